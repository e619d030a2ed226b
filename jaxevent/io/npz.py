"""Recordings as NumPy archives (.npz) of these arrays:

    t, x, y, p            events: times, columns, rows, polarity (bool, 0/1 or -1/1)
    width, height         pixels
    frames                (frames, height, width) uint8, uint16 or floats in [0, 1]
    frame_t               mid-exposure times
    exp_start, exp_end    start and end of the exposures; where present, frame_t is not used
    imu_t, gyro, acc      (samples,), (samples, 3) rad/s, (samples, 3) m/s^2
    calib                 fx fy cx cy k1 k2 p1 p2 k3; of another lens model of `jaxevent.lenses`
                          its numbers
    calib_model           the name of that model

Times are usually integers in microseconds or floats in seconds, those of events in microseconds too
where all are whole; names may state a unit, as in frame_t_ns (`time_units`). Only the events are
required, and width and height where there are no frames. The events may have the other names of
`columns`, or stand together in one array of any name: structured, or of shape (events, 4) or (4,
events), in an order that `columns.order_of` tells. Every other array is kept in `Recording.extra`.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import to_microseconds
from jaxevent.errors import InputError
from jaxevent.io import pinhole, reading, sensor_size, vectors, whole_number
from jaxevent.io.columns import (
    as_rows,
    find,
    first_and_last,
    of_records,
    order_of,
    signed,
    stated_unit,
    unsigned_off,
)
from jaxevent.io.decoded import from_columns
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import (
    SAMPLE,
    InferredUnit,
    clock_of,
    infer_unit,
    numbers_of_dates,
    split_unit,
)
from jaxevent.recording import Frames, Imu, Recording

_TIMES = ("frame_t", "exp_start", "exp_end", "imu_t")


def read(path: Path, options: ReadOptions) -> Recording:
    """Read an archive. Raises `InputError` for bad input."""
    arrays: dict[str, NDArray] = {}
    with reading(str(path)), np.load(path, allow_pickle=False) as archive:
        names = archive.files
        for name in names:
            with reading(f"{path}: {name}"):
                arrays[name] = archive[name]
            if not isinstance(arrays[name], np.ndarray):
                raise InputError(f"{path}: {name} is not a NumPy array; remove or replace it")

    name_of_t, rows = _name_events(path, arrays)
    stated = {}
    for name in list(arrays):
        base, unit = split_unit(name)
        if base in _TIMES and unit is not None and base not in arrays:
            arrays[base], stated[base] = arrays.pop(name), unit

    def take(*names: str) -> list[NDArray]:
        missing = [name for name in names if name not in arrays]
        if missing:
            raise InputError(f"{path}: has no {' and no '.join(missing)}; add the arrays")
        return [arrays.pop(name) for name in names]

    columns = {} if rows is not None else dict(zip("txyp", take("t", "x", "y", "p"), strict=True))
    images = take("frames")[0] if "frames" in arrays else None
    if images is not None and images.ndim != 3:
        raise InputError(
            f"{path}: frames has shape {images.shape}; it must be (frames, height, width)"
        )
    sides = {name: arrays.pop(name) for name in ("width", "height") if name in arrays}
    told = None
    if options.size is None and len(sides) == 2:
        width, height = (whole_number(value, str(path), name) for name, value in sides.items())
        told = (width, height)
    elif images is not None:
        told = (images.shape[2], images.shape[1])
    otherwise = f"{path}: has no width and height and no frames; add them or"
    size = sensor_size(options.size, told, frames=None, otherwise=otherwise)
    source = str(path)
    if rows is not None:
        order = order_of(rows[:SAMPLE], size, source)
        columns = {name: rows[:, order.index(name)] for name in "txyp"}
    shapes = [np.shape(column) for column in columns.values()]
    stated_of_events = stated_unit(name_of_t, columns["t"])
    columns["t"] = numbers_of_dates(columns["t"])[0]
    unit = InferredUnit("us")
    if len(set(shapes)) == 1 and len(shapes[0]) == 1:
        sample = first_and_last(lambda part: {n: columns[n][part] for n in "txyp"}, shapes[0][0])
        unit = infer_unit(sample, shapes[0][0], size, source, options, stated=stated_of_events)
    t = to_microseconds(columns["t"], unit.name, source, "event")
    x, y, p = (columns[name] for name in "xyp")
    events = from_columns((t, x, y, signed(p, unsigned_off(p))), size, source, options)
    notes = list(unit.notes)
    clock = clock_of(unit, columns["t"], events.t)

    def stamps(name: str, what: str) -> NDArray[np.int64]:
        values, of_type = numbers_of_dates(take(name)[0])
        return clock.read(values, source, what, notes, stated=of_type or stated.get(name))

    frames = None if images is None else _frames(path, images, arrays, stamps)
    imu = None
    if "imu_t" in arrays:
        imu_t = stamps("imu_t", "IMU sample")
        gyro, acc = take("gyro", "acc")
        shape = (len(imu_t), 3)
        imu = Imu(imu_t, vectors(gyro, shape, source, "gyro"), vectors(acc, shape, source, "acc"))
    camera = None
    if "calib" in arrays:
        model = str(arrays.pop("calib_model", "radtan"))
        camera = pinhole(arrays.pop("calib"), f"{path}: calib", model)
    return Recording(
        path.stem, *size, events, frames, camera, imu=imu, extra=arrays, notes=tuple(notes)
    )


def _name_events(path: Path, arrays: dict[str, NDArray]) -> tuple[str, NDArray | None]:
    """Give the columns of events the names t, x, y and p among the arrays.

    Returns:
        The name that the column of times had, and events (n, 4) in place of columns, where they
        stand in one array without names: they are told apart by the sensor's size.
    """
    # An archive of the layout may hold more times: t is t wherever there is one.
    fields = find([name for name in arrays if name in "txyp"]) or find(list(arrays))
    if fields is not None:
        found = {field: arrays.pop(name) for field, name in fields.items()}
        arrays |= found
        return fields["t"], None
    records = [name for name, array in arrays.items() if array.dtype.names is not None]
    if len(records) == 1:
        held = arrays.pop(records[0])
        arrays |= of_records(held, f"{path}: {records[0]}")
        return (find(held.dtype.names or ()) or {})["t"], None
    plain = [name for name, array in arrays.items() if as_rows(array) is not None]
    if len(plain) == 1 or "events" in plain:
        return "", as_rows(arrays.pop("events" if "events" in plain else plain[0]))
    return "", None


def _frames(
    path: Path,
    images: NDArray,
    arrays: dict[str, NDArray],
    stamps: Callable[[str, str], NDArray[np.int64]],
) -> Frames | None:
    if "exp_start" in arrays or "exp_end" in arrays:
        missing = [name for name in ("exp_start", "exp_end") if name not in arrays]
        if missing:
            raise InputError(f"{path}: has no {missing[0]}; add the arrays")
        start, end = stamps("exp_start", "exposure"), stamps("exp_end", "exposure")
        arrays.pop("frame_t", None)
        if len(start) != len(end):
            raise InputError(
                f"{path}: exp_start and exp_end have {len(start)} and {len(end)} values; "
                "give one of each per frame"
            )
        t, exposure = start + (end - start) // 2, end - start
    elif "frame_t" in arrays:
        t = stamps("frame_t", "frame")
        exposure = np.zeros_like(t)
    else:
        raise InputError(
            f"{path}: frames have no times; add frame_t (mid-exposure) or exp_start and exp_end"
        )
    return Frames(t, images, exposure) if len(images) or len(t) else None
