"""Locks of objects that threads share, and their state in a forked process."""

import functools
import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn, ParamSpec, TypeVar

from jaxevent.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")

_locks: weakref.WeakSet["TurnLock"] = weakref.WeakSet()


class TurnLock:
    """A lock of an object that changes while it is read, so that threads read it in turn.

    A thread that holds the lock may enter again. A copy of the object has a lock of its own. In a
    forked process entering raises `InputError` where another thread held the lock, since nobody
    will finish that thread's work.
    """

    def __init__(self, owner: str):
        """`owner` names the object, for the message."""
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


def _in_child() -> None:
    for one in list(_locks):
        one.mark_forked()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
