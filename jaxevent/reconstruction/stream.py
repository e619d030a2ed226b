"""The stream of events: what is remembered of it from window to window, and what is counted.

With a dead time an event stands for more than one (`Timing`): counts are then weighted. With
`growth` of a `DeadTime` all counts are derivatives by the dead time, in 1/s.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events, Recording


class Stream(NamedTuple):
    """Events in order of time, as loops see them, of a sensor `width` pixels wide."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    width: int

    @classmethod
    def of(cls, events: Events, width: int) -> "Stream":
        return cls(events.t, events.x, events.y, events.p, width)

    def part(self, begin: int, end: int) -> "Stream":
        """The events of a range of rows."""
        rows = slice(begin, end)
        return Stream(self.t[rows], self.x[rows], self.y[rows], self.p[rows], self.width)


@dataclasses.dataclass
class StreamState:
    """What the stream before a window leaves behind: times of the last event (us)."""

    last: NDArray[np.int64]  # at each pixel
    near: NDArray[np.int64]  # in each pixel's neighbourhood, with a border of one pixel
    # The first event of which the frames tell, and `last` before it; kept where events are weighted
    # by the gap to the one before.
    context: int = 0
    last_then: NDArray[np.int64] | None = None
    frames: int = 1  # how many frames of the recording windows have used

    @classmethod
    def initial(cls, recording: Recording, weighted: bool = False) -> "StreamState":
        pixels = recording.width * recording.height
        border = (recording.width + 2) * (recording.height + 2)
        last = np.full(pixels, recording.start)
        then = last.copy() if weighted else None
        return cls(last, np.full(border, recording.start), 0, then)

    def copy(self) -> "StreamState":
        return dataclasses.replace(self, last=self.last.copy(), near=self.near.copy())


class DeadTime(NamedTuple):
    """A pixel's dead time after an event (us), and whether to count or to differentiate by it."""

    rho: float
    growth: bool


class BaseCounts(NamedTuple):
    """ON and OFF events of each pixel before the times from which pieces count."""

    start: NDArray  # [2, pixels], the window's start
    left: NDArray  # [frames, 2, pixels], left edges of the exposures of the window's frames


class EdgeCounts(NamedTuple):
    """The same, and before the other edges of exposures."""

    base: BaseCounts
    mid: NDArray  # [frames, 2, pixels], middles
    right: NDArray  # [frames, 2, pixels], right edges


@njit
def count_events(x, y, width, pixels):
    """The number of events at each pixel, (pixels,)."""
    counts = np.zeros(pixels, np.int32)
    for i in range(len(x)):
        counts[np.int64(y[i]) * width + x[i]] += 1
    return counts


@njit_noalloc_inlined
def equivalent(gap, dead):
    """How many events one after the gap (us) at its pixel stands for."""
    if dead.rho == 0:
        return 1.0
    if gap <= 1.5 * dead.rho:
        return 0.0 if dead.growth else 3.0
    rest = gap - dead.rho
    return 1e6 * gap / (rest * rest) if dead.growth else gap / rest


@njit_noalloc
def note_latest(stream, last):
    """Bring the times of each pixel's last event, `last`, to the stream's end."""
    t, x, y = stream.t, stream.x, stream.y
    for i in range(len(t)):
        last[np.int64(y[i]) * stream.width + x[i]] = t[i]


def weigh(stream: Stream, last: NDArray[np.int64], dead: DeadTime) -> NDArray[np.float64]:
    """What each event stands for; `last` holds the times of the events before, at each pixel."""
    out = np.empty(len(stream.t))
    _weigh(stream, last, dead, out)
    return out


@njit_noalloc
def _weigh(stream, last, dead, out):
    t, x, y = stream.t, stream.x, stream.y
    for i in range(len(t)):
        pixel = np.int64(y[i]) * stream.width + x[i]
        out[i] = equivalent(t[i] - last[pixel], dead)
        last[pixel] = t[i]


def count_before(stream: Stream, weight: NDArray, edges: NDArray, now: NDArray) -> NDArray:
    """ON and OFF events of each pixel earlier than each edge: [edges, 2, pixels].

    `now` (2, pixels) are the counts at the stream's beginning, and is brought to the last edge.
    """
    out = np.empty((len(edges), *now.shape), now.dtype)
    _count_before(stream, weight, edges, now, out)
    return out


@njit_noalloc
def _count_before(stream, weight, edges, now, out):
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    i = 0
    for e in range(len(edges)):
        while i < len(t) and t[i] < edges[e]:
            now[0 if p[i] else 1, np.int64(y[i]) * stream.width + x[i]] += weight[i]
            i += 1
        for pixel in range(now.shape[1]):  # one by one: numba takes 1.5 s to compile a slice
            out[e, 0, pixel], out[e, 1, pixel] = now[0, pixel], now[1, pixel]


@njit
def add_spread(stream, weight, edges, origin, reach, out):
    """Add to the counts at each edge the part of the pixel's next event that has happened."""
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    last = np.full(out.shape[2], origin)
    for i in range(len(t)):
        pixel = np.int64(y[i]) * stream.width + x[i]
        before, last[pixel] = last[pixel], t[i]
        gap = t[i] - before
        if before > origin and 0 < gap <= reach:
            e = np.searchsorted(edges, before, "right")
            while e < len(edges) and edges[e] <= t[i]:
                out[e, 0 if p[i] else 1, pixel] += weight[i] * (edges[e] - before) / gap
                e += 1
