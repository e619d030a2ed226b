"""Paths that belong to one object: parts of it, its life before and after a pause, turning pieces.

What is in contact with an object all its life and goes along with it is a part of it. Targets that
meet or cross come from apart, and those that stand side by side do not go anywhere. What turns
about each other by a whole turn at one distance, as blades of a propeller do, is rigid.

An object that turns in its place fills a place that is never dark, and all its events show about
which point it turns. Velocities of its pieces give roughly the rate: pieces slide along edges, and
the rate comes out up to twice too small. Events aligned window by window in polar coordinates give
it to 0.1 %. It is one object if a map that turns so predicts its events better than one at rest,
and if what is bright in that map is connected: birds that circle alike turn as well, but are apart.
"""

import copy
import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from jaxevent.blob.search.background import (
    FINE_CELL_PX,
    N_TIME_SLICES,
    Background,
    SceneMotion,
    clutter_evidence,
    look_up,
)
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import larger_variance
from jaxevent.blob.search.own_frame import OwnFrame, differ
from jaxevent.blob.search.paths import (
    TargetPath,
    fit_velocity_noise,
    interpolate_path,
    log_likelihood,
    merge_paths,
)
from jaxevent.blob.search.scene import BLUR_SIGMAS_BINS, map_gain, measure_moving_background
from jaxevent.blob.search.stream import Stream, WindowEvents

N_ANGLE_BINS = 256  # bins of a turn


def merge_parts(paths: list[TargetPath], frame: OwnFrame | None = None) -> list[TargetPath]:
    """Merge paths that are parts of one object.

    Args:
        paths: Paths of targets, all seen in the same windows.
        frame: Their events, which show pieces of outlines; None: only the paths are compared.
    """
    paths = sorted(paths, key=lambda path: path.n.sum(), reverse=True)
    balances: list[float] = []  # of each path, once they are asked for
    # The whole may be in contact with what none of its parts was.
    while (found := _first_whole(paths, balances, frame)) is not None:
        k, i, whole = found
        if balances:
            n = [paths[j].n.sum() for j in (k, i)]
            balances[k] = float(np.average([balances[k], balances.pop(i)], weights=n))
        paths[k] = whole
        del paths[i]
    return paths


def _first_whole(
    paths: list[TargetPath], balances: list[float], frame: OwnFrame | None
) -> tuple[int, int, TargetPath] | None:
    """Return the indices of the first two paths that are parts of one object, and its path.

    `balances` are filled in when they are needed.
    """
    for k, i in itertools.combinations(range(len(paths)), 2):
        are_parts, may_be_pieces = _compare(paths[k], paths[i])
        if are_parts:
            return k, i, merge_paths(paths[k], paths[i])
        if not (may_be_pieces and frame):
            continue
        if not balances:
            balances += frame.balances(paths)
        if differ(balances[k], balances[i]):
            others = [path for j, path in enumerate(paths) if j not in (k, i)]
            whole = frame.whole(paths[k], paths[i], others)
            if whole is not None:
                return k, i, whole
    return None


def _compare(one: TargetPath, other: TargetPath) -> tuple[bool, bool]:
    """Return whether two paths are those of parts of one object, and whether they may be pieces.

    Pieces are those of an outline that windows do not show as one.
    """
    share, contact = CONFIG.nearly_all, CONFIG.contact_distance
    begin, end = max(one.begin, other.begin), min(one.end, other.end)
    if end - begin < share * min(one.end - one.begin, other.end - other.begin):
        return False, False
    t = np.union1d(one.t, other.t)
    t = t[(t >= begin) & (t < end)]
    both = [interpolate_path(path, t) for path in (one, other)]
    p, q = both[0].p, both[1].p
    apart = np.hypot(*(p - q).T)
    sizes = np.stack([path.size[:, 0] for path in both])
    nearest, farthest = np.quantile(apart, (0.02, 0.98))
    # Parts that are beside each other for long are never in one place, as targets that pass are.
    short = min(float(np.median(path.size[:, 1])) for path in both)
    beside = np.quantile(apart / sizes.sum(0), 1 - CONFIG.considerable) > 1
    if beside and nearest < contact * short:
        return False, False
    edge = _is_edge(one, other) or _is_edge(other, one)
    small, large = np.sort(np.median(sizes, 1))
    reach = float(np.quantile(apart / sizes.sum(0), share))
    touch = reach < (1.5 * contact if edge else contact)
    if not touch and _turn_together(p, q, 2 * contact * float(np.median(sizes.sum(0)))):
        return True, False
    # Pieces slide along an edge, but less far than they go with it.
    far = min(float(np.ptp(path, axis=0).max()) for path in (p, q))
    far *= (end - begin) / max(t[-1] - t[0], 1)  # of all of its windows
    together = far > CONFIG.common_way_sizes * small
    together &= bool(farthest - nearest < max(large, far if edge else far / 2))
    if touch and together and (edge or _separate_nats(both) <= CONFIG.log_bayes_factor):
        return True, False
    within = np.quantile(apart / sizes.max(0), share) < contact
    near = together and reach < CONFIG.gate_sigmas * contact
    return False, bool(within or near)


