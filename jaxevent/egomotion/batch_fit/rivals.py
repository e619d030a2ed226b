"""Rival scenes of a window compared on pixels that neither was fitted to.

Both at one sigma, from the same map's beginnings: d_e is by how much more an event costs under one
than under the other, and D_c its sum over cells of 48 px, which err independently:

    z = sum_c D_c / sqrt(sum_c D_c^2)

Single events would claim more: those of a cell see the same edges.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxevent.egomotion.batch_fit.equations import look
from jaxevent.egomotion.batch_fit.path import Path, Prior
from jaxevent.egomotion.batch_fit.photometric import adjust, begin
from jaxevent.egomotion.batch_fit.tracks import Scene, Tracks, subtract_mean, totals

CELL = 48  # px, within which errors are alike
FAR = -9.0  # log inverse depth that makes no parallax
SIGMA = 0.1  # C, at least
STEPS = 16


def without_translation(path: Path) -> Path:
    """A rotation before a scene at infinity, that makes about the flow of the path.

    At the usual depth T_x and T_y do in the middle of the image what T_x rho does as Omega_y and
    -T_y rho as Omega_x.
    """
    rho = jnp.exp(jnp.median(path.log_rho))
    turn = rho * jnp.stack([-path.D[0, 1], path.D[0, 0], jnp.zeros_like(rho)])
    return Path(path.O.at[0].add(turn), path.D, jnp.full_like(path.log_rho, FAR))


def fitted(tracks: Tracks, path: Path, prior: Prior, sigma: float, *, moves: bool = True) -> Scene:
    """A scene fitted from a path, at one sigma at last; unless it `moves` by rotation alone."""
    real = tracks.x.dtype
    prior = prior._replace(moves=jnp.asarray(moves, real))
    scene = Scene(path, jnp.zeros(tracks.shape, real), jnp.asarray(prior.skew, real))
    scene, _ = adjust(tracks, scene, prior, sigma=1.0, settle=2, steps=2)
    return adjust(tracks, scene, prior, sigma=sigma, settle=4, steps=STEPS)[0]


@jax.jit
def _costs(tracks: Tracks, scene: Scene, prior: Prior, sigma: Array) -> tuple[Array, Array]:
    problem, _ = begin(tracks, scene, prior, sigma, jnp.asarray(False))
    seen = look(problem, scene, tracks.on)
    left = subtract_mean(seen.e, seen.on, totals(seen.on, tracks), tracks)
    return left**2 / (1 + left**2 / problem.limit), seen.on


def compared(tracks: Tracks, one: Scene, other: Scene, prior: Prior, sigma: float) -> float:
    """z of `other` over `one`, above 0 where events of these pixels cost less under `other`."""
    at = jnp.asarray(sigma, tracks.x.dtype)
    (a, on), (b, both) = (_costs(tracks, scene, prior, at) for scene in (one, other))
    D = np.asarray((a - b) * on * both, np.float64)
    across = (np.asarray(tracks.x) - tracks.corner[0]) // CELL
    down = (np.asarray(tracks.y) - tracks.corner[1]) // CELL
    cell = (down * (tracks.shape[1] // CELL + 1) + across).astype(int)
    sums = np.bincount(np.maximum(cell, 0), D)
    size = float(np.sqrt((sums**2).sum()))
    return float(sums.sum()) / size if size > 0 else 0.0
