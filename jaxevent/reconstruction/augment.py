"""Models of the log intensity at any time, from frames: deblurring, integration, interpolation.

Equation numbers are those of Wang et al., "An Asynchronous Kalman Filter for Hybrid Event Cameras",
ICCV 2021. Letters: L log intensity ln(I + I0), c contrast threshold, T exposure, tau mid-exposure.
Each model makes its tables, [rows, pixels], once per window. Called with points (their positions
among the frames, `features.Points`) it looks the tables up.
"""

import functools
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.calibration import CalibratedValues, recall_calibration, recall_numbers
from jaxevent.calibration.clipping import find_clipping
from jaxevent.calibration.sampling import Sample
from jaxevent.parameters import THRESHOLDS, Choice, Number, Parameters, Positive
from jaxevent.precision import full_precision
from jaxevent.reconstruction.consistency import (
    events_contradict_frames,
    thresholds_are_doubtful,
)
from jaxevent.reconstruction.features import FrameFeatures, Points
from jaxevent.reconstruction.refinement import choose, refine
from jaxevent.recording import Recording, check_recording

LONG_EXPOSURE = 0.25  # of the time between frames
MIN_MEASURED_SHARE = 1e-6  # of frames that are clipped, so that two of them have weights

T = TypeVar("T", bound="FrameParams")


class FrameParams(Parameters):
    """Parameters of every estimator: thresholds, dead time, and the frames' clock and offset."""

    c_on: Positive = Positive(0.1, "ln I", "contrast threshold of ON events")
    c_off: Positive = Positive(0.1, "ln I", "contrast threshold of OFF events")
    I0: Positive = Positive(
        1.0, "intensity", "offset inside the logarithm, L = ln(I + I0)", least=1e-6
    )
    clock_offset: Number = Number(
        0.0, "s", "added to the frames' time stamps", gradient=False, least=-1e10, most=1e10
    )
    event_delay: Number = Number(
        0.0,
        "s",
        "time by which events lag behind the changes that they stand for; images do not lag",
        gradient=False,
        least=-1e10,
        most=1e10,
    )
    deblur: Choice = Choice((True, False), "deblur frames by the events within their exposures")
    exposure: Positive = Positive(
        0.0, "s", "exposure of frames whose own is not known", gradient=False, most=1e6
    )
    rho_ref: Positive = Positive(
        0.0,
        "s",
        "dead time of a pixel after an event; lost events are compensated",
        gradient=False,
        most=1e6,
    )

    calibrated = ("clock_offset", "c_on", "c_off")
    # The method whose predictions of hidden frames say whether `calibrated_if_needed` numbers are
    # better than defaults; its module sets it. None: they are taken without that.
    validator: ClassVar[Any] = None

    @property
    def frame_delay(self) -> Any:
        """Time added to the frames' stamps to be beside the events that show the same, s."""
        offset, delay = self.clock_offset, self.event_delay
        if isinstance(offset, Tracer) or isinstance(delay, Tracer):
            return offset + delay
        return np.add(offset, delay)  # for which JAX would compile a program

    def beside_events(self: T) -> T:
        """Return the parameters with the frames' clock moved by the delay, for times of events."""
        return self.replace(clock_offset=self.frame_delay, event_delay=0.0)

    @classmethod
    def predictor(cls) -> Any:
        """Return the method whose predictions of hidden frames refine a calibration, or None.

        Parameters of another class take over what it finds.
        """
        return None

    @classmethod
    def for_recording(cls: type[T], recording: Recording, **explicit: Any) -> T:
        """Return parameters with the clock and the thresholds that a recording shows.

        They are kept in the user's cache folder for recordings of the same content.

        Args:
            recording: Events and frames, which `jaxevent.calibrate` calibrates.
            **explicit: Values that win over those found, one by one; those of a preset do, too.

        Returns:
            The parameters; defaults where the recording does not determine a number.
        """
        check_recording(recording, "Params.for_recording")
        params = cls(**explicit)
        values = calibrated_values(recording, params, cls.names_left_open(explicit))
        return params.replace(**values.found)


