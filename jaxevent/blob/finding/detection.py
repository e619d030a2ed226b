"""Blobs of events in one window that background does not make, at a stated false-alarm rate."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.finding.background import CELL, Background, evidence, look_up
from jaxevent.blob.finding.stream import Part
from jaxevent.kernels import Blank, compiled
from jaxevent.kernels import part as kernel_part

_cells = Blank(np.int32)
FALSE_ALARMS = 0.1  # per recording
MOST_FEW = 1000  # events that are looked at wherever they are
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
    usual = scale.window * 9 * g * g
    tests = rows * columns * background.duration / scale.window
    enough = np.log(tests / FALSE_ALARMS)
    # Fewer events are no evidence even where the background is darkest.
    few = np.arange(MOST_FEW)
    darkest = background.rate.min() * background.activity[background.slice(t)] * usual
    few = int(np.argmin(evidence(few, darkest, scale.dispersion.min()) <= enough)) or MOST_FEW
    cells = _cells(rows + 2, columns + 2)
    across, down = (np.arange(n, dtype=np.int32) // g + 1 for n in size[::-1])
    place, many, around = _count(part.x, part.y, across, down, few, cells)
    y, x = np.divmod(many, columns + 2)
    middle = (x - 1) * g + g // 2, (y - 1) * g + g // 2
    mu = background.at(*middle, t, 3 * g) * usual
    hit = evidence(around, mu, scale.dispersion_at(*background.place(*middle, t))) > enough
    return _label(place, many[hit], cells)


# Windows hold far fewer events than there are cells: only those that are not empty are touched, and
# made 0 again. Around all of them is a border of one cell.


@compiled
def _count(x: Any, y: Any, across: Any, down: Any, few: int, cells: Any) -> Any:
    """The cell of each event, the cells whose 3x3 hold at least `few` events, and how many."""
    n, wide, place = cells.ravel(), cells.shape[1], np.empty(len(x), np.int64)
    filled, number = np.empty(len(x), np.int64), 0
    for i in range(len(x)):
        cell = np.int64(down[y[i]]) * wide + across[x[i]]
        place[i] = cell
        if n[cell] == 0:
            filled[number] = cell
            number += 1
        n[cell] += 1
    many, count = np.empty(number, np.int64), 0
    for k in range(number):
        if _sum_around(n, filled[k], wide) >= few:
            many[count] = filled[k]
            count += 1
    many = np.sort(many[:count])
    around = np.empty(count, np.int64)
    for k in range(count):
        around[k] = _sum_around(n, many[k], wide)
    for k in range(number):
        n[filled[k]] = 0
    return place, many, around


@kernel_part
def _sum_around(n: Any, cell: int, wide: int) -> Any:
    total = 0
    for row in (cell - wide, cell, cell + wide):
        total += n[row - 1] + n[row] + n[row + 1]
    return total


@compiled
def _label(place: Any, hit: Any, cells: Any) -> Any:
    """The blob of each event, and how many there are: neighbours, also across corners."""
    labels, wide, waiting = cells.ravel(), cells.shape[1], np.empty(len(hit), np.int64)
    for cell in hit:
        labels[cell] = -1
    number = 0
    for cell in hit:
        if labels[cell] > 0:
            continue
        number += 1
        labels[cell] = number
        waiting[0], count = cell, 1
        while count > 0:
            count -= 1
            middle = waiting[count]
            for row in (middle - wide, middle, middle + wide):
                for near in range(row - 1, row + 2):
                    if labels[near] == -1:
                        labels[near] = number
                        waiting[count] = near
                        count += 1
    of_event = np.zeros(len(place), np.int32)
    if number:
        for i in range(len(place)):
            of_event[i] = labels[place[i]]
    for cell in hit:
        labels[cell] = 0
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
