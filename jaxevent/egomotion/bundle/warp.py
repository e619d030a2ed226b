"""Path of a camera in a window of events, and the warp of events to the reference view.

In a window around t_r, with tau = t - t_r, the pose of camera(t) in camera(t_r) is

    phi(tau) = O0 tau + O1 tau^2 / 2 + ... + O4 tau^5 / 120,  R = exp[phi]x
    C(tau) = C1 tau + C2 tau^2 / 2 + ... + C5 tau^5 / 120,  |C1| = 1

(a constant twist has C2 = O0 x C1, so the unknowns are D2 = C2 - O0 x C1 and so on), and a point of
inverse depth rho in the reference view is moved there by the exact warp

    r = pi(R x),  x_ref = r + rho (f C_xy - C_z r),

which is linear in rho.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined

N_COEFFICIENT_ROWS = 5  # of O and of D: T and Omega are polynomials of the fourth degree
N_WINDOW_SEGMENTS = 8  # of a window, at whose middles a gyro's prior acts
MIN_RELATIVE_PLANE_RHO = 0.1  # least inverse depth of a plane, by the median one
MAX_RAY_SAMPLES = 16  # depths that are tried on a ray
RAY_STEP_PX = 1.0  # between them, unless that takes more of them
MAX_NEWTON_STEP_LOG_DEPTH = 0.01  # a larger second step of Newton starts a search of the ray
MIN_RAY_DERIVATIVE = 0.3  # of log depth less that of the scene, along an event's ray
MAX_PATH_STEP_PX = 4.0  # at the window's end, that one Gauss-Newton step of a path moves the image
MAX_LOG_DEPTH_STEP = 0.5  # of log depth, in one step


class MapGrid(NamedTuple):
    """Positions of the map's pixels and of the nodes of depth in the reference view.

    Attributes:
        x: Position of pixel and node [0, 0] along x, px from the principal point.
        y: Position of pixel and node [0, 0] along y, px from the principal point.
        height: Height of the map, px.
        width: Width of the map, px.
        node: Distance of nodes, px.
        rows: Rows of nodes.
        columns: Columns of nodes.
    """

    x: float
    y: float
    height: int
    width: int
    node: float
    rows: int
    columns: int


class Points(NamedTuple):
    """Pixels at their times.

    Attributes:
        x: (n,) undistorted columns from the principal point, px.
        y: (n,) undistorted rows from the principal point, px.
        tau: (n,) times from the reference time, s.
    """

    x: NDArray
    y: NDArray
    tau: NDArray


class Positions(NamedTuple):
    """Positions in the reference view.

    Attributes:
        X: (n,) columns from the principal point, px.
        Y: (n,) rows from the principal point, px.
    """

    X: NDArray
    Y: NDArray


class CameraMotion(NamedTuple):
    """Polynomials of a path for compiled functions.

    Attributes:
        phi: (rows, 3) factors of tau, tau^2, ... of the rotation vector, rad/s^k.
        C: (rows, 3) factors of tau, tau^2, ... of the camera's position, in units of |T|.
        f: Focal length, px.
    """

    phi: NDArray[np.float64]
    C: NDArray[np.float64]
    f: float


class CellGrid(NamedTuple):
    """Square cells of the reference view, row by row.

    Attributes:
        corner: Position of the first pixel of the first cell, px.
        size: Side of a cell, px.
        rows: Rows of cells.
        columns: Columns of cells.
    """

    corner: tuple[float, float]
    size: int
    rows: int
    columns: int


class DepthField(NamedTuple):
    """Log inverse depths at nodes, and their bounds about each node.

    Attributes:
        log_rho: (nodes,) log inverse depths.
        nearest: (nodes,) bound of the nearest depths.
        farthest: (nodes,) bound of the farthest depths.
        grid: Positions of the nodes.
    """

    log_rho: NDArray
    nearest: NDArray
    farthest: NDArray
    grid: MapGrid


@njit_fastmath_inlined
def _polynomial(c, tau, axis):
    """Evaluate sum_k c_k tau^k of one component, k from 1.

    Args:
        c: (rows, 3) factors of tau, tau^2, ...
        tau: Time from the reference time, s.
        axis: The component, 0 to 2.
    """
    s = c[N_COEFFICIENT_ROWS - 1, axis]
    for k in range(N_COEFFICIENT_ROWS - 2, -1, -1):
        s = s * tau + c[k, axis]
    return s * tau


@njit_fastmath_inlined
def _rotate(phi, x, y, z):
    """Rotate a point by exp[phi]x, to the sixth order of |phi|, which is below 1.

    Args:
        phi: Three components of the rotation vector, rad.
        x: Coordinate of the point, as are y and z.
        y: Coordinate.
        z: Coordinate.
    """
    a, b, c = phi
    s = a * a + b * b + c * c
    one, two = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    dx, dy, dz = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
    return x + one * cx + two * dx, y + one * cy + two * dy, z + one * cz + two * dz


@njit_fastmath_inlined
def reference_ray(motion, x, y, tau):
    """Return the ray r + rho d on which an event lies in the reference view.

    Args:
        motion: `CameraMotion`.
        x: Column of the event, px from the principal point, undistorted.
        y: Row of the event, likewise.
        tau: Time of the event from the reference time, s.

    Returns:
        (rx, ry, dx, dy): the position at infinity, px, and its change with the inverse depth rho,
            px.
    """
    phi, C, f = motion
    turn = _polynomial(phi, tau, 0), _polynomial(phi, tau, 1), _polynomial(phi, tau, 2)
    rx, ry, rz = _rotate(turn, x, y, f)
    z = max(rz / f, 0.05)
    rx, ry = rx / z, ry / z
    cz = _polynomial(C, tau, 2)
    return rx, ry, f * _polynomial(C, tau, 0) - cz * rx, f * _polynomial(C, tau, 1) - cz * ry


@njit_fastmath
def warp_points(points, rho, motion, out):
    """Warp points of known depth to the reference view.

    Args:
        points: `Points` (n,).
        rho: (n,) inverse depths, in units of 1/|T|.
        motion: `CameraMotion`.
        out: `Positions` (n,), output.
    """
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = reference_ray(motion, x[e], y[e], tau[e])
        out.X[e], out.Y[e] = rx + rho[e] * dx, ry + rho[e] * dy


@njit_fastmath_inlined
def _cell_index(x, y, cells):
    """Return the number of the cell that holds a position, or of the nearest cell.

    Args:
        x: px from the principal point.
        y: px from the principal point.
        cells: `CellGrid`.
    """
    left, top = cells.corner
    i = min(max(int(np.floor((x - left + 0.5) / cells.size)), 0), cells.columns - 1)
    j = min(max(int(np.floor((y - top + 0.5) / cells.size)), 0), cells.rows - 1)
    return j * cells.columns + i


@njit_fastmath
def assign_cells(points, motion, rho, cells, index, out):
    """Write the cell of each event after the warp with that cell's inverse depth, and its place.

    Args:
        points: `Points` (n,) of the events.
        motion: `CameraMotion`.
        rho: (cells,) inverse depths.
        cells: `CellGrid`.
        index: (n,) output, the events' cells.
        out: `Positions` (n,), output.
    """
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = reference_ray(motion, x[e], y[e], tau[e])
        k = _cell_index(x[e], y[e], cells)
        for _ in range(2):
            k = _cell_index(rx + rho[k] * dx, ry + rho[k] * dy, cells)
        index[e], out.X[e], out.Y[e] = k, rx + rho[k] * dx, ry + rho[k] * dy


@njit_fastmath_inlined
def bilinear_corner(x, y, grid):
    """Return the first of the four nodes about a position, and the position between them.

    Args:
        x: px from the principal point.
        y: px from the principal point.
        grid: `MapGrid`.

    Returns:
        Number of the node above and to the left, counted row by row, and the distance from it to
            the right and downwards, 0 to 1 nodes.
    """
    i = min(max((x - grid.x) / grid.node, 0.0), grid.columns - 1.001)
    j = min(max((y - grid.y) / grid.node, 0.0), grid.rows - 1.001)
    column, row = int(i), int(j)
    return row * grid.columns + column, i - column, j - row


@njit_fastmath_inlined
def bilinear_weight(u, v, corner):
    """Return the weight of one of four corners in bilinear interpolation.

    Args:
        u: Distance from the first corner to the right, 0 to 1 cells.
        v: Distance downwards.
        corner: 0 to 3: upper left, upper right, lower left, lower right.
    """
    return (u if corner % 2 else 1 - u) * (v if corner > 1 else 1 - v)


@njit_fastmath_inlined
def interpolate_depth(log_rho, x, y, grid):
    """Interpolate log inverse depth between nodes, bilinearly.

    Args:
        log_rho: (nodes,) log inverse depths.
        x: px from the principal point.
        y: px from the principal point.
        grid: `MapGrid`.

    Returns:
        The log inverse depth and its derivatives by x and y, 1/px.
    """
    k, u, v = bilinear_corner(x, y, grid)
    a, b = log_rho[k], log_rho[k + 1]
    c, d = log_rho[k + grid.columns], log_rho[k + grid.columns + 1]
    across, down = (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)
    level = a + u * (b - a) + v * (c - a + u * (d - c - b + a))
    return level, across / grid.node, down / grid.node


@njit_fastmath_inlined
def _newton_step(field, ray, log_rho):
    """Refine the log inverse depth at which a ray meets the scene, by one step of Newton's method.

    Args:
        field: `DepthField` of the scene.
        ray: (rx, ry, dx, dy) as of `reference_ray`, px.
        log_rho: Log inverse depth to start from.
    """
    rx, ry, dx, dy = ray
    rho = np.exp(log_rho)
    there, lx, ly = interpolate_depth(field.log_rho, rx + rho * dx, ry + rho * dy, field.grid)
    return log_rho - (log_rho - there) / max(1 - rho * (lx * dx + ly * dy), MIN_RAY_DERIVATIVE)


@njit_fastmath_inlined
def _first_intersection(field, ray, top, bottom):
    """Search a ray, from near to far, for the first surface of the scene.

    Args:
        field: `DepthField` of the scene.
        ray: (rx, ry, dx, dy) as of `reference_ray`, px.
        top: Log inverse depth at which the search begins.
        bottom: Log inverse depth at which it ends, smaller.

    Returns:
        The log inverse depth; `bottom` if the ray meets no surface.
    """
    rx, ry, dx, dy = ray
    depth, grid = field.log_rho, field.grid
    rho = np.exp(top)
    value = top - interpolate_depth(depth, rx + rho * dx, ry + rho * dy, grid)[0]
    if value <= 0:
        return top
    reach = np.sqrt(dx * dx + dy * dy) * (rho - np.exp(bottom)) / RAY_STEP_PX
    samples = min(1 + int(reach), MAX_RAY_SAMPLES)
    step, before = (bottom - top) / samples, top
    factor = np.exp(step)
    for _ in range(samples):
        rho *= factor
        log_rho = before + step
        new = log_rho - interpolate_depth(depth, rx + rho * dx, ry + rho * dy, grid)[0]
        if new <= 0:
            return before + step * value / max(value - new, 1e-6)
        before, value = log_rho, new
    return bottom


@njit_fastmath
def project(points, motion, field, log_rho, out):
    """Project events into the reference view, on the nearest surface that their rays meet.

    The ray x = r + rho d of an event meets the scene's depths rho'(x) where
    log rho = log rho'(r + rho d): once if depths are smooth, more often beside an edge, where the
    surface of the largest rho hides the others.

    Args:
        points: `Points` (n,) of the events.
        motion: `CameraMotion`.
        field: `DepthField` of the scene.
        log_rho: (n,) the events' log inverse depths in a similar scene, or -inf; overwritten.
        out: `Positions` (n,), output.
    """
    x, y, tau = points
    for e in range(len(x)):
        ray = reference_ray(motion, x[e], y[e], tau[e])
        rx, ry, dx, dy = ray
        here, new = log_rho[e], np.inf
        if here > -np.inf:
            here = _newton_step(field, ray, here)
            new = _newton_step(field, ray, here)
        if not abs(new - here) < MAX_NEWTON_STEP_LOG_DEPTH:
            k = bilinear_corner(rx, ry, field.grid)[0]
            top, bottom = field.nearest[k] + 0.02, field.farthest[k] - 0.02
            new = _first_intersection(field, ray, top, bottom)
            for _ in range(2):
                new = _newton_step(field, ray, new)
        log_rho[e], rho = new, np.exp(new)
        out.X[e], out.Y[e] = rx + rho * dx, ry + rho * dy


@njit_fastmath_inlined
def pose_gradient(motion, tau, ray, rho, hx, hy):
    """Return the gradient of hx X + hy Y by the pose phi and C, (X, Y) the end of an event's ray.

    For a rotation dR x = J dphi x R x, J the left Jacobian of phi; J' w = w - one phi x w + two phi
    x (phi x w).

    Args:
        motion: `CameraMotion`.
        tau: Time of the event from the reference time, s.
        ray: (rx, ry), px: the ray's position at infinity.
        rho: Inverse depth, in units of 1/|T|.
        hx: Factor of X.
        hy: Factor of Y.

    Returns:
        Six derivatives: by the three components of phi at tau, then by those of C.
    """
    phi, C, f = motion
    rx, ry = ray
    rest = 1 - rho * _polynomial(C, tau, 2)
    wx = rest * (-rx * ry / f * hx - (f + ry * ry / f) * hy)
    wy = rest * ((f + rx * rx / f) * hx + rx * ry / f * hy)
    wz = rest * (-ry * hx + rx * hy)
    p, q, s = _polynomial(phi, tau, 0), _polynomial(phi, tau, 1), _polynomial(phi, tau, 2)
    a = p * p + q * q + s * s
    one, two = 0.5 - a / 24 + a * a / 720, 1 / 6 - a / 120 + a * a / 5040
    ax, ay, az = q * wz - s * wy, s * wx - p * wz, p * wy - q * wx
    return (
        wx - one * ax + two * (q * az - s * ay),
        wy - one * ay + two * (s * ax - p * az),
        wz - one * az + two * (p * ay - q * ax),
        rho * f * hx,
        rho * f * hy,
        -rho * (rx * hx + ry * hy),
    )


@njit_fastmath
def point_derivatives(points, rho, motion, by, by_depth):
    """Differentiate the warped positions of points.

    Args:
        points: `Points` (n,).
        rho: (n,) inverse depths, in units of 1/|T|.
        motion: `CameraMotion`.
        by: (n, 6, 2) output, derivatives of X and Y by phi and C at the points' times.
        by_depth: (n, 2) output, derivatives of X and Y by log inverse depth, px.
    """
    x, y, tau = points
    for e in range(len(x)):
        rx, ry, dx, dy = reference_ray(motion, x[e], y[e], tau[e])
        by_depth[e, 0], by_depth[e, 1] = rho[e] * dx, rho[e] * dy
        for axis in range(2):
            h = 1.0 - axis
            six = pose_gradient(motion, tau[e], (rx, ry), rho[e], h, 1.0 - h)
            for n in range(6):
                by[e, n, axis] = six[n]


@dataclasses.dataclass(frozen=True)
class Path:
    """Unknowns of a path: rows O0, O1, ... (rad/s^k), and C1, D2, D3, ... in units of |T|.

    O and D are (rows, 3). `log_rho` holds log inverse depths of cells or nodes, in units of
    1/|T|.
    """

    O: NDArray[np.float64]  # noqa: E741
    D: NDArray[np.float64]
    log_rho: NDArray

    @classmethod
    def constant_twist(cls, heading: NDArray, Omega: NDArray, log_rho: NDArray) -> "Path":
        """Make the path of a constant twist.

        Args:
            heading: (3,) direction of T, of length 1, or 0 at rest.
            Omega: (3,) angular velocity, rad/s.
            log_rho: Log inverse depths of cells or nodes, in units of 1/|T|.

        Returns:
            The path.
        """
        O, D = np.zeros((N_COEFFICIENT_ROWS, 3)), np.zeros((N_COEFFICIENT_ROWS, 3))  # noqa: E741
        O[0], D[0] = Omega, heading
        return cls(O, D, log_rho)

    def derivatives(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return Omega and its derivatives, and those of C from the first on, at tau = 0."""
        constant, turn = [self.D[0]], cross_matrix(self.O[0])
        for _ in self.D[1:]:
            constant.append(turn @ constant[-1])
        C = np.array(constant)
        C[1:] += self.D[1:]
        return self.O, C

    def polynomial_coefficients(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the factors of tau, tau^2, ... in phi and C, (rows, 3) each."""
        O, C = self.derivatives()  # noqa: E741
        factorials = np.array([math.factorial(k + 1) for k in range(len(O))])[:, None]
        return O / factorials, C / factorials

    def motion(self, f: float) -> CameraMotion:
        """Return the polynomials for compiled functions, with the focal length f (px)."""
        return CameraMotion(*self.polynomial_coefficients(), f)

    def unit_twist(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """Return the heading, T of length 1, and Omega (rad/s), (times, 3) each, at tau (s).

        The heading is 0 at times at which the camera stands still.
        """
        T, Omega = self.velocities(tau)
        size = np.linalg.norm(T, axis=1, keepdims=True)
        return T / np.where(size > 0, size, 1), Omega

    def relative_speed(self, tau: float | int | NDArray) -> NDArray[np.float64]:
        """Return |T| at times tau (s), in units of |T| at 0."""
        return np.linalg.norm(self.velocities(tau)[0], axis=1)

    def velocities(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """Return T in units of |C1|, and Omega (rad/s), (times, 3) each, at tau (s)."""
        from scipy.spatial.transform import Rotation

        O, C = self.derivatives()  # noqa: E741
        tau = np.atleast_1d(np.asarray(tau, np.float64))
        powers = _taylor_powers(tau, 0, len(O))
        turns = Rotation.from_rotvec(_taylor_powers(tau, 1, len(O)) @ O)
        return turns.apply(powers @ C, inverse=True), powers @ O


def _taylor_powers(tau: NDArray, first: int, number: int) -> NDArray[np.float64]:
    """Return powers of time over factorials, tau^k / k!.

    Args:
        tau: (times,).
        first: First k.
        number: Number of values of k.

    Returns:
        (times, number).
    """
    return np.stack([tau**k / math.factorial(k) for k in range(first, first + number)], 1)


def segment_times(half: float) -> NDArray[np.float64]:
    """Return the middles (N_WINDOW_SEGMENTS,) of a window's segments, s from its middle."""
    return ((np.arange(N_WINDOW_SEGMENTS) + 0.5) / N_WINDOW_SEGMENTS * 2 - 1) * half


def warp(
    path: Path, f: float, points: Points, rho: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Warp points to the reference view.

    Args:
        path: Path of the camera.
        f: Focal length, px.
        points: Points, whose arrays broadcast with one another and with `rho`.
        rho: Inverse depths, in units of 1/|T|.

    Returns:
        X and Y in px from the principal point.
    """
    parts = np.broadcast_arrays(*(np.asarray(part, np.float64) for part in (*points, rho)))
    x, y, tau, depth = (np.ascontiguousarray(part).reshape(-1) for part in parts)
    out = Positions(np.empty_like(x), np.empty_like(x))
    warp_points(Points(x, y, tau), depth, path.motion(f), out)
    return out.X.reshape(parts[0].shape), out.Y.reshape(parts[0].shape)


class Prior(NamedTuple):
    """Prior knowledge about a window.

    Attributes:
        smooth: Weight of squared differences of log depth between cells.
        relief: Weight of squared differences of log depth from its mean.
        change: Weight of squared changes of the twist, 1/px^2.
        gyro: (N_WINDOW_SEGMENTS, 3) Omega at the segments' middles, rad/s.
        gyro_weight: Weight of the gyro, 1 / (rad/s)^2; 0: none.
        bond: Weight of squared differences of log depth between nodes.
        flat: Weight of squared differences of log intensity between pixels, 1/C^2.
        alike: Number of events that count as one.
        skew: Expected skew of the thresholds.
        skew_weight: Weight of squared differences from it.
        moves: Whether translation and depths are estimated, else they are held.
    """

    smooth: float
    relief: float
    change: float
    gyro: NDArray[np.float64]
    gyro_weight: float
    bond: float
    flat: float
    alike: float
    skew: float = 0.0
    skew_weight: float = 10.0
    moves: bool = True


def normalise(path: Path) -> Path:
    """Scale a path to |C1| = 1, and its depths with it."""
    size = float(np.linalg.norm(path.D[0]))
    depth = path.log_rho + path.log_rho.dtype.type(np.log(size))
    return Path(path.O, path.D / size, depth)


def cross_matrix(v: NDArray) -> NDArray[np.float64]:
    """Return the matrix (3, 3) [v]x with [v]x u = v x u."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], np.float64)


def pixel_rays(x: NDArray, y: NDArray, f: float) -> NDArray[np.float64]:
    """Return the rays of depth 1 through pixels.

    Args:
        x: (n,) px from the principal point, undistorted.
        y: (n,) px from the principal point, undistorted.
        f: Focal length, px.

    Returns:
        (n, 3) points x / f, y / f, 1.
    """
    return np.stack([x / f, y / f, np.ones(len(x))], 1)


def predict_path(path: Path, tau: float, half: float) -> Path:
    """Predict the path of a window that begins tau seconds later, or earlier.

    Its twist is that of `path` within the window of `path`. Beyond, where polynomials grow without
    bound, it stays that of the window's end. Depths are those of the same cells.

    Args:
        path: Path of the window before.
        tau: Shift of the window, s.
        half: Half the length of both windows, s.

    Returns:
        The path in the shifted window.
    """
    from scipy.spatial.transform import Rotation

    n = len(path.O)
    t = np.linspace(-half, half, 8 * N_WINDOW_SEGMENTS + 1)
    velocity, Omega = path.velocities(np.clip(t + tau, -half, half))
    powers = _taylor_powers(t, 0, n)
    O = np.linalg.lstsq(powers, Omega, rcond=None)[0]  # noqa: E741
    turned = Rotation.from_rotvec(_taylor_powers(t, 1, n) @ O).apply(velocity)
    C = np.linalg.lstsq(powers, turned, rcond=None)[0]
    # The inverse of `derivatives`.
    D, constant, turn = [C[0]], C[0], cross_matrix(O[0])
    for row in C[1:]:
        constant = turn @ constant
        D.append(row - constant)
    return normalise(Path(O.astype(np.float64), np.array(D), path.log_rho))


def pack_rows(path: Path, k: int = N_COEFFICIENT_ROWS) -> NDArray[np.float64]:
    """Pack the first rows of a path's O and D as one vector.

    Args:
        path: The path.
        k: Number of rows of each.

    Returns:
        (6 k,), O before D.
    """
    return np.concatenate([path.O[:k], path.D[:k]]).astype(np.float64).ravel()


def replace_rows(path: Path, values: NDArray) -> Path:
    """Replace the first rows of a path's O and D.

    Args:
        path: The path.
        values: (6 k,) rows, as of `pack_rows`.

    Returns:
        A path with these rows.
    """
    values = values.reshape(2, -1, 3)
    k, (O, D) = values.shape[1], (np.array(path.O), np.array(path.D))  # noqa: E741
    O[:k], D[:k] = values
    return Path(O, D, path.log_rho)


def row_units(
    path: Path, f: float, half: float, k: int = N_COEFFICIENT_ROWS
) -> NDArray[np.float64]:
    """Return the rows (6 k,) that each move a point of median depth by 1 px at the window's end.

    Args:
        path: Path whose median depth counts.
        f: Focal length, px.
        half: Half the length of the window, s.
        k: Number of rows of O and of D.
    """
    powers = np.array([math.factorial(m) / (f * half**m) for m in range(1, k + 1)])
    median = float(np.exp(np.median(path.log_rho)))
    return np.repeat(np.concatenate([powers, powers / median]), 3)


def is_twist_change(k: int = N_COEFFICIENT_ROWS) -> NDArray[np.bool_]:
    """Return which of the numbers of `pack_rows` describe a change of the twist."""
    return np.repeat(np.tile(np.arange(k) > 0, 2), 3)


def row_priors(
    prior: Prior, unit: NDArray, half: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the cost of the priors on rows t as t' K t / 2 - b' t + c.

    They are on changes of the twist and the gyro; Omega(tau) = O0 + O1 tau + O2 tau^2 / 2 + ...

    Args:
        prior: Weights, and Omega by the gyro.
        unit: (6 k,) units of t, as of `row_units`.
        half: Half the length of the window, s.

    Returns:
        K (6 k, 6 k), b (6 k,) and c.
    """
    n = len(unit)
    k = n // 6
    times = segment_times(half)
    powers = np.stack([times**m / math.factorial(m) for m in range(k)], 1)
    weight, gyro = float(prior.gyro_weight) / N_WINDOW_SEGMENTS, np.asarray(prior.gyro, np.float64)
    of_O = weight * powers.T @ powers
    K, b = np.zeros((n, n)), np.zeros(n)
    K[: 3 * k, : 3 * k] = np.kron(of_O, np.eye(3))
    b[: 3 * k] = weight * (powers.T @ gyro).ravel()
    K, b = K * unit * unit[:, None], b * unit
    K += np.diag(np.where(is_twist_change(k), float(prior.change), 0.0))
    return K, b, weight / 2 * float((gyro**2).sum())


def gauge_direction(path: Path, unit: NDArray, size: int) -> NDArray[np.float64]:
    """Return the direction in the unknowns that changes |C1|, which is fixed to 1.

    Args:
        path: The path.
        unit: (6 k,) units of its first rows, see `row_units`.
        size: Number of unknowns; the rows are the first.

    Returns:
        (size,) vector.
    """
    k, found = len(unit) // 6, np.zeros(size)
    found[3 * k : 3 * k + 3] = np.asarray(path.D[0]) * unit[3 * k : 3 * k + 3]
    return found


def coefficient_jacobian(
    path: Path, unit: NDArray, half: float, k: int = N_COEFFICIENT_ROWS
) -> NDArray[np.float64]:
    """Return the derivatives of the polynomials' coefficients by the path's first k rows.

    Args:
        path: Path at which they are taken.
        unit: (6 k,) units of the rows.
        half: Half the length of the window, s; powers of tau / half have the coefficients.
        k: Number of rows of O and of D.

    Returns:
        (6 rows, 6 k): coefficients of phi and C, those of one component one after another.
    """
    O, D = path.O, path.D  # noqa: E741
    by = np.zeros((6, N_COEFFICIENT_ROWS, 2, N_COEFFICIENT_ROWS, 3))
    constant, derivative = D[0], np.zeros((3, 2, N_COEFFICIENT_ROWS, 3))
    derivative[:, 1, 0] = np.eye(3)
    turn = cross_matrix(O[0])
    for m in range(N_COEFFICIENT_ROWS):
        by[range(3), m, 0, m, range(3)] = 1
        by[3:, m] = derivative
        if m:
            by[range(3, 6), m, 1, m, range(3)] += 1
        # constant = O0 x constant
        derivative = np.einsum("ij,jrka->irka", turn, derivative)
        derivative[:, 0, 0] -= cross_matrix(constant)
        constant = turn @ constant
    powers = np.array([half**m / math.factorial(m) for m in range(1, N_COEFFICIENT_ROWS + 1)])
    by = by[:, :, :, :k] * powers[:, None, None, None]
    return by.reshape(6 * N_COEFFICIENT_ROWS, 6 * k) * unit


def step_fraction(rows: NDArray) -> float:
    """Return the fraction of a step of the path's rows (px at the window's end) to take."""
    return min(1.0, MAX_PATH_STEP_PX / max(float(np.abs(rows).max()), 1e-9))


def smoothness_weights(
    log_rho: NDArray, weight: float, edge: float
) -> tuple[NDArray, NDArray, float]:
    """Weight the squared differences of log depth between neighbours, robustly.

    A difference well beyond `edge` is an edge of depth, and hardly counts.

    Args:
        log_rho: (rows, columns) log inverse depths.
        weight: Weight of a small squared difference.
        edge: Difference of log depth.

    Returns:
        Weights of differences to the column before and to the row before, each (rows, columns),
        and the cost of all differences.
    """
    found, cost = [], 0.0
    for axis in (1, 0):
        apart = np.diff(log_rho, axis=axis, prepend=np.take(log_rho, [0], axis))
        u = (apart / edge) ** 2
        cost += weight * edge**2 / 2 * float(np.log1p(u).sum())
        found.append(weight / (1 + u))
    found[0][:, 0], found[1][0] = 0, 0
    return found[0], found[1], cost
