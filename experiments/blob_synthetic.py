"""Blob tracking on simulated scenes with known states: all filters and two baselines, one table.

    python experiments/blob_synthetic.py --out blob_synthetic [--seeds 6] [--only a f]

(a) a turning ellipse at up to 2014 px/s, (b) growth by approach, (c) two lights and their inverse
time to contact, (d) background noise, (f) crossings, (g) drop-outs, (i) three cars at event
rate. Each track
is begun by a seed 5 px (one standard deviation along each axis) beside the truth, of about twice
the true size and at rest; those of (i) at the truth. States rest on the events up to each time,
smoothed ones of (i) on all.
Writes table.md and results.json. Done parts are kept in the folder and not repeated.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from common import command_line, machine, markdown_table, write_text

from jaxevent.blob import (
    Tracker,
    TrackerParams,
    Tracks,
    TrackStates,
    chi2,
    chi2_split,
    constant_velocity,
    moment,
    moving_moments,
)
from jaxevent.blob.quantities import inverse_ttc, size_range
from jaxevent.recording import Recording
from jaxevent.simulate import blob_scene
from jaxevent.simulate.blobs import CAR_MOTIONS, ApproachMotion, BlobTruth

CIRCLE, ELLIPSE = {"gate_shape": "circle"}, {"gate_shape": "ellipse"}
CONSTANT = "constant velocity, R = 64 px^2"
METHODS: dict[str, tuple[Tracker, dict[str, Any]]] = {
    "chi2, target 2n": (chi2, {"target": "2n", **CIRCLE}),
    "chi2, target 2n+4": (chi2, CIRCLE),
    "chi2_split": (chi2_split, ELLIPSE),
    "moment": (moment, ELLIPSE),
    "moment, circular gate": (moment, CIRCLE),
    "moment, M = 32": (moment, {"events_per_step": 32, **ELLIPSE}),
    "moving moments, 2 ms": (moving_moments, CIRCLE),
    CONSTANT: (constant_velocity, {"gate_min": 30.0, **CIRCLE}),
}
SETTLE = 0.1  # s, left out of all means
SHIFT = 5.0  # px, of seeds
FOCAL = 1000.0  # px, of the scenes


Chosen = tuple[Tracker, TrackerParams]


def choose(method: str, **values: Any) -> Chosen:
    """Return a tracker and its parameters, by its name in the table."""
    tracker, settings = METHODS[method]
    return tracker, tracker.Params(**{**settings, **values})


def track_targets(
    recording: Recording,
    truth: BlobTruth,
    chosen: Chosen,
    size: float,
    seed: int,
    start: float = 0.0,
    stop: float | None = None,
) -> Tracks:
    """Track all targets, each from a rough seed."""
    rng = np.random.default_rng([seed, 7])
    at = truth(start)[0]
    tracker, params = chosen
    size = 8.0 if tracker is constant_velocity else size
    xy = at[:, :2] + SHIFT * rng.normal(size=(len(at), 2))
    seeds = [(*p, size) for p in xy]
    return tracker.estimate(recording, params, seeds=seeds, start=start, stop=stop, smooth=False)


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    """Return the mean of e^T P^-1 e over the number of components; 1 if P is right."""
    if not covariance.any():  # a baseline that tells none
        return np.nan
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return float((error * solved).sum(-1).mean() / error.shape[-1])


def track_errors(states: TrackStates, true: np.ndarray, times: np.ndarray) -> dict[str, float]:
    """Return errors of the only track against the truth (times, 8) after `SETTLE`."""
    late = times >= SETTLE
    mean, alive = states.mean[late, 0].astype(float), states.valid[late, 0]
    P, true = states.covariance[late, 0].astype(float), true[late]
    last = np.linalg.norm(mean[-12:, :2] - true[-12:, :2], axis=1)
    lost = float(not (alive.all() and np.median(last) < 20))
    mean, P, true = mean[alive], P[alive], true[alive]
    # Pixels add 1/12 px^2 to the events' variances.
    e = mean - true
    size = np.sqrt(true[:, 4:6] ** 2 + 1 / 12)
    ratio = mean[:, 4:6] / size
    turn = np.mod(e[:, 6] + np.pi / 2, np.pi) - np.pi / 2
    return {
        "rmse": float(np.sqrt((e[:, :2] ** 2).sum(1).mean())),
        "velocity": float(np.sqrt((e[:, 2:4] ** 2).sum(1).mean())),
        "bias1": 100 * float(ratio[:, 0].mean() - 1),
        "bias2": 100 * float(ratio[:, 1].mean() - 1),
        "theta": float(np.rad2deg(np.sqrt((turn**2).mean()))),
        "nees_p": nees(e[:, :2], P[:, :2, :2]),
        "nees_l": nees(mean[:, 4:6] - size, P[:, 4:6, 4:6]),
        "lost": lost,
    }


def settling_time(tracks: Tracks, truth: BlobTruth) -> float:
    """ms until both sizes are within 20 % of the truth and stay so for 2 ms."""
    times = np.concatenate([np.arange(0, 6_000, 100), np.arange(6_000, 30_000, 500)])
    times = times[times >= tracks.start]
    true = truth(times)[:, 0, 4:6]
    off = np.any(abs(tracks(times).mean[:, 0, 4:6] / true - 1) > 0.2, axis=1)
    for at in times[:-4]:
        if not off[(times >= at) & (times <= at + 2_000)].any():
            return float(at * 1e-3)
    return np.inf


def size_range_of(states: TrackStates, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Range of the first track, m, and its variance."""
    mean, covariance = jnp.asarray(states.mean[:, 0]), jnp.asarray(states.covariance[:, 0])
    value, variance = size_range(mean, covariance, extent, FOCAL, 0.25)
    return np.asarray(value, float), np.asarray(variance, float)


