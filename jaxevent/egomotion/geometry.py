"""Geometry of the moving image: flow of a rigid scene, rotations, twists, warped events.

Motion is the camera's own, its twist: the velocity T (m/s) and the angular velocity Omega (rad/s)
in its axes, x to the right, y down, z forward. A point at P in these axes moves by
dP/dt = -T - Omega x P. Image coordinates x, y (px) are undistorted, relative to the principal point
and of one focal length f (px): x = f X / Z. With inverse depth 1 / Z (1/m) the image moves with

    U = A T / Z + B Omega,  A = [-f 0 x; 0 -f y],  B = [xy/f -(f+x^2/f) y; f+y^2/f -xy/f -x]

(egomotion thesis, 6.1, whose B is misprinted; its equations 3.2, 6.3, 6.4, 6.11 and 6.18 have the
scene's twist, with both signs changed). Scale is not observable: T and 1 / Z only occur as their
product. All functions broadcast over leading axes and are differentiable.

Images of warped events show how well a motion fits. If it is the right one, the events that one
point of the scene made fall together, and the image of their polarities has a high variance
(Gallego, Rebecq & Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras",
CVPR 2018).

    image = blur(splat(warped, polarity, (height, width)), 1)
    sharpness = image_variance(image)
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike, NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.precision import full_precision, to_jax

Scalars = Float[Array | np.ndarray, "..."] | float | int


def A(x: Scalars, y: Scalars, f: Scalars) -> Float[Array, "... 2 3"]:
    """Return the translation matrix: A T / Z is the flow of a camera with velocity T.

    Args:
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.

    Returns:
        (..., 2, 3) matrices, px.
    """
    x, y, f = jnp.broadcast_arrays(*map(_as_float, (x, y, f)))
    return _stack_rows([-f, 0 * f, x], [0 * f, -f, y])


def B(x: Scalars, y: Scalars, f: Scalars) -> Float[Array, "... 2 3"]:
    """Return the rotation matrix: B Omega is the flow of a camera with angular velocity Omega.

    Args:
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.

    Returns:
        (..., 2, 3) matrices, px.
    """
    x, y, f = jnp.broadcast_arrays(*map(_as_float, (x, y, f)))
    return jnp.stack([jnp.stack(row, -1) for row in _rotation_rows(x, y, f)], -2)


def rotation_basis(
    xi: Float[Array | np.ndarray, "*points 2"], f: float | Float[Array, ""]
) -> Float[Array | np.ndarray, "*points 2 3"]:
    """Return `B` at positions, computed by NumPy for NumPy arrays.

    Args:
        xi: (*points, 2) positions, px.
        f: Focal length, px.

    Returns:
        (*points, 2, 3) matrices, px, in the precision of the positions.
    """
    if not isinstance(xi, np.ndarray):
        return B(xi[..., 0], xi[..., 1], jnp.asarray(f, xi.dtype))
    x, y = xi[..., 0], xi[..., 1]
    return np.stack([np.stack(row, -1) for row in _rotation_rows(x, y, f)], -2)


def _rotation_rows(x: Any, y: Any, f: Any) -> tuple[list, list]:
    """Return the rows of the rotation matrix `B`.

    Args:
        x: Column from the principal point, px.
        y: Row from the principal point, px.
        f: Focal length, px.

    Returns:
        Both rows, of three numbers or arrays each.
    """
    return [x * y / f, -(f + x * x / f), y], [f + y * y / f, -x * y / f, -x]


def flow(
    x: Scalars,
    y: Scalars,
    f: Scalars,
    T: Float[Array | np.ndarray, "*#t 3"],
    Omega: Float[Array | np.ndarray, "*#o 3"],
    inverse_depth: Scalars,
) -> Float[Array, "... 2"]:
    """Return the flow U = A T / Z + B Omega of points of a rigid scene.

    Args:
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.
        T: (..., 3) velocity of the camera, m/s.
        Omega: (..., 3) angular velocity of the camera, rad/s.
        inverse_depth: 1 / Z, 1/m; 0 for points at infinity.

    Returns:
        (..., 2) flow, px/s.
    """
    rho = _as_float(inverse_depth)[..., None]
    return _apply(A(x, y, f), T) * rho + _apply(B(x, y, f), Omega)


def bilinear(
    x: Scalars,
    y: Scalars,
    f: Scalars,
    U: Float[Array | np.ndarray, "*#u 2"],
    T: Float[Array | np.ndarray, "*#t 3"],
    Omega: Float[Array | np.ndarray, "*#o 3"],
) -> Float[Array, "..."]:
    """Return the depth-free constraint T' (I + M Omega), which is 0 for the flow of the twist.

    I = U x X and M = X X' - |X|^2 1 with X = (x, y, f); 6.4 of the thesis has I - M Omega, for the
    scene's twist. The value is the determinant of (U - B Omega, A T). T and -T satisfy it
    alike.

    Args:
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.
        U: (..., 2) flow, px/s.
        T: (..., 3) velocity of the camera.
        Omega: (..., 3) angular velocity of the camera, rad/s.

    Returns:
        (...) values, px^2/s times the unit of T.
    """
    x, y, f = map(_as_float, (x, y, f))
    U, T, Omega = map(_as_float, (U, T, Omega))
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
    """Return d - dt B Omega, the displacement that a rotation leaves unexplained.

    Its `length` is the residual r_c of the thesis, 6.12, in px.

    Args:
        d: (..., 2) displacement of an event from its earlier candidate, px.
        dt: Time between the two, s.
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.
        Omega: (..., 3) angular velocity of the camera, rad/s.

    Returns:
        (..., 2) residual, px.
    """
    return _as_float(d) - _as_float(dt)[..., None] * _apply(B(x, y, f), Omega)


# Eight letters of one equation, public since the first release.
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
    """Return the displacement that no flow of positive depth explains.

    The residual is q - s a with q = d - dt B Omega, a = A T / |A T| and
    s = clip(q . a, 0, rho_max dt). It distinguishes T from -T, since the flow lies on a half-line.
    It equals `rotation_residual` where A T is 0, in the focus of expansion or without translation,
    and with rho_max = 0. It replaces 6.9 of the thesis, whose |F| is |q x a| times |A T| / dt.

    Args:
        d: (..., 2) displacement of an event from its earlier candidate, px.
        dt: Time between the two, s, above 0.
        x: Horizontal coordinate, px.
        y: Vertical coordinate, px.
        f: Focal length, px.
        T: (..., 3) velocity of the camera; only its direction counts.
        Omega: (..., 3) angular velocity of the camera, rad/s.
        rho_max: Largest flow due to translation, |A T| / Z, px/s.

    Returns:
        (..., 2) residual, px.
    """
    q = rotation_residual(d, dt, x, y, f, Omega)
    a = _apply(A(x, y, f), T)
    size = length(a)[..., None]
    a = a / jnp.where(size > 0, size, 1)
    farthest = _as_float(rho_max) * _as_float(dt)
    return q - jnp.clip(_dot(q, a), 0, farthest)[..., None] * a


def length(v: Float[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
    """Return the Euclidean length along the last axis, whose gradient at 0 is 0."""
    square = jnp.sum(_as_float(v) ** 2, -1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def unit(v: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Scale vectors along the last axis to length 1; zero vectors stay."""
    square = (v**2).sum(-1, keepdims=True)
    return jnp.where(square > 0, v / jnp.sqrt(jnp.where(square > 0, square, 1)), v)


