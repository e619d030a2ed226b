"""The loops over events of the photometric fit, compiled: where events lie, misfits, J and J'.

Events are in the order of their tracks: of the k-th they are those from `begin[k]` on, and the last
of `begin` is the number of all. The map is a quadratic B-spline of 1 px, depths are interpolated
between nodes.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.kernels import fast, fast_part

POWERS = 5  # of time, of the path's polynomials
LOOKS = 16  # depths on a ray that are looked at, at most
APART = 1.0  # px on the ray between them, but for those that are so many
FOLD = 0.3  # the least slope, along the ray of an event, of log depth less that of the scene


class Grids(NamedTuple):
    """Where the map's pixels and the nodes lie."""

    x: float  # px, of pixel and node [0, 0]
    y: float
    height: int  # of the map
    width: int
    node: float  # px between nodes
    rows: int  # of nodes
    columns: int


class Points(NamedTuple):
    """Events or other points: where they were seen (px, 0 at the principal point), and when."""

    x: NDArray
    y: NDArray
    tau: NDArray  # s


class Motion(NamedTuple):
    """A path's polynomials: factors (POWERS, 3) of tau, tau^2, ... of phi and C."""

    phi: NDArray[np.float64]
    C: NDArray[np.float64]
    f: float  # px


class Cells(NamedTuple):
    """Square cells of the reference view, row by row."""

    corner: tuple[float, float]  # px, where the first pixel of the first lies
    size: int  # px
    rows: int
    columns: int


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


@fast_part
def _along(c, tau, axis):
    """sum_k c_k tau^k of one component, k from 1."""
    s = c[POWERS - 1, axis]
    for k in range(POWERS - 2, -1, -1):
        s = s * tau + c[k, axis]
    return s * tau


@fast_part
def _turned(a, b, c, x, y, z):
    """exp[phi]x of a point, to the sixth order of |phi|, which is below 1."""
    s = a * a + b * b + c * c
    one, two = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    dx, dy, dz = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
    return x + one * cx + two * dx, y + one * cy + two * dy, z + one * cz + two * dz


@fast_part
def _ray(motion, x, y, tau):
    """The ray of an event in the reference view, r + rho d: r and d."""
    phi, C, f = motion
    a, b, c = _along(phi, tau, 0), _along(phi, tau, 1), _along(phi, tau, 2)
    rx, ry, rz = _turned(a, b, c, x, y, f)
    z = max(rz / f, 0.05)
    rx, ry = rx / z, ry / z
    cz = _along(C, tau, 2)
    return rx, ry, f * _along(C, tau, 0) - cz * rx, f * _along(C, tau, 1) - cz * ry


@fast
def warp(points, rho, motion, X, Y):
    """Write where points of inverse depths rho are in the reference view."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = _ray(motion, x[e], y[e], tau[e])
        X[e], Y[e] = rx + rho[e] * dx, ry + rho[e] * dy


@fast_part
def _cell(x, y, cells):
    """The cell that a place is in, or the nearest one."""
    left, top = cells.corner
    i = min(max(int(np.floor((x - left + 0.5) / cells.size)), 0), cells.columns - 1)
    j = min(max(int(np.floor((y - top + 0.5) / cells.size)), 0), cells.rows - 1)
    return j * cells.columns + i


@fast
def assign(points, motion, rho, cells, number, X, Y):
    """Write the cell of every event, by where it is warped to with its cell's depth, and that."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = _ray(motion, x[e], y[e], tau[e])
        k = _cell(x[e], y[e], cells)
        for _ in range(2):
            k = _cell(rx + rho[k] * dx, ry + rho[k] * dy, cells)
        number[e], X[e], Y[e] = k, rx + rho[k] * dx, ry + rho[k] * dy


@fast_part
def _corner(x, y, grids):
    """The first of four nodes about a place, and the shares of the next column and row."""
    i = min(max((x - grids.x) / grids.node, 0.0), grids.columns - 1.001)
    j = min(max((y - grids.y) / grids.node, 0.0), grids.rows - 1.001)
    column, row = int(i), int(j)
    return row * grids.columns + column, i - column, j - row


@fast_part
def _between(depth, x, y, grids):
    """Log inverse depth between nodes, and its slopes per px along x and y."""
    k, u, v = _corner(x, y, grids)
    a, b, c, d = depth[k], depth[k + 1], depth[k + grids.columns], depth[k + grids.columns + 1]
    across, down = (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)
    level = a + u * (b - a) + v * (c - a + u * (d - c - b + a))
    return level, across / grids.node, down / grids.node


