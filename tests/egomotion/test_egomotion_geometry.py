import inspect
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation
from traced import FULL, products

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import geometry, scores
from jaxevent.egomotion.models import General
from jaxevent.egomotion.truth import gyro_bias, twists_from_gyro, twists_from_poses
from jaxevent.errors import InputError
from jaxevent.recording import Imu, Poses

pytestmark = pytest.mark.slow

# Each a program, in place of one for each of its operations.
geo = types.SimpleNamespace(
    **{name: jax.jit(one) for name, one in inspect.getmembers(geometry, inspect.isfunction)}
)
F = 200.0
RNG = np.random.default_rng(5)
X, Y = RNG.uniform(-120, 120, (2, 40))
Z = RNG.uniform(0.5, 5, 40)
T, OMEGA = np.array([0.5, -0.3, 0.6]), np.array([-0.7, 1.1, 0.4])


def hat(xi):
    """The 4 x 4 matrix of a twist (T, Omega)."""
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]])


def projected(t):
    """Images (n, 2) at t of points seen at (X, Y) at depth Z at time 0, by a constant twist."""
    pose = scipy.linalg.expm(t * hat(np.r_[T, OMEGA]))
    point = np.stack([X * Z / F, Y * Z / F, Z, np.ones_like(Z)])
    seen = np.linalg.inv(pose) @ point
    return (F * seen[:2] / seen[2]).T


def test_flow_is_that_of_a_rendered_rigid_scene():
    h = 2e-4
    # Sixth order differences.
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    numeric = sum(c * (projected(k * h) - projected(-k * h)) for k, c in weights.items()) / h
    U = geo.flow(X, Y, F, T, OMEGA, 1 / Z)
    np.testing.assert_allclose(U, numeric, rtol=1e-9, atol=1e-9 * np.abs(numeric).max())
    # No other sign of either twist does.
    for sign in ((1, -1), (-1, 1), (-1, -1)):
        other = geo.flow(X, Y, F, sign[0] * T, sign[1] * OMEGA, 1 / Z)
        assert np.abs(np.asarray(other) - numeric).max() > 10


def test_bilinear_is_the_determinant_and_zero_at_the_flow():
    U = RNG.normal(0, 100, (40, 2))
    q = U - np.asarray(geo.B(X, Y, F)) @ OMEGA
    a = np.asarray(geo.A(X, Y, F)) @ T
    value = np.asarray(geo.bilinear(X, Y, F, U, T, OMEGA))
    np.testing.assert_allclose(value, q[:, 0] * a[:, 1] - q[:, 1] * a[:, 0], rtol=1e-9, atol=1e-6)
    rigid = geo.bilinear(X, Y, F, geo.flow(X, Y, F, T, OMEGA, 1 / Z), T, OMEGA)
    assert np.abs(rigid).max() < 1e-9 * np.abs(value).max()


def test_half_line_residual_against_a_search():
    d = RNG.normal(0, 3, (40, 2))
    dt, bound = 0.02, 90.0
    residual = geo.length(geo.half_line_residual(d, dt, X, Y, F, T, OMEGA, bound))
    a = np.asarray(geo.A(X, Y, F)) @ T
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    speeds = np.linspace(0, bound, 4001)
    model = dt * (np.asarray(geo.B(X, Y, F)) @ OMEGA)[:, None] + dt * (speeds[:, None] * a[:, None])
    searched = np.linalg.norm(d[:, None] - model, axis=-1).min(1)
    np.testing.assert_allclose(residual, searched, atol=1e-4)
    assert np.asarray(residual < searched + 1e-12).all()


