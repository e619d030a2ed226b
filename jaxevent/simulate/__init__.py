"""Simulated recordings with known truth: events and frames of HDR scenes, or of ordinary video.

    panorama = jaxevent.simulate.scene("lake")
    recording = jaxevent.simulate.simulate(jaxevent.simulate.Pan(panorama, speed="fast"))
    recording.extra["hdr"], recording.extra["hdr_t"]  # the truth, and when

Objects that move on their own, with the true optical flow of every pixel:

    objects = jaxevent.simulate.MovingObjects(speed=90, seed=1)
    recording = jaxevent.simulate.simulate(objects)
    objects.flow(0.2)  # (height, width, 2), px/s

Moving blobs, discs and lights, events only:

    recording, truth = jaxevent.simulate.blob_scene("lissajous")
    truth(recording.events.t)  # the state of every target at every event

A camera that moves in a rigid world:

    recording, truth = jaxevent.simulate.motion_scene("texture", motion="varying")
    truth.twist(recording.events.t)  # T and Omega of the camera at every event

Recordings with faults, made of any others:

    faulty = jaxevent.simulate.faults.randomise_polarity(recording, seed=1)
"""

from jaxevent.deprecated import renamed_names
from jaxevent.simulate import faults
from jaxevent.simulate.blobs import (
    BLOB_SCENES,
    ApproachMotion,
    BlobTruth,
    CircularMotion,
    LinearMotion,
    LissajousMotion,
    RandomWalk,
    Target,
    TargetMotion,
    blob_scene,
    simulate_blobs,
)
from jaxevent.simulate.hybrid import SENSORS, Sensor, simulate
from jaxevent.simulate.motion import (
    MOTION_SCENES,
    BoxWorld,
    CameraMotion,
    FlatPatch,
    MovingCamera,
    Texture,
    make_texture,
    motion_scene,
    planar_motion,
    simulate_frame_events,
    simulate_motion,
)
from jaxevent.simulate.scenes import (
    FITTING_SCENES,
    SCENES,
    TESTING_SCENES,
    IntensitySource,
    MovingObjects,
    Pan,
    scene,
)
from jaxevent.simulate.video import VideoClip, from_video

__all__ = [
    "BLOB_SCENES",
    "FITTING_SCENES",
    "MOTION_SCENES",
    "SCENES",
    "SENSORS",
    "TESTING_SCENES",
    "ApproachMotion",
    "CameraMotion",
    "CircularMotion",
    "VideoClip",
    "LinearMotion",
    "LissajousMotion",
    "MovingCamera",
    "MovingObjects",
    "Pan",
    "FlatPatch",
    "RandomWalk",
    "Sensor",
    "IntensitySource",
    "Target",
    "TargetMotion",
    "Texture",
    "BlobTruth",
    "BoxWorld",
    "blob_scene",
    "faults",
    "simulate_frame_events",
    "from_video",
    "make_texture",
    "motion_scene",
    "planar_motion",
    "scene",
    "simulate",
    "simulate_blobs",
    "simulate_motion",
]
__getattr__ = renamed_names(__name__)
