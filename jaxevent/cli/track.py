"""The command `jaxevent track`."""

import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.display import format_count
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
        "- --live --size 240,180 --seed 120,90,8",
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
        help="initial position (px) and size (standard deviation of its events, px) of a blob, "
        "and its start time (s; default: the start of the recording); may be repeated. "
        "Without seeds the targets are found automatically",
    )
    one.add_argument(
        "--detect",
        action="store_true",
        help="start tracks in grid cells with many events, as set in --params, instead of "
        "searching the whole recording; with seeds: in addition to them",
    )
    one.add_argument(
        "--filtered",
        action="store_true",
        help="causal estimates, from the events up to each time; default: smoothed over the "
        "whole recording, if the method can",
    )
    one.add_argument(
        "--accuracy",
        metavar="SHARE",
        type=float,
        help="process events in batches; allow this relative loss of position accuracy against "
        "single events, e.g. 0.05; default: about 32 batches per window",
    )
    when = one.add_mutually_exclusive_group()
    when.add_argument(
        "--rate", metavar="HZ", type=float, default=1000.0, help="rows per second; default: 1000"
    )
    when.add_argument("--at", choices=["events"], help="one row for each event of a track")
    arguments.add_span(one)
    one.add_argument(
        "--background",
        choices=["events", "high-pass"],
        default="events",
        help="background of the video; default: events",
    )
    arguments.add_live(one, "rows of tracks.csv of --seed or --detect, as with --filtered,")
    arguments.add_reading(one)
    _add_quantities(one)
    arguments.add_output(
        one,
        "--out",
        metavar="DIR_or_FILE",
        help="output folder or file; needed without --live",
    )


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
        help="two tracks whose distance gives 1 / TTC; may be repeated",
    )
    group.add_argument("--extent", metavar="M", type=float, help="size of the target in m")
    group.add_argument("--focal", metavar="PX", type=float, help="focal length in px")
    group.add_argument(
        "--size-factor",
        metavar="K",
        type=float,
        help="ratio of lambda to the diameter in the image; default: 0.354, a uniform rim",
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
    live: bool,
    reading: dict[str, Any],
    pairs: list[tuple[int, int]] | None,
    extent: float | int | None,
    focal: float | int | None,
    size_factor: float | int | None,
    out: Path | None,
) -> None:
    from jaxevent import methods
    from jaxevent.blob import find
    from jaxevent.blob.params import check_accuracy
    from jaxevent.io import toml
    from jaxevent.show.tracks import Output

    tracker = methods.find(method, "blob")
    given = None if params is None else tracker.Params.load(params, method)  # read before the work
    if live:
        options = {
            "--accuracy": accuracy, "--at": at, "--start": start, "--stop": stop, "--pair": pairs,
            "--extent": extent, "--focal": focal, "--size-factor": size_factor, "--out": out,
        }  # fmt: skip
        arguments.refuse_with_live({name: value is not None for name, value in options.items()})
        if seeds is None and not detect:
            raise InputError("--live cannot search all events for targets; add --seed or --detect")
        chosen = {"seeds": seeds, "detect": detect, "rate": float(rate)}
        _print_live(path, tracker, given, **chosen, reading=reading)
        return
    if out is None:
        raise InputError("there is nowhere to write; give a folder or file, --out, or --live")
    each = None if at == "events" else rate
    output = Output(out, each, background, pairs or (), extent, focal, size_factor)
    recording, _ = arguments.open_named(path, reading)
    if not len(recording.events):
        raise InputError(f"{path}: holds no events to track; choose another recording")
    recording.refuse_one_time(str(path))
    check_accuracy(accuracy)
    if accuracy is not None and (seeds is not None or detect):
        raise InputError("--accuracy is for targets that are found; leave out --seed and --detect")
    arguments.warn_of_faults(recording, frames=False)
    span: dict[str, Any] = {"start": start, "stop": stop}
    clock = time.perf_counter()
    options: dict[str, Any] = {"seeds": seeds, "detect": detect, **span}
    found = None
    if seeds is None and not detect:
        found = find(recording, **span, progress=show_progress())
        print(found.summary())
        if len(found) and found.full and not found.camera_moves:
            print(
                "most of the image changes: if the camera moves, tracks may be pieces of its "
                "scene; jaxevent motion tells how it moves"
            )
        if not found.compact:
            print(
                "a target covers a quarter of the sensor: no compact blobs here; they explain "
                f"{found.score:.2g} nats per event"
            )
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
    print("\n".join(written.summary()) if len(tracks) else _explain_no_tracks(found))
    if written.left_out:
        print("\n" + "\n".join(written.left_out))
    how = ", ".join(written.files) + f" in {out}" if not out.suffix else str(out)
    slow = "" if written.slow is None else f"; the video plays at {written.slow:.3g} of real time"
    print(
        f"\n{how}: {format_count(len(tracks), 'track')}, {format_count(count, 'event')} in "
        f"{arguments.describe_speed(count, seconds)}{slow}"
    )


def _print_live(
    path: Path,
    tracker: Any,
    params: Any,
    *,
    seeds: list[tuple[float, ...]] | None,
    detect: bool,
    rate: float,
    reading: dict[str, Any],
) -> None:
    """Print rows of tracks.csv as events come, those of a time with the first event after it.

    Args:
        path: The recording; "-" is standard input.
        tracker: The method.
        params: Parameters of the method.
        seeds: (x, y, ...) of known targets, see `jaxevent.blob.tracker`; None: there are none.
        detect: Whether to look for targets.
        rate: Rows per second.
        reading: Options of `arguments.add_reading`.
    """
    from jaxevent.show.track_tables import LiveTable

    recording, chunks = arguments.open_live(path, reading)
    size = recording.width, recording.height
    table = LiveTable(tracker.live(size, params, seeds=seeds, detect=detect), rate)
    print(table.header, end="", flush=True)
    for events in chunks:
        print(table.add(events), end="", flush=True)
    print(table.finish(), end="", flush=True)


def _explain_no_tracks(found: Any) -> str:
    """Explain why no blob was tracked, given the result of the search, or None."""
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
