"""Images in files that any program can write: single ones, series with times, exposure stacks.

A series is a folder of PNG, JPEG, TIFF or .npy files, taken in the order of their names; or one
.npy file (images, height, width); or one HDF5 file of the datasets t and image, as `jaxevent
reconstruct` writes. Integers of 8 or 16 bits and floats are linear intensities. Timestamps are
lines "t", one per image, or "t name", or "start, end" of each exposure, as DSEC has them; where all
are whole numbers they are microseconds, otherwise seconds. The times of DSEC's images are found
where DSEC keeps them (https://dsec.ifi.uzh.ch/data-format): images/left/exposure_timestamps.txt, or
images/timestamps.txt, of images/left/rectified.

An exposure stack is a folder of PNG, JPEG or TIFF images of 8 bits of one still scene. Exposure
times (s) are in its file exposures.txt, lines "s name"; or in DSEC's file of the starts and ends of
exposures; or in the images' own EXIF data. The camera response that comes of a stack is CSV with
the columns grey, intensity and certainty: evenly spaced grey values from 0 to 1, the intensity of
each, which never falls, and its certainty, at most 1.

Colours become grey (ITU-R 601 luma). A Bayer pattern names the colours of the upper left 2 x 2
pixels, row by row: "RGGB".
"""

import contextlib
import dataclasses
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import LUMA_WEIGHTS, UNIT_NAMES, US_PER_UNIT, to_grey
from jaxevent.camera import TableResponse
from jaxevent.errors import InputError, InputWarning
from jaxevent.io.checks import check_unfolded, reading
from jaxevent.io.decoded import DecodedImages
from jaxevent.io.output import complete
from jaxevent.recording import microseconds
from jaxevent.time_units import unit_of_name

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
TIMESTAMP_FILES = ("timestamps.txt", "images.txt", "timestamp.txt")
STACK_EXPOSURES_FILE = "exposures.txt"
BAYER_PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")  # of a 2 x 2 cell, row by row
_DSEC_EXPOSURES = "*exposure_timestamps*.txt"
_DSEC_FOLDERS = ("rectified", "distorted")  # folders of images in DSEC's folder of a camera
_EXIF, _EXPOSURE_TIME = 0x8769, 0x829A  # tags
_DEEP_COLOUR = re.compile(r"\b(L|LA|RGB\w*|CMYK);16")  # Pillow's name of how pixels are stored


@dataclasses.dataclass(frozen=True)
class Series:
    """Images at sorted times, each read when needed.

    Attributes:
        t: (n,) times in us, the middle of the exposure where it is known.
        exposure: (n,) length of each image's exposure in us, 0 where unknown.
        read: Function from a row to the image (height, width).
        colour: Function from a row to the colours (height, width, 3) uint8, red first, or None of
            an image that is stored otherwise.
        files: All files of the series.
    """

    t: NDArray[np.int64]
    exposure: NDArray[np.int64]
    read: Callable[[int], NDArray[np.float64]]
    colour: Callable[[int], NDArray[np.uint8] | None]
    files: tuple[Path, ...]


@dataclasses.dataclass(frozen=True)
class Scale:
    """Map from stored values to linear intensity: (value / white) ** gamma.

    Attributes:
        white: Value of intensity 1; None takes the largest value of integers of 8 or 16 bits, and
            1 of floats.
        gamma: Exponent.
    """

    white: float | int | None = None
    gamma: float | int = 1.0

    def intensity(self, image: NDArray, source: str) -> NDArray[np.float64]:
        """Convert an image to intensity.

        Args:
            image: (height, width) or (height, width, channels) values as stored.
            source: Name of the image for messages.

        Returns:
            (height, width) linear intensity.

        Raises:
            InputError: The image is of another type or shape.
        """
        kind = image.dtype
        if kind not in (np.uint8, np.uint16) and kind.kind != "f" and self.white is None:
            raise InputError(f"{source}: holds {kind}; give white, the value of intensity 1")
        if image.ndim not in (2, 3) or kind.kind not in "iuf":
            raise InputError(
                f"{source}: is {kind} of shape {image.shape}; store numbers (height, width)"
            )
        white = self.white or (1.0 if kind.kind == "f" else float(np.iinfo(kind).max))
        intensity = image.astype(np.float64) / white
        if self.gamma != 1:
            intensity = np.maximum(intensity, 0) ** self.gamma
        if intensity.ndim == 3:
            if intensity.shape[2] not in (1, 3, 4):
                raise InputError(
                    f"{source}: has {intensity.shape[2]} channels; store grey or red, green, blue"
                )
            grey = intensity.shape[2] == 1
            intensity = intensity[..., 0] if grey else intensity[..., :3] @ LUMA_WEIGHTS
        return intensity


