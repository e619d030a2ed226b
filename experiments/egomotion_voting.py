"""Motion by voting on simulated sequences with known motion, the thesis' literal likelihood beside.

    python experiments/egomotion_voting.py --out egomotion_voting [--seeds 10] [--first 100]
        [--only planar frames rotation penalty situations slow small live]

An ideal event camera of 160 x 120 pixels, f = 200 px, and the thesis' generator of frames 50 us
apart on 32 x 32 pixels. Parameters are the defaults and the presets of `voting.Params`, which were
chosen on seeds 0 to 9. Errors are means over a sequence after its start-up of 200 ms (100 frames),
in three readings: "at once", as the filter tells it; "fixed lag", when what is told counts for the
time that the candidates show; "smoothed", after a backward pass over the whole sequence
(`smoothed`). A run is lost if the filter says so at any time after the start-up, or if its
mean error is 50 % or more. Start-up is until the filter first says that it has found the motion.

"situations" are estimates as the command makes them by default, smoothed, and `causal` ones, where
motion varies, at 300 deg/s or 20 px/s, with noise, uneven thresholds, a lens or a focal length that
is wrong, a pause, dropped events, and a camera at rest. A row is beyond 3 sigma if a component is.
A false lock is a stretch of told rows that are off by more than half of the motion (by 0.5 rad/s
where it is less than 1).
Where the model is chosen, "doubt" counts the sequences in which another one is not excluded, a lens
is found, nothing is seen to move, or all rows are lost; a planar motion is held against the flow in
the middle of the image. General motion is that of one window of `batch`. Beside them stand contrast
maximisation in 30 lines, in windows of 30 ms from an exhaustive start, and points tracked in
frames. "small" holds `voting` against `planes` on small sensors. Writes a table of every part.
"""

import dataclasses
import resource
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from common import command_line, machine, table_of_rows, write_text
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import minimize

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion import batch, contrast, frames, planes, voting
from jaxevent.egomotion.bundle.hypotheses import WindowFitter
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.model_selection import ModelSelection, select_model
from jaxevent.egomotion.models import find_model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.particle_filter.filtering import smooth
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.scores import axis_error, relative_error, relative_magnitude_error
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.events.live import EVENTS_PER_CHUNK
from jaxevent.recording import Events, Recording
from jaxevent.simulate import SENSORS, motion_scene, simulate
from jaxevent.simulate.motion import simulate_frame_events, simulate_motion

Row = dict[str, Any]
Table = tuple[str, list[Row]]

SIZE, DURATION, SETTLE = (160, 120), 0.6, 0.2  # px, s, s
STEP = 50e-6  # s, of frames
FRAMES, SETTLE_FRAMES = 300, 100
TEXTURES = ("noise", "shapes")
SOFT: Row = {}
LITERAL: Row = {"preset": "literal"}
LATEST: Row = {"preset": "literal_latest"}
# In the generator the predecessor was one frame, of up to 3 px, ago.
LITERAL_FRAMES: Row = {
    **Params.presets["frames"],
    **Params.presets["literal"],
    "radius": 4,
    "candidates": 81,
    "every": 4,
    "batch": 32,
    "longest": 2e-4,
    "speed_max": 5e4,
    "tau_max": 4e-4,
    "noise": 4.0,
    "horizon": "fixed",
    "past": STEP,
}


def planar(motion: str, seed: int, texture: str, speed: float = 200.0) -> tuple[Recording, Any]:
    """Return a sequence, and its image velocity at times (s); fast ones are cut short."""
    duration = DURATION if speed < 400 else 0.35
    recording, source = motion_scene(
        "planar", motion, seed, size=SIZE, duration=duration, texture=texture, speed=speed
    )
    return recording, (source.velocity, duration)


