"""Folders of NumPy files and images: the layouts of EVIMO2, EVREAL and TimeLens.

EVIMO2 (Burner et al. 2022), a folder for each camera and sequence:

    dataset_events_t.npy   (events,) or (events, 1)  float seconds, sorted
    dataset_events_xy.npy  (events, 2)               x and y
    dataset_events_p.npy   (events,) or (events, 1)  0/1
    dataset_info.npz       K (3, 3), D (4,), index, discretization, and meta, a pickled dictionary
    dataset_classical.npz  classical_0000000000 and on, (height, width) or in colour
    dataset_depth.npz      depth_0000000000 and on, (height, width) in mm
    dataset_mask.npz       mask_0000000000 and on, (height, width), number of the object times 1000

The layout is that of the project better-flow/evimo, docs_sphinx/source/ground-truth-format.md,
"NPZ (EVIMO2v2)". The sensor's size is that of masks or depths.

Times of images, poses, the model of distortion and IMU samples are in `meta` alone. A pickle can
run any program when it is read, so `load` leaves it out, names it in `extra["arrays_left_out"]`,
and leaves out these parts with it. K and D are kept in `extra`, and make no calibration: D is k1 k2
k3 k4 whatever the model is, without p1 and p2. If you trust the file, read the pickle yourself and
give what is in it:

    with numpy.load(folder / "dataset_info.npz", allow_pickle=True) as info:
        recording = jaxevent.io.folders.read_evimo(folder, meta=info["meta"].item())

Polarities are as stored. The layout's description says that those of the Samsung camera
(samsung_mono) are inverted.

EVREAL (Ercan et al., CVPRW 2023), a folder for each sequence:

    events_ts.npy            (events,) or (events, 1)   float seconds, sorted
    events_xy.npy            (events, 2)                x and y
    events_p.npy             (events,) or (events, 1)   bool or 0/1
    images.npy               (frames, height, width, 1), or without the last axis
    images_ts.npy            (frames,) or (frames, 1)   float seconds
    image_event_indices.npy  events before each image; not needed
    metadata.json            {"sensor_resolution": [height, width]}

The layout is that of the project ercanburak/EVREAL, dataset.py and tools/bag_to_npy.py. Only the
events are required. Without metadata.json the sensor's size is that of the images. Images of three
channels are taken as blue, green, red, OpenCV's order.

TimeLens (Tulyakov et al., CVPR 2021), HS-ERGB and BS-ERGB:

    events/000000.npz ...    x, y, t or timestamp, p or polarity, each (events,): the events between
                             two images, in the order of the files' names
    images/000000.png ...    in the order of their names
    images/timestamp.txt     one time for each image

The folders may be named events_aligned and images_corrected. The layout is that of the projects
uzh-rpg/rpg_timelens, README and timelens/common, and of ercanburak/EVREAL, tools/bs_ergb_to_npy.py.
Times are whole microseconds in BS-ERGB; other units are inferred (`time_units`). The events of
HS-ERGB and BS-ERGB were remapped onto the images' pixels, and are stored in 1/32 pixel. Coordinates
are taken so where most events would lie outside the images otherwise. They are rounded to whole
pixels, as are coordinates with decimals, and events outside the images are left out; a note counts
them. Images beyond the last time are left out too, as the README of TimeLens requires.

Exposures are unknown: 0. Colours become grey (ITU-R 601 luma), and `extra["rgb"]` keeps them.

Decoder. NumPy's own files, read here; checked against files written by the layouts.
"""

import functools
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times, to_grey
from jaxevent.camera import LENS_MODELS, PinholeCamera, find_model
from jaxevent.errors import InputError
from jaxevent.io.checks import (
    ReadOptions,
    damaged,
    image_size,
    make_supported_camera,
    open_archive,
    reading,
    sensor_size,
    whole_number,
    whole_size,
)
from jaxevent.io.columns import ColumnFormat, Fields, find_fields, infer_format, read_columns
from jaxevent.io.decoded import Columns, DecodedImages, read_events
from jaxevent.io.images import IMAGE_SUFFIXES, read_files
from jaxevent.recording import Frames, Imu, Poses, Recording
from jaxevent.time_units import SAMPLE_EVENTS

