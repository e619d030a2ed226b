"""Results from elsewhere: images that other programs made, and published numbers.

Images of a recording are compared like those of the methods here:

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

How images and timestamps are stored is described in `jaxevent.io.images`; times are on the
recording's clock.

Programs that see only events know neither the unit nor the zero of intensity. With "affine", which
every method may have, each image is replaced by a * image + b, a >= 0, that fits the truth best
(Huber's loss, quadratic up to 0.1 of the white) before it is scored.

Published numbers are shown beside those computed here:

    [[method]]
    name = "published"
    label = "AKF, paper's table 2"
    measures = ["mse", "ssim", "lpips"]

    [method.values]
    boxes_6dof = [0.0026, 0.80, 0.26]
    "trees*1" = [0.0179, 0.82]          # any name that matches; missing numbers are unknown

A row is that of the recording whose name matches, and needs no file. Measures are those that the
tables of an evaluation have columns for, in the units of its rows: `mse` is not times 100.
"""

import dataclasses
import fnmatch
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io.images import TIMESTAMP_FILES, Scale, Series, read_series
from jaxevent.parameters import check_choice
from jaxevent.runs.config import check, is_number, is_texts
from jaxevent.runs.family import Source
from jaxevent.show.tables import COLUMNS

Normalise = Literal["none", "affine"]

HUBER_INTENSITY = 0.1  # intensity; larger errors count linearly
HOT_PIXEL_RANGES = (
    3  # pixels so many times the image's 5-95 % range off its median are not fitted to
)
MEASURE_NAMES = [place for _, place, _, _ in COLUMNS if "." not in place]
MAX_FITTED_PIXELS = 1 << 13  # pixels that the brightness is fitted to, at most


