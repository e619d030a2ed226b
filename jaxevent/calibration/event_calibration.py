"""Relative thresholds and hot pixels of a sensor from its events alone, for methods without frames.

Between two times the log intensity of a pixel with U ON and D OFF events changes by

    change = c_on U - c_off D + (less than a threshold).                                  (1)

Two estimates of c_on / c_off follow, which are weighted by their precision:

- Intensity that rises falls again, so the sum of (1) over all pixels is small. If the whole scene
  grows brighter, this is biased, by about half of the standard deviation of (1) among pixels.
- Neighbours grow brighter together. The differences of U and of D between pixels a few pixels apart
  scatter about a line through 0, of slope c_off / c_on. Both differences have errors: counts are
  whole numbers (`QUANTISATION_VARIANCE`), and the changes of the two pixels differ. The geometric
  mean of both regressions treats ON and OFF alike; the regressions bound the slope (Frisch 1934).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.events_alone import CONFIDENCE_Z
from jaxevent.calibration.hot import MAX_EVENTS_SHARE, find_hot_pixels
from jaxevent.calibration.result import CalibrationValue, not_identifiable
from jaxevent.events import remove_hot_pixels
from jaxevent.recording import Recording, check_recording

N_PARTS = 8  # parts of a recording whose events are counted
MAX_PART_EVENTS = 2_000_000  # events of a part that are counted
BLOCK_EVENTS = 1_000_000  # events that are read at once
DISTANCES_PX = (1, 2, 4)  # between pixels that are compared
CAUCHY_SCALE = 2.0  # of the robust weights for errors of (1), in thresholds
# Variance of a difference of two counts: its four ends are uniform within an event, 4 / 12.
QUANTISATION_VARIANCE = 1 / 3
MIN_MOMENT_FRACTION = 0.25  # least part of a second moment left after that is subtracted
# Standard deviation of the image's mean change, relative to that of its pixels' changes.
MEAN_CHANGE_RATIO = 0.5
LOG_RATIO_SPREAD = 0.7  # standard deviation of ln(c_on / c_off) among sensors
N_REWEIGHTINGS = 50  # steps of iteratively reweighted least squares
MIN_EVENTS = 200  # least events of each polarity
MIN_CORRELATION = 1e-3  # least correlation of ON with OFF differences that is used
MIN_LOG_RATIO_ERROR = 0.03  # least standard deviation of an estimate of ln(c_on / c_off)


class EventCalibration(NamedTuple):
    """Properties of a sensor that its events alone determine.

    Absolute contrast is not observable from events alone. So thresholds are relative: the geometric
    mean of the common ON and OFF thresholds is 1.

    | field | meaning |
    |---|---|
    | thresholds | (2, height, width) relative ON and OFF thresholds of each pixel |
    | ratio | ON threshold over OFF threshold; if it is unknown, `thresholds` assume 1 |
    | spread | standard deviation of the logarithm of this ratio among pixels |
    | hot | (height, width), true for hot pixels |
    | read_out | (height, width), true within the rows and columns that the sensor reads out |
    | hot_share | share of the events that hot pixels made |
    """

    thresholds: NDArray[np.float32]
    ratio: CalibrationValue
    spread: float
    hot: NDArray[np.bool_]
    read_out: NDArray[np.bool_]
    hot_share: float


def count_parts(recording: Recording) -> NDArray[np.int32]:
    """Count the events of each pixel in parts of a recording.

    Of long recordings only the first `MAX_PART_EVENTS` events of each part are counted.

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

    Args:
        recording: The recording, in memory or in a file. Its frames are not used.

    Returns:
        Thresholds and hot pixels.
    """
    check_recording(recording, "calibrate_events")
    parts = count_parts(recording)
    counts = parts.sum((0, 1))
    hot, hot_share = _find_hot(parts)
    ratio = _estimate_ratio(parts.sum(0), hot)
    root = np.sqrt(ratio.value if ratio.is_identifiable else 1.0)
    change = root * parts[:, 0] - parts[:, 1] / root
    gain = (root * parts[:, 0] + parts[:, 1] / root) / 2
    s, spread = _estimate_pixel_deviations(change, gain, ~hot & ratio.is_identifiable)
    thresholds = np.stack([root * np.exp(s / 2), np.exp(-s / 2) / root]).astype(np.float32)
    return EventCalibration(thresholds, ratio, spread, hot, _find_read_region(counts), hot_share)


def _find_hot(parts: NDArray[np.integer]) -> tuple[NDArray[np.bool_], float]:
    """Find hot pixels in counts of parts, and their share of the events."""
    hot, counts = find_hot_pixels(parts.sum(1)), parts.sum((0, 1))
    return hot, float(counts[hot].sum() / max(counts.sum(), 1))


def remove_many_hot_events(
    recording: Recording, calibration: EventCalibration | None = None
) -> Recording:
    """Remove the events of hot pixels if they are more than a twentieth of all events.

    Otherwise hot pixels would fill the windows of methods that read a fixed number of events, and
    these windows would become too short to show motion.

    Args:
        recording: The recording.
        calibration: Result of `calibrate_events` for it; None: hot pixels are found here.

    Returns:
        The recording without these events; unchanged if they are few, or if there are no others.
    """
    if calibration is None:
        hot, share = _find_hot(count_parts(recording))
    else:
        hot, share = calibration.hot, calibration.hot_share
    return remove_hot_pixels(recording, hot) if MAX_EVENTS_SHARE < share < 1 else recording


def _find_read_region(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find the region that the sensor reads out: from the first to the last row and column used."""
    inside = np.ones(counts.shape, bool)
    for axis in (0, 1):
        (used,) = np.nonzero(counts.any(axis))
        along = np.arange(counts.shape[1 - axis])
        if len(used):
            within = (used[0] <= along) & (along <= used[-1])
            inside &= within[:, None] if axis else within
    return inside


