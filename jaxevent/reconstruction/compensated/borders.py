"""Whose trajectory each pixel takes where surfaces meet that move in different ways.

Trajectories are bilinear between nodes, which lie two pixels apart, and smooth. Where surfaces meet
that leaves pixels on paths that nothing follows. So each takes the path of a pixel nearby if images
agree clearly better along it, by the same robust squares that motion is found with, gathered over a
Gaussian:

    sum_k rho((L_k(x + u(x', s_k)) - M(x))^2 W_k(x + u)),   x' the pixel nearby

Steps go on from such paths: near borders more of them are right then, so more pixels have one to
take.
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import fast, fast_part, over_rows, room_over
from jaxevent.reconstruction.compensated.agreement import blurred
from jaxevent.reconstruction.compensated.trajectories import (
    OUTSIDE,
    Smoothness,
    around,
    robust_mean,
    spread,
    step,
)

# Every how many pixels are compared, how far away those are whose paths are tried, and the
# Gaussian, both in units of that: turn by turn. Chosen on objects of other seeds and the first half
# of slider_depth: three turns of all pixels (8, 4 and 2 px) are as good and take 1.8 times as long.
TURNS = ((2, 4, 1.0), (1, 3, 1.0))
# Between steps, at nodes. All turns there take a further 3 % off the error of such objects and
# nothing off that of slider_depth; an image takes 7 % longer.
BETWEEN = TURNS[:1]
DIRECTIONS = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)])
# By how much for every instant. By less, pixels of one surface take what noise prefers: with 0 so
# do three of four in slow HDR pans, and well-exposed ones have 1.7 times the error. Chosen on the
# scenes that HDR parameters are fitted to, and on the same objects and frames.
CLEARLY = np.float32(0.1)
APART = np.float32(0.5)  # px at the farthest instant, by which paths differ that are compared


@fast_part
def _cost(images, s, near, y, x, path, floor, nu, level, W, R):
    """How badly images (K, h, w, 4) agree along a path of the pixel y, x: robust squares."""
    count, h, w, _ = images.shape
    one = np.float32(1)
    for k in range(count):
        X = np.float32(x) + (path[0] + path[2] * s[k]) * s[k]
        Y = np.float32(y) + (path[1] + path[3] * s[k]) * s[k]
        inside, x0, y0, x1, y1, fx, fy = around(X, Y, h, w)
        a, b = (one - fy) * (one - fx), (one - fy) * fx
        c, d = fy * (one - fx), fy * fx
        upper, lower = images[k, y0], images[k, y1]
        level[k] = a * upper[x0, 0] + b * upper[x1, 0] + c * lower[x0, 0] + d * lower[x1, 0]
        V = a * upper[x0, 1] + b * upper[x1, 1] + c * lower[x0, 1] + d * lower[x1, 1]
        W[k] = one / (V + floor) if inside else OUTSIDE
    m = robust_mean(level, W, near, nu, R)
    cost, product = 0.0, 1.0
    for k in range(count):
        e = level[k] - m
        product *= 1.0 + e * e * W[k] / nu
        if k % 16 == 15:  # one logarithm for many takes less time; nor is this too large for it
            cost, product = cost + np.log(product), 1.0
    return nu * np.float32(cost + np.log(product))


@fast_part
def _apart(own, other):
    """By how many px at the farthest instant two paths differ, at most."""
    x = abs(other[0] - own[0]) + abs(other[2] - own[2])
    return max(x, abs(other[1] - own[1]) + abs(other[3] - own[3]))


@fast
def _try(begin, end, images, s, near, step, paths, offsets, floor, nu, room, out):
    """Costs (1 + n, h, w) of every `step`-th pixel along both axes: of its path and others'.

    Only differences between them count, so they are 0 where no path differs.
    """
    h, w, _ = paths.shape
    level, W, R = room[begin, 0], room[begin, 1], room[begin, 2]
    for y in range(begin, end):
        for x in range(w):
            at, own, alike = (y * step, x * step), paths[y, x], True
            for n in range(len(offsets)):
                i = min(max(y + offsets[n, 0], 0), h - 1)
                j = min(max(x + offsets[n, 1], 0), w - 1)
                alike = alike and _apart(own, paths[i, j]) < APART
            out[0, y, x] = np.float32(0)
            if not alike:
                out[0, y, x] = _cost(images, s, near, *at, own, floor, nu, level, W, R)
            good = out[0, y, x] < CLEARLY * len(s)  # no other path is clearly better
            for n in range(len(offsets)):
                i = min(max(y + offsets[n, 0], 0), h - 1)
                j = min(max(x + offsets[n, 1], 0), w - 1)
                if good or _apart(own, paths[i, j]) < APART:
                    out[1 + n, y, x] = out[0, y, x]
                else:
                    out[1 + n, y, x] = _cost(
                        images, s, near, *at, paths[i, j], floor, nu, level, W, R
                    )


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
    near = np.exp(-2 * s**2).astype(np.float32)
    whose = np.arange(h * w, dtype=np.int32).reshape(h, w)
    row, column = np.mgrid[:h, :w]
    for every, far, sigma in turns:
        some = paths.reshape(-1, 4)[whose[::every, ::every]]
        rows, columns, _ = some.shape
        costs = np.empty((1 + len(DIRECTIONS), rows, columns), np.float32)
        given = (images, s, near, every, some, DIRECTIONS * far, np.float32(floor), np.float32(nu))
        over_rows(_try, rows, *given, room_over(rows, 3, len(s)), costs)
        found = np.stack([blurred(one, sigma) for one in costs])
        found[1:] += CLEARLY * len(s)
        best = found.argmin(0)
        moves = every * far * np.concatenate([[(0, 0)], DIRECTIONS])[best]
        dy, dx = moves[row // every, column // every].transpose(2, 0, 1)
        whose = whose[(row + dy).clip(0, h - 1), (column + dx).clip(0, w - 1)]
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
    paths = spread(step(images, s, p, floor, nu, smoothness), size)
    whose = choose(images, s, paths, floor, nu, BETWEEN)
    nodes = paths.reshape(-1, paths.shape[-1])[whose[::2, ::2]]
    p = step(images, s, nodes, floor, nu, smoothness)
    return p, choose(images, s, spread(p, size), floor, nu)
