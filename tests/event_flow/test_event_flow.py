"""Dense flow from events: closed forms, oracles, invariances and bad input."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator

from jaxevent.errors import InputError
from jaxevent.event_flow import FlowParams, WindowPaths, flow_from_events
from jaxevent.event_flow.alignment import Alignment
from jaxevent.parameters import Parameters
from jaxevent.recording import Events, Recording
from jaxevent.simulate.faults import add_hot_pixels

WIDTH, HEIGHT = 64, 48


def record(t, x, y, p) -> Recording:
    columns = (
        np.asarray(c, kind) for c, kind in zip((t, x, y, p), ("i8", "u2", "u2", "?"), strict=True)
    )
    return Recording("made", WIDTH, HEIGHT, Events(*columns))


def moving_points(velocity, acceleration=(0.0, 0.0), duration=0.2, count=160, seed=3) -> Recording:
    """Points whose rounded places change make an event each: x = x0 + v t + a t^2 / 2."""
    rng = np.random.default_rng(seed)
    reach = np.abs(velocity) * duration + np.abs(acceleration) * duration**2 / 2
    start = rng.uniform(-reach, np.array([WIDTH, HEIGHT]) + reach, (count * 4, 2))
    sign = rng.random(len(start)) < 0.5
    times = np.arange(0, duration, 2e-4)
    parts = []
    for place, p in zip(start, sign, strict=True):
        path = place + np.outer(times, velocity) + np.outer(times**2 / 2, acceleration)
        pixel = np.rint(path).astype(int)
        new = np.r_[False, (pixel[1:] != pixel[:-1]).any(1)]
        new &= (pixel >= 0).all(1) & (pixel < [WIDTH, HEIGHT]).all(1)
        t = np.rint(times[new] * 1e6).astype(int)
        parts.append(np.stack([t, *pixel[new].T, np.full(len(t), p)], 1))
    rows = np.concatenate(parts)
    return record(*rows[np.lexsort((rows[:, 1], rows[:, 2], rows[:, 0]))].T)


@pytest.mark.parametrize("velocity", [(150.0, 0.0), (-60.0, 80.0), (10.0, -500.0)])
def test_flow_of_constant_velocity(velocity):
    flow = flow_from_events(moving_points(velocity))
    mean, covariance, valid = flow([0.06, 0.1])
    speed = np.hypot(*velocity)
    error = np.linalg.norm(mean - velocity, axis=-1)
    assert np.median(error) < 0.05 * speed
    assert valid.mean() > 0.8
    e = (mean - velocity)[valid]
    z2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(covariance[valid]), e) / 2
    assert z2.mean() < 2


def test_flow_leaves_many_hot_pixels_out():
    # Windows count events: with those of hot pixels nothing would move in them.
    velocity = (150.0, 0.0)
    flow = flow_from_events(add_hot_pixels(moving_points(velocity), share=0.2, rate=2000.0))
    mean, _, valid = flow([0.06, 0.1])
    assert np.median(np.linalg.norm(mean - velocity, axis=-1)) < 15
    assert valid.mean() > 0.7


def test_flow_follows_acceleration():
    v, a = np.array([60.0, 20.0]), np.array([800.0, -300.0])
    flow = flow_from_events(moving_points(v, a))
    for t in (0.06, 0.1, 0.14):
        assert np.median(np.linalg.norm(flow.flow([t])[0] - v - a * t, axis=-1)) < 12
    # A point's path over a third of the recording, against its closed form.
    x, y = flow.paths(70_000, 130_000, 130_000).carry([20.0], [20.0], [70_000])
    moved = v * 0.06 + a * (0.13**2 - 0.07**2) / 2
    assert np.hypot(x[0] - 20 - moved[0], y[0] - 20 - moved[1]) < 0.6


def test_flow_turns_back_with_the_camera():
    """What came comes back after a stop, with the other polarity."""
    velocity, stop = np.array([90.0, -40.0]), 200_000
    e = moving_points(velocity).events
    back = 2 * stop + 50_000 - e.t[::-1], e.x[::-1], e.y[::-1], ~e.p[::-1]
    both = zip((e.t, e.x, e.y, e.p), back, strict=True)
    flow = flow_from_events(record(*map(np.concatenate, both)))
    for t, true in ((0.1, velocity), (0.18, velocity), (0.27, -velocity), (0.35, -velocity)):
        assert np.median(np.linalg.norm(flow.flow([t])[0] - true, axis=-1)) < 25
    x, y = flow.paths(150_000, 300_000, 300_000).carry([30.0], [20.0], [150_000])
    assert np.hypot(x[0] - 30, y[0] - 20) < 0.5


def test_carry_solves_the_differential_equation():
    rng = np.random.default_rng(0)
    knots = np.array([0, 4_000, 15_000, 20_000])
    smooth = rng.normal(size=(4, 4, 5, 2)) * 200
    grid = (np.linspace(0, 1, 4), np.linspace(0, 1, 5))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    at = np.stack([y / (HEIGHT - 1), x / (WIDTH - 1)], -1)
    velocity = np.stack([RegularGridInterpolator(grid, one)(at) for one in smooth])
    field = RegularGridInterpolator((knots * 1e-6, np.arange(HEIGHT), np.arange(WIDTH)), velocity)

    def rate(t, state):
        where = [np.clip(t, 0, 0.02), *np.clip(state[::-1], 0, [HEIGHT - 1, WIDTH - 1])]
        return field(where)[0]

    paths = WindowPaths(9_000, knots, velocity.astype(np.float32))
    start = np.array([[30.0, 20.0, 1_000], [12.5, 30.2, 19_000], [40.0, 8.0, 9_000], [5, 5, -500]])
    found = np.stack(paths.carry(*start[:, :2].T, start[:, 2].astype(np.int64)), 1)
    for row, (px, py, t) in zip(found, start, strict=True):
        if t == paths.at:
            assert tuple(row) == (px, py)
            continue
        span = (t * 1e-6, paths.at * 1e-6)
        true = solve_ivp(rate, span, [px, py], rtol=1e-8, atol=1e-8, max_step=5e-4).y[:, -1]
        assert np.linalg.norm(row - true) < 0.02


def test_carry_returns():
    velocity = np.random.default_rng(1).normal(size=(3, 1, 1, 2)) * 100 + np.zeros(
        (HEIGHT, WIDTH, 1)
    )
    knots = np.array([0, 10_000, 30_000])
    x, y = np.array([10.0, 30.0]), np.array([20.0, 11.0])
    there = WindowPaths(28_000, knots, velocity.astype(np.float32)).carry(x, y, np.array([0, 0]))
    back = WindowPaths(0, knots, velocity.astype(np.float32)).carry(*there, np.array([28_000] * 2))
    assert np.allclose(back, (x, y), atol=1e-3)


def test_results_do_not_depend_on_time_or_order():
    recording = moving_points((200.0, 60.0), count=240)
    first = flow_from_events(recording)([0.03, 0.1, 0.15])
    other = flow_from_events(recording)
    other([0.19])
    other.paths(100_000, 150_000, 120_000)
    e = recording.events[:]
    shifted = dataclasses.replace(recording, events=Events.of_checked(e.t + 10**12, e.x, e.y, e.p))
    late = flow_from_events(shifted)(np.array([30_000, 100_000, 150_000]) + 10**12)
    for a, b, c in zip(first, other([0.03, 0.1, 0.15]), late, strict=True):
        assert np.array_equal(a, b) and np.array_equal(a, c)


def test_causal_flow_uses_no_later_events():
    recording = moving_points((200.0, 60.0), count=240)
    whole = flow_from_events(recording, causal=True)
    t = 120_000
    until = dataclasses.replace(recording, events=recording.events[: recording.events.index(t + 1)])
    cut = flow_from_events(until, causal=True)
    for a, b in zip(whole([t]), cut([t]), strict=True):
        assert np.array_equal(a, b)
    assert np.median(np.linalg.norm(whole.flow([t])[0] - [200, 60], axis=-1)) < 15
    assert not whole([0], extrapolate=True)[2].any()


def still(kind: str) -> Recording:
    rng = np.random.default_rng(5)
    if kind == "one":
        return record([5000], [3], [4], [True])
    n = 4000
    t = np.sort(rng.integers(0, 200_000, n))
    if kind == "pixel":
        return record(t, np.full(n, 7), np.full(n, 9), np.arange(n) % 2)
    if kind == "burst":
        t = np.sort(np.r_[t[::40], 90_000 + rng.integers(0, 1000, n - n // 40)])
    if kind == "hot pixels":
        x, y = (rng.integers(0, size, 40)[rng.integers(0, 40, n)] for size in (WIDTH, HEIGHT))
        return record(t, x, y, rng.random(n) < 0.5)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    p = np.ones(n) if kind == "all ON" else rng.random(n) < 0.5
    return record(np.full(n, 7) if kind == "one time" else t, x, y, p)


@pytest.mark.parametrize(
    "kind", ["one", "pixel", "noise", "all ON", "one time", "burst", "hot pixels"]
)
def test_what_shows_no_motion_is_finite_and_not_valid(kind):
    flow = flow_from_events(still(kind))
    mean, covariance, valid = flow([5_000, 100_000], extrapolate=True)
    assert np.isfinite(mean).all() and np.isfinite(covariance).all()
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert valid.mean() < 0.05
    x, y = flow.paths(0, 200_000, 50_000).carry([5.0], [6.0], [150_000])
    assert np.isfinite([x, y]).all()


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (1, 24), (9, 8)])
def test_tiny_sensors(size):
    rng, n = np.random.default_rng(6), 300
    x, y = (rng.integers(0, side, n).astype(np.uint16) for side in size)
    events = Events(np.arange(n) * 200, x, y, rng.random(n) < 0.5)
    flow = flow_from_events(Recording("tiny", *size, events))
    mean, covariance, _ = flow([0.03])
    assert mean.shape == (1, size[1], size[0], 2)
    assert np.isfinite(mean).all() and np.isfinite(covariance).all()
    assert np.isfinite(flow.paths(0, 50_000, 9_000).carry([0.0], [0.0], [30_000])).all()


def test_surface_is_that_of_most_nodes():
    align = Alignment((180, 240), FlowParams())
    rows, columns = align.nodes
    y, x = np.mgrid[:rows, :columns] / 15
    y, x = y - y.mean(), x - x.mean()
    a, A, c = np.array([3.0, -1.0]), np.array([[0.3, -2.0], [2.0, -0.4]]), np.array([0.6, -0.9])
    at = np.stack([x, y], -1)
    true = a + at @ A.T + (at @ c)[..., None] * at
    u = true + np.random.default_rng(4).normal(0, 0.02, true.shape)
    u[4:10, 5:14] += [4.0, 2.0]  # an object of its own motion
    normal = np.zeros((rows, columns, 6))
    normal[..., 2], normal[..., 3], normal[..., 4] = 40, 10, 30
    surface = u
    for _ in range(5):
        surface = align._fit_surface(u, surface, normal)
    assert np.abs(surface - true).max() < 0.1


def test_the_component_along_an_edge_is_uncertain():
    # Every row of a vertical edge makes an event where the edge enters a column, but for one in
    # ten, within a millisecond.
    rng, speed = np.random.default_rng(2), 150.0
    edges = np.sort(rng.uniform(-20, WIDTH, 14))
    y, x, k = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), np.arange(len(edges)))
    t = (x - edges[k]) / speed + rng.uniform(0, 1e-3, x.shape)
    keep = (t >= 0) & (t < 0.12) & (rng.random(x.shape) < 0.9)
    order = np.argsort(t[keep], kind="stable")
    rows = [np.rint(t[keep] * 1e6), x[keep], y[keep], (k % 2)[keep]]
    recording = record(*(column[order] for column in rows))
    mean, covariance, _ = flow_from_events(recording)([0.06])
    assert np.median(np.abs(mean[..., 0] - speed)) < 0.15 * speed
    across, along = (np.median(np.sqrt(covariance[..., i, i])) for i in (0, 1))
    assert along > 3 * across
    assert np.median(np.abs(mean[..., 1])) < 3 * along


def test_other_parameters_are_refused():
    with pytest.raises(InputError, match="FlowParams"):
        flow_from_events(still("one"), Parameters())
    with pytest.raises(InputError, match="extrapolate"):
        flow_from_events(still("one"), FlowParams())([9.0])
