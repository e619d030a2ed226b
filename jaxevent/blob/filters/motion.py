"""Motion that filters share: a linear filter of the position, and the decay of the turn rate."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.association import Expected
from jaxevent.blob.filters.ellipse import spread
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.steps import Batch


def _product(a: Float[Array, "2 2"], b: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    # Elementwise, so that a whole scan compiles to one kernel: 0.03 us per event for the motion
    # block against 2 us with calls of a matrix product.
    return a[:, :1] * b[:1] + a[:, 1:] * b[1:]


def _inverse(a: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    scale = a[0, 0] + a[1, 1]  # the determinant of 1e20 px^2 would overflow
    a = a / scale
    adjugate = jnp.stack([a[1, 1], -a[0, 1], -a[1, 0], a[0, 0]]).reshape(2, 2)
    return adjugate / ((a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * scale)


def _weighted(factors: list, terms: list[Array]) -> Array:
    total = factors[0] * terms[0]
    for factor, term in zip(factors[1:], terms[1:], strict=True):
        total = total + factor * term
    return total


class Motion(eqx.Module):
    """Position, velocity and, if estimated, polarity offset: a linear filter.

    `P` holds the blocks on and above the diagonal, column by column: pp, pv, vv[, pd, vd, dd].
    """

    x: tuple[Float[Array, " 2"], ...]
    P: tuple[Float[Array, "2 2"], ...]

    @classmethod
    def start(cls, params: TrackerParams, position: Array) -> "Motion":
        variances = [params.P0_p, params.P0_v] + [params.P0_d] * params.polarity_offset
        none = jnp.zeros_like(position)
        eye = jnp.eye(2, dtype=position.dtype)
        P = [(i == j) * v * eye for j, v in enumerate(variances) for i in range(j + 1)]
        return cls((position, *(none for _ in variances[1:])), tuple(P))

    def block(self, i: int, j: int) -> Float[Array, "2 2"]:
        """Covariance of components i and j (0 position, 1 velocity, 2 offset)."""
        return self.P[j * (j + 1) // 2 + i] if i <= j else self.P[i * (i + 1) // 2 + j].T

    def predict(self, params: TrackerParams, dt: Array) -> "Motion":
        p, v, *offset = self.x
        pp, pv, vv, *rest = self.P
        eye = jnp.eye(2, dtype=p.dtype)
        pp = pp + dt * (pv + pv.T) + dt**2 * vv + (params.Q_p * dt + params.Q_v * dt**3 / 3) * eye
        pv = pv + dt * vv + params.Q_v * dt**2 / 2 * eye
        vv = vv + params.Q_v * dt * eye
        if rest:
            pd, vd, dd = rest
            rest = [pd + dt * vd, vd, dd + params.Q_d * dt * eye]
        return Motion((p + dt * v, v, *offset), (pp, pv, vv, *rest))

    def halt(self, params: TrackerParams, known: bool) -> "Motion":
        """The same at rest: the velocity is 0, and known or as uncertain as at the start."""
        p, v, *offset = self.x
        pp, pv, vv, *rest = self.P
        if rest:
            rest[1] = 0 * rest[1]
        variance = 0 if known else params.P0_v
        vv = variance * jnp.eye(2, dtype=vv.dtype)
        return Motion((p, 0 * v, *offset), (pp, 0 * pv, vv, *rest))

    def residuals(self, batch: Batch, weight: Array) -> tuple[Array, Array, list[Array | float]]:
        """Of each event (M, 2), their weighted mean, and the factors of x in what it measures."""
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
        """Of z = sum factors x: with each component, and with itself."""
        k = range(len(self.x))
        B = [_weighted(factors, [self.block(i, j) for i in k]) for j in k]
        return B, _weighted(factors, B)

    def update(self, mean: Array, factors: list, R: Array, m: Array) -> "Motion":
        """Of a mean residual of m events, each with the covariance R.

        The rows of the position come from those of z, whose covariance afterwards is R S^-1 times
        that before: a difference would lose R of 100 px^2 behind P of 1e14 px^2 after a pause.
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
            new[0, j] = row[j] - _weighted(factors[1:], [new[i, j] for i in k])
        pp = _product(left, own) - _weighted(factors[1:], [row[i].T + new[0, i] for i in k])
        new[0, 0] = (pp + pp.T) / 2
        for j in k:
            new[j, j] = (new[j, j] + new[j, j].T) / 2
        return Motion(tuple(x), tuple(new[i, j] for j in range(len(x)) for i in range(j + 1)))


def expected_of(motion: Motion, theta: Array, size: Array) -> Expected:
    return Expected(motion.x[0], motion.x[1], spread(theta, size), motion.P[0], size)


def moments_of(motion: Motion, size: Array, P_size: Array, turn: Array, P_turn: Array):
    mean = jnp.concatenate([motion.x[0], motion.x[1], size, turn])
    parts = [
        jnp.block([[motion.P[0], motion.P[1]], [motion.P[1].T, motion.P[2]]]),
        jnp.diag(P_size),
        P_turn.reshape(2, 2),
    ]
    return mean, jax.scipy.linalg.block_diag(*parts)


def decay(params: TrackerParams, dt: Array) -> tuple[Array, ...]:
    """Of (theta, q) over dt: factors of q in theta and in q, covariances added to both.

    dq = -g q dt + dW with g = 1 / tau_q. With a = g dt the variance of theta is that of W times
    dt^3 (a - 2 (1 - exp(-a)) + (1 - exp(-2 a)) / 2) / a^3, which cancels for small a; there its
    series serves.
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


def transition(params: TrackerParams, dt: Array, still: Array) -> Float[Array, "8 8"]:
    """Of (px, py, vx, vy, lambda1, lambda2, theta, q) over dt; at rest where `still`."""
    to_theta, to_q, *_ = decay(params, dt)
    pairs = jnp.array([0, 1, 6, 7]), jnp.array([2, 3, 7, 7])
    F = jnp.eye(8, dtype=dt.dtype).at[pairs].set(jnp.stack([dt, dt, to_theta, to_q]))
    moving = jnp.zeros(8, bool).at[jnp.array([2, 3, 7])].set(True)
    keep = jnp.where(still & moving, 0.0, 1.0).astype(dt.dtype)
    return keep[:, None] * F * keep
