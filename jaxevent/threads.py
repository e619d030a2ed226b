"""Threads: locks of the objects that they share, JAX's own, and both in a forked process.

Kernels with derivatives are called from within JAX's programs, and use JAX for what depends on
parameters alone. If a program runs in the background while its caller begins another, such a call
can wait for both forever. So JAX finishes each program before it begins the next.

A forked process has none of the threads that JAX computes with, and would wait for them forever.
There JAX's programs are refused; kernels work.
"""

import functools
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import threading
import types
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NoReturn, ParamSpec, TypeVar

from jaxevent.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")

_locks: weakref.WeakSet["TurnLock"] = weakref.WeakSet()
_lacks_threads = False  # whether the threads of JAX stayed in the parent of this process


class TurnLock:
    """A lock of an object that changes while it is read, so that threads read it in turn.

    A thread that holds the lock may enter again. A copy of the object has a lock of its own. In a
    forked process entering raises `InputError` where another thread held the lock, since nobody
    will finish that thread's work.
    """

    def __init__(self, owner: str):
        """Make a lock of an object, whose name is for the message."""
        self._owner, self._lock, self._was_locked = owner, threading.RLock(), False
        _locks.add(self)

    def __enter__(self) -> None:
        if self._was_locked:
            raise InputError(
                f"{self._owner}: another thread was reading it when this process was forked; make "
                "it in the process that reads it, or start processes by spawn or forkserver"
            )
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def iterate(self, items: Iterable[T]) -> Iterator[T]:
        """Yield the items of an iterable, each made while the lock is held."""
        rest, none = iter(items), object()
        while True:
            with self:
                item: Any = next(rest, none)
            if item is none:
                return
            yield item

    def __reduce__(self) -> tuple[Any, ...]:
        return TurnLock, (self._owner,)

    def mark_forked(self) -> None:
        """Record in a forked process whether another thread held the lock."""
        self._was_locked = not self._lock.acquire(blocking=False)
        if not self._was_locked:
            self._lock.release()


def synchronized(method: Callable[P, T]) -> Callable[P, T]:
    """Make threads call a method in turn with all others of the object that are marked so.

    The object holds a `TurnLock` as `_turns`.
    """

    @functools.wraps(method)
    def called(*arguments: P.args, **options: P.kwargs) -> T:
        it: Any = arguments[0]
        with it._turns:
            return method(*arguments, **options)

    return called


def refuse_to_pickle(what: str, instead: str) -> NoReturn:
    """Raise `InputError` for an object that cannot be pickled or copied, with the remedy."""
    raise InputError(f"{what} can be neither pickled nor copied; {instead}")


def use_synchronous_dispatch() -> bool:
    """Make JAX finish each program before it begins the next, now or when it is imported.

    Returns false if JAX has already begun to compute otherwise, or does not tell.
    """
    jax = sys.modules.get("jax")
    if jax is None:
        sys.meta_path.insert(0, _JaxFinder())
        return True
    setting = "jax_cpu_enable_async_dispatch"
    try:
        from jax._src.xla_bridge import backends_are_initialized

        if not backends_are_initialized():
            jax.config.update(setting, False)
        return jax.config.values.get(setting) is False
    except (ImportError, AttributeError):  # private: another JAX may have no such names
        return False


class _JaxFinder(importlib.abc.MetaPathFinder):
    """Finder that has JAX dispatch synchronously as soon as it is imported.

    No variable of the environment says so, and whoever imports it may compute at once.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder.find_spec`."""
        if fullname != "jax":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        loader: Any = None if spec is None else spec.loader
        if loader is not None:
            execute = loader.exec_module

            def exec_module(module: types.ModuleType) -> None:
                execute(module)
                use_synchronous_dispatch()

            loader.exec_module = exec_module
        return spec


@functools.cache
def check_platform_available() -> None:
    """Raise `InputError` if JAX has no device of the platform that JAX_PLATFORMS names.

    JAX raises errors of several kinds, where an array is made first. This starts JAX's platform.
    """
    import jax

    try:
        jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        requested = jax.config.jax_platforms  # ty: ignore[missing-attribute]
        reason = " ".join(str(error).split()).partition(" (set JAX_PLATFORMS")[0].rstrip(".")[:200]
        raise InputError(
            f"JAX_PLATFORMS is {requested!r}, and JAX finds no such device here"
            f"{f' ({reason})' if reason else ''}; unset it, or set JAX_PLATFORMS=cpu"
        ) from None


def check_not_forked() -> None:
    """Raise `InputError` in a forked process whose parent has computed with JAX."""
    if _lacks_threads:
        _refuse()


def _refuse(*_: Any, **__: Any) -> NoReturn:
    raise InputError(
        "this process was forked from one that has computed with JAX, whose threads it lacks; "
        'start it by spawn or forkserver, as multiprocessing.get_context("spawn") does'
    )


def _in_child() -> None:
    global _lacks_threads
    for one in list(_locks):
        one.mark_forked()
    bridge: Any = sys.modules.get("jax._src.xla_bridge")
    compiler: Any = sys.modules.get("jax._src.compiler")
    if bridge is not None and bridge.backends_are_initialized():
        _lacks_threads = True
        if compiler is not None:  # of programs that nobody checks for
            compiler.compile_or_get_cached = _refuse


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
