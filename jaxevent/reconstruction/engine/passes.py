"""A recording's windows divided among bands, and a kernel's passes over them."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import run_over_rows
from jaxevent.codegen.graph import TranslationError, evaluate_arrays
from jaxevent.errors import InputError
from jaxevent.reconstruction.engine.bands import BandLayout
from jaxevent.reconstruction.engine.entering import steps_of
from jaxevent.reconstruction.engine.kernel import kernel_of
from jaxevent.reconstruction.engine.loop import (
    Bands,
    FrameRows,
    Given,
    Images,
    Line,
    Memory,
    Steps,
    run,
)
from jaxevent.reconstruction.engine.pixel import Directions
from jaxevent.reconstruction.engine.timeline import NEVER, make_line
from jaxevent.reconstruction.features import allocate_aligned
from jaxevent.reconstruction.frames import FrameImages, Timing
from jaxevent.reconstruction.stream import Stream, StreamState, event_weights
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import ColumnSource, EventColumns, Recording

FRAME_PIXELS = 1 << 26  # of a window's frames, as they are stored


class Window(NamedTuple):
    """What a pass over a window rests on, whatever the kernel."""

    start: int | None
    stop: int | None
    bands: Bands
    line: Line
    frames: FrameRows
    context: StreamState  # of weighted events

    @property
    def begins(self) -> float:
        return -math.inf if self.start is None else float(self.start)

    def contains(self, time: int) -> bool:
        return self.begins <= time and (self.stop is None or time < self.stop)


class DividedRecording:
    """Cuts a recording into windows whose events are divided among bands of rows.

    `events` bounds a window's events; None: one window is the whole, for images with derivatives.
    `factors` (2, pixels) are those of single pixels' ON and OFF thresholds. Raises
    `TranslationError` for what kernels cannot do.
    """

    def __init__(
        self,
        recording: Recording,
        timing: Timing,
        filtering: bool,
        events: int | None = None,
        factors: NDArray[np.floating] | None = None,
    ):
        smaller = filtering and events is None
        layout = BandLayout.of(recording.width, recording.height, smaller)
        if layout is None:
            raise TranslationError(f"a sensor {recording.width} pixels wide")
        if recording.stop - recording.start >= NEVER:
            raise TranslationError("a recording of over a year")
        whole = max(len(recording.events), 1)
        self.recording, self.layout, self._factors = recording, layout, factors
        self.windows = WindowedRecording(
            recording, timing, filtering=filtering, events=whole if events is None else events
        )
        self.windows.frames = max(8, FRAME_PIXELS // self.windows.pixels)
        if events is None:
            self.windows.frames = len(self.windows.clock) + 2
        self.images = FrameImages(recording, self.dtype)
        none = np.zeros((3, 1), self.dtype)
        self._tables = self.images.tables() if len(self.windows.clock) else none
        self._response = self.images.response()
        # What windows are read and divided into, one after another.
        self._stored: EventColumns | None = None
        self._divided = np.empty(0, np.int64)

    @property
    def dtype(self) -> np.dtype:
        return self.windows.dtype

    @property
    def origin(self) -> int:
        """The recording's start (us), from which kernels count."""
        return self.windows.clock.origin

    def kernel(
        self,
        method: Any,
        params: Any,
        clock_offset: Any,
        directions: Directions = Directions(),  # noqa: B008
    ) -> Any:
        """The kernel of a method, for this recording's frames.

        `clock_offset` is the one that the recording was divided for.
        """
        fixed, clock = self.fixed(clock_offset), self.windows.clock
        layout = clock.exposed, self.dtype, self.layout.stride
        return kernel_of(method, params, fixed, layout, directions)

    def check(self, method: Any, params: Any, clock_offset: Any, directions: Directions) -> None:
        """Raise `TranslationError` if there can be no such kernel."""
        layout = self.windows.clock.exposed, self.dtype, self.layout.stride
        kernel_of(method, params, self.fixed(clock_offset), layout, directions, compiled=False)

    def fixed(self, clock_offset: Any) -> dict[str, NDArray]:
        """What is known with the parameters."""
        return {
            "clock_offset": np.asarray(clock_offset, self.dtype),
            "present": np.asarray(len(self.windows.clock) > 0, self.dtype),
            "response": self._response,
        }

    def cut(self, start: int | None, state: StreamState) -> Window:
        """The window that begins there, its events divided among the bands."""
        windows = self.windows
        stop, source = windows.stop_after(start), self.recording.events
        rows = [0 if start is None else source.index(start)]
        rows.append(len(source) if stop is None else source.index(stop))
        used = windows.clock.used(start, stop)
        bands, state = self.divide(state, *windows.context_of(used, *rows))
        line = make_line(windows.clock, start, stop, self.recording.gain, self.dtype)
        return Window(start, stop, bands, line, self.frames(used), state)

    def divide(self, state: StreamState, context: int, finish: int) -> tuple[Bands, StreamState]:
        """A range of rows of the events, divided among the bands; the state moved to its begin.

        Bands that were divided before are overwritten.
        """
        windows, source = self.windows, self.recording.events
        weight = np.empty(0, self.dtype)
        plain = state.context_last is None and self._factors is None
        if plain and isinstance(source, ColumnSource):
            stored = source.columns(slice(context, finish), self._stored)
            self._stored = stored
            bands = None if stored is None else self._bands_of(stored, weight)
            if bands is not None:
                return bands, state
        around = source[context:finish]  # raises `InputError` for what is not valid
        if state.context_last is not None:
            state = windows.move_context(state, context)
            assert state.context_last is not None
            stream = Stream.of(around, self.recording.width)
            weight = event_weights(stream, state.context_last.copy(), windows.dead).astype(
                self.dtype
            )
        if self._factors is not None:
            pixel = around.y.astype(np.int64) * self.recording.width + around.x
            factors = self._factors[np.where(around.p, 0, 1), pixel]
            weight = (factors * weight if len(weight) else factors).astype(self.dtype)
        least = np.iinfo(np.int64).min
        checked = EventColumns(around.t, around.x, around.y, around.p.view(np.uint8), 0, least)
        bands = self._bands_of(checked, weight)
        if bands is None:  # somebody changed arrays after they were checked
            name = self.recording.name
            around.check(self.recording.width, self.recording.height, name, context)
            raise InputError(f"{name}: events changed while they were read; make a new recording")
        return bands, state

    def _bands_of(self, stored: EventColumns, weight: NDArray) -> Bands | None:
        divided = self.layout.divide(
            stored, weight, self.recording.width, self.origin, self._divided
        )
        if divided is None:
            return None
        self._divided, weights, first = divided
        return Bands(self._divided, weights, first, self.layout.edges, self.recording.width)

    def frames(self, used: slice) -> FrameRows:
        clock, frames = self.windows.clock, self.recording.frames
        left, mid, right = (e[used].astype(float) for e in (clock.left, clock.mid, clock.right))
        images, values = np.zeros((0, 1), np.uint8), np.zeros((0, 0, 1), self.dtype)
        if frames is not None and len(clock):
            images = np.asarray(frames[used].images)
            images = np.ascontiguousarray(images.reshape(len(images), -1))
            if images.dtype.kind == "f":
                values = self.images.values(images)
                images = np.zeros((0, 1), np.uint8)
        gain = self.recording.gain[used].astype(self.dtype)
        return FrameRows(images, self._tables, values, gain, left, mid, right, used.start)


