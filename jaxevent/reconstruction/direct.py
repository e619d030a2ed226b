"""Methods without a state: the log intensity of a model of frames, and perhaps of events, alone."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxevent.reconstruction.augment import (
    AugmentedFrame,
    EventIntegral,
    FrameParams,
    LinearBlend,
    LogIntensityModel,
    ZeroOrderHold,
)
from jaxevent.reconstruction.features import FrameFeatures, Points
from jaxevent.reconstruction.filtering import (
    Filter,
    FrameModel,
    Observation,
    PixelState,
    init_without_variance,
)


class DirectFrameModel(FrameModel):
    """A model of the log intensity that is taken at once."""

    level: LogIntensityModel

    def __call__(self, points: Points) -> Observation:
        u = self.level(points)
        return Observation(u, jnp.full_like(u, jnp.inf))


def predict(params: FrameParams, state: PixelState, dt: Array, frame: Observation) -> PixelState:
    """Take the log intensity of the frames.

    Args:
        params: Parameters; not used.
        state: State of a pixel, of which the variance is kept.
        dt: Time, s; not used.
        frame: Log intensity of the frames.

    Returns:
        The state.
    """
    return PixelState(frame.level, jnp.broadcast_to(state.P, frame.level.shape))


def _direct(name: str, model: type[LogIntensityModel], about: str, **more: Any) -> Filter:
    """Make a method of a model of the log intensity."""

    def frame_model(values: Any, frames: FrameFeatures) -> DirectFrameModel:
        return DirectFrameModel(model(values, frames))

    return Filter(
        name,
        model.Params,
        frame_model,
        init_without_variance,
        predict,
        needs_frames=True,
        has_covariance=False,
        about=about,
        **more,
    )


edi = _direct(
    "edi",
    EventIntegral,
    "The event double integral (Pan et al., CVPR 2019): the nearest frame, deblurred, and the "
    "events since.",
)
augmented = _direct(
    "augmented",
    AugmentedFrame,
    "The augmented frame of the AKF, read directly: two deblurred frames, and the events between "
    "them with a threshold calibrated for each pixel.",
)
blend = _direct(
    "blend", LinearBlend, "The frames before and after, blended by time; no events.", fuses=False
)
last_frame = _direct("last-frame", ZeroOrderHold, "The last frame, held; no events.", fuses=False)
