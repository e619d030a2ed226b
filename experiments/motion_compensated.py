"""Methods that follow motion against those that do not: hidden frames, moving objects, blur.

    JAXEVENT_DATA=FOLDER python experiments/motion_compensated.py --params fitted --out compared

`fitted` is what `jaxevent fit configs/fit_slider_depth.toml --out fitted` makes. Tables:

    slider   slider_depth, every 2nd, 4th, 8th, 16th frame given; each half of the recording
    street   davis346_street, every 2nd, 4th, 8th; all pixels, and where something moves
    objects  simulated objects, frames at 25 and 100 Hz, halfway between frames
    blur     pans and objects, long exposures: at the frames' middles, and halfway between them
    delay    the same of two seeds, `mc` calibrated, with parts of the delay of events of `aks`

Of hidden frames a few are scored, evenly chosen among those that lie between given ones. Simulated
recordings are those of seeds 101 to 103; the smoother and the filter are fitted to seeds 1 to 3.
The method `mc` is left out where there is none. Rows that the folder holds are not computed again.
Columns are means over images; z2 is the mean squared standardised error of ln(I + I0), 1 for honest
variances, to which that of the hidden frame's own noise is added.
"""

import argparse
import dataclasses
import itertools
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import command_line, markdown_table
from numpy.typing import NDArray
from tqdm import tqdm

import jaxevent
from jaxevent.camera import UnknownResponse
from jaxevent.parameters import Parameters, read_toml
from jaxevent.recording import Frames, Recording
from jaxevent.runs.fit import fit
from jaxevent.runs.protocols import frame_times, held_out
from jaxevent.runs.scores import hidden_scores, moving_pixels
from jaxevent.simulate import SENSORS, IntensitySource, MovingObjects, Pan, scene, simulate

METHODS = ("blend", "flow", "edi", "akf", "aks", "mc")
LIKELIHOOD = "aks, likelihood"  # the label of the smoother in a fit to slider_depth
SHARED = ("c_on", "c_off", "I0", "clock_offset", "rho_ref")  # what every method takes from it
NOISE_BLOCK = 8  # px, over which the noise of frames is averaged
CHOOSING, SCORING = (1, 2, 3), (101, 102, 103)  # seeds
RATES = (25.0, 100.0)  # Hz
IMAGES = {2: 10, 4: 10, 8: 10, 16: 8}  # by gap
BLURS = ((0.02, 0.05, 0.1), (25.0, 100.0, 300.0))  # s; px/s
DELAY_BLURS = ((0.002, 0.02, 0.05), (100.0, 300.0))
DELAY_SEEDS = (11, 101)  # for choosing and for scoring
PARTS = (0.0, 0.5, 1.0)  # of the delay of `aks`

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

Chosen = Mapping[str, tuple[Any, Any]]  # method and parameters by name
Row = dict[str, Any]


def choose_parameters(names: Iterable[str], fitted: Path) -> Chosen:
    """Return methods and their parameters, from a fit's folder.

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
            known = method.Params.settings()
            params = params.replace(**{k: v for k, v in values.items() if k in known})
        else:
            params = method.Params.of({k: values[k] for k in SHARED})
        found[name] = method, params
    return found


class Store:
    """Rows of a table, in a file; a cell of a method is computed once."""

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
        """Return the rows, averaged over seeds, by the columns that tell them apart."""
        groups: dict[tuple, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(tuple(row[k] for k in by), []).append(row)
        order = sorted(groups, key=lambda key: [_place(value, names) for value in key])
        return [{**dict(zip(by, key, strict=True)), **_mean(groups[key])} for key in order]


def _place(value: Any, names: Sequence[str]) -> Any:
    return (0, names.index(value), "") if value in names else (1, 0, str(value).zfill(9))


def _mean(rows: Sequence[Row]) -> Row:
    """Return the mean of every number, weighted by `images`."""
    means: Row = {}
    for name in rows[0]:
        known = [row for row in rows if isinstance(row.get(name), int | float)]
        if known and not isinstance(rows[0][name], bool):
            weights = [row["images"] for row in known]
            means[name] = float(np.average([row[name] for row in known], weights=weights))
    return means


def score_images(
    method: Any,
    params: Any,
    given: Recording,
    truth: Frames,
    moving: Sequence[NDArray[np.bool_]] | None = None,
    parts: Mapping[str, NDArray[np.int64]] | None = None,
    noise: float = 0.0,
) -> Row:
    """Return means over the images at the times of `truth`.

    `moving` is where something moves, for each image; `parts` are rows of images whose error is
    told apart; `noise` is the variance of a pixel of the truth.
    """
    times = frame_times(truth, params)
    image, variance, _ = method.estimate(given, params, progress=False)(times, extrapolate=True)
    if not method.has_covariance:
        variance = None
    elif noise:
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
    return {**row, "images": len(times)}


def noise_of(frames: Frames) -> float:
    """Return the variance of a frame's pixel, as a part of white squared.

    It is half of the squared difference of the two consecutive frames that are most alike; of that
    the median of blocks, as most of them do not move.
    """
    changes = np.diff(frames.intensity.astype(np.float64), axis=0) ** 2 / 2
    count, h, w = changes.shape
    n = NOISE_BLOCK
    h, w = h // n, w // n
    blocks = changes[:, : h * n, : w * n].reshape(count, h, n, w, n).mean((2, 4))
    return float(np.median(blocks.reshape(count, -1), axis=1).min())


def choose_evenly(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))]


def hidden_between(count: int, gap: int) -> NDArray[np.int64]:
    """Return the frames out of `count` that are hidden and have a given one on either side."""
    frames = np.arange((count - 1) // gap * gap)
    return frames[frames % gap > 0]


def score_hidden_frames(
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
        rows = choose_evenly(rows, IMAGES[gap])
        places = np.searchsorted(hidden.t, frames.t[rows])
        where = [moving_pixels(given, int(place), gap) for place in places] if moving else None
        score = _scorer(given, hidden[places], where, noise=noise)
        store.add({"gap": gap, "half": half}, methods, score)


def _scorer(
    given: Recording,
    truth: Frames,
    moving: Sequence[NDArray[np.bool_]] | None = None,
    parts: Mapping[str, NDArray[np.int64]] | None = None,
    noise: float = 0.0,
) -> Callable[..., Row]:
    return lambda method, params: score_images(method, params, given, truth, moving, parts, noise)


def sensor(rate: float, exposure: float = 5e-3, samples: int = 8) -> Any:
    """Return a DAVIS whose frames are linear."""
    return dataclasses.replace(
        SENSORS["davis"],
        frame_rate=rate,
        exposure=exposure,
        exposure_samples=samples,
        response=UnknownResponse(),
    )


def load_or_simulate(file: Path, source: IntensitySource, camera: Any, seed: int) -> Recording:
    """Return the recording of a source, kept in a file."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        jaxevent.save(simulate(source, camera, seed, file.stem), file)
    return jaxevent.load(file)


