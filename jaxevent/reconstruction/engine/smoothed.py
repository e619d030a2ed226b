"""Images of a smoother by kernels: stretches of frames, forwards and backwards over bands.

Of every frame of a stretch what it says and what is known before it are kept, of all other
stretches only their links: how what later frames say passes through them.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import run_over_rows
from jaxevent.estimator import Estimate
from jaxevent.progress import bar
from jaxevent.reconstruction.engine.frame_loop import (
    GivenFrames,
    filter_frames,
    read_images,
    smooth_frames,
)
from jaxevent.reconstruction.engine.frame_passes import FramePasses, Stretch
from jaxevent.reconstruction.engine.passes import DividedRecording
from jaxevent.reconstruction.engine.room import ImageRoom
from jaxevent.reconstruction.engine.smoothing import LATER, LINK, STATE, SmoothingMethod
from jaxevent.reconstruction.frames import Clock, Timing
from jaxevent.reconstruction.video import ImageSequence, P
from jaxevent.recording import Recording

STRETCH_EVENTS = 1 << 22  # 8 bytes each
KEPT_PIXELS = 3_000_000  # of a stretch's frames, 24 bytes each


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


class SmoothedVideo(ImageSequence[P]):
    """Images of a smoother, made by a kernel; as `Video` in all else.

    Raises `TranslationError` where there is no kernel for the method.

    Args:
        window_events: Most events of a stretch of frames, if it has more than one frame.
        factors: (2, pixels), of ON and OFF thresholds of single pixels.
    """

    def __init__(
        self,
        estimator: SmoothingMethod,
        recording: Recording,
        params: P,
        *,
        window_events: int = STRETCH_EVENTS,
        progress: bool | None = None,
        factors: NDArray[np.floating] | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._method = estimator
        divided = DividedRecording(recording, Timing.of(params), False, window_events, factors)
        self._passes = FramePasses(divided, estimator, params, params.clock_offset)
        self._stretches = stretches_of(self._passes.clock, recording, window_events)
        most = max(stretch.end - stretch.begin for stretch in self._stretches)
        self._memory = self._passes.memory(self._passes.bands, most)
        self._room = ImageRoom(divided.windows.pixels, self.dtype)
        self._field("given")[:] = self._passes.shares
        self._context = divided.windows.initial()
        self._states: list[NDArray] = []  # before each stretch
        self._later: list[NDArray] = []  # what all frames after each stretch say
        self._open: tuple[int, GivenFrames] | None = None

    @property
    def dtype(self) -> np.dtype:
        return self._passes.dtype

    def _field(self, name: str) -> NDArray:
        return self._passes.field(self._memory, name)

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        passes, done = self._passes, 0
        room, origin = self._room, passes.divided.origin
        frame = passes.frame_before(times - origin)
        begins = [stretch.begin for stretch in self._stretches]
        while done < len(times):
            place = max(int(np.searchsorted(begins, frame[done], "right")) - 1, 0)
            last = place == len(begins) - 1
            end = len(times) if last else int(np.searchsorted(frame, self._stretches[place].end))
            batch = times[done : min(end, done + room.times)]
            given, images = self._opened(place), room.take(len(batch))
            instants = passes.instants(batch - origin, begins[place])
            self._over_bands(read_images, given, self._memory, instants, images)
            made = Estimate(images.mean, images.variance, images.valid.view(bool))
            del images
            yield batch, made
            done += len(batch)

    def _over_bands(self, loop: Any, *args: Any) -> None:
        run_over_rows(loop, self._passes.bands, *args)

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
        stretch, passes = self._stretches[place], self._passes
        bands, self._context = passes.divide(stretch, self._context)
        given = passes.given(stretch, bands, np.arange(passes.bands))
        self._over_bands(filter_frames, given, self._memory, place == 0, linked)
        return given

    def _look_ahead(self) -> None:
        """Pass over all stretches once, to know at each what later ones say."""
        states, links, last = list[NDArray](), list[NDArray](), len(self._stretches) - 1
        given = None

        def fields(names: tuple[str, ...]) -> NDArray:
            return np.stack([self._field(name) for name in names])

        with bar(
            total=last + 1, desc="look ahead", unit="stretch", progress=self.progress
        ) as shown:
            for place in range(last + 1):
                states.append(fields(STATE))
                for k, name in enumerate(LINK):
                    self._field(name)[:] = k == 0
                given = self._filter(place, last > 0)
                links.append(fields(LINK))
                shown.update()
        assert given is not None
        later = [np.zeros_like(states[0])]
        while len(links) > 1:
            later.insert(0, self._method.apply_message_map(links.pop(), later[0]))
        self._states, self._later = states, later
        self._smooth(last, given)
