"""Evidence for motions of points; locks; cameras at rest, by events, frames or gyro."""

import dataclasses

import numpy as np
import pytest
from points import HEIGHT, WIDTH, moved, recorded, turning

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.estimator import HostEstimator, InconsistentMotionWarning
from jaxevent.egomotion.evidence import Evidence, EvidenceTest, LockDetector, report_before_lock
from jaxevent.egomotion.models import Planar, Rotation
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.scores import errors_by_part
from jaxevent.parameters import Parameters
from jaxevent.recording import Events, Imu

CAMERA = PinholeCamera(100.0, 100.0, 59.5, 44.5)
XI, F = pixel_coordinates(WIDTH, HEIGHT, CAMERA)


def test_true_motions_are_supported_and_others_are_not():
    omega = np.array([0.5, 1.5, -1.2])
    recording = moved(turning(omega), 0.2, 400, seed=5, camera=CAMERA)
    test = EvidenceTest(Rotation(F), XI)

    def measure(motion):
        found = test.measure(recording.events, 150_000, motion, 1e-4 * np.eye(3), 6.5, 0.1)
        assert found is not None
        return found

    true = measure(omega)
    assert true.is_supported and true.rest > 3 and true.blocks > 4
    assert true.length == pytest.approx(6.5 / 170, rel=0.15)
    # The parabola through rivals beside the motion points to the truth.
    beside = measure(omega + [0.0, 0.25, 0.0])
    assert beside.offset[1] == pytest.approx(-0.25, abs=0.1)
    for wrong in (-omega, [1.5, -0.5, 1.0], 0.4 * omega):
        assert not measure(np.asarray(wrong)).is_supported
    assert test.measure(recording.events, 100, omega, np.eye(3), 6.5, 0.1) is None  # few events


def test_motions_along_parallel_edges_are_not_supported():
    """Columns of events that go to the right at 100 px/s; other motions up or down explain them."""
    rng, test = np.random.default_rng(6), EvidenceTest(Planar(), XI)
    t = np.sort(rng.integers(0, 100_000, 6000))
    column = rng.integers(-1, 8, 6000)
    x = np.rint(16 * column + 100e-6 * t).astype(int)
    inside = (x >= 0) & (x < WIDTH)
    y, p = rng.integers(0, HEIGHT, 6000), column % 2 == 0
    events = Events(*(v[inside] for v in (t, x.clip(0), y, p)))
    for up in np.linspace(-100.0, 100.0, 9):
        found = test.measure(events, 100_000, np.array([100.0, up]), np.eye(2), 6.5, 0.1)
        assert found is not None and found.rest > 3 and not found.is_supported


