"""The unit of the times in a file of columns: seconds, milliseconds, microseconds or nanoseconds.

A unit is taken, in this order, from the caller (`time_unit=`, `--time-unit`), from what the file
states (the name of the column, as in `timestamp_us` or `t [ns]`, a type with a unit, an attribute),
and from the numbers. Whole numbers are usually microseconds, numbers with decimals seconds; a
layout may have a usual unit of its own. The numbers are compared with what recordings are like
under each unit, as a sum of log-likelihoods:

    span         log10 of seconds: mean 0.7, standard deviation 1.3 above and 1.8 below
    rate         log10 of events per pixel and second: mean 0, deviation 1.2 above and 1.5 below
    bursts       log10 of seconds between events of a pixel, 5 % quantile: mean -3, deviation 0.9,
                 where it is far below that of independent events
    magnitude    up to 12 days after zero, or a date between 2000 and 2050
    resolution   the largest power of ten of which all times are multiples

The numbers decide only where there are at least `MIN_EVENTS`. A unit other than the usual one,
or one that is hardly better than the next, is reported as an `InputWarning`; any unit that the
layout does not state is a note of the recording. The constants were chosen on simulated recordings
(`experiments/studies/time_units.md`).

Times of images, poses and IMU samples of the same file are on the clock of the events: they keep
their usual unit unless, in it, they miss the events or their intervals cannot be, and another unit
mends both. Of numbers of the same kind as the event times, the unit of these comes first.
"""

import re
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.arrays import UNIT_NAMES, US_PER_UNIT, check_resolution, time_step, to_microseconds
from jaxevent.errors import InputError, InputWarning

if TYPE_CHECKING:
    from jaxevent.recording import EventSource

MIN_EVENTS = 300
SAMPLE_EVENTS = 1 << 16  # events from which order, unit and signs are inferred
JUDGED_EVENTS = 1 << 12  # of arrays and recordings whose unit is doubted
_MIN_REPETITIONS = 100  # intervals between events of one pixel
_BURST_FRACTION = (
    0.01  # of the mean interval, or of the sample; of independent events it is 0.025 or more
)
_CERTAIN_NATS = 2.7  # nats by which an undoubted unit exceeds the next
WINNING_NATS = 1.0  # nats by which a unit must exceed the usual one
_CONTRADICTION_NATS = 8.0  # nats by which another unit must exceed a stated one for a warning
_MAX_DECIMAL_SPAN_US = 1e12  # of a recording with times that have decimals: 11.6 days
_GAP_RATIO = 1000.0  # times the sum of all other steps that a gap lasts
_PLAUSIBLE_INTERVALS_US = (150.0, 5e6)  # between images, poses and samples
_MIN_OVERLAP, _CLEAR_OVERLAP = 0.02, 0.5  # intersection over union of the spans of two clocks

_UNIT_SPELLINGS = {
    "s": r"s|secs?|seconds?",
    "ms": r"ms|msecs?|millis|milliseconds?",
    "us": r"us|[µμ]s|usecs?|micros|microseconds?",
    "ns": r"ns|nsecs?|nanos|nanoseconds?",
}
_TIME_PATTERN = r"(t|ts|time|times|timestamp|timestamps|time_stamp)"
_UNIT_PATTERNS = {
    unit: re.compile(
        # A lone "s" without a separator is a plural.
        rf"{_TIME_PATTERN}(?:\s*[\[(]\s*(?:in )?(?:{words})\s*[\])]"
        rf"|[\s_./:-]+(?:in[\s_])?(?:{words})" + (r")" if unit == "s" else rf"|(?:{words}))"),
        re.IGNORECASE,
    )
    for unit, words in _UNIT_SPELLINGS.items()
}
# Log-probabilities of a unit before any number but the kind is known.
_WHOLE_NUMBER_NATS = {"us": 0.0, "ns": -3.0, "ms": -3.5, "s": -10.0}
_DECIMAL_NUMBER_NATS = {"s": 0.0, "ms": -3.5, "us": -4.0, "ns": -8.0}
# Numbers that are whole since their type is coarse, as float32 is.
_ROUNDED_NUMBER_NATS = {"s": 0.0, "us": -0.5, "ms": -3.0, "ns": -3.0}
_UNUSUAL_UNIT_NATS = -4.0  # of units other than the usual one of a layout