@fast_part
def _newton(depth, rx, ry, dx, dy, log_rho, grids):
    """The depth on a ray where the scene's is met, from one nearby."""
    rho = np.exp(log_rho)
    there, lx, ly = _between(depth, rx + rho * dx, ry + rho * dy, grids)
    return log_rho - (log_rho - there) / max(1 - rho * (lx * dx + ly * dy), FOLD)


@fast
def place(points, motion, depth, high, low, grids, X, Y):
    """Write where events are in the reference view: on the nearest surface their rays meet.

    On the ray of an event x = r + rho d, which the depths of the scene, rho'(x), meet where
    log rho = log rho'(r + rho d): once if they are smooth, more often beside an edge, where the
    surface of the largest rho hides the others. `high` and `low` bound depths about nodes.
    """
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = _ray(motion, x[e], y[e], tau[e])
        k = _corner(x[e], y[e], grids)[0]
        top, bottom = high[k] + 0.02, low[k] - 0.02
        # From near to far, the first of some depths that is not nearer than the scene's.
        rho = np.exp(top)
        value = top - _between(depth, rx + rho * dx, ry + rho * dy, grids)[0]
        root = top
        if value > 0:
            reach = np.sqrt(dx * dx + dy * dy) * (rho - np.exp(bottom)) / APART
            looks = min(1 + int(reach), LOOKS)
            step, before, root = (bottom - top) / looks, top, bottom
            less = np.exp(step)
            for _ in range(looks):
                rho *= less
                log_rho = before + step
                new = log_rho - _between(depth, rx + rho * dx, ry + rho * dy, grids)[0]
                if new <= 0:
                    root = before + step * value / max(value - new, 1e-6)
                    break
                before, value = log_rho, new
        for _ in range(2):
            root = _newton(depth, rx, ry, dx, dy, root, grids)
        rho = np.exp(root)
        X[e], Y[e] = rx + rho * dx, ry + rho * dy


@fast
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
            share = _share(m, b)
            s += share * (
                _share(0, a) * image[k] + _share(1, a) * image[k + 1] + _share(2, a) * image[k + 2]
            )
            k += width
        value[e] = s


@fast_part
def _share(m, t):
    """Of the m-th of three quadratic B-splines, t px beside the middle one."""
    return 0.75 - t * t if m == 1 else (0.5 + (m - 1) * t) ** 2 / 2


@fast_part
def _slope(m, t):
    return -2 * t if m == 1 else (m - 1) * 0.5 + t


@fast
def around(image, sums):
    """Write sums over squares of 5 px about each pixel of a map (height, width)."""
    height, width = image.shape
    rows = np.zeros((height, width + 4), image.dtype)
    for j in range(height):
        for k in range(max(j - 2, 0), min(j + 3, height)):
            for i in range(width):
                rows[j, i + 2] += image[k, i]
    for j in range(height):
        row = rows[j]
        for i in range(width):
            sums[j, i] = row[i] + row[i + 1] + row[i + 2] + row[i + 3] + row[i + 4]


@fast
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


@fast
def weigh(e, on, first, begin, limit, usual, plane, grids, weight):
    """Write events' weights, from those before; returns the places' cost and the events'.

    Events at a place of mean cost q cost 4 q / (1 + q / usual), of slope 1 at the usual q. A plane
    hides nothing of itself.
    """
    image = np.zeros((grids.height, grids.width), e.dtype)
    sums, number = np.empty_like(image), np.empty_like(image)
    flat, middle = image.reshape(-1), grids.width + 1
    left, cost = np.empty_like(e), np.empty_like(e)
    for k in range(len(e)):
        flat[first[k] + middle] += on[k]
    around(image, number)
    events, around_it = number.reshape(-1), sums.reshape(-1)
    of_places = 0.0
    for _ in range(2):
        left[:] = e
        subtract_mean(left, weight, begin)
        flat[:] = 0
        for k in range(len(e)):
            cost[k] = on[k] * left[k] ** 2 / (1 + left[k] ** 2 / limit)
            flat[first[k] + middle] += cost[k]
        around(image, sums)
        flat[:] = 0
        of_places = 0.0
        for k in range(len(e)):
            at = first[k] + middle
            n = max(events[at], 1.0)
            q = around_it[at] / n
            slope = 1.0 if plane else 4 / (1 + q / usual) ** 2
            of_places += on[k] * (q if plane else 4 * q / (1 + q / usual))
            flat[at] += on[k] * slope / n
        around(image, sums)
        for k in range(len(e)):
            weight[k] = on[k] / (1 + left[k] ** 2 / limit) ** 2 * around_it[first[k] + middle]
    return of_places, cost.sum()


