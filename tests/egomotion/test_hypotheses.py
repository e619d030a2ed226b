"""Hypotheses of a window, compared on held-out pixels; the thresholds' skew by counts."""

import inspect
from types import SimpleNamespace

import numpy as np
import pytest

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.bundle import hypotheses as h
from jaxevent.egomotion.bundle.hypotheses import HeldOutTest, WindowFitter
from jaxevent.egomotion.bundle.photometric_ba import FitReport
from jaxevent.egomotion.bundle.residuals import Scene
from jaxevent.egomotion.bundle.warp import Path
from jaxevent.egomotion.bundle.windows import Params
from jaxevent.egomotion.geometry import A, B
from jaxevent.recording import Events, Recording


def test_cells_err_independently():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 240, (2, 400))
    one, other = rng.random((2, 400))
    on = (rng.random(400) < 0.9) * 1.0
    costs = {"one": (one, on), "other": (other, on)}
    series: object = SimpleNamespace(x=x, y=y, corner=(0.0, 0.0), shape=(240, 240))
    test = SimpleNamespace(held_out=series, _event_costs=costs.get)
    z = inspect.unwrap(HeldOutTest.z)(test, "one", "other")  # without checks of types
    sums: dict[tuple[int, int], float] = {}
    for i in range(400):
        place = int(x[i] // 48), int(y[i] // 48)
        sums[place] = sums.get(place, 0.0) + on[i] * (one[i] - other[i])
    D = np.array(list(sums.values()))
    assert z == pytest.approx(D.sum() / np.sqrt((D**2).sum()), rel=1e-4)


def test_the_first_hypothesis_gives_way_if_it_is_refuted(monkeypatch):
    """By the one with the largest z on held-out pixels."""
    before = {("b", "a"): 2.1, ("c", "a"): 2.4, ("b", "c"): 1.9}  # z of the first over the second
    z = before | {(two, one): -value for (one, two), value in before.items()}
    monkeypatch.setattr(HeldOutTest, "z", lambda self, one, other: z[other, one])
    best = inspect.unwrap(HeldOutTest.best)
    trial = object.__new__(HeldOutTest)
    assert best(trial, ["a", "b", "c"]) == 2
    assert best(trial, ["c", "b"]) == best(trial, ["b", "a", "c"]) == 0
    assert best(trial, ["a"]) == 0


def test_rotation_alone_makes_about_the_same_flow():
    heading, Omega, f, rho = np.array([0.6, -0.8, 0.0]), np.array([0.1, 0.2, 0.3]), 200.0, 0.2
    path = Path.constant_twist(heading, Omega, np.full(4, np.log(rho)))
    still = h.without_translation(path)
    assert np.exp(still.log_rho).max() < 1e-3
    middle = np.asarray(A(0.0, 0.0, f)) @ heading * rho + np.asarray(B(0.0, 0.0, f)) @ Omega
    np.testing.assert_allclose(np.asarray(B(0.0, 0.0, f)) @ still.O[0], middle, rtol=1e-5)


@pytest.mark.parametrize("least_z, better", [(2.9, 0.1), (2.9, -0.1), (3.1, 0.1), (3.1, -0.1)])
@pytest.mark.parametrize("least", ["turn", "sharpest"])
def test_rotation_alone_starts_from_the_sharpest_too(monkeypatch, better, least_z, least):
    """The rotation that held-out events favour is taken; the path's turn may be false.

    If both are refuted with their maps alone, they are not fitted further.
    """
    path = Path.constant_twist(np.array([1.0, 0, 0]), np.array([0.0, 0.9, 0]), np.full(4, -1.0))
    sharpest = np.array([0.3, 0.1, -0.2])
    monkeypatch.setattr(
        HeldOutTest,
        "fit",
        lambda self, path, moves, steps=h.N_TEST_STEPS: (path, moves, steps),
    )
    turn = h.without_translation(path).O[0]
    refuted_least = turn if least == "turn" else sharpest

    def z(self, one, other):
        if other == "moving":
            return least_z if np.allclose(one[0].O[0], refuted_least) else least_z + 0.5
        return better

    monkeypatch.setattr(HeldOutTest, "z", z)
    for name in ("least_z", "likelier"):  # without checks of types, which scenes here have not
        monkeypatch.setattr(HeldOutTest, name, inspect.unwrap(getattr(HeldOutTest, name)))
    (found, moves, steps), refuted = inspect.unwrap(HeldOutTest.fit_rotation)(
        object.__new__(HeldOutTest), path, sharpest, "moving"
    )
    assert refuted == least_z
    assert steps == (h.N_TEST_STEPS if least_z < h.MIN_TRANSLATION_Z else h.N_TEST_MAP_STEPS)
    expected = sharpest if better > 0 else turn
    np.testing.assert_allclose(found.O[0], expected)
    assert not moves and not found.O[1:].any() and np.exp(found.log_rho).max() < 1e-3


def test_motions_before_a_plane_of_similar_cost_remain(monkeypatch):
    """The false one may cost less until the end."""
    path = Path.constant_twist(np.array([1.0, 0, 0]), np.zeros(3), np.full(4, -1.0))
    found = [(Scene(path, None, 0.0), FitReport(0.1, cost, 1.0)) for cost in (5e-5, 6e-5, 9e-5)]
    monkeypatch.setattr(WindowFitter, "rotation", lambda self, centre: np.zeros(3))
    monkeypatch.setattr(WindowFitter, "sample_events", lambda self, centre, half, most: None)
    monkeypatch.setattr(WindowFitter, "planar_hypotheses", lambda self, centre, planes: found)
    monkeypatch.setattr(h, "homography_flow", lambda cut, Omega: None)
    monkeypatch.setattr(h, "planar_solutions", lambda M: [])
    windows = object.__new__(WindowFitter)
    windows.params = Params()
    assert inspect.unwrap(WindowFitter.hypotheses)(windows, 0) == found[:2]


@pytest.mark.parametrize(("z", "cost"), [(1.9, 1.2), (9.0, 1.2), (1.9, 1.6)])
def test_a_hypothesis_that_is_not_refuted_leaves_the_heading_open(monkeypatch, z, cost):
    """Though most events agree: by its likelihood, if it costs about as little."""
    turned = np.array([0.8, 0.6, 0.0]), np.array([0.0, 0.0, 0.3])
    paths = [
        Path.constant_twist(heading, Omega, np.full(4, -1.0))
        for heading, Omega in ((np.array([1.0, 0, 0]), np.zeros(3)), turned)
    ]
    report = FitReport(0.01, 1e-4, 0.9)
    found = [
        (Scene(path, None, 0.0), report._replace(cost=1e-4 * times))
        for path, times in zip(paths, (1.0, cost), strict=True)
    ]
    trial = SimpleNamespace(
        fit=lambda path, steps: path, best=lambda fits: 0, z=lambda one, other: z
    )
    for name, value in {
        "series": None,
        "prior": None,
        "held_out_test": trial,
        "parallax": 20.0,
    }.items():
        monkeypatch.setattr(WindowFitter, name, lambda *_, value=value: value)
    monkeypatch.setattr(WindowFitter, "lens_covariance", lambda self, path: np.zeros((6, 6)))
    monkeypatch.setattr(h, "adjust", lambda series, scene, *_, **__: (scene, report))
    monkeypatch.setattr(h, "_refine", lambda one, *_, **__: one)
    ambiguity = inspect.unwrap(h._ambiguity_covariance)  # without checks of types
    monkeypatch.setattr(h, "_ambiguity_covariance", ambiguity)
    monkeypatch.setattr(h, "compute_covariance", lambda *_, **__: 1e-6 * np.eye(6))
    monkeypatch.setattr(h, "WindowFit", lambda *values: values)
    windows = object.__new__(WindowFitter)
    windows.params, windows.sigma_floor = Params(), {}
    _, covariance, *_, ambiguity = inspect.unwrap(WindowFitter.refine_final)(windows, 0, found)
    apart = np.concatenate([turned[0] - [1, 0, 0], turned[1]])
    more = np.exp(-(z**2) / 2) * np.outer(apart, apart) if cost < h.MAX_SIMILAR_COST_RATIO else 0.0
    told = h.error_inflation(0.9) * 1e-6 * np.eye(6)
    np.testing.assert_allclose(covariance, told + more, rtol=1e-9)
    assert ambiguity**2 == pytest.approx(np.trace((covariance - told)[:3, :3]))


def test_skew_is_that_by_which_pixels_end_where_they_began():
    # Three ON and two OFF events at every pixel; one more shows ON events alone.
    rows = []
    for pixel in range(50):
        for k, on in enumerate([True, False, True, False, True]):
            rows.append((1000 * k + pixel, pixel, on))
    for k in range(30):
        rows.append((100 * k, 60, True))
    t, x, p = zip(*sorted(rows), strict=True)
    none = np.zeros(len(t), np.uint16)
    events = Events(np.array(t), np.array(x, np.uint16), none, np.array(p))
    camera = PinholeCamera(50.0, 50.0, 32.0, 24.0)
    recording = Recording("r", 64, 48, events, camera=camera)
    windows = WindowFitter(recording, Params(), camera)
    skew, weight = windows.skew(2500, 0.1)
    assert skew == pytest.approx(-0.2) and weight == pytest.approx(1 / 0.03**2, rel=0.01)


def test_errors_grow_where_little_is_explained():
    assert h.error_inflation(1.0) == h.error_inflation(0.95) == pytest.approx(2.5**2)
    assert np.sqrt(h.error_inflation(0.58)) == pytest.approx(2.5 * np.exp(5 * 0.37))


@pytest.mark.parametrize("first", [30, 101, 160])
def test_held_out_pixels_are_others(first):
    rng = np.random.default_rng(3)
    pixel = np.repeat(np.arange(60), rng.integers(2, 40, 60))
    t = rng.permutation(len(pixel)) + 1
    order = np.argsort(t)
    x = (pixel[order] % 64).astype(np.uint16)
    events = Events(t[order], x, np.zeros(len(x), np.uint16), np.ones(len(x), bool))
    camera = PinholeCamera(50.0, 50.0, 32.0, 24.0)
    windows = WindowFitter(Recording("r", 64, 48, events, camera=camera), Params(), camera)
    centre, half = len(x) // 2, 1.0
    parts = windows.series(centre, half, 300, first), windows.series(centre, half, 300, 300, first)
    # A recording may be shorter than a window.
    path = Path.constant_twist(np.array([1.0, 0, 0]), np.zeros(3), np.full(4, np.log(0.5)))
    lasts = 1e-6 * (len(x) - 1)
    all_of_them = windows.series(centre, half, 10_000)
    assert windows.parallax(path, all_of_them) == pytest.approx(lasts * 50 * 0.5, rel=0.05)
    held = [set(part.x) for part in parts]
    assert held[0] and held[1] and not held[0] & held[1]
