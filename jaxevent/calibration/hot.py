"""Hot pixels, recognised by events in every part of a recording."""

import numpy as np
from numpy.typing import NDArray

from jaxevent.events import is_hot

MIN_EVENTS = 3  # of a hot pixel in three quarters of the parts
RATIO = 3  # to the median pixel of the 5 x 5 around
MIN_PARTS = 4
MAX_EVENTS_SHARE = 0.05  # of all events, by hot pixels


def find_hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find hot pixels in counts of several parts of a recording.

    What moves passes a pixel in some parts and moves on. A hot pixel fires in all of them, more
    than most pixels around it, though a fifth of these may be hot too.

    Args:
        counts: (parts, height, width) events of each pixel in parts of similar length.

    Returns:
        (height, width), true for those, and for the lone ones that `jaxevent.events.is_hot` finds.
    """
    from scipy.ndimage import median_filter

    hot = is_hot(counts.sum(0))
    if len(counts) < MIN_PARTS:
        return hot
    steady = np.sort(counts, axis=0)[len(counts) // 4]
    return hot | (
        (steady >= MIN_EVENTS) & (steady > RATIO * (median_filter(steady, 5, mode="reflect") + 1))
    )
