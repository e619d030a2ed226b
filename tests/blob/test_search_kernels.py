"""Compiled loops of `jaxevent.blob.search` beside slow programs with the same results."""

import numpy as np
import pytest
from scipy import ndimage

from jaxevent.blob import moment
from jaxevent.blob.prepare import ChunkPacker
from jaxevent.blob.search import stream as stream_module
from jaxevent.blob.search.background import (
    CELL_PX,
    FINE_CELL_PX,
    N_TIME_SLICES,
    Background,
    clutter_evidence,
    measure_dispersions,
)
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Blobs,
    Scale,
    clutter_model,
    detect,
    measure_blobs,
    split_blob,
)
from jaxevent.blob.search.paths import TargetPath
from jaxevent.blob.search.polarity import prefer_sharper
from jaxevent.blob.search.prediction import KERNEL_RADII_PX, predict, sample_scored, score
from jaxevent.blob.search.search import TargetSearchResult
from jaxevent.blob.search.stream import PixelCounts, Stream, WindowEvents
from jaxevent.blob.search.window_tracker import assign, init_tracks, predict_gates, update_tracks
from jaxevent.recording import Events, Recording

SHAPE = HEIGHT, WIDTH = 64, 96
CELLS = HEIGHT // CELL_PX, WIDTH // CELL_PX
DURATION = 0.5
SCALE = Scale(0.04, 4, np.ones(CELLS))


def detect_at(events, background, scale, t):
    return detect(events, clutter_model(background, scale, SHAPE, t), SHAPE)


def predict_at(stream, background, t):
    """The windows before t, the events that are scored, and what `SCALE` predicts of them."""
    w = SCALE.window
    before = stream.pixel_counts(t - 2 * w, t - w), stream.pixel_counts(t - w, t)
    scored = sample_scored(stream, background, t, w)
    clutter = clutter_model(background, SCALE, SHAPE, t)
    return before, scored.pixels, predict(before, scored, [clutter], SHAPE)[0]


