"""The command `jaxevent flow`."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress
from jaxevent.display import format_count


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Estimate dense optical flow from the events alone. The name of the output tells its kind: "
        ".h5 holds times, flow (px/s), its covariance and where it is valid; .mp4 is a video in "
        "colours, one for each direction; without suffix it is a folder of PNG images of the kind "
        "of the DSEC data set, with the displacements (px) from each time to the next.",
        "slider_depth.zip --out slider_flow.h5",
        "drone.raw --rate 10 --start 2 --stop 3 --out drone_flow",
        "bike.h5 --times wanted.csv --causal --out bike_flow.h5",
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording; frames are not needed")
    when = one.add_mutually_exclusive_group()
    when.add_argument(
        "--rate", metavar="HZ", type=float, default=10.0, help="times per second; default: 10"
    )
    when.add_argument(
        "--times",
        metavar="FILE_or_LIST",
        type=Path,
        help="flow at each time of a list 0.5,0.6 or of a text or CSV file: one in each "
        "line, or its column t; whole numbers are microseconds, others seconds",
    )
    one.add_argument(
        "--start", metavar="S", type=float, help="first time, in s on the recording's clock"
    )
    one.add_argument(
        "--stop", metavar="S", type=float, help="end, exclusive, in s on the recording's clock"
    )
    one.add_argument(
        "--params",
        metavar="FILE",
        type=Path,
        help="TOML file of name = value lines, e.g. displacement = 4",
    )
    one.add_argument("--causal", action="store_true", help="use no events after a time")
    arguments.add_reading(one, frames=False)
    arguments.add_output(
        one, "--out", metavar="DIR_or_FILE", required=True, help="name in .h5, .mp4 or none"
    )


def run(
    *,
    path: Path,
    rate: float | int,
    times: Path | None,
    start: float | int | None,
    stop: float | int | None,
    params: Path | None,
    causal: bool,
    reading: dict[str, Any],
    out: Path,
) -> None:
    from jaxevent.event_flow import FlowParams, flow_from_events
    from jaxevent.io.images import read_times
    from jaxevent.show.export import image_times, within
    from jaxevent.show.flow import flow_writer

    write = flow_writer(out)
    values = FlowParams() if params is None else FlowParams.load(params)
    recording = arguments.open_recording(path, reading)
    recording.refuse_empty(str(path))
    recording.refuse_one_time(str(path))
    alone = dataclasses.replace(recording, frames=None, name=str(path))
    span = alone.event_span()
    wanted = read_times(times, span) if times else image_times(alone, rate, start, stop)
    chosen = within(wanted, start, stop, str(path))
    arguments.warn_of_faults(dataclasses.replace(recording, name=str(path)), frames=False)
    clock = time.perf_counter()
    write(flow_from_events(recording, values, causal=causal), chosen, out, show_progress())
    seconds = time.perf_counter() - clock
    print(f"{out}: flow at {format_count(len(chosen), 'time')}, {seconds:.2f} s")
