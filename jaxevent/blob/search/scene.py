"""How the whole scene moves past a moving camera.

An image of events is aligned to what was seen before by a shift and a turn, from coarse to fine
(Lucas and Kanade), with little weight where they differ. Chained, these motions tell where places
of the scene are on the sensor.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.stream import Part, Stream
from jaxevent.codegen import njit, njit_inlined

REFERENCE = np.array([[60.0, 60], [180, 60], [60, 180], [180, 180]])  # px
STEPS = 128  # motions of a recording, at most
LITTLE = 0.5  # px
WIDE = 240  # bins of a pixel and more, so that no more of them lie side by side
ODD = 1.5  # of the usual difference: pixels that differ so much have half the weight
NEWEST = 0.07  # share of the newest window in what was seen
BLURS = (4, 2, 1)  # bins
ROUNDS, SMALL = 8, 0.02  # of Gauss and Newton, at most; bins at which they end


@dataclasses.dataclass(frozen=True)
class SceneMotion:
    """Where points of the scene are: at t (n,) s in `maps` (n, 2, 3), px from px at the start."""

    t: NDArray[np.float64]
    maps: NDArray[np.float64]

    @property
    def travel(self) -> float:
        """px, how far `REFERENCE` is from where it was at the start, at most."""
        return float(np.hypot(*(self._reference() - REFERENCE[:, None]).T).max())

    @property
    def speed(self) -> float:
        """px/s, the median over time of that of `REFERENCE`."""
        moved = np.diff(self._reference(), axis=1)
        return float(np.median(np.hypot(*moved.T).mean(1) / np.diff(self.t)))

    def _reference(self) -> NDArray[np.float64]:
        """(4, n, 2)."""
        moved = np.einsum("nij,kj->kni", self.maps[:, :, :2], REFERENCE)
        return moved + self.maps[:, :, 2]

    def at(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps at some times, on straight lines between those known."""
        k = np.clip(np.searchsorted(self.t, t) - 1, 0, len(self.t) - 2)
        part = np.asarray((t - self.t[k]) / (self.t[k + 1] - self.t[k]))
        return self.maps[k] + part[..., None, None] * (self.maps[k + 1] - self.maps[k])

    def in_scene(self, x: Any, y: Any, t: Any) -> tuple[Any, Any]:
        """Where in the scene pixels of the sensor are at times (s)."""
        (a, b, e), (c, d, f) = np.moveaxis(self.at(np.asarray(t, float)), (-2, -1), (0, 1))
        x, y, over = x - e, y - f, a * d - b * c
        return (d * x - b * y) / over, (a * y - c * x) / over

    def steps(self, begin: float | int, end: float | int) -> NDArray[np.float64]:
        """Times (s) between two, `begin` and `end` too, between which the scene moves little."""
        number = 1 + int(self.speed * (end - begin) / LITTLE)
        return np.linspace(begin, end, number + 1)

    def on_sensor(self, x: Any, y: Any, t: Any) -> tuple[Any, Any]:
        """Where on the sensor places of the scene are at times (s)."""
        (a, b, e), (c, d, f) = np.moveaxis(self.at(np.asarray(t, float)), (-2, -1), (0, 1))
        return a * x + b * y + e, c * x + d * y + f