_TIMELENS_FOLDERS = (("events", "images"), ("events_aligned", "images_corrected"))
_IMAGE_TIME_FILES = ("timestamp.txt", "timestamps.txt")
_SUBPIXEL_PARTS = 32  # parts of a pixel in which remapped coordinates count
_MIN_MISPLACED_SHARE = 0.5  # share of events outside the images that shows remapped coordinates


def find_reader(folder: Path) -> Callable[[Path, ReadOptions], Recording] | None:
    """Find the reader of a folder by the names of its files; None of another layout."""
    if (folder / "dataset_events_t.npy").is_file():
        return read_evimo
    if all((folder / f"events_{name}.npy").is_file() for name in ("ts", "xy", "p")):
        return read_evreal
    if any(_event_files(folder / name) for name, _ in _TIMELENS_FOLDERS):
        return read_timelens
    return None


class _Sequence(NamedTuple):
    """The events of a folder, left in their files.

    Attributes:
        fields: Columns t, x, y and p of a range of rows.
        count: Number of events.
        is_float: Whether times are stored as floats.
    """

    fields: Fields
    count: int
    is_float: bool


def _open_events(path: Path, prefix: str, name_of_t: str) -> _Sequence:
    """Open the arrays of events of EVIMO2 and EVREAL, or raise `InputError`."""
    opened: list[NDArray] = []
    for name, width in ((name_of_t, 1), ("xy", 2), ("p", 1)):
        file = path / f"{prefix}_{name}.npy"
        with reading(file):
            stored = np.load(file, mmap_mode="r", allow_pickle=False)
        if stored.shape not in ((len(stored), width), (len(stored),)[: 3 - width]):
            raise InputError(
                f"{file}: has shape {stored.shape}; it must be (events, {width}), one row per event"
            )
        opened.append(stored.reshape(len(stored), width))
    lengths = [len(one) for one in opened]
    if len(set(lengths)) != 1:
        raise InputError(
            f"{path}: t, xy and p have {lengths[0]}, {lengths[1]} and {lengths[2]} events; they "
            "must be equally long"
        )
    t, xy, p = opened

    def fields(rows: slice) -> dict[str, NDArray]:
        columns = zip("txyp", (t[:, 0], xy[:, 0], xy[:, 1], p[:, 0]), strict=True)
        return {name: np.array(column[rows]) for name, column in columns}

    return _Sequence(fields, len(t), t.dtype.kind == "f")


def _read_member(archive: zipfile.ZipFile, name: str, source: str) -> NDArray:
    """Read an array of numbers of an archive.

    Raises `InputError` for objects, and for a shape that the array's bytes cannot fill.
    """
    with archive.open(name) as stream:
        shape, dtype = _read_header(stream, f"{source}: {name}")
        if shape is None or dtype is None:
            raise InputError(f"{source}: {name} is pickled, which is not read; store numbers")
        if int(np.prod(shape, dtype=object)) * dtype.itemsize > archive.getinfo(name).file_size:
            raise damaged(f"{source}: {name} holds too few bytes")
    with archive.open(name) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _read_header(stream: Any, source: str) -> tuple[tuple[int, ...] | None, np.dtype | None]:
    """Read the header of NumPy's file of an array.

    Args:
        stream: File of NumPy (.npy), open for reading bytes at its start.
        source: Name of the file for messages.

    Returns:
        Shape and type of the numbers; both None if the array holds objects.
    """
    major, _ = np.lib.format.read_magic(stream)
    read_one = {
        1: np.lib.format.read_array_header_1_0,
        2: np.lib.format.read_array_header_2_0,
    }
    if major not in read_one:
        raise InputError(f"{source}: is an array of an unknown version; store it by numpy.save")
    shape, _, dtype = read_one[major](stream)
    return (None, None) if dtype.hasobject else (shape, dtype)


