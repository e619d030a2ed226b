"""Complementary and high-pass filters (Scheerlinck et al., ACCV 2018): a constant gain.

Their state is log intensity; no variance is estimated. What pulls it is the last frame (the
original), the augmented frame ("CF with augmentation", AKF supplement section 2), or nothing (the
high-pass filter: events only, so its images have no absolute brightness).
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.parameters import Positive
from jaxevent.reconstruction.augment import (
    Augmented,
    AugmentParams,
    FrameParams,
    Held,
    Level,
    Nothing,
    event_change,
)
from jaxevent.reconstruction.features import FrameFeatures, Points
from jaxevent.reconstruction.filtering import (
    Event,
    Filter,
    Observation,
    Observer,
    State,
    without_variance,
)


class Params(FrameParams):
    """Parameters of the complementary and the high-pass filter."""

    alpha = Positive(15.0, "rad/s", "cut-off frequency")


class AugmentedParams(AugmentParams):
    """Parameters of the complementary filter with augmentation."""

    alpha = Positive(15.0, "rad/s", "cut-off frequency")


class Pull(Observer):
    """A model of the log intensity, believed at the rate alpha."""

    level: Level
    alpha: Float[Array, ""]

    def __call__(self, points: Points) -> Observation:
        u = self.level(points)
        return Observation(u, jnp.broadcast_to(self.alpha, u.shape))


def advance(params: FrameParams, state: State, dt: Array, frame: Observation) -> State:
    """L <- L e^(-alpha dt) + u (1 - e^(-alpha dt))."""
    decay = jnp.exp(-frame.rate * dt)
    return State(state.L * decay + frame.level * (1 - decay), state.P)


def jump(params: FrameParams, state: State, event: Event) -> State:
    """L <- L + s c."""
    return State(state.L + event_change(params, event.polarity, event.since), state.P)


def _filter(
    name: str, model: type[Level], params: type[FrameParams], about: str, **more: Any
) -> Filter:
    def observe(values: Any, frames: FrameFeatures) -> Pull:
        return Pull(model(values, frames), values.alpha)

    return Filter(
        name,
        params,
        observe,
        without_variance,
        advance,
        jump,
        has_covariance=False,
        about=f"{about} (Scheerlinck et al., ACCV 2018): a constant gain, no variance.",
        **more,
    )


cf = _filter(
    "cf", Held, Params, "The complementary filter of events and the last frame", needs_frames=True
)
cf_augmented = _filter(
    "cf-augmented",
    Augmented,
    AugmentedParams,
    "The complementary filter of events and the augmented frame",
    needs_frames=True,
)
high_pass = _filter(
    "high-pass",
    Nothing,
    Params,
    "The high-pass filter of events alone, whose images have no absolute brightness",
    fuses=False,
)
