"""Where the events of a window lie: tiles of 32768 slots, [ranks, lanes].

A lane is a pixel, a rank the number of the event at that pixel. There are three kinds of tile, wide
ones for pixels with few events and narrow ones for pixels with many; within a kind the busiest
pixels come first, so that a round of ranks needs only the first blocks of lanes. Tiles run in
order. How many are used is data, how many there is room for comes from a fixed ladder, so another
window or recording of the same sensor compiles nothing.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit

SHAPES = ((8, 4096), (64, 512), (512, 64))  # ranks, lanes of the three kinds of tile
SLOTS = 8 * 4096
LANES = 64  # of the narrowest tile; on several devices each has a part of every so many lanes
THRESHOLDS = (128, 1024)  # events at a pixel from which the next, narrower kind serves it


class SlotMap(NamedTuple):
    """The arrays of a layout, for loops over events: the slot of a pixel's event of any rank."""

    known: bool  # whether there is a layout
    kind: NDArray[np.int8]
    lane: NDArray[np.int32]
    round_tile: NDArray[np.int32]
    round_first: NDArray[np.int64]
    shapes: NDArray[np.int64]

    @classmethod
    def none(cls, pixels: int) -> "SlotMap":
        """Where there are no tiles."""
        zeros, kinds = np.zeros(pixels, np.int32), len(SHAPES)
        return cls(
            False,
            zeros.astype(np.int8),
            zeros,
            np.zeros(kinds, np.int32),
            np.zeros(kinds, np.int64),
            np.array(SHAPES),
        )


@dataclasses.dataclass(frozen=True)
class Layout:
    """Which tile, rank and lane each event of a window takes."""

    kind: NDArray[np.int8]  # per pixel: its place in SHAPES
    lane: NDArray[np.int32]  # per pixel, within its kind
    lanes: list[NDArray[np.int32]]  # per kind: pixels, busiest first
    counts: NDArray[np.int32]  # events per pixel
    round_tile: NDArray[np.int32]  # per kind and round of ranks: the first tile
    round_first: NDArray[np.int64]  # per kind: where its rounds start in round_tile
    room: int  # tiles, from the ladder
    ordinary: bool  # whether the first rung sufficed

    @classmethod
    def of(cls, counts: NDArray[np.int32], events: int) -> "Layout":
        """Lay out a window; room is for `events` of ordinary skew, doubled until it suffices."""
        pixels = len(counts)
        order = _busiest_first(counts)
        ends = [int(np.searchsorted(-counts[order], -limit, "right")) for limit in THRESHOLDS]
        bounds = [pixels, *ends, 0]  # wide tiles serve the tail of the order, narrow its head
        kind, lane = np.zeros(pixels, np.int8), np.zeros(pixels, np.int32)
        lanes, rounds, tiles = [], [], 0
        for k, (ranks, width) in enumerate(SHAPES):
            mine = order[bounds[k + 1] : bounds[k]]
            kind[mine] = k
            lane[mine] = np.arange(len(mine))
            lanes.append(mine)
            busy = counts[mine]
            reach = -(-int(busy[0]) // ranks) if len(mine) else 0
            active = np.searchsorted(-busy, -ranks * np.arange(reach), "left")
            first = tiles + np.concatenate([[0], np.cumsum(-(-active // width))])
            rounds.append(first[:-1].astype(np.int32))
            tiles = int(first[-1])
        # Full tiles, one partly used block of lanes per round, one partly used rank per block.
        spare = 32 if events > SLOTS else 8
        room = events // SLOTS + -(-pixels // SHAPES[0][1]) + spare
        ordinary = tiles <= room
        while room < tiles:
            room *= 2
        starts = np.cumsum([0] + [len(r) for r in rounds[:-1]])
        first_tile = np.concatenate([*rounds, np.zeros(1, np.int32)])  # never empty
        return cls(kind, lane, lanes, counts, first_tile, starts, room, ordinary)

    def lane_begins(self) -> list[int]:
        """Where the lanes of each kind begin among those of all kinds, and where they end."""
        sizes = [-(-len(self.counts) // width) * width for _, width in SHAPES]
        return [sum(sizes[:k]) for k in range(len(SHAPES) + 1)]

    def lane_pixels(self) -> NDArray[np.int32]:
        """The pixels of the lanes of all kinds."""
        *begins, end = self.lane_begins()
        # Room at the end, so that as many lanes as the widest tile has can be cut out anywhere.
        out = np.zeros(end + SHAPES[0][1], np.int32)
        for begin, mine in zip(begins, self.lanes, strict=True):
            out[begin : begin + len(mine)] = mine
        return out

    def tiles(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The kind and the first lane of every tile; kind 3, with room, of those not used."""
        kinds, lanes = np.full(self.room, len(SHAPES), np.int32), np.zeros(self.room, np.int32)
        begins = self.lane_begins()
        for k, (ranks, width) in enumerate(SHAPES):
            busy, first = self.counts[self.lanes[k]], self.round_first[k]
            for turn in range(-(-int(busy[0]) // ranks) if len(busy) else 0):
                blocks = np.arange(-(-int((busy > turn * ranks).sum()) // width))
                tile = self.round_tile[first + turn] + blocks
                kinds[tile], lanes[tile] = k, begins[k] + blocks * width
        return kinds, lanes

    def slots(self) -> NDArray[np.int32]:
        """The slot of each pixel's last event, -1 if it has none."""
        ranks, width = np.array(SHAPES)[self.kind].T
        rank = np.maximum(self.counts - 1, 0)
        busy = self.counts > 0
        rounds = np.where(busy, self.round_first[self.kind] + rank // ranks, 0)
        tile = self.round_tile[rounds] + self.lane // width
        slot = tile * SLOTS + rank % ranks * width + self.lane % width
        return np.where(busy, slot, -1).astype(np.int32)

    def slot_map(self) -> SlotMap:
        """Its arrays, for loops over events."""
        return SlotMap(
            True, self.kind, self.lane, self.round_tile, self.round_first, np.array(SHAPES)
        )


@njit
def _busiest_first(counts):
    """Pixels by falling count, equal counts in pixel order: a counting sort."""
    top = counts.max() if len(counts) else 0
    at = np.zeros(top + 2, np.int64)
    for c in counts:
        at[top - c + 1] += 1
    for c in range(top + 1):
        at[c + 1] += at[c]
    order = np.empty(len(counts), np.int32)
    for pixel in range(len(counts)):
        rank = top - counts[pixel]
        order[at[rank]] = pixel
        at[rank] += 1
    return order
