"""The command `jaxevent register`."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, Literal

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, print_stored, show_progress
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Bring the frames of a separate camera onto the event camera's pixels and clock, and store "
        "both as one recording. From a calibration, or else by a homography, for scenes that are "
        "far away or flat, which is estimated from the recordings, as is the offset of the clocks.",
        "events.raw --frames camera --out both.h5",
        "events.h5 --frames camera.bag --calibration rig.toml --depth 2.5 --out both.h5",
        "events.raw --frames camera --triggers --out both.h5",
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
        help="HDR images of another camera, which become the reference of `jaxevent evaluate`",
    )
    one.add_argument(
        "--homography",
        metavar="CSV",
        type=Path,
        help="three lines of three numbers, from pixels of the event camera to the other's",
    )
    one.add_argument(
        "--calibration",
        metavar="FILE",
        type=Path,
        help="both cameras and the transform between them: camchain.yaml of Kalibr, or TOML, see "
        "jaxevent.register.Rig.read",
    )
    one.add_argument(
        "--cameras",
        metavar="NAME,NAME",
        type=arguments.names,
        help="the event camera and the other one in a camchain, for example cam1,cam0; default: by "
        "their sizes, else the first two",
    )
    one.add_argument(
        "--depth",
        metavar="M_or_NPY",
        type=arguments.number_or_path,
        help="depth of the scene in m, a number or a map of the event camera's pixels; "
        "default: infinity",
    )
    one.add_argument(
        "--plane",
        metavar="A,B,C,D",
        type=arguments.plane,
        help="plane of the scene, a x + b y + c z = d (m), instead of --depth; write "
        "--plane=A,... if A is negative",
    )
    _add_clock(one)
    one.add_argument(
        "--exposure",
        metavar="S",
        type=float,
        help="exposure time in s of images in a folder, if its timestamps do not state it",
    )
    one.add_argument(
        "--white", metavar="V", type=float, help="pixel value of intensity 1; default: the largest"
    )
    one.add_argument(
        "--crop", action="store_true", help="crop to a rectangle of pixels that both cameras see"
    )
    arguments.add_frames(one, "--images", "OTHER")
    arguments.add_reading(one, frames=False)
    arguments.add_output(one, "--out", metavar="FILE", required=True, help="the HDF5 file to write")


def _add_clock(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--offset",
        metavar="S",
        type=float,
        help="offset in s added to the other camera's time stamps; default: estimated",
    )
    one.add_argument(
        "--triggers",
        metavar="EDGE",
        nargs="?",
        const="auto",
        choices=["auto", "rising", "falling", "exposure"],
        help="take the stamps of frames from the event camera's external triggers, and fit the lag "
        "from these to mid-exposure, or take --offset for it: at rising or falling edges, or "
        "halfway between both (exposure); default: exposure where there are both edges",
    )
    one.add_argument(
        "--channel", metavar="N", type=int, help="channel of the triggers, if there are several"
    )
    one.add_argument("--search", metavar="S", type=float, help="largest possible offset in s")


def _check(given: set[str]) -> None:
    """Raise `InputError` for options that do not go together, of those that are given."""
    for one, other in (("homography", "calibration"), ("depth", "plane")):
        if {one, other} <= given:
            raise InputError(f"--{one} and --{other} say the same; leave one of them out")
    for name in ("depth", "plane", "cameras"):
        if name in given and "calibration" not in given:
            raise InputError(f"--{name} needs --calibration; add it or leave --{name} out")
    if "channel" in given and "triggers" not in given:
        raise InputError("--channel is that of triggers; add --triggers or leave it out")
    for name in ("triggers", "crop"):
        if {name, "reference"} <= given:
            raise InputError(f"--{name} is for frames; leave it out with --reference")
    if {"offset", "search"} <= given and "triggers" not in given:
        raise InputError("--search is for an offset that is not known; leave it out with --offset")


def run(
    *,
    path: Path,
    frames: Path | None,
    reference: Path | None,
    homography: Path | None,
    calibration: Path | None,
    depth: float | Path | None,
    plane: tuple[float, float, float, float] | None,
    offset: float | int | None,
    triggers: Literal["auto", "rising", "falling", "exposure"] | None,
    channel: int | None,
    search: float | int | None,
    exposure: float | int | None,
    white: float | int | None,
    crop: bool,
    images: str | None,
    cameras: tuple[str, str] | None,
    reading: dict[str, Any],
    out: Path,
) -> None:
    from jaxevent import register as rig
    from jaxevent.io import save
    from jaxevent.io.output import check_recording_name, complete

    check_recording_name(out)
    given = {
        "homography": homography, "calibration": calibration, "depth": depth, "plane": plane,
        "offset": offset, "search": search, "channel": channel, "triggers": triggers,
        "reference": reference, "crop": crop or None, "cameras": cameras,
    }  # fmt: skip
    _check({name for name, value in given.items() if value is not None})
    lag, offset = (offset, None) if triggers is not None else (None, offset)
    source = frames or reference
    assert source is not None
    other = rig.read_frames(
        source,
        reference=reference is not None,
        exposure=exposure,
        white=white,
        frames=images,
        progress=show_progress(),
    )
    recording, name = arguments.open_named(path, reading)
    seen, grid = (recording.width, recording.height), None
    if calibration is not None:
        sizes = (seen, (other.width, other.height))
        known = rig.Rig.read(calibration, recording.camera, cameras=cameras, sizes=sizes)
        recording = dataclasses.replace(recording, camera=known.events)
        far = {} if depth is None else {"depth": rig.read_depth(depth, seen)}
        grid = known.grid(seen, (other.width, other.height), plane=plane, **far)
    H = None if homography is None else rig.read_homography(homography)
    # Opened first, so that a place that cannot be written is reported before the work.
    with complete(out) as partial:
        found = rig.estimate(
            recording, other, grid, homography=H, offset=offset, search=search,
            progress=show_progress(),
        )  # fmt: skip
        if triggers is not None:
            frames_given = len(other.frames) if other.frames else 0
            other, found = rig.stamp_by_triggers(
                recording, other, found, triggers, channel, lag=lag
            )
        both = rig.apply_registration(
            recording, other, found, crop=crop, reference=reference is not None
        )
        save(dataclasses.replace(both, name=name), partial, progress=show_progress())
    if found.homography is not None and H is None:
        print("homography from the event camera's pixels to the other's:")
        for row in found.homography:
            print("  " + ", ".join(f"{value:.9g}" for value in row))
    how = "given" if offset is not None or lag is not None else "estimated"
    if triggers is not None:
        print(f"frames with a trigger: {len(other.frames or ())} of {frames_given}")
        print(f"lag from triggers to mid-exposure, {how}: {found.offset:.6f} s")
    else:
        print(f"offset added to the other camera's time stamps, {how}: {found.offset:.6f} s")
    if found.agreement is not None:
        print(f"correlation of the changes that frames and events show: {found.agreement:.3f}")
    print(f"pixels that the other camera sees: {rig.coverage(found.grid):.1%}")
    print_stored(both, out)
