"""A recording prepared window by window, or whole: from a stream of events to features.

A per-pixel filter is a ragged array of short scans. The events of a time window are sorted by pixel
and laid out in tiles (`tiles`), with their positions among the frames around them (`frames`). A
recording is prepared whole (`prepare`, for fits), or in windows with carried state
(`WindowedRecording`, for video at constant memory). Results do not depend on the choice.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc
from jaxevent.errors import InputError
from jaxevent.reconstruction.features import (
    N_TILE_SLOTS,
    DeadTimeDerivative,
    Features,
    ImagePoints,
    ReadOut,
    allocate_aligned,
)
from jaxevent.reconstruction.frames import (
    EventTiming,
    FrameClock,
    FrameImages,
    make_frame_features,
    make_segments,
    make_start_points,
)
from jaxevent.reconstruction.stream import (
    BaseCounts,
    DeadTime,
    EdgeCounts,
    EventStream,
    StreamState,
    add_spread_events,
    count_before_edges,
    count_events_per_pixel,
    event_weight,
    event_weights,
    update_last_times,
)
from jaxevent.reconstruction.tiles import SlotMap, TileLayout, TileMemory, make_tiles
from jaxevent.reconstruction.unseen import UnseenChange, measure_unseen_change
from jaxevent.recording import Events, Recording, Times, microseconds

MAX_WINDOW_EVENTS = 1 << 20
# Pixels of all frames of a window: 16 frames of 346x260 take 60 MB.
MAX_WINDOW_FRAME_PIXELS = 6_000_000
WINDOW_FRAME_BOUNDS = (6, 16)  # least and greatest number of frames of a window


class ReaderInputs(NamedTuple):
    """Inputs of the loop that finds images among the events of a window."""

    stream: EventStream  # events of the window and, where changes are spread, those soon after
    n_events: int  # of the window itself
    counts: BaseCounts
    slot_map: SlotMap
    dead: DeadTime
    reach: int  # us, the longest time over which a change is spread
    origin: int  # us, the recording's start


class PixelStates(NamedTuple):
    """State of each pixel at the time that a reader has come to."""

    count: NDArray  # [2, pixels], ON and OFF events
    last: NDArray[np.int64]  # us, of the last event
    slot: NDArray[np.int32]  # of the last event in the window, -1 if none
    rank: NDArray[np.int32]  # of the next event
    image: NDArray[np.int64]  # scratch: the image for which a later event was seen


class ImageRows(NamedTuple):
    """Arrays of a `ReadOut`.

    Attributes:
        slot: [times, pixels] slot of the pixel's last event in the window, -1 if there is none.
        on: [times, pixels] ON events since the left edge of the piece's exposure.
        off: [times, pixels] OFF events since the left edge of the piece's exposure.
        since: [times, pixels] time since the pixel's last event, s.
    """

    slot: NDArray[np.int32]
    on: NDArray
    off: NDArray
    since: NDArray


@dataclasses.dataclass(frozen=True)
class EventWindow:
    """Events with start <= t < stop (us; None: unbounded), prepared for reading images."""

    start: int | None
    stop: int | None
    after: StreamState  # at the window's end
    inputs: ReaderInputs
    clock: FrameClock
    first_frame: int  # that the window uses
    last: NDArray[np.int64]  # us, of each pixel's last event before the window
    dtype: np.dtype  # of the results

    def reader(self, capacity: int) -> "ImageReader":
        """Make a reader of at most `capacity` images at a time."""
        return ImageReader(self, capacity)


class ImageReader:
    """Reads images of a window at any times inside it: the features of each pixel's last event.

    It walks through the window's events in time, and starts again for earlier images.

    Args:
        window: Window of events.
        capacity: Images for which read-outs have memory.
    """

    def __init__(self, window: EventWindow, capacity: int):
        self._window, self._capacity = window, capacity
        shape = capacity, len(window.last)
        self._buffers = [
            ImageRows(
                allocate_aligned(shape, np.int32),
                *(allocate_aligned(shape, window.dtype) for _ in range(3)),
            )
            for _ in range(2)
        ]
        self._rewind()

    def _rewind(self) -> None:
        window, pixels = self._window, len(self._window.last)
        self._row, self._time = 0, np.iinfo(np.int64).min
        self._states = PixelStates(
            window.inputs.counts.start.copy(),
            window.last.copy(),
            np.full(pixels, -1, np.int32),
            np.zeros(pixels, np.int32),
            np.empty(pixels, np.int64),
        )

    def __call__(self, times: NDArray[np.int64]) -> ReadOut:
        """Prepare images at sorted times (us) inside the window, padded to the capacity.

        The arrays are overwritten by the call after the next.
        """
        window, clock, capacity = self._window, self._window.clock, self._capacity
        if len(times) and times[0] < self._time:
            self._rewind()
        self._buffers.reverse()
        out = self._buffers[0]
        piece, frame, weight, blend = clock.locate((times - clock.origin).astype(float))
        # The exposure from whose left edge the piece counts; -1: the window's start.
        exposure = np.maximum(clock.frame_of_piece(piece) - window.first_frame, -1)
        self._row = _read(window.inputs, self._row, times, exposure, self._states, out)
        self._time = times[-1] if len(times) else self._time

        def pad(values: NDArray, dtype: Any) -> NDArray:
            padded = np.zeros(capacity, dtype)
            padded[: len(values)] = values
            return padded

        points = ImagePoints(
            pad(weight, window.dtype)[:, None],
            pad(blend, window.dtype)[:, None],
            out.on,
            out.off,
            pad(piece - clock.first_piece(window.first_frame), np.int32),
            pad(frame - window.first_frame, np.int32),
            pad(clock.seconds_since_frame(times - clock.origin, frame), window.dtype),
        )
        return ReadOut(points, out.slot, out.since)


@njit_noalloc
def _read(inputs, row, times, exposure, states, out):
    """Find every pixel's last event at each time of an image.

    Args:
        inputs: `ReaderInputs` of the window.
        row: Row of the first event that has not been passed over.
        times: Sorted times of images, us.
        exposure: (times,) exposure from which the piece counts; -1: the window's start.
        states: `PixelStates` at that row, changed in place.
        out: `ImageRows`, output: the last event's slot, the time since, and the counts in the
            piece.

    Returns:
        The next row.
    """
    stream, n_events, counts, slot_map, dead, reach, origin = inputs
    # Arrays get names of their own: reading them from tuples in the loops takes far longer.
    t, x, y, p, width = stream.t, stream.x, stream.y, stream.p, stream.width
    count, last, at, rank_of = states.count, states.last, states.slot, states.rank
    image = states.image
    kind, lane_of, shapes = slot_map.kind, slot_map.lane, slot_map.shapes
    round_tile, round_first = slot_map.round_tile, slot_map.round_first
    slot, since, on, off = out.slot, out.since, out.on, out.off
    for pixel in range(len(last)):
        image[pixel] = -1
    for j in range(len(times)):
        while row < n_events and t[row] <= times[j]:
            pixel = np.int64(y[row]) * width + x[row]
            count[0 if p[row] else 1, pixel] += event_weight(t[row] - last[pixel], dead)
            last[pixel] = t[row]
            if slot_map.known:
                k, lane, rank = kind[pixel], lane_of[pixel], rank_of[pixel]
                ranks, lanes = shapes[k, 0], shapes[k, 1]
                rank_of[pixel] = rank + 1
                tile = round_tile[round_first[k] + rank // ranks] + lane // lanes
                at[pixel] = tile * N_TILE_SLOTS + rank % ranks * lanes + lane % lanes
            row += 1
        base = counts.left[exposure[j]] if exposure[j] >= 0 else counts.start
        for pixel in range(len(last)):
            slot[j, pixel] = at[pixel]
            since[j, pixel] = max(times[j] - last[pixel], 0) * 1e-6
            on[j, pixel] = count[0, pixel] - base[0, pixel]
            off[j, pixel] = count[1, pixel] - base[1, pixel]
        after = row
        while after < len(t) and t[after] <= times[j] + reach:
            pixel = np.int64(y[after]) * width + x[after]
            gap = t[after] - last[pixel]
            if image[pixel] != j and last[pixel] > origin and 0 < gap <= reach:
                part = event_weight(gap, dead) * (times[j] - last[pixel]) / gap
                if p[after]:
                    on[j, pixel] += part
                else:
                    off[j, pixel] += part
            image[pixel] = j
            after += 1
    return row


class WindowEvents(NamedTuple):
    """Events of a window and around it, as parts of one array."""

    own: Events
    with_spread: Events  # its own and, where changes are spread, those soon after
    with_frames: Events  # those of all its frames' exposures too


class WindowedRecording:
    """A recording cut into time windows, each prepared; iterates over windows and features.

    Args:
        recording: Events and frames.
        timing: Parameters that preparation depends on.
        filtering: Prepare tiles, for estimators that pass over single events. Else features serve
            to read frames and event counts.
        events: Greatest number of events of a window.
        reuse: Write a window's tiles over the last one's (`TileMemory`), which must be done with.
        derivative: Prepare derivatives of event counts by the dead time in place of counts.
    """

    def __init__(
        self,
        recording: Recording,
        timing: EventTiming = EventTiming(),  # noqa: B008
        *,
        filtering: bool = True,
        events: int = MAX_WINDOW_EVENTS,
        reuse: bool = False,
        derivative: bool = False,
    ):
        self.recording, self.filtering, self.events = recording, filtering, events
        self._timing = timing
        self.clock = FrameClock.of(recording, timing)
        self.dead = DeadTime(round(timing.rho_ref * 1e8) / 100, derivative)
        self.reach = 0 if filtering else round(timing.spread * 1e6)
        # Whole events are counted in integers, weighted and spread ones in double precision.
        self._count_dtype = np.dtype(np.float64 if self.dead.rho or self.reach else np.int32)
        self.pixels = recording.width * recording.height
        # The number of frames depends on the sensor only, to compile once.
        self.frames = max(
            WINDOW_FRAME_BOUNDS[0],
            min(WINDOW_FRAME_BOUNDS[1], MAX_WINDOW_FRAME_PIXELS // self.pixels),
        )
        self.dtype = np.dtype(jnp.result_type(float))
        self.images = FrameImages(recording, self.dtype)
        self._memory = TileMemory(reuse, self.dtype)

    @functools.cached_property
    def unseen(self) -> UnseenChange:
        """Changes that events do not show."""
        return measure_unseen_change(self.images, self.clock)

    def __iter__(self) -> Iterator[tuple[EventWindow, Features]]:
        before, start = self.initial(), None
        while True:
            window, features = self.prepare(start, before)
            yield window, features
            if window.stop is None:
                return
            before, start = window.after, window.stop

    def initial(self) -> StreamState:
        """Return the state before the first window."""
        return StreamState.initial(self.recording, self.dead.rho > 0)

    def prepare(self, start_us: int | None, before: StreamState) -> tuple[EventWindow, Features]:
        """Prepare the window that begins at a time.

        Args:
            start_us: Start of the window, us; None: that of the recording.
            before: State at its start.

        Returns:
            The window, shorter if its events are very unevenly spread, and its features.
        """
        stop = self.choose_stop(start_us)
        source = self.recording.events
        begin = self._row_of(start_us)
        end = len(source) if stop is None else source.index(stop)
        context, finish = self.extend_to_exposures(
            self.clock.frames_within(start_us, stop), begin, end
        )
        if self.reach and stop is not None:
            finish = max(finish, source.index(stop + self.reach))
        around = source[context:finish]
        if before.context_last is not None:
            before = self.move_context(before, context)
        own = around[begin - context : end - context]
        while True:
            layout = self._layout(own)
            middle = int(own.t[len(own) // 2]) if len(own) else 0
            if layout is None or layout.ordinary or len(own) < 2 or middle == own.t[0]:
                spread = around[begin - context :]
                spread = spread[: len(spread) if stop is None else spread.index(stop + self.reach)]
                events = WindowEvents(own, spread, around)
                return self._window(start_us, stop, events, layout, before)
            stop = middle
            own = own[: own.index(stop)]

    def extend(self, recording: Recording) -> None:
        """Go on with the same recording after events or frames were added to its end."""
        self.recording = recording
        self.clock = FrameClock.of(recording, self._timing)
        self.images = FrameImages(recording, self.dtype)

    def settled_until(self, frames_follow: bool) -> float:
        """Return the time up to which windows stay as they are if more is added to the end.

        A window that ends in the exposure of frame k uses frame k + 1 and the events of its
        exposure.

        Args:
            frames_follow: Whether more frames will be added, else events alone.

        Returns:
            The time, us.
        """
        source = self.recording.events
        last = int(source[len(source) - 1 :].t[0]) - self.reach if len(source) else -np.inf
        if not frames_follow:
            return float(last)
        # Events before `last` are known.
        known = np.maximum.accumulate(self.clock.right) + self.clock.origin <= last
        complete = int(np.argmin(known)) if not known.all() else len(known)
        return float(self.clock.left[complete - 2] + self.clock.origin) if complete > 1 else -np.inf

    def first_needed_rows(self, start_us: int | None, before: StreamState) -> tuple[int, int]:
        """Return the first row of the events and the first frame that later windows use.

        Args:
            start_us: Start of the first of these windows, us.
            before: State at that time.
        """
        used = self.clock.frames_within(start_us, None)
        begin = self._row_of(start_us)
        row, _ = self.extend_to_exposures(used, begin, begin)
        if before.context_last is not None:
            row = min(row, before.context)
        return row, used.start

    def prepare_whole(self) -> tuple[EventWindow, Features]:
        """Prepare the whole recording as one window, with memory that grows in steps by a quarter.

        Raises:
            InputError: The frames have more than 2^31 cells.
        """
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
        same = WindowEvents(events, events, events)
        return self._window(None, None, same, self._layout(events), self.initial())

    def choose_stop(self, start_us: int | None) -> int | None:
        """Choose the end of the window that starts at `start_us`; None: the recording's end."""
        stops = []
        clock, source = self.clock, self.recording.events
        at = -np.inf if start_us is None else start_us - clock.origin
        piece = int(np.searchsorted(clock.breaks, at, "right"))
        # A window uses the frame before its first piece's and the one after its last piece's.
        last = max(clock.frame_of_piece(piece) - 1, 0) + self.frames - 2
        if last < len(clock):
            stop = clock.breaks[2 * last if clock.exposed else last]
            stops.append(clock.origin + int(np.ceil(stop)))
        first = self._row_of(start_us)
        if first + self.events < len(source):
            row = first + self.events
            stop = int(source[row : row + 1].t[0])
            if source.index(stop) <= first:  # a burst at one instant is not divided
                stop += 1
            if stop <= self.recording.stop:
                stops.append(stop)
        return min(stops, default=None)

    def extend_to_exposures(
        self, frame_range: slice, begin_row: int, end_row: int
    ) -> tuple[int, int]:
        """Extend a range of events to those in the exposures of frames.

        Args:
            frame_range: Range of frames.
            begin_row: First row.
            end_row: Row after the last.

        Returns:
            The new range, [begin, end).
        """
        if frame_range.start < frame_range.stop:
            # Of overlapping exposures, a later one may begin or an earlier one end further out.
            left, _, right = self.clock.exposure_edges(frame_range)
            source = self.recording.events
            begin_row = min(begin_row, source.index(int(left.min()) - self.reach))
            end_row = max(end_row, source.index(int(right.max()) + self.reach))
        return begin_row, end_row

    def move_context(self, state: StreamState, context_row: int) -> StreamState:
        """Move a state's context: each pixel's last event before a row.

        Args:
            state: State with a context.
            context_row: The row.

        Returns:
            The state with the new context.
        """
        last, row = state.context_last, state.context
        assert last is not None
        if row > context_row:
            last, row = self.initial().last, 0
        last = last.copy()
        while row < context_row:
            part = self.recording.events[row : min(row + MAX_WINDOW_EVENTS, context_row)]
            update_last_times(self._stream(part), last)
            row += len(part)
        return dataclasses.replace(state, context=context_row, context_last=last)

    def _row_of(self, start: int | None) -> int:
        return 0 if start is None else self.recording.events.index(start)

    def _stream(self, events: Events) -> EventStream:
        return EventStream.of(events, self.recording.width)

    def _layout(self, events: Events) -> TileLayout | None:
        if not self.filtering:
            return None
        counts = count_events_per_pixel(events.x, events.y, self.recording.width, self.pixels)
        return TileLayout.of(counts, self.events)

    def _window(
        self,
        start: int | None,
        stop: int | None,
        events: WindowEvents,
        layout: TileLayout | None,
        before: StreamState,
    ) -> tuple[EventWindow, Features]:
        clock, used = self.clock, self.clock.frames_within(start, stop)
        weight, counts = self._weigh_and_count(start, used, events.with_frames, before)
        segments = None
        if clock.exposed:
            stream = self._stream(events.with_frames)
            segments = make_segments(clock, used, stream, weight, counts, self.dtype)
        rows = self._frame_rows(stop, used, before)
        frames = make_frame_features(
            self.images, clock, used, rows, counts, segments=segments, unseen=self.unseen,
            filtering=self.filtering, capacity=self.frames,
        )  # fmt: skip
        after, own = before.copy(), self._stream(events.own)
        after.frames = max(used.stop, 1)
        if layout is None:
            tiles, slots = None, np.full(self.pixels, -1, np.int32)
            slot_map = SlotMap.empty(self.pixels)
            update_last_times(own, after.last)
        else:
            slots, slot_map = layout.last_slots(), layout.slot_map
            tiles = make_tiles(
                own, layout, clock.times_from(used.start), counts.base, after,
                dead=self.dead, capacity=self.events, memory=self._memory,
            )  # fmt: skip
        inputs = ReaderInputs(
            self._stream(events.with_spread),
            len(events.own),
            counts.base,
            slot_map,
            self.dead,
            self.reach,
            clock.origin,
        )
        window = EventWindow(start, stop, after, inputs, clock, used.start, before.last, self.dtype)
        return window, Features(
            frames, tiles, make_start_points(clock, self.pixels, self.dtype), slots
        )

    def _frame_rows(self, stop: int | None, used: slice, before: StreamState) -> NDArray[np.int32]:
        """Return `FrameFeatures.rows` of a window that uses some frames."""
        onward = used.stop if stop is None else self.clock.frames_within(stop, stop).start
        n = max(used.stop - used.start, 0)
        ends = np.maximum([before.frames - 1 - used.start, onward - used.start], 0)
        return np.array([n, *ends], np.int32)

    def _weigh_and_count(
        self, start: int | None, used: slice, around: Events, before: StreamState
    ) -> tuple[NDArray, EdgeCounts]:
        """Weigh the events of a window, and count them before its start and the edges of exposures.

        The start is not moved by changes that are spread.

        Args:
            start: Start of the window, us; None: the recording's.
            used: Range of the frames that the window uses.
            around: Events of the window and of the frames' exposures.
            before: State before the window.

        Returns:
            (events,) number of events that each event stands for, and the counts.
        """
        stream = self._stream(around)
        weight = np.ones(len(around), np.int8)
        if before.context_last is not None:
            weight = event_weights(stream, before.context_last.copy(), self.dead)
        opening = np.iinfo(np.int64).min if start is None else start
        edges, index = np.unique(
            np.concatenate([[opening], *self.clock.exposure_edges(used)]).astype(np.int64),
            return_inverse=True,
        )
        none = np.zeros((2, self.pixels), self._count_dtype)
        counted = count_before_edges(stream, weight, edges, none)
        at_start = counted[index[0]]
        if self.reach:
            at_start = at_start.copy()
            add_spread_events(stream, weight, edges, self.clock.origin, self.reach, counted)
        left, mid, right = (counted[i] for i in np.split(index[1:], 3))
        return weight, EdgeCounts(BaseCounts(at_start, left), mid, right)


