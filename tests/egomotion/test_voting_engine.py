"""The particle filter's kernels, compiled by numba, against `run`, compiled by XLA."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from points import HEIGHT, WIDTH, moved, recorded, turning

from jaxevent.camera import PinholeCamera
from jaxevent.codegen.derivative import DerivativeDirections
from jaxevent.egomotion import voting
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine import CompiledFilter
from jaxevent.errors import InputError

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(100.0, 100.0, 59.5, 44.5)
SMALL = {"every": 2, "candidates": 40, "particles": 64, "batch": 32, "off": 0.0}
RUN = eqx.filter_jit(filtering.run)


def changing(model):
    """Two motions, one after the other, the second after events without order."""
    turn = np.array([0.5, 1.5, -1.2])
    if model == "planar":
        motions = lambda at: np.array([130.0, -70.0]), lambda at: np.array([-40.0, -250.0])
    else:
        motions = turning(turn), turning(-2 * turn)
    first, last = (moved(motion, 0.25, 60, seed=6, camera=CAMERA).events for motion in motions)
    rng, n = np.random.default_rng(1), 1500
    noise = np.sort(rng.integers(0, 50_000, n)), rng.integers(0, WIDTH, n)
    noise = *noise, rng.integers(0, HEIGHT, n), rng.random(n) < 0.5
    t = np.concatenate([first.t, noise[0] + 250_000, last.t + 300_000])
    rest = zip((first.x, first.y, first.p), noise[1:], (last.x, last.y, last.p), strict=True)
    return recorded(t, *map(np.concatenate, rest), camera=CAMERA)


def prepared(model, **settings):
    params = voting.Params.of({**SMALL, **settings})
    kind, sampler = voting.sampler(changing(model), params, model)
    c = sampler.sample_all(4e-3, 0.1).candidates
    noise = filtering.draw(jax.random.key(0), len(c.elapsed), params, kind)
    return params, kind, c, noise, filtering.init(params, kind, noise)


# Rotations differ from planar motion in the basis alone.
@pytest.mark.parametrize("model", ["planar", "general"])
def test_kernel_equals_run(model):
    """In searches, while motions are tracked, and where they are lost."""
    params, kind, c, noise, state = prepared(model)
    got = CompiledFilter(params, kind)(c, noise, state, 5)
    expected = RUN(params, kind, c, noise, state, 5)
    searching = np.asarray(expected[1].searching)
    if model != "general":
        assert (np.diff(searching.astype(int)) > 0).sum() > 0 < (~searching).sum()
    paths = jax.tree_util.tree_flatten_with_path(expected)[0]
    for (path, one), other in zip(paths, jax.tree.leaves(got), strict=True):
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(other, one, rtol=1e-7, atol=1e-8, err_msg=name)


def test_weights_between_nodes_are_within_the_bound():
    """For all particles of each batch of a filter that runs."""
    params, kind, c, noise, state = prepared("planar", off=0.03, noise=0.2)
    exact = eqx.tree_at(lambda p: p.raw["off"], params, jnp.asarray(-jnp.inf))
    by_nodes, by_all = CompiledFilter(params, kind), CompiledFilter(exact, kind)
    errors = []
    for b in range(len(c.elapsed)):
        one = jax.tree.map(lambda a, b=b: a[b : b + 1], c)
        drawn = filtering.RandomNumbers(
            noise.normal[b : b + 1], noise.uniform[b : b + 1], noise.cloud
        )
        used = by_nodes.n_interpolated
        expected, _ = by_all(one, drawn, state)
        state, _ = by_nodes(one, drawn, state)
        if by_nodes.n_interpolated > used:
            w, v = np.exp(state.log_weights), np.exp(expected.log_weights)
            errors.append(np.abs(w - v).max() / v.max())
    assert len(errors) > 40 and 1e-3 < max(errors) < 0.03


def test_kernel_finds_the_motion():
    truth = np.array([130.0, -70.0])
    recording = moved(lambda at: truth, 0.5, 120, seed=3)
    params = voting.Params.of({**SMALL, "batch": 64, "particles": 64, "off": 0.03})
    motion = voting.estimate(recording, params, compiler="numba")
    late = motion.t > motion.t[0] + 300_000
    assert motion.valid[late].all()
    assert np.linalg.norm(motion.mean[late] - truth, axis=1).mean() < 0.03 * np.hypot(*truth)
    again = voting.estimate(recording, params, compiler="numba")
    np.testing.assert_array_equal(motion.mean, again.mean)


def test_numba_without_a_kernel_is_refused():
    recording = moved(lambda at: np.array([130.0, -70.0]), 0.05, 120, seed=3)
    params = voting.Params.of({**SMALL, "likelihood": "literal"})
    with pytest.raises(InputError, match="no kernel.*literal"):
        voting.estimate(recording, params, compiler="numba")
    with pytest.raises(InputError, match="no compiler 'gcc'"):
        voting.estimate(recording, params, compiler="gcc")


def slopes_by_run(names, params, kind, c, noise, state):
    """Derivatives (numbers, batches, d) of the mean by raw values, forwards, compiled by XLA."""
    raw = {name: params.raw[name] for name in names}

    def means(raw):
        return filtering.run(params.with_raw(raw), kind, c, noise, state)[1].mean

    found = jax.jit(jax.jacfwd(means))(raw)
    return np.stack([np.asarray(found[name]) for name in names])


def slopes_by_kernel(names, params, kind, c, noise, state):
    """The same by a kernel, and its number of batches with nodes."""
    leaves = [id(leaf) for leaf in jax.tree.leaves(params)]
    numbers = tuple((leaves.index(id(params.raw[name])), 0) for name in names)
    kernel = CompiledFilter(params, kind, DerivativeDirections(numbers))
    out = kernel.run(c, noise, state).out
    slopes = out.mean_tangents.reshape(len(out.mean), len(names), -1)
    return np.moveaxis(slopes, 1, 0), out.mean, kernel.n_interpolated


@pytest.mark.parametrize("model", ["planar", "general"])
def test_slopes_of_the_kernel_are_those_of_run(model):
    """In searches, while motions are tracked, and where they are lost."""
    names = "sigma_x", "alpha", "noise" if model == "planar" else "noise_rotation"
    about = prepared(model)
    slopes, mean, _ = slopes_by_kernel(names, *about)
    expected = slopes_by_run(names, *about)
    np.testing.assert_allclose(mean, RUN(*about)[1].mean, rtol=1e-7, atol=1e-8)
    for name, got, one in zip(names, slopes, expected, strict=True):
        assert np.abs(one).max() > 0.01
        np.testing.assert_allclose(got, one, rtol=1e-6, atol=1e-6 * np.abs(one).max(), err_msg=name)


def test_slopes_between_nodes_are_those_of_all_particles():
    """Of batches on their own: the noise moves particles, and votes weights, within 3 %."""
    names = "sigma_x", "alpha", "noise"
    params, kind, c, noise, state = prepared("planar", off=0.03, noise=0.2)
    exact = eqx.tree_at(lambda p: p.raw["off"], params, jnp.asarray(-jnp.inf))
    pairs = []
    for b in range(0, len(c.elapsed), 2):
        one = jax.tree.map(lambda a, b=b: a[b : b + 1], c)
        drawn = filtering.RandomNumbers(
            noise.normal[b : b + 1], noise.uniform[b : b + 1], noise.cloud
        )
        slopes, _, used = slopes_by_kernel(names, params, kind, one, drawn, state)
        if used:
            pairs.append((slopes, slopes_by_kernel(names, exact, kind, one, drawn, state)[0]))
        state, _ = CompiledFilter(params, kind)(one, drawn, state)
    got, expected = (np.stack(side)[:, :, 0] for side in zip(*pairs, strict=True))
    assert len(got) > 20
    for k, name in enumerate(names):
        size = np.sqrt((expected[:, k] ** 2).mean())
        assert np.sqrt(((got[:, k] - expected[:, k]) ** 2).mean()) < 0.12 * size > 0, name
