"""The command `jaxevent camera`: responses of cameras, and HDR images."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, print_stored, show_progress
from jaxevent.errors import InputError

_STACK_HELP = (
    "a folder of images of one still scene, whose exposures are in exposures.txt of lines "
    "'s name' or in their EXIF data"
)


def add(commands: Any) -> None:
    camera = commands.add_parser(
        "camera",
        help="Responses of cameras and HDR images",
        description="What frames say of intensity: a camera's response from an exposure stack, HDR "
        "images merged of one, and both given to a recording.",
        epilog="example:\n  jaxevent camera response stack --out response.csv",
        formatter_class=arguments.HelpFormatter,
    )
    parts = camera.add_subparsers(title="parts", metavar="PART", required=True)
    _add_response(parts)
    _add_merge(parts)
    _add_attach(parts)
    _add_reference(parts)


def _add_response(parts: Any) -> None:
    one = command(
        parts,
        response,
        "Estimate a camera's response from images of one scene under different exposures (Debevec "
        "and Malik 1997), as CSV of grey value, intensity and certainty.",
        "stack --out response.csv",
        "stack --exposures 0.001 0.004 0.016 --out response.csv",
        part="response",
    )
    _add_stack(one)
    one.add_argument(
        "--smoothness", metavar="X", type=float, default=20, help="of the curve; default: 20"
    )
    one.add_argument(
        "--margin",
        metavar="N",
        type=int,
        default=4,
        help="grey levels from black and white that count as clipped; default: 4",
    )
    arguments.add_output(one, "--out", metavar="CSV", required=True, help="the file to write")


def _add_merge(parts: Any) -> None:
    one = command(
        parts,
        merge,
        "Merge images of one scene under different exposures into one of linear intensity.",
        "stack --response response.csv --out scene.npy",
        part="merge",
    )
    _add_stack(one)
    one.add_argument(
        "--response", metavar="CSV", type=Path, help="of the camera; default: estimated from these"
    )
    one.add_argument(
        "--white",
        metavar="S",
        type=float,
        help="exposure time whose white is intensity 1; default: the first image's",
    )
    arguments.add_output(
        one, "--out", metavar="FILE", required=True, help="name in .npy, or .tif for 32-bit floats"
    )


def _add_attach(parts: Any) -> None:
    one = command(
        parts,
        attach,
        "Store a recording with its camera's response, which methods then take into account.",
        "street.aedat4 --response response.csv --out street.h5",
        part="attach",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording with frames")
    one.add_argument("--response", metavar="CSV", type=Path, required=True, help="of its camera")
    arguments.add_reading(one)
    arguments.add_output(one, "--out", metavar="FILE", required=True, help="the HDF5 file to write")


def _add_reference(parts: Any) -> None:
    one = command(
        parts,
        reference,
        "Register an HDR image of a still scene to each frame of a recording, by features and a "
        "homography, and store it as the reference of `jaxevent evaluate`.",
        "street.h5 --image scene.npy --out truth.h5",
        part="reference",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording with frames")
    one.add_argument(
        "--image", metavar="FILE", type=Path, required=True, help="linear intensity, .npy or .tif"
    )
    one.add_argument(
        "--scale",
        metavar="X",
        type=float,
        help="by which it is multiplied, so that the frames' white is 1; default: estimated",
    )
    arguments.add_reading(one)
    arguments.add_output(one, "--out", metavar="FILE", required=True, help="the HDF5 file to write")


def _add_stack(one: argparse.ArgumentParser) -> None:
    one.add_argument("stack", metavar="FOLDER", type=Path, help=_STACK_HELP)
    one.add_argument(
        "--exposures",
        metavar="S",
        type=float,
        nargs="+",
        help="exposure times in s, in the order of the images' names",
    )


def response(
    stack: Path,
    exposures: list[float] | None,
    smoothness: float | int,
    margin: int,
    out: Path,
) -> None:
    from jaxevent.camera import estimate_response
    from jaxevent.io.images import read_stack, write_response

    images, seconds = read_stack(stack, exposures)
    found = estimate_response(images, seconds, smoothness=smoothness, margin=margin)
    write_response(out, found)
    known = int((found.weights > 0).sum())
    print(f"{out}: response of {len(images)} images, {known} of 256 grey levels were seen")


def merge(
    stack: Path,
    exposures: list[float] | None,
    response: Path | None,
    white: float | int | None,
    out: Path,
) -> None:
    import numpy as np

    from jaxevent.camera import estimate_response, merge_exposures
    from jaxevent.io.images import read_response, read_stack, write_intensity

    images, seconds = read_stack(stack, exposures)
    if response is None:
        camera = estimate_response(images, seconds)
    else:
        camera = read_response(response)
    image, variance = merge_exposures(images, seconds, camera, reference=white)
    write_intensity(out, image.astype(np.float32))
    bounded = float(np.mean(~np.isfinite(variance)))
    print(
        f"{out}: {image.shape[1]}x{image.shape[0]} pixels of {len(images)} images, intensity "
        f"{image.min():.4g} to {image.max():.4g}; clipped in all images: {bounded:.1%}"
    )


def attach(path: Path, response: Path, reading: dict[str, Any], out: Path) -> None:
    import numpy as np

    from jaxevent.io import save
    from jaxevent.io.images import read_response

    camera = read_response(response)
    recording = arguments.open_recording(path, reading)
    if recording.frames is None:
        missing = recording.describe_left_out("frames")
        raise InputError(
            f"{path}: holds no frames, of whose camera a response could be{missing}; give a "
            "recording with frames"
        )
    fitted = {"response": np.asarray(camera.levels), "certainty": np.asarray(camera.weights)}
    kept = {name: values for name, values in recording.extra.items() if name != "f_Q"}
    recording = dataclasses.replace(recording, extra={**kept, **fitted})
    save(recording, out, progress=show_progress())
    print_stored(recording, out)


def reference(
    path: Path,
    image: Path,
    scale: float | int | None,
    reading: dict[str, Any],
    out: Path,
) -> None:
    from jaxevent.io import save
    from jaxevent.io.images import read_intensity
    from jaxevent.register import register_still

    scene = read_intensity(image)
    recording, name = arguments.open_named(path, reading)
    found, homographies, factor = register_still(
        recording, scene, scale=scale, progress=show_progress()
    )
    save(dataclasses.replace(found, name=name), out, progress=show_progress())
    matched = sum(one is not None for one in homographies)
    how = "estimated" if scale is None else "given"
    print(f"frames that the image was registered to: {matched} of {len(homographies)}")
    print(f"scale from the image to intensity, {how}: {factor:.6g}")
    print_stored(found, out)
