"""Choices of a caller, checks of what a file holds, and files beside it, for all readers.

The readers turn raw numbers of a file into fields of a recording by these functions, so that all
accept the same values and word their errors alike.
"""

import contextlib
import dataclasses
import re
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent import arrays
from jaxevent.camera import LENS_MODELS, PinholeCamera, find_model
from jaxevent.errors import InputError
from jaxevent.recording import Events, ImageSource

GRAVITY_M_S2 = 9.80665  # m/s^2, standard gravity
_ALLOWED_UNFOLDED_BYTES = 1 << 27  # of arrays that every file may unfold to
_MAX_COMPRESSION_RATIO = 100  # times its own bytes that a larger file may unfold to
_TRUTH_ENDINGS = {"_data.hdf5": ("_gt.hdf5",), "_data.h5": ("_pose_gt.h5", "_depth_gt.h5")}
_COUNT_WORDS = {8: "eight", 9: "nine", 12: "twelve"}  # of the numbers of a camera


@dataclasses.dataclass(frozen=True)
class ReadOptions:
    """Options of `jaxevent.io.load`, as readers get them.

    Attributes:
        size: (width, height) in pixels; None takes the size that the file states.
        in_memory: False leaves events and images in the file.
        progress: Whether to show a progress bar; None shows one on a terminal.
        stream: Name of the camera whose events are read; None where the file holds one.
        frames: Name of the images that become the frames; None lets the reader choose.
        without_frames: Whether frames are left out.
        without_events: Whether events are left out; frames are then those of a camera of its own.
        time_unit: Unit of the event times, "s", "ms", "us" or "ns"; None infers it.
        repair: Repairs of event times that go back; None refuses them.
        notes: Remarks that readers add, for `Recording.notes`.
    """

    size: tuple[int, int] | None = None
    in_memory: bool = True
    progress: bool | None = None
    stream: str | None = None
    frames: str | None = None
    time_unit: str | None = None
    repair: str | None = None
    without_frames: bool = False
    without_events: bool = False
    notes: list[str] = dataclasses.field(default_factory=list, compare=False)

    def refuse_stream(self, path: Path) -> None:
        """Raise `InputError` if a camera is named, for a file that holds only one."""
        if self.stream is not None:
            raise InputError(f"{path}: holds one camera only; leave out stream= or --stream")

    def refuse_time_unit(self, path: Path) -> None:
        """Raise `InputError` if a unit of time is given, for a format that states its unit."""
        if self.time_unit is not None:
            raise InputError(
                f"{path}: this format states the unit of its times; leave out time_unit= or "
                "--time-unit"
            )

    def choose_stream(
        self, path: Path, what: str, names: Sequence[str], described: Sequence[str] = ()
    ) -> str | None:
        """Choose the camera of a file that may hold several.

        Args:
            path: The file.
            what: Words of the format for a camera, as "topic of events", for messages.
            names: Names of the cameras in the file.
            described: Longer names for the message, (n,) as `names`.

        Returns:
            One of `names`; None where there is none.

        Raises:
            InputError: There are several cameras and none is named, or none of that name.
        """
        if self.stream is not None and self.stream not in names:
            noun, _, rest = what.partition(" ")
            raise InputError(
                f"{path}: has no {what} {self.stream!r}; its {f'{noun}s {rest}'.strip()} are "
                f"{', '.join(names) or 'none'}"
            )
        if self.stream is None and len(names) > 1 and not self.without_events:
            raise InputError(
                f"{path}: holds the events of {len(names)} cameras, "
                f"{', '.join(described or names)}; choose one with stream=, or with jaxevent "
                "convert --stream"
            )
        return self.stream or next(iter(names), None)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the path before the message of an `InputError`, in place of the recording's name."""
    try:
        yield
    except InputError as error:
        if type(error) is not InputError or str(path) in str(error):
            raise
        message = str(error)
        for name in (path.name, path.stem):
            message = message.removeprefix(f"{name}: ")
        raise InputError(f"{path}: {message}") from error


