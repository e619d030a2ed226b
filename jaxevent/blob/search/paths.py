"""Paths of targets, and the noise of their velocity."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.owners import PathTable
from jaxevent.blob.search.config import CONFIG
from jaxevent.codegen import njit_noalloc
from jaxevent.deprecated import RenamedAttribute

# Velocity noises that are tried, in (larger size)^2 / window^3.
TRIED_VELOCITY_NOISES = 10.0 ** np.arange(-7, 2.01, 0.25)


@dataclasses.dataclass(frozen=True)
class TargetPath:
    """Path of a target through the windows in which it was seen.

    Attributes:
        t: (rows,) us, the middle of each window.
        p: (rows, 2) px, positions.
        v: (rows, 2) px/s, velocities.
        C: (rows, 2, 2) px^2, covariances of the target's events.
        n: (rows,) events in the window, smoothed.
        window: us, length of a window.
        velocity_noise: px^2/s^3, density of the white noise that drives the velocity.
        polarity: Polarity of the target's events, 1 ON and 0 OFF; None for both.
        turn_rate: rad/s at which it turns in place, from x to y; None if it is not known to turn.
        balance: Share of ON less that of OFF among its events; 0 where it is not measured.
    """

    t: NDArray[np.int64]
    p: NDArray[np.float64]
    v: NDArray[np.float64]
    C: NDArray[np.float64]
    n: NDArray[np.float64]
    window: int
    velocity_noise: float
    polarity: int | None = None
    turn_rate: float | None = None
    balance: float = 0.0

    agility = RenamedAttribute("velocity_noise")
    turn = RenamedAttribute("turn_rate")

    @property
    def begin(self) -> int:
        """Start of the first window, us."""
        return int(self.t[0]) - self.window // 2

    @property
    def end(self) -> int:
        """End of the last window, us, which it does not include."""
        return int(self.t[-1]) + self.window // 2

    @property
    def size(self) -> NDArray[np.float64]:
        """(rows, 2) px, standard deviations along the principal axes, the larger first."""
        return np.sqrt(np.maximum(np.linalg.eigvalsh(self.C)[:, ::-1], 0))

    @property
    def is_across_way(self) -> bool:
        """True if it is longer across its way than along it."""
        way = self.p[-1] - self.p[0]
        along = way @ np.median(self.C, 0) @ way / max(float(way @ way), 1e-9)
        return bool(along < (1 - CONFIG.considerable) * np.median(self.size[:, 0]) ** 2)

    @property
    def has_one_polarity(self) -> bool:
        """True if nearly all of its events are known to have one polarity."""
        return abs(self.balance) > 2 * CONFIG.nearly_all - 1  # the difference of both shares

    @property
    def lone_edge(self) -> bool:
        """True if it seems to be one edge of an object of which no more is seen.

        It is long across its way, and has nearly all events of one polarity.
        """
        long, wide = np.median(self.size, 0)
        is_long = bool(wide < CONFIG.majority * long) and self.is_across_way
        return is_long and self.has_one_polarity

    def at(self, t: NDArray[np.int64]) -> NDArray[np.float64]:
        """Interpolate positions (times, 2) linearly at times (us)."""
        return np.stack([np.interp(t, self.t, self.p[:, i]) for i in range(2)], 1)

    def take(self, rows: slice | NDArray) -> "TargetPath":
        """Return the path of some rows."""
        return dataclasses.replace(self, **{k: getattr(self, k)[rows] for k in "tpvCn"})

    def followed_by(self, other: "TargetPath") -> "TargetPath":
        """Return the path of this one's rows and then those of another one."""
        rows = {k: np.concatenate([getattr(self, k), getattr(other, k)]) for k in "tpvCn"}
        return dataclasses.replace(self, **rows)

    def mean_velocity(self, rows: slice) -> NDArray[np.float64]:
        """Fit the velocity (2,) px/s over some rows; zero for fewer than three."""
        t, p = self.t[rows] * 1e-6, self.p[rows]
        return np.polyfit(t - t[0], p, 1)[0] if len(t) > 2 else np.zeros(2)


