"""The events that the search uses, window by window."""

import copy
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.owners import NO_OWNER_INDEX, PathTable, owner_candidates
from jaxevent.blob.search.paths import TargetPath, tabulate_paths
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events, EventSource, Recording

_counts = ZeroedScratch(np.int32)
EVENTS_PER_READ = 1 << 20  # events read at a time
MAX_HELD_EVENTS = 1 << 22  # a stream of so many events is held in memory


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


class Stream:
    """Events of a recording from `start` to before `stop` (us), without those left out.

    Hot pixels are left out once `hot` is set, and events near paths by `without`. No more events
    than `MAX_HELD_EVENTS` are held; others are read when needed, and take a byte each once some of
    them are left out.
    """

    def __init__(self, recording: Recording, start: int, stop: int):
        self.recording, self.start, self.stop = recording, start, stop
        self.width, self.height = recording.width, recording.height
        self._hot = np.zeros((recording.height, recording.width), bool)
        self._first, self._last = (recording.events.index(t) for t in (start, stop))
        self._all = self._first, self._last
        # Rows `_first` to `_last` of these events, of which `_kept` tells those not left out.
        self._events: EventSource = recording.events
        self._kept: NDArray[np.bool_] | None = None
        if len(self) <= MAX_HELD_EVENTS:
            self._hold(self._events[self._first : self._last])

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
        self._hot = hot
        if hot.any():
            self._leave_out((row, hot[part.y, part.x]) for row, part in self._batches())

    def __len__(self) -> int:
        return self._all[1] - self._all[0]

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
        stream = copy.copy(self)
        if until is not None:
            stream._last = self._events.index(until)
        table = tabulate_paths(paths)
        stream._leave_out(
            (row, owner_candidates(part, table, sigmas)[:, 0] != NO_OWNER_INDEX)
            for row, part in stream._batches()
        )
        return stream

    def near(
        self, table: PathTable, sigmas: float | int, every: int = 1
    ) -> Iterator[tuple[Events, NDArray[np.int32]]]:
        """Yield events in batches, with the paths that they may belong to.

        Args:
            table: Rows of the paths.
            sigmas: Radius of the gate, standard deviations.
            every: Step between the events that are taken.

        Yields:
            Events, and their `owner_candidates`.
        """
        for row, part in self._batches():
            part = self._read(row, row + len(part))[::every]
            yield part, owner_candidates(part, table, sigmas)

    def _leave_out(self, masks: Iterable[tuple[int, NDArray[np.bool_]]]) -> None:
        """Leave out events, given by the first row of each batch and a mask of its events."""
        kept = np.ones(self._last - self._first, bool)
        if self._kept is not None:
            kept &= self._kept[: len(kept)]
        for row, mask in masks:
            kept[row - self._first :][: len(mask)] &= ~mask
        self._kept = kept
        if np.count_nonzero(kept) <= MAX_HELD_EVENTS:
            parts = [self._read(row, row + len(part)) for row, part in self._batches()]
            columns = (np.concatenate([getattr(part, k) for part in parts]) for k in "txyp")
            self._hold(Events.of_checked(*columns) if parts else Events.empty())

    def _hold(self, events: Events) -> None:
        """Hold events, none of which are left out."""
        self._events, self._kept, self._first, self._last = events, None, 0, len(events)

    def window(self, begin: float | int, end: float | int) -> WindowEvents:
        """Return the events from `begin` to before `end` (s since the start)."""
        events = self._read(*self._span(begin, end))
        t = (events.t - self.start) * 1e-6
        return WindowEvents(t, events.x.astype(np.int32), events.y.astype(np.int32))

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
        events = self._read(*self._span(begin, end))
        x, y, number = events.x, events.y, len(events)
        if number > max_events:
            some = np.arange(max_events) * (number - 1) // (max_events - 1)
            x, y = x[some], y[some]
        out = PixelCounts(*np.empty((3, len(x)), np.int32))
        pixels = _count_pixels(x, y, _counts(*self.shape), out)
        return PixelCounts(*(column[:pixels] for column in out)), number

    def count_in_cells(self, spans: CountedSpans, cell: int, counts: NDArray[np.int32]) -> None:
        """Add the events of spans to counts of cells.

        Events beyond the cells are counted at their edge.

        Args:
            spans: Spans of time and their maps.
            cell: Side of a cell, px, a power of 2.
            counts: (images, rows, columns) to which events are added.
        """
        us = self.start + np.rint(1e6 * spans.t).astype(np.int64)
        us = np.clip(us, self.start, self.stop)
        bits = cell.bit_length() - 1
        for row, part in self._batches():
            part = part if self._kept is None else self._read(row, row + len(part))
            limits = np.searchsorted(part.t, us)
            _add_to_cells(part.x, part.y, limits, spans, bits, counts)

    def quantile_times(self, number: int) -> NDArray[np.float64]:
        """Return times (number,) s of events that are equally many events apart."""
        share = (np.arange(number) + 0.5) / number
        rows = self._all[0] + (share * len(self)).astype(np.int64)
        us = [int(self.recording.events[row : row + 1].t[0]) for row in rows]
        return (np.array(us) - self.start) * 1e-6

    def _span(self, begin: float | int, end: float | int) -> tuple[int, int]:
        """Return the rows of a span (s), first and end."""
        us = [self.start + round(1e6 * t) for t in (begin, end)]
        first, last = (self._events.index(min(max(t, self.start), self.stop)) for t in us)
        return first, last

    def _read(self, first: int, last: int) -> Events:
        """Return the events of a range of rows, without those left out."""
        events = self._events[first:last]
        if self._kept is None:
            return events
        return events[self._kept[first - self._first : last - self._first]]

    def _batches(self) -> Iterator[tuple[int, Events]]:
        """Yield the first rows of batches, and their events, also those left out."""
        for row in range(self._first, self._last, EVENTS_PER_READ):
            yield row, self._events[row : min(row + EVENTS_PER_READ, self._last)]


