"""All methods of egomotion on the same sequences (the thesis' tables 5.1, 6.1 and 6.3).

    python experiments/egomotion_table.py --out table [--data FOLDER] [--seeds 500 501]

Simulated: an ideal camera of 240x180 pixels, f = 200 px, 25 frames/s, 0.6 s: planar motion,
rotation and general motion, with motions that nothing was chosen on; and fast rotations, 0.06 s of
160x120 pixels, of which all times count. With --data FOLDER, which holds slider_depth.zip and
tubrip_*_rotation.npz, real ones: slider_depth from 1 to 2 s, as planar motion (against its poses at
the one depth that fits the estimate best) and as general motion (a pure translation to the right),
and two cuts of 13 and 99 ms of rotation, without frames.

Parameters are those that suit the recording by themselves, those of `literal` are the thesis'
(`Params.presets`), at once. Every estimate counts for the time that what it saw shows. Errors
are those of `scores.motion_errors` from 0.2 s to 0.1 s before the end, where all methods tell
something, means over seeds: `failed` counts sequences without any estimate there, which are not in
the means.
`CPU` is CPU seconds per second of recording, programs being compiled. What table.csv holds already
is not computed again.
"""

import dataclasses
import functools
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from common import command_line, machine, markdown_table, write_text

import jaxevent
from jaxevent.egomotion import batch, contrast, find_model, frames, planes, voting
from jaxevent.egomotion.estimator import MotionEstimator
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.scores import METRIC_UNITS, score_motion
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError
from jaxevent.io.output import complete
from jaxevent.recording import Recording
from jaxevent.show.motion import motion_at_fitted_depth
from jaxevent.simulate import motion_scene

FAST = 6.0, 12.0, 24.0  # rad/s
DURATION, SETTLE, END = 0.6, 0.2, 0.1  # s
WARM = 0.3  # s of a sequence, for programs to be compiled
KEY = ("sequence", "model", "seed", "method")
SLIDER = 1.0, 2.0  # s
STEP = 5_000  # us between times that are compared
LITERAL = {
    "planar": {"preset": "literal"},
    "rotation": {"preset": "literal_latest"},
    # The parameters of `egomotion_voting.part_general`.
    "general": {
        "preset": "literal_latest", "particles": 500, "every": 32, "alpha_literal": 0.3,
    },
}  # fmt: skip
SHOWN = {
    "planar": ("AEE_rel", "AAE_U"),
    "rotation": ("AAE_Omega", "AME", "AME_rel", "AME_N", "vector_error", "outliers"),
    "general": ("AAE_T", "AAE_Omega", "AME", "AME_rel", "AME_N", "vector_error", "outliers"),
}


class Sequence(NamedTuple):
    """`make()` gives a recording and what is known of its motion; None: its poses tell it."""

    name: str
    model: str
    seed: str
    make: Callable[[], tuple[Recording, KnownMotion | None]]


def simulated_sequences(seed: int) -> Iterator[Sequence]:
    kinds = [
        ("planar", "planar", "constant"),
        ("planar", "planar", "varying"),
        ("rotation", "rotation", "constant"),
        ("rotation", "rotation", "varying"),
        *(("general", scene, "varying") for scene in ("wall", "shapes", "texture")),
    ]
    for speed in FAST:
        make = functools.partial(fast_rotation, speed, seed)
        yield Sequence(f"rotation, {speed:g} rad/s", "rotation", str(seed), make)
    for model, scene, change in kinds:
        make = functools.partial(simulate, model, scene, change, seed)
        yield Sequence(f"{scene}, {change}", model, str(seed), make)


def fast_rotation(speed: float, seed: int) -> tuple[Recording, KnownMotion]:
    size: dict[str, Any] = {"size": (160, 120), "duration": 0.06, "speed": speed}
    recording, source = motion_scene("rotation", "constant", seed, **size)
    t = np.arange(0, 60_001, 1000)
    return recording, KnownMotion(find_model("rotation"), t, source.twist(t)[1])


def simulate(model: str, scene: str, change: str, seed: int) -> tuple[Recording, KnownMotion]:
    recording, source = motion_scene(scene, change, seed, duration=DURATION)
    t = np.arange(0, round(1e6 * DURATION) + 1, 1000)
    kind = find_model(model)
    return recording, KnownMotion(kind, t, kind.from_scene(source, t))


def real_sequences(data: Path) -> Iterator[Sequence]:
    def slider(model: str) -> tuple[Recording, KnownMotion | None]:
        whole = jaxevent.load(data / "slider_depth.zip")
        cut = dataclasses.replace(whole[SLIDER[0] : SLIDER[1]], poses=whole.poses)
        if model == "planar":
            return cut, None
        along = np.tile([1.0, 0, 0, 0, 0, 0], (2, 1))
        return cut, KnownMotion(find_model(model), np.array([cut.start, cut.stop]), along)

    def tubrip(name: str) -> tuple[Recording, KnownMotion]:
        cut = jaxevent.load(data / f"tubrip_{name}_rotation.npz")
        t, omega = np.array([cut.start, cut.stop]), np.asarray(cut.extra["omega"])
        return cut, KnownMotion(find_model("rotation"), t, np.tile(omega, (2, 1)))

    for model in ("planar", "general"):
        yield Sequence("slider_depth", model, "real", functools.partial(slider, model))
    for name in ("boxes", "shapes"):
        yield Sequence(f"tubrip {name}", "rotation", "real", functools.partial(tubrip, name))


