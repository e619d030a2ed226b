"""Reading and writing recordings: `load` any readable file or folder, `save` as HDF5.

The layouts are described in the reader modules: `text`, `mat`, `npz` and `hdf5`. They are imported
when first needed. This module also turns the raw numbers of a file into checked fields, so that
every reader accepts the same values and words its errors alike.
"""

import contextlib
import functools
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording

__all__ = ["load", "save"]

READABLE = (
    "readable are a folder or zip with events.txt (Event-Camera Dataset), .npz, "
    "MATLAB .mat (v5 and v7.3) and HDF5 (jaxevent's own or DSEC-like)"
)


def load(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    in_memory: bool = True,
    progress: bool = False,
) -> Recording:
    """Read and check a recording; its format is told by its content, not by its name.

    Args:
        path: A folder, zip, .npz, .mat or HDF5 file.
        size: (width, height) in pixels; overrides the sensor size of the file, and is needed where
            the file does not tell it.
        in_memory: False leaves the events of an HDF5 file on disk, as `hdf5.StoredEvents`; they
            are then read and checked piece by piece. The other formats are always read whole.
        progress: Show a bar on stderr where reading text takes longer than two seconds.

    Raises:
        InputError: The file is missing, damaged or of another format, or what it holds is not a
            valid recording; the message names the place and the remedy.
    """
    path = Path(path)
    if size is not None and min(size) < 1:
        raise InputError(f"size = {size} must be two positive numbers of pixels, (width, height)")
    return _reader(path, in_memory, progress)(path, size).check(str(path))


def save(
    recording: Recording,
    path: str | os.PathLike[str],
    compression: str | None = None,
    progress: bool = False,
) -> None:
    """Write a recording as HDF5 in the layout of `jaxevent.io.hdf5`, completely or not at all.

    Events left on disk by `load(..., in_memory=False)` are copied at constant memory.

    Args:
        recording: What to write; it is checked first.
        path: The file to write; an existing file is replaced once the new one is complete.
        compression: None for the fastest reading, "gzip" for the smallest file.
        progress: Show a bar on stderr where it takes longer than two seconds.

    Raises:
        InputError: The recording is not valid, or the file cannot be written.
    """
    from jaxevent.io import hdf5

    hdf5.write(recording, Path(path), compression, progress)


def _reader(
    path: Path, in_memory: bool, progress: bool
) -> Callable[[Path, tuple[int, int] | None], Recording]:
    with reading(str(path)):
        is_folder, exists = path.is_dir(), path.exists()
    if is_folder:
        if not (path / "events.txt").is_file():
            raise InputError(f"{path}: the folder holds no events.txt; {READABLE}")
        from jaxevent.io import text

        return functools.partial(text.read, progress=progress)
    if not exists:
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    with reading(str(path)), path.open("rb") as file:
        head = file.read(128)
    if not head:
        raise InputError(f"{path}: the file is empty; fetch it again")
    if head.startswith(b"PK"):
        with reading(str(path)), zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        if any(name.rpartition("/")[2] == "events.txt" for name in names):
            from jaxevent.io import text

            return functools.partial(text.read, progress=progress)
        if names and all(name.endswith(".npy") for name in names):
            from jaxevent.io import npz

            return npz.read
        raise InputError(f"{path}: the zip holds neither events.txt nor .npy arrays; {READABLE}")
    # The header of MATLAB v5: 116 bytes of text, 8 of offset, the version 0x0100 and the letters
    # MI as the writing machine ordered both. (v7.3 has 0x0200 there and is HDF5.)
    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        from jaxevent.io import mat

        return mat.read_v5

    import h5py

    if not h5py.is_hdf5(path):
        raise InputError(f"{path}: the format is not recognised; {READABLE}")
    with reading(str(path)), h5py.File(path) as file:
        events = file.get("events")
        ours = isinstance(events, h5py.Group) and "t" in events
        matlab = isinstance(events, h5py.Dataset)
    if ours:
        from jaxevent.io import hdf5

        return hdf5.read if in_memory else hdf5.open_stored
    if matlab:
        from jaxevent.io import mat

        return mat.read_v73
    raise InputError(f"{path}: the HDF5 file has neither events/t nor an events array; {READABLE}")


