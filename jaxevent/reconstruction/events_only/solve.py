"""The log image of one window of events: a robust sparse problem, solved by numba on the host.

With u = M / c, the log image in thresholds, the image minimises

    E(u) = sum_k w_k tail^2 log(1 + (a_k u - d_k)^2 / (2 tail^2))                      rows (1)
         + sum_cells phi(q(u))                                                        prior (2)
         + 1/2 sum_x (grad u - g)' Lambda (grad u - g)                      other windows' events
         + leak / 2 sum_x u^2                                                                 (3)

a_k is the difference of two bilinear look-ups, w_k the weight of the row. E is smooth. Iteratively
reweighted least squares replace E by the quadratic with

    r_k = w_k / (1 + e_k^2 / (2 tail^2)),    s = gradient / (2 (q + edge^2))

for rows, and for each of the four differences of a cell. Conjugate gradients solve its normal
equations A u = b, preconditioned by the sum of the reciprocal diagonals of P' A P: the columns of P
are pixels, and blocks of 2, 4, 8, ... pixels a side (Bramble, Pasciak and Xu 1990), so that large
regions, which only their edges tie together, move as a whole.

At the solution dE/du = A u - b = 0 with the weights of u itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.reconstruction.events_only.prior import GradientPrior, SolverParams
from jaxevent.reconstruction.events_only.rows import EVENT, Rows

REWEIGHTINGS = 20
CG_LIMITS = (1e-3, 25)  # relative residual, and iterations
BLOCK_BITS = 1  # sides of blocks are powers of 2 to this
SAMPLES = 4  # perturbed solutions that the variance is the mean of
# Chosen on simulated scenes (experiments/studies/events_only.md): how much larger errors are than
# independent rows and the curvature at the solution say, and what is not known without any row.
VARIANCE_FACTOR = 1.5
UNSEEN_VARIANCE = 25.0  # squared thresholds
UNSEEN_INFORMATION = 0.13  # of rows about a pixel, in squared thresholds, from which it is seen
BLUR_PX = 1.5  # of variance and information


class Solution(NamedTuple):
    """The log image of a window, up to an offset."""

    log_image: Float[np.ndarray, "height width"]  # ln I
    variance: Float[np.ndarray, "height width"]  # (ln I)^2, of the difference from the mean
    unseen: Float[np.ndarray, "height width"]  # part of the variance, where rows say little
    residual: Float[np.ndarray, " rows"]  # thresholds
    weight: Float[np.ndarray, " rows"]  # r_k
    iterations: int  # of conjugate gradients, all together


class _System(NamedTuple):
    """The matrix A of a reweighted problem."""

    corner: NDArray[np.uint32]
    fraction: NDArray[np.float32]
    weight: NDArray[np.float32]
    across: NDArray[np.float32]  # (height, width) weights of differences with the pixel right
    down: NDArray[np.float32]  # and with the pixel below
    information: NDArray[np.float32]  # (height, width, 3) xx, xy, yy, or without rows if none
    leak: np.float32


class _ScratchArrays(NamedTuple):
    images: NDArray[np.float32]  # (5, height, width); the first has the reciprocal diagonal of A
    reciprocal: NDArray[np.float32]  # of the diagonals of P' A P, one size of blocks after another
    sums: NDArray[np.float32]  # over blocks


class _Preconditioner:
    """Diagonals of pixels and blocks."""

    def __init__(self, system: _System):
        self.shape = height, width = system.across.shape
        sizes, bits = [], BLOCK_BITS
        while 1 << bits < max(height, width):
            sizes.append((((height - 1) >> bits) + 1) * (((width - 1) >> bits) + 1))
            bits += BLOCK_BITS
        images = np.zeros((5, height, width), np.float32)
        self.arrays = _ScratchArrays(images, *np.zeros((2, sum(sizes)), np.float32))
        parts = np.split(self.arrays.reciprocal, np.cumsum(sizes))[:-1]
        self.parts = [images[0].reshape(-1), *parts]
        self.of_rows = [np.zeros_like(part) for part in self.parts]
        for k, part in enumerate(self.of_rows):
            _add_row_diagonal(system, k * BLOCK_BITS, part)

    def update(self, system: _System) -> None:
        """Take the image's part of A; the rows' part is that of their first weights."""
        for k, (part, of_rows) in enumerate(zip(self.parts, self.of_rows, strict=True)):
            part[:] = of_rows
            _add_image_diagonal(system, k * BLOCK_BITS, part)
            np.divide(1, part, out=part, where=part > 0)


def solve(
    rows: Rows,
    prior: GradientPrior | None = None,
    params: SolverParams | None = None,
    start: NDArray | None = None,
    *,
    variance: bool = True,
    seed: int = 0,
) -> Solution:
    """Find the log image that explains the rows of a window.

    Args:
        rows: Equations of the window.
        prior: Gradients that other windows of events determined.
        params: Numbers of the model.
        start: (height, width) ln I, an image to begin with.
        variance: Whether the variance is wanted; otherwise it is infinite.
        seed: Seed of the perturbations that give the variance.

    Returns:
        The image and its variance.
    """
    params = params or SolverParams()
    height, width = rows.shape
    c = np.float32(rows.threshold)
    u = np.zeros(rows.shape, np.float32) if start is None else (start / c).astype(np.float32)
    # Rows that look up the same pixels lie together in memory.
    order = np.argsort(rows.corner[:, 0], kind="stable")
    base = np.where(rows.kind == EVENT, 1, params.silence).astype(np.float32) * rows.weight
    base, change = base[order], rows.change[order]
    information = np.zeros((0, width, 3), np.float32)
    pull = np.zeros(rows.shape, np.float32)
    if prior is not None:
        L = (prior.information * c**2).astype(np.float32)
        information = np.ascontiguousarray(L.reshape(height, width, 4)[..., [0, 1, 3]])
        g = np.einsum("hwij,hwj->hwi", L, prior.gradient / c).astype(np.float32)
        _add_gradient_transposed(g, pull)
    system = _System(
        rows.corner[order],
        rows.fraction[order],
        base,
        *np.zeros((2, height, width), np.float32),
        information,
        np.float32(params.leak),
    )
    preconditioner = _Preconditioner(system)
    system = system._replace(weight=np.empty_like(base))
    residual, b = np.empty_like(base), np.empty_like(u)
    numbers = tuple(np.float32(v) for v in (params.tail, params.gradient, params.edge))
    iterations = 0
    for _ in range(REWEIGHTINGS):
        _reweight(system, u, (change, base), numbers, residual)
        b[:] = pull
        _add_transposed(system, change * system.weight, b)
        preconditioner.update(system)
        iterations += _conjugate_gradients(system, b, u, preconditioner.arrays, CG_LIMITS)
    _reweight(system, u, (change, base), numbers, residual)
    V = np.full(rows.shape, np.inf, np.float32)
    unseen = _unseen_variance(system, preconditioner.of_rows[0]) * c**2
    if variance:
        samples = _sample_variance(system, preconditioner, order, np.random.default_rng(seed))
        V = VARIANCE_FACTOR * c**2 * samples + unseen
    place = np.argsort(order, kind="stable")
    return Solution(u * c, V, unseen, residual[place], system.weight[place], iterations)


def _unseen_variance(system, of_rows):
    """Return the variance of pixels that neither rows nor the prior of gradients describe."""
    from scipy.ndimage import gaussian_filter

    seen, nothing = of_rows.copy(), np.zeros_like(system.across)
    _add_image_diagonal(system._replace(across=nothing, down=nothing, leak=np.float32(0)), 0, seen)
    seen = gaussian_filter(seen.reshape(system.across.shape), BLUR_PX)
    return UNSEEN_VARIANCE * np.exp(-seen / UNSEEN_INFORMATION)


def factor_information(xx: NDArray, xy: NDArray, yy: NDArray) -> NDArray:
    """Factor information, which may be singular, as F F'.

    Args:
        xx: (height, width) information along x.
        xy: That of both.
        yy: That along y.

    Returns:
        (height, width, 2, 2) F, a lower triangle.
    """
    factor = np.zeros((*xx.shape, 2, 2), np.float32)
    factor[..., 0, 0] = np.sqrt(np.maximum(xx, 0))
    factor[..., 1, 0] = xy / np.sqrt(np.maximum(xx, np.finfo(np.float32).tiny))
    factor[..., 1, 1] = np.sqrt(np.maximum(yy - factor[..., 1, 0] ** 2, 0))
    return factor


def _sample_variance(system, preconditioner, order, rng):
    """Perturb and solve: with b of covariance A, the solution has the covariance A^-1."""
    from scipy.ndimage import gaussian_filter

    height, width = system.across.shape
    total = np.zeros((height, width))
    factor = factor_information(*np.moveaxis(system.information, -1, 0))
    preconditioner.update(system)
    for _ in range(SAMPLES):
        b = np.zeros((height, width), np.float32)
        noise = rng.standard_normal(len(system.weight), np.float32)[order]
        _add_transposed(system, noise * np.sqrt(system.weight), b)
        n = rng.standard_normal((3, height, width), np.float32)
        across, down = np.sqrt(system.across) * n[0], np.sqrt(system.down) * n[1]
        b += np.sqrt(system.leak) * n[2] - across - down
        b[:, 1:] += across[:, :-1]
        b[1:] += down[:-1]
        n = rng.standard_normal((height, width, 2), np.float32)
        if len(system.information):
            _add_gradient_transposed(np.einsum("hwij,hwj->hwi", factor, n), b)
        z = np.zeros_like(b)
        _conjugate_gradients(system, b, z, preconditioner.arrays, CG_LIMITS)
        total += (z - z.mean()) ** 2
    return gaussian_filter(total / SAMPLES, BLUR_PX).astype(np.float32)


@njit_fastmath_inlined
def _row(system, k):
    """Return the pixels and the coefficients of row k."""
    width = system.across.shape[1]
    right, below = (
        np.uint32(min(width - 1, 1)),
        np.uint32(width if system.across.shape[0] > 1 else 0),
    )
    i, j = system.corner[k, 0], system.corner[k, 1]
    ax, ay = system.fraction[k, 0, 0], system.fraction[k, 0, 1]
    bx, by = system.fraction[k, 1, 0], system.fraction[k, 1, 1]
    one = np.float32(1)
    pixels = (
        i,
        i + right,
        i + below,
        i + below + right,
        j,
        j + right,
        j + below,
        j + below + right,
    )
    return pixels, (
        (one - ax) * (one - ay),
        ax * (one - ay),
        (one - ax) * ay,
        ax * ay,
        (bx - one) * (one - by),
        bx * (by - one),
        (bx - one) * by,
        -bx * by,
    )


@njit_fastmath_inlined
def _look_up(pixels, a, u):
    """Difference of the two look-ups of a row in the flat image u."""
    after = a[0] * u[pixels[0]] + a[1] * u[pixels[1]] + a[2] * u[pixels[2]] + a[3] * u[pixels[3]]
    before = a[4] * u[pixels[4]] + a[5] * u[pixels[5]] + a[6] * u[pixels[6]] + a[7] * u[pixels[7]]
    return after + before


@njit_fastmath_inlined
def _spread(pixels, a, value, out):
    """Add the transposed of a row times a value to the flat image `out`."""
    out[pixels[0]] += a[0] * value
    out[pixels[1]] += a[1] * value
    out[pixels[2]] += a[2] * value
    out[pixels[3]] += a[3] * value
    out[pixels[4]] += a[4] * value
    out[pixels[5]] += a[5] * value
    out[pixels[6]] += a[6] * value
    out[pixels[7]] += a[7] * value


@njit_fastmath
def _add_transposed(system, values, out):
    """Add D' values to the image `out`."""
    flat = out.reshape(-1)
    for k in range(len(values)):
        pixels, a = _row(system, k)
        _spread(pixels, a, values[k], flat)


