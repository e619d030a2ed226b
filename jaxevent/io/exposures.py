"""Exposure stacks, and the camera responses that come of them, as files that any program can write.

A stack is a folder of PNG, JPEG or TIFF images of 8 bits of one still scene. Exposure times (s) are
in its file exposures.txt, lines "s name"; or in DSEC's file of the starts and ends of exposures
(`images`); or in the images' own EXIF data. Colours become grey (ITU-R 601 luma).

A response is CSV with the columns grey, intensity and certainty: evenly spaced grey values from 0
to 1, the intensity of each, which never falls, and how certain it is, at most 1.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import TableResponse
from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.io.images import SUFFIXES, read_exposures, read_image
from jaxevent.io.output import complete

TIMES = "exposures.txt"
_EXIF, _EXPOSURE_TIME = 0x8769, 0x829A  # tags


def read_stack(
    folder: Path, exposures: Sequence[float | int] | None = None
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The images (N, height, width) of a folder and their exposure times (N,) in s.

    `exposures` are those of the images in the order of their names, instead of what the folder
    tells. Raises `InputError` naming what is wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give the folder of the images")
    names: list[str] | None = None
    if exposures is None and (folder / TIMES).is_file():
        exposures, names = _listed(folder / TIMES)
    elif exposures is None and (lengths := read_exposures(folder)) is not None:
        exposures = (lengths * 1e-6).tolist()
    files = sorted(one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES)
    files = files if names is None else [folder / name for name in names]
    if not files:
        raise InputError(f"{folder}: holds no images; give those of one scene")
    images = []
    for file in files:
        with reading(str(file)):
            image = read_image(file, str(file), grey=True)
        if image.dtype != np.uint8 or image.shape != np.shape(images[0] if images else image):
            raise InputError(
                f"{file}: is {image.dtype} of {image.shape[1]}x{image.shape[0]} pixels; store all "
                "images with 8 bits and in one size"
            )
        images.append(image)
    if exposures is None:
        exposures = [_told(file) for file in files]
    if len(exposures) != len(files):
        raise InputError(
            f"{folder}: holds {len(files)} images, but {len(exposures)} exposure times are given; "
            "give one for each, in the order of their names"
        )
    seconds = np.asarray(exposures, np.float64)
    if not (np.isfinite(seconds) & (seconds > 0)).all():
        raise InputError(f"{folder}: exposure times must be positive, not {seconds.tolist()}")
    return np.stack(images), seconds


def _listed(path: Path) -> tuple[list[float], list[str]]:
    seconds, names = [], []
    with reading(str(path)):
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


def _told(file: Path) -> float:
    """The exposure time of an image's EXIF data."""
    from PIL import Image

    with reading(str(file)), Image.open(file) as image:
        value = image.getexif().get_ifd(_EXIF).get(_EXPOSURE_TIME)
    if value is None:
        raise InputError(
            f"{file}: does not tell its exposure time; give --exposures, or {TIMES} of lines "
            "'s name' beside the images"
        )
    return float(value)


def write_response(path: Path, response: TableResponse) -> None:
    """Write a response as CSV, completely or not at all."""
    greys = np.linspace(0, 1, len(response.levels))
    table = np.stack([greys, np.asarray(response.levels), np.asarray(response.weights)], 1)
    with complete(path) as partial:
        np.savetxt(partial, table, "%.9g", ",", header="grey,intensity,certainty", comments="")


def read_response(path: Path) -> TableResponse:
    """A response from CSV; raises `InputError` for other files."""
    with reading(str(path)):
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
