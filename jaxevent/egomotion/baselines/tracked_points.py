"""Motion from frames alone: points tracked by Lucas and Kanade's method, as a baseline.

Corners of each frame are followed to the next by pyramidal Lucas-Kanade and back again; those that
return to where they began (forward-backward check) tell the motion between the two frames, by
robust least squares of their undistorted displacements: d / dt = U(x; motion), at the middle x of
the way. For a rotation that is B(x) Omega, of second order in the angle between the frames. Needs
OpenCV, the extra "vision".
"""

import dataclasses
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.baselines.local_planes import CELL, basis_on_host, held, robust_fit
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.estimator import Given, OnHost
from jaxevent.egomotion.motion import Motion
from jaxevent.errors import InputError, require
from jaxevent.parameters import Count, Parameters, Positive, Share
from jaxevent.progress import bar
from jaxevent.recording import Recording


class Params(Parameters):
    """Parameters of motion by tracked points."""

    corners = Count(400, "", "most points that are followed from a frame to the next")
    window = Count(11, "px", "side of the patch that is compared; levels are not smaller than it")
    levels = Count(5, "", "most of the pyramid, each half as large; 4 for ways of some 30 px")
    iterations = Count(30, "", "most of a level")
    fewest = Count(5, "", "points that an estimate needs")

    quality = Share(0.01, "", "a corner's strength, in shares of the best one's")
    spacing = Positive(5.0, "px", "least distance of two corners")
    returns = Positive(0.5, "px", "points that come back farther off do not count")


def solve(params: Params, given: Given) -> Motion:
    """The motion between each two frames, at the middle of their times.

    The covariance is that of the fit; see `local_planes.robust_fit`. Where too few points could be
    followed it is lost, and the motion before is held. Nothing is drawn.
    """
    recording, frames = given.recording, given.recording.frames
    assert frames is not None
    cv2 = require("cv2", "vision")
    positions, f = coordinates(recording.width, recording.height, given.camera)
    model = given.model(f)
    size = model.arms(positions)
    fits, pairs = [], itertools.pairwise(range(len(frames)))
    for one, two in bar(list(pairs), unit="pair", progress=given.progress):
        images = [np.rint(255 * i).astype(np.uint8) for i in frames[one : two + 1].intensity]
        begin, end = _tracks(cv2, params, *images)
        before, after = _undistorted(begin, positions), _undistorted(end, positions)
        dt = (frames.t[two] - frames.t[one]) * 1e-6
        rows = basis_on_host(model, (before + after) / 2).reshape(-1, len(size))
        # Points of a cell share what they show.
        cells = np.floor(begin / CELL).astype(int) @ np.array([1, recording.width // CELL + 1])
        enough = len(begin) >= params.fewest
        values = ((after - before) / dt).reshape(-1)
        fits.append(robust_fit(rows, values, np.repeat(cells, 2), size) if enough else None)
    return held(given.model, (frames.t[:-1] + frames.t[1:]) // 2, fits)


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


@dataclasses.dataclass(frozen=True, repr=False)
class TrackedPoints(OnHost[Params]):
    """Points from each frame to the next; it needs two frames, and OpenCV."""

    needs_frames: bool = dataclasses.field(default=True, kw_only=True)

    def check(self, recording: Recording) -> None:
        frames = recording.frames
        if frames is None or len(frames) < 2:
            raise InputError(
                f"{recording.name}: has {0 if frames is None else len(frames)} frames and tracking "
                "needs two; take a method that uses events, as voting or contrast"
            )


frames = TrackedPoints(
    "frames",
    Params,
    solve,
    linear=True,
    about="Motion from frames alone: points tracked by Lucas and Kanade's method tell the motion "
    "between each two frames. It needs OpenCV.",
)
