"""Images of warped events, compiled: where a window's events fall, blurred, and summed over parts.

The pixel [j, i] of an image lies at (i, j) + corner, px. An event goes to its four pixels.
"""

import numpy as np

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined

ORDER = 5  # of exp(M tau)


@njit_fastmath_inlined
def splat(image, x, y, weight):
    """Add an event at (x, y) px from the corner; what falls outside the image counts nothing."""
    height, width = image.shape
    if not (x > -1 and y > -1 and x < width and y < height):
        return
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    if i >= 0 and j >= 0:
        image[j, i] += weight * (1 - u) * (1 - v)
    if i + 1 < width and j >= 0:
        image[j, i + 1] += weight * u * (1 - v)
    if i >= 0 and j + 1 < height:
        image[j + 1, i] += weight * (1 - u) * v
    if i + 1 < width and j + 1 < height:
        image[j + 1, i + 1] += weight * u * v


@njit_fastmath
def blur(image, work, times):
    """The image under [1 2 1] / 4 in x and in y, so many times, in place; black beyond the border.

    `work` is of the same shape.
    """
    height, width = image.shape
    quarter, half = image.dtype.type(0.25), image.dtype.type(0.5)
    for _ in range(times):
        for j in range(height):
            row, to = image[j], work[j]
            to[0] = half * row[0] + quarter * row[1]
            for i in range(1, width - 1):
                to[i] = quarter * (row[i - 1] + row[i + 1]) + half * row[i]
            to[width - 1] = half * row[width - 1] + quarter * row[width - 2]
        for i in range(width):
            image[0, i] = half * work[0, i] + quarter * work[1, i]
            image[height - 1, i] = half * work[height - 1, i] + quarter * work[height - 2, i]
        for j in range(1, height - 1):
            above, here, below, to = work[j - 1], work[j], work[j + 1], image[j]
            for i in range(width):
                to[i] = quarter * (above[i] + below[i]) + half * here[i]


@njit_fastmath
def segment_images(X, Y, tau, p, half, corner, images):
    """Add the signed images of segments of the window to `images` (S, height, width).

    Events beyond the border count nothing.
    """
    segments, height, width = images.shape
    for e in range(len(X)):
        x, y = X[e] - corner[0], Y[e] - corner[1]
        if x >= 0 and y >= 0 and x <= width - 1 and y <= height - 1:
            s = min(max(int((tau[e] + half) / (2 * half) * segments), 0), segments - 1)
            splat(images[s], x, y, p[e])


@njit_fastmath
def compare(images, cell, low, high, left, top, others, share, sums):
    """Write what segments show of cells against what all others do of the same.

    Cells are seen where their pixels, moved to a segment's time by (left, top) (S, cells), lie
    between `low` and `high`, px of the image. Written are images with the rest 0, those of the
    others, the share of each cell that is seen (S, cells), and of cells (S, cells, 4) sums of
    I T, T^2 and I^2, T the others' image.
    """
    segments, height, width = images.shape
    columns, real = width // cell, images.dtype.type
    for j in range(height):
        for i in range(width):
            k, total, seen, count = j // cell * columns + i // cell, real(0), 0, 0
            for s in range(segments):
                x, y = i + left[s, k], j + top[s, k]
                if x > low[0] and x < high[0] and y > low[1] and y < high[1]:
                    total += images[s, j, i]
                    seen, count = seen | 1 << s, count + 1
                    share[s, k] += 1
            scale = real(segments / count if count > 2 else 0)
            for s in range(segments):
                if not seen >> s & 1:
                    images[s, j, i] = others[s, j, i] = 0
                    continue
                own = images[s, j, i]
                other = (total - own) * scale
                others[s, j, i] = other
                sums[s, k, 0] += own * other
                sums[s, k, 1] += other * other
                sums[s, k, 2] += own * own


@njit_fastmath
def measure(images, others, gain, cell, sums):
    """Write sums over cells (S, cells, 6), of d = gain T - I and the slopes g of T.

    They are those of d^2, gx^2, gx gy, gy^2, gx d, gy d.
    """
    segments, height, width = images.shape
    columns = width // cell
    for s in range(segments):
        for j in range(height):
            for i in range(width):
                k = j // cell * columns + i // cell
                T = others[s]
                gx = ((T[j, i + 1] if i + 1 < width else 0) - (T[j, i - 1] if i else 0)) / 2
                gy = ((T[j + 1, i] if j + 1 < height else 0) - (T[j - 1, i] if j else 0)) / 2
                d = gain[s, k] * T[j, i] - images[s, j, i]
                to = sums[s, k]
                to[0] += d * d
                to[1] += gx * gx
                to[2] += gx * gy
                to[3] += gy * gy
                to[4] += gx * d
                to[5] += gy * d


