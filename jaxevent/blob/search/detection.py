"""Blobs of events that clutter does not make, at a stated rate of false alarms."""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import CELL_PX, Background, CellField, poisson_nats, value_at
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.stream import PixelCounts, WindowEvents
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined

_cells = ZeroedScratch(np.int32)
N_SPLIT_STEPS = 6  # expectation and maximisation, for two targets in a blob


@dataclasses.dataclass(frozen=True)
class Scale:
    """Resolution of the search in time and space.

    Attributes:
        window: Length of windows, s.
        cell: Side of cells, px, a power of 2.
        dispersion: (rows, columns) variance over mean of clutter counts in such windows, in cells
            of 16 px.
        compact: Whether ellipses describe the targets as well as free shapes do.
    """

    window: float | int
    cell: int
    dispersion: NDArray[np.float64]
    compact: bool = False

    @functools.cached_property
    def min_dispersion(self) -> float:
        """Least dispersion of the sensor's cells."""
        return float(self.dispersion.min())

    @functools.cached_property
    def wide_dispersion(self) -> NDArray[np.float64]:
        """(rows, columns) dispersion in 3x3 of the scale's cells, where that of cells adds up."""
        gain = max(1.0, (3 * self.cell / CELL_PX) ** 2)
        return self.min_dispersion + (self.dispersion - self.min_dispersion) * gain


class Blobs(NamedTuple):
    """Moments of the events of blobs."""

    n: NDArray[np.float64]  # (blobs,) events
    p: NDArray[np.float64]  # (blobs, 2) px, means
    C: NDArray[np.float64]  # (blobs, 2, 2) px^2, covariances

    @classmethod
    def zeros(cls, number: int) -> "Blobs":
        """Allocate the moments of so many blobs without events."""
        return cls(np.zeros(number), np.zeros((number, 2)), np.zeros((number, 2, 2)))


class DetectionScratch(NamedTuple):
    """Scratch memory of the detection; cells are numbered row by row, with a border.

    Attributes:
        cell: (pixels,) cell of each pixel.
        filled: (pixels,) cells that are not empty.
        hit: (pixels,) cells with more events than clutter gives.
        waiting: (pixels,) cells of a blob whose neighbours are not yet visited.
        labels: (pixels,) blob of each pixel, from 1 on; 0: none.
    """

    cell: NDArray[np.int64]
    filled: NDArray[np.int64]
    hit: NDArray[np.int64]
    waiting: NDArray[np.int64]
    labels: NDArray[np.int32]

    @classmethod
    def empty(cls, pixels: int) -> "DetectionScratch":
        """Allocate the scratch memory for so many pixels."""
        return cls(*np.empty((4, pixels), np.int64), np.empty(pixels, np.int32))


class ClutterModel(NamedTuple):
    """Clutter of one window and the threshold of detection, for kernels.

    Attributes:
        rates: Rates, 1/(px s).
        dispersion: Variance over mean of the counts in 3x3 cells.
        cell_bits: Binary logarithm of a cell's side in px.
        row_cells: Cells of a row, with the border.
        exposure: Window times the area of 3x3 cells, s px^2.
        min_dispersion: Least dispersion of the sensor.
        min_events: Expected events of 3x3 cells where the clutter is least.
        log_threshold: Evidence from which a cell is detected, nats.
    """

    rates: CellField
    dispersion: CellField
    cell_bits: int
    row_cells: int
    exposure: float | int
    min_dispersion: float | int
    min_events: float | int
    log_threshold: float | int


