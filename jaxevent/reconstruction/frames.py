"""Features of the frames in a window, and the event counts that tie them together."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.codegen import njit
from jaxevent.codegen.graph import evaluate_function
from jaxevent.reconstruction.clock import Clock, rates
from jaxevent.reconstruction.features import FrameFeatures, ImagePoints, Segments
from jaxevent.reconstruction.memory import aligned
from jaxevent.reconstruction.stream import EdgeCounts, Stream
from jaxevent.recording import Recording


@jax.jit
def _look_up(tables: Array, levels: Array, rows: Array, gain: Array) -> tuple[Array, Array, Array]:
    grey, intensity, certainty = tables[:, levels][:, rows]
    return grey, intensity / gain[:, None], certainty


class FrameImages:
    """The frames of a recording as grey values, intensities and certainties of type `dtype`."""

    def __init__(self, recording: Recording, dtype: np.dtype):
        self.recording, self.dtype = recording, dtype
        response, self._gain = recording.response, recording.gain
        self._tables = (lambda grey: grey, response.intensity, response.certainty)

    def response(self) -> NDArray:
        """Intensities of 256 evenly spaced grey values."""
        return evaluate_function(self._tables[1], np.linspace(0, 1, 256)).astype(self.dtype)

    def tables(self) -> NDArray:
        """Grey values, intensities and certainties of the levels that whole numbers stand for."""
        assert self.recording.frames is not None
        kind = self.recording.frames.images.dtype
        levels = 1 + (np.iinfo(kind).max if kind.kind in "iu" else 0)
        return self.values(np.arange(levels) / max(levels - 1, 1))

    def values(self, images: NDArray) -> NDArray:
        """Grey values, intensities and certainties [3, ...] of images in [0, 1]."""
        made = [evaluate_function(table, images).astype(self.dtype) for table in self._tables]
        return np.stack(made)

    def read_on_device(self, used: slice, room: int) -> tuple[Any, Any, Any, NDArray]:
        """The same as `read`, of whole numbers looked up on the device."""
        frames, n = self.recording.frames, used.stop - used.start
        if frames is None or n <= 0 or frames.images.dtype.kind not in "iu":
            return self.read(used, room)
        pixels = self.recording.width * self.recording.height
        levels = np.asarray(frames[used].images).reshape(n, pixels)
        gain = np.ones(room, self.dtype)
        gain[:n] = self._gain[used]
        spare = np.minimum(np.arange(room), n - 1)  # rows that repeat the last
        looked = _look_up(self.tables(), levels, spare, gain[spare])
        return *looked, gain

    def read(self, used: slice, room: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Grey values, intensities, certainties [room, pixels] and gains of a range of frames.

        Spare rows repeat the last; without frames all is 0.5, certainties 0.
        """
        pixels, n = self.recording.width * self.recording.height, used.stop - used.start
        grey, intensity, certainty = (aligned((room, pixels), self.dtype) for _ in range(3))
        grey[:], intensity[:] = 0.5, 0.5
        gain = np.ones(room, self.dtype)
        if n:
            assert self.recording.frames is not None
            images = np.asarray(self.recording.frames[used].images).reshape(n, pixels)
            outs = (grey, intensity, certainty)
            if images.dtype.kind == "f":
                for values, out in zip(self.values(images), outs, strict=True):
                    out[:n] = values
            else:
                for table, out in zip(self.tables(), outs, strict=True):
                    np.take(table, images, out=out[:n])
            for out in outs:
                out[n:] = out[n - 1]
            gain[:n] = self._gain[used]
            intensity[:n] /= gain[:n, None]
            intensity[n:] = intensity[n - 1]
        return grey, intensity, certainty, gain


