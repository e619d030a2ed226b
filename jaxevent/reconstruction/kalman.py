"""The asynchronous Kalman filter (Wang et al., ICCV 2021), equations corrected.

Per pixel: the state is the log intensity L with variance P. Events move L by their threshold and
add noise Q; between events the augmented frame L^A, believed with variance density R, pulls L.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.parameters import Positive
from jaxevent.reconstruction.augment import (
    Augmented,
    AugmentParams,
    BetweenFrames,
    brightness,
    intensity,
)
from jaxevent.reconstruction.estimator import Estimator, Event, Observation, Observer, State
from jaxevent.reconstruction.pixels import FrameFeatures, Points


class Params(AugmentParams):
    """Parameters of the AKF; defaults of the paper, section 6."""

    sigma_proc = Positive(5e-4**0.5, "ln I / sqrt(s)", "process noise, per time since last event")
    sigma_iso = Positive(0.03**0.5, "ln I / sqrt(s)", "isolated noise, per time since neighbours")
    sigma_ref = Positive(0.01**0.5, "ln I", "noise of events within rho of the last one")
    rho = Positive(0.01, "s", "bound on the refractory period")
    kappa = Positive(7e5, "1 / (intensity^2 s)", "certainty of frames: 7e5 DAVIS, 7e7 FLIR")
    w_min = Positive(0.09, "1", "least certainty, of dark and saturated pixels, as part of kappa")
    P0 = Positive(0.09, "(ln I)^2", "variance at the start")

    def __init__(self, **values: Any):
        super().__init__(**values)


class Augmentation(Observer):
    """L^A, and 1/R with R = Rbar / (I + I0)^2, Rbar and I linear between frames (4), (5), (7).

    Paper (4) writes sigma_im^2 = 7e5 as a multiplier; it is the reciprocal of the density.
    Paper (7) prints a factor 2 in the denominator; Var ln(I + I0) = Var I / (I + I0)^2.
    """

    level: Augmented
    image: BetweenFrames
    density: BetweenFrames
    I0: Float[Array, ""]
    present: Float[Array, ""]

    def __init__(self, params: Params, frames: FrameFeatures):
        w = params.response.certainty(jnp.asarray(frames.grey))
        Rbar = 1 / (params.kappa * jnp.maximum(w, params.w_min))
        self.level = Augmented(params, frames)
        self.image = BetweenFrames(params, frames, intensity(params, frames))
        self.density = BetweenFrames(params, frames, Rbar)
        self.I0, self.present = params.I0, jnp.asarray(frames.present)

    def __call__(self, points: Points) -> Observation:
        rate = self.present * (self.image(points) + self.I0) ** 2 / self.density(points)
        return Observation(self.level(points), rate)


def initial(params: Params, level: Array) -> State:
    return State(level, jnp.broadcast_to(params.P0, level.shape))


def advance(params: Params, state: State, dt: Array, frame: Observation) -> State:
    """Towards the augmented frame over dt: (18) and (16).

    The line before (17) of the paper must read P' = -P^2 / R + Q.
    """
    gain = 1 / (1 + state.P * dt * frame.rate)
    return State((state.L - frame.level) * gain + frame.level, state.P * gain)


def noise(params: Params, event: Event) -> Array:
    """Q of an event (2): process, isolated-pixel and refractory-period noise."""
    Q_proc = params.sigma_proc**2 * event.since
    Q_iso = params.sigma_iso**2 * event.near
    Q_ref = jnp.where(event.since <= params.rho, params.sigma_ref**2, 0)
    return Q_proc + Q_iso + Q_ref


def jump(params: Params, state: State, event: Event) -> State:
    """At an event: L moves by the nominal threshold (14), P grows by Q (19)."""
    L = state.L + brightness(params, event.polarity > 0, event.polarity < 0)
    return State(L, state.P + jnp.where(event.polarity == 0, 0, noise(params, event)))


akf = Estimator("akf", Params, Augmentation, initial, advance, jump, needs_frames=False)
