"""Events and images that stay in files are pickled and copied by how these are opened."""

import functools
import os
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, Self

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.recording import Recording

P = ParamSpec("P")


class Opening:
    """The arguments of `load` by which a recording was opened."""

    def __init__(self, arguments: tuple[Any, ...], options: dict[str, Any]):
        self.arguments, self.options = arguments, options
        self._recording: Recording | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Opening, (self.arguments, self.options)

    def part(self, name: str) -> Any:
        """A part of the recording, which is opened once for all of them; None: it has none."""
        if self._recording is None:
            from jaxevent.io import load

            self._recording = load(*self.arguments, **self.options)
        return _parts(self._recording).get(name)


class InFile:
    """A part that stays in a file. A pickle or copy opens the file again, by its absolute path.

    What `load` did not open is read, and held in memory.
    """

    opened: tuple[Opening, str] | None = None  # and which part of the recording it is


class EventsInFile(InFile):
    """An `EventSource`."""

    def __reduce__(self) -> tuple[Any, ...]:
        it: Any = self
        if self.opened is None:
            return it[:].__reduce_ex__(2)
        return _events_again, (*self.opened, len(it))


class ImagesInFile(InFile):
    """An `ImageSource` of some images of a file."""

    _rows: Sequence[int]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, rows: slice | NDArray) -> Self:
        if isinstance(rows, slice):
            return self.of_file(self._rows[rows])
        return self.of_file([self._rows[i] for i in np.arange(len(self))[rows].tolist()])

    def of_file(self, rows: Sequence[int]) -> Self:
        """Other images of the file."""
        part = object.__new__(type(self))
        vars(part).update(vars(self), _rows=rows)
        return part

    def __reduce__(self) -> tuple[Any, ...]:
        it: Any = self
        if self.opened is None:
            return np.asarray, (np.asarray(it),)
        return _images_again, (*self.opened, self._rows, it.shape[1:], it.dtype)


def _parts(recording: Recording) -> dict[str, Any]:
    """All that may stay in a file, by name."""
    frames = recording.frames
    images = {} if frames is None else {"frames": frames.images}
    return {"events": recording.events, **images, **recording.extra}


def _events_again(opening: Opening, name: str, count: int) -> Any:
    found: Any = opening.part(name)
    if not isinstance(found, EventsInFile) or len(found) != count:
        raise _changed(opening, name)
    return found


def _images_again(
    opening: Opening, name: str, rows: Sequence[int], shape: tuple[int, ...], dtype: np.dtype
) -> Any:
    found: Any = opening.part(name)
    if isinstance(found, ImagesInFile) and set(rows) <= set(found._rows):
        part: Any = found.of_file(rows)
        if (part.shape[1:], part.dtype) == (shape, dtype):
            return part
    raise _changed(opening, name)


def _changed(opening: Opening, name: str) -> InputError:
    return InputError(
        f"{opening.arguments[0]}: no longer holds the {name} that were pickled; load it again"
    )


def reopens(load: Callable[P, Recording]) -> Callable[P, Recording]:
    """Have what a function like `load` leaves in a file know how that was opened."""

    @functools.wraps(load)
    def loaded(*arguments: P.args, **options: P.kwargs) -> Recording:
        recording = load(*arguments, **options)
        parts = {n: one for n, one in _parts(recording).items() if isinstance(one, InFile)}
        if parts:
            path: Any = options.pop("path") if "path" in options else arguments[0]
            opening = Opening((os.path.abspath(path), *arguments[1:]), dict(options))
            for name, one in parts.items():
                one.opened = opening, name
        return recording

    return loaded
