"""Results of evaluations and fits: rows, a folder that is complete or not made, checkpoints."""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxevent.errors import InputError
from jaxevent.io.output import check_outputs, complete, locked
from jaxevent.parameters import Parameters
from jaxevent.show.tables import flatten, markdown_table, means

if TYPE_CHECKING:
    import pandas


import io

import equinox as eqx
import numpy as np

from jaxevent.confidence import ParameterInterval, confidence_intervals
from jaxevent.io.output import finite
from jaxevent.runs.family import SPLIT_NAMES
from jaxevent.runs.fit_config import Plan, Task
from jaxevent.show.tables import Row, format_aligned_table
from jaxevent.tuning import Batches, FitResult, RoughNumber, Run, begin

Write = Callable[[str, bytes], None]


class Rows(list[dict[str, Any]]):
    """Rows of results: a list of dicts with a table as its text."""

    def __repr__(self) -> str:
        return self.table()

    def table(self) -> str:
        """Format the rows as a Markdown table, aligned as plain text too."""
        return markdown_table(self)

    def to_dataframe(self) -> "pandas.DataFrame":
        """Convert the rows to a pandas table.

        Nested names are joined by dots, lists are left out.
        """
        import pandas

        flat = [flatten(row) for row in self]
        return pandas.DataFrame(
            [{k: v for k, v in row.items() if not isinstance(v, list)} for row in flat]
        )


class Evaluation(Rows):
    """Rows of `evaluate`, with the means of each method over recordings."""

    def means(self) -> "pandas.DataFrame":
        """Average over recordings: a line for each method, with the number of recordings.

        NaN where no recording has the number.
        """
        import pandas

        return pandas.DataFrame(means(self)).set_index("method")


class Fits(Rows):
    """Rows of `fit`, scores before and after, with the parameters that were found.

    Attributes:
        params_by_method: The fitted `Params` of each method, by label.
        found: A dict for each number that was fitted: `method`, `parameter`, `unit`, `start`,
            `found`, the ends `low` and `high` of its interval, `interval` in words, `remark`, and
            where the loss is rough `gradient_skill`, see `jaxevent.tuning.gradient_skill`.
        gains: A dict for each method: its error `before` and `after`, by `measure`.
    """

    def __init__(
        self,
        rows: Iterable[dict[str, Any]],
        params: Mapping[str, Parameters],
        found: list[dict[str, Any]],
        gains: list[dict[str, Any]],
        text: str,
    ):
        super().__init__(rows)
        self.params_by_method, self.found, self.gains = dict(params), found, gains
        self._text = text

    @property
    def params(self) -> Any:
        """The fitted `Params`; raises `InputError` if several methods were fitted."""
        if len(self.params_by_method) > 1:
            labels = ", ".join(map(repr, self.params_by_method))
            raise InputError(
                f"several methods were fitted; choose one, as params_by_method[...] of {labels}"
            )
        return next(iter(self.params_by_method.values()))

    def table(self) -> str:
        """Format the scores of unseen data, the parameters found, and the gain, as Markdown."""
        return self._text


def check_folder(
    folder: Path,
    names: Sequence[str],
    inputs: Sequence[Path] = (),
    *,
    replace: bool,
    own: bool = False,
) -> None:
    """Raise `InputError` if files of these names cannot be written into a folder safely.

    Inputs are never overwritten. Existing files are only if they may be replaced, or if the folder
    is of a run that continues: the caller's own. See `jaxevent.io.output.check_outputs`.

    Args:
        folder: The folder.
        names: Names of the files.
        inputs: Input files.
        replace: Whether existing files may be replaced.
        own: Whether the folder is of a run that continues.
    """
    files = [folder / name for name in names]
    check_outputs(files, inputs, force=replace, inside=files if own else ())


def write_rows(
    rows: Iterable[dict[str, Any]],
    write: Write,
    table: Callable[[list[dict[str, Any]]], str] = markdown_table,
    **more: Any,
) -> None:
    """Write results.json and results.md.

    Args:
        rows: Rows of results.
        write: The function that `results` gives.
        table: A function from rows to the text of results.md.
        **more: Further entries of results.json.
    """
    rows = list(rows)
    text = json.dumps({"rows": rows, **more}, indent=1, allow_nan=False) + "\n"
    write("results.json", text.encode())
    write("results.md", table(rows).encode())


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock an existing folder; raise `InputError` if another process holds it."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder))
        except BlockingIOError:
            raise InputError(
                f"{folder}: another process writes there; wait for it, or choose another folder"
            ) from None
        yield


