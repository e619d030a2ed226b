"""How fast a target changes its velocity: the process noise under which its path is likeliest."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc

GRID = 10.0 ** np.arange(-7, 2.01, 0.25)  # of the larger size^2 / window^3
FAR = 16.0  # squared standardised innovations count no more than this
FEWEST = 4  # windows


def fit_agility(t: NDArray, m: NDArray, R: NDArray, unit: float | int) -> float:
    """Noise of the velocity, px^2/s^3, of constant velocity filters that are tried on a grid.

    t (windows,) in s, means of events m (windows, 2) in px and their variances R (windows,) in
    px^2. What is returned has the largest likelihood of each mean, predicted from those before;
    `unit` times 0.01 for less than four windows.
    """
    if len(t) < FEWEST:
        return 0.01 * unit
    scores = np.array([_log_likelihood(t, m, R, float(q)) for q in GRID * unit])
    return float(GRID[np.argmax(scores)] * unit)


@njit_noalloc
def _log_likelihood(t: Any, m: Any, R: Any, q: float | int) -> float:
    total = 0.0
    for axis in range(2):
        dt = t[1] - t[0]
        p, v = m[1, axis], (m[1, axis] - m[0, axis]) / dt
        a, b, c = R[1], R[1] / dt, (R[0] + R[1]) / dt**2 + q * dt
        for k in range(2, len(t)):
            dt = t[k] - t[k - 1]
            p += v * dt
            a += 2 * b * dt + c * dt**2 + q * dt**3 / 3
            b += c * dt + q * dt**2 / 2
            c += q * dt
            S = a + R[k]
            z = m[k, axis] - p
            total -= 0.5 * (min(z * z / S, FAR) + np.log(S))
            gain, turn = a / S, b / S
            p, v = p + gain * z, v + turn * z
            c -= turn * b
            a, b = a - gain * a, b - gain * b
    return total
