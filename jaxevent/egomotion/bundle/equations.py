"""The photometric fit to first order: its equations, what eases them, and their solution.

Unknowns are (map, path's rows with skew and plane, depths at nodes).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle import together
from jaxevent.egomotion.bundle.coarse import coarse_shape, factored
from jaxevent.egomotion.bundle.gauss_newton import bonds
from jaxevent.egomotion.bundle.path import ROWS, Path, Prior, normalised
from jaxevent.egomotion.bundle.placing import POWERS
from jaxevent.egomotion.bundle.rows import (
    chain,
    gauge_of_rows,
    later_rows,
    priors_of_rows,
    rows_of,
    units_of_rows,
)
from jaxevent.egomotion.bundle.slopes import (
    BlockRoom,
    Free,
    Slopes,
    back,
    blocks,
    depth_blocks,
    differentiate,
    forward,
    squares,
)
from jaxevent.egomotion.bundle.solving import System, conjugate_gradients
from jaxevent.egomotion.bundle.tracks import Places, Scene, Tracks, read
from jaxevent.egomotion.bundle.weighing import Room, subtract_mean, weigh

BEND = 0.1  # a larger difference of log depth between nodes is an edge
FREE = 6 * ROWS  # numbers of a path's rows; after them come the skew and the plane's normal
# Of conjugate gradients: steps at most, and the part of the first residual that is left at the end.
# With 25 and 0.03 windows of slider_depth take a sixth less, but headings are up to 3.2 degrees off
# (2.9); with 20 and 0.05 headings of evbench_seq3 are claimed that are 30 to 45 degrees off.
# (Coarse nodes of the map, solved with path and smooth depths, save no step: 10 with the map's
# block solved exactly do what 40 do.)
SOLVE, LEFT = 40, 0.01
ALONE = 1e-3  # the same part, where a column of H^-1 is solved for by itself
TINY = 1e-5  # weight of the map's squares
# Standard deviations of its prior that the skew may be off. On slider_depth it goes else from 0.2,
# by counts, to 0.99, where ON events tell nothing, and a mirrored motion costs less than the true.
SKEWED = 2.0

Unknowns = tuple[NDArray, NDArray, NDArray]


class Problem(NamedTuple):
    """What all steps of a fit have in common."""

    tracks: Tracks
    prior: Prior
    sigma: float  # C, of misfits
    plane: bool  # whether depths are a plane's
    usual: float  # C^2, the cost of places at which events begin to count less

    @property
    def limit(self) -> float:
        """The square of a misfit (C^2) from which it is an outlier."""
        return (3 * self.sigma) ** 2

    @property
    def information(self) -> float:
        """Of an event of weight 1 (1/C^2): neighbours see the same, which counts as one."""
        return 1 / (float(self.prior.alike) * self.sigma**2)

    def pull(self, path: Path, unit: NDArray) -> tuple[NDArray, NDArray, float]:
        """What the priors on path and skew cost, now' K now / 2 - b' now + c: K, b and c."""
        K, b, c = priors_of_rows(self.prior, unit, self.tracks.half)
        known, side = np.zeros((FREE + 4, FREE + 4)), np.zeros(FREE + 4)
        known[:FREE, :FREE], side[:FREE] = K, b
        weight, skew = float(self.prior.skew_weight), float(self.prior.skew)
        known[FREE, FREE], side[FREE] = weight, weight * skew
        return known, side, c + weight * skew**2 / 2


class Seen(NamedTuple):
    """A scene, where it puts the events, their misfits and weights, and what is minimised."""

    scene: Scene
    places: Places
    e: NDArray
    weight: NDArray
    energy: float
    cost: float  # robust, per event


def unknowns(scene: Scene, unit: NDArray) -> NDArray[np.float64]:
    """The path's rows in such units, the skew, and 0 for the change of the plane."""
    return np.concatenate([rows_of(scene.path) / unit, [scene.skew, 0, 0, 0]])


