"""Bands of rows: which there are, and how events are divided among them."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import compiled
from jaxevent.reconstruction.fused.timeline import NEVER
from jaxevent.recording import EventColumns

# Room for pixels of a band and its border. A dozen numbers each fill half a megabyte, of a
# second-level cache of one; each number begins a cache line further than a power of two. Where
# derivatives lie beside them the smaller bands are a tenth faster.
STRIDES = (8208, 16400, 32784, 65488)
SMALLER = (4112, *STRIDES)
LEAST_ROWS = 6  # the two rows of a border are read for nothing


@dataclasses.dataclass(frozen=True)
class BandLayout:
    """How a sensor's rows are divided; depends on nothing but its size."""

    stride: int
    edges: NDArray[np.int64]

    @classmethod
    def of(cls, width: int, height: int, smaller: bool = False) -> "BandLayout | None":
        """None for sensors too wide for a band."""
        rows, stride = 0, 0
        for stride in SMALLER if smaller else STRIDES:
            rows = stride // (width + 2) - 2
            if rows >= min(LEAST_ROWS, height):
                break
        if rows < min(3, height):  # a row borders on one other band at most
            return None
        number = -(-height // rows)
        return cls(stride, np.arange(number + 1) * height // number)

    def divide(
        self,
        stored: EventColumns,
        weight: NDArray,
        width: int,
        origin: int,
        room: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray, NDArray[np.int64]] | None:
        """Events band by band, in order of time, with their weights; where each band's begin.

        An event is one number: time, place in the band, polarity (`loop.Bands`). It is given to
        every band that it lies in or borders on. They are written into `room` if they fit. None:
        the events are not in order or not on the sensor.
        """
        counts = _count_bands(stored.y, self.edges)
        if counts[0] < 0:
            return None
        first = np.zeros(len(self.edges), np.int64)
        np.cumsum(counts, out=first[1:])
        total = int(first[-1])
        events = room if len(room) >= total else np.empty(total + total // 4, np.int64)
        weights = np.empty(total if len(weight) else 0, weight.dtype)
        good = _divide(
            stored.t, stored.x, stored.y, stored.p, weight, self.edges, width,
            origin - stored.offset, stored.previous, first, events, weights,
        )  # fmt: skip
        return (events, weights, first) if good else None


@compiled
def _count_bands(y, edges):
    """How many events each band gets; the first number is -1 for a row outside the image."""
    bands, height = len(edges) - 1, edges[-1]
    rows = np.zeros(65536 + 2, np.int64)
    for i in range(len(y)):
        rows[y[i] + 1] += 1
    counts = np.zeros(bands, np.int64)
    for band in range(bands):
        for row in range(edges[band], edges[band + 1] + 2):
            counts[band] += rows[row]
    for row in range(height + 1, len(rows)):
        if rows[row] > 0:
            counts[0] = -1
    return counts


@compiled
def _divide(t, x, y, p, weight, edges, width, origin, previous, cursor, events, weights):
    """Write each event to its band and to one that it borders on; whether all are valid."""
    bands, height, padded = len(edges) - 1, edges[-1], width + 2
    # Of each row its band and where it begins, and the same of a band above or below. Places are
    # unsigned, as others are tried for being negative.
    mine, beside = np.empty(height, np.uint64), np.full(height, bands, np.uint64)
    base, aside = np.empty(height, np.int64), np.zeros(height, np.int64)
    for band in range(bands):
        top, bottom = edges[band], edges[band + 1]
        for row in range(max(top - 1, 0), min(bottom + 1, height)):
            place = ((row - top + 1) * padded + 1) << 1
            if top <= row < bottom:
                mine[row], base[row] = band, place
            else:
                beside[row], aside[row] = band, place
    at, weighted, bad = cursor.astype(np.uint64), len(weight) > 0, False
    none, one = np.uint64(bands), np.uint64(1)
    for i in range(len(t)):
        row, column, up = y[i], np.int64(x[i]), np.int64(p[i])
        bad |= (t[i] < previous) | (column >= width) | (up > 1)
        previous = t[i]
        event = ((t[i] - origin) << 17) + (column << 1 | up)
        band = mine[row]
        events[at[band]] = event + base[row]
        if weighted:
            weights[at[band]] = weight[i]
        at[band] += one
        band = beside[row]
        if band != none:
            events[at[band]] = event + aside[row]
            if weighted:
                weights[at[band]] = weight[i]
            at[band] += one
    if len(t) > 0:
        bad |= (t[0] - origin < -NEVER) | (t[-1] - origin > NEVER)
    return not bad
