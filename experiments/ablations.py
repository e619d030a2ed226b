"""What each part of the filter is worth on the test scenes of ahdr.py; makes the table.

    python experiments/ablations.py --out ablations

Runs configs/ablations.toml; numbers are geometric means over recordings, as factors of the whole.
In a folder that ahdr.py made the filter is the one that was fitted there. In another one the test
scenes are recorded, one seed, and the filter is `preset = "hdr"` with the sensor's thresholds and
dead time.
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any

import ahdr

import jaxevent
from jaxevent.io import toml
from jaxevent.runs.evaluate import evaluate
from jaxevent.simulate import SENSORS

CONFIG = Path(__file__).parents[1] / "configs" / "ablations.toml"
SHOWN = ("MSE", "log MSE", "bright MSE", "dark log MSE", "well-exposed MSE")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="its folder, or that of ahdr.py")
    out = parser.parse_args().out.absolute()
    os.environ["AHDR"] = str(out)
    if not (out / "fitted" / "params.toml").exists():
        ahdr.record(out / "test", ahdr.TESTING, range(2, 3), "davis")
        sensor = SENSORS["davis"]
        known = {"c_on": sensor.c_on, "c_off": sensor.c_off, "rho_ref": sensor.refractory}
        params = jaxevent.akf.Params.of({"preset": "hdr", **known})
        (out / "fitted").mkdir(exist_ok=True)
        (out / "fitted" / "params.toml").write_text(f"[akf]\n{toml.parameters(params)}\n")
    scored = evaluate(CONFIG, out / "ablations", progress=True)
    rows: list[dict[str, Any]] = [{**row, "seed": 0} for row in scored]
    labels = list(dict.fromkeys(row["method"] for row in rows))

    def means(label: str) -> list[float]:
        mine = [row for row in rows if row["method"] == label]
        return [ahdr.summary(mine, ahdr.MEASURES[name])[0] for name in SHOWN]

    whole = means(labels[0])
    lines = ["| | " + " | ".join(SHOWN) + " |", "|---|" + "---:|" * len(SHOWN)]
    lines.append("| whole | " + " | ".join(f"{value:.3g}" for value in whole) + " |")
    for label in labels[1:]:
        cells = [f"x {one / all:.2f}" for one, all in zip(means(label), whole, strict=True)]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    text = "\n".join(lines) + "\n"
    (out / "ablations.md").write_text(text)
    (out / "ablations.json").write_text(json.dumps({k: means(k) for k in labels}, indent=1))
    print(text)


if __name__ == "__main__":
    main()
