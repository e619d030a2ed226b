"""The smoother against all states at once, in float64; and what it does to whole tracks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent import blob
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.tracks import Tracks
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording
from jaxevent.simulate import LinearMotion, Target, simulate_blobs

Q_P, Q_V, P0_P, P0_V, STILL = 30.0, 2e5, 20.0, 4e4, 0.02
PAUSE = 40_000, 90_000  # us, without events
QUIET = {"prefilter": False, "gate_min": 80.0, "gate_max": 1e3}  # all events are the target's


def params_of(tracker, **values):
    noises = {"Q_p": Q_P, "Q_v": Q_V, "P0_p": P0_P, "P0_v": P0_V}
    return tracker.Params(**{**QUIET, **noises, **values})


@pytest.fixture(scope="module")
def walk():
    """Events of a wandering target with a pause, some of them at the same time."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(0, 140_000, 70))
    t = t[(t < PAUSE[0]) | (t >= PAUSE[1])]
    t[1], t[20] = t[0], t[19]
    xy = 60 + np.c_[300 * t * 1e-6, 15 * np.sin(40e-6 * t)] + rng.normal(size=(len(t), 2)) * 4
    x, y = np.rint(xy).astype(np.uint16).T
    return Recording("walk", 160, 120, Events(t, x, y, t % 2 == 0))


def follow(recording, params, seeds, tracker, steps=64, chunks=32, **options):
    packer = ChunkPacker(recording, params, seeds, steps=steps, chunks=chunks, **options)
    runner = KernelRunner(tracker.filter, params, detect=packer.detect)
    return Tracks(runner, packer, smooth=True)


