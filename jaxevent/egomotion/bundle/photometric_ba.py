"""Photometric bundle adjustment of a window of events: path, depths and map of log intensity.

Cf. Guo & Gallego, "Event-based photometric bundle adjustment", there for rotation. Log intensity at
a pixel u at its event e is known from its polarities but for the pixel's initial level b_u, and is
that of the scene at the warped position: with L the map of log intensity in the reference view in
units of the contrast threshold,

    L(x_ref(u, t_e)) = b_u + s_e,   s_e = sum of the polarities of u's events up to and with e,

is linear in L and b_u. Minimised over L, b_u, path and depths is the sum of the squared
residuals, robustly (Geman & McClure, 3 sigma), with weak priors on differences of L and of log
depth between neighbours and on changes of the twist. b_u is eliminated exactly (residuals less
their mean over the pixel's events), all else is one linear system a step, solved by conjugate
gradients (`cg`). Steps extrapolate (Nesterov): reweighting alone is slow. A step that costs more is
taken back and damped (Levenberg & Marquardt): beside sharp edges residuals are linear within a
fraction of a pixel only.
Where an outline passes before another, their crossing moves as neither, and the levels beside them
change. Residuals are large on average there, so that all events count less (`robust_weights`).
An ON threshold C (1 + skew) and an OFF one of C (1 - skew) are allowed for. Pixels of frames are
fitted to the same map.

Depth is interpolated between nodes 4 px apart, and an event lies on the nearest surface that its
ray meets: surfaces behind are hidden. `search_depths` gives every node the depth at which the
events around it have the highest contrast, the path held fixed: beside an edge of depth that is the
nearer surface's, whose outline made the events. Adjusted from smooth depths instead, the path ends
beside the truth. Or all depths are those of a plane.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath
from jaxevent.egomotion.bundle import warp
from jaxevent.egomotion.bundle.alignment import ContrastMaps, ImageScratch, blur, splat
from jaxevent.egomotion.bundle.normal_equations import (
    N_PATH_UNKNOWNS,
    Evaluation,
    NormalEquations,
    Problem,
    evaluate,
    gradient,
    inverse_columns,
    linearise,
    solve,
)
from jaxevent.egomotion.bundle.residuals import PixelSeries, Scene, subtract_mean

# A step that costs more is taken back and damped, first by INITIAL_DAMPING, then by
# DAMPING_GROWTH_FACTOR times more, until no step helps. One that costs less leaves
# DAMPING_DECAY_FACTOR of the damping, and is the last if it gains less than MIN_RELATIVE_GAIN of
# the objective.
INITIAL_DAMPING = 0.1
DAMPING_GROWTH_FACTOR = 5
MAX_DAMPING = 50
DAMPING_DECAY_FACTOR = 0.5
MIN_RELATIVE_GAIN = 1e-3
CORRELATED_CELL_SIZES_PX = 24, 48  # within which errors of events are alike
MAX_LOG_DEPTH_SPREAD = 5.0  # of log depth beside the median, that single precision bears
N_SEARCHED_DEPTHS = 40  # log depths that are tried at a node
DEPTH_SEARCH_SQUARE_PX = 12  # of the square about a node whose contrast counts


class StepControl(NamedTuple):
    """State of the step control.

    Attributes:
        momentum: Nesterov's count of gaining steps.
        damping: Damping of the normal equations.
    """

    momentum: int
    damping: float

    @property
    def extrapolation(self) -> float:
        """Multiple of the last step by which the next one is extrapolated."""
        return self.momentum / (self.momentum + 2)

    @property
    def should_continue(self) -> bool:
        """True while another step may gain."""
        return self.damping < MAX_DAMPING


def update_control(
    control: StepControl, accepted: bool, gain: float, objective: float, builds_momentum: bool
) -> StepControl:
    """Return the step control after a step.

    Args:
        control: State before the step.
        accepted: Whether the step reduced the objective.
        gain: Reduction of the objective.
        objective: Objective before the step.
        builds_momentum: Whether an accepted step adds momentum.

    Returns:
        The state after it.
    """
    damping = control.damping
    damping = (
        damping * DAMPING_DECAY_FACTOR
        if accepted
        else max(damping * DAMPING_GROWTH_FACTOR, INITIAL_DAMPING)
    )
    damping = damping if damping >= INITIAL_DAMPING / 4 else 0.0
    if accepted and gain < MIN_RELATIVE_GAIN * objective:
        damping = MAX_DAMPING
    return StepControl(control.momentum + 1 if accepted and builds_momentum else 0, damping)


class FitReport(NamedTuple):
    """Quality of a fit at its end."""

    noise: float  # C, 1.48 times the median of the absolute residuals
    cost: float  # C^2, robust, per event
    inliers: float  # share of events


def adjust(
    series: PixelSeries,
    scene: Scene,
    prior: warp.Prior,
    *,
    sigma: float | int,
    map_steps: int,
    steps: int,
    plane: bool = False,
) -> tuple[Scene, FitReport]:
    """Take steps of the bundle adjustment.

    Steps after the first ones never raise the objective, and end early if none lowers it.

    Args:
        series: Events.
        scene: Scene to begin with.
        prior: Priors.
        sigma: Standard deviation of residuals, C, which scales outliers.
        map_steps: Number of first steps that move the map alone.
        steps: Number of steps in all.
        plane: Whether depths stay a plane's: rho = n . (x, y, f) / f, of which n is unknown.

    Returns:
        The scene, and a report of its fit.
    """
    problem, kept = init_problem(series, scene, prior, float(sigma), plane)
    last, control = scene, StepControl(0 if map_steps else 1, 0.0)
    for n in range(1, steps + 1):
        scene = gauss_newton_step(problem, kept, control.damping, n <= map_steps)
        extrapolated = extrapolate(scene, last, control.extrapolation, plane)
        tried = evaluate(problem, extrapolated, kept.weight, kept)
        accepted = n <= map_steps or tried.objective <= kept.objective
        gain = kept.objective - tried.objective if n > map_steps else math.inf
        last, kept = (scene, tried) if accepted else (kept.scene, kept)
        control = update_control(control, accepted, gain, kept.objective, n >= map_steps)
        if not control.should_continue:
            break
    return kept.scene, summarise(problem, kept)


def init_problem(
    series: PixelSeries, scene: Scene, prior: warp.Prior, sigma: float, plane: bool
) -> tuple[Problem, Evaluation]:
    """Make the problem of a bundle adjustment, and evaluate its first scene.

    Args:
        series: Events.
        scene: Scene to begin with.
        prior: Priors.
        sigma: Standard deviation of residuals, C.
        plane: Whether depths stay a plane's.

    Returns:
        The problem, with the typical cost of positions at the first scene, and the evaluation.
    """
    weight = np.ones_like(series.x)
    problem = Problem(series, prior, sigma, plane, math.inf)
    first = evaluate(problem, scene, weight)
    problem = problem._replace(typical_cost=max(first.cost, 1e-3 * problem.loss.limit))
    return problem, evaluate(problem, first.scene, weight, first)


def extrapolate(scene: Scene, last: Scene, factor: float, plane: bool) -> Scene:
    """Extrapolate a scene by a multiple of its last step (Nesterov).

    A plane's inverse depths are extrapolated, others' logarithms: only so is it a plane again.

    Args:
        scene: The scene.
        last: The scene before its last step.
        factor: Multiple of the step; 0 returns `scene`.
        plane: Whether depths are a plane's.

    Returns:
        The extrapolated scene.
    """
    if not factor:
        return scene
    here, there = scene.path, last.path
    O, D, image = (  # noqa: E741
        new + factor * (new - old)
        for new, old in ((here.O, there.O), (here.D, there.D), (scene.map, last.map))
    )
    depth = here.log_rho + factor * (here.log_rho - there.log_rho)
    if plane:
        near, nearer = np.exp(there.log_rho), np.exp(here.log_rho)
        far = warp.MIN_RELATIVE_PLANE_RHO * np.median(nearer)
        depth = np.log(np.maximum(nearer + factor * (nearer - near), far))
    skew = scene.skew + factor * (scene.skew - last.skew)
    real = scene.map.dtype
    return Scene(warp.Path(O, D, depth.astype(real)), image.astype(real), skew)


def gauss_newton_step(problem: Problem, kept: Evaluation, damping: float, map_only: bool) -> Scene:
    """Take a damped Gauss-Newton step.

    Args:
        problem: Data and settings.
        kept: Evaluation of the scene at which the step begins.
        damping: Fraction by which the diagonal of the normal matrix is enlarged.
        map_only: Whether the map alone moves.

    Returns:
        The scene after the step; the same scene if the step is not finite.
    """
    scene = kept.scene
    equations = linearise(problem, kept, map_only)
    down: tuple = tuple(-part for part in gradient(equations))
    image, t, q = solve(equations, damping, down)
    if not all(np.isfinite(part).all() for part in (image, t, q)):
        return scene
    if map_only:
        return Scene(scene.path, scene.map + image, scene.skew)
    fraction = warp.step_fraction(t[:N_PATH_UNKNOWNS])
    rows = (equations.t + fraction * t)[:N_PATH_UNKNOWNS] * equations.unit
    path = warp.replace_rows(scene.path, rows)
    if problem.plane:
        depth = update_plane_normal(path, problem.series, fraction * t[N_PATH_UNKNOWNS + 1 :])
    else:
        depth = path.log_rho + np.clip(
            fraction * q, -warp.MAX_LOG_DEPTH_STEP, warp.MAX_LOG_DEPTH_STEP
        )
    path = warp.normalise(warp.Path(path.O, path.D, depth.astype(scene.map.dtype)))
    return Scene(path, scene.map + image, scene.skew + fraction * t[N_PATH_UNKNOWNS])


def update_plane_normal(
    path: warp.Path, series: PixelSeries, change: NDArray
) -> NDArray[np.float64]:
    """Return log depths at nodes after a change of their plane's normal.

    Args:
        path: Path, with a plane's depths but at nodes where they would be too small.
        series: Events, which define the nodes.
        change: (3,) change of the normal, in median inverse depths.

    Returns:
        (nodes,) log inverse depths.
    """
    level = np.exp(path.log_rho.astype(np.float64))
    median = float(np.median(level))
    rays = warp.pixel_rays(*series.node_positions, series.f)
    known = np.where(level > 1.5 * warp.MIN_RELATIVE_PLANE_RHO * median, rays.T, 0)
    # By einsum: larger products wake BLAS's threads, which spin then.
    normal = np.linalg.solve(known @ rays + 1e-6 * np.eye(3), np.einsum("in,n->i", known, level))
    level = np.einsum("ni,i->n", rays, normal + median * change)
    return np.log(np.maximum(level, warp.MIN_RELATIVE_PLANE_RHO * median))


def summarise(problem: Problem, kept: Evaluation) -> FitReport:
    """Return noise, cost and inliers of an evaluation's events."""
    left, events = kept.residual.copy(), problem.series.n_events
    subtract_mean(left, kept.weight, problem.series.begin)
    left, on = left[:events], kept.samples.inside[:events]
    number = max(float(on.sum()), 1.0)
    within = np.abs(left[on > 0])
    noise = 1.48 * float(np.median(within)) if len(within) else 0.0
    inliers = float((on / (1 + left**2 / problem.loss.limit) ** 2).sum()) / number
    return FitReport(noise, kept.cost, inliers)


