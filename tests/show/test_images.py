import dataclasses
import re
import resource
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from noise import HEIGHT, WIDTH, small
from PIL import Image

from jaxevent.egomotion.scores import METRIC_UNITS
from jaxevent.errors import InputError, install_command
from jaxevent.methods import METHODS
from jaxevent.metrics import MEASURE_MEANINGS
from jaxevent.recording import Frames
from jaxevent.show.export import display_images
from jaxevent.show.images import (
    comparison_figure,
    display_limits,
    tone_map,
    video_writer,
    write_png,
)
from jaxevent.show.tables import COLUMNS, markdown_table

pytestmark = pytest.mark.slow

TONES = ["display", "linear", "log", "percentile", "clahe", "changes"]
RAMP = np.linspace(-0.2, 1.3, 40 * 60).reshape(40, 60)


def test_linear_tone_clips_to_0_and_1():
    shown = tone_map(np.array([[-3.0, 0.0, 0.25], [0.5, 1.0, 7.0]]))
    assert shown.dtype == np.uint8
    np.testing.assert_array_equal(shown, [[0, 0, 64], [128, 255, 255]])
    assert display_limits(RAMP) == (0.0, 1.0)


def test_percentile_tone_leaves_out_half_a_percent_at_each_end():
    low, high = display_limits(RAMP, "percentile")
    np.testing.assert_allclose([low, high], [-0.2 + 1.5 * 0.005, 1.3 - 1.5 * 0.005])
    shown = tone_map(RAMP, "percentile")
    assert np.mean(RAMP < low) == np.mean(RAMP > high) == 0.005
    np.testing.assert_array_equal(shown[low > RAMP], 0)
    np.testing.assert_array_equal(shown[high < RAMP], 255)


def test_display_tone_is_the_curve_of_srgb():
    """Greys 1, 10, 118, 188 and 255 of sRGB are 0.0303, 0.3035, 18.1, 50.3 and 100 % of white."""
    light = np.array([[-1.0, 0, 0.000303, 0.003035, 0.1812, 0.5029, 1.0, 3.0]])
    shown = tone_map(4 * light, "display", limits=(0.0, 4.0))
    np.testing.assert_array_equal(shown, [[0, 0, 1, 10, 118, 188, 255, 255]])
    assert display_limits(RAMP, "display") == (0.0, float(np.percentile(RAMP, 99.5)))
    assert display_limits(0 * RAMP, "display") == (0.0, 1.0)


def test_log_tone_gives_each_octave_the_same_share():
    shown = tone_map(2.0 ** np.arange(-8, 1)[None], "log", limits=(2.0**-8, 1.0))
    np.testing.assert_array_equal(shown, [np.rint(255 * np.arange(9) / 8)])


def test_log_limits_ignore_what_is_dark_up_to_rounding():
    images = np.concatenate([np.full(500, 1e-12), np.zeros(200), -np.ones(100), np.ones(500)])
    low, high = display_limits(images[None], "log")
    assert (low, high) == (2.0**-16, 1.0)
    np.testing.assert_array_equal(tone_map(images[None], "log"), 255 * (images[None] > 0.5))


def test_changes_are_even_about_grey():
    levels = np.array([-0.4, -0.2, 0.0, 0.0, 0.2, 0.4])  # ln(1 + I)
    images = np.expm1(np.repeat(levels, 200).reshape(24, 50))
    low, high = display_limits(images, "changes")
    np.testing.assert_allclose(np.log1p([low, high]), [-0.4, 0.4])
    shown = tone_map(images, "changes").ravel()[::200].astype(int)
    np.testing.assert_allclose(shown, [0, 63.75, 127.5, 127.5, 191.25, 255], atol=0.5)
    sparse = np.where(np.arange(10_000) % 1000 < 2, images[-1, -1], 0).reshape(100, 100)
    np.testing.assert_allclose(display_limits(sparse, "changes"), [low, high])  # not of what rests


