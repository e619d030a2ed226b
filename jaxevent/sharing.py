"""Objects that threads share, and what becomes of them in a forked process."""

import functools
import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn, ParamSpec, TypeVar

from jaxevent.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")

_every: weakref.WeakSet["Turns"] = weakref.WeakSet()


class Turns:
    """A lock of an object that changes while it is read: the threads that read it take turns.

    A thread that has the object may enter again. A copy of the object has turns of its own. In a
    forked process entering raises `InputError` where another thread had the object, since nobody
    will finish what that one had begun.
    """

    def __init__(self, whose: str):
        """`whose` names the object, for the message."""
        self._whose, self._lock, self._left = whose, threading.RLock(), False
        _every.add(self)

    def __enter__(self) -> None:
        if self._left:
            raise InputError(
                f"{self._whose}: another thread was reading it when this process was forked; make "
                "it in the process that reads it, or start processes by spawn or forkserver"
            )
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def each(self, items: Iterable[T]) -> Iterator[T]:
        """The items of an iterable, each made in a turn of its own."""
        rest, none = iter(items), object()
        while True:
            with self:
                item: Any = next(rest, none)
            if item is none:
                return
            yield item

    def __reduce__(self) -> tuple[Any, ...]:
        return Turns, (self._whose,)

    def forked(self) -> None:
        """Note in a forked process whether another thread had the object."""
        self._left = not self._lock.acquire(blocking=False)
        if not self._left:
            self._lock.release()


def in_turn(method: Callable[P, T]) -> Callable[P, T]:
    """Have threads call a method in turn, and all others of the object that are marked so.

    The object has `Turns` as `_turns`.
    """

    @functools.wraps(method)
    def called(*arguments: P.args, **options: P.kwargs) -> T:
        it: Any = arguments[0]
        with it._turns:
            return method(*arguments, **options)

    return called


def refuse_to_pickle(what: str, instead: str) -> NoReturn:
    """Raise `InputError` for what cannot be pickled or copied, with the remedy."""
    raise InputError(f"{what} can be neither pickled nor copied; {instead}")


def _in_child() -> None:
    for one in list(_every):
        one.forked()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
