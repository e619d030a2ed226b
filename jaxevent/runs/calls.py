"""Conversion of calls from Python to tables of a configuration, so that one code path serves both.

Objects for which TOML has no type stay in the table: recordings, methods, parameters, metrics, and
tables of ground truth.
"""

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxevent import methods
from jaxevent.display import describe_type
from jaxevent.errors import InputError
from jaxevent.estimator import Estimator
from jaxevent.io.output import values_of
from jaxevent.parameters import Parameters, read_toml
from jaxevent.recording import Recording
from jaxevent.runs.config import NamedRecording, TruthTables
from jaxevent.runs.own import Metric, find_method, import_path, named_metric

PathLike = str | os.PathLike
TRUTH_SETTINGS = ("positions", "truth")  # settings that take tables of ground truth
CALL_HEADER = "# As called from Python; objects are given by their names alone.\n"


class CallForms(NamedTuple):
    """The two forms of a call: with a configuration file, or with recordings and methods."""

    example: str  # call with objects, for messages
    with_config: Collection[str]  # arguments allowed in a call with a configuration
    with_objects: Collection[str]  # arguments that occur only in calls with objects

    def is_config(self, arguments: Sequence[Any], settings: Mapping[str, Any]) -> bool:
        """Return whether a call names a configuration rather than recordings.

        Args:
            arguments: Positional arguments.
            settings: Keyword arguments.

        Raises:
            InputError: An argument is not allowed with a configuration, or the only path is not
                that of a TOML file.
        """
        first = arguments[0] if arguments else settings.get("config")
        if first is None or not is_path(first):
            return False
        beside = [name for name in settings if name not in self.with_config]
        if Path(first).suffix != ".toml":
            method = len(arguments) > 1 and names_method(arguments[1])
            if method or any(name in self.with_objects for name in settings):
                return False
            try:
                read_toml(first)
            except InputError as error:
                raise InputError(
                    f"{error}; if it is a recording, name it in a configuration, or in Python "
                    f"give a method too: {self.example}"
                ) from None
        if beside:
            raise InputError(
                f"{first}: {beside[0]} is no argument beside a configuration; set it in the file"
            )
        return True


def is_path(value: Any) -> bool:
    return isinstance(value, str | os.PathLike)


def names_method(value: Any) -> bool:
    """Return whether an argument can only be a method or several methods."""
    if is_path(value):
        return isinstance(value, str) and (value in methods.names() or ":" in value)
    return value is not None


def recordings_of(given: Any) -> list[Any]:
    """Convert recordings to the list of a configuration.

    Args:
        given: A recording or a path, a list of them, or a mapping from names.
    """
    if isinstance(given, Mapping):
        return [
            NamedRecording(_text(name, "a recording"), _recording(one))
            for name, one in given.items()
        ]
    if is_path(given) or isinstance(given, Recording):
        given = [given]
    return [_recording(one) for one in _as_list(given, "recordings", "recordings or paths")]


def _recording(given: Any) -> str | Recording:
    if isinstance(given, Recording):
        return given
    if is_path(given):
        return os.fspath(given)
    raise InputError(
        f"recordings hold {describe_type(given)}; give jaxevent.Recording objects or paths"
    )


def methods_of(given: Any) -> list[dict[str, Any]]:
    """Convert methods to the tables [[method]] of a configuration.

    Args:
        given: A method, a list of methods, or a mapping from labels. A method is a name, an
            Estimator, a function, a pair (method, params), or a table as in a configuration.
    """
    if isinstance(given, Mapping) and "name" not in given:
        return [{**_method(one), "label": _text(label, "a method")} for label, one in given.items()]
    one = isinstance(given, str | Estimator | Mapping) or callable(given) or _is_pair(given)
    tables = [_method(each) for each in ([given] if one else _as_list(given, "methods", "methods"))]
    return _with_labels(tables)


def _is_pair(given: Any) -> bool:
    """Return whether a value is a pair (method, params), not a tuple of two methods."""
    return (
        isinstance(given, tuple)
        and len(given) == 2
        and (isinstance(given[1], Parameters | Mapping | os.PathLike))
        and not (isinstance(given[1], Mapping) and "name" in given[1])
    )


