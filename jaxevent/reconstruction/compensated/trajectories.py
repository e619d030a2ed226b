"""Trajectories of the scene points that are visible at a target time.

Point x of the target's image lies at x + u(x, s) at the instant s, u = v(x) s + a(x) s^2, s = -1..1
over the instants. v and a are bilinear between nodes, one for every 2 x 2 pixels. They minimise,
with the unknown image M of the target,

    sum_k sum_x rho((L_k(x + u(x, s_k)) - M(x))^2 W_k(x + u)) + smoothness,
    rho(q) = nu log(1 + q / nu),   W_k = 1 / (V_k + floor)

by Gauss-Newton steps in which M is eliminated. Large motion is found from nothing by growing the
horizon: first only the instants next to the target take part, then those twice as far.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined, row_scratch, run_over_rows
from jaxevent.reconstruction.compensated.solving import solve

CHANNELS = 4  # of packed images: log intensity, its variance, its gradient along x and y
OUTSIDE = np.float32(1e-6)  # weight of what lies outside the image
FARTHEST = np.float32(1.5)  # px, at the horizon: the longest step
_TAPS = np.array([1, 4, 6, 4, 1], np.float32) / np.float32(16)


class Smoothness(NamedTuple):
    """What is asked of trajectories beyond the images."""

    weight: float  # of differences between nodes (px^2 at the horizon)
    jump: float  # px, between nodes, beyond which differences count linearly
    edge: float  # ln I / px, the gradient over which nodes part
    straight: float  # draws the acceleration to 0


def pack(L: NDArray, V: NDArray) -> NDArray[np.float32]:
    """Images and their variances (K, h, w) with gradients: (K, h, w, 4)."""
    out = np.empty((*L.shape, CHANNELS), np.float32)
    run_over_rows(_pack, L.shape[1], np.asarray(L, np.float32), np.asarray(V, np.float32), out)
    return out


@njit_noalloc_inlined
def _gradient(image, y, x):
    """Along x and y; five taps: exact for polynomials of degree 4."""
    h, w = image.shape
    up, down, up2, down2 = max(y - 1, 0), min(y + 1, h - 1), max(y - 2, 0), min(y + 2, h - 1)
    left, right, left2, right2 = max(x - 1, 0), min(x + 1, w - 1), max(x - 2, 0), min(x + 2, w - 1)
    eight, twelfth = np.float32(8), np.float32(1 / 12)
    gx = eight * (image[y, right] - image[y, left]) - image[y, right2] + image[y, left2]
    gy = eight * (image[down, x] - image[up, x]) - image[down2, x] + image[up2, x]
    return gx * twelfth, gy * twelfth


@njit_noalloc
def _pack(begin, end, L, V, out):
    count, h, w = L.shape
    for k in range(count):
        for y in range(begin, end):
            for x in range(w):
                out[k, y, x, 0] = L[k, y, x]
                out[k, y, x, 1] = V[k, y, x]
                out[k, y, x, 2], out[k, y, x, 3] = _gradient(L[k], y, x)


@njit_noalloc
def _halve(begin, end, images, room, out):
    """Blur by `_TAPS` along both axes and keep every second: half the size."""
    count, h, w = images.shape
    column = room[begin]
    for k in range(count):
        for y in range(begin, end):
            for x in range(w):
                total = np.float32(0)
                for i in range(5):
                    total += _TAPS[i] * images[k, min(max(2 * y + i - 2, 0), h - 1), x]
                column[x] = total
            for x in range(out.shape[2]):
                total = np.float32(0)
                for j in range(5):
                    total += _TAPS[j] * column[min(max(2 * x + j - 2, 0), w - 1)]
                out[k, y, x] = total


def halve(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images (K, h, w) at half the resolution, rounded up."""
    count, h, w = images.shape
    out = np.empty((count, (h + 1) // 2, (w + 1) // 2), np.float32)
    run_over_rows(_halve, out.shape[1], images, row_scratch(out.shape[1], w), out)
    return out


@njit_noalloc_inlined
def between(values, y, x, out):
    """Values (rows, columns, 4) of nodes at the pixel y, x, bilinear."""
    rows, columns, _ = values.shape
    at_y = min(
        max(np.float32(y) * np.float32(0.5) - np.float32(0.25), np.float32(0)), np.float32(rows - 1)
    )
    at_x = min(
        max(np.float32(x) * np.float32(0.5) - np.float32(0.25), np.float32(0)),
        np.float32(columns - 1),
    )
    i, j = int(at_y), int(at_x)
    i1, j1 = min(i + 1, rows - 1), min(j + 1, columns - 1)
    fy, fx = at_y - np.float32(i), at_x - np.float32(j)
    for c in range(4):
        top = values[i, j, c] + fx * (values[i, j1, c] - values[i, j, c])
        bottom = values[i1, j, c] + fx * (values[i1, j1, c] - values[i1, j, c])
        out[c] = top + fy * (bottom - top)


@njit_noalloc_inlined
def around(X, Y, h, w):
    """Whether a point lies in an image, the pixels around it (or its border) and its place there.

    inside, x0, y0, x1, y1, fx, fy.
    """
    zero = np.float32(0)
    inside = -0.5 <= X <= w - 0.5 and -0.5 <= Y <= h - 0.5
    X = min(max(X, zero), np.float32(w - 1))
    Y = min(max(Y, zero), np.float32(h - 1))
    x0, y0 = min(int(X), max(w - 2, 0)), min(int(Y), max(h - 2, 0))
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    return inside, x0, y0, x1, y1, X - np.float32(x0), Y - np.float32(y0)


class Row(NamedTuple):
    """Room for points of a row, for each row that kernels begin with."""

    path: NDArray[np.float32]  # (rows, 4, points)
    x: NDArray[np.float32]  # (rows, points), px, at the target
    pixel: NDArray[np.int32]  # (rows, 2, points), x and y of the pixel before each point
    part: NDArray[np.float32]  # (rows, 2, points), of a pixel beyond that
    inside: NDArray[np.float32]  # (rows, points), 1, or 0 beyond the image's border

    @classmethod
    def over(cls, rows: int, points: int) -> "Row":
        """For `run_over_rows`."""
        path, part = row_scratch(rows, 4, points), row_scratch(rows, 2, points)
        x, inside = row_scratch(rows, points), row_scratch(rows, points)
        return cls(path, x, np.empty((rows, 2, points), np.int32), part, inside)


@njit_noalloc_inlined
def locate(path, x, y, s, size, pixel, part, inside):
    """Where points of a row are at an instant; arguments are as the parts of a `Row`."""
    h, w = size
    one, zero, half = np.float32(1), np.float32(0), np.float32(0.5)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    last_x, last_y = np.int32(max(w - 2, 0)), np.int32(max(h - 2, 0))
    for i in range(len(x)):
        X = x[i] + (path[0, i] + path[2, i] * s) * s
        Y = y + (path[1, i] + path[3, i] * s) * s
        here = (X >= -half) & (X <= right + half) & (Y >= -half) & (Y <= bottom + half)
        inside[i] = one if here else zero
        # So that what is no number becomes 0, too: it must not point outside.
        X, Y = X if X > zero else zero, Y if Y > zero else zero
        X, Y = min(X, right), min(Y, bottom)
        x0, y0 = min(np.int32(X), last_x), min(np.int32(Y), last_y)
        pixel[0, i], pixel[1, i] = x0, y0
        part[0, i], part[1, i] = X - np.float32(x0), Y - np.float32(y0)


@njit_noalloc_inlined
def weigh(V, inside, floor, W):
    """The information of values of these variances."""
    one = np.float32(1)
    for i in range(len(V)):
        W[i] = one / (V[i] + floor) if inside[i] > 0 else OUTSIDE


@njit_noalloc_inlined
def robust_means(values, W, near, nu, R, sums, means):
    """Means of values (K, points) with information W, and their weights R in it.

    The near instants decide first what the target looks like; then robustly all of them. `sums`
    (2, points) is room.
    """
    one, total, mean = np.float32(1), sums[0], sums[1]
    for turn in range(3):
        for i in range(len(means)):
            total[i], mean[i] = np.float32(0), np.float32(0)
        for k in range(len(values)):
            level, info, weight, early = values[k], W[k], R[k], near[k]
            if turn == 0:
                for i in range(len(means)):
                    weight[i] = info[i] * early
            else:
                for i in range(len(means)):
                    e = level[i] - means[i]
                    weight[i] = info[i] / (one + e * e * info[i] / nu)
            for i in range(len(means)):
                total[i] += weight[i]
                mean[i] += weight[i] * level[i]
        for i in range(len(means)):
            means[i] = mean[i] / total[i]


@njit_noalloc_inlined
def _read(image, pixel, part, k, points):
    """An image's channels at points, bilinear: (4, K, points)."""
    h, w, _ = image.shape
    one = np.float32(1)
    for i in range(pixel.shape[1]):
        x0, y0, fx, fy = pixel[0, i], pixel[1, i], part[0, i], part[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b = (one - fy) * (one - fx), (one - fy) * fx
        c, d = fy * (one - fx), fy * fx
        for q in range(4):
            points[q, k, i] = (
                a * upper[x0, q] + b * upper[x1, q] + c * lower[x0, q] + d * lower[x1, q]
            )


@njit_noalloc
def _fetch(begin, end, images, s, near, p, floor, nu, row, W, sums, points, M):
    """Images along trajectories of some rows, (h, 4, K, w): L, weight R, gradient; their mean."""
    count, h, w, _ = images.shape
    path, pixel, part, inside = (
        row.path[begin],
        row.pixel[begin],
        row.part[begin],
        row.inside[begin],
    )
    at, info = row.x[begin], W[begin]
    for x in range(w):
        at[x] = np.float32(x)
    for y in range(begin, end):
        for x in range(w):
            between(p, y, x, path[:, x])
        for k in range(count):
            locate(path, at, np.float32(y), s[k], (h, w), pixel, part, inside)
            _read(images[k], pixel, part, k, points[y])
            weigh(points[y, 1, k], inside, floor, info[k])
        robust_means(points[y, 0], info, near, nu, points[y, 1], sums[begin], M[y])


@njit_noalloc_inlined
def _add_product(a, b, out):
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@njit_noalloc_inlined
def _add_equations(points, s, M, slope, room, sums):
    """Add those of each pixel of a row to sums (14, w): N (10) and b (4).

    How values change with a path's four numbers is J = g (s, s^2), where the gradient g along
    trajectories and that of the mean, `slope` (2, w), are both that of the scene; the mean of the
    two has less noise. M, the mean of the values by R, is eliminated: J is J - sum R J / sum R.
    """
    J, total, means, r = room[:4], room[4], room[5:9], room[9]
    total[:] = np.float32(0)
    means[:] = np.float32(0)
    for k in range(len(s)):
        R = points[1, k]
        for c in range(2):
            for i in range(len(M)):
                J[c, i] = (points[2 + c, k, i] + slope[c, i]) * np.float32(0.5) * s[k]
            for i in range(len(M)):
                J[2 + c, i] = J[c, i] * s[k]
        for i in range(len(M)):
            total[i] += R[i]
        at = 0
        for c in range(4):
            for i in range(len(M)):
                r[i] = R[i] * J[c, i]
                means[c, i] += r[i]
                sums[10 + c, i] -= r[i] * (points[0, k, i] - M[i])
            for e in range(c, 4):
                _add_product(r, J[e], sums[at])
                at += 1
    at = 0
    for c in range(4):
        for i in range(len(M)):
            r[i] = -means[c, i] / total[i]
        for e in range(c, 4):
            _add_product(r, means[e], sums[at])
            at += 1


@njit_noalloc
def _linearise(begin, end, points, s, M, room, N, b, edge):
    """Normal equations of the nodes of some rows: N (10 entries), b (4); and |grad M|."""
    h, w = M.shape
    own, slope, sums = room[begin, :10], room[begin, 10:12], room[begin, 12:]
    for i in range(begin, end):
        sums[:] = np.float32(0)
        below = min(2 * i + 2, h)
        for y in range(2 * i, below):
            for x in range(w):
                gx, gy = _gradient(M, y, x)
                slope[0, x], slope[1, x] = gx, gy
                sums[14, x] += np.sqrt(gx * gx + gy * gy)
            _add_equations(points[y], s, M[y], slope, own, sums)
        for j in range(N.shape[1]):
            left, right = 2 * j, min(2 * j + 1, w - 1)
            both = np.float32(right - left)  # 0 or 1
            share = np.float32(1) / (np.float32(below - 2 * i) * (np.float32(1) + both))
            for c in range(15):
                mean = (sums[c, left] + both * sums[c, right]) * share
                if c < 10:
                    N[i, j, c] = mean
                elif c < 14:
                    b[i, j, c - 10] = mean
                else:
                    edge[i, j] = mean


def soften(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nodes (rows, columns, channels) blurred by (1, 6, 1) / 8: by a Gaussian of 1 px."""
    out = np.empty_like(values)
    _soften(values, np.empty_like(values[0]), out)
    return out


@njit_noalloc
def _soften(values, row, out):
    rows, columns, channels = values.shape
    for i in range(rows):
        up, down = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            for c in range(channels):
                row[j, c] = (
                    values[up, j, c] + np.float32(6) * values[i, j, c] + values[down, j, c]
                ) / np.float32(8)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            for c in range(channels):
                out[i, j, c] = (
                    row[left, c] + np.float32(6) * row[j, c] + row[right, c]
                ) / np.float32(8)


@njit_noalloc
def _weigh_differences(p, edge, reach, smoothness, across, down):
    """Weights of the differences between neighbouring nodes; `reach` is the horizon."""
    rows, columns, _ = p.shape
    jump, scale = np.float32(smoothness.jump), np.float32(smoothness.edge)
    for i in range(rows):
        for j in range(columns):
            for turn in range(2):
                i1, j1 = i + (turn == 1), j + (turn == 0)
                if i1 >= rows or j1 >= columns:
                    continue
                dx, dy = (p[i1, j1, 0] - p[i, j, 0]) * reach, (p[i1, j1, 1] - p[i, j, 1]) * reach
                weight = jump / np.sqrt(dx * dx + dy * dy + jump * jump)
                slope = (edge[i, j] + edge[i1, j1]) * np.float32(0.5)
                weight *= np.float32(0.1) + np.float32(0.9) * np.exp(-slope / scale)
                if turn == 0:
                    across[i, j] = weight
                else:
                    down[i, j] = weight


@njit_noalloc_inlined
def _median(a, b, c):
    return max(min(a, b), min(max(a, b), c))


@njit_noalloc
def _move(p, d, farthest, moved, sorted_rows, out):
    """p + d, each channel of d no longer than `farthest`, then the median of 3 x 3 nodes.

    All are (rows, columns * channels). `moved` is room, and so is `sorted_rows`, which is longer by
    a node at both ends.
    """
    rows, width = p.shape
    channels = len(farthest)
    for i in range(rows):
        for c in range(channels):
            for j in range(c, width, channels):
                moved[i, j] = p[i, j] + min(max(d[i, j], -farthest[c]), farthest[c])
    low, middle, high = sorted_rows[0], sorted_rows[1], sorted_rows[2]
    for i in range(rows):
        up, here, down = moved[max(i - 1, 0)], moved[i], moved[min(i + 1, rows - 1)]
        for j in range(width):
            low[channels + j] = min(min(up[j], here[j]), down[j])
            middle[channels + j] = _median(up[j], here[j], down[j])
            high[channels + j] = max(max(up[j], here[j]), down[j])
        for line in (low, middle, high):
            for c in range(channels):
                line[c], line[channels + width + c] = line[channels + c], line[width + c]
        # The median of nine lies between the largest of the smallest and the smallest of the
        # largest of three columns.
        for j in range(width):
            k, m = j + channels, j + 2 * channels
            least = max(max(low[j], low[k]), low[m])
            most = min(min(high[j], high[k]), high[m])
            out[i, j] = _median(least, _median(middle[j], middle[k], middle[m]), most)


def _moved(p: NDArray[np.float32], d: NDArray[np.float32], reach: np.float32) -> NDArray:
    """Nodes after a step d, which at the horizon is no longer than `FARTHEST`."""
    rows, columns, channels = p.shape
    out, flat = np.empty_like(p), (rows, columns * channels)
    farthest = FARTHEST / np.repeat([reach, reach * reach / 4], 2).astype(np.float32)
    sorted_rows = np.empty((3, flat[1] + 2 * channels), np.float32)
    moved = np.empty(flat, np.float32)
    _move(p.reshape(flat), d.reshape(flat), farthest, moved, sorted_rows, out.reshape(flat))
    return out


def step(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    p: NDArray[np.float32],
    floor: float,
    nu: float,
    smoothness: Smoothness,
    iterations: int = 12,
) -> NDArray[np.float32]:
    """One Gauss-Newton step of p (rows, columns, 4) on packed images (K, h, w, 4) at s (K,)."""
    reach = np.float32(max(float(np.abs(s).max()), 1e-3))
    near = np.exp(-2 * (s / reach) ** 2).astype(np.float32)
    N, b, edge = linearise(*fetch(images, s, near, p, floor, nu), s)
    across, down = (np.zeros(edge.shape, np.float32) for _ in range(2))
    _weigh_differences(p, edge, reach, smoothness, across, down)
    reach2 = reach * reach
    smooth = np.float32(smoothness.weight) * reach2 * np.array([1, 1, reach2, reach2], np.float32)
    bend = np.float32(smoothness.straight) * reach2 * reach2
    tiny = np.float32(1e-5) * smooth[0]
    ridge = np.array([tiny, tiny, bend, bend], np.float32)
    d = solve(soften(N), soften(b), p, across, down, smooth, ridge, iterations)
    return _moved(p, d, reach)


def fetch(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    near: NDArray[np.float32],
    p: NDArray[np.float32],
    floor: float,
    nu: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What `_fetch` writes: of every pixel its instants' points, and their mean."""
    count, h, w, _ = images.shape
    points, M = np.empty((h, 4, count, w), np.float32), np.empty((h, w), np.float32)
    room = Row.over(h, w), row_scratch(h, count, w), row_scratch(h, 2, w)
    run_over_rows(
        _fetch, h, images, s, near, p, np.float32(floor), np.float32(nu), *room, points, M
    )
    return points, M


def linearise(
    points: NDArray[np.float32], M: NDArray[np.float32], s: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """What `_linearise` writes of what `fetch` returns: N, b and |grad M| of nodes."""
    h, w = M.shape
    shape = -(-h // 2), -(-w // 2)
    N, b = np.empty((*shape, 10), np.float32), np.empty((*shape, 4), np.float32)
    edge, room = np.empty(shape, np.float32), row_scratch(shape[0], 12 + 15, w)
    run_over_rows(_linearise, shape[0], points, s, M, room, N, b, edge)
    return N, b, edge


def misfit(
    images: NDArray[np.float32],
    s: NDArray[np.float32],
    p: NDArray[np.float32],
    floor: float,
    nu: float,
) -> float:
    """How badly packed images (K, h, w, 4) agree along trajectories: robust squares, a mean."""
    points, M = fetch(images, s, np.exp(-2 * s**2).astype(np.float32), p, floor, nu)
    return float(((points[:, 0] - M[:, None]) ** 2 * points[:, 1]).mean())


def by_clock(
    p: NDArray[np.float32], s: NDArray[np.float32], other: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Trajectories on another clock, on which the same instants s (K,) are at other times.

    v and a such that places differ least, squared, most of all near the target.
    """
    weight = np.exp(-(s**2) - other**2)[:, None]
    old, new = (np.stack([one, one**2], 1).astype(float) for one in (s, other))
    change = np.linalg.lstsq(weight * new, weight * old, rcond=None)[0]
    paths = p.reshape(*p.shape[:2], 2, 2)
    return np.einsum("ab,ijbc->ijac", change, paths).reshape(p.shape).astype(np.float32)


@njit_noalloc
def _resize(p, out, scale):
    """Nodes at another resolution, bilinear, displacements times `scale`."""
    rows, columns, channels = p.shape
    ratio = np.float32(1) / scale
    for i in range(out.shape[0]):
        at_y = (np.float32(i) + np.float32(0.5)) * ratio - np.float32(0.5)
        at_y = min(max(at_y, np.float32(0)), np.float32(rows - 1))
        i0 = int(at_y)
        i1, fy = min(i0 + 1, rows - 1), at_y - np.float32(i0)
        for j in range(out.shape[1]):
            at_x = (np.float32(j) + np.float32(0.5)) * ratio - np.float32(0.5)
            at_x = min(max(at_x, np.float32(0)), np.float32(columns - 1))
            j0 = int(at_x)
            j1, fx = min(j0 + 1, columns - 1), at_x - np.float32(j0)
            for c in range(channels):
                top = p[i0, j0, c] + fx * (p[i0, j1, c] - p[i0, j0, c])
                bottom = p[i1, j0, c] + fx * (p[i1, j1, c] - p[i1, j0, c])
                out[i, j, c] = scale * (top + fy * (bottom - top))


def resize(p: NDArray[np.float32], shape: tuple[int, int], finer: bool) -> NDArray[np.float32]:
    """Nodes (rows, columns, 4) for images of twice (`finer`) or half the resolution."""
    out = np.empty((*shape, p.shape[2]), np.float32)
    _resize(p, out, np.float32(2 if finer else 0.5))
    return out


class Pyramid:
    """Images and variances at full, half, quarter ... resolution, packed when first asked for."""

    def __init__(self, L: NDArray, V: NDArray, fade: float):
        self._levels = [(np.asarray(L, np.float32), np.asarray(V, np.float32))]
        self._packed: list[NDArray[np.float32]] = []
        self._fade = np.float32(fade)

    def __getitem__(self, level: int) -> NDArray[np.float32]:
        while len(self._packed) <= level:
            if len(self._levels) == len(self._packed):
                L, V = self._levels[-1]
                self._levels.append((halve(L), halve(V) * self._fade))
            self._packed.append(pack(*self._levels[len(self._packed)]))
        return self._packed[level]


class Stage(NamedTuple):
    """Some steps at some resolutions, of the instants within a horizon."""

    horizon: float
    levels: tuple[int, ...]  # 0: full resolution
    steps: int


def stages(s: NDArray, first: float, coarsest: int = 4) -> list[Stage]:
    """From nothing: the horizon doubles from `first` to all instants."""
    whole = float(np.abs(s).max())
    horizon = min(first, whole)
    found = [Stage(horizon, tuple(range(coarsest, 1, -1)), 3)]
    while found[-1].horizon < whole * 0.999:
        found.append(Stage(min(found[-1].horizon * 2, whole), (2, 1), 2))
    return [*found, Stage(whole, (1,), 2)]


def nodes(height: int, width: int, level: int) -> tuple[int, int]:
    """Rows and columns of the nodes of images of that size at a level."""
    return -(-height // 2 ** (level + 1)), -(-width // 2 ** (level + 1))


class Motion(NamedTuple):
    """Trajectories (rows, columns, 4) of images at a resolution, displacements in its pixels."""

    p: NDArray[np.float32]
    level: int

    def at(self, level: int, height: int, width: int) -> "Motion":
        """The same at another resolution of images of that full size."""
        p, now = self
        while now != level:
            finer = now > level
            now += -1 if finer else 1
            p = resize(p, nodes(height, width, now), finer)
        return Motion(p, level)


def follow(
    pyramid: Pyramid,
    s: NDArray[np.float32],
    plan: list[Stage],
    floor: float,
    nu: float,
    smoothness: Smoothness,
) -> Motion:
    """The motion after all stages of a plan, from none."""
    _, h, w, _ = pyramid[0].shape
    first = plan[0].levels[0]
    motion = Motion(np.zeros((*nodes(h, w, first), 4), np.float32), first)
    for stage in plan:
        chosen = np.abs(s) <= stage.horizon * 1.001
        for level in stage.levels:
            p = motion.at(level, h, w).p
            images = pyramid[level]
            if not chosen.all():
                images = np.ascontiguousarray(images[chosen])
            for _ in range(stage.steps):
                p = step(images, s[chosen], p, floor, nu, smoothness)
            motion = Motion(p, level)
    return motion


@njit_noalloc
def _advect(begin, end, p, s, out):
    rows, columns, _ = p.shape
    half = np.float32(0.5)  # nodes per px
    for i in range(begin, end):
        for j in range(columns):
            X, Y = np.float32(j), np.float32(i)
            for _ in range(4):
                _, j0, i0, j1, i1, fx, fy = around(X, Y, rows, columns)
                for c in range(4):
                    top = p[i0, j0, c] + fx * (p[i0, j1, c] - p[i0, j0, c])
                    bottom = p[i1, j0, c] + fx * (p[i1, j1, c] - p[i1, j0, c])
                    out[i, j, c] = top + fy * (bottom - top)
                X = np.float32(j) - half * (out[i, j, 0] + out[i, j, 2] * s) * s
                Y = np.float32(i) - half * (out[i, j, 1] + out[i, j, 3] * s) * s
            for c in range(2):
                out[i, j, c] += np.float32(2) * out[i, j, c + 2] * s


def advect(p: NDArray[np.float32], s: float, unit: float) -> NDArray[np.float32]:
    """Trajectories (rows, columns, 4) of the points visible at s, and on a clock of that unit.

    Args:
        p: Trajectories of the points visible at 0.
        s: The new target's time on the clock of `p`.
        unit: What 1 stands for on the new clock, in units of the old one.
    """
    out = np.empty_like(p)
    run_over_rows(_advect, len(p), p, np.float32(s), out)
    return out * np.array([unit, unit, unit**2, unit**2], np.float32)


@njit_noalloc
def _spread(begin, end, p, out):
    for y in range(begin, end):
        for x in range(out.shape[1]):
            between(p, y, x, out[y, x])


def spread(p: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """The paths of all pixels, (h, w, 4), from those of nodes."""
    out = np.empty((*size, 4), np.float32)
    run_over_rows(_spread, size[0], p, out)
    return out
