"""Caches: compiled programs in the user's folder, for later processes, and results of methods.

Compiling takes seconds, running often less. So `import jaxevent` tells JAX to keep programs that
took longer than `MIN_COMPILE_SECONDS` to compile. JAX's own settings win:
jax_compilation_cache_dir, JAX_COMPILATION_CACHE_DIR, JAX_ENABLE_COMPILATION_CACHE. JAXEVENT_CACHE=0
leaves all as it is and keeps nothing, and JAXEVENT_CACHE=FOLDER names another folder.

Machine code that is loaded runs with the user's rights. So the folder is the user's alone: it is
made with mode 0700, and not used where another user owns it or may write to it. Files of kernels,
which hold pickles (`jaxevent.codegen.cache`), are read under a key that no other user can read
(`secret_key`). Calibrations of recordings are numbers without code, and have a folder beside it.
"""

import contextlib
import functools
import gc
import hashlib
import os
import platform
import sys
import tempfile
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

MIN_COMPILE_SECONDS = 0.3  # s; shorter compilations are not worth a file

# Of Linux's limit of 65,530, at which LLVM aborts the process. The programs that a method needs
# for a recording of another shape have 500 (smoother) to 900 (mc).
MAX_MEMORY_MAPS = 30_000

SECRET_KEY_BYTES = 32
_OPEN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)  # which not every system has


def keep_compiled() -> Path | None:
    """Have JAX store compiled programs; returns the folder, or None where nothing is changed.

    The settings are variables of the environment too, because processes started later inherit them;
    in those, they are ours and not the user's own.
    The folder is named by the processor, whose instructions compiled programs use: homes are shared
    by machines.
    """
    jax = sys.modules.get("jax")  # if it was imported before, it has read its variables already
    folder = folder_for_compiled()
    named = {os.environ.get("JAX_COMPILATION_CACHE_DIR")}
    named |= {jax.config.jax_compilation_cache_dir} if jax else set()
    theirs = named - {None, str(folder)} or "JAX_ENABLE_COMPILATION_CACHE" in os.environ
    if folder is None or theirs:
        return None
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(MIN_COMPILE_SECONDS))
    if jax:
        least = float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    # What cannot be kept, was damaged, or is being written by another process is compiled again.
    warnings.filterwarnings("ignore", "Error (read|writ)ing persistent compilation cache")
    return folder


def cache_method(method: Callable[..., T], size: int) -> Callable[..., T]:
    """Cache a bound method's latest results, by its arguments, for the object that it is bound to.

    An object with `functools.lru_cache` of a method of its own refers to itself. So what it holds,
    often gigabytes, would stay in memory until Python next looks for cycles.

    Args:
        method: The bound method.
        size: Number of results.

    Returns:
        The function, which does not keep the object alive.
    """
    bound: Any = method
    owner, function = weakref.ref(bound.__self__), bound.__func__

    @functools.lru_cache(size)
    def latest(*args: Any) -> T:
        return function(owner(), *args)

    return latest


class ByValue:
    """A tree of arrays, as a key of a cache: equal to others if all their numbers are.

    Attributes:
        tree: The tree.
    """

    def __init__(self, tree: Any):
        import jax
        import numpy as np

        leaves, structure = jax.tree.flatten(tree)
        arrays = [np.asarray(leaf) for leaf in leaves]
        self.tree = tree
        self._key = structure, tuple((a.dtype.str, a.shape, a.tobytes()) for a in arrays)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByValue) and self._key == other._key


def folder_for_compiled() -> Path | None:
    """Return the user's own folder of compiled programs, or None where there can be none.

    A folder that other users own or may write to is not used, with a warning.
    """
    return _find_folder("compiled", _processor)


def folder_for_calibrations() -> Path | None:
    """Return the user's own folder of calibrations, or None where there can be none."""
    return _find_folder("recordings", lambda: "calibrations")


