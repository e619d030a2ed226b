"""Reading and writing recordings: `load` any readable file or folder, `save` as HDF5.

The layouts are described in the reader modules, and what each was checked against: `aedat`, `atis`
(Event Stream and N-Caltech101), `folders` (EVIMO2, EVREAL and TimeLens), `hdf5`, `hdf5_layouts`,
`mat`, `prophesee`, `ros` (with `bags`), `tables` (text, NumPy, Parquet and Feather; `columns` lists
the names of fields) and `text` (the Event-Camera Dataset). `time_units` finds the unit of times in
tables, `disorder` mends times that go back, `calibration` reads files of cameras. Readers are
imported when first needed.
"""

import codecs
import contextlib
import dataclasses
import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent import arrays
from jaxevent.arrays import times
from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_names
from jaxevent.display import describe_type
from jaxevent.errors import InputError, InputWarning
from jaxevent.io.checks import ReadOptions, naming, open_archive, reading
from jaxevent.io.decoded import remember_call
from jaxevent.recording import PER_FRAME_EXTRAS, Events, Recording

__all__ = ["load", "save", "times"]

Reader = Callable[[Path, ReadOptions], Recording]

_BAG_MAGICS = (b"#ROSBAG", b"\x89MCAP0\r\n", b"SQLite format 3\0")
_UNPACK_REMEDY = "unpack it and load the file inside"
_UNREADABLE_MAGICS = {
    b"\x1f\x8b": ("compressed by gzip", _UNPACK_REMEDY),
    b"BZh": ("compressed by bzip2", _UNPACK_REMEDY),
    b"\xfd7zXZ\0": ("compressed by xz", _UNPACK_REMEDY),
    b"\x28\xb5\x2f\xfd": ("compressed by zstd", _UNPACK_REMEDY),
    b"7z\xbc\xaf\x27\x1c": ("an archive of 7-Zip", _UNPACK_REMEDY),
    b"Rar!": ("an archive of RAR", _UNPACK_REMEDY),
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
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_NONE = "none"  # name of frames or events that are left out
# Lines of the headers of Prophesee's files.
_PROPHESEE = re.compile(rb"^% *(evt|format|version|data file|end)\b", re.I | re.M)
_MAX_LINE_BYTES = 1 << 12

_READABLE_FORMATS = (
    "readable are a folder or zip with events.txt (Event-Camera Dataset), AEDAT 2 and 4, "
    "Prophesee RAW and DAT, Event Stream, bags of ROS 1 and ROS 2, HDF5 (jaxevent's own, DSEC, "
    "MVSEC, M3ED and others), MATLAB .mat (v5 and v7.3), N-Caltech101 .bin, folders of EVIMO2, "
    "EVREAL and TimeLens, .npz, .npy, Parquet, Feather and tables of text"
)


@remember_call
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
    camera: str | os.PathLike[str] | PinholeCamera | None = None,
) -> Recording:
    """Read and check a recording; its format is inferred from its content, not from its name.

    Args:
        path: A file or folder in one of the layouts that `jaxevent.io` lists.
        size: (width, height) in pixels; overrides the sensor size of the file, and is needed where
            the file does not state it.
        in_memory: False leaves events and images in the file, at the memory of a few blocks. Those
            of HDF5 are then read and checked when they are needed (`hdf5.StoredEvents`); other
            formats are decoded and checked once now and again then (`decoded.DecodedEvents`).
            .npz, .mat and folders and zips of text are always read whole. Threads may share such a
            recording; where it is pickled or copied, the file is loaded again.
        progress: Whether to show a bar after two seconds; None shows one on a terminal or in a
            notebook.
        stream: Name of the camera, of a file that holds the events of several: a topic of a ROS
            bag, "left" or "right" of MVSEC and M3ED, the number of a stream of AEDAT 4. "none"
            leaves events out: the frames of a bag or of AEDAT 4 may then be of another camera.
        trust: Whether HDF5 may be made of other files, by links, external storage or virtual
            datasets. Such a file can have any file read that you may read, or never end.
        frames: Name of the images that become the frames, of a file that holds several kinds: a
            topic of a bag, the number of a stream of AEDAT 4. "none" leaves frames out, in any
            format.
        time_unit: The unit of the event times, "s", "ms", "us" or "ns", of formats that do not
            state it; None infers it (`jaxevent.time_units`), with an `InputWarning` in doubt.
        repair: Repairs of event times that go back: "sort" late events, "drop" outliers, "unwrap"
            a counter, keep a "part" between resets, or several of them, as in "unwrap,sort"; see
            `jaxevent.io.disorder`. None refuses such times, and the message names the repairs that
            would help.
        camera: A calibration instead of the recording's: a `PinholeCamera`, or camchain.yaml of
            Kalibr or camera_info of ROS or OpenCV in YAML, or FILE:NAME, a camera of several; see
            `jaxevent.io.calibration`.

    Returns:
        The recording.

    Raises:
        InputError: The file is missing, damaged or of another format, or what it holds is not a
            valid recording; the message names the place and the remedy.
    """
    path = _as_path(path, "load")
    if size is not None and not _is_size(size):
        raise InputError(
            f"size = {arrays.shorten_value(size)} must be two positive numbers of pixels, "
            f"(width, height), whole and at most {arrays.MAX_SIDE_PX}"
        )
    arrays.check_unit(time_unit)
    without_frames, without_events = frames == _NONE, stream == _NONE
    options = ReadOptions(
        None if size is None else (int(size[0]), int(size[1])),
        in_memory,
        progress,
        stream=None if without_events else stream,
        frames=None if without_frames else frames,
        time_unit=time_unit,
        repair=repair,
        without_frames=without_frames,
        without_events=without_events,
    )
    with contextlib.ExitStack() as stack:
        if trust:
            from jaxevent.io.hdf5_files import trusting

            stack.enter_context(trusting())
        if repair is not None:
            from jaxevent.io.disorder import parse_repair

            parse_repair(repair)
        with naming(path):
            recording = _find_reader(path, options)(path, options)
    if without_frames:
        recording = _drop_frames(recording)
    if without_events:
        recording = dataclasses.replace(recording, events=Events.empty())
    recording.refuse_empty(str(path))
    images = None if recording.frames is None else recording.frames.images
    if isinstance(images, np.ndarray) and (doubt := arrays.doubt_levels(images)):
        warnings.warn(f"{path}: {doubt}", InputWarning, stacklevel=3)
    if camera is not None:
        lens = _as_camera(camera, recording)
        left_out = {name: why for name, why in recording.left_out.items() if name != "camera"}
        recording = dataclasses.replace(recording, camera=lens, left_out=left_out)
    if options.notes:
        recording = dataclasses.replace(recording, notes=(*recording.notes, *options.notes))
    return recording


