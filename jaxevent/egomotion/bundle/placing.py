"""Where events lie in the reference view, compiled: on rays, and on surfaces between nodes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined

POWERS = 5  # of time, of the path's polynomials
LOOKS = 16  # depths on a ray that are looked at, at most
APART = 1.0  # px on the ray between them, but for those that are so many
SETTLED = 0.01  # of log depth, that a second step of Newton from the depth before changes at most
FOLD = 0.3  # the least slope, along the ray of an event, of log depth less that of the scene


class Grids(NamedTuple):
    """Where the map's pixels and the nodes lie."""

    x: float  # px, of pixel and node [0, 0]
    y: float
    height: int  # of the map
    width: int
    node: float  # px between nodes
    rows: int  # of nodes
    columns: int


class Points(NamedTuple):
    """Events or other points: where they were seen (px, 0 at the principal point), and when."""

    x: NDArray
    y: NDArray
    tau: NDArray  # s


class Motion(NamedTuple):
    """A path's polynomials: factors (POWERS, 3) of tau, tau^2, ... of phi and C."""

    phi: NDArray[np.float64]
    C: NDArray[np.float64]
    f: float  # px


class Cells(NamedTuple):
    """Square cells of the reference view, row by row."""

    corner: tuple[float, float]  # px, where the first pixel of the first lies
    size: int  # px
    rows: int
    columns: int


@njit_fastmath_inlined
def _along(c, tau, axis):
    """sum_k c_k tau^k of one component, k from 1."""
    s = c[POWERS - 1, axis]
    for k in range(POWERS - 2, -1, -1):
        s = s * tau + c[k, axis]
    return s * tau


@njit_fastmath_inlined
def _turned(a, b, c, x, y, z):
    """exp[phi]x of a point, to the sixth order of |phi|, which is below 1."""
    s = a * a + b * b + c * c
    one, two = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    dx, dy, dz = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
    return x + one * cx + two * dx, y + one * cy + two * dy, z + one * cz + two * dz


@njit_fastmath_inlined
def ray_of(motion, x, y, tau):
    """The ray of an event in the reference view, r + rho d: r and d."""
    phi, C, f = motion
    a, b, c = _along(phi, tau, 0), _along(phi, tau, 1), _along(phi, tau, 2)
    rx, ry, rz = _turned(a, b, c, x, y, f)
    z = max(rz / f, 0.05)
    rx, ry = rx / z, ry / z
    cz = _along(C, tau, 2)
    return rx, ry, f * _along(C, tau, 0) - cz * rx, f * _along(C, tau, 1) - cz * ry


@njit_fastmath
def warp(points, rho, motion, X, Y):
    """Write where points of inverse depths rho are in the reference view."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = ray_of(motion, x[e], y[e], tau[e])
        X[e], Y[e] = rx + rho[e] * dx, ry + rho[e] * dy


@njit_fastmath_inlined
def _cell(x, y, cells):
    """The cell that a place is in, or the nearest one."""
    left, top = cells.corner
    i = min(max(int(np.floor((x - left + 0.5) / cells.size)), 0), cells.columns - 1)
    j = min(max(int(np.floor((y - top + 0.5) / cells.size)), 0), cells.rows - 1)
    return j * cells.columns + i


@njit_fastmath
def assign(points, motion, rho, cells, number, X, Y):
    """Write the cell of every event, by where it is warped to with its cell's depth, and that."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = ray_of(motion, x[e], y[e], tau[e])
        k = _cell(x[e], y[e], cells)
        for _ in range(2):
            k = _cell(rx + rho[k] * dx, ry + rho[k] * dy, cells)
        number[e], X[e], Y[e] = k, rx + rho[k] * dx, ry + rho[k] * dy


@njit_fastmath_inlined
def corner_of(x, y, grids):
    """The first of four nodes about a place, and the shares of the next column and row."""
    i = min(max((x - grids.x) / grids.node, 0.0), grids.columns - 1.001)
    j = min(max((y - grids.y) / grids.node, 0.0), grids.rows - 1.001)
    column, row = int(i), int(j)
    return row * grids.columns + column, i - column, j - row


@njit_fastmath_inlined
def depth_between(depth, x, y, grids):
    """Log inverse depth between nodes, and its slopes per px along x and y."""
    k, u, v = corner_of(x, y, grids)
    a, b, c, d = depth[k], depth[k + 1], depth[k + grids.columns], depth[k + grids.columns + 1]
    across, down = (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)
    level = a + u * (b - a) + v * (c - a + u * (d - c - b + a))
    return level, across / grids.node, down / grids.node


