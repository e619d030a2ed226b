"""Recordings larger than memory: `reconstruct` at 1e7, 1e8 and 1e9 events.

    python experiments/streaming.py --out streaming [--events 1e7 1e8 1e9] [--disk DIR]

Recordings of 346x260 pixels with 10 M events/s at gamma-distributed rates per pixel and 25 frames
per second are made on disk (13 bytes an event), and read by

    jaxevent reconstruct FILE --method akf --rate 100 --out images.h5

in a process of its own. The table says its time, compilation included, and its peak memory. Needs
28 GB of disk for 1e9 events.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import command_line, machine, write_text

from jaxevent.io import save
from jaxevent.recording import Events, Frames, Recording
from jaxevent.show.tables import results_table

WIDTH, HEIGHT, RATE, FPS = 346, 260, 10_000_000, 25
BLOCK = 1_000_000  # events
DRAWN = 16  # blocks that differ; later ones repeat them, so that to make files takes little time


class Drawn:
    """Events that are drawn when they are read, those of block k from the seed [0, k % DRAWN]."""

    def __init__(self, count: int):
        self.count = count
        rate = np.random.default_rng(1).gamma(2.0, 1.0, WIDTH * HEIGHT)
        self.steps = np.cumsum(rate / rate.sum())
        self.drawn: dict[int, Events] = {}

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, rows: slice) -> Events:
        first, stop, _ = rows.indices(self.count)
        parts = []
        for k in range(first // BLOCK, max(-(-stop // BLOCK), first // BLOCK + 1)):
            block = self._block(k)
            parts.append(block[max(first - k * BLOCK, 0) : max(stop - k * BLOCK, 0)])
        return Events(*(np.concatenate([getattr(e, n) for e in parts]) for n in "txyp"))

    def index(self, time: int) -> int:
        k = min(max(time, 0) * RATE // 1_000_000 // BLOCK, (self.count - 1) // BLOCK)
        return min(k * BLOCK + self._block(k).index(time), self.count)

    def _block(self, k: int) -> Events:
        span = BLOCK * 1_000_000 // RATE
        if k % DRAWN not in self.drawn:
            rng = np.random.default_rng([0, k % DRAWN])
            pixel = np.searchsorted(self.steps, rng.random(BLOCK)).clip(0, WIDTH * HEIGHT - 1)
            y, x = (part.astype(np.uint16) for part in np.divmod(pixel, WIDTH))
            t = np.sort(rng.integers(0, span, BLOCK))
            self.drawn[k % DRAWN] = Events(t, x, y, rng.random(BLOCK) < 0.5)
        block = self.drawn[k % DRAWN]
        return dataclasses.replace(block, t=block.t + k * span)


class Noise:
    """Frames of noise that are drawn when they are read."""

    dtype = np.dtype(np.uint8)

    def __init__(self, rows: range):
        self.rows = rows

    @property
    def shape(self) -> tuple[int, ...]:
        return len(self.rows), HEIGHT, WIDTH

    def __getitem__(self, rows: slice) -> "Noise":
        return Noise(self.rows[rows])

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        images = [
            np.random.default_rng([2, k]).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
            for k in self.rows
        ]
        return np.array(images, dtype or np.uint8).reshape(self.shape)


def recording(count: int) -> Recording:
    frames = max(count * FPS // RATE, 1)
    t = np.arange(frames) * (1_000_000 // FPS) + 5_000
    none = np.zeros(frames, np.int64)
    return Recording(
        f"{count:.0e} events", WIDTH, HEIGHT, Drawn(count), Frames(t, Noise(range(frames)), none)
    )


def run_process(arguments: list[str]) -> tuple[float, float, float]:
    """Seconds, CPU seconds and peak memory (GB) of a process; raises if it fails."""
    clock, spent, peak = time.perf_counter(), children_cpu(), 0
    process = subprocess.Popen(arguments)

    def watch() -> None:
        nonlocal peak
        while process.poll() is None:
            try:
                lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
            except OSError:
                return
            peaks = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
            peak = max([peak, *peaks])
            time.sleep(0.2)

    watcher = threading.Thread(target=watch)
    watcher.start()
    if process.wait():
        raise SystemExit(f"{' '.join(arguments)} ended with {process.returncode}")
    seconds = time.perf_counter() - clock
    watcher.join()
    return seconds, children_cpu() - spent, peak / 2**20


def children_cpu() -> float:
    """CPU seconds of the processes that this one has started and waited for."""
    times = os.times()
    return times.children_user + times.children_system


def measure(count: int, disk: Path | None = None) -> dict[str, Any]:
    """Make a recording of so many events, and reconstruct it."""
    with tempfile.TemporaryDirectory(dir=disk) as folder:
        source, images = Path(folder) / "events.h5", Path(folder) / "images.h5"
        clock = time.perf_counter()
        save(recording(count), source, progress=sys.stderr.isatty())
        made = time.perf_counter() - clock
        seconds, cpu, peak = run_process(
            [
                *(sys.executable, "-m", "jaxevent", "reconstruct", str(source)),
                *("--method", "akf", "--rate", "100", "--out", str(images)),
            ]
        )
        return {
            "events": f"{count:.0e}",
            "disk": source.stat().st_size / 1e9,
            "made": made,
            "seconds": seconds,
            "cpu": cpu,
            "rate": count / seconds / 1e6,
            "peak": peak,
            "written": images.stat().st_size / 1e9,
        }


def memory_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure the peak memory of 10 M events."""
    return {}, {"peak memory of 10 M events, GB": measure(10_000_000)["peak"]}


def main() -> int:
    parser = command_line(__doc__, out=True)
    parser.add_argument("--events", type=float, nargs="+", default=[1e7, 1e8, 1e9])
    parser.add_argument("--disk", type=Path, help="where recordings are made; default: temporary")
    arguments = parser.parse_args()
    rows = []
    for count in map(int, arguments.events):
        rows.append(measure(count, arguments.disk))
        print(rows[-1], file=sys.stderr, flush=True)
    columns = [
        ("events GB", "disk", 1, 2),
        ("made s", "made", 1, 1),
        ("reconstructed s", "seconds", 1, 1),
        ("CPU s", "cpu", 1, 1),
        ("M events/s", "rate", 1, 2),
        ("peak GB", "peak", 1, 2),
        ("images GB", "written", 1, 2),
    ]
    table = results_table(
        [{"recording": r["events"] + " events", "method": "akf", **r} for r in rows], columns
    )
    text = f"{machine()}\n\n{table}"
    print(text)
    write_text(arguments.out / "table.md", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
