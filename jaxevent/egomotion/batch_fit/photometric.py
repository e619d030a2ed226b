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
system a step, solved by conjugate gradients, without the matrix: the map's diagonal, and path with
lumped depths exactly, precondition it. Steps extrapolate (Nesterov): reweighting alone is slow. A
step that costs more is taken back and damped (Levenberg & Marquardt): beside sharp edges misfits
are linear within a fraction of a pixel only, and the cost would grow.
Where an outline passes before another, their crossing moves as neither and the levels beside them
change, so that events there mislead. Single misfits do not stand out there, but all of them are
larger: where misfits are large on average, within `PLACE`, all events count less.
Nothing is gained by squeezing events together, which biases contrast, and no event is compared that
tells only the gradient along the flow. An ON threshold C (1 + skew) and an OFF one of C (1 - skew)
are allowed for.

Depth is interpolated between nodes 4 px apart, and an event lies on the nearest surface that its
ray meets: what is behind is hidden. `depths` gives every node the depth at which the events around
it have the highest contrast, the path held fixed: beside an edge of depth that is the nearer
surface's, whose outline made the events. Adjusted from smooth depths instead, the path ends beside
the truth. Or all depths are those of a plane.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxevent.egomotion.batch_fit.equations import (
    FREE,
    Equations,
    Problem,
    Seen,
    linearise,
    look,
    solve,
)
from jaxevent.egomotion.batch_fit.gauss_newton import (
    DEEPEST,
    Acceptance,
    accept,
    limit_step,
    with_first_rows,
)
from jaxevent.egomotion.batch_fit.path import LEAST, ROWS, Path, Prior, normalised, rays_of
from jaxevent.egomotion.batch_fit.tracks import Scene, Tracks, subtract_mean, totals

CELLS = 24, 48  # px, whose errors are alike


class Report(NamedTuple):
    """Of a fit's end: the noise (C), the robust cost per event (C^2), the share of inliers."""

    noise: Array  # 1.48 times the median of the absolute misfits
    cost: Array
    inliers: Array


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
    # Arguments of one kind, so that one program serves all calls with as many events.
    return _adjust(tracks, scene, prior, float(sigma), int(settle), int(steps), bool(plane))


class _Walk(NamedTuple):
    """Where steps of a fit have come to."""

    number: Array
    scene: Scene  # that is tried next
    last: Scene  # that it came from
    kept: Seen  # the best
    acceptance: Acceptance


@jax.jit
def _adjust(
    tracks: Tracks,
    scene: Scene,
    prior: Prior,
    sigma: Array,
    settle: Array,
    steps: Array,
    plane: Array,
) -> tuple[Scene, Report]:
    problem, nothing = begin(tracks, scene, prior, sigma, plane)

    def go(walk: _Walk) -> _Walk:
        n, kept = walk.number, walk.kept
        ahead = extrapolate(walk.scene, walk.last, walk.acceptance.ahead, plane)
        tried = look(problem, ahead, kept.weight)
        better = (tried.energy <= kept.energy) | (n <= settle)
        gain = jnp.where(n > settle, kept.energy - tried.energy, jnp.inf)
        last = jax.tree.map(lambda p, q: jnp.where(better, p, q), walk.scene, kept.scene)
        kept = jax.tree.map(lambda p, q: jnp.where(better, p, q), tried, kept)
        acceptance = accept(walk.acceptance, better, gain, kept.energy, n >= settle)
        goes_on = (n < steps) & acceptance.goes_on
        scene = lax.cond(
            goes_on,
            lambda *now: step(problem, *now),
            lambda *_: walk.scene,
            kept,
            acceptance.damping,
            n < settle,
        )
        return _Walk(n + 1, scene, last, kept, acceptance)

    def unfinished(walk: _Walk) -> Array:
        return (walk.number <= steps) & walk.acceptance.goes_on

    zero = jnp.zeros((), tracks.x.dtype)
    walk = _Walk(jnp.zeros((), int), scene, scene, nothing, Acceptance(zero, zero))
    kept = lax.while_loop(unfinished, go, walk).kept
    return kept.scene, report(problem, kept)


def begin(
    tracks: Tracks, scene: Scene, prior: Prior, sigma: Array, plane: Array
) -> tuple[Problem, Seen]:
    """What steps have in common, and what is kept before the first one: nothing."""
    real = tracks.x.dtype
    sigma, plane = jnp.asarray(sigma, real), jnp.asarray(plane)
    zero, none = jnp.zeros((), real), jnp.zeros_like(tracks.x)
    problem = Problem(tracks, prior, sigma, plane, zero + jnp.inf)
    usual = jnp.maximum(look(problem, scene, tracks.on).cost, 1e-3 * problem.limit)
    nothing = Seen(scene, none, none, none, none, tracks.on, zero + jnp.inf, zero)
    return problem._replace(usual=usual), nothing


def extrapolate(scene: Scene, last: Scene, ahead: Array, plane: Array) -> Scene:
    """The scene so many times its last step ahead (Nesterov).

    Only inverse depths themselves, extrapolated, are a plane's again.
    """
    near, nearer = (jnp.exp(one.path.log_rho) for one in (last, scene))
    tried = jax.tree.map(lambda new, old: new + ahead * (new - old), scene, last)
    level = jnp.maximum(nearer + ahead * (nearer - near), LEAST * jnp.median(nearer))
    level = jnp.where(plane, jnp.log(level), tried.path.log_rho)
    return Scene(Path(tried.path.O, tried.path.D, level), *tried[1:])


