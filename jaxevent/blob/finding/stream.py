"""The events that the search for targets looks at, window by window."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.paths import NOBODY, Path, candidates, join
from jaxevent.kernels import compiled
from jaxevent.recording import Recording

BATCH = 1 << 20  # events read at a time


class Part(NamedTuple):
    """Consecutive events: t in s since the stream's start, x and y in px."""

    t: NDArray[np.float64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.t)


class Stream:
    """Events of a recording from `start` to before `stop` (us), without those that are left out.

    Left out are `hot` pixels, once they are known, and what is near the paths given to `without`.
    Events are read where they are needed; `without` takes a byte for each.
    """

    def __init__(self, recording: Recording, start: int, stop: int):
        self.recording, self.start, self.stop = recording, start, stop
        self.width, self.height = recording.width, recording.height
        self.hot = np.zeros((recording.height, recording.width), bool)
        self._first, self._last = (recording.events.index(t) for t in (start, stop))
        self._kept: NDArray[np.bool_] | None = None  # of all these rows

    @property
    def duration(self) -> float:
        """s."""
        return (self.stop - self.start) * 1e-6

    def __len__(self) -> int:
        """Events in all, those left out included."""
        return self._last - self._first

    def without(self, paths: Sequence[Path], sigmas: float | int) -> "Stream":
        """The same without events within `sigmas` standard deviations of some paths."""
        stream = Stream(self.recording, self.start, self.stop)
        first, last = self._first, self._last
        kept = np.ones(len(self), bool) if self._kept is None else self._kept.copy()
        joined = join(paths)
        for row in range(first, last, BATCH):
            events = self.recording.events[row : min(row + BATCH, last)]
            near = candidates(events, joined, sigmas) != NOBODY
            kept[row - first : row - first + len(near)] &= ~near
        stream.hot, stream._kept = self.hot, kept
        return stream

    def window(self, begin: float | int, end: float | int) -> Part:
        """The events of begin <= t < end (s since the start)."""
        us = [self.start + round(1e6 * t) for t in (begin, end)]
        first, last = (self.recording.events.index(min(t, self.stop)) for t in us)
        return self._rows(first, last)

    def batches(self) -> Iterator[Part]:
        """All events, one batch after another."""
        for row in range(self._first, self._last, BATCH):
            yield self._rows(row, min(row + BATCH, self._last))

    def times(self, number: int) -> NDArray[np.float64]:
        """Times (s) of some events that are equally many events apart."""
        share = (np.arange(number) + 0.5) / number
        rows = self._first + (share * len(self)).astype(np.int64)
        us = [int(self.recording.events[row : row + 1].t[0]) for row in rows]
        return (np.array(us) - self.start) * 1e-6

    def _rows(self, first: int, last: int) -> Part:
        events = self.recording.events[first:last]
        kept = None if self._kept is None else self._kept[first - self._first : last - self._first]
        return Part(*_keep(events.t, events.x, events.y, self.start, self.hot, kept))


@compiled
def _keep(t: Any, x: Any, y: Any, start: int, hot: Any, kept: Any) -> Any:
    """Times (s), x and y of the events that are not left out."""
    out_t, out_x, out_y = np.empty(len(t)), np.empty(len(t), np.int64), np.empty(len(t), np.int64)
    n = 0
    for i in range(len(t)):
        if (kept is None or kept[i]) and not hot[y[i], x[i]]:
            out_t[n], out_x[n], out_y[n] = (t[i] - start) * 1e-6, x[i], y[i]
            n += 1
    return out_t[:n], out_x[:n], out_y[:n]
