"""The clock of a window, and how fast it goes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxevent.event_flow.clock import ROUGHNESS, Clock
from jaxevent.recording import Events


def oracle(t, s, at):
    """Mean and variance of the rate of (1), by quadrature over the noise that drives s."""
    span = t[-1] - t[0]
    t, at = (t - t[0]) / span, (at - t[0]) / span
    u = (np.arange(20_000) + 0.5) / 20_000
    place = np.maximum(t[:, None] - u, 0) ** 2 / 2  # what noise at u does to s, and to the rate
    rate = np.maximum(at - u, 0)
    A, slope = np.stack([t**0, t, t**2], 1), np.array([0, 1, 2 * at])
    means, variances, likelihoods = [], [], []
    for q in ROUGHNESS:
        V = np.eye(len(t)) + q * place @ place.T / len(u)
        k = q * place @ rate / len(u)
        normal = A.T @ np.linalg.solve(V, A)
        b = np.linalg.solve(normal, A.T @ np.linalg.solve(V, s))
        rest = s - A @ b
        squares = rest @ np.linalg.solve(V, rest)
        left = slope - A.T @ np.linalg.solve(V, k)
        means.append(slope @ b + k @ np.linalg.solve(V, rest))
        own = q * rate @ rate / len(u) - k @ np.linalg.solve(V, k)
        scatter = squares / max(len(t) - 5, 1)
        variances.append(scatter * (own + left @ np.linalg.solve(normal, left)))
        log_det = np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1]
        likelihoods.append(-(log_det + (len(t) - 3) * np.log(squares)) / 2)
    weights = np.exp(np.array(likelihoods) - max(likelihoods))
    weights /= weights.sum()
    mean = weights @ means
    variance = weights @ (np.array(variances) + (np.array(means) - mean) ** 2)
    return mean * 1e6 / span, variance * (1e6 / span) ** 2


@pytest.mark.parametrize("times", [5, 9])
def test_rates_are_those_of_the_smoothing_spline(times):
    rng = np.random.default_rng(times)
    t = np.cumsum(rng.uniform(2e3, 9e3, times)) + 7e6
    clock = Clock(t, np.sin(t / 2e4) + 0.01 * rng.standard_normal(times))
    for at in (t[0], t[1] + 500, t[-1]):
        assert_allclose(clock.rate(at), oracle(*clock, at), rtol=2e-4)


def test_a_camera_that_brakes_brakes_to_the_end():
    t = np.linspace(0, 40_000, 9)
    clock = Clock(t, 1 - (1 - t / 50_000) ** 2)
    for at in (0, 10_000, 40_000):
        rate, variance = clock.rate(at)
        assert rate == pytest.approx(2e6 / 50_000 * (1 - at / 50_000))
        assert variance < 1e-6
    assert clock.rate(90_000) == clock.rate(40_000)  # no farther than its times


@pytest.mark.parametrize("times", [1, 2, 3, 4])
def test_few_times_have_the_mean_rate(times):
    t = np.arange(times) * 100
    events = Events(t, np.zeros(times, int), np.zeros(times, int), np.ones(times, bool))
    clock = Clock.of(events, 50, 2)
    rate, variance = clock.rate(60)
    assert rate == pytest.approx(clock.mean_rate) and 0 <= variance < 1e-6


def test_variances_are_those_of_errors():
    """Rates of clocks whose acceleration wanders, with noise; Student's z2 has a median of 0.5."""
    rng, t = np.random.default_rng(3), np.linspace(0, 1e6, 9)
    z2 = []
    for _ in range(300):
        accelerations = np.cumsum(rng.normal(0, 4 / 400**0.5, 400)) + rng.normal()
        rates = 2 + np.cumsum(accelerations) / 400
        s = np.interp(t / 1e6, np.arange(401) / 400, np.concatenate([[0], np.cumsum(rates) / 400]))
        rate, variance = Clock(t, s + rng.normal(0, 0.02, 9)).rate(1e6)
        z2.append((rate - rates[-1]) ** 2 / variance)
    assert 0.35 < np.median(z2) < 0.75
