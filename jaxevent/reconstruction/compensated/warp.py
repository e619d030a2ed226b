"""Images read along the paths of scene points: in numba loops, and in JAX for derivatives.

A path (vx, vy, ax, ay) belongs to the point that the target's image shows at the pixel x. At the
instant s, -1..1, the point lies at x + v s + a s^2 + c. Here c is a displacement at that instant
that all points share. Paths are given at nodes, one per 2 x 2 pixels, and interpolated bilinearly
between them. Functions whose names end in `_jax` are differentiable.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.codegen import (
    empty_row_scratch,
    njit_noalloc,
    njit_noalloc_inlined,
    read_only,
    run_over_rows,
)
from jaxevent.precision import full_precision
from jaxevent.reconstruction.features import Numeric

MAX_MATRIX_PX = 256  # rows of a matrix that filters images
GRADIENT_TAPS = (1 / 12, -8 / 12, 0.0, 8 / 12, -1 / 12)
CUBIC_SLOPE = -0.75  # derivative of the cubic kernel at 1 px, as in OpenCV


class PathTimes(NamedTuple):
    """Instants on the clock of paths, and the displacement that all points share at each."""

    s: Float[Numeric, " k"]  # relative to the target, -1..1
    common: Float[Numeric, "k 2"]  # displacement along x and y, px

    @classmethod
    def without_common(cls, s: NDArray[np.float32]) -> "PathTimes":
        """Make instants s (K,) at which paths alone describe the motion."""
        return cls(s, np.zeros((len(s), 2), np.float32))

    def at_level(self, level: int) -> "PathTimes":
        """Convert to pixels of a level of the image pyramid; 0 is full resolution."""
        return PathTimes(self.s, self.common * np.float32(0.5**level))

    def take(self, chosen: Any) -> "PathTimes":
        """Choose some of the instants."""
        return PathTimes(self.s[chosen], self.common[chosen])


class WarpedImages(NamedTuple):
    """Images at K instants, sampled at the target's points."""

    L: Float[Numeric, "k h w"]  # log intensity, bicubic
    V: Float[Numeric, "k h w"]  # its variance, (ln I)^2, bilinear
    clear: Float[Numeric, "k h w"]  # 1 where a frame shows the point unclipped, bilinear
    inside: Float[Numeric, "k h w"]  # 1, or 0 beyond the image's border


class RowScratch(NamedTuple):
    """Scratch memory for the points of one row, one set per row; see `empty_row_scratch`."""

    path: NDArray[np.float32]  # (rows, 4, points)
    x: NDArray[np.float32]  # (rows, points), px, at the target
    pixel: NDArray[np.int32]  # (rows, 2, points), x and y of the pixel before each point
    part: NDArray[np.float32]  # (rows, 2, points), distance from that pixel, px
    inside: NDArray[np.float32]  # (rows, points), 1, or 0 beyond the image's border

    @classmethod
    def allocate(cls, rows: int, points: int) -> "RowScratch":
        """Allocate scratch memory for `run_over_rows`."""
        path, part = empty_row_scratch(rows, 4, points), empty_row_scratch(rows, 2, points)
        x, inside = empty_row_scratch(rows, points), empty_row_scratch(rows, points)
        return cls(path, x, np.empty((rows, 2, points), np.int32), part, inside)


@njit_noalloc_inlined
def gradient_at_pixel(image, y, x):
    """Return the gradient along x and y at a pixel: five taps, exact for quartic polynomials.

    Args:
        image: (h, w) float32.
        y: Row of the pixel.
        x: Column of the pixel.
    """
    h, w = image.shape
    up, down, up2, down2 = max(y - 1, 0), min(y + 1, h - 1), max(y - 2, 0), min(y + 2, h - 1)
    left, right, left2, right2 = max(x - 1, 0), min(x + 1, w - 1), max(x - 2, 0), min(x + 2, w - 1)
    eight, twelfth = np.float32(8), np.float32(1 / 12)
    gx = eight * (image[y, right] - image[y, left]) - image[y, right2] + image[y, left2]
    gy = eight * (image[down, x] - image[up, x]) - image[down2, x] + image[up2, x]
    return gx * twelfth, gy * twelfth


