"""Fits of parameters to recordings, described by a configuration file.

`fit` and the command `jaxevent fit CONFIG.toml` run the optimiser of `jaxevent.tuning` with these
settings:

    recordings = ["slider_depth.zip"]   # paths or globs, relative to this file; $NAME is expanded;
                                        # "mvsec:FOLDER": all of a data set
    validation = []                     # recordings for early stopping
    test = []                           # recordings that are only scored; if neither is given,
    split = [2, 1, 1]                   # of every 4 images 2 are for the fit, 1 for early stopping,
                                        # and 1 is only scored
    size = [240, 180]                   # only for recordings that do not state it
    stream = "left"                     # only for files of several cameras
    window = 1.0                        # s, of mini-batches; omitted: whole recordings
    batch = 4                           # windows per step; omitted: all
    iterations = 300                    # and the other fields of `Settings`
    loss = "held-out"                   # or "reference" (protocols of `jaxevent.runs.evaluate`), or
                                        # "likelihood" of the frames that the protocol gives
    protocol = "held-out"               # for the likelihood: protocol of frames given and scored
    error = "linear"                    # or "log", "nll"; see `jaxevent.runs.reconstruction`
    dark_offset = 0.003                 # of the error "log"
    weights = { dark = 1, bright = 1 }  # of pixels of HDR references outside what frames record
    calibrate = false                   # start from the defaults, see below
    warm_up = 0.2                       # s of data that are prepared around a window
    gap = 2                             # for the protocol "held-out": every gap-th frame is given

    [[method]]
    name = "akf"                        # a key of jaxevent.METHODS, or "package.module:object"
    label = "akf, mine"                 # in the results; omitted: the name
    params = { c_on = 0.08 }            # initial values, or a TOML file; omitted:
                                        # calibrated, else defaults
    fit = ["c_on", "c_off"]             # by gradient
    search = { clock_offset = [-0.02, 0.02, 9] }  # from, to, number of points
    prior = { c_on = [0.1, 0.5] }       # expected value, standard deviation of its logarithm
    prior_weight = 1.0                  # twice what one standard deviation adds to the loss

Clock and thresholds that `params` does not give start from a calibration with the given frames
(`jaxevent.calibration`), the median over the recordings to fit, unless `calibrate` is false.

A method may have its own calibrate, loss, error, learning_rate, iterations, starts and
prior_weight. Parameters that act when a recording is prepared have no gradient; they are searched,
and each candidate of a search is prepared anew. Defaults are the values above, except where
comments say otherwise, and no prior.

The settings from `loss` on are those of reconstruction; `jaxevent.runs.blob` and
`jaxevent.runs.egomotion` describe those of the other families. Several processes can share a fit:
see `jaxevent.processes`.
"""

import contextlib
import csv
import dataclasses
import io
import json
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import jax

from jaxevent import processes
from jaxevent.display import describe_type
from jaxevent.errors import InputError, InputWarning, MissingExtra
from jaxevent.io import load, toml
from jaxevent.progress import stage
from jaxevent.recording import Recording
from jaxevent.runs.calls import (
    CALL_HEADER,
    CallForms,
    PathLike,
    recordings_of,
    settings_of,
    table_with_names,
)
from jaxevent.runs.contents import digest
from jaxevent.runs.family import SPLIT_NAMES, FitData
from jaxevent.runs.fit_config import Plan, Task, plan_of, read_plan
from jaxevent.runs.results import (
    Fits,
    check_folder,
    compute_gains,
    find_intervals,
    finished_rows,
    format_findings,
    lock_folder,
    open_results,
    restore_checkpoint,
    save_checkpoint,
    write_rows,
)
from jaxevent.show import plot_losses
from jaxevent.tuning import FitResult, Run, optimise

CHECKPOINT_FILE = "checkpoint"  # the name of the file in the folder
RESULT_FILES = ("params.toml", "results.json", "results.md", "loss.csv", "loss.png", "config.toml")
DIVERGED_WARNING = (
    "{}: the fit diverged, to a greater loss than at the start or none that is finite; the "
    "parameters are the best that were seen, so lower learning_rate or start elsewhere"
)
CHECKPOINT_PERIOD_S = 2.0  # s between checkpoints