def motion_errors(
    motion: MotionEstimate,
    params: Params,
    truth: Callable[[NDArray], NDArray],
    times: NDArray[np.floating],
) -> dict[str, float]:
    """Return mean relative errors, %, in three readings, and if the run is lost."""
    true = truth(times)
    smoothed = smooth(motion, params)
    told = {
        "at once": motion(times, centred=False, extrapolate=True),
        "fixed lag": motion(times, centred=True, extrapolate=True),
        "smoothed": smoothed(times, extrapolate=True),
    }
    scores = {}
    for name, states in told.items():
        mean, known = states.mean[states.valid], true[states.valid]
        scores[name] = 100 * float(relative_error(mean, known).mean()) if len(mean) else np.nan
        if true.shape[1] == 3 and len(mean):
            scores[f"AME_rel {name}"] = 100 * float(relative_magnitude_error(mean, known).mean())
            scores[f"AAE {name}"] = float(axis_error(mean, known).mean())
    off = told["smoothed"].mean - true
    scores["bias"] = 100 * float(np.nanmean((off * true).sum(1) / (true**2).sum(1)))
    found = np.flatnonzero(motion.valid)
    scores["start-up"] = 1e-3 * float(motion.t[found[0]]) if len(found) else np.nan
    scores["lost"] = float((~told["at once"].valid).any() or scores["smoothed"] >= 50)
    return scores


def summarise_runs(runs: Sequence[dict[str, float]], names: Iterable[str], prefix: str = "") -> Row:
    """Return means, and the worst of the runs."""
    row: Row = {}
    for name in names:
        values = np.array([run[name] for run in runs])
        if name == "lost":
            row[prefix + name] = f"{int(values.sum())} of {len(values)}"
        else:
            row[prefix + name] = float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
            row[f"{prefix}{name}, worst"] = float(np.nanmax(values, initial=-np.inf))
    return row


FULL = ("at once", "fixed lag", "smoothed", "lost", "start-up")
SHORT = ("at once", "smoothed", "lost")


def score_both(
    sequences: Sequence[tuple[Recording, Any]],
    first: int,
    soft: Row | None = SOFT,
    literal: Row | None = LITERAL,
    *,
    names: Sequence[str] = FULL,
    model: str = "planar",
) -> Row:
    """Score both likelihoods on the same sequences, side by side."""
    row: Row = {}
    for prefix, settings, chosen in (("", soft, names), ("literal ", literal, SHORT)):
        if settings is None:
            continue
        params, runs = Params.of(settings), []
        for k, (recording, (truth, duration)) in enumerate(sequences):
            motion = voting.estimate(recording, params, model=model, seed=first + k, smooth=False)
            times = np.arange(SETTLE, duration - 1e-6, 0.005)
            runs.append(motion_errors(motion, params, truth, times))
        row |= summarise_runs(runs, chosen, prefix)
    return row


def part_planar(seeds: range) -> Table:
    rows = []
    for change in ("constant", "linear", "varying"):
        for texture in TEXTURES:
            made = [planar(change, seed, texture) for seed in seeds]
            rows.append({"motion": change, "texture": texture, **score_both(made, seeds[0])})
            print(f"planar {change} {texture}", file=sys.stderr)
    return "planar: relative AEE (%), 200 px/s; start-up (ms)", rows


def flows() -> dict[str, NDArray[np.float64]]:
    """px/frame."""
    k = np.arange(FRAMES)[:, None]
    straight = {
        f"({u}, {v})": np.tile([u, v], (FRAMES, 1)) for u, v in ((0.8, 0.0), (0.8, 0.6), (1.5, 0.5))
    }
    return {
        **straight,
        "linear, 0.5 to 1.5 of (1, 0.5)": np.array([1.0, 0.5]) * (0.5 + k / FRAMES),
        "(1.3, 0.6) +- 35 %, period 200": np.array([1.3, 0.6])
        * (1 + 0.35 * np.sin(2 * np.pi * k / 200)),
    }


