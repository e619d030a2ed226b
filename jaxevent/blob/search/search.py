"""Targets of a recording, found without settings.

The background is measured, then the scale at which blobs predict the next events best is chosen and
targets are followed at that scale. What is near them is taken away, and all is done again for what
remains, so that slow and fast targets are found in one recording.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.search.background import Background, evidence, measure_background
from jaxevent.blob.search.detection import CONTACT, Scale, touching
from jaxevent.blob.search.found import Found, Pass
from jaxevent.blob.search.lamps import without_lamps
from jaxevent.blob.search.links import Links
from jaxevent.blob.search.moving import find_moving_background, goes_own_way, is_full, pauses
from jaxevent.blob.search.parts import join_parts
from jaxevent.blob.search.paths import Path
from jaxevent.blob.search.polarity import prefer_sharper
from jaxevent.blob.search.scale import Choice, choose_scale
from jaxevent.blob.search.stream import Stream
from jaxevent.blob.search.targets import FAINT, GATE, HOLD, REACH, SEEN, larger
from jaxevent.blob.search.turning import join_turning
from jaxevent.blob.seeds import tracking_span
from jaxevent.progress import stage
from jaxevent.recording import Recording

PASSES = 4
WORTH = 0.05  # nats per event from which a pass is worth it
WORTH_MOVING = 0.1  # and before a scene that moves, whose map is less exact
FEWEST = 100  # events of a recording that is looked at
ONE_PIXEL = 0.5  # px: what is smaller is a pixel, no blob
SHORT, ERRATIC = 16, 0.4  # windows, and sizes by which what is seen in fewer leaves its way in one
FILL = 0.5  # share of its windows in which a target was seen
JOINS = 1.5  # ellipses' distances, as `touching`, of a target's end and its new beginning
PAUSE = 4 * HOLD  # windows between them at most; or, at rest,
LAST = 8  # windows that tell how fast it went
REST = 2.0  # times the life of the shorter of both
LEAP = 2 * GATE * REACH  # sizes: what is farther from its way is not the target
PART = 0.8  # of its usual size and events: a target that is seen whole has more
EDGE = 2.0  # sizes from the sensor's edge, where others come and go
SAME = 0.5  # share of a target's life near one of an earlier pass that makes it a part of that


def find(
    recording: Recording,
    start: int | float | None = None,
    stop: int | float | None = None,
    *,
    progress: bool | None = None,
) -> Found:
    """Find the targets of a recording, without settings.

    Args:
        recording: Events; frames are not needed.
        start: Events are used from there, by default all. Integers are us, floats s.
        stop: And before this.
        progress: Whether a bar is shown; None: where somebody looks on.

    Raises:
        InputError: There is no time between `start` and `stop`.
    """
    stream = Stream(recording, *tracking_span(recording, start, stop))
    if len(stream) < FEWEST:
        return Found((), (), 0, 0.0, recording)
    found: list[Path] = []
    passes: list[Pass] = []
    hot, events = np.zeros((stream.height, stream.width), bool), 0.0
    moves = full = False
    parts = _parts(stream, progress)
    for one in parts:
        new, done = _search(one, progress)
        found += new
        passes += done
        hot |= one.stream.hot
        events += one.background.mean * stream.width * stream.height * one.stream.duration
        moves |= one.background.scene is not None
        full |= is_full(one.background)
    if len(parts) > 1:
        found = _stitch(found, (stream.width, stream.height))
    found, lamps = without_lamps(found, recording, hot)
    found = prefer_sharper(found, recording, hot)
    found.sort(key=lambda path: (path.begin, path.p[0].tolist()))
    rate = events / stream.duration
    number = int(hot.sum())
    return Found(tuple(found), tuple(passes), number, rate, recording, moves, lamps, full)


class _Part(NamedTuple):
    """Events that are searched at once, and what the search begins with."""

    stream: Stream
    background: Background
    choice: Choice | None


def _parts(stream: Stream, progress: bool | None) -> list[_Part]:
    """The whole; or, of a camera that moves at times, each of its pauses and what is between."""
    with stage("find: background", progress):
        background = measure_background(stream)
    spans = pauses(background)
    if len(spans) > 1:
        parts = [stream.part(*span) for span in spans]
        parts = [
            _prepared(one, measure_background(one), progress) for one in parts if len(one) >= FEWEST
        ]
        if any(one.background.scene is not None for one in parts):
            return parts
    return [_prepared(stream, background, progress)]


def _prepared(stream: Stream, background: Background, progress: bool | None) -> _Part:
    with stage("find: scale", progress):
        choice = choose_scale(stream, background)
    if choice is not None:
        with stage("find: the scene's motion", progress):
            moving = find_moving_background(stream, background, choice)
        if moving is not None:
            background, choice = moving, choose_scale(stream, moving)
    return _Part(stream, background, choice)


def _search(part: _Part, progress: bool | None) -> tuple[list[Path], list[Pass]]:
    """Paths and passes against a background; the choice is that of the first pass."""
    stream, background, choice = part
    found: list[Path] = []
    passes: list[Pass] = []
    worth = WORTH if background.scene is None else WORTH_MOVING
    for number in range(PASSES):
        if number:
            with stage(f"find, pass {number + 1}: scale", progress):
                choice = choose_scale(stream, background, worth)
        if choice is None or choice.score < worth:
            break
        confirmed = Links(stream, background, choice.scale).follow(
            f"find, pass {number + 1}", progress
        )
        if not confirmed:
            passes.append(Pass(choice, 0))
            break
        with stage(f"find, pass {number + 1}: beginnings", progress):
            settled = [_settled(path) for path in confirmed]
            rest = stream.without(confirmed, GATE, max(path.begin for path in settled))
            whole = [_look_back(path, rest, background, choice.scale) for path in settled]
        near = whole = join_parts(whole)
        if background.scene is not None:
            whole = [one for one in whole if goes_own_way(one, background.scene, stream.start)]
        lasting = [one for one in whole if _lasting(one, stream.duration)]
        new = _stitch(lasting, (stream.width, stream.height))
        new = [one for one in new if not _left_over(one, found)]
        passes.append(Pass(choice, len(new)))
        found += new
        stitched = [one for one in new if all(one is not other for other in near)]
        stream = stream.without([*near, *stitched], 2 * GATE)
    with stage("find: what turns in its place", progress):
        return join_turning(found, part.stream, background), passes


def _lasting(path: Path, duration: float | int) -> bool:
    """Whether it is larger than a pixel and was seen in enough of its windows.

    What is seen in few of those of the recording, of `duration` s, goes on as it goes: parts of a
    flicker are here and there.
    """
    window, seen = path.window * 1e-6, len(path.t)
    size = np.median(np.trace(path.C, axis1=1, axis2=2))
    leaves = path.agility * window**3 / 3
    short = seen < min(SHORT, FILL * duration / window)
    if short and leaves > (ERRATIC * np.median(path.size[:, 0])) ** 2:
        return False
    windows = (path.t[-1] - path.t[0]) / path.window + 1
    return bool(size > 2 * ONE_PIXEL**2 and seen >= FILL * windows)


def _settled(path: Path) -> Path:
    """The path from where it leaps no more: a new target may be where it is not yet known.

    What comes after tells where each row was expected.
    """
    for k in range(min(LAST, len(path.t) - 2))[::-1]:
        later = slice(k + 1, k + 1 + LAST)
        before = path.p[k + 1] - _speed(path, later) * (path.t[k + 1] - path.t[k]) * 1e-6
        if np.hypot(*(path.p[k] - before)) > LEAP * np.median(path.size[later, 0]):
            return _rows(path, slice(k + 1, None))
    return path


def _rows(path: Path, which: slice | NDArray) -> Path:
    """Some rows of a path."""
    cut = {name: getattr(path, name)[which] for name in ("t", "p", "v", "C", "n")}
    return dataclasses.replace(path, **cut)


def _look_back(path: Path, rest: Stream, background: Background, scale: Scale) -> Path:
    """The path with what was before its beginning: the same look at one place, backwards in time.

    `rest` are the events that belong to nobody.
    """
    first = min(8, len(path.t))
    if first < 3:
        return path
    w, times = scale.window, (path.t[:first] - rest.start) * 1e-6
    v, p = np.polyfit(times - times[0], path.p[:first], 1)
    C, usual = path.C[:first].mean(0), float(np.median(path.n[:first]))
    spread = C + np.eye(2) * (0.1 + np.trace(C) / 2 / max(usual, 1))
    t, silent, rows, farthest = float(times[0]), 0, [], (GATE * REACH) ** 2 * larger(C[None])[0]
    while silent < HOLD and t - 1.5 * w > 0:
        t, p = t - w, p - v * w
        if not (0 <= p[0] < rest.width and 0 <= p[1] < rest.height):
            break
        part = rest.window(t - w / 2, t + w / 2)
        e = np.stack([part.x - p[0], part.y - p[1]], 1) - v * (part.t - t)[:, None]
        S = spread * (1 + 0.2 * silent)
        near = np.einsum("ni,ij,nj->n", e, np.linalg.inv(S), e) < GATE**2
        n = int(near.sum())
        area = np.pi * GATE**2 * np.sqrt(np.linalg.det(S))
        mu = max(float(background.at(p[0], p[1], t, 3 * scale.cell)) * w * area, 1e-3)
        F = scale.dispersion_at(*background.place(p[0], p[1], t))
        if n < 2 or n < FAINT * usual or evidence(n, mu, F) < -np.log(SEEN):
            silent += 1
            continue
        z = e[near].mean(0)
        if z @ z > farthest:
            silent += 1
            continue
        p, v, silent = p + 0.5 * z, v - 0.15 * z / w / (1 + silent), 0
        rows.append((t, p, v, n))
    if not rows:
        return path
    t, p, v, n = (np.array(values) for values in zip(*rows[::-1], strict=True))
    us = rest.start + np.rint(t * 1e6).astype(np.int64)
    C = np.broadcast_to(C, (len(rows), 2, 2))
    before = dataclasses.replace(path, t=us, p=p, v=v, C=C, n=n.astype(float))
    return _after(before, path)


def _after(one: Path, other: Path) -> Path:
    """Two paths, one after the other, as one."""
    pairs = {name: (getattr(one, name), getattr(other, name)) for name in ("t", "p", "v", "C", "n")}
    return dataclasses.replace(one, **{name: np.concatenate(pair) for name, pair in pairs.items()})


def _stitch(paths: list[Path], size: tuple[int, int]) -> list[Path]:
    """Join a path to a later one that begins where it ended: at rest or carried on."""
    paths, done = sorted(paths, key=lambda path: path.begin), []
    while paths:
        one = paths.pop(0)
        while True:
            following = [(_gap(one, other, size), k) for k, other in enumerate(paths)]
            distance, k = min(following, default=(np.inf, -1))
            if distance >= JOINS:
                break
            one = _after(one, _later(one, paths.pop(k)))
        done.append(one)
    return done


def _gap(one: Path, other: Path, size: tuple[int, int]) -> float:
    """How far a path's beginning is from another's end, as `touching`; inf: not in time."""
    other = _later(one, other)
    pause = int(other.t[0] - one.t[-1])
    shorter = min(one.end - one.begin, other.end - other.begin)
    if one.window != other.window or not 0 < pause <= max(
        min(PAUSE * one.window, 2 * REST * shorter), REST * shorter
    ):
        return np.inf
    margin = EDGE * max(one.size[-1, 0], other.size[0, 0])
    at_edge = (one.p[-1] < margin) | (one.p[-1] > np.array(size) - 1 - margin)
    if at_edge.any() and pause > 2 * one.window:
        return np.inf
    ends = [(one.p[-1], other.p[0])]
    if pause <= PAUSE * one.window:
        # In the middle between both: so a bend does not matter.
        half = pause * 0.5e-6
        before, after = _speed(one, slice(-LAST, None)), _speed(other, slice(0, LAST))
        ends += [(one.p[-1] + 2 * half * before, other.p[0])]
        ends += [(one.p[-1] + half * before, other.p[0] - half * after)]
        # Where it goes behind something and comes out it is seen in part.
        last, first = _whole(one)[-1], _whole(other)[0]
        half = (other.t[first] - one.t[last]) * 0.5e-6
        before = _speed(one, slice(max(last - LAST, 0), last + 1))
        after = _speed(other, slice(first, first + LAST + 1))
        ends += [(one.p[last] + half * before, other.p[first] - half * after)]
    C = [np.median(path.C, 0) for path in (one, other)]
    return min(float(touching(p, C[0], q, C[1])) for p, q in ends)


def _whole(path: Path) -> NDArray[np.int64]:
    """Rows in which it has most of its usual size and events; all, where none has both."""
    size = path.size[:, 0]
    told = (path.n >= PART * np.median(path.n)) & (size >= PART * np.median(size))
    return np.flatnonzero(told) if told.any() else np.arange(len(size))


def _later(one: Path, other: Path) -> Path:
    """Another path without rows before one's end, where a look back may have gone; if most stay."""
    rest = other.t > one.t[-1]
    if rest.mean() < FILL:
        return other
    return _rows(other, rest)


def _speed(path: Path, rows: slice) -> NDArray[np.float64]:
    """px/s over some rows."""
    t, p = path.t[rows] * 1e-6, path.p[rows]
    return np.polyfit(t - t[0], p, 1)[0] if len(t) > 2 else np.zeros(2)


def _left_over(path: Path, found: list[Path]) -> bool:
    """Whether it was for long near a target of an earlier pass."""
    for other in found:
        inside = (path.t > other.begin - 2 * other.window) & (path.t < other.end + 2 * other.window)
        row = np.clip(np.searchsorted(other.t, path.t), 0, len(other.t) - 1)
        apart = touching(path.p, path.C, other.at(path.t), other.C[row])
        if (inside & (apart < 1.5 * CONTACT)).mean() >= SAME:
            return True
    return False
