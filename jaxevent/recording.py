"""Recordings of a hybrid event camera: events, frames, calibration, ground truth, IMU, triggers.

Conventions. Time is int64 microseconds on the recording's own clock. `x` is the column
(to the right), `y` the row (downwards), both from 0; image arrays are [y, x]. Polarity is True for
ON (brighter), False for OFF. Where a function takes a time, an integer means microseconds and a
float means seconds, both on the recording's clock.
"""

import dataclasses
import os
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent import arrays
from jaxevent.camera import PinholeCamera, Response, TableResponse, UnknownResponse
from jaxevent.display import HtmlRepr, describe_type, format_count, format_seconds, format_span
from jaxevent.errors import InputError, InputWarning, OrderError
from jaxevent.time_units import doubt_given_unit

if TYPE_CHECKING:
    import pandas

Times = ArrayLike | int | float

MAX_FRAME_GAP_US = 1_000_000  # between frames and all events, if no longer than these
PER_FRAME_EXTRAS = ("gain", "rgb")  # names of `Recording.extra` that hold one entry per frame


def microseconds(time: Times, what: str = "times") -> NDArray[np.int64]:
    """Convert times to microseconds: integers are microseconds already, floats are seconds.

    Args:
        time: One time, or a list of them.
        what: Name of the times for messages.

    Returns:
        Times as int64 us, of the same shape.

    Raises:
        InputError: The times are of another type or shape, not finite, or too large for int64.
    """
    try:
        time = np.asarray(time)
    except ValueError:  # lists of different lengths
        time = np.empty(0, object)
    if time.dtype.kind not in "iuf":
        raise InputError(
            f"{what} are {time.dtype}; give integers (microseconds) or floats (seconds)"
        )
    if time.ndim > 1:
        raise InputError(f"{what} have the shape {time.shape}; give a list of times")
    if not np.all(np.isfinite(time)):
        raise InputError(f"{what} contain a value that is not finite; remove it")
    scaled = np.rint(time.astype(np.float64) * 1e6) if time.dtype.kind == "f" else time
    if time.size and not -(2**63) <= scaled.min() <= scaled.max() < 2**63:
        raise InputError(f"{what} contain one that is too large for microseconds; correct the unit")
    return np.asarray(scaled).astype(np.int64)


def one_time(time: Any, what: str = "the time") -> int:
    """Convert one time, or one length of time, to microseconds, as `microseconds` does.

    Args:
        time: The time.
        what: Its name for messages.

    Returns:
        The time, us.

    Raises:
        InputError: It is no number, several, not finite, or too large for int64.
    """
    try:
        return int(microseconds(time, what))
    except (ValueError, TypeError):
        raise InputError(
            f"{what} is {arrays.shorten_value(time)}; give one finite number, an integer of "
            "microseconds or a float of seconds"
        ) from None


def check_recording(recording: Any, call: str, or_events: bool = False) -> None:
    """Raise `InputError` unless an argument is a `Recording`, naming the remedy.

    Args:
        recording: The argument.
        call: Name of the called function in the message.
        or_events: Whether the function takes bare events, too.
    """
    if isinstance(recording, Recording) or (or_events and _is_source(recording)):
        return
    takes = f"{call} takes {'events or ' * or_events}a recording"
    if isinstance(recording, str | os.PathLike):
        raise InputError(f"{takes}, not a path; give jaxevent.load({str(recording)!r})")
    held = "bare events" if _is_source(recording) else describe_type(recording)
    raise InputError(
        f"{takes}, not {held}; give jaxevent.load(path), or of arrays "
        "jaxevent.Recording.from_arrays(t, x, y, p, width=..., height=...)"
    )


def check_times(times: Times, start_us: int, stop_us: int, name: str) -> None:
    """Check that times lie in the span of the data.

    Args:
        times: Times, integers in us or floats in s.
        start_us: First time of the data in us.
        stop_us: Last time of the data in us.
        name: Name of the recording for messages.

    Raises:
        InputError: A time is outside start <= t <= stop. The message gives both conventions, since
            a number of the wrong one is the usual reason.
    """
    us = np.atleast_1d(microseconds(times))
    if len(us) and (us.min() < start_us or us.max() > stop_us):
        raise InputError(
            f"{name}: times from {us.min()} to {us.max()} us were requested, but it lasts from "
            f"{start_us} to {stop_us} us; give times of the recording's clock inside it (integers "
            "are microseconds, floats seconds), or, in Python, extrapolate=True"
        )


def _describe_span(what: str, number: int, t: Any) -> str:
    """Describe a number of things and their times, as in "2 events from 0.1 to 0.2 s".

    Args:
        what: Name of one of the things.
        number: Their number.
        t: (n,) sorted times, us.

    Returns:
        The description.
    """
    text = format_count(number, what)
    if number < 2:
        return f"{text} at {format_seconds(t[0])} s" if number else text
    return f"{text} from {format_span(t)}"


def _doubt_times(events: NDArray[np.int64], frames: "Frames") -> str | None:
    """Describe the sign that frames have another unit of time than events; None without one.

    Args:
        events: (n,) times of events, us.
        frames: The frames.

    Returns:
        A clause for a message; None: nothing.
    """
    t = frames.t
    if len(events) and len(t):
        gap = max(t[0] - events[-1], events[0] - t[-1])
        if gap > max(events[-1] - events[0], MAX_FRAME_GAP_US):
            ends = [format_span(at) for at in (t, events)]
            return f"frames are from {ends[0]}, events from {ends[1]}"
    if len(t) > 1 and np.median(frames.exposure) > (spacing := np.median(np.diff(t))):
        longest = np.median(frames.exposure) / 1e6
        return f"exposures of {longest:g} s are longer than the {spacing / 1e6:g} s between frames"
    return None