def read_evimo(
    path: Path,
    options: ReadOptions | None = None,
    meta: Mapping[str, Any] | None = None,
    imu: str | None = None,
) -> Recording:
    """Read a folder of EVIMO2.

    Args:
        path: The folder.
        options: Options of `jaxevent.io.load`.
        meta: The dictionary of dataset_info.npz. With it there are frames of the classical camera,
            the calibration, the poses of the camera in the world and, in `extra`, the ground truth:
            `depth` (n, height, width) in m, `mask`, and their times `depth_t` and `mask_t` (n,) in
            us. Depths and masks stay in their files until they are needed.
        imu: Name of one of the series of samples in `meta`.

    Returns:
        The recording.

    Raises:
        InputError: A file is missing, damaged or does not fit the others.
    """
    source = str(path)
    options = options or ReadOptions()
    options.refuse_time_unit(path)
    meta = {} if meta is None else meta
    parts = {name: _NumberedImages(path, name) for name in ("classical", "depth", "mask")}
    extra: dict[str, Any] = dict(_read_info(path))
    if "arrays_left_out" in extra and meta:
        del extra["arrays_left_out"]
    with reading(f"{source}: meta"):
        camera, stated, left_out = _camera(meta, source) if "meta" in meta else (None, None, {})
        poses = _poses(meta["full_trajectory"], source) if "full_trajectory" in meta else None
        samples = _imu(meta["imu"][imu], source) if imu is not None else None
        frames = None
        for name, part in parts.items():
            t, images = part.select(meta.get("frames", ()))
            if len(t) and name == "classical":
                images = np.asarray(images) if options.in_memory else images
                frames = Frames(t, images, np.zeros_like(t))
            elif len(t):
                extra |= {name: images, f"{name}_t": t}
    sizes = [part.shape[::-1] for part in parts.values() if part.shape is not None]
    size = sensor_size(f"{path}: no image shows the sensor's size", options.size, stated, *sizes)
    held = _open_events(path, "dataset_events", "t")
    unit = "s" if held.is_float else "us"
    found = read_columns(held.fields, held.count, size, source, options, unit=unit)
    if frames is None and parts["classical"].names:
        left_out["frames"] = (
            f"the times of the {len(parts['classical'].names):,} images in dataset_classical.npz "
            "are pickled in dataset_info.npz; if you trust it, give its meta to "
            "jaxevent.io.folders.read_evimo"
        )
    return Recording(
        path.name, *size, found.events, frames, camera, poses, samples, extra, left_out=left_out
    )


def _read_info(path: Path) -> Iterator[tuple[str, NDArray]]:
    """Yield the arrays K and D, and the name of what is pickled, which is left alone."""
    file = path / "dataset_info.npz"
    if not file.is_file():
        return
    with reading(file), open_archive(file) as archive:
        for name in ("K", "D"):
            if f"{name}.npy" in archive.namelist():
                values = _read_member(archive, f"{name}.npy", str(file))
                if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
                    raise InputError(f"{file}: {name} must be finite numbers; correct it")
                yield name, values
        if "meta.npy" in archive.namelist():
            yield "arrays_left_out", np.array(["meta"])


