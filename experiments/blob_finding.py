"""Tracking without settings: simulated scenes and what simple trackers make of them.

    python experiments/blob_finding.py --out finding --first 10 [--varied | --objects]

Every scene is tracked as a new user does it, `moment.estimate(recording)`, whose states rest on all
events. Beside it: `filter`, the same tracks from the events up to each time; the targets that
`find` alone gives; `clusters`, connected components of event images, each linked to the
nearest of the image before; `kalman`, a tracker of constant velocity on the same centroids with
optimal assignment, births after three and deaths after five images, as motpy does it; `norfair`,
that library's tracker on them (`pip install norfair filterpy`; else there is no such row); `mean`,
the centred mean of a window's events within three sizes of the mean before, told where each target
begins. All get the window and cell that `find` chose. `by hand` is `moment`, smoothed, from seeds
at the true beginnings, with the truth's sizes, times and changes of velocity (Q_v is the rms
acceleration times the median speed: squared, times the time in which it turns). Makes
table.md and results.json.

`one` counts the targets that exactly one track follows: for most of its time it is nearer to them
than to others. NEES is the mean of that of positions of `moment`, 2 where covariances are right,
of the smoothed and of the filtered ones. "Early" is the rms error of `moment` in the first 50 ms of
each track over that later. The cost is that of `find`, in CPU seconds per million events.

Scores are those of `jaxevent.blob.scores` at 200 times: a track and a target are one where they are
nearer than 2 sizes and 3 px.
"""

import importlib
import importlib.util
import json
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from blob_scenes import DISCS, MEETINGS, OBJECTS, SCENES, VARIED
from common import command_line, markdown_table
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from jaxevent.blob import TargetSearchResult, TrackStates, find, moment
from jaxevent.blob.scores import score_tracks
from jaxevent.blob.search.background import measure_background
from jaxevent.blob.search.detection import clutter_model, detect, measure_blobs
from jaxevent.blob.search.stream import Stream
from jaxevent.recording import Recording
from jaxevent.simulate.blobs import BlobTruth

NORFAIR = importlib.util.find_spec("norfair") is not None

Positions = NDArray[np.float64]  # (times, tracks, 2), NaN where a track is not
TIMES = 200
EARLY_US = 50_000


def found_paths(found: TargetSearchResult, times: NDArray[np.int64]) -> Positions:
    """Return positions of the paths that `find` gives, on straight lines between windows."""
    out = np.full((len(times), len(found), 2), np.nan)
    for k, path in enumerate(found.paths):
        now = (times >= path.begin) & (times < path.end)
        out[now, k] = path.at(times[now])
    return out


def track_targets(
    recording: Recording, found: TargetSearchResult, times: NDArray[np.int64]
) -> dict[str, TrackStates]:
    """Return the states of the default estimate, smoothed and filtered."""
    params = moment.Params(**found.settings())
    tracks = moment.estimate(recording, params, found=found, progress=False)
    return {"moment": tracks(times), "filter": tracks.filtered(times)}


def _centroids(recording: Recording, found: TargetSearchResult) -> Iterator[tuple[int, NDArray]]:
    """Iterate over time and centroids (n, 2) of the components of each event image."""
    if not found.passes:
        return
    scale = found.passes[0].selection.scale
    stream = Stream(recording, int(recording.start), int(recording.stop) + 1)
    background = measure_background(stream)
    for k in range(int(stream.duration / scale.window)):
        begin = k * scale.window
        part = stream.window(begin, begin + scale.window)
        clutter = clutter_model(background, scale, stream.shape, begin)
        labels, number = detect(part, clutter, stream.shape)
        blobs = measure_blobs(part, labels, number)
        yield stream.start + round(1e6 * (begin + scale.window / 2)), blobs.p[blobs.n >= 3]


class _Line(NamedTuple):
    t: list[int]
    p: list[NDArray]


def link_clusters(
    recording: Recording, found: TargetSearchResult, times: NDArray[np.int64]
) -> Positions:
    """Link components to the nearest one of the image before, within 30 px."""
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


def track_by_kalman(
    recording: Recording, found: TargetSearchResult, times: NDArray[np.int64]
) -> Positions:
    """Track by constant velocity and optimal assignment, 3 hits, 5 misses."""
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


def track_by_norfair(
    recording: Recording, found: TargetSearchResult, times: NDArray[np.int64]
) -> Positions:
    """Track by norfair with its own filter, 30 px, 3 hits, 5 misses."""
    library: Any = importlib.import_module("norfair")
    tracker = library.Tracker("euclidean", 30, hit_counter_max=5, initialization_delay=2)
    lines: dict[int, _Line] = {}
    for t, p in _centroids(recording, found):
        for one in tracker.update([library.Detection(points=q[None]) for q in p]):
            line = lines.setdefault(one.id, _Line([], []))
            line.t.append(t)
            line.p.append(np.asarray(one.estimate)[0])
    return _of_lines([one for one in lines.values() if len(one.t) > 1], times)


