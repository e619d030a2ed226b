"""The offset of two clocks, from when frames and events change."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import correlate

from jaxevent.errors import InputError
from jaxevent.recording import Recording
from jaxevent.register.frames import event_span, log_image

_CANDIDATES = 4  # offsets that are tried
_CELLS = 64  # to the width of an image, where clocks are compared
_BLOCK = 128  # steps of that raster held at a time


def clock_offsets(
    recording: Recording, other: Recording, search: float | int | None = None
) -> list[float]:
    """Offsets (s) at which the frames' changes go with the events', the likeliest first.

    Both are reduced to about 64 x 48 cells on a raster of half a frame: the change of ln intensity
    from a frame to the next, and ON minus OFF events of as long a time. Two things are correlated
    at every lag (Pearson's r of what overlaps; Padfield, CVPR 2010): how large the changes are, the
    logarithm of the mean of their absolute values at two smoothnesses, for which the cameras need
    not look the same way; and, counted twice, the smoothed changes at places as they are, for which
    they should, roughly. Up to four maxima of the sum with half the best one or more, and 0 where
    clocks may be the same. Right to about half a frame, which is enough for `refine`.

    `search` (s) bounds the offset; by default the overlap is at least half the shorter recording.
    Raises `InputError` if no offset lets them overlap.
    """
    assert other.frames is not None
    t = other.frames.t
    step = max(float(np.median(np.diff(t))) / 2, 1.0)
    begin, _ = event_span(recording)
    both = [_changes_of_events(recording, step), _changes_of_frames(other)]
    middle, along = (t[1:] + t[:-1]) / 2, begin + step * (np.arange(len(both[0])) + 1)
    across = np.arange(middle[0], middle[-1] + 1e-3, step)
    if len(across) < 6 or len(along) < 6:
        return [0.0]
    weights = np.append([0.5, 0.5], np.full(both[0].shape[1] - 2, 2 / (both[0].shape[1] - 2)))
    total, n = np.zeros(()), np.zeros(0)
    for weight, one, two in zip(weights, both[0].T, both[1].T, strict=True):
        r, n = _correlate(one, np.interp(across, middle, two))
        total = total + weight * r
    lags = (np.arange(len(n)) - (len(across) - 1)) * step + along[0] - across[0]
    fewest = max(6, min(len(along), len(across)) / 2 * (search is None))
    allowed = (n >= fewest) & (np.abs(lags) <= (math.inf if search is None else search * 1e6))
    around = np.pad(np.where(allowed, total, -np.inf), 1, constant_values=-np.inf)
    score = around[1:-1]
    peaks = np.flatnonzero((score >= around[:-2]) & (score > around[2:]) & (score > 0))
    peaks = peaks[np.argsort(-score[peaks], kind="stable")][:_CANDIDATES]
    found = []
    for peak in peaks:
        if score[peak] < score[peaks[0]] / 2:
            break
        left, top, right = around[peak : peak + 3]
        bend = left - 2 * top + right
        shift = 0.5 * (left - right) / bend if np.isfinite(bend) and bend < 0 else 0.0
        found.append(float((lags[peak] + shift * step) * 1e-6))
    same = bool(allowed[np.argmin(np.abs(lags))]) and abs(lags).min() <= step
    if same and all(abs(one) > 1e-6 * step for one in found):
        found.append(0.0)
    if not found:
        raise InputError(
            f"{other.name}: no offset of its clock brings its frames and the events together; give "
            "the offset that is added to the frames' time stamps"
        )
    return found


def _signature(change: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is compared of changes (times, rows, cells): two sizes, then places, (times, ...)."""
    smooth: list[NDArray] = [
        ndimage.gaussian_filter(change, (0, sigma, sigma)) for sigma in (1.5, 4)
    ]
    sizes = [np.log(np.abs(one).mean((1, 2)) + 1e-5) for one in smooth]
    wide: NDArray = ndimage.gaussian_filter(change, (0, 8, 8), mode="constant")
    middle = wide.shape[1] // 2
    # Six rows of eight about the middle, wherever the images end.
    rows = np.clip(middle + np.arange(-20, 21, 8), 0, wide.shape[1] - 1)
    places = wide[:, rows][:, :, 4::8].reshape(len(wide), -1)
    return np.concatenate([np.stack(sizes, 1), places], 1)


def _cells(width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """The row and the column of cells of pixel rows and columns, and the number of rows."""
    rows = max(1, round(height * _CELLS / width))
    down = np.minimum(np.arange(height) * _CELLS // width, rows - 1)
    return down, np.arange(width) * _CELLS // width, rows


def _changes_of_frames(other: Recording) -> NDArray[np.float64]:
    """The signature of the change of ln intensity from each frame to the next."""
    assert other.frames is not None
    down, along, rows = _cells(other.width, other.height)
    place = (down[:, None] * _CELLS + along).ravel()
    count = np.maximum(np.bincount(place, minlength=rows * _CELLS), 1)
    out, before = [], log_image(other, 0)
    for first in range(1, len(other.frames), _BLOCK):
        changes = []
        for row in range(first, min(first + _BLOCK, len(other.frames))):
            level, good = log_image(other, row)
            change = np.where(good & before[1], level - before[0], 0).ravel()
            changes.append(np.bincount(place, change, rows * _CELLS) / count)
            before = level, good
        out.append(_signature(np.stack(changes).reshape(-1, rows, _CELLS)))
    return np.concatenate(out)


def _changes_of_events(recording: Recording, step: float) -> NDArray[np.float64]:
    """The same of 0.2 (ON - OFF) per pixel in windows of two steps (us), a step apart."""
    down, along, rows = _cells(recording.width, recording.height)
    begin, end = event_span(recording)
    steps, out = int((end - begin) / step) + 1, []
    for first in range(0, max(steps - 1, 1), _BLOCK):
        count = min(_BLOCK + 1, steps - first)
        edges = (begin + math.ceil(k * step) for k in (first, first + count))
        events = recording.events[slice(*(recording.events.index(edge) for edge in edges))]
        when = np.clip(((events.t - begin) / step).astype(int) - first, 0, count - 1)
        place = (when * rows + down[events.y]) * _CELLS + along[events.x]
        sign = np.where(events.p, 0.2, -0.2) * _CELLS**2 / recording.width**2
        net = np.bincount(place, sign, count * rows * _CELLS).astype(np.float64)
        net = net.reshape(count, rows, _CELLS)
        out.append(_signature(net[1:] + net[:-1]))
    return np.concatenate(out)


def _correlate(
    one: NDArray[np.float64], two: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pearson's correlation and the number of values that overlap, at every lag.

    Entry k: two[i] lies on one[i + k - (len(two) - 1)].
    """

    one, two = one - one.mean(), two - two.mean()

    def over(a: NDArray, b: NDArray) -> NDArray:
        return correlate(a, b, "full", "fft")

    ones, twos = np.ones_like(one), np.ones_like(two)
    n = np.maximum(np.rint(over(ones, twos)), 1)
    a, b, ab = over(one, twos), over(ones, two), over(one, two)
    aa, bb = over(one**2, twos) - a**2 / n, over(ones, two**2) - b**2 / n
    enough = (aa > 1e-9 * n) & (bb > 1e-9 * n)
    r = (ab - a * b / n) / np.sqrt(np.where(enough, aa * bb, 1))
    return np.where(enough, r, 0), n
