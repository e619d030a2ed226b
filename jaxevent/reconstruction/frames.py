"""The frames of a window: when they were taken, their values, and the events between them."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.cache import ByValue
from jaxevent.calibration.clipping import find_clipping
from jaxevent.camera import Response
from jaxevent.codegen import njit, read_only
from jaxevent.codegen.graph import evaluate_function
from jaxevent.events.live import Tail
from jaxevent.parameters import read_float
from jaxevent.reconstruction.features import (
    ExposureSegments,
    FrameFeatures,
    ImagePoints,
    allocate_aligned,
)
from jaxevent.reconstruction.stream import EdgeCounts, EventStream
from jaxevent.recording import Recording

MIN_SEGMENT_CAPACITY = 1 << 14  # for which memory is allocated; eightfold until it suffices


class EventTiming(NamedTuple):
    """Parameters of every estimator that preparation compares event times with, s.

    An event after the gap dt at its pixel stands for min(dt / (dt - rho_ref), 3) events: what
    happened in the dead time is lost.

    An event is late: the intensity has been moving since the pixel's last one. If `spread` or less
    lies between the two, the second's change is spread evenly over that time. This needs later
    events and is for methods that do not pass over single events.
    """

    clock_offset: float = 0.0  # added to the frames' time stamps
    event_delay: float = 0.0  # by which events lag behind the changes that they stand for
    exposure: float = 0.0  # of frames whose own is not known
    rho_ref: float = 0.0  # dead time of a pixel after an event
    spread: float = 0.0

    @classmethod
    def of(cls, params: Any) -> "EventTiming":
        """Read an estimator's parameters, rounded to 10 ns: float32 has 7.5 ms as 7500 us too."""
        return cls(**{name: round(read_float(params, name), 8) for name in cls._fields})

    @property
    def frame_delay(self) -> float:
        """Time added to the frames' stamps to be beside the events that show the same, s."""
        return self.clock_offset + self.event_delay

    @property
    def image_delay_us(self) -> int:
        """Time added to that of an image to be beside the events that show it, us.

        At the time of a frame, its stamp and `clock_offset`, it is exactly that of the frame.
        """
        return round(1e6 * self.frame_delay) - round(1e6 * self.clock_offset)


def time_span(recording: Recording, clock_offset: Any = 0.0) -> tuple[int, int]:
    """Return the first and last time at which images rest on data.

    Args:
        recording: Events and frames.
        clock_offset: Added to the frames' time stamps, s.

    Returns:
        Times of the first and last event or frame, us, with frames both as stamped and on the
        events' clock.
    """
    late = 0 if recording.frames is None else round(float(clock_offset) * 1e6)
    return recording.start + min(late, 0), recording.stop + max(late, 0)


class FrameTimes(NamedTuple):
    """Times of the frames of a window, us from the recording's start, for compiled loops."""

    origin: int  # us, the recording's start
    breaks: NDArray[np.floating]  # ends of pieces
    weight_rate: NDArray[np.floating]  # 1 / length of each piece, 1/us
    mids: NDArray[np.floating]  # mid-exposures
    blend_rate: NDArray[np.floating]  # 1 / time to the next mid-exposure, 1/us
    begins_piece: NDArray[np.bool_]  # whether a piece begins at the left edge of the exposure
    exposed: bool  # whether exposures are pieces of their own