@contextlib.contextmanager
def reading(source: str) -> Iterator[None]:
    """Turn whatever a parser raises on a bad file into an `InputError` naming `source`.

    The parsers behind this (zipfile, zlib, Pillow, scipy, h5py) document no common exception.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{source}: cannot be read ({reason}); the file is damaged, incomplete or not "
            "permitted, so fetch it again or check its permissions"
        ) from error


def times(values: NDArray, source: str, what: str, scale: float = 1e6) -> NDArray[np.int64]:
    """Times (n,) as int64 us: integers are us already, floats are multiplied by `scale`."""
    values = _numbers(values, source, f"{what} times")
    if values.dtype.kind != "f":
        return values.astype(np.int64, copy=False)
    # int64 ends at 9.2e18; NaN and infinity fail this comparison too.
    good = np.abs(values) < 9e18 / scale
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(
            f"{source}: {what} {row} has the time {values[row]:.16g}, not finite or too large for "
            f"{'seconds' if scale == 1e6 else 'microseconds'}; correct the unit or remove it"
        )
    return np.rint(values.astype(np.float64, copy=False) * scale).astype(np.int64)


def checked_events(
    t: NDArray,
    x: NDArray,
    y: NDArray,
    p: NDArray,
    size: tuple[int, int],
    source: str,
    *,
    first_row: int = 0,
    origin: int = 0,
) -> Events:
    """Events of a file's columns, each (events,), on a sensor of `size` (width, height).

    `t` is int64 us. Coordinates count from `origin`. Polarity is bool, 0/1 or -1/1. `first_row` is
    the row of the first event in `source`. Raises `InputError` for the first bad event.
    """
    if not len(t) == len(x) == len(y) == len(p):
        raise InputError(
            f"{source}: t, x, y and p have {len(t)}, {len(x)}, {len(y)} and {len(p)} values; "
            "they must be equally long"
        )

    def pixels(name: str, values: NDArray, count: int) -> NDArray[np.uint16]:
        values = _numbers(values, source, name)
        last = origin + count - 1
        if values.dtype.kind == "f":
            good = (values >= origin) & (values <= last) & (values == np.rint(values))
            bad_row = None if good.all() else int(np.argmin(good))
        elif len(values) and not origin <= values.min() <= values.max() <= last:
            bad_row = int(np.argmax((values < origin) | (values > last)))
        else:
            bad_row = None
        if bad_row is not None:
            raise InputError(
                f"{source}: event {first_row + bad_row} has {name} = {values[bad_row]:.12g}; on "
                f"the {size[0]}x{size[1]} sensor {name} is a whole number from {origin} to {last}, "
                "so give the sensor's size or remove the event"
            )
        return (values - origin if origin else values).astype(np.uint16, copy=False)

    x, y = pixels("x", x, size[0]), pixels("y", y, size[1])
    events = Events(t, x, y, _polarity(p, source, first_row))
    events.check(*size, source, first_row)
    return events


def _polarity(p: NDArray, source: str, first_row: int) -> NDArray[np.bool_]:
    if p.dtype.kind == "b":
        return p
    p = _numbers(p, source, "p")
    if p.dtype == np.uint8 and (not len(p) or p.max() <= 1):
        return p.view(np.bool_)
    on, off, negative = p == 1, p == 0, p == -1
    good = on | off | negative
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(
            f"{source}: event {first_row + row} has the polarity {p[row]:.12g}; it must be 1 for "
            "ON and 0 or -1 for OFF"
        )
    if off.any() and negative.any():
        raise InputError(
            f"{source}: polarities 0 and -1 both occur; use 0/1 or -1/1 throughout, 1 being ON"
        )
    return on


def pinhole(values: NDArray, source: str) -> PinholeCamera:
    """The camera of nine numbers: fx fy cx cy k1 k2 p1 p2 k3."""
    values = np.ravel(values)
    if values.shape != (9,) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InputError(
            f"{source}: the calibration must be nine finite numbers, fx fy cx cy k1 k2 p1 p2 k3"
        )
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(value) for value in values)
    return PinholeCamera(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def sensor_size(
    *known: tuple[int, int] | None, frames: Frames | None, otherwise: str
) -> tuple[int, int]:
    """(width, height): the first size that is known, else that of the frames.

    Raises `InputError` with the text `otherwise` and the remedy if neither tells it.
    """
    for size in known:
        if size is not None:
            return size
    if frames is None:
        raise InputError(f"{otherwise} give size=(width, height) or --size")
    _, height, width = frames.images.shape
    return width, height


def vectors(values: NDArray, shape: tuple[int, int], source: str, what: str) -> NDArray[np.float64]:
    """Measurements (samples, components) as finite float64, or `InputError`."""
    if values.shape != shape or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InputError(
            f"{source}: {what} has shape {values.shape}; it must hold {shape[0]}x{shape[1]} finite "
            "numbers, one row per time"
        )
    return values.astype(np.float64, copy=False)


def _numbers(values: NDArray, source: str, what: str) -> NDArray:
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise InputError(
            f"{source}: {what} is {values.dtype} of shape {values.shape}; store a list of numbers"
        )
    return values
