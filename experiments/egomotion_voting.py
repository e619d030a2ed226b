"""Motion by voting on simulated sequences with known motion, the thesis' literal likelihood beside.

    python experiments/egomotion_voting.py --out egomotion_voting [--seeds 10] [--first 100]
        [--only planar,frames,figures,limits,edges,rotation,penalty,general]

An ideal event camera of 160 x 120 pixels, f = 200 px, and the thesis' generator of frames 50 us
apart on 32 x 32 pixels. Parameters are the defaults and the presets of `voting.Params`, which were
chosen on seeds 0 to 9. Errors are means over a sequence after its start-up of 200 ms (100 frames),
in three readings: "at once", as the filter tells it; "fixed lag", when what is told counts for the
time that the candidates show; "smoothed", after a backward pass over the whole sequence
(`smoothed`). A run is lost if the filter says so at any time after the start-up, or if its
mean error is 50 % or more. Start-up is until the filter first says that it has found the motion.
Writes a table of every part as Markdown and CSV.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench import machine
from numpy.typing import NDArray

from jaxevent.egomotion import voting
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter.filtering import smooth
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.scores import axis_error, relative_error, relative_magnitude_error
from jaxevent.io.output import complete
from jaxevent.recording import Recording
from jaxevent.simulate import motion_scene
from jaxevent.simulate.motion import MovingCamera, simulate_frame_events

Row = dict[str, Any]
Table = tuple[str, list[Row]]

SIZE, DURATION, SETTLE = (160, 120), 0.6, 0.2  # px, s, s
STEP = 50e-6  # s, of frames
FRAMES, SETTLE_FRAMES = 300, 100
TEXTURES = ("noise", "shapes")
SOFT: Row = {}
LITERAL: Row = {"preset": "literal"}
LATEST: Row = {"preset": "literal_latest"}
# In the generator the predecessor was one frame, of up to 3 px, ago.
LITERAL_FRAMES: Row = {
    **Params.presets["frames"],
    **Params.presets["literal"],
    "radius": 4,
    "candidates": 81,
    "every": 4,
    "batch": 32,
    "longest": 2e-4,
    "speed_max": 5e4,
    "tau_max": 4e-4,
    "noise": 4.0,
    "horizon": "fixed",
    "past": STEP,
}


def planar(motion: str, seed: int, texture: str, speed: float = 200.0) -> tuple[Recording, Any]:
    """A sequence, and its image velocity at times (s); fast ones are cut short."""
    duration = DURATION if speed < 400 else 0.35
    recording, source = motion_scene(
        "planar", motion, seed, size=SIZE, duration=duration, texture=texture, speed=speed
    )
    return recording, (source.velocity, duration)


def errors(
    motion: MotionEstimate,
    params: Params,
    truth: Callable[[NDArray], NDArray],
    times: NDArray[np.floating],
) -> dict[str, float]:
    """Mean relative errors, %, in three readings, and whether the run is lost."""
    true = truth(times)
    smoothed = smooth(motion, params)
    told = {
        "at once": motion(times, extrapolate=True),
        "fixed lag": motion(times, centred=True, extrapolate=True),
        "smoothed": smoothed(times, extrapolate=True),
    }
    scores = {name: 100 * float(relative_error(s.mean, true).mean()) for name, s in told.items()}
    mean = told["smoothed"].mean
    scores["bias"] = 100 * float((((mean - true) * true).sum(1) / (true**2).sum(1)).mean())
    if true.shape[1] == 3:
        for name, states in told.items():
            scores[f"AME_rel {name}"] = 100 * float(
                relative_magnitude_error(states.mean, true).mean()
            )
            scores[f"AAE {name}"] = float(axis_error(states.mean, true).mean())
    found = np.flatnonzero(motion.valid)
    scores["start-up"] = 1e-3 * float(motion.t[found[0]]) if len(found) else np.nan
    scores["lost"] = float((~told["at once"].valid).any() or scores["smoothed"] >= 50)
    return scores


def summary(runs: Sequence[dict[str, float]], names: Iterable[str], prefix: str = "") -> Row:
    """Means, and of all but lost runs the worst."""
    row: Row = {}
    for name in names:
        values = np.array([run[name] for run in runs])
        if name == "lost":
            row[prefix + name] = f"{int(values.sum())} of {len(values)}"
        else:
            row[prefix + name] = float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
            row[f"{prefix}{name}, worst"] = float(np.nanmax(values, initial=-np.inf))
    return row


FULL = ("at once", "fixed lag", "smoothed", "lost", "start-up")
SHORT = ("at once", "smoothed", "lost")


def both(
    sequences: Sequence[tuple[Recording, Any]],
    first: int,
    soft: Row | None = SOFT,
    literal: Row | None = LITERAL,
    *,
    names: Sequence[str] = FULL,
    model: str = "planar",
) -> Row:
    """Both likelihoods on the same sequences, side by side."""
    row: Row = {}
    for prefix, settings, chosen in (("", soft, names), ("literal ", literal, SHORT)):
        if settings is None:
            continue
        params, runs = Params.of(settings), []
        for k, (recording, (truth, duration)) in enumerate(sequences):
            motion = voting.estimate(recording, params, model=model, seed=first + k)
            times = np.arange(SETTLE, duration - 1e-6, 0.005)
            runs.append(errors(motion, params, truth, times))
        row |= summary(runs, chosen, prefix)
    return row


def part_planar(seeds: range) -> list[Table]:
    rows = []
    for change in ("constant", "linear", "varying"):
        for texture in TEXTURES:
            made = [planar(change, seed, texture) for seed in seeds]
            rows.append({"motion": change, "texture": texture, **both(made, seeds[0])})
            print(f"planar {change} {texture}", file=sys.stderr)
    return [("planar: relative AEE (%), 200 px/s; start-up (ms)", rows)]


def flows() -> dict[str, NDArray[np.float64]]:
    """px/frame."""
    k = np.arange(FRAMES)[:, None]
    straight = {
        f"({u}, {v})": np.tile([u, v], (FRAMES, 1)) for u, v in ((0.8, 0.0), (0.8, 0.6), (1.5, 0.5))
    }
    return {
        **straight,
        "linear, 0.5 to 1.5 of (1, 0.5)": np.array([1.0, 0.5]) * (0.5 + k / FRAMES),
        "(1.3, 0.6) +- 35 %, period 200": np.array([1.3, 0.6])
        * (1 + 0.35 * np.sin(2 * np.pi * k / 200)),
    }


def in_frames(
    flow: NDArray[np.float64], seeds: range, settings: Row, names: Sequence[str], **made: Any
) -> Row:
    """Errors in the thesis' generator; start-up in frames."""
    params, runs, fill = Params.of(settings), [], []
    for seed in seeds:
        recording, velocity = simulate_frame_events(flow, seed=seed, **made)
        motion = voting.estimate(recording, params, seed=seed)
        frame = np.arange(SETTLE_FRAMES, len(flow) - 1)
        frame = frame[(frame + 1) * STEP <= motion.t[-1] * 1e-6]
        scores = errors(motion, params, lambda _, v=velocity, at=frame: v[at], (frame + 1) * STEP)
        scores["start-up"] /= 1e3 * STEP
        runs.append(scores)
        fill.append(len(recording.events) / (len(flow) * recording.width * recording.height))
    prefix = "literal " if params.likelihood == "literal" else ""
    return {"fill, %": 100 * float(np.mean(fill)), **summary(runs, names, prefix)}