class InferredUnit(NamedTuple):
    """The unit of a column of event times.

    Attributes:
        name: "s", "ms", "us" or "ns".
        notes: Sentences for `Recording.notes` on how it was found.
    """

    name: str
    notes: tuple[str, ...] = ()


def unit_of_name(name: str) -> str | None:
    """Return the unit that the name of a column of times states, as in "t_ns"; else None."""
    for unit, pattern in _UNIT_PATTERNS.items():
        if pattern.fullmatch(name.strip()):
            return unit
    return None


def split_unit(name: str) -> tuple[str, str | None]:
    """Return a name without the unit at its end, and the unit, as of "frame_t_ns"."""
    for unit, words in _UNIT_SPELLINGS.items():
        end = rf"\s*[\[(]\s*(?:{words})\s*[\])]|[\s_./:-]+(?:{words})"
        if found := re.fullmatch(rf"(.+?)(?:{end})", name.strip(), re.IGNORECASE):
            return found.group(1), unit
    return name, None


def unit_of_words(words: Any) -> str | None:
    """Return the unit that an attribute such as "us" or "[microseconds]" states; else None."""
    if not isinstance(words, str):
        return None
    bare = words.strip().strip("[]()").lower()
    return next((u for u, known in _UNIT_SPELLINGS.items() if re.fullmatch(known, bare)), None)


def numbers_of_dates(values: NDArray) -> tuple[NDArray, str | None]:
    """Return NumPy's dates and durations as whole numbers, and their unit; other values as given.

    Args:
        values: (n,) times of any type.

    Returns:
        (n,) int64 and "s", "ms", "us" or "ns" for datetime64 and timedelta64, else `values`, None.
    """
    if values.dtype.kind not in "mM":
        return values, None
    unit = np.datetime_data(values.dtype)
    if unit[0] not in US_PER_UNIT or unit[1] != 1:
        values, unit = values.astype(f"{values.dtype.kind}8[us]"), ("us", 1)
    return values.view(np.int64), unit[0]


def infer_unit(
    sample: Mapping[str, NDArray],
    n_events: int,
    size: tuple[int, int],
    source: str,
    time_unit: str | None = None,
    *,
    stated: tuple[str, str] | None = None,
    usual: str | None = None,
) -> InferredUnit:
    """Infer the unit of event times, warn where it is doubtful, and check their resolution.

    Args:
        sample: Columns t, x and y, (n,) each: the first events, and then the last one.
        n_events: Number of events in all.
        size: (width, height) of the sensor in pixels.
        source: Name of the file for messages.
        time_unit: Unit that the caller gives; None infers it.
        stated: Unit that the file states, and the words for how it does ("the name 't_ns'").
        usual: Unit of the layout; None has microseconds for whole numbers, seconds for others.

    Returns:
        The unit, with notes on how it was found and on a coarse resolution.

    Raises:
        InputError: The type of the times cannot resolve neighbouring ones, or the times span more
            than 11.6 days.
    """
    t = sample["t"]
    if t.dtype.kind not in "iuf" or not len(t):
        return InferredUnit(time_unit or (stated[0] if stated else usual or "us"))
    numbers = _Numbers.from_sample(sample, n_events, size)
    expected = usual or _convention(numbers)
    scores = {unit: numbers.score(unit, usual) for unit in US_PER_UNIT}
    best = max(scores, key=lambda unit: scores[unit])
    known = n_events >= MIN_EVENTS and numbers.span > 0
    notes: list[str] = []
    doubt = ""
    if time_unit is not None:
        unit = time_unit
        if contradiction := _contradiction(numbers, unit, _CONTRADICTION_NATS, usual):
            doubt = (
                f"{source}: as {UNIT_NAMES[unit]} events are unusual: {contradiction.text}; if "
                f"this is right, give time_unit={contradiction.unit!r} or --time-unit "
                f"{contradiction.unit}"
            )
    elif stated is not None:
        unit = stated[0]
        notes.append(f"event times are {UNIT_NAMES[unit]}, by {stated[1]}")
        if contradiction := _contradiction(numbers, unit, _CONTRADICTION_NATS, usual):
            doubt = (
                f"{source}: event times are {UNIT_NAMES[unit]} by {stated[1]}, but "
                f"{contradiction.text}: if the name is wrong, give "
                f"time_unit={contradiction.unit!r} or --time-unit {contradiction.unit}"
            )
    elif not known:
        unit = expected
        if (
            numbers.span
            and _is_impossible(numbers.median, unit)
            and not _is_impossible(numbers.median, best)
        ):
            unit = best
            notes.append(f"event times are taken as {UNIT_NAMES[unit]}, by their magnitude")
            doubt = _doubt(source, numbers, unit, expected)
    else:
        unit = best if scores[best] > scores[expected] + WINNING_NATS else expected
        after = max((u for u in scores if u != unit), key=lambda u: scores[u])
        is_doubtful = scores[unit] < scores[after] + _CERTAIN_NATS
        if unit != expected or is_doubtful:
            notes.append(
                f"event times are taken as {UNIT_NAMES[unit]}, since {numbers.describe(unit)}"
            )
            doubt = _doubt(source, numbers, unit, expected if unit != expected else after)
    scale = US_PER_UNIT[unit]
    if time_unit is None and numbers.has_decimals and numbers.span * scale > _MAX_DECIMAL_SPAN_US:
        raise InputError(
            f"{source}: the times are numbers with decimals, so {UNIT_NAMES[unit]}, but span "
            f"{numbers.span * scale / 86400e6:.0f} days; store them as integer microseconds, or "
            "give their unit, time_unit= or --time-unit"
        )
    spread = (numbers.rounding, numbers.span, numbers.largest)
    note = check_resolution(spread, numbers.count, unit, source)
    notes += [] if note is None else [f"event {note}"]
    if doubt:
        _warn(doubt)
    return InferredUnit(unit, tuple(notes))


