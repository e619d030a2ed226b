"""Moving objects: drawn as a slow oracle draws them, with the flow that integrates to their way."""

import dataclasses

import numpy as np
import pytest
from noise import write_config
from scipy.ndimage import map_coordinates

import jaxevent
from jaxevent import cli
from jaxevent.camera import UnknownResponse
from jaxevent.runs.evaluate import evaluate
from jaxevent.simulate import SENSORS, MovingObjects, simulate

# Whether a point (x, y) from the middle lies in the shape of radius r.
INSIDE = {
    "_disc": lambda x, y, r: x**2 + y**2 < r**2,
    "_box": lambda x, y, r: -r < x < r and -0.6 * r < y < 0.6 * r,
    "_triangle": lambda x, y, r: y > -r / 2 and y < r - np.sqrt(3) * abs(x),
    "_diamond": lambda x, y, r: abs(x) + abs(y) < r,
    "_cross": lambda x, y, r: max(abs(x), abs(y)) < r and min(abs(x), abs(y)) < r / 3,
}
SMALL = MovingObjects(size=(48, 40), seed=4)


def oracle(objects: MovingObjects, number: int, t: float, x: int, y: int, fine: int = 16):
    """The share of a pixel that an object covers, by points in it, and its intensity there."""
    surface = objects.surfaces[number]
    inside = INSIDE[surface.distance.__name__]
    px, py = (
        surface.middle[i] + surface.swing[i] * np.sin(surface.rate[i] * t + surface.phase[i])
        for i in range(2)
    )
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    share = np.mean(
        [inside(x + dx - px, y + dy - py, surface.radius) for dx in offsets for dy in offsets]
    )
    grain = map_coordinates(
        surface.spline, [[y - py], [x - px]], order=3, mode="grid-wrap", prefilter=False
    )
    return share, surface.light + surface.contrast * np.tanh(grain[0])


@pytest.mark.parametrize("number", range(1, 6))
def test_one_object_is_drawn_as_an_oracle_draws_it(number):
    objects = dataclasses.replace(SMALL)
    kept = (objects.surfaces[0], objects.surfaces[number])
    objects.__dict__["surfaces"] = kept
    t = 0.37
    image = objects.intensity(t)
    behind = kept[0].intensity(
        np.arange(48)[None] - kept[0].position(t)[0],
        np.arange(40)[:, None] - kept[0].position(t)[1],
    )
    shares = np.empty((40, 48))
    expected = np.empty((40, 48))
    for y in range(40):
        for x in range(48):
            shares[y, x], light = oracle(objects, 1, t, x, y)
            expected[y, x] = (1 - shares[y, x]) * behind[y, x] + shares[y, x] * light
    whole = (shares == 0) | (shares == 1)
    # A share that is that of a straight edge is wrong outside of corners, and where edges graze.
    wrong = np.abs(image - expected)[whole]
    assert (wrong > 1e-12).mean() < 0.02 and wrong.max() < 0.2
    error = np.abs(image - expected)[~whole]
    assert error.mean() < 0.02 and error.max() < 0.15
    inside = objects.visible(t) == 1
    assert (inside[shares > 0.7]).all() and not inside[shares < 0.3].any()


def test_farther_objects_are_hidden():
    objects = SMALL
    number = objects.visible(0.2)
    y, x = np.mgrid[:40, :48]
    for k, surface in enumerate(objects.surfaces):
        nearer = [one.covers(x, y, 0.2) for one in objects.surfaces[k + 1 :]]
        free = ~np.any(nearer, axis=0) if nearer else np.ones_like(x, bool)
        np.testing.assert_array_equal(number == k, surface.covers(x, y, 0.2) & free)
    assert len(np.unique(number)) > 3


def test_displacement_integrates_the_flow():
    objects, t0, t1 = MovingObjects(seed=2), 0.31, 0.36
    moves, hidden = objects.displacement(t0, t1)
    steps = np.linspace(t0, t1, 401)
    middles = (steps[1:] + steps[:-1]) / 2
    y, x = np.mgrid[:120, :160]
    # A point's flow is seen as long as nothing hides it: summed along the way of each surface.
    number = objects.visible(t0)
    total = np.zeros_like(moves)
    for t in middles:
        velocity = np.array([surface.velocity(t) for surface in objects.surfaces])
        total += velocity[number] * (t1 - t0) / 400
    np.testing.assert_allclose(moves, total, atol=1e-5)
    # What is not hidden shows the same surface, and the same intensity away from edges.
    px = np.rint(x + moves[..., 0]).astype(int).clip(0, 159)
    py = np.rint(y + moves[..., 1]).astype(int).clip(0, 119)
    there = objects.visible(t1)[py, px]
    assert (there == number)[~hidden].mean() > 0.98  # but for rounding at edges
    at = [y + moves[..., 1], x + moves[..., 0]]
    moved = map_coordinates(objects.intensity(t1), at, order=3, mode="nearest")
    error = np.abs(moved - objects.intensity(t0))
    assert np.median(error[~hidden]) < 0.003 and np.quantile(error[~hidden], 0.9) < 0.02
    assert error[hidden].mean() > 5 * error[~hidden].mean() and 0.001 < hidden.mean() < 0.2
    still, nothing = objects.displacement(t0, t0)
    assert not still.any() and not nothing.any()


