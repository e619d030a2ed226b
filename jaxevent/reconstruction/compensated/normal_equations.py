"""Normal equations of trajectories: in numba for their estimate, in JAX for its derivatives.

A Gauss-Newton step d of the trajectories p, one of four numbers for every node, solves

    (N + smooth Laplacian + ridge) d = b - smooth Laplacian p - ridge p

with N and b of the images, and a Laplacian that weighs differences between neighbouring nodes.

Converged trajectories are where the right-hand side vanishes, F(p, images, cost) = 0. So
dp = A^-1 dF at fixed p, with A = -dF/dp. Derivatives solve these equations once, backwards the
transposed ones. A is close to the normal matrix, which conjugate gradients invert as the
preconditioner of the whole.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import bicgstab, cg
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import empty, njit_fastmath, njit_fastmath_inlined, row_scratch, run_over_rows
from jaxevent.devices import full_precision
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.warp import (
    RowScratch,
    gradient_at_pixel,
    gradient_jax,
    interpolate_paths_jax,
    interpolate_row,
    is_in_image,
    locate_points,
    pad_edges,
    path_positions,
    read_bilinear,
    sample_bilinear,
)
from jaxevent.reconstruction.features import Numeric

MIN_ROWS = 32  # of pixels or nodes, which are worth a thread
# Places of a symmetric matrix's entries among those of its upper triangle.
SYMMETRIC = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
OUTSIDE_INFORMATION = np.float32(1e-6)  # of values outside the image
# Iterations for derivatives: of conjugate gradients with the normal matrix, and of the whole.
CG_ITERATIONS, BICGSTAB_ITERATIONS = 30, 8


class CostParams(NamedTuple):
    """Parameters of the cost that trajectories minimise; `Params` has their meanings."""

    floor: Numeric  # (ln I)^2
    robust: Numeric
    smooth: Numeric  # 1 / px^2
    jump: Numeric  # px
    edge: Numeric  # ln I / px
    straight: Numeric  # 1 / px^2

    @classmethod
    def of(cls, params: Params, convert: Callable[[Any], Any] = np.float32) -> "CostParams":
        """Take the parameters of the cost from those of `mc`.

        Args:
            params: Parameters of `mc`.
            convert: Conversion of each number.

        Returns:
            The parameters.
        """
        return cls(*(convert(getattr(params, name)) for name in cls._fields))


class NormalEquations(NamedTuple):
    """The equations of all nodes at some trajectories."""

    N: Float[Numeric, "rows columns *matrix"]  # (4, 4), or the 10 entries of its upper triangle
    b: Float[Numeric, "rows columns 4"]
    across: Float[Numeric, "rows columns-1"]  # weights of differences; numba: (rows, columns)
    down: Float[Numeric, "rows-1 columns"]
    smooth: Float[Numeric, " 4"]
    ridge: Float[Numeric, " 4"]


class InstantStack(NamedTuple):
    """Images at K instants."""

    L: NDArray[np.float32]  # (K, h, w), log intensity
    V: NDArray[np.float32]  # (K, h, w), its variance, (ln I)^2
    s: NDArray[np.float32]  # (K,), times relative to the target, -1..1
    near: NDArray[np.float32]  # (K,), weights with which a robust mean begins

    @classmethod
    def of(cls, L: NDArray, V: NDArray, s: NDArray[np.float32]) -> "InstantStack":
        """Add the weights, which fall with the distance from the target.

        Args:
            L: (K, h, w) float32, log intensity.
            V: (K, h, w) float32, its variance, (ln I)^2.
            s: (K,) times relative to the target, -1..1.

        Returns:
            Images with weights.
        """
        return cls(L, V, s, np.exp(-2 * (s / max_instant_distance(s)) ** 2).astype(np.float32))


def max_instant_distance(s: NDArray[np.float32]) -> np.float32:
    """Return the largest distance of instants s (K,) from the target."""
    return np.float32(max(float(np.abs(s).max()), 1e-3))


class TrajectorySums(NamedTuple):
    """Sums over instants of what images show along the trajectories of pixels."""

    M: NDArray[np.float32]  # (h, w), the robust mean
    # (h, 6, w): sums of R s'^2, R s' q', R q'^2, R e s, R e q and R e^2, of q = s^2, robust weights
    # R and residuals e. s' and q' differ from s and q by the means that R gives.
    moments: NDArray[np.float32]


@njit_fastmath_inlined
def fill_information(variances, inside, variance_floor, out_information):
    """Write the information of values.

    Args:
        variances: (points,) their variances, (ln I)^2.
        inside: (points,) 1, or 0 beyond the image's border.
        variance_floor: Variance to add, (ln I)^2.
        out_information: (points,) output, the information.
    """
    one = np.float32(1)
    for i in range(len(variances)):
        out_information[i] = (
            one / (variances[i] + variance_floor) if inside[i] > 0 else OUTSIDE_INFORMATION
        )


@njit_fastmath_inlined
def robust_means(values, information, initial_weights, nu, out_means):
    """Write robust means of values.

    First the near instants determine the mean; then all of them.

    Args:
        values: (K, points) values.
        information: (K, points) their information.
        initial_weights: (K,) weights of the instants to begin with.
        nu: Standardised squared residual beyond which weights fall.
        out_means: Output, the weights R (K, points) and means (points,), and scratch (2, points).
    """
    R, means, sums = out_means
    one, total, mean = np.float32(1), sums[0], sums[1]
    for turn in range(3):
        for i in range(len(means)):
            total[i], mean[i] = np.float32(0), np.float32(0)
        for k in range(len(values)):
            level, info, weight, early = values[k], information[k], R[k], initial_weights[k]
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


@njit_fastmath_inlined
def _add_product(a, b, out):
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@njit_fastmath_inlined
def _add_scaled(factor, a, out):
    for x in range(len(out)):
        out[x] += factor * a[x]


class _SampleScratch(NamedTuple):
    """Scratch memory for each row that a kernel begins with."""

    rows: RowScratch
    values: NDArray[np.float32]  # (rows, 3, K, w), log intensity, information, robust weight
    sums: NDArray[np.float32]  # (rows, 7, w)

    @classmethod
    def allocate(cls, rows: int, instants: int, width: int) -> "_SampleScratch":
        """Allocate scratch memory for `run_over_rows`."""
        shapes = (3, instants, width), (7, width)
        return cls(RowScratch.allocate(rows, width), *(row_scratch(rows, *s) for s in shapes))


@njit_fastmath
def _sum_instants(begin, end, inputs, scratch, out):
    """Write the `TrajectorySums` of some rows."""
    images, p, cost = inputs
    count, h, w = images.L.shape
    rows, zero = scratch.rows, np.float32(0)
    path, at, pixel = rows.path[begin], rows.x[begin], rows.pixel[begin]
    part, inside, runs = rows.part[begin], rows.inside[begin], rows.runs[begin]
    row = (path, at, pixel, part, inside, runs)
    level, info, R = scratch.values[begin, 0], scratch.values[begin, 1], scratch.values[begin, 2]
    total, r1, r2 = scratch.sums[begin, 2], scratch.sums[begin, 3], scratch.sums[begin, 4]
    r3, r4 = scratch.sums[begin, 5], scratch.sums[begin, 6]
    for x in range(w):
        at[x] = np.float32(x)
    for y in range(begin, end):
        M, moments = out.M[y], out.moments[y]
        interpolate_row(p, y, rows.nodes[begin], path)
        for k in range(count):
            locate_points(np.float32(y), images.s[k], (h, w), w, row)
            read_bilinear(images.L[k], pixel, part, runs, level[k])
            read_bilinear(images.V[k], pixel, part, runs, info[k])
            fill_information(info[k], inside, cost.floor, info[k])
        robust_means(level, info, images.near, cost.robust, (R, M, scratch.sums[begin, :2]))
        total[:], r1[:], r2[:], r3[:], r4[:] = zero, zero, zero, zero, zero
        moments[:] = zero
        for k in range(count):  # few sums at once: compilers compare the places of all of them
            s, q, weight, e = images.s[k], images.s[k] * images.s[k], R[k], level[k]
            for x in range(w):
                e[x] -= M[x]
                total[x] += weight[x]
            _add_scaled(s, weight, r1)
            _add_scaled(q, weight, r2)
            _add_scaled(q * s, weight, r3)
            _add_scaled(q * q, weight, r4)
            for x in range(w):
                weight[x] *= e[x]
            _add_scaled(s, weight, moments[3])
            _add_scaled(q, weight, moments[4])
            _add_product(weight, e, moments[5])
        for x in range(w):
            moments[0, x] = r2[x] - r1[x] * r1[x] / total[x]
            moments[1, x] = r3[x] - r1[x] * r2[x] / total[x]
            moments[2, x] = r4[x] - r2[x] * r2[x] / total[x]


def sum_instants(images: InstantStack, p: NDArray[np.float32], cost: CostParams) -> TrajectorySums:
    """Sum what images show along trajectories.

    Args:
        images: The images.
        p: (rows, columns, 4) trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        The sums of all pixels.
    """
    count, h, w = images.L.shape
    out = TrajectorySums(empty(h, w), empty(h, 6, w))
    scratch = _SampleScratch.allocate(h, count, w)
    run_over_rows(_sum_instants, h, (images, p, cost), scratch, out, min_rows=MIN_ROWS)
    return out


@njit_fastmath
def _fill_equations(begin, end, sums, scratch, out):
    """Write N (10 entries) and b (4) of the nodes of some rows, and |grad M|: (15,) each.

    The derivative of values by a path's four numbers is J = g (s, s^2), with the scene's gradient
    g, for which that of the mean stands. M, the mean of the values by R, is eliminated exactly: J
    is J - sum R J / sum R. So N is the product of g g^T with the moments of s and s^2.
    """
    h, w = sums.M.shape
    rows = scratch[begin]
    for i in range(begin, end):
        rows[:] = np.float32(0)
        below = min(2 * i + 2, h)
        for y in range(2 * i, below):
            moments = sums.moments[y]
            for x in range(w):
                gx, gy = gradient_at_pixel(sums.M, y, x)
                xx, xy, yy = gx * gx, gx * gy, gy * gy
                ss, sq, qq = moments[0, x], moments[1, x], moments[2, x]
                rows[0, x] += xx * ss
                rows[1, x] += xy * ss
                rows[2, x] += xx * sq
                rows[3, x] += xy * sq
                rows[4, x] += yy * ss
                rows[6, x] += yy * sq
                rows[7, x] += xx * qq
                rows[8, x] += xy * qq
                rows[9, x] += yy * qq
                rows[10, x] -= gx * moments[3, x]
                rows[11, x] -= gy * moments[3, x]
                rows[12, x] -= gx * moments[4, x]
                rows[13, x] -= gy * moments[4, x]
                rows[14, x] += np.sqrt(xx + yy)
        for x in range(w):
            rows[5, x] = rows[3, x]
        for j in range(out.shape[1]):
            left, right = 2 * j, min(2 * j + 1, w - 1)
            both = np.float32(right - left)  # 0 or 1
            share = np.float32(1) / (np.float32(below - 2 * i) * (np.float32(1) + both))
            for c in range(15):
                out[i, j, c] = (rows[c, left] + both * rows[c, right]) * share


@njit_fastmath
def _smooth_nodes(values, row, out):
    """Blur nodes by (1, 6, 1) / 8: by a Gaussian of 1 px."""
    rows, columns, channels = out.shape
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


@njit_fastmath
def _weigh_differences(p, edge, horizon, cost, out):
    """Write the weights of differences between neighbouring nodes, across and down."""
    rows, columns, _ = p.shape
    jump, scale = np.float32(cost.jump), np.float32(cost.edge)
    for i in range(rows):
        for j in range(columns):
            for turn in range(2):
                i1, j1 = i + (turn == 1), j + (turn == 0)
                if i1 >= rows or j1 >= columns:
                    continue
                dx = (p[i1, j1, 0] - p[i, j, 0]) * horizon
                dy = (p[i1, j1, 1] - p[i, j, 1]) * horizon
                weight = jump / np.sqrt(dx * dx + dy * dy + jump * jump)
                steepness = (edge[i, j] + edge[i1, j1]) * np.float32(0.5)
                weight *= np.float32(0.1) + np.float32(0.9) * np.exp(-steepness / scale)
                out[turn, i, j] = weight


def linearise(images: InstantStack, p: NDArray[np.float32], cost: CostParams) -> NormalEquations:
    """Set up the normal equations at some trajectories.

    Args:
        images: The images.
        p: (rows, columns, 4) the trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        The equations, N as the 10 entries of its upper triangle.
    """
    sums, shape = sum_instants(images, p, cost), p.shape[:2]
    entries = empty(*shape, 15)
    scratch = row_scratch(shape[0], 15, sums.M.shape[1])
    run_over_rows(_fill_equations, shape[0], sums, scratch, entries, min_rows=MIN_ROWS)
    blurred = empty(*shape, 14)
    _smooth_nodes(entries, np.empty((shape[1], 14), np.float32), blurred)
    horizon = max_instant_distance(images.s)
    weights = np.zeros((2, *shape), np.float32)
    _weigh_differences(p, entries[..., 14], horizon, cost, weights)
    squared = horizon * horizon
    smooth = cost.smooth * squared * np.array([1, 1, squared, squared], np.float32)
    bend, tiny = cost.straight * squared * squared, np.float32(1e-5) * smooth[0]
    ridge = np.array([tiny, tiny, bend, bend], np.float32)
    return NormalEquations(blurred[..., :10], blurred[..., 10:], *weights, smooth, ridge)


@njit_fastmath_inlined
def _scale_and_add(factor, a, out):
    """Write factor out + a."""
    for x in range(len(out)):
        out[x] = factor * out[x] + a[x]


@njit_fastmath_inlined
def _multiply(N, i, q, out):
    """Multiply the symmetric 4 x 4 matrices of a row of nodes by vectors (4, columns)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    for c in range(len(out)):  # a number that is not known is not unrolled: less to compile
        a, b = N[SYMMETRIC[c, 0], i], N[SYMMETRIC[c, 1], i]
        d, e, product = N[SYMMETRIC[c, 2], i], N[SYMMETRIC[c, 3], i], out[c]
        for j in range(len(product)):
            product[j] = a[j] * x[j] + b[j] * y[j] + d[j] * z[j] + e[j] * w[j]


