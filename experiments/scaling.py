"""Cost of each family against events, pixels, images, targets and cores, with slopes.

    python experiments/scaling.py --out scaling [--only akf aks mc events-only track find voting]
        [--cores]

CPU seconds of this process, the least of two turns after one that compiles. A slope is that of ln
CPU seconds over ln size between the two largest sizes: 1 is linear, 0 no cost. All else stays as it
is while one is changed: random events of `bench_images.stream`; for `mc` and `events-only` the
packaged recording, with every second or fourth event, or side by side with itself; for motion and
targets scenes of `jaxevent.simulate`. The busiest thread's part of all CPU seconds bounds the gain
of more cores. `--cores` shows the clock's seconds instead, of the largest task of each family's
first row, in processes that may use one core and two; nothing else may run beside it.
"""

import contextlib
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from bench_images import stream, tile
from common import command_line, machine, markdown_table, write_text

import jaxevent
from jaxevent.blob import find, moment
from jaxevent.egomotion import voting
from jaxevent.io import load
from jaxevent.recording import Events, Recording
from jaxevent.runs.demo import RECORDING_FILE
from jaxevent.simulate import LinearMotion, Target, motion_scene, simulate_blobs

SEED = 100
SENSORS = ((120, 90), (240, 180), (480, 360))


def image_task(
    method: Any, events: int, size: tuple[int, int], images: int, seconds: float = 0.4
) -> Callable[[], object]:
    """Return the task of making images of random events, in memory, evenly spread in time."""
    recording = stream(events, seconds, SEED, size)
    times = np.linspace(recording.start, recording.stop, images + 2)[1:-1].astype(int)

    def run() -> None:
        for _ in method.estimate(recording, method.Params(), progress=False).batches(times):
            pass

    return run


def images_of(method: Any, events: int, images: int, factor: int) -> dict[str, dict[Any, Callable]]:
    """Return tasks by what is changed, from a number of events and images, and times `factor`."""
    middle = SENSORS[1]
    return {
        "events": {
            n: image_task(method, n, middle, images)
            for n in (events, factor * events, factor**2 * events)
        },
        "pixels": {
            w * h: image_task(method, factor * events, (w, h), images) for w, h in SENSORS
        },
        "images": {
            n: image_task(method, factor * events, middle, n)
            for n in (images, factor * images, factor**2 * images)
        },
    }  # fmt: skip


def packaged_task(
    method: Any, every: int = 1, tiles: tuple[int, int] = (1, 1), images: int = 4
) -> tuple[Recording, Callable[[], object]]:
    """Return a recording made of the packaged one, and the task of making images at 100 Hz."""
    recording = load(str(RECORDING_FILE))
    e = recording.events[:]
    kept = Events(*(getattr(e, name)[::every] for name in "txyp"))
    recording = tile(dataclasses.replace(recording, events=kept), *tiles)
    times = recording.start + 300_000 + 10_000 * np.arange(images)
    return recording, lambda: method.estimate(recording, method.Params(), progress=False)(times)


def packaged_images_of(method: Any) -> dict[str, dict[Any, Callable]]:
    """Return tasks by what is changed, of images of the packaged recording."""
    found: dict[str, dict[Any, Callable]] = {"events": {}, "pixels": {}, "images": {}}
    for every in (4, 2, 1):
        recording, task = packaged_task(method, every)
        found["events"][len(recording.events)] = task
    for tiles in ((1, 1), (2, 1), (2, 2)):
        recording, task = packaged_task(method, tiles=tiles)
        found["pixels"][recording.width * recording.height] = task
    for images in (2, 4, 8):
        found["images"][images] = packaged_task(method, images=images)[1]
    return found


def blobs(targets: int, rate: float, size: tuple[int, int] = (240, 180)) -> tuple[Any, list[Any]]:
    """Return a recording of targets that go to the right, with events per second, and seeds."""
    y = (np.arange(targets) + 0.5) * size[1] / targets
    made = [Target(LinearMotion((20.0, float(at)), (150.0, 0.0)), rate / targets) for at in y]
    recording, _ = simulate_blobs(made, size, 0.4, 0.05 * rate, SEED)
    return recording, [(20.0, float(at), 4.0) for at in y]


def track_task(targets: int, rate: float) -> Callable[[], object]:
    recording, seeds = blobs(targets, rate)
    return lambda: moment.estimate(recording, seeds=seeds).filtered(recording.stop)


def find_task(targets: int, rate: float, size: tuple[int, int] = (240, 180)) -> Callable:
    recording, _ = blobs(targets, rate, size)
    return lambda: find(recording)


def voting_task(particles: int, points: float, size: tuple[int, int]) -> Callable[[], object]:
    recording, _ = motion_scene("rotation", "constant", SEED, size=size, duration=points)
    params = voting.Params(particles=particles)
    return lambda: voting.estimate(recording, params, model="rotation", progress=False)


