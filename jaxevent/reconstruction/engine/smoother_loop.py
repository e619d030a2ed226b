"""Passes of a smoother over frames, forwards and backwards, and over images.

All numbers of a pixel lie at the same place of arrays of `stride` numbers: first those of the frame
that a pass has come to, then those that are stored for each frame. What differs from method to
method are the `SmootherFunctions`, which `smoother_program` writes, and the places of fields; so
this module is compiled once.
"""

import queue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.codegen.derivative import DerivativeDirections
from jaxevent.reconstruction.engine.bands import (
    BandLayout,
    EventBands,
    ExposureSums,
    FrameRows,
    ImageBuffers,
    PartitionedRecording,
    ceil_to_us,
    count_band_events,
    find_first_event,
    load_frame_image,
    sum_exposure_segments,
)
from jaxevent.reconstruction.engine.filter_program import IMAGE_FIELDS, KernelKind
from jaxevent.reconstruction.engine.smoother_program import (
    COUNT_FIELDS,
    LATER_FIELDS,
    STATE_FIELDS,
    WORK_FIELDS,
    SmootherFunctions,
    SmootherProgram,
    SmoothingMethod,
    smoother_kernel,
)
from jaxevent.reconstruction.frames import FrameClock
from jaxevent.reconstruction.stream import StreamState


class SmootherPlaces(NamedTuple):
    """Places of fields, in strides.

    Attributes:
        stride: Pixels of a band, with its border.
        work: Number of fields of the frame that a pass has come to.
        row: Number of fields that are stored for each frame.
        image: Fields of grey value, intensity and certainty.
        total: Fields of the sums over exposures, and of their derivatives.
        inside: Field of events within exposures; -1: not needed.
        side: Field of the side on which a pixel is clipped.
        counts: Fields of ON and OFF events, and of those of the neighbours.
        exposed: Whether exposures are known.
        censored: Whether clipped frames measure anything.
    """

    stride: int
    work: int
    row: int
    image: NDArray[np.int64]
    total: NDArray[np.int64]
    inside: int
    side: int
    counts: NDArray[np.int64]
    exposed: bool
    censored: bool


class FrameTimeline(NamedTuple):
    """A segment of frames in time (us since the recording's start)."""

    mid: NDArray[np.int64]  # events before it are before the frame
    following: NDArray[np.int64]  # the same of the frame after
    seconds: NDArray[np.float64]  # until then
    exists: NDArray[np.float64]  # 1, or 0 for frames that measure nothing


class SegmentScratch(NamedTuple):
    """Scratch of passes: that of the first of the bands that a pass goes over."""

    sums: NDArray  # [bands, 3 * stride], of rows and of events so far
    counts: NDArray  # [bands, 3, stride], see `ExposureSums`
    times: NDArray[np.float64]  # [bands, 3, stride]


class SegmentInputs(NamedTuple):
    """Arguments of passes over a segment of frames."""

    bands: EventBands
    line: FrameTimeline
    frames: FrameRows
    places: SmootherPlaces
    functions: SmootherFunctions
    numbers: NDArray  # (numbers,) parameters' numbers, of the type of the kernel
    slot: NDArray[np.int64]  # of each band in the memory
    rates: NDArray[np.float64]  # see `spread_rates`; empty: no change is spread
    reach: int  # us, the longest time over which a change is spread
    scratch: SegmentScratch


class ImageTimes(NamedTuple):
    """Times of images and their positions among the frames.

    Attributes:
        time: [times] us since the recording's start.
        frame: [times] frame before, -1 before the first.
        elapsed: [times] time since then, s.
        seconds: [times] time until the next frame, s; 0 after the last.
        here: [times] 1 in the middle of the frame's exposure, else 0.
    """

    time: NDArray[np.int64]
    frame: NDArray[np.int64]
    elapsed: NDArray[np.float64]
    seconds: NDArray[np.float64]
    here: NDArray[np.float64]


