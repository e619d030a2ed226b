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

Times are integers in microseconds or floats in seconds, those of events in microseconds too where
all are whole (`columns.time_scale`). Only the events are required, and width
and height where there are no frames. The events may have the other names of `columns`, or stand
together in one structured array of any name. Every other array is kept in `Recording.extra`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import pinhole, reading, sensor_size, times, vectors, whole_number
from jaxevent.io.columns import find, of_records, time_scale
from jaxevent.io.decoded import from_columns
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Frames, Imu, Recording


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

    records = [name for name, array in arrays.items() if array.dtype.names is not None]
    if find(list(arrays)) is None and len(records) == 1:
        arrays |= of_records(arrays.pop(records[0]), f"{path}: {records[0]}")
    # An archive of the layout may hold more times: t is t wherever there is one.
    fields = {} if {"t", "x", "y", "p"} <= set(arrays) else find(list(arrays)) or {}
    for field, name in fields.items():
        arrays[field] = arrays.pop(name)

    def take(*names: str) -> list[NDArray]:
        missing = [name for name in names if name not in arrays]
        if missing:
            raise InputError(f"{path}: has no {' and no '.join(missing)}; add the arrays")
        return [arrays.pop(name) for name in names]

    t, x, y, p = take("t", "x", "y", "p")
    frames = _frames(path, arrays, take) if "frames" in arrays else None
    stored = {name: arrays.pop(name) for name in ("width", "height") if name in arrays}
    told = None
    if options.size is None and len(stored) == 2:
        width, height = (whole_number(value, str(path), name) for name, value in stored.items())
        told = (width, height)
    otherwise = f"{path}: has no width and height and no frames; add them or"
    size = sensor_size(options.size, told, frames=frames, otherwise=otherwise)
    source = str(path)
    t = times(t, source, "event", time_scale(t, source))
    events = from_columns((t, x, y, p), size, source, options)
    imu = None
    if "imu_t" in arrays:
        imu_t, gyro, acc = take("imu_t", "gyro", "acc")
        imu_t = times(imu_t, source, "IMU sample")
        shape = (len(imu_t), 3)
        imu = Imu(imu_t, vectors(gyro, shape, source, "gyro"), vectors(acc, shape, source, "acc"))
    camera = None
    if "calib" in arrays:
        model = str(arrays.pop("calib_model", "radtan"))
        camera = pinhole(arrays.pop("calib"), f"{path}: calib", model)
    return Recording(path.stem, *size, events, frames, camera, imu=imu, extra=arrays)


def _frames(path: Path, arrays: dict[str, NDArray], take) -> Frames | None:
    (images,) = take("frames")
    if images.ndim != 3:
        raise InputError(
            f"{path}: frames has shape {images.shape}; it must be (frames, height, width)"
        )
    source = str(path)
    if "exp_start" in arrays or "exp_end" in arrays:
        start, end = (times(a, source, "exposure") for a in take("exp_start", "exp_end"))
        arrays.pop("frame_t", None)
        if len(start) != len(end):
            raise InputError(
                f"{path}: exp_start and exp_end have {len(start)} and {len(end)} values; "
                "give one of each per frame"
            )
        t, exposure = start + (end - start) // 2, end - start
    elif "frame_t" in arrays:
        t = times(take("frame_t")[0], source, "frame")
        exposure = np.zeros_like(t)
    else:
        raise InputError(
            f"{path}: frames have no times; add frame_t (mid-exposure) or exp_start and exp_end"
        )
    return Frames(t, images, exposure) if len(images) or len(t) else None
