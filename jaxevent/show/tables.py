"""Tables of results: Markdown, plain text and Parquet."""

import json
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from jaxevent.io.output import complete
from jaxevent.metrics import MEASURE_MEANINGS

Column = tuple[str, str, float | int, int]
Row = Mapping[str, Any]  # of an evaluation: recording, method, params, and measures by their names

# Columns of a row of an evaluation: title, place in the row, factor, digits.
REQUIRED_COLUMNS = {"mse", "ssim", "frames", "seconds"}  # of images, None too
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
    ("PSNR dB", "psnr", 1, 2),
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


COST_COLUMNS = {"frames", "missing", "seconds", "times"}  # columns that measure no quality


def columns_of(rows: Sequence[Row], further: Sequence[Column] = ()) -> list[Column]:
    """Choose the columns of a table: those that rows have, and those of `REQUIRED_COLUMNS`.

    Metrics of the user's own, which rows name in `own_metrics`, follow the other measures.

    Args:
        rows: Rows of an evaluation.
        further: Columns beside `COLUMNS`, before those of costs, where a row has them.

    Returns:
        The columns, in their order.
    """
    always = set() if any("per_time" in row for row in rows) else REQUIRED_COLUMNS
    known = [
        column
        for column in COLUMNS
        if column[1] in always or any(nested_value(row, column[1]) is not None for row in rows)
    ]
    own = dict.fromkeys(name for row in rows for name in row.get("own_metrics", ()))
    own_columns = [(name, name, 1, 4) for name in own]
    beside = [c for c in further if any(nested_value(row, c[1]) is not None for row in rows)]
    work = next((i for i, column in enumerate(known) if column[1] in COST_COLUMNS), len(known))
    return [*known[:work], *beside, *own_columns, *known[work:]]


def column_mean(rows: Sequence[Row], place: str) -> float | None:
    """Compute the mean of a number over rows.

    Args:
        rows: Rows of an evaluation.
        place: Place of the number in a row, such as "regions.well.mse".

    Returns:
        The mean over the rows that have the number; None if no row has.
    """
    values = [nested_value(row, place) for row in rows]
    values = [float(value) for value in values if value is not None]
    return float(np.mean(values)) if values else None


def rows_of_method(rows: Sequence[Row], method: str, columns: Sequence[Column]) -> list[Row]:
    """Choose the rows of a method with a number in any column that measures quality.

    Args:
        rows: Rows of an evaluation.
        method: Label of the method.
        columns: Columns of the table.

    Returns:
        The rows, in their order.
    """
    places = [place for _, place, _, _ in columns if place not in COST_COLUMNS]
    return [
        row
        for row in rows
        if row["method"] == method and any(nested_value(row, place) is not None for place in places)
    ]


def means(rows: Sequence[Row], further: Sequence[Column] = ()) -> list[dict[str, Any]]:
    """Compute the means of each method over recordings.

    Args:
        rows: Rows of an evaluation; those with an error do not count.
        further: Columns beside `COLUMNS`, where a row has them.

    Returns:
        For each method `method`, `recordings` (the number of rows that count) and the mean of each
        of `columns_of` by its place in a row; None where no row has the number.
    """
    done = [row for row in rows if "error" not in row]
    chosen = columns_of(done, further)
    columns = [column for column in chosen if column[1] not in ("frames", "missing")]
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = rows_of_method(done, method, columns)
        numbers = {place: column_mean(mine, place) for _, place, _, _ in columns}
        found.append({"method": method, "recordings": len(mine), **numbers})
    return found


