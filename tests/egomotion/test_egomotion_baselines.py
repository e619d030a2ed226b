"""Baselines of egomotion against closed forms, known motions and finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from points import moved, recorded, turning
from scipy.ndimage import gaussian_filter, map_coordinates, shift
from scipy.spatial.transform import Rotation

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import contrast, frames, planes
from jaxevent.egomotion.baselines import contrast as maximisation
from jaxevent.egomotion.baselines import fits, points
from jaxevent.egomotion.baselines import planes as plane_fits
from jaxevent.egomotion.baselines.points import fit_general
from jaxevent.egomotion.estimator import LostMotionWarning
from jaxevent.errors import InputError, InputWarning
from jaxevent.recording import Events, Frames
from jaxevent.simulate import motion_scene

WIDTH, HEIGHT, F = 96, 72, 90.0
SIZE = WIDTH, HEIGHT
CENTRE = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
CAMERA = PinholeCamera(F, F, *CENTRE)


def turning_flow(omega):
    return turning(np.array(omega), F, CENTRE)


SMALL = contrast.Params.of(
    dict(events=4000, duration=0.06, speed_max=300.0, omega_max=3.0, starts=5, margin=8)
)


def swept(normals, speeds, seconds=0.5):
    """Straight edges that sweep over tiles of a sensor one after another, an event per pixel.

    In tile k the edge goes along normals[k] at speeds[k] px/s: t = n . x / speed, to the us.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    tile = (x // 24 + 4 * (y // 24)) % len(normals)
    t = (x * normals[tile, 0] + y * normals[tile, 1]) / speeds[tile]
    for k in range(len(normals)):
        t[tile == k] -= t[tile == k].min()
    t = 1e6 * (t + 0.02 * (tile + 1))
    keep = t < 1e6 * seconds
    return recorded(np.rint(t)[keep], x[keep], y[keep], np.ones(keep.sum()), *SIZE)


def texture(seed=0, shape=(HEIGHT, WIDTH)):
    level = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.0, mode="wrap")
    return 0.5 + 0.15 * level / level.std()


def filmed(images, camera=None, step=40000):
    t = np.arange(len(images)) * step
    kept = Frames(t, np.clip(images, 0, 1).astype(np.float32), np.zeros(len(t), np.int64))
    none = recorded([], [], [], [], *images[0].shape[::-1], camera)
    return dataclasses.replace(none, frames=kept)


