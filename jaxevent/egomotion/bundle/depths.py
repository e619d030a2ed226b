"""Depths at nodes, looked for one by one: where the events around have the highest contrast."""

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.egomotion.bundle import images
from jaxevent.egomotion.bundle.path import Path, warp
from jaxevent.egomotion.bundle.tracks import Tracks

LEVELS = 40  # log depths that are tried
SPOT = 12  # px, of which each has its own


def _tried_depths(path: Path, tracks: Tracks, depths: NDArray) -> tuple[NDArray, NDArray]:
    """Signed contrast and number of events about nodes, (n, rows, columns), by inverse depth."""
    events = slice(tracks.events)
    at = tracks.x[events], tracks.y[events], tracks.tau[events]
    real, none = tracks.x.dtype, np.zeros_like(at[0])
    rx, ry = warp(path, tracks.f, *at, none)
    X, Y = warp(path, tracks.f, *at, none + 1)
    S, N = np.empty((len(depths), *tracks.nodes)), np.empty((len(depths), *tracks.nodes))
    both, work = np.empty((2, *tracks.shape), real), np.empty(tracks.shape, real)
    strips = np.empty((2, tracks.nodes[0], tracks.shape[1]))
    images.depth_maps(
        np.stack([rx, ry, X - rx, Y - ry]).astype(real), tracks.p[events], depths.astype(real),
        tracks.corner, tracks.node, SPOT, both, work, strips, S, N,
    )  # fmt: skip
    return S, N


def depths(path: Path, tracks: Tracks) -> NDArray:
    """Log depths at nodes, each the one of highest contrast around it, for a path that is given.

    They are looked for at those the path has and up to 2.5 times nearer and farther. Beside
    an edge of depth the nearer surface's is found, to which the edge's events belong. Where there
    are few events they are those of the surroundings.
    """
    low, high = np.percentile(path.log_rho, [5.0, 95.0]).tolist()
    low, high = low - np.log(2.5), high + np.log(2.5)
    S, n = (
        scipy.ndimage.gaussian_filter(part, (0, 1.5, 1.5))
        for part in _tried_depths(path, tracks, np.exp(np.linspace(low, high, LEVELS)))
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
    usual = float(np.median(path.log_rho))
    return ((total + 1e-9 * usual) / (weight + 1e-9)).ravel().astype(tracks.x.dtype)
