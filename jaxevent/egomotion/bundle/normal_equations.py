"""Normal equations of the photometric bundle adjustment, and their solution.

Unknowns are (map, path's rows with skew and plane, depths at nodes).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit_fastmath, njit_fastmath_inlined
from jaxevent.egomotion.bundle import cg, warp
from jaxevent.egomotion.bundle.residuals import (
    Direction,
    FreeUnknowns,
    MapSamples,
    PixelSeries,
    ResidualJacobian,
    RobustLoss,
    Scene,
    WeightScratch,
    bspline,
    multiply_jacobian,
    multiply_transpose,
    residual_jacobian,
    robust_weights,
    sample_map,
    subtract_mean,
)

# Numbers of a path's rows; after them come the skew and the plane's normal.
N_PATH_UNKNOWNS = 6 * warp.N_COEFFICIENT_ROWS
NODE_EDGE_LOG_DEPTH = 0.1  # a larger difference of log depth between nodes is an edge
# Less accurate solutions save a sixth of the time and lose 0.3 degrees of heading on slider_depth.
MAX_CG_STEPS, CG_TOLERANCE = 40, 0.01
SINGLE_COLUMN_CG_TOLERANCE = 1e-3  # likewise, of a column of H^-1 that is solved by itself
MAP_RIDGE_WEIGHT = 1e-5  # weight of the map's squares
MAX_SKEW_SIGMAS = 2.0  # standard deviations of its prior by which the skew may be off
N_SIMD_LANES = 8  # numbers that a core multiplies at once
ROWS_PER_SINGLE_PRECISION_SUM = 64  # rows whose squares single precision sums

Unknowns = tuple[NDArray, NDArray, NDArray]


class BlockScratch(NamedTuple):
    """Scratch memory of `path_blocks`: a batch of weighted rows, a mean, and the rows' products."""

    rows: NDArray  # (ROWS_PER_SINGLE_PRECISION_SUM, n, rounded up)
    weight: NDArray  # (ROWS_PER_SINGLE_PRECISION_SUM,)
    mean: NDArray  # (n, rounded up)
    part: NDArray  # (n, n, rounded up)

    @classmethod
    def of(cls, n: int, real: np.dtype) -> "BlockScratch":
        """Allocate the scratch memory.

        Args:
            n: Number of the path's unknowns.
            real: Type of the numbers.

        Returns:
            The memory, all 0.
        """
        wide = -(-n // N_SIMD_LANES) * N_SIMD_LANES
        rows, part = (
            np.zeros((ROWS_PER_SINGLE_PRECISION_SUM, wide), real),
            np.zeros((n, wide), real),
        )
        return cls(rows, np.zeros(ROWS_PER_SINGLE_PRECISION_SUM, real), np.zeros(wide, real), part)


@njit_fastmath_inlined
def _write_jacobian_row(jacobian, e, row):
    """Write the derivatives of one residual by the path's unknowns.

    Args:
        jacobian: `ResidualJacobian`.
        e: Number of the residual.
        row: Output: derivatives by the coefficients, axis by axis, and then by `more`.
    """
    t = jacobian.tau[e]
    for axis in range(6):
        value = jacobian.base[axis, e]
        for k in range(warp.N_COEFFICIENT_ROWS):
            value *= t
            row[axis * warp.N_COEFFICIENT_ROWS + k] = value
    for k in range(len(jacobian.more)):
        row[6 * warp.N_COEFFICIENT_ROWS + k] = jacobian.more[k, e]


@njit_fastmath_inlined
def _add_outer_products(scratch, number, upper):
    """Add rows' diag(weight) rows of a batch of rows, on and below the diagonal.

    Args:
        scratch: `BlockScratch` with rows and weights.
        number: Number of rows of the batch that count.
        upper: (n, n) matrix, changed in place.
    """
    rows, weight, _, part = scratch
    part[:] = 0
    for r in range(number, (number + 3) // 4 * 4):
        weight[r] = 0
    for r in range(0, number, 4):
        p, q, s, t = rows[r], rows[r + 1], rows[r + 2], rows[r + 3]
        f, g, h, o = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
        for i in range(len(upper)):
            a, b, c, d = f * p[i], g * q[i], h * s[i], o * t[i]
            to = part[i]
            for k in range(i // N_SIMD_LANES * N_SIMD_LANES + N_SIMD_LANES):
                to[k] += a * p[k] + b * q[k] + c * s[k] + d * t[k]
    for i in range(len(upper)):
        for k in range(i + 1):
            upper[i, k] += part[i, k]


@njit_fastmath_inlined
def _coarse_corner(jacobian, e):
    """Return the first of the four coarse nodes about an event, and the event's place between them.

    Args:
        jacobian: `ResidualJacobian`.
        e: Number of the event.

    Returns:
        Number of the node above and to the left, counted row by row, and the distance from it to
            the
        right and downwards, 0 to 1 coarse nodes.
    """
    columns = jacobian.columns
    row = jacobian.node[e] // columns
    x, y = jacobian.node[e] - row * columns + jacobian.across[e], row + jacobian.down[e]
    i, j = int(x / cg.NODES_PER_COARSE_NODE), int(y / cg.NODES_PER_COARSE_NODE)
    wide = (columns - 1) // cg.NODES_PER_COARSE_NODE + 2
    return j * wide + i, x / cg.NODES_PER_COARSE_NODE - i, y / cg.NODES_PER_COARSE_NODE - j


@njit_fastmath
def path_blocks(jacobian, weight, begin, scratch, path_block, coupling):
    """Write the blocks of J' W J of the path, and of coarse depths by the path.

    Args:
        jacobian: `ResidualJacobian`.
        weight: (E,) weights of events.
        begin: (series + 1,) rows of series.
        scratch: `BlockScratch`.
        path_block: (n, n) output, coefficients axis by axis, each with its powers, and `more`.
        coupling: (coarse nodes, n) output.
    """
    wide = (jacobian.columns - 1) // cg.NODES_PER_COARSE_NODE + 2
    rows, weights, mean, _ = scratch
    n, filled, series = len(path_block), 0, len(begin) - 1
    path_block[:] = 0
    coupling[:] = 0
    for one in range(series):
        start, stop = begin[one], begin[one + 1]
        total, row = 0.0, rows[filled]
        mean[:] = 0
        for e in range(start, stop):
            _write_jacobian_row(jacobian, e, row)
            total += weight[e]
            for k in range(n):
                mean[k] += weight[e] * row[k]
        less = mean.dtype.type(1 / max(total, 1e-3))
        for e in range(start, stop):
            row = rows[filled]
            _write_jacobian_row(jacobian, e, row)
            for k in range(n):
                row[k] -= less * mean[k]
            weights[filled] = weight[e]
            at, u, v = _coarse_corner(jacobian, e)
            for p in range(4):
                to = coupling[at + p % 2 + p // 2 * wide]
                factor = weight[e] * jacobian.by_depth[e] * warp.bilinear_weight(u, v, p)
                scale = weight.dtype.type(factor)
                for k in range(n):
                    to[k] += scale * row[k]
            filled += 1
            if filled == len(rows) or (one == series - 1 and e == stop - 1):
                _add_outer_products(scratch, filled, path_block)
                filled = 0
    for i in range(n):
        for k in range(i):
            path_block[k, i] = path_block[i, k]


@njit_fastmath
def depth_blocks(jacobian, weight, begin, scratch, coarse_block, lumped):
    """Write the block of J' W J of coarse depths, and the sums of the rows of that of nodes.

    Args:
        jacobian: `ResidualJacobian`.
        weight: (E,) weights of events.
        begin: (series + 1,) rows of series.
        scratch: Of coarse nodes (m,): a mean, indices of those in it, and the last series of each.
        coarse_block: (m, m) output.
        lumped: (nodes,) output, without the means of series.
    """
    columns = jacobian.columns
    wide = (columns - 1) // cg.NODES_PER_COARSE_NODE + 2
    mean, touched, latest = scratch
    latest[:] = -1
    coarse_block[:] = 0
    lumped[:] = 0
    for one in range(len(begin) - 1):
        total, number = 0.0, 0
        for e in range(begin[one], begin[one + 1]):
            w, by = weight[e], jacobian.by_depth[e]
            total += w
            for p in range(4):
                share = warp.bilinear_weight(jacobian.across[e], jacobian.down[e], p)
                lumped[jacobian.node[e] + p % 2 + p // 2 * columns] += w * by * by * share
            at, u, v = _coarse_corner(jacobian, e)
            for p in range(4):
                k, value = at + p % 2 + p // 2 * wide, w * by * warp.bilinear_weight(u, v, p)
                if latest[k] != one:
                    latest[k], touched[number], mean[k] = one, k, 0
                    number += 1
                mean[k] += value
                for q in range(4):
                    product = value * by * warp.bilinear_weight(u, v, q)
                    coarse_block[k, at + q % 2 + q // 2 * wide] += product
        total = max(total, 1e-3)
        for p in range(number):
            k = touched[p]
            for q in range(number):
                coarse_block[k, touched[q]] -= mean[k] * mean[touched[q]] / total


@njit_fastmath
def map_diagonal(jacobian, weight, diagonal):
    """Compute the diagonal of the map's block of J' W J, without the means of series.

    Args:
        jacobian: `ResidualJacobian`.
        weight: (E,) weights of events.
        diagonal: (height * width,) output.
    """
    diagonal[:] = 0
    for e in range(len(weight)):
        k, w = jacobian.first[e], weight[e]
        for i in range(3):
            for j in range(3):
                share = bspline(i, jacobian.v[e]) * bspline(j, jacobian.u[e])
                diagonal[k + i * jacobian.width + j] += w * share * share


class Problem(NamedTuple):
    """Data and settings of a bundle adjustment, the same in all of its steps.

    Attributes:
        series: Events of the window.
        prior: Prior knowledge.
        sigma: Standard deviation of residuals, C.
        plane: Whether depths are a plane's.
        typical_cost: Cost of positions from which events count less, C^2.
    """

    series: PixelSeries
    prior: warp.Prior
    sigma: float
    plane: bool
    typical_cost: float

    @property
    def loss(self) -> RobustLoss:
        """Scales of the robust cost."""
        return RobustLoss((3 * self.sigma) ** 2, self.typical_cost, self.plane)

    @property
    def information(self) -> float:
        """Information of an event of weight 1 (1/C^2); `alike` neighbours count as one."""
        return 1 / (float(self.prior.alike) * self.sigma**2)

    def path_prior(self, unit: NDArray) -> tuple[NDArray, NDArray, float]:
        """Return the cost of the priors on path and skew as t' K t / 2 - b' t + c.

        Args:
            unit: (N_PATH_UNKNOWNS,) units of the path's rows, see `warp.row_units`.

        Returns:
            K, b and c; t are the unknowns of `path_unknowns`.
        """
        K, b, c = warp.row_priors(self.prior, unit, self.series.half)
        matrix, side = (
            np.zeros((N_PATH_UNKNOWNS + 4, N_PATH_UNKNOWNS + 4)),
            np.zeros(N_PATH_UNKNOWNS + 4),
        )
        matrix[:N_PATH_UNKNOWNS, :N_PATH_UNKNOWNS], side[:N_PATH_UNKNOWNS] = K, b
        weight, skew = float(self.prior.skew_weight), float(self.prior.skew)
        matrix[N_PATH_UNKNOWNS, N_PATH_UNKNOWNS], side[N_PATH_UNKNOWNS] = weight, weight * skew
        return matrix, side, c + weight * skew**2 / 2


class Evaluation(NamedTuple):
    """Residuals, weights and cost of a scene.

    Attributes:
        scene: The scene.
        samples: Projections of events, and the map's values there.
        residual: (E,) residuals before the means of series are subtracted, C.
        weight: (E,) weights.
        objective: Sum that steps reduce: robust cost and priors.
        cost: Robust cost per event, C^2.
    """

    scene: Scene
    samples: MapSamples
    residual: NDArray
    weight: NDArray
    objective: float
    cost: float


def path_unknowns(scene: Scene, unit: NDArray) -> NDArray[np.float64]:
    """Return the unknowns of the path's block at a scene.

    Args:
        scene: The scene.
        unit: (N_PATH_UNKNOWNS,) units of the path's rows, see `warp.row_units`.

    Returns:
        (N_PATH_UNKNOWNS + 4,): the path's rows in these units, the skew, and 0 for the change of
            the
        plane.
    """
    return np.concatenate([warp.pack_rows(scene.path) / unit, [scene.skew, 0, 0, 0]])


def laplacian(image: NDArray) -> NDArray:
    """Return each pixel's sum of differences to its neighbours, pixel less neighbour."""
    found = np.zeros_like(image)
    for axis in (0, 1):
        apart = np.diff(image, axis=axis)
        before, after = (np.moveaxis(found, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        before -= np.moveaxis(apart, axis, 0)
        after += np.moveaxis(apart, axis, 0)
    return found


def evaluate(
    problem: Problem, scene: Scene, weight: NDArray, before: Evaluation | None = None
) -> Evaluation:
    """Evaluate a scene, scaled to |C1| = 1, with a skew near that of its prior.

    Args:
        problem: Data and settings.
        scene: Scene to evaluate.
        weight: (E,) weights of the step before.
        before: Evaluation of a similar scene. Its projections are taken if its path is the same
            object.

    Returns:
        The scaled scene with its residuals, weights and cost.
    """
    series, prior, _, plane, _ = problem
    most = MAX_SKEW_SIGMAS / math.sqrt(float(prior.skew_weight))
    skew = min(max(float(scene.skew), prior.skew - most), prior.skew + most)
    same_path = before is not None and before.scene.path is scene.path
    scene = Scene(scene.path if same_path else warp.normalise(scene.path), scene.map, skew)
    samples = sample_map(scene, series, before.samples if before else None, same_path=same_path)
    residual = samples.value - series.level - series.x.dtype.type(scene.skew) * series.count
    weight, scratch = weight.copy(), WeightScratch.of(series.shape, residual)
    of_positions, cost = robust_weights(residual, samples, series, problem.loss, scratch, weight)
    unit = warp.row_units(scene.path, series.f, series.half)
    matrix, side, constant = problem.path_prior(unit)
    t = path_unknowns(scene, unit)
    objective = t @ matrix @ t / 2 - side @ t + constant
    if not plane:
        depth = scene.path.log_rho.reshape(series.nodes)
        objective += warp.smoothness_weights(depth, float(prior.bond), NODE_EDGE_LOG_DEPTH)[2]
    image = scene.map
    differences = sum(float(np.vdot(d, d)) for d in (np.diff(image, axis=k) for k in (0, 1)))
    objective += (
        float(prior.flat) * differences + MAP_RIDGE_WEIGHT * float(np.vdot(image, image))
    ) / 2
    objective += 0.5 * problem.information * of_positions
    number = max(float(samples.inside[: series.n_events].sum()), 1.0)
    return Evaluation(scene, samples, residual, weight, float(objective), float(cost) / number)


class NormalEquations(NamedTuple):
    """Equations H d = -gradient at a scene: blocks of H, which is never made as a whole.

    Attributes:
        problem: The problem.
        evaluation: Residuals and weights at the scene.
        jacobian: Derivatives of the residuals.
        coefficient_jacobian: Derivatives of polynomials' coefficients by the path's unknowns.
        unit: Units of the path's rows.
        t: (n,) unknowns of the path.
        residual: (E,) residuals less the means of series, C.
        diagonal: (height, width) diagonal of the map's block, approximately.
        path_prior: (n, n) matrix of the priors on the path's unknowns.
        path_prior_side: (n,) such that path_prior @ t - path_prior_side is the priors' gradient.
        regularisation: Regularisation of the path's block.
        path_block: (n, n) with priors and regularisation.
        coupling: (coarse nodes, n) depths by path.
        coarse_block: (coarse nodes, coarse nodes) depths without priors.
        lumped: (rows, columns) sums of the rows of the depths' block.
        across: (rows, columns) bonds to the columns before.
        down: (rows, columns) bonds to the rows before.
    """

    problem: Problem
    evaluation: Evaluation
    jacobian: ResidualJacobian
    coefficient_jacobian: NDArray[np.float64]
    unit: NDArray[np.float64]
    t: NDArray[np.float64]
    residual: NDArray
    diagonal: NDArray
    path_prior: NDArray[np.float64]
    path_prior_side: NDArray[np.float64]
    regularisation: NDArray[np.float64]
    path_block: NDArray[np.float64]
    coupling: NDArray[np.float64]
    coarse_block: NDArray[np.float64]
    lumped: NDArray[np.float64]
    across: NDArray[np.float64]
    down: NDArray[np.float64]

    @property
    def n(self) -> int:
        """Number of the path's unknowns, skew and a plane's normal included."""
        return N_PATH_UNKNOWNS + len(self.jacobian.more)

    def jacobian_product(self, v: Unknowns) -> NDArray:
        """Return the changes of residuals (E,) by unknowns, before means are subtracted."""
        image, t, depth = v
        real, value = image.dtype.type, np.empty_like(self.residual)
        coefficients = (
            (self.coefficient_jacobian @ t[:N_PATH_UNKNOWNS])
            .reshape(6, warp.N_COEFFICIENT_ROWS)
            .astype(real)
        )
        more = t[N_PATH_UNKNOWNS : self.n].astype(real)
        direction = Direction(image.ravel(), coefficients, more, depth.astype(real))
        multiply_jacobian(self.jacobian, direction, value)
        return value

    def transpose_product(self, z: NDArray) -> Unknowns:
        """Return J' z of values z (E,)."""
        real, series, n = z.dtype, self.problem.series, len(self.jacobian.more)
        image, depth = np.empty(series.shape, real), np.empty(math.prod(series.nodes), real)
        coefficients, more = np.empty((6, warp.N_COEFFICIENT_ROWS), real), np.empty(n, real)
        multiply_transpose(
            self.jacobian, z, Direction(image.reshape(-1), coefficients, more, depth)
        )
        by_rows = coefficients.ravel() @ self.coefficient_jacobian
        return image, np.concatenate([by_rows, more, np.zeros(4 - n)]), depth


def linearise(problem: Problem, evaluation: Evaluation, map_only: bool) -> NormalEquations:
    """Compute the normal equations of a scene.

    Args:
        problem: Data and settings.
        evaluation: The scene, with residuals and weights.
        map_only: Whether the map alone is free.

    Returns:
        The equations.
    """
    series, prior, _, plane, _ = problem
    scene, weight, real = evaluation.scene, evaluation.weight, series.x.dtype
    path, moves = scene.path, float(prior.moves)
    unit = warp.row_units(path, series.f, series.half)
    median_rho = float(np.exp(np.median(path.log_rho)))
    free = None if map_only else FreeUnknowns(plane, moves, median_rho)
    jacobian = residual_jacobian(scene, series, evaluation.samples, free)
    by = warp.coefficient_jacobian(path, unit, series.half)
    by[:, 3 * warp.N_COEFFICIENT_ROWS :] *= moves
    n = N_PATH_UNKNOWNS + len(jacobian.more)
    residual = evaluation.residual.copy()
    subtract_mean(residual, weight, series.begin)

    coarse = math.prod(cg.coarse_shape(*series.nodes))
    raw, diagonal = np.zeros((n, n)), np.zeros(series.shape, real)
    mixed, coarse_block = np.zeros((coarse, n)), np.zeros((coarse, coarse))
    lumped = np.zeros(series.nodes)
    map_diagonal(jacobian, weight, diagonal.reshape(-1))
    if not map_only:
        path_blocks(jacobian, weight, series.begin, BlockScratch.of(n, real), raw, mixed)
        scratch = np.empty(coarse), np.empty(coarse, np.int64), np.empty(coarse, np.int64)
        depth_blocks(jacobian, weight, series.begin, scratch, coarse_block, lumped.reshape(-1))
    whole = np.zeros((n, N_PATH_UNKNOWNS + 4))
    whole[:N_PATH_UNKNOWNS, :N_PATH_UNKNOWNS], whole[N_PATH_UNKNOWNS:, N_PATH_UNKNOWNS:n] = (
        by,
        np.eye(n - N_PATH_UNKNOWNS),
    )
    information = problem.information
    path_prior, side, _ = problem.path_prior(unit)
    # Changes of the twist and the skew have priors, the rest may be undetermined.
    held = np.append(~warp.is_twist_change(), [False, True, True, True])
    gauge = warp.gauge_direction(path, unit, N_PATH_UNKNOWNS + 4)
    held = np.diag(np.where(held, 1e-3, 0)) + 1e4 * gauge[:, None] * gauge
    path_block = information * whole.T @ raw @ whole + path_prior + held
    depth = path.log_rho.reshape(series.nodes)
    across, down, _ = warp.smoothness_weights(depth, float(prior.bond), NODE_EDGE_LOG_DEPTH)
    if plane:
        across, down = np.zeros_like(across), np.zeros_like(down)
    lumped = information * lumped + 1e-2
    stiff = across + down
    stiff[:, :-1] += across[:, 1:]
    stiff[:-1] += down[1:]
    lumped += 2 * stiff
    # By einsum: larger products wake BLAS's threads, which spin then.
    coupling = np.einsum("ki,ij->kj", mixed, information * whole)
    diagonal = 0.7 * information * diagonal + 4 * float(prior.flat) + MAP_RIDGE_WEIGHT
    return NormalEquations(
        problem, evaluation, jacobian, by, unit, path_unknowns(scene, unit), residual, diagonal,
        path_prior, side, held, path_block, coupling, information * coarse_block, lumped,
        across, down,
    )  # fmt: skip


def gradient(equations: NormalEquations) -> Unknowns:
    """Return the gradient of the objective, with the weights held."""
    problem, evaluation = equations.problem, equations.evaluation
    real, scene, prior = equations.residual.dtype, evaluation.scene, problem.prior
    z = (problem.information * evaluation.weight * equations.residual).astype(real)
    of_map, of_path, of_depth = equations.transpose_product(z)
    depth = scene.path.log_rho.reshape(problem.series.nodes)
    of_bonds = np.zeros(depth.shape)
    for axis, bond in ((1, equations.across), (0, equations.down)):
        pulled = bond * np.diff(depth, axis=axis, prepend=np.take(depth, [0], axis))
        of_bonds += pulled - np.roll(pulled, -1, axis)
    flat, ridge = real.type(prior.flat), real.type(MAP_RIDGE_WEIGHT)
    return (
        of_map + flat * laplacian(scene.map) + ridge * scene.map,
        of_path + equations.path_prior @ equations.t - equations.path_prior_side,
        of_depth + of_bonds.ravel(),
    )


def damped_system(equations: NormalEquations, damping: float) -> cg.System:
    """Return the damped normal matrix and its preconditioner.

    Args:
        equations: The normal equations.
        damping: Fraction by which the diagonal of H is enlarged.

    Returns:
        The system for `cg`.
    """
    series, real = equations.problem.series, equations.evaluation.residual.dtype
    n = equations.n
    damped = damping * np.diag(np.diag(equations.path_block)[:n])
    path_prior = (equations.path_prior + equations.regularisation)[:n, :n] + damped
    hold, bonds = 1e-3 + damping * equations.lumped, (equations.across, equations.down)
    blocks = equations.path_block[:n, :n] + damped, equations.coupling[:, :n]
    lower = cg.coarse_factor((*blocks, equations.coarse_block), hold, bonds)

    def on(values: NDArray) -> NDArray:
        return np.ascontiguousarray(values.astype(real))

    diagonal, lumped = (1 + damping) * equations.diagonal, (1 + damping) * equations.lumped
    return cg.System(
        equations.jacobian, equations.evaluation.weight, equations.problem.information,
        series.begin, equations.coefficient_jacobian, path_prior,
        float(equations.problem.prior.flat), MAP_RIDGE_WEIGHT,
        on(damping * equations.diagonal), on(hold),
        on(bonds[0]), on(bonds[1]), on(1 / diagonal), on(1 / lumped), lower,
        np.empty((6, warp.N_COEFFICIENT_ROWS), real), np.empty(n - N_PATH_UNKNOWNS, real),
        np.empty(len(lower)),
    )  # fmt: skip


def inverse_columns(equations: NormalEquations, rows: list[int]) -> list[Unknowns]:
    """Return columns of the inverse of the undamped normal matrix.

    Args:
        equations: The normal equations.
        rows: Numbers of the path's unknowns.

    Returns:
        For each of these the column of H^-1, times the unknown's own unit.
    """
    n = equations.n
    sides = np.zeros((len(rows), n))
    sides[range(len(rows)), rows] = equations.unit[rows]
    system, shape = damped_system(equations, 0.0), equations.problem.series.shape
    found, size = cg.solve_columns(system, sides), math.prod(shape)
    # Rounding may fail to separate similar directions; a side alone has only one.
    for row in np.flatnonzero(~np.isfinite(found.t).all(1)):
        none, depths = np.zeros(shape, found.rest.dtype), np.zeros_like(system.across)
        side = cg.BlockVector(none, sides[row], depths)
        one, _ = cg.conjugate_gradients(
            system, side, cg.MAX_BLOCK_CG_STEPS, SINGLE_COLUMN_CG_TOLERANCE
        )
        found.t[row] = one.t
        found.rest[row] = np.concatenate([one.map.ravel(), one.depth.ravel()])
    return [
        (rest[:size].reshape(shape), np.append(t, np.zeros(N_PATH_UNKNOWNS + 4 - n)), rest[size:])
        for t, rest in zip(*found, strict=True)
    ]


def solve(
    equations: NormalEquations, damping: float, side: Unknowns, tolerance: float = CG_TOLERANCE
) -> Unknowns:
    """Solve the damped normal equations for a right side by conjugate gradients.

    Args:
        equations: The normal equations.
        damping: Fraction by which the diagonal of H is enlarged.
        side: Right side.
        tolerance: Relative size of the residual at which steps end.

    Returns:
        The solution: map, unknowns of the path, and log depths at nodes.
    """
    n, real = equations.n, equations.evaluation.residual.dtype
    vector = cg.BlockVector(
        np.ascontiguousarray(side[0], real),
        np.ascontiguousarray(side[1][:n], np.float64),
        np.ascontiguousarray(side[2], real).reshape(equations.problem.series.nodes),
    )
    system = damped_system(equations, damping)
    (image, t, depth), _ = cg.conjugate_gradients(system, vector, MAX_CG_STEPS, tolerance)
    return image, np.append(t, np.zeros(N_PATH_UNKNOWNS + 4 - n)), depth.ravel()
