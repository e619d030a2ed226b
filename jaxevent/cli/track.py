"""The command `jaxevent track`."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.display import plural
from jaxevent.errors import InputError


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Track blobs: bright spots and other compact sources of events. Targets, their scales and "
        "the parameters that suit them are found in the recording; what is given in --params or "
        "with --seed wins. Without suffix the output is a folder of tracks.csv, tracks.h5, "
        "tracks.mp4, tracks.png and params.toml; with one it is the file of that kind. Tables have "
        "a row for each track and time.",
        "stars.h5 --out stars",
        "dot.h5 --seed 320,240,20 --rate 2000 --out dot.csv",
        "car.h5 --seed 400,300,15 --seed 460,300,15 --pair 0,1 --out car",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording; frames are not needed")
    one.add_argument(
        "--method",
        metavar="NAME",
        default="moment",
        help="moment, chi2, chi2_split, constant_velocity, moving_moments, or one of your own, "
        "package.module:object; default: moment",
    )
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
        type=arguments.seed,
        action="append",
        help="where a blob is (px), how large (standard deviation of its events, px) and from when "
        "(s, default: the start); may be repeated. Without, targets are found",
    )
    one.add_argument(
        "--detect",
        action="store_true",
        help="tracks begin where events are many on a grid, as --params says, instead of the "
        "search through the whole recording; with seeds: further ones",
    )
    one.add_argument(
        "--filtered",
        action="store_true",
        help="states rest on the events up to each time, as they are known while events come; "
        "default: on all, where the method can",
    )
    one.add_argument(
        "--accuracy",
        metavar="SHARE",
        type=float,
        help="events share steps while positions are at most by this share less certain than event "
        "by event, e.g. 0.05; default: about 32 steps in the window that is found",
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
    arguments.add_reading(one)
    _add_quantities(one)
    arguments.add_output(one, "--out", metavar="DIR_or_FILE", required=True, help="what to write")


def _add_quantities(one: Any) -> None:
    group = one.add_argument_group(
        "time to contact and range, in quantities.csv, the plot and, with --at events, for each "
        "event in quantities.h5"
    )
    group.add_argument(
        "--pair",
        metavar="ID,ID",
        dest="pairs",
        type=arguments.pair,
        action="append",
        help="two tracks whose distance tells 1 / TTC; may be repeated",
    )
    group.add_argument("--extent", metavar="M", type=float, help="the target's size in m")
    group.add_argument("--focal", metavar="PX", type=float, help="focal length in px")
    group.add_argument(
        "--size-factor",
        metavar="K",
        type=float,
        help="lambda over the diameter in the image; default: 0.354, of an even rim",
    )


def run(
    *,
    path: Path,
    method: str,
    params: Path | None,
    seeds: list[tuple[float, ...]] | None,
    detect: bool,
    filtered: bool,
    accuracy: float | int | None,
    rate: float | int,
    at: str | None,
    start: float | int | None,
    stop: float | int | None,
    background: str,
    reading: dict[str, Any],
    pairs: list[tuple[int, int]] | None,
    extent: float | int | None,
    focal: float | int | None,
    size_factor: float | int | None,
    out: Path,
) -> None:
    from jaxevent import methods
    from jaxevent.blob import find
    from jaxevent.blob.search.found import check_accuracy
    from jaxevent.io import toml
    from jaxevent.show.tracks import Output

    tracker = methods.find(method, "blob")
    given = None if params is None else tracker.Params.load(params, method)  # told before the work
    each = None if at == "events" else rate
    output = Output(out, each, background, pairs or (), extent, focal, size_factor)
    recording = arguments.open_recording(path, reading)
    recording = dataclasses.replace(recording, name=str(path))  # for messages
    if not len(recording.events):
        raise InputError(f"{path}: holds no events to track; choose another recording")
    check_accuracy(accuracy)
    if accuracy is not None and (seeds is not None or detect):
        raise InputError("--accuracy is for targets that are found; leave out --seed and --detect")
    span: dict[str, Any] = {"start": start, "stop": stop}
    clock = time.perf_counter()
    options: dict[str, Any] = {"seeds": seeds, "detect": detect, **span}
    found = None
    if seeds is None and not detect:
        found = find(recording, **span, progress=show_progress())
        print(found.summary())
        settings = found.settings(accuracy)
        given = tracker.Params(**settings)
        if params is not None:
            given = tracker.Params.load(params, method, settings)
        if accuracy is not None and given.events_per_step == settings.get("events_per_step"):
            print(
                f"{given.events_per_step} events per step, so that positions are at most "
                f"{100 * accuracy:.3g} % less certain than event by event"
            )
        options = {"found": found, **span}
    smooth = False if filtered else None
    tracks = tracker.estimate(recording, given, **options, smooth=smooth, progress=show_progress())
    seconds = time.perf_counter() - clock
    texts = {"params.toml": toml.parameters(tracks.params) + "\n"}
    written = output.write(tracks, show_progress(), texts, tracker.name)
    count = recording.events.index(tracks.stop) - recording.events.index(tracks.start)
    print("\n".join(written.summary()) if len(tracks) else _nothing(found))
    if written.left_out:
        print("\n" + "\n".join(written.left_out))
    how = ", ".join(written.files) + f" in {out}" if not out.suffix else str(out)
    slow = "" if written.slow is None else f"; the video plays at {written.slow:.3g} of real time"
    print(
        f"\n{how}: {len(tracks):,} {plural('track', len(tracks))}, {count:,} events in "
        f"{seconds:.2f} s, {count / seconds:,.0f} events/s{slow}"
    )


def _nothing(found: Any) -> str:
    """What to say where no blob was tracked, of what was found without settings, or None."""
    if found is not None and found.camera_moves:
        return (
            "the camera moves, and no blob was found that goes its own way; jaxevent motion tells "
            "how the camera moves, --seed X,Y,SIZE says where a blob is"
        )
    if found is not None and found.full:
        return (
            "no blob was found, and most of the image changes: if the camera moves, jaxevent "
            "motion tells how; --seed X,Y,SIZE says where a blob is"
        )
    return "no blob was found; say where one is with --seed X,Y,SIZE, or try --detect"