def calibrated_values(
    recording: Recording, params: FrameParams, names: Sequence[str], sample: Sample | None = None
) -> CalibratedValues:
    """Calibrate some numbers by a recording, thresholds at the `I0` of parameters.

    Parameters with a `predictor` take the numbers by which this method predicts hidden frames of
    the recording best, sought from the calibration on.

    Args:
        recording: Events and frames.
        params: Parameters.
        names: Names of the numbers; none, or fewer than two frames, calibrate nothing.
        sample: A sample of the recording; None: it is taken where it is needed.

    Returns:
        The values.
    """
    if not names or recording.frames is None or len(recording.frames) < 2:
        return CalibratedValues({}, {})
    of_events = {*THRESHOLDS, "rho_ref"}  # the dead time belongs to its thresholds
    if_needed = of_events.intersection(names).intersection(params.calibrated_if_needed)
    if if_needed:
        others = [name for name in names if name not in if_needed]
        values = calibrated_values(recording, params, others, sample)
        known = _numbers_if_needed(
            recording,
            params.replace(**values.found),
            sorted(if_needed),
            sample,
            "event_delay" in names,
        )
        missing = {**values.missing, **known.missing}
        return CalibratedValues(values.found, missing).updated(known.found, names)
    I0 = _rounded_I0(params) if THRESHOLDS.intersection(names) else 1.0
    calibration, method = recall_calibration(recording, I0, sample), params.predictor()
    values = calibration.select(names)
    if method is None or values.missing or not calibration.clock_offset.is_identifiable:
        return values
    if method.Params is not type(params):
        of_method = calibrated_values(
            recording, method.Params(), method.Params.calibrated, sample
        ).found
        return values.updated(of_method, names)
    start = params.replace(**values.found)
    others = [start.replace(**{n: v for n, v in params.values().items() if n in THRESHOLDS})]

    moved = [name for name in names if name != "clock_offset"]

    def compute() -> dict[str, float]:
        return refine(method, recording, start, moved, others)

    what = f"{type(params).__module__} {' '.join(names)} {start.values()}"
    return values.updated(recall_numbers(recording, what, compute), names)


def _rounded_I0(params: FrameParams) -> float:
    return float(f"{float(params.I0):.6g}")


def _numbers_if_needed(
    recording: Recording,
    params: FrameParams,
    names: Sequence[str],
    sample: Sample | None,
    delay_is_open: bool,
) -> CalibratedValues:
    """Return the numbers of events that a recording calls for in place of defaults.

    It does where frames reach their white, beyond which events alone tell how bright points are,
    and where events and frames differ at the defaults. In the second case numbers are taken if they
    predict hidden frames better; of long exposures, whose means images at one time do not predict,
    if events contradict frames.

    Args:
        recording: Events and frames.
        params: Parameters, of which those of the clock are calibrated.
        names: Names of the numbers.
        sample: A sample of the recording; None: it is taken where it is needed.
        delay_is_open: Whether the delay of events may change with them.

    Returns:
        The values, with a delay of events that goes with them; none where defaults do.
    """
    clipped = find_clipping(recording).white.level is not None
    validator = None if clipped or _exposures_are_long(recording, params) else params.validator
    is_needed = thresholds_are_doubtful if validator is not None else events_contradict_frames
    if not (clipped or is_needed(recording, params)):
        return CalibratedValues({}, {})
    # Those of a predictor would hold at its own I0.
    calibration = recall_calibration(recording, _rounded_I0(params), sample)
    found = calibration.select(names)
    if found.missing or validator is None:
        return CalibratedValues({} if found.missing else found.found, found.missing)
    rho = found.found.get("rho_ref")
    # The shortest gaps between events bound a dead time from above alone.
    dead = [{}] if rho is None else [{}, {"rho_ref": rho}, {"rho_ref": rho / 2}]
    thresholds = [
        {**{name: c for name, c in pair.items() if name in found.found}, **lost}
        for pair in calibration.threshold_candidates()
        for lost in dead
    ]
    # The calibrated delay makes up in part for the dead time that the predictor leaves out.
    delays = [{"event_delay": 0.0}] if delay_is_open else []
    steps = [thresholds, delays]

    def compute() -> dict[str, float]:
        return choose(validator, recording, params, steps)

    what = f"{type(params).__module__} {steps} {params.values()}"
    return CalibratedValues(recall_numbers(recording, what, compute), {})


