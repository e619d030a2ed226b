"""A recording prepared window by window, or whole: from a stream of events to features.

A per-pixel filter is a ragged array of short scans. The events of a time window are sorted by pixel
(counting sort) and laid out in tiles (`layout`, `tiles`), with what the frames around them tell
(`clock`, `frames`). A recording is prepared whole (`prepare`, for tuning) or in windows with
carried state (`WindowedRecording`, for reading out video at constant memory); the result does not
depend on the choice.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc
from jaxevent.errors import InputError
from jaxevent.reconstruction.features import (
    SLOTS,
    DeadTimeDerivative,
    Features,
    ImagePoints,
    ReadOut,
    aligned,
)
from jaxevent.reconstruction.frames import (
    Clock,
    FrameImages,
    Timing,
    make_frame_features,
    make_segments,
    make_start,
)
from jaxevent.reconstruction.stream import (
    BaseCounts,
    DeadTime,
    EdgeCounts,
    Stream,
    StreamState,
    add_spread,
    count_before,
    count_events,
    equivalent,
    note_latest,
    weigh,
)
from jaxevent.reconstruction.tiles import Layout, SlotMap, TileMemory, make_tiles
from jaxevent.recording import Events, Recording, Times, microseconds


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


WINDOW_EVENTS = 1 << 20


@dataclasses.dataclass(frozen=True)
class EventWindow:
    """Events with start <= t < stop (us; None: unbounded), prepared for reading."""

    start: int | None
    stop: int | None
    after: StreamState
    basis: Basis

    @property
    def events(self) -> int:
        """How many events it has."""
        return self.basis.events

    def reader(self, room: int) -> ImageReader:
        """Reads its images, at most `room` at a time."""
        return self.basis.reader(room)


@dataclasses.dataclass(frozen=True)
class WindowEvents:
    """The events of a window and, as parts of one array, those around it that tell of it."""

    own: Events
    ahead: Events  # its own and, where changes are spread, those soon after
    around: Events  # those of all its frames' exposures too


class WindowedRecording:
    """Cuts a recording into time windows and prepares them: iterates over windows and features.

    `events` bounds a window's events; `filtering=False` prepares what reading frames and event
    counts needs, without tiles; with `growth` counts are derivatives by the dead time. With
    `reuse` a window's tiles are written over the last one's (`TileMemory`). Only for who is done
    with one window before asking for the next.
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
        self._timing = timing
        self.clock = Clock.of(recording, timing)
        self.dead = DeadTime(round(timing.rho_ref * 1e8) / 100, growth)
        self.reach = 0 if filtering else round(timing.spread * 1e6)
        # Whole events are counted in integers, weighted and spread ones in double precision.
        self.count_dtype = np.dtype(np.float64 if self.dead.rho or self.reach else np.int32)
        self.pixels = recording.width * recording.height
        # Room for frames depends on the sensor only, to compile once: 16 frames of tables are
        # 60 MB at 346x260; larger sensors get fewer.
        self.frames = max(6, min(16, 6_000_000 // self.pixels))
        self.dtype = np.dtype(jnp.result_type(float))
        self._images = FrameImages(recording, self.dtype)
        self._memory = TileMemory(reuse, self.dtype)

    def __iter__(self) -> Iterator[tuple[EventWindow, Features]]:
        before, start = self.initial(), None
        while True:
            window, features = self.prepare(start, before)
            yield window, features
            if window.stop is None:
                return
            before, start = window.after, window.stop

    def initial(self) -> StreamState:
        """The state before the first window."""
        return StreamState.initial(self.recording, self.dead.rho > 0)

    def prepare(self, start: int | None, before: StreamState) -> tuple[EventWindow, Features]:
        """The window that begins at `start`, shorter if its events are very unevenly spread."""
        stop = self.stop_after(start)
        source = self.recording.events
        begin = 0 if start is None else source.index(start)
        end = len(source) if stop is None else source.index(stop)
        context, finish = self.context_of(self.clock.used(start, stop), begin, end)
        if self.reach and stop is not None:
            finish = max(finish, source.index(stop + self.reach))
        around = source[context:finish]
        if before.last_then is not None:
            before = self.move_context(before, context)
        own = around[begin - context : end - context]
        while True:
            layout = self._layout(own)
            middle = int(own.t[len(own) // 2]) if len(own) else 0
            if layout is None or layout.ordinary or len(own) < 2 or middle == own.t[0]:
                ahead = around[begin - context :]
                ahead = ahead[: len(ahead) if stop is None else ahead.index(stop + self.reach)]
                events = WindowEvents(own, ahead, around)
                return self._window(start, stop, events, layout, before)
            stop = middle
            own = own[: own.index(stop)]

    def grow(self, recording: Recording) -> None:
        """Go on with the same recording of which more is known, after its end."""
        self.recording = recording
        self.clock = Clock.of(recording, self._timing)
        self._images = FrameImages(recording, self.dtype)

    def final(self, frames: bool) -> float:
        """The time (us) up to which windows stay as they are if more is added after the end.

        A window that ends in the exposure of frame k uses frame k + 1 and the events of its
        exposure. With `frames` more of these will come.
        """
        source = self.recording.events
        last = int(source[len(source) - 1 :].t[0]) - self.reach if len(source) else -np.inf
        if not frames:
            return float(last)
        # Events before `last` are known.
        known = np.maximum.accumulate(self.clock.right) + self.clock.origin <= last
        complete = int(np.argmin(known)) if not known.all() else len(known)
        return float(self.clock.left[complete - 2] + self.clock.origin) if complete > 1 else -np.inf

    def needed(self, start: int | None, before: StreamState) -> tuple[int, int]:
        """The first row of the events and the first frame that windows from `start` on use."""
        used = self.clock.used(start, None)
        begin = 0 if start is None else self.recording.events.index(start)
        row, _ = self.context_of(used, begin, begin)
        if before.last_then is not None:
            row = min(row, before.context)
        return row, used.start

    def whole(self) -> tuple[EventWindow, Features]:
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
        same = WindowEvents(events, events, events)
        return self._window(None, None, same, layout, self.initial())

    def stop_after(self, start: int | None) -> int | None:
        """Where the window that starts at `start` should end; None: at the recording's end."""
        stops = []
        clock, source = self.clock, self.recording.events
        at = -np.inf if start is None else start - clock.origin
        piece = int(np.searchsorted(clock.breaks, at, "right"))
        # A window uses the frame before its first piece's and the one after its last piece's.
        last = max(clock.frame(piece) - 1, 0) + self.frames - 2
        if last < len(clock):
            stop = clock.breaks[2 * last if clock.exposed else last]
            stops.append(clock.origin + int(np.ceil(stop)))
        first = 0 if start is None else source.index(start)
        if first + self.events < len(source):
            row = first + self.events
            stop = int(source[row : row + 1].t[0])
            if source.index(stop) <= first:  # a burst at one instant is not divided
                stop += 1
            if stop <= self.recording.stop:
                stops.append(stop)
        return min(stops, default=None)

    def context_of(self, used: slice, begin: int, end: int) -> tuple[int, int]:
        """The rows of the events in the frames' exposures and from begin to end."""
        if used.start < used.stop:
            # Of overlapping exposures, a later one may begin or an earlier one end further out.
            left, _, right = self.clock.edges(used)
            source = self.recording.events
            begin = min(begin, source.index(int(left.min()) - self.reach))
            end = max(end, source.index(int(right.max()) + self.reach))
        return begin, end

    def move_context(self, state: StreamState, context: int) -> StreamState:
        """The same, with each pixel's last event before the row `context`."""
        last, row = state.last_then, state.context
        assert last is not None
        if row > context:
            first = self.initial()
            last, row = first.last, 0
        last = last.copy()
        while row < context:
            part = self.recording.events[row : min(row + WINDOW_EVENTS, context)]
            note_latest(self._stream(part), last)
            row += len(part)
        return dataclasses.replace(state, context=context, last_then=last)

    def _stream(self, events: Events) -> Stream:
        return Stream.of(events, self.recording.width)

    def _layout(self, events: Events) -> Layout | None:
        if not self.filtering:
            return None
        counts = count_events(events.x, events.y, self.recording.width, self.pixels)
        return Layout.of(counts, self.events)

    def _window(
        self,
        start: int | None,
        stop: int | None,
        events: WindowEvents,
        layout: Layout | None,
        before: StreamState,
    ) -> tuple[EventWindow, Features]:
        used = self.clock.used(start, stop)
        weight, counts = self._count(start, used, events.around, before)
        segments = None
        if self.clock.exposed:
            segments = make_segments(
                self.clock, used, self._stream(events.around), weight, counts, self.dtype
            )
        rows = self._frame_rows(stop, used, before)
        frames = make_frame_features(
            self._images, self.clock, used, rows, self.frames, counts, segments
        )
        after, own = before.copy(), self._stream(events.own)
        after.frames = max(used.stop, 1)
        if layout is None:
            tiles, slots, slot_map = None, np.full(self.pixels, -1, np.int32), None
            note_latest(own, after.last)
        else:
            slots, slot_map = layout.slots(), layout.slot_map()
            times = self.clock.times_from(used.start)
            tiles = make_tiles(
                own, layout, times, counts.base, after, self.dead, self.events, self._memory
            )
        basis = ReadingBasis(
            self._stream(events.ahead),
            len(events.own),
            self.clock,
            used.start,
            before.last,
            counts.base,
            slot_map or SlotMap.none(self.pixels),
            self.dead.rho,
            self.reach,
            self.dtype,
        )
        features = Features(frames, tiles, make_start(self.clock, self.pixels, self.dtype), slots)
        return EventWindow(start, stop, after, basis), features

    def _frame_rows(self, stop: int | None, used: slice, before: StreamState) -> NDArray[np.int32]:
        """How many frames; rows of the last one of the window before, and the next's first."""
        onward = used.stop if stop is None else self.clock.used(stop, stop).start
        n = max(used.stop - used.start, 0)
        ends = np.maximum([before.frames - 1 - used.start, onward - used.start], 0)
        return np.array([n, *ends], np.int32)

    def _count(
        self, start: int | None, used: slice, around: Events, before: StreamState
    ) -> tuple[NDArray, EdgeCounts]:
        """What each event stands for, and the counts at the window's start and the frames' edges.

        The start is not moved by changes that are spread.
        """
        stream = self._stream(around)
        weight = np.ones(len(around), np.int8)
        if before.last_then is not None:
            weight = weigh(stream, before.last_then.copy(), self.dead)
        opening = np.iinfo(np.int64).min if start is None else start
        edges, where = np.unique(
            np.concatenate([[opening], *self.clock.edges(used)]).astype(np.int64),
            return_inverse=True,
        )
        counted = count_before(stream, weight, edges, np.zeros((2, self.pixels), self.count_dtype))
        at_start = counted[where[0]]
        if self.reach:
            at_start = at_start.copy()
            add_spread(stream, weight, edges, self.clock.origin, self.reach, counted)
        left, mid, right = (counted[w] for w in np.split(where[1:], 3))
        return weight, EdgeCounts(BaseCounts(at_start, left), mid, right)


def sorted_times(times: Times) -> NDArray[np.int64]:
    """Times of images to prepare, us; raises `InputError` if they are not sorted."""
    times = np.atleast_1d(microseconds(times))
    if (times[1:] < times[:-1]).any():
        raise InputError("the times of images to prepare are not sorted; sort them")
    return times


def prepare(
    recording: Recording,
    times: Times,
    timing: Timing = Timing(),  # noqa: B008
    *,
    filtering: bool = True,
) -> tuple[Features, ReadOut]:
    """A whole recording on the device, for `run`, and points of images at `times`, for `read`.

    `times` are sorted, integers in us or floats in s on the recording's clock. `timing` must be
    that of the parameters to run with; `method.prepare(recording, times, params)` takes it from
    there. Derivatives with respect to `clock_offset` hold between the instants at which an edge of
    an exposure passes an event, those by a positive `rho_ref` are exact, those by the others are 0.
    Without `filtering` the features serve methods that do not pass over single events. Raises
    `InputError` for times that are not sorted.

        features, out = prepare(recording, times)
        trajectory, _ = akf.run(params, features)
        image, variance, valid = akf.read(params, trajectory, out)  # (times, pixels)
    """
    times = sorted_times(times)
    timing = Timing(*(round(float(v), 8) for v in timing))

    def made(growth: bool) -> tuple[Features, ReadOut]:
        windows = WindowedRecording(recording, timing, filtering=filtering, growth=growth)
        window, features = windows.whole()
        return features, window.reader(len(times))(times, growth)

    features, out = made(False)
    if timing.rho_ref:
        rho = np.asarray(timing.rho_ref, features.frames.grey.dtype)
        features, out = (
            eqx.tree_at(
                lambda v: v.growth,
                value,
                DeadTimeDerivative(by.counts(), rho),
                is_leaf=lambda v: v is None,
            )
            for value, by in zip((features, out), made(True), strict=True)
        )
    return jax.device_put((features, out))
