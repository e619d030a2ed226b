"""The targets of one moment, while they are followed."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.paths import STILL

JITTER = 0.05  # of the size: error of a window's mean, for events of an edge are not independent


@dataclasses.dataclass
class Live:
    """The targets of one moment; arrays begin with the number of targets."""

    id: NDArray[np.int64]
    t: NDArray[np.float64]  # s, of the last window seen
    p: NDArray[np.float64]  # (n, 2) px
    v: NDArray[np.float64]  # (n, 2) px/s
    P: NDArray[np.float64]  # (n, 3): variance of p, covariance, variance of v; of each axis alike
    C: NDArray[np.float64]  # (n, 2, 2) px^2, covariance of events
    n: NDArray[np.float64]  # events per window
    top: NDArray[np.float64]  # and most of them, slowly forgotten
    q: NDArray[np.float64]  # px^2/s^3
    nis: NDArray[np.float64]  # mean square of standardised innovations
    born: NDArray[np.float64]  # s
    hits: NDArray[np.int64]  # windows seen
    miss: NDArray[np.int64]  # windows of silence
    path: NDArray[np.float64]  # px
    nats: NDArray[np.float64]  # against background
    confirmed: NDArray[np.bool_]
    part: NDArray[np.bool_]  # of another one

    def keep(self, which: NDArray) -> "Live":
        return Live(*(value[which] for value in vars(self).values()))

    def add(self, other: "Live") -> "Live":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Live(*(np.concatenate(pair) for pair in pairs))

    @property
    def size(self) -> NDArray[np.float64]:
        """(n,) px, standard deviation along the longer axis."""
        return np.sqrt(larger(self.C))

    @property
    def agility(self) -> NDArray[np.float64]:
        """Noise of the velocity, px^2/s^3."""
        return self.q * np.clip(self.nis, 0.05, 50)

    def predict(self, t: float | int) -> tuple[NDArray, NDArray]:
        """Positions (n, 2) and P (n, 3) at t; what stands still is not driven any more."""
        dt, (a, b, c), q = t - self.t, self.P.T, np.where(self.miss < STILL, self.agility, 0)
        P = [a + 2 * b * dt + c * dt**2 + q * dt**3 / 3, b + c * dt + q * dt**2 / 2, c + q * dt]
        return self.p + self.v * dt[:, None], np.stack(P, 1)


def start_targets(
    ids: NDArray, t: float | int, p: NDArray, C: NDArray, n: NDArray, window: float | int
) -> Live:
    number, square = len(ids), larger(C)
    zero, none = np.zeros(number), np.zeros(number, np.int64)
    P = np.stack(
        [square / np.maximum(n, 1) + JITTER * square, zero, 9 * (square + 1) / window**2], 1
    )
    # An error of 0.3 sizes after one window.
    q = 0.3**2 * (square + 0.5) * 3 / window**3
    return Live(
        ids, zero + t, p, np.zeros((number, 2)), P, C, n, n, q, zero + 1, zero + t, none + 1, none,
        zero, zero, np.zeros(number, bool), np.zeros(number, bool),
    )  # fmt: skip


def larger(C: NDArray) -> NDArray[np.float64]:
    """Larger eigenvalues of (..., 2, 2)."""
    half = (C[..., 0, 0] - C[..., 1, 1]) / 2
    return (C[..., 0, 0] + C[..., 1, 1]) / 2 + np.hypot(half, C[..., 0, 1])