def doubt_given_unit(
    t: NDArray, x: NDArray, y: NDArray, size: tuple[int, int], unit: str | None
) -> str | None:
    """Compare events, in a unit that a caller gives, with typical recordings.

    Args:
        t: (n,) times as given.
        x: (n,) columns, px.
        y: (n,) rows, px.
        size: (width, height) of the sensor in pixels.
        unit: The unit, "s", "ms", "us" or "ns"; None: microseconds, which are not stated.

    Returns:
        What speaks for another unit and the remedy, for a message; None where nothing does.
    """
    if len(t) < MIN_EVENTS:
        return None
    least = WINNING_NATS if unit is None else _CONTRADICTION_NATS
    numbers = _numbers_of_ends(lambda rows: (t[rows], x[rows], y[rows]), len(t), size)
    unit = unit or "us"
    found = _contradiction(numbers, unit, least)
    if found is None:
        return None
    return (
        f"as {UNIT_NAMES[unit]} events are unusual: {found.text}; if this is right, give "
        f"time_unit={found.unit!r}"
    )


class ClockDoubt(NamedTuple):
    """A unit that fits the times of a recording better than microseconds.

    Attributes:
        nats: Log likelihood ratio of that unit over microseconds.
        text: The unit, and the recording as it would be under both.
        remedy: Words that begin with a verb.
    """

    nats: float
    text: str
    remedy: str


def doubt_microseconds(events: "EventSource", size: tuple[int, int]) -> ClockDoubt | None:
    """Compare a recording with what recordings are like under other units.

    Args:
        events: Its events, of which the first ones and the last one are read.
        size: (width, height) of the sensor in pixels.

    Returns:
        The unit that the times seem to have; None where microseconds are as usual.
    """
    count = len(events)
    if count < MIN_EVENTS:
        return None

    def read(rows: slice) -> tuple[NDArray, NDArray, NDArray]:
        part = events[rows]
        return part.t, part.x, part.y

    found = _contradiction(_numbers_of_ends(read, count, size), "us", WINNING_NATS)
    if found is None:
        return None
    scale = US_PER_UNIT[found.unit]
    remedy = f"multiply the times by {scale:,.0f}"
    if scale < 1:
        remedy = f"divide the times by {1 / scale:,.0f}"
    text = f"the times look like {UNIT_NAMES[found.unit]}, not microseconds: {found.text}"
    return ClockDoubt(found.nats, text, remedy)


def _numbers_of_ends(
    read: Callable[[slice], tuple[NDArray, NDArray, NDArray]], count: int, size: tuple[int, int]
) -> "_Numbers":
    """Compute the statistics by which the unit of a recording is doubted.

    Args:
        read: Function that returns times, columns and rows of some events.
        count: Number of events, of which the first `JUDGED_EVENTS` and the last one are read.
        size: (width, height) of the sensor in pixels.

    Returns:
        The statistics.
    """
    ends = read(slice(min(count - 1, JUDGED_EVENTS))), read(slice(count - 1, count))
    columns = [np.concatenate(parts) for parts in zip(*ends, strict=True)]
    return _Numbers.from_sample(dict(zip("txy", columns, strict=True)), count, size)


