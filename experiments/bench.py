"""Speed, memory and compilation of reconstruction, as ratios measured in one run.

    python experiments/bench.py [--gate | --bless] [--json FILE] [--skip-memory]
                                [--blob | --motion | --video]

A stream of 5 M events at 346x260 (gamma-distributed pixel rates, 2 s, 25 frames per second) is
filtered, prepared and read. Beside it run, on one core: the whole filter as a plain numba program
over events, which is what a C++ program does; its recursion with and without the look-up of
neighbours; and the Accumulator of dv-processing. The tracker of blobs runs on a simulated blob,
beside the same filter as a numba loop and what its authors publish, 0.1 M updates/s; `--blob` runs
nothing else, `--motion` nothing but egomotion, see bench_motion.py, and `--video` nothing but the
complete path, in CPU seconds. `--gate` compares the
ratios with bench_baseline.json and exits with 1 if one is worse than its tolerance; `--bless`
writes them.
"""

import argparse
import functools
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numba
import numpy as np
from bench_motion import motion_bench

import jaxevent
from jaxevent.blob import find, moment
from jaxevent.blob.filters.ellipse import truncation
from jaxevent.blob.fused.tracking import FusedRun
from jaxevent.blob.lifecycle import begin as begin_state
from jaxevent.blob.prepare import Packing
from jaxevent.blob.steps import Batch
from jaxevent.io import load, save
from jaxevent.io.hdf5_files import search_heaps
from jaxevent.reconstruction.filtering import Observation, Observer, State, Trajectory
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import Events, Frames, Recording
from jaxevent.simulate import Line, Target, blob_scene, simulate_blobs

WIDTH, HEIGHT = 346, 260
BASELINE = Path(__file__).with_name("bench_baseline.json")

# Direction and relative tolerance of what the gate compares; timings share two noisy cores.
GATED = {
    "filter / numba program": ("higher", 0.5),
    "filter / numba loop with neighbour look-up": ("higher", 0.5),
    "features and packing / numba program": ("higher", 0.5),
    "loss and gradient of 8 parameters / loss": ("lower", 0.5),
    "complete path / dv-processing Accumulator": ("higher", 0.5),
    "complete path / the same compiled by XLA, CPU": ("higher", 0.5),
    "compilations for a second recording": ("lower", 0.0),
    "peak memory of 100 M events, GB": ("lower", 0.25),
    "blob filter, event by event / numba loop": ("higher", 0.5),
    "blob filter, 32 events per step / numba loop": ("higher", 0.5),
    "blob filter, 64 blobs vmapped / numba loop": ("higher", 0.5),
    "blob.track, 32 events per step / numba loop": ("higher", 0.5),
    "blob: RMSE of 32 events per step / event by event": ("lower", 0.02),
}