def markdown_table(rows: Iterable[Row], further: Sequence[Column] = ()) -> str:
    """Format the results of an evaluation as a Markdown table, aligned as plain text too.

    A table of each method's means follows if there are several recordings, then the meanings of the
    columns and the errors, each once.

    Args:
        rows: Rows with the keys recording, method and, of images, mse, ssim, frames and seconds.
            Others of `COLUMNS` get columns where a row has them. A number that is None, NaN or
            absent appears as "-".
        further: Columns beside `COLUMNS`, where a row has them.
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
    details = "".join(
        f"\n{how} ({errors.count((how, one))}): {one}\n" for how, one in dict.fromkeys(errors)
    )
    columns = columns_of(rows, further)
    return (
        results_table(rows, columns)
        + _table_of_means(rows, further)
        + (legend(columns) if rows else "")
        + details
    )


def _table_of_means(rows: Sequence[Row], further: Sequence[Column]) -> str:
    """Format a table of each method's means; empty where no method has several recordings.

    Args:
        rows: Rows of an evaluation.
        further: Columns beside `COLUMNS`, where a row has them.
    """
    found = means(rows, further)
    if all(row["recordings"] < 2 for row in found):
        return ""
    columns = [column for column in columns_of(rows, further) if column[1] in found[0]]
    table = [["mean of", "recordings", *(title for title, _, _, _ in columns)]]
    for row in found:
        numbers = [format_number(row[column[1]], column) for column in columns]
        table.append([row["method"], str(row["recordings"]), *numbers])
    return "\n" + format_aligned_table(table, (0,))


def legend(columns: Sequence[Column]) -> str:
    """Format the meanings of columns that `metrics.MEASURE_MEANINGS` has as a Markdown list."""
    known = [(title, place) for title, place, _, _ in columns if place in MEASURE_MEANINGS]
    lines = [f"- {title}: {MEASURE_MEANINGS[place]}\n" for title, place in known]
    return "\n" * bool(lines) + "".join(lines)


def short_names(recordings: Iterable[str]) -> dict[str, str]:
    """Return short names by recording: the file's name, or the path where several have it."""
    given = list(dict.fromkeys(recordings))
    short = [PurePath(os.path.expandvars(one)).name for one in given]
    return {
        one: name if short.count(name) == 1 else one for one, name in zip(given, short, strict=True)
    }


def results_table(rows: Iterable[Row], columns: Sequence[Column]) -> str:
    """Format rows of results as a Markdown table.

    Args:
        rows: Rows with the keys recording and method.
        columns: Title, place in a row ("regions.well.mse"), factor and digits of each number. A
            number that is None, NaN or absent appears as "-".
    """
    rows = list(rows)
    names = short_names(row["recording"] for row in rows)
    table = [["recording", "method", *(title for title, _, _, _ in columns)]]
    for row in rows:
        numbers = [format_number(nested_value(row, column[1]), column) for column in columns]
        table.append([names[row["recording"]], row["method"], *numbers])
    return format_aligned_table(table, (0, 1))


def format_aligned_table(table: Sequence[Sequence[str]], left: Collection[int]) -> str:
    """Format cells as a Markdown table, aligned as plain text too.

    Args:
        table: Lines of cells; the first line holds titles.
        left: Indices of the columns of words; the others hold numbers, aligned to the right.
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


def align_cells(table: Sequence[Sequence[str]]) -> list[str]:
    """Format cells as lines of plain text, aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
        for line in table
    ]


def format_number(value: float | int | None, column: Column) -> str:
    """Format a number of a column.

    Args:
        value: The number, in the unit of a row.
        column: Its column: factor and digits.

    Returns:
        The text; "-" for None and NaN.
    """
    _, _, factor, digits = column
    return "-" if value is None or math.isnan(value) else f"{factor * value:.{digits}f}"


def nested_value(row: Row, path: str) -> Any:
    """Return the value at a place of a nested row, or None.

    Args:
        row: A row.
        path: Place in the row, such as "regions.well.mse".

    Returns:
        The value, or None.
    """
    value: Any = row
    for key in path.split("."):
        if key not in value:
            return None
        value = value[key]
    return value


def flatten(row: Row) -> dict[str, Any]:
    """Return a row with nested names joined by dots, those of the outermost level first."""
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


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as Parquet, with nested names joined by dots.

    Lists of numbers, as `per_frame.mse`, are columns of lists; values of several kinds are JSON
    text.

    Args:
        path: File to write; without the extra "parquet" it is removed.
        rows: Rows of an evaluation.
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
