"""MATLAB files, v5 and v7.3, in the layout of the AKF's recordings and their HDR references:

    events      (N, 4)     t (us), x, y, p; x and y count from 1, p is 0/1 or -1/1; or (4, N)
    image       (H, W, K)  uint8, uint16 or floats in [0, 1]
    time_image  (K,)       mid-exposure times (us)
    exposure    (K,) or scalar  us; absent: unknown
    f_Q         (256,)     certainty of each grey level, see `Recording.response`
    ct          scalar     contrast threshold
    HDR_mat     (H, W) or (H, W, K), in colour (H, W, 3) or (H, W, 3, K)  HDR reference

Only `events` is required, and the size where there is no `image`. f_Q, ct, HDR_mat and every other
numeric variable are kept in `Recording.extra`, HDR_mat as [y, x] or [frames, y, x]. HDR_mat in
colour becomes the mean of its three channels, as in the authors' programs; (H, W, 3) is colour
unless there are three frames. MATLAB's rows and columns (1 x N) become vectors.

In place of `events` there may be four vectors with the names of `columns` (ASL-DVS: ts, x, y, pol),
as variables or as fields of a struct, or one other array (N, 4) or (4, N), in an order that
`columns.order_of` infers. Their x and y count from 0 where a 0 occurs, otherwise from 1. The fields
of other structs are kept as "struct.field".
"""

import contextlib
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times
from jaxevent.errors import InputError
from jaxevent.io.checks import (
    ReadOptions,
    check_unfolded,
    damaged,
    image_size,
    reading,
    sensor_size,
)
from jaxevent.io.columns import (
    ColumnReadResult,
    as_rows,
    find_fields,
    order_of,
    read_whole_columns,
    split_rows,
)
from jaxevent.recording import Events, Frames, Recording
from jaxevent.time_units import SAMPLE_EVENTS, Clock

# Types of elements of a v5 file.
_MATRIX, _COMPRESSED = 14, 15
_FLAGS, _SIZES, _NAME = 6, 5, 1  # types of the first three elements of a variable
_NUMBER_KINDS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}
_ARRAY_CLASSES = range(6, 16)  # classes of numeric arrays: double, single and the integers
_KNOWN_VARIABLES = ("image", "time_image", "exposure", "f_Q", "ct", "HDR_mat")  # but events
_STRUCT_CLASS = 2  # class of a struct


def read_v5(path: Path, options: ReadOptions) -> Recording:
    """Read a v5 file.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording, in memory.

    Raises:
        InputError: The file is damaged, or what it holds is not valid.
    """
    import scipy.io

    with reading(path):
        variables = scipy.io.loadmat(_copy_numeric_variables(path))
    return _make_recording(
        path, options, {name: v for name, v in variables.items() if not name.startswith("__")}
    )


def _copy_numeric_variables(path: Path) -> BytesIO:
    """Copy the numeric variables of a file, uncompressed and checked to be complete.

    SciPy uses the number of a type as an index without a check, and reads past the end of a
    variable, so a damaged file would crash the process.
    """
    data = path.read_bytes()
    order = "<" if data[126:128] == b"IM" else ">"
    out = BytesIO()
    out.write(data[:128])
    at = 128
    while at < len(data):
        kind, size = struct.unpack_from(order + "2I", data, at)
        body = data[at + 8 : at + 8 + size]
        wrong = damaged(f"{path}: the variable at byte {at} is not valid")
        if len(body) != size or kind not in (_COMPRESSED, _MATRIX):
            raise wrong
        if kind == _COMPRESSED:
            unpacking = zlib.decompressobj()
            (kind, size) = struct.unpack(order + "2I", unpacking.decompress(body, 8))
            check_unfolded(out.tell() + size, len(data), str(path))
            body = unpacking.decompress(unpacking.unconsumed_tail, size + 1)
        if kind != _MATRIX or len(body) != size:
            raise wrong
        for part in _numeric_parts(memoryview(body), order, wrong):
            out.write(struct.pack(order + "2I", kind, len(part)))
            out.write(part)
        at += 8 + int(struct.unpack_from(order + "2I", data, at)[1])
    out.seek(0)
    return out