FAMILIES: dict[str, Callable[[], dict[str, dict[Any, Callable[[], object]]]]] = {
    "akf": lambda: images_of(jaxevent.akf, 250_000, 10, 4),
    "aks": lambda: images_of(jaxevent.aks, 250_000, 10, 4),
    "mc": lambda: packaged_images_of(jaxevent.mc),
    "events-only": lambda: packaged_images_of(jaxevent.events_only),
    "track": lambda: {
        "events": {n: track_task(4, n / 0.4) for n in (10**5, 4 * 10**5, 16 * 10**5)},
        "targets": {n: track_task(n, 10**6) for n in (2, 8, 32)},
    },
    "find": lambda: {
        "events": {n: find_task(2, n / 0.4) for n in (10**5, 2 * 10**5, 4 * 10**5)},
        "targets": {n: find_task(n, 5e5) for n in (1, 2, 4)},
        "pixels": {w * h: find_task(2, 5e5, (w, h)) for w, h in SENSORS},
    },
    "voting": lambda: {
        "particles": {n: voting_task(n, 0.2, (120, 90)) for n in (50, 200, 800)},
        "seconds": {s: voting_task(200, s, (120, 90)) for s in (0.1, 0.2, 0.4)},
    },
}  # fmt: skip


def thread_seconds() -> dict[str, float]:
    """Return the CPU seconds of each thread of this process, by its number."""
    tick, found = os.sysconf("SC_CLK_TCK"), {}
    for task in os.listdir("/proc/self/task"):
        with contextlib.suppress(FileNotFoundError):  # of a thread that has ended meanwhile
            with open(f"/proc/self/task/{task}/stat") as file:
                user, system = file.read().rpartition(")")[2].split()[11:13]
            found[task] = (int(user) + int(system)) / tick
    return found


def measure(task: Callable[[], object]) -> tuple[float, float]:
    """Return CPU seconds, and the share of them that the busiest thread takes."""
    task()
    best = np.inf, 1.0
    for _ in range(2):
        threads, start = thread_seconds(), time.process_time()
        task()
        seconds = time.process_time() - start
        spent = [now - threads.get(name, 0.0) for name, now in thread_seconds().items()]
        best = min(best, (seconds, min(1.0, max(spent) / max(sum(spent), 1e-9))))
    return best


def slope(sizes: Iterable[float], seconds: Iterable[float]) -> float:
    """Return the slope of ln seconds over ln size between the last two."""
    (n, more), (few, many) = list(sizes)[-2:], list(seconds)[-2:]
    return float(np.log(many / few) / np.log(more / n))


def rows_of(family: str) -> list[list[Any]]:
    """Measure a family; returns a row for each size that is changed."""
    rows = []
    for changed, tasks in FAMILIES[family]().items():
        measured = [measure(task) for task in tasks.values()]
        seconds = [one for one, _ in measured]
        sizes = ", ".join(f"{n:g}" for n in tasks)
        cost = ", ".join(f"{one:.3g}" for one in seconds)
        rows.append([family, changed, sizes, cost, slope(tasks, seconds), 1 / measured[-1][1]])
        print(rows[-1], flush=True)
    return rows


# Costs that are to grow no faster than what is changed.
LINEAR = (("akf", "events"), ("mc", "pixels"), ("track", "targets"), ("find", "events"))


def scaling_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure the slopes of `LINEAR`, for `bench.py`."""
    ratios = {}
    for family, changed in LINEAR:
        tasks = FAMILIES[family]()[changed]
        slopes = slope(tasks, [measure(task)[0] for task in tasks.values()])
        ratios[f"scaling: {family}, slope by {changed}"] = slopes
    return {}, ratios


def clock_seconds(family: str) -> float:
    """Return the seconds of the largest task of a family's first row, the least of three."""
    *_, task = next(iter(FAMILIES[family]().values())).values()
    task()
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        task()
        best = min(best, time.perf_counter() - start)
    return best


def core_row(family: str) -> list[Any]:
    """Measure a family on one core and on two: the clock's seconds, and their ratio."""
    seconds = []
    for n_cores in (1, 2):
        # Libraries count the cores that they may use when they are imported.
        code = (
            "import os; allowed = sorted(os.sched_getaffinity(0)); "
            f"os.sched_setaffinity(0, allowed[:{n_cores}]); "
            f"import scaling; print(scaling.clock_seconds({family!r}))"
        )
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, cwd=os.path.dirname(__file__), check=True, stdout=subprocess.PIPE, text=True
        )
        seconds.append(float(done.stdout.split()[-1]))
    row = [family, *seconds, seconds[0] / seconds[1]]
    print(row, flush=True)
    return row


def main() -> None:
    parser = command_line(__doc__, out=True, parts=FAMILIES)
    parser.add_argument("--cores", action="store_true", help="the clock on one core and on two")
    options = parser.parse_args()
    if options.cores:
        rows = [core_row(family) for family in options.only]
        table = markdown_table(["family", "s, one core", "s, two cores", "ratio"], rows)
    else:
        rows = [row for family in options.only for row in rows_of(family)]
        header = ["family", "changed", "sizes", "CPU s", "slope", "gain of cores at most"]
        table = markdown_table(header, rows, 4)
    text = f"{machine()}\n\n{table}\n"
    write_text(options.out / ("cores.md" if options.cores else "scaling.md"), text)
    print(text)


if __name__ == "__main__":
    main()