@njit_fastmath_inlined
def _add_pull(q, weights, i, smooth, ridge, out):
    """Add smooth times the weighted graph Laplacian of a row, and ridge q; padded by a node."""
    across, above, below = weights[0][i], weights[1][i], weights[1][i + 1]
    up, here, down = q[i], q[i + 1], q[i + 2]
    for j in range(len(out)):
        value = here[j + 1]
        rough = across[j] * (value - here[j]) + across[j + 1] * (value - here[j + 2])
        rough += above[j] * (value - up[j + 1]) + below[j] * (value - down[j + 1])
        out[j] += smooth * rough + ridge * value


@njit_fastmath_inlined
def _invert(N, added, out):
    """Write the inverse (10 entries) of a symmetric 4 x 4 matrix with `added` on its diagonal."""
    one = np.float32(1)
    # The matrix is C D C^T, C a unit lower triangle.
    e0 = one / (N[0] + added[0])
    c10, c20, c30 = N[1] * e0, N[2] * e0, N[3] * e0
    e1 = one / (N[4] + added[1] - c10 * N[1])
    b21, b31 = N[5] - c10 * N[2], N[6] - c10 * N[3]
    c21, c31 = b21 * e1, b31 * e1
    e2 = one / (N[7] + added[2] - c20 * N[2] - c21 * b21)
    b32 = N[8] - c20 * N[3] - c21 * b31
    c32 = b32 * e2
    e3 = one / (N[9] + added[3] - c30 * N[3] - c31 * b31 - c32 * b32)
    # The inverse of C, then that of the whole.
    m10, m21, m32 = -c10, -c21, -c32
    m20, m31 = -c20 - c21 * m10, -c31 - c32 * m21
    m30 = -c30 - c31 * m10 - c32 * m20
    out[0] = e0 + e1 * m10 * m10 + e2 * m20 * m20 + e3 * m30 * m30
    out[1] = e1 * m10 + e2 * m20 * m21 + e3 * m30 * m31
    out[2], out[3] = e2 * m20 + e3 * m30 * m32, e3 * m30
    out[4] = e1 + e2 * m21 * m21 + e3 * m31 * m31
    out[5], out[6] = e2 * m21 + e3 * m31 * m32, e3 * m31
    out[7], out[8], out[9] = e2 + e3 * m32 * m32, e3 * m32, e3


