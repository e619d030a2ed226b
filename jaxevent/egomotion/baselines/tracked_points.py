"""Motion from frames alone: points tracked by Lucas and Kanade's method, as a baseline.

Corners of each frame are followed to the next by pyramidal Lucas-Kanade and back again; those that
return to where they began (forward-backward check) tell the motion between the two frames, by
robust least squares of their undistorted displacements: d / dt = U(x; motion), at the middle x of
the way. For a rotation that is B(x) Omega, of second order in the angle between the frames. General
motion needs longer ways: points are followed over several frames, from each one to the first that
is `span` later, and the five-point method tells it from their places in these two (`five_points`).
Needs OpenCV, the extra "vision".
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.baselines.five_points import relative_motion
from jaxevent.egomotion.baselines.local_planes import CELL, basis_on_host, held, robust_fit
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.estimator import Given, OnHost
from jaxevent.egomotion.models import General, Model
from jaxevent.egomotion.motion import Motion
from jaxevent.egomotion.patches import Speed
from jaxevent.errors import InputError, require
from jaxevent.parameters import Count, Parameters, Positive, UnitInterval
from jaxevent.progress import bar
from jaxevent.recording import Frames, Recording

WAY = 20.0  # px, that the image moves between two frames that tell a general motion
SPANS = (0.05, 1.0)  # s between them, at least and at most


class Params(Parameters):
    """Parameters of motion by tracked points."""

    corners = Count(400, "", "most points that are followed from a frame to the next")
    window = Count(11, "px", "side of the patch that is compared; levels are not smaller than it")
    levels = Count(5, "", "most of the pyramid, each half as large; 4 for ways of some 30 px")
    iterations = Count(30, "", "most of a level")
    fewest = Count(5, "", "points that an estimate needs")

    quality = UnitInterval(0.01, "", "a corner's strength, in shares of the best one's")
    spacing = Positive(5.0, "px", "least distance of two corners")
    returns = Positive(0.5, "px", "points that come back farther off do not count")
    span = Positive(0.4, "s", "general motion: time between the two frames that tell it, at least")


def solve(params: Params, given: Given) -> Motion:
    """The motion between pairs of frames, at the middle of their times.

    The covariance is that of the fit; see `local_planes.robust_fit` and `five_points`. Where too
    few points could be followed it is lost, and the motion before is held. The samples of five
    points are drawn from a fixed seed.
    """
    recording, frames = given.recording, given.recording.frames
    assert frames is not None
    cv2 = require("cv2", "vision")
    positions, f = coordinates(recording.width, recording.height, given.camera)
    model = given.model(f)
    size = model.arms(positions)
    fits, pairs = [], _pairs(frames, float(params.span) if model.half_line else 0.0)
    for one, two in bar(pairs, desc="track points", unit="pair", progress=given.progress):
        images = [np.rint(255 * i).astype(np.uint8) for i in frames[one : two + 1].intensity]
        begin, end = followed(cv2, params, images)
        before, after = undistorted(begin, positions), undistorted(end, positions)
        dt = float(frames.t[two] - frames.t[one]) * 1e-6
        # Points of a cell share what they show.
        cells = np.floor(begin / CELL).astype(int) @ np.array([1, recording.width // CELL + 1])
        if len(begin) < params.fewest:
            fits.append(None)
        elif model.half_line:
            fits.append(relative_motion(cv2, before, after, cells, f, dt))
        else:
            rows = basis_on_host(model, (before + after) / 2).reshape(-1, len(size))
            values = ((after - before) / dt).reshape(-1)
            fits.append(robust_fit(rows, values, np.repeat(cells, 2), size))
    one, two = np.array(pairs).T
    return held(given.model, (frames.t[one] + frames.t[two]) // 2, fits)


def _pairs(frames: Frames, span: float) -> list[tuple[int, int]]:
    """Each frame with the first that is later by `span` s; at least the first and the last."""
    t = np.asarray(frames.t)
    later = np.searchsorted(t, t + max(round(1e6 * span), 1))
    pairs = [(k, int(two)) for k, two in enumerate(later) if two < len(t)]
    return pairs or [(0, len(t) - 1)]


def followed(
    cv2: Any, params: Params, images: list[NDArray[np.uint8]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (n, 2) in the first image and in the last one of points seen in all of them."""
    corners = cv2.goodFeaturesToTrack(
        images[0], params.corners, float(params.quality), float(params.spacing)
    )
    begin = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
    at = begin
    for one, two in zip(images, images[1:], strict=False):
        end, good = _tracked(cv2, params, one, two, at)
        begin, at = begin[good], end[good]
    return begin.astype(float), at.astype(float)


def _tracked(
    cv2: Any,
    params: Params,
    one: NDArray[np.uint8],
    two: NDArray[np.uint8],
    at: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points (n, 2) of an image are in the next one, and which were found there."""
    if not len(at):
        return at, np.zeros(0, bool)
    at = at.reshape(-1, 1, 2).astype(np.float32)
    how = {
        "winSize": (params.window, params.window),
        "maxLevel": params.levels - 1,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, params.iterations, 0.01),
    }
    end, found, _ = cv2.calcOpticalFlowPyrLK(one, two, at, None, **how)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(two, one, end, None, **how)
    off = np.linalg.norm((back - at).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (off <= float(params.returns))
    end = end.reshape(-1, 2)
    good &= ((end >= 0) & (end <= np.array(one.shape[::-1]) - 1)).all(1)
    return end, good


def undistorted(at: NDArray[np.floating], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undistorted places between pixels, bilinearly."""
    height, width = positions.shape[:2]
    i = np.clip(np.floor(at).astype(int), 0, [max(width - 2, 0), max(height - 2, 0)])
    x, y = i.T
    u, v = (at - i).T[..., None]
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = (1 - u) * positions[y, x] + u * positions[y, right]
    lower = (1 - u) * positions[below, x] + u * positions[below, right]
    return (1 - v) * upper + v * lower


def lengths(params: Params, speed: Speed) -> dict[str, float]:
    """A span in which the image moves by `WAY`."""
    return {"span": float(np.clip(WAY / speed.usual, *SPANS))}


@dataclasses.dataclass(frozen=True, repr=False)
class TrackedPoints(OnHost[Params]):
    """Points followed between frames; it needs two frames, and OpenCV."""

    needs_frames: bool = dataclasses.field(default=True, kw_only=True)

    def knows(self, model: type[Model]) -> bool:
        return issubclass(model, General) or not model.half_line

    def check(self, recording: Recording) -> None:
        frames = recording.frames
        if frames is None or len(frames) < 2:
            raise InputError(
                f"{recording.name}: has {0 if frames is None else len(frames)} frames and tracking "
                f"needs two{recording.describe_left_out('frames')}; take a method that uses "
                "events, as voting or contrast"
            )


frames = TrackedPoints(
    "frames",
    Params,
    solve,
    lengths=lengths,
    about="Motion from frames alone: points tracked by Lucas and Kanade's method tell the motion "
    "between each two frames, general motion by the five-point method. It needs OpenCV.",
)
