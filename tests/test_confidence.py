"""Intervals of fitted numbers against closed forms, and what is said of numbers that run away."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxevent import confidence
from jaxevent.confidence import confidence_intervals
from jaxevent.parameters import Number, Parameters, Positive
from jaxevent.tuning import Settings, optimise


class Toy(Parameters):
    mean: Number = Number(0.0, "px", "of normal numbers")
    spread: Positive = Positive(1.0, "px", "their standard deviation")
    idle: Positive = Positive(1.0, "1", "does nothing")
    gain: Positive = Positive(1.0, "1", "the larger the better, ever less", most=1e6)
    capped: Positive = Positive(0.5, "1", "least at 1, beyond its bound", most=0.8)
    late: Number = Number(0.0, "s", "is searched", gradient=False)

    def __init__(self, **values: Any):
        super().__init__(**values)


DRAWN = np.random.default_rng(3).normal(2.0, 0.7, 60)
EACH = [jnp.asarray(x) for x in DRAWN]  # a part for each number


def square(params: Toy, batch: Any) -> jax.Array:
    return (params.mean - batch) ** 2


def test_the_interval_of_a_mean_is_students():
    found = Toy(mean=float(DRAWN.mean()))
    (one,) = confidence_intervals(square, Toy(), found, ["mean"], EACH).intervals
    n = len(DRAWN)
    low, high = scipy.stats.t.interval(0.95, n - 1, DRAWN.mean(), DRAWN.std(ddof=1) / np.sqrt(n))
    assert (one.low, one.high) == pytest.approx((low, high), rel=1e-4)
    assert (one.start, one.value, one.unit) == (0.0, pytest.approx(DRAWN.mean()), "px")
    assert not one.remark and one.holds(2.0) and not one.holds(high + 0.01)


def test_parts_that_the_loss_tells_apart_count_as_batches_do():
    class Whole:
        def __call__(self, params, batch):
            return ((params.mean - batch) ** 2).mean()

        def parts(self, params, batch):
            return (params.mean - batch) ** 2, jnp.ones_like(batch)

    found = Toy(mean=float(DRAWN.mean()))
    apart = confidence_intervals(square, Toy(), found, ["mean"], EACH)
    whole = confidence_intervals(Whole(), Toy(), found, ["mean"], [jnp.asarray(DRAWN)])
    assert apart.parts == whole.parts == 60
    assert whole["mean"].low == pytest.approx(apart["mean"].low, rel=1e-5)


class Likelihood:
    """Minus the mean log density of normal numbers."""

    likelihood = True

    def __call__(self, params, batch):
        z = (batch - params.mean) / params.spread
        return (z**2 / 2 + jnp.log(params.spread)).mean()


@jax.tree_util.register_pytree_node_class
class Measured:
    """A batch that knows how many measurements it holds."""

    def __init__(self, values):
        self.values, self.weight = values, float(values.size)

    def tree_flatten(self):
        return (self.values,), None

    @classmethod
    def tree_unflatten(cls, _, children):
        made = object.__new__(cls)
        (made.values,), made.weight = children, 60.0
        return made


def test_one_batch_of_a_likelihood_has_the_interval_of_its_information():
    """Fisher's: var(mean) = s^2 / n, var(ln s) = 1 / (2 n)."""

    class Loss(Likelihood):
        def __call__(self, params, batch):
            return super().__call__(params, batch.values)

    s, n = float(DRAWN.std()), len(DRAWN)
    found = Toy(mean=float(DRAWN.mean()), spread=s)
    told = confidence_intervals(
        Loss(), Toy(), found, ["mean", "spread"], [Measured(jnp.asarray(DRAWN))]
    )
    assert told.parts == 0
    half = 1.959964 * s / np.sqrt(n)
    assert told["mean"].high == pytest.approx(told["mean"].value + half, rel=1e-4)
    assert told["spread"].high == pytest.approx(s * np.exp(1.959964 / np.sqrt(2 * n)), rel=1e-3)
    assert told["spread"].low == pytest.approx(s * np.exp(-1.959964 / np.sqrt(2 * n)), rel=1e-3)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """Of 100 samples; the interval of a spread is that of large samples, a little narrow."""

    class PartwiseLoss(Likelihood):
        def parts(self, params, batch):
            z = (batch - params.mean) / params.spread
            return z**2 / 2 + jnp.log(params.spread), jnp.ones_like(batch)

    rng, held, loss = np.random.default_rng(0), np.zeros(2), PartwiseLoss()
    for _ in range(100):
        drawn = rng.normal(2.0, 0.7, 80)
        found = Toy(mean=float(drawn.mean()), spread=float(drawn.std()))
        told = confidence_intervals(loss, Toy(), found, ["mean", "spread"], [jnp.asarray(drawn)])
        held += told["mean"].holds(2.0), told["spread"].holds(0.7)
    assert 89 <= held[0] < 100 and 86 <= held[1] < 100


