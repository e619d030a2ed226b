"""Tests of clipped frames: recognised, and what events say beyond white reaches the images."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxevent import akf, aks, check_consistency
from jaxevent.calibration.clipping import find_clipping
from jaxevent.reconstruction.smoother import Gaussian, one_sided_message
from jaxevent.recording import Events, Frames, Recording

SIZE, WHITE_LEVEL = 48, 1.0


def make_recording(images, t=None, events=None) -> Recording:
    t = np.arange(len(images)) * 40_000 if t is None else t
    frames = Frames(np.asarray(t, np.int64), images, np.zeros(len(images), np.int64))
    h, w = images.shape[1:]
    return Recording("made", w, h, Events.empty() if events is None else events, frames)


def smooth_greys(rng, high: float) -> np.ndarray:
    """Grey values with a tail, 1 where they would be white."""
    return rng.beta(2, 3, (4, SIZE, SIZE)) * high


@pytest.mark.parametrize(
    ("scale", "kind"), [(255, np.uint8), (240, np.uint8), (65520, np.uint16), (1, np.float32)]
)
def test_white_is_recognised_at_any_level(scale, kind):
    light = smooth_greys(np.random.default_rng(1), 1.6)
    top = 1 if kind == np.float32 else np.iinfo(kind).max
    images = np.minimum(light, 1) * scale
    found = find_clipping(make_recording(images.astype(kind))).white
    assert found.level is not None
    assert found.level == pytest.approx(scale / top, rel=0.02)
    assert found.level < images.max() / top
    assert found.share == pytest.approx((light > 1).mean(), abs=0.02)
    whole = find_clipping(make_recording((light / light.max() * scale).astype(kind))).white
    assert whole.level is None
    assert whole.ratio < 1.5


@pytest.mark.parametrize("noise", [0.3, 0.6, 1.2])
def test_a_bright_surface_is_not_white(noise):
    """Noise of a flat surface goes both ways, that of white ends at the last grey value."""
    rng = np.random.default_rng(4)
    grey = 230 * rng.beta(2, 3, (4, SIZE, SIZE))
    grey[:, :16] = 238
    noisy = np.rint(grey + rng.normal(0, noise, grey.shape))
    assert find_clipping(make_recording(noisy.astype(np.uint8))).white.level is None
    for last in (238, 255):
        cut = np.minimum(noisy + (last - 238), last).astype(np.uint8)
        assert find_clipping(make_recording(cut)).white.level is not None


def test_black_is_recognised():
    light = smooth_greys(np.random.default_rng(2), 0.9) - 0.2
    images = (np.maximum(light, 0) * 255).astype(np.uint8)
    found = find_clipping(make_recording(images))
    assert found.white.level is None
    assert found.black.level == pytest.approx(2.5 / 255)
    assert find_clipping(make_recording(np.full((3, 8, 8), 100, np.uint8))).black.level is None


def test_the_excess_is_that_of_an_exponential_tail():
    """Of a density that falls exponentially in ln I the mean is found, up to the factor."""
    x = np.random.default_rng(3).exponential(0.5, (4, 96, 96)) - 1.0  # ln I, from dark to white
    images = np.minimum(np.exp(x), 1).astype(np.float32)
    assert find_clipping(make_recording(images)).white.excess == pytest.approx(0.4 * 0.5, rel=0.1)


def moving_edge() -> tuple[Recording, np.ndarray, int]:
    """Bright bars that move over a dark ground, each beyond white by another part.

    Events are those of an ideal sensor with a threshold of 0.1 on ln(I + 1).
    """
    rng = np.random.default_rng(5)
    bars = np.repeat(rng.uniform(0.3, 0.9, 60), 8)
    bars[::24] = bars[4::24] = 0.3
    level = np.where(np.arange(480) // 8 % 3 == 0, 1.6, bars)
    ground = np.repeat(rng.uniform(0.95, 1.05, (24, 1)), 480, 1) * level
    step_us, n = 2000, 241  # a pixel in 2 ms

    def image(k: int) -> np.ndarray:
        return ground[:, 200 - k // 2 : 248 - k // 2] if k % 2 == 0 else (
            ground[:, 200 - k // 2 : 248 - k // 2] + ground[:, 199 - k // 2 : 247 - k // 2]
        ) / 2  # fmt: skip

    reference, rows = np.log1p(image(0)), []
    for k in range(1, n):
        change = np.log1p(image(k)) - reference
        count = np.trunc(change / 0.1 + 1e-9 * np.sign(change)).astype(int)
        reference = reference + 0.1 * count
        for i in range(int(abs(count).max())):
            y, x = np.nonzero(abs(count) > i)
            t = np.full(len(y), k * step_us // 2 - 400 + 20 * i)
            rows.append((t, x, y, count[y, x] > 0))
    t, x, y, p = (np.concatenate(part) for part in zip(*rows, strict=True))
    order = np.argsort(t, kind="stable")
    events = Events(
        t[order].astype(np.int64), x[order].astype(np.uint16), y[order].astype(np.uint16), p[order]
    )
    at = np.arange(0, n, 24)
    images = np.stack([np.minimum(image(k), WHITE_LEVEL) * 255 for k in at]).astype(np.uint8)
    hidden = 12 + 24 * 5
    recording = make_recording(images, at * step_us // 2, events)
    return recording, image(hidden), hidden * step_us // 2


@pytest.mark.parametrize("method", [akf, aks], ids=lambda m: m.name)
def test_what_events_say_beyond_white_reaches_the_image(method):
    recording, truth, t = moving_edge()
    params = method.Params(c_on=0.1, c_off=0.1)
    image, P, _ = method.estimate(recording, params, progress=False)(np.array([t]))
    beyond = truth > 1.2
    assert beyond.mean() > 0.2
    error = np.log(image[0] / truth)[beyond]
    assert np.mean(error**2) < 0.5 * np.mean(np.log(truth[beyond]) ** 2)  # of white, at best
    z = np.log((image[0] + 1) / (truth + 1))[beyond] / np.sqrt(P[0][beyond])
    assert np.median(z**2) < 5  # hundreds where white is taken for a measurement


def one_pixel(side: float, excess: float | None):
    class Row:
        pass

    row = Row()
    row.side, row.bound = jnp.array(side), jnp.array(0.7)
    row.excess = None if excess is None else jnp.array(excess)
    return row


def test_one_sided_evidence_is_the_truncated_normal():
    """Far on the wrong side it counts fully: its moments are those of scipy's distribution."""
    state = Gaussian(jnp.array(-0.3), jnp.array(0.04))
    message, _ = one_sided_message(state, one_pixel(1.0, None), jnp.zeros(()))
    P = 1 / (1 / state.P + message.J)
    m = P * (state.m / state.P + message.h)
    expected = stats.truncnorm((0.7 - state.m) / 0.2, np.inf, loc=state.m, scale=0.2)
    assert float(m) == pytest.approx(expected.mean(), abs=1e-3)
    assert float(P) == pytest.approx(expected.var(), rel=0.05)


