"""Candidates against a slow search; the filter against NumPy, finite differences, known motions."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from points import HEIGHT, WIDTH, moved, recorded, scattered, search_candidates, turning

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import candidates, voting
from jaxevent.egomotion.candidates import CandidateSampler
from jaxevent.egomotion.estimator import InconsistentMotionWarning, LostMotionWarning
from jaxevent.egomotion.models import MODELS, General, Planar, Rotation
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.filtering import smooth
from jaxevent.egomotion.particle_filter.likelihood import is_along_edge, score_batch
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.errors import InputError
from jaxevent.recording import Events

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(100.0, 100.0, 59.5, 44.5)


SCATTER = {"span": 4000, "width": 9, "height": 7, "step": 20}


@pytest.mark.parametrize("every, batch, pieces, per_pixel", [(1, 7, 3, 3), (3, 16, 64, 8)])
def test_candidates_are_the_recent_neighbours(every, batch, pieces, per_pixel):
    recording = scattered(400, **SCATTER)
    e, number = recording.events, 0
    sampler = CandidateSampler(
        recording, radius=2, per_pixel=per_pixel, most=200, every=every, batch=batch, longest=1e9
    )
    rows, ends = [], []
    while not sampler.is_exhausted:
        made = sampler.sample(pieces, 40e-6, 2000e-6)
        c = made.candidates
        np.testing.assert_array_equal(c.mask, c.age > 0)
        for b, k in zip(*np.nonzero(made.row >= 0), strict=True):
            row = made.row[b, k]
            expected = search_candidates(recording, row, 2, per_pixel, 40, 2000)
            assert listed(c, b, k) == expected and c.scale[b, k] == 1
            ages = 1e-6 * (min(2000, e.t[row] - recording.start) - 40)
            np.testing.assert_allclose(c.rate[b, k], len(expected) / ages if ages > 0 else 0)
            np.testing.assert_allclose(c.xi[b, k], [int(e.x[row]) - 4, int(e.y[row]) - 3])
            rows.append(row)
            number += len(expected)
        filled = (made.row >= 0).any(1)
        ends += made.t[filled].tolist()
        np.testing.assert_array_equal(made.t[filled], e.t[made.row.max(1)[filled]])
    np.testing.assert_array_equal(rows, np.arange(0, len(e), every))
    assert number > 500 and len(ends) == -(-len(rows) // batch)


def test_too_many_candidates_are_thinned_evenly():
    recording = scattered(3000, **SCATTER)
    few, all_ = (
        CandidateSampler(recording, radius=2, per_pixel=4, most=most, every=1, batch=50)
        .sample_all(1e-6, 1e-2)
        .candidates
        for most in (10, 200)
    )
    number = all_.mask.sum(-1)
    np.testing.assert_allclose(few.scale, np.maximum(number / 10, 1))
    np.testing.assert_array_equal(few.mask.sum(-1), np.minimum(number, 10))
    # Every candidate stands for as many as there were: sums over all are kept on average.
    for value in (lambda c: c.age, lambda c: c.d[..., 0] ** 2, lambda c: c.d[..., 1] > 0):
        total = (value(all_) * all_.mask).sum()
        thinned = ((value(few) * few.mask).sum(-1) * few.scale).sum()
        assert abs(thinned / total - 1) < 0.02


def test_candidates_about_an_expected_flow():
    recording = scattered(1500, **SCATTER)
    rng = np.random.default_rng(0)
    youngest, oldest = rng.uniform([[100]], 500, (7, 9)), rng.uniform(1000, 3000, (7, 9))
    U, slack = rng.uniform(-1000, 1000, (2, 7, 9)), rng.uniform(0, 300, (7, 9))
    gate = candidates.ExpectedFlow(U, slack, 1.5)
    sampler = CandidateSampler(recording, radius=2, per_pixel=4, most=200, every=3, batch=50)
    made = sampler.sample(20, 1e-6 * youngest, 1e-6 * oldest, expected=gate)
    c, e, some = made.candidates, recording.events, 0
    for b, k in zip(*np.nonzero(made.row >= 0), strict=True):
        x, y = int(e.x[made.row[b, k]]), int(e.y[made.row[b, k]])
        U, slack = gate.U[:, y, x], gate.slack[y, x]
        every = search_candidates(recording, made.row[b, k], 2, 4, youngest[y, x], oldest[y, x])
        near = [
            (dx, dy, age)
            for dx, dy, age in every
            if np.hypot(dx - U[0] * age * 1e-6, dy - U[1] * age * 1e-6) <= 1.5 + slack * age * 1e-6
        ]
        assert listed(c, b, k) == near
        since = e.t[made.row[b, k]] - recording.start
        ages = min(np.floor(oldest[y, x]), since) - np.ceil(youngest[y, x])
        np.testing.assert_allclose(c.rate[b, k], len(every) / ages * 1e6 if ages > 0 else 0)
        some += len(every) - len(near)
    assert some > 500


def listed(c, b, k):
    """(dx, dy, age in us) of an event's candidates."""
    there = c.age[b, k] > 0
    columns = *c.d[b, k, there].T, 1e6 * c.age[b, k, there]
    return sorted(tuple(int(v) for v in np.rint(one)) for one in zip(*columns, strict=True))


