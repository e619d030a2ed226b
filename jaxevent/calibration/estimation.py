"""Estimation of clock, thresholds and noises from the events between frames."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.correspondence import MIN_SIGNIFICANCE, measure_correspondence
from jaxevent.calibration.events_alone import (
    CONFIDENCE_Z,
    estimate_dead_time,
    estimate_ratio,
    gaps_of_pixels,
)
from jaxevent.calibration.model import (
    CURVATURE,
    DEGREES_OF_FREEDOM,
    GAUSSIAN_SCALE,
    MAX_EXPOSURE_INTERVALS,
    MIN_CHANGES,
    SHORTEST_US,
    Fit,
    Model,
    Physics,
    cluster_sums,
    sandwich,
)
from jaxevent.calibration.result import Calibration, CalibrationValue, not_identifiable
from jaxevent.calibration.sampling import (
    SEARCH_US,
    Sample,
    correlate,
    count_between,
    log_changes,
    take_sample,
)
from jaxevent.recording import Recording, check_recording

OFFSET_STEP_US = 4000
MIN_CORRELATION = 0.1
MIN_CORRELATION_SIGMAS = 5.0  # of chance, as many offsets are tried
MIN_PEAK_RATIO = 2.0  # of the highest correlation to those far from it
MIN_NEAR_SHARE = 0.95  # of the correlation within an interval of the stamps to the highest
MIN_POLARITY_SHARE = 0.05  # of the rarer polarity
EARLIER_STARTS_S = (0.0, 3e-3, 8e-3)  # counts of whole events are late
MAX_FIRST_PIXELS = 10_000  # of the fits that choose among starts
FIRST_VARIANCES = (1e-5, 0.05, 0.01)
FIRST_EXPOSURE = 0.3  # of the time between frames
FIRST_DARK_OFFSET = 0.03  # of intensity
GREY_NOISE = 1.5 / 255  # by which pixels are chosen
# Errors of the model itself, found on simulated scenes. Paths between events are not parabolas, so
# that errors grow with the time between these.
THRESHOLD_ERROR = 0.025  # relative
CLOCK_ERROR = 0.035  # of the time between events
MIN_CLOCK_ERROR_S = 1e-4
DEAD_TIME_ERROR_S = 1.5e-4
EXPOSURE_ERROR = 0.1  # relative
BLUR_OF_GAPS, BLUR_ERROR = 0.4, 0.35  # of the squared time between events, in squared exposure
DARK_OFFSET_ERROR = 0.8  # of its logarithm
# An event shows the change since the one before at its pixel, so whole events are late by about
# half the time between these; a part of it, as those that are dense tell most.
LATENESS_OF_GAPS = 0.3  # of the harmonic mean of times between events of one sign
LATENESS_ERROR_S = 0.01  # half width of the clock's interval by whole events
MIN_GAP_US = 100  # as those of bursts
COARSE_FACTOR = 1.6  # half width of the interval of thresholds by them
NOISE_ERROR = 0.15  # of noises, relative
N_PROFILE_STEPS = 4
DARK_OFFSETS = np.geomspace(1e-3, 3, 15)
MIN_DRIFT_SPAN_S = 20.0
MIN_FACTOR_SIGMA = 0.03
MIN_CHANGES_PER_PIXEL = 4.0


class Clock(NamedTuple):
    """Offsets that were tried, with their correlations, and the best of them.

    Attributes:
        offsets: (n,) offsets, s.
        correlations: (n,) correlations of events and frames.
        best: Offset of the highest correlation, s; NaN: none.
        why: Reason why there is none; "" if there is one.
    """

    offsets: NDArray[np.float64]
    correlations: NDArray[np.float64]
    best: float
    why: str


def find_offset(sample: Sample, I0: float) -> Clock:
    """Find the offset of the clocks at which events and frames agree best.

    Args:
        sample: The sample.
        I0: Offset inside the logarithm.

    Returns:
        The offset, to about a step.
    """
    count = SEARCH_US // OFFSET_STEP_US
    tried = np.arange(-count, count + 1) * OFFSET_STEP_US
    found, number = correlate(sample, tried, I0)
    known = np.isfinite(found)
    if not known.any():
        return Clock(tried * 1e-6, found, math.nan, "no events between frames")
    top = int(np.nanargmax(found))
    interval = np.median(np.concatenate([np.diff(s.frame_t) for s in sample.segments]))
    far = found[known & (np.abs(tried - tried[top]) > 2 * max(interval, OFFSET_STEP_US))]
    others = float(np.quantile(np.abs(far), 0.9)) if len(far) else 0.0
    why = ""
    chance = np.maximum(MIN_CORRELATION, MIN_CORRELATION_SIGMAS / np.sqrt(np.maximum(number, 1)))
    if found[top] < chance[top]:
        why = f"events and frames agree at no offset (correlation {found[top]:.2f})"
    elif found[top] < MIN_PEAK_RATIO * others:
        # What moves periodically agrees after every period. Stamps are rarely off by more than an
        # interval, so a peak as high within it is the right one, if it is no chance.
        near = np.where(known & (np.abs(tried) <= interval), found, -np.inf)
        if near.max() >= MIN_NEAR_SHARE * found[top] and _is_significant(sample):
            top = int(near.argmax())
        else:
            why = (
                f"events and frames agree nearly as well at far offsets (correlation {others:.2f}) "
                f"as at {1e-6 * tried[top]:.3g} s ({found[top]:.2f})"
            )
    low = int(np.nanargmin(found))
    if -found[low] > found[top] and (not why or -found[low] >= chance[low]):
        why = f"events show the opposite of frames (correlation {found[low]:.2f})"
    return Clock(tried * 1e-6, found, math.nan if why else float(tried[top]) * 1e-6, why)


def _is_significant(sample: Sample) -> bool:
    """Return whether events agree with frames at some lag beyond chance, tile by tile."""
    found = measure_correspondence(sample)
    return found is not None and float(found.significance[0].max()) > MIN_SIGNIFICANCE


def _interval(value: float, error: float, unit: str, note: str = "") -> CalibrationValue:
    """Make a value of a positive quantity, with the interval of its logarithm.

    Args:
        value: The estimate.
        error: Its standard deviation, in the same unit.
        unit: The unit.
        note: A note on it.

    Returns:
        The value.
    """
    wide = math.exp(min(CONFIDENCE_Z * error / value, 50.0))
    return CalibrationValue(value, value / wide, value * wide, unit, note)


def _first_fit(model: Model, clock: Clock) -> Fit | None:
    """Fit thresholds and clock from several offsets, and return the best fit."""
    best = None
    for early in EARLIER_STARTS_S:
        theta = [0.2, 0.2, clock.best - early, 0.0, (FIRST_EXPOSURE * model.interval_s) ** 2]
        start = Physics(np.array(theta), np.array(FIRST_VARIANCES))
        fit = model.fit(start, (True, True, True, False, False), 5)
        if fit is not None and (best is None or fit.losses.mean() < best.losses.mean()):
            best = fit
    return best


def _fit_sensor(
    sample: Sample, slope: NDArray[np.float64], clock: Clock, is_unknown: bool
) -> tuple[Model, Fit] | None:
    """Fit the numbers that do not depend on the logarithm that a method works in.

    Where thresholds are not the same at all intensities, changes lie off the model by more than
    noise, and the clock follows them: the fit is at the dark offset that the frames prefer.
    Args:
        sample: Sample of the recording.
        slope: (2, entries) grey values, and dI/dg there.
        clock: Clock offsets that were tried.
        is_unknown: Whether some exposures are not known, so that their length is fitted.

    Returns:
        The likelihood at that offset, and its fit; the first ones where too few changes count at
        that offset; None where too few count at any.
    """
    near = Model(sample, FIRST_DARK_OFFSET, GREY_NOISE, slope)
    quick = near.thinned(MAX_FIRST_PIXELS)
    first = _first_fit(quick, clock) or _first_fit(near, clock)
    if first is None:
        return None
    offsets = _DarkOffsets.of(quick, first)
    model = near.with_offset(offsets.likeliest())
    start = Physics(offsets.fits[offsets.place].physics.theta, np.array(FIRST_VARIANCES))
    fit = model.fit(start, (True, True, True, True, is_unknown))
    return (near, first) if fit is None else (model, fit)


def calibrate(recording: Recording, I0: float = 1.0, sample: Sample | None = None) -> Calibration:
    """Calibrate a recording from its own events and frames.

    Args:
        recording: The recording.
        I0: Offset inside the logarithm, L = ln(I + I0), for which thresholds hold.
        sample: A sample of it (`sampling.take_sample`); None: it is taken here.

    Returns:
        The values found, each with its 95 % interval or the reason why there is none.
    """
    check_recording(recording, "calibrate")
    sample = take_sample(recording) if sample is None else sample
    ratio, dead = estimate_ratio(sample), estimate_dead_time(sample)
    frames = 0 if recording.frames is None else len(recording.frames)
    if frames < 2 or not len(recording.events):
        what = "frames" if frames < 2 else "events"
        return _without_fit(sample, ratio, dead, f"too few {what}")
    clock = find_offset(sample, I0)
    on, off = sample.counts.sum((1, 2)).tolist()
    if math.isnan(clock.best) or min(on, off) < MIN_POLARITY_SHARE * (on + off):
        why = clock.why or "nearly all events are of one polarity"
        return _without_fit(sample, ratio, dead, why, clock)
    grey = np.linspace(0, 1, 1025)
    table = np.asarray(recording.response.intensity(grey), np.float64)
    slope = np.stack([grey, np.maximum(np.gradient(table, grey), 1e-6)])
    is_unknown = any((s.exposure == 0).any() for s in sample.segments)
    found = _fit_sensor(sample, slope, clock, is_unknown)
    if found is None:
        return _by_whole_events(sample, I0, ratio, dead, clock)
    model, fit = found
    c_free = (True, True, False, False, False)
    thresholds = model.with_offset(I0).fit(fit.physics, c_free, N_PROFILE_STEPS)
    return _with_fit(sample, model, fit, thresholds or fit, clock)


def _without_fit(
    sample: Sample,
    ratio: CalibrationValue,
    dead: CalibrationValue,
    why: str,
    clock: Clock | None = None,
) -> Calibration:
    """Return the calibration that needs no fit to frames."""
    units = {
        "clock_offset": "s", "clock_drift": "s/s", "c_on": "ln I", "c_off": "ln I",
        "dark_offset": "intensity", "event_noise": "c", "frame_noise": "grey", "exposure": "s",
        "exposure_anchor": "exposure",
    }  # fmt: skip
    none: dict[str, Any] = {name: not_identifiable(unit, why) for name, unit in units.items()}
    empty = np.zeros(0)
    return Calibration(
        **none, threshold_ratio=ratio, rho_ref=dead, hot_pixels=sample.hot,
        offsets=empty if clock is None else clock.offsets,
        correlations=empty if clock is None else clock.correlations,
    )  # fmt: skip


def _by_whole_events(
    sample: Sample, I0: float, ratio: CalibrationValue, dead: CalibrationValue, clock: Clock
) -> Calibration:
    """Return coarse values where few pixels move while frames are taken.

    Whole events are late, and of small changes they miss a part, so that intervals are wide. The
    clock is that of the sensor: the offset at which whole events fit best, less their lateness.
    Args:
        sample: Sample of the recording.
        I0: Offset inside the logarithm.
        ratio: c_on / c_off.
        dead: Dead time, s.
        clock: Clock offsets that were tried.

    Returns:
        The values.
    """
    why = "too few pixels change brightness while frames are taken"
    rest = _without_fit(sample, ratio, dead, why, clock)
    late = clock.best
    sums = np.zeros((2, 2))  # of changes and of events, brighter and darker
    for segment in sample.segments:
        counts = count_between(segment, round(1e6 * late)).astype(np.float64)
        change, used = log_changes(segment, I0)
        used = used & segment.is_covered(round(1e6 * late))[:, None]
        for row, sign in ((0, 1), (1, -1)):
            net = sign * (counts[:, 0] - counts[:, 1])
            rising = used & (net > 0) & (sign * change > 0)
            sums[:, row] += (sign * change)[rising].sum(), net[rising].sum()
    if not (sums > 0).all():
        return rest
    note = "from counts of whole events"
    c_on, c_off = (sums[0] / sums[1]).tolist()
    offset = late - LATENESS_OF_GAPS * _time_between_events(sample)
    ends = offset - LATENESS_ERROR_S, offset + LATENESS_ERROR_S
    return dataclasses.replace(
        rest,
        clock_offset=CalibrationValue(offset, *ends, "s", note),
        c_on=CalibrationValue(c_on, c_on / COARSE_FACTOR, c_on * COARSE_FACTOR, "ln I", note),
        c_off=CalibrationValue(c_off, c_off / COARSE_FACTOR, c_off * COARSE_FACTOR, "ln I", note),
    )


def _time_between_events(sample: Sample) -> float:
    """Return the harmonic mean of times (s) between events of one sign at a pixel; 0 without."""
    gaps = np.maximum(gaps_of_pixels(sample, of_one_sign=True), MIN_GAP_US)
    return 1e-6 * len(gaps) / float((1 / gaps).sum()) if len(gaps) else 0.0


def _with_fit(
    sample: Sample, model: Model, sensor: Fit, thresholds: Fit, clock: Clock
) -> Calibration:
    """Return the values of the sensor's fit and of that of thresholds with their intervals."""
    theta = sensor.physics.theta
    clock_error = max(CLOCK_ERROR * _gap(sensor, 2, 1), MIN_CLOCK_ERROR_S)
    error = np.sqrt(np.diag(sensor.covariance)[2:4] + np.square([clock_error, DEAD_TIME_ERROR_S]))
    late, reach = float(theta[2]), CONFIDENCE_Z * float(error[0])
    offset = CalibrationValue(late, late - reach, late + reach, "s")
    rho, reach = float(theta[3]), CONFIDENCE_Z * float(error[1])
    if rho - reach > 0:
        dead = CalibrationValue(rho, rho - reach, rho + reach, "s")
    else:
        dead = not_identifiable("s", f"at most {rho + reach:.2g} s")
    exposure = _estimate_exposure(sample, sensor, model)
    noise, event_noise = _noises(sensor)
    c_on, c_off, ratio = _thresholds(thresholds)
    return Calibration(
        clock_offset=offset,
        clock_drift=_drift(sample, sensor),
        c_on=c_on,
        c_off=c_off,
        threshold_ratio=ratio,
        dark_offset=_dark_offset(model, sensor),
        event_noise=event_noise,
        frame_noise=noise,
        exposure=exposure,
        exposure_anchor=_locate_stamps(offset, exposure),
        rho_ref=dead,
        hot_pixels=sample.hot,
        offsets=clock.offsets,
        correlations=clock.correlations,
        threshold_factors=_factors(sample, thresholds),
    )


