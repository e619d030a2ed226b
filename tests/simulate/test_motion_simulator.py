import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.ndimage import map_coordinates

from jaxevent import simulate as sim
from jaxevent.egomotion import twists_from_poses
from jaxevent.errors import InputError

pytestmark = pytest.mark.slow

SIZE = (64, 48)
SWINGING = sim.CameraMotion(
    (0.5, -0.3, 0.4, 0.6, -1.0, 0.5),
    slope=(0.3, 0.1, -0.2, 1.0, 0.4, -0.6),
    amplitude=(0.3, 0.2, -0.3, 0.5, 0.6, 0.4),
    frequency=(1.0, 1.3, 2.0, 1.7, 1.1, 1.9),
    phase=(0.3, 1.0, 2.0, -0.4, 0.1, 0.7),
)


def hat(xi):
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]])


def test_poses_integrate_the_twist():
    t = np.array([0.0, 1e-4, 0.0503, 0.3])

    def rate(t, P):
        return (P.reshape(4, 4) @ hat(SWINGING.twist(np.array([t]))[0])).ravel()

    solved = solve_ivp(rate, (0, 0.3), np.eye(4).ravel(), "DOP853", t, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(SWINGING.pose(t), solved.y.T.reshape(-1, 4, 4), atol=1e-10)


def test_truth_from_the_recorded_poses():
    box = sim.make_texture("noise", 0.05)
    world = sim.BoxWorld((-5, -5, -5), (5, 5, 5), box)
    for motion, tolerance in ((sim.CameraMotion(SWINGING.mean), 1e-6), (SWINGING, 2e-2)):
        source = sim.MovingCamera(world, motion, SIZE, 50, duration=0.3)
        twists = twists_from_poses(source.poses())
        T, Omega = source.twist(twists.t)
        assert twists.T is not None
        np.testing.assert_allclose(twists.T, T, atol=tolerance)
        np.testing.assert_allclose(twists.Omega, Omega, atol=tolerance)
    errors = []
    for rate in (100.0, 200.0):
        twists = twists_from_poses(source.poses(rate))
        errors.append(np.abs(twists.Omega - source.twist(twists.t)[1]).max())
    assert 3.5 < errors[0] / errors[1] < 4.5  # second order


def test_images_fit_poses_and_depth():
    _, source = sim.motion_scene("texture", seed=2, size=SIZE, focal=55, duration=0.1)
    source = dataclasses.replace(source, motion=SWINGING, duration=0.4)
    P0, P1 = source.pose(np.array([0.05, 0.35]))
    depth = source.depth(0.05)
    f, camera = 55, source.camera
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    point = (
        np.stack([(x - camera.cx) / f, (y - camera.cy) / f, np.ones(x.shape)], -1)
        * depth[..., None]
    )
    moved = np.linalg.inv(P1) @ P0
    there = (point @ moved[:3, :3].T + moved[:3, 3]).reshape(-1, 3)
    assert there[:, 2].min() > 0
    ray = there / there[:, 2:]
    level, seen = source.world.render(P1[:3, 3], ray @ P1[:3, :3].T, 1 / f)
    same = np.abs(seen - there[:, 2]) < 1e-6
    assert same.mean() > 0.85  # others are hidden at one of the two times
    difference = np.abs(level - np.log(source.intensity(0.05)).ravel())[same]
    assert np.quantile(difference, 0.8) < 1e-9  # beyond are outlines, drawn out over a pixel
    # Depths of the wall alone, by hand.
    plain = dataclasses.replace(source, world=dataclasses.replace(source.world, patches=()))
    np.testing.assert_allclose(plain.depth(0), 3.2, rtol=1e-12)


def test_planar_velocity():
    motion = sim.planar_motion((100, -60), 2, 200, slope=(30, 20), amplitude=(40, 10), phase=0.4)
    world = sim.BoxWorld((-9, -9, -1), (9, 9, 2), sim.make_texture("noise", 0.01))
    source = sim.MovingCamera(world, motion, SIZE)
    t = np.array([0.0, 0.13, 0.5])
    wave = np.sin(2 * np.pi * 2 * t + 0.4)[:, None]
    expected = np.array([100, -60]) + t[:, None] * [30, 20] + wave * [40, 10]
    np.testing.assert_allclose(source.velocity(t), expected, rtol=1e-12)
    T, Omega = source.twist((t * 1e6).astype(int))
    np.testing.assert_allclose(T[:, :2], -expected * 2 / 200)
    assert not Omega.any()
    for name, at_half in (("linear", 200.0), ("varying", 100.0)):
        _, truth = sim.motion_scene("planar", name, size=(16, 12), speed=100, duration=0.5)
        assert np.linalg.norm(truth.velocity(0.5)) == pytest.approx(at_half)


def test_flow_at_the_principal_point_of_general_motion():
    _, source = sim.motion_scene("wall", seed=1, size=SIZE, focal=50, duration=0.1)
    h, t = 1e-4, 0.05
    P = source.pose(np.array([t - h, t, t + h]))
    axis = source.world.render(P[1, :3, 3], P[1, :3, 2][None], 1 / 50)[1][0] * np.array([0, 0, 1.0])
    point = P[1, :3, :3] @ axis + P[1, :3, 3]
    x = []
    for pose in (P[0], P[2]):
        X = pose[:3, :3].T @ (point - pose[:3, 3])
        x.append(50 * X[:2] / X[2])
    np.testing.assert_allclose(source.velocity(t)[0], (x[1] - x[0]) / (2 * h), rtol=1e-5, atol=1e-5)


def test_events_of_a_moving_wave_are_on_time():
    # ln I = swing sin(2 pi u / wavelength) on the wall, u moving with the image.
    grain, swing, f, depth, speed = 0.01, 0.6, 200, 2.0, 150.0
    texels = np.arange(512)
    level = np.broadcast_to(swing * np.sin(2 * np.pi * texels / 64), (512, 512))
    world = sim.BoxWorld((-50, -50, -1), (50, 50, depth), sim.Texture(level, grain))
    motion = sim.planar_motion((speed, 0), depth, f, slope=(100, 0))
    source = sim.MovingCamera(world, motion, (12, 3), f, 0.5)
    events = sim.simulate_motion(source).events
    dark = sim.SENSORS["ideal"].dark_offset

    def theory(x, t):
        u = (x - 5.5) * depth / f - (speed * t + 50 * t**2) * depth / f
        return np.log(np.exp(swing * np.sin(2 * np.pi * u / (64 * grain))) + dark)

    assert len(events) > 300
    steepest = swing * 2 * np.pi / 64 * (speed + 50)
    number = 0
    for x, y in itertools.product(range(12), range(3)):
        mine = (events.x == x) & (events.y == y)
        t, p = events.t[mine] * 1e-6, events.p[mine]
        change = np.diff(theory(x, t))
        same = p[1:] == p[:-1]
        expected = np.where(p[1:], 0.2, -0.2)
        # Chords over at most 4 ms lie this far off, at either end.
        chord = swing * (2 * np.pi / 64 * 200) ** 2 * 4e-3**2 / 8
        assert np.abs(change - expected)[same].max() < 2 * (chord + 1e-6 * steepest)
        late = np.abs(change - expected)[same] / np.abs(np.gradient(theory(x, t), t))[1:][same]
        assert np.median(late) < 1e-4  # s
        number += same.sum()
    assert number > 150


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_events_move_as_the_truth_says(seed):
    recording, truth = sim.motion_scene("planar", seed=seed, size=SIZE, duration=0.1, speed=250)
    spectra = []
    for begin in range(4000, 100_000, 4000):
        now = recording.events[slice(*np.searchsorted(recording.events.t, [begin, begin + 4000]))]
        image = np.zeros(SIZE[::-1])
        np.add.at(image, (now.y, now.x), np.where(now.p, 1.0, -1.0))
        spectra.append(np.fft.fft2(np.pad(image, ((0, 48), (0, 64)))))
    # Images 24 ms apart, correlated.
    products = [b * a.conj() for a, b in zip(spectra[:-6], spectra[6:], strict=True)]
    peak = np.fft.ifft2(np.sum(products, axis=0)).real
    dy, dx = np.unravel_index(peak.argmax(), peak.shape)
    shift = (np.array([dx, dy]) + (64, 48)) % (128, 96) - (64, 48)
    np.testing.assert_allclose(shift, truth.velocity(0.05)[0] * 0.024, atol=0.8)


@pytest.mark.parametrize("name", sim.MOTION_SCENES)
def test_scenes(name):
    settings = {"size": (32, 24), "focal": 30, "duration": 0.06}
    recording, truth = sim.motion_scene(name, "varying", seed=4, **settings)
    again, _ = sim.motion_scene(name, "varying", seed=4, **settings)
    other, _ = sim.motion_scene(name, "varying", seed=5, **settings)
    for field in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(
            getattr(recording.events, field), getattr(again.events, field)
        )
    assert len(other.events) != len(recording.events) > 100
    assert recording.camera == truth.camera and recording.frames is not None
    assert len(recording.poses) == 13
    T, Omega = (
        np.linalg.norm(np.asarray(part)) for part in np.split(np.array(truth.motion.mean), 2)
    )
    low, high = {"planar": (200 / 15, 200 / 15), "rotation": (0, 0)}.get(name, (0.6, 1.0))
    assert low - 1e-9 <= T <= high + 1e-9
    low, high = {"planar": (0, 0), "rotation": (2, 2)}.get(name, (0.4, 1.8))
    assert low - 1e-9 <= Omega <= high + 1e-9
    amplitude = np.linalg.norm(truth.motion.amplitude[3:])
    assert amplitude == pytest.approx(0 if name == "planar" else 0.6 * Omega)
    depth = truth.depth(0.05)
    assert depth.shape == (24, 32) and depth.min() > 0.5


def test_noise_comes_from_the_sensor():
    noisy = dataclasses.replace(sim.SENSORS["ideal"], background_rate=50.0, truth_rate=1e-3)
    kwargs = {"size": (32, 24), "duration": 0.1, "speed": 20}
    quiet, _ = sim.motion_scene("planar", **kwargs)
    loud, _ = sim.motion_scene("planar", sensor=noisy, **kwargs)
    expected = 50 * 32 * 24 * 0.1
    assert abs(len(loud.events) - len(quiet.events) - expected) < 8 * np.sqrt(expected)


def test_frame_generator_against_interpolated_images():
    image = np.random.default_rng(8).normal(size=(9, 11))
    flow = np.array([[0.8, 0.6], [1.0, 0.0], [-0.3, 1.7], [0.0, -1.0]])
    recording, truth = sim.simulate_frame_events(flow, image, size=(10, 7), threshold=0.4, seed=3)
    np.testing.assert_allclose(truth, flow * 20_000)
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(flow, axis=0)])
    y, x = np.mgrid[:7, :10]
    matches = 0
    for x0, y0 in itertools.product(range(11), range(9)):
        shown = [
            map_coordinates(image, [y + y0 - py, x + x0 - px], order=1, mode="grid-wrap")
            for px, py in path
        ]
        change = np.diff(shown, axis=0)
        k, rows, columns = np.nonzero(np.abs(change) > 0.4)
        expected = np.stack([(k + 1) * 50, rows, columns, change[k, rows, columns] > 0])
        events = recording.events
        got = np.stack([events.t, events.y, events.x, events.p])
        got = got[:, np.lexsort(got[::-1])]
        matches += expected.shape == got.shape and np.array_equal(expected, got)
    assert matches == 1


