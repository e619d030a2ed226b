"""What people look at: display images, video files, comparison figures and result tables.

Tone mapping serves the display alone; stored intensities stay linear.
"""

import contextlib
import json
import math
import subprocess
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError, require
from jaxevent.io.output import complete
from jaxevent.metrics import MEANINGS, checked

Tone = Literal["linear", "log", "percentile", "clahe", "changes"]
Kind = Literal["image", "error", "uncertainty"]

# The logarithm shows at most this many halvings below the brightest value (96 dB): pixels that are
# dark up to rounding, say 1e-9, would otherwise take most of the grey scale.
OCTAVES = 16
UNCHANGED = 0.01  # of ln(1 + I), a tenth of a threshold: smaller changes do not count for limits


def display_limits(images: ArrayLike, how: str = "linear") -> tuple[float, float]:
    """The intensities shown as black and as white, from a sample (..., height, width) of images.

    "linear" has the limits 0 and 1, whatever the images. The other tones leave out the darkest and
    the brightest 0.5 % of the values as outliers; "log" and "clahe" look at positive values only.
    "changes" leaves out the largest 5 % of those that differ from 0, and is even about it.
    Pass the result to `tone_map` for each frame of a video, so that its brightness does not pump.
    Raises `InputError` for an unknown tone and for images that are not floats or hold NaN.
    """
    images, logarithmic = _bounded(images), _is_logarithmic(how)
    if how == "linear":
        return 0.0, 1.0
    if how == "changes":
        size = np.abs(_scaled(images.astype(np.float64), how))
        size = size[size > UNCHANGED]
        most = float(np.percentile(size, 95)) if len(size) else 1.0
        return math.expm1(-most), math.expm1(most)
    values = images[images > 0] if logarithmic else images.ravel()
    if not len(values):
        return (2.0**-OCTAVES, 1.0) if logarithmic else (0.0, 1.0)
    low, high = (float(limit) for limit in np.percentile(values.astype(np.float64), [0.5, 99.5]))
    if logarithmic:
        low = max(low, high * 2.0**-OCTAVES)
        return (low, high) if low < high else (low / 2, high * 2)
    return (low, high) if low < high else (low - 0.5, high + 0.5)


def tone_map(
    images: ArrayLike, how: str = "linear", limits: tuple[float | int, float | int] | None = None
) -> NDArray[np.uint8]:
    """Images for the display, uint8, of the same shape (..., height, width) as the float `images`.

    "linear" and "percentile" scale intensity, "log" its base-2 logarithm, from `limits` (black,
    white; by default `display_limits` of these images) to 0..255 and clip what lies outside.
    "changes" scales ln(1 + I), for images from events alone, whose intensity 0 is no change: grey.
    "clahe" equalises the histogram of the result of "log" in tiles of 1/8 of the image with limited
    contrast, each image by itself. Raises `InputError` for an unknown tone, for images that are not
    floats or hold NaN and for limits that are out of order or, with a logarithm, not positive.
    """
    images, logarithmic = _bounded(images), _is_logarithmic(how)
    low, high = limits or display_limits(images, how)
    if not (-math.inf < low < high < math.inf) or (logarithmic and low <= 0):
        raise InputError(
            f"the display limits {low} and {high} do not suit the tone {how!r}; give two finite"
            f"{' positive' if logarithmic else ''} intensities, black below white"
        )
    shown = _scaled(np.clip(images, low, high), how)
    low, high = _scaled(np.array([low, high]), how).tolist()
    shown = np.clip((shown - low) / (high - low), 0, 1)
    if how == "clahe":
        shown = _equalised(shown)
    return np.rint(shown * 255).astype(np.uint8)


def _bounded(images: ArrayLike) -> NDArray[np.floating]:
    """Images whose infinite values (a hot pixel's events add up without end) are only large."""
    images = np.asarray(images)
    if images.dtype.kind == "f":
        images = images.clip(-1e30, 1e30)
    return checked(images, "images")


def _scaled(intensity: NDArray[np.floating], how: str) -> NDArray[np.floating]:
    """What a tone shows evenly."""
    if how == "changes":
        return np.log1p(np.maximum(intensity, 2.0**-OCTAVES - 1))
    return np.log2(intensity) if _is_logarithmic(how) else intensity


def _is_logarithmic(how: str) -> bool:
    if how not in get_args(Tone):
        raise InputError(f"there is no tone {how!r}; choose one of {', '.join(get_args(Tone))}")
    return how in ("log", "clahe")


def _equalised(images: NDArray[np.floating]) -> NDArray[np.floating]:
    from skimage.exposure import equalize_adapthist

    # A constant image has no contrast to equalise, and scikit-image turns it white.
    flat = images.reshape(-1, *images.shape[-2:])
    equal = [equalize_adapthist(one) if np.ptp(one) > 0 else one for one in flat]
    return np.asarray(equal).reshape(images.shape)


