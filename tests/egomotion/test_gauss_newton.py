"""What the fits of a window share: solution, acceptance, limits and the priors' pull."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent.egomotion.batch_fit import gauss_newton
from jaxevent.egomotion.batch_fit.gauss_newton import Acceptance, accept, conjugate_gradients
from jaxevent.egomotion.batch_fit.path import SEGMENTS, Path, Prior

K = 3
HALF = 0.15


def spd(n: int) -> np.ndarray:
    root = np.random.default_rng(n).normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def test_conjugate_gradients_solve():
    """A dense system, whose unknowns are a pytree, in as many steps as it has numbers."""
    H, side = spd(12), np.random.default_rng(0).normal(size=12)

    def joined(v):
        return jnp.concatenate([v[0], v[1].ravel()])

    def apart(v):
        return v[:4], v[4:].reshape(2, 4)

    found = conjugate_gradients(
        lambda v: apart(H @ joined(v)), lambda v: v, apart(jnp.asarray(side)), 16
    )
    np.testing.assert_allclose(joined(found), np.linalg.solve(H, side), rtol=1e-8)


def test_an_exact_preconditioner_needs_one_step():
    H, side = spd(8), jnp.ones(8)
    found = conjugate_gradients(lambda v: H @ v, lambda v: jnp.linalg.solve(H, v), side, 1)
    np.testing.assert_allclose(found, np.linalg.solve(H, side), rtol=1e-9)


def number(value: float) -> jax.Array:
    return jnp.asarray(value)


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
    now = accept(
        Acceptance(number(before[0]), number(before[1])), jnp.asarray(better), number(gain),
        number(1.0), jnp.asarray(True),
    )  # fmt: skip
    assert (float(now.momentum), float(now.damping)) == pytest.approx(after)
    assert bool(now.goes_on) == (after[1] < 50)


def test_steps_are_limited():
    assert float(gauss_newton.limit_step(jnp.array([1.0, -8.0]))) == 0.5
    assert float(gauss_newton.limit_step(jnp.array([1.0, -3.0]))) == 1


def a_path() -> Path:
    rng = np.random.default_rng(1)
    return Path(*(jnp.asarray(rng.normal(size=shape)) for shape in ((5, 3), (5, 3), (7,))))


def test_rows_are_put_back():
    path = a_path()
    rows = gauss_newton.first_rows(path, K)
    moved = gauss_newton.with_first_rows(path, 2 * rows, K)
    np.testing.assert_allclose(gauss_newton.first_rows(moved, K), 2 * rows)
    np.testing.assert_array_equal(moved.O[K:], path.O[K:])
    np.testing.assert_array_equal(moved.D[K:], path.D[K:])
    # Omega of 1 / (f h) moves an image by 1 px at the window's end, its change by 2 / (f h^2).
    unit = gauss_newton.units_of_rows(path, number(80.0), number(HALF), K).reshape(2, K, 3)
    np.testing.assert_allclose(unit[0, :, 0], [1 / 12, 2 / 1.8, 6 / 0.27], rtol=1e-12)
    usual = np.exp(np.median(path.log_rho))
    np.testing.assert_allclose(unit[1], unit[0] / usual, rtol=1e-12)


def test_priors_pull_as_written():
    rng = np.random.default_rng(2)
    now, unit = rng.normal(size=6 * K), rng.uniform(0.5, 2, 6 * K)
    one, gyro = jnp.asarray(1.0), rng.normal(size=(SEGMENTS, 3))
    prior = Prior(one, one, number(0.3), number(0.7), jnp.asarray(gyro), number(2.0), one, one, one)
    O = (now * unit)[: 3 * K].reshape(K, 3)  # noqa: E741
    t = ((np.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * HALF
    seen = O[0] + O[1] * t[:, None] + O[2] * t[:, None] ** 2 / 2
    changes = np.concatenate([now[3 : 3 * K], now[3 * K + 3 :]])
    expected = 0.7 * (O[0] ** 2).sum() + 0.3 * (changes**2).sum()
    expected += 2.0 / SEGMENTS * ((seen - gyro) ** 2).sum() + 0.5
    cost = gauss_newton.pull_of_rows(
        jnp.asarray(now), jnp.asarray(unit), prior, number(HALF), K, 0.5
    )
    assert float(cost) == pytest.approx(expected / 2, rel=1e-12)


def test_bonds_give_way_at_edges():
    log_rho = jnp.array([0.0, 0.01, 5.0])
    pairs = jnp.array([0, 1]), jnp.array([1, 2])
    apart, bond = gauss_newton.bonds_between(log_rho, pairs, number(2.0), 0.1)
    np.testing.assert_allclose(apart, [-0.01, -4.99])
    np.testing.assert_allclose(bond, [2 / 1.01, 2 / (1 + 49.9**2)])
