"""A reconstruction as a function of time: read images at any times without changing them."""

import abc
import functools
import itertools
import math
import warnings
from collections.abc import Iterator
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np
from numpy.typing import NDArray

from jaxevent import threads
from jaxevent.deprecated import renamed_methods
from jaxevent.display import HtmlRepr, format_span
from jaxevent.errors import InputError, InputWarning, require
from jaxevent.estimator import Estimate
from jaxevent.events.blocks import read_blocks
from jaxevent.progress import bar
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.consistency import events_contradict_frames
from jaxevent.reconstruction.features import Features, ReadOut
from jaxevent.reconstruction.frames import EventTiming, time_span
from jaxevent.reconstruction.stream import StreamState
from jaxevent.reconstruction.windows import (
    MAX_WINDOW_EVENTS,
    EventWindow,
    ImageReader,
    WindowedRecording,
)
from jaxevent.recording import Events, Recording, Times, microseconds
from jaxevent.threads import TurnLock

P = TypeVar("P", bound=FrameParams)
S = TypeVar("S", bound="ImageSequence")

MAX_WINDOW_STARTS = 32  # windows from which filtering can be taken up again
NEVER_US = np.iinfo(np.int64).max  # us
N_BATCH_IMAGES = 8  # images read per call; 8 x 90,000 pixels stay in the second-level cache


@runtime_checkable
class FlowSource(Protocol):
    """A source of optical flow: a `RigidFlow` of egomotion, or a video with flow."""

    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.floating]:
        """Return the optical flow at some times.

        Args:
            times: (T,) times, us or seconds as of images.
            extrapolate: Whether times may lie outside the data.

        Returns:
            (T, H, W, 2) flow along x and y, px/s; not finite where it is not known.
        """
        ...


@runtime_checkable
class ImageMethod(Protocol):
    """Members of an estimator that a sequence of images needs; see `estimator.ImageEstimator`."""

    @property
    def name(self) -> str:
        """Name of the method."""

    @property
    def fuses(self) -> bool:
        """True if images rest on events and frames together."""

    @property
    def has_covariance(self) -> bool:
        """True if images have a variance."""

    def check(self, recording: Recording) -> None:
        """Raise `InputError` for a recording without what the method needs."""

    def check_clocks(self, recording: Recording, params: Any) -> None:
        """Check that frames and events can be on one clock.

        Args:
            recording: Events and frames.
            params: Parameters.
        """

    def check_span(self, recording: Recording, times: Times, params: Any) -> None:
        """Check that times lie within the recording.

        Args:
            recording: Events and frames.
            times: Times of images.
            params: Parameters.
        """


@runtime_checkable
class PixelMethod(ImageMethod, Protocol):
    """Members of an estimator that a video needs; see `estimator.PixelEstimator`."""

    @property
    def is_event_driven(self) -> bool:
        """True if the method passes over single events."""

    @property
    def needs_future(self) -> bool:
        """True if `run` needs the message of later windows."""

    def init_state(self, params: Any, features: Features) -> Any:
        """Return the state at the recording's start.

        Args:
            params: Parameters.
            features: The first window.

        Returns:
            The state.
        """

    def run(
        self, params: Any, features: Features, state: Any = None, future: Any = None
    ) -> tuple[Any, Any]:
        """Estimate a window.

        Args:
            params: Parameters.
            features: The window.
            state: State before it.
            future: Message of later windows.

        Returns:
            The trajectory, and the state for the next window.
        """

    def read(self, params: Any, trajectory: Any, out: ReadOut) -> Estimate:
        """Read images of a window.

        Args:
            params: Parameters.
            trajectory: Trajectory that `run` returned.
            out: Prepared times of images.

        Returns:
            The images.
        """


# jax.jit returns before the result is there; eqx.filter_jit waits for it.
@functools.partial(jax.jit, static_argnums=0)
def _start(estimator: PixelMethod, params, features: Features):
    return estimator.init_state(params, features)