def write_png(path: str | Path, image: NDArray) -> None:
    """Write a uint8 image, grey (height, width) or colour (height, width, 3), as a PNG file.

    Raises `InputError` for other arrays.
    """
    from PIL import Image

    _check_displayable(path, image)
    with complete(Path(path)) as temporary:
        Image.fromarray(np.ascontiguousarray(image)).save(temporary, format="PNG")


@contextlib.contextmanager
def video_writer(
    path: str | Path, fps: float | int, preset: str = "veryfast"
) -> Iterator[Callable[[NDArray], None]]:
    """Open an MP4 file (H.264, yuv420p) and give the function that appends a frame to it.

        with video_writer("flight.mp4", fps=30) as write:
            for image in images:
                write(tone_map(image))

    Frames are uint8, grey (height, width) or colour (height, width, 3), all of one size; an odd
    size is padded to even, as the format demands, by repeating the last row or column. `fps` is in
    frames per second; `preset` is x264's, how much time it takes for a smaller file. The file
    appears at the end, complete; an exception leaves none. Raises `InputError` without the extra
    "video", for unfit frames, for none and if encoding fails.
    """
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

        def failure() -> InputError:
            log.seek(0)
            said = " ".join(log.read().decode(errors="replace").split())[-300:]
            why = f" ({said})" if said else ""
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
                ffmpeg.wait()
                raise failure() from None

        try:
            yield write
            if ffmpeg is None:
                raise InputError(f"{path}: a video needs at least one frame; write one")
            ffmpeg.communicate()
            if ffmpeg.returncode:
                raise failure()
        finally:
            if ffmpeg is not None:
                ffmpeg.kill()
                ffmpeg.communicate()


def _check_displayable(path: str | Path, image: NDArray) -> None:
    grey_or_colour = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not grey_or_colour or not image.size:
        raise InputError(
            f"{path}: cannot show an array of {image.dtype} and shape {image.shape}; give uint8 of "
            "(height, width) or (height, width, 3), as tone_map does"
        )


def comparison_figure(
    path: str | Path, panels: Sequence[tuple[str, ArrayLike, str]], title: str = ""
) -> None:
    """Draw labelled arrays side by side, up to three in one row, more in two rows; 150 dpi.

    Each panel is (label, array of shape (height, width), kind). An "image" is grey from 0; an
    "error" diverges from a white 0; an "uncertainty" runs from dark to bright. Panels of one kind
    share one scale, shown by colour bars, whose highest 0.5 % are cut off. Values that are not
    finite stay blank. The suffix of `path` chooses the format (PNG, PDF, SVG). Raises `InputError`
    without the extra "plot", for no panel, for an unknown kind, array or suffix.
    """
    require("matplotlib", "plot")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

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
    figure = Figure(
        figsize=(columns * width, rows * height + 0.35 * bool(title)), layout="constrained"
    )
    formats = FigureCanvasAgg(figure).get_supported_filetypes()
    suffix = Path(path).suffix.lstrip(".").lower()
    if suffix not in formats:
        raise InputError(
            f"{path}: a figure cannot be stored as {suffix or 'a file without suffix'}; "
            "end the name in .png, .pdf or .svg"
        )
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
            bar = figure.colorbar(
                shown,
                cax=axis.inset_axes((1.02, 0.0, 0.035, 1.0)),
                extend="both" if kind == "error" else "max",
            )
            bar.outline.set_visible(False)
            bar.ax.tick_params(labelsize=8, length=2)
    with complete(Path(path)) as temporary:
        figure.savefig(temporary, format=suffix, dpi=150)


def _style(kind: str, arrays: list[NDArray], panels: Sequence[tuple]) -> dict[str, Any]:
    """The colours and the common scale of all panels of one kind, as `imshow` takes them."""
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


Column = tuple[str, str, float | int, int]


