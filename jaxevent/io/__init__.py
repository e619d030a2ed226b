"""Reading and writing recordings: `load` any readable file or folder, `save` as HDF5.

The layouts are described in the reader modules, and what each was checked against: `aedat2`,
`aedat4`, `columns` (tables of text and NumPy records), `event_stream`, `evimo`, `hdf5`,
`hdf5_layouts`, `mat`, `n_caltech`, `npz`, `prophesee`, `ros` (with `bags`, `ros_messages` and
`ros_events`) and `text`; `calibration` reads files of cameras. They are imported when first needed.
This module also turns the raw numbers of a file into checked fields, so that every reader accepts
the same values and words its errors alike.
"""

import contextlib
import dataclasses
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io.options import ReadOptions
from jaxevent.lenses import LENSES, find_model
from jaxevent.recording import PER_FRAME, Events, Frames, Recording

__all__ = ["load", "save"]

Reader = Callable[[Path, ReadOptions], Recording]

_BAGS = (b"#ROSBAG", b"\x89MCAP0\r\n", b"SQLite format 3\0")
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
NO_FRAMES = "none"
_SMALL = 1 << 27  # bytes of arrays that every file may unfold to
_MOST_COMPRESSED = 100  # times that a larger one may unfold to of its own bytes
_MOST_PIXELS = 1 << 16  # of a side: coordinates are uint16
_MOST_TIME = 1 << 62  # us, 146,000 years: sums and differences of two times stay in int64

_COUNTS = {8: "eight", 9: "nine", 12: "twelve"}  # of the numbers of a camera

READABLE = (
    "readable are a folder or zip with events.txt (Event-Camera Dataset), AEDAT 2 and 4, "
    "Prophesee RAW and DAT, Event Stream, bags of ROS 1 and ROS 2, HDF5 (jaxevent's own, DSEC, "
    "MVSEC, M3ED and others), MATLAB .mat (v5 and v7.3), N-Caltech101 .bin, folders of EVIMO2, "
    ".npz, .npy and tables of text"
)


def load(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    in_memory: bool = True,
    progress: bool | None = None,
    stream: str | None = None,
    trust: bool = False,
    *,
    frames: str | None = None,
    time_unit: str | None = None,
    repair: str | None = None,
    camera: str | os.PathLike[str] | None = None,
) -> Recording:
    """Read and check a recording; its format is told by its content, not by its name.

    Args:
        path: A file or folder in one of the layouts that `jaxevent.io` lists.
        size: (width, height) in pixels; overrides the sensor size of the file, and is needed where
            the file does not tell it.
        in_memory: False leaves events and images in the file, at the memory of a few blocks. Those
            of HDF5 are then read and checked where they are asked for (`hdf5.StoredEvents`); other
            formats are decoded and checked once now and again then (`decoded.DecodedEvents`).
            .npz, .mat and folders and zips of text are always read whole.
        progress: Whether a bar is shown where it takes longer than two seconds; None: where
            somebody looks on.
        stream: Which camera, of a file that holds the events of several: a topic of a ROS bag,
            "left" or "right" of MVSEC and M3ED, the number of a stream of AEDAT 4.
        trust: Whether HDF5 may be made of other files, by links, external storage or virtual
            datasets. Such a file can have any file read that you may read, or never end.
        frames: Which images become the frames, of a file that holds several kinds: a topic of a
            bag, the number of a stream of AEDAT 4. "none" leaves frames out, in any format.
        time_unit: The unit of the event times, "s", "ms", "us" or "ns"; None infers it.
        repair: How to mend event times that go back: "sort" late events, "drop" outliers, "unwrap"
            a counter, keep a "part" between resets, or several of them, as in "unwrap,sort"; see
            `jaxevent.io.disorder`. None refuses such times, and the message says what would help.
        camera: A calibration instead of the recording's: camchain.yaml of Kalibr or camera_info of
            ROS in YAML, or FILE:NAME, a camera of several; see `jaxevent.io.calibration`.

    Raises:
        InputError: The file is missing, damaged or of another format, or what it holds is not a
            valid recording; the message names the place and the remedy.
    """
    path = Path(path)
    if size is not None and not 1 <= min(size) <= max(size) <= _MOST_PIXELS:
        raise InputError(
            f"size = {size} must be two positive numbers of pixels, (width, height), of at most "
            f"{_MOST_PIXELS}"
        )
    without_frames = frames == NO_FRAMES
    name = None if without_frames else frames
    options = ReadOptions(
        size, in_memory, progress, stream, name, time_unit, repair, without_frames
    )
    with contextlib.ExitStack() as stack:
        if trust:
            from jaxevent.io.hdf5_files import trusting

            stack.enter_context(trusting())
        if repair is not None:
            from jaxevent.io.disorder import parse_repair

            parse_repair(repair)
        recording = _reader(path, options)(path, options)
    if without_frames:
        recording = _drop_frames(recording)
    recording.check(str(path))
    if camera is not None:
        from jaxevent.io.calibration import read_camera

        lens = read_camera(camera, (recording.width, recording.height))
        left_out = {name: why for name, why in recording.left_out.items() if name != "camera"}
        recording = dataclasses.replace(recording, camera=lens, left_out=left_out)
    return dataclasses.replace(recording, notes=(*recording.notes, *options.notes))