def test_a_plane_of_times_gives_its_normal_flow():
    angle = np.array([0.0, 0.7, 2.0, 3.3, 4.4, 5.5])
    normals = np.stack([np.cos(angle), np.sin(angle)], 1)
    speeds = np.array([150.0, 300.0, 220.0, 180.0, 400.0, 260.0])
    recording = swept(normals, speeds)
    params = planes.Params.of(dict(radius=2, fewest=8, apart=1e-5))
    flow = plane_fits.normal_flow(recording, params)
    e = recording.events
    tile = (e.x // 24 + 4 * (e.y // 24)).astype(int) % len(normals)
    # Inside a tile: elsewhere neighbours belong to other edges.
    inside = (abs(e.x % 24 - 11.5) < 9) & (abs(e.y % 24 - 11.5) < 9)
    assert flow.valid[inside].mean() > 0.9
    good = inside & flow.valid
    expected = (normals * speeds[:, None])[tile]
    # Times are whole us: 1 us in the 2 px / 400 px/s that a plane spans is 2e-4.
    np.testing.assert_allclose(flow.flow[good], expected[good], rtol=0, atol=0.25)
    assert (flow.flow[~flow.valid] == 0).all()
    assert np.array_equal(flow.row, np.arange(len(e.t))) and np.array_equal(flow.t, e.t)
    # The neighbours of an event are those that the edge has passed, up to 3 px ago.
    assert (flow.age[good] > 0).all() and (flow.age[good] < 3 / 150).all()


def test_neighbours_off_the_plane_are_left_out():
    y, x = np.mgrid[:9, :9].reshape(2, -1)
    t = 1000 + x * 5000.0  # 200 px/s to the right
    outlier = (y % 4 == 0) & (x % 4 == 1)
    t[outlier] += 4000
    recording = recorded(t, x, y, np.ones(81), 9, 9)
    flow = {}
    for tolerance in (1.5, 100.0):
        params = planes.Params.of(dict(radius=3, tolerance=tolerance, rough=1.0, oldest=0.1))
        made = plane_fits.normal_flow(recording, params)
        e = recording.events
        flow[tolerance] = made.flow[(e.x == 7) & (e.y == 5)][0]
    assert np.linalg.norm(flow[1.5] - [200, 0]) < 1e-6
    assert np.linalg.norm(flow[100.0] - [200, 0]) > 1


def test_bursts_count_once():
    """The first events of bursts are the edge, whatever comes within `apart` after them."""
    rounds = 3
    y, x = np.mgrid[:9, :9].reshape(2, -1)
    first = 1000 + x * 5000.0
    t = np.concatenate([first + 700 * k * (1 + (x + y) % 3) for k in range(rounds)])
    x, y = np.tile(x, rounds), np.tile(y, rounds)
    recording = recorded(t, x, y, np.ones(len(x)), 9, 9)
    made = plane_fits.normal_flow(recording, planes.Params.of(dict(apart=0.02)))
    assert made.valid.sum() > 20
    np.testing.assert_allclose(made.flow[made.valid], [[200.0, 0]] * made.valid.sum(), atol=1e-6)


def test_fit_is_robust_and_has_a_covariance():
    """The mean of squared errors is the covariance."""
    truth, errors = np.array([120.0, -40.0]), []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0, 2 * np.pi, 200)
        rows = np.stack([np.cos(angle), np.sin(angle)], 1)
        values = rows @ truth + 5 * np.repeat(rng.normal(size=100), 2)  # pairs err together
        values[:10] += 400
        fit = fits.robust_fit(rows, values, np.arange(200) // 2, np.ones(2))
        off = fit.mean - truth
        errors.append(off @ np.linalg.solve(fit.covariance, off))
    assert 1.4 < np.mean(errors) < 3.2  # 2 expected
    upright = rows * [1, 1e-3]
    assert fits.robust_fit(upright, values, np.arange(200), np.ones(2)) is None
    # Where components have other units it is not the aperture.
    assert fits.robust_fit(upright, values, np.arange(200), np.array([1, 1e-3])) is not None


def test_without_outliers_the_fit_is_least_squares():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(50, 3))
    noise = np.sign(rng.normal(size=50))  # none is far off the others
    values = rows @ [1.0, 2.0, 3.0] + 0.01 * noise
    fit = fits.robust_fit(rows, values, np.arange(50), np.ones(3))
    np.testing.assert_allclose(fit.mean, np.linalg.lstsq(rows, values)[0], rtol=1e-9)


@pytest.fixture(scope="module")
def straight():
    velocity = np.array([120.0, -70.0])
    return moved(lambda at: velocity, 0.15, 250, size=SIZE), velocity


@pytest.fixture(scope="module")
def rotating():
    omega = np.array([0.8, -0.9, 1.2])
    return moved(turning_flow(omega), 0.15, 250, camera=CAMERA, size=SIZE), omega


