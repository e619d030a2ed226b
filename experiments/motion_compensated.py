"""Methods that follow motion against those that do not: hidden frames, moving objects, blur, flow.

    JAXEVENT_DATA=FOLDER python experiments/motion_compensated.py --params fitted --out compared

`fitted` is what `jaxevent fit configs/fit_slider_depth.toml --out fitted` makes. Tables:

    slider   slider_depth, every 2nd, 4th, 8th, 16th frame given; each half of the recording
    street   davis346_street, every 2nd, 4th, 8th; all pixels, and where something moves
    objects  simulated objects, frames at 25 and 100 Hz, halfway between frames
    blur     pans and objects, long exposures: at the frames' middles, and halfway between them
    exposures  the same of `mc`, not fitted, with and without exposures along trajectories
    flow     the optical flow of objects, against the true one
    video    seconds of all cores per image of `mc` on slider_depth, 100 images per second and far
             apart, of the smoother's images at the same times, and the error of hidden frames: as
             it is, and with an anchor for every target

Of hidden frames a few are scored, evenly chosen among those that lie between given ones. Simulated
recordings are those of seeds 101 to 103; the smoother and the filter are fitted to seeds 1 to 3.
The method `mc` is left out where there is none. Rows that the folder holds are not computed again.
Columns are means over images; z2 is the mean squared standardised error of ln(I + I0), 1 for honest
variances, to which that of the hidden frame's own noise is added; s is seconds per image, of
reconstruction and reading, without compilation.
"""

import argparse
import dataclasses
import functools
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from compensated_choice import noise_of
from numpy.typing import NDArray
from tqdm import tqdm

import jaxevent
from jaxevent.camera import UnknownResponse
from jaxevent.parameters import Parameters, read_toml
from jaxevent.reconstruction.compensated import estimator
from jaxevent.recording import Frames, Recording
from jaxevent.runs.fit import fit
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.runs.scores import hidden_scores, moves
from jaxevent.simulate import SENSORS, IntensitySource, MovingObjects, Pan, scene, simulate

METHODS = ("blend", "flow", "edi", "akf", "aks", "mc")
LIKELIHOOD = "aks, likelihood"  # the label of the smoother in a fit to slider_depth
SHARED = ("c_on", "c_off", "I0", "clock_offset", "rho_ref")  # what every method takes from it
CHOOSING, SCORING = (1, 2, 3), (101, 102, 103)  # seeds
RATES = (25.0, 100.0)  # Hz
IMAGES = {2: 10, 4: 10, 8: 10, 16: 8}  # by gap
BLURS = ((0.02, 0.05, 0.1), (25.0, 100.0, 300.0))  # s; px/s
FAR = 3.0  # px, errors of the flow that count as wrong

FIT = """
recordings = [{recordings}]
split = [2, 1, 1]
iterations = 40
learning_rate = 0.1
rounds = 2

[[method]]
name = "akf"
params = {{ c_on = 0.2, c_off = 0.18, rho_ref = 5e-4, I0 = 0.1 }}
fit = ["c_on", "c_off", "I0", "kappa", "w_min", "sigma_iso", "sigma_proc", "sigma_ref"]

# The likelihood of hidden frames: that of given ones makes sigma_floor 0.05, and the error twice
# that of the values to start from.
[[method]]
name = "aks"
error = "nll"
params = {{ c_on = 0.2, c_off = 0.18, rho_ref = 5e-4, I0 = 0.1, w_min = 0.6 }}
fit = ["c_on", "c_off", "sigma_event", "sigma_bg", "sigma_frame", "sigma_floor", "share"]
"""

Chosen = Mapping[str, tuple[Any, Parameters]]  # method and parameters by name
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Compensated:
    """Where the parameters of `mc` are: a fit's file or folder, and its label there."""

    file: Path | None
    label: str


