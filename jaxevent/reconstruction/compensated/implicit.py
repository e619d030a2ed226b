"""Derivatives through motion: what trajectories do when images or parameters change a little.

Converged trajectories p are where the right-hand side of the normal equations of `trajectories`
vanishes, F(p, images, numbers) = 0. So dp = A^-1 dF at fixed p, with A = -dF/dp. Derivatives solve
these equations once, backwards the transposed ones. A is close to the normal matrix, which
conjugate gradients invert as the preconditioner of the whole.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import bicgstab, cg
from jaxtyping import Array, Float

from jaxevent.devices import full_precision
from jaxevent.reconstruction.compensated.trajectories import OUTSIDE
from jaxevent.reconstruction.compensated.warping import places, sample, spread_purely, within
from jaxevent.reconstruction.features import Numeric

ITERATIONS = 30  # of conjugate gradients
REPEATED = 8  # with what the normal matrix leaves out


class Numbers(NamedTuple):
    """Those of the motion's cost; see `parameters`."""

    floor: Numeric
    robust: Numeric
    smooth: Numeric
    jump: Numeric
    edge: Numeric
    straight: Numeric


class Seen(NamedTuple):
    """The images that motion is estimated from."""

    L: Float[Numeric, "k h w"]
    V: Float[Numeric, "k h w"]
    s: Float[Numeric, " k"]
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only fill up the number


class Equations(NamedTuple):
    """The normal equations at some trajectories, for all nodes."""

    N: Float[Array, "rows columns 4 4"]
    b: Float[Array, "rows columns 4"]
    across: Float[Array, "rows columns-1"]  # weights of differences between neighbours
    down: Float[Array, "rows-1 columns"]
    smooth: Float[Array, " 4"]
    ridge: Float[Array, " 4"]


def _slopes(images: Array) -> tuple[Array, Array]:
    """Along x and y, by five taps, as `trajectories` has them."""

    def along(axis: int) -> Array:
        rest = [(0, 0)] * images.ndim
        rest[axis] = (2, 2)
        padded, size = jnp.pad(images, rest, mode="edge"), images.shape[axis]
        a, b, _, d, e = (jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(5))
        return (8 * (d - b) - e + a) / 12

    return along(images.ndim - 1), along(images.ndim - 2)


def _to_nodes(pixels: Array) -> Array:
    """Means (rows, columns, ...) of the 2 x 2 pixels of each node."""
    h, w = pixels.shape[:2]

    def total(values: Array) -> Array:
        rest = [(0, h % 2), (0, w % 2)] + [(0, 0)] * (values.ndim - 2)
        padded = jnp.pad(values, rest)
        return padded[::2, ::2] + padded[::2, 1::2] + padded[1::2, ::2] + padded[1::2, 1::2]

    count = total(jnp.ones((h, w), pixels.dtype))
    return total(pixels) / count.reshape(*count.shape, *[1] * (pixels.ndim - 2))


def _soften(nodes: Array) -> Array:
    """Blur by (1, 6, 1) / 8."""
    for axis in (0, 1):
        rest = [(0, 0)] * nodes.ndim
        rest[axis] = (1, 1)
        padded, size = jnp.pad(nodes, rest, mode="edge"), nodes.shape[axis]
        a, b, c = (jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(3))
        nodes = (a + 6 * b + c) / 8
    return nodes


