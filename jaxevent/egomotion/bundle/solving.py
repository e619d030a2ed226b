"""The equations of the photometric fit solved by conjugate gradients, compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle.coarse import ease_rest
from jaxevent.egomotion.bundle.placing import POWERS
from jaxevent.egomotion.bundle.slopes import Slopes, back, forward
from jaxevent.egomotion.bundle.weighing import subtract_mean


@njit_fastmath_inlined
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
    ease_nodes: NDArray  # (rows, columns)
    lower: NDArray[np.float64]  # (m, m), of path and coarse depths (`coarse`)
    coefficients: NDArray  # (6, POWERS), room
    more: NDArray  # (n - 6 POWERS,), room
    side: NDArray[np.float64]  # (m,), room


@njit_fastmath
def multiply(system, map_, t, depth, value, out, out_t, out_depth):
    """Write H times (map, t, depth), and J's change of misfits, `value`."""
    slopes, real = system.slopes, map_.dtype.type
    n, m = len(t), 6 * POWERS
    width, columns = map_.shape[1], depth.shape[1]
    coefficients, more = system.coefficients, system.more
    for k in range(m):
        s = 0.0
        for i in range(m):
            s += system.chain[k, i] * t[i]
        coefficients[k // POWERS, k % POWERS] = s
    for i in range(m, n):
        more[i - m] = t[i]
    flat, nodes = map_.reshape(-1), depth.reshape(-1)
    forward(slopes, flat, coefficients, more, nodes, width, columns, value)
    subtract_mean(value, system.weight, system.begin)
    scale = real(system.information)
    for e in range(len(value)):
        value[e] *= scale * system.weight[e]
    to_map, to_depth = out.reshape(-1), out_depth.reshape(-1)
    back(slopes, value, width, columns, to_map, coefficients, more, to_depth)
    for i in range(m):
        out_t[i] = 0.0
        for k in range(m):
            out_t[i] += system.chain[k, i] * coefficients[k // POWERS, k % POWERS]
    for i in range(m, n):
        out_t[i] = more[i - m]
    for i in range(n):
        for k in range(n):
            out_t[i] += system.known[i, k] * t[k]
    _add_priors(
        map_, depth, real(system.flat), real(system.tiny), system.damp, system.hold,
        system.across, system.down, out, out_depth,
    )  # fmt: skip


@njit_fastmath_inlined
def _dot(a, b):
    s = 0.0
    for i in range(len(a)):
        s += a[i] * b[i]
    return s


class _Parts(NamedTuple):
    """Vectors of all unknowns: of the map (V, height, width), the path, and depths."""

    map: NDArray
    t: NDArray[np.float64]
    depth: NDArray


# The vectors that conjugate gradients keep.
_FOUND, _LEFT, _WAY, _OUT, _BETTER = range(5)


def conjugate_gradients(
    system: System,
    side_map: NDArray,
    side_t: NDArray[np.float64],
    side_depth: NDArray,
    steps: int,
    enough: float,
) -> tuple[NDArray, NDArray[np.float64], NDArray, int]:
    """H^-1 of a side, by so many steps of conjugate gradients from 0.

    They end where the size of what is left, as the preconditioner measures it, is `enough` of the
    first. Returns map, t, depths and the number of steps.
    """
    sides = side_map, side_t, side_depth
    parts = _Parts(*(np.zeros((5, *side.shape), side.dtype) for side in sides))
    for part, side in zip(parts, sides, strict=True):
        part[_LEFT] = side
    value = np.empty(len(system.weight), side_map.dtype)
    done = _conjugate_gradients(system, parts, steps, enough, value)
    return parts.map[_FOUND], parts.t[_FOUND], parts.depth[_FOUND], done


@njit_fastmath
def _conjugate_gradients(system, parts, steps, enough, value):
    way, way_t, way_depth = parts.map[_WAY], parts.t[_WAY], parts.depth[_WAY]
    out, out_t, out_depth = parts.map[_OUT], parts.t[_OUT], parts.depth[_OUT]
    found_t, left_t, better_t = parts.t[_FOUND], parts.t[_LEFT], parts.t[_BETTER]
    left_depth, better = parts.depth[_LEFT], parts.depth[_BETTER]
    ease, p, q, d, r, s = (
        system.ease_map.reshape(-1), parts.map[_FOUND].reshape(-1), parts.map[_LEFT].reshape(-1),
        way.reshape(-1), out.reshape(-1), 0.0,
    )  # fmt: skip
    a, b, c, g, h = (
        parts.depth[_FOUND].reshape(-1), left_depth.reshape(-1), way_depth.reshape(-1),
        out_depth.reshape(-1), better.reshape(-1),
    )  # fmt: skip
    for i in range(len(p)):
        d[i] = q[i] * ease[i]
    ease_rest(system.lower, system.ease_nodes, left_t, left_depth, system.side, way_t, way_depth)
    size = _dot(q, d) + _dot(left_t, way_t) + _dot(b, c)
    first, done = size, 0
    while done < steps and size > enough * enough * first:
        done += 1
        multiply(system, way, way_t, way_depth, value, out, out_t, out_depth)
        s = _dot(d, r) + _dot(way_t, out_t) + _dot(c, g)
        length = size / max(s, 1e-30)
        step = out.dtype.type(length)
        new = 0.0
        for i in range(len(p)):
            p[i] += step * d[i]
            q[i] -= step * r[i]
            new += q[i] * q[i] * ease[i]
        for i in range(len(way_t)):
            found_t[i] += length * way_t[i]
            left_t[i] -= length * out_t[i]
        for i in range(len(a)):
            a[i] += step * c[i]
            b[i] -= step * g[i]
        ease_rest(
            system.lower, system.ease_nodes, left_t, left_depth, system.side, better_t, better
        )
        new += _dot(left_t, better_t) + _dot(b, h)
        share = new / max(size, 1e-30)
        more = out.dtype.type(share)
        for i in range(len(p)):
            d[i] = ease[i] * q[i] + more * d[i]
        for i in range(len(way_t)):
            way_t[i] = better_t[i] + share * way_t[i]
        for i in range(len(a)):
            c[i] = h[i] + more * c[i]
        size = new
    return done
