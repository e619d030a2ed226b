"""General motion of a window: the warp against rigid geometry, and scenes of points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
import scipy.sparse.linalg
from scipy.spatial.transform import Rotation

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, geometry
from jaxevent.egomotion.truth import Twists
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

WIDTH, HEIGHT, F = 96, 72, 80.0
CAMERA = PinholeCamera(F, F, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
T, OMEGA = np.array([0.5, -0.3, 0.6]), np.array([0.3, -0.5, 0.4])
SECONDS = 0.3


@functools.cache
def seen() -> Recording:
    """A roof of two textured planes, 1 to 2 m away: events where log intensity passes levels.

    The poses are exp(t (T, Omega)) by the closed form, t from the middle.
    """
    rng = np.random.default_rng(0)
    wave = 2 * np.pi * rng.uniform(2, 9, (20, 1)) * rng.normal(size=(20, 2)) / 1.5
    phase = rng.uniform(0, 2 * np.pi, 20)
    y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    rays = np.stack([(x - CAMERA.cx) / F, (y - CAMERA.cy) / F, np.ones(len(x))], 1)
    planes = np.array([[-0.5, 0.1, 1], [0.6, 0.3, 1]]), np.array([1.6, 1.5])

    def seen_at(pose: np.ndarray) -> np.ndarray:
        R, C = pose[:3, :3], pose[:3, 3]
        depth = ((planes[1] - planes[0] @ C) / (rays @ R.T @ planes[0].T)).min(1)
        P = C + depth[:, None] * (rays @ R.T)
        return 0.17 * np.sin(P[:, :2] @ wave.T + phase).sum(1)

    steps = np.linspace(-SECONDS / 2, SECONDS / 2, 151)
    poses = np.asarray(geometry.twist_exp(steps[:, None] * np.r_[T, OMEGA]))
    level, rows = None, []
    C = 0.25
    for t, pose in zip(steps, poses, strict=True):
        new = seen_at(pose)
        if level is None:
            level, before = new + C * rng.uniform(-0.5, 0.5, len(new)), new
            continue
        while True:
            sign = np.sign(new - level)
            crossed = np.flatnonzero(np.abs(new - level) >= C)
            if not len(crossed):
                break
            level[crossed] += C * sign[crossed]
            share = (level - before)[crossed] / (new - before)[crossed]
            when = t - (1 - share) * (steps[1] - steps[0]) + SECONDS / 2
            rows.append(np.stack([1e6 * when, x[crossed], y[crossed], sign[crossed] > 0], 1))
        before = new
    table = np.concatenate(rows)
    t, x, y, p = table[np.argsort(table[:, 0], kind="stable")].T
    events = Events(
        np.rint(t).astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(bool)
    )
    return Recording("roof", WIDTH, HEIGHT, events, camera=CAMERA)


GIVEN = {"events": 8192, "fewest": 500, "starts": 3, "rivals": 1, "flow_max": 120.0, "cell": 16}
PARAMS = batch.Params.of(GIVEN)


def test_the_warp_is_the_rigid_scene():
    """Points seen by a moving camera go where the camera at the reference time sees them."""
    rng = np.random.default_rng(1)
    O = rng.normal(size=(3, 3)) * [[1.0], [4], [20]]  # noqa: E741
    D = rng.normal(size=(3, 3))
    path = batch.Path(jnp.asarray(O), jnp.asarray(D), jnp.zeros(1))
    C = np.asarray(path.coefficients()[1])
    np.testing.assert_allclose(C[1], D[1] + np.cross(O[0], D[0]))
    tau = rng.uniform(-0.15, 0.15, 50)
    powers = np.stack([tau, tau**2 / 2, tau**3 / 6], 1)
    P = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], 1)
    P *= rng.uniform(2, 5, (50, 1))
    R = Rotation.from_rotvec(powers @ O)
    local = R.apply(P - powers @ C, inverse=True)
    seen = F * local[:, :2] / local[:, 2:]
    rho = 1 / P[:, 2]
    x, y = batch.warp(path, jnp.asarray(F), *(jnp.asarray(v) for v in (*seen.T, tau, rho)))
    exact = F * P[:, :2] / P[:, 2:]
    np.testing.assert_allclose(np.stack([x, y], 1), exact, atol=2e-4)


def test_twists_of_a_path():
    """Against differences of its poses; a constant twist stays one."""
    path = batch.Path(
        jnp.zeros((3, 3)).at[0].set(OMEGA), jnp.zeros((3, 3)).at[0].set(T), jnp.zeros(1)
    )
    heading, Omega = path.twist(np.array([-0.1, 0.0, 0.1]))
    np.testing.assert_allclose(Omega, np.broadcast_to(OMEGA, (3, 3)))
    np.testing.assert_allclose(heading, np.broadcast_to(T / np.linalg.norm(T), (3, 3)), atol=2e-3)
    later = batch.advanced(path, 0.05)
    np.testing.assert_allclose(later.D[0], T / np.linalg.norm(T), atol=1e-3)


@functools.cache
def fitted() -> tuple[batch.Windows, batch.Fit]:
    windows = batch.Windows(seen(), PARAMS, CAMERA)
    fit = windows.fit(150_000, windows.starts(150_000))
    assert fit is not None
    return windows, fit


def test_the_motion_of_a_window_is_found():
    """As far as 96 x 72 pixels tell it: a heading beside a turn, and a turn beside a heading."""
    _, fit = fitted()
    heading, Omega = (part[0] for part in fit.path.twist(0.0))
    assert np.degrees(np.arccos(heading @ T / np.linalg.norm(T))) < 15
    assert np.linalg.norm(Omega - OMEGA) < 0.35 * np.linalg.norm(OMEGA)
    assert fit.agreement > 0.5 and np.isfinite(fit.covariance).all()
    assert (np.linalg.eigvalsh(fit.covariance) > -1e-12).all()


def scene_of(fit: batch.Fit) -> batch.Scene:
    return batch.Scene(fit.path, jnp.asarray(fit.map), jnp.zeros(()))


def test_tracks_are_the_events_of_pixels():
    windows, _ = fitted()
    tracks = windows.tracks(150_000, 0.15, 3000)
    events, n = seen().events, int(tracks.on.sum())
    assert 2000 < n <= 3000
    pixel, level, number = (np.asarray(a)[:n] for a in (tracks.pixel, tracks.level, tracks.number))
    where = events.y.astype(int) * WIDTH + events.x
    for one in np.unique(pixel)[::20]:
        at = np.flatnonzero(where == one)
        np.testing.assert_array_equal(level[pixel == one], np.cumsum(2.0 * events.p[at] - 1))
        np.testing.assert_array_equal(number[pixel == one], np.arange(len(at)) + 1)
        np.testing.assert_allclose(
            np.asarray(tracks.tau)[:n][pixel == one], (events.t[at] - 150_000) * 1e-6, atol=1e-12
        )


def true_path(log_rho: np.ndarray) -> batch.Path:
    O, D = np.zeros((batch.ROWS, 3)), np.zeros((batch.ROWS, 3))  # noqa: E741
    O[0], D[0] = OMEGA, T / np.linalg.norm(T)
    return batch.Path(*(jnp.asarray(part) for part in (O, D, log_rho)))


def test_events_are_placed_on_the_nearest_surface():
    """Against the largest of the inverse depths that a fine search finds on each ray."""
    windows, _ = fitted()
    tracks = windows.tracks(150_000, 0.15, 3000)
    rows, columns = tracks.nodes
    # A near square before a far wall.
    depths = np.full((rows, columns), np.log(0.3))
    depths[rows // 3 : 2 * rows // 3, columns // 3 : 2 * columns // 3] = np.log(1.8)
    path = true_path(depths.ravel())
    placed = np.stack(jax.jit(batch.placed)(path, tracks), 1)
    lattice = [
        tracks.corner[axis] + batch.NODE * np.arange(n) for axis, n in ((1, rows), (0, columns))
    ]
    there = scipy.interpolate.RegularGridInterpolator(lattice, depths, bounds_error=False)
    tried = np.linspace(np.log(1.9), np.log(0.28), 1000)
    far, near = (
        np.stack(batch.warp(path, tracks.f, tracks.x, tracks.y, tracks.tau, rho + 0 * tracks.x), 1)
        for rho in (0.0, 1.0)
    )
    seen_at = far + np.exp(tried)[:, None, None] * (near - far)
    off = tried[:, None] - there(seen_at[..., ::-1])
    first = np.argmax(off <= 0, 0)
    expected = seen_at[first, np.arange(len(first))]
    n = int(tracks.on.sum())
    right = np.linalg.norm(placed - expected, axis=1)[:n] < 0.05
    hidden = ((off[1:] * off[:-1] < 0).sum(0) > 1)[:n]
    # So many depths are looked at; surfaces that a ray only grazes lie between them.
    assert right.mean() > 0.95
    assert hidden.sum() > 20 and right[hidden].mean() > 0.7


def test_depths_of_a_known_path():
    """The roof's, where events tell them, from a plane at half the distance."""
    windows, _ = fitted()
    tracks = windows.tracks(150_000, 0.15, 8192)
    rows, columns = tracks.nodes
    flat = true_path(np.full(rows * columns, np.log(1.2)))
    found = np.asarray(batch.depths(flat, tracks)).reshape(rows, columns)
    j, i = np.mgrid[:rows, :columns] * batch.NODE
    rays = np.stack([(i + tracks.corner[0]) / F, (j + tracks.corner[1]) / F, np.ones(i.shape)], -1)
    normals, distances = np.array([[-0.5, 0.1, 1], [0.6, 0.3, 1]]), np.array([1.6, 1.5])
    exact = np.log(np.linalg.norm(T) * (rays @ normals.T / distances).max(-1))
    middle = (abs(rays[..., 0]) < 0.4) & (abs(rays[..., 1]) < 0.3)
    assert np.median(abs(found - exact)[middle]) < 0.06


