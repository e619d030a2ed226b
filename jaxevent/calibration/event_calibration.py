"""Thresholds and noise of a sensor from its events alone, for methods without frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.events_alone import CONFIDENCE_Z
from jaxevent.calibration.hot import find_hot_pixels
from jaxevent.calibration.result import CalibrationValue, not_identifiable
from jaxevent.recording import Recording

N_PARTS = 8
MAX_PART_EVENTS = 2_000_000
BLOCK_EVENTS = 1_000_000
TILE_PX = 16
MIN_EVENTS = 200  # of either polarity
MIN_TILES = 8


class EventCalibration(NamedTuple):
    """Numbers of a sensor that its events alone determine.

    Absolute contrast is not observable from events alone. So thresholds are relative: the geometric
    mean of the common ON and OFF thresholds is 1.

    | field | meaning |
    |---|---|
    | thresholds | (2, height, width) ON and OFF thresholds of each pixel, relative |
    | ratio | ratio of the ON threshold to the OFF threshold; 1 is used where it is unknown |
    | hot | (height, width), true for pixels that fire without cause |
    """

    thresholds: NDArray[np.float32]
    ratio: CalibrationValue
    hot: NDArray[np.bool_]


def count_parts(recording: Recording) -> NDArray[np.int32]:
    """Count the events of each pixel in parts of a recording.

    Long recordings are sampled: from each part the first `MAX_PART_EVENTS` events.

    Args:
        recording: The recording, in memory or in a file.

    Returns:
        (parts, 2, height, width) ON and OFF events.
    """
    source, width, height = recording.events, recording.width, recording.height
    counts = np.zeros((N_PARTS, 2 * height * width), np.int32)
    edges = np.linspace(0, len(source), N_PARTS + 1).astype(int).tolist()
    for part, first, last in zip(counts, edges[:-1], edges[1:], strict=True):
        last = min(last, first + MAX_PART_EVENTS)
        for begin in range(first, last, BLOCK_EVENTS):
            events = source[begin : min(begin + BLOCK_EVENTS, last)]
            place = (~events.p * height + events.y) * width + events.x
            part += np.bincount(place, minlength=len(part)).astype(np.int32)
    return counts.reshape(N_PARTS, 2, height, width)


def calibrate_events(recording: Recording) -> EventCalibration:
    """Calibrate a sensor from the events of a recording alone.

    Where the scene comes and goes, its log intensity rises as much as it falls, so that
    c_on N_on = c_off N_off on the whole. The scatter between tiles of the image gives the interval.

    Args:
        recording: The recording, in memory or in a file. Its frames are not used.

    Returns:
        Thresholds and hot pixels.
    """
    parts = count_parts(recording)
    hot = find_hot_pixels(parts.sum(1))
    counts = parts.sum(0) * ~hot
    ratio = _estimate_ratio(counts)
    root = np.sqrt(ratio.value if ratio.is_identifiable else 1.0)
    thresholds = np.empty(counts.shape, np.float32)
    thresholds[:] = np.reshape([root, 1 / root], (2, 1, 1))
    return EventCalibration(thresholds, ratio, hot)


def _estimate_ratio(counts: NDArray[np.integer]) -> CalibrationValue:
    """Estimate c_on / c_off from ON and OFF counts (2, height, width)."""
    tiles = np.add.reduceat(
        np.add.reduceat(counts, np.arange(0, counts.shape[1], TILE_PX), 1),
        np.arange(0, counts.shape[2], TILE_PX), 2,
    ).reshape(2, -1)  # fmt: skip
    on, off = tiles[:, tiles.sum(0) > 0].astype(np.float64)
    if on.sum() < MIN_EVENTS or off.sum() < MIN_EVENTS:
        return not_identifiable("1", "too few events of one polarity")
    if len(on) < MIN_TILES:
        return not_identifiable("1", "the image is too small")
    ratio = float(off.sum() / on.sum())
    error = np.sqrt(((off - ratio * on) ** 2).sum() * len(on) / (len(on) - 1)) / off.sum()
    wide = float(np.exp(CONFIDENCE_Z * error))
    note = "if the scene grows as often brighter as darker"
    return CalibrationValue(ratio, ratio / wide, ratio * wide, "1", note)