class _Contradiction(NamedTuple):
    """A unit that fits far better than the one stated, and the comparison in words."""

    unit: str
    text: str
    nats: float  # log-likelihood ratio of the units


def _contradiction(
    numbers: "_Numbers", unit: str, least: float, usual: str | None = None
) -> _Contradiction | None:
    """Find a unit that fits far better than the one stated.

    Args:
        numbers: Statistics of the times.
        unit: The stated unit.
        least: Log likelihood ratio from which another unit counts, nats.
        usual: Usual unit of the layout.

    Returns:
        The unit and the comparison in words; None if no other unit fits so well.
    """
    scores = {other: numbers.score(other, usual) for other in US_PER_UNIT}
    best = max(scores, key=lambda other: scores[other])
    known = numbers.count >= MIN_EVENTS and numbers.span > 0
    if not known or scores[best] <= scores[unit] + least:
        return None
    text = f"{numbers.describe(unit)}; as {UNIT_NAMES[best]} {numbers.describe(best)}"
    return _Contradiction(best, text, scores[best] - scores[unit])


def _warn(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=4)


def _doubt(source: str, numbers: "_Numbers", unit: str, other: str) -> str:
    return (
        f"{source}: no unit of the event times is stated; {UNIT_NAMES[unit]} are taken, since "
        f"{numbers.describe(unit)}, while as {UNIT_NAMES[other]} {numbers.describe(other)}; give "
        f"time_unit={unit!r} or --time-unit {unit} to confirm, or the right unit"
    )


class _Numbers(NamedTuple):
    """Properties of a column of event times, in its own unit."""

    count: int  # of events
    pixels: int  # of the sensor
    span: float  # sum of steps forwards, without one gap that exceeds all others by far
    largest: float  # largest magnitude
    median: float  # median magnitude
    repetition: float | None  # 5 % quantile of times between a pixel's events; None: unknown
    digits: int | None  # decimal places, negative for multiples of ten; None for any number
    is_float: bool
    rounding: float  # distance between neighbouring numbers, as of `time_step`

    @classmethod
    def from_sample(
        cls, sample: Mapping[str, NDArray], count: int, size: tuple[int, int]
    ) -> "_Numbers":
        pixels = max(size[0] * size[1], 1)
        kept = np.isfinite(sample["t"])
        stored = sample["t"][kept]
        t = stored.astype(np.float64)
        if not len(t):
            return cls(count, pixels, 0.0, 0.0, 0.0, None, None, True, 0.0)
        # Differences of integers are exact, those of large ones as floats are not.
        whole = stored.dtype.kind != "f"
        steps = np.diff(stored.astype(np.int64) if whole else t).astype(np.float64)
        # The sum of steps forwards is the span also where a counter wraps or one time goes back. A
        # step that exceeds all others by far is a gap or a damaged time.
        span = float(steps[steps > 0].sum())
        longest = float(steps[: count - 1 if count <= len(t) else -1].max(initial=0.0))
        span -= longest if longest > _GAP_RATIO * (span - longest) else 0.0
        if len(steps) and steps[-1] < 0 and count > len(t):
            span *= count / len(t)
        largest = float(np.abs(t).max())
        repetition = _repetition(stored, sample["x"][kept], sample["y"][kept])
        if repetition is not None:
            held = float(steps[: SAMPLE_EVENTS - 1][steps[: SAMPLE_EVENTS - 1] > 0].sum())
            if repetition > _BURST_FRACTION * min(span * pixels / count, held):
                repetition = None
        return cls(
            count,
            pixels,
            span,
            largest,
            float(np.median(np.abs(t))),
            repetition,
            _digits(stored),
            not whole,
            time_step(stored),
        )

    @property
    def has_decimals(self) -> bool:
        """True if some time is not a whole number."""
        return self.is_float and (self.digits is None or self.digits > 0)

    def rate(self, unit: str) -> float:
        """Return the number of events per pixel and second."""
        return self.count / (self.pixels * self.span * US_PER_UNIT[unit] * 1e-6)

    def describe(self, unit: str) -> str:
        """Describe the recording as it would be under a unit."""
        seconds = self.span * US_PER_UNIT[unit] * 1e-6
        rate = f", {self.rate(unit):.2g} events per pixel and second" if seconds else ""
        return f"they last {seconds:.3g} s{rate}"

    def score(self, unit: str, usual: str | None) -> float:
        """Return the log-likelihood of a unit, up to a constant, in nats."""
        score = self._prior(unit, usual)
        seconds = US_PER_UNIT[unit] * 1e-6
        if not self.span:
            return score + _of_magnitude(self.median * seconds)
        span = np.log10(self.span * seconds)
        score += _normal(span, 0.7, 1.3 if span > 0.7 else 1.8)
        rate = np.log10(self.rate(unit))
        score += _normal(rate, 0.0, 1.2 if rate > 0 else 1.5)
        if self.repetition is not None:
            score += max(_normal(np.log10(self.repetition * seconds), -3.0, 0.9), -6.0)
        return score + _of_magnitude(self.median * seconds) + self._of_resolution(unit)

    def _prior(self, unit: str, usual: str | None) -> float:
        if self.rounding >= 1:
            return _ROUNDED_NUMBER_NATS[unit] + (
                _UNUSUAL_UNIT_NATS if usual not in (None, unit) else 0.0
            )
        if usual is None:
            return _DECIMAL_NUMBER_NATS[unit] if self.has_decimals else _WHOLE_NUMBER_NATS[unit]
        if unit == "s" and not self.has_decimals:
            return _WHOLE_NUMBER_NATS["s"]  # no recording has its events at whole seconds
        return 0.0 if unit == usual else _UNUSUAL_UNIT_NATS

    def _of_resolution(self, unit: str) -> float:
        """Return the log-likelihood of the decimal places."""
        if self.rounding >= 1:
            return 0.0
        if self.digits is None:
            return -1.2
        if not self.has_decimals:
            typical = {"us": 0, "ms": 0, "ns": -3, "s": 0}[unit]
            return -0.3 if self.digits == typical else -4.0
        typical = {"s": 6, "ms": 3, "us": 3, "ns": 3}[unit]
        if self.digits == typical:
            return -0.3
        if unit == "s":
            return {1: -6.0, 2: -6.0, 3: -3.5, 4: -3.5, 5: -3.0}.get(self.digits, -1.5)
        return -3.5 if self.digits > typical else -1.5


