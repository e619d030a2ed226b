"""Parameters fitted to recordings, as a file describes it.

`fit` and the command `jaxevent fit CONFIG.toml` run the loop of `jaxevent.tuning` as a file
describes it:

    recordings = ["slider_depth.zip"]   # paths or globs, relative to this file; $NAME is expanded
    validation = []                     # recordings for early stopping,
    test = []                           # and those that are only scored; if neither is given,
    split = [2, 1, 1]                   # of every 4 images in turn 2 are fitted, 1, 1 are those
    size = [240, 180]                   # only for recordings that do not tell it
    window = 1.0                        # s, of mini-batches; omitted: whole recordings
    batch = 4                           # windows per step; omitted: all
    iterations = 300                    # and the other fields of `Settings`
    loss = "held-out"                   # or "reference" (protocols of `jaxevent.runs.evaluate`), or
                                        # "likelihood" of the frames that the protocol gives
    protocol = "held-out"               # with the likelihood: what is given, and scored
    error = "linear"                    # or "log", "nll"; see `objectives.Objective`
    dark_offset = 0.003                 # of the error "log"
    weights = { dark = 1, bright = 1 }  # of pixels of HDR references outside what frames record
    warm_up = 0.2                       # s that are prepared around a window

    [[method]]
    name = "akf"                        # a key of jaxevent.METHODS, or "package.module:object"
    label = "akf, mine"                 # in the results; omitted: the name
    params = { c_on = 0.08 }            # to start from, or a TOML file; omitted: defaults
    fit = ["c_on", "c_off"]             # by gradient
    search = { clock_offset = [-0.02, 0.02, 9] }  # from, to, number of points

A method may have its own loss, error, learning_rate, iterations and starts. Parameters that are
fixed when a recording is prepared have no gradient to follow; each candidate of a search is
prepared anew. Values omitted are those above, except where comments say otherwise.

The settings from `loss` on are those of reconstruction; `jaxevent.runs.blob` and
`jaxevent.runs.egomotion` tell those of the other families. All local devices are used, and several
processes fit together: `jaxevent.devices`.
"""

import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxevent import devices
from jaxevent.errors import InputError, require
from jaxevent.estimator import Estimator
from jaxevent.io import load
from jaxevent.io.output import complete
from jaxevent.methods import find
from jaxevent.parameters import Parameters, read_toml
from jaxevent.recording import Recording
from jaxevent.runs import toml
from jaxevent.runs.config import (
    NAME,
    NATURAL,
    NOT_NEGATIVE,
    PATHS,
    POSITIVE,
    SIZE,
    Check,
    check,
    find_recordings,
    is_number,
    is_texts,
    read_params,
)
from jaxevent.runs.contents import fingerprint
from jaxevent.runs.families import HOMES, family_of, find_family
from jaxevent.runs.family import Goal, Shares, Sources
from jaxevent.runs.results import results, write_rows
from jaxevent.splits import SPLITS
from jaxevent.tuning import Fitted, Interval, Run, Settings, begin, optimise

# s between checkpoints
PERIOD = 2.0


