"""Windows prepared on the device: an event goes over the bus as eight bytes, an image as its time.

The host says which events and frames a window has and which lanes its pixels take (`layout`). The
device sorts the events by pixel. What the loops of `tiles`, `stream` and `reading` find by walking
through the stream is found there by bisection in the events of a pixel: how many happened before a
time, and which was the last of a neighbour. The results are those of the loops but for the rounding
of times. This serves GPUs; on CPUs the loops are faster.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.reconstruction.clock import Clock, Timing, rates
from jaxevent.reconstruction.features import (
    EventPoints,
    Features,
    FrameFeatures,
    Numeric,
    ReadOut,
    Tiles,
)
from jaxevent.reconstruction.frames import gathered, make_segments, make_start
from jaxevent.reconstruction.layout import SHAPES, SLOTS, Layout
from jaxevent.reconstruction.reading import Placed, padded
from jaxevent.reconstruction.stream import BaseCounts, EdgeCounts, StreamState, narrow, note_latest
from jaxevent.reconstruction.windows import EventWindow, WindowedRecording, WindowEvents

FARTHEST = 1 << 30  # us from a window's first event that times may lie: sums fit in 32 bits
NEVER = np.iinfo(np.int32).max


class PixelEvents(eqx.Module):
    """Events in the order of their pixels and, at each, of time; times are us from a common base.

    Spare entries lie behind all pixels.
    """

    t: Int[Array, " events"]
    row: Int[Array, " events"]  # place in the stream
    pixel: Int[Array, " events"]
    up: Int[Array, " events"]  # 1 of ON events, 0 of OFF events
    first: Int[Array, " pixels_and_one"]  # where each pixel's events begin
    ons: Int[Array, " events_and_one"]  # ON events among all before a place

    @classmethod
    def of(cls, t: Array, cell: Array, pixels: int) -> "PixelEvents":
        """From the stream: times, and 2 pixel + (1 if ON); 2 pixels for spare entries."""
        order = jnp.argsort(cell >> 1, stable=True).astype(jnp.int32)
        cell = cell[order]
        pixel, up = cell >> 1, cell & 1
        first = jnp.searchsorted(pixel, jnp.arange(pixels + 1, dtype=jnp.int32)).astype(jnp.int32)
        ons = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(up, dtype=jnp.int32)])
        return cls(t[order], order, pixel, up, first, ons)

    def before(self, time: Array) -> Array:
        """Where each pixel's events end that are earlier than a time, (pixels,)."""
        return _bisect(self.t, self.first[:-1], self.first[1:], time)

    def counts(self, end: Array) -> Array:
        """ON and OFF events of each pixel up to a place among its own, (2, pixels)."""
        begin = self.first[:-1]
        on = self.ons[end] - self.ons[begin]
        return jnp.stack([on, end - begin - on])


def _bisect(values: Array, begin: Array, end: Array, least: Array) -> Array:
    """The first place from begin to end whose value is not below `least`, else end."""

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, end = bounds
        middle = (begin + end) // 2
        below = (begin < end) & (values.at[middle].get(mode="clip") < least)
        return jnp.where(below, middle + 1, begin), jnp.where(below, end, middle)

    steps = int(values.shape[0]).bit_length()
    return lax.fori_loop(0, steps, halve, (begin, jnp.maximum(begin, end)))[0]


class Instants(eqx.Module):
    """Sorted times of the frames in us from the base: whole ones, what they round up, and rates."""

    whole: Int[Array, " times"]  # rounded up: a time in us is at or after both or neither
    excess: Array  # us
    rate: Array  # 1/s to the next one, 0 after the last

    @classmethod
    def of(cls, times: NDArray, base: int, room: int, dtype: np.dtype) -> "Instants":
        """With room for some more, which never come."""
        whole = np.full(room, NEVER, np.int32)
        excess, rate = np.zeros(room, dtype), np.zeros(room, dtype)
        up = np.ceil(times - base)
        whole[: len(times)], excess[: len(times)] = up, up - (times - base)
        rate[: max(len(times) - 1, 0)] = 1e6 * rates(times)
        return cls(jnp.asarray(whole), jnp.asarray(excess), jnp.asarray(rate))

    def reached(self, t: Array) -> Array:
        """How many are at or before times."""
        return jnp.searchsorted(self.whole, t, side="right").astype(jnp.int32)

    def position(self, t: Array) -> Array:
        """How far times lie between the last one and the next, 0 outside."""
        last = jnp.maximum(self.reached(t) - 1, 0)
        elapsed = (t - self.whole[last]).astype(self.excess.dtype) + self.excess[last]
        inside = t >= self.whole[0]
        return jnp.where(inside, elapsed * 1e-6 * self.rate[last], 0)