def _thresholds(fit: Fit) -> tuple[CalibrationValue, CalibrationValue, CalibrationValue]:
    """Return the thresholds and their ratio."""
    c, covariance = fit.physics.theta[:2], fit.covariance[:2, :2]
    error = np.sqrt(np.diag(covariance) + (THRESHOLD_ERROR * c) ** 2)
    c_on, c_off = (_interval(float(c[k]), float(error[k]), "ln I") for k in (0, 1))
    by = np.array([1 / c[0], -1 / c[1]])
    spread = math.hypot(math.sqrt(float(by @ covariance @ by)), THRESHOLD_ERROR)
    ratio = float(c[0] / c[1])
    return c_on, c_off, _interval(ratio, ratio * spread, "1")


def _gap(fit: Fit, column: int, power: int) -> float:
    """Return the mean power of the time between events, weighted by their effect on a parameter.

    Args:
        fit: The fit.
        column: Number of the parameter in theta.
        power: The power.

    Returns:
        The mean, s^power.
    """
    weight = fit.weight * fit.terms.J[:, column] ** 2
    return float(np.average(fit.changes.gap**power, weights=weight + 1e-300))


def _estimate_exposure(sample: Sample, fit: Fit, model: Model) -> CalibrationValue:
    known = np.concatenate([s.exposure for s in sample.segments])
    if (known > 0).all():
        length = float(np.median(known)) * 1e-6
        return CalibrationValue(length, length, length, "s", "as the recording says")
    # Within the time between two events a path's curvature is hardly known. So the step to a
    # shorter exposure is taken from one as long as that.
    theta, moves = fit.physics.theta.copy(), np.array([0, 1, 2, 4])
    theta[4] = max(theta[4], _gap(fit, 4, 2))
    changes = model.changes(theta)
    if not fit.covariance[4, 4] > 0 or len(changes.loose) < MIN_CHANGES:
        return not_identifiable("s", "too few pixels change brightness while frames are taken")
    fit, move = model.step(Physics(theta, fit.physics.V), changes, moves)
    covariance = sandwich(fit.terms.J[:, moves], fit.weight, fit.terms.residual, changes)
    square, error = max(float(theta[4] + move[4]), 0.0), math.sqrt(float(covariance[3, 3]))
    # Interpolation smooths paths between events, as a longer exposure would.
    blur = _gap(fit, 4, 2)
    square += BLUR_OF_GAPS * blur
    error = math.hypot(error, BLUR_ERROR * blur, 2 * EXPOSURE_ERROR * square)
    low, high = (math.sqrt(max(square + sign * CONFIDENCE_Z * error, 0)) for sign in (-1, 1))
    if not high < 1.5 * MAX_EXPOSURE_INTERVALS * model.interval_s:
        return not_identifiable("s", "little of the scene moves fast enough")
    least = max(low, SHORTEST_US * 1e-6)
    if low == 0:
        return CalibrationValue(
            math.sqrt(square), 0.0, high, "s", "frames are hardly blurred by motion"
        )
    return CalibrationValue(math.sqrt(max(square, least**2)), low, high, "s")


