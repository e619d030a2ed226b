"""Hot pixels, which fire in every part of a recording, and dead ones, which never do."""

import numpy as np
from numpy.typing import NDArray

from jaxevent.events import is_hot

MIN_EVENTS = 2  # of a hot pixel in each of three quarters of the parts
RATIO = 3  # to the median pixel of the 5 x 5 around
MIN_PARTS = 4
MAX_EVENTS_SHARE = 0.05  # of all events, by hot pixels
MAX_DEAD_SHARE = 0.05  # of the pixels between busy ones
MIN_BETWEEN = 100  # pixels between busy ones, of which a share is known
MIN_SYNCHRONY = 0.3  # correlation of busy pixels; hot ones have 0.0, those that see edges 0.5 to 1
MIN_BUSY_EVENTS = 8  # of pixels on both sides of another: by chance it has none with e^-8


def find_hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find hot pixels in counts of several parts of a recording.

    What moves passes a pixel in some parts and moves on. A hot pixel fires in all of them. In the
    quietest three quarters of its parts together it has more events than most pixels around it have
    in theirs, though a fifth of these may be hot too. Where many pixels are dead, those that fire
    are compared with each other.

    Args:
        counts: (parts, height, width) events of each pixel in parts of similar length.

    Returns:
        (height, width), true for those, and for the lone ones that `jaxevent.events.is_hot` finds.
    """
    total = counts.sum(0)
    hot, counted = is_hot(total), np.ones(total.shape, bool)
    if len(counts) < MIN_PARTS:
        return hot
    if measure_dead_share(counts, hot) > MAX_DEAD_SHARE:
        hot, counted = np.zeros(total.shape, bool), total > 0
    quietest_first = np.sort(counts, axis=0)
    steady = quietest_first[len(counts) // 4] >= MIN_EVENTS
    events = quietest_first[: 3 * len(counts) // 4].sum(0)
    return hot | (steady & _exceeds_median(events, counted))


def _exceeds_median(counts: NDArray[np.integer], counted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Compare pixels with `RATIO` times the median of the 5 x 5 around, and one event.

    Args:
        counts: (height, width) events.
        counted: (height, width) pixels that take part in the median.

    Returns:
        (height, width), true for pixels with more events.
    """
    height, width = counts.shape
    limit = np.pad(RATIO * (counts + 1), 2, mode="symmetric")
    counted = np.pad(counted, 2, mode="symmetric")
    # More than half of the pixels around have a limit below the pixel's count.
    majority = np.zeros(counts.shape, np.int8)
    for y in range(5):
        for x in range(5):
            around = slice(y, y + height), slice(x, x + width)
            majority += counted[around] * np.where(limit[around] < counts, 1, -1).astype(np.int8)
    return majority > 0


def measure_dead_share(counts: NDArray[np.integer], hot: NDArray[np.bool_]) -> float:
    """Measure the share of pixels without an event, of those between busy ones.

    What is at rest leaves regions without events. A pixel at their edge has silent neighbours on
    one side at least, so it is not between busy ones. Hot pixels in such a region fire
    independently of each other. The neighbours of a dead pixel see the same edges: their counts in
    parts of the recording correlate.

    Args:
        counts: (parts, height, width) events of each pixel in parts of similar length.
        hot: (height, width) pixels that do not count, neither as busy nor as dead ones.

    Returns:
        Share of the pixels between two opposite neighbours of `MIN_BUSY_EVENTS` each; 0 if these
        are few, or do not correlate.
    """
    height, width = hot.shape
    total = counts.sum(0)
    busy = np.pad((total >= MIN_BUSY_EVENTS) & ~hot, 1)
    parts = np.pad(counts, ((0, 0), (1, 1), (1, 1)))
    between = np.zeros(hot.shape, bool)
    products = np.zeros(3)  # of deviations of one and the other side: both, and each with itself
    for y, x in ((0, 1), (1, 0), (1, 1), (1, -1)):
        sides = [
            (slice(1 + sign * y, 1 + sign * y + height), slice(1 + sign * x, 1 + sign * x + width))
            for sign in (1, -1)
        ]
        pair = busy[sides[0]] & busy[sides[1]] & ~hot
        between |= pair
        one, other = (
            parts[:, rows, columns][:, pair & (total == 0)].astype(float) for rows, columns in sides
        )
        course = (one + other).sum(1) / max((one + other).sum(), 1)
        one, other = (side - course[:, None] * side.sum(0) for side in (one, other))
        products += (one * other).sum(), (one**2).sum(), (other**2).sum()
    is_known = len(counts) >= MIN_PARTS and between.sum() >= MIN_BETWEEN
    if not is_known or products[0] <= MIN_SYNCHRONY * np.sqrt(products[1] * products[2]):
        return 0.0
    return int((between & (total == 0)).sum()) / int(between.sum())