class _SolverScratch(NamedTuple):
    """Scratch memory of conjugate gradients for rows x columns of nodes."""

    blocks: NDArray[np.float32]  # (2, 10, rows, columns), of the equations and their inverses
    beside: NDArray[np.float32]  # (rows, columns + 1), weights of differences, 0 at the ends
    below: NDArray[np.float32]  # (rows + 1, columns), the same between rows
    q: NDArray[np.float32]  # (4, rows + 2, columns + 2), the direction, 0 around the nodes
    vectors: NDArray[np.float32]  # (4, rows, 4, columns)
    sums: NDArray[np.float32]  # (columns,)
    node: NDArray[np.float32]  # (14,)

    @classmethod
    def zeros(cls, rows: int, columns: int) -> "_SolverScratch":
        """Allocate zeros."""
        shapes = (
            (2, 10, rows, columns), (rows, columns + 1), (rows + 1, columns),
            (4, rows + 2, columns + 2), (4, rows, 4, columns), (columns,), (14,),
        )  # fmt: skip
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))


def solve_normal_equations(
    eq: NormalEquations, p: NDArray[np.float32], iterations: int = 12
) -> NDArray[np.float32]:
    """Solve the normal equations by conjugate gradients, preconditioned by the nodes' own blocks.

    Args:
        eq: The equations, of `linearise`.
        p: (rows, columns, 4) trajectories at which they were set up, px.
        iterations: Number of iterations.

    Returns:
        (rows, columns, 4) the step d, px.
    """
    d = np.empty_like(p)
    _solve(eq, p, iterations, _SolverScratch.zeros(*p.shape[:2]), d)
    return d


