"""Rows of tables of tracks: their columns, units and times."""

import math

import numpy as np
from numpy.typing import NDArray

COLUMNS = ("x", "y", "vx", "vy", "lambda1", "lambda2", "theta", "q")
UNITS = ("px", "px", "px/s", "px/s", "px", "px", "rad", "rad/s")
TABLE_UNITS = {
    "t": "s",
    "id": "1",
    **dict(zip(COLUMNS, UNITS, strict=True)),
    **{f"sigma_{name}": unit for name, unit in zip(COLUMNS, UNITS, strict=True)},
}
TABLE_RATE = 1000.0  # times per second of a table


def table_columns(
    t: NDArray[np.int64],
    id: NDArray[np.integer],
    mean: NDArray[np.floating],
    covariance: NDArray[np.floating],
) -> dict[str, NDArray]:
    """Arrange tracks as the columns of a table, one row for each track and time.

    Args:
        t: Times (rows,), us.
        id: Numbers of the tracks (rows,).
        mean: States (rows, 8), in `UNITS`.
        covariance: Their covariances (rows, 8, 8).

    Returns:
        Arrays (rows,) by the names of `TABLE_UNITS`, in those units. A sigma is the square root of
        a variance.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
    columns = [t / 1e6, id, *mean.T, *deviation.T]
    return dict(zip(TABLE_UNITS, columns, strict=True))


def evenly(start: int, stop: int, rate: float) -> NDArray[np.int64]:
    """Return times (us) at a rate (1/s), from `start` to before `stop` (us)."""
    count = math.ceil((stop - start) * rate / 1e6)
    times = start + np.rint(np.arange(count) * (1e6 / rate)).astype(np.int64)
    return np.unique(times[times < stop])
