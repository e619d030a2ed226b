"""The log image of one window of events: a robust sparse problem, solved by numba on the host.

With u = M / c, the log image in thresholds, the image minimises

    E(u) = sum_k w_k tail^2 log(1 + (a_k u - d_k)^2 / (2 tail^2))                      rows (1)
         + sum_cells phi(q(u))                                                        prior (2)
         + 1/2 sum_x (grad u - g)' Lambda (grad u - g)                      other windows' events
         + leak / 2 sum_x u^2                                                                 (3)

a_k is the difference of two bilinear look-ups, w_k the weight of the row. E is smooth. Iteratively
reweighted least squares replace E by the quadratic with

    r_k = w_k / (1 + e_k^2 / (2 tail^2)),    s = gradient / (2 (q + edge^2))

for rows, and for each of the four differences of a cell. Its residual b - A u is minus the gradient
of E, and a step as long as A says never raises E. So conjugate gradients go on from one set of
weights to the next, with the directions of Polak and Ribiere (1969).

Directions are preconditioned by the sum of the reciprocal diagonals of P' A P: the columns of P are
pixels, and bilinear hats on grids of 2, 4, 8, ... pixels (Bramble, Pasciak and Xu 1990), so that
large regions, which only their edges tie together, move as a whole. A hat is wide against a row's
displacement d, so that on the grid of 2^l pixels the diagonal is 4^-l of the sum of r_k |d|^2 and
of the weights of differences around it.

At the solution dE/du = A u - b = 0 with the weights of u itself. Its derivatives by parameters need
the second derivative of E, which has, in place of r_k and beside s,

    w_k (1 - e_k^2 / (2 tail^2)) / (1 + e_k^2 / (2 tail^2))^2

and for the products of each cell's four differences phi''(q) = -gradient / (2 (q + edge^2)^2).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt32
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined, read_only
from jaxevent.reconstruction.events_only.prior import GradientPrior, SolverParams
from jaxevent.reconstruction.events_only.rows import EVENT, Rows

REWEIGHTINGS = 40  # at most
MAX_REWEIGHTINGS = 2000  # where the image shall be as near to the minimum as numbers allow
STEPS = 3  # of conjugate gradients with the same weights
LEAST_CHANGE = 0.002  # of the image by a reweighting, root mean square in thresholds, to go on
MAX_STEPS = 400  # of conjugate gradients towards the solution of one linear problem
UPDATE_EVERY = 4  # so many reweightings the preconditioner takes the weights; each of the first
SAMPLES = 4  # perturbed solutions that the variance is the mean of
SAMPLE_STEPS = 25  # of conjugate gradients for each
# Chosen on simulated scenes (experiments/studies/events_only.md): how much larger errors are than
# independent rows and the curvature at the solution say, and what is not known without any row.
VARIANCE_FACTOR = 1.15
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


class Energy(NamedTuple):
    """The energy (3) of one window in thresholds; rows that look up near pixels lie together.

    Attributes:
        corner: Flat index of the look-up's pixel above and left.
        fraction: Distance from there along x and y, px.
        weight: Weights w_k.
        change: Changes d_k, thresholds.
        information: Lambda: xx, xy, yy, (px / threshold)^2.
        pull: Transpose of the gradient times Lambda g.
        params: Parameters of the solver.
    """

    corner: UInt32[np.ndarray, "rows 2"]
    fraction: Float[np.ndarray, "rows 2 2"]
    weight: Float[np.ndarray, " rows"]
    change: Float[np.ndarray, " rows"]
    information: Float[np.ndarray, "3 rows_or_0 width"]
    pull: Float[np.ndarray, "height width"]
    params: SolverParams


class _System(NamedTuple):
    """The matrix A of a reweighted problem, or the second derivative of the energy.

    Attributes:
        corner: (rows, 2) flat index of the look-up's pixel above and left.
        fraction: (rows, 2, 2) distance from there along x and y, px.
        weight: (rows,) weights.
        across: (height, width) weights of differences with the pixel right.
        down: (height, width) weights of differences with the pixel below.
        information: (3, height, width) xx, xy, yy, or without rows if none.
        curvature: (height - 1, width - 1) phi'' of cells, or without rows.
        image: (height, width) image at which the matrix is taken.
        flux: (2, width) scratch.
        leak: Weight of the image's square.
    """

    corner: NDArray[np.uint32]
    fraction: NDArray[np.floating]
    weight: NDArray[np.floating]
    across: NDArray[np.floating]
    down: NDArray[np.floating]
    information: NDArray[np.floating]
    curvature: NDArray[np.floating]
    image: NDArray[np.floating]
    flux: NDArray[np.floating]
    leak: np.floating


class _ScratchArrays(NamedTuple):
    images: NDArray[np.floating]  # (6, height, width): 1 / diagonal, r, that before, p, Ap, z
    reciprocal: NDArray[np.floating]  # of the diagonals of P' A P, from grid to coarser grid
    grids: NDArray[np.floating]  # values there
    line: NDArray[np.floating]  # a row of a grid


class _Preconditioner:
    """Diagonals of pixels and of coarser grids."""

    def __init__(self, system: _System):
        shape = height, width = system.across.shape
        count = 0
        while max(shape) > 1:
            shape = (shape[0] + 1) // 2, (shape[1] + 1) // 2
            count += shape[0] * shape[1]
        dtype = system.weight.dtype
        images = np.zeros((6, height, width), dtype)
        self.arrays = _ScratchArrays(images, *np.zeros((2, count), dtype), np.zeros(width, dtype))
        self.of_rows, self.bend = np.zeros((2, height, width), dtype)
        _add_row_diagonal(system, self.of_rows.reshape(-1), self.bend.reshape(-1))

    def update(self, system: _System) -> None:
        """Take the weights of the image's part of A; rows keep those that they had first."""
        diagonal, bend = self.arrays.images[0], self.bend + system.across + system.down
        diagonal[:] = self.of_rows
        _add_image_diagonal(system, diagonal)
        np.divide(1, diagonal, out=diagonal, where=diagonal > 0)
        if system.information.shape[1]:
            bend += system.information[0] + system.information[2]
        scale, begin = bend.dtype.type(1), 0
        while max(bend.shape) > 1:
            for axis in range(2):
                bend = np.add.reduceat(bend, np.arange(0, bend.shape[axis], 2), axis)
            scale, end = scale / 4, begin + bend.size
            self.arrays.reciprocal[begin:end] = 1 / (scale * bend.ravel() + system.leak / scale)
            begin = end


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
    c = np.float32(rows.threshold)
    u = np.zeros(rows.shape, np.float32) if start is None else (start / c).astype(np.float32)
    # Rows that look up the same pixels lie together in memory.
    order = np.argsort(rows.corner[:, 0], kind="stable")
    base = np.where(rows.kind == EVENT, 1, params.silence).astype(np.float32) * rows.weight
    information = np.zeros((3, 0, rows.shape[1]), np.float32)
    pull = np.zeros(rows.shape, np.float32)
    if prior is not None:
        L = (prior.information * c**2).astype(np.float32)
        information, pull = pack_prior(prior.gradient / c, L)
    energy = Energy(
        rows.corner[order],
        rows.fraction[order],
        base[order],
        rows.change[order],
        information,
        pull,
        params,
    )
    system, preconditioner, residual, iterations = _minimise(energy, u)
    V = np.full(rows.shape, np.inf, np.float32)
    unseen = _unseen_variance(system, preconditioner.of_rows) * c**2
    if variance:
        samples = _sample_variance(system, preconditioner, order, np.random.default_rng(seed))
        V = VARIANCE_FACTOR * c**2 * samples + unseen
    place = np.argsort(order, kind="stable")
    return Solution(u * c, V, unseen, residual[place], system.weight[place], iterations)


