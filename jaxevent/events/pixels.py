"""Other pixels for the same scene: a region, fewer and larger ones, those of an ideal camera."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit
from jaxevent.errors import InputError
from jaxevent.events.filters import LONG_AGO
from jaxevent.events.parts import Part, Size, duration, pick, rewrite, select, size_of
from jaxevent.recording import Events, ImageSource, Recording

Change = Callable[[NDArray], NDArray]  # of images (n, H, W) or (n, H, W, 3)


class ChangedImages:
    """An `ImageSource` whose images are changed when they are read."""

    def __init__(self, images: ImageSource | NDArray, change: Change, size: Size):
        self._images, self._change = images, change
        self.dtype = images.dtype
        self.shape = (images.shape[0], size[1], size[0], *images.shape[3:])

    def __reduce__(self) -> tuple[Any, ...]:
        return np.asarray, (np.asarray(self),)

    def __getitem__(self, rows: Any) -> "ChangedImages":
        return ChangedImages(self._images[rows], self._change, (self.shape[2], self.shape[1]))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        out = np.empty(self.shape, self.dtype if dtype is None else dtype)
        for row in range(self.shape[0]):
            out[row] = self._change(np.asarray(self._images[row : row + 1]))[0]
        return out


def _seen(
    recording: Recording,
    events: Events,
    size: Size,
    change: Change,
    camera: PinholeCamera | None,
) -> Recording:
    """The recording on other pixels: its images changed, as its further arrays that are images."""
    width, height = size
    frames = recording.frames
    if frames is not None:
        images = ChangedImages(frames.images, change, size)
        if isinstance(frames.images, np.ndarray):
            images = np.asarray(images)
        frames = dataclasses.replace(frames, images=images)
    extra = _images_of(recording, change)
    return dataclasses.replace(
        recording, width=width, height=height, events=events, frames=frames, camera=camera,
        extra=extra,
    )  # fmt: skip


def _images_of(recording: Recording, change: Change) -> Mapping[str, NDArray]:
    """The further arrays; those of shape (..., H, W) and (..., H, W, 3) changed."""
    extra, sensor = dict(recording.extra), (recording.height, recording.width)
    for name, values in extra.items():
        values = np.asarray(values)
        colour = values.ndim > 2 and values.shape[-3:-1] == sensor and values.shape[-1] == 3
        if values.dtype.kind in "uif" and (values.shape[-2:] == sensor or colour):
            lead = values.ndim - 2 - colour
            new = change(values.reshape(-1, *values.shape[lead:]))
            extra[name] = new.reshape(*values.shape[:lead], *new.shape[1:])
    return extra


def crop(part: Part, x: int, y: int, width: int, height: int, *, size: Size | None = None) -> Part:
    """The region of `width` by `height` pixels whose upper left pixel is (x, y), as a sensor.

    Coordinates count from that pixel. Of a recording, frames and the camera's centre move with it.
    Raises `InputError` for a region that is not inside the sensor.
    """
    across, down = size_of(part, size)
    if not (0 <= x < x + width <= across and 0 <= y < y + height <= down):
        raise InputError(
            f"the region of {width}x{height} pixels from ({x}, {y}) is not inside the "
            f"{across}x{down} sensor; choose one that is"
        )

    def step(e: Events) -> Events:
        e = pick(e, (e.x >= x) & (e.x < x + width) & (e.y >= y) & (e.y < y + height))
        return Events(e.t, e.x - np.uint16(x), e.y - np.uint16(y), e.p)

    new = rewrite(part, step)
    if not isinstance(part, Recording) or not isinstance(new, Recording):
        return new
    camera = part.camera
    if camera is not None:
        camera = dataclasses.replace(camera, cx=camera.cx - x, cy=camera.cy - y)
    window = np.s_[:, y : y + height, x : x + width]
    return _seen(part, _held(new), (width, height), lambda i: i[window], camera)  # ty: ignore[invalid-explicit-return]


def downsample(
    part: Part, factor: int = 1, period: int | float = 0, *, size: Size | None = None
) -> Part:
    """Fewer pixels, and fewer events in time.

    Blocks of `factor` x `factor` pixels become one, which fires the events of all; columns and rows
    that fill no block are left out. Of the events of one such pixel and one polarity in each
    `period` (us or s, counted from time 0) only the first remains; 0: all remain. Frames show the
    blocks' means; the camera's focal lengths and centre change with the pixels. (tonic's
    `Downsample` keeps all events too; its time factor changes the unit of time, which this does
    not.)
    """
    across, down = size_of(part, size)
    if not 1 <= factor <= min(across, down):
        raise InputError(
            f"pixels of {factor}x{factor} are not possible on the {across}x{down} sensor; give a "
            "whole number from 1"
        )
    width, height = across // factor, down // factor
    us = duration(period, "the period of one event per pixel", least=0)

    def step(e: Events) -> Events:
        e = Events(e.t, e.x // np.uint16(factor), e.y // np.uint16(factor), e.p)
        return pick(e, (e.x < width) & (e.y < height))

    new = part if factor == 1 else rewrite(part, step)
    if us:
        last = np.full((2, height, width), LONG_AGO)
        new = select(new, lambda e: _first(e.t, e.x, e.y, e.p, last, us))
    if not isinstance(part, Recording) or not isinstance(new, Recording) or factor == 1:
        return new
    camera = part.camera
    if camera is not None:
        camera = dataclasses.replace(
            camera, fx=camera.fx / factor, fy=camera.fy / factor,
            cx=(camera.cx + 0.5) / factor - 0.5, cy=(camera.cy + 0.5) / factor - 0.5,
        )  # fmt: skip

    def mean(images: NDArray) -> NDArray:
        images = images[:, : height * factor, : width * factor]
        shape = (len(images), height, factor, width, factor, *images.shape[3:])
        return _typed(images.reshape(shape).mean((2, 4), dtype=np.float64), images.dtype)

    return _seen(part, _held(new), (width, height), mean, camera)  # ty: ignore[invalid-explicit-return]


@njit
def _first(t, x, y, p, last, period):
    """Events that are the first of their pixel, polarity and period; `last` is written over."""
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        number = t[i] // period
        kept[i] = last[int(p[i]), y[i], x[i]] != number
        last[int(p[i]), y[i], x[i]] = number
    return kept


def undistort(recording: Recording) -> Recording:
    """The recording as a camera without distortion sees it, of the same focal lengths and centre.

    Events move to the nearest pixel of the undistorted image; those that leave the sensor and
    those at which the distortion has no inverse are left out, and where the image is spread some
    pixels fire none. Frames are interpolated linearly, 0 where the camera saw nothing. Raises
    `InputError` for a recording without calibration.
    """
    camera, width, height = recording.camera, recording.width, recording.height
    if camera is None:
        raise InputError(
            f"{recording.name}: holds no calibration, which undistorting needs; give its camera"
            f"{recording.describe_left_out('camera')}"
        )
    y, x = (axis.ravel() for axis in np.mgrid[:height, :width])
    ideal = camera.undistorted
    to = np.rint(ideal.distort(camera.normalise(x, y)))
    seen = np.all((to >= 0) & (to < (width, height)), axis=-1)  # not of NaN
    column, row = np.where(seen[:, None], to, 0).astype(np.uint16).T

    def step(e: Events) -> Events:
        pixel = e.y.astype(np.intp) * width + e.x
        e, pixel = pick(e, seen[pixel]), pixel[seen[pixel]]
        return Events(e.t, column[pixel], row[pixel], e.p)

    events = _held(rewrite(recording, step))
    at = camera.distort(ideal.normalise(x, y)).reshape(height, width, 2)
    return _seen(recording, events, (width, height), lambda images: _sampled(images, at), ideal)


def _sampled(images: NDArray, at: NDArray[np.float64]) -> NDArray:
    """Images (n, H, W[, 3]) at places (H, W, 2) in px, linearly; 0 outside."""
    height, width = images.shape[1:3]
    inside = np.all((at >= 0) & (at <= (width - 1, height - 1)), axis=-1)
    at = np.where(inside[..., None], at, 0)
    left, top = np.floor(at).astype(np.intp).transpose(2, 0, 1)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (at - np.floor(at)).transpose(2, 0, 1)
    if images.ndim == 4:
        u, v, inside = u[..., None], v[..., None], inside[..., None]
    upper = (1 - u) * images[:, top, left] + u * images[:, top, right]
    lower = (1 - u) * images[:, below, left] + u * images[:, below, right]
    return _typed(np.where(inside, (1 - v) * upper + v * lower, 0), images.dtype)


def _typed(values: NDArray[np.floating], kind: np.dtype) -> NDArray:
    """Rounded where the images are of integers."""
    return (values if kind.kind == "f" else np.rint(values)).astype(kind)


def _held(recording: Recording) -> Events:
    assert isinstance(recording.events, Events)  # as `rewrite` leaves them
    return recording.events