@njit_fastmath
def contrast_and_slope(x, y, tau, p, M, basis, corner, f, blurs, image, work, terms, slope):
    """Minus the sum of squares of the blurred image of events moved by exp(M tau), and its slopes.

    Those by factors of `basis` (n, 3, 3), which M is the sum of, are written to `slope` (n,).
    `terms` (3, ORDER + 1, 3) is room.
    """
    image[:] = 0
    for e in range(len(x)):
        X, Y = moved(M, x[e], y[e], tau[e], f)
        splat(image, X - corner[0], Y - corner[1], p[e])
    blur(image, work, blurs)
    total = 0.0
    for j in range(image.shape[0]):
        for i in range(image.shape[1]):
            total -= float(image[j, i]) ** 2
    blur(image, work, blurs)
    by = terms[2]
    by[:] = 0
    for e in range(len(x)):
        # p_k = (M tau)^k (x, y, f) / f, of which sum_k p_k / k! is the place in homogeneous
        # coordinates. By M, g in these: sum_ij q_i p_j' tau / (i + j + 1)!, q_i = (M' tau)^i g.
        t, X, Y, Z = tau[e], x[e] / f, y[e] / f, 1.0
        p_k, q_k = terms[0], terms[1]
        p_k[0, 0], p_k[0, 1], p_k[0, 2] = X, Y, Z
        share = 1.0
        for k in range(1, ORDER + 1):
            share /= k
            for m in range(3):
                p_k[k, m] = t * (
                    M[m, 0] * p_k[k - 1, 0] + M[m, 1] * p_k[k - 1, 1] + M[m, 2] * p_k[k - 1, 2]
                )
            X, Y, Z = X + share * p_k[k, 0], Y + share * p_k[k, 1], Z + share * p_k[k, 2]
        px, py = f * X / Z, f * Y / Z
        gx, gy = slope_of(image, px - corner[0], py - corner[1])
        gx, gy = -2 * p[e] * gx / Z, -2 * p[e] * gy / Z
        q_k[0, 0], q_k[0, 1], q_k[0, 2] = f * gx, f * gy, -(gx * px + gy * py)
        before = t
        for i in range(ORDER):
            share = before / (i + 1)
            a, b, c, before = 0.0, 0.0, 0.0, share
            for j in range(ORDER - i):
                a, b, c = a + share * p_k[j, 0], b + share * p_k[j, 1], c + share * p_k[j, 2]
                share /= i + j + 2
            for m in range(3):
                by[m, 0] += q_k[i, m] * a
                by[m, 1] += q_k[i, m] * b
                by[m, 2] += q_k[i, m] * c
                q_k[i + 1, m] = t * (
                    M[0, m] * q_k[i, 0] + M[1, m] * q_k[i, 1] + M[2, m] * q_k[i, 2]
                )
    for n in range(len(slope)):
        slope[n] = 0
        for m in range(3):
            slope[n] += (
                basis[n, m, 0] * by[m, 0] + basis[n, m, 1] * by[m, 1] + basis[n, m, 2] * by[m, 2]
            )
    return total


@njit_fastmath_inlined
def moved(M, x, y, t, f):
    """Where exp(M t) takes a point."""
    a, b, c = x / f, y / f, 1.0
    X, Y, Z = a, b, c
    for k in range(1, ORDER + 1):
        s = t / k
        a, b, c = (
            s * (M[0, 0] * a + M[0, 1] * b + M[0, 2] * c),
            s * (M[1, 0] * a + M[1, 1] * b + M[1, 2] * c),
            s * (M[2, 0] * a + M[2, 1] * b + M[2, 2] * c),
        )
        X, Y, Z = X + a, Y + b, Z + c
    return f * X / Z, f * Y / Z


