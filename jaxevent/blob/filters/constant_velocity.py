"""Baseline: a Kalman filter of position and velocity; every event has the variance size^2."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.filter import EventBatch, Filter, PredictedMeasurement, where_tree
from jaxevent.blob.filters.motion import LinearMotion, join_blocks, predicted_ellipse, transition
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.tracker import Tracker


class ConstantVelocityState(eqx.Module):
    """A moving centre and its initial size.

    Attributes:
        motion: Position and velocity of the centre.
        size: Initial size, px.
    """

    motion: LinearMotion
    size: Float[Array, ""]


class Params(TrackerParams):
    """Parameters of `constant_velocity`."""


def init(params: TrackerParams, position: Array, size: Array) -> ConstantVelocityState:
    return ConstantVelocityState(LinearMotion.init(params, position), size.astype(position.dtype))


def predict(
    params: TrackerParams, state: ConstantVelocityState, dt: Array
) -> ConstantVelocityState:
    return ConstantVelocityState(state.motion.predict(params, dt), state.size)


def update(
    params: TrackerParams, state: ConstantVelocityState, batch: EventBatch, weight: Array
) -> ConstantVelocityState:
    m = weight.sum()
    _, mean, factors = state.motion.residuals(batch, weight)
    R = state.size**2 * jnp.eye(2, dtype=state.size.dtype)
    return where_tree(
        m > 0, ConstantVelocityState(state.motion.update(mean, factors, R, m), state.size), state
    )


def predicted_measurement(
    params: TrackerParams, state: ConstantVelocityState
) -> PredictedMeasurement:
    size = state.size * jnp.ones_like(state.motion.x[0])
    return predicted_ellipse(state.motion, 0 * state.size, size)


def zero_velocity(
    params: TrackerParams, state: ConstantVelocityState, known: bool
) -> ConstantVelocityState:
    return ConstantVelocityState(state.motion.zero_velocity(params, known), state.size)


def readout(params: TrackerParams, state: ConstantVelocityState) -> tuple[Array, Array]:
    two = jnp.ones_like(state.motion.x[0])
    return join_blocks(state.motion, state.size * two, 0 * two, 0 * two, jnp.zeros(4, two.dtype))


constant_velocity = Tracker(
    "constant_velocity",
    Params,
    Filter(init, predict, update, predicted_measurement, readout, zero_velocity, transition),
    about="A Kalman filter of position and velocity of round blobs; a baseline.",
)