def compute_covariance(
    series: PixelSeries, scene: Scene, prior: warp.Prior, *, sigma: float | int, plane: bool = False
) -> NDArray[np.float64]:
    """Return the covariance of heading and rotation of an adjusted scene.

    Args:
        series: Events.
        scene: The adjusted scene.
        prior: Priors.
        sigma: Standard deviation of residuals, C, which scales outliers.
        plane: Whether depths are a plane's.

    Returns:
        (6, 6), of the heading C1 and of Omega O0 (rad/s).
    """
    path = scene.path
    median = np.median(path.log_rho)
    depth = np.clip(path.log_rho, median - MAX_LOG_DEPTH_SPREAD, median + MAX_LOG_DEPTH_SPREAD)
    scene = scene._replace(path=warp.Path(path.O, path.D, depth))
    problem, evaluation = init_problem(series, scene, prior, float(sigma), plane)
    return sandwich_covariance(linearise(problem, evaluation, map_only=False))


def sandwich_covariance(equations: NormalEquations) -> NDArray[np.float64]:
    """Return H^-1 (sum_c g_c g_c' + the priors') H^-1 of heading and Omega, (6, 6).

    Errors are alike within cells c of 24 or of 48 px, whichever gives more. H counts the weights w
    of residuals e; the curvature of their robust cost is less, the mean of
    d(w e)/de = w (1 - 3 u) / (1 + u), u = (e / 3 sigma)^2 (Huber).
    """
    problem, evaluation, left = equations.problem, equations.evaluation, equations.residual
    series, weight = problem.series, evaluation.weight
    u = (series.precision * left) ** 2 / problem.loss.limit
    curved = float((weight * (1 - 3 * u) / (1 + u)).sum()) / max(float(weight.sum()), 1.0)
    less = 1 / max(curved, 0.1) ** 2
    small, large = CORRELATED_CELL_SIZES_PX
    rows, columns = (-(-n // small) for n in series.shape)
    down, across = ((series.y - series.corner[1]), (series.x - series.corner[0]))
    cell = (down // small * columns + across // small).astype(np.int64)
    sums, own = [], []
    for v in inverse_columns(
        equations, [*range(3 * warp.N_COEFFICIENT_ROWS, 3 * warp.N_COEFFICIENT_ROWS + 3), *range(3)]
    ):
        score = problem.information * weight * left * equations.jacobian_product(v)
        sums.append(np.bincount(cell, score, rows * columns))
        own.append(v[1])
    parts, size = np.array(sums), large // small
    wide = parts.reshape(6, rows, columns)
    wide = np.pad(wide, [(0, 0), (0, -rows % size), (0, -columns % size)])
    wide = wide.reshape(6, -(-rows // size), size, -(-columns // size), size).sum((2, 4))
    both = [part @ part.T for part in (parts, wide.reshape(6, -1))]
    larger = both[1] if np.trace(both[1]) > np.trace(both[0]) else both[0]
    prior = np.array(own)
    return less * larger + prior @ equations.path_prior @ prior.T


@njit_fastmath
def _contrast_by_depth(rays, p, depths, series, scratch, out):
    """Compute contrast and number of events about nodes, by inverse depth.

    Args:
        rays: r and d (4, events): at inverse depth rho an event lies at r + rho d, px.
        p: (events,) polarities.
        depths: (n,) inverse depths.
        series: `PixelSeries`, for the nodes.
        scratch: `ImageScratch` with sums (2, rows, width).
        out: `ContrastMaps` (n, rows, columns), of the square of `DEPTH_SEARCH_SQUARE_PX` about each
            node.
    """
    rx, ry, dx, dy = rays
    images, strips, node = scratch.images, scratch.sums, series.node
    height, width = images.shape[1:]
    rows, columns = out.contrast.shape[1:]
    before = DEPTH_SEARCH_SQUARE_PX // 2
    for n in range(len(depths)):
        images[:] = 0
        rho = depths[n]
        for e in range(len(rx)):
            X, Y = rx[e] + rho * dx[e] - series.corner[0], ry[e] + rho * dy[e] - series.corner[1]
            splat(images[0], X, Y, p[e])
            splat(images[1], X, Y, images.dtype.type(1))
        blur(images[0], scratch.work, 1)
        strips[:] = 0
        for j in range(rows):
            for k in range(
                max(j * node - before, 0), min(j * node - before + DEPTH_SEARCH_SQUARE_PX, height)
            ):
                for i in range(width):
                    strips[0, j, i] += images[0, k, i] * images[0, k, i]
                    strips[1, j, i] += images[1, k, i]
        for j in range(rows):
            for i in range(columns):
                s = t = 0.0
                for k in range(
                    max(i * node - before, 0),
                    min(i * node - before + DEPTH_SEARCH_SQUARE_PX, width),
                ):
                    s += strips[0, j, k]
                    t += strips[1, j, k]
                out.contrast[n, j, i], out.number[n, j, i] = s, t


def _contrast_of_depths(path: warp.Path, series: PixelSeries, depths: NDArray) -> ContrastMaps:
    """Compute contrast and number of events about nodes for some inverse depths of all nodes.

    Args:
        path: Path of the camera.
        series: Events.
        depths: (n,) inverse depths, in units of 1/|T|.

    Returns:
        Maps (n, rows, columns).
    """
    events = slice(series.n_events)
    at = warp.Points(series.x[events], series.y[events], series.tau[events])
    real, none = series.x.dtype, np.zeros_like(at.x)
    rx, ry = warp.warp(path, series.f, at, none)
    X, Y = warp.warp(path, series.f, at, none + 1)
    rays = np.stack([rx, ry, X - rx, Y - ry]).astype(real)
    sums = np.empty((2, series.nodes[0], series.shape[1]))
    out = ContrastMaps(*(np.empty((len(depths), *series.nodes)) for _ in range(2)))
    scratch = ImageScratch.of(series.shape, real, sums)
    _contrast_by_depth(rays, series.p[events], depths.astype(real), series, scratch, out)
    return out


def search_depths(path: warp.Path, series: PixelSeries) -> NDArray:
    """Search the depth of highest contrast around each node, for a fixed path.

    Depths are tried from 2.5 times nearer to 2.5 times farther than those of the path. Nodes with
    few events take the depths of their surroundings.

    Args:
        path: Path with log depths at nodes.
        series: Events.

    Returns:
        Log inverse depths at nodes (nodes,).
    """
    low, high = np.percentile(path.log_rho, [5.0, 95.0]).tolist()
    low, high = low - np.log(2.5), high + np.log(2.5)
    S, n = (
        scipy.ndimage.gaussian_filter(part, (0, 1.5, 1.5))
        for part in _contrast_of_depths(
            path, series, np.exp(np.linspace(low, high, N_SEARCHED_DEPTHS))
        )
    )
    sharp = S / np.maximum(n, 20)
    best = sharp.argmax(0)
    inner = np.clip(best, 1, N_SEARCHED_DEPTHS - 2)
    before, here, after = (np.take_along_axis(sharp, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    bend = np.minimum(before - 2 * here + after, -1e-9)
    found = inner + np.where(best == inner, np.clip((before - after) / 2 / bend, -0.5, 0.5), 0)
    found = low + (high - low) / (N_SEARCHED_DEPTHS - 1) * found
    clarity = n.mean(0) * np.maximum(1 - sharp.mean(0) / np.maximum(here, 1e-9), 0)
    clarity *= np.where(best == inner, 1, 1e-3)
    clarity /= clarity + max(clarity.mean(), 1e-9)
    total, weight = clarity * found, clarity
    for k in range(6):
        blurred = (
            scipy.ndimage.gaussian_filter(part, 2.0**k) for part in (clarity * found, clarity)
        )
        share = 0.1 ** (k + 1)
        total, weight = (a + share * b for a, b in zip((total, weight), blurred, strict=True))
    median = float(np.median(path.log_rho))
    return ((total + 1e-9 * median) / (weight + 1e-9)).ravel().astype(series.x.dtype)
