"""Values that events tell without frames: the dead time, and the ratio of both thresholds."""

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.result import CalibrationValue
from jaxevent.calibration.sampling import Sample

BINS_PER_OCTAVE = 8  # of the histogram of gaps
MIN_GAPS_ABOVE = 100  # in the bin above the dead time
MAX_SHARE_BELOW = 0.02  # gaps of the two bins below, as part of those above
MIN_EVENTS = 200
CONFIDENCE_Z = 1.96


def gaps_of_pixels(sample: Sample, of_one_sign: bool = False) -> NDArray[np.int64]:
    """Return the times between consecutive events of a pixel.

    Args:
        sample: The sample.
        of_one_sign: Leave out gaps between events of different polarity.

    Returns:
        (gaps,) us.
    """
    parts = [np.empty(0, np.int64)]
    for segment in sample.segments:
        order = np.argsort(segment.pixel, kind="stable")
        t, pixel, p = segment.t[order], segment.pixel[order], segment.p[order]
        kept = pixel[1:] == pixel[:-1]
        if of_one_sign:
            kept &= p[1:] == p[:-1]
        parts.append(np.diff(t)[kept])
    return np.concatenate(parts)


def estimate_dead_time(sample: Sample) -> CalibrationValue:
    """Estimate the dead time of pixels, below which there are no gaps between events.

    Gaps of a sensor without dead time are fewer the shorter they are, but fall off as a power. A
    dead time shows as an edge: there are many gaps just above it and hardly any just below.

    Args:
        sample: The sample.

    Returns:
        The dead time, s.
    """
    gaps = gaps_of_pixels(sample)
    gaps = gaps[gaps > 0]
    nothing = (np.nan, np.nan, np.nan, "s")
    if len(gaps) < MIN_EVENTS:
        return CalibrationValue(*nothing, "not identifiable: too few events of one pixel")
    step = 2 ** (1 / BINS_PER_OCTAVE)
    low, high = float(gaps.min()), float(np.median(gaps))
    edges = low / step**3 * step ** np.arange(int(np.log(max(high / low, 1)) / np.log(step)) + 5)
    # Whole microseconds lie between halves.
    below = np.searchsorted(np.sort(gaps), np.round(edges) - 0.5)
    above, under = below[3:] - below[2:-1], below[2:-1] - below[:-3]
    sharp = (above >= MIN_GAPS_ABOVE) & (under <= MAX_SHARE_BELOW * above)
    if not sharp.any():
        shortest = float(np.quantile(gaps, 1e-3)) * 1e-6
        return CalibrationValue(
            *nothing, f"not identifiable: no edge in the gaps; at most {shortest:.2g} s"
        )
    at = int(np.flatnonzero(sharp)[0]) + 2
    rho = float(gaps[gaps > edges[at] / step].min()) * 1e-6
    return CalibrationValue(rho, rho / step, rho * step, "s", "from the shortest gaps")


def estimate_ratio(sample: Sample) -> CalibrationValue:
    """Estimate c_on / c_off from events alone.

    Where the scene comes and goes, its log intensity rises as much as it falls, so that
    c_on N_on = c_off N_off on the whole. The scatter between tiles of the image tells how well.

    Args:
        sample: The sample.

    Returns:
        The ratio.
    """
    cold = ~sample.hot.ravel()[sample.places]
    on, off = (np.bincount(sample.tile, row.ravel()[sample.places] * cold) for row in sample.counts)
    nothing = (np.nan, np.nan, np.nan, "1")
    if on.sum() < MIN_EVENTS or off.sum() < MIN_EVENTS:
        return CalibrationValue(*nothing, "not identifiable: too few events of one polarity")
    ratio = off.sum() / on.sum()
    residual = off - ratio * on
    tiles = int(((on + off) > 0).sum())
    if tiles < 8:
        return CalibrationValue(*nothing, "not identifiable: the image is too small")
    error = np.sqrt((residual**2).sum() * tiles / (tiles - 1)) / on.sum()
    wide = np.exp(CONFIDENCE_Z * error / ratio)
    note = "from events alone, if the scene grows as often brighter as darker"
    return CalibrationValue(float(ratio), float(ratio / wide), float(ratio * wide), "1", note)