def test_an_unknown_level_is_as_expected_and_no_frame_repeats_it():
    """A state of any variance ends with that of the expectation, also after many frames."""
    m, P = jnp.array(0.4), jnp.array(4.0)
    for _ in range(30):
        message, _ = one_sided_message(Gaussian(m, P), one_pixel(1.0, 0.3), jnp.zeros(()))
        after = 1 / (1 / P + message.J)
        m, P = after * (m / P + message.h), after
        assert 0.7 < m < 0.7 + 2 * 0.3
    assert 0.1 < float(P) ** 0.5 < 0.31
    known = Gaussian(jnp.array(1.6), jnp.array(0.01))  # far beyond, and known
    message, _ = one_sided_message(known, one_pixel(1.0, 0.3), jnp.zeros(()))
    assert float(message.J) < 1e-2 / known.P


def test_many_white_pixels_are_a_fault_with_their_share():
    light = smooth_greys(np.random.default_rng(4), 1.6)
    rng = np.random.default_rng(5)
    events = Events(
        np.sort(rng.integers(0, 120_000, 4000)), rng.integers(0, SIZE, 4000).astype(np.uint16),
        rng.integers(0, SIZE, 4000).astype(np.uint16), rng.random(4000) < 0.5,
    )  # fmt: skip
    recording = make_recording((np.minimum(light, 1) * 255).astype(np.uint8), events=events)
    faults = {fault.name: fault for fault in check_consistency(recording)}
    assert faults["clipped frames"].statistic == pytest.approx((light > 1).mean(), abs=0.02)
