"""Changes that events do not show: the flicker of frames, and movement below the thresholds.

An exposure that adapts, or flicker, makes single frames brighter than those before and after. An
image between frames may be brighter, too, and nothing determines it. So some frames are predicted
from their two neighbours each, and the error that all pixels have in common is squared.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.events.live import Tail
from jaxevent.reconstruction.frames import FrameClock, FrameImages
from jaxevent.recording import Recording

MAX_PREDICTED_FRAMES = 8
STEP_PX = 8  # from one pixel that is looked at to the next, in rows and columns
MIN_QUIET_PIXELS = 50  # without events around them, of which the median is taken
MIN_ERROR = 0.02  # intensity; less is motion or noise
# Of independent brightnesses of variance v two differ by 2 v, squared, and one from the mean of two
# others by 3 v / 2.
PAIR_FACTOR = 0.75
MOVING_RATE_HZ = 1.0  # events of a pixel, where half as much moves as at most


class UnseenChange(NamedTuple):
    """Measures of changes without events in a recording."""

    flicker: float  # variance of the intensity that all pixels of a frame share
    movement: float  # how much of it moves, 0 to 1, by the mean rate of its events


def measure_unseen_change(images: FrameImages, clock: FrameClock) -> UnseenChange:
    """Measure the changes of a recording that events do not show.

    Args:
        images: Frames of the recording.
        clock: Their times.

    Returns:
        The measures; of a live recording, whose end is not known, no flicker and full movement.
    """
    recording = images.recording
    if isinstance(recording.events, Tail):
        return UnseenChange(0.0, 1.0)
    seconds = (recording.stop - recording.start) * 1e-6
    rate = len(recording.events) / (recording.width * recording.height * max(seconds, 1e-6))
    return UnseenChange(measure_flicker(images, clock), rate / (rate + MOVING_RATE_HZ))


def measure_flicker(images: FrameImages, clock: FrameClock) -> float:
    """Measure the variance of a frame's brightness about that of its neighbours.

    Args:
        images: Source of the frames.
        clock: Times of the frames.

    Returns:
        The variance of the part of intensity that all pixels share; 0 where frames are steady.
    """
    n = len(clock)
    if n < 2:
        return 0.0
    middles = np.unique(np.linspace(1, n - 2, min(n - 2, MAX_PREDICTED_FRAMES)).round().astype(int))
    parts = [slice(k - 1, k + 2) for k in middles.tolist()] or [slice(0, 2)]
    squares = [_common_error(images, clock, part) ** 2 for part in parts]
    return (1.0 if n > 2 else PAIR_FACTOR) * float(np.mean(squares))


def _common_error(images: FrameImages, clock: FrameClock, part: slice) -> float:
    """Return the error that pixels share where the frames around predict the middle one.

    Of two frames the first predicts the second.

    Args:
        images: Source of the frames.
        clock: Times of the frames.
        part: Rows of two or three frames.

    Returns:
        The error of intensity; 0 where it is small, or few pixels are quiet.
    """
    intensity = images.sample(part, STEP_PX)
    if len(intensity) == 2:
        error = intensity[1] - intensity[0]
    else:
        before, now, after = clock.mid[part]
        w = (now - before) / max(after - before, 1)
        error = intensity[1] - (1 - w) * intensity[0] - w * intensity[2]
    if abs(np.median(error)) < MIN_ERROR:
        return 0.0
    error = error[_quiet_pixels(images.recording, clock, part)]
    common = float(np.median(error)) if error.size >= MIN_QUIET_PIXELS else 0.0
    return common if abs(common) >= MIN_ERROR else 0.0


def _quiet_pixels(recording: Recording, clock: FrameClock, part: slice) -> NDArray[np.bool_]:
    """Find the pixels without events between frames, in the 3x3 pixels around.

    Args:
        recording: Events and frames.
        clock: Times of the frames.
        part: Rows of the frames.

    Returns:
        (rows, columns) whether it is quiet, of every `STEP_PX`-th pixel.
    """
    from scipy.ndimage import maximum_filter

    source, mids = recording.events, clock.mid[part] + clock.origin
    events = source[source.index(int(mids[0])) : source.index(int(mids[-1]))]
    seen = np.zeros((recording.height, recording.width), bool)
    seen[events.y, events.x] = True
    return ~maximum_filter(seen, 3)[::STEP_PX, ::STEP_PX]
