"""General motion of a window: the warp against rigid geometry, and scenes of points."""

import dataclasses
import functools
import math
import warnings

import numpy as np
import pytest
import scipy.interpolate
from scipy.spatial.transform import Rotation

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import geometry
from jaxevent.egomotion.bundle import hypotheses, initialise, photometric_ba, sequence
from jaxevent.egomotion.bundle import windows as data
from jaxevent.egomotion.bundle.alignment import ImageScratch
from jaxevent.egomotion.bundle.hypotheses import Stage, WindowFit, WindowFitter
from jaxevent.egomotion.bundle.photometric_ba import FitReport, compute_covariance, search_depths
from jaxevent.egomotion.bundle.residuals import PixelSeries, Scene, project_events, residuals
from jaxevent.egomotion.bundle.warp import (
    N_COEFFICIENT_ROWS,
    Path,
    Points,
    Prior,
    normalise,
    predict_path,
    warp,
)
from jaxevent.egomotion.bundle.windows import (
    DARK_GREY_OFFSET,
    Params,
    read_frame_pixels,
    stamp_offset,
)
from jaxevent.egomotion.truth import Twists
from jaxevent.errors import InputError, InputWarning
from jaxevent.recording import Events, Frames, Recording

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]  # it computes long

WIDTH, HEIGHT, F = 96, 72, 80.0
CAMERA = PinholeCamera(F, F, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
T, OMEGA = np.array([0.5, -0.3, 0.6]), np.array([0.3, -0.5, 0.4])
SECONDS = 0.3


# normal . P = distance
ROOF = ((-0.5, 0.1, 1.0), 1.6), ((0.6, 0.3, 1.0), 1.5)


@functools.cache
def seen(planes: tuple = ROOF, finest: float = 9.0, frames: bool = False) -> Recording:
    """Textured planes, 1 to 2 m away: events where log intensity passes levels; 7 frames.

    The poses are exp(t (T, Omega)) by the closed form, t from the middle.
    """
    rng = np.random.default_rng(0)
    wave = 2 * np.pi * rng.uniform(2, finest, (20, 1)) * rng.normal(size=(20, 2)) / 1.5
    phase = rng.uniform(0, 2 * np.pi, 20)
    y, x = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    rays = np.stack([(x - CAMERA.cx) / F, (y - CAMERA.cy) / F, np.ones(len(x))], 1)
    normals, distances = (np.array(part) for part in zip(*planes, strict=True))

    def seen_at(pose: np.ndarray) -> np.ndarray:
        R, C = pose[:3, :3], pose[:3, 3]
        depth = ((distances - normals @ C) / (rays @ R.T @ normals.T)).min(1)
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
    recording = Recording("planes", WIDTH, HEIGHT, events, camera=CAMERA)
    if not frames:
        return recording
    images = [0.2 * np.exp(seen_at(pose)).reshape(HEIGHT, WIDTH) for pose in poses[5:150:23]]
    times = np.rint(1e6 * (steps[5:150:23] + SECONDS / 2)).astype(np.int64)
    shown = np.clip(images, 0, 1).astype(np.float32)
    shown[1::2] *= 0.8  # exposures that change
    taken = Frames(times, shown, np.zeros(len(times), np.int64))
    return dataclasses.replace(recording, frames=taken)


GIVEN = {"events": 8192, "fewest": 500, "starts": 3, "rivals": 1, "flow_max": 120.0, "cell": 16}
PARAMS = Params.of(GIVEN)


def test_warp_of_a_rigid_scene():
    """Points seen by a moving camera go where the camera at the reference time sees them."""
    rng = np.random.default_rng(1)
    O = rng.normal(size=(3, 3)) * [[1.0], [4], [20]]  # noqa: E741
    D = rng.normal(size=(3, 3))
    more = np.zeros((N_COEFFICIENT_ROWS - 3, 3))
    path = Path(np.append(O, more, 0), np.append(D, more, 0), np.zeros(1))
    C = path.derivatives()[1]
    np.testing.assert_allclose(C[1], D[1] + np.cross(O[0], D[0]))
    tau = rng.uniform(-0.15, 0.15, 50)
    powers = np.stack([tau, tau**2 / 2, tau**3 / 6, tau**4 / 24, tau**5 / 120], 1)
    P = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], 1)
    P *= rng.uniform(2, 5, (50, 1))
    R = Rotation.from_rotvec(powers[:, :3] @ O)
    local = R.apply(P - powers @ C, inverse=True)
    seen = F * local[:, :2] / local[:, 2:]
    rho = 1 / P[:, 2]
    x, y = warp(path, F, Points(seen[:, 0], seen[:, 1], tau), rho)
    exact = F * P[:, :2] / P[:, 2:]
    np.testing.assert_allclose(np.stack([x, y], 1), exact, atol=2e-4)


