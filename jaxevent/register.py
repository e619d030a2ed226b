"""Frames of a separate camera brought onto the event camera's pixels and clock.

    from jaxevent import register

    other = register.read_frames("colour_camera.h5")            # any recording, or a folder
    found = register.estimate(recording, other)                 # distant scene: a homography
    hybrid = register.registered(recording, other, found)       # a recording as any other

    rig = register.Rig.read("rig.toml")                         # or calibrated
    grid = rig.grid((346, 260), (1440, 1080), depth=2.5)
    found = register.estimate(recording, other, grid)           # then only the clock is unknown

A *grid* (height, width, 2) says at which x, y of the other camera's images each pixel of the event
camera looks, NaN where it does not see the same. Pixel centres are whole numbers. The offset of the
clocks (s) is added to the other camera's time stamps to get times of the events' clock, as
`clock_offset` of the estimators is.

Homographies map places of the event camera to places of the other one, [u, v, w] = H [x, y, 1].
Both are of images whose distortion has been undone where the camera's calibration tells it.

The images of two pin-hole cameras are related by a homography if the scene is far away, or a plane:
what is nearer than the baseline times the focal length (px) is off by more than one pixel.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError, require
from jaxevent.io.images import Scale, is_series, read_series
from jaxevent.recording import Events, Frames, Recording

Grid = NDArray[np.float64]

_LEVELS = (4.0, 2.0, 1.2)  # px of the event camera by which changes are smoothed, in turn
_STEPS = 12  # Gauss-Newton steps of a level at most
_SPANS = 32  # pairs of frames that are compared
_MOST_PIXELS = 40_000  # of a pair that are compared
_I0 = 0.05  # intensity inside logarithms: noise of dark pixels stays small
_CLIPPED = 0.012  # grey from either end within which frames say nothing: three levels of 255
_KNOWN = 0.75  # of a smoothed change that unclipped pixels tell, where it counts
_AGREE = 0.25  # correlation of changes below which a registration is refused
_FEWEST = 12  # matches that agree on a homography
_TOLERANCE = 3.0  # px of the other camera between matches and the homography
_RATIO = 0.75  # of the distances to the nearest and the second descriptor; Lowe's 0.8 is laxer
_MATCHED = 16  # frames whose features are matched
_WIDEST = 400  # px to which wider images of events are shrunk for that
_ALPHAS = (1.0, 3.0)  # rad/s, cut-off of the reconstructions that are matched
_APART = (1, 3)  # frames between which changes are matched
_CANDIDATES = 4  # offsets that are tried
_CELLS = 64  # to the width of an image, where clocks are compared
_BLOCK = 128  # steps of that raster held at a time

# What `extra` tells of the frames, so that it is replaced with them.
_OF_FRAMES = ("response", "certainty", "f_Q", "clip", "gain", "rgb", "read_noise", "clock_offset")


@dataclasses.dataclass(frozen=True)
class Registration:
    """How another camera's frames fit the events.

    `grid` as the module says; `offset` (s) is added to their time stamps; `homography` (3, 3) where
    the grid is that of one. `agreement` is the correlation, over pixels and frames, of the change
    of ln intensity between frames with what the events say of it (1: all the same), None where
    nothing was estimated.
    """

    grid: Grid
    offset: float
    homography: NDArray[np.float64] | None = None
    agreement: float | None = None


@dataclasses.dataclass(frozen=True)
class Rig:
    """Calibration of an event camera and another one.

    A place X (m) in the event camera's axes (x to the right, y down, z forward) is
    rotation @ X + translation in the other's: `rotation` (3, 3), `translation` (3,) in m.
    Raises `InputError` for a matrix that is no rotation and for focal lengths that are not
    positive.
    """

    events: PinholeCamera
    frames: PinholeCamera
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def __post_init__(self) -> None:
        rotation, translation = (
            np.asarray(part, np.float64) for part in (self.rotation, self.translation)
        )
        turned = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), 0, 1e-4)
        if not turned or np.linalg.det(rotation) < 0:
            raise InputError(
                f"the rotation {rotation.tolist()} between the cameras is not a rotation matrix; "
                "give three orthonormal rows, right-handed"
            )
        if translation.shape != (3,) or not np.isfinite(translation).all():
            raise InputError(
                f"the translation {translation.tolist()} between the cameras cannot be used; give "
                "three finite numbers in m"
            )
        for camera in (self.events, self.frames):
            _check(camera)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def read(cls, path: str | Path, events: PinholeCamera | None = None) -> "Rig":
        """A rig from a TOML file.

            [events]                                  # default: the recording's, `events`
            camera = [fx, fy, cx, cy, k1, k2, p1, p2, k3]    # px, Brown-Conrady; or the first four
            [frames]
            camera = [fx, fy, cx, cy, k1, k2, p1, p2, k3]
            transform = [[...], [...], [...], [0, 0, 0, 1]]  # 4 x 4, or its first three rows

        `transform` takes places (m) from the event camera's axes to the other's, as Kalibr's
        T_cn_cnm1 does if the event camera was its cam0. Raises `InputError` naming what is wrong.
        """
        from jaxevent.io import pinhole
        from jaxevent.parameters import read_toml

        table = read_toml(Path(path))
        known = {"events": {"camera"}, "frames": {"camera", "transform"}}
        for name, part in table.items():
            if name not in known or not isinstance(part, dict) or not set(part) <= known[name]:
                raise InputError(
                    f"{path}: [{name}] is not known or holds more than camera and transform; give "
                    "[events] camera and [frames] camera, transform"
                )

        def camera(name: str) -> PinholeCamera | None:
            values = table.get(name, {}).get("camera")
            if values is None:
                return None
            numbers = np.ravel(_numbers(values, f"{path}: [{name}] camera"))
            if len(numbers) == 4:
                numbers = np.concatenate([numbers, np.zeros(5)])
            return pinhole(numbers, f"{path}: [{name}] camera")

        own, other = camera("events") or events, camera("frames")
        if own is None or other is None:
            raise InputError(
                f"{path}: has no camera of the {'frames' if own else 'events'}, nor has the "
                f"recording; add [{'frames' if own else 'events'}] camera = [fx, fy, cx, cy, ...]"
            )
        where = f"{path}: [frames] transform"
        transform = _numbers(table.get("frames", {}).get("transform", np.eye(4).tolist()), where)
        if transform.shape not in ((3, 4), (4, 4)):
            raise InputError(f"{where} has the shape {transform.shape}; give four rows of four")
        try:
            return cls(own, other, transform[:3, :3], transform[:3, 3])
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def grid(
        self,
        size: tuple[int, int],
        other: tuple[int, int],
        *,
        depth: ArrayLike | float | int = math.inf,
        plane: tuple[float | int, float | int, float | int, float | int] | None = None,
    ) -> Grid:
        """Where each pixel's view lies in the other camera's images.

        Hartley and Zisserman, Multiple View Geometry, 2nd ed., sections 6.1 and 7.4: the pixel's
        distortion is undone, its ray X = Z (x, y, 1) ends at `depth`, and X is projected.

        Args:
            size: (width, height) of the event camera.
            other: (width, height) of the other one.
            depth: Z in m in the event camera, one number or (height, width); infinite: so far
                that the translation does not matter, NaN: not known. What is hidden from the other
                camera by something nearer is not noticed.
            plane: (a, b, c, d): the scene is a X + b Y + c Z = d, m, in the event camera's axes,
                instead of `depth`.

        Raises:
            InputError: The depth is of another shape or not positive, the plane is none, or the
                distortion of the event camera has no inverse in its image.
        """
        width, height = size
        ray = _rays(self.events, size)
        if plane is not None:
            normal, distance = np.asarray(plane[:3], np.float64), float(plane[3])
            if not np.isfinite(plane).all() or not normal.any() or distance == 0:
                raise InputError(
                    f"the plane {list(plane)} is none that a camera can see; give a, b, c, d of "
                    "a X + b Y + c Z = d with d in m, not 0"
                )
            facing = ray @ normal
            Z = distance / np.where(facing == 0, np.nan, facing)
        else:
            Z = np.asarray(depth, np.float64)
            if Z.shape not in ((), (height, width)) or (Z <= 0).any() or np.isnan(Z).all():
                raise InputError(
                    f"a depth of shape {Z.shape} from {Z.min():g} m cannot be used; give metres "
                    f"above 0, one number or ({height}, {width})"
                )
            Z = np.broadcast_to(Z, (height, width)).ravel()
        ahead = Z > 0
        # X / Z, so that infinite depth is no special case.
        seen = ray @ self.rotation.T + self.translation / np.where(ahead, Z, np.nan)[:, None]
        return _inside(_projected(self.frames, seen), other).reshape(height, width, 2)


def homography_grid(
    homography: ArrayLike,
    size: tuple[int, int],
    other: tuple[int, int],
    camera: PinholeCamera | None = None,
    other_camera: PinholeCamera | None = None,
) -> Grid:
    """The grid (height, width, 2) of a homography (3, 3), see the module.

    `size` and `other` are (width, height) of the event camera and of the other one, `camera` and
    `other_camera` the calibrations whose distortion is undone, None for none. Raises `InputError`
    for a matrix that is no homography.
    """
    at = _moved(_homography(homography), _straight(camera, size))
    return _inside(_bent(other_camera, at), other).reshape(*size[::-1], 2)


def read_homography(path: str | Path) -> NDArray[np.float64]:
    """A homography from text: three lines of three numbers, parted by commas or spaces.

    Raises `InputError` for other contents.
    """
    from jaxevent.io import reading

    with reading(str(path)):
        text = Path(path).read_text(encoding="utf-8")
    try:
        rows = [
            [float(word) for word in line.replace(",", " ").split()]
            for line in text.splitlines()
            if line.strip() and not line.startswith("#")
        ]
        return _homography(np.array(rows))
    except ValueError as error:
        why = str(error) if isinstance(error, InputError) else "it is not a table of numbers"
        raise InputError(f"{path}: {why}; give three lines of three numbers") from None


def read_depth(text: str, size: tuple[int, int]) -> NDArray[np.float64]:
    """Depth in m: a number, or the name of an .npy file of (height, width), `size` transposed.

    Raises `InputError` for anything else.
    """
    from jaxevent.io import reading

    try:
        return np.array(float(text))
    except ValueError:
        pass
    with reading(text):
        depth = np.load(text, allow_pickle=False)
    if depth.shape != size[::-1] or depth.dtype.kind not in "iuf":
        raise InputError(
            f"{text}: is {depth.dtype} of shape {depth.shape}; give metres of shape {size[::-1]}"
        )
    return depth.astype(np.float64)


def seen(grid: Grid) -> float:
    """The part of the event camera's pixels that the other camera sees."""
    return float(np.mean(~np.isnan(grid[..., 0])))


