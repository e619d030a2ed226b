"""The photometric fit's equations: slopes against differences, pieces against the dense matrix."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxevent.egomotion.batch_fit import equations as fit
from jaxevent.egomotion.batch_fit.gauss_newton import with_first_rows
from jaxevent.egomotion.batch_fit.lattice import gather, laplacian, spline, weigh
from jaxevent.egomotion.batch_fit.path import ROWS, SEGMENTS, Path, Prior
from jaxevent.egomotion.batch_fit.tracks import Scene, Tracks, placed

pytestmark = pytest.mark.slow

F, HALF, NODE = 20.0, 0.15, 4
SHAPE, CORNER = (20, 24), (-12.0, -10.0)
PIXELS, EACH = 40, 5  # that see events, and how many each
UNKNOWNS = fit.FREE + 4  # of the path, the skew, the plane's normal
# Differences of 1e-6 tell slopes to rounding by that, some 1e-9.
STEP = 1e-6


def some_tracks() -> Tracks:
    rng = np.random.default_rng(0)
    pixel = np.repeat(rng.choice(16 * 12, PIXELS, replace=False), EACH)
    tau = np.sort(rng.uniform(-HALF, HALF, (PIXELS, EACH)), 1).ravel()
    p = rng.choice([-1.0, 1.0], (PIXELS, EACH))
    number = np.tile(np.arange(EACH) + 1.0, PIXELS)
    arrays = pixel % 16 - 7.5, pixel // 16 - 5.5, tau, np.cumsum(p, 1).ravel(), number, p.ravel()
    x, y, tau, level, number, p = (jnp.asarray(part) for part in arrays)
    return Tracks(
        x, y, tau, level, number, p, jnp.asarray(pixel, jnp.int32), jnp.asarray(F),
        jnp.asarray(HALF), SHAPE, CORNER, 16 * 12, NODE,
    )  # fmt: skip


def some_scene(tracks: Tracks, log_rho: np.ndarray) -> Scene:
    """A motion that changes, before some depths at nodes."""
    rng = np.random.default_rng(1)
    rows = 0.3 ** np.arange(ROWS)[:, None] / HALF ** np.arange(ROWS)[:, None]
    O, D = rng.normal(size=(2, ROWS, 3)) * rows * 0.3  # noqa: E741
    D[0] = np.array([0.5, -0.3, 0.6]) / np.linalg.norm([0.5, -0.3, 0.6])
    path = Path(*(jnp.asarray(part) for part in (O, D, log_rho)))
    return Scene(path, jnp.asarray(rng.normal(size=SHAPE)), jnp.asarray(0.05))


def smooth(tracks: Tracks) -> np.ndarray:
    """Log depths at nodes that bend."""
    i, j = np.meshgrid(*(np.arange(n) for n in tracks.nodes), indexing="ij")
    return -0.5 + 0.1 * np.sin(i + 0.7 * j).ravel()


def rays_of_nodes(tracks: Tracks) -> np.ndarray:
    x, y = tracks.places
    return np.stack([x / F, y / F, np.ones(len(x))], 1)


@jax.jit
def misfits_before_means(scene: Scene, tracks: Tracks) -> jax.Array:
    at = spline(*placed(scene.path, tracks), tracks.corner, tracks.shape)
    value = weigh(gather(scene.map, at, tracks.shape), at.share)
    return value - tracks.level - scene.skew * tracks.number


@jax.jit
def look_and_linearise(problem: fit.Problem, scene: Scene) -> tuple[fit.Seen, fit.Equations]:
    seen = fit.look(problem, scene, problem.tracks.on)
    return seen, fit.linearise(problem, seen, jnp.asarray(False))


@functools.cache
def linearised(normal: tuple[float, float, float] | None = None) -> tuple[fit.Seen, fit.Equations]:
    """Before depths that bend, or a plane."""
    tracks, plane = some_tracks(), normal is not None
    log_rho = np.log(rays_of_nodes(tracks) @ normal) if plane else smooth(tracks)
    numbers = 1.0, 1.0, 0.3, 0.7, np.full((SEGMENTS, 3), 0.2), 2.0, 0.8, 0.05, 10.0
    prior = Prior(*(jnp.asarray(number) for number in numbers))
    problem = fit.Problem(tracks, prior, jnp.asarray(0.7), jnp.asarray(plane), jnp.asarray(0.5))
    seen, equations = look_and_linearise(problem, some_scene(tracks, log_rho))
    assert (seen.on == 1).all()
    return seen, equations


@jax.jit
def moved(scene: Scene, equations: fit.Equations, v: tuple) -> Scene:
    """The scene after a change of the unknowns, the plane's left out."""
    image, t, q = v
    rows = (equations.now + t)[: fit.FREE] * equations.unit
    path = with_first_rows(scene.path, rows, ROWS)
    path = Path(path.O, path.D, path.log_rho + q)
    return Scene(path, scene.map + image, scene.skew + t[fit.FREE])


def slopes(function, directions: np.ndarray) -> np.ndarray:
    """Of a function of a change, along each of some directions: central differences."""
    steps = STEP * directions
    both = [np.asarray(function(step)) - np.asarray(function(-step)) for step in steps]
    return np.array(both) / (2 * STEP)


def some_directions(size: int) -> np.ndarray:
    """Some changes of the map at random; each other unknown alone, but for the plane's."""
    n = SHAPE[0] * SHAPE[1]
    maps = np.zeros((3, size))
    maps[:, :n] = np.random.default_rng(2).normal(size=(3, n))
    alone = np.delete(np.eye(size)[n:], np.arange(fit.FREE + 1, UNKNOWNS), 0)
    return np.concatenate([maps, alone])