STEPS = Settings(iterations=80, learning_rate=0.1, rounds=1, patience=1000, every=1)


@pytest.mark.slow
def test_what_ran_away_and_what_does_nothing_is_told():
    def loss(params, batch):
        falls = 1 / (1 + params.gain) * (1 + 0.1 * batch)
        return square(params, batch) + falls + 0 * params.idle

    names, start = ["mean", "idle", "gain"], Toy(mean=1.5)
    fitted = optimise(loss, start, names, EACH[:20], settings=STEPS)
    told = confidence_intervals(loss, start, fitted.params, names, EACH[:20])
    assert told["gain"].remark == confidence.RAN_AWAY and told["gain"].high is None
    assert told["gain"].interval.startswith("above") and told["gain"].value > 10
    assert told["idle"].remark == confidence.UNDETERMINED and told["idle"].interval == "any"
    assert not told["mean"].remark and told["mean"].holds(2.0)


def test_what_ran_to_its_bound_is_told():
    def loss(params, batch):
        return (params.capped - 1) ** 2 * (1 + batch)

    fitted = optimise(loss, Toy(), ["capped"], EACH[:8], settings=STEPS)
    (one,) = confidence_intervals(loss, Toy(), fitted.params, ["capped"], EACH[:8]).intervals
    assert 0.7 < one.value <= 0.8 and one.remark == confidence.REACHED_BOUND.format(0.8)


def test_a_number_that_stopped_on_its_way_is_told():
    settings = Settings(iterations=3, learning_rate=0.1, rounds=1)
    fitted = optimise(square, Toy(), ["mean"], EACH, settings=settings)
    one = confidence_intervals(square, Toy(), fitted.params, ["mean"], EACH)["mean"]
    assert one.remark == confidence.NOT_CONVERGED and one.value < 1


@pytest.mark.parametrize(
    "to, found, remark", [(1.0, 0.37, ""), (0.3, 0.3, confidence.REACHED_SEARCH_END.format(0.3))]
)
def test_a_searched_number(to, found, remark):
    """The loss is prepared anew for every value: least at the mean of numbers around 0.37."""
    drawn = np.random.default_rng(1).normal(0, 0.1, 40)
    drawn += 0.37 - drawn.mean()

    def prepare(params):
        return [jnp.asarray((x - float(params.late)) ** 2) for x in drawn], []

    def loss(params, batch):
        return batch + 0 * params.mean

    one = confidence_intervals(loss, Toy(), Toy(late=found), [], prepare, {"late": (-1, to, 9)})[
        "late"
    ]
    assert one.remark == remark and one.start == 0
    if remark:
        assert one.high is None
    else:
        half = scipy.stats.t.ppf(0.975, 39) * drawn.std(ddof=1) / np.sqrt(40)
        ends = np.array([one.low, one.high], float)
        np.testing.assert_allclose(ends, [0.37 - half, 0.37 + half], atol=0.1 * half)


def test_few_parts_give_no_interval():
    (one,) = confidence_intervals(square, Toy(), Toy(mean=2.0), ["mean"], EACH[:2]).intervals
    assert one.interval == "-" and not one.holds(2.0)
