"""Paths of points through a window of events: velocities at knots, integrated from time to time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined


@njit_noalloc_inlined
def _velocity_at(velocity, spacing, k, weight, x, y):
    """Return the velocity (px/s) at a place, bilinear, between the knots k and k + 1."""
    h, w = velocity.shape[1], velocity.shape[2]
    first = 0.5 * spacing if spacing > 1 else 0.0
    x, y = (x - first) / spacing, (y - first) / spacing
    x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
    i, j = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    fx, fy = x - i, y - j
    i2, j2, k2 = min(i + 1, w - 1), min(j + 1, h - 1), min(k + 1, velocity.shape[0] - 1)
    a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    u = v = 0.0
    if weight < 1:
        m = 1 - weight
        p, q = velocity[k, j], velocity[k, j2]
        u = m * (a * p[i, 0] + b * p[i2, 0] + c * q[i, 0] + d * q[i2, 0])
        v = m * (a * p[i, 1] + b * p[i2, 1] + c * q[i, 1] + d * q[i2, 1])
    if weight > 0:
        p, q = velocity[k2, j], velocity[k2, j2]
        u += weight * (a * p[i, 0] + b * p[i2, 0] + c * q[i, 0] + d * q[i2, 0])
        v += weight * (a * p[i, 1] + b * p[i2, 1] + c * q[i, 1] + d * q[i2, 1])
    return u, v


@njit_noalloc
def _integrate_paths(x, y, t, knots, velocity, spacing, at, out_x, out_y):
    """Integrate dx/dt = v(x, t) from t to `at`, by the midpoint rule between times of knots."""
    n_knots = len(knots)
    for n in range(len(x)):
        px, py, now = float(x[n]), float(y[n]), t[n]
        while now != at:
            # The stretch between knots on the way to `at`; -1 and n_knots - 1 are outside.
            k = -1
            if at > now:
                while k + 1 < n_knots and knots[k + 1] <= now:
                    k += 1
                end = at if k == n_knots - 1 else min(at, knots[k + 1])
            else:
                while k + 1 < n_knots and knots[k + 1] < now:
                    k += 1
                end = at if k == -1 else max(at, knots[k])
            low = max(k, 0)
            scale = shift = 0.0
            if 0 <= k < n_knots - 1:
                scale = 1.0 / (knots[k + 1] - knots[k])
                shift = now - knots[k]
            step = end - now
            u, v = _velocity_at(velocity, spacing, low, shift * scale, px, py)
            half = 0.5e-6 * step
            middle = (shift + 0.5 * step) * scale
            u, v = _velocity_at(velocity, spacing, low, middle, px + half * u, py + half * v)
            px, py, now = px + 2 * half * u, py + 2 * half * v, end
        out_x[n], out_y[n] = px, py


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
        out_x, out_y = np.empty(len(x), np.float32), np.empty(len(x), np.float32)
        places = (np.ascontiguousarray(c, np.float32) for c in (x, y))
        stamps = np.ascontiguousarray(t, np.int64)
        velocity = np.ascontiguousarray(self.velocity, np.float32)
        _integrate_paths(
            *places, stamps, self.knots, velocity, float(self.spacing), self.at, out_x, out_y
        )
        return out_x, out_y
