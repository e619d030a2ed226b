"""Where output may go: not onto an input, not unasked onto a file, not where somebody else writes.

The command line asks `check` before any work. `partial_of` names the temporary sibling under which
`jaxevent.io.output` writes. Its writer holds a lock on it that ends with the process, however that
ends: what nobody holds was left behind.
"""

import contextlib
import os
import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxevent.errors import InputError
from jaxevent.io.companions import companions

try:
    import fcntl
except ImportError:  # not on Windows: there is no lock, and what a killed process left stays
    fcntl = None


def check(
    outputs: Sequence[Path],
    inputs: Sequence[Path] = (),
    *,
    force: bool = False,
    inside: Sequence[Path] = (),
) -> None:
    """Raise `InputError` for outputs that would cost an input, each other, or an existing file.

    Two names of one file are the same, links included.

    Args:
        outputs: Files or folders to be written as a whole.
        inputs: Files or folders that are read, with those that are read beside them.
        force: Whether existing files, and files in existing folders, are to be replaced.
        inside: Outputs to be written although they exist: those of a run that goes on.
    """
    for number, out in enumerate(outputs):
        for other in outputs[:number]:
            if _same(out, other):
                raise InputError(f"{out}: is named for two outputs; give each a name of its own")
        for source in inputs:
            for one in (source, *companions(source)):
                _check_against(out, one)
        if out in inside:
            continue
        if out.is_file() and not force:
            raise InputError(f"{out}: exists; choose another name, or replace it with --force")
        if out.is_dir() and not force and any(out.iterdir()):
            raise InputError(
                f"{out}: the folder is not empty; choose another, or replace its files with --force"
            )
        if any(_state(partial) == "held" for partial in partials(out)):
            raise InputError(
                f"{out}: is being written by another process; wait for it, or choose another name"
            )


def _check_against(out: Path, source: Path) -> None:
    """Raise `InputError` if writing `out` would cost `source`, or a part of it."""
    if _same(out, source):
        raise InputError(f"{out}: is an input too, which would be lost; choose another name")
    if out.is_dir() and any(_same(out, parent) for parent in _parents(source)):
        raise InputError(f"{out}: holds the input {source}; choose another folder")
    there = out.is_file() or (out.is_dir() and any(out.iterdir()))
    if there and source.is_dir() and any(_same(parent, source) for parent in _parents(out)):
        raise InputError(f"{out}: is a part of the input {source}; choose another name")


def _parents(path: Path) -> Sequence[Path]:
    return Path(os.path.realpath(path)).parents


def _same(one: Path, other: Path) -> bool:
    try:
        return os.path.samefile(one, other)
    except OSError:  # one does not exist yet
        return os.path.realpath(one) == os.path.realpath(other)


def partial_of(path: Path) -> Path:
    """A new name beside `path` for what is not complete."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")


def is_partial(path: Path) -> bool:
    """Whether a name is one of `partial_of`, or that of a moment before."""
    return re.fullmatch(r"\..+\.[0-9a-f]{12}\.(part|new)", path.name) is not None


def partials(path: Path) -> list[Path]:
    """What is beside `path` of writes of it that go on, or were broken off."""
    path = path.absolute()
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{12}}\.part")
    try:
        return [one for one in path.parent.iterdir() if pattern.fullmatch(one.name)]
    except OSError:
        return []


def abandoned(path: Path) -> list[Path]:
    """Those of `partials` whose process has ended."""
    return [one for one in partials(path) if _state(one) == "free"]


def _state(path: Path) -> str:
    """Whether a process holds a file or folder: "held", "free", or "unknown" without locks."""
    try:
        with locked(path) as holds:
            return "free" if holds else "unknown"
    except BlockingIOError:
        return "held"
    except OSError:  # it has gone
        return "unknown"


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold an existing file or folder alone; gives False on a file system without locks.

    Raises `BlockingIOError` if somebody else holds it.
    """
    if fcntl is None:
        yield False
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        holds = True
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            holds = False
        yield holds
    finally:
        os.close(descriptor)
