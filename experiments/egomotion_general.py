"""General motion of simulated scenes: the batch estimator's errors, scene by scene.

    python experiments/egomotion_general.py --out general [--seeds 100 101 ...] [--scenes wall ...]
    python experiments/egomotion_general.py --out walls --scenes wall --motions varying --seeds 820
    python experiments/egomotion_general.py --out whole --seconds 1.2 --seeds 210 --scenes texture

Scenes are those of `simulate.motion_scene`, 240x180, f = 200 px, 0.5 s of an ideal camera, constant
and varying motion. A window of 300 ms at the middle is fitted from nothing. Errors are those of
heading (degrees) and of Omega (vector, %) at its centre; "flipped" counts headings off by more than
90 degrees, "both" the share with heading within 5 degrees and Omega within 8 %, "per sigma"
medians of errors by what the covariance tells, "squared" means of squared errors of each component
by their variance. A second table has for several bounds of a heading's sigma how many of the right
headings, within 5 degrees, and of the wrong ones are told. What general.csv holds already is not
computed again.

With `--uneven` the sensor has thresholds of 0.16 and 0.26, differing by 15 % between pixels, and
times that are off by 0.5 ms; `--mismatch` and `--jitter` say how much. With `--seconds` recordings
of varying motion, so long each, are estimated as a whole instead, from window to window; errors are
those of all estimates.
"""

import dataclasses
import time
from typing import Any

import numpy as np
import pandas as pd
from common import command_line, machine, markdown_table, write_text

from jaxevent.egomotion import scores
from jaxevent.egomotion.bundle import sequence
from jaxevent.egomotion.bundle.hypotheses import WindowFitter
from jaxevent.egomotion.bundle.windows import Params
from jaxevent.simulate import SENSORS, Sensor, motion_scene

CENTRE = 250_000  # us
COMPONENTS = [f"{name} per sigma, squared" for name in ("tx", "ty", "tz", "wx", "wy", "wz")]

RIGHT_DEG = 5.0  # error of a heading that is right
BOUNDS_RAD = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6)  # of a heading's sigma

# Thresholds that differ, between pixels too, and times that are off.
UNEVEN = dataclasses.replace(SENSORS["ideal"], c_on=0.16, c_off=0.26, mismatch=0.15, jitter=5e-4)


def window(
    scene: str, motion: str, seed: int, params: Params, sensor: Sensor | None
) -> dict[str, Any]:
    recording, source = motion_scene(scene, motion, seed, sensor=sensor)
    assert recording.camera is not None
    cpu, clock = time.process_time(), time.perf_counter()
    windows = WindowFitter(recording, params, recording.camera)
    fit = windows.fit(CENTRE)
    cpu, clock = time.process_time() - cpu, time.perf_counter() - clock
    assert fit is not None
    T, Omega = source.twist(np.array([CENTRE]))
    heading, turn = fit.path.unit_twist(0.0)
    errors = np.concatenate([heading[0] - T[0] / np.linalg.norm(T), turn[0] - Omega[0]])
    squares = dict(zip(COMPONENTS, errors**2 / np.diag(fit.covariance), strict=True))
    spread = np.sqrt([np.trace(fit.covariance[:3, :3]), np.trace(fit.covariance[3:, 3:])])
    return {
        "scene": f"{scene} {motion}",
        "seed": seed,
        "heading": float(scores.axis_error(heading, T)[0]),
        "Omega": 100 * float(scores.relative_error(turn, Omega)[0]),
        "heading sigma": float(np.degrees(spread[0])),
        "Omega sigma": 100 * float(spread[1] / np.linalg.norm(Omega)),
        "agreement": fit.agreement,
        "cost": fit.cost,
        **squares,
        "CPU s": cpu,
        "s": clock,
    }


