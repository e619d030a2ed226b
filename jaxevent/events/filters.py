"""Filters of events by time, polarity, hot pixels, background activity and dead time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import as_array, shorten_value
from jaxevent.codegen import njit
from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.events.blocks import Part, Size, parse_duration, select_events, size_of, source_of
from jaxevent.events.images import count_events
from jaxevent.recording import Events, Recording, Times, one_time

LONG_AGO_US = np.iinfo(np.int64).min // 2  # us


def crop_time(part: Part, start: Times | None = None, stop: Times | None = None) -> Part:
    """Select the events with start <= t < stop.

    For a recording this is `recording[start:stop]`.

    Args:
        part: Events, or a recording.
        start: Begin, us or s; None: the beginning.
        stop: End, us or s; None: the end.

    Returns:
        The same type.

    Raises:
        InputError: A recording has nothing in that time.
    """
    if isinstance(part, Recording):
        return part[start:stop]
    source = source_of(part)
    ends = [None if time is None else one_time(time) for time in (start, stop)]
    return part[slice(*(None if us is None else source.index(us) for us in ends))]


def select_polarity(part: Part, on: bool | int = True) -> Part:
    """Select the events of one polarity.

    Args:
        part: Events, or a recording.
        on: True or 1 for ON events; False, 0 or -1 for OFF events.

    Returns:
        The same type.

    Raises:
        InputError: It is none of these.
    """
    if np.ndim(on) or on not in (True, False, -1):
        raise InputError(
            f"the polarity {shorten_value(on)} is not possible; give True for ON events, False for "
            "OFF events"
        )
    return select_events(part, lambda events: events.p == (on == 1))


def is_hot(
    counts: NDArray[np.integer], ratio: float | int = 5, least: int = 20
) -> NDArray[np.bool_]:
    """Find hot pixels by the number of events of each.

    A hot pixel fired more often than its neighbours. An edge that passes has busy neighbours.

    Args:
        counts: (H, W) events of each pixel.
        ratio: Factor on the count of the busiest neighbour that a hot pixel exceeds.
        least: Least count of a hot pixel.

    Returns:
        (H, W), True for hot pixels.
    """
    return (counts >= least) & (counts > ratio * max_neighbour_count(counts))


def max_neighbour_count(counts: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return the largest count among the 8 neighbours of each pixel, (H, W), of counts (H, W)."""
    height, width = counts.shape
    around = np.pad(counts, 1)
    busiest = np.zeros_like(counts)
    for dy in range(3):
        for dx in range(3):
            if (dy, dx) != (1, 1):
                np.maximum(busiest, around[dy : dy + height, dx : dx + width], out=busiest)
    return busiest


def find_hot_pixels(part: Events | Recording, *, size: Size | None = None) -> NDArray[np.bool_]:
    """Find hot pixels as `is_hot` does by default; `jaxevent info` counts the same ones.

    Args:
        part: Events, or a recording.
        size: Width and height of the sensor, for events alone.

    Returns:
        (H, W), True for hot pixels.
    """
    return is_hot(count_events(part, size=size))


def remove_hot_pixels(
    part: Part, hot: NDArray[np.bool_] | None = None, *, size: Size | None = None
) -> Part:
    """Remove the events of hot pixels.

    Args:
        part: Events, or a recording.
        hot: (H, W), True for hot pixels; None: those of `find_hot_pixels`.
        size: Width and height of the sensor, for events alone.

    Returns:
        The same type.

    Raises:
        InputError: `hot` has another shape or type.
    """
    width, height = size_of(part, size)
    if hot is None:
        hot = find_hot_pixels(part, size=size)
    hot = as_array(hot, "hot")
    if hot.shape != (height, width) or hot.dtype != np.bool_:
        raise InputError(
            f"hot pixels are {hot.dtype} of shape {hot.shape}; give bool of ({height}, {width})"
        )
    return select_events(part, lambda events: ~hot[events.y, events.x])


def filter_background(
    part: Part, window: int | float, neighbours: int = 1, *, size: Size | None = None
) -> Part:
    """Remove background activity: events that no event nearby supports.

    An event remains if enough of the 8 pixels around it have fired shortly before. The supporting
    events may have been removed themselves. (Delbruck, "Frame-free dynamic digital vision", 2008.
    dv-processing's `BackgroundActivityNoiseFilter` requires less than `window`, and keeps the same
    events for a window 1 us longer. tonic's `Denoise` uses 4 pixels.)

    Args:
        part: Events, or a recording.
        window: Longest time between an event and its support, us or s.
        neighbours: Least number of supporting pixels, 1 to 8.
        size: Width and height of the sensor, for events alone.

    Returns:
        The same type.

    Raises:
        InputError: The window is shorter than 1 us, or the number of neighbours is not possible.
    """
    width, height = size_of(part, size)
    window_us = parse_duration(window, "the window of the background filter")
    if not 1 <= neighbours <= 8:
        raise InputError(f"{neighbours} of 8 neighbours are not possible; give 1 to 8")
    last = np.full((height + 2, width + 2), LONG_AGO_US)
    return select_events(part, lambda e: find_supported(e.t, e.x, e.y, last, window_us, neighbours))


@njit
def find_supported(
    t: Any, x: Any, y: Any, last_t: Any, max_age_us: Any, min_neighbours: Any
) -> Any:
    """Find events that pixels around them support.

    Args:
        t: (n,) times, us, in order.
        x: (n,) columns.
        y: (n,) rows.
        last_t: (H + 2, W + 2) last time of each pixel, us, with a border; updated.
        max_age_us: Longest time between an event and its support, us.
        min_neighbours: Least number of supporting pixels.

    Returns:
        (n,), True for supported events.
    """
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        count = 0
        for row in range(int(y[i]), int(y[i]) + 3):
            for column in range(int(x[i]), int(x[i]) + 3):
                centre = row == int(y[i]) + 1 and column == int(x[i]) + 1
                count += not centre and t[i] - last_t[row, column] <= max_age_us
        kept[i] = count >= min_neighbours
        last_t[int(y[i]) + 1, int(x[i]) + 1] = t[i]
    return kept


def filter_refractory(part: Part, period: int | float, *, size: Size | None = None) -> Part:
    """Remove events within a dead time after the last one kept at the same pixel.

    What remains is what a pixel with that dead time would have fired. (tonic's `RefractoryPeriod`
    measures from the event before, kept or not, so that a fast pixel falls silent.)

    Args:
        part: Events, or a recording.
        period: The dead time, us or s.
        size: Width and height of the sensor, for events alone.

    Returns:
        The same type.

    Raises:
        InputError: The period is shorter than 1 us.
    """
    width, height = size_of(part, size)
    dead_us = parse_duration(period, "the refractory period")
    last = np.full((height, width), LONG_AGO_US)
    return select_events(part, lambda e: _outside_dead_time(e.t, e.x, e.y, last, dead_us))


@njit
def _outside_dead_time(t, x, y, last, dead_us):
    """Find the events that come late enough after the last one kept at their pixel.

    Args:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        last: (height, width) time of the last event kept, us, updated in place.
        dead_us: Dead time, us.

    Returns:
        (n,) booleans.
    """
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        kept[i] = t[i] - last[y[i], x[i]] >= dead_us
        if kept[i]:
            last[y[i], x[i]] = t[i]
    return kept


__getattr__ = renamed_names(__name__)
