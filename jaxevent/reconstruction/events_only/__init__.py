"""Video from events alone: the motion and the image that the events of a window imply together."""

from jaxevent.reconstruction.events_only.estimator import EventsOnly, events_only
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.video import EventsOnlyVideo

__all__ = ["EventsOnly", "EventsOnlyVideo", "Params", "events_only"]
