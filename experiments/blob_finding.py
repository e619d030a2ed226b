"""Tracking without settings: simulated scenes and what simple trackers make of them.

    python experiments/blob_finding.py --out finding --first 10 [--scenes NAME ...] [--data DIR]

Every scene is tracked as a new user does it, `moment.estimate(recording)`, whose states rest on all
events. Beside it: `filter`, the same tracks from the events up to each time; the targets that
`find` alone gives; `clusters`, connected components of event images, each linked to the
nearest of the image before; and `kalman`, a tracker of constant velocity on the same centroids with
optimal assignment, births after three and deaths after five images, as norfair and motpy do it.
Both baselines get the window and cell that `find` chose. Makes table.md and results.json. With
--data, a folder that holds spinning_dot.npz and davis346_street.npz, these are tracked too.

Scores are those of `jaxevent.blob.scores` at 200 times: a track and a target are one where they are
nearer than 2 sizes and 3 px.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from jaxevent.blob import Found, find, moment
from jaxevent.blob.finding.background import measure_background
from jaxevent.blob.finding.detection import detect, measure_blobs
from jaxevent.blob.finding.stream import Stream
from jaxevent.blob.scores import score_tracks
from jaxevent.io import load
from jaxevent.recording import Recording
from jaxevent.simulate.blobs import (
    Circle,
    Line,
    Target,
    Truth,
    blob_scene,
    simulate_blobs,
)

VGA = (640, 480)
TIMES = 200
DOT_CENTRE = (314.29, 202.35)  # px, of a circle fitted to the same events


class Answer(NamedTuple):
    """Positions of tracks at the times scored: (times, tracks, 2), NaN where a track is not."""

    positions: NDArray[np.float64]


def _drifting(
    count: int,
    rate: float,
    speed: float,
    size: float,
    duration: float,
    noise: float,
    seed: int,
    shape: str = "gaussian",
) -> tuple[Recording, Truth]:
    """Targets that circle with random phases, so that they stay on the sensor."""
    rng = np.random.default_rng([seed, count])
    targets = []
    columns = math.ceil(math.sqrt(count * 4 / 3))
    rows = math.ceil(count / columns)
    cell = np.array(VGA) / (columns, rows)
    for k in range(count):
        centre = (np.array([k % columns, k // columns]) + 0.5) * cell
        radius = float(max(0.35 * cell.min() - size, 2.0))
        turn = speed / radius * rng.choice([-1, 1])
        motion = Circle(
            tuple(centre), radius, turn, rng.uniform(0, 2 * np.pi), size=(size, 0.7 * size),
            theta=rng.uniform(0, np.pi),
        )  # fmt: skip
        targets.append(Target(motion, rate, shape))
    return simulate_blobs(targets, VGA, duration, noise, seed)


def _mixed(seed: int) -> tuple[Recording, Truth]:
    rng = np.random.default_rng([seed, 77])
    kinds = [(200, 15, 2.0)] * 2 + [(5e3, 250, 6.0)] * 2 + [(1e5, 2500, 14.0)]
    targets = []
    for k, (rate, speed, size) in enumerate(kinds):
        centre = (110 + 105 * k, 120 + 60 * (k % 4))
        radius = 25.0 + 12 * (k % 3) if k < 4 else 90.0
        motion = Circle(centre, radius, speed / radius, rng.uniform(0, 6), size=(size, 0.7 * size))
        targets.append(Target(motion, rate))
    return simulate_blobs(targets, VGA, 2.0, 5e3, seed)


def _passing_discs(seed: int) -> tuple[Recording, Truth]:
    """Two discs that touch for 0.1 s while they pass each other."""
    rng = np.random.default_rng([seed, 5])
    shift = rng.uniform(-20, 20)
    targets = [
        Target(
            Line((320 - s * 120 + shift, 240 - s * 12.5), (s * 240.0, s * 10.0), size=(9.8, 9.8)),
            3e4,
            "disc",
        )
        for s in (1, -1)
    ]
    return simulate_blobs(targets, VGA, 1.0, 5e3, seed)


class _Meeting(NamedTuple):
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


def _turning_pair(seed: int) -> tuple[Recording, Truth]:
    """Two rings that touch, turn about each other and part."""
    phase = np.random.default_rng([seed, 6]).uniform(0, 6)
    targets = [Target(_Meeting(s, phase), 3e4, "ring") for s in (1, -1)]
    return simulate_blobs(targets, VGA, 2.0, 5e3, seed)


def _stop_and_go(seed: int) -> tuple[Recording, Truth]:
    """One target that stands still, without events, for a second."""
    motion = _Stopping()
    return simulate_blobs([Target(motion, 2e4, dropouts=((1.0, 2.0),))], VGA, 3.0, 2e4, seed)


class _Stopping:
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


def _noise_only(seed: int) -> tuple[Recording, Truth]:
    """Background and hot pixels; the one target is gone before the first time scored."""
    rng = np.random.default_rng([seed, 8])
    hot = [
        Target(Line((int(x), int(y)), size=(0.05, 0.05)), 500.0)
        for x, y in rng.uniform((0, 0), VGA, (8, 2))
    ]
    return simulate_blobs(hot, VGA, 2.0, 2e4, seed)


def _crossing(seed: int) -> tuple[Recording, Truth]:
    return blob_scene("crossing", seed)


SCENES: dict[str, Callable[[int], tuple[Recording, Truth]]] = {
    "4 x 100/s, 10 px/s, 1.5 px": lambda s: _drifting(4, 100, 10, 1.5, 6.0, 2e3, s),
    "6 x 1k/s, 100 px/s, 3 px": lambda s: _drifting(6, 1e3, 100, 3, 3.0, 5e3, s),
    "8 x 300/s, 40 px/s, 4 px": lambda s: _drifting(8, 300, 40, 4, 4.0, 2e3, s),
    "3 x 10k/s, 500 px/s, 8 px": lambda s: _drifting(3, 1e4, 500, 8, 1.5, 2e4, s),
    "2 x 100k/s, 2,000 px/s, 15 px": lambda s: _drifting(2, 1e5, 2e3, 15, 0.5, 2e4, s),
    "1 x 1M/s, 10,000 px/s, 20 px": lambda s: _drifting(1, 1e6, 1e4, 20, 0.15, 2e4, s),
    "1 x 1M/s, 20,000 px/s, 40 px": lambda s: _drifting(1, 1e6, 2e4, 40, 0.15, 2e4, s),
    "1 x 20k/s, 100 px/s, 60 px": lambda s: _drifting(1, 2e4, 100, 60, 2.0, 5e3, s, "ring"),
    "50 x 2k/s, 60 px/s, 3 px": lambda s: _drifting(50, 2e3, 60, 3, 1.5, 5e3, s),
    "flock (8)": lambda s: blob_scene("flock", s),
    "disc": lambda s: blob_scene("disc", s, rate=3e4),
    "lissajous": lambda s: blob_scene("lissajous", s, rate=3e4),
    "lissajous, 10 x background": lambda s: blob_scene("noise", s, rate=3e4, ratio=10.0),
    "lissajous, 50 ms dropout": lambda s: blob_scene("dropout", s, rate=3e4),
    "crossing, 0 px": _crossing,
    "two discs that pass": _passing_discs,
    "two rings that meet": _turning_pair,
    "stop and go": _stop_and_go,
    "mixed 2 x 200/s, 2 x 5k/s, 1 x 100k/s": _mixed,
    "noise and 8 hot pixels": _noise_only,
}  # fmt: skip


def found_paths(found: Found, times: NDArray[np.int64]) -> Answer:
    """Positions of what `find` gives, on straight lines between windows."""
    out = np.full((len(times), len(found), 2), np.nan)
    for k, path in enumerate(found.paths):
        now = (times >= path.begin) & (times < path.end)
        out[now, k] = path.at(times[now])
    return Answer(out)


def tracked(recording: Recording, found: Found, times: NDArray[np.int64]) -> tuple[Answer, Answer]:
    """Positions of what a new user gets, smoothed, and of the filter."""
    params = moment.Params(**found.settings())
    tracks = moment.estimate(recording, params, found=found, progress=False)
    smoothed, filtered = (
        Answer(np.where(states.valid[..., None], states.mean[..., :2], np.nan))
        for states in (tracks(times), tracks.filtered(times))
    )
    return smoothed, filtered


def _centroids(recording: Recording, found: Found) -> Iterator[tuple[int, NDArray]]:
    """Time and centroids (n, 2) of the components of each event image."""
    if not found.passes:
        return
    scale = found.passes[0].choice.scale
    stream = Stream(recording, int(recording.start), int(recording.stop) + 1)
    background = measure_background(stream)
    size = recording.height, recording.width
    for k in range(int(stream.duration / scale.window)):
        begin = k * scale.window
        part = stream.window(begin, begin + scale.window)
        labels, number = detect(part, background, scale, size, begin)
        blobs = measure_blobs(part, labels, number)
        yield stream.start + round(1e6 * (begin + scale.window / 2)), blobs.p[blobs.n >= 3]


class _Line(NamedTuple):
    t: list[int]
    p: list[NDArray]


def clusters(recording: Recording, found: Found, times: NDArray[np.int64]) -> Answer:
    """Components linked to the nearest one of the image before, within 30 px."""
    live: list[_Line] = []
    done: list[_Line] = []
    for t, p in _centroids(recording, found):
        free, following = set(range(len(p))), []
        for one in live:
            apart = [(float(np.hypot(*(p[i] - one.p[-1]))), i) for i in free]
            distance, i = min(apart, default=(np.inf, -1))
            if distance < 30:
                free.discard(i)
                one.t.append(t)
                one.p.append(p[i])
                following.append(one)
            else:
                done.append(one)
        live = following + [_Line([t], [p[i]]) for i in free]
    return _of_lines([one for one in done + live if len(one.t) >= 3], times)


def kalman(recording: Recording, found: Found, times: NDArray[np.int64]) -> Answer:
    """Constant velocity, optimal assignment within 3 standard deviations, 3 hits, 5 misses."""
    live: list[dict[str, Any]] = []
    done: list[_Line] = []
    for t, p in _centroids(recording, found):
        for one in live:
            one["x"] = one["x"] + one["v"]
        rows, columns = np.zeros(0, int), np.zeros(0, int)
        apart = np.zeros((len(live), len(p)))
        if live and len(p):
            apart = np.hypot(
                *(np.array([one["x"] for one in live])[:, None] - p).transpose(2, 0, 1)
            )
            rows, columns = linear_sum_assignment(np.minimum(apart, 1e3))
        hit = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if apart[i, j] < 30}
        for i, one in enumerate(live):
            if i in hit:
                e = p[hit[i]] - one["x"]
                one["x"], one["v"], one["miss"] = one["x"] + 0.6 * e, one["v"] + 0.3 * e, 0
                one["line"].t.append(t)
                one["line"].p.append(one["x"])
            else:
                one["miss"] += 1
        done += [one["line"] for one in live if one["miss"] > 5]
        live = [one for one in live if one["miss"] <= 5]
        for j in set(range(len(p))) - set(hit.values()):
            new = {"x": p[j], "v": np.zeros(2), "miss": 0, "line": _Line([t], [p[j]])}
            live.append(new)
    lines = done + [one["line"] for one in live]
    return _of_lines([one for one in lines if len(one.t) >= 3], times)


def _of_lines(lines: list[_Line], times: NDArray[np.int64]) -> Answer:
    out = np.full((len(times), len(lines), 2), np.nan)
    for k, one in enumerate(lines):
        now = (times >= one.t[0]) & (times <= one.t[-1])
        for axis in range(2):
            out[now, k, axis] = np.interp(times[now], one.t, np.array(one.p)[:, axis])
    return Answer(out)


def score(answer: Answer, truth: Truth, times: NDArray[np.int64], size: tuple[int, int]) -> dict:
    """See the module's docstring."""
    states = truth(times)
    states = states[:, (states[..., 4] > 0.5).any(0)]  # the others are hot pixels
    visible = truth.visible(times)[:, (truth(times)[..., 4] > 0.5).any(0)]
    inside = np.asarray(((states[..., :2] >= 0) & (states[..., :2] < size)).all(-1))
    paths = np.where(inside[..., None], states[..., :2], np.nan)
    told = score_tracks(paths, answer.positions, 2 * states[..., 4] + 3, hidden=~visible)
    names = ("targets", "found", "tracks", "false", "covered", "rms", "idf1", "mota", "hota")
    return {name: getattr(told, name) for name in names}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    args = parser.parse_args()
    rows = []
    for name in args.scenes:
        for seed in range(args.first, args.first + args.seeds):
            recording, truth = SCENES[name](seed)
            times = np.linspace(0, truth.duration * 1e6 - 1, TIMES + 2)[1:-1].astype(np.int64)
            clock = time.process_time()
            found = find(recording, progress=False)
            seconds = time.process_time() - clock
            smoothed, filtered = tracked(recording, found, times)
            answers = {
                "moment": smoothed,
                "filter": filtered,
                "find": found_paths(found, times),
                "clusters": clusters(recording, found, times),
                "kalman": kalman(recording, found, times),
            }
            for method, answer in answers.items():
                row = score(answer, truth, times, (recording.width, recording.height))
                rows.append({"scene": name, "seed": seed, "method": method, "cpu": seconds} | row)
                print(
                    f"{name[:34]:34} {seed} {method:9}"
                    + " ".join(f"{key} {row[key]:.3g}" for key in row)
                    + (f" | {seconds:.1f} s {found.summary()}" if method == "moment" else ""),
                    flush=True,
                )
    args.out.mkdir(parents=True, exist_ok=True)
    if args.data is not None:
        print("\n".join(_real(args.data)))
    (args.out / "results.json").write_text(json.dumps(rows, indent=1))
    (args.out / "table.md").write_text(_table(rows))
    print(_table(rows))


