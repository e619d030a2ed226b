"""The photometric fit of a window of events: path, depths and a map of log intensity in one.

Cf. Guo & Gallego, "Event-based photometric bundle adjustment", there for rotation. Log intensity at
a pixel u at its event e is known from its polarities but for the pixel's beginning b_u, and is that
of the scene where the warp takes u: with L the map of log intensity in the reference view in units
of the contrast threshold,

    L(x_ref(u, t_e)) = b_u + s_e,   s_e = sum of the polarities of u's events up to and with e,

is linear in L and b_u. Minimised over L, b_u, path and depths is the sum of the squared
differences, robustly (Geman & McClure, 3 sigma), with weak priors on differences of L and of log
depth between neighbours and on changes of the twist. L is a quadratic B-spline of 1 px: with
bilinear interpolation the cost at the true motion is higher. b_u is
eliminated exactly (differences less their mean over the pixel's events), all else is one linear
system a step, solved by conjugate gradients, without the matrix: diagonals of map and depths, and
path with smooth depths exactly, precondition it (`coarse`). Steps extrapolate (Nesterov):
reweighting alone is slow. A step that costs more is taken back and damped (Levenberg & Marquardt):
beside sharp edges misfits are linear within a fraction of a pixel only, and the cost would grow.
Where an outline passes before another, their crossing moves as neither and the levels beside them
change, so that events there mislead. Single misfits do not stand out there, but all of them are
larger: where misfits are large on average, within `PLACE`, all events count less.
Nothing is gained by squeezing events together, which biases contrast, and no event is compared that
tells only the gradient along the flow. An ON threshold C (1 + skew) and an OFF one of C (1 - skew)
are allowed for. Pixels of frames, where there are any, are fitted to the same map (`frames`).

Depth is interpolated between nodes 4 px apart, and an event lies on the nearest surface that its
ray meets: what is behind is hidden. `depths` gives every node the depth at which the events around
it have the highest contrast, the path held fixed: beside an edge of depth that is the nearer
surface's, whose outline made the events. Adjusted from smooth depths instead, the path ends beside
the truth. Or all depths are those of a plane.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.equations import (
    FREE,
    Equations,
    Problem,
    Seen,
    gradient_of,
    inverse_of,
    linearise,
    look,
    solve,
)
from jaxevent.egomotion.bundle.gauss_newton import (
    DEEPEST,
    Acceptance,
    accept,
    limit_step,
)
from jaxevent.egomotion.bundle.path import LEAST, ROWS, Path, Prior, normalised, rays_of
from jaxevent.egomotion.bundle.rows import with_rows
from jaxevent.egomotion.bundle.tracks import Scene, Tracks
from jaxevent.egomotion.bundle.weighing import subtract_mean

CELLS = 24, 48  # px, whose errors are alike
# Of log inverse depths, beside the usual one. Nodes that hardly an event tells of end up to 20 from
# it before plain shapes, where single precision holds no equations.
RUNAWAY = 5.0


class Report(NamedTuple):
    """Of a fit's end: the noise (C), the robust cost per event (C^2), the share of inliers."""

    noise: float  # 1.48 times the median of the absolute misfits
    cost: float
    inliers: float


def adjust(
    tracks: Tracks,
    scene: Scene,
    prior: Prior,
    *,
    sigma: float | int,
    settle: int,
    steps: int,
    plane: bool = False,
) -> tuple[Scene, Report]:
    """So many steps of the photometric fit.

    `sigma` (C) scales what counts as an outlier. The first `settle` steps move the map alone. Later
    ones never cost more, and end early where none costs less. The report is of the end. Depths that
    are a `plane`'s remain one's: rho = n . (x, y, f) / f, of which n is unknown, instead of any at
    nodes.
    """
    problem, kept = begin(tracks, scene, prior, float(sigma), plane)
    last, now = scene, Acceptance(0 if settle else 1, 0.0)
    for n in range(1, steps + 1):
        scene = step(problem, kept, now.damping, n <= settle)
        tried = look(problem, extrapolate(scene, last, now.ahead, plane), kept.weight, kept)
        better = n <= settle or tried.energy <= kept.energy
        gain = kept.energy - tried.energy if n > settle else math.inf
        last, kept = (scene, tried) if better else (kept.scene, kept)
        now = accept(now, better, gain, kept.energy, n >= settle)
        if not now.goes_on:
            break
    return kept.scene, report(problem, kept)


def begin(
    tracks: Tracks, scene: Scene, prior: Prior, sigma: float, plane: bool
) -> tuple[Problem, Seen]:
    """What steps have in common, and what is seen to begin with."""
    weight = np.ones_like(tracks.x)
    problem = Problem(tracks, prior, sigma, plane, math.inf)
    first = look(problem, scene, weight)
    problem = problem._replace(usual=max(first.cost, 1e-3 * problem.limit))
    return problem, look(problem, first.scene, weight, first)


def extrapolate(scene: Scene, last: Scene, ahead: float, plane: bool) -> Scene:
    """The scene so many times its last step ahead (Nesterov).

    Only inverse depths themselves, extrapolated, are a plane's again.
    """
    if not ahead:
        return scene
    here, there = scene.path, last.path
    O, D, image = (  # noqa: E741
        new + ahead * (new - old)
        for new, old in ((here.O, there.O), (here.D, there.D), (scene.map, last.map))
    )
    depth = here.log_rho + ahead * (here.log_rho - there.log_rho)
    if plane:
        near, nearer = np.exp(there.log_rho), np.exp(here.log_rho)
        far = LEAST * np.median(nearer)
        depth = np.log(np.maximum(nearer + ahead * (nearer - near), far))
    skew = scene.skew + ahead * (scene.skew - last.skew)
    real = scene.map.dtype
    return Scene(Path(O, D, depth.astype(real)), image.astype(real), skew)


