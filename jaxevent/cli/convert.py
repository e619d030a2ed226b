"""The command `jaxevent convert`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, print_stored, show_progress


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Store a recording as HDF5. The file opens at once and need not fit in memory.",
        "slider_depth.zip slider_depth.h5",
        "stereo.bag left.h5 --stream /davis/left/events",
        "slider_depth.zip small.h5 --compression gzip",
        "wrapped.h5 whole.h5 --repair unwrap,sort",
    )
    one.add_argument("source", metavar="SRC", type=Path, help="a recording")
    arguments.add_output(one, "target", metavar="DST", help="the HDF5 file to write")
    one.add_argument("--compression", choices=["gzip"], help="smaller, but slower to read")
    one.add_argument(
        "--trust",
        action="store_true",
        help="read HDF5 that is made of other files; it could name any file of yours",
    )
    one.add_argument(
        "--repair",
        metavar="HOW",
        help="mend event times that go back: sort (events late by at most 10 ms), drop (outliers), "
        "unwrap (a counter), part (the longest between resets) or part:N, joined by commas",
    )
    arguments.add_reading(one)


def run(
    source: Path,
    target: Path,
    compression: str | None,
    trust: bool,
    repair: str | None,
    reading: dict[str, Any],
) -> None:
    from jaxevent.io import save

    recording = arguments.open_recording(source, reading, trust=trust, repair=repair)
    save(recording, target, compression, progress=show_progress())
    print_stored(recording, target)
    for note in recording.notes:
        print(f"{target}: {note}")
