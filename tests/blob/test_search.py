"""Targets found without settings, on small sensors and against slow, obvious computations."""

import dataclasses
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxevent import blob
from jaxevent.blob.filter import EventBatch
from jaxevent.blob.owners import NO_OWNER_INDEX, owner_candidates
from jaxevent.blob.params import max_events_per_step
from jaxevent.blob.search.background import (
    clutter_evidence,
    find_hot_lines,
    find_hot_pixels,
    measure_background,
)
from jaxevent.blob.search.merge import merge_parts, stitch_paths
from jaxevent.blob.search.paths import (
    TRIED_VELOCITY_NOISES,
    TargetPath,
    fit_velocity_noise,
    log_likelihood,
    tabulate_paths,
)
from jaxevent.blob.search.polarity import drop_lamps
from jaxevent.blob.search.search import TargetSearchResult, _is_persistent
from jaxevent.blob.search.stream import Stream
from jaxevent.blob.track import StepEvents, TrackBuffer, predict_and_gate
from jaxevent.errors import InputError, InputWarning
from jaxevent.io import load
from jaxevent.recording import Events, Recording
from jaxevent.simulate.blobs import CircularMotion, LinearMotion, Target, simulate_blobs

SMALL = (128, 96)


def scene(targets, duration=0.4, noise=2e3, seed=0):
    return simulate_blobs(targets, SMALL, duration, noise, seed)


@pytest.fixture(scope="module")
def crossed():
    """Two targets that pass through each other, their paths, and what is found of them."""
    targets = [
        Target(LinearMotion((64 - s * 40, 48.0), (s * 200.0, 0.0), size=(4.0, 3.0)), 2e4)
        for s in (1, -1)
    ]
    recording, truth = scene(targets)
    return recording, truth, blob.find(recording, progress=False)


