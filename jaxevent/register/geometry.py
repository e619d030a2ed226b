"""Grids, homographies and lenses: the other camera's pixel for each of the event camera.

A *grid* (height, width, 2) holds for each pixel of the event camera the x, y in the other camera's
images, NaN where that does not see the same. Pixel centres are whole numbers. Homographies map
places of the event camera to places of the other one, [u, v, w] = H [x, y, 1].
"""

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.errors import InputError
from jaxevent.io.checks import reading
from jaxevent.recording import Recording

Grid = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Registration:
    """Registration of another camera's frames to the events.

    Attributes:
        grid: (height, width, 2) x, y in the other camera's images, px.
        offset: Seconds to add to its time stamps.
        homography: (3, 3) homography of the grid, if it has one.
        agreement: Correlation, over pixels and frames, of the change of ln intensity between frames
            with that by the events; None if nothing was estimated.
    """

    grid: Grid
    offset: float
    homography: NDArray[np.float64] | None = None
    agreement: float | None = None


def homography_grid(
    homography: ArrayLike,
    size: tuple[int, int],
    other: tuple[int, int],
    camera: PinholeCamera | None = None,
    other_camera: PinholeCamera | None = None,
) -> Grid:
    """Return the grid (height, width, 2) of a homography.

    Args:
        homography: (3, 3), from undistorted pixels of the event camera to those of the other one.
        size: (width, height) of the event camera, px.
        other: (width, height) of the other camera, px.
        camera: Calibration of the event camera, whose distortion is undone.
        other_camera: Calibration of the other camera, likewise.

    Returns:
        x, y in the other camera's images, px, NaN outside.

    Raises:
        InputError: The matrix is no homography.
    """
    at = apply_homography(check_homography(homography), undistorted_pixels(camera, size))
    return mask_outside(distort(other_camera, at), other).reshape(*size[::-1], 2)


def read_homography(path: str | Path) -> NDArray[np.float64]:
    """Read a homography from text: three lines of three numbers, separated by commas or spaces.

    Raises:
        InputError: The file has other contents.
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
    """Read depth in m.

    Args:
        given: A number, or the path of an .npy file of (height, width).
        size: (width, height) of the event camera, px.

    Returns:
        Depth, () or (height, width).

    Raises:
        InputError: The file has other contents.
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


def coverage(grid: Grid) -> float:
    """Return the fraction of the event camera's pixels that the other camera sees."""
    return float(np.mean(~np.isnan(grid[..., 0])))


def recording_grid(recording: Recording, other: Recording, homography: NDArray[np.float64]) -> Grid:
    """Return the grid of a homography between the cameras of two recordings.

    Args:
        recording: Recording whose pixels the grid is of.
        other: Recording whose positions it holds.
        homography: (3, 3) from undistorted pixels of the first to those of the other, px.

    Returns:
        (H, W, 2) positions, px, NaN outside the other image.
    """
    size, seen = (recording.width, recording.height), (other.width, other.height)
    return homography_grid(homography, size, seen, recording.camera, other.camera)


def check_homography(values: ArrayLike) -> NDArray[np.float64]:
    """Return a homography (3, 3) with H[2, 2] = 1, or raise `InputError`."""
    H = np.asarray(values, np.float64)
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise InputError(
            f"a homography is three rows of three finite numbers and has an inverse, not an array "
            f"of shape {H.shape}{'' if H.shape != (3, 3) else ' without one'}"
        )
    return H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H


def apply_homography(H: NDArray[np.float64], points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map positions by a homography.

    Args:
        H: (3, 3) the homography.
        points_px: (n, 2) x and y, px.

    Returns:
        (n, 2), px, NaN behind its horizon.
    """
    seen = points_px @ H[:, :2].T + H[:, 2]
    w = seen[:, 2:] * np.sign(H[2, 2] if H[2, 2] else 1)
    return seen[:, :2] / np.where(w > 1e-9, seen[:, 2:], np.nan)


def undistort_positions(
    camera: PinholeCamera | None, at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Remove the distortion of a camera from positions.

    Args:
        camera: The camera; None: there is no distortion.
        at: (n, 2) x and y, px.

    Returns:
        (n, 2), px.
    """
    if camera is None or not camera.is_distorted:
        return at.astype(np.float64)
    from jaxevent.egomotion.geometry import centred_coordinates

    straight, f = centred_coordinates(camera, at[:, 0], at[:, 1])
    return straight / f * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def undistorted_pixels(
    camera: PinholeCamera | None, sensor_size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the undistorted positions of a camera's pixels.

    Args:
        camera: The camera; None: there is no distortion.
        sensor_size: Width and height, px.

    Returns:
        (height * width, 2) x and y, px, row by row.
    """
    y, x = np.mgrid[: sensor_size[1], : sensor_size[0]].astype(np.float64)
    return undistort_positions(camera, np.stack([x.ravel(), y.ravel()], 1))


def pixel_rays(camera: PinholeCamera, sensor_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return rays through a camera's pixels.

    Args:
        camera: The camera.
        sensor_size: Width and height, px.

    Returns:
        (height * width, 3) rays of depth 1, row by row.
    """
    at = (undistorted_pixels(camera, sensor_size) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.concatenate([at, np.ones((len(at), 1))], 1)


def distort(camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distort positions as a camera does.

    Args:
        camera: The camera; None: there is no distortion.
        at: (n, 2) x and y, px.

    Returns:
        (n, 2), px, NaN where the radial part of the distortion turns back.
    """
    if camera is None or not camera.is_distorted:
        return at
    return camera.distort((at - (camera.cx, camera.cy)) / (camera.fx, camera.fy))


def project(camera: PinholeCamera, points_3d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points to a camera's image.

    Args:
        camera: The camera.
        points_3d: (n, 3) x, y and depth in the camera's axes.

    Returns:
        (n, 2), px, NaN behind the camera.
    """
    Z = np.where(points_3d[:, 2:] > 1e-9, points_3d[:, 2:], np.nan)
    straight = points_3d[:, :2] / Z * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return distort(camera, straight)


def mask_outside(
    points_px: NDArray[np.float64], image_size: tuple[int, int]
) -> NDArray[np.float64]:
    """Set positions outside an image to NaN; its outermost pixels' centres are its edge.

    Args:
        points_px: (n, 2) x and y, px.
        image_size: Width and height of the image, px.

    Returns:
        (n, 2).
    """
    seen = (points_px >= -1e-6) & (points_px <= np.array(image_size) - 1 + 1e-6)
    return np.where(seen.all(1, keepdims=True), points_px, np.nan)


def pixel_scale(grid: NDArray[np.float64]) -> float:
    """Return the median number of the other camera's pixels per step of a grid; 1 without any."""
    if min(grid.shape[:2]) < 2:
        return 1.0
    across = grid[:-1, 1:] - grid[:-1, :-1]
    down = grid[1:, :-1] - grid[:-1, :-1]
    area = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    area = area[np.isfinite(area)]
    return float(np.sqrt(np.median(area))) if len(area) and np.median(area) > 0 else 1.0
