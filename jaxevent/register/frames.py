"""Frames of the other camera: how they are read, compared and resampled to the event camera."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from jaxevent.display import format_span
from jaxevent.errors import InputError
from jaxevent.io import load
from jaxevent.io.images import Scale, is_series, kept_colours, read_series
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register.geometry import Grid, Registration, pixel_scale

_DARK_INTENSITY = 0.05  # intensity, added inside logarithms against the noise of dark pixels
_CLIPPED_GREY_MARGIN = (
    0.012  # grey, distance from either end below which pixels are clipped: 3 of 255
)


def read_frames(
    path: str | Path,
    *,
    reference: bool = False,
    exposure: float | int | None = None,
    white: float | int | None = None,
    frames: str | None = None,
    progress: bool | None = None,
) -> Recording:
    """Read another camera's frames, as a recording that need not hold events.

    Args:
        path: A file or folder that `jaxevent.load` reads, or images as of `jaxevent.io.images`: a
            folder of PNG, TIFF, JPEG or .npy with timestamps.txt or images.txt of lines "t name",
            or HDF5 of t and image.
        reference: Whether to prefer HDR images (`extra["hdr"]` and `extra["hdr_t"]`) to frames.
        exposure: Exposure of such images, s, if their timestamps do not hold it.
        white: Value of such images that is intensity 1.
        frames: Kind of images of a recording that has several, as in `jaxevent.load`. Events
            beside them may be of another camera, and are left out.
        progress: Whether to show progress; by default on a terminal.

    Returns:
        A recording with frames. Colours are in `extra["rgb"]`.

    Raises:
        InputError: The path cannot be read, or holds no frames.
    """

    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    if is_series(path):
        if frames is not None:
            raise InputError(f"{path}: holds one kind of images; leave out frames")
        recording = _read_image_series(path, exposure, white, reference)
    else:
        stream = None if frames is None else "none"
        recording = load(path, in_memory=False, stream=stream, frames=frames, progress=progress)
        if exposure is not None or white is not None:
            name = "exposure" if white is None else "white"
            raise InputError(f"{path}: is a recording, which has its own {name}; leave out {name}")
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


def _read_image_series(
    path: Path, exposure: float | int | None, white: float | int | None, reference: bool
) -> Recording:
    """Read a folder or file of images with time stamps.

    Args:
        path: The folder or file.
        exposure: Length of the exposures, s; None: that of the time stamps.
        white: Value of intensity 1; None: as of `Scale`.
        reference: Whether the images are a reference: without colours, and with any intensity.

    Returns:
        A recording of frames alone.

    Raises:
        InputError: A number is not possible, or images differ in size.
    """
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
        raise InputError(f"{path}: its timestamps hold the exposures; leave out exposure")
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
    """Return the log intensity of a frame.

    Args:
        other: A recording with frames.
        row: Row of the frame.

    Returns:
        ln(I + 0.05) (height, width), and whether pixels are not clipped (height, width).
    """
    assert other.frames is not None
    grey = other.frames[row : row + 1].intensity[0].astype(np.float64)
    if other.frames.images.dtype.kind == "f" and np.nanmax(grey) > 1:
        good, intensity = np.isfinite(grey), np.nan_to_num(grey)
    else:
        good = (grey > _CLIPPED_GREY_MARGIN) & (grey < 1 - _CLIPPED_GREY_MARGIN)
        intensity = np.asarray(other.response.intensity(np.nan_to_num(grey)), np.float64)
        intensity = intensity / other.gain[row]
    return np.log(np.maximum(intensity, 0) + _DARK_INTENSITY), good


_FRAME_EXTRAS = (
    "response",
    "certainty",
    "f_Q",
    "clip",
    "gain",
    "rgb",
    "read_noise",
    "clock_offset",
)


class ResampledImages:
    """Images resampled by a grid, an `ImageSource` of shape (frames, height, width[, 3]).

    Cubic convolution (Keys 1981) of the grey values as they are, with several samples to a pixel
    where the other camera resolves more, so that each pixel shows the mean of what it covers.
    Integers are rounded. Pixels of which half or more comes from a clipped end of integer levels
    keep that end.

    Args:
        images: (frames, h, w) or (frames, h, w, 3), in memory or an `ImageSource`.
        grid: (height, width, 2) x, y in these images, px.
        fill: Value of pixels that the other camera does not see.
    """

    def __init__(
        self,
        images: Any,
        grid: Grid,
        fill: float | int = 0,
        _resampling: "tuple[Any, NDArray[np.bool_]] | None" = None,
    ):
        self._images, self._grid, self._fill = images, grid, fill
        self._resampling = (
            _resampling_matrix(grid, images.shape[1:3]) if _resampling is None else _resampling
        )
        self.dtype: np.dtype = np.dtype(images.dtype)
        self.shape = (images.shape[0], *grid.shape[:2], *images.shape[3:])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> "ResampledImages":
        images = self._images[rows]
        if len(images.shape) != len(self._images.shape):
            raise IndexError("take several images, by a slice or an array")
        return ResampledImages(images, self._grid, self._fill, self._resampling)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        weights, covered = self._resampling
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
            low, high = (self._local_extreme(f, image) for f in (np.fmin, np.fmax))
            values = np.clip(values, low, high)
            if whole:
                values = np.rint(values)
            values = np.where(covered.reshape(-1, 1), values, self._fill)
            out[row] = values.reshape(out[row].shape).astype(self.dtype)
        return out if dtype is None else out.astype(dtype)

    def _local_extreme(self, extreme: Any, image: NDArray) -> NDArray[np.float64]:
        """Return the extreme value within each pixel's reach, which limits overshoots.

        Args:
            extreme: `np.fmin` for the least, `np.fmax` for the greatest value.
            image: (h, w) or (h, w, 3), an image of the other camera.

        Returns:
            (pixels, 1) or (pixels, 3).
        """
        reach = 2 * math.ceil(max(pixel_scale(self._grid), 1)) + 1
        size = (reach, reach) + (1,) * (image.ndim - 2)
        find = ndimage.minimum_filter if extreme is np.fmin else ndimage.maximum_filter
        found = find(image.astype(np.float64), size, mode="nearest")
        at = np.rint(np.nan_to_num(self._grid)).astype(int).reshape(-1, 2)
        return found[at[:, 1], at[:, 0]].reshape(len(at), -1)


def _resampling_matrix(grid: Grid, shape: tuple[int, int]) -> tuple[Any, NDArray[np.bool_]]:
    """Make the matrix of cubic convolution that resamples images.

    Keys, "Cubic convolution interpolation for digital image processing", 1981, a = -1/2. If the
    grid's steps are s > 1 px, ceil(s)^2 samples are averaged over each pixel.
    Args:
        grid: (height, width, 2) x and y in the other camera's images, px, NaN outside.
        shape: Height and width of these images, px.

    Returns:
        The matrix (pixels, other pixels), sparse, and which pixels are seen (height, width).
    """
    height, width = grid.shape[:2]
    covered = ~np.isnan(grid[..., 0])
    count = min(max(1, math.ceil(pixel_scale(grid) - 0.25)), 16)
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
            wx, wy = _keys_weights(at[:, 0] - i[:, 0]), _keys_weights(at[:, 1] - i[:, 1])
            columns = np.clip(i[:, :1] + np.arange(-1, 3), 0, shape[1] - 1)
            rows = np.clip(i[:, 1:] + np.arange(-1, 3), 0, shape[0] - 1)
            source = (rows[:, :, None] * shape[1] + columns[:, None]).reshape(len(pixel), -1)
            weight = (wy[:, :, None] * wx[:, None]).reshape(len(pixel), -1) / count**2
            entries = (weight.ravel(), (np.repeat(pixel, 16), source.ravel()))
            total = total + sparse.coo_array(entries, total.shape).tocsr()
    return total, covered


def _keys_weights(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (n, 4) of the values at -1, 0, 1, 2 for positions s in [0, 1)."""
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


