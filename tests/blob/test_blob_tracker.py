"""The tracker against a plain loop over events, its invariances, and its life cycle."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent import blob
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filter import EventBatch
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.track import canonical_ellipse
from jaxevent.blob.tracks import Tracks
from jaxevent.errors import InputError, InputWarning
from jaxevent.recording import Events, Recording

WIDTH, HEIGHT = 240, 180


def Params(**values):  # noqa: N802
    return blob.moment.Params(**values)


def recording(t, xy, width=WIDTH, height=HEIGHT, name="blobs"):
    """Events of unsorted times (s or us) and positions, those outside the sensor left out."""
    t, xy = np.asarray(t), np.rint(np.reshape(xy, (-1, 2)))
    us = t if t.dtype.kind == "i" else np.rint(t * 1e6)
    keep = ((xy >= 0) & (xy < (width, height))).all(1)
    order = np.argsort(us[keep], kind="stable")
    us, xy = us[keep][order].astype(np.int64), xy[keep][order].astype(np.uint16)
    return Recording(name, width, height, Events(us, xy[:, 0], xy[:, 1], us % 2 == 0))


def cloud(rng, path, size, rate, span, gap=(0.0, 0.0)):
    """Times (s) and positions of a Gaussian blob's events; none during `gap`."""
    t = np.sort(rng.uniform(*span, rng.poisson(rate * (span[1] - span[0]))))
    t = t[(t < gap[0]) | (t >= gap[1])]
    return t, path(t) + rng.normal(size=(len(t), 2)) * size


def line(x, y, vx=0.0, vy=0.0):
    return lambda t: np.stack([x + vx * t, y + vy * t], -1)


def noise(rng, rate, seconds, width=WIDTH, height=HEIGHT):
    t = rng.uniform(0, seconds, rng.poisson(rate * seconds))
    return t, rng.uniform(-0.5, (width - 0.5, height - 0.5), (len(t), 2))


def together(*clouds, **sensor):
    return recording(*(np.concatenate(part) for part in zip(*clouds, strict=True)), **sensor)


@pytest.fixture(scope="module")
def pair():
    """Two blobs that pass each other closely, with stray events: (recording, seeds)."""
    rng = np.random.default_rng(1)
    rec = together(
        cloud(rng, line(60, 80, 900), (5, 3), 3000, (0, 0.12)),
        cloud(rng, line(168, 92, -900), (3, 3), 3000, (0, 0.12)),
        noise(rng, 1000, 0.12),
    )
    return rec, [(60.0, 80.0, 8.0), (168.0, 92.0, 8.0)]


def follow(rec, params=None, seeds=None, detect=False, steps=64, chunks=32, tracker=blob.moment):
    """`estimate` with chunks of a size that suits short recordings."""
    params = params or Params()
    packer = ChunkPacker(
        rec, params, seeds, detect=detect or seeds is None, steps=steps, chunks=chunks
    )
    return Tracks(KernelRunner(tracker.filter, params, detect=packer.detect), packer)


@functools.cache
def _steps_of(f):
    return tuple(
        jax.jit(one) for one in (f.init, f.predict, f.predicted_measurement, f.update, f.readout)
    )


