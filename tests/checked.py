"""The type checker of the tests, named in pyproject.toml: beartype, and jaxtyping's axes.

jaxtyping's own decorator binds the arguments of every call and checks them twice, which took a
sixth of the suite's CPU seconds. Here they are checked once, and axes are only kept for functions
that name arrays.
"""

import functools
import types
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import beartype

check = beartype  # of the fields of dataclasses, by jaxtyping's own decorator


def jaxtyped(one: Any = None, *, typechecker: Any) -> Any:
    """Stands for `jaxtyping.jaxtyped` where jaxtyping's import hook decorates modules."""
    if one is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if not isinstance(one, types.FunctionType):
        return one if writes_its_init(one) else usual(one, typechecker=typechecker)
    # beartype writes a checking function for each that it is given, in a millisecond; what is
    # defined inside a function is defined at every call.
    return one if "<locals>" in one.__qualname__ else checked_when_called(one)


def writes_its_init(one: Any) -> bool:
    """Whether a class has an `__init__` that no dataclass made: it is checked as a function."""
    code = getattr(getattr(one, "__init__", None), "__code__", None)
    return isinstance(one, type) and code is not None and code.co_filename != "<string>"


def names_arrays(one: Callable[..., Any]) -> bool:
    return any(
        isinstance(hint, str) or "jaxtyping." in repr(hint) for hint in one.__annotations__.values()
    )


def checked_when_called(one: Callable[..., Any]) -> Callable[..., Any]:
    """Check each call; the checking function is written at the first.

    Names of axes mean one size in all of a call.
    """
    checked: Callable[..., Any] | None = None

    @functools.wraps(one)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        if checked is None:
            made = beartype(one)
            checked = with_axes(made) if names_arrays(one) else made
        return checked(*args, **kwargs)

    return call


def with_axes(checked: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        with usual("context"):
            return checked(*args, **kwargs)

    return call


usual = jaxtyping.jaxtyped
