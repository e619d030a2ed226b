"""What the fits of a configuration found: numbers with their intervals, and the gain."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxevent.confidence import ParameterInterval, confidence_intervals
from jaxevent.io.output import finite
from jaxevent.runs.fit_config import Task
from jaxevent.show.report import lay_out
from jaxevent.tuning import Batches, FitResult

TITLES = ("method", "parameter", "start", "found", "95 % interval", "unit", "")
INDEPENDENT = "measurements, taken as independent"


def find(task: Task, one: FitResult, problem: Callable[[Any], Batches]) -> list[dict[str, Any]]:
    """A row for each number that a method's fit found or searched, as results.json holds it.

    `low` and `high` are the ends of the interval, None where it is open or there is none;
    `interval` says it in words and `of` what it was told from.
    """
    told = confidence_intervals(
        task.loss, task.params, one.params, task.names, problem, task.search,
        task.settings.forward,
    )  # fmt: skip
    of = f"{told.parts} {task.goal.part}s" if told.parts else INDEPENDENT
    return [_row(task, finding, of) for finding in told.intervals]


def _row(task: Task, one: ParameterInterval, of: str) -> dict[str, Any]:
    ends = {k: None if v is None else finite(v) for k, v in (("low", one.low), ("high", one.high))}
    return {
        "method": task.label,
        "parameter": one.name,
        "unit": one.unit,
        "start": one.start,
        "found": one.value,
        **ends,
        "interval": one.interval,
        "of": "" if one.interval == "-" else of,
        "remark": one.remark,
    }


def gains(tasks: Sequence[Task], rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Of each method its error before and after, over those rows; None where it tells none."""
    found = []
    for task in tasks:
        name = task.goal.measure
        before, after = (
            _mean([row.get(name) for row in rows if row["method"] == label])
            for label in (f"{task.label}, before", task.label)
        )
        split = next((row["split"] for row in rows if row["method"] == task.label), None)
        found.append(
            {"method": task.label, "measure": name, "split": split, "before": before,
             "after": after}
        )  # fmt: skip
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return float(np.mean(told)) if told and len(told) == len(values) else None


def text(found: Sequence[Mapping[str, Any]], gained: Sequence[Mapping[str, Any]]) -> str:
    """The table of what was found, and a line for each method's gain."""
    table: list[list[str]] = [list(TITLES)]
    for row in found:
        cells = (row["method"], row["parameter"], f"{row['start']:.4g}", f"{row['found']:.4g}")
        table.append([*cells, row["interval"], row["unit"], row["remark"]])
    lines = ["\n" + lay_out(table, (0, 1, 5, 6))]
    sources: dict[str, list[str]] = {}
    for row in found:
        if row["of"] and row["method"] not in sources.setdefault(row["of"], []):
            sources[row["of"]].append(row["method"])
    for of, methods in sources.items():
        lines.append(f"\nIntervals of {', '.join(methods)}: from {of}.\n")
    for one in gained:
        if one["before"] is None or one["after"] is None:
            continue
        seen = {"test": "test data", "validation": "validation data"}.get(one["split"], "the fit")
        change = ""
        if one["measure"] != "nll" and one["before"] > 0:
            change = f" ({100 * (one['after'] / one['before'] - 1):+.0f} %)"
        pair = f"{one['before']:.4g} before, {one['after']:.4g} after"
        lines.append(f"\nGain of {one['method']}: {one['measure']} of {seen} {pair}{change}.\n")
    return "".join(lines)
