"""Paths of targets through windows of events, and which events are near them."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events

STILL = 2  # windows of silence after which a target stands still
NOBODY = -1  # whose an event is: of no path


@dataclasses.dataclass(frozen=True)
class Path:
    """Where a target was in the windows in which it was seen.

    Attributes:
        t: (rows,) us, the middle of each window.
        p: (rows, 2) px.
        v: (rows, 2) px/s.
        C: (rows, 2, 2) px^2, covariance of the target's events.
        n: (rows,) events in the window, smoothed.
        window: us.
        agility: px^2/s^3, noise of its velocity.
        polarity: Of its events, 1 ON and 0 OFF; None: both. See `prefer_sharper`.
        turn: rad/s at which it turns in its place, from x to y; None: not told. See `join_turning`.
    """

    t: NDArray[np.int64]
    p: NDArray[np.float64]
    v: NDArray[np.float64]
    C: NDArray[np.float64]
    n: NDArray[np.float64]
    window: int
    agility: float
    polarity: int | None = None
    turn: float | None = None

    @property
    def begin(self) -> int:
        """us."""
        return int(self.t[0]) - self.window // 2

    @property
    def end(self) -> int:
        """us; the first moment that is no more of it."""
        return int(self.t[-1]) + self.window // 2

    @property
    def size(self) -> NDArray[np.float64]:
        """(rows, 2) px, standard deviations along the axes, the larger first."""
        return np.sqrt(np.maximum(np.linalg.eigvalsh(self.C)[:, ::-1], 0))

    def at(self, t: NDArray[np.int64]) -> NDArray[np.float64]:
        """Positions (times, 2) at some times, on straight lines between rows."""
        return np.stack([np.interp(t, self.t, self.p[:, i]) for i in range(2)], 1)

    def seen(self, t: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether a window in which it was seen holds the times."""
        after = np.clip(np.searchsorted(self.t, t), 0, len(self.t) - 1)
        before = np.maximum(after - 1, 0)
        return np.minimum(np.abs(self.t[after] - t), np.abs(self.t[before] - t)) <= self.window / 2


class Joined(NamedTuple):
    """Rows of several paths, one after another: those of path k from first[k] to first[k + 1]."""

    first: NDArray[np.int64]
    window: NDArray[np.int64]
    polarity: NDArray[np.int8]  # that an event of each path has; -1: either
    t: NDArray[np.int64]
    p: NDArray[np.float64]
    S: NDArray[np.float64]  # (rows, 3): of events about p, xx, xy, yy

    @property
    def begins(self) -> NDArray[np.int64]:
        """(paths,) us, as `Path.begin`."""
        return self.t[self.first[:-1]] - self.window // 2

    @property
    def ends(self) -> NDArray[np.int64]:
        """(paths,) us, as `Path.end`."""
        return self.t[self.first[1:] - 1] + self.window // 2


def join(paths: Sequence[Path]) -> Joined:
    """The paths' rows."""
    S = [
        path.C * (1 + 2 / np.maximum(path.n, 1))[:, None, None] + 0.1 * np.eye(2) for path in paths
    ]
    S = np.concatenate(S)
    return Joined(
        np.cumsum([0, *(len(path.t) for path in paths)]),
        np.array([path.window for path in paths]),
        np.array([-1 if p.polarity is None else p.polarity for p in paths], np.int8),
        np.concatenate([path.t for path in paths]),
        np.concatenate([path.p for path in paths]),
        np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]], 1),
    )


def candidates(events: Events, joined: Joined, sigmas: float | int) -> NDArray[np.int32]:
    """Of which paths each event may be, (events, 2): `NOBODY`, or the likelier one first.

    Of a path are events of its polarity within `sigmas` standard deviations while it is seen; of
    more than two paths an event is of the likeliest two.
    """
    t, alone = events.t, len(joined.window) == 1
    whose = np.full((len(events), 2), NOBODY, np.int32)
    far = np.empty((0 if alone else len(events), 2))
    rows = np.stack([np.searchsorted(t, us) for us in (joined.begins, joined.ends)])
    _candidates(t, events.x, events.y, events.p, joined, rows, float(sigmas) ** 2, whose, far)
    return whose