@njit_fastmath_inlined
def slope_of(image, x, y):
    """The slopes along x and y of an image between its pixels, 0 beyond it."""
    height, width = image.shape
    if not (x > -1 and y > -1 and x < width and y < height):
        return 0.0, 0.0
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    a = image[j, i] if i >= 0 and j >= 0 else 0.0
    b = image[j, i + 1] if i + 1 < width and j >= 0 else 0.0
    c = image[j + 1, i] if i >= 0 and j + 1 < height else 0.0
    d = image[j + 1, i + 1] if i + 1 < width and j + 1 < height else 0.0
    return (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)


@njit_fastmath
def turned(x, y, tau, M, f, X, Y):
    """Write where exp(M tau) takes events."""
    for e in range(len(x)):
        X[e], Y[e] = moved(M, x[e], y[e], tau[e], f)


@njit_fastmath
def flow_maps(x, y, tau, p, flows, corner, images, work, squares, S, N):
    """Write contrast and number of events of patches (flows, rows, columns), by flows (px/s).

    Patches are 24 px, 16 px apart: sums of 3 x 3 squares of 8 px. `images` (2, height, width)
    and `squares` (2, height // 8, width // 8) are room.
    """
    height, width = images.shape[1:]
    for n in range(len(flows)):
        images[:] = 0
        for e in range(len(x)):
            X, Y = x[e] - flows[n, 0] * tau[e], y[e] - flows[n, 1] * tau[e]
            splat(images[0], X - corner[0], Y - corner[1], p[e])
            splat(images[1], X - corner[0], Y - corner[1], images.dtype.type(1))
        blur(images[0], work, 1)
        squares[:] = 0
        for j in range(height // 8 * 8):
            signed, number = images[0, j], images[1, j]
            for i in range(width // 8):
                s = t = images.dtype.type(0)
                for k in range(8 * i, 8 * i + 8):
                    s += signed[k] * signed[k]
                    t += number[k]
                squares[0, j // 8, i] += s
                squares[1, j // 8, i] += t
        for j in range(S.shape[1]):
            for i in range(S.shape[2]):
                s = t = 0.0
                for m in range(3):
                    for k in range(3):
                        s += squares[0, 2 * j + m, 2 * i + k]
                        t += squares[1, 2 * j + m, 2 * i + k]
                S[n, j, i], N[n, j, i] = s, t


@njit_fastmath
def depth_maps(rays, p, depths, corner, node, spot, images, work, strips, S, N):
    """Write contrast and number of events about nodes (depths, rows, columns), by inverse depths.

    `rays` are r and d (4, events): at inverse depth rho an event lies at r + rho d. A node's are
    those of the square of `spot` px about it. `strips` (2, rows, width) is room.
    """
    rx, ry, dx, dy = rays
    height, width = images.shape[1:]
    rows, columns = S.shape[1:]
    before = spot // 2
    for n in range(len(depths)):
        images[:] = 0
        rho = depths[n]
        for e in range(len(rx)):
            X, Y = rx[e] + rho * dx[e] - corner[0], ry[e] + rho * dy[e] - corner[1]
            splat(images[0], X, Y, p[e])
            splat(images[1], X, Y, images.dtype.type(1))
        blur(images[0], work, 1)
        strips[:] = 0
        for j in range(rows):
            for k in range(max(j * node - before, 0), min(j * node - before + spot, height)):
                for i in range(width):
                    strips[0, j, i] += images[0, k, i] * images[0, k, i]
                    strips[1, j, i] += images[1, k, i]
        for j in range(rows):
            for i in range(columns):
                s = t = 0.0
                for k in range(max(i * node - before, 0), min(i * node - before + spot, width)):
                    s += strips[0, j, k]
                    t += strips[1, j, k]
                S[n, j, i], N[n, j, i] = s, t


@njit_fastmath
def block_sums(X, Y, p, corner, block, images, work, S, N):
    """Write contrast and number of events of blocks (rows, columns) of the image of events."""
    images[:] = 0
    for e in range(len(X)):
        splat(images[0], X[e] - corner[0], Y[e] - corner[1], p[e])
        splat(images[1], X[e] - corner[0], Y[e] - corner[1], images.dtype.type(1))
    blur(images[0], work, 1)
    blur(images[1], work, 1)
    S[:] = 0
    N[:] = 0
    for j in range(S.shape[0] * block):
        for i in range(S.shape[1] * block):
            S[j // block, i // block] += images[0, j, i] ** 2
            N[j // block, i // block] += images[1, j, i]
