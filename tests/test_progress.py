"""The line of progress: it moves while no step ends, and promises no time it cannot know."""

import time
from typing import Any

import pytest

from jaxevent import progress


class Line:
    """What is written to stderr."""

    def __init__(self, capsys: Any):
        self._capsys = capsys

    def read(self) -> str:
        """What was written since the last look."""
        return self._capsys.readouterr().err

    def wait_for(self, text: str, number: int = 1) -> None:
        """Until it was written that often since the last look."""
        until, seen = time.monotonic() + 30, ""
        while seen.count(text) < number:
            assert time.monotonic() < until, seen
            time.sleep(0.01)
            seen += self.read()


@pytest.fixture
def line(monkeypatch, capsys) -> Line:
    """Nothing is waited for before it is shown."""
    monkeypatch.setattr(progress, "SHOW_DELAY_S", 0.0)
    monkeypatch.setattr(progress, "POLL_INTERVAL_S", 0.01)
    return Line(capsys)


def test_the_time_moves_while_no_step_ends(line):
    with progress.stage("think", True):
        line.wait_for("think [00:00]", 3)
        with progress.bar(range(3), desc="count", unit="one", progress=True) as shown:
            line.wait_for("count:   0%", 3)
            with progress.stage("think deeply", True):
                line.wait_for("think deeply", 2)
            shown.update(1)
            line.wait_for("count:  33%")
        line.wait_for("think [", 2)
        progress.hide()
        line.wait_for("think [")
    # The last thing that is written clears the line.
    assert not progress._open and line.read().rpartition("\r")[2].strip() == ""


def test_nothing_is_written_where_nobody_looks_on(line):
    with progress.stage("think"), progress.bar(range(3), desc="count", unit="one") as shown:
        list(shown)
    assert line.read() == "" and not progress._open


def test_what_is_never_closed_leaves_the_line_to_others(line):
    with progress.stage("think", True):
        forgotten = progress.bar(desc="forgotten", unit="one", progress=True)
        line.wait_for("forgotten")
        del forgotten
        line.wait_for("think")


def test_the_rate_is_that_after_the_first_step(line, monkeypatch):
    """The first step compiles: 100 s. Others take 2 s."""
    now = 1000.0
    monkeypatch.setattr(progress.time, "time", lambda: now)
    monkeypatch.setattr(progress, "_tick", lambda: None)
    with progress.bar(total=11, desc="count", unit="one", progress=True) as shown:
        now += 100
        assert shown.format_dict["rate"] == 0  # not known
        shown.update(1)
        assert shown.format_dict["rate"] == 0
        for _ in range(4):
            now += 2
            shown.update(1)
        assert shown.format_dict["rate"] == pytest.approx(0.5)
        assert "<00:12," in shown.format_meter(**shown.format_dict)
        now += 8  # while a step lasts, less is promised
        assert shown.format_dict["rate"] == pytest.approx(0.25)
