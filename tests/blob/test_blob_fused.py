"""Trackers' kernels, which numba compiles, against `run`, which XLA compiles."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent import blob
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filter import association_weights
from jaxevent.blob.lifecycle import init_state
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.run import ChunkInfo, run_compiled
from jaxevent.blob.track import readout
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

WIDTH, HEIGHT = 96, 64


def crossing(rng, events=2400, seconds=0.03):
    """Two blobs that meet, a third that appears, and stray events."""
    t = np.sort(rng.integers(0, round(seconds * 1e6), events))
    kind = rng.integers(0, 4, events)
    kind[(kind == 2) & (t < 8000)] = 3
    s = t * 1e-6
    centre = np.stack(
        [
            np.select([kind == 0, kind == 1, kind == 2], [25 + 1500 * s, 70 - 1500 * s, 48.0], 0),
            np.select([kind == 0, kind == 1, kind == 2], [22 + 100 * s, 24 + 0 * s, 52.0], 0),
        ],
        1,
    )
    xi = centre + rng.normal(0, (2.5, 1.5), (events, 2))
    stray = rng.uniform(0, (WIDTH - 1, HEIGHT - 1), (events, 2))
    xi = np.where((kind == 3)[:, None], stray, xi)
    x, y = np.rint(xi).clip(0, (WIDTH - 1, HEIGHT - 1)).T.astype(np.uint16)
    made = Events(t.astype(np.int64), x, y, rng.random(events) < 0.5)
    return Recording("crossing", WIDTH, HEIGHT, made)


CASES = {
    "moment": {
        "events_per_step": 5, "tau_q": 0.01, "t_still": 1e-3, "clutter": 1e-3,
        "polarity_offset": True,
    },
    "moving_moments": {"events_per_step": 6, "association": "nearest", "gate_shape": "circle"},
}  # fmt: skip


FEW = {"n_birth": 8.0, "n_confirm": 20.0, "lambda0": 4.0, "gate_min": 4.0, "t_coast": 0.004}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_kernel_equals_run(case):
    """States, births and deaths of seeds, of targets that are born and of those that end."""
    values = CASES[case]
    tracker = getattr(blob, case)
    params = tracker.Params(**FEW, **values, max_targets=3)
    seeds = [(25.0, 22.0, 4.0), (70.0, 24.0, 4.0, 0.001)]
    rec = crossing(np.random.default_rng(7))
    packer = ChunkPacker(rec, params, seeds, detect=True, steps=16, chunks=40)
    state, cursor, kernel = None, packer.first, KernelRunner(tracker.filter, params, detect=True)
    number, init = 0, jax.jit(init_state, static_argnums=0)  # one program in place of forty
    while cursor is not None:
        segment = packer.pack(cursor)
        cursor, number = segment.next, number + 1
        if state is None:
            state = init(tracker.filter, params, segment.features)
        end, log = kernel.run(state, segment.features)
        got = end, ChunkInfo(log, kernel.chunk_starts(kernel.record(state, segment.features)[1]))
        before = state
        state, result = run_compiled(tracker.filter, params, state, segment.features)
        expected = state, dataclasses.replace(result, association=None)
        paths = jax.tree_util.tree_flatten_with_path(expected)[0]
        for (path, one), other in zip(paths, jax.tree.leaves(got), strict=True):
            name = f"{jax.tree_util.keystr(path)} of segment {number}"
            assert other.dtype == one.dtype, name
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9, err_msg=name)
    # Of the last segment also the readout, filtered, as the first chunk with a pause begins.
    _, updates = kernel.record(before, segment.features)
    ends = np.asarray(segment.features.t)[:, 0, -1]  # of the chunks' first steps
    chunk = int(np.flatnonzero((ends > 1) & (np.asarray(result.tracks.id) >= 0).any(1))[0])
    tracks = jax.tree.map(lambda a: np.asarray(a)[chunk], result.tracks)
    read = jax.jit(jax.vmap(functools.partial(readout, tracker.filter, params), (0, None)))
    wanted, id = np.asarray(tracks.id)[None] >= 0, np.asarray(tracks.id, np.int64)
    times = segment.start[[chunk]] + ends[chunk] - 1
    got = kernel.readout(segment, updates, None, times, id, wanted)
    for one, other in zip(got, read(tracks, ends[chunk] - 1), strict=True):
        np.testing.assert_allclose(one[wanted], other[wanted[0]], rtol=1e-9, atol=1e-9)
    log = np.asarray(result.log.end_reason)
    assert log.shape == (40, 5) and (np.asarray(state.next_id) > 2)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_losses_and_their_slopes(case):
    """Losses equal those of `run`; slopes along every number are those of finite differences."""
    tracker = getattr(blob, case)
    params = tracker.Params(**FEW, **CASES[case], max_targets=3)
    rec, seeds = crossing(np.random.default_rng(7)), [(25.0, 22.0, 4.0), (70.0, 24.0, 4.0, 0.001)]
    times = np.arange(1000, 29000, 501)
    truth = np.full((len(times), 2, 2), 30.0)
    batch = blob.prepare_positions(rec, params, seeds, times, truth)
    features, _ = tracker.prepare(rec, np.empty(0), params, seeds=seeds, detect=True)

    def losses(raw, compiler="numba"):
        moved = params.with_raw(raw)
        return jnp.stack(
            [
                *(
                    blob.negative_log_likelihood(tracker, moved, features, events, compiler)
                    for events in ("associated", "all")
                ),
                blob.position_error(tracker, moved, batch, compiler=compiler),
            ]
        )

    stuck = params.names_without_gradient()
    raw = {n: leaf for n, leaf in params.raw.items() if n not in stuck and np.isfinite(leaf)}
    forwards = jax.jit(jax.jacfwd(losses))(raw)
    backwards = jax.jit(jax.jacrev(losses))(raw)
    value, h = jax.jit(losses), 1e-5
    np.testing.assert_allclose(
        value(raw), jax.jit(functools.partial(losses, compiler="xla"))(raw), rtol=1e-9
    )
    for name in raw:
        ends = [value({**raw, name: raw[name] + step}) for step in (h, -h)]
        slope = np.asarray(ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(forwards[name], slope, rtol=1e-5, atol=1e-7, err_msg=name)
        np.testing.assert_allclose(backwards[name], slope, rtol=1e-5, atol=1e-7, err_msg=name)
    with pytest.raises(InputError, match="first derivatives only"):
        jax.hessian(lambda raw: losses(raw)[0])({"Q_v": raw["Q_v"]})


@pytest.mark.slow
def test_tracks_of_both_compilers():
    """Smoothed states, with pauses in which targets stand still, and whose the events are."""
    rec, seeds = crossing(np.random.default_rng(7)), [(25.0, 22.0, 4.0), (70.0, 24.0, 4.0, 0.001)]
    tracker = blob.constant_velocity
    params = tracker.Params(**FEW, events_per_step=1, t_still=1e-3, max_targets=3)
    fused, scanned = (
        tracker.estimate(rec, params, seeds=seeds, detect=True, compiler=compiler, progress=False)
        for compiler in ("numba", "xla")
    )
    np.testing.assert_array_equal([fused.birth, fused.death], [scanned.birth, scanned.death])
    times = np.arange(rec.start, rec.stop, 173)
    result = fused(times)
    assert result.valid.any(0).all() and not result.valid.all()
    for one, other in zip(result, scanned(times), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)
    for one, other in zip(fused.events(), scanned.events(), strict=True):
        for x, y in zip(one, other, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-9)

    # Numbers that do not depend on each other may as well be taken together.
    fused._runner._readout_kernel = fused._runner._readout_kernel._replace(blocks=np.array([0, 8]))
    del fused._segment_infos
    fused._kept_infos.clear()
    np.testing.assert_allclose(fused(times).mean, result.mean, rtol=1e-9, atol=1e-9)


def test_a_filter_without_kernel_is_scanned():
    def strange(params, held, density):
        return association_weights(params, held, jnp.sort(density))

    mine = dataclasses.replace(
        blob.moment,
        name="strange",
        filter=dataclasses.replace(blob.moment.filter, association_weights=strange),
    )
    rec = crossing(np.random.default_rng(2), 50)
    with pytest.raises(InputError, match="no kernel"):
        mine.estimate(rec, mine.Params(), seeds=[(25.0, 22.0, 4.0)], compiler="numba")
    with pytest.raises(InputError, match="no compiler"):
        mine.estimate(rec, mine.Params(), compiler="gcc")