@pytest.fixture(scope="module")
def stream():
    """Noise and three spots, two of which go."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(0, 500_000, 6000))
    x, y = rng.integers(0, WIDTH, 6000), rng.integers(0, HEIGHT, 6000)
    for k, (x0, y0, v) in enumerate([(20, 20, 60), (50, 40, 40), (70, 20, 0)]):
        of = rng.random(6000) < 0.2
        x[of] = np.clip(x0 + v * t[of] * 1e-6 + rng.normal(0, 1.5 + k, of.sum()), 0, WIDTH - 1)
        y[of] = np.clip(y0 + rng.normal(0, 2, of.sum()), 0, HEIGHT - 1)
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), np.zeros(6000, bool))
    return Stream(Recording("spots", WIDTH, HEIGHT, events), 0, 500_000)


@pytest.fixture(scope="module")
def background():
    rng = np.random.default_rng(6)
    return Background(
        rng.uniform(0.2, 0.6, (HEIGHT // FINE_CELL_PX, WIDTH // FINE_CELL_PX)),
        rng.random((N_TIME_SLICES, *CELLS)) < 0.8,
        rng.random(CELLS) < 0.5,
        rng.uniform(1, 1.3, N_TIME_SLICES),
        DURATION,
    )


@pytest.mark.parametrize("most", [5000, 700])
def test_pixels_are_those_of_the_events(stream, most):
    part = stream.window(0.1, 0.3)
    pixels, number = stream.sample(0.1, 0.3, most)
    some = np.linspace(0, len(part) - 1, min(len(part), most)).astype(int)
    places, counts = np.unique((part.y * WIDTH + part.x)[some], return_counts=True)
    order = np.argsort(pixels.y * WIDTH + pixels.x)
    assert number == len(part)
    np.testing.assert_array_equal((pixels.y * WIDTH + pixels.x)[order], places)
    np.testing.assert_array_equal(pixels.n[order], counts)


@pytest.mark.slow
@pytest.mark.parametrize("g", [2, 4])
def test_blobs_are_neighbouring_cells_with_more_events_than_background(stream, background, g):
    scale = Scale(0.02, g, np.full(CELLS, 1.3))
    part = stream.window(0.1, 0.12)
    counts = np.zeros((HEIGHT // g, WIDTH // g))
    np.add.at(counts, (part.y // g, part.x // g), 1)
    around = ndimage.convolve(counts, np.ones((3, 3)), mode="constant")
    y, x = np.mgrid[: HEIGHT // g, : WIDTH // g] * g + g // 2
    mu = background.rate_at(x, y, 0.11) * 0.02 * 9 * g * g
    enough = np.log(counts.size * DURATION / 0.02 / CONFIG.false_alarms)
    hit = (counts > 0) & (clutter_evidence(around, mu, 1.3) > enough)
    labels = np.zeros(hit.shape, np.int32)
    ndimage.label(hit, np.ones((3, 3)), labels)
    number = int(labels.max())
    assert number > 1
    told, blobs = detect_at(part, background, scale, 0.11)
    assert blobs == number
    blob_of = labels[part.y // g, part.x // g]
    pairs = {(0, 0), *((int(told[i]), int(blob_of[i])) for i in np.flatnonzero(blob_of))}
    assert len(pairs) == number + 1 and ((told > 0) == (blob_of > 0)).all()
    to = np.array([blob for _, blob in sorted(pairs)])
    measured = measure_blobs(part, told, blobs)
    for k in range(number):
        xy = np.stack([part.x, part.y])[:, told == k + 1]
        assert measured.n[k] == xy.shape[1]
        np.testing.assert_allclose(measured.p[k], xy.mean(1))
        np.testing.assert_allclose(measured.C[k], np.cov(xy, ddof=0) + np.eye(2) / 12, atol=1e-10)
    # Pixels with counts say the same as events.
    pixels = stream.pixel_counts(0.1, 0.12)
    told, _ = detect_at(pixels, background, scale, 0.11)
    np.testing.assert_array_equal(to[told], labels[pixels.y // g, pixels.x // g])
    for one, other in zip(measure_blobs(pixels, told, blobs), measured, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)


@pytest.mark.slow
def test_what_is_predicted_is_the_sum_over_blobs_and_kernels(stream, background):
    t = 0.2
    (first, second), part, told = predict_at(stream, background, t)
    before = measure_blobs(first, *detect_at(first, background, SCALE, t))
    labels, number = detect_at(second, background, SCALE, t)
    last = measure_blobs(second, labels, number)
    assert number > 2 and told.blob_events[0] == last.n.sum()
    ellipses, kernels, moved = np.zeros(len(part)), np.zeros((len(part), 3)), []
    for n, p, C in zip(*last, strict=True):
        k = np.argmin(np.hypot(*(before.p - p).T))
        known = np.hypot(*(before.p[k] - p)) < 6 * np.sqrt(np.linalg.eigvalsh(C)[1]) + 2
        moved.append((p - before.p[k]) * known)
        S = C * (1 + 4 / n) + 0.1 * np.eye(2)
        S = S + 2 * (C / n + before.C[k] / before.n[k]) * known
        e = np.stack([part.x, part.y], 1) - (p + moved[-1])
        squared = np.einsum("ni,ij,nj->n", e, np.linalg.inv(S), e)
        ellipses += n * np.exp(-squared / 2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
    np.testing.assert_allclose(told.density[:, 0], ellipses, rtol=1e-9, atol=1e-15)
    for j, (r, g) in enumerate(zip(KERNEL_RADII_PX, (2, 4, 8), strict=True)):
        for i in np.flatnonzero(labels):
            x, y = np.array([second.x[i], second.y[i]]) + moved[labels[i] - 1]
            x, y = (np.floor(x / g) + 0.5) * g, (np.floor(y / g) + 0.5) * g
            u = 1 - ((x - part.x) ** 2 + (y - part.y) ** 2) / r**2
            kernels[:, j] += second.n[i] * np.where(u > 0, u, 0) ** 2 * 3 / (np.pi * r**2)
    np.testing.assert_allclose(told.density[:, 1:], kernels, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_scores_are_the_likelihood_of_the_best_shares(stream, background):
    told = [predict_at(stream, background, t)[2] for t in (0.2, 0.3)]
    n = np.concatenate([one.scored.pixels.n for one in told])
    assert n.sum() == sum(one.scored.n_window_events for one in told) > len(n)
    density = np.concatenate([one.density for one in told]).repeat(n, 0)
    b = np.concatenate([one.scored.background for one in told]).repeat(n)
    share = np.full(4, 0.25)
    for _ in range(15):
        share = share * ((1 / (density @ share + b)) @ density)
        share /= share.sum()
    nats = np.log(density @ share / b + 1).sum() - sum(one.blob_events[0] for one in told)
    result = score(told)
    assert result.raw == pytest.approx(nats / len(b)) and result.penalised <= result.raw
    assert result.by_window.sum() == pytest.approx(result.raw) and len(result.by_window) == 2


@pytest.mark.slow
def test_dispersion_is_variance_over_mean(stream, background):
    told = measure_dispersions(stream, background, np.array([0.01]))[0]
    number = 50
    middles = (np.arange(number) + np.arange(number) * (0.5 * (5**0.5 - 1)) % 1) / number * DURATION
    own, fullest = np.ones(CELLS), np.zeros(CELLS)
    full = own < 0
    for i, j in np.ndindex(*own.shape):
        rows = []
        for t in middles:
            k = int(background.slice_at(t))
            part = stream.window(max(t - 0.005, 0), t + 0.005)
            n = ((part.y // CELL_PX == i) & (part.x // CELL_PX == j)).sum()
            if background.calm[k, i, j]:
                rows.append((n, background.activity[k]))
        n, a = np.array(rows).T
        mu = n.sum() / a.sum() * a
        full[i, j] = mu.sum() >= 5
        own[i, j] = ((n - mu) ** 2).sum() / mu.sum() if full[i, j] else 1
        fullest[i, j] = clutter_evidence(n, mu, 1).max() / np.log(max(len(n), 10))
    usual = max(1.0, float(np.median(own[full])))
    bright = background.bright & full
    assert full.mean() > 0.5 and bright.any()
    expected = np.where(bright, np.maximum(np.maximum(own, fullest), usual), usual)
    np.testing.assert_allclose(told, expected)


@pytest.mark.slow
def test_events_are_shared_out_among_gates_and_blobs():
    rng = np.random.default_rng(7)
    number, blobs, targets = 400, 5, 4
    part = WindowEvents(
        np.sort(rng.uniform(0, 0.01, number)),
        rng.integers(10, 60, number).astype(np.int32),
        rng.integers(10, 40, number).astype(np.int32),
    )
    labels = rng.integers(0, blobs + 1, number).astype(np.int32)
    p = np.array([[20.0, 20], [24, 21], [45, 30], [55, 15]])
    v = rng.normal(0, 300, (targets, 2))
    C = np.stack([np.array([[9.0, s], [s, 5.0]]) for s in (0, 2, -3, 1)])
    n, P = np.array([30.0, 20, 5, 40]), rng.uniform(0, 1, (targets, 3))
    confirmed = np.array([True, True, False, True])
    tracks = init_tracks(np.arange(targets), 0.005, Blobs(n, p, C), 0.01)
    gates = predict_gates(tracks._replace(v=v, P=P, confirmed=confirmed), 0.005, 0.01)
    assert gates.shared.tolist() == [True, True, False, False]

    e = np.stack([part.x, part.y], 1) - p[:, None] - v[:, None] * (part.t - 0.005)[:, None]
    S = C * (1 + 2 / n)[:, None, None] + (P[:, 0] + 0.1)[:, None, None] * np.eye(2)
    squared = np.einsum("kni,kij,knj->kn", e, np.linalg.inv(S), e)
    inside = squared < CONFIG.gate_sigmas**2
    distance = squared + np.log(np.linalg.det(S))[:, None] + np.where(confirmed, 0, 2)[:, None]
    near = np.where(inside, distance, np.inf)
    owner = np.where(inside.any(0), near.argmin(0), -1)
    expected = owner.copy()
    for blob in range(1, blobs + 1):
        share = np.array([((labels == blob) & (owner == k)).sum() for k in range(targets)])
        share = share / (labels == blob).sum()
        if share.sum() < CONFIG.claimed_share:
            continue
        own = np.flatnonzero((share >= min(1 - CONFIG.nearly_all, share.max())) & (share > 0))
        kept = (owner >= 0) & confirmed[owner]
        for i in np.flatnonzero((labels == blob) & ~np.isin(owner, own) & ~kept):
            expected[i] = own[distance[own, i].argmin()]
    result = assign(gates, part, labels, blobs)
    told = result.owner
    np.testing.assert_array_equal(result.counts, np.bincount(labels)[1:])
    assert (expected != owner).any()
    np.testing.assert_array_equal(told, expected)

    which = labels > 0
    weight = (told == np.arange(targets)[:, None]) * which.astype(float)
    for i in np.flatnonzero((inside[:2].sum(0) > 1) & which):
        density = np.exp(-distance[:2, i] / 2) * n[:2]
        weight[:, i] = [*(density / density.sum()), 0, 0]
    assert 0 < (weight % 1 > 0).sum()
    number, z, D = result.in_blobs
    np.testing.assert_allclose(number, weight.sum(1))
    for k in range(targets):
        np.testing.assert_allclose(z[k], np.average(e[k], axis=0, weights=weight[k]))
        C = np.cov(e[k].T, aweights=weight[k], ddof=0)
        np.testing.assert_allclose(D[k], C + np.eye(2) / 12, rtol=1e-9)


def test_windows_before_the_start_hold_nothing(stream):
    late = Stream(stream.recording, 100_000, 500_000)
    assert len(late.window(-0.05, 0.0)) == 0 and len(late.pixel_counts(-0.05, 0.0)) == 0
    assert len(late.window(-0.05, 0.05)) == len(late.window(0.0, 0.05))
    assert isinstance(late.pixel_counts(0, 0.1), PixelCounts)


def test_streams_tell_the_same_read_piece_by_piece(stream, background, monkeypatch):
    monkeypatch.setattr(stream_module, "MAX_HELD_EVENTS", 0)
    monkeypatch.setattr(stream_module, "EVENTS_PER_READ", 64)
    pieces = Stream(stream.recording, stream.start, stream.stop)
    pieces.hot = stream.hot
    (_, path), number = lagging(tail=8.0), len(stream.window(0, 1))
    held = stream.without([path], 3)
    for room in (0, number):  # what is left is held where there is room for it
        monkeypatch.setattr(stream_module, "MAX_HELD_EVENTS", room)
        for one, other in ((pieces, stream), (pieces.without([path], 3), held)):
            for told, expected in zip(one.window(0.1, 0.2), other.window(0.1, 0.2), strict=True):
                np.testing.assert_array_equal(told, expected)
        assert number > len(held.window(0, 1)) == len(pieces.without([path], 3).window(0, 1))
    np.testing.assert_array_equal(
        measure_dispersions(pieces, background, np.array([0.01]))[0],
        measure_dispersions(stream, background, np.array([0.01]))[0],
    )


def lagging(tail):
    """A light that goes right, whose OFF events come so many px behind it, and its mean's path."""
    rng = np.random.default_rng(8)
    t = np.sort(rng.integers(0, 1_000_000, 3000))
    on = rng.random(3000) < 0.6
    x = 20 + 40e-6 * t + rng.normal(0, 1.5, 3000) - np.where(on, 0, rng.exponential(tail, 3000))
    y = 30 + rng.normal(0, 1.5, 3000)
    x, y = (np.rint(np.clip(part, 0, 90)).astype(np.uint16) for part in (x, y))
    recording = Recording("light", WIDTH, HEIGHT, Events(t, x, y, on))
    middle = np.arange(25_000, 1_000_000, 50_000)
    p = np.stack([20 + 40e-6 * middle - 0.4 * tail, np.full(20, 30.0)], 1)
    C = np.broadcast_to(np.diag([2.5 + 0.7 * tail**2, 2.5]), (20, 2, 2))
    path = TargetPath(middle, p, np.zeros((20, 2)), C, np.full(20, 150.0), 50_000, 1.0)
    return recording, path