def test_chunks_end_in_time_and_lose_nothing():
    recording = scattered(400, **SCATTER)
    rows, sampler = [], CandidateSampler(recording, radius=2, every=3, batch=7)
    while not sampler.is_exhausted:
        made = sampler.sample(40, 0.0, 1.0, span=5e-4)
        t = recording.events.t[made.row[made.row >= 0]]
        assert t[-1] - t[0] <= 500
        rows.append(made.row[made.row >= 0])
    assert len(rows) == 8
    np.testing.assert_array_equal(np.concatenate(rows), np.arange(0, 400, 3))
    # A search needs candidates of all ages.
    short = CandidateSampler(recording, radius=2, every=3).sample(9, 0.0, 1e-3)
    assert np.max(short.candidates.history) == 1e-3


def test_a_batch_ends_in_time_and_times_add_up():
    recording = recorded([0, 100, 5000, 30000, 30001, 30001], [1] * 6, [1] * 6, [1] * 6)
    sampler = CandidateSampler(recording, every=1, batch=4, longest=0.004, silence=0.02)
    made = sampler.sample_all(0.0, 1.0)
    assert made.t.tolist() == [100, 5000, 30001]
    np.testing.assert_allclose(made.candidates.elapsed, [1e-4, 4.9e-3, 25.001e-3])
    np.testing.assert_allclose(made.candidates.history, [1e-4, 5e-3, 1e-6])


def test_events_whose_candidates_were_dropped_are_not_valid():
    """Silence of 15 ms among events 20 us apart, seen by candidates 18 to 28 ms old."""
    t = np.r_[0:60_000:20, 75_000:150_000:20]
    place = np.arange(len(t)) % 400
    recording = recorded(t, place % 20, place // 20, t > 0, 20, 20)
    sampler = CandidateSampler(recording, every=1, batch=64, longest=0.01)
    sample = sampler.sample_all(0.018, 0.028)
    at = recording.events.t[np.maximum(sample.row, 0)]
    missing = np.minimum(75_000, at - 18_000) - np.maximum(60_000, at - 28_000)
    is_real, valid = sample.row >= 0, sample.candidates.valid
    assert is_real.sum() == len(t) and not valid[~is_real].any()
    sure = is_real & (np.abs(missing - 5000) > 50)
    assert (valid == (missing < 5000))[sure].all() and 700 < (~valid & is_real).sum() < 800


def test_displacements_are_undistorted():
    camera = PinholeCamera(80.0, 80.0, 60.0, 45.0, (-0.3, 0.1, 0.001, -0.002, 0.0))
    recording = recorded([0, 1000], [110, 113], [80, 78], [1, 1])
    c = CandidateSampler(recording, camera, every=1).sample_all(0.0, 1.0).candidates
    xi: np.ndarray = np.asarray(c.xi)[0, :2]
    np.testing.assert_allclose(c.d[0, 1, 0], xi[1] - xi[0])
    bounds = np.asarray(c.bounds)[0, 0]  # from the first column to the last, at its row
    edge, _ = candidates.pixel_coordinates(WIDTH, HEIGHT, camera)
    here = np.asarray(c.xi)[0, 0]
    np.testing.assert_allclose(bounds[:, 0], here[0] - edge[80, [WIDTH - 1, 0], 0])
    np.testing.assert_allclose(bounds[:, 1], here[1] - edge[[HEIGHT - 1, 0], 110, 1])
    assert np.abs(np.asarray(c.d)[0, 1, 0] - [3, -2]).max() > 0.5


def prepared(likelihood="soft", model="planar", number=500, **settings):
    small = {"every": 1, "batch": 16, "particles": 30, "candidates": 20, "radius": 3,
             "baseline": 3.0, "alpha": 2.5, "tau_general": 0.09,
             "rho_max": 25.0}  # fmt: skip
    params = voting.Params.of({"likelihood": likelihood, **small, **settings})
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 100_000, number))
    x, y, p = rng.integers(0, 14, number), rng.integers(0, 11, number), rng.random(number) < 0.5
    recording = recorded(t, x, y, p, 14, 11, PinholeCamera(20.0, 20.0, 6.0, 5.0))
    kind, sampler = voting.sampler(recording, params, model)
    return params, kind, sampler.sample_all(1e-3, 0.1).candidates


