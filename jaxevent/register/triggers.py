"""Frame stamps taken from the event camera's external triggers."""

import dataclasses
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.recording import Frames, Recording
from jaxevent.register.refinement import Registration, refine

Edge = Literal["auto", "rising", "falling", "exposure"]
_MATCHED = 0.5  # of the frames that must have a trigger


def trigger_times(
    recording: Recording, edge: Edge = "auto", channel: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The times (us) of a recording's triggers, and the exposures (us) they tell, 0 where none.

    "rising" and "falling" are the triggers of that edge. "exposure" takes a signal that is high
    while the shutter is open: times are halfway from a rising edge to the falling one after it.
    "auto" is that where both edges occur, and else all triggers. `channel` is needed where there
    are several. Raises `InputError` where there are no such triggers.
    """
    triggers = recording.triggers
    if triggers is None or not len(triggers):
        missing = recording.describe_left_out("triggers")
        raise InputError(
            f"{recording.name}: holds no external triggers{missing}; leave out --triggers"
        )
    channels = np.unique(triggers.channel)
    if channel is None and len(channels) > 1:
        raise InputError(
            f"{recording.name}: holds triggers of the channels {', '.join(map(str, channels))}; "
            "choose one with --channel"
        )
    if channel is not None and channel not in channels:
        raise InputError(
            f"{recording.name}: holds no triggers of the channel {channel} but of "
            f"{', '.join(map(str, channels))}; choose one of these"
        )
    if channel is not None:
        triggers = triggers[triggers.channel == channel]
    if edge == "auto":
        both = {0, 1} <= set(np.unique(triggers.edge).tolist())
        edge = "exposure" if both else "auto"
    if edge == "auto":
        t = triggers.t
    elif edge != "exposure":
        t = triggers.t[triggers.edge == (edge == "rising")]
    else:
        opens = np.flatnonzero((triggers.edge[:-1] == 1) & (triggers.edge[1:] == 0))
        exposure = triggers.t[opens + 1] - triggers.t[opens]
        t = triggers.t[opens] + exposure // 2
        if len(t):
            return t, exposure
    if not len(t):
        raise InputError(
            f"{recording.name}: holds no triggers for {edge!r}; choose the edges that `jaxevent "
            "info` shows"
        )
    return t, np.zeros(len(t), np.int64)


def match_triggers(
    stamps: NDArray[np.int64], triggers: NDArray[np.int64], offset: float | int
) -> NDArray[np.intp]:
    """The trigger of each frame, or -1: the nearest one to its stamp plus the offset (s).

    Both are sorted times (us). From the middle frame on, where `offset` holds, the offset is that
    of the frame before, so that clocks may drift apart. A frame has none where the nearest one is
    half a frame away or more, or another frame's.
    """
    found, taken = np.full(len(stamps), -1), set()
    if len(stamps) < 2 or not len(triggers):
        return found
    half = np.median(np.diff(stamps)) / 2
    middle = len(stamps) // 2
    for rows in (range(middle, len(stamps)), range(middle - 1, -1, -1)):
        ahead = offset * 1e6
        if rows.step < 0 and found[middle] >= 0:
            ahead = float(triggers[found[middle]] - stamps[middle])
        for row in rows:
            wanted = stamps[row] + ahead
            after = int(np.searchsorted(triggers, wanted))
            near = [place for place in (after - 1, after) if 0 <= place < len(triggers)]
            place = min(near, key=lambda place: abs(triggers[place] - wanted))
            if abs(triggers[place] - wanted) < half and place not in taken:
                found[row] = place
                taken.add(place)
                ahead = float(triggers[place] - stamps[row])
    return found


def by_triggers(
    recording: Recording,
    other: Recording,
    found: Registration,
    edge: Edge = "auto",
    channel: int | None = None,
    *,
    lag: float | int | None = None,
) -> tuple[Recording, Registration]:
    """Give another camera's frames the stamps of the event camera's triggers.

    `found` is a registration by the frames' own stamps (`register.estimate`), whose offset needs to
    be right to less than half a frame: it tells which trigger is which frame's. Own stamps
    may jitter and drift; triggers are on the events' clock. What remains is the `lag` (s) from
    a trigger to mid-exposure, the offset of the registration that is returned with the recording
    of frames: it is refined (`register.refine`) unless given. Frames without a trigger are left
    out. Raises `InputError` where less than half of the frames have one.
    """
    assert other.frames is not None
    t, exposure = trigger_times(recording, edge, channel)
    place = match_triggers(other.frames.t, t, found.offset)
    rows = np.flatnonzero(place >= 0)
    if len(rows) < max(3, _MATCHED * len(place)):
        raise InputError(
            f"{other.name}: only {len(rows)} of its {len(place)} frames have a trigger, of "
            f"{len(t)}; choose other edges or another channel, or leave out --triggers"
        )
    kept = other.with_frames(rows)
    assert kept.frames is not None
    own = kept.frames.exposure
    stamped = Frames.of_checked(
        t[place[rows]], kept.frames.images, np.where(own > 0, own, exposure[place[rows]])
    )
    kept = dataclasses.replace(kept, frames=stamped)
    if lag is not None:
        return kept, dataclasses.replace(found, offset=float(lag))
    start = np.median(other.frames.t[rows] - stamped.t) * 1e-6 + found.offset
    refined = refine(recording, kept, float(start), found.grid)
    return kept, dataclasses.replace(refined, homography=found.homography)
