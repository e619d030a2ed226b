"""Motion that all points have in common: its estimate, and images of a camera that is shaken."""

import functools

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from jaxevent.methods import find
from jaxevent.reconstruction.compensated import target_motion
from jaxevent.reconstruction.compensated.common_motion import estimate_common_motion
from jaxevent.reconstruction.compensated.instants import CommonMotion
from jaxevent.reconstruction.compensated.normal_equations import CostParams
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.trajectories import ImagePyramid, fit_path
from jaxevent.simulate import Sensor, simulate

COST = CostParams(*map(np.float32, (2e-4, 10, 40, 0.04, 0.1, 0.2)))
mc = find("mc", "reconstruction")


class Shaken:
    """A texture before a camera that is shaken at 8 Hz, or pans."""

    size, duration = (64, 48), 0.34
    reach, frequency = np.array([4.5, -3.0]), 8.0  # px, Hz

    def __init__(self, seed=0):
        noise = np.random.default_rng(seed).standard_normal((2, 128, 128))
        fine, coarse = (gaussian_filter(noise[k], s, mode="wrap") for k, s in enumerate((1.5, 5)))
        grain = fine / fine.std() + coarse / coarse.std()
        self.image = 0.06 + 0.8 / (1 + np.exp(-1.2 * grain))
        self.y, self.x = np.mgrid[:48, :64].astype(float)

    def displacement(self, t):
        """Return how far points have moved along x and y, px, (..., 2)."""
        return -self.reach * np.sin(2 * np.pi * self.frequency * np.asarray(t)[..., None])

    def velocity(self, t):
        turn = 2 * np.pi * self.frequency
        return -self.reach * turn * np.cos(turn * np.asarray(t)[..., None])

    def intensity(self, t):
        x, y = self.displacement(t)
        return map_coordinates(self.image, [self.y - y, self.x - x], order=3, mode="grid-wrap")


@functools.cache
def shaken():
    sensor = Sensor(c_on=0.15, c_off=0.15, frame_rate=25.0, exposure=2e-3, truth_rate=1.0)
    return simulate(Shaken(), sensor, 5, "shaken")


def images_along(displacement):
    """Return a pyramid of images that have moved by displacements (K, 2), px, with noise."""
    scene, rng = Shaken(2), np.random.default_rng(4)
    at = [[scene.y - y, scene.x - x] for x, y in displacement]
    L = np.log([map_coordinates(scene.image, one, order=3, mode="grid-wrap") for one in at])
    L = (L + rng.normal(0, 0.02, L.shape)).astype(np.float32)
    return ImagePyramid(L, np.full_like(L, 4e-4), 0.35)


def test_course_of_an_image_beside_a_parabola():
    s = np.linspace(-1, 1, 13, dtype=np.float32)
    t = (60_000 * (1 + s)).astype(np.int64)
    parabola = np.outer(s, [9.0, -4.0]) + np.outer(s**2, [-2.0, 3.0])
    assert estimate_common_motion(images_along(parabola), t, s, COST) is None
    shake = 3 * np.stack([np.sin(7 * s), np.cos(6 * s)], 1)
    found = estimate_common_motion(images_along(parabola + shake), t, s, COST)
    powers = np.stack([np.ones(13), s, s**2], 1)
    expected = shake - powers @ np.linalg.lstsq(powers, shake, rcond=None)[0]
    np.testing.assert_allclose(found.displacement, expected, atol=0.12)
    # Between the instants it is a smooth curve through them.
    moved = found.between(int(t[6]), t[[3, 6, 9]])
    np.testing.assert_allclose(moved, found.displacement[[3, 6, 9]] - found.displacement[6], 1e-5)


def test_velocity_of_a_course():
    t = np.arange(0, 100_001, 5_000)
    course = CommonMotion(t, np.stack([3 * np.sin(t * 4e-5), np.cos(t * 3e-5)], 1))
    expected = [3 * 40 * np.cos(2.0), -30 * np.sin(1.5)]
    np.testing.assert_allclose(course.velocity(50_000, 500), expected, rtol=0.01)


@pytest.mark.slow
def test_images_of_a_shaken_camera(monkeypatch):
    recording, source = shaken(), Shaken()
    t = np.array([110_000, 172_000, 189_000])
    truth = np.stack([source.intensity(one * 1e-6) for one in t])
    params = Params(c_on=0.1, c_off=0.1)  # of ln(I + 0.3)

    def error(images):
        return float(((np.asarray(images) - truth)[:, 5:-5, 5:-5] ** 2).mean())

    video = mc.estimate(recording, params, progress=False)
    ours = error(video(t).mean)
    # All points move with the velocity of the camera, of up to 270 px/s.
    flow = np.median(video.flow(t), (1, 2))
    assert np.abs(flow - source.velocity(t * 1e-6)).max() < 30
    # What is prepared for derivatives is the same.
    features, out = mc.prepare(recording, t, params)
    trajectory, _ = jax.jit(mc.run)(params, features)
    prepared = jax.jit(mc.read)(params, trajectory, out).mean.reshape(truth.shape)
    np.testing.assert_allclose(prepared, video(t).mean, atol=2e-3)
    aks = find("aks").estimate(recording, progress=False)
    monkeypatch.setattr(target_motion, "estimate_common_motion", lambda *_: None)
    alone = error(mc.estimate(recording, params, progress=False)(t).mean)
    assert ours < 0.3 * alone
    assert ours < 0.7 * error(aks(t).mean)


def test_a_path_that_explains_a_course():
    s = np.linspace(-0.8, 1, 7, dtype=np.float32)
    course = np.outer(s, [3.0, -1.5]) + np.outer(s**2, [0.5, 2.0])
    np.testing.assert_allclose(fit_path(s, course.astype(np.float32)), [3, -1.5, 0.5, 2], atol=1e-5)
