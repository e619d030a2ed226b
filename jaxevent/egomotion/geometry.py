"""Image motion of a rigid scene: flow, residuals of matched events, rotations and twists.

Everything speaks of the camera's own motion, the camera twist: the camera moves with the velocity T
(m/s) and turns with Omega (rad/s), both in its own axes, x to the right, y down, z forward. A point
at P in these axes moves by dP/dt = -T - Omega x P. Image coordinates x, y (px) are undistorted,
relative to the principal point and of one focal length f (px): x = f X / Z. With inverse depth
1 / Z (1/m) the image moves with

    U = A T / Z + B Omega,  A = [-f 0 x; 0 -f y],  B = [xy/f -(f+x^2/f) y; f+y^2/f -xy/f -x]

(egomotion thesis, 6.1, whose B is misprinted; its equations 3.2, 6.3, 6.4, 6.11 and 6.18 have the
scene's twist, that is both signs turned.) Scale is not observable: T and 1 / Z only occur as their
product. All functions broadcast over leading axes and are differentiable.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.devices import full_precision
from jaxevent.errors import InputError

Scalars = Float[Array | np.ndarray, "..."] | float | int


def A(x: Scalars, y: Scalars, f: Scalars) -> Float[Array, "... 2 3"]:
    """The matrix of translation (px): A T / Z is the flow in px/s of a camera that moves with T."""
    x, y, f = jnp.broadcast_arrays(*map(_real, (x, y, f)))
    return _rows([-f, 0 * f, x], [0 * f, -f, y])


def B(x: Scalars, y: Scalars, f: Scalars) -> Float[Array, "... 2 3"]:
    """The matrix of rotation (px): B Omega is the flow in px/s of a camera that turns by Omega."""
    x, y, f = jnp.broadcast_arrays(*map(_real, (x, y, f)))
    return jnp.stack([jnp.stack(row, -1) for row in _turning_rows(x, y, f)], -2)


def rotation_basis(
    xi: Float[Array | np.ndarray, "*places 2"], f: float | Float[Array, ""]
) -> Float[Array | np.ndarray, "*places 2 3"]:
    """`B` at places xi (px): of NumPy arrays in NumPy, in their precision, else in JAX."""
    if not isinstance(xi, np.ndarray):
        return B(xi[..., 0], xi[..., 1], jnp.asarray(f, xi.dtype))
    x, y = xi[..., 0], xi[..., 1]
    return np.stack([np.stack(row, -1) for row in _turning_rows(x, y, f)], -2)


def _turning_rows(x: Any, y: Any, f: Any) -> tuple[list, list]:
    return [x * y / f, -(f + x * x / f), y], [f + y * y / f, -x * y / f, -x]


def flow(
    x: Scalars,
    y: Scalars,
    f: Scalars,
    T: Float[Array | np.ndarray, "*#t 3"],
    Omega: Float[Array | np.ndarray, "*#o 3"],
    inverse_depth: Scalars,
) -> Float[Array, "... 2"]:
    """U = A T / Z + B Omega in px/s, at inverse depths 1 / Z (1/m), 0 for points at infinity."""
    rho = _real(inverse_depth)[..., None]
    return _apply(A(x, y, f), T) * rho + _apply(B(x, y, f), Omega)


def bilinear(
    x: Scalars,
    y: Scalars,
    f: Scalars,
    U: Float[Array | np.ndarray, "*#u 2"],
    T: Float[Array | np.ndarray, "*#t 3"],
    Omega: Float[Array | np.ndarray, "*#o 3"],
) -> Float[Array, "..."]:
    """The depth-free constraint T' (I + M Omega), 0 for the flow U (px/s) of the camera twist.

    I = U x X and M = X X' - |X|^2 1, X = (x, y, f); 6.4 of the thesis has I - M Omega, for the
    scene's twist. It is the determinant of (U - B Omega, A T), has the unit of px^2/s times that of
    T and changes its sign with T: which way the camera moves it does not tell.
    """
    x, y, f = map(_real, (x, y, f))
    U, T, Omega = map(_real, (U, T, Omega))
    u, v = U[..., 0], U[..., 1]
    X = jnp.stack(jnp.broadcast_arrays(x, y, f), -1)
    moment = jnp.stack(jnp.broadcast_arrays(f * v, -f * u, y * u - x * v), -1)
    M_Omega = X * _dot(X, Omega)[..., None] - _dot(X, X)[..., None] * Omega
    return _dot(T, moment + M_Omega)


def rotation_residual(
    d: Float[Array | np.ndarray, "*#d 2"],
    dt: Scalars,
    x: Scalars,
    y: Scalars,
    f: Scalars,
    Omega: Float[Array | np.ndarray, "*#o 3"],
) -> Float[Array, "... 2"]:
    """d - dt B Omega (px): what a pure rotation leaves of the displacement d (px) within dt (s).

    `d` and `dt` are those of an event at (x, y) from its earlier candidate. The residual r_c is
    its `length` (thesis 6.12, in px).
    """
    return _real(d) - _real(dt)[..., None] * _apply(B(x, y, f), Omega)


def half_line_residual(
    d: Float[Array | np.ndarray, "*#d 2"],
    dt: Scalars,
    x: Scalars,
    y: Scalars,
    f: Scalars,
    T: Float[Array | np.ndarray, "*#t 3"],
    Omega: Float[Array | np.ndarray, "*#o 3"],
    rho_max: Scalars = jnp.inf,
) -> Float[Array, "... 2"]:
    """q - s a (px): a displacement d (px) within dt > 0 (s), less its best flow of positive depth.

    q = d - dt B Omega, a = A T / |A T|, s = clip(q . a, 0, rho_max dt); the residual r_c is its
    `length`. `rho_max` (px/s) bounds the flow due to translation, |A T| / Z. Only the direction of
    T matters; that it is a half-line tells T from -T. Where A T is 0, in the focus of expansion or
    without translation, and with rho_max = 0, it is `rotation_residual`. Replaces 6.9 of the
    thesis, whose |F| is |q x a| times |A T| / dt.
    """
    q = rotation_residual(d, dt, x, y, f, Omega)
    a = _apply(A(x, y, f), T)
    size = length(a)[..., None]
    a = a / jnp.where(size > 0, size, 1)
    farthest = _real(rho_max) * _real(dt)
    return q - jnp.clip(_dot(q, a), 0, farthest)[..., None] * a


def length(v: Float[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """The Euclidean length along the last axis; its gradient at 0 is 0."""
    square = jnp.sum(_real(v) ** 2, -1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def unit(v: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """The vector of length 1 along the last axis; that of 0 is 0."""
    square = (v**2).sum(-1, keepdims=True)
    return jnp.where(square > 0, v / jnp.sqrt(jnp.where(square > 0, square, 1)), v)


@full_precision
def rotation_exp(phi: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """The rotation matrix of a rotation vector (rad), by Rodrigues' formula."""
    phi = _real(phi)
    first, second, _ = _coefficients(_dot(phi, phi))
    K = _cross_matrix(phi)
    return jnp.eye(3, dtype=phi.dtype) + first * K + second * (K @ K)