@njit_fastmath_inlined
def _newton(depth, rx, ry, dx, dy, log_rho, grids):
    """The depth on a ray where the scene's is met, from one nearby."""
    rho = np.exp(log_rho)
    there, lx, ly = depth_between(depth, rx + rho * dx, ry + rho * dy, grids)
    return log_rho - (log_rho - there) / max(1 - rho * (lx * dx + ly * dy), FOLD)


@njit_fastmath_inlined
def _first_met(depth, ray, top, bottom, grids):
    """From near to far, the first of some depths on a ray that is not nearer than the scene's."""
    rx, ry, dx, dy = ray
    rho = np.exp(top)
    value = top - depth_between(depth, rx + rho * dx, ry + rho * dy, grids)[0]
    if value <= 0:
        return top
    reach = np.sqrt(dx * dx + dy * dy) * (rho - np.exp(bottom)) / APART
    looks = min(1 + int(reach), LOOKS)
    step, before = (bottom - top) / looks, top
    less = np.exp(step)
    for _ in range(looks):
        rho *= less
        log_rho = before + step
        new = log_rho - depth_between(depth, rx + rho * dx, ry + rho * dy, grids)[0]
        if new <= 0:
            return before + step * value / max(value - new, 1e-6)
        before, value = log_rho, new
    return bottom


@njit_fastmath
def place(points, motion, depth, high, low, grids, root, X, Y):
    """Write where events are in the reference view: on the nearest surface their rays meet.

    On the ray of an event x = r + rho d, which the depths of the scene, rho'(x), meet where
    log rho = log rho'(r + rho d): once if they are smooth, more often beside an edge, where the
    surface of the largest rho hides the others. `high` and `low` bound depths about nodes. `root`
    holds log rho: those before, of a scene that is about the same, or -inf, and afterwards the new.
    """
    x, y, tau = points
    for e in range(len(x)):
        ray = ray_of(motion, x[e], y[e], tau[e])
        rx, ry, dx, dy = ray
        here, new = root[e], np.inf
        if here > -np.inf:
            here = _newton(depth, rx, ry, dx, dy, here, grids)
            new = _newton(depth, rx, ry, dx, dy, here, grids)
        if not abs(new - here) < SETTLED:
            k = corner_of(rx, ry, grids)[0]
            new = _first_met(depth, ray, high[k] + 0.02, low[k] - 0.02, grids)
            for _ in range(2):
                new = _newton(depth, rx, ry, dx, dy, new, grids)
        root[e], rho = new, np.exp(new)
        X[e], Y[e] = rx + rho * dx, ry + rho * dy


@njit_fastmath_inlined
def by_coefficients(motion, t, rx, ry, rho, hx, hy):
    """Slopes by phi and C of hx X + hy Y, where (X, Y) is the end of an event's ray.

    Of a rotation dR x = J dphi x R x, J the left Jacobian of phi; J' w = w - one phi x w + two
    phi x (phi x w).
    """
    phi, C, f = motion
    gone = 1 - rho * _along(C, t, 2)
    wx = gone * (-rx * ry / f * hx - (f + ry * ry / f) * hy)
    wy = gone * ((f + rx * rx / f) * hx + rx * ry / f * hy)
    wz = gone * (-ry * hx + rx * hy)
    p, q, s = _along(phi, t, 0), _along(phi, t, 1), _along(phi, t, 2)
    a = p * p + q * q + s * s
    one, two = 0.5 - a / 24 + a * a / 720, 1 / 6 - a / 120 + a * a / 5040
    ax, ay, az = q * wz - s * wy, s * wx - p * wz, p * wy - q * wx
    return (
        wx - one * ax + two * (q * az - s * ay),
        wy - one * ay + two * (s * ax - p * az),
        wz - one * az + two * (p * ay - q * ax),
        rho * f * hx,
        rho * f * hy,
        -rho * (rx * hx + ry * hy),
    )


@njit_fastmath
def slopes_by_coefficients(points, rho, motion, by, by_depth):
    """Write how points (n,) move, by phi and C (n, 6, 2), and by log inverse depth (n, 2)."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = ray_of(motion, x[e], y[e], tau[e])
        by_depth[e, 0], by_depth[e, 1] = rho[e] * dx, rho[e] * dy
        for axis in range(2):
            h = 1.0 - axis
            six = by_coefficients(motion, tau[e], rx, ry, rho[e], h, 1.0 - h)
            for n in range(6):
                by[e, n, axis] = six[n]
