"""Methods on simulated HDR scenes: fitted on two of them, tested on four others; makes the table.

    python experiments/ahdr.py --out ahdr

Simulates the recordings (an S-shaped response that crops, mismatched thresholds, dead time, noise,
hot pixels; a slow and a fast pan of each scene), fits every tunable method by
configs/fit_ahdr.toml, gives the smoother's numbers to mc, and scores all on the test scenes against
the true HDR images. Errors are geometric means over test recordings; after +- is the standard
deviation over the seeds of such a mean, in per cent. Done parts are kept in the folder and not
repeated. With --methods only those are fitted and scored, and nothing is fitted where none is
tunable. A fit that the folder holds is kept; one that lacks a method is refused. The tables are
those of all recordings, of slow and of fast ones, and the calibration of each scene. Where
ColorVideoVDP is installed (pip install '.[hdr]'), they have its quality Q too, of every sixth
image. "Outside" are pixels brighter or darker than frames see; "levels" is the part of their log
MSE that the right mean of each connected region would take away. With --known the simulated
sensor's own numbers take the place of fitted ones.
"""

import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import scipy.ndimage
from common import command_line, markdown_table
from tqdm import tqdm

import jaxevent
from jaxevent.io import toml
from jaxevent.metrics import LOG_OFFSET
from jaxevent.parameters import read_toml
from jaxevent.runs.fit import fit
from jaxevent.runs.protocols import PROTOCOLS, Reference, frame_times
from jaxevent.runs.scores import score
from jaxevent.simulate import FITTING_SCENES, SENSORS, TESTING_SCENES, Pan, scene, simulate
from jaxevent.simulate.scenes import Speed

CONFIG = Path(__file__).parents[1] / "configs" / "fit_ahdr.toml"
SECONDS: dict[Speed, float] = {"slow": 1.0, "fast": 0.5}
LABELS = (
    "last-frame", "blend", "flow", "edi", "augmented", "cf", "cf-augmented",
    "akf, the paper's constants", "akf", "aks", "mc",
)  # fmt: skip


