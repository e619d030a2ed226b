"""Parameters of estimators: numbers that are read in physical units and tuned without bounds."""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxevent.errors import InputError

T = TypeVar("T", bound="Parameters")


class Number:
    """A parameter of a `Parameters` class: its default, unit and meaning.

    Reading it from an instance gives the physical value; the instance stores `raw`, on which an
    optimiser may step anywhere. A default of several numbers makes it an array, given as a list.
    """

    def __init__(self, default: float | tuple[float, ...], unit: str, meaning: str):
        self.default, self.unit, self.meaning = default, unit, meaning

    def __set_name__(self, owner: type, name: str):
        self.name = name

    def __get__(self, instance: "Parameters", owner: type) -> Array:
        return self.physical(instance.raw[self.name])

    def physical(self, raw: Array) -> Array:
        return raw

    def unconstrained(self, value: Array) -> Array:
        return value

    def check(self, value: Any) -> None:
        if not isinstance(self.default, tuple):
            self.check_one(value)
            return
        if not (isinstance(value, list | tuple) and value):
            raise InputError(
                f"the parameter {self.name} is {str(value)[:40]}; give a list of numbers, as "
                f"{list(self.default)}"
            )
        for one in value:
            self.check_one(one)

    def check_one(self, value: Any) -> None:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) < 1e38:  # the range of float32
            raise InputError(
                f"the parameter {self.name} is {str(value)[:40]}; give a finite number"
            )


class Positive(Number):
    """A number that stays positive; stored as its logarithm, so 0 is stored as -inf and stays 0."""

    def physical(self, raw: Array) -> Array:
        return jnp.exp(raw)

    def unconstrained(self, value: Array) -> Array:
        return jnp.log(value)

    def check_one(self, value: Any) -> None:
        super().check_one(value)
        if value < 0:
            raise InputError(f"the parameter {self.name} is {value}; it must not be negative")


class Choice:
    """A setting of a `Parameters` class: one of a few values, not differentiated."""

    def __init__(self, options: tuple[str | bool, ...], meaning: str):
        self.options, self.meaning = options, meaning
        self.default = options[0]

    def __set_name__(self, owner: type, name: str):
        self.name = name

    def __get__(self, instance: "Parameters", owner: type) -> Any:
        return dict(instance.chosen)[self.name]

    def check(self, value: Any) -> None:
        if not any(value is option or value == option for option in self.options) or (
            isinstance(value, bool) != isinstance(self.default, bool)
        ):
            options = " or ".join(
                str(o).lower() if isinstance(o, bool) else repr(o) for o in self.options
            )
            raise InputError(f"the parameter {self.name} is {str(value)[:40]!r}; give {options}")


class Count:
    """A setting of a `Parameters` class: a whole number, at least 1, that sizes arrays."""

    def __init__(self, default: int, unit: str, meaning: str):
        self.default, self.unit, self.meaning = default, unit, meaning

    def __set_name__(self, owner: type, name: str):
        self.name = name

    def __get__(self, instance: "Parameters", owner: type) -> int:
        return dict(instance.chosen)[self.name]  # type: ignore[return-value]

    def check(self, value: Any) -> None:
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise InputError(
                f"the parameter {self.name} is {str(value)[:40]!r}; give a whole number above 0"
            )


class Parameters(eqx.Module):
    """Base of every estimator's `Params`: `Params(sigma_iso=0.1)`, `params.sigma_iso`.

    `raw` holds one differentiable leaf per number, `chosen` the choices and counts. A named set of
    values is a preset: `Params(preset="paper", sigma_iso=0.1)`. Raises `InputError` for a name that
    does not exist and for a value outside its domain.
    """

    raw: dict[str, Array]
    chosen: tuple[tuple[str, str | bool | int], ...] = eqx.field(static=True)

    numbers: ClassVar[Mapping[str, Number]] = {}
    choices: ClassVar[Mapping[str, Choice | Count]] = {}
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        own = vars(cls).items()
        cls.numbers = {**cls.numbers, **{k: v for k, v in own if isinstance(v, Number)}}
        cls.choices = {**cls.choices, **{k: v for k, v in own if isinstance(v, Choice | Count)}}

    def __init__(self, *, preset: str | None = None, **values: Any):
        known = {**self.numbers, **self.choices}
        _refuse_unknown(values, {**known, "preset": None})
        if preset is not None:
            if preset not in self.presets:
                raise InputError(f"there is no preset {preset!r}; {nearest(preset, self.presets)}")
            values = {**self.presets[preset], **values}
        self.raw = {}
        for name, number in self.numbers.items():
            value = values.get(name, number.default)
            if not isinstance(value, Array):
                number.check(value)
            value = jnp.asarray(value, jnp.result_type(float))
            self.raw[name] = number.unconstrained(value)
        chosen = {name: values.get(name, choice.default) for name, choice in self.choices.items()}
        for name, value in chosen.items():
            self.choices[name].check(value)
        self.chosen = tuple(chosen.items())

    def values(self) -> dict[str, Any]:
        """The physical values and the choices by name, as `Params(**values)` takes them."""
        numbers = {name: np.asarray(getattr(self, name)).tolist() for name in self.numbers}
        return {**numbers, **dict(self.chosen)}

    @classmethod
    def of(cls: type[T], table: Mapping[str, Any]) -> T:
        """Params from `name = value` settings; raises `InputError` naming the setting."""
        preset = table.get("preset")
        if preset is not None and not isinstance(preset, str):
            raise InputError(f"the preset is {preset!r}; give the name of one")
        return cls(**table)

    @classmethod
    def load(cls: type[T], path: str | Path, method: str | None = None) -> T:
        """Params from a TOML file; raises `InputError` naming file and key.

        The file holds `name = value` settings, or one table of them for each of several methods
        (as `jaxevent fit` writes); then `method` is the name of the table to take.
        """
        table = read_toml(path)
        try:
            if table and all(isinstance(part, dict) for part in table.values()):
                if method is None or method not in table:
                    raise InputError(
                        f"holds parameters of {', '.join(table)}, none of {method}; choose one of "
                        "those methods or give another file"
                    )
                table = table[method]
            return cls.of(table)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def _refuse_unknown(values: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    for name in values:
        if name not in known:
            raise InputError(f"there is no parameter {name!r}; {nearest(name, known)}")


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of a sentence that says what an unknown name may have meant."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file; raises `InputError` if it is missing or not TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:  # not TOML, not UTF-8, or an integer without end
        raise InputError(f"{path}: is not TOML ({error}); mend that line") from None
