"""The loop that all trackers' kernels share: over chunks, steps and targets, as `run` has it.

A target's numbers are a row of `cells` and a row of `whole`; the driver's own come first, in the
order of `CELLS` and `WHOLE`. What differs from filter to filter are the functions of `Functions`,
which `target` writes; so this module is compiled once.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.prepare import LONGEST
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

CELLS = (
    "slot.gate.0", "slot.hits.0", "p.0", "p.1", "long.0", "xi.0", "xi.1", "size.0", "frame.0",
    "frame.1",
)  # fmt: skip
GATE, HITS, P, _, LONG, XI, _, SIZE, FRAME, _ = range(10)
WHOLE = (
    "slot.last.0", "slot.heard.0", "slot.born.0", "slot.apart.0", "slot.id.0", "slot.confirmed.0",
    "limit.0", "time.0", "stop.0", "inside.0", "found.0", "verdict.confirmed.0", "verdict.ended.0",
    "verdict.death.0", "verdict.apart.0", "touched.0",
)  # fmt: skip
LAST, HEARD, BORN, APART, ID, CONFIRMED, LIMIT, TIME, STOP, INSIDE = range(10)
FOUND, NOW_CONFIRMED, ENDED, DEATH, NOW_APART, TOUCHED = range(10, 16)

# Rows of a step's `work`: the events', then four for each target that is alive.
X, Y, AGE, POLARITY, VALID, TARGETS = range(6)
HELD, NEAR, DENSITY, WEIGHT, ROWS = range(5)


class Functions(NamedTuple):
    """What is a filter's own."""

    start: Any
    solo: Any
    ahead: Any
    alone: Any
    share: Any
    update: Any
    limit: Any
    expected: Any
    verdict: Any


class Chunks(NamedTuple):
    """The arrays of `prepare.Features` that the loop reads."""

    t: NDArray[np.int32]
    xi: NDArray
    polarity: NDArray
    valid: NDArray[np.bool_]
    owner: NDArray[np.int32]  # of two each, or empty
    elapsed: NDArray[np.int32]
    stop: NDArray[np.int32]
    cycle: NDArray[np.bool_]
    seed: NDArray[np.int32]
    seed_xi: NDArray
    seed_size: NDArray


class Settings(NamedTuple):
    """Numbers of the life cycle that are not of one target."""

    size: float  # px, of targets that are born
    births: bool
    tau: float  # s, in which the grid forgets
    cell: float  # px
    least: float  # events in 3x3 cells that begin a track
    apart: bool  # whether an event that one gate alone holds is that target's alone to weigh


class Memory(NamedTuple):
    """The targets and the grid of unassociated events."""

    cells: NDArray  # [targets, ...]
    whole: NDArray[np.int64]  # [targets, ...]
    sums: NDArray  # [3, rows, columns]
    at: NDArray[np.int64]  # the grid's time, and the next id


class Told(NamedTuple):
    """What a run tells of each chunk; whose events are only where there is room."""

    owner: NDArray[np.int32]  # [chunks, steps, events], serial numbers; -1: nobody's
    weight: NDArray  # how much of the event is the owner's
    before: NDArray[np.int32]
    after: NDArray[np.int32]
    confirmed: NDArray[np.bool_]
    ended: NDArray[np.int32]
    death: NDArray[np.int32]


class Updates(NamedTuple):
    """Rows: of each chunk all targets at its start, then each after each of its updates.

    `count` goes on beyond the rows that there is room for. Without any nothing is counted.
    """

    cells: NDArray  # [rows, ...]
    whole: NDArray[np.int64]  # [rows, ...]
    target: NDArray[np.int64]  # of each row
    before: NDArray[np.int64]  # the row before of the same target in the chunk; -1: none
    step: NDArray[np.int64]  # steps of the chunk done by then
    begin: NDArray[np.int64]  # the first row of each chunk, and their number
    latest: NDArray[np.int64]  # the last row of each target
    count: NDArray[np.int64]  # [1]


class Space(NamedTuple):
    """Where a step is worked on; nothing in it is kept."""

    work: NDArray  # [rows, events], see above
    marks: NDArray[np.int64]  # whose the events are
    targets: NDArray[np.int64]  # those that are alive
    around: NDArray  # [rows, columns] sums over 3x3 cells of the grid,
    above: NDArray  # [columns + 2] and over the three cells of a column


