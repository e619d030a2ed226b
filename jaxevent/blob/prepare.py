"""Events packed for the tracker: chunks of steps of M events, of fixed shapes, on the host.

A chunk never reaches over a boundary of the life cycle (every `cycle` seconds from the start) nor
over the time at which a seed begins, so births, deaths and steps do not depend on how long chunks
and windows are. Times are int32 us since the chunk's start, hence exact however long the recording.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from jaxevent.kernels import compiled
from jaxevent.recording import Recording

STEPS = (4, 8, 16, 32, 64, 128, 256)  # per chunk
WINDOW_STEPS = 8192
READ_ROWS = 65536  # events read from a file at a time
LONGEST = 2**29  # us between boundaries; two of them fit into int32

Numeric = Array | np.ndarray


class Features(eqx.Module):
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
    frame: Float[Numeric, " 2"]  # width and height, px
    detect: bool = eqx.field(static=True)
    cells: tuple[int, int] = eqx.field(static=True)  # rows and columns of the grid of births


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Tracks given by the user, sorted by time: t (n,) us, xi (n, 2) and size (n,) in px.

    `given` is the place of each among those that the user gave.
    """

    t: NDArray[np.int64]
    xi: NDArray[np.float64]
    size: NDArray[np.float64]
    given: NDArray[np.int64]


class Mark(NamedTuple):
    """Where a window begins: the next event's row and the start of the chunk; no state."""

    row: int
    previous: int  # us, start of the chunk before
    start: int  # us
    seed: int  # the next one


@dataclasses.dataclass(frozen=True)
class Window:
    """Consecutive chunks, where they are in time (us) and of which rows their events are."""

    features: Features
    start: NDArray[np.int64]  # of each chunk
    row: NDArray[np.int64]  # (chunks, steps, M), -1 where not valid
    next: Mark | None


