"""Frame stamps from external triggers, against those that were simulated."""

import dataclasses

import numpy as np
import pytest
from commands import fails
from hypothesis import given
from hypothesis import strategies as st
from rigs import small

import jaxevent
from jaxevent import cli, register
from jaxevent.errors import InputError
from jaxevent.recording import Recording, Triggers


def shutter(opens: np.ndarray, closes: np.ndarray, channel: int = 0) -> Triggers:
    """Rising edges where the shutter opens, falling ones where it closes."""
    t = np.stack([opens, closes], 1).ravel()
    edge = np.tile(np.array([1, 0], np.int8), len(opens))
    return Triggers(t, edge, np.full(len(t), channel, np.uint8))


def triggered_rig(near) -> tuple[Recording, Recording, register.Grid, np.ndarray]:
    """Events with triggers, frames of a clock that jitters and drifts, and the true stamps.

    Three exposures before the first frame and one after the last are triggered too; of the frames
    two have no trigger.
    """
    _, _, recording, other, rig, offset = near
    true = other.frames.t + round(offset * 1e6)
    period, half = int(np.median(np.diff(true))), int(other.frames.exposure[0]) // 2
    mids = np.concatenate([true[0] - period * np.arange(3, 0, -1), true, true[-1:] + period])
    mids = np.delete(mids, [7, 12])
    recording = dataclasses.replace(recording, triggers=shutter(mids - half, mids + half))
    jitter = np.random.default_rng(4).uniform(-2_000, 2_000, len(true))
    drift = 2e-3 * (other.frames.t - other.frames.t.mean())
    stamps = other.frames.t + np.rint(jitter + drift).astype(np.int64)
    frames = dataclasses.replace(
        other.frames, t=stamps, exposure=np.zeros_like(other.frames.exposure)
    )
    size, seen = (recording.width, recording.height), (other.width, other.height)
    grid = rig.grid(size, seen, plane=(0, 0, 1, 2.0))
    kept = np.delete(np.arange(len(true)), [4, 9])
    return recording, dataclasses.replace(other, frames=frames), grid, true[kept]


@pytest.fixture(scope="module")
def registered(near):
    """The rig, and what is found of it without triggers."""
    recording, other, grid, true = triggered_rig(near)
    return recording, other, true, register.estimate(recording, other, grid)


@pytest.mark.slow
def test_stamps_and_lag_are_those_simulated(near, registered):
    recording, other, true, before = registered
    grid, exposure = before.grid, int(near[3].frames.exposure[0])
    for edge, lag in (("falling", -exposure / 2e6), ("auto", 0)):
        stamped, found = register.stamp_by_triggers(recording, other, before, edge)
        assert abs(found.offset - lag) < 1e-3 and found.grid is grid
        np.testing.assert_allclose(stamped.frames.t + found.offset * 1e6, true, atol=1e3)
        known = exposure if edge == "auto" else 0
        assert np.abs(stamped.frames.exposure - known).max() <= 1
        assert (found.agreement or 0) > (before.agreement or 0)  # without jitter
    _, kept = register.stamp_by_triggers(recording, other, before, "rising", lag=0.002)
    assert kept.offset == 0.002


@pytest.mark.slow
def test_the_command_prints_the_lag(near, registered, tmp_path, capsys, monkeypatch):
    recording, other, true, before = registered
    monkeypatch.setattr(register, "estimate", lambda *_, **__: before)
    jaxevent.save(recording, tmp_path / "own.h5")
    jaxevent.save(other, tmp_path / "frames.h5")
    jaxevent.save(dataclasses.replace(recording, triggers=None), tmp_path / "none.h5")
    one, two = near[4].events, near[4].frames
    pose = np.column_stack([near[4].rotation, near[4].translation]).tolist()
    (tmp_path / "rig.toml").write_text(
        f"[events]\ncamera = {[one.fx, one.fy, one.cx, one.cy, *one.distortion]}\n"
        f"[frames]\ncamera = {[two.fx, two.fy, two.cx, two.cy, *two.distortion]}\n"
        f"transform = {pose}\n"
    )
    rest = ["--frames", tmp_path / "frames.h5", "--calibration", tmp_path / "rig.toml"]
    rest += ["--depth", 2, "--out", tmp_path / "out.h5"]

    def bad(path, *words, named):
        fails(capsys, ["register", tmp_path / path, *rest, *words], *named)
        assert not (tmp_path / "out.h5").exists()

    bad("own.h5", "--channel", 0, named=("--triggers",))
    bad("none.h5", "--triggers", named=("none.h5", "no external triggers"))
    bad("own.h5", "--triggers", "rising", "--channel", 5, named=("own.h5", "channel 5"))
    assert (
        cli.main([str(word) for word in ["register", tmp_path / "own.h5", *rest, "--triggers"]])
        == 0
    )
    said = capsys.readouterr().out
    assert f"frames with a trigger: {len(true)} of {len(true) + 2}\n" in said
    both = jaxevent.load(tmp_path / "out.h5")
    lag = float(both.extra["register_offset"])
    assert f"lag from triggers to mid-exposure, estimated: {lag:.6f} s\n" in said
    np.testing.assert_allclose(both.frames.t, true, atol=1e3)
    assert np.abs(both.frames.exposure - near[3].frames.exposure[0]).max() <= 1


@given(
    st.integers(3, 30),
    st.integers(0, 5),
    st.sets(st.integers(0, 29)),
    st.floats(-0.4, 0.4),
    st.integers(0, 2**32 - 1),
)
def test_each_frame_gets_its_own_trigger(frames, more, lost, off, seed):
    """Jitter of a tenth of a frame, triggers before and after, some lost, a start off by 0.4."""
    rng = np.random.default_rng(seed)
    mids = 10_000 * np.arange(-more, frames + more) + rng.integers(-500, 500, frames + 2 * more)
    stamps = 10_000 * np.arange(frames) + rng.integers(-400, 400, frames)
    stamps = stamps + 3_000_000
    own = np.arange(frames) + more
    gone = {more + row for row in lost if row < frames and row != frames // 2}
    left = np.array([place for place in range(len(mids)) if place not in gone])
    found = register.match_triggers(stamps, mids[left], -3 + off * 0.01)
    expected = np.full(frames, -1)
    for row, place in enumerate(own):
        if place not in gone:
            expected[row] = int(np.searchsorted(left, place))
    np.testing.assert_array_equal(found, expected)


def test_triggers_that_are_not_there():
    recording, _ = small()
    with pytest.raises(InputError, match="own: holds no external triggers"):
        register.trigger_times(recording)
    two = Triggers(np.arange(4), np.array([1, 1, 1, 1], np.int8), np.array([0, 1, 0, 1], np.uint8))
    recording = dataclasses.replace(recording, triggers=two)
    with pytest.raises(InputError, match="channels 0, 1.*--channel"):
        register.trigger_times(recording)
    with pytest.raises(InputError, match="channel 2"):
        register.trigger_times(recording, channel=2)
    with pytest.raises(InputError, match="'falling'"):
        register.trigger_times(recording, "falling", 1)
    t, exposure = register.trigger_times(recording, channel=1)
    assert t.tolist() == [1, 3] and exposure.tolist() == [0, 0]
    # A signal that begins and ends within the recording: what is cut off does not count.
    edges = np.array([0, 1, 0, 1, 1, 0, 1], np.int8)
    cut = Triggers(np.array([5, 10, 14, 20, 30, 38, 40]), edges, np.zeros(7, np.uint8))
    t, exposure = register.trigger_times(dataclasses.replace(recording, triggers=cut))
    assert t.tolist() == [12, 34] and exposure.tolist() == [4, 8]
