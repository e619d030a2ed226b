"""Settings that `evaluate` and `fit` share: recordings, methods, parameters, and their checks."""

import contextlib
import dataclasses
import glob
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxevent import datasets
from jaxevent.display import describe_type
from jaxevent.errors import InputError
from jaxevent.estimator import Estimator
from jaxevent.parameters import Parameters, check_choice, read_toml, suggest_name
from jaxevent.recording import Recording

Check = tuple[Callable[[Any], bool], str]  # of a setting: what is accepted, and how to say so


class NamedRecording(NamedTuple):
    """A recording, or its path, and its name in results."""

    name: str
    recording: "Recording | str"


@dataclasses.dataclass(frozen=True, eq=False)
class TruthTables:
    """Tables of ground truth, given in Python: one for all recordings, or one for each by name.

    A table is a pandas DataFrame or the path of a file.
    """

    given: Any

    @classmethod
    def of(cls, given: Any) -> "TruthTables | str":
        """Make them from a table, or a mapping from recordings' names.

        A text is returned unchanged.
        """
        if isinstance(given, str):
            return given
        if isinstance(given, os.PathLike):
            return cls(Path(given))
        if isinstance(given, Mapping) and not any(map(is_column, given.values())):
            return cls({str(name): _table(one) for name, one in given.items()})
        return cls(_table(given))

    def find(self, recording: str) -> Any:
        """Return the table of a recording by its name; raise `InputError` if there is none."""
        if not isinstance(self.given, dict):
            return self.given
        for name in (recording, external_name(Path(recording))):
            if name in self.given:
                return self.given[name]
        raise InputError(
            f"{recording}: no table of the ground truth has this name; "
            f"{suggest_name(recording, self.given)}"
        )


def truth_table(given: TruthTables | str, recording: str) -> Any:
    """Find the table of a recording's ground truth: a DataFrame, or the path of a file.

    A text is the name of files beside recordings, in which * stands for their names without suffix.
    """
    if isinstance(given, TruthTables):
        return given.find(recording)
    path = Path(recording)
    return path.with_name(given.replace("*", external_name(path)))


def truth_files(given: TruthTables | str, recording: str) -> list[Path]:
    """Return the file of a recording's table, if it is in one."""
    table = truth_table(given, recording)
    return [table] if isinstance(table, Path) else []


def is_table(value: Any) -> bool:
    return isinstance(value, TruthTables) or (isinstance(value, str) and value != "")


def is_column(value: Any) -> bool:
    """Return true if a value of a mapping is a column of numbers rather than a table."""
    return not (isinstance(value, str | os.PathLike | Mapping) or hasattr(value, "columns")) and (
        not hasattr(value, "to_dataframe")
    )


def _table(given: Any) -> Any:
    import pandas as pd

    if isinstance(given, str | os.PathLike):
        return Path(given)
    for method in ("to_dataframe", "to_pandas"):
        if hasattr(given, method):
            given = getattr(given, method)()
    try:
        return pd.DataFrame(given).reset_index(drop=True)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the ground truth is {describe_type(given)} that is no table ({error}); give a "
            "DataFrame, the path of a CSV file, or a mapping from recordings' names to them"
        ) from None


def external_name(path: Path) -> str:
    """Return the name of a recording in other programs' results: that of its file, no suffix."""
    return path.name if path.is_dir() else path.stem


def is_text(value: Any) -> bool:
    return isinstance(value, str)


def is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_text, value))


def is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def is_numbers(value: Any, *counts: int) -> bool:
    """Return true for a list of finite numbers, as many as one of `counts`."""
    return isinstance(value, list) and len(value) in counts and all(map(is_number, value))


def is_flag(value: Any) -> bool:
    return isinstance(value, bool)


def is_natural(value: Any) -> bool:
    return type(value) is int and value > 0


POSITIVE_CHECK = (lambda value: is_number(value) and value > 0, "a positive number")
NOT_NEGATIVE_CHECK = (lambda value: is_number(value) and value >= 0, "a number, 0 or more")
FLAG_CHECK = (is_flag, "true or false")
SEED_CHECK = (lambda value: type(value) is int and value >= 0, "a whole number, 0 or more")
NATURAL_CHECK = (is_natural, "a whole number, 1 or more")
NAME_CHECK = (is_text, "text")
PATHS_CHECK = (
    lambda value: (
        isinstance(value, list)
        and all(is_text(one) or isinstance(one, Recording | NamedRecording) for one in value)
    ),
    'a list of paths, as ["file.zip"]',
)


def is_metrics(value: Any) -> bool:
    return isinstance(value, list) and all(is_text(one) or callable(one) for one in value)


METRICS_CHECK = (is_metrics, 'a list of names, as ["lpips"], or of "package.module:function"')
CALIBRATE_CHECK: Check = (
    is_flag,
    "true, to take clock and thresholds that are not given from the recording, or false",
)
STREAM_CHECK = (is_text, 'the name of a camera, as "left"')
SIZE_CHECK: Check = (
    lambda value: isinstance(value, list) and len(value) == 2 and all(map(is_natural, value)),
    "[width, height] in pixels",
)


def check(table: Mapping[str, Any], known: Mapping[str, Check]) -> None:
    """Check the names and values of settings.

    Args:
        table: Settings by name.
        known: Possible settings: a test of values, and its description for messages.

    Raises:
        InputError: A name is unknown, or a value is not possible.
    """
    for name, value in table.items():
        check_choice(name, "setting", known)
        accepts, text = known[name]
        if not accepts(value):
            raise InputError(f"{name} is {str(value)[:60]!r}; give {text}")


