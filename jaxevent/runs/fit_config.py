"""The configuration of a fit, read and checked; `jaxevent.runs.fit` says what it may hold."""

import contextlib
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from jaxevent.errors import InputError
from jaxevent.estimator import Estimator
from jaxevent.io import toml
from jaxevent.parameters import Parameters, read_toml
from jaxevent.recording import Recording
from jaxevent.runs import contents
from jaxevent.runs.calls import table_with_names
from jaxevent.runs.config import (
    CALIBRATE_CHECK,
    FLAG_CHECK,
    NAME_CHECK,
    NATURAL_CHECK,
    NOT_NEGATIVE_CHECK,
    PATHS_CHECK,
    POSITIVE_CHECK,
    SEED_CHECK,
    SIZE_CHECK,
    STREAM_CHECK,
    Check,
    absolute_path,
    check,
    files_named_in,
    find_recordings,
    is_numbers,
    is_text,
    is_texts,
    read_params,
)
from jaxevent.runs.family import MODULE_OF_FAMILY, SPLIT_NAMES, Goal, Shares, family_of, find_family
from jaxevent.runs.own import MethodFunction, find_method
from jaxevent.tuning import Interval, Loss, Settings, begin, with_prior


@dataclasses.dataclass(frozen=True)
class Task:
    """One method of a configuration, checked."""

    label: str
    method: Estimator
    params: Parameters
    names: tuple[str, ...]
    search: Mapping[str, Interval]
    goal: Goal
    loss: Loss  # the goal's, with what is believed of numbers
    settings: Settings
    left_open: tuple[str, ...] = ()  # names of parameters that start from the recordings


@dataclasses.dataclass(frozen=True)
class Plan:
    """A checked configuration; recordings are (name, path or object) by split.

    `config` is None of a call from Python.
    """

    config: Path | None
    text: bytes
    recordings: Mapping[str, list[tuple[str, Path | Recording]]]
    tasks: list[Task]
    size: tuple[int, int] | None
    stream: str | None
    split: Shares
    # s, length of a window that is fitted; None: the default of the family
    window: float | int | None

    def inputs(self) -> list[Path]:
        """Return all files that are read, as far as they can be."""
        found = [] if self.config is None else [self.config, *files_named_in(self.config)]
        for split in SPLIT_NAMES:
            for name, path in self.recordings[split]:
                if isinstance(path, Recording):
                    path = Path(name)
                else:
                    found.append(path)
                for task in self.tasks:
                    with contextlib.suppress(OSError, InputError):
                        found += task.goal.files(path)
        return found

    def where(self) -> str:
        """Return the beginning of a message: the file, if there is one."""
        return "" if self.config is None else f"{self.config}: "

    def digest(self) -> str:
        """Hash the configuration, the recordings and the precision."""
        digest = hashlib.sha256(self.text)
        digest.update(repr([task.params.values() for task in self.tasks]).encode())
        digest.update(str(jnp.result_type(float)).encode())
        for split in SPLIT_NAMES:
            for given, path in self.recordings[split]:
                digest.update(f"{split} {given}".encode())
                files: list[Path] = []
                if isinstance(path, Recording):
                    digest.update(contents.digest(path).encode())
                    path = Path(given)
                else:
                    files += [path] if path.is_file() else sorted(path.rglob("*"))
                for task in self.tasks:
                    files += task.goal.files(path)
                for file in filter(Path.is_file, files):
                    contents.fingerprint(file, digest.update)
        return digest.hexdigest()


_SETTINGS: dict[str, Check] = {
    "iterations": NATURAL_CHECK,
    "learning_rate": POSITIVE_CHECK,
    "patience": NATURAL_CHECK,
    "every": NATURAL_CHECK,
    "starts": NATURAL_CHECK,
    "spread": NOT_NEGATIVE_CHECK,
    "rounds": NATURAL_CHECK,
    "batch": NATURAL_CHECK,
    "seed": SEED_CHECK,
    "probe": FLAG_CHECK,
}
_COMMON: dict[str, Check] = {
    **_SETTINGS,
    "prior_weight": POSITIVE_CHECK,
    "recordings": PATHS_CHECK,
    "validation": PATHS_CHECK,
    "test": PATHS_CHECK,
    "split": (
        lambda value: (
            isinstance(value, list)
            and len(value) == 3
            and all(type(n) is int and n >= 0 for n in value)
            and value[0] > 0
        ),
        "[fit, validation, test] in whole numbers, the first not 0",
    ),
    "size": SIZE_CHECK,
    "stream": STREAM_CHECK,
    "calibrate": CALIBRATE_CHECK,
    "window": POSITIVE_CHECK,
    "method": (
        lambda value: isinstance(value, list) and all(isinstance(n, dict) for n in value),
        '[[method]] with name = "akf"',
    ),
}
_METHOD: dict[str, Check] = {
    **{name: _SETTINGS[name] for name in ("learning_rate", "iterations", "starts")},
    "calibrate": CALIBRATE_CHECK,
    "prior_weight": POSITIVE_CHECK,
    "prior": (
        lambda value: isinstance(value, dict) and all(is_numbers(v, 2) for v in value.values()),
        "a table of name = [believed value, standard deviation of its logarithm]",
    ),
    "name": (lambda value: is_text(value) or isinstance(value, Estimator), "text"),
    "label": NAME_CHECK,
    "params": (
        lambda value: isinstance(value, str | dict | Parameters),
        "a table or the path of a TOML file",
    ),
    "fit": (is_texts, 'a list of names, as ["c_on", "c_off"]'),
    "search": (
        lambda value: (
            isinstance(value, dict)
            and all(is_numbers(v, 3) and type(v[2]) is int for v in value.values())
        ),
        "a table of name = [from, to, number of points]",
    ),
}


