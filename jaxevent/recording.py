"""What a hybrid event camera recorded: events, frames, calibration, ground truth, IMU, triggers.

Conventions, said once. Time is int64 microseconds on the recording's own clock. `x` is the column
(to the right), `y` the row (downwards), both from 0; image arrays are [y, x]. Polarity is True for
ON (brighter), False for OFF. Where a time is asked for, an integer means microseconds and a float
means seconds, both on the recording's clock.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera, Response, TableResponse, UnknownResponse
from jaxevent.errors import InputError, OrderError
from jaxevent.shown import Shown, plural

if TYPE_CHECKING:
    import pandas

Times = ArrayLike | int | float

PER_FRAME = ("gain", "rgb")  # names of `Recording.extra` that hold one entry per frame


def microseconds(time: Times, what: str = "times") -> NDArray[np.int64]:
    """Times as int64 microseconds: integers are taken as microseconds, floats as seconds.

    Raises `InputError` for other types and for times that are not finite or too large for int64.
    """
    time = np.asarray(time)
    if time.dtype.kind not in "iuf":
        raise InputError(
            f"{what} are {time.dtype}; give integers (microseconds) or floats (seconds)"
        )
    if not np.all(np.isfinite(time)):
        raise InputError(f"{what} contain a value that is not finite; remove it")
    scaled = np.rint(time.astype(np.float64) * 1e6) if time.dtype.kind == "f" else time
    if time.size and not -(2**63) <= scaled.min() <= scaled.max() < 2**63:
        raise InputError(f"{what} contain one that is too large for microseconds; correct the unit")
    return np.asarray(scaled).astype(np.int64)


def check_times(times: Times, start: int, stop: int, name: str) -> None:
    """Raise `InputError` for times outside start <= t <= stop (us), the span of the data.

    `name` is that of the recording, for the message. The message gives both conventions, since a
    number of the wrong one is the usual reason.
    """
    us = np.atleast_1d(microseconds(times))
    if len(us) and (us.min() < start or us.max() > stop):
        raise InputError(
            f"{name}: times from {us.min()} to {us.max()} us were asked for, but it lasts from "
            f"{start} to {stop} us; give times of the recording's clock inside it (integers are "
            "microseconds, floats seconds), or extrapolate=True"
        )


def _span(what: str, number: int, t: Any) -> str:
    """As in "2 events from 0.1 to 0.2 s"."""
    text = f"{number:,} {plural(what, number)}"
    return f"{text} from {t[0] / 1e6:g} to {t[-1] / 1e6:g} s" if number else text


@runtime_checkable
class EventSource(Protocol):
    """Events that can be read piece by piece; `Events` in memory, or stored in a file."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: slice) -> "Events":
        """The events of a range of rows, in memory."""
        ...

    def index(self, time: int) -> int:
        """The number of events earlier than `time` (us)."""
        ...


class EventColumns(NamedTuple):
    """Events as they are stored, for those who check order and places while they use them."""

    t: NDArray[np.int64]  # us after `offset`
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]  # 1 ON, 0 OFF
    offset: int
    previous: int  # t of the event before them; of the first, one that is not later


@runtime_checkable
class ColumnSource(EventSource, Protocol):
    """Events that can be read without being checked."""

    def columns(self, rows: slice, room: EventColumns | None = None) -> EventColumns | None:
        """A range of rows, written over those of `room` if they fit; None where types differ."""
        ...


