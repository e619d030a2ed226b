"""Recordings of the ATIS: Event Stream (.es, version 2), and .bin of N-Caltech101 and N-MNIST.

Event Stream also holds change events of a DVS. After a header with the sensor's size each event has
5 bytes: one with the polarity and the time since the previous event, then x and y. Longer times
need further single bytes. The clock starts at 0 with the recording. The format counts rows from the
bottom, so y becomes height - 1 - y.

An ATIS sends two kinds of event. Its change events are the events of the recording. The others are
crossings of two thresholds, whose distance in time measures the absolute intensity of a pixel. They
are not kept; `extra["intensity_events"]` is their number.

Files of N-Caltech101 and N-MNIST have no header. Every event has 5 bytes, big-endian: 8 bits of x,
8 of y from the top, one of polarity, 23 of the time in us. A row of 240, which the sensor lacks,
marks an overflow of the time counter: all later times are 2^13 us later. The file does not state
the sensor's size, which must be given. A file whose times go back is not taken for this format.

Decoders. Event Stream has no fixed records, so a numba loop decodes it: 220 million events/s. The
package event_stream (C++; its files name two licences, MIT and GPL 3) decodes atis.es to the same
1,326,017 events, and agrees on short files of every byte; it stops without a message if a file ends
inside an event. The .bin files have records of one length, which NumPy decodes as the published
reader of the data sets does (Orchard et al. 2015); this was checked on files written by the layout.
"""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.codegen import njit
from jaxevent.errors import InputError
from jaxevent.io import decoded
from jaxevent.io.checks import ReadOptions, check_whole_records, reading, sensor_size
from jaxevent.io.decoded import Columns, FirstPass, read_events
from jaxevent.recording import Recording

_HEADER_BYTES = 20  # of Event Stream
_DATA_KINDS = {0: "generic data", 1: "DVS events", 2: "ATIS events", 4: "colour events"}
_OVERFLOW_ROW, _OVERFLOW_US = 240, 1 << 13
_MIN_RECOGNISED_EVENTS = 16  # least events of a file without a header that is recognised


def is_n_caltech(path: Path) -> bool:
    """Return whether a file without header can be such a .bin: its first times never go back."""
    length = path.stat().st_size
    if length % 5 or length < 5 * _MIN_RECOGNISED_EVENTS:
        return False
    _, (t, _, _, _) = next(_decode_bin(path, None))
    return len(t) >= _MIN_RECOGNISED_EVENTS and bool((t[1:] >= t[:-1]).all())


def read_n_caltech(path: Path, options: ReadOptions) -> Recording:
    """Read a .bin of N-Caltech101 or N-MNIST.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events stay in the file.

    Raises:
        InputError: The file is damaged or of another version.
    """
    otherwise = (
        f"{path}: has no header, but could be a .bin of N-Caltech101 or N-MNIST, of which it does "
        "not state the sensor's size"
    )
    size = sensor_size(otherwise, options.size)
    decode = functools.partial(_decode_bin, path)
    return Recording(path.stem, *size, read_events(decode, size, str(path), options))


def _decode_bin(path: Path, state: tuple[int, int] | None) -> Iterator[tuple[Any, Columns]]:
    offset, before = state or (0, 0)
    with path.open("rb") as file:
        file.seek(offset)
        while len(data := np.fromfile(file, np.uint8, 5 * decoded.BLOCK_EVENTS)):
            state = (offset, before)
            x, y, *rest = data.reshape(-1, 5).T.astype(np.int64)
            overflows = before + np.cumsum(y == _OVERFLOW_ROW)
            t = (rest[0] & 0x7F) << 16 | rest[1] << 8 | rest[2]
            t += overflows * _OVERFLOW_US
            kept = y != _OVERFLOW_ROW
            yield state, (t[kept], x[kept], y[kept], (rest[0] >> 7 == 1)[kept])
            before = int(overflows[-1])
            offset += len(data)


def read_event_stream(path: Path, options: ReadOptions) -> Recording:
    """Read a file of Event Stream.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events stay in the file.

    Raises:
        InputError: The file is damaged or of another version.
    """
    with reading(path), path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    version, kind = tuple(head[12:15]), head[15] if len(head) > 15 else None
    if version[:1] != (2,):
        raise InputError(
            f"{path}: has version {'.'.join(map(str, version))} of Event Stream; only version 2 "
            "can be read, so convert it with its own tools"
        )
    if kind not in (1, 2):
        raise InputError(
            f"{path}: holds {_DATA_KINDS.get(kind or 0, f'data of type {kind}')}; only change "
            "events, of a DVS or an ATIS, can be read"
        )
    if len(head) < _HEADER_BYTES:
        raise InputError(f"{path}: ends inside its header; fetch the file again")
    width, height = (int(n) for n in np.frombuffer(head, "<u2", 2, 16))
    size = options.size or (width, height)
    first_pass = FirstPass()

    def decode(state: tuple[int, int] | None) -> Iterator[tuple[Any, Columns]]:
        offset, t = state or (_HEADER_BYTES, 0)
        with path.open("rb") as file:
            file.seek(offset)
            rest = b""
            while piece := file.read(5 * decoded.BLOCK_EVENTS - len(rest)):
                state = (offset, t)
                data = np.frombuffer(rest + piece, np.uint8)
                columns, count, crossings, used, t = _decode_stream(data, t, kind == 2)
                first_pass.count("intensity_events", crossings, offset)
                offset += used
                rest = data[used:].tobytes()
                ts, xs, ys, ps = (column[:count] for column in columns)
                yield state, (ts, xs, height - 1 - ys, ps)
        check_whole_records(path, len(rest), 5, "an event")

    events = read_events(decode, size, str(path), options)
    return Recording(path.stem, *size, events, extra=first_pass.counts())


@njit
def _decode_stream(data, t, is_atis):
    """Decode whole events at the start of some bytes.

    A first byte dddddddp holds time d and polarity p for a DVS, ddddddpc for an ATIS with c set for
    a crossing. If all bits of d are set, the byte only adds time: 127 p for a DVS, 63 times the two
    low bits for an ATIS.

    Args:
        data: (bytes,) uint8.
        t: Time before the first event, us.
        is_atis: Whether the stream comes from an ATIS.

    Returns:
        The columns, the numbers of events, crossings and bytes used, and the time at their end.
    """
    most = len(data) // 5
    ts, xs = np.empty(most, np.int64), np.empty(most, np.int32)
    ys, ps = np.empty(most, np.int32), np.empty(most, np.bool_)
    count = crossings = at = 0
    shift, low, step = (2, 3, 63) if is_atis else (1, 1, 127)
    while at < len(data):
        byte = np.int64(data[at])
        d = byte >> shift
        if d == step:
            t += step * (byte & low)
            at += 1
            continue
        if at + 5 > len(data):
            break
        t += d
        if is_atis and byte & 1:
            crossings += 1
        else:
            ts[count] = t
            xs[count] = data[at + 1] | np.int32(data[at + 2]) << 8
            ys[count] = data[at + 3] | np.int32(data[at + 4]) << 8
            ps[count] = byte >> (shift - 1) & 1
            count += 1
        at += 5
    return (ts, xs, ys, ps), count, crossings, at, t