def passing(model, truth):
    """Edges that move with the image, one in each of 12 tiles, of a random direction each.

    A point at X (times any depth) of the camera's axes is at exp(Omega t) X of those at time 0.
    An edge is m . exp(Omega t) X = 0 and passes the middle of its tile at time 0; solved for t.
    """
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, 12)
    y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    tile = x // 24 + 4 * (y // 24)
    middle = np.stack([11.5 + 24 * (np.arange(12) % 4), 11.5 + 24 * (np.arange(12) // 4)], 1)
    if model == "planar":
        normals = np.stack([np.cos(angle), np.sin(angle)], 1)
        speed = normals @ truth
        t = ((np.stack([x, y], 1) - middle[tile]) * normals[tile]).sum(1) / speed[tile]
    else:
        centre = np.array([CAMERA.cx, CAMERA.cy])
        X = np.concatenate([np.stack([x, y], 1) - centre, np.full((len(x), 1), F)], 1)
        C = np.concatenate([middle - centre, np.full((12, 1), F)], 1)
        one = np.cross(C, [0.0, 1.0, 0.0])
        m = np.cos(angle)[:, None] * one / np.linalg.norm(one, axis=1)[:, None]
        two = np.cross(one, C)
        m += np.sin(angle)[:, None] * two / np.linalg.norm(two, axis=1)[:, None]
        speed = (m * np.cross(truth, C)).sum(1)
        t = np.zeros(len(x))
        for _ in range(20):
            now = Rotation.from_rotvec(truth * t[:, None]).apply(X)
            slope = (m[tile] * np.cross(truth, now)).sum(1)
            t -= np.clip((m[tile] * now).sum(1) / slope, -0.05, 0.05)
        now = Rotation.from_rotvec(truth * t[:, None]).apply(X)
        t[abs((m[tile] * now).sum(1)) > 1e-6] = np.inf
    keep = (abs(speed)[tile] > 25) & (abs(t) < 0.2)
    camera = CAMERA if model == "rotation" else None
    t = np.rint(1e6 * (t[keep] + 0.2))
    return recorded(t, x[keep], y[keep], np.ones(keep.sum()), *SIZE, camera)


@pytest.mark.parametrize(
    "model, truth", [("planar", [120.0, -70.0]), ("rotation", [0.8, -0.9, 1.2])]
)
def test_planes_find_the_motion(model, truth):
    truth = np.array(truth)
    params = planes.Params.of(dict(window=0.4, step=0.4, oldest=0.1))
    motion = planes.estimate(passing(model, truth), params, model=model)
    assert len(motion) == 1 and motion.valid.all() and motion.lag[0] > 0
    assert np.linalg.norm(motion.mean[0] - truth) < 0.01 * np.linalg.norm(truth)
    assert np.linalg.eigvalsh(motion.covariance[0]).min() > 0


def test_a_rotation_is_found_through_a_fisheye():
    """Seen 45 degrees from the axis; taken for a lens without distortion, it is another one."""
    lens = PinholeCamera(60, 60, 47.5, 35.5, (0.05, -0.01), "equidistant")
    recording, source = motion_scene(
        "rotation", seed=5, size=(96, 72), duration=0.12, speed=2, lens=lens
    )
    assert recording.camera == lens
    params = planes.Params.of(dict(window=0.06, step=0.03))
    errors = []
    for camera in (None, lens.undistorted):
        motion = planes.estimate(recording, params, model="rotation", camera=camera)
        (omega,) = np.unique(source.twist(motion.t)[1].round(9), axis=0)
        errors.append(np.linalg.norm(motion.mean[motion.valid].mean(0) - omega) / 2)
    assert errors[0] < 0.04 and errors[1] > 0.1


def test_planes_of_one_direction_are_lost():
    recording = swept(np.array([[1.0, 0.0]]), np.array([200.0]))
    with pytest.warns(
        InputWarning, match="planes found no motion, all .* are lost; try egomotion.voting, "
    ):
        motion = planes.estimate(recording, planes.Params.of(dict(window=0.1)))
    assert not motion.valid.any() and np.isfinite(motion.mean).all()
    assert np.isfinite(motion.covariance).all()


def test_an_event_alone_is_counted_as_one_estimate():
    recording = swept(np.array([[1.0, 0.0]]), np.array([200.0]))
    alone = dataclasses.replace(recording, events=recording.events[:1])
    with pytest.warns(InputWarning, match="planes found no motion, its only estimate is lost; try"):
        assert "1 estimate, 1 lost" in repr(planes.estimate(alone))


def test_frames_find_a_shift():
    pytest.importorskip("cv2", reason="needs the extra 'vision'")
    big = texture(shape=(HEIGHT + 40, WIDTH + 40))
    d = np.array([3.3, -1.6])  # px a frame: what is at x is at x + d next
    images = [shift(big, k * d[::-1], order=3)[20:-20, 20:-20] for k in range(4)]
    recording = filmed(images)
    motion = frames.estimate(recording)
    assert np.array_equal(motion.t, [20000, 60000, 100000]) and motion.valid.all()
    np.testing.assert_allclose(motion.mean, [d / 0.04] * 3, atol=0.02 / 0.04)
    assert np.linalg.eigvalsh(motion.covariance).min() > 0


def test_frames_find_a_rotation():
    pytest.importorskip("cv2", reason="needs the extra 'vision'")
    omega, dt = np.array([0.3, -0.5, 1.0]), 0.04
    big = texture(1, (4 * HEIGHT, 4 * WIDTH))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(x - CAMERA.cx) / F, (y - CAMERA.cy) / F, np.ones(x.shape)], -1)
    images = []
    for k in range(3):
        seen = rays @ Rotation.from_rotvec(omega * dt * k).as_matrix().T
        u, v = F * seen[..., 0] / seen[..., 2], F * seen[..., 1] / seen[..., 2]
        images.append(map_coordinates(big, [v + 2 * HEIGHT, u + 2 * WIDTH], order=3))
    motion = frames.estimate(filmed(images, CAMERA), model="rotation")
    np.testing.assert_allclose(motion.mean, [omega] * 2, atol=0.01)


def test_frames_that_show_nothing_are_lost():
    pytest.importorskip("cv2", reason="needs the extra 'vision'")
    with pytest.warns(InputWarning, match="frames found no motion, all 2 estimates are lost"):
        motion = frames.estimate(filmed([np.full((HEIGHT, WIDTH), 0.5)] * 3))
    assert not motion.valid.any() and np.isfinite(motion.mean).all()


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_five_points_determine_heading_and_turn(noise):
    """Against points of a known scene; with noise a fifth of them are wrong."""
    cv2 = pytest.importorskip("cv2", reason="needs the extra 'vision'")
    dt, f, n = 0.2, 300.0, 200
    for seed, T in enumerate(([1.0, 0.2, 0.1], [-0.3, 0.9, -0.4], [0.1, 0.1, 1.0])):
        rng, Omega = np.random.default_rng(seed), np.array([0.2, -0.3, 0.5])
        P = np.stack([*rng.uniform(-1, 1, (2, n)), rng.uniform(1.5, 4, n)], 1)
        # The camera's pose after dt, by many short steps of its constant twist.
        R, at, steps = np.eye(3), np.zeros(3), 20_000
        step = Rotation.from_rotvec(Omega * dt / steps).as_matrix()
        for _ in range(steps):
            at = at + R @ np.array(T) * dt / steps
            R = R @ step
        begin, later = f * P[:, :2] / P[:, 2:], (P - at) @ R
        end = f * later[:, :2] / later[:, 2:]
        begin, end = (xy + noise * rng.normal(size=xy.shape) for xy in (begin, end))
        if noise:
            wrong = rng.choice(n, n // 5, replace=False)
            end[wrong] += rng.uniform(-30, 30, (len(wrong), 2))
        fit = fit_general(cv2, begin, end, np.arange(n), f, dt)
        off = fit.mean - np.concatenate([np.array(T) / np.linalg.norm(T), Omega])
        if not noise:
            assert np.abs(off).max() < 1e-4  # the pose's steps
        spread = np.sqrt(np.diag(fit.covariance))
        assert (np.abs(off) < 5 * spread + 1e-3).all() and spread.max() < 0.1
        assert np.abs(fit.covariance[:3] @ np.array([*fit.mean[:3], 0, 0, 0])).max() < 1e-9


def test_five_points_without_a_motion_are_lost():
    cv2 = pytest.importorskip("cv2", reason="needs the extra 'vision'")
    few = np.random.default_rng(0).uniform(-50, 50, (7, 2))
    assert fit_general(cv2, few, few + 1, np.arange(7), 100.0, 0.1) is None


def test_frames_of_a_span_are_paired():
    kept = filmed([texture()] * 6).frames
    assert points.pair_frames(kept, 0.0) == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    assert points.pair_frames(kept, 0.1) == [(0, 3), (1, 4), (2, 5)]
    assert points.pair_frames(kept, 9.0) == [(0, 5)]


def windowed(model, number=150, seed=0, **settings):
    """A window of random events, and one of moderate size of a motion."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 30000, number))
    x, y = rng.integers(8, WIDTH - 8, number), rng.integers(8, HEIGHT - 8, number)
    recording = recorded(t, x, y, rng.random(number) < 0.5, *SIZE, CAMERA)
    params = contrast.Params.of(dict(events=200, duration=0.03, **settings))
    windows = maximisation.WindowSequence(recording, params, model)
    motion = {"planar": [90.0, -40.0], "rotation": [0.7, -0.4, 0.9]}[model]
    return params, windows.crop(next(iter(windows))), np.array(motion)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model, polarity, measure",
    [("planar", "ignored", "variance"), ("rotation", "signed", "mean square")],
)
def test_the_objective_and_its_gradient(model, polarity, measure):
    """Against a loop over events in NumPy, and finite differences within a pixel's kink."""
    params, window, motion = windowed(model, polarity=polarity, measure=measure)
    f, image = window.model.f, np.zeros(window.shape)
    for (x, y), t, w in zip(window.xi, window.t, window.weight, strict=True):
        if model == "planar":
            at = np.array([x, y]) - motion * t
        else:
            X = Rotation.from_rotvec(motion * t).as_matrix() @ [x, y, f]
            at = f * X[:2] / X[2]
        at = at - window.offset
        i, j = np.floor(at).astype(int)
        u, v = at - (i, j)
        w = abs(w) if polarity == "ignored" else w
        for dy, dx, share in (
            (0, 0, (1 - u) * (1 - v)), (0, 1, u * (1 - v)), (1, 0, (1 - u) * v), (1, 1, u * v),
        ):  # fmt: skip
            image[j + dy, i + dx] += w * share
    padded = np.pad(image, 1)
    padded = (padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]) / 4
    J = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    if measure == "variance":
        J = J - J.mean()
    expected = (J**2).sum() / (window.weight**2).sum()
    value = jax.jit(lambda m: maximisation.objective(params, window, m))
    np.testing.assert_allclose(value(motion), expected, rtol=1e-12)
    # As many blurs when their number is traced.
    traced = jax.jit(lambda k: maximisation.objective(params, window, motion, k))
    np.testing.assert_allclose(traced(jnp.asarray(1)), expected, rtol=1e-12)
    gradient, h = jax.jit(jax.grad(value))(motion), 1e-7
    for k, step in enumerate(h * np.eye(len(motion))):
        difference = (value(motion + step) - value(motion - step)) / (2 * h)
        np.testing.assert_allclose(gradient[k], difference, rtol=1e-4, atol=1e-6)


def test_mask_is_visible_all_the_time():
    _, window, _ = windowed("planar")
    seen = np.asarray(maximisation.mask_visible(window, np.array([400.0, 0.0])).mask)
    x = np.arange(window.shape[1]) + window.offset[0]
    y = np.arange(window.shape[0]) + window.offset[1]
    way = 400 * 0.015
    expected = (abs(x) <= (WIDTH - 1) / 2 - way) & (abs(y) <= (HEIGHT - 1) / 2)[:, None]
    # Half a us of the window's length may lie on a pixel's centre.
    assert (seen != expected).sum() <= HEIGHT
    fast = maximisation.mask_visible(window, np.array([1e4, 0.0]))
    assert np.asarray(fast.mask).all()


@pytest.fixture(scope="module")
def sharpened(straight):
    return contrast.estimate(straight[0], SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["planar", "rotation"])
def test_contrast_finds_the_motion(straight, rotating, sharpened, model):
    """Without a start; and the covariance is that of the error."""
    truth, motion = straight[1], sharpened
    if model == "rotation":
        recording, truth = rotating
        motion = contrast.estimate(recording, SMALL, model=model)
    assert len(motion) >= 3 and motion.valid.all() and (motion.contrast > 1.5).all()
    off = motion.mean - truth
    assert (np.linalg.norm(off, axis=1) < 0.03 * np.linalg.norm(truth)).all()
    spread = np.einsum("ni,nij,nj->n", off, np.linalg.inv(motion.covariance), off)
    assert spread.mean() < 5 * len(truth)


@pytest.mark.slow
def test_contrast_along_parallel_edges_is_lost():
    """Upright bars that move by (120, 60) px/s, with the scatter of pixels' thresholds."""
    rng = np.random.default_rng(31)
    edges = np.cumsum(rng.integers(1, 4, 60) * 8) - 60.0
    x, y, edge = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT), edges, indexing="ij")
    t = (x - edge + rng.normal(0, 0.3, x.shape[:2])[..., None]) / 120
    kept = (t > 0) & (t < 0.25)
    on = np.broadcast_to(np.arange(len(edges)) % 2, t.shape)
    recording = recorded(1e6 * t[kept], x[kept], y[kept], on[kept], *SIZE)
    with pytest.warns(InputWarning, match="edges in view are parallel"):
        motion = contrast.estimate(recording, SMALL, model="planar")
    assert len(motion) and not motion.valid.any()


