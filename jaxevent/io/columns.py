"""The names under which files hold the fields of events, and events of named columns.

    t   t, ts, time, times, timestamp, timestamps, time_stamp; with a unit: timestamp_us, t [ns]
    x   x, xs                                    column from 0
    y   y, ys                                    row from 0, downwards
    p   p, ps, pol, pols, polarity, polarities, on   bool, 0/1 or -1/1

These are the names of tonic (x y t p), expelliarmus and OpenEB (t x y p), dv-processing (timestamp
x y polarity), faery and aedat (t x y on) and event_utils (ts xs ys ps). The order of the columns
does not count, as it differs from one program to the next.

Four columns without names are distinguished by their values (`order_of`): t x y p, x y p t, x y t p
or p t x y. A table that fits more than one of these orders is refused.

The unit of the times is that of the name, or inferred (`time_units`): usually us where all are
whole numbers, also as floats and in text, otherwise seconds. A polarity of -1 that was stored
without a sign, as v2e stores it, is the largest number of its type.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent import arrays
from jaxevent.arrays import FIELD_ALIASES, to_microseconds
from jaxevent.deprecated import renamed_names
from jaxevent.errors import InputError
from jaxevent.io import decoded
from jaxevent.io.checks import ReadOptions
from jaxevent.io.decoded import Columns, read_events
from jaxevent.recording import EventSource
from jaxevent.time_units import (
    SAMPLE_EVENTS,
    Clock,
    InferredUnit,
    infer_unit,
    numbers_of_dates,
    unit_of_name,
)

_MAX_FALLING_SHARE = 0.1  # share of events before which times may fall, in an order of columns
_COLUMN_ORDERS = ("txyp", "xypt", "xytp", "ptxy")
_UNIT_SUFFIX = re.compile(r"\s*[\[(][^\])]*[\])]$|_px$")
_UNSIGNED_MINUS_ONES = tuple((1 << bits) - 1 for bits in (8, 16, 32, 64))  # -1 without its sign

Fields = Callable[[slice], Mapping[str, NDArray]]  # columns t, x, y and p of a range of rows


def find_fields(names: Sequence[str]) -> dict[str, str] | None:
    """Find the names of t, x, y and p among some; None unless each is there, once.

    A name with a unit, as in "t_ns" or "x [px]", counts where there is none without.
    """
    if (found := arrays.find_fields(names)) is not None:
        return found
    has_t = any(name.strip().lower() in FIELD_ALIASES["t"] for name in names)
    timed = [] if has_t else [name for name in names if unit_of_name(name)][:1]
    plain = {
        "t" if name in timed else _UNIT_SUFFIX.sub("", name.strip().lower()): name for name in names
    }
    found = arrays.find_fields(list(plain)) if len(plain) == len(names) else None
    return None if found is None else {field: plain[name] for field, name in found.items()}


def is_time(name: str) -> bool:
    """Return whether the name of a column is one of times, with a unit or without."""
    return name.strip().lower() in FIELD_ALIASES["t"] or unit_of_name(name) is not None


def as_rows(array: Any) -> Any:
    """Return an array of shape (events, 4) or (4, events) as (events, 4); None of another shape."""
    if array.ndim != 2 or array.dtype.kind not in "iuf" or 4 not in array.shape:
        return None
    return array if array.shape[1] == 4 else array.T


def split_rows(rows: NDArray, order: str) -> dict[str, NDArray]:
    """Return the columns t, x, y and p of rows of numbers.

    Args:
        rows: (n, 4) rows.
        order: Order of the columns, as "txyp".

    Returns:
        Columns (n,) by name.
    """
    return {name: rows[:, order.index(name)] for name in "txyp"}


def order_of(rows: NDArray, size: tuple[int, int] | None, source: str) -> str:
    """Find the order of four columns without names.

    Times never fall, coordinates are whole numbers on the sensor, and polarities are 0 and 1 or
    -1 and 1.

    Args:
        rows: (n, 4) first rows.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.

    Returns:
        The order, as "txyp".

    Raises:
        InputError: No order fits, or several do.
    """

    def is_p(values: NDArray) -> bool:
        if _unsigned_off(values) is not None:
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
    for falls in (0.0, _MAX_FALLING_SHARE):
        for sides in (size or largest, largest):
            fitting = fitting or [order for order in _COLUMN_ORDERS if fits(order, *sides, falls)]
    if len(fitting) != 1:
        named = " or ".join(" ".join(order) for order in (fitting or _COLUMN_ORDERS))
        raise InputError(
            f"{source}: its four columns without names {'could' if fitting else 'cannot'} be "
            f"{named}; sort by time, or name the columns: a line 't x y p' before the events, or "
            "an array with these fields"
        )
    return fitting[0]


def record_fields(records: NDArray, source: str) -> dict[str, str]:
    """Find the names of t, x, y and p in a structured array of events.

    Args:
        records: (n,) structured array.
        source: Name of the file for messages.

    Returns:
        Names of the array's fields by "t", "x", "y" and "p".

    Raises:
        InputError: The array has other fields, or another shape.
    """
    fields = find_fields(records.dtype.names or ())
    if records.ndim != 1 or fields is None:
        held = ", ".join(records.dtype.names or ()) or str(records.dtype)
        raise InputError(
            f"{source}: holds an array of {held[:80]} of shape {records.shape}; store a list of "
            "records with the fields t, x, y and p"
        )
    return fields


def _unsigned_off(p: NDArray) -> float | None:
    """Find the number that stands for -1 in polarities (n,) stored unsigned: 255, 65535, ...

    Returns None unless the number occurs and 0 does not.
    """
    if p.dtype.kind not in "iuf" or not p.size:
        return None
    most = p.max()
    kind = p.dtype.type if p.dtype.kind == "f" else np.float64
    is_off = any(kind(number) == kind(most) for number in _UNSIGNED_MINUS_ONES)
    return float(most) if is_off and ((p == most) | (p == 1)).all() else None


class ColumnFormat(NamedTuple):
    """The numbers in columns of events.

    Attributes:
        unit: Unit of the times.
        off: Number that stands for the polarity -1; None where it is stored with its sign.
        is_float: Whether times are stored as floats.
    """

    unit: InferredUnit = InferredUnit("us")
    off: float | None = None
    is_float: bool = False

    def convert(self, fields: Mapping[str, NDArray], source: str, first_row: int) -> Columns:
        """Convert columns of a file for `check_events`.

        Args:
            fields: t, x, y and p as stored, (n,) each.
            source: Name of the file for messages.
            first_row: Row of the first event in the file.

        Returns:
            t in us, x, y, and p with its signs.

        Raises:
            InputError: A time is not finite or too large.
        """
        t = numbers_of_dates(fields["t"])[0]
        t = to_microseconds(t, self.unit.name, source, "event", first_row)
        return t, fields["x"], fields["y"], self.signed(fields["p"])

    def signed(self, p: NDArray) -> NDArray:
        """Return polarities with -1 in place of the number that stands for it."""
        if self.off is None:
            return p
        values = p.astype(np.float64)  # exact for the numbers in question and for small ones
        return np.where(values == self.off, -1.0, values)

    def clock(self, first: int, last: int) -> Clock:
        """Return the clock of events, for the times of images, poses and samples beside them.

        Args:
            first: Time of the first event in us.
            last: Time of the last event in us.

        Returns:
            The clock.
        """
        return Clock(self.unit.name, first, last, self.is_float)


MICROSECOND_FORMAT = ColumnFormat()


def sample_ends(fields: Fields, n_events: int) -> dict[str, NDArray]:
    """Read the first `SAMPLE_EVENTS` events, and the last one if there are more.

    Args:
        fields: Columns of a range of rows.
        n_events: Number of events.

    Returns:
        The columns by name, (n,) each.
    """
    first = dict(fields(slice(0, SAMPLE_EVENTS)))
    if n_events <= SAMPLE_EVENTS:
        return first
    last = fields(slice(n_events - 1, n_events))
    return {name: np.concatenate([first[name], last[name]]) for name in first}


def infer_format(
    sample: Mapping[str, NDArray],
    n_events: int,
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    *,
    name: str = "",
    stated: tuple[str, str] | None = None,
    usual: str | None = None,
) -> ColumnFormat:
    """Infer the unit of times and the signs of polarities.

    Args:
        sample: Columns t, x, y and p of the first events and the last one, (n,) each.
        n_events: Number of events in all.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        options: Options of `jaxevent.io.load`.
        name: Name of the column of times, which may state a unit.
        stated: Unit that the file states otherwise, and the words for how.
        usual: Usual unit of the layout, see `infer_unit`.

    Returns:
        The format of the columns.

    Raises:
        InputError: The type of the times cannot resolve them.
    """
    t, unit_of_type = numbers_of_dates(sample["t"])
    if stated is None and unit_of_type is not None:
        stated = unit_of_type, f"the type {sample['t'].dtype}"
    if stated is None and (unit := unit_of_name(name)) is not None:
        stated = unit, f"the name {name.strip()!r}"
    sample = {**sample, "t": t}
    found = infer_unit(
        sample, n_events, size, source, options.time_unit, stated=stated, usual=usual
    )
    return ColumnFormat(found, _unsigned_off(sample["p"]), t.dtype.kind == "f")


class ColumnReadResult(NamedTuple):
    """Events of named columns, with their clock and notes on how the unit of time was found.

    Attributes:
        events: The events.
        clock: Clock of images, poses and samples beside them.
        notes: Remarks on the unit of time.
    """

    events: EventSource
    clock: Clock
    notes: list[str]


def read_columns(
    fields: Fields,
    count: int,
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    *,
    name: str = "",
    usual: str | None = None,
    unit: str | None = None,
    origin: int = 0,
    block: int | None = None,
) -> ColumnReadResult:
    """Make events of named columns, of which any range of rows is read when needed.

    Args:
        fields: Columns t, x, y and p of a range of rows.
        count: Number of events.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        options: Options of `jaxevent.io.load`.
        name: Name of the column of times, which may state a unit.
        usual: Usual unit of the layout, see `infer_unit`.
        unit: Unit of the times where the layout fixes it.
        origin: Number of the first column and row of the sensor, 0 or 1.
        block: Number of events that are read together; None takes `decoded.BLOCK_EVENTS`.

    Returns:
        The events, in memory or left in the file, their clock and notes.

    Raises:
        InputError: The events are not valid.
    """
    if unit is None:
        sample = sample_ends(fields, count)
        if block is not None:  # all are in memory
            sample["p"] = fields(slice(0, count))["p"]
        found = infer_format(sample, count, size, source, options, name=name, usual=usual)
    else:
        found = ColumnFormat(InferredUnit(unit))

    def decode(state: int | None) -> Iterator[tuple[int, Columns]]:
        size_of_block = block or decoded.BLOCK_EVENTS
        for row in range(state or 0, count, size_of_block):
            held = fields(slice(row, row + size_of_block))
            yield row, found.convert(held, source, row)

    events = read_events(decode, size, source, options, origin)
    last = max(len(events) - 1, 0)
    ends = [int(t) for t in (*events[:1].t, *events[last:].t)] or [0, 0]
    return ColumnReadResult(events, found.clock(ends[0], ends[-1]), list(found.unit.notes))


def read_whole_columns(
    columns: Mapping[str, NDArray],
    size: tuple[int, int],
    source: str,
    options: ReadOptions,
    *,
    name: str = "",
    usual: str | None = None,
    origin: int = 0,
) -> ColumnReadResult:
    """Read events of columns in memory, as `read_columns` does.

    Args:
        columns: t, x, y and p, (events,) each.
        size: (width, height) of the sensor in px.
        source: Name of the file for messages.
        options: Choices of the caller; events stay in memory in any case.
        name: Name of the column of times, which may state a unit.
        usual: Usual unit of the layout, see `infer_unit`.
        origin: Number of the first column and row of the sensor, 0 or 1.

    Returns:
        The events, their clock and notes.

    Raises:
        InputError: The events are not valid.
    """
    for key, values in columns.items():
        if values.ndim != 1:
            raise InputError(f"{source}: {key} has shape {values.shape}; store a list of numbers")
    t, x, y, p = (columns[key] for key in "txyp")
    arrays.check_lengths(t, x, y, p, source)
    whole = dataclasses.replace(options, in_memory=True, progress=False, notes=options.notes)
    return read_columns(
        lambda rows: {key: columns[key][rows] for key in "txyp"},
        len(t), size, source, whole, name=name, usual=usual, origin=origin, block=len(t),
    )  # fmt: skip


__getattr__ = renamed_names(__name__)
