"""Depths at nodes, looked for one by one: where the events around have the highest contrast."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jax import lax
from jaxtyping import Array

from jaxevent.egomotion.batch_fit.path import Path
from jaxevent.egomotion.batch_fit.tracks import Tracks, rays_of_events
from jaxevent.egomotion.warped import blur, splat

LEVELS = 40  # log depths that are tried
SPOT = 12  # px, of which each has its own


@jax.jit
def _tried_depths(path: Path, tracks: Tracks, low: Array, high: Array) -> tuple:
    """Signed contrast and number of events about nodes, (LEVELS, rows, columns), by log depth."""
    rx, ry, dx, dy = rays_of_events(path, tracks)
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
