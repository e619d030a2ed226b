"""The targets of one moment, and what a window of events makes of them."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Field, nats, value_at
from jaxevent.blob.search.paths import STILL
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

GATE = 3.0  # standard deviations
HOLD = 24  # windows that confirmed targets are held that are silent
SEEN, SEEN_NEW = 1e-3, 1e-5  # false alarms of a look where a target is known to be
FAINT = 0.02  # of its own rate: a target with fewer events is silent
GAIN = 0.2  # of size and rate
KNOWN = 8.0  # events that the size told before counts for: by chance two or three lie together
REACH = 1.0  # sizes: by how much a known target leaves its way in a window; others are farther
MOST = 0.5  # of its events
ASIDE = 0.5  # sizes: how far few events of a part of it lie from its middle
TOLD = 3  # windows that tell how a target moves
JITTER = 0.05  # of the size: error of a window's mean, for events of an edge are not independent


class Live(NamedTuple):
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
        return Live._make(value[which] for value in self)

    def add(self, other: "Live") -> "Live":
        return Live._make(np.concatenate(pair) for pair in zip(self, other, strict=True))

    @property
    def size(self) -> NDArray[np.float64]:
        """(n,) px, standard deviation along the longer axis."""
        return np.sqrt(larger(self.C))


@njit_noalloc_inlined
def expect_one(live: Any, k: int, t: Any, p: Any, P: Any) -> None:
    """Position and P of a target at t (s); what stands still is not driven any more."""
    dt, q = t - live.t[k], 0.0
    if live.miss[k] < STILL:
        q = live.q[k] * min(max(live.nis[k], 0.05), 50.0)
    a, b, c = live.P[k, 0], live.P[k, 1], live.P[k, 2]
    P[k, 0] = a + 2 * b * dt + c * dt**2 + q * dt**3 / 3
    P[k, 1], P[k, 2] = b + c * dt + q * dt**2 / 2, c + q * dt
    for i in range(2):
        p[k, i] = live.p[k, i] + live.v[k, i] * dt


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
        ids, zero + t, p, np.zeros((number, 2)), P, C, n, n.copy(), q, zero + 1, zero + t,
        none + 1, none, zero, zero.copy(), np.zeros(number, bool), np.zeros(number, bool),
    )  # fmt: skip


def larger(C: NDArray) -> NDArray[np.float64]:
    """Larger eigenvalues of (..., 2, 2)."""
    half = (C[..., 0, 0] - C[..., 1, 1]) / 2
    return (C[..., 0, 0] + C[..., 1, 1]) / 2 + np.hypot(half, C[..., 0, 1])


class Seen(NamedTuple):
    """What a window tells of each target: its events, where they are, and how certain that is."""

    heard: NDArray[np.bool_]  # (n,)
    n: NDArray[np.float64]  # (n,)
    z: NDArray[np.float64]  # (n, 2) px, mean from where the target was expected
    R: NDArray[np.float64]  # (n,) px^2, its variance


class Expected(NamedTuple):
    """What is known of a window before its events, for kernels."""

    t: float  # s
    window: float  # s
    p: NDArray[np.float64]  # (n, 2) px, of targets
    P: NDArray[np.float64]  # (n, 3)
    soft: NDArray[np.bool_]  # (n,) whether it shares events with others
    rates: Field
    dispersion: Field
    least: float  # dispersion
    more: float  # times it exceeds that more, of the scale's cells


def update(live: Live, expected: Expected, found: Any, anywhere: Any) -> Seen:
    """All targets after a window's events, in place.

    `found` are number, mean and covariance of a target's events in blobs, `anywhere` those of all
    of its events: at one place to look at fewer tell. They move the target, not its size.
    """
    number = len(live.n)
    seen = Seen(
        np.zeros(number, bool), np.zeros(number), np.zeros((number, 2)), np.zeros(number)
    )  # fmt: skip
    _update(live, expected, found, anywhere, seen)
    return seen


@njit_noalloc_inlined
def _background(expected: Any, x: float, y: float, determinant: float) -> Any:
    """Events of the background in a gate, and their dispersion."""
    area = np.pi * GATE * GATE * np.sqrt(max(determinant, 0.0))
    mu = value_at(expected.rates, x, y) * area * expected.window
    F = value_at(expected.dispersion, x, y) - expected.least
    return max(mu, 1e-3), expected.least + F * expected.more


@njit_noalloc
def _update(live: Any, expected: Any, found: Any, anywhere: Any, seen: Any) -> None:
    heard, events, means, errors = seen
    for k in range(len(live.n)):
        (n, z, D), some = (found[0][k], found[1][k], found[2][k]), True
        C, before = live.C[k], expected.P[k]
        if n < 2:
            some, more = False, before[0] + 0.1
            determinant = (C[0, 0] + more) * (C[1, 1] + more) - C[0, 1] * C[0, 1]
            mu, F = _background(expected, expected.p[k, 0], expected.p[k, 1], determinant)
            asked = -np.log(SEEN if live.confirmed[k] else SEEN_NEW)
            all_n = anywhere[0][k]
            n = 0.0
            if all_n >= 2 and nats(all_n, mu) / F >= asked:
                n, z, D = all_n, anywhere[1][k], anywhere[2][k]
        if n >= 2:
            live.top[k] = max(0.99 * live.top[k], n)
        square = (n * larger_of(D) + KNOWN * larger_of(C)) / (n + KNOWN)
        means[k, 0], means[k, 1], errors[k] = z[0], z[1], square / 2 / max(n, 1.0)
        heard[k] = (
            n >= 2 and n >= FAINT * live.top[k] and _is_it(live, k, n, z, before[0] + errors[k])
        )
        events[k] = n
        if heard[k]:
            _hear(live, expected, k, n, z, D, square, some)
        else:
            _miss(live, expected, k)


@njit_noalloc_inlined
def _is_it(live: Any, k: int, n: float, z: Any, variance: float) -> bool:
    """Whether n events whose mean is z from where a target was expected may be it.

    A known target is not where few events are that its motion does not lead to, but for parts of
    it that are seen by turns. Where most of them are it may have turned, but goes no farther than
    `REACH` allows.
    """
    square = (REACH * REACH) * larger_of(live.C[k])
    if n >= MOST * live.n[k]:
        variance = max(variance, square)
    most = GATE * GATE * min(variance + ASIDE * ASIDE * square, 2 * square)
    return live.hits[k] < TOLD or z[0] * z[0] + z[1] * z[1] <= most


@njit_noalloc_inlined
def _miss(live: Any, expected: Any, k: int) -> None:
    """A window of silence: what stands still then goes on, if at all, no faster than before."""
    live.miss[k] += 1
    if live.miss[k] == STILL:
        # Or by its size in the time that it is held.
        fast = live.v[k, 0] ** 2 + live.v[k, 1] ** 2
        fast += larger_of(live.C[k]) / (HOLD * expected.window) ** 2
        live.P[k, 2] = min(live.P[k, 2], fast)
        live.v[k, 0] = live.v[k, 1] = live.P[k, 1] = 0


@njit_noalloc_inlined
def _hear(live: Any, expected: Any, k: int, n: float, z: Any, D: Any, square: float, some: bool):
    """A target with n events at z from where it was expected; `some` of them are in blobs."""
    P, free = expected.P[k], not expected.soft[k]
    total = P[0] + square / 2 / max(n, 1.0) + square * JITTER**2 + 1e-3
    if free:
        nis = min((z[0] * z[0] + z[1] * z[1]) / 2 / total, 30.0)
        live.nis[k] += 0.15 * (nis - live.nis[k])
    moved, a, b = 0.0, P[0] / total, P[1] / total
    for i in range(2):
        p = expected.p[k, i] + a * z[i]
        moved += (p - live.p[k, i]) ** 2
        live.p[k, i] = p
        live.v[k, i] += b * z[i]
    live.path[k] += np.sqrt(moved)
    live.P[k, 0], live.P[k, 1], live.P[k, 2] = (1 - a) * P[0], (1 - a) * P[1], P[2] - b * P[1]
    live.t[k], live.miss[k] = expected.t, 0
    newer = 1 / (live.hits[k] + 1)
    if free and some:
        gain = max(GAIN * min(1.0, n / live.n[k]), newer)
        for i in range(2):
            for j in range(2):
                live.C[k, i, j] += gain * (D[i, j] - live.C[k, i, j])
    live.n[k] += max(GAIN, newer) * (n - live.n[k])
    live.hits[k] += 1
    C = live.C[k]
    determinant = C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]
    mu, F = _background(expected, live.p[k, 0], live.p[k, 1], determinant)
    live.nats[k] += nats(n, mu) / F


@njit_noalloc_inlined
def larger_of(C: Any) -> Any:
    """As `larger`, of one."""
    half, cross = (C[0, 0] - C[1, 1]) / 2, C[0, 1]
    return (C[0, 0] + C[1, 1]) / 2 + np.sqrt(half * half + cross * cross)
