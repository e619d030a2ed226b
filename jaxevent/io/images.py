"""Series of images with times, stored as files that any program can write.

A series is a folder of PNG, JPEG, TIFF or .npy files, taken in the order of their names; or one
.npy file (images, height, width); or one HDF5 file of the datasets t and image, as `jaxevent
reconstruct` writes. Integers of 8 or 16 bits and floats are linear intensities. Colours become grey
(ITU-R 601 luma). Timestamps are lines "t", one per image, or "t name", or "start, end" of each
exposure, as DSEC has them; where all are whole numbers they are microseconds, otherwise seconds.
The times of DSEC's images are found where DSEC keeps them (https://dsec.ifi.uzh.ch/data-format):
images/left/exposure_timestamps.txt, or images/timestamps.txt, of images/left/rectified.
"""

import contextlib
import dataclasses
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import LUMA, SCALES
from jaxevent.errors import InputError, InputWarning
from jaxevent.io import check_unfolded, reading
from jaxevent.io.decoded import DecodedImages
from jaxevent.io.output import complete
from jaxevent.io.time_units import NAMES, unit_of_name
from jaxevent.recording import microseconds

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
TIMES = ("timestamps.txt", "images.txt", "timestamp.txt")
_EXPOSURES = "*exposure_timestamps*.txt"
_INNER = ("rectified", "distorted")  # folders of images in DSEC's folder of a camera
_DEEP_COLOUR = re.compile(r"\b(L|LA|RGB\w*|CMYK);16")  # Pillow's name of how pixels are stored


@dataclasses.dataclass(frozen=True)
class Series:
    """Images at sorted times (us), each read when asked for: `read(row)` is (height, width).

    `exposure` is the length of each image's exposure in us, 0 where unknown; `t` is its middle
    where it is known. `colour(row)` is (height, width, 3) uint8, red first, or None of an image
    that is stored otherwise.
    """

    t: NDArray[np.int64]
    exposure: NDArray[np.int64]
    read: Callable[[int], NDArray[np.float64]]
    colour: Callable[[int], NDArray[np.uint8] | None]
    files: tuple[Path, ...]  # that hold all this


@dataclasses.dataclass(frozen=True)
class Scale:
    """Stored values as linear intensity: (value / white) ** gamma.

    `white` None: the largest value of integers of 8 or 16 bits, 1 of floats.
    """

    white: float | int | None = None
    gamma: float | int = 1.0

    def intensity(self, image: NDArray, source: str) -> NDArray[np.float64]:
        """An image as stored, grey (height, width); raises `InputError` naming the `source`."""
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
            intensity = intensity[..., 0] if grey else intensity[..., :3] @ LUMA
        return intensity


def is_series(path: Path) -> bool:
    """Whether these are images with times, not a recording."""
    import h5py

    from jaxevent.io import hdf5_files

    with reading(str(path)):
        if path.is_dir():
            images = any(one.suffix.lower() in SUFFIXES for one in path.iterdir())
            return images and not (path / "events.txt").is_file()
        if not path.is_file() or not h5py.is_hdf5(path):
            return False
        with hdf5_files.open_file(path) as file:
            return {"t", "image"} <= set(file)


def read_series(
    images: Path,
    scale: Scale = Scale(),
    timestamps: Sequence[str] = TIMES,
    beside: Path | None = None,
) -> Series:
    """The images of a folder or file that exists; see the text of this module.

    `timestamps` are names of the file of times, the first that there is in the folder of the images
    or else in the folder `beside`. Raises `InputError` naming what is wrong.
    """
    if images.is_file() and images.suffix.lower() != ".npy":
        return _of_hdf5(images, scale)
    place = images if images.is_dir() else images.parent
    times = _find_timestamps(place, beside, timestamps)
    (t, exposure), names = _times(times)
    if images.is_file():
        with reading(str(images)):
            stack = np.load(images, mmap_mode="r", allow_pickle=False)
        _check_count(images, len(stack) if stack.ndim in (3, 4) else 0, times, len(t))
        return _series(t, exposure, lambda row: stack[row], str(images), (images, times), scale)
    if names is None:
        files = sorted(p for p in images.iterdir() if p.suffix.lower() in SUFFIXES)
        _check_count(images, len(files), times, len(t))
    else:
        files = [images / name for name in names]
    return _series(t, exposure, lambda row: _image(files[row]), str(images), (*files, times), scale)


def find_exposures(place: Path) -> Path | None:
    """Find the file of the starts and ends of exposures as DSEC names it, of a folder of images."""
    folders = [place, place.parent] if place.name in _INNER else [place]
    found = [path for folder in folders for path in sorted(folder.glob(_EXPOSURES))]
    sides = [side for side in ("left", "right") if side in place.parts]
    of_side = [path for path in found if any(side in path.stem for side in sides)]
    chosen = of_side if len(found) > 1 else found
    return chosen[0] if len(chosen) == 1 else None


