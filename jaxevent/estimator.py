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
import importlib
import inspect
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import equinox as eqx
import jax

from jaxevent.errors import InputError
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording, Times

P = TypeVar("P", bound=Parameters)
T = TypeVar("T")


class Described(eqx.Module):
    """A pytree whose `repr` says in a line what it holds: names, types and shapes."""

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


class Estimate(Described):
    """What an estimator tells of some times: `mean, covariance, valid = result(times)`.

    Arrays begin with an axis of times. `valid` says where the mean rests on data: of a pixel at a
    time inside the recording, of a target that is alive, of a motion that is not lost. Elsewhere
    the mean is NaN or the last one known.

    | family | mean | covariance | valid |
    |---|---|---|---|
    | reconstruction | intensity (T, H, W) | variance of log intensity (T, H, W) | (T, H, W) |
    | blob | states (T, targets, 8) | (T, targets, 8, 8) | (T, targets) |
    | egomotion | components (T, d) | (T, d, d) | (T,) |

    A covariance is NaN where the estimator tells none (`Estimator.has_covariance`).
    """

    mean: Any
    covariance: Any
    valid: Any

    def __iter__(self) -> Iterator[Any]:
        return iter((self.mean, self.covariance, self.valid))


class Result(Protocol):
    """What `Estimator.estimate` returns: a function of time; reading it never changes it."""

    def __call__(self, times: Times) -> Estimate:
        """The estimate at `times`: integers are microseconds, floats seconds."""
        ...


@dataclasses.dataclass(frozen=True, repr=False)
class Estimator(abc.ABC, Generic[P]):
    """One estimator: a name, its `Params`, and the steps from a recording to a result.

    Attributes:
        name: How configurations and the command line call it.
        Params: The class of its parameters.
        family: "reconstruction", "blob" or "egomotion": what kind of result it gives.
        needs_frames: Whether it cannot do without frames.
        differentiable: Whether `run` and `read` are pure functions of `params` that jit and
            differentiate; if not, `run` computes on the host.
        has_covariance: Whether it tells how certain it is.
        models: Of egomotion: the names of the motion models that it knows; empty: all.
        options: Names of what `estimate` takes beyond `progress`.
        about: What it is, in a sentence or more; `help` shows it.
    """

    name: str
    Params: type[P]
    family: ClassVar[str]
    needs_frames: bool = dataclasses.field(default=False, kw_only=True)
    differentiable: bool = dataclasses.field(default=True, kw_only=True)
    has_covariance: bool = dataclasses.field(default=True, kw_only=True)
    models: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)
    options: frozenset[str] = dataclasses.field(default=frozenset(), kw_only=True)
    about: str = dataclasses.field(default="", kw_only=True)

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

    def check(self, recording: Recording) -> None:
        """Raise `InputError` if the recording lacks what the estimator needs."""
        if self.needs_frames and recording.frames is None:
            raise InputError(
                f"{recording.name}: holds no frames, which the method {self.name!r} needs"
                f"{recording.describe_left_out('frames')}; choose a method that uses events"
            )

    @abc.abstractmethod
    def prepare(
        self, recording: Recording, times: Times, params: P | None = None, **options: Any
    ) -> tuple[Any, Any]:
        """What `run` needs of a whole recording, and what `read` needs of sorted `times`.

        Depends on data, and on those numbers of `params` that act when data are prepared
        (`Parameters.without_gradient` names them).
        """

    @abc.abstractmethod
    def run(self, params: P, features: Any, state: Any = None) -> tuple[Any, Any]:
        """Estimate: the trajectory, to be read, and the state at the end; pure.

        `state` is what the run before returned; omitted, the recording starts here.
        """

    @abc.abstractmethod
    def read(self, params: P, trajectory: Any, out: Any) -> Estimate:
        """The estimate at the times that were prepared; pure, as `run`."""

    @abc.abstractmethod
    def estimate(self, recording: Recording, params: P | None = None, **options: Any) -> Any:
        """The `Result` of a recording; see the family's own for its options."""

    def refuse_unknown(self, options: dict[str, Any]) -> None:
        """Raise `InputError` for options that `estimate` does not take."""
        for name in options:
            if name not in self.options:
                known = ", ".join(sorted(self.options)) or "none"
                raise InputError(
                    f"the method {self.name!r} has no option {name!r}; leave it out (known: "
                    f"{known})"
                )


def imported(path: str, kind: type[T], what: str) -> T:
    """The object that "package.module:object" names; raises `InputError` if it is not of `kind`."""
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
        wanted = f"a{'n' * (kind.__name__[0] in 'AEIOU')} {kind.__name__}"
        raise InputError(f"{path!r} is a {type(found).__name__}, not {wanted}")
    return found
