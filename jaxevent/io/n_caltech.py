"""Recordings of N-Caltech101 and N-MNIST (.bin): an ATIS before a screen that shows images.

The file has no header. Every event is 5 bytes, big-endian: 8 bits of x, 8 of y from the top, one of
polarity, 23 of the time in us. A row of 240, which the sensor lacks, is no event: the counter of
time has overflowed, and all later times are 2^13 us later. The file does not tell the sensor's
size, which must be given; a file whose times go back is not taken for this format.

Decoder. Records of one length, decoded here by NumPy, by the published reader of the data sets
(Orchard et al. 2015); checked against files written by the layout.
"""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.errors import InputError
from jaxevent.io.decoded import BLOCK, Columns, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Recording

_OVERFLOW_ROW, _OVERFLOW = 240, 1 << 13
_FEWEST = 16  # events by which the format is told


def is_plausible(path: Path) -> bool:
    """Whether a file without any header can be one of these: its first times never go back."""
    length = path.stat().st_size
    if length % 5 or length < 5 * _FEWEST:
        return False
    _, (t, _, _, _) = next(_events(path, None))
    return len(t) >= _FEWEST and bool((t[1:] >= t[:-1]).all())


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input."""
    size = options.size
    if size is None:
        raise InputError(
            f"{path}: has no header, but could be a .bin of N-Caltech101 or N-MNIST; if so give "
            "size=(width, height) or --size"
        )
    decode = functools.partial(_events, path)
    return Recording(path.stem, *size, decoded(decode, size, str(path), options))


def _events(path: Path, state: tuple[int, int] | None) -> Iterator[tuple[Any, Columns]]:
    offset, before = state or (0, 0)
    with path.open("rb") as file:
        file.seek(offset)
        while len(data := np.fromfile(file, np.uint8, 5 * BLOCK)):
            state = (offset, before)
            x, y, *rest = data.reshape(-1, 5).T.astype(np.int64)
            overflows = before + np.cumsum(y == _OVERFLOW_ROW)
            t = (rest[0] & 0x7F) << 16 | rest[1] << 8 | rest[2]
            t += overflows * _OVERFLOW
            kept = y != _OVERFLOW_ROW
            yield state, (t[kept], x[kept], y[kept], (rest[0] >> 7 == 1)[kept])
            before = int(overflows[-1])
            offset += len(data)
