"""The results of an evaluation as one HTML page that opens anywhere, without the network."""

import base64
import datetime
import importlib.util
import io
import math
import os
import platform
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent.display import plural
from jaxevent.errors import install_command
from jaxevent.metrics import LOG_OFFSET, MEASURE_MEANINGS
from jaxevent.show.images import display_limits, tone_map
from jaxevent.show.tables import (
    COST_COLUMNS,
    Column,
    column_mean,
    columns_of,
    format_number,
    means,
    nested_value,
    short_names,
)

PICTURE_PX = 360  # px of the longer side of a picture
MAX_SHOWN_RECORDINGS = (
    12  # recordings with pictures and plots over time; more would make the page slow to open
)
MAX_CURVE_POINTS = 300  # of a curve over time, means of so many parts of it
# Standard deviations of log intensity shown black and white; between them by their logarithm.
DEVIATION_LIMITS = 0.001, 0.1
WIDTH_INCHES = 4.5  # inches of a plot: 27 rem of the page
LABEL_LINE_LETTERS = 18  # letters of a line of a method's label in a plot
# Errors shown in full colour: of intensity, and of ln(I + 0.003) against an HDR reference.
FULL_SCALE_ERROR = {False: 0.1, True: 1.0}
HIGHER_IS_BETTER = {  # of these more is better
    "ssim", "log_ssim", "global_ssim", "authors_ssim", "matlab_ssim", "hdr_quality", "covered",
    "mota", "idf1", "hota",
}  # fmt: skip


class Cell(NamedTuple):
    """A cell of a table: its text, a class of style, how many columns it takes, a hint."""

    text: str
    kind: str = ""
    span: int = 0
    title: str = ""


Table = tuple[list[str], list[list[Cell]], int]  # titles, lines, how many columns are text


