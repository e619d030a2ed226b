"""The results of an evaluation as one HTML page that opens anywhere, without the network."""

import base64
import datetime
import io
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent.display import plural
from jaxevent.metrics import LOG_OFFSET, MEASURE_MEANINGS
from jaxevent.show.images import COLOURS, DARK_COLOURS, display_limits, tone_map
from jaxevent.show.tables import (
    COLUMNS,
    COST_COLUMNS,
    Column,
    Row,
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
MAX_PICTURES = 400  # of a page; with many recordings and methods there are fewer times
MAX_OUTLIERS = 60  # values beyond the whiskers that are drawn
MIN_LOG_RATIO = 5.0  # of the largest to the smallest error that has a logarithmic scale
MAX_LIST_VALUES = 6  # numbers of a parameter that are printed
# Series over time that are no columns of a table.
SERIES_COLUMNS: list[Column] = [("distance px", "distance", 1, 3), ("error %", "error", 1, 2)]
HIGHER, LOWER = "higher is better", "lower is better"
# Errors shown in full colour: of intensity, and of ln(I + 0.003) against an HDR reference.
FULL_SCALE_ERROR = {False: 0.1, True: 1.0}
HIGHER_IS_BETTER = {  # of these more is better
    "ssim", "log_ssim", "global_ssim", "authors_ssim", "matlab_ssim", "hdr_quality", "psnr",
    "covered", "mota", "idf1", "hota",
}  # fmt: skip


class Cell(NamedTuple):
    """A cell of a table: its text, a class of style, how many columns it takes, a hint."""

    text: str
    kind: str = ""
    span: int = 0
    title: str = ""


# Time "t" (us), and "image", "truth", "error" and more, base64 of PNG; see `picture`.
Picture = Mapping[str, Any]
Table = tuple[list[str], list[list[Cell]], int]  # titles, lines, how many columns are text


def page(
    rows: Sequence[Row],
    pictures: Sequence[Sequence[Picture] | None],
    protocol: str,
    config: str,
    hosts: Sequence[str],
    title: str,
) -> str:
    """Render the page.

    Args:
        rows: Rows of `evaluate.evaluate`, those with an error too.
        pictures: `picture`s of each row at some times, or None.
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
    plotted, over_time = _plotted(done)
    shown = _collect_recordings(rows, pictures, methods, over_time, names)
    data = {
        "methods": methods,
        "spreads": _summarise_measures(done, methods, [*plotted, over_time]),
        "recordings": shown,
    }
    values: dict[str, Any] = {
        "title": title,
        "about": f"{len(recordings)} {plural('recording', len(recordings))}, {len(methods)} "
        f"{plural('method', len(methods))}, protocol {protocol}, {now}",
        "meaning": {
            title: MEASURE_MEANINGS[place]
            for title, place, _, _ in columns
            if place in MEASURE_MEANINGS
        },
        "failures": _list_failures(rows, names),
        "means": _tabulate_means(rows, columns),
        "unequal": len(counts) > 1,
        "several": len(recordings) > 1,
        "recordings": shown,
        "pictured": any(one["figures"] for one in shown),
        "full": f"{FULL_SCALE_ERROR[hdr]:g}",
        "unit": "ln(I + 0.003)" if hdr else "intensity",
        "certain": DEVIATION_LIMITS[0],
        "uncertain": DEVIATION_LIMITS[1],
        "everything": _tabulate_rows(rows, columns, names),
        "parameters": _tabulate_parameters(rows, methods),
        "computed": _computed(hosts),
        "config": config,
        "palette": list(zip(COLOURS, DARK_COLOURS, strict=True)),
        "lower": LOWER,
        # Nothing in the data may end the script that holds them.
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
    }
    if len(recordings) > MAX_SHOWN_RECORDINGS:
        values["first_only"] = (
            f"Of {len(recordings)} recordings the first {MAX_SHOWN_RECORDINGS} are shown."
        )
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True,
        undefined=jinja2.ChainableUndefined, keep_trailing_newline=True,
    )  # fmt: skip
    return templates.get_template("page.html").render(values)


def picture(sample: Any) -> dict[str, Any]:
    """Encode an image, its error, the truth and more as base64 of PNG.

    With an HDR reference all are logarithmic, otherwise of the tone "display", in both cases with
    the truth's limits. `sample` is an `evaluate.Sample`.
    """
    image, truth = (np.asarray(a, np.float64) for a in (sample.image, sample.truth))
    known = np.isfinite(truth) & np.isfinite(image)
    truth, image = (np.nan_to_num(a, nan=0.0, posinf=1e30, neginf=0.0) for a in (truth, image))
    if sample.hdr:
        tone, limits = "log", display_limits(truth, "log")
        low = np.log(np.maximum(truth, 0) + LOG_OFFSET)
        error = np.log(np.maximum(image, 0) + LOG_OFFSET) - low
    else:
        tone, limits = "display", display_limits(truth, "display")
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


def _list_failures(rows: Sequence[Row], names: Mapping[str, str]) -> list[tuple[str, list[str]]]:
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


def _own_metrics(rows: Sequence[Row]) -> dict[str, bool | None]:
    """Return for each metric of the user's own whether higher is better, None if not known."""
    return {name: higher for row in rows for name, higher in row.get("own_metrics", {}).items()}


def _higher_is_better(measure: str, own: Mapping[str, bool | None]) -> bool | None:
    """Return whether higher is better; None of a metric that does not say it."""
    return own.get(measure, measure in HIGHER_IS_BETTER)


def _tabulate_means(rows: Sequence[Row], columns: Sequence[Column]) -> Table:
    """Tabulate the means of each method, the best of every measure marked.

    Metrics of the user's own are marked where they say whether higher is better.
    """
    found = means(rows)
    measures = [column for column in columns if column[1] in found[0]]
    own = _own_metrics(rows)
    unmarked = COST_COLUMNS.union(name for name, higher in own.items() if higher is None)
    most = max(one["recordings"] for one in found)
    best = {}
    for _, place, _, _ in measures:
        values = [one[place] for one in found if one["recordings"] == most]
        values = [value for value in values if value is not None]
        if len(values) > 1 and place not in unmarked:
            best[place] = (max if _higher_is_better(place, own) else min)(values)
    lines = []
    several = len({row["recording"] for row in rows}) > 1
    for one in found:
        cells = [Cell(one["method"], "left")] + [Cell(str(one["recordings"]))] * several
        for column in measures:
            place, value = column[1], one[column[1]]
            marked = value is not None and value == best.get(place) and one["recordings"] == most
            cells.append(Cell(format_number(value, column), "best" if marked else ""))
        lines.append(cells)
    titles = ["recordings"] * several + [title for title, _, _, _ in measures]
    return ["method", *titles], lines, 1


def _tabulate_rows(
    rows: Sequence[Row], columns: Sequence[Column], names: Mapping[str, str]
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


def _tabulate_parameters(rows: Sequence[Row], methods: Sequence[str]) -> Table:
    """Tabulate the parameters of each method."""
    lines = []
    for method in methods:
        row = next(row for row in rows if row["method"] == method)
        values = [f"{k} = {_brief(v)}" for k, v in row["params"].items() if v is not None]
        lines.append([Cell(method, "left"), Cell(", ".join(values), "wrap")])
    return ["method", "values"], lines, 2


def _brief(value: Any) -> str:
    """Format a parameter; of a long list the first numbers."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        ending = f", ... ({len(value)})" if len(value) > MAX_LIST_VALUES else ""
        return f"[{', '.join(map(_brief, value[:MAX_LIST_VALUES]))}{ending}]"
    return str(value)


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


def _collect_recordings(
    rows: Sequence[Row],
    pictures: Sequence[Sequence[Picture] | None],
    methods: Sequence[str],
    measure: str,
    names: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Collect curves and pictures of each recording.

    Pictures are the truth, the frame before, and every method's, at some times.
    """
    recordings = list(names)[:MAX_SHOWN_RECORDINGS]
    most = max(1, MAX_PICTURES // (3 * len(methods) * len(recordings)))
    found = []
    for recording in recordings:
        mine = [
            (row, one or [])
            for row, one in zip(rows, pictures, strict=True)
            if row["recording"] == recording and "error" not in row
        ]
        curves = _collect_curves([row for row, _ in mine], methods, measure)
        shown = [(row["method"], _choose_pictures(one, most)) for row, one in mine if one]
        figures: list[dict[str, Any]] = []
        times: list[float] = []
        if shown:
            first = shown[0][1]
            times = [one["t"] / 1e6 for one in first]
            figures.append({"label": "truth", "images": {"image": _picture_column("truth", first)}})
            if "given" in first[0]:
                before = {"image": _picture_column("given", first)}
                figures.append({"label": "last frame given", "images": before})
        for method, one in shown:
            kinds = [("image", "image"), ("error", "error"), ("deviation", "uncertainty")]
            images = {what: _picture_column(kind, one) for kind, what in kinds if kind in one[0]}
            figures.append({"label": method, "images": images})
        if curves or figures:
            name = names[recording]
            found.append({"name": name, "curves": curves, "times": times, "figures": figures})
    return found


def _choose_pictures(pictures: Sequence[Picture], most: int) -> list[Picture]:
    """Choose pictures at even intervals, the middle one among them."""
    return [pictures[row] for row in spread_rows(len(pictures), most)]


def spread_rows(count: int, most: int) -> list[int]:
    """Return at most so many evenly spaced rows of `count`, the middle one among them."""
    most = min(count, most)
    return [(2 * k + 1) * count // (2 * most) for k in range(most)]


def _picture_column(kind: str, pictures: Sequence[Picture]) -> list[str | None]:
    return [one.get(kind) for one in pictures]


def _plotted(rows: Sequence[Row]) -> tuple[list[str], str]:
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


def _series(row: Row) -> Mapping[str, Any]:
    """Return the values of a row by image or time; none of published numbers."""
    return row.get("per_frame") or row.get("per_time") or {}


def _rounded(values: Any) -> Any:
    """Round numbers to what a plot shows; None where not finite."""
    return [float(f"{one:.5g}") if math.isfinite(one) else None for one in values]


def _is_logarithmic(higher_is_better: bool | None, values: NDArray[np.float64]) -> bool:
    """Return whether a plot of an error needs a logarithmic scale.

    Args:
        higher_is_better: Whether higher is better; None if unknown.
        values: (values,) all finite values of the plot.

    Returns:
        True for errors that are positive and differ by more than the factor `MIN_LOG_RATIO`.
    """
    if higher_is_better is not False or not len(values):
        return False
    return bool(values.min() > 0 and values.max() > MIN_LOG_RATIO * values.min())


def _summarise_measures(
    rows: Sequence[Row], methods: Sequence[str], measures: Sequence[str]
) -> list[dict[str, Any]]:
    """Summarise each measure over all images, or times, of all recordings, by method.

    A box reaches from the first to the third quartile, whiskers to the last value within 1.5 times
    the box's length. The mean is that of the table, in the table's unit.

    Args:
        rows: Rows without an error.
        methods: Labels of the methods.
        measures: Measures to be plotted first.

    Returns:
        For each measure a title, the kind of its axis, and a box or None by method.
    """
    own = _own_metrics(rows)
    places = {place for _, place, _, _ in COLUMNS}
    further = [name for row in rows for name in _series(row) if name in places or name in own]
    spreads = []
    for measure in dict.fromkeys([*measures, *further]):
        column = _column(measure)
        boxes: list[dict[str, Any] | None] = []
        every = []
        for method in methods:
            mine = [row for row in rows if row["method"] == method]
            lists = [np.array(_series(row).get(measure, []), np.float64) for row in mine]
            values = np.concatenate([np.zeros(0), *lists])  # None becomes NaN
            values = column[2] * np.sort(values[np.isfinite(values)])
            mean = column_mean(mine, measure)
            if mean is None and not len(values):
                boxes.append(None)
                continue
            mean = float(values.mean()) if mean is None else column[2] * mean
            every.append(np.append(values, mean))
            box: dict[str, Any] = {"mean": mean, "text": format_number(mean / column[2], column)}
            boxes.append(box)
            if len(values) > 1:
                low, middle, high = np.percentile(values, [25, 50, 75])
                reach = 1.5 * (high - low)
                near = values[(values >= low - reach) & (values <= high + reach)]
                far = values[(values < low - reach) | (values > high + reach)]
                far = far[spread_rows(len(far), MAX_OUTLIERS)]
                box |= {"box": _rounded([near[0], low, middle, high, near[-1]])}
                box |= {"far": _rounded(far)}
        if not every:
            continue
        higher = _higher_is_better(measure, own)
        better = "" if higher is None else f", {HIGHER if higher else LOWER}"
        spreads.append(
            {
                "title": column[0] + better,
                "log": _is_logarithmic(higher, np.concatenate(every)),
                "boxes": boxes,
            }
        )
    return spreads


def _collect_curves(
    rows: Sequence[Row], methods: Sequence[str], measure: str
) -> dict[str, Any] | None:
    """Collect the error of every method over the time of one recording."""
    title, _, factor, _ = _column(measure)
    lines, every = [], []
    for row in rows:
        t, values = (np.array(_series(row).get(name, []), np.float64) for name in ("t", measure))
        if not np.isfinite(values).any():
            continue
        order = np.argsort(t, kind="stable")  # tracks follow each other
        t, values = t[order], values[order]
        parts = min(MAX_CURVE_POINTS, len(t))
        t, values = (
            np.array([part.mean() for part in np.array_split(one, parts)])
            for one in (t / 1e6, factor * values)
        )
        every.append(values[np.isfinite(values)])
        place = methods.index(row["method"])
        lines.append({"method": place, "t": _rounded(t), "values": _rounded(values)})
    if not lines:
        return None
    return {
        "title": title,
        "log": _is_logarithmic(
            _higher_is_better(measure, _own_metrics(rows)), np.concatenate(every)
        ),
        "lines": lines,
    }


def _column(measure: str) -> Column:
    """Return title, place, factor and digits of a measure, as tables have them."""
    known = (column for column in (*COLUMNS, *SERIES_COLUMNS) if column[1] == measure)
    return next(known, (measure, measure, 1, 4))
