"""Events packed for the tracker: chunks of steps of M events, of fixed shapes, on the host.

A chunk never reaches over a boundary of the life cycle (every `cycle` seconds from the start) nor
over the time at which a seed begins, so births, deaths and steps do not depend on how long chunks
and stretches are. Times are int32 us since the chunk's start, hence exact however long the
recording.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from jaxevent.blob.params import TrackerParams
from jaxevent.blob.search import TargetSearchResult
from jaxevent.blob.search.paths import NO_OWNER, owner_candidates, tabulate_paths
from jaxevent.blob.seeds import read_seeds, span_of
from jaxevent.codegen import njit_noalloc
from jaxevent.errors import InputError
from jaxevent.estimator import ShortRepr
from jaxevent.events.filters import supported
from jaxevent.recording import Recording, Times, check_times

STEPS = (4, 8, 16, 32, 64, 128, 256)  # per chunk
STRETCH_STEPS = 8192
STRETCH_EVENTS = 262144  # at least, where a kernel follows targets
READ_ROWS = 65536  # events read from a file at a time
TIES = 16  # more events of one time are in the order of a readout, and not of the scene
NEAR = 3.5  # standard deviations from a found path within which events may be the target's
LONGEST = 2**29  # us between boundaries; two of them fit into int32
NEVER = np.iinfo(np.int64).max  # us

Numeric = Array | np.ndarray


class Features(ShortRepr):
    """Chunks of events. An event that only fills up is not valid and has its step's time."""

    t: Int[Numeric, "chunks steps M"]  # us since the chunk's start
    xi: Float[Numeric, "chunks steps M 2"]  # px
    polarity: Float[Numeric, "chunks steps M"]
    valid: Bool[Numeric, "chunks steps M"]
    elapsed: Int[Numeric, " chunks"]  # us from the start of the chunk before
    stop: Int[Numeric, " chunks"]  # us from the chunk's start to its end
    cycle: Bool[Numeric, " chunks"]  # births and deaths happen at its end
    seed: Int[Numeric, " seeds"]  # the chunk at whose start each seed begins; -1: not in these
    seed_xi: Float[Numeric, "seeds 2"]  # px
    seed_size: Float[Numeric, " seeds"]  # px; 0: lambda0
    owner: Int[Numeric, "chunks steps M 2"] | None  # see `owner_candidates`; None: anybody
    own: dict[str, Float[Numeric, " seeds"]]  # numbers (`raw`) that are a seed's own
    frame: Float[Numeric, " 2"]  # width and height, px
    detect: bool = eqx.field(static=True)
    cells: tuple[int, int] = eqx.field(static=True)  # rows and columns of the grid of births


class ReadOut(ShortRepr):
    """Where times are in the chunks of `Features`."""

    chunk: Int[Numeric, " times"]
    step: Int[Numeric, " times"]  # steps of the chunk done by then
    time: Int[Numeric, " times"]  # us since the chunk's start
    inside: Bool[Numeric, " times"]  # whether it is tracked then
    given: Int[Numeric, " seeds"]  # the place of each seed, by time, among those given
    ended: Bool[Numeric, "times seeds"]  # whether what was found has ended by then


