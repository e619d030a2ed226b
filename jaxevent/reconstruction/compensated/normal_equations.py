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

from jaxevent.codegen import (
    njit_disjoint_inlined,
    njit_noalloc,
    njit_noalloc_inlined,
    row_scratch,
    run_over_rows,
)
from jaxevent.codegen.functions import exp32
from jaxevent.devices import full_precision
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    RowScratch,
    bilinear_weights,
    gradient_at_pixel,
    gradient_jax,
    interpolate_path,
    interpolate_paths_jax,
    is_in_image,
    locate_points,
    pad_edges,
    path_positions,
    sample_bilinear,
)
from jaxevent.reconstruction.features import Numeric

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
    """Write an image's channels at points, bilinear: (4, K, points)."""
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
        return cls(RowScratch.allocate(rows, width), *(row_scratch(rows, *s) for s in shapes))


@njit_noalloc_inlined
def _sample_row(y, begin, inputs, scratch, points, means):
    """Write what images show along the trajectories of a row: (4, K, w), and their means (w,)."""
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
def _sample(begin, end, inputs, scratch, out):
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
    run_over_rows(_sample, h, (images, p, cost), scratch, samples)
    return samples


@njit_disjoint_inlined
def _add_instant(shown, scene, s, sums, means):
    """Add the equations of an instant at `s` to those of the pixels of a row.

    `shown` are log intensity, robust weight and gradient along x and y, `scene` is the mean and its
    gradient, `sums` N (10) and b (4), and `means` the sums of R and of R J (4), all (w,).
    """
    (level, R, gx, gy), (M, mean_gx, mean_gy) = shown, scene
    N0, N1, N2, N3, N4, N5, N6, N7, N8, N9, b0, b1, b2, b3 = sums
    total, mean0, mean1, mean2, mean3 = means
    half = np.float32(0.5)
    for x in range(len(M)):
        J0, J1 = (gx[x] + mean_gx[x]) * half * s, (gy[x] + mean_gy[x]) * half * s
        J2, J3, e = J0 * s, J1 * s, level[x] - M[x]
        r0, r1, r2, r3 = R[x] * J0, R[x] * J1, R[x] * J2, R[x] * J3
        total[x] += R[x]
        mean0[x] += r0
        mean1[x] += r1
        mean2[x] += r2
        mean3[x] += r3
        b0[x] -= r0 * e
        b1[x] -= r1 * e
        b2[x] -= r2 * e
        b3[x] -= r3 * e
        N0[x] += r0 * J0
        N1[x] += r0 * J1
        N2[x] += r0 * J2
        N3[x] += r0 * J3
        N4[x] += r1 * J1
        N5[x] += r1 * J2
        N6[x] += r1 * J3
        N7[x] += r2 * J2
        N8[x] += r2 * J3
        N9[x] += r3 * J3


@njit_noalloc_inlined
def _add_product(a, b, out):
    for i in range(len(out)):
        out[i] += a[i] * b[i]


@njit_noalloc_inlined
def _add_pixels(points, M, s, grad_M, scratch, sums):
    """Add the equations of each pixel of a row to sums (14, w): N (10) and b (4).

    `points` are the row's, as of `TrajectorySamples`, and M (w,) are their means.

    The derivative of values by a path's four numbers is J = g (s, s^2). The gradient g along
    trajectories and that of the mean, `grad_M` (2, w), are both that of the scene; the mean of the
    two has less noise. M, the mean of the values by R, is eliminated: J is J - sum R J / sum R.
    """
    total, means, r = scratch[0], scratch[1:5], scratch[5]
    total[:] = np.float32(0)
    means[:] = np.float32(0)
    scene = M, grad_M[0], grad_M[1]
    all_sums = (
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6],
        sums[7], sums[8], sums[9], sums[10], sums[11], sums[12], sums[13],
    )  # fmt: skip
    all_means = total, means[0], means[1], means[2], means[3]
    for k in range(len(s)):
        shown = points[0, k], points[1, k], points[2, k], points[3, k]
        _add_instant(shown, scene, s[k], all_sums, all_means)
    entry = 0
    for c in range(4):
        for i in range(len(M)):
            r[i] = -means[c, i] / total[i]
        for e in range(c, 4):
            _add_product(r, means[e], sums[entry])
            entry += 1


