"""Description of a recording in a few lines: sensor, events, frames, clocks, and the rest."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration import check_consistency
from jaxevent.events import is_hot
from jaxevent.progress import bar
from jaxevent.recording import EventSource, ImageSource, Recording, Triggers

BLOCK_EVENTS = 1 << 20  # events read together: 13 MB
PEAK_RATE_BIN_US = 10_000  # us over which the peak rate is taken
N_RATE_PARTS = 10  # of a recording, whose rates show how the rate changes
MIN_GAP_US = 100_000  # us without an event that may be a jump of the clock
_TRUTH_NAMES = (
    "omega",
    "rvec",
    "tvec",
    "HDR_mat",
    "hdr",
    "motion",
    "tracks",
    "depth",
    "mask",
    "flow",
)


def describe(recording: Recording, progress: bool | None = None) -> list[tuple[str, str]]:
    """Describe a recording, with the faults that `check_consistency` finds; events in blocks.

    Hot pixels are those of `jaxevent.events.find_hot_pixels`. A gap is 0.1 s and more without
    an event, or an interval between frames or samples over 1.5 medians.

    Args:
        recording: The recording.
        progress: Whether a bar is shown; None: in a terminal or notebook.

    Returns:
        Lines (name, text).
    """
    lines = [
        ("name", recording.name),
        ("sensor", f"{recording.width} x {recording.height} pixels"),
        (
            "time",
            f"{recording.start / 1e6:.6f} to {recording.stop / 1e6:.6f} s "
            f"({(recording.stop - recording.start) / 1e6:.3f} s)",
        ),
        *_about_events(recording.events, recording.width, recording.height, progress),
        *_about_frames(recording),
    ]
    if (camera := recording.camera) is not None:
        lens = "" if camera.model == "radtan" else f"{camera.model} "
        lines.append(
            (
                "calibration",
                f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}; "
                f"{lens}distortion {', '.join(f'{k:.4g}' for k in camera.distortion)}",
            )
        )
    for name, part in (("poses", recording.poses), ("IMU", recording.imu)):
        if part is not None and len(part):
            lines.append((name, f"{len(part):,}{_rate_of(part.t)}"))
    if (triggers := recording.triggers) is not None and len(triggers):
        lines.append(("triggers", _about_triggers(triggers)))
    lines += [("clocks", text) for text in _about_clocks(recording)]
    lines.append(("ground truth", _truth(recording, recording.extra)))
    for name, values in recording.extra.items():
        lines.append((f"extra {name}", _value(values)))
    lines += [
        (name, f"none: {why}")
        for name, why in recording.left_out.items()
        if name != "frames" and getattr(recording, name, None) is None
    ]
    lines += [("note", text) for text in recording.notes]
    faults = [("fault", str(fault)) for fault in check_consistency(recording)]
    return lines + (faults or [("faults", "none found")])


def _value(values: Any) -> str:
    """Describe an extra array by its values or shape."""
    if isinstance(values, ImageSource) and len(values.shape) > 1:  # it may stay in its file
        return f"{values.dtype} of shape {values.shape}"
    values = np.asarray(values)
    if values.ndim == 0 or (values.dtype.kind == "U" and values.size < 10):
        return ", ".join(str(value) for value in values.ravel().tolist())
    return f"{values.dtype} of shape {values.shape}"


def _truth(recording: Recording, extra: Mapping[str, NDArray]) -> str:
    """List the ground truth that a recording holds.

    Args:
        recording: The recording.
        extra: Further arrays of its file, by name.

    Returns:
        Names, separated by commas; "none" if there is none.
    """
    known = ["poses"] if recording.poses is not None and len(recording.poses) else []
    known += [name for name in extra if name.startswith(_TRUTH_NAMES)]
    return ", ".join(known) or "none"


def _rate_of(t: NDArray[np.int64]) -> str:
    """Describe the mean rate of times (us)."""
    return f", {(len(t) - 1) / ((t[-1] - t[0]) / 1e6):.1f} per s" if t[-1] > t[0] else ""


def _about_triggers(triggers: Triggers) -> str:
    """Describe triggers by channel and edge."""
    channels, counts = np.unique(triggers.channel, return_counts=True)
    shown = [
        f"{count:,} on channel {channel}" for channel, count in zip(channels, counts, strict=True)
    ]
    edges = [
        f"{count:,} {name}"
        for name, value in (("rising", 1), ("falling", 0), ("of unknown edge", -1))
        if (count := np.count_nonzero(triggers.edge == value))
    ]
    return f"{len(triggers):,}: {', '.join(shown)}; {', '.join(edges)}"


def _about_clocks(recording: Recording) -> list[str]:
    """Describe intervals that are too long, and samples not at the time of the events."""
    texts = []
    events = recording.events
    parts = [("frames", recording.frames), ("poses", recording.poses), ("IMU", recording.imu)]
    for name, part in parts:
        if part is None or not len(part):
            continue
        steps = np.diff(part.t)
        long = np.flatnonzero(steps > 1.5 * np.median(steps)) if len(steps) > 1 else []
        if len(long):
            row = int(np.argmax(steps))
            texts.append(
                f"{name}: {len(long)} intervals over 1.5 medians, the longest "
                f"{steps[row] / 1000:.3f} ms after {part.t[row] / 1e6:.6f} s"
            )
        if name != "frames" and len(events):
            first, last = int(events[:1].t[0]), int(events[len(events) - 1 :].t[0])
            if part.t[-1] < first or part.t[0] > last:
                texts.append(
                    f"{name}: {part.t[0] / 1e6:.6f} to {part.t[-1] / 1e6:.6f} s, not at the time "
                    "of the events"
                )
    return texts


def _about_events(
    events: EventSource, width: int, height: int, progress: bool | None
) -> list[tuple[str, str]]:
    """Describe rate, polarity, gaps and hot pixels of events."""
    count = len(events)
    if not count:
        return [("events", "none")]
    at_pixel = np.zeros(width * height, np.int64)
    on = peak = carried = gaps = 0
    last_bin = None
    first, last = int(events[:1].t[0]), int(events[count - 1 :].t[0])
    in_part = np.zeros(N_RATE_PARTS, np.int64)
    longest, longest_after, before = 0, first, first
    blocks = range(0, count, BLOCK_EVENTS)
    for row in bar(blocks, desc="look at events", unit="M events", progress=progress):
        block = events[row : row + BLOCK_EVENTS]
        on += int(block.p.sum())
        at_pixel += np.bincount(block.y.astype(np.int64) * width + block.x, minlength=len(at_pixel))
        # Sorted, so that only the first bin of a block can have begun in the one before it.
        bins, counts = np.unique((block.t - first) // PEAK_RATE_BIN_US, return_counts=True)
        if last_bin == bins[0]:
            counts[0] += carried
        peak, last_bin, carried = max(peak, int(counts.max())), bins[-1], int(counts[-1])
        steps = np.diff(block.t, prepend=before)
        gaps += int(np.count_nonzero(steps >= MIN_GAP_US))
        if (widest := int(np.argmax(steps))) >= 0 and steps[widest] > longest:
            longest = int(steps[widest])
            longest_after = int(block.t[widest]) - longest
        before = int(block.t[-1])
        edges = first + (last - first) * np.arange(1, N_RATE_PARTS) // N_RATE_PARTS
        in_part += np.diff(np.searchsorted(block.t, edges), prepend=0, append=len(block))
    lines = [
        ("events", f"{count:,}, from {first / 1e6:.6f} to {last / 1e6:.6f} s"),
        ("polarity", f"{100 * on / count:.1f} % ON, {100 * (count - on) / count:.1f} % OFF"),
    ]
    # The last bin is rarely full, so a recording shorter than a bin has no rate.
    seconds = (last - first) / 1e6
    if last - first >= PEAK_RATE_BIN_US:
        part = seconds / N_RATE_PARTS
        rates = ", ".join(_short(n / part) for n in in_part)
        lines += [
            (
                "event rate",
                f"mean {count / seconds:,.0f} per s, peak {peak / PEAK_RATE_BIN_US * 1e6:,.0f} per "
                f"s in {PEAK_RATE_BIN_US // 1000} ms",
            ),
            ("rate over time", f"{rates} per s, in tenths of {part:.3g} s"),
        ]
    if longest:
        text = f"longest {longest / 1000:.3f} ms, after {longest_after / 1e6:.6f} s"
        if gaps:
            text += f"; {gaps} of {MIN_GAP_US // 1000} ms and more, "
            text += "each a jump of the clock or a standstill"
        lines.append(("gaps", text))
    hot = np.flatnonzero(is_hot(at_pixel.reshape(height, width)))
    share = 100 * at_pixel[hot].sum() / count
    remedy = "jaxevent filter --hot-pixels leaves them out"
    some = f"{len(hot):,}, with {share:.2f} % of the events ({remedy})"
    lines.append(("hot pixels", some if len(hot) else "none"))
    hottest = np.argsort(-at_pixel, kind="stable")[:3]
    shown = []
    for pixel in hottest[at_pixel[hottest] > 0]:
        n = int(at_pixel[pixel])
        rate = f", {n / seconds:,.0f} per s" if last - first >= PEAK_RATE_BIN_US else ""
        shown.append(f"({pixel % width}, {pixel // width}) {n:,} events{rate}")
    lines.append(("hottest pixels", "; ".join(shown)))
    return lines


def _short(rate: float) -> str:
    """Format a rate with three digits and k or M: 12.3k."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if rate >= unit:
            return f"{rate / unit:.3g}{name}" if rate < 999.5 * unit else f"{rate / unit:.0f}{name}"
    return f"{rate:.0f}"


def _about_frames(recording: Recording) -> list[tuple[str, str]]:
    """Describe number, exposure and grey levels of frames."""
    frames = recording.frames
    if frames is None:
        return [("frames", f"none{recording.describe_left_out('frames')}")]
    height, width = frames.images.shape[1:]
    known = frames.exposure[frames.exposure > 0] / 1000
    if not len(known):
        exposure = "not known"
    elif known.min() == known.max():
        exposure = f"{known[0]:.3f} ms"
    else:
        exposure = f"{known.min():.3f} to {known.max():.3f} ms"
    if 0 < len(known) < len(frames):
        exposure += f", not known of {len(frames) - len(known)} frames"
    dark = bright = 0.0
    for row in range(len(frames)):
        grey = frames[row : row + 1].intensity
        dark += float(np.mean(grey < 0.02)) / len(frames)
        bright += float(np.mean(grey > 0.98)) / len(frames)
    return [
        (
            "frames",
            f"{len(frames):,} of {width} x {height}, {frames.images.dtype}{_rate_of(frames.t)}",
        ),
        ("exposure", exposure),
        (
            "grey levels",
            f"{100 * dark:.1f} % dark (< 0.02), {100 * bright:.1f} % saturated (> 0.98)",
        ),
    ]
