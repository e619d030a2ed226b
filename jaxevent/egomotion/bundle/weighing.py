"""What the map shows where events lie, and their weights by their misfits, compiled.

Events are in the order of their tracks: of the k-th they are those from `begin[k]` on, and the last
of `begin` is the number of all. The map is a quadratic B-spline of 1 px.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined


@njit_fastmath
def read_map(image, X, Y, grids, first, u, v, inside, value):
    """Write the map's values at places, which splines they are of, and whether inside the map."""
    width = grids.width
    for e in range(len(X)):
        i, j = X[e] - grids.x, Y[e] - grids.y
        inside[e] = i >= 1 and i < width - 2 and j >= 1 and j < grids.height - 2
        i, j = min(max(i, 1.0), width - 2.0), min(max(j, 1.0), grids.height - 2.0)
        column, row = int(i + 0.5), int(j + 0.5)
        a, b = i - column, j - row
        k = (row - 1) * width + column - 1
        first[e], u[e], v[e] = k, a, b
        s = 0.0
        for m in range(3):
            share = spline(m, b)
            s += share * (
                spline(0, a) * image[k] + spline(1, a) * image[k + 1] + spline(2, a) * image[k + 2]
            )
            k += width
        value[e] = s


@njit_fastmath_inlined
def spline(m, t):
    """Of the m-th of three quadratic B-splines, t px beside the middle one."""
    return 0.75 - t * t if m == 1 else (0.5 + (m - 1) * t) ** 2 / 2


@njit_fastmath_inlined
def spline_slope(m, t):
    return -2 * t if m == 1 else (m - 1) * 0.5 + t


@njit_fastmath_inlined
def _around(image, rows, sums):
    """Write sums over squares of 5 px about each pixel of a map (height, width).

    `rows` (height, width + 4) is room.
    """
    height, width = image.shape
    rows[:] = 0
    for j in range(height):
        for k in range(max(j - 2, 0), min(j + 3, height)):
            for i in range(width):
                rows[j, i + 2] += image[k, i]
    for j in range(height):
        row = rows[j]
        for i in range(width):
            sums[j, i] = row[i] + row[i + 1] + row[i + 2] + row[i + 3] + row[i + 4]


@njit_fastmath
def subtract_mean(values, weight, begin):
    """Less the mean over the track's events, in place."""
    for k in range(len(begin) - 1):
        total, s = 0.0, 0.0
        for e in range(begin[k], begin[k + 1]):
            total += weight[e]
            s += weight[e] * values[e]
        mean = s / max(total, 1e-3)
        for e in range(begin[k], begin[k + 1]):
            values[e] -= mean


class Room(NamedTuple):
    """Room for `weigh`: of the map's shape, and of the rows'."""

    image: NDArray
    rows: NDArray  # four columns wider
    sums: NDArray
    number: NDArray
    left: NDArray
    cost: NDArray

    @classmethod
    def of(cls, height: int, width: int, e: NDArray) -> "Room":
        image, sums, number = np.empty((3, height, width), e.dtype)
        rows = np.empty((height, width + 4), e.dtype)
        return cls(image, rows, sums, number, np.empty_like(e), np.empty_like(e))


@njit_fastmath
def weigh(e, on, trust, till, first, begin, limit, usual, plane, room, weight):
    """Write rows' weights, from those before; returns the places' cost and that of the events.

    Misfits count times `trust`; rows from `till` on are pixels of frames.
    Events at a place of mean cost q cost 4 q / (1 + q / usual), of slope 1 at the usual q. A plane
    hides nothing of itself.
    """
    image, rows, sums, number, left, cost = room
    flat, middle = image.reshape(-1), image.shape[1] + 1
    flat[:] = 0
    for k in range(len(e)):
        flat[first[k] + middle] += on[k]
    _around(image, rows, number)
    events, around_it = number.reshape(-1), sums.reshape(-1)
    of_places, of_events = 0.0, e.dtype.type(0)
    for _ in range(2):
        for k in range(len(e)):
            left[k] = e[k]
        subtract_mean(left, weight, begin)
        flat[:] = 0
        for k in range(len(e)):
            square = (trust[k] * left[k]) ** 2
            cost[k] = on[k] * square / (1 + square / limit)
            flat[first[k] + middle] += cost[k]
        _around(image, rows, sums)
        flat[:] = 0
        of_places = 0.0
        for k in range(len(e)):
            at = first[k] + middle
            n = max(events[at], 1.0)
            q = around_it[at] / n
            slope = 1.0 if plane else 4 / (1 + q / usual) ** 2
            of_places += on[k] * (q if plane else 4 * q / (1 + q / usual))
            flat[at] += on[k] * slope / n
        _around(image, rows, sums)
        for k in range(len(e)):
            t = trust[k] ** 2
            w = on[k] * t / (1 + t * left[k] ** 2 / limit) ** 2
            weight[k] = w * around_it[first[k] + middle]
    for k in range(till):
        of_events += cost[k]
    return of_places, of_events
