"""The path of a camera in a window of events, and where it takes them.

In a window around t_r, with tau = t - t_r, the pose of camera(t) in camera(t_r) is

    phi(tau) = O0 tau + O1 tau^2 / 2 + ... + O4 tau^5 / 120,  R = exp[phi]x
    C(tau) = C1 tau + C2 tau^2 / 2 + ... + C5 tau^5 / 120,  |C1| = 1

(a constant twist has C2 = O0 x C1, so the unknowns are D2 = C2 - O0 x C1 and so on), and a point of
inverse depth rho in the reference view is moved there by the exact warp

    r = pi(R x),  x_ref = r + rho (f C_xy - C_z r),

which is linear in rho.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

SEGMENTS = 8
ROWS = 5  # of a path: T and Omega are polynomials of the fourth degree
LEAST = 0.1  # the least inverse depth of a plane, by the usual one


class Path(eqx.Module):
    """The unknowns: rows O0, O1, ... (rad/s^k), and C1, D2, D3, ... in units of |T|; log depths."""

    O: Float[Array, "rows 3"]  # noqa: E741
    D: Float[Array, "rows 3"]
    log_rho: Float[Array, " depths"]  # 1/m in units of 1/|T|, of cells or at nodes

    @classmethod
    def constant(
        cls, heading: NDArray, Omega: NDArray, log_rho: NDArray | Array, real: Any
    ) -> "Path":
        """Of a constant twist: unit heading, Omega (rad/s)."""
        O, D = np.zeros((ROWS, 3)), np.zeros((ROWS, 3))  # noqa: E741
        O[0], D[0] = Omega, heading
        return cls(*(jnp.asarray(part, real) for part in (O, D, log_rho)))

    def coefficients(self) -> tuple[Array, Array]:
        """O and C."""
        C, constant = [self.D[0]], self.D[0]
        for D in self.D[1:]:
            constant = jnp.cross(self.O[0], constant)
            C.append(D + constant)
        return self.O, jnp.stack(C)

    def twist(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """Unit heading R' C' and Omega to second order, (times, 3) each, at times tau (s)."""
        T, Omega = self._motion(tau)
        return T / np.linalg.norm(T, axis=1, keepdims=True), Omega

    def _motion(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """As `twist`, but the velocity in units of |C1|."""
        from scipy.spatial.transform import Rotation

        O, C = (np.asarray(part, np.float64) for part in self.coefficients())  # noqa: E741
        tau = np.atleast_1d(np.asarray(tau, np.float64))
        slopes = _powers(tau, 0, len(O))
        turns = Rotation.from_rotvec(_powers(tau, 1, len(O)) @ O)
        return turns.apply(slopes @ C, inverse=True), slopes @ O


def _powers(tau: NDArray, first: int, number: int) -> NDArray[np.float64]:
    """tau^k / k! for so many k, (times, number)."""
    return np.stack([tau**k / math.factorial(k) for k in range(first, first + number)], 1)


def along(coefficients: Array, tau: Array) -> list[Array]:
    """sum_k c_k tau^k / k!, k from 1: three components."""
    sums = [jnp.zeros_like(tau)] * 3
    for k in range(len(coefficients), 0, -1):
        sums = [(sums[i] + coefficients[k - 1, i]) * tau / k for i in range(3)]
    return sums


def rotated(phi: list[Array], x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """exp[phi]x of points, to the sixth order of |phi|, which is below 1."""
    a, b, c = phi
    s = a * a + b * b + c * c
    one, two = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    dx, dy, dz = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
    return x + one * cx + two * dx, y + one * cy + two * dy, z + one * cz + two * dz


def warp(path: Path, f: Array, x: Array, y: Array, tau: Array, rho: Array) -> tuple[Array, Array]:
    """Where points at x, y (px) at times tau (s), of inverse depths rho, are at the reference."""
    O, C = path.coefficients()  # noqa: E741
    rx, ry, rz = rotated(along(O, tau), x, y, f)
    cx, cy, cz = along(C, tau)
    z = jnp.maximum(rz / f, 0.05)
    rx, ry = rx / z, ry / z
    return rx + rho * (f * cx - cz * rx), ry + rho * (f * cy - cz * ry)


def pairs_of(rows: int, columns: int) -> Array:
    """Neighbours on a lattice that is counted row by row, (2, pairs)."""
    number = jnp.arange(rows * columns).reshape(rows, columns)
    across = jnp.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    return jnp.concatenate([across, jnp.stack([number[:-1].ravel(), number[1:].ravel()])], 1)


class Prior(NamedTuple):
    """What is known beside the events: weights, and Omega (S, 3) rad/s at the segments' times."""

    smooth: Array
    relief: Array
    change: Array
    omega: Array  # 1 / (rad/s)^2
    gyro: Array
    gyro_weight: Array  # 1 / (rad/s)^2, 0: none
    bond: Array  # of the photometric fit, as smooth
    flat: Array
    alike: Array
    skew: Array | float = 0.0  # of the thresholds, about
    skew_weight: Array | float = 10.0
    moves: Array | float = 1.0  # 0: translation and depths are held


def normalised(path: Path) -> Path:
    """The same path with |C1| = 1, which depths make good."""
    size = jnp.sqrt((path.D[0] ** 2).sum())
    return Path(path.O, path.D / size, path.log_rho + jnp.log(size))


def rays_of(x: NDArray, y: NDArray, f: float) -> NDArray[np.float64]:
    """Rays (N, 3) of depth 1 through pixels that lie x, y px from the principal point."""
    return np.stack([x / f, y / f, np.ones(len(x))], 1)


def advanced(path: Path, tau: float, half: float) -> Path:
    """A path for a window that is tau s later, or earlier, its depths those of the same cells.

    Where the windows overlap its twist is the same; beyond, where the polynomials of a path grow
    without bound, it is that of the end. (From a constant twist instead the fit of a window of
    varying motion ended 8 to 25 degrees off.)
    """
    from scipy.spatial.transform import Rotation

    n = len(path.O)
    t = np.linspace(-half, half, 8 * SEGMENTS + 1)
    velocity, Omega = path._motion(np.clip(t + tau, -half, half))
    slopes = _powers(t, 0, n)
    O = np.linalg.lstsq(slopes, Omega, rcond=None)[0]  # noqa: E741
    turned = Rotation.from_rotvec(_powers(t, 1, n) @ O).apply(velocity)
    C = np.linalg.lstsq(slopes, turned, rcond=None)[0]
    # As `coefficients`, the other way.
    D, constant = [C[0]], C[0]
    for row in C[1:]:
        constant = np.cross(O[0], constant)
        D.append(row - constant)
    real = path.O.dtype
    return normalised(Path(jnp.asarray(O, real), jnp.asarray(np.array(D), real), path.log_rho))
