"""Recordings as HDF5 in other layouts than jaxevent's own, recognised by the names inside.

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
                                the order is inferred; 4294967295 is a polarity of -1;
                                /frame (frames, H, W) uint8, /frame_ts in us, /frame_idx, the
                                number of events before each frame, which is not needed
    others                      /events or the file itself with t, x, y and p, whole lists or
                                records, under the names that `jaxevent.arrays.FIELD_ALIASES` lists

Integers are usually us, floats seconds (`time_units`). Exposures are unknown: 0. Where a file holds
two cameras, left or right must be chosen. M3ED's frames come from cameras beside the event camera,
with pixels of their own, and are not read. Poses come from further files beside these, see `truth`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times, to_grey
from jaxevent.errors import InputError
from jaxevent.io import ecf
from jaxevent.io.checks import (
    ReadOptions,
    check_unfolded,
    image_size,
    make_supported_camera,
    reading,
    sensor_size,
    whole_size,
)
from jaxevent.io.columns import MICROSECOND_FORMAT, find_fields, order_of
from jaxevent.io.decoded import DecodedImages
from jaxevent.io.hdf5 import Column, StoredEvents, StoredImages, infer_column_format, read_by
from jaxevent.io.hdf5_files import array, attribute, dataset, describe_images, filter_ids
from jaxevent.io.truth import read_poses
from jaxevent.recording import Frames, Imu, Recording, Triggers
from jaxevent.time_units import SAMPLE_EVENTS

_EVENT_GROUPS = ("events", "", "CD/events")
_STEREO_GROUPS = ("prophesee", "davis")  # groups of the cameras of M3ED and MVSEC


def is_known(file: Any) -> bool:
    """Return whether an open file holds events in one of these layouts."""
    if any(isinstance(file.get(name), h5py.Group) for name in _STEREO_GROUPS):
        return True
    if _name_of_plain_columns(file) is not None:
        return True
    return any(_fields(file, name) is not None for name in _EVENT_GROUPS)


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file of another layout than jaxevent's own.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`; `stream` is "left" or "right" of a file with two
            cameras.

    Returns:
        The recording; unless `options.in_memory`, events and images stay in the file.

    Raises:
        InputError: The file is damaged, or what it holds is not valid.
    """
    return read_by(_read_open, path, options)


def _read_open(file: Any, path: Path, options: ReadOptions) -> Recording:
    source = str(path)
    for name in _STEREO_GROUPS:
        group = file.get(name)
        if isinstance(group, h5py.Group):
            sides = [side for side in ("left", "right") if isinstance(group.get(side), h5py.Group)]
            side = options.choose_stream(path, "camera", sides)
            if side is None:
                raise InputError(f"{path}: has no camera 'left'; its cameras are none")
            read_side = _read_m3ed if name == "prophesee" else _read_mvsec
            return read_side(file, path, options, f"{name}/{side}")
    options.refuse_stream(path)
    columns: dict[str, Column] = {}
    name, name_of_t = "", "t"
    plain = _name_of_plain_columns(file)
    if plain is None:
        with reading(source):
            name = next(name for name in _EVENT_GROUPS if _fields(file, name) is not None)
        name_of_t = (_fields(file, name) or {})["t"]
        columns = _open_columns(file, name, source)
    stamps, images = None, None
    if isinstance(file.get("images"), h5py.Group):
        stamps, images = _open_numbered_images(file, source)
    if isinstance(file.get("frame"), h5py.Dataset):
        stamps, images = _open_images_of_v2e(file, source)
    otherwise = f"{path}: neither an attribute nor an image shows the sensor's size"
    stated = _stated_size(file, source) if options.size is None else None
    size = sensor_size(otherwise, options.size, stated, image_size(images))
    columns = columns if plain is None else _split_plain_columns(file, plain, size, source)
    found = MICROSECOND_FORMAT
    if name == "CD/events":
        options.refuse_time_unit(path)
    else:
        found = infer_column_format(columns, size, source, options, name=name_of_t)
    events = StoredEvents(columns, size, source, found)
    notes, frames = list(found.unit.notes), None
    if images is not None and stamps is not None:
        t = events.clock().read(stamps, source, "image", notes)
        frames = Frames(t, images, np.zeros_like(t))
    return Recording(
        path.stem,
        *size,
        events.repaired(options),
        frames,
        triggers=_read_triggers(file, source),
        notes=tuple(notes),
        left_out=describe_images(file) if frames is None else {},
    )


def _read_triggers(file: Any, source: str) -> Triggers | None:
    """Read the external triggers of Metavision.

    Args:
        file: The file, of h5py.
        source: Name of the file for messages.

    Returns:
        The triggers; None if there are none.
    """
    name = "EXT_TRIGGER/events"
    found = file.get(name)
    if not isinstance(found, h5py.Dataset) or not {"t", "p", "id"} <= set(found.dtype.names or ()):
        return None
    whole = array(file, name, source)
    if not len(whole):
        return None
    t = times(whole["t"], f"{source}: {name}", "row")
    return Triggers(t, whole["p"].astype(np.int8), whole["id"].astype(np.uint8))