@njit_noalloc
def _count_pixels(x: Any, y: Any, counts: Any, out: Any) -> int:
    """List the distinct pixels of events, and count the events of each.

    Args:
        x: (n,) columns, px.
        y: (n,) rows, px.
        counts: (height, width) zero before and after.
        out: `PixelCounts`, output, with room for n pixels.

    Returns:
        Number of pixels.
    """
    pixels = 0
    for i in range(len(x)):
        counts[y[i], x[i]] += 1
        if counts[y[i], x[i]] == 1:
            out.x[pixels], out.y[pixels] = x[i], y[i]
            pixels += 1
    for k in range(pixels):
        out.n[k] = counts[out.y[k], out.x[k]]
        counts[out.y[k], out.x[k]] = 0
    return pixels


@njit_noalloc_inlined
def cell_at(A: Any, x: Any, y: Any, bits: int, shape: Any) -> tuple[int, int]:
    """Return the cell to which a map takes a pixel, or the nearest one.

    Args:
        A: (2, 3) map from pixels to px in the cells.
        x: Column of the pixel, px.
        y: Row of the pixel, px.
        bits: Binary logarithm of a cell's side in px.
        shape: Rows and columns of cells.

    Returns:
        Row and column of the cell.
    """
    row = int(A[1, 0] * x + A[1, 1] * y + A[1, 2]) >> bits
    column = int(A[0, 0] * x + A[0, 1] * y + A[0, 2]) >> bits
    return min(max(row, 0), shape[0] - 1), min(max(column, 0), shape[1] - 1)


@njit_noalloc
def _add_to_cells(x: Any, y: Any, limits: Any, spans: Any, bits: int, counts: Any) -> None:
    """Count events of spans in the cells of their images.

    Args:
        x: (n,) columns, px.
        y: (n,) rows, px.
        limits: (spans, 2) first event of each span, and the one after its last.
        spans: `CountedSpans`.
        bits: Binary logarithm of a cell's side in px.
        counts: (images, rows, columns), added to.
    """
    for k in range(len(limits)):
        own, A = counts[spans.image[k]], spans.maps[k]
        for i in range(limits[k, 0], limits[k, 1]):
            own[cell_at(A, x[i], y[i], bits, own.shape)] += 1