@contextlib.contextmanager
def reading(source: object) -> Iterator[None]:
    """Turn any exception of a parser of bad files into an `InputError` naming `source`.

    The parsers behind this (zipfile, zlib, Pillow, scipy, h5py) document no common exception.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            place = "" if str(error.filename) in str(source) else f": {error.filename}"
            raise InputError(
                f"{source}: cannot be read ({error.strerror}{place}); check the path"
            ) from error
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = reason if len(reason) < 200 else reason[:200] + "..."
        raise InputError(
            f"{source}: cannot be read ({reason}); the file is damaged, incomplete or not "
            "permitted, so fetch it again or check its permissions"
        ) from error


def damaged(what: str) -> InputError:
    """Return the error to raise for a fault of a file, which `what` describes with its place."""
    return InputError(f"{what}; the file was cut off or is damaged, so fetch it again")


def max_unfolded(stored_bytes: int) -> int:
    """Return the number of bytes of arrays that `stored_bytes` bytes of a file may unfold to."""
    return max(_ALLOWED_UNFOLDED_BYTES, _MAX_COMPRESSION_RATIO * stored_bytes)


def check_unfolded(unfolded_bytes: int, stored_bytes: int, source: object) -> None:
    """Raise `InputError` if a file claims to hold far more bytes of arrays than it can.

    Memory stays bounded by what a file holds: real events and images compress less than 20 times.

    Args:
        unfolded_bytes: Number of bytes that the arrays take in memory.
        stored_bytes: Number of bytes of the file.
        source: Name of the file for messages.
    """
    if unfolded_bytes > max_unfolded(stored_bytes):
        raise InputError(
            f"{source}: {stored_bytes:,} bytes of the file claim to hold {unfolded_bytes:,}, over "
            f"{_MAX_COMPRESSION_RATIO} times as many; it is damaged or not a recording, else store "
            "it with less compression"
        )


def check_whole_records(
    path: Path, n_bytes: int, record_bytes: int, what: str = "a record"
) -> None:
    """Check that the bytes of a file are whole records.

    Args:
        path: The file.
        n_bytes: Number of its bytes that hold records.
        record_bytes: Number of bytes of a record.
        what: Words for a record, for the message.

    Raises:
        InputError: The last record is cut off.
    """
    if rest := n_bytes % record_bytes:
        raise InputError(
            f"{path}: ends inside {what}, {rest} bytes after the last whole one of {record_bytes} "
            "bytes; the recording was cut off, so fetch it again or drop these bytes: truncate -s "
            f"-{rest} FILE"
        )


def open_archive(file: Path) -> zipfile.ZipFile:
    """Open a zip archive, or raise `InputError` if it claims to hold far more than it can."""
    archive = zipfile.ZipFile(file)
    unfolded = sum(member.file_size for member in archive.infolist())
    check_unfolded(unfolded, file.stat().st_size, file)
    return archive


def check_events(
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
    """Check the columns of a file and make events of them.

    Args:
        t: (events,) times in us, int64.
        x: (events,) columns in px.
        y: (events,) rows in px.
        p: (events,) polarities, bool, 0/1 or -1/1.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        first_row: Row of the first event in the file.
        origin: Number of the first column and row of the sensor, 0 or 1.

    Returns:
        The events.

    Raises:
        InputError: An event is not valid; the message names the first.
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


def make_camera(values: NDArray, source: str, model: str = "radtan") -> PinholeCamera:
    """Make the camera of a list of numbers.

    Args:
        values: fx fy cx cy in px, and the coefficients of the lens, as k1 k2 p1 p2 k3.
        source: Name of the file for messages.
        model: Name of the lens model, see `jaxevent.camera`.

    Returns:
        The camera.

    Raises:
        InputError: The number of values is another, the model is unknown, or they are not possible.
    """
    found = find_model(model)
    if found is None:
        raise InputError(f"{source}: {_unsupported_lens(model)}")
    values, names = np.ravel(values), LENS_MODELS[found].coefficients
    count = 4 + len(names)
    if values.shape != (count,) or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InputError(
            f"{source}: the calibration must be {_COUNT_WORDS[count]} finite numbers, fx fy cx cy "
            f"{' '.join(names)}"
        )
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    try:
        return PinholeCamera(fx, fy, cx, cy, tuple(distortion), found)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _unsupported_lens(model: str) -> str:
    return (
        f"the calibration has the lens model {model[:40]!r}, which is not supported; supported are "
        f"{', '.join(LENS_MODELS)}"
    )


def make_supported_camera(
    intrinsics: NDArray, model: str, coefficients: NDArray, source: str
) -> tuple[PinholeCamera | None, dict[str, str]]:
    """Make the camera of a calibration, or explain that its lens is not supported.

    Args:
        intrinsics: fx, fy, cx and cy in px.
        model: Name of the lens model; "plumb_bob" of eight coefficients is rational.
        coefficients: Coefficients of the lens; missing ones are 0.
        source: Name of the file for messages.

    Returns:
        The camera or None, and the entry of `Recording.left_out`.

    Raises:
        InputError: The numbers are not valid.
    """
    found, k = find_model(model), np.ravel(coefficients)
    if found == "radtan" and len(k) == len(LENS_MODELS["rational"].coefficients):
        found = "rational"
    if found is None:
        return None, {"camera": f"{source}: {_unsupported_lens(model)}"}
    count = len(LENS_MODELS[found].coefficients)
    if np.any(k[count:]):
        return None, {
            "camera": f"{source}: the calibration has {len(k)} coefficients of the lens model "
            f"{model[:40]!r}, of which {count} are supported"
        }
    k = np.concatenate([k[:count], np.zeros(max(0, count - len(k)))])
    fx, fy = np.ravel(intrinsics)[:2]
    if fx <= 0 or fy <= 0:
        why = f"{source}: holds no calibration, but the focal lengths {fx:g} and {fy:g} px"
        return None, {"camera": why}
    return make_camera(np.concatenate([np.ravel(intrinsics), k]), source, found), {}


