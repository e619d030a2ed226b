"""Pixels of a window's frames, fitted with its events to one map.

A pixel u of a frame at t_f shows the scene's log intensity itself, but for the frame's brightness:

    L(x_ref(u, t_f)) = ln(I_f(u) + DARK) / C + g_f.

So the pixels of a frame are a track of their own, of which the mean is not known. The contrast
threshold C is how much the logarithm changes from frame to frame where events were several, for
each of them: between the slopes of either by the other, as both are noisy. Where they do not agree,
as in frames of another view, or with the polarities exchanged, frames are left out.

Stamps of frames may be off: on slider_depth they are 4 ms before the middle of the exposure by the
clock of events, on evbench_seq3 8 ms after it. `offset` finds by how much changes from frame to
frame agree best with the events between them.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.tracks import Tracks
from jaxevent.recording import Recording

DARK = 0.02  # grey, added before the logarithm
CLIPPED = 0.03, 0.97  # grey, beyond which a pixel tells no intensity
SEVERAL = 2  # events, of one polarity more than of the other, that tell the threshold
ENOUGH = 200  # pixels with so many
AGREEING = 0.5  # the least correlation of changes and events
STEEP = 0.5  # the share of pixels, those with the steepest surroundings, that are fitted
STEP = 1 / 512  # grey, the noise of 8 bits at least
NOISE = 0.1  # C, of events: what is noisier counts less
PAIRS = 20  # of frames, those with most events between them, that tell the offset
FARTHEST = 20_000  # us, of offsets that are tried
# What no image of gentle slopes has (Immerkaer, 1996), 6 times the noise of a pixel.
ROUGH = np.outer([1, -2, 1], [1, -2, 1])


class Account(NamedTuple):
    """How events about a frame tell its level."""

    following: int  # us within which the next event after it is looked for
    only: bool  # whether pixels count only that have one
    step: int  # us between offsets that are tried


# Where both do not find the same offset, so many us apart at most, it is not told: before simulated
# walls of little contrast, whose stamps are right, they find -6 and 17 ms, and headings end 4
# degrees off. On evbench_seq3, where changes agree with events no better, they find -7.6 and -8.2.
ACCOUNTS = Account(50_000, False, 2000), Account(100_000, True, 4000)
ALIKE = 2000


class FramePixels(NamedTuple):
    """A window's frames: log intensity in units of the threshold, and what of it is told."""

    t: NDArray[np.int64]  # us
    level: NDArray[np.float64]  # (frames, pixels)
    trust: NDArray[np.float64]  # likewise; 0: not told
    steep: NDArray[np.bool_]  # (pixels,)


def look_at(recording: Recording, first: int, last: int, late: int = 0) -> FramePixels | None:
    """The frames of a window (us); None where they tell nothing beside the events.

    `late` us are added to their stamps.
    """
    frames = recording.frames
    rows = np.flatnonzero((frames.t + late > first) & (frames.t + late < last)) if frames else ()
    if frames is None or len(rows) < 2:
        return None
    grey = frames[slice(int(rows[0]), int(rows[-1]) + 1)].intensity.astype(np.float64)
    t = frames.t[rows] + late
    level, told = _levels(grey)
    threshold = _threshold(recording, t, level, told)
    if threshold is None:
        return None
    rough = np.abs([scipy.ndimage.convolve(image, ROUGH) for image in grey])
    noise = max(1.48 / 6 * float(np.median(rough)), STEP)
    slopes = np.hypot(*np.gradient(level.mean(0)))
    seen = told.all(0)
    steep = seen & (slopes >= np.quantile(slopes[seen], 1 - STEEP)) if seen.any() else seen
    trust = np.minimum(1, NOISE * threshold * (grey + DARK) / noise) * told
    flat = len(t), -1
    return FramePixels(t, level.reshape(flat) / threshold, trust.reshape(flat), steep.ravel())


