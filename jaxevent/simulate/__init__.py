"""Recordings with known truth: events and frames of HDR scenes, or of ordinary video.

panorama = jaxevent.simulate.scene("lake")
recording = jaxevent.simulate.simulate(jaxevent.simulate.Pan(panorama, speed="fast"))
recording.extra["hdr"], recording.extra["hdr_t"]  # the truth, and when
"""

from jaxevent.simulate.hybrid import SENSORS, Sensor, simulate
from jaxevent.simulate.scenes import FITTING, SCENES, TESTING, Pan, Source, scene
from jaxevent.simulate.video import Clip, from_video

__all__ = [
    "FITTING",
    "SCENES",
    "SENSORS",
    "TESTING",
    "Clip",
    "Pan",
    "Sensor",
    "Source",
    "from_video",
    "scene",
    "simulate",
]