def _drop_frames(recording: Recording) -> Recording:
    """The recording without frames and what there is one of for each frame."""
    extra = {name: part for name, part in recording.extra.items() if name not in PER_FRAME}
    left_out = {**recording.left_out, "frames": "frames='none' or --frames none leaves them out"}
    return dataclasses.replace(recording, frames=None, extra=extra, left_out=left_out)


def save(
    recording: Recording,
    path: str | os.PathLike[str],
    compression: str | None = None,
    progress: bool | None = None,
) -> None:
    """Write a recording as HDF5 in the layout of `jaxevent.io.hdf5`, completely or not at all.

    Events left on disk by `load(..., in_memory=False)` are copied at constant memory.

    Args:
        recording: What to write; it is checked first.
        path: The file to write; an existing file is replaced once the new one is complete.
        compression: None for the fastest reading, "gzip" for the smallest file.
        progress: Whether a bar is shown where it takes longer than two seconds; None: where
            somebody looks on.

    Raises:
        InputError: The recording is not valid, or the file cannot be written.
    """
    from jaxevent.io import hdf5

    hdf5.write(recording, Path(path), compression, progress)


def _reader(path: Path, options: ReadOptions) -> Reader:
    with reading(str(path)):
        is_folder, exists, is_file = path.is_dir(), path.exists(), path.is_file()
    if not exists:
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    if not is_folder and not is_file:
        raise InputError(f"{path}: is a device or pipe; copy what it holds into a file")
    with reading(str(path)):
        head = b"" if is_folder else _head(path)
    if read := _reader_of_streams(path, head):
        return read
    if options.frames is not None:
        raise InputError(
            f"{path}: the format has one kind of frames, and none named {options.frames!r}; leave "
            "out frames= or --frames, or give none to read no frames"
        )
    if not is_folder and head.startswith(HDF5_MAGIC) or _later_hdf5(path, is_folder):
        return _hdf5_reader(path, options)
    refuse_stream(path, options)
    if is_folder:
        from jaxevent.io import evimo

        if evimo.knows(path):
            return evimo.read
        if not (path / "events.txt").is_file():
            raise InputError(f"{path}: the folder holds no events.txt; {READABLE}")
        from jaxevent.io import text

        return text.read
    if head.startswith(b"PK"):
        return _zip_reader(path)
    # The header of MATLAB v5: 116 bytes of text, 8 of offset, the version 0x0100 and the letters
    # MI as the writing machine ordered both. (v7.3 has 0x0200 there and is HDF5.)
    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        from jaxevent.io import mat

        return mat.read_v5
    return _streamed_reader(path, head)


def refuse_stream(path: Path, options: ReadOptions) -> None:
    """Raise `InputError` where a camera of a file is named that holds only one."""
    if options.stream is not None:
        raise InputError(f"{path}: holds one camera only; leave out stream= or --stream")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(128)
    if not head:
        raise InputError(f"{path}: the file is empty; fetch it again")
    return head


