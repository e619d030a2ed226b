"""CPU seconds of this process, which other programs on a machine change less than a clock."""

import time
from collections.abc import Callable, Mapping

import numpy as np


def least_cpu(tasks: Mapping[str, Callable[[], object]], repeat: int = 3) -> dict[str, float]:
    """The least CPU seconds of each task, of so many turns after one that compiles.

    In every turn each task runs once, so that all meet the same neighbours.
    """
    least = dict.fromkeys(tasks, np.inf)
    for turn in range(repeat + 1):
        for name, task in tasks.items():
            start = time.process_time()
            task()
            if turn:
                least[name] = min(least[name], time.process_time() - start)
    return least


def cpu_seconds(task: Callable[[], object], repeat: int = 5) -> float:
    """The same of one task."""
    return least_cpu({"": task}, repeat)[""]
