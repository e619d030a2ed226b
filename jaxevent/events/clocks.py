"""Comparison of the clock of a recording's frames with that of its events.

Two clocks, or a wrong unit of time, show in the spans of frames and events alone. Some spans
differ on one clock too: a still scene makes no events, a camera may begin or end before the other
does, and a short part of a recording may hold its frames on one side. Such differences are taken
for a fault only where they are longer than the constants of this module allow.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np

from jaxevent.errors import InputError, InputWarning
from jaxevent.recording import Recording

MIN_EVENTS = 100  # whose span says anything about a clock, short of one that is far off
MIN_OVERLAP_SHARE = 0.5  # of the shorter of the two spans
NEAR_FRAME_INTERVALS = 3  # intervals between frames that a span may miss the other by
MAX_SPAN_GAP_US = 1_000_000  # us between disjoint spans, from which they are refused
# A lone frame serves events that begin later; their distance, in spans of the events of at least
# `MAX_SPAN_GAP_US`, is not sensitive: another clock is days off.
MAX_LONE_FRAME_SPANS = 10
# One span that is shorter than this part of the other shows a wrong unit of time, if no more than
# one frame lies within the events or the frames are faster than cameras are.
MIN_SPAN_RATIO = 0.01
MIN_FRAME_INTERVAL_US = 100


class ClockMismatch(NamedTuple):
    """A disagreement between the times of frames and events.

    Attributes:
        is_disjoint: Whether the spans are too far apart to be of one clock.
        text: Description of the spans, without the name of the recording.
    """

    is_disjoint: bool
    text: str


def compare_clocks(recording: Recording, clock_offset: Any = 0.0) -> ClockMismatch | None:
    """Compare the span of a recording's frames with that of its events.

    Args:
        recording: Recording whose two ends of the events are read.
        clock_offset: Time in s that is added to the frames' stamps.

    Returns:
        The disagreement; None where there is none, and without events or without frames.
    """
    frames, events = recording.frames, recording.events
    if frames is None or not len(frames) or not len(events):
        return None
    late = round(float(clock_offset) * 1e6)
    first = int(frames.t[0]) - int(frames.exposure[0]) // 2 + late
    last = int(frames.t[-1]) + int(frames.exposure[-1]) // 2 + late
    begin, end = recording.event_span()
    shifted = f" with clock_offset = {float(clock_offset):g} s" if late else ""
    spans = (
        f"the frames last from {first / 1e6:.6f} to {last / 1e6:.6f} s{shifted}, the events from "
        f"{begin / 1e6:.6f} to {end / 1e6:.6f} s"
    )
    common = min(last, end) - max(first, begin)  # us; negative: the distance between the spans
    if len(frames) == 1:
        is_far = -common > MAX_LONE_FRAME_SPANS * max(MAX_SPAN_GAP_US, end - begin)
        return ClockMismatch(True, spans) if is_far else None
    interval = int(np.median(np.diff(frames.t)))
    near, shorter = NEAR_FRAME_INTERVALS * interval, min(last - first, end - begin)
    if common < 0 and -common > max(near, MAX_SPAN_GAP_US):
        return ClockMismatch(True, spans)
    if len(events) < MIN_EVENTS:
        return None
    if common < MIN_OVERLAP_SHARE * shorter and shorter - common > near:
        return ClockMismatch(False, spans)
    is_slow = interval > end - begin and MIN_SPAN_RATIO * (last - first) > end - begin
    is_fast = interval < MIN_FRAME_INTERVAL_US and last - first < MIN_SPAN_RATIO * (end - begin)
    if len(frames) > 2 and (is_slow or is_fast):
        return ClockMismatch(False, f"{spans}, and the frames are {interval / 1e6:.6g} s apart")
    return None


def check_clocks(recording: Recording, clock_offset: Any = 0.0) -> None:
    """Check that the frames and the events of a recording can be on one clock.

    Args:
        recording: Recording whose frames and events are about to be combined.
        clock_offset: Time in s that is added to the frames' stamps.

    Raises:
        InputError: The spans are too far apart; where they are merely unlikely, an `InputWarning`
            is issued.
    """
    mismatch = compare_clocks(recording, clock_offset)
    if mismatch is None:
        return
    if mismatch.is_disjoint:
        raise InputError(
            f"{recording.name}: {mismatch.text}, which cannot be one clock and unit; correct the "
            "times of the frames or clock_offset, estimate it by jaxevent register, or use a "
            "method of events alone, such as high-pass, at times of the events"
        )
    warnings.warn(
        f"{recording.name}: {mismatch.text}, which is unlikely of one clock and unit; check the "
        "times of the frames and clock_offset",
        InputWarning,
        stacklevel=3,
    )


def warn_of_clocks(recording: Recording) -> None:
    """Warn if the clock of the frames differs, for a method that leaves out frames that misfit."""
    mismatch = compare_clocks(recording)
    if mismatch is not None:
        warnings.warn(
            f"{recording.name}: {mismatch.text}, which is unlikely of one clock and unit; frames "
            "that do not fit the events are left out; check their times, or estimate the offset by "
            "jaxevent register",
            InputWarning,
            stacklevel=3,
        )
