"""Parameters of estimators: numbers in physical units, stored in an unconstrained form."""

import difflib
import inspect
import math
import tomllib
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, dataclass_transform, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxevent.deprecated import RenamedAttribute, renamed_names
from jaxevent.display import describe_type
from jaxevent.errors import InputError, InputWarning
from jaxevent.precision import to_jax
from jaxevent.threads import check_platform_available

A = TypeVar("A", Array, np.ndarray)
Numeric = float | Array | np.ndarray | np.number  # a number, or a traced one
T = TypeVar("T", bound="Parameters")
S = TypeVar("S", bound="Setting")

MAX_VALUE = 1e15  # values are smaller in size, so that their squares are in the range of float32
MAX_SHOWN_NUMBERS = 8  # of one parameter in a repr
CALIBRATION_TABLE = "calibration"  # name of the table that `jaxevent calibrate` writes
THRESHOLDS = frozenset({"c_on", "c_off"})  # calibrated numbers that hold for one `I0` only
NO_GRADIENT_REASON = "acts when data are prepared or by comparisons, and has no gradient to follow"


class Setting:
    """A member of a `Parameters` class: a name, a default, a unit and a meaning.

    The class attribute is this description; the attribute of an instance is the value.
    """

    name: str
    default: Any

    def __init__(self, default: Any, unit: str, meaning: str):
        self.default, self.unit, self.meaning = default, unit, meaning

    def __set_name__(self, owner: type, name: str):
        self.name = name

    def __repr__(self) -> str:
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        return f"{self.name} = {format_value(self.default)}{unit}: {self.meaning}"

    def check(self, value: Any) -> None:
        """Raise `InputError` for a value outside the domain."""
        raise NotImplementedError


class Number(Setting):
    """A real parameter, stored in an unconstrained form that an optimiser may step freely.

    A default of several numbers makes an array, which takes lists of the same length. A default of
    one number in a tuple takes lists of any length. `gradient=False` is for a number that acts when
    data are prepared, or by comparisons: it has no derivative, and `optimise` can only search it.
    Values are from `least` to `most`, and below `MAX_VALUE` in size.
    """

    lower: float = -MAX_VALUE  # default of `least` for this class

    def __init__(
        self,
        default: float | tuple[float, ...],
        unit: str,
        meaning: str,
        *,
        gradient: bool = True,
        least: float | None = None,
        most: float = MAX_VALUE,
    ):
        super().__init__(default, unit, meaning)
        self.gradient = gradient
        self.least = self.lower if least is None else least
        self.most = most

    @overload
    def __get__(self: S, instance: None, owner: type) -> S: ...

    @overload
    def __get__(self, instance: "Parameters", owner: type) -> Array: ...

    def __get__(self, instance: "Parameters | None", owner: type) -> Any:
        if instance is None:
            return self
        if instance.is_gradient:
            raise InputError(
                f"this is a gradient, without a value of {self.name}; read "
                f"gradient.raw[{self.name!r}], the derivative by the stored number, or "
                f"gradient.per_unit(params)[{self.name!r}], by the parameter"
            )
        raw = instance.raw[self.name]
        follows = self.gradient or self.name in instance.added_derivatives
        stops = isinstance(raw, Tracer) and not follows
        return self.physical(jax.lax.stop_gradient(raw) if stops else raw)

    if TYPE_CHECKING:  # type of the argument of a `Params` class

        def __set__(self, instance: Any, value: Numeric | Sequence[Numeric]) -> None: ...

    def physical(self, raw: A) -> A:
        """Convert the stored number to the value, by NumPy where it is one of NumPy."""
        return raw

    def unconstrained(self, value: Array) -> Array:
        """Convert a value to the number that is stored."""
        return value

    def check(self, value: Any) -> None:
        """Raise `InputError` for a value outside the domain, or of the wrong shape."""
        if not isinstance(self.default, tuple):
            if isinstance(value, list | tuple):
                raise InputError(
                    f"the parameter {self.name} is {str(value)[:40]}; give one number, and use "
                    "jax.vmap over params for several"
                )
            self.check_one(value)
            return
        if not (isinstance(value, list | tuple) and value):
            raise InputError(
                f"the parameter {self.name} is {repr(value)[:40]}; give a list of numbers, as "
                f"{list(self.default)}"
            )
        if len(value) != len(self.default) > 1:
            raise InputError(
                f"the parameter {self.name} has {len(value)} numbers; give {len(self.default)}"
            )
        for one in value:
            self.check_one(one)

    def check_one(self, value: Any) -> None:
        """Raise `InputError` for a single number outside the domain."""
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) < MAX_VALUE:
            raise InputError(
                f"the parameter {self.name} is {repr(value)[:40]}; give a finite number below "
                f"{MAX_VALUE:g} in size{', without quotes' * isinstance(value, str)}"
            )
        if not self.least <= value <= self.most:
            raise InputError(f"the parameter {self.name} is {value}; it must {self._bounds()}")

    def _bounds(self) -> str:
        if self.most == MAX_VALUE:
            return f"not be below {self.least:g}" if self.least else "not be negative"
        return f"be from {self.least:g} to {self.most:g}"

    def allows(self, value: Array) -> Array:
        """Return whether `check` would accept all values of an array, which may be traced."""
        inside = (value >= self.least) & (value <= self.most) & (jnp.abs(value) < MAX_VALUE)
        return inside.all()


