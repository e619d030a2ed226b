"""Filters of one blob: a bright spot whose events scatter about its centre as a Gaussian.

Every filter has the same pure steps (`BlobFilter`): predict over a gap, then update with the events
of one step. The state is (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad; lambda are
the standard deviations of the events along the blob's axes, theta turns the first axis from x
towards y, q is its rate. L = R(theta) diag(lambda1, lambda2) R(theta)^T is the square root of the
events' covariance. Wang, Molloy, van Goor, Mahony, "Asynchronous Blob Tracker for Event Cameras".
"""

import abc
import dataclasses
import math
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxevent.parameters import Choice, Count, Parameters, Positive

S = TypeVar("S", bound=eqx.Module)
T = TypeVar("T")
Scalar = Float[Array, ""]


class Batch(eqx.Module):
    """The M events of one step."""

    xi: Float[Array, "M 2"]  # px
    age: Float[Array, " M"]  # s before the step's time; 0 for an event at that time
    polarity: Float[Array, " M"]  # +1 or -1


class Expected(eqx.Module):
    """What a filter expects of the next events, and how large it believes the blob to be."""

    p: Float[Array, " 2"]  # px
    v: Float[Array, " 2"]  # px/s
    spread: Float[Array, "2 2"]  # px^2, covariance of events about the true centre
    P_p: Float[Array, "2 2"]  # px^2, covariance of p
    size: Float[Array, " 2"]  # px, lambda1 and lambda2


class FilterParams(Parameters):
    """Parameters of all blob filters; the defaults suit blobs of 10 px at 100,000 events/s."""

    filter = Choice(
        ("moment", "chi2_split", "chi2", "constant_velocity", "moving_moments"),
        "the filter; the last two are baselines",
    )
    events_per_step = Count(1, "", "events that share one prediction and one update")
    polarity_offset = Choice(
        (False, True), "estimate half the distance between the blobs of ON and of OFF events"
    )

    Q_p = Positive(20.0, "px^2/s", "process noise of the position")
    Q_v = Positive(1e6, "px^2/s^3", "process noise of the velocity")
    Q_lambda = Positive(10.0, "px^2/s", "process noise of the sizes")
    Q_theta = Positive(0.1, "rad^2/s", "process noise of the orientation")
    Q_q = Positive(50.0, "rad^2/s^3", "process noise of the turn rate")
    Q_d = Positive(5.0, "px^2/s", "process noise of the polarity offset")
    P0_p = Positive(25.0, "px^2", "variance of the position at the start")
    P0_v = Positive(2.5e5, "px^2/s^2", "variance of the velocity at the start")
    P0_lambda = Positive(
        25.0, "px^2", "variance of the size lambda0 at the start; of others as their square"
    )
    P0_theta = Positive(0.5, "rad^2", "variance of the orientation at the start")
    P0_q = Positive(100.0, "rad^2/s^2", "variance of the turn rate at the start")
    P0_d = Positive(50.0, "px^2", "variance of the polarity offset at the start")
    lambda0 = Positive(10.0, "px", "size at the start, about twice the largest expected")
    lambda_min = Positive(0.5, "px", "least size")
    lambda_max = Positive(60.0, "px", "largest size")
    tau_q = Positive(0.0, "s", "time constant of the turn rate's decay; 0: it does not decay")
    P_theta_max = Positive(1.0, "rad^2", "largest variance of the orientation")

    # Of a Gaussian the ellipse of 3.5 sizes loses 1.3 % of the variance, which is corrected, of a
    # disc or a ring nothing, which makes them 0.7 % too large (2.6 % at 3 sizes). A circle of 3
    # sizes makes ellipses 1.7 % too short, and in background events of 10 times the blob's rate
    # 12 % too wide; the ellipse 2 %.
    gate = Positive(3.5, "", "radius of the gate in sizes")
    gate_shape = Choice(
        ("ellipse", "circle"), "the gate's shape; moment and chi2_split correct for an ellipse"
    )
    gate_decay = Positive(200.0, "1/s", "rate at which the gate follows the size")
    gate_min = Positive(6.0, "px", "least radius of the gate")
    gate_max = Positive(80.0, "px", "largest radius of the gate")
    gate_position = Positive(3.0, "", "standard deviations of the position added to the gate")

    n = Count(10, "", "steps in the window of squared residuals of chi2 and chi2_split")
    beta = Positive(0.01, "", "variance of the position over that of the events, in the window")
    target = Choice(
        ("2n+4", "2n"),
        "chi2: what the window's sum is driven to; 2n is biased by sqrt((n+1)/(n-1))",
    )
    current_in_jacobian = Choice(
        (False, True), "chi2: whether the newest event's residual acts on p and theta in the window"
    )
    formulation = Choice(
        ("corrected", "authors"),
        "chi2: authors leaves the newest event out of the window, has no guards and keeps lambda "
        "itself as state",
    )
    tau_moments = Positive(0.002, "s", "moving_moments: time constant of the window")

    presets = {
        # Stars: tens of events per second each, a few px per second.
        "slow": {
            "Q_p": 0.5,
            "Q_v": 5.0,
            "Q_lambda": 0.05,
            "Q_theta": 0.01,
            "Q_q": 0.01,
            "P0_v": 100.0,
            "lambda0": 3.0,
            "P0_lambda": 2.0,
            "lambda_max": 8.0,
            "gate_min": 4.0,
            "gate_max": 15.0,
        },
        # 10,000 px/s and more, at 10 million events/s.
        "fast": {
            "Q_v": 1e9,
            "Q_lambda": 1e3,
            "Q_theta": 10.0,
            "Q_q": 1e6,
            "P0_p": 100.0,
            "P0_v": 1e8,
            "lambda0": 20.0,
            "P0_lambda": 80.0,
            "gate_min": 10.0,
        },
        # Time to contact: the velocity is averaged over tenths of a second. A Q_p above
        # lambda sqrt(Q_v / rate), here 0.4, would make its time constant sqrt(Q_p / Q_v).
        "ttc": {"Q_p": 0.01, "Q_v": 300.0},
        # Published settings of the authors' program, for cars.
        "authors": {
            "filter": "chi2",
            "formulation": "authors",
            "target": "2n",
            "beta": 0.0,
            "polarity_offset": True,
            "Q_p": 200.0,
            "Q_v": 1e3,
            "Q_lambda": 1.0,
            "Q_theta": 0.005,
            "Q_q": 0.01,
            "P0_p": 10.0,
            "P0_v": 500.0,
            "P0_lambda": 5.0,
            "P0_theta": 0.5,
            "P0_q": 2.0,
            "lambda0": 30.0,
            "gate_shape": "circle",
            "gate": 2.5,
            "gate_decay": 1.4,
            "gate_min": 10.0,
        },
    }