def _reader_of_streams(path: Path, head: bytes) -> Reader | None:
    """The reader of a format but HDF5 that may hold several cameras; a folder's head is empty."""
    if head.startswith(b"#!AER-DAT4"):
        from jaxevent.io import aedat4

        return aedat4.read
    if head.startswith(_BAGS) or (not head and (path / "metadata.yaml").is_file()):
        from jaxevent.io import ros

        return ros.read
    return None


def _streamed_reader(path: Path, head: bytes) -> Reader:
    """The reader of a format that is told by its first bytes and decoded block by block."""
    if head.startswith(b"#!AER-DAT"):
        if not head.startswith(b"#!AER-DAT2"):
            version = head[9:12].decode("latin-1")
            raise InputError(
                f"{path}: is AEDAT {version if version.isprintable() else '?'}; only AEDAT 2 and "
                "4 can be read, so convert it with jAER or DV"
            )
        from jaxevent.io import aedat2

        return aedat2.read
    if head.startswith(b"Event Stream"):
        from jaxevent.io import event_stream

        return event_stream.read
    if head.startswith(b"% "):
        from jaxevent.io import prophesee

        return prophesee.read
    from jaxevent.io import columns

    if head.startswith(columns.NUMPY_MAGIC):
        return columns.read_npy
    if columns.is_text(head):
        return columns.read_text
    from jaxevent.io import n_caltech

    if n_caltech.is_plausible(path):
        return n_caltech.read
    raise InputError(f"{path}: the format is not recognised; {READABLE}")


def _zip_reader(path: Path) -> Reader:
    with reading(str(path)), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        unfolded = sum(member.file_size for member in archive.infolist())
        check_unfolded(unfolded, path.stat().st_size, str(path))
    if any(name.rpartition("/")[2] == "events.txt" for name in names):
        from jaxevent.io import text

        return text.read
    if names and all(name.endswith(".npy") for name in names):
        from jaxevent.io import npz

        return npz.read
    raise InputError(f"{path}: the zip holds neither events.txt nor .npy arrays; {READABLE}")


def _later_hdf5(path: Path, is_folder: bool) -> bool:
    """Whether HDF5 begins after 512, 1024, ... bytes that are not its own, as in MATLAB v7.3."""
    if is_folder:
        return False
    with reading(str(path)), path.open("rb") as file:
        at = 512
        while file.seek(at) == at and (signature := file.read(len(HDF5_MAGIC))):
            if signature == HDF5_MAGIC:
                return True
            at *= 2
    return False


def _hdf5_reader(path: Path, options: ReadOptions) -> Reader:
    import h5py

    from jaxevent.io import hdf5, hdf5_files, hdf5_layouts

    with hdf5_files.open_file(path) as opened, reading(str(path)):
        file: Any = opened
        events = file.get("events")
        ours = isinstance(events, h5py.Group) and {"t", "x", "y", "p"} <= set(events)
        ours |= str(hdf5_files.attribute(file, "format")) == "jaxevent"
        others = not ours and hdf5_layouts.knows(file)
        matlab = hdf5.is_matlab(path, file)
    if others:
        return hdf5_layouts.read
    refuse_stream(path, options)
    if ours:
        return hdf5.read
    if matlab:
        from jaxevent.io import mat

        return mat.read_v73
    raise InputError(
        f"{path}: the HDF5 file has neither events/t, x, y and p nor events under other known "
        f"names; {READABLE}"
    )


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
        reason = reason if len(reason) < 200 else reason[:200] + "..."
        raise InputError(
            f"{source}: cannot be read ({reason}); the file is damaged, incomplete or not "
            "permitted, so fetch it again or check its permissions"
        ) from error


def most_unfolded(stored: int) -> int:
    """The bytes of arrays that `stored` bytes of a file may unfold to."""
    return max(_SMALL, _MOST_COMPRESSED * stored)


def check_unfolded(size: int, stored: int, source: str) -> None:
    """Raise `InputError` where `stored` bytes of a file claim to hold far more, `size`.

    Memory stays bounded by what a file holds: real events and images compress less than 20 times.
    """
    if size > most_unfolded(stored):
        raise InputError(
            f"{source}: {stored:,} bytes of the file claim to hold {size:,}, over "
            f"{_MOST_COMPRESSED} times as many; it is damaged or not a recording, else store it "
            "with less compression"
        )


