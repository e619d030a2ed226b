"""Normal equations: derivatives against differences, blocks against the dense matrix."""

import functools
import math

import numpy as np
import pytest
import scipy.linalg
import scipy.ndimage

from jaxevent.egomotion.bundle import cg
from jaxevent.egomotion.bundle import normal_equations as fit
from jaxevent.egomotion.bundle.residuals import PixelSeries, Scene, sample_map, subtract_mean
from jaxevent.egomotion.bundle.warp import (
    N_COEFFICIENT_ROWS,
    N_WINDOW_SEGMENTS,
    Path,
    Prior,
    replace_rows,
)

pytestmark = pytest.mark.slow

F, HALF, NODE = 20.0, 0.15, 4
SHAPE, CORNER = (20, 24), (-12.0, -10.0)
PIXELS, EACH = 40, 5  # that see events, and how many each
FRAME = 25  # rows of them that are pixels of a frame
# Differences of 1e-6 tell slopes to rounding by that, some 1e-9.
STEP = 1e-6


def some_tracks() -> PixelSeries:
    """Events of pixels, and the pixels of a frame, which count less."""
    rng = np.random.default_rng(0)
    pixel = np.repeat(rng.choice(16 * 12, PIXELS, replace=False), EACH)
    tau = np.sort(rng.uniform(-HALF, HALF, (PIXELS, EACH)), 1).ravel()
    p = rng.choice([-1.0, 1.0], (PIXELS, EACH))
    number = np.tile(np.arange(EACH) + 1.0, PIXELS)
    begin, trust, events = EACH * np.arange(PIXELS + 1), np.ones(len(pixel)), len(pixel) - FRAME
    level = np.cumsum(p, 1).ravel()
    level[events:] = rng.normal(size=FRAME)
    begin = np.append(begin[begin <= events], len(pixel))
    number[events:] = p.reshape(-1)[events:] = 0
    tau[events:], trust[events:] = tau[events], 0.6
    return PixelSeries(
        pixel % 16 - 7.5, pixel // 16 - 5.5, tau, level, number, p.ravel(),
        trust, events, begin, F, HALF, SHAPE, CORNER, NODE,
    )  # fmt: skip


def some_scene(series: PixelSeries, log_rho: np.ndarray) -> Scene:
    """A motion that changes, before some depths at nodes."""
    rng = np.random.default_rng(1)
    rows = (
        0.3 ** np.arange(N_COEFFICIENT_ROWS)[:, None]
        / HALF ** np.arange(N_COEFFICIENT_ROWS)[:, None]
    )
    O, D = rng.normal(size=(2, N_COEFFICIENT_ROWS, 3)) * rows * 0.3  # noqa: E741
    D[0] = np.array([0.5, -0.3, 0.6]) / np.linalg.norm([0.5, -0.3, 0.6])
    return Scene(Path(O, D, log_rho), rng.normal(size=SHAPE), 0.05)


def smooth(series: PixelSeries) -> np.ndarray:
    """Log depths at nodes that bend."""
    i, j = np.meshgrid(*(np.arange(n) for n in series.nodes), indexing="ij")
    return -0.5 + 0.1 * np.sin(i + 0.7 * j).ravel()


def rays_of_nodes(series: PixelSeries) -> np.ndarray:
    x, y = series.node_positions
    return np.stack([x / F, y / F, np.ones(len(x))], 1)


def raw_residuals(scene: Scene, series: PixelSeries) -> np.ndarray:
    return sample_map(scene, series).value - series.level - scene.skew * series.count


@functools.cache
def linearised(
    normal: tuple[float, float, float] | None = None,
) -> tuple[fit.Evaluation, fit.NormalEquations]:
    """Before depths that bend, or a plane."""
    series, plane = some_tracks(), normal is not None
    log_rho = np.log(rays_of_nodes(series) @ normal) if plane else smooth(series)
    gyro = np.full((N_WINDOW_SEGMENTS, 3), 0.2)
    prior = Prior(1.0, 1.0, 0.3, gyro, 2.0, 0.8, 0.05, 10.0)
    problem = fit.Problem(series, prior, 0.7, plane, 0.5)
    seen = fit.evaluate(problem, some_scene(series, log_rho), np.ones(PIXELS * EACH))
    assert (seen.samples.inside == 1).all()
    return seen, fit.linearise(problem, seen, map_only=False)


