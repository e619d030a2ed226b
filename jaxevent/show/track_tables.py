"""Tables of tracks, as CSV and HDF5.

Tracks come as arrays: times (T,), int us or float s on the recording's clock; ids (N,); mean
(T, N, 8) and covariance (T, N, 8, 8) of (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and
rad; valid (T, N), False where a track does not exist and its numbers may be anything.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from jaxevent.blob.live import LiveTracks
from jaxevent.blob.tracks import STATE_COLUMNS, STATE_UNITS, TABLE_UNITS, table_columns
from jaxevent.errors import InputError
from jaxevent.io.output import CLOCK_UNIT, complete, complete_hdf5
from jaxevent.parameters import Parameters
from jaxevent.recording import Events, Times, microseconds

QUANTITIES = (
    "t", "id", "other", "inverse_ttc", "sigma_inverse_ttc", "range", "sigma_range"
)  # fmt: skip


@contextlib.contextmanager
def track_writer(
    path: str | Path, method: str | None = None, params: Parameters | None = None
) -> Iterator[Callable[..., None]]:
    """Open a table of tracks, one row per time and valid track, for a function that appends to it.

    The function takes times, ids, mean, covariance and valid, as above, or the rows of a table: ids
    (rows,), mean (rows, 8), covariance (rows, 8, 8) and times (rows,). CSV has the columns t (s),
    id, the state x, y, vx, vy, lambda1, lambda2, theta, q and their standard deviations sigma_x ...
    sigma_q. HDF5 has t (rows,) int64 us, id (rows,), mean (rows, 8) and covariance (rows, 8, 8),
    with the attributes `columns` and `units` and those of `jaxevent.io.output`. The file
    appears at the end, complete.

    Args:
        path: File that is written, .csv, .h5 or .hdf5.
        method: Name of the method that made the tracks, for HDF5.
        params: Parameters of the method, for HDF5.

    Yields:
        The function that appends.

    Raises:
        InputError: The suffix is another one, or shapes do not fit.
    """
    path = Path(path)
    hdf5 = functools.partial(_hdf5_writer, method=method, params=params)
    kinds = {".csv": _csv_writer, ".h5": hdf5, ".hdf5": hdf5}
    if path.suffix.lower() not in kinds:
        raise InputError(
            f"{path}: tracks cannot be stored as {path.suffix or 'a file without suffix'}; end the "
            "name in .csv or .h5"
        )
    with kinds[path.suffix.lower()](path) as append:

        def write(
            times: Times,
            ids: ArrayLike,
            mean: ArrayLike,
            covariance: ArrayLike,
            valid: ArrayLike | None = None,
        ) -> None:
            t, number, m, P, seen = check_tracks(path, times, ids, mean, covariance, valid)
            if m.ndim == 3:
                row, column = np.nonzero(seen)
                t, number, m, P = t[row], number[column], m[row, column], P[row, column]
            append(t, number, m, P)

        yield write


class LiveTable:
    """Table of live tracks, row by row, as `track_writer` writes that of a recording.

    Args:
        live: The live tracks.
        rate: Times per second, from the first event on.

    Raises:
        InputError: The rate is not possible.
    """

    def __init__(self, live: LiveTracks, rate: float):
        check_rate(rate)
        self._live, self._period, self._count, self._first = live, 1e6 / rate, 0, 0
        self.header = ",".join(TABLE_UNITS) + "\n"

    def add(self, events: Events) -> str:
        """Add events and return the lines of CSV of the times before the last of them."""
        if not len(events):
            return ""
        if not self._count:
            self._first = int(events.t[0])
        times = self._times_until(int(events.t[-1]) - 1)
        row, parts = 0, []
        for end in np.unique(ends := np.searchsorted(events.t, times, "right")):
            self._live.add(events[row:end])
            parts.append(self._read(times[ends == end]))
            row = end
        self._live.add(events[row:])
        return _csv_lines(parts)

    def finish(self) -> str:
        """Return the lines of the last event's time, if that is one of the table."""
        return _csv_lines([self._read(self._times_until(self._live.stop))] * bool(self._count))

    def _times_until(self, last: int) -> NDArray[np.int64]:
        """Return the next times (us) up to the last one, and count them."""
        number = max(math.floor((last - self._first + 1) / self._period) + 1, self._count)
        steps = np.arange(self._count, number)
        times = self._first + np.rint(steps * self._period).astype(np.int64)
        times = times[times <= last]
        self._count += len(times)
        return times

    def _read(self, times: NDArray[np.int64]) -> list[NDArray]:
        """Return times, numbers, means and covariances of the tracks alive at some times."""
        states = self._live(times)
        row, place = np.nonzero(states.valid)
        return [
            times[row],
            states.id[place],
            states.mean[row, place],
            states.covariance[row, place],
        ]