def test_where_events_of_one_polarity_lag_the_other_tells_the_place():
    recording, path = lagging(tail=8.0)
    stream = Stream(recording, 0, 1_000_000)
    (told,) = prefer_sharper([path], stream)
    assert told.polarity == 1
    np.testing.assert_allclose(told.p[:, 0], 20 + 40e-6 * path.t, atol=0.8)
    np.testing.assert_allclose(told.C[0], np.diag([1.5**2 + 1 / 6] * 2), atol=0.4)
    found = TargetSearchResult((told,), (), 0, 0.0, recording)
    kept = ChunkPacker(recording, moment.Params(), found=found).pack_all()
    assert (kept.polarity[kept.valid] > 0).all() and kept.valid.sum() > 1500
    # No events of hot pixels, and no change where both are alike.
    stream.hot = np.ones((HEIGHT, WIDTH), bool)
    assert prefer_sharper([path], stream)[0] is path
    recording, path = lagging(tail=0.5)
    assert prefer_sharper([path], Stream(recording, 0, 1_000_000))[0] is path


def one_target(P, hits=9):
    """A known target at (40, 30) that is seen anew in a window about 10 ms."""
    blob = Blobs(np.array([20.0]), np.array([[40.0, 30.0]]), 4 * np.eye(2)[None])
    tracks = init_tracks(np.arange(1), 0.0, blob, 0.01)
    P, hits = np.array([[P, 0.0, 0.0]]), np.full(1, hits)
    return tracks._replace(P=P, q=np.zeros(1), confirmed=np.ones(1, bool), hits=hits)