@pytest.mark.parametrize(
    ("size", "cell", "margin"), [((40, 30), 6, 4), ((WIDTH, HEIGHT), 22, 14), ((160, 128), 24, 16)]
)
def test_votes_equal_a_loop(size, cell, margin):
    """Sums over pairs of early and late events of overlaps of their bilinear kernels."""
    rng, n = np.random.default_rng(0), 150
    t = np.sort(rng.integers(0, 40_000, n))
    x, y, p = rng.integers(0, 40, n), rng.integers(0, 30, n), rng.random(n) < 0.5
    recording = recorded(t, x, y, p, *size)
    test, U = EvidenceTest(Planar(), pixel_coordinates(*size, None)[0]), [100.0, -50.0]
    found = test.measure(recording.events, 40_000, np.array(U), np.eye(2), 4.0, 0.1)
    length = 4.0 / np.hypot(U[0], U[1])

    def votes(U):
        total = np.zeros((12, 12))
        tau = t * 1e-6 - 0.04 + length / 2
        use = (np.abs(tau) > length / 6) & (t >= round(40_000 - 1e6 * length))
        at = (np.stack([x, y], 1) + 0.5 + margin - np.outer(tau, U)) / 2  # pixels of 2 px
        for i in np.flatnonzero(use & (tau < 0)):
            for j in np.flatnonzero(use & (tau > 0)):
                if np.abs(at[i] - at[j]).max() < 2:
                    for a in np.ndindex(2, 2):
                        pixel = np.floor(at[i]) + a
                        one, two = (np.maximum(1 - np.abs(at[k] - pixel), 0).prod() for k in (i, j))
                        row, column = (2 * pixel[::-1] // cell).astype(int)
                        total[row, column] += one * two * (1 if p[i] == p[j] else -1)
        return total

    D = votes(np.array(U)) - votes(np.zeros(2))
    assert found is not None and np.abs(D).sum() > 0.5
    np.testing.assert_allclose(found.rest, D.sum() / np.sqrt((D**2).sum()), rtol=1e-9)


class Script(EvidenceTest):
    """Evidence that is given."""

    def __init__(self, rows):
        self.rows = iter(rows)

    def speed(self, motion):
        return np.linalg.norm(motion, axis=1)

    def measure(self, *_):
        rest, rival, blocks = next(self.rows)
        return Evidence(rest, rival, np.zeros(2), 0.0, 0.0, 9.0, blocks, 0.01)


def told_by(rows, drift=0.0, moves=False):
    """Whether each of some windows 10 ms apart is told, whose motion drifts by so many sigmas."""
    lock = LockDetector(Script(rows), 6.5, 0.1, lambda m: np.zeros(2), moves)
    mean = np.array([100.0, 0.0])
    return [
        bool(lock.update(None, np.array([50]), np.array([10_000 * k]), mean[None] + drift * k,
                         np.eye(2)[None], np.array([False]))[0])
        for k in range(len(rows))
    ]  # fmt: skip


def test_a_lock_needs_evidence_twice_and_keeps_until_it_fails():
    good, bad, weak = (4.0, 1.0, 9.0), (1.0, -4.0, 9.0), (2.0, -1.0, 9.0)
    assert told_by([bad, good, good, good, weak, bad, good]) == [
        False, False, True, True, True, False, False,
    ]  # fmt: skip
    assert not any(told_by([weak] * 6)) and not any(told_by([good] * 6, drift=9.0))
    compact = [(4.0, 1.0, 2.0)] * 6
    assert not any(told_by(compact)) and any(told_by(compact, moves=True))


def test_a_search_and_a_pause_begin_anew():
    lock = LockDetector(Script([(4.0, 1.0, 9.0)] * 20), 6.5, 0.1, lambda m: np.ones(2))

    def update(t, searching):
        n = len(t)
        mean, cov = np.ones((n, 2)), np.tile(np.eye(2), (n, 1, 1))
        locked = lock.update(None, np.full(n, 50), np.array(t), mean, cov, np.array(searching))
        return locked.tolist()

    for k in range(4):
        last = update([10_000 * k], [False])
    assert last == [True]
    assert update([40_000, 41_000, 42_000], [False, True, False]) == [True, False, False]
    for k in range(5, 9):
        last = update([10_000 * k], [False])
    assert last == [True] and update([500_000], [False]) == [False]


def test_a_motion_whose_events_cease_is_lost_with_them():
    """Noise alone after 10 batches of 50 events; a motion half as fast makes half as many."""

    def told(count, speed):
        lock = LockDetector(Script([(4.0, 1.0, 9.0)] * 20), 6.5, 0.1, lambda m: np.ones(2), True)
        n = len(count)
        mean = np.stack([speed, np.zeros(n)], 1)
        return [
            lock.update(None, count[k : k + 1], np.array([10_000 * k]), mean[k : k + 1],
                        np.eye(2)[None], np.zeros(1, bool)).item()
            for k in range(n)
        ]  # fmt: skip

    steady, slower = np.full(14, 100.0), np.repeat([100.0, 50.0], [10, 4])
    stopped = np.repeat([50, 5], [10, 4])
    assert told(stopped, steady)[8:12] == [True, True, False, False]
    assert all(told(np.repeat([50, 25], [10, 4]), slower)[8:])


def test_a_motion_is_told_again_after_a_pause_shorter_than_a_window():
    """A window is 6.5 px at 100 px/s, 65 ms; batches of 10 ms hold 50 events, in a pause 2."""

    def told(pause):
        lock, n = LockDetector(Script([(4.0, 1.0, 9.0)] * 30), 6.5, 0.1, lambda m: np.ones(2)), 30
        count = np.full(n, 50)
        count[10 : 10 + pause] = 2
        return [
            lock.update(None, count[k : k + 1], np.array([10_000 * k]), np.array([[100.0, 0]]),
                        np.eye(2)[None], np.zeros(1, bool)).item()
            for k in range(n)
        ]  # fmt: skip

    short, long = told(2), told(7)
    assert all(short[5:10]) and short[10:12] == [False, False] and all(short[12:])
    assert not any(long[10:18]) and all(long[25:])


def test_earlier_estimates_are_told_where_they_agree():
    mean = np.array([[0.0], [9.0], [1.0], [1.1], [1.0]])
    told, covariance, drift = report_before_lock(
        np.arange(5) * 1000, mean, np.full((5, 1, 1), 0.1), np.zeros(5, bool),
        np.array([False, False, False, False, True]), lambda m: np.zeros(1),
    )  # fmt: skip
    assert told.tolist() == [False, False, True, True, True]
    np.testing.assert_allclose(covariance[:, 0, 0], [0.1, 0.1, 0.1, 0.11, 0.1])
    np.testing.assert_allclose(drift[told, 0, 0], [0, 0.01, 0])


def test_a_motion_that_was_just_told_drifts_on():
    """Told 2 ms after a search, it counts as settled 4 ms later: then it is 1, before it was 3."""
    mean = np.array([9.0, 3, 3, 2.5, 2, 1.5, 1.2, 1, 1, 1])[:, None]
    searching = np.arange(10) == 0
    told = np.arange(10) >= 3
    found, _, drift = report_before_lock(
        np.arange(10) * 1000, mean, np.full((10, 1, 1), 0.1), searching, told,
        lambda m: np.full(1, 9.0),
    )  # fmt: skip
    assert found.tolist() == (~searching).tolist()
    added = np.where(searching | (np.arange(10) > 7), 0, (mean[:, 0] - 1) ** 2)
    np.testing.assert_allclose(drift[:, 0, 0], added)


def estimate(model, mean, t):
    mean = np.tile(np.asarray(mean, float), (len(t), 1))
    return MotionEstimate.from_arrays(model, t, mean, np.tile(1e-2 * np.eye(mean.shape[1]),
                                                              (len(t), 1, 1)))  # fmt: skip


def test_a_gyro_contradicts_a_turn_that_things_make():
    recording = moved(turning(np.array([0.0, 2.0, 0.0])), 0.2, 200, camera=CAMERA)
    t = np.arange(0, 200_001, 1000)
    motion = estimate("rotation", [0.0, 2.0, 0.0], np.arange(20_000, 190_000, 20_000))
    for rate, valid in ((0.05, False), (2.1, True)):
        gyro = np.tile([0.0, 0.0, rate], (len(t), 1))  # in other axes
        shown = dataclasses.replace(recording, imu=Imu(t, gyro, np.zeros_like(gyro)))
        told, line = motion.with_flow_consistency(shown)
        assert (told.valid == valid).all() and ("gyro contradicts" in line) != valid


def test_events_of_a_part_of_the_image_do_not_tell_a_camera_motion():
    recording = moved(lambda at: np.array([80.0, 20.0]), 0.3, 200, seed=2)
    motion = estimate("planar", [80.0, 20.0], np.array([60_000, 250_000]))
    same, _ = motion.with_flow_consistency(recording)
    assert same.valid.all()
    e = recording.events
    near = (e.x < 60) & (e.y < 45)
    part = dataclasses.replace(recording, events=Events(e.t[near], e.x[near], e.y[near], e.p[near]))
    told, line = motion.with_flow_consistency(part)
    assert not told.valid.any() and "may stand still" in line
    assert np.isnan(told(200_000, extrapolate=True).mean).all()
    assert told.with_flow_consistency(part) == (told, line)  # once
    # Noise over the whole image does not support a motion of the camera either.
    rng, n = np.random.default_rng(3), 2 * len(part.events)
    noise = rng.integers(0, 300_000, n), rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    columns = zip(dataclasses.astuple(part.events), (*noise, rng.random(n) < 0.5), strict=True)
    columns = [np.concatenate(pair) for pair in columns]
    order = np.argsort(columns[0], kind="stable")
    noisy = dataclasses.replace(part, events=Events(*(c[order] for c in columns)))
    method = HostEstimator("own", Parameters, lambda params, inputs: motion)
    with pytest.warns(InconsistentMotionWarning, match="may stand still"):
        assert not method.estimate(noisy, model="planar").valid.any()


def test_a_camera_motion_is_told_on_a_small_sensor_where_the_whole_of_it_moves():
    flow, motion = (lambda at: np.array([80.0, 20.0])), [80.0, 20.0]
    recording = moved(flow, 0.3, 60, seed=2, size=(40, 30))
    estimates = estimate("planar", motion, np.arange(60_000, 260_000, 40_000))
    told, line = estimates.with_flow_consistency(recording)
    assert told.valid.all() and not line
    e = recording.events
    near = np.hypot(e.x - 20.0, e.y - 15.0) < 7  # 13 % of the sensor
    part = dataclasses.replace(recording, events=Events(e.t[near], e.x[near], e.y[near], e.p[near]))
    told, line = estimates.with_flow_consistency(part)
    assert not told.valid.any() and "may stand still" in line


def test_a_heading_that_is_not_observable_is_empty():
    motion = estimate("general", [0.0, 0, 1, 0.1, 0, 0], np.array([0, 100_000]))
    wide = np.diag([1.2, 1.2, 0, 1e-4, 1e-4, 1e-4])[None].repeat(2, 0)
    motion = dataclasses.replace(motion, covariance=wide)
    mean, covariance, valid = motion(50_000)
    assert valid.all() and np.isnan(mean[0, :3]).all() and mean[0, 3] == 0.1
    table = motion.to_dataframe(50_000)
    assert table[["tx", "sigma_tx"]].isna().all().all() and table["lost"].tolist() == [0]
    errors = errors_by_part(motion.model, mean, np.array([[0, 0, 1, 0.1, 0, 0.0]]))
    assert np.isnan(errors["heading"]).all() and errors["error"][0] == 0
    assert covariance[0, 0, 0] == 1.2
