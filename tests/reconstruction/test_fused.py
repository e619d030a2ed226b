"""Kernels, which numba compiles from filters' own functions, against loops over events."""

import dataclasses
import shutil
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import own_filter
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from jax.extend.core import jaxpr_as_fun
from noise import small
from test_own_filter import by_hand
from test_reconstruction import (
    OPTIONS,
    PARAMS,
    look,
    params_of,
    random_recording,
    recordings,
    times_of,
)

import jaxevent
from jaxevent import codegen
from jaxevent.codegen import functions
from jaxevent.codegen.derivative import DerivativeDirections
from jaxevent.codegen.graph import ParameterProgram, evaluate_jaxpr, evaluate_nodes
from jaxevent.methods import METHODS
from jaxevent.reconstruction.compensated.images import instant_smoother
from jaxevent.reconstruction.engine import bands, filter_program
from jaxevent.reconstruction.engine.images import FilterVideo, KernelImages, SmootherVideo
from jaxevent.reconstruction.video import Video
from jaxevent.recording import ColumnSource

pytestmark = pytest.mark.filterwarnings("ignore:random. holds no frames")

# Of the same choices, so that the functions are traced once; conditions on numbers choose the way.
DEAD = {**PARAMS, "rho_ref": 0.0008, "clock_offset": 0.0003, "event_delay": 0.0004}
ALL = {**OPTIONS, "clock_offset": -0.0021}


def check(name, recording, values, **options):
    """Images by a kernel in double precision are those of the loop over events."""
    method = jaxevent.METHODS[name]
    params = params_of(method, **{"weighting": "linear", **values})
    times = times_of(recording)
    video = method.estimate(recording, params, compiler="numba", **options)
    assert isinstance(video, SmootherVideo if name == "aks" else FilterVideo)
    image, variance = look(video, times)
    expected, P = oracles.reconstruct(name, recording, params.values(), times)
    # The oracle finds the moments of truncated Gaussians on a grid.
    close = 3e-5 if name == "aks" and params.one_sided else 1e-10
    np.testing.assert_allclose(image, expected, rtol=close, atol=close)
    np.testing.assert_allclose(variance, P, rtol=close)
    # Read again, from the start: windows are opened anew from their kept states.
    np.testing.assert_array_equal(look(video, times[2])[:, 0], [image[2], variance[2]])


@pytest.mark.slow
@examples(4)
@given(recording=recordings(fewest_frames=1), events=st.sampled_from([7, 1000]))
def test_kernel_of_edi_equals_loop_over_events(recording, events):
    check("edi", recording, ALL, window_events=events)


@pytest.mark.slow
@examples(6)
@given(
    recording=recordings(fewest_frames=1),
    values=st.sampled_from([PARAMS, DEAD, ALL]),
    events=st.sampled_from([7, 1000]),
)
def test_kernel_of_akf_equals_loop_over_events(recording, values, events):
    check("akf", recording, values, window_events=events)


@pytest.mark.slow
@examples(12)
@given(recording=recordings(fewest_frames=1), events=st.sampled_from([7, 1000]))
def test_kernel_of_cf_augmented_equals_loop_over_events(recording, events):
    check("cf-augmented", recording, ALL, window_events=events)


@pytest.mark.parametrize("name", ["cf", "high-pass", "augmented", "edi"])
def test_expressions_of_a_filter_are_its_functions(name):
    """Evaluated by NumPy, without compiling, for points of every piece."""
    method, random = jaxevent.METHODS[name], np.random.default_rng(0)
    params = params_of(method, **{"weighting": "linear", **ALL})
    fixed = {"frame_delay": np.asarray(0.0), "present": np.asarray(1.0)}
    known = DerivativeDirections().inputs(params, fixed | {"response": np.linspace(0, 1, 256)})
    kind = filter_program.KernelKind(False, np.dtype(float), 8208)
    trace = filter_program.trace_filter(method, known, kind)
    program = filter_program.translate_filter(trace, known, kind)
    results = {**program.state, "mean": program.mean, "variance": program.variance}
    for variant, table in zip(filter_program.variants(False), program.tables, strict=True):
        last = 1 if variant.is_first(False) else 2
        inputs = {n: random.uniform(0.1, 0.9, leaf.shape) for n, leaf in trace.inputs.items()}
        for field in filter_program.IMAGE_FIELDS:
            inputs[field][last:] = inputs[field][last]
        inputs["span"][:, last:], inputs["gain"][last + 1 :] = 0, 1
        whole = {**variant._asdict(), "polarity": 1, "rows": np.arange(3)}
        inputs |= {n: np.asarray(v, trace.inputs[n].dtype) for n, v in whole.items()}
        made = jaxpr_as_fun(trace.jaxpr)(*jax.tree.leaves(known), *inputs.values())
        true = dict(zip(trace.outputs, made, strict=True))

        def evaluate(nodes, table=table, inputs=inputs):
            def known(key):
                if isinstance(key, int):
                    return evaluate([table[key]])[0]
                name, _, number = key.rpartition(".")
                return np.ravel(inputs[name])[int(number)]

            return evaluate_nodes(nodes, known, program.host.values, kind.dtype)

        found = evaluate([*results.values()])
        for number, value in zip(results, found, strict=True):
            np.testing.assert_allclose(value, true[number.removesuffix(".0")], rtol=1e-12)


