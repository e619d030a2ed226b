"""The names under which files hold the fields of events, and tables of named columns.

    t   t, ts, time, timestamp, timestamps       us where integers, seconds where floats
    x   x, xs                                    column from 0
    y   y, ys                                    row from 0, downwards
    p   p, ps, pol, pols, polarity, polarities, on   bool, 0/1 or -1/1

These are the names of tonic (x y t p), expelliarmus and OpenEB (t x y p), dv-processing (timestamp
x y polarity), faery and aedat (t x y on) and event_utils (ts xs ys ps). The order of the columns
does not count, as it differs from one program to the next; a table without names is refused.

Here are read NumPy arrays (.npy), structured or of shape (events, 4), and text: a first line with
the names, separated by commas, semicolons, tabs or blanks, then one line per event. Lines before it
that begin with # or % are passed over; a line of two whole numbers before the events is the
sensor's width and height, as rpg_e2vid writes it.

Four columns without names are told apart by what they hold (`order_of`): t x y p, x y p t, x y t p
or p t x y. Where more than one of these could be meant, the table is refused.

Times that all are whole numbers are us, also as floats and in text; other floats are seconds.
"""

import codecs
import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.io import reading, times
from jaxevent.io.decoded import BLOCK, Columns, decoded
from jaxevent.io.options import ReadOptions
from jaxevent.recording import Recording

