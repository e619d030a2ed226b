"""Normal equations solved by preconditioned conjugate gradients, for one or several right sides.

A turn and depths that are all nearer or farther move the image about alike. Conjugate gradients
come last to what so little distinguishes, unless the preconditioner knows both. So path and smooth
depths are solved exactly: smooth depths are those between coarse nodes by bilinear interpolation,
and with P for that the matrix P' H P is made and factorised (Cholesky). Map and single depths have
diagonal preconditioners.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle.residuals import (
    Direction,
    ResidualJacobian,
    multiply_jacobian,
    multiply_transpose,
    subtract_mean,
)
from jaxevent.egomotion.bundle.warp import N_COEFFICIENT_ROWS, bilinear_weight

NODES_PER_COARSE_NODE = 4  # nodes, 16 px, between coarse nodes
MAX_BLOCK_CG_STEPS = 240
STEPS_PER_CONVERGENCE_CHECK = 10  # block steps, in which the unknowns of the sides converge ...
CONVERGED_RELATIVE_CHANGE = 0.1  # ... if they grow by less than this
MIN_RELATIVE_EIGENVALUE = 1e-11  # by the largest; directions below repeat others
MIN_EIGENVALUE = 1e-30  # directions below are solved
N_CACHED_VALUES = 1024  # of all columns that a core's own memory holds together


class BlockVector(NamedTuple):
    """Unknowns of the bundle adjustment, or as many numbers.

    Attributes:
        map: (height, width) of the map.
        t: (n,) of the path, with the skew and the plane.
        depth: (rows, columns) of the depths.
    """

    map: NDArray
    t: NDArray[np.float64]
    depth: NDArray


class System(NamedTuple):
    """Normal matrix H, as its factors, and its preconditioner.

    `coefficient_jacobian` makes polynomials' coefficients of the path's unknowns. Bonds are weights
    of the squared differences of log depth to the nodes before.

    Attributes:
        jacobian: Derivatives of the residuals.
        weight: (E,) weights of the residuals.
        information: Information of an event of weight 1.
        begin: (series + 1,) first row of each series of events, and E.
        coefficient_jacobian: Derivatives of polynomials' coefficients by the path's unknowns.
        path_prior: (n, n) priors on the path's unknowns, with damping.
        flat: Weight of squared differences of the map's pixels.
        ridge: Weight of the map's squares.
        map_damping: (height, width) damping of the map.
        depth_damping: (rows, columns) damping of the depths.
        across: (rows, columns) bonds to the column before.
        down: (rows, columns) bonds to the row before.
        preconditioner_map: (height, width) preconditioner of the map.
        preconditioner_depth: (rows, columns) preconditioner of the depths.
        preconditioner_coarse: (m, m) Cholesky factor of P' H P.
        coefficients: (6, N_COEFFICIENT_ROWS) scratch.
        more: (n - 6 N_COEFFICIENT_ROWS,) scratch.
        side: (m,) scratch.
    """

    jacobian: ResidualJacobian
    weight: NDArray
    information: float
    begin: NDArray[np.int64]
    coefficient_jacobian: NDArray[np.float64]
    path_prior: NDArray[np.float64]
    flat: float
    ridge: float
    map_damping: NDArray
    depth_damping: NDArray
    across: NDArray
    down: NDArray
    preconditioner_map: NDArray
    preconditioner_depth: NDArray
    preconditioner_coarse: NDArray[np.float64]
    coefficients: NDArray
    more: NDArray
    side: NDArray[np.float64]


def coarse_shape(rows: int, columns: int) -> tuple[int, int]:
    """Return the shape of the coarse nodes over nodes of depth.

    Args:
        rows: Rows of nodes of depth.
        columns: Columns of nodes of depth.

    Returns:
        Rows and columns.
    """
    return (rows - 1) // NODES_PER_COARSE_NODE + 2, (columns - 1) // NODES_PER_COARSE_NODE + 2


@njit_fastmath_inlined
def _coarse_node(j, i, corner, columns):
    """Return the coarse node at one of four corners about a node, and its weight.

    Args:
        j: Row of the node of depth.
        i: Column of the node of depth.
        corner: 0 to 3: upper left, upper right, lower left, lower right.
        columns: Number of columns of coarse nodes.

    Returns:
        Number of the coarse node, counted row by row, and its weight in the bilinear interpolation.
    """
    row, column = j // NODES_PER_COARSE_NODE, i // NODES_PER_COARSE_NODE
    u, v = (
        (i - column * NODES_PER_COARSE_NODE) / NODES_PER_COARSE_NODE,
        (j - row * NODES_PER_COARSE_NODE) / NODES_PER_COARSE_NODE,
    )
    node = (row + corner // 2) * columns + column + corner % 2
    return node, bilinear_weight(u, v, corner)


@njit_fastmath
def _add_depth_priors(hold, across, down, begin, out):
    """Add damping and bonds of depths to P' H P, in place.

    Args:
        hold: (rows, columns) damping of log depths at nodes.
        across: (rows, columns) bonds to the column before.
        down: (rows, columns) bonds to the row before.
        begin: Row of the first coarse node in `out`.
        out: (n + m, n + m) matrix P' H P of the path's unknowns and of coarse depths.
    """
    rows, columns = hold.shape
    wide = (columns - 1) // NODES_PER_COARSE_NODE + 2
    for j in range(rows):
        for i in range(columns):
            for p in range(4):
                k, a = _coarse_node(j, i, p, wide)
                for q in range(4):
                    m, b = _coarse_node(j, i, q, wide)
                    out[begin + k, begin + m] += hold[j, i] * a * b
            for axis in range(2):
                bond = (down[j, i] if j else 0.0) if axis else (across[j, i] if i else 0.0)
                if bond == 0:
                    continue
                above, left = (1, 0) if axis else (0, 1)
                for p in range(8):
                    k, a = _coarse_node(j - above * (p // 4), i - left * (p // 4), p % 4, wide)
                    a = a if p < 4 else -a
                    for q in range(8):
                        m, b = _coarse_node(j - above * (q // 4), i - left * (q // 4), q % 4, wide)
                        out[begin + k, begin + m] += bond * a * (b if q < 4 else -b)


@njit_fastmath
def cholesky(matrix):
    """Factorise a matrix in place, below the diagonal; the diagonal holds reciprocals."""
    for i in range(len(matrix)):
        row = matrix[i]
        for k in range(i + 1):
            other, s = matrix[k], row[k]
            for m in range(k):
                s -= row[m] * other[m]
            if k < i:
                row[k] = s * other[k]
            else:
                row[k] = 1 / np.sqrt(max(s, 1e-12 * row[k], 1e-30))


@njit_fastmath
def cholesky_solve(lower, side):
    """Solve a system for one right side, in place, by the factor of `cholesky`.

    Args:
        lower: (n, n) factor; its diagonal holds reciprocals.
        side: (n,) right side, overwritten by the solution.
    """
    for i in range(len(side)):
        row, s = lower[i], side[i]
        for k in range(i):
            s -= row[k] * side[k]
        side[i] = s * row[i]
    for i in range(len(side) - 1, -1, -1):
        row, s = lower[i], side[i] * lower[i, i]
        side[i] = s
        for k in range(i):
            side[k] -= row[k] * s


def coarse_factor(
    blocks: tuple[NDArray, NDArray, NDArray],
    hold: NDArray[np.float64],
    bonds: tuple[NDArray, NDArray],
) -> NDArray[np.float64]:
    """Factorise P' H P of path and coarse depths.

    Args:
        blocks: The path's block (n, n), coarse depths by path (m, n), and coarse depths (m, m).
        hold: (rows, columns) damping of depths.
        bonds: Bonds to the column and to the row before, (rows, columns) each.

    Returns:
        The Cholesky factor (n + m, n + m).
    """
    upper, mixed, smooth = blocks
    lower = np.block([[upper, mixed.T], [mixed, smooth]])
    _add_depth_priors(hold, *bonds, len(upper), lower)
    # Single precision makes up the smallest eigenvalues.
    diagonal = np.arange(len(lower))
    lower[diagonal, diagonal] *= 1 + 1e-5
    lower[diagonal, diagonal] += 1e-3
    cholesky(lower)
    return lower


@njit_fastmath
def precondition_path_and_depths(system, t, depth, out_t, out_depth):
    """Apply the preconditioner to the unknowns of path and depths.

    Args:
        system: `System`; its `side` is scratch.
        t: (n,) unknowns of the path.
        depth: (rows, columns) log depths at nodes.
        out_t: (n,) output.
        out_depth: (rows, columns) output.
    """
    side, n, (rows, columns) = system.side, len(t), depth.shape
    wide = (columns - 1) // NODES_PER_COARSE_NODE + 2
    for i in range(n):
        side[i] = t[i]
    for i in range(n, len(side)):
        side[i] = 0
    for j in range(rows):
        for i in range(columns):
            out_depth[j, i] = depth[j, i] * system.preconditioner_depth[j, i]
            for p in range(4):
                k, share = _coarse_node(j, i, p, wide)
                side[n + k] += share * depth[j, i]
    cholesky_solve(system.preconditioner_coarse, side)
    for i in range(n):
        out_t[i] = side[i]
    for j in range(rows):
        for i in range(columns):
            for p in range(4):
                k, share = _coarse_node(j, i, p, wide)
                out_depth[j, i] += share * side[n + k]


@njit_fastmath_inlined
def _add_prior_products(system, vector, out):
    """Add the products of the priors' part of H with map and depths, in place.

    Args:
        system: `System`.
        vector: `BlockVector` that is multiplied.
        out: `BlockVector` that the products are added to.
    """
    map_, depth, out_depth, lumped = vector.map, vector.depth, out.depth, system.depth_damping
    across, down, (height, width) = system.across, system.down, map_.shape
    real = map_.dtype.type
    flat, ridge = real(system.flat), real(system.ridge)
    for j in range(height):
        row, above, below = map_[j], map_[max(j - 1, 0)], map_[min(j + 1, height - 1)]
        to, own = out.map[j], system.map_damping[j]
        for i in range(1, width - 1):
            four = real(4) * row[i] - row[i - 1] - row[i + 1] - above[i] - below[i]
            to[i] += flat * four + (ridge + own[i]) * row[i]
        for i, beside in ((0, 1), (width - 1, width - 2)):
            four = real(3) * row[i] - row[beside] - above[i] - below[i]
            to[i] += flat * four + (ridge + own[i]) * row[i]
    rows, columns = depth.shape
    for j in range(rows):
        for i in range(columns):
            out_depth[j, i] += lumped[j, i] * depth[j, i]
            if i:
                apart = across[j, i] * (depth[j, i] - depth[j, i - 1])
                out_depth[j, i] += apart
                out_depth[j, i - 1] -= apart
            if j:
                apart = down[j, i] * (depth[j, i] - depth[j - 1, i])
                out_depth[j, i] += apart
                out_depth[j - 1, i] -= apart


@njit_fastmath
def multiply(system, vector, value, out):
    """Multiply H by a vector.

    Args:
        system: `System`; its `coefficients` and `more` are scratch.
        vector: `BlockVector` that is multiplied.
        value: (E,) scratch.
        out: `BlockVector`, output.
    """
    jacobian, real, t, out_t = system.jacobian, vector.map.dtype.type, vector.t, out.t
    n, m = len(t), 6 * N_COEFFICIENT_ROWS
    coefficients, more = system.coefficients, system.more
    for k in range(m):
        s = 0.0
        for i in range(m):
            s += system.coefficient_jacobian[k, i] * t[i]
        coefficients[k // N_COEFFICIENT_ROWS, k % N_COEFFICIENT_ROWS] = s
    for i in range(m, n):
        more[i - m] = t[i]
    flat, nodes = vector.map.reshape(-1), vector.depth.reshape(-1)
    multiply_jacobian(jacobian, Direction(flat, coefficients, more, nodes), value)
    subtract_mean(value, system.weight, system.begin)
    scale = real(system.information)
    for e in range(len(value)):
        value[e] *= scale * system.weight[e]
    to_map, to_depth = out.map.reshape(-1), out.depth.reshape(-1)
    multiply_transpose(jacobian, value, Direction(to_map, coefficients, more, to_depth))
    for i in range(m):
        out_t[i] = 0.0
        for k in range(m):
            out_t[i] += (
                system.coefficient_jacobian[k, i]
                * coefficients[k // N_COEFFICIENT_ROWS, k % N_COEFFICIENT_ROWS]
            )
    for i in range(m, n):
        out_t[i] = more[i - m]
    for i in range(n):
        for k in range(n):
            out_t[i] += system.path_prior[i, k] * t[k]
    _add_prior_products(system, vector, out)


@njit_fastmath_inlined
def _dot(a, b):
    """Return the scalar product of two vectors.

    Args:
        a: (n,).
        b: (n,).

    Returns:
        a' b.
    """
    s = 0.0
    for i in range(len(a)):
        s += a[i] * b[i]
    return s


def conjugate_gradients(
    system: System, side: BlockVector, steps: int, tolerance: float
) -> tuple[BlockVector, int]:
    """Solve H x = side by conjugate gradients from 0.

    Args:
        system: H and its preconditioner.
        side: Right side.
        steps: Most steps.
        tolerance: Size of the residual at the end by its first size, as the preconditioner
            measures it.

    Returns:
        x, and the number of steps taken.
    """
    residual = BlockVector(*(part.copy() for part in side))
    vectors = residual, *(BlockVector(*(np.zeros_like(part) for part in side)) for _ in range(4))
    value = np.empty(len(system.weight), side.map.dtype)
    done = _conjugate_gradients(system, vectors, steps, tolerance, value)
    return vectors[1], done


@njit_fastmath_inlined
def _flat(vector):
    """Return map, path and depths of a vector, each flat."""
    return vector.map.reshape(-1), vector.t, vector.depth.reshape(-1)


@njit_fastmath
def _conjugate_gradients(system, vectors, steps, tolerance, value):
    """Solve H x = side by conjugate gradients, in place; see `conjugate_gradients`.

    Args:
        system: `System`.
        vectors: Five `BlockVector`s: the right side, which becomes the residual; x, which is 0; and
            three of scratch.
        steps: Most steps.
        tolerance: Relative size of the residual at which steps end.
        value: (E,) scratch.

    Returns:
        Number of steps taken.
    """
    residual, found, direction, out, better = vectors
    (q, left_t, b), (p, found_t, a), (d, way_t, c) = _flat(residual), _flat(found), _flat(direction)
    (r, out_t, g), (_, better_t, h) = _flat(out), _flat(better)
    ease, s = system.preconditioner_map.reshape(-1), 0.0
    for i in range(len(p)):
        d[i] = q[i] * ease[i]
    precondition_path_and_depths(system, left_t, residual.depth, way_t, direction.depth)
    size = _dot(q, d) + _dot(left_t, way_t) + _dot(b, c)
    first, done = size, 0
    while done < steps and size > tolerance * tolerance * first:
        done += 1
        multiply(system, direction, value, out)
        s = _dot(d, r) + _dot(way_t, out_t) + _dot(c, g)
        length = size / max(s, 1e-30)
        step = out.map.dtype.type(length)
        new = 0.0
        for i in range(len(p)):
            p[i] += step * d[i]
            q[i] -= step * r[i]
            new += q[i] * q[i] * ease[i]
        for i in range(len(way_t)):
            found_t[i] += length * way_t[i]
            left_t[i] -= length * out_t[i]
        for i in range(len(a)):
            a[i] += step * c[i]
            b[i] -= step * g[i]
        precondition_path_and_depths(system, left_t, residual.depth, better_t, better.depth)
        new += _dot(left_t, better_t) + _dot(b, h)
        share = new / max(size, 1e-30)
        more = out.map.dtype.type(share)
        for i in range(len(p)):
            d[i] = ease[i] * q[i] + more * d[i]
        for i in range(len(way_t)):
            way_t[i] = better_t[i] + share * way_t[i]
        for i in range(len(a)):
            c[i] = h[i] + more * c[i]
        size = new
    return done


class ColumnVectors(NamedTuple):
    """Several vectors of unknowns.

    Attributes:
        t: (S, n) of the path.
        rest: (S, N) of the map and the depths.
    """

    t: NDArray[np.float64]
    rest: NDArray

    def copy(self) -> "ColumnVectors":
        """Return a copy."""
        return ColumnVectors(self.t.copy(), self.rest.copy())


@njit_fastmath
def add_inner_products(a, b, out):
    """Add a b' to a matrix, in place, a part at a time: single precision would not hold all.

    Args:
        a: (S, N) rows.
        b: (S, N) rows.
        out: (S, S) matrix, in double precision.
    """
    for begin in range(0, a.shape[1], N_CACHED_VALUES):
        for k in range(len(a)):
            one = a[k, begin : begin + N_CACHED_VALUES]
            for c in range(len(b)):
                other, s = b[c, begin : begin + N_CACHED_VALUES], a.dtype.type(0)
                for i in range(len(one)):
                    s += one[i] * other[i]
                out[k, c] += s


@njit_fastmath
def _add_combinations(by, a, out):
    """Add linear combinations of rows, by' a, to other rows in place.

    Args:
        by: (S, S) factors.
        a: (S, N) rows.
        out: (S, N) rows that are added to.
    """
    for begin in range(0, a.shape[1], N_CACHED_VALUES):
        for c in range(len(out)):
            to = out[c, begin : begin + N_CACHED_VALUES]
            for k in range(len(a)):
                one, share = a[k, begin : begin + N_CACHED_VALUES], by[k, c]
                for i in range(len(one)):
                    to[i] += share * one[i]


def _inner_products(a: ColumnVectors, b: ColumnVectors) -> NDArray[np.float64]:
    """Return the scalar products of several vectors.

    Args:
        a: S vectors.
        b: S vectors.

    Returns:
        (S, S) a' b.
    """
    found = a.t @ b.t.T
    add_inner_products(a.rest, b.rest, found)
    return found


def _add_scaled(to: ColumnVectors, by: NDArray, direction: ColumnVectors) -> None:
    """Add combinations of vectors, in place.

    Args:
        to: S vectors, added to.
        by: (S, S); column k holds the factors of the directions in the sum that vector k gets.
        direction: S vectors.
    """
    to.t[:] += by.T @ direction.t
    _add_combinations(by.astype(to.rest.dtype), direction.rest, to.rest)


def solve_columns(system: System, sides: NDArray[np.float64]) -> ColumnVectors:
    """Solve H x = side for several right sides, zero in map and depths, by block CG.

    The steps search the span of all sides' directions (O'Leary, "The block conjugate gradient
    algorithm and related methods", 1980): one side alone comes last to poorly determined
    directions. The iteration ends when the sides' own unknowns, which grow, have settled.

    Args:
        system: H, undamped, and its preconditioner.
        sides: (S, n) right sides of the path's unknowns.

    Returns:
        The solutions. If single precision fails, those found before, or NaN.
    """
    shape, nodes = system.preconditioner_map.shape, system.across.shape
    size, number, real = system.preconditioner_map.size, len(sides), system.preconditioner_map.dtype
    value = np.empty(len(system.weight), real)

    def blank() -> ColumnVectors:
        rest = np.zeros((number, size + system.across.size), real)
        return ColumnVectors(np.zeros(sides.shape), rest)

    def vector(columns: ColumnVectors, k: int) -> BlockVector:
        rest = columns.rest[k]
        return BlockVector(rest[:size].reshape(shape), columns.t[k], rest[size:].reshape(nodes))

    def precondition(given: ColumnVectors, out: ColumnVectors) -> None:
        for k in range(number):
            one, to = vector(given, k), vector(out, k)
            np.multiply(one.map, system.preconditioner_map, out=to.map)
            precondition_path_and_depths(system, one.t, one.depth, to.t, to.depth)

    found, left, better, image = (blank() for _ in range(4))
    left.t[:] = sides
    precondition(left, better)
    direction, known = better.copy(), np.zeros(number)
    before = ColumnVectors(np.full_like(found.t, np.nan), np.full_like(found.rest, np.nan))
    for step in range(1, MAX_BLOCK_CG_STEPS + 1):
        for k in range(number):
            multiply(system, vector(direction, k), value, vector(image, k))
        energy = _inner_products(direction, image)
        if not np.isfinite(energy).all():
            return before
        # Directions that nearly repeat others count by their new part.
        sizes, axes = np.linalg.eigh((energy + energy.T) / 2)
        kept = sizes > max(MIN_RELATIVE_EIGENVALUE * sizes[-1], MIN_EIGENVALUE)
        if not kept.any():
            return found
        inverse = axes[:, kept] / sizes[kept] @ axes[:, kept].T
        length = inverse @ _inner_products(direction, left)
        _add_scaled(found, length, direction)
        _add_scaled(left, -length, image)
        precondition(left, better)
        share = -inverse @ _inner_products(image, better)
        _add_scaled(better, share, direction)
        # Scaled to size 1, lest they vanish or overflow.
        sizes = np.maximum(np.abs(better.t).max(1), [np.abs(row).max() for row in better.rest])
        scale = 1 / np.maximum(sizes, 1e-30)
        np.multiply(better.t, scale[:, None], out=direction.t)
        np.multiply(better.rest, scale[:, None].astype(real), out=direction.rest)
        if step % STEPS_PER_CONVERGENCE_CHECK == 0:
            now = (sides * found.t).sum(1)
            if not (now >= (1 - CONVERGED_RELATIVE_CHANGE) * known).all():
                return before
            if (np.abs(now - known) <= CONVERGED_RELATIVE_CHANGE * np.abs(now)).all():
                break
            known, before = now, found.copy()
    return found