def merge_paths(one: TargetPath, other: TargetPath) -> TargetPath:
    """Merge the paths of two parts: the moments of the events of both, of each while it is seen."""
    t = np.union1d(one.t, other.t)
    rows = [interpolate_path(path, t) for path in (one, other)]
    n = rows[0].n + rows[1].n
    share = rows[1].n / n
    d = rows[1].p - rows[0].p
    C = (1 - share)[:, None, None] * rows[0].C + share[:, None, None] * rows[1].C
    C += (share * (1 - share))[:, None, None] * np.einsum("ti,tj->tij", d, d)
    p = rows[0].p + share[:, None] * d
    v = rows[0].v + share[:, None] * (rows[1].v - rows[0].v)
    noise = min(one.velocity_noise, other.velocity_noise)
    weights = one.n.sum(), other.n.sum()
    balance = float(np.average([one.balance, other.balance], weights=weights))
    return TargetPath(t, p, v, C, n, one.window, noise, balance=balance)


def interpolate_path(path: TargetPath, t: NDArray[np.int64]) -> TargetPath:
    """Interpolate a path linearly in time, without events before and after its life.

    Args:
        path: The path.
        t: (n,) times, us.

    Returns:
        The path at those times.
    """

    def at(values: NDArray) -> NDArray[np.float64]:
        flat = values.reshape(len(path.t), -1)
        columns = np.stack([np.interp(t, path.t, column) for column in flat.T], 1)
        return columns.reshape(len(t), *values.shape[1:])

    alive = (t >= path.t[0]) & (t <= path.t[-1])
    return dataclasses.replace(
        path, t=t, p=at(path.p), v=at(path.v), C=at(path.C), n=np.where(alive, at(path.n), 0)
    )


def tabulate_paths(paths: Sequence[TargetPath]) -> PathTable:
    """Concatenate the rows of paths."""
    C, n = (np.concatenate([getattr(path, k) for path in paths]) for k in "Cn")
    S = C * (1 + 2 / np.maximum(n, 1))[:, None, None] + 0.1 * np.eye(2)
    return PathTable(
        np.cumsum([0, *(len(path.t) for path in paths)]),
        np.array([path.window for path in paths]),
        np.array([-1 if p.polarity is None else p.polarity for p in paths], np.int8),
        np.concatenate([path.t for path in paths]),
        np.concatenate([path.p for path in paths]),
        np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]], 1),
    )


def fit_velocity_noise(t: NDArray, m: NDArray, R: NDArray, unit: float | int) -> float:
    """Fit the velocity noise of a path by maximum likelihood.

    Constant-velocity Kalman filters with the noises of `TRIED_VELOCITY_NOISES` predict each
    mean from the means before.

    Args:
        t: (windows,) s, times.
        m: (windows, 2) px, means of the windows' events.
        R: (windows,) px^2, variances of the means.
        unit: px^2/s^3, unit of the grid.

    Returns:
        The noise density of the largest likelihood, px^2/s^3; 0.01 units for fewer windows than
        `SearchConfig.min_confirm_windows`.
    """
    if len(t) < CONFIG.min_confirm_windows:
        return 0.01 * unit
    velocity, noise = 1e6 * (R[0] + R[1]) / (t[1] - t[0]) ** 2, np.ones(len(t) - 1)
    scores = [log_likelihood(t, m, R, velocity, q * noise) for q in TRIED_VELOCITY_NOISES * unit]
    return float(TRIED_VELOCITY_NOISES[np.argmax(scores)] * unit)


@njit_noalloc
def log_likelihood(t: Any, z: Any, R: Any, velocity: float, noise: Any) -> float:
    """Compute the log likelihood of measured places, of a velocity that noise drives.

    Args:
        t: (n,) s.
        z: (n, axes) px, places of which the first is given.
        R: (n,) px^2, their variances.
        velocity: px^2/s^2, variance of the first velocity along each axis.
        noise: (n - 1,) px^2/s^3, densities of the noise between them.
    """
    total = 0.0
    for axis in range(z.shape[1]):
        p, v, a, b, c = z[0, axis], 0.0, R[0], 0.0, velocity
        for k in range(1, len(t)):
            dt, q = t[k] - t[k - 1], noise[k - 1]
            p += v * dt
            a += 2 * b * dt + c * dt**2 + q * dt**3 / 3
            b += c * dt + q * dt**2 / 2
            c += q * dt
            S = a + R[k]
            e = z[k, axis] - p
            total -= 0.5 * (min(e * e / S, CONFIG.max_squared_innovation) + np.log(S))
            p, v = p + a / S * e, v + b / S * e
            c -= b * b / S
            a, b = a * R[k] / S, b * R[k] / S
    return total
