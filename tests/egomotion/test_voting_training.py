"""Runs of voting for a fit: where they begin, and their derivatives by kernels."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from points import moved

from jaxevent import tuning
from jaxevent.egomotion import voting
from jaxevent.egomotion.estimator import TrainingSegment
from jaxevent.egomotion.models import find_model
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError
from jaxevent.runs.egomotion import MotionLoss

pytestmark = pytest.mark.slow

VELOCITY = np.array([130.0, -70.0])
START = {"every": 2, "candidates": 40, "particles": 64, "batch": 16, "off": 0.0, "noise": 1.0}
NAMES = "noise", "alpha", "sigma_x"


@functools.cache
def recording():
    return moved(lambda at: np.broadcast_to(VELOCITY, at.shape), 0.3, 120, seed=4)


def prepared(start=100_000, stop=200_000, compiler=None, **settings):
    kind = find_model("planar")
    t = np.arange(0, 300_001, 10_000)
    known = KnownMotion(kind, t, np.broadcast_to(VELOCITY, (len(t), 2)))
    params = voting.Params.of({**START, **settings})
    segment = TrainingSegment(recording(), start, stop, known, 0)
    made = voting.training_runs([segment], params, kind, 2, 0.0, compiler=compiler)
    return params, made[0]


def test_a_window_s_first_events_have_candidates_from_before_it():
    """Of the 30 ms that candidates reach back: without, a filter of small batches is lost."""
    params, batch = prepared(compiler="numba")
    counted = np.asarray(batch.candidates.mask.sum(-1))[np.asarray(batch.candidates.valid)]
    middle = len(counted) // 2
    assert counted[:100].mean() > 0.8 * counted[middle : middle + 100].mean()
    mean, _ = batch.estimates(params)
    error = np.linalg.norm(np.asarray(mean) - VELOCITY, axis=-1) / np.linalg.norm(VELOCITY)
    assert error[:, 10:].max() < 0.2


def test_batches_begin_once_the_recording_has_a_history():
    _, batch = prepared(start=0)
    late = 1.2 * float(voting.Params().baseline) / np.linalg.norm(VELOCITY)
    assert 0.8 * late < float(batch.time[0]) < 1.3 * late


def test_a_window_shorter_than_the_history_is_used_from_its_start():
    _, batch = prepared(start=0, stop=20_000)
    assert float(batch.time[0]) < 0.01


@pytest.mark.parametrize("compiler", ["numba", "xla"])
def test_a_lost_motion_costs_about_as_much_as_no_motion(compiler):
    """A contrast of 50 is never reached, so the motion is lost after the first batches."""
    params, batch = prepared(compiler=compiler)
    losing, lost = prepared(compiler=compiler, contrast=50.0)
    assert float(lost.counted.sum()) == float(batch.counted.sum())
    assert float(MotionLoss()(params, batch)) < 0.01
    assert 0.7 < float(MotionLoss()(losing, lost)) < 1.5


def test_the_kernel_s_loss_is_that_of_xla():
    (params, by_kernel), (_, by_xla) = prepared(compiler="numba"), prepared(compiler="xla")
    loss = MotionLoss()
    expected = tuning.evaluate_loss(loss, params, by_xla)
    np.testing.assert_allclose(loss(params, by_kernel), expected, rtol=1e-6)


@pytest.mark.parametrize("forward", [True, False])
def test_the_kernel_s_gradient_is_that_of_differences(forward):
    """Of two starts at once, without resampling; ranges of ages, which jump, count as constant."""
    params, batch = prepared(compiler="numba", resample_below=0.0)
    raw = {name: params.raw[name] + 0.1 * np.arange(2) for name in NAMES}
    loss, step = MotionLoss(), 1e-5

    def at(number, **changes):
        here = {name: raw[name][number] + changes.get(name, 0.0) for name in NAMES}
        return float(tuning.evaluate_loss(loss, params.with_raw(here), batch))

    found, slopes = tuning.loss_and_grad(loss, forward, params, raw, batch)
    for number in range(2):
        np.testing.assert_allclose(found[number], at(number), rtol=1e-9)
        for name in NAMES:
            above, below = at(number, **{name: step}), at(number, **{name: -step})
            expected = (above - below) / (2 * step)
            assert abs(expected) > 1e-5
            np.testing.assert_allclose(slopes[name][number], expected, rtol=0.03, err_msg=name)


def test_what_kernels_have_no_derivatives_of_is_refused():
    params, batch = prepared(compiler="numba")

    def loss(alpha):
        return MotionLoss()(params.with_raw({"alpha": alpha}), batch)

    with pytest.raises(InputError, match="first derivatives only.*xla"):
        jax.jit(jax.hessian(loss))(params.raw["alpha"])

    def by_positions(xi):
        candidates = dataclasses.replace(batch.candidates, xi=xi)
        return MotionLoss()(params, dataclasses.replace(batch, candidates=candidates))

    with pytest.raises(InputError, match="by parameters alone.*xla"):
        jax.jit(jax.grad(by_positions))(batch.candidates.xi)


def test_the_literal_likelihood_is_left_to_xla():
    _, batch = prepared(likelihood="literal")
    assert not batch.by_kernel
    with pytest.raises(InputError, match="no kernel"):
        prepared(likelihood="literal", compiler="numba")
