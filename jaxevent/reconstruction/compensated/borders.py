"""Whose trajectory each pixel takes where surfaces meet that move in different ways.

Trajectories are bilinear between nodes, which lie two pixels apart, and smooth. Where surfaces meet
that leaves pixels on paths that nothing follows. So each takes the path of a pixel nearby if images
agree better along it, by robust squares like those that motion is found with, gathered over a
Gaussian:

    sum_k rho((L_k(x + u(x', s_k)) - M(x))^2 W_k(x + u)),   x' the pixel nearby

A point that a nearer surface hides before or after the target is seen on the other side alone. So
the sum is that of all instants, or of those up to the target, or from it on, with a mean M of their
own and `HIDDEN` for every instant: whichever is least.
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import fast, fast_part, over_rows
from jaxevent.reconstruction.compensated.agreement import blurred
from jaxevent.reconstruction.compensated.trajectories import OUTSIDE, around, robust_mean

# Every how many pixels are compared, and how far away those are whose paths are tried, in units of
# that: turn by turn. Turns, `HIDDEN` and `NU` are chosen on objects of seeds 11 to 16, with fitted
# thresholds and without, and the first half of slider_depth. With less for what is hidden, paths
# that agree on one side by chance are picked: 2.4 costs objects 7 % where the smoother's variances
# are small.
TURNS = ((2, 4), (1, 3))
DIRECTIONS = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)])
SIGMA = 1.0  # of the Gaussian, in units of the pixels compared
APART = np.float32(0.5)  # px at the farthest instant, by which paths differ that are compared
HIDDEN = 3.2  # for each instant
NU = np.float32(6)  # of rho, `trajectories` has it


@fast_part
def _misfit(level, W, near, R):
    """Robust squares of values with information W about their mean."""
    m = robust_mean(level, W, near, NU, R)
    cost, product = 0.0, 1.0
    for k in range(len(level)):
        e = level[k] - m
        product *= 1.0 + e * e * W[k] / NU
        if k % 16 == 15:  # one logarithm for many takes less time; nor is this too large for it
            cost, product = cost + np.log(product), 1.0
    return NU * np.float32(cost + np.log(product))


@fast_part
def _compare(images, s, near, own, y, x, path, floor, level, W, R, out):
    """How badly images (K, h, w, 4) agree along a path of the pixel y, x: robust squares.

    Those of all instants, of those up to the target's, `own`, and of those from it on.
    """
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
    last = own + 1
    out[0] = _misfit(level, W, near, R)
    out[1] = _misfit(level[:last], W[:last], near[:last], R)
    out[2] = _misfit(level[own:], W[own:], near[own:], R)


@fast
def _try(begin, end, images, s, near, own, step, paths, offsets, floor, out):
    """Costs (1 + n, 3, h, w) of every `step`-th pixel along both axes: of its path and others'."""
    h, w, _ = paths.shape
    level, W, R = np.empty((3, len(s)), np.float32)
    for y in range(begin, end):
        for x in range(w):
            at, mine, costs = (y * step, x * step), paths[y, x], out[:, :, y, x]
            _compare(images, s, near, own, *at, mine, floor, level, W, R, costs[0])
            for n in range(len(offsets)):
                i = min(max(y + offsets[n, 0], 0), h - 1)
                j = min(max(x + offsets[n, 1], 0), w - 1)
                other = paths[i, j]
                apart = np.float32(0)
                for c in range(2):
                    v, a = other[c] - mine[c], other[c + 2] - mine[c + 2]
                    apart = max(apart, abs(v) + abs(a))
                if apart < APART:
                    costs[1 + n] = costs[0]
                else:
                    _compare(images, s, near, own, *at, other, floor, level, W, R, costs[1 + n])


def choose(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    at: tuple[int, int, int],
    paths: NDArray[np.float32],
    floor: float,
) -> NDArray[np.int32]:
    """The pixel, counted row by row, whose path each pixel takes, (h, w).

    Args:
        images: As `trajectories.pack` makes them, (K, h, w, 4).
        s: Their times, -1..1.
        at: Which of them are those of the frame before, the target, the frame after.
        paths: Of all pixels, (h, w, 4).
        floor: As in `trajectories`.
    """
    h, w, _ = paths.shape
    near, (before, own, after) = np.exp(-2 * s**2).astype(np.float32), at
    sums = 3 if before < own < after else 1  # a side without frames tells little alone
    whose = np.arange(h * w, dtype=np.int32).reshape(h, w)
    row, column = np.mgrid[:h, :w]
    for step, far in TURNS:
        some = paths.reshape(-1, 4)[whose[::step, ::step]]
        rows, columns, _ = some.shape
        costs = np.empty((1 + len(DIRECTIONS), 3, rows, columns), np.float32)
        given = (images, s, near, own, step, some, DIRECTIONS * far, np.float32(floor))
        over_rows(_try, rows, *given, costs)
        seen = np.array([[blurred(one, SIGMA) for one in path[:sums]] for path in costs])
        seen[:, 1:] += HIDDEN * len(s)
        best = seen.min(1).argmin(0)
        moves = step * far * np.concatenate([[(0, 0)], DIRECTIONS])[best]
        dy, dx = moves[row // step, column // step].transpose(2, 0, 1)
        whose = whose[(row + dy).clip(0, h - 1), (column + dx).clip(0, w - 1)]
    return whose
