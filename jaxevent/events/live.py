"""Events that are still coming: by chunks, as lines of a pipe, and the last ones of a stream."""

from collections.abc import Iterator
from io import BufferedIOBase
from typing import BinaryIO

import numpy as np

from jaxevent.arrays import MAX_TIME_US
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

EVENTS_PER_CHUNK = 4096  # of a recording
BYTES_PER_CHUNK = 1 << 16  # at most, of a pipe


class Tail:
    """An `EventSource` that keeps only the last events of a stream, and the first one.

    Args:
        width: Width of the sensor, px.
        height: Height of the sensor, px.

    Attributes:
        count: Number of events so far.
        dropped: Number of events that are not kept.
        last: Time of the last event, us.
    """

    def __init__(self, width: int, height: int) -> None:
        self.checked_size = (width, height)
        self.count = self.dropped = 0
        self.last = np.iinfo(np.int64).min  # us
        self._first = Events.empty()
        self._parts: list[Events] = []

    def __len__(self) -> int:
        return self.count

    def add(self, events: Events) -> None:
        """Add events.

        Args:
            events: Events of the sensor, not earlier than those before.

        Raises:
            InputError: They are not valid events of the sensor, or earlier.
        """
        if not isinstance(events, Events):
            raise InputError(
                f"the events added are a {type(events).__name__}; give jaxevent.Events(t, x, y, p)"
            )
        events.check(*self.checked_size, "the events added", self.count)
        if len(events) and events.t[0] < self.last:
            raise InputError(
                f"the events added begin at {events.t[0]} us, before the last one at {self.last} "
                "us; add them in order of time"
            )
        if len(events):
            # A copy: the caller may use the memory of the events again.
            own = Events.of_checked(*(getattr(events, name).copy() for name in "txyp"))
            self._first = self._first if self.count else own[:1]
            self._parts.append(own)
            self.count += len(events)
            self.last = int(events.t[-1])

    def retained(self) -> Events:
        """Return the events from row `dropped` on."""
        if len(self._parts) != 1:
            parts = self._parts or [Events.empty()]
            joined = (np.concatenate([getattr(e, name) for e in parts]) for name in "txyp")
            self._parts = [Events.of_checked(*joined)]
        return self._parts[0]

    def __getitem__(self, rows: slice) -> Events:
        first, stop, _ = rows.indices(self.count)
        if (first, stop) == (0, 1):
            return self._first
        if first < self.dropped:
            raise IndexError(f"events before row {self.dropped} are gone")
        return self.retained()[first - self.dropped : stop - self.dropped]

    def index(self, time: int) -> int:
        return self.dropped + self.retained().index(time)

    def drop(self, row: int) -> None:
        """Drop the events before a row."""
        kept = self.retained()[max(row - self.dropped, 0) :]
        # A copy: a slice would hold the array that it is of.
        self._parts = [Events.of_checked(*(getattr(kept, name).copy() for name in "txyp"))]
        self.dropped = max(row, self.dropped)


def read_lines(file: BinaryIO | BufferedIOBase, name: str = "standard input") -> Iterator[Events]:
    """Read events from lines `t x y p`, a chunk as soon as it has come.

    The first line tells the unit of all times: seconds where its t has a decimal point or an
    exponent, else microseconds.

    Args:
        file: A binary file or pipe.
        name: Its name, for messages.

    Yields:
        The events of the lines that were complete.

    Raises:
        InputError: A line does not hold four numbers.
    """
    rest, scale, line = b"", 0.0, 1
    read = getattr(file, "read1", file.read)
    while block := read(BYTES_PER_CHUNK):
        whole, newline, rest = (rest + block).rpartition(b"\n")
        if not newline:
            rest = whole + rest
            continue
        if not whole.strip():
            continue
        scale = scale or _time_scale(whole)
        yield _parse(whole, scale, f"{name}: line {line} or later")
        line += whole.count(b"\n") + 1
    if rest.strip():
        yield _parse(rest, scale or _time_scale(rest), f"{name}: line {line}")


def _time_scale(text: bytes) -> float:
    """Return the factor of times in microseconds."""
    first = text.split(maxsplit=1)[0].lower()
    return 1e6 if b"." in first or b"e" in first else 1.0


def _parse(text: bytes, scale: float, place: str) -> Events:
    """Parse lines of text as events.

    Args:
        text: Lines of t, x, y and p.
        scale: Length of the unit of t, us.
        place: Name of the source, for messages.

    Returns:
        The events.

    Raises:
        InputError: A line is no event.
    """
    lines = [row for row in map(bytes.split, text.splitlines()) if row]
    try:
        columns = np.array(lines, np.float64)
    except ValueError:  # words, or lines of different lengths
        columns = np.full((1, 1), np.nan)
    is_number = columns.shape[1] == 4 and np.isfinite(columns).all()
    if not is_number or np.abs(columns[:, 0]).max() * scale >= MAX_TIME_US:
        raise InputError(f"{place}: is not of the form t x y p; give four numbers in each line")
    t, x, y, p = columns.T
    xy = columns[:, 1:3]
    if (xy != np.rint(xy)).any() or not 0 <= xy.min() <= xy.max() < 1 << 16:
        raise InputError(f"{place}: x and y are not pixels; give whole numbers from 0")
    times = np.rint(t * scale).astype(np.int64)
    return Events(times, x.astype(np.uint16), y.astype(np.uint16), p > 0)


def divide(recording: Recording) -> Iterator[Events]:
    """Divide the events of a recording into chunks, of which one is held at a time.

    Args:
        recording: The recording.

    Yields:
        The events of each chunk.
    """
    for row in range(0, len(recording.events), EVENTS_PER_CHUNK):
        yield recording.events[row : row + EVENTS_PER_CHUNK]
