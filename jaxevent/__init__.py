"""Differentiable estimators for event cameras: video, tracks and motion from events.

    recording = jaxevent.load("slider_depth.zip")
    video = jaxevent.akf.estimate(recording, jaxevent.akf.Params(c_on=0.08))
    image, variance, valid = video(recording.frames.t)

Every estimator of `METHODS` is used in this way; `help(jaxevent.akf)` describes one. Compiled
programs are kept in the user's cache folder; `jaxevent.cache` says how to change that.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxevent import cache, deprecated, display, threads

if TYPE_CHECKING:
    from jaxevent import (
        blob,
        calibration,
        camera,
        datasets,
        egomotion,
        events,
        metrics,
        register,
        show,
        simulate,
    )
    from jaxevent.calibration import calibrate, check_consistency
    from jaxevent.errors import InputError, InputWarning
    from jaxevent.estimator import Estimate, Estimator
    from jaxevent.event_flow import flow_from_events
    from jaxevent.io import load, save
    from jaxevent.methods import METHODS
    from jaxevent.parameters import Parameters
    from jaxevent.reconstruction import (
        akf,
        aks,
        augmented,
        blend,
        cf,
        cf_augmented,
        colour,
        edi,
        flow,
        high_pass,
        last_frame,
        mc,
    )
    from jaxevent.reconstruction.events_only import events_only
    from jaxevent.recording import Events, Frames, Recording
    from jaxevent.runs.evaluate import evaluate
    from jaxevent.runs.fit import fit
    from jaxevent.tuning import optimise

__version__ = "0.1.0"

# Loaded when first used: the readers and the compiled preparation are slow to import.
_HOMES = {
    "jaxevent.calibration": ("calibrate", "check_consistency"),
    "jaxevent.errors": ("InputError", "InputWarning"),
    "jaxevent.estimator": ("Estimate", "Estimator"),
    "jaxevent.event_flow": ("flow_from_events",),
    "jaxevent.io": ("load", "save"),
    "jaxevent.methods": ("METHODS",),
    "jaxevent.parameters": ("Parameters",),
    "jaxevent.reconstruction": (
        *("akf", "aks", "augmented", "blend", "cf", "cf_augmented", "edi", "high_pass"),
        *("flow", "last_frame", "mc"),
    ),
    "jaxevent.reconstruction.events_only": ("events_only",),
    "jaxevent.recording": ("Events", "Frames", "Recording"),
    "jaxevent.runs.evaluate": ("evaluate",),
    "jaxevent.runs.fit": ("fit",),
    "jaxevent.tuning": ("optimise",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
_MODULES = {
    **{name: name for name in ("blob", "calibration", "camera", "datasets", "egomotion", "events")},
    **{name: name for name in ("metrics", "register", "show", "simulate")},
    "colour": "reconstruction.colour",
}

__all__ = [
    "METHODS",
    "Estimate",
    "Estimator",
    "Events",
    "Frames",
    "InputError",
    "InputWarning",
    "Parameters",
    "Recording",
    "akf",
    "aks",
    "augmented",
    "blend",
    "blob",
    "cache",
    "calibrate",
    "calibration",
    "camera",
    "cf",
    "cf_augmented",
    "check_consistency",
    "colour",
    "datasets",
    "edi",
    "egomotion",
    "evaluate",
    "events",
    "events_only",
    "fit",
    "flow",
    "flow_from_events",
    "high_pass",
    "last_frame",
    "load",
    "mc",
    "metrics",
    "optimise",
    "register",
    "save",
    "show",
    "simulate",
]

cache.keep_compiled()
deprecated.install()
threads.use_synchronous_dispatch()


def _as_html(thing: Any) -> str:
    return importlib.import_module("jaxevent.show.figures").as_html(thing)


display.as_html = _as_html  # imports the module of figures when something is first shown


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"jaxevent.{_MODULES[name]}")
    if name not in _HOME_OF:
        return deprecated.renamed_names(__name__)(name)
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
