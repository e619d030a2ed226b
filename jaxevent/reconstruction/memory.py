"""Host memory for arrays that a device takes without a copy."""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_count_arrays = itertools.count()


def aligned(shape: tuple[int, ...], dtype: Any, empty: bool = False) -> NDArray:
    """An array of zeros (or anything) whose data start at a multiple of 64 bytes.

    XLA takes it without a copy.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # Large arrays all begin at the same place of a memory page. Written side by side they would
    # share one set of the cache; every array begins some lines further than the one before.
    stagger = 64 * (next(_count_arrays) * 5 % 64)
    memory = (np.empty if empty else np.zeros)(size + stagger + 64, np.uint8)
    begin = -memory.ctypes.data % 64 + stagger
    return memory[begin : begin + size].view(dtype).reshape(shape)


class TileMemory:
    """Memory for the fields of tiles, by name.

    With `reuse` a window's tiles are written over the last one's: fresh memory costs
    time. Without, it is fresh and cleared.
    """

    def __init__(self, reuse: bool, dtype: np.dtype):
        self.dtype = dtype  # of real numbers
        self._fields: dict[str, NDArray] | None = {} if reuse else None

    def field(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray:
        if self._fields is None:
            return aligned(shape, dtype)
        if name not in self._fields or self._fields[name].shape != shape:
            self._fields[name] = aligned(shape, dtype, empty=True)
        return self._fields[name]
