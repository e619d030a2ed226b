"""The events that the search uses, window by window."""

import copy
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.paths import (
    NO_OWNER_INDEX,
    PathTable,
    TargetPath,
    owner_candidates,
    tabulate_paths,
)
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events, EventSource, Recording

_counts = ZeroedScratch(np.int32)
EVENTS_PER_READ = 1 << 20  # events read at a time
MAX_HELD_EVENTS = 1 << 22  # a stream of so many events is held in memory
KEEP_ALL_MASK, NO_HOT_PIXELS = (
    np.ones(0, bool),
    np.zeros((0, 0), bool),
)  # all events are kept, no pixel is hot


class WindowEvents(NamedTuple):
    """Consecutive events of a stream."""

    t: NDArray[np.float64]  # (N,) s since the stream's start
    x: NDArray[np.int32]  # (N,) px
    y: NDArray[np.int32]  # (N,) px

    def __len__(self) -> int:
        return len(self.t)


class PixelCounts(NamedTuple):
    """Distinct pixels of some events, and the events of each."""

    x: NDArray[np.int32]  # (pixels,) px
    y: NDArray[np.int32]  # (pixels,) px
    n: NDArray[np.int32]  # (pixels,) events

    def __len__(self) -> int:
        return len(self.n)


class CountedSpans(NamedTuple):
    """Spans of time, the map of their events' pixels, and the image they are counted in."""

    t: NDArray[np.float64]  # (n, 2) s, begin and end
    maps: NDArray[np.float64]  # (n, 2, 3) from pixels to px of the image
    image: NDArray[np.int64]  # (n,) index of the image


class _Rows(NamedTuple):
    """Consecutive events of the recording, and the masks of those left out, for kernels."""

    t: NDArray[np.int64]  # us
    x: NDArray[np.integer]
    y: NDArray[np.integer]
    hot: NDArray[np.bool_]  # (rows, columns) pixels that are left out, or `NO_HOT_PIXELS`
    kept: NDArray[np.bool_]  # events that are kept, or `KEEP_ALL_MASK`