def inverse_contact_time(states: TrackStates) -> tuple[np.ndarray, np.ndarray]:
    """1 / TTC of the first two tracks, 1/s, and its variance."""
    told = [jnp.asarray(a[:, k]) for k in (0, 1) for a in (states.mean, states.covariance)]
    value, variance = inverse_ttc(*told)
    return np.asarray(value, float), np.asarray(variance, float)


def average_runs(runs: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Means over seeds, standard errors under the key + " se"; of "settled" the median."""
    row: dict[str, Any] = {"runs": len(runs)}
    for name in runs[0]:
        values = np.array([run[name] for run in runs], float)
        row[name] = float(np.median(values) if name == "settled" else values.mean())
        if name == "lost":
            row[name] = int(values.sum())
        elif len(values) > 1 and np.isfinite(values).all():
            row[f"{name} se"] = float(values.std(ddof=1) / np.sqrt(len(values)))
    return row


def score_methods(
    scene: Callable[[int], tuple[Recording, BlobTruth]],
    methods: Sequence[str],
    seeds: Sequence[int],
    size: float = 20.0,
    step: float = 4e-3,
    start_up: bool = False,
    **values: Any,
) -> dict[str, dict[str, Any]]:
    """`average_runs` measures of each method; with `start_up` also how soon the shape is right."""
    runs: dict[str, list[dict[str, float]]] = {method: [] for method in methods}
    for seed in seeds:
        recording, truth = scene(seed)
        times = np.arange(step, truth.duration - step, step)
        true = truth(times)[:, 0]
        for method in methods:
            tracks = track_targets(recording, truth, choose(method, **values), size, seed)
            run = track_errors(tracks(times), true, times)
            if start_up:
                run["settled"] = settling_time(tracks, truth)
            runs[method].append(run)
    return {method: average_runs(rows) for method, rows in runs.items()}


def lissajous(seeds: Sequence[int]) -> dict[str, Any]:
    return score_methods(lambda s: blob_scene("lissajous", s), list(METHODS), seeds, start_up=True)


def noise(seeds: Sequence[int]) -> dict[str, Any]:
    rows: dict[str, Any] = {}
    for ratio in (0.1, 0.5, 1.0, 10.0):
        methods = [m for m in METHODS if m not in ("chi2, target 2n+4", "moment, M = 32")]
        scene = lambda s, ratio=ratio: blob_scene("noise", s, ratio=ratio)  # noqa: E731
        few = seeds[: 2 if ratio < 10 else 1]
        for method, row in score_methods(scene, methods, few, step=8e-3).items():
            rows[f"{ratio:g} | {method}"] = row
    return rows


def growing(seeds: Sequence[int]) -> dict[str, Any]:
    rows: dict[str, list[dict[str, float]]] = {m: [] for m in METHODS if m != CONSTANT}
    times = np.arange(0.004, 1.498, 0.004)
    for seed in seeds:
        recording, truth = blob_scene("growing", seed)
        motion = truth.targets[0].motion
        assert isinstance(motion, ApproachMotion)
        depth = motion.depth(times)
        for method in rows:
            tracks = track_targets(recording, truth, choose(method), 8.0, seed)
            states = tracks(times)
            run = track_errors(states, truth(times)[:, 0], times)
            distance, variance = size_range_of(states, max(motion.extent))
            good = (times >= SETTLE) & states.valid[:, 0]
            relative = (distance / depth - 1)[good]
            run["range bias"] = 100 * relative.mean()
            run["range rms"] = 100 * float(np.sqrt((relative**2).mean()))
            run["range nees"] = float((((distance - depth) ** 2) / variance)[good].mean())
            rows[method].append(run)
    return {method: average_runs(runs) for method, runs in rows.items()}


def contact(seeds: Sequence[int]) -> dict[str, Any]:
    left = ("chi2, target 2n", "chi2_split", "moment", "moment, circular gate", "moment, M = 32")
    rows: dict[str, list[dict[str, float]]] = {m: [] for m in (*left, *list(METHODS)[-2:])}
    times = np.arange(0.01, 3.445, 0.01)
    late = times >= 3 * SETTLE  # the preset averages over tenths of a second
    for seed in seeds[:3]:
        recording, truth = blob_scene("ttc", seed)
        motion = truth.targets[0].motion
        assert isinstance(motion, ApproachMotion)
        true = (motion.speed + motion.acceleration * times) / motion.depth(times)
        for method in rows:
            chosen = choose(method, preset="ttc")
            states = track_targets(recording, truth, chosen, 10.0, seed)(times)
            value, variance = (part[late] for part in inverse_contact_time(states))
            error = value - true[late]
            rows[method].append(
                {
                    "bias": float(np.nanmean(error)),
                    "rms": float(np.sqrt(np.nanmean(error**2))),
                    "nees": float(np.nanmean(error**2 / variance)),
                    "lost": float(not states.valid.all()),
                }
            )
    return {method: average_runs(runs) for method, runs in rows.items()}


def cars(seeds: Sequence[int]) -> dict[str, Any]:
    """Measure errors of 1 / TTC of each car at every event of its lights."""
    runs: dict[str, list[dict[str, float]]] = {}
    params = moment.Params(preset="ttc", lambda0=6.0, events_per_step=8, P0_p=1.0, P0_v=1e4)
    for seed in seeds[:2]:
        recording, truth = blob_scene("cars", seed, rate=6e4)
        points = [(*state[:2], 6.0) for state in truth(0.0)[0]]
        tracks = moment.estimate(recording, params, seeds=points)
        window = (1.0, 1.2)
        whose = np.concatenate([one.id for one in tracks.events(*window)])
        t = np.concatenate([one.t for one in tracks.events(*window)])
        for car, (_, distance, speed, acceleration) in enumerate(CAR_MOTIONS):
            pair = 2 * car, 2 * car + 1
            every = np.unique(t[np.isin(whose, pair)])
            for name, told in (("smoothed", tracks), ("filtered", tracks.filtered)):
                row = {"updates": len(every) / (window[1] - window[0])}
                row["rate"] = np.isin(whose, pair).sum() / (window[1] - window[0])
                for part, times in (
                    ("zoom", every),
                    ("whole", np.arange(300_000, 1_990_000, 5000)),
                ):
                    value, _ = inverse_contact_time(told(times, pair))
                    s = times * 1e-6
                    true = (speed + acceleration * s) / (
                        distance - speed * s - acceleration * s**2 / 2
                    )
                    row[part] = float(np.sqrt(np.mean((value - true) ** 2)))
                runs.setdefault(f"{'left middle right'.split()[car]} | {name}", []).append(row)
    return {name: average_runs(rows) for name, rows in runs.items()}


RUNS = 20  # of crossings and drop-outs


def crossings(seeds: Sequence[int]) -> dict[str, Any]:
    """Count the runs after which each track is near its own target."""
    rows: dict[str, Any] = {}
    for offset in (0.0, 10.0, 20.0):
        kept: dict[str, int] = {}
        for seed in range(seeds[0], seeds[0] + RUNS):
            recording, truth = blob_scene("crossing", seed, offset=offset)
            true = truth(0.55)[0]
            for rule in ("nearest", "soft"):
                for method in ("moment", "moment, M = 32") if offset == 0 else ("moment, M = 32",):
                    chosen = choose(method, association=rule)
                    tracks = track_targets(recording, truth, chosen, 20.0, seed)
                    d = np.linalg.norm(tracks(0.55).mean[0, :, :2] - true[:, :2], axis=1)
                    name = f"{method}, {rule}"
                    kept[name] = kept.get(name, 0) + int((d < 20).all())
        rows[f"{offset:g}"] = {"runs": RUNS, **kept}
    return rows


def dropouts(seeds: Sequence[int]) -> dict[str, Any]:
    """Drop events at a random place where the target is faster than 1900 px/s."""
    rows: dict[str, Any] = {}
    names = ("moment", "moment, M = 32", *list(METHODS)[-2:])
    for length in (0.05, 0.1):
        got = {name: 0 for name in names}
        back: dict[str, list[float]] = {name: [] for name in names}
        for seed in range(seeds[0], seeds[0] + RUNS):
            at = np.random.default_rng([seed, 3]).uniform(0.59, 0.79 - length)
            recording, truth = blob_scene("dropout", seed, length=length, at=at)
            for name in names:
                chosen = choose(name, t_coast=0.3)
                tracks = track_targets(
                    recording, truth, chosen, 20.0, seed, at - 0.2, at + length + 0.1
                )
                times = np.array([at + length, at + length + 0.05])
                d = np.linalg.norm(tracks(times).mean[:, 0, :2] - truth(times)[:, 0, :2], axis=1)
                got[name] += bool(d[1] < 5)
                back[name].append(float(d[0]))
        for name in names:
            error = float(np.median(back[name]))
            rows[f"{1e3 * length:g} ms | {name}"] = {
                "runs": RUNS, "recovered": got[name], "error at return": error
            }  # fmt: skip
    return rows


SECTIONS: dict[str, tuple[str, Callable[[Sequence[int]], dict[str, Any]]]] = {
    "a": ("a blob of (10, 5) px at up to 2014 px/s, turning, 100,000 events/s", lissajous),
    "b": ("growing from 3.5 to 12 px: 17 m to 5 m at 8 m/s", growing),
    "c": ("inverse time to contact of two lights, 0.08 to 0.67 1/s, preset ttc", contact),
    "d": ("background events, as a multiple of the blob's", noise),
    "f": ("two blobs crossing at 1200 px/s: runs in which both keep their track", crossings),
    "g": ("drop-outs at 1900 to 2014 px/s: runs in which the target is found again", dropouts),
    "i": ("three cars, two lights each: 1 / TTC at every event", cars),
}  # fmt: skip

HEADER = (
    "", "rmse px", "velocity px/s", "bias 1, 2 %", "theta deg",
    "settled ms", "NEES p/2", "NEES l/2", "lost",
)  # fmt: skip


def line(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    ms = row.get("settled")
    return (
        name,
        f"{row['rmse']:.3f}",
        f"{row['velocity']:.0f}",
        f"{row['bias1']:+.1f}, {row['bias2']:+.1f}",
        f"{row['theta']:.1f}",
        "" if ms is None else f"{ms:.1f}",
        f"{row['nees_p']:.2f}",
        f"{row['nees_l']:.2f}",
        f"{row['lost']} / {row['runs']}",
    )


def pm(row: dict[str, Any], name: str, digits: int) -> str:
    return f"{row[name]:.{digits}f} ± {row[name + ' se']:.{digits}f}"


def table(letter: str, rows: dict[str, Any]) -> str:
    if letter == "b":
        return markdown_table(
            ("", "range bias %", "range rms %", "NEES range", "rmse px", "lost"),
            [
                (m, pm(r, "range bias", 1), pm(r, "range rms", 1), f"{r['range nees']:.2f}",
                 f"{r['rmse']:.3f}", f"{r['lost']} / {r['runs']}")
                for m, r in rows.items()
            ],
        )  # fmt: skip
    if letter == "c":
        return markdown_table(
            ("", "bias 1/s", "rms 1/s", "NEES", "lost"),
            [
                (m, pm(r, "bias", 3), pm(r, "rms", 3), f"{r['nees']:.2f}", f"{r['lost']}")
                for m, r in rows.items()
            ],
        )
    if letter == "i":
        return markdown_table(
            ("car", "", "events/s of its lights", "different times/s",
             "rms 1/s, each event of 0.2 s", "rms 1/s, 0.3 to 2 s"),
            [
                (*k.split(" | "), f"{r['rate']:,.0f}", f"{r['updates']:,.0f}", f"{r['zoom']:.4f}",
                 f"{r['whole']:.4f}")
                for k, r in rows.items()
            ],
        )  # fmt: skip
    if letter == "f":
        names = [name for name in rows["0"] if name != "runs"]
        body = [
            (n, *(f"{r[n]} / {r['runs']}" if n in r else "" for r in rows.values())) for n in names
        ]
        return markdown_table(("", *(f"offset {k} px" for k in rows)), body)
    if letter == "g":
        body = [
            (*k.split(" | "), f"{r['recovered']} / {r['runs']}", f"{r['error at return']:.1f}")
            for k, r in rows.items()
        ]
        return markdown_table(("pause", "", "recovered", "error at return, px, median"), body)
    header = ("noise", *HEADER) if letter == "d" else HEADER
    body = [(*key.split(" | "), *line("", row)[1:]) for key, row in rows.items()]
    return markdown_table(header, body)


def main() -> int:
    parser = command_line(__doc__, out=True, parts=SECTIONS)
    parser.add_argument("--seeds", type=int, default=6, help="recordings of each scene")
    parser.add_argument("--first-seed", type=int, default=1000)
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    kept = arguments.out / "results.json"
    about: dict[str, Any] = {"machine": machine(), "seeds": [seeds[0], seeds[-1]]}
    results: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    if results and results["seeds"] != about["seeds"]:
        raise SystemExit(f"{kept} is of seeds {results['seeds']}; give another folder or remove it")
    results = {**results, **about}
    for letter in arguments.only:
        if letter in results:
            continue
        begin = time.perf_counter()
        results[letter] = SECTIONS[letter][1](seeds)
        write_text(kept, json.dumps(results, indent=1) + "\n")
        print(
            f"\n({letter}) {time.perf_counter() - begin:.0f} s\n\n{table(letter, results[letter])}"
        )
        sys.stdout.flush()
    text = [f"{about['machine']}; seeds {seeds[0]} to {seeds[-1]} ({RUNS} runs of f and g).\n"]
    text += [
        f"({letter}) {title}\n\n{table(letter, results[letter])}\n"
        for letter, (title, _) in SECTIONS.items()
        if letter in results
    ]
    write_text(arguments.out / "table.md", "\n".join(text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
