"""The names under which files hold the fields of events, and tables of named columns.

    t   t, ts, time, times, timestamp, timestamps, time_stamp; with a unit: timestamp_us, t [ns]
    x   x, xs                                    column from 0
    y   y, ys                                    row from 0, downwards
    p   p, ps, pol, pols, polarity, polarities, on   bool, 0/1 or -1/1

These are the names of tonic (x y t p), expelliarmus and OpenEB (t x y p), dv-processing (timestamp
x y polarity), faery and aedat (t x y on) and event_utils (ts xs ys ps). The order of the columns
does not count, as it differs from one program to the next; a table without names is refused.

Here are read NumPy arrays (.npy), structured or of shape (events, 4) or (4, events), and text: a
first line with the names, separated by commas, semicolons, tabs or blanks, then one line per event.
Lines before it that begin with # or % are passed over, but for names in them; a line of two whole
numbers before the events is the sensor's width and height, as rpg_e2vid writes it. Numbers between
semicolons or tabs may have decimal commas.

Four columns without names are told apart by what they hold (`order_of`): t x y p, x y p t, x y t p
or p t x y. Where more than one of these could be meant, the table is refused.

The unit of the times is that of the name, or inferred (`time_units`): usually us where all are
whole numbers, also as floats and in text, otherwise seconds. A polarity of -1 that was stored
without a sign, as v2e stores it, is the largest number of its type (`unsigned_off`).
"""

import codecs
import contextlib
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent import arrays
from jaxevent.arrays import NAMES, to_microseconds
from jaxevent.errors import InputError
from jaxevent.io import reading
from jaxevent.io.decoded import BLOCK, Columns, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.io.time_units import SAMPLE, InferredUnit, infer_unit, numbers_of_dates, unit_of_name
from jaxevent.recording import Recording

NUMPY_MAGIC = b"\x93NUMPY"
_BYTES = 1 << 24  # of text parsed together: about a million events
_LONGEST_LINE = 1 << 12
_SELDOM = 0.1  # share of events before which times that go back may fall
_TEXT_SAMPLE = 16 * SAMPLE  # bytes of text from which order, unit and signs are inferred
_ORDERS = ("txyp", "xypt", "xytp", "ptxy")
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]$|_px$")
_UNSIGNED = tuple((1 << bits) - 1 for bits in (8, 16, 32, 64))  # -1 without its sign


def find(names: Sequence[str]) -> dict[str, str] | None:
    """Return the names of t, x, y and p among some; None unless each is there, once.

    A name with a unit, as in "t_ns" or "x [px]", counts where there is none without.
    """
    if (found := arrays.find(names)) is not None:
        return found
    has_t = any(name.strip().lower() in NAMES["t"] for name in names)
    timed = [] if has_t else [name for name in names if unit_of_name(name)][:1]
    plain = {"t" if name in timed else _UNIT.sub("", name.strip().lower()): name for name in names}
    found = arrays.find(list(plain)) if len(plain) == len(names) else None
    return None if found is None else {field: plain[name] for field, name in found.items()}


def is_time(name: str) -> bool:
    """Return whether the name of a column is one of times, with a unit or without."""
    return name.strip().lower() in NAMES["t"] or unit_of_name(name) is not None


def stated_unit(name: str, t: NDArray) -> tuple[str, str] | None:
    """Return the unit that a column of times states by its type or name, and the words for how."""
    _, unit = numbers_of_dates(t)
    if unit is not None:
        return unit, f"the type {t.dtype}"
    unit = unit_of_name(name)
    return None if unit is None else (unit, f"the name {name.strip()!r}")


def as_rows(array: Any) -> Any:
    """Return an array of shape (events, 4) or (4, events) as (events, 4); None of another shape."""
    if array.ndim != 2 or array.dtype.kind not in "iuf" or 4 not in array.shape:
        return None
    return array if array.shape[1] == 4 else array.T