@functools.partial(jax.jit, static_argnums=0)
def _run(estimator: PixelMethod, params, features: Features, state, future):
    return estimator.run(params, features, state, future)


@functools.partial(jax.jit, static_argnums=0)
def _read(estimator: PixelMethod, params, trajectory, out: ReadOut):
    return estimator.read(params, trajectory, out)


class WindowStart(NamedTuple):
    """Start of a window with the state there, from which filtering can be taken up again."""

    start: int | None
    before: StreamState
    state: Any

    @property
    def time(self) -> float:
        """Start of the window, us; minus infinity for the first."""
        return -math.inf if self.start is None else float(self.start)


class FilteredWindow(NamedTuple):
    """A window that images can be read from."""

    window: EventWindow
    reader: ImageReader
    trajectory: Any  # result of the method's `run`

    def contains(self, time: int) -> bool:
        """Return whether a time (us) lies in the window."""
        start, stop = self.window.start, self.window.stop
        return (start is None or start <= time) and (stop is None or time < stop)


def note_first_events(first: NDArray[np.int64], events: Events) -> None:
    """Note the times of pixels that fire for the first time.

    Args:
        first: (H, W) times of each pixel's first event, us, `NEVER_US` before; changed in place.
        events: Events after those noted before.
    """
    new = first[events.y, events.x] == NEVER_US
    np.minimum.at(first, (events.y[new], events.x[new]), events.t[new])