@runtime_checkable
class EventSource(Protocol):
    """Events that can be read piece by piece; `Events` in memory, or stored in a file."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: slice) -> "Events":
        """Return the events of a range of rows, in memory."""
        ...

    def index(self, time: int) -> int:
        """Count the events earlier than `time` (us)."""
        ...


class EventColumns(NamedTuple):
    """Columns of events as they are stored, whose order and coordinates are not checked.

    Attributes:
        t: (n,) times after `offset`, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) 1 ON, 0 OFF.
        offset: Time added to all times, us.
        previous: `t` of the event before them; of the first, one that is not later.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    offset: int
    previous: int


@runtime_checkable
class ColumnSource(EventSource, Protocol):
    """An `EventSource` that can be read without checks."""

    def image_rows(self, rows: slice) -> NDArray[np.uint16] | None:
        """Read the y of a range of rows; None where `columns` returns None.

        Args:
            rows: The rows, step 1.
        """
        ...

    def columns(self, rows: slice, out: EventColumns | None = None) -> EventColumns | None:
        """Read a range of rows as they are stored.

        Args:
            rows: The rows, step 1.
            out: Columns to write to, if they are long enough.

        Returns:
            The columns; None if they are stored as other types.
        """
        ...


@dataclasses.dataclass(frozen=True, repr=False)
class Events:
    """Events in memory, sorted by time, one array per field, each of shape (events,).

    Columns are checked when they are given and become plain arrays of these types: t is any
    integer type, x and y whole numbers from 0 to 65535 of any type, p bool, 0/1 or -1/1 of any
    type. Arrays that have the type already are kept, not copied; change them no more. Raises
    `InputError` for other types, values that the types do not hold, columns of different length
    and times that go back.

    Attributes:
        t: Times, us.
        x: Columns, px.
        y: Rows, px.
        p: Polarities, True for ON.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]

    def __post_init__(self):
        source, most = "events", (arrays.MAX_SIDE_PX, arrays.MAX_SIDE_PX)
        if (np.asarray(self.t).dtype if hasattr(self.t, "dtype") else np.dtype(int)).kind == "f":
            raise InputError(
                f"{source}: t is {self.t.dtype}; give integer microseconds, or make the recording "
                "by Recording.from_arrays(..., time_unit='s')"
            )
        t, x, y, p = (arrays.as_column(getattr(self, n), f"{source}: {n}") for n in "txyp")
        arrays.check_lengths(t, x, y, p, source)
        columns = {
            "t": arrays.as_times(t, f"{source}: t"),
            "x": arrays.coordinates("x", x, most, source),
            "y": arrays.coordinates("y", y, most, source),
            "p": arrays.polarities(p, source),
        }
        for name, values in columns.items():
            object.__setattr__(self, name, values)
        self.check_order(source)

    @classmethod
    def of_checked(cls, t: NDArray, x: NDArray, y: NDArray, p: NDArray) -> "Events":
        """Make events of columns that were checked and are plain, as rows of other events are.

        Args:
            t: (n,) times in us, int64.
            x: (n,) columns in px, uint16.
            y: (n,) rows in px, uint16.
            p: (n,) polarities, bool.

        Returns:
            The events.
        """
        events = object.__new__(cls)
        for name, values in zip("txyp", (t, x, y, p), strict=True):
            object.__setattr__(events, name, values)
        return events

    @classmethod
    def empty(cls) -> "Events":
        """Return no events."""
        kinds = (np.int64, np.uint16, np.uint16, np.bool_)
        return cls.of_checked(*(np.empty(0, kind) for kind in kinds))

    def __repr__(self) -> str:
        return f"<{_describe_span('event', len(self), self.t)}>"

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> "Events":
        """Return the events of a slice, a mask or row numbers that rise."""
        rows = _check_rows(rows, "events", len(self))
        if isinstance(rows, slice) and rows.step in (None, 1):
            return Events.of_checked(self.t[rows], self.x[rows], self.y[rows], self.p[rows])
        columns = (np.ascontiguousarray(getattr(self, name)[rows]) for name in "txyp")
        part = Events.of_checked(*columns)
        if isinstance(rows, slice) or rows.dtype.kind != "b":
            part.check_order("events")
        return part

    def index(self, time: int) -> int:
        """Count the events earlier than `time` (us)."""
        return int(np.searchsorted(self.t, time))

    def to_structured(self) -> NDArray:
        """Return the events as a structured array: t int64 us, x and y uint16, p bool."""
        out = np.empty(len(self), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
        for name in "txyp":
            out[name] = getattr(self, name)
        return out

    def to_dataframe(self) -> "pandas.DataFrame":
        """Return the events as a pandas table with the columns t (int64 us), x, y and p (bool)."""
        import pandas

        return pandas.DataFrame({name: getattr(self, name) for name in "txyp"})

    def check(self, width: int, height: int, source: str, first_row: int = 0) -> None:
        """Check that the events are sorted and inside a sensor.

        Args:
            width: Width of the sensor in px.
            height: Height of the sensor in px.
            source: Name of their file or recording for messages.
            first_row: Row of the first event in the source.

        Raises:
            InputError: An event is not valid.
        """
        arrays.check_lengths(self.t, self.x, self.y, self.p, source)
        self.check_order(source, first_row)
        self.check_places(width, height, source, first_row)

    def check_order(self, source: str, first_row: int = 0) -> None:
        """Check that the events are sorted by time.

        Args:
            source: Name of their file or recording for messages.
            first_row: Row of the first event in the source.

        Raises:
            InputError: Times go back.
        """
        row = arrays.first_decrease(self.t)
        if row is not None:
            late = int((self.t < np.maximum.accumulate(self.t)).sum())
            raise OrderError(
                f"{source}: event {first_row + row} is at {self.t[row]} us, earlier than the one "
                f"before it at {self.t[row - 1]} us, like {late:,} of {len(self):,} events "
                "read; sort the events by time (stable), or leave out those whose times are false"
            )

    def check_places(self, width: int, height: int, source: str, first_row: int = 0) -> None:
        """Check that the events are inside a sensor.

        Args:
            width: Width of the sensor in px.
            height: Height of the sensor in px.
            source: Name of their file or recording for messages.
            first_row: Row of the first event in the source.

        Raises:
            InputError: An event is outside.
        """
        for name, values in (("x", self.x), ("y", self.y)):
            arrays.coordinates(name, values, (width, height), source, first_row=first_row)


def _check_rows(rows: Any, what: str, number: int) -> slice | NDArray:
    """Check that rows choose several of a number of things.

    Args:
        rows: Rows as a caller gives them.
        what: Name of the things, for messages.
        number: Number of the things.

    Returns:
        A slice, a mask of all rows, or row numbers.

    Raises:
        InputError: They choose one row, several columns, or rows that are not there.
    """
    if isinstance(rows, slice):
        try:
            rows.indices(number)
        except (TypeError, ValueError):
            raise InputError(
                f"{what}[{rows.start}:{rows.stop}] is not a range of rows; give whole numbers, or "
                "choose times by recording[start:stop] (integers are microseconds, floats seconds)"
            ) from None
        return rows
    chosen = np.asarray(rows) if np.ndim(rows) == 1 else np.empty(0, object)
    if chosen.dtype.kind == "f" and not len(chosen):
        return chosen.astype(np.int64)
    if chosen.dtype.kind not in "biu":
        raise InputError(
            f"{what} are chosen by a slice, a mask or a list of rows, "
            f"not {arrays.shorten_value(rows)}; write {what}[row : row + 1] for one of them"
        )
    if chosen.dtype.kind == "b":
        if len(chosen) != number:
            raise InputError(
                f"{what} are chosen by a mask of {len(chosen):,} values, but there are "
                f"{number:,}; give one value for each"
            )
    elif len(chosen) and not -number <= chosen.min() <= chosen.max() < number:
        wrong = chosen.min() if chosen.min() < -number else chosen.max()
        raise InputError(
            f"{what} have no row {wrong}, for there are {number:,}; give rows from 0 to below that"
        )
    return chosen


def slice_bounds(rows: Any, count: int, what: str = "events in a file") -> tuple[int, int]:
    """Return the bounds of a slice of events that are read piece by piece.

    Args:
        rows: The slice, of step 1.
        count: Number of events.
        what: Name of the events for messages.

    Returns:
        First row, and the row after the last one.

    Raises:
        InputError: The rows are no slice, or its step is another.
    """
    rows = _check_rows(rows, "events", count)
    if not isinstance(rows, slice) or rows.step not in (None, 1):
        raise InputError(f"{what} are read as a range of rows, events[i:j], step 1")
    return rows.indices(count)[:2]


class CheckedEvents:
    """An `EventSource` that checks the events of another one when they are read.

    Raises `InputError` if events are not of the type `Events`, go back in time, lie outside the
    sensor of `size` (width, height), or are not as many as the rows of the slice.
    """

    def __init__(self, source: EventSource, size: tuple[int, int], name: str):
        self._source, self.checked_size, self._name = source, size, f"{name}: events"

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, rows: slice) -> Events:
        start, stop = slice_bounds(rows, len(self), self._name)
        if stop <= start:
            return Events.empty()
        # The event before the range is read too, so that pieces are sorted as a whole.
        lead = min(start, 1)
        events = self._source[start - lead : stop]
        if not isinstance(events, Events) or len(events) != stop - start + lead:
            held = f"{len(events)} events" if isinstance(events, Events) else type(events).__name__
            raise InputError(
                f"{self._name}[{start - lead}:{stop}] of {type(self._source).__name__} is {held}; "
                f"it must be jaxevent.Events of {stop - start + lead} rows"
            )
        events.check(*self.checked_size, self._name, start - lead)
        return events[lead:]

    def index(self, time: int) -> int:
        """Count the events earlier than `time` (us); raise `InputError` for a wrong number."""
        row = self._source.index(time)
        if isinstance(row, int | np.integer) and 0 <= row <= len(self):
            row = int(row)
            near = self[max(row - 1, 0) : row + 1].t
            if (
                near[: min(row, 1)].max(initial=time - 1)
                < time
                <= near[min(row, 1) :].min(initial=np.iinfo(np.int64).max)
            ):
                return row
        raise InputError(
            f"{self._name}: index({time}) of {type(self._source).__name__} is "
            f"{arrays.shorten_value(row)}; it must be the number of events "
            "earlier than that time (us)"
        )


def _is_source(events: Any) -> bool:
    """Return whether an object is events; types of Python have an `index` too."""
    built_in = isinstance(events, type | str | bytes | list | tuple | range)
    return not built_in and isinstance(events, EventSource) and callable(events.index)


def _checked_source(events: Any, size: tuple[int, int], name: str) -> EventSource:
    """Check the events of a recording, or have them checked when they are read.

    Args:
        events: Events, or a source of events.
        size: Width and height of the sensor, px.
        name: Name of the recording, for messages.

    Returns:
        A source that gives valid events alone.

    Raises:
        InputError: They are no events, or not on the sensor.
    """
    if isinstance(events, Events):
        events.check_places(*size, name)
        return events
    if not _is_source(events):
        raise InputError(
            f"{name}: events is a {type(events).__name__}, not jaxevent.Events; make the recording "
            "by jaxevent.Recording.from_arrays(t, x, y, p, width=..., height=...), or of a file by "
            "jaxevent.load"
        )
    known = getattr(events, "checked_size", None)
    if isinstance(known, tuple) and known[0] <= size[0] and known[1] <= size[1]:
        return events
    return CheckedEvents(events, size, name)


@runtime_checkable
class ImageSource(Protocol):
    """Images of shape (frames, height, width) that stay in a file until np.asarray reads them."""

    @property
    def dtype(self) -> np.dtype:
        """Type of the pixels."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images, (frames, height, width)."""
        ...

    def __getitem__(self, rows: Any) -> "ImageSource":
        """Return some of the images, still in the file."""
        ...


