"""What every estimator of the camera's motion gives: a `Motion`, which answers at any time."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Times, microseconds

COMPONENTS = {
    "planar": ("vx", "vy"),
    "rotation": ("wx", "wy", "wz"),
    "general": ("tx", "ty", "tz", "wx", "wy", "wz"),
}


class States(NamedTuple):
    """Motion at some times: mean (times, dimension), covariance (times, dimension, dimension).

    `lost` says where the motion was being searched for, or no event told it.
    """

    mean: NDArray[np.floating]
    covariance: NDArray[np.floating]
    lost: NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Motion:
    """An estimated motion: `mean, covariance, lost = motion(times)`.

    The components of a `model` are those of `COMPONENTS`: the image velocity (px/s); the camera's
    angular velocity (rad/s); or its heading, a unit vector, and then its angular velocity, in the
    camera's axes, x to the right, y down, z forward. The covariance of a heading is that of small
    steps across it.

    Arrays by estimate, n of them: `t` (us), at which it was made, of rising order; `mean`
    (n, dimension); `covariance`; `lost`; `lag` (s) by which what was seen is older than `t`;
    `contrast`, how much better the motion explains the events than chance would, about 1 where it
    does not; `evidence`, the log-likelihood of the events since the estimate before. The last two
    are NaN where an estimator has none. `cloud` (n, particles, dimension), where it was asked for,
    is some of a filter's particles: the likelier a motion, the more of them are near it.
    """

    model: str
    t: NDArray[np.int64]
    mean: NDArray[np.floating]
    covariance: NDArray[np.floating]
    lost: NDArray[np.bool_]
    lag: NDArray[np.floating]
    contrast: NDArray[np.floating]
    evidence: NDArray[np.floating]
    cloud: NDArray[np.floating] | None = None

    @classmethod
    def of(
        cls,
        model: str,
        t: NDArray[np.int64],
        mean: NDArray[np.floating],
        covariance: NDArray[np.floating],
        lost: NDArray[np.bool_] | None = None,
        contrast: NDArray[np.floating] | None = None,
    ) -> "Motion":
        """Of an estimator that has no lag and no likelihood, and by default is never lost."""
        n, none = len(t), np.full(len(t), np.nan)
        lost = np.zeros(n, bool) if lost is None else lost
        contrast = none if contrast is None else contrast
        return cls(model, t, mean, covariance, lost, np.zeros(n), contrast, none)

    @classmethod
    def nothing(cls, model: str) -> "Motion":
        """Of a recording that tells nothing."""
        n = len(COMPONENTS[model])
        return cls.of(model, np.zeros(0, np.int64), np.zeros((0, n)), np.zeros((0, n, n)))

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"Motion({self.model}, {len(self)} estimates, {int(self.lost.sum())} lost)"

    def __call__(self, times: Times, *, centred: bool = False) -> States:
        """The motion at `times`: integers (us) or floats (s).

        Means and covariances are interpolated linearly between the estimates before and after the
        time, and held before the first and after the last one; headings are made unit vectors. With
        `centred` an estimate counts for the time that what it saw shows, `lag` before its own: a
        fixed-lag estimate, which needs the events up to that much later. `lost` is set where either
        estimate is lost, and before the first. Raises `InputError` for times that are not finite.
        """
        times = np.atleast_1d(microseconds(times))
        n, dimension = self.mean.shape
        if n == 0:
            return States(
                np.full((len(times), dimension), np.nan),
                np.full((len(times), dimension, dimension), np.nan),
                np.ones(len(times), bool),
            )
        at = self.t - (1e6 * self.lag if centred else 0)
        at = np.maximum.accumulate(at)
        place = np.searchsorted(at, times, "right")
        after, before = np.minimum(place, n - 1), np.maximum(place - 1, 0)
        gap = at[after] - at[before]
        share = np.where(gap > 0, (times - at[before]) / np.where(gap > 0, gap, 1), 0)
        share = np.clip(share, 0, 1)[:, None]
        mean = (1 - share) * self.mean[before] + share * self.mean[after]
        if self.model == "general":
            size = np.linalg.norm(mean[:, :3], axis=1, keepdims=True)
            heading = np.where(size > 0, mean[:, :3], self.mean[before, :3])
            size = np.where(size > 0, size, 1)
            mean = np.concatenate([heading / size, mean[:, 3:]], 1)
        share = share[..., None]
        covariance = (1 - share) * self.covariance[before] + share * self.covariance[after]
        return States(mean, covariance, self.lost[before] | self.lost[after] | (times < at[0]))
