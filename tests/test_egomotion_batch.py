"""General motion of a window: the warp against rigid geometry, and scenes of points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, geometry
from jaxevent.egomotion.truth import Twists
from jaxevent.errors import InputError
from jaxevent.recording import Events, Recording

WIDTH, HEIGHT, F = 96, 72, 80.0
CAMERA = PinholeCamera(F, F, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
T, OMEGA = np.array([0.5, -0.3, 0.6]), np.array([0.3, -0.5, 0.4])
SECONDS = 0.3


@functools.cache
def seen() -> Recording:
    """Points on a bent surface, 1 to 2 m away, each an event at every pixel that it enters.

    The poses are exp(t (T, Omega)) by the closed form, t from the middle.
    """
    rng = np.random.default_rng(0)
    n = 1500
    at = rng.uniform([-20, -20], [WIDTH + 20, HEIGHT + 20], (n, 2)) - (CAMERA.cx, CAMERA.cy)
    depth = 1.5 + 0.5 * np.sin(at[:, 0] / 25) * np.cos(at[:, 1] / 30)
    points = np.concatenate([at / F, np.ones((n, 1))], 1) * depth[:, None]
    sign, cell, rows = rng.random(n) < 0.5, None, []
    steps = np.linspace(-SECONDS / 2, SECONDS / 2, 600)
    poses = np.asarray(geometry.twist_exp(steps[:, None] * np.r_[T, OMEGA]))
    for t, pose in zip(steps, poses, strict=True):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        xy = np.floor(F * local[:, :2] / local[:, 2:] + (CAMERA.cx + 0.5, CAMERA.cy + 0.5))
        inside = (xy >= 0).all(1) & (xy < (WIDTH, HEIGHT)).all(1)
        if cell is not None:
            new = np.flatnonzero(inside & (xy != cell).any(1))
            when = 1e6 * (t + SECONDS / 2) - 1e6 * SECONDS / 599 * rng.random(len(new))
            rows.append(np.stack([when, *xy[new].T, sign[new]], 1))
        cell = xy
    table = np.concatenate(rows)
    t, x, y, p = table[np.argsort(table[:, 0], kind="stable")].T
    events = Events(
        np.rint(t).astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(bool)
    )
    return Recording("points", WIDTH, HEIGHT, events, camera=CAMERA)


GIVEN = {"events": 8192, "fewest": 500, "starts": 1, "flow_max": 120.0, "cell": 16}
PARAMS = batch.Params.of(GIVEN)


def test_the_warp_is_the_rigid_scene():
    """Points seen by a moving camera go where the camera at the reference time sees them."""
    rng = np.random.default_rng(1)
    O = rng.normal(size=(3, 3)) * [[1.0], [4], [20]]  # noqa: E741
    D = rng.normal(size=(3, 3))
    path = batch.Path(jnp.asarray(O), jnp.asarray(D), jnp.zeros(1))
    C = np.asarray(path.coefficients()[1])
    np.testing.assert_allclose(C[1], D[1] + np.cross(O[0], D[0]))
    tau = rng.uniform(-0.15, 0.15, 50)
    powers = np.stack([tau, tau**2 / 2, tau**3 / 6], 1)
    P = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], 1)
    P *= rng.uniform(2, 5, (50, 1))
    R = Rotation.from_rotvec(powers @ O)
    local = R.apply(P - powers @ C, inverse=True)
    seen = F * local[:, :2] / local[:, 2:]
    rho = 1 / P[:, 2]
    x, y = batch.warp(path, jnp.asarray(F), *(jnp.asarray(v) for v in (*seen.T, tau, rho)))
    exact = F * P[:, :2] / P[:, 2:]
    np.testing.assert_allclose(np.stack([x, y], 1), exact, atol=2e-4)


def test_twists_of_a_path():
    """Against differences of its poses; a constant twist stays one."""
    path = batch.Path(
        jnp.zeros((3, 3)).at[0].set(OMEGA), jnp.zeros((3, 3)).at[0].set(T), jnp.zeros(1)
    )
    heading, Omega = path.twist(np.array([-0.1, 0.0, 0.1]))
    np.testing.assert_allclose(Omega, np.broadcast_to(OMEGA, (3, 3)))
    np.testing.assert_allclose(heading, np.broadcast_to(T / np.linalg.norm(T), (3, 3)), atol=2e-3)
    later = batch.advanced(path, 0.05)
    np.testing.assert_allclose(later.D[0], T / np.linalg.norm(T), atol=1e-3)


@functools.cache
def fitted() -> tuple[batch.Windows, batch.Fit]:
    windows = batch.Windows(seen(), PARAMS, CAMERA)
    fit = windows.fit(150_000, windows.starts(150_000))
    assert fit is not None
    return windows, fit


def test_the_motion_of_a_window_is_found():
    """As far as 96 x 72 pixels tell it: a heading beside a turn, and a turn beside a heading."""
    _, fit = fitted()
    heading, Omega = (part[0] for part in fit.path.twist(0.0))
    assert np.degrees(np.arccos(heading @ T / np.linalg.norm(T))) < 15
    assert np.linalg.norm(Omega - OMEGA) < 0.35 * np.linalg.norm(OMEGA)
    assert fit.agreement > 0.7 and np.isfinite(fit.covariance).all()


def test_the_gradient_of_the_disagreement():
    windows, fit = fitted()
    window = windows.cut(150_000, 0.15, 2048)
    path = jax.tree.map(lambda leaf: leaf + 1e-3, fit.path)
    value = jax.jit(
        lambda O0: batch.disagreement(  # noqa: E731
            dataclasses.replace(path, O=path.O.at[0].set(O0)), window
        )
    )
    slope = jax.jit(jax.grad(value))(path.O[0])
    h = 1e-6
    for axis in np.eye(3):
        difference = (value(path.O[0] + h * axis) - value(path.O[0] - h * axis)) / (2 * h)
        assert slope @ axis == pytest.approx(float(difference), rel=1e-3, abs=1e-5)
    still = batch.Path(0 * path.O, 0 * path.D, path.log_rho)
    assert batch.disagreement(fit.path, window) < 0.9 * batch.disagreement(still, window)


def test_priors_pull():
    windows, fit = fitted()
    window = windows.cut(150_000, 0.15, batch.LAST)
    weak = windows.prior(150_000, 0.15)
    strong = weak._replace(omega=jnp.asarray(1e9))
    path, _ = batch.refine(window, fit.path, strong, 2, 2, PARAMS.iterations)
    assert np.linalg.norm(path.O[0]) < 0.1 * np.linalg.norm(fit.path.O[0])
    t = np.array([0, 300_000])
    wrong = OMEGA + [0.0, 0.2, 0.0]
    windows = batch.Windows(
        seen(), batch.Params.of({**GIVEN, "gyro_std": 1e-5}), CAMERA,
        Twists(t, np.stack([wrong, wrong]), None, 0, 300_000),
    )  # fmt: skip
    prior = windows.prior(150_000, 0.15)
    path, _ = batch.refine(window, fit.path, prior, 2, 2, PARAMS.iterations)
    np.testing.assert_allclose(path.twist(0.0)[1][0], wrong, atol=1e-2)


def test_a_recording_from_end_to_end():
    motion = batch.estimate(seen(), PARAMS)
    mean, covariance, lost = motion(motion.t[len(motion) // 2 :][:1])
    assert not lost[0] and covariance.shape == (1, 6, 6)
    assert np.linalg.norm(mean[0, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos(mean[0, :3] @ T / np.linalg.norm(T))) < 15
    again = batch.estimate(seen(), PARAMS)
    np.testing.assert_array_equal(again.mean, motion.mean)
    few = batch.estimate(seen()[0.0:0.01], PARAMS)
    assert few.lost.all() and np.isfinite(few.mean).all()
    empty = dataclasses.replace(seen(), events=seen().events[:0])
    assert len(batch.estimate(empty, PARAMS)) == 0


def test_what_cannot_be_estimated_is_refused():
    with pytest.raises(InputError, match="calibration"):
        batch.estimate(dataclasses.replace(seen(), camera=None), PARAMS)
    with pytest.raises(InputError, match="general"):
        batch.estimate(seen(), PARAMS, model="generl")