@njit_fastmath_inlined
def _neighbours(k, n):
    """Return the indices before and after k, and the scale of their difference."""
    before, after = max(k - 1, 0), min(k + 1, n - 1)
    return before, after, np.float32(1) / np.float32(max(after - before, 1))


@njit_fastmath
def _add_gradient_transposed(g, out):
    """Add the transposed of the gradient times g (height, width, 2) to `out`."""
    height, width = out.shape
    for y in range(height):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            out[y, right] += sx * g[y, x, 0]
            out[y, left] -= sx * g[y, x, 0]
            out[below, x] += sy * g[y, x, 1]
            out[above, x] -= sy * g[y, x, 1]


@njit_fastmath
def _apply(system, u, out):
    """Write A u to `out`."""
    height, width = u.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = system.leak * u[y, x]
        for x in range(width - 1):
            out[y, x] -= system.across[y, x] * (u[y, x + 1] - u[y, x])
        for x in range(1, width):
            out[y, x] += system.across[y, x - 1] * (u[y, x] - u[y, x - 1])
        if y > 0:
            for x in range(width):
                out[y, x] += system.down[y - 1, x] * (u[y, x] - u[y - 1, x])
        if y + 1 < height:
            for x in range(width):
                out[y, x] -= system.down[y, x] * (u[y + 1, x] - u[y, x])
    for y in range(len(system.information)):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            xx, xy = system.information[y, x, 0], system.information[y, x, 1]
            yy = system.information[y, x, 2]
            gx, gy = sx * (u[y, right] - u[y, left]), sy * (u[below, x] - u[above, x])
            hx, hy = sx * (xx * gx + xy * gy), sy * (xy * gx + yy * gy)
            out[y, right] += hx
            out[y, left] -= hx
            out[below, x] += hy
            out[above, x] -= hy
    flat, image = out.reshape(-1), u.reshape(-1)
    for k in range(len(system.weight)):
        pixels, a = _row(system, k)
        _spread(pixels, a, system.weight[k] * _look_up(pixels, a, image), flat)


