"""What an HDF5 file that jaxevent writes says of how it came to be.

Attributes of its root, each a text:

    jaxevent_version   the version of jaxevent that wrote the file
    command            the command line, as a shell takes it
    inputs             TOML, a table for each file and folder that the command read: see `Command`
    method, params     the estimator's name, and its parameters as TOML, which `Params.load` takes

A file that is written from Python has no command and no inputs. There is no date: the same command
on the same inputs writes the same bytes.
"""

import contextlib
import contextvars
import dataclasses
import functools
import hashlib
import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxevent.io import toml
from jaxevent.io.places import is_partial
from jaxevent.parameters import Parameters

if TYPE_CHECKING:
    import h5py

CLOCK = "us on the recording's clock"  # the unit of times
MOST_HASHED = 2_000_000_000  # bytes of a file that are read for its sha256


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line that is being run, and the files and folders that it reads."""

    words: Sequence[str]
    inputs: Sequence[Path]

    @property
    def line(self) -> str:
        return _printable(shlex.join(self.words))

    @functools.cached_property
    def read(self) -> str:
        """The inputs as TOML, one line each: `"name" = { bytes = 7, sha256 = "..." }`.

        Of a folder it is the sha256 of its files' names and sizes: "name\\tbytes\\n" for each, by
        rising name. Files above 2 GB have their size alone, and a note that says so.
        """
        told = {_printable(str(path)): _fingerprint(path) for path in self.inputs}
        return "\n".join(f"{toml.key(name)} = {toml.text(about)}" for name, about in told.items())


_running: contextvars.ContextVar[Command | None] = contextvars.ContextVar("running", default=None)


@contextlib.contextmanager
def running(command: Command) -> Iterator[None]:
    """Within the block, have files say that this command writes them."""
    token = _running.set(command)
    try:
        yield
    finally:
        _running.reset(token)


def describe(
    file: "h5py.File", method: str | None = None, params: Parameters | None = None
) -> None:
    """Set the attributes that this module lists, as far as they are known."""
    from jaxevent import __version__

    file.attrs["jaxevent_version"] = __version__
    if (command := _running.get()) is not None:
        file.attrs["command"] = command.line
        file.attrs["inputs"] = command.read
    if method is not None:
        file.attrs["method"] = method
    if params is not None:
        file.attrs["params"] = toml.parameters(params)


def _fingerprint(path: Path) -> dict[str, Any]:
    try:
        if path.is_dir():
            return _of_folder(path)
        if not path.is_file():
            return {"note": "neither a file nor a folder"}
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > MOST_HASHED:
                return {"bytes": size, "note": "no sha256: larger than 2 GB"}
            return {"bytes": size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    except OSError as error:  # it has gone: what was made of it is kept
        return {"note": f"cannot be read any more ({error.strerror or error})"}


def _of_folder(path: Path) -> dict[str, Any]:
    """Of its files, but for those that are being written there."""
    sizes = {
        (Path(folder) / name).relative_to(path).as_posix(): (Path(folder) / name).lstat().st_size
        for folder, _, names in os.walk(path)
        if not is_partial(Path(folder))
        for name in names
        if not is_partial(Path(name))
    }
    lines = "".join(f"{name}\t{size}\n" for name, size in sorted(sizes.items()))
    digest = hashlib.sha256(os.fsencode(lines)).hexdigest()
    return {"files": len(sizes), "bytes": sum(sizes.values()), "sha256_names_sizes": digest}


def _printable(text: str) -> str:
    """Text that HDF5 and TOML can hold, of names that are not UTF-8."""
    return os.fsencode(text).decode("utf-8", "backslashreplace")