def _method(given: Any) -> dict[str, Any]:
    if isinstance(given, Mapping):
        return {name: plain_value(value) for name, value in given.items()}
    if isinstance(given, tuple):
        if not _is_pair(given):
            raise InputError(
                f"a method is {str(given)[:60]!r}; give a pair (method, params), of Params or a "
                "mapping"
            )
        method, params = given
        return {"name": method, "params": plain_value(params)}
    return {"name": given}


def _with_labels(tables: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Label tables that share a method by the parameters that differ from its defaults."""
    names = [method_name(table.get("name")) for table in tables]
    for table, name in zip(tables, names, strict=True):
        params = table.get("params")
        if names.count(name) > 1 and "label" not in table and params is not None:
            values: Mapping[str, Any] = params.values() if isinstance(params, Parameters) else {}
            usual = type(params)().values() if isinstance(params, Parameters) else {}
            if isinstance(params, Mapping):
                values = params
            changed = {k: v for k, v in values.items() if k not in usual or v != usual[k]}
            table["label"] = ", ".join([name, *(format_setting(k, v) for k, v in changed.items())])
    return tables


def format_setting(name: str, value: Any) -> str:
    """Format a setting for a label.

    Args:
        name: Name of the setting.
        value: Its value; a number is shown with six digits.

    Returns:
        The label, such as "window 0.1".
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return f"{name} {value:g}" if number else f"{name} {value}"


def method_name(given: Any) -> str:
    """Return the name of a method that has no label."""
    return given if isinstance(given, str) else find_method(given).name


def metrics_of(given: Any) -> list[str | Metric]:
    """Convert metrics to the list of a configuration.

    Args:
        given: A metric, a list of metrics, or a mapping from names. A metric is a name, a function,
            or a pair (name, function).
    """
    if isinstance(given, Mapping):
        given = list(given.items())
    elif isinstance(given, str | Metric) or callable(given):
        given = [given]
    return [_metric(one) for one in _as_list(given, "metrics", "names or functions")]


def _metric(given: Any) -> str | Metric:
    if isinstance(given, str | Metric):
        return given
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], str):
        return named_metric(given[1], given[1], given[0])
    metric = named_metric(given, given)
    path = import_path(given)
    return metric if path is None or path.rpartition(":")[2] != metric.name else path


def settings_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """Convert settings to TOML types, and tables of ground truth to `TruthTables`."""
    return {
        name: TruthTables.of(value) if name in TRUTH_SETTINGS else plain_value(value)
        for name, value in given.items()
        if value is not None
    }


def plain_value(value: Any) -> Any:
    """Convert a value to lists, numbers and text; `Params`, recordings and methods stay objects."""
    if isinstance(value, Parameters | Recording | Estimator | TruthTables):
        return value
    if isinstance(value, Mapping):
        return {name: plain_value(one) for name, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain_value(one) for one in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return value


def table_with_names(value: Any) -> Any:
    """Replace the objects in a table by their names, so that TOML can hold it."""
    if isinstance(value, NamedRecording):
        return table_with_names(value.recording) if is_path(value.recording) else value.name
    if isinstance(value, Recording | Metric):
        return value.name
    if isinstance(value, TruthTables):
        return "given in Python"
    if isinstance(value, Parameters):
        return table_with_names(values_of(value))
    if isinstance(value, Mapping):
        return {name: table_with_names(one) for name, one in value.items() if one is not None}
    if isinstance(value, list):
        return [table_with_names(one) for one in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Estimator) or callable(value):
        return method_name(value)
    return describe_type(value)


def _as_list(given: Any, what: str, of: str) -> Sequence[Any]:
    if not isinstance(given, Iterable):
        raise InputError(f"{what} are {describe_type(given)}; give a list of {of}")
    return list(given)


def _text(name: Any, what: str) -> str:
    if not isinstance(name, str) or not name:
        raise InputError(f"the name of {what} is {name!r}; give text")
    return name
