"""Motion that all points of a scene have in common, and that no parabola of time explains.

Trajectories are parabolas of time over the instants of a target. A camera that is shaken turns
several times meanwhile, but it moves all points alike. So images at instants that follow each other
are registered by one translation, coarse to fine; their sum is the course of the image. Of a camera
that moves evenly it is a parabola, up to noise, and is not needed.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.compensated.instants import CommonMotion
from jaxevent.reconstruction.compensated.normal_equations import (
    CostParams,
    PackedImages,
    linearise,
)
from jaxevent.reconstruction.compensated.trajectories import ImagePyramid, node_shape
from jaxevent.reconstruction.compensated.warp import PathTimes

# Root mean square over the instants of what a parabola leaves of the course: below it images lose
# little sharpness.
MIN_DEVIATION_PX = 0.25
COARSE_LEVELS, FINE_LEVELS = (4, 3, 2), (2, 1)  # to see whether there is any, and to measure it
SEARCH_LEVEL, SEARCH_REACH = 2, 4  # resolution of the search, and how far it goes, in its pixels
N_STEPS_PER_LEVEL = 4  # Gauss-Newton steps
MAX_STEP_PX = 2.0  # at each level, in its pixels
LEAST_STEP_PX = 0.03
MIN_INFORMATION = 1e-3  # of the sum along both axes, along the axis that images show least
MIN_INSTANTS = 4  # fewer always lie on a parabola


def estimate_common_motion(
    pyramid: ImagePyramid, t: NDArray[np.int64], s: NDArray[np.float32], cost: CostParams
) -> CommonMotion | None:
    """Estimate the common motion of images at the instants of a target.

    Args:
        pyramid: Images at the instants.
        t: (K,) sorted times of the instants, us.
        s: (K,) the same on the clock of trajectories, -1..1.
        cost: Parameters of the cost, float32.

    Returns:
        The motion; None where it is a parabola of s, which trajectories explain.
    """
    if len(t) < MIN_INSTANTS:
        return None
    pairs = range(len(t) - 1)
    steps = [_register(pyramid, k, np.zeros(2), COARSE_LEVELS, cost) for k in pairs]
    if _deviation(_subtract_parabola(steps, s)) < MIN_DEVIATION_PX:
        return None
    L = pyramid[SEARCH_LEVEL][..., 0]
    starts = [_find_shift(L[k], L[k + 1]) * 2**SEARCH_LEVEL for k in pairs]
    steps = [_register(pyramid, k, starts[k], FINE_LEVELS, cost) for k in pairs]
    rest = _subtract_parabola(steps, s)
    return CommonMotion(t, rest) if _deviation(rest) > MIN_DEVIATION_PX else None


def _find_shift(image: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float64]:
    """Find the whole pixels by which one image best fits another one.

    Args:
        image: (h, w) log intensity.
        other: (h, w) log intensity.

    Returns:
        (2,) displacement from `image` to `other` along x and y, px, each at most `SEARCH_REACH`.
    """
    (h, w), reach = image.shape, SEARCH_REACH
    best, found = np.inf, np.zeros(2)
    for dy, dx in itertools.product(range(-reach, reach + 1), repeat=2):
        if h <= 2 * abs(dy) or w <= 2 * abs(dx):
            continue
        here = image[max(-dy, 0) : h - max(dy, 0), max(-dx, 0) : w - max(dx, 0)]
        there = other[max(dy, 0) : h + min(dy, 0), max(dx, 0) : w + min(dx, 0)]
        variance = float(np.var(there - here))
        if variance < best:
            best, found = variance, np.array([dx, dy], float)
    return found


def _deviation(displacement: NDArray[np.float64]) -> float:
    return float(np.sqrt((displacement**2).sum(1).mean()))


def _subtract_parabola(
    steps: Sequence[NDArray[np.float64]], s: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Sum steps up to a course, and subtract the parabola of s that is nearest to it.

    Args:
        steps: K - 1 translations (2,) from each instant to the next, px.
        s: (K,) times of the instants on the clock of trajectories, -1..1.

    Returns:
        (K, 2) rest along x and y, px.
    """
    course = np.cumsum([np.zeros(2), *steps], 0)
    powers = np.stack([np.ones_like(s), s, s**2], 1).astype(float)
    return course - powers @ np.linalg.lstsq(powers, course, rcond=None)[0]


def _register(
    pyramid: ImagePyramid,
    k: int,
    moved: NDArray[np.float64],
    levels: tuple[int, ...],
    cost: CostParams,
) -> NDArray[np.float64]:
    """Register an image with the next one by a translation.

    Args:
        pyramid: Images at the instants.
        k: Index of the first of the two images.
        moved: (2,) translation to start from, along x and y, px at full resolution.
        levels: Resolutions, coarse to fine; 0: full.
        cost: Parameters of the cost.

    Returns:
        (2,) translation from image k to image k + 1, px at full resolution.
    """
    times = PathTimes.without_common(np.array([0, 1], np.float32))
    for level in levels:
        images = PackedImages.of(pyramid[level][k : k + 2], times)
        nodes = np.zeros((*node_shape(*pyramid.image_shape, level), 4), np.float32)
        for _ in range(N_STEPS_PER_LEVEL):
            nodes[..., :2] = moved / 2**level
            equations = linearise(images, nodes, cost)
            xx, xy, _, _, yy = equations.N[..., :5].sum((0, 1), dtype=float)
            least = MIN_INFORMATION * (xx + yy) + 1e-12
            matrix = np.array([[xx + least, xy], [xy, yy + least]])
            step = np.linalg.solve(matrix, equations.b[..., :2].sum((0, 1), dtype=float))
            moved = moved + step.clip(-MAX_STEP_PX, MAX_STEP_PX) * 2**level
            if abs(step).max() < LEAST_STEP_PX:
                break
    return moved
