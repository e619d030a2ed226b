"""Egomotion: how the camera moved, from events alone, and what is true of it.

- `candidates`: of each event its earlier neighbours, prepared once;
- `motion`: what they give, at any time;
- `voting`: planar and rotational motion by a particle filter that they vote in;
- `geometry`: the flow of a rigid scene, residuals of matched events, rotations and twists;
- `truth`: the camera's twist from poses or a gyro, and the errors of an estimate.

All speak of the camera's own twist (T, Omega) in its axes, x to the right, y down, z forward.

    motion = egomotion.estimate(recording, model="rotation", seed=0)
    mean, covariance, lost = motion(times)
"""

from jaxevent.egomotion import geometry, truth, voting
from jaxevent.egomotion.motion import Motion, States
from jaxevent.egomotion.truth import Twists, from_gyro, from_poses, gyro_bias, motion_errors
from jaxevent.egomotion.voting import Params, estimate, prepare

__all__ = [
    "Motion",
    "Params",
    "States",
    "Twists",
    "estimate",
    "from_gyro",
    "from_poses",
    "geometry",
    "gyro_bias",
    "motion_errors",
    "prepare",
    "truth",
    "voting",
]