def find_recordings(given: Any, folder: Path) -> list[tuple[str, Path | Recording]]:
    """Find recordings by name: objects, or the paths of those given by paths and globs.

    "NAME:FOLDER" stands for all recordings of a data set of `jaxevent.datasets`. $NAME is expanded.
    Objects have their own names; further ones of a name get a number.

    Args:
        given: Paths, globs and recordings of a configuration.
        folder: Folder that paths are relative to.

    Returns:
        Names, as given, and recordings or their paths.

    Raises:
        InputError: A recording does not exist.
    """
    if not (given and PATHS_CHECK[0](given)):
        raise InputError('recordings is missing or not a list; give recordings = ["file.zip", ...]')
    found: dict[Any, tuple[str, Path | Recording]] = {}
    for one in given:
        name, what = one if isinstance(one, NamedRecording) else (None, one)
        if isinstance(what, Recording):
            found.setdefault((id(what), name), (name or what.name or "recording", what))
            continue
        paths = _find_paths(what, folder)
        if name is not None and len(paths) > 1:
            raise InputError(
                f"{len(paths)} recordings are called {name!r}, those of {what!r}; give each a name"
            )
        for path, text in paths.items():
            found.setdefault(path, (name or text, path))
    return _with_unique_names(list(found.values()))


def _with_unique_names(
    recordings: list[tuple[str, Path | Recording]],
) -> list[tuple[str, Path | Recording]]:
    """Rename recordings that share a name: the second is "name (2)"."""
    taken: set[str] = set()
    found: list[tuple[str, Path | Recording]] = []
    for name, recording in recordings:
        other, number = name, 1
        while other in taken:
            number += 1
            other = f"{name} ({number})"
        taken.add(other)
        found.append((other, recording))
    return found


def _find_paths(text: str, folder: Path) -> dict[Path, str]:
    """Find the paths that a text of a configuration stands for, and the name of each."""
    expanded = os.path.expanduser(os.path.expandvars(text))
    try:
        os.stat(folder / expanded)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # too long, or with a character that no path has
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"the recording {text[:60]!r} cannot be read ({reason}); correct the path"
        ) from None
    unset = re.search(r"\$(\w+|\{[^}]*\})", expanded)
    if unset and not (folder / expanded).exists():
        name = unset.group(1).strip("{}")
        raise InputError(f"the recording {text!r} needs the variable {name}, which is not set")
    name, rest = _data_set(expanded, folder)
    if name:
        paths = datasets.open(name, folder / rest).paths
        return {path: f"{name}:{one}" for one, path in paths.items()}
    if not glob.has_magic(expanded) or (folder / expanded).exists():
        return {folder / expanded: text}
    matches = sorted(glob.glob(expanded, root_dir=folder, recursive=True))
    if not matches:
        raise InputError(f"no recording matches {text!r} in {folder}; correct the pattern")
    return {folder / match: match for match in matches}


def _data_set(text: str, folder: Path) -> tuple[str, str]:
    """Split "NAME:FOLDER" into name and folder; the name is empty if the text is a path."""
    name, _, rest = text.partition(":")
    known = rest and name in datasets.LAYOUTS and not (folder / text).exists()
    return (name, rest) if known else ("", text)


def absolute_path(given: Any) -> Any:
    """Convert a path in the working directory to one that any configuration finds."""
    if isinstance(given, Recording | NamedRecording):
        return given
    given = os.fspath(given)
    name, rest = _data_set(given, Path.cwd())
    path = str(Path(rest).expanduser().absolute())
    return f"{name}:{path}" if name else path


def files_named_in(config: Path) -> list[Path]:
    """Return the existing files that a configuration names, in any setting."""
    found: list[Path] = []

    def collect(value: Any) -> None:
        if isinstance(value, str):
            with contextlib.suppress(OSError, ValueError):  # text that can be no name
                path = config.parent / os.path.expanduser(os.path.expandvars(value))
                found.extend([path] if path.is_file() else [])
        elif isinstance(value, dict | list):
            for part in value.values() if isinstance(value, dict) else value:
                collect(part)

    collect(read_toml(config))
    return found


def read_params(method: Estimator, name: str, given: Any, folder: Path) -> dict[str, Any]:
    """Read the parameters that a configuration gives a method, checked.

    They are a table, the path of a TOML file, both, or an object of the method's `Params`, which
    gives all. Raises `InputError` for anything else and naming a bad setting.

    Args:
        method: The method.
        name: Its name, of the table in a file of several methods.
        given: What the configuration gives.
        folder: The folder that paths are relative to.

    Returns:
        The values that are given, by name, and perhaps "preset".
    """
    kind = method.Params
    if isinstance(given, Parameters):
        if type(given) is not kind:
            raise InputError(
                f"params are {type(given).__module__}.{type(given).__name__}, not those of the "
                f"method {name!r}; give {kind.__module__}.{kind.__name__}"
            )
        return given.values()
    if isinstance(given, str):
        given = {"file": given}
    if not isinstance(given, dict):
        raise InputError(f"params is {given!r}; give a table or the path of a TOML file")
    values = dict(given)
    file = values.pop("file", None)
    if file is not None:
        if not isinstance(file, str):
            raise InputError(f"file is {file!r}; give the path of a TOML file")
        values = {**kind.load_table(folder / os.path.expandvars(file), name), **values}
    kind.of(values)
    return values
