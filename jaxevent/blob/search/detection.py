"""Blobs of events in one window that background does not make, at a stated false-alarm rate."""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import CELL, Background, Field, look_up, nats, value_at
from jaxevent.blob.search.stream import Part, Pixels
from jaxevent.codegen import ZeroedScratch, njit_noalloc, njit_noalloc_inlined

_cells = ZeroedScratch(np.int32)
FALSE_ALARMS = 0.1  # per recording
MOST_FEW = 1000  # events that are looked at wherever they are
CONTACT = 2.0  # what is nearer than this many times the sum of both sizes touches


@dataclasses.dataclass(frozen=True)
class Scale:
    """How finely events are looked at."""

    window: float | int  # s
    cell: int  # px, a power of 2
    dispersion: NDArray[np.float64]  # of the background's counts in such windows, in 16 px cells

    def dispersion_at(self, x: Any, y: Any) -> Any:
        """That of counts in 3x3 of the scale's cells, in which flicker adds up."""
        return self.usual + (look_up(self.dispersion, CELL, x, y) - self.usual) * self.flicker

    def as_long(self, window: float) -> "Scale":
        """The same with another window, s."""
        return dataclasses.replace(self, window=window)

    @functools.cached_property
    def usual(self) -> float:
        """The least dispersion."""
        return float(self.dispersion.min())

    @property
    def flicker(self) -> float:
        """Cells of 16 px in 3x3 of the scale's cells, at least 1."""
        return max(1.0, (3 * self.cell / CELL) ** 2)


class Blobs(NamedTuple):
    """Number, mean and covariance of the events of some blobs."""

    n: NDArray[np.float64]
    p: NDArray[np.float64]  # (blobs, 2) px
    C: NDArray[np.float64]  # (blobs, 2, 2) px^2

    @classmethod
    def of(cls, number: int) -> "Blobs":
        """Room for so many."""
        return cls(np.empty(number), np.empty((number, 2)), np.empty((number, 2, 2)))


class Space(NamedTuple):
    """Where kernels look for blobs of so many pixels; int64 but for `labels`."""

    place: NDArray[np.int64]  # the cell of each pixel
    filled: NDArray[np.int64]  # cells that are not empty,
    hit: NDArray[np.int64]  # those with more events than background,
    waiting: NDArray[np.int64]  # and those of a blob that are still to be looked at
    labels: NDArray[np.int32]  # the blob of each pixel, from 1 on; 0: none

    @classmethod
    def of(cls, pixels: int) -> "Space":
        place, filled, hit, waiting = np.empty((4, pixels), np.int64)
        return cls(place, filled, hit, waiting, np.empty(pixels, np.int32))


class Ground(NamedTuple):
    """What tells blobs from background in a window, for kernels."""

    rates: Field
    dispersion: Field
    bits: int  # the cell is 2^bits px
    wide: int  # cells of a row, with the border
    usual: float | int  # s px^2, of 3x3 cells
    more: float | int  # times the dispersion of 3x3 cells exceeds that of 16 px more than the least
    least: float | int  # dispersion
    darkest: float | int  # events of 3x3 cells where the background is darkest
    enough: float | int  # nats against background


