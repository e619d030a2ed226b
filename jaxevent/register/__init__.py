"""Frames of a separate camera brought onto the event camera's pixels and clock.

    from jaxevent import register

    other = register.read_frames("colour_camera.h5")            # any recording, or a folder
    found = register.estimate(recording, other)                 # distant scene: a homography
    hybrid = register.apply_registration(recording, other, found)       # a recording as any other

    rig = register.Rig.read("rig.toml")                         # or calibrated
    grid = rig.grid((346, 260), (1440, 1080), depth=2.5)
    found = register.estimate(recording, other, grid)           # then only the clock is unknown

    other, found = register.stamp_by_triggers(recording, other, found)  # stamps from its triggers

A *grid* (height, width, 2) holds for each pixel of the event camera the x, y in the other camera's
images, NaN where that does not see the same. Pixel centres are whole numbers. The offset of the
clocks (s) is added to the other camera's time stamps to get times of the events' clock, as
`clock_offset` of the estimators is.

Homographies map positions in the event camera to those in the other one, [u, v, w] = H [x, y, 1].
Both are of images whose distortion has been undone if the camera's calibration is known.

The images of two pin-hole cameras are related by a homography if the scene is far away, or a plane:
points nearer than the baseline times the focal length (px) are off by more than one pixel.
"""

from jaxevent.deprecated import renamed_names
from jaxevent.register.clocks import (
    clock_offsets,
    match_triggers,
    stamp_by_triggers,
    trigger_times,
)
from jaxevent.register.estimation import estimate
from jaxevent.register.features import register_still
from jaxevent.register.frames import ResampledImages, apply_registration, read_frames
from jaxevent.register.geometry import (
    Grid,
    Registration,
    coverage,
    homography_grid,
    read_depth,
    read_homography,
)
from jaxevent.register.refinement import refine
from jaxevent.register.rig import Rig

__all__ = [
    "Grid",
    "Registration",
    "ResampledImages",
    "Rig",
    "apply_registration",
    "clock_offsets",
    "coverage",
    "estimate",
    "homography_grid",
    "match_triggers",
    "read_depth",
    "read_frames",
    "read_homography",
    "refine",
    "register_still",
    "stamp_by_triggers",
    "trigger_times",
]

__getattr__ = renamed_names(__name__)
