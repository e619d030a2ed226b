"""Thresholds of single pixels: learned from changes that are known."""

import jax
import numpy as np
import pytest

from jaxevent.reconstruction.compensated import thresholds
from jaxevent.reconstruction.compensated.images import InstantSmoother
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.frames import EventTiming
from jaxevent.reconstruction.windows import prepare
from jaxevent.recording import Events, Frames, Recording

HEIGHT, WIDTH = 6, 7
PIXELS = HEIGHT * WIDTH
SPAN = (0, 800_000)
C_ON, C_OFF = 0.2, 0.18


def waves(swings):
    """Log intensity (pixels, times) on a grid of 0.1 ms: every pixel swings by itself."""
    rng = np.random.default_rng(4)
    t = np.arange(0, SPAN[1] + 1, 100)
    rate, phase = rng.uniform(4, 9, (PIXELS, 1)), rng.uniform(0, 6.28, (PIXELS, 1))
    return t, swings * np.sin(rate * t * 1e-6 + phase) + 0.3 * swings * np.sin(31e-6 * t + phase)


def recorded(mismatch, swings=2.0):
    """A recording of them, its thresholds as factors (2, pixels), and their true images."""
    t, L = waves(swings)
    rng = np.random.default_rng(5)
    factors = 1 + mismatch * rng.normal(size=(2, PIXELS))
    found = []
    for pixel in range(PIXELS):
        level = L[pixel, 0]
        for k, value in enumerate(L[pixel]):
            while value >= level + C_ON * factors[0, pixel]:
                level += C_ON * factors[0, pixel]
                found.append((t[k], pixel, True))
            while value <= level - C_OFF * factors[1, pixel]:
                level -= C_OFF * factors[1, pixel]
                found.append((t[k], pixel, False))
    when, where, up = (np.array(v) for v in zip(*sorted(found), strict=True))
    events = Events(
        when.astype(np.int64),
        (where % WIDTH).astype(np.uint16),
        (where // WIDTH).astype(np.uint16),
        up.astype(bool),
    )
    stamps = np.arange(0, SPAN[1] + 1, 50_000)
    grey = np.full((len(stamps), HEIGHT, WIDTH), 0.5, np.float32)
    frames = Frames(stamps, grey, np.full(len(stamps), 2000, np.int64))
    recording = Recording("waves", WIDTH, HEIGHT, events, frames)

    def images(at):
        true = L[:, round(at / 100)]
        return true.reshape(HEIGHT, WIDTH), np.full((HEIGHT, WIDTH), 1e-3)

    return recording, factors, images


def params(**changes):
    return Params(c_on=C_ON, c_off=C_OFF, **{"sigma_event": 0.1, **changes})


def test_thresholds_are_learned():
    recording, factors, images = recorded(0.15)
    learned = thresholds.learn_thresholds(recording, params(), SPAN, images)
    assert learned is not None
    before, after = np.std(factors - 1), np.std(learned - factors)
    assert after < 0.6 * before, after / before


def test_nothing_is_learned_from_little():
    recording, _, images = recorded(0.15)
    assert thresholds.learn_thresholds(recording, params(learn=False), SPAN, images) is None
    few, _, images = recorded(0.15, swings=0.3)
    assert thresholds.learn_thresholds(few, params(), SPAN, images) is None
    alike, _, images = recorded(0.0)
    assert thresholds.learn_thresholds(alike, params(), SPAN, images) is None


def test_deviations_are_those_of_single_regressions():
    rng = np.random.default_rng(0)
    rest, on, off = rng.normal(size=(3, 6, 5))
    changes = thresholds.LogChanges(rest, on, off, rng.uniform(0.5, 2, (6, 5)))
    found = thresholds.regress_deviations(changes, 0.3)
    for k in range(5):
        W = np.diag(1 / (changes.V[:, k] + rest[:, k] ** 2 / thresholds.HUBER_SQUARE))
        X = np.stack([on[:, k], off[:, k]], 1)
        left = np.linalg.inv(X.T @ W @ X + np.eye(2) / 0.3**2)
        np.testing.assert_allclose(found.d[:, k], left @ X.T @ W @ rest[:, k], rtol=1e-10)
        np.testing.assert_allclose(found.remaining[:, k], np.diag(left) / 0.3**2, rtol=1e-10)


def test_what_halves_agree_in_is_the_spread():
    rng = np.random.default_rng(1)
    true = 0.07 * rng.normal(size=(2, 20_000))
    on, off = rng.uniform(0, 1, (2, 8, 20_000))
    rest = true[0] * on - true[1] * off + 0.1 * rng.normal(size=on.shape)
    changes = thresholds.LogChanges(rest, on, -off, np.full(on.shape, 0.01))
    halves = [
        thresholds.regress_deviations(changes.select(rows), 0.1) for rows in (slice(4), slice(4, 8))
    ]
    assert thresholds.estimate_deviation_sigma(*halves) == pytest.approx(0.07, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 1e-3])
def test_weighted_events_are_those_of_other_thresholds(rho):
    """One factor for all pixels is the same as common thresholds times it."""
    recording, _, _ = recorded(0.1)
    at = np.array([123_000, 502_000])
    # Their noise is a part of thresholds, too.
    chosen = params(rho_ref=rho, sigma_event=0.0, share=0.0)
    features, out = prepare(recording, at, EventTiming(rho_ref=rho), filtering=False)
    smoother = InstantSmoother("smoother", Params)

    @jax.jit
    def read(p, features, out):
        return smoother.read(p, smoother.run(p, features)[0], out)

    factors = np.repeat([[1.3], [0.8]], PIXELS, 1).astype(np.float32)
    weighted = read(chosen, features.scale_counts(factors), out.scale_counts(factors))
    expected = read(chosen.replace(c_on=1.3 * C_ON, c_off=0.8 * C_OFF), features, out)
    np.testing.assert_allclose(weighted.mean, expected.mean, rtol=1e-4, atol=1e-5)