@dataclasses.dataclass(frozen=True)
class FrameClock:
    """Times of the frames, float64 microseconds from the recording's start, offset applied.

    `breaks` are the times at which pieces end. Exposures that overlap (a jittering stamp) share the
    overlap as their gap, clipped to the two mid-exposures, so that the augmented frame stays
    continuous. Exposures that do not overlap are used as they are.

    Attributes:
        mid: (frames,) middles of the exposures, us.
        left: (frames,) begins of the exposures, us.
        right: (frames,) ends of the exposures, us.
        breaks: Times at which pieces end, us.
        exposed: Whether exposures are pieces of their own.
        offset: Offset that was added to the stamps, s.
        origin: Start of the recording, us.
    """

    mid: NDArray[np.floating]
    left: NDArray[np.floating]
    right: NDArray[np.floating]
    breaks: NDArray[np.floating]
    exposed: bool
    offset: float
    origin: int

    @classmethod
    def of(cls, recording: Recording, timing: EventTiming) -> "FrameClock":
        """Read the times of a recording's frames."""
        offset = round(timing.frame_delay * 1e8) / 100
        frames, origin = recording.frames, recording.start
        if frames is None:
            none = np.empty(0)
            return cls(none, none, none, none, False, offset * 1e-6, origin)
        mid = (frames.t - origin) + offset
        unknown = round(timing.exposure * 1e8) / 100
        exposure = np.where(frames.exposure > 0, frames.exposure, unknown)
        left, right = mid - exposure / 2, mid + exposure / 2
        exposed = bool((exposure > 0).any())
        breaks = mid
        if exposed:
            gap = np.sort([right[:-1], left[1:]], axis=0).clip(mid[:-1], mid[1:])
            breaks = np.stack([np.r_[left[0], gap[1]], np.r_[gap[0], right[-1]]], 1).ravel()
        return cls(mid, left, right, breaks, exposed, offset * 1e-6, origin)

    def __len__(self) -> int:
        return len(self.mid)

    def frame_of_piece(self, piece: Any) -> Any:
        """Return the frame from whose left edge pieces count events; -1: before any exposure."""
        return (piece - 1) // 2 if self.exposed else piece - 1

    def first_piece(self, first_frame: int) -> int:
        """Return the piece that is 0 in a window, which stands for all before `first_frame`."""
        return (2 if self.exposed else 1) * first_frame

    def locate(self, elapsed_us: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Find times (us from the recording's start) among the frames.

        Returns:
            For each time the piece, the frame before (0 if none is), the position in the piece and
            the position between the mid-exposures of two frames, both 0 to 1.
        """
        piece = np.searchsorted(self.breaks, elapsed_us, "right")
        frame = np.searchsorted(self.mid, elapsed_us, "right") - 1
        weight, blend = (
            _position(self.breaks, piece - 1, elapsed_us),
            _position(self.mid, frame, elapsed_us),
        )
        return piece, np.maximum(frame, 0), weight, blend

    def seconds_since_frame(self, elapsed_us: NDArray, frame: NDArray) -> NDArray:
        """Return the time from the middle of frames to some times.

        Args:
            elapsed_us: (times,) us from the recording's start.
            frame: (times,) numbers of frames.

        Returns:
            (times,) s; 0 without frames.
        """
        return (elapsed_us - self.mid[frame]) * 1e-6 if len(self) else np.zeros(len(elapsed_us))

    def frames_within(self, start_us: int | None, stop_us: int | None) -> slice:
        """Return the frames of a span of time, and one more on each side.

        Args:
            start_us: Begin of the span, us; None: the first frame.
            stop_us: End of the span, us; None: the last frame.

        Returns:
            The range of frames.
        """
        span = np.array(
            [
                -np.inf if start_us is None else start_us - self.origin,
                np.inf if stop_us is None else stop_us - self.origin,
            ]
        )
        first, last = self.frame_of_piece(np.searchsorted(self.breaks, span, "right"))
        return slice(max(int(first) - 1, 0), min(max(int(last), 0) + 2, len(self)))

    def exposure_edges(self, frame_range: slice) -> list[NDArray[np.int64]]:
        """Return left edge, middle and right edge of exposures, us on the recording's clock.

        An event with t < edge is before the edge. Half microseconds are rounded up, which orders
        whole ones alike.
        """
        edges = (self.left, self.mid, self.right)
        return [np.ceil(edge[frame_range]).astype(np.int64) + self.origin for edge in edges]

    def times_from(self, first_frame: int) -> FrameTimes:
        """Return the times of the frames from `first_frame` on."""
        breaks, mids = self.breaks[self.first_piece(first_frame) :], self.mid[first_frame:]
        begins_piece = self.left[first_frame:] == (breaks[::2] if self.exposed else breaks)
        return FrameTimes(
            self.origin,
            breaks,
            interval_rates(breaks),
            mids,
            interval_rates(mids),
            begins_piece,
            self.exposed,
        )


def interval_rates(breaks_us: NDArray) -> NDArray:
    """Return 1 / length (1/us) of the intervals between breaks, 0 for empty ones."""
    length = np.diff(breaks_us)
    return np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)


def _position(breaks: NDArray, i: NDArray, time: NDArray) -> NDArray:
    """Return the position of times in their intervals between breaks.

    Args:
        breaks: Sorted breaks, us.
        i: (times,) index of the break before each time.
        time: (times,) times, us.

    Returns:
        (times,), 0 to 1; 0 outside the first and last break.
    """
    inside = (i >= 0) & (i < len(breaks) - 1)
    if not inside.any():
        return np.zeros(len(time))
    j = np.where(inside, i, 0)
    return np.where(inside, (time - breaks[j]) * interval_rates(breaks)[j], 0)


def evaluate_response(response: Response, grey: NDArray) -> NDArray:
    """Evaluate a camera's response.

    Args:
        response: The response.
        grey: Grey values in [0, 1].

    Returns:
        Grey values, intensities and certainties [3, ...].
    """
    functions = (lambda grey: grey, response.intensity, response.certainty)
    return np.stack([evaluate_function(function, grey) for function in functions])


@functools.lru_cache(maxsize=8)
def _response_table(response: ByValue, dtype: np.dtype, count: int) -> NDArray:
    """Evaluate the response at (3, count) evenly spaced grey values, in the precision of JAX.

    Args:
        response: The response; equal ones share a table.
        dtype: JAX's own real numbers, with which it is evaluated.
        count: Number of grey values from 0 to 1.

    Returns:
        See `evaluate_response`.
    """
    return read_only(evaluate_response(response.tree, np.arange(count) / max(count - 1, 1)))


class FrameImages:
    """The frames of a recording as grey values, intensities and certainties of type `dtype`."""

    def __init__(self, recording: Recording, dtype: np.dtype):
        self.recording, self.dtype = recording, dtype
        self._response, self._gain = ByValue(recording.response), recording.gain

    def response(self) -> NDArray:
        """Return the intensities of 256 evenly spaced grey values."""
        return self._table(256)[1]

    @functools.cached_property
    def white(self) -> NDArray | None:
        """See `FrameFeatures.white`; of a live recording, whose frames come later, None."""
        if isinstance(self.recording.events, Tail):
            return None
        found = find_clipping(self.recording).white
        return None if found.level is None else np.array([found.level, found.excess], self.dtype)

    @functools.cached_property
    def tables(self) -> NDArray:
        """Return grey value, intensity and certainty of every whole number of an image."""
        assert self.recording.frames is not None
        kind = self.recording.frames.images.dtype
        levels = 1 + (np.iinfo(kind).max if kind.kind in "iu" else 0)
        return self._table(levels)

    def values(self, images: NDArray) -> NDArray:
        """Return grey values, intensities and certainties [3, ...] of images in [0, 1]."""
        return evaluate_response(self._response.tree, images).astype(self.dtype)

    def _table(self, count: int) -> NDArray:
        """Return `evaluate_response` [3, count] of evenly spaced grey values."""
        real = np.dtype(jnp.result_type(float))
        return _response_table(self._response, real, count).astype(self.dtype)

    def read(self, frame_range: slice, capacity: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Read a range of frames.

        Args:
            frame_range: Range of the recording's frames.
            capacity: Rows of the results. Spare rows repeat the last frame.

        Returns:
            Grey values, intensities and certainties, each [capacity, pixels], and gains
            [capacity]. Without frames grey values and intensities are 0.5, certainties 0.
        """
        pixels, n = (
            self.recording.width * self.recording.height,
            frame_range.stop - frame_range.start,
        )
        grey, intensity, certainty = (
            allocate_aligned((capacity, pixels), self.dtype) for _ in range(3)
        )
        grey[:], intensity[:] = 0.5, 0.5
        gain = np.ones(capacity, self.dtype)
        if n:
            assert self.recording.frames is not None
            images = np.asarray(self.recording.frames[frame_range].images).reshape(n, pixels)
            outs = (grey, intensity, certainty)
            if images.dtype.kind == "f":
                for values, out in zip(self.values(images), outs, strict=True):
                    out[:n] = values
            else:
                for table, out in zip(self.tables, outs, strict=True):
                    np.take(table, images, out=out[:n])
            for out in outs:
                out[n:] = out[n - 1]
            gain[:n] = self._gain[frame_range]
            intensity[:n] /= gain[:n, None]
            intensity[n:] = intensity[n - 1]
        return grey, intensity, certainty, gain

    def sample(self, frame_range: slice, step: int) -> NDArray:
        """Read the intensities of every `step`-th row and column of a range of frames.

        Args:
            frame_range: Range of the recording's frames.
            step: Step, px.

        Returns:
            (frames, rows, columns).
        """
        assert self.recording.frames is not None
        images = np.asarray(self.recording.frames[frame_range].images)[:, ::step, ::step]
        made = self.values(images)[1] if images.dtype.kind == "f" else self.tables[1][images]
        return made / self._gain[frame_range, None, None]


def make_frame_features(
    images: FrameImages,
    clock: FrameClock,
    frame_range: slice,
    rows: NDArray[np.int32],
    counts: EdgeCounts,
    *,
    segments: ExposureSegments | None,
    unseen: tuple[float, float],
    filtering: bool,
    capacity: int,
) -> FrameFeatures:
    """Prepare a range of frames.

    Args:
        images: Frames of the recording.
        clock: Times of all its frames.
        frame_range: Range of frames.
        rows: The numbers `FrameFeatures.rows`.
        counts: Events before the edges of the exposures.
        segments: Segments within the exposures, where these are known.
        unseen: Flicker of the frames, and movement; see `unseen.UnseenChange`.
        filtering: Count the events around each pixel, for filters.
        capacity: Frames for which memory is allocated.

    Returns:
        The features.
    """
    dtype, n, pixels = images.dtype, len(counts.mid), counts.base.start.shape[1]
    grey, intensity, certainty, gain = images.read(frame_range, capacity)
    shape = (2, capacity, pixels)
    span, before = allocate_aligned(shape, dtype), np.zeros((2, pixels), dtype)
    if n:
        span[:, : n - 1] = (counts.right[1:] - counts.base.left[:-1]).swapaxes(0, 1)
        before[:] = counts.right[0] - (counts.base.start if frame_range.start == 0 else 0)
    head = tail = None
    if clock.exposed:
        head, tail = allocate_aligned(shape, dtype), allocate_aligned(shape, dtype)
        head[:, :n] = (counts.mid - counts.base.left).swapaxes(0, 1)
        tail[:, :n] = (counts.right - counts.mid).swapaxes(0, 1)

    pieces = (2 if clock.exposed else 1) * capacity + 1
    breaks = clock.breaks[clock.first_piece(frame_range.start) :]
    weight_rate, blend_rate = np.zeros(pieces, dtype), np.zeros(capacity, dtype)
    for out, times in ((weight_rate[1:], breaks), (blend_rate, clock.mid[frame_range])):
        rate = 1e6 * interval_rates(times)[: len(out)]
        out[: len(rate)] = rate

    around = sum_around(span.sum(0), images.recording.width) if filtering else None
    present = np.asarray(float(frame_range.stop > frame_range.start), dtype)
    return FrameFeatures(
        grey, intensity, certainty, images.response(), gain, images.white, span, around, before,
        head, tail, segments, weight_rate, blend_rate, present, rows,
        np.asarray(clock.offset, dtype), *(np.asarray(value, dtype) for value in unseen),
        images.recording.width,
    )  # fmt: skip


def sum_around(values: NDArray, width: int) -> NDArray:
    """Sum values over the 3x3 pixels around each pixel of a sensor.

    Args:
        values: (frames, pixels).
        width: Width of the sensor, px.

    Returns:
        (frames, pixels).
    """
    image = np.pad(values.reshape(len(values), -1, width), ((0, 0), (1, 1), (1, 1)))
    rows = image[:, :-2] + image[:, 1:-1] + image[:, 2:]
    around = rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:]
    return around.reshape(values.shape)


def make_segments(
    clock: FrameClock,
    frame_range: slice,
    stream: EventStream,
    weight: NDArray,
    counts: EdgeCounts,
    dtype: np.dtype,
) -> ExposureSegments:
    """Cut the exposures of a range of frames into segments of constant brightness.

    Args:
        clock: Times of the frames.
        frame_range: Range of frames.
        stream: Events of all their exposures.
        weight: (events,) number of events that each event stands for.
        counts: Events before the edges of the exposures; here only their shape and type.
        dtype: Type of the results.

    Returns:
        The segments, with memory for more.
    """
    exact = np.stack(
        [clock.left[frame_range], clock.mid[frame_range], clock.right[frame_range]], axis=1
    )
    parts = []
    for row, edges in enumerate(np.stack(clock.exposure_edges(frame_range), axis=1)):
        i, middle, j = (int(np.searchsorted(stream.t, edge)) for edge in edges)
        if i < j:
            part = stream.slice_rows(i, j)._replace(t=stream.t[i:j] - clock.origin)
            count = np.zeros_like(counts.base.start)
            parts.append(_cut_exposure(part, weight[i:j], middle - i, row, exact[row], count))
    total = sum(len(part[0]) for part in parts)
    capacity = MIN_SEGMENT_CAPACITY
    while capacity < total:
        capacity *= 8
    fields = []
    for f, kind in enumerate((np.int32, dtype, dtype, dtype, dtype)):
        field = allocate_aligned((capacity,), kind)
        if parts:
            field[:total] = np.concatenate([part[f] for part in parts])
        fields.append(field)
    return ExposureSegments(*fields)


def make_start_points(clock: FrameClock, n_pixels: int, dtype: np.dtype) -> ImagePoints:
    """Prepare the recording's start, before any event; the first window alone uses it.

    Args:
        clock: Times of the frames.
        n_pixels: Number of pixels of the sensor.
        dtype: Type of real numbers.

    Returns:
        One point in time for all pixels.
    """
    piece, frame, weight, blend = clock.locate(np.zeros(1))
    counts = np.zeros((1, n_pixels), dtype)
    return ImagePoints(
        weight[:, None].astype(dtype),
        blend[:, None].astype(dtype),
        counts,
        counts,
        piece.astype(np.int32),
        frame.astype(np.int32),
        clock.seconds_since_frame(np.zeros(1), frame).astype(dtype),
    )


@njit
def _cut_exposure(stream, weight, middle, row, edges, count):
    """Cut one exposure into segments of constant brightness.

    Args:
        stream: Events of the exposure, with times from the recording's start, us.
        weight: (events,) number of events that each event stands for.
        middle: Index of the first event after the exposure's middle.
        row: Number of the frame.
        edges: Left edge, middle and right edge, us.
        count: (2, pixels) of zeros, scratch.

    Returns:
        The fields of `ExposureSegments`, one number for each event.
    """
    t, x, y, p = stream.t, stream.x, stream.y, stream.p
    n, pixels = len(t), count.shape[1]
    length = edges[2] - edges[0]
    cell = np.empty(n, np.int64)
    share, edge = np.zeros(n), np.zeros(n)
    on, off = np.zeros(n), np.zeros(n)
    for i in range(n):
        cell[i] = row * pixels + np.int64(y[i]) * stream.width + x[i]
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
