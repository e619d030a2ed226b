"""The results of an evaluation as one HTML page that opens anywhere, without the network."""

import base64
import datetime
import html
import importlib.util
import io
import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxevent
from jaxevent.errors import install_command
from jaxevent.metrics import LOG_OFFSET
from jaxevent.show.report import Column, columns_of, display_limits, find, number, tone_map

SIDE = 200  # pixels of the longer side of a picture
STRIPS = 12  # recordings with pictures and plots over time; more would make the page slow to open
POINTS = 300  # of a curve over time, means of so many parts of it
# Errors shown in full colour: of intensity, and of ln(I + 0.003) against an HDR reference.
FULL = {False: 0.25, True: 2.0}
HIGHER = {"ssim", "log_ssim", "global_ssim", "hdr_quality", "covered"}  # of these more is better

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem;
       padding: 0 1rem; color: #1d2329; background: #fff; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; } .meta, figcaption, .note { color: #5a6570; }
.note { font-size: .9rem; margin: .3rem 0; } .scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #e3e7eb;
         white-space: nowrap; }
th { border-bottom: 2px solid #b9c2ca; } th.left, td.left { text-align: left; }
td.wrap { white-space: normal; text-align: left; } td.best { font-weight: 650; }
.failed { border-left: 4px solid #c0392b; padding: .1rem 1rem; background: #fdf3f1; }
.strip { display: flex; gap: .6rem; overflow-x: auto; padding-bottom: .4rem; }
figure { margin: 0; flex: none; } figcaption { font-size: .8rem; max-width: 14rem; }
figure img { display: block; margin-bottom: 2px; }
img.plot { max-width: 100%; } details { margin: .5rem 0; } summary { cursor: pointer; }
pre { background: #f5f7f8; padding: .8rem; overflow-x: auto; font-size: .85rem; }
"""


def page(
    rows: Sequence[Mapping[str, Any]],
    pictures: Sequence[Mapping[str, Any] | None],
    protocol: str,
    config: str,
    hosts: Sequence[str],
    title: str,
) -> str:
    """The page, as text.

    Args:
        rows: As `evaluate.evaluate` gives them, those with an error too.
        pictures: What `picture` gave for each row; None: nothing to show.
        protocol: What was asked of the methods.
        config: The text of the configuration.
        hosts: The names of the machines that computed it.
        title: Of the page.
    """
    recordings = list(dict.fromkeys(row["recording"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    done = [row for row in rows if "error" not in row]
    columns = columns_of(done)
    hdr = any("log_mse" in row for row in done)
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    about = f"{len(recordings)} recordings, {len(methods)} methods, protocol {protocol}, {now}"
    parts = [f"<h1>{_text(title)}</h1>", f'<p class="meta">{_text(about)}</p>']
    parts += _failures(rows)
    parts += ["<h2>Means over recordings</h2>", _means(done, methods, columns)]
    if importlib.util.find_spec("matplotlib") is None:
        parts.append(f'<p class="note">Plots need <code>{install_command("plot")}</code>.</p>')
    else:
        means, over_time = _plotted(done)
        parts.append(_points(done, methods, means))
        parts += ["<h2>Errors over time</h2>", *_curves(done, recordings, methods, over_time)]
    if any(one is not None for one in pictures):
        parts += ["<h2>Pictures</h2>", *_strips(rows, pictures, recordings, hdr)]
    parts += ["<h2>Every recording and method</h2>", _table(rows, columns)]
    parts += ["<h2>Parameters</h2>", _parameters(rows, methods)]
    parts += ["<h2>How it was computed</h2>", _computed(hosts)]
    parts.append(f"<details><summary>configuration</summary><pre>{_text(config)}</pre></details>")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{_text(title)}'
        f"</title><style>{STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def picture(sample: Any) -> dict[str, Any]:
    """An image, its error and the truth as base64 of small PNG, from an `evaluate.Sample`.

    With an HDR reference all are logarithmic, between the truth's limits.
    """
    image, truth = (np.asarray(a, np.float64) for a in (sample.image, sample.truth))
    known = np.isfinite(truth) & np.isfinite(image)
    truth, image = (np.nan_to_num(a, nan=0.0, posinf=1e30, neginf=0.0) for a in (truth, image))
    if sample.hdr:
        tone, limits = "log", display_limits(truth, "log")
        low = np.log(np.maximum(truth, 0) + LOG_OFFSET)
        error = np.log(np.maximum(image, 0) + LOG_OFFSET) - low
    else:
        tone, limits = "linear", (0.0, 1.0)
        error = image.clip(0, 1) - truth
    error = np.where(known, error / FULL[sample.hdr], 0).clip(-1, 1)
    return {
        "t": sample.t,
        "image": _grey(tone_map(image, tone, limits)),
        "truth": _grey(tone_map(truth, tone, limits)),
        "error": _diverging(error),
    }


def _size(shape: tuple[int, ...]) -> tuple[int, int]:
    height, width = shape
    scale = min(1.0, SIDE / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _grey(image: NDArray[np.uint8]) -> str:
    from PIL import Image

    small = Image.fromarray(image).resize(_size(image.shape), Image.Resampling.BOX)
    return _png(small)


def _diverging(error: NDArray[np.float64]) -> str:
    """Errors of -1, 0 and 1 as blue, white and red, in steps, which PNG packs well."""
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
    held = io.BytesIO()
    image.save(held, format="PNG", optimize=True)
    return base64.b64encode(held.getvalue()).decode()


def _text(text: str) -> str:
    return html.escape(str(text))


def _failures(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    parts = []
    for how in ("failed", "skipped"):
        lines = [
            f"<li>{_text(row['recording'])}, {_text(row['method'])}: {_text(row['error'])}</li>"
            for row in rows
            if "error" in row and ("skipped" in row) == (how == "skipped")
        ]
        if lines:
            title = f"{len(lines)} of {len(rows)} {how}"
            parts.append(f'<div class="failed"><h2>{title}</h2><ul>{"".join(lines)}</ul></div>')
    return parts


def _html_table(head: Iterable[str], lines: Iterable[Iterable[str]], left: int) -> str:
    """A table of cells, already HTML, of which the first `left` columns are text."""
    titles = "".join(
        f'<th class="left">{cell}</th>' if i < left else f"<th>{cell}</th>"
        for i, cell in enumerate(head)
    )
    body = "".join(f"<tr>{''.join(cells)}</tr>" for cells in lines)
    return (
        f'<div class="scroll"><table><thead><tr>{titles}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _mean(rows: Sequence[Mapping[str, Any]], place: str) -> float | None:
    """Over the rows that have that number."""
    values = [find(row, place) for row in rows]
    values = [float(value) for value in values if value is not None]
    return float(np.mean(values)) if values else None


def _means(
    rows: Sequence[Mapping[str, Any]], methods: Sequence[str], columns: Sequence[Column]
) -> str:
    measures = [column for column in columns if column[1] not in ("frames", "missing")]
    mine = {method: [row for row in rows if row["method"] == method] for method in methods}
    means = {
        place: [_mean(mine[method], place) for method in methods] for _, place, _, _ in measures
    }
    lines = []
    for i, method in enumerate(methods):
        cells = [f'<td class="left">{_text(method)}</td>', f"<td>{len(mine[method])}</td>"]
        for _, place, factor, digits in measures:
            value = means[place][i]
            others = [one for one in means[place] if one is not None]
            best = others and value == (max if place in HIGHER else min)(others)
            marked = best and len(others) > 1 and place != "seconds"
            cell = number({"mean": value}, "mean", factor, digits)
            cells.append(f'<td class="best">{cell}</td>' if marked else f"<td>{cell}</td>")
        lines.append(cells)
    head = ["method", "recordings", *(_text(title) for title, _, _, _ in measures)]
    table = _html_table(head, lines, 1)
    if len({len(some) for some in mine.values()}) > 1:
        table += (
            '<p class="note">Methods that failed on some recordings have means over the others, '
            "which do not compare.</p>"
        )
    return table


def _table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> str:
    lines = []
    for row in rows:
        cells = [f'<td class="left">{_text(row[name])}</td>' for name in ("recording", "method")]
        if "error" in row:
            cells.append(f'<td class="wrap" colspan="{len(columns)}">{_text(row["error"])}</td>')
        else:
            cells += [f"<td>{number(row, *column[1:])}</td>" for column in columns]
        lines.append(cells)
    head = ["recording", "method", *(_text(title) for title, _, _, _ in columns)]
    return _html_table(head, lines, 2)


def _parameters(rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> str:
    lines = []
    for method in methods:
        row = next(row for row in rows if row["method"] == method)
        values = ", ".join(f"{k} = {v}" for k, v in row["params"].items() if v is not None)
        lines.append(
            [f'<td class="left">{_text(method)}</td>', f'<td class="wrap">{_text(values)}</td>']
        )
    return _html_table(["method", "values"], lines, 2)


def _computed(hosts: Sequence[str]) -> str:
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
    lines = [
        [f'<td class="left">{_text(k)}</td>', f'<td class="wrap">{_text(v)}</td>']
        for k, v in facts.items()
    ]
    return _html_table(["", ""], lines, 2)


def _strips(
    rows: Sequence[Mapping[str, Any]],
    pictures: Sequence[Mapping[str, Any] | None],
    recordings: Sequence[str],
    hdr: bool,
) -> list[str]:
    what = "ln(I + 0.003), log" if hdr else "intensity"
    parts = [
        '<p class="note">The image in the middle of those asked for, and below it its error: red '
        f"too bright, blue too dark, in full colour from {FULL[hdr]:g} in {what.split(',')[0]}.</p>"
    ]

    def figure(top: str, below: str | None, label: str) -> str:
        images = "".join(
            f'<img alt="" src="data:image/png;base64,{one}">' for one in (top, below) if one
        )
        return f"<figure>{images}<figcaption>{_text(label)}</figcaption></figure>"

    for recording in recordings[:STRIPS]:
        shown = [
            (row["method"], one)
            for row, one in zip(rows, pictures, strict=True)
            if row["recording"] == recording and one is not None and "error" not in row
        ]
        if not shown:
            continue
        at = shown[0][1]["t"] / 1e6
        parts.append(f"<h3>{_text(recording)} at {at:.3f} s</h3>")
        figures = [figure(shown[0][1]["truth"], None, "truth")]
        figures += [figure(one["image"], one["error"], method) for method, one in shown]
        parts.append(f'<div class="strip">{"".join(figures)}</div>')
    return [*parts, *_more(recordings)]


def _more(recordings: Sequence[str]) -> list[str]:
    if len(recordings) <= STRIPS:
        return []
    return [f'<p class="note">Of {len(recordings)} recordings the first {STRIPS} are shown.</p>']


NAMES = {
    "mse": "MSE", "ssim": "SSIM", "log_mse": "log MSE", "log_ssim": "log SSIM",
    "AEE_rel": "relative AEE (%)", "AAE_U": "AAE (degrees)", "AAE_T": "heading (degrees)",
    "vector_error": "error of Omega (%)", "AME_rel": "relative AME (%)", "error": "error (%)",
    "rmse": "RMSE (px)", "covered": "covered", "distance": "distance (px)",
}  # fmt: skip


def _plotted(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], str]:
    """Two measures whose means are plotted, and that which is plotted over time."""
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
) -> str:
    """Means over recordings, a panel for each measure; errors on a logarithmic scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.8 + 0.28 * len(methods)), layout="constrained")
    for axis, measure in zip(figure.subplots(1, len(measures)), measures, strict=True):
        values = [
            _mean([row for row in rows if row["method"] == method], measure) for method in methods
        ]
        places = [math.nan if value is None else value for value in values]
        colours = [_colour(i) for i in range(len(methods))]
        axis.hlines(range(len(methods)), 0, 1, "0.9", transform=axis.get_yaxis_transform())
        axis.scatter(places, range(len(methods)), c=colours, zorder=2)
        if measure not in HIGHER and all(place > 0 for place in places if place == place):
            axis.set_xscale("log")
        axis.set(xlabel=NAMES[measure], yticks=range(len(methods)), yticklabels=methods)
        axis.invert_yaxis()
        axis.tick_params(labelleft=measure == measures[0], left=False)
        axis.spines[["top", "right", "left"]].set_visible(False)
    return _plot(figure)


def _curves(
    rows: Sequence[Mapping[str, Any]],
    recordings: Sequence[str],
    methods: Sequence[str],
    measure: str,
) -> list[str]:
    """A plot for each recording of the error of every method at every image."""
    from matplotlib.figure import Figure

    parts = []
    for recording in recordings[:STRIPS]:
        figure = Figure(figsize=(9, 2.8), layout="constrained")
        axis = figure.subplots()
        for row in rows:
            if row["recording"] != recording:
                continue
            series = row.get("per_frame") or row["per_time"]
            t = np.array(series["t"], np.float64) / 1e6
            values = np.array(series[measure], np.float64)  # None becomes NaN
            pieces = [
                (float(np.mean(a)), float(np.mean(b)))
                for a, b in zip(
                    np.array_split(t, min(POINTS, len(t))),
                    np.array_split(values, min(POINTS, len(t))),
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
        axis.set(xlabel="time (s)", ylabel=NAMES[measure])
        if all(np.nanmin(np.asarray(line.get_ydata())) > 0 for line in axis.lines):
            axis.set_yscale("log")
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8)
        parts += [f"<h3>{_text(recording)}</h3>", _plot(figure)]
    return [*parts, *_more(recordings)]


def _colour(place: int) -> str:
    return f"C{place % 10}"


def _plot(figure: Any) -> str:
    import matplotlib

    held = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxevent"}):
        figure.savefig(held, format="svg", metadata={"Date": None})
    data = base64.b64encode(held.getvalue()).decode()
    return f'<img class="plot" alt="" src="data:image/svg+xml;base64,{data}">'
