"""The events that the search for targets looks at, window by window."""

import copy
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.paths import NOBODY, Joined, Path, candidates, join
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events, EventSource, Recording

_counts = ZeroedScratch(np.int32)
BATCH = 1 << 20  # events read at a time
HELD = 1 << 22  # events: so many and fewer are read once
ALL, COLD = np.ones(0, bool), np.zeros((0, 0), bool)  # all events are kept, no pixel is hot


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
        self._hot = np.zeros((recording.height, recording.width), bool)
        self._any_hot = False
        self._first, self._last = (recording.events.index(t) for t in (start, stop))
        self._kept: NDArray[np.bool_] | None = None  # of all these rows
        few = len(self) <= HELD
        # What is held is without what is left out.
        self._held = recording.events[self._first : self._last] if few else None

    @property
    def duration(self) -> float:
        """s."""
        return (self.stop - self.start) * 1e-6

    @property
    def hot(self) -> NDArray[np.bool_]:
        """(rows, columns) pixels that are left out."""
        return self._hot

    @hot.setter
    def hot(self, hot: NDArray[np.bool_]) -> None:
        self._hot, self._any_hot = hot, bool(hot.any())
        if self._held is not None and self._any_hot:
            self._held = self._held[~hot[self._held.y, self._held.x]]

    def __len__(self) -> int:
        """Events in all, those left out included."""
        return self._last - self._first

    def part(self, begin: float | int, end: float | int) -> "Stream":
        """The events of begin <= t < end (s since the start), those left out included."""
        return Stream(self.recording, *(self.start + round(1e6 * t) for t in (begin, end)))

    def without(
        self, paths: Sequence[Path], sigmas: float | int, until: int | None = None
    ) -> "Stream":
        """The same without events within `sigmas` standard deviations of some paths.

        Before `until` (us), if it is given; what is held ends there. If few events are left they
        are held.
        """
        stream, joined = copy.copy(self), join(paths)
        if self._held is not None:
            events = self._held if until is None else self._held[: self._index(until)]
            stream._held = events[candidates(events, joined, sigmas)[:, 0] == NOBODY]
            return stream
        kept = np.ones(len(self), bool) if self._kept is None else self._kept.copy()
        rows = self._first, self._last if until is None else self._index(until)
        left, number = [Events.empty()], 0
        for row, part, whose in near_paths(self.recording.events, joined, sigmas, rows):
            stays = kept[row - self._first :][: len(part)]
            stays &= whose[:, 0] == NOBODY
            if number <= HELD:
                left.append(part[stays & ~self.hot[part.y, part.x] if self._any_hot else stays])
                number += len(left[-1])
        if number <= HELD:
            columns = zip(*((one.t, one.x, one.y, one.p) for one in left), strict=True)
            stream._held, stream._kept = Events.of_checked(*map(np.concatenate, columns)), None
        else:
            stream._kept = kept
        return stream

    def window(self, begin: float | int, end: float | int) -> Part:
        """The events of begin <= t < end (s since the start)."""
        return self._rows(*self._span(begin, end))

    def pixels(self, begin: float | int, end: float | int) -> Pixels:
        """The pixels of these events, by their first event."""
        return self.sample(begin, end, len(self))[0]

    def sample(self, begin: float | int, end: float | int, most: int) -> tuple[Pixels, int]:
        """The pixels of at most so many of these events, at equal steps; how many are in all."""
        events, hot, kept = self._of_rows(*self._span(begin, end))
        counts = _counts(self.height, self.width)
        x, y, n = np.empty((3, min(len(events), most)), np.int32)
        pixels, number = _count(events.x, events.y, hot, kept, most, counts, x, y, n)
        return Pixels(x[:pixels], y[:pixels], n[:pixels]), number

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
            rows, (x, y) = np.searchsorted(self._held.t, us), (self._held.x, self._held.y)
            _add_cells(x, y, COLD, ALL, rows, places, cell, counts, into)
            return
        for k, (begin, end) in enumerate(us.tolist()):
            one, first, last = slice(k, k + 1), self._index(begin), self._index(end)
            for row in range(first, last, BATCH):
                events, hot, kept = self._of_rows(row, min(row + BATCH, last))
                rows = np.array([[0, len(events)]])
                at = places[one], cell, counts, into[one]
                _add_cells(events.x, events.y, hot, kept, rows, *at)

    def count_spans(self, spans: NDArray[np.float64], cell: int, counts: NDArray[np.int32]) -> None:
        """Add to counts (n, rows, columns) the events of spans (n, 2) s, which may overlap.

        As `add_cells` does of cells that stand still, but each event is looked at once.
        """
        us = self.start + np.rint(1e6 * spans.ravel()).astype(np.int64)
        us = np.clip(us, self.start, self.stop)
        edges = np.argsort(us, kind="stable")
        us, columns, done = us[edges], counts.shape[2], 0
        counts = counts.reshape(len(counts), -1)
        before = np.zeros(counts.shape[1], np.int32)
        first, last = self._index(int(us[0])), self._index(int(us[-1]))
        for row in range(first, last, BATCH):
            end = min(row + BATCH, last)
            events, hot, kept = self._of_rows(row, end)
            rows = np.searchsorted(events.t, us[done:])
            some = len(rows) if end == last else int(np.searchsorted(rows, len(events)))
            place = rows[:some], edges[done : done + some]
            _count_spans(events.x, events.y, hot, kept, *place, cell, columns, before, counts)
            done += some

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
        """The first row, of those held or of the recording, that is not before a time (us)."""
        if self._held is None:
            return self.recording.events.index(us)
        return int(np.searchsorted(self._held.t, us))

    def _of_rows(
        self, first: int, last: int
    ) -> tuple[Events, NDArray[np.bool_], NDArray[np.bool_]]:
        """Some events, pixels that are left out, or `COLD`, and which are kept, or `ALL`."""
        if self._held is not None:
            return self._held[first:last], COLD, ALL
        some = slice(first - self._first, last - self._first)
        kept = ALL if self._kept is None else self._kept[some]
        hot = self.hot if self._any_hot else COLD
        return self.recording.events[first:last], hot, kept

    def _rows(self, first: int, last: int) -> Part:
        events, hot, kept = self._of_rows(first, last)
        t, (x, y) = np.empty(len(events)), np.empty((2, len(events)), np.int32)
        number = _keep(events.t, events.x, events.y, self.start, hot, kept, t, x, y)
        return Part(t[:number], x[:number], y[:number])


