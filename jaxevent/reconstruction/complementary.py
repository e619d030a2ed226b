"""Complementary and high-pass filters (Scheerlinck et al., ACCV 2018): a constant gain.

Their state is log intensity; no variance is estimated. It is pulled by the last frame (the
original), by the augmented frame ("CF with augmentation", AKF supplement section 2), or by zero
(the high-pass filter: events only, so its images have no absolute brightness).
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.parameters import Positive
from jaxevent.reconstruction.augment import (
    AugmentedFrame,
    AugmentParams,
    FrameParams,
    LogIntensityModel,
    NoFrames,
    ZeroOrderHold,
    event_change,
)
from jaxevent.reconstruction.features import FrameFeatures, Points
from jaxevent.reconstruction.filtering import (
    Event,
    Filter,
    FrameModel,
    Observation,
    PixelState,
    init_without_variance,
)


class Params(FrameParams):
    """Parameters of the complementary and the high-pass filter."""

    alpha: Positive = Positive(15.0, "rad/s", "cut-off frequency")


class AugmentedParams(AugmentParams):
    """Parameters of the complementary filter with augmentation."""

    alpha: Positive = Positive(15.0, "rad/s", "cut-off frequency")


class ConstantRateModel(FrameModel):
    """A model of the log intensity that pulls the state at the rate alpha."""

    level: LogIntensityModel
    alpha: Float[Array, ""]

    def __call__(self, points: Points) -> Observation:
        u = self.level(points)
        return Observation(u, jnp.broadcast_to(self.alpha, u.shape))


def predict(params: FrameParams, state: PixelState, dt: Array, frame: Observation) -> PixelState:
    """Decay towards the frames: L <- L e^(-alpha dt) + u (1 - e^(-alpha dt)).

    Args:
        params: Parameters; not used.
        state: State of a pixel.
        dt: Time without events, s.
        frame: Log intensity u and rate alpha, 1/s.

    Returns:
        The state dt later.
    """
    decay = jnp.exp(-frame.rate * dt)
    return PixelState(state.L * decay + frame.level * (1 - decay), state.P)


def event_update(params: FrameParams, state: PixelState, event: Event) -> PixelState:
    """Add an event: L <- L + s c.

    Args:
        params: Thresholds.
        state: State just before the event.
        event: The event.

    Returns:
        The state after the event.
    """
    return PixelState(state.L + event_change(params, event.polarity, event.since), state.P)


def _filter(
    name: str, model: type[LogIntensityModel], params: type[FrameParams], about: str, **more: Any
) -> Filter:
    """Make a filter of a model of the log intensity that pulls."""

    def frame_model(values: Any, frames: FrameFeatures) -> ConstantRateModel:
        return ConstantRateModel(model(values, frames), values.alpha)

    return Filter(
        name,
        params,
        frame_model,
        init_without_variance,
        predict,
        event_update,
        has_covariance=False,
        about=f"{about} (Scheerlinck et al., ACCV 2018): a constant gain, no variance.",
        **more,
    )


cf = _filter(
    "cf",
    ZeroOrderHold,
    Params,
    "The complementary filter of events and the last frame",
    needs_frames=True,
)
cf_augmented = _filter(
    "cf-augmented",
    AugmentedFrame,
    AugmentedParams,
    "The complementary filter of events and the augmented frame",
    needs_frames=True,
)
high_pass = _filter(
    "high-pass",
    NoFrames,
    Params,
    "The high-pass filter of events alone, whose images have no absolute brightness",
    fuses=False,
)
