"""Recordings in the layout of TimeLens (Tulyakov et al., CVPR 2021), HS-ERGB and BS-ERGB.

    events/000000.npz ...    x, y, t or timestamp, p or polarity, each (events,): the events between
                             two images, in the order of the files' names
    images/000000.png ...    in the order of their names
    images/timestamp.txt     one time for each image

The folders may be named events_aligned and images_corrected. The layout is that of the projects
uzh-rpg/rpg_timelens, README and timelens/common, and of ercanburak/EVREAL, tools/bs_ergb_to_npy.py.

Times are whole microseconds in BS-ERGB; other units are inferred (`time_units`).
The events of HS-ERGB and BS-ERGB were remapped onto the images' pixels, and are stored in 1/32
pixel. Coordinates are taken so where most events would lie outside the images otherwise. They are
rounded to whole pixels, as are coordinates with decimals, and events outside the images are left
out; a note counts them. Images beyond the last time are left out too, as the README of TimeLens
says. Exposures are unknown: 0. Colours become grey (ITU-R 601 luma), and `extra["rgb"]` keeps them.

Decoder. NumPy's own files, read here; checked against files written by the layout.
"""

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import to_microseconds
from jaxevent.errors import InputError
from jaxevent.io import open_archive, reading, sensor_size
from jaxevent.io.columns import find
from jaxevent.io.decoded import Columns, decoded
from jaxevent.io.images import SUFFIXES, read_files
from jaxevent.io.numpy_files import read_member
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import SAMPLE, clock_of, infer_unit
from jaxevent.recording import Frames, Recording

_FOLDERS = (("events", "images"), ("events_aligned", "images_corrected"))
_STAMPS = ("timestamp.txt", "timestamps.txt")
_FINE = 32  # parts of a pixel in which remapped coordinates count
_MISPLACED = 0.5  # share of events outside the images that shows remapped coordinates


