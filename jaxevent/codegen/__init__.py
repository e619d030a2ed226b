"""Numba decorators, threads over rows and items, and scratch memory for compiled loops.

The other modules of the package compile functions that JAX traces (docs/codegen.md).
"""

import collections
import functools
import inspect
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import cache, support

T = TypeVar("T")
R = TypeVar("R")

# numba compiles two wrappers with each function. The one for calls by address is left out. The one
# for calls from Python stays: without it such a call would end the process.
_COMMON_OPTIONS: dict[str, Any] = {"nogil": True}
# Counting references to arrays takes two thirds of the time of a function with many of them.
_NOALLOC_OPTIONS: dict[str, Any] = {}
if support.HAS_INTERNALS:
    from jaxevent.codegen.internals import njit_linked

    _COMMON_OPTIONS |= {"no_cfunc_wrapper": True}
    _NOALLOC_OPTIONS |= {"_nrt": False}
# Sums in any order, so that they vectorise.
_FASTMATH_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz"},
}


def njit(function: Callable) -> Any:
    """Compile a function with numba, without the checks of arguments that tests add."""
    return cache.njit_cached(inspect.unwrap(function), **_COMMON_OPTIONS)


def njit_inlined(function: Callable) -> Any:
    """Compile a function that only other compiled functions call.

    It has no cache entry of its own: its machine code is stored with each caller.
    """
    return _njit_without_cache(function, error_model="numpy", **_COMMON_OPTIONS)


def njit_noalloc(function: Callable) -> Any:
    """Compile a function that allocates no arrays, in less time than `njit`.

    A division by zero gives infinity or NaN, as in NumPy.
    """
    return cache.njit_cached(
        inspect.unwrap(function), error_model="numpy", **_COMMON_OPTIONS, **_NOALLOC_OPTIONS
    )


def njit_noalloc_inlined(function: Callable) -> Any:
    """Compile a function for calls from `njit_noalloc` functions only; Python cannot call it."""
    return _compile_inlined(function, error_model="numpy", nogil=True, **_NOALLOC_OPTIONS)


def njit_fastmath(function: Callable) -> Any:
    """Compile a function that allocates no arrays, with sums in the fastest order."""
    return cache.njit_cached(
        inspect.unwrap(function), **_COMMON_OPTIONS, **_NOALLOC_OPTIONS, **_FASTMATH_OPTIONS
    )


def njit_fastmath_inlined(function: Callable) -> Any:
    """Compile a function for calls from `njit_fastmath` functions only; Python cannot call it."""
    return _compile_inlined(function, nogil=True, **_NOALLOC_OPTIONS, **_FASTMATH_OPTIONS)


def _njit_without_cache(function: Callable, **options: Any) -> Any:
    """Compile a function with `numba.njit` and no cache; without numba, return it unchanged."""
    plain = inspect.unwrap(function)
    return support.numba.njit(**options)(plain) if support.HAS_NUMBA else plain


def _compile_inlined(function: Callable, **options: Any) -> Any:
    """Compile a function for calls from compiled functions only, without wrappers if possible."""
    return (njit_linked if support.HAS_INTERNALS else _njit_without_cache)(function, **options)


class ZeroedScratch:
    """Arrays of zeros, one per shape and thread; who fills one must set it back to 0.

    Allocating a new one takes longer than processing a few events of a large image.
    """

    def __init__(self, dtype: Any):
        self.dtype, self._threads = dtype, threading.local()

    def __call__(self, *shape: int) -> NDArray:
        """Return the array of a shape."""
        if not hasattr(self._threads, "known"):
            self._threads.known = {}
        known: dict[tuple[int, ...], NDArray] = self._threads.known
        if shape not in known:
            known[shape] = np.zeros(shape, self.dtype)
        return known[shape]


N_THREADS = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)


def read_only(array: NDArray) -> NDArray:
    """Return a read-only view of an array.

    JAX's arrays are read-only, and numba compiles a function again for writable ones.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def empty_row_scratch(n_rows: int, *shape: int) -> NDArray[np.float32]:
    """Allocate uninitialised scratch (rows, ...) for kernels of `run_over_rows`.

    Each part of the rows uses the scratch of its first row. Pages that are never written take no
    memory.
    """
    return np.empty((n_rows, *shape), np.float32)


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(N_THREADS)


class _CoreShare(threading.local):
    """Number of cores among which a thread divides the rows of its kernels; None: all."""

    cores: int | None = None


_share = _CoreShare()


def _limit_cores(cores: int) -> None:
    _share.cores = cores


def run_over_rows(kernel: Callable, n_rows: int, *args: Any) -> None:
    """Run a kernel on parts of the rows, each part on its own thread.

    Kernels must release the interpreter's lock, and their results must not depend on the parts.

    Args:
        kernel: Function of the first row, the one after the last, and `args`.
        n_rows: Number of rows.
        *args: Further arguments.
    """
    parts = min(N_THREADS if _share.cores is None else _share.cores, n_rows)
    if parts <= 1:
        kernel(0, n_rows, *args)
        return
    edges = [n_rows * part // parts for part in range(parts + 1)]
    try:
        jobs = [_workers().submit(kernel, *edges[k : k + 2], *args) for k in range(parts)]
    except RuntimeError:  # the interpreter is shutting down while JAX waits for pending work
        kernel(0, n_rows, *args)
        return
    try:
        for job in jobs:
            job.result()
    finally:
        wait(jobs)  # even if interrupted: they write to arrays of the caller


def map_ahead(
    function: Callable[[T], R], items: Iterable[T], most: int | None = None
) -> Iterator[R]:
    """Yield `function(item)` for each item, in order, while later items are computed.

    The caller's thread iterates over the items. Worker threads compute one item each, and share
    the cores for the rows of kernels. With one core or `most = 1` the caller's thread does both.

    Args:
        function: Function of one item; it should release the interpreter's lock.
        items: The items.
        most: Largest number of pending items; None: the number of cores.

    Yields:
        The results.

    Raises:
        Exception: Any exception of the items or the function, when that result is due.
    """
    most = N_THREADS if most is None else most
    threads = min(most, N_THREADS)
    if threads == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(threads, initializer=_limit_cores, initargs=(N_THREADS // threads,))
    process = os.getpid()

    def begin(item: T) -> Callable[[], R]:
        """Begin to compute an item; return a function that waits for its result."""
        # A forked process lacks these threads, and they may hold the pool's locks.
        future = pool.submit(function, item) if os.getpid() == process else None
        return lambda: (
            function(item) if future is None or os.getpid() != process else future.result()
        )

    def begun() -> Iterator[Callable[[], R]]:
        try:
            for item in items:
                yield begin(item)
        except Exception as error:
            failed: Future[R] = Future()
            failed.set_exception(error)
            yield failed.result

    results: collections.deque[Callable[[], R]] = collections.deque()
    try:
        for result in begun():
            results.append(result)
            if len(results) == most:
                yield results.popleft()()
        while results:
            yield results.popleft()()
    finally:
        if os.getpid() == process:
            pool.shutdown(cancel_futures=True)


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_workers.cache_clear)
