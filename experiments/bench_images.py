"""Speed of images, as part of `bench.py`: filters, smoother, files, losses and gradients.

    python experiments/bench.py images xla calibration smoother start

A stream of 5 M events at 346x260 (gamma-distributed pixel rates, 2 s, 25 frames per second) is
read, filtered and shown. Beside it run, on one core: the whole filter as a plain numba program
over events, which is what a C++ program does; and, where it is installed, the Accumulator of
dv-processing.
"""

import functools
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import equinox as eqx
import jax
import numba
import numpy as np
from common import cpu_seconds, least_cpu

import jaxevent
from jaxevent.calibration import storage
from jaxevent.io import load, save
from jaxevent.io.hdf5_files import search_heaps
from jaxevent.reconstruction.filtering import (
    FilteredTrajectory,
    FrameModel,
    Observation,
    PixelState,
)
from jaxevent.reconstruction.windows import WindowedRecording
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.demo import RECORDING_FILE

WIDTH, HEIGHT = 346, 260
NUMBERS = (0.1, 5e-4, 0.03, 0.01, 0.01, 7e5, 0.09)  # of the filter, as the programs take them
OF_AKF = ("c_on", "c_off", "I0", "kappa", "w_min", "sigma_proc", "sigma_iso", "sigma_ref")


