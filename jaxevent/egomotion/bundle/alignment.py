"""Alignment of a window's segments with each other: a motion from distant starts.

I_s is the signed image of the warped events of one segment,

    min sum_s |I_s - k_s T_s|^2,  T_s = sum of the other segments' images,

by Gauss-Newton on displacements of every cell in every segment with their information (Lucas &
Kanade's equations, k_s per cell and segment), the assignment of events to cells held fixed. It
comes within some ten degrees from most starts; its own optimum is some degrees off.

The pixel [j, i] of an image lies at (i, j) + corner, px. An event is shared among four pixels.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle import warp
from jaxevent.egomotion.bundle.cg import cholesky, cholesky_solve

UNCOMPARED_BORDER_PX = 3  # at the sensor's border, that is not compared
SCORE_BLOCK_PX = 12  # of the image, whose contrast is scored
N_ALIGNED_COEFFICIENT_ROWS = 3  # of O and of D that are fitted
N_ALIGNED_UNKNOWNS = 6 * N_ALIGNED_COEFFICIENT_ROWS  # their numbers
CELL_EDGE_LOG_DEPTH = 0.3  # a larger difference of log depth between cells is an edge


class WindowEvents(NamedTuple):
    """Events of a window, and the sensor and the cells in the reference view.

    Attributes:
        x: (n,) undistorted columns from the principal point, px.
        y: (n,) undistorted rows from the principal point, px.
        tau: (n,) times from the reference time, s.
        p: (n,) polarities, +1 or -1.
        f: Focal length, px.
        half: Half the length of the window, s.
        box: Extent of the sensor, x0, x1, y0, y1, px.
        shape: Height and width of the reference view, px.
        corner: Position of its pixel [0, 0], px.
        cell: Side of a cell, px.
    """

    x: NDArray
    y: NDArray
    tau: NDArray
    p: NDArray
    f: float
    half: float
    box: tuple[float, float, float, float]
    shape: tuple[int, int]
    corner: tuple[float, float]
    cell: int

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.shape[0] // self.cell, self.shape[1] // self.cell

    @property
    def cell_positions(self) -> tuple[NDArray, NDArray]:
        """Positions x and y (cells,) of the cells' centres, px, row by row."""
        rows, columns = self.cells
        j, i = np.divmod(np.arange(rows * columns), columns)
        middle = (self.cell - 1) / 2
        return self.corner[0] + i * self.cell + middle, self.corner[1] + j * self.cell + middle


class ImageScratch(NamedTuple):
    """Scratch for images of events.

    Attributes:
        images: (2, height, width) sums of polarities, and numbers of events.
        work: (height, width) scratch of filters.
        sums: Sums by part of the image.
    """

    images: NDArray
    work: NDArray
    sums: NDArray

    @classmethod
    def of(cls, shape: tuple[int, int], real: np.dtype, sums: NDArray) -> "ImageScratch":
        """Allocate the scratch memory for images.

        Args:
            shape: (height, width), px.
            real: Type of the numbers.
            sums: Sums over parts of the image, which are kept with the images.

        Returns:
            The memory, not initialised.
        """
        return cls(np.empty((2, *shape), real), np.empty(shape, real), sums)


class ContrastMaps(NamedTuple):
    """Contrast and number of events, by part of the image.

    Attributes:
        contrast: Sums of squares of the signed image.
        number: Numbers of events.
    """

    contrast: NDArray[np.float64]
    number: NDArray[np.float64]


class Displacements(NamedTuple):
    """Displacements of cells in segments."""

    information: NDArray[np.float64]  # (S * cells, 2, 2) 1/px^2
    product: NDArray[np.float64]  # (S * cells, 2) information times displacement


class VisibleRegion(NamedTuple):
    """Region of the sensor in the image, and displacements of cells to the times of segments.

    Attributes:
        low: (2,) least x and y, px of the image.
        high: (2,) largest x and y, px of the image.
        left: (S, cells) displacements along x, px.
        top: (S, cells) displacements along y, px.
    """

    low: NDArray
    high: NDArray
    left: NDArray
    top: NDArray


