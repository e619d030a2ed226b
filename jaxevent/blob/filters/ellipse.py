"""The ellipse of a blob: its covariance and axes, and the noise of second moments."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.params import TrackerParams


def spread(theta: Array, size: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """L L^T = R diag(size^2) R^T."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    a, b = size[0] ** 2, size[1] ** 2
    xy = (a - b) * c * s
    return jnp.stack([a * c**2 + b * s**2, xy, xy, a * s**2 + b * c**2]).reshape(2, 2)


def axes(spread: Float[Array, "2 2"]) -> tuple[Array, Array, Array]:
    """theta, and the variances and standard deviations along the axes, the larger first."""
    half, xy = (spread[0, 0] - spread[1, 1]) / 2, spread[0, 1]
    middle = (spread[0, 0] + spread[1, 1]) / 2
    apart = half**2 + xy**2
    long = apart > 1e-12 * middle**2
    radius = jnp.where(long, jnp.sqrt(jnp.where(long, apart, 1)), 0)
    theta = jnp.where(long, jnp.arctan2(jnp.where(long, xy, 0), jnp.where(long, half, 1)) / 2, 0)
    variances = jnp.maximum(jnp.stack([middle + radius, middle - radius]), 1e-12)
    return theta, variances, jnp.sqrt(variances)


def truncation(params: TrackerParams) -> tuple[Array | float, Array | float]:
    """E[u1^2] and E[u1^2 u2^2] of standard normal u that an elliptical gate lets pass.

    r^2 / 2 = (u1^2 + u2^2) / 2 is exponential, cut at g = gate^2 / 2; E[u1^4] is three times the
    second.
    """
    if params.gate_shape != "ellipse":
        return 1.0, 1.0
    g = jnp.maximum(params.gate**2 / 2, 0.01)
    passed = -jnp.expm1(-g)
    first = 1 - g * jnp.exp(-g) / passed
    return first, (1 - jnp.exp(-g) * (g**2 / 2 + g + 1)) / passed


def geometric_step(step: Array, slope: Array) -> Array:
    """log(1 + slope step) / slope: a step of log lambda that is exact however large it is.

    Without P_p and a gate, log lambda of variance P is lambda^2 of an inverse gamma distribution of
    the shape 1 / (4 P). Its update by u^2 multiplies lambda^2 by 1 + 2 step, `step` being that of
    the Kalman filter, and has the same variance. From a size that is twofold too large the Kalman
    filter would know itself sure long before it is there, as u^2 / V - 1 is never below -1.
    """
    return jnp.log1p(jnp.maximum(slope * step, -0.999)) / jnp.maximum(slope, 1e-15)
