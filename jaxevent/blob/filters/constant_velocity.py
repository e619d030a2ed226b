"""Baseline: a Kalman filter of position and velocity; every event has the variance size^2."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.association import Expected
from jaxevent.blob.filters.motion import Motion, expected_of, moments_of, transition
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.steps import Batch, Filter, choose
from jaxevent.blob.tracker import Tracker


class State(eqx.Module):
    """A moving centre and the size it was started with."""

    motion: Motion
    size: Float[Array, ""]


class Params(TrackerParams):
    """Parameters of `constant_velocity`."""


def start(params: TrackerParams, position: Array, size: Array) -> State:
    return State(Motion.start(params, position), size.astype(position.dtype))


def predict(params: TrackerParams, state: State, dt: Array) -> State:
    return State(state.motion.predict(params, dt), state.size)


def update(params: TrackerParams, state: State, batch: Batch, weight: Array) -> State:
    m = weight.sum()
    _, mean, factors = state.motion.residuals(batch, weight)
    R = state.size**2 * jnp.eye(2, dtype=state.size.dtype)
    return choose(m > 0, State(state.motion.update(mean, factors, R, m), state.size), state)


def expected(params: TrackerParams, state: State) -> Expected:
    return expected_of(state.motion, 0 * state.size, state.size * jnp.ones_like(state.motion.x[0]))


def halt(params: TrackerParams, state: State, known: bool) -> State:
    return State(state.motion.halt(params, known), state.size)


def moments(params: TrackerParams, state: State) -> tuple[Array, Array]:
    two = jnp.ones_like(state.motion.x[0])
    return moments_of(state.motion, state.size * two, 0 * two, 0 * two, jnp.zeros(4, two.dtype))


constant_velocity = Tracker(
    "constant_velocity",
    Params,
    Filter(start, predict, update, expected, moments, halt, transition),
    about="A Kalman filter of position and velocity of round blobs; a baseline.",
)