@full_precision
def equations(p: Array, seen: Seen, numbers: Numbers) -> Equations:
    """The normal equations of `trajectories.step`, as a pure function."""
    L, V, s, present = seen
    count, h, w = L.shape
    Y, X = (one.astype(p.dtype) for one in places(spread_purely(p, h, w), s))
    inside = within(Y, X, h, w)
    gx, gy = _slopes(L)
    L, V, gx, gy = (sample(images, Y, X) for images in (L, V, gx, gy))
    shown = present[:, None, None]
    W = shown * jnp.where(inside, 1 / (V + numbers.floor), OUTSIDE)
    s = s[:, None, None]
    R = W * jnp.exp(-2 * s**2)
    m = (R * L).sum(0) / R.sum(0)
    for _ in range(2):
        R = W / (1 + (L - m) ** 2 * W / numbers.robust)
        m = (R * L).sum(0) / R.sum(0)
    mx, my = _slopes(m)
    J = jnp.stack([(gx + mx) / 2 * s, (gy + my) / 2 * s])
    J = jnp.concatenate([J, J * s])
    total = R.sum(0)
    J = J - (R * J).sum(1, keepdims=True) / total
    N = jnp.einsum("khw,akhw,bkhw->hwab", R, J, J)
    b = -jnp.einsum("khw,akhw,khw->hwa", R, J, L - m)
    steep = _to_nodes(jnp.sqrt(mx**2 + my**2 + 1e-20))

    def weights(axis: int) -> Array:
        apart, slope = jnp.diff(p[..., :2], axis=axis), steep
        one, other = ((slope[:, :-1], slope[:, 1:]), (slope[:-1], slope[1:]))[axis == 0]
        weight = numbers.jump / jnp.sqrt((apart**2).sum(-1) + numbers.jump**2)
        return weight * (0.1 + 0.9 * jnp.exp(-(one + other) / 2 / numbers.edge))

    smooth = numbers.smooth * jnp.ones(4, p.dtype)
    tiny = 1e-5 * numbers.smooth
    ridge = jnp.stack([tiny, tiny, numbers.straight, numbers.straight])
    return Equations(
        _soften(_to_nodes(N)), _soften(_to_nodes(b)), weights(1), weights(0), smooth, ridge
    )


def _pull(eq: Equations, q: Array) -> Array:
    """(smooth Laplacian + ridge) q."""
    x = eq.across[..., None] * jnp.diff(q, axis=1)
    y = eq.down[..., None] * jnp.diff(q, axis=0)
    rough = jnp.pad(x, [(0, 0), (1, 0), (0, 0)]) - jnp.pad(x, [(0, 0), (0, 1), (0, 0)])
    rough = rough + jnp.pad(y, [(1, 0), (0, 0), (0, 0)]) - jnp.pad(y, [(0, 1), (0, 0), (0, 0)])
    return eq.smooth * rough + eq.ridge * q


def imbalance(p: Array, seen: Seen, numbers: Numbers) -> Array:
    """F (rows, columns, 4), which vanishes where Gauss-Newton steps have converged."""
    eq = equations(p, seen, numbers)
    return eq.b - _pull(eq, p)


@full_precision
def _solve(eq: Equations, right: Array) -> Array:
    degree = jnp.pad(eq.across, [(0, 0), (1, 0)]) + jnp.pad(eq.across, [(0, 0), (0, 1)])
    degree = degree + jnp.pad(eq.down, [(1, 0), (0, 0)]) + jnp.pad(eq.down, [(0, 1), (0, 0)])
    diagonal = eq.smooth * degree[..., None] + eq.ridge + 1e-6
    blocks = jnp.linalg.inv(eq.N + diagonal[..., None] * jnp.eye(4, dtype=right.dtype))

    def times(q: Array) -> Array:
        return jnp.einsum("ijab,ijb->ija", eq.N, q) + _pull(eq, q)

    def precondition(q: Array) -> Array:
        return jnp.einsum("ijab,ijb->ija", blocks, q)

    return cg(times, right, tol=1e-6, maxiter=ITERATIONS, M=precondition)[0]


@jax.custom_jvp
def depending(p: Array, seen: Seen, numbers: Numbers) -> Array:
    """Converged trajectories p (rows, columns, 4), as a function of images and numbers.

    Returns p as it is. Derivatives are those of the fixpoint; clipped steps and medians, which act
    away from it, count as none, and so do instants and nodes, which are chosen by data.
    """
    return p


@depending.defjvp
def _differentiate(values: tuple, changes: tuple) -> tuple[Array, Array]:
    p, seen, numbers = values
    _, dseen, dnumbers = changes
    eq = equations(p, seen, numbers)

    def balance(images: Seen, others: Numbers) -> Array:
        return imbalance(p, images, others)

    def times(dp: Array) -> Array:
        """A dp."""
        return -jax.jvp(lambda q: imbalance(q, seen, numbers), (p,), (dp,))[1]

    def solve(product: Callable[[Array], Array], right: Array) -> Array:
        def nearly(other: Array) -> Array:
            return _solve(eq, other)

        return bicgstab(product, right, tol=1e-5, maxiter=REPEATED, M=nearly)[0]

    _, dF = jax.jvp(balance, (seen, numbers), (dseen, dnumbers))
    return p, jax.lax.custom_linear_solve(times, dF, solve, solve)
