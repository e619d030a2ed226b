"""Noises found again, and what they gain on recordings that no fit saw.

    python experiments/demonstration.py --out demonstration [--only noises r_t real]

Recordings are drawn from the models of `recovery.py`, of which the true numbers are known, and
fitted with configs/fit_noises.toml and configs/fit_r_t.toml. A grid with as many evaluations of the
loss stands beside, a gradient counted as two. "Real" fits the same numbers to the first half of
real recordings and scores the second. Writes the recordings, the fits' folders and table.md; of
simulated ones also figure.png.
"""

import dataclasses
import itertools
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import command_line, machine, table_of_rows, write_text
from recovery import AKF, VOTES, SimulatedGoal, from_akf, from_literal_votes

import jaxevent
from jaxevent.camera import PinholeCamera
from jaxevent.confidence import confidence_intervals
from jaxevent.egomotion.models import Planar
from jaxevent.egomotion.patches import measure_image_speed
from jaxevent.egomotion.truth import KnownMotion, known_motion
from jaxevent.runs.egomotion import MotionLoss
from jaxevent.runs.family import FitData
from jaxevent.runs.fit_config import Task, read_plan
from jaxevent.runs.reconstruction import Objective, Problem, cut_windows
from jaxevent.tuning import PROBE_STEPS, FitResult, Settings, evaluate_loss, optimise

ROOT = Path(__file__).parents[1]
DRAWN = {"noises": {"fit": range(3), "test": range(100, 103)},
         "r_t": {"fit": range(16), "test": range(100, 108)}}  # fmt: skip
TRUTHS = {"noises": {name: AKF[name] for name in ("sigma_proc", "sigma_iso")}, "r_t": VOTES}
RANGES = {"sigma_proc": (0.01, 3.0), "sigma_iso": (0.01, 3.0), "r_t": (1.0, 1e5)}  # of the grid
DOT_RATE_HZ, DOT_CENTRE_PX, DOT_RADIUS_PX = 19.39, (314.29, 202.35), 107.66


def draw(folder: Path, part: str) -> None:
    """Write the recordings of a part, and the true motion beside those of votes."""
    for split, seeds in DRAWN[part].items():
        (folder / part / split).mkdir(parents=True, exist_ok=True)
        for seed in seeds:
            path = folder / part / split / f"{seed:03d}.h5"
            if part == "noises":
                jaxevent.save(from_akf(seed), path)
                continue
            recording, truth = from_literal_votes(seed)
            jaxevent.save(recording, path)
            columns = {"t": 1e-6 * truth.t, **dict(zip(("vx", "vy"), truth.values.T, strict=True))}
            pd.DataFrame(columns).to_csv(path.with_suffix(".csv"), index=False)


def mean_loss(loss: Any, params: Any, batches: Any) -> float:
    """Return the mean loss over batches of equal weight."""
    return float(np.mean([evaluate_loss(loss, params, batch) for batch in batches]))


def best_of_grid(loss: Any, start: Any, names: Any, batches: Any, count: int) -> tuple[Any, Any]:
    """Return the best of about `count` points on a logarithmic grid, and all losses."""
    side = round(count ** (1 / len(names)))
    axes = [np.geomspace(*RANGES[name], side) for name in names]
    tried = []
    for point in itertools.product(*axes):
        params = start.replace(**dict(zip(names, map(float, point), strict=True)))
        tried.append((mean_loss(loss, params, batches), params))
    return min(tried, key=lambda pair: pair[0])[1], (axes, [one for one, _ in tried])


