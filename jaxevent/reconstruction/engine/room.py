"""Memory into which kernels write images, used again once nobody holds them."""

import sys

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.engine.loop import Images

IMAGE_PIXELS = 1 << 22  # made in one pass, 9 bytes each
_SETS = 2  # the last images are held while the next ones are made


class ImageRoom:
    """Room for at most `times` images at once.

    Fresh memory costs as much as the images: the system clears each page when it is first written.
    """

    def __init__(self, pixels: int, dtype: np.dtype):
        self.times = max(1, IMAGE_PIXELS // pixels)
        self._pixels, self._dtype = pixels, dtype
        self._sets: list[tuple[NDArray, ...]] = []

    def take(self, times: int) -> Images:
        """Room for some images, which their holder alone reads from then on."""
        free = [arrays for arrays in self._sets if _references(arrays) == _ALONE]
        arrays: tuple[NDArray, ...]
        if free:
            arrays = free[0]
        else:
            kinds: tuple[np.dtype, ...] = self._dtype, self._dtype, np.dtype(np.uint8)
            arrays = tuple(np.empty((self.times, self._pixels), kind) for kind in kinds)
            self._sets = [*self._sets, arrays][-_SETS:]
        mean, variance, valid = (array[:times] for array in arrays)
        return Images(mean, variance, valid, np.empty((times, self._pixels, 0, 0), self._dtype))


def _references(arrays: tuple[NDArray, ...]) -> int:
    """How many references there are to the arrays; each part of one that somebody has is one."""
    return sum(sys.getrefcount(array) for array in arrays)


# To arrays that nobody else has. Versions of Python count their own references differently.
_ALONE = _references((np.empty(1), np.empty(1), np.empty(1)))
