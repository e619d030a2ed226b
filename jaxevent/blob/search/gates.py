"""Whose the events of a window are: those in targets' gates, and the blobs that these claim."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.detection import Blobs, add_moments, finish_moments, touch
from jaxevent.blob.search.stream import Part
from jaxevent.blob.search.targets import GATE, REACH, Live, expect_one, larger_of
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

CLAIMED, OWNS = 0.3, 0.1  # shares of a blob that is claimed, and of those who own the rest of it


class Gates(NamedTuple):
    """Where the events of some targets are expected at a time, for kernels."""

    p: NDArray[np.float64]  # (n, 2) px
    v: NDArray[np.float64]  # (n, 2) px/s
    inverse: NDArray[np.float64]  # (n, 4): of their covariance xx, xy, yy; log determinant
    more: NDArray[np.float64]  # (n,) added to an event's distance
    events: NDArray[np.float64]  # (n,) per window
    soft: NDArray[np.bool_]  # (n,) whether a target shares events with others


class Look:
    """What targets see of a window about t (s)."""

    def __init__(self, live: Live, part: Part, t: float | int):
        self.part, self.t = part, t
        n = len(live.n)
        self.p, self.P, self.soft = np.empty((n, 2)), np.empty((n, 3)), np.zeros(n, bool)
        self.gates = Gates(self.p, live.v, np.empty((n, 4)), np.empty(n), live.n, self.soft)
        _expect(live, t, self.P, self.gates)

    def share_out(self, labels: NDArray, blobs: int) -> "Shares":
        """Whose each event is, of which blob each is, from 1 on, and what targets have of them."""
        targets, soft = len(self.p), np.flatnonzero(self.soft)
        shares = Shares(
            np.full(len(self.part), -1), np.zeros((blobs, targets), np.int64),
            np.zeros(blobs, np.int64), np.zeros(blobs, np.int64),
            np.zeros((blobs, targets), bool), np.zeros(blobs, bool),
            Blobs(np.zeros(targets), np.zeros((targets, 2)), np.zeros((targets, 2, 2))),
            Blobs(np.zeros(targets), np.zeros((targets, 2)), np.zeros((targets, 2, 2))),
        )  # fmt: skip
        space = soft, np.zeros(len(soft))
        _share_out(*self.part, self.t, labels, self.gates, shares, space)
        return shares


@njit_noalloc
def _expect(live: Any, t: Any, P: Any, gates: Any) -> None:
    """Fill in where targets are expected at t (s), P, and their gates.

    A known target leaves its way by about its size in a window: what is farther is another. Of
    known targets that touch, events between them are shared.
    """
    for k in range(len(live.n)):
        C, known = live.C[k], live.confirmed[k]
        expect_one(live, k, t, gates.p, P)
        variance = min(P[k, 0], REACH * REACH * larger_of(C)) if known else P[k, 0]
        more = 1 + 2 / live.n[k]
        a, b, c = C[0, 0] * more + variance + 0.1, C[0, 1] * more, C[1, 1] * more + variance + 0.1
        determinant = a * c - b * b
        inverse = gates.inverse[k]
        inverse[0], inverse[1], inverse[2] = c / determinant, -b / determinant, a / determinant
        inverse[3], gates.more[k] = np.log(determinant), 0.0 if known else 2.0
        for j in range(k):
            if known and live.confirmed[j] and touch(gates.p, live.C, j, k):
                gates.soft[j] = gates.soft[k] = True


class Shares(NamedTuple):
    """Whose the events of a window are, as `_share_out` fills it in."""

    owner: NDArray[np.int64]  # whose each event is, -1: nobody's
    table: NDArray[np.int64]  # (blobs, targets) events of a blob in a target's gate,
    counts: NDArray[np.int64]  # (blobs,) all of it,
    free: NDArray[np.int64]  # (blobs,) and what is nobody's
    own: NDArray[np.bool_]  # (blobs, targets) who owns the rest of a blob,
    owned: NDArray[np.bool_]  # (blobs,) and whether it is owned
    found: Blobs  # number, mean and covariance of residuals of each target's events in blobs,
    anywhere: Blobs  # and of all, if some target has fewer than two in blobs


@njit_noalloc_inlined
def _residual(gates: Any, k: int, x: Any, y: Any, late: float) -> tuple[float, float]:
    """How far an event lies from where a target then is, in px."""
    return (
        x - gates.p[k, 0] - gates.v[k, 0] * late,
        y - gates.p[k, 1] - gates.v[k, 1] * late,
    )


@njit_noalloc_inlined
def _squared(ex: float, ey: float, inverse: Any) -> float:
    return inverse[0] * ex * ex + 2 * inverse[1] * ex * ey + inverse[2] * ey * ey


@njit_noalloc
def _share_out(
    t: Any, x: Any, y: Any, middle: Any, labels: Any, gates: Any, shares: Any, space: Any
) -> None:
    _share(t, x, y, middle, labels, gates, shares)
    for i in range(len(t)):
        if labels[i] > 0 and shares.owner[i] < 0:
            shares.free[labels[i] - 1] += 1
    _moments(t, x, y, middle, labels, True, gates, shares.owner, space, shares.found)
    for k in range(len(gates.p)):
        if shares.found.n[k] < 2:
            _moments(t, x, y, middle, labels, False, gates, shares.owner, space, shares.anywhere)
            break


@njit_noalloc_inlined
def _share(t: Any, x: Any, y: Any, middle: Any, labels: Any, gates: Any, shares: Any) -> None:
    """Whose each event is."""
    owner, table, counts, own, owned = (
        shares.owner, shares.table, shares.counts, shares.own, shares.owned,
    )  # fmt: skip
    targets, inverse = len(gates.p), gates.inverse
    for i in range(len(t)):
        least, late = np.inf, t[i] - middle
        for k in range(targets):
            ex, ey = _residual(gates, k, x[i], y[i], late)
            squared = _squared(ex, ey, inverse[k])
            distance = squared + inverse[k, 3] + gates.more[k]
            if squared < GATE * GATE and distance < least:
                least, owner[i] = distance, k
        if labels[i] > 0:
            counts[labels[i] - 1] += 1
            if owner[i] >= 0:
                table[labels[i] - 1, owner[i]] += 1
    # The rest of a blob goes with its owners: targets may grow at once or pass their gates.
    for k in range(len(counts)):
        claimed, most = 0, 0
        for j in range(targets):
            claimed += table[k, j]
            most = max(most, table[k, j])
        if claimed >= CLAIMED * counts[k]:
            for j in range(targets):
                own[k, j] = table[k, j] >= min(OWNS * counts[k], most) and table[k, j] > 0
                owned[k] |= own[k, j]
    for i in range(len(t)):
        blob, k = labels[i] - 1, owner[i]
        if blob < 0 or not owned[blob]:
            continue
        if k >= 0 and (own[blob, k] or gates.more[k] == 0):
            continue
        least, late = np.inf, t[i] - middle
        for k in range(targets):
            if own[blob, k]:
                ex, ey = _residual(gates, k, x[i], y[i], late)
                distance = _squared(ex, ey, inverse[k]) + inverse[k, 3] + gates.more[k]
                if distance < least:
                    least, owner[i] = distance, k


@njit_noalloc_inlined
def _moments(
    t: Any, x: Any, y: Any, middle: Any, labels: Any, in_blobs: bool, gates: Any, owner: Any,
    space: Any, told: Any,
) -> None:  # fmt: skip
    """Number, mean and covariance of residuals; targets in contact share events in both gates."""
    (n, z, C), inverse, (soft, share) = told, gates.inverse, space
    for i in range(len(t)):
        if in_blobs and labels[i] <= 0:
            continue
        late, sharing = t[i] - middle, 0
        for j in range(len(soft)):
            k = soft[j]
            ex, ey = _residual(gates, k, x[i], y[i], late)
            squared, share[j] = _squared(ex, ey, inverse[k]), 0.0
            if squared < GATE * GATE:
                sharing += 1
                share[j] = np.exp(-0.5 * (squared + inverse[k, 3])) * gates.events[k]
        if sharing > 1:
            total = 0.0
            for j in range(len(soft)):
                total += share[j]
            for j in range(len(soft)):
                if share[j] > 0:
                    _add(n, z, C, soft[j], share[j] / total, x[i], y[i], late, gates)
        elif owner[i] >= 0:
            _add(n, z, C, owner[i], 1.0, x[i], y[i], late, gates)
    finish_moments(n, z, C, len(n))


@njit_noalloc_inlined
def _add(n: Any, z: Any, C: Any, k: int, w: float, x: Any, y: Any, late: float, gates: Any) -> None:
    """Add an event's residual to a target's sums."""
    ex, ey = _residual(gates, k, x, y, late)
    add_moments(n, z, C, k, w, ex, ey)
