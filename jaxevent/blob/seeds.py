"""Seeds of tracks given by the user, and the span of time that is tracked."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.recording import Recording, one_time


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Tracks given by the user, sorted by time."""

    t: NDArray[np.int64]  # (n,) us
    xi: NDArray[np.float64]  # (n, 2) px
    size: NDArray[np.float64]  # (n,) px
    index: NDArray[np.int64]  # (n,) index of each in the user's order


def read_seeds(
    recording: Recording,
    seeds: Sequence[Any] | np.ndarray | None,
    start: int,
    stop: int,
    earliest: int | None = None,
) -> Seeds:
    """Read the user's seeds, and sort them by time.

    Args:
        recording: Recording with the sensor's size.
        seeds: One (x, y, size) or (x, y, size, t) for each, in px and us or s; None: none.
        start: Start of tracking, us.
        stop: Its end, us.
        earliest: Earliest time of a seed, us; those before `start` begin there. None: `start`.

    Returns:
        The seeds.

    Raises:
        InputError: A seed has another form, or is outside the sensor or the time.
    """
    times, positions, sizes = [], [], []
    for number, seed in enumerate([] if seeds is None else seeds):
        name = f"{recording.name}: seed {number}"
        try:
            x, y, size, *time = seed
            x, y, size = (float(v) for v in (x, y, size))
        except (TypeError, ValueError):
            raise InputError(f"{name} is {seed!r}; give x, y, size in px, and its time") from None
        if len(time) > 1 or not (math.isfinite(size) and size > 0):
            raise InputError(
                f"{name} is {seed!r}; give x, y, a size above 0 (standard deviation, px) and, if "
                "it begins later, its time"
            )
        if not (-0.5 <= x <= recording.width - 0.5 and -0.5 <= y <= recording.height - 0.5):
            raise InputError(
                f"{name} at ({x:g}, {y:g}) is outside the {recording.width}x{recording.height} "
                "sensor; give pixel coordinates from 0"
            )
        at = one_time(time[0], f"the time of seed {number}") if time else start
        if not (start if earliest is None else earliest) <= at < stop:
            raise InputError(
                f"{name} begins at {at} us, but events are used from {start} to {stop - 1} us; "
                "integers are microseconds, floats seconds, both on the recording's clock"
            )
        times.append(max(at, start))
        positions.append((x, y))
        sizes.append(size)
    index = np.argsort(times, kind="stable").astype(np.int64)
    xi = np.array(positions, np.float64).reshape(-1, 2)
    return Seeds(
        np.array(times, np.int64)[index], xi[index], np.array(sizes, np.float64)[index], index
    )


def tracking_span(
    recording: Recording,
    start: int | float | None,
    stop: int | float | None,
    *,
    live: bool = False,
) -> tuple[int, int]:
    """Return the span [begin, end) in us in which events are used.

    It lies between the first and the last event: beyond them nothing was recorded, which is not a
    time in which nothing happened.

    Args:
        recording: The recording; without events its frames set the default.
        start: Begin, int us or float s; None: the first event.
        stop: End, int us or float s; None: after the last event.
        live: Whether events are still to come, so that the span may go beyond those of now.

    Returns:
        Begin and end, us.

    Raises:
        InputError: The span is empty.
    """
    if not len(recording.events):
        first, last = 0, 1
        if recording.frames is not None:
            first, last = int(recording.frames.t[0]), int(recording.frames.t[-1]) + 1
    else:
        first, last = recording.event_span()
        last += 1
    begin = first if start is None else one_time(start, "the start")
    end = last if stop is None else one_time(stop, "the stop")
    used = begin, end
    if len(recording.events) and not live:
        used = max(begin, first), min(end, last)
    if used[1] <= used[0]:
        limits = [f"from {begin} us"] * (start is not None) + [f"to {end} us"] * (stop is not None)
        raise InputError(
            f"{recording.name}: nothing to track {' '.join(limits)}; the events reach "
            f"from {first} to {last - 1} us, integers are microseconds, floats seconds"
        )
    return used