class _Element(NamedTuple):
    """Element of a variable in a v5 file.

    Attributes:
        kind: Number of the element's type.
        data: Bytes of the element.
        stop: Offset of the next element.
    """

    kind: int
    data: memoryview
    stop: int


def _elements(body: memoryview, order: str, wrong: InputError) -> Iterator[_Element]:
    at = 0
    while at < len(body):
        if len(body) - at < 8:
            raise wrong
        kind, size = struct.unpack_from(order + "2I", body, at)
        start, stop = at + 8, at + 8 + size + -size % 8
        if kind >> 16:  # up to 4 bytes, beside the type
            kind, size, start, stop = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if start + size > len(body) or (stop == at + 8 and start == at + 4 and size > 4):
            raise wrong
        yield _Element(kind, body[start : start + size], stop)
        at = stop


def _numeric_parts(
    body: memoryview, order: str, wrong: InputError, *, is_field: bool = False
) -> list[bytes]:
    """Return the numeric arrays in a variable: the variable itself, or the fields of a struct.

    The elements of an array are its flags, sizes, name, real numbers and, if it is complex,
    imaginary numbers. The lowest byte of the flags is the class; bit 11 marks a complex array. A
    struct has, in place of numbers, the length of its fields' names, the names, and the fields. Its
    fields become variables named "struct.field"; nested structs and arrays of structs are left out.
    Raises `wrong` if the elements do not fill the variable.
    """
    elements = _elements(body, order, wrong)
    flags = next(elements, None)
    if flags is None or flags.kind != _FLAGS or len(flags.data) != 8:
        raise wrong
    (bits,) = struct.unpack_from(order + "I", flags.data)
    is_struct = bits & 0xFF == _STRUCT_CLASS
    if bits & 0xFF not in _ARRAY_CLASSES and (is_field or not is_struct):
        return []
    kept = [flags, *elements]
    if [element.kind for element in kept[1:3]] != [_SIZES, _NAME]:
        raise wrong
    numbers = kept[3:]
    if not is_struct:
        is_right = {element.kind for element in numbers} <= _NUMBER_KINDS
        if len(numbers) != 1 + bool(bits & 0x800) or not is_right:
            raise wrong
        return [bytes(body)]
    if len(numbers) < 2 or len(numbers[0].data) != 4:
        raise wrong
    (length,) = struct.unpack(order + "I", numbers[0].data)
    joined, fields = bytes(numbers[1].data), numbers[2:]
    if not length or len(joined) % length or any(field.kind != _MATRIX for field in fields):
        raise wrong
    names = [joined[at : at + length].split(b"\0")[0] for at in range(0, len(joined), length)]
    if len(fields) != len(names):  # an array of structs
        return []
    parts = []
    for name, field in zip(names, fields, strict=True):
        whole = bytes(kept[2].data) + b"." + name
        if len(field.data):
            held = _numeric_parts(field.data, order, wrong, is_field=True)
            parts += [_rename_array(part, whole, order) for part in held]
    return parts


def _rename_array(body: bytes, name: bytes, order: str) -> bytes:
    """Replace the name of an array of numbers, its third element."""
    elements = [*_elements(memoryview(body), order, damaged("it"))]
    held = struct.pack(order + "2I", 1, len(name)) + name + bytes(-len(name) % 8)
    return body[: elements[1].stop] + held + body[elements[2].stop :]