def _as_path(path: Any, call: str) -> Path:
    """Return a path; raise `InputError` for anything else.

    Args:
        path: A path, or what a caller took for one.
        call: "load" or "save", for the message.

    Returns:
        The path.
    """
    if not isinstance(path, str | os.PathLike):
        order = {"load": "load(path)", "save": "save(recording, path)"}[call]
        raise InputError(f"the path is {describe_type(path)}; call jaxevent.{order}")
    if str(path).startswith(("http:/", "https:/")):  # pathlib keeps one slash
        raise InputError(f"{path}: is an address, not a file; download it first")
    return Path(path)


def _is_size(size: Any) -> bool:
    """Return whether an object is a width and a height that a sensor may have."""
    if isinstance(size, str) or np.shape(size) != (2,):
        return False
    return all(
        isinstance(side, int | np.integer) and 1 <= side <= arrays.MAX_SIDE_PX for side in size
    )


def _as_camera(camera: Any, recording: Recording) -> PinholeCamera:
    """Return a camera, or read it from a file; raise `InputError` for anything else.

    Args:
        camera: A camera, or the path of a calibration.
        recording: The recording; its size scales a calibration.

    Returns:
        The camera.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    if not isinstance(camera, str | os.PathLike):
        raise InputError(
            f"camera is {describe_type(camera)}; give the path of a calibration, or "
            "jaxevent.camera.PinholeCamera(fx, fy, cx, cy), px"
        )
    from jaxevent.io.calibration import read_camera

    return read_camera(camera, (recording.width, recording.height))


def _drop_frames(recording: Recording) -> Recording:
    """Leave out the frames of a recording, and arrays with one entry per frame."""
    extra = {name: part for name, part in recording.extra.items() if name not in PER_FRAME_EXTRAS}
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
        recording: The recording, which is checked first.
        path: The file to write; an existing file is replaced once the new one is complete.
        compression: None for the fastest reading, "gzip" for the smallest file.
        progress: Whether to show a bar after two seconds; None shows one on a terminal or in a
            notebook.

    Raises:
        InputError: This is no recording, or not a valid one, the suffix is none of HDF5, or the
            file cannot be written.
    """
    from jaxevent.io import hdf5
    from jaxevent.io.output import check_recording_name

    path = _as_path(path, "save")
    if not isinstance(recording, Recording):
        raise InputError(
            f"{path}: save writes recordings, not {describe_type(recording)}; write flow by "
            "jaxevent.show.flow.write_flow_hdf5, and images by `jaxevent reconstruct`, or as the "
            "arrays that video(times) returns"
        )
    check_recording_name(path)
    hdf5.write(recording, path, compression, progress)


