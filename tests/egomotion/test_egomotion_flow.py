"""Flow of events from a known motion: against a slow search, closed forms and a scene's truth."""

import dataclasses
import functools

import numpy as np
import pytest
from points import recorded, scattered, search_candidates

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import flow as module
from jaxevent.egomotion.flow import Params, RigidFlow, flow, iterate_flow
from jaxevent.egomotion.models import find_model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.errors import InputError
from jaxevent.recording import Events
from jaxevent.simulate import motion_scene

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, F = 96, 72, 80.0
CAMERA = PinholeCamera(F, F, 47.5, 35.5)


@functools.cache
def textured():
    """From 0.05 to 0.15 s; flow is known about 50 ms later."""
    recording, source = motion_scene("texture", size=(WIDTH, HEIGHT), focal=F, duration=0.16)
    return recording[0.05:0.15], source


def known(model, mean, t=(0, 300_000), valid=None):
    n = len(find_model(model).components)
    mean = np.broadcast_to(np.asarray(mean, float), (len(t), n))
    return MotionEstimate.from_arrays(model, np.array(t), mean, np.zeros((len(t), n, n)), valid)


def true_motion(source, sign=1):
    t = np.arange(0, 160_001, 5_000)
    T, Omega = source.twist(t)
    return known("general", np.c_[sign * T / np.linalg.norm(T, axis=1, keepdims=True), Omega], t)


def project_later(x, y, T, Omega, inverse_depth):
    """Image velocity (px/s) of the scene's points, by projecting them a moment later."""
    h = 1e-6
    P = np.stack([x / F, y / F, np.ones_like(x)], -1) / inverse_depth[..., None]
    P_later = P + h * (-T - np.cross(Omega, P))
    return F * (P_later[..., :2] / P_later[..., 2:] - P[..., :2] / P[..., 2:]) / h


def test_flow_of_a_scene_is_the_true_one(optimised):
    recording, source = textured()
    told = flow(recording, true_motion(source))
    events = recording.events
    late = events.t > 100_000
    T, Omega = source.twist(events.t)
    depth = np.stack([source.depth(float(t)) for t in np.arange(0, 0.16, 0.01)])
    Z = depth[np.rint(events.t / 1e4).astype(int), events.y, events.x]
    U = project_later(events.x - 47.5, events.y - 35.5, T, Omega, 1 / Z)
    assert told.valid[late].mean() > 0.85
    use = told.valid & late
    error = np.linalg.norm(told.flow - U, axis=1) / np.linalg.norm(U, axis=1)
    assert np.median(error[use]) < 0.12  # 0.09 when written
    assert (told.residual[told.valid] <= 1).all()
    assert np.isnan(told.flow[~told.valid]).all()
    # A camera that moves the other way explains less.
    flipped = flow(recording, true_motion(source, -1))
    outlier, flipped = told.residual > 1, flipped.residual > 1
    assert flipped[late].mean() > 2 * outlier[late].mean()  # 0.19 and 0.08


def test_field_of_a_scene_is_the_true_one(optimised):
    recording, source = textured()
    t = 120_000
    found = RigidFlow(recording, true_motion(source)).flow(np.array([t]))[0]
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    T, Omega = (v[0] for v in source.twist(np.array([t])))
    U = project_later(x - 47.5, y - 35.5, T, Omega, 1 / source.depth(t * 1e-6))
    error = np.linalg.norm(found - U, axis=-1)
    assert np.median(error) < 0.12 * np.median(np.linalg.norm(U, axis=-1))


def test_field_of_a_rotation_is_that_of_turned_rays():
    camera = PinholeCamera(40.0, 55.0, 8.3, 6.1, (-0.2, 0.05, 0.01, -0.005, 0.0))
    Omega, h = np.array([0.7, -0.4, 1.5]), 1e-5
    recording = dataclasses.replace(events_without_order(), camera=camera)
    moving = RigidFlow(recording, known("rotation", Omega))
    found = moving.flow(np.array([30_000, 40_000]))
    y, x = np.mgrid[:13, :17].astype(float)
    pixels = np.stack([x.ravel(), y.ravel()], -1)
    ray = np.c_[camera.normalise(*pixels.T), np.ones(13 * 17)]
    later = ray - h * np.cross(Omega, ray)
    true = (camera.distort(later[:, :2] / later[:, 2:]) - pixels) / h
    np.testing.assert_allclose(found[1].reshape(-1, 2), true, rtol=0.02, atol=0.3)
    lost = RigidFlow(recording, known("rotation", Omega, valid=np.zeros(2, bool)))
    assert np.isnan(lost.flow(np.array([30_000]))).all()
    bare = dataclasses.replace(recording, camera=None)
    with pytest.raises(InputError, match="needs; give camera="):
        RigidFlow(bare, known("rotation", Omega)).flow(np.array([30_000]))


def events_without_order(number=500, span=60_000, seed=0):
    return scattered(number, span, 17, 13, 50, seed, PinholeCamera(20.0, 20.0, 7.3, 6.1))