def read_v73(path: Path, options: ReadOptions) -> Recording:
    """Read a v7.3 file.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording, in memory.

    Raises:
        InputError: The file is damaged, or what it holds is not valid.
    """
    import h5py

    from jaxevent.io import hdf5_files

    variables: dict[str, NDArray] = {}
    with reading(path), hdf5_files.open_file(path) as file:
        items: list[tuple[str, Any]] = []
        for name, item in file.items():
            if isinstance(item, h5py.Group) and not name.startswith("#"):
                items += [(f"{name}/{field}", part) for field, part in item.items()]
            else:
                items.append((name, item))
        for name, dataset in items:
            if isinstance(dataset, h5py.Dataset) and dataset.dtype.kind in "biuf":
                with reading(f"{path}: {name}"):
                    # MATLAB stores the shape of an empty array as its data, and all axes reversed.
                    empty = hdf5_files.attribute(dataset, "MATLAB_empty")
                    stored = hdf5_files.array(file, name, str(path))
                    if empty and stored.all():
                        raise InputError(f"{path}: {name} is marked as empty but has a size")
                    value = np.zeros(stored.astype(int)) if empty else stored.T
                    variables[name.replace("/", ".")] = value
                    held = sum(value.nbytes for value in variables.values())
                    check_unfolded(held, path.stat().st_size, str(path))
    return _make_recording(path, options, variables)