def _find_timestamps(place: Path, beside: Path | None, names: Sequence[str]) -> Path:
    folders = [place] if beside is None else [place, beside]
    if names is TIMES:
        if (exposures := find_exposures(place)) is not None:
            return exposures
        if place.name in _INNER:
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


def _series(
    t: NDArray[np.int64],
    exposure: NDArray[np.int64],
    stored: Callable[[int], NDArray],
    source: str,
    files: tuple[Path, ...],
    scale: Scale,
) -> Series:
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


def _of_hdf5(path: Path, scale: Scale) -> Series:
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
    times = microseconds(t[()], f"{path}: t")
    unknown = np.zeros_like(times)
    return _series(times, unknown, lambda row: stored[row], str(path), (path,), scale)


def _image(path: Path) -> NDArray:
    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False)
    return read_image(path, str(path))


def read_image(file: Any, source: str, grey: bool = False) -> NDArray:
    """An image of a path or open file, as stored: (height, width), in colour (height, width, 3).

    Values are uint8, uint16 or float32, and whole numbers of 32 bits become uint16. With `grey`
    colours become grey (ITU-R 601 luma); transparency is passed over. Raises `InputError` where
    a value would not be kept: colours of 16 bits, numbers outside 0 to 65535, several images.
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
        if grey or image.mode in ("1", "LA"):
            return np.asarray(image.convert("L"))
        return np.asarray(image if image.mode in ("L", "RGB", "RGBA") else image.convert("RGB"))


def read_grey_and_colour(file: Any, source: str) -> tuple[NDArray, NDArray[np.uint8] | None]:
    """An image in grey, as of `read_image`, and its colours (height, width, 3); None of a grey one.

    `file` is a path or an open file that can be read from its beginning again.
    """
    from PIL import Image

    grey = read_image(file, source, grey=True)
    with Image.open(file) as image:
        if image.mode in ("1", "L", "LA", "F") or image.mode.startswith("I"):
            return grey, None
        return grey, np.asarray(image.convert("RGB"))


def grey_of_bgr(pixels: NDArray) -> NDArray:
    """Convert blue, green, red (height, width, 3 or 4), OpenCV's order, to grey of their type."""
    grey = pixels[..., :3] @ LUMA[::-1]
    return (grey if pixels.dtype.kind == "f" else np.rint(grey)).astype(pixels.dtype)


def read_files(
    files: Sequence[Path], source: str, in_memory: bool
) -> tuple[NDArray | DecodedImages, dict[str, Any]]:
    """Read images in files of their own, each checked once.

    Args:
        files: At least one file, in the order of the images.
        source: Name of the folder for messages.
        in_memory: False leaves the images in their files.

    Returns:
        Grey images (images, height, width), and the colours of coloured ones as `Recording.extra`
        keeps them.

    Raises:
        InputError: An image cannot be read, or has another size or type than the first.
    """
    shape, kind = (0, 0), np.dtype(np.uint8)
    grey: list[NDArray] = []
    colours: list[NDArray[np.uint8] | None] = []
    stored = unfolded = 0
    are_colours, differ = True, False
    for number, file in enumerate(files):
        with reading(str(file)):
            image, colour = read_grey_and_colour(file, str(file))
            stored += file.stat().st_size
        if number == 0:
            shape, kind = (image.shape[0], image.shape[1]), image.dtype
        if image.shape != shape or image.dtype != kind:
            raise InputError(
                f"{file}: is {image.shape[1]}x{image.shape[0]} {image.dtype} but the first image "
                f"is {shape[1]}x{shape[0]} {kind}; all images must have the sensor's size and one "
                "depth"
            )
        are_colours &= colour is not None
        differ |= colour is not None and bool((colour != colour[..., :1]).any())
        unfolded += image.nbytes + (0 if colour is None else colour.nbytes)
        check_unfolded(unfolded, stored, source)
        if in_memory:
            grey.append(image)
            colours.append(colour)
    if in_memory:
        return np.stack(grey), kept_colours(colours)

    def left(which: int, shape: tuple[int, ...], kind: np.dtype) -> DecodedImages:
        def images(row: int) -> Iterator[NDArray]:
            for file in files[row:]:
                yield np.asarray(read_grey_and_colour(file, str(file))[which])

        return DecodedImages(images, (len(files), *shape), kind, source)

    rgb = {"rgb": left(1, (*shape, 3), np.dtype(np.uint8))} if are_colours and differ else {}
    return left(0, shape, kind), rgb