class Mark(NamedTuple):
    """Where a stretch begins: the next event's row and the start of the chunk; no state."""

    row: int
    previous: int  # us, start of the chunk before
    start: int  # us
    seed: int  # the next one


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Consecutive chunks, where they are in time (us) and of which rows their events are."""

    features: Features
    start: NDArray[np.int64]  # of each chunk
    row: NDArray[np.int64]  # (chunks, steps, M), -1 where not valid
    next: Mark | None

    @property
    def used(self) -> int:
        """The number of chunks, but for those that fill up."""
        return int((self.start < NEVER).sum())

    def find_steps(self, us: NDArray[np.int64]) -> tuple[NDArray, NDArray[np.int32], NDArray]:
        """The chunk of each time (us), its steps done by then, and the time since its start."""
        return find_steps(self.features, self.start, us)


class Packing:
    """The chunks of a recording between two times, one stretch after another.

    Args:
        recording: The events.
        params: The numbers that act here: `events_per_step`, `cycle`, `cell`, those of the
            prefilter.
        seeds: One (x, y, size) or (x, y, size, t) for every target; None: none.
        start: Integers are us, floats s; None: the first event.
        stop: The first time that is left out; None: after the last event.
        detect: Whether tracks are born where events belong to none; None: only without seeds.
        found: Targets that were found: they are the seeds and say whose events may be.
        steps: Of a chunk; None: as suits the recording.
        chunks: Of a stretch; None: as suits the steps.
        as_stored: Whether events of one time are taken as they are stored, and not spread.

    Raises:
        InputError: A seed is outside the sensor or the time, there is no time to track, or events
            share steps though the association takes them singly.
    """

    def __init__(
        self,
        recording: Recording,
        params: TrackerParams,
        seeds: Sequence[Any] | np.ndarray | None = None,
        start: int | float | None = None,
        stop: int | float | None = None,
        detect: bool | None = None,
        *,
        found: TargetSearchResult | None = None,
        steps: int | None = None,
        chunks: int | None = None,
        as_stored: bool = False,
    ):
        if params.association == "authors" and params.events_per_step > 1:
            raise InputError(
                f'{recording.name}: association = "authors" takes one event after the other, but '
                f"events_per_step is {params.events_per_step}; omit it"
            )
        begin, end = span_of(recording, start, stop)
        if found is not None:
            if seeds is not None or detect:
                raise InputError(
                    f"{recording.name}: targets that were found take no seeds and no detection; "
                    "leave these out"
                )
            seeds, detect = found.seeds(begin, end), False
        detect = seeds is None if detect is None else detect
        self.recording, self.start, self.stop = recording, begin, end
        self.joined = self.ends = None
        self.own: dict[str, Numeric] = {}
        if found is not None and len(found):
            self.joined = tabulate_paths(found.paths)
            # What is seen to the last but one window goes on to the end.
            self.ends = np.array(
                [end if p.end >= end - p.window else p.end for p in found.paths], np.int64
            )
            self.own |= found.per_target_values(params)
        self.seeds = read_seeds(recording, seeds, begin, end)
        # Without births and tentative tracks less is to be decided.
        self.period = max(1, round((1 if detect else 10) * 1e6 * float(params.cycle)))
        self.rows = recording.events.index(begin), recording.events.index(end)
        self.events = params.events_per_step
        self.detect, self.prefilter = detect, params.prefilter
        self.neighbours = params.prefilter_neighbours
        self.reach = round(1e6 * float(params.prefilter_time))
        cell = params.cell
        self.cells = -(-recording.height // cell), -(-recording.width // cell)
        if steps is None:
            events = (self.rows[1] - self.rows[0]) * self.period / max(end - begin, 1)
            mean = (events + events**0.5) / self.events  # steps between boundaries, and some
            steps = min(STEPS, key=lambda s: max(1, np.ceil(mean / s)) * (s + 4))
        self.steps = steps
        self.chunks = max(1, STRETCH_STEPS // steps) if chunks is None else chunks
        self.first = Mark(self.rows[0], begin, begin, 0)
        self._as_stored = as_stored or params.association == "authors"

    def lengthen(self) -> None:
        """Make stretches longer, so that a kernel seldom waits for one to be laid out."""
        self.chunks = max(self.chunks, STRETCH_EVENTS // (self.steps * self.events))

    def pack(self, mark: Mark, *, more: bool = False) -> Stretch:
        """The stretch that begins there.

        With `more` events are still to come: a chunk that these may change is left to the next
        stretch.
        """
        shape = self.chunks, self.steps, self.events
        real = np.dtype(jnp.result_type(float))
        out = _Chunks(
            np.zeros(shape, np.int32),
            np.zeros((*shape, 2), real),
            np.zeros(shape, real),
            np.full(shape, -1, np.int64),
            np.zeros(self.chunks, np.int64),
            np.zeros(self.chunks, np.int32),
            np.zeros(self.chunks, np.int32),
            np.zeros(self.chunks, bool),
            np.full(len(self.seeds.t), -1, np.int32),
            np.full((*(shape if self.joined is not None else (0, 0, 0)), 2), NO_OWNER, np.int32),
        )
        stop = NEVER if more else self.stop
        bounds = _Bounds(self.start, stop, self.period, self.seeds.t)
        place = _Place(0, 0, 0, mark.row, mark.previous, mark.start, 0, mark.seed)
        at, done = mark.row, False
        while not done and not (more and at == self.rows[1]):
            upto = min(at + READ_ROWS, self.rows[1])
            given = self._read(at, upto)
            final = upto == self.rows[1] and not more
            done, used, place = _pack(given, at, final, bounds, place, out)
            at += used
        if place.opened:
            at, place = place.at, _leave_open(place, out)
        out.start[place.chunk :] = NEVER
        features = Features(
            out.t, out.xi, out.polarity, out.row >= 0, out.elapsed, out.stop, out.cycle, out.seed,
            self.seeds.xi.astype(real), self.seeds.size.astype(real),
            out.owner if self.joined is not None else None, self.own,
            np.array([self.recording.width, self.recording.height], real),
            self.detect, self.cells,
        )  # fmt: skip
        ended = place.previous == place.begin == stop
        following = None if ended else Mark(at, place.previous, place.begin, place.seed)
        return Stretch(features, out.start, out.row, following)

    def _read(self, at: int, upto: int) -> "_Given":
        """Events of some places in the order in which they are taken.

        Places are rows, but for many events of one time. A readout stores these line by line; here
        every step gets events of all lines, see `_spread`.
        """
        events, first, last = self.recording.events, at, upto
        if not self._as_stored and upto > at:
            begin, end = (int(events[row : row + 1].t[0]) for row in (at, upto - 1))
            first = max(events.index(begin), self.rows[0])
            last = min(events.index(end + 1), self.rows[1])
        part = events[first:last]
        kept, owner = self._kept(part, first), np.empty((0, 2), np.int32)
        if self.joined is not None:
            owner = owner_candidates(part, self.joined, NEAR)
            kept &= owner[:, 0] != NO_OWNER
        order = np.arange(len(part))
        _spread(part.t, len(part) if self._as_stored else TIES, order)
        order = order[at - first : upto - first]
        return _Given(part.t, part.x, part.y, part.p, kept, owner, order, first)

    def whole(self) -> Features:
        """All chunks at once, for recordings that fit into memory."""
        stretches, mark = [], self.first
        while mark is not None:
            stretches.append(self.pack(mark))
            mark = stretches[-1].next
        used = sum(w.used for w in stretches)
        used = -(-used // 32) * 32  # so that few shapes occur
        fields = {}
        names = ("t", "xi", "polarity", "valid", "elapsed", "stop", "cycle")
        for name in (*names, "owner") if self.joined is not None else names:
            fields[name] = np.concatenate([getattr(w.features, name) for w in stretches])[:used]
        at = np.stack([w.features.seed for w in stretches])
        place = np.argmax(at >= 0, axis=0)
        seed = np.where(
            (at >= 0).any(0), at.max(0, initial=-1) + place.astype(np.int32) * self.chunks, -1
        )
        return dataclasses.replace(stretches[0].features, seed=seed.astype(np.int32), **fields)

    def read_out(self, features: Features, us: NDArray[np.int64]) -> ReadOut:
        """Where some times (us) are in all chunks, `features`."""
        inside = (self.start <= us) & (us < self.stop)
        us = np.where(inside, us, self.start)
        used = int(np.flatnonzero(features.cycle)[-1]) + 1  # the others fill up
        begins = self.start + np.cumsum(features.elapsed[:used], dtype=np.int64)
        chunk, step, time = find_steps(features, begins, us)
        ended = np.zeros((len(us), len(self.seeds.t)), bool)
        if self.ends is not None:
            ended = us[:, None] >= self.ends
        return ReadOut(chunk, step, time.astype(np.int32), inside, self.seeds.given, ended)

    def check_times(self, times: Times) -> None:
        """Raise `InputError` for times outside the recording and outside what is tracked."""
        start, stop = self.start, self.stop - 1
        if len(self.recording.events) or self.recording.frames is not None:
            start, stop = min(start, self.recording.start), max(stop, self.recording.stop)
        check_times(times, start, stop, self.recording.name)

    def _kept(self, events, row: int) -> NDArray[np.bool_]:
        """Which events the background-activity prefilter keeps.

        Only events at most `prefilter_time` older matter, so these are looked at anew for every
        stretch and no image of times is kept between stretches.
        """
        if not self.prefilter or not len(events):
            return np.ones(len(events), bool)
        before = self.recording.events.index(int(events.t[0]) - self.reach)
        warm = self.recording.events[max(before, self.rows[0]) : row]
        shape = self.recording.height + 2, self.recording.width + 2
        last = np.full(shape, np.iinfo(np.int64).min // 2)
        for part in (warm, events):
            kept = supported(part.t, part.x, part.y, last, self.reach, self.neighbours)
        return kept


def packing_key(params: TrackerParams) -> tuple[Any, ...]:
    """The numbers that act when events are packed; equal ones pack alike."""
    names = ("events_per_step", "cycle", "cell", "prefilter", "prefilter_neighbours")
    return *(float(getattr(params, name)) for name in names), float(params.prefilter_time)


def find_steps(
    features: Features, start: NDArray[np.int64], us: NDArray[np.int64]
) -> tuple[NDArray, NDArray[np.int32], NDArray]:
    """As `Stretch.find_steps`, of chunks that start at these times."""
    chunk = np.searchsorted(start, us, "right") - 1
    time = us - start[chunk]
    done = (np.asarray(features.t)[chunk, :, -1] <= time[:, None]) & np.asarray(features.valid)[
        chunk, :, 0
    ]
    return chunk, done.sum(1, dtype=np.int32), time


class _Given(NamedTuple):
    """Events to be packed, and others of the first and the last one's times."""

    t: NDArray
    x: NDArray
    y: NDArray
    p: NDArray
    kept: NDArray  # by the prefilter
    owner: NDArray
    order: NDArray  # places of those that are packed, one after another
    first: int  # row of the first


