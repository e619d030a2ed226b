"""The interfaces of numba that this process can use: all that kernels want, public ones, or none.

Kernels are compiled in less time, and kept for later processes, by interfaces that numba may change
in any release. They are used with the releases of `TESTED_NUMBA_RELEASES` alone. With another
release functions are compiled by `numba.njit` in every process: later, with equal results. Where
numba cannot be imported, as beside a NumPy that it does not know, functions run as Python and XLA
compiles what a kernel would compute.
"""

import contextlib
import gc
import importlib
import threading
import warnings
from typing import Any

__all__ = [
    "HAS_INTERNALS",
    "HAS_NUMBA",
    "compiler_lock",
    "garbage_collection_paused",
    "intrinsic",
    "ir",
    "numba",
    "types",
]

# First and last release of numba whose private interfaces are used.
TESTED_NUMBA_RELEASES = ((0, 61), (0, 68))

numba: Any = None
types: Any = None  # numba's types
ir: Any = None  # LLVM's language
intrinsic: Any = None  # decorator of an operation of the compiler's own
compiler_lock: Any = threading.RLock()  # held while numba compiles


def is_tested_release(version: str) -> bool:
    """Return whether the private interfaces of this version of numba are known."""
    numbers = version.split(".")[:2]
    if not all(number.isdecimal() for number in numbers):
        return False
    return (
        TESTED_NUMBA_RELEASES[0]
        <= tuple(int(number) for number in numbers)
        <= TESTED_NUMBA_RELEASES[1]
    )


try:
    import numba
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic
except Exception as error:  # numba raises what it likes beside libraries that it does not know
    numba = None
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    warnings.warn(
        f"numba cannot be imported ({reason}), so that XLA compiles what it can and all else runs "
        "many times slower; install a numba that fits your NumPy, as pip install -U numba does",
        stacklevel=2,
    )

if numba is not None:
    # Kernels take functions as arguments.
    warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)
    with contextlib.suppress(ImportError, AttributeError):  # private: may go in any release
        compiler_lock = importlib.import_module("numba.core.compiler_lock").global_compiler_lock


class _Pause:
    """A context in which Python collects no garbage, for one that compiles.

    A compiler's trees of objects live until a function is compiled. To look through them again and
    again is a fifth of its time.
    """

    def __init__(self) -> None:
        self._depth, self._was_enabled = 0, False

    def __enter__(self) -> None:
        with compiler_lock:
            if self._depth == 0:
                self._was_enabled = gc.isenabled()
                gc.disable()
            self._depth += 1

    def __exit__(self, *_: Any) -> None:
        with compiler_lock:
            self._depth -= 1
            if self._depth == 0 and self._was_enabled:
                gc.enable()


garbage_collection_paused = _Pause()


def _pause_with_dispatchers() -> None:
    """Pause while a function of `numba.njit` is compiled."""
    event = importlib.import_module("numba.core.event")

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            garbage_collection_paused.__enter__()

        def on_end(self, event: Any) -> None:
            garbage_collection_paused.__exit__()

    event.register("numba:compile", Listener())


if numba is not None:
    with contextlib.suppress(ImportError, AttributeError, TypeError):
        _pause_with_dispatchers()

HAS_NUMBA = numba is not None
HAS_INTERNALS = HAS_NUMBA and is_tested_release(numba.__version__)
if HAS_INTERNALS:
    try:
        importlib.import_module("jaxevent.codegen.internals")
    except (ImportError, AttributeError):  # a build of numba that lacks some of them
        HAS_INTERNALS = False
