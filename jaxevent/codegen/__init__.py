"""Compiled loops of the host: numba's decorators, threads over rows and items, and scratch.

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

# numba makes two functions more of each. The one for those that call it by its address is left out;
# without the one for Python a call from there would end the process.
_COMMON_OPTIONS: dict[str, Any] = {"nogil": True}
# Counting references to arrays is two thirds of a function that takes many of them.
_NOALLOC_OPTIONS: dict[str, Any] = {}
if support.HAS_INTERNALS:
    from jaxevent.codegen.internals import njit_linked

    _COMMON_OPTIONS |= {"no_cfunc_wrapper": True}
    _NOALLOC_OPTIONS |= {"_nrt": False}
# Sums in any order, so that several are taken at once.
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
    """Compile a function that makes no arrays of its own, in less time than `njit`.

    A division by zero gives an infinite number or NaN, as in NumPy.
    """
    return cache.njit_cached(
        inspect.unwrap(function), error_model="numpy", **_COMMON_OPTIONS, **_NOALLOC_OPTIONS
    )


def njit_noalloc_inlined(function: Callable) -> Any:
    """Compile a function that only `njit_noalloc` ones call; Python cannot call it."""
    return _lean_inside(function, error_model="numpy", nogil=True, **_NOALLOC_OPTIONS)


def njit_fastmath(function: Callable) -> Any:
    """Compile a function as `njit_noalloc` does, with sums in the fastest order."""
    return cache.njit_cached(
        inspect.unwrap(function), **_COMMON_OPTIONS, **_NOALLOC_OPTIONS, **_FASTMATH_OPTIONS
    )


def njit_fastmath_inlined(function: Callable) -> Any:
    """Compile a function that only `njit_fastmath` ones call; Python cannot call it."""
    return _lean_inside(function, nogil=True, **_NOALLOC_OPTIONS, **_FASTMATH_OPTIONS)


def _njit_without_cache(function: Callable, **options: Any) -> Any:
    """Compile a function with `numba.njit`, without a cache.

    Return it as it is where there is no numba.
    """
    plain = inspect.unwrap(function)
    return support.numba.njit(**options)(plain) if support.HAS_NUMBA else plain


def _lean_inside(function: Callable, **options: Any) -> Any:
    return (njit_linked if support.HAS_INTERNALS else _njit_without_cache)(function, **options)


class ZeroedScratch:
    """Arrays of zeros that functions fill and make 0 again: one of each shape for each thread.

    To lay out a new one takes longer than a few events of a large image.
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
    """Return a view of an array that nobody may write, as JAX's arrays are.

    numba compiles a function once more for each kind of array.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def row_scratch(n_rows: int, *shape: int) -> NDArray[np.float32]:
    """Return scratch (rows, ...) for kernels of `run_over_rows`: parts use that of their first row.

    Memory is taken by what is written alone.
    """
    return np.empty((n_rows, *shape), np.float32)


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(N_THREADS)


class _CoreShare(threading.local):
    """The number of cores over which kernels on a thread divide rows; None: all."""

    cores: int | None = None


_share = _CoreShare()


def _limit_cores(cores: int) -> None:
    _share.cores = cores


def run_over_rows(kernel: Callable, n_rows: int, *args: Any) -> None:
    """Run a kernel on parts of the rows, each on a thread of its own.

    Kernels release the interpreter's lock. What they compute must not depend on the parts.

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
    except RuntimeError:  # the interpreter ends, and JAX waits for what it has begun
        kernel(0, n_rows, *args)
        return
    try:
        for job in jobs:
            job.result()
    finally:
        wait(jobs)  # interrupted, too: what they write is the caller's


def map_ahead(
    function: Callable[[T], R], items: Iterable[T], most: int | None = None
) -> Iterator[R]:
    """Yield `function(item)` for each item, in order, while later items are made.

    The caller's thread makes the items. Others compute, each one item at a time, and share the
    cores for the rows of kernels. With one core or one item the caller's thread computes, too.

    Args:
        function: Function of one item alone; it should release the interpreter's lock.
        items: The items.
        most: Items that are held at once; None: as many as there are cores.

    Yields:
        The results.

    Raises:
        Exception: What making an item or the function raises, when its result is due.
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
        # A forked process has none of the threads, and locks of the pool may be theirs.
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


if hasattr(os, "register_at_fork"):  # the threads stay behind
    os.register_at_fork(after_in_child=_workers.cache_clear)
