"""The command `jaxevent motion`."""

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.errors import InputError

CLOUD = 64  # particles of an estimate that are kept for the plot


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Estimate how the camera moved. It writes a folder of tables (motion.csv, motion.h5), "
        "plots and an image of the events before and after they are moved back along the motion, "
        "and with --truth the errors. The camera's axes are x to the right, y down, z forward.",
        "slider_depth.zip --model planar --truth --out slider",
        "spin.h5 --model rotation --truth spin.csv --flow --out spin",
        "drone.h5 --model general --gyro --start 2 --stop 3 --out drone",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording; frames are not needed")
    one.add_argument(
        "--model",
        metavar="MODEL",
        required=True,
        help="planar: image velocity vx, vy (px/s); rotation: angular velocity wx, wy, wz (rad/s); "
        "general: heading tx, ty, tz, a unit vector, and angular velocity; or one of your own, "
        "package.module:Class",
    )
    one.add_argument(
        "--method",
        metavar="NAME",
        help="voting, batch, contrast, planes or frames, or one of your own, "
        "package.module:object; default: voting, for general motion batch",
    )
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file of name = value lines, e.g. particles = 400, or params.toml of a fit",
    )
    one.add_argument("--seed", metavar="N", type=int, default=0, help="of all that is random")
    one.add_argument(
        "--truth",
        metavar="CSV",
        type=arguments.path_or_auto,
        nargs="?",
        const="auto",
        help="compare with a table with columns as in motion.csv, or without a name with the "
        "recording's poses or else its gyro",
    )
    one.add_argument(
        "--gyro",
        action="store_true",
        help="let the recording's gyro help, with batch",
    )
    one.add_argument(
        "--still",
        metavar="S,S",
        type=arguments.span,
        help="from when to when the camera is still: what its gyro shows then is its bias",
    )
    one.add_argument(
        "--rate", metavar="HZ", type=float, default=1000.0, help="rows per second; default: 1000"
    )
    one.add_argument(
        "--centred",
        action="store_true",
        help="take every estimate for the time that what it saw shows, some ms earlier",
    )
    one.add_argument(
        "--smooth", action="store_true", help="use the events that come later too, with voting"
    )
    one.add_argument("--start", metavar="S", type=float, help="on the recording's clock")
    one.add_argument("--stop", metavar="S", type=float, help="its end")
    one.add_argument(
        "--flow", action="store_true", help="write the optical flow of each event too: flow.h5"
    )
    one.add_argument(
        "--focal",
        metavar="PX",
        type=float,
        help="focal length, for a recording without calibration; the centre is the sensor's",
    )
    arguments.add_size(one)
    arguments.add_output(one, "--out", metavar="DIR", required=True, help="folder to write")


def run(
    path: Path,
    model: str,
    method: str | None,
    params: Path | None,
    seed: int,
    truth: Path | str | None,
    gyro: bool,
    still: tuple[float, float] | None,
    rate: float | int,
    centred: bool,
    smooth: bool,
    start: float | int | None,
    stop: float | int | None,
    flow: bool,
    focal: float | int | None,
    size: tuple[int, int] | None,
    out: Path,
) -> None:
    import json

    from jaxevent.camera import PinholeCamera
    from jaxevent.egomotion import MODELS, find_model, from_gyro, gyro_bias
    from jaxevent.io import load
    from jaxevent.methods import names
    from jaxevent.runs.egomotion import find_estimator
    from jaxevent.show.motion import Output

    kind = find_model(model)
    estimator = find_estimator(method or kind.method)
    estimator.find_model(kind)
    values = (
        estimator.start(kind) if params is None else estimator.Params.load(params, estimator.name)
    )
    if seed < 0:
        raise InputError(f"--seed {seed} is not possible; give a whole number from 0")
    for option, used in (("gyro", gyro), ("smooth", smooth)):
        if used and option not in estimator.options:
            others = [name for name in names("egomotion") if option in find_estimator(name).options]
            raise InputError(
                f"--{option} is not for the method {estimator.name}; leave it out or use "
                f"{' or '.join(others)}"
            )
    output = Output(out, rate, truth, centred, flow)
    recording = load(path, size, in_memory=False, progress=show_progress())
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if not len(recording.events):
        raise InputError(f"{path}: holds no events; choose another recording")
    if focal is not None:
        if not 0 < focal < math.inf:
            raise InputError(f"--focal {focal:g} is not possible; give pixels above 0")
        if recording.camera is not None:
            raise InputError(f"{path}: has a calibration; leave out --focal")
        centre = (recording.width - 1) / 2, (recording.height - 1) / 2
        recording = dataclasses.replace(recording, camera=PinholeCamera(focal, focal, *centre))
    if kind.needs_camera and recording.camera is None:
        others = [name for name, one in MODELS.items() if not one.needs_camera]
        raise InputError(
            f"{path}: has no calibration, which {kind.title} needs; give --focal or choose "
            f"--model {' or '.join(others)}"
        )
    imu = recording.imu
    if imu is None and (gyro or still is not None):
        raise InputError(
            f"{path}: holds no IMU; leave out {'--gyro' if gyro else '--still'} or choose another "
            "recording"
        )
    bias = None if imu is None or still is None else gyro_bias(imu, *still)
    true = output.known(recording, kind, bias)
    settings: dict[str, Any] = {"cloud": CLOUD} if "cloud" in estimator.options else {}
    if smooth:
        settings["smooth"] = True
    if imu is not None and gyro:
        settings["gyro"] = from_gyro(imu) if bias is None else from_gyro(imu, bias)
    if start is not None or stop is not None:
        poses, measured = recording.poses, recording.imu
        recording = dataclasses.replace(recording[start:stop], poses=poses, imu=measured)
        if not len(recording.events):
            raise InputError(f"{path}: holds no events from --start to --stop; choose other times")
    clock = time.perf_counter()
    told = estimator.estimate(
        recording, values, model=kind, seed=seed, progress=show_progress(), **settings
    )
    seconds = time.perf_counter() - clock
    about = {"method": estimator.name, "parameters": json.dumps(values.values()), "seed": seed}
    about |= {"smooth": smooth, "gyro": gyro, "centred": centred}
    written = output.write(recording, told, about, true, show_progress())
    print("\n".join([f"{kind.title} by {estimator.name}:", *written.summary()]))
    count = len(recording.events)
    print(
        f"\n{', '.join(written.files)} in {out}: {count:,} events in {seconds:.2f} s, "
        f"{count / seconds:,.0f} events/s"
    )