@njit_fastmath
def _solve(eq, p, iterations, scratch, d):
    # Channels come first here, and rows of nodes are what loops go over at once.
    rows, columns, channels = p.shape
    smooth, ridge, beside, below, q = eq.smooth, eq.ridge, scratch.beside, scratch.below, scratch.q
    A, P, vectors, node = scratch.blocks[0], scratch.blocks[1], scratch.vectors, scratch.node
    r, found, Aq, z = vectors[0], vectors[1], vectors[2], vectors[3]
    sums, added, block, weights = scratch.sums, node[:4], node[4:], (beside, below)
    for i in range(rows):
        for j in range(columns):
            beside[i, j + 1] = eq.across[i, j] if j < columns - 1 else np.float32(0)
            below[i + 1, j] = eq.down[i, j] if i < rows - 1 else np.float32(0)
            for c in range(channels):
                q[c, i + 1, j + 1] = p[i, j, c]
    for i in range(rows):
        for c in range(channels):
            for j in range(columns):
                r[i, c, j] = eq.b[i, j, c]
            _add_pull(q[c], weights, i, -smooth[c], -ridge[c], r[i, c])
        for j in range(columns):
            degree = beside[i, j] + beside[i, j + 1] + below[i, j] + below[i + 1, j]
            for c in range(channels):
                added[c] = smooth[c] * degree + ridge[c] + np.float32(1e-6)
            _invert(eq.N[i, j], added, block)
            for c in range(10):
                P[c, i, j] = block[c]
                A[c, i, j] = eq.N[i, j, c]
    rz = 0.0
    for turn in range(iterations + 1):
        sums[:] = np.float32(0)
        for i in range(rows):
            _multiply(P, i, r[i], z[i])
            for c in range(channels):
                _add_product(r[i, c], z[i, c], sums)
        following = 0.0
        for j in range(columns):
            following += sums[j]
        share = np.float32(following / (rz + 1e-20)) if turn else np.float32(0)
        rz = following
        if turn == iterations:
            break
        for i in range(rows):
            for c in range(channels):
                if turn == 0:
                    for j in range(columns):  # a slice would take longer to compile
                        q[c, i + 1, j + 1] = z[i, c, j]
                else:
                    _scale_and_add(share, z[i, c], q[c, i + 1, 1:-1])
        sums[:] = np.float32(0)
        for i in range(rows):
            _multiply(A, i, q[:, i + 1, 1:-1], Aq[i])
            for c in range(channels):
                _add_pull(q[c], weights, i, smooth[c], ridge[c], Aq[i, c])
                _add_product(q[c, i + 1, 1:-1], Aq[i, c], sums)
        curvature = 0.0
        for j in range(columns):
            curvature += sums[j]
        step = np.float32(rz / (curvature + 1e-20))
        for i in range(rows):
            for c in range(channels):
                _add_scaled(step, q[c, i + 1, 1:-1], found[i, c])
                _add_scaled(-step, Aq[i, c], r[i, c])
    for i in range(rows):
        for c in range(channels):
            for j in range(columns):
                d[i, j, c] = found[i, c, j]


