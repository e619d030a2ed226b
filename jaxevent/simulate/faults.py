"""Recordings with faults, made of sound ones, for tests of what finds or survives a fault.

    from jaxevent.simulate import faults

    faulty = faults.delay_frames(recording, 0.02)
    for name, make_faulty in faults.FAULTS.items():
        faulty = make_faulty(recording, seed)

All are pure functions, deterministic in their seed. Events are held in memory.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.events import crop
from jaxevent.recording import Events, Frames, Recording


def _with_events(recording: Recording, rows: Any = slice(None), **columns: NDArray) -> Recording:
    """Choose events by rows, then replace some of their columns.

    Args:
        recording: The recording.
        rows: Rows to keep, of all that `Events` takes.
        **columns: New columns (n,) of the rows that are kept, by name.

    Returns:
        The recording with these events.
    """
    events = recording.events[:][rows]
    return dataclasses.replace(recording, events=dataclasses.replace(events, **columns))


def _frames_of(recording: Recording) -> Frames:
    """Return the frames; raise `InputError` where there are none."""
    if recording.frames is None:
        raise InputError(f"{recording.name}: has no frames to change; give a recording with frames")
    return recording.frames


def _with_images(recording: Recording, change: Callable[[NDArray], NDArray]) -> Recording:
    """Change the grey values of frames, which are then rounded and clipped.

    Args:
        recording: A recording with frames.
        change: Function of grey values (frames, height, width) in [0, 1] that returns new ones.

    Returns:
        The recording with these frames.
    """
    frames = _frames_of(recording)
    kind = frames.images.dtype
    grey = np.clip(change(frames.intensity), 0, 1)
    if kind.kind == "u":
        grey = np.rint(grey * (2 ** (8 * kind.itemsize) - 1))
    return dataclasses.replace(
        recording, frames=dataclasses.replace(frames, images=grey.astype(kind))
    )


def drop_packets(
    recording: Recording, seed: int = 0, *, share: float | int = 0.5, packet: float | int = 0.01
) -> Recording:
    """Drop the events of some packets, as a full buffer on the way to the disk does.

    Args:
        recording: The recording.
        seed: Seed of the choice.
        share: Share of the packets that are dropped.
        packet: Length of a packet, s.

    Returns:
        The recording with the events of the other packets.
    """
    t = recording.events[:].t
    number = (t - recording.start) // round(packet * 1e6)
    dropped = np.random.default_rng(seed).random(int(number.max(initial=0)) + 1) < share
    return _with_events(recording, ~dropped[number])


def cut_events(recording: Recording, seed: int = 0, *, length: float | int = 0.05) -> Recording:
    """Cut out the events of one span of time, drawn from those with many events.

    Args:
        recording: The recording.
        seed: Seed of the span's place: about a random event.
        length: Length of the span, s.

    Returns:
        The recording without the events of the span, whose stamps stay as they were.
    """
    t = recording.events[:].t
    if not len(t):
        return recording
    inner = t[len(t) // 10 : len(t) - len(t) // 10]
    middle = np.random.default_rng(seed).choice(inner)
    return _with_events(recording, abs(t - middle) > length * 5e5)


def invert_polarity(recording: Recording, seed: int = 0) -> Recording:
    """Invert the polarity of all events.

    Args:
        recording: The recording.
        seed: Without effect.

    Returns:
        The recording with ON for OFF.
    """
    return _with_events(recording, p=~recording.events[:].p)


def randomise_polarity(recording: Recording, seed: int = 0) -> Recording:
    """Draw the polarity of every event at random.

    Args:
        recording: The recording.
        seed: Seed of the polarities.

    Returns:
        The recording, whose polarity says nothing.
    """
    p = np.random.default_rng(seed).random(len(recording.events)) < 0.5
    return _with_events(recording, p=p)


def set_polarity_on(recording: Recording, seed: int = 0) -> Recording:
    """Set the polarity of all events to ON, as files without a polarity are read.

    Args:
        recording: The recording.
        seed: Without effect.

    Returns:
        The recording with ON events alone.
    """
    return _with_events(recording, p=np.ones(len(recording.events), bool))


def add_hot_pixels(
    recording: Recording, seed: int = 0, *, share: float | int = 0.2, rate: float | int = 100.0
) -> Recording:
    """Add pixels that fire at random without cause.

    Args:
        recording: The recording.
        seed: Seed of their places, times and polarities.
        share: Share of the pixels that are hot.
        rate: Rate of events of each, Hz.

    Returns:
        The recording with the further events.
    """
    rng, (height, width) = np.random.default_rng(seed), (recording.height, recording.width)
    events, seconds = recording.events[:], (recording.stop - recording.start) * 1e-6
    hot = rng.choice(height * width, round(share * height * width), replace=False)
    place = np.repeat(hot, rng.poisson(rate * seconds, len(hot)))
    t = rng.integers(recording.start, recording.stop + 1, len(place))
    columns = (t, place % width, place // width, rng.random(len(place)) < 0.5)
    new = [
        np.concatenate([getattr(events, name), column.astype(getattr(events, name).dtype)])
        for name, column in zip("txyp", columns, strict=True)
    ]
    order = np.argsort(new[0], kind="stable")
    return dataclasses.replace(recording, events=Events(*(column[order] for column in new)))


def silence_pixels(recording: Recording, seed: int = 0, *, share: float | int = 0.5) -> Recording:
    """Remove all events of some pixels, as where these are broken or masked.

    Args:
        recording: The recording.
        seed: Seed of their places.
        share: Share of the pixels that are silent.

    Returns:
        The recording without the events of these pixels.
    """
    rng, events = np.random.default_rng(seed), recording.events[:]
    dead = rng.random((recording.height, recording.width)) < share
    return _with_events(recording, ~dead[events.y, events.x])


def silence_columns(recording: Recording, seed: int = 0, *, share: float | int = 0.2) -> Recording:
    """Remove all events of the last columns, as where a part of the sensor is masked.

    Args:
        recording: The recording.
        seed: Without effect.
        share: Share of the columns that are silent.

    Returns:
        The recording without the events of these columns.
    """
    return _with_events(recording, recording.events[:].x < round((1 - share) * recording.width))


def flip_rows(recording: Recording, seed: int = 0) -> Recording:
    """Flip the events upside down, and leave the frames.

    Args:
        recording: The recording.
        seed: Without effect.

    Returns:
        The recording with rows of events counted from below.
    """
    y = np.uint16(recording.height - 1) - recording.events[:].y
    return _with_events(recording, y=y)


def flip_columns(recording: Recording, seed: int = 0) -> Recording:
    """Flip the events from left to right, and leave the frames.

    Args:
        recording: The recording.
        seed: Without effect.

    Returns:
        The recording with columns of events counted from the right.
    """
    x = np.uint16(recording.width - 1) - recording.events[:].x
    return _with_events(recording, x=x)


def swap_axes(recording: Recording, seed: int = 0) -> Recording:
    """Swap x and y of the events within the largest square about the centre.

    Args:
        recording: The recording, which is cropped to the square.
        seed: Without effect.

    Returns:
        The square recording with x for y in its events alone.
    """
    side = min(recording.width, recording.height)
    left, top = (recording.width - side) // 2, (recording.height - side) // 2
    square = crop(recording, left, top, side, side)
    events = square.events[:]
    return _with_events(square, x=events.y, y=events.x)


def flicker_frames(recording: Recording, seed: int = 0, *, by: float | int = 0.3) -> Recording:
    """Change the brightness of every frame by a random factor.

    Args:
        recording: The recording, with frames.
        seed: Seed of the factors.
        by: Largest change, as a share.

    Returns:
        The recording with the factors, drawn from [1 - by, 1 + by], in its frames.
    """
    factor = 1 + by * np.random.default_rng(seed).uniform(-1, 1, len(_frames_of(recording)))
    return _with_images(recording, lambda grey: grey * factor[:, None, None])


def clip_frames(recording: Recording, seed: int = 0, *, gain: float | int = 3.0) -> Recording:
    """Make the frames brighter, and clip them at white.

    Args:
        recording: The recording, with frames.
        seed: Without effect.
        gain: Factor on the grey values.

    Returns:
        The recording with the frames.
    """
    return _with_images(recording, lambda grey: grey * np.float32(gain))


def blur_frames(recording: Recording, seed: int = 0) -> Recording:
    """Average each frame with those before and after it, as a long exposure does.

    Args:
        recording: The recording, with frames.
        seed: Without effect.

    Returns:
        The recording with blurred frames whose exposures are unknown.
    """

    def change(grey: NDArray) -> NDArray:
        padded = np.concatenate([grey[:1], grey, grey[-1:]])
        return (padded[:-2] + padded[1:-1] + padded[2:]) / 3

    blurred = _with_images(recording, change)
    frames = _frames_of(blurred)
    unknown = dataclasses.replace(frames, exposure=np.zeros_like(frames.exposure))
    return dataclasses.replace(blurred, frames=unknown)


def delay_frames(recording: Recording, by: float | int) -> Recording:
    """Add a time to the stamps of the frames.

    Args:
        recording: The recording, with frames.
        by: The time, s; negative: stamps are too early.

    Returns:
        The recording with the stamps.
    """
    frames = _frames_of(recording)
    late = dataclasses.replace(frames, t=frames.t + round(by * 1e6))
    return dataclasses.replace(recording, frames=late)


def thin_frames(recording: Recording, seed: int = 0, *, rate: float | int = 3.0) -> Recording:
    """Keep so few frames that their rate is at most that given.

    Args:
        recording: The recording, with frames.
        seed: Without effect.
        rate: The rate, Hz.

    Returns:
        The recording with every n-th frame.
    """
    t = _frames_of(recording).t
    every = max(1, int(np.ceil(1e6 / rate / np.median(np.diff(t))))) if len(t) > 1 else 1
    return recording.with_frames(slice(None, None, every))


# Names of faults, and functions of a recording and a seed.
FAULTS: Mapping[str, Callable[[Recording, int], Recording]] = MappingProxyType(
    {
        "half of the events dropped": drop_packets,
        "50 ms without events": cut_events,
        "polarity inverted": invert_polarity,
        "polarity random": randomise_polarity,
        "polarity all ON": set_polarity_on,
        "20 % hot pixels": add_hot_pixels,
        "half of the pixels dead": silence_pixels,
        "a fifth of the columns dead": silence_columns,
        "rows flipped": flip_rows,
        "columns flipped": flip_columns,
        "axes swapped": swap_axes,
        "frames flicker": flicker_frames,
        "frames clipped": clip_frames,
        "frames blurred": blur_frames,
        "frames at 3 Hz": thin_frames,
        "frames 20 ms late": lambda recording, seed: delay_frames(recording, 0.02),
        "frames 20 ms early": lambda recording, seed: delay_frames(recording, -0.02),
        "clocks disjoint": lambda recording, seed: delay_frames(recording, 3600.0),
    }
)
