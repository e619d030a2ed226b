"""Motion from frames alone: points tracked by Lucas and Kanade's method, as a baseline.

Corners of each frame are followed to the next by pyramidal Lucas-Kanade and back again; those that
return to where they began (forward-backward check) tell the motion between the two frames, by
robust least squares of their undistorted displacements: d / dt = U(x; motion), at the middle x of
the way. For a rotation that is B(x) Omega, of second order in the angle between the frames. Needs
OpenCV: pip install 'jaxevent[vision]'.
"""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.baselines.local_planes import (
    CELL,
    arms,
    basis,
    check_model,
    held,
    robust_fit,
)
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.motion import Motion
from jaxevent.errors import InputError, require
from jaxevent.parameters import Count, Parameters, Positive
from jaxevent.recording import Recording

MODELS = ("planar", "rotation")


class Params(Parameters):
    """Parameters of motion by tracked points."""

    corners = Count(400, "", "most points that are followed from a frame to the next")
    window = Count(11, "px", "side of the patch that is compared; levels are not smaller than it")
    levels = Count(5, "", "most of the pyramid, each half as large; 4 for ways of some 30 px")
    iterations = Count(30, "", "most of a level")
    fewest = Count(5, "", "points that an estimate needs")

    quality = Positive(0.01, "", "a corner's strength, in shares of the best one's")
    spacing = Positive(5.0, "px", "least distance of two corners")
    returns = Positive(0.5, "px", "points that come back farther off do not count")


def estimate(
    recording: Recording,
    params: Params | None = None,
    *,
    model: str = "planar",
    camera: PinholeCamera | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Motion:
    """The motion between each two frames, at the middle of their times.

    The covariance is that of the fit; see `planes.robust_fit`. Where too few points could be
    followed it is lost, and the motion before is held.

    Args:
        recording: Frames, and nothing else but the calibration.
        params: See `Params`.
        model: "planar" (vx, vy) in px/s, or "rotation" (wx, wy, wz) in rad/s.
        camera: The calibration, by default the recording's.
        seed: Nothing is drawn.
        progress: Show a bar on stderr.

    Raises:
        InputError: The model is unknown, rotation is asked for without a camera, the recording has
            fewer than two frames, or OpenCV is not installed.
    """
    params = params or Params.of({})
    camera = camera or recording.camera
    check_model(recording, model, camera, MODELS)
    frames = recording.frames
    if frames is None or len(frames) < 2:
        raise InputError(
            f"{recording.name}: has {0 if frames is None else len(frames)} frames and tracking "
            "needs two; take a method that uses events, as voting or contrast"
        )
    cv2 = require("cv2", "vision")
    positions, f = coordinates(recording.width, recording.height, camera)
    size = arms(model, positions, f)
    fits, pairs = [], itertools.pairwise(range(len(frames)))
    for one, two in tqdm(list(pairs), unit="pair", delay=2, disable=not progress, leave=False):
        images = [np.rint(255 * i).astype(np.uint8) for i in frames[one : two + 1].intensity]
        begin, end = _tracks(cv2, params, *images)
        before, after = _undistorted(begin, positions), _undistorted(end, positions)
        dt = (frames.t[two] - frames.t[one]) * 1e-6
        rows = basis(model, (before + after) / 2, f).reshape(-1, len(size))
        # Points of a cell share what they show.
        cells = np.floor(begin / CELL).astype(int) @ np.array([1, recording.width // CELL + 1])
        enough = len(begin) >= params.fewest
        values = ((after - before) / dt).reshape(-1)
        fits.append(robust_fit(rows, values, np.repeat(cells, 2), size) if enough else None)
    return held(model, (frames.t[:-1] + frames.t[1:]) // 2, fits)


def _tracks(
    cv2: Any, params: Params, one: NDArray[np.uint8], two: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (n, 2) of points in the first image and in the second one."""
    none = np.zeros((0, 2))
    begin = cv2.goodFeaturesToTrack(
        one, params.corners, float(params.quality), float(params.spacing)
    )
    if begin is None or not len(begin):
        return none, none
    begin = begin.reshape(-1, 1, 2).astype(np.float32)
    how = {
        "winSize": (params.window, params.window),
        "maxLevel": params.levels - 1,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, params.iterations, 0.01),
    }
    end, found, _ = cv2.calcOpticalFlowPyrLK(one, two, begin, None, **how)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(two, one, end, None, **how)
    off = np.linalg.norm((back - begin).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (off <= float(params.returns))
    inside = ((end >= 0) & (end <= np.array(one.shape[::-1]) - 1)).reshape(-1, 2).all(1)
    good &= inside
    return begin.reshape(-1, 2)[good].astype(float), end.reshape(-1, 2)[good].astype(float)


def _undistorted(at: NDArray[np.floating], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undistorted places between pixels, bilinearly."""
    height, width = positions.shape[:2]
    i = np.clip(np.floor(at).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    x, y = i.T
    u, v = (at - i).T[..., None]
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = (1 - u) * positions[y, x] + u * positions[y, right]
    lower = (1 - u) * positions[below, x] + u * positions[below, right]
    return (1 - v) * upper + v * lower
