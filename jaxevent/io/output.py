"""Output: where it may go, complete or not at all, and a description of how it came to be.

`check_outputs` refuses to write onto an input, onto a file without consent, and where another
process writes; the command line calls it before any work. Until output is complete it has the name
of a temporary sibling. Its writer holds a lock on the sibling that ends with the process: a sibling
without a lock was left behind.

An HDF5 file that jaxevent writes has these attributes of its root, each a text:

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
import inspect
import io
import math
import os
import re
import shlex
import shutil
import signal
import threading
import uuid
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import toml
from jaxevent.io.checks import companions
from jaxevent.parameters import Parameters

try:
    import fcntl
except ImportError:  # not on Windows: there is no lock, and the remains of a killed process stay
    fcntl = None

if TYPE_CHECKING:
    import h5py

CLOCK_UNIT = "us on the recording's clock"  # the unit of times
_MAX_HASHED_BYTES = 2_000_000_000  # bytes of a file that are read for its sha256
_SAMPLE_BYTES = 1024  # bytes from the middle of a plane
_MAX_COMPRESSED_SHARE = 0.9  # of a sample: planes that do not get smaller are stored as they are
_RAW_DEFLATE_WINDOW_BITS = -15  # without zlib's header and checksum


def check_outputs(
    outputs: Sequence[Path],
    inputs: Sequence[Path] = (),
    *,
    force: bool = False,
    inside: Sequence[Path] = (),
    claims: Sequence[Path] = (),
) -> None:
    """Raise `InputError` for outputs that would cost an input, each other, or an existing file.

    Two names of one file are the same, links included.

    Args:
        outputs: Files or folders to be written as a whole.
        inputs: Files or folders that are read, with those that are read beside them.
        force: Whether existing files, and files in existing folders, are to be replaced.
        inside: Outputs to be written although they exist, as those of a run that goes on.
        claims: Siblings of outputs by which this process claims them, see `claim_outputs`.

    Raises:
        InputError: An output would cost something.
    """
    names = {claim.name for claim in claims}
    for number, out in enumerate(outputs):
        for other in outputs[:number]:
            if _is_same_file(out, other):
                raise InputError(f"{out}: is named for two outputs; give each a name of its own")
        for source in inputs:
            for one in (source, *companions(source)):
                _check_against(out, one)
        if out in inside:
            continue
        if (out.is_file() or (out.is_symlink() and not out.is_dir())) and not force:
            raise InputError(f"{out}: exists; choose another name, or replace it with --force")
        if out.is_dir() and not force and any(out.iterdir()):
            raise InputError(
                f"{out}: the folder is not empty; choose another, or replace its files with --force"
            )
        others = (one for one in partials(out) if one.name not in names)
        if any(_lock_state(partial) == "held" for partial in others):
            raise InputError(
                f"{out}: is being written by another process; wait for it, or choose another name"
            )


def _check_against(out: Path, source: Path) -> None:
    """Raise `InputError` if writing `out` would cost `source`, or a part of it."""
    if _is_same_file(out, source):
        raise InputError(f"{out}: is an input too, which would be lost; choose another name")
    if out.is_dir() and any(_is_same_file(out, parent) for parent in _parents(source)):
        raise InputError(f"{out}: holds the input {source}; choose another folder")
    there = out.is_file() or (out.is_dir() and any(out.iterdir()))
    if there and source.is_dir() and any(_is_same_file(parent, source) for parent in _parents(out)):
        raise InputError(f"{out}: is a part of the input {source}; choose another name")


def _parents(path: Path) -> Sequence[Path]:
    return Path(os.path.realpath(path)).parents


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return os.path.samefile(one, other)
    except OSError:  # one does not exist yet
        return os.path.realpath(one) == os.path.realpath(other)


def partial_path(path: Path) -> Path:
    """Return a new name beside `path` for output that is not complete."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")


def is_partial(path: Path) -> bool:
    """Return whether a name is one of `partial_path`, or that of a moment before."""
    return re.fullmatch(r"\..+\.[0-9a-f]{12}\.(part|new)", path.name) is not None


def check_recording_name(path: Path) -> None:
    """Raise `InputError` unless a recording can be stored under this name: it is of HDF5."""
    if path.suffix.lower() not in ("", ".h5", ".hdf5", ".hdf") and not is_partial(path):
        raise InputError(f"{path}: recordings are stored as HDF5; end the name in .h5")