def chosen(names: Iterable[str], fitted: Path, compensated: Compensated) -> Chosen:
    """Methods and their parameters, from a fit's folder.

    The smoother is that fitted to the likelihood, if there is one. What the fit does not have has
    the smoother's thresholds, offset and dead time. `mc` has all numbers of the smoother that it
    knows, and the others of its own file.
    """
    file = fitted / "params.toml"
    labels = read_toml(file)
    smoother = jaxevent.aks.Params.load(file, LIKELIHOOD if LIKELIHOOD in labels else "aks")
    values = smoother.values()
    found: dict[str, tuple[Any, Parameters]] = {}
    for name in names:
        method = jaxevent.METHODS.get(name)
        if method is None:
            continue
        if name == "aks":
            params: Any = smoother
        elif name in labels:
            params = method.Params.load(file, name)
        elif name == "mc":
            params = method.Params()
            if compensated.file is not None:
                own = compensated.file
                own = own / "params.toml" if own.is_dir() else own
                params = method.Params.load(own, compensated.label)
            known = method.Params.settings()
            params = params.replace(**{k: v for k, v in values.items() if k in known})
        else:
            params = method.Params.of({k: values[k] for k in SHARED})
        found[name] = method, params
    return found


class Store:
    """The rows of a table, in a file; a cell of a method is computed once."""

    def __init__(self, file: Path):
        self.file = file
        self.rows: list[Row] = json.loads(file.read_text()) if file.exists() else []

    def add(self, cell: Mapping[str, Any], methods: Chosen, score: Callable[..., Row]) -> None:
        """Score every method that has no row of this cell yet: `score(method, params)`."""
        for name, (method, params) in methods.items():
            key = {**cell, "method": name}
            if any(all(row.get(k) == v for k, v in key.items()) for row in self.rows):
                continue
            self.rows.append({**key, **score(method, params)})
            self.file.write_text(json.dumps(self.rows, indent=1))

    def means(self, by: Sequence[str], names: Sequence[str]) -> list[Row]:
        """The rows, averaged over seeds, by the columns that tell them apart."""
        groups: dict[tuple, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(tuple(row[k] for k in by), []).append(row)
        order = sorted(groups, key=lambda key: [_place(value, names) for value in key])
        return [{**dict(zip(by, key, strict=True)), **_mean(groups[key])} for key in order]


def _place(value: Any, names: Sequence[str]) -> Any:
    return (0, names.index(value), "") if value in names else (1, 0, str(value).zfill(9))


def _mean(rows: Sequence[Row]) -> Row:
    """Of every number, weighted by `images`; None where no row has it."""
    means: Row = {}
    for name in rows[0]:
        known = [row for row in rows if isinstance(row.get(name), int | float)]
        if known and not isinstance(rows[0][name], bool):
            weights = [row["images"] for row in known]
            means[name] = float(np.average([row[name] for row in known], weights=weights))
    return means


def images_of(
    method: Any, params: Parameters, given: Recording, times: NDArray[np.int64]
) -> tuple[NDArray, NDArray | None, float]:
    """Images, their variances if the method tells any, and seconds per image."""
    method.estimate(given, params, progress=False)(times[:1], extrapolate=True)  # compiles
    clock = time.perf_counter()
    image, variance, _ = method.estimate(given, params, progress=False)(times, extrapolate=True)
    seconds = (time.perf_counter() - clock) / len(times)
    return image, variance if method.has_covariance else None, seconds


def scored(
    method: Any,
    params: Any,
    given: Recording,
    truth: Frames,
    moving: Sequence[NDArray[np.bool_]] | None = None,
    parts: Mapping[str, NDArray[np.int64]] | None = None,
    noise: float = 0.0,
) -> Row:
    """A row of means over the images at the times of `truth`.

    `moving` is where something moves, for each image; `parts` are rows of images whose error is
    told apart; `noise` is the variance of a pixel of the truth.
    """
    times = frame_times(truth, params)
    image, variance, seconds = images_of(method, params, given, times)
    if variance is not None and noise:
        variance = variance + noise / (truth.intensity + float(params.I0)) ** 2
    scores = [
        hidden_scores(
            image[k],
            None if variance is None else variance[k],
            truth[k : k + 1],
            float(params.I0),
            None if moving is None else moving[k],
        )
        for k in range(len(times))
    ]
    names = ("mse", "ssim", "z2", "z2_median")
    row: Row = {n: float(np.nanmean([s[n] for s in scores])) for n in names if n in scores[0]}
    if moving is not None:
        shares = np.array([s["moving"]["share"] for s in scores])
        errors = np.array([s["moving"]["mse"] for s in scores])
        row["moving_mse"] = float(np.average(errors[shares > 0], weights=shares[shares > 0]))
        row["moving_share"] = float(shares.mean())
    for name, rows in (parts or {}).items():
        row[name] = float(np.mean([scores[k]["mse"] for k in rows]))
    return {**row, "seconds": seconds, "images": len(times)}


def evenly(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))]