class LastEvents(NamedTuple):
    """The last event of each pixel before the time that a pass has come to, [stride]."""

    time: NDArray[np.float64]  # us
    rate: NDArray[np.float64]  # of its count until the next event, 1/us; of OFF events negative


def spread_rates(bands: EventBands, reach_us: int) -> NDArray[np.float64]:
    """Return the rate at which a pixel's count grows from each event to the next.

    An event is late: where no more than `reach_us` lies between two, the second's change is spread
    over that time (`EventTiming`). Else the rate is 0, as after one at the recording's start.

    Args:
        bands: The events.
        reach_us: Longest time over which a change is spread, us.

    Returns:
        (events,) rates, 1/us; of OFF events negative.
    """
    rates = np.zeros(bands.first[-1])
    _fill_spread_rates(bands, reach_us, np.empty(bands.stride, np.int64), rates)
    return rates


@njit_noalloc
def _fill_spread_rates(bands, reach, ahead, rates):
    """Compute the rates of changes that are spread over the time between two events of a pixel.

    Args:
        bands: `EventBands`.
        reach: Longest time over which a change is spread, us.
        ahead: Scratch for each pixel of a band.
        rates: (n,) output, from each event to its pixel's next one, signed events per us; others
            stay.
    """
    events, weights, first = bands.events, bands.weights, bands.first
    for band in range(len(first) - 1):
        for z in range(len(ahead)):
            ahead[z] = -1
        for j in range(first[band + 1] - first[band]):
            i = first[band + 1] - 1 - j
            z, now = (events[i] >> 1) & 0xFFFF, events[i] >> 17
            k = ahead[z]
            ahead[z] = i
            if k >= 0 and now > 0:
                gap = (events[k] >> 17) - now
                if 0 < gap <= reach:
                    one = np.float64(weights[k]) if len(weights) > 0 else 1.0
                    rates[i] = (one if events[k] & 1 else -one) / gap


@njit_noalloc_inlined
def _init_last(scratch, band):
    """Forget the last events of a band's pixels.

    Args:
        scratch: `SegmentScratch`.
        band: The band's place in it.

    Returns:
        `LastEvents` without any event, in the scratch memory.
    """
    times = scratch.times[band]
    for z in range(times.shape[1]):
        times[1, z] = times[2, z] = 0
    return LastEvents(times[1], times[2])


@njit_noalloc_inlined
def _advance_last(given, i, end, until, last):
    """Note each pixel's last event before a time.

    Args:
        given: `SegmentInputs`.
        i: Place of the first event that is not yet noted.
        end: Place after the band's last event.
        until: Time, us since the recording's start.
        last: `LastEvents`, changed in place.

    Returns:
        The place of the first event that is not before the time.
    """
    events, rates = given.bands.events, given.rates
    while i < end and events[i] >> 17 < until:
        z = (events[i] >> 1) & 0xFFFF
        last.time[z] = events[i] >> 17
        last.rate[z] = rates[i]
        i += 1
    return i


@njit_noalloc_inlined
def _seek_last(given, band, time, last):
    """Note each pixel's last event before a time, from as early as matters.

    Args:
        given: `SegmentInputs`.
        band: Number of the band.
        time: Time, us since the recording's start.
        last: `LastEvents`, output.

    Returns:
        The place of the first event that is not before the time.
    """
    for z in range(len(last.rate)):
        last.rate[z] = 0
    a, b = given.bands.first[band], given.bands.first[band + 1]
    begin = find_first_event(given.bands.events, a, b, time - given.reach)
    return _advance_last(given, begin, b, time, last)


@njit_noalloc_inlined
def _add_partial_events(out, fields, time, last, sign):
    """Add or take away the parts of pixels' next events that have happened by a time.

    Args:
        out: Counts of the band's pixels, changed in place.
        fields: Places of the ON and of the OFF counts in it.
        time: Time, us since the recording's start.
        last: `LastEvents` at that time.
        sign: 1 to add, -1 to take away.
    """
    on, off = fields
    for z in range(len(last.time)):
        begun = sign * last.rate[z] * (time - last.time[z])
        out[on + z] += begun if last.rate[z] > 0 else 0.0
        out[off + z] -= begun if last.rate[z] < 0 else 0.0


