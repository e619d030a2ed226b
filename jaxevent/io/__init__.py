"""Reading and writing recordings: `load` any readable file or folder, `save` as HDF5.

The layouts are described in the reader modules, and what each was checked against: `aedat2`,
`aedat4`, `columns` (tables of text and NumPy records), `event_stream`, `evimo`, `evreal`, `hdf5`,
`hdf5_layouts`, `mat`, `n_caltech`, `npz`, `parquet`, `prophesee`, `ros` (with `bags`,
`ros_messages` and `ros_events`), `text` and `timelens`; `time_units` finds the unit of times in
tables, `calibration` reads files of cameras. They are imported when first needed. This module also
turns the raw numbers of a file into checked fields, so that every reader accepts the same values
and words its errors alike.
"""

import codecs
import contextlib
import dataclasses
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent import arrays
from jaxevent.arrays import times
from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io.options import ReadOptions
from jaxevent.io.reopening import reopens
from jaxevent.lenses import LENSES, find_model
from jaxevent.recording import PER_FRAME, Events, Frames, Recording

__all__ = ["load", "save", "times"]

Reader = Callable[[Path, ReadOptions], Recording]

_BAGS = (b"#ROSBAG", b"\x89MCAP0\r\n", b"SQLite format 3\0")
_UNPACK = "unpack it and load the file inside"
_UNREADABLE = {
    b"\x1f\x8b": ("compressed by gzip", _UNPACK),
    b"BZh": ("compressed by bzip2", _UNPACK),
    b"\xfd7zXZ\0": ("compressed by xz", _UNPACK),
    b"\x28\xb5\x2f\xfd": ("compressed by zstd", _UNPACK),
    b"7z\xbc\xaf\x27\x1c": ("an archive of 7-Zip", _UNPACK),
    b"Rar!": ("an archive of RAR", _UNPACK),
    b"FEA1": ("Feather version 1", "write it anew as Parquet"),
    b"SIMPLE  =": ("FITS", "store events as a table of text or .npz"),
    **{
        b"\x80" + bytes([protocol]): (
            "a pickle, which can run any program when it is read",
            "if you trust it, load it with pickle and write it as .npz with t, x, y and p",
        )
        for protocol in range(2, 6)
    },
}
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
NONE = "none"  # of frames or events that are left out
_PROPHESEE = re.compile(
    rb"^% *(evt|format|version|data file|end)\b", re.I | re.M
)  # lines of its headers
_LINE = 1 << 12  # bytes of a line that are looked at
_SMALL = 1 << 27  # bytes of arrays that every file may unfold to
_MOST_COMPRESSED = 100  # times that a larger one may unfold to of its own bytes

_COUNTS = {8: "eight", 9: "nine", 12: "twelve"}  # of the numbers of a camera

READABLE = (
    "readable are a folder or zip with events.txt (Event-Camera Dataset), AEDAT 2 and 4, "
    "Prophesee RAW and DAT, Event Stream, bags of ROS 1 and ROS 2, HDF5 (jaxevent's own, DSEC, "
    "MVSEC, M3ED and others), MATLAB .mat (v5 and v7.3), N-Caltech101 .bin, folders of EVIMO2, "
    "EVREAL and TimeLens, .npz, .npy, Parquet, Feather and tables of text"
)