def estimate_by_loops(recording, row, base, a, params):
    """Flow and residual of an event by looking at all earlier ones, one after another."""
    sigma, b, oldest = float(params.sigma_x), float(params.baseline), 1e6 * float(params.tau_max)
    near = search_candidates(recording, row, params.radius, params.per_pixel, 1, oldest)
    found = [(np.array([dx, dy], float), age * 1e-6) for dx, dy, age in near]

    def inside(rho, age):
        return b / 2 <= age * np.linalg.norm(base + rho * a) <= b

    def vote(rho, d, age):
        return np.exp(-(np.linalg.norm(d - age * (base + rho * a)) ** 2) / (2 * sigma**2))

    rho = 0.0
    if a.any():
        factor = float(params.fastest / params.slowest) ** (1 / (params.speeds - 1))
        grid = [0.0, *(float(params.slowest) * factor**k for k in range(params.speeds))]
        S = [
            np.linalg.norm(base + rho * a) ** float(params.gain)
            * sum(vote(rho, d, age) for d, age in found if inside(rho, age))
            for rho in grid
        ]
        rho = grid[int(np.argmax(S))]
        for _ in range(2):
            w = [(vote(rho, d, age), d, age) for d, age in found if inside(rho, age)]
            moment = sum(v * age**2 for v, _, age in w)
            if moment > 0:
                along = sum(v * age * ((d - age * base) @ a) for v, d, age in w)
                rho = min(max(along / moment, 0), float(params.fastest))
    left = [np.linalg.norm(d - age * (base + rho * a)) for d, age in found if inside(rho, age)]
    return base + rho * a, min(left, default=np.inf)


# Rotations differ from general motion in the half-line alone.
@pytest.mark.parametrize("model", ["planar", "general"])
def test_flow_equals_a_loop(model):
    recording = events_without_order()
    params = Params.of({"candidates": 256, "radius": 4, "baseline": 3.1, "speeds": 7, "limit": 0.7})
    mean = [180.0, -60.0] if model == "planar" else [0.6, 0.0, 0.8, 3.0, -4.0, 9.0]
    told = flow(recording, known(model, mean), params)
    e = recording.events
    x, y = e.x - 7.3, e.y - 6.1
    one, ahead = np.ones(1), np.zeros(3)
    for row in range(0, len(e), 7):
        u, v, a = x[row : row + 1], y[row : row + 1], np.zeros(2)
        if model == "planar":
            base = np.array(mean)
        else:
            # Cameras of f = 20 px and of F see the same rays.
            u, v = u * F / 20, v * F / 20
            base = project_later(u, v, ahead, np.array(mean[-3:]), one)[0] * 20 / F
            a = project_later(u, v, np.array(mean[:3]), ahead, one)[0]
            a = a / np.linalg.norm(a)
        U, residual = estimate_by_loops(recording, row, base, a, params)
        np.testing.assert_allclose(told.residual[row], residual, rtol=1e-3, atol=1e-4)
        assert told.valid[row] == (model != "general" or residual <= 0.7)
        if told.valid[row]:
            np.testing.assert_allclose(told.flow[row], U, rtol=1e-3, atol=1e-2)


def test_pieces_are_the_whole(monkeypatch):
    recording, source = textured()
    recording = recording[:0.08]
    motion = true_motion(source)
    whole = flow(recording, motion)
    assert len(whole.valid) == len(recording.events)
    monkeypatch.setattr(module, "BATCHES_PER_CHUNK", 3)
    parts = list(iterate_flow(recording, motion))
    assert len(parts) == -(-len(recording.events) // (3 * module.EVENTS_PER_BATCH))
    for name in ("flow", "valid", "residual"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-5)


def test_where_the_motion_is_lost_there_is_no_flow():
    recording = events_without_order()
    motion = known("planar", [100.0, 50.0], t=(0, 20_000, 40_000), valid=np.array([1, 0, 1], bool))
    told = flow(recording, motion)
    between = (recording.events.t > 0) & (recording.events.t < 40_000)
    assert np.array_equal(told.valid, ~between)
    assert np.isnan(told.flow[between]).all() and np.isnan(told.residual[between]).all()
    assert (told.flow[~between] == [100, 50]).all() and told.flow.dtype == np.float32
    late = known("planar", [[0.0, 0.0], [60.0, 0.0]], t=(20_000, 80_000))
    told = flow(recording, dataclasses.replace(late, lag=np.full(2, 0.02)))
    np.testing.assert_allclose(told.flow[:, 0], recording.events.t * 1e-3, atol=1e-3)
    nothing = flow(recording, MotionEstimate.empty("planar"))
    assert not nothing.valid.any() and nothing.outlier_percentage() == 0


def test_noise_is_an_outlier(optimised):
    recording, source = textured()
    rng = np.random.default_rng(0)
    n, e = 2000, recording.events
    t = np.r_[e.t, np.sort(rng.integers(50_000, 150_000, n))]
    x, y = np.r_[e.x, rng.integers(0, WIDTH, n)], np.r_[e.y, rng.integers(0, HEIGHT, n)]
    order = np.argsort(t, kind="stable")
    noisy = recorded(t, x, y, np.r_[e.p, rng.random(n) < 0.5], WIDTH, HEIGHT, recording.camera)
    drawn = (order >= len(e)) & (noisy.events.t > 100_000)
    real = (order < len(e)) & (noisy.events.t > 100_000)
    told = flow(noisy, true_motion(source))
    outlier = told.residual > 1
    assert outlier[drawn].mean() > 2 * outlier[real].mean()


def test_bad_input():
    recording = dataclasses.replace(events_without_order(), camera=None)
    with pytest.raises(InputError, match="made: has no calibration, which the flow of rot"):
        flow(recording, known("rotation", [1.0, 2.0, 3.0]))
    assert flow(recording, known("planar", [1.0, 2.0])).valid.all()
    empty = dataclasses.replace(recording, events=Events.empty())
    assert flow(empty, known("planar", [1.0, 2.0])).flow.shape == (0, 2)


def test_single_precision(float32):
    recording, source = textured()
    told = flow(recording[:0.12], true_motion(source))
    assert told.valid.mean() > 0.5 and np.isfinite(told.flow[told.valid]).all()
