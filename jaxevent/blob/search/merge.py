"""Paths that belong to one object: parts of it, its life before and after a pause, turning pieces.

What is in contact with an object all its life and goes along with it is a part of it. Targets that
meet or cross come from apart, and those that stand side by side do not go anywhere. What turns
about each other by a whole turn at one distance, as blades of a propeller do, is rigid.

The edge that goes ahead of an object and the one that follows change the light in opposite ways:
what is left behind is as bright as what was there before. So a target whose events are nearly all
of one polarity may be a piece, and its object has the events of the other polarity too. Where few
events come from each pixel of an outline, a window shows pieces of it. Events of all windows, at
their places relative to a common path, as an observer sees them who goes along, show whether and
where an outline connects the pieces.

An object that turns in its place fills a place that is never dark. Its events are a scene that
turns, and are aligned window by window like one before a moving camera. It is one object if a map
that turns so predicts its events better than one at rest, and if what is bright in that map is
connected: birds that circle alike turn as well, but are apart.
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
    clutter_evidence,
    look_up,
)
from jaxevent.blob.search.config import CONFIG
from jaxevent.blob.search.detection import (
    Scale,
    clutter_model,
    detect,
    larger_variance,
    measure_blobs,
)
from jaxevent.blob.search.paths import (
    TargetPath,
    fit_velocity_noise,
    interpolate_path,
    log_likelihood,
    merge_paths,
    tabulate_paths,
)
from jaxevent.blob.search.scene import (
    map_gain,
    measure_moving_background,
    measure_scene_motion,
)
from jaxevent.blob.search.stream import Stream, WindowEvents


class OwnFrame(NamedTuple):
    """Events in the frames of their targets, which are all seen in windows of one length."""

    stream: Stream
    background: Background  # at rest
    scale: Scale  # windows and cells in which the targets were seen

    def measure_balances(self, paths: list[TargetPath]) -> list[TargetPath]:
        """Return paths with the balances of their events' polarities."""
        sums = np.zeros((2, len(paths) + 1))
        for part, owner in self.stream.near(tabulate_paths(paths), CONFIG.gate_sigmas):
            owners, signs = owner[:, 0] + 1, np.where(part.p, 1, -1)
            sums += [np.bincount(owners, weights, len(sums[0])) for weights in (signs, signs**2)]
        balances = (sums[0] / np.maximum(sums[1], 1))[1:].tolist()
        pairs = zip(paths, balances, strict=True)
        return [dataclasses.replace(path, balance=balance) for path, balance in pairs]

    def whole(
        self, one: TargetPath, other: TargetPath, others: list[TargetPath]
    ) -> TargetPath | None:
        """Return the path of the object of which two paths are pieces.

        Args:
            one: Path of a piece.
            other: That of another piece.
            others: Paths of other targets, whose events connect nothing.

        Returns:
            A path with the place and shape of what connects the pieces; None if nothing does.
        """
        found = self._connect(one, other)
        if found is None or not others:  # to leave out events takes long
            return found
        stream = self.stream.without(others, CONFIG.gate_sigmas)
        return self._replace(stream=stream)._connect(one, other)

    def _connect(self, one: TargetPath, other: TargetPath) -> TargetPath | None:
        """Return the path of the part between two pieces, by all events of the stream."""
        rows = merge_paths(one, other)
        both = [interpolate_path(path, rows.t).p for path in (one, other)]
        # Means of several windows, for pieces slide along their outline.
        way = np.average(both, 0, [np.median(path.n) for path in (one, other)])
        width = min(CONFIG.min_windows, len(rows.t)) | 1
        way = ndimage.uniform_filter1d(way, width, axis=0, mode="nearest")
        size, shape = np.array(self.stream.shape[::-1]), self.stream.shape
        begin, end = ((at - self.stream.start) * 1e-6 for at in (rows.begin, rows.end))
        events, t = self.stream.window(begin, end), (rows.t - self.stream.start) * 1e-6
        x, y = (
            np.rint(xy - np.interp(events.t, t, along) + half).astype(np.int32)
            for xy, along, half in zip((events.x, events.y), way.T, size // 2, strict=True)
        )
        inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
        moved = WindowEvents(events.t[inside], x[inside], y[inside])
        # Cells no larger than the larger piece.
        large = max(float(np.median(path.size[:, 0])) for path in (one, other))
        cell = max(self.scale.cell, 2 ** int(np.log2(max(large, 1))))
        life = dataclasses.replace(self.scale, window=end - begin, cell=cell)
        clutter = clutter_model(self.background, life, shape, (begin + end) / 2)
        labels, number = detect(moved, clutter, shape)
        if number == 0:
            return None
        _, p, C = measure_blobs(moved, labels, number)
        places = np.stack([np.median(path - way, 0) for path in both]) + size // 2
        away = places[:, None] - p
        squared = np.einsum("kbi,bij,kbj->kb", away, np.linalg.inv(C), away).max(0)
        k = int(squared.argmin())
        # What is much larger than what the pieces span is something else that goes along.
        span = float(np.median(np.hypot(*(both[0] - both[1]).T))) / 2 + large
        if squared[k] >= CONFIG.contact_distance**2 or larger_variance(C)[k] > span**2:
            return None
        C = np.broadcast_to(C[k], rows.C.shape)
        return dataclasses.replace(rows, p=way + p[k] - size // 2, C=C)


def merge_parts(paths: list[TargetPath], frame: OwnFrame | None = None) -> list[TargetPath]:
    """Merge paths that are parts of one object.

    Args:
        paths: Paths of targets, all seen in the same windows.
        frame: Their events, which show pieces of outlines; None: only the paths are compared.
    """
    paths = frame.measure_balances(paths) if frame else paths
    paths = sorted(paths, key=lambda path: path.n.sum(), reverse=True)
    # The whole may be in contact with what none of its parts was.
    while (found := _first_whole(paths, frame)) is not None:
        k, i, whole = found
        paths[k] = whole
        del paths[i]
    return paths


def _first_whole(
    paths: list[TargetPath], frame: OwnFrame | None
) -> tuple[int, int, TargetPath] | None:
    """Return the indices of the first two paths that are parts of one object, and its path."""
    for k, i in itertools.combinations(range(len(paths)), 2):
        one, other = paths[k], paths[i]
        are_parts, may_be_pieces = _compare_paths(one, other)
        if are_parts:
            return k, i, merge_paths(one, other)
        # Different parts of an outline have different balances.
        if frame and may_be_pieces and abs(one.balance - other.balance) > CONFIG.majority:
            others = [path for path in paths if path is not one and path is not other]
            whole = frame.whole(one, other, others)
            if whole is not None:
                return k, i, whole
    return None


def _compare_paths(one: TargetPath, other: TargetPath) -> tuple[bool, bool]:
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
    """Return whether two paths turn about each other by a whole turn, rigidly.

    Args:
        p: (rows, 2) positions of one, px.
        q: (rows, 2) positions of the other at the same times, px.
        reach: Largest distance between them, px.

    Returns:
        Whether they do.
    """
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
    """Estimate the share of a target inside the sensor.

    Args:
        p: (2,) position, px.
        C: (2, 2) covariance of its events, px^2.
        size: Width and height of the sensor, px.

    Returns:
        Share, 0..1.
    """
    away = np.minimum(p + 0.5, np.array(size) - 0.5 - p) / np.sqrt(np.diagonal(C))
    return float(np.clip(0.5 + 0.4 * away, 0, 1).prod())


def _whole_rows(path: TargetPath) -> NDArray[np.int64]:
    """Return rows with most of the usual size and events; all, where none has both."""
    size, share = path.size[:, 0], CONFIG.nearly_all
    whole = (path.n >= share * np.median(path.n)) & (size >= share * np.median(size))
    return np.flatnonzero(whole) if whole.any() else np.arange(len(size))


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
        inside = [look_up(there, FINE_CELL_PX, *path.p.T).mean() for path in out]
        pieces = [path for path, n in zip(out, inside, strict=True) if n >= CONFIG.nearly_all]
        # An object is seen whole, not at many sides of the sensor.
        sides = sum(bool(s.any()) for s in (there[0], there[-1], there[:, 0], there[:, -1]))
        if len(pieces) < 2 or sides > CONFIG.majority * 4:
            continue
        whole = _turning_path(pieces, _events_within(stream, there), background)
        if whole is not None:
            out = [path for path in out if all(path is not piece for piece in pieces)]
            out.append(whole)
    return out


def _events_within(stream: Stream, there: NDArray[np.bool_]) -> Stream:
    """Return the events inside some fine cells.

    Args:
        stream: Events.
        there: (rows, columns) whether a cell of 4 px is chosen.

    Returns:
        A stream of them.
    """
    own, fine = copy.copy(stream), np.ones((FINE_CELL_PX, FINE_CELL_PX), bool)
    own.hot = stream.hot | ~np.kron(there, fine)[: stream.height, : stream.width]
    return own


def _turning_path(
    pieces: list[TargetPath], own: Stream, background: Background
) -> TargetPath | None:
    """Return the path of the object of some pieces; None if it is not one that turns.

    Pieces slide along edges: a turn explains a part of their motion, and hardly any of others'.
    """
    p, v = (np.concatenate([getattr(path, name) for path in pieces]) for name in "pv")
    p = p - p.mean(0)
    momentum, inertia = (p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]).sum(), (p**2).sum()
    if momentum**2 < (1 - CONFIG.nearly_all) * inertia * (v**2).sum():
        return None
    largest = max(pieces, key=lambda path: path.n.sum())
    w, begin = largest.window * 1e-6, max(largest.begin - own.start, 0) * 1e-6
    part = own.between(begin, min(begin + 2 * N_TIME_SLICES * w, own.duration))
    part.hot = own.hot
    scene = measure_scene_motion(part, w)
    # The point that stays in its place.
    turns, shifts = np.split(scene.maps, [2], -1)
    centre = np.linalg.lstsq((turns - np.eye(2)).reshape(-1, 2), -shifts.ravel())[0]
    centre = np.asarray(centre, np.float64)
    moving = measure_moving_background(part, scene)
    if not _is_connected(moving, centre) or map_gain(part, moving, w) < CONFIG.min_gain:
        return None
    angles = np.unwrap(np.arctan2(scene.maps[:, 1, 0], scene.maps[:, 0, 0]))
    rate = float((angles[-1] - angles[0]) / (scene.t[-1] - scene.t[0]))
    path = _path_of_all(own, centre, largest.window, background.min_rate)
    return None if path is None else dataclasses.replace(path, turn_rate=rate)


def _is_connected(moving: Background, centre: NDArray[np.float64]) -> bool:
    """Return whether the bright part of a turning map is connected, about the point of the turn.

    Args:
        moving: Background in the coordinates of the object.
        centre: (2,) point that the object turns about, px.

    Returns:
        Whether it is.
    """
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

    It has the windows with more events than the background gives.

    Args:
        own: Events of the object.
        centre: (2,) point that the object turns about, px.
        window: Length of windows, us.
        min_rate: Rate of the background, 1/(px s).

    Returns:
        The path; None if no window has more.
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
