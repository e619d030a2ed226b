"""The command `jaxevent view`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command
from jaxevent.display import format_count
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Show a recording and what was estimated from it on one timeline, in the Rerun viewer: "
        "events, frames, reconstructed images, tracks, motion.",
        "slider_depth.zip",
        "street.npz images.h5 tracks --start 1 --stop 3",
        "spin.h5 moved --out spin.rrd",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    one.add_argument(
        "results",
        metavar="RESULT",
        type=Path,
        nargs="*",
        help="images with times, as reconstruct writes in HDF5, or the folder or table of track or "
        "motion",
    )
    arguments.add_span(one)
    one.add_argument(
        "--window",
        metavar="MS",
        type=float,
        default=10.0,
        help="events that are shown together; default: 10 ms",
    )
    arguments.add_reading(one)
    arguments.add_output(
        one, "--out", metavar="FILE", help="store it (.rrd) instead of opening the viewer"
    )


def run(
    *,
    path: Path,
    results: list[Path],
    start: float | int | None,
    stop: float | int | None,
    window: float | int,
    reading: dict[str, Any],
    out: Path | None,
) -> None:
    from jaxevent.show.viewer import view

    recording = arguments.open_recording(path, reading)
    if start is not None or stop is not None:
        recording = recording[start:stop]
    if not len(recording.events):
        raise InputError(f"{path}: holds no events, or none from --start to --stop")
    view(recording, *results, out=out, window=window / 1e3)
    if out is not None:
        print(f"{out}: {format_count(len(recording.events), 'event')}; open it with: rerun {out}")
