"""The photometric fit of a window of events: path, depths and a map of log intensity in one.

Cf. Guo & Gallego, "Event-based photometric bundle adjustment", there for rotation. Log intensity at
a pixel u at its event e is known from its polarities but for the pixel's beginning b_u, and is that
of the scene where the warp takes u: with L the map of log intensity in the reference view in units
of the contrast threshold,

    L(x_ref(u, t_e)) = b_u + s_e,   s_e = sum of the polarities of u's events up to and with e,

is linear in L and b_u. Minimised over L, b_u, path and depths is the sum of the squared
differences, robustly (Geman & McClure, 3 sigma), with weak priors on differences of L and of log
depth between neighbours and on changes of the twist. L is a quadratic B-spline of 1 px: with
bilinear interpolation the cost at the true motion is twice as high and more. b_u is
eliminated exactly (differences less their mean over the pixel's events), all else is one linear
system a step, solved by conjugate gradients, without the matrix: the map's diagonal, and path with
lumped depths exactly, precondition it. Steps extrapolate (Nesterov): reweighting alone is slow. A
step that costs more is taken back and damped (Levenberg & Marquardt): beside sharp edges, linear
within 0.3 px, the cost grew to six times what it was in 100 steps without.
Where an outline passes before another, their crossing moves as neither and the levels beside them
change; without the events there, plain shapes' errors are a third to a half. Single misfits do not
stand out there, but all of them are larger (three simulated scenes: the area under the ROC curve is
0.67 to 0.89 for the mean within `PLACE`, 0.59 to 0.69 for single ones): where misfits are large on
average, all events count less.
Nothing is gained by squeezing events together, which biases contrast, and no event is compared that
tells only the gradient along the flow. An ON threshold C (1 + skew) and an OFF one of C (1 - skew)
are allowed for.

Depth is interpolated between nodes 4 px apart, and an event lies on the nearest surface that its
ray meets: what is behind is hidden. `depths` gives every node the depth at which the events around
it have the highest contrast, the path held fixed: beside an edge of depth that is the nearer
surface's, whose outline made the events. Adjusted from smooth depths instead, the path ends some 5
degrees beside the truth. Or all depths are those of a plane.
"""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.path import (
    LEAST,
    ROWS,
    SEGMENTS,
    Path,
    Prior,
    along,
    normalised,
    pairs_of,
    rays_of,
    rotated,
    warp,
)
from jaxevent.egomotion.warped import blur, splat

NODE = 4  # px between nodes of depth
BEND = 0.1  # a larger difference of log depth between nodes is an edge
CELL = 24  # px, whose errors are alike
LEVELS = 40  # log depths that are tried
SPOT = 12  # px, of which each has its own
PLACE = 5  # px, where events' misfits tell of the same
SIDE = 4  # nodes about an event among whose depths its own is
LOOKS = 16  # depths on its ray that are looked at
FOLD = 0.3  # the least slope, along the ray of an event, of log depth less that of the scene
# A step that costs more is taken back and damped, first by so much, then by so many times more;
# where that is too much no step helps. A step that costs less leaves so much of the damping, and is
# the last if it gains less than such a part.
DAMP, HARDER, STUCK, SOFTER, ENOUGH = 0.1, 5, 50, 0.5, 1e-3
SOLVE = 40


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
    """Of a step: the noise (C), the robust cost per event (C^2), the share of inliers."""

    noise: Array  # 1.48 times the median of the absolute misfits, of the last step
    cost: Array
    inliers: Array
    covariance: Array  # (6, 6) of C1 and O0, 0 unless it was asked for


class _Seen(NamedTuple):
    """A scene, where it puts the events, their misfits and weights, and what is minimised."""

    scene: Scene
    X: Array
    Y: Array
    on: Array
    e: Array
    weight: Array
    energy: Array
    cost: Array


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


def _around(values: Array, near: _Near, shape: tuple) -> Array:
    """Of values of events (E,), the sum over those at the same place."""
    middle = near.first + shape[1] + 1
    image = jnp.zeros(shape[0] * shape[1], values.dtype).at[middle].add(values).reshape(shape)
    sums = lax.reduce_window(image, 0.0, lax.add, (PLACE, PLACE), (1, 1), "SAME")
    return sums.ravel()[middle]


def totals(weight: Array, tracks: Tracks) -> Array:
    """Of the weights of events (E,), the sum over each pixel's (pixels,)."""
    return jnp.maximum(jnp.zeros(tracks.pixels, weight.dtype).at[tracks.pixel].add(weight), 1e-3)


