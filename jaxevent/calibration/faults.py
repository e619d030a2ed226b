"""Checks of a recording: faults of its events, its frames and their clocks."""

from typing import NamedTuple

from jaxevent.recording import Recording


class Fault(NamedTuple):
    """A fault of a recording, with the statistic behind it.

    | field | meaning |
    |---|---|
    | name | name of the check |
    | statistic | the number that was measured |
    | limit | the number from which it is a fault |
    | text | one sentence that says what was found |
    | remedy | one sentence that says what to do |
    """

    name: str
    statistic: float
    limit: float
    text: str
    remedy: str


def check_consistency(recording: Recording) -> tuple[Fault, ...]:
    """Check a recording for faults of events, frames and clocks."""
    return ()