def update_at(tracks, background, blobs, t=0.01):
    clutter = clutter_model(background, Scale(0.01, 4, np.ones(CELLS)), SHAPE, t)
    return update_tracks(tracks, predict_gates(tracks, t, 0.01), clutter, blobs, blobs)


def test_gates_of_known_targets_end_at_their_size_beyond_it():
    x = np.array([42, 47, 49, 70], np.int32)
    part = WindowEvents(np.full(4, 0.01), x, np.full(4, 30, np.int32))
    owners = [
        assign(predict_gates(one_target(P), 0.01, 0.01), part, np.zeros(4, np.int32), 0).owner
        for P in (0.0, 1e4)
    ]
    # Of 3 standard deviations of 4.4 px^2, and of 4.4 + 4.
    np.testing.assert_array_equal(owners, [[0, -1, -1, -1], [0, 0, -1, -1]])


@pytest.mark.parametrize(("known", "owners"), [(True, {1}), (False, {0})])
def test_faint_targets_that_are_known_keep_their_events_in_a_blob_with_a_large_one(known, owners):
    p, C = np.array([[30.0, 30], [60, 30]]), 9 * np.ones((2, 1, 1)) * np.eye(2)
    tracks = init_tracks(np.arange(2), 0.0, Blobs(np.array([95.0, 5]), p, C), 0.01)
    tracks = tracks._replace(confirmed=np.array([True, known]), P=np.zeros((2, 3)))
    x = np.r_[np.full(95, 32), np.full(5, 58)].astype(np.int32)
    part = WindowEvents(np.full(100, 0.01), x, np.full(100, 31, np.int32))
    gates = predict_gates(tracks, 0.01, 0.01)
    owner = assign(gates, part, np.ones(100, np.int32), 1).owner
    assert set(owner[:95].tolist()) == {0} and set(owner[95:].tolist()) == owners


