"""Tiles of a window: its events sorted by pixel and written into slots [ranks, lanes].

A lane is a pixel, a rank the number of the event at that pixel. There are three kinds of tile: wide
ones for pixels with few events, narrow ones for pixels with many. Within a kind the busiest pixels
come first, so that a round of ranks needs only the first blocks of lanes. Tiles run in order. How
many are used is data; for how many memory is allocated comes from a fixed ladder, so that another
window or recording of the same sensor compiles nothing.
"""

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.features import (
    N_TILE_SLOTS,
    TILE_SHAPES,
    EventPoints,
    EventTiles,
    allocate_aligned,
)
from jaxevent.reconstruction.frames import FrameTimes
from jaxevent.reconstruction.stream import (
    BaseCounts,
    DeadTime,
    EventStream,
    StreamState,
    event_weight,
)

# Events at a pixel from which the next, narrower kind of tile serves it.
MIN_KIND_EVENTS = (128, 1024)
N_TILE_THREADS = min(4, os.cpu_count() or 1)


class SlotMap(NamedTuple):
    """The slot of a pixel's event of any rank, as arrays for compiled loops."""

    known: bool  # whether there are tiles
    kind: NDArray[np.int8]  # per pixel: index in `TILE_SHAPES`
    lane: NDArray[np.int32]  # per pixel, within its kind
    round_tile: NDArray[np.int32]  # per kind and round of ranks: the first tile
    round_first: NDArray[np.int64]  # per kind: index of its first round in `round_tile`
    shapes: NDArray[np.int64]  # [kinds, 2], `TILE_SHAPES`

    @classmethod
    def empty(cls, n_pixels: int) -> "SlotMap":
        """Return the map of a window without tiles."""
        lane, kinds = np.zeros(n_pixels, np.int32), len(TILE_SHAPES)
        rounds = np.zeros(kinds, np.int32), np.zeros(kinds, np.int64)
        return cls(False, lane.astype(np.int8), lane, *rounds, np.array(TILE_SHAPES))


