"""Precision of computations: single or double, and full where devices would round."""

import contextlib
import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

Q = ParamSpec("Q")
T = TypeVar("T")


def full_precision(function: Callable[Q, T]) -> Callable[Q, T]:
    """Make a function multiply matrices in full precision, where GPUs round factors to 11 bits."""

    @functools.wraps(function)
    def precise(*args: Q.args, **kwargs: Q.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return precise


def to_jax(values: ArrayLike | Array) -> Array:
    """Convert numbers to a JAX array of JAX's own precision, without compiling a program.

    `jnp.asarray` compiles one for each shape, for 60 ms, unless values have the type that they get.
    """
    if isinstance(values, Array):
        return values
    known = np.asarray(values)
    real = jax.dtypes.canonicalize_dtype(known.dtype)
    return jnp.asarray(known.astype(real, copy=False), real)


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
