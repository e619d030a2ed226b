import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import jaxevent
from jaxevent import simulate as sim
from jaxevent.camera import SCurve, UnknownResponse
from jaxevent.show.images import video_writer

pytestmark = pytest.mark.slow

IDEAL = sim.SENSORS["ideal"]
DARK = IDEAL.dark_offset


class Wave:
    """Pixels whose ln(I + DARK) is drift t + swing sin(2 pi f t + pixel), about `base`."""

    def __init__(self, swing, f, drift=0.0, base=-1.0, size=(3, 2), duration=0.5):
        self.swing, self.f, self.drift, self.base = swing, f, drift, base
        self.size, self.duration = size, duration

    def level(self, t, pixel):
        return self.base + self.drift * t + self.swing * np.sin(2 * np.pi * self.f * t + pixel)

    def intensity(self, t):
        pixel = np.arange(self.size[0] * self.size[1], dtype=float)
        return (np.exp(self.level(t, pixel)) - DARK).reshape(self.size[::-1])


def pixels_of(recording):
    """t (us) and s (+-1) of each pixel's events."""
    events = recording.events
    for y, x in itertools.product(range(recording.height), range(recording.width)):
        mine = (events.x == x) & (events.y == y)
        yield events.t[mine], np.where(events.p[mine], 1, -1)


@settings(max_examples=12)
@given(
    swing=st.floats(0.3, 2.0),
    f=st.floats(0.5, 6.0),
    c_on=st.floats(0.08, 0.4),
    c_off=st.floats(0.08, 0.4),
    seed=st.integers(0, 100),
)
def test_ideal_events_are_one_threshold_apart(swing, f, c_on, c_off, seed):
    wave = Wave(swing, f)
    recording = sim.simulate(wave, dataclasses.replace(IDEAL, c_on=c_on, c_off=c_off), seed)
    steepest = 2 * np.pi * f * swing * 1e-6  # per us; and chords of at most 4 ms
    tolerance = 2 * steepest + (2 * np.pi * f) ** 2 * swing * 4e-3**2 / 4
    for pixel, (t, s) in enumerate(pixels_of(recording)):
        change = np.where(s > 0, c_on, -c_off)
        level = wave.level(t * 1e-6, pixel)
        assert np.abs(np.diff(level) - change[1:]).max(initial=0) < tolerance
        whole = wave.level(wave.duration, pixel) - wave.level(0.0, pixel)
        assert abs(change.sum() - whole) < c_on + c_off + tolerance


@pytest.mark.parametrize("drift", [40.0, -25.0])
def test_dead_time_stretches_gaps_and_its_correction_inverts_it(drift):
    rho, c = 2e-3, 0.1
    sensor = dataclasses.replace(IDEAL, c_on=c, c_off=c, refractory=rho)
    wave = Wave(0.0, 1.0, drift, base=-5.0 if drift > 0 else 3.0, duration=0.2)
    for t, s in pixels_of(sim.simulate(wave, sensor)):
        dt = np.diff(t) * 1e-6
        assert len(dt) > 30 and (s == np.sign(drift)).all()
        np.testing.assert_allclose(dt, c / abs(drift) + rho, atol=2e-6)
        corrected = (s[1:] * c * dt / (dt - rho)).sum()
        np.testing.assert_allclose(corrected, drift * (t[-1] - t[0]) * 1e-6, rtol=2e-4)


@pytest.fixture(scope="module")
def recording():
    source = sim.Pan(sim.scene("lake", size=(240, 160)), (40, 30), 0.6, "fast")
    return source, sim.simulate(source, sim.SENSORS["davis"], seed=3)


def test_no_event_within_the_dead_time(recording):
    # Noise events are dead as long as others.
    sensor = sim.Sensor(refractory=7e-4, background_rate=50.0, hot_fraction=0.01, hot_rate=2e3)
    noisy = sim.simulate(recording[0], sensor)
    gaps = np.concatenate([np.diff(t) for t, _ in pixels_of(noisy)])
    assert gaps.min() == 700 and len(gaps) > 10000