def pack_prior(gradient: NDArray, information: NDArray) -> tuple[NDArray, NDArray]:
    """Pack a prior of gradients as `Energy` has it.

    Args:
        gradient: (height, width, 2) g, thresholds / px.
        information: (height, width, 2, 2) Lambda, (px / threshold)^2.

    Returns:
        `information` and `pull` of `Energy`, of the type of `information`.
    """
    pull = np.zeros(information.shape[:2], information.dtype)
    g = np.einsum("hwij,hwj->hwi", information, gradient).astype(information.dtype)
    _add_gradient_transposed(g, pull)
    return np.stack([information[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1))]), pull


class _Minimum(NamedTuple):
    """The reweighted problem at the image of least energy.

    Attributes:
        system: The reweighted problem.
        preconditioner: Its preconditioner.
        residual: (rows,) residuals, thresholds.
        iterations: Number of iterations.
    """

    system: _System
    preconditioner: _Preconditioner
    residual: NDArray[np.floating]
    iterations: int


def _minimise(
    energy: Energy, u: NDArray, least_change: float = LEAST_CHANGE, most: int = REWEIGHTINGS
) -> _Minimum:
    """Minimise the energy of an image, in place.

    Args:
        energy: Energy of a window.
        u: (height, width) image to start from, thresholds; overwritten by that of least energy.
        least_change: Root mean square change of the image below which to stop, thresholds.
        most: Greatest number of reweightings.

    Returns:
        The reweighted problem at the minimum.
    """
    system = _set_up(energy)
    preconditioner = _Preconditioner(system)
    system = system._replace(weight=np.empty_like(energy.weight))
    residual, b, before = np.empty_like(energy.weight), np.empty_like(u), np.empty_like(u)
    iterations, rho = 0, 0.0
    for n in range(most):
        _reweight_at(u, energy, system, residual)
        if n < 3 or n % UPDATE_EVERY == 0:
            preconditioner.update(system)
        b[:], before[:] = energy.pull, u
        _add_transposed(system, energy.change * system.weight, b)
        rho = _conjugate_gradients(system, b, u, preconditioner.arrays, (rho, STEPS))
        iterations += STEPS
        if np.sqrt(np.mean((u - before) ** 2)) < least_change:
            break
    _reweight_at(u, energy, system, residual)
    return _Minimum(system, preconditioner, residual, iterations)


