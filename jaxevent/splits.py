"""How recordings are shared out to fit, to validate and to test."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SPLITS = ("fit", "validation", "test")


def interleave(split: Sequence[int], count: int) -> NDArray[np.int64]:
    """Which of SPLITS each of `count` images is for: shares `split`, in a fixed pattern.

    [2, 1, 1] repeats fit, validation, fit, test.
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
    """Start, end (us) and place in SPLITS of the windows from `first` to `stop`.

    They last `window` seconds, by default an eighth of it if a recording is `split`, else all of
    it, for `place`.
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