@contextlib.contextmanager
def open_results(folder: Path) -> Iterator[Write]:
    """Open a folder for results, made if missing; gives the function `write(name, content)`.

    A folder made here is removed again if the block raises, unless it holds finished tasks. Raises
    `InputError` if the folder cannot be made.
    """
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be made ({error.strerror}); choose a place for a new "
            "folder in an existing, writable one"
        ) from None

    def write(name: str, content: bytes) -> None:
        with complete(folder / name) as partial:
            partial.write_bytes(content)

    try:
        if not os.access(folder, os.W_OK):  # before hours of computing
            raise InputError(f"{folder}: is not writable; choose another folder")
        yield write
    except BaseException:
        if made and not any(folder.glob("tasks/*.json")):
            shutil.rmtree(folder, ignore_errors=True)
        raise


WORSE_REMARK = "The fit of {} made {} worse: keep the parameters from before, or fit to more data."
INTERVAL_COLUMNS = ("method", "parameter", "start", "found", "95 % interval", "unit", "")
MIN_TOLD_LOST_SHARE = 0.01  # of the time, lost beside what was lost before the fit
INDEPENDENT_MEASUREMENTS = "measurements, taken as independent"


def find_intervals(
    task: Task, one: FitResult, problem: Callable[[Any], Batches]
) -> list[dict[str, Any]]:
    """Compute the confidence intervals of a fit, as results.json holds them.

    Args:
        task: Fit of a method.
        one: Result of the fit.
        problem: Function that makes the batches for parameters; see `confidence_intervals`.

    Returns:
        A row for each number that the fit estimated or searched. `low` and `high` are the ends of
        the interval, None if it is open or undetermined; `interval` describes it in words, and `of`
        names the independent parts of the data.
    """
    fitted = confidence_intervals(
        task.loss, task.params, one.params, task.names, problem, task.search,
        task.settings.forward,
    )  # fmt: skip
    of = f"{fitted.parts} {task.goal.part_name}s" if fitted.parts else INDEPENDENT_MEASUREMENTS
    return [_row(task, finding, of, one.rough) for finding in fitted.intervals]


def _row(
    task: Task, one: ParameterInterval, of: str, rough: Mapping[str, RoughNumber]
) -> dict[str, Any]:
    remark = one.remark
    searched = rough.get(one.name.partition("[")[0])
    if searched is not None:
        first = f"rough loss: searched first, to {searched.searched:.4g}"
        remark = "; ".join(filter(None, (first, remark)))
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
        "remark": remark,
        "gradient_skill": None if searched is None else searched.skill,
    }