def all_at_once(recording, M, size, start, times):
    """Position and velocity (times, 4) and their covariances by one linear system of all states.

    States at the steps and at `times` are unknowns: the prior, each step's motion and the events
    are rows of a least squares problem. In the pause the target stands still.
    """
    e = recording.events
    steps = [np.arange(i, min(i + M, len(e))) for i in range(0, len(e), M)]
    result = [(int(e.t[rows[-1]]), rows) for rows in steps] + [(int(t), []) for t in times]
    order = sorted(range(len(result)), key=lambda k: (result[k][0], k))
    nodes = [(int(e.t[0]), []), *(result[k] for k in order)]
    d = 4 * len(nodes)
    A, b = [], []

    def add(rows, values, covariance):
        L = np.linalg.inv(np.linalg.cholesky(covariance))
        A.append(L @ rows)
        b.append(L @ values)

    def place(k):
        return np.eye(d)[4 * k : 4 * k + 4]

    add(place(0), np.r_[start, 0, 0], np.diag([P0_P, P0_P, P0_V, P0_V]))
    last_event, eye = nodes[0][0], np.eye(2)
    for k in range(1, len(nodes)):
        later = [t for t, rows in nodes[k:] if len(rows)]
        dt = (nodes[k][0] - nodes[k - 1][0]) * 1e-6
        gap = ((later[0] if later else nodes[k][0]) - last_event) * 1e-6
        F = np.block([[eye, dt * eye], [0 * eye, eye]])
        a, h, c = Q_P * dt + Q_V * dt**3 / 3, Q_V * dt**2 / 2, Q_V * dt
        if gap > STILL:
            since = (nodes[k - 1][0] - last_event) * 1e-6, (nodes[k][0] - last_event) * 1e-6
            F[:, 2:], h = 0, 0
            # The filter's noise of the whole silence, as far as it has gone.
            a, c = Q_P * dt + Q_V * (since[1] ** 3 - since[0] ** 3) / 3, P0_V
        Q = np.block([[a * eye, h * eye], [h * eye, c * eye]])
        add(place(k) - F @ place(k - 1), np.zeros(4), Q + 1e-13 * np.diag([1, 1, 1e4, 1e4]))
        t, rows = nodes[k]
        if len(rows):  # a step's events count as their mean
            age = (t - e.t[rows]).mean() * 1e-6
            H = np.concatenate([eye, -age * eye], 1)
            xi = np.r_[e.x[rows].mean(), e.y[rows].mean()]
            add(H @ place(k), xi, size**2 / len(rows) * eye)
        last_event = t if len(rows) else last_event
    A, b = np.concatenate(A), np.concatenate(b)
    Q, R = np.linalg.qr(A)
    R = np.linalg.inv(R)
    x, P = R @ Q.T @ b, R @ R.T
    found = [1 + order.index(len(steps) + i) for i in range(len(times))]
    x = np.stack([x[4 * k : 4 * k + 4] for k in found])
    return x, np.stack([P[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in found])


@pytest.mark.slow
def test_equals_least_squares_of_all_states(walk):
    """Before, in and after a pause, and after the last event."""
    M = 4
    tracker, start, size = blob.constant_velocity, (58.0, 62.0), 4.0
    params = params_of(tracker, events_per_step=M, t_still=STILL, cycle=1.0)
    tracks = follow(walk, params, [(*start, size)], tracker)
    times = np.array(
        [int(walk.events.t[0]), 7001, 39_000, 41_000, 60_000, 89_000, 101_234, 139_000]
    )
    result = tracks(times)
    assert result.valid.all()
    x, P = all_at_once(walk, M, size, start, times)
    np.testing.assert_allclose(result.mean[:, 0, :2], x[:, :2], atol=2e-5)
    np.testing.assert_allclose(result.mean[:, 0, 2:4], x[:, 2:], rtol=1e-4, atol=2e-2)
    # Of a velocity in the pause the filter tells that it is not known afterwards.
    moving = (times < PAUSE[0]) | (times >= PAUSE[1])
    np.testing.assert_allclose(
        result.covariance[moving, 0, :4, :4], P[moving], rtol=1e-4, atol=1e-3
    )
    np.testing.assert_allclose(result.covariance[:, 0, :2, :2], P[:, :2, :2], rtol=1e-4, atol=1e-5)
    assert (tracks.filtered(times[:4]).covariance[:, 0, 0, 0] > 1.2 * P[:4, 0, 0]).all()


@pytest.fixture(scope="module")
def three():
    """Two targets that come and go at different times in background events, and one that stays."""
    rec, truth = simulate_blobs(
        [
            Target(LinearMotion((20, 30), (300, 50), size=(4, 2), theta=0.5), 8e3),
            Target(LinearMotion((90, 20), (0, 400), size=(3, 3)), 8e3, dropouts=((0.0, 0.03),)),
            Target(LinearMotion((130, 90), (-200, 0), size=(3, 2)), 8e3, dropouts=((0.05, 0.1),)),
        ],
        (160, 120),
        0.1,
        noise=2e3,
        seed=4,
    )
    return rec, truth


DETECTED = {
    "lambda0": 4.0, "lambda_max": 20.0, "gate_max": 20.0, "events_per_step": 4, "max_targets": 4,
    "t_coast": 0.015, "P0_lambda": 4.0, "n_birth": 15.0, "n_confirm": 40.0,
}  # fmt: skip


@pytest.mark.slow
def test_segments_chunks_and_births_do_not_matter(three):
    """One long segment, and many short ones of which only some beginnings are kept."""
    (rec, _), tracker = three, blob.constant_velocity
    params = tracker.Params(**DETECTED)
    times = np.linspace(rec.start, rec.stop, 41).astype(np.int64)
    tracks = follow(rec, params, None, tracker, steps=64, chunks=64)
    short = follow(rec, params, None, tracker, steps=4, chunks=3)
    assert len(tracks) >= 3 and (tracks.death < tracks.stop).any()
    assert len(short._segment_infos) > len(short._checkpoints) > 8
    for one, other in zip(tracks(times), short(times), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)
    assert len(short._kept_infos) == len(short._segment_infos)
    short._kept_infos = {}  # as where there is no room for what later events say
    for one, other in zip(tracks(times), short(times), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)
    # At its end a track rests on the same events either way.
    ends = np.minimum(tracks.death - 1, rec.stop)
    both = (tracks(ends), tracks.filtered(ends))
    for k in range(len(tracks)):
        np.testing.assert_allclose(*(result.mean[k, k] for result in both), rtol=1e-9)


@pytest.mark.slow
def test_smoothed_states_are_nearer_and_know_it(three):
    rec, truth = three
    tracker = blob.moment
    values = {**DETECTED, "Q_p": 0.0, "Q_v": 1e4, "Q_q": 0.1, "Q_theta": 1e-3, "Q_lambda": 0.1}
    seeds = [(20, 30, 6.0)]
    tracks = tracker.estimate(rec, tracker.Params(**values), seeds=seeds, progress=False)
    times = np.arange(20_000, 80_000, 1000)
    true = truth(times)[:, 0]

    def rms(states):
        assert states.valid.all()
        e = np.asarray(states.mean[:, 0]) - true
        return np.sqrt((e**2).mean(0)), e, np.asarray(states.covariance[:, 0])

    error, e, P = rms(tracks(times))
    before, _, P_before = rms(tracks.filtered(times))
    assert np.hypot(*error[:2]) < 0.75 * np.hypot(*before[:2])
    assert np.hypot(*error[2:4]) < 0.6 * np.hypot(*before[2:4])
    assert np.hypot(*error[4:6]) < 1.1 * np.hypot(*before[4:6])
    assert error[6] < 1.02 * before[6]
    assert (np.linalg.eigvalsh(P) > 0).all()
    assert (np.diagonal(P, axis1=1, axis2=2) < np.diagonal(P_before, axis1=1, axis2=2)).all()
    assert np.einsum("ti,tij,tj->t", e[:, :2], np.linalg.inv(P[:, :2, :2]), e[:, :2]).mean() < 8


@pytest.mark.slow
def test_pure_functions_agree_and_have_gradients(walk):
    tracker, seeds = blob.constant_velocity, [(58.0, 62.0, 4.0)]
    params = params_of(tracker, events_per_step=4, t_still=STILL, cycle=1.0)
    times = np.arange(1000, 139_000, 9000)
    features, out = tracker.prepare(walk, times, params, seeds=seeds)

    def loss(raw):
        own = params.with_raw({**params.raw, **raw})
        trajectory, _ = tracker.run(own, features)
        read = tracker.read(own, tracker.smooth(own, features, trajectory), out)
        return jnp.sum(jnp.sin(read.mean[:, 0, :4] * jnp.array([1, 1, 0.01, 0.01]))), read

    # Compiling a gradient takes seconds: one program tells all.
    loss = jax.jit(jax.value_and_grad(loss, has_aux=True))
    raw = {name: params.raw[name] for name in ("Q_v", "Q_p", "P0_p")}
    (_, read), gradient = loss(raw)
    for one, other in zip(read, follow(walk, params, seeds, tracker)(times), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    h = 1e-5
    for name in raw:
        up, down = (loss({**raw, name: raw[name] + s})[0][0] for s in (h, -h))
        assert gradient[name] == pytest.approx(float(up - down) / (2 * h), rel=2e-4, abs=1e-7)
        assert gradient[name] != 0


@pytest.mark.slow
def test_filters_without_a_transition_are_not_smoothed(walk):
    tracker, seeds = blob.moving_moments, [(58.0, 62.0, 4.0)]
    assert not tracker.estimate(walk, seeds=seeds, progress=False).smooth
    with pytest.raises(InputError, match="cannot be smoothed"):
        tracker.estimate(walk, seeds=seeds, smooth=True)
    mine = functools.partial(blob.moment.estimate, walk, seeds=seeds, progress=False)
    assert mine().smooth and not mine(smooth=False).smooth


@pytest.mark.slow
def test_single_precision(walk, float32):
    tracker = blob.constant_velocity
    params = params_of(tracker, events_per_step=4, t_still=STILL, cycle=1.0)
    times, seeds = np.arange(1000, 139_000, 9000), [(58.0, 62.0, 4.0)]
    result = follow(walk, params, seeds, tracker)(times)
    with jax.enable_x64(True):
        exact = follow(walk, params, seeds, tracker)(times)
    assert result.mean.dtype == np.float32
    np.testing.assert_allclose(result.mean[..., :2], exact.mean[..., :2], atol=5e-3)
    np.testing.assert_allclose(result.mean[..., 2:4], exact.mean[..., 2:4], rtol=2e-3, atol=0.5)
