"""Motion from frames alone: points tracked by Lucas and Kanade's method, as a baseline.

Corners of each frame are tracked to the next by pyramidal Lucas-Kanade and back again. Those that
return to where they began (forward-backward check) determine the motion between the two frames, by
robust least squares of their undistorted displacements: d / dt = U(x; motion), at the midpoint x.
For a rotation that is B(x) Omega, of second order in the angle between the frames.

General motion needs longer displacements. Points are tracked over several frames, from each one to
the first that is `span` later, and their positions in these two are fitted. A point x1 of one view
and x2 of another, (x, y, f) / f, obey x2' E x1 = 0 with E = [t]x R. OpenCV finds E in random
samples of five points (Nister, "An efficient solution to the five-point relative pose problem",
PAMI 2004). From there the constant twist between the views is fitted to the points' Sampson
distances

    e = x2' E x1 / |((E x1)_x, (E x1)_y, (E' x2)_x, (E' x2)_y)|

which are distances (px) from the epipolar lines, by Huber's loss. Both signs of T fit alike; with
one of them points are before the camera. The length of the translation is unknown. Needs OpenCV,
the extra "vision".
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from jaxevent.egomotion.baselines.fits import (
    CORRELATED_CELL_PX,
    HUBER_THRESHOLD_SIGMAS,
    Fit,
    motion_of_fits,
    robust_fit,
    sandwich,
)
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.estimator import HostEstimator, HostInputs
from jaxevent.egomotion.models import General, Model
from jaxevent.egomotion.motion import CovarianceCalibration, MotionEstimate
from jaxevent.egomotion.patches import ImageSpeed
from jaxevent.errors import InputError, require
from jaxevent.parameters import Count, Parameters, Positive, UnitInterval
from jaxevent.progress import bar
from jaxevent.recording import Frames, Recording

PAIR_DISPLACEMENT_PX = 20.0  # of the image between two frames that determine a general motion
PAIR_SPAN_RANGE_S = (0.05, 1.0)  # between them
MIN_TRACKED_POINTS = 8  # of a general motion: 5 of a sample, and others that test it
MAX_EPIPOLAR_DISTANCE_PX = 1.0  # from the epipolar line
RANSAC_CONFIDENCE = 0.999  # of having drawn five inliers
MIN_POINT_NOISE_PX = 0.1  # of tracked points
# Of ideal frames, which all points share: interpolation errs alike everywhere.
SYSTEMATIC_ERROR_PX = 0.008
COVARIANCE_CALIBRATION = CovarianceCalibration(change=0.02)


class Params(Parameters):
    """Parameters of motion by tracked points."""

    corners: Count = Count(400, "", "most points that are tracked from a frame to the next")
    window: Count = Count(
        11, "px", "side of the patch that is compared; levels are not smaller than it"
    )
    levels: Count = Count(
        5, "", "most levels of the pyramid, each half as large; 4 suit about 30 px"
    )
    iterations: Count = Count(30, "", "most iterations of a level")
    fewest: Count = Count(5, "", "least number of points of an estimate")

    quality: UnitInterval = UnitInterval(
        0.01, "", "least strength of a corner, relative to the best one"
    )
    spacing: Positive = Positive(5.0, "px", "least distance of two corners")
    returns: Positive = Positive(
        0.5, "px", "largest distance from the start of a point tracked back"
    )
    span: Positive = Positive(0.4, "s", "general motion: least time between the two frames")


def solve(params: Params, inputs: HostInputs) -> MotionEstimate:
    """Estimate the motion between pairs of frames, at the middle of their times.

    The covariance is that of the fit, with an error that all points share and that of a motion
    which changes between the frames. With too few points the motion is lost, and its mean that of
    the pair before. The samples of five points are drawn with a fixed seed.

    Args:
        params: The parameters.
        inputs: Recording, model and options.

    Returns:
        The estimate.
    """
    recording, frames = inputs.recording, inputs.recording.frames
    assert frames is not None
    cv2 = require("cv2", "vision")
    xi, f = pixel_coordinates(recording.width, recording.height, inputs.camera)
    model = inputs.model(f)
    size = model.pixel_scale(xi)
    fits, pairs = [], pair_frames(frames, float(params.span) if model.half_line else 0.0)
    for one, two in bar(pairs, desc="track points", unit="pair", progress=inputs.progress):
        images = [np.rint(255 * i).astype(np.uint8) for i in frames[one : two + 1].intensity]
        begin, end = track_points(cv2, params, images)
        before, after = interpolate_positions(begin, xi), interpolate_positions(end, xi)
        dt = float(frames.t[two] - frames.t[one]) * 1e-6
        # Errors of points of a cell are correlated.
        columns = np.array([1, recording.width // CORRELATED_CELL_PX + 1])
        cells = np.floor(begin / CORRELATED_CELL_PX).astype(int) @ columns
        if len(begin) < params.fewest:
            fits.append(None)
        elif model.half_line:
            fits.append(fit_general(cv2, before, after, cells, f, dt))
        else:
            basis = np.asarray(model.basis((before + after) / 2), np.float64)
            values = ((after - before) / dt).reshape(-1)
            rows = basis.reshape(-1, len(size))
            fit = robust_fit(rows, values, np.repeat(cells, 2), size)
            fits.append(fit and fit.with_systematic_error(SYSTEMATIC_ERROR_PX, dt, size))
    one, two = np.array(pairs).T
    motion = motion_of_fits(inputs.model, (frames.t[one] + frames.t[two]) // 2, fits)
    if model.half_line:
        return motion
    lengths = (frames.t[two] - frames.t[one]) * 1e-6
    calibration = COVARIANCE_CALIBRATION.with_lens(inputs.camera)
    return motion.with_calibrated_covariance(calibration, lengths)


def pair_frames(frames: Frames, span: float) -> list[tuple[int, int]]:
    """Pair each frame with a later one.

    Args:
        frames: The frames.
        span: Least time between the two, s.

    Returns:
        Rows of the pairs; at least the first and the last frame.
    """
    t = np.asarray(frames.t)
    later = np.searchsorted(t, t + max(round(1e6 * span), 1))
    pairs = [(k, int(two)) for k, two in enumerate(later) if two < len(t)]
    return pairs or [(0, len(t) - 1)]


def track_points(
    cv2: Any, params: Params, images: list[NDArray[np.uint8]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Track corners of the first image through all images.

    Args:
        cv2: The module of OpenCV.
        params: The parameters.
        images: Images (height, width).

    Returns:
        Positions (n, 2) in the first image and in the last one, px.
    """
    corners = cv2.goodFeaturesToTrack(
        images[0], params.corners, float(params.quality), float(params.spacing)
    )
    begin = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
    at = begin
    for one, two in zip(images, images[1:], strict=False):
        end, good = _track_pair(cv2, params, one, two, at)
        begin, at = begin[good], end[good]
    return begin.astype(float), at.astype(float)