def test_prediction_of_a_path():
    """Twists are the same where windows overlap, to a polynomial's accuracy; beyond they stay."""
    path = true_path(np.zeros(1))
    heading, Omega = path.unit_twist(np.array([-0.1, 0.0, 0.1]))
    np.testing.assert_allclose(Omega, np.broadcast_to(OMEGA, (3, 3)))
    np.testing.assert_allclose(heading, np.broadcast_to(path.D[0], (3, 3)), atol=2e-3)
    path.O[1], path.O[2], path.D[1] = 2.0, -10.0, [1.0, -2.0, 0.5]
    t = np.linspace(-0.15, 0.15, 31)
    for tau in (0.0, 0.05, -0.05):
        T, Omega = path.unit_twist(np.clip(t + tau, -0.15, 0.15))
        heading, turn = predict_path(path, tau, 0.15).unit_twist(t)
        np.testing.assert_allclose(turn, Omega, atol=0.03 if tau else 1e-3)
        np.testing.assert_allclose(heading, T, atol=0.03 if tau else 1e-3)
    # The fifth power of what turns by 0.02 rad/s more within the window does not go on beyond.
    steep = dataclasses.replace(path, O=path.O.copy())
    steep.O[4] = 1e3
    for tau in (0.1, -0.1):
        change = (
            predict_path(steep, tau, 0.15).unit_twist(t)[1]
            - predict_path(path, tau, 0.15).unit_twist(t)[1]
        )
        assert np.abs(change).max() < 0.03
    # Depths are in units of the speed at the reference time.
    fast = dataclasses.replace(path, D=path.D.copy())
    fast.D[1] = 2 * path.D[0]
    ratio = np.exp(float(predict_path(fast, 0.1, 0.15).log_rho[0] - path.log_rho[0]))
    assert ratio == pytest.approx(1.2, abs=0.03)


@functools.cache
def roof() -> WindowFitter:
    return WindowFitter(seen(), PARAMS, CAMERA)


@functools.cache
def fitted() -> WindowFit:
    fit = roof().fit(150_000)
    assert fit is not None
    return fit


@functools.cache
def data_of(most: int = 8192) -> tuple[PixelSeries, Prior]:
    return roof().series(150_000, 0.15, most), roof().prior(150_000, 0.15)


def test_the_motion_of_a_window_is_found():
    """As far as 96 x 72 pixels tell it: a heading beside a turn, and a turn beside a heading."""
    fit = fitted()
    heading, Omega = (part[0] for part in fit.path.unit_twist(0.0))
    assert np.degrees(np.arccos(heading @ T / np.linalg.norm(T))) < 15
    assert np.linalg.norm(Omega - OMEGA) < 0.35 * np.linalg.norm(OMEGA)
    assert fit.agreement > 0.5 and np.isfinite(fit.covariance).all()
    assert (np.linalg.eigvalsh(fit.covariance) > -1e-12).all()


def test_the_motion_before_a_wall_is_found():
    """The homography has two, the true one costs less with a plane's depths."""
    recording = seen(ROOF[:1], 5.0)
    few = WindowFitter(recording, PARAMS, CAMERA)
    windows = WindowFitter(recording, Params.of({**GIVEN, "events": 10_000}), CAMERA)
    normal = np.array(ROOF[0][0]) / ROOF[0][1]
    exact = np.cross(np.eye(3), OMEGA) + np.outer(T, normal)
    exact -= np.trace(exact) / 3 * np.eye(3)
    M = initialise.homography_flow(
        few.sample_events(150_000, 0.05, hypotheses.MAX_FLOW_EVENTS), few.rotation(150_000)
    )
    assert np.linalg.norm(M - exact) < 0.5 * np.linalg.norm(exact)

    near = exact + 0.05 * np.linalg.norm(exact) * np.diag([0.5, -0.7, 0.5])
    made = initialise.planar_solutions(near)
    found = windows.planar_hypotheses(150_000, made)
    assert len(found) == 2 and found[0][1].cost < found[1][1].cost
    heading, turn = found[0][0].path.unit_twist(0.0)
    assert np.degrees(np.arccos(heading[0] @ T / np.linalg.norm(T))) < 1
    assert np.linalg.norm(turn[0] - OMEGA) < 0.02 * np.linalg.norm(OMEGA)
    # Depths are the plane's; those smaller than the least were not.
    x, y = windows.series(150_000, 0.15, hypotheses.MAX_HYPOTHESIS_EVENTS).node_positions
    rho = np.exp(found[0][0].path.log_rho)
    rays = np.stack([x / F, y / F, np.ones(len(x))], 1)
    ahead = rays @ normal > 0.3
    n = np.linalg.lstsq(rays[ahead], rho[ahead])[0]
    np.testing.assert_allclose(rays[ahead] @ n, rho[ahead], rtol=1e-3)
    np.testing.assert_allclose(n, normal * np.linalg.norm(T), atol=0.01)
    assert roof().planar_hypotheses(150_000, made) == []