def stream(
    events: int, seconds: float, seed: int, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Recording:
    """Events at gamma-distributed rates per pixel, frames of noise at 25 per second."""
    rng = np.random.default_rng(seed)
    width, height = size
    rate = rng.gamma(2.0, 1.0, width * height)
    pixel = rng.choice(width * height, events, p=rate / rate.sum())
    t = np.sort(rng.integers(0, int(seconds * 1e6), events))
    y, x = np.divmod(pixel, width)
    frames = int(25 * seconds)
    return Recording(
        "bench",
        width,
        height,
        Events(t, x.astype(np.uint16), y.astype(np.uint16), rng.random(events) < 0.5),
        Frames(
            (np.arange(frames) * 40_000 + 5_000).astype(np.int64),
            rng.integers(0, 256, (frames, height, width), np.uint8),
            np.zeros(frames, np.int64),
        ),
    )


@numba.njit
def program(t, x, y, p, grey, mid, c, Q_proc, Q_iso, Q_ref, rho, kappa, w_min):
    """The whole AKF as an event-by-event program: calibration per frame, then event after event.

    Double precision, one core, exposures not known; the arithmetic of the library's filter.
    """
    frames, height, width = grey.shape
    L, P = np.log(grey[0] + 1), np.full((height, width), 0.09)
    last = np.zeros((height, width), np.int64)
    density = 1 / (kappa * np.maximum(4 * grey * (1 - grey), w_min))
    S, total = np.zeros((height, width)), np.zeros((height, width))
    base, ratio = np.log(grey[0] + 1), np.ones((height, width))
    end, k = base, -1
    for i in range(len(t)):
        while k + 1 < frames and t[i] >= mid[k + 1]:
            k += 1
            base, ratio = np.log(grey[k] + 1), np.ones((height, width))
            S[:] = 0
            if k + 1 < frames:  # look ahead for the interval's events, (10)
                end = np.log(grey[k + 1] + 1)
                total[:] = 0
                j = i
                while j < len(t) and t[j] < mid[k + 1]:
                    total[y[j], x[j]] += c if p[j] else -c
                    j += 1
                for row in range(height):
                    for column in range(width):
                        if total[row, column] != 0:
                            r = (end[row, column] - base[row, column]) / total[row, column]
                            if 0.01 <= r <= 1 / 0.6:
                                ratio[row, column] = r
        a, b = np.int64(y[i]), np.int64(x[i])
        near = np.int64(0)
        for row in range(max(a - 1, 0), min(a + 2, height)):
            for column in range(max(b - 1, 0), min(b + 2, width)):
                near = max(near, last[row, column])
        if k < 0:
            u, bright, R = base[a, b] + S[a, b], grey[0, a, b], density[0, a, b]
        elif k + 1 == frames:
            u, bright, R = base[a, b] + S[a, b], grey[k, a, b], density[k, a, b]
        else:
            v = (t[i] - mid[k]) / (mid[k + 1] - mid[k])
            forward = base[a, b] + ratio[a, b] * S[a, b]
            backward = end[a, b] - ratio[a, b] * (total[a, b] - S[a, b])
            u = (1 - v) * forward + v * backward
            bright = (1 - v) * grey[k, a, b] + v * grey[k + 1, a, b]
            R = (1 - v) * density[k, a, b] + v * density[k + 1, a, b]
        dt = (t[i] - last[a, b]) * 1e-6
        gain = 1 / (1 + P[a, b] * dt * (bright + 1) ** 2 / R)
        change = c if p[i] else -c
        L[a, b] = (L[a, b] - u) * gain + u + change
        Q = Q_proc * dt + Q_iso * (t[i] - near) * 1e-6 + (Q_ref if dt <= rho else 0.0)
        P[a, b] = P[a, b] * gain + Q
        S[a, b] += change
        last[a, b] = t[i]
    return L, P


@numba.njit
def event_loop(t, x, y, p, u, rate, near, L, P, last, c, Q_proc, Q_iso, Q_ref, rho, search):
    """The recursion alone, event after event, what the frames say given; near given or searched."""
    height, width = L.shape
    for i in range(len(t)):
        a, b = np.int64(y[i]), np.int64(x[i])
        dt = (t[i] - last[a, b]) * np.float32(1e-6)
        gap = near[i]
        if search:
            latest = np.int64(0)
            for row in range(max(a - 1, 0), min(a + 2, height)):
                for column in range(max(b - 1, 0), min(b + 2, width)):
                    latest = max(latest, last[row, column])
            gap = (t[i] - latest) * np.float32(1e-6)
        gain = 1 / (1 + P[a, b] * dt * rate[i])
        L[a, b] = (L[a, b] - u[i]) * gain + u[i] + (c if p[i] else -c)
        P[a, b] = P[a, b] * gain + Q_proc * dt + Q_iso * gap + (Q_ref if dt <= rho else 0.0)
        last[a, b] = t[i]


class Given(Observer):
    """Observations that are already there, carried in place of the points' weights."""

    def __call__(self, points):
        return Observation(points.weight, points.blend)


def best(function, repeat: int = 5) -> float:
    """The least of some times, s; the first call, which compiles, is not counted."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def program_seconds(recording: Recording) -> float:
    e, f = recording.events, recording.frames
    assert isinstance(e, Events) and f is not None
    grey = f.intensity.astype(np.float64)
    numbers = (0.1, 5e-4, 0.03, 0.01, 0.01, 7e5, 0.09)
    L, P = program(e.t, e.x, e.y, e.p, grey, f.t, *numbers)
    # The same filter: at the last event of a pixel both must agree.
    features, out = jaxevent.akf.prepare(recording, [recording.stop])
    trajectory, end = jax.jit(jaxevent.akf.run)(jaxevent.akf.Params(), features)
    assert np.abs(end.L.reshape(L.shape) - L).max() < 1e-3, "the program is another filter"
    return best(lambda: program(e.t, e.x, e.y, e.p, grey, f.t, *numbers))


def loop_seconds(recording: Recording, search: bool) -> float:
    e = recording.events
    assert isinstance(e, Events)
    n = len(e)
    u, rate, near = (np.full(n, v, np.float32) for v in (0.4, 1e5, 1e-3))

    def run():
        L, P = np.zeros((HEIGHT, WIDTH), np.float32), np.full((HEIGHT, WIDTH), 0.09, np.float32)
        last = np.zeros((HEIGHT, WIDTH), np.int64)
        c, Q_proc, Q_iso, Q_ref, rho = (np.float32(v) for v in (0.1, 5e-4, 0.03, 0.01, 0.01))
        event_loop(
            e.t, e.x, e.y, e.p, u, rate, near, L, P, last, c, Q_proc, Q_iso, Q_ref, rho, search
        )

    return best(run, 20)  # 50 ms each, and the cores are shared


def filter_seconds(recording: Recording) -> float:
    """All windows' filters, with what the frames say and the features already on the device."""
    params = jaxevent.akf.Params()
    look = jax.jit(lambda observer, tiles: observer(tiles.points))
    windows = []
    for _, features in WindowedRecording(recording):
        features = jax.device_put(features)
        observer = jaxevent.akf.observe(params, features.frames)
        known = look(observer, features.tiles)
        tiles = eqx.tree_at(
            lambda t: (t.points.weight, t.points.blend), features.tiles, (known.level, known.rate)
        )
        windows.append((tiles, features.last))

    @jax.jit
    def scan(params, tiles, last, state):
        path = jaxevent.akf.scan(params, Given(), tiles, state)
        return Trajectory(Given(), state, path).at(last), path

    pixels = WIDTH * HEIGHT
    first = State(jax.numpy.zeros(pixels), jax.numpy.full(pixels, 0.09))

    def run():
        state = first
        for tiles, last in windows:
            state, path = scan(params, tiles, last, state)
            jax.block_until_ready(path)

    return best(run, 20)  # 50 ms each, and the cores are shared


def prepare_seconds(recording: Recording) -> float:
    def run():
        for _ in WindowedRecording(recording, reuse=True):
            pass

    return best(run)


def losses(recording: Recording) -> dict[str, Callable[[], object]]:
    """The mean squared error at 8 images, and it with its gradient by 8 parameters."""
    names = ("c_on", "c_off", "I0", "kappa", "w_min", "sigma_proc", "sigma_iso", "sigma_ref")
    frames = recording.frames
    assert frames is not None
    start, rows = jaxevent.akf.Params(preset="paper"), slice(1, 49, 6)
    truth = jax.numpy.asarray(frames.intensity[rows].reshape(8, -1))

    # Everything but the parameters is given as an argument, lest it be compiled as constants.
    def loss(raw, images, truth):
        image, _, _ = images(start.with_raw(raw), variance=False)
        return ((image - truth) ** 2).mean()

    raw, tasks = {name: start.raw[name] for name in names}, {}
    functions = {"loss": jax.jit(loss), "gradient": jax.jit(jax.value_and_grad(loss))}
    for compiler in ("numba", "xla"):
        times = frames.t[rows] + 20_000
        images = jaxevent.akf.prepare_images(recording, times, start, compiler=compiler)
        for name, function in functions.items():
            given = functools.partial(function, raw, images, truth)
            tasks[f"{compiler} {name}"] = lambda given=given: jax.block_until_ready(given())
    return tasks


def text_seconds(folder: Path, events: Events) -> float:
    """Reading events.txt of the Event-Camera Dataset."""
    import pandas

    columns = {"t": events.t * 1e-6, "x": events.x, "y": events.y, "p": events.p.astype(int)}
    pandas.DataFrame(columns).to_csv(
        folder / "events.txt", sep=" ", header=False, index=False, float_format="%.9f"
    )
    seconds = best(lambda: load(folder, size=(WIDTH, HEIGHT)), 3)
    (folder / "events.txt").unlink()
    return seconds


def complete_seconds(path: Path) -> tuple[float, float]:
    """From HDF5 to images at 100 Hz; returns the whole and the reading of the file, s."""
    params = jaxevent.akf.Params()
    reading = best(lambda: load(path))

    def run():
        recording = load(path)
        times = np.arange(recording.start, recording.stop, 10_000)
        for _ in jaxevent.akf.estimate(recording, params).batches(times):
            pass

    return best(run, 3), reading


def cpu_bench(recording: Recording, path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """The complete path by both compilers in CPU seconds, which other work on the machine spares.

    Interleaved, the least of each: the numba program, which makes no images; 100 and 500 images per
    second; and 5 M events of a sensor of 1280x720 in 2 s with 25 images per second, from memory.
    """
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    grey = frames.intensity.astype(np.float64)
    numbers = (0.1, 5e-4, 0.03, 0.01, 0.01, 7e5, 0.09)
    large = stream(5_000_000, 2.0, 1, (1280, 720))

    def read() -> Recording:
        search_heaps.cache_clear()  # as a process that reads the file for the first time
        return load(path)

    def images(given: Recording | None, compiler: Any, rate: int) -> None:
        given = read() if given is None else given
        times = np.arange(given.start, given.stop, 1_000_000 // rate)
        video = jaxevent.akf.estimate(given, compiler=compiler)
        for _ in video.batches(times):
            pass

    tasks = {
        "program": lambda: program(e.t, e.x, e.y, e.p, grey, frames.t, *numbers),
        "reading": read,
        **losses(recording),
    }
    for compiler in ("numba", "xla"):
        for name, given, rate in (("100", None, 100), ("500", None, 500), ("large", large, 25)):
            if (compiler, name) != ("xla", "500"):
                tasks[f"{compiler} {name}"] = functools.partial(images, given, compiler, rate)
    least: dict[str, float] = {}
    for repeat in range(4):
        for name, task in tasks.items():
            start = time.process_time()
            task()
            if repeat:  # the first compiles
                least[name] = min(least.get(name, np.inf), time.process_time() - start)
    extra = 1e9 * (least["numba 500"] - least["numba 100"]) / (800 * WIDTH * HEIGHT)
    n = len(e) / 1e6
    speed = {
        "numba program, per CPU second": n / least["program"],
        "reading HDF5, per CPU second": n / least["reading"],
        "complete path, per CPU second": n / least["numba 100"],
        "complete path compiled by XLA, per CPU second": n / least["xla 100"],
        "1280x720 at 25 Hz, per CPU second": n / least["numba large"],
        "1280x720 at 25 Hz compiled by XLA, per CPU second": n / least["xla large"],
        "loss, per CPU second": n / least["numba loss"],
        "loss and gradient of 8 parameters, per CPU second": n / least["numba gradient"],
        "loss compiled by XLA, per CPU second": n / least["xla loss"],
        "loss and gradient compiled by XLA, per CPU second": n / least["xla gradient"],
    }
    ratio = {
        "complete path / numba program, CPU": least["program"] / least["numba 100"],
        "the same without reading": least["program"] / (least["numba 100"] - least["reading"]),
        "complete path / the same compiled by XLA, CPU": least["xla 100"] / least["numba 100"],
        "ns of CPU per pixel of an image more": extra,
        "loss and 8 gradients / loss, CPU": least["numba gradient"] / least["numba loss"],
        "loss and 8 gradients / loss compiled by XLA, CPU": least["numba gradient"]
        / least["xla loss"],
    }
    return speed, ratio


def accumulator_seconds(recording: Recording) -> float:
    """dv-processing's Accumulator at 100 Hz on the same events, which it has in memory."""
    import dv_processing as dv  # type: ignore[import-not-found]

    e = recording.events
    assert isinstance(e, Events)
    slices = []
    for begin in range(0, recording.stop, 10_000):
        store = dv.EventStore()
        part = e[e.index(begin) : e.index(begin + 10_000)]
        for t, x, y, p in zip(*(v.tolist() for v in (part.t, part.x, part.y, part.p)), strict=True):
            store.push_back(t, x, y, p)
        slices.append(store)

    def run():
        accumulator = dv.Accumulator((WIDTH, HEIGHT))
        for store in slices:
            accumulator.accept(store)
            accumulator.generateFrame()

    return best(run, 3)


def compilations() -> int:
    """How often XLA compiles for a second recording of the same sensor."""
    heard = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            heard.append(event)

    def run(seed: int, events: int) -> None:
        recording = stream(events, 1.0 + seed, seed)
        times = np.arange(0, 10**6, 50_000)
        jaxevent.akf.estimate(recording, jaxevent.akf.Params())(times)

    run(0, 300_000)
    jax.monitoring.register_event_duration_secs_listener(listen)
    run(1, 2_500_000)
    jax.monitoring.clear_event_listeners()
    return len(heard)


def write_long(path: Path, millions: int) -> None:
    """A file of many events, written a million at a time in the layout of `jaxevent.io.hdf5`."""
    import h5py

    n, block = millions * 1_000_000, 1_000_000
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.attrs.update(width=WIDTH, height=HEIGHT, name="long", format="jaxevent", version=1)
        kinds = {"t": "i8", "x": "u2", "y": "u2", "p": "u1"}
        data = {k: file.create_dataset(f"events/{k}", (n,), kind) for k, kind in kinds.items()}
        file["t_offset"] = 0
        # Evenly spaced in time, 2.5 M events/s.
        file["ms_to_idx"] = np.arange(n * 4 // 10_000 + 1, dtype=np.uint64) * 2500
        for row in range(0, n, block):
            rows = slice(row, row + block)
            data["t"][rows] = np.arange(row, row + block) * 4 // 10
            data["x"][rows] = rng.integers(0, WIDTH, block)
            data["y"][rows] = rng.integers(0, HEIGHT, block)
            data["p"][rows] = rng.integers(0, 2, block)
        seconds = n * 4e-7
        t = np.arange(0, int(seconds * 25)) * 40_000
        file["frames/t"] = t
        file["frames/exposure"] = np.zeros_like(t)
        images = file.create_dataset("frames/images", (len(t), HEIGHT, WIDTH), "u1")
        for k in range(len(t)):
            images[k] = rng.integers(0, 256, (HEIGHT, WIDTH))


def reconstruct_long(path: str) -> None:
    """Run by itself: filter the file in windows, then print the peak memory of the process, GB."""
    recording = load(path, in_memory=False)
    start = time.perf_counter()
    times = np.arange(0, recording.stop, 200_000)
    for _ in jaxevent.akf.estimate(recording, jaxevent.akf.Params()).batches(times):
        pass
    seconds = time.perf_counter() - start
    # Not ru_maxrss, which begins at what the process that started this one used.
    status = Path("/proc/self/status").read_text().splitlines()
    peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 2**20
    print(json.dumps({"GB": peak, "seconds": seconds}))


def long_run(folder: Path) -> tuple[float, float]:
    path = folder / "long.h5"
    write_long(path, 100)
    done = subprocess.run(
        [sys.executable, __file__, "--long", str(path)], capture_output=True, text=True, check=True
    )
    answer = json.loads(done.stdout)
    return answer["GB"], answer["seconds"]


@numba.njit
def blob_loop(t, x, y, start, size, Q, P0, kappa, fourth, limits):
    """The `moment` filter of jaxevent.blob event by event, double precision: the state after each.

    Q and P0 are of (p, v, lambda, theta, q), P0 of log lambda; limits are lambda_min, lambda_max
    and P_theta_max.
    """
    px, py, vx, vy = start[0], start[1], 0.0, 0.0
    theta, q = 0.0, 0.0
    log1 = log2 = np.log(size)
    pxx, pxy, pyy = P0[0], 0.0, P0[0]
    axx, axy, ayx, ayy = 0.0, 0.0, 0.0, 0.0  # of position and velocity
    vxx, vxy, vyy = P0[1], 0.0, P0[1]
    P1 = P2 = P0[2]
    tt, tq, qq = P0[3], 0.0, P0[4]
    variance = 3 * fourth - kappa**2
    low, high = np.log(limits[0]), np.log(limits[1])
    out = np.empty((len(t), 4))
    last = 0
    for i in range(len(t)):
        dt = (t[i] - last) * 1e-6
        last = t[i]
        px, py = px + dt * vx, py + dt * vy
        more = Q[0] * dt + Q[1] * dt**3 / 3
        pxx += 2 * dt * axx + dt**2 * vxx + more
        pyy += 2 * dt * ayy + dt**2 * vyy + more
        pxy += dt * (axy + ayx) + dt**2 * vxy
        axx, ayy = axx + dt * vxx + Q[1] * dt**2 / 2, ayy + dt * vyy + Q[1] * dt**2 / 2
        axy, ayx = axy + dt * vxy, ayx + dt * vxy
        vxx, vyy = vxx + Q[1] * dt, vyy + Q[1] * dt
        P1, P2 = P1 + Q[2] * dt * np.exp(-2 * log1), P2 + Q[2] * dt * np.exp(-2 * log2)
        theta += dt * q
        tt += 2 * dt * tq + dt**2 * qq + Q[3] * dt + Q[4] * dt**3 / 3
        tq += dt * qq + Q[4] * dt**2 / 2
        qq += Q[4] * dt

        ex, ey = x[i] - px, y[i] - py
        c, s = np.cos(theta), np.sin(theta)
        l1, l2 = np.exp(log1), np.exp(log2)
        u1, u2 = c * ex + s * ey, c * ey - s * ex
        r1 = pxx * c * c + 2 * pxy * c * s + pyy * s * s
        r2 = pxx * s * s - 2 * pxy * c * s + pyy * c * c
        cross = (pyy - pxx) * c * s + pxy * (c * c - s * s)
        V1, V2 = kappa * l1**2 + r1, kappa * l2**2 + r2

        S11 = pxx + l1**2 * c * c + l2**2 * s * s
        S22 = pyy + l1**2 * s * s + l2**2 * c * c
        S12 = pxy + (l1**2 - l2**2) * c * s
        det = S11 * S22 - S12 * S12
        i11, i12, i22 = S22 / det, -S12 / det, S11 / det
        k11, k12 = pxx * i11 + pxy * i12, pxx * i12 + pxy * i22
        k21, k22 = pxy * i11 + pyy * i12, pxy * i12 + pyy * i22
        k31, k32 = axx * i11 + ayx * i12, axx * i12 + ayx * i22
        k41, k42 = axy * i11 + ayy * i12, axy * i12 + ayy * i22
        px, py = px + k11 * ex + k12 * ey, py + k21 * ex + k22 * ey
        vx, vy = vx + k31 * ex + k32 * ey, vy + k41 * ex + k42 * ey
        vxx, vxy, vyy = (
            vxx - k31 * axx - k32 * ayx,
            vxy - k31 * axy - k32 * ayy,
            vyy - k41 * axy - k42 * ayy,
        )
        axx, axy, ayx, ayy = (
            axx - k11 * axx - k12 * ayx,
            axy - k11 * axy - k12 * ayy,
            ayx - k21 * axx - k22 * ayx,
            ayy - k21 * axy - k22 * ayy,
        )
        pxx, pxy, pyy = (
            pxx - k11 * pxx - k12 * pxy,
            pxy - k11 * pxy - k12 * pyy,
            pyy - k21 * pxy - k22 * pyy,
        )

        a1, a2, b1, b2, b12 = l1**2 / V1, l2**2 / V2, r1 / V1, r2 / V2, cross / np.sqrt(V1 * V2)
        P1, P2 = min(P1, 1.0), min(P2, 1.0)
        slope, noise = variance * a1, variance * a1**2 + 4 * kappa * a1 * b1 + 2 * b1**2
        total = slope**2 * P1 + noise
        log1 += np.log1p(slope**2 * P1 / total * (u1**2 / V1 - 1)) / slope
        log1 = min(max(log1, low), high)
        P1 *= noise / total
        slope, noise = variance * a2, variance * a2**2 + 4 * kappa * a2 * b2 + 2 * b2**2
        total = slope**2 * P2 + noise
        log2 += np.log1p(slope**2 * P2 / total * (u2**2 / V2 - 1)) / slope
        log2 = min(max(log2, low), high)
        P2 *= noise / total

        slope = fourth * (l1**2 - l2**2) / np.sqrt(V1 * V2)
        noise = fourth * a1 * a2 + kappa * (a1 * b2 + a2 * b1) + b1 * b2 + b12**2
        if tt > limits[2]:
            tq *= limits[2] / tt
            tt = limits[2]
        total = slope**2 * tt + noise
        gain = slope / total * (u1 * u2 / np.sqrt(V1 * V2) - b12)
        theta, q = theta + gain * tt, q + gain * tq
        theta -= 2 * np.pi * np.round(theta / (2 * np.pi))
        inner = slope**2 * max(tt * qq - tq**2, 0.0)
        tt, tq, qq = tt * noise / total, tq * noise / total, (qq * noise + inner) / total
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = px, py, np.exp(log1), np.exp(log2)
    return out


def blob_steps(recording: Recording, M: int) -> tuple[np.ndarray, Batch]:
    """All events in steps of M: seconds between the steps, and the steps' batches."""
    e = recording.events
    assert isinstance(e, Events)
    n = len(e) // M * M
    t = e.t[:n].reshape(-1, M)
    dt = np.diff(t[:, -1], prepend=0) * 1e-6
    xi = np.stack([e.x[:n], e.y[:n]], 1).reshape(-1, M, 2)
    polarity = np.where(e.p[:n], 1.0, -1.0).reshape(-1, M)
    age = (t[:, -1:] - t) * 1e-6
    arrays = (jax.numpy.asarray(part, np.float32) for part in (xi, age, polarity))
    return dt.astype(np.float32), Batch(*arrays)


def blob_numbers() -> tuple:
    """What `blob_loop` takes of the parameters of `moment`."""
    p = moment.Params()
    numbers = ("p", "v", "lambda", "theta", "q")
    Q = np.array([float(getattr(p, f"Q_{name}")) for name in numbers])
    P0 = np.array([float(getattr(p, f"P0_{name}")) for name in numbers])
    P0[2] /= float(p.lambda0) ** 2
    limits = np.array([float(v) for v in (p.lambda_min, p.lambda_max, p.P_theta_max)])
    kappa, fourth = (float(v) for v in truncation(p))
    return 20.0, Q, P0, kappa, fourth, limits


def tracker_bench() -> tuple[dict[str, float], dict[str, float]]:
    """The tracker by both compilers, in CPU seconds, which other work on the machine spares.

    One target, from a seed. The loop over packed events, and `estimate` in all. Interleaved, the
    least of each, beside `blob_loop`, which neither gates nor tells of births and deaths.
    """
    speed, tasks, events = {}, {}, {}
    recording, truth = blob_scene("lissajous", 0)
    start, e = truth(0.0)[0, 0, :2] + (3.0, -3.0), recording.events[:24_576]
    loop, numbers = "blob filter as a numba loop", blob_numbers()
    tasks[loop] = lambda: blob_loop(e.t, e.x, e.y, start, *numbers)
    events[loop] = len(e)
    for M in (1, 32):
        params, seeds = moment.Params(events_per_step=M), [(*start, 20.0)]
        many, _ = blob_scene("lissajous", 0, rate=3e6 if M > 1 else 3e5)
        packing = Packing(many, params, seeds)
        stretch = packing.pack(packing.first)
        state = begin_state(moment.filter, params, stretch.features)
        kernel = FusedRun(moment.filter, params, packing)
        name = f"tracker, M = {M}, loop over packed events"
        tasks[name] = functools.partial(kernel, state, stretch.features)
        events[name] = int(np.count_nonzero(stretch.features.valid))
        for compiler in ("numba", "xla"):
            name = f"tracker, M = {M}, `estimate` by {compiler}"
            tasks[name] = functools.partial(
                moment.estimate, many, params, seeds=seeds, compiler=compiler, progress=False
            )
            events[name] = len(many.events)
    paths = ((200, 300), (600, 50)), ((900, 400), (-500, 100)), ((600, 150), (0, 300))
    lines = [Line(at, velocity, size=(8.0, 8.0)) for at, velocity in paths]
    scene, _ = simulate_blobs([Target(line, 2.5e5) for line in lines], (1280, 720), 0.6, 2.5e5)
    found = "`find` at 1280x720"
    tasks[found] = functools.partial(find, scene, progress=False)
    events[found] = len(scene.events)
    least: dict[str, float] = {}
    for repeat in range(4):
        for name, task in tasks.items():
            clock = time.process_time()
            task()
            if repeat:  # the first compiles
                least[name] = min(least.get(name, np.inf), time.process_time() - clock)
    speed = {f"{name}, per CPU second": events[name] / 1e6 / least[name] for name in tasks}
    base = speed[f"{loop}, per CPU second"]
    ratio = {
        f"{name} / numba loop": v / base for name, v in speed.items() if name.startswith("tracker")
    }
    return speed, ratio


def blob_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Filters alone and the tracker, on a blob of 100,000 events/s at up to 2014 px/s."""
    recording, truth = blob_scene("lissajous", 0)
    e = recording.events
    assert isinstance(e, Events)
    start, count, shift = truth(0.0)[0, 0, :2] + (3.0, -3.0), 6144, np.arange(64, dtype=np.float32)

    def scan(length, params, start, dt, batch):
        """Position and sizes after every step; or the last state, by loops of `length` steps.

        XLA makes one function of a short loop over little data, as the tracker has it: 0.5 instead
        of 0.25 M steps/s of one blob.
        """
        blob = moment.filter

        def step(state, part):
            dt, batch = part
            weight = jax.numpy.ones(len(batch.age), dt.dtype)
            if len(weight) == 1:  # as the tracker does
                batch = Batch(batch.xi, 0 * weight, batch.polarity)
            state = blob.update(params, blob.predict(params, state, dt), batch, weight)
            now = blob.expected(params, state)
            return state, None if length else jax.numpy.concatenate([now.p, now.size])

        begin = blob.start(params, start.astype(dt.dtype), jax.numpy.full((), 20.0, dt.dtype))
        if not length:
            return jax.lax.scan(step, begin, (dt, batch))[1]
        parts = jax.tree.map(lambda a: a.reshape(-1, length, *a.shape[1:]), (dt, batch))
        return jax.lax.scan(lambda s, part: jax.lax.scan(step, s, part), begin, parts)[0]

    def seconds(function, given, repeat=15):
        return best(lambda: jax.block_until_ready(function(*given)), repeat)

    told = jax.jit(functools.partial(scan, 0))
    targets = {
        length: jax.jit(jax.vmap(functools.partial(scan, length), (None, 0, None, 0)))
        for length in (64, 256)
    }
    speed, rmse, whole = {}, {}, {}
    for M in (1, 32):
        params = moment.Params(events_per_step=M)
        given = jax.device_put((params, start, *blob_steps(recording, M)))
        states = np.asarray(told(*given), float)
        t = e.t[M - 1 :: M][: len(states)]
        error = (states[:, :2] - truth(t)[:, 0, :2])[t > 100_000]
        rmse[M] = float(np.sqrt((error**2).sum(1).mean()))
        if M == 1:
            by_event = states
        dt, batch = jax.tree.map(lambda part, k=count // M: part[:k], blob_steps(recording, M))
        # As the tracker runs it, for a batch of targets.
        single = params, start[None], dt, jax.tree.map(lambda part: part[None], batch)
        speed[M] = len(dt) * M / 1e6 / seconds(targets[64], single)
    # 64 blobs whose events come at the same times, each at its own place.
    dt, batch = blob_steps(recording, 1)
    batch = jax.tree.map(
        lambda part: jax.numpy.broadcast_to(part[:2048], (64, *part[:2048].shape)), batch
    )
    batch = Batch(batch.xi + shift[:, None, None, None], batch.age, batch.polarity)
    given = jax.device_put((moment.Params(), start + shift[:, None], dt[:2048], batch))
    many = 64 * 2048 / 1e6 / seconds(targets[256], given, 40)

    arguments = start, *blob_numbers()
    same = blob_loop(e.t, e.x, e.y, *arguments)
    # But for rounding to single precision.
    assert np.abs(same - by_event).max() < 0.05, "the loop is another filter"
    part = e[: count * 4]
    loop = count * 4 / 1e6 / best(lambda: blob_loop(part.t, part.x, part.y, *arguments), 15)

    for M in (1, 32):
        params = moment.Params(events_per_step=M)
        stream, _ = blob_scene("lissajous", 0, rate=1e6 if M > 1 else 1e5)
        run = functools.partial(moment.estimate, stream, params, seeds=[(*start, 20.0)])
        whole[M] = len(stream.events) / 1e6 / best(run, 10)
    print(
        f"\nblob: RMSE {rmse[1]:.4f} px event by event, {rmse[32]:.4f} px in steps of 32 "
        f"({rmse[32] - rmse[1]:+.4f})"
    )
    names = {
        "blob filter, event by event": speed[1],
        "blob filter, 32 events per step": speed[32],
        "blob filter, 64 blobs vmapped, in all": many,
        "blob filter as a numba loop": loop,
        "blob.track, event by event": whole[1],
        "blob.track, 32 events per step": whole[32],
    }
    ratio = {
        "blob filter, event by event / numba loop": speed[1] / loop,
        "blob filter, 32 events per step / numba loop": speed[32] / loop,
        "blob filter, 64 blobs vmapped / numba loop": many / loop,
        "blob.track, 32 events per step / numba loop": whole[32] / loop,
        "blob filter, event by event / authors' 0.1 M": speed[1] / 0.1,
        "blob.track, event by event / authors' 0.1 M": whole[1] / 0.1,
        "blob.track, 32 events per step / authors' 0.1 M": whole[32] / 0.1,
        "blob: RMSE of 32 events per step / event by event": rmse[32] / rmse[1],
    }
    return names, ratio


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
    parser.add_argument(
        "--gate", action="store_true", help="exit with 1 if worse than the baseline"
    )
    parser.add_argument("--bless", action="store_true", help="write the baseline")
    parser.add_argument("--json", type=Path, help="write all numbers")
    parser.add_argument("--skip-memory", action="store_true", help="leave out the 100 M events")
    parser.add_argument("--blob", action="store_true", help="the tracker of blobs alone")
    parser.add_argument("--tracker", action="store_true", help="it by both compilers, CPU seconds")
    parser.add_argument("--motion", action="store_true", help="egomotion alone")
    parser.add_argument("--video", action="store_true", help="the complete path alone, CPU seconds")
    parser.add_argument("--long", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.long:
        reconstruct_long(arguments.long)
        return 0

    if arguments.blob:
        return finish(arguments, *blob_bench())
    if arguments.tracker:
        return finish(arguments, *tracker_bench())
    if arguments.motion:
        return finish(arguments, *motion_bench())
    recording = stream(5_000_000, 2.0, 0)
    if arguments.video:
        with tempfile.TemporaryDirectory() as folder:
            save(recording, Path(folder) / "bench.h5")
            return finish(arguments, *cpu_bench(recording, Path(folder) / "bench.h5"))
    n = len(recording.events) / 1e6
    speed, ratio = {}, {}
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.h5"
        save(recording, path)
        whole_program = n / program_seconds(recording)
        loop = n / loop_seconds(recording, search=True)
        given = n / loop_seconds(recording, search=False)
        filtering = n / filter_seconds(recording)
        preparing = n / prepare_seconds(recording)
        of_losses = losses(recording)
        loss, gradient = (best(of_losses[f"numba {name}"]) for name in ("loss", "gradient"))
        whole, reading = complete_seconds(path)
        cpu_speed, cpu_ratio = cpu_bench(recording, path)
        path.unlink()
        assert isinstance(recording.events, Events)
        text = text_seconds(Path(folder), recording.events[:1_000_000])
        accumulator = n / accumulator_seconds(recording)
        speed = {
            "numba program, event by event": whole_program,
            "numba loop, recursion and neighbour look-up": loop,
            "numba loop, recursion alone": given,
            "filter alone": filtering,
            "features and packing": preparing,
            "loss of a prepared recording": n / loss,
            "loss and gradient of 8 parameters": n / gradient,
            "reading text": 1 / text,
            "reading HDF5": n / reading,
            "complete path: HDF5 to 100 Hz images": n / whole,
            "dv-processing Accumulator at 100 Hz, events in memory": accumulator,
        }
        ratio = {
            "filter / numba program": filtering / whole_program,
            "filter / numba loop with neighbour look-up": filtering / loop,
            "filter / numba loop of the recursion alone": filtering / given,
            "features and packing / numba program": preparing / whole_program,
            "loss and gradient of 8 parameters / loss": gradient / loss,
            "complete path / numba program": n / whole / whole_program,
            "complete path / dv-processing Accumulator": n / whole / accumulator,
            "compilations for a second recording": compilations(),
        }
        blob_speed, blob_ratio = (a | b for a, b in zip(blob_bench(), tracker_bench(), strict=True))
        speed |= cpu_speed | blob_speed
        ratio |= cpu_ratio | blob_ratio
        if not arguments.skip_memory:
            gigabytes, seconds = long_run(Path(folder))
            ratio["peak memory of 100 M events, GB"] = gigabytes
            speed["100 M events from HDF5 in windows, 5 Hz images"] = 100 / seconds
    return finish(arguments, speed, ratio)


def finish(arguments: argparse.Namespace, speed: dict[str, float], ratio: dict[str, float]) -> int:
    """Print, write, compare."""
    print("\n| M events/s | |\n|---|---:|")
    for name, value in speed.items():
        print(f"| {name} | {value:.2f} |")
    print("\n| ratio | |\n|---|---:|")
    for name, value in ratio.items():
        print(f"| {name} | {value:.2f} |")
    if arguments.json:
        text = json.dumps({"machine": machine(), "M events/s": speed, "ratios": ratio}, indent=1)
        arguments.json.write_text(text + "\n")
    if arguments.bless:
        old = (
            json.loads(BASELINE.read_text())["ratios"]
            if arguments.blob or arguments.tracker or arguments.motion
            else {}
        )
        kept = {**old, **{k: round(v, 3) for k, v in ratio.items()}}
        BASELINE.write_text(json.dumps({"machine": machine(), "ratios": kept}, indent=1) + "\n")
    if not arguments.gate:
        return 0
    worse = []
    baseline = json.loads(BASELINE.read_text())["ratios"]
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