def _less_mean(values: Array, weight: Array, total: Array, tracks: Tracks) -> Array:
    """Less its mean over the pixel's events, of one value per event (E,), or of rows (E, n)."""
    sums = jnp.zeros((tracks.pixels, *values.shape[1:]), values.dtype)
    sums = sums.at[tracks.pixel].add((weight * values.T).T)
    return values - (sums.T / total).T[tracks.pixel]


class Jacobian(NamedTuple):
    """Misfits before their means are taken, to first order in map, path (and the like) and depths.

    `of` a change of these three it is one of misfits, and `back` its transpose.
    """

    tracks: Tracks
    at: _Near  # of the map
    node: _Near
    by_path: Array  # (n, E)
    by_depth: Array  # (E,)
    weight: Array  # (E,), in means
    total: Array  # of the weights, by pixel: `totals`

    def of(self, v: tuple[Array, Array, Array]) -> Array:
        image, path, depth = v
        value = _mean(_gathered(image, self.at, self.tracks.shape), self.at.share)
        nodes = _mean(_gathered(depth, self.node, self.tracks.nodes), self.node.share)
        return value + path @ self.by_path + self.by_depth * nodes

    def back(self, z: Array) -> tuple[Array, Array, Array]:
        depth = _scattered(self.by_depth * z, self.node, self.node.share, self.tracks.nodes)
        return self.on_map(z, self.at.share), self.by_path @ z, depth

    def on_map(self, z: Array, share: Array) -> Array:
        return _scattered(z, self.at, share, self.tracks.shape).reshape(self.tracks.shape)

    def less_mean(self, z: Array) -> Array:
        return _less_mean(z, self.weight, self.total, self.tracks)


def _laplacian(values: Array) -> Array:
    """Minus the sum of differences to the neighbours, of a map."""
    zero = jnp.zeros((), values.dtype)

    def moved(rows: int, columns: int) -> Array:
        return lax.pad(values, zero, ((rows, -rows, 0), (columns, -columns, 0)))

    # One sum a pixel is a fifth of the time of differences added to where they belong.
    down, across = (np.r_[1, np.full(n - 2, 2), 1] for n in values.shape)
    number = jnp.asarray(down[:, None] + across, values.dtype)
    return number * values - moved(1, 0) - moved(-1, 0) - moved(0, 1) - moved(0, -1)


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
    return on * _less_mean(left, on, totals(on, tracks), tracks)