METHODS: dict[str, tuple[MotionEstimator[Any], dict[str, Any] | None]] = {
    "voting": (voting, None),
    "voting, literal": (voting, LITERAL),
    "contrast": (contrast, None),
    "planes": (planes, None),
    "frames": (frames, None),
    "batch": (batch, None),
}


def estimate_motion(label: str, model: str, recording: Recording) -> MotionEstimate:
    method, given = METHODS[label]
    params = None if given is None else method.Params.of(given[model])
    more = {} if given is None else {"smooth": False}
    return method.estimate(recording, params, model=model, **more)


def cpu() -> float:
    """Return the CPU seconds of this process, on all cores."""
    used = os.times()
    return used.user + used.system


def score_method(sequence: Sequence, label: str, warm: set[tuple[str, str]]) -> dict[str, Any]:
    """Return a row of one method on one sequence."""
    recording, known = make_sequence(sequence)
    model, length = sequence.model, (recording.stop - recording.start) * 1e-6
    METHODS[label][0].find_model_and_camera(recording, model, None)
    if (label, model) not in warm and label != "frames":
        estimate_motion(label, model, recording[: recording.start + round(1e6 * min(WARM, length))])
        warm.add((label, model))
    began = cpu()
    motion = estimate_motion(label, model, recording)
    spent = cpu() - began
    known = motion_at_fitted_depth(recording, motion) if known is None else known
    # Of a cut that is shorter all times count.
    settle, end = (SETTLE, END) if length > 2 * (SETTLE + END) - 0.01 else (0.0, 0.0)
    first, last = recording.start + round(1e6 * settle), recording.stop - round(1e6 * end)
    times = np.arange(first, last + 1, STEP if settle else 1000)
    found = score_motion(motion, known, times, start=first, centred=True)
    failed = not found.figures
    # To no rotation there is no axis and no share.
    figures = {name: value for name, value in found.figures.items() if np.isfinite(value)}
    if "AME" in figures and "vector_error" not in figures:
        del figures["AAE_Omega"]
    return {
        **figures,
        "failed": float(failed),
        "lost": np.nan if failed else 100 * found.lost,
        "CPU": spent / length,
    }


@functools.lru_cache(maxsize=1)
def make_sequence(sequence: Sequence) -> tuple[Recording, KnownMotion | None]:
    return sequence.make()


def format_value(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def markdown(model: str, rows: list[dict[str, Any]]) -> str:
    columns = [*SHOWN[model], "lost", "failed", "CPU"]
    units = {**METRIC_UNITS, "lost": "%", "failed": "", "CPU": "s/s"}
    heads = [f"{name} {units[name]}".strip() for name in columns]
    lines = []
    rows = [row for row in rows if row["model"] == model]
    for name, method in dict.fromkeys((row["sequence"], row["method"]) for row in rows):
        part = [row for row in rows if (row["sequence"], row["method"]) == (name, method)]
        each = {column: np.array([row.get(column, np.nan) for row in part]) for column in columns}
        known = [values[~np.isnan(values)] for values in each.values()]
        texts = [format_value(values.mean()) if len(values) else "-" for values in known]
        texts[columns.index("failed")] = f"{int(each['failed'].sum())} of {len(part)}"
        lines.append([name, method, *texts])
    return markdown_table(["sequence", "method", *heads], lines, 2) + "\n"


def main() -> None:
    parser = command_line(__doc__, out=True)
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[500, 501])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    arguments = parser.parse_args()
    stored, warm = arguments.out / "table.csv", set()
    rows: list[dict[str, Any]] = []
    if stored.exists():
        rows = pd.read_csv(stored, dtype={"seed": str}).to_dict("records")
    done = {tuple(row[name] for name in KEY) for row in rows}
    sequences = [*real_sequences(arguments.data)] if arguments.data else []
    sequences += [one for seed in arguments.seeds for one in simulated_sequences(seed)]
    for sequence in sequences:
        for label in arguments.methods:
            key = (sequence.name, sequence.model, sequence.seed, label)
            if key in done or not METHODS[label][0].supports(find_model(sequence.model)):
                continue
            try:
                row = score_method(sequence, label, warm)
            except InputError as error:  # no frames
                print(error, file=sys.stderr)
                continue
            rows.append({**dict(zip(KEY, key, strict=True)), **row})
            print(rows[-1], file=sys.stderr, flush=True)
            with complete(stored) as path:
                pd.DataFrame(rows).to_csv(path, index=False)
    parts = [markdown(model, rows) for model in SHOWN]
    text = "\n".join([*parts, f"{machine()}; {cpu():.0f} CPU s in all"]) + "\n"
    write_text(arguments.out / "table.md", text)
    print(text)


if __name__ == "__main__":
    main()