def test_relative_fades_what_is_uncertain_and_does_not_stretch_noise():
    """At a deviation of a quarter of the grey scale half of the contrast is left."""
    L = np.linspace(-1, 1, 1001)[None].repeat(2, 0)
    image, limits = 0.5 * np.exp(L), (0.5 * np.exp(-1), 0.5 * np.exp(1))
    variance = np.array([[0.0], [0.25]]).repeat(1001, 1)
    shown = tone_map(image, "relative", limits, variance).astype(float)
    np.testing.assert_allclose(shown[0], tone_map(image, "log", limits)[0])
    np.testing.assert_allclose(shown[1] - 127.5, (shown[0] - 127.5) / 2, atol=1)
    unknown = tone_map(image, "relative", limits, np.full(L.shape, np.inf))
    assert set(np.unique(unknown)) <= {127, 128}
    low, high = display_limits(image, "relative", np.full(L.shape, 1.0))
    np.testing.assert_allclose(np.log(2 * np.array([low, high])), [-2, 2], atol=0.02)
    for known in (None, 0 * variance, np.nan * variance):
        limits = display_limits(image, "relative", known)
        np.testing.assert_allclose(np.log(2 * np.array(limits)), [-0.98, 0.98], atol=1e-3)


@pytest.mark.parametrize("how", ["display", "linear", "log", "percentile", "changes", "relative"])
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-3, 1e3))
def test_brighter_is_never_shown_darker(how, seed, scale):
    values = scale * np.random.default_rng(seed).normal(size=(8, 9)) ** 3
    order = np.argsort(values.ravel())
    shown = tone_map(values, how).ravel()[order].astype(int)
    assert (np.diff(shown) >= 0).all()


@pytest.mark.parametrize("how", TONES)
def test_common_limits_show_a_frame_alike_alone_and_in_a_video(how):
    rng = np.random.default_rng(0)
    video = rng.uniform(0.01, 1, (3, 32, 40)) * np.array([0.1, 1, 5])[:, None, None]
    limits = display_limits(video, how)
    together = tone_map(video, how, limits)
    assert together.shape == video.shape
    before = video.copy()
    for frame, shown in zip(video, together, strict=True):
        np.testing.assert_array_equal(tone_map(frame, how, limits), shown)
    np.testing.assert_array_equal(video, before)


@pytest.mark.parametrize("how", TONES)
def test_constant_images_can_be_shown(how):
    for value in (-1.0, 0.0, 0.3, 1e-30):
        shown = tone_map(np.full((16, 20), value, np.float32), how)
        assert np.ptp(shown) == 0
        if how == "percentile" or (how in ("log", "clahe") and value > 0):
            assert shown[0, 0] in (127, 128)


def test_clahe_brings_out_contrast_in_the_dark_half():
    rng = np.random.default_rng(1)
    image = np.where(np.arange(128) < 64, 0.1, 0.9) * (1 + 0.02 * rng.normal(size=(96, 128)))
    plain, equal = tone_map(image, "log"), tone_map(image, "clahe")
    assert equal[:, :48].std() > 1.2 * plain[:, :48].std()
    assert equal[:, :48].mean() < equal[:, 80:].mean()


@pytest.mark.parametrize("how", TONES)
def test_tone_map_names_bad_input(how):
    with pytest.raises(InputError, match="holds nan at"):
        tone_map(np.where(RAMP > 1, np.nan, RAMP), how)
    with pytest.raises(InputError, match="uint8"):
        tone_map(RAMP.astype(np.uint8), how)
    with pytest.raises(InputError, match="black below white"):
        tone_map(RAMP, how, limits=(1.0, 1.0))
    with pytest.raises(InputError, match="'gamma'; choose one of linear"):
        tone_map(RAMP, "gamma")
    if how in ("log", "clahe"):
        with pytest.raises(InputError, match="two finite positive"):
            tone_map(RAMP, how, limits=(0.0, 1.0))


def test_png_keeps_every_pixel_of_display_images(tmp_path):
    path = tmp_path / "image.png"
    for bad in (np.zeros((4, 4)), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4), np.uint8)):
        with pytest.raises(InputError, match="image.png: cannot show .* give uint8"):
            write_png(path, bad)
        assert not path.exists()
    for shape in ((5, 7), (5, 7, 3)):
        image = np.random.default_rng(2).integers(0, 256, shape, np.uint8)
        write_png(path, image[::-1])
        with Image.open(path) as stored:
            assert stored.format == "PNG"
            np.testing.assert_array_equal(np.asarray(stored), image[::-1])
    assert [path.name for path in tmp_path.iterdir()] == ["image.png"]