class BlobFilter(abc.ABC, Generic[S]):
    """One filter. All steps are pure: they jit, vmap and differentiate."""

    @abc.abstractmethod
    def start(self, params: FilterParams, position: Float[Array, " 2"], size: Scalar) -> S:
        """The state of a resting round blob: centre and size in px."""

    @abc.abstractmethod
    def predict(self, params: FilterParams, state: S, dt: Scalar) -> S:
        """The state dt >= 0 seconds later, without events; exact over any gap."""

    @abc.abstractmethod
    def update(self, params: FilterParams, state: S, batch: Batch, weight: Float[Array, " M"]) -> S:
        """The state after the events of a step.

        `weight` in [0, 1] multiplies an event's information; a step whose weights are all 0
        changes nothing. Events are compared with the position at their own age.
        """

    @abc.abstractmethod
    def expected(self, params: FilterParams, state: S) -> Expected:
        """What the filter expects of events at the state's time."""

    @abc.abstractmethod
    def moments(self, state: S) -> tuple[Float[Array, " 8"], Float[Array, "8 8"]]:
        """Mean and covariance of (px, py, vx, vy, lambda1, lambda2, theta, q), lambda in px."""


def filter_of(params: FilterParams) -> BlobFilter[Any]:
    """The filter that `params.filter` names."""
    return FILTERS[params.filter]


