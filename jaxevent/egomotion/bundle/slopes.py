"""How misfits change, compiled: J, J', and blocks of J' W J.

Events are in the order of their tracks (`weighing`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle.coarse import SPAN, share_of
from jaxevent.egomotion.bundle.placing import (
    FOLD,
    POWERS,
    by_coefficients,
    corner_of,
    depth_between,
    ray_of,
)
from jaxevent.egomotion.bundle.weighing import spline, spline_slope

WIDE, ROWS = 8, 64  # numbers side by side, and rows whose squares single precision adds up


class Free(NamedTuple):
    """What may move beside the map and the path."""

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


@njit_fastmath
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
        here = places.inside[e]
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


@njit_fastmath
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


@njit_fastmath
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


class BlockRoom(NamedTuple):
    """Room for `blocks`: of some rows, their weights and a mean, and of their squares."""

    rows: NDArray  # (ROWS, about n)
    weight: NDArray  # (ROWS,)
    mean: NDArray  # (about n,)
    part: NDArray  # (about n, about n)

    @classmethod
    def of(cls, n: int, real: np.dtype) -> "BlockRoom":
        wide = -(-n // WIDE) * WIDE
        rows, part = np.zeros((ROWS, wide), real), np.zeros((n, wide), real)
        return cls(rows, np.zeros(ROWS, real), np.zeros(wide, real), part)


@njit_fastmath_inlined
def _write_row(slopes, e, row):
    """How an event's misfit changes by coefficients, those of each axis by powers, and by more."""
    t = slopes.tau[e]
    for axis in range(6):
        value = slopes.base[axis, e]
        for k in range(POWERS):
            value *= t
            row[axis * POWERS + k] = value
    for k in range(len(slopes.more)):
        row[6 * POWERS + k] = slopes.more[k, e]


@njit_fastmath_inlined
def _add_squares(room, number, upper):
    """Add rows' diag(weight) rows of so many rows, on and below the diagonal."""
    rows, weight, _, part = room
    part[:] = 0
    for r in range(number, (number + 3) // 4 * 4):
        weight[r] = 0
    for r in range(0, number, 4):
        p, q, s, t = rows[r], rows[r + 1], rows[r + 2], rows[r + 3]
        f, g, h, o = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
        for i in range(len(upper)):
            a, b, c, d = f * p[i], g * q[i], h * s[i], o * t[i]
            to = part[i]
            for k in range(i // WIDE * WIDE + WIDE):
                to[k] += a * p[k] + b * q[k] + c * s[k] + d * t[k]
    for i in range(len(upper)):
        for k in range(i + 1):
            upper[i, k] += part[i, k]


@njit_fastmath_inlined
def _coarse_place(slopes, e, columns):
    """The first of the four coarse nodes about an event, and where between them it is."""
    row = slopes.node[e] // columns
    x, y = slopes.node[e] - row * columns + slopes.across[e], row + slopes.down[e]
    i, j = int(x / SPAN), int(y / SPAN)
    return j * ((columns - 1) // SPAN + 2) + i, x / SPAN - i, y / SPAN - j


@njit_fastmath
def blocks(slopes, weight, begin, columns, room, upper, mixed):
    """Write blocks of J' W J: of coefficients and more, and coarse nodes with these.

    Coefficients come as `base` counts them, one after another, each with its powers.
    """
    wide = (columns - 1) // SPAN + 2
    rows, weights, mean, _ = room
    n, filled, tracks = len(upper), 0, len(begin) - 1
    upper[:] = 0
    mixed[:] = 0
    for track in range(tracks):
        start, stop = begin[track], begin[track + 1]
        total, row = 0.0, rows[filled]
        mean[:] = 0
        for e in range(start, stop):
            _write_row(slopes, e, row)
            total += weight[e]
            for k in range(n):
                mean[k] += weight[e] * row[k]
        less = mean.dtype.type(1 / max(total, 1e-3))
        for e in range(start, stop):
            row = rows[filled]
            _write_row(slopes, e, row)
            for k in range(n):
                row[k] -= less * mean[k]
            weights[filled] = weight[e]
            at, u, v = _coarse_place(slopes, e, columns)
            for p in range(4):
                to = mixed[at + p % 2 + p // 2 * wide]
                scale = weight.dtype.type(weight[e] * slopes.by_depth[e] * share_of(u, v, p))
                for k in range(n):
                    to[k] += scale * row[k]
            filled += 1
            if filled == len(rows) or (track == tracks - 1 and e == stop - 1):
                _add_squares(room, filled, upper)
                filled = 0
    for i in range(n):
        for k in range(i):
            upper[k, i] = upper[i, k]


@njit_fastmath
def depth_blocks(slopes, weight, begin, columns, room, smooth, lumped):
    """Write blocks of J' W J: of coarse nodes, and of nodes each row's sum of single events.

    Room is for a mean, which coarse nodes are in it, and the last track of each.
    """
    wide = (columns - 1) // SPAN + 2
    mean, touched, latest = room
    latest[:] = -1
    smooth[:] = 0
    lumped[:] = 0
    for track in range(len(begin) - 1):
        total, number = 0.0, 0
        for e in range(begin[track], begin[track + 1]):
            w, by = weight[e], slopes.by_depth[e]
            total += w
            for p in range(4):
                share = share_of(slopes.across[e], slopes.down[e], p)
                lumped[slopes.node[e] + p % 2 + p // 2 * columns] += w * by * by * share
            at, u, v = _coarse_place(slopes, e, columns)
            for p in range(4):
                k, value = at + p % 2 + p // 2 * wide, w * by * share_of(u, v, p)
                if latest[k] != track:
                    latest[k], touched[number], mean[k] = track, k, 0
                    number += 1
                mean[k] += value
                for q in range(4):
                    smooth[k, at + q % 2 + q // 2 * wide] += value * by * share_of(u, v, q)
        total = max(total, 1e-3)
        for p in range(number):
            k = touched[p]
            for q in range(number):
                smooth[k, touched[q]] -= mean[k] * mean[touched[q]] / total


@njit_fastmath
def squares(slopes, weight, width, diagonal):
    """Write the diagonal of the map's block of J' W J, which counts events apart."""
    diagonal[:] = 0
    for e in range(len(weight)):
        k, w = slopes.first[e], weight[e]
        for i in range(3):
            for j in range(3):
                share = spline(i, slopes.v[e]) * spline(j, slopes.u[e])
                diagonal[k + i * width + j] += w * share * share
