"""Events that are of no target: hot pixels, and the rate of the others in place and time.

The rate is that of cells of the sensor, from the quieter quarter of the recording's slices: targets
only add events, and one that comes back (swings, circles) fills many slices. One factor tells how
active the whole sensor is in each slice. Where the background is steady and bright, as lamps that
flicker are, cells are smaller, and how its counts disperse is measured for each.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.scene import SceneMotion
from jaxevent.blob.search.stream import Stream, cell_at
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.events.filters import busiest_neighbour

SLICES = 64  # of the recording's time
USUAL = 0.9  # quantile over slices: what a place has where it has much
CELL, FINE = 16, 4  # px; fine cells where the background is bright:
BRIGHT, STEADY = 4.0, 0.5  # times the sensor's median rate, and its own in nearly all slices
PLENTY = 12  # events per slice and cell in which finer ones have enough
FEWEST = 50  # events per slice in the calm cells from which the sensor's activity is told
MOST_WINDOWS = 400  # in which the dispersion is measured
GOLDEN = 0.5 * (5**0.5 - 1)
FULL = 5.0  # counts in a cell whose dispersion is measured
UNMOVED = np.eye(2, 3)


class Field(NamedTuple):
    """Values of places at one moment, for kernels: `value_at(field, x, y)` at a pixel."""

    values: NDArray[np.float64]  # (rows, columns)
    cell: int  # px
    factor: float | int
    place: NDArray[np.float64]  # (2, 3), from pixels to px in the cells


@njit_noalloc_inlined
def value_at(field: Any, x: Any, y: Any) -> Any:
    """As `look_up`."""
    place = cell_at(field.place, x, y, field.cell, field.values.shape)
    return field.values[place] * field.factor


@dataclasses.dataclass(frozen=True)
class Background:
    """The rate of events that are of no target.

    Attributes:
        rate: (rows, columns) 1/(px s), of cells of 4 px.
        calm: (slices, rows, columns) where no target seems to be, in cells of 16 px.
        bright: (rows, columns) where the background itself flickers.
        activity: (slices,) factors of the rate, at least 1.
        duration: s.
        scene: How the scene moves, if it does; rate, calm and bright are of places in the scene.
        corner: x and y (px) of the scene's place where they begin.
        level: (slices,) events of the median place, of those in its fullest slices but a tenth.
    """

    rate: NDArray[np.float64]
    calm: NDArray[np.bool_]
    bright: NDArray[np.bool_]
    activity: NDArray[np.float64]
    duration: float
    scene: SceneMotion | None = None
    corner: tuple[int, int] = (0, 0)
    level: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.ones(SLICES))
    _means: dict[int, NDArray[np.float64]] = dataclasses.field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def slice(self, t: NDArray | float | int) -> Any:
        """Which slices hold times (s)."""
        part = np.asarray(t) / self.duration * SLICES
        return np.clip(part, 0, SLICES - 1).astype(np.int64)

    def at(
        self, x: NDArray | float | int, y: NDArray | float | int, t: Any, over: int = FINE
    ) -> Any:
        """Rates, 1/(px s), at some pixels at a time (s); in a scene means of `over` x `over` px."""
        place = self.place(x, y, t)
        return look_up(self._rates(over), FINE, *place) * self.activity[self.slice(t)]

    def field(self, t: float | int, over: int = FINE) -> Field:
        """The same of all pixels at one time, for kernels."""
        now = min(max(int(t / self.duration * SLICES), 0), SLICES - 1)
        return Field(self._rates(over), FINE, float(self.activity[now]), self.placing(t))

    def field_of(self, values: NDArray[np.float64], cell: int, t: float | int) -> Field:
        """Other values of the same places, in cells of so many px."""
        return Field(values, cell, 1.0, self.placing(t))

    def _rates(self, over: int) -> NDArray[np.float64]:
        if self.scene is None:
            return self.rate
        cells = max(1, round(over / FINE))
        if cells not in self._means:
            mean = ndimage.uniform_filter(self.rate, cells)
            self._means[cells] = np.maximum(mean, self.rate.min())
        return self._means[cells]

    def placing(self, t: float | int) -> NDArray[np.float64]:
        """`place` at one time as a map (2, 3)."""
        return UNMOVED if self.scene is None else placing(self.scene, self.corner, t)

    @functools.cached_property
    def least(self) -> float:
        """1/(px s), where the background is darkest."""
        return float(self.rate.min())

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Places of `rate` that are seen when no target is there."""
        return np.kron(self.calm.any(0), np.ones((CELL // FINE, CELL // FINE), bool))

    @property
    def mean(self) -> float:
        """1/(px s), over all places that are seen when no target is there."""
        part = self.seen
        return float((self.rate * part).sum() / part.sum())

    @property
    def sharp(self) -> float:
        """The longest window, s, in which the scene moves no farther than a cell."""
        return np.inf if self.scene is None else FINE / max(self.scene.speed, 1e-9)

    def place(self, x: Any, y: Any, t: Any) -> tuple[Any, Any]:
        """Where pixels are at times (s), px from `corner`."""
        if self.scene is None:
            return x, y
        x, y = self.scene.in_scene(x, y, t)
        return x - self.corner[0], y - self.corner[1]


def placing(scene: SceneMotion, corner: tuple[int, int], t: float | int) -> NDArray[np.float64]:
    """The map (2, 3) from px of the sensor at a time (s) to those of a scene from a corner."""
    x, y = scene.in_scene(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), t)
    first = [x[0] - corner[0], y[0] - corner[1]]
    return np.stack([[x[1] - x[0], y[1] - y[0]], [x[2] - x[0], y[2] - y[0]], first], 1)


def in_steps(
    spans: NDArray[np.float64], scene: SceneMotion | None, corner: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Spans (n, 2) s in which a scene stands still, of such in which it moves.

    And `placing` (n, 2, 3) of each, and of which of those given it is a part.
    """
    if scene is None:
        return spans, np.tile(UNMOVED, (len(spans), 1, 1)), np.arange(len(spans))
    times = [scene.steps(*span) for span in spans]
    parts = np.concatenate([np.stack([t[:-1], t[1:]], 1) for t in times])
    places = np.stack([placing(scene, corner, t) for t in parts.mean(1)])
    return parts, places, np.repeat(np.arange(len(spans)), [len(t) - 1 for t in times])


def look_up(values: NDArray, cell: int, x: NDArray | float | int, y: NDArray | float | int) -> Any:
    """Values (rows, columns) of cells of so many px at some pixels."""
    rows, columns = values.shape
    row = np.clip(np.asarray(y).astype(np.int64) // cell, 0, rows - 1)
    column = np.clip(np.asarray(x).astype(np.int64) // cell, 0, columns - 1)
    return values[row, column]


def evidence(
    n: NDArray | float | int, mu: NDArray | float | int, dispersion: NDArray | float | int
) -> Any:
    """Nats against n events of background, of which mu are expected; 0 if there are no more.

    Chernoff's bound of the Poisson distribution's tail, over the dispersion.
    """
    n, mu = np.asarray(n, np.float64), np.maximum(np.asarray(mu, np.float64), 1e-300)
    told = n * np.log(np.maximum(n / mu, 1)) - n + mu
    return np.where(n > mu, told, 0) / dispersion


@njit_noalloc_inlined
def nats(n: float | int, mu: float | int) -> float:
    """`evidence` for kernels, of a dispersion of 1."""
    return n * np.log(n / mu) - n + mu if n > mu else 0.0


def find_hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Pixels that fire far more often than all of their eight neighbours.

    `counts` (rows, columns) are their events. A pixel is hot if it has four times the events of its
    strongest neighbour, and more than chance gives to one of all pixels in a thousand recordings.
    """
    mu = np.maximum(busiest_neighbour(counts), 1.0)
    return (counts > 4 * mu) & (evidence(counts, mu, 1) > np.log(counts.size) + 7)


def find_hot_lines(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Columns and rows of which nearly all pixels fire far more often than those beside them.

    Read-out makes them, no object: it is seen whole. `counts` (rows, columns); one or two side by
    side are hot if three quarters of their pixels have four times the median count of the nearer
    and the next line on either side, and more than 4 events.
    """
    hot = np.zeros(counts.shape, bool)
    for lines, marked in ((counts, hot), (counts.T, hot.T)):
        if lines.shape[1] < 5 or not ((lines > 4).mean(0) > 0.75).any():
            continue
        least, usual = np.quantile(lines, 0.25, axis=0), np.median(lines, axis=0)
        beside = np.pad(usual, 2, mode="reflect")
        left, right = np.minimum(beside[:-4], beside[1:-3]), np.minimum(beside[3:-1], beside[4:])
        marked[:, least > 4 * np.maximum(np.maximum(left, right), 1)] = True
    return hot


def measure_background(stream: Stream) -> Background:
    """The background of a stream; hot pixels are marked in the stream."""
    counts, whole = np.zeros((1, stream.height, stream.width), np.int32), np.array([0])
    stream.add_cells(np.array([[0, stream.duration]]), UNMOVED[None], 1, counts, whole)
    stream.hot = find_hot_pixels(counts[0]) | find_hot_lines(counts[0])
    fine = -(-stream.height // CELL) * CELL // FINE, -(-stream.width // CELL) * CELL // FINE
    cells = np.zeros((SLICES, *fine), np.int32)
    edges = np.linspace(0, stream.duration, SLICES + 1)
    spans, places, into = in_steps(np.stack([edges[:-1], edges[1:]], 1), None, (0, 0))
    stream.add_cells(spans, places, FINE, cells, into)
    return _of_counts(cells, stream.duration)


def _of_counts(cells: NDArray[np.int32], duration: float) -> Background:
    """Of the counts of all fine cells in all slices."""
    rows, columns = (n * FINE // CELL for n in cells.shape[1:])
    N = pooled(cells, CELL // FINE).astype(float)
    quarter, m = _quiet(N)
    m = np.maximum(m, max(float(np.median(m)), 0.02))
    least = np.median(m) / CELL**2
    ratio = N / m
    low = ratio <= np.quantile(ratio, 0.7, axis=(1, 2), keepdims=True)
    counted, expected = (N * low).sum((1, 2)), (m * low).sum((1, 2))
    activity = np.ones(SLICES)
    usual = float(np.median(counted / expected))
    if usual > 0 and counted.mean() >= FEWEST:
        activity = np.maximum(1, counted / expected / usual)
    calm = N <= np.maximum(np.median(N, 0), 1)
    middle = np.median(N, 0)
    steady = (np.quantile(N, 0.05, axis=0) >= STEADY * middle) & (middle >= PLENTY)
    full = bright = steady & (m > BRIGHT * np.median(m))
    density, g = m / CELL**2, CELL
    while g > FINE:
        g //= 2
        full = np.kron(full & (quarter >= PLENTY), np.ones((2, 2), bool))
        density, quarter = density.repeat(2, 0).repeat(2, 1), np.zeros(full.shape)
        if full.any():
            quarter, m = _quiet(pooled(cells, g // FINE).astype(float))
            density = np.where(full, np.maximum(m / g**2, least), density)
    level = np.median(N / np.maximum(np.quantile(N, USUAL, axis=0), 1), axis=(1, 2))
    rate = density / (duration / SLICES)
    return Background(rate, calm, bright, activity, duration, level=level)


def pooled(cells: NDArray, by: int) -> NDArray:
    """Sums of by x by cells."""
    slices, rows, columns = cells.shape
    return cells.reshape(slices, rows // by, by, columns // by, by).sum((2, 4))


def _quiet(N: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """The lower quartile of counts over slices, and the mean of a Poisson number that has it.

    Of small numbers the mean is told by the share of zeros.
    """
    quarter, empty = np.quantile(N, 0.25, axis=0), (N == 0).mean(0)
    few = np.minimum(-np.log(np.clip(empty, 0.5 / SLICES, 1)), 5.0)
    return quarter, np.where(quarter >= 3, quarter + 0.674 * np.sqrt(quarter + 0.5), few)


def measure_dispersions(
    stream: Stream, background: Background, windows: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Variance over mean of the background's counts in windows (s) in cells of 16 px; at least 1.

    Of each length of windows: the median over the sensor's cells, so that targets in a minority of
    them do not change it. Where the background is bright it is that of the cell, so large that its
    fullest window is no surprise.
    """
    middles = [_middles(int(min(MOST_WINDOWS, stream.duration / w)), stream) for w in windows]
    spans = [np.stack([t - w / 2, t + w / 2], 1) for t, w in zip(middles, windows, strict=True)]
    spans = np.concatenate(spans)
    N = np.zeros((len(spans), *background.calm.shape[1:]), np.int32)
    if background.scene is None:
        stream.count_spans(spans, CELL, N)
    else:
        spans, places, into = in_steps(spans, background.scene, background.corner)
        stream.add_cells(spans, places, CELL, N, into)
    out, first = [], 0
    for t in middles:
        out.append(_dispersion(N[first : first + len(t)], background, background.slice(t)))
        first += len(t)
    return out


def _middles(number: int, stream: Stream) -> NDArray[np.float64]:
    """Of some windows, s; at no fixed steps, for flicker has a period."""
    return (np.arange(number) + np.arange(number) * GOLDEN % 1) / number * stream.duration


def _dispersion(
    N: NDArray[np.int32], background: Background, slices: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Of counts (windows, rows, columns) of windows in some slices."""
    calm, activity = background.calm[slices], background.activity[slices]
    sums = np.zeros((6, *N.shape[1:]))
    _moments(N, calm, activity, background.bright, sums)
    _, squares, expected, fullest, seen, _ = sums
    full = expected >= FULL
    own = np.where(full, squares / np.maximum(expected, FULL), 1.0)
    usual = max(1.0, float(np.median(own[full]))) if full.mean() >= 0.5 else 1.0
    # Of many windows chance alone makes the fullest one as unlikely as there are windows.
    own = np.maximum(own, fullest / np.log(np.maximum(seen, 10)))
    return np.where(background.bright & full, np.maximum(own, usual), usual)


@njit_noalloc
def _moments(N: Any, calm: Any, activity: Any, bright: Any, sums: Any) -> None:
    """Of calm counts (windows, rows, columns) of each cell: mean, squares about it, expected sum.

    And the nats of the fullest window, where it is bright, how many windows are calm, and the sum
    of their activities: `sums`, which are 0 before.
    """
    windows, rows, columns = N.shape
    mean, squares, expected, fullest, seen, usual = (
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5],
    )  # fmt: skip
    for k in range(windows):
        for i in range(rows):
            for j in range(columns):
                if calm[k, i, j]:
                    mean[i, j] += N[k, i, j]
                    usual[i, j] += activity[k]
                    seen[i, j] += 1
    for i in range(rows):
        for j in range(columns):
            mean[i, j] /= max(usual[i, j], 1.0)
    for k in range(windows):
        for i in range(rows):
            for j in range(columns):
                if calm[k, i, j]:
                    mu = mean[i, j] * activity[k]
                    squares[i, j] += (N[k, i, j] - mu) ** 2
                    expected[i, j] += mu
                    if bright[i, j] and N[k, i, j] > mu:
                        fullest[i, j] = max(fullest[i, j], nats(N[k, i, j], mu))