def fit(
    config: str | Path,
    out: str | Path,
    recordings: Sequence[str | Path] | None = None,
    resume: bool = False,
    progress: bool | None = None,
) -> list[dict[str, Any]]:
    """Run a fit that a TOML file describes; its layout is in the text of this module.

    Writes the folder `out`, made if missing: params.toml (a table of physical values for each
    method), results.json ({"rows": [...]}), results.md (the table of the test images), loss.csv,
    loss.png and config.toml. While it runs, `out` holds a checkpoint at most a few seconds old, by
    which an interrupted run goes on and ends with the same parameters, to the bit. Of several
    processes (`devices.join`) all read the recordings and return the rows, and the first reads and
    writes `out`.

    Args:
        config: The TOML file.
        out: The folder; earlier results in it are replaced at the end.
        recordings: To be fitted to instead of those in the file, relative to the working directory.
        resume: Go on from the checkpoint in `out`. Where the run had not got to the first one, it
            starts; where it had ended, its rows are returned.
        progress: Whether bars are shown; None: where somebody looks on.

    Returns:
        Rows as `evaluate.score` gives them, of the recordings and images of each split: `split` is
        "fit", "validation" or "test", `method` the label, with ", before" for the start values.
        Those of the tracker are described in `jaxevent.runs.blob`.

    Raises:
        InputError: The file, a recording or a parameter cannot be used, `out` cannot be written or
            holds another run's checkpoint, or matplotlib is missing (extra "plot").
    """
    devices.in_step(lambda: require("matplotlib", "plot"))
    out = Path(out)
    plan = devices.in_step(lambda: read_plan(Path(config), recordings))
    checkpoint, writes = out / "checkpoint", devices.first()
    progress = progress if writes else False

    def finished() -> list[dict[str, Any]] | None:
        """The rows of a run that had ended."""
        if checkpoint.exists() and not resume:
            raise InputError(
                f"{out}: holds the checkpoint of an interrupted fit; go on with --resume, or "
                "choose another folder"
            )
        if resume and not checkpoint.exists() and (out / "results.json").exists():
            return _finished(out, plan)
        return None

    rows = devices.by_first(finished)
    if rows is not None:
        return rows
    sources, digest = devices.in_step(lambda: (_sources(plan, progress), plan.digest()))
    if len(set(devices.gathered(digest))) > 1:
        raise InputError(
            f"{config}: the processes see different configurations or recordings; give all the same"
        )
    done: list[Fitted] = []
    with contextlib.ExitStack() as new:

        def begun() -> bytes | None:
            """The checkpoint in the folder, which is made if missing."""
            nonlocal write
            # `results` removes a folder that it made if the block raises. At the first checkpoint
            # the block ends: from then on the folder stays.
            write = new.enter_context(results(out))
            content = checkpoint.read_bytes() if checkpoint.exists() else None
            for remains in out.glob(".*.part"):  # of a write during which the run was killed
                remains.unlink(missing_ok=True)
            return content

        write: Any = None
        content, run, saved = devices.by_first(begun), None, -math.inf
        if content is not None:
            done, run = _restore(content, checkpoint, digest, plan)

        def save(run: Run | None, certain: bool) -> None:
            nonlocal saved
            if writes and (certain or time.monotonic() - saved > PERIOD):
                _save(checkpoint, digest, done, run)
                saved = time.monotonic()
            new.close()

        for task in plan.tasks[len(done) :]:
            try:
                one = optimise(
                    task.goal.loss, task.params, task.names,
                    task.goal.problem(sources, plan.split, plan.window), (),
                    task.settings, task.search,
                    run=run, save=save, progress=progress, title=task.label,
                )  # fmt: skip
            except InputError as error:
                raise InputError(f"{config}: {task.label}: {error}") from None
            run = None
            done.append(one)
            save(None, True)
        new.close()
    scored = [
        (task, label, params)
        for task, one in zip(plan.tasks, done, strict=True)
        for label, params in ((f"{task.label}, before", task.params), (task.label, one.params))
    ]
    mine = range(jax.process_index(), len(scored), jax.process_count())
    found = devices.in_step(
        lambda: {k: list(_rows(*scored[k], sources, plan, progress)) for k in mine}
    )
    told = {k: some for each in devices.gathered(found) for k, some in each.items()}
    rows = [row for k in range(len(scored)) for row in told[k]]
    if not writes:
        return rows
    write("config.toml", plan.text)
    write("loss.csv", _losses(plan.tasks, done).encode())
    write("loss.png", _curves(plan.tasks, done))
    write_rows(rows, write, lambda rows: _results(plan.tasks, unseen(rows)))
    write("params.toml", _tables(plan.tasks, done).encode())
    checkpoint.unlink()
    return rows


def _rows(
    task: "Task", label: str, params: Any, sources: Sources, plan: "Plan", progress: bool | None
) -> Iterator[dict[str, Any]]:
    for row in task.goal.score(sources, plan.split, plan.window, params, progress):
        yield {**row, "method": label}


def _results(tasks: Sequence["Task"], rows: Sequence[dict[str, Any]]) -> str:
    """results.md: one table for the methods of each system."""
    goals = {name: task.goal for task in tasks for name in (task.label, f"{task.label}, before")}
    kinds = dict.fromkeys(type(goal) for goal in goals.values())
    parts = []
    for kind in kinds:
        mine = [row for row in rows if type(goals[row["method"]]) is kind]
        parts.append(goals[mine[0]["method"]].table(mine) if mine else "")
    return "\n".join(filter(None, parts))


