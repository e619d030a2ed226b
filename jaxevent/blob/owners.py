"""The targets that each event may belong to, of those whose paths are known.

The search leaves the events of found targets out with it, and the tracker takes from it the two
targets that an event may update.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events

NO_OWNER_INDEX = -1  # index of the path of an event that is near none


class PathTable(NamedTuple):
    """Rows of several paths, one after another; path k has rows first[k] to first[k + 1]."""

    first: NDArray[np.int64]  # (paths + 1,)
    window: NDArray[np.int64]  # (paths,) us
    polarity: NDArray[np.int8]  # (paths,) polarity of the path's events; -1: either
    t: NDArray[np.int64]  # (rows,) us
    p: NDArray[np.float64]  # (rows, 2) px
    S: NDArray[np.float64]  # (rows, 3) px^2, covariance of events about p: xx, xy, yy

    @property
    def begins(self) -> NDArray[np.int64]:
        """(paths,) us, starts of the paths."""
        return self.t[self.first[:-1]] - self.window // 2

    @property
    def ends(self) -> NDArray[np.int64]:
        """(paths,) us, ends of the paths, which they do not include."""
        return self.t[self.first[1:] - 1] + self.window // 2


class _Owners(NamedTuple):
    """Columns of events, and the likeliest paths of each, for kernels.

    Attributes:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) polarities.
        owner: (n, 2) likeliest paths of each event; -1: none.
        cost: (n, 2) -2 ln likelihood + constant, output; (0, 2) for a single path.
    """

    t: NDArray[np.int64]
    x: NDArray[np.integer]
    y: NDArray[np.integer]
    p: NDArray[np.bool_]
    owner: NDArray[np.int32]
    cost: NDArray[np.float64]


def owner_candidates(events: Events, table: PathTable, sigmas: float | int) -> NDArray[np.int32]:
    """Find the two paths that each event may belong to.

    An event may belong to a path if it has the path's polarity, lies within `sigmas` standard
    deviations of it, and falls into a window in which the target is seen.

    Args:
        events: N events, sorted by time.
        table: Rows of all paths.
        sigmas: Radius of the gate, standard deviations.

    Returns:
        (N, 2) indices of the two likeliest paths, the likelier first; `NO_OWNER_INDEX` for none.
    """
    t, single = events.t, len(table.window) == 1
    owner = np.full((len(events), 2), NO_OWNER_INDEX, np.int32)
    near = _Owners(t, events.x, events.y, events.p, owner, np.empty((0 if single else len(t), 2)))
    rows = np.stack([np.searchsorted(t, us) for us in (table.begins, table.ends)])
    _find_owners(near, table, rows, float(sigmas) ** 2)
    return owner


@njit_noalloc
def _find_owners(near: Any, table: Any, rows: Any, limit: float | int) -> None:
    """Find the paths that may own each event.

    Args:
        near: `_Owners`, the events; owners and costs are output.
        table: `PathTable` of all paths.
        rows: (2, paths) first event of each path's life, and the one after its last.
        limit: Largest squared Mahalanobis distance of an owner.
    """
    for k in range(len(table.window)):
        row, last, i, end = table.first[k], table.first[k + 1] - 1, rows[0, k], rows[1, k]
        while i < end:
            while row < last and table.t[row + 1] <= near.t[i]:
                row += 1
            to = i
            while to < end and (row == last or near.t[to] < table.t[row + 1]):
                to += 1
            _find_owners_between(near, table, (k, row, min(row + 1, last)), (i, to), limit)
            i = to


@njit_noalloc_inlined
def _find_owners_between(near: Any, table: Any, place: Any, events: Any, limit: float | int):
    """Find the events between two rows of a path that it may own.

    Args:
        near: `_Owners`, the events; owners and costs are output.
        table: `PathTable` of all paths.
        place: Number of the path, and both rows of the table.
        events: First event, and the one after the last.
        limit: Largest squared Mahalanobis distance of an owner.
    """
    (k, row, following), w, polarity = place, table.window[place[0]], table.polarity[place[0]]
    x, y, p, S = near.x, near.y, table.p, table.S
    wide = np.sqrt(limit * max(S[row, 0], S[following, 0]))
    high = np.sqrt(limit * max(S[row, 2], S[following, 2]))
    left = np.int64(np.floor(min(p[row, 0], p[following, 0]) - wide))
    right = np.int64(np.ceil(max(p[row, 0], p[following, 0]) + wide))
    top = np.int64(np.floor(min(p[row, 1], p[following, 1]) - high))
    bottom = np.int64(np.ceil(max(p[row, 1], p[following, 1]) + high))
    begin, span = table.t[row], table.t[following] - table.t[row]
    unseen = span > w + w // 2
    over = 1 / span if span > 0 else 0.0
    x0, y0 = p[row, 0], p[row, 1]
    vx, vy = p[following, 0] - x0, p[following, 1] - y0
    a0, b0, c0 = S[row, 0], S[row, 1], S[row, 2]
    da, db, dc = S[following, 0] - a0, S[following, 1] - b0, S[following, 2] - c0
    for i in range(events[0], events[1]):
        if x[i] < left or x[i] > right or y[i] < top or y[i] > bottom:
            continue
        if polarity >= 0 and polarity != near.p[i]:
            continue
        part = min(max((near.t[i] - begin) * over, 0.0), 1.0)
        if unseen and min(part, 1 - part) * span > w / 2:
            continue
        ex, ey = x[i] - x0 - part * vx, y[i] - y0 - part * vy
        a, b, c = a0 + part * da, b0 + part * db, c0 + part * dc
        squared, determinant = c * ex * ex - 2 * b * ex * ey + a * ey * ey, a * c - b * b
        if squared <= limit * determinant:
            if len(near.cost) == 0:
                near.owner[i, 0] = k
            else:
                cost = squared / determinant + np.log(determinant)
                _insert_owner(near.owner[i], near.cost[i], k, cost)


@njit_noalloc_inlined
def _insert_owner(owner: Any, cost: Any, k: int, new: float) -> None:
    """Insert a path among the two likeliest owners of an event.

    Args:
        owner: (2,) numbers of the paths, -1 for none.
        cost: (2,) -2 ln p of the event for these, but for a constant.
        k: Number of the path.
        new: Its cost.
    """
    if owner[0] < 0 or new < cost[0]:
        owner[1], cost[1] = owner[0], cost[0]
        owner[0], cost[0] = k, new
    elif owner[1] < 0 or new < cost[1]:
        owner[1], cost[1] = k, new
