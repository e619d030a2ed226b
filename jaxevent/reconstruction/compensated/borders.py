"""Whose trajectory each pixel takes where surfaces meet that move in different ways.

Trajectories are bilinear between nodes, which lie two pixels apart, and smooth. Where surfaces meet
that leaves pixels on paths that nothing follows. So each takes the path of a pixel nearby if images
agree clearly better along it, by the same robust squares that motion is found with, gathered over a
Gaussian:

    sum_k rho((L_k(x + u(x', s_k)) - M(x))^2 W_k(x + u)),   x' the pixel nearby

Steps go on from such paths: near borders more of them are right then, so more pixels have one to
take.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined, row_scratch, run_over_rows
from jaxevent.reconstruction.compensated.agreement import across, down, taps_of
from jaxevent.reconstruction.compensated.trajectories import (
    Row,
    Smoothness,
    locate,
    robust_means,
    spread,
    step,
    weigh,
)

# Every how many pixels are compared, how far away those are whose paths are tried, and the
# Gaussian, both in units of that: turn by turn. Chosen on objects of other seeds and the first half
# of slider_depth: three turns of all pixels (8, 4 and 2 px) are as good and take longer.
TURNS = ((2, 4, 1.0), (1, 3, 1.0))
# Between steps, at nodes. All turns there take a further 3 % off the error of such objects and
# nothing off that of slider_depth, and take longer.
BETWEEN = TURNS[:1]
# A pixel's own path, and those around it.
OFFSETS = np.array([(0, 0), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])
# By how much for every instant. By less, pixels of one surface take what noise prefers: with 0 so
# do three of four in slow HDR pans, and well-exposed ones have 1.7 times the error. Chosen on the
# scenes that HDR parameters are fitted to, and on the same objects and frames.
CLEARLY = np.float32(0.1)
APART = np.float32(0.5)  # px at the farthest instant, by which paths differ that are compared


class _Room(NamedTuple):
    """Room for each row that kernels begin with."""

    row: Row
    values: NDArray[np.float32]  # (rows, 3, K, w), log intensity, information, weights
    lines: NDArray[np.float32]  # (rows, 6, w), sums (2), means, costs of points, of pixels (2)
    logs: NDArray[np.float64]  # (rows, 2, w), sums of logarithms, and of what products
    which: NDArray[np.int32]  # (rows, w), pixels of a row
    padded: NDArray[np.float32]  # (rows, w + taps)

    @classmethod
    def over(cls, rows: int, columns: int, instants: int, taps: int) -> "_Room":
        """For `run_over_rows`."""
        return cls(
            Row.over(rows, columns),
            row_scratch(rows, 3, instants, columns),
            row_scratch(rows, 6, columns),
            np.empty((rows, 2, columns)),
            np.empty((rows, columns), np.int32),
            row_scratch(rows, columns + taps),
        )


@njit_noalloc_inlined
def _read(image, pixel, part, level, V):
    """Log intensity and variance of a packed image at points, bilinear."""
    h, w, _ = image.shape
    one = np.float32(1)
    for i in range(len(level)):
        x0, y0, fx, fy = pixel[0, i], pixel[1, i], part[0, i], part[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b = (one - fy) * (one - fx), (one - fy) * fx
        c, d = fy * (one - fx), fy * fx
        level[i] = a * upper[x0, 0] + b * upper[x1, 0] + c * lower[x0, 0] + d * lower[x1, 0]
        V[i] = a * upper[x0, 1] + b * upper[x1, 1] + c * lower[x0, 1] + d * lower[x1, 1]


@njit_noalloc_inlined
def _cost(count, begin, images, s, near, y, floor, nu, room):
    """How badly images (K, h, w, 4) agree along the paths of a row's first points.

    Robust squares, `room.lines[begin, 3]`; paths and places at the target stand in `room.row`.
    """
    h, w = images.shape[1:3]
    path, pixel, part = room.row.path[begin], room.row.pixel[begin], room.row.part[begin]
    x, inside = room.row.x[begin, :count], room.row.inside[begin]
    level, W, R = room.values[begin, 0], room.values[begin, 1], room.values[begin, 2]
    sums, means, costs = room.lines[begin, :2], room.lines[begin, 2, :count], room.lines[begin, 3]
    total, product = room.logs[begin, 0], room.logs[begin, 1]
    for k in range(len(s)):
        locate(path, x, y, s[k], (h, w), pixel, part, inside)
        _read(images[k], pixel, part, level[k, :count], W[k])
        weigh(W[k, :count], inside, floor, W[k])
    robust_means(level, W, near, nu, R, sums, means)
    for i in range(count):
        total[i], product[i] = 0.0, 1.0
    for k in range(len(s)):
        for i in range(count):
            e = level[k, i] - means[i]
            product[i] *= 1.0 + e * e * W[k, i] / nu
        # One logarithm for many takes less time; nor is this too large for it.
        if k % 16 == 15 or k + 1 == len(s):
            for i in range(count):
                total[i] += np.log(product[i])
                product[i] = 1.0
    for i in range(count):
        costs[i] = nu * np.float32(total[i])


@njit_noalloc_inlined
def _apart(own, other):
    """By how many px at the farthest instant two paths differ, at most."""
    x = abs(other[0] - own[0]) + abs(other[2] - own[2])
    return max(x, abs(other[1] - own[1]) + abs(other[3] - own[3]))


@njit_noalloc_inlined
def _alike(paths, y, x, offsets):
    """Whether no path nearby differs from a pixel's own."""
    h, w, _ = paths.shape
    for n in range(1, len(offsets)):
        i = min(max(y + offsets[n, 0], 0), h - 1)
        j = min(max(x + offsets[n, 1], 0), w - 1)
        if _apart(paths[y, x], paths[i, j]) >= APART:
            return False
    return True


