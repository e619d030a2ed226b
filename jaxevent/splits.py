"""Partition of recordings into parts to fit, to validate and to test."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SPLIT_NAMES = ("fit", "validation", "test")


def interleave(shares: Sequence[int], n_images: int) -> NDArray[np.int64]:
    """Assign each of `n_images` images to one of SPLITS, with shares `shares` in a fixed pattern.

    [2, 1, 1] repeats fit, validation, fit, test.

    Args:
        shares: Shares of fit, validation and test.
        n_images: Number of images.

    Returns:
        (count,) index in SPLITS.
    """

    def spread(share: int, of: int) -> NDArray[np.bool_]:
        steps = np.ceil(np.arange(of + 1) * share / max(of, 1))
        return np.diff(steps) > 0

    pattern = np.zeros(sum(shares), np.int64)
    others = np.flatnonzero(~spread(shares[0], sum(shares)))
    pattern[others] = np.where(spread(shares[1], len(others)), 1, 2)
    return np.resize(pattern, n_images)


def windows(
    start_us: int,
    stop_us: int,
    window_s: float | int | None,
    shares: Sequence[int] | None,
    unsplit_index: int,
) -> list[tuple[int, int, int]]:
    """Cut the time from `start_us` to `stop_us` into windows.

    Args:
        start_us: Start of the first window, us.
        stop_us: End of the last window, us.
        window_s: Length of a window, s; by default an eighth of the time if `shares` is given, else
            all.
        shares: Shares of fit, validation and test; None assigns all windows to `unsplit_index`.
        unsplit_index: Index in SPLITS of all windows without `shares`.

    Returns:
        Start (us), end (us) and index in SPLITS of each window.
    """
    length = stop_us - start_us
    if window_s is not None:
        length = round(window_s * 1e6)
    elif shares is not None:
        length = -(-length // 8)
    begins = np.arange(start_us, stop_us, max(length, 1))
    whose = (
        np.full(len(begins), unsplit_index) if shares is None else interleave(shares, len(begins))
    )
    return [
        (b, min(b + length, stop_us), s)
        for b, s in zip(begins.tolist(), whose.tolist(), strict=True)
    ]
