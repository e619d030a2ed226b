"""Alignment of a window's events by a dense displacement, from coarse to fine.

An event of polarity p at x and at relative time s, -1..1, is moved along the displacement u (px per
unit of s) to x' = x - s u(x - s u(x) / 2). Signed events there make the image I, their number n.
Where u is right the image is sharp (Gallego et al., CVPR 2018). With weights w = 1 / n, as the
variance of a count is its mean, the sum S of w I^2 has about these derivatives:

    dS/du / 2 = -sum p (s - m) w grad I,    H = sum (s - m)^2 w / n (grad I) (grad I)^T        (1)

over events, m the mean time of the events at x'. H is what S loses in curvature when all times show
the same image. Displacements are those of nodes, bilinear between; each step solves

    min_d  sum (d - H^-1 g)^T H (d - H^-1 g) + smoothness sum rho(r_i + d_i - r_j - d_j)        (2)

over neighbours i, j with the robust rho(e) = log(1 + e^2 / edge^2) and r = u - m. The surface

    m(x) = a + A x + (c . x) x                                                                  (3)

is the flow of a camera that turns, and of one before a plane (Longuet-Higgins and Prazdny 1980).
Its eight coefficients are fitted in each step, so such flow is free of smoothness. Objects of their
own motion, and other depths, are outliers of the fit:

    min_m  sum w (u + d - m)^T H (u + d - m),    w = 1 / (1 + |u - m|^2 / edge^2)               (4)

A camera that stops and turns back within a window has a clock that rests and then runs backwards.
Edges that come back make events of the other polarity, so the polarities after the turn are
reversed there, and (1) holds again.

The covariance of a displacement is that of an estimate from the nodes within a Gaussian of reach r,
which have the information I_r together, are n_r in effect, and differ by D_r in the mean square:

    C = min_r  I_r^-1 + beta D_r / n_r                                                          (5)

The first term is the noise of events, the second what smoothness and unequal motion add. A velocity
is uncertain by its clock, too: by the mean square of what smoothing takes from the clock's rates.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events

N_STEPS_PER_CELL_SIZE = 5  # Gauss-Newton steps
CLOCK_PARTS = 4  # pieces of half a window in which the clock of events goes evenly
CLOCK_INFORMATION = 100.0  # of a clock's time before alignment; not sensitive
CLOCK_STEP, CLOCK_REACH = 0.5, 0.2  # part of a step that is made, and the longest one
LONG_REST, MAX_RESTS = 1.5, 4  # usual intervals of a clock, of a rest and of its pieces
MIN_CLOCK_SPEED = 0.5  # of the clock before alignment, or else that is taken
N_SWEEPS = 30  # of Gauss-Seidel
N_SURFACE_FITS = 2  # in each step
# 1/px^2 and node, of the coefficients of (3) before alignment, in halves of the longer side.
SURFACE_INFORMATION = (1e-6, 0.0435, 0.0435, 1e-6, 0.0435, 0.0435, 0.145, 0.145)
N_BLURS = (1, 2, 2)  # of the sum of events, their number and their mean time
NUMBER_FLOOR = 0.1  # events per cell, added to their number
# The curvature of S is that of the image before it is blurred, which is sharper.
CURVATURE = 3.0
OWN_NUMBER = 0.12  # part of an event in the blurred number of events where it is
NOISE = 0.055  # variance of the gradient of an image of events without order, per event
# The covariance of a displacement, set by experiments/event_flow.py on simulated scenes.
POOLING = (1, 2, 4)  # nodes, the reaches r of (5)
SCATTER = 9.0  # beta of (5)
UNKNOWN_VARIANCE = 6.0  # px^2, without events
FIRST_INFORMATION = 1.0  # 1/px^2, at which half of a component is kept for the next window
MAX_VARIANCE = 1.0  # px^2, along any direction, of what counts as known


@njit_noalloc_inlined
def _node_cell(u, spacing, x, y):
    """Find the node before a place and the distance from it.

    Args:
        u: (rows, columns, ...) values of nodes.
        spacing: Distance of nodes, px.
        x: Place along x, px; beyond the outer nodes it is moved to them.
        y: Place along y, likewise.

    Returns:
        Column and row of the node, and distances along x and y, in nodes.
    """
    rows, columns = u.shape[0], u.shape[1]
    a = min(max(x / spacing - 0.5, 0.0), columns - 1.0)
    b = min(max(y / spacing - 0.5, 0.0), rows - 1.0)
    i, j = min(int(a), max(columns - 2, 0)), min(int(b), max(rows - 2, 0))
    return i, j, a - i, b - j


@njit_noalloc_inlined
def _displacement_at(u, spacing, x, y):
    """Return the displacement at a place, bilinear between nodes at (k + 1/2) spacing.

    Args:
        u: (rows, columns, 2) displacement of nodes, px.
        spacing: Distance of nodes, px.
        x: Place along x, px.
        y: Place along y, px.

    Returns:
        The displacement along x and along y, px.
    """
    i, j, fx, fy = _node_cell(u, spacing, x, y)
    i2, j2 = min(i + 1, u.shape[1] - 1), min(j + 1, u.shape[0] - 1)
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        a * u[j, i, 0] + b * u[j, i2, 0] + c * u[j2, i, 0] + d * u[j2, i2, 0],
        a * u[j, i, 1] + b * u[j, i2, 1] + c * u[j2, i, 1] + d * u[j2, i2, 1],
    )


@njit_noalloc
def _warp_and_vote(x, y, s, p, u, spacing, cell, warped, image):
    """Move events along the displacement and add each to sum, number and times of cells.

    Args:
        x: (n,) positions along x, px.
        y: (n,) positions along y, px.
        s: (n,) relative times.
        p: (n,) polarities, as of `WindowEvents`.
        u: (rows, columns, 2) displacement of nodes, px per unit of s.
        spacing: Distance of nodes, px.
        cell: Size of cells, px.
        warped: (n, 2) output, x and y in cells; x is -1 outside the image.
        image: (3, rows, columns) output with a border of a cell: sums of p, of 1 and of s.
    """
    rows, columns = image.shape[1], image.shape[2]
    image[:] = 0
    for k in range(len(x)):
        dx, dy = _displacement_at(u, spacing, x[k], y[k])
        for _ in range(2):
            dx, dy = _displacement_at(u, spacing, x[k] - s[k] * dx, y[k] - s[k] * dy)
        a, b = (x[k] - s[k] * dx + 0.5) / cell + 0.5, (y[k] - s[k] * dy + 0.5) / cell + 0.5
        warped[k, 0], warped[k, 1] = a, b
        if not (0 <= a < columns - 1 and 0 <= b < rows - 1):
            warped[k, 0] = -1
            continue
        i, j = int(a), int(b)
        fx, fy = a - i, b - j
        for dj in range(2):
            for di in range(2):
                weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                image[0, j + dj, i + di] += weight * p[k]
                image[1, j + dj, i + di] += weight
                image[2, j + dj, i + di] += weight * s[k]


@njit_noalloc
def _blur(image, scratch, passes):
    """Convolve an image with (1, 2, 1) / 4 along both axes, in place; edges repeat.

    Args:
        image: (rows, columns), in place.
        scratch: (rows, columns).
        passes: How many times.
    """
    rows, columns = image.shape
    for _ in range(passes):
        for j in range(rows):
            for i in range(columns):
                left, right = image[j, max(i - 1, 0)], image[j, min(i + 1, columns - 1)]
                scratch[j, i] = 0.25 * (left + right) + 0.5 * image[j, i]
        for j in range(rows):
            up, down = max(j - 1, 0), min(j + 1, rows - 1)
            for i in range(columns):
                image[j, i] = 0.25 * (scratch[up, i] + scratch[down, i]) + 0.5 * scratch[j, i]


@njit_noalloc_inlined
def _look_up(image, a, b):
    """Look up images of cells at a place, bilinear.

    Args:
        image: (3, rows, columns) blurred images of `_warp_and_vote`.
        a: Place along x, in cells.
        b: Place along y, in cells.

    Returns:
        Gradient of the sum along x and y, per cell; sum, number, and sum of times.
    """
    i, j = int(a), int(b)
    fx, fy = a - i, b - j
    gx = gy = value = number = late = 0.0
    for dj in range(2):
        for di in range(2):
            weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
            y, x = j + dj, i + di
            gx += weight * 0.5 * (image[0, y, x + 1] - image[0, y, x - 1])
            gy += weight * 0.5 * (image[0, y + 1, x] - image[0, y - 1, x])
            value += weight * image[0, y, x]
            number += weight * image[1, y, x]
            late += weight * image[2, y, x]
    return gx, gy, value, number, late


@njit_noalloc
def _accumulate(warped, s, p, place, u, spacing, cell, image, normal, clock):
    """Add the derivatives (1) of each event to the nodes and clock's times around it.

    Args:
        warped: (n, 2) places in cells.
        s: (n,) relative times.
        p: (n,) polarities.
        place: (n,) place among the clock's times, from 0.
        u: (rows, columns, 2) displacement of nodes, px.
        spacing: Distance of nodes, px.
        cell: Size of cells, px.
        image: (3, ...) blurred images of `_warp_and_vote`.
        normal: (rows, columns, 6) gets g, xx, xy, yy of H, and what noise adds to xx and yy per
            variance of the gradient, px.
        clock: (K, 2) gets derivative and curvature by the clock's s.

    Returns:
        The score.
    """
    normal[:] = 0
    clock[:] = 0
    score = 0.0
    per_px = 1.0 / cell
    for k in range(len(s)):
        a, b = warped[k, 0], warped[k, 1]
        if a < 1 or b < 1 or a >= image.shape[2] - 2 or b >= image.shape[1] - 2:
            continue
        gx, gy, value, number, late = _look_up(image, a, b)
        gx, gy = gx * per_px, gy * per_px
        age = s[k] - late / max(number, 1e-9)
        w = 1.0 / (number + NUMBER_FLOOR)
        score += p[k] * value * w
        x, y = (a - 0.5) * cell - 0.5, (b - 0.5) * cell - 0.5
        ux, uy = _displacement_at(u, spacing, x, y)
        along = gx * ux + gy * uy
        i = min(int(place[k]), len(clock) - 2)
        f = place[k] - i
        for d in range(2):
            weight = f if d else 1 - f
            clock[i + d, 0] -= weight * p[k] * w * along
            clock[i + d, 1] += weight * CURVATURE * w / (number + NUMBER_FLOOR) * along * along
        c = -p[k] * age * w
        h = CURVATURE * age * age * w / (number + NUMBER_FLOOR)
        others = max(number - OWN_NUMBER, 0.0)
        i, j, fx, fy = _node_cell(u, spacing, x, y)
        for dj in range(2):
            for di in range(2):
                weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                a, b = min(j + dj, u.shape[0] - 1), min(i + di, u.shape[1] - 1)
                normal[a, b, 0] += weight * c * gx
                normal[a, b, 1] += weight * c * gy
                normal[a, b, 2] += weight * h * gx * gx
                normal[a, b, 3] += weight * h * gx * gy
                normal[a, b, 4] += weight * h * gy * gy
                normal[a, b, 5] += weight * h * others * per_px * per_px
    return score


@njit_noalloc
def _solve_step(u, surface, normal, smoothness, edge, step):
    """Solve (2) for the step of the displacement, by Gauss-Seidel.

    Args:
        u: (rows, columns, 2) displacement of nodes, px.
        surface: (rows, columns, 2) surface (3), px.
        normal: (rows, columns, 6), of `_accumulate`.
        smoothness: Weight of the second sum.
        edge: Difference from which neighbours count less, px.
        step: (rows, columns, 2) output, px.
    """
    rows, columns = u.shape[0], u.shape[1]
    step[:] = 0
    for _ in range(N_SWEEPS):
        for j in range(rows):
            for i in range(columns):
                gx, gy = normal[j, i, 0], normal[j, i, 1]
                xx, xy, yy = normal[j, i, 2], normal[j, i, 3], normal[j, i, 4]
                for n in range(4):
                    b, a = i + (n == 0) - (n == 1), j + (n == 2) - (n == 3)
                    if 0 <= a < rows and 0 <= b < columns:
                        ex = u[a, b, 0] - surface[a, b, 0] - u[j, i, 0] + surface[j, i, 0]
                        ey = u[a, b, 1] - surface[a, b, 1] - u[j, i, 1] + surface[j, i, 1]
                        w = smoothness / (1 + (ex * ex + ey * ey) / (edge * edge))
                        gx += w * (ex + step[a, b, 0])
                        gy += w * (ey + step[a, b, 1])
                        xx += w
                        yy += w
                det = xx * yy - xy * xy
                if det > 1e-12:
                    step[j, i, 0] = (yy * gx - xy * gy) / det
                    step[j, i, 1] = (xx * gy - xy * gx) / det


def _image_shape(shape: tuple[int, int], cell: float) -> tuple[int, int]:
    """Return rows and columns of an image of cells, with a border of one.

    Args:
        shape: Height and width of the sensor, px.
        cell: Size of cells, px.

    Returns:
        Rows and columns.
    """
    return int(np.ceil(shape[0] / cell)) + 2, int(np.ceil(shape[1] / cell)) + 2


def _node_shape(shape: tuple[int, int], spacing: float) -> tuple[int, int]:
    """Return rows and columns of the nodes of a sensor.

    Args:
        shape: Height and width of the sensor, px.
        spacing: Distance of nodes, px.

    Returns:
        Rows and columns, at least 1 each.
    """
    return max(int(np.ceil(shape[0] / spacing)), 1), max(int(np.ceil(shape[1] / spacing)), 1)


def _fill_pixels(u: NDArray, shape: tuple[int, int], spacing: float) -> NDArray[np.float32]:
    """Interpolate values of nodes bilinearly to all pixels.

    Args:
        u: (rows, columns, ...) values of nodes.
        shape: Height and width of the sensor, px.
        spacing: Distance of nodes, px.

    Returns:
        (H, W, ...).
    """
    for axis in (0, 1):
        a = np.clip((np.arange(shape[axis])) / spacing - 0.5, 0, u.shape[axis] - 1)
        i = np.minimum(a.astype(int), max(u.shape[axis] - 2, 0))
        f = (a - i).reshape([-1 if k == axis else 1 for k in range(u.ndim)])
        after = np.minimum(i + 1, u.shape[axis] - 1)
        u = (1 - f) * u.take(i, axis) + f * u.take(after, axis)
    return u.astype(np.float32)


def _quadratic_basis(x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Return the eight fields of (3) at some places.

    Args:
        x: (n,) places along x.
        y: (n,) places along y.

    Returns:
        (2, 8, n), along x and y.
    """
    one, zero = np.ones_like(x), np.zeros_like(x)
    along_x = [one, x, y, zero, zero, zero, x * x, x * y]
    return np.array([along_x, [zero, zero, zero, one, x, y, x * y, y * y]])


