"""Thresholds from events alone: simulated truth, what is not identifiable, and odd input."""

import dataclasses

import numpy as np
import pytest

from jaxevent.calibration import calibrate_events
from jaxevent.recording import Recording
from jaxevent.simulate import MovingObjects, Sensor, faults, simulate


@pytest.fixture(scope="module")
def recording():
    scene = MovingObjects((96, 72), duration=0.8, speed=150, background=1.0, seed=103)
    sensor = Sensor(c_on=0.12, c_off=0.2, mismatch=0.1, background_rate=0.1, frame_rate=5)
    return dataclasses.replace(simulate(scene, sensor, seed=103), frames=None)


def test_ratio_is_that_of_the_sensor(recording):
    found = calibrate_events(recording)
    assert found.ratio.low < 0.6 < found.ratio.high
    assert found.ratio.value == pytest.approx(0.6, rel=0.15)
    ratio = np.median(found.thresholds[0] / found.thresholds[1])
    assert ratio == pytest.approx(found.ratio.value, rel=0.05)


def test_inverted_polarity_inverts_the_ratio(recording):
    one, other = (calibrate_events(r) for r in (recording, faults.invert_polarity(recording)))
    assert one.ratio.value * other.ratio.value == pytest.approx(1, rel=1e-6)
    np.testing.assert_allclose(one.thresholds, other.thresholds[::-1], rtol=1e-4)


def test_one_polarity_determines_no_ratio(recording):
    found = calibrate_events(faults.set_polarity_on(recording))
    assert not found.ratio.is_identifiable and "one polarity" in found.ratio.note
    assert (found.thresholds == 1).all()


def test_few_events_determine_no_ratio():
    for n in (1, 3):
        made = Recording.from_arrays(np.arange(n), [0] * n, [0] * n, [1] * n, width=1, height=1)
        found = calibrate_events(made)
        assert not found.ratio.is_identifiable and (found.thresholds == 1).all()


def test_noise_has_no_spread_among_pixels():
    rng = np.random.default_rng(100)
    t, n = np.sort(rng.integers(0, 10**6, 20_000)), 20_000
    place = rng.integers(0, 64 * 48, n)
    made = Recording.from_arrays(
        t, place % 64, place // 64, rng.integers(0, 2, n), width=64, height=48
    )
    found = calibrate_events(made)
    assert found.spread == 0 and found.ratio.low < 1 < found.ratio.high