# What a row of an evaluation is shown by: title, place in the row, factor, digits.
ALWAYS = {"mse", "ssim", "frames", "seconds"}  # of images, None too
COLUMNS: list[Column] = [
    ("MSE x 1e-2", "mse", 100, 3),
    ("SSIM", "ssim", 1, 3),
    ("log MSE", "log_mse", 1, 4),
    ("log SSIM", "log_ssim", 1, 3),
    ("bright MSE", "regions.bright.mse", 1, 3),
    ("dark log MSE", "regions.dark.log_mse", 1, 4),
    ("well MSE x 1e-2", "regions.well.mse", 100, 3),
    ("moving MSE x 1e-2", "moving.mse", 100, 3),
    ("moving share", "moving.share", 1, 4),
    ("LPIPS", "lpips", 1, 3),
    ("JOD", "hdr_quality", 1, 2),
    ("global SSIM", "global_ssim", 1, 3),
    ("authors' SSIM", "authors_ssim", 1, 3),
    ("MATLAB SSIM", "matlab_ssim", 1, 3),
    ("masked MSE x 1e-2", "masked_mse", 100, 3),
    ("frames", "frames", 1, 0),
    ("missing", "missing", 1, 0),
    ("AEE %", "AEE_rel", 1, 2),
    ("AAE deg", "AAE_U", 1, 2),
    ("heading deg", "AAE_T", 1, 2),
    ("Omega %", "vector_error", 1, 2),
    ("AAE Omega deg", "AAE_Omega", 1, 2),
    ("AME %", "AME_rel", 1, 2),
    ("lost", "lost", 1, 3),
    ("start-up s", "startup", 1, 3),
    ("RMSE px", "rmse", 1, 3),
    ("median px", "median", 1, 3),
    ("covered", "covered", 1, 3),
    ("tracks", "tracks", 1, 0),
    ("missed", "missed", 1, 0),
    ("false", "false", 1, 0),
    ("switches", "switches", 1, 0),
    ("MOTA", "mota", 1, 3),
    ("IDF1", "idf1", 1, 3),
    ("HOTA", "hota", 1, 3),
    ("velocity px/s", "velocity", 1, 1),
    ("size %", "size", 100, 1),
    ("theta deg", "theta", 1, 1),
    ("1/TTC 1/s", "inverse_ttc", 1, 3),
    ("range %", "range", 100, 1),
    ("times", "times", 1, 0),
    ("seconds", "seconds", 1, 2),
]


WORK = {"frames", "missing", "seconds", "times"}  # columns that measure no quality


