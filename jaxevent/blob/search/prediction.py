"""What two windows of events predict of the next one's, by blobs at some scale."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background
from jaxevent.blob.search.detection import (
    CONTACT,
    Blobs,
    Scale,
    Space,
    blank_cells,
    blob_moments,
    find_blobs,
    ground_of,
    touch,
)
from jaxevent.blob.search.stream import Pixels, Stream
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined

_bins = ZeroedScratch(np.int32)
SCORED = 2000  # most events of a window that are scored
WIDTHS, BINS = (3.0, 8.0, 20.0), (2, 4, 8)  # px, of the kernels
KERNELS = len(WIDTHS)
ROUNDS = 15  # of expectation and maximisation, for the shares of ellipses and kernels
SPLIT = 0.2  # of the score is lost where all events are in blobs that touch another one
LARGE = 3  # events of a blob that may be split
STRIP = 16  # px
FAR = 80.0  # squared standard deviations from which an ellipse tells nothing


def _weights(r: float, g: int) -> NDArray[np.float64]:
    """Of a kernel, 3 / (pi r^2) (1 - d^2 / r^2)^2: (g, g, bins, bins) 1/px^2.

    Of bins around a pixel that is in row v and column u of its own bin, by v and u.
    """
    reach = int(np.ceil((r + g - 1) / g - 0.5)) - 1  # of the last bin that is nearer than r
    apart = (np.arange(-reach, reach + 1) + 0.5) * g - np.arange(g)[:, None]
    squared = apart[:, None, :, None] ** 2 + apart[None, :, None, :] ** 2
    return 3 / (np.pi * r**2) * np.maximum(1 - squared / r**2, 0) ** 2


_TABLES = tuple(_weights(r, g) for r, g in zip(WIDTHS, BINS, strict=True))


class Scored(NamedTuple):
    """Events of a window that are scored."""

    pixels: Pixels
    background: NDArray[np.float64]  # 1/px^2, at these
    number: int  # of all events


class Told(NamedTuple):
    """What a scale predicts of the events of a window."""

    density: NDArray[np.float64]  # (pixels, 4) 1/px^2, by ellipses and by kernels
    scored: Scored
    expected: float  # events of the blobs
    large: float  # events in blobs of three and more,
    split: float  # and in those of them that touch another one


def choose_scored(
    stream: Stream, background: Background, t: float | int, window: float | int
) -> Scored:
    """At most `SCORED` events of a window that begins at t (s), at equal steps."""
    pixels, number = stream.sample(t, t + window, SCORED)
    return Scored(pixels, background.at(pixels.x, pixels.y, t) * window, number)


def predict(
    first: Pixels,
    second: Pixels,
    scored: Scored,
    background: Background,
    scales: Sequence[Scale],
    size: tuple[int, int],
    t: float | int,
) -> list[Told]:
    """What two windows tell of the third, which begins at t (s), at scales of such windows.

    `size`: rows and columns, px.
    """
    bins = tuple(
        _bins(*(n // g + table.shape[-1] for n in size))
        for table, g in zip(_TABLES, BINS, strict=True)
    )
    x, y, _ = scored.pixels
    space = _PredictionSpace.of(max(len(first), len(second)), len(x), size[0] // STRIP + 1)
    densities = np.zeros((len(scales), len(x), 1 + KERNELS))
    sums = np.zeros((len(scales), 3))
    for scale, density, told in zip(scales, densities, sums, strict=True):
        ground, cells = ground_of(background, scale, size, t), blank_cells(size, scale.cell)
        _predict(first, second, x, y, ground, cells, bins, _TABLES, space, density, told)
    return [
        Told(density, scored, *told) for density, told in zip(densities, sums.tolist(), strict=True)
    ]


class _PredictionSpace(NamedTuple):
    """Where `_predict` keeps what it needs of windows of so many pixels."""

    blobs: Space
    before: Blobs
    last: Blobs
    p: NDArray[np.float64]  # (pixels, 2) px, where the blobs' next events are expected,
    S: NDArray[np.float64]  # (pixels, 2, 2) px^2, and how these scatter
    moved: NDArray[np.float64]  # (2, pixels) px, places of pixels that move with their blobs,
    events: NDArray[np.int32]  # (pixels,) and their events
    reach: NDArray[np.float64]  # (pixels,) px, of blobs
    touches: NDArray[np.bool_]  # (pixels,) whether a blob touches another
    order: NDArray[np.int64]  # scored pixels, by their strips of rows; then those that are near
    strips: NDArray[np.int64]  # (2, strips + 1): where each begins, and is filled

    @classmethod
    def of(cls, pixels: int, scored: int, strips: int) -> "_PredictionSpace":
        return cls(
            Space.of(pixels), Blobs.of(pixels), Blobs.of(pixels), *Blobs.of(pixels)[1:],
            np.empty((2, pixels)), np.empty(pixels, np.int32), np.empty(pixels),
            np.empty(pixels, bool), np.empty(scored, np.int64), np.empty((2, strips + 1), np.int64),
        )  # fmt: skip


class Score(NamedTuple):
    """How well a scale predicts: nats per event."""

    raw: float
    whole: float  # and less what is split
    parts: NDArray[np.float64]  # (windows,) of which the first is the sum


def score(told: list[Told]) -> Score:
    """Of a scale, from what it tells of some windows."""
    scored = [one.scored for one in told]
    number = sum(one.number for one in scored)
    ends = np.cumsum([0, *(len(one.pixels) for one in scored)])
    if not ends[-1]:
        return Score(0.0, 0.0, np.zeros(len(told)))
    density = np.concatenate([one.density for one in told])
    b = np.concatenate([one.background for one in scored])
    weight = np.concatenate([max(1.0, one.number / SCORED) * one.pixels.n for one in scored])
    expected, large, split = (
        np.array([getattr(one, name) for one in told]) for name in ("expected", "large", "split")
    )
    gains, shares = np.zeros(len(told)), np.full((2, 1 + KERNELS), 1 / (1 + KERNELS))
    _gains(density, b, weight, ends, np.empty(len(b), np.int64), shares, gains)
    parts = (gains - expected) / number
    raw = float(parts.sum())
    lost = SPLIT * abs(raw) * float(split.sum()) / max(float(large.sum()), 1e-9)
    return Score(raw, raw - lost, parts)


@njit_noalloc
def _gains(density: Any, b: Any, weight: Any, ends: Any, some: Any, shares: Any, nats: Any) -> None:
    """Log likelihood ratios of windows with the likeliest shares of ellipses and kernels.

    `some` is filled with the pixels that a blob may reach.
    """
    share, new, number = shares[0], shares[1], 0
    for i in range(len(b)):
        total = 0.0
        for j in range(1 + KERNELS):
            total += density[i, j]
        if total > 0:
            some[number] = i
            number += 1
    for _ in range(ROUNDS):
        for j in range(1 + KERNELS):
            new[j] = 0.0
        for k in range(number):
            i = some[k]
            total = b[i]
            for j in range(1 + KERNELS):
                total += density[i, j] * share[j]
            part = weight[i] / total
            for j in range(1 + KERNELS):
                new[j] += part * density[i, j]
        total = 0.0
        for j in range(1 + KERNELS):
            share[j] = share[j] * new[j] + 1e-12
            total += share[j]
        for j in range(1 + KERNELS):
            share[j] /= total
    window = 0
    for k in range(number):
        i = some[k]
        while i >= ends[window + 1]:
            window += 1
        total = 0.0
        for j in range(1 + KERNELS):
            total += density[i, j] * share[j]
        nats[window] += weight[i] * np.log(total / b[i] + 1)


@njit_noalloc
def _predict(
    first: Any, second: Any, x: Any, y: Any, ground: Any, cells: Any, bins: Any, tables: Any,
    space: Any, density: Any, told: Any,
) -> None:  # fmt: skip
    labels = space.blobs.labels
    earlier = find_blobs(first.x, first.y, first.n, ground, cells, space.blobs)
    blob_moments(first.x, first.y, first.n, labels, earlier, space.before)
    number = find_blobs(second.x, second.y, second.n, ground, cells, space.blobs)
    blob_moments(second.x, second.y, second.n, labels, number, space.last)
    if len(x) and number:
        _extrapolate(earlier, number, space)
        _add_ellipses(density, x, y, number, space)
        pixels = _move(second, space)
        near, order = len(x), space.order
        for j in range(near):
            order[j] = j
        for k in range(KERNELS - 1, -1, -1):
            out = density[:, k + 1]
            _add_kernels(out, x, y, order[:near], pixels, space, tables[k], bins[k])
            # What the widest one does not reach the others do not.
            if k == KERNELS - 1:
                near = 0
                for j in range(len(x)):
                    if out[j] > 0:
                        order[near] = j
                        near += 1
        for k in range(number):
            told[0] += space.last.n[k]
        told[1], told[2] = _split(number, space)


@njit_noalloc_inlined
def _larger(C: Any) -> Any:
    """The larger eigenvalue."""
    half, cross = (C[0, 0] - C[1, 1]) / 2, C[0, 1]
    return (C[0, 0] + C[1, 1]) / 2 + np.sqrt(half * half + cross * cross)


@njit_noalloc_inlined
def _extrapolate(earlier: int, number: int, space: Any) -> None:
    """Where the blobs' next events are expected: means and covariances."""
    (n0, p0, C0), (n, p1, C1), p, S = space.before, space.last, space.p, space.S
    for k in range(number):
        least, nearest = np.inf, -1
        for j in range(earlier):
            ex, ey = p1[k, 0] - p0[j, 0], p1[k, 1] - p0[j, 1]
            apart = ex * ex + ey * ey
            if apart < least:
                least, nearest = apart, j
        moves = np.sqrt(least) < 6 * np.sqrt(_larger(C1[k])) + 2
        for i in range(2):
            p[k, i] = p1[k, i]
            if moves:
                p[k, i] += p1[k, i] - p0[nearest, i]
            for j in range(2):
                S[k, i, j] = C1[k, i, j] * (1 + 4 / n[k]) + (0.1 if i == j else 0.0)
                if moves:
                    S[k, i, j] += 2 * (C1[k, i, j] / n[k] + C0[nearest, i, j] / n0[nearest])