@njit_noalloc
def _candidates(
    t: Any, x: Any, y: Any, p: Any, joined: Any, rows: Any, limit: float | int, whose: Any, far: Any
) -> None:
    """Fill in whose events are; `far` are minus twice their log likelihoods, up to a constant.

    Of one path `far` is empty: nothing is compared.
    """
    for k in range(len(joined.window)):
        row, last, i, end = joined.first[k], joined.first[k + 1] - 1, rows[0, k], rows[1, k]
        while i < end:
            while row < last and joined.t[row + 1] <= t[i]:
                row += 1
            to = i
            while to < end and (row == last or t[to] < joined.t[row + 1]):
                to += 1
            place = k, row, min(row + 1, last)
            _between_rows(t, x, y, p, joined, place, (i, to), limit, whose, far)
            i = to


@njit_noalloc_inlined
def _between_rows(
    t: Any, x: Any, y: Any, p: Any, joined: Any, place: Any, events: Any, limit: float | int,
    whose: Any, far: Any,
) -> None:  # fmt: skip
    """The same of events (first, last) between two rows of a path: `place` is it and they."""
    (k, row, following), w, wanted = place, joined.window[place[0]], joined.polarity[place[0]]
    left, right, above, below = _box(joined, row, following, limit)
    begin, span = joined.t[row], joined.t[following] - joined.t[row]
    unseen = span > w + w // 2
    over = 1 / span if span > 0 else 0.0
    x0, y0 = joined.p[row, 0], joined.p[row, 1]
    vx, vy = joined.p[following, 0] - x0, joined.p[following, 1] - y0
    a0, b0, c0 = joined.S[row, 0], joined.S[row, 1], joined.S[row, 2]
    da, db, dc = (
        joined.S[following, 0] - a0, joined.S[following, 1] - b0, joined.S[following, 2] - c0,
    )  # fmt: skip
    for i in range(events[0], events[1]):
        if x[i] < left or x[i] > right or y[i] < above or y[i] > below:
            continue
        if wanted >= 0 and wanted != p[i]:
            continue
        part = min(max((t[i] - begin) * over, 0.0), 1.0)
        if unseen and min(part, 1 - part) * span > w / 2:
            continue
        ex, ey = x[i] - x0 - part * vx, y[i] - y0 - part * vy
        a, b, c = a0 + part * da, b0 + part * db, c0 + part * dc
        squared, determinant = c * ex * ex - 2 * b * ex * ey + a * ey * ey, a * c - b * b
        if squared <= limit * determinant:
            if len(far) == 0:
                whose[i, 0] = k
            else:
                _enter(whose[i], far[i], k, squared / determinant + np.log(determinant))


@njit_noalloc_inlined
def _enter(whose: Any, far: Any, k: int, distance: float) -> None:
    """Path k is one of the likeliest two, or not."""
    if whose[0] < 0 or distance < far[0]:
        whose[1], far[1] = whose[0], far[0]
        whose[0], far[0] = k, distance
    elif whose[1] < 0 or distance < far[1]:
        whose[1], far[1] = k, distance


@njit_noalloc_inlined
def _box(joined: Any, row: int, following: int, limit: Any) -> Any:
    """Least and greatest x and y (px) of what is near a path between two of its rows."""
    p, S = joined.p, joined.S
    wide = np.sqrt(limit * max(S[row, 0], S[following, 0]))
    high = np.sqrt(limit * max(S[row, 2], S[following, 2]))
    return (
        np.int64(np.floor(min(p[row, 0], p[following, 0]) - wide)),
        np.int64(np.ceil(max(p[row, 0], p[following, 0]) + wide)),
        np.int64(np.floor(min(p[row, 1], p[following, 1]) - high)),
        np.int64(np.ceil(max(p[row, 1], p[following, 1]) + high)),
    )
