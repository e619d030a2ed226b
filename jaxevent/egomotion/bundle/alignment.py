"""Segments of a window of events aligned with each other: a motion from far beside it.

I_s is the signed image of the warped events of one segment,

    min sum_s |I_s - k_s T_s|^2,  T_s = sum of the other segments' images,

by Gauss-Newton on displacements of every cell in every segment with their information (Lucas &
Kanade's equations, k_s per cell and segment), the assignment of events to cells held fixed. It
comes within some ten degrees from most starts; its own optimum is some degrees off.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle import images
from jaxevent.egomotion.bundle.coarse import factorise, substitute
from jaxevent.egomotion.bundle.gauss_newton import DEEPEST, bonds, limit_step
from jaxevent.egomotion.bundle.path import SEGMENTS, Path, Prior, normalised, warp
from jaxevent.egomotion.bundle.placing import (
    POWERS,
    Cells,
    Points,
    assign,
    slopes_by_coefficients,
)
from jaxevent.egomotion.bundle.rows import (
    chain,
    gauge_of_rows,
    priors_of_rows,
    rows_of,
    units_of_rows,
    with_rows,
)

BORDER = 3  # px at the sensor's border that are not compared
BLOCK = 12  # px, of the score
K = 3  # rows of O and of D that move
FREE = 6 * K  # their numbers
EDGE = 0.3  # a larger difference of log depth between cells is an edge


@dataclasses.dataclass(frozen=True)
class Window:
    """Events of a window: places (px, undistorted, from the principal point), tau, polarity."""

    x: NDArray
    y: NDArray
    tau: NDArray  # s from the reference time
    p: NDArray  # +-1
    f: float  # px
    half: float  # s
    box: tuple[float, float, float, float]  # px, where the sensor is: x0, x1, y0, y1
    shape: tuple[int, int]  # of the reference view
    corner: tuple[float, float]  # px, where its pixel [0, 0] lies
    cell: int

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


class Displacements(NamedTuple):
    """By how much cells seem displaced in segments (S, cells), as information and its product."""

    xx: NDArray[np.float64]
    xy: NDArray[np.float64]
    yy: NDArray[np.float64]
    vx: NDArray[np.float64]
    vy: NDArray[np.float64]


class Lattice(NamedTuple):
    """The cells' centres in all segments: where they lie (S, cells) px, and the times (s)."""

    X: NDArray[np.float64]
    Y: NDArray[np.float64]
    tau: NDArray[np.float64]

    @classmethod
    def of(cls, window: Window) -> "Lattice":
        times = ((np.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * window.half
        parts = np.broadcast_arrays(*window.places, times[:, None])
        return cls(*(np.array(part, np.float64) for part in parts))


def warped(path: Path, window: Window) -> tuple[NDArray[np.int32], NDArray, NDArray]:
    """The cell of every event, by its warped position, and this."""
    number = np.empty(len(window.x), np.int32)
    X, Y = np.empty_like(window.x), np.empty_like(window.x)
    rho = np.exp(path.log_rho.astype(np.float64))
    points = Points(window.x, window.y, window.tau)
    cells = Cells(window.corner, window.cell, *window.cells)
    assign(points, path.motion(window.f), rho, cells, number, X, Y)
    return number, X, Y


def refine(
    window: Window, path: Path, prior: Prior, *, degree: int, blurs: int, steps: int
) -> Path:
    """So many Gauss-Newton steps from a path; of O and D the rows up to `degree` (<= 2) move.

    Images are blurred `blurs` times by [1 2 1] / 4.
    """
    lattice = Lattice.of(window)
    for _ in range(steps):
        x, y = trace_cells(path, window, lattice)
        found = measure_displacements(path, window, lattice, x, y, blurs)
        path = step(path, *linearise(path, window, lattice, x, y, found, prior), degree)
    return path


def trace_cells(path: Path, window: Window, lattice: Lattice) -> tuple[NDArray, NDArray]:
    """Where the cells' centres were at the segments' times, x and y (S, cells) px."""
    rho, (x, y) = np.exp(path.log_rho), lattice[:2]
    for _ in range(4):
        X, Y = warp(path, window.f, x, y, lattice.tau, rho)
        x, y = x - (X - lattice.X), y - (Y - lattice.Y)
    return x, y


def measure_displacements(
    path: Path, window: Window, lattice: Lattice, x: NDArray, y: NDArray, blurs: int
) -> Displacements:
    """By how much cells seem displaced, by Lucas and Kanade's equations."""
    real, cells = window.x.dtype, lattice.X.shape[1]
    _, X, Y = warped(path, window)
    own = np.zeros((SEGMENTS, *window.shape), real)
    images.segment_images(X, Y, window.tau, window.p, window.half, window.corner, own)
    work = np.empty(window.shape, real)
    for image in own:
        images.blur(image, work, blurs)
    low, high = (
        np.array([window.box[k], window.box[2 + k]]) - np.array(window.corner) for k in (0, 1)
    )
    others, share = np.empty_like(own), np.zeros((SEGMENTS, cells))
    both = np.zeros((SEGMENTS, cells, 3))
    images.compare(
        own, window.cell, low + BORDER, high - BORDER, x - lattice.X, y - lattice.Y, others, share,
        both,
    )  # fmt: skip
    share /= window.cell**2
    gain = both[..., 0] / np.maximum(both[..., 1], 1e-6)
    sums = np.zeros((SEGMENTS, cells, 6))
    images.measure(own, others, gain, window.cell, sums)
    # Noise (per px) of a cell; blurring correlates it.
    noise = sums[..., 0].sum(0) / np.maximum(share.sum(0), 1) / window.cell**2
    weight = np.where((gain > 0) & (share > 0), 1 / (noise + 1e-3), 0) / (1 + 1.5 * blurs)
    xx, xy, yy = (weight * gain**2 * sums[..., k] for k in (1, 2, 3))
    vx, vy = (weight * gain * sums[..., k] for k in (4, 5))
    # A cell that seems displaced by more than about a pixel is not what it is taken for.
    small = 1e-2
    det = (xx + small) * (yy + small) - xy**2
    dx, dy = ((yy + small) * vx - xy * vy) / det, ((xx + small) * vy - xy * vx) / det
    robust = 1 / (1 + (dx**2 + dy**2) / (1 + 0.5 * blurs) ** 2) ** 2
    return Displacements(*(robust * part for part in (xx, xy, yy, vx, vy)))


def linearise(
    path: Path,
    window: Window,
    lattice: Lattice,
    x: NDArray,
    y: NDArray,
    found: Displacements,
    prior: Prior,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """H and g of the displacements and the priors, the path's rows, and their units.

    Unknowns are the path's first rows, in px at the window's end, and the cells' log depths.
    """
    f, half, tau, n = window.f, window.half, lattice.tau, lattice.X.size
    rho = np.broadcast_to(np.exp(path.log_rho), tau.shape)
    unit = units_of_rows(path, f, half, K)
    by, r = np.empty((n, 6, 2)), np.empty((n, 2))
    parts = [np.ascontiguousarray(part, np.float64).ravel() for part in (x, y, tau, rho)]
    slopes_by_coefficients(Points(*parts[:3]), parts[3], path.motion(f), by, r)
    powers = (tau.ravel() / half)[:, None] ** np.arange(1, POWERS + 1)
    J = (by[:, :, None] * powers[:, None, :, None]).reshape(n, 6 * POWERS, 2)
    J = J.transpose(0, 2, 1) @ chain(path, unit, half, K)
    now = rows_of(path, K) / unit
    W = np.stack([found.xx, found.xy, found.xy, found.yy], -1).reshape(n, 2, 2)
    v = np.stack([found.vx, found.vy], -1).reshape(n, 2)
    MJ = W @ J
    cells = lattice.X.shape[1]
    # By einsum: larger products wake BLAS's threads, which spin then, beside other starts' steps.
    upper = np.einsum("ep,eq->pq", J.reshape(-1, FREE), MJ.reshape(-1, FREE))
    mixed = np.einsum("ekp,ek->ep", MJ, r).reshape(SEGMENTS, cells, FREE).sum(0).T
    lower = np.einsum("ek,ekl,el->e", r, W, r).reshape(SEGMENTS, cells).sum(0)
    H = np.block([[upper, mixed], [mixed.T, np.diag(lower)]])
    g = np.concatenate(
        [np.einsum("ekp,ek->p", J, v), (r * v).sum(1).reshape(SEGMENTS, cells).sum(0)]
    )
    depth = path.log_rho.reshape(window.cells)
    bound = bond_matrix(*bonds(depth, prior.smooth, EDGE)[:2])
    H[FREE:, FREE:] += bound
    g[FREE:] += np.einsum("ij,j->i", bound, path.log_rho)
    H[FREE:, FREE:] += prior.relief * np.eye(cells)
    g[FREE:] += prior.relief * (path.log_rho - path.log_rho.mean())
    known, side, _ = priors_of_rows(prior, unit, half)
    H[:FREE, :FREE] += known
    g[:FREE] += known @ now - side
    gauge = gauge_of_rows(path, unit, len(g))
    H = H + 100 * np.trace(upper) / FREE * gauge[:, None] * gauge
    return H + np.diag(1e-3 * np.diag(H) + 1e-6), g, now, unit


def bond_matrix(across: NDArray, down: NDArray) -> NDArray[np.float64]:
    """Of the sum of squares of differences to the cells before, with these weights."""
    number = np.arange(across.size).reshape(across.shape)
    found = np.zeros((across.size, across.size))
    for a, b, weight in (
        (number[:, 1:], number[:, :-1], across[:, 1:]), (number[1:], number[:-1], down[1:]),
    ):  # fmt: skip
        a, b, weight = a.ravel(), b.ravel(), weight.ravel()
        for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            np.add.at(found, (i, j), sign * weight)
    return found


def step(path: Path, H: NDArray, g: NDArray, now: NDArray, unit: NDArray, degree: int) -> Path:
    """The path after a step, whose rows above `degree` stay."""
    moves = np.ones(len(g), bool)
    moves[:FREE] = np.repeat(np.tile(np.arange(K) <= degree, 2), 3)
    change = np.zeros(len(g))
    # LAPACK would wake BLAS's threads, which spin then: half of the CPU seconds of all starts.
    free, down = H[np.ix_(moves, moves)], -g[moves]
    factorise(free)
    substitute(free, down)
    change[moves] = down
    if not np.isfinite(change).all():
        return path
    change *= limit_step(change[:FREE])
    path = with_rows(path, (now + change[:FREE]) * unit)
    deeper = np.clip(change[FREE:], -DEEPEST, DEEPEST)
    return normalised(Path(path.O, path.D, path.log_rho + deeper.astype(path.log_rho.dtype)))


def score(window: Window, path: Path) -> float:
    """What selects among paths: the mean over blocks of n (log S - 1.5 log n) / N."""
    _, X, Y = warped(path, window)
    both = np.empty((2, *window.shape), X.dtype)
    S, n = (np.empty(tuple(size // BLOCK for size in window.shape)) for _ in range(2))
    work = np.empty(window.shape, X.dtype)
    images.block_sums(X, Y, window.p, window.corner, BLOCK, both, work, S, n)
    S, n = S[n > 5], n[n > 5]
    return float((n * (np.log(S + 1e-6) - 1.5 * np.log(n))).sum()) / max(len(X), 1)