@full_precision
def rotation_exp(phi: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotation matrix of a rotation vector (rad), by Rodrigues' formula."""
    phi = _as_float(phi)
    first, second, _ = _coefficients(_dot(phi, phi))
    K = _cross_matrix(phi)
    return jnp.eye(3, dtype=phi.dtype) + first * K + second * (K @ K)


def rotation_log(R: Float[Array | np.ndarray, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Return the rotation vector (rad) of a rotation matrix, of an angle up to pi.

    At half turns, which have two rotation vectors, it jumps and has no gradient.
    """
    R = _as_float(R)
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
    """Return the camera's pose after 1 s of a constant twist (T, Omega), relative to the first."""
    xi = _as_float(xi)
    phi = xi[..., 3:]
    _, second, third = _coefficients(_dot(phi, phi))
    K = _cross_matrix(phi)
    V = jnp.eye(3, dtype=xi.dtype) + second * K + third * (K @ K)
    top = jnp.concatenate([rotation_exp(phi), (V @ xi[..., :3, None])], -1)
    last = jnp.broadcast_to(jnp.array([0, 0, 0, 1], xi.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, last], -2)


@full_precision
def twist_log(P: Float[Array | np.ndarray, "*batch 4 4"]) -> Float[Array, "*batch 6"]:
    """Return the constant twist (T, Omega) that leads to the pose P in 1 s, as `twist_exp` does."""
    P = _as_float(P)
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


def centred_coordinates(
    camera: PinholeCamera, x: ArrayLike, y: ArrayLike
) -> tuple[NDArray[np.float64], float]:
    """Return undistorted coordinates of pixels about the principal point, and their focal length.

    Both axes get the focal length f = sqrt(fx fy). Computed on the host in float64.

    Args:
        camera: The camera.
        x: (n,) columns, px.
        y: (n,) rows, px.

    Returns:
        Coordinates (n, 2) in px, as the functions of this module take them, and f (px).

    Raises:
        InputError: The distortion has no inverse at a pixel within 87 degrees of the axis.
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


def splat(
    xy: Float[Array | NDArray, "E 2"],
    weight: Float[Array | NDArray, "*channels E"],
    shape: tuple[int, int],
    offset: tuple[Scalars, Scalars] = (0.0, 0.0),
) -> Float[Array, "*channels height width"]:
    """Sum weighted events into images, each into its four nearest pixels bilinearly.

    Events outside the image, or not finite, are left out. At the border weights fade, so the image
    is continuous in `xy`. It is differentiable in `xy` and `weight`, forward and in reverse.

    Args:
        xy: (E, 2) positions of events, x first, px.
        weight: (*channels, E) weights.
        shape: Height and width of the image, px.
        offset: Position (x, y) of the pixel [0, 0], px: minus the principal point for coordinates
            that are relative to it.

    Returns:
        (*channels, height, width) images.
    """
    xy, weight = jnp.asarray(xy), jnp.asarray(weight)
    height, width = shape
    # A frame of one pixel around the image takes what leaves it.
    x = jnp.clip(_replace_nonfinite(xy[:, 0] - offset[0]) + 1, 0, width + 1)
    y = jnp.clip(_replace_nonfinite(xy[:, 1] - offset[1]) + 1, 0, height + 1)
    i, j = jnp.floor(x), jnp.floor(y)
    u, v = x - i, y - j
    pixel = j.astype(jnp.int32) * (width + 2) + i.astype(jnp.int32)
    bilinear = jnp.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], -1)
    # One row of four per event, then four shifted sums: faster than four scatters. At the last row
    # and column u and v are 0.
    rows = jnp.zeros((*weight.shape[:-1], (height + 2) * (width + 2), 4), xy.dtype)
    rows = rows.at[..., pixel, :].add(weight[..., None] * bilinear, mode="promise_in_bounds")
    four = rows.reshape(*weight.shape[:-1], height + 2, width + 2, 4)
    return (
        four[..., 1:-1, 1:-1, 0]
        + four[..., 1:-1, :-2, 1]
        + four[..., :-2, 1:-1, 2]
        + four[..., :-2, :-2, 3]
    )


def blur(image: Float[Array, "*channels height width"], times: int = 1) -> Array:
    """Smooth an image by [1 2 1] / 4 in x and in y; it is 0 beyond the border.

    Args:
        image: (*channels, height, width) image.
        times: Number of repetitions.

    Returns:
        (*channels, height, width) image.
    """
    for _ in range(times):
        for axis in (image.ndim - 2, image.ndim - 1):
            n = image.shape[axis]
            pad = [(1, 1) if k == axis else (0, 0) for k in range(image.ndim)]
            wide = jnp.pad(image, pad)
            before, here, after = (lax.slice_in_dim(wide, k, k + n, axis=axis) for k in range(3))
            image = (before + 2 * here + after) / 4
    return image


def sum_of_squares(image: Float[Array, "*channels height width"]) -> Float[Array, ""]:
    """Return the sum of squares of an image: of polarities, the net number of like pairs."""
    return jnp.sum(image**2)


def image_variance(image: Float[Array, "height width"]) -> Float[Array, ""]:
    """Return the variance of an image, its contrast (Gallego et al., 2018)."""
    return jnp.var(image)


def _replace_nonfinite(value: Array) -> Array:
    return jnp.where(jnp.isfinite(value), value, -1e6)


def _as_float(value: ArrayLike | float | int) -> Array:
    value = to_jax(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def _stack_rows(*rows: Sequence[Array]) -> Array:
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def _dot(a: Array, b: Array) -> Array:
    """Return scalar products along the last axis.

    Args:
        a: (..., n).
        b: (..., n).

    Returns:
        (...).
    """
    return jnp.sum(a * b, -1)


def _apply(matrix: Array, vector: Array | np.ndarray) -> Array:
    # Not matmul, whose result is of lower precision on some devices.
    """Multiply matrices by vectors.

    Args:
        matrix: (..., m, n).
        vector: (..., n).

    Returns:
        (..., m).
    """
    return jnp.sum(matrix * _as_float(vector)[..., None, :], -1)


def _cross_matrix(v: Array) -> Array:
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return _stack_rows([0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x])


def _polynomial(t: Array, coefficients: Sequence[float | int]) -> Array:
    """Evaluate a polynomial.

    Args:
        t: Arguments, of any shape.
        coefficients: Coefficients of rising powers.

    Returns:
        Values, of the shape of `t`.
    """
    total = jnp.zeros_like(t)
    for c in reversed(coefficients):
        total = total * t + c
    return total


def _coefficients(square: Array) -> tuple[Array, Array, Array]:
    """Return sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3 of a^2, with two axes appended.

    Below a^2 = 0.1 series are used, with an error of at most 1e-15.
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


__getattr__ = renamed_names(__name__)
