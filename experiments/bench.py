"""Speed and memory, as ratios of CPU seconds measured in one run.

    python experiments/bench.py [PART ...] [--gate | --bless] [--json FILE]

Parts: images (bench_images.py: the complete path from a file to images, losses, gradients), xla
(the scan, where there is no kernel), smoother (bench_smoother.py), tracker and blob
(bench_blob.py), voting and motion (bench_motion.py), memory (streaming.py). Without any, all but
blob and motion, which take minutes. CPU seconds of this process are compared, so other programs on
the machine change little: `--gate` compares the ratios with bench_baseline.json and exits with 1
if one is worse than its tolerance; `--bless` writes those of the parts that ran. `gpu`
(bench_gpu.py) times a GPU against the CPU's kernels, by the clock, and `path` (bench_path.py) the
parts of the complete path and of gradients; these two have no gate.
"""

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

import jax

BASELINE = Path(__file__).with_name("bench_baseline.json")
Found = tuple[dict[str, float], dict[str, float]]  # M events per CPU second, and ratios

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
    "smoother / numba program": ("higher", 0.3),
    "smoother, one image / numba program": ("higher", 0.3),
    "smoother, preset hdr / the same compiled by XLA": ("higher", 0.4),
    "smoother: loss and 8 gradients / loss": ("lower", 0.3),
    "tracker, M = 1, loop over packed events / numba loop": ("higher", 0.3),
    "tracker, M = 32, loop over packed events / numba loop": ("higher", 0.3),
    "tracker, M = 1, `estimate` by numba / numba loop": ("higher", 0.3),
    "tracker, M = 32, `estimate` by numba / numba loop": ("higher", 0.4),
    "blob filter, 32 events per step / numba loop": ("higher", 0.5),
    "blob filter, 64 blobs vmapped / numba loop": ("higher", 0.5),
    "blob: RMSE of 32 events per step / event by event": ("lower", 0.02),
    "planar voting, N = 200 / numba loop": ("higher", 0.4),
    "rotation voting, N = 200 / numba loop": ("higher", 0.4),
    "general voting, N = 500 / numba loop": ("higher", 0.4),
    "peak memory of 10 M events, GB": ("lower", 0.25),
}


def images() -> Found:
    from bench_images import files_bench, stream

    return files_bench(stream(5_000_000, 2.0, 0))


def xla() -> Found:
    from bench_images import stream, xla_bench

    return xla_bench(stream(5_000_000, 2.0, 0))


def smoother() -> Found:
    from bench_smoother import smoother_bench

    return smoother_bench()


def tracker() -> Found:
    from bench_blob import tracker_bench

    return tracker_bench()


def blob() -> Found:
    from bench_blob import blob_bench

    return blob_bench()


def voting() -> Found:
    from bench_motion import voting_bench

    return voting_bench()


def motion() -> Found:
    from bench_motion import motion_bench

    return motion_bench()


def memory() -> Found:
    from streaming import measure

    row = measure(10_000_000)
    return {}, {"peak memory of 10 M events, GB": row["peak"]}


def gpu() -> str:
    from bench_gpu import gpu_bench

    return gpu_bench()


def path() -> str:
    from bench_path import path_bench

    return path_bench()


PARTS: dict[str, Callable[[], Found]] = {
    "images": images,
    "xla": xla,
    "smoother": smoother,
    "tracker": tracker,
    "blob": blob,
    "voting": voting,
    "motion": motion,
    "memory": memory,
}
TABLES = {"gpu": gpu, "path": path}  # alone, without a gate
USUAL = [name for name in PARTS if name not in ("blob", "motion")]


def machine() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [v for v in cpuinfo.read_text().splitlines() if v.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else model
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, jax "
        f"{jax.__version__}, float32"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join([*PARTS, *TABLES])}")
    parser.add_argument(
        "--gate", action="store_true", help="exit with 1 if worse than the baseline"
    )
    parser.add_argument("--bless", action="store_true", help="write the baseline")
    parser.add_argument("--json", type=Path, help="write all numbers")
    arguments = parser.parse_args()
    parts = arguments.parts or USUAL
    if len(parts) == 1 and parts[0] in TABLES:
        print(f"{machine()}\n\n{TABLES[parts[0]]()}")
        return 0
    if unknown := set(parts) - set(PARTS):
        parser.error(f"there are no parts {', '.join(sorted(unknown))}")
    speed, ratio = {}, {}
    for name in parts:
        print(name, file=sys.stderr, flush=True)
        more, ratios = PARTS[name]()
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
    """1 if a ratio is worse than the baseline by more than its tolerance."""
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
