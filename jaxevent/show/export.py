"""Files of a reconstruction: HDF5 of exact values, a video, or a folder of images."""

import math
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import N_THREADS, map_ahead
from jaxevent.display import format_span
from jaxevent.errors import InputError, InputWarning
from jaxevent.io.output import CLOCK_UNIT, complete, complete_hdf5, deflate_shuffled
from jaxevent.progress import bar
from jaxevent.reconstruction.colour import apply_chrominance, chrominance, luminance
from jaxevent.reconstruction.video import N_BATCH_IMAGES, ImageSequence
from jaxevent.recording import Recording, Times, microseconds, one_time
from jaxevent.show.images import Tone, display_limits, encode_png, tone_map, video_writer

MAX_IMAGES = 10_000_000  # times of one command: 80 MB, a day of 100 per second


def image_times(
    recording: Recording,
    rate: float | int,
    start: float | int | None = None,
    stop: float | int | None = None,
) -> NDArray[np.int64]:
    """Return the times of evenly spaced images of a recording.

    Args:
        recording: The recording.
        rate: Times per second.
        start: First time, s; None for the recording's start.
        stop: Last time, s; None for the recording's stop.

    Returns:
        (T,) us, up to the recording's stop.

    Raises:
        InputError: The rate is not possible, or the times are too many.
    """
    if not 0 < rate <= 1e6:
        raise InputError(
            f"{recording.name}: cannot be read at --rate {rate:g}; give a number of images per "
            "second above 0, up to 1e6"
        )
    first = recording.start
    if start is not None:
        first = max(first, one_time(float(start), "--start"))
    last = recording.stop
    if stop is not None:
        last = min(last, one_time(float(stop), "--stop"))
    count = max(0, math.floor((last - first) * rate / 1e6 + 1e-9) + 1)
    if count > MAX_IMAGES:
        raise InputError(
            f"{recording.name}: from {format_span((first, last))} there are {count:,} times at a "
            f"rate of {rate:g} per second; give a part of it, --start and --stop, or a lower "
            "--rate; jaxevent info tells gaps and wrong clocks"
        )
    return first + np.rint(np.arange(count) * (1e6 / rate)).astype(np.int64)


def within(
    times: NDArray[np.int64], start: float | int | None, stop: float | int | None, name: str
) -> NDArray[np.int64]:
    """Choose the times from `start` to before `stop`.

    Args:
        times: (T,) us.
        start: First time, s; None for no bound.
        stop: End, s; None for no bound.
        name: Name of the recording, for the error.

    Raises:
        InputError: There are none.
    """
    first = -np.inf if start is None else one_time(float(start), "--start")
    end = np.inf if stop is None else one_time(float(stop), "--stop")
    chosen = times[(times >= first) & (times < end)]
    if not len(chosen):
        span = f"from {format_span(times)}" if len(times) else "none"
        bounds = (("from --start", start), ("to --stop", stop))
        limits = " ".join(f"{words} {float(s):g} s" for words, s in bounds if s is not None)
        raise InputError(
            f"{name}: there is no image {limits}; its times are {span}, so choose others"
        )
    return chosen


MAX_WHITE_SHARE = 0.01  # of the pixels at white, twice what "display" leaves out of the frames

# Chunks of one image, read by every HDF5 library; `deflate_shuffled` writes them faster than h5py.
_COMPRESSION_OPTIONS = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

Colours = Callable[[NDArray], NDArray] | None  # what `colour_video` returns; None: grey


class ExportOptions(NamedTuple):
    """Choices for a file of images.

    Args:
        tone: Tone of `tone_map`, of videos and PNG images.
        name: Name of the recording, which HDF5 files hold.
        colours: Function that makes colour images of times, `colour_video(video, recording)`;
            None: images are grey.
    """

    tone: str
    name: str
    colours: Colours = None


Writer = Callable[[ImageSequence, NDArray, Path, ExportOptions], str]


def writer(out: Path) -> Writer:
    """Return the function that writes a file of some suffix.

    It is called as `writer(out)(video, times, out, options)`, where `times` are sorted (us). It
    returns the end of a sentence about the file. HDF5 holds t, image, variance and valid, exact,
    or t and image (T, H, W, 3) in colour. Videos and PNG images are toned for the display.

    Raises:
        InputError: The suffix is not .h5, .hdf5, .mp4 or none.
    """
    if not out.name:
        raise InputError(f"{out}: is a folder in use; give the name of a new file or folder")
    kinds = {".h5": write_hdf5, ".hdf5": write_hdf5, ".mp4": _write_video, "": _write_images}
    if out.suffix.lower() not in kinds:
        raise InputError(
            f"{out}: images cannot be stored as {out.suffix}; end the name in .h5 or .mp4, or "
            "leave out the suffix for a folder of PNG images"
        )
    return kinds[out.suffix.lower()]


