"""The text layout of the Event-Camera Dataset (Mueggler et al., IJRR 2017), in a folder or zip.

    events.txt       t x y p                  p is 0/1 or -1/1; the first lines may be "width
                                              height" and names of the columns, in any order
    images.txt       t path                   path relative to the folder
    groundtruth.txt  t px py pz qx qy qz qw   m, unit quaternion
    imu.txt          t ax ay az gx gy gz      m/s^2, rad/s
    calib.txt        fx fy cx cy k1 k2 p1 p2 k3

All t are seconds. If those of events.txt are all whole numbers, their unit is another one, which is
inferred (`time_units`) or given; the other files are then read on the clock of the events. Only
events.txt is required, and it may be empty if there are images. In a zip the files may lie in one
top folder. A zip of a single text file, as rpg_e2vid reads, may give it another name. The exposure
of the images is unknown and set to 0. Colour images become grey (ITU-R 601 luma); if all images are
in colour, `extra["rgb"]` keeps their colours.
"""

import re
import zipfile
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.utils import CallbackIOWrapper

from jaxevent.errors import InputError
from jaxevent.io.checks import (
    ReadOptions,
    check_unfolded,
    image_size,
    make_camera,
    reading,
    sensor_size,
)
from jaxevent.io.columns import find_fields, is_time, read_whole_columns
from jaxevent.io.images import drop_alpha, gather_frames, read_image
from jaxevent.progress import bar
from jaxevent.recording import Frames, Imu, Poses, Recording
from jaxevent.time_units import unit_of_name


