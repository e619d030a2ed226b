"""Events by chunks, as they come: lines of a pipe, or those of a recording."""

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

EVENTS_PER_CHUNK = 4096  # of a recording
BYTES_PER_CHUNK = 1 << 16  # at most, of a pipe


def read_lines(file: BinaryIO, name: str = "standard input") -> Iterator[Events]:
    """Read events from lines `t x y p`, a chunk as soon as it has come.

    The first line tells the unit of all times: seconds where its t has a decimal point, else
    microseconds.

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
    return 1e6 if b"." in text.split(maxsplit=1)[0] else 1.0


def _parse(text: bytes, scale: float, place: str) -> Events:
    """Make events of lines."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.full(1, np.nan)
    columns = values.reshape(-1, 4) if len(values) % 4 == 0 else np.full((1, 4), np.nan)
    t, x, y, p = columns.T
    is_number = np.isfinite(columns).all() and (columns[:, 1:3] >= 0).all()
    if not is_number or (columns[:, 1:3] > np.iinfo(np.uint16).max).any():
        raise InputError(f"{place}: is not of the form t x y p; give four numbers in each line")
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
