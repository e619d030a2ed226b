"""The log image of one window of events: a robust sparse problem, solved by numba on the host.

With u = M / c, the log image in thresholds, the image minimises

    E(u) = sum_k w_k tail^2 log(1 + (a_k u - d_k)^2 / (2 tail^2))                      rows (1)
         + sum_cells phi(q(u))                                                         prior (2)
         + 1/2 sum_x (grad u - g)' Lambda (grad u - g)                      other windows' events
         + leak / 2 sum_x u^2                                                                 (3)

a_k is the difference of two bilinear look-ups, w_k the weight of the row. E is smooth. Iteratively
reweighted least squares replace E by the quadratic with

    r_k = w_k / (1 + e_k^2 / (2 tail^2)),    s = gradient / (2 (q + edge^2))

for rows, and for each of the four differences of a cell. Conjugate gradients solve its normal
equations A u = b, preconditioned by the diagonals of A over pixels and over blocks of pixels of
several sizes (Bramble, Pasciak and Xu 1990). At the solution dE/du = A u - b = 0 with the weights
of u itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.reconstruction.events_only.prior import GradientPrior, SolverParams
from jaxevent.reconstruction.events_only.rows import EVENT, Rows

REWEIGHTINGS = 8
CG_ITERATIONS = 25
CG_TOLERANCE = 1e-3
BLOCK_FACTOR = 3  # between the sides of blocks that precondition
SAMPLES = 4  # perturbed solutions that the variance is the mean of


class Solution(NamedTuple):
    """The log image of a window, up to an offset."""

    log_image: Float[np.ndarray, "height width"]  # ln I
    variance: Float[np.ndarray, "height width"]  # (ln I)^2, of the difference from the mean
    residual: Float[np.ndarray, " rows"]  # thresholds
    weight: Float[np.ndarray, " rows"]  # r_k
    iterations: int  # of conjugate gradients, all together


class _System(NamedTuple):
    """The matrix A of a reweighted problem."""

    corner: NDArray[np.int32]
    fraction: NDArray[np.float32]
    weight: NDArray[np.float32]
    across: NDArray[np.float32]  # (height, width) weights of differences with the pixel right
    down: NDArray[np.float32]  # and with the pixel below
    information: NDArray[np.float32]  # (height, width, 3) xx, xy, yy
    leak: float


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
        prior: What other windows say of the gradient.
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
    information = np.zeros((height, width, 3), np.float32)
    pull = np.zeros(rows.shape, np.float32)
    if prior is not None:
        L = prior.information * c**2
        information[:] = L.reshape(height, width, 4)[..., [0, 1, 3]]
        _add_gradient_transposed(
            np.einsum("hwij,hwj->hwi", L, prior.gradient / c).astype(np.float32), pull
        )
    base = np.where(rows.kind == EVENT, 1, params.silence).astype(np.float32) * rows.weight
    residual, weight = np.empty_like(rows.change), np.empty_like(rows.change)
    across, down = np.zeros(rows.shape, np.float32), np.zeros(rows.shape, np.float32)
    scratch = np.zeros((5, height, width), np.float32)
    system = _System(
        rows.corner, rows.fraction, weight, across, down, information, np.float32(params.leak)
    )
    numbers = tuple(np.float32(v) for v in params)
    iterations = 0
    b = np.empty_like(u)
    for _ in range(REWEIGHTINGS):
        _reweight(system, u, (rows.change, base), numbers, residual)
        b[:] = pull
        _add_transposed(system, rows.change * weight, b)
        iterations += _conjugate_gradients(system, b, u, scratch, CG_TOLERANCE, CG_ITERATIONS)
    _reweight(system, u, (rows.change, base), numbers, residual)
    V = np.full(rows.shape, np.inf, np.float32)
    if variance:
        V = _sample_variance(system, scratch, np.random.default_rng(seed)) * c**2
    return Solution(u * c, V, residual, weight, iterations)


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
    factor[..., 0, 0] = np.sqrt(xx)
    factor[..., 1, 0] = xy / np.sqrt(np.maximum(xx, np.finfo(np.float32).tiny))
    factor[..., 1, 1] = np.sqrt(np.maximum(yy - factor[..., 1, 0] ** 2, 0))
    return factor


def _sample_variance(system, scratch, rng):
    """Perturb and solve: with b of covariance A, the solution has the covariance A^-1."""
    from scipy.ndimage import gaussian_filter

    height, width = system.across.shape
    total = np.zeros((height, width))
    factor = factor_information(*np.moveaxis(system.information, -1, 0))
    for _ in range(SAMPLES):
        b = np.zeros((height, width), np.float32)
        noise = rng.standard_normal(len(system.weight), np.float32)
        _add_transposed(system, noise * np.sqrt(system.weight), b)
        n = rng.standard_normal((3, height, width), np.float32)
        across, down = np.sqrt(system.across) * n[0], np.sqrt(system.down) * n[1]
        b -= across + down
        b[:, 1:] += across[:, :-1]
        b[1:] += down[:-1]
        b += np.sqrt(system.leak) * n[2]
        noise = rng.standard_normal((height, width, 2), np.float32)
        _add_gradient_transposed(np.einsum("hwij,hwj->hwi", factor, noise).astype(np.float32), b)
        z = np.zeros_like(b)
        _conjugate_gradients(system, b, z, scratch, 1e-2, CG_ITERATIONS)
        total += (z - z.mean()) ** 2
    return gaussian_filter(total / SAMPLES, 1.5).astype(np.float32)


@njit_noalloc_inlined
def _bilinear(fraction, side, k):
    fx, fy = fraction[k, side, 0], fraction[k, side, 1]
    return (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy


@njit_noalloc_inlined
def _look_up(system, u, k):
    """Difference of the two look-ups of row k in the flat image u."""
    width = system.across.shape[1]
    i, j = system.corner[k, 0], system.corner[k, 1]
    a0, a1, a2, a3 = _bilinear(system.fraction, 0, k)
    b0, b1, b2, b3 = _bilinear(system.fraction, 1, k)
    after = a0 * u[i] + a1 * u[i + 1] + a2 * u[i + width] + a3 * u[i + width + 1]
    before = b0 * u[j] + b1 * u[j + 1] + b2 * u[j + width] + b3 * u[j + width + 1]
    return after - before


@njit_noalloc_inlined
def _spread(system, value, k, out):
    """Add the transposed of row k times a value to the flat image `out`."""
    width = system.across.shape[1]
    i, j = system.corner[k, 0], system.corner[k, 1]
    a0, a1, a2, a3 = _bilinear(system.fraction, 0, k)
    b0, b1, b2, b3 = _bilinear(system.fraction, 1, k)
    out[i] += a0 * value
    out[i + 1] += a1 * value
    out[i + width] += a2 * value
    out[i + width + 1] += a3 * value
    out[j] -= b0 * value
    out[j + 1] -= b1 * value
    out[j + width] -= b2 * value
    out[j + width + 1] -= b3 * value


@njit_noalloc
def _add_transposed(system, values, out):
    """Add D' values to the image `out`."""
    flat = out.reshape(-1)
    for k in range(len(values)):
        _spread(system, values[k], k, flat)