def measure_scene_motion(stream: Stream, window: float | int) -> SceneMotion:
    """The shift and turn of all that is seen in a stream, from windows (s) aligned to those before.

    What was seen before is a mean of earlier windows, each carried on as the scene went.
    """
    steps = int(min(STEPS, stream.duration / window))
    begins = np.linspace(0, stream.duration - window, steps)
    bins = -(-max(stream.width, stream.height) // WIDE)
    maps, motion, seen = [np.eye(2, 3)], None, None
    for number, begin in enumerate(begins):
        image = _image(stream.window(begin, begin + window), stream, bins)
        if seen is None:
            seen = image
            continue
        motion = _align(seen, image, _shift(seen, image) if motion is None else motion)
        step = _px(motion, image.shape, bins)
        maps.append(np.concatenate([step[:, :2] @ maps[-1][:, :2],
            step[:, :2] @ maps[-1][:, 2:] + step[:, 2:]], 1))  # fmt: skip
        new = max(NEWEST, 1 / (number + 1))
        seen = _carry(seen, motion, image, new)
    return SceneMotion(begins + window / 2, np.array(maps))


def _image(part: Part, stream: Stream, bins: int) -> NDArray[np.float64]:
    """Roots of counts: their noise is everywhere the same."""
    rows, columns = -(-stream.height // bins), -(-stream.width // bins)
    place = part.y // bins * columns + part.x // bins
    return np.sqrt(np.bincount(place, minlength=rows * columns).reshape(rows, columns))


def _px(motion: NDArray, shape: tuple[int, ...], bins: int) -> NDArray[np.float64]:
    """A motion of bins as one of px: p + displacement = A p + b, (2, 3)."""
    turn = motion[0] / (sum(shape) / 4)
    A = np.array([[0, -turn], [turn, 0]])
    middle = (np.array(shape[::-1]) - 1) / 2
    b = bins * (motion[1:] - A @ middle) - A @ np.full(2, (bins - 1) / 2)
    return np.concatenate([A, b[:, None]], 1) + np.eye(2, 3)


def _shift(one: NDArray, other: NDArray) -> NDArray[np.float64]:
    """The shift at which two images are most alike."""
    a, b = (np.fft.rfft2(ndimage.gaussian_filter(i, 3) - i.mean()) for i in (one, other))
    alike = np.fft.irfft2(b * a.conj(), one.shape)
    at = np.unravel_index(alike.argmax(), alike.shape)
    y, x = (int(k) if k < n / 2 else int(k) - n for k, n in zip(at, one.shape, strict=True))
    return np.array([0.0, x, y])


def _align(one: NDArray, other: NDArray, motion: NDArray) -> NDArray[np.float64]:
    """The motion (3,), in bins as `_normal_equations` has it, that takes one image to the other."""
    for blur in BLURS:
        a, b = (ndimage.gaussian_filter(image, blur, mode="constant") for image in (one, other))
        for _ in range(ROUNDS):
            H, slope = _normal_equations(a, b, motion, ODD)
            H += np.eye(3) * (1e-4 * np.trace(H) / 3 + 1e-12)
            step = np.linalg.solve(H, slope)
            motion = motion - step
            if abs(step).max() < SMALL:
                break
    return motion


@njit
def _carry(image: Any, motion: Any, now: Any, new: Any) -> Any:
    """An image after a motion, with a share of what is seen now, or that where it was not seen."""
    (rows, columns), out = image.shape, np.empty(image.shape)
    quarter = (rows + columns) / 4
    for row in range(rows):
        y = (row - (rows - 1) / 2) / quarter
        for column in range(columns):
            x = (column - (columns - 1) / 2) / quarter
            dx, dy = motion[1] - motion[0] * y, motion[2] + motion[0] * x
            before = _value(image, row - dy, column - dx)
            if before == before:
                out[row, column] = (1 - new) * before + new * now[row, column]
            else:
                out[row, column] = now[row, column]
    return out


@njit
def _normal_equations(a: Any, b: Any, motion: Any, odd: float | int) -> Any:
    """Of Gauss and Newton: J^T W J and J^T W e of two images, each moved half the way.

    Motions are a turn about the middle, one unit of which moves what is a quarter of the sides' sum
    away by one bin, and shifts right and down. Bins that differ by `odd` times the usual have half
    the weight.
    """
    rows, columns = a.shape
    quarter = (rows + columns) / 4
    e, mean = np.empty(a.shape), np.zeros(a.shape)
    total, number = 0.0, 0
    for row in range(rows):
        y = (row - (rows - 1) / 2) / quarter
        for column in range(columns):
            x = (column - (columns - 1) / 2) / quarter
            half_x, half_y = (motion[1] - motion[0] * y) / 2, (motion[2] + motion[0] * x) / 2
            before = _value(a, row - half_y, column - half_x)
            after = _value(b, row + half_y, column + half_x)
            difference = after - before
            e[row, column] = difference  # NaN where one was not seen
            if difference == difference:
                mean[row, column] = (after + before) / 2
                total += difference * difference
                number += 1
    scale = 1 / (odd * (np.sqrt(total / max(number, 1)) + 1e-12))
    tt = tx = ty = xx = xy = yy = st = sx = sy = 0.0
    for row in range(rows):
        y = (row - (rows - 1) / 2) / quarter
        above, below = max(row - 1, 0), min(row + 1, rows - 1)
        for column in range(columns):
            difference = e[row, column]
            if not difference == difference:
                continue
            x = (column - (columns - 1) / 2) / quarter
            left, right = max(column - 1, 0), min(column + 1, columns - 1)
            gx = (mean[row, right] - mean[row, left]) / (right - left)
            gy = (mean[below, column] - mean[above, column]) / (below - above)
            gt = x * gy - y * gx
            weight = 1 / (1 + (difference * scale) ** 2)
            wt, wx, wy = weight * gt, weight * gx, weight * gy
            st, sx, sy = st + wt * difference, sx + wx * difference, sy + wy * difference
            tt, tx, ty = tt + wt * gt, tx + wt * gx, ty + wt * gy
            xx, xy, yy = xx + wx * gx, xy + wx * gy, yy + wy * gy
    H = np.array([[tt, tx, ty], [tx, xx, xy], [ty, xy, yy]])
    return H, np.array([st, sx, sy])


@njit_inlined
def _value(image: Any, y: float, x: float) -> float:
    """Between bins on straight lines; NaN outside."""
    rows, columns = image.shape
    if not (0 <= y <= rows - 1 and 0 <= x <= columns - 1):
        return np.nan
    row, column = min(int(y), rows - 2), min(int(x), columns - 2)
    v, u = y - row, x - column
    top = (1 - u) * image[row, column] + u * image[row, column + 1]
    return (1 - v) * top + v * ((1 - u) * image[row + 1, column] + u * image[row + 1, column + 1])