def step(problem: Problem, kept: Seen, damping: float, settling: bool) -> Scene:
    """The scene after a damped step of Gauss and Newton from what is kept."""
    tracks, scene = problem.tracks, kept.scene
    equations = linearise(problem, kept, settling)
    down: tuple = tuple(-part for part in gradient_of(equations))
    image, t, q = solve(equations, damping, down)
    if not all(np.isfinite(part).all() for part in (image, t, q)):
        return scene
    if settling:
        return Scene(scene.path, scene.map + image, scene.skew)
    moved = limit_step(t[:FREE])
    path = with_rows(scene.path, (equations.now + moved * t)[:FREE] * equations.unit)
    if problem.plane:
        depth = tilt(path, tracks, moved * t[FREE + 1 :])
    else:
        depth = path.log_rho + np.clip(moved * q, -DEEPEST, DEEPEST)
    path = normalised(Path(path.O, path.D, depth.astype(scene.map.dtype)))
    return Scene(path, scene.map + image, scene.skew + moved * t[FREE])


def tilt(path: Path, tracks: Tracks, change: NDArray) -> NDArray[np.float64]:
    """Log depths at nodes of their plane after its normal has changed, in usual inverse depths.

    The plane is that of the nodes whose inverse depth was not too small for one.
    """
    level = np.exp(path.log_rho.astype(np.float64))
    usual = float(np.median(level))
    rays = rays_of(*tracks.places, tracks.f)
    told = np.where(level > 1.5 * LEAST * usual, rays.T, 0)
    # By einsum: larger products wake BLAS's threads, which spin then.
    normal = np.linalg.solve(told @ rays + 1e-6 * np.eye(3), np.einsum("in,n->i", told, level))
    level = np.einsum("ni,i->n", rays, normal + usual * change)
    return np.log(np.maximum(level, LEAST * usual))


def report(problem: Problem, kept: Seen) -> Report:
    """What a fit tells of its end, of the events."""
    left, events = kept.e.copy(), problem.tracks.events
    subtract_mean(left, kept.weight, problem.tracks.begin)
    left, on = left[:events], kept.places.inside[:events]
    number = max(float(on.sum()), 1.0)
    within = np.abs(left[on > 0])
    noise = 1.48 * float(np.median(within)) if len(within) else 0.0
    inliers = float((on / (1 + left**2 / problem.limit) ** 2).sum()) / number
    return Report(noise, kept.cost, inliers)


def compute_covariance(
    tracks: Tracks, scene: Scene, prior: Prior, *, sigma: float | int, plane: bool = False
) -> NDArray[np.float64]:
    """The covariance (6, 6) of C1 and O0 of a scene that was fitted with these settings."""
    path = scene.path
    usual = np.median(path.log_rho)
    depth = np.clip(path.log_rho, usual - RUNAWAY, usual + RUNAWAY)
    scene = scene._replace(path=Path(path.O, path.D, depth))
    problem, seen = begin(tracks, scene, prior, float(sigma), plane)
    return spread(linearise(problem, seen, settling=False))


def spread(equations: Equations) -> NDArray[np.float64]:
    """H^-1 (sum_c g_c g_c' + the priors') H^-1, with c cells, within which errors are alike.

    Of cells of 24 and of 48 px those that tell more.

    H counts the weights w of misfits e, the curvature of their robust cost is less: the mean of
    d(w e)/de = w (1 - 3 u) / (1 + u), u = (e / 3 sigma)^2 (Huber). Errors are
    then larger than sigma before plain shapes, where they are alike everywhere: see `inflation`.
    """
    problem, seen, left = equations.problem, equations.seen, equations.left
    tracks, weight = problem.tracks, seen.weight
    u = (tracks.trust * left) ** 2 / problem.limit
    curved = float((weight * (1 - 3 * u) / (1 + u)).sum()) / max(float(weight.sum()), 1.0)
    less = 1 / max(curved, 0.1) ** 2
    rows, columns = (-(-n // CELLS[0]) for n in tracks.shape)
    down, across = ((tracks.y - tracks.corner[1]), (tracks.x - tracks.corner[0]))
    cell = (down // CELLS[0] * columns + across // CELLS[0]).astype(np.int64)
    told, own = [], []
    for v in inverse_of(equations, [*range(3 * ROWS, 3 * ROWS + 3), *range(3)]):
        score = problem.information * weight * left * equations.change(v)
        told.append(np.bincount(cell, score, rows * columns))
        own.append(v[1])
    parts, size = np.array(told), CELLS[1] // CELLS[0]
    wide = parts.reshape(6, rows, columns)
    wide = np.pad(wide, [(0, 0), (0, -rows % size), (0, -columns % size)])
    wide = wide.reshape(6, -(-rows // size), size, -(-columns // size), size).sum((2, 4))
    both = [part @ part.T for part in (parts, wide.reshape(6, -1))]
    larger = both[1] if np.trace(both[1]) > np.trace(both[0]) else both[0]
    prior = np.array(own)
    return less * larger + prior @ equations.known @ prior.T
