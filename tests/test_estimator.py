"""The contract: arguments that are refused in a sentence, results that are tuples."""

import gc
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from noise import small

import jaxevent
from jaxevent import InputError, methods
from jaxevent.estimator import Estimate

METHODS = sorted(jaxevent.METHODS)


@pytest.fixture(scope="module")
def recording():
    return small()


def refuses(said, step, *args, **kwargs):
    with pytest.raises(InputError, match=said) as refused:
        step(*args, **kwargs)
    assert "\n" not in str(refused.value) and str(refused.value)[-1] != "."


@pytest.mark.parametrize("name", METHODS)
def test_what_is_no_recording_is_refused_by_every_method(name, recording):
    method = jaxevent.METHODS[name]
    arrays = recording.events.to_structured()
    for step in (method.estimate, lambda it: method.prepare(it, [0.02])):
        for path in ("a.h5", pathlib.Path("a.h5")):
            refuses(r"takes a recording, not a path; give jaxevent.load\('a.h5'\)", step, path)
        refuses("not bare events; .*Recording.from_arrays", step, recording.events)
        for value, said in (
            ({"t": arrays["t"]}, "a dict"),
            (arrays, "an array"),
            (recording.events.to_dataframe(), "a DataFrame"),
            (None, "None"),
            (method.Params(), "an? [A-Za-z0-9]*Params"),
            (jaxevent.Recording, "the class Recording"),
        ):
            refuses(f"not ({said}); .*jaxevent.load.*Recording.from_arrays", step, value)


@pytest.mark.parametrize("name", METHODS)
def test_what_are_no_parameters_are_refused_by_every_method(name, recording):
    method, spelled = jaxevent.METHODS[name], name.replace("-", "_")
    other = jaxevent.blob.moment if method.family != "blob" else jaxevent.akf
    for step in (method.estimate, lambda r, params: method.prepare(r, [0.02], params)):
        refuses(rf"not a dict; give {spelled}.Params\(\*\*params\)", step, recording, {"c_on": 0.1})
        refuses(rf"not a float; give {spelled}.Params\(name=value\)", step, recording, 0.1)
        refuses(rf"not a str; give {spelled}.Params.load\('p'\)", step, recording, "p")
        refuses("not the class", step, recording, method.Params)
        refuses("not those of jaxevent", step, recording, other.Params())
        zeros = jax.tree.map(jnp.zeros_like, method.Params())
        refuses("not a gradient", step, recording, zeros)


@pytest.mark.parametrize("name", METHODS)
def test_tracing_estimate_or_prepare_names_what_is_differentiable(name, recording):
    method = jaxevent.METHODS[name]
    said = "works on the host, where jax.grad, jit and vmap cannot follow; "
    if not method.differentiable:
        said += "choose another method"
    elif method.family == "reconstruction":
        said += r"prepare once outside, images = .*prepare_images\(recording, times\)"
    else:
        said += r"prepare once outside, features, out = prepare\(recording, times\)"
    refuses(
        said, jax.grad(lambda p: method.estimate(recording, p)(0.02).mean.sum()), method.Params()
    )
    refuses(said, jax.jit(lambda p: method.prepare(recording, [0.02], p)), method.Params())
    if not method.differentiable:
        refuses(said, jax.grad(lambda p: method.run(p, None)[0]), method.Params())


def test_mapped_parameters_go_where_they_are_mapped(recording):
    many = jax.vmap(lambda c: jaxevent.akf.Params(c_on=c))(jnp.array([0.1, 0.2]))
    refuses("one value of c_on, not 2; for jax.vmap", jaxevent.akf.estimate, recording, many)


@pytest.mark.parametrize("name", METHODS)
def test_other_arguments_are_refused_by_every_method(name, recording):
    method = jaxevent.METHODS[name]
    refuses("no option 'windows'|unexpected keyword argument 'windows'",
            method.estimate, recording, windows=3)  # fmt: skip
    refuses("missing a required argument: 'recording'", method.estimate)
    refuses("too many positional arguments", method.estimate, recording, None, 3)
    if "c_on" in method.Params.numbers:
        refuses("give Params.c_on=", method.estimate, recording, c_on=0.1)
    for times in (None, "now", [[0, 1], [2]], [[0.01, 0.02]], [True], [np.nan], 1j):
        refuses("times", method.prepare, recording, times)


@pytest.mark.slow
def test_second_derivatives_through_a_kernel_name_the_compiler_that_has_them(recording):
    with jax.enable_x64(False):
        params = jaxevent.akf.Params()
        images = jaxevent.akf.prepare_images(recording, [0.02], params)

        def loss(params):
            return (images(params, variance=False).mean ** 2).mean()

        first = jax.grad(loss)(params)
        assert first.is_gradient and np.isfinite(first.raw["c_on"])
        refuses('first derivatives only; .*compiler="xla"', jax.hessian(loss), params)


def test_an_estimate_is_the_tuple_of_its_fields():
    one = Estimate(np.zeros(2), np.ones(2), np.array([True, False]))
    assert len(one) == 3 and one[0] is one.mean and one[-1] is one.valid
    assert one[:2] == (one.mean, one.covariance)
    for part, other in zip(one, (one[0], one[1], one[2]), strict=True):
        assert part is other
    with pytest.raises(IndexError):
        one[3]
    assert one.variance is one.covariance  # of images
    covariance = np.arange(18.0).reshape(2, 3, 3)
    motion = Estimate(np.zeros((2, 3)), covariance, np.ones(2, bool))
    np.testing.assert_array_equal(motion.variance, [[0, 4, 8], [9, 13, 17]])


def test_methods_show_their_names_and_suggest_one():
    shown = repr(jaxevent.METHODS)
    assert "\nblob: moment, chi2" in shown and all(name in shown for name in METHODS)
    with pytest.raises(KeyError, match=r"^there is no method 'afk'; did you mean 'akf'\?$"):
        jaxevent.METHODS["afk"]
    assert methods.find("last_frame") is jaxevent.METHODS["last-frame"]
    with pytest.raises(InputError, match="there is no method 3; known: akf"):
        jaxevent.METHODS[3]
    assert "afk" not in jaxevent.METHODS and jaxevent.METHODS.get("afk") is None


@pytest.mark.parametrize("name", ["mc", "events-only"])
def test_images_leave_no_cycles(name, recording):
    """Cycles would hold the memory of a recording until Python next looks for them."""
    images = jaxevent.METHODS[name].estimate(recording)
    images([recording.start + 20_000])
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        del images
        gc.collect()
        cycles = [type(one) for one in gc.garbage if type(one).__module__.startswith("jaxevent")]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not cycles
