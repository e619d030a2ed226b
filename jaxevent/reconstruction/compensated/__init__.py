"""Reconstruction that uses motion: images fused along the paths of the scene's points."""

from jaxevent.deprecated import renamed_names
from jaxevent.reconstruction.compensated.estimator import CompensatedVideo, MotionCompensation, mc
from jaxevent.reconstruction.compensated.params import Params

__all__ = ["CompensatedVideo", "MotionCompensation", "Params", "mc"]

__getattr__ = renamed_names(__name__)