def is_series(path: Path) -> bool:
    """Return whether a file or folder holds images with times, not a recording."""
    import h5py

    from jaxevent.io import hdf5_files

    with reading(path):
        if path.is_dir():
            images = any(one.suffix.lower() in IMAGE_SUFFIXES for one in path.iterdir())
            return images and not (path / "events.txt").is_file()
        if not path.is_file() or not h5py.is_hdf5(path):
            return False
        with hdf5_files.open_file(path) as file:
            return {"t", "image"} <= set(file)


def read_series(
    images: Path,
    scale: Scale = Scale(),
    timestamps: Sequence[str] = TIMESTAMP_FILES,
    beside: Path | None = None,
) -> Series:
    """Read a series of images.

    Args:
        images: A folder or file that exists; see the text of this module.
        scale: Map from stored values to intensity.
        timestamps: Possible names of the file of times, in the folder of the images or `beside`.
        beside: Another folder in which the times may be.

    Returns:
        The series, whose images are read when needed.

    Raises:
        InputError: A file is missing or damaged, or times and images do not fit each other.
    """
    if images.is_file() and images.suffix.lower() != ".npy":
        return _read_hdf5_series(images, scale)
    place = images if images.is_dir() else images.parent
    times = _find_timestamps(place, beside, timestamps)
    (t, exposure), names = _read_stamps(times)
    if images.is_file():
        with reading(images):
            stack = np.load(images, mmap_mode="r", allow_pickle=False)
        _check_count(images, len(stack) if stack.ndim in (3, 4) else 0, times, len(t))
        return _make_series(
            (t, exposure), lambda row: stack[row], str(images), (images, times), scale
        )
    if names is None:
        files = sorted(p for p in images.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        _check_count(images, len(files), times, len(t))
    else:
        files = [images / name for name in names]
    return _make_series(
        (t, exposure), lambda row: _read_file(files[row]), str(images), (*files, times), scale
    )


def find_exposures(place: Path) -> Path | None:
    """Find the file of the starts and ends of exposures as DSEC names it, of a folder of images."""
    folders = [place, place.parent] if place.name in _DSEC_FOLDERS else [place]
    found = [path for folder in folders for path in sorted(folder.glob(_DSEC_EXPOSURES))]
    sides = [side for side in ("left", "right") if side in place.parts]
    of_side = [path for path in found if any(side in path.stem for side in sides)]
    chosen = of_side if len(found) > 1 else found
    return chosen[0] if len(chosen) == 1 else None


def _find_timestamps(place: Path, beside: Path | None, names: Sequence[str]) -> Path:
    folders = [place] if beside is None else [place, beside]
    if names is TIMESTAMP_FILES:
        if (exposures := find_exposures(place)) is not None:
            return exposures
        if place.name in _DSEC_FOLDERS:
            folders.append(place.parents[1])
    for path in (folder / name for name in names for folder in folders):
        if path.is_file():
            return path
    raise InputError(
        f"{place}: there is no {' or '.join(names)} with the images' times; add it or give "
        "timestamps"
    )


def _check_count(images: Path, found: int, times: Path, expected: int) -> None:
    if found != expected:
        raise InputError(
            f"{images}: holds {found} images, {times.name} {expected} times; there must be one "
            "time for each image"
        )


def _make_series(
    stamps: tuple[NDArray[np.int64], NDArray[np.int64]],
    stored: Callable[[int], NDArray],
    source: str,
    files: tuple[Path, ...],
    scale: Scale,
) -> Series:
    """Make a series of images with times.

    Args:
        stamps: (n,) times and (n,) exposures, us.
        stored: Function of the row that reads an image as it is stored.
        source: Name of the series, for messages.
        files: Files that it is read from.
        scale: Scale from stored values to intensity.

    Returns:
        The series.

    Raises:
        InputError: There are no images, or times are not in order.
    """
    t, exposure = stamps
    if not len(t):
        raise InputError(f"{source}: holds no images; give those of the recording")
    if (t[1:] < t[:-1]).any():
        row = int(np.argmax(t[1:] < t[:-1])) + 1
        raise InputError(
            f"{source}: image {row} at {t[row]} us is earlier than the one before it; sort "
            "images and times"
        )

    def image(row: int) -> NDArray:
        with reading(f"{source}: image {row}"):
            return np.asarray(stored(row))

    def colour(row: int) -> NDArray[np.uint8] | None:
        found = image(row)
        is_colour = found.dtype == np.uint8 and found.ndim == 3 and found.shape[2] in (3, 4)
        return found[..., :3] if is_colour else None

    def read(row: int) -> NDArray[np.float64]:
        return scale.intensity(image(row), f"{source}: image {row}")

    return Series(t, exposure, read, colour, files)


def _read_hdf5_series(path: Path, scale: Scale) -> Series:
    from jaxevent.io import hdf5_files

    file = hdf5_files.open_file(path)
    if not {"t", "image"} <= set(file):
        raise InputError(
            f"{path}: has no datasets t and image; store t (images,) and image (images, "
            "height, width)"
        )
    stored, t = (hdf5_files.dataset(file, name, str(path)) for name in ("image", "t"))
    if t.ndim != 1 or stored.ndim not in (3, 4) or len(t) != len(stored):
        raise InputError(
            f"{path}: image has the shape {stored.shape} and t {t.shape}; store one time for "
            "each image"
        )
    times = microseconds(t[()], f"{path}: the times t")
    return _make_series(
        (times, np.zeros_like(times)), lambda row: stored[row], str(path), (path,), scale
    )


def _read_file(path: Path) -> NDArray:
    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False)
    return read_image(path, str(path))