def times(
    values: NDArray, source: str, what: str, scale: float = 1e6, first_row: int = 0
) -> NDArray[np.int64]:
    """Times (n,) as int64 us: integers are us already, floats are multiplied by `scale`.

    `first_row` is the row of the first one in `source`.
    """
    values = _numbers(values, source, f"{what} times")
    is_float = values.dtype.kind == "f"
    values = values.astype(np.float64, copy=False) if is_float else values
    # NaN and infinity fail this comparison too.
    most = _MOST_TIME / scale if is_float else _MOST_TIME
    if len(values) and not -most < values.min() <= values.max() < most:
        row = int(np.argmin((values > -most) & (values < most)))
        unit = "seconds" if is_float and scale == 1e6 else "microseconds"
        shown = f"{values[row]:.16g}" if is_float else str(values[row])
        raise InputError(
            f"{source}: {what} {first_row + row} has the time {shown}, not finite "
            f"or too large for {unit}; correct the unit or remove it"
        )
    if not is_float:
        return values.astype(np.int64, copy=False)
    return np.rint(values * scale).astype(np.int64)


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
    if min(size) < 1 or max(size) > _MOST_PIXELS:
        raise InputError(
            f"{source}: the sensor has {size[0]}x{size[1]} pixels, but at most {_MOST_PIXELS} of a "
            "side, and at least one, can be read; correct its size with size=(width, height) or "
            "--size"
        )
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
    if p.dtype.kind == "b" and p.ndim == 1:
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


def pinhole(values: NDArray, source: str, model: str = "radtan") -> PinholeCamera:
    """The camera of a list of numbers: fx fy cx cy, and those of its lens, as k1 k2 p1 p2 k3.

    Raises `InputError` for another count, for numbers that are not finite, and for a model that
    `jaxevent.lenses` does not list.
    """
    found = find_model(model)
    if found is None:
        raise InputError(f"{source}: {unsupported_lens(model)}")
    values, names = np.ravel(values), LENSES[found].coefficients
    count = 4 + len(names)
    if values.shape != (count,) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InputError(
            f"{source}: the calibration must be {_COUNTS[count]} finite numbers, fx fy cx cy "
            f"{' '.join(names)}"
        )
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    return PinholeCamera(fx, fy, cx, cy, tuple(distortion), found)


def unsupported_lens(model: str) -> str:
    """The sentence of a calibration of another lens model, as of `Recording.left_out`."""
    return (
        f"the calibration has the lens model {model[:40]!r}, which is not supported; supported are "
        f"{', '.join(LENSES)}"
    )


def calibrated(
    intrinsics: NDArray, model: str, coefficients: NDArray, source: str
) -> tuple[PinholeCamera | None, dict[str, str]]:
    """The camera of a calibration, and `Recording.left_out` where its lens is not supported.

    `intrinsics` are fx, fy, cx and cy in px; missing `coefficients` are 0. "plumb_bob" of eight
    coefficients, as drivers write it, is rational. Raises `InputError` for bad numbers.
    """
    found, k = find_model(model), np.ravel(coefficients)
    if found == "radtan" and len(k) == len(LENSES["rational"].coefficients):
        found = "rational"
    if found is None:
        return None, {"camera": f"{source}: {unsupported_lens(model)}"}
    count = len(LENSES[found].coefficients)
    if np.any(k[count:]):
        return None, {
            "camera": f"{source}: the calibration has {len(k)} coefficients of the lens model "
            f"{model[:40]!r}, of which {count} are supported"
        }
    k = np.concatenate([k[:count], np.zeros(max(0, count - len(k)))])
    return pinhole(np.concatenate([np.ravel(intrinsics), k]), source, found), {}


def whole_number(value: Any, source: str, what: str) -> int:
    """One number of a file as an int, or `InputError` unless it is a whole one below 2^62."""
    value = np.asarray(value)
    number = value.item() if value.size == 1 and value.dtype.kind in "iuf" else None
    if number is None or not -_MOST_TIME < number < _MOST_TIME or number != int(number):
        raise InputError(
            f"{source}: {what} must be one whole number, not {np.ravel(value)[:3]}; correct it"
        )
    return int(number)


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