def adjust(series, scene, prior, sigma, map_steps, steps):
    return photometric_ba.adjust(
        series, scene, prior, sigma=sigma, map_steps=map_steps, steps=steps
    )


def scene_of(fit: WindowFit) -> Scene:
    return Scene(fit.path, fit.map, 0.0)


def test_series_are_the_events_of_pixels():
    series, _ = data_of(3000)
    events = seen().events
    assert 2000 < len(series.x) <= 3000
    assert series.begin[0] == 0 and series.begin[-1] == len(series.x)
    where = events.y.astype(int) * WIDTH + events.x
    for first, last in zip(series.begin[:-1:20], series.begin[1::20], strict=True):
        at = slice(first, last)
        x, y = np.rint([series.x[first] + CAMERA.cx, series.y[first] + CAMERA.cy]).astype(int)
        own = np.flatnonzero(where == y * WIDTH + x)
        np.testing.assert_allclose(series.x[at], x - CAMERA.cx)
        np.testing.assert_array_equal(series.p[at], 2.0 * events.p[own] - 1)
        np.testing.assert_array_equal(series.level[at], np.cumsum(2.0 * events.p[own] - 1))
        np.testing.assert_array_equal(series.count[at], np.arange(len(own)) + 1)
        np.testing.assert_allclose(series.tau[at], (events.t[own] - 150_000) * 1e-6, atol=1e-12)


def true_path(log_rho: np.ndarray) -> Path:
    return Path.constant_twist(T / np.linalg.norm(T), OMEGA, log_rho)


