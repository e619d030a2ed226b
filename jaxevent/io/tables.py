"""Tables of events: text, NumPy arrays and archives, Parquet and Feather.

The events have the names that `columns` lists, and their times a unit that is stated or inferred
(`time_units`).

Text has a first line with the names, separated by commas, semicolons, tabs or blanks, then one line
per event. Lines before it that begin with # or % are passed over, but for names in them. A line of
two whole numbers before the events is the sensor's width and height, as rpg_e2vid writes it.
Numbers between semicolons or tabs may have decimal commas.

NumPy arrays (.npy) are structured or of shape (events, 4) or (4, events). Archives (.npz) hold

    t, x, y, p            events: times, columns, rows, polarity (bool, 0/1 or -1/1)
    width, height         pixels
    frames                (frames, height, width[, 3]) uint8, uint16 or floats in [0, 1]
    frame_t               mid-exposure times
    exp_start, exp_end    start and end of the exposures; where present, frame_t is not used
    imu_t, gyro, acc      (samples,), (samples, 3) rad/s, (samples, 3) m/s^2
    calib                 fx fy cx cy k1 k2 p1 p2 k3; of another lens model of `jaxevent.camera`
                          its numbers
    calib_model           the name of that model

Times are usually integers in microseconds or floats in seconds, those of events in microseconds too
where all are whole; names may state a unit, as in frame_t_ns. Only the events are required, and
width and height where there are no frames. The events may stand together in one array of any name.
Every other array is kept in `Recording.extra`.

Of Parquet and of Feather (version 2, the file format of Arrow) the row groups are read in turn, so
that events can be left in the file. Times may be of the types timestamp and duration, which state
their unit. Needs the package pyarrow, of the extra `parquet`.
"""

import codecs
import contextlib
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import as_images
from jaxevent.errors import InputError, require
from jaxevent.io.checks import (
    ReadOptions,
    check_unfolded,
    image_size,
    make_camera,
    reading,
    sensor_size,
    whole_size,
)
from jaxevent.io.columns import (
    ColumnFormat,
    Fields,
    as_rows,
    find_fields,
    infer_format,
    order_of,
    read_columns,
    read_whole_columns,
    record_fields,
    split_rows,
)
from jaxevent.io.decoded import Columns, read_events
from jaxevent.recording import Frames, Imu, Recording
from jaxevent.time_units import SAMPLE_EVENTS, numbers_of_dates, split_unit

if TYPE_CHECKING:
    import pandas as pd

NUMPY_MAGIC = b"\x93NUMPY"
_TEXT_BLOCK_BYTES = 1 << 24  # of text parsed together: about a million events
_MAX_LINE_BYTES = 1 << 12
# Bytes of text from which order, unit and signs are inferred.
_TEXT_SAMPLE_BYTES = 16 * SAMPLE_EVENTS
# Arrays of an archive that hold other times than those of the events.
_OTHER_TIME_ARRAYS = ("frame_t", "exp_start", "exp_end", "imu_t")
_NO_SIZE = "the table does not state the sensor's size"


def read_npy(path: Path, options: ReadOptions) -> Recording:
    """Read an array of events.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording.

    Raises:
        InputError: The file is damaged or its events are not valid.
    """
    source = str(path)
    with reading(source):
        records = np.load(path, mmap_mode="r", allow_pickle=False)
    rows = as_rows(records)
    names = {} if rows is not None else record_fields(records, source)
    size = sensor_size(f"{path}: {_NO_SIZE}", options.size)
    if rows is None:
        fields: Fields = lambda part: _record_columns(np.array(records[part]), names)  # noqa: E731
    else:
        order = order_of(np.array(rows[:SAMPLE_EVENTS]), size, source)
        fields = lambda part: split_rows(np.array(rows[part]), order)  # noqa: E731
    count = len(records if rows is None else rows)
    found = read_columns(fields, count, size, source, options, name=names.get("t", ""))
    return Recording(path.stem, *size, found.events, notes=tuple(found.notes))


def _record_columns(records: NDArray, names: Mapping[str, str]) -> dict[str, NDArray]:
    """Return the columns of a structured array.

    Args:
        records: (n,) structured array.
        names: Names of its fields by "t", "x", "y" and "p".

    Returns:
        Contiguous columns (n,) by these names.
    """
    return {key: np.ascontiguousarray(records[name]) for key, name in names.items()}


