"""Blobs of events in one window that background does not make, at a stated false-alarm rate."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.finding.background import Background, evidence
from jaxevent.blob.finding.stream import Part

FALSE_ALARMS = 0.1  # per recording
_EIGHT = np.ones((3, 3), bool)


class Scale(NamedTuple):
    """How finely events are looked at."""

    window: float | int  # s
    cell: int  # px
    dispersion: float  # of the background's counts in such windows


class Blobs(NamedTuple):
    """Number, mean and covariance of the events of some blobs."""

    n: NDArray[np.float64]
    p: NDArray[np.float64]  # (blobs, 2) px
    C: NDArray[np.float64]  # (blobs, 2, 2) px^2


def detect(
    part: Part, background: Background, scale: Scale, size: tuple[int, int], t: float | int
) -> tuple[NDArray[np.int32], int]:
    """Which blob each event is of, from 1 on, 0: none; and how many there are.

    A blob is made of neighbouring cells that are not empty and whose 3x3 surroundings hold more
    events than background would give to one in 10 recordings. `size`: rows and columns, px.
    """
    g = scale.cell
    rows, columns = -(-size[0] // g), -(-size[1] // g)
    place = part.y // g * columns + part.x // g
    n = np.bincount(place, minlength=rows * columns).reshape(rows, columns)
    around = np.pad(n, 1)
    around = around[:-2] + around[1:-1] + around[2:]
    around = around[:, :-2] + around[:, 1:-1] + around[:, 2:]
    filled = np.flatnonzero(n.ravel())  # four times faster than np.nonzero of two axes
    y, x = np.divmod(filled, columns)
    mu = background.at(x * g + g // 2, y * g + g // 2, t) * scale.window * 9 * g * g
    tests = rows * columns * background.duration / scale.window
    hit = evidence(around.ravel()[filled], mu, scale.dispersion) > np.log(tests / FALSE_ALARMS)
    if not hit.any():
        return np.zeros(len(part), np.int32), 0
    cells = np.zeros(rows * columns, bool)
    cells[filled[hit]] = True
    labels = np.zeros((rows, columns), np.int32)
    number = ndimage.label(cells.reshape(rows, columns), _EIGHT, output=labels)
    return labels.ravel()[place], int(number)  # type: ignore[arg-type]


def measure_blobs(part: Part, labels: NDArray[np.int32], number: int) -> Blobs:
    """Moments of all blobs. A pixel's own extent is added to the covariance."""

    def mean(values: NDArray) -> NDArray:
        return np.bincount(labels, values, number + 1) / np.maximum(n, 1)

    some = np.flatnonzero(labels)
    labels, in_x, in_y = labels[some], part.x[some], part.y[some]
    n = np.bincount(labels, minlength=number + 1).astype(np.float64)
    x, y = mean(in_x), mean(in_y)
    ex, ey = in_x - x[labels], in_y - y[labels]
    xx, xy, yy = mean(ex**2), mean(ex * ey), mean(ey**2)
    C = np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2) + np.eye(2) / 12
    return Blobs(n[1:], np.stack([x, y], 1)[1:], C[1:])
