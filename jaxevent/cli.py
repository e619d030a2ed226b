"""The command line: demo, info, convert, register, reconstruct, track, motion and so on.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import math
import os
import platform
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jaxevent
from jaxevent.errors import InputError

_CLOUD = 64  # particles of an estimate that are kept for the plot


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: the process's arguments); returns the exit status.

    0: done; 1: the output was not read to its end; 2: bad input or arguments (argparse exits with
    2 by itself); 130: interrupted.
    """
    arguments = vars(_parser().parse_args(argv))
    command = arguments.pop("command")
    _keep_compiled()
    try:
        command(**arguments)
        sys.stdout.flush()
    except InputError as error:
        print(f"jaxevent: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Python flushes stdout once more at exit, which must not fail again.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _keep_compiled() -> None:
    """Have JAX keep what it compiles in the user's cache folder; JAX's own variables win.

    By the variables, because the processes of `evaluate --workers` inherit them. The folder is
    named by the processor, whose instructions compiled programs use: homes are shared by machines.
    """
    if {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"} & os.environ.keys():
        return
    from platformdirs import user_cache_path

    about = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    name = hashlib.blake2b(about.encode(), digest_size=6).hexdigest()
    folder = user_cache_path("jaxevent", appauthor=False) / "compiled" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # no home, as in some containers: everything works without
        return
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
        # What cannot be kept, or was damaged, is compiled again.
        warnings.filterwarnings("ignore", "Error (read|writ)ing persistent compilation cache")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxevent",
        description="Video of high rate and dynamic range, tracks, and motion, from event cameras.",
        epilog="example:\n  jaxevent demo",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxevent {jaxevent.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def add(command: Callable, description: str, *examples: str) -> argparse.ArgumentParser:
        name = command.__name__
        lines = "".join(f"\n  jaxevent {name} {example}".rstrip() for example in examples)
        one = commands.add_parser(
            name,
            help=description.partition(".")[0],
            description="\n".join(textwrap.wrap(description, 79)),
            epilog=f"example{'s' * (len(examples) > 1)}:{lines}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        one.set_defaults(command=command)
        return one

    def add_size(one: argparse.ArgumentParser) -> None:
        one.add_argument(
            "--size",
            metavar="W,H",
            type=_size,
            help="sensor size in pixels, for a recording that does not tell it",
        )

    one = add(
        demo,
        "Reconstruct a short recording with every method. It writes a table of errors, a figure "
        "and a slow-motion video, and prints the table.",
        "",
        "--out my-demo",
    )
    one.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("jaxevent-demo"),
        help="default: %(default)s",
    )

    def add_stream(one: argparse.ArgumentParser) -> None:
        one.add_argument(
            "--stream",
            metavar="NAME",
            help="which camera, of a file that holds several: a topic, left, right or a number",
        )

    one = add(info, "Describe a recording.", "slider_depth.zip", "events.npz --size 240,180")
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    add_size(one)
    add_stream(one)

    one = add(
        convert,
        "Store a recording as HDF5. The file opens at once and need not fit in memory.",
        "slider_depth.zip slider_depth.h5",
        "stereo.bag left.h5 --stream /davis/left/events",
        "slider_depth.zip small.h5 --compression gzip",
    )
    one.add_argument("source", metavar="SRC", type=Path, help="a recording")
    one.add_argument("target", metavar="DST", type=Path, help="the HDF5 file to write")
    one.add_argument("--compression", choices=["gzip"], help="smaller, but slower to read")
    add_size(one)
    add_stream(one)

    one = add(
        register,
        "Bring the frames of a separate camera onto the event camera's pixels and clock, and store "
        "both as one recording. From a calibration, or else by a homography, for scenes that are "
        "far away or flat, which is estimated from the recordings, as is the offset of the clocks.",
        "events.raw --frames camera --out both.h5",
        "events.h5 --frames camera.bag --calibration rig.toml --depth 2.5 --out both.h5",
        "both.h5 --reference hdr --homography H.csv --offset 0.0123 --out truth.h5",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording of the event camera")
    source = one.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--frames",
        metavar="OTHER",
        type=Path,
        help="the other camera: a recording, or a folder of images with timestamps.txt",
    )
    source.add_argument(
        "--reference",
        metavar="OTHER",
        type=Path,
        help="the same of HDR images, which become the reference of `jaxevent evaluate`",
    )
    one.add_argument(
        "--homography",
        metavar="CSV",
        type=Path,
        help="three lines of three numbers, from pixels of the event camera to the other's",
    )
    one.add_argument(
        "--calibration",
        metavar="TOML",
        type=Path,
        help="both cameras and the transform between them, see jaxevent.register.Rig.read",
    )
    one.add_argument(
        "--depth",
        metavar="M_or_NPY",
        help="of the scene in m, one number or a map of the event camera's pixels; default: far",
    )
    one.add_argument(
        "--plane",
        metavar="A,B,C,D",
        type=_plane,
        help="instead: the scene is a x + b y + c z = d (m); --plane=A,... where A is negative",
    )
    one.add_argument(
        "--offset",
        metavar="S",
        type=float,
        help="added to the other camera's time stamps; default: estimated",
    )
    one.add_argument(
        "--search", metavar="S", type=float, help="the largest offset that is thought possible"
    )
    one.add_argument(
        "--exposure", metavar="S", type=float, help="of images in a folder, which do not tell it"
    )
    one.add_argument(
        "--white", metavar="V", type=float, help="their value of intensity 1; default: the largest"
    )
    one.add_argument(
        "--crop", action="store_true", help="cut to a rectangle of pixels that both cameras see"
    )
    add_size(one)
    add_stream(one)
    one.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="the HDF5 file to write"
    )

    one = add(
        reconstruct,
        "Make images of a recording. The name of the output tells its kind: .h5 holds times, "
        "linear intensity and its variance; .mp4 is a video; without suffix it is a folder of PNG "
        "images with images.txt.",
        "slider_depth.zip --method akf --rate 200 --out slider.mp4",
        "slider_depth.zip --method akf --at frames --params mine.toml --out slider.h5",
        "bike.h5 --method akf --colour --tone log --out bike",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    one.add_argument(
        "--method",
        metavar="NAME",
        required=True,
        help="akf, aks, cf, cf-augmented, high-pass, edi, augmented, blend or last-frame",
    )
    when = one.add_mutually_exclusive_group()
    when.add_argument("--rate", metavar="HZ", type=float, help="images per second, evenly spaced")
    when.add_argument("--at", choices=["frames"], help="one image where each frame is")
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file of name = value lines, e.g. c_on = 0.1, or params.toml of a fit",
    )
    one.add_argument(
        "--tone",
        choices=["linear", "log", "percentile", "clahe"],
        help="how intensity becomes grey in PNG and MP4; default: linear",
    )
    one.add_argument(
        "--colour",
        action="store_true",
        help="in the colours of the frames, for a recording that holds extra/rgb; in .h5 images "
        "of red, green, blue without variance",
    )
    one.add_argument(
        "--out", metavar="DIR_or_FILE", type=Path, required=True, help="name in .h5, .mp4 or none"
    )
    add_size(one)

    one = add(
        track,
        "Track blobs: bright spots and other compact sources of events. Without suffix the output "
        "is a folder of tracks.csv, tracks.h5, tracks.mp4 and tracks.png; with one it is the file "
        "of that kind. Tables have a row for each track and time.",
        "stars.h5 --params slow.toml --out stars",
        "dot.h5 --seed 320,240,20 --rate 2000 --out dot.csv",
        "car.h5 --seed 400,300,15 --seed 460,300,15 --pair 0,1 --out car",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording; frames are not needed")
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help='TOML file of name = value lines, e.g. preset = "slow" or events_per_step = 16, or '
        "params.toml of a fit",
    )
    one.add_argument(
        "--seed",
        metavar="X,Y,SIZE[,T]",
        dest="seeds",
        type=_seed,
        action="append",
        help="where a blob is (px), how large (standard deviation of its events, px) and from when "
        "(s, default: the start); may be repeated. Without, blobs are found",
    )
    one.add_argument(
        "--detect", action="store_true", help="find further blobs where there are seeds"
    )
    when = one.add_mutually_exclusive_group()
    when.add_argument(
        "--rate", metavar="HZ", type=float, default=1000.0, help="rows per second; default: 1000"
    )
    when.add_argument("--at", choices=["events"], help="a row for each event of a track")
    one.add_argument(
        "--start", metavar="S", type=float, help="of tracking, on the recording's clock"
    )
    one.add_argument("--stop", metavar="S", type=float, help="its end")
    one.add_argument(
        "--background",
        choices=["events", "high-pass"],
        default="events",
        help="behind the tracks in the video; default: events",
    )
    add_size(one)
    group = one.add_argument_group("time to contact and range, in quantities.csv and the plot")
    group.add_argument(
        "--pair", metavar="ID,ID", type=_pair, help="two tracks whose distance tells 1 / TTC"
    )
    group.add_argument("--extent", metavar="M", type=float, help="the target's size in m")
    group.add_argument("--focal", metavar="PX", type=float, help="focal length in px")
    group.add_argument(
        "--size-factor",
        metavar="K",
        type=float,
        help="lambda over the diameter in the image; default: 0.354, of an even rim",
    )
    one.add_argument("--out", metavar="DIR_or_FILE", type=Path, required=True, help="what to write")

    one = add(
        motion,
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
        "general: heading tx, ty, tz, a unit vector, and angular velocity",
    )
    one.add_argument(
        "--method",
        metavar="NAME",
        help="voting, batch, contrast, planes or frames; default: voting, for general motion batch",
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
        nargs="?",
        const="auto",
        help="compare with a table with columns as in motion.csv, or without a name with the "
        "recording's poses or else its gyro",
    )
    one.add_argument(
        "--gyro", action="store_true", help="let the recording's gyro help the method batch"
    )
    one.add_argument(
        "--still",
        metavar="S,S",
        type=_span,
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
    add_size(one)
    one.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to write")

    one = add(
        evaluate,
        "Compare methods on recordings. It hides frames, reconstructs them and prints a table of "
        "the errors. With --out, what is finished is kept: the same again goes on where it was "
        "stopped, and computes only what is new. A recording or method that fails is said, and the "
        "others go on; the exit status is 2 only if all fail.",
        "configs/slider_depth.toml --out results",
        "mine.toml --out results --workers 8",
        "mine.toml --out results --cluster tcp://10.0.0.1:8786",
    )
    one.add_argument("config", metavar="CONFIG.toml", type=Path, help="recordings and methods")
    one.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for report.html, results.json and others"
    )
    where = one.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", metavar="N", type=int, help="compute in N processes instead of one"
    )
    where.add_argument(
        "--cluster", metavar="ADDRESS", help="compute on the Dask cluster with this scheduler"
    )
    where.add_argument(
        "--scheduler-file",
        metavar="FILE",
        type=Path,
        help="the same, of the scheduler that wrote this file",
    )
    one.add_argument(
        "--retries",
        metavar="K",
        type=int,
        default=2,
        help="further attempts where a worker dies or fails; default: %(default)s",
    )

    one = add(
        fit,
        "Fit parameters of methods to recordings. It writes them with tables of the errors before "
        "and after, and prints the errors of images that it did not use. An interrupted fit goes "
        "on with --resume. Several processes, on one machine or many, fit together: each is given "
        "the same arguments and its number.",
        "configs/fit_slider_depth.toml --out fitted",
        "configs/fit_slider_depth.toml --recording mine.h5 --out mine --resume",
        "mine.toml --out fitted --coordinator host1:4321 --processes 2 --process 0",
    )
    one.add_argument("config", metavar="CONFIG.toml", type=Path, help="what to fit, and to what")
    one.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="folder for params.toml, results.md"
    )
    one.add_argument(
        "--recording",
        metavar="PATH",
        dest="recordings",
        action="append",
        help="fitted to instead of those in the file; may be repeated",
    )
    one.add_argument("--resume", action="store_true", help="go on from the checkpoint in DIR")
    one.add_argument(
        "--coordinator", metavar="HOST:PORT", help="a free port of the machine of process 0"
    )
    one.add_argument("--processes", metavar="N", type=int, help="how many fit together")
    one.add_argument("--process", metavar="I", type=int, help="which of them this is, from 0")
    one.add_argument(
        "--distributed",
        action="store_true",
        help="the same, found by JAX: under SLURM, Open MPI, Kubernetes",
    )

    one = add(
        simulate,
        "Make a recording whose truth is known, as HDF5. A simulated sensor looks at a drawn scene "
        "of high dynamic range over which the camera moves, or at a video, of which the frames see "
        "only the middle levels. Or events alone, of moving blobs. Or a camera that moves in a "
        "rigid world.",
        "--scene lake --speed fast --out lake.h5",
        "--blobs lissajous --truth dot.csv --out dot.h5",
        "--motion rotation --change varying --truth spin.csv --out spin.h5",
        "bike.mp4 --cut 50 --speed 0.5 --out bike.h5",
    )
    source = one.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "video", metavar="VIDEO", nargs="?", type=Path, help="a video, or a folder of images"
    )
    source.add_argument(
        "--scene",
        metavar="NAME",
        help="room, forest, mountain, lake, night, tunnel, or a number for a variant of one",
    )
    source.add_argument(
        "--blobs",
        metavar="NAME",
        help="lissajous, noise, growing, ttc, disc, crossing, dropout, flock or walk",
    )
    source.add_argument(
        "--motion",
        metavar="NAME",
        help="of the camera: planar, rotation, or general before a wall, shapes or texture",
    )
    one.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="the HDF5 file to write"
    )
    one.add_argument(
        "--sensor",
        metavar="NAME",
        help="ideal, good, davis or poor; default: davis, with --motion an ideal one",
    )
    one.add_argument("--seed", metavar="N", type=int, default=0, help="of all that is random")
    one.add_argument(
        "--speed",
        metavar="SPEED",
        help="of the camera over a scene, slow (default) or fast; of a video, 2: twice as fast; of "
        "--motion, px/s (planar), rad/s (rotation) or m/s",
    )
    one.add_argument(
        "--duration",
        metavar="S",
        type=float,
        help="seconds of a scene, default 1.5, or of --motion, default 0.5; of the video, before "
        "--speed, or of blobs, default all",
    )
    one.add_argument(
        "--truth",
        metavar="CSV",
        type=Path,
        help="a table at 1000 Hz: of blobs their states, as that of `jaxevent track`, of --motion "
        "the motion, as that of `jaxevent motion`",
    )
    one.add_argument(
        "--size",
        metavar="W,H",
        type=_size,
        help="sensor size in pixels; default: 128,96 for a scene, 240,180 for --motion",
    )
    group = one.add_argument_group("only for --motion")
    group.add_argument(
        "--change",
        metavar="HOW",
        help="how the motion changes: constant (default), linear or varying",
    )
    group = one.add_argument_group("only for a video")
    group.add_argument("--start", metavar="S", type=float, help="first second used; default: 0")
    group.add_argument(
        "--cut",
        metavar="LEVELS",
        type=float,
        help="levels of 255 that the frames crop at either end, 0 to 127; default: 50",
    )
    group.add_argument(
        "--max-size",
        metavar="PIXELS",
        type=int,
        help="longer side, to which a larger video is scaled down; default: 346",
    )
    return parser


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not W,H, for example 240,180") from None
    return width, height


