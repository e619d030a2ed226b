"""Where the events of a window lie: tiles of 32768 slots, [ranks, lanes].

A lane is a pixel, a rank the number of the event at that pixel. There are three kinds of tile, wide
ones for pixels with few events and narrow ones for pixels with many; within a kind the busiest
pixels come first, so that a round of ranks needs only the first blocks of lanes. Tiles run in
order. How many are used is data, how many there is room for comes from a fixed ladder, so another
window or recording of the same sensor compiles nothing.
"""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.features import SHAPES, SLOTS, EventPoints, Tiles, aligned
from jaxevent.reconstruction.frames import FrameTimes
from jaxevent.reconstruction.stream import BaseCounts, DeadTime, Stream, StreamState, equivalent

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


WORKERS = min(4, os.cpu_count() or 1)


class EventOrder(NamedTuple):
    """Events in pixel order."""

    key: NDArray[np.int64]  # time since the origin (us), shifted by one, and polarity
    near: NDArray  # s since the 3x3 neighbourhood's previous event


class TileKind(NamedTuple):
    """The tiles of one kind: what their lanes and rounds hold."""

    place: int  # in SHAPES
    ranks: int
    width: int  # lanes
    offset: int  # of its lanes among those of all kinds
    pixels: NDArray[np.int32]  # of the lanes
    first: NDArray[np.int64]  # where each lane's events begin, and one entry more
    round_tile: NDArray[np.int32]  # the first tile of each round of ranks


class Slots(NamedTuple):
    """The arrays of `Tiles` that `_fill` writes: two per tile, the others [tiles, slots]."""

    kind: NDArray[np.int32]
    lane: NDArray[np.int32]
    since: NDArray
    near: NDArray
    weight: NDArray
    blend: NDArray
    piece_cell: NDArray[np.int32]
    frame_cell: NDArray[np.int32]
    on: NDArray
    off: NDArray
    polarity: NDArray[np.int8]

    @classmethod
    def of(cls, tiles: int, memory: TileMemory) -> "Slots":
        """Room for a number of tiles, none of them used.

        `_fill` clears what used tiles leave empty, unused tiles are skipped. (Derivatives are taken
        of all tiles, where nothing but numbers may lie: then memory is fresh, so cleared.)
        """
        shape, real = (tiles, SLOTS), ("since", "near", "weight", "blend", "on", "off")
        fields: dict[str, Any] = {name: memory.dtype for name in real}
        fields |= {"piece_cell": np.int32, "frame_cell": np.int32, "polarity": np.int8}
        return cls(
            np.full(tiles, len(SHAPES), np.int32),
            np.zeros(tiles, np.int32),
            **{name: memory.field(name, shape, kind) for name, kind in fields.items()},
        )


class LaneStates(NamedTuple):
    """What `_fill` remembers of each of 64 lanes while it passes over their events."""

    piece: NDArray[np.int64]
    frame: NDArray[np.int64]
    before: NDArray[np.int64]  # time of the last event since the origin, us
    on: NDArray  # events counted so far
    off: NDArray
    own_on: NDArray  # at the left edge of the piece's exposure
    own_off: NDArray


def make_tiles(
    stream: Stream,
    layout: Layout,
    times: FrameTimes,
    counts: BaseCounts,
    state: StreamState,
    dead: DeadTime,
    room: int,
    memory: TileMemory,
) -> Tiles:
    """The tiles of a window's events; `state` is brought to the window's end in place.

    `times` and `counts` are of the frames that the window uses, `room` is for how many events
    memory is taken.
    """
    first = np.zeros(len(layout.counts) + 1, np.int64)
    np.cumsum(layout.counts[np.concatenate(layout.lanes)], out=first[1:])
    size = (max(len(stream.t), room),)
    order = EventOrder(
        memory.field("key", size, np.int64), memory.field("order near", size, memory.dtype)
    )
    slots = Slots.of(layout.room, memory)
    with ThreadPoolExecutor(WORKERS) as pool:
        _sort_events(pool, stream, layout, first, state.near, times.origin, order)
        lanes = _fill_tiles(pool, layout, first, order, times, counts, state.last, dead, slots)
    points = EventPoints(
        slots.weight, slots.blend, slots.on, slots.off, slots.piece_cell, slots.frame_cell
    )
    return Tiles(lanes, slots.kind, slots.lane, points, slots.since, slots.near, slots.polarity)


