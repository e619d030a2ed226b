"""Output that appears complete or not at all."""

import contextlib
import io
import math
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxevent.errors import InputError
from jaxevent.parameters import Parameters

if TYPE_CHECKING:
    import h5py


@contextlib.contextmanager
def complete(path: Path, directory: bool = False) -> Iterator[Path]:
    """Yield a temporary sibling of `path`, renamed onto `path` if the block succeeds.

    The sibling is an empty file, or an empty directory where `directory` is True. If the block
    raises, the sibling is removed and `path` is left as it was. An existing file is replaced; an
    existing directory must be empty.

    Raises:
        InputError: `path` is of the other kind, a directory that is not empty, or cannot be
            written; also instead of an OSError raised in the block.
    """
    path = Path(path)
    name = path.absolute().name
    if not name:
        raise InputError(f"{path}: is a folder; give the name of something to write in it")
    partial = path.absolute().with_name(f".{name}.{uuid.uuid4().hex[:12]}.part")
    try:
        _refuse(path, directory)
        if directory:
            partial.mkdir()
        else:
            partial.touch(exist_ok=False)
        yield partial
        if directory and path.exists():
            path.rmdir()
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
        if directory:
            shutil.rmtree(partial, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                partial.unlink()


@contextlib.contextmanager
def complete_hdf5(path: Path) -> Iterator[tuple["h5py.File", Callable[[], None]]]:
    """An HDF5 file to write, with what `complete` promises, and `check()` for long writers.

    Where the disk is full nothing is said before `check()` or the end of the block: HDF5 cannot
    recover from a failed write, and crashes at exit.
    """
    import h5py

    with complete(path) as partial, partial.open("r+b", buffering=0) as raw:
        sink = _Sink(raw)
        with h5py.File(sink, "w") as file:
            yield file, sink.check
        sink.check()


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
        if any(path.iterdir()):
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