def _set_up(energy: Energy) -> _System:
    """Set up the matrix with the weights of rows w_k and none of differences.

    JAX's arrays are read-only, so all that is only read is: numba compiles for either kind.
    """
    height, width = energy.pull.shape
    dtype = energy.weight.dtype
    return _System(
        read_only(energy.corner),
        read_only(energy.fraction),
        read_only(energy.weight),
        *np.zeros((2, height, width), dtype),
        read_only(energy.information),
        np.zeros((0, width), dtype),
        read_only(np.zeros((0, width), dtype)),
        np.zeros((2, width), dtype),
        dtype.type(energy.params.leak),
    )


def _reweight_at(u: NDArray, energy: Energy, system: _System, residual: NDArray) -> None:
    """Write the residuals at the image u, and the weights of rows and differences there.

    Args:
        u: (height, width) image, thresholds.
        energy: The energy.
        system: The reweighted problem, whose weights are written.
        residual: (rows,) output, thresholds.
    """
    params, convert = energy.params, energy.weight.dtype.type
    data = read_only(energy.change), read_only(energy.weight)
    numbers = convert(params.tail), convert(params.gradient), convert(params.edge)
    _reweight(system, read_only(u), data, numbers, residual)


def find_minimum(energy: Energy, start: NDArray, least_change: float) -> NDArray:
    """Find the image of least energy.

    Args:
        energy: Energy of a window.
        start: (height, width) image to begin with, thresholds.
        least_change: Root mean square change by a reweighting, in thresholds, at which it is found.

    Returns:
        (height, width) image, thresholds.
    """
    u = np.array(start, energy.weight.dtype)
    _minimise(energy, u, least_change, MAX_REWEIGHTINGS)
    return u


