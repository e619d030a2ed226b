"""Progress bars: shown by default where somebody looks on, in a terminal or a notebook."""

import sys
import threading
from collections.abc import Iterable
from typing import Any

from tqdm.auto import tqdm

# By default tqdm makes a lock for processes too: a semaphore, of which Python warns that it leaks
# when a process is killed. No two processes share a bar here.
tqdm.set_lock(threading.RLock())


def watched() -> bool:
    """Whether somebody looks on: stderr is a terminal, or the code runs in a notebook."""
    kernel = sys.modules.get("ipykernel")
    return sys.stderr.isatty() or kernel is not None


def bar(
    items: Iterable[Any] | None = None, *, unit: str, progress: bool | None = None, **more: Any
) -> tqdm:
    """A bar on stderr that appears after 2 s and goes when done; see `tqdm` for further options.

    `progress` shows or hides it; None: shown where somebody looks on (`watched`).
    """
    return tqdm(items, unit=unit, delay=2, leave=False, disable=not is_shown(progress), **more)


def is_shown(progress: bool | None) -> bool:
    """Whether a bar is shown: as `progress` says, and if it says nothing, where `watched`."""
    return watched() if progress is None else progress