def sum_over_events(params, model, batch, particles, weights, searching):
    """Sums over events, one term after another: each particle's log-likelihood; votes; chance; tau.

    `tau` is the mean over events of the age of a common range's oldest candidates.
    """
    batch = jax.tree.map(np.asarray, batch)
    total, votes, chance, taus = np.zeros(len(particles)), 0.0, 0.0, []
    rho_max, r_t, s0 = float(params.rho_max), float(params.r_t), float(params.s0)
    alpha, alpha_literal = float(params.alpha), float(params.alpha_literal)
    tau_general = float(params.tau_general)
    most = float(params.d_max if model.name == "planar" else params.V_max)
    band = (searching or params.likelihood == "band") and model.name != "general"
    share = float(params.youngest)
    b, tau_max = float(params.baseline), float(params.tau_max)
    sigma = float(params.sigma_x) * (2 if searching else 1)
    for k in np.flatnonzero(batch.valid):
        x, y = batch.xi[k]
        least_d, most_d = batch.bounds[k]
        f, general = model.f, model.name == "general"
        rows = np.array([[x * y / f, -(f + x * x / f), y], [f + y * y / f, -x * y / f, -x]])
        flows = [q if model.name == "planar" else rows @ q[-3:] for q in particles]
        lines = [np.array([-f * q[0] + x * q[2], -f * q[1] + y * q[2]]) if general else np.zeros(2)
                 for q in particles]  # fmt: skip
        speeds = [np.hypot(*U) for U in flows]
        usual = weights @ np.array(flows)
        tau = min(b / np.hypot(*usual), tau_max)
        if general:
            tau = tau_general
        taus.append(tau)
        if band or general:
            asked = (-least_d >= 0.99 * b).all() and (most_d >= 0.99 * b).all()
        else:
            pad, back = 2 * sigma, usual * tau
            asked = (back >= least_d + pad).all() and (back <= most_d - pad).all()
        if params.likelihood != "literal" and not asked:
            continue
        for i, (U, speed) in enumerate(zip(flows, speeds, strict=True)):
            S, least, own = 0.0, np.inf, []
            for c in range(batch.age.shape[1]):
                age, d = batch.age[k, c], batch.d[k, c]
                if age <= 0:
                    continue
                oldest = min(b / speed, tau_max) if band else tau
                youngest = share * (b / speed if band else tau)
                if youngest <= age <= oldest:
                    distance = d - U * age
                    if general:
                        a = lines[i] / np.hypot(lines[i][0], lines[i][1])
                        distance -= np.clip(distance @ a, 0, rho_max * age) * a
                    S += np.exp(-(distance**2).sum() / (2 * sigma**2))
                if not d.any():
                    own.append(age)
            for c in range(batch.age.shape[1]):
                age, d = batch.age[k, c], batch.d[k, c]
                if age <= 0:
                    continue
                if model.name == "planar":
                    cost = np.hypot(*(d - U / speed)) + r_t * abs(age - 1 / speed)
                else:
                    late = abs(age - min(own)) if own else 0
                    cost = np.hypot(*(d - U * age))
                    if general:  # |F| dt / |A T|
                        (u, v), (p, q) = d / age - U, lines[i]
                        cost = abs(u * q - v * p) * age / np.hypot(p, q)
                    cost = cost + r_t * late if d.any() else np.inf
                least = min(least, cost)
            if params.likelihood == "literal":
                total[i] -= alpha_literal * min(least, most)
                continue
            rate = speed / (weights @ np.array(speeds)) if band else 1
            votes += weights[i] * S * batch.scale[k]
            S *= batch.scale[k] * rate / s0
            total[i] += alpha * np.log(1 + S)
        # Of candidates all over the window as many as one vote's area holds; of a half-line's
        # votes, a disc's and a strip's of the window's half width.
        area = 2 * np.pi * sigma**2
        if general:
            area = area / 2 + np.sqrt(2 * np.pi) * sigma * batch.radius
        usual = batch.rate[k] * (1 - share) * tau
        chance += max(usual * area / (2 * batch.radius + 1) ** 2, 0.2)
    return total, votes, chance, np.mean(taus)


def cloud_of(kind):
    rng = np.random.default_rng(2)
    centre, width = ([120, -60], 60) if kind.name == "planar" else ([3, -3, 4], 3)
    particles = centre + rng.normal(0, width, (30, len(centre)))
    if kind.name == "general":
        T = rng.normal(size=(30, 3)) + [1, 0, 1]
        particles = np.concatenate([T / np.linalg.norm(T, axis=1)[:, None], particles / 4], 1)
    return particles, rng.dirichlet(np.ones(30) * 20)


