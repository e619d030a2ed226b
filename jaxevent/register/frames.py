"""The other camera's frames: how they are read, and what is compared of them."""

import dataclasses
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import load
from jaxevent.io.images import Scale, is_series, kept_colours, read_series
from jaxevent.recording import Events, Frames, Recording

_I0 = 0.05  # intensity inside logarithms: noise of dark pixels stays small
_CLIPPED = 0.012  # grey from either end within which frames say nothing: three grey values of 255


def read_frames(
    path: str | Path,
    *,
    reference: bool = False,
    exposure: float | int | None = None,
    white: float | int | None = None,
    frames: str | None = None,
    progress: bool | None = None,
) -> Recording:
    """Another camera's frames, as a recording that need not hold events.

    `path` is anything that `jaxevent.load` reads, whose frames are taken, or images as of
    `jaxevent.io.images`: a folder of PNG, TIFF, JPEG or .npy with timestamps.txt or images.txt of
    lines "t name", or HDF5 of t and image. `exposure` (s) is that of the latter, where their
    timestamps do not tell it. With `reference`, of a recording its HDR images are taken if it holds
    any (`extra["hdr"]` and `extra["hdr_t"]`), and `white` is the value of images that is intensity
    1. Colours of frames are kept in `extra["rgb"]`. `frames` chooses among several kinds of images
    of a recording, as in `jaxevent.load`; the events beside them may be of another camera, and are
    left out. Raises `InputError` for what cannot be read and where there are no frames.
    """

    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    if is_series(path):
        if frames is not None:
            raise InputError(f"{path}: holds one kind of images; leave out frames")
        recording = _read_series(path, exposure, white, reference)
    else:
        stream = None if frames is None else "none"
        recording = load(path, in_memory=False, stream=stream, frames=frames, progress=progress)
        if exposure is not None or white is not None:
            name = "exposure" if white is None else "white"
            raise InputError(f"{path}: is a recording, which tells its own; leave out {name}")
        if reference and {"hdr", "hdr_t"} <= set(recording.extra):
            images = np.asarray(recording.extra["hdr"], np.float32)
            t = np.atleast_1d(np.asarray(recording.extra["hdr_t"], np.int64))
            if images.ndim != 3 or images.shape[0] != len(t):
                raise InputError(
                    f"{path}: hdr has the shape {images.shape} and hdr_t {t.shape}; store one time "
                    "for each image"
                )
            recording = dataclasses.replace(
                recording, frames=Frames.of_checked(t, images, np.zeros(len(t), np.int64))
            )
    if recording.frames is None:
        missing = recording.describe_left_out("frames")
        raise InputError(
            f"{path}: holds no frames{missing}; give the other camera's recording or images"
        )
    return dataclasses.replace(recording, name=str(path))


def _read_series(
    path: Path, exposure: float | int | None, white: float | int | None, reference: bool
) -> Recording:
    if exposure is not None and not 0 < exposure < math.inf:
        raise InputError(f"{path}: an exposure of {exposure} s is not possible; give seconds")
    if white is not None and not 0 < white < math.inf:
        raise InputError(f"{path}: white = {white} is not possible; give a number above 0")
    series = read_series(path, Scale(white))
    images: list[NDArray[np.float32]] = []
    colours: list[NDArray[np.uint8] | None] = []
    for row in range(len(series.t)):
        colours.append(None if reference else series.colour(row))
        image = series.read(row).astype(np.float32)
        if images and image.shape != images[0].shape:
            raise InputError(
                f"{path}: image {row} has the shape {image.shape} after images of "
                f"{images[0].shape}; give all images one size"
            )
        images.append(image)
    if exposure is not None and series.exposure.any():
        raise InputError(f"{path}: its timestamps tell the exposures; leave out exposure")
    length = series.exposure
    if exposure is not None:
        length = np.full(len(series.t), round(exposure * 1e6), np.int64)
    frames = Frames.of_checked(series.t, np.stack(images), length)
    height, width = images[0].shape
    if not reference:
        frames.check(width, height, str(path))
    extra = kept_colours(colours)
    return Recording(path.name, width, height, Events.empty(), frames, extra=extra)


def log_image(other: Recording, row: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """ln(I + 0.05) of a frame, and where it is not clipped."""
    assert other.frames is not None
    grey = other.frames[row : row + 1].intensity[0].astype(np.float64)
    if other.frames.images.dtype.kind == "f" and np.nanmax(grey) > 1:
        good, intensity = np.isfinite(grey), np.nan_to_num(grey)
    else:
        good = (grey > _CLIPPED) & (grey < 1 - _CLIPPED)
        intensity = np.asarray(other.response.intensity(np.nan_to_num(grey)), np.float64)
        intensity = intensity / other.gain[row]
    return np.log(np.maximum(intensity, 0) + _I0), good


def event_span(recording: Recording) -> tuple[int, int]:
    """The times (us) of the first and the last event."""
    events = recording.events
    return int(events[:1].t[0]), int(events[len(events) - 1 :].t[0])