def _track_pair(
    cv2: Any,
    params: Params,
    one: NDArray[np.uint8],
    two: NDArray[np.uint8],
    at: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Track points from an image to the next one and back.

    Args:
        cv2: The module of OpenCV.
        params: The parameters.
        one: (height, width) image.
        two: (height, width) next image.
        at: (n, 2) positions in the first, px.

    Returns:
        (n, 2) positions in the second, px, and whether tracking back returned to `at`.
    """
    if not len(at):
        return at, np.zeros(0, bool)
    at = at.reshape(-1, 1, 2).astype(np.float32)
    settings = {
        "winSize": (params.window, params.window),
        "maxLevel": params.levels - 1,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, params.iterations, 0.01),
    }
    end, found, _ = cv2.calcOpticalFlowPyrLK(one, two, at, None, **settings)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(two, one, end, None, **settings)
    off = np.linalg.norm((back - at).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (off <= float(params.returns))
    end = end.reshape(-1, 2)
    good &= ((end >= 0) & (end <= np.array(one.shape[::-1]) - 1)).all(1)
    return end, good


def interpolate_positions(at: NDArray[np.floating], xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate undistorted positions between pixels bilinearly.

    Args:
        at: (n, 2) columns and rows, px.
        xi: (height, width, 2) undistorted positions of pixels, px.

    Returns:
        (n, 2) undistorted positions, px.
    """
    height, width = xi.shape[:2]
    i = np.clip(np.floor(at).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    x, y = i.T
    u, v = (at - i).T[..., None]
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = (1 - u) * xi[y, x] + u * xi[y, right]
    lower = (1 - u) * xi[below, x] + u * xi[below, right]
    return (1 - v) * upper + v * lower


def fit_general(
    cv2: Any,
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    cells: NDArray[np.integer],
    f: float,
    dt: float,
) -> Fit | None:
    """Fit heading and Omega (6,) of a camera by the five-point method and Sampson distances.

    Args:
        cv2: The module of OpenCV.
        begin: (n, 2) undistorted positions of points, px.
        end: (n, 2) positions later, px.
        cells: (n,) cell of each point, within which errors are correlated.
        f: Focal length, px.
        dt: Time between the two, s.

    Returns:
        The fit, or None if no motion explains the points.
    """
    if len(begin) < MIN_TRACKED_POINTS:
        return None
    cv2.setRNGSeed(0)
    K = np.diag([f, f, 1.0])
    E, inliers = cv2.findEssentialMat(
        begin, end, K, cv2.RANSAC, RANSAC_CONFIDENCE, MAX_EPIPOLAR_DISTANCE_PX
    )
    if E is None or E.shape != (3, 3) or inliers.sum() < MIN_TRACKED_POINTS:
        return None
    good = inliers.ravel() > 0
    begin, end, cells = begin[good], end[good], cells[good]
    _, R, t, _ = cv2.recoverPose(E, begin, end, K)
    # OpenCV's pose maps points of the first view to the second, the camera's is its inverse.
    first = RigidTransform.from_components(t.ravel(), Rotation.from_matrix(R)).inv()
    start = first.as_exp_coords()
    heading, turn = start[3:] / np.linalg.norm(start[3:]), start[:3]
    across = np.linalg.svd(heading[None])[2][1:].T  # two unit vectors at right angles to it
    rays = [np.concatenate([at / f, np.ones((len(at), 1))], 1) for at in (begin, end)]

    def motion(z: NDArray) -> NDArray:
        moved = heading + across @ z[:2]
        return np.concatenate([moved / np.linalg.norm(moved), turn + z[2:]])

    def distances(z: NDArray) -> NDArray:
        return f * _sampson_distances(motion(z), *rays)

    # The scale is that of the inliers; beyond Huber's bound residuals count linearly.
    scale = max(1.4826 * float(np.median(np.abs(distances(np.zeros(5))))), MIN_POINT_NOISE_PX)
    found = least_squares(
        distances, np.zeros(5), loss="huber", f_scale=HUBER_THRESHOLD_SIGMAS * scale
    )
    residual = distances(found.x)
    weight = np.minimum(1, HUBER_THRESHOLD_SIGMAS * scale / np.maximum(np.abs(residual), 1e-12))
    # least_squares scales its Jacobian by the loss, so here it is computed by differences.
    h = 1e-6
    J = np.stack([(distances(found.x + s) - distances(found.x - s)) / (2 * h)
                  for s in h * np.eye(5)], 1)  # fmt: skip
    H = (J * weight[:, None]).T @ J
    if not np.linalg.eigvalsh(H)[0] > 1e-9 * np.trace(H):
        return None
    covariance = sandwich(H, J * (weight * residual)[:, None], cells)
    mean = motion(found.x)
    if _mean_parallax(mean, rays[0], rays[1], weight) < 0:
        mean[:3] *= -1
    spread = np.zeros((6, 5))
    spread[:3, :2] = across - np.outer(mean[:3], mean[:3] @ across)
    spread[3:, 2:] = np.eye(3) / dt
    mean[3:] /= dt
    return Fit(mean, spread @ covariance @ spread.T)


def _mean_parallax(
    motion: NDArray[np.float64],
    one: NDArray[np.float64],
    two: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> float:
    """Average the displacement along that of points before the camera; it is below 0 if T is wrong.

    Args:
        motion: (6,) T and Omega for unit time.
        one: (n, 3) rays in the first view, of depth 1.
        two: (n, 3) rays in the second view, of depth 1.
        weight: (n,) weights.

    Returns:
        The mean, for f = 1.
    """
    R, t = _relative_pose(motion)
    turned = one @ R.T
    displacement = two[:, :2] - turned[:, :2] / turned[:, 2:]
    along = t[:2] - two[:, :2] * t[2]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return float((weight * (displacement * along).sum(1)).mean())


def _relative_pose(motion: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return R and t from the first view to the second after a twist (6,) for unit time."""
    back = RigidTransform.from_exp_coords(np.roll(motion, 3)).inv()
    return back.rotation.as_matrix(), back.translation


def _sampson_distances(
    motion: NDArray[np.float64], one: NDArray[np.float64], two: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distances of rays from epipolar lines, for f = 1.

    Args:
        motion: (6,) T and Omega for unit time.
        one: (n, 3) rays in the first view, of depth 1.
        two: (n, 3) rays in the second view, of depth 1.

    Returns:
        (n,) signed distances.
    """
    R, t = _relative_pose(motion)
    E = np.cross(t, R, axisb=0, axisc=0)
    to, fro = one @ E.T, two @ E
    size = np.sqrt((to[:, :2] ** 2).sum(1) + (fro[:, :2] ** 2).sum(1))
    return (two * to).sum(1) / np.maximum(size, 1e-12)


def adapt_lengths(params: Params, speed: ImageSpeed) -> dict[str, float]:
    """Return a span in which the image moves by `PAIR_DISPLACEMENT_PX`."""
    return {"span": float(np.clip(PAIR_DISPLACEMENT_PX / speed.median, *PAIR_SPAN_RANGE_S))}


@dataclasses.dataclass(frozen=True, repr=False)
class PointTracker(HostEstimator[Params]):
    """Points tracked between frames; it needs two frames, and OpenCV."""

    needs_frames: bool = dataclasses.field(default=True, kw_only=True)

    def supports(self, model: type[Model]) -> bool:
        return issubclass(model, General) or not model.half_line

    def check(self, recording: Recording) -> None:
        frames = recording.frames
        if frames is None or len(frames) < 2:
            raise InputError(
                f"{recording.name}: has {0 if frames is None else len(frames)} frames and tracking "
                f"needs two{recording.describe_left_out('frames')}; take a method that uses "
                "events, as voting or contrast"
            )


frames = PointTracker(
    "frames",
    Params,
    solve,
    adapt_lengths=adapt_lengths,
    about="Motion from frames alone: points tracked by Lucas and Kanade's method determine the "
    "motion between each two frames, general motion by the five-point method. It needs OpenCV.",
)
