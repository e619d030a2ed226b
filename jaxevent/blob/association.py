"""Whose an event is: inside which gates, how likely to each target, and how it is shared out.

Pure functions of one target and one event, but for `share`, which is of one event and all targets.
The defaults of `Filter`. Gate: Wang, Molloy, van Goor, Mahony, "Asynchronous Blob Tracker for Event
Cameras". Soft association, JPDA: Bar-Shalom, Fortmann, "Tracking and Data Association".
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxevent.blob.params import TrackerParams


class Expected(eqx.Module):
    """What a filter expects of the next events, and how large it believes the blob to be."""

    p: Float[Array, " 2"]  # px
    v: Float[Array, " 2"]  # px/s
    spread: Float[Array, "2 2"]  # px^2, covariance of events about the true centre
    P_p: Float[Array, "2 2"]  # px^2, covariance of p
    size: Float[Array, " 2"]  # px, lambda1 and lambda2


def largest_eigenvalue(a: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Of a symmetric matrix."""
    half = (a[0, 0] - a[1, 1]) / 2
    mean = (a[0, 0] + a[1, 1]) / 2
    return mean + jnp.sqrt(half**2 + a[0, 1] ** 2)


def _determinant(a: Float[Array, "2 2"]) -> Float[Array, ""]:
    return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]


def _squared(e: Float[Array, " 2"], a: Float[Array, "2 2"]) -> Float[Array, ""]:
    """e^T a^-1 e."""
    x, y = e[0], e[1]
    top = a[1, 1] * x**2 - 2 * a[0, 1] * x * y + a[0, 0] * y**2
    return top / _determinant(a)


def gate_radius(
    params: TrackerParams, radius: Float[Array, ""], size: Float[Array, ""], dt: Float[Array, ""]
) -> Float[Array, ""]:
    """The gate's radius (px) dt later: it follows the larger size at the rate `gate_decay`."""
    a = jnp.exp(-params.gate_decay * dt)
    radius = a * radius + (1 - a) * params.gate * size
    return jnp.clip(radius, params.gate_min, params.gate_max)


def gate(
    params: TrackerParams,
    expected: Expected,
    radius: Float[Array, ""],
    e: Float[Array, " 2"],
) -> Bool[Array, ""]:
    """Whether the residual `e` (px) is inside the gate of `radius`, widened by the position's P.

    circle: |e|^2 <= radius^2 + g^2 (largest eigenvalue of P_p); ellipse: the same along every axis
    of the blob, e^T ((radius/lambda1)^2 L L^T + g^2 P_p)^-1 e <= 1; g is `gate_position`.
    """
    g2 = params.gate_position**2
    if params.gate_shape == "circle":
        return (e**2).sum() <= radius**2 + g2 * largest_eigenvalue(expected.P_p)
    scale = radius / expected.size.max()
    return _squared(e, scale**2 * expected.spread + g2 * expected.P_p) <= 1


def log_likelihood(
    params: TrackerParams, expected: Expected, e: Float[Array, " 2"]
) -> Float[Array, ""]:
    """ln(2 pi p) of an event with the residual `e` (px), p = N(e; 0, L L^T + P_p) in 1/px^2."""
    S = expected.spread + expected.P_p
    return -0.5 * (_squared(e, S) + jnp.log(_determinant(S)))


def share(
    params: TrackerParams, inside: Bool[Array, " K"], density: Float[Array, " K"]
) -> Float[Array, " K"]:
    """How much of an event is each target's: w_i ~ p_i among the gates that hold it.

    `density` is the log likelihood by each target.
    """
    density = jnp.where(inside, density, -jnp.inf)
    if params.association == "nearest":
        first = jnp.arange(len(density)) == jnp.argmax(density)
        return (inside & first).astype(density.dtype)
    clutter = params.raw["clutter"] + math.log(2 * math.pi)  # the logarithm: -inf for none
    cluttered = clutter > -jnp.inf
    if len(density) == 1:  # the same: without clutter certainly the one target's
        over = jnp.where(inside, density, 0) - jnp.where(cluttered, clutter, 0)
        return jnp.where(inside, jnp.where(cluttered, jax.nn.sigmoid(over), 1), 0)
    top = density.max()
    top = lax.stop_gradient(jnp.where(cluttered, jnp.maximum(top, clutter), top))
    top = jnp.where(jnp.isfinite(top), top, 0)
    parts = jnp.where(inside, jnp.exp(jnp.where(inside, density, top) - top), 0)
    total = parts.sum() + jnp.where(cluttered, jnp.exp(clutter - top), 0)
    return parts / jnp.where(total > 0, total, 1)
