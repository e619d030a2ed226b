"""Clocks of two cameras: their offset, and stamps by external triggers."""

import dataclasses
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import correlate

from jaxevent.errors import InputError
from jaxevent.recording import Frames, Recording, check_recording
from jaxevent.register.frames import log_image
from jaxevent.register.geometry import Registration
from jaxevent.register.refinement import refine

_N_CANDIDATES = 4  # offsets that are tried
_N_CELLS_ACROSS = 64  # to the width of an image, where clocks are compared
_BLOCK_STEPS = 128  # steps of that raster held at a time


def clock_offsets(
    recording: Recording, other: Recording, search: float | int | None = None
) -> list[float]:
    """Return offsets of the clocks at which frames and events change together, the likeliest first.

    Both are reduced to about 64 x 48 cells on a raster of half a frame: the change of ln intensity
    from a frame to the next, and ON minus OFF events of as long a time. Two signatures are
    correlated at every lag (Pearson's r of the overlap; Padfield, CVPR 2010): the size of the
    changes, the logarithm of the mean of their absolute values at two smoothnesses, for which the
    cameras may look in different directions; and, weighted twice, the smoothed changes at places,
    for which they should look roughly alike. Offsets are right to about half a frame, enough for
    `refine`.

    Args:
        recording: Events of the event camera.
        other: Frames of the other camera.
        search: Largest offset, s. By default at least half the shorter recording overlaps.

    Returns:
        Offsets (s) to add to the frames' time stamps: up to four maxima of the sum of correlations
        with half the largest or more, and 0 if the clocks may be the same.

    Raises:
        InputError: No offset lets the recordings overlap.
    """
    assert other.frames is not None
    t = other.frames.t
    step = max(float(np.median(np.diff(t))) / 2, 1.0)
    begin, end = recording.event_span()
    middle, along = (t[1:] + t[:-1]) / 2, begin + step * np.arange(1, int((end - begin) / step) + 1)
    across = np.arange(middle[0], middle[-1] + 1e-3, step)
    if len(across) < 6 or len(along) < 6:
        return [0.0]
    both = [_event_signatures(recording, step), _frame_signatures(other)]
    weights = np.append([0.5, 0.5], np.full(both[0].shape[1] - 2, 2 / (both[0].shape[1] - 2)))
    total, n = np.zeros(()), np.zeros(0)
    for weight, one, two in zip(weights, both[0].T, both[1].T, strict=True):
        r, n = _correlate(one, np.interp(across, middle, two))
        total = total + weight * r
    lags = (np.arange(len(n)) - (len(across) - 1)) * step + along[0] - across[0]
    fewest = max(6, min(len(along), len(across)) / 2 * (search is None))
    allowed = (n >= fewest) & (np.abs(lags) <= (math.inf if search is None else search * 1e6))
    around = np.pad(np.where(allowed, total, -np.inf), 1, constant_values=-np.inf)
    score = around[1:-1]
    peaks = np.flatnonzero((score >= around[:-2]) & (score > around[2:]) & (score > 0))
    peaks = peaks[np.argsort(-score[peaks], kind="stable")][:_N_CANDIDATES]
    found = []
    for peak in peaks:
        if score[peak] < score[peaks[0]] / 2:
            break
        left, top, right = around[peak : peak + 3]
        bend = left - 2 * top + right
        shift = 0.5 * (left - right) / bend if np.isfinite(bend) and bend < 0 else 0.0
        found.append(float((lags[peak] + shift * step) * 1e-6))
    same = bool(allowed[np.argmin(np.abs(lags))]) and abs(lags).min() <= step
    if same and all(abs(one) > 1e-6 * step for one in found):
        found.append(0.0)
    if not found:
        raise InputError(
            f"{other.name}: no offset of its clock brings its frames and the events together; give "
            "the offset that is added to the frames' time stamps"
        )
    return found


