"""Data of a window: its events, pixels of its frames, and priors.

A pixel u of a frame at t_f shows the scene's log intensity itself, but for the frame's brightness:

    L(x_ref(u, t_f)) = ln(I_f(u) + DARK) / C + g_f.

So the pixels of a frame are a series of their own, whose mean is unknown. The contrast threshold C
is the change of the logarithm from frame to frame per event, where events were several: between the
regression lines of either by the other, as both are noisy. If they do not agree, as in frames of
another view, or with the polarities exchanged, frames are left out.

Stamps of frames may be off by some ms. `stamp_offset` finds the offset at which changes from frame
to frame agree best with the events between them.
"""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.cache import cache_method
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle.alignment import WindowEvents
from jaxevent.egomotion.bundle.residuals import PixelSeries
from jaxevent.egomotion.bundle.warp import N_WINDOW_SEGMENTS, Prior, segment_times
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.motion import lens_error
from jaxevent.egomotion.truth import Twists
from jaxevent.parameters import Choice, Count, Parameters, Positive
from jaxevent.recording import Recording

DEPTH_NODE_SPACING_PX = 4  # between nodes of depth
VIEW_MARGIN_PX = 24  # of the reference view around the sensor
SKEW_CELL_PX = 24  # within which errors of the skew are alike
MIN_SKEW_SIGMA = 0.03  # standard deviation of the thresholds' skew by counts, at least

DARK_GREY_OFFSET = 0.02  # grey, added before the logarithm
UNCLIPPED_GREY_RANGE = 0.03, 0.97  # grey, range in which a pixel shows an intensity
MIN_NET_EVENTS = 2  # of one polarity, that count for the threshold
MIN_THRESHOLD_PIXELS = 200  # with so many events
MIN_EVENT_CORRELATION = 0.5  # of changes and events
STEEP_PIXEL_SHARE = 0.5  # of pixels, those with the steepest surroundings, that are fitted
QUANTISATION_NOISE_GREY = 1 / 512  # grey, the noise of 8 bits
EVENT_NOISE_THRESHOLDS = 0.1  # C, of events; noisier pixels count less
N_FRAME_PAIRS = 20  # with most events between them, that determine the offset of stamps
MAX_STAMP_OFFSET_US = 20_000  # of stamps
# The second difference in x and y of a pixel, 6 times its noise (Immerkaer, 1996).
NOISE_KERNEL = np.outer([1, -2, 1], [1, -2, 1])


class StampOffsetMethod(NamedTuple):
    """Estimate of a pixel's level at a frame, between the events before and after it."""

    following_us: int  # within which the next event after a frame is looked for
    requires_next: bool  # whether pixels without one are left out
    step_us: int  # between offsets that are tried


# Both methods must find the same offset within MAX_STAMP_OFFSET_DIFFERENCE_US, else it is taken for
# 0: walls of little contrast do not determine it.
STAMP_OFFSET_METHODS = (
    StampOffsetMethod(50_000, False, 2000),
    StampOffsetMethod(100_000, True, 4000),
)
MAX_STAMP_OFFSET_DIFFERENCE_US = 2000

FramePair = tuple[NDArray, NDArray, NDArray]


class Params(Parameters):
    """Parameters of the fit of a window, and of the sequence of windows."""

    half_window: Positive = Positive(
        0.15, "s", "half the length of a window; first alignments use 1/3 and 2/3 of it"
    )
    step: Positive = Positive(0.1, "s", "time from one window to the next")
    events: Count = Count(60000, "", "most events of a window, of pixels taken at random")
    fewest: Count = Count(2000, "", "events that a window needs")
    fresh: Count = Count(
        5, "", "windows until new starts compete; twice as many each time they agree"
    )
    starts: Count = Count(3, "", "headings that are refined, of each of two short windows")
    cell: Count = Count(24, "px", "size of a cell of one depth")
    iterations: Count = Count(8, "", "steps of the alignment of segments on the whole window")
    rivals: Count = Count(
        3, "", "aligned starts, some degrees apart, that the bundle adjustment refines"
    )

    smooth: Positive = Positive(1.0, "", "weight of differences of log depth between cells")
    relief: Positive = Positive(0.1, "", "weight of differences of log depth from its mean")
    change: Positive = Positive(
        0.02, "1/px^2", "weight of changes of the twist, in px at the window's end"
    )
    bond: Positive = Positive(1.0, "", "weight of differences of log depth between nodes")
    flat: Positive = Positive(
        0.01, "1/C^2", "weight of differences of log intensity between pixels"
    )
    alike: Positive = Positive(
        10.0, "", "number of events that count as one, as their errors are alike"
    )
    gyro_std: Positive = Positive(0.03, "rad/s", "standard deviation of a gyro, if one is given")
    frames: Choice = Choice((True, False), "whether frames are fitted beside the events")
    flow_max: Positive = Positive(
        220.0, "px/s", "largest flow of patches that is tried, without the rotation"
    )


