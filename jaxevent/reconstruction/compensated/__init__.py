"""Reconstruction that uses motion: images fused along the paths of the scene's points."""

import dataclasses

from jaxevent.deprecated import renamed_names
from jaxevent.reconstruction.compensated.estimator import CompensatedVideo, MotionCompensation, mc
from jaxevent.reconstruction.compensated.params import Params

__all__ = ["CompensatedVideo", "MotionCompensation", "Params", "mc", "mc_through_motion"]

# The same images, for fits whose derivatives go through the motion.
mc_through_motion = dataclasses.replace(mc, through_motion=True)
__getattr__ = renamed_names(__name__)
