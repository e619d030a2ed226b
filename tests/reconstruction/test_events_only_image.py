"""One window of events to one log image: rows, energy, solver and variance."""

import numpy as np
import pytest

from jaxevent.reconstruction.events_only.prior import GradientPrior, SolverParams
from jaxevent.reconstruction.events_only.rows import EVENT, FIRST, LAST, SILENT, make_rows
from jaxevent.reconstruction.events_only.solve import solve
from jaxevent.recording import Events

C = np.float32([0.2, 0.2])


class Translation:
    """Paths of points that move with one velocity, px/s, towards the time 0."""

    covariance = None
    spacing = 1.0

    def __init__(self, velocity):
        self.velocity = velocity

    def carry(self, x, y, t):
        s = t * 1e-6
        return (
            (x - self.velocity[0] * s).astype(np.float32),
            (y - self.velocity[1] * s).astype(np.float32),
        )


def record(level, velocity, half=0.05, step=1e-4, c=0.2):
    """Simulate an ideal sensor that sees a falling level(x, y); its reference is above it."""
    shape = (12, 16)
    y, x = np.indices(shape, float)
    reference = level(x + velocity[0] * half, y + velocity[1] * half)
    reference = reference + np.random.default_rng(0).uniform(0, c, shape)
    columns = []
    for s in np.arange(-half, half, step):
        now = level(x - velocity[0] * s, y - velocity[1] * s)
        fired = np.abs(now - reference) >= c
        sign = np.sign(now - reference)
        for j, i in np.argwhere(fired):
            columns.append((round(s * 1e6), i, j, sign[j, i] > 0))
        reference = np.where(fired, reference + sign * c, reference)
    t, px, py, p = (np.array(column) for column in zip(*columns, strict=True))
    return Events(t.astype(np.int64), px, py, p), shape, (round(-half * 1e6), round(half * 1e6))


def ramp(x, y):
    return 0.15 * x + 0.05 * y


def dense_rows(rows):
    """Matrix of the rows, double precision."""
    D = np.zeros((len(rows.change), rows.shape[0] * rows.shape[1]))
    width = rows.shape[1]
    for k in range(len(D)):
        for side, sign in ((0, 1), (1, -1)):
            x, y = rows.fraction[k, side].astype(float)
            i = int(rows.corner[k, side])
            D[k, i] += sign * (1 - x) * (1 - y)
            D[k, i + 1] += sign * x * (1 - y)
            D[k, i + width] += sign * (1 - x) * y
            D[k, i + width + 1] += sign * x * y
    return D


def central(n):
    """Matrix of central differences, one-sided at the ends."""
    G = np.zeros((n, n))
    for k in range(n):
        low, high = max(k - 1, 0), min(k + 1, n - 1)
        G[k, high] += 1 / (high - low)
        G[k, low] -= 1 / (high - low)
    return G


def energy(u, rows, params, prior=None):
    """E (3) in double precision."""
    weight = np.where(rows.kind == EVENT, 1, params.silence) * rows.weight
    e = dense_rows(rows) @ u.ravel() - rows.change
    total = (weight * params.tail**2 * np.log1p(e**2 / (2 * params.tail**2))).sum()
    across, down = np.diff(u, axis=1) ** 2, np.diff(u, axis=0) ** 2
    q = (across[:-1] + across[1:] + down[:, :-1] + down[:, 1:]) / 2
    total += params.gradient / 2 * np.log1p(q / params.edge**2).sum()
    if prior is not None:
        g = np.stack([u @ central(u.shape[1]).T, central(u.shape[0]) @ u], -1)
        g = g - prior.gradient / rows.threshold
        total += np.einsum("hwi,hwij,hwj", g, prior.information * rows.threshold**2, g) / 2
    return total + params.leak / 2 * (u**2).sum()


@pytest.fixture(scope="module")
def window():
    events, shape, span = record(ramp, (60.0, 20.0))
    return make_rows(events, Translation((60.0, 20.0)), C, shape, span)


def make_prior(shape, seed=3):
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(*shape, 2, 2)).astype(np.float32)
    return GradientPrior(
        (0.1 * rng.normal(size=(*shape, 2))).astype(np.float32), 20 * F @ F.swapaxes(-1, -2)
    )


def converge(rows, params, prior=None):
    image = None
    for _ in range(30):
        image = solve(rows, prior, params, image, variance=False).log_image
    return image / rows.threshold


def test_kinds_of_rows():
    events = Events(np.array([-10, 0, 10]), [3, 3, 4], [2, 2, 2], [True, False, True])
    rows = make_rows(events, Translation((0.0, 0.0)), np.float32([0.1, 0.3]), (5, 6), (-20, 20))
    assert np.bincount(rows.kind).tolist() == [1, 2, 2, 28]
    found = {kind: rows.change[rows.kind == kind].tolist() for kind in (EVENT, FIRST, LAST)}
    assert found[EVENT] == pytest.approx([-1.5])
    assert found[FIRST] == pytest.approx([0.275, 0.275])
    assert found[LAST] == pytest.approx([-0.45, 0.15])
    assert not rows.change[rows.kind == SILENT].any()


def test_rows_outside_the_image_are_left_out():
    nothing = Events(*(np.zeros(0, kind) for kind in (np.int64, np.uint16, np.uint16, bool)))
    rows = make_rows(nothing, Translation((20.0, 0.0)), C, (5, 6), (-100_000, 100_000))
    # Pixels see from 2 px left to 2 px right of them.
    assert sorted(rows.pixel % 6) == [2] * 5 + [3] * 5


