"""The default filter: second moments of the residuals drive the shape, no past events are kept.

With u = R^T e, V = kappa lambda^2 + (R^T P_p R)_ii: u_i^2 / V_i - 1 measures log lambda_i, and
u1 u2 / sqrt(V1 V2) measures theta, not at all where the sizes are equal (cf. MEM-EKF*, Yang
and Baum 2018). Of M events the means are used; their common error, P_p, does not average out.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.association import Expected
from jaxevent.blob.filters.ellipse import geometric_step, spread, truncation
from jaxevent.blob.filters.motion import Motion, decay, expected_of, moments_of, transition
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.states import wrap
from jaxevent.blob.steps import Batch, Filter, choose
from jaxevent.blob.tracker import Tracker


class Params(TrackerParams):
    """Parameters of `moment`."""


class State(eqx.Module):
    """Motion, log sizes and (theta, q), without covariance between the three."""

    motion: Motion
    log_size: Float[Array, " 2"]
    P_size: Float[Array, " 2"]  # of log_size
    turn: Float[Array, " 2"]
    P_turn: Float[Array, " 3"]  # theta theta, theta q, q q


def start(params: TrackerParams, position: Array, size: Array) -> State:
    two = jnp.ones_like(position)
    P_turn = jnp.stack([params.P0_theta, jnp.zeros_like(params.P0_q), params.P0_q])
    return State(
        Motion.start(params, position),
        jnp.log(size) * two,
        params.P0_lambda / params.lambda0**2 * two,
        0 * two,
        P_turn.astype(position.dtype),
    )


def predict(params: TrackerParams, state: State, dt: Array) -> State:
    to_theta, to_q, tt, tq, qq = decay(params, dt)
    theta, q = state.turn
    a, b, d = state.P_turn
    return State(
        state.motion.predict(params, dt),
        state.log_size,
        state.P_size + params.Q_lambda * dt / jnp.exp(state.log_size) ** 2,
        jnp.stack([theta + to_theta * q, to_q * q]),
        jnp.stack(
            [
                a + 2 * to_theta * b + to_theta**2 * d + tt,
                to_q * (b + to_theta * d) + tq,
                to_q**2 * d + qq,
            ]
        ),
    )


class _Residuals(NamedTuple):
    """The events of a step along the blob's axes, of m in all."""

    m: Array
    u: Array  # (2, M), px
    share: Array  # (M,)
    age: Array | float  # s, their mean
    size: Array  # (2,), px
    P: Array  # (2,), px^2: variances of the centre along the axes
    cross: Array  # its covariance


def update(params: TrackerParams, state: State, batch: Batch, weight: Array) -> State:
    m = weight.sum()
    e, mean, factors = state.motion.residuals(batch, weight)
    age = -factors[1]
    theta = state.turn[0] - age * state.turn[1]
    c, s = jnp.cos(theta), jnp.sin(theta)
    size = jnp.exp(state.log_size)
    motion = state.motion.update(mean, factors, spread(theta, size), m)

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
    seen = _Residuals(m, u, share, age, size, P, cross)
    new = State(motion, *_update_size(params, state, seen), *_update_turn(params, state, seen))
    return choose(m > 0, new, state)


def _update_size(params: TrackerParams, state: State, seen: _Residuals) -> tuple[Array, Array]:
    """Log sizes and their variances from u_i^2 / V_i - 1."""
    m, size = seen.m, seen.size
    kappa, fourth = truncation(params)
    variance = 3 * fourth - kappa**2  # of u_i^2 / lambda_i^2, and its slope against log lambda
    V = kappa * size**2 + seen.P
    share_l, r = size**2 / V, seen.P / V
    innovation = (seen.share * seen.u**2).sum(1) / V - 1
    slope = variance * share_l
    noise = variance * share_l**2 + 4 * kappa * share_l * r + 2 * m * r**2  # times m
    P_size = jnp.minimum(state.P_size, 1)
    total = m * slope**2 * P_size + noise
    log_size = state.log_size + geometric_step(m * slope * P_size / total * innovation, slope)
    log_size = jnp.clip(log_size, jnp.log(params.lambda_min), jnp.log(params.lambda_max))
    return log_size, P_size * noise / total


def _update_turn(params: TrackerParams, state: State, seen: _Residuals) -> tuple[Array, Array]:
    """(theta, q) and their covariance from u1 u2 / sqrt(V1 V2)."""
    m, size, age, u = seen.m, seen.size, seen.age, seen.u
    kappa, fourth = truncation(params)
    V = kappa * size**2 + seen.P
    root = jnp.sqrt(V)
    share_l, r, r12 = size**2 / V, seen.P / V, seen.cross / root[0] / root[1]
    innovation = (seen.share * u[0] * u[1]).sum() / root[0] / root[1] - r12
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
    turn = jnp.stack([wrap(turn[0]), turn[1]])
    # P - B B^T / S of a 2x2 P, with the difference of products worked out.
    inner = m * slope**2 * jnp.maximum(tt * qq - tq**2, 0)
    P_turn = jnp.stack([tt * noise + inner * age**2, tq * noise + inner * age, qq * noise + inner])
    return turn, P_turn / total


def expected(params: TrackerParams, state: State) -> Expected:
    return expected_of(state.motion, state.turn[0], jnp.exp(state.log_size))


def halt(params: TrackerParams, state: State, known: bool) -> State:
    theta, q = state.turn
    tt, tq, qq = state.P_turn
    P_turn = jnp.stack([tt, 0 * tq, 0 * qq if known else params.P0_q + 0 * qq])
    motion = state.motion.halt(params, known)
    return State(motion, state.log_size, state.P_size, jnp.stack([theta, 0 * q]), P_turn)


def moments(params: TrackerParams, state: State) -> tuple[Array, Array]:
    size = jnp.exp(state.log_size)
    tt, tq, qq = state.P_turn
    return moments_of(
        state.motion, size, size**2 * state.P_size, state.turn, jnp.stack([tt, tq, tq, qq])
    )


moment = Tracker(
    "moment",
    Params,
    Filter(start, predict, update, expected, moments, halt, transition),
    about="Tracking of blobs by second moments of the events' residuals; the default.",
)
