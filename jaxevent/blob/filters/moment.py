"""The default filter: second moments of the residuals drive the shape, no past events are kept.

With u = R^T e, V = kappa lambda^2 + (R^T P_p R)_ii: u_i^2 / V_i - 1 measures log lambda_i, and
u1 u2 / sqrt(V1 V2) measures theta, not at all where the sizes are equal (cf. MEM-EKF*, Yang
and Baum 2018). Of M events the means are used; their common error, P_p, does not average out.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.filter import EventBatch, Filter, PredictedMeasurement, where_tree
from jaxevent.blob.filters.motion import (
    LinearMotion,
    ellipse_covariance,
    gated_moments,
    join_blocks,
    log_size_step,
    predicted_ellipse,
    transition,
    turn_transition,
)
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.track import wrap_angle
from jaxevent.blob.tracker import Tracker


class Params(TrackerParams):
    """Parameters of `moment`."""


class MomentState(eqx.Module):
    """Motion, log sizes and (theta, q), without covariance between the three.

    Attributes:
        motion: Position and velocity.
        log_size: Logarithms of lambda1 and lambda2 in px.
        P_size: Their variances.
        turn: theta, rad, and q, rad/s.
        P_turn: Their covariance: theta theta, theta q, q q.
    """

    motion: LinearMotion
    log_size: Float[Array, " 2"]
    P_size: Float[Array, " 2"]
    turn: Float[Array, " 2"]
    P_turn: Float[Array, " 3"]


def init(params: TrackerParams, position: Array, size: Array) -> MomentState:
    two = jnp.ones_like(position)
    P_turn = jnp.stack([params.P0_theta, jnp.zeros_like(params.P0_q), params.P0_q])
    return MomentState(
        LinearMotion.init(params, position),
        jnp.log(size) * two,
        params.P0_lambda / params.lambda0**2 * two,
        0 * two,
        P_turn.astype(position.dtype),
    )


def predict(params: TrackerParams, state: MomentState, dt: Array) -> MomentState:
    to_theta, to_q, tt, tq, qq = turn_transition(params, dt)
    theta, q = state.turn
    a, b, d = state.P_turn
    return MomentState(
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
    """Residuals of a step's events along the blob's axes.

    Attributes:
        m: Total weight of the step.
        u: (2, M) residuals, px.
        share: (M,) share of each event in the total weight.
        age: Mean age of the events, s.
        size: (2,) sizes, px.
        P: (2,) variances of the centre along the axes, px^2.
        cross: Covariance of the centre between the axes, px^2.
    """

    m: Array
    u: Array
    share: Array
    age: Array | float
    size: Array
    P: Array
    cross: Array


def update(
    params: TrackerParams, state: MomentState, batch: EventBatch, weight: Array
) -> MomentState:
    m = weight.sum()
    e, mean, factors = state.motion.residuals(batch, weight)
    age = -factors[1]
    theta = state.turn[0] - age * state.turn[1]
    c, s = jnp.cos(theta), jnp.sin(theta)
    size = jnp.exp(state.log_size)
    motion = state.motion.update(mean, factors, ellipse_covariance(theta, size), m)

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
    residuals = _Residuals(m, u, share, age, size, P, cross)
    new = MomentState(
        motion, *_update_size(params, state, residuals), *_update_turn(params, state, residuals)
    )
    return where_tree(m > 0, new, state)


def _update_size(
    params: TrackerParams, state: MomentState, residuals: _Residuals
) -> tuple[Array, Array]:
    """Update log sizes and their variances by u_i^2 / V_i - 1."""
    m, size = residuals.m, residuals.size
    kappa, fourth = gated_moments(params)
    variance = 3 * fourth - kappa**2  # of u_i^2 / lambda_i^2, and its derivative by log lambda
    V = kappa * size**2 + residuals.P
    share_l, r = size**2 / V, residuals.P / V
    innovation = (residuals.share * residuals.u**2).sum(1) / V - 1
    derivative = variance * share_l
    noise = variance * share_l**2 + 4 * kappa * share_l * r + 2 * m * r**2  # times m
    P_size = jnp.minimum(state.P_size, 1)
    total = m * derivative**2 * P_size + noise
    log_size = state.log_size + log_size_step(
        m * derivative * P_size / total * innovation, derivative
    )
    log_size = jnp.clip(log_size, jnp.log(params.lambda_min), jnp.log(params.lambda_max))
    return log_size, P_size * noise / total


def _update_turn(
    params: TrackerParams, state: MomentState, residuals: _Residuals
) -> tuple[Array, Array]:
    """Update (theta, q) and their covariance by u1 u2 / sqrt(V1 V2)."""
    m, size, age, u = residuals.m, residuals.size, residuals.age, residuals.u
    kappa, fourth = gated_moments(params)
    V = kappa * size**2 + residuals.P
    root = jnp.sqrt(V)
    share_l, r, r12 = size**2 / V, residuals.P / V, residuals.cross / root[0] / root[1]
    innovation = (residuals.share * u[0] * u[1]).sum() / root[0] / root[1] - r12
    derivative = fourth * (
        size[0] / root[0] * (size[0] / root[1]) - size[1] / root[0] * (size[1] / root[1])
    )
    noise = fourth * share_l[0] * share_l[1] + kappa * (share_l[0] * r[1] + share_l[1] * r[0])
    noise = noise + m * (r[0] * r[1] + r12**2)
    tt, tq, qq = state.P_turn
    limit = params.P_theta_max
    limit = limit / jnp.maximum(jnp.maximum(tt, limit), 1e-30)
    tt, tq = tt * limit, tq * limit
    with_theta, with_q = tt - age * tq, tq - age * qq
    total = m * derivative**2 * (with_theta - age * with_q) + noise
    gain = m * derivative / total
    turn = state.turn + gain * innovation * jnp.stack([with_theta, with_q])
    turn = jnp.stack([wrap_angle(turn[0]), turn[1]])
    # P - B B^T / S of a 2x2 P, with the difference of products worked out.
    inner = m * derivative**2 * jnp.maximum(tt * qq - tq**2, 0)
    P_turn = jnp.stack([tt * noise + inner * age**2, tq * noise + inner * age, qq * noise + inner])
    return turn, P_turn / total


def predicted_measurement(params: TrackerParams, state: MomentState) -> PredictedMeasurement:
    return predicted_ellipse(state.motion, state.turn[0], jnp.exp(state.log_size))


def zero_velocity(params: TrackerParams, state: MomentState, known: bool) -> MomentState:
    theta, q = state.turn
    tt, tq, qq = state.P_turn
    P_turn = jnp.stack([tt, 0 * tq, 0 * qq if known else params.P0_q + 0 * qq])
    motion = state.motion.zero_velocity(params, known)
    return MomentState(motion, state.log_size, state.P_size, jnp.stack([theta, 0 * q]), P_turn)


def readout(params: TrackerParams, state: MomentState) -> tuple[Array, Array]:
    size = jnp.exp(state.log_size)
    tt, tq, qq = state.P_turn
    return join_blocks(
        state.motion, size, size**2 * state.P_size, state.turn, jnp.stack([tt, tq, tq, qq])
    )


moment = Tracker(
    "moment",
    Params,
    Filter(init, predict, update, predicted_measurement, readout, zero_velocity, transition),
    about="Tracking of blobs by second moments of the events' residuals; the default.",
)
