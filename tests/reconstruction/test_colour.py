import dataclasses

import numpy as np
import pytest

from jaxevent import Events, Frames, InputError, Recording, blend
from jaxevent.camera import PinholeCamera, SCurve
from jaxevent.io.images import BAYER_PATTERNS
from jaxevent.reconstruction.colour import (
    apply_chrominance,
    chrominance,
    colour_video,
    join_channels,
    luminance,
    split_channels,
)


def colours(seed=0, shape=(5, 7)):
    return np.random.default_rng(seed).uniform(0.01, 0.95, (*shape, 3))


def test_luminance_is_rec_709():
    np.testing.assert_allclose(luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(luminance(np.ones((2, 2, 3))), 1, rtol=1e-15)
    assert luminance(np.ones((2, 3), np.float32)).dtype == np.float32


def test_chrominance_on_its_luminance_is_the_colour():
    rgb = colours()
    np.testing.assert_allclose(apply_chrominance(luminance(rgb), chrominance(rgb)), rgb, rtol=1e-13)
    hdr = 1000 * rgb
    again = apply_chrominance(luminance(hdr), chrominance(hdr, white=np.inf))
    np.testing.assert_allclose(again, hdr, rtol=1e-13)


def test_chrominance_has_luminance_1_even_where_it_fades():
    rgb = np.concatenate([colours(), np.ones((5, 2, 3)), np.zeros((5, 2, 3))], 1)
    rgb[0, :, 0] = np.linspace(0, 1, rgb.shape[1])
    np.testing.assert_allclose(luminance(chrominance(rgb, black=0.1)), 1, rtol=1e-13)


def test_hue_and_saturation_stay_at_every_luminance():
    rgb = colours()
    lit = apply_chrominance(np.full((5, 7), 37.0), chrominance(rgb))
    np.testing.assert_allclose(lit / lit.sum(-1, keepdims=True), rgb / rgb.sum(-1, keepdims=True))
    np.testing.assert_allclose(luminance(lit), 37)


def test_chrominance_of_grey_black_and_clipped_colours_is_1():
    grey = np.repeat(np.linspace(0, 1, 11)[:, None], 3, axis=1)
    np.testing.assert_allclose(chrominance(grey), 1, rtol=1e-13)
    np.testing.assert_array_equal(chrominance(np.array([1.0, 0.2, 0.4])), 1)
    np.testing.assert_array_equal(chrominance(np.array([2.0, 0.2, 0.4])), 1)
    np.testing.assert_array_equal(chrominance(np.zeros(3), black=0.1), 1)


def test_colour_fades_over_the_last_of_white_and_black():
    colour = np.array([0.99, 0.3, 0.1])  # half way through the last 2 % below white
    full = colour / luminance(colour)
    np.testing.assert_allclose(chrominance(colour), (full + 1) / 2)
    np.testing.assert_allclose(chrominance(colour / 10, black=0.396), (full * 0.25 + 0.75))
    np.testing.assert_allclose(chrominance(colour, white=0.99), 1)


def test_colours_that_are_none_are_refused():
    with pytest.raises(InputError, match="linear floats"):
        chrominance(np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="linear floats"):
        luminance(np.zeros((4, 4)))
    with pytest.raises(InputError, match="shape"):
        apply_chrominance(np.zeros((4, 5)), np.ones((4, 4, 3)))


def scene(rgb, extra=None) -> Recording:
    """A recording of frames 0.1 s apart whose grey images are the colours' luminance; no events."""
    frames = np.clip(luminance(rgb / 255), 0, 1)
    t = 100_000 * np.arange(1, len(rgb) + 1)
    exposure = np.zeros_like(t)
    extra = {"rgb": rgb, **(extra or {})}
    height, width = rgb.shape[1:3]
    frames = Frames(t, frames, exposure)
    return Recording("garden", width, height, Events.empty(), frames, extra=extra)


def random_frames(count=4, shape=(6, 8)):
    return np.random.default_rng(1).integers(20, 240, (count, *shape, 3), dtype=np.uint8)


def test_colour_video_of_the_frames_is_the_frames():
    rgb = random_frames()
    recording = scene(rgb)
    video = blend.estimate(recording)
    got = colour_video(video, recording)(recording.frames.t[[2, 0, 3, 1]])
    assert got.shape == (4, 6, 8, 3) and got.dtype == video(0.1).mean.dtype
    np.testing.assert_allclose(got, rgb[[2, 0, 3, 1]] / 255, rtol=2e-5)


def test_chrominance_is_linear_between_frames_and_constant_outside():
    rgb = random_frames()
    recording = scene(rgb)
    video = blend.estimate(recording)
    chroma = chrominance(rgb / 255)
    times = np.array([0.05, 0.125, 0.375, 0.45])
    expected = [chroma[0], 0.75 * chroma[0] + 0.25 * chroma[1], 0.25 * chroma[2] + 0.75 * chroma[3]]
    image = video(times, extrapolate=True).mean
    expected = image[..., None] * np.stack([*expected, chroma[3]])
    got = colour_video(video, recording)(times, extrapolate=True)
    np.testing.assert_allclose(got, expected, rtol=2e-5)
    np.testing.assert_allclose(luminance(got), image, rtol=1e-6)


def test_colours_follow_the_clock_of_the_frames():
    rgb = random_frames()
    recording = scene(rgb)
    video = blend.estimate(recording, blend.Params(clock_offset=0.03))
    got = colour_video(video, recording)(recording.frames.t + 30_000)
    np.testing.assert_allclose(got / luminance(got)[..., None], chrominance(rgb / 255), rtol=2e-5)


def test_clipped_pixels_are_grey_and_the_response_is_undone():
    camera = SCurve(50, 6.0)
    rgb = random_frames()
    rgb[:, 0, 0] = [255, 90, 130]
    rgb[:, 0, 1] = [0, 2, 0]
    recording = scene(rgb, {"response": np.asarray(camera.table())})
    got = colour_video(blend.estimate(recording), recording)(0.2)[0]
    np.testing.assert_array_equal(got[0, 0], got[0, 0, 0])
    # Two of the three levels in which black fades: part of a pure green.
    black = float(camera.intensity(2 / 255) / camera.intensity(3 / 255))
    np.testing.assert_allclose(np.ptp(got[0, 1] / luminance(got[0, 1])), black / 0.7152, rtol=1e-4)
    linear = np.asarray(camera.intensity(rgb[1] / 255))
    chroma = got / luminance(got)[..., None]
    np.testing.assert_allclose(chroma[1:], chrominance(linear)[1:], rtol=3e-5)


@pytest.mark.parametrize(
    ("rgb", "message"),
    [
        (None, "no colour frames"),
        (random_frames(3), "leave out the same of rgb"),
        (random_frames().astype(np.float32), "uint8"),
        (random_frames()[..., :2], "uint8"),
    ],
)
def test_colour_frames_that_do_not_fit_are_refused(rgb, message):
    recording = scene(random_frames())
    video = blend.estimate(recording)
    extra = {} if rgb is None else {"rgb": rgb}
    with pytest.raises(InputError, match=f"garden: .*{message}"):
        colour_video(video, dataclasses.replace(recording, extra=extra))
    with pytest.raises(InputError, match="garden: holds no frames"):
        colour_video(video, dataclasses.replace(recording, frames=None))
    with pytest.raises(InputError, match="the video 8x6"):
        colour_video(video, scene(random_frames(shape=(4, 4))))


def mosaic(rgb, pattern):
    """Sample colour images (T, H, W, 3) as a sensor of that pattern does."""
    out = np.empty(rgb.shape[:3], rgb.dtype)
    for y in range(rgb.shape[1]):
        for x in range(rgb.shape[2]):
            out[:, y, x] = rgb[:, y, x, "RGB".index(pattern[2 * (y % 2) + x % 2])]
    return out


def sensor(images, events=1000, **kwargs) -> Recording:
    _, height, width = images.shape
    rng = np.random.default_rng(3)
    t = np.sort(rng.integers(0, 1_000_000, events))
    x, y = (rng.integers(0, side, events).astype(np.uint16) for side in (width, height))
    stream = Events(t, x, y, rng.random(events) < 0.5)
    times = 1000 * np.arange(len(images))
    return Recording(
        "street", width, height, stream, Frames(times, images, 0 * times), **kwargs
    ).check()


def channel_images(parts):
    return {name: part.frames.images for name, part in parts.items()}


@pytest.mark.parametrize("pattern", BAYER_PATTERNS)
def test_colours_survive_splitting_and_joining(pattern):
    y, x = np.mgrid[:8, :10]
    rgb = np.stack([0.1 + 0.02 * x + 0.03 * y, 0.9 - 0.05 * x + 0.01 * y, 0.04 * y], -1)[None]
    parts = split_channels(sensor(mosaic(rgb, pattern)), pattern)
    got = join_channels(channel_images(parts), pattern)
    np.testing.assert_allclose(got[:, 1:-1, 1:-1], rgb[:, 1:-1, 1:-1], atol=1e-14)
    assert got.min() >= rgb.min() and got.max() <= rgb.max()
    even = np.broadcast_to([0.3, 0.7, 0.1], (2, 8, 10, 3))
    parts = split_channels(sensor(mosaic(even, pattern)), pattern)
    assert list(parts) == ["R", "G1", "G2", "B"]
    np.testing.assert_allclose(join_channels(channel_images(parts), pattern), even, rtol=1e-15)


@pytest.mark.parametrize("pattern", BAYER_PATTERNS)
def test_joining_keeps_what_the_sites_read(pattern):
    images = np.random.default_rng(2).random((2, 6, 8), np.float32)
    parts = split_channels(sensor(images), pattern)
    rgb = join_channels(channel_images(parts), pattern)
    assert rgb.dtype == np.float32
    np.testing.assert_allclose(mosaic(rgb, pattern), images, rtol=1e-6)


@pytest.mark.parametrize("pattern", BAYER_PATTERNS)
def test_every_event_goes_to_the_channel_of_its_site(pattern):
    recording = sensor(np.zeros((1, 6, 8), np.uint8))
    parts = split_channels(recording, pattern)
    events = recording.events
    assert sum(len(part.events) for part in parts.values()) == len(events)
    places = {name: pattern.index(name) for name in "RB"}
    places["G1"], places["G2"] = pattern.index("G"), pattern.rindex("G")
    for name, part in parts.items():
        part.check()
        assert (part.width, part.height, part.name) == (4, 3, f"street {name}")
        row, column = divmod(places[name], 2)
        own = (events.x % 2 == column) & (events.y % 2 == row)
        np.testing.assert_array_equal(part.events.t, events.t[own])
        np.testing.assert_array_equal(2 * part.events.x + column, events.x[own])
        np.testing.assert_array_equal(2 * part.events.y + row, events.y[own])
        np.testing.assert_array_equal(part.events.p, events.p[own])


def test_calibration_and_extras_are_those_of_the_sites():
    images = np.arange(48, dtype=np.uint8).reshape(1, 6, 8)
    camera = PinholeCamera(100.0, 90.0, 3.5, 2.5, (0.1, 0.2, 0.3, 0.4, 0.5))
    extra = {
        "HDR_mat": 2.0 * images[0],
        "ct": np.float64(0.1),
        "response": np.linspace(0, 1, 256),
        "rgb": np.zeros((1, 6, 8, 3), np.uint8),
    }
    parts = split_channels(sensor(images, camera=camera, extra=extra))
    blue = parts["B"]
    assert set(blue.extra) == {"HDR_mat", "ct", "response"}
    np.testing.assert_array_equal(blue.extra["HDR_mat"], 2.0 * images[0, 1::2, 1::2])
    # A ray that meets the sensor at pixel (5, 3) meets the blue channel at its pixel (2, 1).
    X, Y = (5 - camera.cx) / camera.fx, (3 - camera.cy) / camera.fy
    own = blue.camera
    np.testing.assert_allclose([own.fx * X + own.cx, own.fy * Y + own.cy], [2, 1])
    assert own.distortion == camera.distortion
    np.testing.assert_array_equal(blue.events.x, split_channels(sensor(images))["B"].events.x)


def test_a_recording_without_frames_and_calibration_is_split():
    recording = dataclasses.replace(sensor(np.zeros((1, 4, 4), np.uint8)), frames=None)
    assert all(p.frames is None and p.camera is None for p in split_channels(recording).values())


@pytest.mark.parametrize("pattern", ["RGBW", "RWWB", "RGB", "rggb", "RRGB", ""])
def test_other_patterns_are_refused(pattern):
    with pytest.raises(InputError, match="RGGB, BGGR, GRBG, GBRG"):
        split_channels(sensor(np.zeros((1, 4, 4), np.uint8)), pattern)
    with pytest.raises(InputError, match="RGGB, BGGR, GRBG, GBRG"):
        join_channels({}, pattern)


@pytest.mark.parametrize("shape", [(1, 5, 4), (1, 4, 5)])
def test_odd_sensors_are_refused(shape):
    with pytest.raises(InputError, match="odd"):
        split_channels(sensor(np.zeros(shape, np.uint8)))


def test_channels_that_do_not_fit_are_refused():
    image = np.zeros((1, 2, 3))
    with pytest.raises(InputError, match="channel B is missing"):
        join_channels({"R": image, "G1": image, "G2": image})
    with pytest.raises(InputError, match="shapes"):
        join_channels({"R": image, "G1": image, "G2": image, "B": image[:, :1]})
    with pytest.raises(InputError, match="shapes"):
        join_channels({name: image[0] for name in ("R", "G1", "G2", "B")})
