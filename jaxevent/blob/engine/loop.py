"""Loop over chunks, steps and tracks that the kernels of all filters share, as `run` has it.

The numbers of a track are a row of `reals` and a row of `integers`; the loop's own come first, in
the order of `REAL_NAMES` and `INTEGER_NAMES`. What differs between filters are the functions of
`TrackFunctions`, which `program` writes; so this module is compiled once.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.prepare import MAX_CHUNK_US
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

REAL_NAMES = (
    "track.gate.0", "track.hits.0", "p.0", "p.1", "long.0", "xi.0", "xi.1", "size.0", "frame.0",
    "frame.1",
)  # fmt: skip
GATE, HITS, P, _, LONG, XI, _, SIZE, FRAME, _ = range(10)
INTEGER_NAMES = (
    "track.last_update.0", "track.last_hit.0", "track.birth.0", "track.last_apart.0", "track.id.0",
    "track.confirmed.0", "limit.0", "events.time.0", "stop.0", "evidence.merging.0",
    "evidence.detected.0", "decision.confirmed.0", "decision.end_reason.0", "decision.death.0",
    "decision.last_apart.0", "touched.0",
)  # fmt: skip
LAST_UPDATE, LAST_HIT, BIRTH, LAST_APART, ID, CONFIRMED, LIMIT, TIME, STOP, MERGING = range(10)
DETECTED, NOW_CONFIRMED, END_REASON, DEATH, NOW_LAST_APART, TOUCHED = range(10, 16)

# Rows of a step's `work`: the events', then those of each track that is alive.
X, Y, AGE, POLARITY, VALID, TRACKS = range(6)
INSIDE, NEAR, LOG_LIKELIHOOD, WEIGHT, LOG_LIKELIHOOD_TANGENT, WEIGHT_TANGENT = range(6)
ROWS_PER_TRACK = 6

GRID_TIME, NEXT_ID = 0, 1  # in `KernelState.counters`
LOSS, COUNT, LOSS_TANGENT, LOSS_BY_OUTLIERS = range(4)  # in `LossSums.totals`
LOG_2_PI = math.log(2 * math.pi)


class TrackFunctions(NamedTuple):
    """Compiled functions of a filter, of one track each.

    Attributes:
        init: Begin a track; a size of 0 stands for the parameter `lambda0`.
        step: Predict and update the only track that is alive, with all events of a step.
        predict: Predict a track to the step's time, with its gate and likelihoods.
        weights_alone: Weigh the events of a track where no event is in two gates.
        weights: Weigh one event for all tracks.
        update: Update a track with weighted events.
        limit: Compute the longest time without events.
        measurement: Predict the distribution of the next events.
        decide: Confirm, delete or keep a track.
    """

    init: Any
    step: Any
    predict: Any
    weights_alone: Any
    weights: Any
    update: Any
    limit: Any
    measurement: Any
    decide: Any


class LifecycleConfig(NamedTuple):
    """Parameters of the life cycle that are not of one track.

    Attributes:
        births: Whether tracks begin of clutter.
        tau: Time in which the grid forgets, s.
        cell: Side of a cell of the grid, px.
        min_events: Number of events in 3x3 cells from which a track begins.
        alone: Whether an event in one gate alone is weighted by that track alone.
    """

    births: bool
    tau: float
    cell: float
    min_events: float
    alone: bool


class TrackKernel(NamedTuple):
    """Functions of a filter with the numbers of its parameters.

    Attributes:
        functions: The compiled functions.
        numbers: Parameters, and numbers that follow from them alone.
        config: Parameters of the life cycle.
    """

    functions: TrackFunctions
    numbers: NDArray[np.float64]
    config: LifecycleConfig


class ChunkArrays(NamedTuple):
    """Arrays of `prepare.Features` that the loop reads.

    Attributes:
        t: [chunks, steps, M] times, us since the chunk's start.
        xi: [chunks, steps, M, 2] positions, px.
        polarity: [chunks, steps, M] +1 or -1.
        valid: [chunks, steps, M] whether an event is real rather than padding.
        owner: [chunks, steps, M, 2] serial numbers of tracks that may own the event, or empty.
        elapsed: [chunks] time from the start of the chunk before, us.
        stop: [chunks] time from the chunk's start to its end, us.
        cycle: [chunks] whether births and deaths happen at its end.
        seed: [seeds] chunk at whose start each seed begins; -1: none of these.
        seed_xi: [seeds, 2] positions of the seeds, px.
        seed_size: [seeds] sizes of the seeds, px.
    """

    t: NDArray[np.int32]
    xi: NDArray
    polarity: NDArray
    valid: NDArray[np.bool_]
    owner: NDArray[np.int32]
    elapsed: NDArray[np.int32]
    stop: NDArray[np.int32]
    cycle: NDArray[np.bool_]
    seed: NDArray[np.int32]
    seed_xi: NDArray
    seed_size: NDArray


class KernelState(NamedTuple):
    """The tracks and the grid of unassociated events.

    Attributes:
        reals: [targets, ...] real numbers of the tracks, by `program.Layout`.
        integers: [targets, ...] integers of the tracks, by `program.Layout`.
        sums: [3, rows, columns] sums of the grid, see `lifecycle.ClutterGrid`.
        counters: Time of the grid, us since the chunk's start, and the next serial number.
    """

    reals: NDArray
    integers: NDArray[np.int64]
    sums: NDArray
    counters: NDArray[np.int64]


class KernelOutput(NamedTuple):
    """Report of each chunk; the association only where its arrays have room.

    Attributes:
        target: [chunks, steps, events] serial numbers; -1: none.
        weight: [chunks, steps, events] weights of the events for their targets.
        id_before: [chunks, targets], as of `lifecycle.LifecycleLog`.
        id_after: [chunks, targets], likewise.
        confirmed: [chunks, targets], likewise.
        end_reason: [chunks, targets], likewise.
        death: [chunks, targets], likewise.
    """

    target: NDArray[np.int32]
    weight: NDArray
    id_before: NDArray[np.int32]
    id_after: NDArray[np.int32]
    confirmed: NDArray[np.bool_]
    end_reason: NDArray[np.int32]
    death: NDArray[np.int32]


class UpdateRecord(NamedTuple):
    """Rows: of each chunk all tracks at its start, then each after each of its updates.

    `count` goes on beyond the capacity. Without rows nothing is counted.

    Attributes:
        reals: [rows, ...] real numbers of the track.
        integers: [rows, ...] integers of the track.
        target: [rows] entry of the track in the buffer.
        previous: [rows] row before of the same track in the chunk; -1: none.
        step: [rows] steps of the chunk done by then.
        begin: [chunks + 1] first row of each chunk, and the number of rows.
        latest: [targets] last row of each track.
        count: [1] number of rows.
    """

    reals: NDArray
    integers: NDArray[np.int64]
    target: NDArray[np.int64]
    previous: NDArray[np.int64]
    step: NDArray[np.int64]
    begin: NDArray[np.int64]
    latest: NDArray[np.int64]
    count: NDArray[np.int64]


class LossSums(NamedTuple):
    """Sums over events for `jaxevent.blob.losses`; see `track._loss`.

    Attributes:
        totals: [4] loss, number of events that count, tangent of the loss through the tracks, and
            its derivative by `outliers`; [0] if no loss is wanted.
        every: Whether every event counts, not only those inside a gate.
        outliers: Share of events that belong to no target.
    """

    totals: NDArray[np.float64]
    every: bool
    outliers: float


class Snapshots(NamedTuple):
    """All tracks at requested moments.

    Attributes:
        moment: [moments] sorted numbers chunk * (steps + 1) + steps of the chunk done by then.
        reals: [moments, targets, ...] real numbers of the tracks, output.
        integers: [moments, targets, ...] their integers, output.
        count: [1] number of moments that have been reached.
    """

    moment: NDArray[np.int64]
    reals: NDArray
    integers: NDArray[np.int64]
    count: NDArray[np.int64]


class LoopOutput(NamedTuple):
    """Arrays that the loop fills; those without room are not wanted.

    Attributes:
        report: Births, deaths and associations.
        updates: Records of tracks.
        losses: Sums over events.
        snapshots: Tracks at requested moments.
    """

    report: KernelOutput
    updates: UpdateRecord
    losses: LossSums
    snapshots: Snapshots


class Scratch(NamedTuple):
    """Scratch memory of a step."""

    work: NDArray  # [rows, events], see above
    owners: NDArray[np.int64]  # possible tracks of the events
    alive: NDArray[np.int64]  # indices of the tracks that are alive
    sums3x3: NDArray  # [rows, columns]
    sums3x1: NDArray  # [columns + 2]


class _Context(NamedTuple):
    """Everything that the parts of the loop share."""

    functions: TrackFunctions
    pointers: Any  # the first arguments of these
    config: LifecycleConfig
    chunks: ChunkArrays
    state: KernelState
    scratch: Scratch
    out: KernelOutput
    updates: UpdateRecord
    losses: LossSums
    snapshots: Snapshots


class _NewTrack(NamedTuple):
    """A track that begins at rest.

    Attributes:
        x: Column, px.
        y: Row, px.
        size: Size, px; 0: `lambda0`.
        time: Time of birth, us since the chunk's start.
        id: Serial number.
        confirmed: Whether it is confirmed at once.
    """

    x: Any
    y: Any
    size: Any
    time: Any
    id: Any
    confirmed: Any


@njit_noalloc
def run(kernel, chunks, state, scratch, out):
    """Track through chunks.

    Args:
        kernel: `TrackKernel`.
        chunks: `ChunkArrays`.
        state: `KernelState` at the first chunk's start; it becomes that at the last one's end.
        scratch: `Scratch`.
        out: `LoopOutput`, output.
    """
    reals, integers, report, updates = state.reals, state.integers, out.report, out.updates
    pointers = (
        reals.ctypes, integers.ctypes, scratch.work.ctypes, scratch.owners.ctypes,
        kernel.numbers.ctypes,
    )  # fmt: skip
    context = _Context(
        kernel.functions, pointers, kernel.config, chunks, state, scratch, report, updates,
        out.losses, out.snapshots,
    )  # fmt: skip
    for chunk in range(len(chunks.t)):
        _begin_chunk(context, chunk)
        updates.begin[chunk] = updates.count[0]
        for k in range(len(reals)):
            context.functions.limit(*pointers, k, 0, 0, 1)
            updates.latest[k] = -1
            if len(updates.target):
                _record(updates, reals, integers, k, -1)
        _run_steps(context, chunk)
        for k in range(len(reals)):
            report.id_before[chunk, k] = report.id_after[chunk, k] = integers[k, ID]
            report.confirmed[chunk, k] = integers[k, CONFIRMED] != 0
            report.end_reason[chunk, k] = report.death[chunk, k] = 0
        if chunks.cycle[chunk]:
            _manage_tracks(context, chunk)
    updates.begin[len(chunks.t)] = updates.count[0]


@njit_noalloc_inlined
def _begin_chunk(context, chunk):
    """Count times from the chunk's start, and begin the tracks of its seeds.

    Args:
        context: `_Context`, whose state is changed.
        chunk: Index of the chunk.
    """
    chunks, state = context.chunks, context.state
    integers, elapsed = state.integers, np.int64(chunks.elapsed[chunk])
    for k in range(len(integers)):
        for field in (LAST_UPDATE, LAST_HIT, BIRTH, LAST_APART):
            integers[k, field] = max(integers[k, field] - elapsed, -2 * MAX_CHUNK_US)
    state.counters[GRID_TIME] = max(state.counters[GRID_TIME] - elapsed, -2 * MAX_CHUNK_US)
    for k in range(len(chunks.seed)):
        if chunks.seed[k] == chunk:
            x, y = chunks.seed_xi[k, 0], chunks.seed_xi[k, 1]
            new = _NewTrack(x, y, chunks.seed_size[k], np.int64(0), k, 1)
            _init_track(context, k, new)


@njit_noalloc_inlined
def _init_track(context, k, new):
    """Begin a track in an entry of the buffer.

    Args:
        context: `_Context`.
        k: The entry.
        new: `_NewTrack`.
    """
    reals, integers = context.state.reals, context.state.integers
    reals[k, XI], reals[k, XI + 1], reals[k, SIZE] = new.x, new.y, new.size
    context.functions.init(*context.pointers, k, 0, 0, 1)
    reals[k, HITS] = 0
    for field in (LAST_UPDATE, LAST_HIT, BIRTH, LAST_APART):
        integers[k, field] = new.time
    integers[k, ID], integers[k, CONFIRMED] = new.id, new.confirmed


@njit_noalloc_inlined
def _run_steps(context, chunk):
    """Run the steps of a chunk; the grid counts the events that are near no track.

    Args:
        context: `_Context`.
        chunk: Number of the chunk.
    """
    chunks, functions, scratch = context.chunks, context.functions, context.scratch
    reals, integers = context.state.reals, context.state.integers
    births, pointers = context.config.births, context.pointers
    work, owners, tracks = scratch.work, scratch.owners, scratch.alive
    t, xi, polarity = chunks.t[chunk], chunks.xi[chunk], chunks.polarity[chunk]
    valid = chunks.valid[chunk]
    steps, size = t.shape
    owned, micro = len(chunks.owner) > 0, work.dtype.type(1e-6)
    associate, recording = len(context.out.target) > 0, len(context.updates.target) > 0
    scoring, moment = len(context.losses.totals) > 0, chunk * (steps + 1)
    stop, faded, none = np.int64(chunks.stop[chunk]), valid[0, 0] & False, np.int64(0)
    for step in range(steps):
        if not valid[step, 0]:
            break  # the rest is padding
        _take_snapshots(context, moment + step)
        time = np.int64(t[step, size - 1])
        for i in range(size):
            work[X, i] = xi[step, i, 0]
            work[Y, i] = xi[step, i, 1]
            work[AGE, i] = work.dtype.type(time - t[step, i]) * micro
            work[POLARITY, i] = polarity[step, i]
            work[VALID, i] = valid[step, i]
        if owned:
            for i in range(size):
                owners[i] = chunks.owner[chunk, step, i, 0]
                owners[size + i] = chunks.owner[chunk, step, i, 1]
        alive = none
        for k in range(len(reals)):
            if time - integers[k, LAST_HIT] <= integers[k, LIMIT]:
                tracks[alive] = k
                integers[k, TIME] = time
                alive += 1
        if alive == 1 and not associate and not scoring:
            needs_near, k = size if size > 1 or births else 0, tracks[0]
            integers[k, TOUCHED] = 0
            functions.step(*pointers, k, TRACKS, size, needs_near)
            if recording and integers[k, TOUCHED] != 0:
                _record(context.updates, reals, integers, k, step)
        elif alive > 0:
            for a in range(alive):
                functions.predict(*pointers, tracks[a], TRACKS + ROWS_PER_TRACK * a, size, size)
            _associate(context, alive, size)
            for a in range(alive):
                k, row = tracks[a], TRACKS + ROWS_PER_TRACK * a
                some = False
                for i in range(size):
                    some |= work[row + WEIGHT, i] > 0
                if some:
                    functions.update(*pointers, k, row, size, size)
                if some and recording:
                    _record(context.updates, reals, integers, k, step)
        if scoring:
            _add_losses(context, alive, size)
        if associate:
            _report_association(context, chunk, step, alive)
        if births:
            faded = _accumulate_clutter(context, t[step], stop, alive, faded)
    _take_snapshots(context, moment + steps)


@njit_noalloc_inlined
def _take_snapshots(context, moment):
    """Copy all tracks for the requested moments up to one.

    Args:
        context: `_Context`.
        moment: Number of the moment, see `Snapshots`.
    """
    wanted, reals, integers = context.snapshots, context.state.reals, context.state.integers
    while wanted.count[0] < len(wanted.moment) and wanted.moment[wanted.count[0]] <= moment:
        row = wanted.count[0]
        for k in range(len(reals)):
            for field in range(reals.shape[1]):
                wanted.reals[row, k, field] = reals[k, field]
            for field in range(integers.shape[1]):
                wanted.integers[row, k, field] = integers[k, field]
        wanted.count[0] = row + 1


@njit_noalloc_inlined
def _add_losses(context, alive, size):
    """Add up the negative log likelihood of a step's events, as `track._loss` does.

    Args:
        context: `_Context`.
        alive: Number of tracks that are alive.
        size: Number of events of the step.
    """
    losses, work = context.losses, context.scratch.work
    totals, every, outliers = losses.totals, losses.every, losses.outliers
    width, height = context.state.reals[0, FRAME], context.state.reals[0, FRAME + 1]
    log_uniform = -np.log(np.float64(width) * np.float64(height))
    stray = outliers if alive > 0 else 1.0
    log_share = np.log1p(-outliers) - np.log(np.float64(max(alive, 1))) if every else 0.0
    for i in range(size):
        top, counted = log_uniform + LOG_2_PI if every else -np.inf, every and work[VALID, i] != 0
        for a in range(alive):
            row = TRACKS + ROWS_PER_TRACK * a
            if counted if every else work[row + INSIDE, i] != 0:
                top, counted = max(top, np.float64(work[row + LOG_LIKELIHOOD, i])), True
        if not counted:
            continue
        # exp(top - ln(2 pi)) times these are the densities.
        targets, tangent, uniform = 0.0, 0.0, 0.0
        for a in range(alive):
            row = TRACKS + ROWS_PER_TRACK * a
            if every or work[row + INSIDE, i] != 0:
                part = np.exp(np.float64(work[row + LOG_LIKELIHOOD, i]) - top + log_share)
                targets += part
                tangent += part * np.float64(work[row + LOG_LIKELIHOOD_TANGENT, i])
        if every:
            uniform = np.exp(log_uniform + LOG_2_PI - top)
        total = targets + stray * uniform
        totals[LOSS] -= top + np.log(total) - LOG_2_PI
        totals[COUNT] += 1
        totals[LOSS_TANGENT] -= tangent / total
        if every and alive > 0:
            totals[LOSS_BY_OUTLIERS] -= (uniform - targets / (1 - outliers)) / total


@njit_noalloc_inlined
def _record(updates, reals, integers, k, step):
    """Record a track after its update in a step.

    Args:
        updates: `UpdateRecord`.
        reals: (targets, ...) real numbers of all tracks.
        integers: (targets, ...) integers of all tracks.
        k: The track's entry in the buffer.
        step: The step of the chunk; -1 for the chunk's start.
    """
    row = updates.count[0]
    updates.count[0] = row + 1
    if row >= len(updates.target):
        return
    for field in range(reals.shape[1]):
        updates.reals[row, field] = reals[k, field]
    for field in range(integers.shape[1]):
        updates.integers[row, field] = integers[k, field]
    updates.target[row], updates.previous[row] = k, updates.latest[k]
    updates.step[row] = step + 1
    updates.latest[k] = row


@njit_noalloc_inlined
def _report_association(context, chunk, step, alive):
    """Report the likeliest track of each event of a step, and its weight.

    Args:
        context: `_Context`.
        chunk: Number of the chunk.
        step: Number of the step in it.
        alive: Number of tracks that are alive, the first in `scratch.alive`.
    """
    work, tracks = context.scratch.work, context.scratch.alive
    target, weight = context.out.target[chunk, step], context.out.weight[chunk, step]
    for i in range(len(target)):
        target[i], weight[i] = -1, 0
        for a in range(alive):
            value = work[TRACKS + ROWS_PER_TRACK * a + WEIGHT, i]
            if value > weight[i]:
                target[i], weight[i] = context.state.integers[tracks[a], ID], value


@njit_noalloc_inlined
def _associate(context, alive, size):
    """Compute the weight of each event of a step for each track.

    Args:
        context: `_Context`; weights go to the rows of the tracks in `scratch.work`.
        alive: Number of tracks that are alive.
        size: Number of events of the step.
    """
    functions, work = context.functions, context.scratch.work
    alone = context.config.alone
    if alone:
        for i in range(size):
            gates = 0.0
            for a in range(alive):
                gates += work[TRACKS + ROWS_PER_TRACK * a + INSIDE, i]
            if gates > 1:
                alone = False
                break
    if alone:
        for a in range(alive):
            row = TRACKS + ROWS_PER_TRACK * a
            functions.weights_alone(*context.pointers, 0, row, size, size)
    else:
        for i in range(size):
            functions.weights(*context.pointers, 0, i, size, alive)


@njit_noalloc_inlined
def _accumulate_clutter(context, t, stop, alive, faded):
    """Add a step's unassociated events to the grid, as `lifecycle.accumulate_clutter` does.

    Args:
        context: `_Context`.
        t: (events,) times, us since the chunk's start.
        stop: End of the chunk, us since its start; the grid's weights are those at that time.
        alive: Number of tracks that are alive.
        faded: Whether the grid has been brought to the time `stop` already.

    Returns:
        Whether it has been brought to that time now.
    """
    sums, counters, work = context.state.sums, context.state.counters, context.scratch.work
    rows, columns = sums.shape[1:]
    micro, tau = sums.dtype.type(1e-6), sums.dtype.type(context.config.tau)
    cell = sums.dtype.type(context.config.cell)
    for i in range(work.shape[1]):
        near = 1 - work[VALID, i]
        for a in range(alive):
            near += work[TRACKS + ROWS_PER_TRACK * a + NEAR, i]
        if near > 0:
            continue
        if not faded:
            _fade(sums, np.exp(-(sums.dtype.type(stop - counters[GRID_TIME]) * micro) / tau))
            counters[GRID_TIME], faded = stop, True
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
    """Multiply the grid by a factor.

    Args:
        sums: (3, rows, columns) number of events and sums of x and y, in place.
        factor: The factor, 0 to 1.
    """
    for kind in range(sums.shape[0]):
        for row in range(sums.shape[1]):
            for column in range(sums.shape[2]):
                sums[kind, row, column] *= factor


@njit_noalloc_inlined
def _manage_tracks(context, chunk):
    """Confirm, delete, merge and begin tracks at a chunk's end; see `lifecycle.manage_tracks`.

    Args:
        context: `_Context`, whose state and output are changed.
        chunk: Index of the chunk.
    """
    functions, pointers, out = context.functions, context.pointers, context.out
    reals, integers = context.state.reals, context.state.integers
    stop, number = np.int64(context.chunks.stop[chunk]), len(reals)
    for k in range(number):
        integers[k, STOP] = stop
        functions.measurement(*pointers, k, 0, 0, 1)
    for k in range(number):
        merging = False
        for j in range(number):
            if integers[j, ID] >= 0 and integers[j, ID] < integers[k, ID]:
                x, y = reals[k, P] - reals[j, P], reals[k, P + 1] - reals[j, P + 1]
                merging |= not x * x + y * y > reals[j, LONG] * reals[j, LONG]
        integers[k, MERGING] = merging
        integers[k, DETECTED] = k >= len(context.chunks.seed)
        functions.decide(*pointers, k, 0, 0, 1)
    for k in range(number):
        ended = integers[k, END_REASON] > 0
        out.confirmed[chunk, k] = integers[k, NOW_CONFIRMED] != 0
        out.end_reason[chunk, k] = integers[k, END_REASON]
        out.death[chunk, k] = integers[k, DEATH]
        integers[k, LAST_APART] = integers[k, NOW_LAST_APART]
        integers[k, CONFIRMED] = 0 if ended else integers[k, NOW_CONFIRMED]
        if ended:
            integers[k, ID] = -1
            gate = reals[k, GATE]
            reals[k, XI] = reals[k, XI + 1] = reals[k, SIZE] = 0
            functions.init(*pointers, k, 0, 0, 1)
            reals[k, GATE] = gate
    if context.config.births:
        _begin_tracks(context, stop)
    for k in range(number):
        out.id_after[chunk, k] = integers[k, ID]


@njit_noalloc_inlined
def _begin_tracks(context, stop):
    """Begin tracks where the grid's 3x3 sums are largest.

    The 5x5 cells around each are emptied.

    Args:
        context: `_Context`.
        stop: End of the chunk, us since its start, at which the tracks begin.
    """
    integers, sums, counters = context.state.integers, context.state.sums, context.state.counters
    config, real = context.config, sums.dtype.type
    elapsed = real(stop - counters[GRID_TIME]) * real(1e-6)
    _fade(sums, np.exp(-elapsed / real(config.tau)))
    counters[GRID_TIME] = stop
    rows, columns = sums.shape[1:]
    sums3x3, free = context.scratch.sums3x3, len(context.chunks.seed)
    while True:
        while free < len(integers) and integers[free, ID] >= 0:
            free += 1
        if free == len(integers):
            return
        _sum_3x3(sums[0], context.scratch.sums3x1, sums3x3)
        top, row, column = real(0), 0, 0
        for r in range(rows):
            for c in range(columns):
                if sums3x3[r, c] > top:
                    top, row, column = sums3x3[r, c], r, c
        if not top > config.min_events:
            return
        n = _sum_near(sums[0], row, column)
        x, y = _sum_near(sums[1], row, column) / n, _sum_near(sums[2], row, column) / n
        new = _NewTrack(x, y, real(0), stop, counters[NEXT_ID], 0)
        _init_track(context, free, new)
        counters[NEXT_ID] += 1
        for r in range(max(row - 2, 0), min(row + 3, rows)):
            for c in range(max(column - 2, 0), min(column + 3, columns)):
                sums[0, r, c] = sums[1, r, c] = sums[2, r, c] = 0


@njit_noalloc_inlined
def _sum_near(counts, row, column):
    """Sum over the 3x3 cells around one.

    Args:
        counts: (rows, columns).
        row: Row of the cell.
        column: Its column.

    Returns:
        The sum over those that exist.
    """
    rows, columns = counts.shape
    total = counts.dtype.type(0)
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(column - 1, 0), min(column + 2, columns)):
            total += counts[r, c]
    return total


@njit_noalloc_inlined
def _sum_3x3(counts, sums3x1, sums3x3):
    """Sum over the 3x3 cells around each cell.

    Args:
        counts: (rows, columns).
        sums3x1: (columns + 2,) scratch.
        sums3x3: (rows, columns) output.
    """
    rows, columns = counts.shape
    sums3x1[0] = sums3x1[columns + 1] = 0
    for r in range(rows):
        for c in range(columns):
            total = counts[r, c]
            if r > 0:
                total = counts[r - 1, c] + total
            if r + 1 < rows:
                total += counts[r + 1, c]
            sums3x1[c + 1] = total
        for c in range(columns):
            sums3x3[r, c] = sums3x1[c] + sums3x1[c + 1] + sums3x1[c + 2]
