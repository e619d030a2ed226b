"""The asynchronous Kalman smoother: a pixel's log intensity from all frames and events.

A pixel's log intensity L is a random walk with known steps: an event moves it by s c and adds the
variance (sigma_event c)^2, time adds sigma_bg^2 per second. Each frame measures it, deblurred, at
mid-exposure, with variance r = (sigma_frame / w)^2 / (I + I0)^2 + sigma_floor^2. A clipped pixel is
a censored measurement: L lies beyond the clip (a truncated Gaussian, whose first two moments are
kept).

Between two of its events a pixel's intensity moves by less than a threshold, unseen. Events around
it are evidence of that: the fraction `share` of every event belongs to the eight neighbours.

Between frames nothing but sums over events matters, so the recursions pass over frames, not events.
Forward (Kalman filter) they carry mean and variance (m, P). Backward (information filter) they
carry the message of later frames, h and J: exp(h L - J L^2 / 2). Both together give mean and
variance at any time. The innovations of the forward pass give the exact marginal likelihood of the
frames, which needs no reference: all parameters can be fitted with it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.parameters import Choice, Positive
from jaxevent.reconstruction.augment import (
    CertaintyParams,
    certainty,
    clipped_side,
    clipping_bound,
    clock_lag,
    deblur_frames,
    deblur_level,
    expected_excess,
    integrate_counts,
    segment_excess,
    unclipped_weight,
)
from jaxevent.reconstruction.engine.images import SmootherImages, SmootherVideo
from jaxevent.reconstruction.estimator import KernelEstimator
from jaxevent.reconstruction.features import (
    Features,
    FrameFeatures,
    ImagePoints,
    Numeric,
    ReadOut,
)
from jaxevent.reconstruction.variance import (
    ERROR_PARAMETERS,
    MIN_INTENSITY,
    ONE_SIDED_FACTOR,
    activity_variance,
    bridge_weight,
    gap_variance,
)


class Params(CertaintyParams):
    """Parameters of the smoother."""

    sigma_event: Positive = Positive(
        0.3, "c", "noise of an event's step, relative to its threshold"
    )
    sigma_bg: Positive = Positive(0.25, "ln I / sqrt(s)", "drift without events")
    sigma_frame: Positive = Positive(
        0.007, "intensity", "noise of frames where the certainty w is 1"
    )
    sigma_floor: Positive = Positive(
        0.02, "ln I", "noise of frames in log intensity, however certain"
    )
    start: Positive = Positive(0.5, "intensity", "mean before the first frame")
    P_start: Positive = Positive(4.0, "(ln I)^2", "variance before the first frame", least=1e-12)
    presets = {
        "hdr": {
            "c_on": 0.2,
            "c_off": 0.2,
            "I0": 0.003,
            "w_min": 1e-5,
            "margin": 2.5,
            "sigma_floor": 0.1,
            "share": 0.3,
            "spread": 0.05,
        },
    }

    share: Positive = Positive(
        0.5, "1", "fraction of an event's change that belongs to its 8 neighbours"
    )
    spread: Positive = Positive(
        0.0,
        "s",
        "longest time between events over which a change is spread",
        gradient=False,
        most=1e6,
    )
    one_sided: Choice = Choice(
        (True, False), "use clipped frames as evidence that L lies beyond the clip"
    )

    calibrated = ("clock_offset", "event_delay", "c_on", "c_off", "share", "sigma_event")

    @classmethod
    def predictor(cls) -> "Smoother | None":
        return aks


SHOWN_CERTAINTY = 0.09  # least certainty w of a frame that shows a pixel


class SmootherParams(Params):
    """Parameters of the smoother and of its variance."""

    frame_noise: Positive = ERROR_PARAMETERS[0]
    error_event: Positive = ERROR_PARAMETERS[1]
    error_still: Positive = ERROR_PARAMETERS[2]
    error_change: Positive = ERROR_PARAMETERS[3]


class Gaussian(eqx.Module):
    """Normal distribution of the log intensity of pixels.

    Attributes:
        m: Mean.
        P: Variance.
    """

    m: Float[Numeric, "*pixels"]
    P: Float[Numeric, "*pixels"]


class Message(eqx.Module):
    """Likelihood exp(h L - J L^2 / 2) of later frames, given the log intensity L of pixels.

    Attributes:
        h: Coefficient of the linear term, 1 / ln I.
        J: Information, 1 / (ln I)^2.
    """

    h: Float[Numeric, "*pixels"]
    J: Float[Numeric, "*pixels"]

    def propagate_back(self, S: Array, q: Array) -> "Message":
        """Return the message about L before it moved.

        Args:
            S: Move, ln I.
            q: Variance of the move, (ln I)^2.

        Returns:
            The message.
        """
        fade = 1 / (1 + q * self.J)
        return Message((self.h - self.J * S) * fade, self.J * fade)

    def __add__(self, other: "Message") -> "Message":
        return Message(self.h + other.h, self.J + other.J)


class MessageMap(eqx.Module):
    """Map from the message after several frames to the one before them.

    h' = h + A (h_later - J_later b) / (1 + C J_later), J' = J + A^2 J_later / (1 + C J_later). Maps
    compose; they are elements of an associative scan (Sarkka & Garcia-Fernandez 2021).

    Attributes:
        A: Factor of the log intensity from before the frames to after them.
        b: Change of the log intensity over them, ln I.
        C: Variance that is added over them, (ln I)^2.
        h: Linear coefficient of the frames' own message, 1 / ln I.
        J: Information of the frames' own message, 1 / (ln I)^2.
    """

    A: Float[Numeric, "*pixels"]
    b: Float[Numeric, "*pixels"]
    C: Float[Numeric, "*pixels"]
    h: Float[Numeric, "*pixels"]
    J: Float[Numeric, "*pixels"]

    def compose(self, after: "MessageMap") -> "MessageMap":
        """Compose this map with that of the frames after its own."""
        D = 1 + self.C * after.J
        return MessageMap(
            self.A * after.A / D,
            after.A * (self.b + self.C * after.h) / D + after.b,
            after.A**2 * self.C / D + after.C,
            self.A * (after.h - after.J * self.b) / D + self.h,
            self.A**2 * after.J / D + self.J,
        )

    def apply(self, later: Message) -> Message:
        """Return the message before the frames, from the one after them."""
        D = 1 + self.C * later.J
        return Message(
            self.h + self.A * (later.h - later.J * self.b) / D, self.J + self.A**2 * later.J / D
        )


class FrameMeasurements(eqx.Module):
    """Measurements of the log intensity by frames, some of them censored.

    Attributes:
        z: Deblurred log intensity.
        r: Its variance, (ln I)^2.
        clear: 1: a measurement; 0: none.
        slope: d z / d I = 1 / (I + I0).
        side: +1, -1: L lies above, below `bound`; 0: nothing is known.
        bound: Bound of the log intensity of clipped pixels.
        excess: Expected log intensity beyond the bound; None: not known.
    """

    z: Float[Array, "*frames pixels"]
    r: Float[Array, "*frames pixels"]
    clear: Float[Array, "*frames pixels"]
    slope: Float[Array, "*frames pixels"]
    side: Float[Array, "*frames pixels"]
    bound: Float[Array, "*frames pixels"]
    excess: Float[Array, "*#frames #pixels"] | None


class FrameSteps(eqx.Module):
    """The frames of a window as measurements, with the steps from each to the next."""

    measured: FrameMeasurements
    S: Float[Array, "frames pixels"]  # sum of s c until the next frame
    q: Float[Array, "frames pixels"]  # variance that is added until then


@runtime_checkable
class CensoredPixels(Protocol):
    """Clipped pixels, a part of `FrameMeasurements`."""

    @property
    def side(self) -> Any:
        """+1, -1: L lies above, below the bound; 0: nothing is known."""

    @property
    def bound(self) -> Any:
        """Log intensity at which pixels clip, ln I."""

    @property
    def excess(self) -> Any:
        """Distance beyond white that is expected of pixels, ln I; None: not known."""


class SmoothedWindow(ShortRepr):
    """A smoothed window: enough to read an image at any time inside it."""

    past: Gaussian  # [frames, pixels], after the frame
    future: Message  # [frames, pixels], at the next frame, of that and all later ones
    first: Message  # (pixels,), at the first frame, of everything
    events: Float[Array, "2 frames pixels"]  # ON, OFF, from the frame to the next
    frames: FrameFeatures
    info: Any  # [frames, pixels], what else images need to know of frames
    link: MessageMap  # from the last frame of this window to the last one of the window before
    last: Message  # (pixels,), of the last frame and all later ones
    log_likelihood: Float[Array, " frames"]  # of the frames, a sum over pixels


def measure_frames(
    params: Params, frames: FrameFeatures, z: Array, exists: Array
) -> FrameMeasurements:
    """Make measurements of frames.

    Args:
        params: Noise and certainty of frames.
        frames: The frames.
        z: (frames, pixels) deblurred log intensity, ln I.
        exists: (frames, 1) whether a row is a frame rather than spare.

    Returns:
        The measurements.
    """
    noise = params.sigma_frame / certainty(params, frames) / (frames.intensity + params.I0)
    clear = unclipped_weight(params, frames)
    side = clipped_side(params, frames) * params.one_sided
    return FrameMeasurements(
        z,
        noise**2 + params.sigma_floor**2,
        clear * exists,
        1 / (frames.intensity + params.I0),
        side * exists,
        jnp.broadcast_to(clipping_bound(params, frames), z.shape),
        expected_excess(params, frames),
    )


def predict_change(params: Params, on: Array, off: Array, seconds: Array) -> tuple[Array, Array]:
    """Return the sum of s c over events, and the variance that they and time add.

    Args:
        params: Thresholds, `sigma_event` and `sigma_bg`.
        on: Number of ON events.
        off: Number of OFF events.
        seconds: Time, s.

    Returns:
        The change, ln I, and its variance, (ln I)^2.
    """
    return integrate_counts(params, on, off), added_variance(params, on, off, seconds)


def make_frame_steps(
    params: Params, frames: FrameFeatures
) -> tuple[FrameSteps, Float[Array, "2 frames pixels"]]:
    """Make measurements of a window's frames, and the steps between them.

    Args:
        params: Parameters.
        frames: The frames.

    Returns:
        Measurements and steps, and the counts (2, frames, pixels) of ON and OFF events from each
        mid-exposure to the next.
    """
    z, counts = jnp.log(frames.intensity + params.I0), frames.span
    if frames.head is not None and frames.tail is not None:
        left, _ = deblur_frames(params, frames)
        z = left + integrate_counts(params, frames.head[0], frames.head[1])
        counts = frames.span - frames.head - jnp.roll(frames.tail, -1, axis=1)
    rate = jnp.asarray(frames.blend_rate)
    follows = (rate > 0)[:, None]  # another frame follows
    exists = jnp.concatenate([jnp.asarray(frames.present)[None], (rate > 0)[:-1]])[:, None]
    counts = jnp.where(follows, counts, 0)
    moves = redistribute_counts(params, frames, counts)
    gap = jnp.where(follows, 1 / jnp.where(follows, rate[:, None], 1), 0)
    S, q = predict_change(params, moves[0], moves[1], gap)
    measured = measure_frames(params, frames, z, exists)
    return FrameSteps(measured, S, jnp.broadcast_to(q, z.shape)), counts


def redistribute_counts(params: Params, frames: FrameFeatures, counts: Array) -> Array:
    """Give a fraction of every pixel's events to its eight neighbours.

    Between two events of a pixel its intensity moves by less than a threshold, unseen; events
    around it are evidence of that. At the border the missing neighbours' part stays with the pixel.

    Args:
        params: `share`, the fraction.
        frames: Frames of the sensor.
        counts: (..., pixels) event counts.

    Returns:
        (..., pixels).
    """
    image = counts.reshape(*counts.shape[:-1], -1, frames.width)

    def sum_three(values: Array, axis: int) -> Array:
        rest = [(0, 0)] * values.ndim
        rest[axis] = (1, 1)
        padded = jnp.pad(values, rest)
        size = values.shape[axis]
        left, middle, right = (lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(3))
        return left + middle + right

    def neighbours(values: Array) -> Array:
        return sum_three(sum_three(values, values.ndim - 1), values.ndim - 2) - values

    given = neighbours(jnp.ones(image.shape[-2:], image.dtype)) / 8
    return redistribute_pixel_count(params, image, neighbours(image), given).reshape(counts.shape)


def redistribute_pixel_count(params: Params, own: Array, around: Array, given: Array) -> Array:
    """Redistribute a pixel's event count: it gives the fraction `params.share` to its neighbours.

    Args:
        params: `share`.
        own: Events of the pixel.
        around: Events of its eight neighbours, summed.
        given: Fraction of the eight neighbours that lie on the sensor.

    Returns:
        The count.
    """
    return own + params.share * (around / 8 - given * own)


class GapEvidence(eqx.Module):
    """Evidence of the gap between two frames that contains a time."""

    activity: Float[Numeric, "*pixels"]  # events, part of them from neighbours
    residual: Float[Numeric, "*pixels"]  # change that events do not explain, ln I
    added: Float[Numeric, "*pixels"]  # variance of the random walk over the gap, (ln I)^2
    part: Float[Numeric, "*#pixels"]  # of the gap that is over, 0 to 1
    is_between: Bool[Numeric, "*#pixels"]  # whether a frame follows, and one is before


def gap_evidence(
    params: Params, past: Gaussian, later: Message, counts: tuple[Array, Array], seconds: Any
) -> GapEvidence:
    """Compute the evidence of a gap between two frames, at a time inside it.

    Args:
        params: Parameters.
        past: State after the frame before.
        later: Message of later frames, at the next one; without precision if there is none.
        counts: ON and OFF events of the gap.
        seconds: Since the frame before, and until the next one.

    Returns:
        The evidence.
    """
    on, off = counts
    elapsed, left = seconds
    S, q = predict_change(params, on, off, elapsed + left)
    known = later.J > 0
    residual = later.h / jnp.where(known, later.J, 1) - past.m - S
    length = elapsed + left
    part = elapsed / jnp.where(length > 0, length, 1)
    return GapEvidence(on + off, jnp.where(known, residual, 0), q, part, left > 0)


def added_variance(params: Params, on: Array, off: Array, seconds: Array) -> Array:
    """Return the variance that events and time add.

    Args:
        params: Thresholds, `sigma_event` and `sigma_bg`.
        on: Number of ON events.
        off: Number of OFF events.
        seconds: Time, s.

    Returns:
        The variance, (ln I)^2.
    """
    events = params.c_on**2 * on + params.c_off**2 * off
    return params.sigma_event**2 * events + params.sigma_bg**2 * seconds


def one_sided_message(state: Gaussian, row: CensoredPixels, floor: Array) -> tuple[Message, Array]:
    """Approximate one-sided evidence by the message that keeps the first two moments.

    L is above the bound (side 1) with probability Phi(d), d = (m - bound) / sqrt(P + floor). The
    moments of the truncated Gaussian are m + P lam / s and P - P^2 lam (lam + d) / s^2,
    lam = phi(d) / Phi(d), s^2 = P + floor.

    A Gaussian grows back the tail that a truncation took. A pixel that stays clipped would be
    truncated again at every frame and drift away from the bound without end. So the evidence counts
    by the sigmoid of -2 d: fully where the state contradicts it, not where it is known.

    Of a pixel at white it is expected to lie `excess` beyond, give or take as much. That counts as
    far as the state is known less well than so, and no more however often a frame repeats it.

    Args:
        state: State before the frame.
        row: The frame's censored pixels.
        floor: Variance of the bound, (ln I)^2.

    Returns:
        The message, and its log likelihood.
    """
    sign = jnp.sign(row.side)
    expected = Message(jnp.zeros_like(state.P), jnp.zeros_like(state.P))
    if row.excess is not None:
        J = jnp.maximum(row.side, 0) * jnp.maximum(1 / row.excess**2 - 1 / state.P, 0)
        expected = Message(J * (row.bound + row.excess), J)
        P = 1 / (1 / state.P + J)
        state = Gaussian(state.m + P * (expected.h - J * state.m), P)
    s2 = state.P + floor
    s = jnp.sqrt(s2)
    d = jnp.clip(jnp.where(sign < 0, -1, 1) * (state.m - row.bound) / s, -100, 100)
    log_Phi = log_ndtr(d)
    lam = jnp.exp(-0.5 * d**2 - 0.9189385332046727 - log_Phi)
    m = state.m + sign * state.P / s * lam
    P = state.P * (1 - state.P / s2 * jnp.clip(lam * (lam + d), 0, 0.9999))
    weight = jnp.abs(row.side) * jax.nn.sigmoid(-2 * d)
    J = 1 / P - 1 / state.P
    beyond = Message(weight * (m / P - state.m / state.P), weight * J)
    return expected + beyond, weight * log_Phi


def frame_update(
    params: Params, state: Gaussian, row: FrameMeasurements
) -> tuple[Gaussian, Message, Array]:
    """Update the state with a frame's measurement.

    Args:
        params: `sigma_floor`, ln I.
        state: State before the frame.
        row: The frame's measurements.

    Returns:
        The state after the frame, the frame's message, and the log likelihood of its intensity.
    """
    # A half clear pixel counts half: its variance is doubled.
    J = row.clear / row.r
    s2 = state.P + row.r
    # Of the intensity, not of its logarithm, whose density depends on I0: p(I) = p(z) dz/dI.
    log_gauss = -0.5 * (jnp.log(2 * jnp.pi * s2) + (row.z - state.m) ** 2 / s2)
    log_gauss = log_gauss + jnp.log(row.slope)
    message, log_side = one_sided_message(state, row, params.sigma_floor**2)
    message = message + Message(J * row.z, J)
    P = state.P / (1 + state.P * message.J)
    # m + P (h - J m) is the information form's mean without its cancellation.
    m = state.m + P * (message.h - message.J * state.m)
    return Gaussian(m, P), message, row.clear * log_gauss + log_side


def init(params: Params) -> Gaussian:
    """Return the state before the first frame."""
    mean = jnp.log(params.start + params.I0)
    return Gaussian(mean, jnp.broadcast_to(params.P_start, mean.shape))


def state_to_message(state: Gaussian) -> Message:
    """Return a state as a message."""
    return Message(state.m / state.P, 1 / state.P)


def single_pixel_frame(gain: Array, fixed: dict[str, Any], **image: Array) -> FrameFeatures:
    """Make one frame of one pixel.

    Args:
        gain: (1,) exposure relative to the common one.
        fixed: Further fields of `FrameFeatures`, equal for all frames.
        **image: Grey value, intensity and certainty, each (1, 1).

    Returns:
        The frame, without events.
    """
    none = jnp.zeros((2, 1, 1), gain.dtype)
    return FrameFeatures(
        **image,
        **({"white": None} | fixed),
        gain=gain[0],
        span=none,
        around=None,
        before=none[:, 0],
        head=None,
        tail=None,
        segments=None,
        weight_rate=none[:, 0, 0],
        blend_rate=none[0, 0],
        present=jnp.ones(()),
        rows=jnp.zeros(3, int),
        width=1,
    )


def smoothed_state(m: Array, precision: Array, later: Message) -> Gaussian:
    """Combine a Gaussian from the past with the message of later frames.

    Args:
        m: Mean from the past, ln I.
        precision: Its precision 1 / P, 1 / (ln I)^2; 0 without a past.
        later: Message of later frames, at the same time.

    Returns:
        The smoothed state.
    """
    P = 1 / (precision + later.J)
    return Gaussian(m + P * (later.h - later.J * m), P)


def filter_forward(params: Params, rows: FrameSteps, state: Gaussian) -> tuple[Any, ...]:
    """Run the Kalman filter over frames.

    Args:
        params: Parameters.
        rows: Frames, arrays [frames, pixels].
        state: State before the first frame.

    Returns:
        The states before and after each frame, its message, and its log likelihood.
    """

    def step(at: Gaussian, row: FrameSteps) -> tuple[Gaussian, Any]:
        after, message, log_likelihood = frame_update(params, at, row.measured)
        return Gaussian(after.m + row.S, after.P + row.q), (at, after, message, log_likelihood)

    return lax.scan(step, state, rows)[1]


def filter_backward(
    rows: FrameSteps, message: Message, last: Message, number: Any
) -> tuple[Message, Message]:
    """Run the information filter backwards over frames.

    Args:
        rows: Frames, arrays [frames, pixels].
        message: Messages of the frames.
        last: Message of the last of the `number` frames and all later ones.
        number: Number of frames.

    Returns:
        The message before the first frame, and after each frame.
    """

    def step(later: Message, row: Any) -> tuple[Message, Message]:
        i, own, S, q = row
        here = later.propagate_back(S, q) + own
        return jax.tree.map(lambda a, b: jnp.where(i == number - 1, a, b), last, here), later

    zero = jnp.zeros_like(rows.S[0])
    steps = (jnp.arange(len(rows.S)), message, rows.S, rows.q)
    return lax.scan(step, Message(zero, zero), steps, reverse=True)


def compose_message_maps(
    rows: FrameSteps, message: Message, anchor: Any, number: Any
) -> MessageMap:
    """Compose the maps from the last of the `number` frames to the frame `anchor`.

    Args:
        rows: Frames, arrays [frames, pixels].
        message: Messages of the frames.
        anchor: Row of the frame at which the map ends.
        number: Number of frames.

    Returns:
        The map.
    """

    def step(link: MessageMap, row: Any) -> tuple[MessageMap, None]:
        i, own, S, q = row
        longer = link.compose(MessageMap(one, S, q, own.h, own.J))
        inside = (i >= anchor) & (i < number - 1)
        return jax.tree.map(lambda a, b: jnp.where(inside, a, b), longer, link), None

    zero, one = jnp.zeros_like(rows.S[0]), jnp.ones_like(rows.S[0])
    steps = (jnp.arange(len(rows.S)), message, rows.S, rows.q)
    return lax.scan(step, MessageMap(one, zero, zero, zero, zero), steps)[0]


def adjacent_counts(
    params: Params, window: "SmoothedWindow", points: ImagePoints
) -> tuple[Array, Array, Array, Array]:
    """Count the events since the frame before and until the frame after, at times of images.

    Known are those since the left edge of the piece's exposure, or, before the first one, since
    the window's start.

    Args:
        params: `clock_offset`, `event_delay` and `share`.
        window: The window.
        points: The images.

    Returns:
        ON and OFF events since the frame before and until the frame after, each (2, times,
        pixels), and the seconds (times, 1) of both intervals.
    """
    frames, f = window.frames, jnp.asarray(points.frame)
    rate = jnp.asarray(frames.blend_rate)[f][:, None]
    elapsed = jnp.asarray(points.elapsed)[:, None] - clock_lag(params, frames)
    behind = jnp.asarray(points.elapsed)[:, None] < 0  # before the first frame
    since = jnp.stack([points.on, points.off])
    between = jnp.take(window.events, f, axis=1)
    before = jnp.asarray(frames.before)[:, None]
    if frames.head is None or frames.tail is None:
        until = jnp.where(behind, before - since, between - since)
    else:
        own = jnp.maximum((jnp.asarray(points.piece) - 1) // 2, 0)
        head = jnp.take(jnp.asarray(frames.head), own, axis=1)
        outside = (jnp.asarray(points.piece) == 0)[:, None]
        first = jnp.where(outside, before - frames.tail[:, :1], head) - since
        since = since - head + jnp.where((own > f)[:, None], between, 0)
        until = jnp.where(behind, first, between - since)
    gap = jnp.where(rate > 0, 1 / jnp.where(rate > 0, rate, 1), 0)
    seconds = jnp.where(behind, -elapsed, jnp.where(rate > 0, gap - elapsed, 0))
    return (
        redistribute_counts(params, frames, since),
        redistribute_counts(params, frames, until),
        elapsed,
        seconds,
    )


AnyParams = TypeVar("AnyParams", bound=Params)


@renamed_methods(keep="readout_inputs", frame_info="readout_inputs", tell="readout")
@dataclasses.dataclass(frozen=True, repr=False)
class Smoother(KernelEstimator[AnyParams]):
    """The asynchronous Kalman smoother."""

    has_likelihood: ClassVar[bool] = True
    adds_unseen_errors: ClassVar[bool] = True  # variances are by `image_variance`
    kernel_video: ClassVar[Any] = SmootherVideo  # class of the kernel of a video
    kernel_images: ClassVar[Any] = SmootherImages  # class of the kernel of images at given times
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "compiler", "factors"}), kw_only=True
    )

    @property
    def is_event_driven(self) -> bool:
        return False

    @property
    def needs_future(self) -> bool:
        return True

    def readout_inputs(
        self, params: Params, frames: FrameFeatures, measured: FrameMeasurements, events: Any
    ) -> Any:
        """Return the data of frames that images need beside the messages; here none.

        Args:
            params: Parameters.
            frames: The frames.
            measured: Their measurements.
            events: (frames, pixels) events within exposures; None where no exposure is known.

        Returns:
            A pytree of arrays (frames, pixels).
        """
        return ()

    def readout(self, params: Params, state: Gaussian, info: Any, here: Array) -> Estimate:
        """Make images of smoothed states.

        Args:
            params: Parameters.
            state: Smoothed states (times, pixels).
            info: `readout_inputs` of the frames before.
            here: Whether the time is the middle of the exposure of the frame before.

        Returns:
            The images.
        """
        image = jnp.exp(state.m) - params.I0
        return Estimate(image, state.P, jnp.isfinite(image))

    def image_variance(
        self, params: Any, state: Gaussian, gap: GapEvidence, flicker: Array, movement: Array
    ) -> Array:
        """Return the variance of images, by the formula of `variance`.

        The smoother's own P rests on noises that are made to weigh frames and events, not on what
        errors are. It says only what clipped frames do not show: the part that no two frames which
        show the pixel would leave.

        Args:
            params: Parameters.
            state: Smoothed state at the time.
            gap: What is known of the gap around.
            flicker: Variance of the intensity that all pixels of a frame share.
            movement: How much of the recording moves, 0 to 1.

        Returns:
            The variance, (ln I)^2.
        """
        I_plus = jnp.maximum(jnp.exp(state.m), MIN_INTENSITY)
        noise, common = (params.frame_noise / I_plus) ** 2, flicker / I_plus**2
        w = bridge_weight(gap.part)
        bridge = gap_variance(params, gap.activity, gap.residual, movement) + common
        walk = ONE_SIDED_FACTOR * activity_variance(params, gap.activity, movement)
        shown = noise * (1 - w / 2) + w * bridge
        V = jnp.where(gap.is_between, shown, noise + common + walk)
        frame = params.sigma_frame / jnp.maximum(params.w_min, SHOWN_CERTAINTY) / I_plus
        q = jnp.where(gap.is_between, gap.added / 4, gap.added)
        return V + jnp.maximum(state.P - q - frame**2 - params.sigma_floor**2, 0)

    def init_state(self, params: Params, features: Features) -> Gaussian:
        pixels = features.last.shape
        return jax.tree.map(lambda v: jnp.broadcast_to(v, pixels), init(params))

    def run(
        self,
        params: Params,
        features: Features,
        state: Gaussian | None = None,
        future: Message | None = None,
    ) -> tuple[SmoothedWindow, Gaussian]:
        """Smooth a window; see `PixelEstimator.run`.

        Args:
            params: Parameters.
            features: The window.
            state: (pixels,) state before the window's first frame.
            future: Message of later windows.

        Returns:
            The smoothed window, and the state (pixels,) before the next window's first frame.
        """
        frames = features.at_dead_time(params.rho_ref).frames
        rows, counts = make_frame_steps(params, frames)
        state = self.init_state(params, features) if state is None else state
        number, anchor, onward = frames.rows
        ahead, past, message, likelihood = filter_forward(params, rows, state)
        last = jax.tree.map(lambda v: v[number - 1], message) if future is None else future
        first, later = filter_backward(rows, message, last, number)
        link = compose_message_maps(rows, message, anchor, number)
        first = first + state_to_message(state)
        events = None
        if frames.head is not None and frames.tail is not None:
            events = (jnp.asarray(frames.head) + frames.tail).sum(0)
        info = self.readout_inputs(params, frames, rows.measured, events)
        window = SmoothedWindow(
            past, later, first, counts, frames, info, link, last, likelihood.sum(1)
        )
        return window, jax.tree.map(lambda v: v.at[onward].get(mode="clip"), ahead)

    def read(self, params: Params, trajectory: SmoothedWindow, out: ReadOut) -> Estimate:
        points = out.at_dead_time(params.rho_ref).points
        f, behind = jnp.asarray(points.frame), jnp.asarray(points.elapsed)[:, None] < 0
        since, until, elapsed, seconds = adjacent_counts(params, trajectory, points)

        later = jax.tree.map(lambda v: v[f], trajectory.future)
        later = jax.tree.map(lambda a, b: jnp.where(behind, a, b), trajectory.first, later)
        later = later.propagate_back(*predict_change(params, until[0], until[1], seconds))
        S, q = predict_change(params, since[0], since[1], elapsed)
        # Before the first frame there is no past: its variance is without bound.
        m = jnp.where(behind, 0, trajectory.past.m[f] + S)
        precision = jnp.where(behind, 0, 1 / jnp.where(behind, 1, trajectory.past.P[f] + q))
        # Times are whole microseconds, the middle of an exposure may lie up to one before.
        here = ~behind & (jnp.asarray(points.elapsed)[:, None] < 1e-6)
        info = jax.tree.map(lambda v: v[f], trajectory.info)
        state = smoothed_state(m, precision, later)
        images = self.readout(params, state, info, here)
        if not self.adds_unseen_errors:
            return images
        past, following = jax.tree.map(
            lambda v: jnp.where(behind, 0, v[f]), (trajectory.past, trajectory.future)
        )
        between = ~behind & (seconds > 0)
        total = jnp.where(between, since + until, jnp.where(behind, until, since))
        passed = jnp.where(behind, seconds, elapsed), jnp.where(between, seconds, 0)
        gap = gap_evidence(params, past, following, (total[0], total[1]), passed)
        frames = trajectory.frames
        V = self.image_variance(params, state, gap, frames.flicker, frames.movement)
        return Estimate(images.mean, V, images.valid)

    def pixel_state_spec(self, number: Array) -> dict[str, Any]:
        """Return the pytrees that `pixel_functions` refer to, every leaf the given number."""
        state, message = Gaussian(number, number), Message(number, number)
        return {"state": state, "message": message, "link": MessageMap(*[number] * 5)}

    def apply_message_map(self, link: NDArray, later: NDArray) -> NDArray:
        """Return the message before several frames, as numbers for kernels.

        Args:
            link: (5, ...) fields of their `MessageMap`.
            later: (2, ...) h and J of the message after them.

        Returns:
            (2, ...) h and J.
        """
        message = MessageMap(*link).apply(Message(*later))
        return np.stack([message.h, message.J])

    def pixel_functions(self, exposed: bool) -> dict[str, Callable[..., dict[str, Any]]]:
        """Return the steps of `run` and `read` at one pixel, for kernels.

        See `engine.smoother_program`. They are functions of parameters, of what depends on these
        alone, and of numbers by name.
        """

        def lag(known):
            return known[0].frame_delay - known[1]["frame_delay"]

        def counted(params, on, off, around_on, around_off, given):
            return redistribute_pixel_count(params, on, around_on, given), redistribute_pixel_count(
                params, off, around_off, given
            )

        def with_variance(known, image, state, gap):
            params, fixed = known
            unseen = fixed["flicker"], fixed["movement"]
            V = self.image_variance(params, state, gap, *unseen)
            return Estimate(image.mean, V, image.valid)

        def frame(known, clipped, *, exists, gain, total, inside, state, **image):
            params, fixed = known
            frames = single_pixel_frame(gain, fixed, **image)
            z = jnp.log(frames.intensity + params.I0)
            z = deblur_level(params, z, total) if exposed else z
            measured = measure_frames(params, frames, z, exists)
            info = self.readout_inputs(params, frames, measured, inside if exposed else None)
            side = measured.side
            if not clipped:
                measured = dataclasses.replace(measured, side=jnp.zeros_like(side))
            past, message, _ = frame_update(params, state, measured)
            return {"past": past, "message": message, "info": info, "side": side}

        def move(known, past, seconds, **counts):
            on, off = counted(known[0], **counts)
            S, q = predict_change(known[0], on, off, seconds)
            return {"moved_on": on, "moved_off": off, "state": Gaussian(past.m + S, past.P + q)}

        def link(known, link, message, moved_on, moved_off, seconds):
            S, q = predict_change(known[0], moved_on, moved_off, seconds)
            return {"link": link.compose(MessageMap(jnp.ones_like(S), S, q, message.h, message.J))}

        def back(known, later, message, moved_on, moved_off, seconds):
            here = (
                later.propagate_back(*predict_change(known[0], moved_on, moved_off, seconds))
                + message
            )
            return {"message": later, "later": here}

        def show(
            known, past, message, *, moved_on, moved_off, info, elapsed, seconds, here, **counts
        ):
            on, off = counted(known[0], **counts)
            rest = jnp.where(seconds > 0, seconds + lag(known), 0)
            left = predict_change(known[0], moved_on - on, moved_off - off, rest)
            S, q = predict_change(known[0], on, off, elapsed - lag(known))
            state = smoothed_state(past.m + S, 1 / (past.P + q), message.propagate_back(*left))
            image = self.readout(known[0], state, info, here)
            if self.adds_unseen_errors:
                total = jnp.where(seconds > 0, moved_on, on), jnp.where(seconds > 0, moved_off, off)
                span = elapsed - lag(known), rest
                gap = gap_evidence(known[0], past, message, total, span)
                image = with_variance(known, image, state, gap)
            return {"image": image}

        def before(known, later, info, seconds, **counts):
            left = predict_change(known[0], *counted(known[0], **counts), seconds + lag(known))
            first = later + state_to_message(init(known[0]))
            zero = jnp.zeros_like(later.h)
            state = smoothed_state(zero, zero, first.propagate_back(*left))
            image = self.readout(known[0], state, info, zero > 0)
            if self.adds_unseen_errors:
                total = counted(known[0], **counts)
                none = Gaussian(zero, zero), Message(zero, zero)
                gap = gap_evidence(known[0], *none, total, (seconds + lag(known), zero))
                image = with_variance(known, image, state, gap)
            return {"image": image}

        def start(known):
            return {"state": init(known[0])}

        def excess(known, share, edge, on, off):
            return {"total": segment_excess(known[0], share + lag(known) * edge, on, off)}

        return {
            "start": start,
            "frame": functools.partial(frame, clipped=False),
            "clipped": functools.partial(frame, clipped=True),
            "move": move,
            "link": link,
            "back": back,
            "show": show,
            "before": before,
            "excess": excess,
        }

    def log_likelihood(self, params: Params, features: Features) -> Float[Array, ""]:
        """Return the log likelihood of all frames of a prepared recording, given its events.

        Args:
            params: Parameters.
            features: The whole recording.

        Returns:
            (), a sum over frames and pixels.
        """
        return self.run(params, features)[0].log_likelihood.sum()


aks = Smoother(
    "aks",
    SmootherParams,
    needs_frames=True,
    about="The asynchronous Kalman smoother. Per pixel it estimates the log intensity from all "
    "frames and events, earlier and later ones, with its variance; an event's change is shared "
    "with the neighbours, and the frames' likelihood can be fitted.",
)
