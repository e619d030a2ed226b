"""The command `jaxevent info`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress


def add(commands: Any) -> None:
    one = command(
        commands, run, "Describe a recording.", "slider_depth.zip", "events.npz --size 240,180"
    )
    one.add_argument("path", metavar="PATH", type=Path, help="a recording")
    arguments.add_reading(one)


def run(path: Path, reading: dict[str, Any]) -> None:
    from jaxevent.show.describe import describe

    recording = arguments.open_recording(path, reading)
    lines = [("file", str(path)), *describe(recording, progress=show_progress())]
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        print(f"{name:{width}}  {text}")
