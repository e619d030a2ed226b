"""Images for the display, video files, and figures of matplotlib.

Tone mapping serves the display alone; stored intensities stay linear. Figures need neither a
display nor pyplot; notebooks show them.
"""

import contextlib
import errno
import functools
import io
import math
import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.output import complete, unwritable
from jaxevent.metrics import check_images

FILE_SIZE_SIGNAL = getattr(signal, "SIGXFSZ", None)  # ends a program whose file is too large
# Colours of lines and areas on white, and on a dark page. Any two differ by 30 and more in CIELAB,
# also to eyes that lack one kind of cone, and have a contrast of 3 or more to the page.
COLOURS = ("#0847d0", "#f06900", "#09a771", "#c364b7", "#6e2800", "#1d2329")
DARK_COLOURS = ("#29c7ff", "#b74505", "#498b69", "#a7479a", "#f1bc57", "#dde3e8")

Tone = Literal["linear", "log", "percentile", "clahe", "changes", "relative", "display"]
Kind = Literal["image", "error", "uncertainty"]

# The logarithm shows at most this many halvings below the brightest value (96 dB): pixels that are
# dark up to rounding, say 1e-9, would otherwise take most of the grey scale.
MAX_OCTAVES = 16
FADE_SPAN = 4.0  # standard deviations that the grey scale of "relative" has, or more
MIN_LOG_CHANGE = 0.01  # of ln(1 + I), a tenth of a threshold; smaller ones do not count for limits


def display_limits(
    images: ArrayLike, tone: str = "linear", variance: ArrayLike | None = None
) -> tuple[float, float]:
    """Compute the intensities shown as black and as white.

    "linear" has the limits 0 and 1, whatever the images. "display" has 0 and the value that 0.5 %
    exceed. The other tones leave out the darkest and
    the brightest 0.5 % of the values as outliers; "log" and "clahe" use positive values only.
    "changes" leaves out the largest 5 % of the values that differ from 0, and is symmetric about 0.
    "relative" leaves out 1 %, and has limits that are at least four standard deviations of most
    pixels apart, so that noise is not stretched to black and white. With the same limits for all
    frames of a video its brightness does not pump.

    Args:
        images: A sample (..., height, width) of the images, floats.
        tone: The tone.
        variance: Variances of the logarithms, of the images' shape; used by "relative" alone.

    Returns:
        Intensities of black and white, for `tone_map`.

    Raises:
        InputError: The tone is unknown, or the images are not floats or hold NaN.
    """
    images, logarithmic = _clip_infinite(images), _is_logarithmic(tone)
    if tone == "linear":
        return 0.0, 1.0
    if tone == "changes":
        size = np.abs(_to_tone_scale(images.astype(np.float64), tone))
        size = size[size > MIN_LOG_CHANGE]
        most = float(np.percentile(size, 95)) if len(size) else 1.0
        return math.expm1(-most), math.expm1(most)
    if tone == "display":
        return 0.0, _bright_level(images)
    values = images[images > 0] if logarithmic else images.ravel()
    if not len(values):
        return (2.0**-MAX_OCTAVES, 1.0) if logarithmic else (0.0, 1.0)
    rare = 1.0 if tone == "relative" else 0.5
    low, high = np.percentile(values.astype(np.float64), [rare, 100 - rare]).tolist()
    if logarithmic:
        low = max(low, high * 2.0**-MAX_OCTAVES)
        if tone == "relative" and np.isfinite(variance := _fill_unknown(variance, images)).any():
            apart = FADE_SPAN * math.sqrt(np.median(variance[np.isfinite(variance)]))
            more = math.exp(max(apart - math.log(high / low), 0.0) / 2)
            low, high = low / more, high * more
        return (low, high) if low < high else (low / 2, high * 2)
    return (low, high) if low < high else (low - 0.5, high + 0.5)


