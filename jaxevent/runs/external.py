"""Images that other programs made of a recording, compared like those of the methods here.

    [[method]]
    name = "external"
    label = "E2VID"
    images = "e2vid/{recording}"     # a folder for each recording; {recording} or * is its name
    timestamps = "timestamps.txt"    # in that folder, or beside the configuration; default:
                                     # this or images.txt
    normalise = "affine"             # omitted: "none", see below
    gamma = 2.2                      # images are intensity ** (1 / gamma); omitted: linear
    white = 255                      # the value of intensity 1; omitted: the largest of integers,
                                     # 1 of floats
    tolerance = 0.001                # s between an image and the time asked for; the default
    clock_offset = 0.0               # s added to the frames' times; the default

Images are PNG, JPEG, TIFF or .npy files, taken in the order of their names; or one .npy file
(images, height, width); or one HDF5 file of the datasets t and image, as `jaxevent reconstruct`
writes. Integers of 8 or 16 bits and floats are linear intensities. Colours become grey (ITU-R 601
luma). The timestamps are lines "t", one per image, or "t name"; where all are whole numbers they
are microseconds, otherwise seconds, on the recording's clock.

Programs that see only events know neither the unit nor the zero of intensity. With "affine", which
every method may have, each image is replaced by a * image + b, a >= 0, that fits the truth best
(Huber's loss, quadratic up to 0.1 of the white) before it is scored.
"""

import contextlib
import dataclasses
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.parameters import nearest
from jaxevent.recording import microseconds

