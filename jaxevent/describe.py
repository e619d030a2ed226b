"""A recording in a few lines: sensor, events, frames, and what else it holds."""

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from jaxevent.recording import EventSource, Frames, Recording

BLOCK = 1 << 20  # events looked at together: 13 MB
BIN = 10_000  # us over which the peak rate is taken


def describe(recording: Recording, progress: bool = False) -> list[tuple[str, str]]:
    """What a user wants to know first of a recording, as (name, text); reads events in blocks."""
    lines = [
        ("name", recording.name),
        ("sensor", f"{recording.width} x {recording.height} pixels"),
        (
            "time",
            f"{recording.start / 1e6:.6f} to {recording.stop / 1e6:.6f} s "
            f"({(recording.stop - recording.start) / 1e6:.3f} s)",
        ),
        *_about_events(recording.events, recording.width, recording.height, progress),
        *_about_frames(recording.frames),
    ]
    if (camera := recording.camera) is not None:
        lines.append(
            (
                "calibration",
                f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}; "
                f"distortion {', '.join(f'{k:.4g}' for k in camera.distortion)}",
            )
        )
    for name, part in (("poses", recording.poses), ("IMU", recording.imu)):
        if part is not None and len(part):
            lines.append((name, f"{len(part):,}{_rate_of(part.t)}"))
    for name, values in recording.extra.items():
        lines.append((f"extra {name}", f"{values.dtype} of shape {values.shape}"))
    return lines


def _rate_of(t: NDArray[np.int64]) -> str:
    return f", {(len(t) - 1) / ((t[-1] - t[0]) / 1e6):.1f} per s" if t[-1] > t[0] else ""


def _about_events(
    events: EventSource, width: int, height: int, progress: bool
) -> list[tuple[str, str]]:
    count = len(events)
    if not count:
        return [("events", "none")]
    at_pixel = np.zeros(width * height, np.int64)
    on = peak = carried = 0
    last_bin = None
    first = last = 0
    blocks = range(0, count, BLOCK)
    for row in tqdm(blocks, unit="M events", delay=2, disable=not progress, leave=False):
        block = events[row : row + BLOCK]
        first, last = first if row else int(block.t[0]), int(block.t[-1])
        on += int(block.p.sum())
        at_pixel += np.bincount(block.y.astype(np.int64) * width + block.x, minlength=len(at_pixel))
        # Sorted, so that only the first bin of a block can have begun in the one before it.
        bins, counts = np.unique((block.t - first) // BIN, return_counts=True)
        if last_bin == bins[0]:
            counts[0] += carried
        peak, last_bin, carried = max(peak, int(counts.max())), bins[-1], int(counts[-1])
    lines = [
        ("events", f"{count:,}, from {first / 1e6:.6f} to {last / 1e6:.6f} s"),
        ("polarity", f"{100 * on / count:.1f} % ON, {100 * (count - on) / count:.1f} % OFF"),
    ]
    # The last bin is rarely full, so a recording shorter than a bin has no rate.
    seconds = (last - first) / 1e6
    if last - first >= BIN:
        lines.append(
            (
                "event rate",
                f"mean {count / seconds:,.0f} per s, peak {peak / BIN * 1e6:,.0f} per s in "
                f"{BIN // 1000} ms",
            )
        )
    hottest = np.argsort(-at_pixel, kind="stable")[:3]
    shown = []
    for pixel in hottest[at_pixel[hottest] > 0]:
        n = int(at_pixel[pixel])
        rate = f", {n / seconds:,.0f} per s" if last - first >= BIN else ""
        shown.append(f"({pixel % width}, {pixel // width}) {n:,} events{rate}")
    lines.append(("hottest pixels", "; ".join(shown)))
    return lines


def _about_frames(frames: Frames | None) -> list[tuple[str, str]]:
    if frames is None:
        return [("frames", "none")]
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