def partials(path: Path) -> list[Path]:
    """List the siblings of `path` that hold writes of it which go on, or were broken off."""
    path = path.absolute()
    pattern = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{12}}\.part")
    try:
        return [one for one in path.parent.iterdir() if pattern.fullmatch(one.name)]
    except OSError:
        return []


def abandoned_partials(path: Path) -> list[Path]:
    """List the siblings of `path` whose writer has ended."""
    return [one for one in partials(path) if _lock_state(one) == "free"]


def _lock_state(path: Path) -> str:
    """Return the lock of a file or folder: "held", "free", or "unknown" without locks."""
    try:
        with locked(path) as holds:
            return "free" if holds else "unknown"
    except BlockingIOError:
        return "held"
    except OSError:  # it was removed
        return "unknown"


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold a lock on an existing file or folder; yield False on a file system without locks.

    Raises `BlockingIOError` if another process holds it.
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


@contextlib.contextmanager
def claim_outputs(outputs: Sequence[Path]) -> Iterator[list[tuple[Path, Path | OSError]]]:
    """Claim outputs for a command that writes them later; `check_outputs` refuses them to others.

    Args:
        outputs: Files or folders to be written.

    Yields:
        Each output with a locked sibling, which is removed after the block, or with the error of
        one that cannot be written, as in a folder that does not exist.
    """
    claims: list[tuple[Path, Path | OSError]] = []
    with contextlib.ExitStack() as stack:
        for out in (path for path in outputs if path.absolute().name):
            claim = partial_path(out.absolute())
            stack.callback(_remove, claim)
            try:
                claim.touch(exist_ok=False)
                stack.enter_context(locked(claim))
                claims.append((out, claim))
            except OSError as error:
                claims.append((out, error))
        yield claims


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line that is being run.

    Attributes:
        words: Words of the command line.
        inputs: Files and folders that it reads.
    """

    words: Sequence[str]
    inputs: Sequence[Path]

    @property
    def line(self) -> str:
        """The command line, as a shell takes it."""
        return _printable(shlex.join(self.words))

    @functools.cached_property
    def described_inputs(self) -> str:
        """The inputs as TOML, one line each: `"name" = { bytes = 7, sha256 = "..." }`.

        Of a folder it is the sha256 of its files' names and sizes: "name\\tbytes\\n" for each, by
        rising name. Files above 2 GB have their size alone, and a note on it.
        """
        prints = {_printable(str(path)): _fingerprint(path) for path in self.inputs}
        return "\n".join(f"{toml.key(n)} = {toml.text(about)}" for n, about in prints.items())


_running: contextvars.ContextVar[Command | None] = contextvars.ContextVar("running", default=None)


@contextlib.contextmanager
def running(command: Command) -> Iterator[None]:
    """Describe files that are written within the block as written by a command."""
    token = _running.set(command)
    try:
        yield
    finally:
        _running.reset(token)


def _describe(
    file: "h5py.File", method: str | None = None, params: Parameters | None = None
) -> None:
    """Set the attributes of an HDF5 file that this module lists."""
    from jaxevent import __version__

    file.attrs["jaxevent_version"] = __version__
    if (command := _running.get()) is not None:
        file.attrs["command"] = command.line
        file.attrs["inputs"] = command.described_inputs
    if method is not None:
        file.attrs["method"] = method
    if params is not None:
        file.attrs["params"] = toml.parameters(params)


def _fingerprint(path: Path) -> dict[str, Any]:
    try:
        if path.is_dir():
            return _folder_fingerprint(path)
        if not path.is_file():
            return {"note": "neither a file nor a folder"}
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > _MAX_HASHED_BYTES:
                return {"bytes": size, "note": "no sha256: larger than 2 GB"}
            return {"bytes": size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    except OSError as error:  # it was removed; the output is kept
        return {"note": f"cannot be read any more ({error.strerror or error})"}


def _folder_fingerprint(path: Path) -> dict[str, Any]:
    """Hash the names and sizes of a folder's files, but for those that are being written."""
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
    """Return a text that HDF5 and TOML can hold, also of names that are not UTF-8."""
    return os.fsencode(text).decode("utf-8", "backslashreplace")


_into_folders = contextvars.ContextVar("into_folders", default=False)


