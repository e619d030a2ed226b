"""Segments of a window of events aligned with each other: a motion from far beside it.

I_s is the signed image of the warped events of one segment,

    min sum_s |I_s - k_s T_s|^2,  T_s = sum of the other segments' images,

by Gauss-Newton on displacements of every cell in every segment with their information (Lucas &
Kanade's equations, k_s per cell and segment), the assignment of events to cells held fixed. It
comes within some ten degrees from most starts; its own optimum is some degrees off.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.gauss_newton import (
    DEEPEST,
    bonds_between,
    first_rows,
    gauge_of_rows,
    limit_step,
    pull_of_rows,
    units_of_rows,
    with_first_rows,
)
from jaxevent.egomotion.batch_fit.path import (
    SEGMENTS,
    Path,
    Prior,
    along,
    normalised,
    pairs_of,
    rotated,
    warp,
)
from jaxevent.egomotion.warped import blur, splat

BORDER = 3  # px at the sensor's border that are not compared
BLOCK = 12  # px, of the score
K = 3  # rows of O and of D that move
FREE = 6 * K  # their numbers
EDGE = 0.3  # a larger difference of log depth between cells is an edge


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

    @property
    def places(self) -> tuple[NDArray, NDArray]:
        """Where cells' centres lie: x and y (px), row by row."""
        rows, columns = self.cells
        j, i = np.divmod(np.arange(rows * columns), columns)
        middle = (self.cell - 1) / 2
        return self.corner[0] + i * self.cell + middle, self.corner[1] + j * self.cell + middle


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


class Overlap(NamedTuple):
    """What a segment and the others show of the same places."""

    images: Array  # (S, h, w)
    others: Array  # (S, h, w), the sum of the others', for as many segments as are compared
    share: Array  # (S, cells) of a cell, that is seen


class Displacements(NamedTuple):
    """By how much cells seem displaced in segments (S, cells), as information and its product."""

    xx: Array
    xy: Array
    yy: Array
    vx: Array
    vy: Array
    agreement: Array  # of segments: 1 where all show the same


