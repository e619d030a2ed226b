"""Distance from tracks: inverse time to contact and range, with variances.

Inverse time to contact (1/s) is positive while approaching; unlike its inverse it is defined at
rest. A mean is (..., 8) in the order (px, py, vx, vy, lambda1, lambda2, theta, q), in px, s and
rad, with its covariance (..., 8, 8). Variances are propagated to first order. All functions are
pure and differentiable.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Num

from jaxevent.deprecated import renamed_names
from jaxevent.precision import full_precision

# lambda1 of the events of a disc over the disc's diameter: of an even rim (a disc that grows or
# flickers), of the leading and trailing edges of one that moves, of an evenly filled one.
SIZE_FACTORS = {"ring": 1 / math.sqrt(8), "disc": 1 / math.sqrt(6), "uniform": 1 / 4}

Number = Num[Array, ""] | float | int


@full_precision
def inverse_ttc(
    mean_a: Float[Array, "*n 8"],
    covariance_a: Float[Array, "*n 8 8"],
    mean_b: Float[Array, "*n 8"],
    covariance_b: Float[Array, "*n 8 8"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Compute 1 / TTC from two blobs at equal depth, in either order.

    (v_a - v_b) . (p_a - p_b) / |p_a - p_b|^2, which holds while the line between them keeps its
    direction in space. The errors of the two tracks are taken as independent. Where the positions
    coincide the value is 0 and the variance infinite. (Event blob tracking, eq. 27.)

    Args:
        mean_a: States of one blob (..., 8).
        covariance_a: Their covariances (..., 8, 8).
        mean_b: States of the other blob (..., 8).
        covariance_b: Their covariances (..., 8, 8).

    Returns:
        Inverse time to contact (...), 1/s, and its variance, 1/s^2.
    """
    joint = (covariance_a + covariance_b)[..., :4, :4]
    difference = (mean_a - mean_b)[..., :4]
    d, w = difference[..., :2], difference[..., 2:]
    squared = jnp.sum(d * d, -1)
    apart = squared > 0
    squared = jnp.where(apart, squared, 1)
    value = jnp.sum(d * w, -1) / squared
    # d value / d d = (w - 2 value d) / |d|^2 and d value / d w = d / |d|^2.
    gradient = jnp.concatenate([w - 2 * value[..., None] * d, d], -1) / squared[..., None]
    variance = jnp.einsum("...i,...ij,...j->...", gradient, joint, gradient)
    return jnp.where(apart, value, 0), jnp.where(apart, variance, jnp.inf)