@functools.cache
def _filter_matrix(size: int, taps: tuple[float, ...]) -> NDArray[np.float64]:
    """Make the matrix that filters along an axis; see `filter_along`.

    Args:
        size: Length of the axis, px.
        taps: The filter.

    Returns:
        (size, size).
    """
    matrix, rows = np.zeros((size, size)), np.arange(size)
    for offset, tap in enumerate(taps, -(len(taps) // 2)):
        np.add.at(matrix, (rows, np.clip(rows + offset, 0, size - 1)), tap)
    return matrix


@full_precision
def filter_along(images: Array, axis: int, taps: tuple[float, ...]) -> Array:
    """Filter images along an axis; the border goes on.

    The filter is a matrix, so that a derivative is one product, too. That of a sum of moved images
    has ten times as many operations to compile, and takes five times as long. Few elements of a
    large matrix are not 0, so that it is applied piece by piece.

    Args:
        images: (..., h, w).
        axis: -2 to filter along y, -1 along x.
        taps: The filter, an odd number of taps.

    Returns:
        (..., h, w).
    """
    size, reach, place = images.shape[axis], len(taps) // 2, images.ndim + axis
    matrix, parts = _filter_matrix(size, taps).astype(images.dtype), []
    for rows in np.array_split(np.arange(size), -(-size // MAX_MATRIX_PX)):
        low, high = max(rows[0] - reach, 0), min(rows[-1] + reach + 1, size)
        part = jax.lax.slice_in_dim(images, low, high, axis=place)
        weights = matrix[rows, low:high]
        parts.append(weights @ part if axis == -2 else part @ weights.T)
    return jnp.concatenate(parts, place)


@full_precision
def sum_images(images: Array, weights: Numeric | None = None) -> Array:
    """Sum images pixel by pixel, as a product, a twentieth of the time of a sum over the axis.

    Args:
        images: (K, h, w).
        weights: (..., K) weights of the images; None: 1.

    Returns:
        (..., h, w).
    """
    weights = jnp.ones(len(images)) if weights is None else jnp.asarray(weights)
    return jnp.tensordot(weights.astype(images.dtype), images, 1)


def gradient_jax(images: Array) -> tuple[Array, Array]:
    """Return the gradients of images (..., h, w) along x and y, as `gradient_at_pixel` does."""
    along_x, along_y = (filter_along(images, axis, GRADIENT_TAPS) for axis in (-1, -2))
    return along_x, along_y


@njit_noalloc_inlined
def bilinear_cell(X, Y, h, w):
    """Return the cell of four pixels around a point: x0, y0, x1, y1, and fx, fy in 0..1.

    Args:
        X: Column of the point, px; beyond the border, the nearest point inside is taken.
        Y: Row of the point, px, likewise.
        h: Height of the image, px.
        w: Width of the image, px.
    """
    zero = np.float32(0)
    X = min(max(X, zero), np.float32(w - 1))
    Y = min(max(Y, zero), np.float32(h - 1))
    x0, y0 = min(int(X), max(w - 2, 0)), min(int(Y), max(h - 2, 0))
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    return x0, y0, x1, y1, X - np.float32(x0), Y - np.float32(y0)


@njit_noalloc_inlined
def bilinear_weights(fx, fy):
    """Return the weights of the four pixels of a cell.

    Args:
        fx: Distance from the first pixel along x, 0..1.
        fy: Distance along y, 0..1.

    Returns:
        Weights of (y0, x0), (y0, x1), (y1, x0) and (y1, x1).
    """
    one = np.float32(1)
    return (one - fy) * (one - fx), (one - fy) * fx, fy * (one - fx), fy * fx


@njit_noalloc_inlined
def blend_nodes(p, cell, out_path):
    """Interpolate the path at a point inside a cell of four nodes.

    Args:
        p: (rows, columns, 4) paths of nodes.
        cell: Column and row of the first node and of the last, and x and y (0..1) between them.
        out_path: (4,) output.
    """
    j, i, j1, i1, fx, fy = cell
    for c in range(4):
        top = p[i, j, c] + fx * (p[i, j1, c] - p[i, j, c])
        bottom = p[i1, j, c] + fx * (p[i1, j1, c] - p[i1, j, c])
        out_path[c] = top + fy * (bottom - top)


@njit_noalloc_inlined
def interpolate_path(p, node_y, node_x, out_path):
    """Interpolate the path at a position in the grid of nodes.

    Args:
        p: (rows, columns, 4) paths of nodes.
        node_y: Row of the position, in nodes.
        node_x: Column of the position, in nodes.
        out_path: (4,) output.
    """
    rows, columns, _ = p.shape
    node_y = min(max(node_y, np.float32(0)), np.float32(rows - 1))
    node_x = min(max(node_x, np.float32(0)), np.float32(columns - 1))
    i, j = int(node_y), int(node_x)
    i1, j1 = min(i + 1, rows - 1), min(j + 1, columns - 1)
    blend_nodes(p, (j, i, j1, i1, node_x - np.float32(j), node_y - np.float32(i)), out_path)


@njit_noalloc
def _resample(begin, end, p, scale, factor, out):
    """Resample the paths of nodes on a grid of another spacing that covers the same area.

    Args:
        begin: First row of the output.
        end: Row after the last one.
        p: (rows, columns, 4) paths.
        scale: Points of the output per node, along each axis.
        factor: Factor on the paths, to convert their unit.
        out: (rows, columns, 4) output.
    """
    ratio, half = np.float32(1) / scale, np.float32(0.5)
    for i in range(begin, end):
        at_y = (np.float32(i) + half) * ratio - half
        for j in range(out.shape[1]):
            interpolate_path(p, at_y, (np.float32(j) + half) * ratio - half, out[i, j])
            for c in range(4):
                out[i, j, c] *= factor


def interpolate_paths(p: NDArray[np.float32], image_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Interpolate the paths of nodes to all pixels.

    Args:
        p: (rows, columns, 4) paths of nodes, px.
        image_shape: Height and width of the image, px.

    Returns:
        (h, w, 4) paths of pixels, px.
    """
    out = np.empty((*image_shape, 4), np.float32)
    run_over_rows(_resample, image_shape[0], p, np.float32(2), np.float32(1), out)
    return out


def resize_nodes(
    p: NDArray[np.float32], shape: tuple[int, int], finer: bool
) -> NDArray[np.float32]:
    """Resample the paths of nodes for images of twice (`finer`) or half the resolution.

    Args:
        p: (rows, columns, 4) paths, in pixels of the old resolution.
        shape: Rows and columns of the new nodes.
        finer: Whether the new resolution is twice the old one, rather than half.

    Returns:
        (*shape, 4) paths, in pixels of the new resolution.
    """
    out, scale = np.empty((*shape, 4), np.float32), np.float32(2 if finer else 0.5)
    run_over_rows(_resample, shape[0], p, scale, scale, out)
    return out


def interpolate_paths_jax(p: Array, height: int, width: int) -> Array:
    """Interpolate the paths of nodes to all pixels, as `interpolate_paths` does.

    Args:
        p: (rows, columns, 4) paths of nodes, px.
        height: Height of the image, px.
        width: Its width, px.

    Returns:
        (height, width, 4) paths of pixels, px.
    """
    Y = jnp.broadcast_to(jnp.arange(height)[:, None] / 2 - 0.25, (4, height, width))
    X = jnp.broadcast_to(jnp.arange(width) / 2 - 0.25, (4, height, width))
    return jnp.moveaxis(sample_bilinear(jnp.moveaxis(p, -1, 0), Y, X), 0, -1)


@njit_noalloc_inlined
def locate_points(y, times, k, image_shape, n_points, scratch_row):
    """Locate the points of a row at an instant: fill `pixel`, `part` and `inside`.

    Args:
        y: The row, px.
        times: `PathTimes`.
        k: Index of the instant.
        image_shape: Height and width of the image, px.
        n_points: Number of points to locate, from the first on.
        scratch_row: The parts of a `RowScratch` for one row.
    """
    h, w = image_shape
    s, common_x, common_y = times.s[k], times.common[k, 0], times.common[k, 1]
    path, x, pixel, part, inside = scratch_row
    one, zero, half = np.float32(1), np.float32(0), np.float32(0.5)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    last_x, last_y = np.int32(max(w - 2, 0)), np.int32(max(h - 2, 0))
    for i in range(n_points):
        X = x[i] + (path[0, i] + path[2, i] * s) * s + common_x
        Y = y + (path[1, i] + path[3, i] * s) * s + common_y
        here = (X >= -half) & (X <= right + half) & (Y >= -half) & (Y <= bottom + half)
        inside[i] = one if here else zero
        # Written so that NaN becomes 0, too, and no index lies outside.
        X, Y = X if X > zero else zero, Y if Y > zero else zero
        X, Y = min(X, right), min(Y, bottom)
        x0, y0 = min(np.int32(X), last_x), min(np.int32(Y), last_y)
        pixel[0, i], pixel[1, i] = x0, y0
        part[0, i], part[1, i] = X - np.float32(x0), Y - np.float32(y0)


@njit_noalloc_inlined
def _cubic_weights(part, out):
    """Compute the cubic weights of the four pixels around each point along an axis.

    Args:
        part: (points,) distance from the second of the four, 0..1.
        out: (4, points) output.
    """
    a, one, two, three = np.float32(CUBIC_SLOPE), np.float32(1), np.float32(2), np.float32(3)
    for i in range(len(part)):
        f = part[i]
        far, rest = one + f, one - f
        first = ((a * far - np.float32(5) * a) * far + np.float32(8) * a) * far
        out[0, i] = first - np.float32(4) * a
        out[1, i] = ((a + two) * f - (a + three)) * f * f + one
        out[2, i] = ((a + two) * rest - (a + three)) * rest * rest + one
        out[3, i] = one - out[0, i] - out[1, i] - out[2, i]


@njit_noalloc_inlined
def _read_bilinear(image, pixel, part, out):
    """Sample an image at points by bilinear interpolation.

    Args:
        image: (h, w).
        pixel: (2, points) x and y of the pixel before each point.
        part: (2, points) distance from that pixel, px.
        out: (points,) output.
    """
    h, w = image.shape
    for i in range(len(out)):
        x0, y0 = pixel[0, i], pixel[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b, c, d = bilinear_weights(part[0, i], part[1, i])
        out[i] = a * upper[x0] + b * upper[x1] + c * lower[x0] + d * lower[x1]


@njit_noalloc_inlined
def _read_bicubic(image, pixel, weights, out):
    """Sample an image at points by bicubic interpolation, with its border replicated.

    Args:
        image: (h, w).
        pixel: (2, points) x and y of the pixel before each point.
        weights: (8, points) of four pixels along x, then along y, by `_cubic_weights`.
        out: (points,) output.
    """
    h, w = image.shape
    for i in range(len(out)):
        x, y, total = int(pixel[0, i]) - 1, int(pixel[1, i]) - 1, np.float32(0)
        if 0 <= x < w - 3 and 0 <= y < h - 3:
            for n in range(4):
                row = image[y + n]
                part = weights[0, i] * row[x] + weights[1, i] * row[x + 1]
                part = part + weights[2, i] * row[x + 2] + weights[3, i] * row[x + 3]
                total += weights[4 + n, i] * part
        else:  # the border is replicated
            for n in range(4):
                row, part = image[min(max(y + n, 0), h - 1)], np.float32(0)
                for m in range(4):
                    part += weights[m, i] * row[min(max(x + m, 0), w - 1)]
                total += weights[4 + n, i] * part
        out[i] = total


@njit_noalloc
def _warp_rows(begin, end, inputs, scratch, cubic, out):
    """Sample images along the paths of some rows of pixels.

    Args:
        begin: First row.
        end: Row after the last one.
        inputs: L, V and clear (K, h, w), (K,) whether clear is above 0 anywhere, `PathTimes`, and
            paths (h, w, 4), px.
        scratch: `RowScratch`.
        cubic: (rows, 8, w) scratch for weights.
        out: `WarpedImages`, output.
    """
    L, V, clear, shown, times, paths = inputs
    count, h, w = L.shape
    path, pixel, part = scratch.path[begin], scratch.pixel[begin], scratch.part[begin]
    at, weights = scratch.x[begin], cubic[begin]
    for x in range(w):
        at[x] = np.float32(x)
    for y in range(begin, end):
        for x in range(w):
            for c in range(4):
                path[c, x] = paths[y, x, c]
        for k in range(count):
            row = (path, at, pixel, part, out.inside[k, y])
            locate_points(np.float32(y), times, k, (h, w), w, row)
            _cubic_weights(part[0], weights[:4])
            _cubic_weights(part[1], weights[4:])
            _read_bicubic(L[k], pixel, weights, out.L[k, y])
            _read_bilinear(V[k], pixel, part, out.V[k, y])
            if shown[k]:
                _read_bilinear(clear[k], pixel, part, out.clear[k, y])
            else:
                out.clear[k, y] = np.float32(0)


def warp_images(
    L: NDArray, V: NDArray, clear: NDArray, times: PathTimes, paths: NDArray
) -> WarpedImages:
    """Sample images along the paths of pixels, by a compiled loop.

    Args:
        L: (K, h, w) float32, log intensity.
        V: (K, h, w) float32, its variance, (ln I)^2.
        clear: (K, h, w) float32, 1 where a frame shows the pixel unclipped.
        times: K times of the images, float32.
        paths: (h, w, 4) float32, px.

    Returns:
        The images at the target's points.
    """
    _, h, w = L.shape
    out = WarpedImages(*(np.empty(L.shape, np.float32) for _ in range(4)))
    inputs = (read_only(L), read_only(V), clear, clear.any((1, 2)), times, paths)
    run_over_rows(_warp_rows, h, inputs, RowScratch.allocate(h, w), empty_row_scratch(h, 8, w), out)
    return out


def path_displacements(paths: Array, times: PathTimes) -> Array:
    """Return the displacements along paths.

    Args:
        paths: (h, w, 4) paths, px: along x and y the coefficients of s, then those of s^2.
        times: K times.

    Returns:
        (K, h, w, 2) along x and y, px.
    """
    s, common = (jnp.asarray(part) for part in times)
    s = s[:, None, None, None]
    return (paths[..., :2] + paths[..., 2:] * s) * s + common[:, None, None]


def squared_reach(paths: Numeric, common: Numeric) -> Numeric:
    """Return an upper bound of the squared displacement of points from the target's image.

    Args:
        paths: (h, w, 4) paths, px.
        common: (K, 2) displacements that all points share, px.

    Returns:
        (h, w), px^2.
    """
    farthest = abs(common).max(0)
    return ((abs(paths[..., :2]) + abs(paths[..., 2:]) + farthest) ** 2).sum(-1)


def path_positions(paths: Array, times: PathTimes) -> tuple[Array, Array]:
    """Return the positions of scene points at the times of images.

    Args:
        paths: (h, w, 4) paths, px.
        times: K times.

    Returns:
        y and x, (K, h, w) each, px.
    """
    height, width, _ = paths.shape
    moved = path_displacements(paths, times)
    return jnp.arange(height)[:, None] + moved[..., 1], jnp.arange(width) + moved[..., 0]


def sample_bilinear(images: Array, Y: Array, X: Array) -> Array:
    """Sample each image at its own points by bilinear interpolation; differentiable.

    Args:
        images: (K, h, w).
        Y: (K, h', w') rows of the points, px.
        X: (K, h', w') columns of the points, px.

    Returns:
        (K, h', w').
    """
    _, h, w = images.shape
    cells = _locate_cells(h, w, Y, X)
    return _interpolate(images, cells, lambda f, i: i * f + (1 - i) * (1 - f), (0, 1))


def _interpolate(
    images: Array,
    cells: tuple[Array, Array, Array, Array],
    weight: Callable[[Array, Array], Array],
    offsets: tuple[int, ...],
) -> Array:
    """Interpolate each image at its own points; differentiable.

    Pixels around the points are added one after another. All at once, as sums over an axis, they
    take ten times as long, and their derivatives three times.

    Args:
        images: (K, h, w).
        cells: Cells of the points, by `_locate_cells`, (K, h', w') each.
        weight: Weight of a pixel, of the position f within the cell and the pixel's offset.
        offsets: Offsets of rows, and of columns, from the cell's first pixel, px.

    Returns:
        (K, h', w').
    """
    _, h, w = images.shape
    y0, x0, fy, fx = cells

    @jax.checkpoint
    def add_pixel(total: Array, offset: Array) -> tuple[Array, None]:
        i, j = offset
        y, x = jnp.clip(y0 + i, 0, h - 1), jnp.clip(x0 + j, 0, w - 1)
        return total + weight(fy, i) * weight(fx, j) * _take(images, y, x), None

    pairs = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    start = jnp.zeros(fy.shape, jnp.result_type(images, fy))
    return jax.lax.scan(add_pixel, start, pairs.astype(np.int32))[0]


def _locate_cells(h: int, w: int, Y: Array, X: Array) -> tuple[Array, Array, Array, Array]:
    """Find the cell of four pixels around each point.

    Args:
        h: Height of the images, px.
        w: Width of the images, px.
        Y: Positions along y, px, of any shape; those beyond the border are moved to it.
        X: Positions along x, likewise.

    Returns:
        y and x of the cell's first pixel, and y and x within the cell, 0..1; of the shape of `Y`.
    """
    Y, X = jnp.clip(Y, 0, h - 1), jnp.clip(X, 0, w - 1)
    y0 = jnp.minimum(Y.astype(int), max(h - 2, 0))
    x0 = jnp.minimum(X.astype(int), max(w - 2, 0))
    return y0, x0, Y - y0, X - x0


def _take(images: Array, y: Array, x: Array) -> Array:
    """Read images at pixels that lie inside.

    Bounds checks would be three of four operations, in derivatives, too.

    Args:
        images: (K, h, w).
        y: (..., K, h, w) rows.
        x: (..., K, h, w) columns.

    Returns:
        (..., K, h, w).
    """
    count, h, w = images.shape
    pixel = (jnp.arange(count)[:, None, None] * h + y) * w + x
    return jnp.ravel(images).at[pixel].get(mode="promise_in_bounds", wrap_negative_indices=False)


def is_in_image(Y: Array, X: Array, height: int, width: int) -> Array:
    """Return whether points lie in an image.

    Args:
        Y: Rows of the points, px.
        X: Columns of the points, px.
        height: Height of the image, px.
        width: Width of the image, px.
    """
    return (X >= -0.5) & (X <= width - 0.5) & (Y >= -0.5) & (Y <= height - 0.5)


def warp_images_jax(
    L: Array, V: Array, clear: Array, times: PathTimes, paths: Array
) -> WarpedImages:
    """Sample images along the paths of pixels; differentiable, otherwise like `warp_images`.

    Args:
        L: (K, h, w) log intensity.
        V: (K, h, w) its variance, (ln I)^2.
        clear: (K, h, w) 1 where a frame shows the pixel unclipped.
        times: K times of the images.
        paths: (h, w, 4), px.

    Returns:
        The images at the target's points.
    """
    _, h, w = L.shape
    Y, X = path_positions(paths, times)
    inside = is_in_image(Y, X, h, w)
    V, clear = sample_bilinear(V, Y, X), sample_bilinear(clear, Y, X)

    def cubic(f: Array, i: Array) -> Array:
        a, d = CUBIC_SLOPE, jnp.abs(f - i)
        near, far = ((a + 2) * d - (a + 3)) * d * d + 1, ((a * d - 5 * a) * d + 8 * a) * d - 4 * a
        return jnp.where(d <= 1, near, far)

    bicubic = _interpolate(L, _locate_cells(h, w, Y, X), cubic, (-1, 0, 1, 2))
    return WarpedImages(bicubic, V, clear, inside.astype(L.dtype))
