"""Points among lattice points: their neighbours, with shares and the shares' slopes."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array


class Near(NamedTuple):
    """The n * n neighbours of points on a lattice (n * n, E): shares, and slopes of the shares."""

    first: Array  # index of the one of the lowest row and column
    share: Array
    along_x: Array
    along_y: Array
    inside: Array


def bilinear(X: Array, Y: Array, corner: tuple, size: float | int, shape: tuple) -> Near:
    """Bilinear interpolation between lattice points `size` px apart."""
    i, j = (X - corner[0]) / size, (Y - corner[1]) / size
    inside = (i >= 0) & (i < shape[1] - 1) & (j >= 0) & (j < shape[0] - 1)
    i, j = jnp.clip(i, 0, shape[1] - 1.001), jnp.clip(j, 0, shape[0] - 1.001)
    low, top = jnp.floor(i), jnp.floor(j)
    u, v = i - low, j - top
    return Near(
        (top * shape[1] + low).astype(jnp.int32),
        jnp.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]),
        jnp.stack([v - 1, 1 - v, -v, v]) / size,
        jnp.stack([u - 1, -u, 1 - u, u]) / size,
        inside,
    )


def spline(X: Array, Y: Array, corner: tuple, shape: tuple) -> Near:
    """Quadratic B-splines a pixel apart."""
    i, j = X - corner[0], Y - corner[1]
    inside = (i >= 1) & (i < shape[1] - 2) & (j >= 1) & (j < shape[0] - 2)
    i, j = jnp.clip(i, 1, shape[1] - 2), jnp.clip(j, 1, shape[0] - 2)
    low, top = jnp.round(i), jnp.round(j)

    def shares(t: Array) -> tuple[list[Array], list[Array]]:
        return (
            [(0.5 - t) ** 2 / 2, 0.75 - t**2, (0.5 + t) ** 2 / 2],
            [t - 0.5, -2 * t, t + 0.5],
        )

    def product(rows: list[Array], columns: list[Array]) -> Array:
        return jnp.stack([row * column for row in rows for column in columns])

    (across, slope_x), (down, slope_y) = shares(i - low), shares(j - top)
    first = ((top - 1) * shape[1] + low - 1).astype(jnp.int32)
    return Near(
        first, product(down, across), product(down, slope_x), product(slope_y, across), inside
    )


def offsets(near: Near, shape: tuple) -> list[int]:
    """From the first of the neighbours to each of them."""
    n = math.isqrt(len(near.share))
    return [a * shape[1] + b for a in range(n) for b in range(n)]


def gather(values: Array, near: Near, shape: tuple) -> list[Array]:
    """The neighbours' values, of values (height * width)."""
    values = values.ravel()
    return [
        values.at[near.first + step].get(mode="promise_in_bounds") for step in offsets(near, shape)
    ]


def weigh(values: list[Array], share: Array) -> Array:
    """The sum of values, one of each corner, by their shares."""
    return sum((value * part for value, part in zip(values, share, strict=True)), jnp.zeros(()))


def scatter(values: Array, near: Near, share: Array, shape: tuple) -> Array:
    """The transpose of gathering with shares: (E, ...) to (height * width, ...)."""
    found = jnp.zeros((shape[0] * shape[1], *values.shape[1:]), values.dtype)
    for step, part in zip(offsets(near, shape), share, strict=True):
        found = found.at[near.first + step].add(values * part, mode="promise_in_bounds")
    return found


def laplacian(values: Array) -> Array:
    """Minus the sum of differences to the neighbours, of a map."""
    zero = jnp.zeros((), values.dtype)

    def moved(rows: int, columns: int) -> Array:
        return lax.pad(values, zero, ((rows, -rows, 0), (columns, -columns, 0)))

    # One sum a pixel is a fifth of the time of differences added to where they belong.
    down, across = (np.r_[1, np.full(n - 2, 2), 1] for n in values.shape)
    number = jnp.asarray(down[:, None] + across, values.dtype)
    return number * values - moved(1, 0) - moved(-1, 0) - moved(0, 1) - moved(0, -1)
