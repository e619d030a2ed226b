"""The AKF's noises fitted to HDR references, and scored on scenes that no fit has seen.

    python experiments/ahdr_noises.py --out noises

Six simulated scenes, each panned slowly and fast before a sensor that shows some of them beside
each other, 32x32 pixels each. Each pair of scenes is held out in turn; configs/fit_noises.toml is
fitted to the next pair, on two paths each, and to the other four scenes. Errors are log MSEs, means
over the folds: of what was fitted to, and of the scenes held out, after +- the standard deviation
over the seeds of their paths, in per cent; and path by path as parts of the error with thresholds
alone, the least, the mean and the largest. Fits that are done are kept in the folder.
"""

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent.runs.fit import fit
from jaxevent.runs.scores import score
from jaxevent.simulate import SENSORS, Pan, scene, simulate

CONFIG = Path(__file__).parents[1] / "configs" / "fit_noises.toml"
PAIRS = (("room", "forest"), ("mountain", "lake"), ("night", "tunnel"))
SIZE, SECONDS = (32, 32), 0.7
NOISES = ("sigma_proc", "sigma_iso", "sigma_ref", "rho_width")
PRESET, BASE = "preset hdr, nothing fitted", "thresholds"


@dataclasses.dataclass(frozen=True)
class Beside:
    """Pans of one length and height beside each other: an `IntensitySource`."""

    pans: Sequence[Pan]
    size: tuple[int, int]
    duration: float

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        return np.hstack([pan.intensity(t) for pan in self.pans])


def record(path: Path, paths: Sequence[tuple[str, int]]) -> None:
    """Simulate scenes on the paths of some seeds, each slow and fast."""
    pans = [
        Pan(scene(name), SIZE, SECONDS, speed, seed)
        for name, seed in paths
        for speed in ("slow", "fast")
    ]
    source = Beside(pans, (len(pans) * SIZE[0], SIZE[1]), SECONDS)
    seed = paths[0][1]
    path.parent.mkdir(parents=True, exist_ok=True)
    jaxevent.save(simulate(source, SENSORS["davis"], seed, path.stem), path)


def fitted(out: Path, held: int, number: int, seeds: int) -> dict[str, list[dict]]:
    """Rows of the scores, and what was found, with one pair held out."""
    scenes = [name for pair in (*PAIRS[held + 1 :], *PAIRS[:held]) for name in pair]
    paths = [(name, seed) for name in scenes[:number] for seed in range(4 // number)]
    folder = out / f"{number}_scenes_fold_{held}"
    recordings = {folder / "fit" / "scenes.h5": paths}
    for seed in range(2, 2 + seeds):
        recordings[folder / "test" / f"seed_{seed}.h5"] = [(name, seed) for name in PAIRS[held]]
    for path, wanted in recordings.items():
        if not path.exists():
            record(path, wanted)
    results = folder / "fitted" / "results.json"
    if not results.exists():
        os.environ["AHDR"] = str(folder)
        resume = (folder / "fitted" / "checkpoint").exists()
        fit(CONFIG, folder / "fitted", resume=resume, progress=sys.stderr.isatty())
    told = json.loads(results.read_text())
    preset = jaxevent.akf.Params(preset="hdr", rho_ref=0.0005)
    for path in recordings:
        row = score(jaxevent.load(path), jaxevent.akf, preset, "reference", progress=False)
        told["rows"].append(
            {**row, "recording": str(path), "split": path.parent.name, "method": PRESET}
        )
    return told


def mean(rows: Sequence[dict]) -> float:
    """Geometric, of the log MSE."""
    return float(np.exp(np.mean([np.log(row["log_mse"]) for row in rows])))


def table(runs: Sequence[dict[str, list[dict]]]) -> str:
    """A line for each method, over the pairs held out."""
    rows = [row for run in runs for row in run["rows"]]
    found = [one for run in runs for one in run["found"]]
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        used, held = ([row for row in mine if row["split"] == s] for s in ("fit", "test"))
        names = sorted({Path(row["recording"]).name for row in held})
        means = [mean([r for r in held if Path(r["recording"]).name == name]) for name in names]
        spread = 100 * np.std(means, ddof=1) / np.mean(means) if len(means) > 1 else 0.0
        cells = [f"{mean(used):.3g}", f"{mean(held):.3g} ± {spread:.0f}"]
        alone = {row["recording"]: row["log_mse"] for row in rows if row["method"] == BASE}
        ratios = [row["log_mse"] / alone[row["recording"]] for row in held]
        middle = np.exp(np.mean(np.log(ratios)))
        cells.append(f"{min(ratios):.2f}, {middle:.2f}, {max(ratios):.2f}")
        for name in NOISES:
            values = [o["found"] for o in found if (o["method"], o["parameter"]) == (method, name)]
            cells.append(f"{min(values):.2g} to {max(values):.2g}" if values else "")
        lines.append(f"| {method} | {' | '.join(cells)} |\n")
    return "".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for everything made")
    parser.add_argument("--seeds", type=int, default=3, help="paths of each scene held out")
    parser.add_argument("--scenes", type=int, nargs="+", default=(2, 4), help="to fit to: 2, 4")
    arguments = parser.parse_args()
    out, text = arguments.out.absolute(), ""
    for number in arguments.scenes:
        runs = [fitted(out, held, number, arguments.seeds) for held in range(len(PAIRS))]
        titles = " | ".join(f"`{name}`" for name in NOISES)
        part = f"| {number} scenes | fitted to | held out | of thresholds' | {titles} |\n"
        part += "|---|" + "---:|" * (3 + len(NOISES)) + "\n" + table(runs)
        print(part, flush=True)
        text += part + "\n"
    (out / "table.md").write_text(text)


if __name__ == "__main__":
    main()