def tone_map(
    images: ArrayLike,
    tone: str = "linear",
    limits: tuple[float | int, float | int] | None = None,
    variance: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Convert images for the display.

    "linear" and "percentile" scale intensity, "log" its base-2 logarithm, from the limits to 0..255
    and clip values outside. "display" encodes intensity as screens expect it, by the curve of sRGB
    (IEC 61966-2-1). "changes" scales ln(1 + I), for images from events alone, whose
    intensity 0 is no change: grey. "relative" is "log" for images whose scale is not known, and
    fades what is uncertain towards middle grey: the distance of the logarithm from grey is divided
    by 1 + P / d^2, with P its variance and d a quarter of the grey scale. "clahe" equalises the
    histogram of the result of "log" in tiles of 1/8 of the image with limited contrast, each image
    by itself.

    Args:
        images: (..., height, width) linear intensity, floats.
        tone: The tone.
        limits: Intensities of black and white; by default `display_limits` of these images.
        variance: Variances of the logarithms, of the images' shape; used by "relative" alone.

    Returns:
        (..., height, width) uint8.

    Raises:
        InputError: The tone is unknown, the images are not floats or hold NaN, or the limits are
            out of order or, with a logarithm, not positive.
    """
    images, logarithmic = _clip_infinite(images), _is_logarithmic(tone)
    low, high = limits or display_limits(images, tone, variance)
    if not (-math.inf < low < high < math.inf) or (logarithmic and low <= 0):
        raise InputError(
            f"the display limits {low} and {high} do not suit the tone {tone!r}; give two finite"
            f"{' positive' if logarithmic else ''} intensities, black below white"
        )
    shown = _to_tone_scale(np.clip(images, low, high), tone)
    low, high = _to_tone_scale(np.array([low, high]), tone).tolist()
    shown = np.clip((shown - low) / (high - low), 0, 1)
    if tone == "relative":
        quarter = math.log(2) * (high - low) / FADE_SPAN
        shown = 0.5 + (shown - 0.5) / (1 + _fill_unknown(variance, images) / quarter**2)
    if tone == "clahe":
        shown = _equalise(shown)
    if tone == "display":
        shown = np.where(shown < 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    return np.rint(shown * 255).astype(np.uint8)


def _bright_level(images: NDArray[np.floating]) -> float:
    """Return the intensity that the brightest 0.5 % exceed, or 1 where that is black."""
    bright = float(np.percentile(images, 99.5)) if images.size else 0.0
    return bright if bright > 0 else 1.0


def _clip_infinite(images: ArrayLike) -> NDArray[np.floating]:
    """Clip infinite values, which a hot pixel's events add up to, to large ones."""
    images = np.asarray(images)
    if images.dtype.kind == "f":
        images = images.clip(-1e30, 1e30)
    return check_images(images, "images")


def _to_tone_scale(intensity: NDArray[np.floating], tone: str) -> NDArray[np.floating]:
    """Return the quantity that a tone shows linearly.

    Args:
        intensity: Intensity, of any shape.
        tone: Tone curve, as of `tone_map`.

    Returns:
        The quantity, of the same shape; with logarithmic tones in octaves.
    """
    if tone == "changes":
        return np.log1p(np.maximum(intensity, 2.0**-MAX_OCTAVES - 1))
    return np.log2(intensity) if _is_logarithmic(tone) else intensity


def _fill_unknown(variance: ArrayLike | None, images: NDArray) -> NDArray[np.floating]:
    """Put 0 in place of variances that are not estimated.

    Args:
        variance: Variance, (ln I)^2, that broadcasts with `images`; None: not estimated.
        images: (..., H, W) images.

    Returns:
        Variances of the shape of `images`.
    """
    given = np.asarray(np.nan if variance is None else variance, np.float64)
    return np.where(np.isnan(given), 0.0, np.broadcast_to(given, images.shape))


def _is_logarithmic(tone: str) -> bool:
    """Return whether a tone scales logarithms; raise `InputError` if it is unknown."""
    if tone not in get_args(Tone):
        raise InputError(f"there is no tone {tone!r}; choose one of {', '.join(get_args(Tone))}")
    return tone in ("log", "clahe", "relative")


def _equalise(images: NDArray[np.floating]) -> NDArray[np.floating]:
    """Equalise the histograms of images in tiles, with limited contrast."""
    from skimage.exposure import equalize_adapthist

    # A constant image has no contrast to equalise, and scikit-image turns it white.
    flat = images.reshape(-1, *images.shape[-2:])
    equal = [equalize_adapthist(one) if np.ptp(one) > 0 else one for one in flat]
    return np.asarray(equal).reshape(images.shape)


def write_png(path: str | Path, image: NDArray) -> None:
    """Write an image as a PNG file.

    Args:
        path: File that is written.
        image: uint8, grey (height, width) or colour (height, width, 3).

    Raises:
        InputError: The array is another one.
    """
    _check_displayable(path, image)
    with complete(Path(path)) as temporary:
        encode_png(temporary, image)


def encode_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image as a PNG file, in a folder that is not complete yet.

    Args:
        path: File that is written.
        image: uint8, grey (height, width) or colour (height, width, 3).
    """
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(image)).save(path, format="PNG")


@contextlib.contextmanager
def video_writer(
    path: str | Path, fps: float | int, preset: str = "veryfast"
) -> Iterator[Callable[[NDArray], None]]:
    """Open an MP4 file (H.264, yuv420p) for a function that appends frames to it.

        with video_writer("flight.mp4", fps=30) as write:
            for image in images:
                write(tone_map(image))

    Frames are uint8, grey (height, width) or colour (height, width, 3), all of one size; an odd
    size is padded to even, as the format demands, by repeating the last row or column. The file
    appears at the end, complete; an exception leaves none.

    Args:
        path: File that is written.
        fps: Frames per second.
        preset: x264's preset, which trades time for a smaller file.

    Yields:
        The function that appends a frame.

    Raises:
        InputError: The name ends otherwise, the extra "video" is missing, a frame is unfit, there
            is none, the file cannot be written, or encoding fails.
    """
    if Path(path).suffix.lower() != ".mp4":
        raise InputError(f"{path}: videos are stored as MP4; end the name in .mp4")
    program = require("imageio_ffmpeg", "video").get_ffmpeg_exe()
    if not 0 < fps < math.inf:
        raise InputError(f"{path}: {fps} frames per second are not possible; give a positive rate")
    shape: tuple[int, ...] = ()
    ffmpeg: subprocess.Popen[bytes] | None = None

    with complete(Path(path)) as temporary, tempfile.TemporaryFile() as log:

        def start() -> subprocess.Popen[bytes]:
            height, width = (size + size % 2 for size in shape[:2])
            pixels = "gray" if len(shape) == 2 else "rgb24"
            given = f"-f rawvideo -pix_fmt {pixels} -s {width}x{height} -r {fps} -i pipe:0"
            # Constant rate factor 16 is visually lossless; faststart puts the index first.
            wanted = f"-c:v libx264 -preset {preset} -crf 16 -pix_fmt yuv420p"
            wanted += " -movflags +faststart -f mp4"
            return subprocess.Popen(
                [program, "-y", "-v", "error", *given.split(), *wanted.split(), str(temporary)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )

        def failure(status: int) -> InputError:
            log.seek(0)
            output = " ".join(log.read().decode(errors="replace").split())
            for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                is_too_large = number == errno.EFBIG and -status == FILE_SIZE_SIGNAL
                if is_too_large or os.strerror(number) in output:
                    return unwritable(Path(path), OSError(number, os.strerror(number)))
            why = f" ({output[-300:]})" if output else ""
            return InputError(f"{path}: ffmpeg failed{why}; check the free space and the rate")

        def write(image: NDArray) -> None:
            nonlocal shape, ffmpeg
            _check_displayable(path, image)
            if ffmpeg is None:
                shape = image.shape
                ffmpeg = start()
            if image.shape != shape:
                raise InputError(
                    f"{path}: a frame has the shape {image.shape} after frames of {shape}; give "
                    "all frames of a video one size"
                )
            odd = [(0, size % 2) for size in shape[:2]] + [(0, 0)] * (len(shape) - 2)
            assert ffmpeg.stdin is not None
            try:
                ffmpeg.stdin.write(np.pad(image, odd, mode="edge").tobytes())
            except BrokenPipeError:
                raise failure(ffmpeg.wait()) from None

        try:
            yield write
            if ffmpeg is None:
                raise InputError(f"{path}: a video needs at least one frame; write one")
            ffmpeg.communicate()
            if ffmpeg.returncode:
                raise failure(ffmpeg.returncode)
        finally:
            if ffmpeg is not None:
                ffmpeg.kill()
                ffmpeg.communicate()


def _check_displayable(path: str | Path, image: NDArray) -> None:
    """Check that an array is a grey or colour image of uint8.

    Args:
        path: File that it is for.
        image: The array.

    Raises:
        InputError: It is none.
    """
    grey_or_colour = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not grey_or_colour or not image.size:
        raise InputError(
            f"{path}: cannot show an array of {image.dtype} and shape {image.shape}; give uint8 of "
            "(height, width) or (height, width, 3), as tone_map does"
        )


def new_figure(width: float | int = 7, height: float | int = 4) -> Any:
    """Make an empty figure that notebooks show.

    Args:
        width: Width, inches.
        height: Height, inches.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        InputError: The extra "plot" is missing.
    """
    require("matplotlib", "plot")
    return _figure_class()(figsize=(width, height), layout="constrained", dpi=120)


@functools.cache
def _figure_class() -> type:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        """A figure that notebooks show where it is the value of a cell."""

        def __init__(self, **options: Any):
            super().__init__(**options)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            held = io.BytesIO()
            self.savefig(held, format="png")
            return held.getvalue()

    return NotebookFigure


def save_figure(figure: Any, path: str | Path, dpi: int = 150) -> None:
    """Write a figure in the format of the path's suffix, complete or not at all.

    Args:
        figure: A figure of matplotlib.
        path: The file.
        dpi: Dots per inch, of images of pixels.

    Raises:
        InputError: matplotlib does not know the suffix.
    """
    path = Path(path)
    suffix = path.suffix.lstrip(".").lower()
    if suffix not in figure.canvas.get_supported_filetypes():
        raise InputError(
            f"{path}: a figure cannot be stored as {suffix or 'a file without suffix'}; "
            "end the name in .png, .pdf or .svg"
        )
    with complete(path) as temporary:
        figure.savefig(temporary, format=suffix, dpi=dpi)


def comparison_figure(
    path: str | Path, panels: Sequence[tuple[str, ArrayLike, str]], title: str = ""
) -> None:
    """Draw labelled arrays side by side, up to three in one row, more in two rows.

    An "image" is grey from 0; an "error" diverges from a white 0; an "uncertainty" runs from dark
    to bright. Panels of one kind share one scale, shown by colour bars, whose highest 0.5 % are cut
    off. Values that are not finite stay blank.

    Args:
        path: File that is written, PNG, PDF or SVG by its suffix.
        panels: Label, array (height, width) and kind of each panel.
        title: Title of the figure.

    Raises:
        InputError: The extra "plot" is missing, there is no panel, or a kind, an array or the
            suffix is not possible.
    """
    if not panels:
        raise InputError(f"{path}: a comparison needs at least one panel; give one")
    arrays: list[NDArray] = []
    for label, array, kind in panels:
        array = np.asarray(array)
        if array.ndim != 2 or not array.size or array.dtype.kind not in "fiub":
            raise InputError(
                f"{path}: the panel {label!r} is {array.dtype} of shape {array.shape}; give real "
                "numbers of shape (height, width)"
            )
        if kind not in get_args(Kind):
            raise InputError(
                f"{path}: the panel {label!r} has the unknown kind {kind!r}; choose one of "
                f"{', '.join(get_args(Kind))}"
            )
        arrays.append(np.where(np.isfinite(array), array, np.nan).astype(np.float64))

    styles = {kind: _style(kind, arrays, panels) for _, _, kind in panels}
    rows = 1 if len(panels) <= 3 else 2
    columns = math.ceil(len(panels) / rows)
    # Inches: a panel is 4 wide, of which a colour bar takes 0.75, and has its label above.
    width, bars = 4.0, any(kind != "image" for _, _, kind in panels)
    aspect = float(np.median([array.shape[0] / array.shape[1] for array in arrays]))
    height = (width - 0.75 * bars) * min(max(aspect, 1 / 3), 3.0) + 0.35
    figure = new_figure(columns * width, rows * height + 0.35 * bool(title))
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, (label, _, kind), array in zip(axes, panels, arrays, strict=False):
        shown = axis.imshow(array, **styles[kind])
        axis.set_title(label, fontsize=11)
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
        if kind != "image":
            place = axis.inset_axes((1.02, 0.0, 0.035, 1.0))
            beyond = "both" if kind == "error" else "max"
            bar = figure.colorbar(shown, cax=place, extend=beyond)
            bar.outline.set_visible(False)
            bar.ax.tick_params(labelsize=8, length=2)
    save_figure(figure, path)


def _style(kind: str, arrays: list[NDArray], panels: Sequence[tuple]) -> dict[str, Any]:
    """Return the colours and common scale of all panels of one kind, for `imshow`.

    Args:
        kind: Kind of the panels.
        arrays: Their arrays, (height, width) each.
        panels: Title, array and kind of each panel.

    Returns:
        Arguments of `imshow` by name.
    """
    same = [a.ravel() for a, panel in zip(arrays, panels, strict=True) if panel[2] == kind]
    values = np.concatenate(same)
    values = values[np.isfinite(values)]
    values = values if len(values) else np.zeros(1)
    if kind == "image":
        return {"cmap": "gray", "vmin": 0.0, "vmax": float(np.percentile(values, 99.9)) or 1.0}
    if kind == "error":
        top = float(np.percentile(np.abs(values), 99.5)) or 1.0
        return {"cmap": "RdBu_r", "vmin": -top, "vmax": top}
    low, top = float(values.min()), float(np.percentile(values, 99.5))
    return {"cmap": "viridis", "vmin": low, "vmax": top if top > low else low + 1.0}
