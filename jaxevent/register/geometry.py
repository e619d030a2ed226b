"""Where a camera's pixels look: grids, homographies and lenses.

A *grid* (height, width, 2) says at which x, y of the other camera's images each pixel of the event
camera looks, NaN where it does not see the same. Pixel centres are whole numbers. Homographies map
places of the event camera to places of the other one, [u, v, w] = H [x, y, 1].
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.recording import Recording

Grid = NDArray[np.float64]


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
    at = move(check_homography(homography), straight_pixels(camera, size))
    return keep_inside(bend(other_camera, at), other).reshape(*size[::-1], 2)


def read_homography(path: str | Path) -> NDArray[np.float64]:
    """A homography from text: three lines of three numbers, parted by commas or spaces.

    Raises `InputError` for other contents.
    """

    with reading(str(path)):
        text = Path(path).read_text(encoding="utf-8-sig")
    try:
        rows = [
            [float(word) for word in line.replace(",", " ").split()]
            for line in text.splitlines()
            if line.strip() and not line.startswith("#")
        ]
        return check_homography(np.array(rows))
    except ValueError as error:
        why = str(error) if isinstance(error, InputError) else "it is not a table of numbers"
        raise InputError(f"{path}: {why}; give three lines of three numbers") from None


def read_depth(given: float | int | Path, size: tuple[int, int]) -> NDArray[np.float64]:
    """Depth in m: a number, or the path of an .npy file of (height, width), `size` transposed.

    Raises `InputError` for anything else.
    """

    if not isinstance(given, Path):
        return np.array(float(given))
    with reading(str(given)):
        depth = np.load(given, allow_pickle=False)
    if depth.shape != size[::-1] or depth.dtype.kind not in "iuf":
        raise InputError(
            f"{given}: is {depth.dtype} of shape {depth.shape}; give metres of shape {size[::-1]}"
        )
    return depth.astype(np.float64)


def seen(grid: Grid) -> float:
    """The part of the event camera's pixels that the other camera sees."""
    return float(np.mean(~np.isnan(grid[..., 0])))


def grid_between(recording: Recording, other: Recording, homography: NDArray[np.float64]) -> Grid:
    size, seen = (recording.width, recording.height), (other.width, other.height)
    return homography_grid(homography, size, seen, recording.camera, other.camera)


def check_homography(values: ArrayLike) -> NDArray[np.float64]:
    H = np.asarray(values, np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise InputError(
            f"a homography is three rows of three finite numbers and has an inverse, not an array "
            f"of shape {H.shape}{'' if H.shape != (3, 3) else ' without one'}"
        )
    return H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H


def move(H: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) under a homography, NaN behind its horizon."""
    seen = at @ H[:, :2].T + H[:, 2]
    w = seen[:, 2:] * np.sign(H[2, 2] if H[2, 2] else 1)
    return seen[:, :2] / np.where(w > 1e-9, seen[:, 2:], np.nan)


def check_camera(camera: PinholeCamera) -> None:
    if not (0 < camera.fx < math.inf and 0 < camera.fy < math.inf):
        raise InputError(
            f"a camera of focal lengths {camera.fx} and {camera.fy} px is not possible; give the "
            "calibration's positive fx and fy in px"
        )


def straighten(camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) in px without the distortion."""
    if camera is None or not camera.is_distorted:
        return at.astype(np.float64)
    from jaxevent.egomotion.geometry import undistort

    straight, f = undistort(camera, at[:, 0], at[:, 1])
    return straight / f * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def straight_pixels(camera: PinholeCamera | None, size: tuple[int, int]) -> NDArray[np.float64]:
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    return straighten(camera, np.stack([x.ravel(), y.ravel()], 1))


def rays(camera: PinholeCamera, size: tuple[int, int]) -> NDArray[np.float64]:
    at = (straight_pixels(camera, size) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.concatenate([at, np.ones((len(at), 1))], 1)


def bend(camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (n, 2) in px with the distortion; NaN where the radial part has turned back."""
    if camera is None or not camera.is_distorted:
        return at
    return camera.distort((at - (camera.cx, camera.cy)) / (camera.fx, camera.fy))


def project(camera: PinholeCamera, X: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where places (n, 3) are seen, (n, 2) in px; NaN behind the camera."""
    Z = np.where(X[:, 2:] > 1e-9, X[:, 2:], np.nan)
    straight = X[:, :2] / Z * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return bend(camera, straight)


def keep_inside(at: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """The same with NaN outside an image, whose outermost pixels' centres are its edge."""
    seen = (at >= -1e-6) & (at <= np.array(size) - 1 + 1e-6)
    return np.where(seen.all(1, keepdims=True), at, np.nan)


def step_size(grid: NDArray[np.float64]) -> float:
    """Pixels of the other camera to a step of the grid, the median; 1 where none are seen."""
    if min(grid.shape[:2]) < 2:
        return 1.0
    across = grid[:-1, 1:] - grid[:-1, :-1]
    down = grid[1:, :-1] - grid[:-1, :-1]
    area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    area = area[np.isfinite(area)]
    return float(np.sqrt(np.median(area))) if len(area) and np.median(area) > 0 else 1.0