@njit_noalloc_inlined
def _count_between(given, band, span, cells, fields, last):
    """Count events as `count_band_events` does, with changes spread over time.

    Args:
        given: `SegmentInputs`.
        band: Number of the band.
        span: Begin, which is included, and end, us since the recording's start.
        cells: Numbers of the band's pixels.
        fields: Places of the ON and of the OFF counts in `cells`.
        last: `LastEvents`, scratch.
    """
    count_band_events(given.bands, band, span, cells, fields[0], fields[1])
    left, right = span
    if len(given.rates) > 0 and right > left:
        i = _seek_last(given, band, left, last)
        _add_partial_events(cells, fields, left, last, -1.0)
        _advance_last(given, i, given.bands.first[band + 1], right, last)
        _add_partial_events(cells, fields, right, last, 1.0)


@njit_noalloc_inlined
def _sum_neighbours(given, band, cells, above):
    """Sum ON and OFF events of the eight neighbours of a band's own pixels.

    Args:
        given: `SegmentInputs`.
        band: Number of the band.
        cells: Numbers of the band's pixels; counts are read, sums written.
        above: (stride,) scratch.
    """
    bands, counts, stride = given.bands, given.places.counts, given.places.stride
    padded, rows = bands.width + 2, bands.edges[band + 1] - bands.edges[band]
    for k in range(2):
        c, out = counts[k] * stride, counts[k + 2] * stride
        for z in range(padded, (rows + 1) * padded):
            above[z] = cells[c + z - padded] + cells[c + z] + cells[c + z + padded]
        for z in range(padded + 1, (rows + 1) * padded - 1):
            cells[out + z] = above[z - 1] + above[z] + above[z + 1] - cells[c + z]


@njit_noalloc_inlined
def _load_frame(band, k, given, cells, last, begin):
    """Load a frame's image into a band, and sum over its exposure.

    Args:
        band: Number of the band.
        k: Row of the frame in the segment.
        given: `SegmentInputs`.
        cells: Numbers of the band's pixels.
        last: `LastEvents`, scratch.
        begin: First band of the pass, whose scratch memory is used.
    """
    bands, frames, places = given.bands, given.frames, given.places
    stride = places.stride
    for kind in range(3):
        at = places.image[kind] * stride
        load_frame_image(frames, kind, k, bands, band, cells[at : at + stride])
    if not places.exposed:
        return
    for total in places.total:
        for z in range(total * stride, (total + 1) * stride):
            cells[z] = 0
    sums = ExposureSums(
        given.functions.excess, given.numbers, places.total, given.scratch.counts[begin],
        given.scratch.times[begin, 0],
    )  # fmt: skip
    sum_exposure_segments(bands, band, frames, k, cells, sums)
    if places.inside >= 0:
        inside = places.inside * stride
        span = ceil_to_us(frames.left[k]), ceil_to_us(frames.right[k])
        _count_between(given, band, span, cells, (inside, inside), last)


@njit_noalloc_inlined
def _measure_clipped(k, row, given, cells, begin, end):
    """Measure again where a frame is clipped, as a censored measurement takes long and is seldom.

    Args:
        k: Row of the frame in the segment.
        row: Place of the frame's stored fields in `cells`.
        given: `SegmentInputs`.
        cells: Numbers of the band's pixels.
        begin: First pixel.
        end: Pixel after the last.
    """
    places, line, gain = given.places, given.line, np.float64(given.frames.gain[k])
    side = places.side * places.stride
    z = begin
    while z < end:
        while z < end and cells[side + z] == 0:
            z += 1
        first = z
        while z < end and cells[side + z] != 0:
            z += 1
        if z > first:
            given.functions.clipped(
                cells.ctypes, given.numbers.ctypes, row, first, z, gain, line.exists[k], 0.0
            )