@fast_part
def _by_coefficients(motion, t, rx, ry, rho, hx, hy):
    """Slopes by phi and C of hx X + hy Y, where (X, Y) is the end of an event's ray.

    Of a rotation dR x = J dphi x R x, J the left Jacobian of phi; J' w = w - one phi x w + two
    phi x (phi x w).
    """
    phi, C, f = motion
    gone = 1 - rho * _along(C, t, 2)
    wx = gone * (-rx * ry / f * hx - (f + ry * ry / f) * hy)
    wy = gone * ((f + rx * rx / f) * hx + rx * ry / f * hy)
    wz = gone * (-ry * hx + rx * hy)
    p, q, s = _along(phi, t, 0), _along(phi, t, 1), _along(phi, t, 2)
    a = p * p + q * q + s * s
    one, two = 0.5 - a / 24 + a * a / 720, 1 / 6 - a / 120 + a * a / 5040
    ax, ay, az = q * wz - s * wy, s * wx - p * wz, p * wy - q * wx
    return (
        wx - one * ax + two * (q * az - s * ay),
        wy - one * ay + two * (s * ax - p * az),
        wz - one * az + two * (p * ay - q * ax),
        rho * f * hx,
        rho * f * hy,
        -rho * (rx * hx + ry * hy),
    )


@fast
def slopes_by_coefficients(points, rho, motion, by, by_depth):
    """Write how points (n,) move, by phi and C (n, 6, 2), and by log inverse depth (n, 2)."""
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = _ray(motion, x[e], y[e], tau[e])
        by_depth[e, 0], by_depth[e, 1] = rho[e] * dx, rho[e] * dy
        for axis in range(2):
            h = 1.0 - axis
            six = _by_coefficients(motion, tau[e], rx, ry, rho[e], h, 1.0 - h)
            for n in range(6):
                by[e, n, axis] = six[n]


@fast
def differentiate(points, number, places, motion, half, depth, image, free, grids, slopes):
    """Write the slopes of misfits, of events where they lie on the nearest surface.

    x = r + rho(x) d, so (1 - d grad rho') dx is what dx were with rho held, d = rho (f C - C_z r).
    """
    x, y, tau = points
    X, Y, f = places.X, places.Y, motion.f
    for e in range(len(x)):
        t = tau[e]
        rx, ry, dx, dy = _ray(motion, x[e], y[e], t)
        log_rho, lx, ly = _between(depth, X[e], Y[e], grids)
        rho = np.exp(log_rho)
        k, slopes.across[e], slopes.down[e] = _corner(X[e], Y[e], grids)
        slopes.node[e] = k
        a, b, gx, gy = slopes.u[e], slopes.v[e], 0.0, 0.0
        k = slopes.first[e]
        for m in range(3):
            for n in range(3):
                value = image[k + m * grids.width + n]
                gx += _share(m, b) * _slope(n, a) * value
                gy += _slope(m, b) * _share(n, a) * value
        dx, dy = rho * dx, rho * dy
        slope = (gx * dx + gy * dy) / max(1 - lx * dx - ly * dy, FOLD)
        hx, hy = gx + slope * lx, gy + slope * ly
        here = places.inside[e] if free.path else 0.0
        by = _by_coefficients(motion, t, rx, ry, rho, here * hx, here * hy)
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
def blocks(slopes, weight, begin, width, columns, upper, mixed, lumped, diagonal):
    """Write blocks of J' W J: of coefficients and more, these with depths, and two diagonals.

    Coefficients come as `base` counts them, one after another, each with its powers. Of the depths'
    block `lumped` is each row's sum, of the map's `diagonal` counts events apart.
    """
    n, m = len(upper), 6 * POWERS
    rows = np.zeros((8, n), weight.dtype)
    mean = np.zeros(n, weight.dtype)
    upper[:] = 0
    mixed[:] = 0
    lumped[:] = 0
    diagonal[:] = 0
    for track in range(len(begin) - 1):
        start, stop = begin[track], begin[track + 1]
        if stop - start > len(rows):
            rows = np.zeros((2 * (stop - start), n), weight.dtype)
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
                    share = _share(i, slopes.v[e]) * _share(j, slopes.u[e])
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
def _ease_rest(system, t, depth, out_depth):
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
    way_t = _ease_rest(system, left_t, left_depth, better)
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
        better_t = _ease_rest(system, left_t, left_depth, better)
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
