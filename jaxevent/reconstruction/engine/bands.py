"""Events, frames and images in bands of rows, and what loops over bands have in common.

A band is a few rows of pixels with one more on each side, whose events act on the neighbourhood.
All numbers of a pixel lie at the same place of arrays of `stride` numbers, one after another in
`cells`: they stay in the processor's cache while the band's images are made.
"""

import dataclasses
import sys
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.codegen.graph import TranslationError
from jaxevent.errors import InputError
from jaxevent.reconstruction.frames import EventTiming
from jaxevent.reconstruction.stream import EventStream, StreamState, event_weights
from jaxevent.reconstruction.unseen import UnseenChange
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import ColumnSource, EventColumns, Recording

NEVER_US = 1 << 45  # us, longer than any recording and within an event's bits
# Pixels of a band and its border. A dozen numbers each fill half a megabyte, of a second-level
# cache of one; each number begins a cache line further than a power of two. Where derivatives lie
# beside them the smaller bands are a tenth faster.
BAND_STRIDES = (8208, 16400, 32784, 65488)
BAND_STRIDES_WITH_DERIVATIVES = (4112, *BAND_STRIDES)
N_BLOCK_EVENTS = 1 << 18  # of a file, read and divided at once
N_ROWS = 1 << 16  # that a y of 16 bits can name
MIN_BAND_ROWS = 6  # the two rows of a border are read for nothing
MAX_WINDOW_FRAME_PIXELS = 1 << 26  # of a window's frames, as they are stored
MAX_PASS_PIXELS = 1 << 22  # made in one pass, 9 bytes each
N_IMAGE_BUFFERS = 2  # the last images are held while the next ones are made


class EventBands(NamedTuple):
    """Events divided among bands, and the rows of each band.

    Attributes:
        events: (n,) time since the recording's start (us), place in the band and polarity, packed
            in one number.
        weights: (n,) events that each one stands for; empty: one.
        first: (bands + 1,) first event of each band, and n.
        edges: (bands + 1,) first row of each band, and the number of rows.
        width: Width of the sensor, px.
        stride: Pixels of a band, with its border.
    """

    events: NDArray[np.int64]
    weights: NDArray
    first: NDArray[np.int64]
    edges: NDArray[np.int64]
    width: int
    stride: int


class FrameRows(NamedTuple):
    """Frames of a window or segment.

    Attributes:
        images: [frames, pixels] grey levels; or empty.
        tables: [3, levels] grey value, intensity and certainty.
        values: [3, frames, pixels] the same where there are no levels.
        gain: [frames] brightness, see `Recording.gain`.
        left: [frames] begins of the exposures, us, exact.
        mid: [frames] middles of the exposures, us.
        right: [frames] ends of the exposures, us.
        number: Number of the first frame in the recording.
    """

    images: NDArray
    tables: NDArray
    values: NDArray
    gain: NDArray
    left: NDArray[np.float64]
    mid: NDArray[np.float64]
    right: NDArray[np.float64]
    number: int


class ImageBuffers(NamedTuple):
    """Images and derivatives of those that have any.

    Attributes:
        mean: [times, pixels].
        variance: [times, pixels], (ln I)^2.
        valid: [times, pixels] whether the image is known.
        derivatives: [times, pixels, images, lanes].
    """

    mean: NDArray
    variance: NDArray
    valid: NDArray[np.uint8]
    derivatives: NDArray

    @classmethod
    def empty(
        cls, n_times: int, n_pixels: int, dtype: np.dtype, n_outputs: int = 0, n_lanes: int = 0
    ) -> "ImageBuffers":
        """Allocate buffers for images.

        Args:
            n_times: Number of images.
            n_pixels: Number of pixels of each.
            dtype: Type of real numbers.
            n_outputs: Number of images that have derivatives, of mean and variance; 0 for none.
            n_lanes: Numbers of a vector of derivatives.

        Returns:
            The buffers; derivatives are 0, images are not initialised.
        """
        mean, variance = (np.empty((n_times, n_pixels), dtype) for _ in range(2))
        valid = np.empty((n_times, n_pixels), np.uint8)
        return cls(mean, variance, valid, np.zeros((n_times, n_pixels, n_outputs, n_lanes), dtype))


