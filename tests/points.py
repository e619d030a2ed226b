"""Points that follow a known flow."""

import numpy as np

from jaxevent.recording import Events, Recording

WIDTH, HEIGHT = 120, 90


def recorded(t, x, y, p, width=WIDTH, height=HEIGHT, camera=None):
    events = Events(
        np.asarray(t, np.int64), np.asarray(x, np.uint16), np.asarray(y, np.uint16),
        np.asarray(p, bool),
    )  # fmt: skip
    return Recording("made", width, height, events, camera=camera)


def moved(flow, seconds, number, seed, camera=None):
    """Points that follow flow(positions) in px/s, each an event at every pixel that it enters."""
    rng = np.random.default_rng(seed)
    at = rng.uniform([0, 0], [WIDTH, HEIGHT], (number, 2))
    sign, cell, dt, rows = rng.random(number) < 0.5, np.floor(at), 4e-4, []
    for k in range(int(seconds / dt)):
        at = at + flow(at - 0.5) * dt  # a pixel's centre is at its whole coordinates
        left = (at < 0).any(1) | (at >= [WIDTH, HEIGHT]).any(1)
        at = np.where(left[:, None], np.mod(at, [WIDTH, HEIGHT]), at)
        new = np.flatnonzero((np.floor(at) != cell).any(1) & ~left)
        cell = np.floor(at)
        rows.append(np.stack([1e6 * dt * (k + rng.random(len(new))), *cell[new].T, sign[new]], 1))
    t, x, y, p = np.concatenate(rows)[np.argsort(np.concatenate(rows)[:, 0])].T
    return recorded(t, x, y, p, camera=camera)


def turning(omega):
    """The flow of a camera that turns, by the derivative of projected points: P' = -omega x P."""

    def flow(at):
        P = np.stack([(at[:, 0] - 59.5) / 100, (at[:, 1] - 44.5) / 100, np.ones(len(at))], 1)
        V = -np.cross(omega, P)
        return 100 * (V[:, :2] - P[:, :2] * V[:, 2:])

    return flow
