"""The equations of the photometric fit solved by conjugate gradients, compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.placing import POWERS
from jaxevent.egomotion.batch_fit.slopes import Slopes, back, forward
from jaxevent.egomotion.batch_fit.weighing import subtract_mean
from jaxevent.kernels import fast, fast_part


@fast_part
def _add_priors(map_, depth, flat, tiny, diagonal, lumped, across, down, out, out_depth):
    """Add what the priors' part of H makes of map and depths, of these bonds between nodes."""
    height, width = map_.shape
    real = map_.dtype.type
    for j in range(height):
        row, above, below = map_[j], map_[max(j - 1, 0)], map_[min(j + 1, height - 1)]
        to, own = out[j], diagonal[j]
        for i in range(1, width - 1):
            four = real(4) * row[i] - row[i - 1] - row[i + 1] - above[i] - below[i]
            to[i] += flat * four + (tiny + own[i]) * row[i]
        for i, beside in ((0, 1), (width - 1, width - 2)):
            four = real(3) * row[i] - row[beside] - above[i] - below[i]
            to[i] += flat * four + (tiny + own[i]) * row[i]
    rows, columns = depth.shape
    for j in range(rows):
        for i in range(columns):
            out_depth[j, i] += lumped[j, i] * depth[j, i]
            if i:
                apart = across[j, i] * (depth[j, i] - depth[j, i - 1])
                out_depth[j, i] += apart
                out_depth[j, i - 1] -= apart
            if j:
                apart = down[j, i] * (depth[j, i] - depth[j - 1, i])
                out_depth[j, i] += apart
                out_depth[j - 1, i] -= apart


class System(NamedTuple):
    """H, of which no matrix is made, and what is about its inverse.

    Unknowns are the map (height, width), t of the path and the like (n,), and depths (rows,
    columns). `chain` makes coefficients of t. Nodes are bound to those before them.
    """

    slopes: Slopes
    weight: NDArray
    information: float  # of an event of weight 1
    begin: NDArray[np.int64]
    chain: NDArray[np.float64]
    known: NDArray[np.float64]  # (n, n), the priors', and what damps
    flat: float
    tiny: float
    damp: NDArray  # (height, width), of the map
    hold: NDArray  # (rows, columns), of depths
    across: NDArray  # (rows, columns)
    down: NDArray
    ease_map: NDArray  # (height, width)
    ease_nodes: NDArray  # (rows * columns,)
    mixed: NDArray  # (rows * columns, n)
    inverse: NDArray[np.float64]  # (n, n)


@fast
def multiply(system, map_, t, depth, value, out, out_depth):
    """H times (map, t, depth): writes that of map and depth, and J's change of misfits, `value`.

    Returns that of t.
    """
    slopes, real = system.slopes, map_.dtype.type
    n, m = len(t), 6 * POWERS
    width, columns = map_.shape[1], depth.shape[1]
    coefficients = np.zeros((6, POWERS), map_.dtype)
    for k in range(m):
        s = 0.0
        for i in range(m):
            s += system.chain[k, i] * t[i]
        coefficients[k // POWERS, k % POWERS] = s
    more = t[m:].astype(map_.dtype)
    flat, nodes = map_.reshape(-1), depth.reshape(-1)
    forward(slopes, flat, coefficients, more, nodes, width, columns, value)
    subtract_mean(value, system.weight, system.begin)
    scale = real(system.information)
    for e in range(len(value)):
        value[e] *= scale * system.weight[e]
    to_map, to_depth = out.reshape(-1), out_depth.reshape(-1)
    back(slopes, value, width, columns, to_map, coefficients, more, to_depth)
    found = np.zeros(n)
    for i in range(m):
        for k in range(m):
            found[i] += system.chain[k, i] * coefficients[k // POWERS, k % POWERS]
    for i in range(m, n):
        found[i] = more[i - m]
    for i in range(n):
        for k in range(n):
            found[i] += system.known[i, k] * t[k]
    _add_priors(
        map_, depth, real(system.flat), real(system.tiny), system.damp, system.hold,
        system.across, system.down, out, out_depth,
    )  # fmt: skip
    return found


@fast_part
def ease_rest(system, t, depth, out_depth):
    """About H^-1 of path and depths, these lumped: writes depths, returns t."""
    n, nodes, to = len(t), depth.reshape(-1), out_depth.reshape(-1)
    side = t.copy()
    for k in range(len(nodes)):
        to[k] = nodes[k] * system.ease_nodes[k]
        row = system.mixed[k]
        for i in range(n):
            side[i] -= to[k] * row[i]
    found = np.zeros(n)
    for i in range(n):
        for k in range(n):
            found[i] += system.inverse[i, k] * side[k]
    for k in range(len(nodes)):
        s, row = 0.0, system.mixed[k]
        for i in range(n):
            s += row[i] * found[i]
        to[k] -= s * system.ease_nodes[k]
    return found


@fast_part
def _dot(a, b):
    s = 0.0
    for i in range(len(a)):
        s += a[i] * b[i]
    return s


@fast
def conjugate_gradients(system, side_map, side_t, side_depth, steps, enough):
    """H^-1 of a side, by so many steps of conjugate gradients from 0.

    They end where the size of what is left, as the preconditioner measures it, is `enough` of the
    first. Returns map, t, depths and the number of steps.
    """
    left, left_t, left_depth = side_map.copy(), side_t.copy(), side_depth.copy()
    found, found_t, found_depth = left * 0, left_t * 0, left_depth * 0
    out, out_depth, better = left * 0, left_depth * 0, left_depth * 0
    value = np.empty(len(system.weight), left.dtype)
    ease, p, q, r, s = (
        system.ease_map.reshape(-1), found.reshape(-1), left.reshape(-1), out.reshape(-1), 0.0,
    )  # fmt: skip
    way = left * system.ease_map
    d = way.reshape(-1)
    way_t = ease_rest(system, left_t, left_depth, better)
    way_depth = better.copy()
    size = _dot(q, d) + _dot(left_t, way_t) + _dot(left_depth.reshape(-1), way_depth.reshape(-1))
    first, done = size, 0
    while done < steps and size > enough * enough * first:
        done += 1
        out_t = multiply(system, way, way_t, way_depth, value, out, out_depth)
        s = _dot(d, r) + _dot(way_t, out_t) + _dot(way_depth.reshape(-1), out_depth.reshape(-1))
        length = size / max(s, 1e-30)
        step = left.dtype.type(length)
        new = 0.0
        for i in range(len(p)):
            p[i] += step * d[i]
            q[i] -= step * r[i]
            new += q[i] * q[i] * ease[i]
        found_t += length * way_t
        left_t -= length * out_t
        found_depth += step * way_depth
        left_depth -= step * out_depth
        better_t = ease_rest(system, left_t, left_depth, better)
        new += _dot(left_t, better_t) + _dot(left_depth.reshape(-1), better.reshape(-1))
        share = new / max(size, 1e-30)
        more = left.dtype.type(share)
        for i in range(len(p)):
            d[i] = ease[i] * q[i] + more * d[i]
        way_t = better_t + share * way_t
        for j in range(better.shape[0]):
            for i in range(better.shape[1]):
                way_depth[j, i] = better[j, i] + more * way_depth[j, i]
        size = new
    return found, found_t, found_depth, done
