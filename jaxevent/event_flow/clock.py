"""Clock of a window of events: the relative time by which all its displacements go.

The relative times s_k that alignment finds at times t_k scatter around a smooth s(t), whose rate is
asked for. Its prior is that of a smoothing spline (Wahba 1978): polynomials of the second degree
are free, and white noise of density q drives the third derivative. So

    s_k = b . (1, t_k, t_k^2) + f(t_k) + e_k,    cov f = q K,    var e = sigma^2,             (1)
    K(a, b) = int_0^min(a,b) (a - u)^2 (b - u)^2 / 4 du,

and with V = I + (q / sigma^2) K the rate at a time t is the posterior mean

    s'(t) = b . (0, 1, 2 t) + (q / sigma^2) dK(t, t_k)/dt . V^-1 (s - A b),                   (2)

A the rows (1, t_k, t_k^2). It goes on changing at the ends as it does inside, as far as what is
seen says so. Of each q / sigma^2 the posterior mean of sigma^2 is taken, r . V^-1 r / (n - 2) with
r = s - A b and n times more than coefficients. Mean and variance of the rate are averaged over
q / sigma^2 by the restricted likelihood, proportional to

    (det V det(A . V^-1 A))^-1/2 (r . V^-1 r)^-n/2.                                           (3)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Events

CLOCK_PARTS = 4  # pieces of half a window in which the clock of events goes evenly
# q / sigma^2 of (1), with the window as unit of time: from a parabola to a curve through all.
ROUGHNESS = np.array([0.0, *10 ** np.arange(0, 7.1, 0.5)])
MIN_SCATTER = 1e-9  # of s; that of exact times


class Clock(NamedTuple):
    """Relative times s of a window, linear between some times."""

    t: NDArray[np.float64]  # (K,) us, rising
    s: NDArray[np.float64]  # (K,)

    @classmethod
    def of(cls, events: Events, at: int, half: int) -> "Clock":
        """Make the clock of a window that goes as fast as time and, in equal parts, events do.

        Events come as fast as a scene moves.

        Args:
            events: The events, one or more.
            at: Time at which s = 0, us.
            half: Number of events around it on either side.

        Returns:
            The clock.
        """
        parts = max(round(CLOCK_PARTS * len(events) / half), 1)
        rows = np.linspace(0, len(events) - 1, parts + 1).astype(int)
        t, first = np.unique(events.t[rows], return_index=True)
        if len(t) < 2:
            return cls(at + np.array([-1.0, 1.0]), np.array([-1.0, 1.0]))
        s = rows[first] / half
        s = (s + (t - t[0]) * (s[-1] / (t[-1] - t[0]))) / 2
        return cls(t.astype(float), s - np.interp(at, t, s))

    @property
    def mean_rate(self) -> float:
        """Mean rate of s over the window, 1/s."""
        return float((self.s[-1] - self.s[0]) / (self.t[-1] - self.t[0])) * 1e6

    def rate(self, t: float) -> tuple[float, float]:
        """Compute how fast s goes at a time, equation (2).

        Args:
            t: Time, us.

        Returns:
            Rate, 1/s, and its variance, 1/s^2: the mean rate and 0 where the clock has two times.
        """
        if len(self.t) < 3:
            return self.mean_rate, 0.0
        span = self.t[-1] - self.t[0]
        at = min(max((t - self.t[0]) / span, 0.0), 1.0)
        means, variances, weights = _predict_rates((self.t - self.t[0]) / span, self.s, at)
        mean = float(weights @ means)
        variance = float(weights @ (variances + (means - mean) ** 2))
        per_s = 1e6 / span
        return mean * per_s, variance * per_s**2


def _predict_rates(t: NDArray, s: NDArray, at: float) -> tuple[NDArray, NDArray, NDArray]:
    """Compute means (2) and variances of the rate for each of `ROUGHNESS`, and their weights.

    Args:
        t: (K,) times from 0 to 1, three or more.
        s: (K,) relative times.
        at: Time of the rate, from 0 to 1.
    """
    # One time more than the polynomial has coefficients shows how far times scatter.
    degree = 2 if len(t) > 4 else 1
    freedom = len(t) - degree - 1
    A, slope = t[:, None] ** np.arange(degree + 1), np.array([[0, 1, 2 * at]])[:, : degree + 1]
    q, s = ROUGHNESS[:, None, None], s[:, None]
    inverse = np.linalg.inv(np.eye(len(t)) + q * _covariance(t[:, None], t))
    normal = np.linalg.inv(A.T @ inverse @ A)
    b = normal @ A.T @ inverse @ s
    rest = s - A @ b
    squares = (rest.mT @ inverse @ rest)[:, 0, 0] + MIN_SCATTER**2
    cross = q * _rate_covariance(at, t)  # (Q, 1, K)
    gain = cross @ inverse
    means = (slope @ b + gain @ rest)[:, 0, 0]
    left = slope - gain @ A
    spread = q * at**3 / 3 - gain @ cross.mT + left @ normal @ left.mT
    likelihood = np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(normal)[1]
    likelihood = (likelihood - freedom * np.log(squares)) / 2
    weights = np.exp(likelihood - likelihood.max())
    # Two times more than coefficients, or fewer, leave the mean of sigma^2 without a bound.
    variances = spread[:, 0, 0] * squares / max(freedom - 2, 1)
    return means, variances, weights / weights.sum()


def _covariance(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Compute K(a, b) of (1)."""
    low, apart = np.minimum(a, b), np.abs(a - b)
    return low**3 * (low**2 / 20 + apart * low / 8 + apart**2 / 12)


def _rate_covariance(a: float, b: NDArray) -> NDArray[np.float64]:
    """Compute dK(a, b)/da: int_0^min(a,b) (a - u) (b - u)^2 / 2 du."""
    low, apart = np.minimum(a, b), np.abs(a - b)
    before = low**2 * (low**2 / 8 + apart * low / 3 + apart**2 / 4)
    return np.where(a < b, before, low**3 * (low / 8 + apart / 6))
