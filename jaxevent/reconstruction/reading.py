"""Reading images from a window: where they lie among its events, pixel by pixel."""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc
from jaxevent.reconstruction.clock import Clock
from jaxevent.reconstruction.features import ImagePoints, ReadOut
from jaxevent.reconstruction.layout import SLOTS, SlotMap
from jaxevent.reconstruction.memory import aligned
from jaxevent.reconstruction.stream import BaseCounts, DeadTime, Stream, equivalent


@runtime_checkable
class ImageReader(Protocol):
    """Says where images at sorted times (us) inside a window lie among its events."""

    def __call__(self, times: NDArray[np.int64], growth: bool = False) -> ReadOut: ...


@runtime_checkable
class Basis(Protocol):
    """What is kept of a window to read images from it."""

    @property
    def events(self) -> int: ...

    def reader(self, room: int) -> ImageReader: ...


@dataclasses.dataclass(frozen=True)
class ReadingBasis:
    """What a `Reader` needs to know of a window."""

    stream: Stream  # its events and, where changes are spread, those soon after
    events: int  # how many are its own
    clock: Clock
    first_frame: int  # of those that it uses
    last: NDArray[np.int64]  # us, of each pixel's last event before the window
    counts: BaseCounts
    slot_map: SlotMap
    rho: float  # us, the dead time
    reach: int  # us, the longest time over which a change is spread
    dtype: np.dtype  # of the results

    def reader(self, room: int) -> "Reader":
        """Reads images, at most `room` at a time."""
        return Reader(self, room)


class PixelStates(NamedTuple):
    """Each pixel at the time that a reader has come to."""

    count: NDArray  # [2, pixels], ON and OFF events
    last: NDArray[np.int64]  # us, of the last event
    slot: NDArray[np.int32]  # of the last event in the window, -1 if none
    rank: NDArray[np.int32]  # of the next event


class ImageRows(NamedTuple):
    """Arrays [times, pixels] of a `ReadOut`."""

    slot: NDArray[np.int32]
    on: NDArray
    off: NDArray
    since: NDArray


class Placed(NamedTuple):
    """Times of images among the frames of a window, of which the first is 0."""

    piece: NDArray[np.int64]
    frame: NDArray[np.int64]  # before
    exposure: NDArray[np.int64]  # whose left edge the piece counts from; -1: the window's start
    weight: NDArray
    blend: NDArray
    elapsed: NDArray

    @classmethod
    def of(cls, clock: Clock, first_frame: int, times: NDArray[np.int64]) -> "Placed":
        piece, frame, weight, blend = clock.locate((times - clock.origin).astype(float))
        return cls(
            piece - clock.first_piece(first_frame),
            frame - first_frame,
            np.maximum(clock.frame(piece) - first_frame, -1),
            weight,
            blend,
            clock.elapsed(times - clock.origin, frame),
        )

    def points(self, room: int, dtype: np.dtype, on: Any, off: Any) -> ImagePoints:
        """The points of images with these counts, padded to the room."""
        weight, blend, elapsed = (
            padded(v, room, dtype) for v in (self.weight, self.blend, self.elapsed)
        )
        piece, frame = (padded(v, room, np.int32) for v in (self.piece, self.frame))
        return ImagePoints(weight[:, None], blend[:, None], on, off, piece, frame, elapsed)


def padded(values: NDArray, room: int, dtype: Any) -> NDArray:
    """Values with zeros behind them, (room,)."""
    out = np.zeros(room, dtype)
    out[: len(values)] = values
    return out


class Reader:
    """Walks through a window's events in time and says where images to be read lie among them.

    Read-outs have room for `room` images.
    """

    def __init__(self, basis: ReadingBasis, room: int):
        self._basis, self._room = basis, room
        shape = room, basis.counts.start.shape[1]
        self._buffers = [
            ImageRows(aligned(shape, np.int32), *(aligned(shape, basis.dtype) for _ in range(3)))
            for _ in range(2)
        ]
        self._rewind()

    def _rewind(self) -> None:
        basis, pixels = self._basis, self._basis.counts.start.shape[1]
        self._row, self._time = 0, np.iinfo(np.int64).min
        self._states = PixelStates(
            basis.counts.start.copy(),
            basis.last.copy(),
            np.full(pixels, -1, np.int32),
            np.zeros(pixels, np.int32),
        )

    def __call__(self, times: NDArray[np.int64], growth: bool = False) -> ReadOut:
        """Images at sorted times (us) inside the window, padded to the room.

        With `growth` counts are derivatives with respect to the dead time. The arrays are
        overwritten by the call after the next.
        """
        basis, clock = self._basis, self._basis.clock
        if len(times) and times[0] < self._time:
            self._rewind()
        self._buffers.reverse()
        out = self._buffers[0]
        at = Placed.of(clock, basis.first_frame, times)
        self._row = _read(
            basis.stream, basis.events, self._row, times, at.exposure, basis.counts,
            basis.slot_map, self._states, DeadTime(basis.rho, growth), basis.reach,
            clock.origin, np.empty(len(self._states.last), np.int64), out,
        )  # fmt: skip
        self._time = times[-1] if len(times) else self._time
        points = at.points(self._room, basis.dtype, out.on, out.off)
        return ReadOut(points, out.slot, out.since)


@njit_noalloc
def _read(stream, own, row, times, frame, counts, slot_map, states, dead, reach, origin, seen, out):
    """At each time, every pixel's last slot, the time since, and its counts in the piece.

    Begins with the event `row` of the window's `own` and returns the next one.
    """
    # Arrays get names of their own: reading them from tuples in the loops takes far longer.
    t, x, y, p, width = stream.t, stream.x, stream.y, stream.p, stream.width
    count, last, at, rank_of = states.count, states.last, states.slot, states.rank
    kind, lane_of, shapes = slot_map.kind, slot_map.lane, slot_map.shapes
    round_tile, round_first = slot_map.round_tile, slot_map.round_first
    slot, since, on, off = out.slot, out.since, out.on, out.off
    for pixel in range(len(last)):
        seen[pixel] = -1
    for j in range(len(times)):
        while row < own and t[row] <= times[j]:
            pixel = np.int64(y[row]) * width + x[row]
            count[0 if p[row] else 1, pixel] += equivalent(t[row] - last[pixel], dead)
            last[pixel] = t[row]
            if slot_map.known:
                k, lane, rank = kind[pixel], lane_of[pixel], rank_of[pixel]
                ranks, lanes = shapes[k, 0], shapes[k, 1]
                rank_of[pixel] = rank + 1
                tile = round_tile[round_first[k] + rank // ranks] + lane // lanes
                at[pixel] = tile * SLOTS + rank % ranks * lanes + lane % lanes
            row += 1
        base = counts.left[frame[j]] if frame[j] >= 0 else counts.start
        for pixel in range(len(last)):
            slot[j, pixel] = at[pixel]
            since[j, pixel] = max(times[j] - last[pixel], 0) * 1e-6
            on[j, pixel] = count[0, pixel] - base[0, pixel]
            off[j, pixel] = count[1, pixel] - base[1, pixel]
        after = row
        while after < len(t) and t[after] <= times[j] + reach:
            pixel = np.int64(y[after]) * width + x[after]
            gap = t[after] - last[pixel]
            if seen[pixel] != j and last[pixel] > origin and 0 < gap <= reach:
                part = equivalent(gap, dead) * (times[j] - last[pixel]) / gap
                if p[after]:
                    on[j, pixel] += part
                else:
                    off[j, pixel] += part
            seen[pixel] = j
            after += 1
    return row