def _exposures_are_long(recording: Recording, params: FrameParams) -> bool:
    """Return whether exposures take much of the time between frames."""
    frames = recording.frames
    assert frames is not None
    exposure = np.where(frames.exposure > 0, frames.exposure, 1e6 * float(params.exposure))
    return bool(np.median(exposure) > LONG_EXPOSURE * np.median(np.diff(frames.t)))


class CertaintyParams(FrameParams):
    """Parameters of the certainty of frames (4), as far as the response leaves it open."""

    w_min: Positive = Positive(
        0.09, "1", "least certainty w of frames, and that of clipped pixels", least=1e-9
    )
    margin: Positive = Positive(
        0.0, "grey / 255", "distance from black and white within which frames clip"
    )
    certainty: Positive = Positive(
        (1.0,), "1", "factors on the certainty w at evenly spaced greys, a spline in ln w"
    )


class AugmentParams(CertaintyParams):
    """Parameters of the augmented frame: calibrated contrasts (10), weights of two frames."""

    calibrate: Choice = Choice((True, False), "fit each pixel's threshold between frames")
    ratio_min: Positive = Positive(
        0.01, "1", "smallest accepted ratio of calibrated to nominal threshold", gradient=False
    )
    ratio_max: Positive = Positive(
        1 / 0.6, "1", "largest accepted ratio of calibrated to nominal threshold", gradient=False
    )
    ratio_width: Positive = Positive(
        0.4, "1", "width about both bounds over which ratios fade to 1; 0: hard", gradient=False
    )
    weighting: Choice = Choice(
        ("linear", "certainty"), "weights of two frames between them: by time, or by certainty too"
    )


def integrate_counts(params: FrameParams, on: Array, off: Array) -> Array:
    """Return the change of log intensity that event counts report: the sum of s c.

    Args:
        params: Thresholds `c_on` and `c_off`, ln I.
        on: Number of ON events, of any shape.
        off: Number of OFF events, of the same shape.

    Returns:
        The change, ln I.
    """
    return params.c_on * on - params.c_off * off


def event_change(params: FrameParams, polarity: Array, since: Array) -> Array:
    """Return the change of log intensity that one event reports.

    With a dead time rho an event stands for dt / (dt - rho) events, at most 3 (`EventTiming`).

    Args:
        params: Thresholds, ln I, and dead time `rho_ref`, s.
        polarity: +1, -1, or 0 for no event.
        since: Time since the pixel's last event, s.

    Returns:
        The change, ln I.
    """
    rho = params.rho_ref
    near = since <= 1.5 * rho
    events = jnp.where(near, 3, since / jnp.where(near, 1, since - rho))
    return integrate_counts(params, polarity > 0, polarity < 0) * jnp.where(rho > 0, events, 1)


@runtime_checkable
class GreyFrames(Protocol):
    """Frames as the camera gave them, a part of `FrameFeatures`."""

    @property
    def grey(self) -> Any:
        """Grey values (frames, pixels), 0 to 1."""

    @property
    def response(self) -> Any:
        """Intensities (256,) of evenly spaced grey values."""

    @property
    def gain(self) -> Any:
        """Exposures (frames,) relative to the common one."""

    @property
    def white(self) -> Any:
        """Grey value from which on frames are clipped, and mean ln I beyond; None: they are not."""


def unclipped_weight(params: CertaintyParams, frames: GreyFrames) -> Float[Array, "frames pixels"]:
    """Return 1 where a grey value shows the intensity, 0 where it is black or white.

    A clipped pixel with noise reads a few grey values from the end. The edge at `margin` is soft, a
    tenth of a grey value wide, so that the margin can be fitted by gradient.

    Args:
        params: `margin`, grey / 255.
        frames: The frames.

    Returns:
        (frames, pixels), 0 to 1.
    """
    grey = jnp.asarray(frames.grey)
    distance = 255 * jnp.minimum(grey, 1 - grey)
    inside = jax.nn.sigmoid(10 * (distance - params.margin))
    found = 1 if frames.white is None else jax.nn.sigmoid(2550 * (frames.white[0] - grey))
    return jnp.where(params.margin > 0, inside, found)


