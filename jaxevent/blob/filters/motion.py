"""Parts that filters share: linear motion, turning, and the ellipse of the events.

The numerical matrices are 2x2. Products of them are written elementwise, so that XLA compiles a
whole scan to one kernel.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.filter import EventBatch, PredictedMeasurement
from jaxevent.blob.params import TrackerParams


def _product(a: Float[Array, "2 2"], b: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    return a[:, :1] * b[:1] + a[:, 1:] * b[1:]


def _inverse(a: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    scale = a[0, 0] + a[1, 1]  # the determinant of 1e20 px^2 would overflow
    a = a / scale
    adjugate = jnp.stack([a[1, 1], -a[0, 1], -a[1, 0], a[0, 0]]).reshape(2, 2)
    return adjugate / ((a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * scale)


def _weighted_sum(factors: list, terms: list[Array]) -> Array:
    """Sum arrays by factors.

    Args:
        factors: Factors.
        terms: Arrays of one shape, one for each factor.

    Returns:
        The sum.
    """
    total = factors[0] * terms[0]
    for factor, term in zip(factors[1:], terms[1:], strict=True):
        total = total + factor * term
    return total


class LinearMotion(eqx.Module):
    """Kalman filter of position, velocity and, if estimated, polarity offset.

    `P` holds the blocks on and above the diagonal, column by column: pp, pv, vv[, pd, vd, dd].
    """

    x: tuple[Float[Array, " 2"], ...]
    P: tuple[Float[Array, "2 2"], ...]

    @classmethod
    def init(cls, params: TrackerParams, position: Array) -> "LinearMotion":
        """Return the state at rest at a position.

        Args:
            params: Parameters of the tracker.
            position: (2,) px.

        Returns:
            The state.
        """
        variances = [params.P0_p, params.P0_v] + [params.P0_d] * params.polarity_offset
        none = jnp.zeros_like(position)
        eye = jnp.eye(2, dtype=position.dtype)
        P = [(i == j) * v * eye for j, v in enumerate(variances) for i in range(j + 1)]
        return cls((position, *(none for _ in variances[1:])), tuple(P))

    def block(self, i: int, j: int) -> Float[Array, "2 2"]:
        """Return the covariance of two components: 0 position, 1 velocity, 2 offset.

        Args:
            i: One component.
            j: The other one.

        Returns:
            The covariance, in products of px and px/s.
        """
        return self.P[j * (j + 1) // 2 + i] if i <= j else self.P[i * (i + 1) // 2 + j].T

    def predict(self, params: TrackerParams, dt: Array) -> "LinearMotion":
        """Predict the state without events, exactly over any gap.

        Args:
            params: Parameters of the tracker.
            dt: () time to predict ahead, s.

        Returns:
            The state then.
        """
        p, v, *offset = self.x
        pp, pv, vv, *rest = self.P
        eye = jnp.eye(2, dtype=p.dtype)
        pp = pp + dt * (pv + pv.T) + dt**2 * vv + (params.Q_p * dt + params.Q_v * dt**3 / 3) * eye
        pv = pv + dt * vv + params.Q_v * dt**2 / 2 * eye
        vv = vv + params.Q_v * dt * eye
        if rest:
            pd, vd, dd = rest
            rest = [pd + dt * vd, vd, dd + params.Q_d * dt * eye]
        return LinearMotion((p + dt * v, v, *offset), (pp, pv, vv, *rest))

    def zero_velocity(self, params: TrackerParams, known: bool) -> "LinearMotion":
        """Set the velocity to 0, either known or as uncertain as that of a new track."""
        p, v, *offset = self.x
        pp, pv, vv, *rest = self.P
        if rest:
            rest[1] = 0 * rest[1]
        variance = 0 if known else params.P0_v
        vv = variance * jnp.eye(2, dtype=vv.dtype)
        return LinearMotion((p, 0 * v, *offset), (pp, 0 * pv, vv, *rest))

    def residuals(
        self, batch: EventBatch, weight: Array
    ) -> tuple[Array, Array, list[Array | float]]:
        """Compute the residuals of events, their weighted mean, and the model of that mean.

        Args:
            batch: The M events.
            weight: (M,) weights of the events, 0 to 1.

        Returns:
            Residuals (M, 2) and their mean (2,), px, and the factors of position, velocity and
            offset in the mean.
        """
        total = weight.sum()
        share = weight / jnp.where(total > 0, total, 1)
        age = (share * batch.age).sum()
        e = batch.xi - self.x[0] + self.x[1] * batch.age[:, None]
        factors = [1.0, -age]
        if len(self.x) == 3:
            e = e - jnp.sign(batch.polarity)[:, None] * self.x[2]
            factors.append((share * jnp.sign(batch.polarity)).sum())
        e = jnp.where(weight[:, None] > 0, e, 0)
        return e, (share[:, None] * e).sum(0), factors

    def covariances(self, factors: list) -> tuple[list[Array], Array]:
        """Return the covariances of z = sum factors x with each component, and its own."""
        k = range(len(self.x))
        B = [_weighted_sum(factors, [self.block(i, j) for i in k]) for j in k]
        return B, _weighted_sum(factors, B)

    def update(self, mean: Array, factors: list, R: Array, m: Array) -> "LinearMotion":
        """Update by the mean residual of events.

        The rows of the position come from those of z, whose covariance afterwards is R S^-1 times
        that before: a difference would lose R of 100 px^2 behind P of 1e14 px^2 after a pause.
        Args:
            mean: (2,) mean residual, px.
            factors: Factors of position, velocity and offset in the mean, of `residuals`.
            R: (2, 2) covariance of one event, px^2.
            m: () number of events, by weight.

        Returns:
            The state after them.
        """
        B, own = self.covariances(factors)
        inverse = _inverse(own * m + R)
        left = _product(R, inverse)
        gain = [_product(inverse, b) * m for b in B]  # transposed
        k = range(1, len(self.x))
        x = [old + mean[0] * g[0] + mean[1] * g[1] for old, g in zip(self.x, gain, strict=True)]
        new = {(i, j): self.block(i, j) - _product(B[i].T, gain[j]) for i in k for j in k}
        row = {j: _product(left, B[j]) for j in k}
        for j in k:
            new[0, j] = row[j] - _weighted_sum(factors[1:], [new[i, j] for i in k])
        pp = _product(left, own) - _weighted_sum(factors[1:], [row[i].T + new[0, i] for i in k])
        new[0, 0] = (pp + pp.T) / 2
        for j in k:
            new[j, j] = (new[j, j] + new[j, j].T) / 2
        blocks = tuple(new[i, j] for j in range(len(x)) for i in range(j + 1))
        return LinearMotion(tuple(x), blocks)


def predicted_ellipse(motion: LinearMotion, theta: Array, size: Array) -> PredictedMeasurement:
    """Predict the events of an ellipse.

    Args:
        motion: Motion of its centre.
        theta: () orientation, rad.
        size: (2,) sizes along its axes, px.

    Returns:
        The prediction.
    """
    spread = ellipse_covariance(theta, size)
    return PredictedMeasurement(motion.x[0], motion.x[1], spread, motion.P[0], size)


def join_blocks(
    motion: LinearMotion, size: Array, P_size: Array, turn: Array, P_turn: Array
) -> tuple[Float[Array, " 8"], Float[Array, "8 8"]]:
    """Join independent motion, sizes and turn (theta, q) to one mean and covariance.

    Args:
        motion: Position and velocity.
        size: (2,) px.
        P_size: (2,) variances, px^2.
        turn: (2,) rad and rad/s.
        P_turn: (4,) covariance of the turn, row by row.
    """
    mean = jnp.concatenate([motion.x[0], motion.x[1], size, turn])
    parts = [
        jnp.block([[motion.P[0], motion.P[1]], [motion.P[1].T, motion.P[2]]]),
        jnp.diag(P_size),
        P_turn.reshape(2, 2),
    ]
    return mean, jax.scipy.linalg.block_diag(*parts)


def turn_transition(params: TrackerParams, dt: Array) -> tuple[Array, ...]:
    """Return the transition of (theta, q) without events: dq = -g q dt + dW, g = 1 / tau_q.

    With a = g dt the variance of theta is that of W times dt^3 (a - 2 (1 - exp(-a)) +
    (1 - exp(-2 a)) / 2) / a^3, which cancels for small a; there its series serves.
    Args:
        params: Parameters of the tracker.
        dt: () time, s.

    Returns:
        Factors of q in theta and in q, and the process noise: variance of theta, covariance,
        variance of q.
    """
    tau = params.tau_q
    a = jnp.where(tau > 0, dt / jnp.where(tau > 0, tau, 1), 0)
    series, term = 1 / 3 + 0 * a, jnp.ones_like(a)
    near = jnp.minimum(a, 0.5)
    for k in range(3, 16):
        term = term * -near
        series = series + term * ((2**k - 2) / (math.factorial(k) * (k + 1)))
    far = jnp.maximum(a, 0.5)
    closed = (far + 2 * jnp.expm1(-far) - jnp.expm1(-2 * far) / 2) / far**3
    cubic = jnp.where(a < 0.5, series, closed)
    safe = jnp.where(a > 0, a, 1)
    once = jnp.where(a > 0, -jnp.expm1(-safe) / safe, 1.0)
    twice = jnp.where(a > 0, -jnp.expm1(-2 * safe) / (2 * safe), 1.0)
    Q = params.Q_q
    return (
        dt * once,
        jnp.exp(-a),
        params.Q_theta * dt + Q * dt**3 * cubic,
        Q * (dt * once) ** 2 / 2,
        Q * dt * twice,
    )


def transition(params: TrackerParams, dt: Array, static: Array) -> Float[Array, "8 8"]:
    """Return the transition matrix of the common state without events.

    Args:
        params: Parameters of the tracker.
        dt: () time, s.
        static: () whether the target stands still: velocity and turn rate are 0.

    Returns:
        The matrix.
    """
    to_theta, to_q, *_ = turn_transition(params, dt)
    pairs = jnp.array([0, 1, 6, 7]), jnp.array([2, 3, 7, 7])
    F = jnp.eye(8, dtype=dt.dtype).at[pairs].set(jnp.stack([dt, dt, to_theta, to_q]))
    moving = jnp.zeros(8, bool).at[jnp.array([2, 3, 7])].set(True)
    keep = jnp.where(static & moving, 0.0, 1.0).astype(dt.dtype)
    return keep[:, None] * F * keep


def ellipse_covariance(theta: Array, size: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return the covariance of an ellipse's events, L L^T = R diag(size^2) R^T.

    Args:
        theta: () orientation, rad.
        size: Sizes along its axes, px.

    Returns:
        The covariance, px^2.
    """
    c, s = jnp.cos(theta), jnp.sin(theta)
    a, b = size[0] ** 2, size[1] ** 2
    xy = (a - b) * c * s
    return jnp.stack([a * c**2 + b * s**2, xy, xy, a * s**2 + b * c**2]).reshape(2, 2)