def first_and_last(
    fields: Callable[[slice], Mapping[str, NDArray]], count: int
) -> dict[str, NDArray]:
    """Return the columns of the first `SAMPLE` events, and of the last where there are more.

    Args:
        fields: Columns t, x, y and p of a range of rows.
        count: Number of events.
    """
    first = fields(slice(0, SAMPLE))
    if count <= SAMPLE:
        return dict(first)
    last = fields(slice(count - 1, count))
    return {name: np.concatenate([first[name], last[name]]) for name in first}


def unsigned_off(p: NDArray) -> float | None:
    """Return the largest number of 8, 16, 32 or 64 bits that stands for -1 in polarities.

    Args:
        p: (n,) polarities of a file.

    Returns:
        The number where it occurs and 0 does not; else None.
    """
    if p.dtype.kind not in "iuf" or not len(p):
        return None
    most = p.max()
    kind = p.dtype.type if p.dtype.kind == "f" else np.float64
    is_off = any(kind(number) == kind(most) for number in _UNSIGNED)
    return float(most) if is_off and ((p == most) | (p == 1)).all() else None


def signed(p: NDArray, off: float | None) -> NDArray:
    """Return polarities with -1 in place of the number `off` of `unsigned_off`."""
    if off is None:
        return p
    values = p.astype(np.float64)  # exact for the numbers of `unsigned_off` and for small ones
    return np.where(values == off, -1.0, values)


def order_of(rows: NDArray, size: tuple[int, int] | None, source: str) -> str:
    """The order of four columns without names, as "txyp", from the first rows (rows, 4).

    Times never fall, coordinates are whole numbers on the sensor of `size` (width, height), and
    polarities are 0 and 1 or -1 and 1. Raises `InputError` unless one order alone fits.
    """

    def is_p(values: NDArray) -> bool:
        if unsigned_off(values) is not None:
            return True
        return bool(np.isin(values, (0, 1)).all() or np.isin(values, (-1, 1)).all())

    def is_place(values: NDArray, count: int) -> bool:
        return bool(((values >= 0) & (values < count) & (values == np.rint(values))).all())

    def fits(order: str, width: int, height: int, falls: float) -> bool:
        t, x, y, p = (rows[:, order.index(name)] for name in "txyp")
        is_sorted = np.count_nonzero(t[1:] < t[:-1]) <= falls * len(t)
        return bool(is_sorted) and is_p(p) and is_place(x, width) and is_place(y, height)

    largest = (1 << 16, 1 << 16)
    fitting: list[str] = []
    # On a sensor too small for them the one order will do, so that the event outside is named, and
    # where no column never falls, one that seldom does, so that the fault of its times is named.
    for falls in (0.0, _SELDOM):
        for sides in (size or largest, largest):
            fitting = fitting or [order for order in _ORDERS if fits(order, *sides, falls)]
    if len(fitting) != 1:
        named = " or ".join(" ".join(order) for order in (fitting or _ORDERS))
        raise InputError(
            f"{source}: its four columns without names {'could' if fitting else 'cannot'} be "
            f"{named}; sort by time, or name the columns: a line 't x y p' before the events, or "
            "an array with these fields"
        )
    return fitting[0]


def of_records(records: NDArray, source: str) -> dict[str, NDArray]:
    """The fields t, x, y and p of a structured array of events, or `InputError`."""
    fields = find(records.dtype.names or ())
    if records.ndim != 1 or fields is None:
        held = ", ".join(records.dtype.names or ()) or str(records.dtype)
        raise InputError(
            f"{source}: holds an array of {held[:80]} of shape {records.shape}; store a list of "
            "records with the fields t, x, y and p"
        )
    return {key: records[name] for key, name in fields.items()}