# Each branch of the likelihood once: of flows, ranges of ages and half-lines.
@pytest.mark.parametrize(
    "likelihood, model",
    [
        *(("soft", model) for model in MODELS),
        ("band", "rotation"),
        ("search", "planar"),
        ("search", "general"),
        ("literal", "planar"),
        ("literal", "general"),
    ],
)
def test_scores_equal_a_loop(likelihood, model):
    searching = likelihood == "search"
    params, kind, c = prepared("soft" if searching else likelihood, model, r_t=50.0)
    batch = jax.tree.map(lambda a: a[25], c)
    particles, weights = cloud_of(kind)
    found = SCORE(params, kind, batch, *map(jnp.asarray, (particles, weights, searching)))
    expected, votes, chance, tau = sum_over_events(
        params, kind, batch, particles, weights, searching
    )
    assert expected.std() > 0.05
    np.testing.assert_allclose(found.log_likelihood.sum(0), expected, rtol=1e-9, atol=1e-12)
    if likelihood != "literal":
        np.testing.assert_allclose([found.votes, found.chance], [votes, chance], rtol=1e-9)
        # Seen is the mean flow since candidates: that of half their ages ago.
        np.testing.assert_allclose(found.lag, (0.7 * tau + tau) / 2 / 2)


@pytest.mark.parametrize("searching", [False, True])
def test_step_equals_a_loop(searching):
    params, kind, c = prepared()
    batch = dataclasses.replace(
        jax.tree.map(lambda a: jnp.asarray(a[25]), c), history=jnp.array(1.0)
    )
    particles, weights = cloud_of(kind)
    carry = filtering.ParticleState(
        *map(jnp.asarray, (particles, np.log(weights), searching, 0.0, 0.0, 0.0, 0.0))
    )
    cloud = jnp.zeros_like(carry.particles)
    noise = filtering.BatchNoise(cloud, jnp.zeros(()), cloud)
    after, found = STEP(params, kind, carry, jax.tree.map(jnp.asarray, batch), noise)
    gain, *_ = sum_over_events(params, kind, batch, particles, weights, searching)
    gain = gain * (min(1, 0.5 / gain.std()) if searching else 1)
    w = weights * np.exp(gain)
    np.testing.assert_allclose(found.evidence, np.log(w.sum()), rtol=1e-9)
    w /= w.sum()
    mean = w @ particles
    np.testing.assert_allclose(found.mean, mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        found.covariance, (particles - mean).T @ np.diag(w) @ (particles - mean), rtol=1e-8
    )
    few = 1 / (w**2).sum() <= 15
    np.testing.assert_allclose(jnp.exp(after.log_weights), 1 / 30 if few else w, rtol=1e-9)


STEP = eqx.filter_jit(filtering.step)
SCORE = eqx.filter_jit(score_batch)


def test_systematic_resampling_is_unbiased():
    w = np.random.default_rng(0).dirichlet(np.full(20, 0.3))
    u = (np.arange(2000) + 0.5) / 2000
    each = jax.jit(jax.vmap(filtering.resample, (None, 0)))
    ancestor, renewed = each(np.log(w), u)
    counts = (np.asarray(ancestor)[..., None] == np.arange(20)).sum(1)
    np.testing.assert_allclose(counts.mean(0), 20 * w, atol=2e-3)
    assert (np.abs(counts - 20 * w) < 1 + 1e-9).all()  # at most one more or less than its share
    np.testing.assert_allclose(renewed, -np.log(20))


def test_resampling_carries_the_score():
    w = np.random.default_rng(0).dirichlet(np.full(20, 0.3))
    resample = jax.jit(filtering.resample)
    ancestor, _ = resample(np.log(w), 0.3)
    jacobian = jax.jit(jax.jacobian(lambda lw: resample(lw, 0.3)[1]))(np.log(w))
    np.testing.assert_allclose(jacobian, np.eye(20)[ancestor])


@pytest.mark.parametrize("likelihood", ["soft", "literal"])
def test_gradient_without_resampling(likelihood, request):
    if likelihood == "literal":
        request.getfixturevalue("optimised")
    params, kind, c = prepared(likelihood, number=300, resample_below=0.0, r_t=50.0, memory=1e9)
    noise = filtering.draw(jax.random.key(3), len(c.elapsed), params, kind)
    carry = filtering.init(params, kind, noise)
    carry = dataclasses.replace(carry, particles=carry.particles / 6, searching=jnp.asarray(False))
    names = ["noise"] + (["r_t", "alpha_literal"] if likelihood == "literal" else
                         ["sigma_x", "s0", "alpha"])  # fmt: skip

    @jax.jit
    def loss(values):
        raw = {**params.raw, **dict(zip(names, values, strict=True))}
        tuned = eqx.tree_at(lambda p: p.raw, params, raw)
        _, found = filtering.run(tuned, kind, c, noise, carry)
        error = ((found.mean - jnp.array([50.0, 20.0])) ** 2).mean()
        return error / 1e3 - found.evidence.sum() / 100

    at = jnp.stack([params.raw[name] for name in names])
    h = 1e-6
    slopes = [(loss(at + h * e) - loss(at - h * e)) / (2 * h) for e in jnp.eye(len(names))]
    gradient = jax.jacfwd(loss)(at)
    np.testing.assert_allclose(gradient, slopes, rtol=1e-5, atol=1e-6)
    assert (np.abs(gradient) > 1e-4).all()


