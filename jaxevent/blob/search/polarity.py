"""Tests of the polarities of a path's events: lamps on the mains, and a polarity that lags.

Light from the mains brightens and fades twice in each of their periods, all over a lamp at once:
its events are ON in one half of each hundredth or 120th of a second and OFF in the other. Of n
events with signs s at times t (s) the coherence is, without the part of chance,

    (|sum s exp(2 pi i f t)|^2 - n) / (n^2 - n),

0 for events of any other kind. It is the median over pieces of time: the mains are not held to a
hertz exactly, and targets pass before lamps. Of lamps whose light goes on and off within 0.5 and
1 ms it is 0.9 and 0.7 to 0.5.

A dim light makes ON events at its edge, and OFF events for long after it has gone on. Their mean
lies in the tail, behind the light: the ON events alone show its position.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.owners import NO_OWNER_INDEX
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import Blobs, add_moments
from jaxevent.blob.search.paths import TargetPath, fit_velocity_noise, tabulate_paths
from jaxevent.blob.search.stream import Stream
from jaxevent.codegen import njit_noalloc

MAINS_HZ = np.array([50.0, 60.0])


def drop_lamps(paths: list[TargetPath], stream: Stream) -> tuple[list[TargetPath], int]:
    """Drop the paths of lamps on the mains.

    Args:
        paths: Paths of targets and lamps.
        stream: Events.

    Returns:
        The other paths, and the number of lamps.
    """
    some = []
    for k, path in enumerate(paths):
        quarters = np.array_split(np.arange(len(path.t)), round(1 / CONFIG.considerable))
        if any(_stays(path, rows) for rows in quarters):
            some.append(k)
    if not some:
        return paths, 0
    begin = min(paths[k].begin for k in some)
    lamps = set()
    each = _mains_coherence([paths[k] for k in some], stream)
    for k, coherence in zip(some, each, strict=True):
        # A track that hops between a lamp and targets is that of the lamp if it is mostly there.
        piece = (paths[k].t - begin) // CONFIG.lamp_piece_us
        rows = np.flatnonzero(coherence[piece] > CONFIG.lamp_coherence)
        if np.nanmedian(coherence) > CONFIG.lamp_coherence and _stays(paths[k], rows):
            lamps.add(k)
    return [path for k, path in enumerate(paths) if k not in lamps], len(lamps)


def _stays(path: TargetPath, rows: NDArray[np.int64]) -> bool:
    """Return whether a path is near one place in most of some rows.

    Args:
        path: The path.
        rows: Rows of the path.

    Returns:
        Whether it is.
    """
    if not len(rows):
        return False
    p = path.p[rows]
    away = np.hypot(*(p - np.median(p, 0)).T)
    return bool(np.median(away) <= CONFIG.gate_sigmas * np.median(path.size[rows, 0]))


def _mains_coherence(paths: list[TargetPath], stream: Stream) -> NDArray[np.float64]:
    """Compute the coherence (paths, pieces) of events with the mains; NaN without events.

    Pieces begin with the first of the paths. A path whose coherence may be chance has 0.
    """
    table, piece = tabulate_paths(paths), CONFIG.lamp_piece_us
    begin = table.begins.min()
    pieces = (table.ends.max() - begin) // piece + 1
    faintest = min(float(np.median(path.n)) / path.window for path in paths)
    every = max(1, int(faintest * piece / CONFIG.min_recording_events / 10))
    n = np.zeros((len(paths), pieces))
    z = np.zeros((len(MAINS_HZ), len(paths) * pieces), complex)
    for part, near in stream.near(table, CONFIG.gate_sigmas, every):
        owner = near[:, 0]
        seen = owner != NO_OWNER_INDEX
        t = part.t[seen] - begin
        place = owner[seen] * pieces + t // piece
        n += np.bincount(place, minlength=n.size).reshape(n.shape)
        for f, sums in zip(2 * MAINS_HZ, z, strict=True):
            turned = np.exp(2e-6j * np.pi * f * t) * np.where(part.p[seen], 1, -1)
            sums += np.bincount(place, turned.real, n.size)
            sums += 1j * np.bincount(place, turned.imag, n.size)
    power = np.abs(z.reshape(len(MAINS_HZ), *n.shape)) ** 2 - n
    best = power.sum(2).argmax(0)
    power = np.take_along_axis(power, best[None, :, None], 0)[0]
    # Then some piece has more than one event.
    sure = power.sum(1) > CONFIG.lamp_sigmas * np.sqrt((n**2).sum(1))
    each = np.where(n > 1, power / np.maximum(n**2 - n, 1), np.nan)
    return np.where(sure[:, None], each, 0.0)


def prefer_sharper(paths: list[TargetPath], stream: Stream) -> list[TargetPath]:
    """Replace paths by those of the sharper polarity's events, where the other polarity lags.

    Args:
        paths: Paths of targets.
        stream: Events.
    """
    if not paths:
        return paths
    table = tabulate_paths(paths)
    first = table.first
    # Few of the events of bright targets suffice to find that no polarity lags.
    least = min(float(np.median(path.n)) for path in paths)
    some = max(1, int(least / CONFIG.min_recording_events))
    sharper = paths
    for every in dict.fromkeys((some, 1)):
        sums = Blobs.zeros(2 * len(table.t))
        for part, owner in stream.near(table, CONFIG.gate_sigmas, every):
            events = part.t, part.x, part.y, part.p
            _add_residuals(events, owner, table, first[:-1].copy(), sums)
        rows = zip(paths, first[:-1], first[1:], strict=True)
        sharper = [
            _sharper_path(path, Blobs(*(value[2 * a : 2 * b] for value in sums)))
            for path, a, b in rows
        ]
        if all(one is path for one, path in zip(sharper, paths, strict=True)):
            break
    return sharper


def _sharper_path(path: TargetPath, sums: Blobs) -> TargetPath:
    """Return the path of its sharper events, or the path itself.

    `sums` are those of its residuals, of OFF and of ON events by turns.

    Args:
        path: The path.
        sums: Moments of the residuals of OFF and of ON events by turns, two rows for each of the
            path.

    Returns:
        The path of those of one sign; the path itself if both are as sharp.
    """
    n, p, S = (value.reshape(-1, 2, *value.shape[1:]) for value in sums)
    mean = p / np.maximum(n, 1)[..., None]
    within = S - n[..., None, None] * mean[..., :, None] * mean[..., None, :]
    within[..., 1, 0] = within[..., 0, 1]
    spread = (within * (n > 1)[..., None, None]).sum(0)
    spread /= np.maximum((n - (n > 0)).sum(0), 1)[:, None, None]
    spread += np.eye(2) / 12
    size = np.sqrt(np.linalg.eigvalsh(spread)[:, 1])
    sharp = int(size[1] <= size[0])
    seen = n[:, sharp] > 1
    enough = seen.sum() >= CONFIG.min_confirm_windows
    enough &= n[:, sharp].sum() >= CONFIG.considerable * n.sum()
    enough &= (n[:, 1 - sharp] > 1).sum() >= CONFIG.min_confirm_windows
    if not enough or size[1 - sharp] < CONFIG.lag_ratio * size[sharp]:
        return path
    t = path.t * 1e-6
    m = (path.p + mean[:, sharp])[seen]
    p = np.stack([np.interp(t, t[seen], m[:, i]) for i in range(2)], 1)
    R = size[sharp] ** 2 / 2 / n[seen, sharp]
    noise = fit_velocity_noise(t[seen], m, R, size[sharp] ** 2 / (path.window * 1e-6) ** 3)
    C, share = np.broadcast_to(spread[sharp], path.C.shape), n[:, sharp].sum() / n.sum()
    return dataclasses.replace(
        path, p=p, C=C, n=share * path.n, velocity_noise=noise, polarity=sharp
    )


@njit_noalloc
def _add_residuals(events: Any, owner: Any, table: Any, rows: Any, sums: Any) -> None:
    """Add events' residuals to the sums of their paths' windows, OFF and ON by turns.

    Events that may belong to two paths are left out.

    Args:
        events: Columns t (us), x, y (px) and p, (n,) each.
        owner: (n, 2) likeliest paths of each event, -1: none.
        table: `PathTable` of the paths.
        rows: (paths,) row of each path where the search for a window begins, in place.
        sums: `Blobs` of two rows for each row of the table, added to.
    """
    t, x, y, p = events
    for i in range(len(t)):
        k = owner[i, 0]
        if k < 0 or owner[i, 1] >= 0:
            continue
        last, half = table.first[k + 1] - 1, table.window[k] / 2
        while rows[k] < last and table.t[rows[k]] + half <= t[i]:
            rows[k] += 1
        row = rows[k]
        if abs(t[i] - table.t[row]) > half:
            continue
        before, after = max(row - 1, table.first[k]), min(row + 1, last)
        span = max(table.t[after] - table.t[before], 1)
        late = (t[i] - table.t[row]) / span
        ex = x[i] - table.p[row, 0] - late * (table.p[after, 0] - table.p[before, 0])
        ey = y[i] - table.p[row, 1] - late * (table.p[after, 1] - table.p[before, 1])
        add_moments(sums, 2 * row + np.int64(p[i]), 1.0, ex, ey)
