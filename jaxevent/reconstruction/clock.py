"""The frames in time: where exposures lie on the events' clock, and where times lie among them."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.recording import Recording


class Timing(NamedTuple):
    """What preparation compares event times with (s); parameters of that name of every estimator.

    `clock_offset` is added to the frames' time stamps, `exposure` is that of frames whose own is
    not known, `rho_ref` a pixel's dead time after an event. An event after the gap dt at its pixel
    stands for min(dt / (dt - rho_ref), 3) events: what happened in the dead time is lost.

    An event is late: the intensity has been moving since the pixel's last one. Where no more than
    `spread` lies between the two, the second's change is spread evenly over that time, which needs
    later events and is for methods that do not filter.
    """

    clock_offset: float = 0.0
    exposure: float = 0.0
    rho_ref: float = 0.0
    spread: float = 0.0

    @classmethod
    def of(cls, params: Any) -> "Timing":
        """From an estimator's parameters, rounded to 10 ns: 7.5 ms is 7500 us in float32 too."""
        return cls(**{n: round(float(getattr(params, n, 0.0)), 8) for n in cls._fields})


def time_span(recording: Recording, clock_offset: Any = 0.0) -> tuple[int, int]:
    """The times (us) between which images rest on data.

    They reach from the first event or frame to the last, frames on the events' clock as well as
    stamped.
    """
    late = 0 if recording.frames is None else round(float(clock_offset) * 1e6)
    return recording.start + min(late, 0), recording.stop + max(late, 0)


class FrameTimes(NamedTuple):
    """Times (us from the recording's start) of the frames that a window uses, for loops.

    Whether an exposure is `aligned`: its left edge begins a piece, so that the counts there are
    those of the stream.
    """

    origin: int  # us, the recording's start
    breaks: NDArray[np.floating]  # ends of pieces
    weight_rate: NDArray[np.floating]  # 1/us
    mids: NDArray[np.floating]  # mid-exposures
    blend_rate: NDArray[np.floating]  # 1/us
    aligned: NDArray[np.bool_]
    exposed: bool  # whether exposures are pieces of their own


@dataclasses.dataclass(frozen=True)
class Clock:
    """The frames in time: float64 microseconds from the recording's start, offset applied.

    `breaks` are the times at which pieces end. Exposures that overlap (a jittering stamp) share the
    overlap as their gap, clipped to the two mid-exposures, so that the augmented frame stays
    continuous; exposures that do not overlap are used as they are.
    """

    mid: NDArray[np.floating]
    left: NDArray[np.floating]
    right: NDArray[np.floating]
    breaks: NDArray[np.floating]
    exposed: bool
    offset: float  # s
    origin: int  # us, the recording's start

    @classmethod
    def of(cls, recording: Recording, timing: Timing) -> "Clock":
        offset = round(timing.clock_offset * 1e8) / 100
        frames, origin = recording.frames, recording.start
        if frames is None:
            none = np.empty(0)
            return cls(none, none, none, none, False, offset * 1e-6, origin)
        mid = (frames.t - origin) + offset
        unknown = round(timing.exposure * 1e8) / 100
        exposure = np.where(frames.exposure > 0, frames.exposure, unknown)
        left, right = mid - exposure / 2, mid + exposure / 2
        exposed = bool((exposure > 0).any())
        breaks = mid
        if exposed:
            gap = np.sort([right[:-1], left[1:]], axis=0).clip(mid[:-1], mid[1:])
            breaks = np.stack([np.r_[left[0], gap[1]], np.r_[gap[0], right[-1]]], 1).ravel()
        return cls(mid, left, right, breaks, exposed, offset * 1e-6, origin)

    def __len__(self) -> int:
        return len(self.mid)

    def frame(self, piece: Any) -> Any:
        """The frame whose left edge pieces count events from; -1 before the first exposure."""
        return (piece - 1) // 2 if self.exposed else piece - 1

    def first_piece(self, first_frame: int) -> int:
        """The piece that is 0 in a window: it stands for everything before the first frame."""
        return (2 if self.exposed else 1) * first_frame

    def locate(self, time: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Piece, frame before, weight in the piece and blend between frames, at times in us."""
        piece = np.searchsorted(self.breaks, time, "right")
        frame = np.searchsorted(self.mid, time, "right") - 1
        return (
            piece,
            np.maximum(frame, 0),
            _position(self.breaks, piece - 1, time),
            _position(self.mid, frame, time),
        )

    def elapsed(self, time: NDArray, frame: NDArray) -> NDArray:
        """Seconds from the middle of frames to times in us; 0 without frames."""
        return (time - self.mid[frame]) * 1e-6 if len(self) else np.zeros(len(time))

    def used(self, start: int | None, stop: int | None) -> slice:
        """The frames that tell what happens from start to stop (us), one more on each side."""
        span = np.array(
            [
                -np.inf if start is None else start - self.origin,
                np.inf if stop is None else stop - self.origin,
            ]
        )
        first, last = self.frame(np.searchsorted(self.breaks, span, "right"))
        return slice(max(int(first) - 1, 0), min(max(int(last), 0) + 2, len(self)))

    def edges(self, used: slice) -> list[NDArray[np.int64]]:
        """Left edge, middle and right edge of exposures (us): events with t < edge are before it.

        Half microseconds are rounded up, which says the same of whole ones.
        """
        edges = (self.left, self.mid, self.right)
        return [np.ceil(edge[used]).astype(np.int64) + self.origin for edge in edges]

    def times_from(self, first_frame: int) -> FrameTimes:
        """The times of the frames from `first_frame` on."""
        breaks, mids = self.breaks[self.first_piece(first_frame) :], self.mid[first_frame:]
        aligned = self.left[first_frame:] == (breaks[::2] if self.exposed else breaks)
        return FrameTimes(
            self.origin, breaks, rates(breaks), mids, rates(mids), aligned, self.exposed
        )


def rates(breaks: NDArray) -> NDArray:
    """1 / length (1/us) of the stretches between breaks, 0 for empty ones."""
    length = np.diff(breaks)
    return np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)


def _position(breaks: NDArray, i: NDArray, time: NDArray) -> NDArray:
    """How far `time` lies between breaks i and i + 1, 0 outside the first and last."""
    inside = (i >= 0) & (i < len(breaks) - 1)
    if not inside.any():
        return np.zeros(len(time))
    j = np.where(inside, i, 0)
    return np.where(inside, (time - breaks[j]) * rates(breaks)[j], 0)
