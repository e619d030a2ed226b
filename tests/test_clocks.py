"""Frames and events whose times cannot be of one clock, wherever both are combined."""

import dataclasses

import numpy as np
import pytest
from commands import fails
from formats import events_of

import jaxevent
from jaxevent import InputError, cli
from jaxevent.errors import InputWarning
from jaxevent.events.clocks import compare_clocks
from jaxevent.methods import find
from jaxevent.recording import Frames, Recording

SIZE = (8, 6)
MS = 1000


def recording(frames=range(0, 1001, 50), events=(0, 1000), exposure=0):
    """Frames at these times (ms) and 200 events between two times (ms)."""
    t = np.asarray(frames, float) * MS
    images = np.random.default_rng(1).integers(20, 200, (len(t), 6, 8)).astype(np.uint8)
    some = events_of(2, 200, SIZE, span=events[1] * MS - events[0] * MS, start=events[0] * MS)
    some = dataclasses.replace(some, t=np.linspace(*np.multiply(events, MS), 200).astype(int))
    shots = Frames(t.astype(np.int64), images, np.full(len(t), exposure * MS))
    return Recording("rec", *SIZE, some, shots)


@pytest.mark.parametrize(
    ("frames", "events"),
    [
        (range(0, 1001, 50), (0, 1000)),
        (range(0, 1001, 50), (800, 1000)),  # still until then
        (range(0, 1001, 50), (100, 150)),
        (range(0, 1001, 50), (-2000, 3000)),
        (range(0, 1001, 50), (1050, 1100)),  # a part in which the events begin after the frames
        (range(0, 60_001, 50), (59_000, 59_500)),  # still for a minute
        ([0, 40], (30, 500)),
        ([0, 500], (20, 480)),
        ([-4900], (0, 400)),  # a lone frame
        ([0], (5000, 5100)),
        ([5000], (0, 5100)),
        (np.arange(0, 100, 0.25), (0, 1000)),  # 4,000 per second
    ],
)
def test_spans_of_one_clock(frames, events):
    assert compare_clocks(recording(frames, events)) is None


@pytest.mark.parametrize(
    ("frames", "events", "is_disjoint"),
    [
        (range(0, 1001, 50), (1_539_262_100_000, 1_539_262_101_000), True),
        (range(7000, 8001, 50), (0, 1000), True),
        (range(0, 1001, 50), (4000, 5000), True),
        (range(0, 1001, 50), (1400, 2000), False),
        (range(0, 1001, 50), (800, 1800), False),
        (range(-900, 101, 50), (0, 1000), False),
        ([1_539_262_100_000], (0, 1000), True),
        (np.arange(0, 1001, 50) * 1000, (0, 1000), False),  # ns read as us
        (np.arange(0, 1001, 50) / 1000, (0, 1000), False),  # ms read as us
    ],
)
def test_spans_of_two_clocks(frames, events, is_disjoint):
    one = recording(frames, events)
    mismatch = compare_clocks(one)
    assert mismatch.is_disjoint == is_disjoint
    first, last = one.frames.t[0] / 1e6, one.frames.t[-1] / 1e6
    assert f"the frames last from {first:.6f} to {last:.6f} s, the events from" in mismatch.text
    assert f"from {events[0] / 1000:.6f} to {events[1] / 1000:.6f} s" in mismatch.text


def test_few_events_and_none():
    one = recording()
    assert compare_clocks(dataclasses.replace(one, frames=None)) is None
    assert compare_clocks(dataclasses.replace(one, events=one.events[:0])) is None
    near, far = recording(range(800, 1801, 50)), recording(range(7000, 8001, 50))
    few = [dataclasses.replace(some, events=some.events[::4]) for some in (near, far)]
    assert compare_clocks(few[0]) is None
    assert compare_clocks(few[1]).is_disjoint


def test_exposures_and_the_offset_count():
    # The exposure of the lone frame begins 9.95 s after the events.
    assert compare_clocks(recording([12_000])) is not None
    assert compare_clocks(recording([12_000], exposure=2_100)) is None
    far = recording(range(7000, 8001, 50))
    assert compare_clocks(far, -7.0) is None
    mismatch = compare_clocks(recording(), 7.0)
    assert mismatch.is_disjoint and "8.000000 s with clock_offset = 7 s, the" in mismatch.text


JOINING = ("akf", "aks", "cf", "cf-augmented", "edi", "augmented", "mc")
APART = ("high-pass", "blend", "last-frame")