def test_recording_is_sound_and_truth_is_the_source(recording):
    source, recording = recording
    assert recording.check() is recording
    assert (recording.width, recording.height) == (40, 30)
    assert 0 <= recording.events.t[0] and recording.events.t[-1] <= 600_000
    extra, frames = recording.extra, recording.frames
    assert frames.images.dtype == np.uint8 and len(frames) == 30
    assert (frames.exposure == 5000).all() and (np.diff(frames.t) == 20_000).all()
    t = extra["hdr_t"]
    assert t.dtype == np.int64 and (np.diff(t) > 0).all() and t[0] >= 200_000 and t[-1] < 600_000
    assert not np.isin(t, frames.t).any() and len(t) == 12
    for k in (0, 5, -1):
        np.testing.assert_allclose(extra["hdr"][k], source.intensity(t[k] * 1e-6), rtol=1e-6)
    for name in ("c_on", "c_off", "dark_offset", "refractory"):
        assert extra[name] == getattr(sim.SENSORS["davis"], name)
    assert (extra["gain"] == 1).all()
    # The tables serve as the response: a grey level's intensity, and where it says nothing.
    np.testing.assert_allclose(recording.response.intensity(np.array(0.5)), 0.5, atol=1e-6)
    low, high = extra["clip"]
    assert extra["response"][2] < low < extra["response"][3]
    assert extra["response"][252] < high < extra["response"][253]


def test_the_seed_decides_everything(recording):
    source, first = recording
    again = sim.simulate(source, sim.SENSORS["davis"], seed=3)
    other = sim.simulate(source, sim.SENSORS["davis"], seed=4)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(again.events, name), getattr(first.events, name))
    np.testing.assert_array_equal(again.frames.images, first.frames.images)
    assert again.extra.keys() == first.extra.keys()
    for name, values in first.extra.items():
        np.testing.assert_array_equal(again.extra[name], values)
    assert len(other.events) != len(first.events)
    assert (other.frames.images != first.frames.images).any()
    assert (other.extra["hdr_t"] != first.extra["hdr_t"]).all()


def test_recording_survives_a_file(recording, tmp_path):
    recording = recording[1]
    jaxevent.save(recording, tmp_path / "sim.h5")
    loaded = jaxevent.load(tmp_path / "sim.h5")
    np.testing.assert_array_equal(loaded.events.t, recording.events.t)
    np.testing.assert_array_equal(loaded.frames.images, recording.frames.images)
    assert loaded.extra.keys() == recording.extra.keys()
    for name, values in recording.extra.items():
        assert loaded.extra[name].dtype == values.dtype
        np.testing.assert_array_equal(loaded.extra[name], values)


def test_noise_free_frames_are_the_mean_over_the_exposure():
    # ln(I + DARK) = base + drift t: the mean of I over an exposure is known.
    wave = Wave(0.0, 1.0, drift=6.0, base=-3.0)
    sensor = dataclasses.replace(IDEAL, exposure=0.01, exposure_samples=50)
    recording = sim.simulate(wave, sensor)
    images = np.asarray(recording.frames.images)
    for t, image in zip(recording.frames.t * 1e-6, images, strict=True):
        ends = np.exp(-3 + 6 * (t + np.array([-0.005, 0.005])))
        mean = (ends[1] - ends[0]) / 6 / 0.01 - DARK
        levels = np.array([image[0, 0] - 0.501, image[0, 0] + 0.501]) / 255
        low, high = SCurve().intensity(levels.clip(0, 1))
        assert (image == image[0, 0]).all() and low < mean < high
    assert images[0, 0, 0] < 10 < 200 < images[-1, 0, 0]


def test_frame_noise_is_that_of_reading_and_of_light():
    sensor = dataclasses.replace(
        IDEAL, response=UnknownResponse(), read_noise=1.5, full_well=2000.0
    )
    wave = Wave(0.0, 1.0, base=np.log(0.5 + DARK), size=(80, 60), duration=0.1)
    images = sim.simulate(wave, sensor).frames.images.astype(float)
    assert abs(images.mean() - 127.5) < 0.1
    expected = 1.5**2 + 255**2 * 0.5 / 2000 + 1 / 12
    assert abs(images.var() / expected - 1) < 0.04


