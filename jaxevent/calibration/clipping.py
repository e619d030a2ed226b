"""Recognition of frames that reach their white or black."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Recording

MAX_FRAMES, MAX_FRAME_PIXELS = 16, 1 << 15  # evenly spaced frames and pixels that are examined
N_LEVELS = 255
WINDOW_LEVELS = 3  # width of a pile-up: noise of up to about one grey level
NEIGHBOUR_LEVELS = 16  # levels below a pile-up with which it is compared
# In frames that do not clip the histogram ends in a falling tail: its ratio is below 1.5.
MIN_PILE_UP_RATIO = 4.0
MIN_PILE_UP_PIXELS = 50  # fewer can be chance
MAX_STRAY_SHARE = 1e-3  # of the pixels, beyond a pile-up
# Pixels beyond the fullest level of a pile-up, relative to those on it. Nothing is brighter than
# white, but noise of a bright surface goes both ways: with a standard deviation of a quarter of a
# level, 2 % of the pixels are more than half a level off.
MAX_BEYOND_RATIO = 0.02
# Share of the pixels. Fewer white pixels are left as they are: their error does not count in frames
# that clip as well, and a guess of their excess would spread to the pixels beside them.
MIN_CLIPPED_SHARE = 0.05
MAX_CLIPPED_SHARE = 0.9  # of more pixels there is nothing to compare with
BAND_BELOW_WHITE_LOG_WIDTH = 0.35  # ln I; the density there is extrapolated beyond white
# Factor on the exponential extrapolation in simulated scenes: the density has modes beyond white.
EXCESS_FACTOR, EXCESS_BOUNDS = 0.4, (0.1, 2.0)


class ClippedEnd(NamedTuple):
    """One end of the grey values, and the pile-up there.

    | field | meaning |
    |---|---|
    | level | grey value (0 to 1) beyond which pixels are clipped; None if none are |
    | share | share of the pixels in the pile-up and beyond |
    | ratio | pixels in the pile-up over those in the fullest window of as many levels below |
    | excess | expected mean distance of clipped pixels beyond white, ln I |
    """

    level: float | None
    share: float
    ratio: float
    excess: float = 0.0


class ClippedEnds(NamedTuple):
    """Both ends of the grey values of a recording's frames."""

    black: ClippedEnd
    white: ClippedEnd


def find_clipping(recording: Recording) -> ClippedEnds:
    """Find the grey values at which a recording's frames clip, from the frames alone.

    Clipped pixels pile up at the last grey value that occurs. Three levels there are compared with
    the fullest three adjacent ones of the 16 levels before them, and nothing may lie beyond the
    fullest level. White may be any level. Saturation below the file's last level whose noise
    exceeds a quarter of a level cannot be distinguished from a bright wall, and is not found.
    """
    frames = recording.frames
    if frames is None or not len(frames):
        nothing = ClippedEnd(None, 0.0, 0.0)
        return ClippedEnds(nothing, nothing)
    rows = np.unique(np.linspace(0, len(frames) - 1, MAX_FRAMES).round().astype(int))
    stride = -(-recording.width * recording.height // MAX_FRAME_PIXELS)
    grey = np.concatenate([np.asarray(frames[k : k + 1].images).ravel()[::stride] for k in rows])
    whole = grey.dtype.kind in "iu"
    top = float(np.iinfo(grey.dtype).max) if whole else 1.0
    step = max(float(grey.max()) / N_LEVELS, 1.0 if whole else 1e-9)
    counts = np.bincount((grey / step + 0.5).astype(np.int64))
    white, black = _find_pile_up(counts), _find_pile_up(counts[::-1])
    if white.level is not None:
        level = white.level * step / top
        white = white._replace(
            level=level, excess=_expected_excess(recording, grey / top, level, white.share)
        )
    if black.level is not None:
        black = black._replace(level=(len(counts) - 1 - black.level) * step / top)
    return ClippedEnds(black, white)


def _find_pile_up(counts: NDArray[np.int64]) -> ClippedEnd:
    """Find the pile-up at the upper end of a histogram; its level is in bins."""
    beyond = counts[::-1].cumsum()[::-1] / counts.sum()
    last = int(np.flatnonzero(beyond >= MAX_STRAY_SHARE)[-1])
    padded = np.concatenate([np.zeros(WINDOW_LEVELS + NEIGHBOUR_LEVELS, np.int64), counts])
    windows = np.lib.stride_tricks.sliding_window_view(padded, WINDOW_LEVELS).sum(-1)
    ends = np.arange(last, len(counts)) + NEIGHBOUR_LEVELS + 1  # windows that end there
    end = int(ends[windows[ends].argmax()])
    below = int(windows[end - NEIGHBOUR_LEVELS : end - WINDOW_LEVELS + 1].max())
    ratio = float(windows[end] / below) if below else float("inf")
    first = max(end - WINDOW_LEVELS - NEIGHBOUR_LEVELS, 0)
    share = float(beyond[first])
    pile = counts[max(end - WINDOW_LEVELS - NEIGHBOUR_LEVELS, 0) :]
    fullest = int(pile[:WINDOW_LEVELS].argmax())
    outside = int(pile[fullest + 1 : fullest + 1 + WINDOW_LEVELS].sum())
    has_edge = outside <= MAX_BEYOND_RATIO * pile[fullest]
    piled = ratio >= MIN_PILE_UP_RATIO and windows[end] >= MIN_PILE_UP_PIXELS
    piled &= has_edge or share > MAX_CLIPPED_SHARE  # frames of hardly more than one value
    found = piled and MIN_CLIPPED_SHARE < share <= MAX_CLIPPED_SHARE
    return ClippedEnd(first - 0.5 if found else None, share if piled else 0.0, ratio)


def _expected_excess(recording: Recording, grey: NDArray, level: float, share: float) -> float:
    """Return the mean distance of clipped pixels beyond white, ln I.

    If the density of ln I falls exponentially, with mean m, from the lower end of the band on, then
    the band holds exp(BAND_BELOW_WHITE_LOG_WIDTH / m) - 1 pixels for each one beyond white.

    Args:
        recording: The recording, for its response.
        grey: (n,) grey values of sampled pixels, 0 to 1.
        level: Grey value beyond which pixels are clipped.
        share: Share of the pixels beyond it.

    Returns:
        The excess, ln I, within `EXCESS_BOUNDS`.
    """
    intensity = np.asarray(recording.response.intensity(np.append(grey, level)))
    light, white = intensity[:-1], intensity[-1]
    band = float(((light < white) & (light >= white * np.exp(-BAND_BELOW_WHITE_LOG_WIDTH))).mean())
    mean = BAND_BELOW_WHITE_LOG_WIDTH / np.log1p(band / share) if band else np.inf
    return float(np.clip(EXCESS_FACTOR * mean, *EXCESS_BOUNDS))