def test_the_dual_of_a_plane_has_the_same_flow():
    windows, _ = fitted()
    tracks = windows.tracks(150_000, 0.15, 3000)
    rows, columns = tracks.nodes
    j, i = (part.ravel() * batch.NODE for part in np.mgrid[:rows, :columns])
    x, y = i + tracks.corner[0], j + tracks.corner[1]
    rho = np.stack([x / F, y / F, np.ones(len(x))], 1) @ [0.1, -0.15, 0.6]
    path = true_path(np.log(rho))
    other = batch.dual(path, tracks)
    assert other is not None and float(other.D[0] @ path.D[0]) < 0.9

    def flow(one: batch.Path) -> np.ndarray:
        a, b = (np.asarray(part(x, y, F)) for part in (geometry.A, geometry.B))
        return (a @ one.D[0]) * np.exp(one.log_rho)[:, None] + b @ one.O[0]

    ahead = np.stack([x / F, y / F, np.ones(len(x))], 1) @ np.asarray(path.D[0]) > 0.1
    assert ahead.mean() > 0.5
    np.testing.assert_allclose(flow(other)[ahead], flow(path)[ahead], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(other.D[0]), 1)
    steps = np.where(x > 0, 0.5, 1.0)
    assert batch.dual(true_path(np.log(rho * steps)), tracks) is None


