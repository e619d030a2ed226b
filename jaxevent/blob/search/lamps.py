"""Lamps: what flickers with the mains and stays where it is, is no target.

Light from the mains brightens and fades twice in each of their periods, all over a lamp at once:
its events are ON in one half of each hundredth or 120th of a second and OFF in the other. Of n
events with signs s at times t (s) the share that comes in time is, without the part of chance,

    (|sum s exp(2 pi i f t)|^2 - n) / (n^2 - n),

0 for events of any other kind. It is the median over pieces of time: the mains are not held to a
hertz exactly, and targets pass before lamps.
"""

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.paths import NOBODY, Path, join
from jaxevent.blob.search.stream import near_paths
from jaxevent.blob.search.targets import GATE
from jaxevent.recording import Recording

MAINS = np.array([50.0, 60.0])  # Hz
PIECE = 250_000  # us; at half a hertz beside f an eighth of a turn
# The share in time of lamps whose light goes on and off within 0.5 and 1 ms is 0.9 and 0.7 to 0.5,
# of targets that pass before them below 0.3; seeds 30 to 33 of the scenes with flicker.
IN_TIME = 0.36
ENOUGH = 1000  # events of a piece that tell its share
SIGMAS = 5.0  # of what chance makes of the share
STAYS = 3.0  # sizes from its median place, where it is while it comes in time: a lamp is no farther
QUARTERS = 4  # of a track's rows: one that stays in none of them is no lamp


def without_lamps(
    paths: list[Path], recording: Recording, hot: NDArray[np.bool_]
) -> tuple[list[Path], int]:
    """The paths that are none of lamps, and how many are. `hot` (rows, columns) are left out."""
    some = [
        k
        for k, path in enumerate(paths)
        if any(_stays(path, rows) for rows in np.array_split(np.arange(len(path.t)), QUARTERS))
    ]
    if not some:
        return paths, 0
    begin = min(paths[k].begin for k in some)
    lamps = set()
    for k, shares in zip(some, _in_time([paths[k] for k in some], recording, hot), strict=True):
        # A track that hops between a lamp and targets is that of the lamp if it is mostly there.
        rows = np.flatnonzero(shares[(paths[k].t - begin) // PIECE] > IN_TIME)
        if np.nanmedian(shares) > IN_TIME and _stays(paths[k], rows):
            lamps.add(k)
    return [path for k, path in enumerate(paths) if k not in lamps], len(lamps)


def _stays(path: Path, rows: NDArray[np.int64]) -> bool:
    """Whether a path is near one place at most of the times of some rows."""
    if not len(rows):
        return False
    p = path.p[rows]
    away = np.hypot(*(p - np.median(p, 0)).T)
    return bool(np.median(away) <= STAYS * np.median(path.size[rows, 0]))


def _in_time(
    paths: list[Path], recording: Recording, hot: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The share (paths, pieces) of events that comes in time with the mains; NaN without events.

    Pieces begin with the first of the paths; all of a path are 0 where it may be chance.
    """
    joined = join(paths)
    begin = joined.begins.min()
    pieces = (joined.ends.max() - begin) // PIECE + 1
    faintest = min(float(np.median(path.n)) / path.window for path in paths)
    every = max(1, int(faintest * PIECE / ENOUGH))
    n = np.zeros((len(paths), pieces))
    z = np.zeros((len(MAINS), len(paths) * pieces), complex)
    for _, part, near in near_paths(recording.events, joined, GATE, every=every):
        whose = near[:, 0]
        seen = (whose != NOBODY) & ~hot[part.y, part.x]
        t = part.t[seen] - begin
        place = whose[seen] * pieces + t // PIECE
        n += np.bincount(place, minlength=n.size).reshape(n.shape)
        for f, sums in zip(2 * MAINS, z, strict=True):
            turned = np.exp(2e-6j * np.pi * f * t) * np.where(part.p[seen], 1, -1)
            sums += np.bincount(place, turned.real, n.size)
            sums += 1j * np.bincount(place, turned.imag, n.size)
    power = np.abs(z.reshape(len(MAINS), *n.shape)) ** 2 - n
    best = power.sum(2).argmax(0)
    power = np.take_along_axis(power, best[None, :, None], 0)[0]
    # Then some piece has more than one event.
    sure = power.sum(1) > SIGMAS * np.sqrt((n**2).sum(1))
    each = np.where(n > 1, power / np.maximum(n**2 - n, 1), np.nan)
    return np.where(sure[:, None], each, 0.0)