def _locate_stamps(offset: CalibrationValue, exposure: CalibrationValue) -> CalibrationValue:
    """Find where in the exposure the stamps lie, if the clocks are the same.

    Args:
        offset: Offset of the clock, s.
        exposure: Length of the exposures, s.

    Returns:
        The place, in exposures: 0 the begin, 1 the end.
    """
    if not exposure.is_identifiable or exposure.low <= 0:
        return not_identifiable("exposure", "exposures are not known")
    # Stamps at the begin of exposures are half of one before their middle.
    low, high = (0.5 - end / exposure.value for end in (offset.high, offset.low))
    place = 0.5 - offset.value / exposure.value
    fits = [name for at, name in ((0, "begin"), (0.5, "middle"), (1, "end")) if low <= at <= high]
    if len(fits) != 1:
        why = f"stamps may be at {' or '.join(fits)}" if fits else "the clocks differ"
        return not_identifiable("exposure", why)
    return CalibrationValue(place, low, high, "exposure", f"stamps are at the {fits[0]}")


def _noises(fit: Fit) -> tuple[CalibrationValue, CalibrationValue]:
    """Return the noise of frames and of events."""
    nu, V, changes = DEGREES_OF_FREEDOM, fit.physics.V, fit.changes
    v = V @ fit.terms.X
    # Derivatives of the likelihood by the logarithms of variances.
    part = (V[:, None] * fit.terms.X / v).T
    score = 0.5 * part * (fit.weight * fit.terms.residual**2 - 1)[:, None]
    H = 0.5 * nu / (nu + 3) * part.T @ part
    inverse = np.linalg.pinv(H)
    meats = [cluster_sums(score, changes, by) for by in ("tile", "interval")]
    error = np.sqrt(np.max([np.diag(inverse @ meat @ inverse) for meat in meats], 0)) / 2
    sigma = GAUSSIAN_SCALE * np.sqrt(V)
    out = []
    for row, unit in ((0, "grey"), (2, "c")):
        spread = math.hypot(float(error[row]), NOISE_ERROR)
        if spread > 0.5:
            out.append(not_identifiable(unit, "other errors are larger"))
        else:
            out.append(_interval(float(sigma[row]), float(sigma[row]) * spread, unit))
    return out[0], out[1]


