"""Log intensity between the events of a pixel, as far as its events tell.

At each event the log intensity has moved by one threshold since the event before. Between both it
is interpolated, so that counts are known in fractions of an event at any time, and their means over
exposures exactly. Interpolation is by parabolas: a straight line lies inside every curve, as if
exposures were longer. The curvature is that of the slopes before and after.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.sampling import SampledSegment
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

MIN_EVENTS_PER_PIXEL = 4
MAX_WEIGHT = 3.0  # events that one stands for after a dead time


class PixelEvents(NamedTuple):
    """Events of the pixels of a segment that fire often enough, pixel by pixel.

    Attributes:
        t: (n,) times, us.
        p: (n,) polarities.
        first: (active + 1,) row of the first event of each pixel, and n.
        active: (active,) index among the sampled pixels.
        clear: (active, frames) whether the pixel is unclipped.
    """

    t: NDArray[np.int64]
    p: NDArray[np.bool_]
    first: NDArray[np.intp]
    active: NDArray[np.intp]
    clear: NDArray[np.bool_]

    def take_every(self, step: int) -> "PixelEvents":
        """Return the events of every `step`-th pixel."""
        if step <= 1:
            return self
        kept = np.arange(0, len(self.active), step)
        number = np.diff(self.first)[kept]
        first = np.concatenate([[0], np.cumsum(number)])
        rows = np.arange(first[-1]) + np.repeat(self.first[kept] - first[:-1], number)
        return PixelEvents(self.t[rows], self.p[rows], first, self.active[kept], self.clear[kept])


class Interpolation(NamedTuple):
    """Counts of events as functions of time.

    Columns of arrays (events, 4) are ON and OFF events, and their derivatives by the dead time, in
    1/s.
    """

    t: NDArray[np.float64]  # us since the first event
    counts: NDArray[np.float64]  # (events, 4) up to and with each event
    bend: NDArray[np.float64]  # (events, 4) second derivative since the event before, 1/us^2
    integral: NDArray[np.float64]  # (events, 4) of the interpolated counts until each, us
    origin: int  # us


class Positions(NamedTuple):
    """Interpolated counts at exposures, each (active, frames, 4), where `good`."""

    good: NDArray[np.bool_]  # (active, frames)
    gap: NDArray[np.float32]  # (active, frames) s between the events around
    mean: NDArray[np.float32]  # over the exposure
    edges: NDArray[np.float32]  # mean of those at its begin and its end
    travel: NDArray[np.float32]  # from its begin to its end
    spread: NDArray[np.float32]  # of errors of events, see `_exposure_error_sums`


def sort_by_pixel(segment: SampledSegment, clear: NDArray[np.bool_]) -> PixelEvents:
    """Sort the events of a segment by pixel.

    Args:
        segment: The segment.
        clear: (frames, pixels) where frames can be used.

    Returns:
        The events.
    """
    number = np.bincount(segment.pixel, minlength=clear.shape[1])
    active = np.flatnonzero((number >= MIN_EVENTS_PER_PIXEL) & (clear.sum(0) > 1))
    index = np.full(len(number), -1)
    index[active] = np.arange(len(active))
    index = index[segment.pixel]
    rows = np.flatnonzero(index >= 0)
    rows = rows[np.argsort(index[rows], kind="stable")]
    first = np.concatenate([[0], np.cumsum(number[active])])
    return PixelEvents(
        segment.t[rows], segment.p[rows], first, active, np.ascontiguousarray(clear[:, active].T)
    )


@njit_noalloc
def _interpolate_counts(t, p, first, rho, counts, bend, integral):
    """Interpolate the counts of events between events, pixel by pixel.

    Args:
        t: (n,) times of events, us, pixel by pixel.
        p: (n,) polarities.
        first: (pixels + 1,) first event of each pixel, and n.
        rho: Dead time, us.
        counts: (n, 4) output: ON and OFF counts up to and with the event, and their derivatives by
            the dead time, 1/s.
        bend: (n, 4) output, second derivatives of the counts in the gap before the event, 1/us^2.
        integral: (n, 4) output, integrals of the counts from the pixel's first event on, us.
    """
    for i in range(len(first) - 1):
        low, high = first[i], first[i + 1]
        for k in range(low, high):
            weight, change = 1.0, 0.0
            for channel in range(4):
                counts[k, channel] = counts[k - 1, channel] if k > low else 0.0
                bend[k, channel] = 0.0
            if k > low:
                gap = t[k] - t[k - 1]
                if gap > 1.5 * rho:
                    weight = gap / (gap - rho)
                    change = 1e6 * gap / ((gap - rho) * (gap - rho))
                else:
                    weight = MAX_WEIGHT
            own = 0 if p[k] else 1
            counts[k, own] += weight
            counts[k, own + 2] += change
        for k in range(low, high):
            if k == low:
                for channel in range(4):
                    integral[k, channel] = 0.0
                continue
            gap = t[k] - t[k - 1]
            inner = k > low + 1 and k + 1 < high and gap > 0
            before = t[k - 1] - t[k - 2] if inner else 0.0
            after = t[k + 1] - t[k] if inner else 0.0
            for channel in range(4):
                if channel < 2 and before > 0 and after > 0:
                    slope = (counts[k, channel] - counts[k - 1, channel]) / gap
                    earlier = (counts[k - 1, channel] - counts[k - 2, channel]) / before
                    later = (counts[k + 1, channel] - counts[k, channel]) / after
                    curve = 2 * (later - earlier) / (before + 2 * gap + after)
                    # Within its gap a parabola turns at most at one end.
                    most = 2 * slope / gap
                    bend[k, channel] = min(max(curve, -most), most)
                integral[k, channel] = (
                    integral[k - 1, channel]
                    + gap * (counts[k - 1, channel] + counts[k, channel]) / 2
                    - bend[k, channel] * gap * gap * gap / 12
                )


def interpolate(events: PixelEvents, rho_us: float) -> Interpolation:
    """Interpolate the counts of events.

    Args:
        events: The events.
        rho_us: Dead time of a pixel after an event, us.

    Returns:
        The counts.
    """
    origin = int(events.t.min()) if len(events.t) else 0
    # With a dead time the change from an event to the next is known from the dead time's end only.
    # What was lost is that part of the path with the slope around the event, but is spread over the
    # gap after it: the sum of all is the path, later by half of the dead time.
    t = (events.t - origin).astype(np.float64) + rho_us / 2
    counts, bend, integral = (np.empty((len(t), 4)) for _ in range(3))
    _interpolate_counts(t, events.p, events.first, float(rho_us), counts, bend, integral)
    return Interpolation(t, counts, bend, integral, origin)


@njit_noalloc_inlined
def _level(counts, bend, k, channel, gap, u):
    """Return a pixel's count between two of its events.

    Args:
        counts: (n, 4) counts at events.
        bend: (n, 4) second derivatives in the gaps before events.
        k: Number of the event after the time.
        channel: Number of the count, 0 to 3.
        gap: Length of the gap before event k, us.
        u: Part of the gap that is over, 0 to 1.
    """
    step = counts[k, channel] - counts[k - 1, channel]
    return counts[k - 1, channel] + u * step - bend[k, channel] * gap * gap * u * (1 - u) / 2


@njit_noalloc_inlined
def _area(counts, bend, integral, k, channel, gap, u):
    """Return the integral of a pixel's count from its first event to a time between two events.

    Args:
        counts: (n, 4) counts at events.
        bend: (n, 4) second derivatives in the gaps before events.
        integral: (n, 4) integrals up to events, us.
        k: Number of the event after the time.
        channel: Number of the count, 0 to 3.
        gap: Length of the gap before event k, us.
        u: Part of the gap that is over, 0 to 1.
    """
    step = counts[k, channel] - counts[k - 1, channel]
    line = u * gap * (counts[k - 1, channel] + u * step / 2)
    curve = bend[k, channel] * gap * gap * gap * u * u * (1 / 4 - u / 6)
    return integral[k - 1, channel] + line - curve


@njit_noalloc_inlined
def _exposure_error_sums(t, k, m, u, v, length):
    """Return the share of events' errors that remains in the mean over an exposure.

    An error of one event stands on the lines to its neighbours. So the mean has weights w of the
    events k - 1 to m, and the mean of both ends has weights e.

    Args:
        t: (n,) times of events, us.
        k: First event not before the exposure's begin.
        m: First event not before its end.
        u: Part of the gap before event k that is over at the begin, 0 to 1.
        v: Part of the gap before event m that is over at the end.
        length: Length of the exposure, us.

    Returns:
        The sums over events of w^2 and of w (e - w), and the same of errors that add up from event
            to
        event: of C (E - C), C and E the sums of w and e from an event on, and of those before it.
    """
    squares = products = late = early = carried = before = ends_before = 0.0
    for j in range(k, m + 2):
        left = right = 0.0
        if j <= m:
            first, last = (u if j == k else 0.0), (v if j == m else 1.0)
            right = (t[j] - t[j - 1]) * (last * last - first * first) / 2
            left = (t[j] - t[j - 1]) * (last - first) - right
        weight = (carried + left) / length
        end = 0.0
        if j == k:
            end += (1 - u) / 2
        if j == k + 1:
            end += u / 2
        if j == m:
            end += (1 - v) / 2
        if j == m + 1:
            end += v / 2
        squares += weight * weight
        products += weight * (end - weight)
        before += weight
        ends_before += end
        if j <= m:
            late += (1 - before) * (before - ends_before)
            early += before * (ends_before - before)
        carried = right
    return squares, products, late, early


@njit_noalloc
def _read(events, path, begin, end, longest, out):
    """Read interpolated counts at exposures.

    Args:
        events: `PixelEvents`.
        path: `Interpolation` of them.
        begin: (frames,) begins of the exposures, us since `path.origin`.
        end: (frames,) their ends, likewise.
        longest: Time between events from which a pixel does not count, s.
        out: `Positions`, output.
    """
    _, p, first, _, clear = events
    t, counts, bend, integral, _ = path
    good, gaps, mean, edges, travel, spread = out
    for i in range(len(first) - 1):
        low, high = first[i], first[i + 1]
        k = low  # the first event not before the time
        for f in range(len(begin)):
            good[i, f] = False
            while k < high and t[k] < begin[f]:
                k += 1
            m = k
            while m < high and t[m] < end[f]:
                m += 1
            if k == low or m == high or not clear[i, f]:
                continue
            before, after = t[k] - t[k - 1], t[m] - t[m - 1]
            gap = 0.5e-6 * (before + after)
            if p[k - 1] != p[k] or p[m - 1] != p[m] or not gap < longest:
                continue
            good[i, f], gaps[i, f] = True, gap
            u = (begin[f] - t[k - 1]) / before if before > 0 else 1.0
            v = (end[f] - t[m - 1]) / after if after > 0 else 1.0
            parts = _exposure_error_sums(t, k, m, u, v, end[f] - begin[f])
            for part in range(4):
                spread[i, f, part] = parts[part]
            for channel in range(4):
                at_begin = _level(counts, bend, k, channel, before, u)
                at_end = _level(counts, bend, m, channel, after, v)
                area = _area(counts, bend, integral, m, channel, after, v)
                area -= _area(counts, bend, integral, k, channel, before, u)
                mean[i, f, channel] = area / (end[f] - begin[f])
                edges[i, f, channel] = (at_begin + at_end) / 2
                travel[i, f, channel] = at_end - at_begin


def read_positions(
    events: PixelEvents,
    path: Interpolation,
    middle_us: NDArray[np.floating],
    length_us: NDArray[np.floating],
    longest: float,
) -> Positions:
    """Read the interpolated counts at exposures.

    A position is good where the frame is clear, and the two events around the begin of the exposure
    are of equal polarity, as are those around its end, and near in time.

    Args:
        events: Events of a segment.
        path: Their interpolation.
        middle_us: (frames,) sorted middles of exposures, us since the path's origin.
        length_us: (frames,) their lengths, us, positive.
        longest: Longest mean time between the two events, s.

    Returns:
        The counts.
    """
    begin = middle_us - length_us / 2
    shape = len(events.active), len(middle_us)
    good, gap = np.empty(shape, np.bool_), np.empty(shape, np.float32)
    out = Positions(good, gap, *(np.empty((*shape, 4), np.float32) for _ in range(4)))
    _read(events, path, begin, begin + length_us, longest, out)
    return out
