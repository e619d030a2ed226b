"""Steps of Gauss and Newton, which the alignment and the photometric fit of a window share.

A fit linearises, adds what the priors pull, solves, limits the step and accepts it or not; each is
a function of its own. What is common of the path's rows and of bonds between neighbours is here
too.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxevent.egomotion.batch_fit.path import SEGMENTS, Path, Prior

FURTHEST = 4  # px at the window's end, that a step moves at most
DEEPEST = 0.5  # of log depth, likewise
# A step that costs more is taken back and damped, first by so much, then by so many times more;
# where that is too much no step helps. A step that costs less leaves so much of the damping, and is
# the last if it gains less than such a part.
DAMP, HARDER, STUCK, SOFTER, ENOUGH = 0.1, 5, 50, 0.5, 1e-3


class Acceptance(NamedTuple):
    """How steps go on: Nesterov's count of steps that gained, and the damping."""

    momentum: Array
    damping: Array

    @property
    def ahead(self) -> Array:
        """By how many times the last step the next one starts ahead: reweighting alone closes a
        tenth of what is left in a step."""
        return self.momentum / (self.momentum + 2)

    @property
    def goes_on(self) -> Array:
        return self.damping < STUCK


def accept(now: Acceptance, better: Array, gain: Array, energy: Array, counts: Array) -> Acceptance:
    """After a step that was `better` or not and gained so much of the energy.

    Only from when it `counts` does a gain add momentum.
    """
    damping = jnp.where(better, now.damping * SOFTER, jnp.maximum(now.damping * HARDER, DAMP))
    damping = jnp.where(damping < DAMP / 4, 0, damping)
    damping = jnp.where(better & (gain < ENOUGH * energy), STUCK, damping)
    return Acceptance(jnp.where(better & counts, now.momentum + 1, 0), damping)


def conjugate_gradients(
    times_H: Callable[[Any], Any], ease: Callable[[Any], Any], side: Any, steps: int
) -> Any:
    """H^-1 side after so many steps from 0, of pytrees; `ease` is the preconditioner."""

    def dot(u: Any, v: Any) -> Array:
        pairs = zip(jax.tree.leaves(u), jax.tree.leaves(v), strict=True)
        return sum((jnp.vdot(p, q) for p, q in pairs), jnp.zeros(()))

    def plus(u: Any, scale: Array, v: Any) -> Any:
        return jax.tree.map(lambda p, q: p + (scale * q).astype(p.dtype), u, v)

    def one(_: Any, state: tuple) -> tuple:
        found, left, direction, size = state
        image = times_H(direction)
        length = size / jnp.maximum(dot(direction, image), 1e-30)
        found, left = plus(found, length, direction), plus(left, -length, image)
        better = ease(left)
        new = dot(left, better)
        return found, left, plus(better, new / jnp.maximum(size, 1e-30), direction), new

    better = ease(side)
    state = (jax.tree.map(jnp.zeros_like, side), side, better, dot(side, better))
    return lax.fori_loop(0, steps, one, state)[0]


def limit_step(rows: Array) -> Array:
    """The share of a step of the path's rows (in px at the window's end) that is taken."""
    return jnp.minimum(1, FURTHEST / jnp.maximum(jnp.abs(rows).max(), 1e-9))


def first_rows(path: Path, k: int) -> Float[Array, " n"]:
    """The first k rows of O and of D, in one."""
    return jnp.concatenate([path.O[:k], path.D[:k]]).ravel()


def with_first_rows(path: Path, values: Array, k: int) -> Path:
    """The path with these rows."""
    values = values.reshape(2 * k, 3)
    if k == len(path.O):
        return Path(values[:k], values[k:], path.log_rho)
    return Path(path.O.at[:k].set(values[:k]), path.D.at[:k].set(values[k:]), path.log_rho)


def units_of_rows(path: Path, f: Array, half: Array, k: int) -> Float[Array, " n"]:
    """Of those rows, that move what is at the median depth by 1 px at the window's end."""
    powers = jnp.stack([math.factorial(m) / (f * half**m) for m in range(1, k + 1)])
    both = jnp.concatenate([powers, powers / jnp.exp(jnp.median(path.log_rho))])
    return jnp.repeat(both, 3)


def later_rows(k: int) -> Array:
    """Which of those rows tell how the twist changes."""
    return jnp.repeat(jnp.tile(jnp.arange(k) > 0, 2), 3)


def pull_of_rows(
    now: Array, unit: Array, prior: Prior, half: Array, k: int, more: Array | float = 0.0
) -> Float[Array, ""]:
    """What the priors on a path's rows cost, in such units: on Omega, its changes and the gyro.

    `more` is added to twice the cost. Omega(tau) = O0 + O1 tau + O2 tau^2 / 2 + ...
    """
    times = ((jnp.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * half
    slopes = jnp.stack([times**m / math.factorial(m) for m in range(k)], 1).astype(now.dtype)
    O = (now[: 3 * k] * unit[: 3 * k]).reshape(k, 3)  # noqa: E741
    cost = prior.omega * (O[0] ** 2).sum() + more
    cost += prior.gyro_weight / SEGMENTS * ((slopes @ O - prior.gyro) ** 2).sum()
    return (cost + (jnp.where(later_rows(k), prior.change, 0) * now**2).sum()) / 2


def gauge_of_rows(path: Path, unit: Array, size: int) -> Float[Array, " n"]:
    """The direction of (size,) unknowns that changes |C1|, which is 1."""
    k = len(unit) // 6
    fixed = slice(3 * k, 3 * k + 3)
    return jnp.zeros(size, unit.dtype).at[fixed].set(path.D[0] * unit[fixed])


def bonds_between(
    log_rho: Array, pairs: tuple[Array, Array], weight: Array, edge: float
) -> tuple[Array, Array]:
    """Bonds of neighbours' log depths: their differences, and the weights of their squares.

    A difference well beyond `edge` is an edge, and pulls no more.
    """
    apart = log_rho[pairs[0]] - log_rho[pairs[1]]
    return apart, weight / (1 + (apart / edge) ** 2)