def compute_gains(tasks: Sequence[Task], rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Compute the mean error of each method before and after its fit.

    Args:
        tasks: Fits of methods.
        rows: Scores before and after the fits.

    Returns:
        For each method `method`, `measure`, `split`, and the error `before` and `after`; None if
        unknown. Of motions also `lost`, the shares of the time without estimates before and after.
    """
    found = []
    for task in tasks:
        name, labels = task.goal.measure, (f"{task.label}, before", task.label)

        def mean(of: str, label: str) -> float | None:
            return _mean([row.get(of) for row in rows if row["method"] == label])

        (before, after), lost = ([mean(of, label) for label in labels] for of in (name, "lost"))
        split = next((row["split"] for row in rows if row["method"] == task.label), None)
        gain = {"method": task.label, "measure": name, "split": split}
        gain |= {"before": before, "after": after}
        found.append(gain if None in lost else {**gain, "lost": lost})
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def format_findings(found: Sequence[Mapping[str, Any]], gained: Sequence[Mapping[str, Any]]) -> str:
    """Format a table of the numbers found, and a line for the gain of each method.

    Args:
        found: Rows of `find_intervals`.
        gained: Rows of `compute_gains`.

    Returns:
        The text.
    """
    table: list[list[str]] = [list(INTERVAL_COLUMNS)]
    for row in found:
        cells = (row["method"], row["parameter"], f"{row['start']:.4g}", f"{row['found']:.4g}")
        table.append([*cells, row["interval"], row["unit"], row["remark"]])
    lines = ["\n" + format_aligned_table(table, (0, 1, 5, 6))]
    sources: dict[str, list[str]] = {}
    for row in found:
        if row["of"] and row["method"] not in sources.setdefault(row["of"], []):
            sources[row["of"]].append(row["method"])
    for of, methods in sources.items():
        lines.append(f"\nIntervals of {', '.join(methods)}: from {of}.\n")
    rough = [row for row in found if row["gradient_skill"] is not None]
    for row in rough:
        lines.append(
            f"\nThe loss of {row['method']} is rough in {row['parameter']}: where the fit starts, "
            f"the gradient predicts its changes with a skill of {row['gradient_skill']:.2g} (1: "
            "exactly, 0: no better than no change). It was searched before the first step.\n"
        )
    for one in gained:
        if one["before"] is None or one["after"] is None:
            continue
        seen = {"test": "test data", "validation": "validation data"}.get(one["split"], "the fit")
        change = ""
        if one["measure"] != "nll" and one["before"] > 0:
            change = f" ({100 * (one['after'] / one['before'] - 1):+.0f} %)"
        pair = f"{one['before']:.4g} before, {one['after']:.4g} after"
        # An error is that of what is estimated: a fit may lower it by estimating less.
        before, after = one.get("lost") or (0.0, 0.0)
        if after >= before + MIN_TOLD_LOST_SHARE:
            change += f", but {100 * after:.0f} % of the time is lost, {100 * before:.0f} % before"
        lines.append(f"\nGain of {one['method']}: {one['measure']} of {seen} {pair}{change}.\n")
        if one["after"] > one["before"]:
            lines.append(f"\n{WORSE_REMARK.format(one['method'], seen)}\n")
        if one["after"] > one["before"]:
            lines.append(f"\n{WORSE_REMARK.format(one['method'], seen)}\n")
    return "".join(lines)


def save_checkpoint(path: Path, digest: str, done: Sequence[FitResult], run: Run | None) -> None:
    """Write a checkpoint: a line of JSON, then the arrays as equinox stores them."""
    header = {
        "digest": digest,
        "done": [[one.loss, one.history, one.rough] for one in done],
        "run": None
        if run is None
        else [run.stage, run.iteration, run.tried, run.history, run.rough],
    }
    arrays = [one.params.raw for one in done], None if run is None else run.position
    with complete(path) as partial, partial.open("wb") as file:
        file.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(file, arrays)


def restore_checkpoint(
    content: bytes, path: Path, digest: str, plan: Plan
) -> tuple[list[FitResult], Run | None]:
    """Read the finished methods of a checkpoint, and the unfinished one, if any."""
    with io.BytesIO(content) as file:
        try:
            header = json.loads(file.readline())
            if header["digest"] != digest:
                raise InputError(
                    f"{path}: is of another configuration, other recordings or another precision; "
                    "go on with the same ones, or choose another folder"
                )
            ended, under_way = header["done"], header["run"]
            tasks = plan.tasks[: len(ended)]
            run = None
            if under_way is not None:
                task = plan.tasks[len(ended)]
                run = begin(task.params, task.names, task.settings, task.search)
            like = [task.params.raw for task in tasks], None if run is None else run.position
            raws, position = eqx.tree_deserialise_leaves(file, like)
        except (ValueError, KeyError, TypeError, RuntimeError, EOFError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is not a checkpoint; remove it to start anew") from error
    for one in [*ended, *filter(None, [under_way])]:
        one[-1] = {name: RoughNumber(*values) for name, values in one[-1].items()}
    done = [
        FitResult(task.params.with_raw(raw), *rest)
        for task, raw, rest in zip(tasks, raws, ended, strict=True)
    ]
    return done, None if under_way is None else Run(position, *under_way)


def finished_rows(out: Path, plan: Plan) -> list[dict[str, Any]]:
    """Read the rows of a run that had ended; raise `InputError` if it was another run."""
    try:
        same = (out / "config.toml").read_bytes() == plan.text
        rows = json.loads((out / "results.json").read_bytes())["rows"] if same else []
    except (OSError, ValueError, KeyError):
        same, rows = False, []
    given = {name for split in SPLIT_NAMES for name, _ in plan.recordings[split]}
    if not same or {row["recording"] for row in rows} != given:
        raise InputError(
            f"{out}: holds results of another run and no checkpoint; leave out --resume to replace "
            "them, or choose another folder"
        )
    return rows
