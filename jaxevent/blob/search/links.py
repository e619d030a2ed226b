"""Targets followed from window to window: predicted, gated, updated, begun, joined and ended.

Each is a Kalman filter of constant velocity in windows of one length. Its size follows that of its
events. Silence is information: where no more events come than the background gives, size and
position hold, and a target that has been silent for two windows stands still, for events need
motion.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.agility import fit_agility
from jaxevent.blob.search.background import CELL, Background
from jaxevent.blob.search.detection import (
    CONTACT,
    FALSE_ALARMS,
    Blobs,
    Scale,
    detect,
    measure_blobs,
    part_blob,
)
from jaxevent.blob.search.gates import Look, Shares
from jaxevent.blob.search.parts import unite
from jaxevent.blob.search.paths import Path
from jaxevent.blob.search.stream import Part, Stream
from jaxevent.blob.search.targets import HOLD, Expected, larger, start_targets, update
from jaxevent.progress import bar

BORN, FILL = 4, 0.5  # windows, and share of its windows, in which a confirmed target was seen
# Windows that silent targets are held: those that are not confirmed, and confirmed ones before a
# scene that moves, where what is silent is hidden and does not stand still.
HOLD_NEW, HOLD_MOVING = 2, 4
YOUNG = 3  # windows: what is in contact then may be a part, what comes in contact later is not
PARTS = 5  # windows of common motion in contact that make two targets one
LONGISH, APART = 2.0, 0.15  # aspect of a target, and share of its events in the smaller of two
GROWN, FARTHER = 1.3, 1.5  # times the least size that it had, and the distance that they had
VALLEY = 0.05  # share of its events that lie between them, of a disc or an outline over 0.2
FREE = 0.7  # share of a blob's events that are nobody's, where a target begins


@dataclasses.dataclass
class _Row:
    """What is kept of a window: of the targets seen."""

    t: float | int
    id: NDArray
    p: NDArray
    v: NDArray
    C: NDArray
    n: NDArray
    m: NDArray  # (n, 2) px, means of the window's events
    R: NDArray  # (n,) px^2, their variance


class Links:
    """Targets followed through a stream: `Links(stream, background, scale).follow()`."""

    def __init__(self, stream: Stream, background: Background, scale: Scale):
        self.stream, self.background, self.scale = stream, background, scale
        self.size = stream.height, stream.width
        none, no_C = np.zeros((0, 2)), np.zeros((0, 2, 2))
        self.live = start_targets(np.zeros(0, np.int64), 0.0, none, no_C, np.zeros(0), scale.window)
        self.next_id = 0
        self.rows: list[_Row] = []
        self.contacts: dict[tuple[int, int], tuple[float, NDArray, float]] = {}
        self.least: dict[int, float] = {}
        self.pairs: dict[int, tuple[float, float, int]] = {}
        self.confirmed: set[int] = set()
        self.parts: dict[int, int] = {}  # and whose
        tests = stream.width * stream.height * stream.duration / scale.window
        self.enough = np.log(tests / FALSE_ALARMS)

    def follow(self, stage: str, progress: bool | None = None) -> list[Path]:
        """The paths of all targets that were confirmed and are no part of another.

        `stage` is shown before the bar of `progress`.
        """
        w = self.scale.window
        windows = int(self.stream.duration / w)
        with bar(total=windows, unit="window", desc=stage, progress=progress) as shown:
            for k in range(windows):
                self._step(k * w)
                shown.update(1)
        self._end(np.ones(len(self.live.id), bool))
        ids = np.concatenate([row.id for row in self.rows] or [np.zeros(0, np.int64)])
        if not len(ids):
            return []
        t = np.concatenate([np.full(len(row.id), row.t) for row in self.rows])
        us = self.stream.start + np.rint(t * 1e6).astype(np.int64)
        joined = [np.concatenate([getattr(row, name) for row in self.rows]) for name in "pvCnmR"]
        paths = {}
        for one in sorted(self.confirmed | set(self.parts)):
            at = np.flatnonzero(ids == one)
            p, v, C, n, m, R = (values[at] for values in joined)
            agility = fit_agility(t[at], m, R, np.median(larger(C)) / w**3)
            paths[one] = Path(us[at], p, v, C, n, round(1e6 * w), agility)
        for part, whole in self.parts.items():  # in order of time: a whole may become a part
            if whole in paths:
                both = unite(paths[whole], paths[part])
                paths[whole] = dataclasses.replace(both, agility=paths[whole].agility)
        return [paths[one] for one in sorted(self.confirmed - set(self.parts))]

    def _step(self, begin: float | int) -> None:
        w = self.scale.window
        t = begin + w / 2
        part = self.stream.window(begin, begin + w)
        labels, blobs = detect(part, self.background, self.scale, self.size, t)
        look = Look(self.live, part, t)
        shares = look.share_out(labels, blobs)
        if len(self.live.id):
            self._update(look, shares)
            self._part(part, t, shares.owner, labels)
            self._join_parts(t)
            self._end(self._over())
        self._begin_targets(part, t, labels, shares)

    def _update(self, look: Look, shares: Shares) -> None:
        """All targets after a window's events."""
        live, t = self.live, look.t
        background, scale = self.background, self.scale
        seen = update(
            live,
            Expected(
                t, scale.window, look.p, look.P, look.soft, background.field(t, 3 * scale.cell),
                background.field_of(scale.dispersion, CELL, t), scale.usual, scale.flicker,
            ),
            shares.found,
            shares.anywhere,
        )  # fmt: skip
        self._confirm(seen.heard, t)
        now, m = seen.heard, look.p + seen.z
        told = (live.id, live.p, live.v, live.C, seen.n, m, seen.R)
        self.rows.append(_Row(t, *(value[now] for value in told)))

    def _confirm(self, heard: NDArray, t: float | int) -> None:
        live = self.live
        if live.confirmed.all():
            return
        age = np.rint((t - live.born) / self.scale.window) + 1
        apart = ~np.isin(live.id, [newer for newer, _ in self.contacts])
        enough = (live.hits >= BORN) & (live.hits >= FILL * age) & (live.nats > self.enough)
        live.confirmed[heard & enough & apart] = True

    def _part(self, part: Part, t: float | int, owner: NDArray, labels: NDArray) -> None:
        """Make two of a target that comes apart into two that go their own ways.

        Of parts of one object, such as both sides of an outline, the distance stays. How far apart
        they are is told along its longer axis, since coarse cells see no gap.
        """
        live, square = self.live, larger(self.live.C)
        longish = square > LONGISH**2 * np.linalg.det(live.C) / square
        before, self.pairs, others = self.pairs, {}, []
        for i in np.flatnonzero(longish & live.confirmed & (live.miss == 0)):
            key, size = int(live.id[i]), float(np.sqrt(square[i]))
            self.least[key] = min(self.least.get(key, size), size)
            if size < GROWN * self.least[key]:
                continue
            at = (owner == i) & (labels > 0)
            two = part_blob(part.x[at], part.y[at], live.C[i], VALLEY)
            if two is None or two.n[1] < APART * at.sum():
                continue
            distance = float(np.hypot(*(two.p[0] - two.p[1])))
            wide = float(np.sqrt(larger(two.C)).sum())
            first, last, windows = before.get(key, (distance, distance, 0))
            if abs(distance - last) > 0.5 * wide:
                first, windows = distance, 0
            if windows < PARTS or distance < max(first + wide, FARTHER * first):
                self.pairs[key] = first, distance, windows + 1
                continue
            live.p[i], live.C[i], live.n[i] = two.p[0], two.C[0], two.n[0]
            del self.least[key]
            others.append(Blobs(two.n[1:], two.p[1:], two.C[1:]))
        for other in others:
            self._begin(t, other)

    def _join_parts(self, t: float | int) -> None:
        """Make one of two targets that touch and move together."""
        if len(self.live.id) < 2:
            self.contacts = {}
            return
        live, w = self.live, self.scale.window
        size = live.size
        reach = size[:, None] + size
        apart = live.p[:, None] - live.p
        near = np.hypot(apart[..., 0], apart[..., 1]) < CONTACT * reach
        heard = (live.miss == 0) & ~live.part
        now: dict[tuple[int, int], tuple[float, NDArray, float]] = {}
        young = t - live.born < (YOUNG - 0.5) * w
        for newer, older in zip(*np.nonzero(np.tril(near, -1)), strict=True):
            key = int(live.id[newer]), int(live.id[older])
            shorter = float(min(live.path[newer], live.path[older]))
            if key not in self.contacts and not young[newer]:
                continue  # they came from apart
            if not (heard[newer] and heard[older]):
                if key in self.contacts:
                    now[key] = self.contacts[key]
                continue
            since, then, path = self.contacts.get(key, (t, apart[newer, older], shorter))
            changed = abs(np.hypot(*apart[newer, older]) - np.hypot(*then))
            if changed >= 0.5 * reach[newer, older]:
                since, then, path = t, apart[newer, older], shorter
            now[key] = since, then, path
            long = (t - since) / w >= PARTS - 0.5
            # Slow neighbours look rigid for a few windows; those that went their own size do not.
            if long and shorter - path > 2 * reach[newer, older]:
                self._join(int(newer), int(older))
                heard = heard & ~live.part
        self.contacts = now

    def _join(self, one: int, other: int) -> None:
        live = self.live

        def weight(i: int) -> tuple[bool, float]:
            return bool(live.confirmed[i]), float(live.n[i] * live.hits[i])

        big, small = (one, other) if weight(one) >= weight(other) else (other, one)
        share = live.n[big] / (live.n[big] + live.n[small])
        p = share * live.p[big] + (1 - share) * live.p[small]
        C = np.zeros((2, 2))
        for i, part in ((big, share), (small, 1 - share)):
            C += part * (live.C[i] + np.outer(live.p[i] - p, live.p[i] - p))
        live.p[big], live.C[big] = p, C
        live.n[big] += live.n[small]
        live.hits[big] = max(live.hits[big], live.hits[small])
        live.part[small] = True
        self.parts[int(live.id[small])] = int(live.id[big])

    def _over(self) -> NDArray[np.bool_]:
        """Which targets end."""
        live, (rows, columns) = self.live, self.size
        x, y = live.p.T
        outside = (x <= -1) | (x >= columns) | (y <= -1) | (y >= rows)
        longest = HOLD if self.background.scene is None else HOLD_MOVING
        hold = np.where(live.confirmed, np.minimum(longest, 2 * live.hits), HOLD_NEW)
        return live.part | outside | (live.miss > hold)

    def _end(self, which: NDArray) -> None:
        if not which.any():
            return
        over = self.live.keep(which)
        self.confirmed |= set(over.id[over.confirmed].tolist())
        for one in over.id.tolist():
            self.least.pop(one, None)
        self.live = self.live.keep(~which)

    def _begin_targets(self, part: Part, t: float | int, labels: NDArray, shares: Shares) -> None:
        """Targets begin at blobs of which most events are nobody's."""
        new = (shares.free >= 3) & (shares.free >= FREE * shares.counts)
        if new.any():
            free = shares.owner < 0
            some = Part(part.t[free], part.x[free], part.y[free])
            n, p, C = measure_blobs(some, labels[free], len(new))
            self._begin(t, Blobs(n[new], p[new], C[new]))

    def _begin(self, t: float | int, blobs: Blobs) -> None:
        n, p, C = blobs
        ids = np.arange(self.next_id, self.next_id + len(n))
        self.next_id += len(n)
        self.live = self.live.add(start_targets(ids, t, p, C, n, self.scale.window))
        self.rows.append(_Row(t, ids, p, np.zeros_like(p), C, n, p, larger(C) / 2 / n))