class BufferPool:
    """Memory for at most `times` images at once, used again when nobody holds the images.

    Fresh memory costs as much as the images: the system clears each page when it is first written.
    """

    def __init__(self, pixels: int, dtype: np.dtype):
        self.times = max(1, MAX_PASS_PIXELS // pixels)
        self._pixels, self._dtype = pixels, dtype
        self._sets: list[tuple[NDArray, ...]] = []

    def take(self, n_times: int) -> ImageBuffers:
        """Take memory for some images, which nothing else writes until they are released."""
        free = [arrays for arrays in self._sets if _count_references(arrays) == _UNUSED]
        arrays: tuple[NDArray, ...]
        if free:
            arrays = free[0]
        else:
            arrays = tuple(ImageBuffers.empty(self.times, self._pixels, self._dtype)[:3])
            self._sets = [*self._sets, arrays][-N_IMAGE_BUFFERS:]
        mean, variance, valid = (array[:n_times] for array in arrays)
        return ImageBuffers(
            mean, variance, valid, np.empty((n_times, self._pixels, 0, 0), self._dtype)
        )


def _count_references(arrays: tuple[NDArray, ...]) -> int:
    """Count the references to arrays; each part of one that somebody holds is one."""
    return sum(sys.getrefcount(array) for array in arrays)


# References to unused arrays. Versions of Python count their own references differently.
_UNUSED = _count_references((np.empty(1), np.empty(1), np.empty(1)))


@dataclasses.dataclass(frozen=True)
class BandLayout:
    """Division of a sensor's rows into bands; depends on nothing but its size.

    Attributes:
        stride: Pixels of a band, with its border.
        edges: (bands + 1,) first row of each band, and the number of rows.
    """

    stride: int
    edges: NDArray[np.int64]

    @classmethod
    def of(cls, width: int, height: int, derivatives: bool = False) -> "BandLayout":
        """Lay out the bands of a sensor.

        Args:
            width: Width of the sensor, px.
            height: Height of the sensor, px.
            derivatives: Whether kernels carry derivatives, and bands are smaller.

        Returns:
            The layout.

        Raises:
            TranslationError: The sensor is too wide for a band.
        """
        rows, stride = 0, 0
        for stride in BAND_STRIDES_WITH_DERIVATIVES if derivatives else BAND_STRIDES:
            rows = stride // (width + 2) - 2
            if rows >= min(MIN_BAND_ROWS, height):
                break
        if rows < min(3, height):  # a row borders on one other band at most
            raise TranslationError(f"a sensor {width} pixels wide")
        number = -(-height // rows)
        return cls(stride, np.arange(number + 1) * height // number)

    @property
    def bands(self) -> int:
        """Number of bands."""
        return len(self.edges) - 1

    def partition(
        self,
        blocks: Iterable[EventColumns],
        counts: NDArray[np.int64],
        weight: NDArray,
        width: int,
        origin_us: int,
        out_events: NDArray[np.int64],
    ) -> EventBands | None:
        """Divide events among the bands, in order of time.

        Every event is given to each band that it lies in or borders on.

        Args:
            blocks: The events in order, which are checked.
            counts: Number of events of each y.
            weight: Events that each one stands for; empty: one.
            width: Width of the sensor, px.
            origin_us: Time from which to count, us.
            out_events: Where the bands' events are written if they fit.

        Returns:
            The bands, or None if the events are not in order or not on the sensor.
        """
        height = int(self.edges[-1])
        if counts[height:].any():
            return None
        before = np.concatenate([[0], np.cumsum(counts[:height])])
        low, high = np.maximum(self.edges[:-1] - 1, 0), np.minimum(self.edges[1:] + 1, height)
        first = np.concatenate([[0], np.cumsum(before[high] - before[low])])
        total = int(first[-1])
        events = out_events if len(out_events) >= total else np.empty(total + total // 4, np.int64)
        weights = np.empty(total if len(weight) else 0, weight.dtype)
        bands = EventBands(events, weights, first, self.edges, width, self.stride)
        at, rows, done = first.astype(np.uint64), self._rows(width), 0
        for stored in blocks:
            t, since_us = stored.t, origin_us - stored.offset
            if len(t) and (t[0] < since_us - NEVER_US or t[-1] > since_us + NEVER_US):
                return None
            weight_of_block = weight[done : done + len(t)]
            if not _partition(stored, weight_of_block, rows, since_us, at, bands):
                return None
            done += len(t)
        return bands

    def _rows(self, width: int) -> "_Rows":
        height, padded = int(self.edges[-1]), width + 2
        rows = np.arange(height)
        own = np.searchsorted(self.edges, rows, "right") - 1
        above, below = rows == self.edges[own], rows + 1 == self.edges[own + 1]
        next_to = np.where(above & (own > 0), own - 1, np.where(below, own + 1, self.bands))

        def place(band: NDArray) -> NDArray[np.int64]:
            return ((rows - self.edges[np.minimum(band, self.bands)] + 1) * padded + 1) << 1

        return _Rows(own.astype(np.uint64), place(own), next_to.astype(np.uint64), place(next_to))


class _Rows(NamedTuple):
    """The band of each row and the place where it begins there, and of a band above or below.

    Bands are unsigned, as other places are tried for being negative; one too many is none.
    """

    own: NDArray[np.uint64]  # (height,) band that owns the row
    own_place: NDArray[np.int64]  # (height,) twice the place of the row's first pixel in that band
    next_to: NDArray[np.uint64]  # (height,) band whose border the row is; the number of bands: none
    next_place: NDArray[np.int64]  # (height,) the place there, likewise


@njit_noalloc
def _count_rows(y, counts):
    """Count events by row.

    Args:
        y: (n,) rows of events.
        counts: (rows,) added to.
    """
    for i in range(len(y)):
        counts[y[i]] += 1


@njit_noalloc
def _partition(stored, weight, rows, origin, at, bands):
    """Write each event to its band, and to one that it borders on.

    Args:
        stored: `EventColumns` of a block.
        weight: (n,) events that each one stands for; empty: one.
        rows: `_Rows`.
        origin: Time from which to count, on the columns' own clock, us.
        at: (bands + 1,) places at which each band's next event goes, changed in place.
        bands: `EventBands`, output.

    Returns:
        Whether all events are in order and on the sensor.
    """
    t, x, y, p, previous = stored.t, stored.x, stored.y, stored.p, stored.previous
    events, weights, width = bands.events, bands.weights, bands.width
    weighted, bad = len(weight) > 0, False
    none, one = np.uint64(len(at) - 1), np.uint64(1)
    for i in range(len(t)):
        row, column, up = y[i], np.int64(x[i]), np.int64(p[i])
        bad |= (t[i] < previous) | (column >= width) | (up > 1)
        previous = t[i]
        event = ((t[i] - origin) << 17) + (column << 1 | up)
        band = rows.own[row]
        events[at[band]] = event + rows.own_place[row]
        if weighted:
            weights[at[band]] = weight[i]
        at[band] += one
        band = rows.next_to[row]
        if band != none:
            events[at[band]] = event + rows.next_place[row]
            if weighted:
                weights[at[band]] = weight[i]
            at[band] += one
    return not bad


class PartitionedRecording:
    """Recording whose events are divided among bands of rows, window by window.

    Args:
        recording: Events and frames.
        timing: Clock and dead time of the method.
        filtering: Whether the method is a filter.
        events: Most events of a window; None: one window is the whole, for derivatives.
        factors: (2, pixels) of single pixels' ON and OFF thresholds.

    Raises:
        TranslationError: Kernels cannot do it.
    """

    def __init__(
        self,
        recording: Recording,
        timing: EventTiming,
        filtering: bool,
        events: int | None = None,
        factors: NDArray[np.floating] | None = None,
    ):
        self.layout = BandLayout.of(recording.width, recording.height, filtering and events is None)
        if recording.stop - recording.start >= NEVER_US:
            raise TranslationError("a recording of over a year")
        whole = max(len(recording.events), 1)
        self.recording, self._factors = recording, factors
        self.windows = WindowedRecording(
            recording, timing, filtering=filtering, events=whole if events is None else events
        )
        self.windows.frames = max(8, MAX_WINDOW_FRAME_PIXELS // self.windows.pixels)
        if events is None:
            self.windows.frames = len(self.windows.clock) + 2
        self.images = self.windows.images
        none = np.zeros((3, 1), self.dtype)
        self._tables = self.images.tables if len(self.windows.clock) else none
        self._response = self.images.response()
        # Memory of the windows, one after another.
        self._stored: EventColumns | None = None
        self._events = np.empty(0, np.int64)

    @property
    def dtype(self) -> np.dtype:
        """Kind of real numbers."""
        return self.windows.dtype

    @property
    def origin(self) -> int:
        """The recording's start (us), from which kernels count."""
        return self.windows.clock.origin

    def fixed_inputs(self, frame_delay: Any, has_variance: bool) -> dict[str, NDArray]:
        """Return the inputs of kernels beside parameters.

        Args:
            frame_delay: Time added to the frames' stamps that windows were made for, s.
            has_variance: Whether the method's variance rests on changes that events do not show.

        Returns:
            Arrays by the names of fields of `FrameFeatures`.
        """
        unseen = self.windows.unseen if has_variance else UnseenChange(0.0, 0.0)
        known = {
            "flicker": np.asarray(unseen.flicker, self.dtype),
            "movement": np.asarray(unseen.movement, self.dtype),
            "frame_delay": np.asarray(frame_delay, self.dtype),
            "present": np.asarray(len(self.windows.clock) > 0, self.dtype),
            "response": self._response,
        }
        white = self.images.white
        return known if white is None else known | {"white": white}

    def partition(
        self, state: StreamState, begin_row: int, end_row: int
    ) -> tuple[EventBands, StreamState]:
        """Divide the events of a range of rows among the bands.

        Bands that were made before are overwritten.

        Args:
            state: State of the stream before or at the first row.
            begin_row: First row.
            end_row: Row after the last.

        Returns:
            The bands, and the state at the first row.
        """
        windows, source = self.windows, self.recording.events
        weight = np.empty(0, self.dtype)
        plain = state.context_last is None and self._factors is None
        if plain and isinstance(source, ColumnSource):
            bands = self._bands_of_source(source, begin_row, end_row)
            if bands is not None:
                return bands, state
        events = source[begin_row:end_row]  # raises `InputError` for what is not valid
        if state.context_last is not None:
            state = windows.move_context(state, begin_row)
            assert state.context_last is not None
            stream = EventStream.of(events, self.recording.width)
            weight = event_weights(stream, state.context_last.copy(), windows.dead).astype(
                self.dtype
            )
        if self._factors is not None:
            pixel = events.y.astype(np.int64) * self.recording.width + events.x
            factors = self._factors[np.where(events.p, 0, 1), pixel]
            weight = (factors * weight if len(weight) else factors).astype(self.dtype)
        earliest = np.iinfo(np.int64).min
        checked = EventColumns(events.t, events.x, events.y, events.p.view(np.uint8), 0, earliest)
        counts = np.zeros(N_ROWS, np.int64)
        _count_rows(events.y, counts)
        bands = self._bands_of([checked], counts, weight)
        if bands is None:  # somebody changed arrays after they were checked
            name = self.recording.name
            events.check(self.recording.width, self.recording.height, name, begin_row)
            raise InputError(f"{name}: events changed while they were read; make a new recording")
        return bands, state

    def _bands_of_source(
        self, source: ColumnSource, begin_row: int, end_row: int
    ) -> EventBands | None:
        """Divide the events of a source among the bands, block by block.

        Each block stays in the processor's cache; 5 million events would fill 65 MB.

        Args:
            source: The events.
            begin_row: First row.
            end_row: Row after the last.

        Returns:
            The bands, or None if the source cannot be read so or events are not valid.
        """
        steps = range(begin_row, end_row, N_BLOCK_EVENTS)
        blocks = [slice(row, min(row + N_BLOCK_EVENTS, end_row)) for row in steps]
        counts = np.zeros(N_ROWS, np.int64)
        for rows in blocks:
            y = source.image_rows(rows)
            if y is None:
                return None
            _count_rows(y, counts)

        def read() -> Iterator[EventColumns]:
            for rows in blocks:
                stored = source.columns(rows, self._stored)
                assert stored is not None
                if self._stored is None or len(stored.t) > len(self._stored.t):
                    self._stored = stored
                yield stored

        return self._bands_of(read(), counts, np.empty(0, self.dtype))

    def _bands_of(
        self, blocks: Iterable[EventColumns], counts: NDArray[np.int64], weight: NDArray
    ) -> EventBands | None:
        """Divide events among the bands, in the memory of the bands before.

        Args:
            blocks: The events in order.
            counts: (`N_ROWS`,) number of events of each y.
            weight: Events that each one stands for; empty: one.

        Returns:
            The bands, or None if the events are not in order or not on the sensor.
        """
        width = self.recording.width
        bands = self.layout.partition(blocks, counts, weight, width, self.origin, self._events)
        if bands is not None:
            self._events = bands.events
        return bands

    def frames(self, frame_range: slice) -> FrameRows:
        """Return a range of the frames, as loops read them."""
        clock, frames = self.windows.clock, self.recording.frames
        left, mid, right = (
            e[frame_range].astype(float) for e in (clock.left, clock.mid, clock.right)
        )
        images, values = np.zeros((0, 1), np.uint8), np.zeros((0, 0, 1), self.dtype)
        if frames is not None and len(clock):
            images = np.asarray(frames[frame_range].images)
            images = np.ascontiguousarray(images.reshape(len(images), -1))
            if images.dtype.kind == "f":
                values = self.images.values(images)
                images = np.zeros((0, 1), np.uint8)
        gain = self.recording.gain[frame_range].astype(self.dtype)
        return FrameRows(images, self._tables, values, gain, left, mid, right, frame_range.start)


# Compilers take several numbers at once where no place can be negative: in parts from 0 on.
@njit_noalloc_inlined
def copy_field(cells, out_begin, in_begin, count):
    """Copy numbers from one place of an array to another.

    Args:
        cells: The array.
        out_begin: First place that is written.
        in_begin: First place that is read.
        count: Number of numbers.
    """
    out, given = cells[out_begin : out_begin + count], cells[in_begin : in_begin + count]
    for z in range(len(out)):
        out[z] = given[z]


@njit_noalloc_inlined
def fill_field(cells, out_begin, count, value):
    """Set some numbers to one value.

    Args:
        cells: (numbers,) numbers of a band's pixels.
        out_begin: First number to set.
        count: How many.
        value: The value.
    """
    out = cells[out_begin : out_begin + count]
    for z in range(len(out)):
        out[z] = value


@njit_noalloc_inlined
def ceil_to_us(time_us):
    """Round a time up: events earlier than this whole number of us are before it."""
    return np.int64(np.ceil(time_us))


@njit_noalloc_inlined
def load_frame_image(frames, table_kind, frame, bands, band, out_field):
    """Write the values of a frame's pixels, by a table, into a field of a band.

    Args:
        frames: `FrameRows`.
        table_kind: 0 for grey values, 1 for intensities, 2 for certainties.
        frame: Row of the frame in `frames`.
        bands: `EventBands`.
        band: Number of the band.
        out_field: (stride,) output; the band's border stays as it is.
    """
    gain, width = frames.gain[frame], bands.width
    is_plain = table_kind != 1 or gain == 1  # divisions take longest
    for line in range(bands.edges[band], bands.edges[band + 1]):
        z, pixel = (line - bands.edges[band] + 1) * (width + 2) + 1, line * width
        out = out_field[z : z + width]
        if len(frames.values) == 0:
            table, levels = frames.tables[table_kind], frames.images[frame, pixel : pixel + width]
            for column in range(len(out)):
                out[column] = table[levels[column]]
        else:
            given = frames.values[table_kind, frame, pixel : pixel + width]
            for column in range(len(out)):
                out[column] = given[column]
        if not is_plain:
            for column in range(len(out)):
                out[column] /= gain


@njit_noalloc_inlined
def find_first_event(events, begin, end, time_us):
    """Find the first of a band's events that is not before a time.

    Args:
        events: Packed events, sorted by time; see `EventBands`.
        begin: First place of the search.
        end: Place after the last one.
        time_us: Time, us since the recording's start.

    Returns:
        The place; `end` if all events are before the time.
    """
    while begin < end:
        middle = (begin + end) >> 1
        if events[middle] >> 17 < time_us:
            begin = middle + 1
        else:
            end = middle
    return begin


@njit_noalloc_inlined
def count_band_events(bands, band, span_us, cells, on_field, off_field):
    """Count each pixel's ON and OFF events in a span of time.

    Args:
        bands: `EventBands`.
        band: Number of the band.
        span_us: Begin, which is included, and end, us since the recording's start.
        cells: Numbers of the band's pixels.
        on_field: Place of the field for ON events in `cells`.
        off_field: Place of the field for OFF events; may be the same.
    """
    events, weights, stride, end = bands.events, bands.weights, bands.stride, bands.first[band + 1]
    weighted, (left, right) = len(weights) > 0, span_us
    fill_field(cells, on_field, stride, 0.0)
    fill_field(cells, off_field, stride, 0.0)
    for i in range(find_first_event(events, bands.first[band], end, left), end):
        event = events[i]
        if event >> 17 >= right:
            break
        z = np.uint64(((event >> 1) & 0xFFFF) + (on_field if event & 1 else off_field))
        cells[z] += weights[i] if weighted else 1


class ExposureSums(NamedTuple):
    """Arguments of `sum_exposure_segments`."""

    excess: Any  # function of the module
    numbers: NDArray  # (numbers,) parameters' numbers, of the type of the kernel
    totals: NDArray[np.int64]  # fields of the sums, in strides
    counts: NDArray  # [3, stride], scratch
    bound: NDArray[np.float64]  # [stride], scratch


@njit_noalloc_inlined
def sum_exposure_segments(bands, band, frames, frame, cells, sums):
    """Add up, in fields, the contributions of the segments of constant brightness in an exposure.

    Args:
        bands: `EventBands`.
        band: Number of the band.
        frames: `FrameRows`.
        frame: Row of the frame in `frames`.
        cells: Numbers of the band's pixels.
        sums: `ExposureSums`.
    """
    events, weights, stride = bands.events, bands.weights, bands.stride
    excess, numbers, totals, counts, bound = sums
    begin, end = bands.first[band], bands.first[band + 1]
    left, mid, right = frames.left[frame], frames.mid[frame], frames.right[frame]
    length = right - left
    a, b = (
        find_first_event(events, begin, end, ceil_to_us(left)),
        find_first_event(events, begin, end, ceil_to_us(right)),
    )
    middle = find_first_event(events, begin, end, ceil_to_us(mid))
    if length <= 0 or a == b:
        return
    added = counts[2]
    for half in range(2):  # backwards from the middle to the left edge, then forwards
        for z in range(stride):
            counts[0, z] = counts[1, z] = 0
            bound[z] = np.nan
        for j in range(b - middle if half else middle - a):
            i = middle + j if half else middle - 1 - j
            z, now = (events[i] >> 1) & 0xFFFF, np.float64(events[i] >> 17)
            if bound[z] == bound[z]:
                share = abs(now - bound[z]) / length
                excess(share, 0.0, counts[0, z], counts[1, z], numbers.ctypes, added.ctypes)
                for n in range(len(totals)):
                    cells[totals[n] * stride + z] += added[n]
            bound[z] = now
            one = np.float64(weights[i]) if len(weights) else 1.0
            counts[0 if events[i] & 1 else 1, z] += one if half else -one
        outer, edge = (right, 1e6 / length) if half else (left, -1e6 / length)
        for z in range(stride):
            if bound[z] == bound[z]:
                share = abs(outer - bound[z]) / length
                excess(share, edge, counts[0, z], counts[1, z], numbers.ctypes, added.ctypes)
                for n in range(len(totals)):
                    cells[totals[n] * stride + z] += added[n]