@dataclasses.dataclass(frozen=True, repr=False)
class Events:
    """Events in memory, sorted by time, one array per field, each of shape (events,)."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]

    @classmethod
    def empty(cls) -> "Events":
        none = np.empty(0, np.uint16)
        return cls(none.astype(np.int64), none, none, none.astype(bool))

    def __repr__(self) -> str:
        return f"<{_span('event', len(self), self.t)}>"

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> "Events":
        return Events(self.t[rows], self.x[rows], self.y[rows], self.p[rows])

    def index(self, time: int) -> int:
        return int(np.searchsorted(self.t, time))

    def to_structured(self) -> NDArray:
        """The events as a NumPy structured array: t int64 us, x and y uint16, p bool."""
        out = np.empty(len(self), [("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
        for name in "txyp":
            out[name] = getattr(self, name)
        return out

    def to_dataframe(self) -> "pandas.DataFrame":
        """The events as a pandas table with the columns t (int64 us), x, y and p (bool)."""
        import pandas

        return pandas.DataFrame({name: getattr(self, name) for name in "txyp"})

    def check(self, width: int, height: int, source: str, first_row: int = 0) -> None:
        """Raise `InputError` unless the events are sorted and inside a width x height sensor.

        `source` and `first_row` say where the events came from in the message.
        """
        if not len(self.t) == len(self.x) == len(self.y) == len(self.p):
            raise InputError(
                f"{source}: t, x, y and p have {len(self.t)}, {len(self.x)}, {len(self.y)} and "
                f"{len(self.p)} values; they must be equally long"
            )
        # Comparing neighbours is three times faster than np.diff, which writes int64 differences.
        backwards = self.t[1:] < self.t[:-1]
        if backwards.any():
            row = int(np.argmax(backwards)) + 1
            raise OrderError(
                f"{source}: event {first_row + row} is at {self.t[row]} us, earlier than the one "
                f"before it at {self.t[row - 1]} us; sort the events by time (stable)"
            )
        for name, values, size in (("x", self.x, width), ("y", self.y, height)):
            if len(values) and int(values.max()) >= size:
                row = int(np.argmax(values >= size))
                raise InputError(
                    f"{source}: event {first_row + row} has {name} = {values[row]} outside the "
                    f"{width}x{height} sensor; give the sensor's size or remove the event"
                )


@runtime_checkable
class ImageSource(Protocol):
    """Images of shape (frames, height, width) that stay in a file until np.asarray reads them."""

    @property
    def dtype(self) -> np.dtype: ...

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: Any) -> "ImageSource":
        """Some of the images, still in the file."""
        ...


@dataclasses.dataclass(frozen=True, repr=False)
class Frames:
    """Grey frames: images (frames, height, width), mid-exposure times and exposure lengths (us).

    Images are uint8 or uint16 grey levels, or floats already in [0, 1]. An exposure of 0 means
    that its length is not known.
    """

    t: NDArray[np.int64]
    images: NDArray | ImageSource
    exposure: NDArray[np.int64]

    def __repr__(self) -> str:
        height, width = self.images.shape[1:]
        return f"<{_span('frame', len(self), self.t)}, {width}x{height} {self.images.dtype}>"

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> "Frames":
        return Frames(self.t[rows], self.images[rows], self.exposure[rows])

    @property
    def intensity(self) -> NDArray[np.float32]:
        """The images as float32 grey values in [0, 1]."""
        images = np.asarray(self.images)
        if images.dtype.kind == "f":
            return images.astype(np.float32)
        return np.divide(images, np.iinfo(images.dtype).max, dtype=np.float32)

    def check(self, width: int, height: int, source: str) -> None:
        """Raise `InputError` unless the frames fit the sensor, are in order and hold numbers."""
        if self.images.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
            raise InputError(
                f"{source}: frames are {self.images.dtype}; store uint8, uint16 or floats in [0, 1]"
            )
        if self.images.shape != (len(self.t), height, width) or len(self.exposure) != len(self.t):
            raise InputError(
                f"{source}: frames have shape {self.images.shape} and {len(self.exposure)} "
                f"exposures; {len(self.t)} frame times of a {width}x{height} sensor need "
                f"({len(self.t)}, {height}, {width}) and {len(self.t)}"
            )
        late = self.t[1:] <= self.t[:-1]
        if late.any():
            row = int(np.argmax(late)) + 1
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
        if self.images.dtype.kind == "f":
            for row in range(len(self)):
                image = np.asarray(self.images[row : row + 1])
                if not ((image >= 0) & (image <= 1)).all():
                    raise InputError(
                        f"{source}: frame {row} holds NaN or values outside [0, 1]; scale float "
                        "frames to [0, 1] and remove broken ones"
                    )


@dataclasses.dataclass(frozen=True)
class Poses:
    """Ground-truth camera poses: t (us), position (n, 3) in m, quaternion (n, 4) as x y z w."""

    t: NDArray[np.int64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice) -> "Poses":
        return Poses(self.t[rows], self.position[rows], self.quaternion[rows])


@dataclasses.dataclass(frozen=True)
class Imu:
    """Inertial measurements: t (us), gyro (samples, 3) in rad/s, acc (samples, 3) in m/s^2."""

    t: NDArray[np.int64]
    gyro: NDArray[np.float64]
    acc: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice) -> "Imu":
        return Imu(self.t[rows], self.gyro[rows], self.acc[rows])


@dataclasses.dataclass(frozen=True)
class Triggers:
    """Signals from outside: t (us), edge (1 rising, 0 falling, -1 unknown), channel, each (n,)."""

    t: NDArray[np.int64]
    edge: NDArray[np.int8]
    channel: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | NDArray) -> "Triggers":
        return Triggers(self.t[rows], self.edge[rows], self.channel[rows])


@dataclasses.dataclass(frozen=True, repr=False)
class Recording(Shown):
    """One recording of one sensor; see the module for the conventions.

    `extra` keeps, by name, whatever arrays the file held beyond these fields (a contrast threshold,
    HDR reference images, a known motion). Of these the library reads: the camera response, see
    `response`; `rgb`, colour frames (frames, height, width, 3) uint8, which may stay in a file as
    frames do, see `jaxevent.colour`.

    `notes` are remarks of the reader, one sentence without a full stop each, that `jaxevent info`
    prints: the unit of time it inferred, the number of words it skipped. `left_out` says, by the
    name of a field that is None ("frames", "camera"), what the file holds of it and how to have it
    read; messages that miss the field end with that.
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

    def __repr__(self) -> str:
        count = len(self.events)
        ends = [self.events[row : row + 1].t[0] for row in ((0, count - 1) if count else ())]
        parts = [f"{self.name}: {self.width}x{self.height}", _span("event", count, ends)]
        if self.frames is not None:
            parts.append(_span("frame", len(self.frames), self.frames.t))
        parts += [n for n in ("camera", "poses", "imu", "triggers") if getattr(self, n) is not None]
        return f"<{', '.join([*parts, *self.extra])}>"

    @property
    def start(self) -> int:
        """The time of the first event or frame (us); the filters' time zero."""
        first = [int(self.events[:1].t[0])] if len(self.events) else []
        return min(first + ([int(self.frames.t[0])] if self.frames else []))

    @property
    def stop(self) -> int:
        """The time of the last event or frame (us)."""
        last = [int(self.events[len(self.events) - 1 :].t[0])] if len(self.events) else []
        return max(last + ([int(self.frames.t[-1])] if self.frames else []))

    @property
    def gain(self) -> NDArray[np.float64]:
        """How much brighter each frame shows the scene than intensity 1 as white: `extra["gain"]`.

        Frames of an automatic exposure: intensity is the response's, divided by the gain. 1 where
        there is none. Raises `InputError` for gains that are not one positive number per frame.
        """
        number = 0 if self.frames is None else len(self.frames)
        if "gain" not in self.extra:
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
        """The camera response that `extra` carries; `UnknownResponse()` where it carries none.

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

    def __getitem__(self, span: slice) -> "Recording":
        """The part with start <= t < stop; ints are microseconds, floats seconds, of its clock."""
        if not isinstance(span, slice) or span.step is not None:
            raise TypeError("slice a recording by two times: recording[t0:t1]")
        t0 = self.start if span.start is None else int(microseconds(span.start))
        t1 = self.stop + 1 if span.stop is None else int(microseconds(span.stop))

        def cut(part):
            if part is None:
                return None
            part = part[slice(*np.searchsorted(part.t, [t0, t1]))]
            return part if len(part) else None

        rows = None
        if self.frames is not None:
            rows = slice(*np.searchsorted(self.frames.t, [t0, t1]))
        part = dataclasses.replace(
            self,
            extra=self._extra_of(rows),
            events=self.events[self.events.index(t0) : self.events.index(t1)],
            frames=cut(self.frames),
            poses=cut(self.poses),
            imu=cut(self.imu),
            triggers=cut(self.triggers),
        )
        if not len(part.events) and part.frames is None:
            raise InputError(
                f"{self.name}: no event and no frame between {t0} and {t1} us; the recording "
                f"reaches from {self.start} to {self.stop} us"
            )
        return part

    def describe_left_out(self, field: str) -> str:
        """The end of a message that misses a field that is None: what the file holds of it."""
        return f" ({self.left_out[field]})" if field in self.left_out else ""

    def with_frames(self, rows: slice | NDArray) -> "Recording":
        """The same recording with only some of its frames."""
        frames = self.frames[rows] if self.frames is not None else None
        return dataclasses.replace(
            self, frames=frames if frames else None, extra=self._extra_of(rows)
        )

    def _extra_of(self, rows: slice | NDArray | None) -> Mapping[str, Any]:
        """The further arrays; those with one entry per frame cut like frames."""
        if rows is None:
            return self.extra
        cut = {name: self.extra[name][rows] for name in PER_FRAME if name in self.extra}
        return {**self.extra, **cut}

    def check(self, source: str | None = None) -> "Recording":
        """Return self, or raise `InputError` naming what is wrong and where."""
        source = source or self.name
        if self.width < 1 or self.height < 1:
            raise InputError(f"{source}: the sensor size {self.width}x{self.height} is not valid")
        if not len(self.events) and not self.frames:
            raise InputError(f"{source}: holds no event and no frame; nothing can be estimated")
        if isinstance(self.events, Events):
            self.events.check(self.width, self.height, source)
        if self.frames is not None:
            self.frames.check(self.width, self.height, source)
        named = (("pose", self.poses), ("IMU", self.imu), ("trigger", self.triggers))
        for name, part in named:
            if part is not None and (np.diff(part.t) < 0).any():
                raise InputError(f"{source}: {name} times are not sorted; sort them")
        return self
