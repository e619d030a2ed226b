"""Images of a smoother by kernels: stretches of frames, forwards and backwards over bands.

Of every frame of a stretch what it says and what is known before it are kept, of all other
stretches only their links: how what later frames say passes through them.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.estimator import Estimate
from jaxevent.kernels import over_rows
from jaxevent.progress import bar
from jaxevent.reconstruction.clock import Clock, Timing
from jaxevent.reconstruction.fused.bands import BandLayout
from jaxevent.reconstruction.fused.frame_loop import (
    FrameLine,
    FramePlaces,
    GivenFrames,
    Instants,
    filter_frames,
    read_images,
    smooth_frames,
)
from jaxevent.reconstruction.fused.loop import Images
from jaxevent.reconstruction.fused.passes import DividedRecording
from jaxevent.reconstruction.fused.smoothing import (
    COUNTS,
    LATER,
    LINK,
    STATE,
    WORK,
    FrameProgram,
    SmoothingMethod,
    smoother_kernel,
)
from jaxevent.reconstruction.video import ImageSequence, P
from jaxevent.recording import Recording

IMAGE_PIXELS = 1 << 22  # made in one pass, 9 bytes each
STRETCH_EVENTS = 1 << 22  # 8 bytes each
KEPT_PIXELS = 3_000_000  # of a stretch's frames, 24 bytes each


class Stretch(NamedTuple):
    """Frames that are smoothed together."""

    begin: int
    end: int


def stretches_of(clock: Clock, recording: Recording, events: int) -> list[Stretch]:
    """Frames in stretches of so many events, one frame at least."""
    most = max(6, KEPT_PIXELS // (recording.width * recording.height))
    rows = [recording.events.index(int(np.ceil(t)) + clock.origin) for t in clock.mid]
    rows.append(len(recording.events))
    found, begin = list[Stretch](), 0
    while begin < len(clock):
        end = int(np.searchsorted(rows, rows[begin] + events, "right")) - 1
        end = min(max(end, begin + 1), begin + most, len(clock))
        found.append(Stretch(begin, end))
        begin = end
    return found


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

    inside = WORK.index("inside") if program.uses("inside") else -1
    sided = program.functions["frame"].results != program.functions["clipped"].results
    return FramePlaces(
        layout.stride, len(WORK), len(program.row), of("grey", "intensity", "certainty"),
        of("total"), inside, WORK.index("side"), of(*COUNTS[:4]), exposed, sided,
    )  # fmt: skip


class SmoothedVideo(ImageSequence[P]):
    """Images of a smoother, made by a kernel; as `Video` in all else.

    Raises `Untranslatable` where there is no kernel for the method.

    Args:
        window_events: Most events of a stretch of frames, if it has more than one frame.
    """

    def __init__(
        self,
        estimator: SmoothingMethod,
        recording: Recording,
        params: P,
        *,
        window_events: int = STRETCH_EVENTS,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._method = estimator
        self._divided = DividedRecording(recording, Timing.of(params), False, window_events)
        self._clock, layout = self._divided.windows.clock, self._divided.layout
        fixed = self._divided.fixed(params.clock_offset)
        fixed = {name: fixed[name] for name in ("clock_offset", "response")}
        self._kernel = smoother_kernel(
            estimator, params, fixed, self._clock.exposed, self.dtype, layout.stride
        )
        program = self._kernel.program
        self._places = _places(program, layout, self._clock.exposed)
        self._stretches = stretches_of(self._clock, recording, window_events)
        most = max(stretch.end - stretch.begin for stretch in self._stretches)
        fields = self._places.work + most * self._places.kept
        self._memory = np.zeros((len(layout.edges) - 1, fields * layout.stride), self.dtype)
        self._context = self._divided.windows.initial()
        self._fill_border(layout)
        self._states: list[NDArray] = []  # before each stretch
        self._later: list[NDArray] = []  # what all frames after each stretch say
        self._open: tuple[int, GivenFrames] | None = None

    @property
    def dtype(self) -> np.dtype:
        return self._divided.dtype

    def _field(self, name: str) -> NDArray:
        """A number of the frame that a pass has come to, [bands, stride]."""
        at, stride = WORK.index(name), self._places.stride
        return self._memory[:, at * stride : (at + 1) * stride]

    def _fill_border(self, layout: BandLayout) -> None:
        """What part of a pixel's events its neighbours get; values where there are no pixels."""
        width, height = self.recording.width, self.recording.height
        for name in ("grey", "intensity", "certainty", *STATE, *LATER):
            self._field(name)[:] = 0.5
        inside = np.pad(np.ones((height, width)), 2)
        around = sum(
            np.roll(inside, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx
        )
        given = np.asarray(around)[1:-1, 1:-1] / 8
        for band, (top, bottom) in enumerate(zip(layout.edges[:-1], layout.edges[1:], strict=True)):
            rows = given[top : bottom + 2]
            self._field("given")[band, : rows.size] = rows.ravel()

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        pixels, origin = self._divided.windows.pixels, self._divided.origin
        room, done, clock = max(1, IMAGE_PIXELS // pixels), 0, self._clock
        frame = np.searchsorted(clock.mid, (times - origin).astype(float), "right") - 1
        while done < len(times):
            begins = [stretch.begin for stretch in self._stretches]
            place = max(int(np.searchsorted(begins, frame[done], "right")) - 1, 0)
            begin, stop = self._stretches[place]
            last = place == len(self._stretches) - 1
            end = len(times) if last else int(np.searchsorted(frame, stop))
            rows = slice(done, min(end, done + room))
            given = self._opened(place)
            images = self._room(rows.stop - done, pixels)
            instants = self._instants(times[rows] - origin, frame[rows], begin)
            self._over_bands(read_images, given, self._memory, instants, images)
            yield times[rows], Estimate(images.mean, images.variance, images.valid.view(bool))
            done = rows.stop

    def _room(self, times: int, pixels: int) -> Images:
        mean, variance = (np.empty((times, pixels), self.dtype) for _ in range(2))
        none = np.empty((times, pixels, 0, 0), self.dtype)
        return Images(mean, variance, np.empty((times, pixels), np.uint8), none)

    def _instants(self, times: NDArray, frame: NDArray, begin: int) -> Instants:
        mid = self._clock.mid
        behind, following = frame < 0, np.minimum(frame + 1, len(mid) - 1)
        elapsed = np.where(behind, 0, 1e-6 * (times - mid[np.maximum(frame, 0)]))
        left = np.where(frame + 1 < len(mid), 1e-6 * (mid[following] - times), 0)
        here = (~behind & (elapsed < 1e-6)).astype(float)
        return Instants(times, np.where(behind, -1, frame - begin), elapsed, left, here)

    def _over_bands(self, loop: Any, *args: Any) -> None:
        over_rows(loop, len(self._divided.layout.edges) - 1, *args)

    def _opened(self, place: int) -> GivenFrames:
        """What is given of a stretch, which is smoothed."""
        if not self._later:
            self._look_ahead()
        if self._open is not None and self._open[0] == place:
            return self._open[1]
        self._open = None  # so that two are never held at once
        for name, values in zip(STATE, self._states[place], strict=True):
            self._field(name)[:] = values
        given = self._filter(place, False)
        self._smooth(place, given)
        return given

    def _smooth(self, place: int, given: GivenFrames) -> None:
        for name, values in zip(LATER, self._later[place], strict=True):
            self._field(name)[:] = values
        self._over_bands(smooth_frames, given, self._memory)
        self._open = place, given

    def _filter(self, place: int, linked: bool) -> GivenFrames:
        """Divide a stretch's events among the bands, and filter its frames."""
        given = self._given(self._stretches[place])
        self._over_bands(filter_frames, given, self._memory, place == 0, linked)
        return given

    def _given(self, stretch: Stretch) -> GivenFrames:
        clock, source, (begin, end) = self._clock, self.recording.events, stretch
        # Before the first frame and after the last one all events count.
        rows = [0, len(source)]
        if begin:
            first = min(clock.left[begin:end].min(), clock.mid[begin])
            rows[0] = source.index(int(np.ceil(first)) + clock.origin)
        if end < len(clock):
            last = max(clock.right[begin:end].max(), clock.mid[end])
            rows[1] = source.index(int(np.ceil(last)) + clock.origin)
        bands, self._context = self._divided.divide(self._context, *rows)
        frames = self._divided.frames(slice(begin, end))
        return GivenFrames(
            bands, _line(clock, stretch), frames, self._places, self._kernel.functions,
            self._kernel.numbers,
        )  # fmt: skip

    def _look_ahead(self) -> None:
        """Pass over all stretches once, to know at each what later ones say."""
        links, last = list[NDArray](), len(self._stretches) - 1
        given = None

        def fields(names: tuple[str, ...]) -> NDArray:
            return np.stack([self._field(name) for name in names])

        with bar(
            total=last + 1, desc="look ahead", unit="stretch", progress=self.progress
        ) as shown:
            for place in range(last + 1):
                self._states.append(fields(STATE))
                for k, name in enumerate(LINK):
                    self._field(name)[:] = k == 0
                given = self._filter(place, last > 0)
                links.append(fields(LINK))
                shown.update()
        assert given is not None
        self._later = [np.zeros_like(self._states[0])]
        while len(links) > 1:
            self._later.insert(0, self._method.through(links.pop(), self._later[0]))
        self._smooth(last, given)
