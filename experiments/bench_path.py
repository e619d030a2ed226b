"""Where the time of the complete path and of gradients goes: `python experiments/bench.py path`.

The complete path is that of `images`: 5 M events of a file become 200 images. Its parts are the
functions that the video calls; what is left is opening the file, tables and windows. By the clock
it uses all cores. A loss of 8 images is timed with its gradient by more and more parameters.
"""

import contextlib
import functools
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from bench_images import NUMBERS, OF_AKF, images, losses, program, stream
from timing import least_cpu

from jaxevent.io import load, save
from jaxevent.reconstruction.engine import bands, filter_loop
from jaxevent.recording import Events

Seconds = defaultdict[str, float]
TURNS = 5
PARAMETERS = (1, 2, 4, 8)


@contextlib.contextmanager
def timed(parts: Seconds, **functions: tuple[Any, str]) -> Iterator[None]:
    """Add up the CPU seconds of methods, given as name=(class, method)."""
    with contextlib.ExitStack() as stack:
        for name, (owner, method) in functions.items():
            inner = getattr(owner, method)

            def outer(*args: Any, inner: Any = inner, name: str = name, **kwargs: Any) -> Any:
                start = time.process_time()
                try:
                    return inner(*args, **kwargs)
                finally:
                    parts[name] += time.process_time() - start

            stack.enter_context(mock.patch.object(owner, method, outer))
        yield


def least_parts(run: Callable[[], object], columns: type) -> tuple[float, float, Seconds]:
    """CPU and clock seconds of the turn that took least, and what its parts took."""
    found = []
    for _ in range(TURNS + 1):  # the first compiles
        parts: Seconds = defaultdict(float)
        start, cpu = time.perf_counter(), time.process_time()
        with timed(
            parts,
            passes=(filter_loop.FilterPasses, "run"),
            division=(bands.BandLayout, "partition"),
            columns=(columns, "columns"),
        ):
            run()
        found.append((time.process_time() - cpu, time.perf_counter() - start, parts))
    return min(found[1:], key=lambda one: one[0])


def path_bench() -> str:
    """Two tables: the parts of the complete path, and losses by the number of parameters."""
    recording = stream(5_000_000, 2.0, 0)
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    n, grey = len(e) / 1e6, frames.intensity.astype(np.float64)
    whole = least_cpu({"it": lambda: program(e.t, e.x, e.y, e.p, grey, frames.t, *NUMBERS)})["it"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.h5"
        save(recording, path)
        kind = type(load(path, in_memory=False).events)
        cpu, clock, parts = least_parts(functools.partial(images, path, None, 100), kind)
        _, _, few = least_parts(functools.partial(images, path, None, 1), kind)
    many = parts["passes"] - few["passes"]
    rows = {
        "passes over the events, 2 images": few["passes"],
        "198 images more": many,
        "division into bands": parts["division"],
        "reading columns": parts["columns"],
        "opening, tables, windows": cpu - sum(parts.values()),
    }
    lines = [f"| CPU seconds of {n:.0f} M events, 200 images | {cpu:.3f} |", "|---|---:|"]
    lines += [f"| {name} | {seconds:.3f} |" for name, seconds in rows.items()]
    lines += [f"| by the clock | {clock:.3f} |", f"| numba program | {whole:.3f} |"]
    return "\n".join([*lines, "", *slopes(recording)])


def slopes(recording: Any) -> list[str]:
    """Losses and gradients by the first few parameters, as multiples of the loss alone."""
    tasks = {}
    for count in PARAMETERS:
        made = losses(recording, names=OF_AKF[:count], compilers=("numba",))
        tasks[f"{count}"] = made["numba gradient"]
        tasks["loss"] = made["numba loss"]
    least = least_cpu(tasks)
    lines = ["| gradient by parameters | of the loss |", "|---:|---:|"]
    return [*lines, *(f"| {k} | {least[f'{k}'] / least['loss']:.2f} |" for k in PARAMETERS)]