@njit_noalloc
def run(functions, numbers, settings, chunks, memory, told, space, updates):
    """Track through chunks; the memory is that at their end."""
    cells, whole = memory.cells, memory.whole
    given = (
        cells.ctypes, whole.ctypes, space.work.ctypes, space.marks.ctypes, numbers.ctypes,
    )  # fmt: skip
    for chunk in range(len(chunks.t)):
        _begin_chunk(functions, given, settings, chunks, memory, chunk)
        updates.begin[chunk] = updates.count[0]
        for k in range(len(cells)):
            functions.limit(*given, k, 0, 0, 1)
            updates.latest[k] = -1
            if len(updates.target):
                _note(updates, cells, whole, k, -1)
        _run_steps(functions, given, settings, chunks, memory, chunk, told, space, updates)
        for k in range(len(cells)):
            told.before[chunk, k] = told.after[chunk, k] = whole[k, ID]
            told.confirmed[chunk, k] = whole[k, CONFIRMED] != 0
            told.ended[chunk, k] = told.death[chunk, k] = 0
        if chunks.cycle[chunk]:
            _end_cycle(functions, given, settings, chunks, memory, chunk, told, space)
    updates.begin[len(chunks.t)] = updates.count[0]


@njit_noalloc_inlined
def _begin_chunk(functions, given, settings, chunks, memory, chunk):
    """Count times from the chunk's start, and begin the tracks of its seeds."""
    cells, whole, elapsed = memory.cells, memory.whole, np.int64(chunks.elapsed[chunk])
    for k in range(len(cells)):
        for field in (LAST, HEARD, BORN, APART):
            whole[k, field] = max(whole[k, field] - elapsed, -2 * LONGEST)
    memory.at[0] = max(memory.at[0] - elapsed, -2 * LONGEST)
    for k in range(len(chunks.seed)):
        if chunks.seed[k] == chunk:
            size = chunks.seed_size[k]
            size = size if size > 0 else cells.dtype.type(settings.size)
            x, y = chunks.seed_xi[k, 0], chunks.seed_xi[k, 1]
            _begin_track(functions, given, cells, whole, k, x, y, size, 0, k, 1)


@njit_noalloc_inlined
def _begin_track(functions, given, cells, whole, k, x, y, size, time, serial, confirmed):
    """A track begins at rest."""
    cells[k, XI], cells[k, XI + 1], cells[k, SIZE] = x, y, size
    functions.start(*given, k, 0, 0, 1)
    cells[k, HITS] = 0
    whole[k, LAST] = whole[k, HEARD] = whole[k, BORN] = whole[k, APART] = time
    whole[k, ID], whole[k, CONFIRMED] = serial, confirmed