@pytest.mark.parametrize("name", JOINING)
def test_methods_that_combine_both_refuse_other_clocks(name):
    method = find(name)
    far, near = recording(range(7000, 8001, 50)), recording(range(800, 1801, 50))
    with pytest.raises(InputError, match="rec: the frames last .* cannot be one clock and unit; c"):
        method.estimate(far)
    with pytest.raises(InputError, match="cannot be one clock"):
        method.prepare(far, [7_000_000])
    with pytest.warns(InputWarning, match="rec: the frames last .* unlikely of one clock and unit"):
        method.estimate(near)
    with pytest.raises(InputError, match="cannot be one clock"):
        method.prepare_images(far, [7_000_000])
    # With the offset they are on one clock.
    method.estimate(far, method.Params().replace(clock_offset=-7.0))


@pytest.mark.parametrize("name", APART)
def test_methods_of_one_of_them_do_not_mind(name):
    method = find(name)
    times = [500_000] if name == "high-pass" else [7_500_000]
    method.estimate(recording(range(7000, 8001, 50)))
    method.prepare(recording(range(7000, 8001, 50)), times)


def test_commands_that_combine_both(tmp_path, capsys):
    path, out = tmp_path / "far.h5", tmp_path / "out.h5"
    jaxevent.save(recording(range(7000, 8001, 50)), path)
    spans = "the frames last from 7.000000 to 8.000000 s, the events from 0.000000 to 1.000000 s"
    assert cli.main(["info", str(path)]) == 0
    assert f"fault           disjoint clocks: {spans}" in capsys.readouterr().out
    for method in ("mc", "high-pass"):
        fails(capsys, ["reconstruct", path, "--method", method, "--out", out], path, spans)
    for name, more in (("fit", 'fit = ["c_on"]\n'), ("evaluate", "")):
        config = tmp_path / f"{name}.toml"
        recordings = f'recordings = ["{path}"]\n'
        config.write_text(f'{recordings}[[method]]\nname = "akf"\n{more}')
        assert cli.main([name, str(config), "--out", str(tmp_path / name)]) != 0
        said = capsys.readouterr()
        assert spans in said.err + said.out
    # Images of the events alone, at times of the events.
    words = ["reconstruct", str(path), "--method", "high-pass", "--rate", "10", "--out", str(out)]
    assert cli.main(words) == 0
    assert "11 images" in capsys.readouterr().out
    near = tmp_path / "near.h5"
    jaxevent.save(recording(range(800, 1801, 50)), near)
    words = ["reconstruct", str(near), "--method", "edi", "--out", str(out), "--force"]
    assert cli.main(words) == 0
    said = capsys.readouterr().err
    assert said.count("clock and unit") == 1 and "unlikely of one clock and unit" in said


def test_parts_say_what_they_leave_out(tmp_path):
    one = dataclasses.replace(
        recording(range(0, 101, 50)), notes=("times are ms",), left_out={"camera": "a fisheye lens"}
    )
    part = one[200 * MS : 400 * MS]
    assert part.frames is None and part.notes == one.notes
    outside = "its 3 frames from 0 to 0.1 s are outside the times taken"
    assert part.left_out == {"camera": "a fisheye lens", "frames": outside}
    with pytest.raises(InputError, match=rf"holds no frames, .* needs \({outside}\)"):
        find("aks").estimate(part)
    assert one[0 : 60 * MS].left_out == {"camera": "a fisheye lens"}
    none = one.with_frames(slice(3, None))
    assert none.frames is None and "not among those chosen" in none.left_out["frames"]
    assert one.with_frames(slice(1, 2)).left_out == one.left_out
    # A field that is there is not left out any more.
    assert one.describe_left_out("camera") == " (a fisheye lens)"
    camera = jaxevent.camera.PinholeCamera(9.0, 9.0, 4.0, 3.0, (0.0,) * 5)
    assert dataclasses.replace(one, camera=camera).describe_left_out("camera") == ""


@pytest.mark.parametrize("model", ["rotation", "general"])
def test_motion_names_the_calibration_that_is_not_read(model):
    one = dataclasses.replace(
        recording(), frames=None, left_out={"camera": "the lens model 'omni' is not known"}
    )
    voting = find("voting")
    with pytest.raises(InputError, match=r"has no calibration.*the lens model 'omni' is not known"):
        voting.estimate(one, model=model)
