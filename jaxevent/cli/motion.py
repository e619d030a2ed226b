"""The command `jaxevent motion`."""

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.errors import InputError

N_PLOTTED_PARTICLES = 64  # particles of an estimate that are kept for the plot


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Estimate how the camera moved. It writes a folder of tables (motion.csv, motion.h5), "
        "plots and an image of the events before and after they are moved back along the motion, "
        "and with --truth the errors. The camera's axes are x to the right, y down, z forward.",
        "slider_depth.zip --out slider",
        "spin.h5 --model rotation --truth spin.csv --flow --out spin",
        "drone.h5 --model general --imu --start 2 --stop 3 --out drone",
        "- --live --size 240,180 --model rotation --focal 200",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording; frames are not needed")
    one.add_argument(
        "--model",
        metavar="MODEL",
        default="auto",
        help="planar: image velocity vx, vy (px/s); rotation: angular velocity wx, wy, wz (rad/s); "
        "general: heading tx, ty, tz, a unit vector, and angular velocity; auto, the default: the "
        "simplest of these that explains the recording; or one of your own, package.module:Class",
    )
    one.add_argument(
        "--method",
        metavar="NAME",
        help="voting (default, then contrast if it finds nothing), batch (default for general "
        "motion), contrast, planes, frames, or package.module:object of your own",
    )
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file, e.g. of particles = 400, or params.toml of a fit",
    )
    one.add_argument("--seed", metavar="N", type=int, default=0, help="seed of random numbers")
    _add_known(one)
    one.add_argument(
        "--rate", metavar="HZ", type=float, default=1000.0, help="rows per second; default: 1000"
    )
    one.add_argument(
        "--causal",
        action="store_true",
        help="estimate each row of voting from the events before it alone; it lags",
    )
    one.add_argument(
        "--centred",
        action="store_true",
        help="do not smooth, but date each estimate of voting to the middle of its events",
    )
    one.add_argument("--smooth", action="store_true", help="smooth by later events: the default")
    arguments.add_span(one)
    one.add_argument(
        "--flow", action="store_true", help="also write the optical flow of each event: flow.h5"
    )
    one.add_argument(
        "--focal",
        metavar="PX",
        type=float,
        help="focal length in px where there is no calibration, about the sensor's centre; sigmas "
        "of rotations count 5 %% of them for its error",
    )
    arguments.add_live(one, "rows of motion.csv, as with --causal,")
    arguments.add_reading(one)
    arguments.add_output(one, "--out", metavar="DIR", help="folder to write; needed without --live")


def _add_known(one: Any) -> None:
    """Add options for ground truth: a table, poses, the gyro."""
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
        "--depth",
        metavar="M",
        type=float,
        help="depth of the scene in m, with --truth: it converts poses to an image velocity; "
        "default: the depth that fits best",
    )
    one.add_argument(
        "--imu",
        action="store_true",
        help="use the recording's gyro, with --method batch; its bias is taken from --still, "
        "or else estimated",
    )
    one.add_argument(
        "--imu-rotation",
        metavar="AXES",
        help="the gyro's axes: camera (x right, y down, z forward; default), y-up (x right, y up, "
        "z backward), x-left (x left, y down, z backward), turned (x left, y up), or a rotation of "
        "nine numbers from its axes to the camera's",
    )
    one.add_argument(
        "--still",
        metavar="S,S",
        type=arguments.span,
        help="times in s between which the camera is still, for the gyro's bias",
    )


