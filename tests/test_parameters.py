"""Kinds of numbers: their domains, what is stored, and where derivatives go."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxevent
from jaxevent.errors import InputError
from jaxevent.parameters import Count, Number, Parameters, Positive, UnitInterval
from jaxevent.precision import to_jax


class Given(Parameters):
    """Parameters of this test."""

    offset: Number = Number(-1.0, "s", "an offset")
    sigma: Positive = Positive(0.5, "px", "a spread")
    outliers: UnitInterval = UnitInterval(0.1, "", "share of outliers")
    late: Positive = Positive(0.2, "s", "acts when data are prepared", gradient=False)
    cells: Count = Count(3, "", "number of cells")


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
    assert set(params.names_without_gradient()) == {"late"}
    followed = params.with_derivatives("late")
    assert float(jax.grad(total)(followed).raw["late"]) == pytest.approx(3 * 0.2)
    assert float(total(followed)) == float(total(params))


def test_dataclasses_replace_is_the_method():
    params = Given(sigma=2.0).with_derivatives("late")
    changed = dataclasses.replace(params, offset=3.0, cells=5)
    assert type(changed) is Given and changed.added_derivatives == {"late"}
    assert changed.values() == Given(sigma=2.0, offset=3.0, cells=5).values()
    assert jax.tree.structure(changed) == jax.tree.structure(params.replace(cells=5))
    with pytest.raises(InputError, match="no parameter 'sigmas'; did you mean 'sigma'"):
        dataclasses.replace(params, sigmas=1.0)
    gradient = jax.grad(lambda p: dataclasses.replace(p, sigma=p.sigma * 2).sigma)(params)
    assert gradient.per_unit(params)["sigma"] == pytest.approx(2)


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


@pytest.mark.parametrize(
    "kind",
    [np.float16, np.float32, np.int8, np.array, jnp.array, lambda v: jnp.array(v, jnp.bfloat16)],
)
def test_numbers_of_numpy_and_jax_are_numbers(kind):
    value = kind(2)
    params = Given(sigma=value, offset=value, cells=np.uint16(4))
    assert float(params.sigma) == pytest.approx(2, rel=1e-12) and float(params.offset) == 2
    assert Given().replace(sigma=value).values() == Given(sigma=2).values()
    assert params.cells == 4 and type(params.cells) is int


@pytest.mark.parametrize(
    "value, said",
    [
        (np.float32("nan"), "sigma is nan; give a finite number"),
        (jnp.array(jnp.inf), "sigma is inf; give a finite number"),
        (jnp.array(-1.0), "sigma is -1.0; it must not be negative"),
        (np.bool_(True), "sigma is True; give a finite number"),
        ("0.1", "sigma is '0.1'; give a finite number below 1e.15 in size, without quotes"),
        (0.1 + 0j, "sigma is .*; give a finite number"),
        (np.complex64(1), "sigma is .*; give a finite number"),
        (np.ma.masked, "sigma is None; give a finite number"),
        ([0.1, 0.2], "sigma is .*; give one number, and use jax.vmap"),
        (np.array([0.1]), "sigma is .*; give one number, and use jax.vmap"),
        (jnp.ones((2, 2)), "sigma is .*; give one number, and use jax.vmap"),
    ],
)
def test_what_is_no_number_is_refused_in_a_sentence(value, said):
    for make in (Given, Given().replace):
        with pytest.raises(InputError, match=f"^the parameter {said}") as refused:
            make(sigma=value)
        assert "\n" not in str(refused.value)


def test_traced_values_pass_unless_they_are_complex():
    given = jax.jit(lambda s: Given(sigma=s).sigma)
    assert np.isnan(given(jnp.nan))
    with pytest.raises(InputError, match="sigma is traced as complex.*; give a real number"):
        given(1j)


def loss(params):
    return (params.offset - 2) ** 2 + jnp.log(params.sigma) * params.outliers + params.sigma**3


def test_a_gradient_shows_itself_and_is_converted_to_units():
    params = Given(sigma=0.25, outliers=0.2)
    for gradient in (jax.grad(loss)(params), jax.jit(jax.grad(loss))(params)):
        assert gradient.is_gradient and not params.is_gradient
        text = repr(gradient)
        assert text.startswith("<gradient by Given.raw") and text.endswith("; 0: late>")
        assert "offset=-6, sigma=0.2469, outliers=-0.2218;" in text  # d / d ln, d / d logit
        found = gradient.per_unit(params)
        h = 1e-6
        for name in ("offset", "sigma", "outliers"):
            ends = [
                loss(params.replace(**{name: float(getattr(params, name)) + s})) for s in (-h, h)
            ]
            assert float(found[name]) == pytest.approx(float(ends[1] - ends[0]) / (2 * h), rel=1e-8)
    with pytest.raises(
        InputError, match=r"a value of sigma; .* gradient.per_unit\(params\)\[.sigma"
    ):
        getattr(gradient, "sigma")  # noqa: B009
    for refused in (lambda: params.per_unit(params), lambda: gradient.per_unit(gradient)):
        with pytest.raises(InputError, match="per_unit"):
            refused()
    inside = jax.jit(lambda params: jax.grad(loss)(params).per_unit(params))(params)
    np.testing.assert_allclose(inside["sigma"], found["sigma"], rtol=1e-12)
    assert np.isnan(Given(sigma=0.0).raw["sigma"] * 0)  # stored as -inf
    assert np.isnan(jax.grad(lambda p: p.sigma)(p0 := Given(sigma=0.0)).per_unit(p0)["sigma"])
    params = jaxevent.akf.Params(exposure=0.0)
    gradient = jax.grad(lambda p: p.c_on**2)(params).per_unit(params)
    prepared = [name for name, number in params.numbers.items() if not number.gradient]
    assert "exposure" in prepared and all(gradient[name] == 0 for name in prepared)


def test_a_step_is_no_parameters_and_its_sum_with_some_is():
    params = Given()
    adam = optax.adam(0.1)
    gradient, memory = jax.grad(loss)(params), adam.init(params)
    step, memory = adam.update(gradient, memory)
    assert step.is_gradient and memory[0].mu.is_gradient
    moved = optax.apply_updates(params, step)
    assert not moved.is_gradient and float(moved.offset) == pytest.approx(-0.9)
    assert repr(moved).startswith("Given(offset=-0.9, sigma=0.4524, ")
    assert repr(jax.tree.map(lambda leaf: None, params)).startswith("Given(")


def test_a_repr_shows_few_of_many_numbers():
    params = jaxevent.mc.Params()
    weights = np.asarray(params.choice).tolist()
    assert f"choice=[{weights[0]:.4g}, " in repr(params) and len(repr(params)) < 800
    assert f", ... {len(weights)} numbers]" in repr(params)
    # A change of a number that is not shown is a change.
    changed = params.replace(choice=[*weights[:-1], weights[-1] + 1])
    assert repr(changed).startswith("Params(choice=[")


def test_numbers_become_jax_arrays_without_a_program(caplog):
    """JAX compiles a program for each shape that it converts itself."""
    values = np.arange(7 * 13.0).reshape(7, 13)  # a shape that no other test converts
    with jax.log_compiles():
        converted = to_jax(values)
        assert "Compiling" not in caplog.text
        jnp.asarray(values)
        assert "Compiling" in caplog.text
    assert isinstance(converted, jax.Array) and converted.dtype == jnp.result_type(float)
    np.testing.assert_array_equal(converted, values)
    assert to_jax(converted) is converted and to_jax(2).dtype == jnp.result_type(int)
