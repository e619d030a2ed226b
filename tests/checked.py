"""The type checker of the tests, named in pyproject.toml.

beartype, but of functions in modules and classes alone. It writes a checking function for each that
it is given, in a millisecond; what is defined inside a function is defined at every call.
"""

from collections.abc import Callable
from typing import Any

from beartype import beartype


def check(one: Callable[..., Any]) -> Callable[..., Any]:
    return one if "<locals>" in one.__qualname__ else beartype(one)
