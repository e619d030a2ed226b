"""Noise of events that frames contradict: closed forms, and images of faulty recordings."""

import functools

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from jaxevent.methods import find
from jaxevent.reconstruction.compensated.event_noise import (
    EventNoise,
    IntervalNoise,
    NoiseParams,
    inflate_variances,
    measure_noise,
)
from jaxevent.reconstruction.compensated.images import InstantImages
from jaxevent.reconstruction.compensated.normal_equations import CostParams, PackedImages
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.trajectories import choose_trajectories, pack_images
from jaxevent.reconstruction.compensated.warp import PathTimes
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import Sensor, simulate
from jaxevent.simulate.faults import FAULTS

HEIGHT, WIDTH = 60, 80
FRAMES = np.array([0, 40_000, 90_000])
PARAMS = Params(rho_ref=1e-9, share=1e-6, sigma_bg=1e-6)
mc = find("mc", "reconstruction")


class TrueImages(InstantImages):
    """Images at frames whose differences are those of events, and an error beside them."""

    image_shape, factors = (HEIGHT, WIDTH), None

    def __init__(self, change, variance):
        self.L = np.stack([np.zeros_like(change), change]).astype(np.float32)
        self.V = np.full((2, HEIGHT, WIDTH), variance, np.float32)

    def __call__(self, times):
        return self.L, self.V, np.ones_like(self.V)


@functools.cache
def drawn():
    """A recording of events at random, and the changes of log intensity that they report."""
    rng = np.random.default_rng(0)
    n = 4 * HEIGHT * WIDTH
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    p, t = rng.random(n) < 0.5, np.sort(rng.integers(1, 40_000, n))
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p)
    grey = np.full((3, HEIGHT, WIDTH), 0.5, np.float32)
    change = np.zeros((HEIGHT, WIDTH))
    np.add.at(change, (y, x), np.where(p, 0.2, -0.2))
    return Recording("drawn", WIDTH, HEIGHT, events, Frames(FRAMES, grey, 0 * FRAMES)), change


def event_noise(error=0.0, frames=FRAMES):
    recording, change = drawn()
    return EventNoise(recording, PARAMS, TrueImages(change + error, 1e-3), frames)