LEAST_WHITE_GREY = 0.98  # grey value from which a pixel may be white and noise


@dataclasses.dataclass(frozen=True, repr=False)
class Frames:
    """Grey frames with the middles and lengths of their exposures.

    Times rise. All is checked when it is given; of images that stay in a file, type and shape.

    Attributes:
        t: (frames,) times of the middle of each exposure in us.
        images: (frames, height, width) uint8 or uint16 grey levels, or floats in [0, 1].
        exposure: (frames,) lengths of the exposures in us; 0 where unknown.

    Raises:
        InputError: Types, shapes or values are not valid.
    """

    t: NDArray[np.int64]
    images: NDArray | ImageSource
    exposure: NDArray[np.int64]

    def __post_init__(self):
        images, source = self.images, "frames"
        lazy = isinstance(images, ImageSource) and not isinstance(images, np.ndarray | np.generic)
        lazy = lazy and isinstance(images.dtype, np.dtype) and not hasattr(images, "__dlpack__")
        if not lazy:
            images = arrays.as_array(images, f"{source}: images")
        arrays.check_image_kind(np.dtype(images.dtype), source)
        t = _integer_times(self.t, f"{source}: t")
        exposure = _integer_times(self.exposure, f"{source}: exposure")
        shape = tuple(images.shape)
        if len(shape) != 3 or not len(t) == len(exposure) == shape[0]:
            raise InputError(
                f"{source} have shape {shape}, and there are {len(t)} times and {len(exposure)} "
                "exposures; give images (n, height, width), and n of both"
            )
        if not lazy:
            arrays.check_image_values(images, source)
            images = arrays.plain_images(np.asarray(images))
        for name, values in (("t", t), ("images", images), ("exposure", exposure)):
            object.__setattr__(self, name, values)
        self._check_times(source)

    @classmethod
    def of_checked(
        cls, t: NDArray[np.int64], images: NDArray | ImageSource, exposure: NDArray[np.int64]
    ) -> "Frames":
        """Make frames of arrays that were checked, as rows of other frames, or of linear intensity.

        Args:
            t: (n,) times in us.
            images: (n, height, width) images.
            exposure: (n,) lengths of the exposures in us.

        Returns:
            The frames.
        """
        frames = object.__new__(cls)
        for name, values in (("t", t), ("images", images), ("exposure", exposure)):
            object.__setattr__(frames, name, values)
        return frames

    def __repr__(self) -> str:
        height, width = self.images.shape[1:]
        return (
            f"<{_describe_span('frame', len(self), self.t)}, {width}x{height} {self.images.dtype}>"
        )

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> "Frames":
        """Return the frames of a slice, a mask or row numbers that rise."""
        rows = _check_rows(rows, "frames", len(self))
        part = Frames.of_checked(self.t[rows], self.images[rows], self.exposure[rows])
        if not isinstance(rows, slice) or (rows.step or 1) < 1:
            part._check_times("frames")
        return part

    @property
    def intensity(self) -> NDArray[np.float32]:
        """Images as float32 grey values in [0, 1]."""
        images = np.asarray(self.images)
        if images.dtype.kind == "f":
            return images.astype(np.float32)
        return np.divide(images, np.iinfo(images.dtype).max, dtype=np.float32)

    @property
    def limits(self) -> NDArray[np.float32]:
        """Intensities of black and of white in each frame, (frames, 2)."""
        return self._of_grey([0, 1])

    @property
    def least_white(self) -> NDArray[np.float32]:
        """Least intensity that may be white and noise, so that it is only a bound, (frames,)."""
        return self._of_grey([LEAST_WHITE_GREY])[:, 0]

    def _of_grey(self, grey: list[float]) -> NDArray[np.float32]:
        """Return the intensities of some grey values in each frame, (frames, values)."""
        return np.tile(np.array(grey, np.float32), (len(self), 1))

    def check(self, width: int, height: int, source: str) -> None:
        """Check that the frames fit a sensor, are in order and hold numbers.

        Args:
            width: Width of the sensor in px.
            height: Height of the sensor in px.
            source: Name of their file or recording for messages.

        Raises:
            InputError: A frame is not valid.
        """
        arrays.check_image_kind(np.dtype(self.images.dtype), f"{source}: frames")
        self.check_shape(width, height, source)
        self._check_times(source)
        arrays.check_image_values(self.images, source)

    def check_shape(self, width: int, height: int, source: str) -> None:
        """Check that the images are those of a sensor.

        Args:
            width: Width of the sensor in px.
            height: Height of the sensor in px.
            source: Name of their file or recording for messages.

        Raises:
            InputError: The images have another shape.
        """
        if self.images.shape != (len(self.t), height, width) or len(self.exposure) != len(self.t):
            raise InputError(
                f"{source}: frames have shape {self.images.shape} and {len(self.exposure)} "
                f"exposures; {len(self.t)} frame times of a {width}x{height} sensor need "
                f"({len(self.t)}, {height}, {width}) and {len(self.t)}; crop, turn or resize "
                "them, or correct the sensor's size"
            )

    def _check_times(self, source: str) -> None:
        row = arrays.first_decrease(self.t, strict=True)
        if row is not None:
            raise InputError(
                f"{source}: frame {row} at {self.t[row]} us is not later than frame {row - 1} at "
                f"{self.t[row - 1]} us; sort the frames by time and remove repeated ones"
            )
        if (self.exposure < 0).any():
            row = int(np.argmax(self.exposure < 0))
            raise InputError(
                f"{source}: frame {row} has the exposure {self.exposure[row]} us; it must be "
                "positive, or 0 where unknown"
            )