class Positive(Number):
    """A positive number, stored as its logarithm, so that 0 is stored as -inf and stays 0."""

    lower = 0.0

    def physical(self, raw: A) -> A:
        return _apply_elementwise("exp", raw)

    def unconstrained(self, value: Array) -> Array:
        return _apply_elementwise("log", value)


class UnitInterval(Number):
    """A number in [0, 1), stored as ln(p / (1 - p)), so that 0 is stored as -inf and stays 0."""

    def physical(self, raw: A) -> A:
        return _apply_elementwise("sigmoid", raw)

    def unconstrained(self, value: Array) -> Array:
        return _apply_elementwise("logit", value)

    def check_one(self, value: Any) -> None:
        super().check_one(value)
        if not 0 <= value < 1:
            raise InputError(
                f"the parameter {self.name} is {value}; it is a share, from 0 to below 1"
            )

    def allows(self, value: Array) -> Array:
        return ((value >= 0) & (value < 1)).all()


class Choice(Setting):
    """One of a few values, the first by default; not differentiated."""

    def __init__(self, options: tuple[str | bool, ...], meaning: str):
        super().__init__(options[0], "", meaning)
        self.options = options

    @overload
    def __get__(self: S, instance: None, owner: type) -> S: ...

    @overload
    def __get__(self, instance: "Parameters", owner: type) -> Any: ...

    def __get__(self, instance: "Parameters | None", owner: type) -> Any:
        return self if instance is None else dict(instance.chosen)[self.name]

    if TYPE_CHECKING:

        def __set__(self, instance: Any, value: str | bool) -> None: ...

    def __repr__(self) -> str:
        return f"{super().__repr__()} (one of {', '.join(map(format_value, self.options))})"

    def check(self, value: Any) -> None:
        if not any(value is option or value == option for option in self.options) or (
            isinstance(value, bool) != isinstance(self.default, bool)
        ):
            options = " or ".join(
                str(o).lower() if isinstance(o, bool) else repr(o) for o in self.options
            )
            raise InputError(f"the parameter {self.name} is {repr(value)[:40]}; give {options}")


class Count(Setting):
    """A whole number, at least 1, that sizes arrays; not differentiated."""

    @overload
    def __get__(self: S, instance: None, owner: type) -> S: ...

    @overload
    def __get__(self, instance: "Parameters", owner: type) -> int: ...

    def __get__(self, instance: "Parameters | None", owner: type) -> Any:
        return self if instance is None else dict(instance.chosen)[self.name]

    if TYPE_CHECKING:

        def __set__(self, instance: Any, value: int) -> None: ...

    def check(self, value: Any) -> None:
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise InputError(
                f"the parameter {self.name} is {repr(value)[:40]}; give a whole number above 0"
            )


if TYPE_CHECKING:
    # Type checkers and editors see a plain class with keyword arguments: those of an `eqx.Module`
    # may be positional.
    class _Module:
        pass
else:
    _Module = eqx.Module


def _make_inherited_init(base: Any, owner: str) -> Any:
    """Make an `__init__` that calls the one of a base class.

    Args:
        base: Class whose `__init__` is called.
        owner: Qualified name of the class that gets the function.

    Returns:
        The function.
    """

    def init(self, *, preset: str | None = None, **values: Any):
        base.__init__(self, preset=preset, **values)

    init.__name__, init.__qualname__ = "__init__", f"{owner}.__init__"
    return init


