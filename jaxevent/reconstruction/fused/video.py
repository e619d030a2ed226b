"""Video by kernels: events, recursion and images in one pass over bands of pixels."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.estimator import Estimate
from jaxevent.kernels import over_rows
from jaxevent.kernels.expressions import Untranslatable
from jaxevent.reconstruction.clock import Timing
from jaxevent.reconstruction.frames import FrameImages
from jaxevent.reconstruction.fused.bands import BandLayout
from jaxevent.reconstruction.fused.kernel import kernel_of
from jaxevent.reconstruction.fused.loop import Bands, FrameRows, Given, Images, Memory, run
from jaxevent.reconstruction.fused.timeline import NEVER, make_line
from jaxevent.reconstruction.stream import Stream, StreamState, weigh
from jaxevent.reconstruction.video import BEGINS, WINDOW_EVENTS, ImageSequence, P
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import Recording

IMAGE_PIXELS = 1 << 22  # made in one pass, 9 bytes each
FRAME_PIXELS = 1 << 26  # of a window's frames, as they are stored


class Begin(NamedTuple):
    """What filtering from a window's start needs."""

    start: int | None
    context: StreamState  # of weighted events
    cells: NDArray | None  # the state, band by band; None: the recording's beginning
    whole: NDArray | None
    last: NDArray | None

    @property
    def time(self) -> float:
        return -math.inf if self.start is None else float(self.start)


@dataclasses.dataclass
class OpenWindow:
    """A window, passed over up to a time (us since the recording's start)."""

    start: int | None
    stop: int | None
    given: Given
    context: StreamState
    time: int

    @property
    def begins(self) -> float:
        return -math.inf if self.start is None else float(self.start)

    def contains(self, time: int) -> bool:
        return self.begins <= time and (self.stop is None or time < self.stop)


