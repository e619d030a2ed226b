"""Frames of a separate camera brought onto the event camera's pixels and clock.

    from jaxevent import register

    other = register.read_frames("colour_camera.h5")            # any recording, or a folder
    found = register.estimate(recording, other)                 # distant scene: a homography
    hybrid = register.registered(recording, other, found)       # a recording as any other

    rig = register.Rig.read("rig.toml")                         # or calibrated
    grid = rig.grid((346, 260), (1440, 1080), depth=2.5)
    found = register.estimate(recording, other, grid)           # then only the clock is unknown

    other, found = register.by_triggers(recording, other, found)  # stamps from its triggers

A *grid* (height, width, 2) says at which x, y of the other camera's images each pixel of the event
camera looks, NaN where it does not see the same. Pixel centres are whole numbers. The offset of the
clocks (s) is added to the other camera's time stamps to get times of the events' clock, as
`clock_offset` of the estimators is.

Homographies map places of the event camera to places of the other one, [u, v, w] = H [x, y, 1].
Both are of images whose distortion has been undone where the camera's calibration tells it.

The images of two pin-hole cameras are related by a homography if the scene is far away, or a plane:
what is nearer than the baseline times the focal length (px) is off by more than one pixel.
"""

from jaxevent.register.clocks import clock_offsets
from jaxevent.register.estimation import estimate
from jaxevent.register.frames import read_frames
from jaxevent.register.geometry import Grid, homography_grid, read_depth, read_homography, seen
from jaxevent.register.refinement import Registration, refine
from jaxevent.register.rig import Rig
from jaxevent.register.still import register_still
from jaxevent.register.triggers import by_triggers, match_triggers, trigger_times
from jaxevent.register.warp import Warped, registered

__all__ = [
    "Grid",
    "Registration",
    "Rig",
    "Warped",
    "by_triggers",
    "clock_offsets",
    "estimate",
    "homography_grid",
    "match_triggers",
    "read_depth",
    "read_frames",
    "read_homography",
    "refine",
    "register_still",
    "registered",
    "seen",
    "trigger_times",
]