def read_frames(
    path: str | Path,
    *,
    reference: bool = False,
    exposure: float | int | None = None,
    white: float | int | None = None,
    progress: bool = False,
) -> Recording:
    """Another camera's frames, as a recording that need not hold events.

    `path` is anything that `jaxevent.load` reads, whose frames are taken, or images as of
    `jaxevent.io.images`: a folder of PNG, TIFF, JPEG or .npy with timestamps.txt or images.txt
    of lines "t name", or HDF5 of t and image. `exposure` (s) is that of the latter, which do not
    tell it. With `reference`, of a recording its HDR images are taken if it holds any
    (`extra["hdr"]` and `extra["hdr_t"]`), and `white` is the value of images that is intensity 1.
    Raises `InputError` for what cannot be read and where there are no frames.
    """
    from jaxevent.io import load

    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    if is_series(path):
        recording = _series(path, exposure, white, reference)
    else:
        recording = load(path, in_memory=False, progress=progress)
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
                recording, frames=Frames(t, images, np.zeros(len(t), np.int64))
            )
    if recording.frames is None:
        raise InputError(f"{path}: holds no frames; give the other camera's recording or images")
    return dataclasses.replace(recording, name=str(path))


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
        self._how = _weights(grid, images.shape[1:3]) if _how is None else _how
        self.dtype = np.dtype(images.dtype)
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
        reach = 2 * math.ceil(max(_scale(self._grid), 1)) + 1
        size = (reach, reach) + (1,) * (image.ndim - 2)
        find = ndimage.minimum_filter if extreme is np.fmin else ndimage.maximum_filter
        found = find(image.astype(np.float64), size, mode="nearest")
        at = np.rint(np.nan_to_num(self._grid)).astype(int).reshape(-1, 2)
        return found[at[:, 1], at[:, 0]].reshape(len(at), -1)


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
    begin, end = _span(recording)
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
    return _cropped(result, covered) if crop else result