class _NumberedImages:
    """Images of one kind by number of their frame, in an archive that may lack or be empty."""

    def __init__(self, path: Path, kind: str):
        self.file, self.kind = path / f"dataset_{kind}.npz", kind
        self.shape: tuple[int, int] | None = None
        self.names: set[str] = set()
        if not self.file.is_file():
            return
        with reading(self.file), open_archive(self.file) as archive:
            self.names = {name for name in archive.namelist() if name.startswith(f"{kind}_")}
            if self.names:
                first = min(self.names)
                with archive.open(first) as stream:
                    shape, _ = _read_header(stream, f"{self.file}: {first}")
                if shape is None or len(shape) not in (2, 3):
                    raise InputError(f"{self.file}: {first} is no image (height, width)")
                self.shape = (shape[0], shape[1])

    def select(self, frames: Sequence[Mapping[str, Any]]) -> tuple[NDArray[np.int64], Any]:
        """Return the times (us) and images of those frames of `meta` that have an image."""
        held = [(frame["ts"], self._member_name(frame)) for frame in frames]
        held = [(stamp, name) for stamp, name in held if name in self.names]
        if not held or self.shape is None:
            return np.empty(0, np.int64), None
        t = times(np.array([stamp for stamp, _ in held], float), str(self.file), self.kind)
        names = [name for _, name in held]
        dtype = next(self._decode(names[:1])).dtype
        images = DecodedImages(
            lambda row: self._decode(names[row:]), (len(t), *self.shape), dtype, str(self.file)
        )
        return t, images

    def _member_name(self, frame: Mapping[str, Any]) -> str:
        return f"{self.kind}_{whole_number(frame['id'], str(self.file), 'id'):010d}.npy"

    def _decode(self, names: Sequence[str]) -> Iterator[NDArray]:
        with reading(self.file), open_archive(self.file) as archive:
            for name in names:
                image = _read_member(archive, name, str(self.file))
                if self.kind == "depth":
                    yield (image / 1000).astype(np.float32)
                elif image.ndim == 3:
                    yield to_grey(image[..., 2::-1])
                else:
                    yield image


def _camera(
    meta: Mapping[str, Any], source: str
) -> tuple[PinholeCamera | None, tuple[int, int], dict[str, str]]:
    """Read the calibration and the size of the sensor.

    Args:
        meta: Content of EVIMO2's meta file.
        source: Name of the file for messages.

    Returns:
        The camera, None if its lens is unknown; (width, height), px; and the entry of
        `Recording.left_out`.
    """
    about = meta["meta"]
    model = str(about.get("dist_model"))
    lens = LENS_MODELS.get(find_model(model) or "")
    names = ("fx", "fy", "cx", "cy", *(lens.coefficients if lens else ()))
    values = np.array([float(about.get(name, 0.0)) for name in names])
    camera, left_out = make_supported_camera(values[:4], model, values[4:], f"{source}: meta")
    return camera, whole_size(about["res_x"], about["res_y"], source), left_out


def _vectors(rows: Sequence[Mapping[str, Any]], axes: str = "xyz") -> NDArray[np.float64]:
    return np.array([[row[axis] for axis in axes] for row in rows], float)


def _poses(trajectory: Sequence[Mapping[str, Any]], source: str) -> Poses | None:
    held = [(one["ts"], one["cam"]["pos"]) for one in trajectory if "cam" in one]
    if not held:
        return None
    stamps, poses = zip(*held, strict=True)
    t = times(np.array(stamps, float), source, "pose")
    return Poses(
        t, _vectors([one["t"] for one in poses]), _vectors([p["q"] for p in poses], "xyzw")
    )


def _imu(samples: Sequence[Mapping[str, Any]], source: str) -> Imu:
    t = times(np.array([one["ts"] for one in samples], float), source, "IMU sample")
    gyro, acc = (
        _vectors([one[name] for one in samples])
        for name in ("angular_velocity", "linear_acceleration")
    )
    return Imu(t, gyro, acc)


def read_evreal(path: Path, options: ReadOptions) -> Recording:
    """Read a folder of EVREAL.

    Args:
        path: The folder.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in their files.

    Raises:
        InputError: A file is missing, damaged or does not fit the others.
    """
    source = str(path)
    held = _open_events(path, "events", "ts")
    images, left_out = _open_images(path)
    otherwise = f"{path}: neither metadata.json nor an image shows the sensor's size"
    size = sensor_size(otherwise, options.size, _stated_size(path), image_size(images))
    usual = "s" if held.is_float else "us"
    found = read_columns(held.fields, held.count, size, source, options, usual=usual)
    notes, frames, extra = found.notes, None, {}
    if images is not None:
        with reading(path / "images_ts.npy"):
            stamps = np.load(path / "images_ts.npy", allow_pickle=False)
        if stamps.size != len(images) or stamps.ndim not in (1, 2):
            raise InputError(
                f"{path}: images.npy holds {len(images)} images, images_ts.npy times of shape "
                f"{stamps.shape}; there must be one time for each image"
            )
        t = found.clock.read(stamps.ravel(), source, "image", notes)
        grey, extra = _split_channels(images, source, notes)
        if len(t):
            if options.in_memory:
                grey, extra = np.asarray(grey), {n: np.asarray(one) for n, one in extra.items()}
            frames = Frames(t, grey, np.zeros_like(t))
        else:
            extra = {}
    return Recording(
        path.name, *size, found.events, frames, extra=extra, notes=tuple(notes), left_out=left_out
    )


