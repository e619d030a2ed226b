"""Egomotion: how the camera moved, from events alone, and what is true of it.

Estimators, objects of the contract in `jaxevent.estimator`:

- `voting` by particle filters, `batch` by a fit to many events at once, `contrast` of warped
  events, `planes` on the surface of active events, `frames` by optical flow.

And what they stand on:

- `models`: what moves, and how that moves the image; a model of one's own is one class;
- `motion`: what every estimator gives, at any time;
- `flow`: the optical flow of each event, once the motion is known; `field`: that of each pixel;
- `candidates`: of each event its earlier neighbours, prepared once;
- `geometry`: the flow of a rigid scene, residuals of matched events, rotations and twists;
- `twists`: the camera's twist from poses or a gyro; `truth`: what is true of a recording's motion;
  `scores`: the errors of an estimate.

All speak of the camera's own twist (T, Omega) in its axes, x to the right, y down, z forward.

    motion = egomotion.voting.estimate(recording, model="rotation", seed=0)
    mean, covariance, valid = motion(times)
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxevent.deprecated import renamed_names

if TYPE_CHECKING:
    from jaxevent.egomotion import (
        candidates,
        field,
        flow,
        geometry,
        models,
        motion,
        scores,
        truth,
        twists,
    )
    from jaxevent.egomotion.baselines.contrast_maximisation import contrast
    from jaxevent.egomotion.baselines.local_planes import planes
    from jaxevent.egomotion.baselines.tracked_points import frames
    from jaxevent.egomotion.bundle.sequence import batch
    from jaxevent.egomotion.estimator import MotionEstimator
    from jaxevent.egomotion.models import MODELS, Model, find_model
    from jaxevent.egomotion.motion import Motion
    from jaxevent.egomotion.particle_filter.estimator import voting
    from jaxevent.egomotion.scores import motion_errors
    from jaxevent.egomotion.truth import Known
    from jaxevent.egomotion.twists import Twists, from_gyro, from_poses, gyro_bias

# Loaded when first used: compiled preparation and SciPy are slow to import.
_HOMES = {
    "bundle.sequence": ("batch",),
    "baselines.contrast_maximisation": ("contrast",),
    "baselines.local_planes": ("planes",),
    "baselines.tracked_points": ("frames",),
    "estimator": ("MotionEstimator",),
    "models": ("MODELS", "Model", "find_model"),
    "motion": ("Motion",),
    "particle_filter.estimator": ("voting",),
    "scores": ("motion_errors",),
    "truth": ("Known",),
    "twists": ("Twists", "from_gyro", "from_poses", "gyro_bias"),
}
_MODULES = (
    "candidates", "field", "flow", "geometry", "models", "motion", "scores", "truth", "twists",
)  # fmt: skip
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "MODELS",
    "Known",
    "Model",
    "Motion",
    "MotionEstimator",
    "Twists",
    "batch",
    "candidates",
    "contrast",
    "find_model",
    "field",
    "flow",
    "frames",
    "from_gyro",
    "from_poses",
    "geometry",
    "gyro_bias",
    "models",
    "motion",
    "motion_errors",
    "planes",
    "scores",
    "truth",
    "twists",
    "voting",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME_OF:
        return renamed_names(__name__)(name)
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