@njit_noalloc_inlined
def _list(y, n, step, paths, offsets, enough, begin, room):
    """Write down the pixels of a row to compare along the `n`th path, with it; how many."""
    h, w, _ = paths.shape
    own, row, count = room.lines[begin, 4], room.row, 0
    i = min(max(y + offsets[n, 0], 0), h - 1)
    for x in range(w):
        j = min(max(x + offsets[n, 1], 0), w - 1)
        if n == 0:
            wanted = not _alike(paths, y, x, offsets)
        else:  # of a path that is good no other is clearly better
            wanted = own[x] >= enough and _apart(paths[y, x], paths[i, j]) >= APART
        if wanted:
            room.which[begin, count], row.x[begin, count] = x, np.float32(x * step)
            for c in range(4):
                row.path[begin, c, count] = paths[i, j, c]
            count += 1
    return count


@njit_noalloc
def _try(begin, end, images, s, near, step, paths, offsets, floor, nu, taps, room, out):
    """Costs (n, h, w) of every `step`-th pixel along both axes: of the paths at offsets (n, 2).

    The first is its own. They are blurred along x. Only differences between them count, so they are
    0 where no path differs, and those of its own where another is not compared.
    """
    which, found, padded = room.which[begin], room.lines[begin, 3], room.padded[begin]
    own, other = room.lines[begin, 4], room.lines[begin, 5]
    for y in range(begin, end):
        own[:] = np.float32(0)
        for n in range(len(offsets)):
            count = _list(y, n, step, paths, offsets, CLEARLY * len(s), begin, room)
            _cost(count, begin, images, s, near, np.float32(y * step), floor, nu, room)
            for x in range(len(own)):
                other[x] = own[x]
            for m in range(count):
                other[which[m]] = found[m]
                if n == 0:
                    own[which[m]] = found[m]
            across(other, taps, padded, out[n, y])


@njit_noalloc
def _take(begin, end, costs, moves, every, margin, taps, whose, lines, out):
    """Whose path each pixel takes by costs that are blurred along x; `whose` are those so far."""
    h, w = whose.shape
    cost, least, best = lines[begin, 0], lines[begin, 1], lines[begin, 2]
    for row in range(begin, end):
        for n in range(len(costs)):
            down(costs[n], row, taps, cost)
            more = margin if n else np.float32(0)
            for i in range(len(cost)):
                if n == 0 or cost[i] + more < least[i]:
                    least[i], best[i] = cost[i] + more, np.float32(n)
        for y in range(row * every, min((row + 1) * every, h)):
            for x in range(w):
                move = moves[int(best[x // every])]
                out[y, x] = whose[min(max(y + move[0], 0), h - 1), min(max(x + move[1], 0), w - 1)]


def choose(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    paths: NDArray[np.float32],
    floor: float,
    nu: float,
    turns: tuple[tuple[int, int, float], ...] = TURNS,
) -> NDArray[np.int32]:
    """The pixel, counted row by row, whose path each pixel takes, (h, w).

    Args:
        images: As `trajectories.pack` makes them, (K, h, w, 4).
        s: Their times, -1..1.
        paths: Of all pixels, (h, w, 4).
        floor: As in `trajectories`.
        nu: As in `trajectories`.
        turns: As `TURNS`.
    """
    h, w, _ = paths.shape
    near, margin = np.exp(-2 * s**2).astype(np.float32), np.float32(CLEARLY * len(s))
    rules = np.float32(floor), np.float32(nu)
    whose = np.arange(h * w, dtype=np.int32).reshape(h, w)
    for every, far, sigma in turns:
        some, taps = paths.reshape(-1, 4)[whose[::every, ::every]], taps_of(sigma)
        rows, columns, _ = some.shape
        costs = np.empty((len(OFFSETS), rows, columns), np.float32)
        room = _Room.over(rows, columns, len(s), len(taps))
        given = (images, s, near, every, some, OFFSETS * far, *rules, taps, room)
        run_over_rows(_try, rows, *given, costs)
        given = (costs, OFFSETS * every * far, every, margin, taps, whose, room.lines)
        whose = np.empty_like(whose)
        run_over_rows(_take, rows, *given, whose)
    return whose


def refine(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    p: NDArray[np.float32],
    floor: float,
    nu: float,
    smoothness: Smoothness,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Trajectories p (rows, columns, 4) after two steps, and what `choose` tells of them.

    Nodes take the paths of others between the steps. Arguments are as those of `trajectories.step`.
    """
    size = images.shape[1:3]
    p = step(images, s, p, floor, nu, smoothness)
    y, x = np.divmod(choose(images, s, spread(p, size), floor, nu, BETWEEN)[::2, ::2], size[1])
    p = step(images, s, p[y // 2, x // 2], floor, nu, smoothness)
    return p, choose(images, s, spread(p, size), floor, nu)
