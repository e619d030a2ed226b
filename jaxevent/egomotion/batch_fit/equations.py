"""The photometric fit to first order: its equations, what eases them, and their solution.

Unknowns are (map, path's rows with skew and plane, depths at nodes).
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxevent.egomotion.batch_fit.gauss_newton import (
    bonds_between,
    conjugate_gradients,
    first_rows,
    gauge_of_rows,
    later_rows,
    pull_of_rows,
    units_of_rows,
    with_first_rows,
)
from jaxevent.egomotion.batch_fit.lattice import (
    Near,
    bilinear,
    gather,
    laplacian,
    scatter,
    spline,
    weigh,
)
from jaxevent.egomotion.batch_fit.path import (
    ROWS,
    Prior,
    along,
    normalised,
    pairs_of,
    rotated,
)
from jaxevent.egomotion.batch_fit.tracks import (
    FOLD,
    Scene,
    Tracks,
    placed,
    subtract_mean,
    sum_around,
    totals,
)

BEND = 0.1  # a larger difference of log depth between nodes is an edge
FREE = 6 * ROWS  # numbers of a path's rows; after them come the skew and the plane's normal
SOLVE = 40  # steps of conjugate gradients


class Problem(NamedTuple):
    """What all steps of a fit have in common."""

    tracks: Tracks
    prior: Prior
    sigma: Array  # C, of misfits
    plane: Array  # whether depths are a plane's
    usual: Array  # C^2, the cost of places at which events begin to count less

    @property
    def limit(self) -> Array:
        """The square of a misfit (C^2) from which it is an outlier."""
        return (3 * self.sigma) ** 2

    @property
    def pairs(self) -> tuple[Array, Array]:
        """Neighbouring nodes."""
        a, b = pairs_of(*self.tracks.nodes)
        return a, b

    def pull(self, now: Array, unit: Array) -> Array:
        """What the priors on the path's rows and the skew cost, in units of the rows."""
        more = self.prior.skew_weight * (now[FREE] - self.prior.skew) ** 2
        return pull_of_rows(now[:FREE], unit, self.prior, self.tracks.half, ROWS, more)


class Seen(NamedTuple):
    """A scene, where it puts the events, their misfits and weights, and what is minimised."""

    scene: Scene
    X: Array
    Y: Array
    on: Array
    e: Array
    weight: Array
    energy: Array
    cost: Array  # robust, per event


def unknowns(scene: Scene, unit: Array) -> Array:
    """The path's rows in such units, the skew, and 0 for the change of the plane."""
    rows = first_rows(scene.path, ROWS) / unit
    return jnp.concatenate([rows, scene.skew[None], jnp.zeros(3, rows.dtype)])


def look(problem: Problem, scene: Scene, weight: Array) -> Seen:
    """The scene with |C1| = 1, what it costs, and the weights of events, from those before."""
    tracks, prior, sigma, plane, usual = problem
    limit, (a, b) = problem.limit, problem.pairs
    path = normalised(scene.path)
    scene = Scene(path, *scene[1:])
    X, Y = placed(path, tracks)
    at = spline(X, Y, tracks.corner, tracks.shape)
    on = tracks.on * at.inside
    e = weigh(gather(scene.map, at, tracks.shape), at.share)
    e = e - tracks.level - scene.skew * tracks.number
    # Events at a place of mean cost q cost 4 q / (1 + q / usual), of slope 1 at the usual q. A
    # plane hides nothing of itself.
    events = jnp.maximum(sum_around(on, at, tracks.shape), 1)
    q = cost = on
    for _ in range(2):
        left = subtract_mean(e, weight, totals(weight, tracks), tracks)
        cost = on * left**2 / (1 + left**2 / limit)
        q = sum_around(cost, at, tracks.shape) / events
        counts = on * jnp.where(plane, 1, 4 / (1 + q / usual) ** 2) / events
        counts = sum_around(counts, at, tracks.shape)
        weight = on / (1 + left**2 / limit) ** 2 * counts
    apart = path.log_rho[a] - path.log_rho[b]
    energy = prior.bond * BEND**2 * jnp.where(plane, 0, jnp.log1p((apart / BEND) ** 2)).sum()
    energy += prior.flat * (scene.map * laplacian(scene.map)).sum() + 1e-5 * (scene.map**2).sum()
    of_places = on * jnp.where(plane, q, 4 * q / (1 + q / usual))
    energy += of_places.sum() / (prior.alike * sigma**2)
    unit = units_of_rows(path, tracks.f, tracks.half, ROWS)
    energy = energy / 2 + problem.pull(unknowns(scene, unit), unit)
    return Seen(scene, X, Y, on, e, weight, energy, cost.sum() / jnp.maximum(on.sum(), 1))


