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
from jaxevent.reconstruction.filtering import (
    Filter,
    Observation,
    Observer,
    State,
    without_variance,
)
from jaxevent.reconstruction.pixels import FrameFeatures, Points


class Direct(Observer):
    """A model of the log intensity, believed at once."""

    level: Level

    def __call__(self, points: Points) -> Observation:
        u = self.level(points)
        return Observation(u, jnp.full_like(u, jnp.inf))


def advance(params: FrameParams, state: State, dt: Array, frame: Observation) -> State:
    return State(frame.level, jnp.broadcast_to(state.P, frame.level.shape))


def _direct(name: str, model: type[Level]) -> Filter:
    def observe(values: Any, frames: FrameFeatures) -> Direct:
        return Direct(model(values, frames))

    return Filter(
        name, model.Params, observe, without_variance, advance,
        needs_frames=True, has_covariance=False,
    )  # fmt: skip


edi = _direct("edi", EventIntegral)
augmented = _direct("augmented", Augmented)
blend = _direct("blend", Blended)
last_frame = _direct("last-frame", Held)