def run(
    *,
    path: Path,
    model: str,
    method: str | None,
    params: Path | None,
    seed: int,
    truth: Path | str | None,
    depth: float | int | None,
    imu: bool,
    imu_rotation: str | None,
    still: tuple[float, float] | None,
    rate: float | int,
    causal: bool,
    centred: bool,
    smooth: bool,
    start: float | int | None,
    stop: float | int | None,
    flow: bool,
    focal: float | int | None,
    live: bool,
    reading: dict[str, Any],
    out: Path | None,
) -> None:
    from jaxevent.egomotion import find_model
    from jaxevent.egomotion.model_selection import select_model
    from jaxevent.egomotion.truth import gyro_bias
    from jaxevent.egomotion.truth import imu_rotation as rotation_of
    from jaxevent.runs.egomotion import find_estimator
    from jaxevent.show.motion import Output

    kind = None if model == "auto" else find_model(model)
    if live:
        given = {
            "--method": method not in (None, "voting"), "--truth": truth is not None, "--imu": imu,
            "--centred": centred, "--smooth": smooth, "--start": start is not None,
            "--stop": stop is not None, "--flow": flow, "--out": out is not None,
        }  # fmt: skip
        arguments.refuse_with_live(given)
        if kind is None:
            raise InputError("--live cannot see all events to choose a model; name it by --model")
        _print_live(path, kind, params, seed, float(rate), focal, reading)
        return
    if out is None:
        raise InputError("there is nowhere to write; give a folder, --out DIR, or --live")
    if kind is not None:
        _check(find_estimator(method or kind.best_method), kind, imu, causal, smooth)
    if causal and (centred or smooth):
        raise InputError("--causal uses no later events; leave out --centred and --smooth")
    arguments.check_seed(seed)
    turned = None if imu_rotation is None else rotation_of(imu_rotation)
    output = Output(out, rate, truth, flow=flow)
    recording = _open(path, reading, focal, "--imu" if imu else "--still" if still else None)
    bias = None
    if recording.imu is not None and still is not None:
        bias = gyro_bias(recording.imu, *still)
    whole, recording = recording, _stretch(recording, start, stop)
    choice = None
    if kind is None:
        choice = select_model(recording)
        print("\n".join(choice.lines))
        kind = choice.model
        if choice.camera is not None:
            recording = dataclasses.replace(recording, camera=choice.camera)
    estimator = find_estimator(method or kind.best_method)
    _check(estimator, kind, imu, causal, smooth)
    _need_camera(recording, kind)
    true = output.known(whole, kind, bias, turned, depth)
    clock = time.perf_counter()
    settings: dict[str, Any] = {"model": kind, "seed": seed, "progress": show_progress()}
    if causal:
        settings["causal"] = True
    elif "smooth" in estimator.options:
        settings["smooth"] = smooth or not centred
    gyro, other = (imu, bias, turned), not (method or params or causal or smooth)
    estimator, told, values = estimated(estimator, recording, params, settings, gyro, other)
    if choice is not None:
        told = choice.include_doubt(told)
    if focal is not None:
        told = told.with_focal_error()
    told, warning = told.with_flow_consistency(recording)
    if warning:
        print(warning)
    seconds = time.perf_counter() - clock
    smoothed = settings.get("smooth", False)
    about = {"seed": seed, "smooth": smoothed, "gyro": imu, "causal": causal}
    made = {"method": estimator.name, "params": values}
    written = output.write(recording, told, about, true, progress=show_progress(), **made)
    hint = _truth_there(whole, kind) if truth is None else []
    print("\n".join([f"{kind.title} by {estimator.name}:", *written.summary(), *hint]))
    count = len(recording.events)
    print(
        f"\n{', '.join(written.files)} in {out}: {count:,} events in "
        f"{arguments.describe_speed(count, seconds)}"
    )


def _open(
    path: Path, reading: dict[str, Any], focal: float | int | None, imu_option: str | None
) -> Any:
    """Open a recording that holds events, and an IMU where an option needs one."""
    recording = arguments.open_recording(path, reading)
    recording = _with_camera(dataclasses.replace(recording, name=str(path)), focal)
    if not len(recording.events):
        raise InputError(f"{path}: holds no events; choose another recording")
    if recording.imu is None and imu_option is not None:
        raise InputError(
            f"{path}: holds no IMU{recording.describe_left_out('imu')}; leave out {imu_option} or "
            "choose another recording"
        )
    return recording


def _print_live(
    path: Path,
    kind: Any,
    params: Path | None,
    seed: int,
    rate: float,
    focal: float | None,
    reading: dict[str, Any],
) -> None:
    """Print rows of motion.csv as events come, each as soon as an estimate after it is there."""
    from jaxevent.egomotion import voting
    from jaxevent.show.motion import LiveTable

    recording, chunks = arguments.open_live(path, reading)
    recording = _with_camera(recording, focal)
    _need_camera(recording, kind)
    values, _ = _parameters(voting, kind, params)
    size = recording.width, recording.height
    live = voting.live(size, values, model=kind, camera=recording.camera, seed=seed)
    table = LiveTable(live, rate)
    for events in chunks:
        live.add(events)
        print(table.rows(), end="", flush=True)
    live.finish()
    print(table.rows(), end="", flush=True)


def _check(estimator: Any, kind: Any, imu: bool, causal: bool, smooth: bool) -> None:
    """Raise `InputError` for a model or an option that the method does not know."""
    from jaxevent.methods import names
    from jaxevent.runs.egomotion import find_estimator

    estimator.find_model(kind)
    wanted = (("gyro", "imu", imu), ("causal", "causal", causal), ("smooth", "smooth", smooth))
    for option, name, used in wanted:
        if used and option not in estimator.options:
            others = [one for one in names("egomotion") if option in find_estimator(one).options]
            raise InputError(
                f"--{name} is not for the method {estimator.name}; leave it out or use "
                f"{' or '.join(others)}"
            )


def _stretch(recording: Any, start: float | int | None, stop: float | int | None) -> Any:
    """The events of some time, with the poses and the IMU of all."""
    if start is None and stop is None:
        return recording
    kept = {"poses": recording.poses, "imu": recording.imu}
    part = dataclasses.replace(recording[start:stop], **kept)
    if not len(part.events):
        raise InputError(
            f"{recording.name}: holds no events from --start to --stop; choose other times"
        )
    return part