def _real(data: Path) -> list[str]:
    """Lines about tracks of real recordings, as a new user gets them, filtered."""
    lines = []
    for name in ("spinning_dot", "davis346_street"):
        recording = load(data / f"{name}.npz")
        tracks = moment.estimate(recording, smooth=False, progress=False)
        lives = (tracks.death - tracks.birth) * 1e-6
        lines.append(f"{name}: tracks of {', '.join(f'{life:.3f}' for life in lives)} s")
        if name == "spinning_dot":
            t = np.linspace(0.003, 0.0499, 900)
            state = tracks(t, [int(tracks.id[np.argmax(lives)])]).mean[:, 0]
            radius = np.hypot(state[:, 0] - DOT_CENTRE[0], state[:, 1] - DOT_CENTRE[1])
            speed = np.hypot(state[:, 2], state[:, 3])
            lines[-1] += (
                f"; radius {radius.mean():.2f} +- {radius.std():.2f} px, "
                f"speed {np.median(speed):,.0f} px/s"
            )
    return lines


def _table(rows: list[dict]) -> str:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = ["| scene | " + " | ".join(methods) + " |", "|---|" + "---|" * len(methods)]
    for name in [*dict.fromkeys(row["scene"] for row in rows), "all"]:
        cells = []
        for method in methods:
            own = [r for r in rows if r["method"] == method and name in (r["scene"], "all")]
            found, targets = sum(r["found"] for r in own), sum(r["targets"] for r in own)
            errors = [r["rms"] for r in own if np.isfinite(r["rms"])]
            cells.append(
                f"{found}/{targets}, {sum(r['false'] for r in own)}, "
                f"{np.mean([r['idf1'] for r in own]):.2f}, {np.mean(errors or [np.nan]):.2f}"
            )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "found, false tracks, IDF1, rms px\n\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
