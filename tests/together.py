"""Several threads that do something at once, and forked processes that say what they found."""

import os
import pickle
import random
import select
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

THREADS = 8


def assert_equal(found: Any, true: Any) -> None:
    """Arrays, one after another, are equal to the bit."""
    for one, other in zip(found, true, strict=True):
        np.testing.assert_array_equal(one, other)


def at_once(job: Callable[[random.Random], Any], threads: int = THREADS) -> list[Any]:
    """What a job gives in each of several threads that begin together and often change."""
    begin, double = threading.Barrier(threads), jax.config.jax_enable_x64
    before = sys.getswitchinterval()

    def run(number: int) -> Any:
        # A thread begins with the settings of the process, not with those of its creator.
        with jax.enable_x64(double):
            begin.wait(60)
            return job(random.Random(number))

    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(run, range(threads)))
    finally:
        sys.setswitchinterval(before)


def in_child(job: Callable[[], Any], seconds: float = 60) -> Any:
    """What a job gives in a forked process, or raises there; fails where it takes too long."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python advise against forks
        child = os.fork()
    if not child:
        try:
            with os.fdopen(write, "wb") as pipe:
                try:
                    found = job()
                except Exception as error:
                    traceback.print_exc()
                    found = error
                pipe.write(pickle.dumps(found))
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        told, _, _ = select.select([pipe], [], [], seconds)
        if not told:
            os.kill(child, signal.SIGKILL)
        content = pipe.read()
        os.waitpid(child, 0)
    assert told, f"the child did not end within {seconds} s"
    found = pickle.loads(content)
    if isinstance(found, Exception):
        raise found
    return found
