"""The command `jaxevent motion`."""

import dataclasses
import math
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.display import format_count
from jaxevent.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from jaxevent.egomotion.estimator import MotionEstimator
    from jaxevent.egomotion.model_selection import ModelSelection
    from jaxevent.egomotion.models import Model
    from jaxevent.egomotion.motion import MotionEstimate
    from jaxevent.recording import Recording

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
    one.add_argument(
        "path",
        metavar="PATH",
        type=Path,
        help="a recording; only the methods batch and frames use its frames",
    )
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
    _add_truth_options(one)
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


def _add_truth_options(one: Any) -> None:
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """The parsed options."""

    path: Path
    model: str
    method: str | None
    params: Path | None
    seed: int
    truth: Path | str | None
    depth: float | int | None  # m, of the plane in front of the camera
    imu: bool
    imu_rotation: str | None
    still: tuple[float, float] | None  # s, first and last time
    rate: float | int  # rows per second
    causal: bool
    centred: bool
    smooth: bool
    start: float | int | None  # s
    stop: float | int | None  # s
    flow: bool
    focal: float | int | None  # px
    live: bool
    reading: dict[str, Any]  # options of `arguments.add_reading`
    out: Path | None


def run(**given: Any) -> None:
    from jaxevent.egomotion import find_model

    options = Options(**given)
    kind = None if options.model == "auto" else find_model(options.model)
    if options.live:
        _print_live(options, kind)
    else:
        _estimate_and_write(options, kind)


def _estimate_and_write(options: Options, kind: "type[Model] | None") -> None:
    """Estimate the motion of a recording and write it; if `kind` is None, select the model."""
    from jaxevent.egomotion.truth import parse_imu_rotation
    from jaxevent.runs.egomotion import find_estimator
    from jaxevent.show.motion import Output

    _check_options(options, kind)
    assert options.out is not None
    gyro_rotation = (
        None if options.imu_rotation is None else parse_imu_rotation(options.imu_rotation)
    )
    output = Output(options.out, options.rate, options.truth, flow=options.flow)
    whole = _open(options)
    arguments.warn_of_faults(whole, frames=False)
    bias = _gyro_bias(options, whole)
    recording = _crop_events(whole, options.start, options.stop)
    choice = None
    if kind is None:
        kind, recording, choice = _select_model(recording)
    estimator = find_estimator(options.method or kind.best_method)
    _check_method(estimator, kind, options)
    _require_camera(recording, kind)
    true = output.make_reference(whole, kind, bias, gyro_rotation, options.depth)
    clock = time.perf_counter()
    settings: dict[str, Any] = {"model": kind, "seed": options.seed, "progress": show_progress()}
    if options.causal:
        settings["causal"] = True
    elif "smooth" in estimator.options:
        settings["smooth"] = options.smooth or not options.centred
    is_default = not (options.method or options.params or options.causal or options.smooth)
    estimator, motion, values = estimate_or_fall_back(
        estimator,
        recording,
        options.params,
        settings,
        (options.imu, bias, gyro_rotation),
        is_default,
    )
    motion = _add_uncertainties(motion, recording, choice, options.focal)
    seconds = time.perf_counter() - clock
    about = {
        "seed": options.seed, "smooth": settings.get("smooth", False), "gyro": options.imu,
        "causal": options.causal,
    }  # fmt: skip
    made = {"method": estimator.name, "params": values}
    written = output.write(recording, motion, about, true, progress=show_progress(), **made)
    hint = _frames_hint(whole, estimator, values)
    hint += _truth_hint(whole, kind) if options.truth is None else []
    print("\n".join([f"{kind.title} by {estimator.name}:", *written.summary(), *hint]))
    count = len(recording.events)
    print(
        f"\n{', '.join(written.files)} in {options.out}: {format_count(count, 'event')} in "
        f"{arguments.describe_speed(count, seconds)}"
    )


