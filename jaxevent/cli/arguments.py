"""What the commands share: their parsers, values of options, progress, what was stored."""

import argparse
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any


def command(
    commands: Any, run: Callable, description: str, *examples: str
) -> argparse.ArgumentParser:
    """Add a command, named by the module of `run`, which takes the parsed options."""
    name = run.__module__.rpartition(".")[2]
    lines = "".join(f"\n  jaxevent {name} {example}".rstrip() for example in examples)
    one = commands.add_parser(
        name,
        help=description.partition(".")[0],
        description="\n".join(textwrap.wrap(description, 79)),
        epilog=f"example{'s' * (len(examples) > 1)}:{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.set_defaults(command=run)
    return one


def add_size(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--size",
        metavar="W,H",
        type=size,
        help="sensor size in pixels, for a recording that does not tell it",
    )


def add_stream(one: argparse.ArgumentParser) -> None:
    one.add_argument(
        "--stream",
        metavar="NAME",
        help="which camera, of a file that holds several: a topic, left, right or a number",
    )


def size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(number) for number in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not W,H, for example 240,180") from None
    return width, height


def seed(text: str) -> tuple[float, ...]:
    return _numbers(text, (3, 4), float, "X,Y,SIZE or X,Y,SIZE,T, for example 120,90,8")


def pair(text: str) -> tuple[int, ...]:
    return _numbers(text, (2,), int, "ID,ID, for example 0,1")


def plane(text: str) -> tuple[float, ...]:
    return _numbers(text, (4,), float, "A,B,C,D, for example 0,0,1,2.5")


def span(text: str) -> tuple[float, ...]:
    return _numbers(text, (2,), float, "START,STOP in seconds, for example 0,0.5")


def _numbers(text: str, counts: tuple[int, ...], kind: Callable, meant: str) -> tuple:
    try:
        numbers = tuple(kind(number) for number in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in counts:
        raise argparse.ArgumentTypeError(f"{text!r} is not {meant}")
    return numbers


def show_progress() -> bool:
    return sys.stderr.isatty()


def print_stored(recording: Any, path: Path) -> None:
    frames = len(recording.frames) if recording.frames else 0
    size_mb = path.stat().st_size / 1e6
    print(f"{path}: {len(recording.events):,} events, {frames} frames, {size_mb:.1f} MB")
