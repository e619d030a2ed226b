"""Egomotion: how the camera moved, from events alone, and what is true of it.

- `geometry`: the flow of a rigid scene, residuals of matched events, rotations and twists;
- `truth`: the camera's twist from poses or a gyro, and the errors of an estimate.

All speak of the camera's own twist (T, Omega) in its axes, x to the right, y down, z forward.
"""

from jaxevent.egomotion import geometry, truth
from jaxevent.egomotion.truth import Twists, from_gyro, from_poses, gyro_bias, motion_errors

__all__ = [
    "Twists",
    "from_gyro",
    "from_poses",
    "geometry",
    "gyro_bias",
    "motion_errors",
    "truth",
]
