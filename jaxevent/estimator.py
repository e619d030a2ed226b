"""The contract of every estimator, whatever its family: prepare, run, read; estimate does all.

    features, out = akf.prepare(recording, times, params)  # host: what depends on data alone
    trajectory, state = akf.run(params, features)  # pure: jit, vmap, grad
    mean, covariance, valid = akf.read(params, trajectory, out)  # at the times prepared

    video = akf.estimate(recording, params)  # the three in a row, in constant memory
    mean, covariance, valid = video(times)  # at any times, in any order

An estimator is one object. What it cannot do it says by a capability, a field of `Estimator`.
Evaluation, fitting, the command line and pictures know estimators through this module alone.
"""

import abc
import dataclasses
import functools
import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from jaxevent.arrays import shorten_value
from jaxevent.camera import PinholeCamera
from jaxevent.display import with_article
from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, describe_value_type
from jaxevent.recording import Recording, Times, check_recording, microseconds

P = TypeVar("P", bound=Parameters)
T = TypeVar("T")


class ShortRepr(eqx.Module):
    """A pytree with a `repr` of one line: names, types and shapes of its fields."""

    def __repr__(self) -> str:
        fields = [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self)]
        parts = [f"{name} {_kind_of(value)}" for name, value in fields if value is not None]
        text = ", ".join(parts)
        return f"{type(self).__name__}({text if len(text) < 120 else f'{text[:116]} ...'})"


def _kind_of(value: Any) -> str:
    if eqx.is_array_like(value) and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    leaves = [leaf for leaf in jax.tree.leaves(value) if hasattr(leaf, "dtype")]
    return type(value).__name__ if leaves else str(value)[:20]


class Estimate(ShortRepr):
    """An estimate at some times: `mean, covariance, valid = result(times)`.

    It unpacks, has a length and is indexed as the tuple of its fields: `result(times)[0]` is the
    mean. Arrays begin with an axis of times. `valid` is true where the mean rests on data: for a
    pixel at a time inside the recording, for a target that is alive, for a motion that is not lost.
    Elsewhere the mean is NaN or the last known one.

    | family | mean | covariance | valid |
    |---|---|---|---|
    | reconstruction | intensity (T, H, W) | variance of log intensity (T, H, W) | (T, H, W) |
    | blob | states (T, targets, 8) | (T, targets, 8, 8) | (T, targets) |
    | egomotion | components (T, d) | (T, d, d) | (T,) |

    The covariance is NaN if the estimator has none (`Estimator.has_covariance`).
    """

    mean: Any
    covariance: Any
    valid: Any

    @property
    def variance(self) -> Any:
        """Variances of the mean's numbers, of its shape: the covariance's diagonal."""
        if np.ndim(self.covariance) == np.ndim(self.mean):
            return self.covariance
        return self.covariance.diagonal(axis1=-2, axis2=-1)

    def __iter__(self) -> Iterator[Any]:
        return iter((self.mean, self.covariance, self.valid))

    def __len__(self) -> int:
        return len(tuple(iter(self)))

    def __getitem__(self, place: int | slice) -> Any:
        return tuple(iter(self))[place]


class Result(Protocol):
    """A function of time, as `Estimator.estimate` returns it; reading it never changes it.

    Threads may share it. It can be pickled and copied, or an error names the reason why not.
    """

    def __call__(self, times: Times) -> Estimate:
        """Return the estimate at `times`: integers are microseconds, floats seconds."""
        ...


class OptionKind(NamedTuple):
    """Domain of an option: a test of values, and its description."""

    fits: Callable[[Any], bool]  # test of a value
    text: str  # description of the domain, for messages


def option_of_class(kind: type, optional: bool = True) -> OptionKind:
    """Make the domain of objects of a class.

    Args:
        kind: The class.
        optional: Whether None belongs to the domain.

    Returns:
        The domain.
    """
    text = f"{kind.__module__}.{kind.__name__}{' or None' if optional else ''}"
    return OptionKind(lambda v: isinstance(v, kind) or (optional and v is None), text)


