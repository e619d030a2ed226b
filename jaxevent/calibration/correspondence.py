"""Correspondence of events and frames: products of counts with changes, over lags and transforms.

Between two frames a pixel counts S = ON - OFF events, and its log intensity changes by d. Their
correlation is high where events and frames belong together, and tells what is wrong elsewhere.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.sampling import Sample, SampledSegment, log_changes
from jaxevent.codegen import njit_noalloc

I0 = 0.1  # inside the logarithm: between the filters' 1 and the dark offset of sensors
MAX_PAIRS = 16  # pairs of frames that are compared
N_LAGS_PER_SIDE = 20  # lags on either side of 0
STEPS_PER_INTERVAL = 8  # so that lags reach 2.5 intervals
STEP_RANGE_US = (2_000, 20_000)
MIN_PIXELS = 50  # clear in both frames
# Events between two frames, from which rounding to whole thresholds is small beside the change.
# With fewer, neighbouring intervals say more than the right one, and any lag or exposure fits.
MIN_EVENTS = 4
N_PARTS = 8  # of the pairs, each left out in turn for the error of the offset
FAR_STEPS = 12  # lag at which events belong to other frames
MIN_SIGNIFICANCE = 6.0  # of a relation that is no chance, among some hundred that are tried

# What brings events to the frames' pixels, and the same of the frames' changes, taken back.
TRANSFORMS: Mapping[str, Callable[[NDArray], NDArray]] = MappingProxyType(
    {
        "": lambda image: image,
        "rows flipped": lambda image: image[::-1],
        "columns flipped": lambda image: image[:, ::-1],
        "rows and columns flipped": lambda image: image[::-1, ::-1],
        "axes swapped": lambda image: image.T,
        "axes swapped, then rows flipped": lambda image: image[::-1].T,
        "axes swapped, then columns flipped": lambda image: image[:, ::-1].T,
        "axes swapped, then rows and columns flipped": lambda image: image[::-1, ::-1].T,
    }
)


class Correspondence(NamedTuple):
    """Correlations of events with frames over lags, and their significance.

    The significance of a sum of products is the sum over tiles of 16 x 16 pixels and pairs of
    frames, divided by the root of the sum of squares. It is normal with deviation 1 where the
    signs of the tiles are independent and of equal odds. Offset and exposure come from pixels
    with at least 4 events between two frames; they are NaN where there are none.

    | field | meaning |
    |---|---|
    | lags | (m,) times added to the frames' stamps, us |
    | interval | median interval between the frames, us |
    | correlation | (transforms, m) of S with d, as `TRANSFORMS` orders them |
    | significance | (transforms, m) of that |
    | activity | significance of events at the same time and place as changes of either sign |
    | busy | number of the pixels, and pairs of frames, with at least 4 events |
    | tiles | number of the tiles, and pairs of frames, with such pixels |
    | offset, offset_sigma | lag of the highest correlation, and its standard error, us |
    | exposure | length of the exposure of the highest correlation, us |
    | dilution | change per event at that exposure, over that at the best one up to an interval |
    """

    lags: NDArray[np.int64]
    interval: int
    correlation: NDArray[np.float64]
    significance: NDArray[np.float64]
    activity: float
    busy: int
    tiles: int
    offset: float
    offset_sigma: float
    exposure: float
    dilution: float


class _Sums(NamedTuple):
    """Sums of a pair of frames over its busy pixels.

    Attributes:
        S2: (m, m) sums of S at two lags.
        Sd: (m,) sums of S d.
        d2: Sum of d^2.
        inside: (m,) lags of which all events are known.
    """

    S2: NDArray[np.float64]
    Sd: NDArray[np.float64]
    d2: float
    inside: NDArray[np.bool_]


def _lag_counts(
    segment: SampledSegment, row: int, lags: NDArray[np.int64]
) -> tuple[NDArray[np.integer], NDArray[np.floating], NDArray[np.floating]]:
    """Count the events between two frames at lags.

    Args:
        segment: The segment.
        row: Number of the first of the frames.
        lags: (m,) times added to the frames' stamps, us.

    Returns:
        (active,) pixels with events, and net and total counts (m, active).
    """
    first, last = (np.searchsorted(segment.t, segment.frame_t[row + k] + lags) for k in (0, 1))
    part = slice(first[0], last[-1])
    counts = np.bincount(segment.pixel[part])
    active, rank = np.flatnonzero(counts), np.cumsum(counts > 0) - 1
    place = rank[segment.pixel[part]]
    sign = np.where(segment.p[part], np.float32(1), np.float32(-1))
    counted = np.zeros((2, len(lags), len(active)), np.float32)
    _count_in_windows(place, sign, first - first[0], last - first[0], counted)
    return active, counted[0], counted[1]


@njit_noalloc
def _count_in_windows(place, sign, first, last, out):
    """Count the events of each pixel in windows of rows.

    Args:
        place: (events,) number of the pixel.
        sign: (events,) 1 or -1.
        first: (windows,) first row of each window, ascending.
        last: (windows,) row after its last, ascending.
        out: (2, windows, n) output, sums of signs and numbers of events.
    """
    begin = end = 0
    for k in range(len(first)):
        if k > 0:
            for pixel in range(out.shape[2]):
                out[0, k, pixel] = out[0, k - 1, pixel]
                out[1, k, pixel] = out[1, k - 1, pixel]
        for i in range(end, last[k]):
            out[0, k, place[i]] += sign[i]
            out[1, k, place[i]] += 1
        for i in range(begin, first[k]):
            out[0, k, place[i]] -= sign[i]
            out[1, k, place[i]] -= 1
        begin, end = first[k], last[k]


def _sum_by_tile(
    counts: NDArray[np.floating], weights: NDArray[np.floating], tile: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Sum weighted counts over the pixels of each tile.

    Args:
        counts: (lags, n) counts of pixels.
        weights: (kinds, n) weights of pixels.
        tile: (n,) number of each pixel's tile.

    Returns:
        (lags, tiles, kinds).
    """
    out = np.zeros((len(counts), tile.max() + 1, len(weights)))
    _add_by_tile(counts, np.ascontiguousarray(weights.T), tile, out)
    return out