@njit_noalloc_inlined
def _run_steps(functions, given, settings, chunks, memory, chunk, told, space, updates):
    """The steps of a chunk; the grid counts the events that are near no target."""
    cells, whole, sums = memory.cells, memory.whole, memory.sums
    work, marks, targets = space.work, space.marks, space.targets
    t, xi, polarity = chunks.t[chunk], chunks.xi[chunk], chunks.polarity[chunk]
    valid = chunks.valid[chunk]
    steps, room = t.shape
    owned, micro = len(chunks.owner) > 0, work.dtype.type(1e-6)
    asked, noted = len(told.owner) > 0, len(updates.target) > 0
    stop, faded, none = np.int64(chunks.stop[chunk]), valid[0, 0] & False, np.int64(0)
    for step in range(steps):
        if not valid[step, 0]:
            break  # the rest fills up
        time = np.int64(t[step, room - 1])
        for i in range(room):
            work[X, i] = xi[step, i, 0]
            work[Y, i] = xi[step, i, 1]
            work[AGE, i] = work.dtype.type(time - t[step, i]) * micro
            work[POLARITY, i] = polarity[step, i]
            work[VALID, i] = valid[step, i]
        if owned:
            for i in range(room):
                marks[i] = chunks.owner[chunk, step, i, 0]
                marks[room + i] = chunks.owner[chunk, step, i, 1]
        alive = none
        for k in range(len(cells)):
            if time - whole[k, HEARD] <= whole[k, LIMIT]:
                targets[alive] = k
                whole[k, TIME] = time
                alive += 1
        if alive == 1 and not asked:
            wanted, k = room if room > 1 or settings.births else 0, targets[0]
            whole[k, TOUCHED] = 0
            functions.solo(*given, k, TARGETS, room, wanted)
            if noted and whole[k, TOUCHED] != 0:
                _note(updates, cells, whole, k, step)
        elif alive > 0:
            for a in range(alive):
                functions.ahead(*given, targets[a], TARGETS + ROWS * a, room, room)
            _share_out(functions, given, settings, alive, room, work)
            for a in range(alive):
                k, row = targets[a], TARGETS + ROWS * a
                some = False
                for i in range(room):
                    some |= work[row + WEIGHT, i] > 0
                if some:
                    functions.update(*given, k, row, room, room)
                if some and noted:
                    _note(updates, cells, whole, k, step)
        if asked:
            _tell_owners(work, whole, targets, alive, told.owner[chunk, step],
                told.weight[chunk, step])  # fmt: skip
        if settings.births:
            faded = _count_strays(settings, sums, memory.at, t[step], stop, alive, work, faded)


@njit_noalloc_inlined
def _note(updates, cells, whole, k, step):
    """Note a target after its update in a step."""
    row = updates.count[0]
    updates.count[0] = row + 1
    if row >= len(updates.target):
        return
    for field in range(cells.shape[1]):
        updates.cells[row, field] = cells[k, field]
    for field in range(whole.shape[1]):
        updates.whole[row, field] = whole[k, field]
    updates.target[row], updates.before[row] = k, updates.latest[k]
    updates.step[row] = step + 1
    updates.latest[k] = row


@njit_noalloc_inlined
def _tell_owners(work, whole, targets, alive, owner, weight):
    """Whose the events of a step are, and how much of them."""
    for i in range(len(owner)):
        owner[i], weight[i] = -1, 0
        for a in range(alive):
            share = work[TARGETS + ROWS * a + WEIGHT, i]
            if share > weight[i]:
                owner[i], weight[i] = whole[targets[a], ID], share


@njit_noalloc_inlined
def _share_out(functions, given, settings, alive, room, work):
    """The weight of each event for each target."""
    apart = settings.apart
    if apart:
        for i in range(room):
            held = 0.0
            for a in range(alive):
                held += work[TARGETS + ROWS * a + HELD, i]
            if held > 1:
                apart = False
                break
    if apart:
        for a in range(alive):
            functions.alone(*given, 0, TARGETS + ROWS * a, room, room)
    else:
        for i in range(room):
            functions.share(*given, 0, i, room, alive)


@njit_noalloc_inlined
def _count_strays(settings, sums, at, t, stop, alive, work, faded):
    """Add a step's unassociated events to the grid, as `lifecycle.count_strays` does."""
    rows, columns = sums.shape[1:]
    micro, tau = sums.dtype.type(1e-6), sums.dtype.type(settings.tau)
    cell = sums.dtype.type(settings.cell)
    for i in range(work.shape[1]):
        near = 1 - work[VALID, i]
        for a in range(alive):
            near += work[TARGETS + ROWS * a + NEAR, i]
        if near > 0:
            continue
        if not faded:
            _fade(sums, np.exp(-(sums.dtype.type(stop - at[0]) * micro) / tau))
            at[0], faded = stop, True
        weight = np.exp(-(sums.dtype.type(stop - t[i]) * micro) / tau)
        x, y = work[X, i], work[Y, i]
        column = min(max(np.int64(x / cell), 0), columns - 1)
        row = min(max(np.int64(y / cell), 0), rows - 1)
        sums[0, row, column] += weight
        sums[1, row, column] += weight * x
        sums[2, row, column] += weight * y
    return faded


@njit_noalloc_inlined
def _fade(sums, factor):
    """Multiply the grid."""
    for kind in range(sums.shape[0]):
        for row in range(sums.shape[1]):
            for column in range(sums.shape[2]):
                sums[kind, row, column] *= factor