def record(folder: Path, scenes: tuple[str, ...], seeds: range, sensor: str) -> list[Path]:
    """Simulate each scene, slow and fast, once per seed."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    jobs: list[tuple[str, Speed, int]] = [
        (name, speed, seed) for seed in seeds for name in scenes for speed in SECONDS
    ]
    for name, speed, seed in tqdm(jobs, desc=f"simulating for {folder.name}"):
        path = folder / f"{name}_{speed}_{seed}.h5"
        paths.append(path)
        if not path.exists():
            source = Pan(scene(name), speed=speed, duration=SECONDS[speed], seed=seed)
            jaxevent.save(simulate(source, SENSORS[sensor], seed, path.stem), path)
    return paths


def quality(recording: jaxevent.Recording, method, params) -> float | None:
    """Return the mean quality of images in JOD, 10 at best; None without ColorVideoVDP."""
    if importlib.util.find_spec("pycvvdp") is None:
        return None
    given, reference = PROTOCOLS["reference"](recording)
    assert isinstance(reference, Reference)
    rows = np.arange(0, len(reference), 6)
    images, _, _ = method.estimate(given, params)(frame_times(reference, params)[rows])
    truth = np.stack([reference.truth(int(row)) for row in rows])
    return float(np.mean(jaxevent.metrics.hdr_quality(images, truth)))


def log_errors_outside(recording: jaxevent.Recording) -> list:
    """Return metrics of pixels brighter or darker than frames see.

    One is their part of the log MSE, the other the part of that which would be gone if each
    connected region had the right mean.
    """
    low, high = recording.extra["clip"]

    def outside(image, truth):
        error = np.log(np.maximum(image, 0) + LOG_OFFSET) - np.log(truth + LOG_OFFSET)
        return np.where((truth < low) | (truth > high), error, 0)

    def outside_range(image, truth) -> float:
        return float(np.mean(outside(image, truth) ** 2))

    def levels_outside(image, truth) -> float:
        error, total = outside(image, truth), 0.0
        for mask in (truth < low, truth > high):
            region, count = scipy.ndimage.label(mask)
            sums = np.bincount(region.ravel(), error.ravel(), count + 1)[1:]
            total += (sums**2 / np.bincount(region.ravel(), minlength=count + 1)[1:]).sum()
        return float(total / truth.size)

    return [outside_range, levels_outside]


def choose(labels: list[str], fitted: Path) -> list[tuple]:
    """Return labels, methods and their parameters, fitted ones where there are any.

    mc is not fitted: it has the smoother's numbers. A method whose extra is missing is left out.
    """
    known = read_toml(fitted) if fitted.exists() else {}
    methods = []
    for label in labels:
        name = label.partition(",")[0]
        if name == "flow" and importlib.util.find_spec("cv2") is None:
            print("flow is left out: it needs pip install '.[vision]'", file=sys.stderr)
            continue
        method = jaxevent.METHODS[name]
        params = method.Params.load(fitted, label) if label in known else method.Params()
        if name == "mc":
            shared = jaxevent.aks.Params.load(fitted, "aks").values()
            shared = {k: v for k, v in shared.items() if k in method.Params.settings()}
            params = method.Params(preset="hdr").replace(**shared)
        methods.append((label, method, params))
    return methods


def numbers_of_sensor(recording: jaxevent.Recording) -> dict[str, float]:
    """Return what the simulated sensor has in the place of fitted thresholds, clock and so on."""
    names = {"I0": "dark_offset", "rho_ref": "refractory"}
    wanted = ("c_on", "c_off", "clock_offset", *names)
    return {name: float(recording.extra[names.get(name, name)]) for name in wanted}


def rows_of(paths: list[Path], methods: list[tuple], out: Path, known: bool) -> list[dict]:
    """Score methods on the recordings; rows are kept in a file."""
    rows = json.loads(out.read_text()) if out.exists() else []
    done = {(row["method"], row["recording"]) for row in rows}
    for path in tqdm(paths, desc="scoring"):
        recording = jaxevent.load(path)
        metrics = log_errors_outside(recording)
        for label, method, params in methods:
            if (label, recording.name) in done:
                continue
            if known:
                own = numbers_of_sensor(recording)
                params = params.replace(**{k: own[k] for k in params.settings() if k in own})
            row = score(recording, method, params, "reference", metrics=metrics)
            del row["per_frame"]
            row["Q"] = quality(recording, method, params)
            rows.append({**row, "method": label, "seed": int(path.stem.rpartition("_")[2])})
            out.write_text(json.dumps(rows, indent=1))
    return rows


MEASURES = {
    "MSE": lambda row: row["mse"],
    "log MSE": lambda row: row["log_mse"],
    "SSIM of log": lambda row: row["log_ssim"],
    "bright MSE": lambda row: row["regions"]["bright"]["mse"],
    "dark log MSE": lambda row: row["regions"]["dark"]["log_mse"],
    "well-exposed MSE": lambda row: row["regions"]["well"]["mse"],
}


def summary(rows: list[dict], measure) -> tuple[float, float]:
    """Geometric mean over recordings, and the relative spread of it over seeds."""
    seeds = sorted({row["seed"] for row in rows})
    means = [
        np.exp(np.mean([np.log(measure(row)) for row in rows if row["seed"] == seed]))
        for seed in seeds
    ]
    mean = float(np.exp(np.mean(np.log(means))))
    return mean, float(np.std(means, ddof=1) / mean) if len(means) > 1 else 0.0


def table(rows: list[dict]) -> str:
    labels = list(dict.fromkeys(row["method"] for row in rows))
    lines = []
    for label in labels:
        mine = [row for row in rows if row["method"] == label]
        cells = [
            f"{m:.3g} +- {100 * s:.0f} %" for m, s in (summary(mine, f) for f in MEASURES.values())
        ]
        lines.append([label, *cells])
    quality_lines = []
    for label in labels:
        mine = [row for row in rows if row["method"] == label]
        seen = [row["Q"] for row in mine]
        Q = "-" if None in seen else f"{np.mean(seen):.2f}"
        outside, levels = (
            float(np.mean([row[name] for row in mine]))
            for name in ("outside_range", "levels_outside")
        )
        whole = float(np.mean([row["log_mse"] for row in mine]))
        shares = f"{100 * outside / whole:.0f}, {100 * levels / outside:.0f}"
        quality_lines.append([label, calibration(mine), shares, Q])
    tables = (
        markdown_table(["method", *MEASURES], lines),
        markdown_table(
            ["method", "z2 bright, dark, well", "% of log MSE outside, of that levels", "Q"],
            quality_lines,
            3,
        ),
    )
    return "\n\n".join(tables) + "\n"


def calibration(rows: list[dict]) -> str:
    """z2 of bright, dark and well-exposed pixels."""
    if rows[0].get("z2") is None:
        return "-"
    parts = [[row["regions"][part] for row in rows] for part in ("bright", "dark", "well")]
    means = [
        np.average([r["z2"] for r in part], weights=[r["share"] for r in part]) for part in parts
    ]
    return ", ".join(f"{value:.2g}" for value in means)


def scenes_apart(rows: list[dict]) -> str:
    """Return the table of z2, scene by scene."""
    labels = dict.fromkeys(row["method"] for row in rows)
    lines = []
    for label in labels:
        mine = [row for row in rows if row["method"] == label and row.get("z2") is not None]
        own = {n: [r for r in mine if r["recording"].startswith(f"{n}_")] for n in TESTING_SCENES}
        if mine:
            lines.append([label, *map(calibration, own.values())])
    return markdown_table(["z2 bright, dark, well", *TESTING_SCENES], lines) + "\n"


def main() -> None:
    parser = command_line(__doc__, out=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sensor", choices=list(SENSORS), default="davis")
    parser.add_argument("--methods", nargs="+", choices=LABELS, default=LABELS, metavar="LABEL")
    parser.add_argument("--known", action="store_true", help="thresholds etc. of the sensor itself")
    arguments = parser.parse_args()
    out = arguments.out.absolute()
    fitted = out / "fitted"
    file = fitted / "params.toml"
    wanted = {*arguments.methods, *({"aks"} if "mc" in arguments.methods else ())}
    plan = read_toml(CONFIG)
    plan["method"] = [m for m in plan["method"] if m.get("label", m["name"]) in wanted]
    tunable = [m.get("label", m["name"]) for m in plan["method"]]
    known = read_toml(file) if file.exists() else tunable
    if missing := [label for label in tunable if label not in known]:
        parser.error(
            f"{file} has no parameters of {'; '.join(missing)}: give another --out, or remove "
            f"{fitted}, so that all are fitted"
        )
    paths = record(out / "test", TESTING_SCENES, range(2, 2 + arguments.seeds), arguments.sensor)
    if plan["method"] and not file.exists():
        record(out / "fit", FITTING_SCENES, range(1), arguments.sensor)
        record(out / "validation", FITTING_SCENES, range(1, 2), arguments.sensor)
        os.environ["AHDR"] = str(out)
        config = out / "fit.toml"
        config.write_text(toml.dump(plan))
        fit(config, fitted, resume=(fitted / "checkpoint").exists(), progress=sys.stderr.isatty())
    methods = choose(arguments.methods, file)
    rows = rows_of(paths, methods, out / "scores.json", arguments.known)
    text = table(rows)
    for speed in SECONDS:
        own = [row for row in rows if f"_{speed}_" in row["recording"]]
        text += f"\n{speed}\n\n{table(own)}"
    text += f"\n{scenes_apart(rows)}"
    (out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
