"""Parameters used to simulate are found again, within the interval that the fit states.

    python experiments/recovery.py [--only smoother akf blob voting] [--seeds 0 1 2]

- smoother, akf, blob: data drawn from the method's own model, where its noises have true values;
  found by the likelihood, of frames, of a reference image and of events.
- clipped: as smoother, but more noise, so that some pixels reach black or white.
- voting: points that drift as the filter's model has it, found by the error of the motion. Its
  votes are no likelihood, so that its best noise need not be the true one. The weight of a vote is
  fitted too, which has no true value; "voting, noise alone" leaves it as it is by default.
- sensor: a simulated sensor, where the thresholds, the dark offset and the frames' clock have true
  values; found by the likelihood of the frames alone.
"""

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

import jaxevent
from jaxevent.confidence import FitIntervals, confidence_intervals
from jaxevent.egomotion.models import Planar
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.recording import Events, Frames, Recording
from jaxevent.runs.blob import FAMILY as BLOBS
from jaxevent.runs.egomotion import MotionGoal, MotionLoss
from jaxevent.runs.family import FitData
from jaxevent.runs.reconstruction import Objective, Problem, RecordingWindow, cut_windows
from jaxevent.simulate import Pan, Sensor, blob_scene, scene, simulate
from jaxevent.tuning import Settings, optimise

TRUE = {
    "c_on": 0.12,
    "c_off": 0.09,
    "sigma_event": 0.12,
    "sigma_bg": 0.15,
    "sigma_frame": 0.008,
}
NOISY = {"sigma_event": 0.2, "sigma_bg": 0.3, "sigma_frame": 0.012}


def from_model(
    true: dict[str, float], seed: int, size: tuple[int, int] = (40, 32), frames: int = 20
) -> Recording:
    """Draw a recording from the smoother's model; I0 = 0.2.

    Events come at random; their polarity pulls their own sum back to the middle, so that frames do
    not reach black or white, where their likelihood is approximate. (It must not depend on the
    noise: the likelihood is of the frames, given the events.)
    """
    rng = np.random.default_rng(seed)
    width, height = size
    pixels, gap = width * height, 20_000
    I0, middle = 0.2, np.log(0.3 + 0.2)
    x = middle + rng.normal(0, 0.1, pixels)
    total = np.zeros(pixels)
    t, where, up, images = [], [], [], []
    for k in range(frames):
        noise = rng.normal(0, true["sigma_frame"], pixels)
        images.append(np.clip(np.exp(x) - I0 + noise, 0, 1))
        count = rng.poisson(4, pixels)
        for pixel in range(pixels):
            times = np.sort(rng.integers(1, gap, count[pixel])) + k * gap
            for time in times:
                on = rng.random() < 1 / (1 + np.exp(6 * total[pixel]))
                c = true["c_on"] if on else true["c_off"]
                total[pixel] += c if on else -c
                x[pixel] += (c if on else -c) + rng.normal(0, true["sigma_event"] * c)
                t.append(time)
                where.append(pixel)
                up.append(on)
        x += rng.normal(0, true["sigma_bg"] * np.sqrt(gap * 1e-6), pixels)
    order = np.argsort(t, kind="stable")
    y, column = np.divmod(np.array(where)[order], width)
    events = Events(
        np.array(t, np.int64)[order], column.astype(np.uint16), y.astype(np.uint16),
        np.array(up)[order],
    )  # fmt: skip
    stack = np.array(images, np.float32).reshape(frames, height, width)
    stamps = np.arange(frames, dtype=np.int64) * gap
    return Recording(
        "model", width, height, events, Frames(stamps, stack, np.zeros(frames, np.int64))
    ).check()


def fit_with_intervals(
    loss: Any, start: Any, names: list[str], batches: Any, settings: Settings, search: Any = None
) -> FitIntervals:
    """Fit parameters, and return them with their intervals."""
    fit = optimise(loss, start, names, batches, settings=settings, search=search)
    return confidence_intervals(loss, start, fit.params, names, batches, search, settings.forward)


def fit_by_frames(recording: Recording, start: Any, names: list[str], search: Any, iterations: int):
    """Fit parameters by the likelihood of the frames."""
    assert recording.frames is not None
    part = RecordingWindow(recording, recording.frames, np.arange(0), np.arange(0))
    problem = Problem(Objective(jaxevent.aks, None), [part])
    settings = Settings(iterations=iterations, learning_rate=0.1, rounds=2)
    return fit_with_intervals(problem.objective, start, names, problem, settings, search)