@full_precision
def certainty(params: CertaintyParams, frames: FrameFeatures) -> Float[Array, "frames pixels"]:
    """Return the certainty w of every frame and pixel, whether it is clipped or not.

    Args:
        params: Factors `certainty` on w and its least value `w_min`.
        frames: The frames.

    Returns:
        (frames, pixels), at least `w_min`.
    """
    w = frames.certainty
    knots = params.certainty
    if len(knots) == 1:
        w = w * knots[0]
    else:
        table = jnp.exp(_spline_matrix(len(knots)) @ jnp.log(knots))
        place = jnp.asarray(frames.grey) * (N_SPLINE_SAMPLES - 1)
        below = jnp.clip(place.astype(int), 0, N_SPLINE_SAMPLES - 2)
        part = place - below
        w = w * ((1 - part) * table[below] + part * table[below + 1])
    return jnp.maximum(w, params.w_min)


def effective_certainty(
    params: CertaintyParams, frames: FrameFeatures
) -> Float[Array, "frames pixels"]:
    """Return the certainty w of each frame and pixel, with clipped pixels at `params.w_min`.

    Args:
        params: Parameters of the certainty.
        frames: The frames.

    Returns:
        (frames, pixels), at least `w_min`.
    """
    clear = unclipped_weight(params, frames)
    return clear * certainty(params, frames) + (1 - clear) * params.w_min


def measured_share(
    params: CertaintyParams, frames: GreyFrames
) -> Float[Array, "frames pixels"] | None:
    """Return 1 where a frame measures the intensity and hardly anything where it is clipped.

    Args:
        params: `margin`, grey / 255.
        frames: The frames.

    Returns:
        (frames, pixels), above 0; None where frames do not clip.
    """
    if frames.white is None:
        return None
    return jnp.maximum(unclipped_weight(params, frames), MIN_MEASURED_SHARE)


def clipped_side(params: CertaintyParams, frames: GreyFrames) -> Float[Array, "frames pixels"]:
    """Return +1 where a frame is clipped at white, -1 where at black, 0 where it is not.

    Args:
        params: `margin`, grey / 255.
        frames: The frames.

    Returns:
        (frames, pixels); between 0 and 1 in size within the soft edge.
    """
    return jnp.where(_is_bright(params, frames), 1, -1) * (1 - unclipped_weight(params, frames))


def _is_bright(params: CertaintyParams, frames: GreyFrames) -> Array:
    """Return whether a grey value is nearer to the white end than to the black one.

    Frames that were found to clip do so at white, which may be any grey value.
    """
    bright = jnp.asarray(frames.grey) > 0.5
    return bright if frames.white is None else bright | (params.margin <= 0)


def clipping_bound(params: CertaintyParams, frames: GreyFrames) -> Float[Array, "frames pixels"]:
    """Return the log intensity at which pixels begin to clip, that of a grey `margin` from the end.

    Args:
        params: `margin`, grey / 255, and `I0`.
        frames: The frames.

    Returns:
        (frames, pixels), ln I, of the end that is nearer to the grey value.
    """
    greys, response = jnp.arange(256), jnp.asarray(frames.response)
    margin = jnp.clip(params.margin, 0, 127)
    gain = jnp.asarray(frames.gain)[:, None]
    dark, bright = (
        jnp.log(jnp.interp(margin, greys, end) / gain + params.I0)
        for end in (response, response[::-1])
    )
    if frames.white is not None:
        white = jnp.log(_white_intensity(frames) + params.I0)
        bright = jnp.where(params.margin > 0, bright, white)
    return jnp.where(_is_bright(params, frames), bright, dark)


def _white_intensity(frames: GreyFrames) -> Array:
    """Return the intensity (frames, 1) at the grey value from which on frames are clipped."""
    greys, response = jnp.arange(256), jnp.asarray(frames.response)
    return jnp.interp(255 * frames.white[0], greys, response) / jnp.asarray(frames.gain)[:, None]


def expected_excess(params: FrameParams, frames: GreyFrames) -> Float[Array, "frames 1"] | None:
    """Return the distance beyond white that is expected of clipped pixels.

    Args:
        params: `I0`.
        frames: The frames.

    Returns:
        (frames, 1), ln(I + I0); None where frames do not clip.
    """
    if frames.white is None:
        return None
    white = _white_intensity(frames)
    return jnp.log1p(white * jnp.expm1(frames.white[1]) / (white + params.I0))


N_SPLINE_SAMPLES = 256