def _drift(sample: Sample, fit: Fit) -> CalibrationValue:
    """Return the growth of the clock offset from segment to segment."""
    changes, J = fit.changes, fit.terms.J[:, 2]
    middle = np.array([s.frame_t.mean() for s in sample.segments]) * 1e-6
    rows = np.unique(changes.segment)
    if len(rows) < 3 or np.ptp(middle[rows]) < MIN_DRIFT_SPAN_S:
        return not_identifiable("s/s", f"the recording is shorter than {MIN_DRIFT_SPAN_S:g} s")
    offset, information = np.zeros(len(rows)), np.zeros(len(rows))
    for k, row in enumerate(rows):
        own = changes.segment == row
        score = (fit.weight * fit.terms.residual * J)[own]
        H = (fit.weight * J**2)[own].sum() * CURVATURE
        _, index = np.unique(changes.interval[own], return_inverse=True)
        offset[k] = score.sum() / H
        information[k] = H**2 / max((np.bincount(index, score) ** 2).sum(), 1e-12)
    information = 1 / (1 / information + 1e-8)
    t = middle[rows] - np.average(middle[rows], weights=information)
    slope = (information * t * offset).sum() / (information * t * t).sum()
    spread = (information * (offset - slope * t) ** 2).sum() / max(len(rows) - 2, 1)
    reach = 2.5 * math.sqrt(max(spread, 1.0) / (information * t * t).sum())
    return CalibrationValue(float(slope), float(slope - reach), float(slope + reach), "s/s")


