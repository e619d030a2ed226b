"""How patches of the image move, from events alone, before anything else is known.

    speed = usual_speed(recording)   # px/s, None where nothing is seen to move

Methods choose the lengths of their windows by that (`MotionEstimator.suit`), and models are
compared by it (`choice`). Around some times, events of a window of length L are moved back by every
way d (px in L) of a grid. The signed image of a patch of 24 px is sharpest at the way that it took
(cf. contrast maximisation). Of windows of many lengths the sharpest in which that way is within
reach tells a patch's speed |d| / L best.
"""

import contextlib
import weakref
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.egomotion.candidates import coordinates
from jaxevent.recording import Recording

PATCH = 24  # px
REACH = 7  # px, the longest way that is tried, in x and y
LENGTHS = 0.0015625 * 2.0 ** np.arange(11)  # s, of windows that are tried
TIMES = 6  # at which windows are tried
MOST = 12_000  # events of a window, of whole patches
FEWEST = 40  # events of a patch
LEAST_WAY = 2.5  # px; a shorter way is not told from none
SHARP = 1.15  # a patch's sharpest image by the median over all ways, at least
ALIKE = 0.2  # of the patches whose halves tell one way, at least; of noise 0.1
ENOUGH = 6  # patches that tell a speed, at least
MARGIN = 6  # px of a patch's image around it
GRAIN = 2  # px of its pixels

# Of `usual_speed`: events, sensor, answer.
_latest: tuple[Any, Any, "Speed | None"] = (lambda: None, None, None)


class Speed(NamedTuple):
    """Of patches of the image (px/s): the median, and the slowest and the fastest quarter's bound.

    `at` lists for each of some times (us) the usual speed then, NaN where nothing is seen to move.
    """

    usual: float
    slow: float
    fast: float
    at: tuple[tuple[int, float], ...]


class Look(NamedTuple):
    """How sharp patches of a window become by every way, for two halves of the pixels.

    Patches that hold too few events are left out; `energy` is the sum of squares of the signed
    image, per event, of ways that are `ways` (2, n) px in the window's length (s), in x and y.
    """

    middle: int  # us
    length: float
    xi: NDArray[np.float64]  # (patches, 2) px, of their middles, from the principal point
    count: NDArray[np.int64]  # (patches,)
    energy: NDArray[np.float64]  # (2, patches, n, n), rows by the way in y
    ways: NDArray[np.float64]  # (n,) px


def middles(recording: Recording, number: int) -> list[int]:
    """So many times (us), spread evenly over the events."""
    events, n = recording.events, len(recording.events)
    rows = [int(n * (k + 0.5) / number) for k in range(number)]
    return [int(events[row : row + 1].t[0]) for row in rows]


def usual_speed(recording: Recording, camera: PinholeCamera | None = None) -> Speed | None:
    """How fast things move in the image (px/s, undistorted); None where that is not seen.

    Windows of 1.6 ms to 1.6 s are tried at six times, spread evenly over the events. The latest
    answer is kept: the windows of each method, the choice of the model and scores ask for it.
    """
    asked = recording.width, recording.height, camera or recording.camera
    global _latest
    events, known, speed = _latest
    if events() is recording.events and known == asked:
        return speed
    speed = _measured(recording, asked[2])
    with contextlib.suppress(TypeError):  # a source of the user's own may not take references
        _latest = weakref.ref(recording.events), asked, speed
    return speed


def tried(recording: Recording) -> str:
    """Of which lengths windows are tried, in words: those that fit in the recording."""
    if len(recording.events) < FEWEST:
        return "in so few events"
    fit = [float(length) for length in LENGTHS if _fits(recording, length)]
    if not fit:
        return "in so short a recording"
    ends = sorted({fit[0], fit[-1]})
    told = [f"{1e3 * one:.2g} ms" if one < 0.1 else f"{one:.2g} s" for one in ends]
    return f"in windows of {' to '.join(told)}"


def _fits(recording: Recording, length: float) -> bool:
    """Whether the recording is as long as a window of this length (s)."""
    return 2 * round(5e5 * length) <= recording.stop - recording.start + 1


def _measured(recording: Recording, camera: PinholeCamera | None) -> Speed | None:
    if len(recording.events) < FEWEST:
        return None
    xi, _ = coordinates(recording.width, recording.height, camera)
    speeds, at, patches = [], [], 0
    for middle in middles(recording, TIMES):
        found: dict[tuple[float, ...], tuple[float, float]] = {}
        for length in LENGTHS:
            seen = look(recording, middle, float(length), REACH, xi)
            if seen is None:
                continue
            sharp, way, alike = _sharpest(seen)
            for k, place in enumerate(map(tuple, seen.xi.tolist())):
                # At the border of what is tried the way may be longer still.
                if way[k] < REACH - 0.5 and sharp[k] > found.get(place, (SHARP, 0.0))[0]:
                    told = alike[k] and way[k] >= LEAST_WAY
                    found[place] = sharp[k], way[k] / float(length) if told else 0.0
        here = np.array([speed for _, speed in found.values() if speed > 0])
        patches += len(found)
        speeds.append(here)
        at.append((middle, float(np.median(here)) if len(here) >= ENOUGH else np.nan))
    speed = np.concatenate(speeds)
    if len(speed) < max(ENOUGH, ALIKE * patches):
        return None
    low, usual, high = np.percentile(speed, [25, 50, 75])
    return Speed(float(usual), float(low), float(high), tuple(at))