def _check_options(options: Options, kind: "type[Model] | None") -> None:
    """Raise `InputError` for options that exclude each other, before anything is read."""
    from jaxevent.runs.egomotion import find_estimator

    if options.out is None:
        raise InputError("there is nowhere to write; give a folder, --out DIR, or --live")
    if kind is not None:
        _check_method(find_estimator(options.method or kind.best_method), kind, options)
    elif options.method is not None:
        find_estimator(options.method)
    if options.causal and (options.centred or options.smooth):
        raise InputError("--causal uses no later events; leave out --centred and --smooth")
    arguments.check_seed(options.seed)


def _open(options: Options) -> "Recording":
    """Open the recording with its camera, and check that it has events and any IMU required."""
    path = options.path
    recording, _ = arguments.open_named(path, options.reading)
    recording = _with_focal_length(recording, options.focal)
    if not len(recording.events):
        raise InputError(f"{path}: holds no events; choose another recording")
    recording.refuse_one_time(str(path))
    if recording.imu is None and (options.imu or options.still is not None):
        raise InputError(
            f"{path}: holds no IMU{recording.describe_left_out('imu')}; leave out "
            f"{'--imu' if options.imu else '--still'} or choose another recording"
        )
    return recording


def _gyro_bias(options: Options, recording: "Recording") -> "NDArray[np.float64] | None":
    """Return the gyro's mean rates (3,), rad/s, during --still; None without that option."""
    from jaxevent.egomotion.truth import gyro_bias

    if recording.imu is None or options.still is None:
        return None
    return gyro_bias(recording.imu, *options.still)


def _select_model(recording: "Recording") -> "tuple[type[Model], Recording, ModelSelection]":
    """Select a model for a recording; return it, the recording with its camera, and the test."""

    from jaxevent.egomotion.model_selection import select_model

    choice = select_model(recording)
    print("\n".join(choice.lines))
    if choice.camera is not None:
        recording = dataclasses.replace(recording, camera=choice.camera)
    return choice.model, recording, choice


def _add_uncertainties(
    motion: "MotionEstimate",
    recording: "Recording",
    choice: "ModelSelection | None",
    focal: float | None,
) -> "MotionEstimate":
    """Add the uncertainties of model, focal length (px) and inconsistent flow to a motion."""
    if choice is not None:
        motion = choice.include_doubt(motion)
    if focal is not None:
        motion = motion.with_focal_error()
    motion, warning = motion.with_flow_consistency(recording)
    if warning:
        print(warning)
    return motion


def _print_live(options: Options, kind: "type[Model] | None") -> None:
    """Print rows of motion.csv as events arrive, each once an estimate after it is available."""
    from jaxevent.egomotion import voting
    from jaxevent.show.motion import LiveTable

    excluded = {
        "--method": options.method not in (None, "voting"), "--truth": options.truth is not None,
        "--imu": options.imu, "--centred": options.centred, "--smooth": options.smooth,
        "--start": options.start is not None, "--stop": options.stop is not None,
        "--flow": options.flow, "--out": options.out is not None,
    }  # fmt: skip
    arguments.refuse_with_live(excluded)
    if kind is None:
        raise InputError("--live cannot see all events to choose a model; name it by --model")
    recording, chunks = arguments.open_live(options.path, options.reading)
    recording = _with_focal_length(recording, options.focal)
    _require_camera(recording, kind)
    values, _ = _load_params(voting, kind, options.params)
    size = recording.width, recording.height
    live = voting.live(size, values, model=kind, camera=recording.camera, seed=options.seed)
    table = LiveTable(live, float(options.rate))
    for events in chunks:
        live.add(events)
        print(table.rows(), end="", flush=True)
    live.finish()
    print(table.rows(), end="", flush=True)


def _check_method(estimator: "MotionEstimator", kind: "type[Model]", options: Options) -> None:
    """Raise `InputError` for a model or an option that the method does not support."""
    from jaxevent.methods import names
    from jaxevent.runs.egomotion import find_estimator

    estimator.find_model(kind)
    for option, name in (("gyro", "imu"), ("causal", "causal"), ("smooth", "smooth")):
        if getattr(options, name) and option not in estimator.options:
            others = [one for one in names("egomotion") if option in find_estimator(one).options]
            raise InputError(
                f"--{name} is not for the method {estimator.name}; leave it out or use "
                f"{' or '.join(others)}"
            )