def _seed(text: str) -> tuple[float, ...]:
    return _numbers(text, (3, 4), float, "X,Y,SIZE or X,Y,SIZE,T, for example 120,90,8")


def _pair(text: str) -> tuple[int, ...]:
    return _numbers(text, (2,), int, "ID,ID, for example 0,1")


def _plane(text: str) -> tuple[float, ...]:
    return _numbers(text, (4,), float, "A,B,C,D, for example 0,0,1,2.5")


def _span(text: str) -> tuple[float, ...]:
    return _numbers(text, (2,), float, "START,STOP in seconds, for example 0,0.5")


def _numbers(text: str, counts: tuple[int, ...], kind: Callable, meant: str) -> tuple:
    try:
        numbers = tuple(kind(number) for number in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in counts:
        raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")
    return numbers


def _progress() -> bool:
    return sys.stderr.isatty()


def evaluate(
    config: Path,
    out: Path | None,
    workers: int | None,
    cluster: str | None,
    scheduler_file: Path | None,
    retries: int,
) -> None:
    from jaxevent.evaluate import evaluate as run
    from jaxevent.report import markdown_table

    rows = run(
        config,
        out,
        progress=_progress(),
        workers=workers,
        cluster=cluster,
        scheduler_file=scheduler_file,
        retries=retries,
    )
    print(markdown_table(rows), end="")
    if out is not None:
        files = "report.html, results.json, results.md, results.parquet, config.toml"
        if not (out / "results.parquet").exists():
            files = files.replace("results.parquet, ", "")
            files += "; results.parquet needs pip install 'jaxevent[parquet]'"
        print(f"\nwritten to {out}: {files}")
    failed = sum("error" in row for row in rows)
    if failed:
        print(f"jaxevent: {failed} of {len(rows)} rows failed, see below them", file=sys.stderr)


def fit(
    config: Path,
    out: Path,
    recordings: list[str] | None,
    resume: bool,
    coordinator: str | None,
    processes: int | None,
    process: int | None,
    distributed: bool,
) -> None:
    from jaxevent import devices

    parts = (coordinator, processes, process)
    if distributed and parts != (None, None, None):
        raise InputError(
            "--distributed finds the coordinator and the processes itself; give one or the other"
        )
    if distributed or parts != (None, None, None):
        devices.join(*parts)

    from jaxevent.fit import fit as run

    run(config, out, recordings, resume, _progress())
    if not devices.first():
        return
    print((out / "results.md").read_text(), end="")
    files = "params.toml, results.json, results.md, loss.csv, loss.png, config.toml"
    print(f"\nwritten to {out}: {files}")


def convert(
    source: Path,
    target: Path,
    compression: str | None,
    size: tuple[int, int] | None,
    stream: str | None,
) -> None:
    from jaxevent.io import load, save

    recording = load(source, size, in_memory=False, progress=_progress(), stream=stream)
    save(recording, target, compression, progress=_progress())
    _print_stored(recording, target)


def register(
    path: Path,
    frames: Path | None,
    reference: Path | None,
    homography: Path | None,
    calibration: Path | None,
    depth: str | None,
    plane: tuple[float, float, float, float] | None,
    offset: float | int | None,
    search: float | int | None,
    exposure: float | int | None,
    white: float | int | None,
    crop: bool,
    size: tuple[int, int] | None,
    stream: str | None,
    out: Path,
) -> None:
    from jaxevent import register as rig
    from jaxevent.io import load, save
    from jaxevent.io.output import complete

    if homography is not None and calibration is not None:
        raise InputError("--homography and --calibration say the same; leave one of them out")
    for name, value in (("depth", depth), ("plane", plane)):
        if value is not None and calibration is None:
            raise InputError(f"--{name} needs --calibration; add it or leave --{name} out")
    if depth is not None and plane is not None:
        raise InputError("--depth and --plane say the same; leave one of them out")
    if offset is not None and search is not None:
        raise InputError("--search is for an offset that is not known; leave it out with --offset")
    if crop and reference is not None:
        raise InputError("--crop is for frames; leave it out with --reference")
    source = frames or reference
    assert source is not None
    other = rig.read_frames(
        source,
        reference=reference is not None,
        exposure=exposure,
        white=white,
        progress=_progress(),
    )
    recording = load(path, size, in_memory=False, progress=_progress(), stream=stream)
    name = recording.name
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    seen, grid = (recording.width, recording.height), None
    if calibration is not None:
        known = rig.Rig.read(calibration, recording.camera)
        recording = dataclasses.replace(recording, camera=known.events)
        far = {} if depth is None else {"depth": rig.read_depth(depth, seen)}
        grid = known.grid(seen, (other.width, other.height), plane=plane, **far)
    H = None if homography is None else rig.read_homography(homography)
    # Opened first, so that a place that cannot be written is told before the work.
    with complete(out) as partial:
        found = rig.estimate(
            recording, other, grid, homography=H, offset=offset, search=search,
            progress=_progress(),
        )  # fmt: skip
        both = rig.registered(recording, other, found, crop=crop, reference=reference is not None)
        save(dataclasses.replace(both, name=name), partial, progress=_progress())
    if found.homography is not None and H is None:
        print("homography from the event camera's pixels to the other's:")
        for row in found.homography:
            print("  " + ", ".join(f"{value:.9g}" for value in row))
    how = "given" if offset is not None else "estimated"
    print(f"offset added to the other camera's time stamps, {how}: {found.offset:.6f} s")
    if found.agreement is not None:
        print(f"correlation of the changes that frames and events show: {found.agreement:.3f}")
    print(f"pixels that the other camera sees: {rig.seen(found.grid):.1%}")
    _print_stored(both, out)


def _print_stored(recording: Any, path: Path) -> None:
    frames = len(recording.frames) if recording.frames else 0
    size_mb = path.stat().st_size / 1e6
    print(f"{path}: {len(recording.events):,} events, {frames} frames, {size_mb:.1f} MB")


def reconstruct(
    path: Path,
    method: str,
    rate: float | int | None,
    at: str | None,
    params: Path | None,
    size: tuple[int, int] | None,
    tone: str | None,
    colour: bool,
    out: Path,
) -> None:
    from jaxevent.colour import colour_video
    from jaxevent.evaluate import find_method, frame_times
    from jaxevent.export import evenly, write_hdf5, writer
    from jaxevent.io import load

    write = writer(out)
    if tone is not None and write is write_hdf5:
        raise InputError(f"{out}: --tone is for images to look at; HDF5 holds linear intensity")
    estimator = find_method(method)
    values = estimator.Params() if params is None else estimator.Params.load(params, method)
    recording = load(path, size, in_memory=False, progress=_progress())
    name = recording.name
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if at == "frames" and recording.frames is None:
        raise InputError(f"{path}: holds no frames; give --rate instead of --at frames")
    if rate is None and recording.frames is not None:
        times = frame_times(recording.frames, values)
    else:
        times = evenly(recording, 100.0 if rate is None else rate)
    clock = time.perf_counter()
    video = estimator.reconstruct(recording, values, progress=_progress())
    colours = colour_video(video, recording) if colour else None
    how = write(video, times, out, tone or "linear", name, colours)
    seconds = time.perf_counter() - clock
    print(
        f"{out}: {len(times):,} images{how}, {seconds:.2f} s, "
        f"{len(recording.events) / seconds:,.0f} events/s"
    )


def track(
    path: Path,
    params: Path | None,
    seeds: list[tuple[float, ...]] | None,
    detect: bool,
    rate: float | int,
    at: str | None,
    start: float | int | None,
    stop: float | int | None,
    background: str,
    size: tuple[int, int] | None,
    pair: tuple[int, int] | None,
    extent: float | int | None,
    focal: float | int | None,
    size_factor: float | int | None,
    out: Path,
) -> None:
    from jaxevent.blob import Params
    from jaxevent.blob import track as run
    from jaxevent.blob.pictures import Output
    from jaxevent.io import load

    values = Params.of({}) if params is None else Params.load(params, "blob")
    each = None if at == "events" else rate
    output = Output(out, each, background, pair, extent, focal, size_factor)
    recording = load(path, size, in_memory=False, progress=_progress())
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if not len(recording.events):
        raise InputError(f"{path}: holds no events to track; choose another recording")
    span: dict[str, Any] = {"start": start, "stop": stop}
    clock = time.perf_counter()
    tracks = run(
        recording, values, seeds, **span, detect=detect or seeds is None, progress=_progress()
    )
    seconds = time.perf_counter() - clock
    written = output.write(tracks, _progress())
    count = recording.events.index(tracks.stop) - recording.events.index(tracks.start)
    if len(tracks):
        print("\n".join(written.summary()))
    else:
        print(
            "no blob was found; say where one is with --seed X,Y,SIZE, or try --params with "
            'preset = "slow" or "fast"'
        )
    how = ", ".join(written.files) + f" in {out}" if not out.suffix else str(out)
    slow = "" if written.slow is None else f"; the video plays at {written.slow:.3g} of real time"
    print(
        f"\n{how}: {len(tracks):,} tracks, {count:,} events in {seconds:.2f} s, "
        f"{count / seconds:,.0f} events/s{slow}"
    )


def motion(
    path: Path,
    model: str,
    method: str | None,
    params: Path | None,
    seed: int,
    truth: str | None,
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
    import inspect
    import json

    from jaxevent.camera import PinholeCamera
    from jaxevent.egomotion import find_method, from_gyro, gyro_bias
    from jaxevent.egomotion.pictures import Output
    from jaxevent.io import load

    estimator = find_method(method, model)
    method = estimator.__name__.rpartition(".")[2]
    values = estimator.Params.of({}) if params is None else estimator.Params.load(params, method)
    if seed < 0:
        raise InputError(f"--seed {seed} is not possible; give a whole number from 0")
    takes = inspect.signature(estimator.estimate).parameters
    for option, used, other in (("gyro", gyro, "batch"), ("smooth", smooth, "voting")):
        if used and option not in takes:
            raise InputError(
                f"--{option} is not for the method {method}; leave it out or use {other}"
            )
    output = Output(out, rate, truth, centred, flow)
    recording = load(path, size, in_memory=False, progress=_progress())
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
    if model != "planar" and recording.camera is None:
        raise InputError(
            f"{path}: has no calibration, which {model} motion needs; give --focal or choose "
            "--model planar"
        )
    imu = recording.imu
    if imu is None and (gyro or still is not None):
        raise InputError(
            f"{path}: holds no IMU; leave out {'--gyro' if gyro else '--still'} or choose another "
            "recording"
        )
    bias = None if imu is None or still is None else gyro_bias(imu, *still)
    true = output.known(recording, model, bias)
    settings: dict[str, Any] = {"cloud": _CLOUD} if "cloud" in takes else {}
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
        recording, values, model=model, seed=seed, progress=_progress(), **settings
    )
    seconds = time.perf_counter() - clock
    about = {"method": method, "parameters": json.dumps(values.values()), "seed": seed}
    about |= {"smooth": smooth, "gyro": gyro, "centred": centred}
    written = output.write(recording, told, about, true, _progress())
    print("\n".join([f"{model} motion by {method}:", *written.summary()]))
    count = len(recording.events)
    print(
        f"\n{', '.join(written.files)} in {out}: {count:,} events in {seconds:.2f} s, "
        f"{count / seconds:,.0f} events/s"
    )


def simulate(
    video: Path | None,
    scene: str | None,
    blobs: str | None,
    motion: str | None,
    change: str | None,
    truth: Path | None,
    out: Path,
    sensor: str | None,
    seed: int,
    speed: str | None,
    duration: float | int | None,
    size: tuple[int, int] | None,
    start: float | int | None,
    cut: float | int | None,
    max_size: int | None,
) -> None:
    from jaxevent import simulate as sim
    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.parameters import nearest
    from jaxevent.simulate.scenes import SPEEDS

    if seed < 0:
        raise InputError(f"--seed {seed} is not possible; give a whole number from 0")
    if duration is not None and not 0 < duration < math.inf:
        raise InputError(f"--duration {duration:g} is not possible; give seconds above 0")
    if size is not None and min(size) < 1:
        raise InputError(f"--size {size[0]},{size[1]} is not possible; give it in pixels")
    if sensor is not None and sensor not in sim.SENSORS:
        raise InputError(f"there is no sensor {sensor!r}; {nearest(sensor, sim.SENSORS)}")
    if blobs is not None or motion is not None:
        given = {"start": start, "cut": cut, "max-size": max_size}
        if blobs is not None:
            given |= {"sensor": sensor, "speed": speed, "size": size, "change": change}
        for name, value in given.items():
            if value is not None:
                what = "blobs" if blobs is not None else "the motion of a camera"
                raise InputError(f"--{name} is not for {what}; leave it out")
        if blobs is not None:
            _simulate_blobs(blobs, truth, out, seed, duration)
        else:
            assert motion is not None
            how = {"change": change or "constant", "sensor": sensor, "speed": speed}
            _simulate_motion(motion, truth, out, seed, duration or 0.5, size or (240, 180), **how)
        return
    if truth is not None:
        raise InputError(
            "--truth is that of --blobs and --motion; HDR scenes hold theirs, leave it out"
        )
    if change is not None:
        raise InputError("--change is for --motion; leave it out")
    sensor = sensor or "davis"
    given: dict[str, Any] = {"start": start, "cut": cut, "max_size": max_size}
    given = {name: value for name, value in given.items() if value is not None}
    # Opened first, so that a place that cannot be written is told before the work.
    with complete(out) as partial:
        if scene is not None:
            if given:
                option = next(iter(given)).replace("_", "-")
                raise InputError(f"--{option} is for a video; leave it out with --scene")
            way: Any = speed or "slow"
            if way not in SPEEDS:
                raise InputError(f"--speed {way} is not possible for a scene; give slow or fast")
            panorama = sim.scene(int(scene) if scene.isdecimal() else scene)
            source = sim.Pan(panorama, size or (128, 96), duration or 1.5, way, seed)
            recording = sim.simulate(source, sim.SENSORS[sensor], seed, f"{scene}-{way}")
        else:
            assert video is not None
            if size is not None:
                raise InputError("--size is for a scene; scale a video with --max-size")
            try:
                factor = float(speed or 1)
            except ValueError:
                raise InputError(
                    f"--speed {speed} is for a scene; give a video a number, such as 0.5"
                ) from None
            stop = None if duration is None else (start or 0.0) + duration
            recording = sim.from_video(
                video, sim.SENSORS[sensor], speed=factor, stop=stop, seed=seed, **given
            )
        save(recording, partial)
    _print_stored(recording, out)


def _simulate_blobs(
    name: str, truth: Path | None, out: Path, seed: int, duration: float | int | None
) -> None:
    import numpy as np

    from jaxevent.blob.pictures import write_states
    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.simulate import blob_scene

    with contextlib.ExitStack() as stack:
        partial = stack.enter_context(complete(out))
        table = None if truth is None else stack.enter_context(complete(truth))
        recording, states = blob_scene(name, seed)
        if duration is not None and duration < states.duration:
            recording = recording[: float(duration)]
        save(recording, partial)
        if table is not None:
            times = np.arange(0, recording.stop + 1, 1000)
            write_states(table, times, states(times), states.visible(times))
    _print_stored(recording, out)


def _simulate_motion(
    name: str,
    truth: Path | None,
    out: Path,
    seed: int,
    duration: float | int,
    size: tuple[int, int],
    *,
    change: str,
    sensor: str | None,
    speed: str | None,
) -> None:
    import numpy as np

    from jaxevent.egomotion.pictures import write_known
    from jaxevent.io import save
    from jaxevent.io.output import complete
    from jaxevent.simulate import SENSORS, motion_scene

    try:
        pace = None if speed is None else float(speed)
    except ValueError:
        pace = math.nan
    if pace is not None and not 0 < pace < math.inf:
        raise InputError(f"--speed {speed} is not possible; give a number above 0, such as 1.5")
    with contextlib.ExitStack() as stack:
        partial = stack.enter_context(complete(out))
        table = None if truth is None else stack.enter_context(complete(truth))
        # The field of view is always that of 240 px and f = 200 px.
        recording, source = motion_scene(
            name, change, seed, size=size, focal=size[0] / 1.2, duration=duration, speed=pace,
            sensor=None if sensor is None else SENSORS[sensor],
        )  # fmt: skip
        save(recording, partial)
        if table is not None:
            times = np.arange(0, round(1e6 * duration) + 1, 1000)
            T, Omega = source.twist(times)
            heading = T / np.maximum(np.linalg.norm(T, axis=1, keepdims=True), 1e-12)
            kinds = {"planar": source.velocity, "rotation": lambda _: Omega}
            values = kinds.get(name, lambda _: np.concatenate([heading, Omega], 1))(times)
            write_known(table, name if name in kinds else "general", times, values)
    _print_stored(recording, out)


def info(path: Path, size: tuple[int, int] | None, stream: str | None) -> None:
    from jaxevent.describe import describe
    from jaxevent.io import load

    recording = load(path, size, in_memory=False, progress=_progress(), stream=stream)
    lines = [("file", str(path)), *describe(recording, progress=_progress())]
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        print(f"{name:{width}}  {text}")


def demo(out: Path) -> None:
    from jaxevent.demo import demo as run

    run(out, progress=_progress())


if __name__ == "__main__":
    sys.exit(main())