@pytest.mark.parametrize("light", [4.0, 0.02])
def test_automatic_exposure_approaches_mid_grey_and_tells_its_gain(light):
    wave = Wave(0.0, 1.0, base=np.log(light + DARK), duration=0.6)
    sensor = dataclasses.replace(IDEAL, auto_exposure=True)
    recording = sim.simulate(wave, sensor)
    gain, grey = recording.extra["gain"], np.asarray(recording.frames.images)[:, 0, 0]
    assert gain[0] == 1 and abs(grey[0] / 255 - 0.5) > 0.4
    seen = np.asarray(SCurve().grey(gain * light)) * 255
    np.testing.assert_allclose(grey, seen, atol=0.51)
    if light > 1:
        assert abs(grey[-1] / 255 - 0.45) < 0.01
        np.testing.assert_allclose(recording.extra["response"][grey[-1]] / gain[-1], light, 0.01)
    else:
        assert grey[-1] > 40 and (np.diff(gain) >= 0).all() and gain.max() == 16


def test_background_events_are_poisson_and_hot_pixels_are_named():
    sensor = sim.Sensor(background_rate=20.0, hot_fraction=0.01, hot_rate=200.0, refractory=0)
    still = Wave(0.0, 1.0, size=(40, 30), duration=1.5)
    recording = sim.simulate(still, sensor, seed=1)
    counts = np.zeros((30, 40))
    np.add.at(counts, (recording.events.y, recording.events.x), 1)
    x, y = recording.extra["hot"].T
    assert len(set(zip(x, y, strict=True))) == 12
    hot = counts[y, x]
    assert abs(hot.mean() - 300) < 5 * np.sqrt(300 / 12)
    counts[y, x] = np.nan
    assert abs(np.nanmean(counts) - 30) < 5 * np.sqrt(30 / 1188)
    assert abs(np.nanvar(counts) / 30 - 1) < 0.25
    on = recording.events.p.mean()
    assert abs(on - 0.5) < 5 * 0.5 / np.sqrt(len(recording.events))
    assert len(sim.simulate(still, IDEAL).events) == 0


def test_thresholds_differ_from_pixel_to_pixel_as_told():
    # Under a constant drift a pixel's threshold is the drift times the gap.
    sensor = dataclasses.replace(IDEAL, c_on=0.1, mismatch=0.05)
    wave = Wave(0.0, 1.0, drift=30.0, base=-5.0, size=(20, 20), duration=0.2)
    c = np.array([30 * np.diff(t).mean() * 1e-6 for t, _ in pixels_of(sim.simulate(wave, sensor))])
    assert abs(c.mean() / 0.1 - 1) < 0.01 and abs(c.std() / c.mean() - 0.05) < 0.01


def test_clock_offset_moves_the_stamps_alone(recording):
    source = recording[0]
    late = dataclasses.replace(sim.SENSORS["davis"], clock_offset=0.004)
    moved = sim.simulate(source, late, seed=3)
    np.testing.assert_array_equal(moved.frames.t + 4000, recording[1].frames.t)
    np.testing.assert_array_equal(moved.frames.images, recording[1].frames.images)
    np.testing.assert_array_equal(moved.events.t, recording[1].events.t)
    assert moved.extra["clock_offset"] == 0.004


def test_jitter_keeps_order_and_range(recording):
    jittered = sim.simulate(recording[0], sim.SENSORS["poor"]).check()
    assert 0 <= jittered.events.t[0] and jittered.events.t[-1] <= 600_000


