"""Losses that are rough: found out before the first step, searched, and given honest intervals."""

import copy
import json
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxevent.confidence import ROUGH, confidence_intervals
from jaxevent.parameters import Number, Parameters, Positive
from jaxevent.runs.results import format_findings, restore_checkpoint, save_checkpoint
from jaxevent.tuning import RoughNumber, Settings, begin, gradient_skill, optimise

TRUE = 3.0
FAR = 600.0


class Toy(Parameters):
    a: Positive = Positive(1.0, "px", "least at TRUE")
    b: Number = Number(0.0, "px", "least at -1")


def rough(params: Toy, batch: Any) -> jax.Array:
    """A valley, and ripples whose slope is three times the valley's at the start."""
    u = jnp.log(params.a / TRUE)
    return 1 + 0.02 * u**2 + 0.01 * jnp.cos(60 * u + batch) + (params.b + 1) ** 2


def smooth(params: Toy, batch: Any) -> jax.Array:
    return jnp.log(params.a / TRUE) ** 2 + 0 * batch + (params.b + 1) ** 2


BATCHES = [jnp.asarray(0.3)]
SETTINGS = Settings(iterations=20, learning_rate=0.05, rounds=1)


def test_the_skill_of_a_gradient():
    x = np.array([-1.0, -0.4, 0.0, 0.3, 1.0])
    assert gradient_skill(x, 3 * x**2 + x, 6 * x + 1) == pytest.approx(1)
    assert gradient_skill(x, 3 * x**2 + x, 0 * x) == pytest.approx(0, abs=1e-9)
    assert gradient_skill(x, np.cos(500 * x), -500 * np.sin(500 * x)) < -100
    assert gradient_skill(x, 1 + 1e-7 * np.cos(500 * x), 0 * x) == 1, "rounding counts for nothing"
    slopes = np.where(x == 0.3, np.nan, 6 * x + 1)
    assert gradient_skill(x, 3 * x**2 + x, slopes) == pytest.approx(1)


def test_a_rough_number_is_searched_first(optimised):
    start = Toy(a=FAR)
    fit = optimise(rough, start, ["a", "b"], BATCHES, settings=SETTINGS)
    assert list(fit.rough) == ["a"] and fit.rough["a"].skill < 0.5
    assert abs(np.log(fit.rough["a"].searched / TRUE)) < 0.8, "within what ripples hide"
    assert abs(np.log(float(fit.params.a) / TRUE)) < 0.8
    plain = optimise(
        rough, start, ["a", "b"], BATCHES, settings=Settings(20, 0.05, rounds=1, probe=False)
    )
    assert float(plain.params.a) > FAR / 2, "the gradient alone stays in a ripple"
    assert not plain.rough


def test_a_smooth_loss_is_followed_as_ever():
    probed, plain = (
        optimise(smooth, Toy(a=8.0), ["a", "b"], BATCHES,
                 settings=Settings(20, 0.05, rounds=1, probe=probe))
        for probe in (True, False)
    )  # fmt: skip
    assert probed.rough == {}
    assert probed.history == plain.history
    assert float(probed.params.a) == float(plain.params.a)


def test_several_starts_move_together():
    settings = Settings(iterations=1, rounds=1, starts=3)
    saved = []
    optimise(rough, Toy(a=FAR), ["a"], BATCHES, settings=settings,
             save=lambda run, _: saved.append(copy.deepcopy(run)))  # fmt: skip
    before, after = saved[0], next(run for run in saved if run.stage == 1)
    shift = np.asarray(after.position.raw["a"] - before.position.raw["a"])
    np.testing.assert_allclose(shift, shift[0], rtol=1e-4)
    assert abs(shift[0]) > 5


def test_a_search_taken_up_again_ends_the_same(tmp_path):
    saved = []
    start = Toy(a=FAR)
    whole = optimise(rough, start, ["a", "b"], BATCHES, settings=SETTINGS,
                     save=lambda run, _: saved.append(copy.deepcopy(run)))  # fmt: skip
    task = types.SimpleNamespace(params=start, names=["a", "b"], settings=SETTINGS, search={})
    plan: Any = types.SimpleNamespace(tasks=[task, task])
    for run in (saved[3], saved[len(saved) // 2], saved[-3]):
        file = tmp_path / "checkpoint"
        save_checkpoint(file, "key", [whole], run)
        done, under_way = restore_checkpoint(file.read_bytes(), file, "key", plan)
        assert done[0].rough == whole.rough
        again = optimise(rough, start, ["a", "b"], BATCHES, settings=SETTINGS, run=under_way)
        assert float(again.params.a) == float(whole.params.a)
        assert again.rough == whole.rough
    assert begin(start, ["a"], SETTINGS).rough == {}
    assert json.loads(json.dumps(whole.rough))["a"][1] == whole.rough["a"].searched


def test_the_interval_of_a_rough_loss_is_that_of_the_smooth_one():
    drawn = np.random.default_rng(2).normal(0.0, 0.4, 40)
    phase = np.random.default_rng(3).uniform(0, 6, 40)

    def loss(params: Toy, batch: Any) -> jax.Array:
        u = jnp.log(params.a / TRUE)
        return (u - batch[0]) ** 2 + 0.02 * jnp.cos(300 * u + batch[1])

    batches = [jnp.asarray(pair) for pair in zip(drawn, phase, strict=True)]
    found = Toy(a=TRUE * float(np.exp(drawn.mean())))
    one = confidence_intervals(loss, Toy(), found, ["a"], batches)["a"]
    expected = TRUE * np.exp(
        scipy.stats.t.interval(0.95, 39, drawn.mean(), drawn.std(ddof=1) / 40**0.5)
    )
    assert one.remark == ROUGH
    np.testing.assert_allclose(np.log([one.low, one.high]), np.log(expected), atol=0.04)


@pytest.mark.parametrize("ended", [0.15, 0.28])
def test_the_interval_of_a_flat_loss_reaches_from_wall_to_wall(ended):
    """To which no parabola fits: the one nearest to it has a minimum as sharp as its walls."""
    shifts = np.random.default_rng(4).normal(0.0, 0.02, 30)
    phase = np.random.default_rng(5).uniform(0, 6, 30)

    def loss(params: Toy, batch: Any) -> jax.Array:
        u = jnp.log(params.a / TRUE) - batch[0]
        return 4 * jnp.maximum(jnp.abs(u) - 0.3, 0) ** 2 + 0.02 * jnp.cos(300 * u + batch[1])

    batches = [jnp.asarray(pair) for pair in zip(shifts, phase, strict=True)]
    found = Toy(a=TRUE * float(np.exp(ended)))
    one = confidence_intervals(loss, Toy(), found, ["a"], batches)["a"]
    assert one.remark == ROUGH
    np.testing.assert_allclose(np.log(np.array([one.low, one.high]) / TRUE), [-0.3, 0.3], atol=0.08)


def test_the_results_say_it():
    row: dict[str, Any] = {
        "method": "voting", "parameter": "r_t", "unit": "px/s", "start": 1e4, "found": 50.0,
        "low": 40.0, "high": 60.0, "interval": "40 to 60", "of": "16 windows",
        "remark": "rough loss: searched first, to 45", "gradient_skill": -12.2,
    }  # fmt: skip
    text = format_findings([row], [])
    assert "searched first, to 45" in text
    assert "The loss of voting is rough in r_t" in text and "skill of -12" in text
    assert "rough" not in format_findings([{**row, "gradient_skill": None, "remark": ""}], [])
    assert RoughNumber(-12.2, 45.0).searched == 45.0