@pytest.mark.slow
def test_two_that_cross_keep_their_identities(crossed):
    recording, truth, found = crossed
    assert len(found) == 2 and found.summary().startswith("2 targets")
    twice = dataclasses.replace(found, passes=found.passes * 2)
    assert twice.summary() == found.summary()
    tracker = blob.constant_velocity
    params = tracker.Params(**found.settings())
    tracks = tracker.estimate(recording, params, found=found, progress=False)
    times = np.arange(20_000, 390_000, 5000)
    forward = tracks.filtered
    states, true = tracks(times), truth(times)
    assert len(tracks) == 2 and states.valid.all()
    # Sizes that the backward pass reads are those of a pass of their own.
    for one, other in zip(tracks._usual_sizes, forward._usual_sizes, strict=True):
        np.testing.assert_array_equal(one, other)
    apart = np.linalg.norm(states.mean[:, :, None, :2] - true[:, None, :, :2], axis=-1)
    straight = apart[:, [0, 1], [0, 1]], apart[:, [0, 1], [1, 0]]
    assert min(np.sqrt((d**2).mean()) for d in straight) < 0.7
    # What is prepared and run by hand is the same.
    features, out = tracker.prepare(recording, times, params, found=found)
    again = jax.jit(lambda p: tracker.read(p, tracker.run(p, features)[0], out))(params)
    filtered = tracks.filtered(times)
    np.testing.assert_allclose(again.mean, filtered.mean, rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_what_the_user_sets_wins_over_what_is_found(crossed):
    _, _, found = crossed
    settings = found.settings()
    params = blob.moment.Params(**settings)
    assert (
        set(found.per_target_values(params))
        == set(settings) & set(found.per_target_values(params))
        != set()
    )
    assert "Q_v" in found.per_target_values(params)
    assert "Q_v" not in found.per_target_values(params.replace(Q_v=12.0))
    with pytest.raises(InputError, match="take no seeds"):
        blob.moment.estimate(crossed[0], found=found, seeds=[(10.0, 10.0, 3.0)])


def test_a_blob_is_found_whatever_share_of_the_events_it_sends():
    """Beside 15 events/s at each pixel it gives a fiftieth of them; a gain of all would hide it."""
    target = Target(CircularMotion((64, 48), 25.0, 6.0, size=(4.0, 3.0)), 4e3)
    recording, truth = scene([target], noise=15.0 * SMALL[0] * SMALL[1], seed=6)
    (path,) = blob.find(recording, progress=False).paths
    e = path.p - truth(path.t)[:, 0, :2]
    assert np.sqrt((e**2).sum(1).mean()) < 2 and path.t[-1] - path.t[0] > 0.8 * 0.4e6


@pytest.mark.slow
def test_noise_and_hot_pixels_are_no_targets():
    hot = [Target(LinearMotion((x, 40.0), size=(0.01, 0.01)), 2e3) for x in (20.0, 90.0)]
    recording, _ = scene(hot, noise=2e4, seed=3)
    found = blob.find(recording, progress=False)
    assert len(found) == 0 and found.hot_pixels == 2
    assert 0.8 * 2e4 < found.background < 1.4 * 2e4
    tracks = blob.constant_velocity.estimate(recording, found=found, progress=False)
    assert len(tracks) == 0 and tracks([0.1]).mean.shape == (1, 0, 8)


@pytest.mark.slow
def test_a_ring_and_a_pair_of_edges_are_one_target_each():
    ring = [Target(LinearMotion((44, 48), (100.0, 0.0), size=(25, 25)), 2e4, "ring")]
    edges = [
        Target(LinearMotion((x, 48), (120.0, 0.0), size=(9.0, 0.6), theta=np.pi / 2), 1e4)
        for x in (20, 40)
    ]
    for targets, middle, size, duration in ((ring, 44, 25, 0.4), (edges, 30, 10, 0.5)):
        recording, truth = scene(targets, duration)
        found = blob.find(recording, progress=False)
        assert len(found) == 1
        (path,) = found.paths
        speed = truth(np.array([0]))[0, 0, 2]
        apart = path.p - np.stack([middle + speed * path.t * 1e-6, np.full(len(path.t), 48)], 1)
        assert np.sqrt((apart**2).sum(1).mean()) < 0.2 * size
        assert np.median(path.size[:, 0]) == pytest.approx(size, rel=0.1)


def _path(t, x, y, size, n):
    t = np.asarray(t, np.int64)
    p = np.stack([np.broadcast_to(np.asarray(value, float), t.shape) for value in (x, y)], 1)
    C = np.broadcast_to(size**2 * np.eye(2), (len(t), 2, 2))
    return TargetPath(t, p, np.zeros_like(p), C, np.full(len(t), float(n)), 1000, 1.0)


def test_paths_in_contact_all_their_lives_are_one():
    t = np.arange(0, 50_000, 1000)
    x = 20 + 1e-3 * t
    one, other = _path(t, x, 30.0, 3.0, 30), _path(t, x, 39.0, 3.0, 10)
    far, crossing = _path(t, x, 45.0, 3.0, 10), _path(t, x[::-1], 39.0, 3.0, 10)
    resting = [_path(t, 20.0, y, 3.0, 10) for y in (30.0, 39.0)]
    overtaking = _path(t, 11 + 1.36e-3 * t, 31.0, 3.0, 10)
    for pair in ([one, far], [one, crossing], [one, overtaking], resting):
        assert len(merge_parts(pair)) == 2
    (both,) = merge_parts([other, one])
    np.testing.assert_allclose(both.p, np.stack([x, np.full(len(t), 32.25)], 1))
    weight = np.array([0.75, 0.25])
    spread = np.cov([30.0, 39.0], aweights=weight, ddof=0)  # and that of each part
    np.testing.assert_allclose(
        both.C, np.broadcast_to(np.diag([9.0, 9 + float(spread)]), both.C.shape)
    )


@pytest.mark.slow
def test_two_that_begin_together_and_part_are_two():
    """Where cells are coarse, they are one blob until they are far apart."""
    starts = [((60.0, 40.0), (-90.0, 0.0)), ((70.0, 44.0), (90.0, 5.0))]
    targets = [Target(LinearMotion(p, v, size=(4.0, 3.0)), 2e4) for p, v in starts]
    recording, truth = scene(targets, 0.6)
    found = blob.find(recording, progress=False)
    assert len(found) == 2
    t = np.array([350_000, 550_000])
    ends = np.stack([path.at(t) for path in found.paths], 1)
    apart = ends[:, :, None] - truth(t)[:, None, :, :2]
    near = np.hypot(apart[..., 0], apart[..., 1]).min(1)
    assert (near < 2).all()


def test_two_outlines_that_begin_in_one_blob_and_part_are_two():
    starts = [((46.0, 44.0), (-20.0, 0.0)), ((54.0, 46.0), (20.0, 5.0))]
    targets = [Target(LinearMotion(p, v, size=(3.3, 3.3)), 4e3, "ring") for p, v in starts]
    recording, truth = scene(targets, 1.5)
    found = blob.find(recording, progress=False)
    assert len(found) == 2
    t = np.array([900_000, 1_400_000])
    apart = np.stack([path.at(t) for path in found.paths], 1)[:, :, None] - truth(t)[:, None, :, :2]
    assert (np.hypot(apart[..., 0], apart[..., 1]).min(1) < 1).all()


def test_what_is_seen_shortly_and_goes_no_way_is_left_out():
    for rows, leaves, duration, lasts in (
        (15, 0.3, 1, True),
        (15, 0.5, 1, False),
        (16, 0.5, 1, True),
        (15, 0.5, 0.02, True),
    ):
        path = _path(np.arange(0, 1000 * rows, 1000), 20.0, 30.0, 3.0, 30)
        # In a window the noise q of the velocity makes a deviation of sqrt(q w^3 / 3).
        path = dataclasses.replace(path, velocity_noise=3 * (leaves * 3.0) ** 2 / 1e-9)
        assert _is_persistent(path, duration) == lasts


def test_pieces_of_an_edge_are_one_while_each_is_seen():
    t = np.arange(0, 50_000, 1000)
    x = 20 + 1e-3 * t
    ends = slice(0, 50), slice(10, 50), slice(12, 40)
    pieces = [
        dataclasses.replace(
            _path(t[k], x[k], y, 1.0, 10), C=np.tile(np.diag([0.25, 16.0]), (len(t[k]), 1, 1))
        )
        for k, y in zip(ends, (0.0, 18.0, 36.0), strict=True)  # 2.25 sizes apart
    ]
    (edge,) = merge_parts(pieces)
    seen = np.stack([(t >= t[k][0]) & (t <= t[k][-1]) for k in ends])
    y = (seen * [[0.0], [18.0], [36.0]]).sum(0) / seen.sum(0)
    np.testing.assert_array_equal(edge.t, t)
    np.testing.assert_allclose(edge.p, np.stack([x, y], 1))
    np.testing.assert_allclose(edge.n, 10 * seen.sum(0))
    spread = (seen * ([[0.0], [18.0], [36.0]] - y) ** 2).sum(0) / seen.sum(0)
    np.testing.assert_allclose(edge.C[:, 1, 1], 16 + spread)
    round_ones = [dataclasses.replace(one, C=16 * np.tile(np.eye(2), (len(one.t), 1, 1)))
        for one in pieces]  # fmt: skip
    assert len(merge_parts(round_ones)) == 3  # as far apart, but no edges
    for n, number in ((10, 2), (50, 1)):  # one that follows another, or is a piece of it
        follow = [_path(t, x, 0.0, 1.0, n), _path(t, x - 18, 0.0, 1.0, 10)]
        C = np.tile(np.diag([16.0, 0.25]), (len(t), 1, 1))
        assert len(merge_parts([dataclasses.replace(one, C=C) for one in follow])) == number


@pytest.mark.parametrize(
    ("radius", "turns", "wobble", "joined"),
    [(13, 1.5, 0, True), (13, 0.8, 0, False), (13, 1.5, 0.2, False), (30, 1.5, 0, False)],
)
def test_what_turns_rigidly_by_a_whole_turn_is_one(radius, turns, wobble, joined):
    t = np.arange(0, 200_000, 1000)
    angle = 2 * np.pi * turns * t / t[-1]
    reach = radius * (1 + wobble * np.sin(5 * angle))
    blades = [
        _path(t, 60 + reach * np.cos(a), 50 + reach * np.sin(a), 3.0, 10)
        for a in (angle, angle + 2 * np.pi / 3, angle + 4 * np.pi / 3)
    ]
    paths = merge_parts(blades)
    assert len(paths) == (1 if joined else 3)
    if joined:
        np.testing.assert_allclose(paths[0].p, np.tile([60.0, 50.0], (len(t), 1)), atol=1e-9)


def test_what_passes_behind_something_goes_on():
    """It is seen in part before it is hidden, and after."""
    t = np.arange(0, 30_000, 1000)
    one, other = _path(t, 20 + 2e-3 * t, 50.0, 6.0, 30), _path(t, 164 + 2e-3 * t, 50.0, 6.0, 30)
    in_part = np.linspace(1, 0.1, 6)
    back = np.where(np.arange(30) < 24, 0, 9 * (1 - np.r_[np.ones(24), in_part]))
    share = np.r_[np.ones(24), in_part]
    C = one.C * share[:, None, None] ** 2
    one = dataclasses.replace(one, p=one.p - back[:, None] * [1, 0], C=C, n=30 * share)
    other = dataclasses.replace(
        other, t=t + 72_000, p=other.p + back[::-1, None] * [1, 0], C=C[::-1], n=30 * share[::-1]
    )
    assert len(stitch_paths([one, other], (400, 100), 110)) == 1
    aside = dataclasses.replace(other, p=other.p + [0.0, 30.0])
    assert len(stitch_paths([one, aside], (400, 100), 110)) == 2
    # Never of its usual size and events at once.
    odd = np.arange(30) % 2 > 0
    C = np.where(odd[:, None, None], 1.0, 36.0) * np.eye(2)
    one = dataclasses.replace(_path(t, 20 + 2e-3 * t, 50.0, 6.0, 30), C=C, n=np.where(odd, 30.0, 1))
    later = _path(t + 31_000, 82 + 2e-3 * t, 50.0, 6.0, 30)
    assert len(stitch_paths([one, later], (400, 100), 110)) == 1


def test_what_leaves_does_not_go_on_as_another_that_was_there_before():
    """A ball leaves by the lower edge beside an arm that is there all the time."""
    t = np.arange(0, 60_000, 1000)
    ball, arm = _path(t[:20], 60.0, 20 + 4e-3 * t[:20], 6.0, 30), _path(t, 62.0, 90.0, 6.0, 30)
    assert len(stitch_paths([ball, arm], (120, 100), 60)) == 2
    for gap, number in ((2, 1), (30, 2)):  # windows; silence beyond the edge is no evidence
        other = _path(t[:20] + 20_000 + 1000 * gap, 60.0, 98.0, 6.0, 30)
        assert len(stitch_paths([ball, other], (120, 100), 60)) == number


def test_a_target_over_a_quarter_of_the_sensor_is_not_compact():
    recording, _ = scene([Target(LinearMotion((60, 40)), 1e3)], 0.1)
    for size, compact in ((10.0, True), (40.0, False)):
        found = TargetSearchResult(
            (_path(np.arange(3) * 1000, 60.0, 40.0, size, 9),), (), 0, 0.0, recording
        )
        assert found.compact == compact and found.score == 0


def test_clutter_counts_where_a_gate_holds_more_of_it_than_of_the_target():
    recording, _ = scene([Target(LinearMotion((60, 40)), 1e3)], 0.1)
    noise = 0.5 * SMALL[0] * SMALL[1]  # a gate of three sizes has 9 pi size^2 of its pixels
    for size, clutter in ((3.0, 0.0), (10.0, 0.5 / 1000)):
        path = _path(np.arange(3) * 1000, 60.0, 40.0, size, 1)  # 1000 events/s
        found = TargetSearchResult((path,), (), 0, noise, recording)
        assert found.settings()["clutter"] == pytest.approx(clutter)


def test_two_in_contact_that_go_their_own_ways_are_two():
    t = np.arange(0, 60_000, 1000)
    x, swing = 20 + 1.5e-3 * t, 5 * np.sin(t / 4e3)
    one, other, rigid = (_path(t, x, 30 + y, 3.0, 10) for y in (swing, 8 - swing, 8 + swing))
    moving = [
        dataclasses.replace(path, v=np.gradient(path.p, t * 1e-6, axis=0))
        for path in (one, other, rigid)
    ]
    assert len(merge_parts([moving[0], moving[1]])) == 2
    assert len(merge_parts([moving[0], moving[2]])) == 1


def test_the_two_edges_of_a_slow_disc_are_one():
    """In windows its outline has few events; its sides, which send least, have none."""
    motion = LinearMotion((40.0, 48.0), (20.0, 0.0), size=(9.8, 6.9))  # radius 12 px
    recording, truth = scene([Target(motion, 2880, shape="disc")], 1.0, 6e3)
    (path,) = blob.find(recording, progress=False).paths
    apart = path.p - truth(path.t)[:, 0, :2]
    assert np.hypot(*apart.mean(0)) < 1.5
    # Of a rim with |cos| of the angle to the heading, along it and across.
    np.testing.assert_allclose(path.size[0], [9.8, 6.9], rtol=0.3)


@pytest.mark.parametrize(
    ("on", "heading", "alone"), [(0.99, 0, True), (0.5, 0, False), (0.99, 1, False)]
)
def test_an_edge_across_its_way_of_one_polarity_is_alone(on, heading, alone):
    rng = np.random.default_rng(2)
    n, duration = 6000, 1.0
    t = np.sort(rng.uniform(0, duration, n))
    p = np.stack([25 + rng.normal(0, 0.5, n), 30 + rng.uniform(-8, 8, n)], 1)
    p[:, heading] += 30 * t
    noise = rng.uniform(0, 1, (3000, 2)) * (np.array(SMALL) - 1)
    t = np.concatenate([t, rng.uniform(0, duration, len(noise))])
    x, y = np.rint(np.concatenate([p, noise])).T.astype(np.uint16)
    order = np.argsort(t)
    signs = rng.random(len(t)) < np.where(np.arange(len(t)) < n, on, 0.5)
    events = Events(*(v[order] for v in ((1e6 * t).astype(np.int64), x, y, signs)))
    (path,) = blob.find(Recording("edge", *SMALL, events), progress=False).paths
    assert path.lone_edge == alone


@pytest.mark.slow
def test_recordings_of_few_events_have_no_targets():
    for count in (0, 1, 99):
        t, none = np.arange(count, dtype=np.int64), np.zeros(count, np.uint16)
        recording = Recording("few", *SMALL, Events(t, none, none, none.astype(bool)))
        assert len(blob.find(recording, progress=False)) == 0
        with pytest.warns(InputWarning, match="few: no target was found"):
            assert len(blob.constant_velocity.estimate(recording, progress=False)) == 0


class Stopping:
    """At rest and without events from 0.3 to 0.6 s, then back."""

    def state(self, t):
        out = np.zeros((len(t), 8))
        out[:, 0] = 30 + 150 * np.minimum(t, 0.3) - 100 * np.maximum(t - 0.6, 0)
        out[:, 1], out[:, 4:6] = 50, (4.0, 3.0)
        return out


@pytest.fixture(scope="module")
def stopped():
    recording, truth = scene([Target(Stopping(), 1e4, dropouts=((0.3, 0.6),))], 0.9)
    return recording, truth, blob.find(recording, progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["moment", "constant_velocity"])
def test_a_silent_target_stands_still(method, stopped):
    recording, truth, found = stopped
    assert len(found) == 1
    tracker = getattr(blob, method)
    tracks = tracker.estimate(
        recording, tracker.Params(**found.settings()), found=found, progress=False
    )
    times = np.array([0.2, 0.35, 0.45, 0.58, 0.75])
    states, true = tracks(times), truth(times)[:, 0]
    assert states.valid.all()
    spread = tracks.filtered(times).covariance[:, 0, 0, 0]
    assert np.abs(states.mean[:, 0, :2] - true[:, :2]).max() < 1.5
    assert (states.covariance[:, 0, 0, 0] < spread + 1e-6).all()
    np.testing.assert_array_equal(states.mean[1:4, 0, 2:4], 0)
    # The filter's size holds; the smoothed one goes over to that of the events that follow.
    sizes = tracks.filtered(times).mean[1:4, 0, 4:6]
    np.testing.assert_allclose(sizes, np.broadcast_to(sizes[0], sizes.shape), rtol=1e-6)
    assert spread[1] < spread[2] < spread[3] and spread[4] < spread[3]


def test_evidence_bounds_the_tail_of_poisson():
    n, mu = np.meshgrid(np.arange(1, 60), [0.01, 0.3, 2.0, 20.0])
    bound = np.exp(-clutter_evidence(n, mu, 1.0))
    assert (bound * (1 + 1e-9) >= stats.poisson.sf(n - 1, mu)).all()
    assert (clutter_evidence(n, mu, 2.0) * 2 == clutter_evidence(n, mu, 1.0)).all()
    assert (clutter_evidence(n, mu, 1.0)[n <= mu] == 0).all()


def test_hot_pixels_stand_alone():
    rng = np.random.default_rng(0)
    counts = rng.poisson(3.0, (40, 50))
    counts[10, 20] = counts[0, 7] = counts[39, 49] = 200
    counts[30:33, 30:33] = 300  # something that rests
    expected = np.zeros(counts.shape, bool)
    expected[10, 20] = expected[0, 7] = expected[39, 49] = True
    np.testing.assert_array_equal(find_hot_pixels(counts), expected)


def test_hot_lines_are_hot_along_the_whole_sensor():
    rng = np.random.default_rng(0)
    counts = rng.poisson(1.0, (40, 50))
    counts[:, [0, 12, 13, 49]] += rng.poisson(30, (40, 4))
    counts[21] += rng.poisson(20, 50)
    counts[5:20, 30] = 60  # part of a line
    counts[:, 36:40] += 30  # something wide
    expected = np.zeros(counts.shape, bool)
    expected[:, [0, 12, 13, 49]] = expected[21] = True
    np.testing.assert_array_equal(find_hot_lines(counts), expected)
    assert not find_hot_lines(rng.poisson(100.0, (40, 50))).any()


def lamp(rng, at, hertz, seconds, number, late=1e-3):
    """Events of a square of 12 px: ON as its light begins, OFF as it ends, exponentially late."""
    half = rng.integers(0, int(2 * hertz * seconds), number)
    t = half / (2 * hertz) + rng.exponential(late, number)
    return t, at + rng.uniform(-6, 6, (number, 2)), half % 2 == 0


def drop_of(parts, paths):
    """`drop_lamps` of events (t, places, polarities) of several lights."""
    t, xi, on = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(t)
    us, (x, y) = np.rint(1e6 * t[order]).astype(np.int64), np.rint(xi[order]).T.astype(np.uint16)
    events = Events(us, x, y, on[order])[x < SMALL[0]]
    recording = Recording("lamps", *SMALL, events)
    return drop_lamps(paths, Stream(recording, int(us[0]), int(us[-1]) + 1))


AT = np.arange(10_000, 2_000_000, 20_000)


@pytest.mark.parametrize(
    ("hertz", "way", "late", "left_out"),
    [
        (100.0, 0, 1e-3, True),
        (119.6, 0, 1e-3, True),  # of a weak net
        (100.0, 60, 1e-3, False),  # it travels: a lamp that is carried
        (110.0, 0, 1e-3, False),  # of no mains
        (100.0, 0, 5e-3, False),  # hardly in time: its coherence is .09
    ],
)
def test_lamps_are_told_by_their_flicker(hertz, way, late, left_out):
    """Beside a light that stands still too, and sends as many events whenever it likes."""
    rng, number = np.random.default_rng(3), 1500
    t, xi, on = lamp(rng, [40.0, 40.0], hertz, 2.0, number, late)
    xi[:, 0] += way * t / 2
    light = rng.uniform(0, 2, number), rng.random(number) < 0.5
    other = light[0], [100.0, 60.0] + rng.normal(size=(number, 2)) * 4, light[1]
    paths = [
        dataclasses.replace(_path(AT, x + moves * AT / 2e6, y, 12**0.5, 15), window=20_000)
        for x, y, moves in ((40.0, 40.0, way), (100.0, 60.0, 0))
    ]
    kept, lamps = drop_of([(t, xi, on), other], paths)
    assert lamps == left_out and kept == paths[left_out:]


@pytest.mark.parametrize(("leaves", "left_out"), [(1.4, 1), (0.6, 0)])
def test_a_track_that_hops_from_a_lamp_is_the_lamp_s_if_it_is_mostly_there(leaves, left_out):
    """Of 2 s; what it goes on with then travels and sends events whenever it likes."""
    rng = np.random.default_rng(4)
    t, xi, on = lamp(rng, [40.0, 40.0], 100.0, 2.0, 3000)
    away = np.flatnonzero(t > leaves)
    t[away], on[away] = rng.uniform(leaves, 2, len(away)), rng.random(len(away)) < 0.5
    places = np.c_[40 + 60 * (t[away] - leaves), 0 * away + 40]
    xi[away] = places + 2 * rng.normal(size=(len(away), 2))
    path = _path(AT, 40 + 60 * np.maximum(AT * 1e-6 - leaves, 0), 40, 3.5, 30)
    kept, lamps = drop_of([(t, xi, on)], [path])
    assert lamps == left_out and len(kept) == 1 - left_out


@pytest.mark.slow
def test_a_lamp_behind_a_target_is_no_target():
    recording, truth = scene(
        [Target(CircularMotion((64, 48), 30, 5.0, 0.0, size=(3.0, 2.5)), 1e4)], 1.0
    )
    t, xi, on = lamp(np.random.default_rng(1), [94.0, 48.0], 100.0, 1.0, 4000)
    x, y = np.rint(xi).T.astype(np.uint16)
    e, us = recording.events, np.rint(1e6 * t).astype(np.int64)
    parts = (e.t, us), (e.x, x), (e.y, y), (e.p, on)
    us, x, y, p = (np.concatenate(part) for part in parts)
    order = np.argsort(us, kind="stable")
    both = dataclasses.replace(recording, events=Events(*(a[order] for a in (us, x, y, p))))
    found = blob.find(both[0.0:1.0], progress=False)
    assert len(found) == 1 and found.lamps == 1 and "1 lamp left out" in found.summary()
    apart = np.linalg.norm(found.paths[0].p - truth(found.paths[0].t)[:, 0, :2], axis=1)
    assert np.median(apart) < 1.5


def test_background_is_that_without_the_targets():
    swinging = Target(CircularMotion((64, 48), 25, 12.0, size=(3.0, 3.0)), 2e4)
    recording, _ = scene([swinging], 1.0, noise=2e4)
    stream = Stream(recording, 0, 1_000_000)
    rate = measure_background(stream).rate
    assert rate.shape == (24, 32)
    true = 2e4 / (SMALL[0] * SMALL[1])
    assert 0.8 * true < np.median(rate) < 1.3 * true
    assert rate.max() < 4 * true  # the target alone makes 20 times as many where it passes


@pytest.mark.slow
def test_candidates_are_those_of_a_slow_loop():
    rng = np.random.default_rng(1)
    paths = []
    for k in range(4):
        t = np.sort(rng.choice(np.arange(5, 95), 50, replace=False)) * 1000
        C = np.stack([np.diag(rng.uniform(2, 9, 2)) + 1.0 for _ in t])
        n = rng.uniform(5, 50, len(t))
        p = np.stack([30 + 0.5e-3 * t, np.full(len(t), 40.0 + 4 * k)], 1)
        polarity = 1 if k == 3 else None
        paths.append(TargetPath(t, p, np.zeros_like(p), C, n, 1000, 1.0, polarity))
    t = 2 * np.sort(rng.integers(0, 50_000, 1000)) + 1  # never half a window from a row
    x, y = rng.integers(20, 90, 1000), rng.integers(35, 60, 1000)
    on = rng.random(1000) < 0.5
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), on)
    told = owner_candidates(events, tabulate_paths(paths), 3.0)

    def distance(path, i):
        """Minus twice the log likelihood, up to a constant; inf: it is not near."""
        seen = np.abs(path.t - t[i]).min() <= path.window / 2
        if not seen or path.polarity not in (None, on[i]):
            return np.inf
        S = path.C * (1 + 2 / path.n)[:, None, None] + 0.1 * np.eye(2)
        S = np.array([[np.interp(t[i], path.t, S[:, a, b]) for b in (0, 1)] for a in (0, 1)])
        e = np.array([x[i], y[i]]) - path.at(t[i : i + 1])[0]
        squared = e @ np.linalg.solve(S, e)
        return squared + np.log(np.linalg.det(S)) if squared <= 9 else np.inf

    several = 0
    for i in range(1000):
        far = np.array([distance(path, i) for path in paths])
        mine = np.argsort(far)[: min(np.isfinite(far).sum(), 2)]
        assert told[i].tolist() == [*mine, NO_OWNER_INDEX, NO_OWNER_INDEX][:2]
        several += np.isfinite(far).sum() > 2
    assert several > 5


