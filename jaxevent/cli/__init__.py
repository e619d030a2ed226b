"""The command line: demo, info, calibrate, convert, reconstruct, track, motion and so on.

What cannot be used is said in one line on stderr, exit status 2. The libraries are imported by the
command that needs them, so that help appears at once.
"""

import argparse
import contextlib
import gc
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jaxevent
from jaxevent.cli import (
    calibrate,
    camera,
    convert,
    demo,
    evaluate,
    filter,
    fit,
    flow,
    info,
    motion,
    reconstruct,
    register,
    simulate,
    track,
    view,
)
from jaxevent.cli.arguments import CommandParser, HelpFormatter, guard_outputs
from jaxevent.errors import InputError, InputWarning, require

# In the order of `jaxevent --help`.
COMMANDS = (
    demo, info, calibrate, convert, filter, register, camera, reconstruct, track, motion, flow,
    evaluate, fit, simulate, view,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: the process's arguments); returns the exit status.

    0: done; 2: bad input or arguments (argparse exits with 2 by itself), or what was to be printed
    could not be; 130, 143, 129: interrupted, terminated, hung up; 141: nobody read the output to
    its end. The last are the numbers that a shell gives a tool which the signal killed, so that
    pipelines (`set -o pipefail`) take it as they take others.
    """
    _mend_streams()
    if argv is None:
        # No result comes sooner from a GPU, of whose memory JAX would take three quarters.
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        with _terminable(), _collect_seldom(ends=argv is None):
            try:
                arguments = vars(_parser().parse_args(argv))
            finally:
                sys.stdout.flush()  # help
            command = arguments.pop("command")
            words = ["jaxevent", *(sys.argv[1:] if argv is None else argv)]
            with guard_outputs(arguments, words) as options, _shown(words), _plain_warnings():
                command(**options)
            sys.stdout.flush()
    except InputError as error:
        _say(str(error))
        return 2
    except (_Signal, KeyboardInterrupt) as signalled:
        number = signalled.number if isinstance(signalled, _Signal) else signal.SIGINT
        if argv is None:
            # What JAX still computes in its threads crashes when Python takes itself down.
            with contextlib.suppress(OSError):
                sys.stdout.flush()
            os._exit(128 + number)
        return 128 + number
    except BrokenPipeError:
        _silence(sys.stdout)
        return 128 + signal.SIGPIPE if hasattr(signal, "SIGPIPE") else 1
    except OSError as error:
        # Errors within files are `InputError`s by now: what remains is that of a name, as one
        # that is too long, and of printing.
        if error.filename is not None:
            _say(
                f"{error.filename}: cannot be used ({error.strerror}); choose another name or place"
            )
            return 2
        if isinstance(error, FileNotFoundError):
            _say("the working folder is no longer there; change to another one")
            return 2
        _silence(sys.stdout)
        _say(f"what was to be printed cannot be written ({error.strerror or error})")
        return 2
    return 0


@contextlib.contextmanager
def _collect_seldom(ends: bool) -> Iterator[None]:
    """Look for garbage in cycles seldom, and not at all when the process `ends` with the block.

    Libraries and traces make many objects that stay. To look through them as often as usual takes a
    tenth of the CPU time of a short command, and to do so at the end another tenth.
    """
    usual = gc.get_threshold()
    gc.set_threshold(50_000, 20, 50)
    try:
        yield
    finally:
        gc.set_threshold(*usual)
        if ends:
            gc.freeze()


@contextlib.contextmanager
def _shown(words: Sequence[str]) -> Iterator[None]:
    """Name the running command in a terminal, unless it prints more itself."""
    if not sys.stderr.isatty():
        yield
        return
    from jaxevent.progress import stage

    with stage(" ".join(words[:2])), contextlib.redirect_stdout(_ProgressAwareStream(sys.stdout)):
        yield


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print each warning about input as one line, once, without the line of code that raised it."""
    with warnings.catch_warnings():
        usual, printed = warnings.showwarning, set()

        def show(message: Any, category: Any, *rest: Any, **more: Any) -> None:
            if issubclass(category, InputWarning):
                if str(message) not in printed:
                    _say(f"warning: {message}")
                printed.add(str(message))
            else:
                usual(message, category, *rest, **more)

        warnings.simplefilter("always", InputWarning)
        warnings.showwarning = show  # ty: ignore[invalid-assignment]
        yield


class _ProgressAwareStream(io.TextIOBase):
    """A stream that clears the line of progress before it writes."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        from jaxevent.progress import hide

        hide()
        return self._stream.write(text)

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    @property
    def encoding(self) -> str:
        return self._stream.encoding


class _Signal(BaseException):
    """A signal to end, which unwinds as an interrupt does."""

    def __init__(self, number: int):
        self.number = number


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP unwind the block, so that nothing incomplete is left behind.

    Compiled modules drop what is raised while they are imported, or crash, and Python drops what is
    raised in callbacks, as JAX has one in garbage collection. So a signal waits for the end of an
    import, and is raised again, twenty times a second, until the block unwinds.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_hook = sys.unraisablehook
    came: list[int] = []

    def leave(number: int, frame: Any) -> None:
        came.append(number)
        handle_again(number, frame)

    def handle_again(number: int, frame: Any) -> None:
        if not came:
            if callable(alarmed := before[number]):
                alarmed(number, frame)
            return
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            if _imports(frame) or _unwinds(sys.exc_info()[1]):
                return
        raise _Signal(came[0])

    def drop(dropped: Any) -> None:
        if not isinstance(dropped.exc_value, _Signal):
            previous_hook(dropped)

    before: dict[int, Any] = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # They are ignored under nohup.
        if number and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            before[number] = signal.signal(number, leave)
    if hasattr(signal, "SIGALRM"):
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, handle_again)
    sys.unraisablehook = drop
    try:
        yield
    except Exception as error:
        # What compiled code made of it.
        if came:
            raise _Signal(came[0]) from error
        raise
    finally:
        if hasattr(signal, "setitimer") and came:
            signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = previous_hook
        for number, handler in before.items():
            signal.signal(number, handler)


def _imports(frame: Any) -> bool:
    """Return true if a module was being imported when a signal came."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _unwinds(error: BaseException | None) -> bool:
    """Return true if a signal's exception is being handled."""
    while error is not None:
        if isinstance(error, _Signal):
            return True
        error = error.__context__
    return False


def _mend_streams() -> None:
    """Make stdout and stderr take any text, and fail where they are closed, not crash.

    A file that is opened next would get the number of a closed one, and what libraries say there.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _say(sentence: str) -> None:
    """Print on stderr why the command ends; do nothing if stderr cannot be written."""
    try:
        print(f"jaxevent: {' '.join(sentence.split())}", file=sys.stderr, flush=True)
    except OSError:
        _silence(sys.stderr)


def _silence(stream: Any) -> None:
    """Have Python's last flush of a stream, at exit, not fail again."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _PrintCompletion(argparse.Action):
    """Print the completion script that shtab makes of the parser, and exit."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        try:
            shtab = require("shtab", "completion")
        except InputError as error:
            parser.error(str(error))
        _complete_files(parser, shtab.FILE)
        print(shtab.complete(parser, values))
        parser.exit()


def _complete_files(parser: argparse.ArgumentParser, how: Any) -> None:
    """Have shells complete the names of files in all arguments that are paths.

    Args:
        parser: A parser; those of its subcommands are changed, too.
        how: shtab's commands that complete a file's name, by shell.
    """
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                _complete_files(one, how)
        elif action.type is Path:
            setattr(action, "complete", how)  # noqa: B010 (shtab looks for it)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="jaxevent",
        description="Video of high rate and dynamic range, tracks, and motion, from event cameras.",
        epilog="examples:\n  jaxevent demo\n  jaxevent reconstruct --help",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxevent {jaxevent.__version__}")
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        default=argparse.SUPPRESS,
        choices=["bash", "zsh", "tcsh"],
        help="print a script that completes words in a shell, for its folder of completions",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in COMMANDS:
        module.add(commands)
    return parser
