"""Parts of one object, such as pieces of its outline, made one path.

What is in contact with an object all its life and goes along with it is a part of it. Targets that
meet or cross come from apart, and those that stand side by side do not go anywhere. What turns
about each other by a whole turn at one distance, as blades of a propeller do, is rigid.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.detection import CONTACT
from jaxevent.blob.search.paths import Path

TOGETHER = 0.9  # share of the shorter life at which two paths are in contact
MOVED = 2.0  # sizes of the smaller one: least way
EDGE = 3.0  # aspect from which a part is a piece of an edge
ALONG = 0.75  # of its longer variance is along its way: that is less than 30 degrees off its axis
LESS = 0.25  # of its events: a piece of an object that is long along its way
NEAR = 3.0  # for `CONTACT`, of pieces of an edge: between them it may have too few events
PIECE, REACH = 0.55, 2.5  # sizes of the larger one: of a piece of it, and half their distance,
RIGID = 1 / 3  # which changes by less than this share of their way;
WIDE = 4.0  # px: what is smaller is seen as one, as two stars near each other are two
NEXT, STIFF, TURN = 4.0, 0.15, 2 * np.pi  # sizes of both, change of distance, rad: of what turns
POINT = 1.5  # px: what is smaller is none, as stars about a diffuse light


def join_parts(paths: list[Path]) -> list[Path]:
    """Make one of paths that are parts of one object; all are seen in the same windows."""
    paths, k = sorted(paths, key=lambda path: path.n.sum(), reverse=True), 0
    while k < len(paths):
        part = next((i for i in range(k + 1, len(paths)) if _one_object(paths[k], paths[i])), None)
        if part is None:
            k += 1
        else:
            # The whole may now touch what none of its parts did.
            paths[k], k = unite(paths[k], paths.pop(part)), 0
    return paths


def _one_object(one: Path, other: Path) -> bool:
    """Whether two paths are those of parts of one object."""
    begin, end = max(one.begin, other.begin), min(one.end, other.end)
    if end - begin < TOGETHER * min(one.end - one.begin, other.end - other.begin):
        return False
    t = np.union1d(one.t, other.t)
    t = t[(t >= begin) & (t < end)]
    p, q = one.at(t), other.at(t)
    apart = np.hypot(*(p - q).T)
    sizes = np.stack([np.interp(t, path.t, path.size[:, 0]) for path in (one, other)])
    edge = _is_edge(one, other) or _is_edge(other, one)
    small, large = np.sort(np.median(sizes, 1))
    # What an object lacks when a piece of it is a target of its own makes it smaller than it is.
    near = np.quantile(apart / sizes.sum(0), TOGETHER) < (NEAR if edge else CONTACT)
    reaches = np.quantile(apart, TOGETHER) < 2 * REACH * large
    piece = large > WIDE and POINT < small < PIECE * large and reaches
    if not (near or piece):
        return _turn_together(p, q, NEXT * float(np.median(sizes.sum(0))))
    # Pieces slide along an edge, but less far than they go with it.
    far = min(float(np.ptp(path, axis=0).max()) for path in (p, q))
    changed = np.ptp(np.quantile(apart, (0.02, 0.98)))
    if not near:
        return bool(far > MOVED * large and changed < RIGID * far)
    return bool(far > MOVED * small and changed < max(large, far if edge else far / 2))


def _is_edge(one: Path, other: Path) -> bool:
    """Whether one is long, and across its way, or along it with far more events than the other.

    Edges along the motion send few events: two that are long along it may follow each other.
    """
    size = np.median(one.size[:, 0])
    way = one.p[-1] - one.p[0]
    along = way @ np.median(one.C, 0) @ way / max(float(way @ way), 1e-9)
    across = along < ALONG * size**2 or np.median(other.n) < LESS * np.median(one.n)
    return bool(np.median(one.size[:, 0] / one.size[:, 1]) > EDGE and across)


def _turn_together(p: NDArray, q: NDArray, reach: float | int) -> bool:
    """Whether two ways (rows, 2) px turn about each other by a whole turn, at one distance."""
    apart = np.hypot(*(p - q).T)
    low, middle, high = np.quantile(apart, (1 - TOGETHER, 0.5, TOGETHER))
    if high > reach or high - low > STIFF * middle:
        return False
    turned = np.unwrap(np.arctan2(*(p - q).T))
    return bool(abs(turned[-1] - turned[0]) > TURN)


def unite(one: Path, other: Path) -> Path:
    """One path of two parts: the moments of the events of both, of each while it is seen."""
    t = np.union1d(one.t, other.t)
    rows = [_at(path, t) for path in (one, other)]
    n = rows[0].n + rows[1].n
    share = rows[1].n / n
    d = rows[1].p - rows[0].p
    C = (1 - share)[:, None, None] * rows[0].C + share[:, None, None] * rows[1].C
    C += (share * (1 - share))[:, None, None] * np.einsum("ti,tj->tij", d, d)
    p = rows[0].p + share[:, None] * d
    v = rows[0].v + share[:, None] * (rows[1].v - rows[0].v)
    return Path(t, p, v, C, n, one.window, min(one.agility, other.agility))


def _at(path: Path, t: NDArray[np.int64]) -> Path:
    """A path at other times (us), on straight lines; without events before and after its life."""

    def of(values: NDArray) -> NDArray[np.float64]:
        flat = values.reshape(len(path.t), -1)
        told = np.stack([np.interp(t, path.t, column) for column in flat.T], 1)
        return told.reshape(len(t), *values.shape[1:])

    alive = (t >= path.t[0]) & (t <= path.t[-1])
    return dataclasses.replace(
        path, t=t, p=of(path.p), v=of(path.v), C=of(path.C), n=np.where(alive, of(path.n), 0)
    )