@pytest.mark.slow
def test_events_near_two_paths_are_taken_by_no_third_target():
    params, filter = blob.moment.Params(), blob.moment.filter
    xi = jnp.array([[20.0, 20], [20, 21], [21, 20], [90, 90], [90, 90]])
    owner = jnp.array([[0, 1], [1, 2], [2, NO_OWNER_INDEX], [0, NO_OWNER_INDEX], [0, 1]])
    batch = EventBatch(xi, jnp.zeros(5), jnp.ones(5))
    state = filter.init(params, jnp.array([20.0, 20]), jnp.array(5.0))
    zero = jnp.zeros((), jnp.int32)
    inside = []
    for k in range(3):
        slot = TrackBuffer(
            state, jnp.array(20.0), jnp.array(0.0), zero, zero, zero, zero, zero + k, zero == 0, {}
        )
        events = StepEvents(zero, batch, jnp.ones(5, bool), owner)
        inside.append(predict_and_gate(filter, params, slot, zero + 1, events).inside)
    # Of one path alone even what its filter does not expect there; of two only what it does.
    assert np.array_equal(inside, [[1, 0, 0, 1, 0], [1, 1, 0, 0, 0], [0, 1, 1, 0, 0]])


def test_agility_is_the_most_likely():
    rng = np.random.default_rng(2)
    dt, q, R = 0.01, 3e4, 0.5
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    steps = rng.multivariate_normal([0, 0], Q, (400, 2))
    state, m = np.zeros((2, 2)), []
    for step in steps:
        state = np.stack([state[:, 0] + dt * state[:, 1], state[:, 1]], 1) + step
        m.append(state[:, 0] + rng.normal(0, np.sqrt(R), 2))
    m, t = np.array(m), dt * np.arange(400)
    found = fit_velocity_noise(t, m, np.full(400, R), 1e6)
    assert q / 2.5 < found < 2.5 * q and np.isclose(TRIED_VELOCITY_NOISES * 1e6, found).any()