def save_video(
    video: ImageSequence, times: Times, path: str | Path, *, tone: Tone | None = None
) -> None:
    """Write images of a reconstruction to a file, as `jaxevent reconstruct` does.

        show.save_video(video, np.arange(1.0, 1.5, 0.01), "slow.mp4")

    Args:
        video: A reconstruction.
        times: Times of the images, integers in us or floats in s.
        path: An MP4 file, played at the rate of the times but at most at 60 images per second; a
            folder of PNG images; or an HDF5 file of exact images, variances and masks `valid`. It
            is replaced.
        tone: Tone of `jaxevent.show.images.tone_map` for MP4 and PNG. None: "display"; "relative"
            or "changes" where no frames tell the brightness.

    Raises:
        InputError: A time is outside the recording, there is none, the suffix is unknown, HDF5 is
            given a tone, or the extra "video" is missing.
    """
    out, wanted = Path(path), np.sort(np.atleast_1d(microseconds(times)))
    write, recording = writer(out), video.recording
    if not len(wanted):
        raise InputError(f"{out}: there are no times; give at least one")
    if tone is not None and write is write_hdf5:
        raise InputError(f"{out}: a tone is for images to look at; HDF5 holds linear intensity")
    shown = tone or default_tone(video.estimator.has_covariance, recording)
    write(video, wanted, out, ExportOptions(shown, recording.name))


def write_hdf5(video: ImageSequence, times: NDArray, out: Path, options: ExportOptions) -> str:
    """Write exact images as HDF5, see `writer`.

    Args:
        video: The images.
        times: (T,) us.
        out: File to write.
        options: Name of the recording, and colours; the tone plays no part.

    Returns:
        The end of a sentence about the file: "".

    Raises:
        InputError: No image holds a finite number.
    """
    colours = options.colours
    shape = (len(times), video.recording.height, video.recording.width)
    what = "linear intensity" if colours is None else "linear Rec. 709 red, green, blue"
    units = {"image": f"{what}: 0 is the frames' black, 1 their white"}
    if colours is None:
        units["variance"] = "(ln I)^2, of ln(intensity + I0); NaN: not estimated"
        units["valid"] = "whether the pixel rests on data"
    else:
        shape = (*shape, 3)
    kinds = {field: "?" if field == "valid" else "<f4" for field in units}
    with complete_hdf5(out, video.estimator.name, video.params) as (file, check):
        file.attrs["recording"] = options.name
        file["t"] = times.astype("i8")
        file["t"].attrs["unit"] = CLOCK_UNIT
        fields = {
            field: file.create_dataset(
                field, shape, kinds[field], chunks=(1, *shape[1:]), **_COMPRESSION_OPTIONS
            )
            for field in units
        }
        for field, unit in units.items():
            fields[field].attrs["unit"] = unit
        row, finite = 0, False
        with ThreadPoolExecutor(N_THREADS) as pool:
            waiting: list[tuple[h5py.Dataset, int, Future[bytes]]] = []
            # One batch is compressed while the next one is made.
            for batch, values in _batches(video, times, colours):
                jobs = [
                    (
                        fields[field],
                        row + n,
                        pool.submit(deflate_shuffled, np.asarray(image, kinds[field])),
                    )
                    for field, images in values.items()
                    for n, image in enumerate(images)
                ]
                _store(waiting)
                check()
                waiting = jobs
                finite = finite or bool(np.isfinite(values["image"]).any())
                row += len(batch)
            _store(waiting)
        if not finite:
            raise InputError(
                f"{out}: the images hold no finite number; choose other times or parameters"
            )
    return ""


def _store(compressed: list[tuple[h5py.Dataset, int, Future[bytes]]]) -> None:
    """Write compressed images to their rows of datasets."""
    for stored, row, job in compressed:
        stored.id.write_direct_chunk((row, *[0] * (len(stored.shape) - 1)), job.result())


def _write_video(video: ImageSequence, times: NDArray, out: Path, options: ExportOptions) -> str:
    """Write images for the display as MP4, see `writer`.

    Args:
        video: The images.
        times: (T,) us.
        out: File to write.
        options: Tone and colours; the recording's name plays no part.

    Returns:
        The end of a sentence about the file.
    """
    seconds = (times[-1] - times[0]) / 1e6
    rate = (len(times) - 1) / seconds if seconds > 0 else 25.0
    fps = min(rate, 60.0)
    range_used = RangeCounter(options.tone)
    with video_writer(out, fps) as write:
        for _, image in display_images(video, times, options.tone, options.colours):
            range_used.add(image)
            write(image)
    return f", played at {fps:.4g} per s, {fps / rate:.3g} of real time{range_used}"