def read_npz(path: Path, options: ReadOptions) -> Recording:
    """Read an archive of arrays.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording.

    Raises:
        InputError: The file is damaged or its arrays are not valid.
    """
    source = str(path)
    arrays: dict[str, NDArray] = {}
    with reading(source), np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            with reading(f"{path}: {name}"):
                arrays[name] = archive[name]
            if not isinstance(arrays[name], np.ndarray):
                raise InputError(f"{path}: {name} is not a NumPy array; remove or replace it")
    name_of_t, rows = _name_events(path, arrays)
    stated = {}
    for name in list(arrays):
        base, unit = split_unit(name)
        if base in _OTHER_TIME_ARRAYS and unit is not None and base not in arrays:
            arrays[base], stated[base] = arrays.pop(name), unit

    def take(*names: str) -> list[NDArray]:
        missing = [name for name in names if name not in arrays]
        if missing:
            raise InputError(f"{path}: has no {' and no '.join(missing)}; add the arrays")
        return [arrays.pop(name) for name in names]

    columns = {} if rows is not None else dict(zip("txyp", take("t", "x", "y", "p"), strict=True))
    images = take("frames")[0] if "frames" in arrays else None
    if images is not None and images.ndim != 3:
        try:
            images, colours = as_images(images)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if colours is not None:
            arrays.setdefault("rgb", colours)
    sides = [arrays.pop(name) for name in ("width", "height") if name in arrays]
    stored = whole_size(*sides, source) if options.size is None and len(sides) == 2 else None
    otherwise = f"{path}: has no width and height and no frames"
    size = sensor_size(otherwise, options.size, stored, image_size(images))
    if rows is not None:
        columns = split_rows(rows, order_of(rows[:SAMPLE_EVENTS], size, source))
    events, clock, notes = read_whole_columns(columns, size, source, options, name=name_of_t)

    def stamps(name: str, what: str) -> NDArray[np.int64]:
        values, of_type = numbers_of_dates(take(name)[0])
        return clock.read(values, source, what, notes, stated=of_type or stated.get(name))

    frames = None if images is None else _frames(path, images, arrays, stamps)
    imu = camera = None
    if "imu_t" in arrays:
        imu = Imu(stamps("imu_t", "IMU sample"), *take("gyro", "acc"))
    if "calib" in arrays:
        model = str(arrays.pop("calib_model", "radtan"))
        camera = make_camera(arrays.pop("calib"), f"{path}: calib", model)
    return Recording(
        path.stem, *size, events, frames, camera, imu=imu, extra=arrays, notes=tuple(notes)
    )


def _name_events(path: Path, arrays: dict[str, NDArray]) -> tuple[str, NDArray | None]:
    """Give the columns of events the names t, x, y and p among the arrays, in place.

    Args:
        path: The file.
        arrays: Arrays of the file by name.

    Returns:
        The name that the column of times had, and events (n, 4) in place of columns. The latter
            stand
        in one array without names, whose order is inferred.
    """
    # An archive of the layout may hold more times: t is t wherever there is one.
    fields = find_fields([name for name in arrays if name in "txyp"]) or find_fields(list(arrays))
    if fields is not None:
        found = {field: arrays.pop(name) for field, name in fields.items()}
        arrays |= found
        return fields["t"], None
    records = [name for name, array in arrays.items() if array.dtype.names is not None]
    if len(records) == 1:
        names = record_fields(arrays[records[0]], f"{path}: {records[0]}")
        arrays |= _record_columns(arrays.pop(records[0]), names)
        return names["t"], None
    plain = [name for name, array in arrays.items() if as_rows(array) is not None]
    if len(plain) == 1 or "events" in plain:
        return "", as_rows(arrays.pop("events" if "events" in plain else plain[0]))
    return "", None


def _frames(
    path: Path,
    images: NDArray,
    arrays: dict[str, NDArray],
    stamps: Callable[[str, str], NDArray[np.int64]],
) -> Frames | None:
    if "exp_start" in arrays or "exp_end" in arrays:
        missing = [name for name in ("exp_start", "exp_end") if name not in arrays]
        if missing:
            raise InputError(f"{path}: has no {missing[0]}; add the arrays")
        start, end = stamps("exp_start", "exposure"), stamps("exp_end", "exposure")
        arrays.pop("frame_t", None)
        if len(start) != len(end):
            raise InputError(
                f"{path}: exp_start and exp_end have {len(start)} and {len(end)} values; "
                "give one of each per frame"
            )
        t, exposure = start + (end - start) // 2, end - start
    elif "frame_t" in arrays:
        t = stamps("frame_t", "frame")
        exposure = np.zeros_like(t)
    else:
        raise InputError(
            f"{path}: frames have no times; add frame_t (mid-exposure) or exp_start and exp_end"
        )
    return Frames(t, images, exposure) if len(images) or len(t) else None