@njit_noalloc_inlined
def _neighbours(k, n):
    """Indices before and after k, and the scale of a central or one-sided difference."""
    before, after = max(k - 1, 0), min(k + 1, n - 1)
    return before, after, np.float32(1) / np.float32(max(after - before, 1))


@njit_noalloc
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


@njit_noalloc
def _apply(system, u, out):
    """Write A u to `out`."""
    height, width = u.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = system.leak * u[y, x]
    for y in range(height):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            if x + 1 < width:
                flow = system.across[y, x] * (u[y, x + 1] - u[y, x])
                out[y, x + 1] += flow
                out[y, x] -= flow
            if y + 1 < height:
                flow = system.down[y, x] * (u[y + 1, x] - u[y, x])
                out[y + 1, x] += flow
                out[y, x] -= flow
            xx, xy, yy = (
                system.information[y, x, 0],
                system.information[y, x, 1],
                system.information[y, x, 2],
            )
            if xx + yy > 0:
                left, right, sx = _neighbours(x, width)
                gx, gy = sx * (u[y, right] - u[y, left]), sy * (u[below, x] - u[above, x])
                hx, hy = sx * (xx * gx + xy * gy), sy * (xy * gx + yy * gy)
                out[y, right] += hx
                out[y, left] -= hx
                out[below, x] += hy
                out[above, x] -= hy
    flat, image = out.reshape(-1), u.reshape(-1)
    for k in range(len(system.weight)):
        _spread(system, system.weight[k] * _look_up(system, image, k), k, flat)


