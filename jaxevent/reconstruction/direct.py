"""Methods that keep no state: what the frames (and the events between them) say, read directly."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxevent.reconstruction.augment import (
    Augmented,
    Blended,
    EventIntegral,
    FrameParams,
    Held,
    Level,
)
from jaxevent.reconstruction.features import FrameFeatures, Points
from jaxevent.reconstruction.filtering import (
    Filter,
    Observation,
    Observer,
    State,
    without_variance,
)


class Direct(Observer):
    """A model of the log intensity, believed at once."""

    level: Level

    def __call__(self, points: Points) -> Observation:
        u = self.level(points)
        return Observation(u, jnp.full_like(u, jnp.inf))


def advance(params: FrameParams, state: State, dt: Array, frame: Observation) -> State:
    return State(frame.level, jnp.broadcast_to(state.P, frame.level.shape))


def _direct(name: str, model: type[Level], about: str, **more: Any) -> Filter:
    def observe(values: Any, frames: FrameFeatures) -> Direct:
        return Direct(model(values, frames))

    return Filter(
        name,
        model.Params,
        observe,
        without_variance,
        advance,
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
    Augmented,
    "The augmented frame of the AKF, read directly: two deblurred frames, and the events between "
    "them with a threshold calibrated for each pixel.",
)
blend = _direct(
    "blend", Blended, "The frames before and after, blended by time; no events.", fuses=False
)
last_frame = _direct("last-frame", Held, "The last frame, held; no events.", fuses=False)