@pytest.mark.slow
def test_a_target_is_updated_as_by_a_kalman_filter(background):
    tracks, t = one_target(3.0), 0.01
    p, P = predict_gates(tracks, t, 0.01)[2:4]
    z, D = np.array([[1.5, -0.5]]), np.array([[[6.0, 1.0], [1.0, 3.0]]])
    seen = update_at(tracks, background, Blobs(np.array([16.0]), z, D))
    assert seen.detected.all() and seen.n[0] == 16
    known = CONFIG.prior_size_events
    square = (16 * np.linalg.eigvalsh(D[0])[1] + known * 4) / (16 + known)
    assert seen.R[0] == pytest.approx(square / 32)
    K = P[0, :2] / (P[0, 0] + square / 32 + 0.05**2 * square + 1e-3)
    np.testing.assert_allclose(tracks.p, p + K[0] * z)
    np.testing.assert_allclose(tracks.P[0, :2], (1 - K[0]) * P[0, :2])
    np.testing.assert_allclose(tracks.C[0], 4 * np.eye(2) + 0.2 * 0.8 * (D[0] - 4 * np.eye(2)))
    mu = background.rate_at(*tracks.p[0], t) * 0.01 * np.pi * 9
    mu *= np.sqrt(np.linalg.det(tracks.C[0]))
    assert tracks.nats[0] == pytest.approx(float(clutter_evidence(16, mu, 1.0)))
    # Two windows of silence: it stands still where it was.
    tracks.v[:] = 50.0
    none = Blobs(np.zeros(1), np.zeros((1, 2)), np.zeros((1, 2, 2)))
    before = tracks.p.copy()
    for misses in (1, 2):
        assert not update_at(tracks, background, none).detected.any()
        assert tracks.misses[0] == misses
    np.testing.assert_array_equal(tracks.p, before)
    assert (tracks.v == 0).all()


