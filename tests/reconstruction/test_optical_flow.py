"""Interpolation along optical flow: what it does with OpenCV, and what is said without it."""

import dataclasses
import json
import re
import sys
from typing import Any

import numpy as np
import pytest
from commands import fails
from noise import HEIGHT, WIDTH, small
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

import jaxevent
from jaxevent import cli
from jaxevent.errors import install_command
from jaxevent.recording import Events, Frames, Recording

SIZE = (64, 96)
STEP = np.array([2.0, -5.0])  # pixels down and right from a frame to the next
STAMPS = np.array([0, 20_000, 40_000, 60_000])
EVALUATION = (
    'recordings = ["small.h5"]\n[[method]]\nname = "flow"\nlabel = "along flow"\n'
    '[[method]]\nname = "blend"\n'
)


def texture_at(share: float) -> NDArray:
    """A smooth texture in [0.2, 0.6] that has moved by `share` steps."""
    noise = np.random.default_rng(3).normal(size=(160, 160))
    smooth = gaussian_filter(noise, 2.5, mode="wrap")
    smooth = 0.2 + 0.4 * (smooth - smooth.min()) / np.ptp(smooth)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return map_coordinates(smooth, [y - share * STEP[0], x - share * STEP[1]], mode="grid-wrap")


def translated(kind: Any = np.uint8, scale: float = 1.0, **extra) -> Recording:
    """The texture in four frames, a step apart, and two events."""
    images = np.stack([texture_at(k) for k in range(len(STAMPS))]) * scale
    if np.issubdtype(kind, np.integer):
        images = np.rint(images * np.iinfo(kind).max)
    images = images.astype(kind)
    t = np.array([0, 60_000])
    events = Events(t, np.uint16([1, 2]), np.uint16([1, 2]), np.array([True, False]))
    frames = Frames(STAMPS, images, np.zeros_like(STAMPS))
    return Recording("translated", SIZE[1], SIZE[0], events, frames, extra=extra).check()


def errors(recording: Recording, scale: float = 1.0) -> tuple[float, float]:
    """Mean squared errors of `flow` and `blend` halfway between frames, away from the border."""
    truth = texture_at(1.5) * scale
    inner = (slice(8, -8), slice(8, -8))
    images = [jaxevent.METHODS[name].estimate(recording)([30_000]) for name in ("flow", "blend")]
    flow, blend = (float(((image.mean[0] - truth)[inner] ** 2).mean()) for image in images)
    return flow, blend


@pytest.fixture
def cv2():
    return pytest.importorskip("cv2", reason="needs the extra 'vision'")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_a_translated_texture_is_found(cv2, kind):
    flow, blend = errors(translated(kind))
    assert flow < 0.02 * blend


def test_dark_frames_are_as_good(cv2):
    scale = 1 / 12
    flow, blend = errors(translated(np.uint16, scale), scale)
    assert flow < 0.02 * blend


def test_frames_of_different_gain_are_brought_together(cv2):
    recording = translated(np.float32)
    gain = np.array([1.0, 1.0, 1.5, 1.0], np.float32)
    images = np.asarray(recording.frames.images) * gain[:, None, None]
    frames = dataclasses.replace(recording.frames, images=images)
    flow, blend = errors(dataclasses.replace(recording, frames=frames, extra={"gain": gain}))
    assert flow < 0.02 * blend


def test_time_has_no_direction(cv2):
    recording = translated()
    frames = dataclasses.replace(recording.frames, images=recording.frames.images[::-1].copy())
    backwards = dataclasses.replace(recording, frames=frames)
    times = np.array([3_000, 11_000, 28_000, 41_000])
    ahead = jaxevent.flow.estimate(recording)(times).mean
    back = jaxevent.flow.estimate(backwards)(60_000 - times).mean
    np.testing.assert_allclose(ahead, back, atol=1e-12)


def test_frames_are_met_and_held(cv2):
    recording = translated()
    params = jaxevent.flow.Params(clock_offset=0.003)
    video = jaxevent.flow.estimate(recording, params)
    times = np.array([63_000, 23_000, 1_000, 0, 61_000])
    image, variance, valid = video(times)
    given = np.asarray(recording.frames.images) / 255
    np.testing.assert_array_equal(image[[0, 1, 2, 3]], given[[3, 1, 0, 0]])
    assert np.isnan(variance).all()
    assert valid.all()  # the last frame is at 63 ms on the clock of events
    with pytest.raises(jaxevent.InputError, match="integers are microseconds"):
        video([64_000])
    assert not video([70_000], extrapolate=True).valid.any()
    assert "flow of translated, 96x64" in repr(video)


def test_estimate_is_prepare_run_read(cv2):
    recording, times = translated(), np.array([1_000, 20_000, 27_000, 33_000, 59_000])
    params = jaxevent.flow.Params(clock_offset=-0.001)
    features, out = jaxevent.flow.prepare(recording, times, params)
    trajectory, state = jaxevent.flow.run(params, features)
    told = jaxevent.flow.read(params, trajectory, out)
    assert state is None and told.mean.shape == (5, SIZE[0] * SIZE[1])
    video = jaxevent.flow.estimate(recording, params)
    for _ in range(2):
        for one, other in zip(video(times), told, strict=True):
            np.testing.assert_array_equal(one.reshape(5, -1), other)
    np.testing.assert_array_equal(video(times[3]).mean[0].ravel(), told.mean[3])
    for values in ([features.mid], features.grey, trajectory.pairs):
        assert len(values) > 0
    assert "\n" not in repr(features) + repr(trajectory)


