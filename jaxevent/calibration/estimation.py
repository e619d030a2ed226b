"""Estimation of clock offset and thresholds from the events between frames."""

import numpy as np

from jaxevent.calibration.result import Calibration, CalibrationValue
from jaxevent.recording import Recording

MAX_INTERVALS = 24
OFFSETS_US = np.arange(-40, 41, 4) * 1000


def calibrate(recording: Recording, I0: float = 1.0) -> Calibration:
    """Calibrate a recording from its own events and frames.

    Args:
        recording: The recording.
        I0: Offset inside the logarithm, L = ln(I + I0), for which thresholds hold.

    Returns:
        The values found.
    """
    pixels = recording.width * recording.height
    hot = np.zeros((recording.height, recording.width), bool)
    frames, source = recording.frames, recording.events
    nothing = CalibrationValue(np.nan, np.nan, np.nan, "s", "not identifiable: too few frames")
    empty = Calibration(nothing, nothing, nothing, nothing, hot, np.zeros(0), np.zeros(0))
    if frames is None or len(frames) < 2 or not len(source):
        return empty
    rows = np.unique(
        np.linspace(0, len(frames) - 2, min(len(frames) - 1, MAX_INTERVALS)).astype(int)
    )
    grey = {k: frames[k : k + 1].intensity[0].ravel().astype(float) for k in {*rows, *(rows + 1)}}
    top = 0.97 * max(float(g.max()) for g in grey.values())

    def counts(offset: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        on, off, change = [], [], []
        for k in rows:
            first, last = (source.index(int(frames.t[k + i]) + offset) for i in (0, 1))
            if last - first < 50:
                continue
            events = source[first:last]
            place = events.y.astype(np.int64) * recording.width + events.x
            a = np.bincount(place[events.p], minlength=pixels)
            b = np.bincount(place[~events.p], minlength=pixels)
            d = np.log(grey[k + 1] + I0) - np.log(grey[k] + I0)
            inside = np.all([(g > 0.03) & (g < top) for g in (grey[k], grey[k + 1])], 0)
            used = inside & (a + b > 0) & (a + b < 40)
            on.append(a[used])
            off.append(b[used])
            change.append(d[used])
        if not on:
            return (np.zeros(0),) * 3
        return np.concatenate(on), np.concatenate(off), np.concatenate(change)

    correlations = []
    for offset in OFFSETS_US.tolist():
        a, b, d = counts(offset)
        correlations.append(np.corrcoef(a - b, d)[0, 1] if len(d) > 100 else 0.0)
    found = np.array(correlations)
    top_row = int(np.clip(np.argmax(found), 1, len(found) - 2))
    left, best, right = found[top_row - 1 : top_row + 2]
    bend = left - 2 * best + right
    offset = OFFSETS_US[top_row] + (0.5 * (left - right) / bend * 4000 if bend < 0 else 0)
    a, b, d = counts(int(offset))
    up, down = (a > b) & (d > 0), (b > a) & (d < 0)
    if min(up.sum(), down.sum()) < 100 or found.max() < 0.2:
        return empty
    c_on = d[up].sum() / (a - b)[up].sum()
    c_off = -d[down].sum() / (b - a)[down].sum()

    def value(v: float, unit: str) -> CalibrationValue:
        return CalibrationValue(float(v), np.nan, np.nan, unit)

    return Calibration(
        value(offset * 1e-6, "s"),
        value(c_on, "ln I"),
        value(c_off, "ln I"),
        value(c_on / c_off, "1"),
        hot,
        OFFSETS_US * 1e-6,
        found,
    )
