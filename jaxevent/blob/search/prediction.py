"""Density of a window's events, predicted from blobs in the two windows before it, at a scale."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Blobs,
    ClutterModel,
    DetectionScratch,
    find_blobs,
    in_contact,
    larger_variance_of,
    sum_blobs,
    zeroed_cells,
)
from jaxevent.blob.search.stream import PixelCounts, Stream
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined

_bins = ZeroedScratch(np.int32)
KERNEL_RADII_PX = (3.0, 8.0, 20.0)
KERNEL_BINS_PX = (2, 4, 8)  # side of the bins of events that each kernel is applied to
N_DENSITIES = 1 + len(KERNEL_RADII_PX)  # one of ellipses, one of each kernel
N_EM_STEPS = 15  # expectation-maximisation steps for the shares of these densities
MAX_SQUARED_SIGMAS = 80.0  # squared standard deviations beyond which a Gaussian is 0


@functools.cache
def _kernel_weights(r: float, g: int) -> NDArray[np.float64]:
    """Tabulate the kernel 3 / (pi r^2) (1 - d^2 / r^2)^2, 1/px^2.

    Args:
        r: Radius of the kernel, px.
        g: Side of a bin, px.

    Returns:
        (g, g, bins, bins) weights [v, u] of the bins around a pixel that lies in row v and column u
        of its own bin.
    """
    reach = int(np.ceil((r + g - 1) / g - 0.5)) - 1  # bins nearer than r, on either side
    apart = (np.arange(-reach, reach + 1) + 0.5) * g - np.arange(g)[:, None]
    squared = apart[:, None, :, None] ** 2 + apart[None, :, None, :] ** 2
    return 3 / (np.pi * r**2) * np.maximum(1 - squared / r**2, 0) ** 2


class ScoredEvents(NamedTuple):
    """Events of a window on which predictions are scored."""

    pixels: PixelCounts
    background: NDArray[np.float64]  # (pixels,) 1/px^2, density of background events there
    n_window_events: int  # number of all events of the window


class ScalePrediction(NamedTuple):
    """Density of a window's events, predicted at one scale."""

    density: NDArray[np.float64]  # (pixels, 4) 1/px^2, of ellipses and of each kernel
    scored: ScoredEvents
    # (3,) numbers of events in blobs, in large ones (`min_blob_events`), and in large ones that
    # touch another
    blob_events: NDArray[np.float64]


class PredictionScore(NamedTuple):
    """Log-likelihood gain of the predictions of a scale over background alone.

    Attributes:
        raw: Gain, nats per event.
        penalised: Gain less a penalty for blobs in contact, nats per event.
        ellipses_only: Penalised gain of ellipses without kernels, nats per event.
        by_window: (windows,) contributions to `raw`.
        n_events: Number of all events of the windows.
    """

    raw: float
    penalised: float
    ellipses_only: float
    by_window: NDArray[np.float64]
    n_events: int


