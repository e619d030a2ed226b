"""NumPy files that need not be trusted: events in arrays of their own, and archives of arrays."""

import functools
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import to_microseconds
from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.io.decoded import BLOCK, Columns, Decoder


def read_member(archive: zipfile.ZipFile, name: str, source: str) -> NDArray:
    """Read an array of numbers of an archive.

    Raises `InputError` for objects, and for a shape that the array's bytes cannot fill.
    """
    with archive.open(name) as stream:
        shape, dtype = read_header(stream, f"{source}: {name}")
        if shape is None or dtype is None:
            raise InputError(f"{source}: {name} is pickled, which is not read; store numbers")
        if int(np.prod(shape, dtype=object)) * dtype.itemsize > archive.getinfo(name).file_size:
            raise InputError(f"{source}: {name} is cut off; fetch the file again")
    with archive.open(name) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def read_header(stream: Any, source: str) -> tuple[tuple[int, ...] | None, np.dtype | None]:
    """Read the shape and type of an array, both None of one that holds objects."""
    major, _ = np.lib.format.read_magic(stream)
    read_one = {
        1: np.lib.format.read_array_header_1_0,
        2: np.lib.format.read_array_header_2_0,
    }
    if major not in read_one:
        raise InputError(f"{source}: is an array of an unknown version; store it by numpy.save")
    shape, _, dtype = read_one[major](stream)
    return (None, None) if dtype.hasobject else (shape, dtype)


def open_events(t: Path, xy: Path, p: Path) -> dict[str, NDArray]:
    """Open the arrays of events, left in their files.

    Args:
        t: File of times (events,) or (events, 1).
        xy: File of columns and rows (events, 2).
        p: File of polarities (events,) or (events, 1).

    Returns:
        "t", "x", "y" and "p", each (events,) of the type that is stored.

    Raises:
        InputError: A file is missing or has another shape, or lengths differ.
    """
    opened: list[NDArray] = []
    for file, width in ((t, 1), (xy, 2), (p, 1)):
        with reading(str(file)):
            stored = np.load(file, mmap_mode="r", allow_pickle=False)
        if stored.shape not in ((len(stored), width), (len(stored),)[: 3 - width]):
            raise InputError(
                f"{file}: has shape {stored.shape}; it must be (events, {width}), one row per event"
            )
        opened.append(stored.reshape(len(stored), width))
    lengths = [len(one) for one in opened]
    if len(set(lengths)) != 1:
        raise InputError(
            f"{t.parent}: t, xy and p have {lengths[0]}, {lengths[1]} and {lengths[2]} events; "
            "they must be equally long"
        )
    stamps, places, signs = opened
    return {"t": stamps[:, 0], "x": places[:, 0], "y": places[:, 1], "p": signs[:, 0]}


def events_decoder(columns: Mapping[str, NDArray], unit: str, source: str) -> Decoder:
    """Return the decoder of the columns of `open_events`, whose times have a unit ("s" or "us")."""
    return functools.partial(_decode, columns, unit, source)


def _decode(
    columns: Mapping[str, NDArray], unit: str, source: str, state: int | None
) -> Iterator[tuple[int, Columns]]:
    for row in range(state or 0, len(columns["t"]), BLOCK):
        t, x, y, p = (np.array(columns[name][row : row + BLOCK]) for name in "txyp")
        yield row, (to_microseconds(t, unit, source, "event", row), x, y, p)