def part_frames(seeds: range) -> list[Table]:
    rows = []
    for name, flow in flows().items():
        soft = in_frames(flow, seeds, {"preset": "frames"}, FULL)
        literal = in_frames(flow, seeds, LITERAL_FRAMES, SHORT)
        rows.append({"motion, px/frame": name, **soft, **literal})
        print(f"frames {name}", file=sys.stderr)
    return [("frame generator: relative AEE (%); start-up (frames)", rows)]


def part_figures(seeds: range) -> list[Table]:
    seeds = seeds[: max(1, len(seeds) // 3)]
    made = {
        (change, texture): [planar(change, seed, texture) for seed in seeds]
        for change in ("constant", "varying")
        for texture in TEXTURES
    }
    penalty, number, speed, density = [], [], [], []
    for (change, texture), sequences in made.items():
        row: Row = {"motion": change, "texture": texture}
        row["soft vote"] = both(sequences, seeds[0], literal=None)["smoothed"]
        for r_t in (0.0, 1e2, 1e3, 1e4, 1e5):
            told = both(sequences, seeds[0], None, {**LITERAL, "r_t": r_t})
            row[f"literal, r_t = {r_t:g} px/s"] = told["literal smoothed"]
        penalty.append(row)
    for N in (25, 50, 100, 200, 400):
        row = {"N": N}
        for texture in TEXTURES:
            sequences = made["varying", texture]
            settings = {"particles": N}
            told = both(sequences, seeds[0], settings, {**LITERAL, **settings}, names=SHORT)
            row |= {f"{texture}: {name}": value for name, value in told.items()}
        number.append(row)
    print("figures: r_t, N", file=sys.stderr)
    for pace in (60.0, 125.0, 250.0, 500.0, 1000.0):
        row = {"px/s": pace}
        wide = {"speed_max": 1500.0}
        for texture in TEXTURES:
            sequences = [planar("constant", seed, texture, pace) for seed in seeds]
            told = both(sequences, seeds[0], wide, {**LITERAL, **wide}, names=SHORT)
            row |= {f"{texture}: {name}": value for name, value in told.items()}
        speed.append(row)
    for pace in (0.4, 0.8, 1.5, 3.0):
        flow = np.tile([0.8 * pace, 0.6 * pace], (FRAMES, 1))
        row = {"px/frame": pace}
        row |= in_frames(flow, seeds, {"preset": "frames"}, SHORT)
        row |= in_frames(flow, seeds, LITERAL_FRAMES, SHORT)
        speed.append(row)
    print("figures: speed", file=sys.stderr)
    flow = np.tile([0.8, 0.0], (FRAMES, 1))
    for threshold in (0.4, 0.3, 0.2, 0.1, 0.05):
        row = {"threshold": threshold}
        row |= in_frames(flow, seeds, {"preset": "frames"}, SHORT, threshold=threshold)
        row |= in_frames(flow, seeds, LITERAL_FRAMES, SHORT, threshold=threshold)
        density.append(row)
    print("figures: texture", file=sys.stderr)
    return [
        ("penalty of time r_t (figure 5.7): smoothed relative AEE (%)", penalty),
        ("particles N, 200 +- 100 px/s at 2 Hz: relative AEE (%)", number),
        ("speed, ideal camera (figure 5.13): relative AEE (%)", speed[:5]),
        ("speed, frame generator (figure 5.13): relative AEE (%)", speed[5:]),
        ("texture, frame generator, (0.8, 0) px/frame (figure 5.15): relative AEE (%)", density),
    ]


def part_limits(seeds: range) -> list[Table]:
    """Figures 5.12 and 5.13, in the thesis' generator."""
    k = np.arange(FRAMES)
    change, speed = [], []
    for p in (0.25, 0.5, 1.0, 1.4):
        flow = np.stack([1.5 + p * np.cos(2 * np.pi * k / 100), np.zeros(FRAMES)], 1)
        row: Row = {"p, px/frame": p, "most, px/frame^2": p * 2 * np.pi / 100}
        row |= in_frames(flow, seeds, {"preset": "frames"}, SHORT)
        change.append(row | in_frames(flow, seeds, LITERAL_FRAMES, SHORT))
    print("limits: amplitude", file=sys.stderr)
    for u in (1.0, 3.0, 5.0, 8.0, 12.0):
        flow = np.tile([u, 0.0], (FRAMES, 1))
        row = {"u, px/frame": u}
        # Without faster first particles a search would end at 2.5 px/frame.
        wide: Row = {"speed_max": 3e5}
        row |= in_frames(flow, seeds, {"preset": "frames", **wide}, SHORT)
        row |= in_frames(flow, seeds, {**LITERAL_FRAMES, **wide}, SHORT)
        far: Row = {**LITERAL_FRAMES, **wide, "radius": 13, "candidates": 729}
        told = in_frames(flow, seeds, far, SHORT)
        row |= {f"{name}, radius 13": value for name, value in told.items() if name != "fill, %"}
        speed.append(row)
    return [
        ("(1.5 + p cos(2 pi k / 100), 0) px/frame (figure 5.12): relative AEE (%)", change),
        ("(u, 0) px/frame (figure 5.13): relative AEE (%)", speed),
    ]


def part_edges(seeds: range) -> list[Table]:
    """Edges left out of the literal vote's candidates (section 6.6.5)."""
    rows = []
    for texture in TEXTURES:
        made = [planar("constant", seed, texture) for seed in seeds]
        for edge in (0.0, 1e-3, 3e-3, 1e-2):
            row: Row = {"texture": texture, "edge, ms": 1e3 * edge}
            row |= both(made, seeds[0], None, {**LITERAL, "edge": edge})
            rows.append(row)
        print(f"edges {texture}", file=sys.stderr)
    return [("edges across the motion left out (section 6.6.5): relative AEE (%)", rows)]


def part_rotation(seeds: range) -> list[Table]:
    ways = {"soft vote": SOFT, "literal": LATEST, "literal, r_t = 0": {**LATEST, "r_t": 0.0}}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for seed in seeds:
        recording, source = motion_scene("rotation", "constant", seed, size=SIZE, duration=0.4)
        times = np.arange(SETTLE, source.duration - 1e-6, 0.005)
        for name, settings in ways.items():
            params = Params.of(settings)
            motion = voting.estimate(recording, params, model="rotation", seed=seed)
            runs[name].append(errors(motion, params, lambda t, s=source: s.twist(t)[1], times))
        print(f"rotation {seed}", file=sys.stderr)
    rows = []
    for name, scores in runs.items():
        for reading in ("at once", "smoothed"):
            row: Row = {"likelihood": name, "reading": reading}
            for title, key in (
                ("vector error, %", reading),
                ("AME_rel, %", f"AME_rel {reading}"),
                ("AAE, degrees", f"AAE {reading}"),
            ):
                told = summary(scores, [key])
                row |= {title: told[key], f"{title}, worst": told[f"{key}, worst"]}
            rows.append(row | summary(scores, ("lost", "start-up")))
    return [("rotation, 2 rad/s", rows)]


def part_penalty(seeds: range) -> list[Table]:
    """Table 6.2, of rotation: general motion by one particle filter finds no heading."""
    weights = (0.0, 1e4, 1.5e4, 2e4, 2.5e4)  # px/s
    runs: dict[float, list[dict[str, float]]] = {r_t: [] for r_t in weights}
    for seed in seeds:
        recording, source = motion_scene("rotation", "constant", seed, size=SIZE, duration=0.3)
        times = np.arange(SETTLE, source.duration - 1e-6, 0.005)
        for r_t in weights:
            params = Params.of({**LATEST, "r_t": r_t})
            motion = voting.estimate(recording, params, model="rotation", seed=seed)
            runs[r_t].append(errors(motion, params, lambda t, s=source: s.twist(t)[1], times))
    names = ("AAE smoothed", "AME_rel smoothed", "smoothed", "lost")
    rows = [{"r_t, px/s": r_t, **summary(found, names)} for r_t, found in runs.items()]
    return [("rotation, 2 rad/s, the literal likelihood (table 6.2): AAE (deg), others %", rows)]


def part_general(seeds: range) -> list[Table]:
    rows = []
    ways: dict[str, Row] = {
        "soft vote, half-line": {"preset": "general"},
        "literal": {**LATEST, "particles": 500, "every": 32, "alpha_literal": 0.3},
    }
    ways["literal, r_t = 0"] = {**ways["literal"], "r_t": 0.0}
    for scene in ("wall", "shapes", "texture"):
        made = [
            motion_scene(scene, "constant", seed, size=SIZE, duration=0.5) for seed in seeds[:3]
        ]
        for name, settings in ways.items():
            runs = [general(recording, source, settings, k) for k, (recording, source) in
                    enumerate(made)]  # fmt: skip
            row: Row = {"scene": scene, "likelihood": name}
            for key in ("heading, degrees", "Omega, %", "lost, % of the time"):
                row |= {f"{key}, seed {s}": run[key] for s, run in zip(seeds, runs, strict=False)}
            rows.append(row)
        print(f"general {scene}", file=sys.stderr)
    return [("general motion, one particle filter over heading and Omega", rows)]


def general(recording: Recording, source: MovingCamera, settings: Row, seed: int) -> dict:
    times = np.arange(0.25, source.duration - 1e-6, 0.005)
    motion = voting.estimate(recording, Params.of(settings), model="general", seed=seed)
    told, (T, Omega) = motion(times, extrapolate=True), source.twist(times)
    return {
        "heading, degrees": float(axis_error(told.mean[:, :3], T).mean()),
        "Omega, %": 100 * float(relative_error(told.mean[:, 3:], Omega).mean()),
        "lost, % of the time": 100 * float((~told.valid).mean()),
    }


PARTS: dict[str, Callable[[range], list[Table]]] = {
    "planar": part_planar,
    "frames": part_frames,
    "figures": part_figures,
    "limits": part_limits,
    "edges": part_edges,
    "rotation": part_rotation,
    "penalty": part_penalty,
    "general": part_general,
}


def markdown(title: str, rows: Sequence[Row]) -> str:
    def shown(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [f"### {title}", "", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(shown(row.get(c, "")) for c in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="sequences of each kind")
    parser.add_argument("--first", type=int, default=100, help="the first one's seed")
    parser.add_argument("--only", help=f"some of {','.join(PARTS)}")
    parser.add_argument("--out", type=Path, help="folder for table.md and one CSV a table")
    arguments = parser.parse_args()
    parts = arguments.only.split(",") if arguments.only else list(PARTS)
    if unknown := [name for name in parts if name not in PARTS]:
        parser.error(f"there is no part {unknown[0]}; choose from {', '.join(PARTS)}")
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    text = f"{machine()}; seeds {seeds[0]} to {seeds[-1]}\n\n"
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
    for part in parts:
        began = time.perf_counter()
        for number, (title, rows) in enumerate(PARTS[part](seeds), start=1):
            text += markdown(title, rows) + "\n"
            print(markdown(title, rows), flush=True)
            if arguments.out:
                with complete(arguments.out / f"{part}_{number}.csv") as path:
                    with path.open("w", newline="") as file:
                        names = list(dict.fromkeys(name for row in rows for name in row))
                        writer = csv.DictWriter(file, names)
                        writer.writeheader()
                        writer.writerows(rows)
        print(f"{part}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
    if arguments.out:
        with complete(arguments.out / "table.md") as path:
            path.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