class _PredictionScratch(NamedTuple):
    """Scratch memory of `_add_prediction`."""

    detection: DetectionScratch
    before: Blobs
    last: Blobs
    predicted: Blobs
    touches: NDArray[np.bool_]  # (pixels,) whether a blob is in contact with another
    bins: tuple[NDArray[np.int32], ...]  # zeros, one image of bins for each kernel
    tables: tuple[NDArray[np.float64], ...]  # `_kernel_weights`

    @classmethod
    def empty(cls, pixels: int, shape: tuple[int, int]) -> "_PredictionScratch":
        """Allocate scratch memory for windows of at most `pixels` pixels on a sensor (h, w)."""
        tables = tuple(map(_kernel_weights, KERNEL_RADII_PX, KERNEL_BINS_PX))
        bins = tuple(_bins(*(n // len(one) + one.shape[-1] for n in shape)) for one in tables)
        return cls(
            DetectionScratch.empty(pixels), *(Blobs.zeros(pixels) for _ in range(3)),
            np.empty(pixels, bool), bins, tables,
        )  # fmt: skip


def sample_scored(
    stream: Stream, background: Background, t: float | int, window: float | int
) -> ScoredEvents:
    """Sample the events of a window on which predictions are scored.

    Args:
        stream: Events.
        background: Their background.
        t: Begin of the window, s.
        window: Length of the window, s.

    Returns:
        The events.
    """
    pixels, number = stream.sample(t, t + window, CONFIG.max_scored_events)
    return ScoredEvents(pixels, background.rate_at(pixels.x, pixels.y, t) * window, number)


def predict(
    before: tuple[PixelCounts, PixelCounts],
    scored: ScoredEvents,
    clutters: Sequence[ClutterModel],
    shape: tuple[int, int],
) -> list[ScalePrediction]:
    """Predict the density of a window's events at several scales.

    Args:
        before: Pixels of the two windows before, the earlier first.
        scored: Events where the density is evaluated.
        clutters: Clutter of the windows at each scale.
        shape: Rows and columns of the sensor.

    Returns:
        A prediction for each scale.
    """
    number = len(scored.pixels)
    scratch = _PredictionScratch.empty(max(map(len, before)), shape)
    order = np.argsort(scored.pixels.y)
    rows, out = (order, scored.pixels.y[order]), []
    for clutter in clutters:
        cells = zeroed_cells(shape, 1 << clutter.cell_bits)
        density, sums = np.zeros((number, N_DENSITIES)), np.zeros(3)
        _add_prediction(before, scored.pixels, rows, clutter, cells, scratch, (density, sums))
        out.append(ScalePrediction(density, scored, sums))
    return out


def score(predictions: list[ScalePrediction]) -> PredictionScore:
    """Score the predictions of one scale for several windows."""
    scored = [one.scored for one in predictions]
    number = sum(one.n_window_events for one in scored)
    windows = np.arange(len(scored)).repeat([len(one.pixels) for one in scored])
    b = np.concatenate([one.background for one in scored])
    ratio = np.concatenate([one.density for one in predictions]) / b[:, None]
    most = CONFIG.max_scored_events
    weight = np.concatenate([max(1.0, one.n_window_events / most) * one.pixels.n for one in scored])
    expected, large, touching = np.array([one.blob_events for one in predictions]).T
    near = ratio.any(1)  # pixels that a blob may reach
    windows, ratio, weight = windows[near], ratio[near], weight[near]
    # Maximum-likelihood shares of the densities.
    shares = np.full(N_DENSITIES, 1 / N_DENSITIES)
    for _ in range(N_EM_STEPS):
        shares = shares * ((weight / (1 + ratio @ shares)) @ ratio) + 1e-12
        shares /= shares.sum()
    gains = weight * np.log1p(ratio @ shares)
    by_window = (np.bincount(windows, gains, len(scored)) - expected) / max(number, 1)
    raw = float(by_window.sum())
    ellipses = float(weight @ np.log1p(ratio[:, 0]) - expected.sum()) / max(number, 1)
    penalty = CONFIG.split_loss * abs(raw) * float(touching.sum()) / max(float(large.sum()), 1e-9)
    return PredictionScore(raw, raw - penalty, ellipses - penalty, by_window, number)


@njit_noalloc
def _add_prediction(
    before: Any, scored: Any, rows: Any, clutter: Any, cells: Any, scratch: Any, out: Any
) -> None:
    """Add the predicted densities of a window's events, and the events of blobs.

    Args:
        before: `PixelCounts` of the two windows before, the earlier first.
        scored: `PixelCounts` at which the density is evaluated.
        rows: Indices that sort the scored pixels by row, and the sorted rows.
        clutter: `ClutterModel`.
        cells: Counts of `zeroed_cells`, zero before and after.
        scratch: `_PredictionScratch`.
        out: `density` (pixels, 4), 1/px^2, and `blob_events` (3,) of `ScalePrediction`, added to.
    """
    (first, second), (density, blob_events) = before, out
    labels = scratch.detection.labels
    earlier = find_blobs(first.x, first.y, first.n, clutter, cells, scratch.detection)
    sum_blobs(first.x, first.y, first.n, labels, earlier, scratch.before)
    number = find_blobs(second.x, second.y, second.n, clutter, cells, scratch.detection)
    sum_blobs(second.x, second.y, second.n, labels, number, scratch.last)
    if number == 0:
        return
    _extrapolate(earlier, number, scratch)
    _add_ellipses(density, scored, rows, number, scratch)
    for k in range(len(KERNEL_RADII_PX)):
        _fill_kernel_density(density[:, k + 1], scored, second, k, scratch)
    for k in range(number):
        blob_events[0] += scratch.last.n[k]
    blob_events[1], blob_events[2] = _count_events_in_contact(number, scratch)


@njit_noalloc_inlined
def _extrapolate(earlier: int, number: int, scratch: Any) -> None:
    """Predict each blob of the next window from its last position and its nearest predecessor.

    Args:
        earlier: Number of blobs in `scratch.before`.
        number: Number of blobs in `scratch.last`.
        scratch: `_PredictionScratch`; fills `predicted`.
    """
    (n0, p0, C0), (n, p1, C1), (new, p, S) = scratch.before, scratch.last, scratch.predicted
    for k in range(number):
        least, nearest = np.inf, -1
        for j in range(earlier):
            ex, ey = p1[k, 0] - p0[j, 0], p1[k, 1] - p0[j, 1]
            apart = ex * ex + ey * ey
            if apart < least:
                least, nearest = apart, j
        new[k] = n[k]
        moves = np.sqrt(least) < 6 * np.sqrt(larger_variance_of(C1[k])) + 2
        for i in range(2):
            p[k, i] = p1[k, i]
            if moves:
                p[k, i] += p1[k, i] - p0[nearest, i]
            for j in range(2):
                S[k, i, j] = C1[k, i, j] * (1 + 4 / n[k]) + (0.1 if i == j else 0.0)
                if moves:
                    S[k, i, j] += 2 * (C1[k, i, j] / n[k] + C0[nearest, i, j] / n0[nearest])


@njit_noalloc_inlined
def _add_ellipses(density: Any, scored: Any, rows: Any, number: int, scratch: Any) -> None:
    """Add the densities of Gaussian blobs at the scored pixels to the first column.

    Args:
        density: (pixels, 4), 1/px^2, added to.
        scored: `PixelCounts`.
        rows: Indices that sort the pixels by row, and the sorted rows.
        number: Number of blobs.
        scratch: `_PredictionScratch`.
    """
    (n, p, S), x, y, (order, sorted_y) = scratch.predicted, scored.x, scored.y, rows
    for k in range(number):
        a, b, c = S[k, 0, 0], S[k, 0, 1], S[k, 1, 1]
        determinant = a * c - b * b
        peak = n[k] / (2 * np.pi * np.sqrt(determinant))
        wide, high = np.sqrt(MAX_SQUARED_SIGMAS * a), np.sqrt(MAX_SQUARED_SIGMAS * c)
        first = np.searchsorted(sorted_y, p[k, 1] - high)
        for i in range(first, len(order)):
            if sorted_y[i] >= p[k, 1] + high:
                break
            j = order[i]
            ex, ey = x[j] - p[k, 0], y[j] - p[k, 1]
            if abs(ex) < wide:
                squared = (c * ex * ex - 2 * b * ex * ey + a * ey * ey) / determinant
                if squared < MAX_SQUARED_SIGMAS:
                    density[j, 0] += peak * np.exp(-0.5 * squared)


@njit_noalloc_inlined
def _fill_kernel_density(out: Any, scored: Any, pixels: Any, k: int, scratch: Any) -> None:
    """Compute the kernel density of the moved events at the scored pixels.

    Each event is put into the middle of its bin.

    Args:
        out: (scored pixels,) output, 1/px^2.
        scored: `PixelCounts` at which the density is evaluated.
        pixels: `PixelCounts` of the last window, which move with their blobs.
        k: Index of the kernel.
        scratch: `_PredictionScratch`, whose bins are zero before and after.
    """
    table, counts = scratch.tables[k], scratch.bins[k]
    g, reach = len(table), table.shape[2] // 2
    _bin_moved_events(counts, pixels, 1, (g, reach), scratch)
    # Unsigned: numba checks the sign of signed indices, which takes two fifths of the time.
    wide, side = np.uint64(2 * reach + 1), np.uint64(g)
    for j in range(len(out)):
        at_y, at_x, total = np.uint64(scored.y[j]), np.uint64(scored.x[j]), 0.0
        row, column = at_y // side, at_x // side
        v, u = at_y - row * side, at_x - column * side
        for a in range(wide):
            for b in range(wide):
                total += table[v, u, a, b] * counts[row + a, column + b]
        out[j] = total
    _bin_moved_events(counts, pixels, -1, (g, reach), scratch)


@njit_noalloc_inlined
def _bin_moved_events(counts: Any, pixels: Any, sign: int, bins: Any, scratch: Any) -> None:
    """Add the events of blobs, moved with them to the next window, to bins, or subtract them.

    Args:
        counts: (rows, columns) of bins, added to.
        pixels: `PixelCounts` of the last window.
        sign: 1 to add, -1 to subtract.
        bins: Side of a bin, px, and number of bins beyond the sensor on either side.
        scratch: `_PredictionScratch`.
    """
    (rows, columns), (g, reach) = counts.shape, bins
    p, last = scratch.predicted.p, scratch.last.p
    for i in range(len(pixels.x)):
        k = scratch.detection.labels[i] - 1
        if k >= 0:
            row = int((pixels.y[i] + (p[k, 1] - last[k, 1])) / g + reach)
            column = int((pixels.x[i] + (p[k, 0] - last[k, 0])) / g + reach)
            if 0 <= row < rows and 0 <= column < columns:
                counts[row, column] += sign * pixels.n[i]


@njit_noalloc_inlined
def _count_events_in_contact(number: int, scratch: Any) -> tuple[float, float]:
    """Count the events in large blobs, and in large blobs that touch another one.

    Pieces of one outline touch each other; its two opposite sides do not.

    Args:
        number: Number of blobs in `scratch.last`.
        scratch: `_PredictionScratch`; fills `touches`.

    Returns:
        Both numbers of events.
    """
    (n, p, C), touches = scratch.last, scratch.touches
    least, large, touching = CONFIG.min_blob_events, 0.0, 0.0
    for k in range(number):
        touches[k] = False
        for j in range(k):
            if min(n[k], n[j]) >= least and not (touches[k] and touches[j]):
                if in_contact(p, C, j, k):
                    touches[k] = touches[j] = True
    for k in range(number):
        if n[k] >= least:
            large += n[k]
            if touches[k]:
                touching += n[k]
    return large, touching