class MotionImages(NamedTuple):
    """Images that motion is estimated from, for derivatives."""

    L: Float[Numeric, "k h w"]  # log intensity
    V: Float[Numeric, "k h w"]  # its variance, (ln I)^2
    s: Float[Numeric, " k"]  # times relative to the target, -1..1
    present: Float[Numeric, " k"]  # 1, or 0 of instants that only pad the number


def _average_pixels(pixels: Array) -> Array:
    """Average the 2 x 2 pixels (h, w, ...) of each node, (rows, columns, ...)."""
    h, w = pixels.shape[:2]

    def total(values: Array) -> Array:
        widths = [(0, h % 2), (0, w % 2)] + [(0, 0)] * (values.ndim - 2)
        padded = jnp.pad(values, widths)
        return padded[::2, ::2] + padded[::2, 1::2] + padded[1::2, ::2] + padded[1::2, 1::2]

    count = total(jnp.ones((h, w), pixels.dtype))
    return total(pixels) / count.reshape(*count.shape, *[1] * (pixels.ndim - 2))


def _smooth_nodes_jax(nodes: Array) -> Array:
    """Blur nodes by (1, 6, 1) / 8."""
    for axis in (0, 1):
        padded, size = pad_edges(nodes, axis, 1), nodes.shape[axis]
        a, b, c = (jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(3))
        nodes = (a + 6 * b + c) / 8
    return nodes