@njit_fastmath
def _add_row_diagonal(system, bits, out):
    """Add diag(P' D' W D P) to `out`, with blocks of 2^bits pixels a side as columns of P."""
    height, width = system.across.shape
    columns = ((width - 1) >> bits) + 1
    reciprocal = np.float32(1) / np.float32(width)
    for k in range(len(system.weight)):
        pixels, a = _row(system, k)
        ya = int((np.float32(pixels[0]) + np.float32(0.5)) * reciprocal)
        yb = int((np.float32(pixels[4]) + np.float32(0.5)) * reciprocal)
        xa, xb = int(pixels[0]) - ya * width, int(pixels[4]) - yb * width
        xc, yc = min(xa + 1, width - 1) >> bits, (min(ya + 1, height - 1) >> bits) * columns
        xd, yd = min(xb + 1, width - 1) >> bits, (min(yb + 1, height - 1) >> bits) * columns
        xa, ya, xb, yb = xa >> bits, (ya >> bits) * columns, xb >> bits, (yb >> bits) * columns
        if xa == xb and xa == xc and xa == xd and ya == yb and ya == yc and ya == yd:
            continue  # a row inside one block does not move with it
        blocks = (ya + xa, ya + xc, yc + xa, yc + xc, yb + xb, yb + xd, yd + xb, yd + xd)
        # (sum a)^2 over each block, as the sum of all products of two entries of a block.
        for m in range(8):
            total = np.float32(0)
            for n in range(8):
                if blocks[n] == blocks[m]:
                    total += a[n]
            out[blocks[m]] += system.weight[k] * a[m] * total


