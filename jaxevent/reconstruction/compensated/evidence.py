"""Images at single instants: the smoother's, and frames as they are where one was taken."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.estimator import Estimate
from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.features import FrameFeatures
from jaxevent.reconstruction.smoother import FrameMeasurements, Gaussian, Smoother


class Shown(NamedTuple):
    """What frames show at the middle of their exposures."""

    z: Float[Array, "*frames pixels"]  # log intensity
    V: Float[Array, "*frames pixels"]  # its variance
    clear: Float[Array, "*frames pixels"]


@dataclasses.dataclass(frozen=True, repr=False)
class Evidence(Smoother):
    """Reads log intensity L, its variance V, and whether a frame shows the pixel unclipped.

    The smoother believes a frame as its own model of noise does, which is made for integrating
    events. At the middle of an exposure the frame itself says more: L of its pixel with the
    variance (sigma_pixel / (I + I0))^2 + 1e-4, deblurred as far as events tell of the exposure.
    """

    def frame_info(
        self, params: Params, frames: FrameFeatures, measured: FrameMeasurements, events: Any
    ) -> Shown:
        z, V = measured.z, (params.sigma_pixel * measured.slope) ** 2 + 1e-4
        if events is not None:
            blurred = jnp.log(frames.intensity + params.I0)
            change = z - blurred
            # What events tell of an exposure is no better than a threshold and their noise: where
            # the correction is not larger than that, a blurred frame is nearer to the truth.
            error = params.c_on * params.c_off * (0.25 + params.sigma_event**2 * events / 3)
            trust = change**2 / (change**2 + error)
            z, V = blurred + trust * change, V + trust * error
        return Shown(z, V, measured.clear)

    def readout(self, params: Params, state: Gaussian, kept: Shown, here: Array) -> Estimate:
        L = jnp.log(jnp.maximum(jnp.exp(state.m) - params.I0, 0) + params.I0)
        shown = here & (kept.clear > 0.5)
        V = jnp.where(shown, jnp.minimum(state.P, kept.V), state.P)
        return Estimate(jnp.where(shown, kept.z, L), V, shown)