@njit_noalloc
def filter_frames(begin, end, inputs, memory, starts, linked):
    """Pass forwards over a segment of frames, for some bands.

    The state of a band is that before the first frame; it becomes that before the frame after the
    last.

    Args:
        begin: First band.
        end: Band after the last.
        inputs: `SegmentInputs`.
        memory: (slots, ...) numbers of the bands, changed in place.
        starts: Whether the recording starts with this segment.
        linked: Whether to compose the maps of messages through the segment, too.
    """
    bands, line, places, functions = inputs.bands, inputs.line, inputs.places, inputs.functions
    numbers, stride, counts = inputs.numbers, places.stride, places.counts
    padded, fields = np.int64(bands.width + 2), (counts[0] * stride, counts[1] * stride)
    above, last_events = inputs.scratch.sums[begin, :stride], _init_last(inputs.scratch, begin)
    for band in range(begin, end):
        cells, rows = memory[inputs.slot[band]], bands.edges[band + 1] - bands.edges[band]
        first, last = padded, (rows + 1) * padded
        if starts:
            functions.start(cells.ctypes, numbers.ctypes, 0, first, last, 0.0, 0.0, 0.0)
        for k in range(len(line.mid)):
            row = np.int64((places.work + k * places.row) * stride)
            _load_frame(band, k, inputs, cells, last_events, begin)
            gain, seconds = np.float64(inputs.frames.gain[k]), line.seconds[k]
            functions.frame(
                cells.ctypes, numbers.ctypes, row, first, last, gain, line.exists[k], 0.0
            )
            if places.censored:
                _measure_clipped(k, row, inputs, cells, first, last)
            span = line.mid[k], line.following[k]
            _count_between(inputs, band, span, cells, fields, last_events)
            _sum_neighbours(inputs, band, cells, above)
            functions.move(cells.ctypes, numbers.ctypes, row, first, last, seconds, 0.0, 0.0)
            if linked:
                functions.link(cells.ctypes, numbers.ctypes, row, first, last, seconds, 0.0, 0.0)


@njit_noalloc
def smooth_frames(begin, end, inputs, memory):
    """Pass backwards over a segment of frames, for some bands.

    Args:
        begin: First band.
        end: Band after the last.
        inputs: `SegmentInputs`.
        memory: (slots, ...) numbers of the bands, with the message of all later frames at the frame
            after the segment; changed in place.
    """
    bands, line, places = inputs.bands, inputs.line, inputs.places
    padded = np.int64(bands.width + 2)
    for band in range(begin, end):
        cells, rows = memory[inputs.slot[band]], bands.edges[band + 1] - bands.edges[band]
        for j in range(len(line.mid)):
            k = len(line.mid) - 1 - j
            row = np.int64((places.work + k * places.row) * places.stride)
            inputs.functions.back(
                cells.ctypes, inputs.numbers.ctypes, row, padded, (rows + 1) * padded,
                line.seconds[k], 0.0, 0.0,
            )  # fmt: skip


@njit_noalloc_inlined
def _count_since(given, band, to, begin, cells, scratch):
    """Count the events from the middle of a frame to a time.

    Args:
        given: `SegmentInputs`.
        band: Number of the band.
        to: Row of the frame, and the time in us.
        begin: Row of the frame that the counts so far are of, and place of the next event.
        cells: Numbers of the band's pixels; counts are written.
        scratch: Counts so far (2 stride,), and `LastEvents`.

    Returns:
        The place of the next event.
    """
    (f, now), (known, i), (so_far, last) = to, begin, scratch
    bands, counts, stride = given.bands, given.places.counts, given.places.stride
    events, weights, is_spread = bands.events, bands.weights, len(given.rates) > 0
    weighted, b, mid = len(weights) > 0, bands.first[band + 1], given.line.mid[f]
    on, off = counts[0] * stride, counts[1] * stride
    if f != known:
        for z in range(2 * stride):
            so_far[z] = 0
        i = find_first_event(events, bands.first[band], b, mid)
        if is_spread:
            _seek_last(given, band, mid, last)
            _add_partial_events(so_far, (0, stride), mid, last, -1.0)
    first = i
    while i < b and events[i] >> 17 <= now:
        z = ((events[i] >> 1) & 0xFFFF) + (0 if events[i] & 1 else stride)
        so_far[z] += weights[i] if weighted else 1
        i += 1
    for z in range(stride):
        cells[on + z], cells[off + z] = so_far[z], so_far[stride + z]
    if is_spread:
        _advance_last(given, first, b, now + 1, last)
        _add_partial_events(cells, (on, off), now, last, 1.0)
    return i