@njit_noalloc
def _write_diagonal(system, out):
    """Write the diagonal of A to `out`, look-ups that share pixels as if they did not."""
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = system.leak
    for y in range(height):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            across, down = system.across[y, x], system.down[y, x]
            if x + 1 < width:
                out[y, x] += across
                out[y, x + 1] += across
            if y + 1 < height:
                out[y, x] += down
                out[y + 1, x] += down
            xx, yy = sx * sx * system.information[y, x, 0], sy * sy * system.information[y, x, 2]
            out[y, right] += xx
            out[y, left] += xx
            out[below, x] += yy
            out[above, x] += yy
    flat = out.reshape(-1)
    for k in range(len(system.weight)):
        for side in range(2):
            i = system.corner[k, side]
            a0, a1, a2, a3 = _bilinear(system.fraction, side, k)
            flat[i] += system.weight[k] * a0 * a0
            flat[i + 1] += system.weight[k] * a1 * a1
            flat[i + width] += system.weight[k] * a2 * a2
            flat[i + width + 1] += system.weight[k] * a3 * a3


@njit_noalloc
def _reweight(system, u, data, numbers, residual):
    """Write the residuals and weights of the image u, and the weights of its differences."""
    change, base = data
    tail, gradient, edge = numbers[1], numbers[2], numbers[3]
    image = u.reshape(-1)
    for k in range(len(change)):
        e = _look_up(system, image, k) - change[k]
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