@njit_disjoint_inlined
def _average_pairs(row, factor, out):
    """Write the means of pairs of neighbours times a factor; the last one may be alone."""
    half = np.float32(0.5) * factor
    for j in range(len(row) // 2):
        out[j] = (row[2 * j] + row[2 * j + 1]) * half
    if len(row) % 2:
        out[len(out) - 1] = row[len(row) - 1] * factor


@njit_noalloc
def _linearise(begin, end, inputs, scratch, M, out):
    """Write N (10 entries) and b (4) of the nodes of some rows, and |grad M|: 15 images.

    Samples of four rows of pixels are kept: memory does not grow with the image. Rows at the border
    of two threads are sampled by both, so a row of M is written when its means are final.
    """
    h, w = M.shape
    samples, lines, recent = scratch
    own, grad_M, sums = lines[begin, :6], lines[begin, 6:8], lines[begin, 8:23]
    means = lines[begin, 23]
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
        for c in range(15):
            _average_pairs(sums[c], np.float32(1) / np.float32(below - 2 * i), out[c, i])


@njit_disjoint_inlined
def _blur_three(before, here, after, out):
    for j in range(len(out)):
        out[j] = (before[j] + np.float32(6) * here[j] + after[j]) * np.float32(0.125)


@njit_noalloc
def _smooth_nodes(values, row, out):
    """Blur images of nodes by (1, 6, 1) / 8: by a Gaussian of 1 px; `row` is padded by a node."""
    channels, rows, columns = out.shape
    for c in range(channels):
        for i in range(rows):
            up, down = values[c, max(i - 1, 0)], values[c, min(i + 1, rows - 1)]
            _blur_three(up, values[c, i], down, row[1 : columns + 1])
            row[0], row[columns + 1] = row[1], row[columns]
            _blur_three(row[:columns], row[1 : columns + 1], row[2:], out[c, i])


@njit_disjoint_inlined
def _weigh_row(own, others, edges, numbers, out):
    """Write the weights of differences between the nodes of a row and others."""
    (here, there), (horizon, jump, scale), half = edges, numbers, np.float32(0.5)
    for j in range(len(out)):
        dx = (others[j, 0] - own[j, 0]) * horizon
        dy = (others[j, 1] - own[j, 1]) * horizon
        weight = jump / np.sqrt(dx * dx + dy * dy + jump * jump)
        smooth = exp32(-(here[j] + there[j]) * half / scale)
        out[j] = weight * (np.float32(0.1) + np.float32(0.9) * smooth)


@njit_noalloc
def _weigh_differences(p, edge, horizon, cost, out):
    """Write the weights of differences between neighbouring nodes, across and down."""
    rows, columns, _ = p.shape
    numbers, last = (horizon, np.float32(cost.jump), np.float32(cost.edge)), columns - 1
    for i in range(rows):
        near = edge[i, :last], edge[i, 1:]
        _weigh_row(p[i, :last], p[i, 1:], near, numbers, out[0, i, :last])
        if i < rows - 1:
            _weigh_row(p[i], p[i + 1], (edge[i], edge[i + 1]), numbers, out[1, i])


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
    entries, M = np.empty((15, *shape), np.float32), np.empty((h, w), np.float32)
    samples = _SampleScratch.allocate(shape[0], count, w)
    scratch = samples, row_scratch(shape[0], 8 + 15 + 1, w), row_scratch(shape[0], 4, 4, count, w)
    run_over_rows(_linearise, shape[0], (images, p, cost), scratch, M, entries)
    blurred = np.empty((14, *shape), np.float32)
    _smooth_nodes(entries, np.empty(shape[1] + 2, np.float32), blurred)
    horizon = max_instant_distance(images.times.s)
    weights = np.zeros((2, *shape), np.float32)
    _weigh_differences(p, entries[14], horizon, cost, weights)
    squared = horizon * horizon
    smooth = cost.smooth * squared * np.array([1, 1, squared, squared], np.float32)
    bend, tiny = cost.straight * squared * squared, np.float32(1e-5) * smooth[0]
    ridge = np.array([tiny, tiny, bend, bend], np.float32)
    N, b = np.moveaxis(blurred[:10], 0, -1), np.moveaxis(blurred[10:], 0, -1)
    return NormalEquations(N, b, *weights, smooth, ridge)


@njit_disjoint_inlined
def _fill_laplacian(weights, here, beside, beyond, out):
    """Write the weighted graph Laplacian of a row.

    Args:
        weights: Of the differences from the nodes to the left and right, above and below.
        here: The row.
        beside: The nodes to the left and right.
        beyond: The rows above and below.
        out: Output.
    """
    (left_weight, right_weight, up_weight, down_weight), (left, right) = weights, beside
    up, down = beyond
    for x in range(len(out)):
        total = left_weight[x] * (here[x] - left[x])
        total += right_weight[x] * (here[x] - right[x])
        total += up_weight[x] * (here[x] - up[x])
        out[x] = total + down_weight[x] * (here[x] - down[x])


@njit_noalloc_inlined
def _laplacian(q, weights, i, out):
    """Write the Laplacian of a row of nodes that are padded by one."""
    width = len(out)
    beside = q[i + 1, :width], q[i + 1, 2 : width + 2]
    beyond = q[i, 1 : width + 1], q[i + 2, 1 : width + 1]
    _fill_laplacian(weights, q[i + 1, 1 : width + 1], beside, beyond, out)


@njit_disjoint_inlined
def _multiply(N, q, rough, numbers, out, sums):
    """Multiply a row of nodes by the matrix of the equations, and add its products with the result.

    Args:
        N: (10, columns) entries of the nodes' matrices.
        q: (4, columns) the row.
        rough: (4, columns) its Laplacian.
        numbers: `smooth` and `ridge` of each.
        out: (4, columns) output.
        sums: (columns,) output, to which the products of `q` and `out` are added.
    """
    N0, N1, N2, N3, N4, N5, N6, N7, N8, N9 = (
        N[0], N[1], N[2], N[3], N[4], N[5], N[6], N[7], N[8], N[9],
    )  # fmt: skip
    q0, q1, q2, q3, (smooth, ridge) = q[0], q[1], q[2], q[3], numbers
    rough0, rough1, rough2, rough3 = rough[0], rough[1], rough[2], rough[3]
    out0, out1, out2, out3 = out[0], out[1], out[2], out[3]
    for x in range(len(sums)):
        a, b, c, d = q0[x], q1[x], q2[x], q3[x]
        y0 = N0[x] * a + N1[x] * b + N2[x] * c + N3[x] * d
        y1 = N1[x] * a + N4[x] * b + N5[x] * c + N6[x] * d
        y2 = N2[x] * a + N5[x] * b + N7[x] * c + N8[x] * d
        y3 = N3[x] * a + N6[x] * b + N8[x] * c + N9[x] * d
        y0 = y0 + smooth[0] * rough0[x] + ridge[0] * a
        y1 = y1 + smooth[1] * rough1[x] + ridge[1] * b
        y2 = y2 + smooth[2] * rough2[x] + ridge[2] * c
        y3 = y3 + smooth[3] * rough3[x] + ridge[3] * d
        out0[x], out1[x], out2[x], out3[x] = y0, y1, y2, y3
        sums[x] = sums[x] + a * y0 + b * y1 + c * y2 + d * y3


@njit_disjoint_inlined
def _precondition(P, r, out, sums):
    """Multiply a row of nodes by symmetric matrices, and add its products with the result."""
    P0, P1, P2, P3, P4, P5, P6, P7, P8, P9 = (
        P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9],
    )  # fmt: skip
    r0, r1, r2, r3 = r[0], r[1], r[2], r[3]
    out0, out1, out2, out3 = out[0], out[1], out[2], out[3]
    for x in range(len(sums)):
        a, b, c, d = r0[x], r1[x], r2[x], r3[x]
        y0 = P0[x] * a + P1[x] * b + P2[x] * c + P3[x] * d
        y1 = P1[x] * a + P4[x] * b + P5[x] * c + P6[x] * d
        y2 = P2[x] * a + P5[x] * b + P7[x] * c + P8[x] * d
        y3 = P3[x] * a + P6[x] * b + P8[x] * c + P9[x] * d
        out0[x], out1[x], out2[x], out3[x] = y0, y1, y2, y3
        sums[x] = sums[x] + a * y0 + b * y1 + c * y2 + d * y3