def _normal(value: float, mean: float, deviation: float) -> float:
    """Return the logarithm of a Gaussian, 0 at its mean.

    Args:
        value: The argument.
        mean: Its mean.
        deviation: Its standard deviation.

    Returns:
        The logarithm, at least -30.
    """
    return max(-0.5 * ((value - mean) / deviation) ** 2, -30.0)


def _is_impossible(largest: float, unit: str) -> bool:
    return _of_magnitude(largest * US_PER_UNIT[unit] * 1e-6) < -10


def _of_magnitude(seconds: float) -> float:
    if seconds <= 1e6:
        return 0.0
    if seconds < 9.4e8:
        return -4.0
    return -1.0 if seconds < 2.6e9 else -20.0


def _convention(numbers: _Numbers) -> str:
    """Return the usual unit of a table: us for whole numbers that differ, s for decimals.

    Large numbers of a coarse type are whole in any case; dates are then seconds.
    """
    if numbers.rounding >= 1 and 9.4e8 <= numbers.median < 2.6e9:
        return "s"
    if numbers.is_float and (numbers.has_decimals or not numbers.span):
        return "s"
    return "us"


def _repetition(t: NDArray, x: NDArray, y: NDArray) -> float | None:
    """Return the 5 % quantile of intervals between events of one pixel.

    Args:
        t: (n,) times.
        x: (n,) columns.
        y: (n,) rows.

    Returns:
        The quantile, in units of `t`; None of too few intervals.
    """
    order = np.lexsort((x[:-1], y[:-1]))  # the last event is not next to the others
    x, y, t = x[order], y[order], t[order]
    same = (x[1:] == x[:-1]) & (y[1:] == y[:-1]) & (t[1:] > t[:-1])
    if np.count_nonzero(same) < _MIN_REPETITIONS:
        return None
    return float(np.quantile((t[1:][same] - t[:-1][same]).astype(np.float64), 0.05))


