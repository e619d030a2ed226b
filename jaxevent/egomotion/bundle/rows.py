"""The rows of a path as unknowns: in units of a pixel, with the priors on them."""

import math

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.path import ROWS, SEGMENTS, Path, Prior, crossing
from jaxevent.egomotion.bundle.placing import POWERS


def rows_of(path: Path, k: int = ROWS) -> NDArray[np.float64]:
    """The first k rows of O and of D, in one (6 k,)."""
    return np.concatenate([path.O[:k], path.D[:k]]).astype(np.float64).ravel()


def with_rows(path: Path, values: NDArray) -> Path:
    """The path with these rows."""
    values = values.reshape(2, -1, 3)
    k, (O, D) = values.shape[1], (np.array(path.O), np.array(path.D))  # noqa: E741
    O[:k], D[:k] = values
    return Path(O, D, path.log_rho)


def units_of_rows(path: Path, f: float, half: float, k: int = ROWS) -> NDArray[np.float64]:
    """Of those rows, that move what is at the median depth by 1 px at the window's end."""
    powers = np.array([math.factorial(m) / (f * half**m) for m in range(1, k + 1)])
    usual = float(np.exp(np.median(path.log_rho)))
    return np.repeat(np.concatenate([powers, powers / usual]), 3)


def later_rows(k: int = ROWS) -> NDArray[np.bool_]:
    """Which of those rows tell how the twist changes."""
    return np.repeat(np.tile(np.arange(k) > 0, 2), 3)


def priors_of_rows(
    prior: Prior, unit: NDArray, half: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """K, b and c of what priors on rows cost, now' K now / 2 - b' now + c, in such units.

    They are on Omega, its changes and the gyro; Omega(tau) = O0 + O1 tau + O2 tau^2 / 2 + ...
    """
    n = len(unit)
    k = n // 6
    times = ((np.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * half
    slopes = np.stack([times**m / math.factorial(m) for m in range(k)], 1)
    weight, gyro = float(prior.gyro_weight) / SEGMENTS, np.asarray(prior.gyro, np.float64)
    of_O = weight * slopes.T @ slopes
    of_O[0, 0] += float(prior.omega)
    K, b = np.zeros((n, n)), np.zeros(n)
    K[: 3 * k, : 3 * k] = np.kron(of_O, np.eye(3))
    b[: 3 * k] = weight * (slopes.T @ gyro).ravel()
    K, b = K * unit * unit[:, None], b * unit
    K += np.diag(np.where(later_rows(k), float(prior.change), 0.0))
    return K, b, weight / 2 * float((gyro**2).sum())


def gauge_of_rows(path: Path, unit: NDArray, size: int) -> NDArray[np.float64]:
    """The direction of (size,) unknowns that changes |C1|, which is 1."""
    k, found = len(unit) // 6, np.zeros(size)
    found[3 * k : 3 * k + 3] = np.asarray(path.D[0]) * unit[3 * k : 3 * k + 3]
    return found


def chain(path: Path, unit: NDArray, half: float, k: int = ROWS) -> NDArray[np.float64]:
    """How coefficients of phi and C (6 * POWERS,), of powers of half windows, change by the rows.

    Those of one component come one after another; rows are the first k, in such units.
    """
    O, D = path.O, path.D  # noqa: E741
    by = np.zeros((6, POWERS, 2, ROWS, 3))
    constant, slope = D[0], np.zeros((3, 2, ROWS, 3))
    slope[:, 1, 0] = np.eye(3)
    turn = crossing(O[0])
    for m in range(ROWS):
        by[range(3), m, 0, m, range(3)] = 1
        by[3:, m] = slope
        if m:
            by[range(3, 6), m, 1, m, range(3)] += 1
        # constant = O0 x constant
        slope = np.einsum("ij,jrka->irka", turn, slope)
        slope[:, 0, 0] -= crossing(constant)
        constant = turn @ constant
    powers = np.array([half**m / math.factorial(m) for m in range(1, POWERS + 1)])
    by = by[:, :, :, :k] * powers[:, None, None, None]
    return by.reshape(6 * POWERS, 6 * k) * unit
