"""Motion by voting on simulated sequences with known motion, the thesis' literal likelihood beside.

    python experiments/egomotion_voting.py --out egomotion_voting [--seeds 10] [--first 100]
        [--only planar frames rotation penalty]

An ideal event camera of 160 x 120 pixels, f = 200 px, and the thesis' generator of frames 50 us
apart on 32 x 32 pixels. Parameters are the defaults and the presets of `voting.Params`, which were
chosen on seeds 0 to 9. Errors are means over a sequence after its start-up of 200 ms (100 frames),
in three readings: "at once", as the filter tells it; "fixed lag", when what is told counts for the
time that the candidates show; "smoothed", after a backward pass over the whole sequence
(`smoothed`). A run is lost if the filter says so at any time after the start-up, or if its
mean error is 50 % or more. Start-up is until the filter first says that it has found the motion.
Writes a table of every part.
"""

import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from common import command_line, machine, table_of_rows, write_text
from numpy.typing import NDArray

from jaxevent.egomotion import voting
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter.filtering import smooth
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.scores import axis_error, relative_error, relative_magnitude_error
from jaxevent.recording import Recording
from jaxevent.simulate import motion_scene
from jaxevent.simulate.motion import simulate_frame_events

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
    """Return a sequence, and its image velocity at times (s); fast ones are cut short."""
    duration = DURATION if speed < 400 else 0.35
    recording, source = motion_scene(
        "planar", motion, seed, size=SIZE, duration=duration, texture=texture, speed=speed
    )
    return recording, (source.velocity, duration)


def motion_errors(
    motion: MotionEstimate,
    params: Params,
    truth: Callable[[NDArray], NDArray],
    times: NDArray[np.floating],
) -> dict[str, float]:
    """Return mean relative errors, %, in three readings, and if the run is lost."""
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


def summarise_runs(runs: Sequence[dict[str, float]], names: Iterable[str], prefix: str = "") -> Row:
    """Return means, and the worst of the runs."""
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


def score_both(
    sequences: Sequence[tuple[Recording, Any]],
    first: int,
    soft: Row | None = SOFT,
    literal: Row | None = LITERAL,
    *,
    names: Sequence[str] = FULL,
    model: str = "planar",
) -> Row:
    """Score both likelihoods on the same sequences, side by side."""
    row: Row = {}
    for prefix, settings, chosen in (("", soft, names), ("literal ", literal, SHORT)):
        if settings is None:
            continue
        params, runs = Params.of(settings), []
        for k, (recording, (truth, duration)) in enumerate(sequences):
            motion = voting.estimate(recording, params, model=model, seed=first + k)
            times = np.arange(SETTLE, duration - 1e-6, 0.005)
            runs.append(motion_errors(motion, params, truth, times))
        row |= summarise_runs(runs, chosen, prefix)
    return row


def part_planar(seeds: range) -> Table:
    rows = []
    for change in ("constant", "linear", "varying"):
        for texture in TEXTURES:
            made = [planar(change, seed, texture) for seed in seeds]
            rows.append({"motion": change, "texture": texture, **score_both(made, seeds[0])})
            print(f"planar {change} {texture}", file=sys.stderr)
    return "planar: relative AEE (%), 200 px/s; start-up (ms)", rows


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
    """Return errors in the thesis' generator; start-up in frames."""
    params, runs, fill = Params.of(settings), [], []
    for seed in seeds:
        recording, velocity = simulate_frame_events(flow, seed=seed, **made)
        motion = voting.estimate(recording, params, seed=seed)
        frame = np.arange(SETTLE_FRAMES, len(flow) - 1)
        frame = frame[(frame + 1) * STEP <= motion.t[-1] * 1e-6]
        scores = motion_errors(
            motion, params, lambda _, v=velocity, at=frame: v[at], (frame + 1) * STEP
        )
        scores["start-up"] /= 1e3 * STEP
        runs.append(scores)
        fill.append(len(recording.events) / (len(flow) * recording.width * recording.height))
    prefix = "literal " if params.likelihood == "literal" else ""
    return {"fill, %": 100 * float(np.mean(fill)), **summarise_runs(runs, names, prefix)}


