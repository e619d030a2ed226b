"""Frames whose brightness changes where no events tell of it."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from jaxevent.camera import UnknownResponse
from jaxevent.methods import find
from jaxevent.reconstruction.compensated import images, target_motion
from jaxevent.reconstruction.compensated.images import are_equally_bright
from jaxevent.reconstruction.compensated.robust_mean import InstantLayout
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import Sensor, simulate

mc = find("mc", "reconstruction")
HEIGHT, WIDTH, STAMPS = 48, 64, np.arange(5) * 50_000
BRIGHT = 2  # the frame that is brighter than all others


class Pane:
    """A texture that goes by below, before a wall that stands still."""

    size, duration = (WIDTH, HEIGHT), 0.26

    def intensity(self, t):
        y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
        x = x - np.where(y < HEIGHT // 2, 0, 60 * t)
        return 0.35 + 0.12 * np.sin(0.7 * x) * np.cos(0.5 * y) + 0.1 * np.sin(0.23 * x + 0.4 * y)


def brightened(recording):
    """The same with one brighter frame."""
    pictures = recording.frames.images.copy()
    pictures[BRIGHT] = (pictures[BRIGHT] * 1.25 + 20).clip(0, 250).astype(np.uint8)
    return dataclasses.replace(
        recording, frames=dataclasses.replace(recording.frames, images=pictures)
    )


@functools.cache
def pane():
    sensor = Sensor(
        frame_rate=20.0,
        exposure=1e-3,
        background_rate=0.0,
        hot_fraction=0.0,
        read_noise=0.5,
        response=UnknownResponse(),
    )
    return simulate(Pane(), sensor, 4, "pane")


def still(grey, moves=()):
    """A recording of frames, with events at the columns `moves`, between all frames."""
    x, y = (p.ravel().astype(np.uint16) for p in np.meshgrid(list(moves), range(HEIGHT)))
    t = np.linspace(1_000, STAMPS[-1], 4 * len(x)).astype(np.int64)
    events = Events(t, np.tile(x, 4), np.tile(y, 4), np.ones(len(t), bool))
    return Recording("still", WIDTH, HEIGHT, events, Frames(STAMPS, grey, np.zeros_like(STAMPS)))


def frame_brightness(recording):
    return images.FrameBrightness(recording, recording.frames.t, 0.3)


def test_frames_are_steady_unless_they_change_without_events():
    rng = np.random.default_rng(3)
    wall = rng.integers(40, 160, (1, HEIGHT, WIDTH)) + rng.integers(-3, 4, (5, HEIGHT, WIDTH))
    wall = wall.astype(np.uint8)
    assert frame_brightness(still(wall, [3])).is_steady(0, 200_000)
    brightness = frame_brightness(brightened(still(wall, [3])))
    assert not brightness.is_steady(0, 200_000)
    before, around, after = (0, 99_999), (50_000, 100_000), (100_001, 200_000)
    assert [brightness.is_steady(*span) for span in (before, around, after)] == [
        True,
        False,
        True,
    ]
    # Where events are everywhere the change may be that of the scene.
    assert frame_brightness(brightened(still(wall, range(0, WIDTH, 2)))).is_steady(0, 200_000)
    # What goes by without events is brighter here and darker there.
    passing = wall.astype(float)
    passing[BRIGHT] *= np.where(np.arange(WIDTH) < WIDTH // 2, 1.3, 1 / 1.3)
    assert frame_brightness(still(passing.astype(np.uint8), [3])).is_steady(0, 200_000)
    moving = wall.copy()
    moving[BRIGHT, :, : WIDTH // 2] += 50
    assert frame_brightness(still(moving, range(WIDTH // 2))).is_steady(0, 200_000)


def test_a_fading_light_is_not_steady_over_several_frames():
    # Of an interval it is below the limit, of all four above.
    wall = 110 + 40 * np.sin(np.arange(WIDTH)) * np.ones((5, HEIGHT, 1))
    level = np.log(wall / 255 + 0.3) - 0.02 * np.arange(5)[:, None, None]
    brightness = frame_brightness(still((255 * (np.exp(level) - 0.3)).astype(np.uint8), [3]))
    assert brightness.is_steady(0, 100_000)
    assert not brightness.is_steady(0, 200_000)


def test_light_that_all_events_show_is_told_from_motion():
    """Motion brightens some places and darkens others; light changes all of them alike."""
    rng = np.random.default_rng(0)
    texture = gaussian_filter(rng.standard_normal((192, 400)), 3, mode="wrap")
    moving = np.stack([texture[:, 7 * k : 7 * k + 256] for k in range(15)]) / texture.std()
    fading = -0.06 * np.arange(15)[:, None, None]
    assert are_equally_bright(moving)
    assert not are_equally_bright(moving + fading)
    assert are_equally_bright(moving + fading / 30)
    assert not are_equally_bright(0 * moving + fading)


def test_brightness_is_in_doubt_where_frames_differ_from_those_around():
    wall = np.full((5, HEIGHT, WIDTH), 100, np.uint8)
    assert frame_brightness(still(wall, [3])).variance(75_000) == 0
    wall[BRIGHT] = 145
    brightness = frame_brightness(still(wall, [3]))
    b = np.log((145 / 255 + 0.3) / (100 / 255 + 0.3))
    left_out = np.mean([(b / 2) ** 2, b**2, (b / 2) ** 2])  # frames 1 to 3, from their neighbours
    np.testing.assert_allclose(brightness.variance(75_000), left_out, rtol=1e-5)
    np.testing.assert_allclose(brightness.variance(62_500), 0.75 * left_out, rtol=1e-5)
    np.testing.assert_allclose(brightness.variance(250_000), left_out, rtol=1e-5)
    assert brightness.variance(100_000) == 0
    two = frame_brightness(still(wall, [3]).with_frames(slice(1, 3)))
    doubts = [two.variance(t) for t in (75_000, 62_500, 250_000, 0, 100_000)]
    np.testing.assert_allclose(doubts, b**2 * np.array([0.75, 0.75**2, 1, 1, 0]), rtol=1e-5)
    # An exposure that adapts evenly leaves nothing in doubt.
    wall = np.exp(np.linspace(-1, -0.4, 5))[:, None, None] * np.ones((5, HEIGHT, WIDTH))
    brightness = frame_brightness(still((255 * wall - 0.3 * 255).round().astype(np.uint8), [3]))
    assert not brightness.is_steady(0, 200_000) and brightness.variance(75_000) == 0


def test_smooth_part():
    image = np.random.default_rng(5).normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    got, reach = images.gaussian_blur(image), images.SMOOTH_PART_SIGMA_PX
    ones = gaussian_filter(np.ones((HEIGHT, WIDTH)), reach, mode="constant", truncate=8)
    for one, part in zip(image, got, strict=True):
        expected = gaussian_filter(one, reach, mode="constant", truncate=8) / ones
        np.testing.assert_allclose(part, expected, atol=1e-5)


def test_beyond_the_frames_brightness_is_that_of_the_nearest_along_trajectories():
    wall = np.full((5, HEIGHT, WIDTH), 100, np.uint8)
    wall[4] = 145
    b = np.log((145 / 255 + 0.3) / (100 / 255 + 0.3))
    brightness = frame_brightness(still(wall, [3]))
    offsets = [brightness.prior(t).offset for t in (-50_000, 100_000, 200_000, 225_000, 900_000)]
    np.testing.assert_allclose(offsets, [0, 0, 0, -b / 2, -b], rtol=1e-5)
    flipped = frame_brightness(still(wall[::-1], [3])).prior(-25_000).offset
    np.testing.assert_allclose(flipped, -b / 2, rtol=1e-5)
    wall[3] = 60  # which of the three is unusual is not determined
    assert frame_brightness(still(wall, [3])).prior(900_000).offset == 0
    # The point of a pixel was 3 px farther right in the nearest frame, at s = -1.
    frame, own = np.random.default_rng(2).normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    paths = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    paths[..., 0] = -3
    at, zero = np.arange(2, dtype=np.float32), np.zeros((), np.float32)
    common = np.zeros((2, 2), np.float32)
    layout = InstantLayout(at - 1, at * 0 + 1, 1 - at, at, common, *np.array([1, 0, 0, 0]))
    brightness = images.BrightnessPrior(np.float32(0.02), np.float32(-b))
    base, P = images.smooth_part_at_target(np.stack([frame, own]), layout, zero, paths, brightness)
    np.testing.assert_allclose(base[:, :-3], frame[:, 3:] - b, rtol=1e-6)
    np.testing.assert_allclose(P, 0.02, rtol=1e-6)
    between = layout._replace(after=np.array(1))
    base, _ = images.smooth_part_at_target(np.stack([frame, own]), between, zero, paths, brightness)
    np.testing.assert_array_equal(base, own)


@pytest.mark.slow
def test_images_between_frames_of_different_brightness(monkeypatch):
    recording = brightened(pane())
    mid = recording.frames.t
    t = np.array([(mid[BRIGHT] + mid[BRIGHT + 1]) // 2])
    params = mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
    level = np.log(Pane().intensity(t[0] * 1e-6) + 0.1)

    def error(image):
        L = np.log(image.reshape(HEIGHT, WIDTH) + 0.1)
        detail = (L - level) - images.gaussian_blur((L - level)[None])[0]
        return float((detail[HEIGHT // 2 + 4 : -4, 6:-6] ** 2).mean())

    video = mc.estimate(recording, params, progress=False)
    image, P, _ = video(t)
    # Its brightness is between those of both frames, which is in doubt.
    assert P.mean() > 0.2 * np.log(1.4) ** 2 / 4
    low, high = (recording.frames.intensity[k].mean() for k in (BRIGHT + 1, BRIGHT))
    assert low + 0.1 * (high - low) < image.mean() < high - 0.1 * (high - low)
    monkeypatch.setattr(target_motion.FrameBrightness, "is_steady", lambda *_: True)
    monkeypatch.setattr(target_motion, "are_equally_bright", lambda *_: True)
    unaware = mc.estimate(recording, params, progress=False)(t).mean
    assert error(image) < 0.5 * error(unaware)


@pytest.mark.slow
def test_white_between_white_frames_of_different_brightness():
    sound, factors = pane(), np.array([2.2, 2.6, 3.2, 2.2, 2.6, 2.2])
    grey = np.rint(factors[:, None, None] * sound.frames.images).clip(0, 255)
    frames = dataclasses.replace(sound.frames, images=grey.astype(np.uint8))
    recording = dataclasses.replace(sound, frames=frames)
    t = np.array([(frames.t[BRIGHT] + frames.t[BRIGHT + 1]) // 2])
    params = mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4)
    video = mc.estimate(recording, params, progress=False)
    target = video.trajectories(int(t[0]))
    assert target.smooth is not None
    image, P, _ = video(t)
    free = target_motion.fuse_target(params, target)
    free = target_motion.add_smooth_part(
        target, free, video.trajectories.brightness.prior(int(t[0]))
    )
    free = np.exp(np.asarray(free.L)) - 0.1
    white = (grey[BRIGHT : BRIGHT + 2] >= 255).all(0)
    lacking, left = (np.maximum(1 - one, 0)[white].sum() for one in (free, image[0]))
    assert left < 0.8 * lacking
    features, out = mc.prepare(recording, t, params)
    found = jax.jit(lambda p: mc.read(p, mc.run(p, features)[0], out))(params)
    np.testing.assert_allclose(found.mean.reshape(image.shape), image, atol=5e-3)
    np.testing.assert_allclose(found.covariance.reshape(P.shape), P, rtol=0.1, atol=1e-4)


@pytest.mark.slow
def test_frames_on_one_side_do_not_confirm_each_other():
    given = pane().with_frames(slice(0, 3))
    t = int(given.frames.t[-1]) + 40_000
    video = mc.estimate(
        given, mc.Params(c_on=0.2, c_off=0.18, I0=0.1, rho_ref=5e-4), progress=False
    )
    sources = video.sources(np.array([t]))
    assert sources["visible_after"].max() == 0 and sources["visible_before"].max() > 0.5
    assert sources["blend"].mean() < 0.5  # what is last references is no longer there
