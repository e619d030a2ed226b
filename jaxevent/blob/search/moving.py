"""The background that a moving camera sees: a map of the scene that goes with it.

It is taken only where a scene is seen all over the sensor, dense with edges or textured, and where
its map, moved along, tells events better than one at rest. Targets that go together, as stars do,
are no scene.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.background import (
    CELL,
    FINE,
    FULL,
    SLICES,
    USUAL,
    Background,
    in_steps,
    pooled,
)
from jaxevent.blob.search.detection import detect
from jaxevent.blob.search.paths import Path
from jaxevent.blob.search.scale import LEAST_WINDOWS, STRETCHES, WINDOWS, Choice
from jaxevent.blob.search.scene import SceneMotion, measure_scene_motion
from jaxevent.blob.search.stream import Stream

CALM = 0.75  # share of the slices in which a place is seen whose counts are taken
LEAST = 0.05  # of the mean rate: that of places without events
TILES, FILLED, FEW = 4, 9, 3  # tiles along each side; of all, those with so many events in blobs
DARK = 0.1  # share of the places that are darker than what blobs are told from there
BRIGHT = 1.5  # times the mean rate: what is bright is an edge if it is
STRIP, SIDES = 16, 3  # of the sensor's width or height a side takes, and how many are reached
OFTEN = 0.25  # of the windows: of a dense scene little stands out in a strip
LONG, LARGE = 2.5, 0.1  # so many times as long as wide, or of this share of the map's shorter side
# Cells: what is long is no less large, for two stars side by side are 1 to 1.5. Share of edges of
# 43 stars up to 0.23 without, 0 with it; of nine real scenes 0.42 to 0.99 without, 0.41 to 0.99.
PAIR = 1.5
# Share of the bright that is edges; where a cell has fewer than so many events more must be, for by
# chance many cells are bright and lie side by side: 0.48 of 20 blobs and noise, 0.98 of a disc.
SCENE, SOME, CLEAR = 0.15, 3, 0.7
# Or share of the scene that is bright: 0.22 of soft textures, 0.05 to 0.1 of stars. Of noise it is
# 0.21, but of so many events in a cell less; nats per event that its map tells more when it moves.
TEXTURE, PLENTY, SURE = 0.15, 20, 0.05
TOLD = 0.1  # of the stretches may be told worse by a map that moves than by one at rest
MOVED = 2.0  # px
QUIET, PAUSE = 0.25, 8  # of a usual slice's events: what a pause has, and its slices, at least
DENSE = 0.3  # level of a usual slice of a dense scene
TRIED = (1, 1 / 4, 1 / 16, 4)  # times the window of blobs: before a scene that shakes it may be any
OWN_WAY = 2.0  # sizes: deviation, along any axis, of a target's own way from its mean
STEADY = 0.2  # sizes by which a target may leave its velocity's way in a window
STEP = 0.01  # s before and after, between which the scene's motion at a target is told


def is_full(background: Background) -> bool:
    """Whether most of the sensor sees events in a usual slice."""
    return float(np.quantile(background.level, USUAL)) > DENSE


def pauses(background: Background) -> list[tuple[float, float]]:
    """Spans (s) in which most of a scene is quiet, and those between them; the whole, if none is.

    Of `PAUSE` slices and more each: what is shorter goes with what is about it.
    """
    most = float(np.quantile(background.level, USUAL))
    quiet = ndimage.binary_opening(background.level < QUIET * most, np.ones(PAUSE))
    moves = ndimage.binary_opening(~quiet, np.ones(PAUSE))
    first = np.flatnonzero(np.diff(moves)) + 1 if is_full(background) else []
    edges = np.array([0, *first, SLICES]) / SLICES * background.duration
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def find_moving_background(
    stream: Stream, background: Background, choice: Choice
) -> Background | None:
    """The background as a map that moves; None where the camera does not seem to move.

    `background` is that at rest, and `choice` the scale of its blobs.
    """
    if _filled(stream, background, choice) < FILLED:
        return None
    for times in TRIED:
        window = times * choice.scale.window
        if not WINDOWS[0] * 1e-6 <= window <= stream.duration / LEAST_WINDOWS:
            continue
        scene = measure_scene_motion(stream, window)
        moving = measure_moving_background(stream, scene)
        gain = _looks_like_one(moving)
        if gain is None:  # whatever the window
            return None
        if scene.travel >= MOVED and map_gain(stream, moving, window) >= gain:
            return moving
    return None


def _looks_like_one(moving: Background) -> float | None:
    """The nats per event that a scene's map must tell more as it moves; None if it is no scene.

    Of edges, or of a texture: much of it is bright, by more than chance makes of few events.
    """
    seen = moving.seen
    events = moving.mean * FINE**2 * moving.duration
    edges = _of_edges(np.where(seen, moving.rate, 0), moving.mean)
    if edges >= (SCENE if events >= SOME else CLEAR):
        return 0.0
    bright = float((moving.rate[seen] > BRIGHT * moving.mean).mean())
    return SURE if events >= PLENTY and bright > TEXTURE else None


def map_gain(stream: Stream, moving: Background, w: float | int) -> float:
    """Nats per event that a map tells more as it moves than one at rest, in most windows of w s."""
    scene = moving.scene
    assert scene is not None
    rest = dataclasses.replace(scene, maps=np.broadcast_to(np.eye(2, 3), scene.maps.shape))
    still, gains = measure_moving_background(stream, rest), []
    for t in np.maximum(stream.times(STRETCHES), w):
        part = stream.window(t - w, t)
        one, other = (b.at(part.x, part.y, part.t) for b in (moving, still))
        gains.append(float(np.log(one / other).mean()) if len(part) else 0.0)
    return float(np.quantile(gains, TOLD))


def _filled(stream: Stream, background: Background, choice: Choice) -> float:
    """In how many tiles of the sensor blobs are seen, in the median window.

    None, if they seldom reach three of its sides: an object may be large, but it is seen whole.
    Blobs are what stands out from the sensor's dark places: in a short recording a scene hardly
    leaves its place, and most of it is in the background.
    """
    w, size = choice.scale.window, (stream.height, stream.width)
    dark = np.full_like(background.rate, np.quantile(background.rate, DARK))
    background = dataclasses.replace(background, rate=dark)
    tiles, sides = [], []
    for t in np.maximum(stream.times(STRETCHES), w):
        part = stream.window(t - w, t)
        labels, _ = detect(part, background, choice.scale, size, t)
        y, x = part.y[labels > 0], part.x[labels > 0]
        place = y * TILES // size[0] * TILES + x * TILES // size[1]
        tiles.append((np.bincount(place, minlength=TILES**2) >= FEW).sum())
        strips = [STRIP * v < n for v, n in ((x, size[1]), (y, size[0]))]
        strips += [STRIP * (n - 1 - v) < n for v, n in ((x, size[1]), (y, size[0]))]
        sides.append(sum(strip.sum() >= FEW for strip in strips))
    return float(np.median(tiles)) if np.mean(np.array(sides) >= SIDES) >= OFTEN else 0.0


def _of_edges(rate: NDArray[np.float64], mean: float) -> float:
    """Share of what is bright that is long or large: edges, and not what may be targets."""
    excess = np.where(rate > BRIGHT * mean, rate - mean, 0)
    labels = np.zeros(rate.shape, np.int32)
    ndimage.label(excess > 0, np.ones((3, 3)), labels)
    number = int(labels.max())
    y, x = np.nonzero(excess)
    part, n = labels[y, x] - 1, excess[y, x]

    def total(values: NDArray) -> NDArray:
        return np.bincount(part, n * values, number) / mass

    mass = np.bincount(part, n, number)
    mx, my = total(x), total(y)
    xx, yy, xy = total(x * x) - mx**2, total(y * y) - my**2, total(x * y) - mx * my
    half, cross = (xx + yy) / 2 + 1 / 12, np.hypot((xx - yy) / 2, xy)
    size = np.sqrt(half + cross)
    long = (size > LONG * np.sqrt(half - cross)) & (size > PAIR)
    large = size > LARGE * min(rate.shape)
    return float(mass[long | large].sum() / max(mass.sum(), 1e-300))


def goes_own_way(path: Path, scene: SceneMotion, start: int) -> bool:
    """Whether a target goes farther than its size, and a cell, on a way that no depth goes.

    What is nearer or farther than most of the scene goes the scene's way, faster or slower. So the
    path across the scene's motion counts, and along it only what goes against it. What goes another
    way in every window is no target, but parts of the scene that are seen by turns. `start`: us.
    """
    window, size = path.window * 1e-6, float(np.median(path.size[:, 0]))
    if path.agility * window**3 / 3 > (STEADY * size) ** 2:
        return False
    t = np.asarray((path.t - start) * 1e-6, np.float64)
    if len(t) < 2:
        return False
    flow = _flow(path, scene, t)
    along = flow / np.maximum(np.hypot(*flow.T), 1e-9)[:, None]
    moved = np.diff(path.p, axis=0)
    with_scene = (moved * along[1:]).sum(1)
    own = moved - np.maximum(with_scene, 0)[:, None] * along[1:]
    way = np.cov(np.concatenate([[[0, 0]], np.cumsum(own, 0)]).T)
    ratio = np.linalg.solve(np.median(path.C, 0) + FINE**2 * np.eye(2), way)
    return bool(np.linalg.eigvals(ratio).real.max() > OWN_WAY**2)


def _flow(path: Path, scene: SceneMotion, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Velocities (rows, 2) px/s of the scene where a path is."""
    now = np.clip(t[:, None] + [-STEP, STEP], scene.t[0], scene.t[-1])
    x, y = scene.in_scene(path.p[:, 0], path.p[:, 1], t)
    x, y = scene.on_sensor(x[:, None], y[:, None], now)
    flow = np.stack([x[:, 1] - x[:, 0], y[:, 1] - y[:, 0]], 1)
    return flow / np.maximum(now[:, 1] - now[:, 0], 1e-9)[:, None]


