"""The events that the search for targets looks at, window by window."""

import copy
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.paths import NOBODY, Joined, Path, candidates, join
from jaxevent.kernels import Blank, lean, lean_part
from jaxevent.recording import Events, EventSource, Recording

_counts = Blank(np.int32)
BATCH = 1 << 20  # events read at a time
HELD = 1 << 22  # events: so many and fewer are read once
ALL = np.ones(0, bool)  # all events are kept


class Part(NamedTuple):
    """Consecutive events: t in s since the stream's start, x and y in px."""

    t: NDArray[np.float64]
    x: NDArray[np.int32]
    y: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.t)


class Pixels(NamedTuple):
    """Distinct pixels, int32, and how many events each has, n."""

    x: NDArray[np.int32]
    y: NDArray[np.int32]
    n: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.n)


class Stream:
    """Events of a recording from `start` to before `stop` (us), without those that are left out.

    Left out are `hot` pixels, once they are known, and what is near the paths given to `without`.
    More than `HELD` events are read where they are needed; `without` takes a byte for each.
    """

    def __init__(self, recording: Recording, start: int, stop: int):
        self.recording, self.start, self.stop = recording, start, stop
        self.width, self.height = recording.width, recording.height
        self.hot = np.zeros((recording.height, recording.width), bool)
        self._first, self._last = (recording.events.index(t) for t in (start, stop))
        self._kept: NDArray[np.bool_] | None = None  # of all these rows
        few = len(self) <= HELD
        self._held = recording.events[self._first : self._last] if few else None

    @property
    def duration(self) -> float:
        """s."""
        return (self.stop - self.start) * 1e-6

    def __len__(self) -> int:
        """Events in all, those left out included."""
        return self._last - self._first

    def without(self, paths: Sequence[Path], sigmas: float | int) -> "Stream":
        """The same without events within `sigmas` standard deviations of some paths."""
        stream, first = copy.copy(self), self._first
        kept = np.ones(len(self), bool) if self._kept is None else self._kept.copy()
        rows = first, self._last
        for row, _, whose in near_paths(self.recording.events, join(paths), sigmas, rows):
            kept[row - first : row - first + len(whose)] &= whose[:, 0] == NOBODY
        stream._kept = kept
        return stream

    def window(self, begin: float | int, end: float | int) -> Part:
        """The events of begin <= t < end (s since the start)."""
        return self._rows(*self._span(begin, end))

    def pixels(self, begin: float | int, end: float | int) -> Pixels:
        """The pixels of these events, by their first event."""
        events, kept = self._of_rows(*self._span(begin, end))
        counts = _counts(self.height, self.width)
        x, y, n = np.empty((3, len(events)), np.int32)
        number = _count(events.x, events.y, self.hot, kept, counts, x, y, n)
        return Pixels(x[:number], y[:number], n[:number])

    def add_cells(
        self,
        spans: NDArray[np.float64],
        places: NDArray[np.float64],
        cell: int,
        counts: NDArray[np.int32],
        into: NDArray[np.int64],
    ) -> None:
        """Count the events of some spans (n, 2) s in cells: counts (spans or fewer, rows, columns).

        Cells are those of the px to which a span's map (n, 2, 3) takes events; what is beyond them
        is counted at their edge. `into` says which counts a span is added to.
        """
        us = self.start + np.rint(1e6 * spans).astype(np.int64)
        us = np.clip(us, self.start, self.stop)
        if self._held is not None:
            rows = np.searchsorted(self._held.t, us)
            kept = ALL if self._kept is None else self._kept
            x, y = self._held.x, self._held.y
            _add_cells(x, y, self.hot, kept, rows, places, cell, counts, into)
            return
        for k, (begin, end) in enumerate(us.tolist()):
            one, first, last = slice(k, k + 1), self._index(begin), self._index(end)
            for row in range(first, last, BATCH):
                events, kept = self._of_rows(row, min(row + BATCH, last))
                rows = np.array([[0, len(events)]])
                at = places[one], cell, counts, into[one]
                _add_cells(events.x, events.y, self.hot, kept, rows, *at)

    def times(self, number: int) -> NDArray[np.float64]:
        """Times (s) of some events that are equally many events apart."""
        share = (np.arange(number) + 0.5) / number
        rows = self._first + (share * len(self)).astype(np.int64)
        us = [int(self.recording.events[row : row + 1].t[0]) for row in rows]
        return (np.array(us) - self.start) * 1e-6

    def _span(self, begin: float | int, end: float | int) -> tuple[int, int]:
        us = [self.start + round(1e6 * t) for t in (begin, end)]
        first, last = (self._index(min(max(t, self.start), self.stop)) for t in us)
        return first, last

    def _index(self, us: int) -> int:
        """The first row that is not before a time (us) of the stream."""
        if self._held is None:
            return self.recording.events.index(us)
        return self._first + int(np.searchsorted(self._held.t, us))

    def _of_rows(self, first: int, last: int) -> tuple[Events, NDArray[np.bool_]]:
        """Some events, and which of them are kept, or `ALL`."""
        some = slice(first - self._first, last - self._first)
        kept = ALL if self._kept is None else self._kept[some]
        return self.recording.events[first:last] if self._held is None else self._held[some], kept

    def _rows(self, first: int, last: int) -> Part:
        events, kept = self._of_rows(first, last)
        t, (x, y) = np.empty(len(events)), np.empty((2, len(events)), np.int32)
        number = _keep(events.t, events.x, events.y, self.start, self.hot, kept, t, x, y)
        return Part(t[:number], x[:number], y[:number])