def rotation_log(R: Float[Array | np.ndarray, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """The rotation vector (rad) of a rotation matrix, of an angle up to pi.

    Half turns have two; there it jumps, and has no gradient.
    """
    R = _real(R)
    # 4 q q' of the unit quaternion q = (w, v) is linear in R. Its column with the largest diagonal
    # entry, at least 1, is q up to a factor that is not small: no root near 0.
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    turn = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]
    columns = [[1 + trace, *turn]]
    for i in range(3):
        diagonal = [m[i][j] + m[j][i] if j != i else 1 + 2 * m[i][i] - trace for j in range(3)]
        columns.append([turn[i], *diagonal])
    outer = jnp.stack([jnp.stack(column, -1) for column in columns], -2)
    largest = jnp.argmax(jnp.diagonal(outer, axis1=-2, axis2=-1), -1)[..., None, None]
    q = jnp.take_along_axis(outer, largest, -2)[..., 0, :]
    q = q * jnp.where(q[..., :1] < 0, -1, 1) / length(q)[..., None]
    w, v = q[..., 0], q[..., 1:]
    square = _dot(v, v)
    small = square < 1e-3
    sine = jnp.sqrt(jnp.where(small, 1, square))
    # 2 arcsin(s) / s in powers of s^2, for s = |v| = sin of half the angle.
    series = _polynomial(square, (2, 1 / 3, 3 / 20, 5 / 56, 35 / 576))
    return jnp.where(small, series, 2 * jnp.arctan2(sine, w) / sine)[..., None] * v


@full_precision
def twist_exp(xi: Float[Array | np.ndarray, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
    """The camera's pose after 1 s of the constant twist (T, Omega): camera to first camera."""
    xi = _real(xi)
    phi = xi[..., 3:]
    _, second, third = _coefficients(_dot(phi, phi))
    K = _cross_matrix(phi)
    V = jnp.eye(3, dtype=xi.dtype) + second * K + third * (K @ K)
    top = jnp.concatenate([rotation_exp(phi), (V @ xi[..., :3, None])], -1)
    last = jnp.broadcast_to(jnp.array([0, 0, 0, 1], xi.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, last], -2)


@full_precision
def twist_log(P: Float[Array | np.ndarray, "*batch 4 4"]) -> Float[Array, "*batch 6"]:
    """The twist (T, Omega) that leads to the pose P in 1 s: the inverse of `twist_exp`."""
    P = _real(P)
    phi = rotation_log(P[..., :3, :3])
    square = _dot(phi, phi)
    small = square < 0.1
    theta = jnp.sqrt(jnp.where(small, 1, square))
    closed = (1 - theta / 2 / jnp.tan(theta / 2)) / theta**2
    series = _polynomial(square, (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160))
    K = _cross_matrix(phi)
    bend = jnp.where(small, series, closed)[..., None, None]
    inverse = jnp.eye(3, dtype=P.dtype) - K / 2 + bend * (K @ K)
    return jnp.concatenate([(inverse @ P[..., :3, 3:])[..., 0], phi], -1)


def undistorted(
    camera: PinholeCamera, x: ArrayLike, y: ArrayLike
) -> tuple[NDArray[np.float64], float]:
    """Coordinates (events, 2) in px of events' pixels as all functions here take them, and f (px).

    Distortion is undone, the principal point is (0, 0), and both axes have the focal length
    f = sqrt(fx fy). On the host, in float64. Raises `InputError` for a camera without positive
    focal lengths and for pixels at which its distortion has no inverse, or that look more than 87
    degrees from the axis.
    """
    straight = camera.normalise(x, y)
    if np.isnan(straight).any():
        row = int(np.argmax(np.isnan(straight).any(-1)))
        raise InputError(
            f"the {camera.model} distortion {camera.distortion} has no inverse at pixel "
            f"({np.ravel(x)[row]:g}, {np.ravel(y)[row]:g}) within 87 degrees of the axis; mend the "
            "calibration or leave out events that far from the centre"
        )
    f = float(np.sqrt(camera.fx * camera.fy))
    return f * straight, f


def _real(value: ArrayLike | float | int) -> Array:
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def _rows(*rows: Sequence[Array]) -> Array:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, -1)


def _apply(matrix: Array, vector: Array | np.ndarray) -> Array:
    # Not matmul, whose result is of lower precision on some devices.
    return jnp.sum(matrix * _real(vector)[..., None, :], -1)


def _cross_matrix(v: Array) -> Array:
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return _rows([0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x])


def _polynomial(t: Array, coefficients: Sequence[float | int]) -> Array:
    total = jnp.zeros_like(t)
    for c in reversed(coefficients):
        total = total * t + c
    return total


def _coefficients(square: Array) -> tuple[Array, Array, Array]:
    """sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3 of a^2, with two axes appended.

    Below a^2 = 0.1 by series that end with an error of 1e-15 or less.
    """
    small = square < 0.1
    a = jnp.sqrt(jnp.where(small, 1, square))
    closed = (jnp.sin(a) / a, (1 - jnp.cos(a)) / a**2, (a - jnp.sin(a)) / a**3)
    series = (
        (1, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800),
        (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600),
        (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800),
    )
    one, two, three = (
        jnp.where(small, _polynomial(square, s), c)[..., None, None]
        for s, c in zip(series, closed, strict=True)
    )
    return one, two, three
