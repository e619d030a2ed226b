"""Images at single instants: the smoother's, and frames as they are where one was taken."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.estimator import Estimate
from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.features import Features, ReadOut
from jaxevent.reconstruction.smoother import Passage, Rows, Smoother, make_rows


class Passing(NamedTuple):
    """A smoothed window, and its frames as measurements."""

    passage: Passage
    rows: Rows
    z: Float[Array, "frames pixels"]  # log intensity at the middle of exposures
    V: Float[Array, "frames pixels"]  # its variance

    @property
    def link(self) -> Any:
        return self.passage.link

    @property
    def last(self) -> Any:
        return self.passage.last


@dataclasses.dataclass(frozen=True, repr=False)
class Evidence(Smoother):
    """Reads log intensity L, its variance V, and whether a frame shows the pixel unclipped.

    The smoother believes a frame as its own model of noise does, which is made for integrating
    events. At the middle of an exposure the frame itself says more: L of its pixel with the
    variance (sigma_pixel / (I + I0))^2 + 1e-4, deblurred as far as events tell of the exposure.
    """

    def run(
        self, params: Params, features: Features, state: Any = None, future: Any = None
    ) -> tuple[Any, Any]:
        passage, state = super().run(params, features, state, future)
        frames = features.at(params.rho_ref).frames
        rows, _ = make_rows(params, frames)
        z, V = rows.z, (params.sigma_pixel * rows.slope) ** 2 + 1e-4
        if frames.head is not None and frames.tail is not None:
            blurred = jnp.log(frames.intensity + params.I0)
            change = rows.z - blurred
            # What events tell of an exposure is no better than a threshold and their noise: where
            # the correction is not larger than that, a blurred frame is nearer to the truth.
            events = (frames.head + frames.tail).sum(0)
            error = params.c_on * params.c_off * (0.25 + params.sigma_event**2 * events / 3)
            trust = change**2 / (change**2 + error)
            z, V = blurred + trust * change, V + trust * error
        return Passing(passage, rows, z, V), state

    def read(self, params: Params, trajectory: Passing, out: ReadOut) -> Estimate:
        passage, rows = trajectory.passage, trajectory.rows
        image, V, _ = super().read(params, passage, out)
        L = jnp.log(jnp.maximum(image, 0) + params.I0)
        frame, elapsed = jnp.asarray(out.points.frame), jnp.asarray(out.points.elapsed)
        # Times are whole microseconds, the middle of an exposure may lie up to one before.
        here = ((elapsed >= 0) & (elapsed < 1e-6))[:, None] & (rows.clear[frame] > 0.5)
        L = jnp.where(here, trajectory.z[frame], L)
        own = trajectory.V[frame]
        return Estimate(L, jnp.where(here, jnp.minimum(V, own), V), here)