def whole(least: int) -> OptionKind:
    """Make the domain of whole numbers from `least` to the largest of int64."""

    def fits(value: Any) -> bool:
        is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return is_whole and least <= value < 1 << 63

    return OptionKind(fits, f"a whole number from {least} on")


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"


OPTIONAL_FLAG = OptionKind(
    lambda v: v is None or isinstance(v, bool | np.bool_), "True, False or None"
)
OPTIONAL_TIME = OptionKind(
    lambda v: v is None or _is_number(v), "one time, integer microseconds or float seconds, or None"
)
OPTIONAL_ROWS = OptionKind(
    lambda v: v is None or (isinstance(v, Sequence) and not isinstance(v, str)) or np.ndim(v) > 0,
    "a list with an entry for each, or None",
)


@dataclasses.dataclass(frozen=True, repr=False)
class Estimator(abc.ABC, Generic[P]):
    """An estimator: a name, its `Params`, and the steps from a recording to a result.

    Attributes:
        name: Name in configurations and at the command line.
        Params: Class of its parameters.
        family: Kind of result: "reconstruction", "blob" or "egomotion".
        needs_frames: True if it requires frames.
        differentiable: True if `run` and `read` are pure functions of `params` that jit and
            differentiate; if not, `run` computes on the host.
        has_covariance: True if it estimates its uncertainty.
        models: For egomotion: names of the motion models that it supports; empty: all.
        options: Names of the options of `estimate` beyond `progress`.
        about: Description in a sentence or more; `help` shows it.
    """

    name: str
    Params: type[P]
    family: ClassVar[str]
    option_kinds: ClassVar[Mapping[str, OptionKind]] = {
        "camera": option_of_class(PinholeCamera),
        "cloud": whole(0),
        "detect": OPTIONAL_FLAG,
        "model": OptionKind(
            lambda v: v is None or isinstance(v, str | type), "a name or class of a motion model"
        ),
        "progress": OPTIONAL_FLAG,
        "refine": OPTIONAL_FLAG,
        "seed": whole(0),
        "seeds": OPTIONAL_ROWS,
        "smooth": OPTIONAL_FLAG,
        "start": OPTIONAL_TIME,
        "stop": OPTIONAL_TIME,
        "window_events": whole(1),
    }
    needs_frames: bool = dataclasses.field(default=False, kw_only=True)
    differentiable: bool = dataclasses.field(default=True, kw_only=True)
    has_covariance: bool = dataclasses.field(default=True, kw_only=True)
    models: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)
    options: frozenset[str] = dataclasses.field(default=frozenset(), kw_only=True)
    about: str = dataclasses.field(default="", kw_only=True)

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        for name in CHECKED_METHODS & vars(cls).keys():
            setattr(cls, name, _check_arguments(name, vars(cls)[name]))

    def __post_init__(self):
        # `help(akf)` shows an object's own text, if it has one, before its class.
        parameters = inspect.cleandoc(self.Params.__doc__ or "")
        estimate = inspect.cleandoc(type(self).estimate.__doc__ or "")
        text = [
            self.about or inspect.cleandoc(type(self).__doc__ or ""),
            f"`estimate(recording, params, ...)`: {estimate}",
            f"`Params`: {parameters}",
        ]
        object.__setattr__(self, "__doc__", "\n\n".join(text))

    def __repr__(self) -> str:
        return f"<{self.family} method {self.name!r}: {self.about.partition('. ')[0] or 'no text'}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by the place at which it is found again, and is the same object."""
        return import_object, (_place_of(self), Estimator, "method")

    def __copy__(self) -> "Estimator[P]":
        return self

    def __deepcopy__(self, known: Any) -> "Estimator[P]":
        return self

    def names_left_open(self, explicit: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names of parameters that a calibration of the recording sets by default.

        Args:
            explicit: Values that the user gave, by name, and perhaps "preset".

        Returns:
            Names that neither these nor their preset set.
        """
        return self.Params.names_left_open(explicit)

    def check(self, recording: Recording) -> None:
        """Raise `InputError` if the recording lacks what the estimator needs.

        Events that were changed since the recording was made are found here, before kernels run.
        """
        recording.check_events()
        if self.needs_frames and recording.frames is None:
            raise InputError(
                f"{recording.name}: holds no frames, which the method {self.name!r} needs"
                f"{recording.describe_left_out('frames')}; choose a method that uses events"
            )

    @abc.abstractmethod
    def prepare(
        self, recording: Recording, times: Times, params: P | None = None, **options: Any
    ) -> tuple[Any, Any]:
        """Compute what depends on the recording alone, once for all values of most parameters.

        Numbers of `params` that act on data matter here, see `Parameters.names_without_gradient`.

        Args:
            recording: Events, and frames if the estimator uses them.
            times: Sorted times to estimate at: integers are microseconds, floats seconds.
            params: Parameters; by default `Params()`.
            **options: Options of the estimator.

        Returns:
            The features that `run` takes, and the data that `read` takes for `times`.

        Raises:
            InputError: The recording lacks something that the estimator needs.
        """

    @abc.abstractmethod
    def run(self, params: P, features: Any, state: Any = None) -> tuple[Any, Any]:
        """Run the estimator over prepared features; a pure function.

        Args:
            params: Parameters.
            features: Features that `prepare` made.
            state: State that a previous run returned; None starts the recording.

        Returns:
            The trajectory, which `read` takes, and the state at the end.
        """

    @abc.abstractmethod
    def read(self, params: P, trajectory: Any, out: Any) -> Estimate:
        """Evaluate a trajectory at the prepared times; a pure function.

        Args:
            params: Parameters.
            trajectory: Trajectory that `run` returned.
            out: The second value of `prepare`.

        Returns:
            Mean, covariance and validity at the prepared times.
        """

    @abc.abstractmethod
    def estimate(self, recording: Recording, params: P | None = None, **options: Any) -> Any:
        """Estimate over a whole recording, in constant memory.

        Args:
            recording: Events, and frames if the estimator uses them.
            params: Parameters; by default `Params()`, with what the recording shows of numbers in
                `names_left_open`.
            **options: Options of the estimator, see `options`.

        Returns:
            A `Result`, a function of time.

        Raises:
            InputError: The recording lacks something that the estimator needs.
        """

    @property
    def spelled(self) -> str:
        """Name as a Python identifier, for messages."""
        return self.name.replace("-", "_")

    @property
    def by_parameters(self) -> str:
        """Advice on how to differentiate by parameters, for messages."""
        if not self.differentiable:
            return "choose another method, this one is no function of parameters to JAX"
        return (
            "prepare once outside, features, out = prepare(recording, times), and map or "
            "differentiate read(params, run(params, features)[0], out)"
        )

    def check_params(self, params: Any, call: str) -> None:
        """Raise `InputError` unless an argument holds parameters of this method, naming the remedy.

        Args:
            params: The argument; None is allowed.
            call: Name of the called function in the message.
        """
        if params is None:
            return
        if not isinstance(params, self.Params) or params.is_gradient:
            remedy = "Params(name=value)"
            if isinstance(params, str | Path):
                remedy = f"Params.load({str(params)!r})"
            elif isinstance(params, dict):
                remedy = "Params(**params)"
            held = describe_value_type(params)
            if isinstance(params, Parameters) and not params.is_gradient:
                held = f"those of {type(params).__module__}"
            raise InputError(
                f"{call} takes parameters of its method, not {held}; give {self.spelled}.{remedy}"
            )

    def refuse_traced(self, params: Any, call: str) -> None:
        """Raise `InputError` for parameters that JAX traces or maps, naming the remedy.

        Args:
            params: Parameters, or None.
            call: Name of the called function in the message.
        """
        if params is None:
            return
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(params)):
            raise InputError(
                f"{call} works on the host, where jax.grad, jit and vmap cannot follow; "
                f"{self.by_parameters}"
            )
        for name, number in params.numbers.items():
            if np.ndim(params.raw[name]) > isinstance(number.default, tuple):
                raise InputError(
                    f"{call} takes one value of {name}, not {len(params.raw[name])}; for jax.vmap "
                    f"over params {self.by_parameters}"
                )

    def refuse_unknown(self, options: dict[str, Any]) -> None:
        """Raise `InputError` for options that `estimate` does not take."""
        for name in options:
            if name not in self.options:
                known = ", ".join(sorted(self.options)) or "none"
                remedy = f"leave it out (known: {known})"
                if name in self.Params.numbers:
                    remedy = f"it is a parameter, so give Params({name}=...), or keep what is "
                    remedy += f"calibrated by Params.for_recording(recording, {name}=...)"
                raise InputError(f"the method {self.name!r} has no option {name!r}; {remedy}")

    def check_options(self, **options: Any) -> None:
        """Raise `InputError` for an option outside its domain in `option_kinds`."""
        for name, value in options.items():
            kind = self.option_kinds.get(name)
            if kind is not None and not kind.fits(value):
                raise InputError(
                    f"the method {self.name!r} takes {name} as {kind.text}, "
                    f"not {shorten_value(value)}"
                )


CHECKED_METHODS = frozenset({"prepare", "prepare_images", "estimate", "live", "run"})


def _check_arguments(step: str, method: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a step of an estimator so that wrong arguments are refused in a sentence.

    Args:
        step: Name of the step, such as "estimate".
        method: Function that computes the step, with `self`.

    Returns:
        A function of the same arguments that raises `InputError` for wrong ones.
    """
    signature = inspect.signature(method)
    kinds = signature.parameters.items()
    rest = next((name for name, one in kinds if one.kind is one.VAR_KEYWORD), "")

    @functools.wraps(method)
    def checked(self: Any, *args: Any, **kwargs: Any) -> Any:
        call = f"{self.spelled}.{step}"
        try:
            given = signature.bind(self, *args, **kwargs).arguments
        except TypeError as error:
            raise InputError(f"{call}: {error}; see help({self.spelled})") from None
        if "recording" in given:
            check_recording(given["recording"], call)
        if "params" in given:
            self.check_params(given["params"], call)
            if step != "run" or not self.differentiable:
                self.refuse_traced(given["params"], call)
        if step == "estimate":
            others = given.get(rest, {})
            self.refuse_unknown({name: v for name, v in others.items() if name != "progress"})
        if "times" in given:
            microseconds(given["times"], f"{call}: times")
        return method(self, *args, **kwargs)

    return checked


def _place_of(estimator: Estimator) -> str:
    """Return the "package.module:object" that holds an estimator; raise `InputError` if none does.

    The modules of its parameters and its class come before modules that import it from there.
    """
    first = [estimator.Params.__module__, type(estimator).__module__]
    own, main = "jaxevent.", ("__main__", "__mp_main__")
    rest = sorted(sys.modules, key=lambda name: (name in main, not name.startswith(own)))
    for name in (*first, *rest):
        for key, value in list(getattr(sys.modules.get(name), "__dict__", {}).items()):
            if value is estimator:
                return f"{name}:{key}"
    raise InputError(
        f"the method {estimator.name!r} cannot be pickled, as no module holds it; give it a name "
        "in a module"
    )


def import_object(path: str, kind: type[T], what: str) -> T:
    """Import an object by "package.module:object".

    Args:
        path: Module and name of the object.
        kind: Class that it must be an instance of.
        what: Noun for it in messages.

    Returns:
        The object.

    Raises:
        InputError: It cannot be imported or is of another class.
    """
    module, _, name = path.partition(":")
    try:
        found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"the {what} {path!r} cannot be imported ({error}); give package.module:object, of a "
            "package that Python finds (PYTHONPATH)"
        ) from None
    if not isinstance(found, kind):
        raise InputError(
            f"{path!r} is {describe_value_type(found)}, not {with_article(kind.__name__)}"
        )
    return found
