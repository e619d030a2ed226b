"""Contents of recordings: hashes of files, kept, and of objects; the recording last loaded."""

import contextlib
import dataclasses
import hashlib
import json
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxevent.display import describe_type
from jaxevent.errors import InputError
from jaxevent.io import load
from jaxevent.io.checks import companions
from jaxevent.io.output import complete
from jaxevent.parameters import Parameters
from jaxevent.progress import bar
from jaxevent.recording import EventSource, Recording


class RecordingCache(threading.local):
    """The recording last loaded: methods are run on it one after another."""

    def __init__(self):
        self.clear()

    def clear(self) -> None:
        self._last: tuple[Any, Recording | InputError | None] = (None, None)

    def load(
        self, path: Path, size: tuple[int, int] | None, stream: str | None, progress: bool | None
    ) -> Recording:
        """Load a recording, unless it was the last one loaded and its files are unchanged.

        Args:
            path: File or folder of the recording.
            size: (width, height) of the sensor in px, for files that do not state it.
            stream: Name of the camera whose events are read.
            progress: Whether to show progress.

        Returns:
            The recording, named by its path; events and images stay in the file.

        Raises:
            InputError: The recording cannot be read.
        """
        size = None if size is None else (size[0], size[1])
        files = [*_files(path), *companions(path)]
        what = (path, size, stream, [_stamp(file) for file in files])
        before, loaded = self._last
        if loaded is None or before != what:
            self.clear()
            try:
                loaded = load(path, size, in_memory=False, progress=progress, stream=stream)
                loaded = dataclasses.replace(loaded, name=str(path))  # for messages
            except InputError as error:
                loaded = error
            self._last = what, loaded
        if isinstance(loaded, InputError):
            raise InputError(str(loaded))
        return loaded


def _files(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]


def _stamp(file: Path) -> tuple[str, int, int]:
    try:
        about = file.stat()
    except OSError:
        return str(file), -1, 0
    return str(file), about.st_size, about.st_mtime_ns


class FileHashes:
    """Hashes of what files and folders hold, kept in a file as long as size and time agree."""

    # A file changed again within the clock's tick (s) after it was read would look unchanged.
    TICK = 2

    def __init__(self, cache: Path, progress: bool | None):
        self.cache, self.progress = cache, progress
        self.known: dict[str, list] = {}
        with contextlib.suppress(OSError, ValueError):
            self.known = dict(json.loads(cache.read_bytes()))
        self.used: dict[str, list] = {}
        self.now: dict[Path, str] = {}
        self.objects: dict[int, tuple[Recording, str]] = {}  # held, so that no id is used again

    def of(self, path: Path) -> str:
        """Return the hash of a file, or of all names and files in a folder; raises OSError."""
        if path not in self.now:
            files = _files(path)
            hashes = [self._of_file(file) for file in files]
            if path.is_dir():
                names = [str(file.relative_to(path)) for file in files]
                text = json.dumps(list(zip(names, hashes, strict=True)))
                self.now[path] = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
            else:
                self.now[path] = hashes[0]
        return self.now[path]

    def of_object(self, recording: Recording) -> str:
        """Return the hash of a recording's content; raises `InputError`."""
        known = self.objects.get(id(recording))
        if known is None:
            known = self.objects[id(recording)] = recording, digest(recording)
        return known[1]

    def _of_file(self, file: Path) -> str:
        name, size, changed = _stamp(file)
        known = self.known.get(name)
        if isinstance(known, list) and known[:2] == [size, changed]:
            self.used[name] = known
            return known[2]
        digest = hashlib.blake2b(digest_size=16)
        with (
            file.open("rb") as opened,
            bar(
                desc=f"reading {file.name}",
                total=size,
                unit="B",
                unit_scale=True,
                progress=self.progress,
            ) as shown,
        ):
            while block := opened.read(1 << 22):
                digest.update(block)
                shown.update(len(block))
        if time.time_ns() - changed > self.TICK * 10**9:
            self.used[name] = [size, changed, digest.hexdigest()]
        return digest.hexdigest()

    def save(self) -> None:
        known = {**self.known, **self.used}
        if known != self.known:
            self.cache.parent.mkdir(exist_ok=True)
            with complete(self.cache) as partial:
                partial.write_text(json.dumps(known))


HASHED_EVENTS = 1 << 20  # events that are hashed at once
HASHED_IMAGES = 64  # images that are hashed at once


def digest(thing: Any) -> str:
    """Hash the content of recordings and settings: numbers, text, arrays, tables, dataclasses.

    Names of recordings do not count. Events and images in a file are read piece by piece. Raises
    `InputError` for anything else.
    """
    whole = hashlib.blake2b(digest_size=16)
    _feed(thing, whole.update)
    return whole.hexdigest()


def _feed(thing: Any, update: Callable[[Any], None]) -> None:
    """Feed a hash a value, with its kind and its length, so that no two values feed the same.

    Args:
        thing: The value: a number, a text, an array, events, or a container of these.
        update: Function that adds bytes to the hash.
    """

    def begin(kind: str, *about: Any) -> None:
        update(f"{kind} {' '.join(map(repr, about))};".encode())

    pandas: Any = sys.modules.get("pandas")  # imported where there is a table
    if thing is None or isinstance(thing, str | bool | int | float | np.generic):
        begin(type(thing).__name__, thing)
    elif isinstance(thing, list | tuple):
        begin("list", len(thing))
        for one in thing:
            _feed(one, update)
    elif pandas is not None and isinstance(thing, pandas.DataFrame):
        _feed({str(name): thing[name].to_numpy() for name in thing.columns}, update)
    elif isinstance(thing, EventSource):
        begin("events", len(thing))
        for first in range(0, len(thing), HASHED_EVENTS):
            part = thing[first : first + HASHED_EVENTS]
            for column in (part.t, part.x, part.y, part.p):
                update(np.ascontiguousarray(column).data)
    elif isinstance(thing, type):
        begin("class", thing.__module__, thing.__qualname__)
    elif isinstance(thing, Parameters):
        begin(type(thing).__qualname__)
        _feed(thing.values(), update)
    elif dataclasses.is_dataclass(thing):
        begin(type(thing).__qualname__)
        for field in dataclasses.fields(thing):
            if not (isinstance(thing, Recording) and field.name == "name"):
                begin(field.name)
                _feed(getattr(thing, field.name), update)
    elif isinstance(thing, Mapping):
        begin("mapping", len(thing))
        for name in sorted(thing, key=repr):
            begin("key", name)
            _feed(thing[name], update)
    elif hasattr(thing, "shape") and hasattr(thing, "dtype"):
        begin("array", str(thing.dtype), tuple(thing.shape))
        if len(thing.shape) == 0 or np.dtype(thing.dtype).kind == "O":
            _feed(np.asarray(thing).tolist(), update)
            return
        rows = HASHED_EVENTS if len(thing.shape) == 1 else HASHED_IMAGES
        for first in range(0, thing.shape[0], rows):
            update(np.ascontiguousarray(thing[first : first + rows]).tobytes())
    else:
        raise InputError(
            f"{describe_type(thing)} in a recording or a setting has no content that can be "
            "compared; remove it"
        )


def fingerprint(path: Path, update: Callable[[bytes], None]) -> None:
    """Feed a hash with the file's name, size and content; of a large file 64 pieces of 1 MiB."""
    size, piece = path.stat().st_size, 1 << 20
    update(f"{path.name} {size}".encode())
    step = max(piece, size // 64)
    with path.open("rb") as file:
        for first in range(0, size, step):
            file.seek(first)
            update(file.read(piece))