@njit_disjoint_inlined
def _scale_and_add(factor, a, out):
    """Write factor out + a."""
    for x in range(len(out)):
        out[x] = factor * out[x] + a[x]


@njit_disjoint_inlined
def _add_scaled(factor, a, out):
    for x in range(len(out)):
        out[x] += factor * a[x]


@njit_disjoint_inlined
def _invert(N, weights, numbers, out):
    """Write the inverses (10 entries) of symmetric matrices with the rest of the diagonal added.

    That is the nodes' own part of the Laplacian by `weights`, times `smooth`, and `ridge`.
    """
    # By Cholesky's factors C, in double precision: nodes without texture are nearly singular.
    N0, N1, N2, N3, N4, N5, N6, N7, N8, N9 = (
        N[0], N[1], N[2], N[3], N[4], N[5], N[6], N[7], N[8], N[9],
    )  # fmt: skip
    out0, out1, out2, out3, out4, out5, out6, out7, out8, out9 = out
    (left, right, up, down), (smooth, ridge), tiny = weights, numbers, 1e-12
    for x in range(len(left)):
        degree, least = left[x] + right[x] + up[x] + down[x], np.float32(1e-6)
        a00 = np.float64(N0[x]) + (smooth[0] * degree + ridge[0] + least)
        a11 = np.float64(N4[x]) + (smooth[1] * degree + ridge[1] + least)
        a22 = np.float64(N7[x]) + (smooth[2] * degree + ridge[2] + least)
        a33 = np.float64(N9[x]) + (smooth[3] * degree + ridge[3] + least)
        i00 = 1 / np.sqrt(max(a00, tiny))
        c10, c20, c30 = N1[x] * i00, N2[x] * i00, N3[x] * i00
        i11 = 1 / np.sqrt(max(a11 - c10 * c10, tiny))
        c21, c31 = (N5[x] - c20 * c10) * i11, (N6[x] - c30 * c10) * i11
        i22 = 1 / np.sqrt(max(a22 - c20 * c20 - c21 * c21, tiny))
        c32 = (N8[x] - c30 * c20 - c31 * c21) * i22
        i33 = 1 / np.sqrt(max(a33 - c30 * c30 - c31 * c31 - c32 * c32, tiny))
        i10, i21, i32 = -c10 * i00 * i11, -c21 * i11 * i22, -c32 * i22 * i33  # the inverse of C
        i20, i31 = -(c20 * i00 + c21 * i10) * i22, -(c31 * i11 + c32 * i21) * i33
        i30 = -(c30 * i00 + c31 * i10 + c32 * i20) * i33
        out0[x], out1[x] = i00**2 + i10**2 + i20**2 + i30**2, i10 * i11 + i20 * i21 + i30 * i31
        out2[x], out3[x], out4[x] = i20 * i22 + i30 * i32, i30 * i33, i11**2 + i21**2 + i31**2
        out5[x], out6[x], out7[x] = i21 * i22 + i31 * i32, i31 * i33, i22**2 + i32**2
        out8[x], out9[x] = i32 * i33, i33**2