@overload
def fit(
    config: PathLike,
    out: PathLike,
    recordings: Sequence[Any] | None = None,
    resume: bool = False,
    progress: bool | None = None,
    replace: bool = True,
    calibrate: bool | None = None,
) -> Fits: ...


@overload
def fit(
    recordings: Any,
    method: Any,
    *,
    fit: Sequence[str] = (),
    search: Mapping[str, Sequence[float | int]] | None = None,
    params: Any = None,
    validation: Any = None,
    test: Any = None,
    out: PathLike | None = None,
    resume: bool = False,
    progress: bool | None = None,
    replace: bool = True,
    **settings: Any,
) -> Fits: ...


def fit(*arguments: Any, **settings: Any) -> Fits:
    """Fit parameters of methods to recordings.

        fit("config.toml", "fitted")
        fitted = fit(recording, akf, fit=["c_on", "c_off"])
        fitted.params.c_on

    The first form runs a configuration in TOML; the text of this module describes its layout. The
    second fits one method and takes the same settings as Python objects.

    Writes the folder `out`, made if missing: params.toml (a table of physical values for each
    method), results.json ({"rows": [...], "found": [...], "gains": [...]}), results.md, loss.csv,
    loss.png (with the extra "plot") and config.toml. results.md has the scores on the test images,
    every fitted number with its initial value and interval (`jaxevent.confidence`), numbers that
    reached a bound or diverged, and the gain. During the fit `out` holds a checkpoint at most a few
    seconds old. An interrupted run that is resumed from it ends with exactly the same parameters.
    With several processes (`processes.join`) all read the recordings and return the rows, and the
    first one reads and writes `out`.

    Args:
        config: The TOML file.
        recordings: Recordings to fit to: a `Recording` or a path, a list of them, or a mapping from
            names. With a file, a list that replaces the file's.
        method: A name, an `Estimator`, or "package.module:object".
        fit: Names of parameters to fit by gradient.
        search: Names of parameters to search, each with (from, to, number of points).
        params: Initial values: the method's `Params`, a mapping, or the path of a TOML file.
        validation: Recordings for early stopping; omitted, a share of the images or windows.
        test: Recordings that are only scored; omitted, a share of the images or windows.
        out: The folder; earlier results in it are replaced at the end. With objects it may be
            omitted, and nothing is written.
        resume: Continue from the checkpoint in `out`. A run without a checkpoint starts anew; of
            a finished run the rows are returned.
        progress: Whether to show bars; None shows them in a terminal or notebook.
        replace: Whether files in `out` that do not belong to the resumed fit may be replaced.
        calibrate: Whether clock and thresholds that are not given start from a calibration of the
            recordings; None: as the file says, or true.
        **settings: The other settings of a configuration, such as `iterations=100` or `window=0.5`.
            `positions` and `truth` also take a DataFrame, or a mapping from recordings' names to
            DataFrames.

    Returns:
        Rows for the recordings and images of each split, like those of `evaluate`, with the fitted
        `params`: see `Fits`. `split` is "fit", "validation" or "test"; `method` is the label, with
        ", before" for the initial values. `warning` is present if the fit diverged, so that the
        result is the best point seen. Rows of trackers are described in `jaxevent.runs.blob`.

    Raises:
        InputError: The file, a recording or a parameter cannot be used, or `out` cannot be written,
            holds another run's checkpoint or is in use by another process.
    """
    if CALL_FORMS.is_config(arguments, settings):
        return _fit_file(*arguments, **settings)
    return _fit_objects(*arguments, **settings)


CALL_FORMS = CallForms(
    'jaxevent.fit(recording, akf, fit=["c_on"])',
    ("config", "out", "recordings", "resume", "progress", "replace", "calibrate"),
    ("method", "fit", "search", "params"),
)


def _fit_file(
    config: PathLike,
    out: PathLike | None = None,
    recordings: Sequence[Any] | None = None,
    resume: bool = False,
    progress: bool | None = None,
    replace: bool = True,
    calibrate: bool | None = None,
) -> Fits:
    if out is None:
        raise InputError(f"{config}: out is missing; give the folder of the results")
    plan = processes.on_all_processes(lambda: read_plan(Path(config), recordings, calibrate))
    return _run_plan(plan, Path(out), resume, progress, replace)


