"""A folder of results: made or left as it was, files complete or not at all."""

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
from jaxevent.show.report import flatten, markdown_table, means

if TYPE_CHECKING:
    import pandas

Write = Callable[[str, bytes], None]


class Rows(list[dict[str, Any]]):
    """Rows of results: a list of dicts that shows itself as a table."""

    def __repr__(self) -> str:
        return self.table()

    def table(self) -> str:
        """The rows as a Markdown table, aligned as plain text too."""
        return markdown_table(self)

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows as a pandas table; nested names are joined by dots, lists are left out."""
        import pandas

        flat = [flatten(row) for row in self]
        return pandas.DataFrame(
            [{k: v for k, v in row.items() if not isinstance(v, list)} for row in flat]
        )


class Evaluation(Rows):
    """Rows of `evaluate`, with the means of each method over recordings."""

    def means(self) -> "pandas.DataFrame":
        """The means over recordings: a line for each method, with the number of recordings.

        NaN where no recording has the number.
        """
        import pandas

        return pandas.DataFrame(means(self)).set_index("method")


class Fits(Rows):
    """Rows of `fit`, scores before and after, with the parameters that were found.

    Attributes:
        params_by_method: The fitted `Params` of each method, by label.
        found: A dict for each number that was fitted: `method`, `parameter`, `unit`, `start`,
            `found`, the ends `low` and `high` of its interval, `interval` in words, `remark`.
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
        """The fitted `Params`; raises `InputError` where several methods were fitted."""
        if len(self.params_by_method) > 1:
            labels = ", ".join(map(repr, self.params_by_method))
            raise InputError(
                f"several methods were fitted; choose one, as params_by_method[...] of {labels}"
            )
        return next(iter(self.params_by_method.values()))

    def table(self) -> str:
        """The scores of data that no fit saw, what was found and the gain, as Markdown."""
        return self._text


def check_folder(
    folder: Path,
    names: Sequence[str],
    inputs: Sequence[Path] = (),
    *,
    replace: bool,
    own: bool = False,
) -> None:
    """Raise `InputError` if writing files of these names into a folder would cost something.

    Inputs are never written over, existing files only if they are to be replaced or the folder is
    of a run that goes on: the caller's own. See `jaxevent.io.output.check_outputs`.
    """
    files = [folder / name for name in names]
    check_outputs(files, inputs, force=replace, inside=files if own else ())


def write_rows(
    rows: Iterable[dict[str, Any]],
    write: Write,
    table: Callable[[list[dict[str, Any]]], str] = markdown_table,
    **more: Any,
) -> None:
    """Write results.json, which holds `more` too, and results.md by a function of `results`."""
    rows = list(rows)
    text = json.dumps({"rows": rows, **more}, indent=1, allow_nan=False) + "\n"
    write("results.json", text.encode())
    write("results.md", table(rows).encode())


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep others from an existing folder; raises `InputError` where one keeps it already."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder))
        except BlockingIOError:
            raise InputError(
                f"{folder}: another process writes there; wait for it, or choose another folder"
            ) from None
        yield


@contextlib.contextmanager
def results(folder: Path) -> Iterator[Write]:
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
