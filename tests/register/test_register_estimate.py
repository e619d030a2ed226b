"""Homographies and clocks that are estimated, against rendered truth."""

import dataclasses
import sys

import numpy as np
import pytest
from rigs import RIGS

import jaxevent
from jaxevent import cli, register
from jaxevent.errors import InputError
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register.clocks import clock_offsets


@pytest.mark.slow
def test_registration_of_a_far_scene(far, tmp_path, capsys):
    pytest.importorskip("cv2")
    _, recording, other, H, offset = far
    jaxevent.save(recording, tmp_path / "events.h5")
    jaxevent.save(other, tmp_path / "frames.h5")
    command = ["register", tmp_path / "events.h5", "--frames", tmp_path / "frames.h5"]
    out = tmp_path / "both.h5"
    assert cli.main([str(word) for word in [*command, "--search", 0.4, "--out", out]]) == 0
    said = capsys.readouterr().out
    both = jaxevent.load(out)
    assert both.name == recording.name and len(both.events) == len(recording.events)
    assert abs(float(both.extra["register_offset"]) - offset) < 1e-3
    assert f"estimated: {float(both.extra['register_offset']):.6f} s" in said
    size = (recording.width, recording.height)
    true = register.homography_grid(H, size, (other.width, other.height))
    found = register.homography_grid(both.extra["homography"], size, (other.width, other.height))
    assert RIGS["grid_error"](found, true) < 0.15
    np.testing.assert_array_equal(both.extra["covered"], ~np.isnan(found[..., 0]))
    np.testing.assert_array_equal(both.extra["response"], other.extra["response"])
    shift = round(float(both.extra["register_offset"]) * 1e6)
    assert set(both.frames.t) <= set(other.frames.t + shift)
    assert (both.frames.exposure == other.frames.exposure[0]).all()
    assert (np.asarray(both.frames.images)[:, ~both.extra["covered"]] == 0).all()


@pytest.mark.slow
def test_clock_of_a_calibrated_rig(near):
    _, _, recording, other, rig, offset = near
    size, seen = (recording.width, recording.height), (other.width, other.height)
    candidates = register.clock_offsets(recording, other)
    assert abs(candidates[0] - offset) < 0.012
    grid = rig.grid(size, seen, plane=(0, 0, 1, 2.0))
    found = register.refine(recording, other, candidates[0], grid)
    assert abs(found.offset - offset) < 1e-3 and (found.agreement or 0) > 0.8
    assert found.grid is grid and found.homography is None
    later = dataclasses.replace(other.frames, t=other.frames.t + 50_000_000)
    later = dataclasses.replace(other, frames=later)
    again = register.clock_offsets(recording, later)
    assert again[0] == pytest.approx(candidates[0] - 50, abs=2e-3)
    with pytest.raises(InputError, match="no offset of its clock"):
        register.clock_offsets(recording, later, search=1.0)


def test_what_is_given_is_kept(near):
    _, _, recording, other, rig, _ = near
    size, seen = (recording.width, recording.height), (other.width, other.height)
    grid = rig.grid(size, seen, depth=2.0)
    found = register.estimate(recording, other, grid, offset=0.25)
    assert found.offset == 0.25 and found.grid is grid and found.agreement is None
    H = np.array([[1.5, 0, 3], [0, 1.5, 4], [0, 0, 1]])
    found = register.estimate(recording, other, homography=H, offset=-0.1)
    assert found.offset == -0.1
    np.testing.assert_array_equal(found.homography, H)


@pytest.mark.slow
def test_frames_of_another_scene_are_refused(near):
    _, _, recording, other, rig, _ = near
    noise = np.random.default_rng(0).integers(60, 190, other.frames.images.shape, dtype=np.uint8)
    wrong = dataclasses.replace(
        other, name="noise", frames=dataclasses.replace(other.frames, images=noise)
    )
    size = (recording.width, recording.height)
    grid = rig.grid(size, (other.width, other.height), depth=2.0)
    with pytest.raises(InputError, match="noise: .* do not agree"):
        register.estimate(recording, wrong, grid, search=0.02)


def test_too_few_matches_are_refused(far):
    pytest.importorskip("cv2")
    _, recording, other, _, _ = far
    even = np.full((len(other.frames), 96, 128), 120, np.uint8)
    even[::2] += 10
    blank = dataclasses.replace(other, frames=dataclasses.replace(other.frames, images=even))
    with pytest.raises(InputError, match="only 0 features"):
        register.estimate(recording, blank, offset=0.0)


def test_opencv_is_named_if_it_is_missing(near, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    _, _, recording, other, _, _ = near
    with pytest.raises(InputError, match=r"\[vision\]"):
        register.estimate(recording, other, offset=0.0)


@pytest.mark.parametrize("last_us", [0, 5_000, 60_000])
def test_events_of_few_windows_do_not_determine_the_clock(last_us):
    rng, n = np.random.default_rng(0), 500
    t = np.sort(rng.integers(0, last_us + 1, n))
    events = Events(t, rng.integers(0, 64, n), rng.integers(0, 48, n), rng.random(n) < 0.5)
    stamps = 33_333 * np.arange(12)
    images = rng.integers(0, 256, (12, 48, 64), np.uint8)
    other = Recording("b", 64, 48, Events.empty(), Frames(stamps, images, np.zeros(12, np.int64)))
    assert clock_offsets(Recording("a", 64, 48, events), other) == [0.0]