def _name_of_plain_columns(file: Any) -> str | None:
    """Find four columns without names: `events`, or the only dataset of a file.

    None where there are none. (MATLAB's files have a header before HDF5.)
    """
    names = ["events"] if "events" in file else list(file)[:2]
    found = file.get(names[0]) if len(names) == 1 else None
    if not isinstance(found, h5py.Dataset) or file.userblock_size or found.dtype.kind not in "iuf":
        return None
    # Of a virtual dataset the shape cannot be read without following it.
    is_virtual = found.id.get_create_plist().get_layout() == h5py.h5d.VIRTUAL
    return names[0] if is_virtual or found.ndim == 2 and 4 in found.shape else None


class _Part:
    """A column or row of a dataset of two axes, or a field of records, as a list of its own."""

    def __init__(self, count: int, dtype: np.dtype, read: Callable[[Any], NDArray]):
        self.shape, self.dtype, self._read = (count,), dtype, read

    def __getitem__(self, rows: Any) -> NDArray:
        return self._read(rows)


def _split_plain_columns(
    file: Any, name: str, size: tuple[int, int], source: str
) -> dict[str, Column]:
    whole = dataset(file, name, source)
    if whole.shape[1] == 4:
        order = order_of(np.asarray(whole[:SAMPLE_EVENTS]), size, source)
        return _split_columns(whole, order)
    order = order_of(np.asarray(whole[:, :SAMPLE_EVENTS].T), size, source)  # (4, events)
    return {
        key: _Part(whole.shape[1], whole.dtype, lambda rows, row=row: whole[row, rows])
        for row, key in enumerate(order)
    }


def _split_columns(whole: h5py.Dataset, order: str) -> dict[str, Column]:
    """Return the columns t, x, y and p of a dataset (events, 4)."""
    return {
        key: _Part(len(whole), whole.dtype, lambda rows, column=column: whole[rows, column])
        for column, key in enumerate(order)
    }


def _read_m3ed(file: Any, path: Path, options: ReadOptions, group: str) -> Recording:
    source, size = str(path), options.size
    options.refuse_time_unit(path)
    columns = _open_columns(file, group, source)
    camera, left_out, calib = None, {}, f"{group}/calib"
    if f"{calib}/intrinsics" in file:
        with reading(f"{source}: {calib}"):
            names = ("intrinsics", "resolution", "distortion_model", "distortion_coeffs")
            names = [name for name in names if f"{calib}/{name}" in file]
            held = {name: array(file, f"{calib}/{name}", source) for name in names}
            if "resolution" in held and size is None:
                size = _check_size(held["resolution"], source)
            model = held.get("distortion_model", np.array("radtan")).item()
            camera, left_out = make_supported_camera(
                held["intrinsics"],
                model.decode() if isinstance(model, bytes) else str(model),
                held.get("distortion_coeffs", np.zeros(0)),
                f"{source}: {calib}",
            )
    size = sensor_size(f"{path}: {calib} has no resolution", size)
    table = dataset(file, f"{group}/ms_map_idx", source) if f"{group}/ms_map_idx" in file else None
    events = StoredEvents(columns, size, source, ms_to_idx=table).repaired(options)
    left_out |= describe_images(file)
    poses = read_poses(path, group)
    return Recording(path.stem, *size, events, camera=camera, poses=poses, left_out=left_out)


def _read_mvsec(file: Any, path: Path, options: ReadOptions, group: str) -> Recording:
    source = str(path)
    whole = dataset(file, f"{group}/events", source)
    if whole.ndim != 2 or whole.shape[1] != 4:
        raise InputError(
            f"{source}: {group}/events has shape {whole.shape}; store (events, 4): x, y, t, p"
        )
    columns = _split_columns(whole, "xytp")
    images = None
    if f"{group}/image_raw" in file:
        images = dataset(file, f"{group}/image_raw", source)
        if images.ndim != 3:
            raise InputError(f"{source}: {group}/image_raw has shape {images.shape}; store 3 axes")
        images = StoredImages(images, source) if len(images) else None
    otherwise = f"{path}: has no {group}/image_raw to show the sensor's size"
    size = sensor_size(otherwise, options.size, image_size(images))
    found = infer_column_format(columns, size, source, options, usual="s")
    events = StoredEvents(columns, size, source, found)
    notes = list(found.unit.notes)

    def stored_times(name: str, what: str) -> NDArray[np.int64]:
        name = f"{group}/{name}"
        return events.clock().read(array(file, name, source), f"{source}: {name}", what, notes)

    frames = imu = None
    if images is not None:
        t = stored_times("image_raw_ts", "image")
        frames = Frames(t, images, np.zeros_like(t))
    if f"{group}/imu" in file:
        t, values = stored_times("imu_ts", "IMU sample"), array(file, f"{group}/imu", source)
        if values.shape != (len(t), 6):
            raise InputError(
                f"{source}: {group}/imu has shape {values.shape}; it must be ({len(t)}, 6), one "
                "row for each time"
            )
        imu = Imu(t, values[:, 3:], values[:, :3])
    poses = read_poses(path, group)
    return Recording(
        path.stem, *size, events.repaired(options), frames, poses=poses, imu=imu, notes=tuple(notes)
    )


