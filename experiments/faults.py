"""Faults that are found in faulty recordings, false alarms in sound ones, and errors of methods.

JAXEVENT_DATA=FOLDER python experiments/faults.py --out faults [--only matrix clean methods scenes]

matrix   what `check_consistency` reports of recordings with one fault each
clean    what it reports of all recordings of the folder, and of 40 simulated scenes without
         faults, whose seeds chose no limit; with CPU seconds
methods  mean squared error x 1e-2 of 8 hidden frames: every second frame is given, of "frames
         at 3 Hz" all that are left. Methods calibrate themselves by what is given. The truth is
         the sound frame, of clipped ones the clipped one. --method, --recording and --fault
         choose some. "mc / best" compares mc with the best of the others.
scenes   the same of images between frames of simulated scenes, against their true intensity: a
         camera that shakes faster than frames follow, and a pan under a lamp of 100 Hz, each by
         a sensor of three thresholds, of seeds that chose no number.
"""

import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import command_line, markdown_table, write_text
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

import jaxevent
from jaxevent.metrics import mse
from jaxevent.recording import Frames, Recording
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.simulate import (
    BoxWorld,
    IntensitySource,
    MovingCamera,
    MovingObjects,
    Pan,
    Sensor,
    make_texture,
    planar_motion,
    scene,
    simulate,
)  # fmt: skip
from jaxevent.simulate.faults import FAULTS

RECORDINGS = ("slider_depth.zip", "davis346_street.npz", "evbench_seq3_calibrated.npz")
METHODS = ("last-frame", "blend", "flow", "akf", "aks", "mc")
# Files whose times of frames are wrong, as their own descriptions say, or whose frames are empty.
FAULTY_FILES = (
    "evbench_seq3.npz", "public_cases/g10_clock", "public_cases/f08b_v2e_frames.h5",
    "public_cases/f13_timelens", "public_cases/g09_imgns", "public_cases/m12_evreal",
    "public_cases/r03_esim.bag", "public_cases/r04_bayer.bag", "public_cases/r05_jpeg.bag",
)  # fmt: skip
N_SCENES, FIRST_SEED = 40, 8_000
KINDS, THRESHOLDS, FIRST_KIND_SEED = ("shake", "lamp"), (0.05, 0.1, 0.2), 8_100
N_IMAGES = 8


class Dimmed:
    """A source whose brightest 0.1 % is at 0.8 of the frames' white, so that none clips."""

    def __init__(self, source: IntensitySource):
        self.source, self.size, self.duration = source, source.size, source.duration
        times = np.linspace(0, source.duration, 4).tolist()
        self.gain = 0.8 / float(np.quantile([source.intensity(t) for t in times], 0.999))

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        return self.gain * self.source.intensity(t)


class Panned:
    """A texture before a camera that shakes, or that moves on under a lamp of 100 Hz."""

    size, duration = (96, 72), 0.8

    def __init__(self, kind: str, seed: int):
        rng = np.random.default_rng(seed)
        grains = [
            gaussian_filter(rng.standard_normal((256, 256)), s, mode="wrap") for s in (1.5, 6)
        ]
        grain = sum(one / one.std() for one in grains)
        self.image = 0.06 + 0.84 / (1 + np.exp(-1.2 * grain))
        self.y, self.x = np.mgrid[: self.size[1], : self.size[0]].astype(float)
        self.shakes, self.frequencies = kind == "shake", rng.uniform(5, 9, 2)
        self.reach = rng.uniform(3, 8, 2) if self.shakes else rng.uniform(-90, 90, 2)

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        turn = 2 * np.pi * t
        dx, dy = self.reach * (np.sin(turn * self.frequencies) if self.shakes else t)
        image = map_coordinates(self.image, [self.y + dy, self.x + dx], order=3, mode="grid-wrap")
        light = 1.0 if self.shakes else (1 + 0.3 * np.sin(100 * turn)) / 1.3
        return image.clip(0.03, 1) * light