def kept_colours(images: Sequence[NDArray[np.uint8] | None]) -> dict[str, NDArray[np.uint8]]:
    """Colours of all frames as `Recording.extra` keeps them: none if one is grey, or all are."""
    colours = [one for one in images if one is not None]
    if not colours or len(colours) < len(images):
        return {}
    differ = any((one != one[..., :1]).any() for one in colours)
    return {"rgb": np.stack(colours)} if differ else {}


def read_intensity(path: Path) -> NDArray[np.float32]:
    """An image of linear intensity (height, width), .npy or TIFF of floats, NaN where unknown."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; correct the path")
    with reading(str(path)):
        image = _image(path)
    if image.ndim != 2 or image.dtype.kind != "f":
        raise InputError(
            f"{path}: is {image.dtype} of shape {image.shape}; store floats (height, width), as "
            "`jaxevent camera merge` does"
        )
    return image.astype(np.float32)


def write_intensity(path: Path, image: NDArray[np.float32]) -> None:
    """Write an image of linear intensity as .npy or TIFF; raises `InputError` for other names."""
    from PIL import Image

    if path.suffix.lower() not in (".npy", ".tif", ".tiff"):
        raise InputError(f"{path}: an image of intensity is .npy or .tif; end the name so")
    with complete(path) as partial:
        if path.suffix.lower() == ".npy":
            with partial.open("wb") as file:
                np.save(file, image)
        else:
            Image.fromarray(image).save(partial, format="TIFF")


def _times(path: Path) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64]], list[str] | None]:
    """The times and exposures (us) of lines "t", "t name" or "start, end", and the names."""
    lines = [re.split(r"\s*[,;]\s*|\s+", line.strip(), maxsplit=1) for line in _lines(path)]
    if len({len(words) for words in lines}) > 1:
        raise InputError(f"{path}: some lines have a name and some have none; give all or none")
    remedy = "give lines 't', 't name' or 'start, end'"
    firsts = [words[0] for words in lines]
    names = [words[1].strip() for words in lines] if lines and len(lines[0]) == 2 else None
    if names is None or not all(re.fullmatch(r"[+-]?[\d.eE+-]+", name) for name in names):
        times = _parsed(path, firsts, remedy)
        return (times, np.zeros_like(times)), names
    both = _parsed(path, firsts + names, remedy)
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
    path = find_exposures(place) or place / TIMES[0]
    if not path.is_file():
        return None
    with contextlib.suppress(InputError):  # of a file that holds something else
        exposure = _times(path)[0][1]
        return exposure if exposure.any() else None
    return None


def read_times(path: Path, span: tuple[int, int] | None = None) -> NDArray[np.int64]:
    """Read the times of a text file, sorted: a time in each line, or a table with a column t.

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
    lines = [re.sub(r"\s+(?=[\[(])", "", line.strip()) for line in _lines(path)]
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
    times = _parsed(path, words, remedy, unit)
    if span is not None and unit is None:
        times = _inside(path, words, remedy, times, span)
    if (times[1:] < times[:-1]).any():
        row = int(np.argmax(times[1:] < times[:-1])) + 1
        raise InputError(f"{path}: time {row}, {words[row]}, is before the one above it; sort them")
    return times


def _inside(
    path: Path, words: Sequence[str], remedy: str, times: NDArray[np.int64], span: tuple[int, int]
) -> NDArray[np.int64]:
    """The times in their usual unit, or in another one that alone puts them in the recording."""

    def share(t: NDArray[np.int64]) -> float:
        return float(np.mean((t >= span[0]) & (t <= span[1])))

    if share(times) >= 0.5:
        return times
    fitting = {}
    for unit in SCALES:
        with contextlib.suppress(InputError):
            t = _parsed(path, words, remedy, unit)
            if share(t) == 1 and 10 * (t.max() - t.min()) >= span[1] - span[0]:
                fitting[unit] = t
    if len(fitting) != 1:
        return times
    unit, t = next(iter(fitting.items()))
    warnings.warn(
        f"{path}: the times are taken as {NAMES[unit]}, since they lie in the recording then; name "
        f"the column t_{unit} to be sure",
        InputWarning,
        stacklevel=3,
    )
    return t


def _lines(path: Path) -> list[str]:
    """The lines of a text file that are neither empty nor comments."""
    with reading(str(path)):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _parsed(
    path: Path, words: Sequence[str], remedy: str, unit: str | None = None
) -> NDArray[np.int64]:
    """Times in us; without a unit whole numbers, if all are, are us, others seconds."""
    whole = all(re.fullmatch(r"[+-]?\d+", word) for word in words)
    scale = Fraction(SCALES[unit or ("us" if whole else "s")]).limit_denominator(1000)
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