class SlotTable(eqx.Module):
    """Where the events of pixels lie in tiles, by rank (`layout.Layout`)."""

    kind: Int[Array, " pixels"]
    lane: Int[Array, " pixels"]
    round_first: Int[Array, " kinds"]
    round_tile: Int[Array, " rounds"]

    @classmethod
    def of(cls, layout: Layout) -> "SlotTable":
        """With room for a power of two of rounds, so that few programs are compiled."""
        rounds = np.zeros(max(64, 1 << (len(layout.round_tile) - 1).bit_length()), np.int32)
        rounds[: len(layout.round_tile)] = layout.round_tile
        first = np.asarray(layout.round_first, np.int32)
        return cls(*map(jnp.asarray, (layout.kind, layout.lane, first, rounds)))

    def slot(self, pixel: Array, rank: Array) -> Array:
        """The slot of pixels' events."""
        shapes = jnp.asarray(SHAPES, jnp.int32)
        kind, lane = self.kind[pixel].astype(jnp.int32), self.lane[pixel]
        ranks, width = shapes[kind, 0], shapes[kind, 1]
        tile = self.round_tile[self.round_first[kind] + rank // ranks] + lane // width
        return tile * SLOTS + rank % ranks * width + lane % width


class OwnEvents(eqx.Module):
    """The window's own among its events and those around it, and what was before them."""

    begin: Int[Numeric, ""]  # rows of the stream
    end: Int[Numeric, ""]
    last: Int[Numeric, " pixels"]  # us, of each pixel's last event before the window

    def places(self, events: PixelEvents) -> tuple[Array, Array]:
        """Where each pixel's own events begin and end."""
        ends = events.first[:-1], events.first[1:]
        return _bisect(events.row, *ends, self.begin), _bisect(events.row, *ends, self.end)


@jax.jit
def _count(events: PixelEvents, edges: Array) -> Array:
    """ON and OFF events of each pixel earlier than each edge, (edges, 2, pixels)."""
    return jax.vmap(lambda edge: events.counts(events.before(edge)))(edges)


@functools.partial(jax.jit, static_argnames=("width", "exposed", "room", "dtype"))
def _fill(
    events: PixelEvents,
    own: OwnEvents,
    table: SlotTable,
    base: Array,
    breaks: Instants,
    mids: Instants,
    width: int,
    exposed: bool,
    room: int,
    dtype: np.dtype,
) -> dict[str, Array]:
    """The arrays (room, slots) of tiles; `base` (frames + 1, 2, pixels) are the pieces' counts."""
    pixels = events.first.shape[0] - 1
    begin, _ = own.places(events)
    pixel = jnp.minimum(events.pixel, pixels - 1)
    place = jnp.arange(events.t.shape[0], dtype=jnp.int32)
    mine = (events.row >= own.begin) & (events.row < own.end) & (events.pixel < pixels)
    rank = place - begin[pixel]
    slot = jnp.where(mine, table.slot(pixel, jnp.maximum(rank, 0)), room * SLOTS)

    before = jnp.where(rank > 0, events.t.at[place - 1].get(mode="clip"), own.last[pixel])
    latest = _neighbourhood(own.last.reshape(-1, width)).reshape(-1)[pixel]
    y, x = pixel // width, pixel % width
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            inside = (0 <= y + dy) & (y + dy < pixels // width) & (0 <= x + dx) & (x + dx < width)
            other = jnp.where(inside, pixel + dy * width + dx, pixel)
            found = _bisect(events.row, begin[other], events.first[other + 1], events.row)
            seen = inside & (found > begin[other])
            at = events.t.at[found - 1].get(mode="clip")
            latest = jnp.where(seen, jnp.maximum(latest, at), latest)

    piece, frame = breaks.reached(events.t), mids.reached(events.t) - 1
    counted = jnp.stack([events.ons[place], place - events.ons[place]])
    start = events.first[pixel]
    counted -= jnp.stack([events.ons[start], start - events.ons[start]])
    row = jnp.maximum((piece - 1) // 2 if exposed else piece - 1, -1) + 1
    on, off = counted - base[row, :, pixel].T

    def seconds(t: Array) -> Array:
        return t.astype(dtype) * 1e-6

    fields = {
        "since": seconds(events.t - before),
        "near": seconds(events.t - latest),
        "weight": breaks.position(events.t),
        "blend": mids.position(events.t),
        "piece_cell": piece * pixels + pixel,
        "frame_cell": jnp.maximum(frame, 0) * pixels + pixel,
        "on": on.astype(dtype),
        "off": off.astype(dtype),
        "polarity": (2 * events.up - 1).astype(jnp.int8),
    }

    def put(values: Array) -> Array:
        empty = jnp.zeros(room * SLOTS, values.dtype)
        return empty.at[slot].set(values, mode="drop").reshape(room, SLOTS)

    return {name: put(values) for name, values in fields.items()}


def _neighbourhood(last: Array) -> Array:
    """The latest of 3x3 neighbours, of images of whole numbers."""
    least = np.array(np.iinfo(last.dtype).min, last.dtype)
    return lax.reduce_window(last, least, lax.max, (3, 3), (1, 1), "SAME")


@functools.partial(jax.jit, static_argnames=("dtype",))
def _read(
    events: PixelEvents,
    own: OwnEvents,
    table: SlotTable | None,
    base: Array,
    times: Array,
    rows: Array,
    dtype: np.dtype,
) -> dict[str, Array]:
    """What images (times, pixels) need; `rows` say which counts of `base` their pieces have."""
    begin, stop = own.places(events)
    pixel = jnp.arange(begin.shape[0], dtype=jnp.int32)

    def one(time: Array, row: Array) -> dict[str, Array]:
        end = _bisect(events.t, begin, stop, time + 1)
        any_yet = end > begin
        last = jnp.where(any_yet, events.t.at[end - 1].get(mode="clip"), own.last)
        on, off = events.counts(end) - base[row]
        slot = jnp.full_like(pixel, -1)
        if table is not None:
            slot = jnp.where(any_yet, table.slot(pixel, jnp.maximum(end - begin - 1, 0)), -1)
        since = jnp.maximum(time - last, 0).astype(dtype) * 1e-6
        return {"slot": slot, "since": since, "on": on.astype(dtype), "off": off.astype(dtype)}

    return jax.vmap(one)(times, rows)


@dataclasses.dataclass(frozen=True)
class DeviceBasis:
    """What is read of a window that lies on the device; as `reading.ReadingBasis`."""

    sorted: PixelEvents
    own: OwnEvents
    table: SlotTable | None
    base: Array  # (frames + 1, 2, pixels), counts at the window's start and the left edges
    base_time: int  # us
    events: int
    clock: Clock
    first_frame: int
    dtype: np.dtype

    def reader(self, room: int) -> "DeviceReader":
        """Reads images, at most `room` at a time."""
        return DeviceReader(self, room)


class DeviceReader:
    """Says where images lie among a window's events; as `reading.Reader`."""

    def __init__(self, basis: DeviceBasis, room: int):
        self._basis, self._room = basis, room

    def __call__(self, times: NDArray[np.int64], growth: bool = False) -> ReadOut:
        """Images at sorted times (us) inside the window, padded to the room."""
        basis, room = self._basis, self._room
        at = Placed.of(basis.clock, basis.first_frame, times)
        whole = np.clip(times - basis.base_time, -FARTHEST, FARTHEST)
        made = _read(
            basis.sorted, basis.own, basis.table, basis.base, padded(whole, room, np.int32),
            padded(at.exposure + 1, room, np.int32), basis.dtype,
        )  # fmt: skip
        points = at.points(room, basis.dtype, made["on"], made["off"])
        return ReadOut(points, made["slot"], made["since"])


class DeviceWindows(WindowedRecording):
    """Windows prepared on the device; the host prepares what times of 32 bits cannot tell."""

    @staticmethod
    def serves(timing: Timing) -> bool:
        """Whether events are counted whole and at once: without dead time and spread."""
        return timing.rho_ref == 0 and timing.spread == 0

    def _window(
        self,
        start: int | None,
        stop: int | None,
        events: WindowEvents,
        layout: Layout | None,
        before: StreamState,
    ) -> tuple[EventWindow, Features]:
        around, clock, used = events.around, self.clock, self.clock.used(start, stop)
        base_time = int(around.t[0]) if len(around) else self.recording.start
        pieces = 2 if clock.exposed else 1
        breaks = clock.breaks[clock.first_piece(used.start) :][: pieces * (used.stop - used.start)]
        times = [clock.edges(used)[0], before.last, around.t[-1:], breaks + clock.origin]
        if any(len(t) and np.abs(t - base_time).max() >= FARTHEST for t in times):
            return super()._window(start, stop, events, layout, before)

        placed = self._upload(around, base_time)
        begin = 0 if start is None else around.index(start)
        begin, end = (np.asarray(row, np.int32) for row in (begin, begin + len(events.own)))
        own = OwnEvents(begin, end, (before.last - base_time).astype(np.int32))
        edges = self._edges(start, used, base_time)
        counted = _count(placed, jnp.asarray(edges))
        base = counted[: 1 + self.frames]
        origin = base_time - clock.origin
        instants = (
            Instants.of(breaks, origin, 2 * self.frames + 2, self.dtype),
            Instants.of(clock.mid[used], origin, self.frames + 2, self.dtype),
        )
        tiles, table, slots = None, None, np.full(self.pixels, -1, np.int32)
        if layout is not None:
            table, slots = SlotTable.of(layout), layout.slots()
            made = _fill(
                placed, own, table, base, *instants,
                self.recording.width, clock.exposed, layout.room, self.dtype,
            )  # fmt: skip
            tiles = self._tiles(layout, made)
        frames = self._frame_features(stop, used, counted, events, before)
        after = self._after(events, before, used)
        basis = DeviceBasis(
            placed, own, table, base, base_time, len(events.own), clock, used.start, self.dtype
        )
        features = Features(frames, tiles, make_start(clock, self.pixels, self.dtype), slots)
        return EventWindow(start, stop, after, basis), jax.device_put(features)

    def _upload(self, around: Any, base_time: int) -> PixelEvents:
        """The events on the device, with room from a ladder of steps by a quarter."""
        room = 1 << 12
        while room < len(around):
            room += room // 4
        t, cell = np.full(room, NEVER, np.int32), np.full(room, 2 * self.pixels, np.int32)
        narrow(self._stream(around), base_time, t, cell)
        return _sorted(jnp.asarray(t), jnp.asarray(cell), self.pixels)

    def _edges(self, start: int | None, used: slice, base_time: int) -> NDArray[np.int32]:
        """The window's start, and the left, middle and right edges of exposures, each with room."""
        out = np.full((3, self.frames), NEVER, np.int32)
        for row, edges in zip(out, self.clock.edges(used), strict=True):
            row[: len(edges)] = np.clip(edges - base_time, -FARTHEST, FARTHEST)
        opening = -FARTHEST if start is None else start - base_time
        return np.concatenate([[opening], out.ravel()]).astype(np.int32)

    def _tiles(self, layout: Layout, made: dict[str, Array]) -> Tiles:
        kind, lane = layout.tiles()
        names = ("weight", "blend", "on", "off", "piece_cell", "frame_cell")
        points = EventPoints(*(made[name] for name in names))
        return Tiles(
            layout.lane_pixels(), kind, lane, points, made["since"], made["near"], made["polarity"]
        )

    def _frame_features(
        self,
        stop: int | None,
        used: slice,
        counted: Array,
        events: WindowEvents,
        before: StreamState,
    ) -> FrameFeatures:
        clock, images, n = self.clock, self._images, max(used.stop - used.start, 0)
        left, mid, right = jnp.split(counted[1:], 3)
        span, first, inside = _between(
            counted[0], left, mid, right, n, used.start == 0, clock.exposed, self.dtype
        )
        head, tail = inside if inside is not None else (None, None)
        segments = None
        if clock.exposed:
            none = np.zeros((2, self.pixels), np.int32)
            edges = EdgeCounts(BaseCounts(none, none), none, none)  # only their shape is used
            weight = np.ones(len(events.around), np.int8)
            segments = make_segments(
                clock, used, self._stream(events.around), weight, edges, self.dtype
            )
        looked = images.read_on_device(used, self.frames)
        between = (span, first, head, tail)
        rows = self._frame_rows(stop, used, before)
        return gathered(images, clock, used, rows, looked, between, segments)

    def _after(self, events: WindowEvents, before: StreamState, used: slice) -> StreamState:
        after = before.copy()
        after.frames = max(used.stop, 1)
        note_latest(self._stream(events.own), after.last)
        image = after.last.reshape(self.recording.height, self.recording.width)
        after.near = np.pad(ndimage.maximum_filter(image, 3, mode="nearest"), 1).ravel()
        return after


@functools.partial(jax.jit, static_argnums=2)
def _sorted(t: Array, cell: Array, pixels: int) -> PixelEvents:
    return PixelEvents.of(t, cell, pixels)


@functools.partial(jax.jit, static_argnames=("first", "exposed", "dtype"))
def _between(
    start: Array, left: Array, mid: Array, right: Array, n: Any, first: bool, exposed: bool,
    dtype: np.dtype,
) -> tuple[Array, Array, tuple[Array, Array] | None]:  # fmt: skip
    """Counts between the edges of frames, [2, frames, pixels], 0 in spare rows."""
    row = jnp.arange(left.shape[0])[:, None, None]

    def rows(counts: Array, number: Any) -> Array:
        return jnp.where(row < number, counts, 0).swapaxes(0, 1).astype(dtype)

    span = rows(jnp.roll(right, -1, 0) - left, n - 1)
    before = jnp.where(n > 0, right[0] - (start if first else 0), 0).astype(dtype)
    inside = (rows(mid - left, n), rows(right - mid, n)) if exposed else None
    return span, before, inside
