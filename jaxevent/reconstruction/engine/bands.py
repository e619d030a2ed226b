"""Bands of rows: which there are, and how events are divided among them."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc
from jaxevent.reconstruction.engine.timeline import NEVER
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
        origin, height = origin - stored.offset, int(self.edges[-1])
        if len(stored.t) and (stored.t[0] < origin - NEVER or stored.t[-1] > origin + NEVER):
            return None
        counts = np.zeros(1 << 16, np.int64)
        _count_rows(stored.y, counts)
        if counts[height:].any():
            return None
        before = np.concatenate([[0], np.cumsum(counts[:height])])
        low, high = np.maximum(self.edges[:-1] - 1, 0), np.minimum(self.edges[1:] + 1, height)
        first = np.concatenate([[0], np.cumsum(before[high] - before[low])])
        total = int(first[-1])
        events = room if len(room) >= total else np.empty(total + total // 4, np.int64)
        weights = np.empty(total if len(weight) else 0, weight.dtype)
        good = _divide(
            stored.t, stored.x, stored.y, stored.p, weight, self._rows(width), width, origin,
            stored.previous, first.astype(np.uint64), events, weights,
        )  # fmt: skip
        return (events, weights, first) if good else None

    def _rows(self, width: int) -> "_Rows":
        bands, height, padded = len(self.edges) - 1, int(self.edges[-1]), width + 2
        rows = np.arange(height)
        mine = np.searchsorted(self.edges, rows, "right") - 1
        above, below = rows == self.edges[mine], rows + 1 == self.edges[mine + 1]
        beside = np.where(above & (mine > 0), mine - 1, np.where(below, mine + 1, bands))

        def place(band: NDArray) -> NDArray[np.int64]:
            return ((rows - self.edges[np.minimum(band, bands)] + 1) * padded + 1) << 1

        of = (mine.astype(np.uint64), beside.astype(np.uint64))
        return _Rows(of[0], place(mine), of[1], place(beside))


class _Rows(NamedTuple):
    """Of each row its band and where it begins there, and the same of a band above or below.

    Bands are unsigned, as other places are tried for being negative; one too many is none.
    """

    mine: NDArray[np.uint64]
    base: NDArray[np.int64]
    beside: NDArray[np.uint64]
    aside: NDArray[np.int64]


@njit_noalloc
def _count_rows(y, counts):
    for i in range(len(y)):
        counts[y[i]] += 1


@njit_noalloc
def _divide(t, x, y, p, weight, rows, width, origin, previous, at, events, weights):
    """Write each event to its band and to one that it borders on; whether all are valid.

    `at` are the places where each band's events begin, and one more.
    """
    mine, base, beside, aside = rows
    weighted, bad = len(weight) > 0, False
    none, one = np.uint64(len(at) - 1), np.uint64(1)
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
    return not bad