def test_perfect_events_reconstruct_what_the_frames_resolve():
    source = sim.Pan(sim.scene("mountain", 3.0, (160, 120)), (40, 30), 0.5, "fast")
    recording = sim.simulate(source, dataclasses.replace(IDEAL, c_on=0.1, c_off=0.1))
    extra = recording.extra
    common = {"c_on": 0.1, "c_off": 0.1, "I0": DARK}
    truth = np.log(extra["hdr"] + DARK)
    seen = (extra["hdr"] > 0.1) & (extra["hdr"] < 0.9)
    assert seen.mean() > 0.15

    def error(method, where, **more):
        params = method.Params(**common, **more)
        image = method.estimate(recording, params)(extra["hdr_t"]).mean
        return np.sqrt(np.mean((np.log(np.maximum(image, 0) + DARK) - truth)[where] ** 2))

    frames = recording.frames
    last = np.searchsorted(frames.t, extra["hdr_t"]) - 1
    held = np.log(extra["response"][np.asarray(frames.images)[last]] + DARK) - truth
    # Between frames events go on where they stop; where frames clip the filter keeps to events.
    assert error(jaxevent.edi, seen) < 0.25 * np.sqrt((held[seen] ** 2).mean())
    akf = error(jaxevent.akf, np.ones_like(seen), kappa=3e4, w_min=1e-5, P0=1.0)
    assert akf < 0.2 * np.sqrt((held**2).mean())


def test_scenes_span_what_they_say_and_differ():
    panoramas = {name: sim.scene(name, size=(240, 160)) for name in sim.SCENES}
    assert len(panoramas) >= 6 and set(sim.FITTING_SCENES) | set(sim.TESTING_SCENES) == set(
        panoramas
    )
    for name, panorama in panoramas.items():
        assert panorama.shape == (160, 240)
        darkest, brightest = np.quantile(panorama, [0.001, 0.999])
        np.testing.assert_allclose(np.log10(brightest / darkest), 4.5, atol=1e-4)
        assert 0.05 < (panorama > 1).mean() < 0.35 and brightest > 8, name
        assert (panorama < 0.02).mean() > 0.05 and darkest < 0.01, name
        # Band-limited: little is left of ln intensity beyond 1/3 cycle per pixel (0.5 is the most).
        power = abs(np.fft.fft2(np.log(np.vstack([panorama, panorama[::-1]])))) ** 2
        f = np.hypot(np.fft.fftfreq(320)[:, None], np.fft.fftfreq(240))
        assert power[f > 1 / 3].sum() < 1e-4 * power[f > 0].sum(), name
    for one, other in itertools.combinations(panoramas.values(), 2):
        assert abs(np.corrcoef(np.log(one).ravel(), np.log(other).ravel())[0, 1]) < 0.9
    np.testing.assert_array_equal(sim.scene("room", size=(240, 160)), panoramas["room"])
    assert not np.allclose(sim.scene(0, size=(240, 160)), sim.scene(6, size=(240, 160)))
    wide = sim.scene("night", decades=3, size=(240, 160))
    np.testing.assert_allclose(np.log(wide), np.log(panoramas["night"]) * 3 / 4.5, atol=1e-9)


def test_a_pan_looks_where_it_says():
    # ln intensity in closed form, periodic in x and mirrored in y.
    y, x = np.mgrid[:128, :192]

    def level(x, y):
        return np.sin(2 * np.pi * x * 4 / 192) + np.cos(np.pi * (y + 0.5) * 6 / 128)

    pan = sim.Pan(np.exp(level(x, y)), (30, 20), 1.0, "fast", seed=5)
    for t in (0.0, 0.31, 1.0):
        (cx, cy), roll, zoom = pan.pose(t)
        down, across = np.mgrid[:20, :30] - np.array([9.5, 14.5])[:, None, None]
        px = cx + zoom * (np.cos(roll) * across - np.sin(roll) * down)
        py = cy + zoom * (np.sin(roll) * across + np.cos(roll) * down)
        np.testing.assert_allclose(np.log(pan.intensity(t)), level(px, py), atol=2e-3)


def test_speeds_that_a_pan_cannot_have():
    for speed in (-1.0, np.inf):
        with pytest.raises(jaxevent.InputError, match="choose slow, fast or a number of px/s"):
            sim.Pan(np.ones((80, 120)), (20, 20), speed=speed)