class _DarkOffsets(NamedTuple):
    """Fits of thresholds at each of `DARK_OFFSETS`.

    Attributes:
        fits: Fit of each offset.
        losses: (offsets, n) losses, of densities of grey values.
    """

    fits: list[Fit]
    losses: NDArray[np.float64]

    @classmethod
    def of(cls, model: Model, fit: Fit) -> "_DarkOffsets":
        """Fit thresholds at each offset, all else as it is."""
        fits, physics = [], fit.physics
        for I0 in DARK_OFFSETS[::-1].tolist():
            for _ in range(N_PROFILE_STEPS):
                found, move = model.step(physics, fit.changes, np.arange(2), I0)
                theta = physics.theta + move
                theta[:2] = np.maximum(theta[:2], physics.theta[:2] / 2)
                physics = Physics(theta, found.physics.V)
            fits.insert(0, found)
        # Densities of grey values rather than of their logarithms, which depend on I0.
        return cls(fits, np.stack([one.losses + one.terms.log_slope for one in fits]))

    @property
    def place(self) -> int:
        """Row of the likeliest offset."""
        return int(np.argmin(self.losses.mean(1)))

    @property
    def is_inside(self) -> bool:
        """True where offsets on both sides are less likely."""
        return 0 < self.place < len(self.fits) - 1

    def likeliest(self) -> float:
        """Return the vertex of the parabola through the least loss and both neighbours."""
        k, ratio = self.place, DARK_OFFSETS[1] / DARK_OFFSETS[0]
        if not self.is_inside:
            return float(DARK_OFFSETS[k])
        left, here, right = self.losses[k - 1 : k + 2].mean(1)
        part = (left - right) / (2 * (left - 2 * here + right))  # of a step
        return float(DARK_OFFSETS[k] * ratio**part)


