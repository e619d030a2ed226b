"""Pixels of a window's frames, fitted with its events to one map.

A pixel u of a frame at t_f shows the scene's log intensity itself, but for the frame's brightness:

    L(x_ref(u, t_f)) = ln(I_f(u) + DARK) / C + g_f.

So the pixels of a frame are a track of their own, of which the mean is not known. The contrast
threshold C is how much the logarithm changes from frame to frame where events were several, for
each of them: between the slopes of either by the other, as both are noisy. Where they do not agree,
as in frames of another view, or with the polarities exchanged, frames are left out.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from jaxevent.egomotion.batch_fit.tracks import Tracks
from jaxevent.recording import Recording

DARK = 0.02  # grey, added before the logarithm
CLIPPED = 0.03, 0.97  # grey, beyond which a pixel tells no intensity
SEVERAL = 2  # events, of one polarity more than of the other, that tell the threshold
ENOUGH = 200  # pixels with so many
AGREEING = 0.5  # the least correlation of changes and events
STEEP = 0.5  # the share of pixels, those with the steepest surroundings, that are fitted
STEP = 1 / 512  # grey, the noise of 8 bits at least
NOISE = 0.1  # C, of events: what is noisier counts less
# What no image of gentle slopes has (Immerkaer, 1996), 6 times the noise of a pixel.
ROUGH = np.outer([1, -2, 1], [1, -2, 1])


class FramePixels(NamedTuple):
    """A window's frames: log intensity in units of the threshold, and what of it is told."""

    t: NDArray[np.int64]  # us
    level: NDArray[np.float64]  # (frames, pixels)
    trust: NDArray[np.float64]  # likewise; 0: not told
    steep: NDArray[np.bool_]  # (pixels,)


def look_at(recording: Recording, first: int, last: int) -> FramePixels | None:
    """The frames of a window (us); None where they tell nothing beside the events."""
    frames = recording.frames
    rows = np.flatnonzero((frames.t > first) & (frames.t < last)) if frames else ()
    if frames is None or len(rows) < 2:
        return None
    grey = frames[slice(int(rows[0]), int(rows[-1]) + 1)].intensity.astype(np.float64)
    t = frames.t[rows]
    told = (grey > CLIPPED[0]) & (grey < CLIPPED[1])
    level = np.log(np.maximum(grey, 0) + DARK)
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


def _threshold(recording: Recording, t: NDArray, level: NDArray, told: NDArray) -> float | None:
    """The contrast threshold; None where events do not agree with the frames."""
    pixels, changes, numbers = level[0].size, [], []
    for k in range(len(t) - 1):
        first, last = (recording.events.index(int(at)) for at in t[k : k + 2])
        events = recording.events[first:last]
        pixel = events.y.astype(np.int64) * recording.width + events.x
        number = np.bincount(pixel, np.where(events.p, 1, -1), pixels)
        both = told[k : k + 2].all(0).ravel()
        quiet = both & (np.bincount(pixel, minlength=pixels) == 0)
        if not quiet.any():
            continue
        several = both & (np.abs(number) >= SEVERAL)
        change = (level[k + 1] - level[k]).ravel()
        changes.append(change[several] - np.median(change[quiet]))  # exposures may change
        numbers.append(number[several])
    if sum(map(len, numbers)) < ENOUGH:
        return None
    y, n = np.concatenate(changes), np.concatenate(numbers)
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
