"""A recording of noise, and configurations that name it."""

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Events, Frames, Recording

WIDTH, HEIGHT = 24, 20


STAMPS = np.array([0, 9_000, 21_000, 30_000, 41_000, 52_000])


def small(**fields) -> Recording:
    """A recording of 400 events and 6 frames of noise, 24x20 pixels."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(1_000, 50_000, 400))
    x, y = rng.integers(0, WIDTH, 400), rng.integers(0, HEIGHT, 400)
    events = Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(400) < 0.5)
    images = rng.integers(0, 256, (len(STAMPS), HEIGHT, WIDTH)).astype(np.uint8)
    frames = Frames(STAMPS, images, np.zeros_like(STAMPS))
    return dataclasses.replace(Recording("small", WIDTH, HEIGHT, events, frames), **fields)


def write_config(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text)
    return path


ONE = 'recordings = ["small.h5"]\n[[method]]\nname = "blend"\n'


CLIP = (0.05, 1.0)


def grey() -> NDArray:
    return np.asarray(small().frames.images) / 255


def hdr_recording(truth: NDArray | None = None, t: NDArray = STAMPS, **extra) -> Recording:
    """`small` with an HDR reference, by default four times the frames: 1/4 of it saturated."""
    images = 4 * grey() if truth is None else truth
    return small(extra={"hdr": images, "hdr_t": t, "clip": np.array(CLIP), **extra})