@njit_fastmath_inlined
def splat(image, x, y, weight):
    """Add an event to the four pixels about it, bilinearly; the part outside the image is lost.

    Args:
        image: (height, width), changed in place.
        x: Column, px from the first pixel.
        y: Row, px from the first pixel.
        weight: Amount to add, such as the polarity.
    """
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
    """Blur an image by [1 2 1] / 4 in x and in y, in place; it is black beyond its border.

    Args:
        image: (height, width).
        work: (height, width) scratch.
        times: Number of blurs.
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
def _accumulate_segments(window, images):
    """Add the warped events to a signed image for each segment of the window.

    Args:
        window: `WindowEvents`, with positions in the reference view.
        images: (S, height, width), changed in place.
    """
    segments, height, width = images.shape
    half = window.half
    for e in range(len(window.x)):
        x, y = window.x[e] - window.corner[0], window.y[e] - window.corner[1]
        if x >= 0 and y >= 0 and x <= width - 1 and y <= height - 1:
            s = min(max(int((window.tau[e] + half) / (2 * half) * segments), 0), segments - 1)
            splat(images[s], x, y, window.p[e])


@njit_fastmath
def _compare_segments(images, cell, region, others, share, sums):
    """Compare each segment's image of a cell with that of all other segments.

    Args:
        images: (S, height, width) of segments; pixels that are not visible are set to 0.
        cell: Size of a cell, px.
        region: `VisibleRegion`.
        others: (S, height, width) output, images of the other segments.
        share: (S, cells) output, visible pixels.
        sums: (S, cells, 3) output, sums of I T, T^2 and I^2, T the others' image.
    """
    segments, height, width = images.shape
    columns, real = width // cell, images.dtype.type
    low, high, left, top = region
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
def _accumulate_gradients(images, others, gain, cell, sums):
    """Add up over cells the products of the difference d = gain T - I and the gradient g of T.

    Args:
        images: (S, height, width) images I of the segments.
        others: (S, height, width) images T of all other segments.
        gain: (S, cells) factors.
        cell: Size of a cell, px.
        sums: (S, cells, 6), changed in place: d^2, gx^2, gx gy, gy^2, gx d and gy d.
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
def _accumulate_events(window, images):
    """Add the warped events to a signed image and to an image of their number.

    Args:
        window: `WindowEvents`, with positions in the reference view.
        images: (2, height, width), changed in place.
    """
    for e in range(len(window.x)):
        x, y = window.x[e] - window.corner[0], window.y[e] - window.corner[1]
        splat(images[0], x, y, window.p[e])
        splat(images[1], x, y, images.dtype.type(1))


def _warp_by_cells(path: warp.Path, window: WindowEvents) -> WindowEvents:
    """Warp events to the reference view, with the depths of their cells."""
    index = np.empty(len(window.x), np.int32)
    out = warp.Positions(np.empty_like(window.x), np.empty_like(window.x))
    rho = np.exp(path.log_rho.astype(np.float64))
    points = warp.Points(window.x, window.y, window.tau)
    cells = warp.CellGrid(window.corner, window.cell, *window.cells)
    warp.assign_cells(points, path.motion(window.f), rho, cells, index, out)
    return window._replace(x=out.X, y=out.Y)


def align_segments(
    window: WindowEvents, path: warp.Path, prior: warp.Prior, *, degree: int, blurs: int, steps: int
) -> warp.Path:
    """Refine a path by the alignment of segments.

    Args:
        window: Events.
        path: Path to begin with, with log depths of cells.
        prior: Priors on path and depths.
        degree: Highest row of O and D that is fitted, at most 2.
        blurs: Number of times that images are blurred by [1 2 1] / 4.
        steps: Number of Gauss-Newton steps.

    Returns:
        The refined path.
    """
    times = warp.segment_times(window.half)[:, None]
    parts = np.broadcast_arrays(*window.cell_positions, times)
    centres = warp.Points(*(np.array(part, np.float64) for part in parts))
    for _ in range(steps):
        tracks = _trace_cells(path, window, centres)
        shifts = warp.Positions(tracks.x - centres.x, tracks.y - centres.y)
        found = _measure_displacements(path, window, shifts, blurs)
        path = _take_step(path, window, tracks, found, prior, degree)
    return path


def _trace_cells(path: warp.Path, window: WindowEvents, centres: warp.Points) -> warp.Points:
    """Find where the centres of cells are at the segments' times.

    Args:
        path: Path, with log depths of cells.
        window: Events.
        centres: (S, cells) the centres in the reference view, px, and the segments' times, s.

    Returns:
        (S, cells) positions at these times.
    """
    rho, (x, y, tau) = np.exp(path.log_rho), centres
    for _ in range(4):
        X, Y = warp.warp(path, window.f, warp.Points(x, y, tau), rho)
        x, y = x - (X - centres.x), y - (Y - centres.y)
    return warp.Points(x, y, tau)