def _sharpest(seen: Look) -> tuple[NDArray, NDArray, NDArray]:
    """Of patches: how sharp they become, the way (px) that does it, whether both halves tell it."""
    n, m = len(seen.xi), len(seen.ways)
    halves = seen.energy.reshape(2, n, -1)
    energy = halves.mean(0)

    def way(best: NDArray) -> NDArray:
        return np.stack([seen.ways[best % m], seen.ways[best // m]], -1)

    apart = np.hypot(*np.moveaxis(way(halves[0].argmax(1)) - way(halves[1].argmax(1)), -1, 0))
    sharp = energy.max(1) / np.maximum(np.median(energy, 1), 1e-9)
    return sharp, np.hypot(*way(energy.argmax(1)).T), apart <= 2


def look(
    recording: Recording,
    middle: int,
    length: float,
    reach: int,
    xi: NDArray[np.float64],
) -> Look | None:
    """The patches of the window of a length (s) about a time (us); None where there are none.

    `xi` (height, width, 2) are the pixels' places; see `candidates.coordinates`.
    """
    corner = np.floor(xi.min((0, 1)))
    columns = int((xi[..., 0].max() - corner[0]) // PATCH) + 1
    half, index = round(5e5 * length), recording.events.index
    start, stop = index(middle - half), index(middle + half)
    if stop - start < FEWEST or not _fits(recording, length):
        return None
    events = recording.events[start : min(stop, start + 40 * MOST)]
    at = xi[events.y, events.x] - corner
    row, column = (at[:, 1] // PATCH).astype(int), (at[:, 0] // PATCH).astype(int)
    patch = row * columns + column
    count = np.bincount(patch)
    order = np.random.default_rng(0).permutation(len(count))
    order = order[count[order] >= FEWEST]
    if not len(order):
        return None
    taken = np.sort(order[: max(1, int((np.cumsum(count[order]) <= MOST).sum()))])
    number = np.full(len(count), -1)
    number[taken] = np.arange(len(taken))
    keep = number[patch] >= 0
    local = at[keep] - np.stack([column, row], 1)[keep] * PATCH
    sign, which = np.where(events.p[keep], 1.0, -1.0), number[patch[keep]]
    halves = (events.x[keep].astype(int) + events.y[keep]) % 2
    since = (events.t[keep] - middle) * 1e-6 / length
    ways = np.arange(-reach, reach + 1.0)
    energy = np.zeros((2, len(taken), len(ways), len(ways)))
    side = (PATCH + 2 * MARGIN) // GRAIN
    images = np.empty((2, len(taken), side, side))
    _energies(local, since, sign, which, halves, ways, images, energy)
    for k in range(2):
        share = np.bincount(which[halves == k], minlength=len(taken))
        energy[k] /= np.maximum(share, 1)[:, None, None]
    centre = corner + (np.stack([taken % columns, taken // columns], 1) + 0.5) * PATCH
    return Look(middle, length, centre, count[taken], energy, ways)


@njit_noalloc
def _energies(at, since, sign, patch, half, ways, images, energy):
    """Sums of squares of patches' signed images, of pixels of `GRAIN`, for every way."""
    side = images.shape[3]
    for row in range(len(ways)):
        for column in range(len(ways)):
            images[:] = 0
            for e in range(len(at)):
                x = (at[e, 0] - ways[column] * since[e] + MARGIN) / GRAIN
                y = (at[e, 1] - ways[row] * since[e] + MARGIN) / GRAIN
                i, j = int(np.floor(x)), int(np.floor(y))
                if i < 0 or j < 0 or i >= side - 1 or j >= side - 1:
                    continue
                u, v = x - i, y - j
                image = images[half[e], patch[e]]
                image[j, i] += sign[e] * (1 - u) * (1 - v)
                image[j, i + 1] += sign[e] * u * (1 - v)
                image[j + 1, i] += sign[e] * (1 - u) * v
                image[j + 1, i + 1] += sign[e] * u * v
            for k in range(2):
                for c in range(energy.shape[1]):
                    total = 0.0
                    for j in range(side):
                        for i in range(side):
                            total += images[k, c, j, i] ** 2
                    energy[k, c, row, column] = total