def test_half_line_tells_forward_from_backward():
    dt = 0.01
    d = dt * np.asarray(geo.flow(X, Y, F, T, OMEGA, 1 / Z))
    right = geo.length(geo.half_line_residual(d, dt, X, Y, F, 7 * T, OMEGA))
    wrong = geo.length(geo.half_line_residual(d, dt, X, Y, F, -T, OMEGA))
    assert np.abs(right).max() < 1e-12
    translation = dt * np.linalg.norm(np.asarray(geo.A(X, Y, F)) @ T, axis=-1) / Z
    np.testing.assert_allclose(wrong, translation, rtol=1e-9)
    # |F| / |A T| dt, the distance from the full line, sees no difference.
    for sign in (1, -1):
        assert np.abs(geo.bilinear(X, Y, F, d / dt, sign * T, OMEGA)).max() < 1e-6


def test_no_translation_is_pure_rotation():
    d = RNG.normal(0, 3, (40, 2))
    rotation = geo.rotation_residual(d, 0.02, X, Y, F, OMEGA)
    np.testing.assert_allclose(rotation, d - 0.02 * np.asarray(geo.B(X, Y, F)) @ OMEGA)
    for other in (
        geo.half_line_residual(d, 0.02, X, Y, F, np.zeros(3), OMEGA),
        geo.half_line_residual(d, 0.02, X, Y, F, T, OMEGA, 0.0),
    ):
        np.testing.assert_allclose(other, rotation, atol=1e-12)
    # In the focus of expansion and at residual 0 gradients are finite.
    focus = T[:2] / T[2] * F

    def total(T, d):
        r = geo.half_line_residual(d, 0.02, focus[0], focus[1], F, T, jnp.zeros(3))
        return geo.length(r).sum()

    for gradient in jax.grad(total, (0, 1))(jnp.asarray(T), jnp.zeros(2)):
        assert jnp.isfinite(gradient).all()


ANGLES = (0.0, 1e-9, 1e-4, 0.03, 0.0632, 0.31, 0.32, 1.0, 3.0, 3.1415)