def _find_reader(path: Path, options: ReadOptions) -> Reader:
    with reading(path):
        is_folder, exists, is_file = path.is_dir(), path.exists(), path.is_file()
    if not exists:
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    if not is_folder and not is_file:
        raise InputError(f"{path}: is a device or pipe; copy what it holds into a file")
    with reading(path):
        head = b"" if is_folder else _read_head(path)
    if read := _find_reader_of_streams(path, head):
        options.refuse_time_unit(path)
        return read
    if options.frames is not None:
        raise InputError(
            f"{path}: the format has one kind of frames, and none named {options.frames!r}; leave "
            "out frames= or --frames, or give none to read no frames"
        )
    if not is_folder and (head.startswith(_HDF5_MAGIC) or _is_hdf5_after_header(path)):
        return _find_hdf5_reader(path, options)
    options.refuse_stream(path)
    if is_folder:
        return _find_folder_reader(path)
    if head.startswith(b"PK"):
        return _find_zip_reader(path)
    # The header of MATLAB v5: 116 bytes of text, 8 of offset, the version 0x0100 and the letters
    # MI as the writing machine ordered both. (v7.3 has 0x0200 there and is HDF5.)
    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        from jaxevent.io import mat

        return mat.read_v5
    if read := _find_table_reader(path, head):
        return read
    read = _find_decoder(path, head)
    options.refuse_time_unit(path)
    return read


