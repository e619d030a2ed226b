"""Calibration: coverage of simulated truth, and what it is worth for hidden frames.

    python experiments/calibration.py --out calibration [--scenes 60] [--data DIR]

60 scenes are drawn: panoramas and moving objects, 25 to 300 px/s, thresholds, mismatch, dark
offset, dead time, background events, hot pixels, jitter, frame rate, exposure, read noise and the
offset of the clocks. Calibration is not told the exposure. coverage.md counts 95 % intervals that
hold the truth, and has the median error; of the clock offset in ms, of the others relative.

hidden.md has the MSE (x 1e-2) of all hidden frames between given ones, every second one hidden:
with defaults, the calibrated clock alone, `for_recording`, and numbers fitted to the hidden frames
themselves, the bound; and CPU seconds of calibration and refinement.

times.md has the MSE (x 1e-2) of images at true times of the first 12 scenes, median and mean: as
they are, and with `event_delay` in the frames' clock, which predicts hidden frames as well but
shows what was there by the delay earlier; and the delay in ms. `blend` and `flow` have the
calibrated clock.
"""

import dataclasses
import time
from typing import Any

import numpy as np
from common import command_line, machine, markdown_table, write_text
from scipy.optimize import minimize

import jaxevent
from jaxevent.calibration import recall_calibration
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.simulate import MovingObjects, Pan, Sensor, scene, simulate

RECORDINGS = ("slider_depth.zip", "davis346_street.npz", "evbench_seq3_calibrated.npz")
FIRST_SEED = 5000
SIZE, DURATION_S = (96, 72), 1.2


def draw_scene(seed: int) -> tuple[Recording, dict[str, float]]:
    """Return a simulated recording without its exposures, and the truth."""
    rng = np.random.default_rng([52, seed])
    rate, c = float(rng.choice([15, 20, 25, 30, 40])), float(np.exp(rng.uniform(-2.3, -1.05)))
    ratio = float(np.exp(rng.uniform(-0.35, 0.35)))
    near, far = rng.uniform(-0.03, 0.03), rng.uniform(-0.2, 0.2)
    sensor = Sensor(
        c_on=c * ratio**0.5, c_off=c / ratio**0.5, mismatch=float(rng.uniform(0, 0.06)),
        dark_offset=float(np.exp(rng.uniform(np.log(0.003), np.log(0.05)))),
        refractory=float(rng.choice([0, 3e-4, 1e-3])),
        background_rate=float(rng.uniform(0, 0.5)), hot_fraction=float(rng.choice([0, 1e-3])),
        jitter=float(rng.choice([0, 1e-4])), frame_rate=rate,
        exposure=float(rng.uniform(0.02, 0.9)) / rate, exposure_samples=12,
        read_noise=float(rng.uniform(0.3, 2)), clock_offset=float(rng.choice([near, far])),
    )  # fmt: skip
    source: Any = MovingObjects(SIZE, DURATION_S, speed=float(rng.uniform(30, 200)), seed=seed)
    if rng.integers(3):
        speed = float(np.exp(rng.uniform(np.log(25), np.log(300))))
        source = Pan(scene(int(rng.integers(1000))), SIZE, DURATION_S, speed, seed)
    made = simulate(source, sensor, seed)
    assert made.frames is not None
    frames = Frames(made.frames.t, made.frames.images, 0 * made.frames.exposure)
    truth = {
        "clock_offset": sensor.clock_offset, "c_on": sensor.c_on, "c_off": sensor.c_off,
        "threshold_ratio": ratio, "dark_offset": sensor.dark_offset,
        "frame_noise": float(np.hypot(sensor.read_noise, 12**-0.5)) / 255,
        "exposure": sensor.exposure, "rho_ref": sensor.refractory,
    }  # fmt: skip
    return dataclasses.replace(made, frames=frames), truth


def coverage(scenes: int) -> str:
    errors: dict[str, list[tuple[bool, float, float]]] = {}
    seconds = []
    for seed in range(FIRST_SEED, FIRST_SEED + scenes):
        recording, truth = draw_scene(seed)
        start = time.process_time()
        found = jaxevent.calibrate(recording, truth["dark_offset"])
        seconds.append(time.process_time() - start)
        for name, true in truth.items():
            one = getattr(found, name)
            if one.is_identifiable:
                unit = 1e-3 if name == "clock_offset" else max(true, 1e-9)
                row = one.low <= true <= one.high, abs(one.value - true) / unit
                errors.setdefault(name, []).append((*row, (one.high - one.low) / 2 / unit))
    rows = [
        [
            name,
            len(of),
            sum(e[0] for e in of),
            *(float(np.median([e[k] for e in of])) for k in (1, 2)),
        ]
        for name, of in errors.items()
    ]
    head = ["", f"identified, of {scenes}", "covered", "median error", "median half width"]
    return f"{markdown_table(head, rows)}\n\nCPU seconds, median: {np.median(seconds):.2f}\n"