def test_flow_is_the_velocity(cv2):
    video = jaxevent.flow.estimate(translated(), jaxevent.flow.Params(clock_offset=0.001))
    times = np.array([47_000, 1_000, 30_000, 500, 61_000])
    flow = video.flow(times)
    assert flow.shape == (5, *SIZE, 2) and np.isnan(flow[3:]).all()
    expected = np.array([STEP[1], STEP[0]]) / 0.02
    np.testing.assert_allclose(np.median(flow[:3], axis=(1, 2)), [expected] * 3, atol=5)
    np.testing.assert_array_equal(video.flow(47_000)[0], flow[0])
    with pytest.raises(jaxevent.InputError, match="integers are microseconds"):
        video.flow([64_000])


def test_what_cannot_be_used_is_said(cv2):
    with pytest.raises(jaxevent.InputError, match="holds no frames"):
        jaxevent.flow.estimate(dataclasses.replace(small(), frames=None))
    frames = Frames(STAMPS, np.zeros((4, 9, 10), np.uint8), np.zeros_like(STAMPS))
    tiny = Recording("tiny", 10, 9, small().events[:0], frames)
    with pytest.raises(jaxevent.InputError, match="10x9 pixels are too few.*'blend'"):
        jaxevent.flow.prepare(tiny, [0])
    with pytest.raises(jaxevent.InputError, match="no option 'window_events'"):
        jaxevent.flow.estimate(small(), window_events=3)
    with pytest.raises(jaxevent.InputError, match="1000000 us were requested"):
        jaxevent.flow.prepare(small(), [1.0])
    black = dataclasses.replace(
        small(), frames=Frames(STAMPS, np.zeros((4, HEIGHT, WIDTH), np.uint8), 0 * STAMPS)
    )
    assert (jaxevent.flow.estimate(black)([30_000]).mean == 0).all()


@pytest.fixture
def folder(tmp_path):
    jaxevent.save(small(), tmp_path / "small.h5")
    (tmp_path / "run.toml").write_text(EVALUATION)
    return tmp_path


def test_it_is_evaluated_and_reconstructs(cv2, folder, capsys):
    assert cli.main(["evaluate", str(folder / "run.toml"), "--out", str(folder / "out")]) == 0
    rows = json.loads((folder / "out" / "results.json").read_text())["rows"]
    assert rows[0]["mse"] > 0 and rows[0]["mse"] != rows[1]["mse"]
    argv = f"reconstruct {folder / 'small.h5'} --method flow --rate 200 --out {folder / 'a.h5'}"
    assert cli.main(argv.split()) == 0 and "11 images" in capsys.readouterr().out


def test_it_cannot_be_fitted(folder, capsys):
    config = folder / "fit.toml"
    config.write_text(
        'recordings = ["small.h5"]\n[[method]]\nname = "flow"\nfit = ["clock_offset"]\n'
    )
    fails(capsys, ["fit", config, "--out", folder / "no"], "'flow' has no gradients")


def test_without_opencv_its_rows_are_skipped(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(jaxevent.InputError, match=re.escape(install_command("vision"))):
        jaxevent.flow.estimate(small())
    out = folder / "out"
    assert cli.main(["evaluate", str(folder / "run.toml"), "--out", str(out)]) == 0
    said = capsys.readouterr()
    sentence = f"this needs the package 'cv2': {install_command('vision')}"
    assert f"jaxevent: along flow is skipped: {sentence}" in said.err.splitlines()
    assert "failed" not in said.err + said.out
    assert f"\nskipped (1): along flow: {sentence}\n" in (out / "results.md").read_text()
    skipped, scored = json.loads((out / "results.json").read_text())["rows"]
    assert skipped["skipped"] is True and skipped["error"] == sentence
    assert set(skipped) == {"recording", "method", "params", "error", "skipped"}
    assert scored["method"] == "blend" and scored["mse"] > 0
    page = (out / "report.html").read_text()
    assert "1 of 2 skipped" in page and "[vision]" in page and "failed</h2>" not in page
    # With nothing else to score it is an error.
    config = folder / "alone.toml"
    config.write_text('recordings = ["small.h5"]\n[[method]]\nname = "flow"\n')
    fails(capsys, ["evaluate", config], install_command("vision"))


def test_a_skipped_row_is_computed_once_the_extra_is_there(cv2, folder, monkeypatch):
    out = folder / "out"
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "cv2", None)
        rows = jaxevent.evaluate(folder / "run.toml", out)
        assert "skipped" in rows[0] and "mse" in rows[1]
    rows = jaxevent.evaluate(folder / "run.toml", out)
    assert "skipped" not in rows[0] and rows[0]["mse"] > 0