@dataclasses.dataclass(frozen=True)
class ExternalImages(Source):
    """Images of another program: their place and format; see the text of this module."""

    images: str  # path of the images of a recording, with {recording} or *
    timestamps: str | None = None  # file of their times; None: timestamps.txt or images.txt
    gamma: float | int = 1.0  # images are intensity ** (1 / gamma)
    # value of intensity 1; None: the largest of integers, 1 of floats
    white: float | int | None = None
    tolerance: float | int = 0.001  # s, between an image and the time asked for
    clock_offset: float | int = 0.0  # s, added to the images' times
    folder: str = "."  # to which the paths are relative

    name = "external"

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "ExternalImages":
        known = {field.name: field for field in dataclasses.fields(cls) if field.name != "folder"}
        for name, value in table.items():
            check_choice(name, "setting", known)
            if name in ("images", "timestamps"):
                if not isinstance(value, str) or not value:
                    raise InputError(f"{name} is {value!r}; give a path")
            elif not is_number(value) or (
                value < 0 if name == "tolerance" else value <= 0 and name != "clock_offset"
            ):
                raise InputError(f"{name} is {value!r}; give a positive number")
        if "images" not in table:
            raise InputError('no images are given; add images = "results/{recording}"')
        return cls(**table, folder=str(folder))

    def values(self) -> dict[str, Any]:
        """Return the settings."""
        return {name: value for name, value in vars(self).items() if name != "folder"}

    def files(self, recording: str) -> Sequence[Path]:
        return self.find(recording).files

    def find(self, recording: str) -> Series:
        """Return the images of a recording by its name; raise `InputError` for missing ones."""
        root = Path(self.folder)
        images = root / _expand_template(self.images, recording)
        if not images.exists():
            raise InputError(
                f"{images}: there are no images of {recording} here; correct images, in which "
                "{recording} stands for its name"
            )
        names = (
            TIMESTAMP_FILES
            if self.timestamps is None
            else (_expand_template(self.timestamps, recording),)
        )
        return read_series(images, Scale(self.white, self.gamma), names, root)

    def nearest(self, series: Series, times: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
        """Yield the nearest image for every time that has one within `tolerance`.

        Args:
            series: Images of a recording.
            times: Times, us.

        Returns:
            Pairs of an index of `times` and an index of the series.
        """
        for row, time in enumerate(times):
            after = int(np.searchsorted(series.t, time))
            near = min(
                (one for one in (after - 1, after) if 0 <= one < len(series.t)),
                key=lambda one: abs(int(series.t[one]) - int(time)),
            )
            if abs(int(series.t[near]) - int(time)) <= round(1e6 * self.tolerance):
                yield row, near


def _expand_template(template: str, recording: str) -> str:
    expanded = os.path.expanduser(os.path.expandvars(template))
    return expanded.replace("{recording}", recording).replace("*", recording)


def check_normalise(how: Any) -> None:
    """Raise `InputError` unless it is one of `Normalise`."""
    if how not in get_args(Normalise):
        raise InputError(f"there is no normalise {how!r}; give 'none' or 'affine'")


def fit_brightness(image: NDArray, truth: NDArray) -> NDArray[np.float64]:
    """Fit a * image + b, a >= 0, to the truth by Huber's loss.

    Hot pixels and pixels that are not finite are left out, and at most `MAX_FITTED_PIXELS` others
    are used, evenly spread.

    Args:
        image: Image, (height, width).
        truth: True image, (height, width).

    Returns:
        The fitted image, (height, width).
    """
    from scipy.optimize import least_squares

    image = np.asarray(image, np.float64)
    usable = np.isfinite(image) & np.isfinite(truth)
    given, wanted = image[usable], np.asarray(truth, np.float64)[usable]
    if len(given) > MAX_FITTED_PIXELS:
        # Multiples of the golden ratio are evenly spread, and not in columns of the image.
        chosen = (np.arange(MAX_FITTED_PIXELS) * ((math.sqrt(5) - 1) / 2) % 1 * len(given)).astype(
            int
        )
        given, wanted = given[chosen], wanted[chosen]
    if not len(given):
        return image
    # From units of the image to about the truth's.
    low, middle, high = np.percentile(given, [5, 50, 95])
    scale = float(high - low) or 1.0
    x = (given - middle) / scale
    x, wanted = x[np.abs(x) < HOT_PIXEL_RANGES], wanted[np.abs(x) < HOT_PIXEL_RANGES]
    spread = max(float(np.ptp(np.percentile(wanted, [5, 95]))), 1e-6)
    found = least_squares(
        lambda ab: ab[0] * x + ab[1] - wanted,
        (spread, float(np.median(wanted))),
        jac=lambda ab: np.stack([x, np.ones_like(x)], axis=1),
        bounds=([0, -np.inf], [np.inf, np.inf]),
        loss="huber",
        f_scale=HUBER_INTENSITY,
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-10,
    )
    a, b = found.x
    return a * ((image - middle) / scale) + b


@dataclasses.dataclass(frozen=True)
class PublishedResults(Source):
    """Published numbers by recording; see the text of this module."""

    measures: Sequence[str]
    numbers: Mapping[str, Sequence[float | int]]  # by the recordings' names

    name = "published"

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "PublishedResults":
        is_table = (lambda value: isinstance(value, dict) and bool(value), "a table of lists")
        check(table, {"measures": (is_texts, 'names, as ["mse", "ssim"]'), "values": is_table})
        for name in ("measures", "values"):
            if name not in table:
                raise InputError(f"{name} is missing; published numbers need measures and values")
        for measure in table["measures"]:
            check_choice(measure, "measure", MEASURE_NAMES)
        for name, numbers in table["values"].items():
            few = isinstance(numbers, list) and len(numbers) <= len(table["measures"])
            if not few or not all(map(is_number, numbers)):
                raise InputError(
                    f"the published values of {name} are {numbers!r}; give a list of at most "
                    f"{len(table['measures'])} numbers, those of {', '.join(table['measures'])}"
                )
        return cls(table["measures"], table["values"])

    def values(self) -> dict[str, Any]:
        """Return the settings."""
        return {"measures": list(self.measures), "values": dict(self.numbers)}

    def files(self, recording: str) -> Sequence[Path]:
        return ()

    def row(self, recording: str) -> dict[str, Any]:
        """Return the numbers of a recording, None for those that are not published."""
        found: Sequence[float | int] = ()
        for name, numbers in self.numbers.items():
            if fnmatch.fnmatchcase(recording, name):
                found = numbers
                break
        blank = dict.fromkeys(("mse", "ssim", *self.measures))
        return {**blank, **dict(zip(self.measures, found, strict=False))}