def _stated_size(path: Path) -> tuple[int, int] | None:
    """Read (width, height) from metadata.json."""
    file = path / "metadata.json"
    if not file.is_file():
        return None
    with reading(file):
        metadata = json.loads(file.read_text(encoding="utf-8-sig"))
    sides = metadata.get("sensor_resolution") if isinstance(metadata, dict) else None
    if sides is None:
        return None
    if not isinstance(sides, list) or len(sides) not in (2, 3):  # the third counts channels
        raise InputError(f"{file}: sensor_resolution must be [height, width], not {sides}")
    return whole_size(sides[1], sides[0], file)


def _open_images(path: Path) -> tuple[NDArray | None, dict[str, str]]:
    """Open the images, left in their file, or explain why they are left out."""
    file = path / "images.npy"
    if not file.is_file():
        return None, {}
    if not (path / "images_ts.npy").is_file():
        return None, {"frames": "images.npy has no images_ts.npy with its times; add that"}
    with reading(file):
        images = np.load(file, mmap_mode="r", allow_pickle=False)
    if images.ndim not in (3, 4) or (images.ndim == 4 and images.shape[3] not in (1, 3)):
        raise InputError(
            f"{file}: has shape {images.shape}; it must be (frames, height, width), with one or "
            "three channels behind these"
        )
    return images, {}


def _split_channels(
    images: NDArray, source: str, notes: list[str]
) -> tuple[DecodedImages, dict[str, Any]]:
    """Split images into grey and colour, left in their file.

    Args:
        images: (n, H, W) or (n, H, W, 1 or 3), the latter blue, green, red.
        source: Name of the folder, for messages.
        notes: Notes of the reading, to which is added how colours are taken.

    Returns:
        Grey images (n, H, W), and colour images (n, H, W, 3), if any, by their name in `extra`.
    """

    def left(convert: Callable[[NDArray], NDArray], *channels: int) -> DecodedImages:
        return DecodedImages(
            lambda row: (convert(np.array(image)) for image in images[row:]),
            (*images.shape[:3], *channels),
            images.dtype,
            f"{source}: images.npy",
        )

    if images.ndim == 3:
        return left(lambda image: image), {}
    if images.shape[3] == 1:
        return left(lambda image: image[..., 0]), {}
    notes.append("images of three channels are taken as blue, green, red")
    has_colours = images.dtype == np.uint8
    rgb = {"rgb": left(lambda image: image[..., ::-1], 3)} if has_colours else {}
    return left(lambda image: to_grey(image[..., ::-1])), rgb


def read_timelens(path: Path, options: ReadOptions) -> Recording:
    """Read a folder of TimeLens.

    Args:
        path: The folder.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in their files.

    Raises:
        InputError: A file is missing, damaged or does not fit the others.
    """
    source = str(path)
    names = next(pair for pair in _TIMELENS_FOLDERS if _event_files(path / pair[0]))
    files, folder = _event_files(path / names[0]), path / names[1]
    notes: list[str] = []
    left_out: dict[str, str] = {}
    stamps, pictures = _find_images(folder, notes, left_out)
    images, extra = None, {}
    if pictures:
        images, extra = read_files(pictures, str(folder), options.in_memory)
    otherwise = f"{path}: no image in {names[1]} shows the sensor's size"
    size = sensor_size(otherwise, options.size, image_size(images))
    first, last = _first_and_last(files)
    grid = _PixelGrid(size, first[1], first[2])
    sample = {
        name: np.concatenate([first[k][:SAMPLE_EVENTS], last[k][-1:]])
        for k, name in enumerate("txyp")
    }
    count, usual = len(first[0]) * len(files), "us" if first[0].dtype.kind in "iu" else None
    found = infer_format(sample, count, size, source, options, usual=usual)
    notes += found.unit.notes
    decode = functools.partial(_decode_timelens, files, found, grid)
    events = read_events(decode, size, source, options)
    notes += grid.describe()
    frames = None
    if images is not None:
        t = [*events[:1].t, *events[max(len(events) - 1, 0) :].t] or [0]
        what = f"{path}: {folder.name}/{_stamps_of(folder)}"
        at = found.clock(int(t[0]), int(t[-1])).read(stamps, what, "image", notes)
        frames = Frames(at, images, np.zeros_like(at))
    return Recording(
        path.name, *size, events, frames, extra=extra, notes=tuple(notes), left_out=left_out
    )