@njit_noalloc_inlined
def _count_until(given, band, now, cells, last):
    """Count the events after a time until the middle of the first frame.

    Args:
        given: `SegmentInputs`.
        band: Number of the band.
        now: Time, us since the recording's start.
        cells: Numbers of the band's pixels; counts are written.
        last: `LastEvents`, scratch.
    """
    counts, stride, mid = given.places.counts, given.places.stride, given.line.mid[0]
    fields = counts[0] * stride, counts[1] * stride
    count_band_events(given.bands, band, (now + 1, mid), cells, fields[0], fields[1])
    if len(given.rates) > 0 and mid > now:
        i = _seek_last(given, band, now + 1, last)
        _add_partial_events(cells, fields, now, last, -1.0)
        _advance_last(given, i, given.bands.first[band + 1], mid, last)
        _add_partial_events(cells, fields, mid, last, 1.0)


@njit_noalloc
def read_images(begin, end, inputs, memory, times, out_images):
    """Make images of a smoothed segment, for some bands.

    Args:
        begin: First band.
        end: Band after the last.
        inputs: `SegmentInputs`.
        memory: (slots, ...) numbers of the bands.
        times: `ImageTimes`, sorted.
        out_images: `ImageBuffers`, output.
    """
    bands, places, functions = inputs.bands, inputs.places, inputs.functions
    numbers, stride = inputs.numbers, places.stride
    width, pixels = np.int64(bands.width), out_images.mean.shape[1]
    size = np.int64(out_images.derivatives.shape[2] * out_images.derivatives.shape[3])
    padded, last = width + 2, _init_last(inputs.scratch, begin)
    above, so_far = inputs.scratch.sums[begin, :stride], inputs.scratch.sums[begin, stride:]
    for band in range(begin, end):
        cells, rows = memory[inputs.slot[band]], bands.edges[band + 1] - bands.edges[band]
        known, i = -1, np.int64(0)
        for image in range(len(times.time)):
            f, now = times.frame[image], times.time[image]
            row = np.int64((places.work + max(f, 0) * places.row) * stride)
            at = np.int64(image * pixels + bands.edges[band] * width)
            if f < 0:
                _count_until(inputs, band, now, cells, last)
            else:
                i = _count_since(inputs, band, (f, now), (known, i), cells, (so_far, last))
                known = f
            _sum_neighbours(inputs, band, cells, above)
            if f < 0:
                functions.before(
                    cells.ctypes, numbers.ctypes, row, rows, width, padded,
                    times.seconds[image], 0.0, 0.0,
                    out_images.mean.ctypes, out_images.variance.ctypes,
                    out_images.valid.ctypes, out_images.derivatives.ctypes, size, at,
                )  # fmt: skip
            else:
                functions.show(
                    cells.ctypes, numbers.ctypes, row, rows, width, padded,
                    times.elapsed[image], times.seconds[image], times.here[image],
                    out_images.mean.ctypes, out_images.variance.ctypes, out_images.valid.ctypes,
                    out_images.derivatives.ctypes, size, at,
                )  # fmt: skip


class FrameSegment(NamedTuple):
    """Frames that are smoothed together."""

    begin: int
    end: int


