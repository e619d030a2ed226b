"""Differentiable estimators for event cameras: reconstruction of HDR video from events and frames.

recording = jaxevent.load("slider_depth.zip")
video = jaxevent.akf.estimate(recording, jaxevent.akf.Params(c_on=0.08))
image, variance, valid = video(recording.frames.t)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxevent import blob, camera, egomotion, metrics, register, simulate
    from jaxevent.errors import InputError
    from jaxevent.estimator import Estimate, Estimator
    from jaxevent.io import load, save
    from jaxevent.methods import METHODS
    from jaxevent.reconstruction import (
        akf,
        aks,
        augmented,
        blend,
        cf,
        cf_augmented,
        colour,
        edi,
        high_pass,
        last_frame,
    )
    from jaxevent.recording import Events, Frames, Recording
    from jaxevent.runs import fit

__version__ = "0.1.0"

# Loaded when first used: the readers and the compiled preparation are slow to import.
_HOME = {
    "jaxevent.errors": ("InputError",),
    "jaxevent.io": ("load", "save"),
    "jaxevent.recording": ("Events", "Frames", "Recording"),
    "jaxevent.estimator": ("Estimate", "Estimator"),
    "jaxevent.methods": ("METHODS",),
    "jaxevent.reconstruction": (
        "akf",
        "aks",
        "augmented",
        "blend",
        "cf",
        "cf_augmented",
        "edi",
        "high_pass",
        "last_frame",
    ),
}
_MODULES = {
    **{name: name for name in ("blob", "camera", "egomotion", "metrics", "register", "simulate")},
    "colour": "reconstruction.colour",
    "fit": "runs.fit",
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "METHODS",
    "Estimate",
    "Estimator",
    "Events",
    "Frames",
    "InputError",
    "Recording",
    "akf",
    "aks",
    "augmented",
    "blend",
    "blob",
    "camera",
    "cf",
    "cf_augmented",
    "colour",
    "edi",
    "egomotion",
    "fit",
    "high_pass",
    "last_frame",
    "load",
    "metrics",
    "register",
    "save",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"jaxevent.{_MODULES[name]}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxevent' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
