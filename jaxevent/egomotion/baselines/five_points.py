"""General motion from points in two views by the five-point method, as a baseline.

A point x1 of one view and x2 of another, (x, y, f) / f, obey x2' E x1 = 0 with E = [t]x R. OpenCV
finds E in random samples of five points (Nister, "An efficient solution to the five-point relative
pose problem", PAMI 2004). From there the constant twist between the views is fitted to the points'
Sampson distances

    e = x2' E x1 / |((E x1)_x, (E x1)_y, (E' x2)_x, (E' x2)_y)|

which are distances (px) from the epipolar lines, by Huber's loss. Both signs of T fit alike; with
one of them points are before the camera. How long the way was is not told.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.egomotion.baselines.local_planes import HUBER, Fit, sandwich

FEWEST = 8  # points that a fit needs: 5 that E takes, and some that judge it
INLIER = 1.0  # px from its epipolar line
SURE = 0.999  # of having drawn five good points
NOISE = 0.1  # px, of which tracked points are expected to err at least


def relative_motion(
    cv2: Any,
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    cells: NDArray[np.integer],
    f: float,
    dt: float,
) -> Fit | None:
    """Heading and Omega (6,) of a camera that saw points at `begin` (n, 2) and dt s later at `end`.

    Places are undistorted, in px from the principal point. Points of one of the `cells` (n,) may
    err together; the covariance is a sandwich over them. None where no motion explains the points.
    """
    if len(begin) < FEWEST:
        return None
    cv2.setRNGSeed(0)
    K = np.diag([f, f, 1.0])
    E, inliers = cv2.findEssentialMat(begin, end, K, cv2.RANSAC, SURE, INLIER)
    if E is None or E.shape != (3, 3) or inliers.sum() < FEWEST:
        return None
    good = inliers.ravel() > 0
    begin, end, cells = begin[good], end[good], cells[good]
    _, R, t, _ = cv2.recoverPose(E, begin, end, K)
    # OpenCV's pose takes points of the first view to the second, the camera's is its inverse.
    first = RigidTransform.from_components(t.ravel(), Rotation.from_matrix(R)).inv()
    start = first.as_exp_coords()
    heading, turn = start[3:] / np.linalg.norm(start[3:]), start[:3]
    across = _across(heading)
    rays = [np.concatenate([at / f, np.ones((len(at), 1))], 1) for at in (begin, end)]

    def motion(z: NDArray) -> NDArray:
        moved = heading + across @ z[:2]
        return np.concatenate([moved / np.linalg.norm(moved), turn + z[2:]])

    def distances(z: NDArray) -> NDArray:
        return f * _sampson(motion(z), *rays)

    # The scale from the inliers; what is beyond Huber's bound counts linearly.
    scale = max(1.4826 * float(np.median(np.abs(distances(np.zeros(5))))), NOISE)
    found = least_squares(distances, np.zeros(5), loss="huber", f_scale=HUBER * scale)
    residual = distances(found.x)
    weight = np.minimum(1, HUBER * scale / np.maximum(np.abs(residual), 1e-12))
    # least_squares scales its Jacobian by the loss: an own one, by differences.
    h = 1e-6
    J = np.stack([(distances(found.x + s) - distances(found.x - s)) / (2 * h)
                  for s in h * np.eye(5)], 1)  # fmt: skip
    H = (J * weight[:, None]).T @ J
    if not np.linalg.eigvalsh(H)[0] > 1e-9 * np.trace(H):
        return None
    covariance = sandwich(H, J * (weight * residual)[:, None], cells)
    mean = motion(found.x)
    if _before(mean, rays[0], rays[1], weight) < 0:
        mean[:3] *= -1
    spread = np.zeros((6, 5))
    spread[:3, :2] = across - np.outer(mean[:3], mean[:3] @ across)
    spread[3:, 2:] = np.eye(3) / dt
    mean[3:] /= dt
    return Fit(mean, spread @ covariance @ spread.T)


def _across(heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors (3, 2) at right angles to a heading and to each other."""
    return np.linalg.svd(heading[None])[2][1:].T


def _before(
    motion: NDArray[np.float64],
    one: NDArray[np.float64],
    two: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> float:
    """The mean way along that which translation makes of points before the camera."""
    R, t = _back(motion)
    turned = one @ R.T
    way = two[:, :2] - turned[:, :2] / turned[:, 2:]
    along = t[:2] - two[:, :2] * t[2]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return float((weight * (way * along).sum(1)).mean())


def _back(motion: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R and t from the first view to the second after a camera's twist (6,) for unit time."""
    back = RigidTransform.from_exp_coords(np.roll(motion, 3)).inv()
    return back.rotation.as_matrix(), back.translation


def _sampson(
    motion: NDArray[np.float64], one: NDArray[np.float64], two: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances of rays (n, 3) from epipolar lines, f being 1."""
    R, t = _back(motion)
    E = np.cross(t, R, axisb=0, axisc=0)
    to, fro = one @ E.T, two @ E
    size = np.sqrt((to[:, :2] ** 2).sum(1) + (fro[:, :2] ** 2).sum(1))
    return (two * to).sum(1) / np.maximum(size, 1e-12)