def _write_images(video: ImageSequence, times: NDArray, out: Path, options: ExportOptions) -> str:
    """Write images for the display as PNG files, see `writer`.

    Args:
        video: The images.
        times: (T,) us.
        out: Folder to write.
        options: Tone and colours; the recording's name plays no part.

    Returns:
        The end of a sentence about the file.
    """
    range_used = RangeCounter(options.tone)
    with complete(out, directory=True) as partial:

        def counted() -> Iterator[tuple[int, tuple[int, NDArray[np.uint8]]]]:
            shown = display_images(video, times, options.tone, options.colours)
            for numbered in enumerate(shown):
                range_used.add(numbered[1][1])
                yield numbered

        def write(numbered: tuple[int, tuple[int, NDArray[np.uint8]]]) -> str:
            number, (at, image) = numbered
            file = f"frame_{number:08d}.png"
            encode_png(partial / file, image)
            return f"{at / 1e6:.6f} {file}\n"

        lines = list(map_ahead(write, counted()))  # compressed on all cores
        (partial / "images.txt").write_text("".join(lines))
    return str(range_used)


class RangeCounter:
    """Share of the pixels that a tone with fixed limits cuts off; `str` describes it."""

    def __init__(self, tone: str):
        self._counts = tone in ("display", "linear")
        self._white = self._pixels = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Count the values of an image."""
        if self._counts:
            self._white += int(np.count_nonzero(image == 255))
            self._pixels += image.size

    def __str__(self) -> str:
        share = self._white / max(self._pixels, 1)
        if share <= MAX_WHITE_SHARE:
            return ""
        return (
            f", {100 * share:.2g} % of the pixels at white or cut off there (--tone log shows all)"
        )


def default_tone(has_variance: bool, recording: Recording) -> str:
    """Return the tone that shows a method's images of a recording best.

    Args:
        has_variance: Whether the method estimates a variance.
        recording: The recording.

    Returns:
        A tone of `tone_map`.
    """
    if recording.frames is not None:
        return "display"
    return "relative" if has_variance else "changes"


def display_images(
    video: ImageSequence, times: NDArray, tone: str, colours: Colours = None
) -> Iterator[tuple[int, NDArray]]:
    """Yield each time (us) and its image for the display, with limits common to all.

    Those of the tone "display" are the frames', where there are frames. A colour image is its
    toned luminance with its former chrominance.

    Args:
        video: A reconstruction.
        times: (T,) sorted times, us.
        tone: Tone of `tone_map`.
        colours: Function from times to colour images; None for grey images.
    """
    frames = video.recording.frames
    if tone == "linear":
        limits = (0.0, 1.0)
    elif tone == "display" and frames is not None and len(frames):
        linear = video.recording.linear_frames
        seen = [linear[row : row + 1].intensity for row in _spaced_rows(len(frames))]
        limits = display_limits(np.concatenate(seen), tone)
    else:
        sample = video(times[_spaced_rows(len(times))])
        limits = display_limits(sample.mean, tone, sample.covariance)
    for batch, values in _batches(video, times, colours):
        images = values["image"]
        if colours is None:
            shown = tone_map(images, tone, limits, variance=values["variance"])
        else:
            # Infinite intensity (`tone_map`) times a chrominance of 0 is NaN.
            images = np.nan_to_num(images, nan=1e30, posinf=1e30)
            toned = tone_map(luminance(images), tone, limits).astype(np.float32)
            shown = apply_chrominance(toned, chrominance(images, white=np.inf))
            shown = np.rint(shown.clip(0, 255)).astype(np.uint8)
        for at, image in zip(batch, shown, strict=True):
            yield int(at), image


def _spaced_rows(count: int) -> NDArray[np.int64]:
    """Return at most 16 evenly spaced rows of `count`."""
    return np.unique(np.linspace(0, count - 1, 16).round().astype(np.int64))


def _batches(
    video: ImageSequence, times: NDArray, colours: Colours
) -> Iterator[tuple[NDArray, dict[str, NDArray]]]:
    """Read images in batches.

    Args:
        video: The images.
        times: (T,) us.
        colours: Function that makes colour images of times; None: images are grey.

    Yields:
        Times of a batch, us, and arrays (times, H, W[, 3]) by their names in HDF5. An
        `InputWarning` tells at the end that grey images are valid nowhere.
    """
    if colours is None:
        is_valid = False
        for batch, estimate in video.batches(times):
            is_valid = is_valid or bool(np.any(estimate.valid))
            yield (
                batch,
                {
                    "image": estimate.mean,
                    "variance": estimate.covariance,
                    "valid": estimate.valid,
                },
            )
        if not is_valid:
            warnings.warn(
                f"{video.recording.name}: no pixel of the images rests on data, they show what is "
                "assumed without any; choose other times, or see jaxevent info",
                InputWarning,
                stacklevel=2,
            )
        return
    rows = range(0, len(times), N_BATCH_IMAGES)
    for row in bar(rows, desc="images", unit="batch", progress=video.progress):
        batch = times[row : row + N_BATCH_IMAGES]
        with np.errstate(invalid="ignore"):  # infinity times 0
            image = colours(batch)
        yield batch, {"image": image}