class Windows:
    """The chunks of a recording between two times (us), one window after another."""

    def __init__(
        self,
        recording: Recording,
        params: Any,
        seeds: Seeds,
        start: int,
        stop: int,
        *,
        detect: bool,
        steps: int | None = None,
        chunks: int | None = None,
    ):
        self.recording, self.seeds, self.start, self.stop = recording, seeds, start, stop
        # Without births and tentative tracks less is to be decided.
        self.period = max(1, round((1 if detect else 10) * 1e6 * float(params.cycle)))
        self.rows = recording.events.index(start), recording.events.index(stop)
        self.events = params.events_per_step
        self.detect, self.prefilter = detect, params.prefilter
        self.neighbours = params.prefilter_neighbours
        self.reach = round(1e6 * float(params.prefilter_time))
        cell = params.cell
        self.cells = -(-recording.height // cell), -(-recording.width // cell)
        if steps is None:
            events = (self.rows[1] - self.rows[0]) * self.period / max(stop - start, 1)
            mean = (events + events**0.5) / self.events  # steps between boundaries, and some
            steps = min(STEPS, key=lambda s: max(1, np.ceil(mean / s)) * (s + 4))
        self.steps = steps
        self.chunks = max(1, WINDOW_STEPS // steps) if chunks is None else chunks
        self.first = Mark(self.rows[0], start, start, 0)

    def prepare(self, mark: Mark) -> Window:
        """The window that begins there."""
        shape = self.chunks, self.steps, self.events
        real = np.dtype(jnp.result_type(float))
        t, row = np.zeros(shape, np.int32), np.full(shape, -1, np.int64)
        xi, polarity = np.zeros((*shape, 2), real), np.zeros(shape, real)
        start = np.zeros(self.chunks, np.int64)
        elapsed, stop = np.zeros((2, self.chunks), np.int32)
        cycle = np.zeros(self.chunks, bool)
        seed = np.full(len(self.seeds.t), -1, np.int32)
        state = np.array([0, 0, 0, mark.previous, mark.start, 0, mark.seed])
        at, done = mark.row, False
        while not done:
            upto = min(at + READ_ROWS, self.rows[1])
            events = self.recording.events[at:upto]
            done, used = _pack(
                events.t, events.x, events.y, events.p, self._kept(events, at), at,
                upto == self.rows[1], self.start, self.stop, self.period, self.seeds.t, state,
                t, xi, polarity, row, start, elapsed, stop, cycle, seed,
            )  # fmt: skip
            at += used
        chunks = state[0]
        start[chunks:] = np.iinfo(np.int64).max
        features = Features(
            t, xi, polarity, row >= 0, elapsed, stop, cycle, seed,
            self.seeds.xi.astype(real), self.seeds.size.astype(real),
            np.array([self.recording.width, self.recording.height], real),
            self.detect, self.cells,
        )  # fmt: skip
        ended = state[3] == state[4] == self.stop
        following = None if ended else Mark(at, int(state[3]), int(state[4]), int(state[6]))
        return Window(features, start, row, following)

    def whole(self) -> Features:
        """All chunks at once, for recordings that fit into memory."""
        windows, mark = [], self.first
        while mark is not None:
            windows.append(self.prepare(mark))
            mark = windows[-1].next
        used = sum(int((w.start < np.iinfo(np.int64).max).sum()) for w in windows)
        used = -(-used // 32) * 32  # so that few shapes occur
        fields = {}
        for name in ("t", "xi", "polarity", "valid", "elapsed", "stop", "cycle"):
            fields[name] = np.concatenate([getattr(w.features, name) for w in windows])[:used]
        at = np.stack([w.features.seed for w in windows])
        place = np.argmax(at >= 0, axis=0)
        seed = np.where(
            (at >= 0).any(0), at.max(0, initial=-1) + place.astype(np.int32) * self.chunks, -1
        )
        return dataclasses.replace(windows[0].features, seed=seed.astype(np.int32), **fields)

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
            kept = _supported(part.t, part.x, part.y, last, self.reach, self.neighbours)
        return kept


@compiled
def _supported(t, x, y, last, reach, neighbours):
    """Events of which `neighbours` of the 8 pixels around fired at most `reach` us before."""
    kept = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        count = 0
        for row in range(int(y[i]), int(y[i]) + 3):
            for column in range(int(x[i]), int(x[i]) + 3):
                centre = row == int(y[i]) + 1 and column == int(x[i]) + 1
                count += not centre and t[i] - last[row, column] <= reach
        kept[i] = count >= neighbours
        last[int(y[i]) + 1, int(x[i]) + 1] = t[i]
    return kept


@compiled
def _pack(
    t_in, x, y, p, kept, row_in, final, origin, finish, period, seed_t, state,
    t, xi, polarity, row, start, elapsed, stop, cycle, seed,
):  # fmt: skip
    """Fill chunks until they are full or events end: (full or ended, number of events used).

    `state` is (chunk, whether it is open, events in it, start of the one before, start, end, next
    seed). With `final`, the time `finish` closes what is open.
    """
    chunk, opened, fill, previous, begin, end, following = state
    chunks, steps, size = t.shape
    i, count = 0, len(t_in)
    while i < count + (1 if final else 0):
        if i < count and not kept[i]:
            i += 1
            continue
        now = t_in[i] if i < count else finish
        if not opened:
            if chunk == chunks:
                state[:] = (chunk, 0, 0, previous, begin, 0, following)
                return True, i
            start[chunk] = begin
            elapsed[chunk] = begin - previous
            while following < len(seed_t) and seed_t[following] <= begin:
                seed[following] = chunk
                following += 1
            end = origin + ((now - origin) // period + 1) * period
            end = min(end, begin + LONGEST)
            if following < len(seed_t):
                end = min(end, seed_t[following])
            opened, fill = 1, 0
        over = now >= end or (i == count)
        if over or fill == steps * size:
            close = min(end, finish) if over else now
            stop[chunk] = close - begin
            cycle[chunk] = over and ((close - origin) % period == 0 or close == finish)
            previous, begin, opened = begin, close, 0
            chunk += 1
            if i == count and close == finish:
                state[:] = (chunk, 0, 0, finish, finish, 0, following)
                return True, i
            continue
        step, place = fill // size, fill % size
        t[chunk, step, place:] = now - begin
        xi[chunk, step, place, 0] = x[i]
        xi[chunk, step, place, 1] = y[i]
        polarity[chunk, step, place] = 1 if p[i] else -1
        row[chunk, step, place] = row_in + i
        fill += 1
        i += 1
    state[:] = (chunk, opened, fill, previous, begin, end, following)
    return False, i
