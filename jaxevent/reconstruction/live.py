"""A reconstruction of events that are still coming: from a camera, a socket, any iterator.

    live = jaxevent.akf.live((346, 260), frames=False)
    for events in camera:  # `jaxevent.Events`, one chunk after another
        live.add(events)
        image, variance, valid = live(live.stop)

Images are those that `estimate` gives of all that has been added so far. What can no longer change
is filtered once and forgotten, so memory does not grow; only the frames' times are kept.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.events.live import Tail
from jaxevent.reconstruction.video import NEVER_US, PixelMethod, Video, note_first_events
from jaxevent.recording import Events, Frames, Recording, Times, microseconds, one_time
from jaxevent.threads import TurnLock, refuse_to_pickle, synchronized

MAX_WINDOW_EVENTS = 1 << 17  # filtered together, and at most so many anew for an image
MAX_HELD_FRAMES = 32  # before what is settled is dropped


@renamed_methods(dropping="drop_before", grown="append")
class RecentImages:
    """An `ImageSource` that holds the last images only.

    Args:
        images: (n, H, W) frames that are left.
        dropped: Number of earlier frames that are gone.
    """

    def __init__(self, images: NDArray, dropped: int = 0):
        self.images, self.dropped = images, dropped
        self.dtype = images.dtype
        self.shape = (dropped + len(images), *images.shape[1:])

    def __getitem__(self, rows: Any) -> Any:
        first, stop, step = rows.indices(self.shape[0])
        if first < self.dropped:
            raise IndexError(f"frames before {self.dropped} are gone")
        return self.images[first - self.dropped : stop - self.dropped : step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        raise IndexError("frames that are gone cannot be read")

    def append(self, image: NDArray) -> "RecentImages":
        """Return the images with one more at the end."""
        return RecentImages(np.concatenate([self.images, image[None]]), self.dropped)

    def drop_before(self, row: int) -> "RecentImages":
        """Return the images without those before a row."""
        return RecentImages(self.images[max(row - self.dropped, 0) :].copy(), row)


class LiveVideo:
    """Images of all that has been added so far: `image, variance, valid = live(times)`.

    With frames a moment is settled when the second frame after it, and the events of its exposure,
    have come. Until then images between frames may change, as those of a recording that ends there
    do. One thread may add while another reads.

    Args:
        estimator: The method.
        size: Width and height of the sensor, px.
        params: Its parameters.
        frames: Whether frames will come.
        window_events: Events that are filtered together.
        extra: Further arrays of a recording, for a camera response.
    """

    def __init__(
        self,
        estimator: PixelMethod,
        size: tuple[int, int],
        params: Any,
        *,
        frames: bool,
        window_events: int = MAX_WINDOW_EVENTS,
        extra: dict[str, NDArray] | None = None,
    ):
        self.estimator, self.params, self.window_events = estimator, params, window_events
        self._expects_frames = frames
        self._turns = TurnLock("live images")
        self._recording = Recording("live", *size, Tail(*size), extra=extra or {})
        self._first_events = np.full(size[::-1], NEVER_US)
        self._video: Video | None = None
        self._changed = False

    @property
    def _events(self) -> Tail:
        assert isinstance(self._recording.events, Tail)
        return self._recording.events

    def __repr__(self) -> str:
        r = self._recording
        return f"LiveVideo({self.estimator.name}, {r.width}x{r.height}, {len(r.events):,} events)"

    def __reduce__(self) -> tuple[Any, ...]:
        refuse_to_pickle("live images", "keep what they show, live(times)")

    @property
    @synchronized
    def start(self) -> int:
        """First time (us) of which images can still be read."""
        self._check()
        settled = None if self._video is None else self._video.settled
        return self._recording.start if settled is None else settled

    @property
    @synchronized
    def stop(self) -> int:
        """Time (us) of the last event or frame."""
        self._check()
        return self._recording.stop

    @synchronized
    def add(self, events: Events) -> None:
        """Add events that are not earlier than those before; raises `InputError` for bad ones."""
        self._events.add(events)
        note_first_events(self._first_events, events)
        self._changed = True
        self._settle()

    @synchronized
    def add_frame(self, time: Times, image: NDArray, exposure: int | float = 0) -> None:
        """Add a frame.

        Args:
            time: Mid-exposure, integer us or float s, after the frame before.
            image: (H, W), whole numbers or floats in [0, 1].
            exposure: Length of the exposure, integer us or float s; 0 if unknown.

        Raises:
            InputError: No frames were expected, or the frame is not valid or not later.
        """
        if not self._expects_frames:
            raise InputError("frames were not expected; make the live video with frames=True")
        r, t = self._recording, one_time(time)
        one = Frames(
            np.array([t]), np.asarray(image)[None], np.array([one_time(exposure, "the exposure")])
        )
        one.check(r.width, r.height, "the frame added")
        known = r.frames
        if known is None:
            frames = dataclasses.replace(one, images=RecentImages(np.asarray(one.images)))
        else:
            if t <= known.t[-1]:
                raise InputError(
                    f"the frame added is at {t} us, not after the one before at {known.t[-1]} us; "
                    "add them in order of time"
                )
            assert isinstance(known.images, RecentImages)
            frames = Frames(
                np.append(known.t, t),
                known.images.append(np.asarray(image)),
                np.append(known.exposure, one.exposure),
            )
        self._recording = dataclasses.replace(r, frames=frames)
        self._changed = True
        self._settle()

    @synchronized
    def __call__(self, times: Times) -> Estimate:
        """Return the images at `times`, from `start` to `stop`, as `Video` does."""
        us = np.atleast_1d(microseconds(times))
        start, stop = self.start, self.stop
        if len(us) and not start <= us.min() <= us.max() <= stop:
            raise InputError(
                f"images from {us.min()} to {us.max()} us are not available, but from {start} to "
                f"{stop} us; earlier ones are forgotten and later ones not known"
            )
        return self._updated_video()(us)

    def _check(self) -> None:
        if not len(self._events) and self._recording.frames is None:
            raise InputError("nothing has been added yet; add events or a frame first")

    def _updated_video(self) -> Video:
        """Return the video of all that has been added."""
        if self._video is None:
            self._video = Video(
                self.estimator, self._recording, self.params,
                window_events=self.window_events, progress=False, first_events=self._first_events,
            )  # fmt: skip
        elif self._changed:
            self._video.extend(self._recording)
        self._changed = False
        return self._video

    def _settle(self) -> None:
        """Filter events that no addition changes, once they are a window's worth, and drop them."""
        tail, frames = self._events, self._recording.frames
        waiting = tail.count - tail.dropped
        held_frames = 0
        if frames is not None and isinstance(frames.images, RecentImages):
            held_frames = len(frames.images.images)
        if waiting < 2 * self.window_events and held_frames < MAX_HELD_FRAMES:
            return
        if self._expects_frames and (frames is None or len(frames) < 3):
            return
        video = self._updated_video()
        row, first_frame = video.settle(self._expects_frames)
        if row > tail.dropped:
            tail.drop(row)
        if frames is not None and isinstance(frames.images, RecentImages):
            if first_frame > frames.images.dropped:
                images = frames.images.drop_before(first_frame)
                self._recording = dataclasses.replace(
                    self._recording, frames=dataclasses.replace(frames, images=images)
                )
                self._changed = True
