"""Which model `--model auto` takes of simulated scenes and real recordings.

    python experiments/egomotion_choice.py --out choice [--seeds 700 701 ...] [--data FOLDER]

Simulated scenes are 0.5 s of 240x180 pixels, f = 200 px (`simulate.motion_scene`): rotation, planar
motion, general motion before a wall, shapes and textures, and "far": textures before which the
camera turns and moves by 0.02 m/s, some 2 px in a second, for which rotation is right. With --data
FOLDER the recordings there too, of long ones a second. Constants were chosen on seeds 700 and 702.
Writes choice.csv and prints a row per scene.
"""

import argparse
import dataclasses
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

import jaxevent
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.model_selection import select_model
from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.simulate import motion_scene

SCENES: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "rotation constant": ("rotation", "rotation", "constant", {}),
    "rotation varying": ("rotation", "rotation", "varying", {}),
    "far": ("rotation", "texture", "varying", {"speed": 0.02}),
    "planar": ("planar", "planar", "constant", {"texture": "noise"}),
    "planar shapes": ("planar", "planar", "varying", {"texture": "shapes"}),
    "wall constant": ("general", "wall", "constant", {}),
    "wall varying": ("general", "wall", "varying", {}),
    "shapes": ("general", "shapes", "varying", {}),
    "texture": ("general", "texture", "varying", {}),
}
# What is right, the file, the focal length where it has no calibration, and the cut (s).
REAL: tuple[tuple[str, str, float | None, tuple[float | None, float | None]], ...] = (
    ("general", "slider_depth.zip", None, (0.0, 1.0)),
    ("general", "slider_depth.zip", None, (1.0, 2.0)),
    ("general", "slider_depth.zip", None, (2.0, 3.0)),
    ("general or rotation", "evbench_seq3_calibrated.npz", None, (0.0, 1.2)),
    ("rotation", "rotating_disk_imu.npz", 200.0, (0.5, 1.5)),
    ("rotation", "rotating_disk_imu.npz", 200.0, (1.5, 2.5)),
    ("rotation", "tubrip_boxes_rotation.npz", None, (None, None)),
    ("rotation", "tubrip_shapes_rotation.npz", None, (None, None)),
)


def row(name: str, right: str, recording: Recording, camera: PinholeCamera | None) -> dict:
    clock = time.process_time()
    try:
        found = select_model(recording, camera)
    except InputError as error:
        return {"scene": name, "right": right, "chosen": f"none: {error}"}
    z = {f"z {one}, {other}": value for (one, other), value in found.z.items()}
    seconds = time.process_time() - clock
    model, said = found.model.name, found.lines[-1]
    return {"scene": name, "right": right, "chosen": model, **z, "CPU s": seconds, "said": said}


def recordings(data: Path) -> Iterator[tuple[str, str, Recording, PinholeCamera | None]]:
    for right, file, focal, (start, stop) in REAL:
        whole = jaxevent.load(data / file)
        cut = dataclasses.replace(whole[start:stop], imu=whole.imu)
        middle = (whole.width - 1) / 2, (whole.height - 1) / 2
        camera = None if focal is None else PinholeCamera(focal, focal, *middle)
        name = file if start is None else f"{file} {start:g} to {stop:g} s"
        yield name, right, cut, camera


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the table")
    parser.add_argument("--seeds", type=int, nargs="*", default=[703, 704])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []

    def add(*one: Any) -> None:
        rows.append(row(*one))
        print(rows[-1], flush=True)
        pd.DataFrame(rows).to_csv(arguments.out / "choice.csv", index=False)

    for seed in arguments.seeds:
        for name in arguments.scenes:
            right, scene, motion, more = SCENES[name]
            add(name, right, motion_scene(scene, motion, seed, **more)[0], None)
    for name, right, recording, camera in recordings(arguments.data) if arguments.data else ():
        add(name, right, recording, camera)
    table = pd.DataFrame(rows)
    for scene, part in table.groupby("scene", sort=False):
        right = part["right"].iloc[0]
        count = ", ".join(f"{n} {k}" for k, n in part["chosen"].value_counts().items())
        print(f"| {scene} | {right} | {count} |")
    print(f"{platform.machine()}, Python {platform.python_version()}")


if __name__ == "__main__":
    main()
