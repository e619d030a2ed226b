"""Normal equations of trajectories.

A Gauss-Newton step d of the trajectories p, one of four numbers for every node, solves

    (N + smooth Laplacian + ridge) d = b - smooth Laplacian p - ridge p

with N and b of the images, and a Laplacian that weighs differences between neighbouring nodes.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaxevent.codegen import empty_row_scratch, njit_noalloc, njit_noalloc_inlined, run_over_rows
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    RowScratch,
    bilinear_weights,
    gradient_at_pixel,
    interpolate_path,
    locate_points,
)
from jaxevent.reconstruction.features import Numeric

OUTSIDE_INFORMATION = np.float32(1e-6)  # of values outside the image


class CostParams(NamedTuple):
    """Parameters of the cost that trajectories minimise; `Params` has their meanings.

    Attributes:
        floor: Least variance of an image read between pixels, (ln I)^2.
        robust: Standardised squared residual beyond which weights fall.
        smooth: Weight of differences between nodes, 1 / px^2.
        jump: Difference of motion beyond which costs are linear, px.
        edge: Gradient across which motion may change, ln I / px.
        straight: Weight of acceleration, 1 / px^2.
    """

    floor: Numeric
    robust: Numeric
    smooth: Numeric
    jump: Numeric
    edge: Numeric
    straight: Numeric

    @classmethod
    def of(cls, params: Params) -> "CostParams":
        """Take the parameters of the cost from those of `mc`."""
        return cls(*(np.float32(getattr(params, name)) for name in cls._fields))


class NormalEquations(NamedTuple):
    """The equations of all nodes at some trajectories.

    Attributes:
        N: The 10 entries of the upper triangle of each node's (4, 4) matrix.
        b: Right-hand side of each node.
        across: Weights of differences with the node right; the last column is not used.
        down: Weights of differences with the node below; the last row is not used.
        smooth: Weight of the differences of each component.
        ridge: Weight of the square of each component.
    """

    N: Float[Numeric, "rows columns 10"]
    b: Float[Numeric, "rows columns 4"]
    across: Float[Numeric, "rows columns"]
    down: Float[Numeric, "rows columns"]
    smooth: Float[Numeric, " 4"]
    ridge: Float[Numeric, " 4"]


class PackedImages(NamedTuple):
    """Images at K instants with their gradients."""

    pixels: NDArray[np.float32]  # (K, h, w, 4): log intensity, its variance, gradient along x, y
    times: PathTimes  # float32
    near: NDArray[np.float32]  # (K,), weights with which a robust mean begins

    @classmethod
    def of(cls, pixels: NDArray[np.float32], times: PathTimes) -> "PackedImages":
        """Add the weights, which fall with the distance from the target.

        Args:
            pixels: (K, h, w, 4) packed images; see `trajectories.pack_images`.
            times: Their times, with common displacements in px of these images.

        Returns:
            Images with weights.
        """
        relative = times.s / max_instant_distance(times.s)
        return cls(pixels, times, np.exp(-2 * relative**2).astype(np.float32))


def max_instant_distance(s: NDArray[np.float32]) -> np.float32:
    """Return the largest distance of instants s (K,) from the target."""
    return np.float32(max(float(np.abs(s).max()), 1e-3))


class TrajectorySamples(NamedTuple):
    """Packed images read along the trajectories of pixels."""

    points: NDArray[np.float32]  # (h, 4, K, w): log intensity, robust weight, gradient along x, y
    M: NDArray[np.float32]  # (h, w), their robust mean


@njit_noalloc_inlined
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


@njit_noalloc_inlined
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


@njit_noalloc_inlined
def _read_channels(image, pixel, part, k, points):
    """Write an image's channels at points, bilinear.

    Args:
        image: (h, w, 4) packed image.
        pixel: (2, points) x and y of the pixel before each point.
        part: (2, points) distance from that pixel, px.
        k: Index of the instant.
        points: (4, K, points) output, of which that of k is written.
    """
    h, w, _ = image.shape
    for i in range(pixel.shape[1]):
        x0, y0 = pixel[0, i], pixel[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b, c, d = bilinear_weights(part[0, i], part[1, i])
        for q in range(4):
            points[q, k, i] = (
                a * upper[x0, q] + b * upper[x1, q] + c * lower[x0, q] + d * lower[x1, q]
            )


class _SampleScratch(NamedTuple):
    """Scratch memory for each row that a kernel begins with."""

    rows: RowScratch
    information: NDArray[np.float32]  # (rows, K, w)
    sums: NDArray[np.float32]  # (rows, 2, w)

    @classmethod
    def allocate(cls, rows: int, instants: int, width: int) -> "_SampleScratch":
        """Allocate scratch memory for `run_over_rows`.

        Args:
            rows: Rows that kernels may begin with.
            instants: Number of instants, K.
            width: Width of the images, px.
        """
        shapes = (instants, width), (2, width)
        return cls(RowScratch.allocate(rows, width), *(empty_row_scratch(rows, *s) for s in shapes))


@njit_noalloc_inlined
def _sample_row(y, begin, inputs, scratch, points, means):
    """Sample images along the trajectories of a row of pixels.

    Args:
        y: The row.
        begin: First row of the kernel, whose scratch memory is used.
        inputs: `PackedImages`, trajectories of nodes (rows, columns, 4), px, and `CostParams`.
        scratch: `_SampleScratch`.
        points: (4, K, w) output, as of `TrajectorySamples`.
        means: (w,) output, robust means, ln I.
    """
    images, p, cost = inputs
    count, h, w, _ = images.pixels.shape
    rows, info = scratch.rows, scratch.information[begin]
    path, at, pixel = rows.path[begin], rows.x[begin], rows.pixel[begin]
    part, inside, half = rows.part[begin], rows.inside[begin], np.float32(0.5)
    at_y = np.float32(y) * half - np.float32(0.25)
    for x in range(w):
        at[x] = np.float32(x)
        interpolate_path(p, at_y, np.float32(x) * half - np.float32(0.25), path[:, x])
    for k in range(count):
        row = (path, at, pixel, part, inside)
        locate_points(np.float32(y), images.times, k, (h, w), w, row)
        _read_channels(images.pixels[k], pixel, part, k, points)
        fill_information(points[1, k], inside, cost.floor, info[k])
    found = (points[1], means, scratch.sums[begin])
    robust_means(points[0], info, images.near, cost.robust, found)


@njit_noalloc
def _sample_rows(begin, end, inputs, scratch, out):
    """Read packed images along the trajectories of some rows of pixels.

    Args:
        begin: First row.
        end: Row after the last one.
        inputs: As of `_sample_row`.
        scratch: `_SampleScratch`.
        out: `TrajectorySamples`, output.
    """
    for y in range(begin, end):
        _sample_row(y, begin, inputs, scratch, out.points[y], out.M[y])


def sample_trajectories(
    images: PackedImages, p: NDArray[np.float32], cost: CostParams
) -> TrajectorySamples:
    """Read packed images along trajectories.

    Args:
        images: The packed images.
        p: (rows, columns, 4) trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        What the images show along the trajectories of pixels.
    """
    count, h, w, _ = images.pixels.shape
    points, M = np.empty((h, 4, count, w), np.float32), np.empty((h, w), np.float32)
    samples = TrajectorySamples(points, M)
    scratch = _SampleScratch.allocate(h, count, w)
    run_over_rows(_sample_rows, h, (images, p, cost), scratch, samples)
    return samples


@njit_noalloc_inlined
def _add_product(a, b, out):
    """Add products, element by element.

    Args:
        a: (n,).
        b: (n,).
        out: (n,) added to.
    """
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@njit_noalloc_inlined
def _add_pixels(points, M, s, grad_M, scratch, sums):
    """Add the equations of each pixel of a row to sums.

    The derivative of values by a path's four numbers is J = g (s, s^2). The gradient g along
    trajectories and that of the mean are both that of the scene; the mean of the two has less
    noise. M, the mean of the values by R, is eliminated: J is J - sum R J / sum R.
    Args:
        points: (4, K, w) samples of the row, as of `TrajectorySamples`.
        M: (w,) their means, ln I.
        s: (K,) times relative to the target, -1..1.
        grad_M: (2, w) gradient of the means along x and y, ln I / px.
        scratch: (10, w).
        sums: (14, w) N (10 entries) and b (4), added to.
    """
    J, total, means, r = scratch[:4], scratch[4], scratch[5:9], scratch[9]
    total[:] = np.float32(0)
    means[:] = np.float32(0)
    for k in range(len(s)):
        R = points[1, k]
        for c in range(2):
            for i in range(len(M)):
                J[c, i] = (points[2 + c, k, i] + grad_M[c, i]) * np.float32(0.5) * s[k]
            for i in range(len(M)):
                J[2 + c, i] = J[c, i] * s[k]
        for i in range(len(M)):
            total[i] += R[i]
        entry = 0
        for c in range(4):
            # LLVM takes several pixels at once only in loops over few arrays, where it can check
            # quickly that none overlap.
            for i in range(len(M)):
                r[i] = R[i] * J[c, i]
            for i in range(len(M)):
                means[c, i] += r[i]
            for i in range(len(M)):
                sums[10 + c, i] -= r[i] * (points[0, k, i] - M[i])
            for e in range(c, 4):
                _add_product(r, J[e], sums[entry])
                entry += 1
    entry = 0
    for c in range(4):
        for i in range(len(M)):
            r[i] = -means[c, i] / total[i]
        for e in range(c, 4):
            _add_product(r, means[e], sums[entry])
            entry += 1


@njit_noalloc
def _linearise(begin, end, inputs, scratch, M, out):
    """Write the equations of the nodes of some rows.

    Samples of four rows of pixels are kept: memory does not grow with the image. Rows at the border
    of two threads are sampled by both, so a row of M is written when its means are final.
    Args:
        begin: First row of nodes.
        end: Row after the last one.
        inputs: As of `_sample_row`.
        scratch: `_SampleScratch`, lines (rows, 28, w), and samples (rows, 4, 4, K, w).
        M: (h, w) output, robust means, ln I.
        out: (rows, columns, 15) output: N (10 entries), b (4), and |grad M|, ln I / px.
    """
    h, w = M.shape
    samples, lines, recent = scratch
    own, grad_M, sums = lines[begin, :10], lines[begin, 10:12], lines[begin, 12:27]
    means = lines[begin, 27]
    points, sampled = recent[begin], max(2 * begin - 2, 0)
    for i in range(begin, end):
        sums[:] = np.float32(0)
        below = min(2 * i + 2, h)
        while sampled < min(2 * i + 4, h):
            _sample_row(sampled, begin, inputs, samples, points[sampled % 4], means)
            for x in range(w):
                M[sampled, x] = means[x]
            sampled += 1
        for y in range(2 * i, below):
            for x in range(w):
                gx, gy = gradient_at_pixel(M, y, x)
                grad_M[0, x], grad_M[1, x] = gx, gy
                sums[14, x] += np.sqrt(gx * gx + gy * gy)
            _add_pixels(points[y % 4], M[y], inputs[0].times.s, grad_M, own, sums)
        for j in range(out.shape[1]):
            left, right = 2 * j, min(2 * j + 1, w - 1)
            both = np.float32(right - left)  # 0 or 1
            share = np.float32(1) / (np.float32(below - 2 * i) * (np.float32(1) + both))
            for c in range(15):
                out[i, j, c] = (sums[c, left] + both * sums[c, right]) * share


@njit_noalloc
def _smooth_nodes(values, row, out):
    """Blur nodes by (1, 6, 1) / 8 both ways: by a Gaussian of 1 px.

    Args:
        values: (rows, columns, at least channels) values of nodes.
        row: (columns, channels) scratch.
        out: (rows, columns, channels) output.
    """
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


@njit_noalloc
def _weigh_differences(p, edge, horizon, cost, out):
    """Write the weights of differences between neighbouring nodes.

    Args:
        p: (rows, columns, 4) trajectories, px.
        edge: (rows, columns) |grad M|, ln I / px.
        horizon: Largest distance of an instant from the target, in units of s.
        cost: `CostParams`.
        out: (2, rows, columns) output: with the node to the right, and with that below.
    """
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


def linearise(images: PackedImages, p: NDArray[np.float32], cost: CostParams) -> NormalEquations:
    """Set up the normal equations at some trajectories.

    Args:
        images: The packed images.
        p: (rows, columns, 4) the trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        The equations, N as the 10 entries of its upper triangle.
    """
    shape, (count, h, w, _) = p.shape[:2], images.pixels.shape
    entries, M = np.empty((*shape, 15), np.float32), np.empty((h, w), np.float32)
    samples = _SampleScratch.allocate(shape[0], count, w)
    scratch = (
        samples,
        empty_row_scratch(shape[0], 12 + 15 + 1, w),
        empty_row_scratch(shape[0], 4, 4, count, w),
    )
    run_over_rows(_linearise, shape[0], (images, p, cost), scratch, M, entries)
    blurred = np.empty((*shape, 14), np.float32)
    _smooth_nodes(entries, np.empty((shape[1], 14), np.float32), blurred)
    horizon = max_instant_distance(images.times.s)
    weights = np.zeros((2, *shape), np.float32)
    _weigh_differences(p, entries[..., 14], horizon, cost, weights)
    squared = horizon * horizon
    smooth = cost.smooth * squared * np.array([1, 1, squared, squared], np.float32)
    bend, tiny = cost.straight * squared * squared, np.float32(1e-5) * smooth[0]
    ridge = np.array([tiny, tiny, bend, bend], np.float32)
    return NormalEquations(blurred[..., :10], blurred[..., 10:], *weights, smooth, ridge)


@njit_noalloc_inlined
def _add_difference(weight, a, b, out):
    """Add weighted differences.

    Args:
        weight: (n,) weights.
        a: (n,).
        b: (n,), subtracted from `a`.
        out: (n,) added to.
    """
    for x in range(len(out)):
        out[x] += weight[x] * (a[x] - b[x])


@njit_noalloc_inlined
def _scale_and_add(factor, a, out):
    """Write factor out + a.

    Args:
        factor: The factor.
        a: (n,).
        out: (n,), in place.
    """
    for x in range(len(out)):
        out[x] = factor * out[x] + a[x]


@njit_noalloc_inlined
def _add_scaled(factor, a, out):
    """Add a multiple of a row.

    Args:
        factor: The factor.
        a: (n,).
        out: (n,) added to.
    """
    for x in range(len(out)):
        out[x] += factor * a[x]


@njit_noalloc_inlined
def _multiply(N, i, q, out):
    """Multiply the symmetric 4 x 4 matrices of a row of nodes by vectors.

    Args:
        N: (10, rows, columns) entries of the matrices' upper triangles.
        i: The row.
        q: (4, columns) vectors.
        out: (4, columns) output.
    """
    for c in range(len(out)):  # numbers that are not known are not unrolled: less to compile
        for x in range(out.shape[1]):
            out[c, x] = np.float32(0)
        for e in range(len(out)):
            low, high = min(c, e), max(c, e)
            _add_product(N[low * (7 - low) // 2 + high, i], q[e], out[c])


@njit_noalloc_inlined
def _laplacian(q, across, down, i, out):
    """Write the weighted graph Laplacian of a row of nodes.

    Args:
        q: (rows + 2, columns + 2) one channel, padded by a node.
        across: (rows, columns + 1) weights of differences along rows, 0 at the ends.
        down: (rows + 1, columns) weights of those between rows, 0 at the ends.
        i: The row.
        out: (columns,) output.
    """
    width = len(out)
    here, left, right = q[i + 1, 1:-1], q[i + 1, :width], q[i + 1, 2:]
    out[:] = np.float32(0)
    _add_difference(across[i, :width], here, left, out)
    _add_difference(across[i, 1:], here, right, out)
    _add_difference(down[i], here, q[i, 1:-1], out)
    _add_difference(down[i + 1], here, q[i + 2, 1:-1], out)


@njit_noalloc_inlined
def _invert(N, added, scratch, out):
    """Invert a symmetric positive 4 x 4 matrix.

    Args:
        N: (10,) its upper triangle.
        added: (4,) added to its diagonal.
        scratch: (3, 4, 4) in double precision.
        out: (10,) output, the upper triangle of the inverse.
    """
    # Cholesky, in double precision: nodes without texture are nearly singular.
    A, C, inverse = scratch[0], scratch[1], scratch[2]
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            A[i, j] = N[entry]
            A[j, i] = N[entry]
            entry += 1
        A[i, i] += added[i]
    for i in range(4):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= C[i, k] * C[j, k]
            C[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / C[j, j]
    for j in range(4):  # the inverse of C
        for i in range(j, 4):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= C[i, k] * inverse[k, j]
            inverse[i, j] = total / C[i, i]
    entry = 0
    for i in range(4):
        for j in range(i, 4):
            total = 0.0
            for k in range(j, 4):
                total += inverse[k, i] * inverse[k, j]
            out[entry] = total
            entry += 1


class _SolverScratch(NamedTuple):
    """Scratch memory of conjugate gradients for rows x columns of nodes."""

    blocks: NDArray[np.float32]  # (2, 10, rows, columns), of the equations and their inverses
    beside: NDArray[np.float32]  # (rows, columns + 1), weights of differences, 0 at the ends
    below: NDArray[np.float32]  # (rows + 1, columns), the same between rows
    q: NDArray[np.float32]  # (4, rows + 2, columns + 2), the direction, 0 around the nodes
    vectors: NDArray[np.float32]  # (4, rows, 4, columns)
    lines: NDArray[np.float32]  # (2, columns)
    node: NDArray[np.float32]  # (14,)
    inverse: NDArray[np.float64]  # (3, 4, 4)

    @classmethod
    def zeros(cls, rows: int, columns: int) -> "_SolverScratch":
        """Allocate zeros."""
        shapes = (
            (2, 10, rows, columns), (rows, columns + 1), (rows + 1, columns),
            (4, rows + 2, columns + 2), (4, rows, 4, columns), (2, columns), (14,),
        )  # fmt: skip
        single = [np.zeros(shape, np.float32) for shape in shapes]
        return cls._make([*single, np.zeros((3, 4, 4))])


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


@njit_noalloc
def _solve(eq, p, iterations, scratch, d):
    # Channels come first here, and rows of nodes are what loops go over at once.
    """Solve the normal equations by conjugate gradients.

    Args:
        eq: `NormalEquations`, N as 10 entries.
        p: (rows, columns, 4) trajectories at which they were set up, px.
        iterations: Number of iterations.
        scratch: `_SolverScratch` of zeros.
        d: (rows, columns, 4) output, the step, px.
    """
    rows, columns, channels = p.shape
    smooth, ridge, beside, below, q = eq.smooth, eq.ridge, scratch.beside, scratch.below, scratch.q
    A, P, vectors, node = scratch.blocks[0], scratch.blocks[1], scratch.vectors, scratch.node
    r, found, Aq, z = vectors[0], vectors[1], vectors[2], vectors[3]
    rough, sums, added, block = scratch.lines[0], scratch.lines[1], node[:4], node[4:]
    for i in range(rows):
        for j in range(columns):
            beside[i, j + 1] = eq.across[i, j] if j < columns - 1 else np.float32(0)
            below[i + 1, j] = eq.down[i, j] if i < rows - 1 else np.float32(0)
            for c in range(channels):
                q[c, i + 1, j + 1] = p[i, j, c]
    for i in range(rows):
        for c in range(channels):
            _laplacian(q[c], beside, below, i, rough)
            for j in range(columns):
                pull = smooth[c] * rough[j] + ridge[c] * p[i, j, c]
                r[i, c, j] = eq.b[i, j, c] - pull
        for j in range(columns):
            degree = beside[i, j] + beside[i, j + 1] + below[i, j] + below[i + 1, j]
            for c in range(channels):
                added[c] = smooth[c] * degree + ridge[c] + np.float32(1e-6)
            _invert(eq.N[i, j], added, scratch.inverse, block)
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
                _laplacian(q[c], beside, below, i, rough)
                _add_scaled(smooth[c], rough, Aq[i, c])
                _add_scaled(ridge[c], q[c, i + 1, 1:-1], Aq[i, c])
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
