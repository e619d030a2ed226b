"""Preparation for reconstruction: from a stream of events to features per pixel.

A per-pixel filter is a ragged array of short scans. Here the events of a time window are sorted by
pixel (counting sort) and laid out in tiles of 32768 slots, [ranks, lanes]: a lane is a pixel, a
rank the number of the event at that pixel. There are three kinds of tile, wide ones for pixels with
few events and narrow ones for pixels with many; within a kind the busiest pixels come first, so
that a round of ranks needs only the first blocks of lanes. Tiles run in order. How many are used is
data, how many there is room for comes from a fixed ladder, so another window or recording of the
same sensor compiles nothing.

Each slot holds what depends on data alone: times since the pixel's and the neighbourhood's last
event, polarity, and where the event lies among the frames. The frames cut time into *pieces*:
before the first exposure, within exposure f, in the gap after it. In each piece the augmented frame
is a blend of two integrations of events (`augment`), and a piece's event counts start at the left
edge of its exposure.

On several devices (`Features.over`) each has a share of the lanes of every block of 64, which all
kinds of tile are made of: as much work for each, and none waits for another.

A recording is prepared whole (`prepare`, for tuning) or window by window with carried state
(`Windows`, for reading out video at constant memory); the result does not depend on the choice.
"""

import abc
import dataclasses
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.devices import AXIS, along
from jaxevent.devices import mesh as devices_mesh
from jaxevent.errors import InputError
from jaxevent.kernels import compiled
from jaxevent.recording import Events, Recording, Times, microseconds

SHAPES = ((8, 4096), (64, 512), (512, 64))  # ranks, lanes of the three kinds of tile
SLOTS = 8 * 4096
LANES = 64  # of the narrowest tile; on several devices each has a part of every so many lanes
THRESHOLDS = (128, 1024)  # events at a pixel from which the next, narrower kind serves it
WINDOW_EVENTS = 1 << 20
_count_rooms = itertools.count()
WORKERS = min(4, os.cpu_count() or 1)


# Prepared on the host, where they stay until a jitted function takes them.
if TYPE_CHECKING:
    from typing import Any as Numeric
else:
    Numeric = Array | np.ndarray


class Points(eqx.Module):
    """Where points lie among the frames, and how to look a table [rows, pixels] up at them."""

    weight: Float[Numeric, "*#points"]  # position in the piece, 0 to 1
    blend: Float[Numeric, "*#points"]  # position between the mid-exposures of two frames, 0 to 1
    on: Float[Numeric, "*points"]  # ON events since the left edge of the piece's exposure
    off: Float[Numeric, "*points"]

    @abc.abstractmethod
    def of_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        """The table's entries for the points' pieces and pixels."""

    @abc.abstractmethod
    def of_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        """The table's entries for the frames before the points."""

    @abc.abstractmethod
    def of_piece_alone(self, values: Float[Array, " pieces"], pixels: int) -> Float[Array, "..."]:
        """The values of the points' pieces, equal for all pixels."""


