"""Frames brought onto the event camera's pixels: images seen through a grid, and the recording."""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register.frames import event_span
from jaxevent.register.geometry import Grid, step_size
from jaxevent.register.refinement import Registration

_OF_FRAMES = ("response", "certainty", "f_Q", "clip", "gain", "rgb", "read_noise", "clock_offset")


class Warped:
    """Images seen through a grid, an `ImageSource` of shape (frames, height, width[, 3]).

    Cubic convolution (Keys 1981) of the grey values as they are, with several samples to a pixel
    where the other camera resolves more, so that each pixel shows the mean of what it covers.
    Integers are rounded. Pixels of which half or more comes from a clipped end of integer levels
    keep that end. `fill` is the value where the other camera sees nothing.
    """

    def __init__(
        self,
        images: Any,
        grid: Grid,
        fill: float | int = 0,
        _how: "tuple[Any, NDArray[np.bool_]] | None" = None,
    ):
        """`images` is (frames, h, w) or (frames, h, w, 3), in memory or an `ImageSource`."""
        self._images, self._grid, self._fill = images, grid, fill
        self._how = _convolution(grid, images.shape[1:3]) if _how is None else _how
        self.dtype: np.dtype = np.dtype(images.dtype)
        self.shape = (images.shape[0], *grid.shape[:2], *images.shape[3:])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> "Warped":
        images = self._images[rows]
        if len(images.shape) != len(self._images.shape):
            raise IndexError("take several images, by a slice or an array")
        return Warped(images, self._grid, self._fill, self._how)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        weights, covered = self._how
        out = np.empty(self.shape, self.dtype)
        whole = self.dtype.kind in "iu"
        top = np.iinfo(self.dtype).max if whole else 0
        for row in range(self.shape[0]):
            image = np.asarray(self._images[row : row + 1])[0]
            flat = image.reshape(image.shape[0] * image.shape[1], -1)
            values = weights @ flat.astype(np.float64)
            if whole:
                for end in (0, top):
                    values = np.where(weights @ (flat == end).astype(float) >= 0.5, end, values)
            low, high = (self._around(f, image) for f in (np.fmin, np.fmax))
            values = np.clip(values, low, high)
            if whole:
                values = np.rint(values)
            values = np.where(covered.reshape(-1, 1), values, self._fill)
            out[row] = values.reshape(out[row].shape).astype(self.dtype)
        return out if dtype is None else out.astype(dtype)

    def _around(self, extreme: Any, image: NDArray) -> NDArray[np.float64]:
        """The least or greatest value within a pixel's reach, so that nothing overshoots it."""
        reach = 2 * math.ceil(max(step_size(self._grid), 1)) + 1
        size = (reach, reach) + (1,) * (image.ndim - 2)
        find = ndimage.minimum_filter if extreme is np.fmin else ndimage.maximum_filter
        found = find(image.astype(np.float64), size, mode="nearest")
        at = np.rint(np.nan_to_num(self._grid)).astype(int).reshape(-1, 2)
        return found[at[:, 1], at[:, 0]].reshape(len(at), -1)


def _convolution(grid: Grid, shape: tuple[int, int]) -> tuple[Any, NDArray[np.bool_]]:
    """The matrix (pixels, other pixels) of cubic convolution, and which pixels are seen.

    Keys, "Cubic convolution interpolation for digital image processing", 1981, a = -1/2. Where the
    grid's steps are s > 1 px, ceil(s)^2 samples are averaged over each pixel.
    """
    height, width = grid.shape[:2]
    covered = ~np.isnan(grid[..., 0])
    count = min(max(1, math.ceil(step_size(grid) - 0.25)), 16)
    # Steps to the neighbours, of one side where the other one is not seen.
    slopes = []
    for axis in (1, 0):
        ahead = np.diff(grid, axis=axis, append=np.nan)
        back = np.diff(grid, axis=axis, prepend=np.nan)
        both = np.where(np.isnan(ahead), back, np.where(np.isnan(back), ahead, (ahead + back) / 2))
        slopes.append(np.nan_to_num(both))
    within = (np.arange(count) + 0.5) / count - 0.5
    pixel = np.flatnonzero(covered.ravel())
    total = sparse.csr_array((height * width, shape[0] * shape[1]))
    for dy in within:
        for dx in within:
            at = (grid + dx * slopes[0] + dy * slopes[1]).reshape(-1, 2)[pixel]
            at = np.clip(at, 0, np.array(shape[::-1]) - 1)
            i = np.floor(at).astype(int)
            wx, wy = _keys(at[:, 0] - i[:, 0]), _keys(at[:, 1] - i[:, 1])
            columns = np.clip(i[:, :1] + np.arange(-1, 3), 0, shape[1] - 1)
            rows = np.clip(i[:, 1:] + np.arange(-1, 3), 0, shape[0] - 1)
            source = (rows[:, :, None] * shape[1] + columns[:, None]).reshape(len(pixel), -1)
            weight = (wy[:, :, None] * wx[:, None]).reshape(len(pixel), -1) / count**2
            entries = (weight.ravel(), (np.repeat(pixel, 16), source.ravel()))
            total = total + sparse.coo_array(entries, total.shape).tocsr()
    return total, covered