def apply_registration(
    recording: Recording,
    other: Recording,
    found: Registration,
    *,
    crop: bool = False,
    reference: bool = False,
) -> Recording:
    """Return the recording with the other camera's frames on its pixels and clock.

    Events, calibration, poses and IMU stay; its own frames are replaced, and in `extra` the
    properties of frames by those of the other recording (response, gain, colours). Frames more than
    a frame before or after the events are left out. Pixels that the other camera does not see are
    black, 0: frames may not hold NaN, and black counts as little as a clipped pixel. `extra` gets:

    - covered (height, width) bool: the pixels that the other camera sees;
    - register_offset: `found.offset`, s;
    - homography (3, 3), if there is one.

    Args:
        recording: Recording of the event camera.
        other: Frames of the other camera.
        found: Their registration.
        crop: Whether to cut the recording to the largest rectangle of pixels that are seen, so that
            black borders are not taken for the truth, by a fit for example.
        reference: Whether images become the HDR reference instead of frames: `extra` gets hdr
            (T, height, width) float32, NaN for unseen pixels, and hdr_t.

    Returns:
        The recording.

    Raises:
        InputError: No frame falls into the time of the events, or nothing is seen.
    """
    assert other.frames is not None
    t = other.frames.t + round(found.offset * 1e6)
    gap = int(np.median(np.diff(t))) if len(t) > 1 else 0
    begin, end = recording.event_span()
    rows = np.flatnonzero((t >= begin - gap) & (t <= end + gap))
    if not len(rows):
        raise InputError(
            f"{other.name}: with the offset {found.offset:g} s its frames are from "
            f"{format_span(t)}, the events from {format_span((begin, end))}; give the offset that "
            "is added to the frames' time stamps"
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
        images = ResampledImages(other.frames.images[rows], found.grid, math.nan)
        images = np.asarray(images, np.float32)
        return dataclasses.replace(recording, extra={**extra, "hdr": images, "hdr_t": t[rows]})
    for name in _FRAME_EXTRAS:
        extra.pop(name, None)
    theirs = other.with_frames(rows).extra
    extra |= {name: theirs[name] for name in _FRAME_EXTRAS if name in theirs}
    if "rgb" in theirs:
        extra["rgb"] = np.asarray(ResampledImages(theirs["rgb"], found.grid))
    images = ResampledImages(other.frames.images[rows], found.grid)
    frames = Frames(t[rows], images, other.frames.exposure[rows])
    result = dataclasses.replace(
        recording, frames=frames, extra={**extra, **about, "covered": covered}
    )
    return _crop(result, covered) if crop else result


def _crop(recording: Recording, covered: NDArray[np.bool_]) -> Recording:
    """Crop a recording to its largest rectangle of covered pixels.

    Args:
        recording: A recording with frames.
        covered: (H, W) whether the other camera sees a pixel.

    Returns:
        The recording of these pixels.

    Raises:
        InputError: No event lies on them.
    """
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
    """Return left, top, right, bottom of the largest rectangle of True, the ends excluded."""
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
