"""General motion by fitting a whole window of events: the camera's path and the scene's depth.

In a window around t_r, with tau = t - t_r, the pose of camera(t) in camera(t_r) is

    phi(tau) = O0 tau + O1 tau^2 / 2 + ... + O4 tau^5 / 120,  R = exp[phi]x
    C(tau) = C1 tau + C2 tau^2 / 2 + ... + C5 tau^5 / 120,  |C1| = 1

(a constant twist has C2 = O0 x C1, so the unknowns are D2 = C2 - O0 x C1 and so on), and a point of
inverse depth rho in the reference view is moved there by the exact warp

    r = pi(R x),  x_ref = r + rho (f C_xy - C_z r),

which is linear in rho. The fit is photometric (cf. Guo & Gallego, "Event-based photometric bundle
adjustment", there for rotation). Log intensity at a pixel u at its event e is known from its
polarities but for the pixel's beginning b_u, and is that of the scene where the warp takes u: with
L the map of log intensity in the reference view in units of the contrast threshold,

    L(x_ref(u, t_e)) = b_u + s_e,   s_e = sum of the polarities of u's events up to and with e,

is linear in L and b_u. Minimised over L, b_u, path and depths is the sum of the squared
differences, robustly (Geman & McClure, 3 sigma), with weak priors on differences of L and of log
depth between neighbours and on changes of the twist. L is a quadratic B-spline of 1 px: with
bilinear interpolation the cost at the true motion is twice as high and more. b_u is
eliminated exactly (differences less their mean over the pixel's events), all else is one linear
system a step, solved by conjugate gradients, without the matrix: the map's diagonal, and path with
lumped depths exactly, precondition it. Steps extrapolate (Nesterov): reweighting alone is slow.
Nothing is gained by squeezing events together, which biases contrast, and no event is compared that
tells only the gradient along the flow.

Depth is interpolated between nodes 4 px apart, and an event lies on the nearest surface that its
ray meets: what is behind is hidden. Before the fit, and twice between its first steps, every node
takes the depth at which the events around it have the highest contrast, the path held fixed: beside
an edge of depth that is the nearer surface's, whose outline made the events. Adjusted from smooth
depths instead, the path ends some 5 degrees beside the truth.

Where events are noisy, sigma is not made much smaller than their misfit. An ON threshold
C (1 + skew) and an OFF one of C (1 - skew) are allowed for.

Before it, segments of the window are aligned: I_s is the signed image of the warped events of one,

    min sum_s |I_s - k_s T_s|^2,  T_s = sum of the other segments' images,

by Gauss-Newton on displacements of every cell in every segment with their information (Lucas &
Kanade's equations, k_s per cell and segment), the assignment to cells held fixed. It comes within
some ten degrees from most starts; its own optimum is some degrees off.

Starts, coarse to fine: the best pure rotation; flows of patches of the derotated events with their
uncertainty; a robust fit of the rest of the rotation for every heading of a hemisphere, both signs
of T told apart by depths > 0. Each start is followed with a constant twist, then over longer
windows. The mean over blocks of n (log S - 1.5 log n) / N, S the contrast and n the number of
events of a block, selects those that go on; of these the photometric cost selects, again and again
as the fit proceeds. Before a plane two motions explain the events to some hundredths of C: of both
the fit is tried.
"""

import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.optimize
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray
from tqdm import tqdm

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.geometry import A, B
from jaxevent.egomotion.motion import Motion
from jaxevent.egomotion.truth import Twists
from jaxevent.egomotion.warped import blur, splat
from jaxevent.errors import InputError
from jaxevent.parameters import Count, Number, Parameters, Positive, nearest
from jaxevent.recording import Recording

MODELS = ("general",)
SEGMENTS = 8
MARGIN = 24  # px of the reference view around the sensor
BORDER = 3  # px at the sensor's border that are not compared
DIRECTIONS = 600  # headings of a hemisphere that are tried
HOP, PATCH = 16, 24  # px between patches whose flow is measured, and their size
BLOCK = 12  # px, of the score
APART = np.cos(np.radians(6))  # headings of rivals
TURN = 0.1  # rad/s, likewise
COARSE = 15000  # events of short windows
MIDDLE = 30000
LAST = 60000
TRIED = 30000  # of the photometric fit of rivals
ROWS = 5  # of a path: T and Omega are polynomials of the fourth degree
NODE = 4  # px between nodes of depth
BEND = 0.1  # a larger difference of log depth between nodes is an edge
LEVELS = 40  # log depths that are tried
SPOT = 12  # px, of which each has its own
SIDE = 4  # nodes about an event among whose depths its own is
LOOKS = 16  # depths on its ray that are looked at
PLANE = 0.1  # half the inverse depths of a plane are nearer to it than this share of themselves
FOLD = 0.3  # the least slope, along the ray of an event, of log depth less that of the scene
SOLVE = 40  # steps of conjugate gradients
# Sigma (C), steps and how much flatter the map is, after each trial of depths, at the end, and
# again if rivals remain that have nearly the least cost: so many times it and so much more (C^2);
# depths that are just looked for leave up to 0.03 C. A flatter map leaves less freedom, so the fit
# converges sooner.
ROUNDS = ((0.3, 6, 1), (0.2, 6, 1), (0.1, 8, 1))
FINAL = ((0.05, 20, 10), (0.02, 10, 3))
MORE = ((0.02, 10, 3),)
CLOSE = (3.0, 1e-3), (1.25, 1e-5)
SHARP = 0.4  # sigma by the noise that is seen, at least: events beside edges are outliers


class Params(Parameters):
    """Parameters of the fit of a window, and of the sequence of windows."""

    half_window = Positive(0.15, "s", "half the length of the last window; earlier: 1/3, 2/3")
    step = Positive(0.1, "s", "from one window to the next")
    events = Count(60000, "", "most events of a window, of pixels taken at random")
    fewest = Count(2000, "", "events that a window needs")
    fresh = Count(5, "", "every so many windows new starts compete with the window before")
    starts = Count(3, "", "headings that are followed, of each of two short windows")
    cell = Count(24, "px", "of one depth")
    iterations = Count(8, "", "steps of the alignment of segments on the whole window")
    rivals = Count(3, "", "aligned starts, some degrees apart, that go on to the photometric fit")

    smooth = Positive(1.0, "", "weight of differences of log depth between cells")
    relief = Positive(0.1, "", "weight of differences of log depth from its mean")
    change = Positive(0.02, "1/px^2", "weight of changes of the twist, in px at the window's end")
    bond = Positive(1.0, "", "weight of differences of log depth between nodes")
    flat = Positive(0.01, "1/C^2", "weight of differences of log intensity between pixels")
    alike = Positive(10.0, "", "how many events together tell as much as one: errors are alike")
    omega_scale = Number(0.0, "rad/s", "prior: |Omega| is about so much or less; 0: not known")
    gyro_std = Positive(0.03, "rad/s", "of a gyro, if one is given")
    flow_max = Positive(220.0, "px/s", "flows of patches that are tried, without the rotation")


class Window(eqx.Module):
    """Events of a window, filled up with events of no weight."""

    x: Float[Array, " E"]  # px, undistorted, from the principal point
    y: Float[Array, " E"]
    tau: Float[Array, " E"]  # s from the reference time
    p: Float[Array, " E"]  # polarity +-1, 0 where there is no event
    f: Float[Array, ""]  # px
    half: Float[Array, ""]  # s
    box: Float[Array, "4"]  # px, where the sensor is: x0, x1, y0, y1
    shape: tuple[int, int] = eqx.field(static=True)  # of the reference view
    corner: tuple[float, float] = eqx.field(static=True)  # px, where its pixel [0, 0] lies
    cell: int = eqx.field(static=True)

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return self.shape[0] // self.cell, self.shape[1] // self.cell


class Path(eqx.Module):
    """The unknowns: rows O0, O1, ... (rad/s^k), and C1, D2, D3, ... in units of |T|; log depths."""

    O: Float[Array, "rows 3"]  # noqa: E741
    D: Float[Array, "rows 3"]
    log_rho: Float[Array, " depths"]  # 1/m in units of 1/|T|, of cells or at nodes

    def coefficients(self) -> tuple[Array, Array]:
        """O and C."""
        C, constant = [self.D[0]], self.D[0]
        for D in self.D[1:]:
            constant = jnp.cross(self.O[0], constant)
            C.append(D + constant)
        return self.O, jnp.stack(C)

    def twist(self, tau: float | int | NDArray) -> tuple[NDArray, NDArray]:
        """Unit heading R' C' and Omega to second order, (times, 3) each, at times tau (s)."""
        from scipy.spatial.transform import Rotation

        O, C = (np.asarray(part, np.float64) for part in self.coefficients())  # noqa: E741
        tau = np.atleast_1d(np.asarray(tau, np.float64))
        slopes = np.stack([tau**k / math.factorial(k) for k in range(len(O))], 1)
        powers = np.stack([tau**k / math.factorial(k) for k in range(1, len(O) + 1)], 1)
        T = Rotation.from_rotvec(powers @ O).apply(slopes @ C, inverse=True)
        return T / np.linalg.norm(T, axis=1, keepdims=True), slopes @ O


def _along(coefficients: Array, tau: Array) -> list[Array]:
    """sum_k c_k tau^k / k!, k from 1: three components."""
    sums = [jnp.zeros_like(tau)] * 3
    for k in range(len(coefficients), 0, -1):
        sums = [(sums[i] + coefficients[k - 1, i]) * tau / k for i in range(3)]
    return sums