def _fit_objects(
    recordings: Any = None,
    method: Any = None,
    *,
    out: PathLike | None = None,
    resume: bool = False,
    progress: bool | None = None,
    replace: bool = True,
    **settings: Any,
) -> Fits:
    if method is None:
        raise InputError(f"no method is given; give a recording and one, as {CALL_FORMS.example}")
    if isinstance(method, list | dict | type):
        raise InputError(
            f"the method is {describe_type(method)}; give one Estimator, or its name, and fit "
            "others apart"
        )
    given = settings_of(settings)
    entry = {"name": method, **{k: given.pop(k) for k in METHOD_SETTINGS if k in given}}
    table = {"recordings": recordings_of(recordings), **given, "method": [entry]}
    for split in ("validation", "test"):
        if split in table:
            table[split] = recordings_of(settings[split])
    if resume and out is None:
        raise InputError("resume goes on from the checkpoint in out; give out")
    text = CALL_HEADER + toml.dump(table_with_names(table))
    plan = processes.on_all_processes(lambda: plan_of(table, Path(), None, text.encode()))
    if out is None:
        return _run_plan(plan, None, resume, progress, replace)
    # `resume` recognises the recordings of a finished run by these lines.
    lines = [
        f"# {toml.text(name)} holds {digest(recording)}\n"
        for split in SPLIT_NAMES
        for name, recording in plan.recordings[split]
        if isinstance(recording, Recording)
    ]
    plan = dataclasses.replace(plan, text="".join(lines).encode() + plan.text)
    return _run_plan(plan, Path(out), resume, progress, replace)


# Settings of a method, not of the file.
METHOD_SETTINGS = ("fit", "search", "params", "label", "prior")


def _run_plan(
    plan: Plan, out: Path | None, resume: bool, progress: bool | None, replace: bool
) -> Fits:
    """Fit the methods of a plan; see `fit`."""
    progress = progress if processes.is_process_zero() else False
    with contextlib.ExitStack() as held:
        if out is not None:
            rows = processes.on_process_zero(
                lambda: _finished_run_rows(out, plan, resume, replace, held)
            )
            if rows is not None:
                return _read_finished_run(rows, out, plan)
        data = processes.on_all_processes(lambda: _load_all(plan, progress))
        plan = processes.on_all_processes(lambda: calibrate_plan(plan, data))
        key = ""
        if out is not None or not processes.is_single():
            key = processes.on_all_processes(plan.digest)
        if len(set(processes.allgather(key))) > 1:
            raise InputError(
                f"{plan.where()}the processes see different configurations or recordings; give all "
                "the same"
            )
        done, found, write = _fit_tasks(plan, data, key, out, progress, held)
        with warnings.catch_warnings():
            # At the start of a fit thresholds need not be the sensor's.
            warnings.filterwarnings("ignore", ".*events contradict frames", InputWarning)
            rows = _score(plan, done, data, progress)
        params = {t.label: one.params for t, one in zip(plan.tasks, done, strict=True)}
        gained = compute_gains(plan.tasks, rows_outside_fit(rows))
        fits = Fits(rows, params, found, gained, _format_report(plan.tasks, rows, found, gained))
        if out is None or not processes.is_process_zero():
            return fits
        write("config.toml", plan.text)
        write("loss.csv", _format_losses(plan.tasks, done).encode())
        try:
            write("loss.png", _draw_losses(plan.tasks, done))
        except MissingExtra:
            (out / "loss.png").unlink(missing_ok=True)  # that of a run before
        write_rows(rows, write, lambda _: fits.table(), found=found, gains=gained)
        write("params.toml", _format_params(plan.tasks, done).encode())
        (out / CHECKPOINT_FILE).unlink()
    return fits


def calibrate_plan(plan: Plan, data: FitData) -> Plan:
    """Return a plan whose fits start from a calibration of the recordings.

    Args:
        plan: The plan.
        data: Recordings of the plan.

    Returns:
        The plan with other initial parameters.
    """
    tasks = [
        dataclasses.replace(task, params=task.goal.calibrate(data, task.params, task.left_open))
        for task in plan.tasks
    ]
    return dataclasses.replace(plan, tasks=tasks)