class EventPoints(Points):
    """Points that each have their own pixel and time."""

    cell: Int[Numeric, "*points"]  # piece * pixels + pixel
    level: Int[Numeric, "*points"]  # frame before the point * pixels + pixel

    def of_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        return table.reshape(-1).at[self.cell].get(mode="clip")

    def of_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        return table.reshape(-1).at[self.level].get(mode="clip")

    def of_piece_alone(self, values: Float[Array, " pieces"], pixels: int) -> Float[Array, "..."]:
        return values.at[self.cell // pixels].get(mode="clip")


class ImagePoints(Points):
    """All pixels at a few times; weights are (times, 1)."""

    piece: Int[Numeric, " times"]
    level: Int[Numeric, " times"]
    elapsed: Float[Numeric, " times"]  # s since mid-exposure of the frame before; negative: none is

    def of_piece(self, table: Float[Array, "pieces pixels"]) -> Float[Array, "..."]:
        return table.at[self.piece].get(mode="clip")

    def of_frame(self, table: Float[Array, "frames pixels"]) -> Float[Array, "..."]:
        return table.at[self.level].get(mode="clip")

    def of_piece_alone(self, values: Float[Array, " pieces"], pixels: int) -> Float[Array, "..."]:
        return values.at[self.piece].get(mode="clip")[:, None]


class Tiles(eqx.Module):
    """The events of a window; slots without an event have polarity 0 and change nothing.

    Shared out over a mesh, the arrays' last axis is cut into blocks of `LANES`, which become the
    last axis, and that is what is shared out.
    """

    pixel: Int[Numeric, "*lanes"]  # the pixel of each lane
    kind: Int[Numeric, " tiles"]  # the tile's place in SHAPES; len(SHAPES): the tile is not used
    lane: Int[Numeric, " tiles"]  # the tile's first lane
    points: EventPoints
    since: Float[Numeric, "tiles *slots"]  # s since the pixel's previous event
    near: Float[Numeric, "tiles *slots"]  # s since the 3x3 neighbourhood's previous event
    polarity: Int[Numeric, "tiles *slots"]  # +1, -1, or 0 where there is no event
    mesh: Mesh | None = eqx.field(static=True, default=None)

    def over(self, mesh: Mesh) -> "Tiles":
        """The same, lanes shared out over a mesh whose size divides `LANES`."""

        def put(leaf: Any, spec: PartitionSpec) -> Any:
            if len(spec):
                leaf = leaf.reshape(*leaf.shape[:-1], -1, LANES)
            return jax.device_put(leaf, NamedSharding(mesh, spec))

        placed = jax.tree.map(put, self, self._specs())
        return dataclasses.replace(placed, mesh=mesh)

    def _specs(self) -> Any:
        """How every array is shared out; empty: not at all."""
        slots = PartitionSpec(None, None, AXIS)
        others = {
            "kind": PartitionSpec(),
            "lane": PartitionSpec(),
            "pixel": PartitionSpec(None, AXIS),
        }
        return jax.tree_util.tree_map_with_path(
            lambda path, _: others.get(path[0].name, slots), self
        )

    def each(self, function: Callable[..., Any], *whole: Any) -> Any:
        """`function(tiles, *whole)`, arrays (tiles, slots), on every device with its lanes.

        Nothing passes between devices but, backwards, the sum of derivatives by `whole`.
        """
        if self.mesh is None:
            return function(self, *whole)

        def here(tiles: Tiles, *whole: Any) -> Any:
            def flat(leaf: Array, spec: PartitionSpec) -> Array:
                return leaf.reshape(*leaf.shape[:-2], -1) if len(spec) else leaf

            mine = jax.tree.map(flat, tiles, tiles._specs())
            out = function(dataclasses.replace(mine, mesh=None), *whole)
            return jax.tree.map(lambda v: v.reshape(*v.shape[:-1], -1, lanes), out)

        lanes = LANES // self.mesh.size
        return jax.shard_map(
            here,
            mesh=self.mesh,
            in_specs=(self._specs(), *[PartitionSpec()] * len(whole)),
            out_specs=PartitionSpec(None, None, AXIS),
            check_vma=False,  # branches that skip a tile give zeros, which are the same everywhere
        )(self, *whole)


class Segments(eqx.Module):
    """Events inside exposures: each bounds one segment of constant brightness (EDI)."""

    cell: Int[Numeric, " segments"]  # frame * pixels + pixel
    share: Float[Numeric, " segments"]  # of the exposure that the segment fills
    edge: Float[Numeric, " segments"]  # growth of `share` per second of later frame clock
    on: Float[Numeric, " segments"]  # ON events from mid-exposure to the segment, negative before
    off: Float[Numeric, " segments"]


class FrameFeatures(eqx.Module):
    """Frames of a window and the event counts that tie them together; spare rows repeat the last.

    Counts are [frames, pixels]: `head` from the left edge to mid-exposure, `tail` from there to the
    right edge, `span` from the left edge to the right edge of the next exposure; `before` counts
    from the window's start to the first right edge.
    """

    grey: Float[Numeric, "frames pixels"]  # in [0, 1], as the camera gave it
    intensity: Float[Numeric, "frames pixels"]  # the grey values through the inverse response
    certainty: Float[Numeric, "frames pixels"]  # w of the response, at most 1
    response: Float[Numeric, " 256"]  # intensities of evenly spaced grey values
    gain: Float[Numeric, " frames"]  # the frames' exposure relative to the common one
    span: Float[Numeric, "2 frames pixels"]  # ON, OFF
    before: Float[Numeric, "2 pixels"]
    head: Float[Numeric, "2 frames pixels"] | None  # None where no exposure is known
    tail: Float[Numeric, "2 frames pixels"] | None
    segments: Segments | None
    piece_rate: Float[Numeric, " pieces"]  # d weight / dt of each piece, 1/s
    level_rate: Float[Numeric, " frames"]  # d blend / dt after each frame, 1/s
    present: Float[Numeric, ""]  # 1, or 0 if the recording has no frames
    rows: Int[Numeric, " 3"]  # number of frames; rows of the last one before, of the next's first
    clock_offset: Float[Numeric, ""]  # s, for which the positions were prepared
    width: int = eqx.field(static=True)  # of the sensor, whose pixels are in rows


class Growth(eqx.Module):
    """Derivatives of event counts with respect to the dead time `rho_ref` (1/s), array by array.

    Counts are made for one dead time; around it they are continued linearly.
    """

    counts: list[Float[Numeric, "..."]]
    rho_ref: Float[Numeric, ""]  # s, for which the counts were made


class Features(eqx.Module):
    """All that `run` needs to know about a window of a recording; a pytree of arrays."""

    frames: FrameFeatures
    tiles: Tiles | None  # None where the estimator does not filter
    start: ImagePoints  # every pixel at the recording's start
    last: Int[Numeric, " pixels"]  # the slot of each pixel's last event, -1 if it has none
    growth: Growth | None = None

    def counts(self) -> list[Any]:
        """The arrays that count events."""
        f, s = self.frames, self.frames.segments
        tiles = [] if self.tiles is None else [self.tiles.points.on, self.tiles.points.off]
        exposed = [] if s is None else [f.head, f.tail, s.on, s.off]
        return [f.span, f.before, *exposed, *tiles]

    def at(self, rho_ref: Array) -> "Features":
        """The features for a dead time near the one that they were made for."""
        return _grown(self, rho_ref)

    def over(self, devices: Sequence[Any]) -> "Features":
        """The features on several devices: lanes of tiles and pixels of images shared out."""
        mesh = pixel_mesh(devices)
        if mesh is None:
            return self
        pixels = self.last.shape[0]
        growth = self.growth
        if growth is not None:
            counts = list(growth.counts)
            if self.tiles is not None:
                at = eqx.tree_at(lambda t: (t.points.on, t.points.off), self.tiles, counts[-2:])
                points = at.over(mesh).points
                counts[-2:] = [points.on, points.off]
                counts[:-2] = over_pixels(counts[:-2], mesh, pixels)
            else:
                counts = over_pixels(counts, mesh, pixels)
            growth = Growth(counts, over_pixels(growth.rho_ref, mesh, pixels))
        rest = (self.frames, self.start, self.last)
        frames, start, last = over_pixels(rest, mesh, pixels)
        tiles = None if self.tiles is None else self.tiles.over(mesh)
        return Features(frames, tiles, start, last, growth)


class ReadOut(eqx.Module):
    """Images to be read: one time each, and for every pixel its last event before it."""

    points: ImagePoints
    slot: Int[Numeric, "times pixels"]  # of the pixel's last event in the window, -1 if none
    since: Float[Numeric, "times pixels"]  # s since the pixel's last event
    growth: Growth | None = None

    def counts(self) -> list[Any]:
        """The arrays that count events."""
        return [self.points.on, self.points.off]

    def images(self, rows: NDArray) -> "ReadOut":
        """Those of its images, in that order."""
        parts, growth = (self.points, self.slot, self.since), self.growth
        chosen = jax.tree.map(lambda leaf: leaf[rows], parts)
        if growth is not None:
            growth = Growth([count[rows] for count in growth.counts], growth.rho_ref)
        points, slot, since = chosen
        return ReadOut(points, slot, since, growth)

    def at(self, rho_ref: Array) -> "ReadOut":
        """The read-out for a dead time near the one that it was made for."""
        return _grown(self, rho_ref)

    def over(self, devices: Sequence[Any]) -> "ReadOut":
        """The read-out on several devices, pixels shared out."""
        mesh = pixel_mesh(devices)
        return self if mesh is None else over_pixels(self, mesh, self.slot.shape[1])


def pixel_mesh(devices: Sequence[Any]) -> Mesh | None:
    """The mesh that pixels are shared out over; None where there is but one device."""
    return devices_mesh(devices, LANES)


def over_pixels(tree: Any, mesh: Mesh, pixels: int) -> Any:
    """Arrays [..., pixels] shared out along pixels, all others whole on every device."""

    def put(leaf: Any) -> Any:
        return along(mesh, leaf, -1 if np.shape(leaf)[-1:] == (pixels,) else None)

    return jax.tree.map(put, tree)


Counting = TypeVar("Counting", Features, ReadOut)


def _grown(counting: Counting, rho_ref: Array) -> Counting:
    growth = counting.growth
    if growth is None:
        return counting
    change = rho_ref - growth.rho_ref
    moved = [n + change * g for n, g in zip(counting.counts(), growth.counts, strict=True)]
    return eqx.tree_at(lambda c: c.counts(), counting, moved)


class Timing(NamedTuple):
    """What preparation compares event times with (s); parameters of that name of every estimator.

    `clock_offset` is added to the frames' time stamps, `exposure` is that of frames whose own is
    not known, `rho_ref` a pixel's dead time after an event. An event after the gap dt at its pixel
    stands for min(dt / (dt - rho_ref), 3) events: what happened in the dead time is lost.

    An event is late: the intensity has been moving since the pixel's last one. Where no more than
    `spread` lies between the two, the second's change is spread evenly over that time, which needs
    later events and is for methods that do not filter.
    """

    clock_offset: float = 0.0
    exposure: float = 0.0
    rho_ref: float = 0.0
    spread: float = 0.0

    @classmethod
    def of(cls, params: Any) -> "Timing":
        """From an estimator's parameters, rounded to 10 ns: 7.5 ms is 7500 us in float32 too."""
        return cls(**{n: round(float(getattr(params, n, 0.0)), 8) for n in cls._fields})


@dataclasses.dataclass(frozen=True)
class Clock:
    """The frames in time: float64 microseconds from the recording's start, offset applied.

    `breaks` are the times at which pieces end. Exposures that overlap (a jittering stamp) share the
    overlap as their gap, clipped to the two mid-exposures, so that the augmented frame stays
    continuous; exposures that do not overlap are used as they are.
    """

    mid: NDArray[np.floating]
    left: NDArray[np.floating]
    right: NDArray[np.floating]
    breaks: NDArray[np.floating]
    exposed: bool
    offset: float  # s

    @classmethod
    def of(cls, recording: Recording, timing: Timing) -> "Clock":
        offset = round(timing.clock_offset * 1e8) / 100
        frames = recording.frames
        if frames is None:
            none = np.empty(0)
            return cls(none, none, none, none, False, offset * 1e-6)
        mid = (frames.t - recording.start) + offset
        unknown = round(timing.exposure * 1e8) / 100
        exposure = np.where(frames.exposure > 0, frames.exposure, unknown)
        left, right = mid - exposure / 2, mid + exposure / 2
        exposed = bool((exposure > 0).any())
        breaks = mid
        if exposed:
            gap = np.sort([right[:-1], left[1:]], axis=0).clip(mid[:-1], mid[1:])
            breaks = np.stack([np.r_[left[0], gap[1]], np.r_[gap[0], right[-1]]], 1).ravel()
        return cls(mid, left, right, breaks, exposed, offset * 1e-6)

    def __len__(self) -> int:
        return len(self.mid)

    def frame(self, piece: Any) -> Any:
        """The frame whose left edge pieces count events from; -1 before the first exposure."""
        return (piece - 1) // 2 if self.exposed else piece - 1

    def locate(self, time: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Piece, frame before, weight in the piece and blend between frames, at times in us."""
        piece = np.searchsorted(self.breaks, time, "right")
        level = np.searchsorted(self.mid, time, "right") - 1
        return (
            piece,
            np.maximum(level, 0),
            _position(self.breaks, piece - 1, time),
            _position(self.mid, level, time),
        )

    def elapsed(self, time: NDArray, level: NDArray) -> NDArray:
        """Seconds from the middle of the frames `level` to times in us; 0 without frames."""
        return (time - self.mid[level]) * 1e-6 if len(self) else np.zeros(len(time))


def _position(breaks: NDArray, i: NDArray, time: NDArray) -> NDArray:
    """How far `time` lies between breaks i and i + 1, 0 outside the first and last."""
    inside = (i >= 0) & (i < len(breaks) - 1)
    if not inside.any():
        return np.zeros(len(time))
    j = np.where(inside, i, 0)
    return np.where(inside, (time - breaks[j]) * _rate(breaks)[j], 0)


@dataclasses.dataclass
class Carry:
    """What the stream before a window leaves behind: times of the last event (us)."""

    last: NDArray[np.int64]  # at each pixel
    near: NDArray[np.int64]  # in each pixel's neighbourhood, with a border of one pixel
    # The first event of which the frames tell, and `last` before it; kept where events are weighted
    # by the gap to the one before.
    context: int = 0
    last_then: NDArray[np.int64] | None = None
    frames: int = 1  # how many frames of the recording windows have used

    @classmethod
    def initial(cls, recording: Recording, weighted: bool = False) -> "Carry":
        pixels = recording.width * recording.height
        border = (recording.width + 2) * (recording.height + 2)
        last = np.full(pixels, recording.start)
        then = last.copy() if weighted else None
        return cls(last, np.full(border, recording.start), 0, then)

    def copy(self) -> "Carry":
        return dataclasses.replace(self, last=self.last.copy(), near=self.near.copy())


@dataclasses.dataclass
class Window:
    """Events with start <= t < stop (us; None: unbounded), prepared for filtering and reading."""

    start: int | None
    stop: int | None
    features: Features | None
    after: Carry
    _width: int
    _events: Events
    _ahead: Events  # the same and, where changes are spread, those soon after
    _clock: Clock
    _origin: int
    _first_frame: int
    _before: Carry
    _rho: float  # us, the dead time
    _reach: int  # us, the longest time over which a change is spread
    _counts: NDArray  # [2, pixels] ON and OFF at the window's start
    _reference: NDArray  # [frames, 2, pixels] ON and OFF at the left edge of each exposure
    _layout: "Layout | None"

    def reader(self, room: int, dtype: Any) -> "Reader":
        return Reader(self, room, dtype)


def _first_piece(clock: Clock, first_frame: int) -> int:
    """Piece 0 of a window stands for everything before its first frame."""
    return (2 if clock.exposed else 1) * first_frame


class Reader:
    """Walks through a window's events in time and says where images to be read lie among them."""

    def __init__(self, window: Window, room: int, dtype: Any):
        self.window, self.room = window, room
        pixels = window._counts.shape[1]
        self._layout = window._layout or Layout.none(pixels)
        self._shapes = np.array(SHAPES)
        self._buffers = [
            (_room((room, pixels), np.int32), *(_room((room, pixels), dtype) for _ in range(3)))
            for _ in range(2)
        ]
        self._dtype, self._pixels = dtype, pixels
        self._rewind()

    def _rewind(self) -> None:
        window, pixels = self.window, self._pixels
        self._row, self._time = 0, np.iinfo(np.int64).min
        self._count, self._last = window._counts.copy(), window._before.last.copy()
        self._at, self._rank = np.full(pixels, -1, np.int32), np.zeros(pixels, np.int32)

    def __call__(self, times: NDArray[np.int64], growth: bool = False) -> ReadOut:
        """Images at sorted times (us) inside the window, padded to `room`.

        With `growth` counts are derivatives with respect to the dead time. The arrays are
        overwritten by the call after the next.
        """
        window = self.window
        clock, layout, events = window._clock, self._layout, window._ahead
        if len(times) and times[0] < self._time:
            self._rewind()
        self._buffers.reverse()
        slot, on, off, since = self._buffers[0]
        piece, level, weight, blend = clock.locate((times - window._origin).astype(float))
        self._row = _read(
            events.t, events.x, events.y, events.p, len(window._events), window._origin,
            window._reach, window._width, self._row, window._layout is not None, times,
            clock.frame(piece) - window._first_frame, window._reference, window._counts,
            self._count, self._last, self._at, self._rank, layout.kind, layout.lane,
            layout.round_tile, layout.round_first, self._shapes, window._rho, growth,
            slot, since, on, off,
        )  # fmt: skip
        self._time = times[-1] if len(times) else self._time

        def row(values: NDArray, kind: Any, first: int = 0) -> NDArray:
            out = np.zeros(self.room, kind)
            out[: len(times)] = values - first
            return out

        points = ImagePoints(
            row(weight, self._dtype)[:, None],
            row(blend, self._dtype)[:, None],
            on,
            off,
            row(piece, np.int32, _first_piece(clock, window._first_frame)),
            row(level, np.int32, window._first_frame),
            row(clock.elapsed(times - window._origin, level), self._dtype),
        )
        return ReadOut(points, slot, since)


@dataclasses.dataclass
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
    def none(cls, pixels: int) -> "Layout":
        zeros, kinds = np.zeros(pixels, np.int32), len(SHAPES)
        return cls(
            zeros.astype(np.int8), zeros, [], zeros, np.zeros(kinds, np.int32),
            np.zeros(kinds, np.int64), 0, True,
        )  # fmt: skip

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
        room = events // SLOTS + -(-pixels // SHAPES[0][1]) + 32
        ordinary = tiles <= room
        while room < tiles:
            room *= 2
        starts = np.cumsum([0] + [len(r) for r in rounds[:-1]])
        first_tile = np.concatenate([*rounds, np.zeros(1, np.int32)])  # never empty
        return cls(kind, lane, lanes, counts, first_tile, starts, room, ordinary)

    def slots(self) -> NDArray[np.int32]:
        """The slot of each pixel's last event, -1 if it has none."""
        ranks, width = np.array(SHAPES)[self.kind].T
        rank = np.maximum(self.counts - 1, 0)
        busy = self.counts > 0
        rounds = np.where(busy, self.round_first[self.kind] + rank // ranks, 0)
        tile = self.round_tile[rounds] + self.lane // width
        slot = tile * SLOTS + rank % ranks * width + self.lane % width
        return np.where(busy, slot, -1).astype(np.int32)


class Windows:
    """Cuts a recording into time windows and prepares them.

    `events` bounds a window's events; `filtering=False` prepares what reading frames and event
    counts needs, without tiles; with `growth` counts are derivatives by the dead time. With
    `reuse` a window's tiles are written over the last one's: fresh memory costs 0.5 ms per MB here,
    a third of the preparation. Only for who is done with one window before asking for the next.
    """

    def __init__(
        self,
        recording: Recording,
        timing: Timing = Timing(),  # noqa: B008
        *,
        filtering: bool = True,
        events: int = WINDOW_EVENTS,
        reuse: bool = False,
        growth: bool = False,
    ):
        self.recording, self.filtering, self.events = recording, filtering, events
        self.clock = Clock.of(recording, timing)
        self.rho, self.growth = round(timing.rho_ref * 1e8) / 100, growth
        self.reach = 0 if filtering else round(timing.spread * 1e6)
        # Whole events are counted in integers, weighted and spread ones in double precision.
        self.count_dtype = np.dtype(np.float64 if self.rho or self.reach else np.int32)
        self.pixels = recording.width * recording.height
        # Room for frames depends on the sensor only, to compile once: 16 frames of tables are
        # 60 MB at 346x260; larger sensors get fewer.
        self.frames = max(6, min(16, 6_000_000 // self.pixels))
        self.dtype = np.dtype(jnp.result_type(float))
        self.origin = recording.start
        response, self._gain = recording.response, recording.gain
        self._tables = (lambda grey: grey, response.intensity, response.certainty)
        self._memory: dict[str, NDArray] | None = {} if reuse else None

    def _tile_room(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray:
        """Memory for one field of the tiles, cleared unless it is used again."""
        if self._memory is None:
            return _room(shape, dtype)
        if name not in self._memory or self._memory[name].shape != shape:
            self._memory[name] = _room(shape, dtype, empty=True)
        return self._memory[name]

    def initial(self) -> Carry:
        return Carry.initial(self.recording, self.rho > 0)

    def _stop(self, start: int | None) -> int | None:
        """Where the window that starts at `start` should end; None: at the recording's end."""
        stops = []
        clock, source = self.clock, self.recording.events
        at = -np.inf if start is None else start - self.origin
        piece = int(np.searchsorted(clock.breaks, at, "right"))
        # A window uses the frame before its first piece's and the one after its last piece's.
        last = max(clock.frame(piece) - 1, 0) + self.frames - 2
        if last < len(clock):
            stop = clock.breaks[2 * last if clock.exposed else last]
            stops.append(self.origin + int(np.ceil(stop)))
        first = 0 if start is None else source.index(start)
        if first + self.events < len(source):
            row = first + self.events
            stop = int(source[row : row + 1].t[0])
            if source.index(stop) <= first:  # a burst at one instant is not divided
                stop += 1
            if stop <= self.recording.stop:
                stops.append(stop)
        return min(stops, default=None)

    def prepare(self, start: int | None, before: Carry) -> Window:
        """The window that begins at `start`, shorter if its events are very unevenly spread."""
        stop = self._stop(start)
        source = self.recording.events
        begin = 0 if start is None else source.index(start)
        end = len(source) if stop is None else source.index(stop)
        context, finish = self._context(self._used(start, stop), begin, end)
        if self.reach and stop is not None:
            finish = max(finish, source.index(stop + self.reach))
        around = source[context:finish]
        if before.last_then is not None:
            before = self._moved(before, context)
        events = around[begin - context : end - context]
        while True:
            layout = self._layout(events)
            middle = int(events.t[len(events) // 2]) if len(events) else 0
            if layout is None or layout.ordinary or len(events) < 2 or middle == events.t[0]:
                ahead = around[begin - context :]
                ahead = ahead[: len(ahead) if stop is None else ahead.index(stop + self.reach)]
                return self._window(start, stop, around, events, ahead, layout, before)
            stop = middle
            events = events[: events.index(stop)]

    def _context(self, used: slice, begin: int, end: int) -> tuple[int, int]:
        """The rows of the events in the frames' exposures and from begin to end."""
        if used.start < used.stop:
            # Of overlapping exposures, a later one may begin or an earlier one end further out.
            left, _, right = self._edges(used)
            source = self.recording.events
            begin = min(begin, source.index(int(left.min()) - self.reach))
            end = max(end, source.index(int(right.max()) + self.reach))
        return begin, end

    def _moved(self, carry: Carry, context: int) -> Carry:
        """The same, with each pixel's last event before the row `context`."""
        last, row = carry.last_then, carry.context
        assert last is not None
        if row > context:
            first = self.initial()
            last, row = first.last, 0
        last = last.copy()
        while row < context:
            part = self.recording.events[row : min(row + WINDOW_EVENTS, context)]
            _latest(part.t, part.x, part.y, self.recording.width, last)
            row += len(part)
        return dataclasses.replace(carry, context=context, last_then=last)

    def whole(self) -> Window:
        """The whole recording as one window, with room from a ladder of steps by a quarter."""
        while self.frames < len(self.clock) + 2:
            self.frames += -(-self.frames // 4)
        if (2 * self.frames + 1) * self.pixels >= 2**31:
            raise InputError(
                f"{self.recording.name}: {len(self.clock)} frames of {self.pixels} pixels are too "
                "many to prepare in one piece; cut the recording in time: recording[t0:t1]"
            )
        self.events = 1 << 15
        while self.events < len(self.recording.events):
            self.events += self.events // 4
        events = self.recording.events[:]
        layout = self._layout(events)
        return self._window(None, None, events, events, events, layout, self.initial())

    def __iter__(self) -> Iterator[Window]:
        before, start = self.initial(), None
        while True:
            window = self.prepare(start, before)
            yield window
            if window.stop is None:
                return
            before, start = window.after, window.stop

    def _layout(self, events: Events) -> Layout | None:
        if not self.filtering:
            return None
        counts = _count(events.x, events.y, self.recording.width, self.pixels)
        return Layout.of(counts, self.events)

    def _used(self, start: int | None, stop: int | None) -> slice:
        """The frames that tell what happens from start to stop, one more on each side."""
        span = np.array(
            [
                -np.inf if start is None else start - self.origin,
                np.inf if stop is None else stop - self.origin,
            ]
        )
        first, last = self.clock.frame(np.searchsorted(self.clock.breaks, span, "right"))
        return slice(max(int(first) - 1, 0), min(max(int(last), 0) + 2, len(self.clock)))

    def _edges(self, used: slice) -> list[NDArray[np.int64]]:
        """Left edge, middle and right edge of exposures (us): events with t < edge are before it.

        Half microseconds are rounded up, which says the same of whole ones.
        """
        edges = (self.clock.left, self.clock.mid, self.clock.right)
        return [np.ceil(edge[used]).astype(np.int64) + self.origin for edge in edges]

    def _window(
        self,
        start: int | None,
        stop: int | None,
        around: Events,
        events: Events,
        ahead: Events,
        layout: Layout | None,
        before: Carry,
    ) -> Window:
        """The window of `events`; `around` holds those of all its frames' exposures too."""
        used = self._used(start, stop)
        opening = np.iinfo(np.int64).min if start is None else start
        weight = np.ones(len(around), np.int8)
        if before.last_then is not None:
            weight = _weights(
                around.t, around.x, around.y, self.recording.width, before.last_then.copy(),
                self.rho, self.growth,
            )  # fmt: skip
        edges, where = np.unique(
            np.concatenate([[opening], *self._edges(used)]).astype(np.int64), return_inverse=True
        )
        snapshot = _snapshots(
            around.t, around.x, around.y, around.p, weight, edges, self.recording.width,
            np.zeros((2, self.pixels), self.count_dtype),
        )  # fmt: skip
        at_start = snapshot[where[0]]
        if self.reach:
            at_start = at_start.copy()
            _spread(
                around.t, around.x, around.y, around.p, weight, edges, self.recording.width,
                self.origin, self.reach, snapshot,
            )  # fmt: skip
        at_left, at_mid, at_right = (snapshot[w] for w in np.split(where[1:], 3))

        frames = self._frames(used, around, weight, at_left, at_mid, at_right, at_start)
        onward = used.stop if stop is None else self._used(stop, stop).start
        frames.rows[1:] = np.maximum([before.frames - 1 - used.start, onward - used.start], 0)
        after, tiles, ends = before.copy(), None, np.full(self.pixels, -1, np.int32)
        after.frames = max(used.stop, 1)
        if layout is not None:
            ends = layout.slots()
            tiles = self._tiles(events, layout, after, used.start, at_left, at_start)
        else:
            _latest(events.t, events.x, events.y, self.recording.width, after.last)
        return Window(
            start,
            stop,
            Features(frames, tiles, self._start(), ends),
            after,
            self.recording.width,
            events,
            ahead,
            self.clock,
            self.origin,
            used.start,
            before,
            self.rho,
            self.reach,
            at_start,
            at_left,
            layout,
        )

    def _start(self) -> ImagePoints:
        """The recording's start, where no event has happened; only the first window uses it."""
        piece, level, weight, blend = self.clock.locate(np.zeros(1))
        counts = np.zeros((1, self.pixels), self.dtype)
        return ImagePoints(
            weight[:, None].astype(self.dtype), blend[:, None].astype(self.dtype), counts, counts,
            piece.astype(np.int32), level.astype(np.int32),
            self.clock.elapsed(np.zeros(1), level).astype(self.dtype),
        )  # fmt: skip

    def _frames(
        self,
        used: slice,
        around: Events,
        weight: NDArray,
        at_left: NDArray,
        at_mid: NDArray,
        at_right: NDArray,
        at_start: NDArray,
    ) -> FrameFeatures:
        clock, room, pixels, dtype = self.clock, self.frames, self.pixels, self.dtype
        n = len(at_left)
        grey, intensity, certainty = (_room((room, pixels), dtype) for _ in range(3))
        grey[:], intensity[:] = 0.5, 0.5
        gain = np.ones(room, dtype)
        span = _room((2, room, pixels), dtype)
        before = np.zeros((2, pixels), dtype)
        if n:
            assert self.recording.frames is not None
            images = np.asarray(self.recording.frames[used].images).reshape(n, pixels)
            for table, out in zip(self._tables, (grey, intensity, certainty), strict=True):
                if images.dtype.kind == "f":
                    out[:n] = table(jnp.asarray(images))
                else:
                    levels = np.arange(np.iinfo(images.dtype).max + 1)
                    entries = table(jnp.asarray(levels / levels[-1]))
                    np.take(np.asarray(entries, dtype), images, out=out[:n])
                out[n:] = out[n - 1]
            gain[:n] = self._gain[used]
            intensity[:n] /= gain[:n, None]
            intensity[n:] = intensity[n - 1]
            span[:, : n - 1] = (at_right[1:] - at_left[:-1]).swapaxes(0, 1)
            before[:] = at_right[0] - (at_start if used.start == 0 else 0)
        head = tail = segments = None
        pieces = room + 1
        if clock.exposed:
            pieces = 2 * room + 1
            head, tail = (_room((2, room, pixels), dtype) for _ in range(2))
            head[:, :n] = (at_mid - at_left).swapaxes(0, 1)
            tail[:, :n] = (at_right - at_mid).swapaxes(0, 1)
            segments = self._segments(used, around, weight)
        breaks = clock.breaks[_first_piece(clock, used.start) :]

        def rates(times: NDArray, size: int, first: int) -> NDArray:
            out = np.zeros(size, dtype)
            rate = 1e6 * _rate(times)[: size - first]
            out[first : first + len(rate)] = rate
            return out

        return FrameFeatures(
            grey,
            intensity,
            certainty,
            np.asarray(self._tables[1](jnp.linspace(0, 1, 256)), dtype),
            gain,
            span,
            before,
            head,
            tail,
            segments,
            rates(breaks, pieces, 1),
            rates(clock.mid[used], room, 0),
            np.asarray(float(n > 0), dtype),
            np.array([n, 0, 0], np.int32),
            np.asarray(clock.offset, dtype),
            self.recording.width,
        )

    def _segments(self, used: slice, around: Events, weight: NDArray) -> Segments:
        clock, parts = self.clock, []
        exact = np.stack([clock.left[used], clock.mid[used], clock.right[used]], axis=1)
        for row, edges in enumerate(np.stack(self._edges(used), axis=1)):
            i, m, j = (around.index(int(edge)) for edge in edges)
            if i < j:
                part = around[i:j]
                t = part.t - self.origin
                parts.append(
                    _exposure(
                        t,
                        part.x,
                        part.y,
                        part.p,
                        weight[i:j],
                        m - i,
                        row,
                        exact[row],
                        self.recording.width,
                        np.zeros((2, self.pixels), self.count_dtype),
                    )  # fmt: skip
                )
        total = sum(len(part[0]) for part in parts)
        room = 1 << 14
        while room < total:
            room *= 8
        kinds = (np.int32, self.dtype, self.dtype, self.dtype, self.dtype)
        fields = []
        for f, kind in enumerate(kinds):
            field = _room((room,), kind)
            if parts:
                field[:total] = np.concatenate([part[f] for part in parts])
            fields.append(field)
        return Segments(*fields)

    def _tiles(
        self,
        events: Events,
        layout: Layout,
        carry: Carry,
        first_frame: int,
        reference: NDArray,
        at_start: NDArray,
    ) -> Tiles:
        """Fill the tiles; `carry` is brought to the window's end in place."""
        clock, dtype, pixels = self.clock, self.dtype, self.pixels
        width, height = self.recording.width, self.recording.height
        order = np.concatenate(layout.lanes)
        first = np.zeros(pixels + 1, np.int64)
        np.cumsum(layout.counts[order], out=first[1:])
        cursor = np.empty(pixels, np.int64)
        cursor[order] = first[:-1]
        room = (max(len(events), self.events),)
        key, near = self._tile_room("key", room, np.int64), self._tile_room("near", room, dtype)
        shape = (layout.room, SLOTS)
        # `_fill` clears what used tiles leave empty, unused tiles are skipped. (Derivatives are
        # taken of all tiles, where nothing but numbers may lie: then memory is fresh, so cleared.)
        floats = [self._tile_room(f"float {i}", shape, dtype) for i in range(4)]
        places = [self._tile_room(f"int {i}", shape, np.int32) for i in range(2)]
        counts = [self._tile_room(f"count {i}", shape, dtype) for i in range(2)]
        polarity = self._tile_room("polarity", shape, np.int8)
        kind = np.full(layout.room, len(SHAPES), np.int32)
        lane = np.zeros(layout.room, np.int32)
        # Room at the end, so that as many lanes as the widest tile has can be cut out anywhere.
        lanes = np.zeros(sum(-(-pixels // w) * w for _, w in SHAPES) + SHAPES[0][1], np.int32)

        breaks = clock.breaks[_first_piece(clock, first_frame) :]
        begins = clock.left[first_frame:]
        # Where a piece begins with its exposure, the counts at its begin are those of the stream.
        aligned = begins == (breaks[::2] if clock.exposed else breaks)
        known = (
            self.origin, self.rho, self.growth, carry.last, at_start, reference, breaks,
            _rate(breaks), clock.mid[first_frame:], _rate(clock.mid[first_frame:]), aligned,
            clock.exposed,
        )  # fmt: skip
        with ThreadPoolExecutor(WORKERS) as pool:
            bands = np.linspace(0, height, WORKERS + 1).astype(int)

            def sort(job: int) -> None:
                _sort(
                    events.t, events.x, events.y, events.p, width, bands[job], bands[job + 1],
                    self.origin, cursor, carry.near, key, near,
                )  # fmt: skip

            list(pool.map(sort, range(WORKERS)))
            begin = offset = 0
            for k, (ranks, across) in enumerate(SHAPES):
                mine = layout.lanes[k]
                blocks = -(-len(mine) // across)
                lanes[offset : offset + len(mine)] = mine
                rounds = layout.round_tile[layout.round_first[k] :]
                part = (
                    ranks, across, mine, first[begin : begin + len(mine) + 1], rounds, k, offset,
                    kind, lane, key, near, *known, *floats, *places, *counts, polarity,
                )  # fmt: skip

                def fill(job: int, jobs: int = blocks * across // 64, part: tuple = part) -> None:
                    _fill(job, WORKERS, jobs, *part)

                list(pool.map(fill, range(WORKERS)))
                begin += len(mine)
                offset += -(-pixels // across) * across
        since, gap, weight, blend = floats
        (cell, level), (on, off) = places, counts
        points = EventPoints(weight, blend, on, off, cell, level)
        return Tiles(lanes, kind, lane, points, since, gap, polarity)


def _rate(breaks: NDArray) -> NDArray:
    """1 / length (1/us) of the stretches between breaks, 0 for empty ones."""
    length = np.diff(breaks)
    return np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)


def time_span(recording: Recording, clock_offset: Any = 0.0) -> tuple[int, int]:
    """The times (us) between which images rest on data.

    They reach from the first event or frame to the last, frames on the events' clock as well as
    stamped.
    """
    late = 0 if recording.frames is None else round(float(clock_offset) * 1e6)
    return recording.start + min(late, 0), recording.stop + max(late, 0)


def prepare(
    recording: Recording,
    times: Times,
    clock_offset: float | int = 0.0,
    exposure: float | int = 0.0,
    rho_ref: float | int = 0.0,
    spread: float | int = 0.0,
    *,
    filtering: bool = True,
) -> tuple[Features, ReadOut]:
    """A whole recording on the device, for `run`, and points of images at `times`, for `read`.

    `times` are sorted, integers in us or floats in s on the recording's clock. `clock_offset`,
    `exposure`, `rho_ref`, `spread` (s, see `Timing`) must be those of the parameters to run with;
    `method.prepare(recording, times, params)` takes them from there. Derivatives with respect to
    `clock_offset` hold between the instants at which an edge of an exposure passes an event, those
    by a positive `rho_ref` are exact, those by the others are 0. Without `filtering` the features
    serve methods that do not pass over single events. Raises `InputError` for times that are not
    sorted.

        features, out = prepare(recording, times)
        trajectory, _ = akf.run(params, features)
        image, variance = akf.read(params, trajectory, out)  # (times, pixels)
    """
    times = np.atleast_1d(microseconds(times))
    if (times[1:] < times[:-1]).any():
        raise InputError("the times of images to prepare are not sorted; sort them")
    timing = Timing(*(round(float(v), 8) for v in (clock_offset, exposure, rho_ref, spread)))

    def made(growth: bool) -> tuple[Features, ReadOut]:
        windows = Windows(recording, timing, filtering=filtering, growth=growth)
        window = windows.whole()
        assert window.features is not None
        return window.features, window.reader(len(times), windows.dtype)(times, growth)

    features, out = made(False)
    if timing.rho_ref:
        rho = np.asarray(timing.rho_ref, features.frames.grey.dtype)
        features, out = (
            eqx.tree_at(
                lambda v: v.growth, value, Growth(by.counts(), rho), is_leaf=lambda v: v is None
            )
            for value, by in zip((features, out), made(True), strict=True)
        )
    return jax.device_put((features, out))


@compiled
def _count(x, y, width, pixels):
    counts = np.zeros(pixels, np.int32)
    for i in range(len(x)):
        counts[np.int64(y[i]) * width + x[i]] += 1
    return counts


@compiled
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


@compiled
def _stands_for(gap, rho, growth):
    """How many events one after the gap (us) at its pixel stands for; `growth`: d / d rho, 1/s."""
    if rho == 0:
        return 1.0
    if gap <= 1.5 * rho:
        return 0.0 if growth else 3.0
    rest = gap - rho
    return 1e6 * gap / (rest * rest) if growth else gap / rest


@compiled
def _latest(t, x, y, width, last):
    for i in range(len(t)):
        last[np.int64(y[i]) * width + x[i]] = t[i]


@compiled
def _weights(t, x, y, width, last, rho, growth):
    """What each event stands for; `last` holds the times of the events before, at each pixel."""
    out = np.empty(len(t), np.float64)
    for i in range(len(t)):
        pixel = np.int64(y[i]) * width + x[i]
        out[i] = _stands_for(t[i] - last[pixel], rho, growth)
        last[pixel] = t[i]
    return out


@compiled
def _snapshots(t, x, y, p, weight, edges, width, now):
    """ON and OFF events of each pixel earlier than each edge: [edges, 2, pixels]."""
    out = np.zeros((len(edges), 2, now.shape[1]), now.dtype)
    if len(edges) == 0:
        return out
    i = 0
    for e in range(len(edges)):
        while i < len(t) and t[i] < edges[e]:
            now[0 if p[i] else 1, np.int64(y[i]) * width + x[i]] += weight[i]
            i += 1
        out[e] = now
    return out


@compiled
def _spread(t, x, y, p, weight, edges, width, origin, reach, out):
    """Add to the counts at each edge the part of the pixel's next event that has happened."""
    last = np.full(out.shape[2], origin)
    for i in range(len(t)):
        pixel = np.int64(y[i]) * width + x[i]
        before, last[pixel] = last[pixel], t[i]
        gap = t[i] - before
        if before > origin and 0 < gap <= reach:
            e = np.searchsorted(edges, before, "right")
            while e < len(edges) and edges[e] <= t[i]:
                out[e, 0 if p[i] else 1, pixel] += weight[i] * (edges[e] - before) / gap
                e += 1


@compiled
def _exposure(t, x, y, p, weight, middle, row, edges, width, count):
    """Segments of constant brightness within one exposure; events `middle` on lie after its mid."""
    n, pixels = len(t), count.shape[1]
    length = edges[2] - edges[0]
    cell = np.empty(n, np.int64)
    share, edge = np.zeros(n), np.zeros(n)
    on, off = np.zeros(n), np.zeros(n)
    for i in range(n):
        cell[i] = row * pixels + np.int64(y[i]) * width + x[i]
    bound = np.full(pixels, edges[0])
    for i in range(middle):  # from the previous event to this one
        pixel = cell[i] - row * pixels
        share[i] = (t[i] - bound[pixel]) / length
        if bound[pixel] == edges[0]:
            edge[i] = -1e6 / length
        bound[pixel] = t[i]
    for i in range(middle - 1, -1, -1):
        pixel = cell[i] - row * pixels
        count[0 if p[i] else 1, pixel] -= weight[i]
        on[i], off[i] = count[0, pixel], count[1, pixel]
    count[:] = 0
    bound[:] = edges[2]
    for i in range(n - 1, middle - 1, -1):  # from this event to the next one
        pixel = cell[i] - row * pixels
        share[i] = (bound[pixel] - t[i]) / length
        if bound[pixel] == edges[2]:
            edge[i] = 1e6 / length
        bound[pixel] = t[i]
    for i in range(middle, n):
        pixel = cell[i] - row * pixels
        count[0 if p[i] else 1, pixel] += weight[i]
        on[i], off[i] = count[0, pixel], count[1, pixel]
    return cell, share, edge, on, off


@compiled
def _sort(t, x, y, p, width, top, bottom, origin, cursor, latest, key, near):
    """Events into pixel order, with the time since the 3x3 neighbourhood's previous event.

    Serves the rows top <= y < bottom, so that several can work side by side. Writing an event's
    time to the nine pixels that it neighbours replaces a search over nine: the stream is sorted,
    so the latest write is the maximum.
    """
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


@compiled
def _fill(
    first_job, step, jobs, ranks, width, lanes, first, round_tile, shape, offset, kind, lane_of,
    key, gap, origin, rho, growth, last, at_start, reference, breaks, piece_rate, mids,
    level_rate, aligned, exposed, since, near, weight, blend, cell, level, on, off, polarity,
):  # fmt: skip
    """Write the slots of 64 lanes at a time: 64 sequential streams in, whole cache lines out."""
    lane_count = len(lanes)
    pixels = at_start.shape[1]
    piece_at = np.empty(64, np.int64)
    level_at = np.empty(64, np.int64)
    count_on, count_off = np.empty(64, at_start.dtype), np.empty(64, at_start.dtype)
    own_on, own_off = np.empty(64, at_start.dtype), np.empty(64, at_start.dtype)
    before = np.empty(64, np.int64)
    pieces, frames = len(breaks), len(mids)
    for job in range(first_job, jobs, step):
        b = job * 64 // width
        lane0 = job * 64
        head = first[b * width + 1] - first[b * width]
        rounds = (head + ranks - 1) // ranks
        for k in range(min(64, lane_count - lane0)):
            pixel = lanes[lane0 + k]
            piece_at[k] = -1
            level_at[k] = -1
            count_on[k], count_off[k] = at_start[0, pixel], at_start[1, pixel]
            before[k] = last[pixel] - origin
        for rank in range(rounds * ranks):
            tile = round_tile[rank // ranks] + b
            if rank % ranks == 0:
                kind[tile] = shape
                lane_of[tile] = offset + b * width
            base = rank % ranks * width + lane0 - b * width
            for k in range(64):
                slot = base + k
                lane = lane0 + k
                if lane >= lane_count or rank >= first[lane + 1] - first[lane]:
                    since[tile, slot] = near[tile, slot] = 0
                    weight[tile, slot] = blend[tile, slot] = 0
                    cell[tile, slot] = level[tile, slot] = 0
                    on[tile, slot] = off[tile, slot] = 0
                    polarity[tile, slot] = 0
                    continue
                pixel = lanes[lane]
                event = first[lane] + rank
                now = key[event] >> 1
                up = key[event] & 1
                piece = piece_at[k]
                if piece < 0 or (piece < pieces and breaks[piece] <= now):
                    fresh = piece < 0  # the window may start in the middle of a piece
                    own = (piece - 1) // 2 if exposed else piece - 1
                    piece = max(piece, 0)
                    while piece < pieces and breaks[piece] <= now:
                        piece += 1
                    piece_at[k] = piece
                    new = (piece - 1) // 2 if exposed else piece - 1
                    if new < 0:
                        own_on[k], own_off[k] = at_start[0, pixel], at_start[1, pixel]
                    elif fresh or not aligned[new]:
                        own_on[k], own_off[k] = reference[new, 0, pixel], reference[new, 1, pixel]
                    elif new != own:
                        own_on[k], own_off[k] = count_on[k], count_off[k]
                frame = level_at[k]
                while frame + 1 < frames and mids[frame + 1] <= now:
                    frame += 1
                level_at[k] = frame
                since[tile, slot] = (now - before[k]) * 1e-6
                events = _stands_for(now - before[k], rho, growth)
                before[k] = now
                near[tile, slot] = gap[event]
                w = 0.0
                if piece > 0 and piece < pieces:
                    w = (now - breaks[piece - 1]) * piece_rate[piece - 1]
                weight[tile, slot] = w
                g = 0.0
                if frame >= 0 and frame + 1 < frames:
                    g = (now - mids[frame]) * level_rate[frame]
                blend[tile, slot] = g
                cell[tile, slot] = piece * pixels + pixel
                level[tile, slot] = max(frame, 0) * pixels + pixel
                on[tile, slot] = count_on[k] - own_on[k]
                off[tile, slot] = count_off[k] - own_off[k]
                if up:
                    count_on[k] += events
                else:
                    count_off[k] += events
                polarity[tile, slot] = 2 * up - 1
        for k in range(min(64, lane_count - lane0)):
            last[lanes[lane0 + k]] = before[k] + origin


@compiled
def _read(
    t, x, y, p, own_events, origin, reach, width, row, filtering, times, frame, reference,
    at_start, count, last, at, rank, kind, lane, round_tile, round_first, shapes, rho, growth,
    slot, since, on, off,
):  # fmt: skip
    """At each time, every pixel's last slot, the time since, and its counts in the piece."""
    pixels = len(last)
    seen = np.full(pixels, -1)
    for j in range(len(times)):
        while row < own_events and t[row] <= times[j]:
            pixel = np.int64(y[row]) * width + x[row]
            count[0 if p[row] else 1, pixel] += _stands_for(t[row] - last[pixel], rho, growth)
            last[pixel] = t[row]
            if filtering:
                k = kind[pixel]
                ranks, lanes = shapes[k, 0], shapes[k, 1]
                r = rank[pixel]
                rank[pixel] = r + 1
                tile = round_tile[round_first[k] + r // ranks] + lane[pixel] // lanes
                at[pixel] = tile * SLOTS + r % ranks * lanes + lane[pixel] % lanes
            row += 1
        own = reference[frame[j]] if frame[j] >= 0 else at_start
        for pixel in range(pixels):
            slot[j, pixel] = at[pixel]
            since[j, pixel] = max(times[j] - last[pixel], 0) * 1e-6
            on[j, pixel] = count[0, pixel] - own[0, pixel]
            off[j, pixel] = count[1, pixel] - own[1, pixel]
        after = row
        while after < len(t) and t[after] <= times[j] + reach:
            pixel = np.int64(y[after]) * width + x[after]
            gap = t[after] - last[pixel]
            if seen[pixel] != j and last[pixel] > origin and 0 < gap <= reach:
                part = _stands_for(gap, rho, growth) * (times[j] - last[pixel]) / gap
                if p[after]:
                    on[j, pixel] += part
                else:
                    off[j, pixel] += part
            seen[pixel] = j
            after += 1
    return row


def _room(shape: tuple[int, ...], dtype: Any, empty: bool = False) -> NDArray:
    """An array whose data start at a multiple of 64 bytes, which XLA takes without a copy."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    # Large arrays all begin at the same place of a memory page. Written side by side they would
    # share one set of the cache; every array begins some lines further than the one before.
    stagger = 64 * (next(_count_rooms) * 5 % 64)
    memory = (np.empty if empty else np.zeros)(size + stagger + 64, np.uint8)
    begin = -memory.ctypes.data % 64 + stagger
    return memory[begin : begin + size].view(dtype).reshape(shape)