def part_frames(seeds: range) -> Table:
    rows = []
    for name, flow in flows().items():
        soft = in_frames(flow, seeds, {"preset": "frames"}, FULL)
        literal = in_frames(flow, seeds, LITERAL_FRAMES, SHORT)
        rows.append({"motion, px/frame": name, **soft, **literal})
        print(f"frames {name}", file=sys.stderr)
    return "frame generator: relative AEE (%); start-up (frames)", rows


def part_rotation(seeds: range) -> Table:
    ways = {"soft vote": SOFT, "literal": LATEST, "literal, r_t = 0": {**LATEST, "r_t": 0.0}}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for seed in seeds:
        recording, source = motion_scene("rotation", "constant", seed, size=SIZE, duration=0.4)
        times = np.arange(SETTLE, source.duration - 1e-6, 0.005)
        for name, settings in ways.items():
            params = Params.of(settings)
            motion = voting.estimate(recording, params, model="rotation", seed=seed)
            runs[name].append(
                motion_errors(motion, params, lambda t, s=source: s.twist(t)[1], times)
            )
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
                told = summarise_runs(scores, [key])
                row |= {title: told[key], f"{title}, worst": told[f"{key}, worst"]}
            rows.append(row | summarise_runs(scores, ("lost", "start-up")))
    return "rotation, 2 rad/s", rows


def _turn(source: Any) -> Callable[[NDArray], NDArray]:
    return lambda t: source.twist(t)[1]


def part_penalty(seeds: range) -> Table:
    """Vary r_t with the speed of the image; errors at once, geometric means over sequences."""
    rows = []
    for model, preset, speed in (
        ("planar", "literal", 60.0), ("planar", "literal", 200.0), ("planar", "literal", 600.0),
        ("rotation", "literal_latest", 400.0),
    ):  # fmt: skip
        for texture in TEXTURES:
            row: Row = {"motion": model, "px/s": speed, "texture": texture}
            for r_t in np.geomspace(10, 1e5, 9):
                errors = []
                for seed in seeds:
                    duration = DURATION if speed <= 400 else 0.35
                    more: Row = {"speed": speed} if model == "planar" else {}
                    recording, source = motion_scene(
                        model, "varying", seed, size=SIZE, duration=duration, texture=texture,
                        **more,
                    )  # fmt: skip
                    params = Params(preset=preset, r_t=float(r_t))
                    motion = voting.estimate(recording, params, model=model, seed=seed)
                    times = np.arange(SETTLE, duration - 1e-6, 0.005)
                    truth = source.velocity if model == "planar" else _turn(source)
                    errors.append(motion_errors(motion, params, truth, times)["at once"])
                row[f"{r_t:.2g}"] = float(np.exp(np.log(errors).mean()))
            rows.append(row)
            print(f"penalty {row}", file=sys.stderr)
    return "literal likelihood over r_t (px/s): relative error at once (%)", rows


PARTS: dict[str, Callable[[range], Table]] = {
    "planar": part_planar,
    "frames": part_frames,
    "rotation": part_rotation,
    "penalty": part_penalty,
}


def main() -> int:
    parser = command_line(__doc__, out=True, parts=PARTS)
    parser.add_argument("--seeds", type=int, default=10, help="sequences of each kind")
    parser.add_argument("--first", type=int, default=100, help="the first one's seed")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    text = f"{machine()}; seeds {seeds[0]} to {seeds[-1]}\n\n"
    for part in arguments.only:
        title, rows = PARTS[part](seeds)
        one = f"### {title}\n\n{table_of_rows(rows)}\n\n"
        print(one, flush=True)
        text += one
    write_text(arguments.out / "table.md", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