@dataclasses.dataclass(frozen=True, repr=False)
class LinearFrames(Frames):
    """Frames of a camera that is known; their `intensity` is linear in that of the scene.

    Attributes:
        response: Response of the camera.
        gain: (frames,) brightness of each frame, see `Recording.gain`.
    """

    response: Response
    gain: NDArray[np.float64]

    def __post_init__(self):
        """Take the images as they are: they are those of checked frames."""

    def __getitem__(self, rows: slice | NDArray) -> "LinearFrames":
        part = super().__getitem__(rows)
        return LinearFrames(part.t, part.images, part.exposure, self.response, self.gain[rows])

    @property
    def intensity(self) -> NDArray[np.float32]:
        """Images as float32 intensities: the response of the grey values over the gain."""
        return self._linear(super().intensity)

    def _of_grey(self, grey: list[float]) -> NDArray[np.float32]:
        return self._linear(super()._of_grey(grey))

    def _linear(self, grey: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the intensities of grey values (frames, ...)."""
        linear = np.asarray(self.response.intensity(grey), np.float64)
        return (linear / self.gain.reshape(-1, *[1] * (grey.ndim - 1))).astype(np.float32)


def _integer_times(values: Any, what: str) -> NDArray[np.int64]:
    """Convert times of any integer type to int64.

    Args:
        values: (n,) times, us.
        what: What they are the times of, for messages.

    Returns:
        (n,) us.

    Raises:
        InputError: They are no integers.
    """
    t = arrays.as_column(values, what)
    if t.dtype.kind == "f" and len(t):
        raise InputError(
            f"{what} is {t.dtype}; give integer microseconds, as np.rint(1e6 * {what.split()[-1]})"
            ".astype('int64') of seconds"
        )
    return arrays.as_times(t, what)


def _set_rows(
    part: Any, what: str, may_be_nan: str | None = None, **columns: tuple[tuple[int, ...], Any]
) -> None:
    """Check times and columns of measurements, and store them with their types.

    Args:
        part: Frozen dataclass with `t` (us) and the columns; changed in place.
        what: Name of a row for messages.
        may_be_nan: Column that may hold NaN.
        columns: Shape of a row and type, by the name of the column.

    Raises:
        InputError: Times are not sorted, or a column has another shape or is not finite.
    """
    t = _integer_times(part.t, f"{what}: t")
    row = arrays.first_decrease(t)
    if row is not None:
        raise InputError(
            f"{what} times are not sorted: row {row} is earlier than the one above it; sort them"
        )
    object.__setattr__(part, "t", t)
    for name, (shape, kind) in columns.items():
        values = arrays.as_array(getattr(part, name), f"{what}: {name}")
        wanted = (len(t), *shape)
        kept = values.astype(kind) if np.isfinite(values).all() else values
        known = kept == values
        if name == may_be_nan and values.dtype.kind == "f":
            known |= np.isnan(values)
        if values.shape != wanted or not known.all():
            raise InputError(
                f"{what}: {name} is {values.dtype} of shape {values.shape}; it must be finite "
                f"{np.dtype(kind)} of shape {wanted}, one row for each of {len(t)} times"
            )
        object.__setattr__(part, name, arrays.as_plain(values, kind))


@dataclasses.dataclass(frozen=True)
class _TimedRows:
    """Rows of measurements at sorted times; subclasses have further columns."""

    t: NDArray[np.int64]  # (n,) us

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> Self:
        rows = _check_rows(rows, "rows", len(self))
        return type(self)(*(values[rows] for values in vars(self).values()))


@dataclasses.dataclass(frozen=True)
class Poses(_TimedRows):
    """Ground-truth camera poses.

    Attributes:
        t: (n,) sorted times, us.
        position: (n, 3) m.
        quaternion: (n, 4) as x, y, z, w.
    """

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    def __post_init__(self):
        _set_rows(self, "pose", position=((3,), np.float64), quaternion=((4,), np.float64))


@dataclasses.dataclass(frozen=True)
class Imu(_TimedRows):
    """Inertial measurements.

    Attributes:
        t: (n,) sorted times, us.
        gyro: (n, 3) angular velocity, rad/s.
        acc: (n, 3) acceleration, m/s^2, NaN where it was not measured; it may be left out.
    """

    gyro: NDArray[np.float64]
    acc: NDArray[np.float64] = None  # ty: ignore[invalid-assignment]

    def __post_init__(self):
        if self.acc is None:
            object.__setattr__(self, "acc", np.full(np.shape(self.gyro), np.nan))
        _set_rows(self, "IMU", "acc", gyro=((3,), np.float64), acc=((3,), np.float64))


@dataclasses.dataclass(frozen=True)
class Triggers(_TimedRows):
    """Signals from outside.

    Attributes:
        t: (n,) sorted times, us.
        edge: (n,) 1 rising, 0 falling, -1 unknown.
        channel: (n,) number of the input.
    """

    edge: NDArray[np.int8]
    channel: NDArray[np.uint8]

    def __post_init__(self):
        _set_rows(self, "trigger", edge=((), np.int8), channel=((), np.uint8))
        if not np.isin(self.edge, (-1, 0, 1)).all():
            raise InputError("triggers need an edge, -1, 0 or 1, for each time; correct them")


def _columns_given(t: Any, x: Any, y: Any, p: Any) -> dict[str, Any]:
    """Return the columns of events by name.

    Args:
        t: (n,) times in any unit; or all columns in one array or table, if the others are None.
        x: (n,) columns, px; None: as `t` says.
        y: (n,) rows, px; None: as `t` says.
        p: (n,) polarities; None: as `t` says.

    Returns:
        The columns.

    Raises:
        InputError: One is missing.
    """
    given = dict(zip("txyp", (t, x, y, p), strict=True))
    if x is None and y is None and p is None:
        given = arrays.columns_of(t)
    missing = [name for name in "txyp" if given[name] is None]
    if missing:
        raise InputError(
            f"{missing[0]} is missing; give t, x, y and p, or one array with these fields"
        )
    return given


def _events_of_columns(
    t: NDArray[np.int64], given: Mapping[str, Any], size: tuple[int, int], name: str
) -> Events:
    """Check columns of a caller, and make events of them.

    Args:
        t: (n,) times, us.
        given: Columns x, y and p by name.
        size: Width and height of the sensor, px.
        name: Name of the recording, for messages.

    Returns:
        The events.

    Raises:
        InputError: A column is not valid, or times are not in order.
    """
    x, y, p = (arrays.as_column(given[field], field) for field in "xyp")
    arrays.check_lengths(t, x, y, p, name)
    events = Events.of_checked(
        t,
        arrays.coordinates("x", x, size, name),
        arrays.coordinates("y", y, size, name),
        arrays.polarities(p, name),
    )
    events.check_order(name)
    return events


@dataclasses.dataclass(frozen=True, repr=False)
class Recording(HtmlRepr):
    """One recording of one sensor; see the module for the conventions.

    `extra` keeps, by name, whatever arrays the file held beyond these fields (a contrast threshold,
    HDR reference images, a known motion). Of these the library reads: the camera response, see
    `response`; `rgb`, colour frames (frames, height, width, 3) uint8, which may stay in a file as
    frames do, see `jaxevent.colour`.

    `notes` are remarks of the reader, one sentence without a full stop each, that `jaxevent info`
    prints: the unit of time it inferred, the number of words it skipped. `left_out` describes, by
    the name of a field that is None ("frames", "camera"), the data of the file and how to have them
    read; messages that miss the field end with that.

    Attributes:
        name: Name, for messages and results.
        width: Width of the sensor, px.
        height: Height of the sensor, px.
        events: The events, in memory or in a file.
        frames: The frames; None: there are none.
        camera: Calibration of the lens.
        poses: True poses of the camera.
        imu: Inertial measurements.
        extra: Further arrays by name.
        triggers: Signals from outside.
        notes: Remarks of the reader.
        left_out: Descriptions of data that were not read, by field.
    """

    name: str
    width: int
    height: int
    events: EventSource
    frames: Frames | None = None
    camera: PinholeCamera | None = None
    poses: Poses | None = None
    imu: Imu | None = None
    extra: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    triggers: Triggers | None = None
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if not isinstance(self.name, str) or "\0" in self.name:
            raise InputError(
                f"name is {arrays.shorten_value(self.name)}, a {type(self.name).__name__}; give "
                "a text without the character NUL, the recording's name"
            )
        size = arrays.as_size(self.width, self.height, self.name)
        for side, pixels in zip(("width", "height"), size, strict=True):
            object.__setattr__(self, side, pixels)
        events = _checked_source(self.events, size, self.name)
        object.__setattr__(self, "events", events)
        parts = {"camera": PinholeCamera, "frames": Frames, "poses": Poses, "imu": Imu}
        parts["triggers"] = Triggers
        for field, kind, remedy in (
            *(
                (name, one, f"{one.__module__}.{one.__name__} or None")
                for name, one in parts.items()
            ),
            ("extra", Mapping, "a dictionary by name"),
            ("left_out", Mapping, "a dictionary by name"),
            ("notes", tuple | list, "a tuple of sentences"),
        ):
            part = getattr(self, field)
            if not isinstance(part, kind) and (part is not None or field not in parts):
                raise InputError(f"{self.name}: {field} is a {type(part).__name__}; give {remedy}")
        for key in self.extra:
            if not isinstance(key, str):
                raise InputError(
                    f"{self.name}: {arrays.shorten_value(key)} is no name of a further array "
                    "(extra); give a text"
                )
        if self.frames is not None:
            self.frames.check_shape(self.width, self.height, self.name)
        if self.camera is not None:
            self.camera.check_sensor(*size, self.name)

    @classmethod
    def from_arrays(
        cls,
        t: Any,
        x: Any = None,
        y: Any = None,
        p: Any = None,
        *,
        width: int | None = None,
        height: int | None = None,
        frames: Any = None,
        frame_times: Any = None,
        exposure: Any = None,
        time_unit: arrays.TimeUnit | None = None,
        name: str = "arrays",
        camera: PinholeCamera | None = None,
        poses: Poses | None = None,
        imu: Imu | None = None,
        triggers: Triggers | None = None,
        extra: Mapping[str, Any] | None = None,
        white: float | int | None = None,
    ) -> "Recording":
        """Make a recording of arrays in memory.

        Arrays are lists or arrays of any library that NumPy can read: NumPy of any byte order and
        stride, JAX, PyTorch on the CPU, columns of pandas, polars and Arrow. Those that have the
        recording's own types are kept, not copied; change them no more.

        Args:
            t: Times of the events (n,), sorted. Integers are us unless `time_unit` says otherwise;
                floats need `time_unit`. Given alone: a structured array, a DataFrame, a table or a
                dictionary that holds all four columns by names such as t, x, y, p or timestamp,
                x, y, polarity.
            x: Columns of the events (n,), whole numbers from 0 to width - 1.
            y: Rows of the events (n,), whole numbers from 0 to height - 1.
            p: Polarity (n,): bool, 0 and 1 or -1 and 1 of any type. 1 is ON.
            width: Pixels of a row of the sensor; by default those of the frames.
            height: Pixels of a column of the sensor; by default those of the frames.
            frames: Images (m, height, width), or in colour (m, height, width, 3), red first: uint8,
                white is 255; uint16, white is 65535; or floats, white is 1; see `white`. Colours
                become grey (ITU-R 601 luma) and are kept in `extra["rgb"]`, uint8.
            frame_times: Times (m,) of the middle of each exposure, which rise; units are as of `t`.
            exposure: Length of the exposures, one number or (m,), of the same unit; by default
                unknown.
            time_unit: Unit of `t`, `frame_times` and `exposure`: "s", "ms", "us" or "ns". Times
                are rounded to us.
            name: The recording's name, in messages and on pages.
            camera: Lens of the event camera.
            poses: Ground truth of the camera's motion.
            imu: Inertial measurements.
            triggers: Signals from outside.
            extra: Further arrays by name; see `Recording`.
            white: Level of the frames that is white, where it is another: 4095 for 12 bits in
                uint16, 255 for floats up to 255. Integers become uint16.

        Returns:
            The recording, checked. An `InputWarning` tells of frames far from all events, of
            exposures longer than the time between frames, of uint16 frames that hold 12 bits or
            fewer, and of times that look like those of another unit.

        Raises:
            InputError: An argument has another type, shape or length, a value is not finite, not
                on the sensor or not in order, or more than one meaning is possible. The message
                names the argument and the remedy.
        """
        arrays.check_unit(time_unit)
        given = _columns_given(t, x, y, p)
        grey = colours = made = None
        if frames is not None:
            frames = frames if white is None else arrays.scale_levels(frames, white)
            grey, colours = arrays.as_images(frames)
            height = grey.shape[1] if height is None else height
            width = grey.shape[2] if width is None else width
        elif any(one is not None for one in (frame_times, exposure, white)):
            what = "frame_times" if frame_times is not None else "exposure"
            what = "white" if frame_times is None and exposure is None else what
            raise InputError(f"{what} is given without frames; give frames, (m, height, width)")
        if width is None or height is None:
            raise InputError(
                "width and height are missing, the sensor's size in pixels; give width=346, "
                "height=260 or what your camera has"
            )
        size = arrays.as_size(width, height, name)
        us = arrays.as_times(given["t"], "t", time_unit)
        events = _events_of_columns(us, given, size, name)
        stored = arrays.as_column(given["t"], "t")
        if doubt := doubt_given_unit(stored, events.x, events.y, size, time_unit):
            warnings.warn(f"{name}: {doubt}", InputWarning, stacklevel=2)
        if grey is not None and (doubt := arrays.doubt_levels(grey)):
            warnings.warn(f"{name}: {doubt}", InputWarning, stacklevel=2)
        if grey is not None:
            if frame_times is None:
                raise InputError("frame_times is missing; give the time of each of the frames")
            middle = arrays.as_times(frame_times, "frame_times", time_unit)
            lengths = arrays.as_array(0 if exposure is None else exposure, "exposure")
            if lengths.ndim == 0:
                lengths = np.broadcast_to(lengths, middle.shape)
            made = Frames(middle, grey, arrays.as_times(lengths, "exposure", time_unit))
        further = {} if extra is None else extra
        if colours is not None and isinstance(further, Mapping):
            further = {"rgb": colours, **further}
        recording = cls(name, *size, events, made, camera, poses, imu, further, triggers)
        recording.refuse_empty()
        if made is not None and (doubt := _doubt_times(us, made)):
            unit = "integers are us" if time_unit is None else f"time_unit={time_unit!r}"
            warnings.warn(
                f"{name}: {doubt}; frame_times and exposure have the unit of t, {unit}; correct "
                "what has another",
                InputWarning,
                stacklevel=2,
            )
        return recording

    def __repr__(self) -> str:
        count = len(self.events)
        ends = [self.events[row : row + 1].t[0] for row in ((0, count - 1) if count else ())]
        parts = [f"{self.name}: {self.width}x{self.height}", _describe_span("event", count, ends)]
        if self.frames is not None:
            parts.append(_describe_span("frame", len(self.frames), self.frames.t))
        parts += [n for n in ("camera", "poses", "imu", "triggers") if getattr(self, n) is not None]
        extra = [f"{len(self.extra)} arrays in extra"] if len(self.extra) > 3 else self.extra
        return f"<{', '.join([*parts, *extra])}>"

    @property
    def start(self) -> int:
        """Time of the first event or frame in us; the filters' time zero."""
        self.refuse_empty()
        first = [int(self.events[:1].t[0])] if len(self.events) else []
        return min(first + ([int(self.frames.t[0])] if self.frames else []))

    @property
    def stop(self) -> int:
        """Time of the last event or frame in us."""
        self.refuse_empty()
        last = [int(self.events[len(self.events) - 1 :].t[0])] if len(self.events) else []
        return max(last + ([int(self.frames.t[-1])] if self.frames else []))

    def event_span(self) -> tuple[int, int]:
        """Return the times of the first and the last event, us.

        Raises:
            InputError: There are no events.
        """
        count = len(self.events)
        if not count:
            raise InputError(f"{self.name}: holds no events; choose another recording")
        return int(self.events[:1].t[0]), int(self.events[count - 1 :].t[0])

    @property
    def gain(self) -> NDArray[np.float64]:
        """Brightness of each frame relative to one in which intensity 1 is white: `extra["gain"]`.

        Frames of an automatic exposure: intensity is the response's, divided by the gain. 1 where
        there is none. Raises `InputError` for gains that are not one positive number per frame.
        """
        number = 0 if self.frames is None else len(self.frames)
        if not number or "gain" not in self.extra:
            return np.ones(number)
        gain = np.asarray(self.extra["gain"])
        if gain.dtype.kind not in "iuf" or gain.shape != (number,) or not (gain > 0).all():
            raise InputError(
                f"{self.name}: extra['gain'] is {gain.dtype} of shape {gain.shape}; give one "
                f"positive number for each of the {number} frames"
            )
        return gain.astype(np.float64)

    @property
    def response(self) -> Response:
        """Camera response in `extra`; `UnknownResponse()` if there is none.

        `extra["response"]` holds n >= 3 intensities of evenly spaced grey values from 0 to 1 that
        never fall, `extra["certainty"]`, where present, their n certainties. Recordings of the
        AKF's authors have `extra["f_Q"]` instead, the certainties of 256 grey levels with which
        intensity is linear. Raises `InputError` for other shapes and values.
        """
        key, levels, weights = "f_Q", np.linspace(0, 1, 256), self.extra.get("f_Q")
        if "response" in self.extra:
            key, levels, weights = "response", self.extra["response"], self.extra.get("certainty")
        elif weights is None:
            return UnknownResponse()
        try:
            return TableResponse(levels, weights)
        except ValueError as error:
            also = " with extra['certainty']" if key == "response" and weights is not None else ""
            raise InputError(f"{self.name}: extra[{key!r}]{also}: {error}") from error

    @property
    def linear_frames(self) -> Frames:
        """The frames; where the camera's response or gains are known, `LinearFrames`.

        Methods reconstruct this intensity. Without a response it is the grey value.

        Raises:
            InputError: The recording has no frames, or its response or gains are not valid.
        """
        if self.frames is None:
            raise InputError(f"{self.name}: holds no frames; choose a recording with frames")
        response, gain, grey = self.response, self.gain, np.linspace(0, 1, 256)
        if (gain == 1).all() and np.allclose(response.intensity(grey), grey, atol=1e-6):
            return self.frames
        frames = self.frames
        return LinearFrames(frames.t, frames.images, frames.exposure, response, gain)

    def __getitem__(self, span: slice) -> "Recording":
        """Return the part with start <= t < stop; ints are us, floats s, of its clock."""
        if not isinstance(span, slice) or span.step is not None:
            raise TypeError("slice a recording by two times: recording[t0:t1]")
        t0 = self.start if span.start is None else one_time(span.start, "the start")
        t1 = self.stop + 1 if span.stop is None else one_time(span.stop, "the stop")

        if t1 < t0 and span.start is not None and span.stop is not None:
            raise InputError(
                f"{self.name}: the part from {t0} to {t1} us ends before it begins; give the "
                "earlier time first"
            )

        def cut(part):
            if part is None:
                return None
            part = part[slice(*np.searchsorted(part.t, [t0, t1]))]
            return part if len(part) else None

        rows = None
        if self.frames is not None:
            rows = slice(*np.searchsorted(self.frames.t, [t0, t1]))
        names = ("frames", "poses", "imu", "triggers")
        cuts = {name: cut(getattr(self, name)) for name in names}
        part = dataclasses.replace(
            self,
            extra=self._cut_extra(rows),
            events=self.events[self.events.index(t0) : self.events.index(t1)],
            left_out=self._left_out_of(cuts, "outside the times taken"),
            **cuts,
        )
        if not len(part.events) and part.frames is None:
            ends = [] if span.start is None else [f"from {t0}"]
            ends += [] if span.stop is None else [f"to {t1}"]
            raise InputError(
                f"{self.name}: no event and no frame {' '.join(ends)} us; the recording "
                f"reaches from {self.start} to {self.stop} us"
            )
        return part

    def require_camera(self, camera: PinholeCamera | None, what: str) -> PinholeCamera:
        """Return a camera that is given, or the recording's.

        Args:
            camera: The camera; None takes the recording's.
            what: Name of what needs it, for the message.

        Returns:
            The camera.

        Raises:
            InputError: There is none; the message says how to give one.
        """
        camera = self.camera if camera is None else camera
        if camera is None:
            raise InputError(
                f"{self.name}: has no calibration, which {what} needs"
                f"{self.describe_left_out('camera')}; give "
                "camera=jaxevent.camera.PinholeCamera(fx, fy, cx, cy) in px, here or to "
                "jaxevent.load, which reads calibrations from YAML, too; a recording that a "
                "configuration names has its own from jaxevent convert --camera"
            )
        return camera

    def describe_left_out(self, field: str) -> str:
        """Return the end of a message that misses a field: the entry of `left_out`."""
        is_missing = getattr(self, field) is None
        return f" ({self.left_out[field]})" if is_missing and field in self.left_out else ""

    def _left_out_of(self, cuts: Mapping[str, Any], why: str) -> Mapping[str, str]:
        """Return `left_out` with the fields that a cut leaves empty.

        Args:
            cuts: Parts of the recording after the cut, by field; None: nothing is left.
            why: End of the note, such as "not among those chosen".

        Returns:
            Notes by field.
        """
        left_out = dict(self.left_out)
        for name, part in cuts.items():
            whole = getattr(self, name)
            if part is None and whole is not None and len(whole):
                left_out[name] = f"its {len(whole):,} {name} from {format_span(whole.t)} are {why}"
        return left_out

    def with_frames(self, rows: slice | NDArray) -> "Recording":
        """Return the recording with some of its frames, by a slice, a mask or row numbers."""
        frames = (self.frames[rows] if self.frames is not None else None) or None
        left_out = self._left_out_of({"frames": frames}, "not among those chosen")
        return dataclasses.replace(
            self, frames=frames, extra=self._cut_extra(rows), left_out=left_out
        )

    def _cut_extra(self, rows: slice | NDArray | None) -> Mapping[str, Any]:
        """Return the further arrays; those with one entry per frame are cut like frames."""
        if rows is None:
            return self.extra
        cut = {name: self.extra[name][rows] for name in PER_FRAME_EXTRAS if name in self.extra}
        return {**self.extra, **cut}

    def check(self, source: str | None = None) -> "Recording":
        """Check the recording again; arrays that were changed since it was made are found, too.

        Args:
            source: Name for messages; by default the recording's.

        Returns:
            The recording.

        Raises:
            InputError: Something is not valid; the message names the place.
        """
        source = source or self.name
        self.refuse_empty(source)
        self.check_events(source)
        if self.frames is not None:
            self.frames.check(self.width, self.height, source)
        return self

    def check_events(self, source: str | None = None) -> None:
        """Raise `InputError` if events in memory were changed since they were checked."""
        if isinstance(self.events, Events):
            self.events.check(self.width, self.height, source or self.name)

    def refuse_empty(self, source: str | None = None) -> None:
        """Raise `InputError` if there is neither an event nor a frame."""
        if not len(self.events) and not self.frames:
            raise InputError(
                f"{source or self.name}: holds no event and no frame; choose a recording with some"
            )

    def refuse_one_time(self, source: str | None = None) -> None:
        """Raise `InputError` if several events are all at one time, which shows no motion."""
        if len(self.events) < 2:
            return
        first, last = self.event_span()
        if first == last:
            raise InputError(
                f"{source or self.name}: all {len(self.events):,} events are at one time, "
                f"{first} us; choose a recording with times"
            )