def in_frames(
    flow: NDArray[np.float64], seeds: range, settings: Row, names: Sequence[str], **made: Any
) -> Row:
    """Return errors in the thesis' generator; start-up in frames."""
    params, runs, fill = Params.of(settings), [], []
    for seed in seeds:
        recording, velocity = simulate_frame_events(flow, seed=seed, **made)
        motion = voting.estimate(recording, params, seed=seed, smooth=False)
        frame = np.arange(SETTLE_FRAMES, len(flow) - 1)
        frame = frame[(frame + 1) * STEP <= motion.t[-1] * 1e-6]
        scores = motion_errors(
            motion, params, lambda _, v=velocity, at=frame: v[at], (frame + 1) * STEP
        )
        scores["start-up"] /= 1e3 * STEP
        runs.append(scores)
        fill.append(len(recording.events) / (len(flow) * recording.width * recording.height))
    prefix = "literal " if params.likelihood == "literal" else ""
    return {"fill, %": 100 * float(np.mean(fill)), **summarise_runs(runs, names, prefix)}


def part_frames(seeds: range) -> Table:
    rows = []
    for name, flow in flows().items():
        soft = in_frames(flow, seeds, {"preset": "frames"}, FULL)
        literal = in_frames(flow, seeds, LITERAL_FRAMES, SHORT)
        rows.append({"motion, px/frame": name, **soft, **literal})
        print(f"frames {name}", file=sys.stderr)
    return "frame generator: relative AEE (%); start-up (frames)", rows


def part_rotation(seeds: range) -> Table:
    ways = {"soft vote": SOFT, "literal": LATEST, "literal, r_t = 0": {**LATEST, "r_t": 0.0}}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for seed in seeds:
        recording, source = motion_scene("rotation", "constant", seed, size=SIZE, duration=0.4)
        times = np.arange(SETTLE, source.duration - 1e-6, 0.005)
        for name, settings in ways.items():
            params = Params.of(settings)
            motion = voting.estimate(recording, params, model="rotation", seed=seed, smooth=False)
            runs[name].append(
                motion_errors(motion, params, lambda t, s=source: s.twist(t)[1], times)
            )
        print(f"rotation {seed}", file=sys.stderr)
    rows = []
    for name, scores in runs.items():
        for reading in ("at once", "smoothed"):
            row: Row = {"likelihood": name, "reading": reading}
            for title, key in (
                ("vector error, %", reading),
                ("AME_rel, %", f"AME_rel {reading}"),
                ("AAE, degrees", f"AAE {reading}"),
            ):
                told = summarise_runs(scores, [key])
                row |= {title: told[key], f"{title}, worst": told[f"{key}, worst"]}
            rows.append(row | summarise_runs(scores, ("lost", "start-up")))
    return "rotation, 2 rad/s", rows


def _true_rotation(source: Any) -> Callable[[NDArray], NDArray]:
    return lambda t: source.twist(t)[1]


def part_penalty(seeds: range) -> Table:
    """Vary r_t with the speed of the image; errors at once, geometric means over sequences."""
    rows = []
    for model, preset, speed in (
        ("planar", "literal", 60.0), ("planar", "literal", 200.0), ("planar", "literal", 600.0),
        ("rotation", "literal_latest", 400.0),
    ):  # fmt: skip
        for texture in TEXTURES:
            row: Row = {"motion": model, "px/s": speed, "texture": texture}
            for r_t in np.geomspace(10, 1e5, 9):
                errors = []
                for seed in seeds:
                    duration = DURATION if speed <= 400 else 0.35
                    more: Row = {"speed": speed} if model == "planar" else {}
                    recording, source = motion_scene(
                        model, "varying", seed, size=SIZE, duration=duration, texture=texture,
                        **more,
                    )  # fmt: skip
                    params = Params(preset=preset, r_t=float(r_t))
                    motion = voting.estimate(
                        recording, params, model=model, seed=seed, smooth=False
                    )
                    times = np.arange(SETTLE, duration - 1e-6, 0.005)
                    truth = source.velocity if model == "planar" else _true_rotation(source)
                    errors.append(motion_errors(motion, params, truth, times)["at once"])
                row[f"{r_t:.2g}"] = float(np.exp(np.log(errors).mean()))
            rows.append(row)
            print(f"penalty {row}", file=sys.stderr)
    return "literal likelihood over r_t (px/s): relative error at once (%)", rows