def count_evaluations(settings: Settings, names: Any, rough: Any) -> int:
    """Return the number of losses that a fit computed, a gradient counted as two."""
    lines = 1 + (len(names) if rough and len(names) > 1 else 0)
    searched = 21 * len(rough)
    descent = settings.rounds * (2 * settings.iterations + settings.iterations // settings.every)
    return descent + 3 * len(PROBE_STEPS) * lines + searched


def show(values: Any, names: Any) -> str:
    return ", ".join(f"{float(getattr(values, name)):.3g}" for name in names)


def simulated(folder: Path, part: str) -> tuple[list[dict[str, Any]], Any]:
    """Fit drawn recordings by the configuration; return rows, and curves for the figure."""
    draw(folder, part)
    os.environ["DEMONSTRATION"] = str(folder.resolve())
    config = ROOT / "configs" / f"fit_{part}.toml"
    begun = time.process_time()
    fits = jaxevent.fit(config, folder / f"fitted_{part}", progress=False)
    seconds = time.process_time() - begun
    plan = read_plan(config)
    task: Task = plan.tasks[0]
    batches = {}
    for split in ("fit", "test"):
        paths: Any = plan.recordings[split]
        given = [(name, jaxevent.load(path)) for name, path in paths]
        named = [(n, dataclasses.replace(one, name=n)) for n, one in given]
        sources: Any = {"fit": named, "validation": [], "test": []}
        batches[split] = task.goal.problem(FitData(sources))(task.params)[0]
    rough = [row["parameter"] for row in fits.found if row["gradient_skill"] is not None]
    count = count_evaluations(task.settings, task.names, rough)
    begun = time.process_time()
    grid, curve = best_of_grid(task.loss, task.params, task.names, batches["fit"], count)
    true = task.params.replace(**TRUTHS[part])
    rows = []
    for label, params, taken in (
        ("start", task.params, ""), ("gradient", fits.params, f"{seconds:.0f}"),
        ("grid", grid, f"{time.process_time() - begun:.0f}"), ("truth", true, ""),
    ):  # fmt: skip
        rows.append({
            "": label, "numbers": show(params, task.names),
            "loss, fitted": mean_loss(task.loss, params, batches["fit"]),
            "loss, unseen": mean_loss(task.loss, params, batches["test"]), "CPU s": taken,
        })  # fmt: skip
    for row in fits.found:
        value = TRUTHS[part][row["parameter"]]
        holds = (row["low"] or 0) <= value <= (row["high"] or np.inf)
        rows.append({"": row["parameter"], "true": value, "start": row["start"],
                     "found": row["found"], "95 % interval": row["interval"],
                     "holds it": "yes" if holds else "no", "remark": row["remark"]})  # fmt: skip
        print(rows[-1], flush=True)
    return rows, (task.names, curve, true, fits.params, task.params, fits.found)


def plot(curves: dict[str, Any], path: Path) -> None:
    """Plot the loss of the fitted recordings, with starts, truths and what was found."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(4.6 * len(curves), 3.6), squeeze=False)
    for ax, (part, (names, (grid, losses), true, found, start, rows)) in zip(
        axes[0], curves.items(), strict=True
    ):
        points = {"start": (start, "C3o"), "found": (found, "C0D"), "true": (true, "C1*")}
        losses = np.reshape(losses, [len(axis) for axis in grid])
        if len(names) == 1:
            ax.loglog(grid[0], losses, "0.6", marker=".", label="loss")
            for label, (params, mark) in points.items():
                value = float(getattr(params, names[0]))
                height = np.exp(np.interp(np.log(value), np.log(grid[0]), np.log(losses)))
                ax.plot(value, height, mark, label=label, ms=9)
            ax.axvspan(rows[0]["low"], rows[0]["high"], color="C0", alpha=0.2)
            ax.set(xlabel=f"{names[0]}, px/s", ylabel="relative squared error")
        else:
            levels = losses.min() + np.geomspace(0.01, 30, 9)
            ax.contour(*grid, losses.T, levels=levels, cmap="Greys_r", linewidths=0.8)
            for label, (params, mark) in points.items():
                ax.plot(*(float(getattr(params, name)) for name in names), mark, label=label, ms=9)
            (a, b), (c, d) = ((row["low"], row["high"]) for row in rows)
            ax.plot([a, b, b, a, a], [c, c, d, d, c], "C0", lw=1)
            ax.set(xscale="log", yscale="log", xlabel=names[0], ylabel=names[1])
        ax.set_title("AKF, -ln p of references" if part == "noises" else "literal votes")
        ax.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def halves(recording: Any) -> list[Any]:
    middle = (recording.start + recording.stop) // 2
    return [recording[recording.start : middle], recording[middle : recording.stop]]


def real_noises(data: Path) -> list[dict[str, Any]]:
    """Fit the AKF's noises to hidden frames of a first half; score the second."""
    rows, names = [], ["sigma_proc", "sigma_iso"]
    for name, offset in (("slider_depth.zip", 0.0075), ("davis346_street.npz", 0.0)):
        first, second = halves(jaxevent.load(data / name))
        start = jaxevent.akf.Params(clock_offset=offset)
        problems = {}
        for error in ("nll", "linear"):
            objective = Objective(jaxevent.akf, error)
            for k, part in enumerate((first, second)):
                problems[error, k] = Problem(objective, cut_windows(part, "held-out"))
        problem = problems["nll", 0]
        settings = Settings(iterations=30, learning_rate=0.2, rounds=1, patience=1000)
        fit: FitResult = optimise(problem.objective, start, names, problem, settings=settings)
        told = confidence_intervals(problem.objective, start, fit.params, names, problem)
        count = count_evaluations(settings, names, fit.rough)
        grid, _ = best_of_grid(problem.objective, start, names, problem(start)[0], count)
        for label, params in (("start", start), ("gradient", fit.params), ("grid", grid)):
            row: dict[str, Any] = {"recording": name, "": label, "numbers": show(params, names)}
            for error, title in (("nll", "-ln p"), ("linear", "MSE")):
                objective = problems[error, 1].objective
                value = mean_loss(objective, params, problems[error, 1](params)[0])
                row[f"{title}, unseen"] = value
            if label == "gradient":
                row["intervals"] = "; ".join(one.interval for one in told.intervals)
                row["remarks"] = "; ".join(one.remark for one in told.intervals if one.remark)
            rows.append(row)
            print(row, flush=True)
    return rows


def dot_motion(recording: Any) -> KnownMotion:
    """Return the image velocity of the spinning dot, whose phase and sense events tell."""
    events = recording.events
    x, y = (
        np.asarray(v, float) - c for v, c in zip((events.x, events.y), DOT_CENTRE_PX, strict=True)
    )
    turn = 2 * np.pi * DOT_RATE_HZ * 1e-6
    angle, t = np.arctan2(y, x), np.asarray(events.t, float)
    means = {sense: np.exp(1j * (angle - sense * turn * t)).mean() for sense in (-1, 1)}
    sense = max(means, key=lambda one: abs(means[one]))
    times = np.arange(recording.start, recording.stop + 101, 100)
    now = np.angle(means[sense]) + sense * turn * times
    speed = sense * turn * 1e6 * DOT_RADIUS_PX
    return KnownMotion(Planar, times, speed * np.stack([-np.sin(now), np.cos(now)], 1))


def real_r_t(data: Path) -> list[dict[str, Any]]:
    """Fit r_t to the first half of recordings with known motion; score the second."""
    rows = []
    slider = jaxevent.load(data / "slider_depth.zip")[0.3:1.9]
    disk = jaxevent.load(data / "rotating_disk_imu.npz")[0.5:1.5]
    centre = (disk.width - 1) / 2, (disk.height - 1) / 2
    disk = dataclasses.replace(disk, camera=PinholeCamera(200.0, 200.0, *centre))
    dot = jaxevent.load(data / "spinning_dot.npz")
    for name, recording, model, truth, window in (
        ("slider_depth", slider, "planar", known_motion(slider, "planar", depth=1.94), 0.2),
        ("rotating_disk", disk, "rotation", known_motion(disk, "rotation", "gyro"), 0.125),
        ("spinning_dot", dot, "planar", dot_motion(dot), 0.00625),
    ):
        voting = jaxevent.egomotion.voting
        speed = measure_image_speed(recording, recording.camera)
        preset = "literal" if model == "planar" else "literal_latest"
        start = voting.Params(preset=preset, every=32, particles=100)
        adapted = start
        if speed is not None:
            adapted = voting.adapt_params(recording, start, speed=speed).params
        parts = []
        for part in halves(recording):
            named = dataclasses.replace(part, name="0")
            goal = SimulatedGoal(voting, MotionLoss(), model, "", 2, window / 4, {}, (truth,))
            sources: Any = {"fit": [("0", named)], "validation": [], "test": []}
            parts.append(goal.problem(FitData(sources, (1, 0, 0), window))(start)[0])
        settings = Settings(iterations=8, learning_rate=0.2, rounds=1, patience=1000, forward=True)
        fit: FitResult = optimise(goal.loss, start, ["r_t"], parts[0], settings=settings)
        for label, params in (("default", start), ("by speed", adapted), ("fit", fit.params)):
            rows.append({
                "recording": name, "": label, "r_t": float(params.r_t),
                "px/s": "-" if speed is None else f"{speed.median:.0f}",
                "error, unseen, %": 100 * mean_loss(goal.loss, params, parts[1]) ** 0.5,
                "rough": ", ".join(fit.rough) if label == "fit" else "",
            })  # fmt: skip
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    parts = ("noises", "r_t", "real")
    parser = command_line(__doc__, out=True, parts=parts)
    parser.add_argument("--data", type=Path, help="real recordings; default: $JAXEVENT_DATA/data")
    arguments = parser.parse_args()
    text, curves = f"{machine()}\n", {}
    for part in arguments.only:
        begun = time.process_time()
        if part == "real":
            data = arguments.data or Path(os.environ["JAXEVENT_DATA"]) / "data"
            tables = {"noises": real_noises(data), "r_t": real_r_t(data)}
        else:
            rows, curves[part] = simulated(arguments.out, part)
            tables = {part: rows[:4], f"{part}, recovered": rows[4:]}
        text += f"\n{part}: {time.process_time() - begun:.0f} CPU s\n"
        for title, rows in tables.items():
            text += f"\n### {part}: {title}\n\n{table_of_rows(rows)}\n"
        write_text(arguments.out / "table.md", text)
        if curves:
            plot(curves, arguments.out / "figure.png")
    print(text)


if __name__ == "__main__":
    main()
