"""Blobs of events in one window that background does not make, at a stated false-alarm rate."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.background import CELL, Background, evidence, look_up
from jaxevent.blob.finding.stream import Part
from jaxevent.kernels import compiled

FALSE_ALARMS = 0.1  # per recording
CONTACT = 2.0  # what is nearer than this many times the sum of both sizes touches


class Scale(NamedTuple):
    """How finely events are looked at."""

    window: float | int  # s
    cell: int  # px
    dispersion: NDArray[np.float64]  # of the background's counts in such windows, in 16 px cells

    def dispersion_at(self, x: Any, y: Any) -> Any:
        """That of counts in 3x3 of the scale's cells, in which flicker adds up."""
        usual, cells = self.dispersion.min(), max(1.0, (3 * self.cell / CELL) ** 2)
        return usual + (look_up(self.dispersion, CELL, x, y) - usual) * cells


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
    place, filled, around = _count(part.x, part.y, g, rows, columns)
    y, x = np.divmod(filled, columns)
    middle = x * g + g // 2, y * g + g // 2
    mu = background.at(*middle, t, 3 * g) * scale.window * 9 * g * g
    tests = rows * columns * background.duration / scale.window
    hit = evidence(around, mu, scale.dispersion_at(*background.place(*middle, t))) > np.log(
        tests / FALSE_ALARMS
    )
    return _label(place, filled[hit], rows, columns)


# Windows hold far fewer events than there are cells: only those that are not empty are touched.


@compiled
def _count(x: Any, y: Any, g: int, rows: int, columns: int) -> Any:
    """The cell of each event, the cells that are not empty, and the events in their 3x3."""
    n, place = np.zeros((rows + 2, columns + 2), np.int32), np.empty(len(x), np.int64)
    filled, number = np.empty(len(x), np.int64), 0
    for i in range(len(x)):
        row, column = np.int64(y[i]) // g, np.int64(x[i]) // g
        place[i] = row * columns + column
        if n[row + 1, column + 1] == 0:
            filled[number] = place[i]
            number += 1
        n[row + 1, column + 1] += 1
    filled = np.sort(filled[:number])
    around = np.zeros(number, np.int64)
    for k in range(number):
        row, column = filled[k] // columns, filled[k] % columns
        for down in range(3):
            for right in range(3):
                around[k] += n[row + down, column + right]
    return place, filled, around


@compiled
def _label(place: Any, hit: Any, rows: int, columns: int) -> Any:
    """The blob of each event, and how many there are: neighbours, also across corners."""
    labels, waiting = np.zeros((rows + 2, columns + 2), np.int32), np.empty(len(hit), np.int64)
    for cell in hit:
        labels[cell // columns + 1, cell % columns + 1] = -1
    number = 0
    for cell in hit:
        if labels[cell // columns + 1, cell % columns + 1] > 0:
            continue
        number += 1
        labels[cell // columns + 1, cell % columns + 1] = number
        waiting[0], count = cell, 1
        while count > 0:
            count -= 1
            row, column = waiting[count] // columns, waiting[count] % columns
            for down in range(3):
                for right in range(3):
                    if labels[row + down, column + right] == -1:
                        labels[row + down, column + right] = number
                        waiting[count] = (row + down - 1) * columns + column + right - 1
                        count += 1
    of_event = np.zeros(len(place), np.int32)
    for i in range(len(place)):
        of_event[i] = labels[place[i] // columns + 1, place[i] % columns + 1]
    return of_event, number


def measure_blobs(part: Part, labels: NDArray[np.int32], number: int) -> Blobs:
    """Moments of all blobs. A pixel's own extent is added to the covariance."""

    n, p, C = _moments(part.x, part.y, labels, number)
    return Blobs(n, p, C + np.eye(2) / 12)


@compiled
def _moments(x: Any, y: Any, labels: Any, number: int) -> Any:
    n, p, C = np.zeros(number), np.zeros((number, 2)), np.zeros((number, 2, 2))
    for i in range(len(labels)):
        k = labels[i] - 1
        if k >= 0:
            n[k] += 1
            p[k, 0] += x[i]
            p[k, 1] += y[i]
    for k in range(number):
        p[k] /= max(n[k], 1.0)
    for i in range(len(labels)):
        k = labels[i] - 1
        if k >= 0:
            ex, ey = x[i] - p[k, 0], y[i] - p[k, 1]
            C[k, 0, 0] += ex * ex
            C[k, 0, 1] += ex * ey
            C[k, 1, 1] += ey * ey
    for k in range(number):
        C[k] /= max(n[k], 1.0)
        C[k, 1, 0] = C[k, 0, 1]
    return n, p, C


def touching(pa: NDArray, Ca: NDArray, pb: NDArray, Cb: NDArray) -> Any:
    """Distances over the sum of both ellipses' reach along the line between them."""
    d = pb - pa
    length = np.hypot(d[..., 0], d[..., 1])
    u = d / np.maximum(length, 1e-9)[..., None]
    reach = [np.sqrt(np.einsum("...i,...ij,...j", u, C, u)) for C in (Ca, Cb)]
    return length / np.maximum(reach[0] + reach[1], 1e-9)