def _measure_displacements(
    path: warp.Path, window: WindowEvents, shifts: warp.Positions, blurs: int
) -> Displacements:
    """Measure the displacements of cells by Lucas and Kanade's equations.

    Args:
        path: Path that warps the events.
        window: Events.
        shifts: (S, cells) px, shifts of cells' centres from the reference to the segments' times.
        blurs: Number of times that images are blurred.

    Returns:
        The displacements with their information.
    """
    real, cells = window.x.dtype, shifts.X.shape[1]
    own = np.zeros((warp.N_WINDOW_SEGMENTS, *window.shape), real)
    _accumulate_segments(_warp_by_cells(path, window), own)
    work = np.empty(window.shape, real)
    for image in own:
        blur(image, work, blurs)
    low, high = (
        np.array([window.box[k], window.box[2 + k]]) - np.array(window.corner) for k in (0, 1)
    )
    others, share = np.empty_like(own), np.zeros((warp.N_WINDOW_SEGMENTS, cells))
    both = np.zeros((warp.N_WINDOW_SEGMENTS, cells, 3))
    region = VisibleRegion(low + UNCOMPARED_BORDER_PX, high - UNCOMPARED_BORDER_PX, *shifts)
    _compare_segments(own, window.cell, region, others, share, both)
    share /= window.cell**2
    gain = both[..., 0] / np.maximum(both[..., 1], 1e-6)
    sums = np.zeros((warp.N_WINDOW_SEGMENTS, cells, 6))
    _accumulate_gradients(own, others, gain, window.cell, sums)
    # Noise (per px) of a cell; blurring correlates it.
    noise = sums[..., 0].sum(0) / np.maximum(share.sum(0), 1) / window.cell**2
    weight = np.where((gain > 0) & (share > 0), 1 / (noise + 1e-3), 0) / (1 + 1.5 * blurs)
    xx, xy, yy = (weight * gain**2 * sums[..., k] for k in (1, 2, 3))
    vx, vy = (weight * gain * sums[..., k] for k in (4, 5))
    # A displacement by more than about a pixel is an outlier.
    small = 1e-2
    det = (xx + small) * (yy + small) - xy**2
    dx, dy = ((yy + small) * vx - xy * vy) / det, ((xx + small) * vy - xy * vx) / det
    robust = 1 / (1 + (dx**2 + dy**2) / (1 + 0.5 * blurs) ** 2) ** 2
    xx, xy, yy, vx, vy = (robust * part for part in (xx, xy, yy, vx, vy))
    information, product = np.stack([xx, xy, xy, yy], -1), np.stack([vx, vy], -1)
    return Displacements(information.reshape(-1, 2, 2), product.reshape(-1, 2))


