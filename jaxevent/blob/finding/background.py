"""Events that are of no target: hot pixels, and the rate of the others in place and time.

The rate is that of cells of the sensor, from the quieter quarter of the recording's slices: targets
only add events, and one that comes back (swings, circles) fills many slices. One factor tells how
active the whole sensor is in each slice.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.blob.finding.stream import Stream
from jaxevent.events.filters import busiest_neighbour

SLICES = 64  # of the recording's time
CELL = 16  # px
FEWEST = 50  # events per slice in the calm cells from which the sensor's activity is told
MOST_WINDOWS = 400  # in which the dispersion is measured
FULL = 5.0  # counts in a cell whose dispersion is measured


@dataclasses.dataclass(frozen=True)
class Background:
    """The rate of events that are of no target.

    Attributes:
        rate: (rows, columns) 1/(px s), of cells of 16 px.
        calm: (slices, rows, columns) where no target seems to be.
        activity: (slices,) factors of the rate, at least 1.
        duration: s.
    """

    rate: NDArray[np.float64]
    calm: NDArray[np.bool_]
    activity: NDArray[np.float64]
    duration: float

    def slice(self, t: ArrayLike | float | int) -> Any:
        """Which slices hold times (s)."""
        part = np.asarray(t) / self.duration * SLICES
        return np.clip(part, 0, SLICES - 1).astype(np.int64)

    def at(self, x: ArrayLike | float | int, y: ArrayLike | float | int, t: float | int) -> Any:
        """Rates, 1/(px s), at some pixels at a time (s)."""
        rows, columns = self.rate.shape
        row = np.clip(np.asarray(y).astype(np.int64) // CELL, 0, rows - 1)
        column = np.clip(np.asarray(x).astype(np.int64) // CELL, 0, columns - 1)
        return self.rate[row, column] * self.activity[self.slice(t)]


def evidence(
    n: ArrayLike | float | int, mu: ArrayLike | float | int, dispersion: float | int
) -> Any:
    """Nats against n events of background, of which mu are expected; 0 if there are no more.

    Chernoff's bound of the Poisson distribution's tail, over the dispersion.
    """
    n, mu = np.asarray(n, np.float64), np.maximum(np.asarray(mu, np.float64), 1e-300)
    told = n * np.log(np.maximum(n / mu, 1)) - n + mu
    return np.where(n > mu, told, 0) / dispersion


def find_hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Pixels that fire far more often than all of their eight neighbours.

    `counts` (rows, columns) are their events. A pixel is hot if it has four times the events of its
    strongest neighbour, and more than chance gives to one of all pixels in a thousand recordings.
    """
    mu = np.maximum(busiest_neighbour(counts), 1.0)
    return (counts > 4 * mu) & (evidence(counts, mu, 1) > np.log(counts.size) + 7)


def measure_background(stream: Stream) -> Background:
    """The background of a stream; hot pixels are marked in the stream."""
    pixels = np.zeros(stream.height * stream.width, np.int64)
    for part in stream.batches():
        pixels += np.bincount(part.y * stream.width + part.x, minlength=len(pixels))
    stream.hot = find_hot_pixels(pixels.reshape(stream.height, stream.width))
    rows, columns = -(-stream.height // CELL), -(-stream.width // CELL)
    cells = np.zeros(SLICES * rows * columns, np.int64)
    for part in stream.batches():
        slices = np.minimum(part.t / stream.duration * SLICES, SLICES - 1).astype(np.int64)
        place = (slices * rows + part.y // CELL) * columns + part.x // CELL
        cells += np.bincount(place, minlength=len(cells))
    return _of_counts(cells.reshape(SLICES, rows, columns).astype(float), stream.duration)


def _of_counts(N: NDArray[np.float64], duration: float) -> Background:
    """Of the counts of all cells in all slices."""
    quarter, empty = np.quantile(N, 0.25, axis=0), (N == 0).mean(0)
    # The mean of a Poisson number from its lower quartile, or from the share of zeros if small.
    few = np.minimum(-np.log(np.clip(empty, 0.5 / SLICES, 1)), 5.0)
    m = np.where(quarter >= 3, quarter + 0.674 * np.sqrt(quarter + 0.5), few)
    m = np.maximum(m, max(float(np.median(m)), 0.02))
    ratio = N / m
    low = ratio <= np.quantile(ratio, 0.7, axis=(1, 2), keepdims=True)
    counted, expected = (N * low).sum((1, 2)), (m * low).sum((1, 2))
    activity = np.ones(SLICES)
    usual = float(np.median(counted / expected))
    if usual > 0 and counted.mean() >= FEWEST:
        activity = np.maximum(1, counted / expected / usual)
    calm = N <= np.maximum(np.median(N, 0), 1)
    return Background(m / (CELL**2 * duration / SLICES), calm, activity, duration)


def measure_dispersion(stream: Stream, background: Background, window: float | int) -> float:
    """Variance over mean of the background's counts in windows (s); at least 1.

    The median over the sensor's cells: targets in a minority of them do not change it.
    """
    number = int(min(MOST_WINDOWS, stream.duration / window))
    rows, columns = background.rate.shape
    middles = (np.arange(number) + 0.5) / number * stream.duration
    slices = background.slice(middles)
    calm = background.calm[slices]
    activity = background.activity[slices][:, None, None]
    N = np.zeros((number, rows, columns))
    for k, middle in enumerate(middles):
        part = stream.window(middle - window / 2, middle + window / 2)
        place = part.y // CELL * columns + part.x // CELL
        N[k] = np.bincount(place, minlength=rows * columns).reshape(rows, columns)
    mean = (N * calm).sum(0) / np.maximum((activity * calm).sum(0), 1)
    squares = (calm * (N - mean * activity) ** 2).sum(0)
    expected = (calm * mean * activity).sum(0)
    full = expected >= FULL
    if full.mean() < 0.5:
        return 1.0
    return max(1.0, float(np.median(squares[full] / expected[full])))
