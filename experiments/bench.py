"""Speed and memory, as ratios of CPU seconds measured in one run.

    python experiments/bench.py [PART ...] [--gate | --bless] [--json FILE]

Parts: images (the complete path from a file to images, losses, gradients), xla (the scan, where
there is no kernel), calibration, smoother, mc, tracker (bench_blob.py), voting and motion
(bench_motion.py), events-only (events_only.py), memory (streaming.py), start (a short `jaxevent
reconstruct`, one picture of `mc` and help in fresh processes), scaling (scaling.py). Without any,
all but motion, which takes minutes.
CPU seconds of this process are compared, so other programs on the machine change little: `--gate`
compares the ratios with bench_baseline.json and exits with 1 if one is worse than its tolerance;
`--bless` writes those of the parts that ran.
"""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

from common import command_line, machine

BASELINE = Path(__file__).with_name("bench_baseline.json")

# Direction and relative tolerance of what the gate compares: runs beside other work on two cores
# differed by up to a fifth.
GATED = {
    "complete path / numba program": ("higher", 0.3),
    "the same, events in memory": ("higher", 0.3),
    "complete path / the same compiled by XLA": ("higher", 0.4),
    "1280x720 at 25 Hz / numba program of 346x260": ("higher", 0.3),
    "pixel of an image more / event of the numba program": ("lower", 0.4),
    "loss and 8 gradients / loss": ("lower", 0.3),
    "complete path / dv-processing Accumulator": ("higher", 0.4),
    "filter by XLA / numba program": ("higher", 0.4),
    "features and packing / numba program": ("higher", 0.4),
    "compilations for a second recording": ("lower", 0.0),
    "calibration / reading and filtering of 30 M events": ("lower", 0.4),
    "smoother / numba program": ("higher", 0.3),
    "smoother, one image / numba program": ("higher", 0.3),
    "smoother, preset hdr / the same compiled by XLA": ("higher", 0.4),
    "smoother: loss and 8 gradients / loss": ("lower", 0.3),
    "tracker, M = 1, loop over packed events / numba loop": ("higher", 0.3),
    "tracker, M = 32, loop over packed events / numba loop": ("higher", 0.3),
    "tracker, M = 1, `estimate` by numba / numba loop": ("higher", 0.3),
    "tracker, M = 32, `estimate` by numba / numba loop": ("higher", 0.4),
    "tracker, M = 1: loss and 3 gradients / loss": ("lower", 0.4),
    "tracker, M = 1: loss and 3 gradients by numba / by XLA": ("higher", 0.5),
    "planar voting: loss and 3 gradients / loss": ("lower", 0.4),
    "planar voting: loss and 3 gradients by numba / by XLA": ("higher", 0.5),
    "planar voting, N = 200 / numba loop": ("higher", 0.4),
    "rotation voting, N = 200 / numba loop": ("higher", 0.4),
    "general voting, N = 500 / numba loop": ("higher", 0.4),
    "events-only / images of tiles": ("higher", 0.4),
    "events-only: pixel of 640x480 / of 240x180": ("lower", 0.4),
    "mc: image of 100 Hz video / optical flow": ("lower", 0.3),
    "mc: single image / optical flow": ("lower", 0.3),
    "mc: loss and 5 gradients / loss": ("lower", 0.4),
    "mc: loss and 5 gradients / single image": ("lower", 0.4),
    "mc: single image, pixel of 1200x720 / of 240x180": ("lower", 0.4),
    "peak memory of 10 M events, GB": ("lower", 0.25),
    "start: akf, cold / imports": ("lower", 0.4),
    "start: akf, warm / imports": ("lower", 0.4),
    "start: aks, cold / imports": ("lower", 0.4),
    "start: aks, warm / imports": ("lower", 0.4),
    "start: picture of mc, cold / imports": ("lower", 0.4),
    "start: picture of mc, warm / imports": ("lower", 0.4),
    "start: help, warm / imports": ("lower", 0.6),
    "scaling: akf, slope by events": ("lower", 0.25),
    "scaling: mc, slope by pixels": ("lower", 0.25),
    "scaling: track, slope by targets": ("lower", 0.25),
    "scaling: find, slope by events": ("lower", 0.6),
}


# Module and function of each part.
PARTS = {
    "images": "bench_images.images_bench",
    "xla": "bench_images.xla_bench",
    "calibration": "bench_images.calibration_bench",
    "smoother": "bench_images.smoother_bench",
    "mc": "bench_images.motion_compensated_bench",
    "tracker": "bench_blob.tracker_bench",
    "voting": "bench_motion.voting_bench",
    "motion": "bench_motion.motion_bench",
    "events-only": "events_only.events_only_bench",
    "memory": "streaming.memory_bench",
    "start": "bench_images.start_bench",
    "scaling": "scaling.scaling_bench",
}
USUAL = [name for name in PARTS if name != "motion"]


def run_part(name: str) -> Any:
    """Import the module of a part and run it."""
    module, _, function = PARTS[name].partition(".")
    return getattr(importlib.import_module(module), function)()


def main() -> int:
    parser = command_line(__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}")
    parser.add_argument(
        "--gate", action="store_true", help="exit with 1 if worse than the baseline"
    )
    parser.add_argument("--bless", action="store_true", help="write the baseline")
    parser.add_argument("--json", type=Path, help="write all numbers")
    arguments = parser.parse_args()
    parts = arguments.parts or USUAL
    if unknown := set(parts) - set(PARTS):
        parser.error(f"there are no parts {', '.join(sorted(unknown))}")
    speed, ratio = {}, {}
    for name in parts:
        print(name, file=sys.stderr, flush=True)
        more, ratios = run_part(name)
        show(more, ratios)
        speed, ratio = speed | more, ratio | ratios
        if arguments.json:
            numbers = {"machine": machine(), "M events per CPU second": speed, "ratios": ratio}
            arguments.json.write_text(json.dumps(numbers, indent=1) + "\n")
        if arguments.bless:
            bless(ratio)
    return gate(ratio) if arguments.gate else 0


def show(speed: dict[str, float], ratio: dict[str, float]) -> None:
    for title, numbers in (("M events per CPU second", speed), ("ratio", ratio)):
        print(f"\n| {title} | |\n|---|---:|")
        for name, value in numbers.items():
            print(f"| {name} | {value:.2f} |", flush=True)


def bless(ratio: dict[str, float]) -> None:
    """Write the ratios that the gate compares; those of parts that did not run stay."""
    known = json.loads(BASELINE.read_text())["ratios"] | ratio
    kept = {name: round(known[name], 3) for name in GATED if name in known}
    BASELINE.write_text(json.dumps({"machine": machine(), "ratios": kept}, indent=1) + "\n")


def gate(ratio: dict[str, float]) -> int:
    """Return 1 if a ratio is worse than the baseline by more than its tolerance."""
    baseline = json.loads(BASELINE.read_text())["ratios"]
    worse = []
    for name, (direction, tolerance) in GATED.items():
        if name not in ratio or name not in baseline:
            continue
        bound = baseline[name] * (1 - tolerance if direction == "higher" else 1 + tolerance)
        if ratio[name] < bound if direction == "higher" else ratio[name] > bound:
            worse.append(f"{name}: {ratio[name]:.2f}, baseline {baseline[name]:.2f}")
    print("\n" + ("\n".join(["worse than the baseline:", *worse]) if worse else "gate passed"))
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
