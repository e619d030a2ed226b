"""Partition of recordings into parts to fit, to validate and to test."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SPLIT_NAMES = ("fit", "validation", "test")


def interleave(split: Sequence[int], count: int) -> NDArray[np.int64]:
    """Assign each of `count` images to one of SPLITS, with shares `split` in a fixed pattern.

    [2, 1, 1] repeats fit, validation, fit, test.

    Args:
        split: Shares of fit, validation and test.
        count: Number of images.

    Returns:
        (count,) index in SPLITS.
    """

    def spread(share: int, of: int) -> NDArray[np.bool_]:
        steps = np.ceil(np.arange(of + 1) * share / max(of, 1))
        return np.diff(steps) > 0

    pattern = np.zeros(sum(split), np.int64)
    others = np.flatnonzero(~spread(split[0], sum(split)))
    pattern[others] = np.where(spread(split[1], len(others)), 1, 2)
    return np.resize(pattern, count)


def windows(
    first: int, stop: int, window: float | int | None, split: Sequence[int] | None, place: int
) -> list[tuple[int, int, int]]:
    """Cut the time from `first` to `stop` into windows.

    Args:
        first: Start of the first window, us.
        stop: End of the last window, us.
        window: Length of a window, s; by default an eighth of the time if `split` is given, else
            all.
        split: Shares of fit, validation and test; None assigns all windows to `place`.
        place: Index in SPLITS of all windows without `split`.

    Returns:
        Start (us), end (us) and index in SPLITS of each window.
    """
    length = stop - first
    if window is not None:
        length = round(window * 1e6)
    elif split is not None:
        length = -(-length // 8)
    begins = np.arange(first, stop, max(length, 1))
    whose = np.full(len(begins), place) if split is None else interleave(split, len(begins))
    return [
        (b, min(b + length, stop), s) for b, s in zip(begins.tolist(), whose.tolist(), strict=True)
    ]
