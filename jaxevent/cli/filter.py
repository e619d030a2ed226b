"""The command `jaxevent filter`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, print_stored, show_progress


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Store a recording without some of its events, as HDF5. The steps are taken in the order "
        "in which they are listed here; each is left out unless it is asked for.",
        "street.raw clean.h5 --hot-pixels --background 5000",
        "street.raw part.h5 --start 1 --stop 2.5 --crop 200 100 320 240",
        "street.raw small.h5 --downsample 2 --refractory 1000 --polarity on",
    )
    one.add_argument("source", metavar="SRC", type=Path, help="a recording")
    arguments.add_output(one, "target", metavar="DST", help="the HDF5 file to write")
    arguments.add_reading(one)
    steps = one.add_argument_group("steps")
    steps.add_argument("--start", metavar="S", type=float, help="on the recording's clock, in s")
    steps.add_argument(
        "--stop",
        metavar="S",
        type=float,
        help="end of the events kept, exclusive, in s on the recording's clock",
    )
    steps.add_argument("--hot-pixels", action="store_true", help="leave out pixels that are hot")
    steps.add_argument(
        "--crop",
        metavar=("X", "Y", "W", "H"),
        type=int,
        nargs=4,
        help="keep W x H pixels from (X, Y) on, which becomes (0, 0)",
    )
    steps.add_argument(
        "--undistort", action="store_true", help="as a camera without distortion sees it"
    )
    steps.add_argument(
        "--background",
        metavar="US",
        type=int,
        help="leave out events with no event in the 8 pixels around in the last US microseconds",
    )
    steps.add_argument(
        "--refractory",
        metavar="US",
        type=int,
        help="leave out events less than US microseconds after the one kept before at their pixel",
    )
    steps.add_argument("--polarity", choices=["on", "off"], help="keep one polarity")
    steps.add_argument(
        "--downsample", metavar="N", type=int, help="make one pixel of each N x N pixels"
    )
    steps.add_argument(
        "--period",
        metavar="US",
        type=int,
        help="keep one event for each pixel and polarity in US microseconds",
    )
    one.add_argument("--compression", choices=["gzip"], help="smaller, but slower to read")


def run(
    *,
    source: Path,
    target: Path,
    reading: dict[str, Any],
    start: float | int | None,
    stop: float | int | None,
    hot_pixels: bool,
    crop: list[int] | None,
    undistort: bool,
    background: int | None,
    refractory: int | None,
    polarity: str | None,
    downsample: int | None,
    period: int | None,
    compression: str | None,
) -> None:
    import dataclasses

    from jaxevent import events
    from jaxevent.errors import InputError
    from jaxevent.io import save
    from jaxevent.recording import Recording

    recording, name = arguments.open_named(source, reading)
    steps: list[tuple[str, Callable[[Recording], Recording]]] = []
    if start is not None or stop is not None:
        steps.append(("cut in time", lambda r: r[start:stop]))
    if hot_pixels:
        steps.append(("hot pixels", _remove_hot_pixels))
    if crop is not None:
        steps.append(("crop", lambda r: events.crop(r, *crop)))
    if undistort:
        steps.append(("undistort", events.undistort))
    if background is not None:
        steps.append(("background", lambda r: events.filter_background(r, background)))
    if refractory is not None:
        steps.append(("refractory", lambda r: events.filter_refractory(r, refractory)))
    if polarity is not None:
        steps.append(("polarity", lambda r: events.select_polarity(r, polarity == "on")))
    if downsample is not None or period is not None:
        factor = 1 if downsample is None else downsample
        steps.append(("downsample", lambda r: events.downsample(r, factor, period or 0)))
    if not steps:
        raise InputError(
            f"{source}: no filter is given; name a step, for example --hot-pixels, "
            "or use jaxevent convert"
        )
    counts = [("events", len(recording.events))]
    for title, step in steps:
        recording = step(recording)
        counts.append((title, len(recording.events)))
    if not len(recording.events):
        raise InputError(f"{source}: no event is left; take less away")
    save(dataclasses.replace(recording, name=name), target, compression, progress=show_progress())
    width = max(len(f"{count:,}") for _, count in counts)
    for title, count in counts:
        share = 100 * count / max(counts[0][1], 1)
        print(f"{title:12} {count:>{width},}  {share:5.1f} %")
    print_stored(recording, target)


def _remove_hot_pixels(recording: Any) -> Any:
    """Remove the hot pixels that `jaxevent info` and `jaxevent calibrate` report."""
    from jaxevent.calibration.event_calibration import count_parts
    from jaxevent.calibration.hot import find_hot_pixels
    from jaxevent.events import remove_hot_pixels

    return remove_hot_pixels(recording, find_hot_pixels(count_parts(recording).sum(1)))
