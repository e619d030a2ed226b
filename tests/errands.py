"""Tasks for other processes to run; nothing here is slow to import."""

import os
import re
import signal
import time
from pathlib import Path

from jaxevent.errors import InputError


def errand(folder: str, name: str, then: str = "", times: int = 1, seconds: float = 0.0) -> dict:
    """Count the call in a file; in the first `times` calls of the name do as `then` says."""
    calls = Path(folder) / f"{name}.calls"
    with calls.open("a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(seconds)
    if len(calls.read_text().splitlines()) <= times:
        if then == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if then == "fail":
            raise RuntimeError(f"{name} has\na bad day")
        if then == "refuse":
            raise InputError(f"{name} cannot be used")
        if then == "not a number":
            return {"name": float("nan")}
    return {"name": name, "of": [1, 2.5, None]}


def log(folder: Path, what: str) -> list[str]:
    """The keys of the log's lines that say so."""
    text = (folder / "log.txt").read_text()
    return re.findall(rf"^\S+ \S+ \d+ (\S+) {what}", text, re.MULTILINE)
