"""How loops over events are compiled for the host."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable) -> Any:
    """Compile with numba, without the argument checks that tests wrap around functions."""
    return numba.njit(cache=True, nogil=True)(inspect.unwrap(function))
