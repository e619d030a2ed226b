"""Things that turn in their place: pieces of the texture of one are one target.

Such a thing fills a place that is never dark, and all its events tell about which point it turns.
Velocities of its pieces tell roughly how fast: pieces slide along edges, and the rate comes out up
to twice too small. Events aligned window by window in polar coordinates tell it to 0.1 %. It is one
thing if a map that turns so tells its events better than one at rest, and if what is bright in that
map hangs together: birds that circle alike turn as well, but are apart.
"""

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.agility import fit_agility
from jaxevent.blob.search.background import BRIGHT, FINE, Background, evidence, look_up
from jaxevent.blob.search.moving import SIDES, SURE, map_gain, measure_moving_background
from jaxevent.blob.search.paths import Path
from jaxevent.blob.search.scene import SceneMotion
from jaxevent.blob.search.stream import Stream
from jaxevent.blob.search.targets import SEEN, larger

INSIDE = 0.8  # share of a piece's rows that are in the place
RING, ANGLES = FINE, 256  # px of a ring, and bins of a turn
REACH = 2.0  # times the turn of a window that velocities tell: how far beside it one is sought
BLUR, NEWEST = 1.5, 0.07  # bins, and share of the newest window in what was seen
RIM = 0.98  # share of the events that are not farther from the middle
# Share of the bright that hangs together, and of its usual rate from which a cell is bright: 0.97
# and more of textured discs, seeds 0 to 7 and 20 to 27; 0.14 to 0.56 of 3 to 25 blobs that circle
# alike, 2 to 5 px large and within 60 px of the middle, 18 scenes, and 0.95 of 12 that overlap. Of
# discs a map that turns tells 0.46 to 0.77 nats per event more than one at rest.
TOGETHER, DIM = 0.96, 0.07


class Turn(NamedTuple):
    """A turn: rad/s, from x to y, about a point (px)."""

    rate: float
    centre: NDArray[np.float64]


def join_turning(paths: list[Path], stream: Stream, background: Background) -> list[Path]:
    """Make one of the paths of pieces of each thing that turns in its place.

    `background` is that of the stream, at rest; before a scene that moves nothing is joined.
    """
    if not paths or background.scene is not None:
        return paths
    bright = background.rate > BRIGHT * np.median(background.rate)
    places = np.zeros(bright.shape, np.int32)
    ndimage.label(bright, np.ones((3, 3)), places)
    out = list(paths)
    for place in range(1, int(places.max()) + 1):
        there = places == place
        pieces = [path for path in out if look_up(there, FINE, *path.p.T).mean() >= INSIDE]
        if not pieces or _sides(there) >= SIDES:
            continue
        whole = _turning(pieces, _within(stream, there), background)
        if whole is not None:
            out = [path for path in out if all(path is not piece for piece in pieces)]
            out.append(whole)
    return out


def _sides(there: NDArray[np.bool_]) -> int:
    """How many sides of the sensor a place reaches: an object is seen whole."""
    return sum(bool(side.any()) for side in (there[0], there[-1], there[:, 0], there[:, -1]))


def _within(stream: Stream, there: NDArray[np.bool_]) -> Stream:
    """The events of a place, told in fine cells."""
    own = copy.copy(stream)
    inside = np.kron(there, np.ones((FINE, FINE), bool))[: stream.height, : stream.width]
    own.hot = stream.hot | ~inside
    return own


def _turning(pieces: list[Path], own: Stream, background: Background) -> Path | None:
    """The path of the thing whose pieces these are; None if it is not one that turns."""
    centre = _middle(own)
    turn = Turn(_rate(pieces, centre), centre)
    window = max(pieces, key=lambda path: path.n.sum()).window
    scene = _follow(own, turn, window * 1e-6)
    moving = measure_moving_background(own, scene)
    if not _is_one(moving, turn.centre) or map_gain(own, moving, window * 1e-6) < SURE:
        return None
    return _whole(own, Turn(_mean_rate(scene), centre), window, background)


def _middle(own: Stream) -> NDArray[np.float64]:
    """The point (px) about which the events are most alike when they are turned by half a turn.

    What turns in its place leaves events all about its middle alike. Of roots of counts it is half
    of where their convolution with themselves is largest.
    """
    pixels = own.pixels(0, own.duration)
    image = np.zeros((2 * own.height, 2 * own.width))
    image[pixels.y, pixels.x] = np.sqrt(pixels.n)
    alike = np.fft.irfft2(np.fft.rfft2(image) ** 2, image.shape)
    y, x = np.unravel_index(alike.argmax(), alike.shape)
    return np.array([x, y]) / 2


def _rate(pieces: list[Path], centre: NDArray[np.float64]) -> float:
    """How fast pieces turn about a point, rad/s: the median of their rows by distance squared."""
    (x, y), v = (np.concatenate([getattr(path, name) for path in pieces]).T for name in "pv")
    x, y = x - centre[0], y - centre[1]
    square = np.maximum(x * x + y * y, 1e-9)
    rate = (x * v[1] - y * v[0]) / square
    order = np.argsort(rate)
    total = np.cumsum(square[order])
    return float(rate[order][np.searchsorted(total, total[-1] / 2)])