def sorted_times(times: Times) -> NDArray[np.int64]:
    """Return times of images in us.

    Raises:
        InputError: The times are not sorted.
    """
    times = np.atleast_1d(microseconds(times))
    if (times[1:] < times[:-1]).any():
        raise InputError("the times of images to prepare are not sorted; sort them")
    return times


def prepare(
    recording: Recording,
    times: Times,
    timing: EventTiming = EventTiming(),  # noqa: B008
    *,
    filtering: bool = True,
) -> tuple[Features, ReadOut]:
    """Prepare a whole recording for `run`, and points of images for `read`, on the device.

        features, out = prepare(recording, times)
        trajectory, _ = akf.run(params, features)
        image, variance, valid = akf.read(params, trajectory, out)  # (times, pixels)

    Derivatives with respect to `clock_offset` hold between the instants at which an edge of an
    exposure passes an event. Those by a positive `rho_ref` are exact, those by the other parameters
    of `timing` are 0.

    Args:
        recording: Events and frames.
        times: Sorted times of images, integers in us or floats in s on the recording's clock.
        timing: The parameters to run with; `method.prepare(recording, times, params)` reads them
            from `params`.
        filtering: Prepare tiles, for methods that pass over single events.

    Returns:
        The features of the recording, and the read-out of the images.

    Raises:
        InputError: The times are not sorted, or the recording has too many frames.
    """
    times = sorted_times(times)
    timing = EventTiming(*(round(float(v), 8) for v in timing))

    def prepare_counts(derivative: bool) -> tuple[Features, ReadOut]:
        windows = WindowedRecording(recording, timing, filtering=filtering, derivative=derivative)
        window, features = windows.prepare_whole()
        return features, window.reader(len(times))(times)

    features, out = prepare_counts(False)
    if timing.rho_ref:
        rho = np.asarray(timing.rho_ref, features.frames.grey.dtype)
        features, out = (
            dataclasses.replace(value, derivative=DeadTimeDerivative(by.counts(), rho))
            for value, by in zip((features, out), prepare_counts(True), strict=True)
        )
    return jax.device_put((features, out))