def read_image(file: Any, source: str) -> NDArray:
    """Read an image with Pillow.

    Args:
        file: A path, or an open file.
        source: Name of the file for messages.

    Returns:
        The image as stored: (height, width), in colour (height, width, 3), red first, and with
        transparency (height, width, 4). Values are uint8, uint16 or float32; whole numbers of 32
        bits become uint16.

    Raises:
        InputError: A value would not be kept: the file holds colours of 16 bits, numbers outside 0
            to 65535, or several images.
    """
    from PIL import Image

    with Image.open(file) as image:
        if getattr(image, "n_frames", 1) > 1:
            raise InputError(f"{source}: holds several images; store each as a file of its own")
        if any(_DEEP_COLOUR.search(str(tile[3])) for tile in image.tile):
            raise InputError(
                f"{source}: holds colours of 16 bits, of which Pillow reads 8; store it as 16-bit "
                "grey or 8-bit colours"
            )
        if image.mode == "F":
            return np.asarray(image)
        if image.mode.startswith("I"):
            values = np.asarray(image)
            if values.size and not 0 <= values.min() <= values.max() <= 65535:
                raise InputError(
                    f"{source}: holds values from {values.min()} to {values.max()}; store 8 or 16 "
                    "bits, or floats in [0, 1]"
                )
            return values.astype(np.uint16)
        if image.mode in ("1", "LA"):
            return np.asarray(image.convert("L"))
        return np.asarray(image if image.mode in ("L", "RGB", "RGBA") else image.convert("RGB"))