class _Equations(NamedTuple):
    """Normal equations with images of nodes first."""

    N: NDArray[np.float32]  # (10, rows, columns)
    b: NDArray[np.float32]  # (4, rows, columns)
    across: NDArray[np.float32]  # (rows, columns)
    down: NDArray[np.float32]
    smooth: NDArray[np.float32]  # (4,)
    ridge: NDArray[np.float32]


class _SolverScratch(NamedTuple):
    """Scratch memory of conjugate gradients for rows x columns of nodes."""

    inverse: NDArray[np.float32]  # (rows, 10, columns)
    beside: NDArray[np.float32]  # (rows, columns + 1), weights of differences, 0 at the ends
    below: NDArray[np.float32]  # (rows + 1, columns), the same between rows
    q: NDArray[np.float32]  # (4, rows + 2, columns + 2), the direction, 0 around the nodes
    vectors: NDArray[np.float32]  # (4, rows, 4, columns)
    lines: NDArray[np.float32]  # (5, columns)

    @classmethod
    def zeros(cls, rows: int, columns: int) -> "_SolverScratch":
        """Allocate zeros."""
        shapes = (
            (rows, 10, columns), (rows, columns + 1), (rows + 1, columns),
            (4, rows + 2, columns + 2), (4, rows, 4, columns), (5, columns),
        )  # fmt: skip
        return cls._make(np.zeros(shape, np.float32) for shape in shapes)


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
    N, b = (np.ascontiguousarray(np.moveaxis(part, -1, 0)) for part in eq[:2])
    _solve(_Equations(N, b, *eq[2:]), p, iterations, _SolverScratch.zeros(*p.shape[:2]), d)
    return d


@njit_noalloc_inlined
def _total(row):
    total = 0.0
    for j in range(len(row)):
        total += row[j]
    return total