class _Bounds(NamedTuple):
    """What chunks do not reach over, us: the cycles from `start` on, `stop`, the seeds' times."""

    start: int
    stop: int
    period: int
    seed_t: NDArray


class _Place(NamedTuple):
    """How far the packing is."""

    chunk: int
    opened: int  # whether that chunk is begun
    fill: int  # events in it
    at: int  # its first event's place
    previous: int  # us, start of the chunk before
    begin: int  # us, its start
    end: int  # us
    seed: int  # the next one


class _Chunks(NamedTuple):
    """Arrays to be filled; see `Features` and `Stretch`."""

    t: NDArray
    xi: NDArray
    polarity: NDArray
    row: NDArray
    start: NDArray
    elapsed: NDArray
    stop: NDArray
    cycle: NDArray
    seed: NDArray
    owner: NDArray


def _leave_open(place: _Place, out: _Chunks) -> _Place:
    """Take back the chunk that is open: the place before it."""
    chunk = place.chunk
    sown = out.seed == chunk
    out.row[chunk], out.seed[sown], out.elapsed[chunk] = -1, -1, 0
    begun = place.seed - int(sown.sum())
    return _Place(chunk, 0, 0, place.at, place.previous, place.begin, 0, begun)


@njit_noalloc
def _spread(t: Any, least: int, order: Any) -> None:
    """Spread runs of more than so many equal times in an order.

    Places of a run of n are taken in steps of about .618 n, so that a few that follow each other
    are of all parts of the run.
    """
    begin = 0
    for end in range(1, len(t) + 1):
        if end < len(t) and t[end] == t[begin]:
            continue
        n = end - begin
        if n > least:
            step = np.int64(0.618034 * n)
            while math.gcd(step, n) > 1:
                step += 1
            for k in range(n):
                order[begin + k] = begin + k * step % n
        begin = end