def unseen(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of the test images; where there are none, of the validation or the fit."""
    for split in reversed(SPLITS):
        chosen = [row for row in rows if row["split"] == split]
        if chosen:
            return chosen
    return []


@dataclasses.dataclass(frozen=True)
class Task:
    """One method of a configuration, checked."""

    label: str
    method: Estimator
    params: Parameters
    names: tuple[str, ...]
    search: Mapping[str, Interval]
    goal: Goal
    settings: Settings


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration; recordings are (as given, path) by split."""

    text: bytes
    recordings: Mapping[str, list[tuple[str, Path]]]
    tasks: list[Task]
    size: tuple[int, int] | None
    split: Shares
    window: float | int | None

    def digest(self) -> str:
        """A number that changes with the configuration, the recordings and the precision."""
        digest = hashlib.sha256(self.text)
        digest.update(repr([task.params.values() for task in self.tasks]).encode())
        digest.update(str(jnp.result_type(float)).encode())
        for split in SPLITS:
            for given, path in self.recordings[split]:
                digest.update(f"{split} {given}".encode())
                files = [path] if path.is_file() else sorted(path.rglob("*"))
                for task in self.tasks:
                    files += task.goal.files(path)
                for file in filter(Path.is_file, files):
                    fingerprint(file, digest.update)
        return digest.hexdigest()


_SETTINGS: dict[str, Check] = {
    "iterations": NATURAL,
    "learning_rate": POSITIVE,
    "patience": NATURAL,
    "every": NATURAL,
    "starts": NATURAL,
    "spread": NOT_NEGATIVE,
    "rounds": NATURAL,
    "batch": NATURAL,
    "seed": (lambda value: type(value) is int and value >= 0, "a whole number, 0 or more"),
}
_COMMON: dict[str, Check] = {
    **_SETTINGS,
    "recordings": PATHS,
    "validation": PATHS,
    "test": PATHS,
    "split": (
        lambda value: (
            isinstance(value, list)
            and len(value) == 3
            and all(type(n) is int and n >= 0 for n in value)
            and value[0] > 0
        ),
        "[fit, validation, test] in whole numbers, the first not 0",
    ),
    "size": SIZE,
    "window": POSITIVE,
    "method": (
        lambda value: isinstance(value, list) and all(isinstance(n, dict) for n in value),
        '[[method]] with name = "akf"',
    ),
}
_METHOD: dict[str, Check] = {
    **{name: _SETTINGS[name] for name in ("learning_rate", "iterations", "starts")},
    "name": NAME,
    "label": NAME,
    "params": (lambda value: isinstance(value, str | dict), "a table or the path of a TOML file"),
    "fit": (is_texts, 'a list of names, as ["c_on", "c_off"]'),
    "search": (
        lambda value: (
            isinstance(value, dict)
            and all(
                isinstance(v, list) and len(v) == 3 and all(map(is_number, v)) and type(v[2]) is int
                for v in value.values()
            )
        ),
        "a table of name = [from, to, number of points]",
    ),
}


def read_plan(config: Path, recordings: Sequence[str | Path] | None = None) -> Plan:
    """Read and check a configuration; raises `InputError` naming the file and the setting.

    `recordings` take the place of those that it names, relative to the working directory.
    """
    table = read_toml(config)
    try:
        families = {name: find_family(name) for name in HOMES}
        further = {k: v for one in families.values() for k, v in one.fit_settings.items()}
        check(table, {**_COMMON, **further})
        text = config.read_bytes()
        folders = dict.fromkeys(SPLITS, config.parent)
        if recordings:
            table = {**table, "recordings": [str(Path(one).absolute()) for one in recordings]}
            text = toml.dump(table).encode()
        found = {
            split: find_recordings(table[key], folders[split]) if table.get(key) else []
            for split, key in zip(SPLITS, ("recordings", "validation", "test"), strict=True)
        }
        if not found["fit"]:
            raise InputError('no recording is given; add recordings = ["file.zip"]')
        places = [path.resolve() for split in SPLITS for _, path in found[split]]
        twice = [path for path in places if places.count(path) > 1]
        if twice:
            raise InputError(f"{twice[0]} is in two of recordings, validation and test; choose one")
        apart = bool(found["validation"] or found["test"])
        if apart and "split" in table:
            raise InputError("split is for configurations without validation and test; omit it")
        if not table.get("method"):
            raise InputError('no method is given; add [[method]] with name = "akf"')
        tasks: list[Task] = []
        for number, entry in enumerate(table["method"], 1):
            try:
                tasks.append(_task(entry, table, config.parent))
            except InputError as error:
                raise InputError(f"method {number}: {error}") from None
        labels = [task.label for task in tasks]
        for label in labels:
            if labels.count(label) > 1:
                raise InputError(f"two methods are called {label!r}; give them different labels")
        used = {k for task in tasks for k in family_of(task.method).fit_settings}
        for name in table:
            if name in further and name not in used:
                raise InputError(f"{name} is a setting of none of these methods; omit it")
        size = table.get("size")
        return Plan(
            text,
            found,
            tasks,
            None if size is None else (size[0], size[1]),
            None if apart else tuple(table.get("split", (2, 1, 1))),
            table.get("window"),
        )
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def _task(entry: Mapping[str, Any], table: Mapping[str, Any], folder: Path) -> Task:
    name = entry.get("name")
    if not isinstance(name, str):
        raise InputError('a method has no name; give name = "akf"')
    method = find(name)
    family = family_of(method)
    check(entry, {**_METHOD, **{k: family.fit_settings[k] for k in family.own}})
    params = read_params(method.Params, name, entry.get("params", {}), folder)
    both = {**table, **entry}
    goal = family.goal(method, params, both)
    names, search = tuple(entry.get("fit", ())), entry.get("search", {})
    if not names and not search:
        raise InputError('nothing is to be fitted; give names, as fit = ["c_on", "c_off"]')
    given = {name: both[name] for name in _SETTINGS if name in both}
    settings = Settings(**given, forward=goal.forward)
    intervals = {name: (low, high, count) for name, (low, high, count) in search.items()}
    begin(params, names, settings, intervals)  # checks the names
    return Task(entry.get("label", name), method, params, names, intervals, goal, settings)


def _sources(plan: Plan, progress: bool | None) -> Sources:
    return {
        split: [(given, _load(path, plan, progress)) for given, path in plan.recordings[split]]
        for split in SPLITS
    }


def _load(path: Path, plan: Plan, progress: bool | None) -> Recording:
    recording = load(path, plan.size, in_memory=False, progress=progress)
    return dataclasses.replace(recording, name=str(path))  # for messages


def _save(path: Path, digest: str, done: Sequence[Fitted], run: Run | None) -> None:
    """Write a checkpoint: a line of JSON, then the arrays as equinox stores them."""
    header = {
        "digest": digest,
        "done": [[one.loss, one.history] for one in done],
        "run": None if run is None else [run.stage, run.iteration, run.tried, run.history],
    }
    arrays = [one.params.raw for one in done], None if run is None else run.position
    with complete(path) as partial, partial.open("wb") as file:
        file.write(json.dumps(header).encode() + b"\n")
        eqx.tree_serialise_leaves(file, arrays)


def _restore(
    content: bytes, path: Path, digest: str, plan: Plan
) -> tuple[list[Fitted], Run | None]:
    """The methods done and the one under way, if any, of a checkpoint."""
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
    done = [
        Fitted(task.params.with_raw(raw), *rest)
        for task, raw, rest in zip(tasks, raws, ended, strict=True)
    ]
    return done, None if under_way is None else Run(position, *under_way)


def _finished(out: Path, plan: Plan) -> list[dict[str, Any]]:
    """The rows of a run that had ended; raises `InputError` if it was another one."""
    try:
        same = (out / "config.toml").read_bytes() == plan.text
        rows = json.loads((out / "results.json").read_bytes())["rows"] if same else []
    except (OSError, ValueError, KeyError):
        same, rows = False, []
    given = {name for split in SPLITS for name, _ in plan.recordings[split]}
    if not same or {row["recording"] for row in rows} != given:
        raise InputError(
            f"{out}: holds results of another run and no checkpoint; leave out --resume to replace "
            "them, or choose another folder"
        )
    return rows


def _losses(tasks: Sequence[Task], done: Sequence[Fitted]) -> str:
    """loss.csv; empty where a loss was not computed."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["method", "start", "round", "iteration", "fit", "validation"])
    for task, one in zip(tasks, done, strict=True):
        table.writerows([task.label, *line] for line in one.history)
    return text.getvalue()


def _curves(tasks: Sequence[Task], done: Sequence[Fitted]) -> bytes:
    """loss.png: the losses of every method over iterations, a line for each start."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3 * len(tasks)), layout="constrained")
    for task, one, axis in zip(
        tasks, done, figure.subplots(len(tasks), squeeze=False)[:, 0], strict=True
    ):
        for start in range(task.settings.starts):
            lines = [line for line in one.history if line[0] == start]
            for column, colour, name in ((3, "C0", "fit"), (4, "C1", "validation")):
                seen = [line for line in lines if line[column] is not None]
                at = [line[1] * task.settings.iterations + line[2] for line in seen]
                losses = [line[column] for line in seen]
                axis.plot(at, losses, colour, lw=1, label=name if start == 0 else None)
        axis.set(title=task.label, xlabel="iteration", ylabel="loss")
        axis.legend(frameon=False)
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=120)
    return image.getvalue()


def _tables(tasks: Sequence[Task], done: Sequence[Fitted]) -> str:
    """params.toml: a table for each method."""
    pairs = zip(tasks, done, strict=True)
    return "\n".join(
        f"[{toml.key(task.label)}]\n{toml.parameters(one.params)}\n" for task, one in pairs
    )