def gather_frames(
    images: Iterable[NDArray],
    decode: Callable[[int], Iterable[NDArray]],
    label: Callable[[int], str],
    source: str,
    in_memory: bool,
) -> tuple[NDArray | DecodedImages | None, dict[str, Any]]:
    """Check the frames of a file once, and convert colours to grey.

    Args:
        images: First pass over all images, each (height, width), or in colour (height, width, 3)
            with red first.
        decode: Decoder for later passes: `decode(i)` yields the images from number i on.
        label: Function from the number of an image to its name for messages.
        source: Name of the file for messages.
        in_memory: False leaves the images in their file.

    Returns:
        Grey images (n, height, width), None if there are none, and the entry of `Recording.extra`
        for the colours of coloured ones.

    Raises:
        InputError: An image has another size or type than the first.
    """
    grey: list[NDArray] = []
    colours: list[NDArray | None] = []
    first: tuple[Any, Any] = ((0, 0), None)
    count, are_colours, differ = 0, True, False
    for image in images:
        is_colour = image.ndim == 3 and image.dtype == np.uint8
        are_colours &= is_colour
        differ |= is_colour and bool((image != image[..., :1]).any())
        kind = (image.shape[:2], image.dtype)
        first = first if count else kind
        if kind != first:
            (height, width), dtype = first
            raise InputError(
                f"{label(count)} is {image.shape[1]}x{image.shape[0]} {image.dtype} but the first "
                f"image is {width}x{height} {dtype}; all images must have the sensor's size and "
                "one depth"
            )
        if in_memory:
            grey.append(to_grey(image))
            colours.append(image if is_colour else None)
        count += 1
    if not count:
        return None, {}
    if in_memory:
        return np.stack(grey), kept_colours(colours)
    shape = (count, *first[0])
    rgb = DecodedImages(decode, (*shape, 3), np.dtype(np.uint8), source)
    left = DecodedImages(lambda row: map(to_grey, decode(row)), shape, first[1], source)
    return left, {"rgb": rgb} if are_colours and differ else {}


def read_files(
    files: Sequence[Path], source: str, in_memory: bool
) -> tuple[NDArray | DecodedImages | None, dict[str, Any]]:
    """Read frames in files of their own, each checked once.

    Args:
        files: Files in the order of the images.
        source: Name of the folder for messages.
        in_memory: False leaves the images in their files.

    Returns:
        Grey images (n, height, width), and the entry of `Recording.extra` for colours.

    Raises:
        InputError: An image cannot be read, or has another size or type than the first.
    """

    def decode(row: int) -> Iterator[NDArray]:
        stored = unfolded = 0
        for file in files[row:]:
            with reading(file):
                image = drop_alpha(read_image(file, str(file)))
            stored, unfolded = stored + file.stat().st_size, unfolded + image.nbytes
            check_unfolded(unfolded, stored, source)
            yield image

    return gather_frames(decode(0), decode, lambda n: f"{files[n]}:", source, in_memory)


def drop_alpha(image: NDArray) -> NDArray:
    """Return an image without its transparency."""
    return image if image.ndim == 2 else image[..., :3]


def kept_colours(images: Sequence[NDArray[np.uint8] | None]) -> dict[str, NDArray[np.uint8]]:
    """Return the entry of `Recording.extra` for colours; empty if one frame is grey, or all are."""
    colours = [one for one in images if one is not None]
    if not colours or len(colours) < len(images):
        return {}
    differ = any((one != one[..., :1]).any() for one in colours)
    return {"rgb": np.stack(colours)} if differ else {}


def read_intensity(path: Path) -> NDArray[np.float32]:
    """Read an image of linear intensity (height, width), .npy or TIFF of floats, NaN: unknown."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; correct the path")
    with reading(path):
        image = _read_file(path)
    if image.ndim != 2 or image.dtype.kind != "f":
        raise InputError(
            f"{path}: is {image.dtype} of shape {image.shape}; store floats (height, width), as "
            "`jaxevent camera merge` does"
        )
    return image.astype(np.float32)


def write_intensity(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image of linear intensity, completely or not at all.

    Args:
        path: File to write, .npy or .tif.
        image: (height, width) intensity.

    Raises:
        InputError: The name has another ending, or the file cannot be written.
    """
    from PIL import Image

    if path.suffix.lower() not in (".npy", ".tif", ".tiff"):
        raise InputError(f"{path}: an image of intensity is .npy or .tif; end the name so")
    with complete(path) as partial:
        if path.suffix.lower() == ".npy":
            with partial.open("wb") as file:
                np.save(file, image)
        else:
            Image.fromarray(image).save(partial, format="TIFF")