def find_event_texts(names: Sequence[str]) -> list[str]:
    """Return the text files of events among the names in a zip.

    These are all files events.txt; without any, a single file *.txt, as rpg_e2vid writes.
    """
    found = [name for name in names if name.rpartition("/")[2] == "events.txt"]
    files = [name for name in names if not name.endswith("/") and not name.startswith("__MACOSX/")]
    return found or (files if len(files) == 1 and files[0].endswith(".txt") else [])


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a recording from a folder or zip in the layout of the Event-Camera Dataset.

    Args:
        path: The folder or zip.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording, in memory.

    Raises:
        InputError: A file is missing, damaged or invalid.
    """
    if path.is_dir():
        return _read(path, path, options)
    with reading(path), zipfile.ZipFile(path) as archive:
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
    stamps, unit_of_stamps, images, extra = _read_images(path, root)
    columns, header, names = _read_numbers(
        root / name, source, "t x y p", header="width height", progress=options.progress
    )
    otherwise = (
        f"{source}: neither a first line 'width height' nor an image shows the sensor's size"
    )
    size = sensor_size(otherwise, options.size, header, image_size(images))
    fields = find_fields(names) or {name: name for name in "txyp"}
    held = {key: columns[names.index(fields[key])] for key in "txyp"}
    events, clock, notes = read_whole_columns(
        held, size, source, options, name=fields["t"], usual="s"
    )
    is_known = unit_of_name(fields["t"]) is not None or options.time_unit is not None
    if clock.unit == "s" and not is_known and _are_whole(held["t"]):
        raise InputError(
            f"{source}: all times are whole numbers, but those of this layout are seconds; write "
            "seconds with decimals, or give the unit, time_unit= or --time-unit"
        )

    def table(name: str, layout: str, what: str) -> tuple[NDArray[np.int64], NDArray] | None:
        """Read the times (us) and further columns of another file of the folder."""
        if not (root / f"{name}.txt").is_file():
            return None
        source = f"{path}: {name}.txt"
        (t, *values), _, _ = _read_numbers(root / f"{name}.txt", source, layout)
        return clock.read(t, source, what, notes, usual="s"), np.stack(values, axis=1)

    frames = poses = imu = camera = None
    if images is not None:
        at = clock.read(
            stamps, f"{path}: images.txt", "image", notes, usual="s", stated=unit_of_stamps
        )
        frames = Frames(at, images, np.zeros_like(at))
    if (found := table("groundtruth", "t px py pz qx qy qz qw", "pose")) is not None:
        poses = Poses(found[0], found[1][:, :3], found[1][:, 3:])
    if (found := table("imu", "t ax ay az gx gy gz", "IMU sample")) is not None:
        imu = Imu(found[0], gyro=found[1][:, 3:], acc=found[1][:, :3])
    if (root / "calib.txt").is_file():
        source = f"{path}: calib.txt"
        values, _, _ = _read_numbers(root / "calib.txt", source, "fx fy cx cy k1 k2 p1 p2 k3")
        camera = make_camera(np.concatenate(values), source)
    return Recording(
        path.stem, *size, events, frames, camera, poses, imu, extra, notes=tuple(notes)
    )


def _are_whole(t: NDArray) -> bool:
    return len(t) > 1 and bool((t == np.rint(t)).all()) and t[0] != t[-1]


def _read_numbers(
    file: Path | zipfile.Path,
    source: str,
    layout: str,
    header: str | None = None,
    progress: bool | None = None,
) -> tuple[list[NDArray[np.float64]], tuple[int, int] | None, list[str]]:
    """Read the columns of a file of finite numbers, with its header and the columns' names.

    Leading lines that are blank, start with # or hold letters are skipped. If one of them holds the
    names of an event's columns, it gives their order; otherwise the layout does.
    """
    names = layout.split()
    found = None
    skip = 0
    with reading(source), file.open("rb") as lines:
        while line := lines.readline().removeprefix(BOM_UTF8):
            words = _split_words(line)
            if header is not None and len(words) == len(names) and find_fields(words):
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


def _split_words(line: bytes) -> list[str]:
    """Split a line or comment into words; a unit in brackets stays with its name, as in "t [s]"."""
    text = line.decode("utf-8", "replace").lstrip("#% ")
    return re.sub(r"\s+(?=[\[(])", "", text).split()


def _are_names(words: list[str]) -> bool:
    """Return whether words can be names of columns: none begins like a number."""
    return bool(words) and not any(re.match(r"[+-]?\.?\d|nan|inf", w, re.I) for w in words)


def _read_images(
    path: Path, root: Path | zipfile.Path
) -> tuple[NDArray, str | None, Any, dict[str, Any]]:
    """Read the frames' stored times, the unit that their header names, the images and extras."""

    if not (root / "images.txt").is_file():
        return np.empty(0), None, None, {}
    source = f"{path}: images.txt"
    with reading(source):
        lines = (root / "images.txt").read_text(encoding="utf-8-sig").splitlines()
    stamps, names, unit = [], [], None
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(maxsplit=1)
        if not stamps and _are_names(fields) and is_time(fields[0]):
            unit = unit_of_name(fields[0])
            continue
        try:
            stamps.append(float(fields[0]))
            names.append(fields[1].strip())
        except (ValueError, IndexError):
            raise InputError(
                f"{source}: line {number} is {line[:60]!r}; each line must be 't path'"
            ) from None

    def decode(row: int) -> Iterator[NDArray]:
        unfolded, seen, stored = 0, set(), 0 if path.is_dir() else path.stat().st_size
        for name in names[row:]:
            image = _read_image(path, root, name)
            if path.is_dir() and name not in seen:
                seen.add(name)
                stored += (path / name).stat().st_size
            unfolded += image.nbytes
            check_unfolded(unfolded, stored, source)
            yield image

    images, extra = gather_frames(
        decode(0), decode, lambda n: f"{path}: {names[n]}", source, in_memory=True
    )
    return np.array(stamps), unit, images, extra


def _read_image(path: Path, root: Path | zipfile.Path, name: str) -> NDArray:
    if name.startswith(("/", "\\")) or ".." in re.split(r"[/\\]", name):
        raise InputError(f"{path}: images.txt names {name}, outside the recording; copy it inside")
    file = root / name
    if not file.is_file():
        raise InputError(
            f"{path}: images.txt names {name}, which does not exist; add the image or remove "
            "its line"
        )
    with reading(f"{path}: {name}"), file.open("rb") as stream:
        return drop_alpha(read_image(stream, f"{path}: {name}"))