@dataclasses.dataclass(frozen=True)
class Held:
    """The state of all pixels, band by band."""

    cells: NDArray
    whole: NDArray
    last: NDArray


class Passes:
    """A kernel, and what its bands remember from one pass over events to the next."""

    def __init__(self, kernel: Any, layout: BandLayout, dtype: np.dtype):
        fields, bands = kernel.places, len(layout.edges) - 1
        self.kernel, self.layout, self.dtype = kernel, layout, dtype
        places, stride = fields.places, layout.stride
        self._memory = Memory(
            allocate_aligned((bands, fields.size), dtype),
            np.zeros((bands, max(len(fields.whole), 1) * stride), np.int64),
            np.zeros((bands, stride)),
            np.zeros((bands, 2), np.int64),
            np.empty((bands, max(places.room, (places.factors + 1) * stride)), dtype),
            np.empty((bands, stride)),
            np.empty((bands, 3, stride), dtype),
        )
        self._steps = Steps(np.zeros((0, 5), np.int64), np.zeros(1, np.int64))

    def run(
        self,
        window: Window,
        until: int,
        times: NDArray | None = None,
        images: Images | None = None,
        enter: tuple[int, int] = (-1, 0),
    ) -> None:
        """Pass over the window's events before a time (us since the recording's start)."""
        kernel = self.kernel
        places = kernel.places.places
        if enter[0] >= 0:
            self._steps = steps_of(places, window.line, window.frames, enter)
        given = Given(
            window.bands, window.line, self._steps, window.frames, places.total,
            self.layout.stride, kernel.functions, kernel.numbers,
        )  # fmt: skip
        if times is None or images is None:
            times, images = np.empty(0, np.int64), self.room(0, 0)
        run_over_rows(
            run, len(self.layout.edges) - 1, given, self._memory, enter, times, until, images
        )

    def room(self, times: int, pixels: int) -> Images:
        """Where images go, and derivatives of those that have any."""
        shape, fields = (times, pixels), self.kernel.places
        slopes = np.empty((*shape, len(fields.outputs), fields.lanes), self.dtype)
        mean, variance = np.empty(shape, self.dtype), np.empty(shape, self.dtype)
        return Images(mean, variance, np.empty(shape, np.uint8), slopes)

    def begin(self, window: Window) -> None:
        """Enter the recording's first window: the state at the start."""
        self._memory.last[:] = 0
        self._start(window)
        self.run(window, -NEVER, enter=(0, -NEVER))

    def resume(self, window: Window, held: Held, now: int) -> None:
        """Enter a later window at its beginning (us since the recording's start)."""
        memory = self._memory
        memory.cells[:, : held.cells.shape[1]] = held.cells
        memory.whole[:], memory.last[:] = held.whole, held.last
        self.run(window, -NEVER, enter=(0, now))

    def state(self) -> Held:
        """A copy of the state, without derivatives."""
        cells, whole, last = self._memory[:3]
        held = sum(kind.kind == "f" for kind in self.kernel.program.traced.state)
        return Held(cells[:, : held * self.layout.stride].copy(), whole.copy(), last.copy())

    def _start(self, window: Window) -> None:
        """The state at the recording's start, with its derivatives."""
        line, fields, memory = window.line, self.kernel.places, self._memory
        stretch = int(np.searchsorted(line.start, 0, "right")) - 1
        self.run(window, -NEVER, enter=(stretch, 0))
        uniform = line.uniform[stretch]
        position = {
            "weight": -line.begin[stretch] * line.rate[stretch],
            "blend": -line.mid[stretch] * line.blend_rate[stretch],
        }

        addresses = fields.addresses()

        def known(name: str) -> Any:
            if name in position:
                return position[name]
            if name in fields.cells:
                return fields.of_bands(name, memory.cells, memory.whole)
            return uniform[addresses[name][2]]

        records, program = fields.records(memory.cells), self.kernel.program
        start = program.start[int(line.variant[stretch])]
        made = evaluate_arrays([*start.values()], known, self.kernel.values, program.dtype)
        state = dict(zip(start, made, strict=True))
        for name, values in state.items():
            if name.startswith("state"):
                fields.of_bands(name, memory.cells, memory.whole)[:] = values
                continue
            leaf, _, direction = name.removeprefix("slope").partition("_")
            place = fields.states.get(int(leaf))
            if place is not None:
                records[:, :, place + int(direction)] = values