IDEAL = dataclasses.replace(
    SENSORS["ideal"], c_on=0.3, c_off=0.3, frame_rate=25.0, exposure=1e-3, exposure_samples=1,
    truth_rate=1e-3,
)  # fmt: skip
UNEVEN = dataclasses.replace(IDEAL, c_on=0.24, c_off=0.39, mismatch=0.15, jitter=5e-4)
MIDDLE = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
LENS_FOCAL = 100.0  # px, of the lens that distorts
N_REPEATS = 12  # of a sequence, live
SHORT_DURATION = 0.4  # s, of situations
N_GENERAL_SEQUENCES = 2  # each takes as long as five others
PAUSE_US, PAUSE_AT_US = 2_000_000, 200_000


def merge(recording: Recording, events: Events, keep_frames: bool) -> Recording:
    """Return the recording with further events."""
    columns = [np.concatenate([getattr(e, n) for e in (recording.events, events)]) for n in "txyp"]
    order = np.argsort(columns[0], kind="stable")
    kept = {} if keep_frames else {"frames": None, "poses": None}
    return dataclasses.replace(recording, events=Events(*(c[order] for c in columns)), **kept)


def noise_events(span: tuple[int, int], number: int, seed: int) -> Events:
    """Return events without order; one in ten is of five hot pixels."""
    rng = np.random.default_rng([seed, 1])
    x, y = (rng.integers(0, n, number).astype(np.uint16) for n in SIZE)
    hot = rng.random(number) < 0.1
    x[hot], y[hot] = x[rng.integers(0, 5, hot.sum())], y[rng.integers(0, 5, hot.sum())]
    x[:5], y[:5] = np.arange(5) * 20 + 7, np.arange(5) * 15 + 4
    return Events(np.sort(rng.integers(*span, number)), x, y, rng.random(number) < 0.5)


class Things:
    """Two textured discs that fly before a textured background: a source of intensity."""

    def __init__(self, seed: int):
        rng = np.random.default_rng([seed, 2])
        self.size, self.duration = SIZE, SHORT_DURATION
        self.textures = [
            0.3 * np.exp(2 * gaussian_filter(rng.normal(size=(SIZE[1], SIZE[1])), 1.5))
            for _ in range(2)
        ]
        self.back = 0.3 * np.exp(2 * gaussian_filter(rng.normal(size=SIZE[::-1]), 2))
        self.radius, self.place = rng.uniform(8, 20, 2), rng.uniform(30, 90, (2, 2))
        self.velocity = rng.uniform(60, 250, (2, 1)) * np.stack(
            [[np.cos(a), np.sin(a)] for a in rng.uniform(0, 2 * np.pi, 2)]
        )

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        y, x = np.mgrid[: SIZE[1], : SIZE[0]]
        image = self.back
        for k in range(2):
            u, v = self.place[k] + self.velocity[k] * t
            u, v = u % SIZE[0], v % SIZE[1]
            cover = np.clip(self.radius[k] - np.hypot(x - u, y - v) + 0.5, 0, 1)
            own = map_coordinates(self.textures[k], [y - v + 50, x - u + 50], order=1, mode="wrap")
            image = image * (1 - cover) + cover * own
        return image


