"""Clutter: hot pixels, and the rate of events that no target made, in place and time.

The rate of a cell of the sensor comes from the quieter quarter of the recording's slices: targets
only add events, and one that comes back (swings, circles) fills many slices. One factor per slice
is the activity of the whole sensor. Where the background is steady and bright, as flickering lamps
are, cells are smaller, and the dispersion of the counts is measured for each.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.stream import CountedSpans, Stream, cell_at
from jaxevent.codegen import njit_noalloc_inlined
from jaxevent.events.filters import max_neighbour_count

N_TIME_SLICES = 64  # equal parts of the recording's time
CELL_PX, FINE_CELL_PX = 16, 4  # px, sides of cells; fine ones where the background is bright
GOLDEN_RATIO_CONJUGATE = 0.5 * (5**0.5 - 1)
# Points that show motion.
REFERENCE_POINTS_PX = np.array([[60.0, 60], [180, 60], [60, 180], [180, 180]])


@dataclasses.dataclass(frozen=True)
class SceneMotion:
    """Motion of a scene past the camera.

    Attributes:
        t: (n,) s.
        maps: (n, 2, 3) from px of the sensor at the start to px at those times.
    """

    t: NDArray[np.float64]
    maps: NDArray[np.float64]

    @property
    def travel(self) -> float:
        """Largest distance (px) of the reference points from their places at the start."""
        return float(np.hypot(*(self._reference() - REFERENCE_POINTS_PX[:, None]).T).max())

    @functools.cached_property
    def speed(self) -> float:
        """Median speed (px/s) of the reference points over time."""
        moved = np.diff(self._reference(), axis=1)
        return float(np.median(np.hypot(*moved.T).mean(1) / np.diff(self.t)))

    def _reference(self) -> NDArray[np.float64]:
        """(4, n, 2) px, places of the reference points."""
        return np.stack(move_places(self.maps, *REFERENCE_POINTS_PX.T[..., None]), -1)

    def at(self, t: NDArray | float | int) -> NDArray[np.float64]:
        """Interpolate the maps (..., 2, 3) linearly at times (s)."""
        t = np.asarray(t, float)
        k = np.clip(np.searchsorted(self.t, t) - 1, 0, len(self.t) - 2)
        part = np.asarray((t - self.t[k]) / (self.t[k + 1] - self.t[k]))
        return self.maps[k] + part[..., None, None] * (self.maps[k + 1] - self.maps[k])

    def to_scene(
        self, t: NDArray | float | int, corner: tuple[int, int] = (0, 0)
    ) -> NDArray[np.float64]:
        """Return maps from pixels at some times to the scene.

        Args:
            t: Times, s.
            corner: x and y, px of the scene, from which its places count.

        Returns:
            (..., 2, 3) from pixels to px of the scene.
        """
        A, b = np.split(self.at(t), [2], -1)
        A = np.linalg.inv(A)
        return np.concatenate([A, -A @ b - np.reshape(corner, (2, 1))], -1)


def move_places(maps: NDArray, x: Any, y: Any) -> tuple[Any, Any]:
    """Apply maps (..., 2, 3) to places.

    Args:
        maps: (..., 2, 3) maps from px to px.
        x: x of the places, px, of a shape that broadcasts with the maps'.
        y: y of the places, px, likewise.

    Returns:
        x and y of the moved places, px.
    """
    (a, b, e), (c, d, f) = np.moveaxis(maps, (-2, -1), (0, 1))
    return a * x + b * y + e, c * x + d * y + f


class CellField(NamedTuple):
    """Values of cells of the scene at one moment, for kernels.

    Attributes:
        values: (rows, columns) of cells.
        cell_bits: Binary logarithm of a cell's side in px.
        factor: Factor on all values.
        map: (2, 3) map from pixels to px in the cells.
    """

    values: NDArray[np.float64]
    cell_bits: int
    factor: float | int
    map: NDArray[np.float64]


@njit_noalloc_inlined
def value_at(field: Any, x: Any, y: Any) -> Any:
    """Return the value of a field at a pixel.

    Args:
        field: `CellField`.
        x: Column of the pixel, px.
        y: Row of the pixel, px.

    Returns:
        The value, in the unit of the field.
    """
    return (
        field.values[cell_at(field.map, x, y, field.cell_bits, field.values.shape)] * field.factor
    )


@dataclasses.dataclass(frozen=True)
class Background:
    """Rate of the events that no target made.

    Attributes:
        rate: (rows, columns) 1/(px s), of cells of 4 px.
        calm: (slices, rows, columns) whether a cell of 16 px seems to be without target.
        bright: (rows, columns) whether the background itself flickers in a cell of 16 px.
        activity: (slices,) factors of the rate, at least 1.
        duration: s.
        scene: Motion of the scene, or None; rate, calm and bright are then those of its places.
        corner: x and y (px) of the scene's place where they begin.
        level: (slices,) counts of the median cell, as a share of those in its full slices.
        _means: (rows, columns) mean rates 1/(px s) around cells, by the reach in cells.
    """

    rate: NDArray[np.float64]
    calm: NDArray[np.bool_]
    bright: NDArray[np.bool_]
    activity: NDArray[np.float64]
    duration: float
    scene: SceneMotion | None = None
    corner: tuple[int, int] = (0, 0)
    level: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.ones(N_TIME_SLICES))
    _means: dict[int, NDArray[np.float64]] = dataclasses.field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def slice_at(self, t: NDArray | float | int) -> Any:
        """Return the indices of the slices that hold times (s)."""
        part = np.asarray(t) / self.duration * N_TIME_SLICES
        return np.clip(part, 0, N_TIME_SLICES - 1).astype(np.int64)

    def rate_at(self, x: NDArray | float | int, y: NDArray | float | int, t: Any) -> Any:
        """Return rates at pixels, 1/(px s).

        Args:
            x: Pixels, px.
            y: Pixels, px.
            t: Times, s, one or as many as pixels.
        """
        cells = look_up(self.rate, FINE_CELL_PX, *self.to_scene(x, y, t))
        return cells * self.activity[self.slice_at(t)]

    def rate_field(self, t: float | int, over: int) -> CellField:
        """Return the field of clutter rates at a time.

        Args:
            t: The time, s.
            over: Side of the squares over which rates of a moving scene are averaged, px.

        Returns:
            The field, 1/(px s).
        """
        factor = float(self.activity[self.slice_at(t)])
        return CellField(
            self._mean_rates(over), FINE_CELL_PX.bit_length() - 1, factor, self._map_at(t)
        )

    def field_of(self, values: NDArray[np.float64], t: float | int) -> CellField:
        """Return the field of other values of the scene at a time.

        Args:
            values: (rows, columns) of cells of 16 px.
            t: The time, s.

        Returns:
            The field.
        """
        return CellField(values, CELL_PX.bit_length() - 1, 1.0, self._map_at(t))

    def _mean_rates(self, over: int) -> NDArray[np.float64]:
        """Return rates averaged over squares of so many px, if the scene moves."""
        if self.scene is None:
            return self.rate
        cells = max(1, round(over / FINE_CELL_PX))
        if cells not in self._means:
            mean = ndimage.uniform_filter(self.rate, cells)
            self._means[cells] = np.maximum(mean, self.rate.min())
        return self._means[cells]

    def _map_at(self, t: float | int) -> NDArray[np.float64]:
        """Return the map (2, 3) from pixels at a time (s) to px from `corner`."""
        return np.eye(2, 3) if self.scene is None else self.scene.to_scene(t, self.corner)

    @functools.cached_property
    def min_rate(self) -> float:
        """Rate where the background is darkest, 1/(px s)."""
        return float(self.rate.min())

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Cells of `rate` that are seen while no target is there."""
        fine = CELL_PX // FINE_CELL_PX
        return np.kron(self.calm.any(0), np.ones((fine, fine), bool))

    @property
    def mean_rate(self) -> float:
        """Mean rate of the visible cells, 1/(px s)."""
        visible = self.visible
        return float((self.rate * visible).sum() / visible.sum())

    @property
    def is_dense(self) -> bool:
        """True if most of the sensor has events in a full slice."""
        return float(np.quantile(self.level, CONFIG.nearly_all)) > CONFIG.considerable

    @property
    def max_window(self) -> float:
        """Longest window (s) in which the scene moves no farther than a fine cell."""
        return np.inf if self.scene is None else FINE_CELL_PX / max(self.scene.speed, 1e-9)

    def to_scene(self, x: Any, y: Any, t: Any) -> tuple[Any, Any]:
        """Map pixels to places of the scene.

        Args:
            x: Columns, px.
            y: Rows, px.
            t: Times, s, one or as many as pixels.

        Returns:
            x and y of the places, px from `corner`.
        """
        if self.scene is None:
            return x, y
        return move_places(self.scene.to_scene(t, self.corner), x, y)