def _crop_events(
    recording: "Recording", start: float | int | None, stop: float | int | None
) -> "Recording":
    """Crop a recording's events to start..stop (s); poses and IMU stay whole."""
    if start is None and stop is None:
        return recording
    kept = {"poses": recording.poses, "imu": recording.imu}
    part = dataclasses.replace(recording[start:stop], **kept)
    if not len(part.events):
        raise InputError(
            f"{recording.name}: holds no events from --start to --stop; choose other times"
        )
    return part


def _with_focal_length(recording: "Recording", focal: float | int | None) -> "Recording":
    """Give a recording a camera of the focal length (px); None leaves it as it is."""
    from jaxevent.camera import PinholeCamera

    if focal is None:
        return recording
    if not 0 < focal < math.inf:
        raise InputError(f"--focal {focal:g} is not possible; give pixels above 0")
    if recording.camera is not None:
        raise InputError(f"{recording.name}: has a calibration; leave out --focal")
    centre = (recording.width - 1) / 2, (recording.height - 1) / 2
    return dataclasses.replace(recording, camera=PinholeCamera(focal, focal, *centre))


def _truth_hint(recording: "Recording", kind: "type[Model]") -> list[str]:
    """Return a line that recommends --truth if the recording holds its true motion."""
    has = {"poses": recording.poses, "gyro": recording.imu}
    sources = ("poses",) if kind.fits_depth and recording.camera is not None else kind.truth_sources
    known = [name for name in sources if (rows := has[name]) is not None and len(rows)]
    return [f"the recording's {known[0]} can show errors: add --truth"] if known else []


def _frames_hint(recording: "Recording", estimator: "MotionEstimator", values: Any) -> list[str]:
    """Return a line that says that the recording's frames, if any, are not used.

    Args:
        recording: The recording.
        estimator: The method.
        values: Parameters of the method.

    Returns:
        The line, or an empty list.
    """
    if recording.frames is None or estimator.needs_frames or values.values().get("frames"):
        return []
    count = format_count(len(recording.frames), "frame")
    return [f"by the events alone, without the recording's {count}"]


def _require_camera(recording: "Recording", kind: "type[Model]") -> None:
    from jaxevent.egomotion import MODELS

    if kind.needs_camera and recording.camera is None:
        others = [name for name, one in MODELS.items() if not one.needs_camera]
        raise InputError(
            f"{recording.name}: has no calibration, which {kind.title} needs"
            f"{recording.describe_left_out('camera')}; give --camera or --focal, or choose "
            f"--model {' or '.join(others)}"
        )


def _load_params(
    estimator: "MotionEstimator", kind: "type[Model]", path: Path | None
) -> tuple[Any, set[str]]:
    """Return the parameters from a file or the defaults, and the names that the file sets."""
    from jaxevent.parameters import read_toml

    if path is None:
        return estimator.initial_params(kind), set()
    values = estimator.Params.load(path, estimator.name)
    table = read_toml(path)
    return values, {*table, *table.get(estimator.name, {})}


