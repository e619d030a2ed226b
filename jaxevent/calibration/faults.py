"""Checks of a recording: faults of its events, its frames and their clocks.

Limits come from chance, from geometry or from simulated scenes; docs/faults.md gives each with its
reason. All checks use one sample of the recording, so that they cost seconds however long it is.
"""

import warnings
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.clipping import MAX_CLIPPED_SHARE, MIN_CLIPPED_SHARE, find_clipping
from jaxevent.calibration.correspondence import (
    I0,
    MIN_PIXELS,
    MIN_SIGNIFICANCE,
    TRANSFORMS,
    Correspondence,
    measure_correspondence,
    turn_events,
)
from jaxevent.calibration.gaps import MAX_MISSED_EVENTS, find_gaps
from jaxevent.calibration.hot import MAX_DEAD_SHARE, MAX_EVENTS_SHARE
from jaxevent.calibration.light import common_change
from jaxevent.calibration.sampling import Sample, count_between, log_changes, take_sample
from jaxevent.display import plural
from jaxevent.errors import InputWarning
from jaxevent.events.clocks import MIN_OVERLAP_SHARE, MIN_SPAN_RATIO, compare_clocks
from jaxevent.recording import Events, Recording, check_recording
from jaxevent.time_units import WINNING_NATS, doubt_microseconds

MAX_HOT_SHARE = 0.01  # of the pixels
MAX_PAUSE_US = 10_000  # lights on mains of 50 Hz pause for less
MAX_MISSED_SHARE = 0.05  # of the events, in gaps up to 10 ms
BURST_US, BURST_RATIO, BURST_BINS = 1_000, 10, 10  # a burst is 10 times what is around it
MAX_BURST_SHARE = 0.05  # of the events
MAX_REPEATED_EVENTS_SHARE = 0.05  # of the events
MAX_CLOCK_STEP_US = 100  # within a coarser step a pixel may well fire twice
MAX_POLARITY_SHARE, MIN_POLARITIES = 0.95, 1_000
MIN_ADVANTAGE = 2.0  # of a correlation over that of the recording as it is
MIN_BUSY = 100  # pixels with several events between frames, which determine clock and exposure
# Tiles with such pixels: where all of them agree, the significance is the root of their number,
# and half of that is usual.
MIN_RELATED = (2.5 * MIN_SIGNIFICANCE) ** 2
MAX_OFFSET_INTERVALS = 0.25  # stamp at one end of an exposure that lasts half the interval
MAX_EXPOSURE_INTERVALS = 1.0  # frames of one camera are not exposed at the same time
MAX_DILUTION = 1.25  # of the change per event; slow scenes without blur reach 1.1
MAX_UNDONE_SHARE = 0.5  # of the events
MAX_SILENT_SHARE, MIN_CHANGED_PIXELS = 0.02, 300  # of the pixels that change in the frames
MIN_THRESHOLD_EVENTS = 4
# Between frames that are equal, of pixels that change by several thresholds.
MAX_REPEATED_SHARE, MIN_NET_EVENTS, MIN_CHANGING = 0.05, 2, 50
MAX_FLICKER = 0.05  # of ln I, half the lowest thresholds of sensors
DEAD_PIXELS_REMEDY = (
    "look for pixels that are broken, or masked by the camera or a filter; images of their places "
    "rest on the frames, if there are any"
)

# Faults of the events alone, whether frames revealed them or not.
EVENT_FAULTS = (
    *("hot pixels", "dead pixels", "unusual clock", "missing events", "event bursts"),
    *("repeated events", "lost polarity", "inverted polarity", "flipped or swapped axes"),
)


class Fault(NamedTuple):
    """A fault of a recording, with the statistic behind it.

    | field | meaning |
    |---|---|
    | name | name of the check |
    | statistic | the number that was measured |
    | limit | the number above which it is a fault |
    | text | one sentence that says what was found |
    | remedy | one sentence that says what to do |
    """

    name: str
    statistic: float
    limit: float
    text: str
    remedy: str

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.text} (statistic {self.statistic:.3g}, limit {self.limit:.3g}); "
            f"{self.remedy}"
        )


