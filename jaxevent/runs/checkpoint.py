"""Checkpoints of a fit: what it needs to go on, bound to what it is fitted to."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx

from jaxevent.errors import InputError
from jaxevent.io.output import complete
from jaxevent.runs.fit_config import Plan
from jaxevent.splits import SPLITS
from jaxevent.tuning import FitResult, Run, begin


def save(path: Path, digest: str, done: Sequence[FitResult], run: Run | None) -> None:
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


def restore(
    content: bytes, path: Path, digest: str, plan: Plan
) -> tuple[list[FitResult], Run | None]:
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
        FitResult(task.params.with_raw(raw), *rest)
        for task, raw, rest in zip(tasks, raws, ended, strict=True)
    ]
    return done, None if under_way is None else Run(position, *under_way)


def finished_rows(out: Path, plan: Plan) -> list[dict[str, Any]]:
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
