"""What passes over a smoother's frames rest on: its kernel, events in bands, memory."""

import queue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.engine.bands import BandLayout
from jaxevent.reconstruction.engine.frame_loop import (
    FrameLine,
    FramePlaces,
    GivenFrames,
    Instants,
    Room,
    follow_events,
)
from jaxevent.reconstruction.engine.loop import Bands, Images
from jaxevent.reconstruction.engine.passes import DividedRecording
from jaxevent.reconstruction.engine.pixel import Directions
from jaxevent.reconstruction.engine.smoothing import (
    COUNTS,
    LATER,
    STATE,
    WORK,
    FrameProgram,
    SmoothingMethod,
    smoother_kernel,
)
from jaxevent.reconstruction.frames import Clock
from jaxevent.reconstruction.stream import StreamState


class Stretch(NamedTuple):
    """Frames that are smoothed together."""

    begin: int
    end: int


def _line(clock: Clock, stretch: Stretch) -> FrameLine:
    begin, end = stretch
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
    return FrameLine(here, after, seconds, exists)


def _places(program: FrameProgram, layout: BandLayout, exposed: bool) -> FramePlaces:
    def of(*names: str) -> NDArray[np.int64]:
        return np.array([WORK.index(name) for name in names], np.int64)

    total = [program.work.index(name) for name in ("total", *program.slopes("total"))]
    inside = WORK.index("inside") if program.uses("inside") else -1
    sided = program.functions["frame"].results != program.functions["clipped"].results
    return FramePlaces(
        layout.stride, len(program.work), len(program.row), of("grey", "intensity", "certainty"),
        np.array(total, np.int64), inside, WORK.index("side"), of(*COUNTS[:4]), exposed, sided,
    )  # fmt: skip


def _shares(layout: BandLayout, width: int, height: int) -> NDArray:
    """The part of each pixel's events that its neighbours get, [bands, stride]."""
    inside = np.pad(np.ones((height, width)), 2)
    around = sum(
        np.roll(inside, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx
    )
    given = np.asarray(around)[1:-1, 1:-1] / 8
    shares = np.zeros((len(layout.edges) - 1, layout.stride))
    for band, (top, bottom) in enumerate(zip(layout.edges[:-1], layout.edges[1:], strict=True)):
        rows = given[top : bottom + 2]
        shares[band, : rows.size] = rows.ravel()
    return shares


class FramePasses:
    """A smoother's kernel for a recording; raises `TranslationError`."""

    def __init__(
        self,
        divided: DividedRecording,
        method: SmoothingMethod,
        params: Any,
        clock_offset: Any,
        directions: Directions = Directions(),  # noqa: B008
    ):
        self.divided, self.dtype = divided, divided.dtype
        self.clock, self.layout = divided.windows.clock, divided.layout
        self._method, self._directions = method, directions
        fixed = divided.fixed(clock_offset)
        self._fixed = {name: fixed[name] for name in ("clock_offset", "response")}
        self._program: FrameProgram | None = None
        self.spare: queue.SimpleQueue[NDArray] = queue.SimpleQueue()  # memory for bands
        self.use(params)
        recording = divided.recording
        self.shares = _shares(self.layout, recording.width, recording.height)

    def use(self, params: Any) -> None:
        """Go on with other parameters."""
        exposed = self.clock.exposed
        layout = exposed, self.dtype, self.layout.stride
        kernel = smoother_kernel(self._method, params, self._fixed, layout, self._directions)
        if self._program is not kernel.program:
            self._program, self.spare = kernel.program, queue.SimpleQueue()
        self.kernel, self.places = kernel, _places(kernel.program, self.layout, exposed)

    @property
    def bands(self) -> int:
        return len(self.layout.edges) - 1

    def memory(self, bands: int, frames: int) -> NDArray:
        """Room for so many bands and frames of each, [bands, ...]."""
        places = self.places
        memory = np.zeros((bands, (places.work + frames * places.kept) * places.stride), self.dtype)
        for name in ("grey", "intensity", "certainty", *STATE, *LATER):
            self.field(memory, name)[:] = 0.5  # where there are no pixels, too
        return memory

    def field(self, memory: NDArray, name: str) -> NDArray:
        """A number of the frame that a pass has come to, [bands, stride]."""
        at, stride = self.kernel.program.work.index(name), self.places.stride
        return memory[:, at * stride : (at + 1) * stride]

    def divide(self, stretch: Stretch, state: StreamState) -> tuple[Bands, StreamState]:
        """The events that tell of a stretch of frames; the state moved to their beginning."""
        clock, source, (begin, end) = self.clock, self.divided.recording.events, stretch
        reach = self.divided.windows.reach
        # Before the first frame and after the last one all events count.
        rows = [0, len(source)]
        if begin:
            first = min(clock.left[begin:end].min(), clock.mid[begin])
            rows[0] = source.index(int(np.ceil(first)) + clock.origin - reach)
        if end < len(clock):
            last = max(clock.right[begin:end].max(), clock.mid[end])
            rows[1] = source.index(int(np.ceil(last)) + clock.origin + reach)
        return self.divided.divide(state, *rows)

    def given(self, stretch: Stretch, bands: Bands, slot: NDArray[np.int64]) -> GivenFrames:
        """What passes over a stretch rest on; each band has a `slot` of the memory."""
        frames, reach = self.divided.frames(slice(*stretch)), self.divided.windows.reach
        rates = follow_events(bands, self.layout.stride, reach) if reach else np.empty(0)
        return GivenFrames(
            bands, _line(self.clock, stretch), frames, self.places, self.kernel.functions,
            self.kernel.numbers, slot, rates, reach,
            Room.of(self.bands, self.layout.stride, self.dtype),
        )  # fmt: skip

    def room(self, times: int) -> Images:
        """Where images go, and derivatives of those that have any."""
        pixels, numbers = self.divided.windows.pixels, len(self._directions.numbers)
        of = (len(self._directions.of), self._directions.lanes) if numbers else (0, 0)
        mean, variance = (np.empty((times, pixels), self.dtype) for _ in range(2))
        valid, slopes = np.empty((times, pixels), np.uint8), np.zeros((times, pixels, *of))
        return Images(mean, variance, valid, slopes.astype(self.dtype, copy=False))

    def frame_before(self, times: NDArray) -> NDArray[np.int64]:
        """The frame before times (us since the recording's start), -1 before the first."""
        return np.searchsorted(self.clock.mid, times.astype(float), "right") - 1

    def instants(self, times: NDArray, begin: int) -> Instants:
        """Times that lie in a stretch which begins with that frame."""
        mid, frame = self.clock.mid, self.frame_before(times)
        behind, following = frame < 0, np.minimum(frame + 1, len(mid) - 1)
        elapsed = np.where(behind, 0, 1e-6 * (times - mid[np.maximum(frame, 0)]))
        left = np.where(frame + 1 < len(mid), 1e-6 * (mid[following] - times), 0)
        here = (~behind & (elapsed < 1e-6)).astype(float)
        return Instants(times, np.where(behind, -1, frame - begin), elapsed, left, here)