def is_text(head: bytes) -> bool:
    """Return whether a file that begins with some bytes can be a table of text."""
    head = head.removeprefix(codecs.BOM_UTF8)
    return bool(re.match(rb"[ -~\t\r\n]*[ -~\t\r\n\x80-\xff]{0,3}\Z", head)) and bool(
        re.search(rb"\d", head) or find_fields(_split(head.splitlines()[0].decode("latin-1")))
    )


def read_text(path: Path, options: ReadOptions) -> Recording:
    """Read a table of text.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording.

    Raises:
        InputError: A line or an event is not valid.
    """
    source = str(path)
    with reading(source), path.open("rb") as file:
        table = _read_head(file, source)
    size = options.size or table.size
    sample, table = _read_sample(path, table, size)
    size = sensor_size(f"{path}: {_NO_SIZE}", size)
    # The number of events is estimated from those of the first part.
    held = (path.stat().st_size - table.start) / _TEXT_SAMPLE_BYTES
    count = round(len(sample["t"]) * max(held, 1.0))
    name = table.fields["t"] if table.has_names else ""
    found = infer_format(sample, count, size, source, options, name=name)
    table = dataclasses.replace(table, format=found)
    events = read_events(functools.partial(_decode, path, table), size, source, options)
    return Recording(path.stem, *size, events, notes=found.unit.notes)


@dataclasses.dataclass(frozen=True)
class _Table:
    """The layout of a table of text.

    Attributes:
        start: Offset of the first event in bytes.
        names: Of all columns.
        fields: Names of the columns t, x, y and p.
        separator: Between columns, a regular expression.
        decimal: Mark of decimals.
        size: (width, height) of the sensor, where the table states it.
        has_names: Whether the names are those of the file.
        has_decimals: Whether times have decimals.
        format: Unit of the times and signs of the polarities.
    """

    start: int
    names: list[str]
    fields: Mapping[str, str]
    separator: str
    decimal: str
    size: tuple[int, int] | None
    has_names: bool = False
    has_decimals: bool = False
    format: ColumnFormat = ColumnFormat()


def _split(line: str) -> list[str]:
    """Split a line into its fields, by the separator that it has."""
    line = line.strip()
    separator = _separator(line)
    if separator is None:  # a unit belongs to its name: "t [us] x y p"
        line = re.sub(r"\s+(?=[\[(])", "", line)
    return [field.strip().strip('"') for field in line.split(separator)]


def _separator(line: str) -> str | None:
    """Return the mark between the fields of a line; None of blanks.

    A comma beside semicolons or tabs is a decimal one.
    """
    return next((mark for mark in ";\t," if mark in line), None)


def _read_head(file: Any, source: str) -> _Table:
    """Read the lines before the first event, and infer how the events are written.

    Args:
        file: File open for reading bytes, at its start; afterwards behind the first event.
        source: Name of the file for messages.

    Returns:
        Layout of the table, and where its first event begins.

    Raises:
        InputError: The file holds no table of events.
    """
    size = None
    names: list[str] | None = None
    while True:
        start = file.tell()
        raw = file.readline(_MAX_LINE_BYTES)
        if len(raw) == _MAX_LINE_BYTES:
            raise InputError(
                f"{source}: has a line of over {_MAX_LINE_BYTES} bytes; {_WANTED_LAYOUT}"
            )
        if not raw:
            raise InputError(f"{source}: holds no event; {_WANTED_LAYOUT}")
        line = raw.decode("utf-8-sig" if start == 0 else "utf-8", "replace").strip()
        geometry = re.match(r"[#%]\s*geometry\s*[:=]?\s*(\d{1,5})\s*[,x ]\s*(\d{1,5})\s*$", line)
        if geometry:
            size = (int(geometry.group(1)), int(geometry.group(2)))
        if not line or line[0] in "#%":
            # A line of names may be a comment too: "# t x y p".
            bare = _split(line.lstrip("#% "))
            names = bare if line and find_fields(bare) else names
            continue
        fields = _split(line)
        if names is None and find_fields(fields):
            names = fields
            continue
        if len(fields) == 2 and all(re.fullmatch(r"[1-9]\d{0,4}", field) for field in fields):
            size = (int(fields[0]), int(fields[1]))
            continue
        break
    mark = _separator(line) or r"\s+"
    has_comma = mark != "," and any(re.fullmatch(r"[+-]?\d*,\d+", field) for field in fields)
    decimal = "," if has_comma else "."
    if names is None:
        numbers = [field.replace(decimal, ".") for field in fields]
        if len(fields) != 4 or not all(_is_number(field) for field in numbers):
            raise InputError(
                f"{source}: the line {line[:60]!r} is neither names of the columns t, x, y and p "
                f"nor four numbers; {_WANTED_LAYOUT}"
            )
        return _Table(start, list("0123"), {}, mark, decimal, size)
    if len(fields) != len(names) or len(set(names)) != len(names):
        raise InputError(
            f"{source}: the line {line[:60]!r} does not have the columns {', '.join(names)[:80]}; "
            "each line must have one value for each name"
        )
    return _Table(start, names, find_fields(names) or {}, mark, decimal, size, has_names=True)


