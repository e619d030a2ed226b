"""The fitting loop on small losses with known answers, and the command on synthetic recordings."""

import copy
import csv
import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import noise
import numpy as np
import optax
import pytest
import scipy.stats
from commands import fails
from PIL import Image
from texture import C_OFF, C_ON, HEIGHT, LATE, WIDTH, moving

import jaxevent
import jaxevent.runs.fit
import jaxevent.tuning
from jaxevent import cli
from jaxevent.confidence import confidence_intervals
from jaxevent.estimator import Estimate
from jaxevent.methods import METHOD_HOMES, METHODS
from jaxevent.parameters import Number, Parameters, Positive
from jaxevent.reconstruction.estimator import PixelEstimator, ScannedImages
from jaxevent.reconstruction.filtering import Filter
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.family import interleave
from jaxevent.runs.fit import fit
from jaxevent.runs.protocols import Reference, held_out
from jaxevent.runs.reconstruction import (
    ImageBatch,
    Objective,
    Problem,
    TruthLimits,
    cut_windows,
)
from jaxevent.runs.results import format_findings
from jaxevent.runs.scores import score
from jaxevent.tuning import Settings, begin, optimise

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    jaxevent.save(moving(), tmp_path / "moving.h5")
    write(tmp_path, "c_off = 0.02\n", "mine.toml")
    return tmp_path


# The loop, on losses whose minimum is known.


class Toy(Parameters):
    a: Positive = Positive(1.0, "1", "least at 2")
    b: Number = Number(0.0, "1", "least at -1")
    c: Number = Number(0.0, "1", "searched, least at 0.3")

    def __init__(self, **values: Any):
        super().__init__(**values)


def toy(params: Toy, batch: Any) -> jax.Array:
    """Least at a = 2, b = -1, c = 0.3 for batches that are (1, 1)."""
    scale, target = batch
    bowl = (params.a - 2 * target) ** 2 + 3 * (params.b + target) ** 2 * params.a
    return scale * (bowl + jnp.cosh(params.c - 0.3))


ONE = (jnp.ones(()), jnp.ones(()))
QUICK = Settings(iterations=200, learning_rate=0.1, patience=200, rounds=1)


def close(params: Parameters, **values: float) -> None:
    for name, value in values.items():
        assert float(getattr(params, name)) == pytest.approx(value, abs=2e-3), name


def test_optimise_finds_the_minimum():
    fitted = optimise(toy, Toy(), ["a", "b"], [ONE], settings=QUICK)
    close(fitted.params, a=2, b=-1, c=0)
    assert fitted.loss == pytest.approx(np.cosh(0.3), abs=1e-5)
    assert [line[2] for line in fitted.history] == list(range(201))
    searched = optimise(toy, Toy(), ["a", "b"], [ONE], (), QUICK, {"c": (-2, 2, 5)})
    close(searched.params, a=2, b=-1, c=0.3)
    alone = optimise(toy, Toy(), [], [ONE], (), QUICK, {"c": (-2, 2, 5)})
    close(alone.params, a=1, b=0, c=0.3)


def test_a_fit_traces_its_loss_twice():
    """Checks, probes and validation share a program, and gradients are the other."""
    traced = []

    def counted(params: Toy, batch: Any) -> jax.Array:
        traced.append(batch)
        return toy(params, batch)

    fitted = optimise(counted, Toy(), ["a", "b"], [ONE], settings=QUICK)
    confidence_intervals(counted, Toy(), fitted.params, ["a", "b"], [ONE])
    assert len(traced) == 2


def test_adam_by_hand():
    """The first steps are those of Adam with the rate of a cosine, halved in the second round."""
    settings = Settings(iterations=4, learning_rate=0.1, every=1, rounds=2)
    losses = [line[3] for line in optimise(toy, Toy(), ["a"], [ONE], settings=settings).history]
    raw, expected = jnp.log(1.0), []

    def loss(r):
        return toy(Toy(a=jnp.exp(r)), ONE)

    value_and_slope = jax.jit(jax.value_and_grad(loss))
    for rate in (0.1, 0.05):
        adam = optax.adam(optax.cosine_decay_schedule(rate, 4, 0.1))
        memory = adam.init(raw)
        for _ in range(4):
            value, slope = value_and_slope(raw)
            expected.append(float(value))
            step, memory = adam.update(slope, memory)
            raw = optax.apply_updates(raw, step)
        expected.append(None)
    assert losses == [None if e is None else pytest.approx(e, rel=1e-12) for e in expected]


def test_forward_and_reverse_agree():
    runs = [
        optimise(toy, Toy(), ["a", "b"], [ONE], settings=dataclasses.replace(QUICK, forward=mode))
        for mode in (True, False)
    ]
    for name in ("a", "b"):
        np.testing.assert_allclose(*(run.params.raw[name] for run in runs), rtol=1e-9)


def test_starts_are_followed_as_if_alone():
    settings = Settings(iterations=60, starts=3, patience=15, spread=1.0, seed=4, rounds=1)
    together = optimise(toy, Toy(), ["a", "b"], [ONE], settings=settings)
    drawn = begin(Toy(), ["a", "b"], settings).position.raw
    assert float(drawn["a"][0]) == 0 and len(set(map(float, drawn["a"]))) == 3
    best = []
    for start in range(3):
        raw = {name: leaf[start] for name, leaf in drawn.items()}
        params = Toy().with_raw(raw)
        alone = optimise(
            toy, params, ["a", "b"], [ONE], settings=dataclasses.replace(settings, starts=1)
        )
        mine = [line[1:] for line in together.history if line[0] == start][: len(alone.history)]
        for one, other in zip(mine, [line[1:] for line in alone.history], strict=True):
            if one[2] is None or other[2] is None:  # where the one start stopped, others went on
                assert one[:2] == other[:2]
                continue
            assert one[:3] == pytest.approx(other[:3], rel=1e-12)
            assert one[3] is None or one[3] == pytest.approx(other[3], rel=1e-12)
        best.append(alone)
    winner = min(best, key=lambda one: one.loss)
    assert together.loss == pytest.approx(winner.loss, rel=1e-12)
    close(together.params, a=float(winner.params.a), b=float(winner.params.b))