def _make_timeline(clock: FrameClock, segment: FrameSegment) -> FrameTimeline:
    begin, end = segment
    mid = clock.mid[max(begin - 1, 0) : end + 1]
    gap = np.diff(mid)
    before = gap[: begin - max(begin - 1, 0)]
    gap = gap[len(before) :]
    here = np.ceil(clock.mid[begin:end]).astype(np.int64)
    after = here.copy()
    after[: len(gap)] = np.ceil(clock.mid[begin + 1 : begin + 1 + len(gap)]).astype(np.int64)
    seconds = np.zeros(end - begin)
    seconds[: len(gap)] = 1e-6 * gap
    # Of frames at one time the first measures.
    exists = np.ones(end - begin)
    exists[0] = begin == 0 or before[0] > 0
    exists[1:] = gap[: end - begin - 1] > 0
    return FrameTimeline(here, after, seconds, exists)


def _places(program: SmootherProgram, stride: int, exposed: bool) -> SmootherPlaces:
    def of(*names: str) -> NDArray[np.int64]:
        return np.array([WORK_FIELDS.index(name) for name in names], np.int64)

    total = [program.work.index(name) for name in ("total.0", *program.derivatives("total.0"))]
    inside = WORK_FIELDS.index("inside") if program.uses("inside.0") else -1
    censored = program.functions["frame"].results != program.functions["clipped"].results
    return SmootherPlaces(
        stride, len(program.work), len(program.row), of(*IMAGE_FIELDS), np.array(total, np.int64),
        inside, WORK_FIELDS.index("side"), of(*COUNT_FIELDS[:4]), exposed, censored,
    )  # fmt: skip