def test_misfits_change_as_linearised():
    """By every row of the path, the skew, every depth, and some changes of the map."""
    seen, equations = linearised()
    tracks = equations.problem.tracks
    flat, apart = ravel_pytree(equations.gradient)
    directions = some_directions(len(flat))
    found = jax.vmap(lambda v: equations.jacobian.of(apart(v)))(jnp.asarray(directions))
    expected = slopes(
        lambda v: misfits_before_means(moved(seen.scene, equations, apart(v)), tracks), directions
    )
    assert (abs(expected).max(1) > 1e-3).sum() > len(expected) - 15  # some nodes see no events
    np.testing.assert_allclose(found, expected, atol=1e-7)


# Log depths of tilts of a plane that faces the camera are linear between nodes; others' nearly, and
# there the factors of the plane's normal are not all the same.
@pytest.mark.parametrize("normal, near", [((0.0, 0.0, 0.6), 1e-7), ((0.2, -0.1, 0.6), 0.02)])
def test_misfits_change_with_a_plane_as_linearised(normal, near):
    seen, equations = linearised(normal)
    tracks, scene = equations.problem.tracks, seen.scene
    rays, rho = rays_of_nodes(tracks), np.exp(scene.path.log_rho)
    assert np.ptp(rho) > 0.2 or near < 1e-6

    def tilted(change: np.ndarray) -> jax.Array:
        level = jnp.asarray(np.log(rho + np.median(rho) * rays @ change))
        path = Path(scene.path.O, scene.path.D, level)
        return misfits_before_means(scene._replace(path=path), tracks)

    found, expected = equations.jacobian.by_path[fit.FREE + 1 :], slopes(tilted, np.eye(3))
    np.testing.assert_allclose(found, expected, atol=near * abs(expected).max())
    assert (equations.jacobian.by_depth == 0).all()


def test_the_gradient_is_that_of_what_is_minimised():
    """Of misfits less their means, the weights held, and the priors."""
    seen, equations = linearised()
    problem, scene = equations.problem, seen.scene
    prior, (a, b) = problem.prior, problem.pairs
    flat, apart = ravel_pytree(equations.gradient)

    @jax.jit
    def total(scene: Scene, e: jax.Array, t: jax.Array) -> jax.Array:
        left = equations.jacobian.subtract_mean(e)
        differences = scene.path.log_rho[a] - scene.path.log_rho[b]
        bonds = prior.bond * fit.BEND**2 * jnp.log1p((differences / fit.BEND) ** 2).sum()
        maps = prior.flat * (scene.map * laplacian(scene.map)).sum() + 1e-5 * (scene.map**2).sum()
        pull = problem.pull(equations.now + t, equations.unit)
        return ((equations.information * left**2).sum() + bonds + maps) / 2 + pull

    def cost(v: np.ndarray) -> jax.Array:
        new = moved(scene, equations, apart(v))
        return total(new, misfits_before_means(new, problem.tracks), apart(v)[1])

    directions = some_directions(len(flat))
    found, expected = directions @ np.asarray(flat), slopes(cost, directions)
    np.testing.assert_allclose(found, expected, atol=1e-6 * abs(expected).max())
    assert abs(expected[-len(scene.path.log_rho) :]).max() > 1e-3


def test_the_matrix_is_that_of_least_squares():
    """J' W J of misfits less their means; what is kept of it are its blocks."""
    _, equations = linearised()
    flat, apart = ravel_pytree(equations.gradient)
    eye, undamped = jnp.eye(len(flat)), jnp.zeros(())
    columns = jax.vmap(lambda v: ravel_pytree(equations.times_H(undamped, apart(v)))[0])(eye)
    J = jax.vmap(lambda v: equations.jacobian.subtract_mean(equations.jacobian.of(apart(v))))(eye)
    n, m = SHAPE[0] * SHAPE[1], SHAPE[0] * SHAPE[1] + UNKNOWNS
    H = np.asarray(columns)
    priors = H - np.asarray((J * equations.information) @ J.T)
    held = np.asarray(equations.known + equations.held)
    np.testing.assert_allclose(priors[n:m, n:m], held, atol=1e-6)
    np.testing.assert_allclose(priors[m:, n:m], 0, atol=1e-9)
    np.testing.assert_allclose(H, H.T, atol=1e-9 * abs(H).max())
    np.testing.assert_allclose(np.asarray(equations.upper), H[n:m, n:m], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(np.asarray(equations.mixed), H[m:, n:m], atol=1e-9)


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_the_preconditioner_is_exact_where_the_matrix_is_of_blocks(damping):
    """A diagonal for the map, and path with depths that do not pull on each other."""
    _, equations = linearised()
    flat, apart = ravel_pytree(equations.gradient)
    ease = fit.precondition(equations, jnp.asarray(damping))
    eased = jax.vmap(lambda v: ravel_pytree(ease(apart(v)))[0])(jnp.eye(len(flat)))
    stiff = (damping + 1e-3) * np.diag(equations.stiff)
    lumped = (1 + damping) * np.diag(equations.lumped)
    rest = np.block([[equations.upper + stiff, equations.mixed.T], [equations.mixed, lumped]])
    n = SHAPE[0] * SHAPE[1]
    map_ = (1 + damping) * np.asarray(equations.diagonal).ravel()
    np.testing.assert_allclose(eased[:n, :n], np.diag(1 / map_), rtol=1e-12)
    np.testing.assert_array_equal(eased[:n, n:], 0)
    np.testing.assert_array_equal(eased[n:, :n], 0)
    np.testing.assert_allclose(eased[n:, n:] @ rest, np.eye(len(rest)), atol=1e-7)