def read_plan(
    config: Path, recordings: Sequence[Any] | None = None, calibrate: bool | None = None
) -> Plan:
    """Read and check a configuration.

    Args:
        config: The TOML file.
        recordings: In place of those that it names, written like them but relative to the working
            directory.
        calibrate: In place of the file's `calibrate`; None leaves it.

    Returns:
        The plan of a fit.

    Raises:
        InputError: A setting cannot be used; the message names file and setting.
    """
    table: dict[str, Any] = read_toml(config)
    text = config.read_bytes()
    try:
        if recordings:
            table = {**table, "recordings": [absolute_path(one) for one in recordings]}
        if calibrate is not None:
            table = {**table, "calibrate": calibrate}
        if recordings or calibrate is not None:
            text = toml.dump(table_with_names(table)).encode()
        return plan_of(table, config.parent, config, text)
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def plan_of(table: Mapping[str, Any], folder: Path, config: Path | None, text: bytes) -> Plan:
    """Check the table of a configuration, in which paths are relative to `folder`.

    Args:
        table: As a file has it; recordings, methods and parameters may be objects.
        folder: To which paths are relative.
        config: The file; None of a call from Python.
        text: The configuration as results keep it.

    Raises:
        InputError: A setting cannot be used; the message names it.
    """
    families = {name: find_family(name) for name in MODULE_OF_FAMILY}
    further = {k: v for one in families.values() for k, v in one.fit_settings.items()}
    check(table, {**_COMMON, **further})
    found = {
        split: find_recordings(table[key], folder) if table.get(key) else []
        for split, key in zip(SPLIT_NAMES, ("recordings", "validation", "test"), strict=True)
    }
    if not found["fit"]:
        raise InputError('no recording is given; add recordings = ["file.zip"]')
    given = [one for split in SPLIT_NAMES for one in found[split]]
    keys = [id(one) if isinstance(one, Recording) else one.resolve() for _, one in given]
    for (name, _), key in zip(given, keys, strict=True):
        if keys.count(key) > 1:
            raise InputError(
                f"{key if isinstance(key, Path) else name} is in two of recordings, validation and "
                "test; choose one"
            )
    apart = bool(found["validation"] or found["test"])
    if apart and "split" in table:
        raise InputError("split is for configurations without validation and test; omit it")
    if not table.get("method"):
        raise InputError(
            'no method is given; give one such as "akf", in a configuration by [[method]] with '
            'name = "akf"'
        )
    tasks: list[Task] = []
    for number, entry in enumerate(table["method"], 1):
        try:
            tasks.append(_task(entry, table, folder))
        except InputError as error:
            where = "" if config is None else f"method {number}: "
            raise InputError(f"{where}{error}") from None
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
        config,
        text,
        found,
        tasks,
        None if size is None else (size[0], size[1]),
        table.get("stream"),
        None if apart else tuple(table.get("split", (2, 1, 1))),
        table.get("window"),
    )


def _task(entry: Mapping[str, Any], table: Mapping[str, Any], folder: Path) -> Task:
    name = entry.get("name")
    if name is None:
        raise InputError('a method has no name; give name = "akf"')
    method = find_method(name)
    if isinstance(method, MethodFunction):
        raise InputError(
            f"the method {method.name!r} is a function and has no parameters to fit; make an "
            "Estimator"
        )
    name = name if isinstance(name, str) else method.name
    family = family_of(method)
    check(entry, {**_METHOD, **{k: family.fit_settings[k] for k in family.own}})
    given = entry.get("params", {})
    explicit = read_params(method, name, given, folder)
    params = given if isinstance(given, Parameters) else method.Params.of(explicit)
    both = {**table, **entry}
    left_open = method.names_left_open(explicit) if both.get("calibrate", True) else ()
    goal = family.goal(method, params, both)
    names, search = tuple(entry.get("fit", ())), entry.get("search", {})
    if not names and not search:
        raise InputError('nothing is to be fitted; give names, as fit = ["c_on", "c_off"]')
    if names and not method.differentiable:
        raise InputError(
            f"the method {method.name!r} computes on the host and has no gradient to follow; "
            f"search its numbers: search = {{ {names[0]} = [from, to, number of points] }}"
        )
    prior = entry.get("prior", {})
    for one in prior:
        if one not in names and one not in search:
            raise InputError(f"the prior names {one}, which is not fitted; omit it")
    loss = with_prior(goal.loss, params, prior, both.get("prior_weight", 1.0))
    chosen = {name: both[name] for name in _SETTINGS if name in both}
    settings = Settings(**chosen, forward=goal.forward)
    intervals = {name: (low, high, count) for name, (low, high, count) in search.items()}
    begin(params, names, settings, intervals)  # checks the names
    label = entry.get("label", name)
    return Task(label, method, params, names, intervals, goal, loss, settings, left_open)