def ellipse_axes(covariance: Float[Array, "2 2"]) -> tuple[Array, Array]:
    """Return the orientation (rad) and the standard deviations along the axes, larger first."""
    half, xy = (covariance[0, 0] - covariance[1, 1]) / 2, covariance[0, 1]
    middle = (covariance[0, 0] + covariance[1, 1]) / 2
    apart = half**2 + xy**2
    long = apart > 1e-12 * middle**2
    radius = jnp.where(long, jnp.sqrt(jnp.where(long, apart, 1)), 0)
    theta = jnp.where(long, jnp.arctan2(jnp.where(long, xy, 0), jnp.where(long, half, 1)) / 2, 0)
    variances = jnp.maximum(jnp.stack([middle + radius, middle - radius]), 1e-12)
    return theta, jnp.sqrt(variances)


def gated_moments(params: TrackerParams) -> tuple[Array | float, Array | float]:
    """Return E[u1^2] and E[u1^2 u2^2] of standard normal u that an elliptical gate lets pass.

    r^2 / 2 = (u1^2 + u2^2) / 2 is exponential, cut at g = gate^2 / 2; E[u1^4] is three times the
    second.
    """
    if params.gate_shape != "ellipse":
        return 1.0, 1.0
    g = jnp.maximum(params.gate**2 / 2, 0.01)
    passed = -jnp.expm1(-g)
    first = 1 - g * jnp.exp(-g) / passed
    return first, (1 - jnp.exp(-g) * (g**2 / 2 + g + 1)) / passed


def log_size_step(step: Array, derivative: Array) -> Array:
    """Return a step of log lambda of any length, log(1 + derivative step) / derivative.

    Without P_p and a gate, log lambda of variance P is lambda^2 of an inverse gamma distribution of
    the shape 1 / (4 P). Its update by u^2 multiplies lambda^2 by 1 + 2 step, `step` being that of
    the Kalman filter, and has the same variance. From a size twice too large the Kalman filter's
    variance would shrink long before the size is right, as u^2 / V - 1 is never below -1.

    Args:
        step: Step of the Kalman filter, of log lambda.
        derivative: Derivative of the measured u^2 / V by log lambda.

    Returns:
        The step.
    """
    return jnp.log1p(jnp.maximum(derivative * step, -0.999)) / jnp.maximum(derivative, 1e-15)
