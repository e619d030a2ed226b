"""Compiled programs are kept in the user's cache folder, for later processes.

Compiling takes seconds, running often less. So `import jaxevent` tells JAX to keep programs that
took longer than `LEAST` to compile. JAX's own settings win: jax_compilation_cache_dir,
JAX_COMPILATION_CACHE_DIR, JAX_ENABLE_COMPILATION_CACHE. JAXEVENT_CACHE=0 leaves all as it is, and
JAXEVENT_CACHE=FOLDER names another folder.
"""

import contextlib
import gc
import hashlib
import os
import platform
import sys
import warnings
from pathlib import Path

LEAST = 0.3  # s; shorter compilations are not worth a file

# Of Linux's limit of 65,530, at which LLVM aborts the process. The programs that a method needs
# for a recording of another shape have 500 (smoother) to 900 (mc).
MAPS = 30_000


def keep_compiled() -> Path | None:
    """Have JAX keep what it compiles; returns the folder, or None where nothing is changed.

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
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(LEAST))
    if jax:
        least = float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
    # What cannot be kept, was damaged, or is being written by another process is compiled again.
    warnings.filterwarnings("ignore", "Error (read|writ)ing persistent compilation cache")
    return folder


def folder_for_compiled() -> Path | None:
    """The folder in which compiled programs are kept; None where none can be."""
    wanted = os.environ.get("JAXEVENT_CACHE", "")
    if wanted == "0":
        return None
    folder = (Path(wanted) if wanted else _user_folder()) / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # no home, as in some containers: everything works without
        return None
    return folder if os.access(folder, os.W_OK) else None


def release_compiled(maps: int = MAPS) -> bool:
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


def _user_folder() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("jaxevent", appauthor=False) / "compiled"


def _processor() -> str:
    """A name of the instructions that this processor has."""
    about = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        about += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.blake2b(about.encode(), digest_size=6).hexdigest()