@jax.jit
def adjust(
    tracks: Tracks,
    scene: Scene,
    prior: Prior,
    sigma: Array | float | int,
    settle: Array | int,
    steps: Array | int,
    tell: Array | bool = False,
    plane: Array | bool = False,
) -> tuple[Scene, Report]:
    """So many steps of the photometric fit.

    `sigma` (C) scales what counts as an outlier. The first `settle` steps move the map alone. Later
    ones never cost more, and end early where none costs less. The report is of the end, the
    covariance is computed if `tell`. Depths that are a `plane`'s remain one's:
    rho = n . (x, y, f) / f, of which n is unknown, instead of any at nodes.
    """
    k, f, h = ROWS, tracks.f, tracks.half
    real, rows = tracks.x.dtype, 6 * ROWS
    free = rows + 4  # of the path, the skew, n
    rays = jnp.asarray(rays_of(*tracks.places, 1.0), real) / jnp.stack([f, f, jnp.ones_like(f)])
    plane, tell = jnp.asarray(plane), jnp.asarray(tell)
    a, b = pairs_of(*tracks.nodes)
    sigma = jnp.asarray(sigma, real)
    limit = (3 * sigma) ** 2
    powers = jnp.stack([math.factorial(m) / (f * h**m) for m in range(1, k + 1)])
    times = ((jnp.arange(SEGMENTS) + 0.5) / SEGMENTS * 2 - 1) * h
    slopes = jnp.stack([times**m / math.factorial(m) for m in range(k)], 1).astype(real)

    def with_rows(path: Path, values: Array) -> Path:
        values = values.reshape(2 * k, 3)
        return Path(values[:k], values[k:], path.log_rho)

    def units(path: Path) -> Array:
        """Of the path's rows, that move what is at the median depth by 1 px at the window's end."""
        both = jnp.concatenate([powers, powers / jnp.exp(jnp.median(path.log_rho))])
        return jnp.repeat(both, 3)

    later = jnp.repeat(jnp.tile(jnp.arange(k) > 0, 2), 3)

    def pulled(now: Array, unit: Array) -> Array:
        """What the priors on the path's rows and the skew cost, in such units."""
        O = (now[: 3 * k] * unit[: 3 * k]).reshape(k, 3)  # noqa: E741
        cost = prior.omega * (O[0] ** 2).sum() + 10 * now[rows] ** 2
        cost += prior.gyro_weight / SEGMENTS * ((slopes @ O - prior.gyro) ** 2).sum()
        return (cost + (jnp.where(later, prior.change, 0) * now[:rows] ** 2).sum()) / 2

    def values(scene: Scene, unit: Array) -> Array:
        now = jnp.concatenate([scene.path.O, scene.path.D]).ravel()
        return jnp.concatenate([now / unit, scene.skew[None], jnp.zeros(3, real)])

    def seen(scene: Scene, weight: Array, usual: Array) -> _Seen:
        path = normalised(scene.path)
        scene = Scene(path, *scene[1:])
        X, Y = placed(path, tracks)
        at = _spline(X, Y, tracks.corner, tracks.shape)
        on = tracks.on * at.inside
        e = _mean(_gathered(scene.map, at, tracks.shape), at.share)
        e = e - tracks.level - scene.skew * tracks.number
        # Events at a place of mean cost q cost 4 q / (1 + q / usual), of slope 1 at the usual q. A
        # plane hides nothing of itself.
        events = jnp.maximum(_around(on, at, tracks.shape), 1)
        for _ in range(2):
            left = _less_mean(e, weight, totals(weight, tracks), tracks)
            cost = on * left**2 / (1 + left**2 / limit)
            q = _around(cost, at, tracks.shape) / events
            counts = on * jnp.where(plane, 1, 4 / (1 + q / usual) ** 2) / events
            counts = _around(counts, at, tracks.shape)
            weight = on / (1 + left**2 / limit) ** 2 * counts
        apart = path.log_rho[a] - path.log_rho[b]
        energy = prior.bond * BEND**2 * jnp.where(plane, 0, jnp.log1p((apart / BEND) ** 2)).sum()
        energy += (
            prior.flat * (scene.map * _laplacian(scene.map)).sum() + 1e-5 * (scene.map**2).sum()
        )
        of_places = on * jnp.where(plane, q, 4 * q / (1 + q / usual))
        energy += of_places.sum() / (prior.alike * sigma**2)
        unit = units(path)
        return _Seen(
            scene,
            X,
            Y,
            on,
            e,
            weight,
            energy / 2 + pulled(values(scene, unit), unit),
            cost.sum() / jnp.maximum(on.sum(), 1),
        )

    def one(kept: _Seen, damping: Array, settling: Array) -> tuple:
        scene, X, Y, on, e, weight = kept[:6]
        path = scene.path
        at = _spline(X, Y, tracks.corner, tracks.shape)
        node = _corners(X, Y, tracks.corner, tracks.node, tracks.nodes)
        four = _gathered(path.log_rho, node, tracks.nodes)
        rho = jnp.exp(_mean(four, node.share))
        lx, ly = _mean(four, node.along_x), _mean(four, node.along_y)
        nine = _gathered(scene.map, at, tracks.shape)
        gx, gy = _mean(nine, at.along_x), _mean(nine, at.along_y)

        # x = r + rho(x) d: (1 - d grad rho') dx = what it is with rho held, d = rho (f C - C_z r).
        unit = units(path)
        now = values(scene, unit)
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
        growth = jnp.stack([tracks.tau**m / math.factorial(m) for m in range(1, k + 1)])
        # Mapped, since XLA else computes what moves events anew for every power: 20 ms, not 2.
        by = lax.map(lambda power: power * by, growth).reshape(rows, -1)
        chain = jax.jacfwd(lambda v: jnp.stack(with_rows(path, v).coefficients(), 1).ravel())
        by = (chain(now[:rows] * unit) * unit).T @ by
        by_depth = hx * dx + hy * dy
        usual = jnp.exp(jnp.median(path.log_rho))
        by_plane = by_depth * usual / rho * jnp.stack([X / f, Y / f, one])
        Jt = jnp.concatenate([by, -tracks.number[None], jnp.where(plane, by_plane, 0)])
        free_now = (on > 0) & ~settling
        Jt = jnp.where(free_now, Jt, 0)
        Jd = jnp.where(free_now & ~plane, by_depth, 0)
        jacobian = Jacobian(tracks, at, node, Jt, Jd, weight, totals(weight, tracks))
        left = jacobian.less_mean(e)

        # Priors, of the path's rows and of depths.
        pull, known = jax.grad(pulled)(now, unit), jax.hessian(pulled)(now, unit)
        held = jnp.append(~later, jnp.array([False, True, True, True]))
        # |C1| = 1
        fixed = slice(3 * k, 3 * k + 3)
        gauge = jnp.zeros(free, real).at[fixed].set(path.D[0] * unit[fixed])
        held = jnp.diag(jnp.where(held, 1e-3, 0)) + 1e4 * gauge[:, None] * gauge
        apart = path.log_rho[a] - path.log_rho[b]
        bond = jnp.where(plane, 0, prior.bond / (1 + (apart / BEND) ** 2))

        # Information of events: neighbours see the same, which counts as one.
        w = weight / (prior.alike * sigma**2)

        # Preconditioner: the diagonal for the map; path with depths, these lumped, exactly.
        diagonal = jacobian.on_map(w, at.share**2)
        diagonal = 0.7 * diagonal + 4 * prior.flat + 1e-5
        # One row per event: 7 ms for 60 k events, 15 ms one column after the other.
        centred = w[:, None] * jacobian.less_mean(Jt.T)
        upper = Jt @ centred + known + held
        stiff = jnp.diag(upper)
        mixed = _scattered(Jd[:, None] * centred, node, node.share[..., None], tracks.nodes)
        lumped = _scattered(w * Jd**2, node, node.share, tracks.nodes) + 1e-2
        lumped = lumped.at[a].add(2 * bond).at[b].add(2 * bond)
        eased_by = 1 + damping
        small = upper + damping * jnp.diag(stiff) - mixed.T @ (mixed / (eased_by * lumped)[:, None])
        small = (small + small.T) / 2 + 1e-3 * jnp.diag(stiff)

        def times_H(v: tuple) -> tuple:
            image, t, q = v
            of_map, of_path, of_depth = jacobian.back(w * jacobian.less_mean(jacobian.of(v)))
            flat = prior.flat * _laplacian(image) + (1e-5 + damping * diagonal) * image
            apart = bond * (q[a] - q[b])
            return (
                of_map + flat,
                of_path + (known + held) @ t + damping * stiff * t,
                of_depth
                + (1e-3 + damping * lumped) * q
                + jnp.zeros_like(q).at[a].add(apart).at[b].add(-apart),
            )

        of_map, of_path, of_depth = jacobian.back(w * left)
        gradient = (
            of_map + prior.flat * _laplacian(scene.map) + 1e-5 * scene.map,
            of_path + pull,
            of_depth
            + jnp.zeros_like(path.log_rho).at[a].add(bond * apart).at[b].add(-bond * apart),
        )

        factor = jax.scipy.linalg.cho_factor(small)
        ease_map, ease_nodes = 1 / (eased_by * diagonal), 1 / (eased_by * lumped)

        def eased(v: tuple) -> tuple:
            q = v[2] * ease_nodes
            t = jax.scipy.linalg.cho_solve(factor, v[1] - q @ mixed)
            return v[0] * ease_map, t, q - (mixed @ t) * ease_nodes

        solve = functools.partial(_conjugate_gradients, times_H, eased)
        image, t, q = solve(jax.tree.map(jnp.negative, gradient), SOLVE)
        sound = jnp.isfinite(t).all() & jnp.isfinite(q).all() & jnp.isfinite(image).all()
        image, t, q = (jnp.where(sound, part, 0) for part in (image, t, q))
        largest = jnp.abs(t[:rows]).max()
        moved = jnp.where(settling, 0, jnp.minimum(1, 4 / jnp.maximum(largest, 1e-9)))
        path = with_rows(path, (now + moved * t)[:rows] * unit)
        # The plane is that of the nodes whose inverse depth was not too small for one.
        level = jnp.exp(path.log_rho)
        told = jnp.where(level > 1.5 * LEAST * usual, rays.T, 0)
        normal = jnp.linalg.solve(told @ rays + 1e-6 * jnp.eye(3, dtype=real), told @ level)
        level = rays @ (normal + moved * usual * t[rows + 1 :])
        level = jnp.log(jnp.maximum(level, LEAST * usual))
        nodes = path.log_rho + jnp.clip(moved * q, -0.5, 0.5)
        path = normalised(Path(path.O, path.D, jnp.where(plane, level, nodes)))
        scene = Scene(path, scene.map + image, scene.skew + moved * t[rows])

        def covariance(_: Any) -> Array:
            # H^-1 (sum_c g_c g_c' + the priors') H^-1, with c cells, within which errors are
            # alike. H counts the weights w of misfits e, the curvature of their robust cost is
            # less: the mean of d(w e)/de = w (1 - 3 u) / (1 + u), u = (e / 3 sigma)^2 (Huber).
            # Errors are then 1 to 3 times sigma before walls and textures, but 7 to 35 times before
            # plain shapes, where they are alike everywhere.
            u = left**2 / limit
            curved = (weight * (1 - 3 * u) / (1 + u)).sum() / jnp.maximum(weight.sum(), 1)
            less = 1 / jnp.maximum(curved, 0.1) ** 2
            rows_of, columns = (-(-n // CELL) for n in tracks.shape)
            across = (tracks.x - tracks.corner[0]) // CELL
            cell = ((tracks.y - tracks.corner[1]) // CELL * columns + across).astype(jnp.int32)
            chosen = jnp.concatenate([jnp.arange(3 * k, 3 * k + 3), jnp.arange(3)])
            zero = jax.tree.map(jnp.zeros_like, gradient)

            def column(i: Array) -> tuple[Array, Array]:
                v = solve((zero[0], zero[1].at[i].set(1), zero[2]), SOLVE)
                told = jnp.zeros(rows_of * columns, real).at[cell].add(w * left * jacobian.of(v))
                return told * unit[i], v[1] * unit[i]

            told, own = lax.map(column, chosen)
            return less * (told @ told.T) + own @ known @ own.T

        nothing = jnp.zeros((6, 6), real)
        return scene, lax.cond(tell, covariance, lambda _: nothing, None)

    def go(state: tuple) -> tuple:
        n, scene, last, kept, momentum, damping, told = state
        # Nesterov's extrapolation: reweighting alone closes a tenth of what is left in a step.
        ahead = momentum / (momentum + 2)
        near, nearer = (jnp.exp(one.path.log_rho) for one in (last, scene))
        tried = jax.tree.map(lambda new, old: new + ahead * (new - old), scene, last)
        # Only inverse depths themselves, extrapolated, are a plane's again.
        level = jnp.maximum(nearer + ahead * (nearer - near), LEAST * jnp.median(nearer))
        level = jnp.where(plane, jnp.log(level), tried.path.log_rho)
        tried = seen(Scene(Path(tried.path.O, tried.path.D, level), *tried[1:]), kept.weight, usual)
        better = (tried.energy <= kept.energy) | (n <= settle)
        gain = jnp.where(n > settle, kept.energy - tried.energy, jnp.inf)
        last = jax.tree.map(lambda p, q: jnp.where(better, p, q), scene, kept.scene)
        kept = jax.tree.map(lambda p, q: jnp.where(better, p, q), tried, kept)
        momentum = jnp.where(better & (n >= settle), momentum + 1, 0)
        damping = jnp.where(better, damping * SOFTER, jnp.maximum(damping * HARDER, DAMP))
        damping = jnp.where(damping < DAMP / 4, 0, damping)
        damping = jnp.where(better & (gain < ENOUGH * kept.energy), STUCK, damping)
        goes_on = (n < steps) & (damping < STUCK)
        new = lax.cond(goes_on, one, lambda *_: (scene, told), kept, damping, n < settle)
        return n + 1, new[0], last, kept, momentum, damping, new[1]

    def unfinished(state: tuple) -> Array:
        return (state[0] <= steps) & (state[5] < STUCK)

    zero, none = jnp.zeros((), real), jnp.zeros_like(tracks.x)
    usual = jnp.maximum(seen(scene, tracks.on, zero + jnp.inf).cost, 1e-3 * limit)
    kept = _Seen(scene, none, none, none, none, tracks.on, zero + jnp.inf, zero)
    state = (jnp.zeros((), int), scene, scene, kept, zero, zero, jnp.zeros((6, 6), real))
    _, _, _, kept, _, _, covariance = lax.while_loop(unfinished, go, state)
    left = jnp.abs(_less_mean(kept.e, kept.weight, totals(kept.weight, tracks), tracks))
    number = jnp.maximum(kept.on.sum(), 1)
    middle = jnp.sort(jnp.where(kept.on > 0, left, jnp.inf))[(number / 2).astype(jnp.int32)]
    noise = jnp.where(jnp.isfinite(middle), 1.48 * middle, 0)
    inliers = (kept.on / (1 + left**2 / limit) ** 2).sum() / number
    return kept.scene, Report(noise, kept.cost, inliers, covariance)


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