@reopens
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
            .npz, .mat and folders and zips of text are always read whole. Threads may share such a
            recording; where it is pickled or copied, the file is loaded again.
        progress: Whether a bar is shown where it takes longer than two seconds; None: where
            somebody looks on.
        stream: Which camera, of a file that holds the events of several: a topic of a ROS bag,
            "left" or "right" of MVSEC and M3ED, the number of a stream of AEDAT 4. "none" leaves
            events out: the frames of a bag or of AEDAT 4 may then be of another camera.
        trust: Whether HDF5 may be made of other files, by links, external storage or virtual
            datasets. Such a file can have any file read that you may read, or never end.
        frames: Which images become the frames, of a file that holds several kinds: a topic of a
            bag, the number of a stream of AEDAT 4. "none" leaves frames out, in any format.
        time_unit: The unit of the event times, "s", "ms", "us" or "ns", of formats that do not
            state it; None infers it (`jaxevent.io.time_units`), with an `InputWarning` in doubt.
        repair: How to mend event times that go back: "sort" late events, "drop" outliers, "unwrap"
            a counter, keep a "part" between resets, or several of them, as in "unwrap,sort"; see
            `jaxevent.io.disorder`. None refuses such times, and the message says what would help.
        camera: A calibration instead of the recording's: camchain.yaml of Kalibr or camera_info of
            ROS or OpenCV in YAML, or FILE:NAME, a camera of several; see `jaxevent.io.calibration`.

    Raises:
        InputError: The file is missing, damaged or of another format, or what it holds is not a
            valid recording; the message names the place and the remedy.
    """
    path = Path(path)
    if size is not None and not 1 <= min(size) <= max(size) <= arrays.MAX_PIXELS:
        raise InputError(
            f"size = {size} must be two positive numbers of pixels, (width, height), of at most "
            f"{arrays.MAX_PIXELS}"
        )
    arrays.check_unit(time_unit)
    without_frames, without_events = frames == NONE, stream == NONE
    camera_name = None if without_events else stream
    name = None if without_frames else frames
    options = ReadOptions(
        size, in_memory, progress, camera_name, name, time_unit, repair,
        without_frames, without_events,
    )  # fmt: skip
    with contextlib.ExitStack() as stack:
        if trust:
            from jaxevent.io.hdf5_files import trusting

            stack.enter_context(trusting())
        if repair is not None:
            from jaxevent.io.disorder import parse_repair

            parse_repair(repair)
        with naming(path):
            recording = _reader(path, options)(path, options)
    if without_frames:
        recording = _drop_frames(recording)
    if without_events:
        recording = dataclasses.replace(recording, events=Events.empty())
    recording.refuse_empty(str(path))
    if camera is not None:
        from jaxevent.io.calibration import read_camera

        lens = read_camera(camera, (recording.width, recording.height))
        left_out = {name: why for name, why in recording.left_out.items() if name != "camera"}
        recording = dataclasses.replace(recording, camera=lens, left_out=left_out)
    if options.notes:
        recording = dataclasses.replace(recording, notes=(*recording.notes, *options.notes))
    return recording


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
        refuse_time_unit(path, options)
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
        from jaxevent.io import evimo, evreal, timelens

        if evimo.knows(path):
            refuse_time_unit(path, options)
            return evimo.read
        for layout in (evreal, timelens):
            if layout.knows(path):
                return layout.read
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
    if read := _table_reader(path, head):
        return read
    read = _streamed_reader(path, head)
    refuse_time_unit(path, options)
    return read


def refuse_stream(path: Path, options: ReadOptions) -> None:
    """Raise `InputError` where a camera of a file is named that holds only one."""
    if options.stream is not None:
        raise InputError(f"{path}: holds one camera only; leave out stream= or --stream")


def refuse_time_unit(path: Path, options: ReadOptions) -> None:
    """Raise `InputError` where a unit of time is given for a format that states it."""
    if options.time_unit is not None:
        raise InputError(
            f"{path}: this format states the unit of its times; leave out time_unit= or --time-unit"
        )


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
    from jaxevent.io import n_caltech

    if n_caltech.is_plausible(path):
        return n_caltech.read
    for magic, (what, remedy) in _UNREADABLE.items():
        if head.startswith(magic):
            raise InputError(f"{path}: is {what}; {remedy}")
    raise InputError(f"{path}: the format is not recognised; {READABLE}")


def _table_reader(path: Path, head: bytes) -> Reader | None:
    """The reader of a file of columns, told by its first bytes."""
    if head.startswith((b"#!AER-DAT", b"Event Stream")):
        return None
    from jaxevent.io import columns

    if head.startswith(b"% "):
        with path.open("rb") as file:
            first = file.read(1 << 13)
        is_table = columns.is_text(first) and not _PROPHESEE.search(first)
        return columns.read_text if is_table else None

    if head.startswith(columns.NUMPY_MAGIC):
        return columns.read_npy
    if head.startswith((b"PAR1", b"ARROW1\0\0")):
        from jaxevent.io import parquet

        return parquet.read
    return columns.read_text if columns.is_text(head) else None


def _zip_reader(path: Path) -> Reader:
    with reading(str(path)), open_archive(path) as archive:
        names = archive.namelist()
        texts = find_event_texts(names)
        if texts and texts[0].rpartition("/")[2] != "events.txt":
            with archive.open(texts[0]) as file:
                texts = texts if _is_table(file.readline(_LINE)) else []
    if texts:
        from jaxevent.io import text

        return text.read
    if names and all(name.endswith(".npy") for name in names):
        from jaxevent.io import npz

        return npz.read
    raise InputError(f"{path}: the zip holds neither events.txt nor .npy arrays; {READABLE}")


def find_event_texts(names: Sequence[str]) -> list[str]:
    """Return the texts of events among the names in a zip.

    They are all events.txt, or else a text of any name that is the only file, as of rpg_e2vid.
    """
    found = [name for name in names if name.rpartition("/")[2] == "events.txt"]
    files = [name for name in names if not name.endswith("/") and not name.startswith("__MACOSX/")]
    return found or (files if len(files) == 1 and files[0].endswith(".txt") else [])


def _is_table(line: bytes) -> bool:
    """Tell whether a text that begins with a line can be events: width and height, or numbers."""
    words = line.removeprefix(codecs.BOM_UTF8).split()
    return len(words) in (2, 4) and all(re.fullmatch(rb"[+-]?[\d.eE+-]+", word) for word in words)


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
        matlab = hdf5.is_matlab(path)
    if others and not matlab:
        return hdf5_layouts.read
    refuse_stream(path, options)
    if matlab:
        from jaxevent.io import mat

        return mat.read_v73
    if ours:
        return hdf5.read
    raise InputError(
        f"{path}: the HDF5 file has neither events/t, x, y and p nor events under other known "
        f"names; {READABLE}"
    )


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the path before the message of an `InputError` that does not name it."""
    try:
        yield
    except InputError as error:
        if type(error) is not InputError or str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error


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


def open_archive(file: Path) -> zipfile.ZipFile:
    """Open a zip archive; raises `InputError` where it claims to hold far more than it can."""
    archive = zipfile.ZipFile(file)
    unfolded = sum(member.file_size for member in archive.infolist())
    check_unfolded(unfolded, file.stat().st_size, str(file))
    return archive


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
    arrays.as_size(*size, source)
    arrays.check_lengths(t, x, y, p, source)
    events = Events.of_checked(
        arrays.as_plain(t, np.int64),
        arrays.coordinates("x", x, size, source, first_row=first_row, origin=origin),
        arrays.coordinates("y", y, size, source, first_row=first_row, origin=origin),
        arrays.polarities(p, source, first_row),
    )
    events.check_order(source, first_row)
    return events


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
    if (
        number is None
        or not -arrays.MAX_TIME_US < number < arrays.MAX_TIME_US
        or number != int(number)
    ):
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