def _make_recording(path: Path, options: ReadOptions, variables: dict) -> Recording:
    arrays: dict[str, NDArray] = {
        name: value
        for name, value in variables.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
    found = _find_events(arrays)
    if found is None:
        raise InputError(
            f"{path}: has no numeric variable events; store it as N x 4 (t in us, x, y, p), or "
            "vectors t, x, y and p"
        )
    images = arrays.pop("image") if "image" in arrays else None
    if images is not None:
        images = _check_images(path, images)
    otherwise = f"{path}: has no image to show the sensor's size"
    size = sensor_size(otherwise, options.size, image_size(images))
    events, clock, notes = _read_events(path, found, size, options)
    frames = None
    if images is not None:
        frames = _make_frames(path, images, arrays, clock, notes)
    extra = {name: _squeeze(value) for name, value in arrays.items() if name != "HDR_mat"}
    if "HDR_mat" in arrays:
        number = 0 if frames is None else len(frames)
        extra["HDR_mat"] = _to_grey_reference(arrays["HDR_mat"], number, f"{path}: HDR_mat")
    return Recording(path.stem, *size, events, frames, extra=extra, notes=tuple(notes))


class _StoredEvents(NamedTuple):
    """Events as stored: columns by name, or one array whose order of columns may be known.

    `is_layout` marks the array `events` of the layout: t x y p, if its times are sorted.
    """

    columns: dict[str, NDArray]
    array: NDArray | None
    name_of_t: str = ""
    is_layout: bool = False


def _find_events(arrays: dict[str, NDArray]) -> _StoredEvents | None:
    """Remove the events from the variables and return them; None if there are none."""
    if "events" in arrays:
        return _StoredEvents({}, arrays.pop("events"), is_layout=True)
    structs = sorted({name.partition(".")[0] for name in arrays if "." in name})
    for prefix in ("", *(f"{name}." for name in structs)):
        inside = [name.removeprefix(prefix) for name in arrays if name.startswith(prefix)]
        if (fields := find_fields(inside)) is not None:
            columns = {key: arrays.pop(prefix + name) for key, name in fields.items()}
            return _StoredEvents(columns, None, fields["t"])
    plain = [
        name
        for name, value in arrays.items()
        if name not in _KNOWN_VARIABLES and as_rows(value) is not None
    ]
    return _StoredEvents({}, arrays.pop(plain[0])) if len(plain) == 1 else None


def _read_events(
    path: Path, found: _StoredEvents, size: tuple[int, int], options: ReadOptions
) -> ColumnReadResult:
    source = f"{path}: events"
    if found.array is None:
        columns = {name: _vector(value) for name, value in found.columns.items()}
    elif found.array.size == 0:
        is_float = found.array.dtype.kind == "f"
        return ColumnReadResult(Events.empty(), Clock("us", 0, 0, is_float), [])
    else:
        rows = as_rows(found.array)
        if rows is None:
            raise InputError(
                f"{source} has shape {found.array.shape}; store it as N x 4 (t in us, x, y, p)"
            )
        order = "txyp"
        if not found.is_layout:
            order = order_of(rows[:SAMPLE_EVENTS], (size[0] + 1, size[1] + 1), source)
        elif not _has_order_of_layout(rows[:SAMPLE_EVENTS]):
            with contextlib.suppress(InputError):  # the first bad value is named
                order = order_of(rows[:SAMPLE_EVENTS], (size[0] + 1, size[1] + 1), source)
        columns = split_rows(rows, order)
    # MATLAB counts from 1; other programs that write its files count from 0.
    is_from_0 = not found.is_layout and any((columns[name] == 0).any() for name in "xy")
    events = read_whole_columns(
        columns,
        size,
        source,
        options,
        name=found.name_of_t,
        usual="us",
        origin=0 if is_from_0 else 1,
    )
    if is_from_0:
        events.notes.append("x and y count from 0, as a 0 occurs")
    return events


def _has_order_of_layout(rows: NDArray) -> bool:
    """Return whether the first of four columns can be times and the last polarities."""
    return bool((rows[1:, 0] >= rows[:-1, 0]).all() or np.isin(rows[:, 3], (-1, 0, 1)).all())


def _vector(value: NDArray) -> NDArray:
    """Flatten a MATLAB row or column (1 x N) to a vector."""
    return value.reshape(-1) if value.size == max(value.shape, default=0) else value


def _check_images(path: Path, images: NDArray) -> NDArray | None:
    """Check images and put frames first.

    Args:
        path: The file, for messages.
        images: [y, x] or [y, x, frame].

    Returns:
        [frame, y, x]; None if the array is empty.

    Raises:
        InputError: Floats exceed 1, or the array has another shape.
    """
    if images.size == 0:
        return None
    if images.dtype.kind == "f" and images.max() > 1:
        raise InputError(
            f"{path}: image is {images.dtype} with values up to {images.max():g}; store grey "
            "levels as uint8, or floats scaled to [0, 1]"
        )
    if images.ndim == 2:
        images = images[:, :, None]
    return _frames_first(images, f"{path}: image")


def _make_frames(
    path: Path, images: NDArray, arrays: dict[str, NDArray], clock: Clock, notes: list[str]
) -> Frames:
    if "time_image" not in arrays:
        raise InputError(f"{path}: image has no times; add time_image, mid-exposure times in us")
    source = f"{path}: time_image"
    t = clock.read(np.ravel(arrays.pop("time_image")), source, "image", notes, usual="us")
    if "exposure" in arrays:
        source = f"{path}: exposure"
        exposure = times(np.ravel(arrays.pop("exposure")), source, "image", us_per_unit=1.0)
        if len(exposure) == 1:
            exposure = np.full_like(t, exposure[0])
    else:
        exposure = np.zeros_like(t)
    return Frames(t, images, exposure)


def _frames_first(images: NDArray, source: str) -> NDArray:
    """Put the axis of frames first.

    Args:
        images: [y, x, frame], or [y, x], which stays as it is.
        source: Name of the array, for messages.

    Returns:
        Contiguous [frame, y, x], or [y, x].

    Raises:
        InputError: The array has other dimensions.
    """
    if images.ndim not in (2, 3):
        raise InputError(f"{source} has shape {images.shape}; store grey images as H x W x K")
    return np.ascontiguousarray(np.moveaxis(images, 2, 0) if images.ndim == 3 else images)


def _to_grey_reference(images: NDArray, frames: int, source: str) -> NDArray:
    """Convert `HDR_mat` to grey.

    Args:
        images: [y, x[, frame]] or in colour [y, x, 3[, frame]].
        frames: Number of frames; if it is 3, an axis of length 3 is that of frames, not colours.
        source: Name of the array, for messages.

    Returns:
        [frame, y, x] or [y, x].

    Raises:
        InputError: The array has another shape.
    """
    colour = images.ndim == 4 or (images.ndim == 3 and images.shape[2] == 3 and frames != 3)
    if colour and images.shape[2] != 3:
        raise InputError(
            f"{source} has shape {images.shape}; store it as H x W x K, or in colour as "
            "H x W x 3 x K"
        )
    return _frames_first(images.mean(axis=2) if colour else images, source)


def _squeeze(value: NDArray) -> NDArray:
    return np.squeeze(value) if value.size else value.reshape(0)