def _take_step(
    path: warp.Path,
    window: WindowEvents,
    tracks: warp.Points,
    found: Displacements,
    prior: warp.Prior,
    degree: int,
) -> warp.Path:
    """Take a Gauss-Newton step of the path's first rows and of the depths of cells.

    Unknowns are the path's first rows, in px at the window's end, and the cells' log depths.

    Args:
        path: Path at which the step begins.
        window: Events.
        tracks: (S, cells) positions of cells at the segments' times.
        found: Displacements of cells in segments.
        prior: Priors on path and depths.
        degree: Highest row of O and D that is fitted.

    Returns:
        The path after the step; `path` itself if the step is not finite.
    """
    f, half, (_, cells), n = window.f, window.half, tracks.x.shape, tracks.x.size
    rho = np.broadcast_to(np.exp(path.log_rho), tracks.x.shape)
    unit = warp.row_units(path, f, half, N_ALIGNED_COEFFICIENT_ROWS)
    by, r = np.empty((n, 6, 2)), np.empty((n, 2))
    parts = [np.ascontiguousarray(part, np.float64).ravel() for part in (*tracks, rho)]
    warp.point_derivatives(warp.Points(*parts[:3]), parts[3], path.motion(f), by, r)
    powers = (parts[2] / half)[:, None] ** np.arange(1, warp.N_COEFFICIENT_ROWS + 1)
    J = (by[:, :, None] * powers[:, None, :, None]).reshape(n, 6 * warp.N_COEFFICIENT_ROWS, 2)
    J = J.transpose(0, 2, 1) @ warp.coefficient_jacobian(
        path, unit, half, N_ALIGNED_COEFFICIENT_ROWS
    )
    now = warp.pack_rows(path, N_ALIGNED_COEFFICIENT_ROWS) / unit
    W, v = found
    MJ = W @ J
    # By einsum: larger products wake BLAS's threads, which spin then, beside other starts' steps.
    upper = np.einsum(
        "ep,eq->pq", J.reshape(-1, N_ALIGNED_UNKNOWNS), MJ.reshape(-1, N_ALIGNED_UNKNOWNS)
    )
    mixed = (
        np.einsum("ekp,ek->ep", MJ, r)
        .reshape(warp.N_WINDOW_SEGMENTS, cells, N_ALIGNED_UNKNOWNS)
        .sum(0)
        .T
    )
    lower = np.einsum("ek,ekl,el->e", r, W, r).reshape(warp.N_WINDOW_SEGMENTS, cells).sum(0)
    H = np.block([[upper, mixed], [mixed.T, np.diag(lower)]])
    g = np.concatenate(
        [np.einsum("ekp,ek->p", J, v), (r * v).sum(1).reshape(warp.N_WINDOW_SEGMENTS, cells).sum(0)]
    )
    depth = path.log_rho.reshape(window.cells)
    bound = _smoothness_matrix(
        *warp.smoothness_weights(depth, prior.smooth, CELL_EDGE_LOG_DEPTH)[:2]
    )
    H[N_ALIGNED_UNKNOWNS:, N_ALIGNED_UNKNOWNS:] += bound
    g[N_ALIGNED_UNKNOWNS:] += np.einsum("ij,j->i", bound, path.log_rho)
    H[N_ALIGNED_UNKNOWNS:, N_ALIGNED_UNKNOWNS:] += prior.relief * np.eye(cells)
    g[N_ALIGNED_UNKNOWNS:] += prior.relief * (path.log_rho - path.log_rho.mean())
    known, side, _ = warp.row_priors(prior, unit, half)
    H[:N_ALIGNED_UNKNOWNS, :N_ALIGNED_UNKNOWNS] += known
    g[:N_ALIGNED_UNKNOWNS] += known @ now - side
    gauge = warp.gauge_direction(path, unit, len(g))
    H = H + 100 * np.trace(upper) / N_ALIGNED_UNKNOWNS * gauge[:, None] * gauge
    H = H + np.diag(1e-3 * np.diag(H) + 1e-6)

    moves = np.ones(len(g), bool)
    moves[:N_ALIGNED_UNKNOWNS] = np.repeat(
        np.tile(np.arange(N_ALIGNED_COEFFICIENT_ROWS) <= degree, 2), 3
    )
    change = np.zeros(len(g))
    # LAPACK would wake BLAS's threads, which spin then: half of the CPU seconds of all starts.
    free, down = H[np.ix_(moves, moves)], -g[moves]
    cholesky(free)
    cholesky_solve(free, down)
    change[moves] = down
    if not np.isfinite(change).all():
        return path
    change *= warp.step_fraction(change[:N_ALIGNED_UNKNOWNS])
    path = warp.replace_rows(path, (now + change[:N_ALIGNED_UNKNOWNS]) * unit)
    deeper = np.clip(change[N_ALIGNED_UNKNOWNS:], -warp.MAX_LOG_DEPTH_STEP, warp.MAX_LOG_DEPTH_STEP)
    return warp.normalise(
        warp.Path(path.O, path.D, path.log_rho + deeper.astype(path.log_rho.dtype))
    )


def _smoothness_matrix(across: NDArray, down: NDArray) -> NDArray[np.float64]:
    """Return the matrix of a weighted sum of squared differences between neighbouring cells.

    Args:
        across: (rows, columns) weights of differences to the column before.
        down: (rows, columns) weights of differences to the row before.

    Returns:
        (cells, cells) matrix K: the sum is v' K v.
    """
    number = np.arange(across.size).reshape(across.shape)
    found = np.zeros((across.size, across.size))
    for a, b, weight in (
        (number[:, 1:], number[:, :-1], across[:, 1:]), (number[1:], number[:-1], down[1:]),
    ):  # fmt: skip
        a, b, weight = a.ravel(), b.ravel(), weight.ravel()
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            np.add.at(found, (i, j), sign * weight)
    return found


def contrast_score(window: WindowEvents, path: warp.Path) -> float:
    """Score a path by the contrast of the image of warped events.

    Args:
        window: Events.
        path: Path, with log depths of cells.

    Returns:
        The mean over blocks of n (log S - 1.5 log n) / N: S is the sum of squares of the signed
            image
        in a block, n its number of events and N that of all events. More is better.
    """
    images = np.zeros((2, *window.shape), window.x.dtype)
    work = np.empty_like(images[0])
    _accumulate_events(_warp_by_cells(path, window), images)
    for image in images:
        blur(image, work, 1)
    rows, columns = (size // SCORE_BLOCK_PX for size in window.shape)
    images[0] *= images[0]
    images = images[:, : rows * SCORE_BLOCK_PX, : columns * SCORE_BLOCK_PX].astype(np.float64)
    blocks = images.reshape(2, rows, SCORE_BLOCK_PX, columns, SCORE_BLOCK_PX).sum((2, 4))
    S, n = blocks[:, blocks[1] > 5]
    return float((n * (np.log(S + 1e-6) - 1.5 * np.log(n))).sum()) / max(len(window.x), 1)
