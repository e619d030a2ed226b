"""Contrast thresholds of single pixels, learned from fused images.

No two pixels of a sensor have the same contrast thresholds. Along trajectories other pixels see
what a pixel saw, so fused images show the change of log intensity at it, and its events count it in
thresholds. Between two times, for every pixel,

    M(t') - M(t) = (1 + d_on) c_on n_on - (1 + d_off) c_off n_off + noise,   d ~ N(0, sigma^2),

with the variances of both images, of the events' steps, and of the rest of a threshold at both
ends. sigma is estimated from what both halves of the changes have in common. Where it is small, or
events are few, nothing is gained and all pixels keep the common thresholds.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.stream import MAX_EVENT_WEIGHT, count_polarities
from jaxevent.recording import Recording

N_IMAGE_PAIRS = 8  # between pairs of images that are evenly spaced over a recording
MAX_FRAME_INTERVALS = 4  # between the images of a pair
MIN_EVENTS_PER_PIXEL = 40.0  # per pixel in all changes together; with fewer nothing is learned
EXPECTED_DEVIATION_SIGMA = 0.1  # standard deviation of d, before it is known
MIN_DEVIATION_SIGMA = 0.05  # of d; pixels that differ less are averaged by the fusion as well
NEIGHBOURHOOD_SIGMA_PX = 4.0  # of the Gaussian over the pixels that one is compared with
HUBER_SQUARE = 5.0  # standardised squares beyond which changes count less
COMMON_FACTOR_BOUNDS = (0.5, 2.0)  # on the common threshold

ImageFunction = Callable[[int], tuple[NDArray, NDArray]]  # log intensity, variance at a time (us)


class LogChanges(NamedTuple):
    """Changes of log intensity, each (changes, pixels), ln I."""

    rest: NDArray[np.floating]  # left by the events and the common thresholds
    on: NDArray[np.floating]  # of ON events by the common threshold
    off: NDArray[np.floating]  # of OFF events, negative
    V: NDArray[np.floating]  # the variance of `rest`

    def select(self, rows: slice) -> "LogChanges":
        """Select some of the changes."""
        return LogChanges(*(values[rows] for values in self))


class ThresholdDeviations(NamedTuple):
    """Relative deviations of ON and OFF thresholds of pixels.

    Attributes:
        d: (2, pixels) deviations.
        remaining: (2, pixels) part of their prior variance that is left, 0..1.
    """

    d: NDArray[np.floating]
    remaining: NDArray[np.floating]


def regress_deviations(changes: LogChanges, prior_sigma: float) -> ThresholdDeviations:
    """Estimate the deviations d by robust ridge regression of every pixel.

    Args:
        changes: The changes.
        prior_sigma: Prior standard deviation of d.

    Returns:
        The deviations.
    """
    rest, on, off, V = changes
    W = 1 / (V + rest**2 / HUBER_SQUARE)
    A = (W * on * on).sum(0) + prior_sigma**-2
    B = (W * on * off).sum(0)
    C = (W * off * off).sum(0) + prior_sigma**-2
    a, b = (W * on * rest).sum(0), (W * off * rest).sum(0)
    det = A * C - B * B
    d = np.stack([C * a - B * b, A * b - B * a]) / det
    return ThresholdDeviations(d, np.stack([C, A]) / det / prior_sigma**2)


def subtract_local_mean(
    deviations: ThresholdDeviations, image_shape: tuple[int, int]
) -> ThresholdDeviations:
    """Subtract the mean of the pixels around: errors of the scene's motion are common to these.

    Args:
        deviations: Deviations of all pixels.
        image_shape: Height and width of the sensor, px.

    Returns:
        The deviations, less their Gaussian mean.
    """
    d = deviations.d.reshape(2, *image_shape)
    smooth = gaussian_filter(d, (0, NEIGHBOURHOOD_SIGMA_PX, NEIGHBOURHOOD_SIGMA_PX))
    return deviations._replace(d=(d - smooth).reshape(deviations.d.shape))


def estimate_deviation_sigma(first: ThresholdDeviations, second: ThresholdDeviations) -> float:
    """Estimate the standard deviation of d from two regressions on different changes.

    Each finds the part 1 - `remaining` of d, with independent errors.
    """
    found = ((1 - first.remaining) * (1 - second.remaining)).sum().clip(1e-12)
    return float(np.sqrt(max((first.d * second.d).sum() / found, 0.0)))


def _change_times(recording: Recording, span: tuple[int, int]) -> list[tuple[int, int]]:
    """Choose times between which to measure changes, which do not overlap.

    Args:
        recording: Events and frames.
        span: First and last time with data, us.

    Returns:
        Begin and end of each change, us.
    """
    first, last = span
    assert recording.frames is not None
    lag = (last - first) // N_IMAGE_PAIRS
    if len(recording.frames) > 1:
        lag = min(lag, MAX_FRAME_INTERVALS * int(np.median(np.diff(recording.frames.t))))
    begins = np.linspace(first, last - lag, N_IMAGE_PAIRS).astype(np.int64)
    return [(t, t + lag) for t in begins.tolist()]


def learn_thresholds(
    recording: Recording, params: Params, span_us: tuple[int, int], images: ImageFunction
) -> NDArray[np.float32] | None:
    """Learn the ON and OFF thresholds of every pixel.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        span_us: First and last time with data, us.
        images: A function from a time (us) to log intensity and its variance, of any shape.

    Returns:
        (2, pixels) factors on the common thresholds. None where events are too few, or where both
        halves of the changes do not have deviations above `MIN_DEVIATION_SIGMA` in common.
    """
    c_on, c_off = float(params.c_on), float(params.c_off)
    if not params.learn or span_us[1] - span_us[0] < N_IMAGE_PAIRS:
        return None
    times, source = _change_times(recording, span_us), recording.events
    pixels = recording.width * recording.height
    n_events = sum(source.index(end) - source.index(begin) for begin, end in times)
    if n_events * MAX_EVENT_WEIGHT < MIN_EVENTS_PER_PIXEL * pixels:
        return None
    rho = 1e6 * float(params.rho_ref)  # us
    counts = np.stack([count_polarities(recording, *pair, rho) for pair in times], 1)
    if counts.sum((0, 1)).mean() < MIN_EVENTS_PER_PIXEL:
        return None
    known = {t: images(t) for t in sorted({t for pair in times for t in pair})}
    rest = np.stack([(known[b][0] - known[a][0]).ravel() for a, b in times])
    P = np.stack([(known[b][1] + known[a][1]).ravel() for a, b in times])
    on, off = c_on * counts[0], -c_off * counts[1]
    steps = float(params.sigma_event) ** 2 * (c_on * on - c_off * off)
    drift = float(params.sigma_bg) ** 2 * np.array([(b - a) * 1e-6 for a, b in times])[:, None]
    changes = LogChanges(rest - on - off, on, off, P + steps + drift + c_on * c_off / 3)
    size = (recording.height, recording.width)
    halves = (slice(0, N_IMAGE_PAIRS // 2), slice(N_IMAGE_PAIRS // 2, None))
    found = estimate_deviation_sigma(
        *(
            subtract_local_mean(
                regress_deviations(changes.select(half), EXPECTED_DEVIATION_SIGMA), size
            )
            for half in halves
        )
    )
    if not found > MIN_DEVIATION_SIGMA:
        return None
    factors = 1 + subtract_local_mean(regress_deviations(changes, found), size).d
    return factors.clip(*COMMON_FACTOR_BOUNDS).astype(np.float32)
