"""Events packed for the tracker: chunks of steps of M events, of fixed shapes, on the host.

A chunk ends at the latest at a boundary of the life cycle (every `cycle` seconds from the start)
and at the time at which a seed begins. So births, deaths and steps do not depend on the length of
chunks and segments. Times are int32 us since the chunk's start, hence exact however long the
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

from jaxevent.blob.owners import NO_OWNER_INDEX, owner_candidates
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.search import TargetSearchResult
from jaxevent.blob.search.paths import tabulate_paths
from jaxevent.blob.seeds import read_seeds, tracking_span
from jaxevent.codegen import njit_noalloc
from jaxevent.errors import InputError
from jaxevent.estimator import ShortRepr
from jaxevent.events.filters import find_supported
from jaxevent.recording import Recording, Times, check_times, one_time

STEPS_PER_CHUNK_CHOICES = (4, 8, 16, 32, 64, 128, 256)  # possible numbers
STEPS_PER_SEGMENT = 8192
EVENTS_PER_READ = 65536  # events read from a file at a time
MAX_UNSPREAD_TIES = 16  # more events of one time have the order of a readout, not of the scene
CANDIDATE_SIGMAS = 3.5  # distance from a found path within which an event may be the target's
MAX_CHUNK_US = 2**29  # between boundaries; two of them fit into int32
NEVER_US = np.iinfo(np.int64).max

Numeric = Array | np.ndarray


class Features(ShortRepr):
    """Chunks of steps of M events; a padding event is not valid and has its step's time."""

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
    owner: Int[Numeric, "chunks steps M 2"] | None  # see `owner_candidates`; None: any track
    overrides: dict[str, Float[Numeric, " seeds"]]  # parameters (`raw`) of single seeds
    frame: Float[Numeric, " 2"]  # width and height, px
    detect: bool = eqx.field(static=True)
    grid_shape: tuple[int, int] = eqx.field(static=True)  # rows and columns of the clutter grid


class ReadoutTimes(ShortRepr):
    """Location of times in the chunks of `Features`."""

    chunk: Int[Numeric, " times"]
    step: Int[Numeric, " times"]  # steps of the chunk done by then
    time: Int[Numeric, " times"]  # us since the chunk's start
    inside: Bool[Numeric, " times"]  # whether it is tracked then
    seed_index: Int[Numeric, " seeds"]  # index of each seed in the user's order
    ended: Bool[Numeric, "times seeds"]  # whether a found target has ended by then


class PackingCursor(NamedTuple):
    """Place in a recording where the packing of a segment begins.

    Attributes:
        row: Row of the next event.
        previous: Start of the chunk before, us.
        start: Start of the chunk, us.
        seed: Index of the next seed.
    """

    row: int
    previous: int
    start: int
    seed: int


@dataclasses.dataclass(frozen=True)
class Segment:
    """Consecutive chunks, with their times and the rows of their events.

    Attributes:
        features: Packed events of the chunks.
        start: (chunks,) start of each chunk, us.
        row: (chunks, steps, M) row of each event in the recording, -1 where not valid.
        next: Place where the next segment begins; None: this is the last one.
    """

    features: Features
    start: NDArray[np.int64]
    row: NDArray[np.int64]
    next: PackingCursor | None

    @property
    def n_chunks(self) -> int:
        """Number of chunks without padding."""
        return int((self.start < NEVER_US).sum())

    def find_steps(self, us: NDArray[np.int64]) -> tuple[NDArray, NDArray[np.int32], NDArray]:
        """Return chunk, steps done and us since the chunk's start of each time (us)."""
        return find_steps(self.features, self.start, us)