def scenes() -> str:
    """Return the table of errors x 1e-2 between the frames of simulated scenes."""
    rows = []
    for kind in KINDS:
        for seed, c in enumerate(THRESHOLDS, FIRST_KIND_SEED):
            source = Panned(kind, seed)
            sensor = Sensor(c_on=c, c_off=c, frame_rate=24.0, exposure=4e-3, truth_rate=1.0)
            given = simulate(source, sensor, seed)
            assert given.frames is not None
            mid = given.frames.t[2:-2]
            parts = np.resize([0.5, 0.25, 0.7], len(mid) - 1)
            times = np.round(mid[:-1] + parts * np.diff(mid)).astype(np.int64)[::2]
            truth = np.stack([source.intensity(t * 1e-6) for t in times.tolist()])
            errors = {}
            for method in METHODS:
                estimator = jaxevent.METHODS[method]
                video = estimator.estimate(given, progress=False)
                images = np.clip(np.asarray(video(times).mean), 0, 1)
                errors[method] = 100 * float(np.mean((images - truth) ** 2))
            best = min(v for k, v in errors.items() if k != "mc")
            rows.append([kind, f"{c} of seed {seed}", *errors.values(), errors["mc"] / best])
            print(*rows[-1], flush=True)
    return markdown_table(["scene", "threshold", *METHODS, "mc / best"], rows, 2)


def simulated_scene(seed: int) -> Recording:
    """Return a sound recording of random thresholds, noise, speed, and rate of frames."""
    rng = np.random.default_rng(seed)
    c_on, speed = np.exp(rng.uniform(np.log([0.1, 20]), np.log([0.35, 200]))).tolist()
    sensor = Sensor(
        c_on=c_on, c_off=c_on * rng.uniform(0.7, 1.4), dark_offset=rng.uniform(0.003, 0.03),
        background_rate=rng.uniform(0, 0.5), read_noise=rng.uniform(0.3, 1.2),
        refractory=float(rng.choice([0, 3e-4, 1e-3])),
        frame_rate=float(rng.choice([20, 25, 30, 40])),
        exposure=float(rng.choice([5e-4, 2e-3, 5e-3, 0.01])),
    )  # fmt: skip
    size, seconds = (112, 84), 0.8
    if seed % 3 == 0:
        return simulate(MovingObjects(size, seconds, speed, seed=seed), sensor, seed)
    if seed % 3 == 1:
        pan = Pan(scene(seed, decades=2.0), size, seconds, speed, seed)
        return simulate(Dimmed(pan), sensor, seed)
    direction = rng.uniform(0, 2 * np.pi)
    vx, vy = (speed * np.cos(direction), speed * np.sin(direction))
    texture = make_texture(("noise", "shapes")[seed // 3 % 2], 0.02, seed)
    world = BoxWorld((-50, -50, -1), (50, 50, 2), texture)
    motion = planar_motion((vx, vy), 2, 100.0, amplitude=(vx / 2, vy / 2))
    return simulate(Dimmed(MovingCamera(world, motion, size, 100.0, seconds)), sensor, seed)


def describe(recording: Recording) -> tuple[str, float]:
    """Return the faults that are found with statistic and limit, and CPU seconds."""
    start = time.process_time()
    found = jaxevent.check_consistency(recording)
    text = "; ".join(f"{f.name} {f.statistic:.3g} > {f.limit:.3g}" for f in found)
    return text or "none", time.process_time() - start


def matrix(folder: Path) -> str:
    """Return the table of faults by recording."""
    names = [name.partition(".")[0] for name in RECORDINGS]
    sound = [jaxevent.load(folder / name) for name in RECORDINGS]
    rows = [["none", *(describe(one)[0] for one in sound)]]
    for name, make_faulty in FAULTS.items():
        rows.append([name, *(describe(make_faulty(one, 0))[0] for one in sound)])
    return markdown_table(["fault", *names], rows, 1 + len(names))


def sound_recordings(folder: Path) -> Iterator[tuple[str, Recording]]:
    """Yield every recording of a folder that can be read, then simulated scenes."""
    for path in sorted([*folder.glob("*.*"), *folder.glob("public_cases/*")]):
        try:
            recording = jaxevent.load(path)
        except (jaxevent.errors.InputError, ImportError, OSError):
            continue  # no recording, or one of a reader that is not installed
        yield str(path.relative_to(folder)), recording
    for seed in range(FIRST_SEED, FIRST_SEED + N_SCENES):
        yield f"scene {seed}", simulated_scene(seed)


def clean(folder: Path) -> str:
    """Return the table of false alarms, and of what is found in files known to be faulty."""
    rows = [
        [name, len(one.events), 0 if one.frames is None else len(one.frames), *describe(one)]
        for name, one in sound_recordings(folder)
    ]
    alarms = sum(row[3] != "none" and row[0] not in FAULTY_FILES for row in rows)
    table = markdown_table(["recording", "events", "frames", "found", "CPU s"], rows)
    return (
        f"{table}\n\n{alarms} of {len(rows)} recordings with a false alarm or a fault of their own"
    )


def hide_frames(sound: Recording, name: str) -> tuple[Recording, NDArray, NDArray]:
    """Return what is given of a faulty recording, stamps of hidden frames (us), and the truth."""
    faulty = FAULTS[name](sound, 0) if name != "none" else sound
    assert sound.frames is not None and faulty.frames is not None
    given = faulty if len(faulty.frames) < len(sound.frames) else held_out(faulty)[0]
    step = len(sound.frames) // len(faulty.frames) + 1 if given is faulty else 2
    assert given.frames is not None
    rows = np.arange(step * (len(given.frames) - 1))
    rows = rows[rows % step > 0]
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, N_IMAGES).round().astype(int))]
    of_truth = sound if name in ("frames flicker", "frames blurred") or given is faulty else faulty
    stamps = sound.frames.t if given is faulty else faulty.frames.t
    assert of_truth.frames is not None
    return given, stamps[rows], of_truth.frames[rows].intensity