def step(problem: Problem, kept: Seen, damping: Array, settling: Array) -> Scene:
    """The scene after a damped step of Gauss and Newton from what is kept."""
    tracks, scene = problem.tracks, kept.scene
    equations = linearise(problem, kept, settling)
    image, t, q = solve(equations, damping, jax.tree.map(jnp.negative, equations.gradient))
    sound = jnp.isfinite(t).all() & jnp.isfinite(q).all() & jnp.isfinite(image).all()
    image, t, q = (jnp.where(sound, part, 0) for part in (image, t, q))
    moved = jnp.where(settling, 0, limit_step(t[:FREE]))
    rows = (equations.now + moved * t)[:FREE] * equations.unit
    path = with_first_rows(scene.path, rows, ROWS)
    nodes = path.log_rho + jnp.clip(moved * q, -DEEPEST, DEEPEST)
    level = tilt(path, tracks, moved, t[FREE + 1 :])
    path = normalised(Path(path.O, path.D, jnp.where(problem.plane, level, nodes)))
    return Scene(path, scene.map + image, scene.skew + moved * t[FREE])


def tilt(path: Path, tracks: Tracks, moved: Array, change: Array) -> Array:
    """Log depths at nodes of their plane after its normal has changed.

    The plane is that of the nodes whose inverse depth was not too small for one.
    """
    f, real = tracks.f, tracks.x.dtype
    usual, level = jnp.exp(jnp.median(path.log_rho)), jnp.exp(path.log_rho)
    rays = jnp.asarray(rays_of(*tracks.places, 1.0), real) / jnp.stack([f, f, jnp.ones_like(f)])
    told = jnp.where(level > 1.5 * LEAST * usual, rays.T, 0)
    normal = jnp.linalg.solve(told @ rays + 1e-6 * jnp.eye(3, dtype=real), told @ level)
    level = rays @ (normal + moved * usual * change)
    return jnp.log(jnp.maximum(level, LEAST * usual))


def report(problem: Problem, kept: Seen) -> Report:
    """What a fit tells of its end."""
    weight, on = kept.weight, kept.on
    tracks = problem.tracks
    left = jnp.abs(subtract_mean(kept.e, weight, totals(weight, tracks), tracks))
    number = jnp.maximum(on.sum(), 1)
    middle = jnp.sort(jnp.where(on > 0, left, jnp.inf))[(number / 2).astype(jnp.int32)]
    noise = jnp.where(jnp.isfinite(middle), 1.48 * middle, 0)
    inliers = (on / (1 + left**2 / problem.limit) ** 2).sum() / number
    return Report(noise, kept.cost, inliers)


def compute_covariance(
    tracks: Tracks, scene: Scene, prior: Prior, *, sigma: float | int, plane: bool = False
) -> Float[Array, "6 6"]:
    """The covariance (6, 6) of C1 and O0 of a scene that was fitted with these settings."""
    return _compute_covariance(tracks, scene, prior, float(sigma), bool(plane))


@jax.jit
def _compute_covariance(
    tracks: Tracks, scene: Scene, prior: Prior, sigma: Array, plane: Array
) -> Array:
    problem, nothing = begin(tracks, scene, prior, sigma, plane)
    seen = look(problem, scene, nothing.weight)
    return spread(linearise(problem, seen, jnp.asarray(False)), seen)


def spread(equations: Equations, seen: Seen) -> Float[Array, "6 6"]:
    """H^-1 (sum_c g_c g_c' + the priors') H^-1, with c cells, within which errors are alike.

    Of cells of 24 and of 48 px those that tell more.

    H counts the weights w of misfits e, the curvature of their robust cost is less: the mean of
    d(w e)/de = w (1 - 3 u) / (1 + u), u = (e / 3 sigma)^2 (Huber). Errors are
    then larger than sigma before plain shapes, where they are alike everywhere: see `inflation`.
    """
    tracks, weight, left = equations.problem.tracks, seen.weight, equations.left
    u = left**2 / equations.problem.limit
    curved = (weight * (1 - 3 * u) / (1 + u)).sum() / jnp.maximum(weight.sum(), 1)
    less = 1 / jnp.maximum(curved, 0.1) ** 2
    rows, columns = (-(-n // CELLS[0]) for n in tracks.shape)
    across = (tracks.x - tracks.corner[0]) // CELLS[0]
    cell = ((tracks.y - tracks.corner[1]) // CELLS[0] * columns + across).astype(jnp.int32)
    chosen = jnp.concatenate([jnp.arange(3 * ROWS, 3 * ROWS + 3), jnp.arange(3)])
    zero = jax.tree.map(jnp.zeros_like, equations.gradient)
    undamped = jnp.zeros((), left.dtype)

    def column(i: Array) -> tuple[Array, Array]:
        v = solve(equations, undamped, (zero[0], zero[1].at[i].set(1), zero[2]))
        score = equations.information * left * equations.jacobian.of(v)
        told = jnp.zeros(rows * columns, left.dtype).at[cell].add(score)
        return told * equations.unit[i], v[1] * equations.unit[i]

    told, own = lax.map(column, chosen)
    size = CELLS[1] // CELLS[0]
    wide = told.reshape(6, rows, columns)
    wide = jnp.pad(wide, [(0, 0), (0, -rows % size), (0, -columns % size)])
    wide = wide.reshape(6, -(-rows // size), size, -(-columns // size), size).sum((2, 4))
    both = [part @ part.T for part in (told, wide.reshape(6, -1))]
    larger = jnp.where(jnp.trace(both[1]) > jnp.trace(both[0]), both[1], both[0])
    return less * larger + own @ equations.known @ own.T
