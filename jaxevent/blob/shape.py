"""Uncertainty of a position where the target's shape changes.

The filter takes events for independent ones of an ellipse, so that their mean is the target's
middle. Where another target's events are among them, or a part of the target is not seen, the mean
is beside it, and innovations do not tell, for the error stays as long as the cause. The second
moments do: if the weights of the target's parts change by a share e, its variances change by about
e, and its mean by about e of its size. So a change d of the logarithms of sizes, by which the
variances change by 2 d, adds (2 d)^2 of the ellipse's covariance to that of the position, beyond
what the sizes' own errors explain, and at most all of it, for the middle is within the ellipse.

Of an object of which only one edge is seen the middle is about twice the edge's deviation away.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

N_SHAPE_TIMES = 256  # times of a recording at which sizes are read
MIN_SHAPE_TIMES = 8  # of them in a track's life, for its usual sizes to be known
MAX_FITTED_TIMES = 64
MIN_RANK_CORRELATION = 0.85  # of sizes and time, for a target that approaches or leaves
EDGE_DISTANCE_SIZES = 2.0  # of an edge, from it to its object's middle; 1.9 of half a disc
SIGNIFICANT_VARIANCES = 3.0  # squared changes from which a shape differs


class UsualSizes(NamedTuple):
    """Usual sizes of a track: 1 / size is a line over time, within the range that was read."""

    level: NDArray[np.float64]  # (2,) 1/px, at time 0
    slope: NDArray[np.float64]  # (2,) 1/px/s, of a target that approaches or leaves; 0 of others
    low: NDArray[np.float64]  # (2,) 1/px
    high: NDArray[np.float64]  # (2,) 1/px
    away: NDArray[np.float64]  # (2,) larger sizes by which an object's middle is off its lone edge

    def at(self, t: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return sizes (times, 2) px at times (s)."""
        return 1 / np.clip(self.level + self.slope * t[:, None], self.low, self.high)


def fit_usual_sizes(
    t: NDArray[np.floating], sizes: NDArray[np.floating], lone_edge: bool = False
) -> UsualSizes | None:
    """Fit the usual sizes of a track by medians, of pairs for the slope (Theil and Sen).

    Args:
        t: (times,) s.
        sizes: (times, 2) px.
        lone_edge: Whether the target is one edge of an object of which no more is seen.

    Returns:
        The usual sizes; None for fewer than `MIN_SHAPE_TIMES` times.
    """
    if len(t) < MIN_SHAPE_TIMES:
        return None
    kept = np.unique(np.linspace(0, len(t) - 1, MAX_FITTED_TIMES).astype(int))
    t, inverse = np.asarray(t, np.float64)[kept], 1 / np.asarray(sizes, np.float64)[kept]
    i, j = np.triu_indices(len(t), 1)
    slope = np.median((inverse[j] - inverse[i]) / (t[j] - t[i])[:, None], axis=0)
    ranks = np.argsort(np.argsort(inverse, axis=0), axis=0)
    steady = [abs(np.corrcoef(np.arange(len(t)), rank)[0, 1]) for rank in ranks.T]
    slope = np.where(np.array(steady) > MIN_RANK_CORRELATION, slope, 0.0)
    level = np.median(inverse - slope * t[:, None], axis=0)
    away = np.full(2, EDGE_DISTANCE_SIZES if lone_edge else 0.0)
    return UsualSizes(level, slope, inverse.min(0), inverse.max(0), away)


def shape_covariance(
    usual: UsualSizes, t: NDArray[np.floating], mean: Any, covariance: Any
) -> NDArray[np.float64]:
    """Compute the covariance that the change of a track's shape adds to that of its position.

    Args:
        usual: Usual sizes of the track.
        t: (times,) s.
        mean: (times, 8) states, see `TrackStates`.
        covariance: (times, 8, 8) their covariances.

    Returns:
        (times, 2, 2) px^2.
    """
    sizes, known = mean[:, 4:6], usual.at(t)
    change = (np.log(sizes / known) ** 2).mean(1)
    chance = (np.diagonal(covariance, axis1=1, axis2=2)[:, 4:6] / sizes**2).mean(1)
    share = np.where(change > SIGNIFICANT_VARIANCES * chance, 4 * (change - chance), 0)
    c, s = np.cos(mean[:, 6]), np.sin(mean[:, 6])
    axes = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)
    variances = np.minimum(share, 1)[:, None] * known**2
    variances = variances + (usual.away * known.max(1, keepdims=True)) ** 2
    return np.einsum("tij,tj,tkj->tik", axes, variances, axes)
