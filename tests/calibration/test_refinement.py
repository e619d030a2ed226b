"""Numbers by which a method predicts hidden frames best, with a method of a known best."""

import types

import numpy as np
import pytest

import jaxevent
from jaxevent.reconstruction import augment
from jaxevent.reconstruction.consistency import change_ratio, thresholds_are_doubtful
from jaxevent.reconstruction.refinement import choose
from jaxevent.simulate import MovingObjects, Sensor, simulate

Params = jaxevent.METHODS["mc"].Params


@pytest.fixture(scope="module")
def recording():
    scene = MovingObjects((48, 32), duration=0.5, speed=60, background=0.8, seed=3)
    return simulate(scene, Sensor(c_on=0.06, c_off=0.06, frame_rate=30), seed=3)


def method_with_loss(recording, loss):
    """A method whose images are off by loss(params) from the recording's frames."""

    def estimate(given, params, progress):
        def read(times, extrapolate):
            rows = np.searchsorted(recording.frames.t, times)
            true = recording.response.intensity(recording.frames.intensity[rows])
            y = np.arange(given.height)  # a band of rows may be cut out
            return np.asarray(true)[:, y] + loss(params), None, None

        return read

    return types.SimpleNamespace(estimate=estimate)


def test_each_step_takes_the_value_that_lowers_the_error(recording):
    asked = []

    def loss(params):
        asked.append((round(float(params.c_on), 4), round(float(params.rho_ref), 4)))
        return 0.2 * abs(np.log(params.c_on / 0.1)) + 20 * abs(params.rho_ref - 2e-3)

    method = method_with_loss(recording, loss)
    steps = [
        [{"c_on": 0.15}, {"c_on": 0.11}, {"c_on": 0.3}],
        [{"rho_ref": 0.0015}],
        [{"c_on": 0.9}],
    ]
    found = choose(method, recording, Params(c_on=0.2), steps)
    assert found == {"c_on": 0.11, "rho_ref": 0.0015}
    assert set(asked) == {
        (0.2, 0), (0.15, 0), (0.11, 0), (0.3, 0), (0.11, 0.0015), (0.9, 0.0015),
    }  # fmt: skip
    assert choose(method, recording, Params(c_on=0.1, rho_ref=0.002), steps) == {}
    assert choose(method, recording.with_frames(slice(0, 2)), Params(c_on=0.9), steps) == {}


def test_thresholds_that_contradict_frames_are_taken_if_they_predict_better(recording, monkeypatch):
    """By a stub in the place of mc, which asks for none of its own images."""
    clock = {"clock_offset": 0.0, "event_delay": 1e-3}
    wrong = Params(c_on=0.5, c_off=0.5, I0=0.003, **clock)
    assert thresholds_are_doubtful(recording, wrong)
    assert not thresholds_are_doubtful(recording, wrong.replace(c_on=0.06, c_off=0.06))
    true = jaxevent.calibrate(recording, 0.003)
    assert true.c_on.value == pytest.approx(0.06, rel=0.3)
    for prefers_low in (True, False):
        sign = 1 if prefers_low else -1
        method = method_with_loss(recording, lambda p, sign=sign: 0.1 + 0.02 * sign * float(p.c_on))
        monkeypatch.setattr(Params, "validator", method)
        monkeypatch.setattr(augment, "recall_numbers", lambda recording, what, compute: compute())
        values = augment.calibrated_values(recording, wrong, ("c_on", "c_off", "rho_ref")).found
        assert ("c_on" in values) == prefers_low, values
        if prefers_low:
            assert values["c_on"] == pytest.approx(true.c_on.value, rel=1e-6)


def test_the_ratio_of_changes_counts_what_dead_times_miss():
    """Events of one polarity every 2 ms with 1 ms lost after each: half of the change is seen."""
    n, step = 60, 2_000
    pixels = np.arange(400)
    t = np.repeat(1 + step * np.arange(n), len(pixels))
    y, x = np.divmod(np.tile(pixels, n), 20)
    events = jaxevent.recording.Events(
        t, x.astype(np.uint16), y.astype(np.uint16), np.ones(len(t), bool)
    )
    grey = 0.1 * np.exp(0.05 * np.arange(4))  # ln I rises by 0.05 in 20 ms, by 0.005 an event
    frames = jaxevent.recording.Frames(
        20_000 * np.arange(1, 5),  # after a first interval, whose first gaps are not known
        np.broadcast_to(grey[:, None, None], (4, 20, 20)).astype(np.float32).copy(),
        np.zeros(4, np.int64),
    )
    recording = jaxevent.recording.Recording("steady", 20, 20, events, frames)
    params = Params(c_on=0.0025, c_off=0.0025, I0=1e-6)
    lost = change_ratio(recording, params)
    counted = change_ratio(recording, params.replace(rho_ref=1e-3))
    assert lost is not None and lost.ratio == pytest.approx(2, rel=1e-3)
    assert counted is not None and counted.ratio == pytest.approx(1, rel=1e-3)
