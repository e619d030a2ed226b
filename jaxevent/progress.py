"""Progress on stderr, in a terminal or a notebook.

`bar` counts steps; `stage` shows an activity that cannot be counted. The activity that began last
and is not over has the line. From 2 s on a thread keeps its time moving while no step ends.
"""

import os
import sys
import threading
import time
import weakref
from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm

# By default tqdm makes a lock for processes too: a semaphore, of which Python warns that it leaks
# when a process is killed. No two processes share a bar here.
tqdm.set_lock(threading.RLock())

SHOW_DELAY_S = 2.0  # s before anything is shown
POLL_INTERVAL_S = 0.5  # s between looks at the time

_open: list[weakref.ref["Bar"]] = []  # the last one has the line
_over = threading.Event()


def _begin_anew() -> None:
    """Leave the open bars and the lock to the parent of a forked process."""
    tqdm.set_lock(threading.RLock())
    _open.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


class Bar(tqdm):  # ty: ignore[unsupported-base]
    """A bar of tqdm on a line that all bars share, with a rate that holds from its first step on.

    The first step often compiles what all others use; a rate with it would promise too long a time.
    """

    _first: tuple[float, float] | None = None  # what was done, and when (s), after the first step
    _displayed = False  # whether it is on the line

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        if not self.disable:
            with self.get_lock():
                _open.append(weakref.ref(self))
                if len(_open) == 1:
                    _over.clear()
                    threading.Thread(target=_tick, daemon=True).start()

    @property
    def format_dict(self) -> dict[str, Any]:
        known = super().format_dict
        now, done = time.time(), self.n - self.initial
        if self._first is None and done > 0:
            self._first = self.n, now
        count, since = self._first or (self.n, now)
        steps, elapsed = self.n - count, now - since
        return {**known, "rate": steps / elapsed if steps > 0 and elapsed >= 1 else 0}  # 0: unknown

    def update(self, n: float | int | None = 1) -> bool | None:
        displayed = super().update(n)
        if self._first is None and not self.disable:
            self._first = self.n, time.time()
        return displayed

    def display(self, *arguments: Any, **options: Any) -> Any:
        if _last() is self or self._displayed:
            self._displayed = True
            return super().display(*arguments, **options)
        return None

    def hide(self) -> None:
        """Leave the line to others, until it is shown again."""
        if self._displayed:
            self._displayed = False
            self.clear()

    def close(self) -> None:
        super().close()
        with self.get_lock():
            # By identity: tqdm takes bars of one line for equal.
            _open[:] = [one for one in _open if one() is not None and one() is not self]
            if not _open:
                _over.set()


def _last() -> Bar | None:
    """Return the bar that has the line."""
    while _open and _open[-1]() is None:
        _open.pop()
    return _open[-1]() if _open else None


def _tick() -> None:
    """Keep the time of the bar that has the line moving."""
    began = time.time()
    while not _over.wait(POLL_INTERVAL_S):
        if time.time() - began >= SHOW_DELAY_S:
            with tqdm.get_lock():
                _show()


def _show() -> None:
    """Give the line to the bar that began last. A function, so that the thread holds no bar."""
    shown = _last()
    for one in (other() for other in _open[:-1]):
        if one is not None:
            one.hide()
    if shown is not None:
        shown.refresh()
        shown.delay = 0  # so that it is cleared in the end


def is_interactive() -> bool:
    """Return true if stderr is a terminal, or the code runs in a notebook."""
    kernel = sys.modules.get("ipykernel")
    return sys.stderr.isatty() or kernel is not None


def bar(
    items: Iterable[Any] | None = None,
    *,
    desc: str,
    unit: str,
    progress: bool | None = None,
    **more: Any,
) -> Bar:
    """Make a bar on stderr that appears after 2 s and goes when done.

    Args:
        items: Items to iterate over, as `tqdm` takes them.
        desc: Activity that the bar shows.
        unit: Name of a step.
        progress: Whether to show it; None shows it where the process `is_interactive`.
        **more: Further options of `tqdm`.

    Returns:
        The bar, an iterable and a context.
    """
    return Bar(
        items, desc=desc, unit=unit, delay=SHOW_DELAY_S, leave=False, position=0,
        disable=not is_shown(progress), **more,
    )  # fmt: skip


def stage(desc: str, progress: bool | None = None) -> Bar:
    """Make a context during which a line shows an activity and its duration.

    Options as of `bar`.
    """
    return bar(desc=desc, unit="", progress=progress, bar_format="{desc} [{elapsed}]")


def hide() -> None:
    """Clear the line before something is printed; it returns while its activity goes on."""
    with tqdm.get_lock():
        for one in (other() for other in _open):
            if one is not None:
                one.hide()


def is_shown(progress: bool | None) -> bool:
    """Return `progress`, or where it is None whether the process `is_interactive`."""
    return is_interactive() if progress is None else progress