class FusedVideo(ImageSequence[P]):
    """Images of a reconstruction, made by a kernel (`fused`); as `Video` in all else.

    Raises `Untranslatable` where there is no kernel for the method.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: P,
        *,
        window_events: int = WINDOW_EVENTS,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        timing = Timing.of(params)
        if timing.spread and not estimator.filters:
            raise Untranslatable("changes that are spread over time")
        self._windows = WindowedRecording(
            recording, timing, filtering=estimator.filters, events=window_events
        )
        self._windows.frames = max(8, FRAME_PIXELS // self._windows.pixels)
        layout = BandLayout.of(recording.width, recording.height)
        if layout is None:
            raise Untranslatable(f"a sensor {recording.width} pixels wide")
        self._layout = layout
        clock = self._windows.clock
        images = FrameImages(recording, self.dtype)
        self._kernel = kernel_of(
            estimator, estimator.observe, params, images.response(), len(clock) > 0,
            clock.exposed, self.dtype, layout.stride,
        )  # fmt: skip
        self._tables = images.tables() if len(clock) else np.zeros((3, 1), self.dtype)
        self._images = images
        self._memory = self._make_memory()
        begin = Begin(None, self._windows.initial(), None, None, None)
        self._begins, self._open = [begin], None

    @property
    def dtype(self) -> np.dtype:
        return self._windows.dtype

    def _make_memory(self) -> Memory:
        fields, bands = self._kernel.source.fields, len(self._layout.edges) - 1

        def made(number: int, kind: Any) -> NDArray:
            return np.zeros((bands, number * self._layout.stride), kind)

        return Memory(
            made(len(fields.cells), self.dtype),
            made(max(len(fields.whole), 1), np.int64),
            made(1, np.float64),
            np.zeros((bands, 3), np.int64),
        )

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        room = max(1, IMAGE_PIXELS // self._windows.pixels)
        done, origin = 0, self._windows.clock.origin
        while done < len(times):
            window = self._window_of(int(times[done]))
            end = len(times)
            if window.stop is not None:
                end = int(np.searchsorted(times, window.stop))
            batch = times[done : min(end, done + room)]
            shape = len(batch), self._windows.pixels
            kinds = self.dtype, self.dtype, np.uint8
            images = Images(*(np.empty(shape, kind) for kind in kinds))
            self._run(window, int(batch[-1]) - origin + 1, batch - origin, images)
            done += len(batch)
            yield batch, Estimate(images.mean, images.variance, images.valid.view(bool))

    def _run(
        self,
        window: OpenWindow,
        until: int,
        times: NDArray,
        images: Images,
        enter: tuple[int, int] = (-1, 0),
    ) -> None:
        """Pass over the window's events before a time (us since the recording's start)."""
        over_rows(
            run, len(self._layout.edges) - 1, window.given, self._memory, enter, times, until,
            images,
        )  # fmt: skip
        window.time = until - 1

    def _enter_stretch(self, window: OpenWindow, stretch: int, now: int) -> None:
        """Put the bands into a stretch, before all events."""
        self._run(window, -NEVER, *self._nothing(), (stretch, now))

    def _nothing(self) -> tuple[NDArray, Images]:
        """No images."""
        kinds = self.dtype, self.dtype, np.dtype(np.uint8)
        return np.empty(0, np.int64), Images(*(np.empty((0, 0), kind) for kind in kinds))

    def _window_of(self, time: int) -> OpenWindow:
        """The open window that contains `time`, not passed over beyond it."""
        at, window = time - self._windows.clock.origin, self._open
        if window is not None and window.contains(time) and window.time <= at:
            return window
        begin = [b for b in self._begins if b.time <= time][-1]
        behind = window is None or time < window.begins or window.begins < begin.time
        if window is None or behind or window.contains(time):
            window = self._enter(begin)
        while not window.contains(time):
            window = self._enter(self._finish(window))
        return window

    def _finish(self, window: OpenWindow) -> Begin:
        """Pass over the rest of a window; where the next one begins."""
        assert window.stop is not None
        self._run(window, window.stop - self._windows.clock.origin, *self._nothing())
        cells, whole, last, _ = self._memory
        held = sum(kind.kind == "f" for kind in self._kernel.program.traced.state)
        state = cells[:, : held * self._layout.stride].copy()
        begin = Begin(window.stop, window.context, state, whole.copy(), last.copy())
        if all(b.start != window.stop for b in self._begins):
            self._begins = sorted([*self._begins, begin], key=lambda b: b.time)
            if len(self._begins) > BEGINS:  # the first one, the last one, and half of the others
                self._begins = [self._begins[0], *self._begins[1:-1][::2], self._begins[-1]]
        return begin

    def _enter(self, begin: Begin) -> OpenWindow:
        """Divide a window's events among the bands, and put the bands at its start."""
        self._open = None  # so that two windows are never held at once
        window = self._cut(begin)
        memory, origin = self._memory, self._windows.clock.origin
        if begin.cells is None or begin.whole is None or begin.last is None:
            memory.last[:] = 0
            self._start(window)
            now = -NEVER
        else:
            memory.cells[:, : begin.cells.shape[1]] = begin.cells
            memory.whole[:], memory.last[:] = begin.whole, begin.last
            assert begin.start is not None
            now = begin.start - origin
        self._enter_stretch(window, 0, now)
        self._open = window
        return window

    def _cut(self, begin: Begin) -> OpenWindow:
        windows, start = self._windows, begin.start
        stop, source = windows.stop_after(start), self.recording.events
        rows = [0 if start is None else source.index(start)]
        rows.append(len(source) if stop is None else source.index(stop))
        used = windows.clock.used(start, stop)
        context, finish = windows.context_of(used, *rows)
        around, state = source[context:finish], begin.context
        weight = np.empty(0, self.dtype)
        if state.last_then is not None:
            state = windows.move_context(state, context)
            assert state.last_then is not None
            stream = Stream.of(around, self.recording.width)
            weight = weigh(stream, state.last_then.copy(), windows.dead).astype(self.dtype)
        origin, width = windows.clock.origin, self.recording.width
        events, weights, first = self._layout.divide(
            around.t, around.x, around.y, around.p, weight, width, origin
        )
        bands = Bands(events, weights, first, self._layout.edges, width)
        line = make_line(windows.clock, start, stop, self.recording.gain, self.dtype)
        kernel = self._kernel
        given = Given(
            bands, line, self._frames(used), kernel.source.fields.places(), kernel.functions,
            kernel.numbers,
        )  # fmt: skip
        return OpenWindow(start, stop, given, state, -NEVER)

    def _frames(self, used: slice) -> FrameRows:
        clock, frames = self._windows.clock, self.recording.frames
        left, mid, right = (e[used].astype(float) for e in (clock.left, clock.mid, clock.right))
        images, values = np.zeros((0, 1), np.uint8), np.zeros((0, 0, 1), self.dtype)
        if frames is not None and len(clock):
            images = np.asarray(frames[used].images)
            images = np.ascontiguousarray(images.reshape(len(images), -1))
            if images.dtype.kind == "f":
                values = self._images.values(images)
                images = np.zeros((0, 1), np.uint8)
        gain = self.recording.gain[used].astype(self.dtype)
        return FrameRows(images, self._tables, values, gain, left, mid, right, used.start)

    def _start(self, window: OpenWindow) -> None:
        """The state at the recording's start."""
        line, fields = window.given.line, self._kernel.source.fields
        stretch = int(np.searchsorted(line.start, 0, "right")) - 1
        self._enter_stretch(window, stretch, 0)
        stride, uniform = self._layout.stride, line.uniform[stretch]
        position = {
            "weight": -line.begin[stretch] * line.rate[stretch],
            "blend": -line.mid[stretch] * line.blend_rate[stretch],
        }

        def known(name: str) -> Any:
            if name in position:
                return position[name]
            if name in fields.cells:
                at = fields.cells[name] * stride
                return self._memory.cells[:, at : at + stride]
            return uniform[fields.uniform(name)]

        state = self._kernel.start(int(line.variant[stretch]), known)
        for k, values in enumerate(state):
            name = f"state{k}"
            of_cells = name in fields.cells
            array = self._memory.cells if of_cells else self._memory.whole
            at = (fields.cells if of_cells else fields.whole)[name] * stride
            array[:, at : at + stride] = values