def test_the_likelihood_of_places_is_the_density_of_all_of_them():
    """Given the first place: its error, the first velocity and the integrated noise add up."""
    rng = np.random.default_rng(4)
    t, c, q = np.cumsum(rng.uniform(0.5, 1.5, 9)), 2.0, rng.uniform(0.1, 3, 8)
    R, z = rng.uniform(0.5, 1, 9), rng.normal(0, 1, (9, 2))
    S = R[0] + c * np.outer(t - t[0], t - t[0])
    for k in range(8):  # acceleration between t[k] and t[k + 1], integrated twice by Simpson's rule
        u = np.linspace(t[k], t[k + 1], 3)
        reach = np.maximum(t[:, None] - u, 0)
        weight = np.array([1, 4, 1]) * (t[k + 1] - t[k]) / 6
        S += q[k] * (reach * weight) @ reach.T
    S = (S + np.diag(R))[1:, 1:]
    total = sum(stats.multivariate_normal(np.full(8, x[0]), S).logpdf(x[1:]) for x in z.T)
    ours = log_likelihood(t, z, R, c, q)
    assert ours == pytest.approx(total + 8 * np.log(2 * np.pi), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [0.02, 0.1, 0.5])
def test_steps_of_several_events_keep_the_accuracy_asked_for(accuracy):
    size, rate, velocity_noise = 6.0, 5e4, 2e6
    M = float(
        max_events_per_step(
            accuracy, np.array([size]), np.array([rate]), np.array([velocity_noise])
        )[0]
    )

    def sigma(M):
        """Of the position just before an update, by Riccati's equation step by step."""
        dt, P = M / rate, np.diag([size**2, 1e6])
        F = np.array([[1, dt], [0, 1]])
        Q = velocity_noise * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        for _ in range(round(5e3 / M)):
            P = F @ P @ F.T + Q
            before, K = P[0, 0], P[:, 0] / (P[0, 0] + size**2 / M)
            P = P - np.outer(K, P[0])
        return np.sqrt(before)

    told = sigma(M) / sigma(1) - 1
    assert 0.3 * accuracy < told <= accuracy