@njit_noalloc_inlined
def _add_ellipses(density: Any, x: Any, y: Any, number: int, space: Any) -> None:
    """Events per px^2 of some Gaussian blobs at pixels, added to the first column.

    Pixels are sorted into strips of rows: a blob looks into those that it reaches.
    """
    n, p, S, order = space.last.n, space.p, space.S, space.order
    first, following = space.strips[0], space.strips[1]
    strips = len(first) - 1
    for j in range(strips + 1):
        first[j] = 0
    for j in range(len(x)):
        first[y[j] // STRIP + 1] += 1
    for j in range(strips):
        first[j + 1] += first[j]
        following[j] = first[j]
    for j in range(len(x)):
        strip = y[j] // STRIP
        order[following[strip]] = j
        following[strip] += 1
    for k in range(number):
        a, b, c = S[k, 0, 0], S[k, 0, 1], S[k, 1, 1]
        determinant = a * c - b * b
        peak = n[k] / (2 * np.pi * np.sqrt(determinant))
        wide, high = np.sqrt(FAR * a), np.sqrt(FAR * c)
        low = min(max(int((p[k, 1] - high) / STRIP), 0), strips - 1)
        top = min(max(int((p[k, 1] + high) / STRIP), 0), strips - 1)
        for i in range(first[low], first[top + 1]):
            j = order[i]
            ex, ey = x[j] - p[k, 0], y[j] - p[k, 1]
            if abs(ex) < wide and abs(ey) < high:
                squared = (c * ex * ex - 2 * b * ex * ey + a * ey * ey) / determinant
                if squared < FAR:
                    density[j, 0] += peak * np.exp(-0.5 * squared)


@njit_noalloc_inlined
def _move(pixels: Any, space: Any) -> int:
    """Pixels of blobs, moved as these, and their events: how many they are."""
    moved, p, last, m = space.moved, space.p, space.last.p, 0
    for i in range(len(pixels.x)):
        k = space.blobs.labels[i] - 1
        if k >= 0:
            moved[0, m] = pixels.x[i] + (p[k, 0] - last[k, 0])
            moved[1, m] = pixels.y[i] + (p[k, 1] - last[k, 1])
            space.events[m] = pixels.n[i]
            m += 1
    return m


@njit_noalloc_inlined
def _add_kernels(
    out: Any, x: Any, y: Any, some: Any, pixels: int, space: Any, table: Any, counts: Any
) -> None:
    """Kernels about places, summed at some pixels: of bins, `counts`, in whose middles they lie."""
    (rows, columns), g, reach = counts.shape, len(table), table.shape[2] // 2
    px, py, events = space.moved[0], space.moved[1], space.events
    for k in range(pixels):
        row, column = int(py[k] / g + reach), int(px[k] / g + reach)
        if 0 <= row < rows and 0 <= column < columns:
            counts[row, column] += events[k]
    # Of what may be negative numba asks at every place: that takes two fifths of the time.
    wide, side = np.uint64(2 * reach + 1), np.uint64(g)
    for j in some:
        at_y, at_x, total = np.uint64(y[j]), np.uint64(x[j]), 0.0
        row, column = at_y // side, at_x // side
        v, u = at_y - row * side, at_x - column * side
        for a in range(wide):
            for b in range(wide):
                total += table[v, u, a, b] * counts[row + a, column + b]
        out[j] = total
    for k in range(pixels):
        row, column = int(py[k] / g + reach), int(px[k] / g + reach)
        if 0 <= row < rows and 0 <= column < columns:
            counts[row, column] = 0


@njit_noalloc_inlined
def _split(number: int, space: Any) -> tuple[float, float]:
    """Events in large blobs, and in those that touch another one.

    By ellipses: pieces along an outline touch each other, both of its sides do not.
    """
    (n, p, C), reach, touches = space.last, space.reach, space.touches
    large = split = 0.0
    for k in range(number):
        reach[k], touches[k] = np.sqrt(_larger(C[k])), False
    for k in range(number):
        for j in range(k):
            if n[k] < LARGE or n[j] < LARGE or (touches[k] and touches[j]):
                continue
            ux, uy = p[j, 0] - p[k, 0], p[j, 1] - p[k, 1]
            if ux * ux + uy * uy >= (CONTACT * (reach[k] + reach[j])) ** 2:
                continue
            if touch(p, C, j, k):
                touches[k] = touches[j] = True
    for k in range(number):
        if n[k] >= LARGE:
            large += n[k]
            if touches[k]:
                split += n[k]
    return large, split