def _fields(file: Any, name: str) -> Mapping[str, str] | None:
    """Find the stored names of times, coordinates and polarities.

    Args:
        file: The file, of h5py.
        name: Name of a group or of a dataset of records; "" is the file itself.

    Returns:
        Stored names by "t", "x", "y" and "p"; None if one of them is missing.
    """
    found = file.get(name) if name else file
    if isinstance(found, h5py.Group):
        return find_fields(list(found))
    if isinstance(found, h5py.Dataset) and found.dtype.names:
        return find_fields(found.dtype.names)
    return None


def _open_columns(file: Any, name: str, source: str) -> dict[str, Column]:
    fields = _fields(file, name)
    if fields is None:
        raise InputError(f"{source}: {name} has no t, x, y and p; add them")
    if not isinstance(file.get(name) if name else file, h5py.Dataset):
        return {key: dataset(file, f"{name}/{fields[key]}", source) for key in "txyp"}
    whole: Any = dataset(file, name, source, undone=[ecf.HDF5_FILTER_ID])
    if filter_ids(whole) == [ecf.HDF5_FILTER_ID]:
        whole = ecf.Records(whole, f"{source}: {name}")
    return {
        key: _Part(whole.shape[0], whole.dtype[field], whole.fields(field).__getitem__)
        for key, field in fields.items()
    }


def _stated_size(file: Any, source: str) -> tuple[int, int] | None:
    """Read the size of the sensor from the attributes of a file.

    Args:
        file: The file, of h5py.
        source: Name of the file for messages.

    Returns:
        (width, height), px; None if no attribute states it.
    """
    with reading(f"{source}: attributes"):
        if (size := attribute(file, "sensor_resolution")) is not None:
            if np.size(size) == 3:  # height, width, channels
                size = np.ravel(size)[:2]
            height, width = _check_size(size, source)
            return width, height
        if (text := attribute(file, "geometry")) is not None:
            width, _, height = str(text).partition("x")
            return int(width), int(height)
        width, height = (attribute(file, name) for name in ("width", "height"))
        return None if width is None or height is None else _check_size([width, height], source)


def _check_size(values: Any, source: str) -> tuple[int, int]:
    if np.size(values) != 2:
        raise InputError(
            f"{source}: the sensor's size is {np.size(values)} numbers; store two, or give "
            "size=(width, height) or --size"
        )
    return whole_size(*np.ravel(values), source)


def _open_images_of_v2e(file: Any, source: str) -> tuple[NDArray | None, StoredImages | None]:
    """Open the frames that v2e keeps beside its events.

    Args:
        file: The file, of h5py.
        source: Name of the file for messages.

    Returns:
        (images,) times in the file's unit, and the images; both None if there are no times.
    """
    stored = dataset(file, "frame", source)
    if stored.ndim != 3 or not isinstance(file.get("frame_ts"), h5py.Dataset):
        return None, None
    stamps = array(file, "frame_ts", source)
    if len(stamps) != len(stored):
        raise InputError(
            f"{source}: frame holds {len(stored)} images, frame_ts {len(stamps)} times; there must "
            "be one time for each image"
        )
    return (stamps, StoredImages(stored, f"{source}: frame")) if len(stamps) else (None, None)


def _open_numbered_images(file: Any, source: str) -> tuple[NDArray | None, DecodedImages | None]:
    """Open the images of event_utils, one dataset each, in the order of their names.

    Args:
        file: The file, of h5py.
        source: Name of the file for messages.

    Returns:
        (images,) times in the file's unit, and the images; both None if there are none.
    """
    with reading(f"{source}: images"):
        names = sorted(file["images"])
        if not names:
            return None, None
        stamps = np.array([attribute(file["images"][name], "timestamp") for name in names])
    first = dataset(file, f"images/{names[0]}", source)
    if first.ndim not in (2, 3):
        raise InputError(f"{source}: images/{names[0]} has shape {first.shape}; store grey images")
    held = len(names) * (first.size or 0) * first.dtype.itemsize
    check_unfolded(held, file.id.get_filesize(), f"{source}: images")

    def image(name: str) -> NDArray:
        pixels = array(file, f"images/{name}", source)
        # event_utils stores colours with OpenCV, blue first.
        return to_grey(pixels if pixels.ndim == 2 else pixels[..., 2::-1])

    images = DecodedImages(
        lambda row: (image(name) for name in names[row:]),
        (len(names), first.shape[0], first.shape[1]),
        first.dtype,
        f"{source}: images",
    )
    return stamps, images
