"""Tasks: what is kept, what is tried again, and what a death costs."""

import json
import logging
import signal
import subprocess
import sys
import time
from pathlib import Path

import distributed
import errands
import pytest
from errands import errand, log

from jaxevent.errors import InputError
from jaxevent.runs.tasks import ComputeResources, Outcome, Task, attempt, run


@pytest.fixture(scope="module")
def address():
    """Of a cluster of two threads in this process."""
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        dashboard_address=":0",
        silence_logs=logging.CRITICAL,
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(params=["here", "processes", "cluster"])
def place(request) -> ComputeResources | None:
    if request.param == "cluster":
        return ComputeResources(cluster=request.getfixturevalue("address"))
    return ComputeResources(workers=2) if request.param == "processes" else None


def tasks_of(folder: Path, **then: str) -> list[Task]:
    return [
        Task(name, {"folder": str(folder), "name": name, "then": what}, f"key-{name}")
        for name, what in then.items()
    ]


def calls(folder: Path) -> dict[str, int]:
    """How often each errand was run."""
    return {path.stem: path.read_text().count("\n") for path in folder.glob("*.calls")}


@pytest.mark.slow
def test_outcomes_are_in_order_and_finished_tasks_are_kept(place, tmp_path):
    folder = tmp_path / "kept" / "here"
    some = tasks_of(tmp_path, a="", b="refuse", c="fail", d="not a number")
    twin = Task("another a", some[0].arguments, "key-a")
    outcomes = run(errand, [*some, twin], folder, place, retries=1)
    results = [{"name": name, "of": [1, 2.5, None]} for name in "acd"]
    assert [outcome.result for outcome in outcomes] == [results[0], None, *results[1:], results[0]]
    assert [outcome.error for outcome in outcomes] == [None, "b cannot be used", None, None, None]
    assert calls(tmp_path) == {"a": 1, "b": 1, "c": 2, "d": 2}
    assert sorted(log(folder, "started")) == [f"key-{name}" for name in "abccdd"]
    assert sorted(log(folder, "finished")) == ["key-a", "key-c", "key-d"]
    assert "RuntimeError: c has\na bad day" in (folder / "log.txt").read_text()

    more = [*tasks_of(tmp_path, a="", e="", c=""), Task("a", some[0].arguments)]
    again = run(errand, more, folder, place)
    assert [outcome.result["name"] for outcome in again] == ["a", "e", "c", "a"]
    assert calls(tmp_path) == {"a": 2, "b": 1, "c": 2, "d": 2, "e": 1}  # once without a key
    (folder / "key-e.json").write_text('{"result": ')
    assert run(errand, tasks_of(tmp_path, e=""), folder)[0].result["name"] == "e"
    assert calls(tmp_path)["e"] == 2
    assert json.loads((folder / "key-e.json").read_text())["result"]["name"] == "e"


@pytest.mark.slow
def test_attempts_run_out(place, tmp_path):
    arguments = {"folder": str(tmp_path), "name": "a", "then": "fail", "times": 9}
    (outcome,) = run(errand, [Task("a", arguments)], None, place, retries=3)
    assert outcome == Outcome(error="RuntimeError: a has a bad day")
    assert calls(tmp_path) == {"a": 4}


def test_a_task_that_another_run_has_finished_is_read(tmp_path):
    (task,) = tasks_of(tmp_path, a="")
    first = attempt(errand, task, tmp_path)
    assert attempt(errand, task, tmp_path) == first and calls(tmp_path) == {"a": 1}


@pytest.mark.slow
def test_a_dead_worker_loses_nothing_and_blames_only_its_task(tmp_path):
    some = tasks_of(tmp_path, a="", b="die", c="", d="die", e="")
    some[3].arguments["times"] = 9
    outcomes = run(errand, some, None, ComputeResources(workers=2), retries=1)
    assert [outcome.error is None for outcome in outcomes] == [True, True, True, False, True]
    assert outcomes[3].error == "d: its process died (exit code -9)"
    assert calls(tmp_path) == {"a": 1, "b": 2, "c": 1, "d": 2, "e": 1}


@pytest.mark.slow
def test_workers_end_with_the_process_that_started_them(tmp_path):
    code = f"""
import sys
sys.path.insert(0, {str(Path(errands.__file__).parent)!r})
from errands import errand, log
from jaxevent.runs.tasks import ComputeResources, Task, run
if __name__ == "__main__":
    some = [Task(n, dict(folder={str(tmp_path)!r}, name=n, seconds=60.0), n) for n in "ab"]
    run(errand, some, None, ComputeResources(workers=2))
"""
    script = tmp_path / "script.py"
    script.write_text(code)
    parent = subprocess.Popen([sys.executable, script])
    deadline = time.monotonic() + 60
    while sum(calls(tmp_path).values()) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    parent.kill()
    parent.wait()
    children = [int(path.read_text()) for path in tmp_path.glob("*.calls")]
    assert len(children) == 2

    def alive(pid: int) -> bool:
        status = Path(f"/proc/{pid}/stat")
        return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"

    while any(map(alive, children)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not any(map(alive, children))


def test_places_that_cannot_be(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="exclude each other; give one"):
        ComputeResources(workers=2, cluster="tcp://x:1")
    with pytest.raises(InputError, match="0 workers cannot work"):
        ComputeResources(workers=0)
    with pytest.raises(InputError, match="-1 retries are not possible"):
        run(errand, [], retries=-1)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file/x: the folder cannot be made"):
        run(errand, [], tmp_path / "file" / "x")
    with pytest.raises(InputError, match="none.json: there is no such scheduler file"):
        run(errand, [], None, ComputeResources(scheduler_file=tmp_path / "none.json"))
    monkeypatch.setattr("jaxevent.runs.tasks.CONNECT_TIMEOUT_S", 1)
    with pytest.raises(InputError, match="tcp://127.0.0.1:9: no Dask scheduler answers"):
        run(errand, tasks_of(tmp_path, a=""), None, ComputeResources(cluster="tcp://127.0.0.1:9"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"\[cluster\]"):
        ComputeResources(cluster="tcp://x:1")


DEFERRED = """
import os, signal, subprocess, sys
from jaxevent.runs.tasks import defer_signals

signal.signal(signal.SIGINT, signal.default_int_handler)
child = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('goes on')"
try:
    with defer_signals():
        os.kill(os.getpid(), signal.SIGINT)
        subprocess.run([sys.executable, "-c", child])
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="no masks of signals here")
def test_an_interrupt_waits_until_a_process_has_started():
    """A child that is interrupted as it starts would print a traceback; it inherits the mask."""
    done = subprocess.run([sys.executable, "-c", DEFERRED], capture_output=True, text=True)
    assert done.stdout == "goes on\ninterrupted\n" and done.stderr == ""