@contextlib.contextmanager
def allow_writing_into_folders(allowed: bool) -> Iterator[None]:
    """Set whether `complete` writes into folders that are not empty, within the block.

    Files of the same names are replaced then, and numbered ones of the same kind removed, as those
    of a longer series of images. All others stay.
    """
    token = _into_folders.set(allowed)
    try:
        yield
    finally:
        _into_folders.reset(token)


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error of an output that cannot be written."""
    reason = " ".join((error.strerror or str(error)).split())
    return InputError(
        f"{path}: cannot be written ({reason}); choose a writable place with enough room"
    )


@contextlib.contextmanager
def complete(path: Path, directory: bool = False) -> Iterator[Path]:
    """Yield a temporary sibling of `path`, renamed onto `path` if the block succeeds.

    If the block raises, the sibling is removed and `path` is left as it was. An existing file is
    replaced; an existing directory must be empty, but see `allow_writing_into_folders`.
    Siblings that a killed process left are removed.

    Args:
        path: File or folder to write.
        directory: Whether the sibling is an empty directory, not an empty file.

    Yields:
        The sibling.

    Raises:
        InputError: `path` is of the other kind, a directory that is not empty, or cannot be
            written; also instead of an OSError raised in the block.
    """
    path = Path(path)
    if not path.absolute().name:
        raise InputError(f"{path}: is a folder; give the name of something to write in it")
    partial = partial_path(path.absolute())
    # It has its name once it is locked: nobody shall take it for abandoned.
    unlocked = partial.with_suffix(".new")
    try:
        _refuse_taken_path(path, directory)
        for remains in abandoned_partials(path):
            _remove(remains)
        if directory:
            unlocked.mkdir()
        else:
            unlocked.touch(exist_ok=False)
        with locked(unlocked):
            unlocked.replace(partial)
            yield partial
            if directory and path.exists():
                _move_files(partial, path)
            else:
                partial.replace(path)
    except InputError as error:  # of a file in a folder that has its final name only now
        if str(partial) in str(error):
            raise InputError(str(error).replace(str(partial), str(path))) from error
        raise
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        _remove(unlocked)
        _remove(partial)


def check_writable(path: Path, directory: bool = False) -> None:
    """Raise `InputError` where `complete` could not write, before the work begins."""

    class Withdrawn(Exception):
        pass

    with contextlib.suppress(Withdrawn), complete(path, directory):
        raise Withdrawn


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _move_files(new: Path, folder: Path) -> None:
    """Move the files of a folder into another one, in place of those of the same kind there."""
    if not folder.is_symlink() and not any(folder.iterdir()):
        folder.rmdir()
        new.replace(folder)
        return
    names = {file.name for file in new.iterdir()}
    number = re.compile(r"\d{6,}")
    series = {number.sub("0", name) for name in names if number.search(name)}
    for file in folder.iterdir():
        if file.name not in names and number.sub("0", file.name) in series and file.is_file():
            file.unlink()
    for name in names:
        (new / name).replace(folder / name)


@contextlib.contextmanager
def complete_hdf5(
    path: Path, method: str | None = None, params: Parameters | None = None
) -> Iterator[tuple["h5py.File", Callable[[], None]]]:
    """Open an HDF5 file to write, which appears complete or not at all, as by `complete`.

    A full disk is reported by `check()` or at the end of the block only: HDF5 cannot recover from a
    failed write, and crashes at exit.

    Args:
        path: File to write.
        method: Name of the estimator, for the file's description.
        params: Its parameters.

    Yields:
        The open file, and `check()` for long writers.
    """
    import h5py

    with complete(path) as partial, partial.open("r+b", buffering=0) as raw:
        out = _NeverFailingFile(raw)
        with _signals_outside(out.readinto, out.write, out.truncate) as let_signals_in:

            def check() -> None:
                let_signals_in()
                out.check()

            with h5py.File(out, "w") as file:
                _describe(file, method, params)
                yield file, check
            check()


@contextlib.contextmanager
def _signals_outside(*callbacks: Callable) -> Iterator[Callable[[], None]]:
    """Delay signals that come while one of the callbacks runs; yield a function that lets them in.

    An exception of a handler there would unwind through libhdf5, which crashes. While libhdf5
    compresses, signals are first seen in a callback.
    """
    codes = {inspect.unwrap(getattr(one, "__func__", one)).__code__ for one in callbacks}
    before: dict[int, Any] = {}
    waiting: list[int] = []

    def handle(number: int, frame: Any) -> None:
        caller = frame
        while caller is not None and caller.f_code not in codes:
            caller = caller.f_back
        if caller is None:
            before[number](number, frame)
        else:
            waiting.append(number)

    def let_in() -> None:
        while waiting:
            number = waiting.pop()
            before[number](number, None)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGALRM"):
            number = getattr(signal, name, None)
            if number is not None and callable(handler := signal.getsignal(number)):
                before[number] = handler
                signal.signal(number, handle)
    try:
        yield let_in
        let_in()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _NeverFailingFile:
    """A file for HDF5 whose writes always seem to succeed."""

    def __init__(self, raw: io.FileIO):
        self.raw = raw
        self.error: OSError | None = None
        self.read, self.seek, self.tell, self.flush = raw.read, raw.seek, raw.tell, raw.flush

    def check(self) -> None:
        """Raise the OSError of the first failed write."""
        if self.error is not None:
            raise self.error

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, with zeros after the end."""
        view, done = memoryview(buffer).cast("B"), 0
        while done < len(view) and (count := self.raw.readinto(view[done:])):
            done += count
        view[done:] = bytes(len(view) - done)
        return len(view)

    def write(self, data: Any) -> int:
        view, done = memoryview(data).cast("B"), 0
        try:
            while done < len(view) and self.error is None:
                done += self.raw.write(view[done:]) or 0
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int) -> int:
        try:
            if self.error is None:
                self.raw.truncate(size)
        except OSError as error:
            self.error = error
        return size