def test_the_map_is_the_least_squares_one():
    """For a path held fixed, against a sparse solver on splines' weights written out."""
    windows, fit = fitted()
    tracks, prior = windows.tracks(150_000, 0.15, 8192), windows.prior(150_000, 0.15)
    scene = scene_of(fit)._replace(map=jnp.zeros(tracks.shape))
    # All events' weights are 1.
    prior = prior._replace(alike=jnp.asarray(1e-6), flat=jnp.asarray(0.02))
    for _ in range(2):
        scene, _ = batch.adjust(tracks, scene, prior, 1e3, 100, 8)
    left = np.asarray(batch.misfits(scene, tracks))
    n = int(tracks.on.sum())
    X, Y = (np.asarray(a)[:n] for a in batch.placed(scene.path, tracks))
    i, j = X - tracks.corner[0], Y - tracks.corner[1]
    height, width = tracks.shape
    inside = (i >= 1) & (i < width - 2) & (j >= 1) & (j < height - 2)
    i, j, e = i[inside], j[inside], np.arange(inside.sum())
    column, row = np.rint(i).astype(int), np.rint(j).astype(int)
    spline = scipy.interpolate.BSpline.basis_element([-1.5, -0.5, 0.5, 1.5])
    parts = [
        (e, (row + v) * width + column + u, spline(i - column - u) * spline(j - row - v))
        for u in (-1, 0, 1)
        for v in (-1, 0, 1)
    ]
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    pixel = np.unique(np.asarray(tracks.pixel)[:n][inside], return_inverse=True)[1]
    offsets = scipy.sparse.csr_array((-np.ones(len(e)), (e, pixel)), (len(e), pixel.max() + 1))
    events = scipy.sparse.csr_array((values, (rows, columns)), (len(e), height * width))
    number = np.arange(height * width).reshape(height, width)
    one = scipy.sparse.eye_array(height * width).tocsr()
    apart = [one[number[1:].ravel()] - one[number[:-1].ravel()],
             one[number[:, 1:].ravel()] - one[number[:, :-1].ravel()]]  # fmt: skip
    prior_rows = scipy.sparse.vstack([np.sqrt(0.02) * part for part in apart])
    none = scipy.sparse.csr_array((prior_rows.shape[0], offsets.shape[1]))
    matrix = scipy.sparse.vstack(
        [scipy.sparse.hstack([events, offsets]), scipy.sparse.hstack([prior_rows, none])]
    )
    level = np.asarray(tracks.level)[:n][inside]
    side = np.append(level, np.zeros(prior_rows.shape[0]))
    found = scipy.sparse.linalg.lsqr(matrix, side, iter_lim=300)
    cost = np.linalg.norm(left) ** 2 + ((prior_rows @ np.asarray(scene.map).ravel()) ** 2).sum()
    assert np.sqrt(cost) == pytest.approx(found[3], rel=0.01)
    assert found[3] < 0.5 * np.linalg.norm(level)


