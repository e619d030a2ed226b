"""Events as Apache Parquet, and as Feather (version 2, the file format of Arrow).

The columns have the names that `columns.NAMES` lists, in any order, with others beside them. Times
are whole numbers or floats whose unit is that of the name, or inferred (`time_units`), or of the
types timestamp and duration, which state it. Row groups are read in turn, so that events can be
left in the file. Needs the package pyarrow, of the extra `parquet`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError, require
from jaxevent.io import check_unfolded, reading
from jaxevent.io.columns import find, read_columns
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Recording


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a file. Raises `InputError` for bad input."""
    source = str(path)
    with path.open("rb") as file:
        is_parquet = file.read(4) == b"PAR1"
    with reading(source):
        groups: Any = _Parquet(path) if is_parquet else _Feather(path)
    fields = find(groups.names)
    if fields is None:
        raise InputError(
            f"{path}: has the columns {', '.join(groups.names)[:80]}; name those of the events t, "
            "x, y and p"
        )
    if options.size is None:
        raise InputError(
            f"{path}: the table does not tell the sensor's size; give size=(width, height) or "
            "--size"
        )
    columns = _Columns(groups, fields, source)
    return read_columns(path, columns.read, columns.count, fields["t"], options)


class _Columns:
    """Columns t, x, y and p of a table whose groups of rows are read when asked for."""

    def __init__(self, groups: Any, fields: dict[str, str], source: str):
        self._groups, self._fields, self._source = groups, fields, source
        self._ends = np.cumsum([0, *groups.rows])
        self._recent: tuple[int, dict[str, NDArray]] = (-1, {})
        self.count = int(self._ends[-1])

    def read(self, rows: slice) -> dict[str, NDArray]:
        """Read the columns of a range of rows."""
        start, stop, _ = rows.indices(self.count)
        pieces = []
        number = int(np.searchsorted(self._ends, start, side="right")) - 1
        while number < len(self._ends) - 1 and (self._ends[number] < stop or not pieces):
            first = int(self._ends[number])
            held = self._group(number)
            part = slice(max(start - first, 0), stop - first)
            pieces.append({name: values[part] for name, values in held.items()})
            number += 1
        if not pieces:
            return {name: np.empty(0, np.int64) for name in self._fields}
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in self._fields}

    def _group(self, number: int) -> dict[str, NDArray]:
        if self._recent[0] != number:
            names = list(self._fields.values())
            with reading(self._source):
                table = self._groups.read(number, names)
                held = {
                    key: _as_numpy(table.column(name), name, self._source)
                    for key, name in self._fields.items()
                }
            self._recent = (number, held)
        return self._recent[1]


def _as_numpy(column: Any, name: str, source: str) -> NDArray:
    if column.null_count:
        raise InputError(f"{source}: the column {name} has empty values; remove those events")
    values = column.to_numpy()
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind not in "iufmM":
        raise InputError(f"{source}: the column {name} is {column.type}; store numbers")
    return values


class _Parquet:
    def __init__(self, path: Path):
        self._file = require("pyarrow.parquet", "parquet").ParquetFile(path, memory_map=True)
        metadata = self._file.metadata
        groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
        check_unfolded(
            sum(group.total_byte_size for group in groups), path.stat().st_size, str(path)
        )
        self.names = [str(name) for name in self._file.schema_arrow.names]
        self.rows = [group.num_rows for group in groups]
        check_unfolded(8 * sum(self.rows), path.stat().st_size, str(path))

    def read(self, number: int, names: list[str]) -> Any:
        return self._file.read_row_group(number, columns=names)


class _Feather:
    def __init__(self, path: Path):
        arrow = require("pyarrow", "parquet")
        self._table = arrow.Table
        self._file = arrow.ipc.open_file(arrow.memory_map(str(path)))
        self.names = [str(name) for name in self._file.schema.names]
        self.rows = []
        for number in range(self._file.num_record_batches):
            self.rows.append(self._file.get_batch(number).num_rows)
            check_unfolded(8 * sum(self.rows), path.stat().st_size, str(path))

    def read(self, number: int, names: list[str]) -> Any:
        return self._table.from_batches([self._file.get_batch(number)]).select(names)
