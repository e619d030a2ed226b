"""Egomotion: the motion of the camera, from events alone, and its known motion.

Estimators, objects of the contract in `jaxevent.estimator`:

- `voting` by particle filters, `batch` by a fit to many events at once, `contrast` of warped
  events, `planes` on the surface of active events, `frames` by optical flow.

Modules that they are built on:

- `models`: motion models, and how they move the image; a new model is one class;
- `motion`: the result of every estimator, a function of time;
- `flow`: the optical flow of events and pixels, once the motion is known;
- `candidates`: earlier neighbours of events, sampled once;
- `geometry`: the flow of a rigid scene, rotations and twists, images of warped events;
- `truth`: the known motion of a recording, from poses, a gyro or a table;
- `scores`: errors of an estimate;
- `patches` and `model_selection`: the speed of the image, and the model that explains it;
- `evidence` and `still`: whether votes support a motion, and whether the camera moves at all;
- `live`: the motion of a stream of events.

Motion is the camera's own twist (T, Omega) in its axes, x to the right, y down, z forward.

    motion = egomotion.voting.estimate(recording, model="rotation", seed=0)
    mean, covariance, valid = motion(times)
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxevent.deprecated import renamed_names

if TYPE_CHECKING:
    from jaxevent.egomotion import candidates, flow, geometry, models, motion, scores, truth
    from jaxevent.egomotion.baselines.contrast import contrast
    from jaxevent.egomotion.baselines.planes import planes
    from jaxevent.egomotion.baselines.points import frames
    from jaxevent.egomotion.bundle.sequence import batch
    from jaxevent.egomotion.estimator import MotionEstimator
    from jaxevent.egomotion.models import MODELS, Model, find_model
    from jaxevent.egomotion.motion import MotionEstimate
    from jaxevent.egomotion.particle_filter.estimator import voting
    from jaxevent.egomotion.scores import motion_errors
    from jaxevent.egomotion.truth import (
        KnownMotion,
        Twists,
        gyro_bias,
        known_motion,
        twists_from_gyro,
        twists_from_poses,
    )

# Loaded when first used: compiled preparation and SciPy are slow to import.
_HOMES = {
    "baselines.contrast": ("contrast",),
    "baselines.planes": ("planes",),
    "baselines.points": ("frames",),
    "bundle.sequence": ("batch",),
    "estimator": ("MotionEstimator",),
    "models": ("MODELS", "Model", "find_model"),
    "motion": ("MotionEstimate",),
    "particle_filter.estimator": ("voting",),
    "scores": ("motion_errors",),
    "truth": (
        "KnownMotion",
        "Twists",
        "twists_from_gyro",
        "twists_from_poses",
        "gyro_bias",
        "known_motion",
    ),
}
_MODULES = ("candidates", "flow", "geometry", "models", "motion", "scores", "truth")
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "MODELS",
    "KnownMotion",
    "Model",
    "MotionEstimate",
    "MotionEstimator",
    "Twists",
    "batch",
    "candidates",
    "contrast",
    "find_model",
    "flow",
    "frames",
    "twists_from_gyro",
    "twists_from_poses",
    "geometry",
    "gyro_bias",
    "known_motion",
    "models",
    "motion",
    "motion_errors",
    "planes",
    "scores",
    "truth",
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
