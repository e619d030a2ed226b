"""Event Stream recordings (.es, version 2): change events of a DVS or an ATIS.

After a header with the sensor's size each event is 5 bytes, one of time since the event before and
polarity, then x and y; single bytes carry longer times. The clock starts at 0 with the recording.
The rows of the format count from the bottom: y becomes height - 1 - y here.

An ATIS sends two kinds of event. Its change events are the events of the recording. The others,
crossings of two thresholds whose distance in time measures the absolute intensity of a pixel, are
no change and are not kept; `extra["intensity_events"]` says how many there were.

Decoder. The format has no fixed records, so it is decoded here by a numba loop: 220 million
events/s. The package event_stream (C++; its files name two licences, MIT and GPL 3) decodes
atis.es to the same 1,326,017 events, and the same short files of every byte; it stops without a
word where a file ends inside an event.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.codegen import njit
from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.io.decoded import BLOCK, Columns, Tally, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Recording

MAGIC = b"Event Stream"
_HEADER = 20
_KINDS = {0: "generic data", 1: "DVS events", 2: "ATIS events", 4: "colour events"}


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input."""
    with reading(str(path)), path.open("rb") as file:
        head = file.read(_HEADER)
    version, kind = tuple(head[12:15]), head[15] if len(head) > 15 else None
    if version[:1] != (2,):
        raise InputError(
            f"{path}: has version {'.'.join(map(str, version))} of Event Stream; only version 2 "
            "can be read, so convert it with its own tools"
        )
    if kind not in (1, 2):
        raise InputError(
            f"{path}: holds {_KINDS.get(kind or 0, f'data of type {kind}')}; only change events, "
            "of a DVS or an ATIS, can be read"
        )
    if len(head) < _HEADER:
        raise InputError(f"{path}: ends inside its header; fetch the file again")
    width, height = (int(n) for n in np.frombuffer(head, "<u2", 2, 16))
    size = options.size or (width, height)
    found = Tally()

    def decode(state: tuple[int, int] | None) -> Iterator[tuple[Any, Columns]]:
        offset, t = state or (_HEADER, 0)
        with path.open("rb") as file:
            file.seek(offset)
            rest = b""
            while piece := file.read(5 * BLOCK - len(rest)):
                state = (offset, t)
                data = np.frombuffer(rest + piece, np.uint8)
                columns, count, crossings, used, t = _decode(data, t, kind == 2)
                found.add("intensity_events", crossings, offset)
                offset += used
                rest = data[used:].tobytes()
                ts, xs, ys, ps = (column[:count] for column in columns)
                yield state, (ts, xs, height - 1 - ys, ps)
        if rest:
            raise InputError(
                f"{path}: ends {len(rest)} bytes after the start of an event of 5 bytes; the "
                "recording was cut off, so fetch it again or drop these bytes: truncate -s "
                f"-{len(rest)} FILE"
            )

    events = decoded(decode, size, str(path), options)
    return Recording(path.stem, *size, events, extra=found.arrays())


@njit
def _decode(data, t, is_atis):
    """Whole events at the start of `data`, their number, the crossings, the bytes used, the time.

    A first byte dddddddp holds time d and polarity p for a DVS, ddddddpc for an ATIS with c set for
    a crossing. All of d set: the time goes on by 127 p (DVS), or 63 times the two low bits (ATIS).
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