@pytest.mark.parametrize("colour", [(), (3,)])
def test_video_keeps_frames_size_and_rate(tmp_path, colour):
    path = tmp_path / "video.mp4"
    # Smooth motion, of the odd size that must be padded.
    y, x = np.mgrid[:61, :83]
    waves = [127 + 100 * np.sin(x / 9 + 0.3 * k) * np.cos(y / 11) for k in range(12)]
    frames = [np.rint(wave).astype(np.uint8) for wave in waves]
    with video_writer(path, fps=25) as write:
        for frame in frames:
            write(np.broadcast_to(frame.reshape(61, 83, *(1 for _ in colour)), (61, 83, *colour)))
        assert not path.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["video.mp4"]
    # Not by the reader of imageio, which forks; JAX warns that this may deadlock.
    program = imageio_ffmpeg.get_ffmpeg_exe()
    decode = [program, "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    stored = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 62, 84, 3)
    (stream,) = [line for line in decoded.stderr.decode().splitlines() if "Video: h264" in line]
    assert all(part in stream for part in ("yuv420p", " 84x62", " 25 fps"))
    assert len(stored) == 12
    error = stored[:, :61, :83].astype(float) - np.stack(frames)[..., None]
    assert np.abs(error).mean() < 1.5 and np.abs(error).max() < 12


def test_broken_video_leaves_no_file(tmp_path):
    path, frame = tmp_path / "video.mp4", np.zeros((32, 32), np.uint8)
    with pytest.raises(InputError, match=r"\(32, 30\) after frames of \(32, 32\)"):
        with video_writer(path, fps=25) as write:
            write(frame)
            write(frame[:, 2:])
    with pytest.raises(InputError, match="float64"), video_writer(path, fps=25) as write:
        write(frame.astype(float))
    with pytest.raises(InputError, match="at least one frame"), video_writer(path, fps=25):
        pass
    with pytest.raises(InputError, match="0 frames per second"), video_writer(path, fps=0):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("frames", [1, 200])
def test_failing_encoder_is_reported_and_leaves_no_file(tmp_path, monkeypatch, frames):
    # Python is not ffmpeg: it complains about the options and ends with an exit status.
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: sys.executable)
    with pytest.raises(InputError, match=r"video\.mp4: ffmpeg failed \(.*option.*\); check"):
        with video_writer(tmp_path / "video.mp4", fps=25) as write:
            for _ in range(frames):
                write(np.zeros((64, 64), np.uint8))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limit", ["file", "disk"])
def test_a_video_that_finds_no_room_says_so_without_the_log_of_its_encoder(
    limit, tmp_path, monkeypatch
):
    path, reason = tmp_path / "video.mp4", "File too large"
    noise = np.random.default_rng(0).integers(0, 256, (30, 120, 160), np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit == "disk":  # the encoder writes to a device that is full
        program, real = tmp_path / "encoder", imageio_ffmpeg.get_ffmpeg_exe()
        program.write_text(f'#!/bin/bash\nexec {real} "${{@:1:$#-1}}" /dev/full\n')
        program.chmod(0o700)
        monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(program))
        reason = "No space left on device"
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(InputError) as caught, video_writer(path, fps=25) as write:
            for frame in noise:
                write(frame)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    wanted = f"{path}: cannot be written ({reason}); choose a writable place with enough room"
    assert str(caught.value) == wanted and not path.exists()


@pytest.mark.parametrize("module, extra", [("imageio_ffmpeg", "video"), ("matplotlib", "plot")])
def test_missing_extra_is_named(tmp_path, monkeypatch, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"{module}.*{re.escape(install_command(extra))}"):
        if extra == "plot":
            comparison_figure(tmp_path / "figure.png", [("a", np.zeros((2, 2)), "image")])
        else:
            with video_writer(tmp_path / "video.mp4", fps=25):
                pass
    assert not list(tmp_path.iterdir())


def panels():
    rng = np.random.default_rng(3)
    image = rng.uniform(size=(26, 34))
    error = rng.normal(size=(26, 34)) / 10
    return [
        ("truth", image, "image"),
        ("filter", image.astype(np.float32), "image"),
        ("smoother", image > 0.5, "image"),
        ("error", error, "error"),
        ("half error", error / 2, "error"),
        ("variance", np.where(image > 0.9, np.inf, image), "uncertainty"),
    ]


@pytest.mark.parametrize("count, rows, columns", [(1, 1, 1), (5, 2, 3)])
def test_figure_is_a_grid_of_panels(tmp_path, count, rows, columns):
    path = tmp_path / "figure.png"
    comparison_figure(path, panels()[:count], "Filters compared")
    with Image.open(path) as stored:
        assert stored.format == "PNG" and stored.info["dpi"] == pytest.approx((150, 150), abs=0.1)
        width, height = stored.size
        pixels = np.asarray(stored.convert("RGB"))
    assert width == columns * 4 * 150
    assert height / rows == pytest.approx((4 * 26 / 34 + 0.35) * 150, rel=0.2)
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]