def _read_sample(
    path: Path, table: _Table, size: tuple[int, int] | None
) -> tuple[dict[str, NDArray], _Table]:
    """Read the first events and the last one.

    Args:
        path: The file.
        table: The table, whose columns may be unnamed.
        size: (width, height) of the sensor in px.

    Returns:
        Columns of the events, and the table with the order of its columns.
    """
    with reading(str(path)), path.open("rb") as file:
        file.seek(table.start)
        text = file.read(_TEXT_SAMPLE_BYTES)
        end = b""
        if len(text) == _TEXT_SAMPLE_BYTES:
            text = text[: text.rfind(b"\n") + 1]
            file.seek(-min(_MAX_LINE_BYTES, path.stat().st_size - table.start), 2)
            end = file.read().rstrip()
            end = end[end.rfind(b"\n") + 1 :] + b"\n"
    every = dataclasses.replace(table, fields={name: name for name in table.names})
    if not table.fields:
        columns = _numbers(path, every, text, 0)
        order = order_of(np.stack([np.asarray(c) for c in columns.values()], 1), size, str(path))
        fields = {name: table.names[order.index(name)] for name in "txyp"}
        table = dataclasses.replace(table, fields=fields)
    sample = _numbers(path, table, text, 0)
    with contextlib.suppress(InputError):  # a bad last line is found when it is its turn
        if end.strip():
            last = _numbers(path, table, end, 0)
            sample = {name: np.concatenate([sample[name], last[name]]) for name in sample}
    return sample, dataclasses.replace(table, has_decimals=sample["t"].dtype.kind == "f")


_WANTED_LAYOUT = (
    "a table of events begins with a line of names such as t,x,y,p, and each line after it is one "
    "event"
)


def _is_number(field: str) -> bool:
    try:
        return math.isfinite(float(field))
    except ValueError:
        return False


def _decode(
    path: Path, table: _Table, state: tuple[int, int] | None
) -> Iterator[tuple[tuple[int, int], Columns]]:
    """Decode lines of a table.

    Args:
        path: The file.
        table: Its layout.
        state: Offset in bytes, and number of events before it; None: the start.

    Yields:
        The state before a block, and its columns.
    """
    offset, row = state or (table.start, 0)
    with path.open("rb") as file:
        file.seek(offset)
        rest = b""
        while piece := file.read(_TEXT_BLOCK_BYTES - len(rest)):
            text = rest + piece
            cut = text.rfind(b"\n") + 1
            if len(text) < _TEXT_BLOCK_BYTES:
                cut = len(text)  # the last line may lack its end
            elif not cut:
                raise InputError(
                    f"{path}: has a line of over {_TEXT_BLOCK_BYTES} bytes; {_WANTED_LAYOUT}"
                )
            columns = _parse_lines(path, table, text[:cut], row)
            yield (offset, row), columns
            row += len(columns[0])
            offset += cut
            rest = text[cut:]