def test_events_are_placed_on_the_nearest_surface():
    """Against the largest of the inverse depths that a fine search finds on each ray."""
    series, _ = data_of(3000)
    rows, columns = series.nodes
    # A near square before a far wall.
    depths = np.full((rows, columns), np.log(0.3))
    depths[rows // 3 : 2 * rows // 3, columns // 3 : 2 * columns // 3] = np.log(1.8)
    path = true_path(depths.ravel())
    (X, Y), log_rho = project_events(path, series)
    found = np.stack([X, Y], 1)
    lattice = [
        series.corner[axis] + series.node * np.arange(n) for axis, n in ((1, rows), (0, columns))
    ]
    there = scipy.interpolate.RegularGridInterpolator(lattice, depths, bounds_error=False)
    tried = np.linspace(np.log(1.9), np.log(0.28), 1000)
    far, near = (
        np.stack(warp(path, series.f, series.points, np.array(rho)), 1) for rho in (0.0, 1.0)
    )
    seen_at = far + np.exp(tried)[:, None, None] * (near - far)
    off = tried[:, None] - there(seen_at[..., ::-1])
    first = np.argmax(off <= 0, 0)
    expected = seen_at[first, np.arange(len(first))]
    right = np.linalg.norm(found - expected, axis=1) < 0.05
    hidden = (off[1:] * off[:-1] < 0).sum(0) > 1
    # So many depths are looked at; surfaces that a ray only grazes lie between them.
    assert right.mean() > 0.95
    assert hidden.sum() > 20 and right[hidden].mean() > 0.7
    # From where they lay before the motion was changed a little they are found too.
    changed = Path(1.02 * path.O, path.D, path.log_rho)
    searched, near = (project_events(changed, series, rho)[0] for rho in (None, log_rho))
    assert np.abs(searched[0] - X).max() > 0.1
    same = np.hypot(searched[0] - near[0], searched[1] - near[1]) < 0.01
    assert same.mean() > 0.97


def test_gradient_of_contrast():
    """By each generator of a homography flow, against differences."""
    cut = roof().sample_events(150_000, 0.15, 3000)
    basis = np.concatenate([initialise.ROTATION_GENERATORS, initialise.STRAIN_GENERATORS])
    terms = np.empty((3, initialise.MATRIX_EXPONENTIAL_ORDER + 1, 3))
    scratch, slope = ImageScratch.of(cut.shape, cut.x.dtype, terms), np.empty(len(basis))

    def contrast(values: np.ndarray) -> float:
        M = np.tensordot(values, basis, 1)
        return initialise.contrast_and_gradient(cut, M, basis, 4, scratch, slope)

    values = np.linspace(-0.4, 0.5, len(basis))
    # Steps over which the image moves by some hundredths of a pixel.
    step, found = 2e-3, []
    for way in np.eye(len(basis)):
        found.append((contrast(values + step * way) - contrast(values - step * way)) / (2 * step))
    contrast(values)
    np.testing.assert_allclose(slope, found, atol=0.02 * np.abs(found).max())


def test_a_function_of_few_numbers_is_minimised():
    """Rosenbrock's, which is least, 0, at (1, 1)."""

    def rosenbrock(at: np.ndarray) -> tuple[float, np.ndarray]:
        a, b = 1 - at[0], at[1] - at[0] ** 2
        return a**2 + 100 * b**2, np.array([-2 * a - 400 * at[0] * b, 200 * b])

    at, least = initialise.minimise_bfgs(rosenbrock, np.array([-1.2, 1.0]), 60)
    np.testing.assert_allclose(at, 1, atol=1e-3)
    assert 0 <= least < 1e-6


def test_depths_of_a_known_path():
    """The roof's, where events tell them, from a plane at half the distance."""
    series, _ = data_of()
    rows, columns = series.nodes
    flat = true_path(np.full(rows * columns, np.log(1.2)))
    found = search_depths(flat, series).reshape(rows, columns)
    j, i = np.mgrid[:rows, :columns] * series.node
    rays = np.stack([(i + series.corner[0]) / F, (j + series.corner[1]) / F, np.ones(i.shape)], -1)
    normals, distances = (np.array(part) for part in zip(*ROOF, strict=True))
    exact = np.log(np.linalg.norm(T) * (rays @ normals.T / distances).max(-1))
    middle = (abs(rays[..., 0]) < 0.4) & (abs(rays[..., 1]) < 0.3)
    assert np.median(abs(found - exact)[middle]) < 0.06


def test_two_motions_before_a_plane_have_the_same_flow():
    """Against A T rho + B Omega of the motion that made M, and of the one it was not."""
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-40, 40, 9), np.linspace(-30, 30, 7)))
    a, b = (np.asarray(part(x, y, F)) for part in (geometry.A, geometry.B))

    def flow(one: initialise.PlanarMotion) -> np.ndarray:
        rho = np.stack([x / F, y / F, np.ones(len(x))], 1) @ one.normal
        return (a @ one.T) * rho[:, None] + b @ one.Omega

    rng = np.random.default_rng(3)
    for _ in range(20):
        made = initialise.PlanarMotion(
            rng.normal(size=3), np.append(rng.normal(size=2), 1.0), OMEGA
        )
        M = np.cross(np.eye(3), made.Omega) + np.outer(made.T, made.normal)
        both = initialise.planar_solutions(M - np.trace(M) / 3 * np.eye(3))
        for one in both:
            np.testing.assert_allclose(flow(one), flow(made), atol=1e-9)
        off = [abs(one.Omega - made.Omega).max() for one in both]
        assert min(off) < 1e-9 and max(off) > 1e-2
    path = made.path((x, y), F, np.dtype(float))
    at = np.abs(x) + np.abs(y) < 20
    heading = made.T / np.linalg.norm(made.T)
    there = (a @ heading) * np.exp(path.log_rho)[:, None] + b @ path.O[0]
    np.testing.assert_allclose(there[at], flow(made)[at], atol=1e-9)
    still = initialise.planar_solutions(np.cross(np.eye(3), OMEGA))
    assert all(np.isfinite(np.concatenate(one)).all() for one in still)


def test_the_map_is_a_quadratic_spline():
    """Against SciPy's splines; residuals are less the means of their series."""
    series, _ = data_of(3000)
    scene = Scene(true_path(np.full(math.prod(series.nodes), np.log(0.6))), None, 0.1)
    scene = scene._replace(map=np.random.default_rng(0).normal(size=series.shape))
    (X, Y), _ = project_events(scene.path, series)
    i, j = X - series.corner[0], Y - series.corner[1]
    height, width = series.shape
    inside = (i >= 1) & (i < width - 2) & (j >= 1) & (j < height - 2)
    spline = scipy.interpolate.BSpline.basis_element([-1.5, -0.5, 0.5, 1.5], extrapolate=False)
    rows, columns = (np.nan_to_num(spline(at[:, None] - np.arange(n)))
                     for at, n in ((j, height), (i, width)))  # fmt: skip
    value = np.einsum("ej,ji,ei->e", rows, scene.map, columns)
    value -= series.level + scene.skew * series.count
    pixel = np.repeat(np.arange(len(series.begin) - 1), np.diff(series.begin))
    mean = np.bincount(pixel, inside * value) / np.maximum(np.bincount(pixel, inside), 1e-3)
    expected = inside * (value - mean[pixel])
    np.testing.assert_allclose(residuals(scene, series), expected, atol=1e-9)