def _separate_nats(rows: list[TargetPath]) -> float:
    """Compute nats for two objects against a rigid one, of paths at the same times.

    The difference of a rigid object's parts stays, or their distance where it turns, which is less
    likely beforehand; they slide along edges by a share of the way. The velocity of two objects
    relative to each other is as large as their own velocities, and changes as much.
    """
    rows = [path.take(slice(None, None, -(-len(path.t) // N_TIME_SLICES))) for path in rows]
    slide = CONFIG.slide_share
    R = sum(larger_variance(path.C) * (1 / np.maximum(path.n, 2) + slide**2) for path in rows)
    t, d = rows[0].t * 1e-6, rows[1].p - rows[0].p
    v = np.concatenate([path.v for path in rows], 1)
    velocity, noise = (v[0] ** 2).sum() / 2, (np.diff(v, axis=0) ** 2).sum(1) / 2 / np.diff(t)

    def rigid_nats(z: NDArray, slide: float) -> float:
        squares = slide**2, 1.0
        one, two = (log_likelihood(t, z, R, s * velocity, s * noise) for s in squares)
        return one - two

    turn = rigid_nats(np.hypot(*d.T)[:, None], slide / 3) - CONFIG.log_bayes_factor
    return -max(rigid_nats(d, slide), turn)


def _is_edge(one: TargetPath, other: TargetPath) -> bool:
    """Return whether one is long across its way, or along it with far more events than the other.

    Edges along the motion send few events: two that are long along it may follow each other.
    """
    long = np.median(one.size[:, 0] / one.size[:, 1]) > CONFIG.edge_aspect
    few = np.median(other.n) < CONFIG.considerable * np.median(one.n)
    return bool(long and (one.is_across_way or few))


def _turn_together(p: NDArray, q: NDArray, reach: float | int) -> bool:
    """Return whether two ways (rows, 2) px turn about each other by a whole turn, rigidly."""
    apart = np.hypot(*(p - q).T)
    share = CONFIG.nearly_all
    low, middle, high = np.quantile(apart, (1 - share, 0.5, share))
    if high > reach or high - low > CONFIG.slide_share * middle:
        return False
    turned = np.unwrap(np.arctan2(*(p - q).T))
    return bool(abs(turned[-1] - turned[0]) > 2 * np.pi)


def stitch_paths(
    paths: list[TargetPath], size: tuple[int, int], windows: float | int
) -> list[TargetPath]:
    """Join each path to a later one that is likelier its continuation than a new target.

    Args:
        paths: Paths of targets.
        size: Width and height of the sensor, px.
        windows: Windows of the recording.
    """
    paths, done = sorted(paths, key=lambda path: path.begin), []
    while paths:
        one = paths.pop(0)
        while True:
            nats = [
                (_continuation_evidence(one, two, size, windows), k) for k, two in enumerate(paths)
            ]
            most, k = max(nats, default=(-np.inf, -1))
            if most < CONFIG.log_bayes_factor:
                break
            one = one.followed_by(paths.pop(k))
        done.append(one)
    return done


def _continuation_evidence(
    one: TargetPath, other: TargetPath, size: tuple[int, int], windows: float | int
) -> float:
    """Compute nats for a path's beginning as another one's continuation, against a new target."""
    pause = int(other.t[0] - one.t[-1])
    if one.window != other.window or pause <= 0:
        return -np.inf
    rows, gap = CONFIG.min_windows, pause / one.window
    square = float(np.mean([np.median(larger_variance(path.C)) for path in (one, other)]))
    few = min(float(np.median(path.n)) for path in (one, other))
    whole = [_whole_rows(path) for path in (one, other)]
    nats = -np.inf
    # At rest, or carried on to the middle of the pause, so that a bend does not matter. Where it
    # goes behind something and comes out it is seen in part.
    for last, first in ((len(one.t) - 1, 0), (whole[0][-1], whole[1][0])):
        before = one.mean_velocity(slice(max(last - rows, 0), last + 1))
        after = other.mean_velocity(slice(first, first + rows + 1))
        half = (other.t[first] - one.t[last]) * 0.5e-6
        e = other.p[first] - half * after - one.p[last] - half * before
        # Velocities of both ends, each from means of so many windows.
        wide = square * (1 + 6 * gap**2 / rows**3 * (1 / few + CONFIG.mean_error_sizes**2))
        nats = max(nats, -e @ e / 2 / wide - np.log(2 * np.pi * wide))
    e = other.p[0] - one.p[-1]
    nats = max(nats, -e @ e / 2 / square - np.log(2 * np.pi * square))
    for spread, values in (
        (CONFIG.rate_change, [np.median(path.n) for path in (one, other)]),
        (CONFIG.area_change, [np.median(path.size.prod(1)) for path in (one, other)]),
    ):
        change = np.log(values[1] / values[0])
        nats -= change**2 / 2 / spread**2 + 0.5 * np.log(2 * np.pi * spread**2)
    inside = min(
        _inside_share(one.p[-1], one.C[-1], size), _inside_share(other.p[0], other.C[0], size)
    )
    nats += gap * np.log(1 - CONFIG.resume_probability) + (gap - 1) * np.log(max(inside, 1e-9))
    return float(nats + np.log(size[0] * size[1] * windows * CONFIG.new_target_volume))


def _inside_share(p: NDArray, C: NDArray, size: tuple[int, int]) -> float:
    """Return about the share of a target inside the sensor."""
    away = np.minimum(p + 0.5, np.array(size) - 0.5 - p) / np.sqrt(np.diagonal(C))
    return float(np.clip(0.5 + 0.4 * away, 0, 1).prod())


def _whole_rows(path: TargetPath) -> NDArray[np.int64]:
    """Return rows with most of the usual size and events; all, where none has both."""
    size, share = path.size[:, 0], CONFIG.nearly_all
    whole = (path.n >= share * np.median(path.n)) & (size >= share * np.median(size))
    return np.flatnonzero(whole) if whole.any() else np.arange(len(size))


class Turn(NamedTuple):
    """A rotation in the image: rad/s, from x to y, about a point (px)."""

    rate: float
    centre: NDArray[np.float64]


def merge_turning(
    paths: list[TargetPath], stream: Stream, background: Background
) -> list[TargetPath]:
    """Merge the paths of pieces of each object that turns in its place.

    Args:
        paths: Paths of targets.
        stream: All events.
        background: Background of the stream; before a moving scene nothing is merged.
    """
    if not paths or background.scene is not None:
        return paths
    bright = background.rate > CONFIG.bright_ratio * np.median(background.rate)
    places = np.zeros(bright.shape, np.int32)
    ndimage.label(bright, np.ones((3, 3)), places)
    out = list(paths)
    for place in range(1, int(places.max()) + 1):
        there = places == place
        pieces = [
            path
            for path in out
            if look_up(there, FINE_CELL_PX, *path.p.T).mean() >= CONFIG.nearly_all
        ]
        # An object is seen whole, not at many sides of the sensor.
        sides = sum(bool(s.any()) for s in (there[0], there[-1], there[:, 0], there[:, -1]))
        if not pieces or sides > CONFIG.majority * 4 or len(pieces) < 2:
            continue
        whole = _turning_path(pieces, _events_within(stream, there), background)
        if whole is not None:
            out = [path for path in out if all(path is not piece for piece in pieces)]
            out.append(whole)
    return out


def _events_within(stream: Stream, there: NDArray[np.bool_]) -> Stream:
    """Return the events inside some fine cells."""
    own, fine = copy.copy(stream), np.ones((FINE_CELL_PX, FINE_CELL_PX), bool)
    own.hot = stream.hot | ~np.kron(there, fine)[: stream.height, : stream.width]
    return own


def _turning_path(
    pieces: list[TargetPath], own: Stream, background: Background
) -> TargetPath | None:
    """Return the path of the object of some pieces; None if it is not one that turns."""
    centre = _centre_of_turn(own)
    window = max(pieces, key=lambda path: path.n.sum()).window
    scene = _measure_turn(own, Turn(_rate_of_pieces(pieces, centre), centre), window * 1e-6)
    moving = measure_moving_background(own, scene)
    if not _is_connected(moving, centre) or map_gain(own, moving, window * 1e-6) < CONFIG.min_gain:
        return None
    angles = np.unwrap(np.arctan2(scene.maps[:, 1, 0], scene.maps[:, 0, 0]))
    rate = float((angles[-1] - angles[0]) / (scene.t[-1] - scene.t[0]))
    path = _path_of_all(own, centre, window, background.min_rate)
    return None if path is None else dataclasses.replace(path, turn_rate=rate)


def _centre_of_turn(own: Stream) -> NDArray[np.float64]:
    """Return the point (px) about which the events are most symmetric.

    What turns in its place leaves equal events on both sides of its centre. The centre is half of
    where the convolution of the roots of counts with themselves is largest.
    """
    pixels = own.pixel_counts(0, own.duration)
    image = np.zeros((2 * own.height, 2 * own.width))
    image[pixels.y, pixels.x] = np.sqrt(pixels.n)
    convolved = np.fft.irfft2(np.fft.rfft2(image) ** 2, image.shape)
    y, x = np.unravel_index(convolved.argmax(), convolved.shape)
    return np.array([x, y]) / 2


def _rate_of_pieces(pieces: list[TargetPath], centre: NDArray[np.float64]) -> float:
    """Return the rate (rad/s) of pieces about a point, their median by squared distance."""
    (x, y), v = (np.concatenate([getattr(path, name) for path in pieces]).T for name in "pv")
    x, y = x - centre[0], y - centre[1]
    square = np.maximum(x * x + y * y, 1e-9)
    rate = (x * v[1] - y * v[0]) / square
    order = np.argsort(rate)
    total = np.cumsum(square[order])
    return float(rate[order][np.searchsorted(total, total[-1] / 2)])


def _measure_turn(own: Stream, turn: Turn, window: float) -> SceneMotion:
    """Measure the turn window by window (s), where events correlate most with those before.

    Each angle is sought about the one that `turn` leads to, as far as the turn of a window: the
    rate of pieces is up to twice too small.
    """
    number = int(own.duration / window)
    whole = own.pixel_counts(0, own.duration)
    far = np.hypot(whole.x - turn.centre[0], whole.y - turn.centre[1])
    rings = int(np.quantile(far, CONFIG.nearly_all, method="lower") / FINE_CELL_PX) + 1
    order = 1j * np.arange(N_ANGLE_BINS // 2 + 1)
    step = turn.rate * window
    reach = max(2, int(abs(step) / (2 * np.pi) * N_ANGLE_BINS))
    reach = min(reach, N_ANGLE_BINS // 2 - 1)
    near = np.arange(-reach, reach + 1)

    def spectrum(k: int) -> NDArray[np.complex128]:
        part = own.window(k * window, (k + 1) * window)
        return _ring_spectrum(part, turn, (k + 0.5) * window, rings)

    angles, seen = [0.0], spectrum(0)
    for k in range(1, number):
        now = spectrum(k)
        expected = angles[-1] + step
        correlation = np.fft.irfft(
            (now * seen.conj()).sum(0) * np.exp(order * expected), N_ANGLE_BINS
        )
        best = int(near[np.argmax(correlation[near])])
        before, peak, after = (correlation[i % N_ANGLE_BINS] for i in (best - 1, best, best + 1))
        bend = before - 2 * peak + after
        top = best + (0.5 * (before - after) / bend if bend < 0 else 0.0)
        angles.append(expected + top * 2 * np.pi / N_ANGLE_BINS)
        gain = max(CONFIG.reference_gain, 1 / (k + 1))
        seen = (1 - gain) * seen + gain * now * np.exp(order * angles[-1])
    c, s = np.cos(angles), np.sin(angles)
    A = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)
    maps = np.concatenate([A, (turn.centre - A @ turn.centre)[..., None]], 2)
    t = np.asarray((np.arange(number) + 0.5) * window, np.float64)
    return SceneMotion(t, maps)


def _ring_spectrum(part: WindowEvents, turn: Turn, t: float, rings: int) -> NDArray[np.complex128]:
    """Transform roots of counts in rings and angles about a point to (rings, frequencies).

    Events are carried to a time t (s) as they turn.
    """
    dx, dy = part.x - turn.centre[0], part.y - turn.centre[1]
    angle = (np.arctan2(dy, dx) - turn.rate * (part.t - t)) / (2 * np.pi) % 1
    ring = (np.hypot(dx, dy) / FINE_CELL_PX).astype(np.int64)
    place = ring * N_ANGLE_BINS + (angle * N_ANGLE_BINS).astype(np.int64) % N_ANGLE_BINS
    size = rings * N_ANGLE_BINS
    counts = np.bincount(place[place < size], minlength=size).reshape(-1, N_ANGLE_BINS)
    image = ndimage.gaussian_filter1d(np.sqrt(counts), BLUR_SIGMAS_BINS[-1], axis=1, mode="wrap")
    return np.fft.rfft(image - image.mean(1, keepdims=True))


def _is_connected(moving: Background, centre: NDArray[np.float64]) -> bool:
    """Return whether what is bright in a turning map is connected, about the point of the turn."""
    rate = np.where(moving.visible, moving.rate - moving.rate.min(), 0)
    total = float(rate.sum())
    labels = np.zeros(rate.shape, np.int32)
    bright = rate * total > CONFIG.connected_rate * (rate**2).sum()
    ndimage.label(bright, np.ones((3, 3)), labels)
    mass = np.bincount(labels.ravel(), rate.ravel())
    if len(mass) < 2 or mass[1:].max() < CONFIG.connected_share * total:
        return False
    y, x = np.nonzero(labels == 1 + mass[1:].argmax())
    places = (np.stack([x, y], 1) + 0.5) * FINE_CELL_PX + moving.corner
    n = rate[y, x]
    away = np.average(places, 0, n) - centre
    C = np.cov(places.T, aweights=n) + np.eye(2)
    return bool(away @ np.linalg.solve(C, away) < 1)


def _path_of_all(
    own: Stream, centre: NDArray[np.float64], window: int, min_rate: float
) -> TargetPath | None:
    """Return the path of all events of an object that stays about a place.

    It has the windows (us) with more events than a background of `min_rate` (1/(px s)) gives; None
    if none has.
    """
    w, rows = window * 1e-6, []
    area = own.width * own.height - int(own.hot.sum())
    for k in range(int(own.duration / w)):
        part = own.window(k * w, (k + 1) * w)
        if clutter_evidence(len(part), min_rate * area * w, 1) > -np.log(CONFIG.false_alarm_known):
            e = np.stack([part.x, part.y], 1) - centre
            rows.append(((k + 0.5) * w, e.mean(0), e.T @ e / len(e) + np.eye(2) / 12, len(e)))
    if not rows:
        return None
    t, m, C, n = (np.array(values, float) for values in zip(*rows, strict=True))
    R = larger_variance(C) / 2 / n
    us = own.start + np.rint(t * 1e6).astype(np.int64)
    noise = fit_velocity_noise(t, m, R, float(np.median(larger_variance(C))) / w**3)
    p = np.tile(centre, (len(t), 1))
    return TargetPath(us, p, np.zeros_like(p), C, n, window, noise)