NAMES = {
    "t": ("t", "ts", "time", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on"),
}
NUMPY_MAGIC = b"\x93NUMPY"
_BYTES = 1 << 24  # of text parsed together: about a million events
_LONGEST_LINE = 1 << 12
_SAMPLE = 1 << 16  # events, or 16 times as many bytes of text, that tell order and unit
_SELDOM = 0.1  # share of events before which times that go back may fall
_LONGEST = 1_000_000  # seconds of a recording
_ORDERS = ("txyp", "xypt", "xytp", "ptxy")


def find(names: Sequence[str]) -> dict[str, str] | None:
    """Which of some names are t, x, y and p; None unless each is there, once."""
    found = {}
    for field, aliases in NAMES.items():
        fitting = [name for name in names if name.strip().lower() in aliases]
        if len(fitting) != 1:
            return None
        found[field] = fitting[0]
    return found


def order_of(rows: NDArray, size: tuple[int, int] | None, source: str) -> str:
    """The order of four columns without names, as "txyp", from the first rows (rows, 4).

    Times never fall, coordinates are whole numbers on the sensor of `size` (width, height), and
    polarities are 0 and 1 or -1 and 1. Raises `InputError` unless one order alone fits.
    """

    def is_p(values: NDArray) -> bool:
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


def time_scale(t: NDArray, source: str) -> float:
    """How many us one unit of the events' times is, from some of them: 1 or 1e6.

    Integers are us. Floats that all are whole and not all equal are us too, as no recording has
    its events at whole seconds; others are seconds. Raises `InputError` where these would span
    more than `_LONGEST` seconds.
    """
    if t.dtype.kind != "f" or not len(t):
        return 1e6
    finite = t[np.isfinite(t)].astype(np.float64)
    span = float(finite.max() - finite.min()) if len(finite) else 0.0
    if span > 0 and (finite == np.rint(finite)).all():
        return 1.0
    if span > _LONGEST:
        raise InputError(
            f"{source}: the times are floats that are not whole, so seconds, but span "
            f"{span / 86400:.0f} days; store them as integer microseconds"
        )
    return 1e6


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
    plain = records.ndim == 2 and records.shape[1] == 4 and records.dtype.kind in "iuf"
    if not plain:
        of_records(records, source)
    if size is None:
        raise InputError(
            f"{path}: an array does not tell the sensor's size; give size=(width, height) or --size"
        )

    order = order_of(np.array(records[:_SAMPLE]), size, source) if plain else ""

    def fields_of(rows: slice) -> dict[str, NDArray]:
        held = np.array(records[rows])
        if plain:
            return {name: held[:, order.index(name)] for name in "txyp"}
        return of_records(held, source)

    ends = [fields_of(part)["t"] for part in (slice(0, _SAMPLE), slice(-1, None))]
    scale = time_scale(np.concatenate(ends), source)

    def decode(state: int | None) -> Iterator[tuple[int, Columns]]:
        for row in range(state or 0, len(records), BLOCK):
            fields = fields_of(slice(row, row + BLOCK))
            t = times(fields["t"], source, "event", scale, row)
            x, y, p = (np.ascontiguousarray(fields[key]) for key in "xyp")
            yield row, (t, x, y, p)

    return Recording(path.stem, *size, decoded(decode, size, source, options))


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
    table = _told(path, table, size)
    if size is None:
        raise InputError(
            f"{path}: the table does not tell the sensor's size; give size=(width, height) or "
            "--size"
        )
    decode = functools.partial(_rows, path, table)
    return Recording(path.stem, *size, decoded(decode, size, source, options))


class _Table:
    def __init__(
        self,
        start: int,
        names: list[str],
        fields: Mapping[str, str],
        separator: str,
        in_seconds: bool,
        size: tuple[int, int] | None,
        scale: float = 1e6,
    ):
        self.start, self.names, self.fields = start, names, fields
        self.separator, self.in_seconds, self.size = separator, in_seconds, size
        self.scale = scale  # us in one unit of times with decimals


def _split(line: str) -> list[str]:
    """The fields of a line, by the separator that it has."""
    line = line.strip()
    separator = next((mark for mark in ",;\t" if mark in line), None)
    return [field.strip().strip('"') for field in line.split(separator)]


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
    mark = next((mark for mark in ",;\t" if mark in line), r"\s+")
    if names is None:
        if len(fields) != 4 or not all(_is_number(field) for field in fields):
            raise InputError(f"{source}: the line {line[:60]!r} comes before any names; {_WANTED}")
        return _Table(start, list("0123"), {}, mark, False, size)
    if len(fields) != len(names) or len(set(names)) != len(names):
        raise InputError(
            f"{source}: the line {line[:60]!r} does not have the columns {', '.join(names)[:80]}; "
            "each line must have one value for each name"
        )
    return _Table(start, names, find(names) or {}, mark, False, size)


def _told(path: Path, table: _Table, size: tuple[int, int] | None) -> _Table:
    """The table with the order of its columns and the unit of its times, from the first events."""
    with reading(str(path)), path.open("rb") as file:
        file.seek(table.start)
        text = file.read(16 * _SAMPLE)
    if len(text) == 16 * _SAMPLE:
        text = text[: text.rfind(b"\n") + 1]
    names, fields = table.names, table.fields
    if not fields:
        bare = _Table(0, names, {name: name for name in names}, table.separator, False, size)
        columns = _numbers(path, bare, text, 0)
        order = order_of(np.stack([np.asarray(c) for c in columns.values()], 1), size, str(path))
        fields = {name: names[order.index(name)] for name in "txyp"}
    named = _Table(table.start, names, fields, table.separator, False, table.size)
    t = _numbers(path, named, text, 0)["t"]
    first = re.split(table.separator, text.strip().partition(b"\n")[0].decode("latin-1").strip())
    stamp = first[names.index(fields["t"])].strip()
    named.in_seconds = not re.fullmatch(r"[+-]?\d+", stamp)
    named.scale = time_scale(t, str(path))
    return named


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
    if table.in_seconds and t.dtype.kind != "f":
        t = t.astype(np.float64)
    elif not table.in_seconds and t.dtype.kind == "f":
        raise InputError(
            f"{path}: the times of the events from number {row} on have decimals, those before "
            "have none; write all as whole microseconds or all as seconds with decimals"
        )
    t = times(t, str(path), "event", table.scale, row)
    return t, columns["x"], columns["y"], columns["p"]


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