def test_the_photometric_fit_ends_at_the_truth():
    """From 6 degrees beside it, and depths of a plane that faces the camera."""
    windows, _ = fitted()
    tracks, prior = windows.tracks(150_000, 0.15, 8192), windows.prior(150_000, 0.15)
    depths = np.full(tracks.nodes[0] * tracks.nodes[1], np.log(np.linalg.norm(T) / 1.5))
    path = true_path(depths)
    beside = path.D.at[0].add(jnp.array([0.1, 0, 0]))
    path = batch.normalised(dataclasses.replace(path, D=beside))
    scene = batch.Scene(path, jnp.zeros(tracks.shape), jnp.zeros(()))
    for sigma, settle, steps in ((0.3, 2, 12), (0.2, 0, 15), (0.05, 0, 15)):
        scene, report = batch.adjust(tracks, scene, prior, sigma, settle, steps)
    heading, Omega = (part[0] for part in scene.path.twist(0.0))
    assert np.degrees(np.arccos(heading @ T / np.linalg.norm(T))) < 3
    assert np.linalg.norm(Omega - OMEGA) < 0.06 * np.linalg.norm(OMEGA)
    assert report.rms < 0.05 and report.inliers > 0.9


def test_the_gradient_of_misfits():
    """Before a smooth surface: beside edges of depth misfits jump from one surface to the other."""
    windows, fit = fitted()
    tracks = windows.tracks(150_000, 0.15, 8192)
    rows, columns = tracks.nodes
    depths = np.log(0.6) + 0.2 * np.sin(np.arange(columns) / 6) + np.zeros((rows, 1))
    given = true_path(depths.ravel())
    scene = scene_of(fit)._replace(path=given)

    @jax.jit
    def value(O0):
        path = dataclasses.replace(given, O=given.O.at[0].set(O0))
        return jnp.mean(batch.misfits(scene._replace(path=path), tracks) ** 2)

    at = given.O[0] + 0.01
    slope = jax.jit(jax.grad(value))(at)
    h = 1e-7
    for axis in np.eye(3):
        difference = (value(at + h * axis) - value(at - h * axis)) / (2 * h)
        assert slope @ axis == pytest.approx(float(difference), rel=1e-3, abs=1e-5)
    assert value(given.O[0]) < 0.9 * value(given.O[0] + 0.2)


def test_priors_pull():
    windows, fit = fitted()
    tracks, prior = windows.tracks(150_000, 0.15, 8192), windows.prior(150_000, 0.15)
    strong = prior._replace(omega=jnp.asarray(1e9))
    scene, _ = batch.adjust(tracks, scene_of(fit), strong, 0.1, 0, 8)
    assert np.linalg.norm(scene.path.O[0]) < 0.1 * np.linalg.norm(fit.path.O[0])
    t = np.array([0, 300_000])
    wrong = OMEGA + [0.0, 0.2, 0.0]
    windows = batch.Windows(
        seen(), batch.Params.of({**GIVEN, "gyro_std": 1e-5}), CAMERA,
        Twists(t, np.stack([wrong, wrong]), None, 0, 300_000),
    )  # fmt: skip
    prior = windows.prior(150_000, 0.15)
    scene, report = batch.adjust(tracks, scene_of(fit), prior, 0.1, 0, 8, True)
    np.testing.assert_allclose(scene.path.twist(0.0)[1][0], wrong, atol=1e-2)
    assert np.sqrt(np.diag(report.covariance)[3:]).max() < 1e-4


def test_a_recording_from_end_to_end():
    motion = batch.estimate(seen(), PARAMS)
    mean, covariance, lost = motion(motion.t[len(motion) // 2 :][:1])
    assert not lost[0] and covariance.shape == (1, 6, 6)
    assert np.linalg.norm(mean[0, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos(mean[0, :3] @ T / np.linalg.norm(T))) < 15
    again = batch.estimate(seen(), PARAMS)
    np.testing.assert_array_equal(again.mean, motion.mean)
    few = batch.estimate(seen()[0.0:0.01], PARAMS)
    assert few.lost.all() and np.isfinite(few.mean).all()
    at_once = seen().events[:3000]
    at_once = dataclasses.replace(at_once, t=np.full(3000, 150_000))
    instant = batch.estimate(dataclasses.replace(seen(), events=at_once), PARAMS)
    assert all(np.isfinite(part).all() for part in (instant.mean, instant.covariance))
    empty = dataclasses.replace(seen(), events=seen().events[:0])
    assert len(batch.estimate(empty, PARAMS)) == 0


def test_what_cannot_be_estimated_is_refused():
    with pytest.raises(InputError, match="calibration"):
        batch.estimate(dataclasses.replace(seen(), camera=None), PARAMS)
    with pytest.raises(InputError, match="general"):
        batch.estimate(seen(), PARAMS, model="generl")