def columns_of(rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    """Those of `COLUMNS` that any of the rows has, and of images those of `ALWAYS`.

    Metrics of the user's own, which rows name in `own_metrics`, follow the other measures.
    """
    always = set() if any("per_time" in row for row in rows) else ALWAYS
    known = [
        column
        for column in COLUMNS
        if column[1] in always or any(find(row, column[1]) is not None for row in rows)
    ]
    own = dict.fromkeys(name for row in rows for name in row.get("own_metrics", ()))
    work = next((i for i, column in enumerate(known) if column[1] in WORK), len(known))
    return [*known[:work], *((name, name, 1, 4) for name in own), *known[work:]]


def mean_of(rows: Sequence[Mapping[str, Any]], place: str) -> float | None:
    """The mean of a number over the rows that have it."""
    values = [find(row, place) for row in rows]
    values = [float(value) for value in values if value is not None]
    return float(np.mean(values)) if values else None


def measured(
    rows: Sequence[Mapping[str, Any]], method: str, columns: Sequence[Column]
) -> list[Mapping[str, Any]]:
    """The rows of a method that have a number in any column that measures quality."""
    places = [place for _, place, _, _ in columns if place not in WORK]
    return [
        row
        for row in rows
        if row["method"] == method and any(find(row, place) is not None for place in places)
    ]


def means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The means of each method over recordings, by column.

    Args:
        rows: Of an evaluation; those with an error do not count.

    Returns:
        For each method `method`, `recordings`, how many rows count, and for each of `columns_of`
        the mean, at the column's place in a row; None where no row has the number.
    """
    done = [row for row in rows if "error" not in row]
    columns = [column for column in columns_of(done) if column[1] not in ("frames", "missing")]
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = measured(done, method, columns)
        numbers = {place: mean_of(mine, place) for _, place, _, _ in columns}
        found.append({"method": method, "recordings": len(mine), **numbers})
    return found


def markdown_table(rows: Iterable[Mapping[str, Any]]) -> str:
    """The results of an evaluation as a Markdown table, its columns aligned as plain text too.

    Each row has the keys recording, method and, of images, mse, ssim, frames and seconds. Others of
    `COLUMNS` get columns where a row has them; what is not there is not shown. A number that is
    None, NaN or absent appears as "-". MSE is multiplied by 100 where its column says so; seconds
    are those of computing. Of several recordings the means of each method follow. Then come the
    columns' meanings and the `error` of rows that have one, each once.
    """
    rows = list(rows)
    errors = [
        (
            "skipped" if "skipped" in row else "failed",
            f"{row['method']}: " * ("skipped" in row) + " ".join(row["error"].split()),
        )
        for row in rows
        if "error" in row
    ]
    said = "".join(
        f"\n{how} ({errors.count((how, one))}): {one}\n" for how, one in dict.fromkeys(errors)
    )
    columns = columns_of(rows)
    return aligned(rows, columns) + _table_of_means(rows) + (legend(columns) if rows else "") + said


def _table_of_means(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table of each method's means; empty where no method has several recordings."""
    found = means(rows)
    if all(row["recordings"] < 2 for row in found):
        return ""
    columns = [column for column in columns_of(rows) if column[1] in found[0]]
    table = [["mean of", "recordings", *(title for title, _, _, _ in columns)]]
    for row in found:
        numbers = [
            number({"mean": row[place]}, "mean", factor, digits)
            for _, place, factor, digits in columns
        ]
        table.append([row["method"], str(row["recordings"]), *numbers])
    return "\n" + lay_out(table, (0,))


def legend(columns: Sequence[Column]) -> str:
    """What columns mean: a Markdown list, a line for each that `metrics.MEANINGS` explains."""
    known = [(title, place) for title, place, _, _ in columns if place in MEANINGS]
    lines = [f"- {title}: {MEANINGS[place]}\n" for title, place in known]
    return "\n" * bool(lines) + "".join(lines)


def short_names(recordings: Iterable[str]) -> dict[str, str]:
    """What recordings are called: the file's name, the path where several have that."""
    given = list(dict.fromkeys(recordings))
    short = [PurePath(one).name for one in given]
    return {
        one: name if short.count(name) == 1 else one for one, name in zip(given, short, strict=True)
    }


def aligned(rows: Iterable[Mapping[str, Any]], columns: Sequence[Column]) -> str:
    """A Markdown table of rows with the keys recording and method, and columns of numbers.

    A column is its title, its place in a row ("regions.well.mse"), a factor and how many digits are
    shown. A number that is None, NaN or absent appears as "-". Recordings are called as
    `short_names` does.
    """
    rows = list(rows)
    names = short_names(row["recording"] for row in rows)
    table = [["recording", "method", *(title for title, _, _, _ in columns)]]
    for row in rows:
        cells = [names[row["recording"]], row["method"]]
        for _, place, factor, digits in columns:
            cells.append(number(row, place, factor, digits))
        table.append(cells)
    return lay_out(table, (0, 1))


def lay_out(table: Sequence[Sequence[str]], left: Collection[int]) -> str:
    """Cells as a Markdown table whose first row are titles; aligned as plain text too.

    Columns in `left` hold words, the others numbers, which are aligned to the right.
    """
    cells = [[" ".join(cell.split()).replace("|", r"\|") for cell in line] for line in table]
    widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
    rule: list[str] = ["-" * w if i in left else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
    cells.insert(1, rule)
    lines = (
        [cell.ljust(w) if i in left else cell.rjust(w) for i, (cell, w) in pairs]
        for pairs in (enumerate(zip(line, widths, strict=True)) for line in cells)
    )
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def number(row: Mapping[str, Any], place: str, factor: float | int, digits: int) -> str:
    """A number of a row times `factor` as text; "-" if it is None, NaN or absent."""
    value = find(row, place)
    if value is None or math.isnan(value):
        return "-"
    return f"{factor * value:.{digits}f}"


def find(row: Mapping[str, Any], path: str) -> Any:
    """What a nested row holds at "regions.well.mse"; None if there is nothing."""
    value: Any = row
    for key in path.split("."):
        if key not in value:
            return None
        value = value[key]
    return value


def flatten(row: Mapping[str, Any]) -> dict[str, Any]:
    """The row with nested names joined by dots, those of the outermost level first."""
    flat: dict[str, Any] = {}
    pending = [("", row)]
    while pending:
        prefix, table = pending.pop(0)
        for key, value in table.items():
            if isinstance(value, Mapping):
                pending.append((f"{prefix}{key}.", value))
            else:
                flat[f"{prefix}{key}"] = value
    return flat


def write_parquet(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as Parquet, a line per row; nested names are joined by dots.

    Lists of numbers, as `per_frame.mse`, are columns of lists; what is of several kinds is JSON
    text. Without the extra "parquet" no file is written, and an older one is removed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        path.unlink(missing_ok=True)
        return

    flat = [flatten(row) for row in rows]

    def kind(values: list[Any]) -> pyarrow.DataType | None:
        kinds = {type(value) for value in values}
        if not kinds:
            return pyarrow.float64()
        if kinds == {bool}:
            return pyarrow.bool_()
        if kinds <= {int, float}:
            return pyarrow.int64() if kinds == {int} else pyarrow.float64()
        if kinds == {str}:
            return pyarrow.string()
        if kinds == {list}:
            inner = kind([one for value in values for one in value if one is not None])
            return None if inner is None else pyarrow.list_(inner)
        return None

    columns: dict[str, Any] = {}
    for name in dict.fromkeys(name for row in flat for name in row):
        values = [row.get(name) for row in flat]
        of = kind([value for value in values if value is not None])
        if of is None:
            values = [None if value is None else json.dumps(value) for value in values]
        columns[name] = pyarrow.array(values, pyarrow.string() if of is None else of)
    with complete(path) as partial:
        parquet.write_table(pyarrow.table(columns), partial)
