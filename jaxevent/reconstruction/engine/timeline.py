"""A window's stretches of time: where points lie in one piece, after one frame."""

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.engine.loop import Line
from jaxevent.reconstruction.engine.pixel import ROWS, Variant, pieces, variants
from jaxevent.reconstruction.frames import Clock, rates

NEVER = 1 << 45  # us, longer than any recording and within an event's bits


def make_line(
    clock: Clock, start: int | None, stop: int | None, gain: NDArray, dtype: np.dtype
) -> Line:
    """The stretches from start to stop (us; None: without bound), in us since the start."""
    begin = -NEVER if start is None else start - clock.origin
    end = NEVER if stop is None else stop - clock.origin
    bounds = np.unique(np.ceil(np.concatenate([clock.breaks, clock.mid])).astype(np.int64))
    times = np.concatenate([[begin], bounds[(bounds > begin) & (bounds < end)]]).astype(np.int64)
    piece = np.searchsorted(clock.breaks, times, "right")
    before = np.searchsorted(clock.mid, times, "right") - 1
    frame = np.asarray(clock.frame(piece))
    # Where a piece, and the frame before its points, lie among the frames that tell of it.
    first = np.maximum(frame - 1, 0)
    at = np.stack([piece - clock.first_piece(1) * first, np.maximum(before, 0) - first], 1)
    known = variants(clock.exposed)
    variant = [known.index(Variant(*place)) for place in at.tolist()]
    piece_begin, rate = _stretch(clock.breaks, piece - 1)
    mid, blend_rate = _stretch(clock.mid, before)
    uniform = np.stack([_uniform(clock, int(f), gain) for f in frame]).astype(dtype)
    return Line(times, frame, np.array(variant), piece_begin, rate, mid, blend_rate, uniform, begin)


def _stretch(breaks: NDArray, at: NDArray) -> tuple[NDArray, NDArray]:
    """Where the stretches after breaks begin, and 1 / length; both 0 outside the breaks."""
    if len(breaks) < 2:
        return np.zeros(len(at)), np.zeros(len(at))
    inside = (at >= 0) & (at < len(breaks) - 1)
    k = np.where(inside, at, 0)
    return np.where(inside, breaks[k], 0.0), np.where(inside, rates(breaks)[k], 0.0)


def _uniform(clock: Clock, frame: int, gain: NDArray) -> NDArray:
    """What the tables of a piece of `frame` need to know: `FrameFeatures` of three frames."""
    first = max(frame - 1, 0)
    stop = min(len(clock), max(frame, 0) + 2)

    def padded(values: NDArray, size: int, at: int, rest: float) -> NDArray:
        out = np.full(size, rest)
        part = values[: size - at]
        out[at : at + len(part)] = part
        return out

    used = slice(first, stop)
    breaks = clock.breaks[clock.first_piece(first) :]
    return np.concatenate(
        [
            padded(gain[used], ROWS, 0, 1.0),
            padded(1e6 * rates(breaks), pieces(clock.exposed), 1, 0.0),
            padded(1e6 * rates(clock.mid[used]), ROWS, 0, 0.0),
        ]
    )