def test_flow_is_that_of_the_surface_at_a_pixel():
    objects = MovingObjects(seed=3, speed=60, spread=0.5)
    for t in (0.0, 0.8):
        number = objects.visible(t)
        for k, surface in enumerate(objects.surfaces):
            h = 1e-5
            slope = (surface.position(t + h) - surface.position(t - h)) / (2 * h)
            own = objects.flow(t)[number == k]
            np.testing.assert_allclose(own, np.broadcast_to(slope, own.shape), atol=1e-4)


def test_speeds_are_those_asked_for():
    t = np.linspace(0, 60, 3_000)
    for seed in range(3):
        objects = MovingObjects(seed=seed, speed=50, spread=0.3)
        speeds = [
            np.sqrt(np.mean(np.sum([surface.velocity(float(s)) ** 2 for s in t], axis=1)))
            for surface in objects.surfaces
        ]
        assert speeds[0] == pytest.approx(20, rel=0.03)
        assert all(0.97 * 35 < speed < 1.03 * 65 for speed in speeds[1:])
        assert np.ptp(speeds[1:]) > 3
    still = MovingObjects(seed=2, background=0).surfaces
    assert not still[0].velocity(0.3).any() and still[1].velocity(0.3).any()
    resting = MovingObjects(seed=1, speed=0)
    np.testing.assert_array_equal(resting.intensity(0.0), resting.intensity(0.7))


def test_a_sensor_records_them():
    sensor = dataclasses.replace(SENSORS["davis"], frame_rate=25, response=UnknownResponse())
    objects = MovingObjects(size=(64, 48), duration=0.3, seed=5)
    recording = simulate(objects, sensor, seed=5).check()
    assert len(recording.frames) == 8 and len(recording.events) > 1000
    images = np.asarray(recording.frames.images)
    assert 10 < images.min() and images.max() < 245  # nothing clips
    truth = np.mean([objects.intensity(0.0025 + s) for s in np.linspace(-1, 1, 9) * 0.0022], 0)
    assert np.abs(images[0] / 255 - truth).mean() < 0.01
    at = float(recording.extra["hdr_t"][0]) * 1e-6
    np.testing.assert_allclose(recording.extra["hdr"][0], objects.intensity(at), atol=1e-6)
    same = MovingObjects(size=(64, 48), duration=0.3, seed=5).intensity(0.1)
    np.testing.assert_array_equal(same, objects.intensity(0.1))
    assert not np.array_equal(same, MovingObjects(size=(64, 48), seed=6).intensity(0.1))


@pytest.mark.parametrize(
    "wrong", [{"size": (31, 99)}, {"speed": -1}, {"speed": np.inf}, {"spread": 1.0}]
)
def test_objects_that_are_not_possible(wrong):
    with pytest.raises(jaxevent.InputError, match="objects of .* are not possible; give"):
        MovingObjects(**wrong)


def test_a_background_that_is_not_possible():
    with pytest.raises(jaxevent.InputError, match="background of -1 times .* give a number"):
        MovingObjects(background=-1)


@pytest.mark.slow
def test_the_command_makes_and_evaluations_use_them(tmp_path, capsys):
    out = tmp_path / "objects.h5"
    argv = f"simulate --objects --size 48,40 --duration 0.4 --speed 50 --seed 3 --out {out}"
    assert cli.main(argv.split()) == 0 and "20 frames" in capsys.readouterr().out
    text = 'recordings = ["objects.h5"]\nprotocol = "reference"\n[[method]]\nname = "blend"\n'
    (row,) = evaluate(write_config(tmp_path, text))
    assert 0 < row["mse"] < 0.05
    for option, said in (("--cut 50", "--cut is for a video"), ("--speed fast", "such as 200")):
        assert cli.main(f"simulate --objects {option} --out {tmp_path / 'b.h5'}".split()) == 2
        assert said in capsys.readouterr().err
