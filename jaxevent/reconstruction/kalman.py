"""The asynchronous Kalman filter (Wang et al., ICCV 2021), equations corrected.

The state of a pixel is the log intensity L with variance P. Events move L by their threshold and
add noise Q. Between events the augmented frame L^A, of variance density R, pulls L.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.parameters import Choice, Number, Positive
from jaxevent.reconstruction.augment import (
    AugmentedFrame,
    AugmentParams,
    FrameInterpolation,
    certainty,
    clipped_side,
    clipping_bound,
    effective_certainty,
    event_change,
    expected_excess,
    frame_information,
    measured_share,
)
from jaxevent.reconstruction.features import FrameFeatures, ImagePoints, Points
from jaxevent.reconstruction.filtering import Event, Filter, FrameModel, Observation, PixelState
from jaxevent.reconstruction.variance import ERROR_PARAMETERS, AugmentedFrameErrors


class Params(AugmentParams):
    """Parameters of the AKF."""

    sigma_proc: Positive = Positive(
        5e-4**0.5, "ln I / sqrt(s)", "process noise, per time since last event"
    )
    sigma_iso: Positive = Positive(
        0.03**0.5, "ln I / sqrt(s)", "isolated noise, per time since neighbours"
    )
    sigma_ref: Positive = Positive(0.01**0.5, "ln I", "noise of events within rho of the last one")
    rho: Positive = Positive(0.01, "s", "bound on the refractory period")
    rho_width: Positive = Positive(0.0, "1", "width in ln time of the step at rho; 0: a sharp step")
    kappa: Positive = Positive(
        7e5, "1 / (intensity^2 s)", "certainty of frames: 7e5 DAVIS, 7e7 FLIR", least=1e-12
    )
    log_bias: Number = Number(
        0.0,
        "Hz",
        "added to ln I of frames for noise (6): the frame rate; -1 as the paper prints it",
    )
    P0: Positive = Positive(0.09, "(ln I)^2", "variance at the start")
    above: Number = Number(
        0.0, "ln I", "initial distance of saturated pixels above the clipping bound"
    )
    below: Number = Number(0.0, "ln I", "initial distance of black pixels below the clipping bound")
    one_sided: Choice = Choice(
        (False, True), "use clipped frames as evidence that L lies beyond the clip"
    )
    clip_rate: Positive = Positive(
        1000.0, "1 / ((ln I)^2 s)", "1/R of clipped frames, if one-sided"
    )
    frame_noise: Positive = ERROR_PARAMETERS[0]
    error_event: Positive = ERROR_PARAMETERS[1]
    error_still: Positive = ERROR_PARAMETERS[2]
    error_change: Positive = ERROR_PARAMETERS[3]

    presets = {
        "paper": {"ratio_width": 0.0},
        "hdr": {
            "c_on": 0.2,
            "c_off": 0.2,
            "I0": 0.003,
            "w_min": 1e-6,
            "margin": 2.5,
            "calibrate": False,
            "weighting": "certainty",
            "sigma_proc": 0.36,
            "sigma_iso": 0.16,
            "sigma_ref": 0.16,
            "rho": 0.1,
            "kappa": 4.8e4,
            "P0": 1.5,
            "clip_rate": 160.0,
            "above": 0.7,
            "below": 0.8,
            "one_sided": True,
        },
    }

    calibrated = ("clock_offset", "event_delay", "c_on", "c_off")

    @classmethod
    def predictor(cls) -> Filter:
        return akf

    def names_without_gradient(self) -> dict[str, str]:
        found = super().names_without_gradient()
        if not float(self.rho_width) > 0:
            found["rho"] = "is compared with while rho_width is 0; start with rho_width above 0"
        return found


MAX_LOG_BIAS = 0.5  # ln I; the expansion holds for small noise


def noise_bias(params: Params, frames: FrameFeatures) -> Float[Array, "frames pixels"]:
    """Return the correction of the log intensity of frames for noise, (6).

    It is `log_bias` Rbar / (2 (I + I0)^2). Of a noisy I with the variance V the log is too low by
    V / (2 (I + I0)^2) on average, to second order; V is the density Rbar times the frame rate. (6)
    subtracts Rbar / (2 (I + I0)^2) "to compensate", which doubles what it means to undo.

    Args:
        params: `log_bias`, Hz, `kappa` and the parameters of the certainty.
        frames: The frames.

    Returns:
        (frames, pixels), ln I, at most `MAX_LOG_BIAS` in size.
    """
    Rbar = 1 / (params.kappa * effective_certainty(params, frames))
    bias = params.log_bias * Rbar / (2 * (jnp.asarray(frames.intensity) + params.I0) ** 2)
    return jnp.asarray(frames.present) * jnp.clip(bias, -MAX_LOG_BIAS, MAX_LOG_BIAS)


class AugmentedFrameModel(FrameModel):
    """L^A with 1/R, R = Rbar / (I + I0)^2, Rbar and I linear between frames (4), (5), (7).

    Paper (4) writes sigma_im^2 = 7e5 as a multiplier; it is the reciprocal of the density.
    Paper (7) prints a factor 2 in the denominator; Var ln(I + I0) = Var I / (I + I0)^2.
    Weighted by certainty, 1/R is linear between frames: where one frame is clipped, the other one's
    certainty fades over the gap instead of vanishing at its beginning.
    """

    level: AugmentedFrame
    image: FrameInterpolation | None
    density: FrameInterpolation
    share: FrameInterpolation | None  # of the rate, where frames clip
    I0: Float[Array, ""]  # offset of intensity, as in ln(I + I0)
    present: Float[Array, ""]  # 1, or 0 if the recording has no frames
    clipped: Float[Array, "frames pixels"]  # 1 where the frame is clipped, else 0
    begin: Float[Array, "frames pixels"]  # state of a clipped pixel at the start, ln I
    bound: Float[Array, "frames pixels"] | None  # as in `Observation`
    push: Float[Array, "frames pixels"] | None
    excess: Float[Array, "frames pixels"] | None
    errors: AugmentedFrameErrors

    def __init__(self, params: Params, frames: FrameFeatures):
        self.level = AugmentedFrame(params, frames, noise_bias(params, frames))
        self.I0, self.present = params.I0, jnp.asarray(frames.present)
        self.share = None
        if params.weighting == "certainty":
            self.image = None
            trust = params.kappa * frame_information(params, frames)
            self.density = FrameInterpolation(params, frames, trust)
        else:
            Rbar = 1 / (params.kappa * effective_certainty(params, frames))
            share = measured_share(params, frames)
            if share is not None:
                Rbar = 1 / (params.kappa * certainty(params, frames))
                self.share = FrameInterpolation(params, frames, share)
            self.image = FrameInterpolation(params, frames, jnp.asarray(frames.intensity))
            self.density = FrameInterpolation(params, frames, Rbar)
        side = clipped_side(params, frames)
        # A clipped value gives its side alone: dark ones differ by the rounding of noise.
        edge = clipping_bound(params, frames)
        self.clipped = abs(side)
        above, expected = params.above, expected_excess(params, frames)
        if expected is not None:
            above = jnp.where(params.margin > 0, above, expected)
        self.begin = edge + jnp.where(side > 0, above, -params.below)
        self.errors = AugmentedFrameErrors(params, frames)
        self.bound = self.push = self.excess = None
        if expected is not None:
            self.excess = jnp.broadcast_to(expected, edge.shape)
        if params.one_sided or expected is not None:
            # Both frames of a gap are needed: where one is not clipped, events show when it began.
            following = jnp.roll(side, -1, axis=0)
            both = jnp.where(side * following > 0, jnp.minimum(abs(side), abs(following)), 0)
            self.bound = edge
            self.push = params.clip_rate * jnp.sign(side) * both

    def __call__(self, points: Points) -> Observation:
        if self.image is None:
            rate = self.present * self.density(points)
        else:
            rate = self.present * (self.image(points) + self.I0) ** 2 / self.density(points)
            if self.share is not None:
                rate = rate * self.share(points)
        bound = push = excess = variance = None
        if self.bound is not None and self.push is not None:
            bound = points.gather_frame(self.bound)
            push = self.present * points.gather_frame(self.push)
        if self.excess is not None:
            excess = points.gather_frame(self.excess)
        if isinstance(points, ImagePoints):
            variance = self.present * self.errors(points)
        return Observation(self.level(points), rate, bound, push, excess, variance)

    def initial_level(self, points: Points) -> Array:
        level = self.level(points)
        return level + points.gather_frame(self.clipped) * (points.gather_frame(self.begin) - level)


def init(params: Params, level: Array) -> PixelState:
    """Return the state at the recording's start.

    Args:
        params: Variance `P0`, (ln I)^2.
        level: Log intensity of the frames, ln I.

    Returns:
        The state.
    """
    return PixelState(level, jnp.broadcast_to(params.P0, level.shape))


def predict(params: Params, state: PixelState, dt: Array, frame: Observation) -> PixelState:
    """Pull the state towards the augmented frame over a time without events: (18) and (16).

    The line before (17) of the paper must read P' = -P^2 / R + Q. One-sided evidence of clipped
    frames acts like a frame at the bound while the state lies on its wrong side.

    Args:
        params: Parameters; not used.
        state: State of a pixel.
        dt: Time, s.
        frame: Log intensity and 1/R of the augmented frame, held over `dt`.

    Returns:
        The state dt later.
    """
    rate, u = frame.rate, frame.level
    if frame.push is not None and frame.excess is not None:
        # Events tell the level to within a threshold, whatever their noise; see also
        # `smoother.one_sided_message`.
        least = jnp.where(frame.push != 0, params.c_on * params.c_off / 3, 0)
        P = jnp.maximum(state.P, least)
        J = jnp.where(frame.push > 0, jnp.maximum(1 / frame.excess**2 - 1 / P, 0), 0)
        gain = 1 / (1 + P * J)
        at = frame.bound + frame.excess
        state = PixelState((state.L - at) * gain + at, P * gain)
    if frame.push is not None:
        wrong = frame.push * (frame.bound - state.L) > 0
        push = jnp.where(wrong, jnp.abs(frame.push), 0)
        total = rate + push
        u = u + (frame.bound - u) * push / jnp.where(total > 0, total, 1)
        rate = total
    gain = 1 / (1 + state.P * dt * rate)
    return PixelState((state.L - u) * gain + u, state.P * gain)


def process_noise(params: Params, event: Event) -> Array:
    """Return Q of an event (2): process, isolated-pixel and refractory-period noise.

    Args:
        params: Standard deviations of the three.
        event: The event.

    Returns:
        Q, (ln I)^2.
    """
    Q_proc = params.sigma_proc**2 * event.since
    Q_iso = params.sigma_iso**2 * event.near
    return Q_proc + Q_iso + params.sigma_ref**2 * refractory_indicator(params, event.since)


def refractory_indicator(params: Params, since: Array) -> Array:
    """Return 1 within the bound rho on the refractory period, 0 after it.

    The comparison has no derivative by rho. With a width the step is relaxed to
    1 / (1 + (dt / rho)^(1 / width)), which has one.

    Args:
        params: `rho`, s, and `rho_width`, of ln time.
        since: Time since the pixel's last event, s.

    Returns:
        The indicator, 0 to 1.
    """
    sharp = params.rho_width == 0
    steepness = 1 / jnp.where(sharp, 1, params.rho_width)
    some = params.rho > 0
    later = jnp.log(jnp.where(some, params.rho, 1)) - jnp.log(jnp.maximum(since, 1e-7))
    soft = jnp.where(some, jax.nn.sigmoid(steepness * later), 0.0)
    return jnp.where(sharp, jnp.where(since <= params.rho, 1.0, 0.0), soft)


def event_update(params: Params, state: PixelState, event: Event) -> PixelState:
    """Add an event: L moves by the nominal threshold (14), P grows by Q (19).

    Args:
        params: Thresholds and noises.
        state: State just before the event.
        event: The event; with polarity 0 the state stays.

    Returns:
        The state after the event.
    """
    L = state.L + event_change(params, event.polarity, event.since)
    return PixelState(L, state.P + jnp.where(event.polarity == 0, 0, process_noise(params, event)))


akf = Filter(
    "akf",
    Params,
    AugmentedFrameModel,
    init,
    predict,
    event_update,
    about="The asynchronous Kalman filter (Wang et al., ICCV 2021), equations corrected. Per pixel "
    "it estimates the log intensity and its variance: events move it by their threshold and make "
    "it less certain, and between events the augmented frame pulls it.",
)