@njit_noalloc
def _pack(given, first_row, final, bounds, place, out):
    """Fill chunks until they are full or events end: (full or ended, events used, place).

    With `final`, the end of the time closes what is open.
    """
    chunk, opened, fill, at, previous, begin, end, following = place
    seed_t, finish = bounds.seed_t, bounds.stop
    chunks, steps, size = out.t.shape
    i, count, order, owned = 0, len(given.order), given.order, len(given.owner) > 0
    step, slot = fill // size, fill % size
    while i < count + (1 if final else 0):
        k = order[i] if i < count else 0
        if i < count and not given.kept[k] and not (opened and given.t[k] >= end):
            i += 1
            continue
        now = given.t[k] if i < count else finish
        if not opened:
            if chunk == chunks:
                return True, i, _Place(chunk, 0, 0, at, previous, begin, 0, following)
            out.start[chunk] = begin
            out.elapsed[chunk] = begin - previous
            while following < len(seed_t) and seed_t[following] <= begin:
                out.seed[following] = chunk
                following += 1
            end = bounds.start + ((now - bounds.start) // bounds.period + 1) * bounds.period
            end = min(end, begin + LONGEST)
            if following < len(seed_t):
                end = min(end, seed_t[following])
            opened, step, slot, at = 1, 0, 0, first_row + i
        over = now >= end or (i == count)
        if over or step == steps:
            close = min(end, finish) if over else now
            out.stop[chunk] = close - begin
            whole = (close - bounds.start) % bounds.period == 0
            out.cycle[chunk] = over and (whole or close == finish)
            if slot > 0:
                out.t[chunk, step, slot:] = out.t[chunk, step, slot - 1]
            previous, begin, opened = begin, close, 0
            chunk += 1
            if i == count and close == finish:
                return True, i, _Place(chunk, 0, 0, at, finish, finish, 0, following)
            continue
        out.t[chunk, step, slot] = now - begin
        out.xi[chunk, step, slot, 0] = given.x[k]
        out.xi[chunk, step, slot, 1] = given.y[k]
        out.polarity[chunk, step, slot] = 1 if given.p[k] else -1
        out.row[chunk, step, slot] = given.first + k
        if owned:
            out.owner[chunk, step, slot, 0] = given.owner[k, 0]
            out.owner[chunk, step, slot, 1] = given.owner[k, 1]
        slot, i = slot + 1, i + 1
        if slot == size:
            step, slot = step + 1, 0
    return False, i, _Place(chunk, opened, step * size + slot, at, previous, begin, end, following)