def track_by_means(
    recording: Recording, found: TargetSearchResult, truth: BlobTruth, times: NDArray[np.int64]
) -> Positions:
    """Follow each target by a centred mean, from its true position where it is first seen."""
    states, size = truth(times), (recording.width, recording.height)
    inside = ((states[..., :2] >= 0) & (states[..., :2] < size)).all(-1)
    seen = inside & truth.visible(times) & (states[..., 4] > 0.5).any(0)
    lines, events = [], recording.events
    window = round(1e6 * found.passes[0].selection.scale.window) if found.passes else 10_000
    for k in np.flatnonzero(seen.any(0)):
        first, line = seen[:, k].argmax(), _Line([], [])
        p, reach = states[first, k, :2], 3 * states[first, k, 4]
        for t in range(int(times[first]), int(times[-1]), max(window // 2, 1)):
            part = events[events.index(t - window // 2) : events.index(t + window // 2)]
            near = np.hypot(part.x - p[0], part.y - p[1]) < reach
            if near.sum() >= 3:
                p = np.array([part.x[near].mean(), part.y[near].mean()])
            line.t.append(t)
            line.p.append(p)
        lines.append(line)
    return _of_lines(lines, times)


def track_by_hand(recording: Recording, truth: BlobTruth, times: NDArray[np.int64]) -> Positions:
    """Track by `moment` from seeds with scales of the truth; Q_v is acceleration times speed."""
    states, t = truth(times), times
    seen = truth.visible(times)
    real = np.flatnonzero((states[..., 4] > 0.5).any(0) & seen.any(0))
    if not len(real):
        return np.full((len(times), 0, 2), np.nan)
    L = float(np.median(states[:, real, 4]))
    speed = float(np.median(np.hypot(*np.moveaxis(states[:, real, 2:4], 2, 0))))
    change = np.gradient(states[:, real, 2:4], t * 1e-6, axis=0)
    hard = float(np.sqrt((change**2).sum(-1).mean())) * speed
    W = float(np.clip(L / max(speed, 1e-9), 1e-3, 0.5))
    seeds = []
    for k in real:
        first = int(np.argmax(seen[:, k]))
        x, y = np.clip(states[first, k, :2], 0, (recording.width - 1, recording.height - 1))
        seeds.append((float(x), float(y), float(states[first, k, 4]), int(t[first])))
    rest: dict[str, Any] = {"lambda_max": 6 * L, "t_coast": 1e3, "t_merge": 1e3, "aspect_max": 1e3}
    params = moment.Params(
        Q_p=1e-4 * L**2 / W, Q_v=max(hard, 1e-4 * L**2 / W**3), Q_lambda=(0.05 * L) ** 2 / W,
        Q_theta=0.01 / W, Q_q=0.01 / W**3, P0_p=L**2 / 4, P0_v=4 * speed**2 + (L / W) ** 2,
        P0_lambda=(0.5 * L) ** 2, P0_q=(0.1 / W) ** 2, lambda0=L, gate_decay=1 / W,
        gate_min=max(2.0, 1.5 * L), gate_max=24 * L, t_still=2 * W, sigma_max=1e3,
        events_per_step=8, **rest,
    )  # fmt: skip
    tracks = moment.estimate(recording, params, seeds=seeds, progress=False)
    states = tracks(times)
    return np.where(states.valid[..., None], states.mean[..., :2], np.nan)


def _of_lines(lines: list[_Line], times: NDArray[np.int64]) -> Positions:
    out = np.full((len(times), len(lines), 2), np.nan)
    for k, one in enumerate(lines):
        now = (times >= one.t[0]) & (times <= one.t[-1])
        for axis in range(2):
            out[now, k, axis] = np.interp(times[now], one.t, np.array(one.p)[:, axis])
    return out


def score(
    answer: Positions, truth: BlobTruth, times: NDArray[np.int64], size: tuple[int, int]
) -> dict:
    """Return the scores that the module's docstring describes."""
    states = truth(times)
    states = states[:, (states[..., 4] > 0.5).any(0)]  # the others are hot pixels
    visible = truth.visible(times)[:, (truth(times)[..., 4] > 0.5).any(0)]
    inside = np.asarray(((states[..., :2] >= 0) & (states[..., :2] < size)).all(-1))
    paths = np.where(inside[..., None], states[..., :2], np.nan)
    told = score_tracks(paths, answer, 2 * states[..., 4] + 3, hidden=~visible)
    names = ("targets", "found", "tracks", "false", "covered", "rms", "idf1", "mota", "hota")
    distance = np.linalg.norm(paths[:, :, None] - answer[:, None], axis=-1)
    near = distance < (2 * states[..., 4] + 3)[..., None]
    least = np.where(near, distance, np.inf).min(1, keepdims=True, initial=np.inf)
    owned = (near & (distance == least)).sum(0)  # times at which a target is a track's nearest
    owner = owned == np.maximum(owned.max(0, initial=0), 0.05 * len(times))
    return {name: getattr(told, name) for name in names} | {"one": int((owner.sum(1) == 1).sum())}


def state_scores(
    states: TrackStates, truth: BlobTruth, times: NDArray[np.int64]
) -> dict[str, float]:
    """Return the mean NEES and the early error of tracks where they are near a target."""
    true = truth(times)
    e = states.mean[:, :, None, :2] - true[:, None, :, :2]
    distance = np.where(states.valid[..., None], np.hypot(e[..., 0], e[..., 1]), np.inf)
    row, track = np.nonzero((distance < 2 * true[:, None, :, 4] + 3).any(2))
    if not len(row):
        return {"nees": np.nan, "early": np.nan}
    nearest = distance[row, track].argmin(1)
    e, P = e[row, track, nearest], states.covariance[row, track][:, :2, :2]
    nees = float((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(1).mean())
    first = times[states.valid.argmax(0)]
    early = times[row] < first[track] + EARLY_US
    square = (e**2).sum(1)
    later = early.any() and not early.all()
    ratio = np.sqrt(square[early].mean() / square[~early].mean()) if later else np.nan
    return {"nees": nees, "early": float(ratio)}


def main() -> None:
    parser = command_line(__doc__, out=True)
    parser.add_argument("--scenes", nargs="+", help="default: all of SCENES")
    parser.add_argument("--search", action="store_true", help="only `find` and the baselines")
    parser.add_argument("--varied", action="store_true", help="all of VARIED instead")
    parser.add_argument("--objects", action="store_true", help="all of OBJECTS instead")
    parser.add_argument("--discs", action="store_true", help="all of DISCS instead")
    parser.add_argument("--meetings", action="store_true", help="all of MEETINGS instead")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    args = parser.parse_args()
    rows, scenes = [], SCENES | VARIED | OBJECTS | DISCS | MEETINGS
    chosen = OBJECTS if args.objects else VARIED if args.varied else SCENES
    chosen = MEETINGS if args.meetings else DISCS if args.discs else chosen
    find(SCENES["disc"](args.first)[0], progress=False)  # compiles
    for name in args.scenes or chosen:
        for seed in range(args.first, args.first + args.seeds):
            recording, truth = scenes[name](seed)
            times = np.linspace(0, truth.duration * 1e6 - 1, TIMES + 2)[1:-1].astype(np.int64)
            clock = time.process_time()
            found = find(recording, progress=False)
            seconds = time.process_time() - clock
            answers, of_states = {}, {}
            tracked = {} if args.search else track_targets(recording, found, times)
            for method, states in tracked.items():
                answers[method] = np.where(states.valid[..., None], states.mean[..., :2], np.nan)
                of_states[method] = state_scores(states, truth, times)
            answers |= {
                "find": found_paths(found, times),
                "clusters": link_clusters(recording, found, times),
                "kalman": track_by_kalman(recording, found, times),
                "mean": track_by_means(recording, found, truth, times),
            }
            if NORFAIR:
                answers["norfair"] = track_by_norfair(recording, found, times)
            if not args.search:
                answers["by hand"] = track_by_hand(recording, truth, times)
            for method, answer in answers.items():
                row = score(answer, truth, times, (recording.width, recording.height))
                row |= {"cost": 1e6 * seconds / len(recording.events)}
                row |= of_states.get(method, {"nees": np.nan, "early": np.nan})
                rows.append({"scene": name, "seed": seed, "method": method, "cpu": seconds} | row)
                print(
                    f"{name[:34]:34} {seed} {method:9}"
                    + " ".join(f"{key} {row[key]:.3g}" for key in row)
                    + (f" | {seconds:.1f} s {found.summary()}" if method == "find" else ""),
                    flush=True,
                )
        (args.out / "results.json").write_text(json.dumps(rows, indent=1))
        (args.out / "table.md").write_text(_table(rows))
    print(_table(rows))


def _table(rows: list[dict]) -> str:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = []
    for name in [*dict.fromkeys(row["scene"] for row in rows), "all"]:
        cells = []
        for method in methods:
            own = [r for r in rows if r["method"] == method and name in (r["scene"], "all")]
            found, targets = sum(r["found"] for r in own), sum(r["targets"] for r in own)
            errors = [r["rms"] for r in own if np.isfinite(r["rms"])]
            cells.append(
                f"{found}/{targets}, {sum(r['false'] for r in own)}, "
                f"{sum(r['one'] for r in own)}, {np.mean([r['idf1'] for r in own]):.2f}, "
                f"{np.mean(errors or [np.nan]):.2f}"
            )
        own = [r for r in rows if name in (r["scene"], "all")]
        more = [
            np.nanmedian([r[score] for r in own if r["method"] == method] or [np.nan])
            for score, method in (("nees", "moment"), ("nees", "filter"), ("early", "moment"))
        ]
        cost = np.median([r["cost"] for r in own])
        lines.append([name, *cells, *(f"{value:.2f}" for value in more), f"{cost:.1f}"])
    table = markdown_table(["scene", *methods, "NEES", "filtered", "early", "cost"], lines)
    return f"found, false tracks, with one track, IDF1, rms px\n\n{table}\n"


if __name__ == "__main__":
    main()
