"""Points that follow a known flow, events without order, and a search of candidates by loops."""

import numpy as np

from jaxevent.recording import Events, Recording

WIDTH, HEIGHT = 120, 90


def recorded(t, x, y, p, width=WIDTH, height=HEIGHT, camera=None):
    """Make a recording of events in any order."""
    order = np.argsort(t, kind="stable")
    columns = zip((t, x, y, p), (np.int64, np.uint16, np.uint16, bool), strict=True)
    events = Events(*(np.asarray(column, kind)[order] for column, kind in columns))
    return Recording("made", width, height, events, camera=camera)


def moved(flow, seconds, number, seed=0, camera=None, size=(WIDTH, HEIGHT)):
    """Points that follow flow(positions) in px/s, each an event at every pixel that it enters."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(0, size, (number, 2))
    sign, cell, dt, rows = rng.random(number) < 0.5, np.floor(at), 4e-4, []
    for k in range(int(seconds / dt)):
        at = at + flow(at - 0.5) * dt  # a pixel's centre is at its whole coordinates
        left = (at < 0).any(1) | (at >= size).any(1)
        at = np.where(left[:, None], np.mod(at, size), at)
        new = np.flatnonzero((np.floor(at) != cell).any(1) & ~left)
        cell = np.floor(at)
        rows.append(np.stack([1e6 * dt * (k + rng.random(len(new))), *cell[new].T, sign[new]], 1))
    return recorded(*np.concatenate(rows).T, *size, camera)


def turning(omega, f=100, centre=(59.5, 44.5)):
    """The flow of a camera that turns, by the derivative of projected points: P' = -omega x P."""

    def flow(at):
        P = np.concatenate([(at - centre) / f, np.ones((len(at), 1))], 1)
        V = -np.cross(omega, P)
        return f * (V[:, :2] - P[:, :2] * V[:, 2:])

    return flow


def scattered(number, span, width, height, step, seed=0, camera=None):
    """Random events, many at the same time, all over a small sensor."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, span, number)) // step * step
    x, y, p = (rng.integers(0, n, number) for n in (width, height, 2))
    return recorded(t, x, y, p, width, height, camera)


def search_candidates(recording, row, radius, per_pixel, youngest, oldest):
    """(dx, dy, age in us) of an event's candidates, among all earlier events."""
    e = recording.events
    found, at_pixel = [], {}
    for i in reversed(range(row)):
        pixel = int(e.x[i]), int(e.y[i])
        dx, dy = int(e.x[row]) - pixel[0], int(e.y[row]) - pixel[1]
        if e.p[i] != e.p[row] or max(abs(dx), abs(dy)) > radius:
            continue
        at_pixel[pixel] = at_pixel.get(pixel, 0) + 1
        age = int(e.t[row] - e.t[i])
        if at_pixel[pixel] <= per_pixel and age > 0 and youngest <= age <= oldest:
            found.append((dx, dy, age))
    return sorted(found)