def _neighbour_differences(
    counts: NDArray[np.integer], hot: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return differences of counts between pixels `DISTANCES_PX` apart that are not hot.

    Args:
        counts: (2, height, width) ON and OFF events.
        hot: (height, width) hot pixels.

    Returns:
        (n,) differences of ON and of OFF counts.
    """
    found = []
    for distance in DISTANCES_PX:
        for near, far in (
            (np.s_[..., :-distance, :], np.s_[..., distance:, :]),
            (np.s_[..., :-distance], np.s_[..., distance:]),
        ):
            difference = (counts[far] - counts[near])[:, ~(hot[far] | hot[near])]
            found.append(difference[:, difference.any(0)])
    U, D = np.concatenate(found, 1).astype(np.float64)
    return U, D


def _estimate_ratio(counts: NDArray[np.integer], hot: NDArray[np.bool_]) -> CalibrationValue:
    """Estimate c_on / c_off from counts of events.

    Args:
        counts: (2, height, width) ON and OFF events.
        hot: (height, width) whether a pixel is hot.

    Returns:
        The ratio.
    """
    on, off = counts[:, ~hot]
    if min(on.sum(), off.sum()) < MIN_EVENTS:
        return not_identifiable("1", "too few events of one polarity")
    whole = np.log(off.sum() / on.sum())
    root, active = np.exp(whole / 2), on + off > 0
    change, gain = (root * on - off / root)[active], (root * on + off / root)[active] / 2
    error = MEAN_CHANGE_RATIO * float(change.std() / gain.mean()) + MIN_LOG_RATIO_ERROR
    estimates = [(whole, error), _log_ratio_from_neighbours(counts, hot)]
    value = precision = 0.0
    for log_ratio, error in estimates:
        value += log_ratio / error**2
        precision += error**-2
    # Sensors' ratios have the mean 1.
    precision += LOG_RATIO_SPREAD**-2
    ratio, wide = np.exp([value / precision, CONFIDENCE_Z / np.sqrt(precision)]).tolist()
    return CalibrationValue(ratio, ratio / wide, ratio * wide, "1", "from events alone")


def _log_ratio_from_neighbours(
    counts: NDArray[np.integer], hot: NDArray[np.bool_]
) -> tuple[float, float]:
    """Estimate ln(c_on / c_off) from differences between neighbouring pixels.

    Args:
        counts: (2, height, width) ON and OFF events.
        hot: (height, width) hot pixels.

    Returns:
        The estimate and its standard deviation.
    """
    U, D = _neighbour_differences(counts, hot)
    root, rho = 1.0, 0.0
    for _ in range(N_REWEIGHTINGS):
        w = 1 / (1 + (root * U - D / root) ** 2 / (2 * CAUCHY_SCALE**2))
        UU, UD, DD = (w * U * U).sum(), (w * U * D).sum(), (w * D * D).sum()
        if not UU * DD > 0:
            return 0.0, np.inf
        rho = UD / np.sqrt(UU * DD)
        UU, DD = (
            max(v - QUANTISATION_VARIANCE * w.sum(), MIN_MOMENT_FRACTION * v) for v in (UU, DD)
        )
        root = (DD / UU) ** 0.25
    rho = max(rho, MIN_CORRELATION)
    # The slopes of the regressions of U on D and of D on U are rho times smaller and larger.
    error = -np.log(rho) / CONFIDENCE_Z + np.sqrt((1 - rho**2) / len(U)) / rho + MIN_LOG_RATIO_ERROR
    return 2 * float(np.log(root)), error


def _estimate_pixel_deviations(
    change: NDArray[np.float64], gain: NDArray[np.float64], is_used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], float]:
    """Estimate each pixel's deviation from the common ratio by empirical Bayes.

    A deviation s of ln(c_on / c_off) changes (1) by s (c_on U + c_off D) / 2 in every part of the
    recording. Parts that are not adjacent have independent errors, so the mean product of their
    changes measures the variance of s. Changes that neighbours share belong to the scene.

    Args:
        change: (parts, height, width) c_on U - c_off D.
        gain: (parts, height, width) (c_on U + c_off D) / 2.
        is_used: (height, width) whether a pixel is used.

    Returns:
        (height, width) deviations, and their standard deviation.
    """
    from scipy.ndimage import median_filter

    change = np.where(is_used, change, 0)  # a hot pixel must not count in its neighbours' medians
    own = change - median_filter(change, (1, 5, 5), mode="reflect")
    own, gain = own[:, is_used], gain[:, is_used]
    products, moments = np.zeros((2, own.shape[1]))
    for k in range(2, len(own)):
        products += own[k] * own[: k - 1].sum(0)
        moments += gain[k] * gain[: k - 1].sum(0)
    chance = CONFIDENCE_Z * float(np.sqrt((products**2).sum()))
    found = float(products.sum())
    variance = found / max(float(moments.sum()), 1e-9) if found > chance else 0.0
    own, gain = own.sum(0), gain.sum(0)
    noise = max(float((own**2 - variance * gain**2).mean()), 1.0) if len(own) else 1.0
    s = np.zeros(is_used.shape)
    s[is_used] = -variance * gain * own / (variance * gain**2 + noise)
    return s, float(np.sqrt(variance))
