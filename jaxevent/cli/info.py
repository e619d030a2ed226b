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
    arguments.add_size(one)
    arguments.add_stream(one)


def run(path: Path, size: tuple[int, int] | None, stream: str | None) -> None:
    from jaxevent.io import load
    from jaxevent.show.describe import describe

    recording = load(path, size, in_memory=False, progress=show_progress(), stream=stream)
    lines = [("file", str(path)), *describe(recording, progress=show_progress())]
    width = max(len(name) for name, _ in lines)
    for name, text in lines:
        print(f"{name:{width}}  {text}")