def check_consistency(recording: Recording, sample: Sample | None = None) -> tuple[Fault, ...]:
    """Check a recording for faults of events, frames and clocks.

    Hot pixels go out first; the other checks see the rest. What needs frames is left out without
    them, and what needs both clocks where they do not meet.

    Args:
        recording: The recording, in memory or in a file.
        sample: A sample of it (`sampling.take_sample`); None: it is taken here.

    Returns:
        The faults, empty where nothing is wrong.
    """
    check_recording(recording, "check_consistency")
    sample = take_sample(recording) if sample is None else sample
    return tuple(
        fault
        for found in (
            _check_hot_pixels(sample),
            _check_dead_pixels(sample),
            _check_unit(recording),
            _check_times(recording, sample),
            _check_repeated_events(sample),
            _check_both(recording, sample),
            _check_white(recording),
        )
        for fault in found
        if fault.statistic > fault.limit
    )


def _check_hot_pixels(sample: Sample) -> Iterator[Fault]:
    """Check the share of hot pixels, and that of their events."""
    share, number = float(sample.hot.mean()), int(sample.hot.sum())
    events = sample.counts.sum(0)
    of_events = float(events[sample.hot].sum() / max(events.sum(), 1))
    statistic, limit = of_events, MAX_EVENTS_SHARE
    text = f"{number} hot {plural('pixel', number)} made {100 * of_events:.3g} % of the events"
    if share > MAX_HOT_SHARE:
        statistic, limit = share, MAX_HOT_SHARE
        text = (
            f"{100 * share:.3g} % of the pixels fire in all parts of the recording, unlike those "
            "around them"
        )
    yield Fault(
        "hot pixels", statistic, limit, text,
        "remove them: jaxevent filter --hot-pixels, or events.remove_hot_pixels with "
        "calibrate(recording).hot_pixels",
    )  # fmt: skip


def _check_dead_pixels(sample: Sample) -> Iterator[Fault]:
    """Check the share of pixels without an event, of those between busy ones."""
    yield Fault(
        "dead pixels", sample.dead_share, MAX_DEAD_SHARE,
        f"{100 * sample.dead_share:.3g} % of the pixels between busy ones have no event at all",
        DEAD_PIXELS_REMEDY,
    )  # fmt: skip


def warn_of_unit(recording: Recording) -> None:
    """Warn if the times of events look like those of another unit than microseconds."""
    for fault in _check_unit(recording):
        if fault.statistic > fault.limit:
            warnings.warn(f"{recording.name}: {fault}", InputWarning, stacklevel=3)


def _check_unit(recording: Recording) -> Iterator[Fault]:
    """Check whether the times of events are as usual as microseconds."""
    doubt = doubt_microseconds(recording.events, (recording.width, recording.height))
    if doubt is not None:
        yield Fault(
            "unusual clock", doubt.nats, WINNING_NATS, doubt.text,
            f"if so, {doubt.remedy}, or read the file with --time-unit",
        )  # fmt: skip


def _times(recording: Recording, sample: Sample) -> list[NDArray[np.int64]]:
    """Return times of events without hot pixels: of all in memory, else of the segments."""
    events = recording.events
    if not isinstance(events, Events):
        return [segment.t for segment in sample.segments]
    return [events.t[~sample.hot[events.y, events.x]] if sample.hot.any() else events.t]


def _check_times(recording: Recording, sample: Sample) -> Iterator[Fault]:
    """Check the times of events for gaps and bursts."""
    gaps, total, in_bursts = [], 0, 0
    for t in _times(recording, sample):
        total += len(t)
        found = find_gaps(t)
        gaps += zip(found.missed.tolist(), found.begin.tolist(), found.end.tolist(), strict=True)
        in_bursts += _count_bursts(t)
    long = [gap for gap in gaps if gap[2] - gap[1] >= MAX_PAUSE_US]
    lost = sum(gap[0] for gap in gaps)
    if long or lost > MAX_MISSED_SHARE * (total + lost):
        most, begin, end = max(long or gaps)
        yield Fault(
            "missing events", float(most), MAX_MISSED_EVENTS,
            f"about {100 * lost / (total + lost):.2g} % of the events are missing in {len(gaps)} "
            f"{plural('gap', len(gaps))}, about {most:,} from {begin / 1e6:.6f} to "
            f"{end / 1e6:.6f} s",
            "record again with a larger buffer or a lower event rate; images around the gaps rest "
            "on the frames, if there are any",
        )  # fmt: skip
    share = in_bursts / max(total, 1)
    yield Fault(
        "event bursts", share, MAX_BURST_SHARE,
        f"{100 * share:.3g} % of the events come in milliseconds with over {BURST_RATIO} times as "
        "many as around them",
        "look for flashes of light, and for stamps that a buffer gave many events together",
    )  # fmt: skip


