"""Passes over `Events` and recordings, block by block."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.progress import bar
from jaxevent.recording import Events, EventSource, Recording, check_recording, one_time

Part = TypeVar("Part", Events, Recording)
Size = tuple[int, int]

BLOCK_EVENTS = 1 << 20  # read from a file together


def source_of(part: Any) -> EventSource:
    """Return the source of the events; raise `InputError` for what holds none."""
    check_recording(part, "a function of jaxevent.events", or_events=True)
    return part.events if isinstance(part, Recording) else part


def size_of(part: Any, size: Size | None) -> Size:
    """Return width and height of the sensor: of the recording, or as given.

    Args:
        part: Events, or a recording.
        size: Width and height, for events alone.

    Returns:
        Width and height, px.

    Raises:
        InputError: The size is missing or not positive, or events lie outside the sensor.
    """
    if isinstance(part, Recording):
        part.check_events()
        return part.width, part.height
    source_of(part)
    if size is None:
        raise InputError("events alone have no sensor; give size=(width, height)")
    if min(size) < 1:
        raise InputError(f"size = {size} must be two positive numbers of pixels, (width, height)")
    part.check(*size, "events")
    return size


def parse_duration(length: Any, what: str, least: int = 1) -> int:
    """Convert a length of time to us.

    Args:
        length: Integer us, or float s.
        what: Name of the length, for messages.
        least: Least length, us.

    Returns:
        The length, us.

    Raises:
        InputError: The length is no number, or shorter than `least`.
    """
    us = one_time(length, what)
    if us < least:
        raise InputError(
            f"{what} is {us} us; give {least} us or more (integers are microseconds, floats "
            "seconds)"
        )
    return us


def read_blocks(source: EventSource, start: int = 0, stop: int | None = None) -> Iterator[Events]:
    """Read a range of rows block by block.

    Args:
        source: The events.
        start: First row.
        stop: Row after the last one; None: all.

    Yields:
        Events, in order.
    """
    stop = len(source) if stop is None else stop
    for row in bar(range(start, stop, BLOCK_EVENTS), desc="read events", unit="M events"):
        yield source[row : min(row + BLOCK_EVENTS, stop)]


def map_events(part: Part, step: Callable[[Events], Events]) -> Part:
    """Apply a function to the events, block by block and in order.

    Args:
        part: Events, or a recording.
        step: A function from the events of a block to others.

    Returns:
        The same type, with the new events in memory.
    """
    done = [step(block) for block in read_blocks(source_of(part))] or [Events.empty()]
    columns = (np.concatenate([getattr(e, name) for e in done]) for name in "txyp")
    events = Events.of_checked(*columns)
    if isinstance(part, Recording):
        return dataclasses.replace(part, events=events)
    return events  # ty: ignore[invalid-explicit-return]


def select_events(part: Part, keep: Callable[[Events], NDArray[np.bool_]]) -> Part:
    """Select events by a mask.

    Args:
        part: Events, or a recording.
        keep: A function from the n events of a block to the mask (n,) of those that remain.

    Returns:
        The same type, with the selected events in memory.
    """
    return map_events(part, lambda events: events[keep(events)])