def score(sound: Recording, fault: str, method: str) -> float:
    """Return the mean squared error of a method in the place of hidden frames."""
    given, stamps, truth = hide_frames(sound, fault)
    estimator = jaxevent.METHODS[method]
    params = estimator.Params.for_recording(given)
    stamped = Frames(stamps, truth, 0 * stamps)
    result = estimator.estimate(given, params, progress=False)
    images = np.asarray(result(frame_times(stamped, params), extrapolate=True).mean)
    return float(np.mean([mse(np.clip(a, 0, 1), b) for a, b in zip(images, truth, strict=True)]))


def compare(folder: Path, store: Path, chosen: dict[str, list[str]]) -> str:
    """Return the table of errors; cells that the folder holds are not computed again."""
    errors = json.loads(store.read_text()) if store.exists() else {}
    rows = []
    for file in chosen["recording"]:
        sound = jaxevent.load(folder / file)
        for fault in chosen["fault"]:
            cell = errors.setdefault(f"{file}: {fault}", {})
            for method in chosen["method"]:
                if method not in cell:
                    cell[method] = score(sound, fault, method)
                    store.write_text(json.dumps(errors, indent=1))
            best = min((v for k, v in cell.items() if k != "mc"), default=np.nan)
            values = [100 * cell[m] if m in cell else "-" for m in METHODS]
            ratio = cell["mc"] / best if "mc" in cell else "-"
            rows.append([file.partition(".")[0], fault, *values, ratio])
            print(*rows[-1], flush=True)
    return markdown_table(["recording", "fault", *METHODS, "mc / best"], rows, 2)


def main() -> None:
    parser = command_line(
        __doc__, out=True, data=True, parts=("matrix", "clean", "methods", "scenes")
    )
    faults = ["none", *(name for name in FAULTS if name != "clocks disjoint")]
    for name, choices in (("method", METHODS), ("recording", RECORDINGS), ("fault", faults)):
        parser.add_argument(f"--{name}", nargs="+", choices=choices, default=list(choices))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    chosen = {name: getattr(arguments, name) for name in ("method", "recording", "fault")}
    for part in arguments.only:
        if part == "methods":
            text = compare(arguments.data, arguments.out / "errors.json", chosen)
        elif part == "scenes":
            text = scenes()
        else:
            text = {"matrix": matrix, "clean": clean}[part](arguments.data)
        write_text(arguments.out / f"{part}.md", text + "\n")
        print(text)


if __name__ == "__main__":
    main()