@dataclasses.dataclass(frozen=True)
class TileLayout:
    """Tile, rank and lane of each event of a window."""

    slot_map: SlotMap
    lanes: list[NDArray[np.int32]]  # per kind: pixels, busiest first
    counts: NDArray[np.int32]  # events per pixel
    capacity: int  # tiles, from the ladder
    ordinary: bool  # whether the first rung sufficed

    @classmethod
    def of(cls, counts: NDArray[np.int32], n_events: int) -> "TileLayout":
        """Lay out a window.

        Args:
            counts: (pixels,) events of each pixel.
            n_events: Events of ordinary skew for which tiles are allocated; doubled until they
                suffice.
        """
        pixels = len(counts)
        order = _busiest_first(counts)
        ends = [int(np.searchsorted(-counts[order], -limit, "right")) for limit in MIN_KIND_EVENTS]
        bounds = [pixels, *ends, 0]  # wide tiles serve the tail of the order, narrow its head
        kind, lane = np.zeros(pixels, np.int8), np.zeros(pixels, np.int32)
        lanes, rounds, tiles = [], [], 0
        for k, (ranks, width) in enumerate(TILE_SHAPES):
            own = order[bounds[k + 1] : bounds[k]]
            kind[own] = k
            lane[own] = np.arange(len(own))
            lanes.append(own)
            busy = counts[own]
            n_rounds = -(-int(busy[0]) // ranks) if len(own) else 0
            active = np.searchsorted(-busy, -ranks * np.arange(n_rounds), "left")
            first = tiles + np.concatenate([[0], np.cumsum(-(-active // width))])
            rounds.append(first[:-1].astype(np.int32))
            tiles = int(first[-1])
        # Full tiles, one partly used block of lanes per round, one partly used rank per block.
        spare = 32 if n_events > N_TILE_SLOTS else 8
        capacity = n_events // N_TILE_SLOTS + -(-pixels // TILE_SHAPES[0][1]) + spare
        ordinary = tiles <= capacity
        while capacity < tiles:
            capacity *= 2
        round_first = np.cumsum([0] + [len(r) for r in rounds[:-1]])
        round_tile = np.concatenate([*rounds, np.zeros(1, np.int32)])  # never empty
        slot_map = SlotMap(True, kind, lane, round_tile, round_first, np.array(TILE_SHAPES))
        return cls(slot_map, lanes, counts, capacity, ordinary)

    def lane_begins(self) -> list[int]:
        """Return the first lane of each kind among those of all kinds, and the number of lanes."""
        sizes = [-(-len(self.counts) // width) * width for _, width in TILE_SHAPES]
        return [sum(sizes[:k]) for k in range(len(TILE_SHAPES) + 1)]

    def lane_pixels(self) -> NDArray[np.int32]:
        """Return the pixels of the lanes of all kinds."""
        *begins, end = self.lane_begins()
        # Zeros at the end, so that as many lanes as the widest tile has can be cut out anywhere.
        out = np.zeros(end + TILE_SHAPES[0][1], np.int32)
        for begin, own in zip(begins, self.lanes, strict=True):
            out[begin : begin + len(own)] = own
        return out

    def last_slots(self) -> NDArray[np.int32]:
        """Return the slot of each pixel's last event, -1 if it has none."""
        kind, lane = self.slot_map.kind, self.slot_map.lane
        ranks, width = np.array(TILE_SHAPES)[kind].T
        rank = np.maximum(self.counts - 1, 0)
        busy = self.counts > 0
        rounds = np.where(busy, self.slot_map.round_first[kind] + rank // ranks, 0)
        tile = self.slot_map.round_tile[rounds] + lane // width
        slot = tile * N_TILE_SLOTS + rank % ranks * width + lane % width
        return np.where(busy, slot, -1).astype(np.int32)


@njit
def _busiest_first(counts):
    """Sort pixels by falling count, equal counts in pixel order: a counting sort."""
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
    """Memory for the arrays of tiles, by name.

    With `reuse` a window's tiles are written over the last one's, as fresh memory costs time. Else
    memory is fresh and cleared.
    """

    def __init__(self, reuse: bool, dtype: np.dtype):
        self.dtype = dtype  # of real numbers
        self._arrays: dict[str, NDArray] | None = {} if reuse else None

    def array(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray:
        """Return the array of a name, allocated anew if its shape changed.

        Args:
            name: Name of the array.
            shape: Its shape.
            dtype: Its type.

        Returns:
            The array; with `reuse` it holds what was written last.
        """
        if self._arrays is None:
            return allocate_aligned(shape, dtype)
        if name not in self._arrays or self._arrays[name].shape != shape:
            self._arrays[name] = allocate_aligned(shape, dtype, empty=True)
        return self._arrays[name]


class EventOrder(NamedTuple):
    """Events in the order of lanes."""

    key: NDArray[np.int64]  # time since the origin (us), shifted by one, and polarity
    near: NDArray  # s since the 3x3 neighbourhood's previous event


class TileInputs(NamedTuple):
    """Inputs of the loop that writes tiles."""

    order: EventOrder
    times: FrameTimes  # of the window's frames
    counts: BaseCounts
    dead: DeadTime


class TileKind(NamedTuple):
    """Lanes and rounds of the tiles of one kind."""

    index: int  # in `TILE_SHAPES`
    ranks: int
    width: int  # lanes
    offset: int  # of its lanes among those of all kinds
    pixels: NDArray[np.int32]  # of the lanes
    first: NDArray[np.int64]  # index of each lane's first event, and one entry more
    round_tile: NDArray[np.int32]  # the first tile of each round of ranks


class TileArrays(NamedTuple):
    """Arrays of `EventTiles` that `_fill` writes.

    Attributes:
        kind: [tiles] index in `TILE_SHAPES`; their number: the tile is not used.
        lane: [tiles] first lane of the tile.
        since: [tiles, slots] time since the pixel's previous event, s.
        near: [tiles, slots] time since the 3x3 neighbourhood's previous event, s.
        weight: [tiles, slots] position in the piece, 0..1.
        blend: [tiles, slots] position between the mid-exposures of two frames, 0..1.
        on: [tiles, slots] ON events since the left edge of the piece's exposure.
        off: [tiles, slots] OFF events since the left edge of the piece's exposure.
        piece_cell: [tiles, slots] piece * pixels + pixel.
        frame_cell: [tiles, slots] frame before the event * pixels + pixel.
        polarity: [tiles, slots] +1, -1, or 0 where there is no event.
    """

    kind: NDArray[np.int32]
    lane: NDArray[np.int32]
    since: NDArray
    near: NDArray
    weight: NDArray
    blend: NDArray
    on: NDArray
    off: NDArray
    piece_cell: NDArray[np.int32]
    frame_cell: NDArray[np.int32]
    polarity: NDArray[np.int8]

    @classmethod
    def allocate(cls, n_tiles: int, memory: TileMemory) -> "TileArrays":
        """Allocate tiles, none of them used.

        `_fill` clears what used tiles leave empty, unused tiles are skipped. (Derivatives are taken
        of all tiles, which must then hold numbers: memory is fresh, so cleared.)

        Args:
            n_tiles: Number of tiles.
            memory: Memory of the tiles.

        Returns:
            The arrays.
        """
        reals = dict.fromkeys(("since", "near", "weight", "blend", "on", "off"), memory.dtype)
        kinds = reals | {"piece_cell": np.int32, "frame_cell": np.int32, "polarity": np.int8}
        return cls(
            np.full(n_tiles, len(TILE_SHAPES), np.int32),
            np.zeros(n_tiles, np.int32),
            **{
                name: memory.array(name, (n_tiles, N_TILE_SLOTS), kind)
                for name, kind in kinds.items()
            },
        )


class LaneStates(NamedTuple):
    """State of each of 64 lanes while `_fill` passes over their events.

    Attributes:
        piece: Index of the piece that the lane has come to.
        frame: Index of the frame before it.
        before: Time of the last event since the origin, us.
        on: ON events counted so far.
        off: OFF events counted so far.
        own_on: ON events at the left edge of the piece's exposure.
        own_off: OFF events at the left edge of the piece's exposure.
    """

    piece: NDArray[np.int64]
    frame: NDArray[np.int64]
    before: NDArray[np.int64]
    on: NDArray
    off: NDArray
    own_on: NDArray
    own_off: NDArray


def make_tiles(
    stream: EventStream,
    layout: TileLayout,
    times: FrameTimes,
    counts: BaseCounts,
    state: StreamState,
    *,
    dead: DeadTime,
    capacity: int,
    memory: TileMemory,
) -> EventTiles:
    """Write the events of a window into tiles.

    Args:
        stream: Events of the window.
        layout: Their tiles, ranks and lanes.
        times: Times of the frames that the window uses.
        counts: Events before the times from which pieces count.
        state: State before the window; updated in place to its end.
        dead: The dead time.
        capacity: Events for which memory is allocated.
        memory: Memory of the tiles.

    Returns:
        The tiles.
    """
    first = np.zeros(len(layout.counts) + 1, np.int64)
    np.cumsum(layout.counts[np.concatenate(layout.lanes)], out=first[1:])
    size = (max(len(stream.t), capacity),)
    key, near = memory.array("key", size, np.int64), memory.array("order", size, memory.dtype)
    inputs = TileInputs(EventOrder(key, near), times, counts, dead)
    out = TileArrays.allocate(layout.capacity, memory)
    with ThreadPoolExecutor(N_TILE_THREADS) as pool:
        _sort_events(pool, stream, layout, first, state.near, inputs)
        _fill_tiles(pool, layout, first, inputs, state.last, out)
    points = EventPoints(out.weight, out.blend, out.on, out.off, out.piece_cell, out.frame_cell)
    return EventTiles(
        layout.lane_pixels(), out.kind, out.lane, points, out.since, out.near, out.polarity
    )


def _sort_events(
    pool: ThreadPoolExecutor,
    stream: EventStream,
    layout: TileLayout,
    first: NDArray[np.int64],
    latest: NDArray[np.int64],
    inputs: TileInputs,
) -> None:
    """Write events in the order of lanes to `inputs.order`, with several threads.

    Args:
        pool: Threads.
        stream: Events of the window.
        layout: Their lanes.
        first: (lanes + 1,) place of each lane's first event.
        latest: Time of the last event in each pixel's neighbourhood, us; see `StreamState.near`.
            Updated in place.
        inputs: Times of frames, and the order that is written.
    """
    pixels = len(layout.counts)
    cursor = np.empty(pixels, np.int64)
    cursor[np.concatenate(layout.lanes)] = first[:-1]
    bands = np.linspace(0, pixels // stream.width, N_TILE_THREADS + 1).astype(int)

    def sort(worker: int) -> None:
        band = bands[worker], bands[worker + 1]
        _sort(stream, band, inputs.times.origin, cursor, latest, inputs.order)

    list(pool.map(sort, range(N_TILE_THREADS)))


def _fill_tiles(
    pool: ThreadPoolExecutor,
    layout: TileLayout,
    first: NDArray[np.int64],
    inputs: TileInputs,
    last: NDArray[np.int64],
    out: TileArrays,
) -> None:
    """Write the slots of all tiles, with several threads.

    Args:
        pool: Threads.
        layout: Tiles, ranks and lanes.
        first: (lanes + 1,) place of each lane's first event.
        inputs: Events in the order of lanes, frames and counts.
        last: (pixels,) time of each pixel's last event, us, updated in place.
        out: Arrays of the tiles, output.
    """
    begin, slot_map = 0, layout.slot_map
    for index, (ranks, width) in enumerate(TILE_SHAPES):
        own, offset = layout.lanes[index], layout.lane_begins()[index]
        rounds = slot_map.round_tile[slot_map.round_first[index] :]
        lane_first = first[begin : begin + len(own) + 1]
        kind = TileKind(index, ranks, width, offset, own, lane_first, rounds)

        def fill(worker: int, kind: TileKind = kind) -> None:
            _fill(worker, N_TILE_THREADS, kind, inputs, last, out)

        list(pool.map(fill, range(N_TILE_THREADS)))
        begin += len(own)


@njit_noalloc
def _sort(stream, band, origin, cursor, latest, order):
    """Sort events by lane, with the time since the 3x3 neighbourhood's previous event.

    It serves some rows, so that several threads can work side by side. Writing an event's time to
    the nine pixels that it neighbours replaces a search over nine: the stream is sorted, so the
    latest write is the maximum.

    Args:
        stream: `EventStream`.
        band: First row, and the one after the last.
        origin: The recording's start, us.
        cursor: (pixels,) place of each pixel's next event, changed in place.
        latest: Time of the last event in each neighbourhood, us, with a border of one pixel;
            changed in place.
        order: `EventOrder`, output.
    """
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    key, near = order.key, order.near
    width = stream.width
    top, bottom = band
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
def _fill(worker, workers, kind, inputs, last, out):
    """Write slots, 64 lanes at a time: 64 sequential streams in, whole cache lines out.

    Args:
        worker: Number of this thread, which takes every `workers`-th job.
        workers: Number of threads.
        kind: `TileKind`.
        inputs: `TileInputs`.
        last: (pixels,) time of each pixel's last event, us, updated in place.
        out: `TileArrays`, output.
    """
    start, origin = inputs.counts.start, inputs.times.origin
    lane_count, counted, integer = len(kind.pixels), start.dtype, np.int64
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
            lanes.on[k], lanes.off[k] = start[0, pixel], start[1, pixel]
            lanes.before[k] = last[pixel] - origin
        _fill_lanes(lane0, mine, lanes, kind, inputs, out)
        for k, pixel in enumerate(mine):
            last[pixel] = lanes.before[k] + origin


@njit_noalloc_inlined
def _fill_lanes(lane0, mine, lanes, kind, inputs, out):
    """Write the slots of 64 lanes.

    Args:
        lane0: First of the lanes.
        mine: Their pixels.
        lanes: `LaneStates`, changed in place.
        kind: `TileKind`.
        inputs: `TileInputs`.
        out: `TileArrays`, output.
    """
    # Arrays get names of their own: reading them from tuples in the loop takes four times as long.
    order, times, counts, dead = inputs
    since, near, weight, blend = out.since, out.near, out.weight, out.blend
    piece_cell, frame_cell, polarity = out.piece_cell, out.frame_cell, out.polarity
    on, off, key, gap = out.on, out.off, order.key, order.near
    piece_at, frame_at, before = lanes.piece, lanes.frame, lanes.before
    count_on, count_off, own_on, own_off = lanes.on, lanes.off, lanes.own_on, lanes.own_off
    breaks, mids, exposed = times.breaks, times.mids, times.exposed
    begins_piece = times.begins_piece
    weight_rate, blend_rate = times.weight_rate, times.blend_rate
    first, start, left, pixels = kind.first, counts.start, counts.left, counts.start.shape[1]
    block = lane0 // kind.width
    busiest = first[block * kind.width + 1] - first[block * kind.width]
    rounds = (busiest + kind.ranks - 1) // kind.ranks
    for rank in range(rounds * kind.ranks):
        tile = kind.round_tile[rank // kind.ranks] + block
        if rank % kind.ranks == 0:
            out.kind[tile] = kind.index
            out.lane[tile] = kind.offset + block * kind.width
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
                elif fresh or not begins_piece[new]:
                    own_on[k], own_off[k] = left[new, 0, pixel], left[new, 1, pixel]
                elif new != own:
                    own_on[k], own_off[k] = count_on[k], count_off[k]
            frame = frame_at[k]
            while frame + 1 < len(mids) and mids[frame + 1] <= now:
                frame += 1
            frame_at[k] = frame
            since[tile, slot] = (now - before[k]) * 1e-6
            events = event_weight(now - before[k], dead)
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