def laplacian(image: NDArray) -> NDArray:
    """Minus the sum of differences to the neighbours, of a map."""
    found = np.zeros_like(image)
    for axis in (0, 1):
        apart = np.diff(image, axis=axis)
        before, after = (np.moveaxis(found, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        before -= np.moveaxis(apart, axis, 0)
        after += np.moveaxis(apart, axis, 0)
    return found


def look(problem: Problem, scene: Scene, weight: NDArray, before: Seen | None = None) -> Seen:
    """The scene with |C1| = 1, what it costs, and the weights of events, from those before.

    Where the path is that of what was seen `before`, events stay where they were, else about there.
    """
    tracks, prior, sigma, plane, usual = problem
    most = SKEWED / math.sqrt(float(prior.skew_weight))
    skew = min(max(float(scene.skew), prior.skew - most), prior.skew + most)
    stays = before is not None and before.scene.path is scene.path
    scene = Scene(scene.path if stays else normalised(scene.path), scene.map, skew)
    places = read(scene, tracks, before.places if before else None, stays=stays)
    e = places.value - tracks.level - tracks.x.dtype.type(scene.skew) * tracks.number
    weight = weight.copy()
    of_places, cost = weigh(
        e, places.inside, tracks.trust, tracks.events, places.first, tracks.begin, problem.limit,
        usual, plane, Room.of(tracks.grids.height, tracks.grids.width, e), weight,
    )  # fmt: skip
    unit = units_of_rows(scene.path, tracks.f, tracks.half)
    known, side, constant = problem.pull(scene.path, unit)
    now = unknowns(scene, unit)
    energy = now @ known @ now / 2 - side @ now + constant
    if not plane:
        energy += bonds(scene.path.log_rho.reshape(tracks.nodes), float(prior.bond), BEND)[2]
    image = scene.map
    differences = sum(float(np.vdot(d, d)) for d in (np.diff(image, axis=k) for k in (0, 1)))
    energy += (float(prior.flat) * differences + TINY * float(np.vdot(image, image))) / 2
    energy += 0.5 * problem.information * of_places
    number = max(float(places.inside[: tracks.events].sum()), 1.0)
    return Seen(scene, places, e, weight, float(energy), float(cost) / number)


class Equations(NamedTuple):
    """H d = -gradient of a scene: pieces of H, which is never made, and what eases its solution."""

    problem: Problem
    seen: Seen
    slopes: Slopes
    chain: NDArray[np.float64]
    unit: NDArray[np.float64]  # of the path's rows
    now: NDArray[np.float64]  # of the unknowns of the path
    left: NDArray  # (E,) C, misfits
    diagonal: NDArray  # of the map's block, about
    known: NDArray[np.float64]  # the priors' part of the path's block
    side: NDArray[np.float64]  # and what they pull to: known @ now - side is their gradient
    held: NDArray[np.float64]  # what keeps it regular
    upper: NDArray[np.float64]  # the path's block
    mixed: NDArray[np.float64]  # (coarse nodes, n), path with depths
    smooth: NDArray[np.float64]  # (coarse nodes, coarse nodes), depths without priors
    lumped: NDArray[np.float64]  # (rows, columns) the depths' block, each row's sum
    across: NDArray[np.float64]  # bonds to the columns before
    down: NDArray[np.float64]

    @property
    def stiff(self) -> NDArray[np.float64]:
        """Diagonal of the path's block."""
        return np.diag(self.upper)

    def change(self, v: Unknowns) -> NDArray:
        """Of misfits, before their means are taken."""
        image, t, depth = v
        real, value = image.dtype.type, np.empty_like(self.left)
        coefficients = (self.chain @ t[:FREE]).reshape(6, POWERS).astype(real)
        grids = self.problem.tracks.grids
        forward(
            self.slopes, image.ravel(), coefficients, t[FREE : len(self.slopes.more) + FREE]
            .astype(real), depth.astype(real), grids.width, grids.columns, value,
        )  # fmt: skip
        return value

    def transposed(self, z: NDArray) -> Unknowns:
        """What J' makes of values of events."""
        real, tracks, n = z.dtype, self.problem.tracks, len(self.slopes.more)
        image, depth = np.empty(tracks.shape, real), np.empty(math.prod(tracks.nodes), real)
        coefficients, more = np.empty((6, POWERS), real), np.empty(n, real)
        grids = tracks.grids
        back(
            self.slopes, z, grids.width, grids.columns, image.reshape(-1), coefficients, more, depth
        )
        t = np.concatenate([coefficients.ravel() @ self.chain, more, np.zeros(4 - n)])
        return image, t, depth


def linearise(problem: Problem, seen: Seen, settling: bool) -> Equations:
    """The equations of a scene; only the map is free while `settling`."""
    tracks, prior, _, plane, _ = problem
    scene, weight, real = seen.scene, seen.weight, tracks.x.dtype
    path, moves = scene.path, float(prior.moves)
    unit = units_of_rows(path, tracks.f, tracks.half)
    now = unknowns(scene, unit)
    slopes = slopes_of(problem, seen, not settling)
    by = chain(path, unit, tracks.half)
    by[:, 3 * ROWS :] *= moves
    n = FREE + len(slopes.more)
    left = seen.e.copy()
    subtract_mean(left, weight, tracks.begin)

    grids, coarse = tracks.grids, math.prod(coarse_shape(*tracks.nodes))
    raw, diagonal = np.zeros((n, n)), np.zeros(tracks.shape, real)
    mixed, smooth = np.zeros((coarse, n)), np.zeros((coarse, coarse))
    lumped = np.zeros(tracks.nodes)
    squares(slopes, weight, grids.width, diagonal.reshape(-1))
    if not settling:
        blocks(slopes, weight, tracks.begin, grids.columns, BlockRoom.of(n, real), raw, mixed)
        room = np.empty(coarse), np.empty(coarse, np.int64), np.empty(coarse, np.int64)
        depth_blocks(slopes, weight, tracks.begin, grids.columns, room, smooth, lumped.reshape(-1))
    whole = np.zeros((n, FREE + 4))
    whole[:FREE, :FREE], whole[FREE:, FREE:n] = by, np.eye(n - FREE)
    information = problem.information
    known, side, _ = problem.pull(path, unit)
    # What nothing tells is held: changes of the twist and the skew are by their priors.
    held = np.append(~later_rows(), [False, True, True, True])
    gauge = gauge_of_rows(path, unit, FREE + 4)
    held = np.diag(np.where(held, 1e-3, 0)) + 1e4 * gauge[:, None] * gauge
    upper = information * whole.T @ raw @ whole + known + held
    across, down, _ = bonds(path.log_rho.reshape(tracks.nodes), float(prior.bond), BEND)
    if plane:
        across, down = np.zeros_like(across), np.zeros_like(down)
    lumped = information * lumped + 1e-2
    stiff = across + down
    stiff[:, :-1] += across[:, 1:]
    stiff[:-1] += down[1:]
    lumped += 2 * stiff
    return Equations(
        problem, seen, slopes, by, unit, now, left,
        0.7 * information * diagonal + 4 * float(prior.flat) + TINY, known, side, held, upper,
        # By einsum: larger products wake BLAS's threads, which spin then.
        np.einsum("ki,ij->kj", mixed, information * whole), information * smooth, lumped,
        across, down,
    )  # fmt: skip


def gradient_of(equations: Equations) -> Unknowns:
    """Of what is minimised, weights held."""
    problem, seen = equations.problem, equations.seen
    real, scene, prior = equations.left.dtype, seen.scene, problem.prior
    z = (problem.information * seen.weight * equations.left).astype(real)
    of_map, of_path, of_depth = equations.transposed(z)
    depth = scene.path.log_rho.reshape(problem.tracks.nodes)
    of_bonds = np.zeros(depth.shape)
    for axis, bond in ((1, equations.across), (0, equations.down)):
        pulled = bond * np.diff(depth, axis=axis, prepend=np.take(depth, [0], axis))
        of_bonds += pulled - np.roll(pulled, -1, axis)
    flat, tiny = real.type(prior.flat), real.type(TINY)
    return (
        of_map + flat * laplacian(scene.map) + tiny * scene.map,
        of_path + equations.known @ equations.now - equations.side,
        of_depth + of_bonds.ravel(),
    )


def slopes_of(problem: Problem, seen: Seen, free: bool) -> Slopes:
    """The slopes of misfits, before their means are taken; unless `free` by the map alone."""
    tracks, plane = problem.tracks, problem.plane
    path, there, real = seen.scene.path, seen.places, tracks.x.dtype
    E, depth = len(tracks.x), np.ascontiguousarray(path.log_rho)
    room = np.empty if free else np.zeros
    slopes = Slopes(
        there.first, there.u, there.v, room((6, E), real), room(E, real),
        room((4 if plane else 1, E), real), room(E, np.int32), room(E, real),
        room(E, real), room(E, real),
    )  # fmt: skip
    if free:
        usual = float(np.exp(np.median(depth)))
        differentiate(
            tracks.points, tracks.number, there, path.motion(tracks.f), tracks.half, depth,
            seen.scene.map.ravel(), Free(plane, float(problem.prior.moves), usual),
            tracks.grids, slopes,
        )  # fmt: skip
    return slopes


def system_of(equations: Equations, damping: float) -> System:
    """H damped, and about H^-1: diagonals, and path with smooth depths exactly (`coarse`)."""
    tracks, real = equations.problem.tracks, equations.seen.e.dtype
    n = FREE + len(equations.slopes.more)
    damped = damping * np.diag(equations.stiff[:n])
    known = (equations.known + equations.held)[:n, :n] + damped
    hold, across, down = 1e-3 + damping * equations.lumped, equations.across, equations.down
    upper, mixed = equations.upper[:n, :n] + damped, equations.mixed[:, :n]
    lower = factored(upper, mixed, equations.smooth, hold, across, down)

    def on(values: NDArray) -> NDArray:
        return np.ascontiguousarray(values.astype(real))

    return System(
        equations.slopes, equations.seen.weight, equations.problem.information, tracks.begin,
        equations.chain, known, float(equations.problem.prior.flat), TINY,
        on(damping * equations.diagonal), on(hold), on(across), on(down),
        on(1 / ((1 + damping) * equations.diagonal)), on(1 / ((1 + damping) * equations.lumped)),
        lower, np.empty((6, POWERS), real), np.empty(n - FREE, real), np.empty(len(lower)),
    )  # fmt: skip


def inverse_of(equations: Equations, rows: list[int]) -> list[Unknowns]:
    """Columns of H^-1, undamped, of so many of the path's rows, each in its own unit."""
    n = FREE + len(equations.slopes.more)
    sides = np.zeros((len(rows), n))
    sides[range(len(rows)), rows] = equations.unit[rows]
    system, shape = system_of(equations, 0.0), equations.problem.tracks.shape
    found, size = together.solve(system, sides), math.prod(shape)
    # Directions that are about one are told apart by rounding; a side alone has but one.
    for row in np.flatnonzero(~np.isfinite(found.t).all(1)):
        none, depths = np.zeros(shape, system.ease_map.dtype), np.zeros_like(system.across)
        image, found.t[row], depths, _ = conjugate_gradients(
            system, none, sides[row], depths, together.MOST, ALONE
        )
        found.rest[row] = np.concatenate([image.ravel(), depths.ravel()])
    return [
        (rest[:size].reshape(shape), np.append(t, np.zeros(FREE + 4 - n)), rest[size:])
        for t, rest in zip(*found, strict=True)
    ]


def solve(equations: Equations, damping: float, side: Unknowns, left: float = LEFT) -> Unknowns:
    """H^-1 side, damped, by conjugate gradients, until so much of the residual is left."""
    n, real = FREE + len(equations.slopes.more), equations.seen.e.dtype
    nodes = equations.problem.tracks.nodes
    image, t, depth, _ = conjugate_gradients(
        system_of(equations, damping), np.ascontiguousarray(side[0], real),
        np.ascontiguousarray(side[1][:n], np.float64),
        np.ascontiguousarray(side[2], real).reshape(nodes), SOLVE, left,
    )  # fmt: skip
    return image, np.append(t, np.zeros(FREE + 4 - n)), depth.ravel()
