"""Simulated scenes for trackers without settings: those of `blob_finding.py`.

`SCENES` has each kind of target once, on which the search was built, `VARIED` came later: other
sensors, outlines, bars, pairs of edges, one polarity only, targets that come and go, flicker, a
background that moves with the camera, very short and very long recordings, stars; `OBJECTS` are
rigid bodies, flocks, hands and targets that leave, `DISCS` outlines of few events, and `MEETINGS`
outlines that meet. Constants were chosen on seeds below 20, and of these three on seeds from 100
on. Each is called with a seed and gives the recording and its truth.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.recording import Events, Recording
from jaxevent.simulate.blobs import (
    ApproachMotion,
    BlobTruth,
    CircularMotion,
    LinearMotion,
    LissajousMotion,
    Target,
    blob_scene,
    simulate_blobs,
)

VGA, DAVIS, DVS, HD = (640, 480), (346, 260), (128, 128), (1280, 720)
Scene = Callable[[int], tuple[Recording, BlobTruth]]


@dataclasses.dataclass(frozen=True)
class Outline:
    """An outline that moves rigidly: events are where its edges cross pixels, |n . v| each.

    `corners` (corners, 2) px about the centre at theta = 0, in order. `motion` gives position and
    angle, its sizes are replaced by the deviations of the events. `rate` events/s in all. `share`
    of the edges' events follow |n . v|, the rest comes from all edges alike, as noise of their
    pixels does. With `open` the last corner is not joined to the first; corners of several
    segments are separated by NaN.
    """

    motion: LinearMotion | CircularMotion | LissajousMotion | ApproachMotion
    rate: float
    corners: NDArray[np.float64]
    share: float = 0.9
    polarity: bool | None = None  # of all events; None: of the edge's side

    @property
    def _segments(self) -> tuple[NDArray, NDArray]:
        a, b = self.corners[:-1], self.corners[1:]
        there = np.isfinite(a).all(1) & np.isfinite(b).all(1)
        return a[there], b[there]

    def _shares(self, t: NDArray) -> NDArray[np.float64]:
        """(times, segments): where events come from."""
        a, b = self._segments
        d = b - a
        state = self.motion.state(t)
        c, s = np.cos(state[:, 6])[:, None], np.sin(state[:, 6])[:, None]
        normal = -(s * d[:, 0] + c * d[:, 1]), c * d[:, 0] - s * d[:, 1]
        middle = (a + b) / 2
        x, y = c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]
        v = state[:, 2:4], state[:, 7:8]
        speed = abs(normal[0] * (v[0][:, :1] - v[1] * y) + normal[1] * (v[0][:, 1:] + v[1] * x))
        even = np.hypot(*d.T) / np.hypot(*d.T).sum()
        total = speed.sum(1, keepdims=True)
        return np.where(
            total > 0, self.share * speed / np.maximum(total, 1e-12) + (1 - self.share) * even, even
        )

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        state = self.motion.state(t)
        a, b = self._segments
        middle, half = (a + b) / 2, (b - a) / 2
        w = self._shares(t)
        mean = w @ middle
        squares = np.einsum("ts,sij->tij", w, np.einsum("si,sj->sij", middle, middle)
            + np.einsum("si,sj->sij", half, half) / 3)  # fmt: skip
        C = squares - np.einsum("ti,tj->tij", mean, mean)
        size = np.sqrt(np.maximum(np.linalg.eigvalsh(C)[:, ::-1], 0.01))
        c, s = np.cos(state[:, 6]), np.sin(state[:, 6])
        shift = np.stack([c * mean[:, 0] - s * mean[:, 1], s * mean[:, 0] + c * mean[:, 1]], 1)
        return np.concatenate([state[:, :2] + shift, state[:, 2:4], size, state[:, 6:]], 1)

    def visible(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.ones(t.shape, bool)

    def events(self, duration, rng):
        t = rng.uniform(0, duration, rng.poisson(self.rate * duration))
        a, b = self._segments
        total = np.cumsum(self._shares(t), 1)
        k = (rng.random(len(t))[:, None] > total / total[:, -1:]).sum(1)
        u = a[k] + rng.random(len(t))[:, None] * (b - a)[k] + rng.normal(size=(len(t), 2)) * 0.3
        state = self.motion.state(t)
        c, s = np.cos(state[:, 6]), np.sin(state[:, 6])
        turned = np.stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1]], 1)
        on = (turned * state[:, 2:4]).sum(1) > 0
        if self.polarity is not None:
            on[:] = self.polarity
        return t, state[:, :2] + turned, on


@dataclasses.dataclass(frozen=True)
class Path:
    """A smooth path through points (n, 2) px at times (n,) s, with sizes (px)."""

    t: ArrayLike
    points: NDArray[np.float64]
    size: tuple[float, float]
    spin: float = 0.0

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.interpolate import PchipInterpolator

        curve = PchipInterpolator(self.t, self.points)
        out = np.zeros((len(t), 8))
        now = np.clip(t, np.min(self.t), np.max(self.t))
        out[:, :2], out[:, 2:4] = curve(now), curve(now, 1)
        out[:, 4:6], out[:, 6], out[:, 7] = self.size, self.spin * t, self.spin
        return out


def drifting(
    count: int,
    rate: float,
    speed: float,
    size: float,
    duration: float,
    noise: float,
    seed: int,
    shape: str = "gaussian",
    frame: tuple[int, int] = VGA,
    **target,
) -> tuple[Recording, BlobTruth]:
    """Targets that circle with random phases, so that they stay on the sensor."""
    rng = np.random.default_rng([seed, count])
    targets = []
    columns = math.ceil(math.sqrt(count * 4 / 3))
    rows = math.ceil(count / columns)
    cell = np.array(frame) / (columns, rows)
    for k in range(count):
        centre = (np.array([k % columns, k // columns]) + 0.5) * cell
        radius = float(max(0.35 * cell.min() - size, 2.0))
        turn = speed / radius * rng.choice([-1, 1])
        motion = CircularMotion(
            tuple(centre), radius, turn, rng.uniform(0, 2 * np.pi), size=(size, 0.7 * size),
            theta=rng.uniform(0, np.pi),
        )  # fmt: skip
        targets.append(Target(motion, rate, shape, **target))
    return simulate_blobs(targets, frame, duration, noise, seed)


def _mixed(seed: int) -> tuple[Recording, BlobTruth]:
    rng = np.random.default_rng([seed, 77])
    kinds = [(200, 15, 2.0)] * 2 + [(5e3, 250, 6.0)] * 2 + [(1e5, 2500, 14.0)]
    targets = []
    for k, (rate, speed, size) in enumerate(kinds):
        centre = (110 + 105 * k, 120 + 60 * (k % 4))
        radius = 25.0 + 12 * (k % 3) if k < 4 else 90.0
        motion = CircularMotion(
            centre, radius, speed / radius, rng.uniform(0, 6), size=(size, 0.7 * size)
        )
        targets.append(Target(motion, rate))
    return simulate_blobs(targets, VGA, 2.0, 5e3, seed)


def _passing_discs(seed: int) -> tuple[Recording, BlobTruth]:
    """Two discs that touch for 0.1 s while they pass each other."""
    rng = np.random.default_rng([seed, 5])
    shift = rng.uniform(-20, 20)
    targets = [
        Target(
            LinearMotion(
                (320 - s * 120 + shift, 240 - s * 12.5), (s * 240.0, s * 10.0), size=(9.8, 9.8)
            ),
            3e4,
            "disc",
        )
        for s in (1, -1)
    ]
    return simulate_blobs(targets, VGA, 1.0, 5e3, seed)


@dataclasses.dataclass(frozen=True)
class _MeetingMotion:
    """One of two that come from apart, touch for half a second, turning, and part again."""

    sign: int
    phase: float

    def path(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        apart = 23 + 60 * np.maximum(np.abs(t - 1.0) - 0.25, 0)
        angle = self.phase + 2.0 * t
        centre = np.stack([320 + 90 * np.sin(1.9 * t), 240 + 60 * np.cos(1.3 * t)], 1)
        half = np.stack([np.cos(angle), np.sin(angle)], 1) * apart[:, None] / 2
        return centre + self.sign * half

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros((len(t), 8))
        out[:, :2] = self.path(t)
        out[:, 2:4] = (self.path(t + 1e-5) - self.path(t - 1e-5)) / 2e-5
        out[:, 4:6] = 8.0
        return out


def _turning_pair(seed: int) -> tuple[Recording, BlobTruth]:
    """Two rings that touch, turn about each other and part."""
    phase = np.random.default_rng([seed, 6]).uniform(0, 6)
    targets = [Target(_MeetingMotion(s, phase), 3e4, "ring") for s in (1, -1)]
    return simulate_blobs(targets, VGA, 2.0, 5e3, seed)


class _StoppingMotion:
    """Along a line, at rest from 1 to 2 s, then back at an angle."""

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        first, then = np.minimum(t, 1.0), np.maximum(t - 2.0, 0.0)
        out = np.zeros((len(t), 8))
        out[:, 0] = 150 + 250 * first - 120 * then
        out[:, 1] = 200 + 30 * first + 160 * then
        out[:, 2] = np.where(t < 1, 250, np.where(t < 2, 0, -120))
        out[:, 3] = np.where(t < 1, 30, np.where(t < 2, 0, 160))
        out[:, 4:6] = 7.0, 5.0
        return out


def _stop_and_go(seed: int) -> tuple[Recording, BlobTruth]:
    """One target that stands still, without events, for a second."""
    return simulate_blobs(
        [Target(_StoppingMotion(), 2e4, dropouts=((1.0, 2.0),))], VGA, 3.0, 2e4, seed
    )


def _hot(rng: np.random.Generator, number: int, frame: tuple[int, int]) -> list[Target]:
    """Pixels that fire all the time; too small to be scored."""
    return [
        Target(LinearMotion((int(x), int(y)), size=(0.05, 0.05)), float(rng.uniform(100, 2000)))
        for x, y in rng.uniform((0, 0), frame, (number, 2))
    ]


def _noise_only(seed: int) -> tuple[Recording, BlobTruth]:
    """Background and hot pixels; the one target is gone before the first time scored."""
    rng = np.random.default_rng([seed, 8])
    hot = [
        Target(LinearMotion((int(x), int(y)), size=(0.05, 0.05)), 500.0)
        for x, y in rng.uniform((0, 0), VGA, (8, 2))
    ]
    return simulate_blobs(hot, VGA, 2.0, 2e4, seed)


SCENES: dict[str, Scene] = {
    "4 x 100/s, 10 px/s, 1.5 px": lambda s: drifting(4, 100, 10, 1.5, 6.0, 2e3, s),
    "6 x 1k/s, 100 px/s, 3 px": lambda s: drifting(6, 1e3, 100, 3, 3.0, 5e3, s),
    "8 x 300/s, 40 px/s, 4 px": lambda s: drifting(8, 300, 40, 4, 4.0, 2e3, s),
    "3 x 10k/s, 500 px/s, 8 px": lambda s: drifting(3, 1e4, 500, 8, 1.5, 2e4, s),
    "2 x 100k/s, 2,000 px/s, 15 px": lambda s: drifting(2, 1e5, 2e3, 15, 0.5, 2e4, s),
    "1 x 1M/s, 10,000 px/s, 20 px": lambda s: drifting(1, 1e6, 1e4, 20, 0.15, 2e4, s),
    "1 x 1M/s, 20,000 px/s, 40 px": lambda s: drifting(1, 1e6, 2e4, 40, 0.15, 2e4, s),
    "1 x 20k/s, 100 px/s, 60 px": lambda s: drifting(1, 2e4, 100, 60, 2.0, 5e3, s, "ring"),
    "50 x 2k/s, 60 px/s, 3 px": lambda s: drifting(50, 2e3, 60, 3, 1.5, 5e3, s),
    "flock (8)": lambda s: blob_scene("flock", s),
    "disc": lambda s: blob_scene("disc", s, rate=3e4),
    "lissajous": lambda s: blob_scene("lissajous", s, rate=3e4),
    "lissajous, 10 x background": lambda s: blob_scene("noise", s, rate=3e4, ratio=10.0),
    "lissajous, 50 ms dropout": lambda s: blob_scene("dropout", s, rate=3e4),
    "crossing, 0 px": lambda s: blob_scene("crossing", s),
    "two discs that pass": _passing_discs,
    "two rings that meet": _turning_pair,
    "stop and go": _stop_and_go,
    "mixed 2 x 200/s, 2 x 5k/s, 1 x 100k/s": _mixed,
    "noise and 8 hot pixels": _noise_only,
}


def _square(half: float, stretch: float = 1.0) -> NDArray[np.float64]:
    w, h = half * stretch, half
    return np.array([(-w, -h), (w, -h), (w, h), (-w, h), (-w, -h)], float)


def _polygon(corners: int, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    angle = np.sort(np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) * 2 * np.pi / corners
    r = radius * rng.uniform(0.7, 1.2, corners)
    points = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
    return np.concatenate([points, points[:1]])


def _outline(
    half: float, rate: float, speed: float, frame: tuple[int, int], duration: float, kind: str
) -> Scene:
    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        rng = np.random.default_rng([seed, 21])
        corners = {
            "square": lambda: _square(half),
            "polygon": lambda: _polygon(int(rng.integers(3, 8)), half, rng),
            "bar": lambda: _square(half / 12, 12),
            "edges": lambda: np.array(
                [(-half, -half), (-half, half), (np.nan, np.nan), (half, -half), (half, half)]
            ),
        }[kind]()
        heading = rng.uniform(0, 2 * np.pi)
        if kind == "edges":
            heading = 0.0
        v = speed * np.array([np.cos(heading), np.sin(heading)])
        middle = np.array(frame) / 2 + rng.uniform(-0.1, 0.1, 2) * frame
        spin = 0.0 if kind == "edges" else rng.uniform(-1, 1) * speed / half
        line = LinearMotion(tuple(middle - v * duration / 2), tuple(v), spin=spin)
        outline: Any = Outline(line, rate, corners)  # what a target does
        return simulate_blobs([outline], frame, duration, 5e3, seed)

    return scene


def _one_polarity(on: bool) -> Scene:
    """Three blobs of which only one polarity is seen, one of them slow."""

    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        recording, truth = drifting(3, 3e3, 150, 5, 2.0, 3e3, seed, frame=DAVIS)
        keep = (truth.source < 0) | (np.asarray(recording.events[:].p) == on)
        events = recording.events[:]
        part = Events(events.t[keep], events.x[keep], events.y[keep], events.p[keep])
        return dataclasses.replace(recording, events=part), dataclasses.replace(
            truth, source=truth.source[keep], t=truth.t[keep], xi=truth.xi[keep]
        )

    return scene


def _come_and_go(seed: int) -> tuple[Recording, BlobTruth]:
    """Twelve cross the sensor, one after another, some together."""
    rng = np.random.default_rng([seed, 31])
    targets = []
    for _ in range(12):
        begin, heading = rng.uniform(-0.5, 3.5), rng.uniform(0, 2 * np.pi)
        speed, size = rng.uniform(150, 500), rng.uniform(3, 9)
        v = speed * np.array([np.cos(heading), np.sin(heading)])
        through = np.array(VGA) * rng.uniform(0.2, 0.8, 2)
        start = through - v * (begin + 1.0)
        targets.append(
            Target(
                LinearMotion(tuple(start), tuple(v), size=(size, 0.7 * size)), rng.uniform(2e3, 2e4)
            )
        )
    return simulate_blobs(targets, VGA, 4.0, 1e4, seed)


def _flicker(frame: tuple[int, int], size: float, rate: float) -> Scene:
    """Lamps of 100 Hz in the background, and two targets that pass before them."""

    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        rng = np.random.default_rng([seed, 41])
        lamps = [
            Lamp(tuple(rng.uniform(0.15, 0.85, 2) * frame), rng.uniform(4, 20), 2e4, 1e-3)
            for _ in range(3)
        ]
        moves = [
            CircularMotion(tuple(np.array(frame) * (0.3 + 0.4 * k, 0.5)), 0.2 * frame[1], 2.0 + k,
                rng.uniform(0, 6), size=(size, 0.7 * size))
            for k in range(2)
        ]  # fmt: skip
        targets = [Target(m, rate) for m in moves]
        return with_background(targets, frame, 3.0, 5e3, seed, lamps)

    return scene


@dataclasses.dataclass(frozen=True)
class Lamp:
    """A square of light that flickers at 100 Hz: events of the background."""

    centre: tuple[float, float]
    half: float
    rate: float
    burst: float
    frequency: float = 100.0

    def events(self, duration, rng):
        period = 1 / self.frequency
        n = rng.poisson(self.rate * duration)
        edge = rng.integers(0, max(1, int(duration / period * 2)), n)
        t = edge * period / 2 + rng.exponential(self.burst, n)
        xi = np.array(self.centre) + rng.uniform(-self.half, self.half, (n, 2))
        return t, xi, edge % 2 == 0


@dataclasses.dataclass(frozen=True)
class Texture:
    """Edges of a scene that moves past a moving camera: events of the background."""

    velocity: tuple[float, float]  # px/s
    frame: tuple[int, int]
    number: int = 150
    rate: float = 1e5
    seed: int = 0

    def events(self, duration, rng):
        own = np.random.default_rng([self.seed, 51])
        v = np.array(self.velocity)
        reach = abs(v) * duration
        low, high = -reach - 20, np.array(self.frame) + reach + 20
        a = own.uniform(low, high, (self.number, 2))
        angle, length = own.uniform(0, np.pi, self.number), own.uniform(10, 80, self.number)
        d = np.stack([np.cos(angle), np.sin(angle)], 1) * length[:, None]
        share = abs(d[:, 0] * v[1] - d[:, 1] * v[0]) * own.uniform(0.2, 1, self.number)
        n = rng.poisson(self.rate * duration * np.prod(high - low) / np.prod(self.frame))
        k = rng.choice(self.number, n, p=share / share.sum())
        t = rng.uniform(0, duration, n)
        xi = a[k] + rng.random(n)[:, None] * d[k] + v * (t - duration / 2)[:, None]
        return t, xi + rng.normal(size=(n, 2)) * 0.4, k % 2 == 0


def with_background(
    targets: Sequence[Any],
    frame: tuple[int, int],
    duration: float,
    noise: float,
    seed: int,
    others: Sequence[Lamp | Texture],
) -> tuple[Recording, BlobTruth]:
    """A scene with events of things that are no targets."""
    recording, truth = simulate_blobs(targets, frame, duration, noise, seed)
    events = recording.events[:]
    rng = np.random.default_rng([seed, 61])
    parts = [other.events(duration, rng) for other in others]
    t, xi, on = (np.concatenate(one) for one in zip(*parts, strict=True))
    at = np.rint(xi)
    inside = ((at >= 0) & (at < frame)).all(1) & (t < duration)
    t, xi, on, at = t[inside], xi[inside], on[inside], at[inside]
    us = np.concatenate([np.asarray(events.t), np.rint(t * 1e6).astype(np.int64)])
    order = np.argsort(us, kind="stable")
    x, y = at.astype(np.uint16).T
    joined = Events(
        us[order],
        np.concatenate([np.asarray(events.x), x])[order],
        np.concatenate([np.asarray(events.y), y])[order],
        np.concatenate([np.asarray(events.p), on])[order],
    )
    source = np.concatenate([truth.source, np.full(len(t), -1)])[order]
    return dataclasses.replace(recording, events=joined), dataclasses.replace(
        truth,
        source=source,
        t=np.concatenate([truth.t, t])[order],
        xi=np.concatenate([truth.xi, xi])[order],
    )


def _camera(speed: float, rate: float, contrast: float) -> Scene:
    """The camera moves, so that the whole scene does, and a target goes another way."""

    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        rng = np.random.default_rng([seed, 71])
        heading = rng.uniform(0, 2 * np.pi)
        v = speed * np.array([np.cos(heading), np.sin(heading)])
        own = CircularMotion((173, 130), 70, 3.0, rng.uniform(0, 6), size=(6.0, 4.5))
        scene = Texture(tuple(v), DAVIS, rate=rate, seed=seed)
        return with_background([Target(own, contrast)], DAVIS, 2.0, 2e3, seed, [scene])

    return scene


def _stars(seed: int) -> tuple[Recording, BlobTruth]:
    """43 that drift together, of 15 to 200 events/s each, and hot pixels."""
    rng = np.random.default_rng([seed, 81])
    v = rng.uniform(2, 6) * np.array([1.0, rng.uniform(-0.5, 0.5)])
    places = rng.uniform((10, 10), (230, 170), (400, 2))
    kept: list[NDArray] = []
    for p in places:
        if all(np.hypot(*(p - q)) > 9 for q in kept) and len(kept) < 43:
            kept.append(p)
    targets = [
        Target(LinearMotion(tuple(p - 5 * v), tuple(v), size=(1.2, 1.0)), float(rate))
        for p, rate in zip(kept, np.exp(rng.uniform(np.log(15), np.log(200), 43)), strict=True)
    ]
    return simulate_blobs([*targets, *_hot(rng, 5, (240, 180))], (240, 180), 10.0, 2e3, seed)


def _stops_and_turns(seed: int) -> tuple[Recording, BlobTruth]:
    """20 s of one large target that goes, stops, turns and goes on; few events while it rests."""
    rng = np.random.default_rng([seed, 91])
    t = np.array([0, 3, 5, 8, 11, 13, 16, 17, 20.0])
    points = rng.uniform((60, 60), (280, 200), (9, 2))
    points[2], points[5] = points[1], points[4]  # at rest
    path = Path(t, points, (16.0, 9.0), 0.2)
    rests = ((3.0, 5.0), (11.0, 13.0))
    moving = Target(path, 1.5e4, "ring", dropouts=rests)
    return simulate_blobs([moving], DAVIS, 20.0, 3e3, seed)


def _thrown(seed: int) -> tuple[Recording, BlobTruth]:
    """A large target on a parabola, and flicker behind."""
    rng = np.random.default_rng([seed, 101])
    t = np.linspace(0, 1.2, 13)
    points = np.stack([40 + 470 * t, 420 - 900 * t + 700 * t**2], 1) + rng.uniform(-20, 20, 2)
    ball = Target(Path(t, points, (18.0, 18.0)), 4e4, "ring")
    lamp = Lamp((330.0, 60.0), 25.0, 3e4, 5e-4)
    return with_background([ball], VGA, 1.2, 1e4, seed, [lamp])


def _approach(seed: int) -> tuple[Recording, BlobTruth]:
    """One that grows from 3 to 20 px while it comes nearer."""
    rng = np.random.default_rng([seed, 111])
    motion = ApproachMotion(
        (rng.uniform(-1, 1), rng.uniform(-0.5, 0.5)), 20.0, 5.6, (0.24, 0.2), focal=600,
        centre=(320, 240), size_factor=0.4, theta=0.3,
    )  # fmt: skip
    return simulate_blobs([Target(motion, 2e4)], VGA, 3.0, 1e4, seed)


def _unsteady(seed: int) -> tuple[Recording, BlobTruth]:
    """Two whose rate changes tenfold, four times a second."""
    gaps = tuple((a, a + 0.11) for a in np.arange(0.1, 3, 0.25))
    parts = []
    for k in range(2):
        circle = CircularMotion((120 + 110 * k, 130), 45, 2.5 - 4 * k, 0.3 * seed, size=(5.0, 4.0))
        parts += [Target(circle, 1e3), Target(circle, 9e3, dropouts=gaps)]
    recording, truth = simulate_blobs(parts, DAVIS, 3.0, 3e3, seed)
    return recording, dataclasses.replace(truth, targets=truth.targets[::2])


def _faint(seed: int) -> tuple[Recording, BlobTruth]:
    """Three of 10 events/s that go 1 px/s, for 20 s."""
    return drifting(3, 10, 1, 1.5, 20.0, 100, seed, frame=(240, 180))


def _noise(rate: float, frame: tuple[int, int], duration: float, hot: int) -> Scene:
    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        rng = np.random.default_rng([seed, 121])
        return simulate_blobs(_hot(rng, hot, frame), frame, duration, rate, seed)

    return scene


VARIED: dict[str, Scene] = {
    "square of 30 px, 30k/s": _outline(15, 3e4, 120, DAVIS, 1.5, "square"),
    "square of 100 px, 20k/s": _outline(50, 2e4, 100, DAVIS, 1.5, "square"),
    "square of 200 px, 500k/s": _outline(100, 5e5, 500, HD, 0.8, "square"),
    "polygon of 60 px, 50k/s": _outline(60, 5e4, 150, VGA, 1.5, "polygon"),
    "polygon of 150 px, 30k/s": _outline(150, 3e4, 60, VGA, 2.0, "polygon"),
    "bar of 80 px, 20k/s, turning": _outline(40, 2e4, 80, DAVIS, 2.0, "bar"),
    "pair of edges, 40 px, 20k/s": _outline(20, 2e4, 150, DAVIS, 1.2, "edges"),
    "pair of edges, 120 px, 100k/s": _outline(60, 1e5, 300, VGA, 1.2, "edges"),
    "ring of 15 px, 5k/s": lambda s: drifting(2, 5e3, 80, 15, 2.0, 5e3, s, "ring", DAVIS),
    "ring of 30 px, 300k/s": lambda s: drifting(1, 3e5, 2e3, 30, 0.5, 2e4, s, "ring", HD),
    "ring of 60 px, 500k/s": lambda s: drifting(1, 5e5, 600, 60, 0.5, 2e4, s, "ring", VGA),
    "ring of 60 px, 5k/s": lambda s: drifting(1, 5e3, 40, 60, 4.0, 2e3, s, "ring", VGA),
    "disc of 40 px, 100k/s": lambda s: drifting(1, 1e5, 400, 40, 1.0, 1e4, s, "disc", VGA),
    "ON only": _one_polarity(True),
    "OFF only": _one_polarity(False),
    "12 come and go": _come_and_go,
    "lamps of 100 Hz, 2 targets": _flicker(DAVIS, 5.0, 5e3),
    "lamps of 100 Hz, 2 large": _flicker(VGA, 16.0, 5e4),
    "camera moves, 30 px/s": _camera(30, 5e4, 1e4),
    "camera moves, 150 px/s": _camera(150, 2e5, 2e4),
    "43 stars": _stars,
    "stops and turns, 20 s": _stops_and_turns,
    "thrown, flicker behind": _thrown,
    "approach, 3 to 20 px": _approach,
    "rate changes tenfold": _unsteady,
    "3 x 10/s, 1 px/s, 20 s": _faint,
    "2 x 3k/s, 128x128": lambda s: drifting(2, 3e3, 120, 5, 2.0, 1e3, s, frame=DVS),
    "4 x 500/s, 128x128, 10 x": lambda s: drifting(4, 500, 40, 3, 4.0, 2e4, s, frame=DVS),
    "20 x 5k/s, 1280x720": lambda s: drifting(20, 5e3, 200, 5, 1.5, 1e5, s, frame=HD),
    "2 x 1M/s, 20 ms": lambda s: drifting(2, 1e6, 3e3, 10, 0.02, 1e5, s),
    "1 x 50k/s, 20 ms": lambda s: drifting(1, 5e4, 1e3, 6, 0.02, 2e4, s, frame=DAVIS),
    "1 x 300k/s, 100 ms, 10 x": lambda s: drifting(1, 3e5, 5e3, 12, 0.1, 3e6, s, frame=HD),
    "noise 1M/s, 1280x720": _noise(1e6, HD, 0.5, 30),
    "noise 500/s, 346x260, 20 s": _noise(500, DAVIS, 20.0, 5),
}


@dataclasses.dataclass(frozen=True)
class Paced:
    """An outline or target whose events come as it moves: none at rest, all at its top speed."""

    target: Any
    top: float  # px/s

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.target.state(t)

    def visible(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.hypot(*self.target.motion.state(t)[:, 2:4].T) > 0.1 * self.top

    def events(self, duration, rng):
        t, xi, on = self.target.events(duration, rng)
        speed = np.hypot(*self.target.motion.state(t)[:, 2:4].T)
        kept = rng.random(len(t)) < speed / self.top
        return t[kept], xi[kept], on[kept]


@dataclasses.dataclass(frozen=True)
class Tailed:
    """A target and a dim tail: a share of its events come late, where it was, and are OFF."""

    target: Target
    late: float  # s, mean
    share: float

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.target.state(t)

    def visible(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.ones(t.shape, bool)

    def events(self, duration, rng):
        t, xi, on = self.target.events(duration, rng)
        tail = rng.random(len(t)) < self.share
        t = t + np.where(tail, rng.exponential(self.late, len(t)), 0)
        on = np.where(tail, False, True)
        kept = t < duration
        return t[kept], xi[kept], on[kept]


@dataclasses.dataclass(frozen=True)
class Strip:
    """A strip (left, top, right, bottom) px with events at a steady rate: background."""

    box: tuple[float, float, float, float]
    rate: float

    def events(self, duration, rng):
        n = rng.poisson(self.rate * duration)
        low, high = self.box[:2], self.box[2:]
        return rng.uniform(0, duration, n), rng.uniform(low, high, (n, 2)), rng.random(n) < 0.5


class SwingMotion:
    """A swing about a centre: amplitude (px) along x, a shallow arc, `rate` rad/s."""

    def __init__(self, centre: tuple[float, float], amplitude: float, rate: float, phase: float):
        self.centre, self.amplitude, self.rate, self.phase = centre, amplitude, rate, phase

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        a, out = self.rate * t + self.phase, np.zeros((len(t), 8))
        s, c = np.sin(a), np.cos(a)
        out[:, 0] = self.centre[0] + self.amplitude * s
        out[:, 1] = self.centre[1] + 0.25 * self.amplitude * (1 - s * s)
        out[:, 2] = self.amplitude * self.rate * c
        out[:, 3] = -0.5 * self.amplitude * self.rate * s * c
        out[:, 4:6] = 1.0
        return out


def _circle(radius: float, corners: int = 24) -> NDArray[np.float64]:
    angle = np.linspace(0, 2 * np.pi, corners + 1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def _segments(*lines: NDArray) -> NDArray[np.float64]:
    gap = np.full((1, 2), np.nan)
    return np.concatenate([part for line in lines for part in (line, gap)][:-1])


def _ball_and_arm(seed: int) -> tuple[Recording, BlobTruth]:
    """A ball is thrown out of the lower edge at 0.28 s; the arm that threw it goes on."""
    rng = np.random.default_rng([seed, 131])
    speed = np.array([rng.uniform(-150, 150), 180 / 0.28])
    start = np.array([173 + rng.uniform(-30, 30), 90.0])
    ball = Outline(LinearMotion(tuple(start), tuple(speed), spin=6.0), 6e4, _circle(18))
    place = start + (rng.choice([-1, 1]) * 15.0, 135.0)
    arm_motion = LissajousMotion(
        tuple(place), (12.0, 8.0), (1.3, 0.9), (rng.uniform(0, 6), rng.uniform(0, 6)), spin=0.8
    )
    arm: Any = Outline(arm_motion, 1.5e4, _square(7, 5))
    parts: list[Any] = [ball, arm]
    return simulate_blobs(parts, DAVIS, 0.75, 5e3, seed)


def _pendulum(seed: int) -> tuple[Recording, BlobTruth]:
    """A bob, silent where it turns, swings before a strip of steady events for 5 s."""
    rng = np.random.default_rng([seed, 141])
    swing: Any = SwingMotion((64, 70), 40.0, rng.uniform(3.5, 5.5), rng.uniform(0, 6))
    bob: Any = Paced(Outline(swing, 2e4, _circle(7)), 40.0 * swing.rate)
    low = rng.uniform(66, 74)
    strip: Any = Strip((10, low, 118, low + 6), 6e3)
    return with_background([bob], DVS, 5.0, 1e3, seed, [strip])


def _pen(seed: int) -> tuple[Recording, BlobTruth]:
    """A pen of 90 px turns about a point that hardly moves."""
    rng = np.random.default_rng([seed, 151])
    motion = LissajousMotion(
        (173, 130), (10.0, 8.0), (0.4, 0.5), (rng.uniform(0, 6), rng.uniform(0, 6)),
        theta=rng.uniform(0, 3), spin=rng.choice([-1, 1]) * rng.uniform(4, 9),
    )  # fmt: skip
    pen: Any = Outline(motion, 4e4, _square(4, 11))
    return simulate_blobs([pen], DAVIS, 2.0, 5e3, seed)


def _textured_disc(seed: int) -> tuple[Recording, BlobTruth]:
    """A disc of 45 px with twelve lines on it turns in its place, or drifts."""
    rng = np.random.default_rng([seed, 161])
    lines = []
    for _ in range(12):
        r, a = 38 * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        d = rng.uniform(4, 12) * np.array([np.cos(b := rng.uniform(0, np.pi)), np.sin(b)])
        middle = r * np.array([np.cos(a), np.sin(a)])
        lines.append(np.stack([middle - d / 2, middle + d / 2]))
    v = (0.0, 0.0) if seed % 2 else (float(rng.uniform(20, 60)), float(rng.uniform(-20, 20)))
    motion = LinearMotion((140, 130), v, spin=rng.choice([-1, 1]) * rng.uniform(3, 8))
    disc: Any = Outline(motion, 8e4, _segments(_circle(45), *lines))
    return simulate_blobs([disc], DAVIS, 1.5, 5e3, seed)


def _rim(seed: int) -> tuple[Recording, BlobTruth]:
    """A rim of 40 px rolls across the sensor."""
    rng = np.random.default_rng([seed, 171])
    speed = float(rng.choice([-1, 1]) * rng.uniform(80, 160))
    motion = LinearMotion((173 - speed * 0.75, 130 + rng.uniform(-40, 40)), (speed, 10.0))
    rim: Any = Outline(motion, 3e4, _circle(40))
    return simulate_blobs([rim], DAVIS, 1.5, 5e3, seed)


def _thirty(seed: int) -> tuple[Recording, BlobTruth]:
    """30 blobs of 3 px on curves of their own, which cross."""
    rng = np.random.default_rng([seed, 181])
    targets = [
        Target(
            LissajousMotion(
                tuple(rng.uniform((60, 50), (286, 210))), tuple(rng.uniform(20, 45, 2)),
                tuple(rng.uniform(0.15, 0.4, 2)), tuple(rng.uniform(0, 6, 2)), size=(3.0, 2.5),
            ),
            2e3,
        )
        for _ in range(30)
    ]  # fmt: skip
    return simulate_blobs(targets, DAVIS, 2.0, 3e3, seed)


def _hand(seed: int) -> tuple[Recording, BlobTruth]:
    """The outline of a hand of 100 px waves before the camera."""
    rng = np.random.default_rng([seed, 191])
    points: list[tuple[float, float]] = [(-25, 45), (-28, 0)]
    for k in range(4):
        x = -28 + 14 * k
        points += [(x, -rng.uniform(35, 55)), (x + 9, -rng.uniform(35, 55)), (x + 11, 0)]
    points += [(45, -5), (48, 4), (28, 25), (25, 45)]
    motion = LissajousMotion(
        (173, 130), (50.0, 20.0), (0.8, 0.6), tuple(rng.uniform(0, 6, 2)), spin=0.3
    )
    hand: Any = Outline(motion, 6e4, np.array(points, float))
    return simulate_blobs([hand], DAVIS, 2.0, 5e3, seed)


def _close_flock(seed: int) -> tuple[Recording, BlobTruth]:
    """Twelve birds of 3 px that fly together, 18 px apart, each a little its own way."""
    rng = np.random.default_rng([seed, 201])
    heading, targets = rng.uniform(0, 2 * np.pi), []
    v = 60 * np.array([np.cos(heading), np.sin(heading)])
    for k in range(12):
        place = np.array([173, 130]) - v * 1.0 + 18 * np.array([k % 4 - 1.5, k // 4 - 1])
        own = v + rng.normal(size=2) * 2.0
        start = tuple(place + rng.normal(size=2) * 1.5)
        targets.append(Target(LinearMotion(start, tuple(own), size=(3.0, 2.0)), 2e3))
    return simulate_blobs(targets, DAVIS, 2.0, 3e3, seed)


def _dim_tails(seed: int) -> tuple[Recording, BlobTruth]:
    """Five lights that leave dim tails of OFF events for 0.3 s."""
    rng = np.random.default_rng([seed, 211])
    targets: list[Any] = []
    for k in range(5):
        circle = CircularMotion(
            (60 + 56 * k, 90 + 80 * (k % 2)), 25, 2.4 * rng.choice([-1, 1]), rng.uniform(0, 6),
            size=(2.5, 2.5),
        )  # fmt: skip
        targets.append(Tailed(Target(circle, 3e3), 0.3, 0.4))
    return simulate_blobs(targets, DAVIS, 3.0, 3e3, seed)


OBJECTS: dict[str, Scene] = {
    "ball leaves, arm stays": _ball_and_arm,
    "pendulum before a strip": _pendulum,
    "pen that turns": _pen,
    "bar of 80 px, turning": _outline(40, 2e4, 80, DAVIS, 2.0, "bar"),
    "textured disc that turns": _textured_disc,
    "rim of 40 px": _rim,
    "30 blobs, 346x260": _thirty,
    "hand": _hand,
    "flock of 12, close": _close_flock,
    "dim tails": _dim_tails,
}


def _slow_disc(radius: float, speed: float, density: float) -> Scene:
    """A disc (px, px/s) with so many events per px of its outline and px of its way."""

    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        frame, size = (240, 180), radius / np.sqrt(1.5)
        motion = LinearMotion((80.0, 84.0), (speed, 0.0), size=(size, size / np.sqrt(2)))
        target = Target(motion, 4 * density * radius * speed, "disc")
        return simulate_blobs([target], frame, 1.0, 0.5 * frame[0] * frame[1], seed)

    return scene


DISCS: dict[str, Scene] = {
    f"disc of {radius} px, {speed} px/s, {density} events/px": _slow_disc(radius, speed, density)
    for radius, speed, density in (
        (7, 12, 3), (7, 20, 3), (7, 40, 1), (7, 40, 3), (12, 12, 3), (12, 20, 1), (12, 20, 3),
        (12, 40, 1), (12, 40, 3), (45, 60, 1),
    )
}  # fmt: skip


def _small_discs(seed: int) -> tuple[Recording, BlobTruth]:
    """Twelve discs of 3 to 5 px on curves of their own, some in contact at the start."""
    rng = np.random.default_rng([seed, 301])
    targets = []
    for place in _places(rng, ((40, 40), (306, 220)), 18):
        size = rng.uniform(3, 5) / np.sqrt(1.5)
        motion = LissajousMotion(
            tuple(place), tuple(rng.uniform(15, 35, 2)), tuple(rng.uniform(0.15, 0.4, 2)),
            tuple(rng.uniform(0, 6, 2)), size=(size, size / np.sqrt(2)),
        )  # fmt: skip
        targets.append(Target(motion, rng.uniform(1.5e3, 3e3), "disc"))
    return simulate_blobs(targets, DAVIS, 2.0, 5e3, seed)


def _parting_discs(seed: int) -> tuple[Recording, BlobTruth]:
    """Twelve discs of 4 px that go straight on, some in contact at the start."""
    rng = np.random.default_rng([seed, 302])
    targets = []
    size = 4 / np.sqrt(1.5)
    for place in _places(rng, ((60, 50), (286, 210)), 14):
        angle = rng.uniform(0, 2 * np.pi)
        v = rng.uniform(20, 50) * np.array([np.cos(angle), np.sin(angle)])
        motion = LinearMotion(tuple(place - v * 0.5), tuple(v), size=(size, size / np.sqrt(2)))
        targets.append(Target(motion, 2e3, "disc"))
    return simulate_blobs(targets, DAVIS, 1.5, 3e3, seed)


def _places(
    rng: np.random.Generator, box: tuple[tuple[int, int], tuple[int, int]], apart: float
) -> list[NDArray[np.float64]]:
    """Twelve places between the corners of a box, so far (px) from each other."""
    places: list[NDArray[np.float64]] = []
    while len(places) < 12:
        place = rng.uniform(box[0], box[1])
        if all(np.hypot(*(place - other)) > apart for other in places):
            places.append(place)
    return places


@dataclasses.dataclass(frozen=True)
class _LegMotion:
    """The middle of a leg of so many px that swings about a hip, which moves along the rows."""

    hip: tuple[float, float]
    speed: float
    length: float
    phase: float

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        out, rate, half = np.zeros((len(t), 8)), 2 * np.pi * 1.4, self.length / 2
        angle = 0.45 * np.sin(rate * t + self.phase)
        spin = 0.45 * rate * np.cos(rate * t + self.phase)
        out[:, 0] = self.hip[0] + self.speed * t - half * np.sin(angle)
        out[:, 1] = self.hip[1] + half * np.cos(angle)
        out[:, 2] = self.speed - half * np.cos(angle) * spin
        out[:, 3] = -half * np.sin(angle) * spin
        out[:, 4:6], out[:, 6], out[:, 7] = 1.0, angle, spin
        return out


@dataclasses.dataclass(frozen=True)
class Walker:
    """Outlines of a body, a head and two legs that swing, from `start` (px) along the rows."""

    start: tuple[float, float]
    speed: float
    phase: float
    height: float = 1.0

    def state(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros((len(t), 8))
        out[:, 0], out[:, 1] = self.start[0] + self.speed * t, self.start[1] + 4 * self.height
        out[:, 2], out[:, 6] = self.speed, np.pi / 2
        out[:, 4:6] = 19 * self.height, 6.5 * self.height
        return out

    def visible(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.ones(t.shape, bool)

    def events(self, duration, rng):
        (x, y), v, h = self.start, (self.speed, 0.0), self.height
        body = np.array([(-6, -14), (6, -14), (7, 10), (-7, 10), (-6, -14)]) * h
        head = _circle(4.0, 12) * [h, 1.125 * h]
        leg = np.array([(-2.5, -12), (2.5, -12), (2, 12), (-2, 12), (-2.5, -12)]) * h
        swings: list[Any] = [
            _LegMotion((x, y + 10 * h), self.speed, 24 * h, self.phase + half)
            for half in (0, np.pi)
        ]
        parts = [
            Outline(LinearMotion((x, y), v), 13_500, body),
            Outline(LinearMotion((x, y - 20 * h), v), 4500, head),
            *(Outline(swing, 6000, leg) for swing in swings),
        ]
        each = [part.events(duration, rng) for part in parts]
        t, xi, on = (np.concatenate(column) for column in zip(*each, strict=True))
        order = np.argsort(t, kind="stable")
        return t[order], xi[order], on[order]


def _walkers(overtake: bool) -> Scene:
    """Two who walk past each other, or one who overtakes the other."""

    def scene(seed: int) -> tuple[Recording, BlobTruth]:
        rng = np.random.default_rng([seed, 304 if overtake else 303])
        targets: list[Any] = []
        ranges = ((35, 45), (75, 95)) if overtake else ((50, 90), (-90, -50))
        for low, high in ranges:
            v = rng.uniform(low, high)
            x = 173 - v * 1.5 + rng.uniform(-15, 15)
            place = x, 120 + rng.uniform(-6, 6)
            targets.append(Walker(place, v, rng.uniform(0, 6), rng.uniform(0.85, 1.15)))
        return simulate_blobs(targets, DAVIS, 3.0, 5e3, seed)

    return scene


MEETINGS: dict[str, Scene] = {
    "12 small discs": _small_discs,
    "12 small discs that part": _parting_discs,
    "two walkers pass": _walkers(False),
    "one walker overtakes": _walkers(True),
}