def page(
    rows: Sequence[Mapping[str, Any]],
    pictures: Sequence[Mapping[str, Any] | None],
    protocol: str,
    config: str,
    hosts: Sequence[str],
    title: str,
) -> str:
    """Render the page.

    Args:
        rows: Rows of `evaluate.evaluate`, those with an error too.
        pictures: A `picture` of each row, or None.
        protocol: Name of the protocol of evaluation.
        config: Text of the configuration.
        hosts: Names of the machines that computed it.
        title: Title of the page.

    Returns:
        The page as HTML.
    """
    import jinja2

    recordings = list(dict.fromkeys(row["recording"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    done = [row for row in rows if "error" not in row]
    columns, names = columns_of(done), short_names(recordings)
    hdr = any("log_mse" in row for row in done)
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    counts = {one["recordings"] for one in means(rows)}
    values: dict[str, Any] = {
        "title": title,
        "about": f"{len(recordings)} {plural('recording', len(recordings))}, {len(methods)} "
        f"{plural('method', len(methods))}, protocol {protocol}, {now}",
        "meaning": {
            title: MEASURE_MEANINGS[place]
            for title, place, _, _ in columns
            if place in MEASURE_MEANINGS
        },
        "failures": _failures(rows, names),
        "means": _means(rows, columns),
        "unequal": len(counts) > 1,
        "strips": _strips(rows, pictures, recordings, names),
        "full": f"{FULL_SCALE_ERROR[hdr]:g}",
        "unit": "ln(I + 0.003)" if hdr else "intensity",
        "certain": DEVIATION_LIMITS[0],
        "uncertain": DEVIATION_LIMITS[1],
        "everything": _table(rows, columns, names),
        "parameters": _parameters(rows, methods),
        "computed": _computed(hosts),
        "config": config,
    }
    if len(recordings) > MAX_SHOWN_RECORDINGS:
        values["first_only"] = (
            f"Of {len(recordings)} recordings the first {MAX_SHOWN_RECORDINGS} are shown."
        )
    if importlib.util.find_spec("matplotlib") is None:
        values["missing_plots"] = install_command("plot")
    else:
        plotted, over_time = _plotted(done)
        values["points"] = _points(done, methods, plotted)
        values["boxes"] = _boxes(done, methods, [*plotted, over_time])
        values["curves"] = _curves(done, recordings, methods, over_time, names)
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True,
        undefined=jinja2.ChainableUndefined, keep_trailing_newline=True,
    )  # fmt: skip
    return templates.get_template("page.html").render(values)


def picture(sample: Any) -> dict[str, Any]:
    """Encode an image, its error, the truth and more as base64 of PNG.

    With an HDR reference all are logarithmic, between the truth's limits. Otherwise they are
    linear, and dark ones are brightened alike. `sample` is an `evaluate.Sample`.
    """
    image, truth = (np.asarray(a, np.float64) for a in (sample.image, sample.truth))
    known = np.isfinite(truth) & np.isfinite(image)
    truth, image = (np.nan_to_num(a, nan=0.0, posinf=1e30, neginf=0.0) for a in (truth, image))
    if sample.hdr:
        tone, limits = "log", display_limits(truth, "log")
        low = np.log(np.maximum(truth, 0) + LOG_OFFSET)
        error = np.log(np.maximum(image, 0) + LOG_OFFSET) - low
    else:
        bright = float(np.percentile(truth, 99.5))
        tone, limits = "linear", (0.0, bright if 0 < bright < 0.8 else 1.0)
        error = image.clip(0, 1) - truth
    error = np.where(known, error / FULL_SCALE_ERROR[sample.hdr], 0).clip(-1, 1)
    shown = {
        "t": sample.t,
        "image": _grey(tone_map(image, tone, limits)),
        "truth": _grey(tone_map(truth, tone, limits)),
        "error": _diverging(error),
    }
    if sample.deviation is not None:
        least, most = DEVIATION_LIMITS
        deviation = np.nan_to_num(np.asarray(sample.deviation, np.float64), nan=most)
        share = np.log(np.maximum(deviation, least) / least) / np.log(most / least)
        shown["deviation"] = _grey(np.rint(255 * share.clip(0, 1)).astype(np.uint8))
    if sample.given is not None:
        shown["given"] = _grey(tone_map(np.asarray(sample.given, np.float64), tone, limits))
    return shown


def _size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return width and height of a picture of an image, px."""
    height, width = shape
    scale = min(1.0, PICTURE_PX / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _grey(image: NDArray[np.uint8]) -> str:
    """Encode a grey image."""
    from PIL import Image

    small = Image.fromarray(image).resize(_size(image.shape), Image.Resampling.BOX)
    return _png(small)


def _diverging(error: NDArray[np.float64]) -> str:
    """Encode errors of -1, 0 and 1 as blue, white and red, in steps, which PNG packs well."""
    from PIL import Image

    small = Image.fromarray(error.astype(np.float32)).resize(
        _size(error.shape), Image.Resampling.BOX
    )
    steps = 12
    level = np.rint(np.asarray(small) * steps).astype(int) + steps
    share = np.abs(np.arange(2 * steps + 1) - steps)[:, None] / steps
    ends = np.where(np.arange(2 * steps + 1)[:, None] < steps, [33, 102, 172], [178, 24, 43])
    palette = np.rint(255 + share * (ends - 255)).astype(np.uint8)
    coloured = Image.fromarray(level.astype(np.uint8), mode="P")
    coloured.putpalette(palette.tobytes())
    return _png(coloured)


def _png(image: Any) -> str:
    """Encode a Pillow image as base64 of PNG."""
    held = io.BytesIO()
    image.save(held, format="PNG", optimize=True)
    return base64.b64encode(held.getvalue()).decode()


def _failures(
    rows: Sequence[Mapping[str, Any]], names: Mapping[str, str]
) -> list[tuple[str, list[str]]]:
    """List what failed and what was skipped, with titles."""
    parts = []
    for how in ("failed", "skipped"):
        lines = [
            f"{names[row['recording']]}, {row['method']}: {row['error']}"
            for row in rows
            if "error" in row and ("skipped" in row) == (how == "skipped")
        ]
        if lines:
            parts.append((f"{len(lines)} of {len(rows)} {how}", lines))
    return parts


def _means(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> Table:
    """Tabulate the means of each method, the best of every measure marked.

    Metrics of the user's own are not marked, as it is not known whether more of them is better.
    """
    found = means(rows)
    measures = [column for column in columns if column[1] in found[0]]
    unmarked = COST_COLUMNS.union(*(row.get("own_metrics", ()) for row in rows))
    most = max(one["recordings"] for one in found)
    best = {}
    for _, place, _, _ in measures:
        values = [one[place] for one in found if one["recordings"] == most]
        values = [value for value in values if value is not None]
        if len(values) > 1 and place not in unmarked:
            best[place] = (max if place in HIGHER_IS_BETTER else min)(values)
    lines = []
    for one in found:
        cells = [Cell(one["method"], "left"), Cell(str(one["recordings"]))]
        for column in measures:
            place, value = column[1], one[column[1]]
            marked = value is not None and value == best.get(place) and one["recordings"] == most
            cells.append(Cell(format_number(value, column), "best" if marked else ""))
        lines.append(cells)
    return ["method", "recordings", *(title for title, _, _, _ in measures)], lines, 1


def _table(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[Column], names: Mapping[str, str]
) -> Table:
    """Tabulate all rows."""
    lines = []
    for row in rows:
        path = row["recording"]
        cells = [Cell(names[path], "left", title=path), Cell(row["method"], "left")]
        if "error" in row:
            cells.append(Cell(row["error"], "wrap", len(columns)))
        else:
            for column in columns:
                cells.append(Cell(format_number(nested_value(row, column[1]), column)))
        lines.append(cells)
    return ["recording", "method", *(title for title, _, _, _ in columns)], lines, 2


def _parameters(rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> Table:
    """Tabulate the parameters of each method."""
    lines = []
    for method in methods:
        row = next(row for row in rows if row["method"] == method)
        values = ", ".join(f"{k} = {v}" for k, v in row["params"].items() if v is not None)
        lines.append([Cell(method, "left"), Cell(values, "wrap")])
    return ["method", "values"], lines, 2


def _computed(hosts: Sequence[str]) -> Table:
    """Tabulate versions and machines."""
    import jax

    facts = {
        "jaxevent": jaxevent.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "Python": platform.python_version(),
        "system": platform.platform(),
        "processors": str(os.cpu_count()),
        "devices": ", ".join(dict.fromkeys(str(device.device_kind) for device in jax.devices())),
        "machines": ", ".join(hosts),
    }
    return ["", ""], [[Cell(k, "left"), Cell(v, "wrap")] for k, v in facts.items()], 2


def _strips(
    rows: Sequence[Mapping[str, Any]],
    pictures: Sequence[Mapping[str, Any] | None],
    recordings: Sequence[str],
    names: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Collect the truth, the frame before, and every method's pictures of each recording."""
    strips = []
    for recording in recordings[:MAX_SHOWN_RECORDINGS]:
        shown = [
            (row["method"], one)
            for row, one in zip(rows, pictures, strict=True)
            if row["recording"] == recording and one is not None and "error" not in row
        ]
        if not shown:
            continue
        first = shown[0][1]
        figures = [{"label": "truth", "images": [{"what": "image", "data": first["truth"]}]}]
        if "given" in first:
            before = [{"what": "image", "data": first["given"]}]
            figures.append({"label": "last frame given", "images": before})
        for method, one in shown:
            kinds = [("image", "image"), ("error", "error"), ("deviation", "uncertainty")]
            images = [{"what": what, "data": one[kind]} for kind, what in kinds if kind in one]
            figures.append({"label": method, "images": images})
        title = f"{names[recording]} at {first['t'] / 1e6:.3f} s"
        strips.append({"title": title, "figures": figures})
    return strips


MEASURE_LABELS = {
    "mse": "MSE", "ssim": "SSIM", "log_mse": "log MSE", "log_ssim": "log SSIM",
    "AEE_rel": "relative AEE (%)", "AAE_U": "AAE (degrees)", "AAE_T": "heading (degrees)",
    "vector_error": "error of Omega (%)", "AME_rel": "relative AME (%)", "error": "error (%)",
    "rmse": "RMSE (px)", "covered": "covered", "distance": "distance (px)", "lpips": "LPIPS",
    "hdr_quality": "JOD", "global_ssim": "global SSIM", "authors_ssim": "authors' SSIM",
    "matlab_ssim": "MATLAB SSIM", "masked_mse": "masked MSE",
}  # fmt: skip


def _plotted(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], str]:
    """Choose two measures whose means are plotted, and the one plotted over time."""
    pairs = {
        "log_mse": (["log_mse", "log_ssim"], "log_mse"),
        "rmse": (["rmse", "covered"], "distance"),
        "AAE_T": (["AAE_T", "vector_error"], "error"),
        "AEE_rel": (["AEE_rel", "AAE_U"], "error"),
        "vector_error": (["vector_error", "AME_rel"], "error"),
    }
    for name, pair in pairs.items():
        if any(name in row for row in rows):
            return pair
    return ["mse", "ssim"], "mse"


def _points(
    rows: Sequence[Mapping[str, Any]], methods: Sequence[str], measures: Sequence[str]
) -> list[str]:
    """Plot means over recordings for each measure, errors on a logarithmic scale."""
    plots = []
    for measure in measures:
        figure, axis = _panel(methods)
        values = [
            column_mean([row for row in rows if row["method"] == method], measure)
            for method in methods
        ]
        places = [math.nan if value is None else value for value in values]
        colours = [_colour(i) for i in range(len(methods))]
        axis.hlines(range(len(methods)), 0, 1, "0.9", transform=axis.get_yaxis_transform())
        axis.scatter(places, range(len(methods)), c=colours, zorder=2)
        if measure not in HIGHER_IS_BETTER and all(place > 0 for place in places if place == place):
            axis.set_xscale("log")
            _label_plainly(axis.xaxis)
        axis.set_xlabel(MEASURE_LABELS[measure])
        plots.append(_plot(figure))
    return plots


def _panel(methods: Sequence[str]) -> tuple[Any, Any]:
    """Make a figure and its axes with a line for each method, from above."""
    from matplotlib.figure import Figure

    lines = sum(len(textwrap.wrap(method, LABEL_LINE_LETTERS)) for method in methods)
    figure = Figure(
        figsize=(WIDTH_INCHES, 0.8 + 0.14 * (lines + len(methods))), layout="constrained"
    )
    axis = figure.subplots()
    labels = [textwrap.fill(method, LABEL_LINE_LETTERS) for method in methods]
    axis.set(yticks=range(len(methods)), yticklabels=labels, ylim=(len(methods) - 0.5, -0.5))
    axis.tick_params(left=False)
    axis.spines[["top", "right", "left"]].set_visible(False)
    return figure, axis


def _series(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values of a row by image or time; none of published numbers."""
    return row.get("per_frame") or row.get("per_time") or {}


def _boxes(
    rows: Sequence[Mapping[str, Any]], methods: Sequence[str], measures: Sequence[str]
) -> list[str]:
    """Plot the distribution of each measure over all images, or times, of all recordings.

    A box reaches from the first to the third quartile, the line in it is the median, whiskers
    reach to the last value within 1.5 times the box's length. Further metrics have plots too.
    """
    own = {name for row in rows for name in row.get("own_metrics", ())}
    further = [
        name for row in rows for name in _series(row) if name in MEASURE_LABELS or name in own
    ]
    plots = []
    for measure in dict.fromkeys([*measures, *further]):
        lists = [
            [v for row in rows if row["method"] == one for v in _series(row).get(measure, [])]
            for one in methods
        ]
        columns = [np.array(one, np.float64) for one in lists]  # None becomes NaN
        columns = [one[np.isfinite(one)] for one in columns]
        if not any(len(one) for one in columns):
            continue
        figure, axis = _panel(methods)
        drawn = axis.boxplot(
            columns, positions=range(len(methods)), orientation="horizontal", widths=0.6,
            patch_artist=True, flierprops={"marker": ".", "markersize": 2, "alpha": 0.4},
            medianprops={"color": "black"}, manage_ticks=False,
        )  # fmt: skip
        for i, box in enumerate(drawn["boxes"]):
            box.set(facecolor=_colour(i), alpha=0.6)
        if measure not in HIGHER_IS_BETTER | own and all((one > 0).all() for one in columns):
            axis.set_xscale("log")
            _label_plainly(axis.xaxis)
        axis.set_xlabel(MEASURE_LABELS.get(measure, measure))
        plots.append(_plot(figure))
    return plots


def _curves(
    rows: Sequence[Mapping[str, Any]],
    recordings: Sequence[str],
    methods: Sequence[str],
    measure: str,
    names: Mapping[str, str],
) -> list[tuple[str, str]]:
    """Plot the error of every method at every image, for each recording by its name."""
    from matplotlib.figure import Figure

    parts = []
    for recording in recordings[:MAX_SHOWN_RECORDINGS]:
        figure = Figure(figsize=(WIDTH_INCHES, 2.8), layout="constrained")
        axis = figure.subplots()
        for row in rows:
            if row["recording"] != recording:
                continue
            series = _series(row)
            if not series:
                continue
            t = np.array(series["t"], np.float64) / 1e6
            values = np.array(series[measure], np.float64)  # None becomes NaN
            pieces = [
                (float(np.mean(a)), float(np.mean(b)))
                for a, b in zip(
                    np.array_split(t, min(MAX_CURVE_POINTS, len(t))),
                    np.array_split(values, min(MAX_CURVE_POINTS, len(t))),
                    strict=True,
                )
            ]
            if not pieces or not np.isfinite([b for _, b in pieces]).any():
                continue
            place = methods.index(row["method"])
            axis.plot(
                *zip(*pieces, strict=True),
                label=row["method"],
                color=_colour(place),
                linestyle=("-", "--", ":")[place // 10 % 3],
                linewidth=1.2,
                marker="." if len(pieces) < 60 else None,
                markersize=3,
            )
        if not axis.lines:
            continue
        axis.set(xlabel="time (s)", ylabel=MEASURE_LABELS[measure])
        if all(np.nanmin(np.asarray(line.get_ydata())) > 0 for line in axis.lines):
            axis.set_yscale("log")
            _label_plainly(axis.yaxis)
        axis.spines[["top", "right"]].set_visible(False)
        longest = max(len(str(line.get_label())) for line in axis.lines)
        columns = max(1, 60 // (longest + 6))
        figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
        parts.append((names[recording], _plot(figure)))
    return parts


def _label_plainly(axis: Any) -> None:
    """Put ticks of a logarithmic axis at 1, 2 and 5 of each decade, as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _colour(place: int) -> str:
    return f"C{place % 10}"


def _plot(figure: Any) -> str:
    """Encode a figure as base64 of SVG."""
    import matplotlib

    held = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxevent"}):
        figure.savefig(held, format="svg", metadata={"Date": None}, transparent=True)
    return base64.b64encode(held.getvalue()).decode()
