"""Recordings of ordinary video: artificial HDR data as in the AKF paper's supplement, 4.2."""

import dataclasses
import functools
import math
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from PIL import Image

from jaxevent.camera import Response, SCurve, Values
from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError, require
from jaxevent.recording import Recording
from jaxevent.simulate.hybrid import Sensor, expose, frame_times, simulate

_MAX_PIXELS = 200_000_000  # of all frames; 7 bytes each
_FOLDER_RATE_HZ = 30.0  # of a folder of images
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm")

_LEVEL = np.arange(256) / 255
# IEC 61966-2-1 (sRGB) to linear light; ITU-R BT.709 luminance.
_LINEAR = np.where(_LEVEL <= 0.04045, _LEVEL / 12.92, ((_LEVEL + 0.055) / 1.055) ** 2.4)
_REC709 = np.array([0.2126, 0.7152, 0.0722])


class _CroppedResponse(Response):
    """An S-curve over intensities from `dark` to 1 instead of from 0 to 1."""

    curve: SCurve
    dark: float

    def grey(self, intensity: Values) -> Float[Array, "..."]:
        return self.curve.grey((intensity - self.dark) / (1 - self.dark))

    def intensity(self, grey: Values) -> Float[Array, "..."]:
        return self.dark + (1 - self.dark) * self.curve.intensity(grey)

    def certainty(self, grey: Values) -> Float[Array, "..."]:
        return self.curve.certainty(grey)


@dataclasses.dataclass(frozen=True)
class VideoClip:
    """Video frames as an `IntensitySource`; light changes linearly from each frame to the next.

    Objects fade between frames rather than move, so video of motion above a pixel or two per frame
    needs a higher rate. Darkness is half the light of level 1, never 0.
    """

    images: NDArray[np.uint8]  # (frames, height, width, 3), sRGB
    rate: float | int  # frames per second
    white: float | int = 1.0  # linear light, of the video's 1, that is intensity 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.images.shape[2], self.images.shape[1]

    @property
    def duration(self) -> float:
        """Length, s."""
        return (len(self.images) - 1) / self.rate

    def intensity(self, t: float | int) -> NDArray[np.float64]:
        """Return the luminance (height, width) at t seconds."""
        k, u = self._locate_frame(t)
        return (1 - u) * self._luminance[k].astype(float) + u * self._luminance[k + 1]

    def colour(self, t: float | int) -> NDArray[np.float64]:
        """Return the intensity of red, green and blue, (height, width, 3), at t seconds."""
        k, u = self._locate_frame(t)
        light = (1 - u) * _LINEAR[self.images[k]] + u * _LINEAR[self.images[k + 1]]
        return light / self.white

    def _locate_frame(self, t: float | int) -> tuple[int, float]:
        k = min(max(math.floor(t * self.rate), 0), len(self.images) - 2)
        return k, min(max(t * self.rate - k, 0.0), 1.0)

    @functools.cached_property
    def _luminance(self) -> NDArray[np.float32]:
        light = np.empty(self.images.shape[:3], np.float32)
        for image, out in zip(self.images, light, strict=True):
            out[:] = np.maximum(_LINEAR[image] @ _REC709, _LINEAR[1] / 2) / self.white
        return light


def from_video(
    path: str | os.PathLike[str],
    sensor: Sensor | None = None,
    *,
    cut: float | int = 50,
    speed: float | int = 1.0,
    max_size: int = 346,
    rate: float | int | None = None,
    start: float | int = 0.0,
    stop: float | int | None = None,
    seed: int = 0,
) -> Recording:
    """Record a video with a simulated sensor of low dynamic range; the video is the HDR truth.

    The sRGB video is made linear, and its Rec. 709 luminance is recorded by a camera that crops: it
    resolves the levels from `cut` to 255 - `cut` of linear light (the paper's data use 30, 50, 80,
    100 and 115). Intensity stays proportional to light, as events need it: 1 is the level
    255 - `cut`. Light below cut / (255 - cut) or above 1 is cropped. Beside the arrays of
    `simulate`, `extra` holds

    - rgb (frames, H, W, 3) uint8: each frame in colour, of the same camera;
    - cut, and white: the linear light, of the video's 1, that is intensity 1.

    Args:
        path: A video that ffmpeg reads (extra "video"), or a folder of images, in the order of
            their names with numbers counted as numbers.
        sensor: Its settings, with `response` None; default `Sensor()`.
        cut: Levels cropped at either end, 0 to 127.
        speed: Plays the video faster (> 1) or slower (< 1).
        max_size: Longer side (pixels) to which larger videos are scaled down.
        rate: Frames per second, before `speed`; None: as in the file, 30 for a folder.
        start: First second of the video used.
        stop: Last second used; None for its end.
        seed: Seed of all noise.

    Returns:
        The recording.

    Raises:
        InputError: The file is missing, no video or too long, holds fewer than two frames in the
            chosen part, or a setting is not possible.
    """
    path = Path(path)
    sensor = Sensor() if sensor is None else sensor
    if sensor.response is not None:
        raise InputError("a sensor for video has its response from cut; leave response out")
    for name, value in (("speed", speed), ("rate", 1.0 if rate is None else rate)):
        if not 0 < value < math.inf:
            raise InputError(f"{path}: {name} = {value} is not possible; give a positive number")
    if not 0 <= start < (math.inf if stop is None else stop):
        raise InputError(f"{path}: from second {start} to {stop} is nothing; give start < stop")
    if max_size < 16:
        raise InputError(f"{path}: max_size = {max_size} is too small; give 16 pixels or more")
    curve = SCurve(cut)
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; correct the path")
    read = _read_folder if path.is_dir() else _read_video
    images, found = read(path, max_size, rate, start, stop)
    clip = VideoClip(images, found * speed, (255 - cut) / 255)
    sensor = dataclasses.replace(sensor, response=_CroppedResponse(curve, cut / (255 - cut)))
    recording = simulate(clip, sensor, seed, path.stem)
    stamps = frame_times(clip.duration, sensor)
    noise = np.random.default_rng([seed, 1])
    rgb, _ = expose(clip.colour, stamps, sensor, noise, recording.extra["gain"])
    scalars = {"cut": np.asarray(float(cut)), "white": np.asarray(clip.white)}
    return dataclasses.replace(recording, extra={**recording.extra, "rgb": rgb, **scalars})


