"""Samples of a recording: a few stretches of consecutive frames, with the events around them.

A calibration needs some ten thousand changes of brightness, and not more as recordings grow. So a
sample has at most `MAX_EVENTS` events, `MAX_INTERVALS` intervals between frames and `MAX_PIXELS`
pixels, in stretches that are spread over the recording. Short recordings are taken whole.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.hot import find_hot_pixels
from jaxevent.codegen import njit_noalloc
from jaxevent.recording import Recording

MAX_EVENTS = 3_000_000
MAX_INTERVALS = 48
MAX_PIXELS = 100_000
N_STRETCHES = 8
N_CANDIDATES = 32  # places of stretches, of which the busiest are taken
SEARCH_US = 500_000  # largest offset of the clocks that is sought
TILE_PX = 16
MARGIN_LEVELS = 2.5  # of 255, from either end, within which a pixel counts as clipped
WHITE_SHARE = 0.97  # of the brightest grey value, from which a pixel counts as clipped


class SampledSegment(NamedTuple):
    """Consecutive frames and the events around them, of the sampled pixels."""

    t: NDArray[np.int64]  # (events,) us
    pixel: NDArray[np.int32]  # (events,) index among the sampled pixels
    p: NDArray[np.bool_]  # (events,)
    span: tuple[int, int]  # us, first and last time of which all events are here
    rows: NDArray[np.intp]  # (frames,) of the recording
    frame_t: NDArray[np.int64]  # (frames,) stamps, us
    exposure: NDArray[np.int64]  # (frames,) us, 0 where unknown
    grey: NDArray[np.float32]  # (frames, pixels)
    intensity: NDArray[np.float32]  # (frames, pixels)
    clear: NDArray[np.bool_]  # (frames, pixels), not clipped

    def without(self, pixels: NDArray[np.bool_]) -> "SampledSegment":
        """Return the stretch without the events of some of the sampled pixels."""
        keep = ~pixels[self.pixel]
        clear = self.clear & ~pixels
        return self._replace(t=self.t[keep], pixel=self.pixel[keep], p=self.p[keep], clear=clear)

    def is_covered(self, offset_us: int = 0) -> NDArray[np.bool_]:
        """Return between which consecutive frames (frames - 1,) the stretch has all events."""
        times = self.frame_t + offset_us
        return (times[:-1] >= self.span[0]) & (times[1:] <= self.span[1])


class Sample(NamedTuple):
    """Stretches of a recording, without its hot pixels."""

    stretches: tuple[SampledSegment, ...]
    places: NDArray[np.intp]  # (pixels,) y width + x of the sampled pixels
    tile: NDArray[np.intp]  # (pixels,) number of the pixel's tile
    size: tuple[int, int]  # width, height
    hot: NDArray[np.bool_]  # (height, width)
    counts: NDArray[np.int64]  # (2, height, width) ON and OFF events of all pixels and stretches
    is_whole: bool  # whether it holds every event and frame


def choose_pixels(width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Choose pixels in whole tiles, spread over the sensor.

    Args:
        width: Width of the sensor, px.
        height: Height of the sensor, px.

    Returns:
        (pixels,) places y width + x, and numbers of their tiles.
    """
    across = -(-width // TILE_PX)
    y, x = np.divmod(np.arange(width * height), width)
    tile = y // TILE_PX * across + x // TILE_PX
    order = np.random.default_rng(0).permutation(int(tile[-1]) + 1)
    kept = order[: max(1, len(order) * MAX_PIXELS // max(width * height, MAX_PIXELS))]
    chosen = np.zeros(len(order), bool)
    chosen[kept] = True
    places = np.flatnonzero(chosen[tile])
    return places, tile[places]


def _choose_rows(recording: Recording) -> list[NDArray[np.intp]]:
    """Choose the frames of each stretch."""
    frames, source = recording.frames, recording.events
    assert frames is not None
    intervals = len(frames) - 1
    if intervals <= MAX_INTERVALS and len(source) <= MAX_EVENTS:
        return [np.arange(len(frames))]
    each = max(1, min(MAX_INTERVALS // N_STRETCHES, intervals // N_STRETCHES))
    begins = np.unique(np.linspace(0, intervals - each, N_CANDIDATES).astype(np.intp))
    # The busiest of each eighth, so that stretches are spread over the recording.
    busy = [
        source.index(int(frames.t[k + each])) - source.index(int(frames.t[k]))
        for k in begins.tolist()
    ]
    parts = np.array_split(np.arange(len(begins)), min(N_STRETCHES, len(begins)))
    best = [part[np.argmax(np.array(busy)[part])] for part in parts]
    return [begins[k] + np.arange(each + 1) for k in best]


def _read_stretch(
    recording: Recording, span: tuple[int, int], most: int, rows: NDArray[np.intp]
) -> tuple[NDArray[np.intp], tuple[int, int], int, int]:
    """Shrink a stretch until it has at most `most` events: first the search, then the frames.

    Returns:
        Rows of its frames, its span (us), and the first and last row of its events.
    """
    source, frames = recording.events, recording.frames
    reach = SEARCH_US
    while True:
        if frames is not None and len(rows):
            span = int(frames.t[rows[0]]) - reach, int(frames.t[rows[-1]]) + reach
        first, last = source.index(span[0]), source.index(span[1] + 1)
        if last - first <= most:
            return rows, span, first, last
        interval = int(np.median(np.diff(frames.t[rows]))) if frames and len(rows) > 1 else 0
        if len(rows) and reach > max(interval, 1000):
            reach //= 2
        elif len(rows) > 2:
            rows = rows[: (len(rows) + 2) // 2]
        else:
            return rows, (span[0], int(source[first + most :][:1].t[0])), first, first + most


def _choose_stretches(recording: Recording) -> list[NDArray[np.intp]]:
    """Choose the frames of each stretch, of which there may be none."""
    frames = recording.frames
    if frames is not None and len(frames) > 1:
        return _choose_rows(recording)
    rows = np.arange(len(frames) if frames is not None else 0)
    return [rows] * (N_STRETCHES if len(recording.events) > MAX_EVENTS else 1)


def _spread_events(
    recording: Recording, number: int, count: int, most: int
) -> tuple[tuple[int, int], int, int]:
    """Return the span (us) and rows of the events of one of several stretches without frames."""
    source = recording.events
    first = max((len(source) - most) * number // max(count - 1, 1), 0)
    last = min(first + most, len(source))
    ends = source[first:last].t[[0, -1]] if last > first else (0, 0)
    return (int(ends[0]), int(ends[1])), first, last


def _read_frames(
    recording: Recording, rows: NDArray[np.intp], places: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return grey values and intensities (rows, pixels) of frames."""
    grey = np.empty((len(rows), len(places)), np.float32)
    intensity, frames = np.empty_like(grey), recording.frames
    if frames is None:
        return grey, intensity
    levels, gain = np.linspace(0, 1, 1025), recording.gain
    table = np.asarray(recording.response.intensity(levels), np.float64)
    for i, row in enumerate(rows.tolist()):
        grey[i] = frames[row : row + 1].intensity[0].ravel()[places]
        intensity[i] = np.interp(grey[i], levels, table) / gain[row]
    return grey, intensity


def _count_by_part(
    t: NDArray[np.int64], place: NDArray[np.int64], parts: int, pixels: int
) -> list[NDArray[np.int32]]:
    """Count the events of each pixel in parts of equal length."""
    cuts = np.empty(0, np.intp)
    if parts > 1 and len(t):
        cuts = np.searchsorted(t, np.linspace(t[0], t[-1] + 1, parts + 1)[1:-1])
    return [np.bincount(part, minlength=pixels).astype(np.int32) for part in np.split(place, cuts)]


def take_sample(recording: Recording) -> Sample:
    """Take a sample of a recording.

    Args:
        recording: The recording, with or without frames.

    Returns:
        The sample, without events of hot pixels.
    """
    width, height = recording.width, recording.height
    frames, source = recording.frames, recording.events
    places, tile = choose_pixels(width, height)
    index = np.full(width * height, -1, np.int32)
    index[places] = np.arange(len(places))
    chosen = _choose_stretches(recording)
    most = MAX_EVENTS // len(chosen)
    counts = np.zeros((2, width * height), np.int64)
    by_part, found, events_read = [], [], 0
    for number, rows in enumerate(chosen):
        if len(rows) > 1:
            rows, span, first, last = _read_stretch(recording, (0, 0), most, rows)
        else:
            span, first, last = _spread_events(recording, number, len(chosen), most)
        events = source[first:last]
        events_read += len(events)
        place = events.y.astype(np.int64) * width + events.x
        for row, of in enumerate((events.p, ~events.p)):
            counts[row] += np.bincount(place[of], minlength=width * height)
        parts = N_STRETCHES if len(chosen) == 1 else 1
        by_part += _count_by_part(events.t, place, parts, width * height)
        pixel = index[place]
        keep = pixel >= 0
        grey, intensity = _read_frames(recording, rows, places)
        stamps = frames.t[rows] if frames is not None else np.empty(0, np.int64)
        exposure = frames.exposure[rows] if frames is not None else np.empty(0, np.int64)
        # Before the first and after the last event nothing is known to be missing.
        found.append(
            SampledSegment(
                events.t[keep], pixel[keep], events.p[keep], span, rows, stamps, exposure,
                grey, intensity, np.zeros(grey.shape, bool),
            )
        )  # fmt: skip
    white = max((float(s.grey.max(initial=0)) for s in found), default=0.0) * WHITE_SHARE
    dark, bright = MARGIN_LEVELS / 255, min(white, 1 - MARGIN_LEVELS / 255)
    hot = find_hot_pixels(np.stack(by_part).reshape(-1, height, width))
    is_out = hot.ravel()[places]
    stretches = tuple(
        s._replace(clear=(s.grey > dark) & (s.grey < bright)).without(is_out) for s in found
    )
    return Sample(
        stretches, places, tile, (width, height), hot, counts.reshape(2, height, width),
        events_read == len(source) and sum(map(len, chosen)) == (len(frames) if frames else 0),
    )  # fmt: skip


def count_between(stretch: SampledSegment, offset_us: int = 0) -> NDArray[np.int32]:
    """Count the events between consecutive frames.

    Args:
        stretch: The stretch.
        offset_us: Time added to the frames' stamps, us.

    Returns:
        (frames - 1, 2, pixels) ON and OFF events.
    """
    pixels = stretch.clear.shape[1]
    out = np.zeros((max(len(stretch.frame_t) - 1, 0), 2, pixels), np.int32)
    edges = np.searchsorted(stretch.t, stretch.frame_t + offset_us)
    for k in range(len(out)):
        part = slice(edges[k], edges[k + 1])
        p, pixel = stretch.p[part], stretch.pixel[part]
        out[k] = [np.bincount(pixel[of], minlength=pixels) for of in (p, ~p)]
    return out


def log_changes(
    stretch: SampledSegment, I0: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the changes of ln(I + I0) from each frame to the next.

    Args:
        stretch: The stretch.
        I0: Offset inside the logarithm.

    Returns:
        (frames - 1, pixels) changes, and where both frames are not clipped.
    """
    L = np.log(np.maximum(stretch.intensity, 0) + np.float32(I0))
    return np.diff(L, axis=0), stretch.clear[1:] & stretch.clear[:-1]


@njit_noalloc
def _add_moments(t, pixel, sign, change, used, edges, count, out):
    """Add S^2, S d and S of all used pixels at each offset, S the sum of signs in the window."""
    low = high = 0
    S2 = Sd = S = 0.0
    for j in range(len(edges)):
        while high < len(t) and t[high] < edges[j, 1]:
            i = pixel[high]
            if used[i]:
                S2 += 1 + 2 * sign[high] * count[i]
                Sd += sign[high] * change[i]
                S += sign[high]
                count[i] += sign[high]
            high += 1
        while low < high and t[low] < edges[j, 0]:
            i = pixel[low]
            if used[i]:
                S2 += 1 - 2 * sign[low] * count[i]
                Sd -= sign[low] * change[i]
                S -= sign[low]
                count[i] -= sign[low]
            low += 1
        out[j, 0] += S2
        out[j, 1] += Sd
        out[j, 2] += S
    for i in range(len(count)):
        count[i] = 0


def correlate(
    sample: Sample, offsets_us: NDArray[np.int64], I0: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Correlate the events' counts with the frames' changes at offsets of the clock.

    Pearson's r of ON minus OFF events with the change of ln(I + I0), over all pixels that no frame
    clips and all intervals between frames. An interval counts at an offset where its events are in
    the sample.

    Args:
        sample: The sample.
        offsets_us: (offsets,) times added to the frames' stamps, us, sorted.
        I0: Offset inside the logarithm.

    Returns:
        (offsets,) correlations, NaN where fewer than half of the intervals have events, and
        numbers of the changes in them.
    """
    sums = np.zeros((len(offsets_us), 6))  # S^2, S d, S, n, d^2, d
    intervals = np.zeros(len(offsets_us))
    total = 0
    for stretch in sample.stretches:
        change, used = log_changes(stretch, I0)
        sign = np.where(stretch.p, 1.0, -1.0)
        count = np.zeros(change.shape[1])
        begin, end = stretch.span
        if len(stretch.t):
            begin, end = max(begin, int(stretch.t[0])), min(end, int(stretch.t[-1]))
        for k in range(len(change)):
            edges = stretch.frame_t[k : k + 2] + offsets_us[:, None]
            inside = (edges[:, 0] >= begin) & (edges[:, 1] <= end + 1)
            out = np.zeros((len(edges), 3))
            first = int(np.searchsorted(stretch.t, edges[0, 0]))
            _add_moments(
                stretch.t[first:], stretch.pixel[first:], sign[first:], change[k], used[k],
                edges, count, out,
            )  # fmt: skip
            d = change[k][used[k]].astype(np.float64)
            sums[inside, :3] += out[inside]
            sums[inside, 3:] += len(d), d @ d, d.sum()
            intervals += inside
            total += 1
    S2, Sd, S, n, d2, d = sums.T
    n = np.maximum(n, 1)
    spread = (S2 - S * S / n) * (d2 - d * d / n)
    enough = (spread > 1e-12) & (intervals >= math.ceil(total / 2))
    r = np.where(enough, (Sd - S * d / n) / np.sqrt(np.where(enough, spread, 1)), np.nan)
    return r, n.astype(np.int64)
