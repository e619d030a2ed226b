"""Recordings as HDF5 in other layouts than jaxevent's own, told by the names inside.

    event_utils (ECD as HDF5)   /events/{ts, xs, ys, ps}: ts in s; /images/image000000000 and on,
                                each with its time, attribute timestamp; sensor_resolution (H, W)
    MVSEC                       /davis/{left, right}/events (N, 4): x, y, t in s, p -1/1;
                                image_raw (frames, H, W), image_raw_ts in s, imu (N, 6): 3 of
                                acceleration, 3 of angular velocity, imu_ts in s
    M3ED                        /prophesee/{left, right}/{t, x, y, p}: t in us; ms_map_idx;
                                calib/{intrinsics (fx fy cx cy), distortion_coeffs, resolution}
    Metavision                  /CD/events, records with fields t, x, y, p, also compressed by ECF
                                (`ecf`); attribute geometry; /EXT_TRIGGER/events, records t, p, id
    v2e                         /events, or the only dataset, (N, 4) or (4, N): t in us, x, y, p;
                                the order is told by the content; 4294967295 is a polarity of -1;
                                /frame (frames, H, W) uint8, /frame_ts in us, /frame_idx, the
                                number of events before each frame, which is not needed
    others                      /events or the file itself with t, x, y and p, whole lists or
                                records, under the names that `jaxevent.arrays.NAMES` lists

Integers are usually us, floats seconds (`time_units`). Exposures are unknown: 0. Where a file holds
two cameras, left or right must be chosen. M3ED's frames come from cameras beside the event camera,
with pixels of their own, and are not read. Poses come from further files beside these, see `truth`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import (
    calibrated,
    check_unfolded,
    ecf,
    reading,
    refuse_stream,
    refuse_time_unit,
    sensor_size,
    times,
    vectors,
    whole_number,
)
from jaxevent.io.columns import find, order_of
from jaxevent.io.decoded import DecodedImages
from jaxevent.io.hdf5 import (
    Column,
    StoredEvents,
    StoredImages,
    clock_of_columns,
    convert_columns,
    read_stored,
)
from jaxevent.io.hdf5_files import array, attribute, dataset, describe_images, filters_of
from jaxevent.io.images import grey_of_bgr
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import SAMPLE, InferredUnit
from jaxevent.io.truth import read_poses
from jaxevent.recording import Frames, Imu, Recording, Triggers

_GROUPS = ("events", "", "CD/events")
_SIDES = {"prophesee": "M3ED", "davis": "MVSEC"}


def knows(file: Any) -> bool:
    """Whether a file holds events in one of these layouts."""
    if any(isinstance(file.get(name), h5py.Group) for name in _SIDES):
        return True
    if _plain_name(file) is not None:
        return True
    return any(_fields(file, name) is not None for name in _GROUPS)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input.

    Unless `options.in_memory`, events and images stay in it. `options.stream` is "left" or "right"
    of a file with two cameras.
    """
    return read_stored(path, options, _recording)


def _recording(file: Any, path: Path, options: ReadOptions) -> Recording:
    source, size, stream = str(path), options.size, options.stream
    for name in _SIDES:
        group = file.get(name)
        if isinstance(group, h5py.Group):
            side = _side(path, group, stream)
            read = _m3ed if name == "prophesee" else _mvsec
            return read(file, path, options, f"{name}/{side}")
    refuse_stream(path, options)
    columns: dict[str, Column] = {}
    name, name_of_t = "", "t"
    plain = _plain_name(file)
    if plain is None:
        with reading(source):
            name = next(name for name in _GROUPS if _fields(file, name) is not None)
        name_of_t = (_fields(file, name) or {})["t"]
        columns = _columns(file, name, source)
    images = _images(file, source) if isinstance(file.get("images"), h5py.Group) else None
    if isinstance(file.get("frame"), h5py.Dataset):
        images = _images_of_v2e(file, source)
    told = _told_size(file, source) if size is None else None
    if told is None and images is not None:
        told = (images[1].shape[2], images[1].shape[1])
    otherwise = f"{path}: neither an attribute nor an image tells the sensor's size;"
    size = sensor_size(size, told, frames=None, otherwise=otherwise)
    columns = columns if plain is None else _plain_columns(file, plain, size, source)
    unit = InferredUnit("us")
    if name == "CD/events":
        refuse_time_unit(path, options)
    else:
        columns, unit = convert_columns(columns, size, source, options, name=name_of_t)
    notes, frames = list(unit.notes), None
    if images is not None:
        clock = clock_of_columns(columns, unit, source)
        t = clock.read(images[0], source, "image", notes)
        frames = Frames(t, images[1], np.zeros_like(t))
    stored = StoredEvents(columns, size, source).repaired(options)
    return Recording(
        path.stem,
        *size,
        stored,
        frames,
        triggers=_triggers(file, source),
        notes=tuple(notes),
        left_out=describe_images(file) if frames is None else {},
    )


