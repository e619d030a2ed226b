"""Thresholds of single pixels, learned from fused images.

No two pixels of a sensor have the same contrast thresholds. Along trajectories others see what a
pixel saw, so the fused images tell by how much the log intensity at it changed, and its events by
how many thresholds. Between two times, for every pixel,

    M(t') - M(t) = (1 + d_on) c_on n_on - (1 + d_off) c_off n_off + noise,   d ~ N(0, sigma^2),

with the variances of both images, those of the events' steps, and of what is left of a threshold at
both ends. sigma is what both halves of the changes agree in, so it is that of left-out evidence;
where it is small, or events are few, nothing is gained and all pixels stay alike.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.stream import DeadTime, Stream, count_before, event_weights
from jaxevent.recording import Recording

CHANGES = 8  # between pairs of images that are evenly spaced over a recording
APART = 4  # intervals of frames, at most, between the images of a pair
ENOUGH = 40.0  # events per pixel in all changes together; with fewer nothing is learned
EXPECTED = 0.1  # standard deviation of d, before it is known
LEAST = 0.05  # of it; pixels that are less unlike are averaged by the fusion as well
AROUND = 4.0  # px, of the Gaussian over pixels that one is compared with
TAIL = 5.0  # standardised squares beyond which changes count less
FACTORS = (0.5, 2.0)  # of the common threshold, at least and at most

Images = Callable[[int], tuple[NDArray, NDArray]]  # log intensity and variance at a time (us)


class Changes(NamedTuple):
    """Changes of log intensity, each (changes, pixels), and what events tell of them."""

    rest: NDArray[np.floating]  # what the common thresholds leave
    on: NDArray[np.floating]  # what ON events tell, by the common threshold
    off: NDArray[np.floating]  # OFF events, negative
    V: NDArray[np.floating]  # the variance of `rest`

    def part(self, rows: slice) -> "Changes":
        """Some of them."""
        return Changes(*(values[rows] for values in self))


class Regressed(NamedTuple):
    """Deviations of ON and OFF thresholds of pixels, each (2, pixels)."""

    d: NDArray[np.floating]
    left: NDArray[np.floating]  # of their variance, 0..1: what changes did not tell


def regress(changes: Changes, mismatch: float) -> Regressed:
    """The mean of d, by robust ridge regression of every pixel."""
    rest, on, off, V = changes
    W = 1 / (V + rest**2 / TAIL)
    A = (W * on * on).sum(0) + mismatch**-2
    B = (W * on * off).sum(0)
    C = (W * off * off).sum(0) + mismatch**-2
    a, b = (W * on * rest).sum(0), (W * off * rest).sum(0)
    det = A * C - B * B
    d = np.stack([C * a - B * b, A * b - B * a]) / det
    return Regressed(d, np.stack([C, A]) / det / mismatch**2)


def stand_out(found: Regressed, size: tuple[int, int]) -> Regressed:
    """The same, as deviations from the pixels around. Errors of the scene's are common to these."""
    d = found.d.reshape(2, *size)
    smooth = gaussian_filter(d, (0, AROUND, AROUND))
    return found._replace(d=(d - smooth).reshape(found.d.shape))


def spread(one: Regressed, other: Regressed) -> float:
    """The standard deviation of deviations, from two regressions on different changes.

    Each finds the share 1 - left of them, and errors that do not go together.
    """
    common = (one.d * other.d).sum() / ((1 - one.left) * (1 - other.left)).sum().clip(1e-12)
    return float(np.sqrt(max(common, 0.0)))


def _times(recording: Recording, span: tuple[int, int]) -> list[tuple[int, int]]:
    """Begins and ends (us) of changes that do not overlap."""
    first, last = span
    assert recording.frames is not None
    lag = (last - first) // CHANGES
    if len(recording.frames) > 1:
        lag = min(lag, APART * int(np.median(np.diff(recording.frames.t))))
    begins = np.linspace(first, last - lag, CHANGES).astype(np.int64)
    return [(t, t + lag) for t in begins.tolist()]


def _count(recording: Recording, begin: int, end: int, rho: float) -> NDArray[np.floating]:
    """ON and OFF events (2, pixels) in between, those after a dead time (us) weighted for it."""
    source = recording.events
    # Of the pixels' events before as many as tell the gaps of nearly all.
    rows = slice(source.index(2 * begin - end), source.index(end))
    stream = Stream.of(source[rows], recording.width)
    pixels = recording.width * recording.height
    weight = event_weights(stream, np.full(pixels, recording.start), DeadTime(rho, False))
    before, after = count_before(stream, weight, np.array([begin, end]), np.zeros((2, pixels)))
    return after - before


def learn(
    recording: Recording, params: Params, span: tuple[int, int], images: Images
) -> NDArray[np.float32] | None:
    """Every pixel's ON and OFF thresholds (2, pixels) as parts of the common ones.

    None where the events are too few, or what both halves of the changes say of pixels does not
    agree in more than `LEAST`. `span` (us) is where the recording has data; `images` tells log
    intensity and variance, of any shape.
    """
    c_on, c_off = float(params.c_on), float(params.c_off)
    if not params.learn or span[1] - span[0] < CHANGES:
        return None
    times = _times(recording, span)
    counts = np.stack([_count(recording, *pair, 1e6 * float(params.rho_ref)) for pair in times], 1)
    if counts.sum((0, 1)).mean() < ENOUGH:
        return None
    known = {t: images(t) for t in sorted({t for pair in times for t in pair})}
    rest = np.stack([(known[b][0] - known[a][0]).ravel() for a, b in times])
    P = np.stack([(known[b][1] + known[a][1]).ravel() for a, b in times])
    on, off = c_on * counts[0], -c_off * counts[1]
    steps = float(params.sigma_event) ** 2 * (c_on * on - c_off * off)
    drift = float(params.sigma_bg) ** 2 * np.array([(b - a) * 1e-6 for a, b in times])[:, None]
    changes = Changes(rest - on - off, on, off, P + steps + drift + c_on * c_off / 3)
    size = (recording.height, recording.width)
    halves = (slice(0, CHANGES // 2), slice(CHANGES // 2, None))
    found = spread(*(stand_out(regress(changes.part(half), EXPECTED), size) for half in halves))
    if not found > LEAST:
        return None
    factors = 1 + stand_out(regress(changes, found), size).d
    return factors.clip(*FACTORS).astype(np.float32)