def _binomial_means(values: NDArray) -> NDArray[np.float64]:
    """Return binomial means over five values, four fewer than there are."""
    return np.convolve(values, [1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16], "valid")


class Clock(NamedTuple):
    """Relative times s of a window, linear between some times."""

    t: NDArray[np.float64]  # (K,) us, rising
    s: NDArray[np.float64]  # (K,)

    @classmethod
    def of(cls, events: Events, at: int, half: int) -> "Clock":
        """Make the clock of a window that goes as fast as time and, in equal parts, events do.

        Events come as fast as a scene moves.

        Args:
            events: The events, one or more.
            at: Time at which s = 0, us.
            half: Number of events around it on either side.

        Returns:
            The clock.
        """
        parts = max(round(CLOCK_PARTS * len(events) / half), 1)
        rows = np.linspace(0, len(events) - 1, parts + 1).astype(int)
        t, first = np.unique(events.t[rows], return_index=True)
        if len(t) < 2:
            return cls(at + np.array([-1.0, 1.0]), np.array([-1.0, 1.0]))
        s = rows[first] / half
        s = (s + (t - t[0]) * (s[-1] / (t[-1] - t[0]))) / 2
        return cls(t.astype(float), s - np.interp(at, t, s))

    @property
    def mean_rate(self) -> float:
        """Mean of the absolute rate of s over the window, 1/s."""
        return float(np.abs(np.diff(self.s)).sum() / (self.t[-1] - self.t[0])) * 1e6

    @property
    def rises(self) -> bool:
        """True if s rises throughout."""
        return bool((np.diff(self.s) > 0).all())

    def turned(self, at: int) -> "Iterator[tuple[Clock, float]]":
        """Make clocks that rest where events are few, and run backwards from then on.

        Args:
            at: Time at which s = 0, us.

        Yields:
            A clock for each interval that is longer than its neighbours, and its middle, us.
        """
        length, steps = np.diff(self.t), np.diff(self.s)
        usual, around = np.median(length), np.pad(length, 1)
        few = (length > np.maximum(around[:-2], around[2:])) & (length > LONG_REST * usual)
        for k in np.flatnonzero(few).tolist():
            n = min(math.ceil(length[k] / usual), MAX_RESTS)
            t = np.insert(self.t, k + 1, np.linspace(self.t[k], self.t[k + 1], n + 1)[1:-1])
            s = np.cumsum(np.concatenate([[0.0], steps[:k], np.zeros(n), -steps[k + 1 :]]))
            yield Clock(t, s - np.interp(at, t, s)), (self.t[k] + self.t[k + 1]) / 2

    def rates(self) -> NDArray[np.float64]:
        """Return how fast s goes at the times of the clock.

        Returns:
            (2, K) the rate, 1/s, and its variance, 1/s^2.
        """
        order = 1 if len(self.t) < 3 else 2
        rates = 1e6 * np.gradient(self.s, self.t, edge_order=order)
        # Rates at both ends continue those inside, so that a camera which brakes brakes to the end.
        smooth = _binomial_means(np.pad(rates, 2, mode="reflect", reflect_type="odd"))
        return np.stack([smooth, _binomial_means(np.pad((rates - smooth) ** 2, 2, mode="edge"))])