def _product(a: Float[Array, "2 2"], b: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    # Elementwise, so that a whole scan compiles to one kernel: 0.03 us per event for the motion
    # block against 2 us with calls of a matrix product.
    return a[:, :1] * b[:1] + a[:, 1:] * b[1:]


def _inverse(a: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    scale = a[0, 0] + a[1, 1]  # the determinant of 1e20 px^2 would overflow
    a = a / scale
    adjugate = jnp.stack([a[1, 1], -a[0, 1], -a[1, 0], a[0, 0]]).reshape(2, 2)
    return adjugate / ((a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * scale)


def _spread(theta: Array, size: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """L L^T = R diag(size^2) R^T."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    a, b = size[0] ** 2, size[1] ** 2
    xy = (a - b) * c * s
    return jnp.stack([a * c**2 + b * s**2, xy, xy, a * s**2 + b * c**2]).reshape(2, 2)


def _wrapped(theta: Array) -> Array:
    return theta - 2 * jnp.pi * jnp.round(theta / (2 * jnp.pi))


def _where(hit: Array, new: T, old: T) -> T:
    return jax.tree.map(lambda a, b: jnp.where(hit, a, b), new, old)


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
    def start(cls, params: FilterParams, position: Array) -> "Motion":
        variances = [params.P0_p, params.P0_v] + [params.P0_d] * params.polarity_offset
        none = jnp.zeros_like(position)
        eye = jnp.eye(2, dtype=position.dtype)
        P = [(i == j) * v * eye for j, v in enumerate(variances) for i in range(j + 1)]
        return cls((position, *(none for _ in variances[1:])), tuple(P))

    def block(self, i: int, j: int) -> Float[Array, "2 2"]:
        """Covariance of components i and j (0 position, 1 velocity, 2 offset)."""
        return self.P[j * (j + 1) // 2 + i] if i <= j else self.P[i * (i + 1) // 2 + j].T

    def predict(self, params: FilterParams, dt: Array) -> "Motion":
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


def _decay(params: FilterParams, dt: Array) -> tuple[Array, ...]:
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


def _truncation(params: FilterParams) -> tuple[Array | float, Array | float]:
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


def _geometric(step: Array, slope: Array) -> Array:
    """log(1 + slope step) / slope: a step of log lambda that is exact however large it is.

    Without P_p and a gate, log lambda of variance P is lambda^2 of an inverse gamma distribution of
    the shape 1 / (4 P). Its update by u^2 multiplies lambda^2 by 1 + 2 step, `step` being that of
    the Kalman filter, and has the same variance. From a size that is twofold too large the Kalman
    filter would know itself sure long before it is there, as u^2 / V - 1 is never below -1.
    """
    return jnp.log1p(jnp.maximum(slope * step, -0.999)) / jnp.maximum(slope, 1e-15)


class MomentState(eqx.Module):
    """Motion, log sizes and (theta, q), without covariance between the three."""

    motion: Motion
    log_size: Float[Array, " 2"]
    P_size: Float[Array, " 2"]  # of log_size
    turn: Float[Array, " 2"]
    P_turn: Float[Array, " 3"]  # theta theta, theta q, q q


class Moment(BlobFilter[MomentState]):
    """The default: second moments of the residuals drive the shape, no past events are kept.

    With u = R^T e, V = kappa lambda^2 + (R^T P_p R)_ii: u_i^2 / V_i - 1 measures log lambda_i, and
    u1 u2 / sqrt(V1 V2) measures theta, not at all where the sizes are equal (cf. MEM-EKF*, Yang
    and Baum 2018). Of M events the means are used; their common error, P_p, does not average out.
    """

    def start(self, params, position, size):
        two = jnp.ones_like(position)
        P_turn = jnp.stack([params.P0_theta, jnp.zeros_like(params.P0_q), params.P0_q])
        return MomentState(
            Motion.start(params, position),
            jnp.log(size) * two,
            params.P0_lambda / params.lambda0**2 * two,
            0 * two,
            P_turn.astype(position.dtype),
        )

    def predict(self, params, state, dt):
        to_theta, to_q, tt, tq, qq = _decay(params, dt)
        theta, q = state.turn
        a, b, d = state.P_turn
        return MomentState(
            state.motion.predict(params, dt),
            state.log_size,
            state.P_size + params.Q_lambda * dt * jnp.exp(-2 * state.log_size),
            jnp.stack([theta + to_theta * q, to_q * q]),
            jnp.stack(
                [
                    a + 2 * to_theta * b + to_theta**2 * d + tt,
                    to_q * (b + to_theta * d) + tq,
                    to_q**2 * d + qq,
                ]
            ),
        )

    def update(self, params, state, batch, weight):
        m = weight.sum()
        e, mean, factors = state.motion.residuals(batch, weight)
        age = -factors[1]
        theta = state.turn[0] - age * state.turn[1]
        c, s = jnp.cos(theta), jnp.sin(theta)
        size = jnp.exp(state.log_size)
        motion = state.motion.update(mean, factors, _spread(theta, size), m)

        share = weight / jnp.where(m > 0, m, 1)
        u = jnp.stack([c * e[:, 0] + s * e[:, 1], c * e[:, 1] - s * e[:, 0]])
        _, P = state.motion.covariances(factors)
        cross = (P[1, 1] - P[0, 0]) * c * s + P[0, 1] * (c**2 - s**2)
        P = jnp.stack(
            [
                P[0, 0] * c**2 + 2 * P[0, 1] * c * s + P[1, 1] * s**2,
                P[0, 0] * s**2 - 2 * P[0, 1] * c * s + P[1, 1] * c**2,
            ]
        )
        kappa, fourth = _truncation(params)
        variance = 3 * fourth - kappa**2  # of u_i^2 / lambda_i^2, and its slope against log lambda
        V = kappa * size**2 + P
        root = jnp.sqrt(V)
        share_l, r, r12 = size**2 / V, P / V, cross / root[0] / root[1]

        innovation = (share * u**2).sum(1) / V - 1
        slope = variance * share_l
        noise = variance * share_l**2 + 4 * kappa * share_l * r + 2 * m * r**2  # times m
        P_size = jnp.minimum(state.P_size, 1)
        total = m * slope**2 * P_size + noise
        log_size = state.log_size + _geometric(m * slope * P_size / total * innovation, slope)
        log_size = jnp.clip(log_size, jnp.log(params.lambda_min), jnp.log(params.lambda_max))
        P_size = P_size * noise / total

        innovation = (share * u[0] * u[1]).sum() / root[0] / root[1] - r12
        slope = fourth * (
            size[0] / root[0] * (size[0] / root[1]) - size[1] / root[0] * (size[1] / root[1])
        )
        noise = fourth * share_l[0] * share_l[1] + kappa * (share_l[0] * r[1] + share_l[1] * r[0])
        noise = noise + m * (r[0] * r[1] + r12**2)
        tt, tq, qq = state.P_turn
        limit = params.P_theta_max
        limit = limit / jnp.maximum(jnp.maximum(tt, limit), 1e-30)
        tt, tq = tt * limit, tq * limit
        with_theta, with_q = tt - age * tq, tq - age * qq
        total = m * slope**2 * (with_theta - age * with_q) + noise
        gain = m * slope / total
        turn = state.turn + gain * innovation * jnp.stack([with_theta, with_q])
        turn = jnp.stack([_wrapped(turn[0]), turn[1]])
        # P - B B^T / S of a 2x2 P, with the difference of products worked out.
        inner = m * slope**2 * jnp.maximum(tt * qq - tq**2, 0)
        P_turn = jnp.stack(
            [tt * noise + inner * age**2, tq * noise + inner * age, qq * noise + inner]
        )
        new = MomentState(motion, log_size, P_size, turn, P_turn / total)
        return _where(m > 0, new, state)

    def expected(self, params, state):
        return _expected(state.motion, state.turn[0], jnp.exp(state.log_size))

    def moments(self, state):
        size = jnp.exp(state.log_size)
        tt, tq, qq = state.P_turn
        return _moments(
            state.motion, size, size**2 * state.P_size, state.turn, jnp.stack([tt, tq, tq, qq])
        )


def _expected(motion: Motion, theta: Array, size: Array) -> Expected:
    return Expected(motion.x[0], motion.x[1], _spread(theta, size), motion.P[0], size)


def _moments(motion: Motion, size: Array, P_size: Array, turn: Array, P_turn: Array):
    mean = jnp.concatenate([motion.x[0], motion.x[1], size, turn])
    parts = [
        jnp.block([[motion.P[0], motion.P[1]], [motion.P[1].T, motion.P[2]]]),
        jnp.diag(P_size),
        P_turn.reshape(2, 2),
    ]
    return mean, jax.scipy.linalg.block_diag(*parts)


class Window(eqx.Module):
    """The squared residuals of the last n steps, along the axes that the blob had then.

    A row of `ring` holds a step's sums of w u1^2, w u2^2 and w over its events; as u is the
    residual of the state predicted for the step, |L^-1 e|^2 with any later sizes is u1^2 /
    lambda1^2 + u2^2 / lambda2^2. `sums` is that of the ring; `fresh` collects what came since slot
    0 and replaces it once per turn, so that rounding does not add up.
    """

    ring: Float[Array, "n 3"]
    sums: Float[Array, " 3"]
    fresh: Float[Array, " 3"]
    slot: Int[Array, ""]
    filled: Int[Array, ""]

    @classmethod
    def empty(cls, n: int, dtype: Any) -> "Window":
        three, zero = jnp.zeros(3, dtype), jnp.zeros((), jnp.int32)
        return cls(jnp.zeros((n, 3), dtype), three, three, zero, zero)

    def push(self, new: Float[Array, " 3"]) -> "Window":
        n = len(self.ring)
        here = (jnp.arange(n) == self.slot)[:, None]
        old = jnp.where(here, self.ring, 0).sum(0)
        fresh = self.fresh + new
        last = self.slot == n - 1
        return Window(
            jnp.where(here, new, self.ring),
            jnp.where(last, fresh, jnp.maximum(self.sums + (new - old), new)),
            jnp.where(last, 0, fresh),
            jnp.where(last, 0, self.slot + 1),
            jnp.minimum(self.filled + 1, n),
        )


class WindowState(eqx.Module):
    """The joint state and the window of residuals."""

    x: Float[Array, " d"]  # px py vx vy lambda1 lambda2 theta q [dx dy]; lambda or its log
    P: Float[Array, "d d"]
    window: Window
    logarithmic: bool = eqx.field(static=True)  # whether x holds log lambda


P_POSITION_MAX = 1e6  # px^2; in single precision a longer pause would leave nothing of R


@dataclasses.dataclass(frozen=True)
class ChiSquare(BlobFilter[WindowState]):
    """The paper's extended Kalman filter: 0 = L^-1 e + N(0, I), and a window's sum of |L^-1 e|^2.

    `split=False` is eq. 11-23: the one sum is driven to 2 n (`target`) with the variance 4 n.
    `split=True` has one sum per axis, driven to n, with the variance 2 n n, as each residual
    counts n times; the pseudo-measurement L^-1 e then does not act on the sizes, so they are
    unbiased and positive. Of M events per step the mean of L^-1 e has the covariance I / m, and
    the window's slots hold the step's sums; n counts steps.

    While the window fills, and while the position's variance exceeds a quarter of the smaller
    size squared (beta would not hold), the shape stays.
    """

    split: bool

    def start(self, params, position, size):
        logarithmic = self.split or params.formulation == "corrected"
        none = jnp.zeros_like(position)
        P_size = params.P0_lambda / params.lambda0**2 if logarithmic else params.P0_lambda
        blocks = [position, none, (jnp.log(size) if logarithmic else size) + none, none]
        P = [params.P0_p, params.P0_p, params.P0_v, params.P0_v, P_size, P_size]
        P += [params.P0_theta, params.P0_q] + [params.P0_d] * 2 * params.polarity_offset
        return WindowState(
            jnp.concatenate(blocks + [none] * params.polarity_offset),
            jnp.diag(jnp.stack(P)).astype(position.dtype),
            Window.empty(params.n, position.dtype),
            logarithmic,
        )

    def predict(self, params, state, dt):
        authors = params.formulation == "authors"
        x, P = state.x, state.P
        to_theta, to_q, tt, tq, qq = _decay(params, dt)
        pp, pv, vv = params.Q_p * dt, params.Q_v * dt**2 / 2, params.Q_v * dt
        if authors:
            tt, tq, pv = params.Q_theta * dt, 0 * dt, 0 * dt
        else:
            pp = pp + params.Q_v * dt**3 / 3
        Q_size = params.Q_lambda * dt * jnp.ones(2)
        if state.logarithmic:
            Q_size = Q_size * jnp.exp(-2 * x[4:6])

        def advance(rows: Array) -> Array:
            p, v, size, theta, q, rest = jnp.split(rows, [2, 4, 6, 7, 8])
            return jnp.concatenate([p + dt * v, v, size, theta + to_theta * q, to_q * q, rest])

        P = advance(advance(P).T)
        own = [pp, pp, vv, vv, Q_size[0], Q_size[1], tt, qq]
        Q = jnp.diag(jnp.stack(own + [params.Q_d * dt] * (len(x) - 8)))
        for i, j, covariance in ((0, 2, pv), (1, 3, pv), (6, 7, tq)):
            pair = np.zeros((len(x), len(x)))
            pair[i, j] = pair[j, i] = 1
            Q = Q + jnp.asarray(pair, P.dtype) * covariance
        return dataclasses.replace(state, x=advance(x), P=P + Q)

    def update(self, params, state, batch, weight):
        authors = params.formulation == "authors"
        logarithmic = state.logarithmic
        x, P = state.x, state.P
        m = weight.sum()
        share = weight / jnp.where(m > 0, m, 1)
        age = (share * batch.age).sum()
        sign = jnp.sign(batch.polarity)
        e = batch.xi - x[:2] + x[2:4] * batch.age[:, None]
        if params.polarity_offset:
            e = e - sign[:, None] * x[8:]
        e = jnp.where(weight[:, None] > 0, e, 0)
        theta = x[6] - age * x[7]
        cos, sin = jnp.cos(theta), jnp.sin(theta)
        size = jnp.exp(x[4:6]) if logarithmic else x[4:6]
        over = 1 / size
        u = jnp.stack([cos * e[:, 0] + sin * e[:, 1], cos * e[:, 1] - sin * e[:, 0]])
        mean = (share * u).sum(1)
        energy = (weight * u**2).sum(1)

        if authors:
            trusted = jnp.bool(True)
        else:
            limits = {0: P_POSITION_MAX, 1: P_POSITION_MAX, 6: params.P_theta_max}
            if logarithmic:
                limits |= {4: 1.0, 5: 1.0}
            keep = [jnp.ones_like(m)] * len(x)
            for i, limit in limits.items():
                keep[i] = limit / jnp.maximum(jnp.maximum(P[i, i], limit), 1e-30)
            keep = jnp.stack(keep)
            # Covariances shrink as much as variances: the gain of a velocity stays what it was.
            P = P * keep[:, None] * keep + jnp.diag((keep - keep**2) * jnp.diagonal(P))
            a, b, c = lax.stop_gradient((P[0, 0], P[0, 1], P[1, 1]))
            radius = (a + c) / 2 + jnp.hypot((a - c) / 2, b)
            trusted = radius <= 0.25 * size.min() ** 2
        push = jnp.concatenate([energy, m[None]])
        window = state.window.push(push)
        full = window.filled >= params.n
        shape = (trusted & (full | authors)).astype(P.dtype)

        unit = jnp.eye(len(x), dtype=P.dtype)
        per = size if logarithmic else jnp.ones_like(size)  # d lambda / d its state
        turning = (over[0] - over[1]) * (unit[6] - age * unit[7]) * trusted
        rows = []
        for i, (a, b) in enumerate(((cos, sin), (-sin, cos))):
            along = a * (unit[0] - age * unit[2]) + b * (unit[1] - age * unit[3])
            if params.polarity_offset:
                along = along + (share * sign).sum() * (a * unit[8] + b * unit[9])
            row = -over[i] * along + turning * mean[1 - i]
            if not self.split:
                row = row - shape * over[i] ** 2 * mean[i] * per[i] * unit[4 + i]
            rows.append((row, -mean[i] * over[i], jnp.ones(()), m))

        past = window.sums - push
        scale = 1.0 if authors else 1 / (1 + params.beta)
        W = jnp.where(m > 0, window.sums[2], 1)
        if self.split:
            kappa, fourth = _truncation(params)
            variance = 3 * fourth / kappa**2 - 1
            for i in range(2):
                found = (energy[i] + scale * past[i]) * over[i] ** 2 / kappa
                slope = -kappa * variance * W
                noise = variance * W * params.n
                rows.append((slope * unit[4 + i], W - found, noise, shape))
        else:
            inside = past[:2] * scale + (0 if authors else energy)
            found = (inside * over**2).sum()
            pull = -2 * inside * over**3 * per
            row = pull[0] * unit[4] + pull[1] * unit[5]
            if params.current_in_jacobian and not authors:
                for i in range(2):
                    other = rows[i][0] * (1 - unit[4] - unit[5])
                    row = row + 2 * m * mean[i] * over[i] * other
            goal = 2 * W + (4 if params.target == "2n+4" else 0)
            on = jnp.where(window.filled > 1, 1.0, 0.0) if authors else shape
            rows.append((row, goal - found, 4 * W, on))

        # One scalar after the other, all at the predicted state: equal to the joint update.
        # Rounding may take a variance that falls a millionfold below 0; the last term is as large.
        step, rounding = jnp.zeros_like(x), 4 * jnp.finfo(P.dtype).eps * jnp.diagonal(P)
        for row, innovation, noise, m_row in rows:
            B = P @ row
            gain = m_row * B / (m_row * jnp.maximum(row @ B, 0) + noise)
            step = step + gain * (innovation - row @ step)
            P = P - gain[:, None] * B
        P = P + jnp.diag(rounding)
        x = x + step
        if not authors:
            low, high = params.lambda_min, params.lambda_max
            if logarithmic:
                low, high = jnp.log(low), jnp.log(high)
            x = jnp.concatenate([x[:4], jnp.clip(x[4:6], low, high), _wrapped(x[6])[None], x[7:]])
        window = _where(trusted, window, state.window)
        return _where(m > 0, WindowState(x, P, window, logarithmic), state)

    def expected(self, params, state):
        x = state.x
        size = jnp.exp(x[4:6]) if state.logarithmic else x[4:6]
        return Expected(x[:2], x[2:4], _spread(x[6], size), state.P[:2, :2], size)

    def moments(self, state):
        x, P = state.x[:8], state.P[:8, :8]
        if state.logarithmic:
            size = jnp.exp(x[4:6])
            x = jnp.concatenate([x[:4], size, x[6:]])
            per = jnp.concatenate([jnp.ones(4, P.dtype), size, jnp.ones(2, P.dtype)])
            P = P * per[:, None] * per
        return x, P


class RoundState(eqx.Module):
    """A moving centre and the size it was started with."""

    motion: Motion
    size: Scalar


class ConstantVelocity(BlobFilter[RoundState]):
    """Baseline: a Kalman filter of position and velocity; every event has the variance size^2."""

    def start(self, params, position, size):
        return RoundState(Motion.start(params, position), size.astype(position.dtype))

    def predict(self, params, state, dt):
        return RoundState(state.motion.predict(params, dt), state.size)

    def update(self, params, state, batch, weight):
        m = weight.sum()
        _, mean, factors = state.motion.residuals(batch, weight)
        R = state.size**2 * jnp.eye(2, dtype=state.size.dtype)
        return _where(
            m > 0, RoundState(state.motion.update(mean, factors, R, m), state.size), state
        )

    def expected(self, params, state):
        return _expected(
            state.motion, 0 * state.size, state.size * jnp.ones_like(state.motion.x[0])
        )

    def moments(self, state):
        two = jnp.ones_like(state.motion.x[0])
        return _moments(state.motion, state.size * two, 0 * two, 0 * two, jnp.zeros(4, two.dtype))


class MovingState(eqx.Module):
    """Weighted moments of the events; times are ages before the state's time."""

    mass: Scalar
    center: Float[Array, " 2"]  # px
    age: Scalar  # s, mean
    spread: Float[Array, "2 2"]  # px^2
    drift: Float[Array, " 2"]  # px s, covariance of position and time
    duration: Scalar  # s^2, variance of time


class MovingMoments(BlobFilter[MovingState]):
    """Baseline: mean and covariance of the events with weights exp(-age / tau_moments).

    The position lags by `tau_moments`; the velocity is the slope of the line through the events.
    """

    def start(self, params, position, size):
        none = jnp.zeros((), position.dtype)
        spread = size**2 * jnp.eye(2, dtype=position.dtype)
        return MovingState(none + 1, position, none, spread, 0 * position, none)

    def predict(self, params, state, dt):
        mass = state.mass * jnp.exp(-dt / params.tau_moments)
        return dataclasses.replace(state, mass=mass, age=state.age + dt)

    def update(self, params, state, batch, weight):
        m = weight.sum()
        share = weight / jnp.where(m > 0, m, 1)
        xi = jnp.where(weight[:, None] > 0, batch.xi, 0)
        center, age = (share[:, None] * xi).sum(0), (share * batch.age).sum()
        e, t = jnp.where(weight[:, None] > 0, xi - center, 0), age - batch.age
        own = [
            (share[:, None, None] * e[:, :, None] * e[:, None]).sum(0),
            (share[:, None] * e * t[:, None]).sum(0),
            (share * t**2).sum(),
        ]
        mass = state.mass + m
        new = m / jnp.where(mass > 0, mass, 1)
        d, dt = center - state.center, state.age - age
        between = [d[:, None] * d, d * dt, dt**2]
        old = [state.spread, state.drift, state.duration]
        spread, drift, duration = (
            (1 - new) * a + new * b + new * (1 - new) * c
            for a, b, c in zip(old, own, between, strict=True)
        )
        moved = MovingState(
            mass, state.center + new * d, state.age - new * dt, spread, drift, duration
        )
        return _where(m > 0, moved, state)

    def expected(self, params, state):
        theta, _, size = _axes(state.spread)
        size = jnp.clip(size, params.lambda_min, params.lambda_max)
        spread = _spread(theta, size)
        v, _, _ = self._line(state)
        return Expected(state.center, v, spread, spread / jnp.maximum(state.mass, 1e-6), size)

    def moments(self, state):
        theta, _, size = _axes(state.spread)
        v, P_p, P_v = self._line(state)
        motion = Motion((state.center, v), (P_p, 0 * P_p, P_v))
        turn = jnp.stack([theta, 0 * theta])
        mass = jnp.maximum(state.mass, 1e-6)
        return _moments(motion, size, size**2 / (2 * mass), turn, jnp.zeros(4, theta.dtype))

    @staticmethod
    def _line(state: MovingState) -> tuple[Array, Array, Array]:
        known = state.duration > 0
        duration = jnp.where(known, state.duration, 1)
        mass = jnp.maximum(state.mass, 1e-6)
        P_v = jnp.where(known, state.spread / (mass * duration), 0)
        return jnp.where(known, state.drift / duration, 0), state.spread / mass, P_v


def _axes(spread: Float[Array, "2 2"]) -> tuple[Array, Array, Array]:
    """theta, and the variances and standard deviations along the axes, the larger first."""
    half, xy = (spread[0, 0] - spread[1, 1]) / 2, spread[0, 1]
    middle = (spread[0, 0] + spread[1, 1]) / 2
    apart = half**2 + xy**2
    long = apart > 1e-12 * middle**2
    radius = jnp.where(long, jnp.sqrt(jnp.where(long, apart, 1)), 0)
    theta = jnp.where(long, jnp.arctan2(jnp.where(long, xy, 0), jnp.where(long, half, 1)) / 2, 0)
    variances = jnp.maximum(jnp.stack([middle + radius, middle - radius]), 1e-12)
    return theta, variances, jnp.sqrt(variances)


FILTERS: dict[str, BlobFilter[Any]] = {
    "moment": Moment(),
    "chi2_split": ChiSquare(split=True),
    "chi2": ChiSquare(split=False),
    "constant_velocity": ConstantVelocity(),
    "moving_moments": MovingMoments(),
}
