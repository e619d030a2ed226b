"""Gaps in the times of events, in which events are missing that those around lead to expect."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MIN_GAP_US, MIN_GAP_STEPS = 1_000, 5  # steps of the stamps, which may be of ms
MAX_MISSED_EVENTS = 100  # expected in a gap: by chance none come with e^-100, in clusters e^-10
SIDE_US = 5_000  # before and after a gap, whose rates of events are those within it


class Gaps(NamedTuple):
    """Gaps in which events are missing, each (gaps,)."""

    begin: NDArray[np.int64]  # us, of the last event before
    end: NDArray[np.int64]  # us, of the first event after
    missed: NDArray[np.int64]  # events at the lesser rate of the two sides
    expected: NDArray[np.float64]  # events at the mean of the rates next to the gap


def find_gaps(t: NDArray[np.int64]) -> Gaps:
    """Find the gaps in the times of events (us), sorted, in which more are missing than by chance.

    The rate of a side is that over the length of the gap, to find it, and next to it, to fill it.
    """
    steps = np.diff(t)
    least = MIN_GAP_STEPS * np.median(steps[steps > 0]) if steps.any() else 0
    rows = np.flatnonzero(steps >= max(MIN_GAP_US, least))
    begin, end = t[rows], t[rows + 1]
    before = rows + 1 - np.searchsorted(t, 2 * begin - end)
    after = np.searchsorted(t, 2 * end - begin, side="right") - rows - 1
    missed = np.minimum(before, after)
    chosen = missed > MAX_MISSED_EVENTS
    rows, begin, end = rows[chosen], begin[chosen], end[chosen]
    low, high = np.maximum(begin - SIDE_US, t[:1]), np.minimum(end + SIDE_US, t[-1:])
    rates = (rows - np.searchsorted(t, low)) / np.maximum(begin - low, 1)
    rates += (np.searchsorted(t, high) - rows - 1) / np.maximum(high - end, 1)
    return Gaps(begin, end, missed[chosen], (end - begin) * rates / 2)