def spans_at_rest(
    spans: NDArray[np.float64], scene: SceneMotion | None, corner: tuple[int, int]
) -> CountedSpans:
    """Divide spans so that the scene is at rest in each part, counted in its span.

    Args:
        spans: (n, 2) begin and end of each span, s.
        scene: Motion of the scene; None: the scene is at rest.
        corner: x and y, px of the scene, where images begin.

    Returns:
        The parts, at least one of each span.
    """
    if scene is None:
        return CountedSpans(spans, np.tile(np.eye(2, 3), (len(spans), 1, 1)), np.arange(len(spans)))
    number = 1 + (scene.speed * np.ptp(spans, axis=1) / CONFIG.resolution_px).astype(np.int64)
    times = [np.linspace(*span, n + 1) for span, n in zip(spans, number, strict=True)]
    parts = np.concatenate([np.stack([t[:-1], t[1:]], 1) for t in times])
    maps = scene.to_scene(parts.mean(1), corner)
    return CountedSpans(parts, maps, np.repeat(np.arange(len(spans)), number))


def count_in_slices(
    stream: Stream, shape: tuple[int, int], scene: SceneMotion | None, corner: tuple[int, int]
) -> NDArray[np.int32]:
    """Count the events of each fine cell of a scene in each slice.

    Args:
        stream: The events.
        shape: Rows and columns of fine cells.
        scene: Motion of the scene; None: it is at rest.
        corner: x and y, px of the scene, where the cells begin.

    Returns:
        (slices, rows, columns) counts.
    """
    cells = np.zeros((N_TIME_SLICES, *shape), np.int32)
    edges = np.linspace(0, stream.duration, N_TIME_SLICES + 1)
    spans = spans_at_rest(np.stack([edges[:-1], edges[1:]], 1), scene, corner)
    stream.count_in_cells(spans, FINE_CELL_PX, cells)
    return cells


