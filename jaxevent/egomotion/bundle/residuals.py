"""Residuals of events by a scene: its path, depths and map of log intensity; and their Jacobian.

Events of a window are series, one per pixel, one after another. The map is a quadratic B-spline
with knots 1 px apart.
"""

from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle import warp

DEPTH_BOUND_NODES = 4  # about an event, among whose depths the event's lies


class PixelSeries(NamedTuple):
    """Events of a window as one series per pixel; arrays of events are (E,).

    Rows from `n_events` on are pixels of frames, with `count` and `p` 0: a series for each frame.

    Attributes:
        x: Undistorted columns from the principal point, px.
        y: Undistorted rows from the principal point, px.
        tau: Times from the reference time, s.
        level: Sum of the series' polarities up to and with the event.
        count: Number of these.
        p: Polarities, +1 or -1.
        precision: Noise of an event over that of the row, at most 1.
        n_events: Number of rows that are events.
        begin: (series + 1,) first row of each series, and E.
        f: Focal length, px.
        half: Half the length of the window, s.
        shape: Height and width of the map, px.
        corner: Position of the map's pixel [0, 0], px.
        node: Distance of the nodes of depth, px.
    """

    x: NDArray
    y: NDArray
    tau: NDArray
    level: NDArray
    count: NDArray
    p: NDArray
    precision: NDArray
    n_events: int
    begin: NDArray[np.int64]
    f: float
    half: float
    shape: tuple[int, int]
    corner: tuple[float, float]
    node: int

    @property
    def points(self) -> warp.Points:
        """Pixels and times of all rows."""
        return warp.Points(self.x, self.y, self.tau)

    @property
    def nodes(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        height, width = self.shape
        return (height - 2) // self.node + 2, (width - 2) // self.node + 2

    @property
    def grid(self) -> warp.MapGrid:
        """Positions of the map's pixels and of the nodes."""
        (x, y), (height, width), (rows, columns) = self.corner, self.shape, self.nodes
        return warp.MapGrid(float(x), float(y), height, width, float(self.node), rows, columns)

    @property
    def node_positions(self) -> tuple[NDArray, NDArray]:
        """Positions x and y (nodes,) of nodes in the reference view, px, row by row."""
        rows, columns = self.nodes
        j, i = np.divmod(np.arange(rows * columns), columns)
        return self.corner[0] + i * self.node, self.corner[1] + j * self.node


class Scene(NamedTuple):
    """Unknowns: path with log depths at nodes, map of log intensity, skew of the thresholds.

    The map is in units of the mean threshold C; C (1 + skew) is that of ON, C (1 - skew) of OFF.

    Attributes:
        path: Path with log depths at nodes.
        map: (height, width) log intensity.
        skew: Skew of the thresholds.
    """

    path: warp.Path
    map: NDArray
    skew: float


class MapSamples(NamedTuple):
    """Projections of events (E,) to the reference view, and the map's values there.

    Attributes:
        X: Positions along x, px.
        Y: Positions along y, px.
        log_rho: Log inverse depths.
        first: Index of the first of the nine splines about the position.
        u: Distance from the middle spline along x, px.
        v: Distance from the middle spline along y, px.
        inside: 1 inside the map, else 0.
        value: Values of the map, C.
    """

    X: NDArray
    Y: NDArray
    log_rho: NDArray
    first: NDArray[np.int32]
    u: NDArray
    v: NDArray
    inside: NDArray
    value: NDArray


class RobustLoss(NamedTuple):
    """Scales of the robust cost of residuals."""

    limit: float  # C^2, squared residual of an outlier
    typical_cost: float  # C^2, mean cost about a position from which its events count less
    plane: bool  # whether depths are a plane's, which hides nothing of itself


class WeightScratch(NamedTuple):
    """Scratch memory of `robust_weights`.

    Attributes:
        image: (height, width).
        rows: (height, width + 4).
        sums: (height, width).
        number: (height, width).
        residual: (E,).
        cost: (E,).
    """

    image: NDArray
    rows: NDArray
    sums: NDArray
    number: NDArray
    residual: NDArray
    cost: NDArray

    @classmethod
    def of(cls, shape: tuple[int, int], residual: NDArray) -> "WeightScratch":
        """Allocate the scratch memory.

        Args:
            shape: (height, width) of the map, px.
            residual: (E,) residuals, of which length and type count.

        Returns:
            The memory, not initialised.
        """
        image, sums, number = np.empty((3, *shape), residual.dtype)
        rows = np.empty((shape[0], shape[1] + 4), residual.dtype)
        return cls(image, rows, sums, number, np.empty_like(residual), np.empty_like(residual))


@njit_fastmath
def interpolate_map(image, grid, samples):
    """Interpolate the map at events by quadratic B-splines.

    Args:
        image: (height * width,) coefficients of the map.
        grid: `MapGrid`.
        samples: `MapSamples`, of which X and Y are read, and the splines, `inside` and `value` are
            written.
    """
    width = grid.width
    for e in range(len(samples.X)):
        i, j = samples.X[e] - grid.x, samples.Y[e] - grid.y
        samples.inside[e] = i >= 1 and i < width - 2 and j >= 1 and j < grid.height - 2
        i, j = min(max(i, 1.0), width - 2.0), min(max(j, 1.0), grid.height - 2.0)
        column, row = int(i + 0.5), int(j + 0.5)
        a, b = i - column, j - row
        k = (row - 1) * width + column - 1
        samples.first[e], samples.u[e], samples.v[e] = k, a, b
        s = 0.0
        for m in range(3):
            s += bspline(m, b) * (
                bspline(0, a) * image[k]
                + bspline(1, a) * image[k + 1]
                + bspline(2, a) * image[k + 2]
            )
            k += width
        samples.value[e] = s


@njit_fastmath_inlined
def bspline(m, t):
    """Evaluate one of the three quadratic B-splines about a position.

    Args:
        m: 0 to 2, the spline before, at and after the middle one.
        t: Position, -0.5 to 0.5 px from the centre of the middle one.
    """
    return 0.75 - t * t if m == 1 else (0.5 + (m - 1) * t) ** 2 / 2


@njit_fastmath_inlined
def bspline_derivative(m, t):
    """Evaluate the derivative of a quadratic B-spline.

    Args:
        m: 0 to 2, the spline before, at and after the middle one.
        t: Position, -0.5 to 0.5 px from the centre of the middle one.

    Returns:
        1/px.
    """
    return -2 * t if m == 1 else (m - 1) * 0.5 + t


@njit_fastmath_inlined
def _sum_boxes(image, rows, sums):
    """Sum an image over the square of 5 px about each pixel.

    Args:
        image: (height, width).
        rows: (height, width + 4) scratch.
        sums: (height, width) output.
    """
    height, width = image.shape
    rows[:] = 0
    for j in range(height):
        for k in range(max(j - 2, 0), min(j + 3, height)):
            for i in range(width):
                rows[j, i + 2] += image[k, i]
    for j in range(height):
        row = rows[j]
        for i in range(width):
            sums[j, i] = row[i] + row[i + 1] + row[i + 2] + row[i + 3] + row[i + 4]


@njit_fastmath
def subtract_mean(values, weight, begin):
    """Subtract the weighted mean of each series from its values, in place.

    Args:
        values: (E,) values.
        weight: (E,) weights.
        begin: (series + 1,) first row of each series, and E.
    """
    for k in range(len(begin) - 1):
        total, s = 0.0, 0.0
        for e in range(begin[k], begin[k + 1]):
            total += weight[e]
            s += weight[e] * values[e]
        mean = s / max(total, 1e-3)
        for e in range(begin[k], begin[k + 1]):
            values[e] -= mean


@njit_fastmath
def robust_weights(residual, samples, series, loss, scratch, weight):
    """Reweight events by their residuals and by those about them (Geman & McClure).

    Events at a position of mean cost q cost 4 q / (1 + q / typical), of derivative 1 at the
    typical q: outlines that cross mislead all events there.

    Args:
        residual: (E,) C, before means of series are subtracted.
        samples: `MapSamples` of the events.
        series: `PixelSeries`.
        loss: `RobustLoss`.
        scratch: `WeightScratch`.
        weight: (E,) weights of the step before; overwritten.

    Returns:
        The cost of positions, and that of events, C^2.
    """
    image, rows, sums, number, left, cost = scratch
    on, first, precision, begin = samples.inside, samples.first, series.precision, series.begin
    flat, middle = image.reshape(-1), image.shape[1] + 1
    flat[:] = 0
    for k in range(len(residual)):
        flat[first[k] + middle] += on[k]
    _sum_boxes(image, rows, number)
    events, around_it = number.reshape(-1), sums.reshape(-1)
    of_positions, of_events = 0.0, residual.dtype.type(0)
    for _ in range(2):
        for k in range(len(residual)):
            left[k] = residual[k]
        subtract_mean(left, weight, begin)
        flat[:] = 0
        for k in range(len(residual)):
            square = (precision[k] * left[k]) ** 2
            cost[k] = on[k] * square / (1 + square / loss.limit)
            flat[first[k] + middle] += cost[k]
        _sum_boxes(image, rows, sums)
        flat[:] = 0
        of_positions = 0.0
        for k in range(len(residual)):
            at = first[k] + middle
            n = max(events[at], 1.0)
            q = around_it[at] / n
            slope = 1.0 if loss.plane else 4 / (1 + q / loss.typical_cost) ** 2
            of_positions += on[k] * (q if loss.plane else 4 * q / (1 + q / loss.typical_cost))
            flat[at] += on[k] * slope / n
        _sum_boxes(image, rows, sums)
        for k in range(len(residual)):
            t = precision[k] ** 2
            w = on[k] * t / (1 + t * left[k] ** 2 / loss.limit) ** 2
            weight[k] = w * around_it[first[k] + middle]
    for k in range(series.n_events):
        of_events += cost[k]
    return of_positions, of_events


def project_events(
    path: warp.Path, series: PixelSeries, log_rho: NDArray | None = None
) -> tuple[warp.Positions, NDArray]:
    """Project events into the reference view.

    Args:
        path: Path with log depths at nodes.
        series: The events.
        log_rho: (E,) log inverse depths of the events in a similar scene, which saves time.

    Returns:
        Positions in px, and log inverse depths (E,).
    """
    out = warp.Positions(np.empty_like(series.x), np.empty_like(series.x))
    root = np.full_like(series.x, -np.inf) if log_rho is None else log_rho.copy()
    depth = np.ascontiguousarray(path.log_rho)
    of, size = depth.reshape(series.nodes), 2 * DEPTH_BOUND_NODES + 1
    high = scipy.ndimage.maximum_filter(of, size, mode="nearest").ravel()
    low = scipy.ndimage.minimum_filter(of, size, mode="nearest").ravel()
    field = warp.DepthField(depth, high, low, series.grid)
    warp.project(series.points, path.motion(series.f), field, root, out)
    return out, root


def sample_map(
    scene: Scene, series: PixelSeries, before: MapSamples | None = None, *, same_path: bool = False
) -> MapSamples:
    """Project events into a scene's reference view and interpolate its map there.

    Args:
        scene: Path, depths and map.
        series: The events.
        before: Samples of a similar scene, whose depths save time.
        same_path: Whether path and depths are those of `before`.

    Returns:
        Positions and map values of the events.
    """
    if before is not None and same_path:
        X, Y, depth = before.X, before.Y, before.log_rho
    else:
        (X, Y), depth = project_events(scene.path, series, before.log_rho if before else None)
    u, v, inside, value = (np.empty_like(X) for _ in range(4))
    samples = MapSamples(X, Y, depth, np.empty(len(X), np.int32), u, v, inside, value)
    interpolate_map(scene.map.ravel(), series.grid, samples)
    return samples


def residuals(scene: Scene, series: PixelSeries) -> NDArray:
    """Return the residuals of a series: L(x_e) - s_e less its mean over the series' events, C.

    Args:
        scene: Path and map.
        series: The events of some pixels.

    Returns:
        (E,); 0 beyond the map.
    """
    samples = sample_map(scene, series)
    left = samples.value - series.level - scene.skew * series.count
    left = left.astype(series.x.dtype)
    subtract_mean(left, samples.inside, series.begin)
    return samples.inside * left


class FreeUnknowns(NamedTuple):
    """Unknowns that are free beside the map and the path."""

    plane: bool  # depths are a plane's
    depths: float  # 1, or 0: translation and depths are held
    median_rho: float  # 1/m in units of 1/|T|


class MapField(NamedTuple):
    """Map of log intensity and depths, and the positions of both.

    Attributes:
        image: (height * width,) map, C.
        log_rho: (nodes,) log inverse depths.
        grid: Positions of pixels and nodes.
    """

    image: NDArray
    log_rho: NDArray
    grid: warp.MapGrid


class Direction(NamedTuple):
    """A change of the unknowns, or a gradient.

    Attributes:
        map: (height * width,) of the map.
        coefficients: (6, rows) of the path's polynomials.
        more: Of the skew and of a plane's normal.
        depth: (nodes,) of the depths.
    """

    map: NDArray
    coefficients: NDArray
    more: NDArray
    depth: NDArray


class ResidualJacobian(NamedTuple):
    """Derivatives of residuals (E,) before the means of series are subtracted.

    By the map: nine splines about `first`, `u` and `v` px beside the middle one. By the path's
    coefficients: `base` times powers of `tau`, from the first on. By log depth: `by_depth`, shared
    among the four nodes from `node` on.

    Attributes:
        first: (E,) index of the first spline.
        u: (E,) distance from the middle spline along x, px.
        v: (E,) distance from the middle spline along y, px.
        base: (6, E) derivatives by the path's first coefficients.
        tau: (E,) times, in half windows.
        more: (n, E) derivatives by the skew and the normal of a plane.
        node: (E,) index of the first node.
        across: (E,) weight of the next column's nodes.
        down: (E,) weight of the next row's nodes.
        by_depth: (E,) derivatives by log depth.
        width: Width of the map, px.
        columns: Columns of nodes.
    """

    first: NDArray[np.int32]
    u: NDArray
    v: NDArray
    base: NDArray
    tau: NDArray
    more: NDArray
    node: NDArray[np.int32]
    across: NDArray
    down: NDArray
    by_depth: NDArray
    width: int
    columns: int


@njit_fastmath
def differentiate_residuals(series, samples, motion, field, free, jacobian):
    """Write the Jacobian of residuals, of events on the nearest surface.

    x = r + rho(x) d, so (1 - d grad rho') dx is what dx were with rho held, d = rho (f C - C_z r).

    Args:
        series: `PixelSeries`.
        samples: `MapSamples` of its events.
        motion: `CameraMotion`.
        field: `MapField` of the scene.
        free: `FreeUnknowns`.
        jacobian: `ResidualJacobian`, output, with its splines already written.
    """
    x, y, tau, half, number = series.x, series.y, series.tau, series.half, series.count
    X, Y, f, grid, image = samples.X, samples.Y, motion.f, field.grid, field.image
    for e in range(len(x)):
        t = tau[e]
        rx, ry, dx, dy = warp.reference_ray(motion, x[e], y[e], t)
        log_rho, lx, ly = warp.interpolate_depth(field.log_rho, X[e], Y[e], grid)
        rho = np.exp(log_rho)
        k, jacobian.across[e], jacobian.down[e] = warp.bilinear_corner(X[e], Y[e], grid)
        jacobian.node[e] = k
        a, b, gx, gy = jacobian.u[e], jacobian.v[e], 0.0, 0.0
        k = jacobian.first[e]
        for m in range(3):
            for n in range(3):
                value = image[k + m * grid.width + n]
                gx += bspline(m, b) * bspline_derivative(n, a) * value
                gy += bspline_derivative(m, b) * bspline(n, a) * value
        dx, dy = rho * dx, rho * dy
        slope = (gx * dx + gy * dy) / max(1 - lx * dx - ly * dy, warp.MIN_RAY_DERIVATIVE)
        hx, hy = gx + slope * lx, gy + slope * ly
        here = samples.inside[e]
        by = warp.pose_gradient(motion, t, (rx, ry), rho, here * hx, here * hy)
        for n in range(6):
            jacobian.base[n, e] = by[n]
        by_depth = here * (hx * dx + hy * dy)
        jacobian.more[0, e] = -here * number[e]
        if free.plane:
            share = by_depth * free.median_rho / rho
            jacobian.more[1, e] = share * X[e] / f
            jacobian.more[2, e] = share * Y[e] / f
            jacobian.more[3, e] = share
        jacobian.by_depth[e] = 0.0 if free.plane else free.depths * by_depth
        jacobian.tau[e] = t / half


def residual_jacobian(
    scene: Scene, series: PixelSeries, samples: MapSamples, free: FreeUnknowns | None
) -> ResidualJacobian:
    """Return the Jacobian of residuals; without `free`, by the map alone."""
    E, real = len(series.x), series.x.dtype
    make = np.zeros if free is None else np.empty
    jacobian = ResidualJacobian(
        samples.first, samples.u, samples.v, make((6, E), real), make(E, real),
        make((4 if free and free.plane else 1, E), real), make(E, np.int32), make(E, real),
        make(E, real), make(E, real), series.grid.width, series.grid.columns,
    )  # fmt: skip
    if free is not None:
        depth = np.ascontiguousarray(scene.path.log_rho)
        field = MapField(scene.map.ravel(), depth, series.grid)
        motion: warp.CameraMotion = scene.path.motion(series.f)
        differentiate_residuals(series, samples, motion, field, free, jacobian)
    return jacobian


@njit_fastmath
def multiply_jacobian(jacobian, direction, value):
    """Compute the changes of residuals for a change of the unknowns.

    Args:
        jacobian: `ResidualJacobian`.
        direction: `Direction`, the change.
        value: (E,) output, C.
    """
    image, coefficients, more, depth = direction
    width, columns = jacobian.width, jacobian.columns
    real = value.dtype.type
    half, middle, one = real(0.5), real(0.75), real(1)
    for e in range(len(value)):
        value[e] = 0
    for axis in range(6):
        base, tau = jacobian.base[axis], jacobian.tau
        a, b, c, d, g = coefficients[axis]
        for e in range(len(value)):
            t = tau[e]
            value[e] += base[e] * t * (a + t * (b + t * (c + t * (d + t * g))))
    for n in range(len(more)):
        row, by = jacobian.more[n], more[n]
        for e in range(len(value)):
            value[e] += row[e] * by
    first, node = jacobian.first, jacobian.node
    for e in range(len(value)):
        k, a, b = first[e], jacobian.u[e], jacobian.v[e]
        x, y, z = half * (half - a) * (half - a), middle - a * a, half * (half + a) * (half + a)
        s = half * (half - b) * (half - b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k += width
        s += (middle - b * b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k += width
        s += half * (half + b) * (half + b) * (x * image[k] + y * image[k + 1] + z * image[k + 2])
        k, a, b = node[e], jacobian.across[e], jacobian.down[e]
        top = (one - a) * depth[k] + a * depth[k + 1]
        k += columns
        low = (one - a) * depth[k] + a * depth[k + 1]
        value[e] += s + jacobian.by_depth[e] * ((one - b) * top + b * low)


@njit_fastmath
def multiply_transpose(jacobian, z, out):
    """Multiply the transposed Jacobian by a vector.

    Args:
        jacobian: `ResidualJacobian`.
        z: (E,) vector.
        out: `Direction`, output.
    """
    image, coefficients, more, depth = out
    width, columns = jacobian.width, jacobian.columns
    real = z.dtype.type
    half, middle, one = real(0.5), real(0.75), real(1)
    image[:] = 0
    depth[:] = 0
    first, node = jacobian.first, jacobian.node
    for e in range(len(z)):
        k, a, b, s = first[e], jacobian.u[e], jacobian.v[e], z[e]
        x = half * (half - a) * (half - a) * s
        y, w = (middle - a * a) * s, half * (half + a) * (half + a) * s
        share = half * (half - b) * (half - b)
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k += width
        share = middle - b * b
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k += width
        share = half * (half + b) * (half + b)
        image[k] += share * x
        image[k + 1] += share * y
        image[k + 2] += share * w
        k, a, b, s = node[e], jacobian.across[e], jacobian.down[e], s * jacobian.by_depth[e]
        depth[k] += (one - b) * (one - a) * s
        depth[k + 1] += (one - b) * a * s
        k += columns
        depth[k] += b * (one - a) * s
        depth[k + 1] += b * a * s
    for axis in range(6):
        base, tau = jacobian.base[axis], jacobian.tau
        p = q = r = s = o = real(0)
        for e in range(len(z)):
            t = tau[e]
            v = z[e] * base[e] * t
            p += v
            v *= t
            q += v
            v *= t
            r += v
            v *= t
            s += v
            o += v * t
        sums = coefficients[axis]
        sums[0], sums[1], sums[2], sums[3], sums[4] = p, q, r, s, o
    for n in range(len(more)):
        row, s = jacobian.more[n], real(0)
        for e in range(len(z)):
            s += row[e] * z[e]
        more[n] = s