def solve_linear(
    energy: Energy, u: NDArray, right: NDArray, tolerance: float, *, exact: bool
) -> NDArray:
    """Solve a linear problem with the second derivative of the energy at an image.

    Args:
        energy: Energy of a window.
        u: (height, width) image, thresholds.
        right: (height, width) right side.
        tolerance: Norm of the residual to stop at, relative to that of the right side.
        exact: Whether the second derivative is exact; else it is the matrix A of the reweighted
            problem.

    Returns:
        (height, width) solution.
    """
    system = _set_up(energy)
    preconditioner = _Preconditioner(system)
    system = system._replace(weight=np.empty_like(energy.weight))
    residual = np.empty_like(energy.weight)
    _reweight_at(u, energy, system, residual)
    preconditioner.update(system)
    if exact:
        share = residual**2 / (2 * energy.params.tail**2)
        system.weight[:] = energy.weight * (1 - share) / (1 + share) ** 2
        system = system._replace(curvature=_prior_curvature(u, energy.params), image=read_only(u))
    z, rho = np.zeros_like(right), 0.0
    least = tolerance * np.linalg.norm(right)
    for _ in range(MAX_STEPS // SAMPLE_STEPS):
        rho = _conjugate_gradients(system, right, z, preconditioner.arrays, (rho, SAMPLE_STEPS))
        if not rho > 0 or np.linalg.norm(preconditioner.arrays.images[1]) <= least:
            break
    return z


def _prior_curvature(u: NDArray, params: SolverParams) -> NDArray:
    """Return phi''(q), the second derivative of the prior (2), of the cells of an image.

    Args:
        u: (height, width) image, thresholds.
        params: Parameters of the solver.

    Returns:
        (height - 1, width - 1).
    """
    across, down = np.diff(u, axis=1) ** 2, np.diff(u, axis=0) ** 2
    q = (across[:-1] + across[1:] + down[:, :-1] + down[:, 1:]) / 2
    return -params.gradient / (2 * (q + params.edge**2) ** 2)


def _unseen_variance(system, of_rows):
    """Return the variance of pixels that neither rows nor the prior of gradients describe.

    Args:
        system: `_System` at the solution.
        of_rows: (height, width) diagonal of its rows.

    Returns:
        (height, width), squared thresholds.
    """
    from scipy.ndimage import gaussian_filter

    seen, nothing = of_rows.copy(), np.zeros_like(system.across)
    _add_image_diagonal(system._replace(across=nothing, down=nothing, leak=np.float32(0)), seen)
    seen = gaussian_filter(seen, BLUR_PX)
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
    """Perturb and solve: with b of covariance A, the solution has the covariance A^-1.

    Args:
        system: `_System` at the solution.
        preconditioner: `_Preconditioner` of it.
        order: (rows,) number of each row in the order in which perturbations are drawn.
        rng: Generator of NumPy.

    Returns:
        (height, width) mean square of the samples, squared thresholds.
    """
    from scipy.ndimage import gaussian_filter

    height, width = system.across.shape
    total = np.zeros((height, width))
    factor = factor_information(*system.information)
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
        if system.information.shape[1]:
            _add_gradient_transposed(np.einsum("hwij,hwj->hwi", factor, n), b)
        z = np.zeros_like(b)
        _conjugate_gradients(system, b, z, preconditioner.arrays, (0.0, SAMPLE_STEPS))
        total += (z - z.mean()) ** 2
    return gaussian_filter(total / SAMPLES, BLUR_PX).astype(np.float32)


@njit_fastmath_inlined
def _row_coefficients(system, k):
    """Return the pixels that a row looks up, and their coefficients.

    Args:
        system: `_System`.
        k: The row.

    Returns:
        Eight flat indices, four of the look-up at t_b before four of that at t_a, and eight
        coefficients.
    """
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
    """Return the difference of the two look-ups of a row.

    Args:
        pixels: Eight flat indices, of `_row_coefficients`.
        a: Eight coefficients, of `_row_coefficients`.
        u: (pixels,) flat image.

    Returns:
        The difference.
    """
    after = a[0] * u[pixels[0]] + a[1] * u[pixels[1]] + a[2] * u[pixels[2]] + a[3] * u[pixels[3]]
    before = a[4] * u[pixels[4]] + a[5] * u[pixels[5]] + a[6] * u[pixels[6]] + a[7] * u[pixels[7]]
    return after + before


@njit_fastmath_inlined
def _add_transposed_row(pixels, a, value, out):
    """Add the transposed of a row times a value to an image.

    Args:
        pixels: Eight flat indices, of `_row_coefficients`.
        a: Eight coefficients, of `_row_coefficients`.
        value: The value.
        out: (pixels,) flat image, added to.
    """
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
    """Add D' values to an image, D the matrix of all rows.

    Args:
        system: `_System`.
        values: (rows,).
        out: (height, width) image, added to.
    """
    flat = out.reshape(-1)
    for k in range(len(values)):
        pixels, a = _row_coefficients(system, k)
        _add_transposed_row(pixels, a, values[k], flat)


@njit_fastmath_inlined
def _neighbours(k, n):
    """Return the neighbours along an axis between which a central difference is taken.

    Args:
        k: Index of a pixel.
        n: Length of the axis, px.

    Returns:
        Index before, index after, and the reciprocal of their distance, 1/px.
    """
    before, after = max(k - 1, 0), min(k + 1, n - 1)
    return before, after, np.float32(1) / np.float32(max(after - before, 1))


@njit_fastmath
def _add_gradient_transposed(g, out):
    """Add the transposed of the gradient times g to an image.

    Args:
        g: (height, width, 2) along x and y.
        out: (height, width) image, added to.
    """
    height, width = out.shape
    for y in range(height):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            out[y, right] += sx * g[y, x, 0]
            out[y, left] -= sx * g[y, x, 0]
            out[below, x] += sy * g[y, x, 1]
            out[above, x] -= sy * g[y, x, 1]


@njit_fastmath_inlined
def _differences_of_cell(u, y, x):
    """Return the four differences of a cell.

    Args:
        u: (height, width) image.
        y: Row of the cell's first pixel.
        x: Its column.

    Returns:
        The differences across, above and below, and down, left and right.
    """
    upper, lower = u[y, x + 1] - u[y, x], u[y + 1, x + 1] - u[y + 1, x]
    return upper, lower, u[y + 1, x] - u[y, x], u[y + 1, x + 1] - u[y, x + 1]


@njit_fastmath_inlined
def _add_cell(image, curvature, u, y, x, out):
    """Add the part of the second derivative that couples the differences of a cell, times u.

    Args:
        image: (height, width) image at which the derivative is taken.
        curvature: phi'' of the cell.
        u: (height, width) image.
        y: Row of the cell's first pixel.
        x: Its column.
        out: (height, width) image, added to.
    """
    a, b, c, d = _differences_of_cell(image, y, x)
    ua, ub, uc, ud = _differences_of_cell(u, y, x)
    value = curvature * (a * ua + b * ub + c * uc + d * ud)
    out[y, x] -= value * (a + c)
    out[y, x + 1] += value * (a - d)
    out[y + 1, x] += value * (c - b)
    out[y + 1, x + 1] += value * (b + d)


@njit_fastmath
def _apply_matrix(system, u, out):
    """Write A u.

    Args:
        system: `_System`.
        u: (height, width) image.
        out: (height, width) output.
    """
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
    for y in range(system.information.shape[1]):
        above, below, sy = _neighbours(y, height)
        along, down = system.flux[0], system.flux[1]
        for x in range(1, width - 1):
            along[x] = np.float32(0.5) * (u[y, x + 1] - u[y, x - 1])
        for x in (0, width - 1):
            left, right, sx = _neighbours(x, width)
            along[x] = sx * (u[y, right] - u[y, left])
        for x in range(width):
            xx, xy = system.information[0, y, x], system.information[1, y, x]
            yy = system.information[2, y, x]
            gx, gy = along[x], sy * (u[below, x] - u[above, x])
            along[x], down[x] = xx * gx + xy * gy, sy * (xy * gx + yy * gy)
        for x in range(width):
            out[below, x] += down[x]
            out[above, x] -= down[x]
        for x in range(1, width - 1):
            out[y, x + 1] += np.float32(0.5) * along[x]
        for x in range(1, width - 1):
            out[y, x - 1] -= np.float32(0.5) * along[x]
        for x in (0, width - 1):
            left, right, sx = _neighbours(x, width)
            out[y, right] += sx * along[x]
            out[y, left] -= sx * along[x]
    for y in range(system.curvature.shape[0]):
        for x in range(width - 1):
            _add_cell(system.image, system.curvature[y, x], u, y, x, out)
    flat, image = out.reshape(-1), u.reshape(-1)
    for k in range(len(system.weight)):
        pixels, a = _row_coefficients(system, k)
        _add_transposed_row(pixels, a, system.weight[k] * _look_up(pixels, a, image), flat)


@njit_fastmath
def _add_row_diagonal(system, diagonal, bend):
    """Add diag(D' W D) to `diagonal`, and half of w |b - a|^2 to `bend` at both ends of rows.

    Args:
        system: `_System`.
        diagonal: (pixels,) flat image, added to.
        bend: (pixels,) flat image, added to.
    """
    width = system.across.shape[1]
    reciprocal, half = np.float32(1) / np.float32(width), np.float32(0.5)
    for k in range(len(system.weight)):
        pixels, a = _row_coefficients(system, k)
        ya = np.floor((np.float32(pixels[0]) + half) * reciprocal)
        yb = np.floor((np.float32(pixels[4]) + half) * reciprocal)
        dy = ya + system.fraction[k, 0, 1] - yb - system.fraction[k, 1, 1]
        dx = np.float32(pixels[0]) - ya * width - (np.float32(pixels[4]) - yb * width)
        dx += system.fraction[k, 0, 0] - system.fraction[k, 1, 0]
        part = half * system.weight[k] * (dx * dx + dy * dy)
        bend[pixels[0]] += part
        bend[pixels[4]] += part
        i, j = np.int64(pixels[0]), np.int64(pixels[4])
        right, below = np.int64(pixels[1]) - i, np.int64(pixels[2]) - i
        at = i, i + right, i + below, i + below + right, j, j + right, j + below, j + below + right
        # The square of the sum of the entries at each pixel.
        for m in range(8):
            total = np.float32(0)
            for n in range(8):
                if at[n] == at[m]:
                    total += a[n]
            diagonal[at[m]] += system.weight[k] * a[m] * total


@njit_fastmath
def _add_image_diagonal(system, out):
    """Add the diagonal of A without its rows to an image.

    Args:
        system: `_System`.
        out: (height, width) image, added to.
    """
    height, width = out.shape
    for y in range(height):
        for x in range(width):
            out[y, x] += system.leak + system.across[y, x] + system.down[y, x]
            if x > 0:
                out[y, x] += system.across[y, x - 1]
            if y > 0:
                out[y, x] += system.down[y - 1, x]
    for y in range(system.information.shape[1]):
        above, below, sy = _neighbours(y, height)
        for x in range(width):
            left, right, sx = _neighbours(x, width)
            xx, yy = system.information[0, y, x], system.information[2, y, x]
            if left != right:
                out[y, left] += sx * sx * xx
                out[y, right] += sx * sx * xx
            if above != below:
                out[above, x] += sy * sy * yy
                out[below, x] += sy * sy * yy


@njit_fastmath_inlined
def _coarse_rows(y, n):
    """Return the coarse rows around a fine one.

    Args:
        y: The fine row.
        n: Number of coarse rows.

    Returns:
        The nearer and the farther one.
    """
    near = y >> 1
    return near, min(max(near + ((y & 1) << 1) - 1, 0), n - 1)


@njit_fastmath_inlined
def _restrict(fine, coarse, line):
    """Add a grid to one of half its nodes each way, the transpose of `_add_prolongated`.

    Args:
        fine: (height, width) values.
        coarse: (rows, columns) values, added to; half of each, rounded up.
        line: Scratch for a coarse row.
    """
    near, far = np.float32(0.75), np.float32(0.25)
    (height, width), (rows, columns) = fine.shape, coarse.shape
    for y in range(height):
        j, other = _coarse_rows(y, rows)
        for i in range(columns):
            line[i] = 0
        line[0] = fine[y, 0]
        for i in range(columns - 1):
            line[i] += near * fine[y, 2 * i + 1] + far * fine[y, 2 * i + 2]
        for i in range(columns - 1):
            line[i + 1] += far * fine[y, 2 * i + 1] + near * fine[y, 2 * i + 2]
        if width % 2 == 0:
            line[columns - 1] += fine[y, width - 1]
        for i in range(columns):
            coarse[j, i] += near * line[i]
            coarse[other, i] += far * line[i]


@njit_fastmath_inlined
def _add_prolongated(coarse, fine, line):
    """Add a grid to one of twice its nodes each way, bilinear between centres of cells.

    Args:
        coarse: (rows, columns) values.
        fine: (height, width) values, added to.
        line: Scratch for a coarse row.
    """
    near, far = np.float32(0.75), np.float32(0.25)
    (height, width), (rows, columns) = fine.shape, coarse.shape
    for y in range(height):
        j, other = _coarse_rows(y, rows)
        for i in range(columns):
            line[i] = near * coarse[j, i] + far * coarse[other, i]
        fine[y, 0] += line[0]
        for i in range(columns - 1):
            fine[y, 2 * i + 1] += near * line[i] + far * line[i + 1]
            fine[y, 2 * i + 2] += far * line[i] + near * line[i + 1]
        if width % 2 == 0:
            fine[y, width - 1] += line[columns - 1]


@njit_fastmath_inlined
def _fill_grids(scratch, r):
    """Restrict an image to all coarser grids.

    Args:
        scratch: `_ScratchArrays`, whose `grids` are written.
        r: (height, width) image.
    """
    grids = scratch.grids
    begin, end, fine = 0, 0, r
    for k in range(len(grids)):
        grids[k] = 0
    while end < len(grids):
        rows, columns = (fine.shape[0] + 1) >> 1, (fine.shape[1] + 1) >> 1
        begin, end = end, end + rows * columns
        coarse = grids[begin:end].reshape(rows, columns)
        _restrict(fine, coarse, scratch.line)
        fine = coarse


@njit_fastmath
def _precondition(scratch, r, z):
    """Precondition a residual by the reciprocal diagonals of pixels and coarser grids.

    Args:
        scratch: `_ScratchArrays`, with the diagonals.
        r: (height, width) residual.
        z: (height, width) output.
    """
    grids = scratch.grids
    height, width = r.shape
    _fill_grids(scratch, r)
    for k in range(len(grids)):
        grids[k] *= scratch.reciprocal[k]
    for y in range(height):
        for x in range(width):
            z[y, x] = scratch.images[0, y, x] * r[y, x]
    level, end = 0, len(grids)
    while (max(height, width) - 1) >> level:
        level += 1
    for bits in range(level, 0, -1):
        rows, columns = ((height - 1) >> bits) + 1, ((width - 1) >> bits) + 1
        begin, fine = end - rows * columns, z
        coarse = grids[begin:end].reshape(rows, columns)
        if bits > 1:
            rows, columns = ((height - 1) >> (bits - 1)) + 1, ((width - 1) >> (bits - 1)) + 1
            fine = grids[begin - rows * columns : begin].reshape(rows, columns)
        _add_prolongated(coarse, fine, scratch.line)
        end = begin


@njit_fastmath
def _reweight(system, u, data, numbers, residual):
    """Write the residuals of an image, and the weights of its rows and differences.

    Args:
        system: `_System`, whose `weight`, `across` and `down` are overwritten.
        u: (height, width) image, thresholds.
        data: (rows,) changes d_k and weights w_k of the energy.
        numbers: `tail`, `gradient` and `edge`.
        residual: (rows,) output, thresholds.
    """
    change, base = data
    tail, gradient, edge = numbers
    image = u.reshape(-1)
    for k in range(len(change)):
        pixels, a = _row_coefficients(system, k)
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
            a, b, c, d = _differences_of_cell(u, y, x)
            q = (a * a + b * b + c * c + d * d) / 2
            s = gradient / (2 * (q + edge * edge))
            system.across[y, x] += s
            system.across[y + 1, x] += s
            system.down[y, x] += s
            system.down[y, x + 1] += s


@njit_fastmath
def _update_direction(r, before, z, rho, p):
    """Turn the direction of conjugate gradients by a preconditioned residual.

    As the matrix changes, directions are those of Polak and Ribiere.
    Args:
        r: (pixels,) residual.
        before: (pixels,) residual of the step before.
        z: (pixels,) preconditioned residual.
        rho: What the step before returned, or 0.
        p: (pixels,) direction, in place.

    Returns:
        r' z.
    """
    new, same = np.float32(0), np.float32(0)
    for k in range(len(r)):
        new += r[k] * z[k]
        same += before[k] * z[k]
    beta = max((new - same) / rho, np.float32(0)) if rho > 0 else np.float32(0)
    for k in range(len(r)):
        p[k] = z[k] + beta * p[k]
    return new


@njit_fastmath
def _advance(p, Ap, u, r, before):
    """Go along a direction to the minimum there.

    Args:
        p: (pixels,) direction.
        Ap: (pixels,) A times the direction.
        u: (pixels,) image, in place.
        r: (pixels,) residual, in place.
        before: (pixels,) output, the residual before the step.

    Returns:
        Whether there is a minimum; else nothing changes.
    """
    along, curvature = np.float32(0), np.float32(0)
    for k in range(len(p)):
        along += r[k] * p[k]
        curvature += p[k] * Ap[k]
    if curvature <= 0:
        return False
    alpha = along / curvature
    for k in range(len(p)):
        before[k] = r[k]
        u[k] += alpha * p[k]
        r[k] -= alpha * Ap[k]
    return True


def _conjugate_gradients(system, b, u, scratch, stage):
    """Take steps towards A u = b, in place; go on with the directions of the call before.

    Weights may have changed since.
    Args:
        system: `_System`, with A.
        b: (height, width) right side.
        u: (height, width) image, in place.
        scratch: `_ScratchArrays` of the preconditioner, with the direction of the call before.
        stage: What that call returned, or 0, and the number of steps.

    Returns:
        r' z of the last step, for the next call; 0 or less where there is nothing left to do.
    """
    convert = u.dtype.type
    rho, steps = convert(stage[0]), stage[1]
    _, residual, _, direction, product, preconditioned = scratch.images
    r, before, p, Ap, z = scratch.images[1:].reshape(5, -1)
    _apply_matrix(system, u, product)
    np.subtract(b, product, out=residual)
    for _ in range(steps):
        _precondition(scratch, residual, preconditioned)
        rho = convert(_update_direction(r, before, z, rho, p))
        if rho <= 0:
            break
        _apply_matrix(system, direction, product)
        if not _advance(p, Ap, u.reshape(-1), r, before):
            return convert(0)
    return rho
