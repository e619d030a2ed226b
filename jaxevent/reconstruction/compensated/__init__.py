"""Reconstruction that uses motion: images fused along the paths of the scene's points."""

import dataclasses

from jaxevent.reconstruction.compensated.estimator import CompensatedVideo, MotionCompensated, mc
from jaxevent.reconstruction.compensated.parameters import Params

__all__ = ["CompensatedVideo", "MotionCompensated", "Params", "mc", "mc_through_motion"]

# The same images, for fits whose derivatives go through the motion.
mc_through_motion = dataclasses.replace(mc, through_motion=True)