def _follow(own: Stream, turn: Turn, window: float) -> SceneMotion:
    """The turn window by window (s): that at which it is most like what was seen before.

    As fast as `turn` says, or slower or faster by up to `REACH` times that.
    """
    number = int(own.duration / window)
    polar = _Polar(own, turn, window)
    order = 1j * np.arange(ANGLES // 2 + 1)
    step = turn.rate * window
    reach = min(max(2, int(REACH * abs(step) / (2 * np.pi) * ANGLES)), ANGLES // 2 - 1)
    near = np.arange(-reach, reach + 1)
    angles, seen = [0.0], polar.spectrum(0)
    for k in range(1, number):
        now = polar.spectrum(k)
        expected = angles[-1] + step
        alike = np.fft.irfft((now * seen.conj()).sum(0) * np.exp(order * expected), ANGLES)
        best = int(near[np.argmax(alike[near])])
        before, peak, after = alike[best - 1], alike[best], alike[(best + 1) % ANGLES]
        bend = before - 2 * peak + after
        top = best + (0.5 * (before - after) / bend if bend < 0 else 0.0)
        angles.append(expected + top * 2 * np.pi / ANGLES)
        new = max(NEWEST, 1 / (k + 1))
        seen = (1 - new) * seen + new * now * np.exp(order * angles[-1])
    return _as_motion((np.arange(number) + 0.5) * window, np.array(angles), turn.centre)


class _Polar:
    """Roots of counts of windows of a stream in rings and angles about a point."""

    def __init__(self, own: Stream, turn: Turn, window: float):
        self.own, self.turn, self.window = own, turn, window
        whole = own.pixels(0, own.duration)
        far = np.sort(np.hypot(whole.x - turn.centre[0], whole.y - turn.centre[1]))
        self.rings = int(far[int(RIM * (len(far) - 1))] / RING) + 1

    def spectrum(self, k: int) -> NDArray[np.complex128]:
        """Of window k, (rings, frequencies); events are carried to the middle of the window."""
        part = self.own.window(k * self.window, (k + 1) * self.window)
        dx, dy = part.x - self.turn.centre[0], part.y - self.turn.centre[1]
        late = part.t - (k + 0.5) * self.window
        angle = (np.arctan2(dy, dx) - self.turn.rate * late) / (2 * np.pi) % 1
        ring = (np.hypot(dx, dy) / RING).astype(np.int64)
        place = ring * ANGLES + (angle * ANGLES).astype(np.int64) % ANGLES
        size = self.rings * ANGLES
        counts = np.bincount(place[place < size], minlength=size).reshape(-1, ANGLES)
        image = ndimage.gaussian_filter1d(np.sqrt(counts), BLUR, axis=1, mode="wrap")
        return np.fft.rfft(image - image.mean(1, keepdims=True))


def _as_motion(t: NDArray, angles: NDArray, centre: NDArray[np.float64]) -> SceneMotion:
    """Turns by angles about a point."""
    c, s = np.cos(angles), np.sin(angles)
    A = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)
    return SceneMotion(t, np.concatenate([A, (centre - A @ centre)[..., None]], 2))


def _mean_rate(scene: SceneMotion) -> float:
    """How fast a scene turns from its first window to its last, rad/s."""
    angles = np.unwrap(np.arctan2(scene.maps[:, 1, 0], scene.maps[:, 0, 0]))
    return float((angles[-1] - angles[0]) / (scene.t[-1] - scene.t[0]))


def _is_one(moving: Background, centre: NDArray[np.float64]) -> bool:
    """Whether what is bright in a map that turns hangs together, about the point of the turn."""
    rate = np.where(moving.seen, moving.rate - moving.rate.min(), 0)
    total = float(rate.sum())
    labels = np.zeros(rate.shape, np.int32)
    ndimage.label(rate * total > DIM * (rate**2).sum(), np.ones((3, 3)), labels)
    mass = np.bincount(labels.ravel(), rate.ravel())
    if len(mass) < 2 or mass[1:].max() < TOGETHER * total:
        return False
    y, x = np.nonzero(labels == 1 + mass[1:].argmax())
    places = (np.stack([x, y], 1) + 0.5) * FINE + moving.corner
    n = rate[y, x]
    away = np.average(places, 0, n) - centre
    C = np.cov(places.T, aweights=n) + np.eye(2)
    return bool(away @ np.linalg.solve(C, away) < 1)


def _whole(own: Stream, turn: Turn, window: int, background: Background) -> Path | None:
    """The path of all events of a place that turns.

    Of windows (us) with more events than the darkest background gives; None, if there are none.
    """
    w, rows = window * 1e-6, []
    area = own.width * own.height - int(own.hot.sum())
    for k in range(int(own.duration / w)):
        part = own.window(k * w, (k + 1) * w)
        if evidence(len(part), background.least * area * w, 1) > -np.log(SEEN):
            e = np.stack([part.x, part.y], 1) - turn.centre
            rows.append(((k + 0.5) * w, e.mean(0), e.T @ e / len(e) + np.eye(2) / 12, len(e)))
    if not rows:
        return None
    t, m, C, n = (np.array(values) for values in zip(*rows, strict=True))
    R = larger(C) / 2 / n
    us = own.start + np.rint(t * 1e6).astype(np.int64)
    agility = fit_agility(t, m, R, float(np.median(larger(C))) / w**3)
    p = np.tile(turn.centre, (len(t), 1))
    n = n.astype(float)
    return Path(us, p, np.zeros_like(p), C, n, window, agility, turn=turn.rate)