def _read_stamps(
    path: Path,
) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], list[str] | None]:
    """Read times and exposures (us) of lines "t", "t name" or "start, end", and the names."""
    lines = [re.split(r"\s*[,;]\s*|\s+", line.strip(), maxsplit=1) for line in _read_lines(path)]
    if len({len(words) for words in lines}) > 1:
        raise InputError(f"{path}: some lines have a name and some have none; give all or none")
    remedy = "give lines 't', 't name' or 'start, end'"
    firsts = [words[0] for words in lines]
    names = [words[1].strip() for words in lines] if lines and len(lines[0]) == 2 else None
    if names is None or not all(re.fullmatch(r"[+-]?[\d.eE+-]+", name) for name in names):
        times = _parse_times(path, firsts, remedy)
        return (times, np.zeros_like(times)), names
    both = _parse_times(path, firsts + names, remedy)
    start, end = both[: len(firsts)], both[len(firsts) :]
    if (end < start).any() or (end[:-1] > start[1:]).any():
        raise InputError(
            f"{path}: has two columns of numbers; keep the times only, or the start and the end of "
            "each exposure, which end before the next one starts"
        )
    return (start + (end - start) // 2, end - start), None


def read_exposures(place: Path) -> NDArray[np.int64] | None:
    """Read the exposures (us) of a folder's images, in the order of their names.

    Returns None where no file of times has the starts and ends of exposures.
    """
    path = find_exposures(place) or place / TIMESTAMP_FILES[0]
    if not path.is_file():
        return None
    with contextlib.suppress(InputError):  # of a file that holds something else
        exposure = _read_stamps(path)[0][1]
        return exposure if exposure.any() else None
    return None


def read_times(path: Path, span: tuple[int, int] | None = None) -> NDArray[np.int64]:
    """Read the times of a text file, sorted: a time in each line, or a table with a column t.

    A name that is no file but numbers with commas between them, as "0.65,0.66", are the times.

    Columns are separated by commas, semicolons or spaces, and the first line names them, t with a
    unit or without (t_ns); without names the times are the first column. Without a unit whole
    numbers are microseconds, others seconds, unless few of them then lie in the recording and all
    of them in another unit. Lines that begin with # do not count.

    Args:
        path: The file.
        span: First and last time of the recording in us.

    Returns:
        (n,) int64 us.

    Raises:
        InputError: The file holds something else.
    """
    if re.fullmatch(r"[\d.e+-]+(,[\d.e+-]+)*", str(path)) and not path.exists():
        source = str(path).split(",")
    else:
        source = _read_lines(path)
    lines = [re.sub(r"\s+(?=[\[(])", "", line.strip()) for line in source]
    rows = [re.split(r"\s*[,;]\s*|\s+", line) for line in lines]
    column, unit = 0, None
    if rows and not re.match(r"[+-]?\.?\d", rows[0][0]):
        names = rows.pop(0)
        named = [name for name in names if name == "t"] or [n for n in names if unit_of_name(n)]
        if not named:
            raise InputError(f"{path}: has no column t but {', '.join(names)[:80]}; add it")
        column, unit = names.index(named[0]), unit_of_name(named[0])
    if not rows:
        raise InputError(f"{path}: holds no times; give one in each line")
    words = [row[column] if column < len(row) else "" for row in rows]
    remedy = "give a time in each line, or a table with a column t"
    times = _parse_times(path, words, remedy, unit)
    if span is not None and unit is None:
        times = _choose_unit_inside(path, words, remedy, times, span)
    if (times[1:] < times[:-1]).any():
        row = int(np.argmax(times[1:] < times[:-1])) + 1
        raise InputError(f"{path}: time {row}, {words[row]}, is before the one above it; sort them")
    return times


def _choose_unit_inside(
    path: Path, words: Sequence[str], remedy: str, times: NDArray[np.int64], span: tuple[int, int]
) -> NDArray[np.int64]:
    """Parse times in their usual unit, or in the only one that puts them in the recording.

    Args:
        path: The file, for messages.
        words: Texts of the times.
        remedy: Advice for texts that are no times, for messages.
        times: (n,) times in the usual unit, us.
        span: Start and stop of the recording, us.

    Returns:
        (n,) times, us.
    """

    def share(t: NDArray[np.int64]) -> float:
        return float(np.mean((t >= span[0]) & (t <= span[1])))

    if share(times) >= 0.5:
        return times
    fitting = {}
    for unit in US_PER_UNIT:
        with contextlib.suppress(InputError):
            t = _parse_times(path, words, remedy, unit)
            if share(t) == 1 and 10 * (t.max() - t.min()) >= span[1] - span[0]:
                fitting[unit] = t
    if len(fitting) != 1:
        return times
    unit, t = next(iter(fitting.items()))
    warnings.warn(
        f"{path}: the times are taken as {UNIT_NAMES[unit]}, since they lie in the recording then; "
        f"name the column t_{unit} to be sure",
        InputWarning,
        stacklevel=3,
    )
    return t


def _read_lines(path: Path) -> list[str]:
    """Read the lines of a text file that are neither empty nor comments."""
    with reading(path):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _parse_times(
    path: Path, words: Sequence[str], remedy: str, unit: str | None = None
) -> NDArray[np.int64]:
    """Parse times in us; without a unit they are us if all are whole numbers, else seconds."""
    whole = all(re.fullmatch(r"[+-]?\d+", word) for word in words)
    scale = Fraction(US_PER_UNIT[unit or ("us" if whole else "s")]).limit_denominator(1000)
    times: list[int] = []
    for number, word in enumerate(words):
        value: Any = math.nan
        with contextlib.suppress(ValueError):
            value = int(word) * scale if whole else float(word) * float(scale)
        if not abs(value) < 9e18:
            raise InputError(
                f"{path}: line {number} of numbers starts with {word[:20]!r}, not a time; {remedy}"
            )
        times.append(round(value))
    return np.array(times, np.int64)


def read_stack(
    folder: Path, exposures: Sequence[float | int] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Read an exposure stack.

    Args:
        folder: The folder of the images.
        exposures: (n,) exposure times in s in the order of the images' names; None takes those
            that the folder states.

    Returns:
        Images (n, height, width) and exposure times (n,) in s.

    Raises:
        InputError: An image cannot be used, or exposure times are missing or not positive.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give the folder of the images")
    names: list[str] | None = None
    if exposures is None and (folder / STACK_EXPOSURES_FILE).is_file():
        exposures, names = _read_exposure_list(folder / STACK_EXPOSURES_FILE)
    elif exposures is None and (lengths := read_exposures(folder)) is not None:
        exposures = (lengths * 1e-6).tolist()
    files = sorted(one for one in folder.iterdir() if one.suffix.lower() in IMAGE_SUFFIXES)
    files = files if names is None else [folder / name for name in names]
    if not files:
        raise InputError(f"{folder}: holds no images; give those of one scene")
    images = []
    for file in files:
        with reading(file):
            image = to_grey(drop_alpha(read_image(file, str(file))))
        if image.dtype != np.uint8 or image.shape != np.shape(images[0] if images else image):
            raise InputError(
                f"{file}: is {image.dtype} of {image.shape[1]}x{image.shape[0]} pixels; store all "
                "images with 8 bits and in one size"
            )
        images.append(image)
    if exposures is None:
        exposures = [_exif_exposure(file) for file in files]
    if len(exposures) != len(files):
        raise InputError(
            f"{folder}: holds {len(files)} images, but {len(exposures)} exposure times are given; "
            "give one for each, in the order of their names"
        )
    seconds = np.asarray(exposures, np.float64)
    if not (np.isfinite(seconds) & (seconds > 0)).all():
        raise InputError(f"{folder}: exposure times must be positive, not {seconds.tolist()}")
    return np.stack(images), seconds


def _read_exposure_list(path: Path) -> tuple[list[float], list[str]]:
    seconds, names = [], []
    with reading(path):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        time, _, name = line.strip().partition(" ")
        try:
            seconds.append(float(time))
        except ValueError:
            time = ""
        if not time or not (path.parent / name.strip()).is_file() or not name.strip():
            raise InputError(f"{path}: line {number} is {line[:60]!r}; give lines 's name'")
        names.append(name.strip())
    return seconds, names


def _exif_exposure(file: Path) -> float:
    """Read the exposure time (s) of an image's EXIF data."""
    from PIL import Image

    with reading(file), Image.open(file) as image:
        value = image.getexif().get_ifd(_EXIF).get(_EXPOSURE_TIME)
    if value is None:
        raise InputError(
            f"{file}: does not state its exposure time; give --exposures, or "
            f"{STACK_EXPOSURES_FILE} of lines 's name' beside the images"
        )
    return float(value)


def write_response(path: Path, response: TableResponse) -> None:
    """Write a camera response as CSV, completely or not at all.

    Args:
        path: File to write.
        response: The response.
    """
    greys = np.linspace(0, 1, len(response.levels))
    table = np.stack([greys, np.asarray(response.levels), np.asarray(response.weights)], 1)
    with complete(path) as partial:
        np.savetxt(partial, table, "%.9g", ",", header="grey,intensity,certainty", comments="")


def read_response(path: Path) -> TableResponse:
    """Read a camera response from CSV; raises `InputError` for other files."""
    with reading(path):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    wanted = "grey,intensity,certainty"
    if not lines or lines[0].replace(" ", "") != wanted:
        raise InputError(f"{path}: the first line is not '{wanted}'; give a response's CSV")
    try:
        table = np.array([[float(one) for one in line.split(",")] for line in lines[1:] if line])
    except ValueError:
        raise InputError(f"{path}: holds a line that is not three numbers; mend it") from None
    even = table.ndim == 2 and table.shape[1] == 3
    if not even or not np.allclose(table[:, 0], np.linspace(0, 1, len(table)), 0, 1e-6):
        raise InputError(f"{path}: the grey values are not evenly spaced from 0 to 1; mend them")
    try:
        return TableResponse(table[:, 1], table[:, 2])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def bayer_sites(pattern: str) -> dict[str, tuple[int, int]]:
    """Return the row and column of R, G1, G2 and B in the 2 x 2 cell of a Bayer pattern.

    G1 is the first green, row by row. Raises `InputError` for other patterns.
    """
    if pattern not in BAYER_PATTERNS:
        raise InputError(
            f"the colour pattern {pattern!r} is not one of {', '.join(BAYER_PATTERNS)}; other "
            "patterns cannot be split"
        )
    greens = iter(("G1", "G2"))
    names = [next(greens) if letter == "G" else letter for letter in pattern]
    found = {name: divmod(place, 2) for place, name in enumerate(names)}
    return {name: found[name] for name in ("R", "G1", "G2", "B")}


def demosaic(mosaic: NDArray, pattern: str) -> NDArray[np.floating]:
    """Interpolate the colours of raw images bilinearly.

    A colour keeps its values at its sites. Elsewhere it is the mean of its 2 or 4 nearest sites, at
    the border of those that exist.

    Args:
        mosaic: (n, height, width) raw images.
        pattern: Bayer pattern, as "RGGB".

    Returns:
        (n, height, width, 3) colours, red first, floats of the precision of `mosaic`, at least 32
        bits.

    Raises:
        InputError: The pattern is not one of `BAYER_PATTERNS`.
    """
    import scipy.ndimage  # slow to import

    places = bayer_sites(pattern)
    shape, dtype = mosaic.shape, np.result_type(np.float32, mosaic)
    out = np.empty((*shape, 3), dtype)
    cross = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype)
    square = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype)
    for axis, (names, kernel) in enumerate(
        ((("R",), square), (("G1", "G2"), cross), (("B",), square))
    ):
        known = np.zeros(shape[1:], dtype)
        for name in names:
            row, column = places[name]
            known[row::2, column::2] = 1
        weights = scipy.ndimage.convolve(known, kernel, mode="constant")
        total = scipy.ndimage.convolve(mosaic * known, kernel[None], mode="constant")
        out[..., axis] = total / weights
    return out
