"""The command line: demo, info, convert, register, reconstruct, track, motion and so on.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence

import jaxevent
from jaxevent.cli import (
    convert,
    demo,
    evaluate,
    fit,
    info,
    motion,
    reconstruct,
    register,
    simulate,
    track,
)
from jaxevent.errors import InputError

# In the order of `jaxevent --help`.
COMMANDS = (
    demo, info, convert, register, reconstruct, track, motion, evaluate, fit, simulate,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: the process's arguments); returns the exit status.

    0: done; 1: the output was not read to its end; 2: bad input or arguments (argparse exits with
    2 by itself); 130: interrupted.
    """
    arguments = vars(_parser().parse_args(argv))
    command = arguments.pop("command")
    try:
        command(**arguments)
        sys.stdout.flush()
    except InputError as error:
        print(f"jaxevent: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Python flushes stdout once more at exit, which must not fail again.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxevent",
        description="Video of high rate and dynamic range, tracks, and motion, from event cameras.",
        epilog="example:\n  jaxevent demo",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxevent {jaxevent.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for module in COMMANDS:
        module.add(commands)
    return parser