@njit_noalloc
def _add_by_tile(counts, weights, tile, out):
    """Add up weighted counts by tile.

    Args:
        counts: (lags, pixels).
        weights: (pixels, k).
        tile: (pixels,) number of each pixel's tile.
        out: (lags, tiles, k) added to.
    """
    for j in range(counts.shape[0]):
        for i in range(counts.shape[1]):
            for k in range(weights.shape[1]):
                out[j, tile[i], k] += counts[j, i] * weights[i, k]


def measure_correspondence(sample: Sample) -> Correspondence | None:
    """Measure how events and frames agree.

    Args:
        sample: Sample of a recording.

    Returns:
        The correspondence; None where no clear pixels of two frames are within the events' time.
    """
    pairs = [(s, row) for s in sample.segments for row in range(len(s.frame_t) - 1) if len(s.t)]
    if not pairs:
        return None
    interval = int(np.median([s.frame_t[row + 1] - s.frame_t[row] for s, row in pairs]))
    step = int(np.clip(interval // STEPS_PER_INTERVAL, *STEP_RANGE_US))
    lags = np.arange(-N_LAGS_PER_SIDE, N_LAGS_PER_SIDE + 1) * step
    width, height = sample.size
    kinds = list(TRANSFORMS.values())[: len(TRANSFORMS) if width == height else 4]
    m, n = len(lags), len(kinds)
    total, squares, contrast = np.zeros((n, m)), np.zeros((n, m)), np.zeros((2, m))
    S2, d2, used = np.zeros((n, m)), np.zeros((n, m)), np.zeros(m)
    sums, busy, tiles = [], 0, 0
    chosen = np.unique(np.linspace(0, len(pairs) - 1, MAX_PAIRS).round().astype(int))
    for segment, row in (pairs[i] for i in chosen):
        changes, clears = log_changes(_cut_frame_pair(segment, row), I0)
        d, clear = changes[0], clears[0]
        begin = max(segment.span[0], int(segment.t[0]))
        end = min(segment.span[1], int(segment.t[-1])) + 1
        inside = (segment.frame_t[row] + lags >= begin) & (segment.frame_t[row + 1] + lags <= end)
        if clear.sum() < MIN_PIXELS or not inside.any():
            continue
        # The median change is the frames' own brightness, which is judged apart.
        d = np.where(clear, d - np.median(d[clear]), 0)
        size = np.where(clear, np.abs(d) - np.abs(d)[clear].mean(), 0)
        full = np.zeros((2, height * width), np.float32)
        full[:, sample.places] = d, clear
        moved, seen = (
            np.stack([kind(image.reshape(height, width)).ravel() for kind in kinds])
            for image in full
        )
        moved, seen = moved[:, sample.places], seen[:, sample.places]
        active, S, N = _lag_counts(segment, row, lags)
        S, N = S * inside[:, None], N * inside[:, None]
        tile = sample.tile[active]
        products = _sum_by_tile(S, moved[:, active], tile)
        total += products.sum(1).T
        squares += (products**2).sum(1).T
        above = _contrast(_sum_by_tile(N, size[None, active], tile)[..., 0], inside)
        contrast += above.sum(1), (above**2).sum(1)
        S2 += seen[:, active] @ (S**2).T
        d2 += (moved**2).sum(1)[:, None] * inside
        used += inside
        often = clear[active] & (N.max(0) >= MIN_EVENTS)
        kept, change = S[:, often].astype(np.float64), d[active[often]].astype(np.float64)
        sums.append(_Sums(kept @ kept.T, kept @ change, float(change @ change), inside))
        busy += int(often.sum())
        tiles += len(np.unique(tile[often]))
    if not sums:
        return None
    enough = used >= max(used.max() / 2, 1)
    correlation = np.where(enough, total / np.sqrt(S2 * d2 + 1e-12), 0)
    significance = np.where(enough, total / np.sqrt(squares + 1e-12), 0)
    activity = float((contrast[0] / np.sqrt(contrast[1] + 1e-12)).max())
    parts = [[s for k, s in enumerate(sums) if k % N_PARTS != part] for part in range(N_PARTS)]
    offsets = np.array([_find_offset(part, step) for part in parts[: len(sums)] if part])
    error = np.sqrt((len(offsets) - 1) * np.var(offsets)) if len(offsets) > 1 else np.nan
    return Correspondence(
        lags, interval, correlation, significance, activity, busy, tiles,
        _find_offset(sums, step), float(error), *_find_exposure(sums, step, interval),
    )  # fmt: skip


def turn_events(sample: Sample, name: str, inverted: bool) -> Sample:
    """Bring the events of a sample to the frames' pixels.

    Args:
        sample: Sample of a recording.
        name: What brings them there, of `TRANSFORMS`.
        inverted: Whether the polarity is inverted, too.

    Returns:
        The sample, without events that come to pixels outside of it.
    """
    width, height = sample.size
    index = np.full(width * height, -1, np.int32)
    index[sample.places] = np.arange(len(sample.places))
    place = np.arange(width * height).reshape(height, width)
    to = index[TRANSFORMS[name](place).ravel()[sample.places]]
    turned = []
    for one in sample.segments:
        pixel = to[one.pixel]
        keep = pixel >= 0
        turned.append(one._replace(t=one.t[keep], pixel=pixel[keep], p=one.p[keep] ^ inverted))
    return sample._replace(segments=tuple(turned))


def _cut_frame_pair(segment: SampledSegment, row: int) -> SampledSegment:
    """Cut two consecutive frames out of a segment.

    Args:
        segment: The segment.
        row: Number of the first frame in it.

    Returns:
        The segment with their intensities and clear pixels; other columns are as they were.
    """
    two = slice(row, row + 2)
    return segment._replace(intensity=segment.intensity[two], clear=segment.clear[two])


def _contrast(curve: NDArray, inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the height of curves above the mean of lags at which events belong to other frames.

    Args:
        curve: (lags, n).
        inside: (lags,) whether all events are known.

    Returns:
        (lags, n), 0 where the mean is not known.
    """
    out = np.zeros(curve.shape)
    near = np.arange(FAR_STEPS, len(curve) - FAR_STEPS)
    known = inside[near] & inside[near - FAR_STEPS] & inside[near + FAR_STEPS]
    beside = (curve[near - FAR_STEPS] + curve[near + FAR_STEPS]) / 2
    out[near] = np.where(known[:, None], curve[near] - beside, 0)
    return out


def _fit_windows(
    sums: list[_Sums], first: NDArray[np.integer], stop: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit the frames' changes to events averaged over windows of lags.

    A window counts if all events are known for half of the pairs.

    Args:
        sums: Sums of each pair of frames.
        first: (windows,) first lag of each window.
        stop: (windows,) lag after its last.

    Returns:
        The correlations, minus infinity where they are not known, and the changes per event.
    """
    # Sums over windows are differences of sums from the first lag on.
    inside, Sd = (
        np.pad(np.cumsum([getattr(s, name) for s in sums], 1), ((0, 0), (1, 0)))
        for name in ("inside", "Sd")
    )
    S2 = np.cumsum(np.cumsum([s.S2 for s in sums], 1), 2)
    S2 = np.pad(S2, ((0, 0), (1, 0), (1, 0)))
    known = inside[:, stop] - inside[:, first] == stop - first
    S2 = S2[:, stop, stop] - S2[:, first, stop] - S2[:, stop, first] + S2[:, first, first]
    S2 = (S2 * known).sum(0)
    Sd = ((Sd[:, stop] - Sd[:, first]) * known).sum(0)
    d2 = (np.array([s.d2 for s in sums])[:, None] * known).sum(0)
    fitted = (2 * known.sum(0) >= len(sums)) & (S2 * d2 > 0)
    S2, d2 = np.where(fitted, S2, 1), np.where(fitted, d2, 1)
    change = np.where(fitted, Sd / S2 * (stop - first), np.nan)
    return np.where(fitted, Sd / np.sqrt(S2 * d2), -np.inf), change


def _find_offset(sums: list[_Sums], step: int) -> float:
    """Find the lag of the highest correlation, by a parabola through three.

    Args:
        sums: Sums of each pair of frames.
        step: Distance of lags, us.

    Returns:
        The lag, us; NaN if no correlation is known.
    """
    lags = np.arange(2 * N_LAGS_PER_SIDE + 1)
    curve, _ = _fit_windows(sums, lags, lags + 1)
    if not np.isfinite(curve).any():
        return np.nan
    top = int(curve.argmax())
    left, middle, right = np.pad(curve, 1, constant_values=-np.inf)[top : top + 3]
    bend = left - 2 * middle + right
    inner = np.isfinite(bend) and bend < 0
    return float((top - N_LAGS_PER_SIDE + (0.5 * (left - right) / bend if inner else 0)) * step)


def _find_exposure(sums: list[_Sums], step: int, interval: int) -> tuple[float, float]:
    """Find the exposure of the highest correlation.

    Args:
        sums: Sums of each pair of frames.
        step: Distance of lags, us.
        interval: Time between frames, us.

    Returns:
        Exposure, us, and dilution, see `Correspondence`.
    """
    half, middle = np.mgrid[: N_LAGS_PER_SIDE - 1, : 2 * N_LAGS_PER_SIDE + 1].reshape(2, -1)
    whole = (middle >= half) & (middle + half <= 2 * N_LAGS_PER_SIDE)
    half, middle = half[whole], middle[whole]
    r, change = _fit_windows(sums, middle - half, middle + half + 1)
    exposure = 2.0 * half * step
    best, short = np.argmax(r), np.argmax(np.where(exposure <= interval, r, -np.inf))
    if not np.isfinite(r[best] + r[short]):
        return np.nan, np.nan
    return float(exposure[best]), float(change[best] / change[short])
