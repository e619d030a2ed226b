"""The smoother: what all frames and events of a recording say about a pixel, before and after.

A pixel's log intensity L is a random walk with known steps: an event moves it by s c and adds the
variance (sigma_event c)^2, time adds sigma_bg^2 per second. Each frame measures it, deblurred, at
mid-exposure, with variance r = (sigma_frame / w)^2 / (I + I0)^2 + sigma_floor^2. A clipped pixel of
a frame is no measurement; it says only that L lies beyond the clip (one-sided evidence, a truncated
Gaussian whose first two moments are kept).

Between two of its events a pixel's intensity moves by less than a threshold, unseen. Events around
it tell of that: of every event the part `share` belongs to the eight neighbours (on slider_depth
the changes between frames have a quarter less error so, and hidden frames too).

Between frames nothing but sums over events matters, so the recursions pass over frames, not events.
Forward (Kalman filter) it carries mean and variance (m, P); backward (information filter) what
later frames say, h and J: exp(h L - J L^2 / 2). Both together give mean and variance at any time,
and the innovations of the forward pass the exact marginal likelihood of the frames, which needs no
reference: all parameters can be fitted with it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods, renamed_names
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
    integrate_counts,
    segment_excess,
    unclipped_weight,
)
from jaxevent.reconstruction.engine.images import (
    SmootherImages,
    SmootherVideo,
    images_from_kernel,
    video_from_kernel,
)
from jaxevent.reconstruction.estimator import PixelEstimator, PreparedImages
from jaxevent.reconstruction.features import (
    Features,
    FrameFeatures,
    ImagePoints,
    Numeric,
    ReadOut,
)
from jaxevent.reconstruction.video import ImageSequence, Video
from jaxevent.recording import Recording, Times


class Params(CertaintyParams):
    """Parameters of the smoother."""

    sigma_event = Positive(0.3, "c", "noise of an event's step, as part of its threshold")
    sigma_bg = Positive(0.25, "ln I / sqrt(s)", "drift without events")
    sigma_frame = Positive(0.007, "intensity", "noise of frames where the certainty w is 1")
    sigma_floor = Positive(0.02, "ln I", "noise of frames in log intensity, however certain")
    start = Positive(0.5, "intensity", "mean before the first frame")
    P_start = Positive(4.0, "(ln I)^2", "variance before the first frame", least=1e-12)
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

    share = Positive(0.5, "1", "part of an event's change that belongs to its 8 neighbours")
    spread = Positive(
        0.0,
        "s",
        "longest time between events over which a change is spread",
        gradient=False,
        most=1e6,
    )
    one_sided = Choice((True, False), "whether clipped frames tell that L lies beyond the clip")


class Gaussian(eqx.Module):
    """Mean and variance of the log intensity of pixels."""

    m: Float[Numeric, "*pixels"]
    P: Float[Numeric, "*pixels"]


class Message(eqx.Module):
    """What later frames say about the log intensity L of pixels: exp(h L - J L^2 / 2)."""

    h: Float[Numeric, "*pixels"]
    J: Float[Numeric, "*pixels"]

    def propagate_back(self, S: Array, q: Array) -> "Message":
        """The same about L before it moved by S with variance q."""
        fade = 1 / (1 + q * self.J)
        return Message((self.h - self.J * S) * fade, self.J * fade)

    def __add__(self, other: "Message") -> "Message":
        return Message(self.h + other.h, self.J + other.J)


@renamed_methods(before="apply", then="compose")
class MessageMap(eqx.Module):
    """How a message after several frames becomes one before them (Sarkka & Garcia-Fernandez 2021).

    h' = h + A (h_later - J_later b) / (1 + C J_later), J' = J + A^2 J_later / (1 + C J_later).
    """

    A: Float[Numeric, "*pixels"]
    b: Float[Numeric, "*pixels"]
    C: Float[Numeric, "*pixels"]
    h: Float[Numeric, "*pixels"]
    J: Float[Numeric, "*pixels"]

    def compose(self, after: "MessageMap") -> "MessageMap":
        """Both links in one, this one being the earlier."""
        D = 1 + self.C * after.J
        return MessageMap(
            self.A * after.A / D,
            after.A * (self.b + self.C * after.h) / D + after.b,
            after.A**2 * self.C / D + after.C,
            self.A * (after.h - after.J * self.b) / D + self.h,
            self.A**2 * after.J / D + self.J,
        )

    def apply(self, later: Message) -> Message:
        D = 1 + self.C * later.J
        return Message(
            self.h + self.A * (later.h - later.J * self.b) / D, self.J + self.A**2 * later.J / D
        )


class FrameMeasurements(eqx.Module):
    """What frames measure."""

    z: Float[Array, "*frames pixels"]  # deblurred log intensity
    r: Float[Array, "*frames pixels"]  # its variance
    clear: Float[Array, "*frames pixels"]  # 1: a measurement; 0: none
    slope: Float[Array, "*frames pixels"]  # d z / d I = 1 / (I + I0)
    side: Float[Array, "*frames pixels"]  # +1, -1: L lies above, below `bound`; 0: nothing known
    bound: Float[Array, "*frames pixels"]


class FrameSteps(eqx.Module):
    """The frames of a window as measurements, and the steps from each to the next."""

    measured: FrameMeasurements
    S: Float[Array, "frames pixels"]  # sum of s c until the next frame
    q: Float[Array, "frames pixels"]  # variance that is added until then


@runtime_checkable
class CensoredPixels(Protocol):
    """Clipped pixels, as `FrameSteps` has them."""

    @property
    def side(self) -> Any: ...

    @property
    def bound(self) -> Any: ...


class SmoothedWindow(ShortRepr):
    """A smoothed window: enough to read an image at any time inside it."""

    past: Gaussian  # [frames, pixels], after the frame
    future: Message  # [frames, pixels], at the next frame, of that and all later ones
    first: Message  # (pixels,), at the first frame, of everything
    events: Float[Array, "2 frames pixels"]  # ON, OFF, from the frame to the next
    frames: FrameFeatures
    kept: Any  # [frames, pixels], what else images need to know of frames
    link: MessageMap  # from the last frame of this window to the last one of the window before
    last: Message  # (pixels,), of the last frame and all later ones
    log_likelihood: Float[Array, " frames"]  # of the frames, a sum over pixels


def measure_frames(
    params: Params, frames: FrameFeatures, z: Array, exists: Array
) -> FrameMeasurements:
    """Frames as measurements; `z` is the deblurred log intensity."""
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
    )


def change_between(params: Params, on: Array, off: Array, seconds: Array) -> tuple[Array, Array]:
    """The sum of s c over events, and the variance that they and time add."""
    return integrate_counts(params, on, off), added_variance(params, on, off, seconds)


def make_frame_steps(
    params: Params, frames: FrameFeatures
) -> tuple[FrameSteps, Float[Array, "2 frames pixels"]]:
    """Measurements and steps; and the counts of ON and OFF events between mid-exposures."""
    z, counts = jnp.log(frames.intensity + params.I0), frames.span
    if frames.head is not None and frames.tail is not None:
        left, _ = deblur_frames(params, frames)
        z = left + integrate_counts(params, frames.head[0], frames.head[1])
        counts = frames.span - frames.head - jnp.roll(frames.tail, -1, axis=1)
    rate = jnp.asarray(frames.blend_rate)
    follows = (rate > 0)[:, None]  # another frame follows
    exists = jnp.concatenate([jnp.asarray(frames.present)[None], (rate > 0)[:-1]])[:, None]
    counts = jnp.where(follows, counts, 0)
    moves = redistribute_images(params, frames, counts)
    gap = jnp.where(follows, 1 / jnp.where(follows, rate[:, None], 1), 0)
    S, q = change_between(params, moves[0], moves[1], gap)
    measured = measure_frames(params, frames, z, exists)
    return FrameSteps(measured, S, jnp.broadcast_to(q, z.shape)), counts


def redistribute_images(params: Params, frames: FrameFeatures, counts: Array) -> Array:
    """Event counts [..., pixels] of which each pixel gives the part `share` to its neighbours.

    Between two events of a pixel its intensity moves by less than a threshold, unseen; events
    around it tell of that. At the border the missing neighbours' part stays with the pixel.
    """
    image = counts.reshape(*counts.shape[:-1], -1, frames.width)

    def three(values: Array, axis: int) -> Array:
        rest = [(0, 0)] * values.ndim
        rest[axis] = (1, 1)
        padded = jnp.pad(values, rest)
        size = values.shape[axis]
        left, middle, right = (lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(3))
        return left + middle + right

    def around(values: Array) -> Array:
        return three(three(values, values.ndim - 1), values.ndim - 2) - values

    given = around(jnp.ones(image.shape[-2:], image.dtype)) / 8
    return redistribute_events(params, image, around(image), given).reshape(counts.shape)


def redistribute_events(params: Params, own: Array, around: Array, given: Array) -> Array:
    """Events of a pixel of which the part `given` of the neighbours get their share.

    `around` are those of its neighbours.
    """
    return own + params.share * (around / 8 - given * own)


def added_variance(params: Params, on: Array, off: Array, seconds: Array) -> Array:
    """Variance that a stretch of time adds."""
    events = params.c_on**2 * on + params.c_off**2 * off
    return params.sigma_event**2 * events + params.sigma_bg**2 * seconds


def one_sided_message(state: Gaussian, row: CensoredPixels, floor: Array) -> tuple[Message, Array]:
    """One-sided evidence as the message that keeps the first two moments; its log likelihood.

    L is above the bound (side 1) with probability Phi(d), d = (m - bound) / sqrt(P + floor). The
    moments of the truncated Gaussian are m + P lam / s and P - P^2 lam (lam + d) / s^2,
    lam = phi(d) / Phi(d), s^2 = P + floor.

    A Gaussian grows back the tail that a truncation took. A pixel that stays clipped would be
    truncated again at every frame and drift away from the bound without end; so the evidence counts
    by the sigmoid of -2 d: fully where the state contradicts it, not where it is known.
    """
    sign = jnp.sign(row.side)
    s2 = state.P + floor
    s = jnp.sqrt(s2)
    d = jnp.clip(jnp.where(sign < 0, -1, 1) * (state.m - row.bound) / s, -100, 100)
    log_Phi = log_ndtr(d)
    lam = jnp.exp(-0.5 * d**2 - 0.9189385332046727 - log_Phi)
    m = state.m + sign * state.P / s * lam
    P = state.P * (1 - state.P / s2 * jnp.clip(lam * (lam + d), 0, 0.9999))
    weight = jnp.abs(row.side) * jax.nn.sigmoid(-2 * d)
    J = 1 / P - 1 / state.P
    return Message(weight * (m / P - state.m / state.P), weight * J), weight * log_Phi


def frame_update(
    params: Params, state: Gaussian, row: FrameMeasurements
) -> tuple[Gaussian, Message, Array]:
    """The state after a frame, what the frame says, and the log likelihood of that."""
    # A half clear pixel counts half: its variance is doubled.
    J = row.clear / row.r
    s2 = state.P + row.r
    # Of the intensity, not of its logarithm, whose density depends on I0: p(I) = p(z) dz/dI.
    log_gauss = -0.5 * (jnp.log(2 * jnp.pi * s2) + (row.z - state.m) ** 2 / s2)
    log_gauss = log_gauss + jnp.log(row.slope)
    said, log_side = one_sided_message(state, row, params.sigma_floor**2)
    said = said + Message(J * row.z, J)
    P = state.P / (1 + state.P * said.J)
    # m + P (h - J m) is the information form's mean without its cancellation.
    m = state.m + P * (said.h - said.J * state.m)
    return Gaussian(m, P), said, row.clear * log_gauss + log_side


def init(params: Params) -> Gaussian:
    """The state before the first frame."""
    mean = jnp.log(params.start + params.I0)
    return Gaussian(mean, jnp.broadcast_to(params.P_start, mean.shape))


def state_to_message(state: Gaussian) -> Message:
    """A state as a message."""
    return Message(state.m / state.P, 1 / state.P)


def single_pixel_frame(gain: Array, fixed: dict[str, Any], **image: Array) -> FrameFeatures:
    """One frame of one pixel: grey value, intensity and certainty."""
    none = jnp.zeros((2, 1, 1), gain.dtype)
    return FrameFeatures(
        **image,
        **fixed,
        gain=gain[0],
        span=none,
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


def combine(m: Array, precision: Array, later: Message) -> Gaussian:
    """What is known from before, with its precision 1 / P, and from later."""
    P = 1 / (precision + later.J)
    return Gaussian(m + P * (later.h - later.J * m), P)


def filter_forward(params: Params, rows: FrameSteps, state: Gaussian) -> tuple[Any, ...]:
    """Kalman filter over frames, arrays [frames, pixels].

    Returns the states before and after each frame, what each says, and its log likelihood.
    """

    def step(at: Gaussian, row: FrameSteps) -> tuple[Gaussian, Any]:
        after, said, log_likelihood = frame_update(params, at, row.measured)
        return Gaussian(after.m + row.S, after.P + row.q), (at, after, said, log_likelihood)

    return lax.scan(step, state, rows)[1]


def filter_backward(
    rows: FrameSteps, said: Message, last: Message, number: Any
) -> tuple[Message, Message]:
    """Information filter over frames: what is said before the first frame, and after each.

    `last` is what the last of the `number` frames and all later ones say.
    """

    def step(later: Message, row: Any) -> tuple[Message, Message]:
        i, own, S, q = row
        here = later.propagate_back(S, q) + own
        return jax.tree.map(lambda a, b: jnp.where(i == number - 1, a, b), last, here), later

    zero = jnp.zeros_like(rows.S[0])
    steps = (jnp.arange(len(rows.S)), said, rows.S, rows.q)
    return lax.scan(step, Message(zero, zero), steps, reverse=True)


def compose_message_maps(rows: FrameSteps, said: Message, anchor: Any, number: Any) -> MessageMap:
    """The link from the last of the `number` frames to the frame `anchor`."""

    def step(link: MessageMap, row: Any) -> tuple[MessageMap, None]:
        i, own, S, q = row
        longer = link.compose(MessageMap(one, S, q, own.h, own.J))
        inside = (i >= anchor) & (i < number - 1)
        return jax.tree.map(lambda a, b: jnp.where(inside, a, b), longer, link), None

    zero, one = jnp.zeros_like(rows.S[0]), jnp.ones_like(rows.S[0])
    steps = (jnp.arange(len(rows.S)), said, rows.S, rows.q)
    return lax.scan(step, MessageMap(one, zero, zero, zero, zero), steps)[0]


def adjacent_counts(
    params: Params, passage: "SmoothedWindow", points: ImagePoints
) -> tuple[Array, Array, Array, Array]:
    """ON and OFF events [2, times, pixels] since the frame before and until the frame after.

    Known are those since the left edge of the piece's exposure, or, before the first one, since
    the window's start. Also the seconds (times, 1) of both stretches.
    """
    frames, f = passage.frames, jnp.asarray(points.frame)
    rate = jnp.asarray(frames.blend_rate)[f][:, None]
    elapsed = jnp.asarray(points.elapsed)[:, None] - clock_lag(params, frames)
    behind = jnp.asarray(points.elapsed)[:, None] < 0  # before the first frame
    since = jnp.stack([points.on, points.off])
    between = jnp.take(passage.events, f, axis=1)
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
        redistribute_images(params, frames, since),
        redistribute_images(params, frames, until),
        elapsed,
        seconds,
    )


@renamed_methods(keep="frame_info", tell="readout")
@dataclasses.dataclass(frozen=True, repr=False)
class Smoother(PixelEstimator[Params]):
    """The estimator of this module."""

    has_likelihood: ClassVar[bool] = True
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "devices", "compiler", "factors"}), kw_only=True
    )

    @property
    def is_event_driven(self) -> bool:
        return False

    @property
    def needs_future(self) -> bool:
        return True

    def frame_info(
        self, params: Params, frames: FrameFeatures, measured: FrameMeasurements, events: Any
    ) -> Any:
        """What images need to know of frames beside the messages: arrays [frames, pixels].

        `events` [frames, pixels] lie within exposures; None where no exposure is known.
        """
        return ()

    def readout(self, params: Params, state: Gaussian, kept: Any, here: Array) -> Estimate:
        """Images of smoothed states; `here`: at the middle of the exposure of the frame before."""
        image = jnp.exp(state.m) - params.I0
        return Estimate(image, state.P, jnp.isfinite(image))

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
        """As `PixelEstimator.run`; the state is (pixels,), before the next window's first frame."""
        frames = features.at_dead_time(params.rho_ref).frames
        rows, counts = make_frame_steps(params, frames)
        state = self.init_state(params, features) if state is None else state
        number, anchor, onward = frames.rows
        ahead, past, said, likelihood = filter_forward(params, rows, state)
        last = jax.tree.map(lambda v: v[number - 1], said) if future is None else future
        first, later = filter_backward(rows, said, last, number)
        link = compose_message_maps(rows, said, anchor, number)
        first = first + state_to_message(state)
        events = None
        if frames.head is not None and frames.tail is not None:
            events = (jnp.asarray(frames.head) + frames.tail).sum(0)
        kept = self.frame_info(params, frames, rows.measured, events)
        passage = SmoothedWindow(
            past, later, first, counts, frames, kept, link, last, likelihood.sum(1)
        )
        return passage, jax.tree.map(lambda v: v.at[onward].get(mode="clip"), ahead)

    def read(self, params: Params, trajectory: SmoothedWindow, out: ReadOut) -> Estimate:
        points = out.at_dead_time(params.rho_ref).points
        f, behind = jnp.asarray(points.frame), jnp.asarray(points.elapsed)[:, None] < 0
        since, until, elapsed, seconds = adjacent_counts(params, trajectory, points)

        later = jax.tree.map(lambda v: v[f], trajectory.future)
        later = jax.tree.map(lambda a, b: jnp.where(behind, a, b), trajectory.first, later)
        later = later.propagate_back(*change_between(params, until[0], until[1], seconds))
        S, q = change_between(params, since[0], since[1], elapsed)
        # Before the first frame there is no past: its variance is without bound.
        m = jnp.where(behind, 0, trajectory.past.m[f] + S)
        precision = jnp.where(behind, 0, 1 / jnp.where(behind, 1, trajectory.past.P[f] + q))
        # Times are whole microseconds, the middle of an exposure may lie up to one before.
        here = ~behind & (jnp.asarray(points.elapsed)[:, None] < 1e-6)
        kept = jax.tree.map(lambda v: v[f], trajectory.kept)
        return self.readout(params, combine(m, precision, later), kept, here)

    def pixel_state_spec(self, number: Array) -> dict[str, Any]:
        """The trees of numbers that `pixel_functions` speaks of, all as the one given."""
        state, said = Gaussian(number, number), Message(number, number)
        return {"state": state, "said": said, "link": MessageMap(*[number] * 5)}

    def apply_message_map(self, link: NDArray, later: NDArray) -> NDArray:
        """Numbers of the message before several frames, from those of their link and the later."""
        message = MessageMap(*link).apply(Message(*later))
        return np.stack([message.h, message.J])

    def pixel_functions(self, exposed: bool) -> dict[str, Callable[..., dict[str, Any]]]:
        """What `run` and `read` do at one pixel, for kernels (`engine.smoother_program`).

        Functions of parameters, what is known with them, and numbers that kernels keep by name.
        """

        def lag(known):
            return known[0].clock_offset - known[1]["clock_offset"]

        def counted(params, on, off, around_on, around_off, given):
            return redistribute_events(params, on, around_on, given), redistribute_events(
                params, off, around_off, given
            )

        def frame(known, clipped, exists, gain, total, inside, state, **image):
            params, fixed = known
            frames = single_pixel_frame(gain, fixed, **image)
            z = jnp.log(frames.intensity + params.I0)
            z = deblur_level(params, z, total) if exposed else z
            measured = measure_frames(params, frames, z, exists)
            kept = self.frame_info(params, frames, measured, inside if exposed else None)
            side = measured.side
            if not clipped:
                measured = dataclasses.replace(measured, side=jnp.zeros_like(side))
            past, said, _ = frame_update(params, state, measured)
            return {"past": past, "said": said, "kept": kept, "side": side}

        def move(known, past, seconds, **counts):
            on, off = counted(known[0], **counts)
            S, q = change_between(known[0], on, off, seconds)
            return {"moved_on": on, "moved_off": off, "state": Gaussian(past.m + S, past.P + q)}

        def link(known, link, said, moved_on, moved_off, seconds):
            S, q = change_between(known[0], moved_on, moved_off, seconds)
            return {"link": link.compose(MessageMap(jnp.ones_like(S), S, q, said.h, said.J))}

        def back(known, later, said, moved_on, moved_off, seconds):
            here = (
                later.propagate_back(*change_between(known[0], moved_on, moved_off, seconds)) + said
            )
            return {"said": later, "later": here}

        def show(known, past, said, moved_on, moved_off, kept, elapsed, seconds, here, **counts):
            on, off = counted(known[0], **counts)
            rest = jnp.where(seconds > 0, seconds + lag(known), 0)
            left = change_between(known[0], moved_on - on, moved_off - off, rest)
            S, q = change_between(known[0], on, off, elapsed - lag(known))
            state = combine(past.m + S, 1 / (past.P + q), said.propagate_back(*left))
            return {"image": self.readout(known[0], state, kept, here)}

        def before(known, later, kept, seconds, **counts):
            left = change_between(known[0], *counted(known[0], **counts), seconds + lag(known))
            first = later + state_to_message(init(known[0]))
            zero = jnp.zeros_like(later.h)
            state = combine(zero, zero, first.propagate_back(*left))
            return {"image": self.readout(known[0], state, kept, zero > 0)}

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

    def estimate(
        self,
        recording: Recording,
        params: Params | None = None,
        *,
        compiler: str | None = None,
        **options: Any,
    ) -> ImageSequence[Params]:
        """As `Filter.estimate`: by a kernel on CPUs, in single precision.

        `run` and `read` serve in double precision, on other devices and on several. `factors` (2,
        pixels) are those of ON and OFF thresholds of single pixels. Raises `InputError`.
        """
        self.check_options(**options)
        params = self.Params() if params is None else params
        fused = video_from_kernel(SmootherVideo, self, recording, params, compiler, options)
        return Video(self, recording, params, **options) if fused is None else fused

    def prepare_images(
        self,
        recording: Recording,
        times: Times,
        params: Params | None = None,
        *,
        extrapolate: bool = False,
        compiler: str | None = None,
    ) -> PreparedImages:
        """As `Filter.prepare_images`."""
        params = self.Params() if params is None else params
        fused = images_from_kernel(
            SmootherImages,
            self,
            recording,
            times,
            params,
            extrapolate=extrapolate,
            compiler=compiler,
        )
        if fused is not None:
            return fused
        return super().prepare_images(recording, times, params, extrapolate=extrapolate)

    def log_likelihood(self, params: Params, features: Features) -> Float[Array, ""]:
        """Of all frames of a prepared recording, given its events: a sum over frames and pixels."""
        return self.run(params, features)[0].log_likelihood.sum()


aks = Smoother(
    "aks",
    Params,
    needs_frames=True,
    about="The asynchronous Kalman smoother. Per pixel it estimates the log intensity from all "
    "frames and events, earlier and later ones, with its variance; an event's change is shared "
    "with the neighbours, and the frames' likelihood can be fitted.",
)

__getattr__ = renamed_names(__name__)
