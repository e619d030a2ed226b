"""Two cameras and small recordings of them, which tests of registration share."""

import runpy
from pathlib import Path

import numpy as np

from jaxevent.camera import PinholeCamera
from jaxevent.recording import Events, Frames, Recording
from jaxevent.register import Rig

RIGS = runpy.run_path(str(Path(__file__).parents[1] / "experiments" / "register.py"))
ONE = PinholeCamera(110.0, 111.0, 63.0, 48.5, (-0.2, 0.05, 1e-3, -5e-4, 0.0))
TWO = PinholeCamera(160.0, 158.0, 101.0, 74.0, (-0.15, 0.03, -1e-3, 1e-3, 0.01))
SIZE, OTHER = (128, 96), (200, 150)


def turned(x: float, y: float, z: float) -> np.ndarray:
    """Rodrigues' formula."""
    w = np.array([x, y, z])
    angle = np.linalg.norm(w)
    a, b, c = w / angle
    K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


RIG = Rig(ONE, TWO, turned(0.02, -0.03, 0.05), np.array([-0.1, 0.02, 0.01]))


def events(t, x, y, p) -> Events:
    fields = (
        np.array(t, np.int64),
        np.array(x, np.uint16),
        np.array(y, np.uint16),
        np.array(p, bool),
    )
    return Events(*fields)


def small(frames: int = 6) -> tuple[Recording, Recording]:
    t = np.arange(0, 100_000, 500)
    own = events(t, t // 500 % 8, t // 500 % 6, t % 1000 == 0)
    extra = {"gain": np.full(2, 2.0), "hot": np.zeros((1, 2)), "hdr": np.ones((1, 6, 8)), "kept": t}
    old = Frames(np.array([0, 9]), np.zeros((2, 6, 8), np.uint8), np.zeros(2, np.int64))
    recording = Recording("own", 8, 6, own, old, PinholeCamera(9.0, 9.0, 4.0, 3.0), extra=extra)
    images = np.full((frames, 6, 8), 100, np.uint8)
    rgb = np.full((frames, 6, 8, 3), 50, np.uint8)
    stamps = np.arange(frames) * 20_000 + 5_000_000
    other = Recording(
        "other", 8, 6, Events.empty(), Frames(stamps, images, np.full(frames, 3_000)),
        extra={"rgb": rgb, "gain": np.arange(1.0, frames + 1)},
    )  # fmt: skip
    return recording, other


def part_grid() -> np.ndarray:
    grid = np.moveaxis(np.mgrid[:6, :8], 0, -1)[..., ::-1].astype(float)
    grid[:, :2] = np.nan
    grid[0, 5] = np.nan
    return grid
