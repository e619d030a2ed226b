"""A texture that moves, its events with known thresholds."""

import functools

import numpy as np

from jaxevent.recording import Events, Frames, Recording

WIDTH, HEIGHT = 20, 16


C_ON, C_OFF, LATE = 0.015, 0.01, 4_300  # thresholds in ln(I + 1); us by which stamps are too early


@functools.cache
def moving() -> Recording:
    """A texture that moves for 0.5 s, its events with known thresholds, 20 frames whose stamps are
    4.3 ms too early."""
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    waves = [(rng.uniform(-0.7, 0.7, 2), rng.uniform(-90, 90), rng.uniform(0, 6)) for _ in range(5)]

    def intensity(t: float) -> np.ndarray:
        phases = [kx * x + ky * y + w * t + p for (kx, ky), w, p in waves]
        return 0.5 + 0.09 * np.sum(np.sin(phases), axis=0)

    step = 2e-4
    level = np.log1p(intensity(0.0))
    found = []
    before = level.copy()
    for k in range(1, 2501):
        now = np.log1p(intensity(k * step))
        for sign, c in ((1, C_ON), (-1, C_OFF)):
            crossed = sign * (now - level) >= c
            level = np.where(crossed, level + sign * c, level)
            row, column = np.nonzero(crossed)
            part = (level - before)[crossed] / (now - before)[crossed]
            t = np.rint(1e6 * step * (k - 1 + part)).astype(np.int64)
            found.append((t, column, row, np.full(len(t), sign > 0)))
        before = now
    t, column, row, up = (np.concatenate(field) for field in zip(*found, strict=True))
    order = np.argsort(t, kind="stable")
    events = Events(
        t[order], column[order].astype(np.uint16), row[order].astype(np.uint16), up[order]
    )
    stamps = np.arange(5_000, 500_000, 25_000)
    images = np.stack([intensity((stamp + LATE) * 1e-6) for stamp in stamps])
    frames = Frames(stamps, np.rint(255 * images.clip(0, 1)).astype(np.uint8), 0 * stamps)
    return Recording("moving", WIDTH, HEIGHT, events, frames).check()
