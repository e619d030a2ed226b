"""Pictures and videos of tracks: ellipses and trails over events.

Arrays as in `jaxevent.show.track_tables`.
"""

import colorsys
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from jaxevent.errors import InputError
from jaxevent.recording import Recording, Times, microseconds
from jaxevent.show.report import video_writer
from jaxevent.show.track_tables import check_tracks

_DARK, _ON, _OFF = (24, 24, 28), (235, 235, 235), (110, 130, 190)  # background and events
_LOW = 480  # rows; smaller sensors are enlarged, so that lines and numbers can be seen


def track_frames(
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    valid: ArrayLike,
    *,
    images: Iterable[NDArray] | None = None,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """Pictures (scale height, scale width, 3) at sorted times, of the tracks alive at each.

    A track is the ellipse of `sigmas` standard deviations, its id, and the way it went in the last
    `trail` seconds, in a colour of its own. Behind are the events of the last `window` seconds
    (default: since the time before), ON white and OFF blue, or `images`: as many uint8 images of
    the sensor's size, grey or colour. `scale` (default: 1, or more for sensors of fewer than 480
    rows) enlarges. Raises `InputError` for arrays that do not fit each other or the sensor.
    """
    t, number, mean, _, valid = check_tracks(recording.name, times, ids, mean, None, valid)
    if (np.diff(t) < 0).any():
        raise InputError(f"{recording.name}: the times of a video are not sorted; sort them")
    states = zip(mean, valid & np.isfinite(mean).all(-1), strict=True)
    yield from draw_frames(recording, t, number, states, images, sigmas, trail, window, scale)


def draw_frames(
    recording: Recording,
    t: NDArray[np.int64],
    number: NDArray,
    states: Iterable[tuple[NDArray, NDArray]],
    images: Iterable[NDArray] | None,
    sigmas: float | int = 2.0,
    trail: float | int = 0.3,
    window: float | int | None = None,
    scale: int | None = None,
) -> Iterator[NDArray[np.uint8]]:
    """The same of states (tracks, 8), and which of them are valid, which come one by one."""
    if scale is None:
        scale = max(1, math.ceil(_LOW / recording.height))
    if window is None:
        window = float(np.median(np.diff(t))) * 1e-6 if len(t) > 1 else 0.01
    events = _event_images(recording, t, round(window * 1e6)) if images is None else images
    colours = [track_colour(int(n)) for n in number]
    behind, font = iter(events), ImageFont.load_default(14)
    ways: dict[int, list[tuple[int, NDArray]]] = {}  # of the tracks alive: times and places
    for k, (now, (mean, valid)) in enumerate(zip(t.tolist(), states, strict=True)):
        image = next(behind, None)
        size = (recording.height, recording.width)
        if image is None or image.shape[:2] != size or image.dtype != np.uint8:
            found = "none" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(
                f"{recording.name}: image {k} of {len(t)} behind the tracks is {found}; give uint8 "
                f"of {size}, grey or colour, for each time"
            )
        large = Image.fromarray(image).convert("RGB")
        if scale > 1:
            wide, high = (scale * side for side in large.size)
            large = large.resize((wide, high), Image.Resampling.NEAREST)
        draw = ImageDraw.Draw(large)
        first = now - round(trail * 1e6)
        ways = {int(i): ways.get(int(i), []) for i in np.flatnonzero(valid)}
        for i, way in ways.items():
            way.append((now, mean[i, :2]))
            while way[0][0] < first:
                way.pop(0)
            _line(draw, np.stack([place for _, place in way]), colours[i], scale, 1)
            ellipse = outline(mean[i], sigmas)
            _line(draw, ellipse, colours[i], scale, 2)
            x, y = _large(np.array([ellipse[:, 0].max(), ellipse[:, 1].min()]), scale)
            draw.text((x, y), str(number[i]), fill=colours[i], font=font, anchor="ls")
        yield np.asarray(large)


def write_track_video(
    path: str | Path,
    recording: Recording,
    times: Times,
    ids: ArrayLike,
    mean: ArrayLike,
    valid: ArrayLike,
    *,
    fps: float | int | None = None,
    **settings,
) -> None:
    """Write the pictures of `track_frames`, which has the further settings, as an MP4 file.

    By default it plays in real time, but at most at 60 pictures per second. Raises `InputError` as
    `track_frames` and without the extra "video".
    """
    t = np.atleast_1d(microseconds(times))
    if fps is None:
        span = int(t[-1] - t[0]) if len(t) else 0
        fps = min((len(t) - 1) / (span * 1e-6), 60.0) if span > 0 else 25.0
    with video_writer(path, fps) as write:
        for image in track_frames(recording, t, ids, mean, valid, **settings):
            write(image)


def track_colour(number: int, dark: bool = False) -> tuple[int, int, int]:
    """Red, green and blue (0 to 255) of a track; neighbouring ids differ."""
    hue = (0.07 + number * 0.618034) % 1
    r, g, b = colorsys.hsv_to_rgb(hue, 0.9 if dark else 0.65, 0.75 if dark else 1.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _event_images(
    recording: Recording, times: NDArray[np.int64], window: int
) -> Iterator[NDArray[np.uint8]]:
    """The events of (t - window, t], the last one of a pixel on top."""
    for t in times:
        image = np.full((recording.height, recording.width, 3), _DARK, np.uint8)
        first, last = (recording.events.index(int(at)) for at in (t - window + 1, t + 1))
        part = recording.events[first:last]
        image[part.y, part.x] = np.where(part.p[:, None], _ON, _OFF)
        yield image


def outline(state: NDArray, sigmas: float | int) -> NDArray[np.float64]:
    """Points (49, 2) of the closed ellipse of `sigmas` standard deviations of a state (8,), px."""
    angle = np.linspace(0, 2 * np.pi, 49)
    u, v = sigmas * state[4] * np.cos(angle), sigmas * state[5] * np.sin(angle)
    c, s = np.cos(state[6]), np.sin(state[6])
    return np.stack([state[0] + c * u - s * v, state[1] + s * u + c * v], 1)


def _large(points: NDArray, scale: int) -> tuple[float, ...]:
    """Places in an enlarged image, x and y by turns; pixel centres stay whole for scale 1."""
    return tuple(((points + 0.5) * scale - 0.5).clip(-1e5, 1e5).ravel().tolist())


def _line(draw, points: NDArray, colour: tuple[int, int, int], scale: int, width: int) -> None:
    if len(points) > 1:
        draw.line(_large(points, scale), fill=colour, width=width)
