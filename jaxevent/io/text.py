"""The text layout of the Event-Camera Dataset (Mueggler et al., IJRR 2017), in a folder or zip.

    events.txt       t x y p                  p is 0/1 or -1/1; a first line may be: width height
    images.txt       t path                   path relative to the folder
    groundtruth.txt  t px py pz qx qy qz qw   m, unit quaternion
    imu.txt          t ax ay az gx gy gz      m/s^2, rad/s
    calib.txt        fx fy cx cy k1 k2 p1 p2 k3

All t are seconds; events.txt with whole numbers only, which would be microseconds or worse, is
refused. Only events.txt is required, and it may be empty where there are images. In a
zip the files may lie in one top folder. The exposure of the images is unknown: 0. Colour images
become grey (ITU-R 601 luma); where all are, `extra["rgb"]` keeps their colours.
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

from jaxevent.errors import InputError
from jaxevent.io import check_unfolded, pinhole, reading, sensor_size, times
from jaxevent.io.decoded import from_columns
from jaxevent.io.images import kept_colours, read_grey_and_colour
from jaxevent.io.options import ReadOptions
from jaxevent.progress import bar
from jaxevent.recording import Frames, Imu, Poses, Recording


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a folder or zip. Raises `InputError` for bad input."""
    if path.is_dir():
        return _read(path, path, options)
    with reading(str(path)), zipfile.ZipFile(path) as archive:
        inside = [
            name
            for name in archive.namelist()
            if name.count("/") <= 1 and name.rpartition("/")[2] == "events.txt"
        ]
        if len(inside) != 1:
            raise InputError(
                f"{path}: holds {len(inside)} events.txt at its top or in a top folder; "
                "make a zip of one recording"
            )
        root = zipfile.Path(archive, inside[0].removesuffix("events.txt"))
        return _read(path, root, options)


def _read(path: Path, root: Path | zipfile.Path, options: ReadOptions) -> Recording:
    source = f"{path}: events.txt"
    frames, colours = _frames(path, root)
    columns, header = _table(
        root / "events.txt", source, "t x y p", header="width height", progress=options.progress
    )
    otherwise = (
        f"{source}: neither a first line 'width height' nor an image tells the sensor's size;"
    )
    size = sensor_size(options.size, header, frames=frames, otherwise=otherwise)
    t, x, y, p = columns
    if len(t) > 1 and (t == np.rint(t)).all() and t[0] != t[-1]:
        raise InputError(
            f"{source}: all times are whole numbers, but those of this layout are seconds; write "
            "seconds with decimals, or load a table with the line 't x y p' before events in us"
        )
    columns = times(t, source, "event"), x, y, p
    events = from_columns(columns, size, source, options)

    poses = imu = camera = None
    if (root / "groundtruth.txt").is_file():
        source = f"{path}: groundtruth.txt"
        (t, *pose), _ = _table(root / "groundtruth.txt", source, "t px py pz qx qy qz qw")
        pose = np.stack(pose, axis=1)
        poses = Poses(times(t, source, "pose"), pose[:, :3], pose[:, 3:])
    if (root / "imu.txt").is_file():
        source = f"{path}: imu.txt"
        (t, *sample), _ = _table(root / "imu.txt", source, "t ax ay az gx gy gz")
        sample = np.stack(sample, axis=1)
        imu = Imu(times(t, source, "IMU sample"), gyro=sample[:, 3:], acc=sample[:, :3])
    if (root / "calib.txt").is_file():
        source = f"{path}: calib.txt"
        values, _ = _table(root / "calib.txt", source, "fx fy cx cy k1 k2 p1 p2 k3")
        camera = pinhole(np.concatenate(values), source)
    return Recording(path.stem, *size, events, frames, camera, poses, imu, colours)


def _table(
    file: Path | zipfile.Path,
    source: str,
    layout: str,
    header: str | None = None,
    progress: bool | None = None,
) -> tuple[list[NDArray[np.float64]], tuple[int, int] | None]:
    """The columns of a file of numbers, finite float64, and its first line if that is a header.

    Lines before the numbers that are blank or start with # are passed over.
    """
    names = layout.split()
    found = None
    skip = 0
    with reading(source), file.open("rb") as lines:
        while (line := lines.readline().removeprefix(BOM_UTF8)) and (
            not line.strip() or line.startswith(b"#")
        ):
            skip += 1
        if header is not None and len(fields := line.split()) == len(header.split()):
            if not all(field.isdigit() and int(field) for field in fields):
                raise InputError(
                    f"{source}: line {skip + 1} has {len(fields)} fields but is not '{header}'; "
                    f"each line must be '{layout}'"
                )
            found = (int(fields[0]), int(fields[1]))
            skip += 1
            line = lines.readline()
        if not line.strip() and not lines.read().strip():
            return [np.empty(0) for _ in names], found
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
    return columns, found


def _frames(
    path: Path, root: Path | zipfile.Path
) -> tuple[Frames | None, dict[str, NDArray[np.uint8]]]:
    """The frames, and the colours of coloured ones as `extra` keeps them."""
    if not (root / "images.txt").is_file():
        return None, {}
    source = f"{path}: images.txt"
    with reading(source):
        lines = (root / "images.txt").read_text(encoding="utf-8-sig").splitlines()
    stamps, images, colours, unfolded = [], [], [], 0
    seen, stored = set(), 0 if path.is_dir() else path.stat().st_size
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split(maxsplit=1)
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
        return None, {}
    t = times(np.array(stamps), source, "image")
    return Frames(t, np.stack(images), np.zeros_like(t)), kept_colours(colours)


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