def test_search_finds_fast_rotations():
    """About ten times as fast as could be searched in the whole window."""
    omega = np.array([14.0, 8.0, -6.0])
    recording = moved(turning_flow(omega), 0.024, 800, camera=CAMERA, size=SIZE)
    params = contrast.Params.of(dict(events=4000, duration=0.02, margin=8, starts=5))
    windows = maximisation.WindowSequence(recording, params, "rotation")
    found = windows.search(next(iter(windows)))
    assert np.linalg.norm(found - omega) < 0.15 * np.linalg.norm(omega)


@pytest.mark.slow
def test_contrast_is_independent_of_the_clock(straight, sharpened):
    e = straight[0].events
    later = dataclasses.replace(straight[0], events=dataclasses.replace(e, t=e.t + 3_600_000_000))
    motion = contrast.estimate(later, SMALL)
    assert np.array_equal(sharpened.mean, motion.mean)
    assert np.array_equal(sharpened.t + 3_600_000_000, motion.t)


@pytest.mark.slow
def test_windows_of_a_number_of_events(straight):
    recording, truth = straight
    params = contrast.Params.of({**SMALL.values(), "window": "events"})
    motion = contrast.estimate(recording, params)
    # And the ends of the first and the last.
    assert len(motion) == (len(recording.events) - 4000) // 2000 + 1 + 2
    off = np.linalg.norm(motion.mean - truth, axis=1) / np.linalg.norm(truth)
    assert (off < 0.05).all()