def test_frame_generator_noise_and_seeds():
    flow = np.tile([0.8, 0.0], (20, 1))
    first, _ = sim.simulate_frame_events(flow, seed=1)
    again, _ = sim.simulate_frame_events(flow, seed=1)
    np.testing.assert_array_equal(first.events.x, again.events.x)
    assert 0.05 < len(first.events) / (20 * 32 * 32) < 0.9
    still, _ = sim.simulate_frame_events(np.zeros((20, 2)), noise=0.1, seed=1)
    assert abs(len(still.events) - 2048) < 5 * np.sqrt(2048)
    with pytest.raises(InputError, match="no event"):
        sim.simulate_frame_events(np.zeros((20, 2)))


def test_what_is_not_possible():
    with pytest.raises(InputError, match="no scene"):
        sim.motion_scene("walls")
    with pytest.raises(InputError, match="no motion"):
        sim.motion_scene("wall", "constnat")
    with pytest.raises(InputError, match="outside the world"):
        sim.motion_scene("wall", size=(16, 12), speed=500, duration=0.1)
    with pytest.raises(InputError, match="no texture"):
        sim.make_texture("nois", 0.1)
    with pytest.raises(InputError, match="slope of a camera's motion"):
        sim.CameraMotion(SWINGING.mean, slope=(np.nan, 0, 0, 0, 0, 0))
    with pytest.raises(InputError, match="finite px/frame"):
        sim.simulate_frame_events(np.zeros(3))
    source = sim.MovingCamera(
        sim.BoxWorld((-1, -1, -1), (1, 1, 1), sim.make_texture("noise", 0.1)),
        SWINGING,
        (16, 12),
        20,
    )
    with pytest.raises(InputError, match="known from 0"):
        source.twist(0.6)
