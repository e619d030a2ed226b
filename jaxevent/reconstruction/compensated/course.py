"""A clock that goes as fast as the scene moves.

Where the camera speeds up, slows down or stops, all points do so together. Trajectories that are
parabolas of time miss that over a few frames; as many events come as things move, so parabolas of
the number of events do not. Where things move on their own, each has a course of its own, and the
clock is time. Which of both it is, parts of the image tell: as far as the rate of events in one
follows from the rate in all others, their course is common.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Recording

MOST = 0.9  # of the clock is told by events: time never stands still
PROBES = 8  # stretches of a recording in which parts of the image are compared
INTERVALS = 4  # of frames, the length of a stretch
PARTS, BINS = 4, 16  # of the image along each axis, and of a stretch
KNOWN = 4096  # times of which the number of events before is remembered
LEAST = 0.05  # changes of the rate, as a part of it, that do not matter


@dataclasses.dataclass(frozen=True)
class Course:
    """The clock of a recording; on the whole it goes as fast as time."""

    index: Callable[[int], int]  # the number of events before a time (us)
    origin: int  # us
    apart: float  # us, events of the whole recording
    share: float  # of the clock that events tell, 0..1; the rest is time

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """What it shows at times (us), in us."""
        past = np.asarray(times - self.origin, float)
        if not self.share:
            return past
        counts = np.array([self.index(t) for t in times.tolist()], float)
        return (1 - self.share) * past + self.share * self.apart * counts

    def rate(self, begin: int, end: int) -> float:
        """Events between two times (us), as part of what comes in as long on the mean."""
        if not (self.apart and end > begin):
            return 1.0
        return (self.index(end) - self.index(begin)) * self.apart / (end - begin)


TIME = Course(lambda _: 0, 0, 0.0, 0.0)


def course_of(recording: Recording, span: tuple[int, int], interval: int) -> Course:
    """The course of a recording whose frames are `interval` us apart."""
    first, last = span
    length = min(INTERVALS * interval, last - first)
    begins = np.linspace(first, last - length, PROBES).astype(np.int64)
    stretches = [_count(recording, int(begin), length) for begin in np.unique(begins)]
    number = max(len(recording.events), 1)
    apart = (recording.stop - recording.start) / number
    # Targets share instants, and formats that are decoded are slow to search.
    index = functools.lru_cache(KNOWN)(recording.events.index)
    return Course(index, first, apart, common_part(np.stack(stretches)))


def common_part(counts: NDArray[np.floating]) -> float:
    """How far parts of the image share the course of all others, 0 to `MOST`.

    `counts` are those of events, (stretches, parts, bins). The slope of a regression: of what a
    part's rate differs by from even, on what that of all other parts does.
    """
    total = counts.sum((1, 2), keepdims=True)
    own, rest = counts.sum(2, keepdims=True), counts.sum(1, keepdims=True) - counts
    bins = counts.shape[2]
    here = counts / np.maximum(own, 1) * bins - 1
    there = rest / np.maximum(total - own, 1) * bins - 1
    slope = (own * here * there).sum() / max((own * (there**2 + LEAST**2)).sum(), 1e-12)
    return float(min(max(slope, 0.0), MOST))


def _count(recording: Recording, begin: int, length: int) -> NDArray[np.floating]:
    """Events of a stretch, (parts, bins)."""
    source = recording.events
    events = source[source.index(begin) : source.index(begin + length)]
    row = events.y.astype(np.int64) * PARTS // recording.height
    column = events.x.astype(np.int64) * PARTS // recording.width
    at = (events.t - begin) * BINS // max(length, 1)
    place = (row * PARTS + column) * BINS + at
    return np.bincount(place, minlength=PARTS**2 * BINS).reshape(PARTS**2, BINS).astype(float)