def test_steps_follow_the_accuracy():
    t = np.arange(0, 1_000_000, 10_000)
    path = dataclasses.replace(_path(t, 50 + 1e-5 * t, 60 + 0 * t, 5.0, 3.0), velocity_noise=1e3)
    recording = Recording("none", 100, 100, Events.empty())
    one = TargetSearchResult((path,), (), 0, 0.0, recording)
    two = TargetSearchResult((path, path), (), 0, 0.0, recording)
    told = [one.settings(a)["events_per_step"] for a in (1e-4, 0.02, 0.1, 1.0)]
    # The time constant is that of 161 events.
    assert told == [1, 4, 16, 32]
    assert two.settings(0.02)["events_per_step"] == 8
    for bad in (0.0, -1.0, 7.0, np.nan):
        with pytest.raises(InputError, match="accuracy"):
            one.settings(bad)


@pytest.mark.slow
def test_targets_do_not_depend_on_the_clock(crossed):
    recording, _, found = crossed
    events = recording.events[:]
    late = dataclasses.replace(events, t=events.t + 7_000_000_000)
    again = blob.find(dataclasses.replace(recording, events=late), progress=False)
    for one, other in zip(found.paths, again.paths, strict=True):
        np.testing.assert_array_equal(other.t - one.t, 7_000_000_000)
        np.testing.assert_allclose(other.p, one.p, atol=1e-4)