@dataclass_transform(
    kw_only_default=True, field_specifiers=(Number, Positive, UnitInterval, Choice, Count)
)
class _ParameterArrays(_Module):
    """Stored fields of `Parameters`."""

    raw: dict[str, Array]  # numbers in unconstrained form, by name
    # choices and counts, by name
    chosen: tuple[tuple[str, str | bool | int], ...] = eqx.field(static=True)
    added_derivatives: frozenset[str] = eqx.field(static=True)  # see `Parameters.with_derivatives`
    # Tells parameters, 1, from gradients and differences of parameters, 0. Nothing depends on it,
    # so JAX makes it 0 in every gradient and tangent (a homogeneous coordinate of `raw`).
    homogeneous: Array


_FIELDS = frozenset({"raw", "chosen", "added_derivatives", "homogeneous"})


class Parameters(_ParameterArrays):
    """Base of every estimator's `Params`: `Params(sigma_iso=0.1)`, `params.sigma_iso`.

    `raw` holds one differentiable leaf per number, `chosen` the choices and counts. A preset is a
    named set of values: `Params(preset="paper", sigma_iso=0.1)`. Numbers may be Python, NumPy or
    JAX numbers, traced or not. Raises `InputError` for a name that does not exist and for a value
    outside its domain.

    `jax.grad(loss)(params)` has this type, too. Its `raw` holds derivatives with respect to the
    stored numbers, which are logarithms of positive parameters. `gradient.per_unit(params)` gives
    derivatives with respect to the parameters themselves.
    """

    if TYPE_CHECKING:
        preset: str | None = None

    numbers: ClassVar[Mapping[str, Number]] = {}
    choices: ClassVar[Mapping[str, Choice | Count]] = {}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}  # named sets of values
    calibrated: ClassVar[tuple[str, ...]] = ()  # names that calibrations of recordings determine
    # Names calibrated only if frames are clipped or blurred, or contradict events at the defaults.
    calibrated_if_needed: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        # Annotations are for editors; Equinox would turn them into fields.
        for name, value in vars(cls).items():
            if isinstance(value, Setting):
                cls.__annotations__.pop(name, None)
        own = vars(cls).items()
        cls.numbers = {**cls.numbers, **{k: v for k, v in own if isinstance(v, Number)}}
        cls.choices = {**cls.choices, **{k: v for k, v in own if isinstance(v, Choice | Count)}}
        # Each class gets its own signature, which `help`, completion and `inspect` show.
        base: Any = next(kind for kind in cls.__mro__[1:] if "__init__" in vars(kind))
        init: Any = vars(cls).get("__init__")
        if init is None:
            init = cls.__init__ = _make_inherited_init(base, cls.__qualname__)
        keyword = inspect.Parameter.KEYWORD_ONLY
        init.__signature__ = inspect.Signature(
            [
                inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY),
                inspect.Parameter("preset", keyword, default=None, annotation=str | None),
                *(
                    inspect.Parameter(name, keyword, default=setting.default)
                    for name, setting in cls.settings().items()
                ),
            ]
        )
        about = (cls.__doc__ or "").partition("\n\nArguments:\n")[0]
        cls.__doc__ = "\n".join([about, "", "Arguments:", *_describe_settings(cls)])

    def __init__(self, *, preset: str | None = None, **values: Any):
        check_platform_available()  # JAX makes its first arrays here
        # `dataclasses.replace` passes the stored fields together with the changed values.
        fields = {name: values.pop(name) for name in _FIELDS} if _FIELDS <= values.keys() else {}
        _refuse_unknown(values, {**self.numbers, **self.choices, "preset": None})
        if preset is not None:
            check_choice(preset, "preset", self.presets)
            values = {**self.presets[preset], **values}
        if fields:
            self.raw, self.chosen = fields["raw"], fields["chosen"]
            self.added_derivatives = fields["added_derivatives"]
            self.homogeneous = fields["homogeneous"]
            changed = self.replace(**values)
            self.raw, self.chosen = changed.raw, changed.chosen
            return
        self.raw = {
            name: _to_stored(number, values.get(name, number.default))
            for name, number in self.numbers.items()
        }
        self.chosen = tuple(
            (name, _to_stored_setting(choice, values.get(name, choice.default)))
            for name, choice in self.choices.items()
        )
        self.added_derivatives = frozenset()
        self.homogeneous = to_jax(np.ones(()))

    @classmethod
    def settings(cls) -> dict[str, Setting]:
        """Return all settings by name."""
        return {**cls.numbers, **cls.choices}

    @classmethod
    def names_left_open(cls, explicit: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names that a calibration may set: those that no value and no preset sets.

        Args:
            explicit: Values by name, and perhaps "preset".

        Returns:
            The names, including those in `calibrated_if_needed`.
        """
        return cls.names_not_stated((*cls.calibrated, *cls.calibrated_if_needed), explicit)

    @classmethod
    def names_not_stated(cls, names: Iterable[str], explicit: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names among `names` that no value and no preset sets.

        Args:
            names: The names.
            explicit: Values by name, and perhaps "preset".

        Returns:
            The names, in the same order.
        """
        stated = {*explicit, *cls.presets.get(explicit.get("preset") or "", {})}
        return tuple(name for name in names if name not in stated)

    @property
    def is_gradient(self) -> bool:
        """True for a gradient or a difference of parameters; false while JAX traces it."""
        return isinstance(self.homogeneous, Array | np.ndarray) and not (
            isinstance(self.homogeneous, Tracer) or np.any(np.asarray(self.homogeneous))
        )

    def per_unit(self, params: "Parameters") -> dict[str, Array]:
        """Convert a gradient to derivatives with respect to the parameters, in 1 / their units.

            gradient = jax.grad(loss)(params)
            gradient.per_unit(params)["c_on"]  # d loss / d c_on

        A gradient holds derivatives with respect to the stored numbers, which are logarithms of
        positive parameters. The chain rule needs the values of the parameters, too.

        Args:
            params: The parameters at which the gradient was taken.

        Returns:
            Derivatives by name, in the gradient's shape. They are 0 for a number without gradient.
            They are NaN for a positive parameter that is 0: it is stored as -inf, and cannot move.

        Raises:
            InputError: This is not a gradient, or `params` are not parameters of the same class.
        """
        if type(params) is not type(self) or params.is_gradient:
            raise InputError(
                f"per_unit needs the {type(self).__qualname__} at which the gradient was taken, "
                f"not {describe_value_type(params)}; give gradient.per_unit(params)"
            )
        if not (self.is_gradient or isinstance(self.homogeneous, Tracer)):
            raise InputError(
                "per_unit converts a gradient and these are parameters; call it as "
                "jax.grad(loss)(params).per_unit(params)"
            )
        found = {}
        for name, number in self.numbers.items():
            raw = jnp.asarray(params.raw[name])
            _, slope = jax.jvp(number.physical, (raw,), (jnp.ones_like(raw),))
            unknown = jnp.nan if number.gradient or name in params.added_derivatives else 0.0
            found[name] = jnp.where(slope == 0, unknown, self.raw[name] / slope)
        return found

    def __repr__(self) -> str:
        if not all(isinstance(leaf, Array | np.ndarray) for leaf in self.raw.values()):
            return eqx.tree_pformat(self)
        if self.is_gradient:
            parts = {
                name: _format_leaf(self.raw[name], self.numbers[name]) for name in self.numbers
            }
            zeros = [name for name, text in parts.items() if text == "0"]
            some = ", ".join(
                f"{name}={_shorten(text)}" for name, text in parts.items() if text != "0"
            )
            rest = f"0: {', '.join(zeros)}" if zeros else ""
            return (
                f"<gradient by {type(self).__qualname__}.raw, where positive numbers are logarithms"
                f": {'; '.join(filter(None, [some, rest]))}>"
            )
        defaults = type(self)()
        changed, same = [], []
        for name in self.settings():
            text = _format_setting(self, name)
            where = same if text == _format_setting(defaults, name) else changed
            where.append(f"{name}={_shorten(text)}")
        rest = f"defaults: {', '.join(same)}" if same else ""
        return f"{type(self).__qualname__}({'; '.join(filter(None, [', '.join(changed), rest]))})"

    def values(self) -> dict[str, Any]:
        """Return physical values and choices by name, in the form that `Params(**values)` takes."""
        numbers = {name: np.asarray(getattr(self, name)).tolist() for name in self.numbers}
        return {**numbers, **dict(self.chosen)}

    def replace(self: T, **values: Any) -> T:
        """Return a copy with some values replaced; raises the same errors as the constructor."""
        _refuse_unknown(values, self.settings())
        if self.is_gradient:
            raise InputError("a gradient has no values to replace; replace those of its parameters")
        raw = {
            name: _to_stored(self.numbers[name], value, self.raw[name].dtype)
            for name, value in values.items()
            if name in self.numbers
        }
        chosen = dict(self.chosen)
        for name in values.keys() - raw.keys():
            chosen[name] = _to_stored_setting(self.choices[name], values[name])
        return self._with({**self.raw, **raw}, tuple(chosen.items()), self.added_derivatives)

    def with_raw(self: T, raw: Mapping[str, Array]) -> T:
        """Return a copy with some of the unconstrained numbers replaced."""
        return self._with({**self.raw, **raw}, self.chosen, self.added_derivatives)

    def with_derivatives(self: T, *names: str) -> T:
        """Return a copy that has derivatives for numbers that act when data are prepared.

        They are valid only near the prepared value: use them for inspection, not for descent.
        """
        _refuse_unknown(dict.fromkeys(names), self.numbers)
        return self._with(self.raw, self.chosen, self.added_derivatives | set(names))

    def _with(
        self: T,
        raw: dict[str, Array],
        chosen: tuple[tuple[str, str | bool | int], ...],
        added_derivatives: frozenset[str],
    ) -> T:
        new = object.__new__(type(self))
        fields = {
            "raw": raw, "chosen": chosen, "added_derivatives": added_derivatives,
            "homogeneous": self.homogeneous,
        }  # fmt: skip
        for name, value in fields.items():
            object.__setattr__(new, name, value)
        return new

    def names_without_gradient(self) -> dict[str, str]:
        """Return the names of the numbers without gradient, each with the reason."""
        return {
            name: NO_GRADIENT_REASON for name, number in self.numbers.items() if not number.gradient
        }

    without_gradient = RenamedAttribute("names_without_gradient")

    @classmethod
    def of(cls: type[T], table: Mapping[str, Any], rest: Mapping[str, Any] | None = None) -> T:
        """Make parameters from a table of `name = value` settings.

        Args:
            table: Values by name; "preset" names a preset.
            rest: Values for numbers that neither the table nor its preset sets.

        Returns:
            The parameters.

        Raises:
            InputError: A name does not exist or a value is outside its domain.
        """
        preset = table.get("preset")
        if preset is not None and not isinstance(preset, str):
            raise InputError(f"the preset is {preset!r}; give the name of one")
        return cls(**{**(rest or {}), **cls.presets.get(preset or "", {}), **table})

    @classmethod
    def load(
        cls: type[T],
        path: str | Path,
        method: str | None = None,
        rest: Mapping[str, Any] | None = None,
    ) -> T:
        """Read parameters from a TOML file; see `load_table`.

        Args:
            path: The file.
            method: Name of the table to take from a file of several methods.
            rest: Values for numbers that the file does not set; omitted, the defaults.

        Returns:
            The parameters.

        Raises:
            InputError: The file cannot be read or holds an invalid setting; the message names file
                and key.
        """
        return cls.of(cls.load_table(path, method), rest)

    @classmethod
    def load_table(cls, path: str | Path, method: str | None = None) -> dict[str, Any]:
        """Read `name = value` settings from a TOML file.

        The file holds settings, or one table of them for each of several methods, as `jaxevent fit`
        writes. A table `[calibration]`, as `jaxevent calibrate` writes, gives numbers that the
        method's settings leave open. Its thresholds hold for its own `I0`, and are left out if the
        settings have another one.

        Args:
            path: The file.
            method: Name of the table to take from a file of several methods.

        Returns:
            Values by name, and perhaps "preset".

        Raises:
            InputError: The file cannot be read or holds an invalid setting.
        """
        table = read_toml(path)
        try:
            calibration = table.pop(CALIBRATION_TABLE, None)
            if table and all(isinstance(part, dict) for part in table.values()):
                if method not in table and calibration is None:
                    raise InputError(
                        f"holds parameters of {', '.join(table)}, none of {method}; choose one of "
                        "those methods or give another file"
                    )
                table = table.get(method or "", {})
            params = cls.of(table)
            if calibration is not None:
                table = {**cls._take_calibration(calibration, table, params), **table}
                cls.of(table)
            return table
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def _take_calibration(
        cls, calibration: Any, table: Mapping[str, Any], params: "Parameters"
    ) -> dict[str, Any]:
        """Select the values of a calibration that complete the settings of a method.

        Args:
            calibration: Table `[calibration]` of a file that `jaxevent calibrate` wrote.
            table: Settings of the user, which take precedence.
            params: Parameters made from `table` alone.

        Returns:
            Values of the calibration for the parameters that `table` leaves open.

        Raises:
            InputError: The calibration is not a table, or the method has none of its parameters.
        """
        if not isinstance(calibration, dict):
            raise InputError(
                f"calibration is {str(calibration)[:40]!r}; give the table that jaxevent calibrate "
                "writes"
            )
        if not cls.calibrated:
            raise InputError(
                "holds the calibration of a recording, and this method has no clock or thresholds; "
                "leave it out"
            )
        names = set(cls.names_left_open(table)) - set(cls.calibrated_if_needed)
        found = {n: calibration[n] for n in cls.settings() if n in names and n in calibration}
        if not found.keys() & THRESHOLDS:
            return found
        I0, own = calibration.get("I0", 1.0), params.values()["I0"]
        cls.numbers["I0"].check(I0)
        if math.isclose(I0, own, rel_tol=1e-4):
            return found
        warnings.warn(
            f"thresholds of the calibration hold for I0 = {I0:g}, not for {own:.4g}, and are left "
            f"out; make others by jaxevent calibrate --I0 {own:.4g}",
            InputWarning,
            stacklevel=4,
        )
        return {name: value for name, value in found.items() if name not in THRESHOLDS}


def read_float(params: Any, name: str, default: float = 0.0) -> float:
    """Read a number of parameters, many times as fast as by way of its JAX array.

    Args:
        params: `Parameters`, or another object.
        name: Name of the number.
        default: Value where there is no such attribute.

    Returns:
        The value.
    """
    if not isinstance(params, Parameters) or name not in params.numbers or params.is_gradient:
        return float(getattr(params, name, default))
    raw: Any = params.raw[name]
    known = raw if isinstance(raw, Tracer) else np.asarray(raw)  # a traced one raises below
    return float(params.numbers[name].physical(known))


# Versions for NumPy and for JAX.
_FUNCTIONS: Mapping[str, tuple[Callable, Callable]] = {
    "exp": (np.exp, jnp.exp),
    "log": (np.log, jnp.log),
    "sigmoid": (lambda raw: 1 / (1 + np.exp(-raw)), jax.nn.sigmoid),
    "logit": (lambda p: np.log(p) - np.log1p(-p), lambda p: jnp.log(p) - jnp.log1p(-p)),
}


def _apply_elementwise(name: str, values: Any) -> Any:
    """Apply a function of `_FUNCTIONS` to each element, with NumPy unless values are traced.

    XLA would compile for 60 ms for each shape.

    Args:
        name: Name in `_FUNCTIONS`.
        values: Array of any shape, of JAX or of NumPy.

    Returns:
        Array of the same shape and library.
    """
    known_by, traced_by = _FUNCTIONS[name]
    if isinstance(values, Tracer):
        return traced_by(values)
    # Logarithms of 0 and overflowing exponentials are expected.
    with np.errstate(divide="ignore", over="ignore"):
        known = np.asarray(known_by(np.asarray(values)))
    return known if isinstance(values, np.ndarray) else to_jax(known)


def _to_python(value: Any) -> Any:
    """Convert arrays to Python numbers and lists; traced values stay as they are."""
    if isinstance(value, list | tuple):
        return [_to_python(one) for one in value]
    if isinstance(value, Tracer):
        return value
    if isinstance(value, np.ndarray | np.generic | Array):
        return value.tolist()  # None where masked
    if hasattr(value, "__array__") and not isinstance(value, type):
        return np.asarray(value).tolist()
    return value


def _to_stored(number: Number, value: Any, dtype: Any = None) -> Array:
    """Convert a value to the number that is stored, checked unless it is traced.

    Args:
        number: The parameter.
        value: Value in the parameter's unit.
        dtype: Type of the stored number; None: JAX's default float.

    Returns:
        The unconstrained number.

    Raises:
        InputError: The value is outside the parameter's domain.
    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    if isinstance(value, Tracer):
        if not (
            jnp.issubdtype(value.dtype, np.floating) or jnp.issubdtype(value.dtype, np.integer)
        ):
            raise InputError(
                f"the parameter {number.name} is traced as {value.dtype}; give a real number"
            )
    elif any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)):
        value = jnp.stack([jnp.asarray(one, dtype) for one in value])
    else:
        plain = _to_python(value)
        number.check(plain)
        # Converted by NumPy, as JAX would compile the conversion.
        value = np.asarray(plain, dtype)
    return number.unconstrained(jnp.asarray(value, dtype))


def _to_stored_setting(setting: Choice | Count, value: Any) -> Any:
    """Check a choice or count, and convert it to the value that is stored.

    Args:
        setting: The parameter.
        value: The value.

    Returns:
        The value.

    Raises:
        InputError: The value is outside the parameter's domain.
    """
    value = _to_python(value)
    setting.check(value)
    return value


def describe_value_type(value: Any) -> str:
    """Describe a value's type for messages: "a dict", "the class Params", "a gradient"."""
    if isinstance(value, Parameters) and value.is_gradient:
        return "a gradient"
    return describe_type(value)


def _format_leaf(value: Array | np.ndarray, number: Number) -> str:
    """Format a physical or stored number; if traced or batched, its type or shape.

    Args:
        value: The value.
        number: The parameter; its default shows whether it is a list of numbers.

    Returns:
        The text.
    """
    if isinstance(value, Tracer):
        return value.aval.str_short()
    ndim = isinstance(number.default, tuple)
    return format_value(np.asarray(value).tolist()) if value.ndim <= ndim else f"array{value.shape}"


def _format_setting(params: Parameters, name: str) -> str:
    """Format the value of one setting; if traced or batched, its type or shape."""
    value = getattr(params, name)
    return (
        _format_leaf(value, params.numbers[name]) if name in params.numbers else format_value(value)
    )


def _shorten(text: str) -> str:
    """Shorten the text of a list of many numbers to its first three."""
    numbers = text.split(", ")
    if len(numbers) <= MAX_SHOWN_NUMBERS:
        return text
    return f"{', '.join(numbers[:3])}, ... {len(numbers)} numbers]"


def format_value(value: Any) -> str:
    """Format a value for descriptions; floats get four significant digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(format_value, value))}]"
    return repr(value)


def _describe_settings(kind: type[Parameters]) -> list[str]:
    """Return lines that describe every setting, for the docstring of a class."""
    lines = []
    for name, setting in kind.settings().items():
        unit = f" {setting.unit}" if setting.unit not in ("", "1") else ""
        more = ""
        if isinstance(setting, Choice):
            more = f" One of {', '.join(map(format_value, setting.options))}."
        if isinstance(setting, Number) and not setting.gradient:
            more = " No gradient."
        lines.append(
            f"    {name}: default {format_value(setting.default)}{unit}; {setting.meaning}.{more}"
        )
    if kind.presets:
        lines.append(f"    preset: a named set of values: {', '.join(kind.presets)}.")
    return lines


def _refuse_unknown(values: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    for name in values:
        check_choice(name, "parameter", known)


def check_choice(name: Any, what: str, known: Collection[str]) -> str:
    """Check that a name is one of the known names.

    Args:
        name: The name; configurations may give any type.
        what: Noun for it in the message.
        known: All names that exist.

    Returns:
        The name.

    Raises:
        InputError: There is no such name; the message suggests one.
    """
    if name not in known:
        raise InputError(f"there is no {what} {name!r}; {suggest_name(str(name), known)}")
    return name


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the closest known name, or all of them.

    Args:
        name: The unknown name.
        known: All names that exist.

    Returns:
        "did you mean 'x'?", or "known: x, y".
    """
    close = difflib.get_close_matches(name, list(known), 3)
    close.sort(key=lambda one: sorted(one) != sorted(name))  # letters in another order come first
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read the tables of a TOML file; raise `InputError` if it is missing or not TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text; give a file in TOML") from None
    except ValueError as error:  # not TOML, or an integer without end
        raise InputError(f"{path}: is not TOML ({error}); mend that line") from None


__getattr__ = renamed_names(__name__)
