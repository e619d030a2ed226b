"""Images of noise, of single events and of paths that explain events, or do not."""

import numpy as np
import pytest

from jaxevent.calibration import check_consistency
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.silence import explained_share
from jaxevent.reconstruction.events_only.windows import WindowSolver
from jaxevent.recording import Recording

SHAPE = (48, 64)


def noise(n, seed=100):
    rng = np.random.default_rng(seed)
    place = rng.integers(0, SHAPE[0] * SHAPE[1], n)
    t, p = np.sort(rng.integers(0, 10**6, n)), rng.integers(0, 2, n)
    return Recording.from_arrays(t, place % 64, place // 64, p, width=64, height=48)


@pytest.mark.parametrize("n", [1, 2, 500, 9000])
def test_noise_is_flat_and_unknown(n):
    recording = noise(n)
    windows = WindowSolver(recording, Params())
    solution = windows((recording.start + recording.stop) // 2).solution
    c = windows.thresholds.mean()
    assert np.isfinite(solution.log_image).all() and np.isfinite(solution.variance).all()
    assert np.abs(solution.log_image).max() < 0.2 * c
    assert np.sqrt(np.median(solution.variance)) > 1.5 * c


def bad_input(kind):
    """Events that pass along a row of edges, with something wrong, and the fault's name."""
    rng = np.random.default_rng(100)
    k, column, y = (v.ravel() for v in np.mgrid[:12, :64, :48])
    t, x, p = (column + 6 * k) * 2000 + 100 * (y % 7), column, k % 2 == 0
    if kind == "one pixel":
        x, y, p = np.full_like(x, 10), np.full_like(y, 12), rng.random(len(t)) < 0.5
    elif kind == "all ON":
        p = np.ones(len(t), bool)
    elif kind == "bursts":
        at = np.repeat([70_000, 120_000], SHAPE[0] * SHAPE[1])
        pixels = np.tile(np.arange(SHAPE[0] * SHAPE[1]), 2)
        t, x, y = np.r_[t, at], np.r_[x, pixels % 64], np.r_[y, pixels // 64]
        p = np.r_[p, np.ones(len(at), bool)]
    else:
        pixels = np.repeat(rng.choice(SHAPE[0] * SHAPE[1], SHAPE[0] * SHAPE[1] // 5, False), 60)
        t = np.r_[t, rng.integers(0, t.max(), len(pixels))]
        x, y = np.r_[x, pixels % 64], np.r_[y, pixels // 64]
        p = np.r_[p, rng.random(len(pixels)) < 0.5]
    order = np.argsort(t, kind="stable")
    columns = (v[order] for v in (t, x, y, p))
    return Recording.from_arrays(*columns, width=64, height=48)


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("one pixel", "hot pixels"),
        ("all ON", "lost polarity"),
        ("bursts", "event bursts"),
        ("20 % hot pixels", "hot pixels"),
    ],
)
def test_bad_input_is_told_and_gives_finite_images(kind, fault):
    recording = bad_input(kind)
    assert fault in [found.name for found in check_consistency(recording)]
    windows = WindowSolver(recording, Params())
    solution = windows((recording.start + recording.stop) // 2).solution
    assert np.isfinite(solution.log_image).all() and np.isfinite(solution.variance).all()
    assert solution.variance.min() > 0
    if kind != "bursts":  # what shows no motion, without what is wrong either
        c = windows.thresholds.mean()
        assert np.abs(solution.log_image).max() < 0.2 * c
        assert np.sqrt(np.median(solution.variance)) > 1.5 * c


def test_share_of_an_edge_on_its_path_and_off_it():
    y, k = np.divmod(np.arange(48 * 40), 40)
    pixel, p = (y * 64 + k + 10).astype(np.int32), np.ones(len(y), bool)
    on_path = np.stack([np.full(len(y), 30.2), y], 1).astype(np.float32)
    share = explained_share(pixel, p, on_path, SHAPE).reshape(SHAPE)
    assert share[10:38, 15:45].min() > 0.8
    random = np.random.default_rng(100).random(len(p)) < 0.5
    assert explained_share(pixel, random, on_path, SHAPE).mean() < 0.02
    # A pixel that flickers where it is supports nothing.
    still = np.tile(np.float32([[5.0, 5.0]]), (100, 1))
    flicker = np.arange(100) % 2 == 0
    assert explained_share(np.full(100, 325, np.int32), flicker, still, SHAPE).max() == 0
