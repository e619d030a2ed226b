"""Machine code of functions that numba compiles, in files for later processes.

numba keeps the signatures of a function in an index, and numbers the files that it names. Two
processes that compile different signatures at the same time read the same index, take the same
number, and one signature is then answered with the other's machine code. A damaged index or file
ends the process with a traceback. Here each signature has a file of its own name, in the user's own
folder (`jaxevent.cache`). The file begins with a hash of all that it depends on and of what it
holds: another file, and a part of one, is nothing but compiled again, and so is what cannot be
written. The hash is made with the user's secret key, so that no other user can make a file that is
read: its content is a pickle, which could run anything.
"""

import contextlib
import functools
import hashlib
import hmac
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxevent import cache
from jaxevent.codegen import support
from jaxevent.codegen.support import numba

if support.HAS_INTERNALS:
    from jaxevent.codegen import internals

_HASH = 32  # bytes at the beginning of a file


def njit_cached(function: Callable, **options: Any) -> Any:
    """Compile by `numba.njit` with these options, cached in files.

    Do nothing where there is no numba.
    """
    if not support.HAS_NUMBA:
        return function
    made: Any = numba.njit(**options)(function)
    files = _files_of(function)
    return internals.use_signature_cache(made, files) if files is not None else made


def cfunc(signature: Any, **options: Any) -> Callable[[Callable], Any]:
    """Compile by `numba.cfunc` with these options, cached in files."""

    def compile_one(function: Callable) -> Any:
        files = _files_of(function)
        with support.garbage_collection_paused:
            if files is None:
                return numba.cfunc(signature, **options)(function)
            return internals.cached_cfunc(function, signature, options, files)

    return compile_one


def _files_of(function: Callable) -> "SignatureFiles | None":
    """Return the files of a function's signatures, or None where nothing is cached."""
    folder = cache.folder_for_compiled() if support.HAS_INTERNALS else None
    return None if folder is None else SignatureFiles(folder, function)


def hash_source(function: Callable) -> str:
    """Hash all that a function is compiled from: files, and numbers of other files."""
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
            # A NamedTuple of numbers is read like a number.
            elif not name.startswith("__") and (
                isinstance(value, int | float | str)
                or (isinstance(value, tuple) and hasattr(value, "_fields"))
            ):
                parts[path].append(f"{name} = {value!r}")
    about = repr(sorted(parts.values()))
    return hashlib.blake2b(about.encode(), digest_size=_HASH).hexdigest()


@functools.cache
def _content(path: str) -> str:
    try:
        return hashlib.blake2b(Path(path).read_bytes(), digest_size=_HASH).hexdigest()
    except OSError:  # typed in
        return path


class SignatureFiles:
    """Files of one function's signatures, in a folder of the user's own.

    Their names hold the function's and a hash of Python's version and of all that it is compiled
    from. So installations beside each other share what is the same in both, and do not replace each
    other's.
    """

    def __init__(self, folder: Path, function: Any):
        self.folder, self._function = folder, function

    @functools.cached_property
    def _about(self) -> str:
        return repr((numba.__version__, hash_source(self._function)))

    @functools.cached_property
    def _name(self) -> str:
        code = self._function.__code__
        about = f"{self._about} {sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
        content = hashlib.blake2b(about.encode(), digest_size=6).hexdigest()
        return f"{code.co_name.strip('<>')}-{code.co_firstlineno}.{content}"

    def flush(self) -> None:
        """Forget all signatures."""
        for path in self.folder.glob(f"{self._name}.*.nbc"):
            path.unlink(missing_ok=True)

    def save(self, key: Any, data: Any) -> None:
        """Save the machine code of a key, where it can be written.

        Args:
            key: Signature, machine and source of a function.
            data: What numba stores of it.
        """
        path = self._path(key)
        if path is None or cache.secret_key(self.folder) is None:
            return
        payload = internals.dumps(data)
        with contextlib.suppress(OSError):
            file = tempfile.NamedTemporaryFile(dir=self.folder, delete=False)
            try:
                with file:
                    file.write(self._hash(key, payload) + payload)
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise

    def load(self, key: Any) -> Any:
        """Load the machine code of a key; return None where there is none."""
        path = self._path(key)
        if path is None or cache.secret_key(self.folder) is None:
            return None
        try:
            content = path.read_bytes()
        except OSError:
            return None
        payload = content[_HASH:]
        if not hmac.compare_digest(content[:_HASH], self._hash(key, payload)):
            return None
        try:
            return pickle.loads(payload)
        except ImportError:  # another process compiled it, of a module that is not found here
            return None

    def _path(self, key: Any) -> Path | None:
        """Return the file of a key.

        None for one that holds addresses, which other processes share.
        """
        text = repr(key)
        if " at 0x" in text:
            return None
        named = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        return self.folder / f"{self._name}.{named}.nbc"

    def _hash(self, key: Any, payload: bytes) -> bytes:
        secret = cache.secret_key(self.folder)
        assert secret is not None
        about = f"{self._about}{key!r}".encode()
        return hashlib.blake2b(about + b"\0" + payload, digest_size=_HASH, key=secret).digest()