@njit_noalloc
def _solve(eq, p, iterations, scratch, d):
    (rows, columns, channels), end = p.shape, p.shape[1] + 1
    numbers, beside, below, q = (eq.smooth, eq.ridge), scratch.beside, scratch.below, scratch.q
    vectors, rough, sums, P = scratch.vectors, scratch.lines[:4], scratch.lines[4], scratch.inverse
    r, found, Aq, z = vectors[0], vectors[1], vectors[2], vectors[3]
    for i in range(rows):
        for j in range(columns):
            beside[i, j + 1] = eq.across[i, j] if j < columns - 1 else np.float32(0)
            below[i + 1, j] = eq.down[i, j] if i < rows - 1 else np.float32(0)
            for c in range(channels):
                q[c, i + 1, j + 1] = p[i, j, c]
    sums[:] = np.float32(0)
    for i in range(rows):
        weights = beside[i, :columns], beside[i, 1:end], below[i], below[i + 1]
        inverse = (
            P[i, 0], P[i, 1], P[i, 2], P[i, 3], P[i, 4], P[i, 5], P[i, 6], P[i, 7], P[i, 8], P[i, 9]
        )  # fmt: skip
        _invert(eq.N[:, i], weights, numbers, inverse)
        for c in range(channels):
            _laplacian(q[c], weights, i, rough[c])
            for j in range(columns):
                pull = eq.smooth[c] * rough[c, j] + eq.ridge[c] * q[c, i + 1, j + 1]
                r[i, c, j] = eq.b[c, i, j] - pull
        _precondition(P[i], r[i], z[i], sums)
    rz, share = _total(sums), np.float32(0)
    q[:, 1 : rows + 1, 1:end] = np.float32(0)
    for _ in range(iterations):
        for i in range(rows):
            for c in range(channels):
                _scale_and_add(share, z[i, c], q[c, i + 1, 1:end])
        sums[:] = np.float32(0)
        for i in range(rows):
            weights = beside[i, :columns], beside[i, 1:end], below[i], below[i + 1]
            for c in range(channels):
                _laplacian(q[c], weights, i, rough[c])
            _multiply(eq.N[:, i], q[:, i + 1, 1:end], rough, numbers, Aq[i], sums)
        step = np.float32(rz / (_total(sums) + 1e-20))
        sums[:] = np.float32(0)
        for i in range(rows):
            for c in range(channels):
                _add_scaled(step, q[c, i + 1, 1:end], found[i, c])
                _add_scaled(-step, Aq[i, c], r[i, c])
            _precondition(P[i], r[i], z[i], sums)
        following = _total(sums)
        share, rz = np.float32(following / (rz + 1e-20)), following
    for i in range(rows):
        for c in range(channels):
            for j in range(columns):
                d[i, j, c] = found[i, c, j]


class MotionImages(NamedTuple):
    """Images that motion is estimated from, for derivatives."""

    L: Float[Numeric, "k h w"]  # log intensity
    V: Float[Numeric, "k h w"]  # its variance, (ln I)^2
    times: PathTimes
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
    L, V, times, present = images
    count, h, w = L.shape
    Y, X = (one.astype(p.dtype) for one in path_positions(interpolate_paths_jax(p, h, w), times))
    inside = is_in_image(Y, X, h, w)
    gx, gy = gradient_jax(L)
    L, V, gx, gy = (sample_bilinear(image, Y, X) for image in (L, V, gx, gy))
    W = present[:, None, None] * jnp.where(inside, 1 / (V + cost.floor), OUTSIDE_INFORMATION)
    s = jnp.asarray(times.s)[:, None, None]
    R = W * jnp.exp(-2 * s**2)
    M = (R * L).sum(0) / R.sum(0)
    for _ in range(2):
        R = W / (1 + (L - M) ** 2 * W / cost.robust)
        M = (R * L).sum(0) / R.sum(0)
    mx, my = gradient_jax(M)
    J = jnp.stack([(gx + mx) / 2 * s, (gy + my) / 2 * s])
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

    _, change = jax.linearize(lambda q: normal_equation_residual(q, images, cost), p)

    def times(dp: Array) -> Array:
        """Return A dp."""
        return -change(dp)

    def solve_all(product: Callable[[Array], Array], right: Array) -> Array:
        def precondition(other: Array) -> Array:
            return _solve_jax(eq, other)

        return bicgstab(product, right, tol=1e-5, maxiter=BICGSTAB_ITERATIONS, M=precondition)[0]

    _, dF = jax.jvp(
        lambda *data: normal_equation_residual(p, *data), (images, cost), tuple(changes_of_data)
    )
    return p, jax.lax.custom_linear_solve(times, dF, solve_all, solve_all)