def error_of(method: Any, params: Any, given: Recording, hidden: Frames) -> float:
    mean, _, _ = method.estimate(given, params, progress=False)(
        frame_times(hidden, params), extrapolate=True
    )
    return float(((mean.clip(0, 1) - hidden.intensity) ** 2).mean())


def fit(method: Any, params: Any, given: Recording, hidden: Frames) -> float:
    """Return the least error of the numbers that `for_recording` sets, on the hidden frames."""
    names = [name for name in type(params).calibrated if name != "clock_offset"]

    def loss(z: np.ndarray) -> float:
        values = {
            n: float(getattr(params, n)) + 0.003 * s
            if n == "event_delay"
            else float(getattr(params, n)) * np.exp(0.3 * s)
            for n, s in zip(names, z, strict=True)
        }
        return np.log(error_of(method, params.replace(**values), given, hidden))

    simplex = np.vstack([np.zeros(len(names)), 0.5 * np.eye(len(names))])
    options = {"initial_simplex": simplex, "maxfev": 150, "xatol": 0.05, "fatol": 1e-3}
    return float(np.exp(minimize(loss, simplex[0], method="Nelder-Mead", options=options).fun))


def hidden_frames(folder: Any) -> str:
    rows = []
    for name in RECORDINGS:
        given, hidden = held_out(jaxevent.load(folder / name))
        assert given.frames is not None
        hidden = hidden[slice(0, int(np.searchsorted(hidden.t, given.frames.t[-1])))]
        for simple in ("blend", "flow"):
            method = getattr(jaxevent, simple)
            rows.append([name, simple, 100 * error_of(method, method.Params(), given, hidden)])
        for key in ("akf", "aks", "mc"):
            method = getattr(jaxevent, key)
            start = time.process_time()
            clock = recall_calibration(given, float(method.Params().I0)).clock_offset.value
            middle = time.process_time()
            chosen = method.Params.for_recording(given)
            end = time.process_time()
            columns = (method.Params(), method.Params(clock_offset=clock), chosen)
            errors = [100 * error_of(method, p, given, hidden) for p in columns]
            best = "-" if key == "mc" else 100 * fit(method, chosen, given, hidden)
            rows.append([name, key, *errors, best, middle - start, end - middle])
    head = ["", "method", "defaults", "clock", "for_recording", "fitted", "calibrate s", "refine s"]
    return markdown_table(head, (row + ["-"] * (len(head) - len(row)) for row in rows), 2) + "\n"


def true_times(scenes: int) -> str:
    """Return the table of errors at true times."""
    errors: dict[str, list[tuple[float, float, float]]] = {}
    for seed in range(FIRST_SEED, FIRST_SEED + scenes):
        recording, _ = draw_scene(seed)
        assert recording.frames is not None
        clock = jaxevent.calibrate(recording).clock_offset.value
        if not np.isfinite(clock):
            continue
        span = recording.frames.t[[1, -2]] + round(1e6 * clock)
        t, truth = recording.extra["hdr_t"], recording.extra["hdr"]
        inside = (span[0] < t) & (t < span[1])
        for name in ("blend", "flow", "akf", "aks", "mc"):
            method: Any = getattr(jaxevent, name)
            params = method.Params(clock_offset=clock)
            if method.fuses:
                params = method.Params.for_recording(recording)
            delay = 1e3 * float(params.event_delay)
            both = []
            for one in (params, params.beside_events()):
                image = method.estimate(recording, one, progress=False)(t[inside]).mean
                both.append(float(((image.clip(0, 1) - truth[inside].clip(0, 1)) ** 2).mean()))
            errors.setdefault(name, []).append((100 * both[0], 100 * both[1], delay))
    rows = []
    for name, of in errors.items():
        middle, mean = np.median(of, 0), np.mean(of, 0)
        rows.append([name, middle[0], mean[0], middle[1], mean[1], middle[2]])
    head = ["", "median", "mean", "delay in the clock: median", "mean", "delay, ms"]
    return f"{markdown_table(head, rows, 3)}\n\n{len(of)} scenes\n"


def main() -> None:
    parser = command_line(__doc__, out=True, data=True, parts=("coverage", "hidden", "times"))
    parser.add_argument("--scenes", type=int, default=60, help="number of simulated scenes")
    args = parser.parse_args()
    if "coverage" in args.only:
        write_text(args.out / "coverage.md", f"{coverage(args.scenes)}\n{machine()}\n")
    if "hidden" in args.only:
        write_text(args.out / "hidden.md", f"{hidden_frames(args.data)}\n{machine()}\n")
    if "times" in args.only:
        write_text(args.out / "times.md", f"{true_times(min(args.scenes, 12))}\n{machine()}\n")


if __name__ == "__main__":
    main()