@pytest.mark.parametrize(
    "speed, least, most", [("slow", 20, 40), ("fast", 200, 400), (90.0, 60, 120)]
)
def test_pans_keep_their_speed_and_turn(speed, least, most):
    pan = sim.Pan(sim.scene("room", size=(120, 80)), (20, 20), 1.5, speed)
    position = np.array([pan.pose(t)[0] for t in np.linspace(0, 1.5, 1501)])
    velocity = np.diff(position, axis=0) * 1e3
    pace = np.hypot(*velocity.T)
    assert least * 0.99 < pace.min() < least * 1.2 and most * 0.85 < pace.max() < most * 1.01
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    assert np.ptp(heading) > 3 and np.abs(np.diff(heading)).max() < 0.02


@pytest.mark.parametrize(
    "bad, said",
    [
        ({"c_on": 0.0}, "c_on = 0.0"),
        ({"refractory": -1e-3}, "refractory = -0.001"),
        ({"read_noise": np.nan}, "read_noise = nan"),
        ({"exposure": 0.03}, "does not fit 50.0 frames"),
        ({"mismatch": 0.5}, "mismatch is at most 0.2"),
        ({"exposure_samples": 0}, "must be positive"),
    ],
)
def test_impossible_sensors_are_refused(bad, said):
    with pytest.raises(jaxevent.InputError, match=said):
        sim.Sensor(**bad)


def test_impossible_sources_are_refused():
    panorama = sim.scene("room", size=(96, 64))
    with pytest.raises(jaxevent.InputError, match="no scene 'moon'; choose room"):
        sim.scene("moon")
    with pytest.raises(jaxevent.InputError, match="9 decades"):
        sim.scene("room", decades=9)
    with pytest.raises(jaxevent.InputError, match="positive intensities"):
        sim.Pan(-panorama)
    with pytest.raises(jaxevent.InputError, match="fewer than two frames"):
        sim.simulate(sim.Pan(panorama, (8, 8), 0.02))
    dark = Wave(0.0, 1.0, base=np.log(DARK / 2))
    with pytest.raises(jaxevent.InputError, match="dark: the intensity at 0.000000 s is not posi"):
        sim.simulate(dark, name="dark")