def _format_report(tasks: Sequence[Task], rows: Any, found: Any, gained: Any) -> str:
    """Format results.md: the scores on images outside the fit, the numbers found, and the gain.

    Args:
        tasks: Methods of the fit.
        rows: Scores.
        found: Numbers found, with their intervals.
        gained: Gains of the methods.
    """
    return _format_scores(tasks, rows_outside_fit(rows)) + format_findings(found, gained)


def _read_finished_run(rows: list[dict[str, Any]], out: Path, plan: Plan) -> Fits:
    """Read the result of a finished run from its folder.

    Args:
        rows: Scores of the run.
        out: The folder.
        plan: Plan of the run.
    """
    kept = json.loads((out / "results.json").read_bytes())
    params = {
        task.label: task.method.Params.load(out / "params.toml", task.label) for task in plan.tasks
    }
    found, gained = kept.get("found", []), kept.get("gains", [])
    return Fits(rows, params, found, gained, _format_report(plan.tasks, rows, found, gained))


def _finished_run_rows(
    out: Path, plan: Plan, resume: bool, replace: bool, held: contextlib.ExitStack
) -> list[dict[str, Any]] | None:
    """Return the rows of a finished run that is resumed; None if the fit must be computed.

    An existing folder is locked until the stack is closed.

    Args:
        out: Folder of the results.
        plan: The plan.
        resume: Whether to resume a run.
        replace: Whether existing files may be replaced.
        held: Stack that holds the lock of the folder.

    Returns:
        The rows, or None.

    Raises:
        InputError: The folder holds the checkpoint of an interrupted fit that is not resumed, or
            files that may not be replaced.
    """
    if out.is_dir():
        held.enter_context(lock_folder(out))
    checkpoint = out / CHECKPOINT_FILE
    if checkpoint.exists() and not resume:
        raise InputError(
            f"{out}: holds the checkpoint of an interrupted fit; go on with --resume, or choose "
            "another folder"
        )
    if resume and not checkpoint.exists() and (out / "results.json").exists():
        return finished_rows(out, plan)
    check_folder(out, RESULT_FILES, plan.inputs(), replace=replace, own=checkpoint.exists())
    return None


def _fit_tasks(
    plan: Plan,
    data: FitData,
    key: str,
    out: Path | None,
    progress: bool | None,
    held: contextlib.ExitStack,
) -> tuple[list[FitResult], list[dict[str, Any]], Any]:
    """Fit all methods, starting from the checkpoint in the folder if there is one.

    The folder is made if missing, and locked until the stack is closed.

    Args:
        plan: The plan.
        data: Recordings of the plan.
        key: Hash of the plan, which must match the checkpoint's.
        out: Folder of the results, or None.
        progress: Whether to show progress.
        held: Stack that holds the lock of the folder.

    Returns:
        The fits, rows about the fitted numbers, and the function that writes to the folder.

    Raises:
        InputError: A fit cannot be done; the message names the method.
    """
    saved = -math.inf
    done: list[FitResult] = []
    found: list[dict[str, Any]] = []
    run: Run | None = None
    write: Any = None
    with contextlib.ExitStack() as new:

        def open_folder(out: Path) -> bytes | None:
            """Open the folder and return the content of its checkpoint, if any."""
            nonlocal write
            # `open_results` removes a folder that it made if its block raises. The block ends at
            # the first checkpoint; from then on the folder stays.
            missing = not out.exists()
            write = new.enter_context(open_results(out))
            if missing:
                held.enter_context(lock_folder(out))
            checkpoint = out / CHECKPOINT_FILE
            content = checkpoint.read_bytes() if checkpoint.exists() else None
            for remains in out.glob(".*.part"):  # of an interrupted write
                remains.unlink(missing_ok=True)
            return content

        if out is not None:
            content = processes.on_process_zero(lambda: open_folder(out))
            if content is not None:
                done, run = restore_checkpoint(content, out / CHECKPOINT_FILE, key, plan)

        def keep(run: Run | None, certain: bool) -> None:
            nonlocal saved
            if out is None:
                return
            if processes.is_process_zero() and (
                certain or time.monotonic() - saved > CHECKPOINT_PERIOD_S
            ):
                save_checkpoint(out / CHECKPOINT_FILE, key, done, run)
                saved = time.monotonic()
            new.close()

        for number, task in enumerate(plan.tasks):
            try:
                problem = task.goal.problem(data)
                if number == len(done):
                    one = optimise(
                        task.loss, task.params, task.names, problem, (),
                        task.settings, task.search,
                        run=run, save=keep, progress=progress, title=task.label,
                    )  # fmt: skip
                    run = None
                    done.append(one)
                    keep(None, True)
            except InputError as error:
                raise InputError(f"{plan.where()}{task.label}: {error}") from None
            with stage(f"{task.label}: intervals", progress):
                found += find_intervals(task, done[number], problem)
        new.close()
    return done, found, write