@full_precision
def linearise_jax(p: Array, images: MotionImages, cost: CostParams) -> NormalEquations:
    """Set up the normal equations at some trajectories of all instants; differentiable.

    Args:
        p: (rows, columns, 4) trajectories of nodes, px.
        images: The images.
        cost: Parameters of the cost.

    Returns:
        The equations, N as matrices (4, 4).
    """
    L, V, s, present = images
    count, h, w = L.shape
    Y, X = (one.astype(p.dtype) for one in path_positions(interpolate_paths_jax(p, h, w), s))
    inside = is_in_image(Y, X, h, w)
    L, V = sample_bilinear(L, Y, X), sample_bilinear(V, Y, X)
    W = present[:, None, None] * jnp.where(inside, 1 / (V + cost.floor), OUTSIDE_INFORMATION)
    s = s[:, None, None]
    R = W * jnp.exp(-2 * s**2)
    M = (R * L).sum(0) / R.sum(0)
    for _ in range(2):
        R = W / (1 + (L - M) ** 2 * W / cost.robust)
        M = (R * L).sum(0) / R.sum(0)
    mx, my = gradient_jax(M)
    J = jnp.stack([mx * s, my * s])
    J = jnp.concatenate([J, J * s])
    J = J - (R * J).sum(1, keepdims=True) / R.sum(0)
    N = jnp.einsum("khw,akhw,bkhw->hwab", R, J, J)
    b = -jnp.einsum("khw,akhw,khw->hwa", R, J, L - M)
    edge = _average_pixels(jnp.sqrt(mx**2 + my**2 + 1e-20))

    def weights(axis: int) -> Array:
        difference = jnp.diff(p[..., :2], axis=axis)
        one, other = ((edge[:, :-1], edge[:, 1:]), (edge[:-1], edge[1:]))[axis == 0]
        weight = cost.jump / jnp.sqrt((difference**2).sum(-1) + cost.jump**2)
        return weight * (0.1 + 0.9 * jnp.exp(-(one + other) / 2 / cost.edge))

    tiny = 1e-5 * cost.smooth
    ridge = jnp.stack([tiny, tiny, cost.straight, cost.straight])
    N, b = (_smooth_nodes_jax(_average_pixels(part)) for part in (N, b))
    return NormalEquations(N, b, weights(1), weights(0), cost.smooth * jnp.ones(4, p.dtype), ridge)