def make_frame_features(
    images: FrameImages,
    clock: Clock,
    used: slice,
    rows: NDArray[np.int32],
    room: int,
    counts: EdgeCounts,
    segments: Segments | None,
) -> FrameFeatures:
    """Features of the frames `used`, with room for `room`; `rows` are those of the features."""
    dtype, n, pixels = images.dtype, len(counts.mid), counts.base.start.shape[1]
    looked = images.read(used, room)
    span, before = aligned((2, room, pixels), dtype), np.zeros((2, pixels), dtype)
    if n:
        span[:, : n - 1] = (counts.right[1:] - counts.base.left[:-1]).swapaxes(0, 1)
        before[:] = counts.right[0] - (counts.base.start if used.start == 0 else 0)
    head = tail = None
    if clock.exposed:
        head, tail = (aligned((2, room, pixels), dtype) for _ in range(2))
        head[:, :n] = (counts.mid - counts.base.left).swapaxes(0, 1)
        tail[:, :n] = (counts.right - counts.mid).swapaxes(0, 1)

    return gathered(images, clock, used, rows, looked, (span, before, head, tail), segments)


def gathered(
    images: FrameImages,
    clock: Clock,
    used: slice,
    rows: NDArray[np.int32],
    looked: tuple[Any, Any, Any, NDArray],
    between: tuple[Any, Any, Any, Any],
    segments: Segments | None,
) -> FrameFeatures:
    """The features, of frames as `FrameImages.read` gives them and events between their edges."""
    grey, intensity, certainty, gain = looked
    present = np.asarray(float(used.stop > used.start), images.dtype)
    rates_of = _piece_rates(clock, used, len(gain), images.dtype)
    return FrameFeatures(
        grey, intensity, certainty, images.response(), gain, *between, segments, *rates_of,
        present, rows, np.asarray(clock.offset, images.dtype), images.recording.width,
    )  # fmt: skip


def _piece_rates(clock: Clock, used: slice, room: int, dtype: np.dtype) -> tuple[NDArray, NDArray]:
    """How fast weights grow in each piece and blends after each frame of `used`, 1/s."""
    pieces = (2 if clock.exposed else 1) * room + 1
    breaks = clock.breaks[clock.first_piece(used.start) :]
    weight_rate, blend_rate = np.zeros(pieces, dtype), np.zeros(room, dtype)
    for out, times in ((weight_rate[1:], breaks), (blend_rate, clock.mid[used])):
        rate = 1e6 * rates(times)[: len(out)]
        out[: len(rate)] = rate
    return weight_rate, blend_rate


def make_segments(
    clock: Clock,
    used: slice,
    stream: Stream,
    weight: NDArray,
    counts: EdgeCounts,
    dtype: np.dtype,
) -> Segments:
    """Segments of constant brightness within the exposures of the frames `used`.

    `stream` are the events of all exposures, `weight` what each stands for.
    """
    exact = np.stack([clock.left[used], clock.mid[used], clock.right[used]], axis=1)
    parts = []
    for row, edges in enumerate(np.stack(clock.edges(used), axis=1)):
        i, middle, j = (int(np.searchsorted(stream.t, edge)) for edge in edges)
        if i < j:
            part = stream.part(i, j)._replace(t=stream.t[i:j] - clock.origin)
            count = np.zeros_like(counts.base.start)
            parts.append(_cut_exposure(part, weight[i:j], middle - i, row, exact[row], count))
    total = sum(len(part[0]) for part in parts)
    room = 1 << 14
    while room < total:
        room *= 8
    fields = []
    for f, kind in enumerate((np.int32, dtype, dtype, dtype, dtype)):
        field = aligned((room,), kind)
        if parts:
            field[:total] = np.concatenate([part[f] for part in parts])
        fields.append(field)
    return Segments(*fields)


def make_start(clock: Clock, pixels: int, dtype: np.dtype) -> ImagePoints:
    """The recording's start, where no event has happened; only the first window uses it."""
    piece, frame, weight, blend = clock.locate(np.zeros(1))
    counts = np.zeros((1, pixels), dtype)
    return ImagePoints(
        weight[:, None].astype(dtype),
        blend[:, None].astype(dtype),
        counts,
        counts,
        piece.astype(np.int32),
        frame.astype(np.int32),
        clock.elapsed(np.zeros(1), frame).astype(dtype),
    )


@njit
def _cut_exposure(stream, weight, middle, row, edges, count):
    """Segments of constant brightness within one exposure; events `middle` on lie after its mid."""
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