def _score(
    plan: Plan, done: Sequence[FitResult], data: FitData, progress: bool | None
) -> list[dict[str, Any]]:
    """Score all methods with their initial and their fitted parameters, shared among processes."""
    scored: list[tuple[Task, str, Any, dict[str, str]]] = []
    for task, one in zip(plan.tasks, done, strict=True):
        warning = {"warning": DIVERGED_WARNING.format(task.label)} if one.diverged else {}
        scored.append((task, f"{task.label}, before", task.params, {}))
        scored.append((task, task.label, one.params, warning))
    mine = range(jax.process_index(), len(scored), jax.process_count())

    def score(task: Task, label: str, params: Any, warning: dict[str, str]) -> list[dict[str, Any]]:
        rows = task.goal.score(data, params, progress)
        return [{**row, "method": label, **warning} for row in rows]

    found = processes.on_all_processes(lambda: {k: score(*scored[k]) for k in mine})
    gathered = {k: some for each in processes.allgather(found) for k, some in each.items()}
    return [row for k in range(len(scored)) for row in gathered[k]]


def _format_scores(tasks: Sequence[Task], rows: Sequence[dict[str, Any]]) -> str:
    """Format the scores of results.md: one table for the methods of each family.

    Args:
        tasks: Methods of the fit.
        rows: Scores.
    """
    goals = {name: task.goal for task in tasks for name in (task.label, f"{task.label}, before")}
    kinds = dict.fromkeys(type(goal) for goal in goals.values())
    parts = []
    for kind in kinds:
        mine = [row for row in rows if type(goals[row["method"]]) is kind]
        parts.append(goals[mine[0]["method"]].table(mine) if mine else "")
    return "\n".join(filter(None, parts))


def rows_outside_fit(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the test images, else those of the validation, else those of the fit."""

    for split in reversed(SPLIT_NAMES):
        chosen = [row for row in rows if row["split"] == split]
        if chosen:
            return chosen
    return []


def _load_all(plan: Plan, progress: bool | None) -> FitData:
    sources = {
        split: [(given, _load(given, one, plan, progress)) for given, one in plan.recordings[split]]
        for split in SPLIT_NAMES
    }
    return FitData(sources, plan.split, plan.window)


def _load(given: str, path: Path | Recording, plan: Plan, progress: bool | None) -> Recording:
    if isinstance(path, Recording):
        return dataclasses.replace(path, name=given)
    recording = load(path, plan.size, in_memory=False, progress=progress, stream=plan.stream)
    return dataclasses.replace(recording, name=str(path))  # for messages


def _format_losses(tasks: Sequence[Task], done: Sequence[FitResult]) -> str:
    """Format loss.csv; a field is empty where a loss was not computed."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["method", "start", "round", "iteration", "fit", "validation"])
    for task, one in zip(tasks, done, strict=True):
        table.writerows([task.label, *line] for line in one.history)
    return text.getvalue()


def _draw_losses(tasks: Sequence[Task], done: Sequence[FitResult]) -> bytes:
    """Draw loss.png: the losses of every method over iterations, a line for each start."""
    figure = plot_losses(done, [task.label for task in tasks])
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=120)
    return image.getvalue()


def _format_params(tasks: Sequence[Task], done: Sequence[FitResult]) -> str:
    """Format params.toml: a table for each method."""
    pairs = zip(tasks, done, strict=True)
    return "\n".join(
        f"[{toml.key(task.label)}]\n{toml.parameters(one.params)}\n" for task, one in pairs
    )