@pytest.mark.parametrize("seed", [None, 3])
def test_solution_makes_the_energy_stationary(window, seed):
    params = SolverParams(gradient=0.3, edge=0.3, leak=1e-3)
    prior = None if seed is None else make_prior(window.shape, seed)
    u = converge(window, params, prior).astype(float)
    rng = np.random.default_rng(1)
    for _ in range(5):
        d = rng.normal(size=u.shape)
        slope = (
            energy(u + 1e-4 * d, window, params, prior)
            - energy(u - 1e-4 * d, window, params, prior)
        ) / 2e-4
        bend = energy(u + d, window, params, prior) - energy(u, window, params, prior)
        assert abs(slope) < 2e-3 * bend


def test_quadratic_problem_equals_the_dense_one(window):
    # Without tails and with wide edges the energy is a quadratic form.
    params = SolverParams(tail=1e3, gradient=40.0, edge=20.0, leak=1e-2)
    prior = make_prior(window.shape)
    height, width = window.shape
    root = np.sqrt(window.weight.astype(float))
    D, d = root[:, None] * dense_rows(window), root * window.change
    s = params.gradient / (2 * params.edge**2)
    A = D.T @ D + params.leak * np.eye(height * width)
    for axis, n in ((0, height), (1, width)):
        step, other = np.diff(np.eye(n), axis=0), window.shape[1 - axis]
        share = np.full(other, 2.0)
        share[[0, -1]] = 1
        parts = (step.T @ step, np.diag(share))
        A += s * np.kron(*(parts if axis == 0 else parts[::-1]))
    c = window.threshold
    G = np.stack([np.kron(np.eye(height), central(width)), np.kron(central(height), np.eye(width))])
    L = prior.information.reshape(-1, 2, 2) * c**2
    A += np.einsum("ipa,pij,jpb->ab", G, L, G)
    g = prior.gradient.reshape(-1, 2) / c
    b = D.T @ d + np.einsum("ipa,pij,pj->a", G, L, g)
    exact = np.linalg.solve(A, b).reshape(height, width)
    found = converge(window, params, prior)
    assert found - found.mean() == pytest.approx(exact - exact.mean(), abs=1e-3 * np.ptp(exact))


def test_ramp_is_recovered_along_the_motion():
    events, shape, span = record(ramp, (60.0, 0.0))
    rows = make_rows(events, Translation((60.0, 0.0)), C, shape, span)
    found = solve(rows, None, SolverParams(gradient=1e-3)).log_image
    y, x = np.indices(shape)
    slopes = np.diff(found, axis=1)[:, 3:-3]
    assert slopes.mean() == pytest.approx(np.diff(ramp(x, y), axis=1).mean(), rel=0.05)
    assert slopes.std() < 0.05


def test_image_depends_on_neither_clock_nor_order_of_pixels():
    events, shape, span = record(ramp, (60.0, 20.0))
    image = solve(make_rows(events, Translation((60.0, 20.0)), C, shape, span)).log_image
    again = solve(make_rows(events, Translation((60.0, 20.0)), C, shape, span)).log_image
    assert np.array_equal(image, again)
    flipped = Events(events.t, shape[1] - 1 - events.x.astype(int), events.y, events.p)
    other = solve(make_rows(flipped, Translation((-60.0, 20.0)), C, shape, span)).log_image
    assert other[:, ::-1] == pytest.approx(image, abs=0.05)
    flipped = Events(events.t, events.x, shape[0] - 1 - events.y.astype(int), events.p)
    other = solve(make_rows(flipped, Translation((60.0, -20.0)), C, shape, span)).log_image
    assert other[::-1] == pytest.approx(image, abs=0.05)
    inverted = Events(events.t, events.x, events.y, ~events.p)
    other = solve(make_rows(inverted, Translation((60.0, 20.0)), C, shape, span)).log_image
    assert -other == pytest.approx(image, abs=1e-6)


@pytest.mark.parametrize(
    ("shape", "n"), [((12, 16), 0), ((12, 16), 1), ((1, 1), 5), ((1, 9), 5), ((7, 1), 5)]
)
def test_degenerate_windows(shape, n):
    events = Events(np.arange(n), np.zeros(n, int), np.zeros(n, int), np.arange(n) % 2 == 0)
    solution = solve(make_rows(events, Translation((1e3, 0.0)), C, shape, (-9, 9)))
    assert solution.log_image.shape == solution.variance.shape == shape
    assert np.isfinite(solution.log_image).all() and np.isfinite(solution.variance).all()
    if n == 0:
        assert not solution.log_image.any()


def test_warm_start_costs_fewer_iterations(window):
    first = solve(window, variance=False)
    again = solve(window, start=first.log_image, variance=False)
    assert again.iterations < first.iterations / 2


def test_variance_is_large_where_nothing_was_seen(window):
    seen = solve(window).variance
    events = Events(np.arange(4), [2, 3, 2, 3], [2, 2, 2, 2], [True, False, True, True])
    still = make_rows(events, Translation((0.0, 0.0)), C, window.shape, (-9, 9))
    unseen = solve(still).variance
    assert np.sqrt(unseen).min() > 1 > 2 * np.sqrt(np.median(seen))


def test_errors_have_the_size_of_the_variance():
    def level(x, y):
        return 0.6 * np.sin(0.7 * x + 0.4 * y) - 0.5 * x

    events, shape, span = record(level, (60.0, 20.0))
    solution = solve(make_rows(events, Translation((60.0, 20.0)), C, shape, span))
    y, x = np.indices(shape)
    error = solution.log_image - level(x, y)
    error -= error.mean()
    # Errors of so small an image are few independent ones: the range of scenes in the study.
    assert 0.2 < (error**2 / solution.variance).mean() < 4.5