def _triggers(file: Any, source: str) -> Triggers | None:
    """The external triggers of Metavision."""
    name = "EXT_TRIGGER/events"
    found = file.get(name)
    if not isinstance(found, h5py.Dataset) or not {"t", "p", "id"} <= set(found.dtype.names or ()):
        return None
    whole = array(file, name, source)
    if not len(whole):
        return None
    t = times(whole["t"], f"{source}: {name}", "row")
    return Triggers(t, whole["p"].astype(np.int8), whole["id"].astype(np.uint8))


def _plain_name(file: Any) -> str | None:
    """The name of four columns without names: `events`, or whatever stands alone in a file.

    None where there are none. (MATLAB's files have a header before HDF5.)
    """
    names = ["events"] if "events" in file else list(file)[:2]
    found = file.get(names[0]) if len(names) == 1 else None
    if not isinstance(found, h5py.Dataset) or file.userblock_size or found.dtype.kind not in "iuf":
        return None
    # Of a virtual dataset the shape cannot be asked for without following it.
    is_virtual = found.id.get_create_plist().get_layout() == h5py.h5d.VIRTUAL
    return names[0] if is_virtual or found.ndim == 2 and 4 in found.shape else None


def _plain_columns(file: Any, name: str, size: tuple[int, int], source: str) -> dict[str, Column]:
    whole = dataset(file, name, source)
    is_wide = whole.shape[1] != 4  # (4, events)
    first = np.asarray(whole[:, :SAMPLE].T if is_wide else whole[:SAMPLE])
    order = order_of(first, size, source)
    part = _Row if is_wide else _Part
    return {name: part(whole, order.index(name)) for name in "txyp"}


def _side(path: Path, group: Any, stream: str | None) -> str:
    sides = [name for name in ("left", "right") if isinstance(group.get(name), h5py.Group)]
    if stream is None and len(sides) == 1:
        return sides[0]
    if stream is None and sides:
        raise InputError(
            f"{path}: holds the events of two cameras, left and right; choose one with stream=, or "
            "with jaxevent convert --stream"
        )
    if stream not in sides:
        raise InputError(
            f"{path}: has no camera {stream or 'left'!r}; its cameras are "
            f"{', '.join(sides) or 'none'}"
        )
    return str(stream)


def _m3ed(file: Any, path: Path, options: ReadOptions, group: str) -> Recording:
    source, size = str(path), options.size
    refuse_time_unit(path, options)
    columns = _columns(file, group, source)
    camera, left_out = None, {}
    if f"{group}/calib/intrinsics" in file:
        with reading(f"{source}: {group}/calib"):
            if f"{group}/calib/resolution" in file and size is None:
                size = _pair(array(file, f"{group}/calib/resolution", source), source)
            camera, left_out = _camera(file, f"{group}/calib", source)
    if size is None:
        raise InputError(
            f"{path}: {group}/calib has no resolution; give size=(width, height) or --size"
        )
    table = None
    if f"{group}/ms_map_idx" in file:
        table = dataset(file, f"{group}/ms_map_idx", source)
    events = StoredEvents(columns, size, source, 0, table).repaired(options)
    poses = read_poses(path, group)
    left_out |= describe_images(file)
    return Recording(path.stem, *size, events, camera=camera, poses=poses, left_out=left_out)


def _camera(file: Any, group: str, source: str) -> tuple[PinholeCamera | None, dict[str, str]]:
    k, model = np.zeros(0), "radtan"
    if f"{group}/distortion_coeffs" in file:
        k = array(file, f"{group}/distortion_coeffs", source)
    if f"{group}/distortion_model" in file:
        text = array(file, f"{group}/distortion_model", source).item()
        model = text.decode() if isinstance(text, bytes) else str(text)
    intrinsics = array(file, f"{group}/intrinsics", source)
    return calibrated(intrinsics, model, k, f"{source}: {group}")


class _Part:
    """A column of (N, 4), or a field of records, as a list of its own."""

    def __init__(self, whole: Any, key: int | str):
        self._whole, self._key = whole, key
        self.shape: tuple[int, ...] = whole.shape[:1]
        self.dtype: np.dtype = whole.dtype if isinstance(key, int) else whole.dtype[key]

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(self._key, int):
            return self._whole[rows, self._key]
        return self._whole.fields(self._key)[rows]


class _Row:
    """A row of (4, N) as a list of its own."""

    def __init__(self, whole: Any, row: int):
        self._whole, self._row = whole, row
        self.shape: tuple[int, ...] = whole.shape[1:]
        self.dtype: np.dtype = whole.dtype

    def __getitem__(self, columns: Any) -> Any:
        return self._whole[self._row, columns]