def size_of(equations: fit.NormalEquations) -> tuple[int, int, int]:
    """How many numbers of the map, of the path and the like, and depths are unknown."""
    series = equations.problem.series
    free = fit.N_PATH_UNKNOWNS + len(equations.jacobian.more)
    return SHAPE[0] * SHAPE[1], free, series.nodes[0] * series.nodes[1]


def joined(parts: fit.Unknowns, n: int) -> np.ndarray:
    """Unknowns in one, those of the path that are free."""
    return np.concatenate([parts[0].ravel(), parts[1][:n], parts[2].ravel()])


def apart(flat: np.ndarray, equations: fit.NormalEquations) -> fit.Unknowns:
    """The same, the other way; those that are not free 0."""
    n, m, _ = size_of(equations)
    path = np.append(flat[n : n + m], np.zeros(fit.N_PATH_UNKNOWNS + 4 - m))
    return flat[:n].reshape(SHAPE), path, flat[n + m :]


def moved(scene: Scene, equations: fit.NormalEquations, v: fit.Unknowns) -> Scene:
    """The scene after a change of the unknowns, the plane's left out."""
    image, t, q = v
    path = replace_rows(scene.path, (equations.t + t)[: fit.N_PATH_UNKNOWNS] * equations.unit)
    path = Path(path.O, path.D, path.log_rho + q)
    return Scene(path, scene.map + image, scene.skew + t[fit.N_PATH_UNKNOWNS])


def slopes(function, directions: np.ndarray) -> np.ndarray:
    """Of a function of a change, along each of some directions: central differences."""
    steps = STEP * directions
    both = [np.asarray(function(step)) - np.asarray(function(-step)) for step in steps]
    return np.array(both) / (2 * STEP)


def dense_jacobian(equations: fit.NormalEquations) -> np.ndarray:
    """J' of residuals before their means are taken."""
    eye = np.eye(sum(size_of(equations)))
    return np.array([equations.jacobian_product(apart(v, equations)) for v in eye])


def some_directions(equations: fit.NormalEquations) -> np.ndarray:
    """Some changes of the map at random; each other unknown alone."""
    n, size = size_of(equations)[0], sum(size_of(equations))
    maps = np.zeros((3, size))
    maps[:, :n] = np.random.default_rng(2).normal(size=(3, n))
    return np.concatenate([maps, np.eye(size)[n:]])


def test_jacobian_of_residuals():
    """By every row of the path, the skew, every depth, and some changes of the map."""
    seen, equations = linearised()
    series, directions = equations.problem.series, some_directions(equations)
    found = np.array([equations.jacobian_product(apart(v, equations)) for v in directions])
    expected = slopes(
        lambda v: raw_residuals(moved(seen.scene, equations, apart(v, equations)), series),
        directions,
    )
    assert (abs(expected).max(1) > 1e-3).sum() > len(expected) - 15  # some nodes see no events
    np.testing.assert_allclose(found, expected, atol=1e-7)


@pytest.mark.parametrize("skew, known", [(5.0, 0.2), (-5.0, 0.0), (0.1, 0.1)])
def test_the_skew_stays_near_that_of_counts(skew, known):
    """Within two deviations, here 0.1, of what counts tell, also while a fit extrapolates."""
    seen, equations = linearised()
    prior = equations.problem.prior._replace(skew=0.1, skew_weight=1 / 0.05**2)
    problem = equations.problem._replace(prior=prior)
    scene = seen.scene._replace(skew=skew)
    assert fit.evaluate(problem, scene, seen.weight).scene.skew == pytest.approx(known)