class Stream:
    """Events of a recording from `start` to before `stop` (us), without those left out.

    Hot pixels are left out once `hot` is set, and events near paths by `without`. More events than
    `MAX_HELD_EVENTS` are read when needed; `without` then takes a byte for each.
    """

    def __init__(self, recording: Recording, start: int, stop: int):
        self.recording, self.start, self.stop = recording, start, stop
        self.width, self.height = recording.width, recording.height
        self._hot = np.zeros((recording.height, recording.width), bool)
        self._any_hot = False
        self._first, self._last = (recording.events.index(t) for t in (start, stop))
        self._kept: NDArray[np.bool_] | None = None  # of all these rows
        # Held events are those that are not left out.
        held = len(self) <= MAX_HELD_EVENTS
        self._held = recording.events[self._first : self._last] if held else None

    @property
    def duration(self) -> float:
        """Length of the stream, s."""
        return (self.stop - self.start) * 1e-6

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return self.height, self.width

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
        return self._last - self._first

    def between(self, begin: float | int, end: float | int) -> "Stream":
        """Return the stream of all events from `begin` to before `end` (s since the start)."""
        return Stream(self.recording, *(self.start + round(1e6 * t) for t in (begin, end)))

    def without(
        self, paths: Sequence[TargetPath], sigmas: float | int, until: int | None = None
    ) -> "Stream":
        """Return the stream without the events near some paths.

        Args:
            paths: Paths whose events are left out.
            sigmas: Distance from a path within which events are left out, standard deviations.
            until: Time (us) up to which the new stream is used; None for all of it.
        """
        stream, table = copy.copy(self), tabulate_paths(paths)
        if self._held is not None:
            events = self._held if until is None else self._held[: self._index(until)]
            stream._held = events[owner_candidates(events, table, sigmas)[:, 0] == NO_OWNER_INDEX]
            return stream
        kept = np.ones(len(self), bool) if self._kept is None else self._kept.copy()
        rows = self._first, self._last if until is None else self._index(until)
        left, number = [Events.empty()], 0
        for row, part, owner in batches_near_paths(self.recording.events, table, sigmas, rows):
            stays = kept[row - self._first :][: len(part)]
            stays &= owner[:, 0] == NO_OWNER_INDEX
            if number <= MAX_HELD_EVENTS:
                left.append(part[stays & ~self.hot[part.y, part.x] if self._any_hot else stays])
                number += len(left[-1])
        if number <= MAX_HELD_EVENTS:
            columns = zip(*((one.t, one.x, one.y, one.p) for one in left), strict=True)
            stream._held, stream._kept = Events.of_checked(*map(np.concatenate, columns)), None
        else:
            stream._kept = kept
        return stream

    def window(self, begin: float | int, end: float | int) -> WindowEvents:
        """Return the events from `begin` to before `end` (s since the start)."""
        rows = self._rows(*self._span(begin, end))
        t, (x, y) = np.empty(len(rows.t)), np.empty((2, len(rows.t)), np.int32)
        number = _select(rows, self.start, WindowEvents(t, x, y))
        return WindowEvents(t[:number], x[:number], y[:number])

    def pixel_counts(self, begin: float | int, end: float | int) -> PixelCounts:
        """Count the events of a span (s) in their pixels, ordered by their first events."""
        return self.sample(begin, end, len(self))[0]

    def sample(
        self, begin: float | int, end: float | int, max_events: int
    ) -> tuple[PixelCounts, int]:
        """Count some events of a span in their pixels, taken at equal steps.

        Args:
            begin: Start of the span, s.
            end: End of the span, s, which it does not include.
            max_events: Number of events that are taken at most.

        Returns:
            The pixels, and the number of events of the span.
        """
        rows = self._rows(*self._span(begin, end))
        counts = _counts(self.height, self.width)
        out = PixelCounts(*np.empty((3, min(len(rows.t), max_events)), np.int32))
        pixels, number = _sample(rows, max_events, counts, out)
        return PixelCounts(*(column[:pixels] for column in out)), number

    def count_in_cells(self, spans: CountedSpans, cell: int, counts: NDArray[np.int32]) -> None:
        """Add the events of spans to counts of cells.

        Events beyond the cells are counted at their edge.

        Args:
            spans: Spans of time and their maps.
            cell: Side of a cell, px.
            counts: (images, rows, columns) to which events are added.
        """
        us = self.start + np.rint(1e6 * spans.t).astype(np.int64)
        us = np.clip(us, self.start, self.stop)
        if self._held is not None:
            rows = self._rows(0, len(self._held))
            _add_to_cells(rows, np.searchsorted(self._held.t, us), spans, cell, counts)
            return
        for k, (begin, end) in enumerate(us.tolist()):
            one, last = CountedSpans._make(v[k : k + 1] for v in spans), self._index(end)
            for row in range(self._index(begin), last, EVENTS_PER_READ):
                rows = self._rows(row, min(row + EVENTS_PER_READ, last))
                _add_to_cells(rows, np.array([[0, len(rows.t)]]), one, cell, counts)

    def count_in_spans(
        self, spans: NDArray[np.float64], cell: int, counts: NDArray[np.int32]
    ) -> None:
        """Add the events of spans that may overlap to counts of cells at rest.

        Each event is read once, unlike in `count_in_cells`.

        Args:
            spans: (n, 2) s, begin and end.
            cell: Side of a cell, px.
            counts: (n, rows, columns) to which events are added.
        """
        us = self.start + np.rint(1e6 * spans.ravel()).astype(np.int64)
        us = np.clip(us, self.start, self.stop)
        edges = np.argsort(us, kind="stable")
        us, done, before = us[edges], 0, np.zeros(counts.shape[1:], np.int32)
        first, last = self._index(int(us[0])), self._index(int(us[-1]))
        for row in range(first, last, EVENTS_PER_READ):
            end = min(row + EVENTS_PER_READ, last)
            rows = self._rows(row, end)
            limits = np.searchsorted(rows.t, us[done:])
            some = len(limits) if end == last else int(np.searchsorted(limits, len(rows.t)))
            _add_between_edges(rows, limits[:some], edges[done : done + some], cell, before, counts)
            done += some

    def quantile_times(self, number: int) -> NDArray[np.float64]:
        """Return times (number,) s of events that are equally many events apart."""
        share = (np.arange(number) + 0.5) / number
        rows = self._first + (share * len(self)).astype(np.int64)
        us = [int(self.recording.events[row : row + 1].t[0]) for row in rows]
        return (np.array(us) - self.start) * 1e-6

    def _span(self, begin: float | int, end: float | int) -> tuple[int, int]:
        """Return the rows of a span (s), first and end."""
        us = [self.start + round(1e6 * t) for t in (begin, end)]
        first, last = (self._index(min(max(t, self.start), self.stop)) for t in us)
        return first, last

    def _index(self, us: int) -> int:
        """Return the first row, of those held or of the recording, that is not before a time."""
        if self._held is None:
            return self.recording.events.index(us)
        return int(np.searchsorted(self._held.t, us))

    def _rows(self, first: int, last: int) -> _Rows:
        """Return rows of the events with the masks of those left out."""
        if self._held is not None:
            events, hot, kept = self._held[first:last], NO_HOT_PIXELS, KEEP_ALL_MASK
        else:
            events, hot = (
                self.recording.events[first:last],
                self.hot if self._any_hot else NO_HOT_PIXELS,
            )
            some = slice(first - self._first, last - self._first)
            kept = KEEP_ALL_MASK if self._kept is None else self._kept[some]
        return _Rows(events.t, events.x, events.y, hot, kept)


def batches_near_paths(
    events: EventSource,
    table: PathTable,
    sigmas: float | int,
    rows: tuple[int, int] | None = None,
    *,
    every: int = 1,
) -> Iterator[tuple[int, Events, NDArray[np.int32]]]:
    """Yield events in batches, with the paths that they may belong to.

    Args:
        events: Events of a recording.
        table: Rows of the paths.
        sigmas: Radius of the gate, standard deviations.
        rows: First and last row of the events; None for those in the paths' lives.
        every: Step between the events that are taken.

    Yields:
        The first row of a batch, its events, and their `owner_candidates`.
    """
    if rows is None:
        rows = events.index(int(table.begins.min())), events.index(int(table.ends.max()))
    for row in range(*rows, EVENTS_PER_READ):
        part = events[row : min(row + EVENTS_PER_READ, rows[1])]
        part = part if every == 1 else part[::every]
        yield row, part, owner_candidates(part, table, sigmas)