def _mvsec(file: Any, path: Path, options: ReadOptions, group: str) -> Recording:
    source, size = str(path), options.size
    whole = dataset(file, f"{group}/events", source)
    if whole.ndim != 2 or whole.shape[1] != 4:
        raise InputError(
            f"{source}: {group}/events has shape {whole.shape}; store (events, 4): x, y, t, p"
        )
    x, y, t, p = (_Part(whole, column) for column in range(4))
    columns: dict[str, Column] = {"t": t, "x": x, "y": y, "p": p}
    frames = imu = images = told = None
    if f"{group}/image_raw" in file:
        images = dataset(file, f"{group}/image_raw", source)
        if images.ndim != 3:
            raise InputError(f"{source}: {group}/image_raw has shape {images.shape}; store 3 axes")
        told = (images.shape[2], images.shape[1]) if len(images) else None
    otherwise = f"{path}: has no {group}/image_raw to tell the sensor's size;"
    size = sensor_size(size, told, frames=None, otherwise=otherwise)
    columns, unit = convert_columns(columns, size, source, options, usual="s")
    notes, clock = list(unit.notes), clock_of_columns(columns, unit, source)
    if images is not None:
        stamps = array(file, f"{group}/image_raw_ts", source)
        stamps = clock.read(stamps, f"{source}: {group}/image_raw_ts", "image", notes)
        if len(stamps):
            frames = Frames(stamps, StoredImages(images, source), np.zeros_like(stamps))
    if f"{group}/imu" in file:
        stamps = array(file, f"{group}/imu_ts", source)
        stamps = clock.read(stamps, f"{source}: {group}/imu_ts", "IMU sample", notes)
        name = f"{group}/imu"
        values = vectors(array(file, name, source), (len(stamps), 6), source, name)
        imu = Imu(stamps, values[:, 3:], values[:, :3])
    events = StoredEvents(columns, size, source).repaired(options)
    poses = read_poses(path, group)
    return Recording(path.stem, *size, events, frames, poses=poses, imu=imu, notes=tuple(notes))


def _fields(file: Any, name: str) -> Mapping[str, str] | None:
    """The names under which a group or records hold t, x, y and p; None where they do not."""
    found = file.get(name) if name else file
    if isinstance(found, h5py.Group):
        return find(list(found))
    if isinstance(found, h5py.Dataset) and found.dtype.names:
        return find(found.dtype.names)
    return None


def _columns(file: Any, name: str, source: str) -> dict[str, Column]:
    found = file.get(name) if name else file
    fields = _fields(file, name)
    if fields is None:
        raise InputError(f"{source}: {name} has no t, x, y and p; add them")
    columns: dict[str, Column]
    if isinstance(found, h5py.Dataset):
        whole: Any = dataset(file, name, source, undone=[ecf.FILTER])
        if filters_of(whole) == [ecf.FILTER]:
            whole = ecf.Records(whole, f"{source}: {name}")
        columns = {key: _Part(whole, fields[key]) for key in "txyp"}
    else:
        columns = {key: dataset(file, f"{name}/{fields[key]}", source) for key in "txyp"}
    return columns


def _told_size(file: Any, source: str) -> tuple[int, int] | None:
    with reading(f"{source}: attributes"):
        if (size := attribute(file, "sensor_resolution")) is not None:
            if np.size(size) == 3:  # height, width, channels
                size = np.ravel(size)[:2]
            height, width = _pair(size, source)
            return width, height
        if (text := attribute(file, "geometry")) is not None:
            width, _, height = str(text).partition("x")
            return int(width), int(height)
        width, height = (attribute(file, name) for name in ("width", "height"))
        if width is not None and height is not None:
            return _pair([width, height], source)
    return None


def _pair(values: Any, source: str) -> tuple[int, int]:
    if np.size(values) != 2:
        raise InputError(
            f"{source}: the sensor's size is {np.size(values)} numbers; store two, or give "
            "size=(width, height) or --size"
        )
    first, second = (whole_number(n, source, "a side of the size") for n in np.ravel(values))
    return first, second


def _images_of_v2e(file: Any, source: str) -> tuple[NDArray, StoredImages] | None:
    """The times and images of the frames that v2e keeps beside its events; None without times."""
    stored = dataset(file, "frame", source)
    if stored.ndim != 3 or not isinstance(file.get("frame_ts"), h5py.Dataset):
        return None
    stamps = array(file, "frame_ts", source)
    if len(stamps) != len(stored):
        raise InputError(
            f"{source}: frame holds {len(stored)} images, frame_ts {len(stamps)} times; there must "
            "be one time for each image"
        )
    return (stamps, StoredImages(stored, f"{source}: frame")) if len(stamps) else None


def _images(file: Any, source: str) -> tuple[NDArray, DecodedImages] | None:
    """The times and images of event_utils, one dataset each, in the order of their names."""
    with reading(f"{source}: images"):
        names = sorted(file["images"])
        if not names:
            return None
        stamps = np.array([attribute(file["images"][name], "timestamp") for name in names])
    first = dataset(file, f"images/{names[0]}", source)
    if first.ndim not in (2, 3):
        raise InputError(f"{source}: images/{names[0]} has shape {first.shape}; store grey images")
    held = len(names) * (first.size or 0) * first.dtype.itemsize
    check_unfolded(held, file.id.get_filesize(), f"{source}: images")

    def image(name: str) -> NDArray:
        pixels = array(file, f"images/{name}", source)
        if pixels.ndim == 2:
            return pixels
        return grey_of_bgr(pixels)  # as event_utils stores them with OpenCV

    images = DecodedImages(
        lambda row: (image(name) for name in names[row:]),
        (len(names), first.shape[0], first.shape[1]),
        first.dtype,
        f"{source}: images",
    )
    return stamps, images