def _dark_offset(model: Model, fit: Fit) -> CalibrationValue:
    """Return the offset in the logarithm under which frames are likeliest."""
    offsets = _DarkOffsets.of(model, fit)
    k, step = offsets.place, math.log(DARK_OFFSETS[1] / DARK_OFFSETS[0])
    if not offsets.is_inside:
        end = f"{'at most' if k == 0 else 'at least'} {DARK_OFFSETS[k]:.2g}"
        return not_identifiable("intensity", f"dark pixels tell no more than {end}")
    left, here, right = offsets.losses[k - 1 : k + 2]
    bend = float((left - 2 * here + right).sum()) / step**2
    slope = (right - left)[:, None] / (2 * step)
    meat = max(float(cluster_sums(slope, fit.changes, by)[0, 0]) for by in ("tile", "interval"))
    error = math.hypot(math.sqrt(meat) / bend, DARK_OFFSET_ERROR)
    if not 0 < error < 1.5:
        return not_identifiable("intensity", "pixels differ too little in brightness")
    value = offsets.likeliest()
    return _interval(value, value * error, "intensity")


def _factors(sample: Sample, fit: Fit) -> NDArray[np.float32] | None:
    """Return factors on the thresholds of pixels, if halves of the data agree on them."""
    changes, theta = fit.changes, fit.physics.theta
    pixels = len(sample.places)
    if len(changes.loose) < MIN_CHANGES_PER_PIXEL * pixels:
        return None
    x = np.stack([theta[0] * changes.n[0], -theta[1] * changes.n[1]])

    def regress(rows: NDArray, prior: float) -> tuple[NDArray, NDArray]:
        pixel, w = changes.pixel[rows], fit.weight[rows]
        a, b, e = x[0, rows], x[1, rows], fit.terms.residual[rows]
        sums = [np.bincount(pixel, w * v, pixels) for v in (a * a, a * b, b * b, a * e, b * e)]
        A, C = sums[0] + prior**-2, sums[2] + prior**-2
        det = A * C - sums[1] ** 2
        d = np.stack([C * sums[3] - sums[1] * sums[4], A * sums[4] - sums[1] * sums[3]]) / det
        return d, 1 - np.stack([C, A]) / det / prior**2

    every = np.arange(len(changes.loose))
    halves = [regress(every[changes.interval % 2 == k], 0.1) for k in (0, 1)]
    (d1, part1), (d2, part2) = halves
    variance = (d1 * d2).sum() / max((part1 * part2).sum(), 1e-9)
    if not variance > MIN_FACTOR_SIGMA**2:
        return None
    d, _ = regress(every, math.sqrt(variance))
    factors = np.ones((2, sample.size[0] * sample.size[1]), np.float32)
    factors[:, sample.places] = 1 + d
    return factors.reshape(2, sample.size[1], sample.size[0])