@lean_part
def _stays(i: int, x: Any, y: Any, hot: Any, kept: Any) -> bool:
    """Whether an event is not left out."""
    return (len(kept) == 0 or kept[i]) and not hot[y[i], x[i]]


@lean
def _keep(
    t: Any, x: Any, y: Any, start: int, hot: Any, kept: Any, to_t: Any, to_x: Any, to_y: Any
) -> int:
    """Times (s), x and y of the events that are not left out: how many they are."""
    n = 0
    for i in range(len(x)):
        if _stays(i, x, y, hot, kept):
            to_t[n], to_x[n], to_y[n] = (t[i] - start) * 1e-6, x[i], y[i]
            n += 1
    return n


@lean
def _count(x: Any, y: Any, hot: Any, kept: Any, counts: Any, px: Any, py: Any, n: Any) -> int:
    """Of the events that are not left out the pixels, and how many each has: their number."""
    m = 0
    for i in range(len(x)):
        if _stays(i, x, y, hot, kept):
            if counts[y[i], x[i]] == 0:
                px[m], py[m] = x[i], y[i]
                m += 1
            counts[y[i], x[i]] += 1
    for k in range(m):
        n[k] = counts[py[k], px[k]]
        counts[py[k], px[k]] = 0
    return m


@lean_part
def cell_at(A: Any, x: Any, y: Any, cell: int, shape: Any) -> tuple[int, int]:
    """The cell (row, column) of the px to which a map (2, 3) takes a pixel, or the nearest one."""
    row = int(A[1, 0] * x + A[1, 1] * y + A[1, 2]) // cell
    column = int(A[0, 0] * x + A[0, 1] * y + A[0, 2]) // cell
    return min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)


def near_paths(
    events: EventSource,
    joined: Joined,
    sigmas: float | int,
    rows: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Events, NDArray[np.int32]]]:
    """Events of some rows, by default while some path is, a part after another.

    The first row of each part, its events, and whose they are (`candidates`).
    """
    if rows is None:
        rows = events.index(int(joined.begins.min())), events.index(int(joined.ends.max()))
    for row in range(*rows, BATCH):
        part = events[row : min(row + BATCH, rows[1])]
        yield row, part, candidates(part, joined, sigmas)


@lean
def _add_cells(
    x: Any, y: Any, hot: Any, kept: Any, rows: Any, places: Any, cell: int, counts: Any, into: Any
) -> None:
    for k in range(len(rows)):
        own = counts[into[k]]
        for i in range(rows[k, 0], rows[k, 1]):
            if _stays(i, x, y, hot, kept):
                own[cell_at(places[k], x[i], y[i], cell, own.shape)] += 1