def relative_error(motion, truth):
    """After the first 300 ms."""
    late = motion.t > motion.t[0] + 300_000
    assert late.sum() > 20 and motion.valid[late].all()
    return np.linalg.norm(motion.mean[late] - truth, axis=1).mean() / np.linalg.norm(truth)


def fast() -> Params:
    """Parameters of few candidates, in the precision of the test."""
    return voting.Params.of({"every": 2, "candidates": 48})


def test_planar_motion_is_found(float32):
    truth = np.array([130.0, -70.0])
    recording = moved(lambda at: truth, 0.45, 120, seed=3)
    motion = voting.estimate(recording, fast(), seed=1, cloud=16)
    assert motion.mean.dtype == np.float32
    assert relative_error(motion, truth) < 0.03
    # The particles that are asked for are drawn by weight, and change nothing else.
    assert motion.cloud.shape == (len(motion), 16, 2)
    apart = motion.cloud.mean(1) - motion.mean
    spread = np.sqrt(np.trace(motion.covariance, axis1=1, axis2=2))
    assert (np.linalg.norm(apart, axis=1) < 1.0 * spread)[motion.valid].all()
    again = voting.estimate(recording, fast(), seed=1)
    assert again.cloud is None
    np.testing.assert_array_equal(motion.mean, again.mean)


def test_bursts_do_not_make_the_motion_too_fast(float32):
    """An edge makes 16 events at a pixel, of levels that are 0.15 px apart."""
    truth = np.array([130.0, -70.0])
    e = moved(lambda at: truth, 0.25, 40, seed=8).events
    late = np.arange(16) * 0.15e6 / 148
    t = (e.t[:, None] + late).ravel()
    x, y, p = (np.repeat(column, len(late)) for column in (e.x, e.y, e.p))
    motion = voting.estimate(recorded(t, x, y, p), fast(), seed=1)
    mean = motion.mean[motion.t > 150_000].mean(0)
    np.testing.assert_allclose(mean, truth, atol=3.0)


def test_motion_is_found_where_events_were_dropped(float32):
    """15 of each 50 ms are missing; then nothing is told, as the camera may have stopped."""
    truth = np.array([130.0, -70.0])
    recording = moved(lambda at: truth, 0.4, 120, seed=4)
    e = recording.events
    kept = e.t % 50_000 >= 15_000
    events = Events(e.t[kept], e.x[kept], e.y[kept], e.p[kept])
    motion = voting.estimate(dataclasses.replace(recording, events=events), fast(), seed=1)
    times = np.arange(200_000, 380_000, 1000)
    mean, covariance, valid = motion(times)
    silent = times % 50_000 < 15_000
    assert not valid[silent & (times % 50_000 > 2000)].any() and valid[~silent].mean() > 0.5
    z = (mean - truth)[valid] / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[valid])
    assert np.abs(z).max() < 3


def test_rotation_is_found():
    """In double precision; the scenes beside it are in single precision, as users have them."""
    truth = np.array([0.5, 1.5, -1.2])
    recording = moved(turning(truth), 0.45, 150, seed=5, camera=CAMERA)
    motion = voting.estimate(recording, fast(), model="rotation", seed=0)
    assert relative_error(motion, truth) < 0.05


def test_motion_is_found_again_after_a_sudden_change(float32):
    before, truth = (300, 0), (60, 0)
    first = moved(lambda at: np.array(before), 0.3, 120, seed=6).events
    second = moved(lambda at: np.array(truth), 0.4, 120, seed=7).events
    parts = [np.concatenate([getattr(first, n), getattr(second, n)]) for n in "xyp"]
    recording = recorded(np.concatenate([first.t, second.t + 300_000]), *parts)
    with pytest.warns(InconsistentMotionWarning, match="does not move as one"):
        motion = voting.estimate(recording, fast())
    assert not motion.valid[motion.t > 300_000].all()
    # Candidates of the new motion are as old as the baseline takes: 76 to 108 ms at 60 px/s.
    again = 0.3 + 0.1 + 0.7 * 6.5 / np.hypot(*truth)
    mean, covariance, valid = motion(np.arange(again, 0.69, 0.01))
    assert valid.all()
    np.testing.assert_allclose(mean, np.tile(truth, (len(mean), 1)), atol=12)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_vmap_over_seeds_and_parameters():
    params, kind, c = prepared()
    c = jax.tree.map(lambda a: a[:4], c)  # as many as elsewhere: one program
    keys = jax.random.split(jax.random.key(0), 3)

    def final(key, alpha):
        tuned = eqx.tree_at(lambda p: p.raw["alpha"], params, alpha)
        noise = filtering.draw(key, len(c.elapsed), params, kind)
        return RUN(tuned, kind, c, noise, filtering.init(params, kind, noise))[1].mean[-1]

    alphas = jnp.log(jnp.array([1.0, 2.0, 3.0]))
    together = jax.jit(jax.vmap(final))(keys, alphas)
    for k in range(3):
        np.testing.assert_allclose(together[k], final(keys[k], alphas[k]), rtol=1e-7)
    assert len(np.unique(np.asarray(together))) == together.size