def test_a_known_target_does_not_leap_to_few_events(background):
    # Of size 2, with 20 events per window: 3 of them are at most 4.0 px from where it is expected,
    # most of them at most 6.7.
    for n, away, hits, detected in (
        (3, 2.0, 9, True),
        (3, 5.0, 9, False),
        (3, 5.0, 2, True),
        (16, 5.0, 9, True),
        (16, 9.0, 9, False),
    ):
        tracks = one_target(0.25, hits)
        blobs = Blobs(np.array([float(n)]), np.array([[away, 0.0]]), 0.1 * np.eye(2)[None])
        assert update_at(tracks, background, blobs).detected[0] == detected
        assert (tracks.p[0, 0] > 40.5) == detected


def test_blobs_of_two_targets_are_told_from_a_bar_and_from_a_tail():
    rng = np.random.default_rng(8)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    side = np.arange(400) < 250
    wide = rng.normal(0, 2.0, (400, 2))
    shapes = {
        "two": np.where(side, 0.0, 12.0),
        "bar": rng.uniform(0, 22, 400),
        "tail": np.where(side, 0.0, rng.exponential(10, 400)),
        "one": np.zeros(400),
    }
    for name, along in shapes.items():
        p = 40 + (wide + np.stack([along, np.zeros(400)], 1)) @ turn.T
        part = WindowEvents(np.zeros(401), *np.append(np.rint(p), [[5, 90]], 0).T.astype(np.int32))
        owner, two = np.append(np.full(400, 3), -1), Blobs.zeros(2)
        nats = split_blob(part, owner, 3, two)
        assert (nats > 20) == (name == "two"), name
        assert nats > 20 or nats < 0
        if name == "two":
            np.testing.assert_allclose(two.n, [250, 150], atol=3)
            np.testing.assert_allclose(two.p, 40 + np.outer([0, 12], turn[:, 0]), atol=0.6)
            np.testing.assert_allclose(two.C, np.broadcast_to(4 * np.eye(2), (2, 2, 2)), atol=1.2)