class WindowEvents(NamedTuple):
    """Events of a window.

    Attributes:
        x: (n,) columns, px.
        y: (n,) rows, px.
        t: (n,) times, us.
        p: (n,) polarities, of mean 0 and variance 1.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    t: NDArray[np.int64]
    p: NDArray[np.float32]

    @classmethod
    def of(cls, events: Events) -> "WindowEvents":
        """Make them of events."""
        # What goes up comes down: the mean is 0. A polarity that is always the same tells nothing.
        p = np.where(events.p, 1.0, -1.0)
        p = (p - p.mean()) / max(float(p.std()), 1e-3)
        x, y, p = (np.asarray(c, np.float32) for c in (events.x, events.y, p))
        return cls(x, y, events.t, p)

    def reversed_after(self, t: float) -> "WindowEvents":
        """Return the events with polarities reversed after a time.

        Args:
            t: The time, us.

        Returns:
            The events.
        """
        return self._replace(p=np.where(self.t > t, -self.p, self.p))


class Displacement(NamedTuple):
    """Displacement of nodes, with its information and covariance."""

    u: NDArray[np.float64]  # (rows, columns, 2), px per unit of s
    clock: Clock
    information: NDArray[np.float64]  # (rows, columns, 3), xx, xy and yy, 1/px^2
    covariance: NDArray[np.float64]  # (rows, columns, 2, 2), px^2
    score: float  # per event


def _principal(information: NDArray, reach: int) -> tuple[NDArray, NDArray]:
    """Return eigenvalues and axes of the information of nodes within a Gaussian.

    Args:
        information: (rows, columns, 3), xx, xy and yy, 1/px^2.
        reach: Standard deviation of the Gaussian, in nodes.

    Returns:
        Eigenvalues (rows, columns, 2), 1/px^2, rising, and axes as columns (rows, columns, 2, 2).
    """
    pooled = gaussian_filter(information, (reach, reach, 0), mode="constant")
    return np.linalg.eigh(4 * np.pi * reach**2 * pooled[..., [[0, 1], [1, 2]]])


def _compose_matrices(axes: NDArray, values: NDArray) -> NDArray:
    """Return matrices of these axes and eigenvalues.

    Args:
        axes: (..., 2, 2) axes as columns.
        values: (..., 2) eigenvalues.

    Returns:
        (..., 2, 2).
    """
    return (axes * values[..., None, :]) @ np.swapaxes(axes, -1, -2)


def _mean_square_difference(u: NDArray, reach: int) -> NDArray[np.float64]:
    """Return the mean square of differences from nodes around, `reach` and twice as far.

    Args:
        u: (rows, columns, 2) displacement, px.
        reach: Distance of these nodes, in nodes.

    Returns:
        (rows, columns), px^2.
    """
    far, (rows, columns) = 2 * reach, u.shape[:2]
    near, total = np.pad(u, ((far, far), (far, far), (0, 0)), mode="edge"), np.zeros(u.shape[:2])
    for distance in (reach, far):
        for j, i in ((0, 1), (1, 0), (1, 1), (1, -1)):
            for c in (distance, -distance):
                other = near[far + c * j :, far + c * i :][:rows, :columns]
                total += ((other - u) ** 2).sum(-1)
    return total / 16


class Alignment:
    """Displacements of windows of events: `align(events, start, cells)`.

    Args:
        shape: Height and width of the sensor.
        params: `FlowParams`.
    """

    def __init__(self, shape: tuple[int, int], params: Any):
        self.shape, self.spacing = shape, float(params.spacing)
        self.nodes = _node_shape(shape, self.spacing)
        self.smoothness, self.edge = float(params.smoothness), float(params.edge)
        y, x = np.mgrid[: self.nodes[0], : self.nodes[1]].reshape(2, -1) * 2 / max(self.nodes)
        self._basis = _quadratic_basis(x - x.mean(), y - y.mean())

    def fill(self, values: NDArray) -> NDArray[np.float32]:
        """Interpolate values of nodes to all pixels."""
        return _fill_pixels(values, self.shape, self.spacing)

    def _covariance(self, u: NDArray, information: NDArray) -> NDArray[np.float64]:
        """Return the covariance (5) of the nodes' displacement, the least over reaches.

        Args:
            u: Displacement less the surface (3), px.
            information: (rows, columns, 3), 1/px^2.

        Returns:
            (rows, columns, 2, 2), px^2.
        """
        best = np.full((*self.nodes, 2, 2), np.inf)
        trace = np.maximum(information[..., 0] + information[..., 2], 0) + 1e-9
        for reach in POOLING:
            values, axes = _principal(information, reach)
            C = _compose_matrices(axes, 1 / (np.maximum(values, 0) + 1 / UNKNOWN_VARIANCE))
            pooled, squares = (
                gaussian_filter(one, reach, mode="constant") for one in (trace, trace**2)
            )
            n = 4 * np.pi * reach**2 * pooled**2 / squares
            C = C + (SCATTER / n * _mean_square_difference(u, reach))[..., None, None] * np.eye(2)
            less = np.trace(C, axis1=-2, axis2=-1) < np.trace(best, axis1=-2, axis2=-1)
            best = np.where(less[..., None, None], C, best)
        return best

    def shrink(self, aligned: Displacement) -> NDArray[np.float64]:
        """Return the displacement without components that events around do not determine.

        They would double with each window.

        Args:
            aligned: Displacement and information.

        Returns:
            (rows, columns, 2), px.
        """
        values, axes = _principal(aligned.information, POOLING[-1])
        values = np.maximum(values, 0)
        known = _compose_matrices(axes, values / (values + FIRST_INFORMATION))
        return (known @ aligned.u[..., None])[..., 0]

    def typical(self, aligned: Displacement) -> float:
        """Return the median length of known displacements, weighted by information, px.

        Args:
            aligned: Displacement and information.
        """
        known = self.shrink(aligned)
        length = np.hypot(known[..., 0], known[..., 1]).ravel()
        weight = np.maximum(aligned.information[..., 0] + aligned.information[..., 2], 0)
        order = np.argsort(length, kind="stable")
        total = np.cumsum(weight.ravel()[order])
        return float(length[order[np.searchsorted(total, total[-1] / 2)]])

    def _fit_surface(self, u: NDArray, before: NDArray, normal: NDArray) -> NDArray[np.float64]:
        """Fit (3) to displacements and their steps; outliers from the surface before count less.

        Args:
            u: (rows, columns, 2) displacement, px.
            before: (rows, columns, 2) surface before, px.
            normal: (rows, columns, 6), of `_accumulate`.

        Returns:
            (rows, columns, 2) surface, px.
        """
        B0, B1 = self._basis
        gx, gy, xx, xy, yy = normal.reshape(-1, normal.shape[-1]).T[:5]
        ux, uy = u.reshape(-1, 2).T
        HB0, HB1 = xx * B0 + xy * B1, xy * B0 + yy * B1
        surface, prior = before, np.diag(SURFACE_INFORMATION) * len(ux)
        for _ in range(N_SURFACE_FITS):
            w = 1 / (1 + ((u - surface) ** 2).sum(-1).ravel() / self.edge**2)
            A = (w * B0) @ HB0.T + (w * B1) @ HB1.T + prior
            b = B0 @ (w * (xx * ux + xy * uy + gx)) + B1 @ (w * (xy * ux + yy * uy + gy))
            c = np.linalg.solve(A, b)
            surface = np.stack([c @ B0, c @ B1], -1).reshape(u.shape)
        return surface

    def _update_clock(
        self, clock: Clock, at: int, s: NDArray, turns: NDArray
    ) -> NDArray[np.float64]:
        """Move the times of a clock by a step of (1), on the whole as fast as before alignment.

        Args:
            clock: The K times of the clock, and its s before alignment.
            at: Time at which s = 0, us.
            s: (K,) present s.
            turns: (K, 2) derivative and curvature by s, of `_accumulate`.

        Returns:
            (K,) new s.
        """
        step = (turns[:, 0] + CLOCK_INFORMATION * (clock.s - s)) / (turns[:, 1] + CLOCK_INFORMATION)
        s = s + CLOCK_STEP * np.clip(step, -CLOCK_REACH, CLOCK_REACH)
        s = s - np.interp(at, clock.t, s)
        speed = (s @ clock.s) / max(clock.s @ clock.s, 1e-9)
        return s / speed if speed > MIN_CLOCK_SPEED else clock.s

    def score(self, events: WindowEvents, clock: Clock, u: NDArray, cell: int) -> float:
        """Return the score of a displacement.

        Args:
            events: The events.
            clock: Their clock.
            u: (rows, columns, 2) displacement of nodes, px.
            cell: Size of cells, px.

        Returns:
            The score per event.
        """
        x, y, t, p = events
        s = np.interp(t, clock.t, clock.s).astype(np.float32)
        warped = np.empty((len(x), 2), np.float32)
        image = np.zeros((3, *_image_shape(self.shape, cell)), np.float32)
        _warp_and_vote(x, y, s, p, u, self.spacing, cell, warped, image)
        blurred = image.copy()
        for channel, passes in zip(blurred, N_BLURS, strict=True):
            _blur(channel, np.empty_like(channel), passes)
        total = (image[0] * blurred[0] / (blurred[1] + NUMBER_FLOOR)).sum()
        return float(total) / max(len(x), 1)

    def __call__(
        self,
        events: WindowEvents,
        clock: Clock,
        at: int,
        start: NDArray | None,
        cells: tuple[int, ...],
        adapt: bool,
    ) -> Displacement:
        """Align the events of a window.

        Args:
            events: The events.
            clock: Clock to start from.
            at: Time at which points are displaced by 0, us.
            start: Displacement (rows, columns, 2) to start from, px; None: no displacement.
            cells: Sizes of the cells, px, one after the other.
            adapt: Whether the clock is estimated, too.

        Returns:
            The displacement.
        """
        u = np.zeros((*self.nodes, 2)) if start is None else start.copy()
        normal, step = np.zeros((*self.nodes, 6)), np.zeros_like(u)
        x, y, t, p = events
        warped = np.empty((len(x), 2), np.float32)
        place = np.interp(t, clock.t, np.arange(len(clock.t))).astype(np.float32)
        turns, ahead = np.zeros((len(clock.t), 2)), clock.s.copy()
        surface, score = u, 0.0
        for cell in cells:
            image = np.zeros((3, *_image_shape(self.shape, cell)), np.float32)
            scratch = np.empty_like(image[0])
            reach, before = np.full((*self.nodes, 1), float(cell)), np.zeros_like(u)
            for _ in range(N_STEPS_PER_CELL_SIZE):
                s = np.interp(place, np.arange(len(ahead)), ahead).astype(np.float32)
                _warp_and_vote(x, y, s, p, u, self.spacing, cell, warped, image)
                for channel, passes in zip(image, N_BLURS, strict=True):
                    _blur(channel, scratch, passes)
                score = _accumulate(
                    warped, s, p, place, u, self.spacing, cell, image, normal, turns
                )
                surface = self._fit_surface(u, surface, normal)
                _solve_step(u, surface, normal, self.smoothness, self.edge, step)
                # Sharp images have a smaller range than their curvature tells: steps that turn
                # back are halved.
                reach *= np.where((step * before).sum(-1, keepdims=True) < 0, 0.5, 1)
                length = np.hypot(step[..., :1], step[..., 1:])
                before = step * np.minimum(1, reach / np.maximum(length, 1e-9))
                u += before
                if adapt:
                    ahead = self._update_clock(clock, at, ahead, turns)
        information = normal[..., 2:5] - NOISE * normal[..., 5:] * [1, 0, 1]
        return Displacement(
            u,
            Clock(clock.t, ahead),
            information,
            self._covariance(u - surface, information),
            score / max(len(x), 1),
        )