@njit_noalloc_inlined
def _is_kept(rows: Any, i: int) -> bool:
    """Return whether an event is not left out."""
    return (len(rows.kept) == 0 or rows.kept[i]) and (
        len(rows.hot) == 0 or not rows.hot[rows.y[i], rows.x[i]]
    )


@njit_noalloc
def _select(rows: Any, start: int, out: Any) -> int:
    """Fill in the events that are kept, and return their number."""
    n = 0
    for i in range(len(rows.t)):
        if _is_kept(rows, i):
            out.t[n], out.x[n], out.y[n] = (rows.t[i] - start) * 1e-6, rows.x[i], rows.y[i]
            n += 1
    return n


@njit_noalloc
def _sample(rows: Any, most: int, counts: Any, out: Any) -> tuple[int, int]:
    """Fill in the pixels of at most so many kept events; return the numbers of both.

    `counts` (rows, columns) are zero, and are again.
    """
    events, pixels = len(rows.t), 0
    if events > most:
        if len(rows.hot) == 0 and len(rows.kept) == 0:
            for k in range(most):
                pixels += _count_event(rows, k * (events - 1) // (most - 1), counts, out, pixels)
            _take_counts(pixels, counts, out)
            return pixels, events
        events = 0
        for i in range(len(rows.t)):
            events += _is_kept(rows, i)
    number = following = taken = 0
    for i in range(len(rows.t)):
        if _is_kept(rows, i):
            if number == following:
                pixels += _count_event(rows, i, counts, out, pixels)
                taken += 1
                following = taken * (events - 1) // (most - 1) if events > most else taken
            number += 1
    _take_counts(pixels, counts, out)
    return pixels, number


@njit_noalloc_inlined
def _count_event(rows: Any, i: int, counts: Any, out: Any, pixels: int) -> int:
    """Count an event in its pixel; return 1 if the pixel is new, else 0."""
    x, y = rows.x[i], rows.y[i]
    counts[y, x] += 1
    if counts[y, x] > 1:
        return 0
    out.x[pixels], out.y[pixels] = x, y
    return 1


@njit_noalloc_inlined
def _take_counts(pixels: int, counts: Any, out: Any) -> None:
    """Move the counts of pixels from the image to the list."""
    for k in range(pixels):
        out.n[k] = counts[out.y[k], out.x[k]]
        counts[out.y[k], out.x[k]] = 0


@njit_noalloc_inlined
def cell_at(A: Any, x: Any, y: Any, cell: int, shape: Any) -> tuple[int, int]:
    """Return the cell (row, column) to which a map (2, 3) takes a pixel, or the nearest one."""
    row = int(A[1, 0] * x + A[1, 1] * y + A[1, 2]) // cell
    column = int(A[0, 0] * x + A[0, 1] * y + A[0, 2]) // cell
    return min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)


@njit_noalloc_inlined
def _log2(cell: int) -> int:
    """Return the exponent of a power of two."""
    bits = 0
    while 1 << bits < cell:
        bits += 1
    return bits


@njit_noalloc
def _add_to_cells(rows: Any, limits: Any, spans: Any, cell: int, counts: Any) -> None:
    """Add the events between `limits` (n, 2) to their images."""
    bits = _log2(cell)
    for k in range(len(limits)):
        own, A = counts[spans.image[k]], spans.maps[k]
        moved = A[0, 0] != 1 or A[1, 1] != 1 or A[0, 1] != 0 or A[1, 0] != 0
        moved |= A[0, 2] != 0 or A[1, 2] != 0
        for i in range(limits[k, 0], limits[k, 1]):
            if not _is_kept(rows, i):
                continue
            if moved:
                own[cell_at(A, rows.x[i], rows.y[i], cell, own.shape)] += 1
            else:
                own[rows.y[i] >> bits, rows.x[i] >> bits] += 1


@njit_noalloc
def _add_between_edges(
    rows: Any, limits: Any, edges: Any, cell: int, before: Any, counts: Any
) -> None:
    """Add counts `before` the ends of spans, and subtract those before their beginnings.

    Edges, at `limits` of the events, are numbered: twice that of the span, and 1 more at its end.
    """
    bits, i = _log2(cell), 0
    for k in range(len(limits) + 1):
        until = limits[k] if k < len(limits) else len(rows.t)
        while i < until:
            if _is_kept(rows, i):
                before[rows.y[i] >> bits, rows.x[i] >> bits] += 1
            i += 1
        if k < len(limits):
            own, sign = counts[edges[k] >> 1], 2 * (edges[k] & 1) - 1
            for row in range(before.shape[0]):
                for column in range(before.shape[1]):
                    own[row, column] += sign * before[row, column]