@functools.lru_cache
def _spline_matrix(knots: int) -> NDArray[np.floating]:
    """Return the natural cubic spline through evenly spaced knots as a matrix (points, knots)."""
    from scipy.interpolate import CubicSpline

    if knots < 3:
        return np.linspace([1.0, 0.0], [0.0, 1.0], N_SPLINE_SAMPLES)
    kind = CubicSpline(np.linspace(0, 1, knots), np.eye(knots), bc_type="natural")
    return kind(np.linspace(0, 1, N_SPLINE_SAMPLES))


def clock_lag(params: FrameParams, frames: FrameFeatures) -> Float[Array, ""]:
    """Return the seconds by which the frames' clock differs from the prepared one; 0 in a `Video`.

    Args:
        params: `clock_offset` and `event_delay`, s.
        frames: Features that were prepared for some such times.

    Returns:
        (), s.
    """
    return params.frame_delay - frames.frame_delay


def segment_excess(params: FrameParams, share: Array, on: Array, off: Array) -> Array:
    """Return the part that a segment of an exposure adds to m - 1, see `deblur_frames`.

    Args:
        params: Thresholds.
        share: Fraction of the exposure that the segment fills.
        on: ON events from mid-exposure to the segment, negative before.
        off: OFF events, likewise.

    Returns:
        The part, of the shape of `share`.
    """
    return share * jnp.expm1(integrate_counts(params, on, off))


def deblur_level(params: FrameParams, level: Array, total: Array) -> Array:
    """Return the log intensity at mid-exposure, from that of the exposure's mean.

    Args:
        params: `deblur`.
        level: Log intensity of the mean, ln I.
        total: Sum of `segment_excess` over the exposure.

    Returns:
        The log intensity, ln I.
    """
    return level - jnp.log1p(total) * params.deblur


def deblur_frames(
    params: FrameParams,
    frames: FrameFeatures,
    shift: Float[Array, "frames pixels"] | float = 0.0,
) -> tuple[Float[Array, "frames pixels"], Float[Array, "frames pixels"]]:
    """Return the log intensity at both edges of each exposure (event double integral).

    The exposure averages exp(E(t)), E the events' change since mid-exposure. E is piecewise
    constant, so the mean is exact: m = 1 + sum over segments of share (exp(E) - 1), and
    l(D) = ln((I + I0) / m).

    Args:
        params: Thresholds, `I0` and `deblur`.
        frames: The frames.
        shift: Added to ln(I + I0), ln I.

    Returns:
        Log intensity at the left and at the right edge, each (frames, pixels), ln I.
    """
    level = jnp.log(frames.intensity + params.I0) + shift
    if frames.segments is None or frames.head is None or frames.tail is None:
        return level, level
    s = frames.segments
    excess = segment_excess(params, s.share + clock_lag(params, frames) * s.edge, s.on, s.off)
    total = jax.ops.segment_sum(excess, s.frame_cell, level.size).reshape(level.shape)
    level = deblur_level(params, level, total)
    return (
        level - integrate_counts(params, frames.head[0], frames.head[1]),
        level + integrate_counts(params, frames.tail[0], frames.tail[1]),
    )


def _shift_endpoints(lag: Array, here: Array, there: Array) -> tuple[Array, Array]:
    """Shift the end points of a linear interpolation.

    The blend with weight w becomes what the blend with weight w - lag was.

    Args:
        lag: Shift of the weight.
        here: Values for weight 0.
        there: Values for weight 1.

    Returns:
        The values for weight 0 and 1.
    """
    drift = lag * (here - there)
    return here + drift, there + drift


def frame_information(
    params: AugmentParams, frames: FrameFeatures
) -> Float[Array, "frames pixels"]:
    """Return w (I + I0)^2, the information rate of each frame on log intensity.

    Args:
        params: Parameters of the certainty, and `I0`.
        frames: The frames.

    Returns:
        (frames, pixels), in units of `kappa`.
    """
    return effective_certainty(params, frames) * (frames.intensity + params.I0) ** 2


class LogIntensityModel(eqx.Module):
    """A model of the log intensity at any time, made of a window's frames."""

    Params: ClassVar[type[FrameParams]] = FrameParams

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        raise NotImplementedError

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        raise NotImplementedError