def _csv_lines(parts: list[list[NDArray]]) -> str:
    """Return the rows of a table, in parts, as lines of CSV."""
    if not parts:
        return ""
    columns = table_columns(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return pd.DataFrame(columns).to_csv(index=False, header=False)


@contextlib.contextmanager
def _csv_writer(path: Path) -> Iterator[Callable[..., None]]:
    """Open a CSV file for a function that appends rows."""
    with complete(path) as partial, partial.open("w", newline="") as file:
        file.write(",".join(TABLE_UNITS) + "\n")

        def append(t: NDArray, number: NDArray, mean: NDArray, covariance: NDArray) -> None:
            table = pd.DataFrame(table_columns(t, number, mean, covariance))
            table.to_csv(file, index=False, header=False)

        yield append


@contextlib.contextmanager
def _hdf5_writer(
    path: Path, method: str | None, params: Parameters | None
) -> Iterator[Callable[..., None]]:
    """Open an HDF5 file for a function that appends rows."""
    with complete_hdf5(path, method, params) as (file, check):
        file.attrs["format"] = "jaxevent tracks"

        def append(*arrays: NDArray) -> None:
            _append_rows(file, zip(("t", "id", "mean", "covariance"), arrays, strict=True))
            check()

        yield append
        if "t" not in file:
            append(*empty_rows())
        for name, unit in (("t", CLOCK_UNIT), ("id", "1")):
            file[name].attrs["unit"] = unit
        for name, unit in (("mean", "units"), ("covariance", "units[i] units[j]")):
            file[name].attrs["columns"], file[name].attrs["units"] = STATE_COLUMNS, STATE_UNITS
            file[name].attrs["unit"] = unit


@contextlib.contextmanager
def quantity_writer(
    path: str | Path, method: str | None = None, params: Parameters | None = None
) -> Iterator[Callable[..., None]]:
    """Open an HDF5 file of time to contact and range for a function that appends rows.

    It takes the columns `QUANTITIES`, (rows,) each: t int64 us, id and other (-1: no other track)
    integers, the others floats, NaN where not requested.
    """
    with complete_hdf5(Path(path), method, params) as (file, check):
        file.attrs["format"] = "jaxevent quantities"

        def append(*columns: NDArray) -> None:
            _append_rows(file, zip(QUANTITIES, columns, strict=True))
            check()

        none = np.empty(0, np.int64)
        append(none, none, none, *[np.empty(0)] * 4)
        yield append
        units = (CLOCK_UNIT, "1", "1", "1/s", "1/s", "m", "m")
        for name, unit in zip(QUANTITIES, units, strict=True):
            file[name].attrs["unit"] = unit


def _append_rows(file: h5py.File, columns: Iterable[tuple[str, NDArray]]) -> None:
    """Append rows of arrays to data sets, which are made if they are missing.

    Args:
        file: The file.
        columns: Names and arrays (rows, ...).
    """
    for name, array in columns:
        if name not in file:
            file.create_dataset(
                name, (0, *array.shape[1:]), array.dtype, maxshape=(None, *array.shape[1:]),
                chunks=(4096, *array.shape[1:]),
            )  # fmt: skip
        stored = file[name]
        assert isinstance(stored, h5py.Dataset)
        row = len(stored)
        stored.resize(row + len(array), axis=0)
        stored[row:] = array


def empty_rows() -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return times, ids, means and covariances of no row."""
    none = np.empty(0, np.int64)
    return none, none, np.empty((0, 8), np.float32), np.empty((0, 8, 8), np.float32)


def write_states(path: str | Path, times: Times, states: ArrayLike, valid: ArrayLike) -> None:
    """Write known states, such as the truth, as CSV with the columns t, id, x, ... q.

    Args:
        path: File that is written.
        times: (T,) integers (us) or floats (s).
        states: (T, N, 8).
        valid: (T, N) whether a state is written.
    """
    t, ids = np.atleast_1d(microseconds(times)), np.arange(np.shape(states)[1])
    t, ids, states, _, valid = check_tracks(path, t, ids, states, None, valid)
    row, column = np.nonzero(valid)
    columns = {"t": t[row] / 1e6, "id": ids[column]}
    columns |= {name: states[row, column, i] for i, name in enumerate(STATE_COLUMNS)}
    pd.DataFrame(columns).to_csv(path, index=False)


def check_rate(rate: float | int) -> None:
    """Raise `InputError` for a number of times per second that is not possible."""
    if not 0 < rate <= 1e6:
        raise InputError(f"--rate {rate:g} is not possible; give times per s, up to 1e6")


def check_tracks(
    place: str | Path,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    covariance: ArrayLike | None,
    valid: ArrayLike | None,
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Convert tracks to arrays whose shapes fit.

    Args:
        place: Name for messages.
        times: (T,) integers (us) or floats (s).
        ids: (N,) ids; (T,) for single rows.
        mean: (T, N, 8) states; (T, 8) for single rows.
        covariance: (T, N, 8, 8) covariances; None: 0.
        valid: (T, N) whether a track is alive; None: all, or single rows.

    Returns:
        Times in us, ids, mean, covariance and valid.

    Raises:
        InputError: The shapes do not fit.
    """
    t, ids, mean = np.atleast_1d(microseconds(times)), np.asarray(ids), np.asarray(mean)
    if covariance is None:
        covariance = np.broadcast_to(0.0, (*mean.shape, 8))
    covariance = np.asarray(covariance)
    flat = mean.ndim == 2 and valid is None
    shape = (len(t),) if flat else (len(t), ids.size)
    valid = np.ones(shape, bool) if valid is None else np.asarray(valid, bool)
    rows = ids.shape == ((len(t),) if flat else (ids.size,))
    fit = mean.shape == (*shape, 8) and covariance.shape == (*shape, 8, 8) and valid.shape == shape
    if not (rows and fit and ids.dtype.kind in "iu"):
        raise InputError(
            f"{place}: {len(t)} times, {ids.dtype} ids of {ids.shape}, mean {mean.shape}, "
            f"covariance {covariance.shape} and valid {valid.shape} do not fit; give T times, N "
            "integer ids, (T, N, 8), (T, N, 8, 8) and (T, N)"
        )
    return t, ids, mean, covariance, valid
