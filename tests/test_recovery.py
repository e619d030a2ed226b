"""Parameters that data were drawn with are found by the likelihood alone."""

import numpy as np
import pytest
from scripts import script

import jaxevent
from jaxevent.runs.reconstruction import Objective, Problem, cut_windows
from jaxevent.tuning import Settings


@pytest.fixture(scope="module")
def recovery():
    return script("recovery")


@pytest.mark.slow
def test_intervals_hold_the_noises_of_the_akf(recovery, optimised):
    """The demonstration in small."""
    true, names = recovery.AKF, ["sigma_proc", "sigma_iso"]
    start = jaxevent.akf.Params(**true, rho=recovery.RHO, I0=recovery.I0, P0=recovery.P0,
                                kappa=1e-9, calibrate=False, deblur=False)  # fmt: skip
    start = start.replace(sigma_proc=0.1, sigma_iso=0.2)
    drawn = cut_windows(recovery.from_akf(0, size=(32, 24)), "reference")
    problem = Problem(Objective(jaxevent.akf, "nll", False), drawn)
    settings = Settings(iterations=30, learning_rate=0.2, rounds=1)
    told = recovery.fit_with_intervals(problem.objective, start, names, problem, settings)
    for name in names:
        assert told[name].holds(true[name]) and not told[name].holds(told[name].start)
        assert 0.5 * true[name] < told[name].low < told[name].high < 2 * true[name]


def test_literal_votes_are_late_as_drawn(recovery):
    """Pairs stand alone: lateness has the spread 1 / (alpha r_t), and they move by 1 px."""
    late, along = [], []
    for seed in range(12):
        recording, truth = recovery.from_literal_votes(seed, seconds=0.3)
        t, x, y = (
            np.asarray(v, int) for v in (recording.events.t, recording.events.x, recording.events.y)
        )
        cell = x // 16 + 1000 * (y // 16)
        order = np.lexsort((t, cell))
        pair = np.flatnonzero(np.diff(cell[order]) == 0)
        first, second = order[pair], order[pair + 1]
        velocity = truth(t[second])
        speed = np.linalg.norm(velocity, axis=1)
        late.append((t[second] - t[first]) * 1e-6 - 1 / speed)
        d = np.stack([x[second] - x[first], y[second] - y[first]], 1)
        along.append((d * velocity).sum(1) / speed)
    late = np.concatenate(late)
    expected = 1 / (recovery.VOTES_SETTINGS["alpha_literal"] * recovery.VOTES["r_t"])
    assert len(late) > 1500
    assert abs(np.median(late)) < 0.1 * expected
    assert np.median(abs(late)) == pytest.approx(np.log(2) * expected, rel=0.1)
    assert np.concatenate(along).mean() == pytest.approx(1, abs=0.03)