# Log depths of tilts of a plane that faces the camera are linear between nodes; others' nearly, and
# there the factors of the plane's normal are not all the same.
@pytest.mark.parametrize("normal, near", [((0.0, 0.0, 0.6), 1e-7), ((0.2, -0.1, 0.6), 0.02)])
def test_jacobian_with_a_plane(normal, near):
    seen, equations = linearised(normal)
    series, scene = equations.problem.series, seen.scene
    rays, rho = rays_of_nodes(series), np.exp(scene.path.log_rho)
    assert np.ptp(rho) > 0.2 or near < 1e-6

    def tilted(change: np.ndarray) -> np.ndarray:
        level = np.log(rho + np.median(rho) * rays @ change)
        path = Path(scene.path.O, scene.path.D, level)
        return raw_residuals(scene._replace(path=path), series)

    found, expected = equations.jacobian.more[1:], slopes(tilted, np.eye(3))
    np.testing.assert_allclose(found, expected, atol=near * abs(expected).max())
    assert (equations.jacobian.by_depth == 0).all()


def test_gradient_of_the_objective():
    """Of residuals less their means, the weights held, and the priors."""
    seen, equations = linearised()
    problem, scene = equations.problem, seen.scene
    prior, (rows, columns) = problem.prior, problem.series.nodes

    def cost(v: np.ndarray) -> float:
        parts = apart(v, equations)
        new = moved(scene, equations, parts)
        left = raw_residuals(new, problem.series)
        subtract_mean(left, seen.weight, problem.series.begin)
        depth = new.path.log_rho.reshape(rows, columns)
        bonds = maps = 0.0
        for axis in (0, 1):
            u = (np.diff(depth, axis=axis) / fit.NODE_EDGE_LOG_DEPTH) ** 2
            bonds += prior.bond * fit.NODE_EDGE_LOG_DEPTH**2 * np.log1p(u).sum()
            maps += prior.flat * (np.diff(new.map, axis=axis) ** 2).sum()
        maps += 1e-5 * (new.map**2).sum()
        t = equations.t + parts[1]
        known, side, constant = problem.path_prior(equations.unit)
        pull = t @ known @ t / 2 - side @ t + constant
        return (problem.information * (seen.weight * left**2).sum() + bonds + maps) / 2 + pull

    directions = some_directions(equations)
    flat = joined(fit.gradient(equations), size_of(equations)[1])
    found, expected = directions @ flat, slopes(cost, directions)
    np.testing.assert_allclose(found, expected, atol=1e-6 * abs(expected).max())
    assert abs(expected[-rows * columns :]).max() > 1e-3


def times(system: cg.System, v: fit.Unknowns) -> fit.Unknowns:
    """H v."""
    out, out_depth = np.empty(SHAPE), np.empty(system.depth_damping.shape)
    t = np.ascontiguousarray(v[1][: len(system.path_prior)])
    depth = np.ascontiguousarray(v[2]).reshape(system.depth_damping.shape)
    value, found = np.empty(PIXELS * EACH), np.empty_like(t)
    image = np.ascontiguousarray(v[0])
    result = cg.BlockVector(out, found, out_depth)
    cg.multiply(system, cg.BlockVector(image, t, depth), value, result)
    return result


@functools.cache
def matrix(damping: float) -> np.ndarray:
    _, equations = linearised()
    system = fit.damped_system(equations, damping)
    size = size_of(equations)
    eye = np.eye(sum(size))
    return np.array([joined(times(system, apart(v, equations)), size[1]) for v in eye]).T


def between_coarse(equations: fit.NormalEquations) -> np.ndarray:
    """The nodes' depths by those of coarse nodes, (nodes, coarse nodes)."""
    rows, columns = equations.problem.series.nodes
    wide = cg.coarse_shape(rows, columns)
    at = np.indices((rows, columns)).reshape(2, -1) / cg.NODES_PER_COARSE_NODE
    each = np.eye(math.prod(wide)).reshape(-1, *wide)
    return np.stack([scipy.ndimage.map_coordinates(one, at, order=1) for one in each], 1)


