"""What configurations of `evaluate` and `fit` share: recordings, methods, parameters, checks."""

import contextlib
import glob
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from jaxevent import datasets
from jaxevent.errors import InputError
from jaxevent.parameters import Parameters, nearest, read_toml

P = TypeVar("P", bound=Parameters)

Check = tuple[Callable[[Any], bool], str]  # of a setting: what is accepted, and how to say so


def is_text(value: Any) -> bool:
    return isinstance(value, str)


def is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_text, value))


def is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def is_natural(value: Any) -> bool:
    return type(value) is int and value > 0


POSITIVE = (lambda value: is_number(value) and value > 0, "a positive number")
NOT_NEGATIVE = (lambda value: is_number(value) and value >= 0, "a number, 0 or more")
NATURAL = (is_natural, "a whole number, 1 or more")
NAME = (is_text, "text")
PATHS = (is_texts, 'a list of paths, as ["file.zip"]')

STREAM = (is_text, 'the name of a camera, as "left"')
SIZE: Check = (
    lambda value: isinstance(value, list) and len(value) == 2 and all(map(is_natural, value)),
    "[width, height] in pixels",
)


def check(table: Mapping[str, Any], known: Mapping[str, Check]) -> None:
    for name, value in table.items():
        if name not in known:
            raise InputError(f"there is no setting {name!r}; {nearest(name, known)}")
        accepts, text = known[name]
        if not accepts(value):
            raise InputError(f"{name} is {str(value)[:60]!r}; give {text}")


def one_of(value: str, what: str, known: Sequence[str]) -> str:
    """The value; raises `InputError` unless it is one of those known."""
    if value not in known:
        raise InputError(f"there is no {what} {value!r}; {nearest(value, known)}")
    return value


def find_recordings(given: Any, folder: Path) -> list[tuple[str, Path]]:
    """Recordings as given and their paths, of paths and globs relative to `folder`.

    "NAME:FOLDER" stands for all recordings of a data set of `jaxevent.datasets`. $NAME is expanded.
    Raises `InputError` for what is not there.
    """
    if not (isinstance(given, list) and given and all(isinstance(one, str) for one in given)):
        raise InputError('recordings is missing or not a list; give recordings = ["file.zip", ...]')
    found: dict[Path, str] = {}
    for text in given:
        expanded = os.path.expanduser(os.path.expandvars(text))
        unset = re.search(r"\$(\w+|\{[^}]*\})", expanded)
        if unset and not (folder / expanded).exists():
            name = unset.group(1).strip("{}")
            raise InputError(f"the recording {text!r} needs the variable {name}, which is not set")
        name, rest = _data_set(expanded, folder)
        if name:
            for one, path in datasets.open(name, folder / rest).paths.items():
                found.setdefault(path, f"{name}:{one}")
            continue
        if not glob.has_magic(expanded) or (folder / expanded).exists():
            found.setdefault(folder / expanded, text)
            continue
        matches = sorted(glob.glob(expanded, root_dir=folder, recursive=True))
        if not matches:
            raise InputError(f"no recording matches {text!r} in {folder}; correct the pattern")
        for match in matches:
            found.setdefault(folder / match, match)
    return [(text, path) for path, text in found.items()]


def _data_set(text: str, folder: Path) -> tuple[str, str]:
    """The name and the folder of "NAME:FOLDER"; an empty name where it is a path."""
    name, _, rest = text.partition(":")
    known = rest and name in datasets.LAYOUTS and not (folder / text).exists()
    return (name, rest) if known else ("", text)


def from_anywhere(given: str) -> str:
    """A recording as given in the working directory, named so that any configuration finds it."""
    name, rest = _data_set(given, Path.cwd())
    path = str(Path(rest).expanduser().absolute())
    return f"{name}:{path}" if name else path


def named_files(config: Path) -> list[Path]:
    """The existing files that a configuration names, in whichever setting."""
    found: list[Path] = []

    def look(value: Any) -> None:
        if isinstance(value, str):
            with contextlib.suppress(OSError, ValueError):  # text that can be no name
                path = config.parent / os.path.expanduser(os.path.expandvars(value))
                found.extend([path] if path.is_file() else [])
        elif isinstance(value, dict | list):
            for part in value.values() if isinstance(value, dict) else value:
                look(part)

    look(read_toml(config))
    return found


def read_params(kind: type[P], name: str, given: Any, folder: Path) -> P:
    """Params of a method as a configuration gives them: a table, a TOML file's path, or both.

    Paths are relative to `folder`. Raises `InputError` for anything else and naming a bad setting.
    """

    def load_file(path: str) -> P:
        return kind.load(folder / os.path.expandvars(path), name)

    if isinstance(given, str):
        return load_file(given)
    if not isinstance(given, dict):
        raise InputError(f"params is {given!r}; give a table or the path of a TOML file")
    values = dict(given)
    file = values.pop("file", None)
    if file is None:
        return kind.of(values)
    if not isinstance(file, str):
        raise InputError(f"file is {file!r}; give the path of a TOML file")
    return kind.of({**load_file(file).values(), **values})