def read_npy(path: Path, options: ReadOptions) -> Recording:
    """Read an array. Raises `InputError` for bad input."""
    source, size = str(path), options.size
    with reading(source):
        records = np.load(path, mmap_mode="r", allow_pickle=False)
    plain = as_rows(records)
    name = "" if plain is not None else _name_of_times(records, source)
    if size is None:
        raise InputError(
            f"{path}: an array does not tell the sensor's size; give size=(width, height) or --size"
        )
    order = "" if plain is None else order_of(np.array(plain[:SAMPLE]), size, source)
    count = len(records) if plain is None else len(plain)

    def fields_of(rows: slice) -> dict[str, NDArray]:
        if plain is not None:
            held = np.array(plain[rows])
            return {name: held[:, order.index(name)] for name in "txyp"}
        return of_records(np.array(records[rows]), source)

    return read_columns(path, fields_of, count, name, options)


def _name_of_times(records: NDArray, source: str) -> str:
    of_records(records, source)
    return (find(records.dtype.names or ()) or {})["t"]


def read_columns(
    path: Path,
    fields_of: Callable[[slice], Mapping[str, NDArray]],
    count: int,
    name: str,
    options: ReadOptions,
) -> Recording:
    """Read events of which any range of rows can be had; `options` hold the sensor's size.

    Args:
        path: The file.
        fields_of: Columns t, x, y and p of a range of rows.
        count: Number of events.
        name: Name of the column of times.
        options: Choices of the caller.

    Raises:
        InputError: The events are not valid.
    """
    source, size = str(path), options.size
    assert size is not None
    sample = first_and_last(fields_of, count)
    stated = stated_unit(name, sample["t"])
    sample["t"] = numbers_of_dates(sample["t"])[0]
    unit = infer_unit(sample, count, size, source, options, stated=stated)
    off = unsigned_off(sample["p"])

    def decode(state: int | None) -> Iterator[tuple[int, Columns]]:
        for row in range(state or 0, count, BLOCK):
            fields = fields_of(slice(row, row + BLOCK))
            t = to_microseconds(numbers_of_dates(fields["t"])[0], unit.name, source, "event", row)
            x, y, p = (np.ascontiguousarray(fields[key]) for key in "xyp")
            yield row, (t, x, y, signed(p, off))

    events = decoded(decode, size, source, options)
    return Recording(path.stem, *size, events, notes=unit.notes)


def is_text(head: bytes) -> bool:
    """Whether a file that begins so can be a table of text."""
    head = head.removeprefix(codecs.BOM_UTF8)
    return bool(re.match(rb"[ -~\t\r\n]*[ -~\t\r\n\x80-\xff]{0,3}\Z", head)) and bool(
        re.search(rb"\d", head) or find(_split(head.splitlines()[0].decode("latin-1")))
    )