class ChunkPacker:
    """Packer of the events between two times into chunks, one segment after another.

    Args:
        recording: The events.
        params: Of these act `events_per_step`, `cycle`, `cell` and those of the prefilter.
        seeds: One (x, y, size) or (x, y, size, t) for every target; None: none.
        start: Integers are us, floats s; None: the first event.
        stop: The first time that is left out; None: after the last event.
        detect: Whether tracks are born of unassociated events; None: only without seeds.
        found: Targets found before: they are the seeds and limit the tracks of each event.
        steps: Steps of a chunk; None: chosen by the rate of events.
        chunks: Chunks of a segment; None: chosen by the steps.
        events_per_segment: At least this many events fit into a segment of default length.
        as_stored: Whether events of one time are taken as they are stored, and not spread.
        live: Whether events are still to come, so that the span may go beyond those of now.

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
        events_per_segment: int = 0,
        as_stored: bool = False,
        live: bool = False,
    ):
        if params.association == "authors" and params.events_per_step > 1:
            raise InputError(
                f'{recording.name}: association = "authors" takes one event after the other, but '
                f"events_per_step is {params.events_per_step}; omit it"
            )
        begin, end = tracking_span(recording, start, stop, live=live)
        if found is not None:
            if seeds is not None or detect:
                raise InputError(
                    f"{recording.name}: targets that were found take no seeds and no detection; "
                    "leave these out"
                )
            seeds, detect = found.seeds(begin, end), False
        detect = seeds is None if detect is None else detect
        self.recording, self.start, self.stop = recording, begin, end
        self.joined = self.found_ends = None
        self.found_edges: list[bool] = []
        self.overrides: dict[str, Numeric] = {}
        if found is not None and len(found):
            self.joined = tabulate_paths(found.paths)
            # A target seen in the last window but one goes on to the end.
            self.found_ends = np.array(
                [end if p.end >= end - p.window else p.end for p in found.paths], np.int64
            )
            self.found_edges = [path.lone_edge for path in found.paths]
            self.overrides |= found.per_target_values(params)
        earliest = None if start is None else one_time(start, "the start")
        self.seeds = read_seeds(recording, seeds, begin, end, earliest)
        # Without births and tentative tracks less is to be decided.
        self.period = max(1, round((1 if detect else 10) * 1e6 * float(params.cycle)))
        self.rows = recording.events.index(begin), recording.events.index(end)
        self.events_per_step = params.events_per_step
        self.detect, self.prefilter = detect, params.prefilter
        self.neighbours = params.prefilter_neighbours
        self.prefilter_us = round(1e6 * float(params.prefilter_time))
        cell = params.cell
        self.grid_shape = -(-recording.height // cell), -(-recording.width // cell)
        if steps is None:
            events = (self.rows[1] - self.rows[0]) * self.period / max(end - begin, 1)
            # Steps between boundaries, and some.
            mean = (events + events**0.5) / self.events_per_step
            steps = min(STEPS_PER_CHUNK_CHOICES, key=lambda s: max(1, np.ceil(mean / s)) * (s + 4))
        if chunks is None:
            events = max(events_per_segment, STEPS_PER_SEGMENT * self.events_per_step)
            chunks = max(1, events // (steps * self.events_per_step))
        self.steps, self.chunks = steps, chunks
        self.first = PackingCursor(self.rows[0], begin, begin, 0)
        self._as_stored = as_stored or params.association == "authors"

    def pack(self, cursor: PackingCursor, *, more: bool = False) -> Segment:
        """Pack the segment that begins at a cursor.

        Args:
            cursor: Begin of the segment.
            more: Whether events are still to come: a chunk that these may change is left to the
                next segment.
        """
        shape = self.chunks, self.steps, self.events_per_step
        real = np.dtype(jnp.result_type(float))
        out = _ChunkArrays(
            np.zeros(shape, np.int32),
            np.zeros((*shape, 2), real),
            np.zeros(shape, real),
            np.full(shape, -1, np.int64),
            np.zeros(self.chunks, np.int64),
            np.zeros(self.chunks, np.int32),
            np.zeros(self.chunks, np.int32),
            np.zeros(self.chunks, bool),
            np.full(len(self.seeds.t), -1, np.int32),
            np.full(
                (*(shape if self.joined is not None else (0, 0, 0)), 2), NO_OWNER_INDEX, np.int32
            ),
        )
        stop = NEVER_US if more else self.stop
        limits = _ChunkLimits(self.start, stop, self.period, self.seeds.t)
        state = _PackingState(0, 0, 0, cursor.row, cursor.previous, cursor.start, 0, cursor.seed)
        row, done = cursor.row, False
        while not done and not (more and row == self.rows[1]):
            end = min(row + EVENTS_PER_READ, self.rows[1])
            rows = self._read(row, end)
            final = end == self.rows[1] and not more
            done, used, state = _pack(rows, row, final, limits, state, out)
            row += used
        if state.opened:
            row, state = state.row, _discard_open_chunk(state, out)
        out.start[state.chunk :] = NEVER_US
        features = Features(
            out.t, out.xi, out.polarity, out.row >= 0, out.elapsed, out.stop, out.cycle, out.seed,
            self.seeds.xi.astype(real), self.seeds.size.astype(real),
            out.owner if self.joined is not None else None, self.overrides,
            np.array([self.recording.width, self.recording.height], real),
            self.detect, self.grid_shape,
        )  # fmt: skip
        ended = state.previous == state.begin == stop
        following = None if ended else PackingCursor(row, state.previous, state.begin, state.seed)
        return Segment(features, out.start, out.row, following)

    def _read(self, begin: int, end: int) -> "_EventRows":
        """Read the events [begin, end) in the order in which they are packed.

        The order is that of rows, but for many events of one time. A readout stores these line by
        line; here every step gets events of all lines, see `_spread_ties`.
        """
        events, first, last = self.recording.events, begin, end
        if not self._as_stored and end > begin:
            t0, t1 = (int(events[row : row + 1].t[0]) for row in (begin, end - 1))
            first = max(events.index(t0), self.rows[0])
            last = min(events.index(t1 + 1), self.rows[1])
        part = events[first:last]
        accepted, owner = self._prefilter(part, first), np.empty((0, 2), np.int32)
        if self.joined is not None:
            owner = owner_candidates(part, self.joined, CANDIDATE_SIGMAS)
            accepted &= owner[:, 0] != NO_OWNER_INDEX
        order = np.arange(len(part))
        _spread_ties(part.t, len(part) if self._as_stored else MAX_UNSPREAD_TIES, order)
        order = order[begin - first : end - first]
        return _EventRows(part.t, part.x, part.y, part.p, accepted, owner, order, first)

    def pack_all(self) -> Features:
        """Pack all chunks at once, for recordings that fit into memory."""
        segments, cursor = [], self.first
        while cursor is not None:
            segments.append(self.pack(cursor))
            cursor = segments[-1].next
        n_chunks = sum(segment.n_chunks for segment in segments)
        n_chunks = -(-n_chunks // 32) * 32  # so that few shapes occur
        fields = {}
        names = ("t", "xi", "polarity", "valid", "elapsed", "stop", "cycle")
        for name in (*names, "owner") if self.joined is not None else names:
            fields[name] = np.concatenate([getattr(w.features, name) for w in segments])[:n_chunks]
        at = np.stack([w.features.seed for w in segments])
        place = np.argmax(at >= 0, axis=0)
        seed = np.where(
            (at >= 0).any(0), at.max(0, initial=-1) + place.astype(np.int32) * self.chunks, -1
        )
        return dataclasses.replace(segments[0].features, seed=seed.astype(np.int32), **fields)

    def locate_times(self, features: Features, us: NDArray[np.int64]) -> ReadoutTimes:
        """Find the chunks and steps of some times.

        Args:
            features: All chunks of the recording.
            us: (n,) times, us.

        Returns:
            The place of each time, and whether it is inside the tracked span.
        """
        inside = (self.start <= us) & (us < self.stop)
        us = np.where(inside, us, self.start)
        n_chunks = int(np.flatnonzero(features.cycle)[-1]) + 1  # the others are padding
        begins = self.start + np.cumsum(features.elapsed[:n_chunks], dtype=np.int64)
        chunk, step, time = find_steps(features, begins, us)
        ended = np.zeros((len(us), len(self.seeds.t)), bool)
        if self.found_ends is not None:
            ended = us[:, None] >= self.found_ends
        index = self.seeds.index
        return ReadoutTimes(chunk, step, time.astype(np.int32), inside, index, ended)

    def check_times(self, times: Times) -> None:
        """Raise `InputError` for times outside the recording and outside the tracked span."""
        start, stop = self.start, self.stop - 1
        if len(self.recording.events) or self.recording.frames is not None:
            start, stop = min(start, self.recording.start), max(stop, self.recording.stop)
        check_times(times, start, stop, self.recording.name)

    def _prefilter(self, events, row: int) -> NDArray[np.bool_]:
        """Return which events pass the background-activity prefilter.

        Only events at most `prefilter_time` older matter. So they are read again for every segment
        and no image of times is kept between segments.

        Args:
            events: Consecutive events.
            row: Row of the first one in the recording.

        Returns:
            (events,) truth values.
        """
        if not self.prefilter or not len(events):
            return np.ones(len(events), bool)
        before = self.recording.events.index(int(events.t[0]) - self.prefilter_us)
        warm = self.recording.events[max(before, self.rows[0]) : row]
        shape = self.recording.height + 2, self.recording.width + 2
        last = np.full(shape, np.iinfo(np.int64).min // 2)
        for part in (warm, events):
            passed = find_supported(
                part.t, part.x, part.y, last, self.prefilter_us, self.neighbours
            )
        return passed


def packing_key(params: TrackerParams) -> tuple[Any, ...]:
    """Return the parameters that act when events are packed; equal ones pack alike."""
    names = ("events_per_step", "cycle", "cell", "prefilter", "prefilter_neighbours")
    return *(float(getattr(params, name)) for name in names), float(params.prefilter_time)


def find_steps(
    features: Features, start: NDArray[np.int64], us: NDArray[np.int64]
) -> tuple[NDArray, NDArray[np.int32], NDArray]:
    """Find times in chunks.

    Args:
        features: The chunks.
        start: Starts of the chunks, us.
        us: Times, us.

    Returns:
        Of each time the chunk, the steps of it that are done by then, and us since its start.
    """
    chunk = np.searchsorted(start, us, "right") - 1
    time = us - start[chunk]
    done = (np.asarray(features.t)[chunk, :, -1] <= time[:, None]) & np.asarray(features.valid)[
        chunk, :, 0
    ]
    return chunk, done.sum(1, dtype=np.int32), time


class _EventRows(NamedTuple):
    """Events that were read, of which some are packed.

    Attributes:
        t: (n,) times, us.
        x: (n,) columns, px.
        y: (n,) rows, px.
        p: (n,) polarities.
        accepted: (n,) whether the prefilter accepts the event.
        owner: (n, 2) serial numbers of tracks that may own the event, or empty.
        order: Indices of the events to be packed, one after another.
        first: Row of the first event in the recording.
    """

    t: NDArray
    x: NDArray
    y: NDArray
    p: NDArray
    accepted: NDArray
    owner: NDArray
    order: NDArray
    first: int


class _ChunkLimits(NamedTuple):
    """Times at which chunks end.

    Attributes:
        start: Start of the first cycle, us.
        stop: End of the recording, us.
        period: Length of a cycle, us.
        seed_t: (seeds,) start times of the seeds, us.
    """

    start: int
    stop: int
    period: int
    seed_t: NDArray


class _PackingState(NamedTuple):
    """State of the packing between two reads.

    Attributes:
        chunk: Index of the chunk.
        opened: Whether that chunk is begun.
        fill: Number of events in it.
        row: Row of its first event.
        previous: Start of the chunk before, us.
        begin: Its start, us.
        end: Its end, us.
        seed: Index of the next seed.
    """

    chunk: int
    opened: int
    fill: int
    row: int
    previous: int
    begin: int
    end: int
    seed: int


class _ChunkArrays(NamedTuple):
    """Arrays of chunks to be filled.

    Attributes:
        t: (chunks, steps, M) times, us since the chunk's start.
        xi: (chunks, steps, M, 2) positions, px.
        polarity: (chunks, steps, M) +1 or -1.
        row: (chunks, steps, M) row in the recording; -1: padding.
        start: (chunks,) start of each chunk, us.
        elapsed: (chunks,) time from the start of the chunk before, us.
        stop: (chunks,) time from the chunk's start to its end, us.
        cycle: (chunks,) whether births and deaths happen at its end.
        seed: (seeds,) chunk at whose start each seed begins; -1: none of these.
        owner: (chunks, steps, M, 2) serial numbers of tracks that may own the event, or empty.
    """

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


def _discard_open_chunk(state: _PackingState, out: _ChunkArrays) -> _PackingState:
    """Discard the chunk that is open.

    Args:
        state: State of the packing.
        out: Arrays of the chunks, of which those of the open one are cleared.

    Returns:
        The state before it was opened.
    """
    chunk = state.chunk
    seeded = out.seed == chunk
    out.row[chunk], out.seed[seeded], out.elapsed[chunk] = -1, -1, 0
    seed = state.seed - int(seeded.sum())
    return _PackingState(chunk, 0, 0, state.row, state.previous, state.begin, 0, seed)


@njit_noalloc
def _spread_ties(t: Any, max_ties: int, order: Any) -> None:
    """Spread long runs of equal times in an order of events.

    A run of n is traversed in steps of about .618 n, so that a few consecutive events come from all
    parts of the run.

    Args:
        t: (n,) sorted times, us.
        max_ties: Number of equal times that stay in order.
        order: (n,) indices of the events, changed in place.
    """
    begin = 0
    for end in range(1, len(t) + 1):
        if end < len(t) and t[end] == t[begin]:
            continue
        n = end - begin
        if n > max_ties:
            step = np.int64(0.618034 * n)
            while math.gcd(step, n) > 1:
                step += 1
            for k in range(n):
                order[begin + k] = begin + k * step % n
        begin = end


@njit_noalloc
def _pack(rows, first_row, final, limits, state, out):
    """Fill chunks until they are full or the events end.

    Args:
        rows: `_EventRows` to be packed.
        first_row: Row of the first of them in the recording.
        final: Whether these are the last events; then the end of the time closes the open chunk.
        limits: `_ChunkLimits`.
        state: `_PackingState` before.
        out: `_ChunkArrays`, output.

    Returns:
        Whether the chunks are full or time is over, the number of events used, and the state after.
    """
    chunk, opened, fill, row, previous, begin, end, following = state
    seed_t, finish = limits.seed_t, limits.stop
    chunks, steps, size = out.t.shape
    i, count, order, owned = 0, len(rows.order), rows.order, len(rows.owner) > 0
    step, slot = fill // size, fill % size
    while i < count + (1 if final else 0):
        k = order[i] if i < count else 0
        if i < count and not rows.accepted[k] and not (opened and rows.t[k] >= end):
            i += 1
            continue
        now = rows.t[k] if i < count else finish
        if not opened:
            if chunk == chunks:
                return True, i, _PackingState(chunk, 0, 0, row, previous, begin, 0, following)
            out.start[chunk] = begin
            out.elapsed[chunk] = begin - previous
            while following < len(seed_t) and seed_t[following] <= begin:
                out.seed[following] = chunk
                following += 1
            end = limits.start + ((now - limits.start) // limits.period + 1) * limits.period
            end = min(end, begin + MAX_CHUNK_US)
            if following < len(seed_t):
                end = min(end, seed_t[following])
            opened, step, slot, row = 1, 0, 0, first_row + i
        over = now >= end or (i == count)
        if over or step == steps:
            close = min(end, finish) if over else now
            out.stop[chunk] = close - begin
            whole = (close - limits.start) % limits.period == 0
            out.cycle[chunk] = over and (whole or close == finish)
            if slot > 0:
                out.t[chunk, step, slot:] = out.t[chunk, step, slot - 1]
            previous, begin, opened = begin, close, 0
            chunk += 1
            if i == count and close == finish:
                return True, i, _PackingState(chunk, 0, 0, row, finish, finish, 0, following)
            continue
        out.t[chunk, step, slot] = now - begin
        out.xi[chunk, step, slot, 0] = rows.x[k]
        out.xi[chunk, step, slot, 1] = rows.y[k]
        out.polarity[chunk, step, slot] = 1 if rows.p[k] else -1
        out.row[chunk, step, slot] = rows.first + k
        if owned:
            out.owner[chunk, step, slot, 0] = rows.owner[k, 0]
            out.owner[chunk, step, slot, 1] = rows.owner[k, 1]
        slot, i = slot + 1, i + 1
        if slot == size:
            step, slot = step + 1, 0
    fill = step * size + slot
    return False, i, _PackingState(chunk, opened, fill, row, previous, begin, end, following)
