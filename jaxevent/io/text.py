"""The text layout of the Event-Camera Dataset (Mueggler et al., IJRR 2017), in a folder or zip.

    events.txt       t x y p                  p is 0/1 or -1/1; first lines may be: width height,
                                              and names of the columns, in any order
    images.txt       t path                   path relative to the folder
    groundtruth.txt  t px py pz qx qy qz qw   m, unit quaternion
    imu.txt          t ax ay az gx gy gz      m/s^2, rad/s
    calib.txt        fx fy cx cy k1 k2 p1 p2 k3

All t are seconds. Where those of events.txt are whole numbers only, their unit is another, which is
inferred (`time_units`) or given, and the other files are read on the clock of the events. Only
events.txt is required, and it may be empty where there are images. In a zip the files may lie in
one top folder; a zip of one text alone, as rpg_e2vid reads, may name it otherwise. The exposure of
the images is unknown: 0. Colour images become grey (ITU-R 601 luma); where all are, `extra["rgb"]`
keeps their colours.
"""

import re
import zipfile
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.utils import CallbackIOWrapper

from jaxevent.arrays import to_microseconds
from jaxevent.errors import InputError
from jaxevent.io import check_unfolded, find_event_texts, pinhole, reading, sensor_size
from jaxevent.io.columns import find, first_and_last, is_time, signed, stated_unit, unsigned_off
from jaxevent.io.decoded import from_columns
from jaxevent.io.images import kept_colours, read_grey_and_colour
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import clock_of, infer_unit, unit_of_name
from jaxevent.progress import bar
from jaxevent.recording import Frames, Imu, Poses, Recording


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a folder or zip. Raises `InputError` for bad input."""
    if path.is_dir():
        return _read(path, path, options)
    with reading(str(path)), zipfile.ZipFile(path) as archive:
        inside = [name for name in find_event_texts(archive.namelist()) if name.count("/") <= 1]
        if len(inside) != 1:
            raise InputError(
                f"{path}: holds {len(inside)} events.txt at its top or in a top folder; "
                "make a zip of one recording"
            )
        folder, _, name = inside[0].rpartition("/")
        return _read(path, zipfile.Path(archive, folder and f"{folder}/"), options, name)


def _read(
    path: Path, root: Path | zipfile.Path, options: ReadOptions, name: str = "events.txt"
) -> Recording:
    source = f"{path}: {name}"
    stamps, unit_of_stamps, images, colours = _images(path, root)
    columns, header, names = _table(
        root / name, source, "t x y p", header="width height", progress=options.progress
    )
    otherwise = (
        f"{source}: neither a first line 'width height' nor an image tells the sensor's size;"
    )
    told = header or (None if images is None else (images.shape[2], images.shape[1]))
    size = sensor_size(options.size, told, frames=None, otherwise=otherwise)
    fields = find(names) or {name: name for name in "txyp"}
    t, x, y, p = (columns[names.index(fields[name])] for name in "txyp")
    stated = stated_unit(fields["t"], t)
    sample = first_and_last(lambda rows: {"t": t[rows], "x": x[rows], "y": y[rows]}, len(t))
    unit = infer_unit(sample, len(t), size, source, options, stated=stated, usual="s")
    is_known = stated is not None or options.time_unit is not None
    if unit.name == "s" and not is_known and _are_whole(t):
        raise InputError(
            f"{source}: all times are whole numbers, but those of this layout are seconds; write "
            "seconds with decimals, or give the unit, time_unit= or --time-unit"
        )
    notes = list(unit.notes)
    us = to_microseconds(t, unit.name, source, "event")
    events = from_columns((us, x, y, signed(p, unsigned_off(p))), size, source, options)
    clock = clock_of(unit, t, us)

    frames = poses = imu = camera = None
    if images is not None:
        source = f"{path}: images.txt"
        at = clock.read(stamps, source, "image", notes, usual="s", stated=unit_of_stamps)
        frames = Frames(at, images, np.zeros_like(at))
    if (root / "groundtruth.txt").is_file():
        source = f"{path}: groundtruth.txt"
        (t, *pose), _, _ = _table(root / "groundtruth.txt", source, "t px py pz qx qy qz qw")
        pose = np.stack(pose, axis=1)
        at = clock.read(t, source, "pose", notes, usual="s")
        poses = Poses(at, pose[:, :3], pose[:, 3:])
    if (root / "imu.txt").is_file():
        source = f"{path}: imu.txt"
        (t, *sample), _, _ = _table(root / "imu.txt", source, "t ax ay az gx gy gz")
        sample = np.stack(sample, axis=1)
        at = clock.read(t, source, "IMU sample", notes, usual="s")
        imu = Imu(at, gyro=sample[:, 3:], acc=sample[:, :3])
    if (root / "calib.txt").is_file():
        source = f"{path}: calib.txt"
        values, _, _ = _table(root / "calib.txt", source, "fx fy cx cy k1 k2 p1 p2 k3")
        camera = pinhole(np.concatenate(values), source)
    return Recording(
        path.stem, *size, events, frames, camera, poses, imu, colours, notes=tuple(notes)
    )


def _are_whole(t: NDArray) -> bool:
    return len(t) > 1 and bool((t == np.rint(t)).all()) and t[0] != t[-1]


def _table(
    file: Path | zipfile.Path,
    source: str,
    layout: str,
    header: str | None = None,
    progress: bool | None = None,
) -> tuple[list[NDArray[np.float64]], tuple[int, int] | None, list[str]]:
    """Read a file of numbers: its columns, finite float64, their names, and its header.

    Lines before the numbers that are blank, start with # or hold letters are passed over. One with
    the names of events names the columns, which otherwise are those of the layout.
    """
    names = layout.split()
    found = None
    skip = 0
    with reading(source), file.open("rb") as lines:
        while line := lines.readline().removeprefix(BOM_UTF8):
            words = _words(line)
            if header is not None and len(words) == len(names) and find(words):
                names = words
            elif header is not None and len(fields := line.split()) == len(header.split()):
                if not all(field.isdigit() and int(field) for field in fields):
                    raise InputError(
                        f"{source}: line {skip + 1} has {len(fields)} fields but is not "
                        f"'{header}'; each line must be '{layout}'"
                    )
                found = (int(fields[0]), int(fields[1]))
            elif line.strip() and not line.startswith(b"#"):
                if len(words) != len(names) or not _are_names(words):
                    break
            skip += 1
        if not line.strip() and not lines.read().strip():
            return [np.empty(0) for _ in names], found, names
    # 4 to 5 million events/s with sep=r"\s+" on one core, 40 times numpy.loadtxt.
    total = file.stat().st_size if isinstance(file, Path) else None
    with (
        reading(source),
        file.open("rb") as stream,
        bar(
            total=total, desc=f"read {file.name}", unit="B", unit_scale=True,
            progress=progress,
        ) as shown,
    ):  # fmt: skip
        table = pd.read_csv(
            cast(Any, CallbackIOWrapper(shown.update, stream, "read")),
            sep=r"\s+",
            header=None,
            names=names,
            skiprows=skip,
            engine="c",
            low_memory=False,
            quoting=3,
        )
    if not isinstance(table.index, pd.RangeIndex):  # pandas makes surplus columns the index
        raise InputError(f"{source}: has too many columns; each line must be '{layout}'")
    columns = []
    for name in names:
        values = np.asarray(pd.to_numeric(table[name], errors="coerce"), np.float64)
        good = np.isfinite(values)
        if not good.all():
            row = int(np.argmin(good))
            raise InputError(
                f"{source}: row {row} has {name} = {table[name].iloc[row]}; each line must be the "
                f"finite numbers '{layout}'"
            )
        columns.append(values)
    return columns, found, names


def _words(line: bytes) -> list[str]:
    """The words of a line that may be a comment; a unit belongs to its name: "t [s] x y p"."""
    text = line.decode("utf-8", "replace").lstrip("#% ")
    return re.sub(r"\s+(?=[\[(])", "", text).split()


def _are_names(words: list[str]) -> bool:
    """Return whether a line names columns: none of its words begins as a number does."""
    return bool(words) and not any(re.match(r"[+-]?\.?\d|nan|inf", w, re.I) for w in words)


def _images(
    path: Path, root: Path | zipfile.Path
) -> tuple[NDArray, str | None, NDArray | None, dict[str, NDArray[np.uint8]]]:
    """The times of the frames, as stored, the unit in their name, the frames, and the colours."""
    none = np.empty(0), None, None, dict[str, NDArray[np.uint8]]()
    if not (root / "images.txt").is_file():
        return none
    source = f"{path}: images.txt"
    with reading(source):
        lines = (root / "images.txt").read_text(encoding="utf-8-sig").splitlines()
    stamps, unit, images, colours, unfolded = [], None, [], [], 0
    seen, stored = set(), 0 if path.is_dir() else path.stat().st_size
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(maxsplit=1)
        if not stamps and _are_names(fields) and is_time(fields[0]):
            unit = unit_of_name(fields[0])
            continue
        try:
            stamps.append(float(fields[0]))
            name = fields[1].strip()
        except (ValueError, IndexError):
            raise InputError(
                f"{source}: line {number} is {line[:60]!r}; each line must be 't path'"
            ) from None
        image, colour = _image(path, root, name)
        images.append(image)
        colours.append(colour)
        if path.is_dir() and name not in seen:
            seen.add(name)
            stored += (path / name).stat().st_size
        unfolded += image.nbytes + (0 if colour is None else colour.nbytes)
        check_unfolded(unfolded, stored, source)
        if images[-1].shape != images[0].shape or images[-1].dtype != images[0].dtype:
            raise InputError(
                f"{path}: {name} is {_kind(images[-1])} but the first image is "
                f"{_kind(images[0])}; all images must have the sensor's size and one depth"
            )
    if not images:
        return none
    return np.array(stamps), unit, np.stack(images), kept_colours(colours)


def _image(
    path: Path, root: Path | zipfile.Path, name: str
) -> tuple[NDArray, NDArray[np.uint8] | None]:
    if name.startswith(("/", "\\")) or ".." in re.split(r"[/\\]", name):
        raise InputError(f"{path}: images.txt names {name}, outside the recording; copy it inside")
    file = root / name
    if not file.is_file():
        raise InputError(
            f"{path}: images.txt names {name}, which does not exist; add the image or remove "
            "its line"
        )
    with reading(f"{path}: {name}"), file.open("rb") as stream:
        return read_grey_and_colour(stream, f"{path}: {name}")


def _kind(image: NDArray) -> str:
    return f"{image.shape[1]}x{image.shape[0]} {image.dtype}"