@njit_fastmath
def _add_image_diagonal(system, bits, out):
    """Add diag(P' B P) to `out`, where B is A without its rows."""
    height, width = system.across.shape
    columns = ((width - 1) >> bits) + 1
    for y in range(height):
        i = (y >> bits) * columns
        for x in range(width):
            out[i + (x >> bits)] += system.leak
        for x in range(((1 << bits) - 1), width - 1, 1 << bits):
            out[i + (x >> bits)] += system.across[y, x]
            out[i + (x >> bits) + 1] += system.across[y, x]
        if y + 1 < height and (y + 1) >> bits != y >> bits:
            for x in range(width):
                out[i + (x >> bits)] += system.down[y, x]
                out[i + columns + (x >> bits)] += system.down[y, x]
    for y in range(len(system.information)):
        above, below, sy = _neighbours(y, height)
        above, below = (above >> bits) * columns, (below >> bits) * columns
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            left, right, i = left >> bits, right >> bits, (y >> bits) * columns
            xx, yy = system.information[y, x, 0], system.information[y, x, 2]
            if left != right:
                out[i + left] += sx * sx * xx
                out[i + right] += sx * sx * xx
            if above != below:
                out[above + (x >> bits)] += sy * sy * yy
                out[below + (x >> bits)] += sy * sy * yy