def whole(scene: str, seed: int, params: Params, seconds: float) -> dict[str, Any]:
    recording, source = motion_scene(scene, "varying", seed, duration=seconds)
    clock = time.perf_counter()
    found = sequence.batch.estimate(recording, params)
    spent = time.perf_counter() - clock
    kept = found.valid
    T, Omega = source.twist(found.t[kept])
    heading = scores.axis_error(found.mean[kept, :3], T)
    turn = 100 * scores.relative_error(found.mean[kept, 3:], Omega)
    return {
        "scene": f"{scene} varying",
        "seed": seed,
        "estimates": len(heading),
        "lost": int((~kept).sum()),
        "heading deg, median": float(np.median(heading)),
        "max": float(heading.max()),
        "Omega %, median": float(np.median(turn)),
        "max ": float(turn.max()),
        "both": float(((heading <= 5) & (turn <= 8)).mean()),
        "s": spent,
    }


def bound_table(table: pd.DataFrame) -> str:
    """Return how many right and wrong headings bounds of their sigma leave."""
    right, lines = table["heading"] <= RIGHT_DEG, []
    for bound in BOUNDS_RAD:
        told = table["heading sigma"] <= np.degrees(bound)
        worst = table["heading"][told].max()
        lines.append(
            (
                f"{bound:g}",
                f"{(told & right).sum()} of {right.sum()}",
                f"{(told & ~right).sum()} of {(~right).sum()}",
                f"{worst:.1f}",
            )
        )
    header = "bound, rad", "right headings told", "wrong ones told", "worst told, deg"
    return markdown_table(header, lines)


def main() -> None:
    parser = command_line(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(196, 206)))
    parser.add_argument("--scenes", nargs="+", default=["wall", "shapes", "texture"])
    parser.add_argument("--motions", nargs="+", default=["constant", "varying"])
    parser.add_argument("--seconds", type=float, help="of whole recordings, instead of windows")
    parser.add_argument("--uneven", action="store_true", help="a sensor with uneven thresholds")
    parser.add_argument("--mismatch", type=float, default=UNEVEN.mismatch, help="of uneven ones")
    parser.add_argument("--jitter", type=float, default=UNEVEN.jitter, help="s, likewise")
    arguments = parser.parse_args()
    own = {"mismatch": arguments.mismatch, "jitter": arguments.jitter}
    sensor = dataclasses.replace(UNEVEN, **own) if arguments.uneven else None
    params, rows = Params.of({}), []
    if arguments.seconds:
        for seed in arguments.seeds:
            for scene in arguments.scenes:
                rows.append(whole(scene, seed, params, arguments.seconds))
                print(rows[-1], flush=True)
                pd.DataFrame(rows).to_csv(arguments.out / "recordings.csv", index=False)
        return
    stored = arguments.out / "general.csv"
    if stored.exists():
        rows = pd.read_csv(stored).to_dict("records")
    done = {(row["scene"], row["seed"]) for row in rows}
    for seed in arguments.seeds:
        for scene in arguments.scenes:
            for motion in arguments.motions:
                if (f"{scene} {motion}", seed) in done:
                    continue
                rows.append(window(scene, motion, seed, params, sensor))
                print(rows[-1], flush=True)
                pd.DataFrame(rows).to_csv(stored, index=False)
    table = pd.DataFrame(rows)
    header = (
        "scene", "windows", "heading deg, mean / median / max", "Omega %, the same", "both",
        "flipped", "per sigma", "squared, tx to wz", "CPU s", "s, median / max",
    )  # fmt: skip
    lines = []
    for name, part in [*table.groupby("scene", sort=False), ("all", table)]:
        three = [
            " / ".join(f"{value:.1f}" for value in (column.mean(), column.median(), column.max()))
            for column in (part["heading"], part["Omega"])
        ]
        both = ((part["heading"] <= 5) & (part["Omega"] <= 8)).mean()
        flipped = int((part["heading"] > 90).sum())
        sigmas = ", ".join(
            f"{(part[error] / part[f'{error} sigma']).median():.1f}"
            for error in ("heading", "Omega")
        )
        squares = " ".join(f"{part[one].mean():.1f}" for one in COMPONENTS)
        times = f"{part['s'].median():.1f} / {part['s'].max():.1f}"
        cpu = f"{part['CPU s'].median():.1f}"
        lines.append(
            (name, len(part), *three, f"{100 * both:.0f} %", flipped, sigmas, squares, cpu, times)
        )
    text = f"{markdown_table(header, lines)}\n\n{bound_table(table)}\n\n{machine()}\n"
    write_text(arguments.out / "general.md", text)
    print(text)


if __name__ == "__main__":
    main()