def bound_ratio(params: AugmentParams, ratio: Array, known: Array) -> Array:
    """Replace calibrated over nominal thresholds by 1 where out of bounds or not known (10).

    Within `ratio_width` / 2 of a bound a ratio r becomes 1 + w (r - 1), with the weight
    w = t^2 (3 - 2 t) for t that rises from 0 to 1 across the bound. So images do not jump as the
    parameters change. Elsewhere the bounds are hard.

    Args:
        params: Bounds and width, as ratios.
        ratio: (frames, pixels).
        known: Where there is a ratio, (frames, pixels).

    Returns:
        (frames, pixels).
    """
    above, below = ratio - params.ratio_min, params.ratio_max - ratio
    width = params.ratio_width
    weight = jnp.where((above >= 0) & (below >= 0), 1.0, 0.0)
    inside = jnp.minimum(above, below)  # of the nearer bound: the other one's weight is 1 or 0
    t = jnp.clip(inside / jnp.where(width > 0, width, 1) + 0.5, 0, 1)
    weight = jnp.where(width > 0, t * t * (3 - 2 * t), weight)
    return jnp.where(known & (weight > 0), 1 + weight * (ratio - 1), 1)


class AugmentedFrame(LogIntensityModel):
    """L^A(t), (8)-(11): between two deblurred frames, integrated from both with c calibrated.

    Each piece blends two lines base + ratio S, S the nominal integral of events since the left edge
    of the piece's exposure. The calibrated threshold is `ratio` times the nominal one (10).

    Weighted by certainty, the lines of a gap count by (1 - u) / R_k and u / R_{k+1} instead of 1 -
    u and u, R = 1 / (w (I + I0)^2). So a clipped frame does not act against a good one. `tilt` is
    R_k / R_{k+1}. At the ends of the gap the estimate is the same.

    Args:
        params: Parameters of the augmented frame.
        frames: Frames of a window, and the events around them.
        shift: (frames, pixels) ln I, added to the frames' log intensity; 0: none.
    """

    Params = AugmentParams
    params: AugmentParams
    from_base: Float[Array, "pieces pixels"]  # ln I, of the line that counts at a piece's start
    from_ratio: Float[Array, "pieces pixels"]  # calibrated over nominal threshold, of that line
    to_base: Float[Array, "pieces pixels"]  # ln I, of the line that counts at a piece's end
    to_ratio: Float[Array, "pieces pixels"]
    tilt: Float[Array, "pieces pixels"] | None
    lag: Float[Array, " pieces"]  # of the frames' clock, as a fraction of the piece

    def __init__(
        self,
        params: AugmentParams,
        frames: FrameFeatures,
        shift: Float[Array, "frames pixels"] | float = 0.0,
    ):
        left, right = deblur_frames(params, frames, shift)
        # Row f is the change from frame f to frame f + 1.
        span = integrate_counts(params, frames.span[0], frames.span[1])
        following = jnp.roll(right, -1, axis=0)
        known = (span != 0) & params.calibrate
        shown = measured_share(params, frames)
        if shown is not None:
            # A clipped frame tells that the level is no lower, an unclipped one beside it how high.
            here, there = shown > 0.5, jnp.roll(shown, -1, axis=0) > 0.5
            begin = jnp.where(there & ~here, jnp.maximum(left, following - span), left)
            following = jnp.where(here & ~there, jnp.maximum(following, left + span), following)
            left, known = begin, known & (here | there)
        ratio = (following - left) / jnp.where(span == 0, 1, span)
        ratio = bound_ratio(params, ratio, known)

        # Before the first exposure: backwards from its right edge with the nominal threshold.
        first = right[0] - integrate_counts(params, frames.before[0], frames.before[1])
        one = jnp.ones_like(first)
        before = (first, one, first, one)
        # In the gap after frame f: forwards from its left edge (8), backwards from the next one's
        # right edge (9). After the last frame span is 0, so the forward line is nominal.
        gap = (left, ratio, following - ratio * span, ratio)
        if frames.head is None or frames.tail is None:
            rows = [jnp.concatenate([b[None], g]) for b, g in zip(before, gap, strict=True)]
        else:
            # Within exposure f: from the backward line of the interval before it to the forward
            # line of the one after it (11).
            back = jnp.concatenate([one[None], ratio[:-1]])
            own = frames.head + frames.tail
            inside = (right - back * integrate_counts(params, own[0], own[1]), back, left, ratio)
            rows = [
                jnp.concatenate([b[None], jnp.stack([e, g], 1).reshape(-1, len(first))])
                for b, e, g in zip(before, inside, gap, strict=True)
            ]
        from_base, from_ratio, to_base, to_ratio = rows
        self.params = params
        self.lag = clock_lag(params, frames) * frames.weight_rate
        self.tilt = None
        if params.weighting == "certainty":
            trust = frame_information(params, frames)
            q = jnp.roll(trust, -1, axis=0) / trust
            one = jnp.ones_like(q)
            between = [q] if frames.head is None else [one, q]
            self.tilt = jnp.concatenate([one[:1], jnp.stack(between, 1).reshape(-1, q.shape[1])])
            self.from_base, self.to_base = from_base, to_base
            self.from_ratio, self.to_ratio = from_ratio, to_ratio
        else:
            lag = self.lag[:, None]
            self.from_base, self.to_base = _shift_endpoints(lag, from_base, to_base)
            self.from_ratio, self.to_ratio = _shift_endpoints(lag, from_ratio, to_ratio)

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        S = integrate_counts(self.params, points.on, points.off)
        u = points.weight
        if self.tilt is not None:
            pixels = self.tilt.shape[1]
            u = u - points.gather_piece_value(self.lag, pixels)
            toward = u * points.gather_piece(self.tilt)
            u = toward / (1 - u + toward)
        forward = points.gather_piece(self.from_base) + points.gather_piece(self.from_ratio) * S
        backward = points.gather_piece(self.to_base) + points.gather_piece(self.to_ratio) * S
        return (1 - u) * forward + u * backward