def _with_camera(recording: Any, focal: float | int | None) -> Any:
    """The recording, with a camera of a focal length that was given."""
    from jaxevent.camera import PinholeCamera

    if focal is None:
        return recording
    if not 0 < focal < math.inf:
        raise InputError(f"--focal {focal:g} is not possible; give pixels above 0")
    if recording.camera is not None:
        raise InputError(f"{recording.name}: has a calibration; leave out --focal")
    centre = (recording.width - 1) / 2, (recording.height - 1) / 2
    return dataclasses.replace(recording, camera=PinholeCamera(focal, focal, *centre))


def _truth_there(recording: Any, kind: Any) -> list[str]:
    """A line that says that the recording itself tells its motion, if it does."""
    has = {"poses": recording.poses, "gyro": recording.imu}
    sources = ("poses",) if kind.fits_depth and recording.camera is not None else kind.truth_sources
    known = [name for name in sources if has[name] is not None and len(has[name])]
    return [f"the recording's {known[0]} can tell errors: add --truth"] if known else []


def _need_camera(recording: Any, kind: Any) -> None:
    from jaxevent.egomotion import MODELS

    if kind.needs_camera and recording.camera is None:
        others = [name for name, one in MODELS.items() if not one.needs_camera]
        raise InputError(
            f"{recording.name}: has no calibration, which {kind.title} needs"
            f"{recording.describe_left_out('camera')}; give --focal or choose --model "
            f"{' or '.join(others)}"
        )


def _parameters(estimator: Any, kind: Any, path: Path | None) -> tuple[Any, set[str]]:
    """The parameters, and the names of those that a file gives."""
    from jaxevent.parameters import read_toml

    if path is None:
        return estimator.initial_params(kind), set()
    values = estimator.Params.load(path, estimator.name)
    table = read_toml(path)
    return values, {*table, *table.get(estimator.name, {})}


def estimated(
    estimator: Any,
    recording: Any,
    params: Path | None,
    settings: dict[str, Any],
    gyro: Any,
    other: bool,
) -> tuple[Any, Any, Any]:
    """The method, the motion by it, and its parameters, which suit the recording.

    Where it finds nothing, or not before the middle, by the model's `other` method. `gyro` is that
    of `_told`.
    """
    from jaxevent.runs.egomotion import find_estimator

    kind = settings["model"]
    values, given = _parameters(estimator, kind, params)
    suited = estimator.adapt_params(recording, values, given=given)
    if suited.message:
        print(suited.message)
    told = _told(estimator, recording, suited.params, settings, gyro)
    first, usual = told.t[told.valid][:1], (estimator, told, suited.params)
    soon = len(first) and first[0] - recording.start <= (recording.stop - recording.start) / 2
    if soon or not other or not kind.fallback_method:
        return usual
    late = " before the recording's middle" if len(first) else ""
    print(f"{estimator.name} found no motion{late}, so {kind.fallback_method} is tried")
    estimator = find_estimator(kind.fallback_method)
    suited = estimator.adapt_params(recording, estimator.initial_params(kind), speed=suited.speed)
    if suited.params_message:
        print(f"{estimator.name}: {suited.params_message}")
    settings = {k: v for k, v in settings.items() if k not in ("causal", "smooth")}
    told = _told(estimator, recording, suited.params, settings, gyro)
    if len(first) and not told.valid.any():
        return usual
    return estimator, told, suited.params


def _told(estimator: Any, recording: Any, values: Any, settings: dict[str, Any], gyro: Any) -> Any:
    """The motion by a method; `gyro` tells whether the IMU helps, its bias and its axes."""
    more = {"cloud": N_PLOTTED_PARTICLES} if "cloud" in estimator.options else {}
    helps, bias, turned = gyro
    if helps:
        more["gyro"] = _gyro(estimator, recording, values, settings, bias, turned)
    return estimator.estimate(recording, values, **settings, **more)


def _gyro(
    estimator: Any, recording: Any, values: Any, settings: Any, bias: Any, turned: Any
) -> Any:
    """Return the gyro's rates without bias; an unknown bias is taken from a first estimate."""
    import numpy as np

    from jaxevent.egomotion import from_gyro
    from jaxevent.egomotion.truth import fit_gyro_bias

    zero = np.zeros(3) if bias is None else bias
    measured = from_gyro(recording.imu, zero, turned)
    if bias is not None:
        return measured
    told = estimator.estimate(recording, values, **settings)
    at = told.t[told.valid & (told.t >= measured.start) & (told.t <= measured.stop)]
    if not len(at):
        return measured
    rows = next(part.rows for part in told.model.parts if part.figure == "Omega")
    off = fit_gyro_bias(told(at).mean[:, rows], measured(at)[1])
    print(f"the gyro's bias, from a first estimate: {', '.join(f'{v:+.3f}' for v in off)} rad/s")
    return dataclasses.replace(measured, Omega=measured.Omega - off)
