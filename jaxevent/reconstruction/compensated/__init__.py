"""Reconstruction that uses motion: images fused along the paths of the scene's points."""

from jaxevent.reconstruction.compensated.estimator import CompensatedVideo, MotionCompensated, mc
from jaxevent.reconstruction.compensated.parameters import Params

__all__ = ["CompensatedVideo", "MotionCompensated", "Params", "mc"]