def estimate_or_fall_back(
    estimator: "MotionEstimator",
    recording: "Recording",
    params: Path | None,
    settings: dict[str, Any],
    gyro: Any,
    may_fall_back: bool,
) -> "tuple[MotionEstimator, MotionEstimate, Any]":
    """Estimate the motion, by the model's fallback method if the first half has no estimate.

    Args:
        estimator: The method.
        recording: The recording.
        params: File of parameters, or None.
        settings: Options of `estimate`, with the model.
        gyro: Whether the gyro is used, its bias (3,) in rad/s or None, and its rotation or None.
        may_fall_back: Whether the fallback method may be tried.

    Returns:
        The method used, the motion, and the parameters, adapted to the recording.
    """
    from jaxevent.runs.egomotion import find_estimator

    kind = settings["model"]
    values, given = _load_params(estimator, kind, params)
    suited = estimator.adapt_params(recording, values, given=given)
    if suited.message:
        print(suited.message)
    motion = _estimate(estimator, recording, suited.params, settings, gyro)
    first, result = motion.t[motion.valid][:1], (estimator, motion, suited.params)
    is_early = len(first) and first[0] - recording.start <= (recording.stop - recording.start) / 2
    is_refuted = not len(first) and motion.warning
    if is_early or is_refuted or not may_fall_back or not kind.fallback_method:
        return result
    late = " before the recording's middle" if len(first) else ""
    print(f"{estimator.name} found no motion{late}, so {kind.fallback_method} is tried")
    estimator = find_estimator(kind.fallback_method)
    suited = estimator.adapt_params(recording, estimator.initial_params(kind), speed=suited.speed)
    if suited.params_message:
        print(f"{estimator.name}: {suited.params_message}")
    settings = {k: v for k, v in settings.items() if k not in ("causal", "smooth")}
    motion = _estimate(estimator, recording, suited.params, settings, gyro)
    if len(first) and not motion.valid.any():
        return result
    return estimator, motion, suited.params


def _estimate(
    estimator: "MotionEstimator",
    recording: "Recording",
    values: Any,
    settings: dict[str, Any],
    gyro: Any,
) -> "MotionEstimate":
    """Estimate the motion by one method, with the gyro if it is used.

    Args:
        estimator: The method.
        recording: The recording.
        values: Parameters.
        settings: Options of `estimate`.
        gyro: Whether the gyro is used, its bias (3,) in rad/s or None, and its rotation or None.

    Returns:
        The motion.
    """
    from jaxevent.egomotion.estimator import InconsistentMotionWarning, LostMotionWarning

    more = {"cloud": N_PLOTTED_PARTICLES} if "cloud" in estimator.options else {}
    uses_gyro, bias, gyro_rotation = gyro
    with warnings.catch_warnings():
        # The command's summary reports these.
        warnings.simplefilter("ignore", LostMotionWarning)
        warnings.simplefilter("ignore", InconsistentMotionWarning)
        if uses_gyro:
            more["gyro"] = _gyro_without_bias(
                estimator, recording, values, settings, bias, gyro_rotation
            )
        return estimator.estimate(recording, values, **settings, **more)


def _gyro_without_bias(
    estimator: "MotionEstimator",
    recording: "Recording",
    values: Any,
    settings: dict[str, Any],
    bias: "NDArray[np.float64] | None",
    gyro_rotation: "NDArray[np.float64] | None",
) -> Any:
    """Return the gyro's rates without their bias.

    Args:
        estimator: The method of the first estimate.
        recording: The recording, with an IMU.
        values: Parameters.
        settings: Options of `estimate`.
        bias: (3,) rad/s; None: fitted to a first estimate.
        gyro_rotation: (3, 3) rotation from the gyro's axes to the camera's, or None.

    Returns:
        The measured rates, less the bias.
    """
    import numpy as np

    from jaxevent.egomotion import twists_from_gyro
    from jaxevent.egomotion.truth import fit_gyro_bias

    assert recording.imu is not None  # see `_open`
    zero = np.zeros(3) if bias is None else bias
    measured = twists_from_gyro(recording.imu, zero, gyro_rotation)
    if bias is not None:
        return measured
    motion = estimator.estimate(recording, values, **settings)
    at = motion.t[motion.valid & (motion.t >= measured.start) & (motion.t <= measured.stop)]
    if not len(at):
        return measured
    rows = next(part.rows for part in motion.model.parts if part.figure == "Omega")
    off = fit_gyro_bias(motion(at).mean[:, rows], measured(at)[1])
    print(f"the gyro's bias, from a first estimate: {', '.join(f'{v:+.3f}' for v in off)} rad/s")
    return dataclasses.replace(measured, Omega=measured.Omega - off)