def estimate(
    recording: Recording,
    other: Recording,
    grid: Grid | None = None,
    *,
    homography: ArrayLike | None = None,
    offset: float | int | None = None,
    search: float | int | None = None,
    progress: bool = False,
) -> Registration:
    """How another camera's frames fit the events: what is not given is estimated.

    Without `grid` and `homography` (3, 3) a homography is, that of a distant or flat scene:
    features (SIFT, Lowe 2004) of frames, and of their differences, are matched with those of what
    the events alone say of the same times (`jaxevent.high_pass`, and their sums), RANSAC (Barath et
    al., MAGSAC++, CVPR 2020) finds the homography of most of them, and `refine`, which needs no
    features, makes it sub-pixel. Only this needs OpenCV: pip install 'jaxevent[vision]'. The
    cameras must have moved, or the scene.

    Without `offset` (s, added to the frames' time stamps) the clocks are compared: offsets are
    tried at which the frames change when the events say so (`clock_offsets`), up to `search` s
    either way, by default wherever the recordings overlap by half, and the best one is refined
    together with the homography, or alone. A given grid, homography or offset is kept as it is.

    Simulated rigs of 2.5 decades (`experiments/register.py`): 0.04 to 0.16 px rms, clock to 0.6 ms
    or, where images move 20 to 40 px/s, to 2.4 ms. Where frames clip most of what moves (4.5
    decades) up to 1.1 px and 15 ms were seen: take a recording of a scene that frames resolve.

    Raises `InputError` for too few matches, and if the changes of frames and events do not agree in
    the end: correlation below 0.25.
    """
    frames = other.frames
    if frames is None or not len(recording.events):
        raise InputError(
            f"{(other if frames is None else recording).name}: holds no "
            f"{'frames' if frames is None else 'events'}, so there is nothing to register"
        )
    if offset is not None and not math.isfinite(offset):
        raise InputError(f"the offset {offset} of the clocks is not possible; give seconds")
    if search is not None and not 0 < search < math.inf:
        raise InputError(f"a search of {search} s is not possible; give seconds above 0")
    if homography is not None:
        homography = _homography(homography)
        grid = _grid_of(recording, other, homography)
    if grid is not None and np.isnan(grid).all():
        raise InputError(
            f"{other.name}: shows nothing that the event camera sees; correct the calibration, the "
            "depth or the homography"
        )
    if grid is not None and offset is not None:
        return Registration(grid, float(offset), homography)
    if len(frames) < 3:
        raise InputError(
            f"{other.name}: holds {len(frames)} frames, and estimating needs 3; give the offset "
            "and the homography or calibration"
        )
    offsets = [float(offset)] if offset is not None else clock_offsets(recording, other, search)
    best, problem = None, None
    for candidate in offsets:
        try:
            starts = None if grid is not None else _match(recording, other, candidate, progress)
            now = refine(recording, other, candidate, grid, starts, keep_offset=offset is not None)
        except InputError as error:
            problem = problem or error
            continue
        if best is None or (now.agreement or 0) > (best.agreement or 0):
            best = now
        if (now.agreement or 0) > 2 * _AGREE:
            break
    if best is None:
        assert problem is not None
        raise problem
    if (best.agreement or 0) < _AGREE:
        raise InputError(
            f"{other.name}: what its frames show and the events do not agree, the correlation of "
            f"their changes is {best.agreement:.2f}; give what is known of the offset, homography "
            "or calibration, or a part of the recordings in which the cameras move more"
        )
    return dataclasses.replace(best, homography=homography) if grid is not None else best


def clock_offsets(
    recording: Recording, other: Recording, search: float | int | None = None
) -> list[float]:
    """Offsets (s) at which the frames' changes go with the events', the likeliest first.

    Both are reduced to about 64 x 48 cells on a raster of half a frame: the change of ln intensity
    from a frame to the next, and ON minus OFF events of as long a time. Two things are correlated
    at every lag (Pearson's r of what overlaps; Padfield, CVPR 2010): how large the changes are, the
    logarithm of the mean of their absolute values at two smoothnesses, for which the cameras need
    not look the same way; and, counted twice, the smoothed changes at places as they are, for which
    they should, roughly. Up to four maxima of the sum with half the best one or more, and 0 where
    clocks may be the same. Right to about half a frame, which is enough for `refine`.

    `search` (s) bounds the offset; by default the overlap is at least half the shorter recording.
    Raises `InputError` if no offset lets them overlap.
    """
    assert other.frames is not None
    t = other.frames.t
    step = max(float(np.median(np.diff(t))) / 2, 1.0)
    begin, _ = _span(recording)
    both = [_changes_of_events(recording, step), _changes_of_frames(other)]
    middle, along = (t[1:] + t[:-1]) / 2, begin + step * (np.arange(len(both[0])) + 1)
    across = np.arange(middle[0], middle[-1] + 1e-3, step)
    if len(across) < 6 or len(along) < 6:
        return [0.0]
    weights = np.append([0.5, 0.5], np.full(both[0].shape[1] - 2, 2 / (both[0].shape[1] - 2)))
    total, n = np.zeros(()), np.zeros(0)
    for weight, one, two in zip(weights, both[0].T, both[1].T, strict=True):
        r, n = _correlation(one, np.interp(across, middle, two))
        total = total + weight * r
    lags = (np.arange(len(n)) - (len(across) - 1)) * step + along[0] - across[0]
    fewest = max(6, min(len(along), len(across)) / 2 * (search is None))
    allowed = (n >= fewest) & (np.abs(lags) <= (math.inf if search is None else search * 1e6))
    around = np.pad(np.where(allowed, total, -np.inf), 1, constant_values=-np.inf)
    score = around[1:-1]
    peaks = np.flatnonzero((score >= around[:-2]) & (score > around[2:]) & (score > 0))
    peaks = peaks[np.argsort(-score[peaks], kind="stable")][:_CANDIDATES]
    found = []
    for peak in peaks:
        if score[peak] < score[peaks[0]] / 2:
            break
        left, top, right = around[peak : peak + 3]
        bend = left - 2 * top + right
        shift = 0.5 * (left - right) / bend if np.isfinite(bend) and bend < 0 else 0.0
        found.append(float((lags[peak] + shift * step) * 1e-6))
    same = bool(allowed[np.argmin(np.abs(lags))]) and abs(lags).min() <= step
    if same and all(abs(one) > 1e-6 * step for one in found):
        found.append(0.0)
    if not found:
        raise InputError(
            f"{other.name}: no offset of its clock brings its frames and the events together; give "
            "the offset that is added to the frames' time stamps"
        )
    return found


