"""Reading images from a window: where they lie among its events, pixel by pixel."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import compiled
from jaxevent.reconstruction.clock import Clock
from jaxevent.reconstruction.features import ImagePoints, ReadOut
from jaxevent.reconstruction.layout import SLOTS, SlotMap
from jaxevent.reconstruction.memory import aligned
from jaxevent.reconstruction.stream import BaseCounts, DeadTime, Stream, equivalent


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
        piece, frame, weight, blend = clock.locate((times - clock.origin).astype(float))
        self._row = _read(
            basis.stream, basis.events, self._row, times, clock.frame(piece) - basis.first_frame,
            basis.counts, basis.slot_map, self._states, DeadTime(basis.rho, growth), basis.reach,
            clock.origin, out,
        )  # fmt: skip
        self._time = times[-1] if len(times) else self._time

        def row(values: NDArray, kind: Any, first: int = 0) -> NDArray:
            padded = np.zeros(self._room, kind)
            padded[: len(times)] = values - first
            return padded

        points = ImagePoints(
            row(weight, basis.dtype)[:, None],
            row(blend, basis.dtype)[:, None],
            out.on,
            out.off,
            row(piece, np.int32, clock.first_piece(basis.first_frame)),
            row(frame, np.int32, basis.first_frame),
            row(clock.elapsed(times - clock.origin, frame), basis.dtype),
        )
        return ReadOut(points, out.slot, out.since)


@compiled
def _read(stream, own, row, times, frame, counts, slot_map, states, dead, reach, origin, out):
    """At each time, every pixel's last slot, the time since, and its counts in the piece.

    Begins with the event `row` of the window's `own` and returns the next one.
    """
    # Arrays get names of their own: reading them from tuples in the loops takes far longer.
    t, x, y, p, width = stream.t, stream.x, stream.y, stream.p, stream.width
    count, last, at, rank_of = states.count, states.last, states.slot, states.rank
    kind, lane_of, shapes = slot_map.kind, slot_map.lane, slot_map.shapes
    round_tile, round_first = slot_map.round_tile, slot_map.round_first
    slot, since, on, off = out.slot, out.since, out.on, out.off
    seen = np.full(len(last), -1)
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