@njit_noalloc_inlined
def _stays(i: int, x: Any, y: Any, hot: Any, kept: Any) -> bool:
    """Whether an event is not left out."""
    return (len(kept) == 0 or kept[i]) and (len(hot) == 0 or not hot[y[i], x[i]])


@njit_noalloc
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


@njit_noalloc
def _count(
    x: Any, y: Any, hot: Any, kept: Any, most: int, counts: Any, px: Any, py: Any, n: Any
) -> tuple[int, int]:
    """Pixels of at most so many of the events that are not left out, and how many each has.

    How many pixels there are, and how many events in all.
    """
    events, m = len(x), 0
    if events > most:
        if len(hot) == 0 and len(kept) == 0:
            for k in range(most):
                m += _enter(x, y, k * (events - 1) // (most - 1), counts, px, py, m)
            _empty(m, counts, px, py, n)
            return m, events
        events = 0
        for i in range(len(x)):
            events += _stays(i, x, y, hot, kept)
    number = following = taken = 0
    for i in range(len(x)):
        if _stays(i, x, y, hot, kept):
            if number == following:
                m += _enter(x, y, i, counts, px, py, m)
                taken += 1
                following = taken * (events - 1) // (most - 1) if events > most else taken
            number += 1
    _empty(m, counts, px, py, n)
    return m, number


@njit_noalloc_inlined
def _enter(x: Any, y: Any, i: int, counts: Any, px: Any, py: Any, m: int) -> int:
    """Count an event in its pixel, the m-th if it is new: whether it is, 0 or 1."""
    counts[y[i], x[i]] += 1
    if counts[y[i], x[i]] > 1:
        return 0
    px[m], py[m] = x[i], y[i]
    return 1


@njit_noalloc_inlined
def _empty(m: int, counts: Any, px: Any, py: Any, n: Any) -> None:
    """Take over the counts of m pixels."""
    for k in range(m):
        n[k] = counts[py[k], px[k]]
        counts[py[k], px[k]] = 0


@njit_noalloc_inlined
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
    every: int = 1,
) -> Iterator[tuple[int, Events, NDArray[np.int32]]]:
    """Events of some rows, by default while some path is, a part after another; one of `every`.

    The first row of each part, its events, and whose they are (`candidates`).
    """
    if rows is None:
        rows = events.index(int(joined.begins.min())), events.index(int(joined.ends.max()))
    for row in range(*rows, BATCH):
        part = events[row : min(row + BATCH, rows[1])]
        part = part if every == 1 else part[::every]
        yield row, part, candidates(part, joined, sigmas)


@njit_noalloc_inlined
def _bits(cell: int) -> int:
    """By how many a place (px) is shifted to tell its cell."""
    bits = 0
    while 1 << bits < cell:
        bits += 1
    return bits


@njit_noalloc
def _add_cells(
    x: Any, y: Any, hot: Any, kept: Any, rows: Any, places: Any, cell: int, counts: Any, into: Any
) -> None:
    bits = _bits(cell)
    for k in range(len(rows)):
        own, A = counts[into[k]], places[k]
        moved = A[0, 0] != 1 or A[1, 1] != 1 or A[0, 1] != 0 or A[1, 0] != 0
        moved |= A[0, 2] != 0 or A[1, 2] != 0
        for i in range(rows[k, 0], rows[k, 1]):
            if not _stays(i, x, y, hot, kept):
                continue
            if moved:
                own[cell_at(A, x[i], y[i], cell, own.shape)] += 1
            else:
                own[y[i] >> bits, x[i] >> bits] += 1


@njit_noalloc
def _count_spans(
    x: Any, y: Any, hot: Any, kept: Any, rows: Any, edges: Any, cell: int, columns: int,
    before: Any, counts: Any,
) -> None:  # fmt: skip
    """Add to counts of spans those `before` their ends, less those before their beginnings.

    Edges, at `rows` of the events, are numbered: twice that of the span, and 1 more at its end.
    """
    bits = _bits(cell)
    i = 0
    for k in range(len(rows) + 1):
        until = rows[k] if k < len(rows) else len(x)
        while i < until:
            if _stays(i, x, y, hot, kept):
                before[(y[i] >> bits) * columns + (x[i] >> bits)] += 1
            i += 1
        if k < len(rows):
            own = counts[edges[k] >> 1]
            if edges[k] & 1:
                for j in range(len(before)):
                    own[j] += before[j]
            else:
                for j in range(len(before)):
                    own[j] -= before[j]