class EventIntegral(LogIntensityModel):
    """The latest deblurred frame plus the events since, with nominal thresholds (EDI)."""

    params: FrameParams
    base: Float[Array, "pieces pixels"]  # ln I at the left edge of the piece's exposure

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        left, right = deblur_frames(params, frames)
        first = right[0] - integrate_counts(params, frames.before[0], frames.before[1])
        if frames.head is not None:  # an exposure and the gap after it are two pieces
            left = jnp.repeat(left, 2, axis=0)
        self.params, self.base = params, jnp.concatenate([first[None], left])

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return points.gather_piece(self.base) + integrate_counts(self.params, points.on, points.off)


class ZeroOrderHold(LogIntensityModel):
    """The last frame whose mid-exposure has passed; before it, the first one."""

    level: Float[Array, "frames pixels"]  # ln(I + I0)

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        self.level = jnp.log(frames.intensity + params.I0)

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return points.gather_frame(self.level)


class LinearBlend(LogIntensityModel):
    """Intensity linear in time between two frames."""

    I0: Float[Array, ""]  # offset of intensity, as in ln(I + I0)
    image: "FrameInterpolation"

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        self.I0 = params.I0
        self.image = FrameInterpolation(params, frames, jnp.asarray(frames.intensity))

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return jnp.log(self.image(points) + self.I0)


class NoFrames(LogIntensityModel):
    """Log intensity 0 at all times, for methods that take no frames."""

    def __init__(self, params: FrameParams, frames: FrameFeatures):
        pass

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        return jnp.zeros(points.on.shape, points.weight.dtype)


class FrameInterpolation(eqx.Module):
    """A quantity known at mid-exposures: linear in time between them, constant outside.

    Args:
        params: `clock_offset` and `event_delay`, s.
        frames: Frames of a window.
        table: (frames, pixels) values at mid-exposure.
    """

    here: Float[Array, "frames pixels"]  # values at mid-exposure of a frame, of the table's unit
    there: Float[Array, "frames pixels"]  # values at mid-exposure of the next one

    def __init__(
        self, params: FrameParams, frames: FrameFeatures, table: Float[Array, "frames pixels"]
    ):
        lag = clock_lag(params, frames) * frames.blend_rate[:, None]
        self.here, self.there = _shift_endpoints(lag, table, jnp.roll(table, -1, axis=0))

    def __call__(self, points: Points) -> Float[Array, "*points"]:
        v = points.blend
        return (1 - v) * points.gather_frame(self.here) + v * points.gather_frame(self.there)
