"""Table and picture of a calibration."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration import Calibration
from jaxevent.display import plural
from jaxevent.recording import Recording
from jaxevent.show.images import COLOURS, new_figure, tone_map
from jaxevent.show.tables import format_aligned_table

N_SHOWN_INTERVALS = 8  # between frames, whose pixels the picture shows
COUNT_LIMIT_PERCENTILE = 99.5  # of the counts' sizes, at which the picture ends
N_BINS = 61  # of the picture's log differences


def calibration_table(calibration: Calibration) -> str:
    """Format the values of a calibration as a table, with intervals and notes.

    Args:
        calibration: The calibration.

    Returns:
        Lines of text.
    """
    table = [["", "value", "95 % interval", "unit", ""]]
    for name, one in calibration.values().items():
        known = one.is_identifiable
        interval = (
            f"{one.low:.4g} to {one.high:.4g}" if np.isfinite([one.low, one.high]).all() else ""
        )
        unit = "" if one.unit == "1" else one.unit
        table.append([name, f"{one.value:.4g}" if known else "-", interval, unit * known, one.note])
    y, x = np.nonzero(calibration.hot_pixels)
    first = ", ".join(f"({i}, {j})" for i, j in zip(x[:5].tolist(), y[:5].tolist(), strict=True))
    table.append(["hot pixels", f"{len(x)}", "", "", f"{first}{', ...' * (len(x) > 5)}"])
    return format_aligned_table(table, (0, 3, 4))


def plot_calibration(calibration: Calibration, recording: Recording, I0: float = 1.0) -> Any:
    """Draw correlation over clock offset, events against changes of frames, and hot pixels.

    Args:
        calibration: The calibration.
        recording: The recording that it is of.
        I0: Offset inside the logarithm that it was made for.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: The extra "plot" is missing.
    """
    figure = new_figure(12, 3.8)
    left, middle, right = figure.subplots(1, 3)
    _draw_correlations(left, calibration)
    _draw_counts(middle, calibration, recording, I0)
    _draw_hot_pixels(right, calibration, recording)
    return figure


def _draw_correlations(axis: Any, calibration: Calibration) -> None:
    clock = calibration.clock_offset
    line = {"color": COLOURS[-1], "lw": 1, "ms": 3, "label": "correlation"}
    axis.plot(1e3 * calibration.offsets, calibration.correlations, ".-", **line)
    if clock.is_identifiable:
        axis.axvline(1e3 * clock.value, color=COLOURS[1], lw=1, label="estimate")
        if np.isfinite([clock.low, clock.high]).all():
            band = {"color": COLOURS[1], "alpha": 0.2, "lw": 0, "label": "95 % interval"}
            axis.axvspan(1e3 * clock.low, 1e3 * clock.high, **band)
    title = f"clock {1e3 * clock.value:+.2f} ms" if clock.is_identifiable else "clock: not found"
    axis.set(title=title, xlabel="clock offset (ms)", ylabel="correlation of events and frames")
    axis.legend(frameon=False, fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_counts(axis: Any, calibration: Calibration, recording: Recording, I0: float) -> None:
    """Draw the net events of pixels over their change of log intensity, and the thresholds.

    Args:
        axis: Axis of matplotlib.
        calibration: Thresholds to draw as lines.
        recording: Events and frames.
        I0: Offset inside the logarithm.
    """
    change, net = _measure_frame_changes(recording, calibration, I0)
    axis.set(xlabel=f"change of ln(I + {I0:g}) between frames", ylabel="ON minus OFF events")
    if not len(net):
        axis.set_title("no events between frames")
        return
    most = max(2, int(np.percentile(np.abs(net), COUNT_LIMIT_PERCENTILE)))
    end = max(float(np.percentile(np.abs(change), COUNT_LIMIT_PERCENTILE)), 1e-3)
    counts, _, _ = np.histogram2d(
        change, net, [np.linspace(-end, end, N_BINS), np.arange(-most - 0.5, most + 1)]
    )
    extent = (-end, end, -most - 0.5, most + 0.5)
    axis.imshow(np.log1p(counts.T), "Greys", origin="lower", extent=extent, aspect="auto")
    lines = ((calibration.c_on, COLOURS[1], "ON", 1), (calibration.c_off, COLOURS[0], "OFF", -1))
    for threshold, colour, name, sign in lines:
        if threshold.is_identifiable:
            reach = sign * min(end, most * threshold.value)
            label = f"{name} {threshold.value:.3g}"
            axis.plot([0, reach], [0, reach / threshold.value], color=colour, lw=1.5, label=label)
    axis.set(
        xlim=(-end, end), ylim=(-most - 0.5, most + 0.5), title="thresholds; darker: more pixels"
    )
    if axis.lines:
        axis.legend(frameon=False, loc="upper left")


def _measure_frame_changes(
    recording: Recording, calibration: Calibration, I0: float
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Measure changes of log intensity between frames, and count the events meanwhile.

    Args:
        recording: Events and frames.
        calibration: Offset of the clock, and hot pixels.
        I0: Offset inside the logarithm.

    Returns:
        Changes, ln I, and ON minus OFF events, (n,) each, of pixels with events in a few intervals.
    """
    frames = recording.linear_frames if recording.frames else None
    late = (
        round(1e6 * calibration.clock_offset.value)
        if calibration.clock_offset.is_identifiable
        else 0
    )
    change, net = [np.zeros(0)], [np.zeros(0, np.int64)]
    if frames is None or len(frames) < 2:
        return change[0], net[0]
    pixels = recording.width * recording.height
    rows = np.linspace(0, len(frames) - 2, N_SHOWN_INTERVALS).round().astype(int)
    for row in np.unique(rows).tolist():
        first, last = (recording.events.index(int(t) + late) for t in frames.t[row : row + 2])
        events = recording.events[first:last]
        place = events.y.astype(np.int64) * recording.width + events.x
        both = np.bincount(place, minlength=pixels)
        levels = np.log(frames[row : row + 2].intensity.reshape(2, -1) + I0)
        used = (both > 0) & ~calibration.hot_pixels.ravel()
        net.append((2 * np.bincount(place[events.p], minlength=pixels) - both)[used])
        change.append((levels[1] - levels[0])[used])
    return np.concatenate(change), np.concatenate(net)


def _draw_hot_pixels(axis: Any, calibration: Calibration, recording: Recording) -> None:
    y, x = np.nonzero(calibration.hot_pixels)
    height, width = calibration.hot_pixels.shape
    if recording.frames is not None:
        axis.imshow(tone_map(recording.frames[:1].intensity[0], "display"), "gray")
    axis.plot(x, y, "o", color=COLOURS[1], ms=4, mfc="none")
    title = f"{len(x)} hot {plural('pixel', len(x))}"
    axis.set(title=title, xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axis.set(xticks=[], yticks=[], aspect="equal")