RUN = eqx.filter_jit(filtering.run)


# Rotations have no branch of their own.
@pytest.mark.parametrize(
    "model, likelihood",
    [("planar", "soft"), ("general", "soft"), ("planar", "literal"), ("general", "literal")],
)
def test_odd_streams(model, likelihood):
    params = voting.Params.of({**fast().values(), "likelihood": likelihood})
    rng = np.random.default_rng(0)
    n = 300
    x, y, p = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n), rng.random(n) < 0.5
    even = np.arange(n) * 100
    few = recorded(even[:5], x[:5], y[:5], p[:5], camera=CAMERA)
    silent = recorded(even + 1_000_000 * (even > 15000), x, y, p, camera=CAMERA)
    at_once = recorded(0 * even, x, y, p, camera=CAMERA)
    one_pixel = recorded(even, 0 * x + 5, 0 * y, p, camera=CAMERA)
    one = recorded(even[:1], x[:1], y[:1], p[:1], camera=CAMERA)
    for recording in (one, few, silent, at_once, one_pixel):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", LostMotionWarning)
            warnings.simplefilter("ignore", InconsistentMotionWarning)
            motion = voting.estimate(recording, params, model=model, smooth=True)
        is_lost = not motion.valid.any() and not motion.warning
        assert [w.category for w in told] == [LostMotionWarning] * is_lost
        assert len(motion) > 0
        states = motion(recording.start + np.arange(5) * 300_000, extrapolate=True)
        for value in (motion.mean, motion.covariance, motion.contrast, motion.evidence):
            assert np.isfinite(value).all()
        # An undecided heading is NaN in a row whose rotation is known.
        assert (np.isfinite(states.mean).any(1) == states.valid).all()
        if model == "general":
            np.testing.assert_allclose(np.linalg.norm(motion.mean[:, :3], axis=1), 1)
    assert not motion.valid.any() or likelihood == "literal"
    nothing = dataclasses.replace(few, events=Events.empty())
    with pytest.warns(LostMotionWarning, match="found no motion, as there are no events; try"):
        states = voting.estimate(nothing, params, model=model)(0.5)
    assert not states.valid.any() and np.isnan(states.mean).all()


@pytest.mark.parametrize("model", ["planar", "general"])
def test_filter_restarts_when_all_particles_die(model):
    params, kind, c = prepared(model=model)
    c = jax.tree.map(lambda a: a[:4], c)
    noise = filtering.draw(jax.random.key(0), len(c.elapsed), params, kind)
    carry = filtering.init(params, kind, noise)
    dead = dataclasses.replace(carry, log_weights=jnp.full_like(carry.log_weights, -jnp.inf))
    after, found = RUN(params, kind, c, noise, dead)
    assert found.searching[0] and after.searching
    assert np.ptp(after.particles, axis=0).min() > 1  # everywhere
    for value in (*jax.tree.leaves(found), after.particles, after.log_weights):
        assert np.isfinite(value).all()


def test_states_between_batches():
    motion = MotionEstimate(
        Planar, np.array([1000, 3000]), np.array([[1.0, 0], [3, 4]]),
        np.stack([np.eye(2), 3 * np.eye(2)]), np.array([False, True]),
        np.full(2, 5e-4), np.ones(2), np.zeros(2),
    )  # fmt: skip
    at_once = dataclasses.replace(motion, lag=np.zeros(2))
    mean, covariance, valid = at_once(np.array([500, 1500, 3000, 9000]))
    np.testing.assert_allclose(mean, [[np.nan] * 2, [np.nan] * 2, [3, 4], [3, 4]])
    np.testing.assert_allclose(covariance[1], 1.5 * np.eye(2))
    assert valid.tolist() == [False, False, True, True]
    found = dataclasses.replace(motion, valid=np.array([True, True]))
    np.testing.assert_allclose(found(np.array([1500])).mean, [[2, 2]])
    # As it was known at the time, the error has what the motion changes while it lags.
    late = dataclasses.replace(found, causal=True)(np.array([2000]))
    np.testing.assert_allclose(late.mean, [[2, 2]])
    np.testing.assert_allclose(late.covariance[0], 2 * np.eye(2) + [[1, 2], [2, 4]])


