"""Samples of a recording: a few segments of consecutive frames, with the events around them.

A calibration needs some ten thousand changes of brightness, and not more as recordings grow. So a
sample has at most `MAX_EVENTS` events, `MAX_INTERVALS` intervals between frames and `MAX_PIXELS`
pixels, in segments that are spread over the recording. Short recordings are taken whole. Where
events are dense, a segment is two frames with an interval between frames before and after, and the
sample has fewer pixels: with a part of an interval's events it would miss the change between them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.hot import find_hot_pixels, measure_dead_share
from jaxevent.codegen import njit_noalloc
from jaxevent.recording import EventSource, Recording

MAX_EVENTS = 3_000_000
MAX_READ_EVENTS = 24_000_000  # of all pixels, where events are dense
MAX_INTERVALS = 48
MAX_PIXELS = 100_000
N_SEGMENTS = 8
N_CANDIDATES = 32  # places of segments, of which the busiest are taken
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
        """Return the segment without the events of some of the sampled pixels."""
        keep = ~pixels[self.pixel]
        clear = self.clear & ~pixels
        return self._replace(t=self.t[keep], pixel=self.pixel[keep], p=self.p[keep], clear=clear)

    def is_covered(self, offset_us: int = 0) -> NDArray[np.bool_]:
        """Return between which consecutive frames (frames - 1,) the segment has all events."""
        times = self.frame_t + offset_us
        return (times[:-1] >= self.span[0]) & (times[1:] <= self.span[1])


class SegmentPlace(NamedTuple):
    """Place of a segment in a recording."""

    rows: NDArray[np.intp]  # (frames,)
    span: tuple[int, int]  # us, first and last time of which all events are in it
    first: int  # row of its first event
    last: int  # row after that of its last event


class Sample(NamedTuple):
    """Stretches of a recording, without its hot pixels."""

    segments: tuple[SampledSegment, ...]
    places: NDArray[np.intp]  # (pixels,) y width + x of the sampled pixels
    tile: NDArray[np.intp]  # (pixels,) number of the pixel's tile
    size: tuple[int, int]  # width, height
    hot: NDArray[np.bool_]  # (height, width)
    counts: NDArray[np.int64]  # (2, height, width) ON and OFF events of all pixels and segments
    dead_share: float  # of the pixels between busy ones, without an event


def choose_pixels(
    width: int, height: int, share: float = 1.0
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Choose pixels in whole tiles, spread over the sensor.

    Args:
        width: Width of the sensor, px.
        height: Height of the sensor, px.
        share: Largest part of the pixels, above 0.

    Returns:
        (pixels,) places y width + x, and numbers of their tiles.
    """
    across = -(-width // TILE_PX)
    y, x = np.divmod(np.arange(width * height), width)
    tile = y // TILE_PX * across + x // TILE_PX
    order = np.random.default_rng(0).permutation(int(tile[-1]) + 1)
    share = min(share, MAX_PIXELS / (width * height), 1.0)
    kept = order[: max(1, int(len(order) * share))]
    chosen = np.zeros(len(order), bool)
    chosen[kept] = True
    places = np.flatnonzero(chosen[tile])
    return places, tile[places]


def _choose_rows(recording: Recording) -> list[NDArray[np.intp]]:
    """Choose the frames of each segment."""
    frames, source = recording.frames, recording.events
    assert frames is not None
    intervals = len(frames) - 1
    if intervals <= MAX_INTERVALS and len(source) <= MAX_EVENTS:
        return [np.arange(len(frames))]
    each = max(1, min(MAX_INTERVALS // N_SEGMENTS, intervals // N_SEGMENTS))
    begins = np.unique(np.linspace(0, intervals - each, N_CANDIDATES).astype(np.intp))
    # The busiest of each eighth, so that segments are spread over the recording.
    busy = [
        source.index(int(frames.t[k + each])) - source.index(int(frames.t[k]))
        for k in begins.tolist()
    ]
    parts = np.array_split(np.arange(len(begins)), min(N_SEGMENTS, len(begins)))
    best = [part[np.argmax(np.array(busy)[part])] for part in parts]
    return [begins[k] + np.arange(each + 1) for k in best]


def _bound_segment(recording: Recording, rows: NDArray[np.intp], most: int) -> SegmentPlace:
    """Shrink a segment until it has few enough events: first the search, then the frames.

    At least two frames remain, with at least half of an interval before and after.

    Args:
        recording: Events and frames.
        rows: Rows of the frames.
        most: Most events.

    Returns:
        The place of the segment.
    """
    source, frames = recording.events, recording.frames
    assert frames is not None
    reach = SEARCH_US
    while True:
        span = int(frames.t[rows[0]]) - reach, int(frames.t[rows[-1]]) + reach
        first, last = source.index(span[0]), source.index(span[1] + 1)
        if last - first > most and reach > max(int(np.median(np.diff(frames.t[rows]))), 1000):
            reach //= 2
        elif last - first > most and len(rows) > 2:
            rows = rows[: (len(rows) + 2) // 2]
        else:
            return SegmentPlace(rows, span, first, last)


def _cut_segment(source: EventSource, segment: SegmentPlace) -> SegmentPlace:
    """End a segment after `MAX_READ_EVENTS`, as where minutes pass between two frames."""
    last = segment.first + MAX_READ_EVENTS
    if last >= segment.last:
        return segment
    end = int(source[last : last + 1].t[0])
    return segment._replace(span=(segment.span[0], end - 1), last=source.index(end))


def _choose_segments(recording: Recording) -> list[SegmentPlace]:
    """Choose the segments; without frames they are ranges of events."""
    frames, source = recording.frames, recording.events
    if frames is not None and len(frames) > 1:
        chosen = _choose_rows(recording)
        found = [_bound_segment(recording, rows, MAX_EVENTS // len(chosen)) for rows in chosen]
        number = MAX_READ_EVENTS // max(1, *(one.last - one.first for one in found))
        if number < len(found):
            some = np.linspace(0, len(found) - 1, max(number, 1)).round().astype(int)
            found = [_cut_segment(source, found[k]) for k in some.tolist()]
        return found
    rows = np.arange(len(frames) if frames is not None else 0)
    count = N_SEGMENTS if len(source) > MAX_EVENTS else 1
    most, found = MAX_EVENTS // count, []
    for first in np.linspace(0, max(len(source) - most, 0), count).astype(int).tolist():
        last = min(first + most, len(source))
        ends = source[first:last].t[[0, -1]].tolist() if last > first else (0, 0)
        found.append(SegmentPlace(rows, (ends[0], ends[1]), first, last))
    return found


def _read_frames(
    recording: Recording, rows: NDArray[np.intp], places: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read frames at sampled pixels.

    Args:
        recording: Events and frames.
        rows: Rows of the frames.
        places: (pixels,) numbers of the pixels, row by row.

    Returns:
        Grey values and intensities, (rows, pixels) each.
    """
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


def _read_events(
    recording: Recording, segment: SegmentPlace, index: NDArray[np.int32], parts: int
) -> tuple[list[NDArray], NDArray[np.int32]]:
    """Read the events of a segment.

    Args:
        recording: The recording.
        segment: The segment.
        index: (pixels of the sensor,) index among the sampled pixels, -1 outside of these.
        parts: Number of parts of equal length in time.

    Returns:
        Times, pixels and polarity of the events at sampled pixels, and numbers (2, parts, pixels of
        the sensor) of ON and OFF events at all.
    """
    source, first, last = recording.events, segment.first, segment.last
    counts, kept = np.zeros((2, parts, len(index)), np.int32), []
    cuts = np.empty(0)
    if parts > 1 and last > first:
        t0, t1 = (int(source[row : row + 1].t[0]) for row in (first, last - 1))
        cuts = np.linspace(t0, t1 + 1, parts + 1)[1:-1]
    for row in range(first, last, MAX_EVENTS):
        events = source[row : min(row + MAX_EVENTS, last)]
        place = events.y.astype(np.int64) * recording.width + events.x
        begins = [0, *np.searchsorted(events.t, cuts).tolist(), len(place)]
        for part in range(len(begins) - 1):
            within = slice(begins[part], begins[part + 1])
            for k, of in enumerate((events.p[within], ~events.p[within])):
                counts[k, part] += np.bincount(place[within][of], minlength=len(index))
        pixel = index[place]
        keep = pixel >= 0
        kept.append((events.t[keep], pixel[keep], events.p[keep]))
    if not kept:
        kept.append((np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.bool_)))
    return [np.concatenate(column) for column in zip(*kept, strict=True)], counts


def take_sample(recording: Recording) -> Sample:
    """Take a sample of a recording.

    Args:
        recording: The recording, with or without frames.

    Returns:
        The sample, without events of hot pixels.
    """
    width, height, frames = recording.width, recording.height, recording.frames
    chosen = _choose_segments(recording)
    most = max(segment.last - segment.first for segment in chosen) * len(chosen)
    places, tile = choose_pixels(width, height, MAX_EVENTS / max(most, MAX_EVENTS))
    index = np.full(width * height, -1, np.int32)
    index[places] = np.arange(len(places))
    found, by_part = [], []
    parts = N_SEGMENTS if len(chosen) == 1 else 1
    for segment in chosen:
        columns, counts = _read_events(recording, segment, index, parts)
        by_part.append(counts)
        rows = segment.rows
        grey, intensity = _read_frames(recording, rows, places)
        stamps = frames.t[rows] if frames is not None else np.empty(0, np.int64)
        exposure = frames.exposure[rows] if frames is not None else np.empty(0, np.int64)
        # Before the first and after the last event nothing is known to be missing.
        found.append(
            SampledSegment(
                *columns, segment.span, rows, stamps, exposure, grey, intensity,
                np.zeros(grey.shape, bool),
            )
        )  # fmt: skip
    counts = np.concatenate(by_part, 1).reshape(2, -1, height, width)
    white = max((float(s.grey.max(initial=0)) for s in found), default=0.0) * WHITE_SHARE
    dark, bright = MARGIN_LEVELS / 255, min(white, 1 - MARGIN_LEVELS / 255)
    hot = find_hot_pixels(counts.sum(0))
    is_out = hot.ravel()[places]
    segments = tuple(
        s._replace(clear=(s.grey > dark) & (s.grey < bright)).without(is_out) for s in found
    )
    return Sample(
        segments, places, tile, (width, height), hot, counts.sum(1, dtype=np.int64),
        measure_dead_share(counts.sum(0), hot),
    )  # fmt: skip


def count_between(segment: SampledSegment, offset_us: int = 0) -> NDArray[np.int32]:
    """Count the events between consecutive frames.

    Args:
        segment: The segment.
        offset_us: Time added to the frames' stamps, us.

    Returns:
        (frames - 1, 2, pixels) ON and OFF events.
    """
    pixels = segment.clear.shape[1]
    out = np.zeros((max(len(segment.frame_t) - 1, 0), 2, pixels), np.int32)
    edges = np.searchsorted(segment.t, segment.frame_t + offset_us)
    for k in range(len(out)):
        part = slice(edges[k], edges[k + 1])
        p, pixel = segment.p[part], segment.pixel[part]
        out[k] = [np.bincount(pixel[of], minlength=pixels) for of in (p, ~p)]
    return out


def log_changes(
    segment: SampledSegment, I0: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the changes of ln(I + I0) from each frame to the next.

    Args:
        segment: The segment.
        I0: Offset inside the logarithm.

    Returns:
        (frames - 1, pixels) changes, and where both frames are not clipped.
    """
    L = np.log(np.maximum(segment.intensity, 0) + np.float32(I0))
    return np.diff(L, axis=0), segment.clear[1:] & segment.clear[:-1]


@njit_noalloc
def _add_moments(t, pixel, sign, change, used, edges, count, out):
    """Add up moments of event counts S and changes d of all used pixels, in windows at offsets.

    Args:
        t: (events,) times, us.
        pixel: (events,) numbers of the pixels.
        sign: (events,) 1 or -1; S is its sum in the window.
        change: (pixels,) changes d of log intensity.
        used: (pixels,) whether a pixel counts.
        edges: (offsets, 2) begin and end of the window at each offset, us, ascending.
        count: (pixels,) zeros, scratch.
        out: (offsets, 3), changed in place: sums of S^2, S d and S.
    """
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
    for segment in sample.segments:
        change, used = log_changes(segment, I0)
        sign = np.where(segment.p, 1.0, -1.0)
        count = np.zeros(change.shape[1])
        begin, end = segment.span
        if len(segment.t):
            begin, end = max(begin, int(segment.t[0])), min(end, int(segment.t[-1]))
        for k in range(len(change)):
            edges = segment.frame_t[k : k + 2] + offsets_us[:, None]
            inside = (edges[:, 0] >= begin) & (edges[:, 1] <= end + 1)
            out = np.zeros((len(edges), 3))
            first = int(np.searchsorted(segment.t, edges[0, 0]))
            _add_moments(
                segment.t[first:], segment.pixel[first:], sign[first:], change[k], used[k],
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
