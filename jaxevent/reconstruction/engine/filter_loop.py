"""Passes of a filter over events: the loop that all its kernels share, and what the loop takes.

What differs from method to method are the four `FilterFunctions`, which `filter_program` writes,
and the places of fields; so this module is compiled once.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined, run_over_rows
from jaxevent.codegen.derivative import DerivativeDirections, parse_derivative
from jaxevent.codegen.module import CompiledProgram
from jaxevent.reconstruction.engine.bands import (
    NEVER_US,
    EventBands,
    ExposureSums,
    FrameRows,
    ImageBuffers,
    PartitionedRecording,
    copy_field,
    count_band_events,
    fill_field,
    find_first_event,
    load_frame_image,
    sum_exposure_segments,
)
from jaxevent.reconstruction.engine.filter_program import (
    N_PIECE_FRAMES,
    FieldPlaces,
    FilterFunctions,
    FilterMethod,
    KernelKind,
    Variant,
    filter_kernel,
    n_pieces,
    variants,
)
from jaxevent.reconstruction.features import allocate_aligned
from jaxevent.reconstruction.frames import FrameClock, interval_rates
from jaxevent.reconstruction.stream import StreamState


class Timeline(NamedTuple):
    """Intervals of a window in which points lie in one piece, after one frame.

    Attributes:
        start: [intervals] begin of each interval, us since the recording's start.
        frame: [intervals] frame of the piece, -1 before the first exposure.
        variant: [intervals] index of the variant, see `filter_program.Variant`.
        begin: [intervals] begin of the piece, us.
        rate: [intervals] reciprocal length of the piece, 1/us.
        mid: [intervals] middle of the frame before, us.
        blend_rate: [intervals] reciprocal time from that to the next middle, 1/us.
        uniform: [intervals, ...] inputs of tables that are equal for all pixels.
        opening: Start of the window, us.
    """

    start: NDArray[np.int64]
    frame: NDArray[np.int64]
    variant: NDArray[np.int64]
    begin: NDArray[np.float64]
    rate: NDArray[np.float64]
    mid: NDArray[np.float64]
    blend_rate: NDArray[np.float64]
    uniform: NDArray
    opening: int


class BandedWindow(NamedTuple):
    """A window of a recording, as a pass over it takes it, whatever the kernel."""

    start: int | None  # us
    stop: int | None
    bands: EventBands
    line: Timeline
    frames: FrameRows
    context: StreamState  # of weighted events

    @property
    def begins(self) -> float:
        """Start of the window, us."""
        return -math.inf if self.start is None else float(self.start)

    def contains(self, time_us: int) -> bool:
        """Return whether a time (us) is in the window."""
        return self.begins <= time_us and (self.stop is None or time_us < self.stop)


def cut_window(
    recording: PartitionedRecording, start_us: int | None, state: StreamState
) -> BandedWindow:
    """Cut the window that begins at a time, and divide its events among the bands.

    Args:
        recording: The recording.
        start_us: Start of the window, us; None: the recording's.
        state: State of the stream at the end of the window before.

    Returns:
        The window.
    """
    windows, source = recording.windows, recording.recording.events
    stop = windows.choose_stop(start_us)
    rows = [0 if start_us is None else source.index(start_us)]
    rows.append(len(source) if stop is None else source.index(stop))
    used = windows.clock.frames_within(start_us, stop)
    bands, state = recording.partition(state, *windows.extend_to_exposures(used, *rows))
    line = make_timeline(windows.clock, start_us, stop, recording.recording.gain, recording.dtype)
    return BandedWindow(start_us, stop, bands, line, recording.frames(used), state)


def make_timeline(
    clock: FrameClock, start_us: int | None, stop_us: int | None, gain: NDArray, dtype: np.dtype
) -> Timeline:
    """Make the timeline of a window.

    Args:
        clock: Times of the frames.
        start_us: Start of the window, us; None: without bound.
        stop_us: End of the window.
        gain: (frames,) gain of each frame.
        dtype: Kind of real numbers.

    Returns:
        The timeline.
    """
    begin = -NEVER_US if start_us is None else start_us - clock.origin
    end = NEVER_US if stop_us is None else stop_us - clock.origin
    bounds = np.unique(np.ceil(np.concatenate([clock.breaks, clock.mid])).astype(np.int64))
    times = np.concatenate([[begin], bounds[(bounds > begin) & (bounds < end)]]).astype(np.int64)
    piece = np.searchsorted(clock.breaks, times, "right")
    before = np.searchsorted(clock.mid, times, "right") - 1
    frame = np.asarray(clock.frame_of_piece(piece))
    # Positions of a piece, and of the frame before its points, among the frames that it rests on.
    first = np.maximum(frame - 1, 0)
    at = np.stack([piece - clock.first_piece(1) * first, np.maximum(before, 0) - first], 1)
    known = variants(clock.exposed)
    variant = [known.index(Variant(*place)) for place in at.tolist()]
    piece_begin, rate = _intervals(clock.breaks, piece - 1)
    mid, blend_rate = _intervals(clock.mid, before)
    uniform = np.stack([_uniform_inputs(clock, int(f), gain) for f in frame]).astype(dtype)
    return Timeline(
        times, frame, np.array(variant), piece_begin, rate, mid, blend_rate, uniform, begin
    )


def _intervals(breaks: NDArray, at: NDArray) -> tuple[NDArray, NDArray]:
    """Return the intervals between breaks at some places.

    Args:
        breaks: (n,) sorted times, us.
        at: Numbers of intervals; that of the first break is 0.

    Returns:
        The begins of the intervals, us, and 1 / length, 1/us; 0 outside the breaks.
    """
    if len(breaks) < 2:
        return np.zeros(len(at)), np.zeros(len(at))
    inside = (at >= 0) & (at < len(breaks) - 1)
    k = np.where(inside, at, 0)
    return np.where(inside, breaks[k], 0.0), np.where(inside, interval_rates(breaks)[k], 0.0)


def _uniform_inputs(clock: FrameClock, frame: int, gain: NDArray) -> NDArray:
    """Return the inputs of a piece's tables that are equal for all pixels, as of three frames.

    Args:
        clock: Times of the window's frames.
        frame: Frame of the piece, -1 before the first.
        gain: (frames,) exposures relative to the common one.

    Returns:
        Gains of the frames, rates of the pieces (1/s) and rates between frames (1/s), one after
        another; gains are 1 and rates 0 where there is no frame.
    """
    first = max(frame - 1, 0)
    used = slice(first, min(len(clock), max(frame, 0) + 2))

    def padded(values: NDArray, size: int, at: int, rest: float) -> NDArray:
        out = np.full(size, rest)
        part = values[: size - at]
        out[at : at + len(part)] = part
        return out

    breaks = clock.breaks[clock.first_piece(first) :]
    return np.concatenate(
        [
            padded(gain[used], N_PIECE_FRAMES, 0, 1.0),
            padded(1e6 * interval_rates(breaks), n_pieces(clock.exposed), 1, 0.0),
            padded(1e6 * interval_rates(clock.mid[used]), N_PIECE_FRAMES, 0, 0.0),
        ]
    )


# Kinds of steps, and their arguments; fields are places in `cells`.
STEP_MOVE = 0  # to a field, from another
STEP_LOAD = 1  # into a field, which of `FrameRows.tables`, and of which frame
STEP_FILL = 2  # a field, with half of a number
STEP_SUM = 3  # into a column of `WindowInputs.totals`, the segments of a frame's exposure
STEP_COUNT = 4  # into two fields, of ON and OFF, events from a time on and until another
STEP_AROUND = 5  # into a field, the sum of two others over the 3x3 pixels around each

NO_PREVIOUS_FRAME = -9


class EntrySteps(NamedTuple):
    """Steps of all bands at the beginning of each interval, in order."""

    step: NDArray[np.int64]  # [steps, 5]: its kind and arguments
    end: NDArray[np.int64]  # [intervals + 1], of the steps of the interval before


def entry_steps(
    places: FieldPlaces, timeline: Timeline, frames: FrameRows, entry_point: tuple[int, int]
) -> EntrySteps:
    """List the steps at the beginning of each interval of a window.

    A piece of another frame needs other images, sums over exposures and counts of events. Times and
    places of fields alone decide which.

    Args:
        places: Places of the fields.
        timeline: Timeline of the window.
        frames: Frames of the window.
        entry_point: Interval in which the window is entered, with no frame known, and the time, us
            since the recording's start; the steps of the intervals before are left out.

    Returns:
        The steps.
    """
    first, now = entry_point
    ends, before, found = (
        np.zeros(len(timeline.start) + 1, np.int64),
        NO_PREVIOUS_FRAME,
        list[Any](),
    )
    entry = _FrameEntry(places, frames, timeline.opening)
    for interval in range(first, len(timeline.start)):
        frame = int(timeline.frame[interval])
        if frame != before:
            time = now if interval == first else int(timeline.start[interval])
            found += entry.steps(frame, before, time)
        before, ends[interval + 1] = frame, len(found)
    steps = np.zeros((len(found), 5), np.int64)
    for row, step in enumerate(found):
        steps[row, : len(step)] = step
    return EntrySteps(steps, ends)


class _FrameEntry:
    """Lists the steps where pieces of another frame begin."""

    def __init__(self, places: FieldPlaces, frames: FrameRows, opening: int):
        self.places, self.number, self.opening = places, frames.number, opening
        # Events earlier than these whole numbers of us are before the time.
        edges = (frames.left, frames.mid, frames.right)
        self.left, self.mid, self.right = (np.ceil(e).astype(int).tolist() for e in edges)

    def steps(self, frame: int, before: int, now: int) -> Iterator[tuple[int, ...]]:
        """List the steps where pieces of a frame begin.

        Args:
            frame: Number of the frame that the pieces count from; -1 before the first.
            before: Number of the frame of the pieces before, or `NO_PREVIOUS_FRAME`.
            now: Time, us since the recording's start.

        Yields:
            Kind and arguments of a step.
        """
        places, number = self.places, self.number
        count = len(self.left) + number
        base = max(frame - 1, 0)
        rows = min(count, max(frame, 0) + 2) - base
        follows = frame == before + 1
        if follows and frame >= 2:
            for to, of in places.shifted.tolist():
                yield STEP_MOVE, to * places.stride, of * places.stride
        fresh = 0 if not follows else 3 if frame == 0 else 2
        for row in range(fresh, 3):
            yield from self._image_steps(base + row - number, row, rows)
        for row in range(fresh, 3):
            left = mid = right = 0
            if row < rows:
                k = base + row - number
                left, mid, right = self.left[k], self.mid[k], self.right[k]
            yield from self._count_steps(places.head[:, row], left, mid)
            yield from self._count_steps(places.tail[:, row], mid, right)
        for row in range(0 if not follows else 2 if frame == 0 else 1, 2):
            left = right = 0
            if row + 1 < rows:  # another frame follows
                k = base + row - number
                left, right = self.left[k], self.right[k + 1]
            yield from self._count_steps(places.span[:, row], left, right)
            if places.around[row] >= 0:
                fields = places.around[row], *places.span[:, row]
                yield STEP_AROUND, *(int(field) * places.stride for field in fields)
        # The piece counts from its exposure's left edge, before the first from the window's start.
        begin = self.left[frame - number] if frame >= 0 else now
        yield from self._count_steps(np.array([places.on, places.off]), begin, now)
        if frame < 0 and count > 0:
            yield from self._count_steps(places.before, self.opening, self.right[0])

    def _image_steps(self, k: int, row: int, rows: int) -> Iterator[tuple[int, ...]]:
        """List the steps for the images of one frame of a piece, and for its exposure's sums.

        Args:
            k: Row of the frame in the window's frames.
            row: Number of the frame among the piece's three.
            rows: Number of the three that exist.

        Yields:
            Kind and arguments of a step.
        """
        places, stride = self.places, self.places.stride
        for kind in range(3):
            field = int(places.image[kind, row]) * stride
            if field >= 0 and row < rows:
                yield STEP_LOAD, field, kind, k
            elif field >= 0 and rows > 0:
                yield STEP_MOVE, field, int(places.image[kind, row - 1]) * stride
            elif field >= 0:
                yield STEP_FILL, field, int(kind < 2)
        for total in places.total[:, row].tolist():
            yield STEP_FILL, total * stride, 0
        if len(places.total) and row < rows:
            yield STEP_SUM, row, k

    def _count_steps(
        self, fields: NDArray[np.int64], left: int, right: int
    ) -> Iterator[tuple[int, ...]]:
        """List the step that counts events of a span of time; none where a method needs no counts.

        Args:
            fields: (2,) places of the counts of ON and OFF events, in strides; -1: not needed.
            left: First time that counts, us.
            right: Time from which events no longer count, us.

        Returns:
            The step and its arguments.
        """
        if fields[0] >= 0:
            on, off = (fields * self.places.stride).tolist()
            yield STEP_COUNT, on, off, left, right


class BandMemory(NamedTuple):
    """State of all bands, and scratch."""

    cells: NDArray  # [bands, fields * stride], real numbers of pixels
    whole: NDArray[np.int64]  # [bands, fields * stride], whole numbers of pixels' states
    last: NDArray[np.float64]  # [bands, stride], us, of the pixels' last events
    place: NDArray[np.int64]  # [bands, 2]: next event and interval
    scratch: NDArray  # [bands, ...], a row's numbers while images and tables are made
    bound: NDArray[np.float64]  # [bands, stride], see `ExposureSums`
    counts: NDArray  # [bands, 3, stride], see `ExposureSums`


class WindowInputs(NamedTuple):
    """Arguments of a pass over a window."""

    bands: EventBands
    line: Timeline
    steps: EntrySteps
    frames: FrameRows
    totals: NDArray[np.int64]  # [sums, rows], fields of sums over exposures, in strides
    functions: FilterFunctions
    numbers: NDArray  # (numbers,) parameters' numbers, of the type of the kernel


@njit_noalloc_inlined
def _sum_around(cells, fields, sums, shape):
    """Sum two fields over the 3x3 pixels around each of a band's own pixels, into another field.

    Args:
        cells: Numbers of the band's pixels.
        fields: Places of the output and of the two fields.
        sums: Scratch, of a band's size.
        shape: Rows of the band, and width of a row with its border.
    """
    rows, padded = shape
    (out_begin, on, off), n = fields, rows * padded
    above_on, at_on, below_on = cells[on:], cells[on + padded :], cells[on + 2 * padded :]
    above_off, at_off, below_off = cells[off:], cells[off + padded :], cells[off + 2 * padded :]
    for z in range(n):
        sums[z] = above_on[z] + at_on[z] + below_on[z] + above_off[z] + at_off[z] + below_off[z]
    out, middle, right = cells[out_begin + padded + 1 :], sums[1:], sums[2:]
    for z in range(n - 2):
        out[z] = sums[z] + middle[z] + right[z]


@njit_noalloc_inlined
def _take_steps(steps, begin, end, given, band, memory):
    """Take the steps of a band at the beginning of an interval.

    Args:
        steps: (steps, 5), see `EntrySteps`.
        begin: First of the steps.
        end: The one after the last.
        given: `WindowInputs`.
        band: Number of the band.
        memory: `BandMemory`.
    """
    bands, frames, cells = given.bands, given.frames, memory.cells[band]
    stride = bands.stride
    for i in range(begin, end):
        kind, at, of, left, right = (
            steps[i, 0], steps[i, 1], steps[i, 2], steps[i, 3], steps[i, 4]
        )  # fmt: skip
        if kind == STEP_MOVE:
            copy_field(cells, at, of, stride)
        elif kind == STEP_LOAD:
            load_frame_image(frames, of, left, bands, band, cells[at : at + stride])
        elif kind == STEP_FILL:
            fill_field(cells, at, stride, 0.5 * of)
        elif kind == STEP_SUM:
            sums = ExposureSums(
                given.functions.excess, given.numbers, given.totals[:, at], memory.counts[band],
                memory.bound[band],
            )  # fmt: skip
            sum_exposure_segments(bands, band, frames, of, cells, sums)
        elif kind == STEP_AROUND:
            shape = np.int64(bands.edges[band + 1] - bands.edges[band]), np.int64(bands.width + 2)
            _sum_around(cells, (at, of, left), memory.scratch[band], shape)
        else:
            count_band_events(bands, band, (left, right), cells, at, of)


class PassRequest(NamedTuple):
    """Extent of a pass over a window, and the images that it makes."""

    # Interval and time (us) at which the bands enter the window first; -1: they are in it.
    enter: tuple[int, int]
    until: int  # us; events before it are passed over
    times: NDArray[np.int64]  # of images, sorted, us
    images: ImageBuffers


@njit_noalloc
def filter_events(begin, end, inputs, memory, request):
    """Pass over the events of some bands, and make images.

    Args:
        begin: First band.
        end: Band after the last.
        inputs: `WindowInputs`.
        memory: `BandMemory`, changed in place.
        request: `PassRequest`; its images are written.
    """
    enter, until, times, images = request
    bands, line, functions, steps = inputs.bands, inputs.line, inputs.functions, inputs.steps.step
    first, edges, starts, ends = bands.first, bands.edges, line.start, inputs.steps.end
    width, weighted = np.int64(bands.width), np.int64(len(bands.weights) > 0)
    padded, pixels, places = width + 2, images.mean.shape[1], memory.place
    size = np.int64(images.derivatives.shape[2] * images.derivatives.shape[3])
    numbers, events, weights = inputs.numbers.ctypes, bands.events.ctypes, bands.weights.ctypes
    mean, variance, valid = images.mean.ctypes, images.variance.ctypes, images.valid.ctypes
    derivatives, uniform = images.derivatives.ctypes, line.uniform.ctypes
    for band in range(begin, end):
        place, rows, row = places[band], edges[band + 1] - edges[band], 0
        last_own, finish = (rows + 1) * padded, first[band + 1]
        cells, whole = memory.cells[band].ctypes, memory.whole[band].ctypes
        last, scratch = memory.last[band].ctypes, memory.scratch[band].ctypes
        i, s, entering, is_shown = place[0], place[1], enter[0] >= 0, False
        if entering:
            i, s = (
                find_first_event(bands.events, first[band], finish, np.int64(enter[1])),
                np.int64(enter[0]),
            )
        while True:
            if entering:
                _take_steps(steps, ends[s], ends[s + 1], inputs, band, memory)
                functions.tables(
                    line.variant[s], cells, padded, last_own, numbers, uniform,
                    s * line.uniform.shape[1], scratch,
                )  # fmt: skip
                entering = is_shown = False
            stop = np.int64(until)
            if s + 1 < len(starts) and starts[s + 1] < stop:
                stop = starts[s + 1]
            reading = row < len(times) and times[row] < stop
            till = times[row] + 1 if reading else stop
            opening, rate = line.begin[s], line.rate[s]
            mid, blend_rate = line.mid[s], line.blend_rate[s]
            i = functions.events(
                cells, whole, last, events, weights, weighted, i, finish, till, padded, last_own,
                padded, opening, rate, mid, blend_rate, numbers,
            )  # fmt: skip
            if reading:
                if not is_shown:
                    functions.image_tables(
                        line.variant[s], cells, padded, last_own, numbers, uniform,
                        s * line.uniform.shape[1], scratch,
                    )  # fmt: skip
                    is_shown = True
                t = np.float64(times[row])
                functions.images(
                    cells, whole, last, rows, width, padded, t, (t - opening) * rate,
                    (t - mid) * blend_rate, numbers, mean, variance, valid, derivatives, scratch,
                    size, row * pixels + edges[band] * width,
                )  # fmt: skip
                row += 1
            elif s + 1 < len(starts) and starts[s + 1] < until:
                s += 1
                entering = True
            else:
                break
        place[0], place[1] = i, s


@dataclasses.dataclass(frozen=True)
class PixelStates:
    """State of all pixels, band by band.

    Attributes:
        cells: Real numbers of all pixels, band by band; see `filter_program.FieldPlaces`.
        whole: Whole numbers of all pixels, likewise.
        last: Times of the last events, us, likewise.
    """

    cells: NDArray
    whole: NDArray
    last: NDArray


class FilterPasses:
    """A filter's kernel for a recording, and the state of the bands between passes over events.

    Args:
        recording: The recording, divided among bands.
        method: The filter.
        params: Its parameters.
        frame_delay: Time added to the frames' stamps that the recording was divided for, s.
        directions: Numbers by which derivatives are taken.

    Raises:
        TranslationError: There is no kernel.
    """

    def __init__(
        self,
        recording: PartitionedRecording,
        method: FilterMethod,
        params: Any,
        frame_delay: Any,
        directions: DerivativeDirections = DerivativeDirections(),  # noqa: B008
    ):
        self.recording, self._method = recording, method
        self.kind = KernelKind(
            recording.windows.clock.exposed, recording.dtype, recording.layout.stride, directions
        )
        self._fixed = recording.fixed_inputs(frame_delay, method.has_covariance)
        self.kernel: CompiledProgram | None = None
        self.use_params(params)

    def use_params(self, params: Any) -> None:
        """Go on with other parameters."""
        kernel = filter_kernel(self._method, params, self._fixed, self.kind)
        if self.kernel is None or self.kernel.places is not kernel.places:
            self._allocate(kernel)
        self.kernel, self.fields = kernel, kernel.places

    def _allocate(self, kernel: CompiledProgram) -> None:
        fields, dtype, bands = kernel.places, self.kind.dtype, self.recording.layout.bands
        places, stride = fields.places, self.kind.stride
        scratch = max(places.table_scratch, (places.factors + 1) * stride)
        self._memory = BandMemory(
            allocate_aligned((bands, fields.size), dtype),
            np.zeros((bands, max(len(fields.whole), 1) * stride), np.int64),
            np.zeros((bands, stride)),
            np.zeros((bands, 2), np.int64),
            np.empty((bands, scratch), dtype),
            np.empty((bands, stride)),
            np.empty((bands, 3, stride), dtype),
        )
        self._steps = EntrySteps(np.zeros((0, 5), np.int64), np.zeros(1, np.int64))

    def run(
        self,
        window: BandedWindow,
        until_us: int,
        times_us: NDArray | None = None,
        out_images: ImageBuffers | None = None,
        entry_point: tuple[int, int] = (-1, 0),
    ) -> None:
        """Pass over the window's events before a time.

        Args:
            window: The window.
            until_us: Time, us since the recording's start.
            times_us: Sorted times of images before `until_us`, us since the recording's start.
            out_images: Where the images are written.
            entry_point: See `PassRequest`.
        """
        places, kernel = self.fields.places, self.kernel
        assert kernel is not None
        if entry_point[0] >= 0:
            self._steps = entry_steps(places, window.line, window.frames, entry_point)
        given = WindowInputs(
            window.bands, window.line, self._steps, window.frames, places.total, kernel.functions,
            kernel.numbers,
        )  # fmt: skip
        if times_us is None or out_images is None:
            times_us, out_images = np.empty(0, np.int64), self.image_buffers(0, 0)
        n_bands = self.recording.layout.bands
        request = PassRequest(entry_point, until_us, times_us, out_images)
        run_over_rows(filter_events, n_bands, given, self._memory, request)

    def image_buffers(self, n_times: int, n_pixels: int) -> ImageBuffers:
        """Make buffers for images, and for derivatives of those that have any."""
        return ImageBuffers.empty(
            n_times, n_pixels, self.kind.dtype, len(self.fields.outputs), self.fields.lanes
        )

    def init(self, window: BandedWindow) -> None:
        """Enter the recording's first window: the state at the start, with its derivatives."""
        self._memory.last[:] = 0
        line, fields, memory = window.line, self.fields, self._memory
        interval = int(np.searchsorted(line.start, 0, "right")) - 1
        self.run(window, -NEVER_US, entry_point=(interval, 0))
        uniform, addresses = line.uniform[interval], fields.addresses()
        position = {
            "weight.0": -line.begin[interval] * line.rate[interval],
            "blend.0": -line.mid[interval] * line.blend_rate[interval],
        }

        def known(name: str) -> Any:
            if name in position:
                return position[name]
            if name in fields.cells:
                return fields.of_bands(name, memory.cells, memory.whole)
            return uniform[addresses[name][2]]

        records, kernel = fields.records(memory.cells), self.kernel
        assert kernel is not None
        variant = int(line.variant[interval])
        state = kernel.program.initial_state(variant, known, kernel.values)
        for name, values in state.items():
            derivative = parse_derivative(name)
            if derivative is None:
                fields.of_bands(name, memory.cells, memory.whole)[:] = values
            elif derivative[0] in fields.states:
                records[:, :, fields.states[derivative[0]] + derivative[1]] = values
        self.run(window, -NEVER_US, entry_point=(0, -NEVER_US))

    def resume(self, window: BandedWindow, states: PixelStates, now_us: int) -> None:
        """Enter a later window at its beginning.

        Args:
            window: The window.
            states: State of all pixels at that time.
            now_us: Begin of the window, us since the recording's start.
        """
        memory = self._memory
        memory.cells[:, : states.cells.shape[1]] = states.cells
        memory.whole[:], memory.last[:] = states.whole, states.last
        self.run(window, -NEVER_US, entry_point=(0, now_us))

    def copy_states(self) -> PixelStates:
        """Copy the state, without derivatives."""
        cells, whole, last = self._memory[:3]
        real = self.fields.cells["on.0"] * self.kind.stride  # fields of the state come first
        return PixelStates(cells[:, :real].copy(), whole.copy(), last.copy())
