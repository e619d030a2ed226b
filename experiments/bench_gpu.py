"""A GPU against the CPU's kernels, by the clock: `python experiments/bench.py gpu`.

Images of the filter and the smoother from memory, a loss with 8 gradients, a tracker of 64 targets
and voting, each by XLA on JAX's default device and by a kernel on all cores of the CPU. The table
is in M events per second, without files. Without a GPU the default device is the CPU.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
from bench_images import images, losses, stream

import jaxevent
from jaxevent.blob import moment
from jaxevent.egomotion import voting
from jaxevent.simulate import LinearMotion, Target, motion_scene, simulate_blobs

REPEAT = 3  # of which the first compiles
EVENTS = 5_000_000


def targets() -> tuple[Any, list[tuple[float, float, float]]]:
    """64 blobs that cross an image of 1280x720, and where they begin."""
    places = [(100.0 + 140 * (k % 8), 60.0 + 80 * (k // 8)) for k in range(64)]
    lines = [LinearMotion(at, (60.0, 20.0), size=(6.0, 6.0)) for at in places]
    recording, _ = simulate_blobs([Target(line, 1e4) for line in lines], (1280, 720), 1.0, 0.0)
    return recording, [(x, y, 12.0) for x, y in places]


def tasks(events: int) -> dict[str, tuple[int, Callable[[str], object]]]:
    """By name the number of events, and what is timed, given the compiler."""
    recording = stream(events, 2.0, 0)
    of_losses = losses(recording)
    many, seeds = targets()
    scene, _ = motion_scene("rotation", "constant", 200, size=(160, 120), duration=0.1)

    def made(method: Any) -> Callable[[str], object]:
        return functools.partial(images, recording, rate=100, method=method)

    def track(compiler: str) -> None:
        params = moment.Params(events_per_step=32)
        moment.estimate(many, params, seeds=seeds, compiler=compiler, progress=False)

    def vote(compiler: str) -> None:
        voting.estimate(scene, model="rotation", compiler=compiler, progress=False)

    return {
        "akf, 100 Hz images": (events, made(jaxevent.akf)),
        "aks, 100 Hz images": (events, made(jaxevent.aks)),
        "akf, loss and 8 gradients": (events, lambda compiler: of_losses[f"{compiler} gradient"]()),
        "moment, 64 targets": (len(many.events), track),
        "voting, rotation": (len(scene.events), vote),
    }


def gpu_bench(events: int = EVENTS) -> str:
    """The table."""
    device, host = jax.devices()[0], jax.devices("cpu")[0]
    rows = [f"| M events/s | {device.device_kind} | kernel, CPU |", "|---|---:|---:|"]
    for name, (count, task) in tasks(events).items():
        speeds = []
        for compiler, where in (("xla", device), ("numba", host)):
            with jax.default_device(where):
                seconds = []
                for _ in range(REPEAT):
                    start = time.perf_counter()
                    task(compiler)
                    seconds.append(time.perf_counter() - start)
            speeds.append(count / 1e6 / min(seconds[1:]))
        rows.append(f"| {name} | {speeds[0]:.2f} | {speeds[1]:.2f} |")
        print(rows[-1], flush=True)
    return "\n".join(rows)