def test_smoothing_equals_the_dense_posterior():
    """Of a random walk seen with noise: a Kalman filter, then the joint Gaussian of all times."""
    params, rng, n = (
        voting.Params.of({"noise_rotation": 2.0}),
        np.random.default_rng(0),
        40,
    )
    dt = rng.uniform(1e-3, 1e-2, n)
    dt[0], R, P0 = 0.0, np.diag([0.1, 0.2, 0.4]), np.eye(3)
    z = np.cumsum(2 * np.sqrt(dt)[:, None] * rng.normal(size=(n, 3)), 0)
    z += rng.normal(size=(n, 3)) @ np.sqrt(R)
    mean, P, found = np.zeros(3), P0, []
    for k in range(n):
        P = P + 4.0 * dt[k] * np.eye(3)
        K = P @ np.linalg.inv(P + R)
        mean, P = mean + K @ (z[k] - mean), (np.eye(3) - K) @ P
        found.append((mean, P))
    t = np.rint(1e6 * np.cumsum(dt)).astype(np.int64)
    lag = np.linspace(0.02, 0.03, n)
    means, covariances = (np.array(part) for part in zip(*found, strict=True))
    motion = dataclasses.replace(
        MotionEstimate.from_arrays("rotation", t, means, covariances), lag=lag
    )
    smoothed = smooth(motion, params)
    # cov(x_i, x_j) = P0 + 4 min(t_i, t_j), each component alone.
    joint = 1 + 4 * np.cumsum(dt)[np.minimum.outer(np.arange(n), np.arange(n))]
    for i in range(3):
        gain = joint @ np.linalg.inv(joint + R[i, i] * np.eye(n))
        np.testing.assert_allclose(smoothed.mean[:, i], gain @ z[:, i], rtol=1e-2, atol=2e-3)
        posterior = joint - gain @ joint
        np.testing.assert_allclose(smoothed.covariance[:, i, i], np.diag(posterior), rtol=1e-3)
    np.testing.assert_allclose(smoothed.t, t - 1e6 * lag, atol=1)
    assert not smoothed.lag.any()
    # Nothing passes a stretch in which the motion is lost.
    valid = np.arange(n) != 20
    cut = smooth(dataclasses.replace(motion, valid=valid), params)
    first = smooth(
        MotionEstimate.from_arrays("rotation", t[:20], means[:20], covariances[:20]), params
    )
    np.testing.assert_allclose(cut.mean[:20], first.mean)
    np.testing.assert_allclose(cut.mean[20], means[20])


def test_means_over_the_ages_of_candidates_are_undone():
    """Of a sine of seven periods per second, whose mean over 80 ms is half as large."""
    t, span, w = np.arange(0, 1_500_000, 1000), 0.08, 2 * np.pi * 7
    params, size = voting.Params.of({"noise_rotation": 2.0}), np.array([0.3, -0.2, 0.1])
    true = 1 + size * np.sin(w * 1e-6 * t)[:, None]
    mean = 1 + size * np.sin(w * 1e-6 * t)[:, None] * np.sin(w * span / 2) / (w * span / 2)
    assert np.abs(mean - true).max() > 0.1
    for sigma, low, high in ((1e-12, 0.0, 0.08), (1e-4, 0.0, 0.08), (1.0, 0.4, 1.1)):
        covariance = np.tile(sigma**2 * np.eye(3), (len(t), 1, 1))
        motion = MotionEstimate.from_arrays("rotation", t, mean, covariance)
        found = filtering.undo_averages(motion, np.full(len(t), span), params)
        off = np.abs(found - true)[100:-100] / np.abs(size)
        assert low <= off.max() <= high  # noise may hide the change
    # Each stretch counts by itself, and lost rows stay.
    valid = (t < 700_000) | (t > 800_000)
    covariance = np.tile(1e-8 * np.eye(3), (len(t), 1, 1))
    motion = MotionEstimate.from_arrays("rotation", t, mean, covariance, valid)
    part = motion.from_arrays("rotation", t[:701], mean[:701], covariance[:701], valid[:701])
    found = filtering.undo_averages(motion, np.full(len(t), span), params)
    alone = filtering.undo_averages(part, np.full(701, span), params)
    np.testing.assert_array_equal(found[:700], alone[:700])
    np.testing.assert_array_equal(found[~valid], mean[~valid])