@pytest.mark.slow
def test_times_beyond_the_recording_change_nothing(crossed):
    recording, _, found = crossed
    params = blob.moment.Params(**found.settings())
    want = blob.moment.estimate(recording, params, found=found)
    again = blob.find(recording, -1.0, 20.0, progress=False)
    assert again.background == found.background
    for one, other in zip(found.paths, again.paths, strict=True):
        np.testing.assert_array_equal(other.p, one.p)
    tracks = blob.moment.estimate(recording, params, found=again, start=-1.0, stop=20.0)
    assert (tracks.start, tracks.stop) == (want.start, want.stop)
    np.testing.assert_array_equal(tracks.death, want.death)
    seeded = blob.moment.estimate(recording, params, seeds=[(64, 48, 4, -0.5)], start=-1.0)
    assert seeded.birth[0] == want.start
    with pytest.raises(InputError, match="from 400001 us to 900000 us; the events reach"):
        blob.find(recording, 400_001, 900_000)


@pytest.mark.skipif("JAXEVENT_DATA" not in os.environ, reason="JAXEVENT_DATA is not set")
@pytest.mark.slow
def test_cars_on_a_street_and_a_spinning_dot_are_found():
    data = Path(os.environ["JAXEVENT_DATA"]) / "data"
    street = blob.find(load(data / "davis346_street.npz"), progress=False)
    lives = [(path.end - path.begin) * 1e-6 for path in street.paths]
    assert sum(life > 1.5 for life in lives) == 3 and all(x < 0.2 for x in lives if x < 1.5)
    dot = load(data / "spinning_dot.npz")
    tracks = blob.moment.estimate(dot, progress=False)
    assert len(tracks) == 1 and tracks.death[0] - tracks.birth[0] > 0.9 * 50_000
    t = np.linspace(0.003, 0.0495, 400)
    states = tracks(t).mean[:, 0]
    radius = np.hypot(states[:, 0] - 314.29, states[:, 1] - 202.35)
    speed = np.hypot(states[:, 2], states[:, 3])
    assert abs(radius.mean() - 107.66) < 1.5 and abs(np.median(speed) / 13117 - 1) < 0.03