class Jacobian(NamedTuple):
    """Misfits before their means are taken, to first order in map, path (and the like) and depths.

    `of` a change of these three it is one of misfits, and `back` its transpose.
    """

    tracks: Tracks
    at: Near  # of the map
    node: Near
    by_path: Array  # (n, E)
    by_depth: Array  # (E,)
    weight: Array  # (E,), in means
    total: Array  # of the weights, by pixel: `totals`

    def of(self, v: tuple[Array, Array, Array]) -> Array:
        image, path, depth = v
        value = weigh(gather(image, self.at, self.tracks.shape), self.at.share)
        nodes = weigh(gather(depth, self.node, self.tracks.nodes), self.node.share)
        return value + path @ self.by_path + self.by_depth * nodes

    def back(self, z: Array) -> tuple[Array, Array, Array]:
        depth = scatter(self.by_depth * z, self.node, self.node.share, self.tracks.nodes)
        return self.on_map(z, self.at.share), self.by_path @ z, depth

    def on_map(self, z: Array, share: Array) -> Array:
        return scatter(z, self.at, share, self.tracks.shape).reshape(self.tracks.shape)

    def subtract_mean(self, z: Array) -> Array:
        return subtract_mean(z, self.weight, self.total, self.tracks)


class Slopes(NamedTuple):
    """How misfits change before their means are taken: by what moves events."""

    at: Near  # of the map
    node: Near
    by_path: Array  # (FREE + 4, E): the rows in units, the skew, the plane's normal
    by_depth: Array  # (E,)


def differentiate(problem: Problem, seen: Seen, unit: Array) -> Slopes:
    """The slopes of misfits, of events where they lie on the nearest surface.

    x = r + rho(x) d, so (1 - d grad rho') dx is what dx were with rho held, d = rho (f C - C_z r).
    """
    tracks, plane = problem.tracks, problem.plane
    scene, X, Y = seen.scene, seen.X, seen.Y
    path, f = scene.path, tracks.f
    at = spline(X, Y, tracks.corner, tracks.shape)
    node = bilinear(X, Y, tracks.corner, tracks.node, tracks.nodes)
    four = gather(path.log_rho, node, tracks.nodes)
    rho = jnp.exp(weigh(four, node.share))
    lx, ly = weigh(four, node.along_x), weigh(four, node.along_y)
    nine = gather(scene.map, at, tracks.shape)
    gx, gy = weigh(nine, at.along_x), weigh(nine, at.along_y)

    # Where events go by phi and by C, and the rest by the chain rule.
    O, C = path.coefficients()  # noqa: E741
    phi, (cx, cy, cz) = along(O, tracks.tau), along(C, tracks.tau)

    def turned(phi: list[Array]) -> tuple[Array, Array]:
        rx, ry, rz = rotated(phi, tracks.x, tracks.y, f)
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
    growth = jnp.stack([tracks.tau**m / math.factorial(m) for m in range(1, ROWS + 1)])
    # Mapped, since XLA else computes what moves events anew for every power: 20 ms, not 2.
    by = lax.map(lambda power: power * by, growth).reshape(FREE, -1)
    now = first_rows(path, ROWS) / unit
    chain = jax.jacfwd(
        lambda v: jnp.stack(with_first_rows(path, v, ROWS).coefficients(), 1).ravel()
    )
    by = (chain(now * unit) * unit).T @ by
    by_depth = hx * dx + hy * dy
    usual = jnp.exp(jnp.median(path.log_rho))
    by_plane = by_depth * usual / rho * jnp.stack([X / f, Y / f, one])
    by = jnp.concatenate([by, -tracks.number[None], jnp.where(plane, by_plane, 0)])
    return Slopes(at, node, by, by_depth)


class Equations(NamedTuple):
    """H d = -gradient of a scene: pieces of H, which is never made, and what eases its solution."""

    problem: Problem
    jacobian: Jacobian
    unit: Array  # of the path's rows
    now: Array  # of the unknowns of the path
    left: Array  # (E,) C, misfits
    information: Array  # (E,) 1/C^2, of events
    gradient: tuple[Array, Array, Array]
    diagonal: Array  # of the map's block, about
    known: Array  # the priors' part of the path's block
    held: Array  # what keeps it regular
    stiff: Array  # diagonal of the path's block
    upper: Array  # the path's block
    mixed: Array  # path with depths
    lumped: Array  # (nodes,) the depths' block, each row's sum
    bond: Array  # (pairs,)

    def times_H(self, damping: Array, v: tuple) -> tuple:
        """H v, damped."""
        (image, t, q), (a, b) = v, self.problem.pairs
        flat = self.problem.prior.flat
        seen = self.jacobian.subtract_mean(self.jacobian.of(v))
        of_map, of_path, of_depth = self.jacobian.back(self.information * seen)
        apart = self.bond * (q[a] - q[b])
        return (
            of_map + (flat * laplacian(image) + (1e-5 + damping * self.diagonal) * image),
            of_path + (self.known + self.held) @ t + damping * self.stiff * t,
            of_depth
            + (1e-3 + damping * self.lumped) * q
            + jnp.zeros_like(q).at[a].add(apart).at[b].add(-apart),
        )