@full_precision
def log_size(
    mean: Float[Array, "*n 8"], covariance: Float[Array, "*n 8 8"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Compute log sqrt(lambda1 lambda2), which does not depend on the order of the axes.

    Args:
        mean: States (..., 8).
        covariance: Their covariances (..., 8, 8).

    Returns:
        Logarithm of the size in px (...), and its variance.
    """
    gradient = 0.5 / mean[..., 4:6]
    variance = jnp.einsum("...i,...ij,...j->...", gradient, covariance[..., 4:6, 4:6], gradient)
    return jnp.sum(jnp.log(mean[..., 4:6]), -1) / 2, variance


def inverse_ttc_from_size(
    times: Float[Array | np.ndarray, " times"],
    mean: Float[Array | np.ndarray, "times 8"],
    covariance: Float[Array | np.ndarray, "times 8 8"],
    valid: Bool[Array | np.ndarray, " times"] | None = None,
    *,
    Q: Number = 0.01,
    Q_lambda: Number | None = None,
    smooth: bool = True,
    smoothed: bool = False,
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Compute the inverse time to contact from the sizes of one blob.

    The scale w = 1 / sqrt(lambda1 lambda2) is proportional to depth, so that at constant speed it
    is a line in time and 1 / TTC = -w' / w: a Kalman filter of (w, w'), exactly linear, whose
    measurements are the track's sizes, which lag where the track is filtered. Before the second
    measurement the variance is that of the prior, about 100 1/s^2.

    Args:
        times: Sorted times (times,), s.
        mean: States (times, 8).
        covariance: Their covariances (times, 8, 8).
        valid: Rows that are measurements (times,); the others, of any value, are predicted. None:
            all.
        Q: Spectral density of the speed's changes relative to the depth, 1/s^3. 0 is constant
            speed: the least squares line.
        Q_lambda: The filter's own `Q_lambda`, px^2/s, see `Tracks.track_params`. Errors of a track
            at close times are correlated, and sizes of a filtered one lag; given it, they weigh as
            much as the events behind them, and their lag is undone. None: independent errors
            without a lag.
        smooth: Whether all times are used for each (Rauch-Tung-Striebel), or those up to it.
        smoothed: Whether the track is smoothed (`Tracks.smooth`): sizes do not lag, and their
            errors last twice as long as a filter's.

    Returns:
        Inverse time to contact (times,), 1/s, and its variance, 1/s^2.
    """
    # Differences, while times are double: seconds since 1970 in single precision are 128 s apart.
    valid = jnp.ones(times.shape, bool) if valid is None else valid
    return _inverse_ttc_from_size(
        times - times[:1], mean, covariance, valid, Q, Q_lambda, smooth=smooth, smoothed=smoothed
    )


@functools.partial(jax.jit, static_argnames=("smooth", "smoothed"))
@full_precision
def _inverse_ttc_from_size(
    times: Array, mean: Array, covariance: Array, valid: Array, Q: Number,
    Q_lambda: Number | None, *, smooth: bool, smoothed: bool,
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:  # fmt: skip
    """Compute `inverse_ttc_from_size` of times from 0 on.

    Args:
        times: (times,) s, from 0 on.
        mean: (times, 8) states of a track.
        covariance: (times, 8, 8) their covariances.
        valid: (times,) whether the track is seen.
        Q: As of `inverse_ttc_from_size`, 1/s^3.
        Q_lambda: As of `inverse_ttc_from_size`, px^2/s.
        smooth: Whether all times are used for each, or those up to it.
        smoothed: Whether the track is smoothed.

    Returns:
        Inverse time to contact (times,), 1/s, and its variance, 1/s^2.
    """
    mean = jnp.where(valid[:, None], mean, 1.0)
    covariance = jnp.where(valid[:, None, None], covariance, jnp.eye(8, dtype=mean.dtype))
    logarithm, relative = log_size(mean, covariance)
    # Relative to a common size, for single precision.
    reference = jnp.sum(jnp.where(valid, logarithm, 0)) / jnp.maximum(jnp.sum(valid), 1)
    w = jnp.exp(reference - logarithm)
    dt = jnp.diff(times, prepend=times[:1])
    R = w**2 * _relative_noise(times, relative, covariance, valid, Q_lambda, smoothed)
    lag = _lag(times, covariance, valid, None if smoothed else Q_lambda)

    def product(a, b):
        return jnp.sum(a[:, :, None] * b[None], 1)  # faster to compile and run than a dot

    def forward(state, row):
        m, P = state
        dt, w, R, lag, valid = row
        F = jnp.array([[1.0, dt], [0.0, 1.0]])
        noise = Q * m[0] ** 2 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        predicted = jnp.sum(F * m, 1), product(product(F, P), F.T) + noise
        m, P = predicted
        H = jnp.stack([jnp.ones_like(lag), -lag])  # the size of then
        toward = jnp.sum(P * H, 1)
        gain = jnp.where(valid, toward / (jnp.sum(H * toward) + R), 0)
        m = m + gain * (w - jnp.sum(H * m))
        keep = jnp.eye(2, dtype=w.dtype) - gain[:, None] * H
        fresh = gain[:, None] * gain * jnp.where(valid, R, 0)
        P = product(product(keep, P), keep.T) + fresh
        return (m, P), ((m, P), predicted, F)

    def backward(later, row):
        (m, P), (m_predicted, P_predicted), F = row
        (a, b), (_, d) = P_predicted
        adjugate = jnp.array([[d, -b], [-b, a]])
        determinant = jnp.maximum(a * d - b * b, 8 * jnp.finfo(a.dtype).eps * a * d)
        gain = product(product(P, F.T), adjugate) / determinant
        m = m + jnp.sum(gain * (later[0] - m_predicted), 1)
        P = P + product(product(gain, later[1] - P_predicted), gain.T)
        return (m, P), (m, P)

    first = w[jnp.argmax(valid)]
    prior = jnp.array([1.0, 0.0]) * first, 100 * first**2 * jnp.eye(2, dtype=w.dtype)
    end, (state, predicted, F) = lax.scan(forward, prior, (dt, w, R, lag, valid))
    if smooth:
        # A last step of dt = 0 leads from the end to itself.
        F = jnp.concatenate([F[1:], F[:1]])
        predicted = jax.tree.map(lambda x, e: jnp.concatenate([x[1:], e[None]]), predicted, end)
        _, state = lax.scan(backward, end, (state, predicted, F), reverse=True)
    m, P = state
    value = -m[:, 1] / m[:, 0]
    gradient = -jnp.stack([value, jnp.ones_like(value)], -1) / m[:, :1]
    return value, jnp.einsum("ti,tij,tj->t", gradient, P, gradient)


def _relative_noise(
    times: Array, relative: Array, covariance: Array, valid: Array, Q_lambda: Number | None,
    smoothed: bool,
) -> Float[Array, " times"]:  # fmt: skip
    """Return the variances of log sizes that make a filter's errors count like independent ones.

    Args:
        times: (times,) s.
        relative: (times,) variances of log sizes by the states' covariance.
        covariance: (times, 8, 8) of the states.
        valid: (times,) whether the track is alive.
        Q_lambda: Process noise of sizes, px^2/s; None: errors are independent already.
        smoothed: Whether states are smoothed.

    Returns:
        (times,) variances.
    """
    # Sizes known exactly would make the covariances singular.
    R = jnp.maximum(relative, 1e-10)
    if Q_lambda is None:
        return R
    # A filter of a walk of density Q that has settled at the variance P forgets over tau = P / Q.
    # Of P one half is noise that it passes on, the other its lag behind a walk, which steady growth
    # is not. The mean of many samples whose errors have the correlation r^k, r = exp(-dt / tau),
    # has the variance of independent ones times (1 + r) / (1 - r) = coth(dt / (2 tau)). So samples
    # at dt << tau make P^2 / Q, the density of events' noise. Smoothed, P is half of the filter's,
    # half of that is noise, of the correlation (1 + k dt / tau) r^k, and the factor at dt << tau
    # is 4 tau / dt, so that the density is the same.
    P_lambda = _size_variance(covariance) * (4 if smoothed else 1)
    last = jnp.max(jnp.where(valid, times, times[0]))
    span = last - jnp.min(jnp.where(valid, times, times[-1]))
    every = jnp.maximum(span, 0) / jnp.maximum(jnp.sum(valid) - 1, 1)
    return R / 2 / jnp.tanh(jnp.maximum(every * Q_lambda / (2 * P_lambda), 1e-6))


def _size_variance(covariance: Array) -> Float[Array, " times"]:
    """Return the mean variance of both sizes, px^2, above 0."""
    return jnp.maximum((covariance[:, 4, 4] + covariance[:, 5, 5]) / 2, 1e-10)


def _lag(
    times: Array, covariance: Array, valid: Array, Q_lambda: Number | None
) -> Float[Array, " times"]:
    """Return the time by which the sizes of a filter lag.

    A settled filter forgets over P / Q. One that has not settled holds the mean since its start,
    which lags by half of the time since then.

    Args:
        times: (times,) s.
        covariance: (times, 8, 8) of the states.
        valid: (times,) whether the track is alive.
        Q_lambda: Process noise of sizes, px^2/s; None: no lag.

    Returns:
        (times,) s.
    """
    if Q_lambda is None:
        return jnp.zeros_like(times)
    age = times - jnp.min(jnp.where(valid, times, times[-1]))
    return jnp.minimum(_size_variance(covariance) / Q_lambda, jnp.maximum(age, 0) / 2)


def size_range(
    mean: Float[Array, "*n 8"],
    covariance: Float[Array, "*n 8 8"],
    extent: Number,
    focal: Number,
    size_factor: Number = SIZE_FACTORS["ring"],
    size_factor_variance: Number = 0.0,
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Compute the range of a target of known extent: size_factor extent focal / lambda1.

    (Event blob tracking, eq. 28, whose lambda is not a diameter.)

    Args:
        mean: States (..., 8).
        covariance: Their covariances (..., 8, 8).
        extent: Diameter of the target, m.
        focal: Focal length, px.
        size_factor: lambda1 over the target's diameter in the image: one of `SIZE_FACTORS`, or that
            of `calibrate_size_factor`.
        size_factor_variance: Its variance.

    Returns:
        Range (...), m, and its variance, m^2.
    """
    first = mean[..., 4] >= mean[..., 5]
    size = jnp.where(first, mean[..., 4], mean[..., 5])
    variance = jnp.where(first, covariance[..., 4, 4], covariance[..., 5, 5])
    value = size_factor * extent * focal / size
    relative = variance / size**2 + size_factor_variance / jnp.square(size_factor)
    return value, value**2 * relative


def calibrate_size_factor(
    size: Float[Array, " n"],
    known_range: Float[Array, " n"],
    extent: Number,
    focal: Number,
    variance: Float[Array, " n"] | None = None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Calibrate the size factor by least squares in size = factor extent focal / range.

    The variance is scaled by the residuals, so that weights need only be relative.

    Args:
        size: Sizes lambda1 (n,), px, n >= 2.
        known_range: Ranges (n,), m.
        extent: Diameter of the target, m.
        focal: Focal length, px.
        variance: Variances of the sizes (n,), px^2; None: equal ones.

    Returns:
        The size factor and its variance.
    """
    diameter = extent * focal / known_range
    weight = jnp.ones_like(size) if variance is None else 1 / variance
    information = jnp.sum(weight * diameter**2)
    factor = jnp.sum(weight * diameter * size) / information
    residual = jnp.sum(weight * (size - factor * diameter) ** 2)
    return factor, residual / (size.shape[0] - 1) / information


__getattr__ = renamed_names(__name__)