@pytest.mark.slow
def test_lone_window_measures_the_change_of_the_motion():
    """The motion's mean, its change as a part of the error, and how far it may be at the ends."""
    speeds = iter(np.linspace(100, 200, 200))

    def faster(at):
        return np.tile([next(speeds), 0.0], (len(at), 1))

    recording = moved(faster, 0.06, 800, size=SIZE)
    params = contrast.Params.of({**SMALL.values(), "duration": 1.0})
    motion = contrast.estimate(recording, params)
    assert list(motion.t) == pytest.approx([recording.start, 30_000, recording.stop], abs=500)
    true = np.array([[100, 0], [137.5, 0], [175, 0]])
    z = (motion.mean - true) / np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    assert motion.valid.all() and (np.abs(z) < 3).all()
    sigma = np.sqrt(motion.covariance[:, 0, 0])
    assert 0.7 * 37.5 < sigma[0] < 1.3 * 37.5 and 0.06 * 75 < sigma[1] < 0.2 * 75


@pytest.mark.slow
def test_changes_that_windows_average_are_in_sigma():
    """A speed that oscillates once in a window has means that are alike, as a constant one has."""
    ends = np.zeros(2)
    for k, swing in enumerate((0.0, 60.0)):
        speeds = iter(150 + swing * np.sin(2 * np.pi * np.arange(450) / 150))

        def uneven(at, speeds=speeds):
            return np.tile([next(speeds), 0.0], (len(at), 1))

        motion = contrast.estimate(moved(uneven, 0.18, 500, size=SIZE), SMALL)
        inner = motion.valid[1:-1]
        assert inner.sum() > 3
        ends[k] = np.sqrt(np.median(motion.covariance[1:-1][inner][:, 0, 0]))
    assert ends[0] < 0.05 * 150 and 0.3 * 60 < ends[1] < 1.2 * 60


