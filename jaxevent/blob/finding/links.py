"""Targets followed from window to window: predicted, gated, updated, begun, joined and ended.

Each is a Kalman filter of constant velocity in windows of one length. Its size follows that of its
events. Silence is information: where no more events come than the background gives, size and
position hold, and a target that has been silent for two windows stands still, for events need
motion.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.agility import fit_agility
from jaxevent.blob.finding.background import Background, evidence
from jaxevent.blob.finding.detection import (
    CONTACT,
    FALSE_ALARMS,
    Scale,
    detect,
    measure_blobs,
    touching,
)
from jaxevent.blob.finding.gates import GATE, Look
from jaxevent.blob.finding.parts import unite
from jaxevent.blob.finding.paths import STILL, Path
from jaxevent.blob.finding.stream import Part, Stream
from jaxevent.blob.finding.targets import JITTER, larger, start_targets
from jaxevent.progress import bar

BORN, FILL = 4, 0.5  # windows, and share of its windows, in which a confirmed target was seen
# Windows that silent targets are held: confirmed ones (and twice those seen), others; and confirmed
# ones before a scene that moves, where what is silent is hidden and does not stand still.
HOLD, HOLD_NEW, HOLD_MOVING = 24, 2, 4
SEEN, SEEN_NEW = 1e-3, 1e-5  # false alarms of a look where a target is known to be
FAINT = 0.02  # of its own rate: a target with fewer events is silent
GAIN = 0.2  # of size and rate
YOUNG = 3  # windows: what is in contact then may be a part, what comes in contact later is not
PARTS = 5  # windows of common motion in contact that make two targets one
LONGISH, APART = 3.0, 0.25  # aspect of a target, and share of its events in the smaller of two
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
        self.pairs: dict[int, tuple[float, int]] = {}
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
        owner = np.full(len(part), -1)
        if len(self.live.id):
            seen = Look(self.live, part, t)
            owner = seen.share_out(labels, blobs)
            self._update(seen, owner, labels > 0)
            self._part(part, owner, labels, blobs)
            self._join_parts(t)
            self._end(self._over())
        self._begin_targets(part, t, owner, labels, blobs)

    def _update(self, seen: Look, owner: NDArray, in_blob: NDArray) -> None:
        """All targets after a window's events."""
        live, t = self.live, seen.t
        n, z, D = seen.moments(owner, in_blob)
        # One place to look at, no search: fewer events tell. They move the target, not its size.
        weak = n < 2
        if weak.any():
            spread = np.linalg.det(live.C + (seen.P[:, 0] + 0.1)[:, None, None] * np.eye(2))
            all_n, all_z, all_D = seen.moments(owner, np.ones(len(owner), bool))
            told = evidence(all_n, self._expected(seen.p, t, spread), self._dispersion(seen.p, t))
            asked = -np.log(np.where(live.confirmed, SEEN, SEEN_NEW))
            there = weak & (all_n >= 2) & (told >= asked)
            n = np.where(weak, np.where(there, all_n, 0), n)
            z = np.where(there[:, None], all_z, z)
            D = np.where(there[:, None, None], all_D, D)
        live.top = np.where(n >= 2, np.maximum(0.99 * live.top, n), live.top)
        heard = (n >= 2) & (n >= FAINT * live.top)
        live.miss = np.where(heard, 0, live.miss + 1)
        still = live.miss == STILL
        # If it does go on, then no faster than before, or by its size in the time that it is held.
        fast = (live.v**2).sum(1) + larger(live.C) / (HOLD * self.scale.window) ** 2
        live.P[still, 2] = np.minimum(live.P[:, 2], fast)[still]
        live.v[still], live.P[still, 1] = 0, 0

        square = larger(D)
        R = square / 2 / np.maximum(n, 1) + square * JITTER**2 + 1e-3
        total = seen.P[:, 0] + R
        free = heard & ~seen.soft
        nis = np.clip((z**2).sum(1) / 2 / total, 0, 30)
        live.nis = np.where(free, live.nis + 0.15 * (nis - live.nis), live.nis)
        K = seen.P[:, :2] / total[:, None]
        p = seen.p + K[:, :1] * z
        P = np.stack(
            [(1 - K[:, 0]) * seen.P[:, 0], (1 - K[:, 0]) * seen.P[:, 1],
             seen.P[:, 2] - K[:, 1] * seen.P[:, 1]], 1,
        )  # fmt: skip
        live.path += np.where(heard, np.hypot(*(p - live.p).T), 0)
        live.p = np.where(heard[:, None], p, live.p)
        live.v = np.where(heard[:, None], live.v + K[:, 1:] * z, live.v)
        live.P = np.where(heard[:, None], P, live.P)
        live.t = np.where(heard, t, live.t)
        newer = 1 / (live.hits + 1)
        a = np.maximum(GAIN * np.minimum(1, n / live.n), newer)
        sized = free & ~weak
        live.C = np.where(sized[:, None, None], live.C + a[:, None, None] * (D - live.C), live.C)
        a = np.maximum(GAIN, newer)
        live.n = np.where(heard, live.n + a * (n - live.n), live.n)
        live.hits = live.hits + heard
        mu = self._expected(live.p, t, np.linalg.det(live.C))
        told = evidence(n, mu, self._dispersion(live.p, t))
        live.nats = live.nats + np.where(heard, told, 0)
        self._confirm(heard, t)
        some = live.keep(heard)
        m, R = (seen.p + z)[heard], (square / 2 / np.maximum(n, 1))[heard]
        self.rows.append(_Row(t, some.id, some.p, some.v, some.C, n[heard], m, R))

    def _expected(self, p: NDArray, t: float | int, determinant: NDArray) -> NDArray[np.float64]:
        """Events of the background in gates."""
        rate = self.background.at(p[:, 0], p[:, 1], t, 3 * self.scale.cell)
        area = np.pi * GATE**2 * np.sqrt(np.maximum(determinant, 0))
        return np.maximum(rate * area * self.scale.window, 1e-3)

    def _dispersion(self, p: NDArray, t: float | int) -> NDArray[np.float64]:
        return self.scale.dispersion_at(*self.background.place(p[:, 0], p[:, 1], t))

    def _confirm(self, heard: NDArray, t: float | int) -> None:
        live = self.live
        age = np.rint((t - live.born) / self.scale.window) + 1
        apart = ~np.isin(live.id, [newer for newer, _ in self.contacts])
        enough = (live.hits >= BORN) & (live.hits >= FILL * age) & (live.nats > self.enough)
        live.confirmed = live.confirmed | (heard & enough & apart)

    def _part(self, part: Part, owner: NDArray, labels: NDArray, blobs: int) -> None:
        """Leave a target the larger of two blobs that move apart: the other is another one.

        Of parts of one object, such as both sides of an outline, the distance does not double.
        """
        live = self.live
        longish = larger(live.C) > LONGISH**2 * np.linalg.det(live.C) / larger(live.C)
        before, self.pairs = self.pairs, {}
        for i in np.flatnonzero(longish & live.confirmed & (live.miss == 0)):
            at = (owner == i) & (labels > 0)
            two = measure_blobs(Part(part.t[at], part.x[at], part.y[at]), labels[at], blobs)
            a, b = np.argsort(-two.n, kind="stable")[:2] if blobs > 1 else (0, 0)
            if a == b or two.n[b] < APART * at.sum():
                continue
            if touching(two.p[a], two.C[a], two.p[b], two.C[b]) < CONTACT:
                continue
            distance = float(np.hypot(*(two.p[a] - two.p[b])))
            first, windows = before.get(int(live.id[i]), (distance, 0))
            if windows >= PARTS and distance > 2 * first:
                live.p[i], live.C[i], live.n[i] = two.p[a], two.C[a], two.n[a]
                continue
            self.pairs[int(live.id[i])] = first, windows + 1

    def _join_parts(self, t: float | int) -> None:
        """Make one of two targets that touch and move together."""
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
        over = self.live.keep(which)
        self.confirmed |= set(over.id[over.confirmed].tolist())
        self.live = self.live.keep(~which)

    def _begin_targets(
        self, part: Part, t: float | int, owner: NDArray, labels: NDArray, blobs: int
    ) -> None:
        """Targets begin at blobs of which most events are nobody's."""
        if not blobs:
            return
        free = owner < 0
        counts = np.bincount(labels, minlength=blobs + 1)
        found = measure_blobs(Part(part.t[free], part.x[free], part.y[free]), labels[free], blobs)
        new = (found.n >= 3) & (found.n >= FREE * counts[1:])
        number = int(new.sum())
        ids = np.arange(self.next_id, self.next_id + number)
        self.next_id += number
        p, C, n = found.p[new], found.C[new], found.n[new]
        self.live = self.live.add(start_targets(ids, t, p, C, n, self.scale.window))
        self.rows.append(_Row(t, ids, p, np.zeros_like(p), C, n, p, larger(C) / 2 / n))