def _refuse_taken_path(path: Path, directory: bool) -> None:
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if directory and path.is_dir():
        if not _into_folders.get() and any(path.iterdir()):
            raise InputError(f"{path}: the folder is not empty; choose another or empty it")
    elif path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file to write")
    elif path.exists() and (directory or not path.is_file()):
        raise InputError(f"{path}: exists and is not what is to be written; choose another name")


def deflate_shuffled(numbers: NDArray) -> bytes:
    """Compress numbers as HDF5's filters "shuffle" and "gzip" do, but five times as fast.

    zlib spends most of its time on the bytes of mantissas, which do not get smaller. Here a sample
    of each byte plane decides whether it is compressed or stored, and only repeated bytes are
    searched. The result is one zlib stream (experiments/studies/compression.md compares).

    Args:
        numbers: Numbers or booleans of a chunk.

    Returns:
        A chunk of a dataset of their type, with `compression="gzip", shuffle=True`.
    """
    size = numbers.dtype.itemsize
    words = np.ascontiguousarray(numbers).reshape(-1).view(f"u{size}")
    parts, check = [b"\x78\x01"], 1
    for k in range(size):
        plane = (words >> (8 * k)).astype(np.uint8).data
        compressor = _choose_compressor(plane)
        flush = zlib.Z_FINISH if k + 1 == size else zlib.Z_FULL_FLUSH
        parts += [compressor.compress(plane), compressor.flush(flush)]
        check = zlib.adler32(plane, check)
    return b"".join([*parts, check.to_bytes(4, "big")])


def _choose_compressor(plane: memoryview) -> Any:
    middle = max(len(plane) // 2 - _SAMPLE_BYTES // 2, 0)
    sample = plane[middle : middle + _SAMPLE_BYTES]
    trial = _compressor(1)
    size = len(trial.compress(sample)) + len(trial.flush())
    return _compressor(int(size < _MAX_COMPRESSED_SHARE * len(sample)))


def _compressor(level: int) -> Any:
    """Make a compressor of raw deflate; level 0 stores."""
    return zlib.compressobj(level, zlib.DEFLATED, _RAW_DEFLATE_WINDOW_BITS, 9, zlib.Z_RLE)


def finite(value: float | int) -> float | int | None:
    """Return a number, or None if it is not finite, as JSON has no such number."""
    return value if math.isfinite(value) else None


def values_of(params: Parameters) -> dict[str, Any]:
    """Return parameters as JSON holds them: numbers of 6 digits, lists, text, true and false."""

    def plain(value: Any) -> Any:
        if value is None or isinstance(value, str | bool | np.bool_):
            return bool(value) if isinstance(value, np.bool_) else value
        if np.ndim(value):
            return [plain(one) for one in value]
        return finite(float(f"{float(value):.6g}"))

    return {name: plain(value) for name, value in params.values().items()}