Recovered = tuple[dict[str, float], FitIntervals]


def model_recovery(
    seed: int, more: dict[str, float] | None = None, size: tuple[int, int] = (40, 32)
) -> Recovered:
    """Recover the smoother, from a start that is wrong by a factor of 2 or so."""
    true = {**TRUE, **(more or {})}
    start = jaxevent.aks.Params(
        c_on=0.2, c_off=0.2, I0=0.2, sigma_event=0.3, sigma_bg=0.4, sigma_frame=0.03,
        sigma_floor=1e-4, w_min=1.0, share=0.0,
    )  # fmt: skip
    return true, fit_by_frames(from_model(true, seed, size), start, list(true), None, 100)


AKF = {"c_on": 0.12, "c_off": 0.09, "sigma_proc": 0.3, "sigma_iso": 0.6, "sigma_ref": 0.04}
RHO, I0, P0, LENGTH = 0.01, 0.01, 1e-4, 1_000_000  # s, intensity, (ln I)^2, us


def from_akf(seed: int, size: tuple[int, int] = (64, 48)) -> Recording:
    """Draw events and a final image from the AKF's model: each event adds its three noises.

    Pixels differ in their rates, and blocks of 8x8 too, by which the noises differ.
    """
    rng, (width, height) = np.random.default_rng(seed), size
    blocks = np.exp(rng.uniform(0, np.log(20), (height // 8, width // 8)))
    rate = np.kron(blocks, np.ones((8, 8))) * np.exp(rng.uniform(0, np.log(8), (height, width)))
    row, column = np.nonzero(np.ones_like(rate))
    count = rng.poisson(rate[row, column])
    at = np.repeat(np.arange(width * height), count)
    t = rng.integers(1, LENGTH, len(at))
    order = np.argsort(t, kind="stable")
    t, y, x = t[order], row[at[order]], column[at[order]]
    first = np.clip(np.exp(np.log(0.5) + rng.normal(0, 0.1, (height, width))), 0.1, 0.9)
    start = first.astype(np.float32)
    L = np.log(start + I0) + rng.normal(0, np.sqrt(P0), start.shape)
    total, last = np.zeros(start.shape), np.zeros((height + 2, width + 2))  # us
    up = np.zeros(len(t), bool)
    for k, (now, j, i) in enumerate(zip(t, y, x, strict=True)):
        since, near = now - last[j + 1, i + 1], now - last[j : j + 3, i : i + 3].max()
        up[k] = rng.random() < 1 / (1 + np.exp(6 * total[j, i]))
        change = AKF["c_on"] if up[k] else -AKF["c_off"]
        Q = AKF["sigma_proc"] ** 2 * since * 1e-6 + AKF["sigma_iso"] ** 2 * near * 1e-6
        Q += AKF["sigma_ref"] ** 2 * (since * 1e-6 <= RHO)
        total[j, i] += change
        L[j, i] += change + rng.normal(0, np.sqrt(Q))
        last[j + 1, i + 1] = now
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), up)
    frames = Frames(np.zeros(1, np.int64), start[None], np.zeros(1, np.int64))
    extra = {
        "hdr": (np.exp(L) - I0)[None],
        "hdr_t": np.array([LENGTH], np.int64),
        "clip": np.array([0.0, 1.0]),
    }
    return Recording("akf", width, height, events, frames, extra=extra).check()


def akf_recovery(seed: int) -> Recovered:
    """Recover the AKF by the likelihood of an image at the end; frames give the start alone."""
    start = jaxevent.akf.Params(
        c_on=0.2, c_off=0.2, sigma_proc=0.1, sigma_iso=0.2, sigma_ref=0.1, rho=RHO, I0=I0, P0=P0,
        kappa=1e-9, calibrate=False, deblur=False,
        frame_noise=0.0, error_event=0.0, error_still=0.0, error_change=0.0,
    )  # fmt: skip
    drawn = cut_windows(from_akf(seed), "reference")
    problem = Problem(Objective(jaxevent.akf, "nll", False), drawn)
    settings = Settings(iterations=80, learning_rate=0.1, rounds=2)
    return AKF, fit_with_intervals(problem.objective, start, list(AKF), problem, settings)


WALK = {"Q_p": 20.0, "Q_v": 1e6, "Q_lambda": 10.0, "Q_theta": 0.1}


def blob_recovery(seed: int) -> Recovered:
    """Recover the blob filter by the likelihood of events, from noises wrong by factors of 10."""
    method = jaxevent.blob.moment
    start = method.Params(
        events_per_step=32, Q_p=200.0, Q_v=1e5, Q_lambda=100.0, Q_theta=1.0, Q_q=50.0
    )
    sources: Any = {"fit": [], "validation": [], "test": []}
    batches = []
    for k in range(8 * seed, 8 * seed + 8):
        recording, truth = blob_scene(
            "walk", k, walk_seed=k, duration=0.1, rate=4e4, Q_q=50.0, **WALK
        )
        x, y = truth(0.0)[0, 0, :2].tolist()
        settings = {"loss": "likelihood", "seeds": [[x, y, 10.0]]}
        goal = BLOBS.goal(method, start, settings)
        named = dataclasses.replace(recording, name=f"walk {k}")
        one = {**sources, "fit": [(named.name, named)]}
        batches += goal.problem(FitData(one))(start)[0]
    settings = Settings(
        iterations=40, learning_rate=0.3, rounds=1, every=10, patience=1000, forward=True
    )
    return WALK, fit_with_intervals(goal.loss, start, list(WALK), batches, settings)


NOISE = {"noise": 1.0}
STEP = 2e-4  # s, of points that move
SEQUENCES, RUNS, SETTLE = 6, 2, 0.05  # s


@dataclasses.dataclass(frozen=True)
class SimulatedGoal(MotionGoal):
    """Goal of recordings whose true motion is given, not read from a file."""

    truths: tuple[KnownMotion, ...] = ()

    def known(self, recording: Recording) -> KnownMotion:
        return self.truths[int(recording.name)]


def drifting_points(
    seed: int, size: tuple[int, int], noise: float, seconds: float = 0.4
) -> tuple[Recording, KnownMotion]:
    """Draw points whose velocity wanders by `noise` of its speed per square root of a second."""
    rng = np.random.default_rng([seed, 5])
    angle = rng.uniform(0, 2 * np.pi)
    path = [200.0 * np.array([np.cos(angle), np.sin(angle)])]
    for step in rng.normal(size=(round(seconds / STEP) - 1, 2)):
        path.append(path[-1] + noise * np.linalg.norm(path[-1]) * np.sqrt(STEP) * step)
    return events_of_points(seed, size, np.array(path))


def events_of_points(
    seed: int, size: tuple[int, int], path: np.ndarray, number: int = 60
) -> tuple[Recording, KnownMotion]:
    """Draw points that move by a path of velocities (times, 2), `STEP` apart, px/s."""
    rng = np.random.default_rng([seed, 1])
    at, sign = rng.uniform([0, 0], size, (number, 2)), rng.random(number) < 0.5
    cell, rows = np.floor(at), []
    times = STEP * np.arange(len(path))
    for t, U in zip(times, path, strict=True):
        at = at + U * STEP
        left = ((at < 0) | (at >= size)).any(1)
        at = np.where(left[:, None], np.mod(at, size), at)
        new = np.flatnonzero((np.floor(at) != cell).any(1) & ~left)
        cell = np.floor(at)
        rows.append(np.c_[1e6 * (t + STEP * rng.random(len(new))), cell[new], sign[new]])
    table = np.concatenate(rows)
    t, x, y, p = table[np.argsort(table[:, 0], kind="stable")].T
    events = Events(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p > 0)
    grid = np.rint(1e6 * times).astype(np.int64)
    return Recording("points", *size, events), KnownMotion(Planar, grid, path)


def voting_recovery(seed: int, names: tuple[str, ...] = ("noise", "alpha")) -> Recovered:
    """Recover the soft vote by the error of the motion; noise too small by a factor of 5."""
    drawn = [drifting_points(k + 10 * seed, (96, 72), NOISE["noise"]) for k in range(SEQUENCES)]
    named = [dataclasses.replace(one, name=str(k)) for k, (one, _) in enumerate(drawn)]
    truths = tuple(truth for _, truth in drawn)
    voting, loss = jaxevent.egomotion.voting, MotionLoss()
    goal = SimulatedGoal(voting, loss, "planar", "", RUNS, SETTLE, {}, truths)
    start = voting.Params(particles=100, batch=32, noise=0.2)
    sources: Any = {"fit": [(one.name, one) for one in named], "validation": [], "test": []}
    batches, _ = goal.problem(FitData(sources))(start)
    settings = Settings(
        iterations=30, learning_rate=0.2, rounds=1, every=10, patience=1000, forward=True
    )
    return NOISE, fit_with_intervals(loss, start, list(names), batches, settings)


VOTES = {"r_t": 50.0}
VOTES_SETTINGS = {"radius": 5, "noise": 0.6, "alpha_literal": 4.0}


def from_literal_votes(seed: int, seconds: float = 2.0) -> tuple[Recording, KnownMotion]:
    """Draw pairs of events from the literal likelihood: distance and lateness are exponential.

    The motion is along an axis, of about 50 px/s, and only its speed wanders. Each pair has a
    neighbourhood of its own, so that no other event is a candidate. Its first event is before the
    second, which cuts a few of the largest earlinesses of fast motion.
    """
    rng, cell, reach = np.random.default_rng([seed, 9]), 16, VOTES_SETTINGS["radius"]
    way = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[seed % 4]
    steps, count = round(seconds * 1e3), round(seconds * 500)
    alpha, spread = VOTES_SETTINGS["alpha_literal"], VOTES_SETTINGS["noise"] * np.sqrt(1e-3)
    logs = np.cumsum(spread * rng.normal(size=steps + 1))
    speed = 50 * np.exp(logs - logs[0])
    t = np.sort(rng.uniform(0, seconds, count))
    expected = 1 / speed[(1e3 * t).astype(int)]
    age = np.zeros(count)
    while (early := age <= 1e-4).any():
        late = rng.laplace(0, 1 / (alpha * VOTES["r_t"]), count)
        age = np.where(early, expected + late, age)
    axis = np.arange(-reach, reach + 1)
    d = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    chance = np.exp(-alpha * np.linalg.norm(d - way, axis=1))
    d = d[rng.choice(len(d), count, p=chance / chance.sum())]
    columns, rows = 20, 15
    place = rng.permutation(columns * rows)[np.arange(count) % (columns * rows)]
    at = np.stack([place % columns, place // columns], 1) * cell + cell // 2
    times, xy = np.concatenate([t - age, t]), np.concatenate([at, at + d])
    sign = np.tile(rng.random(count) < 0.5, 2)
    order = np.argsort(times, kind="stable")
    order = order[times[order] >= 0]
    x, y = xy[order].T.astype(np.uint16)
    events = Events(np.rint(1e6 * times[order]).astype(np.int64), x, y, sign[order])
    truth = KnownMotion(Planar, 1000 * np.arange(steps + 1), speed[:, None] * way)
    return Recording("votes", columns * cell, rows * cell, events), truth


def sensor_recovery(seed: int) -> Recovered:
    """Recover a simulated sensor: a slow pan, 2 s, all noise of a DAVIS.

    Events lag the intensity: on average it has moved half a threshold on since the last one. The
    offset found for the frames' clock contains that lag, half the time between a pixel's events.
    """
    sensor = Sensor(c_on=0.22, c_off=0.16, clock_offset=0.004, refractory=1e-3)
    pan = Pan(scene("forest"), speed="slow", duration=2.0, seed=seed)
    recording = simulate(pan, sensor, seed)
    start = jaxevent.aks.Params(preset="hdr", c_on=0.3, c_off=0.3, sigma_event=0.3)
    names = ["c_on", "c_off", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor"]
    search = {"clock_offset": (-0.012, 0.012, 9), "rho_ref": (0.0, 0.003, 7)}
    true = {"c_on": 0.22, "c_off": 0.16, "clock_offset": 0.004, "rho_ref": 1e-3}
    return true, fit_by_frames(recording, start, names, search, 60)


PARTS: dict[str, Callable[[int], Recovered]] = {
    "smoother": model_recovery,
    "clipped": lambda seed: model_recovery(seed, NOISY),
    "akf": akf_recovery,
    "blob": blob_recovery,
    "voting": voting_recovery,
    "voting, noise alone": lambda seed: voting_recovery(seed, ("noise",)),
    "sensor": sensor_recovery,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    arguments = parser.parse_args()
    print("| | seed | | true | start | found | 95 % interval | holds it | error |")
    print("|---|---:|---|---:|---:|---:|---:|---|---:|")
    for title in arguments.only:
        for seed in arguments.seeds:
            true, told = PARTS[title](seed)
            for name, value in true.items():
                one = told[name]
                held = "yes" if one.holds(value) else "no"
                error = f"{100 * (one.value / value - 1):+.1f} %"
                cells = (f"{value:.4g}", f"{one.start:.4g}", f"{one.value:.4g}", one.interval, held)
                print(
                    f"| {title} | {seed} | `{name}` | {' | '.join(cells)} | {error} |", flush=True
                )


if __name__ == "__main__":
    main()