@pytest.fixture(scope="module")
def twists():
    axis = RNG.normal(size=(len(ANGLES), 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    return np.concatenate([RNG.normal(size=axis.shape), np.array(ANGLES)[:, None] * axis], 1)


def test_exponentials_and_logarithms(twists):
    exp, log = jax.jit(geo.twist_exp), jax.jit(geo.twist_log)
    P = np.asarray(exp(twists))
    np.testing.assert_allclose(P, [scipy.linalg.expm(hat(xi)) for xi in twists], atol=1e-14)
    np.testing.assert_allclose(log(P), twists, atol=1e-10)
    R = geo.rotation_exp(twists[:, 3:])
    np.testing.assert_allclose(R, Rotation.from_rotvec(twists[:, 3:]).as_matrix(), atol=1e-14)
    # Half turns about all axes, of which either vector is right.
    for axis in [*np.eye(3), np.array([0.6, 0, -0.8])]:
        half = geo.rotation_log(Rotation.from_rotvec(np.pi * axis).as_matrix())
        np.testing.assert_allclose(np.abs(half), np.pi * np.abs(axis), atol=1e-7)


def test_gradients_of_exponentials_and_logarithms(twists):
    xi = jnp.asarray(twists[:-1])
    exp, h = jax.jit(geo.twist_exp), 1e-6
    jacobian = jax.jit(jax.vmap(jax.jacrev(geo.twist_exp)))(xi)
    for k, step in enumerate(h * np.eye(6)):
        numeric = (exp(xi + step) - exp(xi - step)) / (2 * h)
        np.testing.assert_allclose(jacobian[..., k], numeric, atol=1e-8)
    # log(exp(xi)) is the identity, whatever the series in between.
    both = jax.jit(jax.vmap(jax.jacrev(lambda v: geo.twist_log(geo.twist_exp(v)))))(xi)
    np.testing.assert_allclose(both, np.broadcast_to(np.eye(6), both.shape), atol=1e-7)


def test_single_precision(float32, twists):
    P = geo.twist_exp(twists.astype(np.float32))
    assert P.dtype == jnp.float32
    np.testing.assert_allclose(geo.twist_log(P)[:-2], twists[:-2], atol=3e-6)


def test_undistorted_inverts_the_distortion():
    camera = PinholeCamera(199.1, 202.4, 132.2, 110.7, (-0.368, 0.151, -3e-4, -2.8e-4, 0.0))
    x, y = (RNG.integers(0, size, 300).astype(np.uint16) for size in (240, 180))
    points, f = geometry.centred_coordinates(camera, x, y)
    assert f == np.sqrt(camera.fx * camera.fy)
    # The published formula, forwards.
    a, b = points.T / f
    k1, k2, p1, p2, k3 = camera.distortion
    r = a**2 + b**2
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    back_x = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a**2)
    back_y = b * radial + p1 * (r + 2 * b**2) + 2 * p2 * a * b
    np.testing.assert_allclose(camera.fx * back_x + camera.cx, x, atol=1e-9)
    np.testing.assert_allclose(camera.fy * back_y + camera.cy, y, atol=1e-9)
    plain, f = geometry.centred_coordinates(
        PinholeCamera(100.0, 100.0, 20.0, 10.0), [25, 20], [10, 7]
    )
    np.testing.assert_allclose(plain, [[5, 0], [0, -3]], atol=1e-12)
    folding = PinholeCamera(100.0, 100.0, 120.0, 90.0, (-0.8, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="no inverse at pixel"):
        geometry.centred_coordinates(folding, x, y)
    with pytest.raises(InputError, match="focal lengths"):
        geometry.centred_coordinates(PinholeCamera(0.0, 1.0, 0.0, 0.0), x, y)


def poses_of(xi, t, start=None):
    """Poses of a constant twist from a world pose."""
    start = scipy.linalg.expm(hat([1, 2, 3, 0.4, -2, 1])) if start is None else start
    P = np.array([start @ scipy.linalg.expm(s * hat(xi)) for s in t * 1e-6])
    return Poses(t, P[:, :3, 3], Rotation.from_matrix(P[:, :3, :3]).as_quat())


@pytest.mark.parametrize("span", [0.0, 0.021])
def test_truth_of_sampled_poses(span):
    xi = np.r_[T, 3 * OMEGA]
    t = 1_000_000 + np.cumsum(np.random.default_rng(1).integers(1000, 9000, 40))
    poses = poses_of(xi, t)
    # A quaternion's sign says nothing.
    poses.quaternion[::3] *= -1
    measured = twists_from_poses(poses, span)
    at_T, at_Omega = measured(np.array([t[0], t[7] + 1, t[-1]]))
    assert at_T is not None
    np.testing.assert_allclose(at_T, np.tile(T, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(at_Omega, np.tile(3 * OMEGA, (3, 1)), atol=1e-6)
    with pytest.raises(InputError, match="known from"):
        measured(t[-1:] + 1)
    with pytest.raises(InputError, match="none 9.0 s apart"):
        twists_from_poses(poses, 9.0)


def test_repeated_pose_times_are_passed_over():
    t = np.array([0, 5000, 5000, 10000])
    poses = poses_of(np.r_[T, OMEGA], t)
    poses.position[1] += 5
    measured = twists_from_poses(poses[1:])
    assert measured.T is not None
    np.testing.assert_allclose(measured.T, [T], atol=1e-9)


def test_gyro():
    t = np.arange(0, 100_000, 1000)
    R = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    bias = np.array([0.02, -0.01, 0.03])
    rates = np.where(t[:, None] < 50_000, 0, OMEGA * (t[:, None] - 50_000) * 1e-5)
    imu = Imu(t, rates @ R + bias, np.zeros((100, 3)))
    np.testing.assert_allclose(gyro_bias(imu, 0, 0.05), bias, atol=1e-12)
    none, Omega = twists_from_gyro(imu, gyro_bias(imu, 0, 50_000), R)(np.array([0.01, 0.0705]))
    assert none is None
    np.testing.assert_allclose(Omega, [np.zeros(3), OMEGA * 0.205], atol=1e-12)
    with pytest.raises(InputError, match="is no rotation"):
        twists_from_gyro(imu, bias, -np.eye(3))
    with pytest.raises(InputError, match="no gyro sample"):
        gyro_bias(imu, 1.0, 2.0)


def test_metrics_of_known_errors():
    truth = np.array([[2.0, 0, 0], [0, 0, 4.0]])
    estimate = np.array([[0, 3.0, 0], [0, 0, 4.1]])
    errors = scores.motion_errors(Omega=(estimate, truth), T=(estimate, truth))
    degrees = 180 / np.pi
    expected = {
        "AAE_T": 45.0,
        "AAE_Omega": 45.0,
        "AME": (1 + 0.1) / 2 * degrees,
        "AME_rel": 100 * (0.5 + 0.025) / 2,
        "AME_N": 100 * (0.25 + 0.025) / 2,
        "vector_error": 100 * (np.sqrt(13) / 2 + 0.025) / 2,
        "outliers": 50.0,
    }
    assert errors == pytest.approx(expected, rel=1e-9)
    flows = scores.motion_errors(U=([[3.0, 4.0]], [[3.0, 0.0]]))
    angle = np.degrees(np.arctan2(4, 3))
    assert flows == pytest.approx({"AEE": 4.0, "AEE_rel": 400 / 3, "AAE_U": angle})


def test_metrics_do_not_see_scale_of_translation_nor_axes():
    a, b = RNG.normal(size=(2, 30, 3))
    factor = 10 ** RNG.uniform(-200, 100, (30, 1))
    first = scores.axis_error(a, b)
    np.testing.assert_allclose(scores.axis_error(factor * a, b / factor**0.5), first, rtol=1e-9)
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    np.testing.assert_allclose(first, np.degrees(np.arccos(cosine)), rtol=1e-7)
    np.testing.assert_allclose(scores.axis_error(-a, b), 180 - first, rtol=1e-9)
    # arccos in float64 cannot tell this angle from 0.
    small = scores.axis_error([[1.0, 1e-9, 0]], [[1.0, 0, 0]])
    np.testing.assert_allclose(small, np.degrees(1e-9), rtol=1e-6)
    R = Rotation.from_rotvec([0.4, 2, -1]).as_matrix()
    both, turned = scores.motion_errors(Omega=(a, b)), scores.motion_errors(Omega=(a @ R, b @ R))
    assert turned == pytest.approx(both, rel=1e-9)


def test_metrics_of_zero_vectors():
    zero, one = np.zeros((1, 3)), np.ones((1, 3))
    assert set(scores.motion_errors(Omega=(zero, zero), T=(zero, zero)).values()) == {0.0}
    errors = scores.motion_errors(Omega=(one, zero), T=(one, zero))
    assert errors["AAE_T"] == errors["AAE_Omega"] == pytest.approx(90)
    assert errors["AME_rel"] == errors["AME_N"] == errors["vector_error"] == np.inf
    assert errors["outliers"] == 100
    other = scores.motion_errors(Omega=(zero, one), T=(zero, one))
    assert other["AAE_T"] == pytest.approx(90) and other["vector_error"] == 100
    with pytest.raises(InputError, match="not finite in row 0"):
        scores.axis_error([[np.nan, 0, 0]], one)
    with pytest.raises(InputError, match="cannot be compared"):
        scores.motion_errors(T=(one, np.ones((2, 3))))


def test_products_are_of_full_precision():
    """GPUs round the factors of others to 11 bits."""
    twist, model = jnp.ones(6), General(f=100.0)
    found = products(lambda xi: geometry.twist_log(geometry.twist_exp(xi)), twist)
    found += products(model.flow, jnp.ones(2), twist)
    found += products(model.mean, jnp.ones((4, 6)), jnp.ones(4))
    assert len(found) > 5 and set(found) == {FULL}