@njit_fastmath
def _precondition(scratch, r, z):
    """Write the reciprocal diagonals of pixels and blocks, applied to r, to z."""
    height, width = r.shape
    inverse, sums = scratch.images[0], scratch.sums
    rows, columns = height, width
    begin, end = 0, 0
    # Sums over blocks, each size from the one below.
    while max(rows, columns) > 1 and end < len(sums):
        fine, fine_columns, fine_rows = begin, columns, rows
        rows, columns = ((rows - 1) >> BLOCK_BITS) + 1, ((columns - 1) >> BLOCK_BITS) + 1
        begin, end = end, end + rows * columns
        for k in range(begin, end):
            sums[k] = 0
        for y in range(fine_rows):
            i = begin + (y >> BLOCK_BITS) * columns
            for x in range(fine_columns):
                sums[i + (x >> BLOCK_BITS)] += (
                    r[y, x] if begin == 0 else sums[fine + y * fine_columns + x]
                )
    for k in range(len(sums)):
        sums[k] *= scratch.reciprocal[k]
    # Corrections of each size are added to the one below.
    bits = 0
    while 1 << (bits + BLOCK_BITS) < max(height, width):
        bits += BLOCK_BITS
    while bits > BLOCK_BITS:
        rows, columns = ((height - 1) >> bits) + 1, ((width - 1) >> bits) + 1
        bits -= BLOCK_BITS
        fine_rows, fine_columns = ((height - 1) >> bits) + 1, ((width - 1) >> bits) + 1
        begin = end - rows * columns
        fine = begin - fine_rows * fine_columns
        for y in range(fine_rows):
            i = begin + (y >> BLOCK_BITS) * columns
            for x in range(fine_columns):
                sums[fine + y * fine_columns + x] += sums[i + (x >> BLOCK_BITS)]
        end = begin
    columns = ((width - 1) >> BLOCK_BITS) + 1
    for y in range(height):
        i = (y >> BLOCK_BITS) * columns
        for x in range(width):
            z[y, x] = inverse[y, x] * r[y, x]
        if len(sums):
            for x in range(width):
                z[y, x] += sums[i + (x >> BLOCK_BITS)]


@njit_fastmath
def _reweight(system, u, data, numbers, residual):
    """Write the residuals and weights of the image u, and the weights of its differences."""
    change, base = data
    tail, gradient, edge = numbers
    image = u.reshape(-1)
    for k in range(len(change)):
        pixels, a = _row(system, k)
        e = _look_up(pixels, a, image) - change[k]
        residual[k] = e
        system.weight[k] = base[k] / (1 + e * e / (2 * tail * tail))
    height, width = u.shape
    for y in range(height):
        for x in range(width):
            system.across[y, x] = 0
            system.down[y, x] = 0
    for y in range(height - 1):
        for x in range(width - 1):
            a, b = u[y, x + 1] - u[y, x], u[y + 1, x + 1] - u[y + 1, x]
            c, d = u[y + 1, x] - u[y, x], u[y + 1, x + 1] - u[y, x + 1]
            q = (a * a + b * b + c * c + d * d) / 2
            s = gradient / (2 * (q + edge * edge))
            system.across[y, x] += s
            system.across[y + 1, x] += s
            system.down[y, x] += s
            system.down[y, x + 1] += s


@njit_fastmath_inlined
def _dot(a, b):
    total = np.float32(0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit_fastmath
def _conjugate_gradients(system, b, u, scratch, stop):
    """Solve A u = b from u on, in place; return the number of iterations."""
    tolerance, limit = stop
    r, p, Ap, z = scratch.images[1], scratch.images[2], scratch.images[3], scratch.images[4]
    fu, fb, fr = u.reshape(-1), b.reshape(-1), r.reshape(-1)
    fp, fA, fz = p.reshape(-1), Ap.reshape(-1), z.reshape(-1)
    n = len(fu)
    _precondition(scratch, b, z)
    norm = _dot(fb, fz)
    _apply(system, u, Ap)
    for k in range(n):
        fr[k] = fb[k] - fA[k]
    _precondition(scratch, r, z)
    rho = _dot(fr, fz)
    for k in range(n):
        fp[k] = fz[k]
    for iteration in range(limit):
        if rho <= tolerance * tolerance * norm:
            return iteration
        _apply(system, p, Ap)
        alpha = rho / _dot(fp, fA)
        for k in range(n):
            fu[k] += alpha * fp[k]
            fr[k] -= alpha * fA[k]
        _precondition(scratch, r, z)
        new = _dot(fr, fz)
        beta = new / rho
        for k in range(n):
            fp[k] = fz[k] + beta * fp[k]
        rho = new
    return limit
