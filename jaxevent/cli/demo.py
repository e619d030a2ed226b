"""The command `jaxevent demo`."""

from pathlib import Path
from typing import Any

from jaxevent.cli.arguments import command, show_progress


def add(commands: Any) -> None:
    one = command(
        commands,
        run,
        "Reconstruct a short recording with every method. It writes a table of errors, a figure "
        "and a slow-motion video, and prints the table.",
        "",
        "--out my-demo",
    )
    one.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("jaxevent-demo"),
        help="default: %(default)s",
    )


def run(out: Path) -> None:
    from jaxevent.runs.demo import demo

    demo(out, progress=show_progress())
