"""Protocols of reconstruction: the input of a method, and the true images to compare with.

"held-out" gives frames 0, 2, 4, ... and asks for images where frames 1, 3, 5, ... are, at their
time stamps plus the method's `clock_offset`; a function of your own gets the stamps. With a `gap` g
it gives every g-th frame, 0, g, 2 g, ..., and asks for all others. The truth is the intensity of
the hidden frames: their grey values, and where the recording holds the camera's response or gains,
`Recording.linear_frames`. Images are clipped to the range of the truth, [0, 1] without gains,
before they are scored.

"reference" gives the whole recording and asks for the HDR images that it keeps in
`Recording.extra`, float linear intensities of which 1 is the frames' white, without clipping:

    hdr      (T, H, W)  with hdr_t (T,), sorted times (us) on the events' clock
    HDR_mat  (K, H, W)  of the AKF authors' .mat files, used where there is no hdr: at the time of
                        each of the K frames plus `clock_offset`; a single (H, W) image: of the last
    clip     (2,)       what the frames record from and to; absent: 0.01, 1

Pixels that are NaN in hdr have no reference. HDR_mat counts in the frames' grey levels (255 is
white where they are uint8) and is 0 where it has no reference, as the authors' programs have it. In
the measures of whole images such pixels count as right; regions and mean errors leave them out.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.events.clocks import check_clocks
from jaxevent.parameters import check_choice
from jaxevent.recording import Frames, Recording, microseconds

DEFAULT_GAP_FRAMES = 2  # every second frame is given
GAP_DOMAIN = "a whole number of frames from one that is kept to the next, 2 or more"


def is_gap(value: Any) -> bool:
    """Return true for a whole number of 2 or more."""
    return type(value) is int and value >= 2


def held_out(recording: Recording, gap: int = DEFAULT_GAP_FRAMES) -> tuple[Recording, Frames]:
    """Split a recording into the frames to give and those to hide.

    Args:
        recording: A recording with frames and events.
        gap: Every `gap`-th frame is given.

    Returns:
        The recording with every `gap`-th frame, and the hidden frames.

    Raises:
        InputError: The gap is below 2, there are fewer than gap + 1 frames, or no events.
    """
    if not is_gap(gap):
        raise InputError(f"a gap of {gap!r} hides no frame; give {GAP_DOMAIN}")
    frames = recording.frames
    if frames is None or len(frames) <= gap:
        which = "second one" if gap == 2 else f"one but each {gap}th"
        raise InputError(
            f"{recording.name}: has {0 if frames is None else len(frames)} frames"
            f"{recording.describe_left_out('frames')}; hiding every {which} needs at least "
            f"{gap + 1}, so choose a recording with more"
        )
    _need_events(recording)
    hidden = slice(1, None, 2) if gap == 2 else np.flatnonzero(np.arange(len(frames)) % gap)
    return recording.with_frames(slice(0, None, gap)), recording.linear_frames[hidden]


def frames_around(given: Frames, row: int, gap: int = DEFAULT_GAP_FRAMES) -> tuple[int, int] | None:
    """Return the given frames before and after a hidden one.

    Args:
        given: Frames of the recording that `held_out` returns.
        row: Index of the hidden frame.
        gap: As for `held_out`.

    Returns:
        Indices of the given frames before and after; None after the last.
    """
    before = row // (gap - 1)
    return (before, before + 1) if before + 1 < len(given) else None


def _need_events(recording: Recording) -> None:
    if not len(recording.events):
        raise InputError(
            f"{recording.name}: holds no events, so there is nothing to reconstruct from; choose "
            "another recording"
        )


@dataclasses.dataclass(frozen=True, repr=False)
class Reference(Frames):
    """HDR reference images, float intensities that may exceed 1; the exposure is unknown.

    Attributes:
        timed: True if t is on the events' clock.
        clip: Intensities that the frames record from and to.
        white: Value of `images` that is intensity 1; then 0 marks pixels without reference. None
            means 1, and NaN marks them.
    """

    timed: bool
    clip: tuple[float, float]
    white: float | None = None

    def __post_init__(self):
        """Take the images as they are: `reference` checks them, with limits of their own."""

    def truth(self, row: int) -> NDArray[np.float64]:
        """Return one image (height, width) of intensity, NaN where there is no reference."""
        image = np.asarray(self.images[row], np.float64)
        return image if self.white is None else np.where(image == 0, np.nan, image / self.white)


def reference(recording: Recording) -> tuple[Recording, Reference]:
    """Return a recording and the HDR images in its `extra`, as this module describes them.

    Raises `InputError` for missing or unusable images and for missing events.
    """
    _need_events(recording)
    extra, name = recording.extra, recording.name
    size = (recording.height, recording.width)
    clip = np.asarray(extra.get("clip", (0.01, 1.0)))
    if clip.shape != (2,) or clip.dtype.kind not in "iuf" or not clip[0] < clip[1]:
        raise InputError(f"{name}: clip is {clip.tolist()}; store two intensities, low below high")
    if "hdr" in extra:
        images, what, white = extra["hdr"], "hdr", None
        if "hdr_t" not in extra:
            raise InputError(f"{name}: hdr has no times; add hdr_t, in us on the events' clock")
        t = np.atleast_1d(microseconds(extra["hdr_t"], f"{name}: hdr_t"))
        if t.ndim != 1 or (t[1:] <= t[:-1]).any():
            raise InputError(f"{name}: hdr_t is not sorted; sort hdr by time, each time once")
    elif "HDR_mat" in extra:
        images, what, frames = extra["HDR_mat"], "HDR_mat", recording.frames
        if frames is None:
            missing = recording.describe_left_out("frames")
            raise InputError(f"{name}: HDR_mat needs frames to tell its times{missing}; add frames")
        images, t = (images[None], frames.t[-1:]) if images.ndim == 2 else (images, frames.t)
        kind = frames.images.dtype
        white = 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)
    else:
        raise InputError(
            f"{name}: holds no HDR reference; add hdr (T, H, W) and hdr_t, or choose the protocol "
            "'held-out'"
        )
    if images.shape != (len(t), *size) or not len(t):
        raise InputError(
            f"{name}: {what} has the shape {images.shape}; its {len(t)} times and the sensor need "
            f"({len(t)}, {size[0]}, {size[1]})"
        )
    if images.dtype.kind != "f" and white is None:
        raise InputError(
            f"{name}: {what} is {images.dtype}; store floats of which 1 is the frames' white"
        )
    for row in range(len(images)):
        if (images[row] < 0).any() or np.isinf(images[row]).any():
            raise InputError(
                f"{name}: {what} image {row} holds negative or infinite values; store linear "
                "intensities, NaN where there is none"
            )
    bounds = (float(clip[0]), float(clip[1]))
    none = np.zeros(len(t), np.int64)
    return recording, Reference(t, images, none, what == "hdr", bounds, white)


PROTOCOLS: dict[str, Callable[..., tuple[Recording, Frames]]] = {
    "held-out": held_out,
    "reference": reference,
}


def divide(
    recording: Recording, protocol: str, gap: int = DEFAULT_GAP_FRAMES
) -> tuple[Recording, Frames]:
    """Apply a protocol to a recording.

    Args:
        recording: The recording.
        protocol: "held-out" or "reference".
        gap: Every `gap`-th frame is given, of the protocol "held-out".

    Returns:
        The recording to give to methods, and the true images to compare with.

    Raises:
        InputError: The recording cannot be used, the protocol is unknown, or the gap hides no
            frames.
    """
    check_choice(protocol, "protocol", PROTOCOLS)
    check_clocks(recording)
    if protocol == "held-out":
        return held_out(recording, gap)
    if gap != DEFAULT_GAP_FRAMES:
        raise InputError(f"the protocol {protocol!r} hides no frames; omit gap")
    return PROTOCOLS[protocol](recording)


def frame_times(frames: Frames, clock: Any) -> np.ndarray:
    """Return the times of frames on the events' clock.

    Args:
        frames: Frames or references; a `Reference` may be on that clock already.
        clock: An object with the attribute `clock_offset`, s.

    Returns:
        (frames,) times, us.
    """
    if isinstance(frames, Reference) and frames.timed:
        return frames.t
    return frames.t + round(float(clock.clock_offset) * 1e6)
