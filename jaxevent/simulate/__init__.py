"""Recordings with known truth: events and frames of HDR scenes, or of ordinary video.

panorama = jaxevent.simulate.scene("lake")
recording = jaxevent.simulate.simulate(jaxevent.simulate.Pan(panorama, speed="fast"))
recording.extra["hdr"], recording.extra["hdr_t"]  # the truth, and when

Moving blobs, discs and lights, events only:

recording, truth = jaxevent.simulate.blob_scene("lissajous")
truth(recording.events.t)  # the state of every target at every event
"""

from jaxevent.simulate.blobs import (
    BLOB_SCENES,
    Approach,
    Circle,
    Line,
    Lissajous,
    Motion,
    RandomWalk,
    Target,
    Truth,
    blob_scene,
    simulate_blobs,
)
from jaxevent.simulate.hybrid import SENSORS, Sensor, simulate
from jaxevent.simulate.scenes import FITTING, SCENES, TESTING, Pan, Source, scene
from jaxevent.simulate.video import Clip, from_video

__all__ = [
    "BLOB_SCENES",
    "FITTING",
    "SCENES",
    "SENSORS",
    "TESTING",
    "Approach",
    "Circle",
    "Clip",
    "Line",
    "Lissajous",
    "Motion",
    "Pan",
    "RandomWalk",
    "Sensor",
    "Source",
    "Target",
    "Truth",
    "blob_scene",
    "from_video",
    "scene",
    "simulate",
    "simulate_blobs",
]
