"""Colour: chrominance of colour frames on reconstructed luminance, and colour event cameras.

Colours are linear Rec. 709 red, green and blue, in this order, on the last axis. Two cameras: a
grey event camera whose frames were also taken in colour (`Recording.extra["rgb"]`), whose
reconstruction gets the frames' chrominance (AKF paper, appendix 3), and a camera with a Bayer
pattern over events and frames, each colour of which is reconstructed on its own:

    parts = split_channels(recording)
    videos = {name: akf.estimate(part, params) for name, part in parts.items()}
    image = join_channels({name: video(times).mean for name, video in videos.items()})
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError
from jaxevent.io.images import bayer_sites, demosaic
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Events, Frames, Recording, Times, check_recording, microseconds

REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)  # luminance of linear red, green and blue; the sum is 1
_HIDDEN = 1e-3  # what a frame counts where it does not show a point, so that something does
_SHOULDER = 0.02  # of white: colours fade to grey over the last 2 % below it


def luminance(rgb: ArrayLike) -> NDArray[np.floating]:
    """Return the luminance (...) of linear colours (..., 3), Rec. 709: white (1, 1, 1) has 1.

    Raises:
        InputError: Colours are not floats of three channels.
    """
    colours = _check_colours(rgb)
    return np.asarray(colours @ np.asarray(REC709_LUMINANCE, colours.dtype))


def chrominance(
    rgb: ArrayLike, *, black: float | int = 0.0, white: float | int = 1.0
) -> NDArray[np.floating]:
    """Divide colours by their luminance, so that the result has luminance 1; grey is (1, 1, 1).

    A channel that reads `white` is clipped and the ratio means nothing: over the last 2 % below
    white the colour fades to grey. It also fades where the brightest channel is between `black` and
    0 and noise makes the ratio. Luminance 0 is grey in any case.

    Args:
        rgb: (..., 3) linear colours.
        black: Intensity below which colours fade.
        white: Intensity at which channels clip; `np.inf` for colours that are nowhere clipped.

    Returns:
        (..., 3).

    Raises:
        InputError: Colours are not floats of three channels.
    """
    colours = _check_colours(rgb)
    y = luminance(colours)[..., None]
    light = y > 0
    ratio = np.where(light, colours / np.where(light, y, 1), 1)
    brightest = colours.max(-1, keepdims=True)
    trust = np.clip((1 - brightest / white) / _SHOULDER, 0, 1)
    if black > 0:
        trust = trust * np.clip(brightest / black, 0, 1)
    return (1 + trust * (ratio - 1)).astype(colours.dtype)


def apply_chrominance(luminance: ArrayLike, chroma: ArrayLike) -> NDArray[np.floating]:
    """Return linear colours of a luminance and a chrominance.

    Hue and saturation are those of the chrominance at every luminance.

    Args:
        luminance: (...), of any range.
        chroma: (..., 3).

    Returns:
        (..., 3).

    Raises:
        InputError: The shapes do not fit together.
    """
    y, ratio = np.asarray(luminance), _check_colours(chroma)
    try:
        return y[..., None] * ratio
    except ValueError as error:
        raise InputError(
            f"a luminance of shape {y.shape} needs a chrominance of shape {(*y.shape, 3)}, not "
            f"{ratio.shape}"
        ) from error


def _check_colours(rgb: ArrayLike) -> NDArray[np.floating]:
    """Return colours as an array; raise `InputError` unless they are floats of three channels."""
    colours = np.asarray(rgb)
    if colours.dtype.kind != "f" or colours.shape[-1:] != (3,):
        raise InputError(
            f"colours of shape {colours.shape} and type {colours.dtype} cannot be used; give "
            "linear floats (..., 3)"
        )
    return colours


def colour_video(
    video: ImageSequence[Any], recording: Recording
) -> Callable[..., NDArray[np.floating]]:
    """Make a reconstruction in the colours of `recording.extra["rgb"]`: `colour_video(...)(times)`.

    The video's image is the luminance. The chrominance is that of the frames before and after,
    linear between them and constant outside. Where the video knows how points move (`mc`),
    chrominance is that of the points, and a frame that does not show a point does not count.

    Args:
        video: Images of the recording.
        recording: The recording with `extra["rgb"]`, (frames, H, W, 3) uint8: the colours of each
            of
            its frames, on the same camera response.

    Returns:
        A function of times, as `video` takes them, that returns linear colours (T, H, W, 3).

    Raises:
        InputError: There are no colour frames, or their number, size or type differs.
    """
    name, frames, rgb = recording.name, recording.frames, recording.extra.get("rgb")
    if frames is None or rgb is None:
        missing = "no colour frames"
        if frames is None:
            missing = f"no frames{recording.describe_left_out('frames')}"
        raise InputError(f"{name}: holds {missing}; add extra['rgb'] of its frames in colour")
    wanted = (len(frames), recording.height, recording.width, 3)
    if rgb.shape != wanted or rgb.dtype != np.uint8:
        raise InputError(
            f"{name}: extra['rgb'] is {rgb.shape} {rgb.dtype}; {len(frames)} frames need {wanted} "
            "uint8, so where frames are left out leave out the same of rgb"
        )
    own = video.recording
    if (own.width, own.height) != (recording.width, recording.height):
        raise InputError(
            f"{name}: its colours are {recording.width}x{recording.height}, the video "
            f"{own.width}x{own.height}; give the recording that was reconstructed"
        )
    table = np.asarray(recording.response.intensity(np.arange(256) / 255), np.float32)
    # Grey values within 3 of an end may be clipped ones that noise moved.
    black, white = float(table[3]), float(table[252])
    frame_t = frames.t + round(float(video.params.clock_offset) * 1e6)

    @functools.lru_cache(maxsize=4)
    def chroma(frame: int) -> NDArray[np.floating]:
        colours = np.asarray(rgb[frame : frame + 1])[0]  # of a file, perhaps
        return chrominance(table[colours], black=black, white=white)

    def mixed(t: int) -> NDArray[np.floating]:
        place = float(np.interp(t, frame_t, np.arange(len(frame_t))))
        before = int(place)
        after, share = min(before + 1, len(frame_t) - 1), place - before
        pair = np.stack([chroma(before), chroma(after)])
        seen, shown = video.carry(pair, frame_t[[before, after]], t)
        weight = np.array([1 - share, share], seen.dtype)[:, None, None] * (shown + _HIDDEN)
        return (weight[..., None] * seen).sum(0) / weight.sum(0)[..., None]

    def colours(times: Times, extrapolate: bool = False) -> NDArray[np.floating]:
        t = np.atleast_1d(microseconds(times))
        order = np.argsort(t, kind="stable")
        out = np.empty((len(t), *wanted[1:]), video.dtype)
        done = 0
        for batch, images in video.batches(t[order], extrapolate):
            for row, time, image in zip(order[done:], batch.tolist(), images.mean, strict=False):
                out[row] = apply_chrominance(image, mixed(time))
            done += len(batch)
        return out

    return colours


def split_channels(recording: Recording, pattern: str = "RGGB") -> dict[str, Recording]:
    """Split a recording into the recordings R, G1, G2 and B of a Bayer pattern.

    Each is of half the size. Events and frames of a channel are those of its sites. Its pinhole
    camera has half the focal lengths and its centre at the sites. Arrays of `extra` whose last two
    axes are the sensor's are subsampled as frames are, `rgb` is left out, others are kept.

    Args:
        recording: The recording.
        pattern: Colours of the upper left 2 x 2 pixels, row by row.

    Returns:
        The recordings by name of the channel.

    Raises:
        InputError: The pattern is unknown, or the width or height is odd.
    """
    check_recording(recording, "split_channels")
    places = bayer_sites(pattern)
    if recording.width % 2 or recording.height % 2:
        raise InputError(
            f"{recording.name}: the {recording.width}x{recording.height} sensor has an odd side, "
            "which a 2x2 colour pattern does not fill; crop the recording to an even size"
        )
    events = recording.events[: len(recording.events)]
    return {name: _channel(recording, events, name, *site) for name, site in places.items()}


def _channel(recording: Recording, events: Events, name: str, row: int, column: int) -> Recording:
    here = (events.y % 2 == row) & (events.x % 2 == column)
    own = Events(events.t[here], events.x[here] // 2, events.y[here] // 2, events.p[here])

    def sampled(images: NDArray) -> NDArray:
        return np.ascontiguousarray(images[..., row::2, column::2])

    frames, pinhole = recording.frames, recording.camera
    if frames is not None:
        frames = Frames(frames.t, sampled(np.asarray(frames.images)), frames.exposure)
    if pinhole is not None:
        # Pixel i of the channel is pixel 2 i + column of the sensor, both counted at their centres.
        pinhole = dataclasses.replace(
            pinhole,
            fx=pinhole.fx / 2,
            fy=pinhole.fy / 2,
            cx=(pinhole.cx - column) / 2,
            cy=(pinhole.cy - row) / 2,
        )
    size = (recording.height, recording.width)
    extra = {
        key: sampled(value) if np.shape(value)[-2:] == size else value
        for key, value in recording.extra.items()
        if key != "rgb"
    }
    return dataclasses.replace(
        recording,
        name=f"{recording.name} {name}",
        width=recording.width // 2,
        height=recording.height // 2,
        events=own,
        frames=frames,
        camera=pinhole,
        extra=extra,
    )


def join_channels(images: Mapping[str, NDArray], pattern: str = "RGGB") -> NDArray[np.floating]:
    """Join images of the channels R, G1, G2 and B to colour images.

    Bilinear demosaicing: a channel keeps its values at its sites. Elsewhere it is the mean of its 2
    or 4 nearest sites, at the border of fewer.

    Args:
        images: (T, h, w) images by name of the channel.
        pattern: Colours of the upper left 2 x 2 pixels, row by row.

    Returns:
        (T, 2 h, 2 w, 3).

    Raises:
        InputError: The pattern is unknown, a channel is missing, or shapes differ.
    """
    places = bayer_sites(pattern)
    missing = [name for name in places if name not in images]
    if missing:
        raise InputError(f"the channel {missing[0]} is missing; give R, G1, G2 and B")
    channels = {name: np.asarray(images[name]) for name in places}
    shapes = [channel.shape for channel in channels.values()]
    if len(set(shapes)) > 1 or len(shapes[0]) != 3:
        raise InputError(f"the channels have shapes {shapes}; give all as (times, height, width)")
    count, height, width = shapes[0]
    mosaic = np.empty((count, 2 * height, 2 * width), np.result_type(*channels.values()))
    for name, (row, column) in places.items():
        mosaic[:, row::2, column::2] = channels[name]
    return demosaic(mosaic, pattern)
