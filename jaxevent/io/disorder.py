"""Event times that go back: what kind of fault it is, and how each kind is mended.

Four faults are distinguished, in times of int64 us:

    jitter    events that come late by at most a bound: they are sorted
    outliers  a few events far before or after their neighbours, to whose times the stream
              returns at once: they are dropped
    wraps     a counter that begins again after 2^k us or ns: it is continued
    resets    a clock that is set back and goes on from there: one of the parts is kept

`find_disorder` finds the faults in one pass over the times. `repair_decoder` mends those that the
user named, while the file is decoded. Both need the memory of a few blocks.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.display import format_count
from jaxevent.errors import InputError, OrderError

DEFAULT_MAX_LATE_US = 10_000  # us that an event may be late where sorting has no bound of its own
_MAX_OUTLIER_RUN = 1000  # events that may be outliers together
_MAX_EDGE_OUTLIERS = 10  # events that are outliers where the stream before or after them is missing
_MIN_COUNTER_BITS = {1.0: 24, 1000.0: 32}  # of counters of us and of ns, by ticks in a us
_WRAP_TOLERANCE_SHARE = 1e-3  # of a wrap's period, in which there was no event
_MAX_FAULT_SHARE = 0.05  # share of events that begin a fault; beyond, times are in no order at all
_MIN_REFUSED_FAULTS = 1000  # that are always examined

REPAIR_KINDS = ("sort", "drop", "unwrap", "part")
_REPAIR_USAGE = (
    "sort (events late by at most 10 ms, or sort:20000 in us, sort:0.02 in s), drop (outliers), "
    "unwrap (a counter) and part (the longest part between resets, or part:2), several joined by "
    "commas"
)

Columns = tuple[NDArray, NDArray, NDArray, NDArray]
Decoder = Callable[[Any], Iterator[tuple[Any, Columns]]]


@dataclasses.dataclass(frozen=True)
class Repair:
    """The repairs that a user named.

    Attributes:
        sort: Whether to sort late events.
        bound: Time in us by which an event may be late.
        drop: Whether to drop outliers.
        unwrap: Whether to continue counters that wrap.
        part: Number of the part to keep, from 1; 0 keeps the longest and None refuses resets.
    """

    sort: bool = False
    bound: int = DEFAULT_MAX_LATE_US
    drop: bool = False
    unwrap: bool = False
    part: int | None = None


def parse_repair(text: str) -> Repair:
    """Turn an option such as "sort", "drop,sort:20000" or "part:2" into a `Repair`.

    Raises:
        InputError: A word is not one of `REPAIR_KINDS`, or its number is not valid.
    """
    chosen: dict[str, Any] = {}
    for word in text.split(","):
        kind, colon, value = word.strip().partition(":")
        chosen |= _parse_repair(text, kind, value if colon else None)
    return Repair(**chosen)


def _parse_repair(text: str, kind: str, value: str | None) -> dict[str, Any]:
    refused = InputError(f"repair = {text!r} is not known; give {_REPAIR_USAGE}")
    if kind not in REPAIR_KINDS or (value is not None and kind in ("drop", "unwrap")):
        raise refused
    if value is None:
        return {kind: 0 if kind == "part" else True}
    try:
        number = int(value) if value.isdigit() or kind == "part" else round(float(value) * 1e6)
    except (ValueError, OverflowError):
        raise refused from None
    if number < 1:
        raise refused
    return {"part": number} if kind == "part" else {"sort": True, "bound": number}


class Reset(NamedTuple):
    """A clock that is set back.

    Attributes:
        row: Row of the first event after it.
        before: Last time before it, us.
        after: First time after it, us.
    """

    row: int
    before: int
    after: int


@dataclasses.dataclass
class Disorder:
    """The faults of a stream of event times.

    Attributes:
        events: Number of events.
        bound: Lateness in us up to which an event counts as late, not as an outlier.
        late: Number of events that are earlier than one before them, by at most `bound`.
        latest: Largest lateness of these in us.
        outliers: Runs of rows [begin, end) that are outliers.
        wraps: Rows at which a counter wraps, with the period in us; negative where it steps back
            over its start.
        resets: Places where the clock is set back.
        first: Row of the first event that is earlier than the one before it, with both times; None
            where times never go back.
    """

    bound: int
    events: int = 0
    late: int = 0
    latest: int = 0
    outliers: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    wraps: list[tuple[int, float]] = dataclasses.field(default_factory=list)
    resets: list[Reset] = dataclasses.field(default_factory=list)
    first: Reset | None = None

    @property
    def dropped(self) -> int:
        """The number of outliers."""
        return sum(end - begin for begin, end in self.outliers)

    @property
    def parts(self) -> list[tuple[int, int]]:
        """Rows [begin, end) of the parts between resets."""
        edges = [0, *(reset.row for reset in self.resets), self.events]
        return list(zip(edges[:-1], edges[1:], strict=True))

    def explain(self, source: str) -> InputError:
        """Describe the faults, and the repairs that mend them, as the error to raise."""
        faults = [text for _, text in self._faults()]
        repairs = ",".join(kind for kind, _ in self._faults())
        where = f"{source}: "
        if self.first is not None:
            where += (
                f"event {self.first.row} is at {self.first.after} us, earlier than the one before "
                f"it at {self.first.before} us: "
            )
        # With so few events, a reset of the clock and outliers at an edge look alike.
        if self.events <= 2 * _MAX_EDGE_OUTLIERS and (self.resets or self.outliers):
            return OrderError(f"{where.rstrip(': ')}; sort the events by time (stable)")
        return OrderError(
            f"{where}{'; '.join(faults)}; mend this with repair={repairs!r} or jaxevent convert "
            f"--repair {repairs}"
        )

    def _faults(self) -> Iterator[tuple[str, str]]:
        """Yield the repair of each kind of fault that there is, and a description of the fault."""
        if self.wraps:
            period = abs(self.wraps[0][1])
            number = sum(1 for _, size in self.wraps if size > 0)
            yield "unwrap", f"a counter of {_period(period)} wraps {_in_words(number)}"
        if self.resets:
            first, sizes = self.resets[0], [end - begin for begin, end in self.parts]
            shown = ", ".join(f"{size:,}" for size in sizes[:8]) + ", ..." * (len(sizes) > 8)
            yield (
                "part",
                f"the clock is set back {_in_words(len(self.resets))}, at event {first.row} from "
                f"{first.before} to {first.after} us, which leaves parts of {shown} events",
            )
        if self.outliers:
            n = self.dropped
            yield "drop", f"{format_count(n, 'event')} far from the times around {_pronoun(n)}"
        if self.late:
            n, bound = self.late, max(self.bound, self.latest)
            sort = "sort" if bound == DEFAULT_MAX_LATE_US else f"sort:{bound}"
            yield (
                sort,
                f"{format_count(n, 'event')} late by at most {self.latest:,} us (jitter)",
            )

    def refuse_rest(self, repair: Repair, source: str) -> None:
        """Raise `InputError` where faults remain that `repair` does not mend."""
        sorts = repair.sort and self.latest <= repair.bound
        mends = (repair.unwrap, repair.part is not None, repair.drop, sorts)
        present = (self.wraps, self.resets, self.outliers, self.late)
        if any(bool(found) and not mended for found, mended in zip(present, mends, strict=True)):
            raise self.explain(source)
        if repair.part is not None and repair.part > len(self.parts):
            raise InputError(
                f"{source}: has no part {repair.part}, as its clock is set back "
                f"{_in_words(len(self.resets))}; give a part from 1 to {len(self.parts)}"
            )

    def kept_rows(self, repair: Repair) -> tuple[int, int]:
        """Return the rows [begin, end) of the part that `repair` keeps."""
        parts = self.parts
        if repair.part is None or len(parts) == 1:
            return 0, self.events
        if repair.part:
            return parts[repair.part - 1]
        return max(parts, key=lambda part: part[1] - part[0])

    def describe_repair(self, repair: Repair) -> str:
        """Describe the repairs that were made, with the number of events of each."""
        made = []
        if repair.unwrap and self.wraps:
            row, period = self.wraps[0]
            touched = self.events - row
            made.append(f"{format_count(touched, 'event')} moved by multiples of {_period(period)}")
        begin, end = self.kept_rows(repair)
        if end - begin < self.events:
            made.append(
                f"{self.events - end + begin:,} events of other parts dropped (events {begin} to "
                f"{end - 1} stay)"
            )
        if repair.drop and self.outliers:
            made.append(f"{format_count(self.dropped, 'outlier')} dropped")
        if repair.sort and self.late:
            made.append(
                f"{format_count(self.late, 'late event')} sorted (by at most {self.latest:,} us)"
            )
        return f"repaired event times: {', '.join(made) or 'none went back'}"


def _in_words(number: int) -> str:
    return "once" if number == 1 else f"{number:,} times"


def _pronoun(number: int) -> str:
    return "it" if number == 1 else "them"


def _period(period: float) -> str:
    """Describe the period of a counter, as in "2^32 us"."""
    for unit, scale in (("us", 1.0), ("ns", 1000.0)):
        bits = np.log2(abs(period) * scale)
        if abs(bits - round(bits)) < 1e-9:
            return f"2^{round(bits)} {unit}"
    return f"{period:g} us"


def find_disorder(
    blocks: Iterable[NDArray[np.int64]], max_late_us: int = DEFAULT_MAX_LATE_US, source: str = ""
) -> Disorder:
    """Find the faults of event times.

    A step back by more than `max_late_us` is the wrap of a counter where it is nearly 2^k us or
    ns. It is an outlier where the times return by a similar step within a few events, before or
    after it. Otherwise it is a reset.

    Args:
        blocks: Event times in us, in the order of the file, (events,) each.
        max_late_us: Lateness in us up to which events are late, not outliers.
        source: Name of the file, for the error.

    Returns:
        The faults.

    Raises:
        InputError: The times are in no order.
    """
    found = Disorder(max_late_us)
    scan = _Scan(found, source)
    held = np.empty(0, np.int64)
    for block in blocks:
        # The rows before a step and those after it decide what it is: they are held back.
        held = np.concatenate([held, scan.continue_wraps(np.asarray(block, np.int64))])
        if len(held) > 4 * _MAX_OUTLIER_RUN:
            scan.classify_steps(held, len(held) - _MAX_OUTLIER_RUN)
            scan.count_late(held, len(held) - 2 * _MAX_OUTLIER_RUN)
            held = held[-3 * _MAX_OUTLIER_RUN :]
    scan.classify_steps(held, len(held))
    scan.count_late(held, len(held))
    scan.turn_edges_into_outliers()
    return found


class _Scan:
    """The state of `find_disorder` between blocks of times."""

    def __init__(self, found: Disorder, source: str):
        self.found, self.source = found, source
        self.shift = 0.0  # us that wraps have added so far
        self.settled = 0  # rows before which steps are decided
        self.counted = 0  # rows before which late events are counted
        self.highest: int | None = None  # time (us) that the current part has reached
        self.before: int | None = None  # last raw time
        self.faults = 0

    def continue_wraps(self, block: NDArray[np.int64]) -> NDArray[np.int64]:
        """Continue the times of a block over wraps; note wraps and the first step back."""
        if not len(block):
            return block
        found, row = self.found, self.found.events
        steps = np.diff(block, prepend=block[0] if self.before is None else self.before)
        if found.first is None and (steps < 0).any():
            at = int(np.argmax(steps < 0))
            before = self.before if at == 0 else int(block[at - 1])
            found.first = Reset(row + at, int(before or 0), int(block[at]))
        found.events += len(block)
        self.before = int(block[-1])
        large = np.flatnonzero(np.abs(steps) > 2 * found.bound)
        shifts = np.zeros(len(block))
        for at in large[_periods(steps[large], found.bound) > 0]:
            period = float(_periods(steps[at : at + 1], found.bound)[0])
            size = period if steps[at] < 0 else -period
            if self.shift + size < 0:  # a pause of this length, not a step over the start
                continue
            self.shift += size
            shifts[at] = size
            found.wraps.append((row + int(at), size))
            self._count_fault()
        return block + np.rint(self.shift - shifts.sum() + np.cumsum(shifts)).astype(np.int64)

    def classify_steps(self, t: NDArray[np.int64], stop: int) -> None:
        """Classify the falls of times before a place as resets or as outliers.

        Args:
            t: Times of the latest events, us; the last one is the last one read.
            stop: Place in `t` before which falls are classified.
        """
        found = self.found
        origin = found.events - len(t)  # row of t[0]
        last_run = found.outliers[-1][1] if found.outliers else 0
        for at in np.flatnonzero(t[1:stop] < t[: stop - 1] - found.bound) + 1:
            row = origin + int(at)
            if row < max(self.settled, last_run):
                continue
            run = _run_of_outliers(t, int(at), found.bound, begins=origin == 0)
            if run is None:
                found.resets.append(Reset(row, int(t[at - 1]), int(t[at])))
            else:
                found.outliers.append((max(origin + run[0], last_run), origin + run[1]))
                last_run = origin + run[1]
            self._count_fault()
        self.settled = origin + stop

    def count_late(self, t: NDArray[np.int64], end: int) -> None:
        """Count the late events before a place; outliers are not late.

        Args:
            t: Times of the latest events, us; the last one is the last one read.
            end: Place in `t` before which events are counted.
        """
        found = self.found
        origin = found.events - len(t)
        begin, self.counted = self.counted - origin, origin + end
        good = np.ones(len(t), bool)
        for first, last in found.outliers[::-1]:
            if last <= origin:
                break
            good[max(first - origin, 0) : max(last - origin, 0)] = False
        edges = [reset.row - origin for reset in found.resets if begin <= reset.row - origin < end]
        for k, (low, high) in enumerate(zip([begin, *edges], [*edges, end], strict=True)):
            part = t[low:high][good[low:high]]
            if k:
                self.highest = None
            if not len(part):
                continue
            lead = part[0] if self.highest is None else max(self.highest, int(part[0]))
            reached = np.maximum.accumulate(np.concatenate([[lead], part]))[1:]
            late = reached - part
            found.late += int(np.count_nonzero(late))
            found.latest = max(found.latest, int(late.max()))
            self.highest = int(reached[-1])

    def turn_edges_into_outliers(self) -> None:
        """Turn parts of a few events at either end into outliers."""
        found = self.found
        while (
            found.resets
            and found.resets[0].row <= _MAX_EDGE_OUTLIERS < found.events - _MAX_EDGE_OUTLIERS
        ):
            found.outliers.insert(0, (0, found.resets.pop(0).row))
        while (
            found.resets
            and found.events - found.resets[-1].row
            <= _MAX_EDGE_OUTLIERS
            < found.events - _MAX_EDGE_OUTLIERS
        ):
            found.outliers.append((found.resets.pop().row, found.events))

    def _count_fault(self) -> None:
        self.faults += 1
        if self.faults > _MIN_REFUSED_FAULTS and self.faults > _MAX_FAULT_SHARE * self.found.events:
            raise OrderError(
                f"{self.source}: the event times go back at one in "
                f"{self.found.events // self.faults} events by more than {self.found.bound:,} us, "
                "so they are in no order; sort the events by time (stable)"
            )


def _periods(steps: NDArray[np.int64], bound: int) -> NDArray[np.float64]:
    """Return the periods of counters whose wraps explain steps of the time.

    Between the last event before a wrap and the first one after it, a little time passes: the step
    is a little less than the period. Jitter can make it a little more.

    Args:
        steps: (n,) steps, us.
        bound: Largest jitter, us.

    Returns:
        (n,) periods, us; 0 where no counter wraps so.
    """
    sizes = np.abs(steps).astype(np.float64)
    periods = np.zeros(len(steps))
    for scale, fewest in list(_MIN_COUNTER_BITS.items())[::-1]:  # microseconds win
        bits = np.ceil(np.log2(np.maximum((sizes - bound) * scale, 1)))
        period = 2.0**bits / scale
        missing = period - sizes
        near = (missing >= -bound) & (missing <= np.maximum(bound, _WRAP_TOLERANCE_SHARE * period))
        fits = near & (bits >= fewest) & (period > 8 * bound)
        periods = np.where(fits, period, periods)
    return periods


def _run_of_outliers(
    t: NDArray[np.int64], at: int, bound: int, begins: bool
) -> tuple[int, int] | None:
    """Find the outliers that make times fall at a place.

    Times that return to their former course, before or after the fall, do so by a step of at least
    half its size: a clock that was set back climbs there slowly.

    Args:
        t: (n,) times, us.
        at: Place of the event that is earlier than the one before it.
        bound: Largest jitter, us.
        begins: Whether `t` begins with the recording.

    Returns:
        Their places [begin, end); None if the fall is none of outliers.
    """
    depth = t[at - 1] - t[at]
    ahead = t[at : at + _MAX_OUTLIER_RUN]
    back = np.flatnonzero(ahead >= t[at - 1] - bound)
    late = None
    if len(back) and ahead[back[0]] - ahead[back[0] - 1] >= depth // 2:
        late = (at, at + int(back[0]))
    behind = t[max(at - _MAX_OUTLIER_RUN, 0) : at][::-1]
    low = np.flatnonzero(behind <= t[at] + bound)
    early = None
    if len(low) and behind[low[0] - 1] - behind[low[0]] >= depth // 2:
        early = (at - int(low[0]), at)
    elif not len(low) and begins and at <= _MAX_EDGE_OUTLIERS < len(t) - at:
        early = (0, at)
    runs = [run for run in (late, early) if run is not None]
    return min(runs, key=lambda run: run[1] - run[0], default=None)


def repair_decoder(decode: Decoder, found: Disorder, repair: Repair) -> Decoder:
    """Make a decoder that mends the faults of another one.

    Args:
        decode: The decoder of a file, see `jaxevent.io.decoded`.
        found: The faults of its times.
        repair: The repairs to make.

    Returns:
        The decoder. Its states hold the events that wait to be sorted.
    """
    begin, end = found.kept_rows(repair)
    rows = np.array([row for row, _ in found.wraps], np.int64)
    shifts = np.concatenate([[0.0], np.cumsum([size for _, size in found.wraps])])
    starts = np.array([first for first, _ in found.outliers], np.int64)
    stops = np.array([last for _, last in found.outliers], np.int64)

    def mended(columns: Columns, row: int) -> Columns:
        t = columns[0]
        number = np.arange(row, row + len(t))
        keep = (number >= begin) & (number < end)
        if repair.drop:
            keep &= np.searchsorted(starts, number, "right") == np.searchsorted(
                stops, number, "right"
            )
        if repair.unwrap:
            moved = shifts[np.searchsorted(rows, number, "right")]
            t = t + np.rint(moved).astype(np.int64)
        return _select_rows((t, *columns[1:]), keep)

    def decode_repaired(state: Any) -> Iterator[tuple[Any, Columns]]:
        inner, row, waiting, is_end = state or (None, 0, None, False)
        for place, columns in () if is_end else decode(inner):
            here = (place, row, waiting, False)
            out = mended(columns, row)
            row += len(columns[0])
            if repair.sort:
                out, waiting = _sort_events(out, waiting, repair.bound)
            yield here, out
        if waiting is not None:
            yield (None, row, waiting, True), waiting

    return decode_repaired


def _select_rows(columns: Columns, rows: Any) -> Columns:
    t, x, y, p = (np.asarray(column)[rows] for column in columns)
    return t, x, y, p


def _sort_events(columns: Columns, waiting: Columns | None, bound: int) -> tuple[Columns, Columns]:
    """Sort events by time; those after which earlier ones may still come wait.

    Args:
        columns: Columns of further events.
        waiting: Columns of the events that wait; None: none.
        bound: Largest time by which an event is late, us.

    Returns:
        Columns of the sorted events that are ready, and of those that wait.
    """
    if waiting is not None:
        pairs = zip(waiting, columns, strict=True)
        t, x, y, p = (np.concatenate(pair) for pair in pairs)
        columns = t, x, y, p
    order = np.argsort(columns[0], kind="stable")
    columns = _select_rows(columns, order)
    t = columns[0]
    ready = int(np.searchsorted(t, t[-1] - bound)) if len(t) else 0
    return _select_rows(columns, slice(0, ready)), _select_rows(columns, slice(ready, None))