def test_early_stopping_keeps_the_best_of_validation():
    validation = [(jnp.ones(()), jnp.asarray(0.75))]  # least at a = 1.5, which is passed
    settings = dataclasses.replace(QUICK, patience=10, every=2)
    fitted = optimise(toy, Toy(b=-1.0), ["a"], [ONE], validation, settings)
    seen = [(line[4], line[2]) for line in fitted.history if line[4] is not None]
    least, at = min(seen)
    assert 0 < at < 60 and fitted.history[-1][2] == at + 10 and fitted.history[-1][3] is None
    assert fitted.loss == pytest.approx(least, rel=1e-12)
    assert float(toy(fitted.params, validation[0])) == pytest.approx(least, rel=1e-12)
    assert 1 < float(fitted.params.a) < 2


@dataclasses.dataclass
class Weighed:
    """A batch that counts three times, or as often as it says."""

    pair: tuple
    weight: float


jax.tree_util.register_dataclass(Weighed, ["pair", "weight"], [])


def test_batches_count_by_their_weight():
    def loss(params, batch):
        return (params.b - batch.pair[1]) ** 2

    batches = [Weighed(ONE, 3.0), Weighed((ONE[0], jnp.asarray(5.0)), 1.0)]
    fitted = optimise(loss, Toy(), ["b"], batches, settings=QUICK)
    close(fitted.params, b=2)
    assert fitted.loss == pytest.approx(3, abs=1e-5)