class FramePixels(NamedTuple):
    """Pixels of a window's frames, row by row."""

    t: NDArray[np.int64]  # (frames,) us
    level: NDArray[np.float64]  # (frames, pixels) log intensity, in units of the threshold
    precision: NDArray[np.float64]  # likewise, noise of an event over the pixel's; 0: unknown
    steep: NDArray[np.bool_]  # (pixels,) whether a pixel is fitted


def read_frame_pixels(
    recording: Recording, first: int, last: int, delay_us: int = 0
) -> FramePixels | None:
    """Read the frames of a window as levels.

    Args:
        recording: Events and frames.
        first: Begin of the window, us.
        last: End of the window, us.
        delay_us: Added to the frames' stamps.

    Returns:
        The levels; None for fewer than two frames, and if they do not agree with the events.
    """
    frames = recording.frames
    if frames is None:
        return None
    rows = np.flatnonzero((frames.t + delay_us > first) & (frames.t + delay_us < last))
    if len(rows) < 2:
        return None
    grey = frames[slice(int(rows[0]), int(rows[-1]) + 1)].intensity.astype(np.float64)
    t = frames.t[rows] + delay_us
    level, known = _log_levels(grey)
    threshold = _contrast_threshold(recording, t, level, known)
    if threshold is None:
        return None
    rough = np.abs([scipy.ndimage.convolve(image, NOISE_KERNEL) for image in grey])
    noise = max(1.48 / 6 * float(np.median(rough)), QUANTISATION_NOISE_GREY)
    slopes = np.hypot(*np.gradient(level.mean(0)))
    seen = known.all(0)
    steep = (
        seen & (slopes >= np.quantile(slopes[seen], 1 - STEEP_PIXEL_SHARE)) if seen.any() else seen
    )
    precision = (
        np.minimum(1, EVENT_NOISE_THRESHOLDS * threshold * (grey + DARK_GREY_OFFSET) / noise)
        * known
    )
    flat = len(t), -1
    return FramePixels(t, level.reshape(flat) / threshold, precision.reshape(flat), steep.ravel())