def situation(name: str, seed: int) -> tuple[Recording, str, Callable[[NDArray], NDArray]]:
    """Return the recording, its model ("auto" if it is chosen), and the truth at times (us)."""
    model = "planar" if name in ("planar", "low texture", "20 px/s") else "rotation"
    made: Row = {"size": SIZE, "duration": SHORT_DURATION, "sensor": IDEAL}
    if model == "rotation":
        made["speed"] = 1.0  # rad/s
    if name == "low texture":
        made["texture"] = "shapes"
    elif name == "20 px/s":
        made |= {"speed": 20.0, "duration": 1.5}
    elif name == "300 deg/s":
        made |= {"speed": np.radians(300), "duration": 0.25}
    elif name == "uneven thresholds":
        made["sensor"] = UNEVEN
    elif name == "lens k1 = -0.35":
        made["lens"] = PinholeCamera(LENS_FOCAL, LENS_FOCAL, *MIDDLE, (-0.35, 0.1, 0.0, 0.0, 0.0))
    if name == "camera at rest":
        recording = dataclasses.replace(
            simulate(Things(seed), IDEAL, seed), camera=PinholeCamera(200.0, 200.0, *MIDDLE)
        )
        recording = merge(recording, noise_events((0, 400_000), 5000, seed), False)
        return recording, "rotation", lambda t: np.zeros((len(t), 3))
    steady = "300 deg/s", "slow translation", "20 px/s"
    change = "constant" if name in steady else "varying"
    scene = "texture" if name == "slow translation" else model
    if name == "slow translation":
        made["speed"] = 0.15
    recording, source = motion_scene(scene, change, seed, **made)
    if name == "slow translation":
        T = source.motion.mean[:3]
        source = dataclasses.replace(
            source, motion=dataclasses.replace(source.motion, mean=(*T, 0, 0, 0))
        )
        recording = simulate_motion(source, None, seed)
    last = round(1e6 * source.duration) - 1

    def truth(t: NDArray) -> NDArray:
        if name == "pause of 2 s":
            paused = (t > PAUSE_AT_US) & (t < PAUSE_AT_US + PAUSE_US)
            t = np.where(t >= PAUSE_AT_US + PAUSE_US, t - PAUSE_US, np.minimum(t, PAUSE_AT_US))
            return np.where(paused[:, None], 0, source.twist(np.clip(t, 0, last))[1])
        t = np.clip(t, 0, last)
        return source.velocity(t) if model == "planar" else source.twist(t)[1]

    if name == "30 % noise":
        number = int(0.3 * len(recording.events))
        recording = merge(recording, noise_events((0, last), number, seed), True)
    elif name == "pause of 2 s":
        e = recording.events[:]
        moved = Events(e.t + PAUSE_US * (e.t >= PAUSE_AT_US), e.x, e.y, e.p)
        noise = noise_events((0, last + PAUSE_US), 20_000, seed)
        recording = merge(dataclasses.replace(recording, events=moved), noise, False)
    elif name == "15 of 50 ms dropped":
        e = recording.events[:]
        kept = e.t % 50_000 >= 15_000
        events = Events(e.t[kept], e.x[kept], e.y[kept], e.p[kept])
        recording = dataclasses.replace(recording, events=events)
    elif name == "lens k1 = -0.35":
        recording = dataclasses.replace(
            recording, camera=PinholeCamera(LENS_FOCAL, LENS_FOCAL, *MIDDLE)
        )
    elif name == "focal 10 % wrong":
        recording = dataclasses.replace(recording, camera=PinholeCamera(220.0, 220.0, *MIDDLE))
    return recording, "auto" if name[:4] in ("lens", "slow") else model, truth


SITUATIONS = (
    "planar", "rotation", "general", "300 deg/s", "low texture", "30 % noise",
    "uneven thresholds", "lens k1 = -0.35", "focal 10 % wrong", "pause of 2 s", "camera at rest",
    "slow translation", "20 px/s", "15 of 50 ms dropped",
)  # fmt: skip