def _count_bursts(t: NDArray[np.int64]) -> int:
    """Count the events in bins of 1 ms that hold far more than the 10 on either side."""
    if not len(t):
        return 0
    bins, counts = np.unique((t - t[0]) // BURST_US, return_counts=True)
    ends = np.concatenate([[0], np.cumsum(counts)])
    before = ends[:-1] - ends[np.searchsorted(bins, bins - BURST_BINS)]
    after = ends[np.searchsorted(bins, bins + BURST_BINS, side="right")] - ends[1:]
    around = np.maximum(before, after) / BURST_BINS + 1
    inner = (bins >= BURST_BINS) & (bins <= bins[-1] - BURST_BINS)
    return int(counts[inner & (counts > BURST_RATIO * around)].sum())


def _check_repeated_events(sample: Sample) -> Iterator[Fault]:
    """Check the share of events that are in the recording more than once."""
    total, different = 0, 0
    for t, pixel, p, *_ in sample.segments:
        steps = np.diff(t)
        if not steps.any() or steps[steps > 0].min() > MAX_CLOCK_STEP_US:
            continue
        total += len(t)
        # Nearly sorted: as `np.unique` makes a hash table of integers, it takes 50 times as long.
        keys = np.sort(((t - t[0]) * len(sample.places) + pixel) * 2 + p, kind="stable")
        different += 1 + np.count_nonzero(np.diff(keys))
    share = 1 - different / max(total, 1)
    yield Fault(
        "repeated events", share if total else 0.0, MAX_REPEATED_EVENTS_SHARE,
        f"{100 * share:.3g} % of the events repeat the time, pixel and polarity of another one",
        "look for parts that were stored twice; jaxevent filter --refractory 1 keeps one of each",
    )  # fmt: skip


def _check_both(recording: Recording, sample: Sample) -> Iterator[Fault]:
    """Check polarity, and events against frames."""
    on, off = sample.counts[:, ~sample.hot].sum(1).tolist()
    if one_sign := on + off >= MIN_POLARITIES and max(on, off) > MAX_POLARITY_SHARE * (on + off):
        yield Fault(
            "lost polarity", max(on, off) / (on + off), MAX_POLARITY_SHARE,
            f"{100 * on / (on + off):.3g} % of the events are ON, while what passes a pixel makes "
            "events of both polarities",
            "read the file again with the column or bit of its polarity; use methods without "
            "polarity, or frames alone",
        )  # fmt: skip
    if (mismatch := compare_clocks(recording)) is not None:
        outside, limit = _mismatch(recording)
        yield Fault(
            "disjoint clocks", outside, limit, mismatch.text,
            "check the unit and the clock of both, or estimate the offset: jaxevent register",
        )  # fmt: skip
        if mismatch.is_disjoint:
            return
    if (correspondence := measure_correspondence(sample)) is None:
        return
    turn, relation = (None, None) if one_sign else _check_relation(correspondence)
    if relation is not None:
        yield relation
    if turn is not None:  # the other checks see what the remedy leaves
        sample = turn_events(sample, *turn)
        correspondence = measure_correspondence(sample) or correspondence
    has_polarity = not one_sign and (relation is None or turn is not None)
    is_related = has_polarity and correspondence.significance[0].max() > MIN_SIGNIFICANCE
    offset = correspondence.offset if is_related else 0.0
    yield from _check_brightness(sample, offset, has_polarity)
    if is_related:
        if sample.dead_share <= MAX_DEAD_SHARE:
            yield from _check_silent_pixels(sample, offset)
        yield from _check_clock(correspondence)


def _mismatch(recording: Recording) -> tuple[float, float]:
    """Return the statistic of a mismatch of clocks and its limit."""
    frames = recording.frames
    assert frames is not None
    spans = [(int(frames.t[0]), int(frames.t[-1])), recording.event_span()]
    lengths = sorted(end - begin for begin, end in spans)
    common = min(end for _, end in spans) - max(begin for begin, _ in spans)
    outside = 1 - max(common, 0) / max(lengths[0], 1)
    if outside > 1 - MIN_OVERLAP_SHARE:
        return outside, 1 - MIN_OVERLAP_SHARE
    return lengths[1] / max(lengths[0], 1), 1 / MIN_SPAN_RATIO


def _check_relation(
    correspondence: Correspondence,
) -> tuple[tuple[str, bool] | None, Fault | None]:
    """Check whether events belong to the frames, as they are or turned over.

    Returns:
        How events have to be turned, as of `turn_events`, and the fault.
    """
    r, z = correspondence.correlation, correspondence.significance
    here = max(float(r[0].max()), 0.0)
    real = np.where(np.abs(z) > MIN_SIGNIFICANCE, r, 0)
    kind, lag = np.unravel_index(np.argmax(np.abs(real)), real.shape)
    found, significance = float(real[kind, lag]), float(abs(z[kind, lag]))
    name = list(TRANSFORMS)[kind]
    if found and (kind or found < 0) and abs(found) > MIN_ADVANTAGE * here:
        inverse = "polarity inverted" if found < 0 else ""
        changed = " and ".join(part for part in (name, inverse) if part)
        return (name, found < 0), Fault(
            "flipped or swapped axes" if kind else "inverted polarity",
            significance, MIN_SIGNIFICANCE,
            f"events correlate with the changes of the frames by {here:.2f} at most, with "
            f"{changed} by {abs(found):.2f}",
            f"make the recording of events with {changed}"
            + (", dataclasses.replace(events, p=~events.p)" if inverse else ""),
        )  # fmt: skip
    if not found and correspondence.activity > MIN_SIGNIFICANCE:
        return None, Fault(
            "lost polarity", correspondence.activity, MIN_SIGNIFICANCE,
            f"events come where and when frames change, but their polarity says nothing about the "
            f"sign: the correlation is {float(np.abs(r[0]).max()):.2f} at most",
            "read the file again with the column or bit of its polarity; use methods without "
            "polarity, or frames alone",
        )  # fmt: skip
    if not found and correspondence.tiles > MIN_RELATED:
        return None, Fault(
            "unrelated events", float(correspondence.tiles), MIN_RELATED,
            f"events and changes of the frames do not correlate within "
            f"{correspondence.lags[-1] / 1e3:.0f} ms: by {float(np.abs(r[0]).max()):.2f} at most",
            "check that frames and events are of one recording, clock and camera, and that no axis "
            "is flipped",
        )  # fmt: skip
    return None, None


def _check_clock(correspondence: Correspondence) -> Iterator[Fault]:
    """Check offset and exposure of frames that belong to the events."""
    if correspondence.busy < MIN_BUSY:
        return
    interval = correspondence.interval
    if correspondence.exposure > MAX_EXPOSURE_INTERVALS * interval:
        yield Fault(
            "blurred frames", correspondence.dilution, MAX_DILUTION,
            f"changes of the frames follow the events over {correspondence.exposure / 1e3:.0f} ms, "
            f"longer than their interval of {interval / 1e3:.0f} ms, as means of several do",
            "use the frames before they were averaged, or only every few of them",
        )  # fmt: skip
        if correspondence.dilution > MAX_DILUTION:
            return
    offset, sigma = correspondence.offset * 1e-6, correspondence.offset_sigma * 1e-6
    if abs(offset) - 2 * sigma > MAX_OFFSET_INTERVALS * interval * 1e-6:
        yield Fault(
            "clock offset", abs(offset), MAX_OFFSET_INTERVALS * interval * 1e-6,
            f"frames fit the events best {abs(offset) * 1e3:.1f} ms "
            f"{'later' if offset > 0 else 'earlier'} than their stamps",
            f"add {round(1e6 * offset)} us to the frames' times, or leave them: calibration finds "
            "the parameter clock_offset",
        )  # fmt: skip


def _check_silent_pixels(sample: Sample, offset: float) -> Iterator[Fault]:
    """Check the share of pixels without an event, of those that change in the frames.

    What is at rest changes in no frame. The log intensity of a pixel without an event stays between
    c_off below and c_on above a level: its range is below twice the mean threshold. That is the sum
    of changes between frames divided by that of their net events, of pixels with 4 events or more;
    noise of the frames makes it larger.

    Args:
        sample: Sample of the recording.
        offset: Time added to the frames' stamps, us; NaN: none.

    Yields:
        The fault.
    """
    offset_us, n = 0 if np.isnan(offset) else int(offset), len(sample.places)
    counts, ranges, moved, net = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for segment in sample.segments:
        counts += np.bincount(segment.pixel, minlength=n)
        covered = segment.is_covered(offset_us)
        used = segment.clear & (np.append(covered, False) | np.append(False, covered))[:, None]
        L = np.log(np.maximum(segment.intensity, 0) + np.float32(I0))
        top, bottom = (np.where(used, v, -np.inf).max(0, initial=-np.inf) for v in (L, -L))
        ranges = np.maximum(ranges, top + bottom)
        changes, clear = log_changes(segment, I0)
        on, off = count_between(segment, offset_us).swapaxes(0, 1)
        clear &= covered[:, None]
        moved += (clear * np.abs(changes)).sum(0)
        net += (clear * np.abs(on - off)).sum(0)
    busy = counts >= MIN_THRESHOLD_EVENTS
    threshold = moved[busy].sum() / max(net[busy].sum(), 1)
    changed = (ranges > 2 * threshold) & ~sample.hot.ravel()[sample.places]
    number, share = int(changed.sum()), float((counts == 0)[changed].sum() / max(changed.sum(), 1))
    if busy.sum() >= MIN_CHANGED_PIXELS and number >= MIN_CHANGED_PIXELS:
        yield Fault(
            "dead pixels", share, MAX_SILENT_SHARE,
            f"{100 * share:.3g} % of the {number:,} pixels that change in the frames have no event",
            DEAD_PIXELS_REMEDY,
        )  # fmt: skip


def _check_brightness(sample: Sample, offset: float, has_polarity: bool) -> Iterator[Fault]:
    """Check the brightness of frames: repeated frames, flicker, and changes undone between frames.

    Args:
        sample: Sample of the recording.
        offset: Time added to the frames' stamps, us; NaN: none.
        has_polarity: Whether the polarity of events can be used.

    Yields:
        The faults, with their statistics.
    """
    steps, net, total, repeated, intervals = [], 0, 0, 0, 0
    for segment in sample.segments:
        changes, clear = log_changes(segment, I0)
        offset_us = 0 if np.isnan(offset) else int(offset)
        counts, covered = count_between(segment, offset_us), segment.is_covered(offset_us)
        known = (part[covered] for part in (changes, clear, counts))
        for d, used, (on, off) in zip(*known, strict=True):
            quiet = used & (on + off == 0)
            repeated += not d.any() and (np.abs(on - off) >= MIN_NET_EVENTS).sum() >= MIN_CHANGING
            intervals += 1
            net += int(np.abs(on - off).sum())
            total += int((on + off).sum())
            if quiet.sum() >= MIN_PIXELS:
                steps.append(float(common_change(d[quiet])))
    share = repeated / max(intervals, 1)
    yield Fault(
        "repeated frames", share, MAX_REPEATED_SHARE,
        f"{100 * share:.3g} % of the frames equal the one before them, while events report changes",
        "leave out the repeated frames, with the stamps of those that were exposed",
    )  # fmt: skip
    flicker = float(np.median(np.abs(steps))) if steps else 0.0
    yield Fault(
        "flickering frames", flicker, MAX_FLICKER,
        f"from frame to frame pixels without an event change by {100 * flicker:.3g} % in the "
        "median",
        'give the brightness of each frame as extra["gain"], or record with constant exposure '
        "and gain",
    )  # fmt: skip
    undone = 1 - net / total if total and has_polarity else 0.0
    yield Fault(
        "sparse frames", undone, MAX_UNDONE_SHARE,
        f"of the change that events report, {100 * undone:.3g} % is undone before the next frame",
        "record more frames per second; events must bridge the time between them, for which their "
        "thresholds must be known well",
    )  # fmt: skip


def _check_white(recording: Recording) -> Iterator[Fault]:
    """Check the share of pixels whose frames are white."""
    white = find_clipping(recording).white
    if white.level is None and white.share > MAX_CLIPPED_SHARE:
        yield Fault(
            "empty frames", white.share, MAX_CLIPPED_SHARE,
            f"{100 * white.share:.3g} % of the frames' pixels have one grey value",
            "read the frames again, or leave them out",
        )  # fmt: skip
        return
    yield Fault(
        "clipped frames", white.share, MIN_CLIPPED_SHARE,
        f"{100 * white.share:.3g} % of the frames' pixels are white, where only events tell what "
        "happens",
        "shorten the exposure; methods with a variance take white for a lower bound",
    )  # fmt: skip
