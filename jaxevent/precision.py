"""Precision of computations: single or double, and full where devices would round."""

import contextlib
import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

Q = ParamSpec("Q")
T = TypeVar("T")


def full_precision(function: Callable[Q, T]) -> Callable[Q, T]:
    """Make a function multiply matrices in full precision, where GPUs round factors to 11 bits."""

    @functools.wraps(function)
    def precise(*args: Q.args, **kwargs: Q.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return precise


def double_precision(enabled: bool) -> contextlib.AbstractContextManager[Any]:
    """Compute in double precision within a `with` block, or in single precision."""
    if hasattr(jax, "enable_x64"):  # since JAX 0.8
        return jax.enable_x64(enabled)
    from jax.experimental import enable_x64  # ty: ignore[missing-module-member]

    return enable_x64(enabled)


def with_own_settings(function: Callable[Q, T]) -> Callable[Q, T]:
    """Make a function compute with this thread's precision and device on other threads, too.

    JAX keeps for each thread what `with` blocks set.
    """
    double, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # ty: ignore[missing-attribute]

    @functools.wraps(function)
    def called(*args: Q.args, **kwargs: Q.kwargs) -> T:
        with double_precision(double), jax.default_device(device):
            return function(*args, **kwargs)

    return called