def stream(
    events: int, seconds: float, seed: int, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Recording:
    """Draw events at gamma-distributed rates per pixel, and frames of noise at 25 per second."""
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
    """Run the whole AKF event by event: calibration per frame, then event after event.

    Double precision, one core, exposures not known; the arithmetic of the library's filter with
    hard limits of the ratio (`ratio_width` 0).
    """
    frames, height, width = grey.shape
    L, P = np.log(grey[0] + 1), np.full((height, width), 0.09)
    last = np.zeros((height, width), np.int64)
    density = 1 / (kappa * np.maximum(4 * grey * (1 - grey), w_min))
    S, total = np.zeros((height, width)), np.zeros((height, width))
    base, ratio = np.log(grey[0] + 1), np.ones((height, width))
    end, k = base, -1
    for i in range(np.searchsorted(t, mid[0])):  # events before the first frame lead up to it
        total[y[i], x[i]] += c if p[i] else -c
    L -= total
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
            u = base[a, b] - (total[a, b] - S[a, b])
            bright, R = grey[0, a, b], density[0, a, b]
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


class KnownFrames(FrameModel):
    """Observations known beforehand, carried in place of the points' weights."""

    def __call__(self, points):
        return Observation(points.weight, points.blend)


def filter_seconds(recording: Recording) -> float:
    """Return the CPU seconds of all windows' filters, with their features on the device."""
    params = jaxevent.akf.Params()
    look = jax.jit(lambda frame_model, tiles: frame_model(tiles.points))
    windows = []
    for _, features in WindowedRecording(recording):
        features = jax.device_put(features)
        frame_model = jaxevent.akf.frame_model(params, features.frames)
        known = look(frame_model, features.tiles)
        tiles = eqx.tree_at(
            lambda t: (t.points.weight, t.points.blend), features.tiles, (known.level, known.rate)
        )
        windows.append((tiles, features.last))

    @jax.jit
    def scan(params, tiles, last, state):
        path = jaxevent.akf.scan(params, KnownFrames(), tiles, state)
        return FilteredTrajectory(KnownFrames(), state, path).at(last), path

    pixels = WIDTH * HEIGHT
    first = PixelState(jax.numpy.zeros(pixels), jax.numpy.full(pixels, 0.09))

    def run():
        state = first
        for tiles, last in windows:
            state, path = scan(params, tiles, last, state)
            jax.block_until_ready(path)

    return cpu_seconds(run, 20)


def prepare_seconds(recording: Recording) -> float:
    def run():
        for _ in WindowedRecording(recording, reuse=True):
            pass

    return cpu_seconds(run)


def losses(
    recording: Recording,
    method: Any = jaxevent.akf,
    start: Any = None,
    names: tuple[str, ...] = OF_AKF,
    compilers: tuple[str, ...] = ("numba", "xla"),
) -> dict[str, Callable[[], object]]:
    """Return tasks of the mean squared error at 8 images, alone and with its gradient.

    Keys are those of a compiler, "numba" or "xla", and "loss" or "gradient".
    """
    start = jaxevent.akf.Params(preset="paper") if start is None else start
    frames = recording.frames
    assert frames is not None
    rows = slice(1, 49, 6)
    truth = jax.numpy.asarray(frames.intensity[rows].reshape(8, -1))

    # Everything but the parameters is given as an argument, lest it be compiled as constants.
    def loss(raw, images, truth):
        image, _, _ = images(start.with_raw(raw), variance=False)
        return ((image - truth) ** 2).mean()

    raw, tasks = {name: start.raw[name] for name in names}, {}
    functions = {"loss": jax.jit(loss), "gradient": jax.jit(jax.value_and_grad(loss))}
    for compiler in compilers:
        times = frames.t[rows] + 20_000
        images = method.prepare_images(recording, times, start, compiler=compiler)
        for name, function in functions.items():
            given = functools.partial(function, raw, images, truth)
            tasks[f"{compiler} {name}"] = lambda given=given: jax.block_until_ready(given())
    return tasks


def read(path: Path, in_memory: bool) -> Recording:
    """Load a file like a process that reads it for the first time."""
    search_heaps.cache_clear()
    return load(path, in_memory=in_memory)


def images(given: Recording | Path, compiler: Any, rate: int, method: Any = jaxevent.akf) -> None:
    """Run the complete path of a recording in memory, or in a file, with default parameters."""
    given = read(given, in_memory=False) if isinstance(given, Path) else given
    times = np.arange(given.start, given.stop, 1_000_000 // rate)
    for _ in method.estimate(given, method.Params(), compiler=compiler).batches(times):
        pass


def measure_images(recording: Recording, path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Measure the complete path by both compilers, losses and gradients.

    The numba program makes no images. Beside it: 100 and 500 images per second, read from the file
    as `jaxevent reconstruct` does; and 5 M events of a sensor of 1280x720 in 2 s with 25 images per
    second, from memory.
    """
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    grey = frames.intensity.astype(np.float64)
    check_program(recording, grey)
    large = stream(5_000_000, 2.0, 1, (1280, 720))

    tasks: dict[str, Callable[[], object]] = {
        "program": lambda: program(e.t, e.x, e.y, e.p, grey, frames.t, *NUMBERS),
        "reading": lambda: read(path, in_memory=True),
        "numba memory": lambda: images(recording, "numba", 100),
        **losses(recording),
    }
    for compiler in ("numba", "xla"):
        for name, given, rate in (("100", path, 100), ("500", path, 500), ("large", large, 25)):
            if compiler == "numba" or name == "100":
                tasks[f"{compiler} {name}"] = functools.partial(images, given, compiler, rate)
    least, n = least_cpu(tasks), len(e) / 1e6
    extra = (least["numba 500"] - least["numba 100"]) / (800 * WIDTH * HEIGHT)
    shown = {
        "numba program": "program",
        "reading HDF5, with checks": "reading",
        "complete path": "numba 100",
        "complete path, events in memory": "numba memory",
        "complete path compiled by XLA": "xla 100",
        "1280x720 at 25 Hz": "numba large",
        "loss": "numba loss",
        "loss and gradient of 8 parameters": "numba gradient",
        "loss compiled by XLA": "xla loss",
        "loss and gradient compiled by XLA": "xla gradient",
    }
    speed = {name: n / least[task] for name, task in shown.items()}
    ratio = {
        "complete path / numba program": least["program"] / least["numba 100"],
        "the same, events in memory": least["program"] / least["numba memory"],
        "complete path / the same compiled by XLA": least["xla 100"] / least["numba 100"],
        "1280x720 at 25 Hz / numba program of 346x260": least["program"] / least["numba large"],
        "ns per pixel of an image more": 1e9 * extra,
        "pixel of an image more / event of the numba program": 5e6 * extra / least["program"],
        "loss and 8 gradients / loss": least["numba gradient"] / least["numba loss"],
        "loss and 8 gradients / loss compiled by XLA": least["numba gradient"] / least["xla loss"],
    }
    return speed, ratio


def check_program(recording: Recording, grey: np.ndarray) -> None:
    """Check that the program and the library agree at the last event of each pixel."""
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    L, _ = program(e.t, e.x, e.y, e.p, grey, frames.t, *NUMBERS)
    features, _ = jaxevent.akf.prepare(recording, [recording.stop])
    _, end = jax.jit(jaxevent.akf.run)(jaxevent.akf.Params(ratio_width=0), features)
    assert np.abs(end.L.reshape(L.shape) - L).max() < 1e-3, "the program is another filter"


def xla_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure the paths without a kernel: the scan alone, features, compilations."""
    recording = stream(5_000_000, 2.0, 0)
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    grey, n = frames.intensity.astype(np.float64), len(e) / 1e6
    whole = n / cpu_seconds(lambda: program(e.t, e.x, e.y, e.p, grey, frames.t, *NUMBERS))
    filtering, preparing = n / filter_seconds(recording), n / prepare_seconds(recording)
    speed = {
        "filter alone, by XLA": filtering,
        "features and packing": preparing,
    }
    ratio = {
        "filter by XLA / numba program": filtering / whole,
        "features and packing / numba program": preparing / whole,
        "compilations for a second recording": compilations(),
    }
    return speed, ratio


def images_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure images of a recording in a file, and dv-processing where it is installed."""
    recording = stream(5_000_000, 2.0, 0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.h5"
        save(recording, path)
        speed, ratio = measure_images(recording, path)
    try:
        accumulator = len(recording.events) / 1e6 / accumulator_seconds(recording)
    except ImportError:
        print("dv-processing is not installed: its Accumulator is left out")
        return speed, ratio
    speed["dv-processing Accumulator at 100 Hz, events in memory"] = accumulator
    name = "complete path / dv-processing Accumulator"
    return speed, ratio | {name: speed["complete path"] / accumulator}


def accumulator_seconds(recording: Recording) -> float:
    """Return the CPU seconds of dv-processing's Accumulator at 100 Hz, events in memory."""
    import dv_processing as dv

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

    return cpu_seconds(run, 3)


def compilations() -> int:
    """Count the compilations by XLA for a second recording of the same sensor."""
    heard = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            heard.append(event)

    def run(seed: int, events: int) -> None:
        recording = stream(events, 1.0 + seed, seed)
        times = np.arange(50_000, 10**6, 50_000)
        jaxevent.akf.estimate(recording, jaxevent.akf.Params(), compiler="xla")(times)

    run(0, 300_000)
    jax.monitoring.register_event_duration_secs_listener(listen)
    run(1, 2_500_000)
    jax.monitoring.clear_event_listeners()
    return len(heard)


# The parameters that losses are differentiated by, and how they are called here.
OF_AKS = ("c_on", "c_off", "I0", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor", "share")
LOSS_NAMES = {
    "numba loss": "loss, kernel",
    "numba gradient": "loss and gradient, kernel",
    "xla loss": "loss, XLA",
    "xla gradient": "loss and gradient, XLA",
}


@numba.njit
def mix(counts, share):
    """Return event counts of which each pixel gives a part to its neighbours."""
    height, width = counts.shape
    out = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            total, number = 0.0, 0
            for row in range(max(y - 1, 0), min(y + 2, height)):
                for column in range(max(x - 1, 0), min(x + 2, width)):
                    total += counts[row, column]
                    number += 1
            own = counts[y, x]
            out[y, x] = own + share * ((total - own) / 8 - (number - 1) / 8 * own)
    return out


@numba.njit
def smoother_program(t, x, y, p, image, certainty, mid, times, numbers):
    """Run a Kalman filter over frames, an information filter back, and form images between."""
    c_on, c_off, I0, sigma_event, sigma_bg, sigma_frame, floor, m0, P0, share = numbers
    frames, height, width = image.shape
    size = height, width
    m, P = np.full(size, m0), np.full(size, P0)
    past_m, past_P = np.empty(image.shape), np.empty(image.shape)
    h, J = np.empty(image.shape), np.empty(image.shape)
    moved = np.zeros((frames, 2, height, width))
    i = np.searchsorted(t, mid[0])
    for k in range(frames):
        z = np.log(image[k] + I0)
        said = 1 / ((sigma_frame / certainty[k] / (image[k] + I0)) ** 2 + floor**2)
        h[k], J[k] = said * z, said
        past_P[k] = P / (1 + P * said)
        past_m[k] = m + past_P[k] * (h[k] - said * m)
        if k + 1 < frames:
            counts = np.zeros((2, height, width))
            while i < len(t) and t[i] < mid[k + 1]:
                counts[0 if p[i] else 1, y[i], x[i]] += 1
                i += 1
            for polarity in range(2):
                moved[k, polarity] = mix(counts[polarity], share)
            m = past_m[k] + c_on * moved[k, 0] - c_off * moved[k, 1]
            q = sigma_event**2 * (c_on**2 * moved[k, 0] + c_off**2 * moved[k, 1])
            P = past_P[k] + q + sigma_bg**2 * (mid[k + 1] - mid[k]) * 1e-6
    later_h, later_J = np.zeros(size), np.zeros(size)
    for k in range(frames - 1, -1, -1):
        own_h, own_J = h[k].copy(), J[k].copy()
        h[k], J[k] = later_h, later_J  # what is said at the next frame
        if k + 1 < frames:
            q = sigma_event**2 * (c_on**2 * moved[k, 0] + c_off**2 * moved[k, 1])
            q += sigma_bg**2 * (mid[k + 1] - mid[k]) * 1e-6
            fade = 1 / (1 + q * later_J)
            own_h += (later_h - later_J * (c_on * moved[k, 0] - c_off * moved[k, 1])) * fade
            own_J += later_J * fade
        later_h, later_J = own_h, own_J
    out = np.empty((2, len(times), height, width), np.float32)
    f, i = -1, 0
    counts = np.zeros((2, height, width))
    for n in range(len(times)):
        now = times[n]
        while f + 1 < frames and mid[f + 1] <= now:
            f += 1
            counts[:] = 0
            i = np.searchsorted(t, mid[f])
        while i < len(t) and t[i] <= now:
            counts[0 if p[i] else 1, y[i], x[i]] += 1
            i += 1
        on, off = mix(counts[0], share), mix(counts[1], share)
        elapsed = (now - mid[f]) * 1e-6
        left = (mid[f + 1] - now) * 1e-6 if f + 1 < frames else 0.0
        for row in range(height):
            for column in range(width):
                a, b = on[row, column], off[row, column]
                u, v = moved[f, 0, row, column] - a, moved[f, 1, row, column] - b
                mean = past_m[f, row, column] + c_on * a - c_off * b
                spread = sigma_event**2 * (c_on**2 * a + c_off**2 * b) + sigma_bg**2 * elapsed
                q = sigma_event**2 * (c_on**2 * u + c_off**2 * v) + sigma_bg**2 * left
                fade = 1 / (1 + q * J[f, row, column])
                told = (h[f, row, column] - J[f, row, column] * (c_on * u - c_off * v)) * fade
                weight = J[f, row, column] * fade
                V = 1 / (1 / (past_P[f, row, column] + spread) + weight)
                out[0, n, row, column] = np.exp(mean + V * (told - weight * mean)) - I0
                out[1, n, row, column] = V
    return out


def program_images(recording: Recording, times: np.ndarray) -> np.ndarray:
    frames, v = recording.frames, jaxevent.aks.Params().values()
    assert frames is not None
    grey = np.asarray(frames.images)
    table = np.arange(256) / 255
    certain = np.maximum(np.asarray(recording.response.certainty(table)), v["w_min"])
    image = np.asarray(recording.response.intensity(table))[grey]
    names = ("c_on", "c_off", "I0", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor")
    numbers = [v[name] for name in names] + [np.log(v["start"] + v["I0"]), v["P_start"], v["share"]]
    e = recording.events[:]
    return smoother_program(e.t, e.x, e.y, e.p, image, certain[grey], frames.t, times,
                   tuple(float(n) for n in numbers))  # fmt: skip


def repeat(recording: Recording, times: int) -> Recording:
    """Repeat a recording end to end, one frame interval apart."""
    e, frames = recording.events, recording.frames
    assert isinstance(e, Events) and frames is not None
    late = np.arange(times) * (recording.stop - recording.start + int(frames.t[1] - frames.t[0]))
    return Recording(
        "repeated",
        recording.width,
        recording.height,
        Events(
            (e.t + late[:, None]).ravel(), np.tile(e.x, times), np.tile(e.y, times),
            np.tile(e.p, times),
        ),
        Frames(
            (frames.t + late[:, None]).ravel(), np.tile(np.asarray(frames.images), (times, 1, 1)),
            np.tile(frames.exposure, times),
        ),
    )  # fmt: skip


def find_params(path: Path) -> Any:
    """Find the parameters of `akf` for a recording in a file, as where nothing is kept."""
    storage._memory.clear()
    with mock.patch.dict(os.environ, JAXEVENT_CACHE="0"):
        return jaxevent.akf.usual_params(read(path, in_memory=False))


def calibration_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure calibration of a long recording: 30 M events, the packaged one end to end."""
    recording = repeat(load(str(RECORDING_FILE)), 90)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.h5"
        save(recording, path)
        tasks: dict[str, Callable[[], object]] = {
            "hash": lambda: storage.hash_content(read(path, in_memory=False), 1.0),
            "calibration": lambda: jaxevent.calibrate(read(path, in_memory=False)),
            "params": functools.partial(find_params, path),
            "filtering": lambda: images(path, "numba", 1),
            "complete": lambda: images(path, "numba", 100),
        }
        least, n = least_cpu(tasks), len(recording.events) / 1e6
    speed = {
        "30 M events, reading and filtering": n / least["filtering"],
        "30 M events, complete path": n / least["complete"],
        "30 M events, complete path with calibration": n / (least["complete"] + least["params"]),
    }
    ratio = {
        "CPU seconds of a calibration": least["calibration"],
        "CPU seconds of a calibration with akf's own numbers": least["params"],
        "CPU seconds to find a kept one": least["hash"],
        "calibration / reading and filtering of 30 M events": least["params"] / least["filtering"],
    }
    return speed, ratio


def images_by(
    recording: Recording, times: np.ndarray, compiler: str, preset: str | None = None
) -> np.ndarray:
    params = jaxevent.aks.Params(preset=preset)
    made = jaxevent.aks.estimate(recording, params, compiler=compiler, progress=False)
    return np.concatenate([np.asarray(part.mean) for _, part in made.batches(times)])


def smoother_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure the kernel of `aks`, the scan, and a plain numba program.

    The program passes forwards and backwards over whole images, in double precision on one core,
    with the arithmetic of the smoother's defaults: exposures not known, nothing clipped. The preset
    `hdr` spreads changes over time. The loss is that at 8 images of the prepared recording.
    """
    recording = stream(5_000_000, 2.0, 0)
    frames = recording.frames
    assert frames is not None
    times = np.arange(frames.t[0], recording.stop, 10_000)
    ways: dict[str, Any] = {
        "numba program": lambda: program_images(recording, times)[0],
        "kernel": lambda: images_by(recording, times, "numba"),
        "compiled by XLA": lambda: images_by(recording, times, "xla"),
        "kernel, one image": lambda: images_by(recording, times[:1], "numba"),
        "kernel, preset hdr": lambda: images_by(recording, times, "numba", "hdr"),
        "preset hdr, compiled by XLA": lambda: images_by(recording, times, "xla", "hdr"),
    }
    worst = abs(ways["kernel"]() - ways["numba program"]()).max()
    assert worst < 1e-4, worst
    of_losses = losses(recording, jaxevent.aks, jaxevent.aks.Params(), OF_AKS)
    ways |= {shown: of_losses[name] for name, shown in LOSS_NAMES.items()}
    least = least_cpu(ways)
    speed = {f"smoother, {n}": len(recording.events) / 1e6 / cpu for n, cpu in least.items()}
    whole, gradient = least["numba program"], "loss and gradient, kernel"
    ratio = {
        "smoother / numba program": whole / least["kernel"],
        "smoother, one image / numba program": whole / least["kernel, one image"],
        "smoother / the same compiled by XLA": least["compiled by XLA"] / least["kernel"],
        "smoother, preset hdr / the same compiled by XLA": least["preset hdr, compiled by XLA"]
        / least["kernel, preset hdr"],
        "smoother: loss and 8 gradients / loss": least[gradient] / least["loss, kernel"],
    }
    return speed, ratio


TILES = (4, 5)  # copies of the packaged recording below and beside each other: 1200x720


def tile(recording: Recording, rows: int, columns: int) -> Recording:
    """Lay copies of a recording out side by side."""
    e, frames = recording.events[:], recording.frames
    assert frames is not None
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    order = np.argsort(np.tile(e.t, rows * columns), kind="stable")
    x = (e.x + recording.width * j.reshape(-1, 1)).ravel()[order]
    y = (e.y + recording.height * i.reshape(-1, 1)).ravel()[order]
    t = np.tile(e.t, rows * columns)[order]
    p = np.tile(e.p, rows * columns)[order]
    images = np.tile(np.asarray(frames.images), (1, rows, columns))
    size = recording.width * columns, recording.height * rows
    return Recording("tiles", *size, Events(t, x, y, p), Frames(frames.t, images, frames.exposure))


OF_MC = ("c_on", "c_off", "sigma_event", "sigma_pixel", "information")


def fit_tasks_of_mc(recording: Recording, times: np.ndarray) -> dict[str, Callable[[], object]]:
    """Return tasks of a loss of prepared images of `mc`, alone and with its gradient."""
    start = jaxevent.mc.Params()
    images = jaxevent.mc.prepare_images(recording, times, start)
    truth = images(start).mean + 0.1

    def loss(raw, images, truth):
        image, _, _ = images(start.with_raw(raw))
        return ((image - truth) ** 2).mean()

    raw = {name: start.raw[name] for name in OF_MC}
    functions = {"loss": jax.jit(loss), "gradient": jax.jit(jax.value_and_grad(loss))}

    def task(function: Callable) -> Callable[[], object]:
        return lambda: jax.block_until_ready(function(raw, images, truth))

    return {name: task(function) for name, function in functions.items()}


def motion_compensated_bench() -> tuple[dict[str, float], dict[str, float]]:
    """Measure `mc` on the packaged recording: a video, single images, and one of a large sensor.

    Beside it runs optical flow between frames, with the video's images. Single images are as far
    apart as share nothing. A fit's loss of those images, whose motion is known, follows, with its
    gradient.
    """
    recording, params = load(str(RECORDING_FILE)), jaxevent.mc.Params()
    large, second = tile(recording, *TILES), recording.start + np.arange(1_000_000)
    video, single = second[200_000:600_000:10_000], second[150_000:950_000:200_000]

    def images(method: Any, params: Any, given: Recording, times: np.ndarray) -> object:
        return method.estimate(given, params, progress=False)(times)

    make = functools.partial
    tasks: dict[str, Callable[[], object]] = {
        "flow": make(images, jaxevent.METHODS["flow"], None, recording, video),
        "video": make(images, jaxevent.mc, params, recording, video),
        "single": make(images, jaxevent.mc, params, recording, single),
        "large": make(images, jaxevent.mc, params, large, single[1:2]),
        **fit_tasks_of_mc(recording, single),
    }
    counts = {
        **{name: len(video) for name in ("flow", "video")},
        **{name: len(single) for name in ("single", "loss", "gradient")},
        "large": 1,
    }
    least = {name: cpu / counts[name] for name, cpu in least_cpu(tasks, 2).items()}
    pixels = TILES[0] * TILES[1]
    return {}, {
        "mc: CPU seconds of an image of 100 Hz video": least["video"],
        "mc: CPU seconds of a single image": least["single"],
        "mc: CPU seconds of a single image, 1200x720": least["large"],
        "mc: CPU seconds of the loss of an image": least["loss"],
        "mc: CPU seconds of its loss and gradient": least["gradient"],
        "mc: loss and 5 gradients / loss": least["gradient"] / least["loss"],
        "mc: loss and 5 gradients / single image": least["gradient"] / least["single"],
        "mc: image of 100 Hz video / optical flow": least["video"] / least["flow"],
        "mc: single image / optical flow": least["single"] / least["flow"],
        "mc: single image, pixel of 1200x720 / of 240x180": least["large"]
        / least["single"]
        / pixels,
    }


CROP = Path(jaxevent.__file__).parent / "data" / "slider_depth_crop.h5"
PROGRAM = "import sys; from jaxevent.cli import main; sys.exit(main())"
COMMAND = (sys.executable, "-c", PROGRAM, "reconstruct", str(CROP), "--rate", "200")


FIRST_PICTURE = (
    f"import jaxevent; recording = jaxevent.load({str(CROP)!r}); "
    "jaxevent.mc.estimate(recording)(recording.start + 300_000)"
)
IMPORTS = "import equinox, h5py, jax, numba, optax, scipy.ndimage"
STARTS: dict[str, tuple[str, ...]] = {
    "imports": (sys.executable, "-c", IMPORTS),
    **{name: (*COMMAND, "--method", name, "--out") for name in ("akf", "aks")},
    "picture of mc": (sys.executable, "-c", FIRST_PICTURE),
    "help": (sys.executable, "-m", "jaxevent", "--help"),
}


def start_seconds(words: tuple[str, ...], caches: Path) -> float:
    """Return the CPU seconds of one process, which may write a file."""
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    env, out = {**kept, "JAXEVENT_CACHE": str(caches)}, caches / "images.h5"
    words = (*words, str(out)) if words[-1] == "--out" else words
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(words, env=env, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    out.unlink(missing_ok=True)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def start_bench(turns: int = 2) -> tuple[dict[str, float], dict[str, float]]:
    """Measure short uses in a fresh process, with cold and warm caches.

    `jaxevent reconstruct` of the packaged crop at 200 images per second, to HDF5; one picture of
    `mc` from Python; help. They are compared with the imports of what the library depends on. Cold:
    nothing that numba and XLA compile is kept; Python's own bytecode is. Each number is the least
    of the turns, in which all take part, so that all meet the same neighbours.
    """
    least: dict[tuple[str, str], float] = {}
    for _ in range(turns):
        for name, words in STARTS.items():
            with tempfile.TemporaryDirectory() as folder:
                for state in ("cold", "warm"):
                    found = start_seconds(words, Path(folder))
                    least[name, state] = min(least.get((name, state), np.inf), found)
    seconds = {
        f"start: CPU seconds of {name}, {state}": cpu for (name, state), cpu in least.items()
    }
    imports = least["imports", "warm"]
    return {}, seconds | {
        f"start: {name}, {state} / imports": cpu / imports
        for (name, state), cpu in least.items()
        if name != "imports"
    }