def _sort_events(
    pool: ThreadPoolExecutor,
    stream: Stream,
    layout: Layout,
    first: NDArray[np.int64],
    latest: NDArray[np.int64],
    origin: int,
    order: EventOrder,
) -> None:
    """Write events in the order of lanes, whose events begin at `first`, to `order`."""
    pixels = len(layout.counts)
    cursor = np.empty(pixels, np.int64)
    cursor[np.concatenate(layout.lanes)] = first[:-1]
    bands = np.linspace(0, pixels // stream.width, WORKERS + 1).astype(int)

    def sort(worker: int) -> None:
        _sort(stream, bands[worker], bands[worker + 1], origin, cursor, latest, order)

    list(pool.map(sort, range(WORKERS)))


def _fill_tiles(
    pool: ThreadPoolExecutor,
    layout: Layout,
    first: NDArray[np.int64],
    order: EventOrder,
    times: FrameTimes,
    counts: BaseCounts,
    last: NDArray[np.int64],
    dead: DeadTime,
    slots: Slots,
) -> NDArray[np.int32]:
    """Write events in the order of lanes to slots; the pixels of all lanes."""
    begin = 0
    for place, (ranks, width) in enumerate(SHAPES):
        mine, offset = layout.lanes[place], layout.lane_begins()[place]
        rounds = layout.round_tile[layout.round_first[place] :]
        lane_first = first[begin : begin + len(mine) + 1]
        kind = TileKind(place, ranks, width, offset, mine, lane_first, rounds)

        def fill(worker: int, kind: TileKind = kind) -> None:
            _fill(worker, WORKERS, kind, order, times, counts, last, dead, slots)

        list(pool.map(fill, range(WORKERS)))
        begin += len(mine)
    return layout.lane_pixels()


@njit_noalloc
def _sort(stream, top, bottom, origin, cursor, latest, order):
    """Events into pixel order, with the time since the 3x3 neighbourhood's previous event.

    Serves the rows top <= y < bottom, so that several can work side by side. Writing an event's
    time to the nine pixels that it neighbours replaces a search over nine: the stream is sorted,
    so the latest write is the maximum.
    """
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    key, near = order.key, order.near
    width = stream.width
    padded = width + 2
    for i in range(len(t)):
        line = np.int64(y[i])
        if line < top - 1 or line > bottom:
            continue
        column = np.int64(x[i])
        if top <= line < bottom:
            pixel = line * width + column
            at = cursor[pixel]
            cursor[pixel] = at + 1
            key[at] = (t[i] - origin) << 1 | (1 if p[i] else 0)
            near[at] = (t[i] - latest[(line + 1) * padded + column + 1]) * 1e-6
        for row in range(max(line - 1, top), min(line + 2, bottom)):
            middle = (row + 1) * padded + column + 1
            latest[middle - 1] = t[i]
            latest[middle] = t[i]
            latest[middle + 1] = t[i]


@njit
def _fill(worker, workers, kind, order, times, counts, last, dead, slots):
    """Write the slots of 64 lanes at a time: 64 sequential streams in, whole cache lines out."""
    lane_count, counted, integer = len(kind.pixels), counts.start.dtype, np.int64
    lanes = LaneStates(
        np.empty(64, integer), np.empty(64, integer), np.empty(64, integer),
        np.empty(64, counted), np.empty(64, counted),
        np.empty(64, counted), np.empty(64, counted),
    )  # fmt: skip
    jobs = (lane_count + kind.width - 1) // kind.width * kind.width // 64
    for job in range(worker, jobs, workers):
        lane0 = job * 64
        mine = kind.pixels[lane0 : lane0 + 64]
        for k, pixel in enumerate(mine):
            lanes.piece[k] = -1
            lanes.frame[k] = -1
            lanes.on[k], lanes.off[k] = counts.start[0, pixel], counts.start[1, pixel]
            lanes.before[k] = last[pixel] - times.origin
        _fill_lanes(lane0, mine, lanes, kind, order, times, counts, dead, slots)
        for k, pixel in enumerate(mine):
            last[pixel] = lanes.before[k] + times.origin


@njit_noalloc_inlined
def _fill_lanes(lane0, mine, lanes, kind, order, times, counts, dead, slots):
    """Write the slots of the lanes from `lane0` on, of the pixels `mine`, and bring `lanes` on."""
    # Arrays get names of their own: reading them from tuples in the loop takes four times as long.
    since, near, weight, blend = slots.since, slots.near, slots.weight, slots.blend
    piece_cell, frame_cell, polarity = slots.piece_cell, slots.frame_cell, slots.polarity
    on, off, key, gap = slots.on, slots.off, order.key, order.near
    piece_at, frame_at, before = lanes.piece, lanes.frame, lanes.before
    count_on, count_off, own_on, own_off = lanes.on, lanes.off, lanes.own_on, lanes.own_off
    breaks, mids, aligned, exposed = times.breaks, times.mids, times.aligned, times.exposed
    weight_rate, blend_rate = times.weight_rate, times.blend_rate
    first, start, left, pixels = kind.first, counts.start, counts.left, counts.start.shape[1]
    block = lane0 // kind.width
    busiest = first[block * kind.width + 1] - first[block * kind.width]
    rounds = (busiest + kind.ranks - 1) // kind.ranks
    for rank in range(rounds * kind.ranks):
        tile = kind.round_tile[rank // kind.ranks] + block
        if rank % kind.ranks == 0:
            slots.kind[tile] = kind.place
            slots.lane[tile] = kind.offset + block * kind.width
        base = rank % kind.ranks * kind.width + lane0 - block * kind.width
        for k in range(64):
            slot = base + k
            if k >= len(mine) or rank >= first[lane0 + k + 1] - first[lane0 + k]:
                since[tile, slot] = near[tile, slot] = 0
                weight[tile, slot] = blend[tile, slot] = 0
                piece_cell[tile, slot] = frame_cell[tile, slot] = 0
                on[tile, slot] = off[tile, slot] = 0
                polarity[tile, slot] = 0
                continue
            pixel, event = mine[k], first[lane0 + k] + rank
            now, up = key[event] >> 1, key[event] & 1
            piece = piece_at[k]
            if piece < 0 or (piece < len(breaks) and breaks[piece] <= now):
                fresh = piece < 0  # the window may start in the middle of a piece
                own = (piece - 1) // 2 if exposed else piece - 1
                piece = max(piece, 0)
                while piece < len(breaks) and breaks[piece] <= now:
                    piece += 1
                piece_at[k] = piece
                new = (piece - 1) // 2 if exposed else piece - 1
                if new < 0:
                    own_on[k], own_off[k] = start[0, pixel], start[1, pixel]
                elif fresh or not aligned[new]:
                    own_on[k], own_off[k] = left[new, 0, pixel], left[new, 1, pixel]
                elif new != own:
                    own_on[k], own_off[k] = count_on[k], count_off[k]
            frame = frame_at[k]
            while frame + 1 < len(mids) and mids[frame + 1] <= now:
                frame += 1
            frame_at[k] = frame
            since[tile, slot] = (now - before[k]) * 1e-6
            events = equivalent(now - before[k], dead)
            before[k] = now
            near[tile, slot] = gap[event]
            w = 0.0
            if piece > 0 and piece < len(breaks):
                w = (now - breaks[piece - 1]) * weight_rate[piece - 1]
            weight[tile, slot] = w
            v = 0.0
            if frame >= 0 and frame + 1 < len(mids):
                v = (now - mids[frame]) * blend_rate[frame]
            blend[tile, slot] = v
            piece_cell[tile, slot] = piece * pixels + pixel
            frame_cell[tile, slot] = max(frame, 0) * pixels + pixel
            on[tile, slot] = count_on[k] - own_on[k]
            off[tile, slot] = count_off[k] - own_off[k]
            if up:
                count_on[k] += events
            else:
                count_off[k] += events
            polarity[tile, slot] = 2 * up - 1