def _find_folder(kind: str, name: Callable[[], str]) -> Path | None:
    """Return the folder of a name in the one that the user named, or in the user's of a kind."""
    wanted = os.environ.get("JAXEVENT_CACHE", "")
    if wanted == "0":
        return None
    base = (Path(wanted) if wanted else _user_folder(kind)).absolute()
    folder = _own_folder(base, name())
    if folder is not None and not folder.is_dir():  # somebody removed it meanwhile
        _own_folder.cache_clear()
        secret_key.cache_clear()
        folder = _own_folder(base, name())
    return folder


@functools.cache
def secret_key(folder: Path) -> bytes | None:
    """Return the key of files in the folder, made at first; None where it cannot be kept.

    It is random, and its file is readable by the user alone. A file that other users own or may
    read is replaced, so that what was written under it is compiled again.
    """
    path = folder / "key"
    try:
        for _ in range(3):  # other processes may make one at the same time
            key = _read_key(path)
            if key is not None:
                return key
            _make_key(path)
    except OSError:
        pass
    return None


def _read_key(path: Path) -> bytes | None:
    """Return the content of a key's file; None where there is none, or others may read it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | _OPEN)
    except OSError:
        return None
    try:
        status = os.fstat(descriptor)
        private = not _foreign_access(status) and not (_HAS_USERS and status.st_mode & 0o077)
        content = os.read(descriptor, SECRET_KEY_BYTES + 1)
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return content if private and len(content) == SECRET_KEY_BYTES else None


def _make_key(path: Path) -> None:
    """Make a key where there is no file, or one of no use; another process's key stays."""
    descriptor, name = tempfile.mkstemp(dir=path.parent)  # with mode 0600
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(os.urandom(SECRET_KEY_BYTES))
        try:
            os.link(name, path)
        except FileExistsError:
            if _read_key(path) is None:
                path.unlink(missing_ok=True)
        except OSError:  # a file system without links
            os.replace(name, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)


def release_compiled(maps: int = MAX_MEMORY_MAPS) -> bool:
    """Forget all compiled programs if the process has more than so many memory maps.

    Each program keeps several maps. What is needed again is read from the cache folder. Returns
    whether they were forgotten.
    """
    jax = sys.modules.get("jax")
    try:
        many = len(Path("/proc/self/maps").read_bytes().splitlines()) > maps
    except OSError:  # other systems have no such limit
        return False
    if not (jax and many):
        return False
    jax.clear_caches()
    gc.collect()
    return True


_HAS_USERS = hasattr(os, "geteuid")  # elsewhere the folders of a profile are the user's alone


@functools.cache
def _own_folder(base: Path, name: str) -> Path | None:
    folder = base / name
    try:
        for one in [*reversed(base.parents), base, folder]:
            if not one.is_dir():
                one.mkdir(mode=0o700, exist_ok=True)
        for one in (base, folder):
            reason = _foreign_access(one.stat())
            if reason:
                warnings.warn(
                    f"{one}: compiled programs and calibrations are neither kept nor looked for "
                    f"there, as {reason}; remove the folder, or name one of your own by "
                    "JAXEVENT_CACHE=FOLDER, or keep none by JAXEVENT_CACHE=0",
                    stacklevel=4,
                )
                return None
    except OSError:  # no home, as in some containers: everything works without
        return None
    return folder if os.access(folder, os.W_OK) else None


def _foreign_access(status: os.stat_result) -> str:
    """Why a folder or file may hold what another user wrote; empty where it may not."""
    if not _HAS_USERS:
        return ""
    if status.st_uid != os.geteuid():
        return f"the user {status.st_uid} owns it"
    return "other users may write to it" if status.st_mode & 0o022 else ""


def _user_folder(kind: str) -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("jaxevent", appauthor=False) / kind


@functools.cache
def _processor() -> str:
    """Return a name of the instructions that this processor has."""
    about = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.blake2b(about.encode(), digest_size=6).hexdigest()
