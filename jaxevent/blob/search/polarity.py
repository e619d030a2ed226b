"""Targets whose events of one polarity lag: where these are is told by the other's.

A dim light makes ON events at its edge, and OFF events for long after it has gone on. Their mean
lies in the tail, behind the light.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.agility import fit_agility
from jaxevent.blob.search.paths import Path, join
from jaxevent.blob.search.stream import near_paths
from jaxevent.blob.search.targets import GATE
from jaxevent.codegen import njit_noalloc
from jaxevent.recording import Recording

LAGS = 1.8  # times the larger standard deviation of the sharper polarity's events
SHARE = 0.2  # of the events are of the sharper polarity, at least
FEWEST = 4  # windows in which it is seen, and
FEW = 2  # events in each
ENOUGH = 100  # events of a window


def prefer_sharper(paths: list[Path], recording: Recording, hot: NDArray[np.bool_]) -> list[Path]:
    """Paths of the sharper polarity's events, where the other's lag; the others as they are.

    `hot` (rows, columns) are pixels that are left out.
    """
    if not paths:
        return paths
    # Most events of bright targets are not needed to tell that no polarity lags.
    every = max(1, int(min(float(np.median(path.n)) for path in paths) / ENOUGH))
    told = _told(paths, recording, hot, every)
    lags = any(one is not path for one, path in zip(told, paths, strict=True))
    return _told(paths, recording, hot, 1) if lags and every > 1 else told


def _told(
    paths: list[Path], recording: Recording, hot: NDArray[np.bool_], every: int
) -> list[Path]:
    """The same, told by one event of `every`."""
    joined = join(paths)
    sums = np.zeros((len(joined.t), 2, 6))
    for _, part, near in near_paths(recording.events, joined, GATE, every=every):
        now = joined.first[:-1].copy()
        _add(part.t, part.x, part.y, part.p, near, joined, hot, now, sums)
    ends = zip(joined.first[:-1], joined.first[1:], strict=True)
    return [_sharper(path, sums[a:b]) for path, (a, b) in zip(paths, ends, strict=True)]


def _sharper(path: Path, sums: NDArray[np.float64]) -> Path:
    """A path, or that of its sharper events, by sums of its windows' residuals."""
    n, S = sums[..., 0], sums[..., 1:]
    mean = S[..., :2] / np.maximum(n, 1)[..., None]
    spread = np.empty((2, 2, 2))
    for i, (a, b) in enumerate([(0, 0), (0, 1), (1, 1)]):
        within = (S[..., 2 + i] - n * mean[..., a] * mean[..., b]) * (n > 1)
        spread[:, a, b] = spread[:, b, a] = within.sum(0) / np.maximum((n - (n > 0)).sum(0), 1)
    spread += np.eye(2) / 12
    size = np.sqrt(np.linalg.eigvalsh(spread)[:, 1])
    sharp = int(size[1] <= size[0])
    enough = (n[:, sharp] >= FEW).sum() >= FEWEST and n[:, sharp].sum() >= SHARE * n.sum()
    if not enough or (n[:, 1 - sharp] > 1).sum() < FEWEST or size[1 - sharp] < LAGS * size[sharp]:
        return path
    seen = n[:, sharp] >= FEW
    t = path.t * 1e-6
    m = (path.p + mean[:, sharp])[seen]
    p = np.stack([np.interp(t, t[seen], m[:, i]) for i in range(2)], 1)
    R = size[sharp] ** 2 / 2 / n[seen, sharp]
    agility = fit_agility(t[seen], m, R, size[sharp] ** 2 / (path.window * 1e-6) ** 3)
    C = np.broadcast_to(spread[sharp], path.C.shape)
    share = n[:, sharp].sum() / n.sum()
    return dataclasses.replace(path, p=p, C=C, n=share * path.n, agility=agility, polarity=sharp)


@njit_noalloc
def _add(
    t: Any, x: Any, y: Any, p: Any, whose: Any, joined: Any, hot: Any, rows: Any, sums: Any
) -> None:
    """Add events' residuals to the sums of their paths' windows, by polarity.

    `rows` are those at which the search in each path begins.
    """
    for i in range(len(t)):
        k = whose[i, 0]
        if k < 0 or whose[i, 1] >= 0 or hot[y[i], x[i]]:
            continue
        last, half = joined.first[k + 1] - 1, joined.window[k] / 2
        while rows[k] < last and joined.t[rows[k]] + half <= t[i]:
            rows[k] += 1
        row = rows[k]
        if abs(t[i] - joined.t[row]) > half:
            continue
        before, after = max(row - 1, joined.first[k]), min(row + 1, last)
        span = max(joined.t[after] - joined.t[before], 1)
        late = (t[i] - joined.t[row]) / span
        ex = x[i] - joined.p[row, 0] - late * (joined.p[after, 0] - joined.p[before, 0])
        ey = y[i] - joined.p[row, 1] - late * (joined.p[after, 1] - joined.p[before, 1])
        sign = np.int64(p[i])
        sums[row, sign, 0] += 1
        sums[row, sign, 1] += ex
        sums[row, sign, 2] += ey
        sums[row, sign, 3] += ex * ex
        sums[row, sign, 4] += ex * ey
        sums[row, sign, 5] += ey * ey