def ground_of(
    background: Background, scale: Scale, size: tuple[int, int], t: float | int
) -> Ground:
    """Of a window about t (s) on a sensor of `size`: rows and columns, px."""
    g = scale.cell
    usual = scale.window * 9 * g * g
    tests = -(-size[0] // g) * -(-size[1] // g) * background.duration / scale.window
    rates, least = background.field(t, 3 * g), scale.usual
    return Ground(
        rates, background.field_of(scale.dispersion, CELL, t), g.bit_length() - 1,
        -(-size[1] // g) + 2, float(usual), scale.flicker,
        least, float(background.least * rates.factor * usual),
        float(np.log(tests / FALSE_ALARMS)),
    )  # fmt: skip


def detect(
    part: Part | Pixels, background: Background, scale: Scale, size: tuple[int, int], t: float | int
) -> tuple[NDArray[np.int32], int]:
    """Which blob each event is of, from 1 on, 0: none; and how many there are.

    A blob is made of neighbouring cells that are not empty and whose 3x3 surroundings hold more
    events than background would give to one in 10 recordings. Blobs come in the order of their
    cells' first events. `size`: rows and columns, px.
    """
    ground, space = ground_of(background, scale, size, t), Space.of(len(part))
    cells = blank_cells(size, scale.cell)
    number = _detect(part.x, part.y, _events_of(part), ground, cells, space)
    return space.labels, number


def blank_cells(size: tuple[int, int], cell: int) -> NDArray[np.int32]:
    """Cells of a sensor and a border of one cell around them, to be counted in, row by row."""
    rows, columns = (-(-n // cell) + 2 for n in size)
    return _cells(rows * columns)


# Windows hold far fewer events than there are cells: only those that are not empty are touched, and
# made 0 again.


@njit_noalloc
def _detect(x: Any, y: Any, number: Any, ground: Any, cells: Any, space: Any) -> int:
    return find_blobs(x, y, number, ground, cells, space)


@njit_noalloc_inlined
def find_blobs(x: Any, y: Any, number: Any, ground: Any, cells: Any, space: Any) -> int:
    """How many blobs there are of pixels with so many events each, as `detect`.

    `cells` are 0, and are again; the pixels' blobs are in `space.labels`.
    """
    filled = _count(x, y, number, ground, cells, space)
    hits = _significant(filled, ground, cells, space)
    for i in range(filled):
        cells[space.filled[i]] = 0
    return _label(len(x), hits, ground.wide, cells, space)


@njit_noalloc_inlined
def _count(x: Any, y: Any, number: Any, ground: Any, cells: Any, space: Any) -> int:
    """The cell of each pixel, and all that are not empty: their number."""
    n, wide, bits, count = cells, ground.wide, ground.bits, 0
    for i in range(len(x)):
        at = ((np.int64(y[i]) >> bits) + 1) * wide + (np.int64(x[i]) >> bits) + 1
        space.place[i] = at
        if n[at] == 0:
            space.filled[count] = at
            count += 1
        n[at] += number[i]
    return count


@njit_noalloc_inlined
def _significant(filled: int, ground: Any, cells: Any, space: Any) -> int:
    """Cells that are not empty whose 3x3 hold more events than background gives: their number."""
    n, wide, g = cells, ground.wide, 1 << ground.bits
    # Fewer events are no evidence even where the background is darkest.
    few = 1
    while few < MOST_FEW and nats(few, ground.darkest) <= ground.enough * ground.least:
        few += 1
    many, some, count = space.hit, 0, 0
    for i in range(filled):
        if _sum_around(n, space.filled[i], wide) >= few:
            many[some] = space.filled[i]
            some += 1
    for i in range(some):
        cell = many[i]
        x, y = (cell % wide - 1) * g + g // 2, (cell // wide - 1) * g + g // 2
        mu = value_at(ground.rates, x, y) * ground.usual
        F = ground.least + (value_at(ground.dispersion, x, y) - ground.least) * ground.more
        if nats(_sum_around(n, cell, wide), mu) > ground.enough * F:
            many[count] = cell
            count += 1
    return count


@njit_noalloc_inlined
def _sum_around(n: Any, cell: int, wide: int) -> Any:
    total = 0
    for row in (cell - wide, cell, cell + wide):
        total += n[row - 1] + n[row] + n[row + 1]
    return total


@njit_noalloc_inlined
def _label(events: int, hits: int, wide: int, labels: Any, space: Any) -> int:
    """The blob of each event, and how many there are: neighbours, also across corners."""
    waiting = space.waiting
    for i in range(hits):
        labels[space.hit[i]] = -1
    number = 0
    for i in range(hits):
        cell = space.hit[i]
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
    for i in range(events):
        space.labels[i] = labels[space.place[i]]
    for i in range(hits):
        labels[space.hit[i]] = 0
    return number


def measure_blobs(part: Part | Pixels, labels: NDArray[np.int32], number: int) -> Blobs:
    """Moments of all blobs. A pixel's own extent is added to the covariance."""
    blobs = Blobs.of(number)
    _measure(part.x, part.y, _events_of(part), labels, number, blobs)
    return blobs


def _events_of(part: Part | Pixels) -> NDArray[np.int32]:
    return part.n if isinstance(part, Pixels) else np.ones(len(part), np.int32)


@njit_noalloc
def _measure(x: Any, y: Any, events: Any, labels: Any, number: int, blobs: Any) -> None:
    blob_moments(x, y, events, labels, number, blobs)


@njit_noalloc_inlined
def blob_moments(x: Any, y: Any, events: Any, labels: Any, number: int, blobs: Any) -> None:
    """The first `number` of `blobs`, of pixels with so many events each, as `measure_blobs`."""
    n, p, C = blobs
    for k in range(number):
        n[k] = p[k, 0] = p[k, 1] = C[k, 0, 0] = C[k, 0, 1] = C[k, 1, 1] = 0.0
    # One pass: sums of whole numbers are exact.
    for i in range(len(x)):
        k = labels[i] - 1
        if k >= 0:
            add_moments(n, p, C, k, float(events[i]), float(x[i]), float(y[i]))
    finish_moments(n, p, C, number)


@njit_noalloc_inlined
def add_moments(n: Any, p: Any, C: Any, k: int, weight: float, x: float, y: float) -> None:
    """Add a place to the sums of one of several blobs."""
    n[k] += weight
    p[k, 0] += weight * x
    p[k, 1] += weight * y
    C[k, 0, 0] += weight * x * x
    C[k, 0, 1] += weight * x * y
    C[k, 1, 1] += weight * y * y


@njit_noalloc_inlined
def finish_moments(n: Any, p: Any, C: Any, number: int) -> None:
    """Means and covariances, with that of a pixel, from the sums of the first `number`."""
    for k in range(number):
        over = 1 / max(n[k], 1e-9)
        p[k, 0] *= over
        p[k, 1] *= over
        C[k, 0, 0] = C[k, 0, 0] * over - p[k, 0] * p[k, 0] + 1 / 12
        C[k, 0, 1] = C[k, 1, 0] = C[k, 0, 1] * over - p[k, 0] * p[k, 1]
        C[k, 1, 1] = C[k, 1, 1] * over - p[k, 1] * p[k, 1] + 1 / 12


def part_blob(x: NDArray, y: NDArray, C: NDArray, valley: float) -> Blobs | None:
    """The two halves of a blob of covariance C that has a gap across its longer axis; or None.

    A gap is where less than the share `valley` of its events lies within the halves' sizes of the
    middle between them, and the halves do not touch. The half with more events comes first.
    """
    if len(x) < 8:
        return None
    p = np.stack([x, y], 1).astype(float)
    along = p @ np.linalg.eigh(C)[1][:, 1]
    middle = along.mean()
    for _ in range(4):  # of two means
        upper = along > middle
        if upper.all() or not upper.any():
            return None
        middle = (along[upper].mean() + along[~upper].mean()) / 2
    halves = sorted((upper, ~upper), key=lambda half: -half.sum())
    between = sum(along[half].std() for half in halves) / 2
    if (abs(along - middle) < between).mean() > valley:
        return None
    two = Blobs.of(2)
    for k, half in enumerate(halves):
        two.n[k], two.p[k] = half.sum(), p[half].mean(0)
        two.C[k] = np.cov(p[half].T, ddof=0) + np.eye(2) / 12
    apart = touching(two.p[0], two.C[0], two.p[1], two.C[1])
    return two if apart >= CONTACT else None


def touching(pa: NDArray, Ca: NDArray, pb: NDArray, Cb: NDArray) -> Any:
    """Distances over the sum of both ellipses' reach along the line between them."""
    d = pb - pa
    length = np.hypot(d[..., 0], d[..., 1])
    u = d / np.maximum(length, 1e-9)[..., None]
    reach = [np.sqrt(np.einsum("...i,...ij,...j", u, C, u)) for C in (Ca, Cb)]
    return length / np.maximum(reach[0] + reach[1], 1e-9)


@njit_noalloc_inlined
def touch(p: Any, C: Any, j: int, k: int) -> bool:
    """Whether two of some blobs touch: `touching` is below `CONTACT`."""
    x, y, reach = p[k, 0] - p[j, 0], p[k, 1] - p[j, 1], 0.0
    for i in (j, k):
        reach += np.sqrt(C[i, 0, 0] * x * x + 2 * C[i, 0, 1] * x * y + C[i, 1, 1] * y * y)
    return x * x + y * y <= CONTACT * reach
