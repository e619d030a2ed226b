"""Priors of fits against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxevent
from jaxevent.errors import InputError
from jaxevent.tuning import LossWithPrior, Settings, with_prior

SPREAD, N = 0.3, 40
PRIOR = {"c_on": (0.2, 0.1)}


def measured(params, batch):
    """-ln p of logarithms of a threshold that were measured with a known spread, their mean."""
    return (((batch - params.raw["c_on"]) / SPREAD) ** 2).mean() / 2


measured.likelihood = True


class Parts:
    """The same, measurement by measurement."""

    def __call__(self, params, batch):
        return measured(params, batch)

    def parts(self, params, batch):
        return ((batch - params.raw["c_on"]) / SPREAD) ** 2 / 2, jnp.ones_like(batch)


@pytest.mark.slow
def test_a_prior_and_a_likelihood_make_the_posterior():
    """Of Gaussians, in logarithms: the mean weighted by precision, and the precisions added."""
    y = jnp.asarray(np.random.default_rng(3).normal(np.log(0.1), SPREAD, N))
    params = jaxevent.akf.Params()
    precision = N / SPREAD**2, 1 / 0.1**2
    mean = np.average([float(y.mean()), np.log(0.2)], weights=precision)
    believed = with_prior(measured, params, PRIOR, 1 / N)
    settings = Settings(iterations=200, rounds=1, learning_rate=0.1, patience=200)
    fitted = jaxevent.optimise(believed, params, ["c_on"], [y], (), settings)
    np.testing.assert_allclose(np.log(float(fitted.params.c_on)), mean, atol=2e-3)
    assert abs(mean - float(y.mean())) > 0.05
    curvature = jax.jit(jax.hessian(lambda raw: believed(params.with_raw({"c_on": raw}), y)))
    np.testing.assert_allclose(N * curvature(jnp.log(0.1)), sum(precision))


def test_parts_and_likelihood_of_the_loss_remain():
    params, y = jaxevent.akf.Params(c_on=0.3), jnp.linspace(-2.0, -1.0, 5)
    believed = with_prior(measured, params, PRIOR)
    assert believed.likelihood and not hasattr(believed, "parts")
    parted = with_prior(Parts(), params, PRIOR, 0.5)
    assert not parted.likelihood
    values, weights = parted.parts(params, y)
    np.testing.assert_allclose(np.average(values, weights=weights), parted(params, y))
    rise = parted(params, y) - measured(params, y)
    np.testing.assert_allclose(rise, 0.25 * (np.log(0.3 / 0.2) / 0.1) ** 2)
    assert with_prior(measured, params, {}) is measured
    same = with_prior(measured, params, PRIOR)
    assert same == believed and hash(same) == hash(believed) and isinstance(same, LossWithPrior)


@pytest.mark.parametrize(
    ("prior", "weight", "message"),
    [
        ({"c_no": (0.1, 0.5)}, 1, "which is no number"),
        ({"c_on": (0.1, 0.0)}, 1, "has the spread 0"),
        ({"sigma_iso": (0.0, 1.0)}, 1, "which has no logarithm"),
        ({"c_on": (-0.1, 1.0)}, 1, "c_on"),
        (PRIOR, 0, "the weight of a prior is 0"),
    ],
)
def test_priors_that_say_nothing_are_refused(prior, weight, message):
    with pytest.raises(InputError, match=message):
        with_prior(measured, jaxevent.akf.Params(), prior, weight)