def clutter_model(
    background: Background, scale: Scale, shape: tuple[int, int], t: float | int
) -> ClutterModel:
    """Return the clutter of a window.

    Args:
        background: Background of the stream.
        scale: Window and cells.
        shape: Rows and columns of the sensor.
        t: Middle of the window, s.
    """
    g = scale.cell
    exposure = scale.window * 9 * g * g
    tests = -(-shape[0] // g) * -(-shape[1] // g) * background.duration / scale.window
    rates = background.rate_field(t, 3 * g)
    return ClutterModel(
        rates, background.field_of(scale.wide_dispersion, t), g.bit_length() - 1,
        -(-shape[1] // g) + 2, float(exposure), scale.min_dispersion,
        float(background.min_rate * rates.factor * exposure),
        float(np.log(tests / CONFIG.false_alarms)),
    )  # fmt: skip


@njit_noalloc
def clutter_at(clutter: Any, x: Any, y: Any) -> Any:
    """Return the rate, 1/(px s), and the dispersion of the clutter at a pixel.

    Args:
        clutter: `ClutterModel`.
        x: Column of the pixel, px.
        y: Row of the pixel, px.

    Returns:
        The rate, and the variance over the mean of counts.
    """
    return value_at(clutter.rates, x, y), value_at(clutter.dispersion, x, y)


def detect(
    events: WindowEvents | PixelCounts, clutter: ClutterModel, shape: tuple[int, int]
) -> tuple[NDArray[np.int32], int]:
    """Detect blobs in one window.

    A blob consists of neighbouring cells that are not empty and whose 3x3 surroundings hold more
    events than clutter gives to one in 10 recordings. Blobs are numbered by the first events of
    their cells.

    Args:
        events: Events or pixels of the window.
        clutter: Clutter of the window.
        shape: Rows and columns of the sensor.

    Returns:
        Blob of each event, from 1 on, 0 for none; and the number of blobs.
    """
    scratch = DetectionScratch.empty(len(events))
    cells = zeroed_cells(shape, 1 << clutter.cell_bits)
    number = find_blobs(events.x, events.y, _event_counts(events), clutter, cells, scratch)
    return scratch.labels, number


def zeroed_cells(shape: tuple[int, int], cell: int) -> NDArray[np.int32]:
    """Return counts of a sensor's cells and of a border of one cell, row by row, all zero."""
    rows, columns = (-(-n // cell) + 2 for n in shape)
    return _cells(rows * columns)


def _event_counts(events: WindowEvents | PixelCounts) -> NDArray[np.int32]:
    """Return the events of each pixel, or 1 of each event."""
    return events.n if isinstance(events, PixelCounts) else np.ones(len(events), np.int32)


# Windows hold far fewer events than there are cells: only those that are not empty are touched, and
# made 0 again.


@njit_noalloc
def find_blobs(x: Any, y: Any, n: Any, clutter: Any, cells: Any, scratch: Any) -> int:
    """Label pixels by the blob that they belong to, and count the blobs.

    Args:
        x: (pixels,) columns, px.
        y: (pixels,) rows, px.
        n: (pixels,) events of each pixel.
        clutter: `ClutterModel`.
        cells: Counts of `zeroed_cells`, zero before and after.
        scratch: `DetectionScratch`, whose `labels` are the output.

    Returns:
        Number of blobs.
    """
    filled = _count_in_cells(x, y, n, clutter, cells, scratch)
    hits = _find_hits(filled, clutter, cells, scratch)
    for i in range(filled):
        cells[scratch.filled[i]] = 0
    return _label_pixels(len(x), hits, clutter.row_cells, cells, scratch)


@njit_noalloc_inlined
def _count_in_cells(x: Any, y: Any, n: Any, clutter: Any, cells: Any, scratch: Any) -> int:
    """Count events in cells, and list the cells that are not empty.

    Args:
        x: (pixels,) columns, px.
        y: (pixels,) rows, px.
        n: (pixels,) events of each pixel.
        clutter: `ClutterModel`.
        cells: Counts of cells, added to.
        scratch: `DetectionScratch`; fills `cell` and `filled`.

    Returns:
        Number of cells that are not empty.
    """
    wide, bits, count = clutter.row_cells, clutter.cell_bits, 0
    for i in range(len(x)):
        at = ((np.int64(y[i]) >> bits) + 1) * wide + (np.int64(x[i]) >> bits) + 1
        scratch.cell[i] = at
        if cells[at] == 0:
            scratch.filled[count] = at
            count += 1
        cells[at] += n[i]
    return count


@njit_noalloc_inlined
def _find_hits(filled: int, clutter: Any, cells: Any, scratch: Any) -> int:
    """List the cells whose 3x3 surroundings hold more events than clutter.

    Args:
        filled: Number of cells that are not empty.
        clutter: `ClutterModel`.
        cells: Counts of cells.
        scratch: `DetectionScratch`; fills `hit`.

    Returns:
        Number of hits.
    """
    wide, g, hit = clutter.row_cells, 1 << clutter.cell_bits, scratch.hit
    # Fewer events are no evidence even where the clutter is least.
    few, least = 1, clutter.log_threshold * clutter.min_dispersion
    while poisson_nats(few, clutter.min_events) <= least:
        few += 1
    count = 0
    for i in range(filled):
        cell = scratch.filled[i]
        total = 0
        for row in (cell - wide, cell, cell + wide):
            total += cells[row - 1] + cells[row] + cells[row + 1]
        if total < few:
            continue
        x, y = (cell % wide - 1) * g + g // 2, (cell // wide - 1) * g + g // 2
        rate, F = clutter_at(clutter, x, y)
        if poisson_nats(total, rate * clutter.exposure) > clutter.log_threshold * F:
            hit[count] = cell
            count += 1
    return count


@njit_noalloc_inlined
def _label_pixels(pixels: int, hits: int, wide: int, labels: Any, scratch: Any) -> int:
    """Label pixels by blobs of neighbouring hits, also across corners.

    Args:
        pixels: Number of pixels.
        hits: Number of cells in `scratch.hit`.
        wide: Cells of a row, with the border.
        labels: Labels of cells, zero before and after.
        scratch: `DetectionScratch`; fills `labels`.

    Returns:
        Number of blobs.
    """
    waiting = scratch.waiting
    for i in range(hits):
        labels[scratch.hit[i]] = -1
    number = 0
    for i in range(hits):
        cell = scratch.hit[i]
        if labels[cell] > 0:
            continue
        number += 1
        labels[cell] = number
        waiting[0], count = cell, 1
        while count > 0:
            count -= 1
            middle = waiting[count]
            for row in (middle - wide, middle, middle + wide):
                for near in range(row - 1, row + 2):
                    if labels[near] == -1:
                        labels[near] = number
                        waiting[count] = near
                        count += 1
    for i in range(pixels):
        scratch.labels[i] = labels[scratch.cell[i]]
    for i in range(hits):
        labels[scratch.hit[i]] = 0
    return number


def measure_blobs(
    events: WindowEvents | PixelCounts, labels: NDArray[np.int32], number: int
) -> Blobs:
    """Compute the moments of all blobs; a pixel's own extent is added to the covariance.

    Args:
        events: Events or pixels of a window.
        labels: Blob of each, from 1 on; 0 for none.
        number: Number of blobs.
    """
    blobs = Blobs.zeros(number)
    sum_blobs(events.x, events.y, _event_counts(events), labels, number, blobs)
    return blobs


@njit_noalloc
def sum_blobs(x: Any, y: Any, weights: Any, labels: Any, number: int, blobs: Any) -> None:
    """Compute the moments of blobs.

    Args:
        x: (pixels,) columns, px.
        y: (pixels,) rows, px.
        weights: (pixels,) events of each pixel.
        labels: (pixels,) blob of each pixel, from 1 on; 0 for none.
        number: Number of blobs.
        blobs: `Blobs`, output: its first `number` rows.
    """
    _clear_blobs(blobs, number)
    # One pass: sums of whole numbers are exact.
    for i in range(len(x)):
        k = labels[i] - 1
        if k >= 0:
            add_moments(blobs, k, float(weights[i]), float(x[i]), float(y[i]))
    finish_moments(blobs, number)


@njit_noalloc_inlined
def add_moments(blobs: Any, k: int, weight: float, x: float, y: float) -> None:
    """Add a place to the sums of blob k.

    Args:
        blobs: `Blobs` that hold sums.
        k: Index of the blob.
        weight: Events at the place.
        x: Column, px.
        y: Row, px.
    """
    n, p, C = blobs
    n[k] += weight
    p[k, 0] += weight * x
    p[k, 1] += weight * y
    C[k, 0, 0] += weight * x * x
    C[k, 0, 1] += weight * x * y
    C[k, 1, 1] += weight * y * y


@njit_noalloc_inlined
def finish_moments(blobs: Any, number: int) -> None:
    """Turn sums of blobs to means and covariances, with a pixel's own extent.

    Args:
        blobs: `Blobs` that hold sums, in place.
        number: Number of blobs, from the first on.
    """
    n, p, C = blobs
    for k in range(number):
        over = 1 / max(n[k], 1e-9)
        p[k, 0] *= over
        p[k, 1] *= over
        C[k, 0, 0] = C[k, 0, 0] * over - p[k, 0] * p[k, 0] + 1 / 12
        C[k, 0, 1] = C[k, 1, 0] = C[k, 0, 1] * over - p[k, 0] * p[k, 1]
        C[k, 1, 1] = C[k, 1, 1] * over - p[k, 1] * p[k, 1] + 1 / 12


@njit_noalloc
def split_blob(events: Any, owner: Any, k: int, two: Any) -> float:
    """Split the events of one owner across their longer axis, and return nats for two targets.

    Two Gaussians of one size are fitted along that axis. The density between the targets is then
    less than at either of them, while that of one body, a bar or a light with a tail, is no less
    there than at its dimmer end. Events in both places tell, by their likelihood.

    Args:
        events: N events.
        owner: (N,) owners of the events.
        k: The owner.
        two: Two blobs, filled in with the one of more events first.
    """
    x, y, (n, p, C) = events.x, events.y, two
    _clear_blobs(two, 2)
    for i in range(len(owner)):
        if owner[i] == k:
            add_moments(two, 0, 1.0, float(x[i]), float(y[i]))
    finish_moments(two, 1)
    number, most = n[0], larger_variance_of(C[0])
    if number < 2 * CONFIG.min_blob_events:
        return -np.inf
    turn = 0.5 * np.arctan2(2 * C[0, 0, 1], C[0, 0, 0] - C[0, 1, 1])
    ux, uy = np.cos(turn), np.sin(turn)
    middle, square, share = ux * p[0, 0] + uy * p[0, 1], C[0, 0, 0] + C[0, 1, 1] - most, 0.5
    # Means of the halves of a Gaussian.
    low, high = middle - 0.8 * np.sqrt(most), middle + 0.8 * np.sqrt(most)
    for _ in range(N_SPLIT_STEPS):
        weight = a = b = squares = 0.0
        for i in range(len(owner)):
            if owner[i] == k:
                s = ux * x[i] + uy * y[i]
                odds = ((s - low) ** 2 - (s - high) ** 2) / 2 / square
                part = 1 / (1 + np.exp(odds) * (1 - share) / share)
                weight += part
                a += part * s
                b += (1 - part) * s
                squares += part * (s - low) ** 2 + (1 - part) * (s - high) ** 2
        if min(weight, number - weight) < CONFIG.min_blob_events:
            return -np.inf
        share, square = weight / number, squares / number + 1 / 12
        low, high = a / weight, b / (number - weight)
    # A third of the distance about the middle between both, and as much about the dimmer one.
    near, dim = (high - low) / 6, low if share < 0.5 else high
    middle, deviation = (low + high) / 2, np.sqrt(2 * square)
    expected_between = expected = between = about = 0.0
    for mean, part in ((low, share), (high, 1 - share)):
        a, b = (middle - near - mean) / deviation, (middle + near - mean) / deviation
        expected_between += part * (math.erf(b) - math.erf(a))
        a, b = (dim - near - mean) / deviation, (dim + near - mean) / deviation
        expected += part * (math.erf(b) - math.erf(a))
    _clear_blobs(two, 2)
    first = 0 if share >= 0.5 else 1
    for i in range(len(owner)):
        if owner[i] == k:
            s = ux * x[i] + uy * y[i]
            between += abs(s - middle) < near
            about += abs(s - dim) < near
            add_moments(two, first if s < middle else 1 - first, 1.0, float(x[i]), float(y[i]))
    finish_moments(two, 2)
    ratio = expected_between / max(expected, 1e-9)
    if ratio >= 1 or min(n[0], n[1]) < CONFIG.min_blob_events:
        return -np.inf
    return between * np.log(2 * ratio / (1 + ratio)) + about * np.log(2 / (1 + ratio))


@njit_noalloc_inlined
def _clear_blobs(blobs: Any, number: int) -> None:
    """Set the moments of blobs to zero.

    Args:
        blobs: `Blobs`, in place.
        number: Number of blobs, from the first on.
    """
    for k in range(number):
        blobs.n[k] = blobs.p[k, 0] = blobs.p[k, 1] = 0.0
        blobs.C[k, 0, 0] = blobs.C[k, 0, 1] = blobs.C[k, 1, 1] = 0.0


@njit_noalloc_inlined
def in_contact(p: Any, C: Any, j: int, k: int) -> bool:
    """Return whether two ellipses of a list are near each other.

    Near is twice the sum of their standard deviations along the line between them.

    Args:
        p: (n, 2) middles of the ellipses, px.
        C: (n, 2, 2) their covariances, px^2.
        j: Index of the one.
        k: Index of the other.

    Returns:
        Whether they are.
    """
    x, y, reach = p[k, 0] - p[j, 0], p[k, 1] - p[j, 1], 0.0
    for i in (j, k):
        reach += np.sqrt(C[i, 0, 0] * x * x + 2 * C[i, 0, 1] * x * y + C[i, 1, 1] * y * y)
    return x * x + y * y <= CONFIG.contact_distance * reach


def larger_variance(C: NDArray) -> NDArray[np.float64]:
    """Return the larger eigenvalues of (..., 2, 2) covariances."""
    half = (C[..., 0, 0] - C[..., 1, 1]) / 2
    return (C[..., 0, 0] + C[..., 1, 1]) / 2 + np.hypot(half, C[..., 0, 1])


@njit_noalloc_inlined
def larger_variance_of(C: Any) -> Any:
    """Return the larger eigenvalue of one covariance, for kernels."""
    half, cross = (C[0, 0] - C[1, 1]) / 2, C[0, 1]
    return (C[0, 0] + C[1, 1]) / 2 + np.sqrt(half * half + cross * cross)
