"""A method of a user's own: a filter of three numbers per pixel, of which one is no real number.

It predicts brightness that goes on changing: L is the log intensity, D its slope, n counts events.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jaxevent.parameters import Positive, UnitInterval
from jaxevent.reconstruction.augment import FrameParams, ZeroOrderHold, event_change
from jaxevent.reconstruction.filtering import Event, Filter, FrameModel, Observation


class Params(FrameParams):
    """Parameters of the trend filter."""

    alpha: Positive = Positive(10.0, "rad/s", "rate at which the last frame pulls")
    gain: UnitInterval = UnitInterval(
        0.1, "1", "part of an event's slope that the slope takes over"
    )
    tau: Positive = Positive(0.02, "s", "time constant in which a slope fades")


class State(eqx.Module):
    L: Array
    D: Array
    n: Array


class Frames(FrameModel):
    level: ZeroOrderHold
    alpha: Array

    def __init__(self, params: Params, frames):
        self.level, self.alpha = ZeroOrderHold(params, frames), params.alpha

    def __call__(self, points):
        u = self.level(points)
        return Observation(u, jnp.broadcast_to(self.alpha, u.shape))


def init(params: Params, level: Array) -> State:
    return State(level, jnp.zeros_like(level), jnp.zeros_like(level, int))


def predict(params: Params, state: State, dt: Array, frame: Observation) -> State:
    fading = jnp.exp(-dt / params.tau)
    L = state.L + state.D * params.tau * (1 - fading)
    decay = jnp.exp(-frame.rate * dt)
    return State(L * decay + frame.level * (1 - decay), state.D * fading, state.n)


def event_update(params: Params, state: State, event: Event) -> State:
    change = event_change(params, event.polarity, event.since)
    slope = change / jnp.maximum(event.since, 1e-3)
    D = state.D + params.gain * (slope - state.D)
    real = event.polarity != 0
    return State(state.L + change, jnp.where(real, D, state.D), state.n + jnp.where(real, 1, 0))


def readout(params: Params, state: State) -> tuple[Array, Array]:
    return state.L, 0.01 / (1 + state.n)


trend = Filter(
    "trend", Params, Frames, init, predict, event_update, readout, needs_frames=True,
    about="A filter that predicts slopes.",
)  # fmt: skip
