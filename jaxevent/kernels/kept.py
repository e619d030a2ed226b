"""Functions that numba compiles, kept in files for later processes.

numba keeps the signatures of a function in an index, and numbers the files that it names. Two
processes that compile different signatures at the same time read the same index, take the same
number, and one signature is then answered with the other's machine code. A damaged index or file
ends the process with a traceback. Here each signature has a file of its own name, which begins with
a hash of all that it depends on and of what it holds: another file, and a part of one, is nothing
but compiled again, and so is what cannot be written.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import sigutils
from numba.core.caching import FunctionCache, NullCache
from numba.core.ccallback import CFunc
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.cpython import hashing  # noqa: F401  (its symbols: loaded code may refer to them)
from numba.experimental import function_type  # noqa: F401  (the type of kernels as arguments)

_HASH = 32  # bytes at the beginning of a file


def compiled(function: Callable, **options: Any) -> Any:
    """`numba.njit` with these options, kept."""
    made: Any = numba.njit(**options)(function)
    made._cache = _cache(function)
    return made


def callback(signature: Any, **options: Any) -> Callable[[Callable], CFunc]:
    """`numba.cfunc` with these options, kept."""

    def compile_one(function: Callable) -> CFunc:
        made: Any = CFunc(function, sigutils.normalize_signature(signature), {}, options)
        made._cache = _cache(function)
        made.compile()
        return made

    return compile_one


def _cache(function: Callable) -> FunctionCache | NullCache:
    try:
        return _Cache(function)
    except RuntimeError:  # no folder can be written
        return NullCache()


class _Cache(FunctionCache):
    def __init__(self, function: Callable):
        super().__init__(function)
        locator = self._impl.locator
        folder = Path(locator.get_cache_path())
        self._cache_file = Files(folder, self._impl.filename_base, source_of(function))

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As numba's, but without what only compiling needs: imports that take half a second."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def source_of(function: Callable) -> str:
    """A hash of all that a function is compiled from: files, and numbers of other files."""
    parts: dict[str, list[str]] = {}
    waiting: list[Any] = [function]
    while waiting:
        one = waiting.pop()
        path = one.__code__.co_filename
        if path in parts:
            continue
        parts[path] = [_content(path)]
        for name, value in one.__globals__.items():
            called = getattr(value, "py_func", None)
            if called is not None:
                waiting.append(called)
            elif isinstance(value, int | float | str) and not name.startswith("__"):
                parts[path].append(f"{name} = {value!r}")
    about = repr(sorted(parts.values()))
    return hashlib.blake2b(about.encode(), digest_size=_HASH).hexdigest()


@functools.cache
def _content(path: str) -> str:
    try:
        return hashlib.blake2b(Path(path).read_bytes(), digest_size=_HASH).hexdigest()
    except OSError:  # typed in
        return path


class Files:
    """The files of one function's signatures, in a folder; `stamp` is of its source."""

    def __init__(self, folder: Path, name: str, stamp: object):
        self.folder, self.name = folder, name
        self._about = repr((numba.__version__, stamp))

    def flush(self) -> None:
        """Forget all signatures."""
        for path in self.folder.glob(f"{self.name}.*.nbc"):
            path.unlink(missing_ok=True)

    def save(self, key: Any, data: Any) -> None:
        """Keep what was compiled for a key; raises `OSError` where it cannot be written."""
        path = self._path(key)
        if path is None:
            return
        payload = dumps(data)
        file = tempfile.NamedTemporaryFile(dir=self.folder, delete=False)
        try:
            with file:
                file.write(self._hash(key, payload) + payload)
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise

    def load(self, key: Any) -> Any:
        """What was compiled for a key; None where there is none."""
        path = self._path(key)
        if path is None:
            return None
        try:
            content = path.read_bytes()
        except OSError:
            return None
        payload = content[_HASH:]
        whole = content[:_HASH] == self._hash(key, payload)
        return pickle.loads(payload) if whole else None

    def _path(self, key: Any) -> Path | None:
        """The file of a key; None for one that holds addresses, which other processes share."""
        text = repr(key)
        if " at 0x" in text:
            return None
        named = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        return self.folder / f"{self.name}.{named}.nbc"

    def _hash(self, key: Any, payload: bytes) -> bytes:
        about = f"{self._about}{key!r}".encode()
        return hashlib.blake2b(about + b"\0" + payload, digest_size=_HASH).digest()
