"""Parameters of estimators: numbers that are read in physical units and tuned without bounds."""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxevent.errors import InputError

T = TypeVar("T", bound="Parameters")


class Number:
    """A parameter of a `Parameters` class: its default, unit and meaning.

    Reading it from an instance gives the physical value; the instance stores `raw`, on which an
    optimiser may step anywhere.
    """

    def __init__(self, default: float, unit: str, meaning: str):
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

    def check(self, value: Any) -> None:
        super().check(value)
        if value < 0:
            raise InputError(f"the parameter {self.name} is {value}; it must not be negative")


class Parameters(eqx.Module):
    """Base of every estimator's `Params`: `Params(sigma_iso=0.1)`, `params.sigma_iso`.

    `raw` holds one differentiable leaf per number. Raises `InputError` for a name that does not
    exist and for a value outside its domain.
    """

    raw: dict[str, Array]

    numbers: ClassVar[Mapping[str, Number]] = {}

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        own = {name: entry for name, entry in vars(cls).items() if isinstance(entry, Number)}
        cls.numbers = {**cls.numbers, **own}

    def __init__(self, **values: Any):
        _refuse_unknown(values, self.numbers)
        self.raw = {}
        for name, number in self.numbers.items():
            value = values.get(name, number.default)
            if not isinstance(value, Array):
                number.check(value)
            value = jnp.asarray(value, jnp.result_type(float))
            self.raw[name] = number.unconstrained(value)

    def values(self) -> dict[str, float]:
        """The physical values by name, as `Params(**values)` takes them."""
        return {name: float(getattr(self, name)) for name in self.numbers}

    @classmethod
    def of(cls: type[T], table: Mapping[str, Any]) -> T:
        """Params from `name = number` settings; raises `InputError` naming the setting."""
        _refuse_unknown(table, cls.numbers)
        return cls(**table)

    @classmethod
    def load(cls: type[T], path: str | Path) -> T:
        """Params from a TOML file of `name = number`; raises `InputError` naming file and key."""
        try:
            return cls.of(read_toml(path))
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
