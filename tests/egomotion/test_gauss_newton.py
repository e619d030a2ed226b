"""Step control, and rows of a path: units, derivatives, priors and smoothness."""

import dataclasses

import numpy as np
import pytest

from jaxevent.egomotion.bundle import warp
from jaxevent.egomotion.bundle.photometric_ba import StepControl, update_control
from jaxevent.egomotion.bundle.warp import N_COEFFICIENT_ROWS, N_WINDOW_SEGMENTS, Path, Prior

K = 3
HALF = 0.15


@pytest.mark.parametrize(
    "before, better, gain, after",
    [
        ((2, 0.0), True, 0.5, (3, 0.0)),  # gained: more momentum
        ((2, 0.4), True, 0.5, (3, 0.2)),  # and half of the damping
        ((2, 0.04), True, 0.5, (3, 0.0)),  # which ends below a quarter of the first
        ((2, 0.0), False, -1.0, (0, 0.1)),  # cost more: taken back, damped
        ((0, 0.1), False, -1.0, (0, 0.5)),  # then five times more
        ((2, 0.0), True, 1e-5, (3, 50)),  # gained next to nothing: the last one
    ],
)
def test_steps_are_accepted_or_damped(before, better, gain, after):
    now = update_control(StepControl(*before), better, gain, 1.0, True)
    assert (now.momentum, now.damping) == pytest.approx(after)
    assert now.should_continue == (after[1] < 50)


def test_steps_are_limited():
    assert warp.step_fraction(np.array([1.0, -8.0])) == 0.5
    assert warp.step_fraction(np.array([1.0, -3.0])) == 1


def a_path() -> Path:
    rng = np.random.default_rng(1)
    return Path(*(rng.normal(size=shape) for shape in ((5, 3), (5, 3), (7,))))


def test_rows_are_put_back():
    path = a_path()
    first = warp.pack_rows(path, K)
    moved = warp.replace_rows(path, 2 * first)
    np.testing.assert_allclose(warp.pack_rows(moved, K), 2 * first)
    np.testing.assert_array_equal(moved.O[K:], path.O[K:])
    np.testing.assert_array_equal(moved.D[K:], path.D[K:])
    # Omega of 1 / (f h) moves an image by 1 px at the window's end, its change by 2 / (f h^2).
    unit = warp.row_units(path, 80.0, HALF, K).reshape(2, K, 3)
    np.testing.assert_allclose(unit[0, :, 0], [1 / 12, 2 / 1.8, 6 / 0.27], rtol=1e-12)
    usual = np.exp(np.median(path.log_rho))
    np.testing.assert_allclose(unit[1], unit[0] / usual, rtol=1e-12)


@pytest.mark.parametrize("k", [K, 5])
def test_jacobian_of_coefficients(k):
    """Against differences of the polynomials, in half windows."""
    path = a_path()
    unit = warp.row_units(path, 80.0, HALF, k)
    powers = HALF ** np.arange(1, N_COEFFICIENT_ROWS + 1)

    def coefficients(at: Path) -> np.ndarray:
        both = np.stack(at.polynomial_coefficients()) * powers[:, None]
        return both.transpose(0, 2, 1).ravel()

    found, h = warp.coefficient_jacobian(path, unit, HALF, k), 1e-6
    assert found.shape == (6 * N_COEFFICIENT_ROWS, 6 * k)
    for n, one in enumerate(np.eye(6 * k)):
        step = h * one * unit
        ends = [
            coefficients(warp.replace_rows(path, warp.pack_rows(path, k) + s))
            for s in (step, -step)
        ]
        np.testing.assert_allclose(found[:, n], (ends[0] - ends[1]) / (2 * h), atol=1e-7)


def test_the_size_of_the_translation_is_held():
    path = dataclasses.replace(a_path(), D=np.eye(5, 3))
    unit = warp.row_units(path, 80.0, HALF, K)
    gauge = warp.gauge_direction(path, unit, 6 * K + 4)
    expected = np.zeros(6 * K + 4)
    expected[3 * K] = unit[3 * K]
    np.testing.assert_allclose(gauge, expected)


def test_cost_of_priors():
    rng = np.random.default_rng(2)
    now, unit = rng.normal(size=6 * K), rng.uniform(0.5, 2, 6 * K)
    gyro = rng.normal(size=(N_WINDOW_SEGMENTS, 3))
    prior = Prior(1.0, 1.0, 0.3, gyro, 2.0, 1.0, 1.0, 1.0)
    O = (now * unit)[: 3 * K].reshape(K, 3)  # noqa: E741
    t = ((np.arange(N_WINDOW_SEGMENTS) + 0.5) / N_WINDOW_SEGMENTS * 2 - 1) * HALF
    seen = O[0] + O[1] * t[:, None] + O[2] * t[:, None] ** 2 / 2
    changes = np.concatenate([now[3 : 3 * K], now[3 * K + 3 :]])
    expected = 0.3 * (changes**2).sum()
    expected += 2.0 / N_WINDOW_SEGMENTS * ((seen - gyro) ** 2).sum()
    H, b, constant = warp.row_priors(prior, unit, HALF)
    cost = now @ H @ now / 2 - b @ now + constant
    assert cost == pytest.approx(expected / 2, rel=1e-12)


def test_bonds_give_way_at_edges():
    log_rho = np.array([[0.0, 0.01, 5.0], [0.0, 0.01, 5.0]])
    across, down, cost = warp.smoothness_weights(log_rho, 2.0, 0.1)
    row = [0, 2 / 1.01, 2 / (1 + 49.9**2)]
    np.testing.assert_allclose(across, [row, row])
    np.testing.assert_allclose(down, [[0, 0, 0], [2, 2, 2]])
    one = 2.0 * 0.1**2 / 2 * (np.log1p(0.01) + np.log1p(49.9**2))
    assert cost == pytest.approx(2 * one)