@njit_noalloc_inlined
def _dot(a, b):
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit_noalloc
def _write_block_diagonal(system, side, out):
    """Write 1 / (P' A P), with a block of side x side pixels as column of P, to `out`."""
    height, width = system.across.shape
    columns = (width + side - 1) // side
    for k in range(len(out)):
        out[k] = 0
    for y in range(height):
        for x in range(width):
            i = (y // side) * columns + x // side
            out[i] += system.leak
            if x + 1 < width and (x + 1) % side == 0:
                out[i] += system.across[y, x]
                out[i + 1] += system.across[y, x]
            if y + 1 < height and (y + 1) % side == 0:
                out[i] += system.down[y, x]
                out[i + columns] += system.down[y, x]
    for k in range(len(system.weight)):
        # Only blocks that the look-ups do not share as a whole.
        i0, j0 = system.corner[k, 0], system.corner[k, 1]
        ay, ax = i0 // width, i0 % width
        by, bx = j0 // width, j0 % width
        ya, xa, yb, xb = ay // side, ax // side, by // side, bx // side
        if (
            ya == yb
            and xa == xb
            and ya == (ay + 1) // side
            and xa == (ax + 1) // side
            and yb == (by + 1) // side
            and xb == (bx + 1) // side
        ):
            continue
        a0, a1, a2, a3 = _bilinear(system.fraction, 0, k)
        b0, b1, b2, b3 = _bilinear(system.fraction, 1, k)
        y0, x0 = min(ya, yb), min(xa, xb)
        y1, x1 = max((ay + 1) // side, (by + 1) // side), max((ax + 1) // side, (bx + 1) // side)
        w = system.weight[k]
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                e = np.float32(0)
                if ya == y:
                    e += (a0 if xa == x else 0) + (a1 if (ax + 1) // side == x else 0)
                if (ay + 1) // side == y:
                    e += (a2 if xa == x else 0) + (a3 if (ax + 1) // side == x else 0)
                if yb == y:
                    e -= (b0 if xb == x else 0) + (b1 if (bx + 1) // side == x else 0)
                if (by + 1) // side == y:
                    e -= (b2 if xb == x else 0) + (b3 if (bx + 1) // side == x else 0)
                out[y * columns + x] += w * e * e
    for k in range(len(out)):
        out[k] = 1 / out[k] if out[k] > 0 else np.float32(0)


@njit_noalloc
def _precondition(inverse, blocks, sums, r, z):
    """Write the sum of diagonal preconditioners of pixels and blocks, applied to r, to z."""
    height, width = r.shape
    for y in range(height):
        for x in range(width):
            z[y, x] = inverse[y, x] * r[y, x]
    side, begin = BLOCK_FACTOR, 0
    while begin < len(blocks):
        columns, rows = (width + side - 1) // side, (height + side - 1) // side
        for k in range(rows * columns):
            sums[k] = 0
        for y in range(height):
            i = (y // side) * columns
            for x in range(width):
                sums[i + x // side] += r[y, x]
        for k in range(rows * columns):
            sums[k] *= blocks[begin + k]
        for y in range(height):
            i = (y // side) * columns
            for x in range(width):
                z[y, x] += sums[i + x // side]
        begin += rows * columns
        side *= BLOCK_FACTOR


def _block_diagonals(system, shape):
    """Return the reciprocal diagonals of blocks of all sides, one after another."""
    height, width = shape
    side, parts = BLOCK_FACTOR, []
    while side < max(shape):
        part = np.empty(-(-height // side) * -(-width // side), np.float32)
        _write_block_diagonal(system, side, part)
        parts.append(part)
        side *= BLOCK_FACTOR
    return np.concatenate(parts) if parts else np.empty(0, np.float32)


def _conjugate_gradients(system, b, u, scratch, tolerance, limit):
    _write_diagonal(system, scratch[0])
    blocks = _block_diagonals(system, u.shape)
    return _iterate(system, (b, u), scratch, blocks, np.empty_like(blocks), (tolerance, limit))


@njit_noalloc
def _iterate(system, images, scratch, blocks, sums, stop):
    """Solve A u = b from u on, in place; return the number of iterations."""
    b, u = images
    tolerance, limit = stop
    inverse, r, p, Ap, z = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    n = u.size
    fu, fb, fi, fr, fp, fA, fz = (
        u.reshape(-1),
        b.reshape(-1),
        inverse.reshape(-1),
        r.reshape(-1),
        p.reshape(-1),
        Ap.reshape(-1),
        z.reshape(-1),
    )
    for k in range(n):
        fi[k] = 1 / fi[k] if fi[k] > 0 else np.float32(1)
    _precondition(inverse, blocks, sums, b, z)
    norm = _dot(fb, fz)
    _apply(system, u, Ap)
    for k in range(n):
        fr[k] = fb[k] - fA[k]
    _precondition(inverse, blocks, sums, r, z)
    rho = _dot(fr, fz)
    for k in range(n):
        fp[k] = fz[k]
    for iteration in range(limit):
        if rho <= tolerance * tolerance * norm:
            return iteration
        _apply(system, p, Ap)
        alpha = np.float32(rho / _dot(fp, fA))
        for k in range(n):
            fu[k] += alpha * fp[k]
            fr[k] -= alpha * fA[k]
        _precondition(inverse, blocks, sums, r, z)
        new = _dot(fr, fz)
        beta = np.float32(new / rho)
        for k in range(n):
            fp[k] = fz[k] + beta * fp[k]
        rho = new
    return limit