def whole_number(value: Any, source: object, what: str) -> int:
    """Return one number of a file as an int.

    Args:
        value: The number, or an array of one.
        source: Name of the file for messages.
        what: Name of the number for messages.

    Returns:
        The number.

    Raises:
        InputError: The value is not one whole number below 2^62.
    """
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


def whole_size(width: Any, height: Any, source: object) -> tuple[int, int]:
    """Return the sensor's size of a file as whole numbers.

    Args:
        width: Width in px, a number or an array of one.
        height: Height in px.
        source: Name of the file for messages.

    Returns:
        (width, height).

    Raises:
        InputError: A side is no whole number.
    """
    with reading(source):
        return whole_number(width, source, "width"), whole_number(height, source, "height")


def image_size(images: ImageSource | NDArray | None) -> tuple[int, int] | None:
    """Return (width, height) of images (n, height, width); None of none."""
    return None if images is None else (images.shape[2], images.shape[1])


def sensor_size(otherwise: str, *sizes: tuple[int, int] | None) -> tuple[int, int]:
    """Return the first size that is known.

    Args:
        otherwise: First part of the error, as "FILE: no image shows the sensor's size".
        *sizes: (width, height) in px each, or None.

    Returns:
        (width, height) in px.

    Raises:
        InputError: No size is known.
    """
    for size in sizes:
        if size is not None:
            return size
    raise InputError(f"{otherwise}; give size=(width, height) or --size")


def companions(path: Path) -> list[Path]:
    """Find the files beside a recording's: ground truth, triggers, and DSEC's rectifying map."""
    found = truth_files(path)
    for other in (trigger_file(path), rectify_map_file(path)):
        found += [] if other is None else [other]
    return found


def truth_files(path: Path) -> list[Path]:
    """Find the files of ground truth that exist."""
    found = []
    for end, others in _TRUTH_ENDINGS.items():
        if path.name.endswith(end):
            found += [path.with_name(path.name.removesuffix(end) + other) for other in others]
    found += [folder / stamps for folder, stamps in _truth_folders(path)]
    return [file for file in found if file.is_file()]


def _truth_folders(path: Path) -> list[tuple[Path, str]]:
    """Find the folders of ground truth of DSEC's left camera, and the names of their times."""
    if path.name != "events.h5":
        return []
    if path.parts[-3:-1] == ("events", "left"):
        sequence = path.parents[2]
    elif path.parent.name == "events_left":
        sequence = path.parents[1]
    else:
        return []
    found = []
    for kind, apart, stamps in (
        ("flow", "train_optical_flow", "forward_timestamps.txt"),
        ("disparity", "train_disparity", "timestamps.txt"),
    ):
        places = [place / kind for place in (sequence, sequence.parents[1] / apart / sequence.name)]
        found += [(place, stamps) for place in places if place.is_dir()][:1]
    return found


def trigger_file(path: Path) -> Path | None:
    """Find the triggers NAME_trigger.dat of Prophesee's events NAME_cd.dat or NAME_td.dat."""
    name = re.sub(r"_(cd|td)(\.dat)$", r"_trigger\2", path.name, flags=re.IGNORECASE)
    return _existing(path, name)


def rectify_map_file(path: Path) -> Path | None:
    """Find the file of the places of a DSEC camera's pixels in the rectified image."""
    return _existing(path, "rectify_map.h5") if path.suffix in (".h5", ".hdf5") else None


def images_folder(path: Path) -> Path | None:
    """Find the folder of the images of DSEC's frame camera beside the events in `path`."""
    if path.name != "events.h5" or path.parts[-3:-2] != ("events",):
        return None
    folder = path.parents[2] / "images" / path.parent.name
    return next((one for one in (folder / "rectified", folder) if one.is_dir()), None)


def _existing(path: Path, name: str) -> Path | None:
    other = path.parent / name
    return other if name != path.name and other.is_file() else None