def hidden_between(count: int, gap: int) -> NDArray[np.int64]:
    """The frames out of `count` that are hidden and have a given one on either side."""
    frames = np.arange((count - 1) // gap * gap)
    return frames[frames % gap > 0]


def real(
    store: Store,
    recording: Recording,
    methods: Chosen,
    gaps: Iterable[int],
    halves: Mapping[str, int | None],
    moving: bool = False,
) -> None:
    """Score hidden frames of a recording, `halves` of it: 0, 1, or None for the whole."""
    frames = recording.frames
    assert frames is not None
    noise = noise_of(frames)
    cells = [(gap, half) for gap in gaps for half in halves]
    for gap, half in tqdm(cells, desc=store.file.stem, disable=not sys.stderr.isatty()):
        given, hidden = held_out(recording, gap)
        rows = hidden_between(len(frames), gap)
        if halves[half] is not None:
            rows = rows[(rows >= len(frames) // 2) == bool(halves[half])]
        rows = evenly(rows, IMAGES[gap])
        places = np.searchsorted(hidden.t, frames.t[rows])
        where = [moves(given, int(place), gap) for place in places] if moving else None
        score = _scorer(given, hidden[places], where, noise=noise)
        store.add({"gap": gap, "half": half}, methods, score)


def _scorer(
    given: Recording,
    truth: Frames,
    moving: Sequence[NDArray[np.bool_]] | None = None,
    parts: Mapping[str, NDArray[np.int64]] | None = None,
    noise: float = 0.0,
) -> Callable[..., Row]:
    return lambda method, params: scored(method, params, given, truth, moving, parts, noise)


def sensor(rate: float, exposure: float = 5e-3, samples: int = 8) -> Any:
    """A DAVIS whose frames are linear, as those of a DAVIS are."""
    return dataclasses.replace(
        SENSORS["davis"],
        frame_rate=rate,
        exposure=exposure,
        exposure_samples=samples,
        response=UnknownResponse(),
    )


def recorded(file: Path, source: IntensitySource, camera: Any, seed: int) -> Recording:
    """The recording of a source, kept in a file."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        jaxevent.save(simulate(source, camera, seed, file.stem), file)
    return jaxevent.load(file)


def objects_at(folder: Path, rate: float, seed: int) -> tuple[MovingObjects, Recording]:
    source = MovingObjects(seed=seed)
    file = folder / "recordings" / f"objects_{rate:g}Hz_{seed}.h5"
    return source, recorded(file, source, sensor(rate), seed)


def fitted_to_objects(folder: Path) -> Path:
    """The folder of a fit to objects of the seeds for choosing, with few frames.

    One sensor is simulated; its parameters do not depend on how many frames it takes.
    """
    out, rate = folder / "fitted_to_objects", RATES[0]
    if not (out / "params.toml").exists():
        names = []
        for seed in CHOOSING:
            objects_at(folder, rate, seed)
            names.append(f'"recordings/objects_{rate:g}Hz_{seed}.h5"')
        config = folder / "fit_to_objects.toml"
        config.write_text(FIT.format(recordings=", ".join(names)))
        fit(config, out, resume=(out / "checkpoint").exists(), progress=sys.stderr.isatty())
    return out


def truth_of(source: IntensitySource, times: NDArray[np.int64]) -> Frames:
    """The sharp images of a source at times (us)."""
    images = np.stack([source.intensity(float(t) * 1e-6) for t in times])
    return Frames(times, images.clip(0, 1).astype(np.float32), np.zeros_like(times))


def halfway(recording: Recording, count: int) -> NDArray[np.int64]:
    """Times (us) in the middle between frames, not those of the first tenth of the recording."""
    assert recording.frames is not None
    t = recording.frames.t
    middles = (t[1:] + t[:-1]) // 2
    return evenly(middles[middles >= recording.start + 0.1 * (t[-1] - t[0])], count)


def objects(store: Store, folder: Path, fits: Callable[[Path], Chosen]) -> None:
    """Score images halfway between frames."""
    methods = fits(fitted_to_objects(folder))
    for rate in RATES:
        for seed in tqdm(SCORING, desc=f"objects, {rate:g} Hz", disable=not sys.stderr.isatty()):
            source, recording = objects_at(folder, rate, seed)
            truth = truth_of(source, halfway(recording, 6))
            store.add({"rate": rate, "seed": seed}, methods, _scorer(recording, truth))


def panorama() -> NDArray[np.float64]:
    """A scene whose contrast frames can show."""
    light = scene("mountain", decades=1.0)
    return 0.9 * light / np.quantile(light, 0.9999)


def blur(store: Store, folder: Path, fits: Callable[[Path], Chosen]) -> None:
    """Score images at the middles of long exposures, and halfway between frames."""
    methods = fits(fitted_to_objects(folder))
    for cell, source, recording in tqdm(blurred(folder), disable=not sys.stderr.isatty()):
        t, parts = at_and_between(recording)
        store.add(cell, methods, _scorer(recording, truth_of(source, t), None, parts))


def exposures(store: Store, folder: Path) -> None:
    """Score `mc` on the same images, with and without exposures integrated along trajectories."""
    mc = jaxevent.METHODS["mc"]
    params = mc.Params.of({"c_on": 0.2, "c_off": 0.18, "I0": 0.1, "rho_ref": 5e-4})
    both = {"mc": (mc, params), "mc, per pixel": (mc, params.replace(integrate=False))}
    for cell, source, recording in tqdm(blurred(folder), disable=not sys.stderr.isatty()):
        t, parts = at_and_between(recording)
        store.add(cell, both, _scorer(recording, truth_of(source, t), None, parts))


def blurred(
    folder: Path,
    blurs: tuple[tuple[float, ...], tuple[float, ...]] = BLURS,
    label: str = "",
    **other: Any,
) -> Iterator[tuple[Row, IntensitySource, Recording]]:
    """Recordings of long exposures, with what tells them apart: exposures (s), speeds (px/s).

    The label is of the sensor's `other` settings, in the names of files.
    """
    light, seed = panorama(), SCORING[0]
    for kind, exposure, speed in itertools.product(("pan", "objects"), *blurs):
        rate = min(25.0, 0.8 / exposure)
        camera = sensor(rate, exposure, max(8, round(2 * exposure * speed)))
        camera = dataclasses.replace(camera, **other)
        size, duration = (160, 120), 7 / rate + exposure
        source: IntensitySource = (
            MovingObjects(size, duration, speed, seed=seed)
            if kind == "objects"
            else Pan(light, size, duration, speed, seed)
        )
        name = f"{kind}_{1e3 * exposure:g}ms_{speed:g}px{label}.h5"
        recording = recorded(folder / "recordings" / name, source, camera, seed)
        yield {"scene": kind, "exposure_ms": 1e3 * exposure, "speed": speed}, source, recording


def at_and_between(recording: Recording) -> tuple[NDArray[np.int64], dict[str, NDArray]]:
    """The middles of three exposures and three times halfway, and which are which."""
    assert recording.frames is not None
    t = np.sort(np.concatenate([recording.frames.t[2:5], halfway(recording, 3)]))
    at = np.isin(t, recording.frames.t)
    return t, {"at_frames": np.flatnonzero(at), "between": np.flatnonzero(~at)}


def flow_errors(
    found: NDArray, true: NDArray, where: NDArray[np.bool_] | None = None
) -> tuple[float, float]:
    """Mean end-point error in px, and per cent of pixels where it is above `FAR`."""
    error = np.linalg.norm(found - true, axis=-1)
    error = error if where is None else error[where]
    return float(np.nanmean(error)), float(100 * np.mean(~(error <= FAR)))


def dense_flow(store: Store, folder: Path, fits: Callable[[Path], Chosen]) -> None:
    """Score flows, in px per frame: halfway between frames, and from each to the next."""
    methods = fits(fitted_to_objects(folder))
    methods = {n: (m, p) for n, (m, p) in methods.items() if n in ("flow", "mc")}
    for rate in RATES:
        for seed in tqdm(SCORING, desc=f"flow, {rate:g} Hz", disable=not sys.stderr.isatty()):
            source, recording = objects_at(folder, rate, seed)
            score = _flow_scorer(source, recording, halfway(recording, 6), 1 / rate)
            store.add({"rate": rate, "seed": seed}, methods, score)


def _flow_scorer(
    source: MovingObjects, recording: Recording, middles: NDArray[np.int64], step: float
) -> Callable[..., Row]:
    def score(method: Any, params: Any) -> Row:
        late = round(1e6 * float(params.clock_offset))
        video = method.estimate(recording, params, progress=False)
        video(middles[:1] + late)  # compiles
        clock = time.perf_counter()
        now = video.flow(middles + late) * step
        seconds = (time.perf_counter() - clock) / len(middles)
        begins = middles - round(0.5e6 * step)
        ahead = video.flow(begins + late, extrapolate=True) * step
        columns: dict[str, list[float]] = {}
        for k, (middle, begin) in enumerate(zip(middles, begins, strict=True)):
            t, t0 = float(middle) * 1e-6, float(begin) * 1e-6
            moved, hidden = source.displacement(t0, t0 + step)
            for name, pair in (
                ("now", flow_errors(now[k], source.flow(t) * step)),
                ("next", flow_errors(ahead[k], moved, ~hidden)),
                ("all", flow_errors(ahead[k], moved)),
            ):
                for what, value in zip(("epe", "far"), pair, strict=True):
                    columns.setdefault(f"{what}_{name}", []).append(value)
        row: Row = {name: float(np.mean(values)) for name, values in columns.items()}
        return {**row, "seconds": seconds, "images": len(middles)}

    return score


def video(store: Store, recording: Recording, fits: Chosen) -> None:
    """Time evenly spaced images, with the motion of anchors and with every target's own."""
    frames = recording.frames
    assert frames is not None
    for gap, apart in itertools.product((2, 8), (estimator.ANCHOR_STEPS, 1)):
        given, hidden = held_out(recording, gap)
        rows = evenly(hidden_between(len(frames), gap), IMAGES[gap])
        truth = hidden[np.searchsorted(hidden.t, frames.t[rows])]
        smoother = functools.partial(jaxevent.METHODS["aks"].estimate, given, fits["aks"][1])
        score = functools.partial(_paced, smoother=smoother, given=given, truth=truth, apart=apart)
        store.add({"gap": gap, "apart": apart}, {"mc": fits["mc"]}, score)


def _paced(
    method: Any,
    params: Any,
    smoother: Callable[..., Any],
    given: Recording,
    truth: Frames,
    apart: int,
) -> Row:
    kept, estimator.ANCHOR_STEPS = estimator.ANCHOR_STEPS, apart
    times = frame_times(truth, params)
    evenly_spaced = times[len(times) // 2] + np.arange(16) * 10_000

    def seconds(made: Any, wanted: NDArray[np.int64]) -> float:
        """CPU time per image."""
        made(wanted[-1:])  # the smoother has gone through the recording
        clock = time.process_time()
        made(wanted)
        return (time.process_time() - clock) / len(wanted)

    try:
        image = method.estimate(given, params, progress=False)(times).mean
        paces = {"seconds": evenly_spaced, "alone": times[:-1]}
        row: Row = {
            name: seconds(method.estimate(given, params, progress=False), wanted)
            for name, wanted in paces.items()
        }
        row["smoother"] = seconds(smoother(progress=False), evenly_spaced)
    finally:
        estimator.ANCHOR_STEPS = kept
    errors = (np.clip(image, 0, 1) - truth.intensity) ** 2
    return {**row, "mse": float(errors.mean()), "images": len(times)}


IMAGE_COLUMNS = (
    ("MSE x 1e-2", "mse", 100, 4),
    ("SSIM", "ssim", 1, 3),
    ("z2", "z2", 1, 2),
    ("s", "seconds", 1, 3),
)
FLOW_COLUMNS = tuple(
    (f"{title}{ending}", f"{name}_{what}", 1, 2)
    for what, ending in (("now", ", halfway"), ("next", ", to the next"), ("all", ", hidden too"))
    for title, name in (("EPE px", "epe"), (f"% > {FAR:g} px", "far"))
)


def markdown(
    rows: Sequence[Row], keys: Mapping[str, str], columns: Iterable[tuple[str, str, int, int]]
) -> str:
    """A Markdown table."""
    columns = list(columns)
    head = [*keys.values(), *(title for title, *_ in columns)]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(keys) + "---:|" * len(columns)]
    for row in rows:
        cells = [f"{row[k]:g}" if isinstance(row[k], float) else str(row[k]) for k in keys]
        for _, name, factor, digits in columns:
            value = row.get(name)
            if value is None or not np.isfinite(value):
                cells.append("-")
            else:
                cells.append(f"{factor * value:.{digits}f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    tables = ("slider", "street", "objects", "blur", "exposures", "flow", "video")
    parser.add_argument("--params", type=Path, help="folder of a fit to slider_depth")
    parser.add_argument("--street-params", type=Path, help="of one to davis346_street; or the same")
    parser.add_argument("--mc-params", type=Path, help="file or folder with the parameters of mc")
    parser.add_argument("--mc-label", default="mc", help="their label; default: %(default)s")
    parser.add_argument("--methods", nargs="+", default=METHODS, metavar="NAME")
    parser.add_argument("--tables", nargs="+", default=tables, choices=tables)
    parser.add_argument("--out", type=Path, required=True, help="folder for everything made")
    arguments = parser.parse_args()
    if arguments.params is None and {"slider", "street", "video"} & set(arguments.tables):
        parser.error("the tables slider, street and video need --params")
    out = arguments.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    names, compensated = arguments.methods, Compensated(arguments.mc_params, arguments.mc_label)

    def fits(folder: Path) -> Chosen:
        return chosen(names, folder, compensated)

    for title, text in _tables(arguments, out, fits):
        (out / f"{title}.md").write_text(text)
        print(f"{title}\n\n{text}", flush=True)


def _tables(
    arguments: argparse.Namespace, out: Path, fits: Callable[[Path], Chosen]
) -> Iterator[tuple[str, str]]:
    names, wanted = tuple(arguments.methods), arguments.tables
    data = Path(os.environ.get("JAXEVENT_DATA", ".")) / "data"
    if "slider" in wanted:
        store = Store(out / "slider.json")
        recording = jaxevent.load(data / "slider_depth.zip")
        halves = {"1st": 0, "2nd": 1}
        real(store, recording, fits(arguments.params), IMAGES, halves)
        keys = {"gap": "gap", "half": "half", "method": "method"}
        yield "slider", markdown(store.means(list(keys), names), keys, IMAGE_COLUMNS)
    if "street" in wanted:
        store = Store(out / "street.json")
        recording = jaxevent.load(data / "davis346_street.npz")
        folder = arguments.street_params or arguments.params
        real(store, recording, fits(folder), (2, 4, 8), {"all": None}, moving=True)
        keys = {"gap": "gap", "method": "method"}
        more = (("moving MSE x 1e-2", "moving_mse", 100, 4), ("share", "moving_share", 1, 4))
        rows = store.means(list(keys), names)
        yield "street", markdown(rows, keys, (*IMAGE_COLUMNS, *more))
    keys = {"rate": "frames (Hz)", "method": "method"}
    if "objects" in wanted:
        store = Store(out / "objects.json")
        objects(store, out, fits)
        yield "objects", markdown(store.means(list(keys), names), keys, IMAGE_COLUMNS)
    for name in ("blur", "exposures"):
        if name not in wanted:
            continue
        store = Store(out / f"{name}.json")
        if name == "blur":
            blur(store, out, fits)
        else:
            exposures(store, out)
        parts = (("at frames", "at_frames", 100, 4), ("between", "between", 100, 4))
        how = {
            "scene": "scene", "exposure_ms": "exposure (ms)", "speed": "px/s", "method": "method",
        }  # fmt: skip
        rows = store.means(list(how), names)
        yield name, markdown(rows, how, (*IMAGE_COLUMNS, *parts))
    if "flow" in wanted:
        store = Store(out / "flow.json")
        dense_flow(store, out, fits)
        columns = (*FLOW_COLUMNS, ("s", "seconds", 1, 3))
        yield "flow", markdown(store.means(list(keys), names), keys, columns)
    if "video" in wanted and "mc" in names:
        store = Store(out / "video.json")
        video(store, jaxevent.load(data / "slider_depth.zip"), fits(arguments.params))
        columns = (
            ("MSE x 1e-2", "mse", 100, 4), ("s", "seconds", 1, 3), ("s, far apart", "alone", 1, 3),
            ("s, smoother", "smoother", 1, 4),
        )  # fmt: skip
        keys = {"gap": "gap", "apart": "steps between anchors"}
        yield "video", markdown(store.means(list(keys), names), keys, columns)


if __name__ == "__main__":
    main()