def knows(folder: Path) -> bool:
    """Tell whether a folder holds a recording."""
    return any(_event_files(folder / name) for name, _ in _FOLDERS)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a folder.

    Unless `options.in_memory`, events and images stay in their files. Raises `InputError` for bad
    input.
    """
    source = str(path)
    names = next(pair for pair in _FOLDERS if _event_files(path / pair[0]))
    files, folder = _event_files(path / names[0]), path / names[1]
    notes: list[str] = []
    left_out: dict[str, str] = {}
    stamps, pictures = _find_images(folder, notes, left_out)
    images, extra = None, {}
    if pictures:
        images, extra = read_files(pictures, str(folder), options.in_memory)
    told = None if images is None else (images.shape[2], images.shape[1])
    otherwise = f"{path}: no image in {names[1]} tells the sensor's size;"
    size = sensor_size(options.size, told, frames=None, otherwise=otherwise)
    first, last = _ends(files)
    places = _Places(size, first[1], first[2])
    sample = {
        name: np.concatenate([first[k][:SAMPLE], last[k][-1:]]) for k, name in enumerate("txy")
    }
    count, usual = len(first[0]) * len(files), "us" if first[0].dtype.kind in "iu" else None
    unit = infer_unit(sample, count, size, source, options, usual=usual)
    notes += unit.notes
    decode = functools.partial(_decode, files, unit.name, places)
    events = decoded(decode, size, source, options)
    notes += places.describe()
    frames = None
    if images is not None:
        ends = [*events[:1].t, *events[max(len(events) - 1, 0) :].t]
        what = f"{folder.name}/{_stamps_of(folder)}"
        t = clock_of(unit, sample["t"], ends).read(stamps, f"{path}: {what}", "image", notes)
        frames = Frames(t, images, np.zeros_like(t))
    return Recording(
        path.name, *size, events, frames, extra=extra, notes=tuple(notes), left_out=left_out
    )


def _event_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.npz")) if folder.is_dir() else []


def _stamps_of(folder: Path) -> str | None:
    return next((name for name in _STAMPS if (folder / name).is_file()), None)


def _find_images(
    folder: Path, notes: list[str], left_out: dict[str, str]
) -> tuple[NDArray, list[Path]]:
    """Find the times of the images, as stored, and their files; what is left out is named."""
    files = []
    if folder.is_dir():
        files = sorted(one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES[:-1])
    name = _stamps_of(folder)
    if files and name is None:
        left_out["frames"] = (
            f"{folder} holds {len(files):,} images without their times; add {_STAMPS[0]} with one "
            "time for each"
        )
    if not files or name is None:
        return np.empty(0), []
    stamps = _read_stamps(folder / name)
    if len(stamps) > len(files):
        raise InputError(
            f"{folder / name}: has {len(stamps)} times for {len(files)} images; leave out the "
            "lines that belong to none"
        )
    if len(stamps) < len(files):
        notes.append(f"{len(files) - len(stamps):,} images beyond the last time are left out")
    return stamps, files[: len(stamps)]


def _read_stamps(file: Path) -> NDArray:
    """Read one number from each line: integers where all are, else floats."""
    with reading(str(file)):
        words = file.read_text(encoding="utf-8-sig").split()
    for kind in (np.int64, np.float64):
        try:
            stamps = np.array(words, kind)
        except (ValueError, OverflowError):
            continue
        if np.isfinite(stamps).all():
            return stamps
    raise InputError(f"{file}: holds something else than times; give one number in each line")


class _Places:
    """The conversion of coordinates to whole pixels of the images.

    Attributes:
        parts: Number of parts of a pixel in which coordinates are stored, 1 or 32.
        is_remapped: Whether coordinates lie between pixels, and outside the images too.
        n_outside: Number of events outside the images, of the files that were converted.
    """

    def __init__(self, size: tuple[int, int], x: NDArray, y: NDArray):
        """Infer the coordinates from those of some events, (events,) each."""
        self._size = size
        outside = (x >= size[0]) | (y >= size[1]) | (x < 0) | (y < 0)
        is_fine = bool(len(x)) and float(outside.mean()) > _MISPLACED
        self.parts = _FINE if is_fine else 1
        self.is_remapped = is_fine or any(
            values.dtype.kind == "f" and bool((values != np.rint(values)).any())
            for values in (x, y)
        )
        self.n_outside = 0
        self._last = -1

    def convert(self, number: int, columns: Columns) -> Columns:
        """Return the events of file `number` in whole pixels, without those outside the images."""
        if not self.is_remapped:
            return columns
        t, x, y, p = columns
        column, row = (np.rint(values.astype(np.float64) / self.parts) for values in (x, y))
        width, height = self._size
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if number > self._last:  # a file that is decoded again counts once
            self._last, self.n_outside = number, self.n_outside + int((~inside).sum())
        return t[inside], column[inside], row[inside], p[inside]

    def describe(self) -> Iterator[str]:
        """Yield a sentence on the coordinates where they lie between pixels."""
        if self.is_remapped:
            unit = f"1/{self.parts} pixel" if self.parts > 1 else "fractions of a pixel"
            outside = f"; {self.n_outside:,} events outside the images are left out"
            yield f"coordinates are in {unit}{outside if self.n_outside else ''}"


def _columns(file: Path) -> Columns:
    """Read t, x, y and p of a file, as stored."""
    with reading(str(file)), open_archive(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        fields = find(names)
        if fields is None:
            raise InputError(
                f"{file}: holds {', '.join(names)[:80] or 'nothing'}; store x, y, timestamp and "
                "polarity"
            )
        t, x, y, p = (read_member(archive, f"{fields[n]}.npy", str(file)).ravel() for n in "txyp")
    return t, x, y, p


def _ends(files: Sequence[Path]) -> tuple[Columns, Columns]:
    """Read the first and the last file that hold events; the first and the last where none does."""
    first, last = (
        next((one for one in map(_columns, order) if len(one[0])), None)
        for order in (files, files[::-1])
    )
    return first or _columns(files[0]), last or _columns(files[-1])


def _decode(
    files: Sequence[Path], unit: str, places: _Places, state: int | None
) -> Iterator[tuple[int, Columns]]:
    row = 0
    for number in range(state or 0, len(files)):
        t, x, y, p = _columns(files[number])
        stamps = to_microseconds(t, unit, str(files[number]), "event", row)
        row += len(t)
        yield number, places.convert(number, (stamps, x, y, p))
