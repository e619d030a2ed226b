"""Kinds of numbers: their domains, what is stored, and where derivatives go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent.errors import InputError
from jaxevent.parameters import Count, Number, Parameters, Positive, Share


class Given(Parameters):
    """Parameters of this test."""

    offset = Number(-1.0, "s", "an offset")
    sigma = Positive(0.5, "px", "a spread")
    outliers = Share(0.1, "", "share of outliers")
    late = Positive(0.2, "s", "acts when data are prepared", gradient=False)
    cells = Count(3, "", "number of cells")


@pytest.mark.parametrize(
    "values, said",
    [
        ({"outliers": 1.0}, "outliers is 1.0; it is a share, from 0 to below 1"),
        ({"outliers": 1.5}, "it is a share"),
        ({"outliers": -0.1}, "it is a share"),
        ({"sigma": -1.0}, "sigma is -1.0; it must not be negative"),
        ({"offset": float("nan")}, "give a finite number"),
        ({"offset": True}, "give a finite number"),
        ({"cells": 0}, "a whole number above 0"),
        ({"sigmas": 1.0}, "did you mean 'sigma'"),
    ],
)
def test_values_outside_the_domain_are_refused(values, said):
    with pytest.raises(InputError, match=said):
        Given(**values)
    with pytest.raises(InputError, match=said):
        Given().replace(**values)


@pytest.mark.parametrize("share", [0.0, 1e-6, 0.1, 0.5, 0.999])
def test_a_share_is_what_was_given(share):
    params = Given(outliers=share)
    assert float(params.outliers) == pytest.approx(share, rel=1e-12)
    # Wherever an optimiser steps, it stays one.
    for step in (-50.0, 50.0):
        moved = params.with_raw({"outliers": params.raw["outliers"] + step})
        assert 0 <= float(moved.outliers) <= 1


def test_derivatives_stop_at_what_is_prepared():
    params = Given()

    def total(params):
        return params.offset + params.sigma**2 + params.outliers + 3 * params.late

    slope = jax.grad(total)(params).raw
    assert float(slope["sigma"]) == pytest.approx(2 * 0.5**2)  # by its logarithm
    assert float(slope["outliers"]) == pytest.approx(0.1 * 0.9)  # by its logit
    assert float(slope["late"]) == 0
    assert set(params.without_gradient()) == {"late"}
    followed = params.with_derivatives("late")
    assert float(jax.grad(total)(followed).raw["late"]) == pytest.approx(3 * 0.2)
    assert float(total(followed)) == float(total(params))


def test_values_travel_through_jit_and_vmap():
    params = Given(sigma=0.25)
    assert float(jax.jit(lambda p: p.sigma)(params)) == pytest.approx(0.25)
    many = jax.vmap(lambda s: params.replace(sigma=s))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(many.sigma, [0.1, 0.2], rtol=1e-12)
    seen = []
    jax.jit(lambda p: seen.append(repr(p)) or p.sigma)(params)
    assert "sigma=float64[]" in seen[0] or "sigma=f64[]" in seen[0]


def test_values_made_in_double_precision_are_read_in_single():
    params = Given(sigma=0.3)
    with jax.enable_x64(False):
        assert params.sigma.dtype == np.float32 and float(params.sigma) == pytest.approx(0.3)
        under_jit = jax.jit(lambda params: params.sigma)(params)
        np.testing.assert_allclose(params.sigma, under_jit, rtol=1e-6)