@pytest.mark.parametrize(
    "active, filled",
    [
        ([(0, 100)], (True, True, True)),
        ([(0, 60)], (True, False, False)),  # the camera stops
        ([(40, 100)], (False, False, True)),  # it begins to move
        ([(0, 25), (75, 100)], (True, False, True)),
        ([(0, 45), (60, 100)], (True, True, True)),  # events were dropped
    ],
)
def test_windows_across_a_stop_are_lost(active, filled):
    """Events 20 us apart while the camera moves, 400 us apart of noise."""
    spans = [np.arange(1000 * a, 1000 * b, 20) for a, b in active]
    t = np.sort(np.concatenate([*spans, np.arange(0, 100_000, 400)]))
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, WIDTH, len(t)), rng.integers(0, HEIGHT, len(t))
    recording = recorded(t, x, y, x % 2 == 0, *SIZE)
    params = SMALL.replace(duration=0.0996)
    windows = maximisation.WindowSequence(recording, params)
    assert len(windows) == 1 and tuple(windows.filled_parts(next(iter(windows)))) == filled
    if not filled[1]:
        with pytest.warns(LostMotionWarning):
            assert not contrast.estimate(recording, params).valid.any()


@pytest.mark.slow
def test_silence_and_noise_are_lost_and_the_motion_found_again(straight, optimised):
    recording, truth = straight[0][0.0:0.1], straight[1]
    e, rng = recording.events, np.random.default_rng(0)
    n = 3000
    noise = np.sort(rng.integers(1_000_000, 1_100_000, n))
    events = Events(
        np.concatenate([e.t, noise, e.t + 2_000_000]),
        np.concatenate([e.x, rng.integers(0, WIDTH, n).astype(np.uint16), e.x]),
        np.concatenate([e.y, rng.integers(0, HEIGHT, n).astype(np.uint16), e.y]),
        np.concatenate([e.p, rng.random(n) < 0.5, e.p]),
    )
    motion = contrast.estimate(dataclasses.replace(recording, events=events), SMALL)
    assert np.isfinite(motion.mean).all() and np.isfinite(motion.covariance).all()
    silent = (motion.t > 300_000) & (motion.t < 900_000)
    noisy = (motion.t > 1_040_000) & (motion.t < 1_060_000)
    again = motion.t > 2_050_000
    assert not motion.valid[silent].any() and not motion.valid[noisy].any()
    assert motion.valid[again].all()
    assert (np.linalg.norm(motion.mean[again] - truth, axis=1) < 5).all()