def _stack(path: Path, images: Iterator[Image.Image], max_size: int) -> NDArray[np.uint8]:
    """Stack images of one size, (frames, height, width, 3), scaled down to `max_size`."""
    frames, given = [], None
    for image in images:
        if given not in (None, image.size):
            raise InputError(
                f"{path}: image {len(frames)} is {image.width}x{image.height} after images of "
                f"{given[0]}x{given[1]}; give all images one size"
            )
        given = image.size
        shrink = min(1, max_size / max(given))
        size = max(1, round(given[0] * shrink)), max(1, round(given[1] * shrink))
        if (len(frames) + 1) * size[0] * size[1] > _MAX_PIXELS:
            raise InputError(
                f"{path}: is too long, over {len(frames)} frames of {size[0]}x{size[1]}; choose a "
                "part with start and stop, or a smaller max_size"
            )
        scaled = image if size == given else image.resize(size, Image.Resampling.BOX)
        frames.append(np.asarray(scaled.convert("RGB")))
    if len(frames) < 2:
        raise InputError(
            f"{path}: number of frames in the chosen part is {len(frames)}; at least 2 are needed"
        )
    return np.stack(frames)


def _read_video(
    path: Path,
    max_size: int,
    rate: float | int | None,
    start: float | int,
    stop: float | int | None,
) -> tuple[NDArray[np.uint8], float]:
    """Read a video by ffmpeg.

    Args:
        path: The file.
        max_size: Longer side to which larger frames are scaled down, px.
        rate: Frames per second; None: as the file states.
        start: First second.
        stop: Second at which to stop; None: the end.

    Returns:
        (frames, height, width, 3), and frames per second.

    Raises:
        InputError: ffmpeg cannot read the file, it states no rate, or it is too long.
    """
    program = require("imageio_ffmpeg", "video").get_ffmpeg_exe()
    # PPM images have their size after rotation, the log has the rate. -t is the input's time.
    part = ["-ss", str(start)] + ([] if stop is None else ["-t", str(stop - start)])
    wanted = "-map 0:v:0 -f image2pipe -c:v ppm -pix_fmt rgb24 pipe:1".split()
    command = [program, "-nostdin", "-hide_banner", "-nostats", *part, "-i", path.absolute()]
    with tempfile.TemporaryFile() as log:
        ffmpeg = subprocess.Popen([*command, *wanted], stdout=subprocess.PIPE, stderr=log)
        try:
            assert ffmpeg.stdout is not None
            images = _stack(path, _portable_pixmaps(ffmpeg.stdout), max_size)
        except InputError as error:
            ffmpeg.kill()
            log.seek(0)
            if b"Output #0" in log.read():
                raise
            raise InputError(
                f"{path}: is not a video that ffmpeg can read; give a video or a folder of images"
            ) from error
        finally:
            ffmpeg.kill()
            ffmpeg.communicate()
        log.seek(0)
        rates = re.search(r"Output #0.*?Video:.*?([\d.]+) fps", log.read().decode("latin1"), re.S)
    if rate is None and rates is None:
        raise InputError(f"{path}: has no number of frames per second; give rate")
    return images, float(rates[1] if rate is None and rates else rate or 0)


def _portable_pixmaps(stream: IO[bytes]) -> Iterator[Image.Image]:
    """Yield binary PPM images of 8 bit."""
    while stream.readline() == b"P6\n":
        width, height = (int(number) for number in stream.readline().split())
        stream.readline()
        pixels = stream.read(3 * width * height)
        if len(pixels) == 3 * width * height:
            yield Image.frombytes("RGB", (width, height), pixels)


def _read_folder(
    path: Path,
    max_size: int,
    rate: float | int | None,
    start: float | int,
    stop: float | int | None,
) -> tuple[NDArray[np.uint8], float]:
    """Read a folder of images as `_read_video` reads a video.

    Args:
        path: The folder.
        max_size: Longest side of the images, px; larger ones are reduced.
        rate: Images per second; None: the default for folders.
        start: Time of the first image, s after that of the folder.
        stop: Time after the last image, s, likewise; None: the end.

    Returns:
        (images, height, width) or in colour, and images per second.
    """
    found = float(_FOLDER_RATE_HZ if rate is None else rate)

    def order(file: Path) -> list[str | int]:
        parts = re.split(r"(\d+)", file.name)
        return [int(part) if k % 2 else part for k, part in enumerate(parts)]

    files = sorted((f for f in path.iterdir() if f.suffix.lower() in _SUFFIXES), key=order)
    last = None if stop is None else math.ceil(stop * found)

    def read() -> Iterator[Image.Image]:
        for file in files[math.ceil(start * found) : last]:
            try:
                with Image.open(file) as image:
                    yield image.convert("RGB")
            except OSError as error:
                raise InputError(f"{file}: is not a readable image; remove it") from error

    return _stack(path, read(), max_size), found


__getattr__ = renamed_names(__name__)
