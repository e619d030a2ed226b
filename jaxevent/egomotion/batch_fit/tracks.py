"""A window's events pixel by pixel, the scene that they show, and where it puts them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.lattice import Near, bilinear, gather, spline, weigh
from jaxevent.egomotion.batch_fit.path import Path, warp

PLACE = 5  # px, where events' misfits tell of the same
SIDE = 4  # nodes about an event among whose depths its own is
LOOKS = 16  # depths on its ray that are looked at
FOLD = 0.3  # the least slope, along the ray of an event, of log depth less that of the scene


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


def sum_around(values: Array, near: Near, shape: tuple) -> Array:
    """Of values of events (E,), the sum over those at the same place."""
    middle = near.first + shape[1] + 1
    image = jnp.zeros(shape[0] * shape[1], values.dtype).at[middle].add(values).reshape(shape)
    sums = lax.reduce_window(image, 0.0, lax.add, (PLACE, PLACE), (1, 1), "SAME")
    return sums.ravel()[middle]


def totals(weight: Array, tracks: Tracks) -> Array:
    """Of the weights of events (E,), the sum over each pixel's (pixels,)."""
    return jnp.maximum(jnp.zeros(tracks.pixels, weight.dtype).at[tracks.pixel].add(weight), 1e-3)


def subtract_mean(values: Array, weight: Array, total: Array, tracks: Tracks) -> Array:
    """Less its mean over the pixel's events, of one value per event (E,), or of rows (E, n)."""
    sums = jnp.zeros((tracks.pixels, *values.shape[1:]), values.dtype)
    sums = sums.at[tracks.pixel].add((weight * values.T).T)
    return values - (sums.T / total).T[tracks.pixel]


def rays_of_events(path: Path, tracks: Tracks) -> tuple[Array, Array, Array, Array]:
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
    rx, ry, dx, dy = rays_of_events(path, tracks)

    def off(log_rho: Array) -> Array:
        rho = jnp.exp(log_rho)
        at = bilinear(rx + rho * dx, ry + rho * dy, tracks.corner, tracks.node, tracks.nodes)
        return log_rho - weigh(gather(path.log_rho, at, tracks.nodes), at.share)

    def newton(log_rho: Array) -> Array:
        value, slope = jax.jvp(off, (log_rho,), (jnp.ones_like(log_rho),))
        return log_rho - value / jnp.maximum(lax.stop_gradient(slope), FOLD)

    # From near to far, the first of some depths that is not nearer than the scene's.
    scene = path.log_rho.reshape(tracks.nodes)
    reach = (2 * SIDE + 1, 2 * SIDE + 1)
    high = lax.reduce_window(scene, -jnp.inf, lax.max, reach, (1, 1), "SAME").ravel()
    low = lax.reduce_window(scene, jnp.inf, lax.min, reach, (1, 1), "SAME").ravel()
    first = bilinear(tracks.x, tracks.y, tracks.corner, tracks.node, tracks.nodes).first
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
    at = spline(*placed(scene.path, tracks), tracks.corner, tracks.shape)
    value = weigh(gather(scene.map, at, tracks.shape), at.share)
    on = tracks.on * at.inside
    left = value - tracks.level - scene.skew * tracks.number
    return on * subtract_mean(left, on, totals(on, tracks), tracks)