def look_up(values: NDArray, cell: int, x: NDArray | float | int, y: NDArray | float | int) -> Any:
    """Look up the values of cells at pixels; pixels beyond the cells get those at the edge.

    Args:
        values: (rows, columns) of cells.
        cell: Side of a cell, px.
        x: Columns of the pixels, px.
        y: Rows of the pixels, px, of the same shape.

    Returns:
        Values, of the shape of `x`.
    """
    rows, columns = values.shape
    row = np.clip(np.asarray(y).astype(np.int64) // cell, 0, rows - 1)
    column = np.clip(np.asarray(x).astype(np.int64) // cell, 0, columns - 1)
    return values[row, column]


def clutter_evidence(
    n: NDArray | float | int, mu: NDArray | float | int, dispersion: NDArray | float | int
) -> Any:
    """Compute the evidence against clutter by Chernoff's bound of the Poisson tail.

    Args:
        n: Counted events.
        mu: Expected events of clutter.
        dispersion: Variance over mean of clutter counts.

    Returns:
        Nats; 0 for counts that are no larger than expected.
    """
    n, mu = np.asarray(n, np.float64), np.maximum(np.asarray(mu, np.float64), 1e-300)
    nats = n * np.log(np.maximum(n / mu, 1)) - n + mu
    return np.where(n > mu, nats, 0) / dispersion


@njit_noalloc_inlined
def poisson_nats(n: float | int, mu: float | int) -> float:
    """Compute `clutter_evidence` of a dispersion of 1, for kernels.

    Args:
        n: Counted events.
        mu: Expected events of clutter.

    Returns:
        Nats.
    """
    return n * np.log(n / mu) - n + mu if n > mu else 0.0


def find_hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find pixels that fire far more often than all of their eight neighbours.

    A hot pixel has four times the events of its strongest neighbour, and more than chance gives to
    one pixel of a thousand recordings. `counts` (rows, columns) are events.
    """
    mu = np.maximum(max_neighbour_count(counts), 1.0)
    return (counts > 4 * mu) & (clutter_evidence(counts, mu, 1) > np.log(counts.size) + 7)


def find_hot_lines(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find columns and rows of which nearly all pixels fire far more often than those beside them.

    The read-out of the sensor makes them. One or two lines side by side are hot if three quarters
    of their pixels have over four events, and four times the median count of the nearer and the
    next line on either side. `counts` (rows, columns) are events.
    """
    hot = np.zeros(counts.shape, bool)
    for lines, marked in ((counts, hot), (counts.T, hot.T)):
        if lines.shape[1] < 5 or not ((lines > 4).mean(0) > 0.75).any():
            continue
        low, median = np.quantile(lines, 0.25, axis=0), np.median(lines, axis=0)
        beside = np.pad(median, 2, mode="reflect")
        left, right = np.minimum(beside[:-4], beside[1:-3]), np.minimum(beside[3:-1], beside[4:])
        marked[:, low > 4 * np.maximum(np.maximum(left, right), 1)] = True
    return hot


def measure_background(stream: Stream) -> Background:
    """Measure the background of a stream, and mark the hot pixels in the stream."""
    counts = np.zeros((1, *stream.shape), np.int32)
    whole = spans_at_rest(np.array([[0, stream.duration]]), None, (0, 0))
    stream.count_in_cells(whole, 1, counts)
    stream.hot = find_hot_pixels(counts[0]) | find_hot_lines(counts[0])
    rows, columns = (-(-n // CELL_PX) * CELL_PX // FINE_CELL_PX for n in stream.shape)
    cells = count_in_slices(stream, (rows, columns), None, (0, 0))
    return _background_of_counts(cells, stream.duration)


def _background_of_counts(cells: NDArray[np.int32], duration: float) -> Background:
    """Compute the background from the counts of all fine cells in all slices.

    Args:
        cells: (slices, rows, columns) counts of cells of 4 px.
        duration: Length of all slices, s.

    Returns:
        The background.
    """
    N = pool(cells, CELL_PX // FINE_CELL_PX).astype(float)
    quarter, m = _calm_mean(N)
    m = np.maximum(m, max(float(np.median(m)), 0.02))
    least = np.median(m) / CELL_PX**2
    ratio = N / m
    low = ratio <= np.quantile(ratio, 0.7, axis=(1, 2), keepdims=True)
    counted, expected = (N * low).sum((1, 2)), (m * low).sum((1, 2))
    activity = np.ones(N_TIME_SLICES)
    typical = float(np.median(counted / expected))
    if typical > 0 and counted.mean() >= CONFIG.min_recording_events:
        activity = np.maximum(1, counted / expected / typical)
    middle = np.median(N, 0)
    calm = N <= np.maximum(middle, 1)
    steady = np.quantile(N, 0.05, axis=0) >= CONFIG.majority * middle
    steady &= middle >= CONFIG.min_fine_events
    full = bright = steady & (m > CONFIG.bright_ratio * np.median(m))
    density, cell = m / CELL_PX**2, CELL_PX
    while cell > FINE_CELL_PX:
        cell //= 2
        full = np.kron(full & (quarter >= CONFIG.min_fine_events), np.ones((2, 2), bool))
        density, quarter = density.repeat(2, 0).repeat(2, 1), np.zeros(full.shape)
        if full.any():
            quarter, m = _calm_mean(pool(cells, cell // FINE_CELL_PX).astype(float))
            density = np.where(full, np.maximum(m / cell**2, least), density)
    filled = np.maximum(np.quantile(N, CONFIG.nearly_all, axis=0), 1)
    level = np.median(N / filled, axis=(1, 2))
    rate = density / (duration / N_TIME_SLICES)
    return Background(rate, calm, bright, activity, duration, level=level)


def pool(cells: NDArray, by: int) -> NDArray:
    """Sum counts over square blocks of cells.

    Args:
        cells: (slices, rows, columns) counts.
        by: Side of a block in cells, a divisor of rows and columns.

    Returns:
        (slices, rows / by, columns / by) sums.
    """
    slices, rows, columns = cells.shape
    return cells.reshape(slices, rows // by, by, columns // by, by).sum((2, 4))


def _calm_mean(N: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Return the lower quartile of counts over slices, and the mean of a Poisson number with it.

    For small counts the mean follows from the share of zeros.
    """
    quarter, empty = np.quantile(N, 0.25, axis=0), (N == 0).mean(0)
    few = np.minimum(-np.log(np.clip(empty, 0.5 / N_TIME_SLICES, 1)), 5.0)
    return quarter, np.where(quarter >= 3, quarter + 0.674 * np.sqrt(quarter + 0.5), few)


def measure_dispersions(
    stream: Stream, background: Background, windows: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Measure the dispersion of the background's counts, variance over mean, at least 1.

    It is the median over the cells, so that targets in a minority of them do not change it. Where
    the background is bright it is that of the cell, so large that its fullest window is no
    surprise.

    Args:
        stream: Events.
        background: Their background.
        windows: Lengths of windows, s.

    Returns:
        (rows, columns) dispersions in cells of 16 px, for each length.
    """
    centres = []
    for w in windows:
        # At no fixed steps, as flicker has a period.
        k = np.arange(int(min(CONFIG.max_dispersion_windows, stream.duration / w)))
        centres.append((k + k * GOLDEN_RATIO_CONJUGATE % 1) / len(k) * stream.duration)
    spans = [np.stack([t - w / 2, t + w / 2], 1) for t, w in zip(centres, windows, strict=True)]
    spans = np.concatenate(spans)
    N = np.zeros((len(spans), *background.calm.shape[1:]), np.int32)
    stream.count_in_cells(spans_at_rest(spans, background.scene, background.corner), CELL_PX, N)
    each = np.split(N, np.cumsum([len(t) for t in centres])[:-1])
    return [
        _dispersion(n, background, background.slice_at(t))
        for n, t in zip(each, centres, strict=True)
    ]


def _dispersion(
    N: NDArray[np.int32], background: Background, slices: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Compute the dispersion of the counts of windows in given slices.

    Args:
        N: (windows, rows, columns) counts of cells of 16 px.
        background: The background.
        slices: (windows,) slice of each window.

    Returns:
        (rows, columns) variance over mean, at least 1.
    """
    calm, bright = background.calm[slices], background.bright
    N, active = N * calm, background.activity[slices, None, None] * calm
    mu = N.sum(0) / np.maximum(active.sum(0), 1) * active
    squares, expected, windows = ((N - mu) ** 2).sum(0), mu.sum(0), calm.sum(0)
    fullest = np.zeros(bright.shape)
    fullest[bright] = clutter_evidence(N[:, bright], mu[:, bright], 1).max(0, initial=0)
    full = expected >= CONFIG.min_dispersion_events
    own = np.where(full, squares / np.maximum(expected, CONFIG.min_dispersion_events), 1.0)
    usual = max(1.0, float(np.median(own[full]))) if full.mean() >= 0.5 else 1.0
    # Of many windows chance alone makes the fullest one as unlikely as there are windows.
    own = np.maximum(own, fullest / np.log(np.maximum(windows, 10)))
    return np.where(bright & full, np.maximum(own, usual), usual)
