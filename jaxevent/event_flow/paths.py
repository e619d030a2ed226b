"""Paths of points through a window of events: velocities at knots, integrated from time to time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined, run_over_rows

BLOCK_POINTS = 64  # that pass through a stretch of time one beside the other


@njit_fastmath_inlined
def _bilinear(field, place, part, component):
    """Interpolate a component of a field in a cell of nodes.

    Args:
        field: (rows, columns, 2).
        place: Column and row of the cell's first node.
        part: Distance from there along x and y, 0..1.
        component: 0: along x; 1: along y.

    Returns:
        The component.
    """
    (x, y), (fx, fy) = place, part
    right, below, one = x + np.uint32(1), y + np.uint32(1), np.float32(1)
    first = field[y, x, component] * (one - fx) + field[y, right, component] * fx
    second = field[below, x, component] * (one - fx) + field[below, right, component] * fx
    return first * (one - fy) + second * fy


@njit_fastmath_inlined
def _velocity_at(fields, weight, x, y):
    """Return the velocity between two fields, bilinear between nodes.

    Args:
        fields: (rows, columns, 2) before and after.
        weight: Weight of the one after, 0..1.
        x: Place along x, in nodes; beyond the outer ones it is moved to them.
        y: Place along y, likewise.

    Returns:
        The velocity along x and along y, nodes/s.
    """
    before, after = fields
    height, width = before.shape[0], before.shape[1]
    zero, one = np.float32(0), np.float32(1)
    x, y = x if x > zero else zero, y if y > zero else zero  # 0 of a NaN, too
    x, y = min(x, np.float32(width - 1)), min(y, np.float32(height - 1))
    i, j = min(np.int32(x), np.int32(width - 2)), min(np.int32(y), np.int32(height - 2))
    fx, fy = x - np.float32(i), y - np.float32(j)
    place, part = (np.uint32(i), np.uint32(j)), (fx, fy)
    early = one - weight
    u = early * _bilinear(before, place, part, 0) + weight * _bilinear(after, place, part, 0)
    v = early * _bilinear(before, place, part, 1) + weight * _bilinear(after, place, part, 1)
    return u, v


@njit_fastmath_inlined
def _integrate_block(s, flow, along, x, y):
    """Take points later or earlier to the time 0; others stay in place.

    Args:
        s: (n,) times of the points, s.
        flow: Times (K,), s, and velocities (K, rows, columns, 2), nodes/s.
        along: 1: later; -1: earlier.
        x: (n,) positions along x, in nodes, in place.
        y: (n,) positions along y, in nodes, in place.
    """
    knots, velocity = flow
    last, half, zero = len(knots) - 1, np.float32(0.5), np.float32(0)
    far = s[0]
    for n in range(len(s)):
        far = min(far, s[n]) if along > 0 else max(far, s[n])
    for turn in range(last + 2):
        # The stretch begins at the knot k; -1 and the last one are outside.
        k = turn - 1 if along > 0 else last - turn
        begin = knots[k] if k >= 0 else min(far, zero)
        end = knots[k + 1] if k < last else max(far, zero)
        goal = min(zero, end) if along > 0 else max(zero, begin)
        entry = begin if along > 0 else end
        if (goal - far) * along <= 0 or (goal - entry) * along <= 0:
            continue
        low = max(k, 0)
        fields = velocity[low], velocity[min(low + 1, last)]
        start, scale = knots[low], zero
        if k >= 0 and k < last:
            scale = np.float32(1) / (end - begin)
        for n in range(len(s)):
            now = max(s[n], begin) if along > 0 else min(s[n], end)
            step = max((goal - now) * along, zero) * along
            u, v = _velocity_at(fields, (now - start) * scale, x[n], y[n])
            middle = (now + half * step - start) * scale
            u, v = _velocity_at(fields, middle, x[n] + half * step * u, y[n] + half * step * v)
            x[n], y[n] = x[n] + step * u, y[n] + step * v


@njit_fastmath
def _integrate_paths(begin, end, s, flow, x, y):
    """Integrate dx/ds = v(x, s) from s to 0, in place, by the midpoint rule between knots.

    Args:
        begin: First block of `BLOCK_POINTS` points.
        end: Block after the last one.
        s: (n,) times of the points, s.
        flow: Times (K,), s, and velocities (K, rows, columns, 2), nodes/s.
        x: (n,) positions along x, in nodes, in place.
        y: (n,) positions along y, in nodes, in place.
    """
    for block in range(begin, end):
        first, last = block * BLOCK_POINTS, min((block + 1) * BLOCK_POINTS, len(s))
        for along in (np.float32(1), np.float32(-1)):
            _integrate_block(s[first:last], flow, along, x[first:last], y[first:last])


class WindowPaths(NamedTuple):
    """Paths of the points that a window of events saw.

    Attributes:
        at: Time to which `carry` takes points, us.
        knots: (K,) int64 times of the velocities, us, rising. Between them velocity is linear in
            time, outside it is constant.
        velocity: (K, rows, columns, 2) velocity of nodes along x and y, px/s; bilinear between.
        covariance: (1, H, W, 2, 2) mean covariance of the pixels' velocity, (px/s)^2, or None.
        spacing: Distance of nodes, px; the outer ones are half of it from the border. 1: nodes are
            pixels.
    """

    at: int
    knots: NDArray[np.int64]
    velocity: NDArray
    covariance: NDArray[np.float32] | None = None
    spacing: float = 1.0

    def carry(
        self, x: NDArray, y: NDArray, t: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Carry points along their paths to the time `at`.

        Args:
            x: (n,) columns, px.
            y: (n,) rows, px.
            t: (n,) times at which the points are there, us.

        Returns:
            Columns and rows (n,) at the time `at`, px; they may lie outside the sensor.
        """
        # In coordinates of nodes, of which there are at least two each way, and s from `at`.
        first = 0.5 * self.spacing if self.spacing > 1 else 0.0
        places = [((np.asarray(c) - first) / self.spacing).astype(np.float32) for c in (x, y)]
        pads = [(0, max(2 - n, 0)) for n in self.velocity.shape[1:3]]
        velocity = np.pad(self.velocity / self.spacing, ((0, 0), *pads, (0, 0)), "edge")
        s, knots = ((np.subtract(c, self.at) * 1e-6).astype(np.float32) for c in (t, self.knots))
        flow, blocks = (knots, velocity.astype(np.float32)), -(-len(s) // BLOCK_POINTS)
        run_over_rows(_integrate_paths, blocks, s, flow, *places)
        out_x, out_y = (c * np.float32(self.spacing) + np.float32(first) for c in places)
        return out_x, out_y
