"""Compiled loops of the host: numba's decorators, threads over rows, and scratch.

The other modules of the package compile functions that JAX traces (docs/codegen.md).
"""

import ctypes
import functools
import inspect
import math
import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import cache, support

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
    return _inside(function, error_model="numpy", **_COMMON_OPTIONS)


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


def _inside(function: Callable, **options: Any) -> Any:
    """Compile a function with `numba.njit`, without a cache.

    Return it as it is where there is no numba.
    """
    plain = inspect.unwrap(function)
    return support.numba.njit(**options)(plain) if support.HAS_NUMBA else plain


def _lean_inside(function: Callable, **options: Any) -> Any:
    return (njit_linked if support.HAS_INTERNALS else _inside)(function, **options)


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


class _RecycledMemory:
    """Blocks of memory that are used again once no array is left that uses them.

    A page that a process writes for the first time costs more than to fill it.
    """

    def __init__(self, max_kept_bytes: int):
        self._max, self._kept, self._lock = max_kept_bytes, 0, threading.Lock()
        self._free: dict[int, list[NDArray[np.uint8]]] = {}

    def __call__(self, n_bytes: int) -> Any:
        """Return a block of at least so many bytes, in multiples of 1/8 of a power of two."""
        step = max(1 << max(n_bytes.bit_length() - 4, 0), ALIGNMENT_BYTES)
        size = -(-n_bytes // step) * step
        with self._lock:
            free = self._free.get(size)
            memory = free.pop() if free else None
            self._kept -= size if free is not None and memory is not None else 0
        if memory is None:
            memory = np.empty(size + ALIGNMENT_BYTES, np.uint8)
        offset = -memory.ctypes.data % ALIGNMENT_BYTES
        block = (ctypes.c_char * size).from_buffer(memory.data, offset)
        weakref.finalize(block, self._release, size, memory).atexit = False
        return block

    def _release(self, size: int, memory: NDArray[np.uint8]) -> None:
        with self._lock:
            if self._kept + size <= self._max:
                self._free.setdefault(size, []).append(memory)
                self._kept += size


ALIGNMENT_BYTES, MIN_RECYCLED_BYTES = 64, 1 << 18
_recycled_memory = _RecycledMemory(512 << 20)


def empty(*shape: int) -> NDArray[np.float32]:
    """Return an array (float32); a large one has memory that others have used before."""
    count = math.prod(shape)
    if 4 * count < MIN_RECYCLED_BYTES:
        return np.empty(shape, np.float32)
    return np.frombuffer(_recycled_memory(4 * count), np.float32, count).reshape(shape)


def row_scratch(n_rows: int, *shape: int) -> NDArray[np.float32]:
    """Return scratch (rows, ...) for kernels of `run_over_rows`: parts use that of their first row.

    Memory is taken by what is written alone.
    """
    return empty(n_rows, *shape)


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(N_THREADS)


def run_over_rows(kernel: Callable, n_rows: int, *args: Any, min_rows: int = 1) -> None:
    """Call `kernel(begin, end, *args)` for parts of the rows, each on a thread of its own.

    Kernels release the interpreter's lock. What they compute must not depend on the parts, each of
    which has `min_rows` rows or more.
    """
    parts = min(N_THREADS, n_rows // min_rows)
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


if hasattr(os, "register_at_fork"):  # the threads stay behind
    os.register_at_fork(after_in_child=_workers.cache_clear)
