"""The command line: demo, info, convert, register, reconstruct, track, motion and so on.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import hashlib
import os
import platform
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

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
    _keep_compiled()
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


def _keep_compiled() -> None:
    """Have JAX keep what it compiles in the user's cache folder; JAX's own variables win.

    By the variables, because the processes of `evaluate --workers` inherit them. The folder is
    named by the processor, whose instructions compiled programs use: homes are shared by machines.
    """
    if {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"} & os.environ.keys():
        return
    from platformdirs import user_cache_path

    about = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    name = hashlib.blake2b(about.encode(), digest_size=6).hexdigest()
    folder = user_cache_path("jaxevent", appauthor=False) / "compiled" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # no home, as in some containers: everything works without
        return
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
        # What cannot be kept, or was damaged, is compiled again.
        warnings.filterwarnings("ignore", "Error (read|writ)ing persistent compilation cache")


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
