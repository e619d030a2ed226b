"""How misfits change, compiled: J, J', and blocks of J' W J.

Events are in the order of their tracks (`weighing`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.placing import (
    FOLD,
    POWERS,
    by_coefficients,
    corner_of,
    depth_between,
    ray_of,
)
from jaxevent.egomotion.batch_fit.weighing import spline, spline_slope
from jaxevent.kernels import fast


class Free(NamedTuple):
    """What may move beside the map."""

    path: bool
    plane: bool  # depths are a plane's
    depths: float  # 1, or 0: translation and depths are held
    usual: float  # 1/m in units of 1/|T|, the usual inverse depth


class Slopes(NamedTuple):
    """How misfits change, before their means are taken, event by event (E,).

    By the map: nine splines about `first`, `u` and `v` px beside the middle one. By the path's
    coefficients: `base` (6, E) times powers of `tau`, from the first on, in half windows. By other
    numbers: `more` (n, E), the skew and the normal of a plane. By log depth: `by_depth`, shared
    among the four nodes from `node` on.
    """

    first: NDArray[np.int32]
    u: NDArray
    v: NDArray
    base: NDArray
    tau: NDArray
    more: NDArray
    node: NDArray[np.int32]
    across: NDArray  # share of the next column's nodes
    down: NDArray  # of the next row's
    by_depth: NDArray


@fast
def differentiate(points, number, places, motion, half, depth, image, free, grids, slopes):
    """Write the slopes of misfits, of events where they lie on the nearest surface.

    x = r + rho(x) d, so (1 - d grad rho') dx is what dx were with rho held, d = rho (f C - C_z r).
    """
    x, y, tau = points
    X, Y, f = places.X, places.Y, motion.f
    for e in range(len(x)):
        t = tau[e]
        rx, ry, dx, dy = ray_of(motion, x[e], y[e], t)
        log_rho, lx, ly = depth_between(depth, X[e], Y[e], grids)
        rho = np.exp(log_rho)
        k, slopes.across[e], slopes.down[e] = corner_of(X[e], Y[e], grids)
        slopes.node[e] = k
        a, b, gx, gy = slopes.u[e], slopes.v[e], 0.0, 0.0
        k = slopes.first[e]
        for m in range(3):
            for n in range(3):
                value = image[k + m * grids.width + n]
                gx += spline(m, b) * spline_slope(n, a) * value
                gy += spline_slope(m, b) * spline(n, a) * value
        dx, dy = rho * dx, rho * dy
        slope = (gx * dx + gy * dy) / max(1 - lx * dx - ly * dy, FOLD)
        hx, hy = gx + slope * lx, gy + slope * ly
        here = places.inside[e] if free.path else 0.0
        by = by_coefficients(motion, t, rx, ry, rho, here * hx, here * hy)
        for n in range(6):
            slopes.base[n, e] = by[n]
        by_depth = here * (hx * dx + hy * dy)
        slopes.more[0, e] = -here * number[e]
        if free.plane:
            share = by_depth * free.usual / rho
            slopes.more[1, e] = share * X[e] / f
            slopes.more[2, e] = share * Y[e] / f
            slopes.more[3, e] = share
        slopes.by_depth[e] = 0.0 if free.plane else free.depths * by_depth
        slopes.tau[e] = t / half


@fast
def forward(slopes, image, coefficients, more, depth, width, columns, value):
    """Write the changes of misfits by those of map, coefficients (6, POWERS), more, and depths."""
    real = value.dtype.type
    half, middle, one = real(0.5), real(0.75), real(1)
    for e in range(len(value)):
        value[e] = 0
    for axis in range(6):
        base, tau = slopes.base[axis], slopes.tau
        a, b, c, d, g = coefficients[axis]
        for e in range(len(value)):
            t = tau[e]
            value[e] += base[e] * t * (a + t * (b + t * (c + t * (d + t * g))))
    for n in range(len(more)):
        row, by = slopes.more[n], more[n]
        for e in range(len(value)):
            value[e] += row[e] * by
    first, node = slopes.first, slopes.node
    for e in range(len(value)):
        k, a, b = first[e], slopes.u[e], slopes.v[e]
        x, y, z = half * (half - a) * (half - a), middle - a * a, half * (half + a) * (half + a)
        s = half * (half - b) * (half - b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k += width
        s += (middle - b * b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k += width
        s += half * (half + b) * (half + b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k, a, b = node[e], slopes.across[e], slopes.down[e]
        top = (one - a) * depth[k] + a * depth[k + 1]
        k += columns
        low = (one - a) * depth[k] + a * depth[k + 1]
        value[e] += s + slopes.by_depth[e] * ((one - b) * top + b * low)


@fast
def back(slopes, z, width, columns, image, coefficients, more, depth):
    """Write the transpose of `forward` of values z (E,)."""
    real = z.dtype.type
    half, middle, one = real(0.5), real(0.75), real(1)
    image[:] = 0
    depth[:] = 0
    first, node = slopes.first, slopes.node
    for e in range(len(z)):
        k, a, b, s = first[e], slopes.u[e], slopes.v[e], z[e]
        x = half * (half - a) * (half - a) * s
        y, w = (middle - a * a) * s, half * (half + a) * (half + a) * s
        share = half * (half - b) * (half - b)
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k += width
        share = middle - b * b
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k += width
        share = half * (half + b) * (half + b)
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k, a, b, s = node[e], slopes.across[e], slopes.down[e], s * slopes.by_depth[e]
        depth[k] += (one - b) * (one - a) * s
        depth[k + 1] += (one - b) * a * s
        k += columns
        depth[k] += b * (one - a) * s
        depth[k + 1] += b * a * s
    for axis in range(6):
        base, tau = slopes.base[axis], slopes.tau
        p = q = r = s = o = real(0)
        for e in range(len(z)):
            t = tau[e]
            v = z[e] * base[e] * t
            p += v
            v *= t
            q += v
            v *= t
            r += v
            v *= t
            s += v
            o += v * t
        sums = coefficients[axis]
        sums[0], sums[1], sums[2], sums[3], sums[4] = p, q, r, s, o
    for n in range(len(more)):
        row, s = slopes.more[n], real(0)
        for e in range(len(z)):
            s += row[e] * z[e]
        more[n] = s


@fast
def blocks(slopes, weight, begin, width, columns, rows, upper, mixed, lumped, diagonal):
    """Write blocks of J' W J: of coefficients and more, these with depths, and two diagonals.

    Coefficients come as `base` counts them, one after another, each with its powers. Of the depths'
    block `lumped` is each row's sum, of the map's `diagonal` counts events apart. `rows` is room,
    of one more than the most events of a track.
    """
    n, m = len(upper), 6 * POWERS
    mean = rows[len(rows) - 1]
    upper[:] = 0
    mixed[:] = 0
    lumped[:] = 0
    diagonal[:] = 0
    for track in range(len(begin) - 1):
        start, stop = begin[track], begin[track + 1]
        total = 0.0
        mean[:] = 0
        for e in range(start, stop):
            row, t = rows[e - start], slopes.tau[e]
            for axis in range(6):
                value = slopes.base[axis, e]
                for k in range(POWERS):
                    value *= t
                    row[axis * POWERS + k] = value
            for k in range(m, n):
                row[k] = slopes.more[k - m, e]
            total += weight[e]
            for k in range(n):
                mean[k] += weight[e] * row[k]
        total = max(total, 1e-3)
        for k in range(n):
            mean[k] /= total
        for e in range(start, stop):
            row, w = rows[e - start], weight[e]
            for k in range(n):
                row[k] -= mean[k]
            for i in range(n):
                scaled = w * row[i]
                for k in range(n):
                    upper[i, k] += scaled * row[k]
            a, b, at = slopes.across[e], slopes.down[e], slopes.node[e]
            by = w * slopes.by_depth[e]
            for corner in range(4):
                share = (a if corner % 2 else 1 - a) * (b if corner > 1 else 1 - b)
                node = at + corner % 2 + corner // 2 * columns
                lumped[node] += share * by * slopes.by_depth[e]
                part = mixed[node]
                scale = weight.dtype.type(share * by)
                for k in range(n):
                    part[k] += scale * row[k]
            k = slopes.first[e]
            for i in range(3):
                for j in range(3):
                    share = spline(i, slopes.v[e]) * spline(j, slopes.u[e])
                    diagonal[k + i * width + j] += w * share * share


@fast
def chained(rows, by, out):
    """Write rows @ by. NumPy would wake BLAS's threads, which then spin: twice the time in all."""
    for k in range(len(rows)):
        own, to = rows[k], out[k]
        to[:] = 0
        for i in range(len(own)):
            for j in range(len(to)):
                to[j] += own[i] * by[i, j]


@fast
def weighed_squares(rows, weight, out):
    """Write rows' diag(weight) rows, for the same reason."""
    out[:] = 0
    for k in range(len(rows)):
        row = rows[k]
        for i in range(len(row)):
            scaled = weight[k] * row[i]
            for j in range(len(row)):
                out[i, j] += scaled * row[j]