def _parse_lines(path: Path, table: _Table, text: bytes, row: int) -> Columns:
    if not text.strip():
        none = np.empty(0)
        return none.astype(np.int64), none, none, none
    columns = _numbers(path, table, text, row)
    t = columns["t"]
    if table.has_decimals and t.dtype.kind != "f":
        t = t.astype(np.float64)
    elif not table.has_decimals and t.dtype.kind == "f":
        raise InputError(
            f"{path}: the times of the events from number {row} on have decimals, those before "
            "have none; write all as whole microseconds or all as seconds with decimals"
        )
    return table.format.convert({**columns, "t": t}, str(path), row)


def _numbers(path: Path, table: _Table, text: bytes, row: int) -> dict[str, NDArray]:
    """Parse the columns of some lines, as integers where all numbers are whole.

    Args:
        path: The file.
        table: Its layout.
        text: The lines.
        row: Number of the first of their events, for messages.

    Returns:
        Arrays (n,) by the table's fields.

    Raises:
        InputError: A value is no number, or lines have too many columns.
    """
    # The import takes a third of a second.
    import pandas as pd

    with reading(str(path)):
        try:
            frame = pd.read_csv(
                BytesIO(text),
                sep=table.separator,
                header=None,
                names=table.names,
                engine="c",
                low_memory=False,
                quoting=3,
                comment="#",
                decimal=table.decimal,
            )
        except pd.errors.EmptyDataError:
            frame = pd.DataFrame({name: np.empty(0) for name in table.names})
    if not isinstance(frame.index, pd.RangeIndex):  # pandas makes surplus columns the index
        raise InputError(f"{path}: has too many columns; {_WANTED_LAYOUT}")
    columns = {}
    for key, name in table.fields.items():
        values = frame[name].to_numpy()
        if values.dtype.kind not in "iub":
            numbers = np.asarray(pd.to_numeric(frame[name], errors="coerce"), np.float64)
            if not np.isfinite(numbers).all():
                bad = int(np.argmin(np.isfinite(numbers)))
                held = str(values[bad])
                if key != "p" or held.strip().lower() not in ("true", "false"):
                    raise InputError(
                        f"{path}: event {row + bad} has {name} = {held[:40]}; {_WANTED_LAYOUT}"
                    )
                words = [str(value).strip().lower() for value in values]
                numbers = np.array([{"true": 1, "false": 0}.get(word, 9) for word in words])
            values = numbers
        columns[key] = values
    return columns


def read_parquet(path: Path, options: ReadOptions) -> Recording:
    """Read a Parquet or Feather file.

    Args:
        path: The file.
        options: Options of `jaxevent.io.load`.

    Returns:
        The recording.

    Raises:
        InputError: The file is damaged or its events are not valid.
    """
    source = str(path)
    with path.open("rb") as file:
        is_parquet = file.read(4) == b"PAR1"
    with reading(source):
        groups: Any = _Parquet(path) if is_parquet else _Feather(path)
    fields = find_fields(groups.names)
    if fields is None:
        raise InputError(
            f"{path}: has the columns {', '.join(groups.names)[:80]}; name those of the events t, "
            "x, y and p"
        )
    size = sensor_size(f"{path}: {_NO_SIZE}", options.size)
    rows = _RowGroups(groups, fields, source)
    found = read_columns(rows.read, rows.count, size, source, options, name=fields["t"])
    return Recording(path.stem, *size, found.events, notes=tuple(found.notes))


class _RowGroups:
    """Columns t, x, y and p of a table whose groups of rows are read when needed."""

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
    """Convert a column of a Parquet file to numbers.

    Args:
        column: Column of pyarrow.
        name: Its name, for messages.
        source: Name of the file, for messages.

    Returns:
        (n,).

    Raises:
        InputError: It has empty values, or no numbers.
    """
    if column.null_count:
        raise InputError(f"{source}: the column {name} has empty values; remove those events")
    values = column.to_numpy()
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind not in "iufmM":
        raise InputError(f"{source}: the column {name} is {column.type}; store numbers")
    return values


class _Parquet:
    """The groups of rows of a Parquet file."""

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
    """The groups of rows of a Feather file."""

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


def read_table(path: Path, wanted: str) -> "pd.DataFrame":
    """Read a CSV table with named columns.

    Args:
        path: The file.
        wanted: What to do where it is no table, for the message.

    Returns:
        The table.

    Raises:
        InputError: The file cannot be read or is no table.
    """
    import pandas as pd  # the import takes a third of a second

    try:
        return pd.read_csv(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:
        raise InputError(f"{path}: is no table ({error}); {wanted}") from None