def linearise(problem: Problem, seen: Seen, settling: Array) -> Equations:
    """The equations of a scene; only the map is free while `settling`."""
    tracks, prior, sigma, plane, _ = problem
    (a, b), scene = problem.pairs, seen.scene
    path, weight = scene.path, seen.weight
    unit = units_of_rows(path, tracks.f, tracks.half, ROWS)
    now = unknowns(scene, unit)
    at, node, Jt, Jd = differentiate(problem, seen, unit)
    free = (seen.on > 0) & ~settling
    Jt, Jd = jnp.where(free, Jt, 0), jnp.where(free & ~plane, Jd, 0)
    Jt = jnp.concatenate([Jt[: 3 * ROWS], prior.moves * Jt[3 * ROWS : FREE], Jt[FREE:]])
    Jd = prior.moves * Jd
    jacobian = Jacobian(tracks, at, node, Jt, Jd, weight, totals(weight, tracks))
    left = jacobian.subtract_mean(seen.e)

    # Priors, of the path's rows and of depths.
    pull, known = jax.grad(problem.pull)(now, unit), jax.hessian(problem.pull)(now, unit)
    held = jnp.append(~later_rows(ROWS), jnp.array([False, True, True, True]))
    gauge = gauge_of_rows(path, unit, FREE + 4)
    held = jnp.diag(jnp.where(held, 1e-3, 0)) + 1e4 * gauge[:, None] * gauge
    apart, bond = bonds_between(path.log_rho, (a, b), prior.bond, BEND)
    bond = jnp.where(plane, 0, bond)

    # Information of events: neighbours see the same, which counts as one.
    w = weight / (prior.alike * sigma**2)
    of_map, of_path, of_depth = jacobian.back(w * left)
    gradient = (
        of_map + prior.flat * laplacian(scene.map) + 1e-5 * scene.map,
        of_path + pull,
        of_depth + jnp.zeros_like(path.log_rho).at[a].add(bond * apart).at[b].add(-bond * apart),
    )

    diagonal = jacobian.on_map(w, at.share**2)
    diagonal = 0.7 * diagonal + 4 * prior.flat + 1e-5
    # One row per event: 7 ms for 60 k events, 15 ms one column after the other.
    centred = w[:, None] * jacobian.subtract_mean(Jt.T)
    upper = Jt @ centred + known + held
    mixed = scatter(Jd[:, None] * centred, node, node.share[..., None], tracks.nodes)
    lumped = scatter(w * Jd**2, node, node.share, tracks.nodes) + 1e-2
    lumped = lumped.at[a].add(2 * bond).at[b].add(2 * bond)
    return Equations(
        problem, jacobian, unit, now, left, w, gradient, diagonal, known, held, jnp.diag(upper),
        upper, mixed, lumped, bond,
    )  # fmt: skip


def precondition(equations: Equations, damping: Array) -> Any:
    """About H^-1: the diagonal for the map; path with depths, these lumped, exactly."""
    eased_by, stiff = 1 + damping, equations.stiff
    mixed, lumped = equations.mixed, equations.lumped
    small = equations.upper + damping * jnp.diag(stiff)
    small = small - mixed.T @ (mixed / (eased_by * lumped)[:, None])
    small = (small + small.T) / 2 + 1e-3 * jnp.diag(stiff)
    factor = jax.scipy.linalg.cho_factor(small)
    ease_map, ease_nodes = 1 / (eased_by * equations.diagonal), 1 / (eased_by * lumped)

    def ease(v: tuple) -> tuple:
        q = v[2] * ease_nodes
        t = jax.scipy.linalg.cho_solve(factor, v[1] - q @ mixed)
        return v[0] * ease_map, t, q - (mixed @ t) * ease_nodes

    return ease


def solve(equations: Equations, damping: Array, side: tuple) -> tuple:
    """H^-1 side, damped, by conjugate gradients."""
    ease = precondition(equations, damping)
    return conjugate_gradients(lambda v: equations.times_H(damping, v), ease, side, SOLVE)