def read_text(path: Path, options: ReadOptions) -> Recording:
    """Read a table of text. Raises `InputError` for bad input."""
    source = str(path)
    with reading(source), path.open("rb") as file:
        table = _table(file, source)
    size = options.size or table.size
    sample, table = _sample(path, table, size)
    if size is None:
        raise InputError(
            f"{path}: the table does not tell the sensor's size; give size=(width, height) or "
            "--size"
        )
    count = table.count_rows(path, len(sample["t"]))
    stated = stated_unit(table.fields["t"], sample["t"]) if table.has_names else None
    unit = infer_unit(sample, count, size, source, options, stated=stated)
    table = dataclasses.replace(table, unit=unit, off=unsigned_off(sample["p"]))
    decode = functools.partial(_rows, path, table)
    events = decoded(decode, size, source, options)
    return Recording(path.stem, *size, events, notes=unit.notes)


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
        unit: Unit of the times.
        off: Number that stands for the polarity -1.
    """

    start: int
    names: list[str]
    fields: Mapping[str, str]
    separator: str
    decimal: str
    size: tuple[int, int] | None
    has_names: bool = False
    has_decimals: bool = False
    unit: InferredUnit = InferredUnit("us")
    off: float | None = None

    def count_rows(self, path: Path, sampled: int) -> int:
        """Estimate the number of events in a file from those of its first part."""
        held = path.stat().st_size - self.start
        return round(sampled * max(held / _TEXT_SAMPLE, 1.0))


def _split(line: str) -> list[str]:
    """The fields of a line, by the separator that it has."""
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


def _table(file: Any, source: str) -> _Table:
    """What the lines before the first event tell, and how the first event is written."""
    size = None
    names: list[str] | None = None
    while True:
        start = file.tell()
        raw = file.readline(_LONGEST_LINE)
        if len(raw) == _LONGEST_LINE:
            raise InputError(f"{source}: has a line of over {_LONGEST_LINE} bytes; {_WANTED}")
        if not raw:
            raise InputError(f"{source}: holds no event; {_WANTED}")
        line = raw.decode("utf-8-sig" if start == 0 else "utf-8", "replace").strip()
        geometry = re.match(r"[#%]\s*geometry\s*[:=]?\s*(\d{1,5})\s*[,x ]\s*(\d{1,5})\s*$", line)
        if geometry:
            size = (int(geometry.group(1)), int(geometry.group(2)))
        if not line or line[0] in "#%":
            # A line of names may be a comment too: "# t x y p".
            bare = _split(line.lstrip("#% "))
            names = bare if line and find(bare) else names
            continue
        fields = _split(line)
        if names is None and find(fields):
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
            raise InputError(f"{source}: the line {line[:60]!r} comes before any names; {_WANTED}")
        return _Table(start, list("0123"), {}, mark, decimal, size)
    if len(fields) != len(names) or len(set(names)) != len(names):
        raise InputError(
            f"{source}: the line {line[:60]!r} does not have the columns {', '.join(names)[:80]}; "
            "each line must have one value for each name"
        )
    return _Table(start, names, find(names) or {}, mark, decimal, size, has_names=True)


def _sample(
    path: Path, table: _Table, size: tuple[int, int] | None
) -> tuple[dict[str, NDArray], _Table]:
    """Return the first events and the last one, and the table with the order of its columns."""
    with reading(str(path)), path.open("rb") as file:
        file.seek(table.start)
        text = file.read(_TEXT_SAMPLE)
        end = b""
        if len(text) == _TEXT_SAMPLE:
            text = text[: text.rfind(b"\n") + 1]
            file.seek(-min(_LONGEST_LINE, path.stat().st_size - table.start), 2)
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


_WANTED = (
    "a table of events begins with a line of names such as t,x,y,p, and each line after it is one "
    "event"
)


def _is_number(field: str) -> bool:
    try:
        return math.isfinite(float(field))
    except ValueError:
        return False


def _rows(
    path: Path, table: _Table, state: tuple[int, int] | None
) -> Iterator[tuple[tuple[int, int], Columns]]:
    """Events of the lines from a place on: its offset in bytes and the number of events before."""
    offset, row = state or (table.start, 0)
    with path.open("rb") as file:
        file.seek(offset)
        rest = b""
        while piece := file.read(_BYTES - len(rest)):
            text = rest + piece
            cut = text.rfind(b"\n") + 1
            if len(text) < _BYTES:
                cut = len(text)  # the last line may lack its end
            elif not cut:
                raise InputError(f"{path}: has a line of over {_BYTES} bytes; {_WANTED}")
            columns = _parsed(path, table, text[:cut], row)
            yield (offset, row), columns
            row += len(columns[0])
            offset += cut
            rest = text[cut:]


def _parsed(path: Path, table: _Table, text: bytes, row: int) -> Columns:
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
    t = to_microseconds(t, table.unit.name, str(path), "event", row)
    return t, columns["x"], columns["y"], signed(columns["p"], table.off)


def _numbers(path: Path, table: _Table, text: bytes, row: int) -> dict[str, NDArray]:
    """The columns of some lines by the table's fields, integers where all are whole."""
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
        raise InputError(f"{path}: has too many columns; {_WANTED}")
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
                        f"{path}: event {row + bad} has {name} = {held[:40]}; {_WANTED}"
                    )
                words = [str(value).strip().lower() for value in values]
                numbers = np.array([{"true": 1, "false": 0}.get(word, 9) for word in words])
            values = numbers
        columns[key] = values
    return columns
