"""The command `jaxevent demo`."""

from pathlib import Path
from typing import Any

from jaxevent.cli import arguments
from jaxevent.cli.arguments import command, show_progress

DEFAULT_FOLDER = Path("jaxevent-demo")


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Reconstruct a short recording with every method. It writes a table of errors, a figure "
        "and a slow-motion video, and prints the table.",
        "",
        "--out my-demo",
    )
    arguments.add_output(
        one,
        "--out",
        shared=True,
        metavar="DIR",
        default=DEFAULT_FOLDER,
        help="default: %(default)s, whose files are replaced without --force",
    )


def run(out: Path, force: bool) -> None:
    from jaxevent.runs.demo import demo

    demo(out, progress=show_progress(), replace=force or out == DEFAULT_FOLDER)