def test_the_photometric_fit_ends_at_the_truth():
    """From 6 degrees beside it, and depths of a plane that faces the camera."""
    series, prior = data_of()
    depths = np.full(series.nodes[0] * series.nodes[1], np.log(np.linalg.norm(T) / 1.5))
    path = true_path(depths)
    path.D[0] += np.array([0.1, 0, 0])
    scene = Scene(normalise(path), np.zeros(series.shape), 0.0)
    for sigma, map_steps, steps in ((0.3, 2, 12), (0.2, 0, 15), (0.05, 0, 15)):
        scene, report = adjust(series, scene, prior, sigma, map_steps, steps)
    heading, Omega = (part[0] for part in scene.path.unit_twist(0.0))
    assert np.degrees(np.arccos(heading @ T / np.linalg.norm(T))) < 3
    assert np.linalg.norm(Omega - OMEGA) < 0.06 * np.linalg.norm(OMEGA)
    assert report.noise < 0.05 and report.inliers > 0.9


def test_levels_of_frames_are_in_units_of_the_threshold():
    recording = seen(frames=True)
    shown = read_frame_pixels(recording, 0, 300_000)
    assert shown is not None and len(shown.t) == 7 and (shown.precision > 0.5).mean() > 0.9
    logarithm = np.log(recording.frames.intensity.reshape(7, -1) + DARK_GREY_OFFSET)
    slope = np.polyfit(logarithm.ravel(), shown.level.ravel(), 1)[0]
    assert slope == pytest.approx(1 / 0.25, rel=0.15)
    assert read_frame_pixels(recording, 0, 50_000) is None  # one frame tells no change
    exchanged = dataclasses.replace(recording.events, p=~recording.events.p)
    assert read_frame_pixels(dataclasses.replace(recording, events=exchanged), 0, 300_000) is None
    mirrored = dataclasses.replace(recording.frames, images=recording.frames.images[:, :, ::-1])
    assert read_frame_pixels(dataclasses.replace(recording, frames=mirrored), 0, 300_000) is None


def stamped(late: int) -> Recording:
    """The recording with frames whose stamps are so many us early."""
    recording = seen(frames=True)
    frames = dataclasses.replace(recording.frames, t=recording.frames.t - late)
    return dataclasses.replace(recording, frames=frames)


def test_offset_of_stamps():
    for late in (-6000, 0, 9000):
        assert abs(stamp_offset(stamped(late)) - late) < 1500  # in which the image moves by 0.07 px
    recording = stamped(9000)
    mirrored = dataclasses.replace(recording.frames, images=recording.frames.images[:, :, ::-1])
    assert stamp_offset(dataclasses.replace(recording, frames=mirrored)) == 0
    assert stamp_offset(dataclasses.replace(recording, frames=recording.frames[:1])) == 0
    assert stamp_offset(stamped(10**12)) == 0  # no event between them


@pytest.mark.parametrize(
    "told, expected", [((4000, 5500), 4000), ((4000, 6500), 0), ((4000, None), 0), ((None, 0), 0)]
)
def test_an_offset_that_depends_on_the_method_is_none(monkeypatch, told, expected):
    monkeypatch.setattr(
        data, "_best_offset", lambda *given: told[data.STAMP_OFFSET_METHODS.index(given[-1])]
    )
    assert stamp_offset(stamped(0)) == expected


def test_frames_determine_motion_if_events_are_few():
    """From 6 degrees beside it, with a tenth of the events; frames are stamped 9 ms early."""
    off = []
    for given in (True, False):
        params = Params.of({**GIVEN, "frames": given})
        windows = WindowFitter(stamped(9000), params, CAMERA)
        series, prior = windows.series(150_000, 0.15, 1500), windows.prior(150_000, 0.15)
        assert (len(series.x) > series.n_events) == given
        path = true_path(np.full(math.prod(series.nodes), np.log(np.linalg.norm(T) / 1.5)))
        path.D[0] += np.array([0.1, 0, 0])
        stages = tuple(Stage(sigma, 12) for sigma in (0.3, 0.05))
        blank = hypotheses.blank_scene(series, normalise(path), prior)
        (scene, _) = hypotheses._settle_and_refine(series, blank, prior, stages)
        off.append(np.degrees(np.arccos(scene.path.D[0] @ T / np.linalg.norm(T))))
    assert off[0] < 4 and off[0] < 0.5 * off[1], off