def _digits(values: NDArray) -> int | None:
    """Return the least n with all values multiples of 10^-n, -9 to 9; None where there is none."""
    if values.dtype.kind != "f":
        whole = values
    else:
        t = values.astype(np.float64)
        error = 2 * np.spacing(np.abs(values).max()).astype(np.float64)
        for n in range(10):
            # Numbers that are whole only within an error of half a step show nothing.
            if n and error * 10.0**n > 0.05:
                return None
            scaled = t * 10.0**n
            if (np.abs(scaled - np.rint(scaled)) <= error * 10.0**n * (n > 0)).all():
                if n:
                    return n
                break
        else:
            return None
        if np.abs(t).max() >= 2.0**63:
            return 0
        whole = t.astype(np.int64)
    if not whole.any():
        return 0
    return -next((n for n in range(9, 0, -1) if not (whole % 10**n).any()), 0)


class Clock(NamedTuple):
    """The events' clock, for the times of images, poses and samples beside them.

    Attributes:
        unit: Unit of the event times, as stored.
        first: Time of the first event in us.
        last: Time of the last event in us; that of the first where there are none.
        is_float: Whether the times are stored as floats.
    """

    unit: str
    first: int
    last: int
    is_float: bool

    def read(
        self,
        values: NDArray,
        source: str,
        what: str,
        notes: list[str],
        *,
        usual: str | None = None,
        stated: str | None = None,
    ) -> NDArray[np.int64]:
        """Convert times of images, poses or samples to us; see the text of this module.

        Args:
            values: (n,) times as stored.
            source: Name of the file for messages.
            what: "image", "pose" or the like.
            notes: Notes of the recording, to which one on an unusual unit is added.
            usual: Unit of the layout; None has us for integers, s for floats.
            stated: Unit that the file states.

        Returns:
            (n,) int64 us.
        """
        unit = stated or usual or ("s" if values.dtype.kind == "f" else "us")
        in_usual = to_microseconds(values, unit, source, what)
        if stated is not None or self.last <= self.first or len(in_usual) < 2:
            return in_usual
        is_alike = self.unit != unit and self.is_float == (values.dtype.kind == "f")
        if is_alike and self._fits(values, self.unit):
            return to_microseconds(values, self.unit, source, what)
        if self._fits(values, unit):
            return in_usual
        others = {other: self._overlap(values, other) for other in US_PER_UNIT if other != unit}
        # The unit of the events first, where several would do.
        best = max(
            others, key=lambda u: (others[u] > _CLEAR_OVERLAP / 2, u == self.unit, others[u])
        )
        if others[best] <= _CLEAR_OVERLAP / 2 or not self._has_plausible_intervals(values, best):
            return in_usual
        note = f"{what} times are taken as {UNIT_NAMES[best]}, on the clock of the events"
        is_new = note not in notes
        notes += [note] * is_new
        if best != self.unit and is_new:
            _warn(
                f"{source}: {note}; as {UNIT_NAMES[unit]}, the usual unit, they would not fit the "
                f"events: write whole microseconds, or {UNIT_NAMES[unit]}, to be sure"
            )
        return to_microseconds(values, best, source, what)

    def _fits(self, values: NDArray, unit: str) -> bool:
        """Return whether times of a series fit the events' clock.

        Args:
            values: (n,) rising times of the series, n > 1.
            unit: Their unit.

        Returns:
            Whether their intervals are plausible, and they go with the events.
        """
        if not self._has_plausible_intervals(values, unit):
            return False
        first, last = _extremes(values, unit)
        if last < self.first or first > self.last:
            return False
        inside = first >= self.first and last <= self.last
        return not inside or self._overlap(values, unit) > _MIN_OVERLAP

    def _overlap(self, values: NDArray, unit: str) -> float:
        """Return the intersection of the spans of two series over their union.

        Args:
            values: (n,) times of a series.
            unit: Its unit.

        Returns:
            The ratio, 0 to 1.
        """
        first, last = _extremes(values, unit)
        common = min(last, self.last) - max(first, self.first)
        return max(common, 0.0) / max(max(last, self.last) - min(first, self.first), 1.0)

    @staticmethod
    def _has_plausible_intervals(values: NDArray, unit: str) -> bool:
        first, last = _extremes(values, unit)
        least, most = _PLAUSIBLE_INTERVALS_US
        return least <= (last - first) / (len(values) - 1) <= most


def _extremes(values: NDArray, unit: str) -> tuple[float, float]:
    """Return the least and the greatest of some times.

    Args:
        values: (n,) times.
        unit: Their unit.

    Returns:
        Both, us.
    """
    return float(values.min()) * US_PER_UNIT[unit], float(values.max()) * US_PER_UNIT[unit]