def _signature(change: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is compared of changes (times, rows, cells): two sizes, then places, (times, ...)."""
    smooth: list[NDArray] = [
        ndimage.gaussian_filter(change, (0, sigma, sigma)) for sigma in (1.5, 4)
    ]
    sizes = [np.log(np.abs(one).mean((1, 2)) + 1e-5) for one in smooth]
    wide: NDArray = ndimage.gaussian_filter(change, (0, 8, 8), mode="constant")
    middle = wide.shape[1] // 2
    # Six rows of eight about the middle, wherever the images end.
    rows = np.clip(middle + np.arange(-20, 21, 8), 0, wide.shape[1] - 1)
    places = wide[:, rows][:, :, 4::8].reshape(len(wide), -1)
    return np.concatenate([np.stack(sizes, 1), places], 1)


def _cells(width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """The row and the column of cells of pixel rows and columns, and the number of rows."""
    rows = max(1, round(height * _CELLS / width))
    down = np.minimum(np.arange(height) * _CELLS // width, rows - 1)
    return down, np.arange(width) * _CELLS // width, rows


def _changes_of_frames(other: Recording) -> NDArray[np.float64]:
    """The signature of the change of ln intensity from each frame to the next."""
    assert other.frames is not None
    down, along, rows = _cells(other.width, other.height)
    place = (down[:, None] * _CELLS + along).ravel()
    count = np.maximum(np.bincount(place, minlength=rows * _CELLS), 1)
    out, before = [], _log_image(other, 0)
    for first in range(1, len(other.frames), _BLOCK):
        changes = []
        for row in range(first, min(first + _BLOCK, len(other.frames))):
            level, good = _log_image(other, row)
            change = np.where(good & before[1], level - before[0], 0).ravel()
            changes.append(np.bincount(place, change, rows * _CELLS) / count)
            before = level, good
        out.append(_signature(np.stack(changes).reshape(-1, rows, _CELLS)))
    return np.concatenate(out)


def _changes_of_events(recording: Recording, step: float) -> NDArray[np.float64]:
    """The same of 0.2 (ON - OFF) per pixel in windows of two steps (us), a step apart."""
    down, along, rows = _cells(recording.width, recording.height)
    begin, end = _span(recording)
    steps, out = int((end - begin) / step) + 1, []
    for first in range(0, max(steps - 1, 1), _BLOCK):
        count = min(_BLOCK + 1, steps - first)
        edges = (begin + math.ceil(k * step) for k in (first, first + count))
        events = recording.events[slice(*(recording.events.index(edge) for edge in edges))]
        when = np.clip(((events.t - begin) / step).astype(int) - first, 0, count - 1)
        place = (when * rows + down[events.y]) * _CELLS + along[events.x]
        sign = np.where(events.p, 0.2, -0.2) * _CELLS**2 / recording.width**2
        net = np.bincount(place, sign, count * rows * _CELLS).astype(np.float64)
        net = net.reshape(count, rows, _CELLS)
        out.append(_signature(net[1:] + net[:-1]))
    return np.concatenate(out)


def refine(
    recording: Recording,
    other: Recording,
    offset: float | int,
    grid: Grid | None = None,
    homographies: Sequence[ArrayLike] | None = None,
    *,
    keep_offset: bool = False,
) -> Registration:
    """Make an offset (s), and a homography unless a `grid` is given, sub-ms and sub-pixel.

    Between two frames ln intensity changes by D, and by what the events say of the same time: with
    W the place that a pixel sees and o the offset,

        D(W(x; h)) = a ON(x; o) - b OFF(x; o) + const,

    ON and OFF being the numbers of events from one mid-exposure to the other. h, o and the
    thresholds a, b minimise the sum of squares over pixels and 32 pairs of frames, under Huber's
    weights, by Gauss-Newton steps from coarse to fine (smoothed by 4, 2 and 1.2 px): alignment as
    that of Evangelidis and Psarakis, PAMI 2008, but of images of change, in which both cameras
    measure the same, so that the lag of a reconstruction has no part in it. Clipped pixels do not
    count. The homography is moved by the places of the image's corners.

    Takes a start within about 5 px and half a frame; of several `homographies` (3, 3) the one
    with which the changes agree best is. Raises `InputError` if frames and events share
    nothing to compare.
    """
    if (grid is None) == (not homographies):
        raise InputError("give either a grid or homographies to start from")
    starts = [None] if grid is not None else [_homography(one) for one in homographies or ()]
    tries = []
    for H in starts:
        problem = _Changes(recording, other, grid, H, keep_offset)
        at = np.append(problem.corners, float(offset))
        with contextlib.suppress(InputError):
            problem.choose(float(offset))
            tries.append((problem.fit(at, _LEVELS[0]).agreement, H, problem, at))
    if not tries:
        raise InputError(
            f"{other.name}: with the offset {offset:g} s its frames show too little, unclipped, of "
            "what the events show to compare them; give another offset, homography or calibration"
        )
    agreement, H, problem, at = max(tries, key=lambda one: one[0])
    for sigma in _LEVELS:
        at, agreement = problem.solve(at, sigma)
        if agreement < _AGREE / 2:  # hopeless; those that are right begin above a half
            break
    if H is not None:
        H = problem.homography(at)
        grid = _grid_of(recording, other, H)
    assert grid is not None
    return Registration(grid, float(at[-1]), H, float(agreement))


@dataclasses.dataclass(frozen=True)
class _Fit:
    """What is compared at a place: (values, ...) of all pairs, and how well it fits."""

    X: NDArray[np.float64]  # (values, 3): ON, OFF and 1
    D: NDArray[np.float64]  # (values,)
    slope: NDArray[np.float64]  # (values, 2) of D, per px of the other camera
    use: NDArray[np.bool_]  # (pairs, n): which these are
    weight: NDArray[np.float64]  # (values,)
    b: NDArray[np.float64]  # (3,)
    agreement: float


class _Changes:
    """Changes between pairs of frames, of the frames and of the events; see `refine`."""

    def __init__(
        self,
        recording: Recording,
        other: Recording,
        grid: Grid | None,
        homography: NDArray[np.float64] | None,
        keep_offset: bool,
    ):
        self.recording, self.other, self.keep_offset = recording, other, keep_offset
        self.size = recording.width, recording.height
        width, height = self.size
        self.shape = other.height, other.width
        self.finest = max(1, math.ceil(math.sqrt(width * height / _MOST_PIXELS)))
        self.stride = self.finest
        self.fixed = None if grid is None or homography is not None else grid
        self.corners = np.empty(0)
        self.frame = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        if homography is not None:
            self.corners = _moved(homography, self.frame).ravel()
        self.pixels = _straight(recording.camera, self.size).reshape(height, width, 2)
        self.pairs: NDArray[np.intp] | None = None
        self._near: tuple[float, list] | None = None
        self._images: tuple[Any, Any] = None, None

    def homography(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """The homography that moves the image's corners to at[:8] (Hartley, Zisserman, 4.1)."""
        rows, values = [], []
        for (x, y), (u, v) in zip(self.frame, at[:8].reshape(4, 2), strict=True):
            rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
            values += [u, v]
        return np.append(np.linalg.solve(np.array(rows), values), 1.0).reshape(3, 3)

    def places(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the compared pixels look, (n, 2), NaN outside."""
        s = self.stride
        if self.fixed is not None:
            return self.fixed[s // 2 :: s, s // 2 :: s].reshape(-1, 2)
        pixels = self.pixels[s // 2 :: s, s // 2 :: s].reshape(-1, 2)
        seen = _bent(self.other.camera, _moved(self.homography(at), pixels))
        return _inside(seen, (self.other.width, self.other.height))

    def choose(self, offset: float) -> None:
        """The pairs of frames: those with the most events, with about an event per pixel each."""
        assert self.other.frames is not None
        t = self.other.frames.t + round(offset * 1e6)
        begin, end = _span(self.recording)
        inside = np.flatnonzero((t >= begin) & (t <= end))
        if len(inside) < 2:
            raise InputError(
                f"{self.other.name}: with the offset {offset:g} s no two of its frames fall into "
                "the time of the events; give another offset"
            )
        index = np.array([self.recording.events.index(int(one)) for one in t[inside]])
        each = max((index[-1] - index[0]) / (len(index) - 1), 1) / (self.size[0] * self.size[1])
        apart = int(np.clip(round(1 / each), 1, max(1, (len(inside) - 1) // 4)))
        first = np.arange(0, len(inside) - apart, max(1, apart // 2))
        # Those that show something, of all times: translation is an offset if motion is the same.
        clear = np.array([self._clear(int(k)) for k in inside])
        worth = (index[first + apart] - index[first]) * np.minimum(
            clear[first], clear[first + apart]
        )
        first = first[worth >= 0.2 * worth.max()]
        first = first[np.unique(np.linspace(0, len(first) - 1, _SPANS).astype(int))]
        self.pairs = np.stack([inside[first], inside[first + apart]], 1)
        self.apart = float(np.median(t[self.pairs[:, 1]] - t[self.pairs[:, 0]]))
        self._near, self._images = None, (None, None)

    @functools.lru_cache(maxsize=4096)  # noqa: B019, lives as long as one estimate
    def _clear(self, row: int) -> float:
        """The part of a frame that is not clipped."""
        return float(_log_image(self.other, row)[1].mean())

    def fired(self, offset: float, sigma: float) -> NDArray[np.float64]:
        """ON and OFF events of each pair, (pairs, n, 2), smoothed.

        An event tells that a threshold has been crossed since the pixel's last one, so counts lag
        behind intensity by half a threshold, in slow scenes by tens of ms. Each event therefore
        counts evenly over the time since the one before it, or until the one after it if that is
        shorter, where both are of its polarity.
        """
        assert self.other.frames is not None and self.pairs is not None
        t = self.other.frames.t[self.pairs] + offset * 1e6
        width, height = self.size
        s, out = self.stride, []
        for (begin, end), (place, first, last) in zip(t, self._crossings(offset), strict=True):
            within = np.minimum(last, end) - np.maximum(first, begin)
            part = np.clip(within / (last - first), 0, 1)
            counts = np.bincount(place, part, 2 * width * height).reshape(2, height, width)
            smooth = ndimage.gaussian_filter(counts.astype(np.float32), (0, sigma, sigma))
            out.append(smooth[::-1, s // 2 :: s, s // 2 :: s].reshape(2, -1).T)
        return np.stack(out).astype(np.float64)

    def _crossings(self, offset: float) -> list[tuple[NDArray, NDArray, NDArray]]:
        """Of each pair's events the place and polarity, and from when to when they count (us)."""
        if self._near is None or abs(offset - self._near[0]) * 1e6 > self.apart / 2:
            assert self.other.frames is not None and self.pairs is not None
            width, height = self.size
            found = []
            for begin, end in self.other.frames.t[self.pairs] + round(offset * 1e6):
                around = (begin - 2 * self.apart, end + 2 * self.apart)
                rows = slice(*(self.recording.events.index(int(one)) for one in around))
                events = self.recording.events[rows]
                pixel = events.y.astype(np.intp) * width + events.x
                order = np.argsort(pixel, kind="stable")
                t, p, pixel = events.t[order].astype(np.float64), events.p[order], pixel[order]
                same = (pixel[1:] == pixel[:-1]) & (p[1:] == p[:-1])
                gap = np.where(same, np.diff(t), np.inf)
                since = np.minimum(np.append(np.inf, gap), np.append(gap, np.inf))
                # Alone: no more than its polarity is known.
                since = np.maximum(np.where(np.isfinite(since), since, 1), 1)
                found.append((p * (height * width) + pixel, t - since, t))
            self._near = offset, found
        return self._near[1]

    def shown(self, at: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        """D, its two slopes and how far it counts at the places, (pairs, n, 4)."""
        where = self.places(at)
        part = self.pixels[self.stride // 2 :: self.stride, self.stride // 2 :: self.stride]
        scale = _scale(where.reshape(part.shape)) / self.stride
        images = self._smoothed(sigma, scale)
        inside = ~np.isnan(where[:, 0])
        values = _bilinear(np.where(inside[:, None], where, 0), self.shape) @ images
        values = values.reshape(len(where), -1, 4).swapaxes(0, 1)
        values[..., 3] *= inside
        return values

    def _smoothed(self, sigma: float, scale: float) -> NDArray[np.float64]:
        """D of each pair, its slopes and where it is known: (other pixels, pairs * 4)."""
        blur = sigma * scale
        if self._images[0] is None or abs(math.log(self._images[0] / blur)) > 0.1:
            assert self.pairs is not None
            images = []
            for one, two in self.pairs:
                (low, known), (high, well) = (_log_image(self.other, int(k)) for k in (one, two))
                good = (known & well).astype(np.float32)
                change = (high - low).astype(np.float32) * good
                weight = ndimage.gaussian_filter(good, blur)
                D = ndimage.gaussian_filter(change, blur) / np.maximum(weight, 0.1)
                known = (weight > _KNOWN).astype(np.float32)
                images += [D, np.gradient(D, axis=1), np.gradient(D, axis=0), known]
            self._images = blur, np.stack([one.ravel() for one in images], 1).astype(np.float64)
        return self._images[1]

    def solve(self, at: NDArray[np.float64], sigma: float) -> tuple[NDArray[np.float64], float]:
        """Gauss-Newton steps until they are small; the place and the correlation there."""
        self.choose(float(at[-1]))
        self.stride = max(self.finest, int(sigma / 1.3))  # smooth images say the same next door
        fit = self.fit(at, sigma)
        for _ in range(_STEPS):
            step, moved = self.step(at, sigma, fit), None
            for _ in range(4):
                now = self.fit(at + step, sigma)
                if now.agreement > fit.agreement:
                    moved = at + step
                    break
                step = step / 3
            if moved is None:
                break
            at, fit = moved, now
            if np.abs(step[:-1]).max(initial=0) < 5e-3 and abs(step[-1]) < 3e-6:
                break
        return at, fit.agreement

    def fit(self, at: NDArray[np.float64], sigma: float) -> _Fit:
        """The thresholds at a place, and the correlation of changes under Huber's weights."""
        D, slope_x, slope_y, counts = np.moveaxis(self.shown(at, sigma), -1, 0)
        use = counts > 0.99
        if use.sum() < 100:
            raise InputError(
                f"{self.other.name}: shows too little of what the events show, unclipped, to "
                "compare them; correct the calibration or homography, or give other frames"
            )
        X = self.fired(float(at[-1]), sigma)[use]
        X, D = np.concatenate([X, np.ones((len(X), 1))], -1), D[use]
        weight, b = np.ones(len(D)), np.zeros(3)
        for _ in range(3):
            b = _least_squares(X, D, weight)
            r = np.abs(D - X @ b)
            spread = 1.345 * 1.4826 * float(np.median(r[:: max(1, len(r) // 20_000)])) + 1e-9
            weight = np.minimum(1, spread / np.maximum(r, 1e-12))
        agreement = _weighted_correlation(D, X @ b, weight)
        return _Fit(X, D, np.stack([slope_x[use], slope_y[use]], -1), use, weight, b, agreement)

    def step(self, at: NDArray[np.float64], sigma: float, fit: _Fit) -> NDArray[np.float64]:
        """The Gauss-Newton step from a place, at most as long as the smoothing can bear.

        D + D' dh = X(o) b + (X' b) do + X db is linear in dh, do and b + db.
        """
        offset, free = float(at[-1]), len(at) - 1
        columns = [fit.X]
        if not self.keep_offset:
            delta = min(self.apart / 8, 2000.0) * 1e-6
            later, earlier = (self.fired(offset + d, sigma)[fit.use] for d in (delta, -delta))
            columns.append(((later - earlier) @ fit.b[:2] / (2 * delta))[:, None])
        pixel, eps = np.nonzero(fit.use)[1], 0.01
        for k in range(free):
            ahead, back = at.copy(), at.copy()
            ahead[k] += eps
            back[k] -= eps
            move = np.nan_to_num((self.places(ahead) - self.places(back)) / (2 * eps))
            columns.append(-(fit.slope * move[pixel]).sum(-1, keepdims=True))
        found = _least_squares(np.concatenate(columns, 1), fit.D, fit.weight)[3:]
        step = np.zeros(len(at))
        if not self.keep_offset:
            step[-1], found = found[0], found[1:]
        step[:free] = found
        far = np.abs(step[:free]).max(initial=0) / (4 * sigma)
        return step / max(far, abs(step[-1]) / (self.apart * 5e-7), 1)


def _match(
    recording: Recording, other: Recording, offset: float, progress: bool
) -> list[NDArray[np.float64]]:
    """Homographies that most matches of features agree on, to a few pixels.

    Matched are what the events say at a frame's time with that frame, and what they say of the
    time between two frames with their difference. Of six simulated rigs the first gave 6 to 80
    matches, 30 to 90 % of them right, the second none to 490, 0 to 90 %: the first where frames
    clip and in fast motion, the second elsewhere. The homography, and the affine map and the
    similarity, which few matches tell better, are the three results.
    """
    cv2 = require("cv2", "vision")
    assert other.frames is not None
    t = other.frames.t + round(offset * 1e6)
    part, rows = _busiest(recording, t)
    small = min(1.0, _WIDEST / recording.width)
    scales = small, min(1.0, 1.5 * small * recording.width / other.width)
    sift = cv2.SIFT_create(1000, contrastThreshold=0.02)

    def features(image: NDArray[np.floating], scale: float) -> tuple[NDArray, NDArray]:
        image = image.astype(np.float32)
        size = round(image.shape[1] * scale), round(image.shape[0] * scale)
        seen = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        points, about = sift.detectAndCompute(_even(seen), None)
        if about is None or len(points) < 2:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        actual = np.array(image.shape[::-1]) / seen.shape[::-1]
        return (np.array([one.pt for one in points]) + 0.5) * actual - 0.5, about

    begin, end = [], []
    for own, shown in _alike(part, other, t, rows, progress):
        (where, described), (there, about) = features(own, scales[0]), features(shown, scales[1])
        if not len(where) or not len(there):
            continue
        for pair in cv2.BFMatcher().knnMatch(described, about, k=2):
            if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance:
                begin.append(where[pair[0].queryIdx])
                end.append(there[pair[0].trainIdx])
    found, count = [], 0
    if len(begin) >= _FEWEST:
        one = _straightened(recording.camera, np.array(begin))
        two = _straightened(other.camera, np.array(end))
        far = _TOLERANCE / scales[1]
        for fit in (cv2.findHomography, cv2.estimateAffine2D, cv2.estimateAffinePartial2D):
            cv2.setRNGSeed(0)
            if fit is cv2.findHomography:
                how = {"method": cv2.USAC_MAGSAC, "confidence": 0.9999}
            else:
                how = {"method": cv2.RANSAC, "confidence": 0.999}
            H, agree = fit(one, two, ransacReprojThreshold=far, maxIters=20_000, **how)
            # The same feature in several frames says the same once.
            places = np.concatenate([one, two], 1)[np.ravel(agree) > 0] / 2
            places = len(np.unique(np.rint(places), axis=0))
            count = max(count, places)
            if H is not None and places >= _FEWEST:
                found.append(np.vstack([H, [0, 0, 1]])[:3])
    if not found:
        raise InputError(
            f"{other.name}: only {count} features of its frames and of the events agree on where "
            f"they are, and {_FEWEST} are needed; give the homography or calibration, or "
            "recordings of a scene with more texture, in motion"
        )
    return found


def _alike(
    part: Recording,
    other: Recording,
    t: NDArray[np.int64],
    rows: NDArray[np.intp],
    progress: bool,
) -> Iterator[tuple[NDArray[np.floating], NDArray[np.floating]]]:
    """Pairs of images of the same by the events and by the frames `rows`, whose times are t."""
    from jaxevent.reconstruction import high_pass

    if not len(rows):
        return
    for alpha in _ALPHAS:
        video = high_pass.estimate(part, high_pass.Params(alpha=alpha), progress=progress)
        images = video(t[rows], extrapolate=True).mean
        for image, row in zip(images, rows, strict=True):
            level = np.log(np.maximum(image + 1, 1e-3))
            yield ndimage.gaussian_filter(level, 0.7), _log_image(other, int(row))[0]
    for apart in _APART:
        for row in rows[rows + apart < len(t)]:
            span = (part.events.index(int(one)) for one in (t[row], t[row + apart]))
            events = part.events[slice(*span)]
            place = events.y.astype(np.intp) * part.width + events.x
            net = np.bincount(place, np.where(events.p, 1.0, -1.0), part.width * part.height)
            net = ndimage.gaussian_filter(net.reshape(part.height, part.width), 1.2)
            (low, known), (high, well) = (_log_image(other, int(k)) for k in (row, row + apart))
            change = np.where(known & well, high - low, 0)
            yield net, ndimage.gaussian_filter(change, 1.2 * other.width / part.width)


def _busiest(recording: Recording, t: NDArray[np.int64]) -> tuple[Recording, NDArray[np.intp]]:
    """Ten seconds at most, with the most events, and frames in them, evenly spread."""
    begin, end = _span(recording)
    first = np.arange(begin, max(end - 5_000_000, begin + 1), 5_000_000)
    index = [[recording.events.index(int(f + s)) for s in (0, 10_000_000)] for f in first]
    begin = int(first[np.argmax(np.diff(index, axis=1)[:, 0])])
    end = min(end, begin + 10_000_000)
    events = recording.events[slice(*(recording.events.index(one) for one in (begin, end + 1)))]
    # The reconstruction needs some time before it shows anything.
    inside = np.flatnonzero((t >= begin + min(200_000, (end - begin) // 4)) & (t <= end))
    chosen = (
        inside[np.unique(np.linspace(0, len(inside) - 1, _MATCHED).astype(int))]
        if len(inside)
        else inside
    )
    return dataclasses.replace(recording, events=events, frames=None, extra={}), chosen


def _even(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Grey levels of local contrast: both cameras' images look alike in them."""
    scale = image.shape[1] / 128
    level = image - ndimage.gaussian_filter(image, 12 * scale)
    contrast = np.sqrt(ndimage.gaussian_filter(level**2, 20 * scale)) + 0.3 * level.std() + 1e-6
    return np.clip(128 + 50 * level / contrast, 0, 255).astype(np.uint8)


def _span(recording: Recording) -> tuple[int, int]:
    """The times (us) of the first and the last event."""
    events = recording.events
    return int(events[:1].t[0]), int(events[len(events) - 1 :].t[0])


def _log_image(other: Recording, row: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
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


def _correlation(
    one: NDArray[np.float64], two: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pearson's correlation and the number of values that overlap, at every lag.

    Entry k: two[i] lies on one[i + k - (len(two) - 1)].
    """
    from scipy.signal import correlate

    one, two = one - one.mean(), two - two.mean()

    def over(a: NDArray, b: NDArray) -> NDArray:
        return correlate(a, b, "full", "fft")

    ones, twos = np.ones_like(one), np.ones_like(two)
    n = np.maximum(np.rint(over(ones, twos)), 1)
    a, b, ab = over(one, twos), over(ones, two), over(one, two)
    aa, bb = over(one**2, twos) - a**2 / n, over(ones, two**2) - b**2 / n
    enough = (aa > 1e-9 * n) & (bb > 1e-9 * n)
    r = (ab - a * b / n) / np.sqrt(np.where(enough, aa * bb, 1))
    return np.where(enough, r, 0), n


def _bilinear(at: NDArray[np.float64], shape: tuple[int, int]) -> Any:
    """The matrix (n, pixels) of bilinear interpolation at places x, y (n, 2)."""
    height, width = shape
    i = np.clip(np.floor(at).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    u, v = (at - i).T
    first = i[:, 1] * width + i[:, 0]
    source = first[:, None] + np.array([0, min(1, width - 1), width, width + 1])
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)
    source = np.minimum(source, height * width - 1)
    ends = np.arange(len(at) + 1) * 4
    return sparse.csr_array((weight.ravel(), source.ravel(), ends), (len(at), height * width))


def _least_squares(
    A: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The weighted least-squares solution; columns that are 0 or the others' copies get 0."""
    size = np.sqrt((weight[:, None] * A**2).sum(0)) + 1e-30
    A = A / size
    W = weight[:, None] * A
    return np.linalg.lstsq(A.T @ W, W.T @ y, rcond=1e-9)[0] / size


def _weighted_correlation(
    a: NDArray[np.float64], b: NDArray[np.float64], weight: NDArray[np.float64]
) -> float:
    total = weight.sum()
    a, b = (one - (weight * one).sum() / total for one in (a, b))
    size = math.sqrt(float((weight * a * a).sum() * (weight * b * b).sum()))
    return float((weight * a * b).sum()) / size if size > 0 else 0.0


def _grid_of(recording: Recording, other: Recording, homography: NDArray[np.float64]) -> Grid:
    size, seen = (recording.width, recording.height), (other.width, other.height)
    return homography_grid(homography, size, seen, recording.camera, other.camera)


def _homography(values: ArrayLike) -> NDArray[np.float64]:
    H = np.asarray(values, np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise InputError(
            f"a homography is three rows of three finite numbers and has an inverse, not an array "
            f"of shape {H.shape}{'' if H.shape != (3, 3) else ' without one'}"
        )
    return H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H


def _moved(H: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) under a homography, NaN behind its horizon."""
    seen = at @ H[:, :2].T + H[:, 2]
    w = seen[:, 2:] * np.sign(H[2, 2] if H[2, 2] else 1)
    return seen[:, :2] / np.where(w > 1e-9, seen[:, 2:], np.nan)


def _check(camera: PinholeCamera) -> None:
    if not (0 < camera.fx < math.inf and 0 < camera.fy < math.inf):
        raise InputError(
            f"a camera of focal lengths {camera.fx} and {camera.fy} px is not possible; give the "
            "calibration's positive fx and fy in px"
        )


def _straightened(camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) in px without the distortion."""
    if camera is None or not any(camera.distortion):
        return at.astype(np.float64)
    from jaxevent.egomotion.geometry import undistorted

    straight, f = undistorted(camera, at[:, 0], at[:, 1])
    return straight / f * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _straight(camera: PinholeCamera | None, size: tuple[int, int]) -> NDArray[np.float64]:
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    return _straightened(camera, np.stack([x.ravel(), y.ravel()], 1))


def _rays(camera: PinholeCamera, size: tuple[int, int]) -> NDArray[np.float64]:
    at = (_straight(camera, size) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.concatenate([at, np.ones((len(at), 1))], 1)


def _bent(camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) in px with the distortion; NaN where the radial part has turned back."""
    if camera is None or not any(camera.distortion):
        return at
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = ((at - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    r2 = x * x + y * y
    # r (1 + k1 r^2 + k2 r^4 + k3 r^6) rises with r up to the least root of its slope.
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    turns = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)]
    r2 = np.where(r2 < turns.min(initial=math.inf), r2, np.nan)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            camera.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + camera.cx,
            camera.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + camera.cy,
        ],
        1,
    )


def _projected(camera: PinholeCamera, X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where places (n, 3) are seen, (n, 2) in px; NaN behind the camera."""
    Z = np.where(X[:, 2:] > 1e-9, X[:, 2:], np.nan)
    straight = X[:, :2] / Z * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return _bent(camera, straight)


def _inside(at: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """The same with NaN outside an image, whose outermost pixels' centres are its edge."""
    seen = (at >= -1e-6) & (at <= np.array(size) - 1 + 1e-6)
    return np.where(seen.all(1, keepdims=True), at, np.nan)


def _scale(grid: NDArray[np.float64]) -> float:
    """Pixels of the other camera to a step of the grid, the median; 1 where none are seen."""
    if min(grid.shape[:2]) < 2:
        return 1.0
    across = grid[:-1, 1:] - grid[:-1, :-1]
    down = grid[1:, :-1] - grid[:-1, :-1]
    area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    area = area[np.isfinite(area)]
    return float(np.sqrt(np.median(area))) if len(area) and np.median(area) > 0 else 1.0


def _weights(grid: Grid, shape: tuple[int, int]) -> tuple[Any, NDArray[np.bool_]]:
    """The matrix (pixels, other pixels) of cubic convolution, and which pixels are seen.

    Keys, "Cubic convolution interpolation for digital image processing", 1981, a = -1/2. Where the
    grid's steps are s > 1 px, ceil(s)^2 samples are averaged over each pixel.
    """
    height, width = grid.shape[:2]
    covered = ~np.isnan(grid[..., 0])
    count = min(max(1, math.ceil(_scale(grid) - 0.25)), 16)
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


def _cropped(recording: Recording, covered: NDArray[np.bool_]) -> Recording:
    """The recording's largest rectangle of covered pixels."""
    left, top, right, bottom = _rectangle(covered)
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


def _rectangle(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
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


def _numbers(values: Any, where: str) -> NDArray[np.float64]:
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise InputError(f"{where} is not a list of finite numbers; give numbers")
    return numbers


def _series(
    path: Path, exposure: float | int | None, white: float | int | None, reference: bool
) -> Recording:
    if exposure is not None and not 0 < exposure < math.inf:
        raise InputError(f"{path}: an exposure of {exposure} s is not possible; give seconds")
    if white is not None and not 0 < white < math.inf:
        raise InputError(f"{path}: white = {white} is not possible; give a number above 0")
    series = read_series(path, Scale(white))
    images: list[NDArray[np.float32]] = []
    for row in range(len(series.t)):
        image = series.read(row).astype(np.float32)
        if images and image.shape != images[0].shape:
            raise InputError(
                f"{path}: image {row} has the shape {image.shape} after images of "
                f"{images[0].shape}; give all images one size"
            )
        images.append(image)
    length = np.full(len(series.t), round((exposure or 0) * 1e6), np.int64)
    frames = Frames(series.t, np.stack(images), length)
    height, width = images[0].shape
    if not reference:
        frames.check(width, height, str(path))
    return Recording(path.name, width, height, Events.empty(), frames)
