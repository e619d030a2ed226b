"""Trajectories of the scene points that are visible at a target time.

Point x of the target's image lies at x + u(x, s) at the instant s, u = v(x) s + a(x) s^2 + c(s),
s = -1..1 over the instants. c is common to all points (`common_motion`). v and a are bilinear
between nodes, one for every 2 x 2 pixels. They minimise, with the unknown image M of the target,

    sum_k sum_x rho((L_k(x + u(x, s_k)) - M(x))^2 W_k(x + u)) + smoothness,
    rho(q) = nu log(1 + q / nu),   W_k = 1 / (V_k + floor)

by Gauss-Newton steps in which M is eliminated. Large motion is found from nothing by growing the
horizon: first only the instants next to the target take part, then those twice as far.

Trajectories of nodes are smooth. Where surfaces meet that move in different ways, that leaves
pixels on paths that no point follows. So each pixel takes the path of a pixel x' nearby if images
agree clearly better along it, by the same robust squares, gathered over a Gaussian:

    sum_k rho((L_k(x + u(x', s_k)) - M(x))^2 W_k(x + u))

Steps go on from such paths: near borders more of them are right then, so more pixels have a right
one to take.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import (
    empty_row_scratch,
    njit_noalloc,
    njit_noalloc_inlined,
    read_only,
    run_over_rows,
)
from jaxevent.reconstruction.compensated.normal_equations import (
    CostParams,
    PackedImages,
    fill_information,
    linearise,
    max_instant_distance,
    robust_means,
    sample_trajectories,
    solve_normal_equations,
)
from jaxevent.reconstruction.compensated.robust_mean import (
    blur_along_x,
    blur_along_y,
    blur_image,
    gaussian_taps,
)
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    RowScratch,
    bilinear_cell,
    bilinear_weights,
    blend_nodes,
    gradient_at_pixel,
    interpolate_paths,
    locate_points,
    resize_nodes,
)

MAX_STEP_PX = np.float32(1.5)  # at the horizon
HALVING_TAPS = np.array([1, 4, 6, 4, 1], np.float32) / np.float32(16)
# A pixel's own path, and those around it.
NEIGHBOUR_OFFSETS = np.array(
    [(0, 0), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]
)
# Least gain in cost per instant for which a pixel takes another path. With less, pixels of one
# surface take what noise prefers. Set on pans of HDR scenes for fitting, on objects of seeds that
# are not scored, and on the first half of slider_depth.
MIN_COST_GAIN = np.float32(0.1)
MIN_PATH_DIFFERENCE_PX = np.float32(0.5)  # at the farthest instant, between paths to compare


class PathSearch(NamedTuple):
    """One pass over an image in which pixels compare their paths with those nearby."""

    spacing: int  # px, between the pixels that are compared
    distance: int  # to the paths that are tried, in units of the spacing
    sigma: float  # of the Gaussian over which costs are gathered, in units of the spacing


CHOICE_SIGMA = 2.0  # of the Gaussian over which costs of trajectories are compared, in nodes
FINE_SHARE = 2.0  # by which the cost of a search without coarse levels is divided
# Set on objects of seeds that are not scored, and on the first half of slider_depth.
PATH_SEARCHES = (PathSearch(2, 4, 1.0), PathSearch(1, 3, 1.0))


def pack_images(L: NDArray, V: NDArray) -> NDArray[np.float32]:
    """Pack images with their gradients.

    Args:
        L: (K, h, w) log intensity.
        V: (K, h, w) its variance, (ln I)^2.

    Returns:
        (K, h, w, 4) L, V, and the gradient of L along x and y, 1/px.
    """
    out = np.empty((*L.shape, 4), np.float32)
    given = (read_only(np.asarray(values, np.float32)) for values in (L, V))
    run_over_rows(_pack_rows, L.shape[1], *given, out)
    return out


@njit_noalloc
def _pack_rows(begin, end, L, V, out):
    """Pack some rows of images with their gradients.

    Args:
        begin: First row.
        end: Row after the last one.
        L: (K, h, w) log intensity.
        V: (K, h, w) its variance, (ln I)^2.
        out: (K, h, w, 4) output, as of `pack_images`.
    """
    count, h, w = L.shape
    for k in range(count):
        for y in range(begin, end):
            for x in range(w):
                out[k, y, x, 0] = L[k, y, x]
                out[k, y, x, 1] = V[k, y, x]
                out[k, y, x, 2], out[k, y, x, 3] = gradient_at_pixel(L[k], y, x)


@njit_noalloc
def _halve(begin, end, images, scratch, out):
    """Write rows of images of half the resolution.

    Args:
        begin: First row of the output.
        end: Row after the last one.
        images: (K, h, w).
        scratch: (rows, w).
        out: (K, rows, columns) output, half of h and w, rounded up.
    """
    count, h, w = images.shape
    column = scratch[begin]
    for k in range(count):
        for y in range(begin, end):
            for x in range(w):
                total = np.float32(0)
                for i in range(5):
                    total += HALVING_TAPS[i] * images[k, min(max(2 * y + i - 2, 0), h - 1), x]
                column[x] = total
            for x in range(out.shape[2]):
                total = np.float32(0)
                for j in range(5):
                    total += HALVING_TAPS[j] * column[min(max(2 * x + j - 2, 0), w - 1)]
                out[k, y, x] = total


def halve_resolution(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Blur images (K, h, w) and keep every second pixel: half the resolution, rounded up."""
    count, h, w = images.shape
    out = np.empty((count, (h + 1) // 2, (w + 1) // 2), np.float32)
    run_over_rows(_halve, out.shape[1], images, empty_row_scratch(out.shape[1], w), out)
    return out


class ImagePyramid:
    """Packed images at full, half, quarter ... resolution, made when first needed.

    Args:
        L: (K, h, w) log intensity.
        V: (K, h, w) its variance, (ln I)^2.
        variance_factor: Factor on the blurred variance from one resolution to half of it.
    """

    def __init__(self, L: NDArray, V: NDArray, variance_factor: float):
        self._levels = [(np.asarray(L, np.float32), np.asarray(V, np.float32))]
        self._packed: dict[int, NDArray[np.float32]] = {}
        self._factor = np.float32(variance_factor)
        self.image_shape: tuple[int, int] = self._levels[0][0].shape[1:]

    def __getitem__(self, level: int) -> NDArray[np.float32]:
        """Return the packed images of a level; 0 is full resolution."""
        while len(self._levels) <= level:
            L, V = self._levels[-1]
            self._levels.append((halve_resolution(L), halve_resolution(V) * self._factor))
        if level not in self._packed:
            self._packed[level] = pack_images(*self._levels[level])
        return self._packed[level]


@njit_noalloc_inlined
def _median(a, b, c):
    """Return the median of three numbers.

    Args:
        a: The first.
        b: The second.
        c: The third.

    Returns:
        The median.
    """
    return max(min(a, b), min(max(a, b), c))


@njit_noalloc
def _move(p, d, longest, scratch, out):
    """Write p + d, each channel of d cut to `longest`, then the median of 3 x 3 nodes.

    Args:
        p: (rows, columns * channels) trajectories of nodes, px.
        d: (rows, columns * channels) step, px.
        longest: (channels,) px.
        scratch: (rows, columns * channels), and three rows that are longer by a node at both ends.
        out: (rows, columns * channels) output, px.
    """
    moved, sorted_rows = scratch
    rows, width = p.shape
    channels = len(longest)
    for i in range(rows):
        for c in range(channels):
            for j in range(c, width, channels):
                moved[i, j] = p[i, j] + min(max(d[i, j], -longest[c]), longest[c])
    low, middle, high = sorted_rows[0], sorted_rows[1], sorted_rows[2]
    for i in range(rows):
        up, here, down = moved[max(i - 1, 0)], moved[i], moved[min(i + 1, rows - 1)]
        for j in range(width):
            low[channels + j] = min(min(up[j], here[j]), down[j])
            middle[channels + j] = _median(up[j], here[j], down[j])
            high[channels + j] = max(max(up[j], here[j]), down[j])
        for line in (low, middle, high):
            for c in range(channels):
                line[c], line[channels + width + c] = line[channels + c], line[width + c]
        # The median of nine lies between the largest of the smallest and the smallest of the
        # largest of three columns.
        for j in range(width):
            k, m = j + channels, j + 2 * channels
            least = max(max(low[j], low[k]), low[m])
            most = min(min(high[j], high[k]), high[m])
            out[i, j] = _median(least, _median(middle[j], middle[k], middle[m]), most)


def gauss_newton_step(
    images: PackedImages, p: NDArray[np.float32], cost: CostParams
) -> NDArray[np.float32]:
    """Improve trajectories by one Gauss-Newton step, followed by a median over 3 x 3 nodes.

    Args:
        images: Packed images.
        p: (rows, columns, 4) trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        (rows, columns, 4) the new trajectories, px.
    """
    d = solve_normal_equations(linearise(images, p, cost), p)
    rows, columns, channels = p.shape
    out, flat, horizon = (
        np.empty_like(p),
        (rows, columns * channels),
        max_instant_distance(images.times.s),
    )
    longest = MAX_STEP_PX / np.repeat([horizon, horizon * horizon / 4], 2).astype(np.float32)
    scratch = np.empty(flat, np.float32), np.empty((3, flat[1] + 2 * channels), np.float32)
    _move(p.reshape(flat), d.reshape(flat), longest, scratch, out.reshape(flat))
    return out


def robust_cost(images: PackedImages, p: NDArray[np.float32], cost: CostParams) -> float:
    """Return the mean weighted squared difference of images along trajectories.

    Args:
        images: Packed images.
        p: (rows, columns, 4) trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        The mean over pixels and instants.
    """
    points, M = sample_trajectories(images, p, cost)
    return float(((points[:, 0] - M[:, None]) ** 2 * points[:, 1]).mean())


def choose_trajectories(
    images: PackedImages,
    several: Sequence[NDArray[np.float32]],
    cost: CostParams,
    shares: Sequence[float],
) -> NDArray[np.float32]:
    """Choose for every node the trajectories along which images agree best around it.

    Args:
        images: Packed images.
        several: Trajectories of nodes, each (rows, columns, 4), px.
        cost: Parameters of the cost, float32.
        shares: By which the cost of each is divided, above 0.

    Returns:
        (rows, columns, 4) the trajectories chosen, px.
    """
    costs = []
    for p, share in zip(several, shares, strict=True):
        points, M = sample_trajectories(images, p, cost)
        squares = ((points[:, 0] - M[:, None]) ** 2 * points[:, 1]).sum(1)
        rows, columns = p.shape[:2]
        unpaired = [(0, 2 * rows - len(squares)), (0, 2 * columns - squares.shape[1])]
        padded = np.pad(squares, unpaired, mode="edge")
        nodes = padded.reshape(rows, 2, columns, 2).mean((1, 3))
        costs.append(blur_image(nodes, CHOICE_SIGMA) / np.float32(share))
    best = np.argmin(costs, 0)
    return np.take_along_axis(np.stack(several), best[None, ..., None], 0)[0]


def change_clock(
    p: NDArray[np.float32], s: NDArray[np.float32], new_s: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Convert trajectories to another clock.

    v and a are fitted to the places at the instants by least squares, most of all near the target.

    Args:
        p: (rows, columns, 4) trajectories of nodes, px.
        s: (K,) the instants on the present clock, -1..1.
        new_s: (K,) the same instants on the new clock, -1..1.

    Returns:
        (rows, columns, 4) trajectories on the new clock, px.
    """
    weight = np.exp(-(s**2) - new_s**2)[:, None]
    old, new = (np.stack([one, one**2], 1).astype(float) for one in (s, new_s))
    change = np.linalg.lstsq(weight * new, weight * old, rcond=None)[0]
    paths = p.reshape(*p.shape[:2], 2, 2)
    return np.einsum("ab,ijbc->ijac", change, paths).reshape(p.shape).astype(np.float32)


def fit_path(s: NDArray[np.float32], displacement: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fit a path to displacements, by least squares, most of all near the target.

    Args:
        s: (K,) times relative to the target, -1..1.
        displacement: (K, 2) along x and y, px.

    Returns:
        (4,) the path, px.
    """
    weight = np.exp(-2 * s**2)[:, None]
    powers = np.stack([s, s**2], 1).astype(float)
    path = np.linalg.lstsq(weight * powers, weight * displacement, rcond=None)[0]
    return path.ravel().astype(np.float32)


class RefinementStage(NamedTuple):
    """Steps at some resolutions, with the instants within a horizon."""

    horizon: float  # in units of `s`
    levels: tuple[int, ...]  # 0: full resolution
    steps: int  # at each level


def plan_stages(s: NDArray, first_horizon: float, coarsest: int = 4) -> list[RefinementStage]:
    """Plan a search from no motion, whose horizon doubles until it has all instants.

    Args:
        s: (K,) times of the instants relative to the target, -1..1.
        first_horizon: Horizon of the first stage, in units of `s`.
        coarsest: Level at which the search begins.

    Returns:
        The stages, in order.
    """
    whole = float(np.abs(s).max())
    horizon = min(first_horizon, whole)
    plan = [RefinementStage(horizon, tuple(range(coarsest, 1, -1)), 3)]
    while plan[-1].horizon < whole * 0.999:
        plan.append(RefinementStage(min(plan[-1].horizon * 2, whole), (2, 1), 2))
    return [*plan, RefinementStage(whole, (1,), 2)]


def node_shape(height: int, width: int, level: int) -> tuple[int, int]:
    """Return the number of nodes at a level of resolution.

    Args:
        height: Height of the full image, px.
        width: Width of the full image, px.
        level: 0 for full resolution, 1 for half of it, and so on.

    Returns:
        Rows and columns.
    """
    return -(-height // 2 ** (level + 1)), -(-width // 2 ** (level + 1))


class NodeTrajectories(NamedTuple):
    """Trajectories of nodes at one resolution."""

    p: NDArray[np.float32]  # (rows, columns, 4), in pixels of that resolution
    level: int  # 0: full resolution

    def at_level(self, level: int, image_shape: tuple[int, int]) -> "NodeTrajectories":
        """Convert to another resolution.

        Args:
            level: 0 for full resolution, 1 for half of it, and so on.
            image_shape: Height and width of the full image, px.

        Returns:
            The trajectories at that level.
        """
        p, now = self
        while now != level:
            finer = now > level
            now += -1 if finer else 1
            p = resize_nodes(p, node_shape(*image_shape, now), finer)
        return NodeTrajectories(p, level)


def estimate_trajectories(
    pyramid: ImagePyramid, times: PathTimes, plan: list[RefinementStage], cost: CostParams
) -> NodeTrajectories:
    """Estimate trajectories from no motion, by all stages of a plan.

    Args:
        pyramid: Images of the target's instants.
        times: Sorted times of the K instants.
        plan: The stages.
        cost: Parameters of the cost, float32.

    Returns:
        The trajectories at the level of the last stage.
    """
    h, w = pyramid.image_shape
    first = plan[0].levels[0]
    found = NodeTrajectories(np.zeros((*node_shape(h, w, first), 4), np.float32), first)
    for stage in plan:
        # Instants are sorted, so that these follow each other.
        chosen = slice(*np.searchsorted(times.s, stage.horizon * np.array([-1.001, 1.001])))
        for level in stage.levels:
            p = found.at_level(level, (h, w)).p
            at = times.take(chosen).at_level(level)
            images, starts = PackedImages.of(pyramid[level][chosen], at), [p]
            if stage is plan[0] and level == stage.levels[-1]:
                # A pattern finer than the pixels of the coarse levels has misled these.
                starts.append(np.zeros_like(p))
            for _ in range(stage.steps):
                starts = [gauss_newton_step(images, p, cost) for p in starts]
            if len(starts) > 1:
                starts = [choose_trajectories(images, starts, cost, (1.0, FINE_SHARE))]
            found = NodeTrajectories(starts[0], level)
    return found


@njit_noalloc
def _advect(begin, end, p, s, common, out):
    """Write the trajectories of the points that some rows of nodes see at another time.

    Args:
        begin: First row of nodes.
        end: Row after the last one.
        p: (rows, columns, 4) trajectories of the points visible at 0, px.
        s: The other time.
        common: (2,) displacement that all points share at s, px.
        out: (rows, columns, 4) output, on the same clock, px.
    """
    rows, columns, _ = p.shape
    half = np.float32(0.5)  # nodes per px
    for i in range(begin, end):
        for j in range(columns):
            X, Y = np.float32(j), np.float32(i)
            for _ in range(4):
                blend_nodes(p, bilinear_cell(X, Y, rows, columns), out[i, j])
                X = np.float32(j) - half * ((out[i, j, 0] + out[i, j, 2] * s) * s + common[0])
                Y = np.float32(i) - half * ((out[i, j, 1] + out[i, j, 3] * s) * s + common[1])
            for c in range(2):
                out[i, j, c] += np.float32(2) * out[i, j, c + 2] * s


def advect_nodes(
    p: NDArray[np.float32], s: float, unit: float, common: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Carry trajectories to another target: those of the points that are visible there.

    Args:
        p: (rows, columns, 4) trajectories of the points visible at 0, px.
        s: Time of the new target on the clock of `p`.
        unit: What 1 stands for on the new clock, in units of the old one.
        common: (2,) displacement that all points share at s, px.

    Returns:
        (rows, columns, 4) trajectories of the points visible at s, on the new clock, px.
    """
    out = np.empty_like(p)
    run_over_rows(_advect, len(p), p, np.float32(s), common, out)
    return out * np.array([unit, unit, unit**2, unit**2], np.float32)


class _SearchScratch(NamedTuple):
    """Scratch memory for each row that a kernel begins with."""

    rows: RowScratch
    values: NDArray[np.float32]  # (rows, 3, K, w), log intensity, information, weights
    lines: NDArray[np.float32]  # (rows, 6, w), sums (2), means, costs of points, of pixels (2)
    logs: NDArray[np.float64]  # (rows, 2, w), sums of logarithms, and products to take them of
    chosen: NDArray[np.int32]  # (rows, w), pixels of a row
    padded: NDArray[np.float32]  # (rows, w + taps)

    @classmethod
    def allocate(cls, shape: tuple[int, int], instants: int, taps: int) -> "_SearchScratch":
        """Allocate scratch memory for `run_over_rows`.

        Args:
            shape: Rows and columns of the points.
            instants: Number of instants.
            taps: Length of the blur along a row, px.
        """
        rows, columns = shape
        return cls(
            RowScratch.allocate(rows, columns),
            empty_row_scratch(rows, 3, instants, columns),
            empty_row_scratch(rows, 6, columns),
            np.empty((rows, 2, columns)),
            np.empty((rows, columns), np.int32),
            empty_row_scratch(rows, columns + taps),
        )


class _SearchInputs(NamedTuple):
    """One pass of `select_paths`.

    Attributes:
        images: Packed images.
        paths: (h, w, 4) paths of every `spacing`-th pixel, px.
        spacing: Distance of these pixels, px.
        offsets: (n, 2) distances of the pixels whose paths are tried, px.
        cost: Parameters of the cost.
        taps: Taps of the Gaussian filter.
        min_gain: Least gain from which another path is taken.
    """

    images: PackedImages
    paths: NDArray[np.float32]
    spacing: int
    offsets: NDArray[np.int64]
    cost: CostParams
    taps: NDArray[np.float32]
    min_gain: np.float32


@njit_noalloc_inlined
def _read_levels(image, pixel, part, level, V):
    """Write log intensity and variance of a packed image at points, bilinear.

    Args:
        image: (h, w, 4) packed image.
        pixel: (2, points) x and y of the pixel before each point.
        part: (2, points) distance from that pixel, px.
        level: (points,) output, ln I.
        V: (points,) output, (ln I)^2.
    """
    h, w, _ = image.shape
    for i in range(len(level)):
        x0, y0 = pixel[0, i], pixel[1, i]
        x1 = min(x0 + 1, w - 1)
        upper, lower = image[y0], image[min(y0 + 1, h - 1)]
        a, b, c, d = bilinear_weights(part[0, i], part[1, i])
        level[i] = a * upper[x0, 0] + b * upper[x1, 0] + c * lower[x0, 0] + d * lower[x1, 0]
        V[i] = a * upper[x0, 1] + b * upper[x1, 1] + c * lower[x0, 1] + d * lower[x1, 1]


@njit_noalloc_inlined
def _evaluate_cost(count, begin, y, inputs, scratch):
    """Write the robust costs of a row's first points into `scratch.lines[begin, 3]`.

    Their paths and places at the target stand in `scratch.rows`.
    Args:
        count: Number of points.
        begin: First row of the kernel, whose scratch memory is used.
        y: Row of the points at the target, px of the images.
        inputs: `_SearchInputs`.
        scratch: `_SearchScratch`.
    """
    images, nu = inputs.images, inputs.cost.robust
    h, w = images.pixels.shape[1:3]
    times, rows, lines = images.times, scratch.rows, scratch.lines[begin]
    path, pixel, part = rows.path[begin], rows.pixel[begin], rows.part[begin]
    x, inside = rows.x[begin], rows.inside[begin]
    level, W, R = scratch.values[begin, 0], scratch.values[begin, 1], scratch.values[begin, 2]
    means, costs = lines[2, :count], lines[3]
    total, product = scratch.logs[begin, 0], scratch.logs[begin, 1]
    for k in range(len(times.s)):
        locate_points(y, times, k, (h, w), count, (path, x, pixel, part, inside))
        _read_levels(images.pixels[k], pixel, part, level[k, :count], W[k])
        fill_information(W[k, :count], inside, inputs.cost.floor, W[k])
    robust_means(level, W, images.near, nu, (R, means, lines[:2]))
    for i in range(count):
        total[i], product[i] = 0.0, 1.0
    for k in range(len(times.s)):
        for i in range(count):
            e = level[k, i] - means[i]
            product[i] *= 1.0 + e * e * W[k, i] / nu
        # One logarithm for many takes less time; nor is this too large for it.
        if k % 16 == 15 or k + 1 == len(times.s):
            for i in range(count):
                total[i] += np.log(product[i])
                product[i] = 1.0
    for i in range(count):
        costs[i] = nu * np.float32(total[i])


@njit_noalloc_inlined
def _path_difference(own, other):
    """Bound the difference of two paths at the farthest instant.

    Args:
        own: (4,) path, px.
        other: (4,) path, px.

    Returns:
        An upper bound of the larger one of the differences along x and y, px.
    """
    x = abs(other[0] - own[0]) + abs(other[2] - own[2])
    return max(x, abs(other[1] - own[1]) + abs(other[3] - own[3]))


@njit_noalloc_inlined
def _paths_are_alike(paths, y, x, offsets):
    """Return whether no path nearby differs from a pixel's own.

    Args:
        paths: (h, w, 4) paths, px.
        y: Row of the pixel.
        x: Its column.
        offsets: (n, 2) rows and columns to the pixels nearby; the first is the pixel itself.

    Returns:
        Whether all differ by less than `MIN_PATH_DIFFERENCE_PX`.
    """
    h, w, _ = paths.shape
    for n in range(1, len(offsets)):
        i = min(max(y + offsets[n, 0], 0), h - 1)
        j = min(max(x + offsets[n, 1], 0), w - 1)
        if _path_difference(paths[y, x], paths[i, j]) >= MIN_PATH_DIFFERENCE_PX:
            return False
    return True


@njit_noalloc_inlined
def _list_pixels(y, n, inputs, begin, scratch):
    """Write the pixels of a row to compare along the path at an offset, with that path.

    Args:
        y: The row.
        n: Number of the offset; 0: the pixels' own paths.
        inputs: `_SearchInputs`.
        begin: First row of the kernel, whose scratch memory is used.
        scratch: `_SearchScratch`.

    Returns:
        Their number.
    """
    paths, offsets, rows = inputs.paths, inputs.offsets, scratch.rows
    h, w, _ = paths.shape
    own, count = scratch.lines[begin, 4], 0
    i = min(max(y + offsets[n, 0], 0), h - 1)
    for x in range(w):
        j = min(max(x + offsets[n, 1], 0), w - 1)
        if n == 0:
            wanted = not _paths_are_alike(paths, y, x, offsets)
        else:  # of a path that is good no other is clearly better
            difference = _path_difference(paths[y, x], paths[i, j])
            wanted = own[x] >= inputs.min_gain and difference >= MIN_PATH_DIFFERENCE_PX
        if wanted:
            scratch.chosen[begin, count] = x
            rows.x[begin, count] = np.float32(x * inputs.spacing)
            for c in range(4):
                rows.path[begin, c, count] = paths[i, j, c]
            count += 1
    return count


@njit_noalloc
def _evaluate_paths(begin, end, inputs, scratch, out):
    """Write the costs of the paths at all offsets, blurred along x; the first is a pixel's own.

    Only differences between them count, so they are 0 where no path differs, and those of the own
    path where another is not compared.
    Args:
        begin: First row.
        end: Row after the last one.
        inputs: `_SearchInputs`.
        scratch: `_SearchScratch`.
        out: (n, h, w) output, costs.
    """
    chosen, found, padded = scratch.chosen[begin], scratch.lines[begin, 3], scratch.padded[begin]
    own, other = scratch.lines[begin, 4], scratch.lines[begin, 5]
    for y in range(begin, end):
        own[:] = np.float32(0)
        for n in range(len(inputs.offsets)):
            count = _list_pixels(y, n, inputs, begin, scratch)
            _evaluate_cost(count, begin, np.float32(y * inputs.spacing), inputs, scratch)
            for x in range(len(own)):
                other[x] = own[x]
            for m in range(count):
                other[chosen[m]] = found[m]
                if n == 0:
                    own[chosen[m]] = found[m]
            blur_along_x(other, inputs.taps, padded, out[n, y])


@njit_noalloc
def _write_selected_paths(begin, end, inputs, found, scratch, out):
    """Write the paths that pixels take.

    Args:
        begin: First row of the pixels that were compared.
        end: Row after the last one.
        inputs: `_SearchInputs`.
        found: Costs (n, rows, columns), blurred along x, and present paths (h, w), as flat indices.
        scratch: `_SearchScratch`.
        out: (h, w) output, flat indices of the pixels whose paths are taken.
    """
    costs, path_index = found
    h, w = path_index.shape
    lines, spacing = scratch.lines[begin], inputs.spacing
    cost, least, best = lines[0], lines[1], lines[2]
    for row in range(begin, end):
        for n in range(len(costs)):
            blur_along_y(costs[n], row, inputs.taps, cost)
            more = inputs.min_gain if n else np.float32(0)
            for i in range(len(cost)):
                if n == 0 or cost[i] + more < least[i]:
                    least[i], best[i] = cost[i] + more, np.float32(n)
        for y in range(row * spacing, min((row + 1) * spacing, h)):
            for x in range(w):
                move = inputs.offsets[int(best[x // spacing])]
                i = min(max(y + move[0] * spacing, 0), h - 1)
                out[y, x] = path_index[i, min(max(x + move[1] * spacing, 0), w - 1)]


def select_paths(
    images: PackedImages,
    paths: NDArray[np.float32],
    cost: CostParams,
    searches: tuple[PathSearch, ...] = PATH_SEARCHES,
) -> NDArray[np.int32]:
    """Select for each pixel the path of a nearby pixel along which the images agree best.

    Args:
        images: Packed images of full resolution.
        paths: (h, w, 4) paths of all pixels, px.
        cost: Parameters of the cost, float32.
        searches: The passes over the image, in order.

    Returns:
        (h, w) flat indices of the pixels whose paths are taken, row by row.
    """
    h, w, _ = paths.shape
    min_gain = np.float32(MIN_COST_GAIN * len(images.times.s))
    path_index = np.arange(h * w, dtype=np.int32).reshape(h, w)
    for spacing, distance, sigma in searches:
        some = paths.reshape(-1, 4)[path_index[::spacing, ::spacing]]
        taps, shape = gaussian_taps(sigma), some.shape[:2]
        inputs = _SearchInputs(
            images, some, spacing, NEIGHBOUR_OFFSETS * distance, cost, taps, min_gain
        )
        costs = np.empty((len(NEIGHBOUR_OFFSETS), *shape), np.float32)
        scratch = _SearchScratch.allocate(shape, len(images.times.s), len(taps))
        run_over_rows(_evaluate_paths, shape[0], inputs, scratch, costs)
        out = np.empty_like(path_index)
        run_over_rows(_write_selected_paths, shape[0], inputs, (costs, path_index), scratch, out)
        path_index = out
    return path_index


def borrow_paths(
    images: PackedImages, p: NDArray[np.float32], cost: CostParams
) -> NDArray[np.float32]:
    """Let nodes take the trajectories of others nearby along which images agree better.

    Args:
        images: Packed images of full resolution.
        p: (rows, columns, 4) trajectories of nodes, px.
        cost: Parameters of the cost, float32.

    Returns:
        (rows, columns, 4) the trajectories, px.
    """
    size = images.pixels.shape[1:3]
    index = select_paths(images, interpolate_paths(p, size), cost, PATH_SEARCHES[:1])
    y, x = np.divmod(index[::2, ::2], size[1])
    return p[y // 2, x // 2]