def test_mini_batches_take_turns():
    """Each of three batches once, in some order, before any comes again; the seed decides."""

    def used(seed: int, size: int, rounds: int = 1) -> list[int]:
        batches = [(jnp.ones(()), jnp.asarray(float(k))) for k in range(3)]
        settings = Settings(12 // rounds, batch=size, rounds=rounds, seed=seed)
        lines = optimise(  # its loss tells which batches a step has used
            lambda params, batch: 10.0 ** batch[1] + 0 * params.b, Toy(), ["b"], batches,
            settings=settings,
        ).history  # fmt: skip
        return [round(size * line[3]) for line in lines if line[3] is not None]

    single = used(3, 1)
    assert all(sorted(single[k : k + 3]) == [1, 10, 100] for k in range(0, 12, 3))
    assert len({tuple(single[k : k + 3]) for k in range(0, 12, 3)}) > 1
    assert used(3, 1) == single != used(2, 1)
    assert used(3, 1, rounds=3) == single  # rounds of 4 steps go on in the order
    pairs = used(3, 2)
    assert pairs == [sum(single[2 * k : 2 * k + 2]) for k in range(6)] + pairs[6:]
    assert used(3, 3) == [111] * 12 and used(3, 5) == [185] * 12  # all; five times their mean


def test_search_prepares_every_candidate():
    """Batches that depend on a parameter: its search sees them change, gradients do not."""
    seen = []

    def prepare(params):
        seen.append(float(params.c))
        return [(jnp.ones(()), 1 + (params.c - 0.37) ** 2)], [ONE]

    def loss(params, batch):
        return (params.b - 1) ** 2 + batch[1]

    fitted = optimise(loss, Toy(), ["b"], prepare, (), QUICK, {"c": (-1, 1, 5)})
    close(fitted.params, b=1, c=0.37)
    np.testing.assert_allclose(seen[1:7], [-1, -0.5, 0, 0.5, 1, 0])
    assert seen[7] == pytest.approx(0.37)  # the vertex of the parabola
    assert max(abs(c - 0.37) for c in seen[-8:]) <= 0.5  # the last ones, close to it


@pytest.mark.parametrize("after", [0.9, 1.1])
def test_a_fit_that_makes_test_data_worse_says_so(after):
    gain = {"method": "akf", "measure": "mse", "split": "test", "before": 1.0, "after": after}
    said = format_findings([], [gain])
    assert ("The fit of akf made test data worse: keep" in said) == (after > 1)


class Misleading:
    """Batches that make a loss worse the further b is from 0, which derivatives do not see.

    With batches of its own b the loss is (b - 2)^2 / 4 + 3 b^2, least at b = 2 / 13; with batches
    that stay it is least at b = 2. The validation loss always falls towards 2.
    """

    def __call__(self, params):
        return [jnp.asarray([3 * float(params.b) ** 2, 1.0])], [jnp.asarray([0.0, 1.0])]

    @staticmethod
    def loss(params, batch):
        return batch[1] * (params.b - 2) ** 2 / 4 + batch[0]

    def fit_loss(self, b):
        return (b - 2) ** 2 / 4 + 3 * b**2


@pytest.mark.parametrize("starts", [1, 3])
def test_steps_that_make_prepared_batches_worse_are_taken_back(starts):
    problem = Misleading()
    settings = Settings(iterations=60, learning_rate=0.1, rounds=2, starts=starts, probe=False)
    kept = []

    def keep(run, certain):
        kept.append(copy.deepcopy(run))

    start = Toy(b=0.0)
    fitted = optimise(problem.loss, start, ["b"], problem, (), settings, save=keep)
    found = float(fitted.params.b)
    assert 0.05 < found < 0.25, "the least loss is at 2 / 13"
    assert problem.fit_loss(found) < problem.fit_loss(0.0)
    # Taken up again anywhere, it ends the same.
    for run in kept[2::17]:
        again = optimise(problem.loss, start, ["b"], problem, (), settings, run=run)
        assert float(again.params.b) == found and again.history == fitted.history


def test_a_rough_number_is_searched_with_batches_of_each_candidate():
    """With batches that stay the loss is least at b = 4, with those of each candidate at 1."""

    def prepare(params):
        return [params.b], []

    def loss(params, batch):
        return (batch - 1) ** 2 + 0.1 * (params.b - batch) ** 2 + 0.5 * jnp.sin(40 * params.b)

    settings = Settings(iterations=1, learning_rate=1e-3, rounds=1)
    fitted = optimise(loss, Toy(b=4.0), ["b"], prepare, (), settings)
    assert list(fitted.rough) == ["b"]
    assert abs(fitted.rough["b"].searched - 1) < 1


def test_a_descent_prepares_batches_with_its_parameters():
    """The batch is 1 + b / 2 of the b that it is prepared with, so the loss is 0 at b = 2."""
    kept = []

    def prepare(params):
        return [1 + params.b / 2], []

    def loss(params, batch):
        return (params.b - batch) ** 2

    def keep(run, certain):
        if run.stage == 1 and run.iteration == 3:  # batches are of iteration 0
            kept.append(copy.deepcopy(run))

    settings = dataclasses.replace(QUICK, probe=False)
    fitted = optimise(loss, Toy(), ["b"], prepare, (), settings, save=keep)
    close(fitted.params, b=2)
    assert fitted.loss < 1e-3
    again = optimise(loss, Toy(), ["b"], prepare, (), settings, run=kept[0])
    assert again.history == fitted.history


def test_a_search_stays_in_its_interval_and_keeps_what_is_better():
    quiet = dataclasses.replace(QUICK, iterations=1)

    def loss(params, batch):
        return jnp.where(params.c > 0.95, jnp.nan, (params.c - 0.9) ** 2) + 0 * params.b

    fitted = optimise(loss, Toy(), [], [ONE], (), quiet, {"c": (-1, 0.5, 4)})
    close(fitted.params, c=0.5)
    fitted = optimise(loss, Toy(c=0.9), [], [ONE], (), quiet, {"c": (-1, 0.5, 4)})
    close(fitted.params, c=0.9)
    fitted = optimise(loss, Toy(), [], [ONE], (), quiet, {"c": (-1, 2, 4)})
    close(fitted.params, c=0.9)


def test_steps_that_are_not_finite_are_left_out():
    def loss(params, batch):
        hole = jnp.where((params.b > 0.3) & (params.b < 0.6), jnp.nan, 1.0)
        return (params.b - 1) ** 2 * hole

    often = dataclasses.replace(QUICK, every=1)
    fitted = optimise(loss, Toy(), ["b"], [ONE], settings=often)
    assert 0.15 < float(fitted.params.b) <= 0.3
    with pytest.raises(jaxevent.InputError, match="not finite where the fit starts"):
        optimise(loss, Toy(b=0.5), ["b"], [ONE], settings=QUICK)


def test_a_start_that_is_not_finite_is_not_chosen():
    several = dataclasses.replace(QUICK, starts=3, spread=1.0)
    bad = begin(Toy(), ["b"], several).position.raw["b"][1]

    def loss(params, batch):
        return jnp.where(jnp.abs(params.b - bad) < 1e-6, jnp.nan, (params.b - 1) ** 2)

    fitted = optimise(loss, Toy(), ["b"], [ONE], settings=several)
    losses = [loss for start, *_, loss, _ in fitted.history if start == 1 and loss is not None]
    assert losses and not np.isfinite(losses).any()
    close(fitted.params, b=1.0)


def test_what_leads_out_of_the_numbers_is_not_the_best():
    """A loss that falls for ever, towards an infinite parameter."""

    def loss(params, batch):
        return jnp.exp(-params.a) + (params.b - 1) ** 2

    fast = dataclasses.replace(QUICK, learning_rate=1000.0, every=1, iterations=10)
    fitted = optimise(loss, Toy(), ["a"], [ONE], settings=fast)
    assert math.isfinite(float(fitted.params.a)) and math.isfinite(fitted.loss)
    Toy(**fitted.params.values())  # which accepts no other
    assert fitted.diverged
    assert not optimise(loss, Toy(), ["a"], [ONE], settings=QUICK).diverged
    away = optimise(loss, Toy(), ["b"], [ONE], settings=fast)
    assert float(away.params.b) == 0.0 and away.loss == away.history[0][4] and away.diverged
    still = optimise(loss, Toy(b=1.0), ["b"], [ONE], settings=QUICK)
    assert not still.diverged
    # Data that agree with the fit at the start alone: early stopping keeps that.
    target = (jnp.asarray(1.0), jnp.asarray(0.0))
    kept = optimise(lambda params, at: (params.b - at) ** 2, Toy(), ["b"], target[:1], target[1:],
                    QUICK)  # fmt: skip
    assert not kept.diverged and float(kept.params.b) == 0


@pytest.mark.parametrize(
    ("names", "search", "said"),
    [
        (["aa"], {}, "no parameter 'aa'; did you mean 'a'"),
        ([], {"d": (0, 1, 3)}, "no parameter 'd'"),
        (["c"], {"c": (0, 1, 3)}, "both"),
        (["a"], {"c": (1, 0, 3)}, "search of c"),
        (["a"], {"c": (0, 1, 2)}, "search of c"),
        (["b"], {"a": (-1, 1, 3)}, "must not be negative"),
        (["b"], {"a": (1, 1e39, 3)}, "finite"),
    ],
)
def test_what_cannot_be_fitted(names, search, said):
    with pytest.raises(jaxevent.InputError, match=said):
        optimise(toy, Toy(), names, [ONE], search=search)
    with pytest.raises(jaxevent.InputError, match="a starts at 0"):
        optimise(toy, Toy(a=0.0), ["a"], [ONE])
    with pytest.raises(jaxevent.InputError, match="nothing to fit to"):
        optimise(toy, Toy(), ["a"], [])


def test_a_run_taken_up_anywhere_ends_the_same():
    settings = Settings(iterations=7, starts=2, every=3, patience=4, batch=1, learning_rate=0.3)
    batches = [ONE, (jnp.ones(()), jnp.asarray(1.1))]
    arguments = (toy, Toy(), ["a", "b"], batches, (), settings, {"c": (-1, 1, 3)})
    saved: list[jaxevent.tuning.Run] = []
    whole = optimise(*arguments, save=lambda run, _: saved.append(copy.deepcopy(run)))
    taken = saved[::3]
    assert {run.stage for run in taken} == {0, 1, 2, 3, 4, 5} and len(taken) > 10
    assert any(run.iteration for run in taken) and any(run.tried for run in taken)

    def looked(runs: list[jaxevent.tuning.Run], stage: int) -> int:
        return max([len(run.tried) for run in runs if run.stage == stage], default=0)

    for run in taken:
        later = [run]
        again = optimise(
            *arguments,
            run=copy.deepcopy(run),
            save=lambda run, _, to=later: to.append(copy.deepcopy(run)),
        )
        assert again.loss == whole.loss and again.history == whole.history
        for name, leaf in whole.params.raw.items():
            assert np.array_equal(again.params.raw[name], leaf)
        # What was computed is not repeated.
        assert looked(later, run.stage) == looked(saved, run.stage)


# The losses of reconstructions.


def test_images_are_shared_out_in_a_fixed_pattern():
    assert interleave([2, 1, 1], 10).tolist() == [0, 1, 0, 2, 0, 1, 0, 2, 0, 1]
    assert interleave([1, 0, 0], 3).tolist() == [0, 0, 0]
    assert interleave([3, 1, 0], 8).tolist() == [0, 0, 0, 1, 0, 0, 0, 1]
    assert interleave([1, 0, 2], 4).tolist() == [0, 2, 2, 0]
    for split in ([5, 2, 3], [1, 4, 1]):
        assert np.bincount(interleave(split, sum(split))).tolist() == split


@dataclasses.dataclass(frozen=True)
class HtmlRepr(PixelEstimator):
    """A method whose images are what it is given to read, with the variance 0.3."""

    @property
    def is_event_driven(self):
        return False

    def init_state(self, params, features):
        return None

    def run(self, params, features, state=None, future=None):
        return None, None

    def read(self, params, trajectory, out):
        return Estimate(out, jnp.full(out.shape, 0.3), jnp.isfinite(out))


def by_hand(error: str, image: float, truth: float, clipped: bool, white: float) -> float:
    d, I0 = 0.003, 1.0
    if error == "nll":
        normal = scipy.stats.norm(np.log(image + I0), np.sqrt(0.3))
        if clipped and truth >= 0.98:
            return -normal.logsf(np.log(truth + I0))
        if clipped and truth <= 0:
            return -normal.logcdf(np.log(truth + I0))
        return -normal.logpdf(np.log(truth + I0)) + np.log(truth + I0)
    if clipped and (truth >= 1 and image > 1 or truth <= 0 and image < 0):
        return 0.0
    shown = image if image <= white else white + white * np.log(image / white)
    if clipped and truth >= 0.98:  # white but for noise
        shown = min(image, white)
    if error == "linear":
        return (shown - truth) ** 2
    sign = 1 if shown >= 0 else -1
    return (sign * np.log((abs(shown) + d) / d) - np.log((truth + d) / d)) ** 2


@pytest.mark.parametrize("clipped", [True, False])
@pytest.mark.parametrize("error", ["linear", "log", "nll"])
def test_errors_by_hand(error, clipped):
    images = np.array([0.3, -0.2, 1.5, 40.0, 0.7])
    truths = np.array([0.0, 0.4, 1.0, *([0.99] if clipped else [7.0])])
    white = max(1.0, truths.max())
    image, truth = (v.ravel() for v in np.meshgrid(images, truths))
    weights = np.linspace(0.5, 2, len(truth))[None]
    weights[0, 3] = 0
    shown, true = jnp.asarray(image[None]), jnp.asarray(truth[None])
    method = HtmlRepr("shown", jaxevent.akf.Params)
    objective = Objective(method, error, clipped)
    one = jnp.asarray(1.0)

    @jax.jit
    @jax.value_and_grad
    def loss(image, weights):
        given = ScannedImages(None, image, method)
        limits = TruthLimits(*jnp.asarray([[[0.0]], [[white]], [[0.98]]]))
        batch = ImageBatch(given, true, weights, limits, one)
        return objective(jaxevent.akf.Params(), batch)

    expected = [by_hand(error, i, t, clipped, white) for i, t in zip(image, truth, strict=True)]
    value, slope = loss(shown, weights)
    assert float(value) == pytest.approx(np.average(expected, weights=weights[0]))
    evenly, _ = loss(shown, np.full((1, 1), 2.0))
    assert float(evenly) == pytest.approx(np.mean(expected))
    # It slopes wherever it is not 0 but for white, and never jumps.
    slope = np.asarray(slope)[0]
    assert np.isfinite(slope).all()
    if error != "nll":
        counted = (np.array(expected) > 1e-12) & (weights[0] > 0)
        counted &= ~((truth >= 0.98) & (image > 1)) if clipped else True
        assert (slope[counted] != 0).all() and counted.sum() > 10


@pytest.mark.filterwarnings("ignore:.*events contradict frames")
def test_the_loss_bounds_the_evaluated_error():
    """It equals what evaluation says of images within [0, 1], and is more for others."""
    recording = moving()
    problem = Problem(Objective(METHODS["blend"]), cut_windows(recording, "held-out"))
    params = METHODS["blend"].Params(clock_offset=0.002)
    value = float(jax.jit(problem.objective)(params, problem(params)[0][0]))
    row = score(recording, METHODS["blend"], params)
    assert value == pytest.approx(row["mse"], rel=1e-6)
    edi = METHODS["edi"]
    params = edi.Params(c_on=0.5, c_off=0.3)
    problem = Problem(Objective(edi), cut_windows(recording, "held-out"))
    value = float(jax.jit(problem.objective)(params, problem(params)[0][0]))
    assert value > 1.01 * score(recording, edi, params)["mse"]


@pytest.mark.parametrize("window", [0.1, 0.17, 2.0])
def test_windows_use_every_image_once(window):
    recording = moving()
    cut = cut_windows(recording, "held-out", (2, 1, 1), window, 0.05)
    given, hidden = held_out(recording)
    assert sorted(np.concatenate([part.rows for part in cut])) == list(range(len(hidden)))
    split = np.concatenate([part.split for part in cut])
    assert split.tolist() == interleave([2, 1, 1], len(hidden)).tolist()
    for number, part in enumerate(cut):
        t0 = recording.start + round(number * window * 1e6)
        t1 = t0 + round(window * 1e6)
        stamps = hidden.t[part.rows]
        assert ((stamps >= t0) & (stamps < t1)).all()
        assert part.recording.start >= t0 - 50_000 and part.recording.stop < t1 + 50_000
        assert part.recording.start <= t0 + 1 and part.recording.stop >= min(t1, hidden.t[-1])
        assert len(part.recording.events) and set(part.recording.frames.t) <= set(given.frames.t)


def test_batches_of_windows_weigh_their_images():
    recording = moving()
    blend = METHODS["blend"]
    params = blend.Params(clock_offset=LATE * 1e-6)
    row = score(recording, blend, params)
    use = interleave([2, 1, 1], row["frames"])
    # With a margin that holds the next frames, a blend does not see that it was cut.
    problem = Problem(Objective(blend), cut_windows(recording, "held-out", (2, 1, 1), 0.2, 0.1))
    objective = jax.jit(problem.objective)
    for split, batches in enumerate(problem(params)):
        assert len(batches) == 3 and len({batch.truth.shape for batch in batches}) == 1
        weights = [float(batch.weight) for batch in batches]
        assert sum(weights) == (use == split).sum() * WIDTH * HEIGHT
        losses = [float(objective(params, batch)) for batch in batches]
        expected = np.mean(np.array(row["per_frame"]["mse"])[use == split])
        assert np.average(losses, weights=weights) == pytest.approx(expected, rel=1e-6)
    assert problem(params) is problem(params)
    moved = blend.Params(clock_offset=0.0)
    assert problem(moved) is not problem(params)


def test_motion_is_found_anew_with_other_parameters():
    mc = METHODS["mc"]
    problem = Problem(Objective(mc), cut_windows(moving(), "held-out")[:1])

    def paths(**values):
        return problem(mc.Params(**values))[0][0].prepared.out.targets.p

    assert paths() is paths()
    assert np.abs(paths() - paths(smooth=4e3)).max() > 1e-3


def test_references_weigh_their_regions():
    recording = moving()
    hdr = np.array([0.001, 0.5, 3.0, np.nan])[np.arange(WIDTH * HEIGHT) % 4]
    hdr = np.tile(hdr.reshape(1, HEIGHT, WIDTH), (5, 1, 1))
    extra = {"hdr": hdr, "hdr_t": np.arange(1, 6) * 90_000, "clip": np.array([0.01, 1.0])}
    recording = dataclasses.replace(recording, extra=extra)
    method, params = METHODS["last-frame"], METHODS["last-frame"].Params()
    cut = cut_windows(recording, "reference", (1, 0, 0))
    assert isinstance(cut[0].truth, Reference)
    values = {}
    for name in ("dark", "well", "bright"):
        weights = {region: float(region == name) for region in ("dark", "well", "bright")}
        problem = Problem(Objective(method, "linear", False), cut, (), weights)
        values[name] = float(problem.objective(params, problem(params)[0][0]))
    row = score(recording, method, params, "reference")
    for name, value in values.items():
        assert value == pytest.approx(row["regions"][name]["mse"], rel=1e-6), name
    evenly = Problem(Objective(method, "linear", False), cut)
    value = float(evenly.objective(params, evenly(params)[0][0]))
    assert value == pytest.approx(np.mean(list(values.values())), rel=1e-6)


# The command.

EDI = """
recordings = ["moving.h5"]
calibrate = false
iterations = 30
learning_rate = 0.2
[[method]]
name = "edi"
fit = ["c_on", "c_off"]
search = { clock_offset = [-0.02, 0.02, 9] }
"""


def write(folder: Path, text: str, name: str = "run.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> tuple[Path, list[dict]]:
    folder = tmp_path_factory.mktemp("fitted")
    jaxevent.save(moving(), folder / "moving.h5")
    rows = fit(write(folder, EDI), folder / "out")
    return folder, rows


def test_thresholds_and_clock_are_recovered(fitted):
    folder, _ = fitted
    edi = METHODS["edi"]
    params = edi.Params.load(folder / "out" / "params.toml", "edi")
    assert float(params.c_on) == pytest.approx(C_ON, rel=0.1)
    assert float(params.c_off) == pytest.approx(C_OFF, rel=0.1)
    # Events lag behind the intensity, by half a threshold where it rises or falls.
    assert LATE * 1e-6 < float(params.clock_offset) < LATE * 1e-6 + 0.002
    # Nowhere in a fine scan is the loss lower.
    problem = Problem(Objective(edi), cut_windows(moving(), "held-out", (2, 1, 1)))

    def loss(offset: float) -> float:
        shifted = edi.Params(**{**params.values(), "clock_offset": offset})
        return float(
            jaxevent.tuning.evaluate_loss(problem.objective, shifted, problem(shifted)[0][0])
        )

    scan = [float(offset) for offset in np.arange(0.003, 0.008, 0.00025)]
    losses = [loss(offset) for offset in scan]
    assert loss(float(params.clock_offset)) <= min(losses) * 1.001
    assert abs(scan[int(np.argmin(losses))] - float(params.clock_offset)) <= 2.5e-4


def test_a_prior_holds_what_is_believed(fitted, tmp_path):
    """A strong one ends where it is centred, one that is all but nothing where there is none."""
    folder, _ = fitted
    found = {}
    for weight in (1e-9, 1e3):
        prior = f"prior = {{ c_on = [0.15, 0.2] }}\nprior_weight = {weight}\n"
        fit(write(folder, EDI + prior, f"{weight}.toml"), tmp_path / str(weight))
        found[weight] = METHODS["edi"].Params.load(tmp_path / str(weight) / "params.toml", "edi")
    free = METHODS["edi"].Params.load(folder / "out" / "params.toml", "edi")
    assert float(found[1e-9].c_on) == pytest.approx(float(free.c_on), rel=1e-3)
    assert float(found[1e3].c_on) == pytest.approx(0.15, rel=0.02)


def test_what_a_fit_writes(fitted):
    folder, rows = fitted
    out = folder / "out"
    names = ["config.toml", "loss.csv", "loss.png", "params.toml", "results.json", "results.md"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert (out / "config.toml").read_text() == EDI
    written = json.loads((out / "results.json").read_text())
    assert written["rows"] == rows and list(written) == ["rows", "found", "gains"]
    counts = {"fit": 5, "validation": 3, "test": 2}
    assert [(row["method"], row["split"], row["frames"]) for row in rows] == [
        (method, split, count)
        for method in ("edi, before", "edi")
        for split, count in counts.items()
    ]
    assert {row["recording"] for row in rows} == {"moving.h5"}
    for before, after in zip(rows[:3], rows[3:], strict=True):
        assert after["mse"] < 0.5 * before["mse"]
        assert before["per_frame"]["t"] == after["per_frame"]["t"]
    stamps = np.sort(np.concatenate([row["per_frame"]["t"] for row in rows[:3]]))
    assert stamps.tolist() == held_out(moving())[1].t.tolist()
    table = (out / "results.md").read_text().splitlines()
    assert table[4] == "" and "edi, before" in table[2]
    assert f"{100 * rows[5]['mse']:.3f}" in table[3]
    told = {row["parameter"]: row for row in written["found"]}
    assert list(told) == ["c_on", "c_off", "clock_offset"]
    for name, true in (("c_on", C_ON), ("c_off", C_OFF)):
        assert told[name]["low"] < told[name]["found"] < told[name]["high"] < 1.5 * true
        assert told[name]["of"] == "5 images" and told[name]["unit"] == "ln I"
        assert told[name]["start"] == pytest.approx(0.1)
    (titles,) = [n for n, line in enumerate(table) if line.startswith("| method | parameter")]
    assert [cell.strip() for cell in table[titles + 2].split("|")[1:5]] == [
        "edi", "c_on", "0.1", f"{told['c_on']['found']:.4g}"
    ]  # fmt: skip
    gain = {"method": "edi", "measure": "mse", "split": "test", "before": rows[2]["mse"],
            "after": rows[5]["mse"]}  # fmt: skip
    assert written["gains"] == [gain]
    values = tomllib.loads((out / "params.toml").read_text())
    assert list(values) == ["edi"]
    assert METHODS["edi"].Params.of(values["edi"]).values() == values["edi"]
    assert values["edi"]["I0"] == 1
    lines = list(csv.DictReader((out / "loss.csv").read_text().splitlines()))
    assert list(lines[0]) == ["method", "start", "round", "iteration", "fit", "validation"]
    assert {line["round"] for line in lines} == {"0", "1"}
    assert float(lines[-1]["validation"]) < float(lines[0]["validation"])
    with Image.open(out / "loss.png") as figure:
        assert figure.width > 500


def test_gradients_of_a_reconstruction_agree():
    """Forwards, in reverse, and by differences, of two starts."""
    edi = METHODS["edi"]
    problem = Problem(Objective(edi), cut_windows(moving(), "held-out", (2, 1, 1)))
    params = edi.Params(clock_offset=0.004)
    batch = problem(params)[0][0]
    raw = {name: params.raw[name] + jnp.array([0, 0.1]) for name in ("c_on", "I0")}
    slopes = functools.partial(jaxevent.tuning.loss_and_grad, problem.objective)
    forward, reverse = (slopes(mode, params, raw, batch) for mode in (True, False))
    np.testing.assert_allclose(forward[0], reverse[0], rtol=1e-12)
    for name in raw:
        np.testing.assert_allclose(forward[1][name], reverse[1][name], rtol=1e-9)
        ends = [
            jaxevent.tuning._compute_losses(
                problem.objective, params, {**raw, name: raw[name] + h}, batch
            )
            for h in (1e-5, -1e-5)
        ]
        np.testing.assert_allclose(forward[1][name], (ends[0] - ends[1]) / 2e-5, rtol=1e-4)


def test_the_configuration_of_the_readme():
    plan = jaxevent.runs.fit.read_plan(
        Path(__file__).parents[2] / "configs" / "fit_slider_depth.toml", ["slider_depth.zip"]
    )
    assert plan.tasks[0].label == "akf" and "c_on" in plan.tasks[0].names
    assert plan.recordings["fit"][0][1] == Path.cwd() / "slider_depth.zip"


TWO = """
recordings = ["moving.h5"]
calibrate = false
window = 0.25
warm_up = 0.05
batch = 1
iterations = 6
every = 3
rounds = 1
[[method]]
name = "edi"
params = "mine.toml"
fit = ["c_on"]
search = { clock_offset = [0, 0.01, 3] }
[[method]]
name = "blend"
label = "a blend"
starts = 2
fit = ["I0", "c_on"]
"""


class Killed(BaseException):
    pass


def interrupted(monkeypatch, after: int) -> None:
    """Let the next fit die between its n-th checkpoint and the one after."""
    save, count = jaxevent.runs.fit.save_checkpoint, 0

    def dying(*arguments):
        nonlocal count
        if count == after:
            raise Killed
        count += 1
        save(*arguments)

    monkeypatch.setattr(jaxevent.runs.fit, "save_checkpoint", dying)


def test_an_interrupted_fit_goes_on(folder, monkeypatch, capsys):
    monkeypatch.setattr(jaxevent.runs.fit, "CHECKPOINT_PERIOD_S", 0.0)
    config, out = write(folder, TWO), folder / "out"
    fit(config, folder / "whole")
    same = ("params.toml", "loss.csv", "config.toml")
    expected = [(folder / "whole" / name).read_bytes() for name in same]
    assert b'["a blend"]' in expected[0]
    for after in (13, 24):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            interrupted(patch, after)
            fit(config, out)
        assert [path.name for path in out.iterdir()] == ["checkpoint"]
        (out / ".checkpoint.0123.part").touch()  # as a kill while writing leaves it
        if after == 13:
            with monkeypatch.context() as patch, pytest.raises(Killed):
                interrupted(patch, 3)
                fit(config, out, resume=True)
        rows = fit(config, out, resume=True)
        assert [(out / name).read_bytes() for name in same] == expected, after
        assert not (out / "checkpoint").exists() and not list(out.glob(".*"))
        assert fit(config, out, resume=True) == rows  # nothing was left to do
        for path in out.iterdir():
            path.unlink()

    # What does not belong together is refused, and leaves the checkpoint alone.
    with monkeypatch.context() as patch, pytest.raises(Killed):
        interrupted(patch, 5)
        fit(config, out)
    checkpoint = (out / "checkpoint").read_bytes()
    fails(capsys, ["fit", config, "--out", out], out, "--resume")
    other = write(folder, TWO.replace("iterations = 6", "iterations = 7"), "other.toml")
    jaxevent.save(dataclasses.replace(moving(), name="copy"), folder / "copy.h5")
    for argv in ([other], [config, "--recording", folder / "copy.h5"]):
        fails(capsys, ["fit", *argv, "--out", out, "--resume"], out, "another configuration")
    write(folder, "c_off = 0.03\n", "mine.toml")
    fails(capsys, ["fit", config, "--out", out, "--resume"], out, "another configuration")
    write(folder, "c_off = 0.02\n", "mine.toml")
    kept = (folder / "moving.h5").read_bytes()
    jaxevent.save(moving()[:0.4], folder / "moving.h5")
    fails(capsys, ["fit", config, "--out", out, "--resume"], out, "other recordings")
    (folder / "moving.h5").write_bytes(kept)
    assert (out / "checkpoint").read_bytes() == checkpoint
    (out / "checkpoint").write_bytes(checkpoint[:-100])
    fails(capsys, ["fit", config, "--out", out, "--resume"], out, "is not a checkpoint")
    fails(capsys, ["fit", other, "--out", folder / "whole", "--resume"], "another run")


def test_a_fit_that_is_killed_ends_as_if_it_had_not_been(folder, capsys):
    """kill -9 in a descent; elsewhere the test above lets it die."""
    one = TWO[: TWO.rindex("[[")].replace("iterations = 6", "iterations = 100")
    config = write(folder, one.replace("every = 3", "patience = 100"))
    program = (
        "import jaxevent.runs.fit as f; f.CHECKPOINT_PERIOD_S = 0; "
        "from jaxevent.cli import main; main()"
    )

    def begin_fit(out: Path, *more: str) -> subprocess.Popen:
        argv = [sys.executable, "-c", program, "fit", config, "--out", out, *more]
        env = {**os.environ, "JAX_ENABLE_X64": "1"}  # as here
        return subprocess.Popen(argv, env=env, stdout=subprocess.PIPE, text=True)

    def kill_at(process: subprocess.Popen, out: Path, stage: int, iteration: int) -> None:
        while process.poll() is None:
            if (out / "checkpoint").exists():
                with (out / "checkpoint").open("rb") as file:
                    run = json.loads(file.readline())["run"]
                if run is not None and run[:2] >= [stage, iteration]:
                    break
            time.sleep(0.005)
        assert process.poll() is None, "the fit ended before it was killed"
        process.kill()
        process.communicate()

    out, whole = folder / "out", folder / "whole"
    fit(config, whole)
    capsys.readouterr()
    kill_at(begin_fit(out), out, 1, 20)
    assert cli.main(["fit", str(config), "--out", str(out), "--resume"]) == 0
    assert capsys.readouterr().out.count("edi, before") == 1
    assert not (out / "checkpoint").exists()
    for name in ("params.toml", "loss.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_a_fit_that_diverges_says_so(folder, capsys):
    """It writes what can be used, and tells again when it is asked to go on."""
    text = EDI.replace("learning_rate = 0.2", "learning_rate = 1000.0\nrounds = 1")
    text = text.replace("iterations = 30", "iterations = 3\nevery = 1")
    best = f"params = {{ c_on = {C_ON}, c_off = {C_OFF}, clock_offset = {LATE / 1e6} }}\n"
    text = text.partition("search")[0] + best
    config, out = write(folder, text), folder / "out"
    for again in ([], ["--resume"]):
        assert cli.main(["fit", str(config), "--out", str(out), *again]) == 2
        said = capsys.readouterr()
        assert said.err.count("\n") == 1 and "edi: the fit diverged" in said.err
        assert "| edi, before" in said.out
    jaxevent.METHODS["edi"].Params.load(out / "params.toml", "edi")
    rows = json.loads((out / "results.json").read_text())["rows"]
    told = {(row["method"], row["split"]): row["mse"] for row in rows}
    assert told["edi", "validation"] <= told["edi, before", "validation"]


def test_recordings_for_each_split_and_in_place_of_those_named(folder, capsys, monkeypatch):
    for name in ("a", "b", "c"):
        jaxevent.save(moving(), folder / f"{name}.h5")
    text = TWO.replace('["moving.h5"]', '["none.h5"]\nvalidation = ["b.h5"]\ntest = ["c.h5"]')
    config, out = write(folder, text.replace("starts = 2", "starts = 1")), folder / "out"
    monkeypatch.chdir(folder)
    argv = ["fit", str(config), "--out", str(out), "--recording", "a.h5"]
    assert cli.main(argv) == 0
    said = capsys.readouterr().out
    assert said.count("c.h5") == 4 and "b.h5" not in said and "params.toml" in said
    rows = json.loads((out / "results.json").read_text())["rows"]
    a = str(folder / "a.h5")
    assert [(row["recording"], row["split"]) for row in rows[:3]] == [
        (a, "fit"),
        ("b.h5", "validation"),
        ("c.h5", "test"),
    ]
    assert all(row["frames"] == 10 for row in rows)
    again = tomllib.loads((out / "config.toml").read_text())
    assert again == {**tomllib.loads(config.read_text()), "recordings": [a]}


class Likely(Filter):
    """A method whose likelihood tells the threshold and which frames it was given."""

    has_likelihood = True

    def log_likelihood(self, params, features):
        return -((params.c_on - 0.2) ** 2) * features.frames.grey.size + 0 * params.I0


BLEND = METHODS["blend"]
LIKELY = Likely(**{f.name: getattr(BLEND, f.name) for f in dataclasses.fields(BLEND)})


def test_the_likelihood_sees_given_frames_only(folder, monkeypatch):
    monkeypatch.setitem(METHOD_HOMES["reconstruction"], "likely", "test_fit:LIKELY")
    seen = []
    prepare = Likely.prepare

    def record(self, recording, times, params, **options):
        seen.append((recording.frames.t.tolist(), len(times)))
        return prepare(self, recording, times, params, **options)

    monkeypatch.setattr(Likely, "prepare", record)
    head = 'recordings = ["moving.h5"]\nloss = "likelihood"\nrounds = 1\n'
    method = '[[method]]\nname = "likely"\nfit = ["c_on"]\n'
    rows = fit(write(folder, head + method), folder / "out")
    assert seen == [(held_out(moving())[0].frames.t.tolist(), 0)]
    assert [row["split"] for row in rows] == ["test", "test"]
    assert rows[1]["params"]["c_on"] == pytest.approx(0.2, abs=1e-3)


def test_a_fit_of_the_likelihood_gains_likelihood(folder):
    head = 'recordings = ["moving.h5"]\nsplit = [1, 1, 1]\niterations = 1\nrounds = 1\n'
    method = 'error = "nll"\n[[method]]\nname = "akf"\nfit = ["frame_noise"]\n'
    fits = fit(write(folder, head + method), folder / "likely")
    (gain,) = fits.gains
    assert gain["measure"] == "nll"
    before, after = (row["nll"] for row in fits if row["split"] == "test")
    assert (gain["before"], gain["after"]) == (before, after) and before != after
    table = (folder / "likely" / "results.md").read_text()
    assert f"| {before:.4f} |" in table and " NLL |" in table
    assert f"Gain of akf: nll of test data {before:.4g} before" in table


GOOD = TWO.replace("starts = 2\n", "")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD.replace("recordings", "recordingz"), "'recordingz'; did you mean 'recordings'"),
        (GOOD.replace("moving", "none-*"), "none-*.h5"),
        (GOOD.replace("moving", "none"), "none.h5"),
        (GOOD.replace('["moving.h5"]', '"moving.h5"'), "recordings is"),
        (GOOD.replace('["moving.h5"]', "[]"), "no recording is given"),
        ('test = ["moving.h5"]' + GOOD, "moving.h5 is in two of"),
        ('validation = ["none.h5"]\nsplit = [1, 1, 1]' + GOOD, "split is for"),
        ("split = [0, 1, 1]" + GOOD, "split is"),
        ("split = [2, 1]" + GOOD, "split is"),
        ("size = [20]" + GOOD, "size is"),
        ('loss = "heldout"' + GOOD, "'heldout'; did you mean 'held-out'"),
        ('loss = "likelihood"' + GOOD, "'edi' has no likelihood"),
        ('loss = "reference"' + GOOD, "no HDR reference"),
        ('protocol = "reference"' + GOOD, "omit protocol"),
        ('loss = "likelihood"\nprotocol = "hidden"' + GOOD, "no protocol 'hidden'"),
        ('error = "linaer"' + GOOD, "'linaer'; did you mean 'linear'"),
        ('error = "nll"' + GOOD, "'edi' estimates no variance"),
        ("dark_offset = 0" + GOOD, "dark_offset is"),
        ("weights = { bright = 2 }" + GOOD, "weights are for HDR references"),
        ("weights = { light = 2 }" + GOOD, "weights is"),
        (GOOD.replace("window = 0.25", "window = 0"), "window is"),
        (GOOD.replace("warm_up = 0.05", "warm_up = -1"), "warm_up is"),
        (GOOD.replace("batch = 1", "batch = 0"), "batch is"),
        (GOOD.replace("iterations = 6", "iterations = 6.5"), "iterations is"),
        (GOOD.replace("rounds = 1", "rounds = true"), "rounds is"),
        ("seed = -1" + GOOD, "seed is"),
        ("learning_rate = nan" + GOOD, "learning_rate is"),
        ("patience = 0" + GOOD, "patience is"),
        ("spread = -1" + GOOD, "spread is"),
        ("starts = 0" + GOOD, "starts is"),
        (GOOD[: GOOD.index("[[")], "no method is given"),
        (GOOD.replace('name = "edi"', 'name = "edy"'), "method 1: there is no method 'edy'"),
        (GOOD.replace('name = "edi"', ""), "method 1: a method has no name"),
        (GOOD.replace('"a blend"', '"edi"'), "two methods are called 'edi'"),
        (GOOD + "seed = 3", "method 2: there is no setting 'seed'"),
        (GOOD + "params = 3", "method 2: params is"),
        (GOOD + "params = { c_one = 1 }", "'c_one'; did you mean 'c_on'"),
        (GOOD + "params = { I0 = 0 }", "I0 is 0; it must not be below 1e-06"),
        (GOOD.replace('["c_on"]', '["c_onn"]'), "no parameter 'c_onn'; did you mean 'c_on'"),
        (GOOD.replace('["c_on"]', '["clock_offset"]'), "search = { clock_offset = [from, to"),
        (GOOD.replace('["c_on"]', '"c_on"'), "fit is"),
        (GOOD.replace('["I0", "c_on"]', "[]"), "nothing is to be fitted"),
        (GOOD + "prior = { c_off = [0.1, 0.5] }", "the prior names c_off, which is not fitted"),
        (GOOD + "prior = { c_on = [0.1, 0] }", "method 2: the prior of c_on has the spread 0"),
        (GOOD + "prior = { c_on = 0.1 }", "method 2: prior is"),
        (GOOD + "prior_weight = 0", "method 2: prior_weight is"),
        (GOOD.replace("[0, 0.01, 3]", "[0, 0.01]"), "search is"),
        (GOOD.replace("[0, 0.01, 3]", "[0.01, 0, 3]"), "search of clock_offset"),
        (GOOD + "search = { I0 = [0, 1, 3] }", "I0 is both"),
        (GOOD + "fit = [", "is not TOML"),
    ],
)
def test_bad_configurations(text, said, folder, capsys):
    config = write(folder, text)
    before = sorted(folder.rglob("*"))
    fails(capsys, ["fit", config, "--out", folder / "out"], said)
    assert sorted(folder.rglob("*")) == before


def test_bad_ways_to_fit(folder, capsys):
    config = write(folder, TWO)
    before = sorted(folder.rglob("*"))
    fails(capsys, ["fit", folder / "none.toml", "--out", folder / "out"], "none.toml")
    fails(capsys, ["fit", config, "--out", folder / "missing" / "out"], folder / "missing")
    fails(capsys, ["fit", config, "--out", config], config)
    fails(
        capsys, ["fit", config, "--out", folder / "out", "--recording", folder / "no.h5"], "no.h5"
    )
    with pytest.raises(SystemExit):
        cli.main(["fit", str(config)])
    assert sorted(folder.rglob("*")) == before


def test_without_matplotlib_a_fit_writes_the_rest(tmp_path, capsys, monkeypatch):
    jaxevent.save(noise.small(), tmp_path / "small.h5")
    text = noise.ONE.replace('"blend"', '"edi"') + 'fit = ["c_on"]\n'
    config = write(tmp_path, "iterations = 1\nrounds = 1\nsplit = [1, 0, 1]\n" + text)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["fit", str(config), "--out", str(tmp_path / "out")]) == 0
    assert "loss.png is left out: it needs pip install" in capsys.readouterr().out
    names = ["config.toml", "loss.csv", "params.toml", "results.json", "results.md"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names


def test_relaxed_refractory_bound_finds_the_optimum_of_a_scan():
    """Changes that follow the pixel's last event within 10 ms are ten times less certain."""
    bound, size, stop = 0.01, 10, 800_000
    rng = np.random.default_rng(0)
    rows = []
    truth = np.full(size * size, math.log(1.5))
    for pixel in range(size * size):
        now = 0
        while True:
            gap = int(np.exp(rng.uniform(np.log(1e3), np.log(1e5))))
            now += gap
            if now >= stop:
                break
            step = 0.1 * rng.choice([1, -1])
            truth[pixel] += step + rng.normal(0, 0.2 if gap <= bound * 1e6 else 0.02)
            rows.append((now, pixel % size, pixel // size, step > 0))
    t, x, y, p = (np.array(column) for column in zip(*sorted(rows), strict=True))
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p)
    grey = np.full((1, size, size), 0.5, np.float32)
    frames = Frames(np.zeros(1, np.int64), grey, np.zeros(1, np.int64))
    recording = Recording("noisy", size, size, events, frames).check()

    def params(rho):
        return jaxevent.akf.Params(
            sigma_ref=0.2, sigma_iso=1e-3, sigma_proc=5e-3, kappa=1e-9, P0=1e-4, rho=rho,
            rho_width=0.3,
        )  # fmt: skip

    batch = jaxevent.akf.prepare(recording, np.array([stop]), params(bound), extrapolate=True)

    @jax.jit
    def loss(params, batch):
        features, out = batch
        image, P, _ = jaxevent.akf.read(params, jaxevent.akf.run(params, features)[0], out)
        error = jnp.log(image + params.I0) - truth
        return (error**2 / P + jnp.log(P)).mean() / 2

    scan = np.geomspace(4e-3, 0.025, 13)
    losses = [float(loss(params(float(rho)), batch)) for rho in scan]
    best = scan[int(np.argmin(losses))]
    assert 0.008 < best < 0.013
    for start in (2e-3, 0.06):
        settings = Settings(iterations=30, learning_rate=0.2, rounds=1)
        found = optimise(loss, params(start), ["rho"], [batch], settings=settings).params
        assert float(loss(found, batch)) <= min(losses) + 1e-3
        assert float(found.rho) == pytest.approx(best, rel=0.15)