def offset(recording: Recording) -> int:
    """How many us to add to the frames' stamps; 0 where events do not tell an offset."""
    frames = recording.frames
    if frames is None or len(frames.t) < 2:
        return 0
    lasts, begins = np.diff(frames.t), [recording.events.index(int(t)) for t in frames.t]
    most = min(FARTHEST, int(lasts.min()) // 2)
    pairs: list[tuple[NDArray, NDArray, NDArray]] = []
    for k in np.argsort(-np.diff(begins), kind="stable")[:PAIRS]:
        level, told = _levels(frames[slice(int(k), int(k) + 2)].intensity.astype(np.float64))
        pairs.append((frames.t[k : k + 2], level, np.all(told, axis=0)))
    late = _agreed(recording, pairs, most, ACCOUNTS[0])
    other = None if late is None else _agreed(recording, pairs, most, ACCOUNTS[1])
    return late if late is not None and other is not None and abs(late - other) <= ALIKE else 0


def _agreed(
    recording: Recording,
    pairs: list[tuple[NDArray, NDArray, NDArray]],
    most: int,
    account: Account,
) -> int | None:
    """The offset (us), up to the most, of highest agreement; None where that is no maximum."""
    end = most // account.step * account.step
    tried = np.arange(-end, end + 1, account.step)
    agree = [_agreement(recording, pairs, int(late), account) for late in tried]
    best = int(np.argmax(agree))
    if not 0 < best < len(tried) - 1 or not agree[best] > AGREEING:
        return None
    before, at, after = agree[best - 1 : best + 2]
    bend = max(2 * at - before - after, 1e-9)  # of the parabola, whose top it is
    return int(tried[best] + round(account.step * (after - before) / 2 / bend))


def _levels(grey: NDArray) -> tuple[NDArray, NDArray]:
    """Log intensity, and where it is told."""
    return np.log(np.maximum(grey, 0) + DARK), (grey > CLIPPED[0]) & (grey < CLIPPED[1])


def _change(
    recording: Recording,
    t: NDArray,
    level: NDArray,
    told: NDArray,
    account: Account | None = None,
) -> tuple[NDArray, NDArray] | None:
    """Of pixels told in two frames at t (us), changes of level and sums of polarities between.

    Sums lag: they tell the level at the last event. Between that and the next it is about halfway,
    and sums of such levels are told by an `account`.
    """
    end = t[1] + (account.following if account else 0)
    first, last, till = (recording.events.index(int(at)) for at in (*t, end))
    events, pixels = recording.events[first:till], told.size
    pixel = events.y.astype(np.int64) * recording.width + events.x
    p, between = np.where(events.p, 1, -1), last - first
    told = told.ravel()
    quiet = told & (np.bincount(pixel[:between], minlength=pixels) == 0)
    if not quiet.any():
        return None
    number: NDArray = np.bincount(pixel[:between], p[:between], pixels)
    for sign, begin in ((-1, 0), (1, between)) if account else ():
        next_one = np.zeros(pixels)
        next_one[pixel[begin:][::-1]] = p[begin:][::-1]  # what is written last is the first
        number += sign / 2 * next_one
        told = told & (next_one != 0) if account and account.only else told
    change = (level[1] - level[0]).ravel()
    # Exposures may change.
    return change[told] - np.median(change[quiet]), number[told]


def _agreement(
    recording: Recording,
    pairs: list[tuple[NDArray, NDArray, NDArray]],
    late: int,
    account: Account,
) -> float:
    """The correlation of changes and sums, of frames so much later than their stamps."""
    found = [_change(recording, t + late, level, told, account) for t, level, told in pairs]
    kept = [one for one in found if one is not None]
    if not kept:
        return 0.0
    y, n = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    # By einsum: larger products wake BLAS's threads, which spin then.
    yy, yn, nn = (np.einsum("i,i", *pair) for pair in ((y, y), (y, n), (n, n)))
    return float(yn / np.sqrt(max(yy * nn, 1e-30)))


def _threshold(recording: Recording, t: NDArray, level: NDArray, told: NDArray) -> float | None:
    """The contrast threshold; None where events do not agree with the frames."""
    parts = []
    for k in range(len(t) - 1):
        found = _change(recording, t[k : k + 2], level[k : k + 2], told[k] & told[k + 1])
        if found is not None:
            several = np.abs(found[1]) >= SEVERAL
            parts.append([part[several] for part in found])
    if sum(len(change) for change, _ in parts) < ENOUGH:
        return None
    y, n = (np.concatenate(part) for part in zip(*parts, strict=True))
    yy, yn, nn = y @ y, y @ n, n @ n
    if not yn > AGREEING * np.sqrt(yy * nn):
        return None
    return float(np.sqrt(yn / nn * np.sqrt(yy / nn)))


def with_frames(
    tracks: Tracks, seen: FramePixels, xi: NDArray, centre: int, most: int, seed: int
) -> Tracks:
    """The tracks of events, and after them at most so many pixels of frames.

    `xi` (pixels, 2) are where pixels lie (px, undistorted, from the principal point).
    """
    each, rng = most // len(seen.t), np.random.default_rng([seed, abs(centre), most])
    chosen = []
    for trust in seen.trust:
        free = np.flatnonzero(seen.steep & (trust > 0))
        chosen.append(np.sort(rng.choice(free, min(each, len(free)), replace=False)))
    number = np.array([len(one) for one in chosen])
    if not number.all():
        return tracks
    which, pixel = np.repeat(np.arange(len(number)), number), np.concatenate(chosen)
    none = np.zeros(len(pixel))
    tau = (seen.t[which] - centre) * 1e-6
    more = {"x": xi[pixel, 0], "y": xi[pixel, 1], "tau": tau, "number": none, "p": none}
    more |= {"level": seen.level[which, pixel], "trust": seen.trust[which, pixel]}
    both = {
        name: np.concatenate([getattr(tracks, name), rows]).astype(tracks.x.dtype)
        for name, rows in more.items()
    }
    begin = np.append(tracks.begin, tracks.begin[-1] + np.cumsum(number))
    return dataclasses.replace(tracks, **both, begin=begin)