def stamp_offset(recording: Recording) -> int:
    """Estimate the offset, us, to add to frames' stamps; 0 if the events do not determine it."""
    frames = recording.frames
    if frames is None or len(frames.t) < 2:
        return 0
    lasts, begins = np.diff(frames.t), [recording.events.index(int(t)) for t in frames.t]
    most = min(MAX_STAMP_OFFSET_US, int(lasts.min()) // 2)
    pairs: list[FramePair] = []
    for k in np.argsort(-np.diff(begins), kind="stable")[:N_FRAME_PAIRS]:
        level, known = _log_levels(frames[slice(int(k), int(k) + 2)].intensity.astype(np.float64))
        pairs.append((frames.t[k : k + 2], level, np.all(known, axis=0)))
    found = _best_offset(recording, pairs, most, STAMP_OFFSET_METHODS[0])
    other = None if found is None else _best_offset(recording, pairs, most, STAMP_OFFSET_METHODS[1])
    if found is None or other is None or abs(found - other) > MAX_STAMP_OFFSET_DIFFERENCE_US:
        return 0
    return found


def _best_offset(
    recording: Recording, pairs: list[FramePair], most: int, method: StampOffsetMethod
) -> int | None:
    """Find the offset of stamps at which changes of frames correlate best with events.

    Args:
        recording: Events.
        pairs: Consecutive frames.
        most: Largest offset, us.
        method: Steps of the search, and the estimate of levels between events.

    Returns:
        The offset, us; None if the correlation has no clear maximum.
    """
    end = most // method.step_us * method.step_us
    tried = np.arange(-end, end + 1, method.step_us)
    correlation = [_change_correlation(recording, pairs, int(us), method) for us in tried]
    best = int(np.argmax(correlation))
    if not 0 < best < len(tried) - 1 or not correlation[best] > MIN_EVENT_CORRELATION:
        return None
    before, at, after = correlation[best - 1 : best + 2]
    bend = max(2 * at - before - after, 1e-9)  # of the parabola through the three
    return int(tried[best] + round(method.step_us * (after - before) / 2 / bend))


def _log_levels(grey: NDArray) -> tuple[NDArray, NDArray]:
    """Return log intensity, and whether it is not clipped."""
    return np.log(np.maximum(grey, 0) + DARK_GREY_OFFSET), (grey > UNCLIPPED_GREY_RANGE[0]) & (
        grey < UNCLIPPED_GREY_RANGE[1]
    )


def _level_changes(
    recording: Recording, pair: FramePair, method: StampOffsetMethod | None = None
) -> tuple[NDArray, NDArray] | None:
    """Return changes of level between two frames, and sums of polarities, by pixel.

    Sums lag: they give the level at the last event. Between that and the next it is about halfway,
    which `method` takes into account.

    Args:
        recording: Events.
        pair: Times (2,) us, levels (2, height, width), and where they are known.
        method: How a level between two events is estimated.

    Returns:
        Changes and sums of the known pixels; None if no pixel is without events.
    """
    t, level, known = pair
    end = t[1] + (method.following_us if method else 0)
    first, last, till = (recording.events.index(int(at)) for at in (*t, end))
    events, pixels = recording.events[first:till], known.size
    pixel = events.y.astype(np.int64) * recording.width + events.x
    p, between = np.where(events.p, 1, -1), last - first
    known = known.ravel()
    quiet = known & (np.bincount(pixel[:between], minlength=pixels) == 0)
    if not quiet.any():
        return None
    # Without any event the sums are integers.
    number = np.bincount(pixel[:between], p[:between], pixels).astype(np.float64)
    for sign, begin in ((-1, 0), (1, between)) if method else ():
        next_one = np.zeros(pixels)
        next_one[pixel[begin:][::-1]] = p[begin:][::-1]  # the last one written is the first
        number += sign / 2 * next_one
        known = known & (next_one != 0) if method and method.requires_next else known
    change = (level[1] - level[0]).ravel()
    # Exposures may change.
    return change[known] - np.median(change[quiet]), number[known]


def _change_correlation(
    recording: Recording, pairs: list[FramePair], offset_us: int, method: StampOffsetMethod
) -> float:
    """Correlate the changes of frames with the sums of events between them.

    Args:
        recording: Events.
        pairs: Consecutive frames.
        offset_us: Offset that is added to the frames' stamps, us.
        method: Estimate of levels between events.

    Returns:
        The correlation; 0 if no pair can be compared.
    """
    found = [
        _level_changes(recording, (t + offset_us, level, known), method)
        for t, level, known in pairs
    ]
    kept = [one for one in found if one is not None]
    if not kept:
        return 0.0
    y, n = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    # By einsum: larger products wake BLAS's threads, which spin then.
    yy, yn, nn = (np.einsum("i,i", *pair) for pair in ((y, y), (y, n), (n, n)))
    return float(yn / np.sqrt(max(yy * nn, 1e-30)))


def _contrast_threshold(
    recording: Recording, t: NDArray, level: NDArray, known: NDArray
) -> float | None:
    """Estimate the contrast threshold by events and consecutive frames.

    Args:
        recording: Events.
        t: (n,) times of frames, us.
        level: (n, height, width) log intensities.
        known: (n, height, width) whether a pixel is not clipped.

    Returns:
        The threshold, ln I; None if events do not agree with the frames.
    """
    parts = []
    for k in range(len(t) - 1):
        pair = t[k : k + 2], level[k : k + 2], known[k] & known[k + 1]
        found = _level_changes(recording, pair)
        if found is not None:
            several = np.abs(found[1]) >= MIN_NET_EVENTS
            parts.append([part[several] for part in found])
    if sum(len(change) for change, _ in parts) < MIN_THRESHOLD_PIXELS:
        return None
    y, n = (np.concatenate(part) for part in zip(*parts, strict=True))
    yy, yn, nn = y @ y, y @ n, n @ n
    if not yn > MIN_EVENT_CORRELATION * np.sqrt(yy * nn):
        return None
    return float(np.sqrt(yn / nn * np.sqrt(yy / nn)))


class WindowReader:
    """Data of a recording in windows, each given by its centre (us) and half its length (s)."""

    def __init__(
        self,
        recording: Recording,
        params: Params,
        camera: PinholeCamera,
        gyro: Twists | None = None,
        seed: int = 0,
    ):
        self.recording, self.params, self.gyro, self.seed = recording, params, gyro, seed
        self.lens = lens_error(camera)
        self.sigma_floor: dict[int, float] = {}  # C, least sigma, by centres
        # Stages read the same window one after another.
        self.read_frame_pixels = cache_method(self._read_frame_pixels, 2)
        self.real = np.dtype(jax.dtypes.canonicalize_dtype(float))
        self.xi, self.f = pixel_coordinates(recording.width, recording.height, camera)
        flat = self.xi.reshape(-1, 2)
        lower, upper = np.floor(flat.min(0)) - VIEW_MARGIN_PX, np.ceil(flat.max(0)) + VIEW_MARGIN_PX
        cells = np.ceil((upper - lower + 1) / params.cell).astype(int)
        corner = lower - (cells * params.cell - (upper - lower + 1)) // 2
        self.corner = (float(corner[0]), float(corner[1]))
        self.shape = (int(cells[1]) * params.cell, int(cells[0]) * params.cell)
        ends = flat[:, 0].min(), flat[:, 0].max(), flat[:, 1].min(), flat[:, 1].max()
        self.box = (float(ends[0]), float(ends[1]), float(ends[2]), float(ends[3]))

    @functools.cached_property
    def frame_delay_us(self) -> int:
        """Offset of the frames' stamps."""
        return stamp_offset(self.recording)

    @property
    def half(self) -> float:
        """Half the length of a whole window, s."""
        return float(self.params.half_window)

    def _read_frame_pixels(self, first: int, last: int) -> FramePixels | None:
        return read_frame_pixels(self.recording, first, last, self.frame_delay_us)

    def event_range(self, centre: int, half: float) -> tuple[int, int]:
        """Return the range [begin, end) of a window's events.

        Args:
            centre: Middle of the window, us.
            half: Half its length, s.
        """
        span, index = round(half * 1e6), self.recording.events.index
        return index(centre - span), index(centre + span)

    def sample_events(self, centre: int, half: float, most: int) -> WindowEvents:
        """Sample a window's events at random.

        Args:
            centre: Middle of the window, us.
            half: Half its length, s.
            most: Most events.

        Returns:
            The events, in order.
        """
        most = min(most, self.params.events)
        first, last = self.event_range(centre, half)
        events = self.recording.events[first:last]
        rng = np.random.default_rng([self.seed, abs(centre), most])
        keep = np.arange(len(events))
        if len(keep) > most:
            keep = np.sort(rng.choice(len(keep), most, replace=False))
        x, y = self.xi[events.y[keep], events.x[keep]].T.astype(self.real)
        tau = ((events.t[keep] - centre) * 1e-6).astype(self.real)
        p = np.where(events.p[keep], 1, -1).astype(self.real)
        x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
        return WindowEvents(
            x, y, tau, p, self.f, half, self.box, self.shape, self.corner, self.params.cell
        )

    def prior(self, centre: int, half: float) -> Prior:
        """Make the priors of a window from the parameters, the gyro and counts of events.

        Args:
            centre: Middle of the window, us.
            half: Half its length, s.

        Returns:
            The priors.
        """
        params = self.params
        gyro, weight = np.zeros((N_WINDOW_SEGMENTS, 3)), 0.0
        if self.gyro is not None:
            times = centre + segment_times(half) * 1e6
            at = np.clip(np.rint(times), self.gyro.start, self.gyro.stop).astype(np.int64)
            gyro, weight = self.gyro(at)[1], 1 / float(params.gyro_std) ** 2
        skew, skew_weight = self.skew(centre, half)
        return Prior(
            smooth=float(params.smooth), relief=float(params.relief), change=float(params.change),
            gyro=gyro, gyro_weight=weight, bond=float(params.bond),
            flat=float(params.flat), alike=float(params.alike), skew=skew, skew_weight=skew_weight,
        )  # fmt: skip

    def skew(self, centre: int, half: float) -> tuple[float, float]:
        """Estimate the skew of the thresholds by counts of events.

        Levels that end where they begin have N_on C (1 + skew) = N_off C (1 - skew). Without a
        prior the fit of real events runs away to skew = -1: no ON threshold, so all ON events fit.

        Args:
            centre: Middle of the window, us.
            half: Half its length, s.

        Returns:
            The skew, and its weight, 1 / variance.
        """
        first, last = self.event_range(centre, half)
        events = self.recording.events[first:last]
        shape = self.recording.height, self.recording.width
        pixel = np.ravel_multi_index((events.y, events.x), shape)
        on, off = (
            np.bincount(pixel[events.p == p], minlength=np.prod(shape)) for p in (True, False)
        )
        both = (on > 0) & (off > 0)
        total, more = ((both * part).reshape(shape) for part in (on + off, on - off))
        rows, columns = (np.arange(0, n, SKEW_CELL_PX) for n in shape)
        cells = np.add.reduceat(np.add.reduceat(np.stack([total, more]), rows, 1), columns, 2)
        number = max(float(cells[0].sum()), 1.0)
        skew = -float(cells[1].sum()) / number
        spread = float(np.sqrt(((cells[1] + skew * cells[0]) ** 2).sum())) / number
        return skew, 1 / (MIN_SKEW_SIGMA**2 + spread**2)

    def series(
        self, centre: int, half: float, most: int, limit: int | None = None, skip: int = 0
    ) -> PixelSeries:
        """Return the events of pixels taken at random, and pixels of frames beside them.

        Args:
            centre: Middle of the window, us.
            half: Half its length, s.
            most: Most events, and most pixels of frames.
            limit: Most events, without frames.
            skip: Number of events of pixels that are left out, with `limit`.

        Returns:
            The series, one per pixel.
        """
        frames = None
        if limit is None and self.params.frames:
            span = round(half * 1e6)
            frames = self.read_frame_pixels(centre - span, centre + span)
        most = min(most, self.params.events)
        limit = most if limit is None else min(limit, most)
        first, last = self.event_range(centre, half)
        events = self.recording.events[first:last]
        width, pixels = self.recording.width, self.recording.width * self.recording.height
        pixel = events.y.astype(np.int64) * width + events.x
        count = np.bincount(pixel, minlength=pixels)
        # A single event of a pixel has no residual.
        order = np.random.default_rng([self.seed, abs(centre), most]).permutation(pixels)
        order = order[count[order] > 1]
        taken = np.zeros(pixels, bool)
        number = np.cumsum(count[order])
        # A pixel that holds event number `skip` is of neither part.
        taken[order[(number - count[order] >= skip) & (number <= skip + limit)]] = True
        keep = np.flatnonzero(taken[pixel])
        keep = keep[np.argsort(pixel[keep], kind="stable")]
        n, where = len(keep), pixel[keep]
        begins = np.append(True, where[1:] != where[:-1])[:n]
        begin = np.maximum.accumulate(np.where(begins, np.arange(n), 0))
        p = np.where(events.p[keep], 1, -1)
        total = np.cumsum(p)
        lower, upper = (
            np.array(self.box[::2]) - VIEW_MARGIN_PX,
            np.array(self.box[1::2]) + VIEW_MARGIN_PX,
        )
        lower = np.floor(lower)
        across, down = (np.ceil(upper - lower).astype(int) + 1).tolist()
        x, y = self.xi.reshape(-1, 2)[where].T
        rows = x, y, (events.t[keep] - centre) * 1e-6, total - (total - p)[begin]
        rows += np.arange(n) - begin + 1, p
        x, y, tau, level, number, p = (np.ascontiguousarray(row, self.real) for row in rows)
        begin, corner = np.append(np.flatnonzero(begins), n), (float(lower[0]), float(lower[1]))
        series = PixelSeries(
            x, y, tau, level, number, p, np.ones_like(x), n, begin, self.f, half, (down, across),
            corner, DEPTH_NODE_SPACING_PX,
        )  # fmt: skip
        return series if frames is None else self._with_frames(series, frames, centre, most)

    def _with_frames(
        self, series: PixelSeries, frames: FramePixels, centre: int, most: int
    ) -> PixelSeries:
        """Append pixels of frames, taken at random, to a series of events.

        Args:
            series: The events.
            frames: Pixels of frames in the window.
            centre: Middle of the window, us.
            most: Most pixels.

        Returns:
            The longer series; the same one if a frame has no pixel to offer.
        """
        each, rng = most // len(frames.t), np.random.default_rng([self.seed, abs(centre), most])
        chosen = []
        for precision in frames.precision:
            free = np.flatnonzero(frames.steep & (precision > 0))
            chosen.append(np.sort(rng.choice(free, min(each, len(free)), replace=False)))
        number = np.array([len(one) for one in chosen])
        if not number.all():
            return series
        which, pixel = np.repeat(np.arange(len(number)), number), np.concatenate(chosen)
        x, y = self.xi.reshape(-1, 2)[pixel].T
        none = np.zeros(len(pixel))
        more = {
            "x": x, "y": y, "tau": (frames.t[which] - centre) * 1e-6, "count": none, "p": none,
            "level": frames.level[which, pixel], "precision": frames.precision[which, pixel],
        }  # fmt: skip
        both: dict[str, Any] = {
            name: np.concatenate([getattr(series, name), rows]).astype(self.real)
            for name, rows in more.items()
        }
        begin = np.append(series.begin, series.begin[-1] + np.cumsum(number))
        return series._replace(**both, begin=begin)
