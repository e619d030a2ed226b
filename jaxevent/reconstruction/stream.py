"""Counts over the stream of events, and the state that passes from window to window.

With a dead time an event stands for more than one (`frames.EventTiming`): counts are then weighted.
With `DeadTime.derivative` all counts are derivatives by the dead time, in 1/s.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events, Recording

# Events that one stands for at most: of a pixel whose events follow each other within a dead time.
MAX_EVENT_WEIGHT = 3.0


class EventStream(NamedTuple):
    """Events in order of time, as compiled loops take them.

    Attributes:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) polarities.
        width: Width of the sensor, px.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    width: int

    @classmethod
    def of(cls, events: Events, width: int) -> "EventStream":
        return cls(events.t, events.x, events.y, events.p, width)

    def slice_rows(self, begin_row: int, end_row: int) -> "EventStream":
        """Return the events of a range of rows.

        Args:
            begin_row: First row.
            end_row: Row after the last one.

        Returns:
            Views of the columns.
        """
        rows = slice(begin_row, end_row)
        return EventStream(self.t[rows], self.x[rows], self.y[rows], self.p[rows], self.width)


@dataclasses.dataclass
class StreamState:
    """Times of the last events (us) before a window."""

    last: NDArray[np.int64]  # at each pixel
    near: NDArray[np.int64]  # in each pixel's 3x3 neighbourhood, with a border of one pixel
    # The first row of the events in the frames' exposures, and `last` before it. Kept where events
    # are weighted by the gap to the one before.
    context: int = 0
    context_last: NDArray[np.int64] | None = None  # us, at each pixel
    frames: int = 1  # number of frames of the recording that windows have used

    @classmethod
    def initial(cls, recording: Recording, weighted: bool = False) -> "StreamState":
        """Return the state before the first event."""
        pixels = recording.width * recording.height
        border = (recording.width + 2) * (recording.height + 2)
        last = np.full(pixels, recording.start)
        context_last = last.copy() if weighted else None
        return cls(last, np.full(border, recording.start), 0, context_last)

    def copy(self) -> "StreamState":
        """Copy the state, to be updated in place."""
        return dataclasses.replace(self, last=self.last.copy(), near=self.near.copy())


class DeadTime(NamedTuple):
    """Dead time of a pixel after an event, and whether counts or their derivatives are made."""

    rho: float  # us
    derivative: bool


class BaseCounts(NamedTuple):
    """ON and OFF events of each pixel before the times from which pieces count."""

    start: NDArray  # [2, pixels], the window's start
    left: NDArray  # [frames, 2, pixels], left edges of the exposures of the window's frames


class EdgeCounts(NamedTuple):
    """ON and OFF events of each pixel before all edges of exposures."""

    base: BaseCounts
    mid: NDArray  # [frames, 2, pixels], middles
    right: NDArray  # [frames, 2, pixels], right edges


@njit
def count_events_per_pixel(x, y, width, n_pixels):
    """Count the events at each pixel.

    Args:
        x: (events,) columns, px.
        y: (events,) rows, px.
        width: Width of the sensor, px.
        n_pixels: Number of pixels of the sensor.

    Returns:
        (pixels,) counts.
    """
    counts = np.zeros(n_pixels, np.int32)
    for i in range(len(x)):
        counts[np.int64(y[i]) * width + x[i]] += 1
    return counts


@njit_noalloc_inlined
def event_weight(gap_us, dead_time):
    """Return the number of events that one event stands for.

    Args:
        gap_us: Time since the pixel's event before, us.
        dead_time: `DeadTime`.

    Returns:
        The number; with `dead_time.derivative` its derivative by the dead time, 1/s.
    """
    if dead_time.rho == 0:
        return 1.0
    if gap_us <= 1.5 * dead_time.rho:
        return 0.0 if dead_time.derivative else MAX_EVENT_WEIGHT
    rest = gap_us - dead_time.rho
    return 1e6 * gap_us / (rest * rest) if dead_time.derivative else gap_us / rest


@njit_noalloc
def update_last_times(stream, out_last_us):
    """Update the times of each pixel's last event to the stream's end.

    Args:
        stream: `EventStream`.
        out_last_us: (pixels,) times, us, changed in place.
    """
    t, x, y = stream.t, stream.x, stream.y
    for i in range(len(t)):
        out_last_us[np.int64(y[i]) * stream.width + x[i]] = t[i]


