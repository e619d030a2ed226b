"""Alignment of a window's events by a dense displacement, from coarse to fine.

An event of polarity p at x and at relative time s, -1..1, is moved along the displacement u (px per
unit of s) to x' = x - s u(x - s u(x) / 2). Signed events there make the image I, their number n.
Where u is right the image is sharp (Gallego et al., CVPR 2018). With weights w = 1 / n, as the
variance of a count is its mean, the sum S of w I^2 has about these derivatives:

    dS/du / 2 = -sum p (s - m) w grad I,    H = sum (s - m)^2 w / n (grad I) (grad I)^T        (1)

over events, m the mean time of the events at x'. H is what S loses in curvature when all times show
the same image. Displacements are those of nodes, bilinear between; each step solves

    min_d  sum (d - H^-1 g)^T H (d - H^-1 g) + smoothness sum rho(u_i + d_i - u_j - d_j)        (2)

over neighbours i, j with the robust rho(e) = log(1 + e^2 / edge^2).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.recording import Events

N_STEPS = 5  # Gauss-Newton steps at each size of cells
CLOCK_PARTS = 4  # pieces of half a window in which the clock of events goes evenly
N_SWEEPS = 30  # of Gauss-Seidel
N_BLURS = (1, 2, 2)  # of the sum of events, their number and their mean time
NUMBER_FLOOR = 0.1  # events per cell, added to their number
# The curvature of S is that of the image before it is blurred, which is sharper.
CURVATURE = 3.0
OWN_NUMBER = 0.12  # part of an event in the blurred number of events where it is
NOISE = 0.055  # variance of the gradient of an image of events without order, per event
# The covariance of a displacement, set by experiments/event_flow.py on simulated scenes.
POOLING = 1.5  # nodes, of the Gaussian whose nodes tell of one
MIN_INFORMATION = 0.1  # 1/px^2
MIN_VARIANCE = 0.001  # px^2
MAX_VARIANCE = 1.0  # px^2, along any direction, of what counts as known
RELATIVE_VARIANCE = 0.0002  # of the square of the displacement


@njit_noalloc_inlined
def node_cell(u, spacing, x, y):
    """Return the node before a place and the distance from it, in nodes."""
    rows, columns = u.shape[0], u.shape[1]
    a = min(max(x / spacing - 0.5, 0.0), columns - 1.0)
    b = min(max(y / spacing - 0.5, 0.0), rows - 1.0)
    i, j = min(int(a), max(columns - 2, 0)), min(int(b), max(rows - 2, 0))
    return i, j, a - i, b - j


@njit_noalloc_inlined
def displacement_at(u, spacing, x, y):
    """Return the displacement at a place, bilinear between nodes at (k + 1/2) spacing."""
    i, j, fx, fy = node_cell(u, spacing, x, y)
    i2, j2 = min(i + 1, u.shape[1] - 1), min(j + 1, u.shape[0] - 1)
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        a * u[j, i, 0] + b * u[j, i2, 0] + c * u[j2, i, 0] + d * u[j2, i2, 0],
        a * u[j, i, 1] + b * u[j, i2, 1] + c * u[j2, i, 1] + d * u[j2, i2, 1],
    )


@njit_noalloc
def warp_and_vote(x, y, s, p, u, spacing, cell, warped, image):
    """Move events along the displacement and add each to sum, number and mean time of cells.

    `image` (3, rows, columns) has a border of one cell; `warped` (n, 2) gets the places in cells.
    """
    rows, columns = image.shape[1], image.shape[2]
    image[:] = 0
    for k in range(len(x)):
        dx, dy = displacement_at(u, spacing, x[k], y[k])
        for _ in range(2):
            dx, dy = displacement_at(u, spacing, x[k] - s[k] * dx, y[k] - s[k] * dy)
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
def blur(image, scratch, passes):
    """Convolve an image with (1, 2, 1) / 4 along both axes, some times; edges repeat."""
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


@njit_noalloc
def accumulate(warped, s, p, x, y, u, spacing, cell, image, normal):
    """Add the derivatives (1) of each event to the nodes around it; return the score.

    `normal` (rows, columns, 6) gets g, xx, xy, yy of H, and what noise adds to xx and to yy
    per variance of the gradient, px.
    """
    normal[:] = 0
    score = 0.0
    per_px = 1.0 / cell
    for k in range(len(s)):
        if warped[k, 0] < 1:
            continue
        i, j = int(warped[k, 0]), int(warped[k, 1])
        if i < 1 or j < 1 or i > image.shape[2] - 3 or j > image.shape[1] - 3:
            continue
        fx, fy = warped[k, 0] - i, warped[k, 1] - j
        gx = gy = number = late = value = 0.0
        for dj in range(2):
            for di in range(2):
                weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                a, b = j + dj, i + di
                gx += weight * 0.5 * (image[0, a, b + 1] - image[0, a, b - 1])
                gy += weight * 0.5 * (image[0, a + 1, b] - image[0, a - 1, b])
                number += weight * image[1, a, b]
                late += weight * image[2, a, b]
                value += weight * image[0, a, b]
        gx, gy = gx * per_px, gy * per_px
        age = s[k] - late / max(number, 1e-9)
        w = 1.0 / (number + NUMBER_FLOOR)
        score += p[k] * value * w
        c = -p[k] * age * w
        h = CURVATURE * age * age * w / (number + NUMBER_FLOOR)
        others = max(number - OWN_NUMBER, 0.0)
        i, j, fx, fy = node_cell(
            u, spacing, (warped[k, 0] - 0.5) * cell - 0.5, (warped[k, 1] - 0.5) * cell - 0.5
        )
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
def solve_step(u, normal, smoothness, edge, sweeps, step):
    """Solve (2) for the step (rows, columns, 2) of the displacement, by Gauss-Seidel."""
    rows, columns = u.shape[0], u.shape[1]
    step[:] = 0
    for _ in range(sweeps):
        for j in range(rows):
            for i in range(columns):
                gx, gy = normal[j, i, 0], normal[j, i, 1]
                xx, xy, yy = normal[j, i, 2], normal[j, i, 3], normal[j, i, 4]
                for n in range(4):
                    b, a = i + (n == 0) - (n == 1), j + (n == 2) - (n == 3)
                    if 0 <= a < rows and 0 <= b < columns:
                        ex, ey = u[a, b, 0] - u[j, i, 0], u[a, b, 1] - u[j, i, 1]
                        w = smoothness / (1 + (ex * ex + ey * ey) / (edge * edge))
                        gx += w * (ex + step[a, b, 0])
                        gy += w * (ey + step[a, b, 1])
                        xx += w
                        yy += w
                det = xx * yy - xy * xy
                if det > 1e-12:
                    step[j, i, 0] = (yy * gx - xy * gy) / det
                    step[j, i, 1] = (xx * gy - xy * gx) / det


def image_shape(shape: tuple[int, int], cell: float) -> tuple[int, int]:
    """Return rows and columns of an image of cells, with a border of one."""
    return int(np.ceil(shape[0] / cell)) + 2, int(np.ceil(shape[1] / cell)) + 2


def node_shape(shape: tuple[int, int], spacing: float) -> tuple[int, int]:
    """Return rows and columns of the nodes of a sensor (H, W)."""
    return tuple(max(int(np.ceil(n / spacing)), 1) for n in shape)


def fill_pixels(u: NDArray, shape: tuple[int, int], spacing: float) -> NDArray[np.float32]:
    """Interpolate values of nodes (rows, columns, ...) bilinearly to all pixels (H, W, ...)."""
    for axis in (0, 1):
        a = np.clip((np.arange(shape[axis])) / spacing - 0.5, 0, u.shape[axis] - 1)
        i = np.minimum(a.astype(int), max(u.shape[axis] - 2, 0))
        f = (a - i).reshape([-1 if k == axis else 1 for k in range(u.ndim)])
        after = np.minimum(i + 1, u.shape[axis] - 1)
        u = (1 - f) * u.take(i, axis) + f * u.take(after, axis)
    return u.astype(np.float32)


class Clock(NamedTuple):
    """Relative times s of a window, linear between some times; s = 1 is its end."""

    t: NDArray[np.float64]  # (K,) us
    s: NDArray[np.float64]  # (K,)

    def rate(self, t: float) -> float:
        """Return how fast s goes at a time (us), 1/s."""
        return float(np.interp(t, self.t, np.gradient(self.s, self.t))) * 1e6


def time_clock(events: Events, at: int) -> Clock:
    """Make the clock of a window that goes as fast as time, with s = 0 at a time (us)."""
    unit = max(float(np.abs(events.t - at).max(initial=0)), 1.0)
    return Clock(at + np.array([-unit, unit]), np.array([-1.0, 1.0]))


def event_clock(events: Events, at: int, half: int) -> Clock:
    """Make the clock of a window that goes as fast as events come.

    Events come as fast as a scene moves, so that a camera that brakes has a constant velocity.

    Args:
        events: The events.
        at: Time at which s = 0, us.
        half: Number of events after which s = 1.

    Returns:
        The clock.
    """
    rows = np.unique(
        np.append(np.arange(0, len(events), max(half // CLOCK_PARTS, 1)), len(events) - 1)
    )
    t, first = np.unique(events.t[rows], return_index=True)
    s = rows[first] / half
    if len(t) < 2:
        return time_clock(events, at)
    return Clock(t.astype(float), s - np.interp(at, t, s))


class WindowEvents(NamedTuple):
    """Events of a window: places (px) and relative times."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    s: NDArray[np.float32]
    p: NDArray[np.float32]  # polarity, of mean 0 and variance 1

    @classmethod
    def of(cls, events: Events, clock: Clock) -> "WindowEvents":
        """Make them of events, with relative times of a clock."""
        # What goes up comes down: the mean is 0. A polarity that is always the same tells nothing.
        p = np.where(events.p, 1.0, -1.0)
        p = (p - p.mean()) / max(float(p.std()), 1e-3) if len(p) else p
        columns = (events.x, events.y, np.interp(events.t, clock.t, clock.s), p)
        return cls(*(np.asarray(c, np.float32) for c in columns))