def oracle(rec, params, seeds, tracker=blob.moment):
    """Plain loops over steps, events and targets.

    Returns each event's target and weight, the mean negative log-likelihood of events inside a
    gate, and a function that gives mean and covariance of the targets at a time.
    """
    start, predict, expected, update, moments = _steps_of(tracker.filter)
    e, first, M = rec.events, rec.start, params.events_per_step
    b, alpha, g = float(params.gate), float(params.gate_decay), float(params.gate_position)
    low, high = float(params.gate_min), float(params.gate_max)
    targets = [
        (start(params, jnp.array([x, y]), jnp.asarray(size)), min(max(b * size, low), high), first)
        for x, y, size in seeds
    ]
    paths = [[(first, state)] for state, *_ in targets]
    target_of, loss, rows = [], [], list(range(len(e)))
    while rows:
        cycle = (e.t[rows[0]] - first) // 10_000
        step = [r for r in rows[:M] if (e.t[r] - first) // 10_000 == cycle]
        rows = rows[len(step) :]
        time = int(e.t[step[-1]])
        ages = [(time - int(e.t[r])) * 1e-6 for r in step]
        near, predictions = [[] for _ in step], []
        for k, (state, gate, last) in enumerate(targets):
            dt = (time - last) * 1e-6
            state = predict(params, state, jnp.asarray(dt))
            result = expected(params, state)
            size = float(result.size.max())
            a = math.exp(-alpha * dt)
            radius = min(max(a * gate + (1 - a) * b * size, low), high)
            predictions.append((state, radius))
            p, v, P, L2 = map(np.asarray, (result.p, result.v, result.P_p, result.spread))
            for place, r in enumerate(step):
                d = np.array([e.x[r], e.y[r]], float) - (p - ages[place] * v)
                if params.gate_shape == "circle":
                    inside = d @ d <= radius**2 + g**2 * np.linalg.eigvalsh(P)[-1]
                else:
                    inside = d @ np.linalg.solve((radius / size) ** 2 * L2 + g**2 * P, d) <= 1
                if inside:
                    S = L2 + P
                    density = math.exp(-d @ np.linalg.solve(S, d) / 2) / (2 * math.pi)
                    near[place].append((density / math.sqrt(np.linalg.det(S)), k))
        weights = np.zeros((len(targets), M))
        for place, found in enumerate(near):
            loss += [-math.log(sum(n for n, _ in found))] if found else []
            for density, k in found:
                total = sum(n for n, _ in found) + float(params.clutter)
                weights[k, place] = density / total
                if params.association == "nearest":
                    weights[k, place] = (density, k) == max(found)
            best = int(np.argmax(weights[:, place]))
            target_of.append((best if found else -1, weights[best, place]))
        fill = M - len(step)
        batch = EventBatch(
            jnp.array([(e.x[r], e.y[r]) for r in step + step[-1:] * fill], float),
            jnp.array(ages + [0.0] * fill),
            jnp.array([1.0 if e.p[r] else -1.0 for r in step + step[-1:] * fill]),
        )
        for k, (state, radius) in enumerate(predictions):
            if weights[k].any():
                targets[k] = (update(params, state, batch, jnp.array(weights[k])), radius, time)
                paths[k].append((time, targets[k][0]))

    def at(time):
        rows = []
        for path in paths:
            t, state = [one for one in path if one[0] <= time][-1]
            state = predict(params, state, jnp.asarray((time - t) * 1e-6))
            rows.append(canonical_ellipse(*moments(params, state)))
        return [np.stack(part) for part in zip(*rows, strict=True)]

    return (
        np.array([k for k, _ in target_of]),
        np.array([w for _, w in target_of]),
        np.mean(loss),
        at,
    )


NEAREST = {"association": "nearest", "gate_shape": "circle", "events_per_step": 4}


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting", [NEAREST, {"clutter": 1e-3, "gate_min": 2.0, "gate_decay": 20.0}]
)
def test_equals_a_plain_loop(pair, setting):
    rec = pair[0][0.03:0.09]  # they pass at 60 ms
    seeds = [(*line(60, 80, 900)(0.03), 8.0), (*line(168, 92, -900)(0.03), 8.0)]
    params = Params(**setting)
    ids, weights, _, at = oracle(rec, params, seeds)
    assert (ids == -1).sum() > 20
    tracks = follow(rec, params, seeds)
    result = list(tracks.events())
    assert np.array_equal(np.concatenate([e.id for e in result]), ids)
    np.testing.assert_allclose(np.concatenate([e.weight for e in result]), weights, atol=1e-9)
    assert np.array_equal(np.concatenate([e.row for e in result]), np.arange(len(rec.events)))
    part = np.concatenate([e.row for e in tracks.events(0.05, 0.052)])
    assert np.array_equal(part, np.arange(*map(rec.events.index, (50_000, 52_000))))
    times = np.array([rec.start, rec.start + 3001, 61_234, int(rec.events.t[200]), rec.stop])
    states = tracks(times)
    assert states.valid.all()
    for i, time in enumerate(times):
        mean, covariance = at(time)
        np.testing.assert_allclose(states.mean[i], mean, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(states.covariance[i], covariance, rtol=1e-7, atol=1e-9)


def parts(states):
    return states.mean, states.covariance, states.valid, states.idle


def same(a, b, exact=True):
    compare = np.testing.assert_array_equal
    if not exact:
        compare = functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
    for one, other in zip(a, b, strict=True):
        compare(one, other)


@pytest.mark.slow
def test_chunks_and_windows_do_not_matter(pair):
    rec, seeds = pair
    seeds = [seeds[0], (*line(168, 92, -900)(0.0312345), 8.0, 0.0312345)]
    times = np.arange(0, 125_000, 777)
    params = Params(**NEAREST)
    whole = follow(rec, params, seeds)
    assert whole.birth[1] == 31_234 and not whole(31_233).valid[0, 1]
    expected = parts(whole(times, extrapolate=True))
    other = follow(rec, params, seeds, steps=3, chunks=5)
    # Not to the last bit: compilers round one size of a loop's arrays otherwise than another.
    same(parts(other(times, extrapolate=True)), expected, exact=False)
    same(parts(other(times[::-1], extrapolate=True)), [v[::-1] for v in expected], exact=False)
    assert np.array_equal(other.death, whole.death) and len(other._checkpoints) > 10


@pytest.mark.slow
def test_shift_in_time_and_order_of_seeds(pair):
    rec, seeds = pair
    e = rec.events
    later = Recording("later", WIDTH, HEIGHT, Events(e.t + 10**9 + 1, e.x, e.y, e.p))
    times = np.arange(0, 120_000, 5003) + rec.start
    first = follow(rec, seeds=seeds)
    same(parts(follow(later, seeds=seeds)(times + 10**9 + 1)), parts(first(times)))
    turned = follow(rec, seeds=seeds[::-1])
    same([v[:, ::-1] for v in parts(turned(times))], parts(first(times)), exact=False)
    same([v[:, 0] for v in parts(turned(times, [1]))], [v[:, 1] for v in parts(turned(times))])


@pytest.fixture(scope="module")
def eight():
    """Eight moving blobs of 30,000 events/s and five times as much noise as one of them."""
    rng = np.random.default_rng(2)
    places = [(30 + 60 * i, 45 + 90 * j) for i in range(4) for j in range(2)]
    speeds = rng.uniform(-200, 200, (8, 2))
    paths = [line(*p, *v) for p, v in zip(places, speeds, strict=True)]
    clouds = [cloud(rng, path, (5, 3), 30_000, (0, 0.03)) for path in paths]
    return together(*clouds, noise(rng, 150_000, 0.03)), paths


@pytest.mark.slow
def test_births(eight):
    rec, paths = eight
    params, seeds = Params(lambda0=8.0), [(5, 5, 3, 29_990), (230, 5, 3, 29_990)]
    tracks = follow(rec, params, seeds, detect=True)
    assert len(tracks) == 2 + 8 and (tracks.birth[:2] == 29_990).all()
    assert tracks.confirmed[2:].max() < 10_000 and (tracks.birth < tracks.confirmed)[2:].all()
    states = tracks(29_000, tracks.id[2:])
    assert states.valid.all()
    truth = np.stack([path(0.029) for path in paths])
    d = np.linalg.norm(states.mean[0, :, None, :2] - truth, axis=-1)
    assert sorted(np.argmin(d, axis=1)) == list(range(8)) and d.min(1).max() < 2.5


@pytest.mark.slow
def test_life_cycle():
    """A blob leaves the image, another pauses too long and comes back, two seeds share a third."""
    rng = np.random.default_rng(3)
    rec = together(
        cloud(rng, line(200, 40, 1500), (4, 4), 30_000, (0, 0.08)),
        cloud(rng, line(60, 40), (4, 4), 30_000, (0, 0.08), (0.02, 0.05)),
        cloud(rng, line(60, 140), (4, 4), 30_000, (0, 0.08)),
    )
    params = Params(t_coast=0.02, t_merge=0.03, lambda0=8.0)
    tracks = follow(rec, params, [(60, 140, 8), (63, 140, 8)], detect=True)
    assert tracks.ended[1] == "merged" and tracks.ended[0] == "end"
    assert 30_000 <= tracks.death[1] - tracks.start < 45_000
    left = tracks.ended.index("left")
    assert 22_000 < tracks.death[left] < 32_000
    idle = tracks.ended.index("idle")
    last = rec.events.t[(rec.events.x < 100) & (rec.events.y < 90) & (rec.events.t < 20_000)][-1]
    assert tracks.death[idle] == last + 20_000
    again = tracks(79_000).mean[0, :, :2] - (60, 40)
    again = np.flatnonzero(np.linalg.norm(again, axis=1) < 3)
    assert len(again) == 1 and again[0] > max(idle, left) and tracks.birth[again[0]] > 50_000
    assert len(set(tracks.id)) == len(tracks) == 5
    states = tracks([int(tracks.death[idle]) - 1, int(tracks.death[idle])])
    assert states.valid[:, idle].tolist() == [True, False]
    assert states.idle[0, idle] == pytest.approx(0.02, abs=2e-6)
    assert np.isnan(states.mean[1, idle]).all()


@pytest.mark.slow
def test_pause_and_crossing():
    """100 ms without events at 600 px/s, and a head-on crossing at 1200 px/s."""
    rng = np.random.default_rng(4)
    path = line(20, 90, 600)
    rec = recording(*cloud(rng, path, (5, 4), 50_000, (0, 0.3), (0.1, 0.2)))
    tracks = follow(rec, Params(t_coast=0.2), [(20, 90, 10), (20, 20, 5)])
    states = tracks([0.09, 0.2, 0.29])
    assert np.linalg.norm(states.mean[2, 0, :2] - path(0.29)) < 2
    assert states.covariance[1, 0, 0, 0] > 20 * states.covariance[0, 0, 0, 0]
    paths = line(60, 90, 600), line(180, 90, -600)
    rec = together(*(cloud(rng, p, (6, 4), 50_000, (0, 0.19)) for p in paths))
    tracks = follow(rec, Params(t_coast=0.2), [(60, 90, 10), (180, 90, 10)])
    ends = tracks(0.18).mean[0, :, :2]
    assert np.linalg.norm(ends - [p(0.18) for p in paths], axis=1).max() < 3


@pytest.mark.slow
def test_strange_streams():
    at = np.full(500, 7, np.int64)
    rng = np.random.default_rng(5)
    streams = {
        "one": ([5], [(3, 3)]),
        "two": ([5, 5], [(3, 3), (100, 100)]),
        "instant": (at, np.full((500, 2), 60.0)),
        "hammer": (np.arange(2000) * 40, np.full((2000, 2), 60.0)),
        "silence": (np.r_[np.arange(500), 10**7 + np.arange(500)], rng.uniform(50, 70, (1000, 2))),
        "hour": ([0, 1, 4 * 10**9, 4 * 10**9 + 1], np.full((4, 2), 60.0)),
    }
    seeds = [(60, 60, 10), (65, 60, 5)]
    short = {"n_birth": 5.0, "n_confirm": 8.0, "t_coast": 1e-3}
    for name, (t, xy) in streams.items():
        rec = recording(np.array(t), xy, name=name)
        for tracks in (
            follow(rec, Params(**short), seeds, detect=True),
            follow(rec, Params(t_coast=1e6, sigma_max=1e14), seeds),
        ):
            states = tracks(np.r_[rec.start, rec.stop, rec.stop // 2], extrapolate=True)
            assert np.isfinite(states.mean[states.valid]).all(), name
            assert np.isfinite(states.covariance[states.valid]).all(), name
            assert (tracks.death > tracks.birth).all() and not tracks(
                -1, extrapolate=True
            ).valid.any()
        assert len(tracks) == 2 and (tracks(rec.stop).valid.all() or name == "hour")
    none = Recording("none", WIDTH, HEIGHT, Events.empty())
    with pytest.warns(InputWarning, match="none: no target was found; give seeds"):
        tracks = blob.moment.estimate(none)
    assert list(tracks.events()) == []
    assert len(tracks) == 0 and tracks([0, 1], extrapolate=True).mean.shape == (2, 0, 8)


@pytest.mark.slow
def test_single_precision(pair, float32):
    rec, seeds = pair
    e = rec.events
    late = Recording("late", WIDTH, HEIGHT, Events(e.t + 10**12, e.x, e.y, e.p))
    tracks, later = follow(rec, seeds=seeds), follow(late, seeds=seeds)
    states = tracks(np.array([50_000, 110_000]))
    assert states.mean.dtype == np.float32
    same(parts(later(np.array([50_000, 110_000]) + 10**12)), parts(states))
    with jax.enable_x64(True):
        exact = follow(rec, seeds=seeds)(np.array([50_000, 110_000]))
    np.testing.assert_allclose(states.mean[..., :2], exact.mean[..., :2], atol=0.02)


@pytest.mark.slow
def test_prefilter():
    rng = np.random.default_rng(6)
    rec = together(noise(rng, 20_000, 0.05), cloud(rng, line(60, 60), (3, 3), 20_000, (0, 0.05)))
    params = Params(prefilter=True, prefilter_time=2e-3)
    e = rec.events
    kept = []
    for i in range(len(e)):
        near = (e.t[:i] >= e.t[i] - 2000) & (
            np.maximum(abs(e.x[:i].astype(int) - e.x[i]), abs(e.y[:i].astype(int) - e.y[i])) == 1
        )
        pixels = {(e.x[j], e.y[j]) for j in np.flatnonzero(near)}
        kept.append(len(pixels) >= 2)
    kept = np.flatnonzero(kept)
    for steps, chunks in ((4, 3), (64, 100)):
        packer = ChunkPacker(rec, params, [], steps=steps, chunks=chunks)
        cursor, rows = packer.first, []
        while cursor is not None:
            segment = packer.pack(cursor)
            t = segment.start[:, None, None] + segment.features.t
            row = segment.row[segment.features.valid]
            assert np.array_equal(t[segment.features.valid], e.t[row])
            rows, cursor = [*rows, *row], segment.next
        assert np.array_equal(rows, kept) and 0 < len(kept) < len(e) / 2


def line_by_line(seed=0):
    """A blob of (20, 15) px at rest; each ms has one time, its events from top down."""
    t, xy = cloud(np.random.default_rng(seed), line(100, 90), (20, 15), 400_000, (0, 0.025))
    ms = (t * 1000).astype(np.int64)
    order = np.lexsort((xy[:, 0], xy[:, 1], ms))
    return recording(1000 * ms[order], xy[order])


def test_steps_hold_events_of_all_lines_of_one_time():
    rec = line_by_line()
    packer = ChunkPacker(rec, Params(events_per_step=8), [(100.0, 90.0, 25.0)], steps=5, chunks=3)
    cursor, rows, far = packer.first, [], []
    while cursor is not None:
        segment = packer.pack(cursor)
        valid, row = segment.features.valid, segment.row
        assert np.array_equal((segment.start[:, None, None] + segment.features.t)[valid],
            rec.events.t[row[valid]])  # fmt: skip
        far += list(rec.events.y[row[valid.all(-1)]].mean(-1) - 90)
        rows, cursor = [*rows, *row[valid]], segment.next
    assert sorted(rows) == list(range(len(rec.events)))
    # Of 8 events drawn at random it is 5.3 px, of 8 that follow each other 14.
    assert len(far) > 1000 and np.std(far) < 4


@pytest.mark.slow
def test_gradient_and_vmap(pair):
    rec, seeds = pair
    rec = rec[0.05:0.09]
    seeds = [(*line(60, 80, 900)(0.05), 8.0), (*line(168, 92, -900)(0.05), 8.0)]
    tracker = blob.constant_velocity
    params = tracker.Params(clutter=1e-5)
    features, _ = tracker.prepare(rec, np.empty(0), params, seeds=seeds)
    likelihood = functools.partial(blob.negative_log_likelihood, tracker)
    times = np.arange(51_000, 89_000, 1000)
    truth = np.stack([line(60, 80, 900)(times * 1e-6), line(168, 92, -900)(times * 1e-6)], 1)
    truth[3, 1] = np.nan
    batch = blob.prepare_positions(rec, params, seeds, times, truth)

    def losses(raw):
        """Both losses and their slopes: one backwards, the other one along all numbers at once."""

        def nll(raw):
            return likelihood(params.with_raw(raw), batch.features, "all")

        def error(raw):
            return blob.position_error(tracker, params.with_raw(raw), batch)

        ones = jax.tree.map(jnp.ones_like, raw)
        held = likelihood(params.with_raw(raw), features)
        return held, jax.value_and_grad(nll)(raw), jax.jvp(error, (raw,), (ones,))

    names, h = ("Q_v", "Q_p", "P0_v", "P0_p", "outliers", "clutter"), 1e-5
    raw = {name: params.raw[name] for name in names}
    steps = {name: np.zeros(13) for name in names}
    for k, name in enumerate(names):
        steps[name][2 * k : 2 * k + 2] = h, -h
    # Compiling a gradient takes seconds: one program tells all.
    held, (nll, gradient), (errors, along) = jax.tree.map(
        np.asarray, jax.jit(jax.vmap(losses))({name: raw[name] + steps[name] for name in names})
    )
    expected = float(oracle(rec, params, seeds, tracker)[2])
    assert held[12] == pytest.approx(expected, rel=1e-9)
    values = np.stack([nll, errors], 1)
    expected = (values[:12:2] - values[1:12:2]) / (2 * h)
    assert abs(expected[:, 0]).min() > 1e-7
    np.testing.assert_allclose([gradient[name][12] for name in names], expected[:, 0], rtol=3e-4)
    assert along[12] == pytest.approx(expected[:, 1].sum(), rel=3e-4)

    d2 = ((follow(rec, params, seeds, tracker=tracker)(times).mean[:, :, :2] - truth) ** 2).sum(-1)
    error = np.nanmean(200 * (np.sqrt(1 + d2 / 100) - 1))
    assert values[12, 1] == pytest.approx(error, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"seeds": [(240, 3, 5)]}, "outside the 240x180 sensor"),
        ({"seeds": [(3, 3)]}, "give x, y, size"),
        ({"seeds": [(3, 3, 0)]}, "size above 0"),
        ({"seeds": [(3, 3, 5, 7.0)]}, "begins at 7000000 us"),
        ({"start": 7.0}, "nothing to track"),
        ({"seeds": np.ones((1, 5))}, "give x, y, a size"),
    ],
)
def test_bad_input(pair, given, words):
    with pytest.raises(InputError, match=words):
        blob.moment.estimate(pair[0], **given)
