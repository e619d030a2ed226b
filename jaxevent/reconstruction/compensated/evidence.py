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
    events. At the middle of an exposure the frame itself, deblurred, says more: L of its pixel with
    the variance (sigma_pixel / (I + I0))^2 + 1e-4.
    """

    def run(
        self, params: Params, features: Features, state: Any = None, future: Any = None
    ) -> tuple[Any, Any]:
        passage, state = super().run(params, features, state, future)
        rows, _ = make_rows(params, features.at(params.rho_ref).frames)
        return Passing(passage, rows), state

    def read(self, params: Params, trajectory: Passing, out: ReadOut) -> Estimate:
        passage, rows = trajectory
        image, V, _ = super().read(params, passage, out)
        L = jnp.log(jnp.maximum(image, 0) + params.I0)
        frame, elapsed = jnp.asarray(out.points.frame), jnp.asarray(out.points.elapsed)
        # Times are whole microseconds, the middle of an exposure may lie up to one before.
        here = ((elapsed >= 0) & (elapsed < 1e-6))[:, None] & (rows.clear[frame] > 0.5)
        z: Float[Array, "times pixels"] = rows.z[frame]
        own = (params.sigma_pixel * rows.slope[frame]) ** 2 + 1e-4
        L = jnp.where(here, z, L)
        return Estimate(L, jnp.where(here, jnp.minimum(V, own), V), here)