def moving(frames=15, width=48, height=32):
    y, x = np.mgrid[:height, :width]
    for k in range(frames):
        grey = 128 + 120 * np.sin((x + 2 * k) / 6) * np.cos(y / 9)
        yield np.stack([grey, 0.8 * grey, 255 - grey], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """The same frames as a folder of images (10.png after 9.png) and as MP4."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "images").mkdir()
    with video_writer(folder / "film.mp4", 25) as write:
        for k, image in enumerate(moving()):
            Image.fromarray(image).save(folder / "images" / f"{k}.png")
            write(image)
    return folder


def test_images_become_a_recording_whose_truth_they_are(film):
    quiet = dataclasses.replace(IDEAL, c_on=0.1, c_off=0.1)
    recording = sim.from_video(film / "images", quiet, cut=30, rate=25)
    extra = recording.extra
    assert recording.name == "images" and (recording.width, recording.height) == (48, 32)

    def luminance(image):
        s = image.astype(float) / 255
        linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
        light = linear @ [0.2126, 0.7152, 0.0722]
        return np.maximum(light, 1 / 255 / 12.92 / 2) * 255 / 225

    light = np.stack([luminance(image) for image in moving()])
    assert light.min() < 30 / 225 and light.max() > 0.5
    for t, truth in zip(extra["hdr_t"] * 1e-6, extra["hdr"], strict=True):
        k = int(t * 25)
        u = t * 25 - k
        np.testing.assert_allclose(truth, (1 - u) * light[k] + u * light[k + 1], rtol=1e-5)
    # Level 30 of linear light is the camera's black, 225 its white.
    assert extra["response"][0] == pytest.approx(30 / 225, abs=1e-6)
    assert extra["response"][255] == pytest.approx(1, abs=1e-6)
    assert extra["white"] == 225 / 255 and extra["cut"] == 30
    # Frames in colour are those of the camera: grey where grey is, dark where all is dark.
    rgb = extra["rgb"]
    assert rgb.shape == (*recording.frames.images.shape, 3) and rgb.dtype == np.uint8
    assert (rgb.max(-1) >= recording.frames.images).all()
    assert (rgb.min(-1) <= recording.frames.images).all()
    # Events add up to the change of ln(I + dark offset).
    moved = np.zeros((32, 48))
    sign = np.where(recording.events.p, 0.1, -0.1)
    np.add.at(moved, (recording.events.y, recording.events.x), sign)
    change = np.log(light[-1] + DARK) - np.log(light[0] + DARK)
    assert np.abs(moved - change).max() < 0.2 and np.abs(change).max() > 1


def test_colour_frames_of_grey_images_are_grey_and_the_frames(tmp_path):
    for k, image in enumerate(moving(6)):
        Image.fromarray(image[..., 0]).save(tmp_path / f"{k}.png")
    recording = sim.from_video(tmp_path, IDEAL, cut=50)
    frames = np.asarray(recording.frames.images).astype(int)
    assert frames.min() == 0 and frames.max() > 250
    assert abs(recording.extra["rgb"] - frames[..., None]).max() <= 1


def test_video_files_are_read_played_and_scaled(film):
    images = sim.from_video(film / "images", IDEAL, rate=25)
    video = sim.from_video(film / "film.mp4", IDEAL)
    assert video.name == "film" and len(video.frames) == len(images.frames)
    difference = video.extra["hdr"] - images.extra["hdr"]
    assert np.abs(difference).mean() < 0.03 * images.extra["hdr"].mean()
    fast = sim.from_video(film / "film.mp4", IDEAL, speed=2, max_size=24, start=0.2, stop=0.6)
    assert (fast.width, fast.height) == (24, 16)
    assert fast.events.t[-1] <= 180_000 and 8 <= len(fast.frames) <= 9
    jaxevent.save(fast, film / "fast.h5")
    np.testing.assert_array_equal(jaxevent.load(film / "fast.h5").extra["rgb"], fast.extra["rgb"])


@pytest.mark.parametrize(
    "name, options, said",
    [
        ("none.mp4", {}, "none.mp4: there is no such file"),
        ("text.mp4", {}, "text.mp4: is not a video"),
        ("film.mp4", {"stop": 0.03}, "frames in the chosen part is 1; at least 2"),
        ("film.mp4", {"start": 9.0}, "frames in the chosen part is 0"),
        ("film.mp4", {"start": 1, "stop": 0.5}, "give start < stop"),
        ("film.mp4", {"speed": 0}, "speed = 0 is not possible"),
        ("film.mp4", {"max_size": 3}, "max_size = 3 is too small"),
        ("film.mp4", {"cut": 128}, "cannot crop 128"),
        ("film.mp4", {"sensor": sim.Sensor(response=SCurve())}, "has its response from cut"),
        ("mixed", {}, "mixed: image 1 is 48x32 after images of 20x20"),
        ("broken", {}, "1.png: is not a readable image"),
        (".", {}, "frames in the chosen part is 0"),
    ],
)
def test_unfit_video_is_refused(film, name, options, said):
    (film / "text.mp4").write_text("no video\n" * 100)
    for folder in ("mixed", "broken"):
        (film / folder).mkdir(exist_ok=True)
        Image.new("RGB", (20, 20)).save(film / folder / "0.png")
    Image.new("RGB", (48, 32)).save(film / "mixed" / "1.png")
    (film / "broken" / "1.png").write_bytes(b"no image")
    with pytest.raises(jaxevent.InputError, match=said):
        sim.from_video(film / name, **options)


def test_too_long_videos_are_refused(film, monkeypatch):
    monkeypatch.setattr("jaxevent.simulate.video._MAX_PIXELS", 5 * 48 * 32)
    with pytest.raises(jaxevent.InputError, match="too long, over 5 frames of 48x32; choose a"):
        sim.from_video(film / "film.mp4")
    assert sim.from_video(film / "film.mp4", stop=0.18).width == 48