def event_weights(
    stream: EventStream, last_us: NDArray[np.int64], dead_time: DeadTime
) -> NDArray[np.float64]:
    """Return the number of events that each event stands for.

    Args:
        stream: Events.
        last_us: (pixels,) time of each pixel's last event before the stream, us; updated in place.
        dead_time: The dead time.

    Returns:
        (events,).
    """
    out = np.empty(len(stream.t))
    _event_weights(stream, last_us, dead_time, out)
    return out


def count_polarities(
    recording: Recording, begin: int, end: int, rho_us: float
) -> NDArray[np.float64]:
    """Count the ON and OFF events of each pixel between two times, weighted for a dead time.

    Args:
        recording: The recording.
        begin: First time, us.
        end: End, us.
        rho_us: Dead time, us.

    Returns:
        (2, pixels) ON and OFF events.
    """
    source, pixels = recording.events, recording.width * recording.height
    # With enough events before the begin to know the gaps of nearly all pixels.
    first = 2 * begin - end if rho_us > 0 else begin
    events = source[source.index(first) : source.index(end)]
    weight = np.ones(len(events))
    if rho_us > 0:
        last_us = np.full(pixels, recording.start)
        stream = EventStream.of(events, recording.width)
        weight = event_weights(stream, last_us, DeadTime(rho_us, False))
    place = events.y.astype(np.int64) * recording.width + events.x
    inside = events.t >= begin
    return np.stack(
        [
            np.bincount(place[of], weight[of], minlength=pixels)
            for of in (inside & events.p, inside & ~events.p)
        ],
        dtype=np.float64,
    )


@njit_noalloc
def _event_weights(stream, last, dead, out):
    """Write the number of events that each event stands for.

    Args:
        stream: `EventStream`.
        last: (pixels,) time of each pixel's last event before the stream, us, in place.
        dead: `DeadTime`.
        out: (events,) output.
    """
    t, x, y = stream.t, stream.x, stream.y
    for i in range(len(t)):
        pixel = np.int64(y[i]) * stream.width + x[i]
        out[i] = event_weight(t[i] - last[pixel], dead)
        last[pixel] = t[i]


def count_before_edges(
    stream: EventStream, weight: NDArray, edges_us: NDArray, counts: NDArray
) -> NDArray:
    """Count the ON and OFF events of each pixel that are earlier than each edge.

    Args:
        stream: Events.
        weight: (events,) number of events that each event stands for.
        edges_us: Sorted times, us.
        counts: (2, pixels) counts before the stream; updated in place to the last edge.

    Returns:
        (edges, 2, pixels).
    """
    out = np.empty((len(edges_us), *counts.shape), counts.dtype)
    _count_before(stream, weight, edges_us, counts, out)
    return out


@njit_noalloc
def _count_before(stream, weight, edges, counts, out):
    """Write the ON and OFF events of each pixel that are earlier than each edge.

    Args:
        stream: `EventStream`.
        weight: (events,) number of events that each event stands for.
        edges: (edges,) sorted times, us.
        counts: (2, pixels) counts before the stream, in place to the last edge.
        out: (edges, 2, pixels) output.
    """
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    i = 0
    for e in range(len(edges)):
        while i < len(t) and t[i] < edges[e]:
            counts[0 if p[i] else 1, np.int64(y[i]) * stream.width + x[i]] += weight[i]
            i += 1
        for pixel in range(counts.shape[1]):  # one by one: numba takes 1.5 s to compile a slice
            out[e, 0, pixel], out[e, 1, pixel] = counts[0, pixel], counts[1, pixel]


@njit
def add_spread_events(stream, weight, edges_us, origin_us, reach_us, out_counts):
    """Add to the counts at each edge the fraction of the pixel's next event that has happened.

    The change of an event is spread evenly over the time since the pixel's event before, if that is
    not too long and the event before is not at the recording's start.

    Args:
        stream: `EventStream`.
        weight: (events,) number of events that each event stands for.
        edges_us: (edges,) sorted times, us.
        origin_us: The recording's start, us.
        reach_us: Longest time over which a change is spread, us.
        out_counts: (edges, 2, pixels) counts before each edge, changed in place.
    """
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    last = np.full(out_counts.shape[2], origin_us)
    for i in range(len(t)):
        pixel = np.int64(y[i]) * stream.width + x[i]
        before, last[pixel] = last[pixel], t[i]
        gap = t[i] - before
        if before > origin_us and 0 < gap <= reach_us:
            e = np.searchsorted(edges_us, before, "right")
            while e < len(edges_us) and edges_us[e] <= t[i]:
                out_counts[e, 0 if p[i] else 1, pixel] += weight[i] * (edges_us[e] - before) / gap
                e += 1
