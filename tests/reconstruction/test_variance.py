"""Variances of `akf` and `aks`: the formula, event by event, and what it says of true errors."""

import dataclasses

import jax
import numpy as np
import oracles
import pytest

import jaxevent
from jaxevent.camera import UnknownResponse
from jaxevent.reconstruction.frames import EventTiming, FrameClock, FrameImages
from jaxevent.reconstruction.unseen import measure_flicker
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import SENSORS, MovingObjects, simulate


def random_recording(seed, exposure=0):
    rng = np.random.default_rng(seed)
    n, size = 60, (3, 4)
    t = np.sort(rng.integers(0, 50_000, n))
    y, x = (rng.integers(0, s, n).astype(np.uint16) for s in size)
    mid = np.array([4_000, 16_000, 30_000, 41_000])
    images = rng.integers(20, 236, (len(mid), *size)).astype(np.uint8)
    frames = Frames(mid, images, np.full(len(mid), exposure))
    return Recording("random", size[1], size[0], Events(t, x, y, rng.random(n) < 0.5), frames)


TIMES = np.array([500, 4_000, 9_000, 15_900, 20_001, 35_000, 40_999, 45_000])


@pytest.mark.parametrize("name", ["akf", "aks"])
def test_variance_equals_the_formula_pixel_by_pixel(name):
    recording, method = random_recording(1, exposure=2_000), jaxevent.METHODS[name]
    values = {"c_on": 0.13, "c_off": 0.09, "I0": 0.4, "frame_noise": 0.03, "error_change": 0.5}
    if name == "aks":
        values |= {"one_sided": False}
    params = method.Params(**values)
    images = method.estimate(recording, params)(TIMES, extrapolate=True)
    kernel = None
    if jax.dtypes.canonicalize_dtype(float) == np.float64:
        with jax.enable_x64(False):
            single = method.Params(**values)
            kernel = method.estimate(recording, single, compiler="numba")
            kernel = kernel(TIMES, extrapolate=True)
    expected, P = oracles.reconstruct(name, recording, params.values(), TIMES)
    np.testing.assert_allclose(images.mean, expected, rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(images.covariance, P, rtol=2e-6)
    if kernel is not None:
        np.testing.assert_allclose(kernel.covariance, P, rtol=2e-4)


def test_at_a_frame_the_variance_is_that_of_its_noise_and_the_filter():
    recording = random_recording(2)
    params = jaxevent.aks.Params(frame_noise=0.02, I0=0.5)
    image, variance, _ = jaxevent.aks.estimate(recording, params)(recording.frames.t[1:2])
    np.testing.assert_allclose(variance, (0.02 / (image + 0.5)) ** 2, rtol=1e-4)


def scene(seed, sensor):
    """A simulated recording, and every second frame's true image."""
    source = MovingObjects(size=(96, 72), duration=1.0, seed=seed, background=0.4 * (seed % 2))
    camera = dataclasses.replace(
        SENSORS[sensor], frame_rate=25.0, exposure=5e-4, exposure_samples=2,
        response=UnknownResponse(), read_noise=1.275,
    )  # fmt: skip
    recording = simulate(source, camera, seed)
    given = recording.with_frames(slice(0, None, 2))
    times = recording.frames.t[5:20:4]
    return given, times, np.stack([source.intensity(t * 1e-6) for t in times])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["akf", "aks"])
def test_variances_cover_true_errors_of_simulated_scenes(name):
    method, means = jaxevent.METHODS[name], []
    for seed, sensor in ((501, "davis"), (502, "poor")):
        given, times, truth = scene(seed, sensor)
        params = method.Params(c_on=0.07, c_off=0.065)
        image, variance, _ = method.estimate(given, params, progress=False)(times)
        z2 = (np.log(image + 1) - np.log(truth + 1)) ** 2 / variance
        means.append(z2.mean())
        assert (z2 < 9).mean() > 0.9
    assert 0.5 < np.mean(means) < 2 and 0.3 < min(means) <= max(means) < 2.5


def test_frame_noise_is_the_empirical_variance_of_a_still_scene():
    """Monte Carlo: halfway between noisy frames of a still scene half of their noise is left.

    The filter's own P falls as 1 / t while nothing happens; the error does not.
    """
    rng = np.random.default_rng(7)
    t = np.arange(0, 400_000, 40_000)
    images = np.clip(0.5 + 0.02 * rng.normal(size=(len(t), 40, 40)), 0, 1).astype(np.float32)
    none = Events(np.array([5]), *np.zeros((2, 1), np.uint16), np.array([True]))
    recording = Recording("still", 40, 40, none, Frames(t, images, np.zeros_like(t)))
    params = jaxevent.akf.Params(frame_noise=0.02, error_change=0.0, kappa=7e7)
    image, variance, _ = jaxevent.akf.estimate(recording, params)([0.06, 0.34])
    error = (np.log(image + 1) - np.log(1.5))[:, 1:]
    np.testing.assert_allclose(variance[:, 1:].mean((1, 2)), (error**2).mean((1, 2)), rtol=0.1)


def flicker_of(images, exposure=None):
    t = np.arange(len(images)) * 40_000
    frames = Frames(t, images.astype(np.uint8), np.zeros_like(t))
    none = Events(np.array([5]), *np.zeros((2, 1), np.uint16), np.array([True]))
    recording = Recording("wall", *images.shape[:0:-1], none, frames)
    clock = FrameClock.of(recording, EventTiming())
    return measure_flicker(FrameImages(recording, np.dtype(np.float32)), clock)


def test_flicker_is_the_squared_error_of_prediction_by_neighbours():
    wall = np.full((9, 80, 80), 100.0)
    assert flicker_of(wall) == 0
    wall[4] += 51  # of 255: one frame is brighter by 0.2
    predicted = np.array([0, 0, 0.1, 0.2, 0.1, 0, 0])  # of frames 1 to 7
    np.testing.assert_allclose(flicker_of(wall), (predicted**2).mean(), rtol=1e-5)
    np.testing.assert_allclose(flicker_of(wall[4:6]), 0.75 * 0.2**2, rtol=1e-5)
    wall[4] = 102
    assert flicker_of(wall) == 0  # less than what is told from noise
