"""The MATLAB layout of the asynchronous Kalman filter and HDR recordings, v5 and v7.3:

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
"""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import check_unfolded, reading, sensor_size, times
from jaxevent.io.decoded import from_columns
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Events, Frames, Recording

_MATRIX, _COMPRESSED = 14, 15  # types of elements
_FLAGS, _SIZES, _NAME = 6, 5, 1
_NUMBERS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}
_CLASSES = range(6, 16)  # of arrays: double, single and the integers


def read_v5(path: Path, options: ReadOptions) -> Recording:
    """Read a v5 file. Raises `InputError` for bad input."""
    import scipy.io

    with reading(str(path)):
        variables = scipy.io.loadmat(_unpacked(path))
    return _recording(
        path, options, {name: v for name, v in variables.items() if not name.startswith("__")}
    )


def _unpacked(path: Path) -> BytesIO:
    """The numeric variables of a file, without compression and checked to be whole.

    SciPy takes the number of a type as an index into its table without looking, and reads on past
    the end of a variable: a damaged file ends the process.
    """
    data = path.read_bytes()
    order = "<" if data[126:128] == b"IM" else ">"
    out = BytesIO()
    out.write(data[:128])
    at = 128
    while at < len(data):
        kind, size = struct.unpack_from(order + "2I", data, at)
        body = data[at + 8 : at + 8 + size]
        if len(body) != size or kind not in (_COMPRESSED, _MATRIX):
            raise InputError(
                f"{path}: the variable at byte {at} is damaged or cut off; fetch the file again"
            )
        if kind == _COMPRESSED:
            unpacking = zlib.decompressobj()
            (kind, size) = struct.unpack(order + "2I", unpacking.decompress(body, 8))
            check_unfolded(out.tell() + size, len(data), str(path))
            body = unpacking.decompress(unpacking.unconsumed_tail, size + 1)
        if kind != _MATRIX or len(body) != size:
            raise InputError(f"{path}: the variable at byte {at} is damaged; fetch it again")
        if _is_numeric(memoryview(body), order, f"{path}: the variable at byte {at}"):
            out.write(struct.pack(order + "2I", kind, size))
            out.write(body)
        at += 8 + int(struct.unpack_from(order + "2I", data, at)[1])
    out.seek(0)
    return out


def _is_numeric(body: memoryview, order: str, source: str) -> bool:
    """Whether a variable is an array of numbers; `InputError` where its elements do not fill it.

    They are the flags, whose lowest byte is the class and whose bit 11 says complex, the sizes, the
    name, the real and for complex the imaginary numbers.
    """
    damaged = InputError(f"{source} is damaged; fetch the file again")
    kinds = []
    at = 0
    numeric = is_complex = False
    while at < len(body):
        if len(body) - at < 8:
            raise damaged
        kind, size = struct.unpack_from(order + "2I", body, at)
        start, stop = at + 8, at + 8 + size + -size % 8
        if kind >> 16:  # up to 4 bytes, beside the type
            kind, size, start, stop = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if start + size > len(body) or (stop == at + 8 and start == at + 4 and size > 4):
            raise damaged
        if not kinds:
            if kind != _FLAGS or size != 8:
                raise damaged
            (flags,) = struct.unpack_from(order + "I", body, start)
            numeric, is_complex = flags & 0xFF in _CLASSES, bool(flags & 0x800)
            if not numeric:
                return False
        kinds.append(kind)
        at = stop
    if (
        kinds[1:3] != [_SIZES, _NAME]
        or len(kinds) != 4 + is_complex
        or not set(kinds[3:]) <= _NUMBERS
    ):
        raise damaged
    return True