class Aligned(NamedTuple):
    """Displacement of nodes and what events tell of it."""

    u: NDArray[np.float64]  # (rows, columns, 2), px per unit of s
    information: NDArray[np.float64]  # (rows, columns, 3), xx, xy and yy, 1/px^2
    score: float  # per event


class Alignment:
    """Displacements of windows of events: `align(events, start, cells)`.

    Args:
        shape: Height and width of the sensor.
        params: `FlowParams`.
    """

    def __init__(self, shape: tuple[int, int], params: Any):
        self.shape, self.spacing = shape, float(params.spacing)
        self.nodes = node_shape(shape, self.spacing)
        self.smoothness, self.edge = float(params.smoothness), float(params.edge)

    def fill(self, values: NDArray) -> NDArray[np.float32]:
        """Interpolate values of nodes to all pixels."""
        return fill_pixels(values, self.shape, self.spacing)

    def covariance(self, aligned: Aligned) -> NDArray[np.float64]:
        """Return the covariance of the nodes' displacement.

        It is the inverse of what a node and those around tell, and what they differ by, which is
        large at borders of objects.

        Args:
            aligned: Displacement and information.

        Returns:
            (rows, columns, 2, 2), px^2.
        """
        pooled = gaussian_filter(aligned.information, (POOLING, POOLING, 0), mode="constant")
        pooled *= 4 * np.pi * POOLING**2
        values, axes = np.linalg.eigh(pooled[..., [[0, 1], [1, 2]]])
        variances = 1 / np.maximum(values, MIN_INFORMATION)
        C = (axes * variances[..., None, :]) @ np.swapaxes(axes, -1, -2)
        # Differences of second order around a node: 0 where flow is affine, large at borders.
        near = np.pad(aligned.u, ((2, 2), (2, 2), (0, 0)), mode="edge")
        rows, columns = self.nodes
        around = [near[j : j + rows, i : i + columns] for j in range(5) for i in range(5)]
        off = np.stack([(around[k] + around[24 - k]) / 2 - aligned.u for k in range(12)])
        spread = (off**2).sum(-1).max(0)[..., None, None] * np.eye(2)
        length2 = (aligned.u**2).sum(-1)[..., None, None]
        floor = (MIN_VARIANCE + RELATIVE_VARIANCE * length2) * np.eye(2)
        return C + spread + floor

    def typical(self, aligned: Aligned) -> float:
        """Return the median length of displacements, weighted by information, px.

        It is 0 where events determine none of them.

        Args:
            aligned: Displacement and information.
        """
        if not (np.linalg.eigvalsh(self.covariance(aligned)) < MAX_VARIANCE).all(-1).any():
            return 0.0
        weight = np.maximum(aligned.information[..., 0] + aligned.information[..., 2], 0)
        length = np.hypot(aligned.u[..., 0], aligned.u[..., 1]).ravel()
        order = np.argsort(length, kind="stable")
        total = np.cumsum(weight.ravel()[order])
        return float(length[order[np.searchsorted(total, total[-1] / 2)]])

    def __call__(
        self, events: WindowEvents, start: NDArray | None, cells: tuple[int, ...]
    ) -> Aligned:
        """Align the events of a window.

        Args:
            events: The events.
            start: Displacement (rows, columns, 2) to start from, px; None: no displacement.
            cells: Sizes of the cells, px, one after the other.

        Returns:
            The displacement.
        """
        u = np.zeros((*self.nodes, 2)) if start is None else start.copy()
        normal, step = np.zeros((*self.nodes, 6)), np.zeros_like(u)
        warped = np.empty((len(events.x), 2), np.float32)
        x, y, s, p = events
        score = 0.0
        for cell in cells:
            image = np.zeros((3, *image_shape(self.shape, cell)), np.float32)
            scratch = np.empty_like(image[0])
            reach, before = np.full((*self.nodes, 1), float(cell)), np.zeros_like(u)
            for _ in range(N_STEPS):
                warp_and_vote(x, y, s, p, u, self.spacing, cell, warped, image)
                for channel, passes in zip(image, N_BLURS, strict=True):
                    blur(channel, scratch, passes)
                score = accumulate(warped, s, p, x, y, u, self.spacing, cell, image, normal)
                solve_step(u, normal, self.smoothness, self.edge, N_SWEEPS, step)
                # Sharp images have a smaller range than their curvature tells: steps that turn
                # back are halved.
                reach *= np.where((step * before).sum(-1, keepdims=True) < 0, 0.5, 1)
                length = np.hypot(step[..., :1], step[..., 1:])
                before = step * np.minimum(1, reach / np.maximum(length, 1e-9))
                u += before
        information = normal[..., 2:5] - NOISE * normal[..., 5:] * [1, 0, 1]
        return Aligned(u, information, score / max(len(x), 1))