def _rotated(phi: list[Array], x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """exp[phi]x of points, to the sixth order of |phi|, which is below 1."""
    a, b, c = phi
    s = a * a + b * b + c * c
    one, two = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    dx, dy, dz = b * cz - c * cy, c * cx - a * cz, a * cy - b * cx
    return x + one * cx + two * dx, y + one * cy + two * dy, z + one * cz + two * dz


def warp(path: Path, f: Array, x: Array, y: Array, tau: Array, rho: Array) -> tuple[Array, Array]:
    """Where points at x, y (px) at times tau (s), of inverse depths rho, are at the reference."""
    O, C = path.coefficients()  # noqa: E741
    rx, ry, rz = _rotated(_along(O, tau), x, y, f)
    cx, cy, cz = _along(C, tau)
    z = jnp.maximum(rz / f, 0.05)
    rx, ry = rx / z, ry / z
    return rx + rho * (f * cx - cz * rx), ry + rho * (f * cy - cz * ry)


def assigned(path: Path, window: Window) -> Int[Array, " E"]:
    """The cell of every event, by its warped position."""

    def cell(x: Array, y: Array) -> Array:
        rows, columns = window.cells
        i = jnp.floor((x - window.corner[0] + 0.5) / window.cell)
        j = jnp.floor((y - window.corner[1] + 0.5) / window.cell)
        i, j = jnp.clip(i, 0, columns - 1), jnp.clip(j, 0, rows - 1)
        return (j * columns + i).astype(jnp.int32)

    found = cell(window.x, window.y)
    for _ in range(2):
        rho = jnp.exp(path.log_rho)[found]
        found = cell(*warp(path, window.f, window.x, window.y, window.tau, rho))
    return lax.stop_gradient(found)


def segments(path: Path, window: Window, cell: Int[Array, " E"]) -> Float[Array, "S h w"]:
    """The signed images of the segments' warped events."""
    rho = jnp.exp(path.log_rho)[cell]
    X, Y = warp(path, window.f, window.x, window.y, window.tau, rho)
    height, width = window.shape
    tall = height + 2  # of one image in a stack of them, apart by 2 lines
    share = (window.tau + window.half) / (2 * window.half)
    which = jnp.clip(jnp.floor(share * SEGMENTS), 0, SEGMENTS - 1)
    i, j = X - window.corner[0], Y - window.corner[1]
    inside = (i >= 0) & (i <= width - 1) & (j >= 0) & (j <= height - 1)
    at = jnp.stack([jnp.where(inside, i, 0), jnp.where(inside, j, 0) + which * tall], 1)
    stack = splat(at, jnp.where(inside, window.p, 0), (SEGMENTS * tall, width))
    return stack.reshape(SEGMENTS, tall, width)[:, :height]


def _sums(image: Array, window: Window) -> Array:
    """Sums over cells (..., cells)."""
    (rows, columns), n = window.cells, window.cell
    parts = image.reshape(*image.shape[:-2], rows, n, columns, n).sum((-3, -1))
    return parts.reshape(*image.shape[:-2], rows * columns)


def _spread(values: Array, window: Window) -> Array:
    """Values of cells (..., cells) at all pixels."""
    rows, columns = window.cells
    values = values.reshape(*values.shape[:-1], rows, columns)
    return jnp.repeat(jnp.repeat(values, window.cell, -2), window.cell, -1)


def _pairs(rows: int, columns: int) -> Array:
    """Neighbours on a lattice that is counted row by row, (2, pairs)."""
    number = jnp.arange(rows * columns).reshape(rows, columns)
    across = jnp.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    return jnp.concatenate([across, jnp.stack([number[:-1].ravel(), number[1:].ravel()])], 1)


class Prior(NamedTuple):
    """What is known beside the events: weights, and Omega (S, 3) rad/s at the segments' times."""

    smooth: Array
    relief: Array
    change: Array
    omega: Array  # 1 / (rad/s)^2
    gyro: Array
    gyro_weight: Array  # 1 / (rad/s)^2, 0: none
    bond: Array  # of the photometric fit, as smooth
    flat: Array
    alike: Array


@jax.jit
def refine(
    window: Window,
    path: Path,
    prior: Prior,
    degree: int | Array,
    blurs: int | Array,
    steps: int | Array,
) -> tuple[Path, Array]:
    """So many Gauss-Newton steps from a path; of O and D the rows up to `degree` (<= 2) move.

    Images are blurred `blurs` times by [1 2 1] / 4. The second result is how well segments agreed
    before the last step: 1 where all show the same.
    """
    k, f, h = 3, window.f, window.half
    rows, columns = window.cells
    cells, free = rows * columns, 6 * k
    still = jnp.repeat(jnp.tile(jnp.arange(k) > degree, 2), 3)
    still = jnp.append(still, jnp.zeros(cells, bool))
    j, i = jnp.divmod(jnp.arange(cells), columns)
    middle = (window.cell - 1) / 2
    X0 = jnp.broadcast_to(window.corner[0] + i * window.cell + middle, (SEGMENTS, cells))
    Y0 = jnp.broadcast_to(window.corner[1] + j * window.cell + middle, (SEGMENTS, cells))
    times = ((jnp.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * h
    tau = jnp.broadcast_to(times[:, None], (SEGMENTS, cells))
    X0, Y0, tau = (part.astype(window.x.dtype) for part in (X0, Y0, tau))
    px = window.corner[0] + jnp.arange(window.shape[1])
    py = window.corner[1] + jnp.arange(window.shape[0])
    pairs = _pairs(rows, columns)

    def rows_of(path: Path) -> Array:
        return jnp.concatenate([path.O[:k], path.D[:k]]).ravel()

    def with_rows(path: Path, values: Array) -> Path:
        values = values.reshape(2 * k, 3)
        return Path(path.O.at[:k].set(values[:k]), path.D.at[:k].set(values[k:]), path.log_rho)

    def one(_: Any, state: tuple[Path, Array]) -> tuple[Path, Array]:
        path, _ = state
        rho = jnp.broadcast_to(jnp.exp(path.log_rho), (SEGMENTS, cells))
        images = segments(path, window, assigned(path, window))
        images = lax.fori_loop(0, blurs, lambda _, image: blur(image, 1), images)

        # Where the cells' centres were at the segments' times, and so what the sensor saw of them.
        x, y = X0, Y0
        for _ in range(4):
            X, Y = warp(path, f, x, y, tau, rho)
            x, y = x - (X - X0), y - (Y - Y0)
        at_x = _spread(x - X0, window) + px[None, None, :]
        at_y = _spread(y - Y0, window) + py[None, :, None]
        seen = (at_x > window.box[0] + BORDER) & (at_x < window.box[1] - BORDER)
        seen &= (at_y > window.box[2] + BORDER) & (at_y < window.box[3] - BORDER)
        seen = seen.astype(images.dtype)
        share = _sums(seen, window) / window.cell**2
        images = images * seen
        count = seen.sum(0)
        others = (images.sum(0) - images) * seen
        others = others * jnp.where(count > 2, SEGMENTS / jnp.maximum(count, 1), 0)

        wide = jnp.pad(others, ((0, 0), (1, 1), (1, 1)))
        gx = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
        gy = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
        both = _sums(images * others, window)
        gain = both / jnp.maximum(_sums(others**2, window), 1e-6)
        left = _spread(gain, window) * others - images
        # Noise (per px) of a cell; blurring correlates it.
        noise = _sums(left**2, window).sum(0) / jnp.maximum(share.sum(0), 1) / window.cell**2
        weight = jnp.where((gain > 0) & (share > 0), 1 / (noise + 1e-3), 0) / (1 + 1.5 * blurs)
        xx, xy, yy = (weight * gain**2 * _sums(p, window) for p in (gx * gx, gx * gy, gy * gy))
        vx, vy = (weight * gain * _sums(g * left, window) for g in (gx, gy))
        # A cell that seems displaced by more than about a pixel is not what it is taken for.
        small = 1e-2
        det = (xx + small) * (yy + small) - xy**2
        dx, dy = ((yy + small) * vx - xy * vy) / det, ((xx + small) * vy - xy * vx) / det
        robust = 1 / (1 + (dx**2 + dy**2) / (1 + 0.5 * blurs) ** 2) ** 2
        xx, xy, yy, vx, vy = (robust * part for part in (xx, xy, yy, vx, vy))

        now = rows_of(path)
        J = jax.jacfwd(lambda values: jnp.stack(warp(with_rows(path, values), f, x, y, tau, rho)))(
            now
        )
        O, C = path.coefficients()  # noqa: E741
        rx, ry, rz = _rotated(_along(O, tau), x, y, f)
        cx, cy, cz = _along(C, tau)
        r = rho * jnp.stack([f * cx - cz * rx * f / rz, f * cy - cz * ry * f / rz])
        # All in px at the window's end.
        unit = jnp.stack([1 / (f * h), 2 / (f * h**2), 6 / (f * h**3)])[:k]
        unit = jnp.repeat(jnp.concatenate([unit, unit / jnp.exp(jnp.median(path.log_rho))]), 3)
        J, now = J * unit, now / unit
        MJ = jnp.stack([xx[..., None] * J[0] + xy[..., None] * J[1],
                        xy[..., None] * J[0] + yy[..., None] * J[1]])  # fmt: skip
        upper = jnp.einsum("isnp,isnq->pq", J, MJ)
        mixed = jnp.einsum("isnp,isn->pn", MJ, r)
        lower = (xx * r[0] ** 2 + 2 * xy * r[0] * r[1] + yy * r[1] ** 2).sum(0)
        H = jnp.block([[upper, mixed], [mixed.T, jnp.diag(lower)]])
        g = jnp.concatenate(
            [jnp.einsum("isnp,isn->p", J, jnp.stack([vx, vy])), (r[0] * vx + r[1] * vy).sum(0)]
        )

        a, b = free + pairs[0], free + pairs[1]
        apart = path.log_rho[pairs[0]] - path.log_rho[pairs[1]]
        bond = prior.smooth / (1 + (apart / 0.3) ** 2)
        H = H.at[a, a].add(bond).at[b, b].add(bond).at[a, b].add(-bond).at[b, a].add(-bond)
        g = g.at[a].add(bond * apart).at[b].add(-bond * apart)
        rest = jnp.zeros(free + cells, H.dtype).at[free:].set(prior.relief)
        centre = jnp.concatenate([now, path.log_rho - path.log_rho.mean()])
        later = jnp.repeat(jnp.tile(jnp.arange(k) > 0, 2), 3)
        rest = rest.at[:free].set(prior.change * later)
        rest = rest.at[:3].add(prior.omega * unit[0] ** 2)
        H, g = H + jnp.diag(rest), g + rest * centre
        # Omega(tau) = O0 + O1 tau + O2 tau^2 / 2 against the gyro.
        powers = jnp.stack([jnp.ones(SEGMENTS, H.dtype), times, times**2 / 2], 1)[:, :k]
        G = (powers[:, None, :, None] * jnp.eye(3, dtype=H.dtype)[None, :, None, :]).reshape(
            3 * SEGMENTS, 3 * k
        ) * unit[: 3 * k]
        off = (powers @ path.O[:k] - prior.gyro).ravel()
        H = H.at[: 3 * k, : 3 * k].add(prior.gyro_weight / SEGMENTS * G.T @ G)
        g = g.at[: 3 * k].add(prior.gyro_weight / SEGMENTS * G.T @ off)
        # |C1| = 1
        gauge = (
            jnp.zeros(free + cells, H.dtype)
            .at[3 * k : 3 * k + 3]
            .set(path.D[0] * unit[3 * k : 3 * k + 3])
        )
        H = H + 100 * jnp.trace(upper) / free * gauge[:, None] * gauge
        H = H + jnp.diag(1e-3 * jnp.diag(H) + 1e-6)
        H = jnp.where(still[:, None] | still, 0, H) + jnp.diag(still.astype(H.dtype))
        g = jnp.where(still, 0, g)

        change = -jnp.linalg.solve(H, g)
        change = jnp.where(jnp.isfinite(change).all(), change, 0)
        largest = jnp.abs(change[:free]).max()
        change = change * jnp.minimum(1, 4 / jnp.maximum(largest, 1e-9))
        path = with_rows(path, (now + change[:free]) * unit)
        path = Path(path.O, path.D, path.log_rho + jnp.clip(change[free:], -0.5, 0.5))
        path = normalised(path)
        own = jnp.maximum((_sums(images**2, window) * share).sum(), 1e-6)
        return path, (gain * both * share).sum() / own

    return lax.fori_loop(0, steps, one, (path, jnp.zeros((), window.x.dtype)))


def normalised(path: Path) -> Path:
    """The same path with |C1| = 1, which depths make good."""
    size = jnp.sqrt((path.D[0] ** 2).sum())
    return Path(path.O, path.D / size, path.log_rho + jnp.log(size))


@jax.jit
def score(window: Window, path: Path) -> Float[Array, ""]:
    """What selects among paths: the mean over blocks of n (log S - 1.5 log n) / N."""
    rho = jnp.exp(path.log_rho)[assigned(path, window)]
    X, Y = warp(path, window.f, window.x, window.y, window.tau, rho)
    both = splat(
        jnp.stack([X, Y], 1), jnp.stack([window.p, jnp.abs(window.p)]), window.shape, window.corner
    )
    parts = jnp.stack([blur(both[0], 1) ** 2, both[1]])
    height, width = (n // BLOCK * BLOCK for n in window.shape)
    parts = parts[:, :height, :width].reshape(2, height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    S, n = parts.sum((2, 4))
    told = jnp.log(jnp.where(n > 5, S, 1) + 1e-6) - 1.5 * jnp.log(jnp.where(n > 5, n, 1))
    return jnp.where(n > 5, n * told, 0).sum() / jnp.maximum(jnp.abs(window.p).sum(), 1)


# The photometric fit


class Tracks(eqx.Module):
    """Events of a window, pixel by pixel, filled up with events of no weight."""

    x: Float[Array, " E"]  # px, undistorted, from the principal point
    y: Float[Array, " E"]
    tau: Float[Array, " E"]  # s from the reference time
    level: Float[Array, " E"]  # sum of the pixel's polarities up to and with this event's
    number: Float[Array, " E"]  # how many these are
    p: Float[Array, " E"]  # polarity +-1, 0 where there is no event
    pixel: Int[Array, " E"]
    f: Float[Array, ""]  # px
    half: Float[Array, ""]  # s
    shape: tuple[int, int] = eqx.field(static=True)  # of the map
    corner: tuple[float, float] = eqx.field(static=True)  # px, where its pixel [0, 0] lies
    pixels: int = eqx.field(static=True)
    node: int = eqx.field(static=True)  # px between nodes of depth

    @property
    def on(self) -> Float[Array, " E"]:
        """1; 0 where there is no event."""
        return jnp.abs(self.p)

    @property
    def nodes(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        return tuple((n - 2) // self.node + 2 for n in self.shape)  # pyright: ignore

    @property
    def places(self) -> tuple[NDArray, NDArray]:
        """Where nodes lie in the reference view: x and y (px), row by row."""
        rows, columns = self.nodes
        j, i = np.divmod(np.arange(rows * columns), columns)
        return self.corner[0] + i * self.node, self.corner[1] + j * self.node


class Scene(NamedTuple):
    """The unknowns: path with log depths at nodes, map of log intensity, difference of thresholds.

    The map is in units of the mean threshold C; C (1 + skew) is that of ON, C (1 - skew) of OFF.
    """

    path: Path
    map: Array  # (height, width)
    skew: Array


class Report(NamedTuple):
    """Of a step: the rms of inliers (C), the robust cost per event (C^2), the share of inliers."""

    rms: Array
    cost: Array
    inliers: Array
    step: Array  # px at the window's end
    covariance: Array  # (6, 6) of C1 and O0, 0 unless it was asked for


class _Near(NamedTuple):
    """The n * n neighbours of points on a lattice (n * n, E): shares, and slopes of the shares."""

    first: Array  # index of the one of the lowest row and column
    share: Array
    along_x: Array
    along_y: Array
    inside: Array


def _corners(X: Array, Y: Array, corner: tuple, size: float | int, shape: tuple) -> _Near:
    """Bilinear interpolation between lattice points `size` px apart."""
    i, j = (X - corner[0]) / size, (Y - corner[1]) / size
    inside = (i >= 0) & (i < shape[1] - 1) & (j >= 0) & (j < shape[0] - 1)
    i, j = jnp.clip(i, 0, shape[1] - 1.001), jnp.clip(j, 0, shape[0] - 1.001)
    low, top = jnp.floor(i), jnp.floor(j)
    u, v = i - low, j - top
    return _Near(
        (top * shape[1] + low).astype(jnp.int32),
        jnp.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]),
        jnp.stack([v - 1, 1 - v, -v, v]) / size,
        jnp.stack([u - 1, -u, 1 - u, u]) / size,
        inside,
    )


def _spline(X: Array, Y: Array, corner: tuple, shape: tuple) -> _Near:
    """Quadratic B-splines a pixel apart."""
    i, j = X - corner[0], Y - corner[1]
    inside = (i >= 1) & (i < shape[1] - 2) & (j >= 1) & (j < shape[0] - 2)
    i, j = jnp.clip(i, 1, shape[1] - 2), jnp.clip(j, 1, shape[0] - 2)
    low, top = jnp.round(i), jnp.round(j)

    def shares(t: Array) -> tuple[list[Array], list[Array]]:
        return (
            [(0.5 - t) ** 2 / 2, 0.75 - t**2, (0.5 + t) ** 2 / 2],
            [t - 0.5, -2 * t, t + 0.5],
        )

    def product(rows: list[Array], columns: list[Array]) -> Array:
        return jnp.stack([row * column for row in rows for column in columns])

    (across, slope_x), (down, slope_y) = shares(i - low), shares(j - top)
    first = ((top - 1) * shape[1] + low - 1).astype(jnp.int32)
    return _Near(
        first, product(down, across), product(down, slope_x), product(slope_y, across), inside
    )


def _steps(near: _Near, shape: tuple) -> list[int]:
    """From the first of the neighbours to each of them."""
    n = math.isqrt(len(near.share))
    return [a * shape[1] + b for a in range(n) for b in range(n)]


def _gathered(values: Array, near: _Near, shape: tuple) -> list[Array]:
    """The neighbours' values, of values (height * width)."""
    values = values.ravel()
    return [
        values.at[near.first + step].get(mode="promise_in_bounds") for step in _steps(near, shape)
    ]


def _mean(values: list[Array], share: Array) -> Array:
    return sum((value * part for value, part in zip(values, share, strict=True)), jnp.zeros(()))


def _scattered(values: Array, near: _Near, share: Array, shape: tuple) -> Array:
    """The transpose of gathering with shares: (E, ...) to (height * width, ...)."""
    found = jnp.zeros((shape[0] * shape[1], *values.shape[1:]), values.dtype)
    for step, part in zip(_steps(near, shape), share, strict=True):
        found = found.at[near.first + step].add(values * part, mode="promise_in_bounds")
    return found


def _laplacian(values: Array) -> Array:
    """Minus the sum of differences to the neighbours, of a map."""
    down, right = values[1:] - values[:-1], values[:, 1:] - values[:, :-1]
    out = jnp.zeros_like(values).at[1:].add(down).at[:-1].add(-down)
    return out.at[:, 1:].add(right).at[:, :-1].add(-right)


def _rays(path: Path, tracks: Tracks) -> tuple[Array, Array, Array, Array]:
    """The rays of events in the reference view, x = r + rho d: r and d."""
    none = jnp.zeros_like(tracks.x)
    rx, ry = warp(path, tracks.f, tracks.x, tracks.y, tracks.tau, none)
    dx, dy = warp(path, tracks.f, tracks.x, tracks.y, tracks.tau, none + 1)
    return rx, ry, dx - rx, dy - ry


def placed(path: Path, tracks: Tracks) -> tuple[Array, Array]:
    """Where events are in the reference view: on the nearest surface that their rays meet.

    On the ray of an event x = r + rho d, which the depths of the scene, rho'(x), meet where
    log rho = log rho'(r + rho d): once if they are smooth, more often beside an edge, where the
    surface of the largest rho hides the others. Differentiable in the path (implicitly).
    """
    rx, ry, dx, dy = _rays(path, tracks)

    def off(log_rho: Array) -> Array:
        rho = jnp.exp(log_rho)
        at = _corners(rx + rho * dx, ry + rho * dy, tracks.corner, tracks.node, tracks.nodes)
        return log_rho - _mean(_gathered(path.log_rho, at, tracks.nodes), at.share)

    def newton(log_rho: Array) -> Array:
        value, slope = jax.jvp(off, (log_rho,), (jnp.ones_like(log_rho),))
        return log_rho - value / jnp.maximum(lax.stop_gradient(slope), FOLD)

    # From near to far, the first of some depths that is not nearer than the scene's.
    scene = path.log_rho.reshape(tracks.nodes)
    reach = (2 * SIDE + 1, 2 * SIDE + 1)
    high = lax.reduce_window(scene, -jnp.inf, lax.max, reach, (1, 1), "SAME").ravel()
    low = lax.reduce_window(scene, jnp.inf, lax.min, reach, (1, 1), "SAME").ravel()
    first = _corners(tracks.x, tracks.y, tracks.corner, tracks.node, tracks.nodes).first
    high, low = high[first] + 0.02, low[first] - 0.02

    def look(k: Any, state: tuple) -> tuple:
        done, root, before, value = state
        log_rho = high + (low - high) * k / LOOKS
        new = off(log_rho)
        share = value / jnp.maximum(value - new, 1e-6)
        root = jnp.where(~done & (new <= 0), before + share * (log_rho - before), root)
        return done | (new <= 0), root, log_rho, new

    value = off(high)
    state = value <= 0, jnp.where(value <= 0, high, low), high, value
    root = newton(lax.fori_loop(1, LOOKS + 1, look, state)[1])
    rho = jnp.exp(newton(lax.stop_gradient(root)))
    return rx + rho * dx, ry + rho * dy


def misfits(scene: Scene, tracks: Tracks) -> Float[Array, " E"]:
    """L(x_e) - s_e less its mean over the pixel's events, in units of C.

    Pure and differentiable in the scene. 0 where there is no event or it leaves the map.
    """
    at = _spline(*placed(scene.path, tracks), tracks.corner, tracks.shape)
    value = _mean(_gathered(scene.map, at, tracks.shape), at.share)
    on = tracks.on * at.inside
    left = value - tracks.level - scene.skew * tracks.number
    return on * _less_mean(left, on, tracks)


def _less_mean(values: Array, weight: Array, tracks: Tracks) -> Array:
    both = jnp.zeros((tracks.pixels, 2), values.dtype)
    both = both.at[tracks.pixel].add(jnp.stack([weight * values, weight], 1))
    return values - (both[:, 0] / jnp.maximum(both[:, 1], 1e-3))[tracks.pixel]


@jax.jit
def adjust(
    tracks: Tracks,
    scene: Scene,
    prior: Prior,
    sigma: Array | float | int,
    settle: Array | int,
    steps: Array | int,
    tell: Array | bool = False,
) -> tuple[Scene, Report]:
    """So many steps of the photometric fit.

    `sigma` (C) scales what counts as an outlier. The first `settle` steps move the map alone. The
    report is of the last step, the covariance is computed if `tell`.
    """
    k, f, h = ROWS, tracks.f, tracks.half
    real, free = tracks.x.dtype, 6 * k + 1
    a, b = _pairs(*tracks.nodes)
    sigma = jnp.asarray(sigma, real)
    powers = jnp.stack([math.factorial(m) / (f * h**m) for m in range(1, k + 1)])
    times = ((jnp.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * h
    slopes = jnp.stack([times**m / math.factorial(m) for m in range(k)], 1).astype(real)

    def with_rows(path: Path, values: Array) -> Path:
        values = values.reshape(2 * k, 3)
        return Path(values[:k], values[k:], path.log_rho)

    def one(n: Any, state: tuple) -> tuple:
        scene, last, weight, _ = state
        # Nesterov's extrapolation: reweighting alone closes a tenth of what is left in a step.
        ahead = jnp.where(n > settle, (n - settle) / (n - settle + 2), 0).astype(real)
        last, scene = scene, jax.tree.map(lambda new, old: new + ahead * (new - old), scene, last)
        path = normalised(scene.path)

        X, Y = placed(path, tracks)
        at = _spline(X, Y, tracks.corner, tracks.shape)
        node = _corners(X, Y, tracks.corner, tracks.node, tracks.nodes)
        four = _gathered(path.log_rho, node, tracks.nodes)
        rho = jnp.exp(_mean(four, node.share))
        lx, ly = _mean(four, node.along_x), _mean(four, node.along_y)
        nine = _gathered(scene.map, at, tracks.shape)
        gx, gy = _mean(nine, at.along_x), _mean(nine, at.along_y)
        on = tracks.on * at.inside
        e = _mean(nine, at.share) - tracks.level - scene.skew * tracks.number
        limit = (3 * sigma) ** 2
        for _ in range(2):
            left = _less_mean(e, weight, tracks)
            weight = on / (1 + left**2 / limit) ** 2
        total = jnp.zeros(tracks.pixels, real).at[tracks.pixel].add(weight)
        total = jnp.maximum(total, 1e-3)

        def less_mean(z: Array) -> Array:
            """Of one value per event (E,), or of rows of them (E, n)."""
            sums = jnp.zeros((tracks.pixels, *z.shape[1:]), real)
            sums = sums.at[tracks.pixel].add((weight * z.T).T)
            return z - (sums.T / total).T[tracks.pixel]

        left = less_mean(e)

        # x = r + rho(x) d: (1 - d grad rho') dx = what it is with rho held, d = rho (f C - C_z r).
        now = jnp.concatenate([path.O, path.D]).ravel()
        unit = jnp.concatenate([powers, powers / jnp.exp(jnp.median(path.log_rho))])
        unit = jnp.repeat(unit, 3)
        # Where events go by phi and by C, and the rest by the chain rule.
        O, C = path.coefficients()  # noqa: E741
        phi, (cx, cy, cz) = _along(O, tracks.tau), _along(C, tracks.tau)

        def turned(phi: list[Array]) -> tuple[Array, Array]:
            rx, ry, rz = _rotated(phi, tracks.x, tracks.y, f)
            return rx * f / rz, ry * f / rz

        def parallax(rx: Array, ry: Array) -> tuple[Array, Array]:
            return rho * (f * cx - cz * rx), rho * (f * cy - cz * ry)

        def moved_by(phi: list[Array]) -> tuple[Array, Array]:
            (rx, ry), (dx, dy) = turned(phi), parallax(*turned(phi))
            return rx + dx, ry + dy

        one, none = jnp.ones_like(rho), jnp.zeros_like(rho)
        by_phi = [
            jax.jvp(moved_by, (phi,), ([one if i == axis else none for i in range(3)],))[1]
            for axis in range(3)
        ]
        rx, ry = turned(phi)
        dx, dy = parallax(rx, ry)
        by_C = [(rho * f, none), (none, rho * f), (-rho * rx, -rho * ry)]
        squeezed = jnp.maximum(1 - lx * dx - ly * dy, FOLD)
        slope = (gx * dx + gy * dy) / squeezed
        hx, hy = gx + slope * lx, gy + slope * ly
        by = jnp.stack([hx * x + hy * y for x, y in by_phi + by_C])
        growth = jnp.stack([tracks.tau**m / math.factorial(m) for m in range(1, k + 1)])
        chain = jax.jacfwd(lambda v: jnp.concatenate(with_rows(path, v).coefficients()).ravel())
        by = by.reshape(2, 1, 3, -1) * growth[:, None]
        by = (chain(now) * unit).T @ by.reshape(6 * k, -1)
        Jt = jnp.concatenate([by, -tracks.number[None]])
        free_now = (on > 0) & (n >= settle)
        Jt = jnp.where(free_now, Jt, 0)
        Jd = jnp.where(free_now, hx * dx + hy * dy, 0)
        now = jnp.append(now / unit, scene.skew)

        # Priors, of the path's rows and of depths.
        later = jnp.append(jnp.repeat(jnp.tile(jnp.arange(k) > 0, 2), 3), False)
        known = jnp.diag(jnp.where(later, prior.change, 1e-3))
        pull = jnp.where(later, prior.change, 0) * now
        known = known.at[-1, -1].set(10.0)
        pull = pull.at[-1].set(10.0 * scene.skew)
        turn = jnp.zeros(free, real).at[:3].set(prior.omega * unit[:3] ** 2)
        known, pull = known + jnp.diag(turn), pull + turn * now
        G = slopes[:, None, :, None] * jnp.eye(3, dtype=real)[None, :, None, :]
        G = G.reshape(3 * SEGMENTS, 3 * k) * unit[: 3 * k]
        off = (slopes @ path.O - prior.gyro).ravel()
        known = known.at[: 3 * k, : 3 * k].add(prior.gyro_weight / SEGMENTS * G.T @ G)
        pull = pull.at[: 3 * k].add(prior.gyro_weight / SEGMENTS * G.T @ off)
        # |C1| = 1
        fixed = slice(3 * k, 3 * k + 3)
        gauge = jnp.zeros(free, real).at[fixed].set(path.D[0] * unit[fixed])
        known = known + 1e4 * gauge[:, None] * gauge
        apart = path.log_rho[a] - path.log_rho[b]
        bond = prior.bond / (1 + (apart / BEND) ** 2)

        # Information of events: neighbours see the same, which counts as one.
        w = weight / (prior.alike * sigma**2)

        def times_H(v: tuple) -> tuple:
            image, t, q = v
            y = _mean(_gathered(image, at, tracks.shape), at.share) + t @ Jt
            y = y + Jd * _mean(_gathered(q, node, tracks.nodes), node.share)
            z = w * less_mean(y)
            flat = prior.flat * _laplacian(image.reshape(tracks.shape)).ravel() + 1e-5 * image
            apart = bond * (q[a] - q[b])
            return (
                _scattered(z, at, at.share, tracks.shape) + flat,
                Jt @ z + known @ t,
                _scattered(Jd * z, node, node.share, tracks.nodes)
                + 1e-3 * q
                + jnp.zeros_like(q).at[a].add(apart).at[b].add(-apart),
            )

        z = w * left
        flat = prior.flat * _laplacian(scene.map) + 1e-5 * scene.map
        gradient = (
            _scattered(z, at, at.share, tracks.shape) + flat.ravel(),
            Jt @ z + pull,
            _scattered(Jd * z, node, node.share, tracks.nodes)
            + jnp.zeros_like(path.log_rho).at[a].add(bond * apart).at[b].add(-bond * apart),
        )

        # Preconditioner: the diagonal for the map; path with depths, these lumped, exactly.
        diagonal = _scattered(w, at, at.share**2, tracks.shape)
        diagonal = 0.7 * diagonal + 4 * prior.flat + 1e-5
        # One row per event: 7 ms for 60 k events, 15 ms one column after the other.
        centred = w[:, None] * less_mean(Jt.T)
        upper = Jt @ centred + known
        mixed = _scattered(Jd[:, None] * centred, node, node.share[..., None], tracks.nodes)
        lumped = _scattered(w * Jd**2, node, node.share, tracks.nodes) + 1e-2
        lumped = lumped.at[a].add(2 * bond).at[b].add(2 * bond)
        small = upper - mixed.T @ (mixed / lumped[:, None])
        small = (small + small.T) / 2 + 1e-3 * jnp.diag(jnp.diag(upper))
        factor = jax.scipy.linalg.cho_factor(small)

        def eased(v: tuple) -> tuple:
            q = v[2] / lumped
            t = jax.scipy.linalg.cho_solve(factor, v[1] - mixed.T @ q)
            return v[0] / diagonal, t, q - (mixed @ t) / lumped

        solve = functools.partial(_conjugate_gradients, times_H, eased)
        image, t, q = solve(jax.tree.map(jnp.negative, gradient), SOLVE)
        sound = jnp.isfinite(t).all() & jnp.isfinite(q).all() & jnp.isfinite(image).all()
        image, t, q = (jnp.where(sound, part, 0) for part in (image, t, q))
        largest = jnp.abs(t[:-1]).max()
        moved = jnp.where(n >= settle, jnp.minimum(1, 4 / jnp.maximum(largest, 1e-9)), 0)
        path = with_rows(path, (now + moved * t)[:-1] * unit)
        path = Path(path.O, path.D, path.log_rho + jnp.clip(moved * q, -0.5, 0.5))
        path = normalised(path)
        scene = Scene(path, scene.map + image.reshape(tracks.shape), scene.skew + moved * t[-1])

        def covariance(_: Any) -> Array:
            chosen = jnp.concatenate([jnp.arange(3 * k, 3 * k + 3), jnp.arange(3)])
            zero = jax.tree.map(jnp.zeros_like, gradient)

            def column(i: Array) -> Array:
                return solve((zero[0], zero[1].at[i].set(1), zero[2]), SOLVE)[1][chosen]

            inverse = lax.map(column, chosen) * unit[chosen][:, None] * unit[chosen]
            return (inverse + inverse.T) / 2

        told = Report(
            jnp.sqrt((weight * left**2).sum() / jnp.maximum(weight.sum(), 1)),
            (on * left**2 / (1 + left**2 / limit)).sum() / jnp.maximum(on.sum(), 1),
            weight.sum() / jnp.maximum(on.sum(), 1),
            largest,
            lax.cond(
                jnp.asarray(tell) & (n == steps - 1),
                covariance,
                lambda _: jnp.zeros((6, 6), real),
                None,
            ),
        )
        return scene, last, jnp.where(on > 0, weight, tracks.on), told

    zero = jnp.zeros((), real)
    nothing = Report(zero, zero, zero, zero, jnp.zeros((6, 6), real))
    state = lax.fori_loop(0, steps, one, (scene, scene, tracks.on, nothing))
    return Scene(normalised(state[0].path), *state[0][1:]), state[3]


def _conjugate_gradients(times_H: Any, eased: Any, side: tuple, steps: int) -> tuple:
    def dot(u: tuple, v: tuple) -> Array:
        return sum((jnp.vdot(p, q) for p, q in zip(u, v, strict=True)), jnp.zeros(()))

    def plus(u: tuple, scale: Array, v: tuple) -> tuple:
        return jax.tree.map(lambda p, q: p + (scale * q).astype(p.dtype), u, v)

    def one(_: Any, state: tuple) -> tuple:
        found, left, direction, size = state
        image = times_H(direction)
        length = size / jnp.maximum(dot(direction, image), 1e-30)
        found, left = plus(found, length, direction), plus(left, -length, image)
        better = eased(left)
        new = dot(left, better)
        return found, left, plus(better, new / jnp.maximum(size, 1e-30), direction), new

    better = eased(side)
    state = (jax.tree.map(jnp.zeros_like, side), side, better, dot(side, better))
    return lax.fori_loop(0, steps, one, state)[0]


@jax.jit
def _tried_depths(path: Path, tracks: Tracks, low: Array, high: Array) -> tuple:
    """Signed contrast and number of events about nodes, (LEVELS, rows, columns), by log depth."""
    rx, ry, dx, dy = _rays(path, tracks)
    both, (rows, columns) = jnp.stack([tracks.p, tracks.on]), tracks.nodes
    (height, width), node, before = tracks.shape, tracks.node, SPOT // 2
    pad = (before, rows * node + SPOT - height), (before, columns * node + SPOT - width)

    def about(image: Array) -> Array:
        spots = (SPOT, SPOT), (node, node)
        sums = lax.reduce_window(jnp.pad(image, pad), 0.0, lax.add, *spots, "VALID")
        return sums[:rows, :columns]

    def one(log_rho: Array) -> tuple[Array, Array]:
        rho = jnp.exp(log_rho)
        at = jnp.stack([rx + rho * dx, ry + rho * dy], 1)
        images = splat(at, both, tracks.shape, tracks.corner)
        return about(blur(images[0], 1) ** 2), about(images[1])

    return lax.map(one, low + (high - low) * jnp.arange(LEVELS) / (LEVELS - 1))


def depths(path: Path, tracks: Tracks) -> Array:
    """Log depths at nodes, each the one of highest contrast around it, for a path that is given.

    They are looked for at those the path has and up to 2.5 times nearer and farther. Beside
    an edge of depth the nearer surface's is found, to which the edge's events belong. Where there
    are few events they are those of the surroundings.
    """
    low, high = (float(v) for v in jnp.percentile(path.log_rho, jnp.array([5.0, 95.0])))
    low, high = low - np.log(2.5), high + np.log(2.5)
    real = tracks.x.dtype
    S, n = (
        scipy.ndimage.gaussian_filter(np.asarray(part, np.float64), (0, 1.5, 1.5))
        for part in _tried_depths(path, tracks, jnp.asarray(low, real), jnp.asarray(high, real))
    )
    sharp = S / np.maximum(n, 20)
    best = sharp.argmax(0)
    inner = np.clip(best, 1, LEVELS - 2)
    before, here, after = (np.take_along_axis(sharp, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    bend = np.minimum(before - 2 * here + after, -1e-9)
    found = inner + np.where(best == inner, np.clip((before - after) / 2 / bend, -0.5, 0.5), 0)
    found = low + (high - low) / (LEVELS - 1) * found
    told = n.mean(0) * np.maximum(1 - sharp.mean(0) / np.maximum(here, 1e-9), 0)
    told *= np.where(best == inner, 1, 1e-3)
    told /= told + max(told.mean(), 1e-9)
    total, weight = told * found, told
    for k in range(6):
        blurred = (scipy.ndimage.gaussian_filter(part, 2.0**k) for part in (told * found, told))
        share = 0.1 ** (k + 1)
        total, weight = (a + share * b for a, b in zip((total, weight), blurred, strict=True))
    usual = float(jnp.median(path.log_rho))
    return jnp.asarray(((total + 1e-9 * usual) / (weight + 1e-9)).ravel(), real)


# Starts


@functools.partial(jax.jit, static_argnums=2)
def _turned(Omega: Array, window: Window, blurs: int, scale: Array) -> tuple[Array, Array]:
    def loss(Omega: Array) -> Array:
        X, Y = _derotated(Omega, window)
        image = blur(splat(jnp.stack([X, Y], 1), window.p, window.shape, window.corner), blurs)
        return -jnp.sum(image**2) / scale

    return jax.value_and_grad(loss)(Omega)


def _derotated(Omega: Array, window: Window) -> tuple[Array, Array]:
    x, y, z = _rotated([Omega[i] * window.tau for i in range(3)], window.x, window.y, window.f)
    return window.f * x / z, window.f * y / z


def rotation(window: Window) -> NDArray[np.float64]:
    """The pure rotation (rad/s) of the highest contrast; with parallax only a beginning."""
    per_px = 1 / float(window.f * window.half)
    real = window.x.dtype

    def climb(at: NDArray, blurs: int) -> tuple[NDArray, float]:
        scale = -_turned(jnp.asarray(at, real), window, blurs, jnp.ones((), real))[0]

        def value(px: NDArray) -> tuple[float, NDArray]:
            loss, slope = _turned(jnp.asarray(px * per_px, real), window, blurs, scale)
            return float(loss), np.asarray(slope, np.float64) * per_px

        found = scipy.optimize.minimize(
            value, at / per_px, jac=True, method="L-BFGS-B", options={"maxiter": 12}
        )
        return found.x * per_px, float(found.fun) * float(scale)

    first: list[NDArray] = [
        np.zeros(3),
        *(8 * per_px * sign * axis for axis in np.eye(3) for sign in (1, -1)),
    ]
    best = min(_side_by_side(lambda at: climb(at, 8), first), key=lambda pair: pair[1])[0]
    for blurs in (2, 1):
        best, _ = climb(best, blurs)
    return best


@jax.jit
def _flow_maps(window: Window, Omega: Array, flows: Float[Array, "n 2"]) -> tuple[Array, Array]:
    """Contrast and number of events of all patches, (n, rows, columns), for flows (px/s)."""
    x, y = _derotated(Omega, window)
    height, width = (n // 8 * 8 for n in window.shape)

    def patches(image: Array) -> Array:
        image = image[:height, :width].reshape(height // 8, 8, width // 8, 8).sum((1, 3))
        return lax.reduce_window(image, 0.0, lax.add, (3, 3), (2, 2), "VALID")

    def one(U: Array) -> tuple[Array, Array]:
        at = jnp.stack([x - U[0] * window.tau, y - U[1] * window.tau], 1)
        both = splat(at, jnp.stack([window.p, jnp.abs(window.p)]), window.shape, window.corner)
        return patches(blur(both[0], 1) ** 2), patches(both[1])

    return lax.map(one, flows)


class Flows(NamedTuple):
    """Of patches: places (n, 2) px, flows (n, 2) px/s and their covariances."""

    xi: NDArray[np.float64]
    U: NDArray[np.float64]
    covariance: NDArray[np.float64]


def patch_flows(window: Window, Omega: NDArray, flow_max: float) -> Flows | None:
    """Flows of patches of the derotated events; None if fewer than 6 tell one."""
    real = window.x.dtype
    step = 0.6 / float(window.half)
    count = int(np.ceil(flow_max / step))
    grid = np.arange(-count, count + 1) * step
    n = len(grid)
    flows = np.stack(np.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 2)
    S, N = (
        np.asarray(part, np.float64)
        for part in _flow_maps(window, jnp.asarray(Omega, real), jnp.asarray(flows, real))
    )
    sharp = (S / np.maximum(N, 20)).reshape(n, n, *S.shape[1:])
    N = N.reshape(sharp.shape)
    a, b = (part.ravel() for part in np.mgrid[-1:2, -1:2].astype(float))
    # Least squares of a quadratic on 3 x 3 values.
    solve = np.linalg.pinv(np.stack([np.ones(9), a, b, a * a / 2, a * b, b * b / 2], 1))
    found = []
    for row, column in np.ndindex(*S.shape[1:]):
        map_ = sharp[:, :, row, column]
        i, j = np.unravel_index(np.argmax(map_), map_.shape)
        events = N[i, j, row, column]
        if not (0 < i < n - 1 and 0 < j < n - 1) or events < 40:
            continue
        _, ga, gb, aa, ab, bb = solve @ map_[i - 1 : i + 2, j - 1 : j + 2].ravel()
        bend, axes = np.linalg.eigh(-np.array([[aa, ab], [ab, bb]]))
        bend = np.maximum(bend, 1e-4 * map_[i, j] + 1e-9)
        off = np.clip(axes @ (axes.T @ np.array([ga, gb]) / bend), -1, 1)
        information = axes * bend @ axes.T * events / map_[i, j] / step**2
        covariance = 16 * np.linalg.inv(information) + 4 * np.eye(2)
        xi = np.array(window.corner) + np.array([column, row]) * HOP + (PATCH - 1) / 2
        found.append((xi, np.array([grid[i], grid[j]]) + off * step, covariance))
    if len(found) < 6:
        return None
    return Flows(*(np.array(part) for part in zip(*found, strict=True)))


def headings(flows: Flows, f: float, Omega: NDArray, number: int, omega_weight: float) -> list:
    """The best (heading, Omega, inverse depths, their weights), at least 32 degrees apart.

    For every heading of a hemisphere the rest of the rotation is fitted to what flows are across
    its epipolar lines, robustly (Geman & McClure, the limit falling from 64 to 2 deviations);
    depths > 0 choose its sign.
    """
    k = np.arange(DIRECTIONS) + 0.5
    z, azimuth = k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    T = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], 1)
    x, y = flows.xi.T
    a = np.einsum("kij,tj->tki", np.asarray(A(x, y, f), np.float64), T)
    turn = np.asarray(B(x, y, f), np.float64)
    across = np.stack([-a[..., 1], a[..., 0]], -1)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    variance = np.einsum("tki,kij,tkj->tk", across, flows.covariance, across)
    target = np.einsum("tki,ki->tk", across, flows.U)
    basis = np.einsum("tki,kij->tkj", across, turn)
    more = np.zeros((DIRECTIONS, 3))
    damping = (1e-6 * f * f + omega_weight) * np.eye(3)
    for turn_number in range(10):
        left = target - np.einsum("tkj,tj->tk", basis, more)
        limit = 4.0 * 4.0 ** max(0, 5 - turn_number)
        weight = 1 / variance / (1 + left**2 / variance / limit) ** 2
        H = np.einsum("tk,tki,tkj->tij", weight, basis, basis) + damping
        side = np.einsum("tk,tki,tk->ti", weight, basis, target) - omega_weight * Omega
        more = np.linalg.solve(H, side[..., None])[..., 0]
    rest = flows.U - np.einsum("kij,tj->tki", turn, more)
    information = np.linalg.inv(flows.covariance)
    along = np.einsum("tki,kij,tkj->tk", a, information, a)
    towards = np.einsum("tki,kij,tkj->tk", a, information, rest)
    found = []
    for sign in (1, -1):
        rho = np.maximum(sign * towards / np.maximum(along, 1e-12), 0)
        miss = rest - sign * rho[..., None] * a
        e = np.einsum("tki,kij,tkj->tk", miss, information, miss)
        cost = (e / (1 + e / 4)).sum(1) + omega_weight * ((more + Omega) ** 2).sum(1)
        found += list(zip(cost, sign * T, more + Omega, rho, along, strict=True))
    found.sort(key=lambda one: one[0])
    best: list = []
    for one in found:
        if all(one[1] @ other[1] < 0.85 for other in best):
            best.append(one)
            if len(best) == number:
                break
    return [one[1:] for one in best]


def start(
    window: Window, flows: Flows, T: NDArray, Omega: NDArray, rho: NDArray, weight: NDArray
) -> Path:
    """A path of constant twist with depths that patches tell, the nearest ones most."""
    rows, columns = window.cells
    j, i = np.divmod(np.arange(rows * columns), columns)
    middle = (window.cell - 1) / 2
    x, y = window.corner[0] + i * window.cell + middle, window.corner[1] + j * window.cell + middle
    far = (x[:, None] - flows.xi[:, 0]) ** 2 + (y[:, None] - flows.xi[:, 1]) ** 2
    usual = max(float(np.average(rho, weights=weight + 1e-12)), 1e-3)
    share = np.exp(-far / (2 * PATCH**2)) * weight / max(weight.mean(), 1e-12) + 1e-6
    depth = (share * np.clip(rho, 0.15 * usual, 6 * usual)).sum(1) / share.sum(1)
    real = window.x.dtype
    O, D = np.zeros((ROWS, 3)), np.zeros((ROWS, 3))  # noqa: E741
    O[0], D[0] = Omega, T
    return Path(*(jnp.asarray(part, real) for part in (O, D, np.log(depth))))


class Fit(NamedTuple):
    """A fitted window: path with depths at nodes, covariance (6, 6) of heading and Omega.

    `agreement` is the share of events that the fit explains, `cost` the robust cost per event.
    """

    path: Path
    covariance: NDArray[np.float64]
    agreement: float
    cost: float
    map: NDArray[np.floating]


class Windows:
    """The windows of a recording, and how one is fitted."""

    def __init__(
        self,
        recording: Recording,
        params: Params,
        camera: PinholeCamera,
        gyro: Twists | None = None,
        seed: int = 0,
    ):
        self.recording, self.params, self.gyro, self.seed = recording, params, gyro, seed
        self.xi, self.f = coordinates(recording.width, recording.height, camera)
        flat = self.xi.reshape(-1, 2)
        lower, upper = np.floor(flat.min(0)) - MARGIN, np.ceil(flat.max(0)) + MARGIN
        cells = np.ceil((upper - lower + 1) / params.cell).astype(int)
        corner = lower - (cells * params.cell - (upper - lower + 1)) // 2
        self.corner = (float(corner[0]), float(corner[1]))
        self.shape = (int(cells[1]) * params.cell, int(cells[0]) * params.cell)
        self.box = (flat[:, 0].min(), flat[:, 0].max(), flat[:, 1].min(), flat[:, 1].max())

    def rows(self, centre: int, half: float) -> tuple[int, int]:
        """The events of a window."""
        span, index = round(half * 1e6), self.recording.events.index
        return index(centre - span), index(centre + span)

    def cut(self, centre: int, half: float, most: int) -> Window:
        """At most so many of a window's events, the rest empty."""
        most = min(most, self.params.events)
        first, last = self.rows(centre, half)
        events = self.recording.events[first:last]
        rng = np.random.default_rng([self.seed, abs(centre), most])
        keep = np.arange(len(events))
        if len(keep) > most:
            keep = np.sort(rng.choice(len(keep), most, replace=False))
        real = np.dtype(jnp.result_type(float))
        data = np.zeros((4, most), real)
        n = len(keep)
        data[:2, :n] = self.xi[events.y[keep], events.x[keep]].T
        data[2, :n] = (events.t[keep] - centre) * 1e-6
        data[3, :n] = np.where(events.p[keep], 1, -1)
        x, y, tau, p = (jnp.asarray(part) for part in data)
        return Window(
            x,
            y,
            tau,
            p,
            jnp.asarray(self.f, real),
            jnp.asarray(half, real),
            jnp.asarray(self.box, real),
            self.shape,
            self.corner,
            self.params.cell,
        )

    def prior(self, centre: int, half: float) -> Prior:
        real = np.dtype(jnp.result_type(float))
        params = self.params
        gyro, weight = np.zeros((SEGMENTS, 3)), 0.0
        if self.gyro is not None:
            times = centre + ((np.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * half * 1e6
            at = np.clip(np.rint(times), self.gyro.start, self.gyro.stop).astype(np.int64)
            gyro, weight = self.gyro(at)[1], 1 / float(params.gyro_std) ** 2
        values = (params.smooth, params.relief, params.change, self.omega_weight, gyro, weight)
        values += (params.bond, params.flat, params.alike)
        return Prior(*(jnp.asarray(value, real) for value in values))

    @property
    def omega_weight(self) -> float:
        scale = float(self.params.omega_scale)
        return 1 / scale**2 if scale > 0 else 0.0

    def starts(self, centre: int) -> list[Path]:
        """Paths of constant twist to begin with, followed for a third of the window."""
        params, half = self.params, float(self.params.half_window) / 3
        short = self.cut(centre, half, COARSE)
        if self.gyro is None:
            Omega = rotation(short)
        else:
            middle = np.clip(centre, self.gyro.start, self.gyro.stop)
            Omega = self.gyro(np.array([middle], np.int64))[1][0]
        found: list[Path] = []
        window, prior = self.cut(centre, half, MIDDLE), self.prior(centre, half)
        for length in (half / 2, half):
            cut = short if length == half else self.cut(centre, length, COARSE)
            flows = patch_flows(cut, Omega, float(params.flow_max))
            if flows is None:
                continue
            best = headings(flows, self.f, Omega, params.starts, self.omega_weight)
            found += [start(window, flows, *one) for one in best]

        def follow(path: Path) -> Path:
            path, _ = refine(window, path, prior, 0, 4, 6)
            return refine(window, path, prior, 0, 1, 6)[0]

        return _side_by_side(follow, found)

    def tracks(self, centre: int, half: float, most: int) -> Tracks:
        """All of a window's events of as many pixels as have so many in total, the rest empty."""
        most = min(most, self.params.events)
        first, last = self.rows(centre, half)
        events = self.recording.events[first:last]
        width, pixels = self.recording.width, self.recording.width * self.recording.height
        pixel = events.y.astype(np.int64) * width + events.x
        count = np.bincount(pixel, minlength=pixels)
        # One event alone tells nothing.
        order = np.random.default_rng([self.seed, abs(centre), most]).permutation(pixels)
        order = order[count[order] > 1]
        taken = np.zeros(pixels, bool)
        taken[order[np.cumsum(count[order]) <= most]] = True
        keep = np.flatnonzero(taken[pixel])
        keep = keep[np.argsort(pixel[keep], kind="stable")]
        n, where = len(keep), pixel[keep]
        begins = np.append(True, where[1:] != where[:-1])[:n]
        begin = np.maximum.accumulate(np.where(begins, np.arange(n), 0))
        p = np.where(events.p[keep], 1, -1)
        total = np.cumsum(p)
        real = np.dtype(jnp.result_type(float))
        data = np.zeros((6, most), real)
        data[:2, :n] = self.xi.reshape(-1, 2)[where].T
        data[2, :n] = (events.t[keep] - centre) * 1e-6
        data[3, :n] = total - (total - p)[begin]
        data[4, :n] = np.arange(n) - begin + 1
        data[5, :n] = p
        which = np.full(most, pixels, np.int32)
        which[:n] = where
        lower, upper = np.array(self.box[::2]) - MARGIN, np.array(self.box[1::2]) + MARGIN
        lower = np.floor(lower)
        across, down = (np.ceil(upper - lower).astype(int) + 1).tolist()
        x, y, tau, level, number, p = (jnp.asarray(part) for part in data)
        return Tracks(
            x,
            y,
            tau,
            level,
            number,
            p,
            jnp.asarray(which),
            jnp.asarray(self.f, real),
            jnp.asarray(half, real),
            (down, across),
            (float(lower[0]), float(lower[1])),
            pixels + 1,
            NODE,
        )

    def aligned(self, centre: int, paths: list[Path]) -> list[Path]:
        """Starts followed by the alignment of segments, the best first, some degrees apart."""
        half = float(self.params.half_window)
        middle, last = self.cut(centre, 2 * half / 3, MIDDLE), self.cut(centre, half, LAST)
        priors = self.prior(centre, 2 * half / 3), self.prior(centre, half)

        def follow(path: Path) -> tuple[float, Path]:
            path, _ = refine(middle, path, priors[0], 1, 2, 8)
            path, _ = refine(last, path, priors[1], 2, 2, self.params.iterations)
            return float(score(last, path)) - self.turning(path), path

        found = [pair for pair in _side_by_side(follow, paths) if np.isfinite(pair[0])]
        best = [path for _, path in sorted(found, key=lambda pair: -pair[0])]
        return _apart(best, lambda path: path)[: self.params.rivals]

    def on_nodes(self, path: Path, tracks: Tracks) -> Path:
        """A path with the depths of cells, with depths at nodes."""
        cell, (x, y) = self.params.cell, tracks.places
        middle = (cell - 1) / 2
        u, v = (x - self.corner[0] - middle) / cell, (y - self.corner[1] - middle) / cell
        cells = np.asarray(path.log_rho, np.float64)
        cells = cells.reshape(self.shape[0] // cell, self.shape[1] // cell)
        log_rho = scipy.ndimage.map_coordinates(cells, [v, u], order=1, mode="nearest")
        return Path(path.O, path.D, jnp.asarray(log_rho, path.O.dtype))

    def fit(self, centre: int, paths: list[Path], warm: Path | None = None) -> Fit | None:
        """The best of some starts, and of a path with depths at nodes that is about right."""
        half = float(self.params.half_window)
        prior = self.prior(centre, half)
        tracks = self.tracks(centre, half, TRIED)
        rivals = [self.on_nodes(path, tracks) for path in self.aligned(centre, paths)]
        rivals += [] if warm is None else [warm]

        def tried(paths: list[Path]) -> list[tuple[Scene, Report]]:
            return _side_by_side(lambda path: _tried(tracks, path, prior), paths)

        left = self.remaining(tried(rivals), CLOSE[0])
        duals = [other for scene, _ in left if (other := dual(scene.path, tracks)) is not None]
        new = [one for one in duals if not any(_near_to(one, scene.path) for scene, _ in left)]
        left = self.remaining(left + tried(new), CLOSE[0])
        tracks = self.tracks(centre, half, self.params.events)

        def followed(stages: Any) -> list[tuple[Scene, Report]]:
            new = _side_by_side(lambda one: _adjusted(tracks, one[0], one[1], prior, stages), left)
            return self.remaining(new, CLOSE[1])

        left = followed(FINAL)
        left = followed(MORE) if len(left) > 1 else left
        if not left:
            return None
        scene, report = left[0]
        sigma = max(MORE[0][0], SHARP * float(report.rms))
        scene, report = adjust(tracks, scene, prior, sigma, 0, 1, True)
        return Fit(
            scene.path,
            np.asarray(report.covariance, np.float64),
            float(report.inliers),
            float(report.cost),
            np.asarray(scene.map),
        )

    def remaining(
        self, rivals: list[tuple[Scene, Report]], close: tuple[float, float]
    ) -> list[tuple[Scene, Report]]:
        """Rivals of about the least cost, that first, without those that came to a better one."""
        ranked = sorted(((self.cost(*one), one) for one in rivals), key=lambda pair: pair[0])
        limit = close[0] * ranked[0][0] + close[1] if ranked else 0.0
        return _apart([one for cost, one in ranked if cost < limit], lambda one: one[0].path)

    def cost(self, scene: Scene, report: Report) -> float:
        """What selects among rivals: the cost per event, with the prior of |Omega|."""
        value = float(report.cost) + self.turning(scene.path)
        return value if np.isfinite(value) else np.inf

    def turning(self, path: Path) -> float:
        """The prior of |Omega|, per event."""
        return 0.5 * self.omega_weight * float((path.O[0] ** 2).sum()) / LAST


def _side_by_side(follow: Callable[[Any], Any], rivals: list[Any]) -> list[Any]:
    """What comes of rivals, of some at a time: steps of one keep about one core busy."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(follow, rivals))


def _near_to(path: Path, other: Path) -> bool:
    turn = float(((path.O[0] - other.O[0]) ** 2).sum())
    return bool(path.D[0] @ other.D[0] > APART) and turn < TURN**2


def _apart(ranked: list[Any], path: Callable[[Any], Path]) -> list[Any]:
    """Those that are not near to an earlier one that is kept."""
    best: list[Any] = []
    for one in ranked:
        if not any(_near_to(path(one), path(other)) for other in best):
            best.append(one)
    return best


def dual(path: Path, tracks: Tracks) -> Path | None:
    """The other motion before a plane that explains the same flow; None if depths are no plane's.

    With rho = n . (x, y, f) / f points move by -(T n' + [Omega]x) X, and so they do if T and n
    change places and n x T is added to Omega (cf. Longuet-Higgins, "The visual ambiguity of a
    moving plane", 1984). Only perspective and time tell the two from each other.
    """
    f, (x, y) = float(tracks.f), tracks.places
    rays = np.stack([x / f, y / f, np.ones(len(x))], 1)
    rho = np.exp(np.asarray(path.log_rho, np.float64))
    weight = 1 / rho**2
    for _ in range(4):
        n = np.linalg.solve((rays.T * weight) @ rays, (rays.T * weight) @ rho)
        off = np.abs(rays @ n / rho - 1)
        weight = 1 / rho**2 / (1 + (off / PLANE) ** 2) ** 2
    O, D = np.array(path.O, np.float64), np.zeros(path.D.shape)  # noqa: E741
    T = np.asarray(path.D[0], np.float64)
    depth = np.linalg.norm(n) * (rays @ T)
    sign = np.sign(np.median(depth))
    if np.median(off) > PLANE or not sign:
        return None
    O[0] += np.cross(n, T)
    D[0] = sign * n / np.linalg.norm(n)
    log_rho = np.log(np.maximum(sign * depth, 0.1 * abs(np.median(depth))))
    real = path.O.dtype
    return Path(*(jnp.asarray(part, real) for part in (O, D, log_rho)))


def _tried(tracks: Tracks, path: Path, prior: Prior) -> tuple[Scene, Report]:
    """A rival followed: depths are looked for, then adjusted with the path, in turns."""
    real, report = tracks.x.dtype, None
    for stage in ROUNDS:
        path = Path(path.O, path.D, depths(path, tracks))
        scene = Scene(path, jnp.zeros(tracks.shape, real), jnp.zeros((), real))
        scene, report = adjust(tracks, scene, prior, ROUNDS[0][0], 2, 2)  # the map alone
        scene, report = _adjusted(tracks, scene, report, prior, (stage,))
        path = scene.path
    assert report is not None
    return scene, report


def _adjusted(
    tracks: Tracks,
    scene: Scene,
    report: Report,
    prior: Prior,
    stages: tuple[tuple[float, int, float | int], ...],
) -> tuple[Scene, Report]:
    """Through stages; sigma is not much less than the noise (C) that was seen."""
    for sigma, steps, flatter in stages:
        seen = prior._replace(flat=flatter * prior.flat)
        scene, report = adjust(tracks, scene, seen, max(sigma, SHARP * float(report.rms)), 0, steps)
    return scene, report


def advanced(path: Path, tau: float) -> Path:
    """A path for a window that is tau s later, its depths those of the same cells."""
    T, Omega = path.twist(tau)
    real = path.O.dtype
    O, D = np.asarray(path.O, np.float64).copy(), np.asarray(path.D, np.float64).copy()  # noqa: E741
    for k in range(len(O) - 1, -1, -1):
        O[k] = sum(O[m] * tau ** (m - k) / math.factorial(m - k) for m in range(k, len(O)))
    D[0] = T[0]
    return Path(jnp.asarray(O, real), jnp.asarray(D, real), path.log_rho)


def estimate(
    recording: Recording,
    params: Params | None = None,
    *,
    model: str = "general",
    camera: PinholeCamera | None = None,
    seed: int = 0,
    gyro: Twists | None = None,
    progress: bool = False,
) -> Motion:
    """The general motion of a camera, from windows that overlap.

    The motion at a time is the mean of what the windows around it tell, of those nearer the more
    (a raised cosine). Estimates are a fifth of a `step` apart.

    Args:
        recording: Events, and the calibration if no `camera` is given.
        params: See `Params`.
        model: "general"; (tx, ty, tz) is a unit vector, (wx, wy, wz) in rad/s.
        camera: The calibration, by default the recording's.
        seed: Chooses events where a window has more than `events`.
        gyro: What a gyro measured (`truth.from_gyro`), which settles Omega.
        progress: Show a bar on stderr.

    Raises:
        InputError: The model is another, or there is no calibration.
    """
    params = params or Params.of({})
    if model not in MODELS:
        raise InputError(
            f"batch does not know the motion model {model!r}; {nearest(model, MODELS)}"
        )
    camera = camera or recording.camera
    if camera is None:
        raise InputError(
            f"{recording.name}: has no calibration, which general motion needs; give a camera"
        )
    if not len(recording.events):
        return Motion.nothing(model)
    windows = Windows(recording, params, camera, gyro, seed)
    first, last = int(recording.events[:1].t[0]), int(recording.events[-1:].t[0])
    half, step = (round(1e6 * float(value)) for value in (params.half_window, params.step))
    centres = np.arange(first + half, last - half + 1, step)
    if not len(centres):
        centres = np.array([(first + last) // 2])
    fits: list[Fit | None] = []
    warm, since = None, 0
    for centre in tqdm(centres.tolist(), unit="window", disable=not progress, leave=False, delay=2):
        a, b = windows.rows(centre, half * 1e-6)
        if b - a < params.fewest:
            warm = None
            fits.append(None)
            continue
        anew = warm is None or since % params.fresh == 0
        fit = windows.fit(centre, windows.starts(centre) if anew else [], warm)
        since = since + 1 if fit is not None else 0
        warm = None if fit is None else advanced(fit.path, step * 1e-6)
        fits.append(fit)
    return _blended(centres, fits, half, step, first, last)


def _blended(
    centres: NDArray, fits: list[Fit | None], half: int, step: int, first: int, last: int
) -> Motion:
    """The motion of overlapping windows; lost where none tells it.

    Of a window the middle two thirds count, those beyond `reach` where no other tells more.
    """
    end = 2 * half // 3
    t = np.arange(max(centres[0] - end, first), min(centres[-1] + end, last) + 1, max(step // 5, 1))
    heading, Omega = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    covariance, total, contrast = np.zeros((len(t), 6, 6)), np.zeros(len(t)), np.zeros(len(t))
    reach = min(end, step)
    for centre, fit in zip(centres, fits, strict=True):
        near = np.abs(t - centre) <= end
        if fit is None or not near.any():
            continue
        far = np.minimum(np.abs(t[near] - centre) / max(reach, 1), 1)
        weight = np.maximum(np.cos(np.pi / 2 * far) ** 2, 1e-3)
        T, turn = fit.path.twist((t[near] - centre) * 1e-6)
        heading[near] += weight[:, None] * T
        Omega[near] += weight[:, None] * turn
        covariance[near] += weight[:, None, None] * fit.covariance
        contrast[near] += weight * fit.agreement
        total[near] += weight
    lost = total < 1e-6
    safe = np.where(lost, 1, total)
    size = np.linalg.norm(heading, axis=1, keepdims=True)
    heading = np.where(size > 0, heading / np.where(size > 0, size, 1), np.array([0.0, 0, 1]))
    mean = np.concatenate([heading, Omega / safe[:, None]], 1)
    return Motion.of("general", t, mean, covariance / safe[:, None, None], lost, contrast / safe)
