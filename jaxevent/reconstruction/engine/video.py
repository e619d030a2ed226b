"""Video by kernels: events, recursion and images in one pass over bands of pixels."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen.module import make_kernel
from jaxevent.estimator import Estimate
from jaxevent.reconstruction.engine.passes import DividedRecording, Held, Passes, Window
from jaxevent.reconstruction.engine.room import ImageRoom
from jaxevent.reconstruction.engine.timeline import NEVER
from jaxevent.reconstruction.frames import Timing
from jaxevent.reconstruction.stream import StreamState
from jaxevent.reconstruction.video import MAX_STARTS, ImageSequence, P
from jaxevent.recording import Recording

WINDOW_EVENTS = 1 << 21  # 8 bytes each, and 13 where they are read from a file


class Begin(NamedTuple):
    """What filtering from a window's start needs."""

    start: int | None
    context: StreamState  # of weighted events
    held: Held | None  # None: the recording's beginning

    @property
    def time(self) -> float:
        return -math.inf if self.start is None else float(self.start)


class FusedVideo(ImageSequence[P]):
    """Images of a reconstruction, made by a kernel (`fused`); as `Video` in all else.

    Raises `TranslationError` where there is no kernel for the method.
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
        self._divided = DividedRecording(
            recording, Timing.of(params), estimator.is_event_driven, window_events
        )
        # Divided for the parameters' own clock: the lag is exactly 0.
        kernel = self._divided.kernel(estimator, params, params.clock_offset)
        self._passes = Passes(kernel, self._divided.layout, self.dtype)
        self._room = ImageRoom(self._divided.windows.pixels, self.dtype)
        self._begins = [Begin(None, self._divided.windows.initial(), None)]
        self._open: Window | None = None
        self._done = -NEVER  # the time up to which the open window is passed over

    @property
    def dtype(self) -> np.dtype:
        return self._divided.dtype

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        room, done, origin = self._room, 0, self._divided.origin
        while done < len(times):
            window = self._window_of(int(times[done]))
            end = len(times)
            if window.stop is not None:
                end = int(np.searchsorted(times, window.stop))
            batch = times[done : min(end, done + room.times)]
            images = room.take(len(batch))
            last = int(batch[-1]) - origin
            self._open = None  # until it is passed over up to a time that is known
            self._passes.run(window, last + 1, batch - origin, images)
            self._open, self._done = window, last
            done += len(batch)
            made = Estimate(images.mean, images.variance, images.valid.view(bool))
            del images
            yield batch, made

    def _window_of(self, time: int) -> Window:
        """The open window that contains `time`, not passed over beyond it."""
        at, window = time - self._divided.origin, self._open
        if window is not None and window.contains(time) and self._done <= at:
            return window
        begin = [b for b in self._begins if b.time <= time][-1]
        behind = window is None or time < window.begins or window.begins < begin.time
        if window is None or behind or window.contains(time):
            window = self._enter(begin)
        while not window.contains(time):
            window = self._enter(self._finish(window))
        return window

    def _finish(self, window: Window) -> Begin:
        """Pass over the rest of a window; where the next one begins."""
        assert window.stop is not None
        self._open = None
        self._passes.run(window, window.stop - self._divided.origin)
        begin = Begin(window.stop, window.context, self._passes.state())
        if all(b.start != window.stop for b in self._begins):
            self._begins = sorted([*self._begins, begin], key=lambda b: b.time)
            if (
                len(self._begins) > MAX_STARTS
            ):  # the first one, the last one, and half of the others
                self._begins = [self._begins[0], *self._begins[1:-1][::2], self._begins[-1]]
        return begin

    def _enter(self, begin: Begin) -> Window:
        """Divide a window's events among the bands, and put the bands at its start."""
        self._open = None  # so that two windows are never held at once
        window = self._divided.cut(begin.start, begin.context)
        if begin.held is None or begin.start is None:
            self._passes.begin(window)
        else:
            self._passes.resume(window, begin.held, begin.start - self._divided.origin)
        self._open, self._done = window, -NEVER
        return window


def serves_images(devices: Sequence[Any]) -> bool:
    """Return whether kernels are the faster way to images: in single precision, on one device."""
    return jnp.result_type(float) == np.float32 and len(devices) < 2


def video_by_kernel(
    kind: Callable[..., ImageSequence[P]],
    method: Any,
    recording: Recording,
    params: P,
    compiler: str | None,
    options: dict[str, Any],
) -> ImageSequence[P] | None:
    """Make the images of a method by a kernel.

    Args:
        kind: Class of the images.
        method: The method.
        recording: Events and frames.
        params: Parameters of the method.
        compiler: "numba" or "xla" if the user names one.
        options: Further options of the method's `estimate`.

    Returns:
        The images, or None where XLA compiles the method.

    Raises:
        InputError: The user names numba, and there is no kernel.
    """
    own = {name: value for name, value in options.items() if name != "devices"}
    serves = serves_images(options.get("devices", ()))
    return make_kernel(
        method.name, compiler, serves, lambda: kind(method, recording, params, **own)
    )