@njit_noalloc_inlined
def _end_cycle(functions, given, settings, chunks, memory, chunk, told, space):
    """Confirmations, deaths, mergers and births at a chunk's end; see `lifecycle.end_cycle`."""
    cells, whole, seeds = memory.cells, memory.whole, len(chunks.seed)
    stop, number = np.int64(chunks.stop[chunk]), len(cells)
    for k in range(number):
        whole[k, STOP] = stop
        functions.expected(*given, k, 0, 0, 1)
    for k in range(number):
        inside = False
        for j in range(number):
            if whole[j, ID] >= 0 and whole[j, ID] < whole[k, ID]:
                x, y = cells[k, P] - cells[j, P], cells[k, P + 1] - cells[j, P + 1]
                inside |= not x * x + y * y > cells[j, LONG] * cells[j, LONG]
        whole[k, INSIDE], whole[k, FOUND] = inside, k >= seeds
        functions.verdict(*given, k, 0, 0, 1)
    for k in range(number):
        ended = whole[k, ENDED] > 0
        told.confirmed[chunk, k] = whole[k, NOW_CONFIRMED] != 0
        told.ended[chunk, k], told.death[chunk, k] = whole[k, ENDED], whole[k, DEATH]
        whole[k, APART] = whole[k, NOW_APART]
        whole[k, CONFIRMED] = 0 if ended else whole[k, NOW_CONFIRMED]
        if ended:
            whole[k, ID] = -1
            gate = cells[k, GATE]
            cells[k, XI] = cells[k, XI + 1] = 0
            cells[k, SIZE] = settings.size
            functions.start(*given, k, 0, 0, 1)
            cells[k, GATE] = gate
    if settings.births:
        _bear(functions, given, settings, memory, stop, seeds, space)
    for k in range(number):
        told.after[chunk, k] = whole[k, ID]


@njit_noalloc_inlined
def _bear(functions, given, settings, memory, stop, seeds, space):
    """Tracks are born where the grid's 3x3 sums are largest, which empties 5x5 cells."""
    cells, whole, sums, at = memory.cells, memory.whole, memory.sums, memory.at
    elapsed = sums.dtype.type(stop - at[0]) * sums.dtype.type(1e-6)
    _fade(sums, np.exp(-elapsed / sums.dtype.type(settings.tau)))
    at[0] = stop
    rows, columns = sums.shape[1:]
    around, above, free = space.around, space.above, seeds
    while True:
        while free < len(cells) and whole[free, ID] >= 0:
            free += 1
        if free == len(cells):
            return
        _sum_around(sums[0], above, around)
        top, row, column = sums.dtype.type(0), 0, 0
        for r in range(rows):
            for c in range(columns):
                if around[r, c] > top:
                    top, row, column = around[r, c], r, c
        if not top > settings.least:
            return
        n = _sum_near(sums[0], row, column)
        x, y = _sum_near(sums[1], row, column) / n, _sum_near(sums[2], row, column) / n
        size = cells.dtype.type(settings.size)
        _begin_track(functions, given, cells, whole, free, x, y, size, stop, at[1], 0)
        at[1] += 1
        for r in range(max(row - 2, 0), min(row + 3, rows)):
            for c in range(max(column - 2, 0), min(column + 3, columns)):
                sums[0, r, c] = sums[1, r, c] = sums[2, r, c] = 0


@njit_noalloc_inlined
def _sum_near(counts, row, column):
    """The sum over the 3x3 cells around one."""
    rows, columns = counts.shape
    total = counts.dtype.type(0)
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(column - 1, 0), min(column + 2, columns)):
            total += counts[r, c]
    return total


@njit_noalloc_inlined
def _sum_around(counts, above, around):
    """Sums over 3x3 cells."""
    rows, columns = counts.shape
    above[0] = above[columns + 1] = 0
    for r in range(rows):
        for c in range(columns):
            total = counts[r, c]
            if r > 0:
                total = counts[r - 1, c] + total
            if r + 1 < rows:
                total += counts[r + 1, c]
            above[c + 1] = total
        for c in range(columns):
            around[r, c] = above[c] + above[c + 1] + above[c + 2]