def _neighbour_fractions(layout: BandLayout, width: int, height: int) -> NDArray:
    """Return the fraction of each pixel's eight neighbours that are on the sensor.

    Args:
        layout: Division into bands.
        width: Width of the sensor, px.
        height: Its height, px.

    Returns:
        [bands, stride].
    """
    inside = np.pad(np.ones((height, width)), 2)
    around = sum(
        np.roll(inside, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx
    )
    given = np.asarray(around)[1:-1, 1:-1] / 8
    fractions = np.zeros((layout.bands, layout.stride))
    for band, (top, bottom) in enumerate(zip(layout.edges[:-1], layout.edges[1:], strict=True)):
        rows = given[top : bottom + 2]
        fractions[band, : rows.size] = rows.ravel()
    return fractions


class SmootherPasses:
    """A smoother's kernel for a recording, and the inputs of passes over its frames.

    Args:
        recording: The recording, divided among bands.
        method: The smoother.
        params: Its parameters.
        frame_delay: Time added to the frames' stamps that the recording was divided for, s.
        directions: Numbers by which derivatives are taken.

    Raises:
        TranslationError: There is no kernel.
    """

    def __init__(
        self,
        recording: PartitionedRecording,
        method: SmoothingMethod,
        params: Any,
        frame_delay: Any,
        directions: DerivativeDirections = DerivativeDirections(),  # noqa: B008
    ):
        self.recording, self.dtype, self._method = recording, recording.dtype, method
        self.clock, self.layout = recording.windows.clock, recording.layout
        stride = self.layout.stride
        self.kind = KernelKind(self.clock.exposed, self.dtype, stride, directions)
        fixed = recording.fixed_inputs(frame_delay, method.adds_unseen_errors)
        self._fixed = {name: value for name, value in fixed.items() if name != "present"}
        self._program: SmootherProgram | None = None
        self.spare: queue.SimpleQueue[NDArray] = queue.SimpleQueue()  # memory for bands
        self.use_params(params)
        sensor = recording.recording
        self.fractions = _neighbour_fractions(self.layout, sensor.width, sensor.height)

    def use_params(self, params: Any) -> None:
        """Go on with other parameters."""
        self.kernel = smoother_kernel(self._method, params, self._fixed, self.kind)
        if self._program is not self.kernel.program:
            self._program, self.spare = self.kernel.program, queue.SimpleQueue()
        self.places = _places(self.kernel.program, self.kind.stride, self.kind.exposed)

    def memory(self, n_bands: int, n_frames: int) -> NDArray:
        """Make memory for some bands.

        Args:
            n_bands: Number of bands.
            n_frames: Number of frames of each.

        Returns:
            (bands, ...) numbers, with 0.5 as grey value of what is no pixel.
        """
        places = self.places
        memory = np.zeros(
            (n_bands, (places.work + n_frames * places.row) * places.stride), self.dtype
        )
        for name in (*IMAGE_FIELDS, *STATE_FIELDS, *LATER_FIELDS):
            self.field(memory, f"{name}.0")[:] = 0.5  # where there are no pixels, too
        return memory

    def field(self, memory: NDArray, number: str) -> NDArray:
        """Return one field of the frame that a pass has come to.

        Args:
            memory: (bands, ...) as of `memory`.
            number: Name of the field's number, such as "given.0".

        Returns:
            (bands, stride) view.
        """
        at, stride = self.kernel.program.work.index(number), self.places.stride
        return memory[:, at * stride : (at + 1) * stride]

    def partition(
        self, segment: FrameSegment, state: StreamState
    ) -> tuple[EventBands, StreamState]:
        """Divide the events around a segment of frames among the bands.

        Returns:
            The bands, and the state of the stream at the first event.
        """
        clock, source, (begin, end) = self.clock, self.recording.recording.events, segment
        reach = self.recording.windows.reach
        # Before the first frame and after the last one all events count.
        rows = [0, len(source)]
        if begin:
            first = min(clock.left[begin:end].min(), clock.mid[begin])
            rows[0] = source.index(int(np.ceil(first)) + clock.origin - reach)
        if end < len(clock):
            last = max(clock.right[begin:end].max(), clock.mid[end])
            rows[1] = source.index(int(np.ceil(last)) + clock.origin + reach)
        return self.recording.partition(state, *rows)

    def inputs(
        self, segment: FrameSegment, bands: EventBands, slot: NDArray[np.int64]
    ) -> SegmentInputs:
        """Make the arguments of passes over a segment.

        Args:
            segment: The segment.
            bands: Its events, by band.
            slot: (bands,) place of each band in the memory.

        Returns:
            The arguments.
        """
        reach, n, stride = self.recording.windows.reach, self.layout.bands, self.kind.stride
        scratch = SegmentScratch(
            np.empty((n, 3 * stride), self.dtype),
            np.empty((n, 3, stride), self.dtype),
            np.empty((n, 3, stride)),
        )
        return SegmentInputs(
            bands, _make_timeline(self.clock, segment), self.recording.frames(slice(*segment)),
            self.places, self.kernel.functions, self.kernel.numbers, slot,
            spread_rates(bands, reach) if reach else np.empty(0), reach, scratch,
        )  # fmt: skip

    def image_buffers(self, n_times: int) -> ImageBuffers:
        """Make buffers for images, and for derivatives of those that have any."""
        directions, pixels = self.kind.directions, self.recording.windows.pixels
        of = (len(directions.of), directions.lanes) if directions.numbers else (0, 0)
        return ImageBuffers.empty(n_times, pixels, self.dtype, *of)

    def frame_before(self, times_us: NDArray) -> NDArray[np.int64]:
        """Return the frame before times (us since the recording's start), -1 before the first."""
        return np.searchsorted(self.clock.mid, times_us.astype(float), "right") - 1

    def image_times(self, times_us: NDArray, first_frame: int) -> ImageTimes:
        """Locate times of images in a segment.

        Args:
            times_us: Sorted times, us since the recording's start.
            first_frame: First frame of the segment.

        Returns:
            The times with their positions among the segment's frames.
        """
        mid, frame = self.clock.mid, self.frame_before(times_us)
        behind, following = frame < 0, np.minimum(frame + 1, len(mid) - 1)
        elapsed = np.where(behind, 0, 1e-6 * (times_us - mid[np.maximum(frame, 0)]))
        left = np.where(frame + 1 < len(mid), 1e-6 * (mid[following] - times_us), 0)
        here = (~behind & (elapsed < 1e-6)).astype(float)
        return ImageTimes(times_us, np.where(behind, -1, frame - first_frame), elapsed, left, here)