def measured(size_of_error, offset=0.0):
    """The noise where events explain the left half, and an error is added in the right one."""
    expected = 4 * (0.6 * 0.2) ** 2 + 2e-3  # the mean variance of the steps, and of two frames
    error = np.random.default_rng(1).normal(size=(HEIGHT, WIDTH))
    error *= size_of_error * np.sqrt(expected)
    error[:, : WIDTH // 2] = 0
    return event_noise(error + offset)(0), expected


def test_noise_is_the_ratio_of_squares():
    (factor, excess, trust), expected = measured(3.0)
    right = np.s_[10:-10, WIDTH // 2 + 20 : -8]
    np.testing.assert_allclose(np.median(factor[right]), 3.0**4, rtol=0.2)
    np.testing.assert_allclose(excess[right], (factor[right] - 1) * expected, rtol=0.15)
    left = np.s_[:, : WIDTH // 2 - 25]
    np.testing.assert_array_equal(factor[left], 1)
    np.testing.assert_array_equal(excess[left], 0)
    assert 0.4 < trust < 0.6  # in half of the image


def test_sound_events_and_brightness_are_no_noise():
    (factor, excess, trust), _ = measured(0.7, offset=0.5)
    np.testing.assert_array_equal(factor, 1)
    np.testing.assert_array_equal(excess, 0)
    assert trust == pytest.approx(1)


def test_variances_between_frames_grow():
    measure = event_noise()
    times = np.array([-5, 0, 10_000, 40_000, 65_000, 90_000, 99_000])
    interval, shape = measure.locate(times)
    np.testing.assert_array_equal(interval, [0, 0, 0, 1, 1, 1, 1])
    np.testing.assert_allclose(shape, [0.25, 0, 0.1875, 0, 0.25, 0, 0.25])
    factor = np.stack([np.full((2, 2), 3), np.full((2, 2), 5)]).astype(np.float32)
    noise = IntervalNoise(factor, 2 * factor, np.ones(2))
    V = np.full((7, 2, 2), 0.5, np.float32)
    found = inflate_variances(V, jax.tree.map(lambda values: values[interval], noise), shape)
    expected = [3.0, 0.5, 1.5 + 6 * 0.1875, 0.5, 5.0, 0.5, 5.0]
    np.testing.assert_allclose(found[:, 0, 0], expected, rtol=1e-6)
    for k in (0, 1):
        measure._cache[k] = jax.tree.map(lambda values, k=k: values[k], noise)
    measure.inflate(times, V)
    np.testing.assert_allclose(V, found, rtol=1e-6)
    assert event_noise(frames=FRAMES[:1]).trust(5) == 1


def test_trajectories_are_chosen_by_region():
    rng = np.random.default_rng(3)
    s = np.array([-1, -0.5, 0, 0.5, 1], np.float32)
    scene = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH + 20)), 1.5) * 3
    still = np.repeat(scene[None, :, :WIDTH], 5, 0)
    moving = np.stack([scene[:, 10 - k : 10 - k + WIDTH] for k in (-4, -2, 0, 2, 4)])
    L = np.where(np.arange(WIDTH) < WIDTH // 2, still, moving).astype(np.float32)
    images = PackedImages.of(pack_images(L, np.full_like(L, 1e-3)), PathTimes.without_common(s))
    cost = CostParams(*map(np.float32, (2e-4, 10, 40, 0.04, 0.1, 0.2)))
    resting = np.zeros((HEIGHT // 2, WIDTH // 2, 4), np.float32)
    going = resting.copy()
    going[..., 0] = 4
    chosen = choose_trajectories(images, (resting, going), cost, (1.0, 0.5))[..., 0]
    assert (chosen[3:-3, 3 : WIDTH // 4 - 5] == 0).all()
    assert (chosen[3:-3, WIDTH // 4 + 5 : -5] == 4).all()
    noisy = (L + rng.normal(size=L.shape) * 0.02).astype(np.float32)
    images = PackedImages.of(pack_images(noisy, np.full_like(L, 1e-3)), PathTimes.without_common(s))
    chosen = choose_trajectories(images, (resting, going), cost, (1.0, 1e-6))[..., 0]
    assert (chosen[3:-3, 5:-5] == 0).all()


class Slide:
    """A texture that slides by."""

    size, duration, velocity = (48, 40), 0.42, (70.0, -30.0)

    def __init__(self):
        noise = np.random.default_rng(5).normal(size=(80, 100))
        self.level = 2.5 * gaussian_filter(noise, 2.5)
        self.y, self.x = np.mgrid[20:60, 36:84].astype(float)

    def intensity(self, t):
        at = [self.y - self.velocity[1] * t, self.x - self.velocity[0] * t]
        return np.exp(-1.3 + map_coordinates(self.level, at, order=3, mode="nearest"))


@functools.cache
def sound():
    sensor = Sensor(
        frame_rate=20.0, exposure=1e-3, background_rate=0.1, hot_fraction=0.0, truth_rate=20.0
    )
    return simulate(Slide(), sensor, 3, "slide")


VALUES = Params(c_on=0.2, c_off=0.18, I0=0.03, rho_ref=5e-4, exposure=1e-3, margin=2.0)


@functools.cache
def faulty_video(fault):
    return mc.estimate(FAULTS[fault](sound(), 1), VALUES, progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["rows flipped", "half of the events dropped"])
def test_images_of_faulty_events_are_no_worse_than_of_frames(fault):
    t, truth = (sound().extra[name] for name in ("hdr_t", "hdr"))
    inner = np.flatnonzero((t > 60_000) & (t < 340_000))[:3]
    image, P, _ = faulty_video(fault)(t[inner])
    blend = find("blend").estimate(sound(), progress=False)(t[inner]).mean
    error = float(((image - truth[inner]) ** 2).mean())
    assert error < 0.2 * float(((blend - truth[inner]) ** 2).mean())
    z2 = np.log((image + 0.03) / (truth[inner] + 0.03)) ** 2 / P
    assert 0.1 < z2.mean() < 4


@pytest.mark.slow
def test_prepared_images_of_faulty_events_are_those_of_the_video():
    t, video = np.array([190_000]), faulty_video("rows flipped")
    features, out = mc.prepare(video.recording, t, VALUES)
    assert video.trajectories.event_noise(2).factor.max() > 10
    found = jax.jit(lambda p: mc.read(p, mc.run(p, features)[0], out))(VALUES)
    whole = video(t)
    np.testing.assert_allclose(found.mean.reshape(1, 40, 48), whole.mean, atol=2e-3)
    np.testing.assert_allclose(found.covariance.reshape(1, 40, 48), whole.covariance, rtol=0.1)


@pytest.mark.slow
def test_images_of_faulty_events_do_not_depend_on_others():
    t = np.array([130_000, 190_000])
    video = faulty_video("rows flipped")
    again = mc.estimate(video.recording, VALUES, progress=False)
    later, earlier = again(t[1:]).mean[0], again(t[:1]).mean[0]
    np.testing.assert_array_equal(video(t).mean, [earlier, later])


def test_frames_on_the_events_clock_count_before_the_first_event():
    recording, _ = drawn()
    images = InstantImages(recording, PARAMS.replace(clock_offset=-0.2), 1 << 14)
    assert images(FRAMES - 200_000)[2].all()


def test_noise_has_the_derivatives_of_its_differences():
    recording, change = drawn()
    error = 0.5 * np.random.default_rng(2).normal(size=change.shape)
    images = TrueImages(change + error, 1e-3)
    frames, noise = images(FRAMES[:2]), EventNoise(recording, PARAMS, images, FRAMES)
    names = ("c_on", "c_off", "sigma_event")
    events = noise.events(np.array([0]), FRAMES)
    np.testing.assert_array_equal(events.ends, [[0, 1]])

    def measure(values):
        params = PARAMS.replace(**dict(zip(names, values, strict=True)))
        return measure_noise(
            NoiseParams.of(params, jax.numpy.asarray),
            jax.tree.map(lambda image: image[None], frames),
            events.counts,
            events.seconds,
        )

    values = [getattr(PARAMS, name).item() for name in names]
    found = measure(jax.numpy.asarray(values))
    for one, other in zip(found, noise(0), strict=True):
        np.testing.assert_allclose(np.asarray(one)[0], other, rtol=1e-3, atol=1e-4)
    assert 1.5 < np.median(found.factor) < 100
    slopes = jax.jacfwd(lambda v: measure(v).excess.mean())(jax.numpy.asarray(values))
    for k, name in enumerate(names):
        ends = [
            EventNoise(recording, PARAMS.replace(**{name: v}), images, FRAMES)(0).excess.mean()
            for v in (values[k] * 1.01, values[k] * 0.99)
        ]
        slope = (ends[0] - ends[1]) / (0.02 * values[k])
        np.testing.assert_allclose(slopes[k], slope, rtol=0.02)


@pytest.mark.slow
def test_prepared_images_measure_the_noise_anew():
    """With other thresholds than those of `prepare` the noise is theirs, as a fit needs."""
    t, other = np.array([175_000]), VALUES.replace(c_on=0.6, c_off=0.6)
    read = jax.jit(lambda p, features, out: mc.read(p, mc.run(p, features)[0], out))
    prepared = mc.prepare(sound(), t, VALUES)
    before, found, anew = (
        np.median(np.log(read(values, *one).covariance))
        for values, one in (
            (VALUES, prepared),
            (other, prepared),
            (other, mc.prepare(sound(), t, other)),
        )
    )
    assert abs(found - anew) < 0.1 * (anew - before)