def test_figures_do_not_depend_on_each_other(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)  # of another test
    for name in ("a.png", "b.png"):
        comparison_figure(tmp_path / name, panels()[4:])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert "matplotlib.pyplot" not in sys.modules


def test_a_panel_without_one_finite_value_can_be_drawn(tmp_path):
    blank = np.full((8, 9), np.nan)
    kinds = ["image", "error", "uncertainty"]
    comparison_figure(tmp_path / "figure.PDF", [(kind, blank, kind) for kind in kinds])
    assert (tmp_path / "figure.PDF").read_bytes().startswith(b"%PDF")


def test_figure_names_bad_panels(tmp_path):
    path = tmp_path / "figure.png"
    with pytest.raises(InputError, match="at least one panel"):
        comparison_figure(path, [])
    with pytest.raises(InputError, match=r"panel 'a' is float64 of shape \(3,\)"):
        comparison_figure(path, [("a", np.zeros(3), "image")])
    with pytest.raises(InputError, match="unknown kind 'heat'; choose one of image, error"):
        comparison_figure(path, [("a", np.zeros((3, 3)), "heat")])
    with pytest.raises(InputError, match=r"figure\.xyz: a figure cannot be stored as xyz"):
        comparison_figure(tmp_path / "figure.xyz", panels())
    assert not list(tmp_path.iterdir())


def test_markdown_table():
    names = ["recording", "method", "mse", "ssim", "frames", "events", "seconds", "params"]
    values = [
        ("night", "akf", 0.0018, 0.8604, 22, 5_000_000, 12, {"sigma_iso": 0.1}),
        ("a|b\nc", "cf", float("nan"), None, 22, 5_000_000, 0.5, {}),
    ]
    rows = [dict(zip(names, row, strict=True)) for row in values]
    assert markdown_table(rows) == (
        "| recording | method | MSE x 1e-2 |  SSIM | frames | seconds |\n"
        "| --------- | ------ | ---------: | ----: | -----: | ------: |\n"
        "| night     | akf    |      0.180 | 0.860 |     22 |   12.00 |\n"
        "| a\\|b c    | cf     |          - |     - |     22 |    0.50 |\n"
        "\n"
        "- MSE x 1e-2: mean square error of intensity; 0 is best\n"
        "- SSIM: structural similarity of intensity, from -1 to 1; 1 is best\n"
        "- frames: images that were compared\n"
        "- seconds: seconds of computing, compilation included\n"
    )
    assert markdown_table([]).count("\n") == 2


def test_every_number_that_is_shown_is_explained():
    assert {place for _, place, _, _ in COLUMNS} < MEASURE_MEANINGS.keys()
    assert {*METRIC_UNITS, "lost", "startup"} < MEASURE_MEANINGS.keys()


@pytest.mark.parametrize("how", TONES)
def test_pixels_without_bound_are_white_and_change_no_limit(how):
    """A hot pixel's events add up until exp(L) overflows."""
    image = np.linspace(0.1, 0.9, 400, dtype=np.float32).reshape(20, 20)
    hot = image.copy()
    hot[3, 4] = np.inf
    assert display_limits(hot, how) == pytest.approx(display_limits(image, how), rel=0.02)
    shown = tone_map(hot, how)
    assert shown[3, 4] == shown.max()
    with pytest.raises(InputError, match="not finite"):
        tone_map(np.where(np.isinf(hot), np.nan, hot), how)


def test_the_display_is_that_of_the_scene_whatever_the_camera():
    scene = np.random.default_rng(3).uniform(0.02, 0.3, (2, HEIGHT, WIDTH)).astype(np.float32)
    stamps = np.array([10_000, 40_000])
    plain = small(frames=Frames(stamps, scene, 0 * stamps))
    curved = small(frames=Frames(stamps, np.sqrt(scene), 0 * stamps))
    curved = dataclasses.replace(curved, extra={"response": np.linspace(0, 1, 1024) ** 2})
    blend, times = METHODS["blend"], np.array([15_000, 30_000])
    shown = [
        np.stack([image for _, image in display_images(video, times, "display")]).astype(int)
        for video in (blend.estimate(one, blend.Params()) for one in (plain, curved))
    ]
    assert np.abs(shown[0] - shown[1]).max() <= 1 and shown[0].max() > 200