def _keys(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (n, 4) of the values at -1, 0, 1, 2 for a place s in [0, 1)."""
    s = s[:, None]
    return np.concatenate(
        [
            ((-0.5 * s + 1) * s - 0.5) * s,
            (1.5 * s - 2.5) * s * s + 1,
            ((-1.5 * s + 2) * s + 0.5) * s,
            (0.5 * s - 0.5) * s * s,
        ],
        1,
    )


def registered(
    recording: Recording,
    other: Recording,
    found: Registration,
    *,
    crop: bool = False,
    reference: bool = False,
) -> Recording:
    """The recording with the other camera's frames on its pixels and clock.

    Events, calibration, poses and IMU stay; frames that it had are replaced, and what `extra` told
    of them by what the other recording tells (response, gain, colours). The frames' time stamps are
    other.frames.t + found.offset; those more than a frame before or after the events are left out.
    Pixels that the other camera does not see are black, 0: frames may not hold NaN, and black is
    believed as little as a clipped pixel is. `extra` tells of it all:

    - covered (height, width) bool: the pixels that the other camera sees;
    - register_offset: `found.offset`, s;
    - homography (3, 3), where there is one.

    With `crop` the recording is cut to the largest rectangle of pixels that are seen, so that black
    borders are nowhere taken for the truth, by a fit for example; the calibration's centre moves
    along. With `reference` frames stay, and the images become the HDR reference: `extra` gets
    hdr (T, height, width) float32, NaN where there is none, and hdr_t.

    Raises `InputError` if no frame falls into the time of the events, or nothing is seen.
    """
    assert other.frames is not None
    t = other.frames.t + round(found.offset * 1e6)
    gap = int(np.median(np.diff(t))) if len(t) > 1 else 0
    begin, end = event_span(recording)
    rows = np.flatnonzero((t >= begin - gap) & (t <= end + gap))
    if not len(rows):
        raise InputError(
            f"{other.name}: with the offset {found.offset:g} s its frames are from "
            f"{t[0] * 1e-6:g} to {t[-1] * 1e-6:g} s, the events from {begin * 1e-6:g} to "
            f"{end * 1e-6:g} s; give the offset that is added to the frames' time stamps"
        )
    covered = ~np.isnan(found.grid[..., 0])
    if not covered.any():
        raise InputError(
            f"{other.name}: shows nothing that the event camera sees; correct the calibration, the "
            "depth or the homography"
        )
    rows = slice(int(rows[0]), int(rows[-1]) + 1)
    extra: dict[str, Any] = dict(recording.extra)
    about: dict[str, Any] = {"register_offset": np.asarray(float(found.offset))}
    if found.homography is not None:
        about["homography"] = found.homography
    if reference:
        images = Warped(other.frames.images[rows], found.grid, math.nan)
        images = np.asarray(images, np.float32)
        return dataclasses.replace(recording, extra={**extra, "hdr": images, "hdr_t": t[rows]})
    for name in _OF_FRAMES:
        extra.pop(name, None)
    told = other.with_frames(rows).extra
    extra |= {name: told[name] for name in _OF_FRAMES if name in told}
    if "rgb" in told:
        extra["rgb"] = np.asarray(Warped(told["rgb"], found.grid))
    images = Warped(other.frames.images[rows], found.grid)
    frames = Frames(t[rows], images, other.frames.exposure[rows])
    result = dataclasses.replace(
        recording, frames=frames, extra={**extra, **about, "covered": covered}
    )
    return _crop(result, covered) if crop else result


def _crop(recording: Recording, covered: NDArray[np.bool_]) -> Recording:
    """The recording's largest rectangle of covered pixels."""
    left, top, right, bottom = largest_rectangle(covered)
    events = recording.events[0 : len(recording.events)]
    inside = (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
    if not inside.any() or recording.frames is None:
        raise InputError(
            f"{recording.name}: no event lies on the pixels that the other camera sees; correct "
            "the calibration or homography, or do not crop"
        )
    kept = Events(
        events.t[inside],
        (events.x[inside] - left).astype(np.uint16),
        (events.y[inside] - top).astype(np.uint16),
        events.p[inside],
    )
    frames, camera = recording.frames, recording.camera
    images = np.asarray(frames.images)[:, top:bottom, left:right]
    if camera is not None:
        camera = dataclasses.replace(camera, cx=camera.cx - left, cy=camera.cy - top)
    extra: dict[str, Any] = dict(recording.extra)
    size = recording.height, recording.width
    for name, values in recording.extra.items():
        for axis in range(values.ndim - 1):
            if values.shape[axis : axis + 2] == size:
                here = (slice(None),) * axis
                extra[name] = values[*here, top:bottom, left:right]
                break
    if "homography" in extra:
        shift = np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]])
        extra["homography"] = extra["homography"] @ shift
    extra.pop("hot", None)
    return dataclasses.replace(
        recording,
        width=right - left,
        height=bottom - top,
        events=kept,
        frames=Frames(frames.t, images, frames.exposure),
        camera=camera,
        extra=extra,
    )


def largest_rectangle(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """left, top, right, bottom of the largest rectangle of True, the ends excluded."""
    best, found = 0, (0, 0, 0, 0)
    run = np.zeros(mask.shape[1] + 1, int)
    for y, row in enumerate(mask):
        run[:-1] = np.where(row, run[:-1] + 1, 0)
        stack: list[int] = []
        for x, high in enumerate(run):
            while stack and run[stack[-1]] >= high:
                tall = int(run[stack.pop()])
                left = stack[-1] + 1 if stack else 0
                if tall * (x - left) > best:
                    best, found = tall * (x - left), (left, y - tall + 1, x, y + 1)
            stack.append(x)
    return found