Normalise = Literal["none", "affine"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
LUMA = np.array([0.299, 0.587, 0.114])
HUBER = 0.1  # intensity; larger errors count linearly
HOT = 3  # pixels so many times the image's 5-95 % range off its median are not fitted to
SAMPLE = 1 << 13  # pixels that the brightness is fitted to, at most


@dataclasses.dataclass(frozen=True)
class Series:
    """Images at sorted times (us), each read when asked for: `read(row)` is (height, width)."""

    t: NDArray[np.int64]
    read: Callable[[int], NDArray[np.float64]]
    files: tuple[Path, ...]  # that hold all this


@dataclasses.dataclass(frozen=True)
class External:
    """Where the images are and how they are stored; the text of this module has more."""

    images: str
    timestamps: str | None = None
    gamma: float | int = 1.0
    white: float | int | None = None
    tolerance: float | int = 0.001
    clock_offset: float | int = 0.0
    folder: str = "."  # to which the paths are relative

    name = "external"

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "External":
        """From the settings of a configuration; raises `InputError` naming a bad one."""
        known = {field.name: field for field in dataclasses.fields(cls) if field.name != "folder"}
        for name, value in table.items():
            if name not in known:
                raise InputError(f"there is no setting {name!r}; {nearest(name, known)}")
            if name in ("images", "timestamps"):
                if not isinstance(value, str) or not value:
                    raise InputError(f"{name} is {value!r}; give a path")
            elif (
                not isinstance(value, int | float)
                or isinstance(value, bool)
                or not math.isfinite(value)
                or (value < 0 if name == "tolerance" else value <= 0 and name != "clock_offset")
            ):
                raise InputError(f"{name} is {value!r}; give a positive number")
        if "images" not in table:
            raise InputError('no images are given; add images = "results/{recording}"')
        return cls(**table, folder=str(folder))

    def values(self) -> dict[str, Any]:
        """The settings."""
        return {name: value for name, value in vars(self).items() if name != "folder"}

    def find(self, recording: str) -> Series:
        """The images of the recording of that name; raises `InputError` naming what is wrong."""
        root = Path(self.folder)
        images = root / _named(self.images, recording)
        if not images.exists():
            raise InputError(
                f"{images}: there are no images of {recording} here; correct images, in which "
                "{recording} stands for its name"
            )
        if images.is_file() and images.suffix.lower() != ".npy":
            return self._of_hdf5(images)
        place = images if images.is_dir() else images.parent
        times = self._timestamps(place, root, recording)
        t, names = _times(times)
        if images.is_file():
            with reading(str(images)):
                stack = np.load(images, mmap_mode="r", allow_pickle=False)
            self._count(images, len(stack) if stack.ndim in (3, 4) else 0, times, len(t))
            return self._series(t, lambda row: stack[row], str(images), (images, times))
        if names is None:
            files = sorted(p for p in images.iterdir() if p.suffix.lower() in SUFFIXES)
            self._count(images, len(files), times, len(t))
        else:
            files = [images / name for name in names]
        return self._series(t, lambda row: _image(files[row]), str(images), (*files, times))

    def nearest(self, series: Series, times: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
        """(row of `times`, row of the series) wherever there is an image within `tolerance`."""
        for row, time in enumerate(times):
            after = int(np.searchsorted(series.t, time))
            near = min(
                (one for one in (after - 1, after) if 0 <= one < len(series.t)),
                key=lambda one: abs(int(series.t[one]) - int(time)),
            )
            if abs(int(series.t[near]) - int(time)) <= round(1e6 * self.tolerance):
                yield row, near

    def _timestamps(self, place: Path, root: Path, recording: str) -> Path:
        names = ["timestamps.txt", "images.txt"] if self.timestamps is None else [self.timestamps]
        candidates = [where / _named(name, recording) for name in names for where in (place, root)]
        for path in candidates:
            if path.is_file():
                return path
        raise InputError(
            f"{place}: there is no {' or '.join(names)} with the images' times; add it or give "
            "timestamps"
        )

    @staticmethod
    def _count(images: Path, found: int, times: Path, expected: int) -> None:
        if found != expected:
            raise InputError(
                f"{images}: holds {found} images, {times.name} {expected} times; there must be one "
                "time for each image"
            )

    def _series(
        self,
        t: NDArray[np.int64],
        stored: Callable[[int], NDArray],
        source: str,
        files: tuple[Path, ...],
    ) -> Series:
        if not len(t):
            raise InputError(f"{source}: holds no images; give those of the recording")
        if (t[1:] < t[:-1]).any():
            row = int(np.argmax(t[1:] < t[:-1])) + 1
            raise InputError(
                f"{source}: image {row} at {t[row]} us is earlier than the one before it; sort "
                "images and times"
            )

        def read(row: int) -> NDArray[np.float64]:
            with reading(f"{source}: image {row}"):
                image = stored(row)
            return self._intensity(np.asarray(image), f"{source}: image {row}")

        return Series(t, read, files)

    def _of_hdf5(self, path: Path) -> Series:
        import h5py

        with reading(str(path)):
            file = h5py.File(path)
            stored, t = file.get("image"), file.get("t")
        if not isinstance(stored, h5py.Dataset) or not isinstance(t, h5py.Dataset):
            raise InputError(
                f"{path}: has no datasets t and image; store t (images,) and image (images, "
                "height, width)"
            )
        if t.ndim != 1 or stored.ndim not in (3, 4) or len(t) != len(stored):
            raise InputError(
                f"{path}: image has the shape {stored.shape} and t {t.shape}; store one time for "
                "each image"
            )
        times = microseconds(t[()], f"{path}: t")
        return self._series(times, lambda row: stored[row], str(path), (path,))

    def _intensity(self, image: NDArray, source: str) -> NDArray[np.float64]:
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


def _named(template: str, recording: str) -> str:
    expanded = os.path.expanduser(os.path.expandvars(template))
    return expanded.replace("{recording}", recording).replace("*", recording)


def _image(path: Path) -> NDArray:
    from PIL import Image

    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False)
    with Image.open(path) as image:
        if getattr(image, "n_frames", 1) > 1:
            raise InputError(f"{path}: holds several images; store each as a file of its own")
        return np.asarray(image.convert("RGB") if image.mode in ("P", "CMYK") else image)


def _times(path: Path) -> tuple[NDArray[np.int64], list[str] | None]:
    """The times (us) of a file of lines "t" or "t name", and the names."""
    with reading(str(path)):
        lines = [line.split(maxsplit=1) for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [words for words in lines if words and not words[0].startswith("#")]
    if len({len(words) for words in lines}) > 1:
        raise InputError(f"{path}: some lines have a name and some have none; give all or none")
    whole = all(re.fullmatch(r"[+-]?\d+", words[0]) for words in lines)
    times: list[int] = []
    for number, words in enumerate(lines):
        value = math.nan
        with contextlib.suppress(ValueError):
            value = int(words[0]) if whole else float(words[0]) * 1e6
        if not abs(value) < 9e18:
            raise InputError(
                f"{path}: line {number} of numbers starts with {words[0][:20]!r}, not a time; give "
                "lines 't' or 't name'"
            )
        times.append(round(value))
    names = [words[1].strip() for words in lines] if lines and len(lines[0]) == 2 else None
    if names and all(re.fullmatch(r"[+-]?[\d.eE+-]+", name) for name in names):
        raise InputError(f"{path}: has two columns of numbers; keep the times only")
    return np.array(times, np.int64), names


def check_normalise(how: Any) -> None:
    """Raise `InputError` unless it is one of `Normalise`."""
    if how not in get_args(Normalise):
        raise InputError(f"there is no normalise {how!r}; give 'none' or 'affine'")


def fit_brightness(image: NDArray, truth: NDArray) -> NDArray[np.float64]:
    """a * image + b closest to the truth by Huber's loss, a >= 0; both (height, width).

    Hot pixels and those of which either is not finite are not looked at, and of the others at most
    `SAMPLE`, evenly spread.
    """
    from scipy.optimize import least_squares

    image = np.asarray(image, np.float64)
    usable = np.isfinite(image) & np.isfinite(truth)
    given, wanted = image[usable], np.asarray(truth, np.float64)[usable]
    if len(given) > SAMPLE:
        # Multiples of the golden ratio are evenly spread, and not in columns of the image.
        chosen = (np.arange(SAMPLE) * ((math.sqrt(5) - 1) / 2) % 1 * len(given)).astype(int)
        given, wanted = given[chosen], wanted[chosen]
    if not len(given):
        return image
    # From units of the image to about the truth's.
    low, middle, high = np.percentile(given, [5, 50, 95])
    scale = float(high - low) or 1.0
    x = (given - middle) / scale
    x, wanted = x[np.abs(x) < HOT], wanted[np.abs(x) < HOT]
    spread = max(float(np.ptp(np.percentile(wanted, [5, 95]))), 1e-6)
    found = least_squares(
        lambda ab: ab[0] * x + ab[1] - wanted,
        (spread, float(np.median(wanted))),
        jac=lambda ab: np.stack([x, np.ones_like(x)], axis=1),  # type: ignore[arg-type]
        bounds=([0, -np.inf], [np.inf, np.inf]),
        loss="huber",
        f_scale=HUBER,
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-10,
    )
    a, b = found.x
    return a * ((image - middle) / scale) + b
