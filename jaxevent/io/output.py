"""Output that appears complete or not at all."""

import contextlib
import contextvars
import inspect
import io
import math
import re
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxevent.errors import InputError
from jaxevent.io.description import describe
from jaxevent.io.places import abandoned, locked, partial_of
from jaxevent.parameters import Parameters

if TYPE_CHECKING:
    import h5py


_into_folders = contextvars.ContextVar("into_folders", default=False)


@contextlib.contextmanager
def into_folders(allowed: bool) -> Iterator[None]:
    """Within the block, whether `complete` writes into folders that are not empty.

    Files of the same names are replaced then, and numbered ones of the same kind removed, as those
    of a longer series of images. All others stay.
    """
    token = _into_folders.set(allowed)
    try:
        yield
    finally:
        _into_folders.reset(token)


@contextlib.contextmanager
def complete(path: Path, directory: bool = False) -> Iterator[Path]:
    """Yield a temporary sibling of `path`, renamed onto `path` if the block succeeds.

    The sibling is an empty file, or an empty directory where `directory` is True. If the block
    raises, the sibling is removed and `path` is left as it was. An existing file is replaced; an
    existing directory must be empty, but see `into_folders`. Siblings that a killed process left
    are removed.

    Raises:
        InputError: `path` is of the other kind, a directory that is not empty, or cannot be
            written; also instead of an OSError raised in the block.
    """
    path = Path(path)
    if not path.absolute().name:
        raise InputError(f"{path}: is a folder; give the name of something to write in it")
    partial = partial_of(path.absolute())
    # It has its name once it is locked: nobody shall take it for abandoned.
    unlocked = partial.with_suffix(".new")
    try:
        _refuse(path, directory)
        for remains in abandoned(path):
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
        reason = " ".join((error.strerror or str(error)).split())
        raise InputError(
            f"{path}: cannot be written ({reason}); choose a writable place with enough room"
        ) from error
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
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
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
    """An HDF5 file to write, with what `complete` promises, and `check()` for long writers.

    It says of itself what `jaxevent.io.description` lists.
    Where the disk is full nothing is said before `check()` or the end of the block: HDF5 cannot
    recover from a failed write, and crashes at exit.
    """
    import h5py

    with complete(path) as partial, partial.open("r+b", buffering=0) as raw:
        sink = _Sink(raw)
        with _signals_outside(sink.readinto, sink.write, sink.truncate) as let_signals_in:

            def check() -> None:
                let_signals_in()
                sink.check()

            with h5py.File(sink, "w") as file:
                describe(file, method, params)
                yield file, check
            check()


@contextlib.contextmanager
def _signals_outside(*callbacks: Callable) -> Iterator[Callable[[], None]]:
    """Have signals that come while one of these functions runs wait; gives what lets them in.

    What a handler raises there would unwind through libhdf5, which crashes. While libhdf5
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


class _Sink:
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


def _refuse(path: Path, directory: bool) -> None:
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if directory and path.is_dir():
        if not _into_folders.get() and any(path.iterdir()):
            raise InputError(f"{path}: the folder is not empty; choose another or empty it")
    elif path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file to write")
    elif path.exists() and (directory or not path.is_file()):
        raise InputError(f"{path}: exists and is not what is to be written; choose another name")


def finite(value: float | int) -> float | int | None:
    """The value, None where JSON has no number."""
    return value if math.isfinite(value) else None


def values_of(params: Parameters) -> dict[str, Any]:
    """The values as they were given: numbers to 6 digits, lists of them, text, true and false.

    None where JSON has no number.
    """

    def plain(value: Any) -> Any:
        if value is None or isinstance(value, str | bool | np.bool_):
            return bool(value) if isinstance(value, np.bool_) else value
        if np.ndim(value):
            return [plain(one) for one in value]
        return finite(float(f"{float(value):.6g}"))

    return {name: plain(value) for name, value in params.values().items()}
