"""Changes of the pixel grid: crop, downsample, undistort."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import shorten_value
from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit
from jaxevent.errors import InputError
from jaxevent.events.blocks import (
    Part,
    Size,
    map_events,
    parse_duration,
    select_events,
    size_of,
)
from jaxevent.events.filters import LONG_AGO_US
from jaxevent.recording import Events, ImageSource, Recording, check_recording

Change = Callable[[NDArray], NDArray]  # of images (n, H, W) or (n, H, W, 3)


class ChangedImages:
    """An `ImageSource` that changes images when they are read."""

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


def _with_pixels(
    recording: Recording,
    events: Events,
    size: Size,
    change: Change,
    camera: PinholeCamera | None,
) -> Recording:
    """Replace the pixels of a recording: change its frames, and further arrays that are images."""
    width, height = size
    frames = recording.frames
    if frames is not None:
        images = ChangedImages(frames.images, change, size)
        if isinstance(frames.images, np.ndarray):
            images = np.asarray(images)
        frames = dataclasses.replace(frames, images=images)
    extra = _change_extra(recording, change)
    return dataclasses.replace(
        recording, width=width, height=height, events=events, frames=frames, camera=camera,
        extra=extra,
    )  # fmt: skip


def _change_extra(recording: Recording, change: Change) -> Mapping[str, NDArray]:
    """Change the further arrays of shape (..., H, W) and (..., H, W, 3)."""
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
    """Crop to a region, whose upper left pixel becomes (0, 0).

    The frames and the camera's centre of a recording change with it.

    Args:
        part: Events, or a recording.
        x: First column, px.
        y: First row, px.
        width: Width of the region, px.
        height: Height of the region, px.
        size: Width and height of the sensor, for events alone.

    Returns:
        The same type.

    Raises:
        InputError: The region is no whole number of pixels, or not inside the sensor.
    """
    across, down = size_of(part, size)
    region = {"x": x, "y": y, "width": width, "height": height}
    for name, pixels in region.items():
        if not isinstance(pixels, int | np.integer) or isinstance(pixels, bool):
            raise InputError(f"{name} is {shorten_value(pixels)}; give a whole number of pixels")
    if not (0 <= x < x + width <= across and 0 <= y < y + height <= down):
        raise InputError(
            f"the region of {width}x{height} pixels from ({x}, {y}) is not inside the "
            f"{across}x{down} sensor; choose one that is"
        )

    def step(e: Events) -> Events:
        e = e[(e.x >= x) & (e.x < x + width) & (e.y >= y) & (e.y < y + height)]
        return Events(e.t, e.x - np.uint16(x), e.y - np.uint16(y), e.p)

    new = map_events(part, step)
    if not isinstance(part, Recording) or not isinstance(new, Recording):
        return new
    camera = part.camera
    if camera is not None:
        camera = dataclasses.replace(camera, cx=camera.cx - x, cy=camera.cy - y)
    window = np.s_[:, y : y + height, x : x + width]
    return _with_pixels(part, _in_memory(new), (width, height), lambda i: i[window], camera)  # ty: ignore[invalid-explicit-return]


def downsample(
    part: Part, factor: int = 1, period: int | float = 0, *, size: Size | None = None
) -> Part:
    """Merge blocks of pixels, and thin out events in time.

    Blocks of `factor` x `factor` pixels become one, which fires the events of all; columns and rows
    that fill no block are left out. Frames show the blocks' means; the camera's focal lengths and
    centre change with the pixels. (tonic's `Downsample` keeps all events too; its time factor
    changes the unit of time, which this does not.)

    Args:
        part: Events, or a recording.
        factor: Width and height of a block, px.
        period: Time in which only the first event of a pixel and polarity remains, us or s, counted
            from time 0; 0: all remain.
        size: Width and height of the sensor, for events alone.

    Returns:
        The same type.

    Raises:
        InputError: The factor or the period is not possible.
    """
    across, down = size_of(part, size)
    most = min(across, down)
    if not isinstance(factor, int | np.integer) or not 1 <= factor <= most:
        raise InputError(
            f"pixels of {factor}x{factor} are not possible on the {across}x{down} sensor; give a "
            f"whole number from 1 to {most}"
        )
    width, height = across // factor, down // factor
    period_us = parse_duration(period, "the period of one event per pixel", least=0)

    def step(e: Events) -> Events:
        e = Events(e.t, e.x // np.uint16(factor), e.y // np.uint16(factor), e.p)
        return e[(e.x < width) & (e.y < height)]

    new = part if factor == 1 else map_events(part, step)
    if period_us:
        last = np.full((2, height, width), LONG_AGO_US)
        new = select_events(new, lambda e: _is_first(e.t, e.x, e.y, e.p, last, period_us))
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
        return _cast(images.reshape(shape).mean((2, 4), dtype=np.float64), images.dtype)

    return _with_pixels(part, _in_memory(new), (width, height), mean, camera)  # ty: ignore[invalid-explicit-return]


@njit
def _is_first(t, x, y, p, last, period):
    """Find the first events of their pixel, polarity and period.

    Args:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) polarities.
        last: (2, height, width) number of the last period with an event, updated in place.
        period: Length of a period, us.

    Returns:
        (n,) booleans.
    """
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        number = t[i] // period
        kept[i] = last[int(p[i]), y[i], x[i]] != number
        last[int(p[i]), y[i], x[i]] = number
    return kept


def undistort(recording: Recording) -> Recording:
    """Undistort a recording: a camera without distortion, of the same focal lengths and centre.

    Events move to the nearest pixel of the undistorted image. Those that leave the sensor are
    removed, and those where the distortion has no inverse. Where the image is spread, some pixels
    fire none. Frames are interpolated linearly, 0 where the camera saw nothing.

    Args:
        recording: The recording, with calibration.

    Returns:
        The recording.

    Raises:
        InputError: The recording has no calibration.
    """
    check_recording(recording, "undistort")
    camera, width, height = recording.camera, recording.width, recording.height
    if camera is None:
        raise InputError(
            f"{recording.name}: holds no calibration, which undistorting needs"
            f"{recording.describe_left_out('camera')}; give it to jaxevent.load(path, camera=...)"
        )
    y, x = (axis.ravel() for axis in np.mgrid[:height, :width])
    ideal = camera.undistorted
    to = np.rint(ideal.distort(camera.normalise(x, y)))
    seen = np.all((to >= 0) & (to < (width, height)), axis=-1)  # not of NaN
    column, row = np.where(seen[:, None], to, 0).astype(np.uint16).T

    def step(e: Events) -> Events:
        pixel = e.y.astype(np.intp) * width + e.x
        e, pixel = e[seen[pixel]], pixel[seen[pixel]]
        return Events(e.t, column[pixel], row[pixel], e.p)

    events = _in_memory(map_events(recording, step))
    at = camera.distort(ideal.normalise(x, y)).reshape(height, width, 2)
    return _with_pixels(
        recording, events, (width, height), lambda images: _interpolate_images(images, at), ideal
    )


def _interpolate_images(images: NDArray, at: NDArray[np.float64]) -> NDArray:
    """Interpolate images linearly at points.

    Args:
        images: (n, H, W[, 3]).
        at: (h, w, 2) x and y, px.

    Returns:
        (n, h, w[, 3]) of the type of `images`, 0 outside.
    """
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
    return _cast(np.where(inside, (1 - v) * upper + v * lower, 0), images.dtype)


def _cast(values: NDArray[np.floating], kind: np.dtype) -> NDArray:
    """Convert values to the type of images, rounded where these are integers.

    Args:
        values: Values, of any shape.
        kind: The type.

    Returns:
        The values, of that shape.
    """
    return (values if kind.kind == "f" else np.rint(values)).astype(kind)


def _in_memory(recording: Recording) -> Events:
    """Return the events of a recording that `map_events` made."""
    assert isinstance(recording.events, Events)
    return recording.events