def _event_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.npz")) if folder.is_dir() else []


def _stamps_of(folder: Path) -> str | None:
    return next((name for name in _IMAGE_TIME_FILES if (folder / name).is_file()), None)


def _find_images(
    folder: Path, notes: list[str], left_out: dict[str, str]
) -> tuple[NDArray, list[Path]]:
    """Find the times of the images, as stored, and their files; what is left out is named."""
    files = []
    if folder.is_dir():
        files = sorted(one for one in folder.iterdir() if one.suffix.lower() in IMAGE_SUFFIXES[:-1])
    name = _stamps_of(folder)
    if files and name is None:
        left_out["frames"] = (
            f"{folder} holds {len(files):,} images without their times; add "
            f"{_IMAGE_TIME_FILES[0]} with one time for each"
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
    with reading(file):
        words = file.read_text(encoding="utf-8-sig").split()
    for kind in (np.int64, np.float64):
        try:
            stamps = np.array(words, kind)
        except (ValueError, OverflowError):
            continue
        if np.isfinite(stamps).all():
            return stamps
    raise InputError(f"{file}: holds something else than times; give one number in each line")


class _PixelGrid:
    """The conversion of coordinates to whole pixels of the images.

    Attributes:
        parts: Number of parts of a pixel in which coordinates are stored, 1 or 32.
        is_remapped: Whether coordinates lie between pixels, and outside the images too.
        n_outside: Number of events outside the images, of the files that were converted.
    """

    def __init__(self, size: tuple[int, int], x: NDArray, y: NDArray):
        """Infer the unit of coordinates from some events.

        Args:
            size: (width, height), px.
            x: (events,) columns of some events as they are stored, px or parts of one.
            y: (events,) rows, likewise.
        """
        self._size = size
        outside = (x >= size[0]) | (y >= size[1]) | (x < 0) | (y < 0)
        is_fine = bool(len(x)) and float(outside.mean()) > _MIN_MISPLACED_SHARE
        self.parts = _SUBPIXEL_PARTS if is_fine else 1
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


def _read_columns(file: Path) -> Columns:
    """Read t, x, y and p of a file, as stored."""
    with reading(file), open_archive(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        fields = find_fields(names)
        if fields is None:
            raise InputError(
                f"{file}: holds {', '.join(names)[:80] or 'nothing'}; store x, y, timestamp and "
                "polarity"
            )
        t, x, y, p = (_read_member(archive, f"{fields[n]}.npy", str(file)).ravel() for n in "txyp")
    return t, x, y, p


def _first_and_last(files: Sequence[Path]) -> tuple[Columns, Columns]:
    """Read the first and the last file that hold events; the first and the last where none does."""
    first, last = (
        next((one for one in map(_read_columns, order) if len(one[0])), None)
        for order in (files, files[::-1])
    )
    return first or _read_columns(files[0]), last or _read_columns(files[-1])


def _decode_timelens(
    files: Sequence[Path], found: ColumnFormat, grid: _PixelGrid, state: int | None
) -> Iterator[tuple[int, Columns]]:
    row = 0
    for number in range(state or 0, len(files)):
        columns = dict(zip("txyp", _read_columns(files[number]), strict=True))
        converted = found.convert(columns, str(files[number]), row)
        row += len(converted[0])
        yield number, grid.convert(number, converted)