def read_v73(path: Path, options: ReadOptions) -> Recording:
    """Read a v7.3 file. Raises `InputError` for bad input."""
    import h5py

    from jaxevent.io import hdf5_files

    variables: dict[str, NDArray] = {}
    with reading(str(path)), hdf5_files.open_file(path) as file:
        for name, dataset in file.items():
            if isinstance(dataset, h5py.Dataset) and dataset.dtype.kind in "biuf":
                with reading(f"{path}: {name}"):
                    # MATLAB stores the shape of an empty array as its data, and all axes reversed.
                    empty = hdf5_files.attribute(dataset, "MATLAB_empty")
                    stored = hdf5_files.array(file, name, str(path))
                    if empty and stored.all():
                        raise InputError(f"{path}: {name} is said to be empty but has a size")
                    variables[name] = np.zeros(stored.astype(int)) if empty else stored.T
                    held = sum(value.nbytes for value in variables.values())
                    check_unfolded(held, path.stat().st_size, str(path))
    return _recording(path, options, variables)


def _recording(path: Path, options: ReadOptions, variables: dict) -> Recording:
    arrays: dict[str, NDArray] = {
        name: value
        for name, value in variables.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
    if "events" not in arrays:
        raise InputError(
            f"{path}: has no numeric variable events; store it as N x 4 (t in us, x, y, p)"
        )
    columns = arrays.pop("events")
    frames = _frames(path, arrays) if "image" in arrays else None
    otherwise = f"{path}: has no image to tell the sensor's size;"
    size = sensor_size(options.size, frames=frames, otherwise=otherwise)
    events = _events(path, columns, size, options)
    extra = {name: _squeeze(value) for name, value in arrays.items() if name != "HDR_mat"}
    if "HDR_mat" in arrays:
        number = 0 if frames is None else len(frames)
        extra["HDR_mat"] = _reference(arrays["HDR_mat"], number, f"{path}: HDR_mat")
    return Recording(path.stem, *size, events, frames, extra=extra)


def _events(path: Path, columns: NDArray, size: tuple[int, int], options: ReadOptions) -> Events:
    source = f"{path}: events"
    if columns.size == 0:
        return Events.empty()
    if columns.ndim != 2 or 4 not in columns.shape:
        raise InputError(
            f"{source} has shape {columns.shape}; store it as N x 4 (t in us, x, y, p)"
        )
    t, x, y, p = columns.T if columns.shape[1] == 4 else columns
    timed = times(t, source, "event", scale=1.0), x, y, p
    return from_columns(timed, size, source, options, origin=1)


def _frames(path: Path, arrays: dict[str, NDArray]) -> Frames | None:
    images = arrays.pop("image")
    if images.size == 0:
        return None
    if images.dtype.kind == "f" and images.max() > 1:
        raise InputError(
            f"{path}: image is {images.dtype} with values up to {images.max():g}; store grey "
            "levels as uint8, or floats scaled to [0, 1]"
        )
    if images.ndim == 2:
        images = images[:, :, None]
    images = _frames_first(images, f"{path}: image")
    if "time_image" not in arrays:
        raise InputError(f"{path}: image has no times; add time_image, mid-exposure times in us")
    source = f"{path}: time_image"
    t = times(np.ravel(arrays.pop("time_image")), source, "image", scale=1.0)
    if "exposure" in arrays:
        source = f"{path}: exposure"
        exposure = times(np.ravel(arrays.pop("exposure")), source, "image", scale=1.0)
        if len(exposure) == 1:
            exposure = np.full_like(t, exposure[0])
    else:
        exposure = np.zeros_like(t)
    return Frames(t, images, exposure)


def _frames_first(images: NDArray, source: str) -> NDArray:
    """[y, x, frame] as contiguous [frame, y, x]; [y, x] as it is."""
    if images.ndim not in (2, 3):
        raise InputError(f"{source} has shape {images.shape}; store grey images as H x W x K")
    return np.ascontiguousarray(np.moveaxis(images, 2, 0) if images.ndim == 3 else images)


def _reference(images: NDArray, frames: int, source: str) -> NDArray:
    """HDR_mat as grey [frame, y, x] or [y, x]."""
    colour = images.ndim == 4 or (images.ndim == 3 and images.shape[2] == 3 and frames != 3)
    if colour and images.shape[2] != 3:
        raise InputError(
            f"{source} has shape {images.shape}; store it as H x W x K, or in colour as "
            "H x W x 3 x K"
        )
    return _frames_first(images.mean(axis=2) if colour else images, source)


def _squeeze(value: NDArray) -> NDArray:
    return np.squeeze(value) if value.size else value.reshape(0)