def objects_at(folder: Path, rate: float, seed: int) -> tuple[MovingObjects, Recording]:
    source = MovingObjects(seed=seed)
    file = folder / "recordings" / f"objects_{rate:g}Hz_{seed}.h5"
    return source, load_or_simulate(file, source, sensor(rate), seed)


def fitted_to_objects(folder: Path) -> Path:
    """Return the folder of a fit to objects of the seeds for choosing, with few frames.

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
    """Return the sharp images of a source at times (us)."""
    images = np.stack([source.intensity(float(t) * 1e-6) for t in times])
    return Frames(times, images.clip(0, 1).astype(np.float32), np.zeros_like(times))


def halfway(recording: Recording, count: int) -> NDArray[np.int64]:
    """Return times (us) in the middle between frames, after the first tenth of the recording."""
    assert recording.frames is not None
    t = recording.frames.t
    middles = (t[1:] + t[:-1]) // 2
    return choose_evenly(middles[middles >= recording.start + 0.1 * (t[-1] - t[0])], count)


def objects(store: Store, folder: Path, fits: Callable[[Path], Chosen]) -> None:
    """Score images halfway between frames."""
    methods = fits(fitted_to_objects(folder))
    for rate in RATES:
        for seed in tqdm(SCORING, desc=f"objects, {rate:g} Hz", disable=not sys.stderr.isatty()):
            source, recording = objects_at(folder, rate, seed)
            truth = truth_of(source, halfway(recording, 6))
            store.add({"rate": rate, "seed": seed}, methods, _scorer(recording, truth))


def make_panorama() -> NDArray[np.float64]:
    """Return a scene whose contrast frames can show."""
    light = scene("mountain", decades=1.0)
    return 0.9 * light / np.quantile(light, 0.9999)


def blur(store: Store, folder: Path, fits: Callable[[Path], Chosen]) -> None:
    """Score images at the middles of long exposures, and halfway between frames."""
    methods = fits(fitted_to_objects(folder))
    for cell, source, recording in tqdm(
        blurred_recordings(folder), disable=not sys.stderr.isatty()
    ):
        t, parts = at_and_between(recording)
        store.add(cell, methods, _scorer(recording, truth_of(source, t), None, parts))


def delay(store: Store, folder: Path) -> None:
    """Score `mc` with parts of the delay of `aks`."""
    mc, aks = jaxevent.METHODS["mc"], jaxevent.aks
    for seed in DELAY_SEEDS:
        for cell, source, recording in blurred_recordings(folder, DELAY_BLURS, seed):
            chosen = mc.Params.for_recording(recording)
            whole = float(aks.Params.for_recording(recording).event_delay)
            t, parts = at_and_between(recording)
            methods = {
                f"{part:g}": (mc, chosen.replace(event_delay=part * whole)) for part in PARTS
            }
            more = {"seed": seed, "delay_ms": 1e3 * whole}
            store.add(
                {**cell, **more}, methods, _scorer(recording, truth_of(source, t), None, parts)
            )


def blurred_recordings(
    folder: Path, blurs: tuple[tuple[float, ...], tuple[float, ...]] = BLURS, seed: int = SCORING[0]
) -> Iterator[tuple[Row, IntensitySource, Recording]]:
    """Iterate over recordings of long exposures, with scene, exposure and speed."""
    light = make_panorama()
    for kind, exposure, speed in itertools.product(("pan", "objects"), *blurs):
        rate = min(25.0, 0.8 / exposure)
        camera = sensor(rate, exposure, max(8, round(2 * exposure * speed)))
        size, duration = (160, 120), 7 / rate + exposure
        source: IntensitySource = (
            MovingObjects(size, duration, speed, seed=seed)
            if kind == "objects"
            else Pan(light, size, duration, speed, seed)
        )
        name = f"{kind}_{1e3 * exposure:g}ms_{speed:g}px{f'_{seed}' * (seed != SCORING[0])}.h5"
        recording = load_or_simulate(folder / "recordings" / name, source, camera, seed)
        yield {"scene": kind, "exposure_ms": 1e3 * exposure, "speed": speed}, source, recording


def at_and_between(recording: Recording) -> tuple[NDArray[np.int64], dict[str, NDArray]]:
    """Return the middles of three exposures and three times halfway, and the rows of each."""
    assert recording.frames is not None
    t = np.sort(np.concatenate([recording.frames.t[2:5], halfway(recording, 3)]))
    at = np.isin(t, recording.frames.t)
    return t, {"at_frames": np.flatnonzero(at), "between": np.flatnonzero(~at)}


IMAGE_COLUMNS = (
    ("MSE x 1e-2", "mse", 100, 4),
    ("SSIM", "ssim", 1, 3),
    ("z2", "z2", 1, 2),
)


def table(
    rows: Sequence[Row], keys: Mapping[str, str], columns: Iterable[tuple[str, str, int, int]]
) -> str:
    """Return a Markdown table of rows.

    Args:
        rows: Rows by column.
        keys: Titles of the columns that tell rows apart.
        columns: Title, name, factor and digits of each column of numbers.
    """
    columns = list(columns)
    lines = []
    for row in rows:
        cells = [f"{row[k]:g}" if isinstance(row[k], float) else str(row[k]) for k in keys]
        for _, name, factor, digits in columns:
            value = row.get(name)
            missing = value is None or not np.isfinite(value)
            cells.append("-" if missing else f"{factor * value:.{digits}f}")
        lines.append(cells)
    return markdown_table([*keys.values(), *(title for title, *_ in columns)], lines, len(keys))


def main() -> None:
    parser = command_line(__doc__, out=True)
    tables = ("slider", "street", "objects", "blur", "delay")
    parser.add_argument("--params", type=Path, help="folder of a fit to slider_depth")
    parser.add_argument("--street-params", type=Path, help="of one to davis346_street; or the same")
    parser.add_argument("--methods", nargs="+", default=METHODS, metavar="NAME")
    parser.add_argument("--tables", nargs="+", default=tables, choices=tables)
    arguments = parser.parse_args()
    if arguments.params is None and {"slider", "street"} & set(arguments.tables):
        parser.error("the tables slider and street need --params")
    out = arguments.out.absolute()

    def fits(folder: Path) -> Chosen:
        return choose_parameters(arguments.methods, folder)

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
        score_hidden_frames(store, recording, fits(arguments.params), IMAGES, halves)
        keys = {"gap": "gap", "half": "half", "method": "method"}
        yield "slider", table(store.means(list(keys), names), keys, IMAGE_COLUMNS)
    if "street" in wanted:
        store = Store(out / "street.json")
        recording = jaxevent.load(data / "davis346_street.npz")
        folder = arguments.street_params or arguments.params
        score_hidden_frames(store, recording, fits(folder), (2, 4, 8), {"all": None}, moving=True)
        keys = {"gap": "gap", "method": "method"}
        more = (("moving MSE x 1e-2", "moving_mse", 100, 4), ("share", "moving_share", 1, 4))
        rows = store.means(list(keys), names)
        yield "street", table(rows, keys, (*IMAGE_COLUMNS, *more))
    keys = {"rate": "frames (Hz)", "method": "method"}
    if "objects" in wanted:
        store = Store(out / "objects.json")
        objects(store, out, fits)
        yield "objects", table(store.means(list(keys), names), keys, IMAGE_COLUMNS)
    if "blur" in wanted:
        store = Store(out / "blur.json")
        blur(store, out, fits)
        parts = (("at frames", "at_frames", 100, 4), ("between", "between", 100, 4))
        how = {
            "scene": "scene", "exposure_ms": "exposure (ms)", "speed": "px/s", "method": "method",
        }  # fmt: skip
        rows = store.means(list(how), names)
        yield "blur", table(rows, how, (*IMAGE_COLUMNS, *parts))
    if "delay" in wanted:
        store = Store(out / "delay.json")
        delay(store, out)
        parts = (("at frames", "at_frames", 100, 4), ("between", "between", 100, 4))
        how = {
            "seed": "seed", "scene": "scene", "exposure_ms": "exposure (ms)", "speed": "px/s",
            "delay_ms": "delay (ms)", "method": "part",
        }  # fmt: skip
        rows = store.means(list(how), names)
        yield "delay", table(rows, how, (IMAGE_COLUMNS[0], *parts))


if __name__ == "__main__":
    main()