def test_the_matrix_is_that_of_least_squares():
    """J' W J of residuals less their means; what is kept of it are its blocks."""
    seen, equations = linearised()
    (n, free, _), begin = size_of(equations), equations.problem.series.begin
    m = n + free
    J = dense_jacobian(equations)
    for row in J:
        subtract_mean(row, seen.weight, begin)
    H = matrix(0.0)
    priors = H - equations.problem.information * (J * seen.weight) @ J.T
    held = (equations.path_prior + equations.regularisation)[:free, :free]
    np.testing.assert_allclose(priors[n:m, n:m], held, atol=1e-6)
    np.testing.assert_allclose(priors[m:, n:m], 0, atol=1e-9)
    np.testing.assert_allclose(H, H.T, atol=1e-9 * abs(H).max())
    upper = equations.path_block[:free, :free]
    np.testing.assert_allclose(upper, H[n:m, n:m], rtol=1e-9, atol=1e-6)
    P, of_events = between_coarse(equations), H - priors
    np.testing.assert_allclose(equations.coupling[:, :free], P.T @ H[m:, n:m], atol=1e-9)
    np.testing.assert_allclose(equations.coarse_block, P.T @ of_events[m:, m:] @ P, atol=1e-9)


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_the_preconditioner_is_exact_for_path_and_smooth_depths(damping):
    """Beside diagonals for map and depths, of these with all that a node pulls on."""
    _, equations = linearised()
    system, (n, free, nodes) = fit.damped_system(equations, damping), size_of(equations)
    eased = []
    for v in np.eye(free + nodes):
        depth = v[free:].reshape(system.depth_damping.shape)
        out = np.empty_like(depth)
        t = np.empty(free)
        cg.precondition_path_and_depths(system, v[:free].copy(), depth.copy(), t, out)
        eased.append(np.append(t, out))
    P = np.asarray(scipy.linalg.block_diag(np.eye(free), between_coarse(equations)))
    H = P.T @ matrix(damping)[n:, n:] @ P
    H += np.diag(1e-5 * np.diag(H) + 1e-3)
    single = np.append(np.zeros(free), 1 / ((1 + damping) * equations.lumped))
    expected = np.diag(single) + P @ np.linalg.solve(H, P.T)
    np.testing.assert_allclose(eased, expected, atol=1e-9 * abs(expected).max())
    map_ = (1 + damping) * equations.diagonal
    np.testing.assert_allclose(system.preconditioner_map, 1 / map_, rtol=1e-12)


def test_conjugate_gradients_solve():
    """What they leave is as small as was asked for; with more steps it is nothing."""
    _, equations = linearised()
    size, rng = size_of(equations), np.random.default_rng(4)
    side = rng.normal(size=sum(size))
    system, H = fit.damped_system(equations, 0.5), matrix(0.5)
    depth = side[size[0] + size[1] :].reshape(system.depth_damping.shape)
    path = side[size[0] : size[0] + size[1]]
    given = cg.BlockVector(side[: size[0]].reshape(SHAPE), path, depth)
    exact, steps = np.linalg.solve(H, side), []
    for enough, near in ((0.1, 0.3), (1e-3, 3e-3), (1e-9, 1e-7)):
        found, done = cg.conjugate_gradients(system, given, 2000, enough)
        off = joined(found, size[1]) - exact
        assert np.sqrt(off @ H @ off) < near * np.sqrt(exact @ side)
        steps.append(done)
    assert 0 < steps[0] < steps[1] < steps[2] < 30  # 22; steepest descent needs 45
    assert cg.conjugate_gradients(system, given, 5, 0.0)[1] == 5


@pytest.mark.parametrize("wrong", [None, np.nan, 3.0])
def test_several_sides_are_solved_together(monkeypatch, wrong):
    """Against the dense matrix; one side twice is no harm. Else, if numbers do not hold, apart."""
    _, equations = linearised()
    if wrong:
        inner, rng = cg.add_inner_products, np.random.default_rng(3)

        def roughly(a, b, out):
            inner(a, b, out)
            out *= 1 + wrong * rng.normal(size=out.shape)

        monkeypatch.setattr(cg, "add_inner_products", roughly)
    size, rows = size_of(equations), [0, 4, 15, 4]
    found = np.array([joined(v, size[1]) for v in fit.inverse_columns(equations, rows)]).T
    sides = np.zeros((sum(size), len(rows)))
    sides[size[0] + np.array(rows), range(len(rows))] = equations.unit[rows]
    exact = np.linalg.solve(matrix(0.0), sides)
    np.testing.assert_allclose(found[size[0] :], exact[size[0] :], atol=0.02 * abs(exact).max())
    own = (sides * found).sum(0) / (sides * exact).sum(0)
    assert (own < 1 + 1e-6).all() and (own > 0.95).all()