def test_ages_that_differ_across_the_image_make_no_roll(monkeypatch):
    """Least squares over pixels, each of which tells a mean over its own ages, are undone."""
    f, baseline, late = 130.0, 6.5, 0.02
    y, x = (part.ravel() for part in np.mgrid[-56:57:8, -76:77:8].astype(float))
    basis = np.asarray(Rotation(f).basis(np.stack([x, y], -1)), np.float64)
    t = np.arange(0, 600_000, 3000)

    def turn(at):
        return np.stack([-0.8 + 0 * at, 0.4 + 0.6 * np.sin(2 * np.pi * 2 * at), 0.9 + 0 * at], -1)

    seen, span = np.empty((len(t), 3)), np.empty(len(t))
    for row, now in enumerate(1e-6 * t):
        speed = np.linalg.norm(basis @ turn(now), axis=-1)
        age = np.minimum(baseline / speed, 0.1)
        age *= 2 * late * speed.sum() / (speed * age).sum()
        told = turn(now + late - age[:, None] * (np.arange(50) + 0.5) / 50).mean(1)
        flow = np.einsum("pid,pd->pi", basis, told)
        weight = np.sqrt(speed) * age
        sides = (weight[:, None] * flow).ravel()
        seen[row] = np.linalg.lstsq((weight[:, None, None] * basis).reshape(-1, 3), sides)[0]
        span[row] = 2 * late
    true = turn(1e-6 * t)
    assert np.abs(seen - true)[30:-30, 2].max() > 0.04
    covariance = np.tile(1e-6 * np.eye(3), (len(t), 1, 1))
    motion = MotionEstimate.from_arrays("rotation", t, seen, covariance)
    params = voting.Params.of({"baseline": baseline, "tau_max": 0.1})
    found = filtering.undo_averages(motion, span, params, basis)
    assert np.abs(found - true)[30:-30].max() < 0.01
    # Pieces of a long recording are those of the whole.
    monkeypatch.setattr(filtering, "PIECE_KNOTS", 50)
    monkeypatch.setattr(filtering, "MARGIN_KNOTS", 64)
    pieces = filtering.undo_averages(motion, span, params, basis)
    assert 0 < np.abs(pieces - found).max() < 1e-4


def test_general_particles():
    params = voting.Params.of({"preset": "general"})
    kind = General(100.0)
    noise = filtering.draw(jax.random.key(0), 1, params, kind)
    particles = jax.jit(filtering.init, static_argnums=1)(params, kind, noise).particles
    particles = np.asarray(particles)
    np.testing.assert_allclose(np.linalg.norm(particles[:, :3], axis=1), 1)
    # All over the sphere: second moments of directions are 1 / 3.
    T = particles[:, :3]
    np.testing.assert_allclose(T.T @ T / 500, np.eye(3) / 3, atol=0.06)
    steps, moved = 0.01 * np.asarray(noise.normal[0]), jax.jit(jax.vmap(kind.retract))
    after = np.asarray(moved(particles, steps))
    np.testing.assert_allclose(np.linalg.norm(after[:, :3], axis=1), 1)
    across = steps[:, :3] - particles[:, :3] * (steps[:, :3] * particles[:, :3]).sum(1)[:, None]
    np.testing.assert_allclose(after[:, :3] - particles[:, :3], across, atol=2e-3)
    around = np.concatenate([np.tile([0.6, 0.0, 0.8], (500, 1)), particles[:, 3:]], 1)
    cloud = moved(around, 5 * steps)
    mean = np.asarray(jax.jit(kind.mean)(cloud, np.full(500, 1 / 500)))
    np.testing.assert_allclose(mean[:3], [0.6, 0, 0.8], atol=0.02)
    apart = np.asarray(jax.jit(jax.vmap(kind.deviation, (0, None)))(cloud, mean))
    np.testing.assert_allclose(apart[:, :3] @ mean[:3], 0, atol=1e-12)
    covariance = apart.T @ apart / 500
    np.testing.assert_allclose(np.linalg.eigvalsh(covariance[:3, :3])[1:], 0.05**2, rtol=0.2)


def test_impossible_estimates_are_refused():
    recording = recorded([0, 1], [0, 1], [0, 1], [0, 1])
    for model in ("rotation", "general"):
        with pytest.raises(InputError, match="calibration"):
            voting.estimate(recording, fast(), model=model)
    with pytest.raises(InputError, match="planar"):
        voting.estimate(recording, fast(), model="planer")


def test_candidates_along_an_edge_against_a_loop():
    """Thesis 6.6.5: young ones whose pixel fired before when the event's own did."""
    rng, edge = np.random.default_rng(5), 0.002
    d = rng.integers(-1, 2, (2, 40)).astype(float)
    age = rng.choice([0.0, 0.001, 0.0015, 0.003, 0.02, 0.021, 0.03], 40) * (
        1 + 1e-3 * rng.random(40)
    )
    own = [age[c] for c in range(40) if age[c] > 0 and not d[:, c].any()]
    last, expected = min(own), []
    for c in range(40):
        earlier = [a for a, e in zip(age, d.T, strict=True) if (e == d[:, c]).all() and a > age[c]]
        near = bool(earlier) and abs(min(earlier) - last) <= edge
        expected.append(0 < age[c] <= edge and near)
    params = voting.Params(edge=edge)
    found = is_along_edge(params, jnp.asarray(d), jnp.asarray(age), jnp.asarray(last))
    assert np.array_equal(found, expected) and 0 < sum(expected) < (age > 0).sum()