def _signature(change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the signature (times, n) of changes (times, rows, cells): two sizes, then places."""
    smooth: list[NDArray] = [
        ndimage.gaussian_filter(change, (0, sigma, sigma)) for sigma in (1.5, 4)
    ]
    sizes = [np.log(np.abs(one).mean((1, 2)) + 1e-5) for one in smooth]
    wide: NDArray = ndimage.gaussian_filter(change, (0, 8, 8), mode="constant")
    middle = wide.shape[1] // 2
    # Six rows of eight about the middle, wherever the images end.
    rows = np.clip(middle + np.arange(-20, 21, 8), 0, wide.shape[1] - 1)
    places = wide[:, rows][:, :, 4::8].reshape(len(wide), -1)
    return np.concatenate([np.stack(sizes, 1), places], 1)


def _cells(width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """Return the cell rows and columns of pixel rows and columns, and the number of cell rows."""
    rows = max(1, round(height * _N_CELLS_ACROSS / width))
    down = np.minimum(np.arange(height) * _N_CELLS_ACROSS // width, rows - 1)
    return down, np.arange(width) * _N_CELLS_ACROSS // width, rows


def _frame_signatures(other: Recording) -> NDArray[np.float64]:
    """Return signatures of the change of ln intensity from each frame to the next."""
    assert other.frames is not None
    down, along, rows = _cells(other.width, other.height)
    place = (down[:, None] * _N_CELLS_ACROSS + along).ravel()
    count = np.maximum(np.bincount(place, minlength=rows * _N_CELLS_ACROSS), 1)
    out, before = [], log_image(other, 0)
    for first in range(1, len(other.frames), _BLOCK_STEPS):
        changes = []
        for row in range(first, min(first + _BLOCK_STEPS, len(other.frames))):
            level, good = log_image(other, row)
            change = np.where(good & before[1], level - before[0], 0).ravel()
            changes.append(np.bincount(place, change, rows * _N_CELLS_ACROSS) / count)
            before = level, good
        out.append(_signature(np.stack(changes).reshape(-1, rows, _N_CELLS_ACROSS)))
    return np.concatenate(out)


def _event_signatures(recording: Recording, step: float) -> NDArray[np.float64]:
    """Return signatures of the events, in windows of two steps, a step apart.

    Args:
        recording: Events.
        step: Step, us.

    Returns:
        A signature for each window, of 0.2 (ON - OFF) per pixel.
    """
    down, along, rows = _cells(recording.width, recording.height)
    begin, end = recording.event_span()
    steps, out = int((end - begin) / step) + 1, []
    for first in range(0, max(steps - 1, 1), _BLOCK_STEPS):
        count = min(_BLOCK_STEPS + 1, steps - first)
        edges = (begin + math.ceil(k * step) for k in (first, first + count))
        events = recording.events[slice(*(recording.events.index(edge) for edge in edges))]
        when = np.clip(((events.t - begin) / step).astype(int) - first, 0, count - 1)
        place = (when * rows + down[events.y]) * _N_CELLS_ACROSS + along[events.x]
        sign = np.where(events.p, 0.2, -0.2) * _N_CELLS_ACROSS**2 / recording.width**2
        net = np.bincount(place, sign, count * rows * _N_CELLS_ACROSS).astype(np.float64)
        net = net.reshape(count, rows, _N_CELLS_ACROSS)
        out.append(_signature(net[1:] + net[:-1]))
    return np.concatenate(out)


def _correlate(
    one: NDArray[np.float64], two: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Correlate two series at every lag.

    Args:
        one: (n,) values.
        two: (m,) values.

    Returns:
        Pearson's correlation, and the number of values that overlap, (n + m - 1,) each. Entry k:
        two[i] lies on one[i + k - (m - 1)].
    """

    one, two = one - one.mean(), two - two.mean()

    def over(a: NDArray, b: NDArray) -> NDArray:
        return correlate(a, b, "full", "fft")

    ones, twos = np.ones_like(one), np.ones_like(two)
    n = np.maximum(np.rint(over(ones, twos)), 1)
    a, b, ab = over(one, twos), over(ones, two), over(one, two)
    aa, bb = over(one**2, twos) - a**2 / n, over(ones, two**2) - b**2 / n
    enough = (aa > 1e-9 * n) & (bb > 1e-9 * n)
    r = (ab - a * b / n) / np.sqrt(np.where(enough, aa * bb, 1))
    return np.where(enough, r, 0), n


Edge = Literal["auto", "rising", "falling", "exposure"]
_MIN_TRIGGERED_SHARE = 0.5  # of the frames that must have a trigger


def trigger_times(
    recording: Recording, edge: Edge = "auto", channel: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the times of a recording's triggers, and the exposures that they show.

    Args:
        recording: A recording with external triggers.
        edge: "rising" and "falling" select the triggers of that edge. "exposure" takes a signal
            that is high while the shutter is open: times are halfway from a rising edge to the
            falling one after it. "auto" is "exposure" if both edges occur, else all triggers.
        channel: Channel of the triggers, needed if there are several.

    Returns:
        Times (n,), us, and exposures (n,), us, 0 if unknown.

    Raises:
        InputError: There are no such triggers.
    """
    check_recording(recording, "trigger_times")
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
    """Match each frame to the trigger nearest to its stamp plus the offset.

    From the middle frame on, at which `offset` holds, the offset is that of the frame before, so
    that clocks may drift apart. A frame has none if the nearest one is half a frame away or more,
    or another frame's.

    Args:
        stamps: (frames,) sorted stamps, us.
        triggers: (n,) sorted times of triggers, us.
        offset: Seconds to add to the stamps.

    Returns:
        (frames,) indices of triggers, -1 for none.
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


def stamp_by_triggers(
    recording: Recording,
    other: Recording,
    found: Registration,
    edge: Edge = "auto",
    channel: int | None = None,
    *,
    lag: float | int | None = None,
) -> tuple[Recording, Registration]:
    """Give another camera's frames the stamps of the event camera's triggers.

    Own stamps may jitter and drift; triggers are on the events' clock. There remains the lag from
    a trigger to mid-exposure. Frames without a trigger are left out.

    Args:
        recording: Recording with external triggers.
        other: Frames of the other camera.
        found: Registration by the frames' own stamps (`estimate`), whose offset is right to
            less than half a frame.
        edge: Edges to take, as in `trigger_times`.
        channel: Channel of the triggers, needed if there are several.
        lag: Seconds from a trigger to mid-exposure; refined (`refine`) unless given.

    Returns:
        The frames with their new stamps, and a registration with the lag as its offset.

    Raises:
        InputError: Fewer than half of the frames have a trigger.
    """
    assert other.frames is not None
    t, exposure = trigger_times(recording, edge, channel)
    place = match_triggers(other.frames.t, t, found.offset)
    rows = np.flatnonzero(place >= 0)
    if len(rows) < max(3, _MIN_TRIGGERED_SHARE * len(place)):
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
