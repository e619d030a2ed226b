"""Bands of rows: which there are, and how events are divided among them."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import compiled

# Room for pixels of a band and its border. A dozen numbers each fill half a megabyte, of a
# second-level cache of one; each number begins a cache line further than a power of two.
STRIDES = (8208, 16400, 32784, 65488)
LEAST_ROWS = 6  # the two rows of a border are read for nothing


@dataclasses.dataclass(frozen=True)
class BandLayout:
    """How a sensor's rows are divided; depends on nothing but its size."""

    stride: int
    edges: NDArray[np.int64]

    @classmethod
    def of(cls, width: int, height: int) -> "BandLayout | None":
        """None for sensors too wide for a band."""
        rows, stride = 0, 0
        for stride in STRIDES:
            rows = stride // (width + 2) - 2
            if rows >= min(LEAST_ROWS, height):
                break
        if rows < 1:
            return None
        number = -(-height // rows)
        return cls(stride, np.arange(number + 1) * height // number)

    def divide(
        self,
        t: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.bool_],
        weight: NDArray,
        width: int,
        origin: int,
    ) -> tuple[NDArray[np.int64], NDArray, NDArray[np.int64]]:
        """Events band by band, in order of time, with their weights; where each band's begin.

        An event is one number: time, place in the band, polarity (`loop.Bands`). It is given to
        every band that it lies in or borders on.
        """
        first = np.zeros(len(self.edges), np.int64)
        np.cumsum(_count_bands(y, self.edges), out=first[1:])
        events, weights = np.empty(first[-1], np.int64), np.empty(0, weight.dtype)
        if len(weight):
            weights = np.empty(first[-1], weight.dtype)
        cursor = first[:-1].copy()
        _divide(t, x, y, p, weight, self.edges, width + 2, origin, cursor, events, weights)
        return events, weights, first


@compiled
def _count_bands(y, edges):
    bands, height = len(edges) - 1, edges[-1]
    rows = np.zeros(height + 2, np.int64)
    for i in range(len(y)):
        rows[y[i] + 1] += 1
    counts = np.zeros(bands, np.int64)
    for band in range(bands):
        counts[band] = rows[edges[band] : edges[band + 1] + 2].sum()
    return counts


@compiled
def _divide(t, x, y, p, weight, edges, padded, origin, cursor, events, weights):
    bands, height = len(edges) - 1, edges[-1]
    # Of each row: its band, and the bands above and below that it borders on; else -1.
    member, base = np.full((3, height), -1), np.zeros((3, height), np.int64)
    for band in range(bands):
        top, bottom = edges[band], edges[band + 1]
        for row in range(max(top - 1, 0), min(bottom + 1, height)):
            place = 1 if row < top else 2 if row >= bottom else 0
            member[place, row] = band
            base[place, row] = (row - top + 1) * padded + 1
    inner = member[1] + member[2] == -2
    weighted = len(weight) > 0
    for i in range(len(t)):
        row = np.int64(y[i])
        now = (t[i] - origin) << 17
        low = np.int64(x[i]) << 1 | (1 if p[i] else 0)
        for place in range(1 if inner[row] else 3):
            band = member[place, row]
            if band >= 0:
                at = cursor[band]
                cursor[band] = at + 1
                events[at] = now | ((base[place, row] << 1) + low)
                if weighted:
                    weights[at] = weight[i]