class Lattice(NamedTuple):
    """The cells' centres in all segments: where they lie (S, cells) px, and the times (s)."""

    X: Array
    Y: Array
    tau: Array
    times: Array  # (S,)

    @classmethod
    def of(cls, window: Window) -> "Lattice":
        cells = window.cells[0] * window.cells[1]
        X, Y = (jnp.broadcast_to(part, (SEGMENTS, cells)) for part in window.places)
        times = ((jnp.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * window.half
        tau = jnp.broadcast_to(times[:, None], (SEGMENTS, cells))
        X, Y, tau = (part.astype(window.x.dtype) for part in (X, Y, tau))
        return cls(X, Y, tau, times)


def refine(
    window: Window, path: Path, prior: Prior, *, degree: int, blurs: int, steps: int
) -> tuple[Path, Array]:
    """So many Gauss-Newton steps from a path; of O and D the rows up to `degree` (<= 2) move.

    Images are blurred `blurs` times by [1 2 1] / 4. The second result is how well segments agreed
    before the last step: 1 where all show the same.
    """
    return _refine(window, path, prior, int(degree), int(blurs), int(steps))


@jax.jit
def _refine(
    window: Window, path: Path, prior: Prior, degree: Array, blurs: Array, steps: Array
) -> tuple[Path, Array]:
    lattice = Lattice.of(window)

    def one(_: Any, state: tuple[Path, Array]) -> tuple[Path, Array]:
        path, _ = state
        x, y = trace_cells(path, window, lattice)
        overlap = compare_segments(path, window, lattice, x, y, blurs)
        found = measure_displacements(overlap, window, blurs)
        H, g, now, unit = linearise(path, window, lattice, x, y, found, prior)
        return step(path, H, g, now, unit, degree), found.agreement

    return lax.fori_loop(0, steps, one, (path, jnp.zeros((), window.x.dtype)))


def trace_cells(path: Path, window: Window, lattice: Lattice) -> tuple[Array, Array]:
    """Where the cells' centres were at the segments' times, x and y (S, cells) px."""
    rho = jnp.broadcast_to(jnp.exp(path.log_rho), lattice.tau.shape)
    x, y = lattice.X, lattice.Y
    for _ in range(4):
        X, Y = warp(path, window.f, x, y, lattice.tau, rho)
        x, y = x - (X - lattice.X), y - (Y - lattice.Y)
    return x, y


def compare_segments(
    path: Path, window: Window, lattice: Lattice, x: Array, y: Array, blurs: Array
) -> Overlap:
    """The segments' images where the sensor saw the cells, and those of the others."""
    images = segments(path, window, assigned(path, window))
    images = lax.fori_loop(0, blurs, lambda _, image: blur(image, 1), images)
    px = window.corner[0] + jnp.arange(window.shape[1])
    py = window.corner[1] + jnp.arange(window.shape[0])
    at_x = _spread(x - lattice.X, window) + px[None, None, :]
    at_y = _spread(y - lattice.Y, window) + py[None, :, None]
    seen = (at_x > window.box[0] + BORDER) & (at_x < window.box[1] - BORDER)
    seen &= (at_y > window.box[2] + BORDER) & (at_y < window.box[3] - BORDER)
    seen = seen.astype(images.dtype)
    share = _sums(seen, window) / window.cell**2
    images = images * seen
    count = seen.sum(0)
    others = (images.sum(0) - images) * seen
    others = others * jnp.where(count > 2, SEGMENTS / jnp.maximum(count, 1), 0)
    return Overlap(images, others, share)


def measure_displacements(overlap: Overlap, window: Window, blurs: Array) -> Displacements:
    """By how much cells seem displaced, by Lucas and Kanade's equations."""
    images, others, share = overlap
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
    own = jnp.maximum((_sums(images**2, window) * share).sum(), 1e-6)
    agreement = (gain * both * share).sum() / own
    xx, xy, yy, vx, vy = (robust * part for part in (xx, xy, yy, vx, vy))
    return Displacements(xx, xy, yy, vx, vy, agreement)


def linearise(
    path: Path,
    window: Window,
    lattice: Lattice,
    x: Array,
    y: Array,
    found: Displacements,
    prior: Prior,
) -> tuple[Array, Array, Array, Array]:
    """H and g of the displacements and the priors, the path's rows, and their units.

    Unknowns are the path's first rows, in px at the window's end, and the cells' log depths.
    """
    f, h, tau = window.f, window.half, lattice.tau
    rho = jnp.broadcast_to(jnp.exp(path.log_rho), tau.shape)
    xx, xy, yy, vx, vy, _ = found
    now = first_rows(path, K)
    J = jax.jacfwd(
        lambda values: jnp.stack(warp(with_first_rows(path, values, K), f, x, y, tau, rho))
    )(now)
    O, C = path.coefficients()  # noqa: E741
    rx, ry, rz = rotated(along(O, tau), x, y, f)
    cx, cy, cz = along(C, tau)
    r = rho * jnp.stack([f * cx - cz * rx * f / rz, f * cy - cz * ry * f / rz])
    unit = units_of_rows(path, f, h, K)
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

    pairs = pairs_of(*window.cells)
    a, b = FREE + pairs[0], FREE + pairs[1]
    apart, bond = bonds_between(path.log_rho, (pairs[0], pairs[1]), prior.smooth, EDGE)
    H = H.at[a, a].add(bond).at[b, b].add(bond).at[a, b].add(-bond).at[b, a].add(-bond)
    g = g.at[a].add(bond * apart).at[b].add(-bond * apart)
    rest = jnp.zeros(len(g), H.dtype).at[FREE:].set(prior.relief)
    H = H + jnp.diag(rest)
    g = g.at[FREE:].add(prior.relief * (path.log_rho - path.log_rho.mean()))

    def pull(rows: Array) -> Array:
        return pull_of_rows(rows, unit, prior, h, K)

    H = H.at[:FREE, :FREE].add(jax.hessian(pull)(now))
    g = g.at[:FREE].add(jax.grad(pull)(now))
    gauge = gauge_of_rows(path, unit, len(g))
    H = H + 100 * jnp.trace(upper) / FREE * gauge[:, None] * gauge
    return H + jnp.diag(1e-3 * jnp.diag(H) + 1e-6), g, now, unit


def step(path: Path, H: Array, g: Array, now: Array, unit: Array, degree: Array) -> Path:
    """The path after a step, whose rows above `degree` stay."""
    still = jnp.repeat(jnp.tile(jnp.arange(K) > degree, 2), 3)
    still = jnp.append(still, jnp.zeros(len(g) - FREE, bool))
    H = jnp.where(still[:, None] | still, 0, H) + jnp.diag(still.astype(H.dtype))
    change = -jnp.linalg.solve(H, jnp.where(still, 0, g))
    change = jnp.where(jnp.isfinite(change).all(), change, 0)
    change = change * limit_step(change[:FREE])
    path = with_first_rows(path, (now + change[:FREE]) * unit, K)
    deeper = jnp.clip(change[FREE:], -DEEPEST, DEEPEST)
    return normalised(Path(path.O, path.D, path.log_rho + deeper))


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
