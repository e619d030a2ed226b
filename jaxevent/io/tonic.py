"""Recordings from and for tonic (Lenz et al.), whose data sets have items of events and a target.

    dataset = tonic.datasets.NMNIST("data")
    for recording in jaxevent.io.tonic.from_dataset(dataset):
        ...
    events, target = jaxevent.io.tonic.to_item(recording, target=3)

tonic's events are a structured array of x, y, t and p in any order and of any type, t in us, on a
`sensor_size` of (width, height, polarities). The types that tonic 1.7 uses can all be read;
`to_item` gives those of its `tonic.io.events_struct`. tonic itself is not imported.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import times
from jaxevent.errors import InputError
from jaxevent.io.checks import check_events
from jaxevent.io.columns import record_fields
from jaxevent.recording import Recording, check_recording

EVENT_DTYPE: np.dtype = np.dtype([("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", bool)])


def from_dataset(dataset: Any, size: tuple[int, ...] | None = None) -> Iterator[Recording]:
    """Make a recording of each item of a data set, in turn.

    Args:
        dataset: A data set of tonic: it has a length, items and a `sensor_size`.
        size: (width, height) in px, where `sensor_size` is None.

    Yields:
        The recordings.

    Raises:
        InputError: The size is not known, or an item is not valid.
    """
    size = size or getattr(dataset, "sensor_size", None)
    for number in range(len(dataset)):
        yield from_item(dataset[number], size, f"{type(dataset).__name__} {number}")


def from_item(item: Any, size: tuple[int, ...] | None, name: str = "tonic") -> Recording:
    """Make a recording of an item of a data set.

    Args:
        item: (events, target), or events alone.
        size: tonic's `sensor_size`, or (width, height).
        name: Name of the recording.

    Returns:
        A recording whose `extra["target"]` is the target, where that is numbers or text.

    Raises:
        InputError: The events are not those of a camera, or not valid; `name` is in the message.
    """
    records, target = item if isinstance(item, tuple) and len(item) == 2 else (item, None)
    records = np.asarray(records)
    if size is None:
        raise InputError(f"{name}: its sensor_size is None; give size=(width, height)")
    t, x, y, p = (records[field] for field in record_fields(records, name).values())
    sensor = (int(size[0]), int(size[1]))
    events = check_events(times(t, name, "event", us_per_unit=1.0), x, y, p, sensor, name)
    extra = {"target": np.asarray(target)} if _is_plain(target) else {}
    return Recording(name, *sensor, events, extra=extra)


def to_item(recording: Recording, target: Any = None) -> tuple[NDArray, Any]:
    """Make an item of tonic of a recording.

    Args:
        recording: The recording.
        target: The target; None takes `extra["target"]`.

    Returns:
        The events as tonic's structured array, and the target or None.

    Raises:
        InputError: The sensor has coordinates above 32,767, which tonic's int16 does not hold.
    """
    check_recording(recording, "to_item")
    if max(recording.width, recording.height) > 1 << 15:
        raise InputError(
            f"{recording.name}: its sensor of {recording.width}x{recording.height} pixels has "
            "coordinates that do not fit tonic's int16; crop it with jaxevent.events.crop"
        )
    events = recording.events[:]
    records = np.empty(len(events), EVENT_DTYPE)
    for field in "xytp":
        records[field] = getattr(events, field)
    return records, recording.extra.get("target") if target is None else target


def _is_plain(target: Any) -> bool:
    if target is None or not isinstance(target, str | int | float | np.generic | np.ndarray):
        return False
    return np.asarray(target).dtype.kind in "biufU"
