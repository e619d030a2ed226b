"""Which events remain: by time, polarity, hot pixels, background activity and dead time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit
from jaxevent.errors import InputError
from jaxevent.events.images import count_events
from jaxevent.events.parts import Part, Size, duration, select, size_of
from jaxevent.recording import Events, Recording, Times, microseconds

LONG_AGO = np.iinfo(np.int64).min // 2  # us


def crop_time(part: Part, start: Times | None = None, stop: Times | None = None) -> Part:
    """The part with start <= t < stop; None: from the beginning, to the end.

    Of a recording the same as `recording[start:stop]`, which raises `InputError` where nothing is.
    """
    if isinstance(part, Recording):
        return part[start:stop]
    ends = [None if time is None else int(microseconds(time)) for time in (start, stop)]
    return part[slice(*(None if us is None else part.index(us) for us in ends))]


def select_polarity(part: Part, on: bool = True) -> Part:
    """Only the ON events, or with `on=False` only the OFF events."""
    return select(part, lambda events: events.p == on)


def is_hot(
    counts: NDArray[np.integer], ratio: float | int = 5, least: int = 20
) -> NDArray[np.bool_]:
    """Which pixels are hot (H, W), by how many events each fired (H, W).

    A hot pixel fired more than `ratio` times as often as the busiest of its neighbours, and at
    least `least` times. An edge that passes has busy neighbours.
    """
    return (counts >= least) & (counts > ratio * busiest_neighbour(counts))


def busiest_neighbour(counts: NDArray[np.integer]) -> NDArray[np.integer]:
    """The most events (H, W) that one of the 8 pixels around each fired, by counts (H, W)."""
    height, width = counts.shape
    around = np.pad(counts, 1)
    busiest = np.zeros_like(counts)
    for dy in range(3):
        for dx in range(3):
            if (dy, dx) != (1, 1):
                np.maximum(busiest, around[dy : dy + height, dx : dx + width], out=busiest)
    return busiest


def find_hot_pixels(part: Events | Recording, *, size: Size | None = None) -> NDArray[np.bool_]:
    """Which pixels are hot, (H, W); see `is_hot`. `jaxevent info` counts the same ones."""
    return is_hot(count_events(part, size=size))


def remove_hot_pixels(
    part: Part, hot: NDArray[np.bool_] | None = None, *, size: Size | None = None
) -> Part:
    """Without the events of hot pixels: `hot` (H, W), by default those that are found."""
    width, height = size_of(part, size)
    if hot is None:
        hot = find_hot_pixels(part, size=size)
    if hot.shape != (height, width) or hot.dtype != np.bool_:
        raise InputError(
            f"hot pixels are {hot.dtype} of shape {hot.shape}; give bool of ({height}, {width})"
        )
    return select(part, lambda events: ~hot[events.y, events.x])


def filter_background(
    part: Part, window: int | float, neighbours: int = 1, *, size: Size | None = None
) -> Part:
    """Without background activity: events that nothing around them supports are left out.

    An event remains if `neighbours` or more of the 8 pixels around it have fired at most `window`
    (us or s) before. Those may have been left out themselves. (Delbruck, "Frame-free dynamic
    digital vision", 2008. dv-processing's `BackgroundActivityNoiseFilter` says less than `window`,
    and keeps the same events for a window 1 us longer. tonic's `Denoise` looks at 4 pixels.)
    """
    width, height = size_of(part, size)
    reach = duration(window, "the window of the background filter")
    if not 1 <= neighbours <= 8:
        raise InputError(f"{neighbours} of 8 neighbours are not possible; give 1 to 8")
    last = np.full((height + 2, width + 2), LONG_AGO)
    return select(part, lambda e: supported(e.t, e.x, e.y, last, reach, neighbours))


@njit
def supported(t: Any, x: Any, y: Any, last: Any, reach: Any, neighbours: Any) -> Any:
    """Events of which `neighbours` of the 8 pixels around fired at most `reach` us before.

    `last` (H + 2, W + 2), with a border, holds the times before and is written over.
    """
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        count = 0
        for row in range(int(y[i]), int(y[i]) + 3):
            for column in range(int(x[i]), int(x[i]) + 3):
                centre = row == int(y[i]) + 1 and column == int(x[i]) + 1
                count += not centre and t[i] - last[row, column] <= reach
        kept[i] = count >= neighbours
        last[int(y[i]) + 1, int(x[i]) + 1] = t[i]
    return kept


def filter_refractory(part: Part, period: int | float, *, size: Size | None = None) -> Part:
    """Only events at least `period` (us or s) after the one kept before at the same pixel.

    As a pixel with that dead time would have fired. (tonic's `RefractoryPeriod` measures from the
    event before, kept or not, so that a fast pixel falls silent.)
    """
    width, height = size_of(part, size)
    dead = duration(period, "the refractory period")
    last = np.full((height, width), LONG_AGO)
    return select(part, lambda e: _ready(e.t, e.x, e.y, last, dead))


@njit
def _ready(t, x, y, last, dead):
    """Events at least `dead` us after the last one kept at their pixel; `last` is written over."""
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        kept[i] = t[i] - last[y[i], x[i]] >= dead
        if kept[i]:
            last[y[i], x[i]] = t[i]
    return kept