class ImageSequence(HtmlRepr, abc.ABC, Generic[P]):
    """Images of a reconstruction: `image, variance, valid = sequence(times)`.

    A subclass reads images in `_read`, at times of the events that show them: those of images and
    `event_delay`. Images do not depend on which others were read. Threads may share a sequence:
    they take turns, in calls as a whole, else image by image. A pickle or copy holds the arguments
    of the sequence, and is made anew of these. Raises `InputError` if the recording lacks what the
    estimator needs. The first reading warns if events contradict frames at the given thresholds,
    see `consistency`.

    Attributes:
        is_checked: Whether events were compared with frames, or need not be.
    """

    _made_of: tuple[tuple[Any, ...], dict[str, Any]]  # arguments by position and by name

    def __new__(cls: type[S], *given: Any, **options: Any) -> S:
        self = object.__new__(cls)
        self._made_of = given, options
        return self

    def __init__(
        self,
        estimator: ImageMethod,
        recording: Recording,
        params: P,
        *,
        progress: bool | None = None,
    ):
        estimator.check(recording)
        estimator.check_clocks(recording, params)
        self.estimator, self.recording, self.params = estimator, recording, params
        self.progress = progress
        self._image_delay_us = EventTiming.of(params).image_delay_us
        self.is_checked, self._is_live = not estimator.fuses, False
        self._turns = TurnLock(f"images of {recording.name}")

    def __reduce__(self) -> tuple[Any, ...]:
        given, options = self._made_of
        return functools.partial(type(self), **options), given

    @property
    @abc.abstractmethod
    def dtype(self) -> np.dtype:
        """Type of images and variances."""

    def _among_events(self, times: Times, extrapolate: bool) -> NDArray[np.int64]:
        """Return the times of images on the clock of events.

        Args:
            times: Integers (us) or floats (s) on the recording's clock.
            extrapolate: Allow times outside the recording.

        Returns:
            Times, us.

        Raises:
            InputError: A time is outside the recording.
        """
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            self.estimator.check_span(self.recording, wanted, self.params)
        return wanted + self._image_delay_us

    @abc.abstractmethod
    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        """Read a few images after another at sorted times (us): the times and their `Estimate`.

        Its arrays have a row of all pixels, of any shape, for each of the times, and may have spare
        rows after these.
        """

    def __repr__(self) -> str:
        r = self.recording
        span = format_span((r.start, r.stop))
        kind = type(self).__name__
        return f"{kind}({self.estimator.name} of {r.name}, {r.width}x{r.height}, {span})"

    def __call__(self, times: Times, extrapolate: bool = False) -> Estimate:
        """Return the images at times.

        Args:
            times: Integers (us) or floats (s) on the recording's clock, in any order.
            extrapolate: Allow times outside the recording; before its start images show the initial
                state.

        Returns:
            `mean`, `covariance` and `valid`, each (T, H, W). `mean` is intensity, 0 black and 1 the
            frames' white, and goes beyond. `covariance` is the variance of log intensity ln(I +
            I0), NaN of methods that estimate none. `valid` is false outside the recording and where
            the intensity is not a finite number; `events-only` adds where its deviation is above
            its parameter `vague`. Where a method of events and frames gets none of
            these, it is false before a pixel's first event, and an `InputWarning` says so.

        Raises:
            InputError: A time is not finite, or outside the recording.
        """
        times = np.atleast_1d(microseconds(times))
        order = np.argsort(times, kind="stable")
        shape = (len(times), self.recording.height, self.recording.width)
        image, variance = np.empty((2, *shape), self.dtype)
        whole = Estimate(image, variance, np.empty(shape, bool))
        done = 0
        with self._turns:  # for all, so that nobody moves the sequence to and fro
            for batch, part in self.batches(times[order], extrapolate):
                rows = order[done : done + len(batch)]
                for array, values in zip(whole, part, strict=True):
                    array[rows] = values
                done += len(batch)
        return whole

    @property
    def _lacks_frames(self) -> bool:
        """True if the method fuses frames with events, and there are none."""
        return self.estimator.fuses and self.recording.frames is None

    def _doubt(self) -> str | None:
        """Return why images are doubtful, for a warning."""
        if self._is_live or not self._lacks_frames:
            return events_contradict_frames(self.recording, self.params)
        return (
            f"{self.recording.name}: holds no frames, so images of {self.estimator.name} are "
            "changes from grey, valid from a pixel's first event on; take jaxevent.events_only"
        )

    @functools.cached_property
    def _first_events(self) -> NDArray[np.int64]:
        """Times (H, W) of each pixel's first event, us."""
        first = np.full((self.recording.height, self.recording.width), NEVER_US)
        for events in read_blocks(self.recording.events):
            note_first_events(first, events)
        return first

    def carry(
        self, images: NDArray[np.floating], at: NDArray[np.int64], to: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Move images to another time along the motion of points, if the sequence knows it.

        Here points stay in place.

        Args:
            images: (n, H, W, channels).
            at: (n,) times at which they were taken, us.
            to: Time to which they are moved, us.

        Returns:
            The images (n, H, W, channels), and the degree (n, H, W), 0 to 1, to which each shows
                the
            points visible at the time `to`.
        """
        return images, np.ones(images.shape[:3], images.dtype)

    def to_xarray(self, times: Times) -> Any:
        """Return the images at `times` as an `xarray.Dataset`, for labelled axes, netCDF and Dask.

        It has image, variance and valid over t (us), y and x (px). Raises `InputError` as calling
        does, and without the extra "xarray".
        """
        xarray = require("xarray", "xarray")
        axes, names = ("t", "y", "x"), ("image", "variance", "valid")
        fields = {name: (axes, part) for name, part in zip(names, self(times), strict=True)}
        places = {"t": np.atleast_1d(microseconds(times)), "y": np.arange(self.recording.height)}
        places["x"] = np.arange(self.recording.width)
        about = {"method": self.estimator.name, "recording": self.recording.name}
        dataset = xarray.Dataset(fields, places, about)
        for name, unit in (("t", "us"), ("x", "px"), ("y", "px")):
            dataset[name].attrs["units"] = unit
        dataset["image"].attrs["long_name"] = "intensity, 0 black, 1 the frames' white"
        dataset["variance"].attrs["long_name"] = "variance of ln(intensity + I0)"
        return dataset

    def batches(
        self, times: Times, extrapolate: bool = False
    ) -> Iterator[tuple[NDArray[np.int64], Estimate]]:
        """Yield the images a few after another.

        Args:
            times: Sorted times, integers (us) or floats (s).
            extrapolate: Allow times outside the recording.

        Yields:
            Times (us), and their images as a call returns them.

        Raises:
            InputError: Times are not sorted, or outside the recording.
        """
        times = np.atleast_1d(microseconds(times))
        if (times[1:] < times[:-1]).any():
            raise InputError("times must be sorted to be read in batches; sort them")
        among_events = self._among_events(times, extrapolate)
        with self._turns:
            checked, self.is_checked = self.is_checked, True
        if not checked and (doubt := self._doubt()) is not None:
            warnings.warn(doubt, InputWarning, stacklevel=2)
        start, stop = time_span(self.recording, self.params.clock_offset)
        with bar(total=len(times), desc="images", unit="image", progress=self.progress) as shown:
            for read, images in self._turns.iterate(self._read(among_events)):
                batch = read - self._image_delay_us
                shape = (len(batch), self.recording.height, self.recording.width)
                image, variance, valid = (
                    np.asarray(v)[: len(batch)].reshape(shape) for v in images
                )
                inside = (start <= batch) & (batch <= stop)
                if not inside.all():
                    valid = valid & inside[:, None, None]
                if self._lacks_frames:
                    valid = valid & (self._first_events <= read[:, None, None])
                yield batch, Estimate(image, variance, valid)
                shown.update(len(batch))


@renamed_methods(grow="extend")
class Video(ImageSequence[P]):
    """Images of a reconstruction: `image, variance, valid = video(times)`.

    The recording is filtered in time windows when images in them are read; windows before them are
    filtered first. One window is held, and the state at the start of some, so memory does not grow
    with the recording's length. Images do not depend on which other images were read, nor on the
    windows.

    Args:
        estimator: The method.
        recording: Events and frames.
        params: Its parameters.
        window_events: Greatest number of events of a window.
        progress: Show a progress bar; None: if it takes long.
        factors: (2, pixels) factors on the ON and OFF thresholds of single pixels, for methods that
            do not pass over single events.
        first_events: (H, W) times of each pixel's first event, us, of a live recording, which
            forgets events.
    """

    estimator: PixelMethod

    def __init__(
        self,
        estimator: PixelMethod,
        recording: Recording,
        params: P,
        *,
        window_events: int = MAX_WINDOW_EVENTS,
        progress: bool | None = None,
        factors: NDArray[np.floating] | None = None,
        first_events: NDArray[np.int64] | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        if first_events is not None:
            self._first_events, self._is_live = first_events, True
        self._factors = factors
        self._windows = WindowedRecording(
            recording,
            EventTiming.of(params),
            filtering=estimator.is_event_driven,
            events=window_events,
            reuse=True,
        )
        self._starts = [WindowStart(None, self._windows.initial(), None)]
        self._current: FilteredWindow | None = None
        # The last reading and its images.
        self._pending: tuple[object, Any] = (None, None)
        self._future: dict[int | None, Any] | None = None  # by the start of the window

    @property
    def dtype(self) -> np.dtype:
        return self._windows.dtype

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        # One batch is computed while the next one is looked up in the events.
        ahead = None
        for following in itertools.chain(self._dispatch(times), [None]):
            if ahead is not None:
                yield ahead
            ahead = following

    def _dispatch(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        """Yield batches of images that are being computed on the device."""
        threads.check_not_forked()
        done, mine = 0, object()
        while done < len(times):
            window, reader, trajectory = self._open_window_at(int(times[done]))
            stop = window.stop
            end = len(times) if stop is None else int(np.searchsorted(times, stop))
            for first in range(done, end, N_BATCH_IMAGES):
                batch = times[first : min(first + N_BATCH_IMAGES, end)]
                reading, images_before = self._pending
                if reading is not mine:  # two readings of this one fit into the reader
                    jax.block_until_ready(images_before)
                out = self._scale(reader(batch))
                images = _read(self.estimator, self.params, trajectory, out)
                self._pending = mine, images
                for leaf in images:
                    leaf.copy_to_host_async()
                yield batch, images
            done = end

    def _scale(self, part: Any) -> Any:
        """Scale the counts of features or a read-out."""
        return part if self._factors is None else part.scale_counts(self._factors)

    def _open_window_at(self, time: int) -> FilteredWindow:
        """Return the filtered window that contains `time`; those before it are filtered first."""
        if self.estimator.needs_future and self._future is None:
            self._run_backward_pass()
        if self._current is not None and self._current.contains(time):
            return self._current
        begin = [b for b in self._starts if b.time <= time][-1]
        while True:
            self._current = None  # so that two windows are never held at once
            self._current, begin = self._filter(begin)
            stop = self._current.window.stop
            if stop is None or time < stop:
                return self._current

    @property
    def settled(self) -> int | None:
        """Time (us) before which images can no longer be read; None: all can."""
        start = self._starts[0].start
        return None if start is None else start - self._image_delay_us

    def extend(self, recording: Recording) -> None:
        """Go on with the same recording after events or frames were added to its end."""
        self.recording = recording
        self._windows.extend(recording)
        self._current, self._starts = None, self._starts[:1]

    def settle(self, frames: bool) -> tuple[int, int]:
        """Filter up to the time before which additions change nothing, and keep that state only.

        Args:
            frames: Whether more frames will come, else events alone.

        Returns:
            The first row of the events and the first frame that are needed from then on.
        """
        begin, final = self._starts[0], self._windows.settled_until(frames)
        while True:
            self._current = None
            _, following = self._filter(begin)
            if following.start is None or following.start > final:
                break
            begin = following
        self._starts = [begin]
        return self._windows.first_needed_rows(begin.start, begin.before)

    def _run_backward_pass(self) -> None:
        """Pass over all windows once, for the message of later windows at each."""
        begin, starts, links = self._starts[0], [], []
        total = len(self.recording.events)
        with bar(
            total=total, desc="look ahead", unit="event", unit_scale=True, progress=self.progress
        ) as shown:
            while True:
                starts.append(begin.start)
                filtered, begin = self._filter(begin)
                links.append((filtered.trajectory.link, filtered.trajectory.last))
                shown.update(filtered.window.inputs.n_events)
                if filtered.window.stop is None:
                    break
        message, future = links[-1][1], {starts[-1]: None}
        for place in range(len(starts) - 1, 0, -1):
            message = links[place][0].apply(message)
            future[starts[place - 1]] = message
        self._future = future
        self._current = filtered  # no window is later than the last

    def _filter(self, begin: WindowStart) -> tuple[FilteredWindow, WindowStart]:
        """Prepare and filter the window that begins there; return it and the start of the next."""
        threads.check_not_forked()
        window, features = self._windows.prepare(begin.start, begin.before)
        features = self._scale(features)
        state = begin.state
        if state is None:
            state = _start(self.estimator, self.params, features)
        future = None if self._future is None else self._future[begin.start]
        trajectory, end = _run(self.estimator, self.params, features, state, future)
        jax.block_until_ready(trajectory)  # before the next window's tiles overwrite these
        following = WindowStart(window.stop, window.after, end)
        if window.stop is not None and all(b.start != window.stop for b in self._starts):
            self._starts = sorted([*self._starts, following], key=lambda b: b.time)
            if len(self._starts) > MAX_WINDOW_STARTS:  # first, last, half of the others
                self._starts = [self._starts[0], *self._starts[1:-1][::2], self._starts[-1]]
        return FilteredWindow(window, window.reader(N_BATCH_IMAGES), trajectory), following