def _pull(eq: NormalEquations, q: Array) -> Array:
    """Return (smooth Laplacian + ridge) q."""
    x = eq.across[..., None] * jnp.diff(q, axis=1)
    y = eq.down[..., None] * jnp.diff(q, axis=0)
    rough = jnp.pad(x, [(0, 0), (1, 0), (0, 0)]) - jnp.pad(x, [(0, 0), (0, 1), (0, 0)])
    rough = rough + jnp.pad(y, [(1, 0), (0, 0), (0, 0)]) - jnp.pad(y, [(0, 1), (0, 0), (0, 0)])
    return eq.smooth * rough + eq.ridge * q


def normal_equation_residual(p: Array, images: MotionImages, cost: CostParams) -> Array:
    """Return the right-hand side of the normal equations, which vanishes at convergence.

    Args:
        p: (rows, columns, 4) trajectories of nodes, px.
        images: The images.
        cost: Parameters of the cost.

    Returns:
        F, (rows, columns, 4).
    """
    eq = linearise_jax(p, images, cost)
    return eq.b - _pull(eq, p)


@full_precision
def _solve_jax(eq: NormalEquations, right: Array) -> Array:
    degree = jnp.pad(eq.across, [(0, 0), (1, 0)]) + jnp.pad(eq.across, [(0, 0), (0, 1)])
    degree = degree + jnp.pad(eq.down, [(1, 0), (0, 0)]) + jnp.pad(eq.down, [(0, 1), (0, 0)])
    diagonal = eq.smooth * degree[..., None] + eq.ridge + 1e-6
    blocks = jnp.linalg.inv(eq.N + diagonal[..., None] * jnp.eye(4, dtype=right.dtype))

    def times(q: Array) -> Array:
        return jnp.einsum("ijab,ijb->ija", eq.N, q) + _pull(eq, q)

    def precondition(q: Array) -> Array:
        return jnp.einsum("ijab,ijb->ija", blocks, q)

    return cg(times, right, tol=1e-6, maxiter=CG_ITERATIONS, M=precondition)[0]


@jax.custom_jvp
def implicit_trajectories(p: Array, images: MotionImages, cost: CostParams) -> Array:
    """Make converged trajectories a differentiable function of images and cost.

    Derivatives are those of the fixpoint. Clipped steps and medians, which act away from it, have
    none, and neither have instants and nodes, which are chosen by data.

    Args:
        p: (rows, columns, 4) converged trajectories of nodes, px.
        images: The images.
        cost: Parameters of the cost.

    Returns:
        p as it is.
    """
    return p


@implicit_trajectories.defjvp
def _differentiate(values: tuple, changes: tuple) -> tuple[Array, Array]:
    p, images, cost = values
    _, *changes_of_data = changes
    eq = linearise_jax(p, images, cost)

    def times(dp: Array) -> Array:
        """Return A dp."""
        return -jax.jvp(lambda q: normal_equation_residual(q, images, cost), (p,), (dp,))[1]

    def solve_all(product: Callable[[Array], Array], right: Array) -> Array:
        def precondition(other: Array) -> Array:
            return _solve_jax(eq, other)

        return bicgstab(product, right, tol=1e-5, maxiter=BICGSTAB_ITERATIONS, M=precondition)[0]

    _, dF = jax.jvp(
        lambda *data: normal_equation_residual(p, *data), (images, cost), tuple(changes_of_data)
    )
    return p, jax.lax.custom_linear_solve(times, dF, solve_all, solve_all)