def measure_moving_background(stream: Stream, scene: SceneMotion) -> Background:
    """Rates of places of the scene while they are seen, from the calmer three quarters of slices.

    What goes its own way is nowhere in the scene for long.
    """
    size = np.array([stream.width, stream.height])
    middles = (np.arange(SLICES) + 0.5) / SLICES * stream.duration
    x, y = (np.array([[0, 1, 0, 1], [0, 0, 1, 1]]) * (size[:, None] - 1))[..., None]
    places = np.stack(scene.in_scene(x, y, middles))
    low = np.floor(places.min((1, 2)))
    columns, rows = ((places.max((1, 2)) - low) // CELL + 1).astype(int)
    corner = int(low[0]), int(low[1])

    y, x = np.mgrid[:rows, :columns] * CELL + CELL / 2
    x, y = scene.on_sensor(x[..., None] + low[0], y[..., None] + low[1], middles)
    seen = np.moveaxis((x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1]), 2, 0)
    by = CELL // FINE
    cells = np.zeros((SLICES, rows * by, columns * by), np.int32)
    edges = np.arange(SLICES + 1) / SLICES * stream.duration
    spans, places, into = in_steps(np.stack([edges[:-1], edges[1:]], 1), scene, corner)
    stream.add_cells(spans, places, FINE, cells, into)

    N = np.where(seen, pooled(cells, by), np.inf)
    rank = np.ceil(CALM * seen.sum(0)).astype(int) - 1
    most = np.take_along_axis(np.sort(N, 0), np.maximum(rank, 0)[None], 0)[0]
    calm = seen & (N <= most)
    activity = _activity(N, calm, seen)
    there = np.kron(calm, np.ones((1, by, by))) > 0
    expected = (there * activity[:, None, None]).sum(0)
    rate = (cells * there).sum(0) / np.maximum(expected, 1) / FINE**2
    known = expected > 0
    usual = max(float(rate[known].mean()), 0.02 / CELL**2)
    rate = np.where(known, np.maximum(rate, LEAST * usual), usual) * SLICES / stream.duration
    bright = np.ones((rows, columns), bool)
    return Background(rate, calm, bright, activity, stream.duration, scene, corner)


def _activity(N: NDArray, calm: NDArray, seen: NDArray) -> NDArray[np.float64]:
    """Of each slice: the median ratio of counts to the places' calm ones, over the slices' own."""
    mean = np.where(calm, N, 0).sum(0) / np.maximum(calm.sum(0), 1)
    full = mean >= FULL
    told = np.array([
        np.median(n[s & full] / mean[s & full]) if (s & full).any() else 1.0
        for n, s in zip(N, seen, strict=True)
    ])  # fmt: skip
    return np.clip(told / max(float(np.median(told)), 1e-9), 0.1, 10)
