"""The path of a camera in a window of events, and where it takes them.

In a window around t_r, with tau = t - t_r, the pose of camera(t) in camera(t_r) is

    phi(tau) = O0 tau + O1 tau^2 / 2 + ... + O4 tau^5 / 120,  R = exp[phi]x
    C(tau) = C1 tau + C2 tau^2 / 2 + ... + C5 tau^5 / 120,  |C1| = 1

(a constant twist has C2 = O0 x C1, so the unknowns are D2 = C2 - O0 x C1 and so on), and a point of
inverse depth rho in the reference view is moved there by the exact warp

    r = pi(R x),  x_ref = r + rho (f C_xy - C_z r),

which is linear in rho.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle import placing

SEGMENTS = 8
ROWS = 5  # of a path: T and Omega are polynomials of the fourth degree
LEAST = 0.1  # the least inverse depth of a plane, by the usual one


@dataclasses.dataclass(frozen=True)
class Path:
    """The unknowns: rows O0, O1, ... (rad/s^k), and C1, D2, D3, ... in units of |T|; log depths.

    O and D are (ROWS, 3). Depths are inverse ones, 1/m in units of 1/|T|, of cells or at nodes.
    """

    O: NDArray[np.float64]  # noqa: E741
    D: NDArray[np.float64]
    log_rho: NDArray

    @classmethod
    def constant(cls, heading: NDArray, Omega: NDArray, log_rho: NDArray) -> "Path":
        """Of a constant twist: unit heading, Omega (rad/s)."""
        O, D = np.zeros((ROWS, 3)), np.zeros((ROWS, 3))  # noqa: E741
        O[0], D[0] = Omega, heading
        return cls(O, D, log_rho)

    def coefficients(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """O and C."""
        constant, turn = [self.D[0]], crossing(self.O[0])
        for _ in self.D[1:]:
            constant.append(turn @ constant[-1])
        C = np.array(constant)
        C[1:] += self.D[1:]
        return self.O, C

    def polynomials(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """phi and C, whose rows are factors of tau, tau^2, ..."""
        O, C = self.coefficients()  # noqa: E741
        factorials = np.array([math.factorial(k + 1) for k in range(len(O))])[:, None]
        return O / factorials, C / factorials

    def motion(self, f: float) -> placing.Motion:
        """The same for the loops, of a camera of focal length f (px)."""
        return placing.Motion(*self.polynomials(), f)

    def twist(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """Unit heading R' C' and Omega to second order, (times, 3) each, at times tau (s).

        Where the camera stands still the heading is 0.
        """
        T, Omega = self._motion(tau)
        size = np.linalg.norm(T, axis=1, keepdims=True)
        return T / np.where(size > 0, size, 1), Omega

    def pace(self, tau: float | int | NDArray) -> NDArray[np.float64]:
        """|T| at times tau (s), in units of that at 0."""
        return np.linalg.norm(self._motion(tau)[0], axis=1)

    def _motion(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """As `twist`, but the velocity in units of |C1|."""
        from scipy.spatial.transform import Rotation

        O, C = self.coefficients()  # noqa: E741
        tau = np.atleast_1d(np.asarray(tau, np.float64))
        slopes = _powers(tau, 0, len(O))
        turns = Rotation.from_rotvec(_powers(tau, 1, len(O)) @ O)
        return turns.apply(slopes @ C, inverse=True), slopes @ O


def _powers(tau: NDArray, first: int, number: int) -> NDArray[np.float64]:
    """tau^k / k! for so many k, (times, number)."""
    return np.stack([tau**k / math.factorial(k) for k in range(first, first + number)], 1)


def warp(
    path: Path, f: float, x: NDArray, y: NDArray, tau: NDArray, rho: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where points at x, y (px) at times tau (s), of inverse depths rho, are at the reference."""
    x, y, tau, rho = (np.asarray(part, np.float64) for part in (x, y, tau, rho))
    parts = [np.ascontiguousarray(one) for one in np.broadcast_arrays(x, y, tau, rho)]
    X, Y = np.empty_like(parts[0]), np.empty_like(parts[0])
    flat = [part.reshape(-1) for part in (*parts, X, Y)]
    placing.warp(placing.Points(*flat[:3]), flat[3], path.motion(f), *flat[4:])
    return X, Y


class Prior(NamedTuple):
    """What is known beside the events: weights, and Omega (S, 3) rad/s at the segments' times."""

    smooth: float
    relief: float
    change: float
    omega: float  # 1 / (rad/s)^2
    gyro: NDArray[np.float64]
    gyro_weight: float  # 1 / (rad/s)^2, 0: none
    bond: float  # of the photometric fit, as smooth
    flat: float
    alike: float
    skew: float = 0.0  # of the thresholds, about
    skew_weight: float = 10.0
    moves: bool = True  # else translation and depths are held


def normalised(path: Path) -> Path:
    """The same path with |C1| = 1, which depths make good."""
    size = float(np.linalg.norm(path.D[0]))
    depth = path.log_rho + path.log_rho.dtype.type(np.log(size))
    return Path(path.O, path.D / size, depth)


def crossing(v: NDArray) -> NDArray[np.float64]:
    """The matrix (3, 3) that makes v x u of u."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], np.float64)


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
    D, constant, turn = [C[0]], C[0], crossing(O[0])
    for row in C[1:]:
        constant = turn @ constant
        D.append(row - constant)
    return normalised(Path(O.astype(np.float64), np.array(D), path.log_rho))