def maximise_contrast(recording: Recording, model: str, times: NDArray) -> NDArray[np.float64]:
    """Return the motions (times, d) that make 30 ms of events sharpest, plainly."""
    xi, f = pixel_coordinates(recording.width, recording.height, recording.camera)
    kind = find_model(model)(f)
    basis, found = np.asarray(kind.basis(xi), float), []
    unit = 1 / kind.pixel_scale(xi)
    low = xi.min((0, 1)) - 20
    shape = (np.ceil(xi.max((0, 1))) + 21 - low).astype(int)[::-1]
    grid = np.stack(np.meshgrid(*[np.linspace(-400, 400, 17)] * 2), -1).reshape(-1, 2)
    if model == "rotation":
        grid = np.stack([grid[:, 1], -grid[:, 0], 0 * grid[:, 0]], 1)
    for t in times:
        part = recording.events[
            recording.events.index(int(t) - 15_000) : recording.events.index(int(t) + 15_000)
        ]
        step = max(1, len(part) // 10_000)
        x, y, at = (c[::step] for c in (part.x, part.y, (part.t - t) * 1e-6))
        where, columns, sign = xi[y, x] - low, basis[y, x], np.where(part.p[::step], 1, -1)

        def loss(z: NDArray) -> float:
            i, j = np.rint(where - columns @ (z * unit) * at[:, None]).astype(int).T  # noqa: B023
            i, j = np.clip(i, 0, shape[1] - 1), np.clip(j, 0, shape[0] - 1)
            image = np.bincount(j * shape[1] + i, sign, shape.prod()).reshape(shape)  # noqa: B023
            return -float(gaussian_filter(image, 1.0).var())

        starts = grid if not found else [found[-1] / unit]
        start = min(starts, key=loss)
        simplex = np.concatenate([start[None], start + 20 * np.eye(len(start))])
        options = {"initial_simplex": simplex, "maxiter": 120}
        found.append(minimize(loss, start, method="Nelder-Mead", options=options).x * unit)
    return np.array(found)


def score_rows(told: Any, true: NDArray) -> tuple[dict[str, float], NDArray[np.bool_]]:
    """Return figures of an estimate at some times, and which rows are false."""
    off = np.linalg.norm(np.nan_to_num(told.mean) - true, axis=1)
    size = np.linalg.norm(true, axis=1)
    least = 1.0 if true.shape[1] == 3 else 50.0
    false = told.valid & (off > 0.5 * np.maximum(size, least))
    sigma = np.sqrt(np.diagonal(told.covariance, axis1=1, axis2=2))
    beyond = (np.abs(np.nan_to_num(told.mean) - true) > 3 * sigma).any(1)[told.valid]
    row = {"lost %": 100 * float((~told.valid).mean())}
    if told.valid.any():
        share = off[told.valid] / np.maximum(size[told.valid], 1e-3 * least)
        row |= {"beyond 3 sigma %": 100 * float(beyond.mean())}
        if size.min() > 0 or (size > 0).mean() > 0.1:
            row |= {"error %": 100 * float(np.median(share))}
    return row, false


def score_general(seed: int) -> dict[str, float]:
    """Return figures of general motion in the middle of a sequence, from nothing."""
    recording, source = motion_scene("texture", "varying", seed, size=SIZE, duration=0.4)
    assert recording.camera is not None
    middle = 200_000
    fit = WindowFitter(recording, batch.Params.of({}), recording.camera).fit(middle)
    T, Omega = source.twist(np.array([middle]))
    true = np.concatenate([T / np.linalg.norm(T), Omega], 1)
    assert fit is not None
    mean = np.concatenate(fit.path.unit_twist(0.0), 1)
    told = Estimate(mean, fit.covariance[None], np.ones(1, bool))
    return score_rows(told, true)[0]


def score_voting(
    name: str, recording: Recording, doubt: ModelSelection | None, model: str, seed: int, truth: Any
) -> dict[str, dict[str, float]]:
    """Return figures of the command's estimate, and of the causal one of the same votes."""
    times = np.arange(recording.start, recording.stop, 1000)
    start = voting.initial_params(find_model(model))
    params = voting.adapt_params(recording, start).params
    runner, parts = voting.make_runner(recording, params, model=model, seed=seed), []
    while not runner.sampler.is_exhausted:
        parts.append(runner.run())
    causal = runner.causal_motion(parts).with_recording(recording)
    causal, rows = causal._with_gaps(float(params.tau_max)), {}
    for prefix, motion in (
        ("", runner.motion(parts)),
        ("causal ", causal),
    ):
        told = doubt.include_doubt(motion) if doubt else motion
        if name == "focal 10 % wrong":
            told = told.with_focal_error()
        told, _ = told.with_flow_consistency(recording)
        rows[prefix], false = score_rows(told(times), truth(times))
        rows[prefix]["false locks"] = float((np.diff(np.r_[0, false]) == 1).sum())
    return rows


def score_others(recording: Recording, model: str, truth: Any) -> dict[str, float]:
    """Return median errors of plain contrast maximisation, and of points in frames."""
    some = np.arange(recording.start + 120_000, recording.stop - 15_000, 100_000)
    some = some[np.linalg.norm(truth(some), axis=1) > 0]
    row: dict[str, float] = {}
    if len(some):
        plain = relative_error(maximise_contrast(recording, model, some), truth(some))
        row["30 lines, error %"] = 100 * float(np.median(plain))
    if recording.frames and len(some):
        points = frames.estimate(recording, model=model)(some)
        off = relative_error(points.mean[points.valid], truth(some)[points.valid])
        row["points, error %"] = 100 * float(np.median(off)) if len(off) else np.nan
    return row


def part_situations(seeds: range) -> Table:
    rows = []
    for name in SITUATIONS:
        runs: dict[str, list[dict[str, float]]] = {"": [], "causal ": [], "other ": []}
        chosen, doubts = [], 0
        for seed in seeds:
            if name == "general":
                if len(runs[""]) < N_GENERAL_SEQUENCES:
                    runs[""].append(score_general(seed))
                continue
            recording, model, truth = situation(name, seed)
            doubt = None
            if model == "auto":
                try:
                    doubt = select_model(recording)
                except InputError:  # nothing is seen to move
                    chosen.append("none")
                    doubts += 1
                    continue
                model = doubt.model.name
                chosen.append(model + (" + lens" if doubt.camera else ""))
                doubts += doubt.doubt is not None or doubt.camera is not None
                if doubt.camera:
                    recording = dataclasses.replace(recording, camera=doubt.camera)
            if model == "general":
                continue
            if model == "planar" and truth(np.zeros(1)).shape[1] == 3:

                def truth(t: NDArray, turn: Any = truth) -> NDArray:
                    return LENS_FOCAL * turn(t)[:, [1, 0]] * [-1, 1]

            found = score_voting(name, recording, doubt, model, seed, truth)
            for prefix, one in found.items():
                runs[prefix].append(one)
            is_silent = doubt is not None and doubt.doubt is None and doubt.camera is None
            doubts += is_silent and found[""]["lost %"] == 100
            runs["other "].append(score_others(recording, model, truth))
        row: Row = {"situation": name}
        if chosen:
            row |= {"chosen": ", ".join(chosen), "doubt": f"{doubts} of {len(chosen)}"}
        for prefix, scored in runs.items():
            for key in dict.fromkeys(key for one in scored for key in one):
                values = [one[key] for one in scored if key in one]
                total = np.sum if key == "false locks" else np.nanmean
                row[prefix.replace("other ", "") + key] = float(total(values))
        row["worst beyond %"] = max(
            (one["beyond 3 sigma %"] for one in runs[""] if "beyond 3 sigma %" in one),
            default=np.nan,
        )
        rows.append(row)
        print(f"situations {time.process_time():.0f} s {row}", file=sys.stderr, flush=True)
    return "situations: as the command estimates by default, and causal", rows


def part_slow(seeds: range) -> Table:
    """Errors and honesty of `frames` and `contrast` where the image is slow."""
    rows = []
    for model, change, speed in (
        ("planar", "constant", 20.0), ("planar", "varying", 20.0), ("rotation", "varying", 0.1),
    ):  # fmt: skip
        row: Row = {"motion": f"{model}, {change}", "speed": speed}
        for method in (frames, contrast):
            runs = []
            for seed in seeds:
                recording, source = motion_scene(
                    model, change, seed, size=SIZE, sensor=IDEAL, speed=speed, duration=1.5
                )
                times = np.arange(recording.start, recording.stop, 2000)
                true = source.velocity(times) if model == "planar" else source.twist(times)[1]
                runs.append(score_rows(method.estimate(recording, model=model)(times), true)[0])
            for key in runs[0]:
                row[f"{method.name}: {key}"] = float(np.mean([run[key] for run in runs]))
        rows.append(row)
        print(f"slow {time.process_time():.0f} s {row}", file=sys.stderr, flush=True)
    return "frames and contrast where the image is slow", rows


def part_small(seeds: range) -> Table:
    """Errors of `voting` and `planes` where a small sensor turns, 0.1 to 0.37 s."""
    rows, times = [], np.arange(100_000, 370_000, 5000)
    for size, focal in (((120, 90), 100.0), ((160, 120), 130.0), ((240, 180), 200.0)):
        for change in ("constant", "varying"):
            runs: dict[str, list[dict[str, float]]] = {"planes": [], "voting": []}
            for seed in seeds:
                recording, source = motion_scene(
                    "rotation", change, seed, size=size, focal=focal, duration=SHORT_DURATION
                )
                true = source.twist(times)[1]
                for method in (planes, voting):
                    told = method.estimate(recording, model="rotation")(times)
                    runs[method.name].append(score_rows(told, true)[0])
            row: Row = {"size": f"{size[0]} x {size[1]}", "rotation": change}
            for name, scored in runs.items():
                row |= summarise_runs(scored, ("error %", "beyond 3 sigma %"), f"{name}: ")
            rows.append(row)
            print(f"small {time.process_time():.0f} s {row}", file=sys.stderr, flush=True)
    return "rotations on small sensors", rows


def part_live(seeds: range) -> Table:
    """Memory of live motion while a sequence is repeated, and what an hour at its rate takes."""
    recording, _ = planar("constant", seeds[0], "noise")
    e = recording.events[:]
    period, live = int(e.t[-1] - e.t[0]) + 1, voting.live(SIZE, model="planar", seed=seeds[0])
    rows: list[Row] = []
    for repeat in range(N_REPEATS):
        clock = time.process_time()
        moved = Events(e.t + repeat * period, e.x, e.y, e.p)
        for first in range(0, len(e), EVENTS_PER_CHUNK):
            live.add(moved[first : first + EVENTS_PER_CHUNK])
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        rows.append(
            {
                "events, M": 1e-6 * (repeat + 1) * len(e),
                "recording, s": 1e-6 * (repeat + 1) * period,
                "events held": len(live._tail.retained()),
                "estimates held": len(live.motion),
                "peak memory, MB": peak,
                "CPU s per s": (time.process_time() - clock) / (1e-6 * period),
            }
        )
    hour, half = 3600e6 / period, N_REPEATS // 2
    growth = (rows[-1]["peak memory, MB"] - rows[half]["peak memory, MB"]) / (N_REPEATS - 1 - half)
    rows.append(
        {
            **rows[-1],
            "events, M": 1e-6 * hour * len(e),
            "recording, s": 3600.0,
            "peak memory, MB": rows[-1]["peak memory, MB"] + growth * (hour - N_REPEATS),
        }
    )
    return "live motion: memory; the last row is extrapolated", rows


PARTS: dict[str, Callable[[range], Table]] = {
    "planar": part_planar,
    "frames": part_frames,
    "rotation": part_rotation,
    "penalty": part_penalty,
    "situations": part_situations,
    "slow": part_slow,
    "small": part_small,
    "live": part_live,
}


def main() -> int:
    parser = command_line(__doc__, out=True, parts=PARTS)
    parser.add_argument("--seeds", type=int, default=10, help="sequences of each kind")
    parser.add_argument("--first", type=int, default=100, help="the first one's seed")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    text = f"{machine()}; seeds {seeds[0]} to {seeds[-1]}\n\n"
    for part in arguments.only:
        title, rows = PARTS[part](seeds)
        one = f"### {title}\n\n{table_of_rows(rows)}\n\n"
        print(one, flush=True)
        text += one
    write_text(arguments.out / "table.md", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