def _read_head(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(128)
    if not head:
        raise InputError(f"{path}: the file is empty; fetch it again")
    return head


def _find_reader_of_streams(path: Path, head: bytes) -> Reader | None:
    """Find the reader of a format but HDF5 that may hold several cameras; folders have no head."""
    if head.startswith(b"#!AER-DAT4"):
        from jaxevent.io import aedat

        return aedat.read_aedat4
    if head.startswith(_BAG_MAGICS) or (not head and (path / "metadata.yaml").is_file()):
        from jaxevent.io import ros

        return ros.read
    return None


def _find_folder_reader(path: Path) -> Reader:
    from jaxevent.io import folders

    if read := folders.find_reader(path):
        return read
    if not (path / "events.txt").is_file():
        raise InputError(f"{path}: the folder holds no events.txt; {_READABLE_FORMATS}")
    from jaxevent.io import text

    return text.read


def _find_decoder(path: Path, head: bytes) -> Reader:
    """Find the reader of a format with first bytes of its own that is decoded block by block."""
    if head.startswith(b"#!AER-DAT"):
        if not head.startswith(b"#!AER-DAT2"):
            version = head[9:12].decode("latin-1")
            raise InputError(
                f"{path}: is AEDAT {version if version.isprintable() else '?'}; only AEDAT 2 and "
                "4 can be read, so convert it with jAER or DV"
            )
        from jaxevent.io import aedat

        return aedat.read_aedat2
    if head.startswith(b"% "):
        from jaxevent.io import prophesee

        return prophesee.read
    from jaxevent.io import atis

    if head.startswith(b"Event Stream"):
        return atis.read_event_stream
    if atis.is_n_caltech(path):
        return atis.read_n_caltech
    for magic, (what, remedy) in _UNREADABLE_MAGICS.items():
        if head.startswith(magic):
            raise InputError(f"{path}: is {what}; {remedy}")
    raise InputError(f"{path}: the format is not recognised; {_READABLE_FORMATS}")


def _find_table_reader(path: Path, head: bytes) -> Reader | None:
    """Find the reader of a file of columns by its first bytes."""
    if head.startswith((b"#!AER-DAT", b"Event Stream")):
        return None
    from jaxevent.io import tables

    if head.startswith(b"% "):
        with path.open("rb") as file:
            first = file.read(1 << 13)
        is_table = tables.is_text(first) and not _PROPHESEE.search(first)
        return tables.read_text if is_table else None
    if head.startswith(tables.NUMPY_MAGIC):
        return tables.read_npy
    if head.startswith((b"PAR1", b"ARROW1\0\0")):
        return tables.read_parquet
    return tables.read_text if tables.is_text(head) else None


def _find_zip_reader(path: Path) -> Reader:
    from jaxevent.io import tables, text

    with reading(path), open_archive(path) as archive:
        names = archive.namelist()
        texts = text.find_event_texts(names)
        if texts and texts[0].rpartition("/")[2] != "events.txt":
            with archive.open(texts[0]) as file:
                texts = texts if _is_table(file.readline(_MAX_LINE_BYTES)) else []
    if texts:
        return text.read
    if names and all(name.endswith(".npy") for name in names):
        return tables.read_npz
    raise InputError(
        f"{path}: the zip holds neither events.txt nor .npy arrays; {_READABLE_FORMATS}"
    )


def _is_table(line: bytes) -> bool:
    """Return whether a line can begin a text of events: width and height, or numbers."""
    words = line.removeprefix(codecs.BOM_UTF8).split()
    return len(words) in (2, 4) and all(re.fullmatch(rb"[+-]?[\d.eE+-]+", word) for word in words)


def _is_hdf5_after_header(path: Path) -> bool:
    """Return whether HDF5 begins after 512, 1024, ... bytes of another header, as MATLAB's."""
    with reading(path), path.open("rb") as file:
        at = 512
        while file.seek(at) == at and (signature := file.read(len(_HDF5_MAGIC))):
            if signature == _HDF5_MAGIC:
                return True
            at *= 2
    return False


def _find_hdf5_reader(path: Path, options: ReadOptions) -> Reader:
    import h5py

    from jaxevent.io import hdf5, hdf5_files, hdf5_layouts

    with hdf5_files.open_file(path) as opened, reading(path):
        file: Any = opened
        events = file.get("events")
        is_ours = isinstance(events, h5py.Group) and {"t", "x", "y", "p"} <= set(events)
        is_ours |= str(hdf5_files.attribute(file, "format")) == "jaxevent"
        is_other = not is_ours and hdf5_layouts.is_known(file)
        held = "" if is_ours or is_other else hdf5_files.describe_datasets(file)
        with path.open("rb") as stored:  # MATLAB puts 512 bytes of its own before HDF5
            is_matlab = stored.read(6) == b"MATLAB"
    if is_other and not is_matlab:
        return hdf5_layouts.read
    options.refuse_stream(path)
    if is_matlab:
        from jaxevent.io import mat

        return mat.read_v73
    if is_ours:
        return hdf5.read
    raise InputError(
        f"{path}: the HDF5 file has neither events/t, x, y and p nor events under other known "
        f"names; it holds {held}; read its columns with h5py and give them to "
        "jaxevent.Recording.from_arrays(t, x, y, p, width=..., height=...)"
    )


__getattr__ = renamed_names(__name__)