@pytest.mark.slow
@examples(9)
@given(
    recording=recordings(fewest_frames=1),
    values=st.sampled_from([PARAMS, {**DEAD, "spread": 0.02}, ALL]),
    events=st.sampled_from([7, 1000]),
)
def test_kernel_of_the_smoother_equals_loop_over_events(recording, values, events):
    check("aks", recording, values, window_events=events)


@pytest.mark.slow
def test_smoothers_of_one_kernel_equal_the_scan(monkeypatch):
    """Of all instants that `mc` asks for, and whatever the bands and cores."""
    recording = random_recording(7, 900, 9, size=(11, 9), hot=90)
    clear = np.random.default_rng(0).integers(20, 235, recording.frames.images.shape)
    part = recording.frames.images.astype(np.uint8)
    part[:, 2:7] = clear[:, 2:7]  # the others are clipped here and there
    recording = dataclasses.replace(
        recording, frames=dataclasses.replace(recording.frames, images=part)
    )
    params = jaxevent.mc.Params(margin=30.0, spread=0.03)
    times = np.sort(np.concatenate([times_of(recording), recording.frames.t]))
    factors = np.random.default_rng(1).uniform(0.5, 2.0, (2, 99))

    def images(compiler):
        video = instant_smoother.estimate(
            recording, params, compiler=compiler, window_events=200, factors=factors
        )
        return video(times, extrapolate=True)

    mean, variance, shown = images("numba")
    scan = images("xla")
    np.testing.assert_allclose(mean, scan.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(variance, scan.covariance, rtol=1e-9)
    np.testing.assert_array_equal(shown, scan.valid)
    assert 0.02 < shown.mean() < 0.9
    monkeypatch.setattr(codegen, "N_THREADS", 1)
    np.testing.assert_array_equal(images("numba").mean, mean)
    # Bands of three rows each.
    monkeypatch.setattr(bands, "BAND_STRIDES", (5 * 13,))
    np.testing.assert_allclose(images("numba").mean, mean, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@examples(3)
@given(recording=recordings())
def test_kernel_without_frames(recording):
    recording = dataclasses.replace(recording, frames=None)
    if len(recording.events):
        check("akf", recording, PARAMS, window_events=7)


@pytest.mark.slow
def test_kernel_of_a_users_own_filter():
    """A state of three numbers, one of them whole; nothing is written twice."""
    recording, params = small(), own_filter.Params(gain=0.3, alpha=20.0)
    times = np.array([9_000, 30_000, 52_000])
    video = own_filter.trend.estimate(recording, params, compiler="numba", window_events=90)
    image, variance, valid = video(times)
    np.testing.assert_allclose(image, by_hand(recording, params, times), rtol=1e-10)
    scan = own_filter.trend.estimate(recording, params, compiler="xla")(times)
    np.testing.assert_allclose(variance, scan.covariance, rtol=1e-12)
    assert valid.all()


@pytest.mark.slow
def test_bands_and_cores_do_not_change_a_bit(monkeypatch):
    recording = random_recording(7, 900, 5, size=(11, 9), exposure=0)
    times, params = times_of(recording), params_of(jaxevent.high_pass, **PARAMS)

    def images():
        return look(jaxevent.high_pass.estimate(recording, params, compiler="numba"), times)

    whole = images()
    # Bands of three rows each: the events of two of them are neighbours of other bands.
    monkeypatch.setattr(bands, "BAND_STRIDES", (5 * 13,))
    layout = bands.BandLayout.of(11, 9)
    assert layout is not None and len(layout.edges) == 4
    np.testing.assert_array_equal(images(), whole)
    monkeypatch.setattr(codegen, "N_THREADS", 1)
    np.testing.assert_array_equal(images(), whole)


@pytest.mark.slow
def test_stored_events_are_checked_while_they_are_divided(tmp_path):
    recording = random_recording(7, 900, 5, size=(11, 9), exposure=0)
    times, params = times_of(recording), params_of(jaxevent.high_pass, **PARAMS)
    path = tmp_path / "stored.h5"
    jaxevent.save(recording, path)

    def images(given):
        options: dict = {"compiler": "numba", "window_events": 90}
        return look(jaxevent.high_pass.estimate(given, params, **options), times)

    stored = jaxevent.load(path, in_memory=False)
    np.testing.assert_array_equal(images(stored), images(recording))
    assert isinstance(stored.events, ColumnSource)
    for name, value in {"t": 0, "x": 11, "y": 9, "p": 2}.items():
        wrong = shutil.copy(path, tmp_path / f"{name}.h5")
        with h5py.File(wrong, "r+") as file:
            column: Any = file[f"events/{name}"]
            column[500] = value
        with pytest.raises(jaxevent.InputError, match="500"):
            images(jaxevent.load(wrong, in_memory=False))


@pytest.mark.slow
def test_images_that_are_held_are_not_written_over(monkeypatch):
    monkeypatch.setattr(bands, "MAX_PASS_PIXELS", 2 * 11 * 9)  # two images at once
    recording = random_recording(7, 900, 5, size=(11, 9), exposure=0)
    times = np.linspace(recording.start, recording.stop, 9).astype(np.int64)
    params = params_of(jaxevent.high_pass, **PARAMS)
    video = jaxevent.high_pass.estimate(recording, params, compiler="numba")
    parts = [(estimate.mean[1:], estimate) for _, estimate in video.batches(times)]
    assert len(parts) > 3
    held = np.concatenate([estimate.mean for _, estimate in parts])
    np.testing.assert_array_equal(held, video(times).mean)
    arrays = video._buffers.take(2).mean.base  # used again once nobody has them
    assert video._buffers.take(1).mean.base is not arrays
    address = arrays.ctypes.data
    del arrays
    assert video._buffers.take(1).mean.ctypes.data == address


@pytest.mark.slow
def test_float_frames_are_those_of_their_levels():
    recording = random_recording(8, 90, 4)
    frames = recording.frames
    floats = dataclasses.replace(frames, images=np.asarray(frames.images) / 255.0)
    times, params = times_of(recording), jaxevent.edi.Params(exposure=0.004)
    one, two = (
        look(jaxevent.edi.estimate(r, params, compiler="numba"), times)
        for r in (recording, dataclasses.replace(recording, frames=floats))
    )
    np.testing.assert_allclose(one[0], two[0], rtol=1e-12)


@pytest.mark.slow
def test_which_compiler_serves(float32):
    recording, blend = small(), jaxevent.blend
    assert isinstance(blend.estimate(recording), FilterVideo)
    assert type(blend.estimate(recording, compiler="xla")) is Video
    with jax.enable_x64(True):
        assert type(blend.estimate(recording)) is Video
    # Where a function has no translation the scan serves.
    for predict, reason in (
        (lambda p, s, dt, f: dataclasses.replace(s, L=jnp.sinh(f.level)), "'sinh'"),
        (lambda p, s, dt, f: 1 / 0, "fail for one pixel"),
    ):
        odd = dataclasses.replace(jaxevent.cf, predict=predict)
        assert type(odd.estimate(recording)) is Video
        with pytest.raises(jaxevent.InputError, match=reason):
            odd.estimate(recording, compiler="numba")
    with pytest.raises(jaxevent.InputError, match="numba or xla"):
        blend.estimate(recording, compiler="gcc")


def test_functions_of_single_precision():
    x = np.concatenate([np.linspace(-87, 88, 3001), [0, 1e-30, 1e-7, -1e-7]]).astype(np.float32)
    exact = np.exp(x.astype(float))
    assert max(abs(functions.exp32(v) / e - 1) for v, e in zip(x, exact, strict=True)) < 2e-7
    positive = np.geomspace(1e-37, 1e38, 3001).astype(np.float32)
    for v, e in zip(positive, np.log(positive.astype(float)), strict=True):
        assert abs(functions.log32(v) - e) <= 2e-7 * max(abs(e), 1e-3)
    for v in np.array([-0.9, -1e-3, -1e-9, 0, 1e-9, 1e-4, 0.3, 7, 1e9], np.float32):
        assert functions.log1p32(v) == pytest.approx(np.log1p(float(v)), rel=3e-7)
        assert functions.logistic32(v) == pytest.approx(1 / (1 + np.exp(-float(v))), rel=3e-7)
    inf, nan = np.float32(np.inf), np.float32(np.nan)
    assert (
        functions.exp32(inf) == inf
        and functions.exp32(-inf) == 0
        and np.isnan(functions.exp32(nan))
    )
    assert functions.log32(np.float32(0)) == -inf and functions.log32(inf) == inf
    assert np.isnan(functions.log32(np.float32(-1))) and np.isnan(functions.log32(nan))


def test_numbers_of_parameters_are_found_without_compiling():
    """NumPy gives what JAX gives: interpolation, a table, a sum, choices."""

    def numbers(a, b):
        table = jnp.linspace(0, 1, 8) ** 2
        place = jnp.interp(a, jnp.arange(8), table)
        return place, jnp.where(b > 0, jnp.log1p(b), b), table[1:3] @ jnp.stack([a, b]), table[::-1]

    closed = jax.make_jaxpr(numbers)(2.3, -0.4)
    for given_numbers in ((2.3, -0.4), (9.0, 0.7)):
        made = evaluate_jaxpr(closed, [np.asarray(v) for v in given_numbers])
        for one, other in zip(made, numbers(*given_numbers), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)

    def places(x, i):
        return x[i], x[:, i], x[i, :, i], jnp.take(x, i, axis=2), x[1:3, i[0], 2:4]

    x, i = np.random.default_rng(0).random((4, 5, 6)), np.array([[0, 3], [1, 1], [-1, 2]])
    for one, other in zip(
        evaluate_jaxpr(jax.make_jaxpr(places)(x, i), [x, i]), places(x, jnp.asarray(i)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    program = ParameterProgram()
    first = program.add_input(np.asarray(2.0))
    greater = jax.make_jaxpr(lambda x: x > 1)(2.0).eqns[0]
    program.conditions += program.add(greater, [first, np.asarray(1.0)])
    assert program.evaluate([np.asarray(3.0)]) is not None
    assert program.evaluate([np.asarray(0.5)]) is None


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("akf", {}), ("aks", ALL)])
def test_derivatives_by_kernels_are_those_of_the_scan(name, options):
    """Of loss and gradient in reverse, and along a direction, of means and variances."""
    values = {**PARAMS, **options}
    recording, method = random_recording(7, 300, 5, size=(4, 3), exposure=700), METHODS[name]
    params = params_of(method, **values)
    times = np.unique(np.clip(times_of(recording), recording.start, recording.stop))
    still = {*params.names_without_gradient(), "ratio_min", "ratio_max"}
    raw = {n: leaf for n, leaf in params.raw.items() if n not in still}
    truth = np.random.default_rng(0).random((len(times), 12))

    def loss(raw, images):
        mean, variance, _ = images(params.with_raw(raw))
        variance = jnp.where(jnp.isfinite(variance), variance, 0)
        return ((mean - truth) ** 2).mean() + (jnp.sin(3 * mean) * variance).mean()

    found = []
    for compiler in ("numba", "xla"):
        images = method.prepare_images(recording, times, params, compiler=compiler)
        assert isinstance(images, KernelImages) == (compiler == "numba")
        value, slope = jax.jit(jax.value_and_grad(loss))(raw, images)
        ones = jax.tree.map(jnp.ones_like, raw)
        along = jax.jit(lambda r, t, i: jax.jvp(lambda v: loss(v, i), (r,), (t,)))(
            raw, ones, images
        )
        found.append((value, slope, along))
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-13)


@pytest.mark.slow
def test_images_prepared_for_losses():
    """Some of them, mapped over parameters, by a program that serves another recording too."""
    first, second = small(), random_recording(3, 80, 3, size=(24, 20))
    times, compiled = np.array([9_000, 30_000, 52_000]), []
    method, start = jaxevent.blend, jaxevent.blend.Params()

    @jax.jit
    def means(I0, images):
        compiled.append(I0)
        return jax.vmap(lambda v: images(start.with_raw({"I0": v})).mean)(I0)

    for recording in (first, second):
        images = method.prepare_images(recording, times, compiler="numba").take(np.array([2, 0, 2]))
        made = means(jnp.log(jnp.array([0.3, 1.0])), images)
        for I0, some in zip((0.3, 1.0), made, strict=True):
            video = method.estimate(recording, method.Params(I0=I0), compiler="numba")
            expected = video(times[[2, 0, 2]]).mean.reshape(3, -1)
            np.testing.assert_allclose(some, expected, rtol=1e-12)
    assert len(compiled) == 1