@pytest.mark.parametrize("number", [0, 1, 50])
@pytest.mark.filterwarnings("ignore:made. .* found no motion:jaxevent.errors.InputWarning")
@pytest.mark.parametrize("method", [planes, contrast])
def test_few_events_are_lost(method, number):
    few = recorded([5] * number, range(number), [3] * number, [1] * number, *SIZE)
    motion = method.estimate(few)
    assert not motion.valid.any() and len(motion) == (number > 0)
    assert "planar assumed" in repr(motion) or method is contrast
    assert "(planar, " in repr(method.estimate(few, model="planar"))
    assert np.isfinite(motion.mean).all() and np.isfinite(motion.covariance).all()


@pytest.mark.parametrize("method", [planes, frames, contrast])
def test_bad_input(method, straight):
    recording, _ = straight
    with pytest.raises(InputError, match="no motion model 'planer'; did you mean 'planar'"):
        method.estimate(recording, model="planer")
    with pytest.raises(InputError, match="made: has no calibration, which rotation needs"):
        method.estimate(recording, model="rotation")


@pytest.mark.parametrize("number", [0, 1])
def test_no_frames(straight, number):
    one = filmed([texture()]).frames if number else None
    recording = dataclasses.replace(straight[0], frames=one)
    with pytest.raises(
        InputError, match=f"made: has {number} frames .* take a method that uses ev"
    ):
        frames.estimate(recording)


@pytest.mark.slow
def test_single_precision(float32, straight):
    recording, truth = straight
    motion = contrast.estimate(recording, SMALL)
    assert (np.linalg.norm(motion.mean - truth, axis=1) < 0.03 * np.linalg.norm(truth)).all()
