"""`jaxevent filter`: the functions of `jaxevent.events`, in the order of its help."""

import dataclasses

import numpy as np
import pytest
from commands import described, fails
from noise import HEIGHT, WIDTH, small

import jaxevent
from jaxevent import cli, events
from jaxevent.camera import PinholeCamera


@pytest.fixture
def stored(tmp_path):
    camera = PinholeCamera(20.0, 20.0, WIDTH / 2, HEIGHT / 2, (-0.3, 0.0, 0.0, 0.0, 0.0))
    recording = dataclasses.replace(small(), camera=camera)
    jaxevent.save(recording, tmp_path / "r.h5")
    return recording


def test_steps_are_those_of_the_library_in_the_order_of_the_help(stored, tmp_path, capsys):
    words = [
        "--period 900 --downsample 2 --polarity off --refractory 3 --background 4000 --undistort",
        f"--crop 1 1 {WIDTH - 2} {HEIGHT - 2} --hot-pixels --start 0.01",
    ]
    source, target = tmp_path / "r.h5", tmp_path / "out.h5"
    assert cli.main(["filter", str(source), str(target), *" ".join(words).split()]) == 0
    told = capsys.readouterr().out
    expected = events.crop(events.remove_hot_pixels(stored[0.01:]), 1, 1, WIDTH - 2, HEIGHT - 2)
    expected = events.filter_background(events.undistort(expected), 4000)
    expected = events.select_polarity(events.filter_refractory(expected, 3), False)
    expected = events.downsample(expected, 2, 900)
    found = jaxevent.load(target)
    assert described(target)["inputs"].keys() == {str(source)}
    assert 0 < len(found.events) < len(stored.events)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(found.events, name), getattr(expected.events, name))
    np.testing.assert_array_equal(found.frames.images, expected.frames.images)
    assert (found.name, found.camera) == (stored.name, expected.camera)
    assert told.splitlines()[0].split() == ["events", f"{len(stored.events):,}", "100.0", "%"]


def test_what_cannot_be_filtered(stored, tmp_path, capsys):
    source, target = tmp_path / "r.h5", tmp_path / "out.h5"
    fails(capsys, ["filter", source, target], source, "no filter is given", "--hot-pixels")
    fails(capsys, ["filter", source, target, "--crop", 0, 0, 500, 2], "500x2", "not inside")
    fails(capsys, ["filter", source, target, "--background", 0], "is 0 us")
    fails(capsys, ["filter", source, target, "--downsample", 0], "0x0", "whole number from 1")
    fails(capsys, ["filter", source, target, "--start", "nan"], "the start is nan")
    fails(capsys, ["filter", source, target, "--start", 90], source, "no event")
    assert not target.exists()


def test_hot_pixels_beside_each_other_are_left_out(tmp_path):
    """A fifth of the pixels fires 60 times, others once."""
    rng = np.random.default_rng(7)
    hot = rng.random((30, 40)) < 0.2
    y, x = np.repeat(np.indices(hot.shape).reshape(2, -1), np.where(hot, 60, 1).ravel(), axis=1)
    t, p = np.sort(rng.integers(0, 1_000_000, len(x))), rng.random(len(x)) < 0.5
    order = rng.permutation(len(x))
    source, target = tmp_path / "hot.npz", tmp_path / "clean.h5"
    np.savez(source, t=t, x=x[order], y=y[order], p=p, width=40, height=30)
    assert cli.main(["filter", str(source), str(target), "--time-unit", "us", "--hot-pixels"]) == 0
    left = jaxevent.load(target).events
    assert hot[left.y, left.x].mean() < 0.05