def test_a_lens_leaves_errors_across_the_heading():
    bent = dataclasses.replace(CAMERA, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    ideal, real = (WindowFitter(seen(), PARAMS, camera) for camera in (CAMERA, bent))
    heading = T / np.linalg.norm(T)
    near, far = (
        Path.constant_twist(heading, np.zeros(3), np.full(4, np.log(d))) for d in (2.0, 1.0)
    )
    assert not ideal.lens_covariance(near).any()
    one, other = real.lens_covariance(near), real.lens_covariance(far)
    np.testing.assert_allclose(one[:3, :3] @ heading, 0, atol=1e-12)
    # Of a translation alone the heading is as well told at any speed, Omega errs with the speed.
    np.testing.assert_allclose(one[:3, :3], other[:3, :3])
    np.testing.assert_allclose(one[3:, 3:], 4 * other[3:, 3:])


def test_the_covariance_is_that_of_repeated_fits():
    """Of the same events at times that are off by some ms, anew each time."""
    series, prior = data_of()
    rng = np.random.default_rng(0)
    rows, told = [], []
    for _ in range(8):
        tau = series.tau + 5e-3 * rng.normal(size=len(series.tau))
        noisy = series._replace(tau=tau)
        scene, _ = adjust(noisy, scene_of(fitted()), prior, 0.2, 1, 6)
        rows.append(np.concatenate([part[0] for part in scene.path.unit_twist(0.0)]))
        if len(told) < 2:  # they are alike
            told.append(np.diag(compute_covariance(noisy, scene, prior, sigma=0.2)))
    ratio = np.var(rows, 0, ddof=1).sum() / np.mean(told, 0).sum()
    assert 0.5**2 < ratio < 2**2, ratio


def test_steps_never_cost_more():
    """Beside true depths, with a sigma rather small for how far they are."""
    series, prior = data_of()
    rng = np.random.default_rng(0)
    depths = np.log(0.6) + 0.1 * rng.normal(size=series.nodes[0] * series.nodes[1])
    scene = Scene(true_path(depths), np.zeros(series.shape), 0.0)
    scene, first = adjust(series, scene, prior, 0.1, 3, 3)
    costs = [adjust(series, scene, prior, 0.1, 0, steps)[1].cost for steps in (1, 2, 4, 8, 16)]
    assert costs[-1] < 0.1 * first.cost
    assert (np.diff(costs) <= 1e-3 * np.array(costs[:-1])).all()


def test_priors_pull():
    series, _ = data_of()
    t = np.array([0, 300_000])
    wrong = OMEGA + [0.0, 0.2, 0.0]
    windows = WindowFitter(
        seen(), Params.of({**GIVEN, "gyro_std": 1e-5}), CAMERA,
        Twists(t, np.stack([wrong, wrong]), None, 0, 300_000),
    )  # fmt: skip
    prior = windows.prior(150_000, 0.15)
    scene, _ = adjust(series, scene_of(fitted()), prior, 0.1, 0, 8)
    np.testing.assert_allclose(scene.path.unit_twist(0.0)[1][0], wrong, atol=1e-2)
    covariance = compute_covariance(series, scene, prior, sigma=0.1)
    assert np.sqrt(np.diag(covariance)[3:]).max() < 1e-4


def test_a_recording_from_end_to_end(monkeypatch):
    """With fewer steps than `fitted`, which are enough to come near."""
    monkeypatch.setattr(hypotheses, "COARSE_TO_FINE_STAGES", (Stage(0.3, 4),))
    monkeypatch.setattr(hypotheses, "FINAL_STAGES", (Stage(0.1, 3),))
    monkeypatch.setattr(hypotheses, "PLANAR_STAGES", ())
    motion = sequence.batch.estimate(seen(), PARAMS)
    mean, covariance, valid = motion(motion.t[len(motion) // 2 :][:1])
    assert valid[0] and covariance.shape == (1, 6, 6)
    assert np.linalg.norm(mean[0, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos(mean[0, :3] @ T / np.linalg.norm(T))) < 15
    with pytest.warns(InputWarning, match="batch found no motion, all .* are lost; try another"):
        few = sequence.batch.estimate(seen()[0.0:0.01], PARAMS)
    assert not few.valid.any() and np.isfinite(few.mean).all()
    empty = dataclasses.replace(seen(), events=seen().events[:0])
    with pytest.warns(InputWarning, match="batch found no motion, as there are no events"):
        assert len(sequence.batch.estimate(empty, PARAMS)) == 0


def a_fit(path, cost, ambiguity=0.0):
    return WindowFit(path, np.eye(6), 1.0, cost, np.zeros((1, 1)), ambiguity)


def test_windows_that_disagree_are_less_sure():
    """By the mean square of differences halfway to the windows before and after."""
    turns = [np.array([0.0, 0, w]) for w in (0.0, 0.2, 0.1)]
    paths = [Path.constant_twist(np.array([0.0, 0, 1]), turn, np.zeros(1)) for turn in turns]
    paths[1].O[1, 2] = -2.0  # rad/s^2
    fits = [a_fit(path, 1.0) for path in paths]
    centres = np.array([0, 100_000, 200_000])
    told = sequence._disagreements(centres, [*fits], 150_000)
    before, after = 0.2 + 2.0 * 0.05 - 0.0, 0.1 - (0.2 - 2.0 * 0.05)
    expected = np.array([before**2, (before**2 + after**2) / 2, after**2])
    np.testing.assert_allclose([off[5, 5] for off in told], expected, atol=1e-12)
    assert all(np.abs(off[:5, :5]).max() < 1e-12 for off in told)
    for lost in ([fits[0], None, fits[2]], [fits[0]]):
        apart = sequence._disagreements(centres[: len(lost)], lost, 150_000)
        assert not np.any(apart)
    far = sequence._disagreements(10 * centres, [*fits], 150_000)
    assert not np.any(far)  # they share no events


def test_the_end_of_a_path_is_less_sure():
    """If no other window overlaps it, by its difference from the motion at the middle."""
    path = Path.constant_twist(np.array([0.0, 0, 1]), np.array([0, 0, 0.5]), np.zeros(1))
    path.O[1, 2] = -2.0  # rad/s^2
    fits, half = [a_fit(path, 1.0)._replace(covariance=np.eye(6) * 1e-4)] * 3, 150_000
    told = sequence._blend(np.arange(3) * 100_000, [*fits], half, 100_000, (-half, 2 * half))
    middle = np.abs(told.t - 100_000) < 100_000
    apart = told.covariance[middle, 5, 5] - 1e-4  # of the windows, which a ramp does not join
    lone = sequence._blend(np.zeros(1, int), fits[:1], half, 100_000, (-half, half))
    assert list(lone.t[[0, -1]]) == [-100_000, 100_000]
    grown = 1e-4 + (sequence.WINDOW_END_SIGMA_PER_CHANGE * 2.0 * lone.t * 1e-6) ** 2
    np.testing.assert_allclose(lone.covariance[:, 5, 5], grown)
    np.testing.assert_allclose(lone.covariance[:, :5, :5], np.tile(np.eye(5) * 1e-4, (11, 1, 1)))
    np.testing.assert_allclose(apart, (2.0 * 0.1) ** 2)
    short = sequence._blend(np.zeros(1, int), fits[:1], half, 100_000, (-4000, 4000))
    assert list(short.t) == [-4000, -2000, 0, 2000, 4000]
    first = told.covariance[told.t == -100_000, 5, 5]
    assert first > (sequence.WINDOW_END_SIGMA_PER_CHANGE * 0.2) ** 2
    # Where the camera is slower the same errors of its velocity turn the heading farther.
    path.D[1, 2] = -9.9  # 1/s^2, of |T| at the middle
    slower = sequence._blend(np.zeros(1, int), fits[:1], half, 100_000, (-half, half))
    pace = np.clip(1 - 9.9 * slower.t * 1e-6, 0.02 / np.pi * np.sqrt(3), 1)
    heading = np.diagonal(slower.covariance[:, :3, :3], axis1=1, axis2=2)
    np.testing.assert_allclose(heading, np.tile(1e-4 / pace[:, None] ** 2, 3), rtol=1e-6)
    np.testing.assert_allclose(slower.covariance[:, 5, 5], grown)
    path.D[1, 2] = -8.0  # it stands still after 1 / 8 s
    stops = path.unit_twist(np.array([0.0, 0.125]))[0]
    np.testing.assert_array_equal(stops, [[0, 0, 1], [0, 0, 0]])


def replace_fits(monkeypatch, fit, follow):
    """Replace the fits of windows by functions of centre and path; return their calls."""
    calls = []

    def fit_anew(self, centre, warm=None):
        calls.append(("anew", centre))
        return a_fit(*fit(centre, warm))

    def refine_from(self, centre, warm):
        return Scene(warm, np.full((), centre), 0.0), FitReport(0.0, 0.0, 0.0)

    def refine_final(self, centre, hypotheses, stages=()):
        ((scene, _),) = hypotheses
        assert scene.map == centre
        calls.append(("from", centre))
        return a_fit(*follow(centre, scene.path))

    monkeypatch.setattr(WindowFitter, "fit", fit_anew)
    monkeypatch.setattr(WindowFitter, "refine_from", refine_from)
    monkeypatch.setattr(WindowFitter, "refine_final", refine_final)
    return calls


def test_a_lost_or_ambiguous_path_is_not_followed(monkeypatch):
    path = true_path(np.zeros(4))
    # The third window costs much more, the cost of the sixth is unknown.
    costs = {2: 2 * sequence.LOST_COST_RATIO * 1e-3, 5: np.nan}
    calls = replace_fits(
        monkeypatch,
        lambda centre, warm: (path, 1e-3, 2.0 * (centre == first)),
        lambda centre, warm: (path, costs.get((centre - first) // 20_000, 1e-3)),
    )
    recording = seen()
    first = int(recording.events.t[0]) + 20_000
    short = {"half_window": 0.02, "step": 0.02, "fresh": 100}
    sequence.batch.estimate(recording, Params.of({**GIVEN, **short}))
    order = [f"{kind} {(centre - first) // 20_000}" for kind, centre in calls][:10]
    expected = "anew 0, anew 1, from 2, anew 2, from 3, from 4, from 5, anew 5, from 6, from 7"
    assert ", ".join(order) == expected


def test_new_starts_that_agree_are_made_less_often(monkeypatch):
    path = true_path(np.zeros(4))
    other = Path(path.O, -path.D, path.log_rho)
    found = iter([path, path, path, other, other, other])
    calls = replace_fits(
        monkeypatch,
        lambda centre, warm: (next(found), 1e-3),
        lambda centre, warm: (warm, 1e-3),
    )
    recording = seen()
    first = int(recording.events.t[0]) + 10_000
    short = {"half_window": 0.01, "step": 0.01, "fewest": 1, "fresh": 2}
    sequence.batch.estimate(recording, Params.of({**GIVEN, **short}))
    anew = [(centre - first) // 10_000 for kind, centre in calls if kind == "anew"]
    # 2 windows after the first, 4, 8, where they do not agree, again 2.
    assert anew == [0, 2, 6, 14, 16, 20]


@pytest.mark.parametrize("cheaper", ["all", "none", "the last two"])
def test_a_wrong_beginning_is_fitted_again(monkeypatch, cheaper):
    """New starts are followed back in time, as far as that costs less."""
    right = true_path(np.zeros(4))
    wrong = Path(right.O, -right.D, right.log_rho)
    recording = seen()
    first = int(recording.events.t[0]) + 50_000

    def follow(centre, warm):
        if float(warm.D[0] @ right.D[0]) < 0:
            return warm, 1e-3
        less = cheaper == "all" or (cheaper == "the last two" and centre > first)
        return warm, 5e-4 if less else 3e-3

    replace_fits(
        monkeypatch,
        lambda centre, warm: (wrong if warm is None else right, 1e-3),
        follow,
    )
    params = Params.of({**GIVEN, "half_window": 0.05, "step": 0.05, "fresh": 3})
    motion = sequence.batch.estimate(recording, params)
    at = np.searchsorted(motion.t, first + 50_000 * np.arange(4))
    along = motion.mean[at, :3] @ right.unit_twist(0.0)[0].ravel()
    assert (along > 0).tolist() == [cheaper == "all", *2 * [cheaper != "none"], True]


def test_what_cannot_be_estimated_is_refused():
    with pytest.raises(InputError, match="calibration"):
        sequence.batch.estimate(dataclasses.replace(seen(), camera=None), PARAMS)
    with pytest.raises(InputError, match="general"):
        sequence.batch.estimate(seen(), PARAMS, model="generl")


@pytest.mark.parametrize("is_used", [True, False])
def test_frames_of_another_clock_are_not_left_out_in_silence(monkeypatch, recwarn, is_used):
    events = np.arange(200)
    kept = Events(1000 * events, events % 20, events // 20, events % 2 == 0)
    stamps = 3600 * 10**6 + 10_000 * np.arange(3)
    frames = Frames(stamps, np.zeros((3, 15, 20), np.uint8), np.zeros(3, np.int64))
    camera = PinholeCamera(20.0, 20.0, 9.5, 7.0)
    recording = Recording("two clocks", 20, 15, kept, frames, camera=camera)

    def fit(*_):
        raise InterruptedError

    monkeypatch.setattr(sequence, "WindowFitter", fit)
    warnings.simplefilter("always")
    with pytest.raises(InterruptedError):
        sequence.batch.estimate(recording, sequence.batch.Params(frames=is_used))
    told = [str(one.message) for one in recwarn if "frames last from 3600" in str(one.message)]
    assert len(told) == is_used


def test_events_at_one_time_are_refused():
    n = np.arange(200)
    kept = Events(np.full(200, 7), n % 20, n // 20, n % 2 == 0)
    camera = PinholeCamera(20.0, 20.0, 9.5, 7.0)
    with pytest.raises(InputError, match="once: all 200 events are at one time, 7 us"):
        sequence.batch.estimate(Recording("once", 20, 15, kept, camera=camera))
