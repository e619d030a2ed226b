"""How functions of events pass over `Events` and recordings: in blocks, with the sensor's size."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.progress import bar
from jaxevent.recording import Events, EventSource, Recording, microseconds

Part = TypeVar("Part", Events, Recording)
Size = tuple[int, int]

BLOCK = 1 << 20  # events read from a file together


def source_of(part: Events | Recording) -> EventSource:
    return part.events if isinstance(part, Recording) else part


def size_of(part: Events | Recording, size: Size | None) -> Size:
    """(width, height) of the sensor: the recording's, else what was given."""
    if isinstance(part, Recording):
        part.check_events()
        return part.width, part.height
    if size is None:
        raise InputError("events alone do not tell the sensor; give size=(width, height)")
    if min(size) < 1:
        raise InputError(f"size = {size} must be two positive numbers of pixels, (width, height)")
    part.check(*size, "events")
    return size


def duration(length: int | float, what: str, least: int = 1) -> int:
    """A length of time in us, of `least` us or more."""
    us = int(microseconds(length, what))
    if us < least:
        raise InputError(
            f"{what} is {us} us; give {least} us or more (integers are microseconds, floats "
            "seconds)"
        )
    return us


def blocks(source: EventSource, start: int = 0, stop: int | None = None) -> Iterator[Events]:
    """The events of a range of rows, block by block."""
    stop = len(source) if stop is None else stop
    for row in bar(range(start, stop, BLOCK), desc="read events", unit="M events"):
        yield source[row : min(row + BLOCK, stop)]


def pick(events: Events, rows: NDArray) -> Events:
    """Some of the events, by a mask or by rows."""
    return events[rows]


def rewrite(part: Part, step: Callable[[Events], Events]) -> Part:
    """The same with `step` of its events, which are passed block by block, in order."""
    done = [step(block) for block in blocks(source_of(part))]
    done = done or [Events.empty()]
    columns = (np.concatenate([getattr(e, name) for e in done]) for name in "txyp")
    events = Events.of_checked(*columns)
    if isinstance(part, Recording):
        return dataclasses.replace(part, events=events)
    return events  # ty: ignore[invalid-explicit-return]


def select(part: Part, keep: Callable[[Events], NDArray[np.bool_]]) -> Part:
    """The same with those events of which `keep` says True."""
    return rewrite(part, lambda events: pick(events, keep(events)))
