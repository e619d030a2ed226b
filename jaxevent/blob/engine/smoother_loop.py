"""Readout of recorded updates: states at times, filtered or smoothed.

The backward pass is that of `jaxevent.blob.smoother`, over the updates of each track alone, and in
double precision. What differs between filters are the functions of `ReadoutFunctions`, which
`program` writes; they read and write numbers in a row of `work`, at the places below.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine.loop import ID, LAST_HIT, LAST_UPDATE, UpdateRecord
from jaxevent.blob.prepare import MAX_CHUNK_US
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

DT, SILENCE, X, P, F = 0, 1, 2, 10, 74  # s, s, (8,), (8, 8) and (8, 8)
MEAN, COVARIANCE, WORK_SIZE = 138, 146, 210
N_MATRICES = 6  # that the backward pass works with

# `smoother.BackwardInfo` of a track as one row: r (8,), N (8, 8) and the rest.
R, N, NEXT, KNOWN, INFO_ID, INFO_SIZE = 0, 8, 72, 73, 74, 75


class ReadoutFunctions(NamedTuple):
    """Compiled functions of a filter, of a track's row."""

    predict: Any  # X, P after DT without events, of SILENCE in all
    transition: Any  # F over DT
    canonical: Any  # MEAN and COVARIANCE of X, P


class ReadoutKernel(NamedTuple):
    """Functions of a filter with the numbers of its parameters.

    Attributes:
        functions: The compiled functions.
        numbers: Parameters, and numbers that follow from them alone.
        order: (8,) components of the state, those that depend on each other side by side.
        blocks: Index in `order` at which each block of dependent components begins, and 8.
        smallest: Number added to correlations that rounding makes singular.
    """

    functions: ReadoutFunctions
    numbers: NDArray[np.float64]
    order: NDArray[np.int64]
    blocks: NDArray[np.int64]
    smallest: float


class ReadoutScratch(NamedTuple):
    """Scratch memory of the readout."""

    matrices: NDArray[np.float64]  # [N_MATRICES, 8, 8]
    vectors: NDArray[np.float64]  # [2, 8]
    work: NDArray  # [WORK_SIZE]
    owners: NDArray[np.int64]  # not used here


class ReadoutQuery(NamedTuple):
    """Sorted times, and the tracks to be read out at them.

    Attributes:
        chunk: [times] chunk of each time.
        step: [times] steps of the chunk done by then.
        time: [times] time, us since the chunk's start.
        serial: [tracks] serial numbers.
        requested: [times, tracks] whether the state is requested.
    """

    chunk: NDArray[np.int64]
    step: NDArray[np.int64]
    time: NDArray[np.int64]
    serial: NDArray[np.int64]
    requested: NDArray[np.bool_]


class ReadoutArrays(NamedTuple):
    """States that were read out.

    Attributes:
        mean: [times, tracks, 8] px, s and rad.
        covariance: [times, tracks, 8, 8].
        idle: [times, tracks] time since the last event, s.
    """

    mean: NDArray
    covariance: NDArray
    idle: NDArray


class _Context(NamedTuple):
    """Everything that the parts of the readout share."""

    kernel: ReadoutKernel
    updates: UpdateRecord
    scratch: ReadoutScratch


@njit_noalloc
def backward_pass(kernel, updates, elapsed, info, rows, scratch):
    """Run the backward pass over recorded chunks.

    Args:
        kernel: Functions of the filter.
        updates: Updates of the chunks.
        elapsed: Time from each chunk's start to the next one's, us.
        info: Backward information of each track at the start of the chunk after the last one; it
            becomes that at the first chunk's start.
        rows: Output: backward information of each recorded row.
        scratch: Scratch memory.
    """
    context = _Context(kernel, updates, scratch)
    for back in range(len(elapsed)):
        chunk = len(elapsed) - 1 - back
        begin, end = updates.begin[chunk], updates.begin[chunk + 1]
        _propagate_to_chunk_end(updates.integers[begin : begin + len(info)], info, elapsed[chunk])
        _smooth_chunk(context, begin, end, info, rows)


@njit_noalloc
def readout(kernel, updates, rows, query, scratch, out):
    """Read out tracks at times, smoothed where the backward pass was run.

    Args:
        kernel: `ReadoutKernel`.
        updates: `UpdateRecord` of the chunks.
        rows: (rows, INFO_SIZE) backward information of each recorded row; empty for filtered
            states.
        query: `ReadoutQuery`.
        scratch: `ReadoutScratch`.
        out: `ReadoutArrays`, output where the query requests a state.
    """
    context = _Context(kernel, updates, scratch)
    for track in range(len(query.serial)):
        _readout_track(context, rows, query, track, out)


@njit_noalloc_inlined
def _propagate_to_chunk_end(integers, info, elapsed):
    """Propagate backward information from the start of the next chunk, in place.

    Args:
        integers: (targets, ...) integers of the tracks at the chunk's start. A track that is not
            the same in the next chunk has no information.
        info: (targets, INFO_SIZE) backward information.
        elapsed: Time between the starts of both chunks, us.
    """
    for k in range(len(info)):
        id = integers[k, ID]
        if info[k, KNOWN] != 0 and info[k, INFO_ID] == id and id >= 0:
            info[k, NEXT] = min(np.int64(info[k, NEXT]) + elapsed, 2 * MAX_CHUNK_US)
        else:
            for field in range(INFO_SIZE):
                info[k, field] = 0
        info[k, INFO_ID] = id


@njit_noalloc_inlined
def _pointers(context, dt, silence):
    """Return the first arguments of a function of a row.

    Args:
        context: `_Context`.
        dt: Time over which to predict, us; written to the scratch memory in s.
        silence: Time without events in all, us, likewise.

    Returns:
        Pointers to reals, integers, scratch memory, owners and numbers.
    """
    work, updates = context.scratch.work, context.updates
    micro = work.dtype.type(1e-6)
    work[DT], work[SILENCE] = work.dtype.type(dt) * micro, work.dtype.type(silence) * micro
    return (
        updates.reals.ctypes, updates.integers.ctypes, work.ctypes, context.scratch.owners.ctypes,
        context.kernel.numbers.ctypes,
    )  # fmt: skip


@njit_noalloc_inlined
def _predict(context, row, dt, silence):
    """Predict X and P of a row's track into the scratch memory.

    Args:
        context: `_Context`.
        row: Recorded row of the track.
        dt: Time over which to predict, us.
        silence: Time without events in all, us.
    """
    context.kernel.functions.predict(*_pointers(context, dt, silence), row, 0, 0, 1)


@njit_noalloc_inlined
def _smooth_chunk(context, begin, end, info, rows):
    """Smooth the updates in rows [begin, end), from the last to the first.

    With g = F^T r' and G = F^T N' F of the next update, r = (P-)^-1 (x - x- + P g) and N = (P-)^-1
    (P + P G P - P-) (P-)^-1.

    Args:
        context: `_Context`.
        begin: First row of the chunk.
        end: Row after the last one.
        info: (targets, INFO_SIZE) backward information after the chunk; it becomes that at its
            start.
        rows: (rows, INFO_SIZE) output, backward information after each row's update.
    """
    kernel, updates = context.kernel, context.updates
    work, matrices = context.scratch.work, context.scratch.matrices
    e, now, before = context.scratch.vectors[0], matrices[1], matrices[2]
    for back in range(end - begin):
        row = end - 1 - back
        k, previous = updates.target[row], updates.previous[row]
        for field in range(INFO_SIZE):
            rows[row, field] = info[k, field]
        if previous < 0:
            continue
        time, since = updates.integers[row, LAST_UPDATE], updates.integers[previous, LAST_UPDATE]
        none = time - time
        _transport(context, info[k], row, time)
        _predict(context, row, none, none)
        for i in range(8):
            e[i] = work[X + i]
            for j in range(8):
                now[i, j] = work[P + 8 * i + j]
        _predict(context, previous, time - since, time - since)
        for i in range(8):
            e[i] -= work[X + i]
            for j in range(8):
                before[i, j] = work[P + 8 * i + j]
        e[6] -= 2 * np.pi * np.rint(e[6] / (2 * np.pi))
        for block in range(len(kernel.blocks) - 1):
            members = kernel.order[kernel.blocks[block] : kernel.blocks[block + 1]]
            _smooth_update(members, kernel.smallest, info[k], context.scratch)
        info[k, NEXT], info[k, KNOWN] = time, 1


@njit_noalloc_inlined
def _transport(context, info, row, time):
    """Transport backward information from a track's next update to an earlier time.

    It is g = F^T r and G = F^T N F, with F the transition between both; g goes to vectors[1], G to
    matrices[0] of the scratch memory.

    Args:
        context: `_Context`.
        info: (INFO_SIZE,) backward information of the track.
        row: Recorded row of the track before the time.
        time: Time, us since the chunk's start.
    """
    kernel, scratch = context.kernel, context.scratch
    work, g, G, product = scratch.work, scratch.vectors[1], scratch.matrices[0], scratch.matrices[3]
    next = np.int64(info[NEXT])
    until = next if info[KNOWN] != 0 else time
    silence = until - context.updates.integers[row, LAST_UPDATE]
    kernel.functions.transition(*_pointers(context, max(next - time, 0), silence), row, 0, 0, 1)
    for block in range(len(kernel.blocks) - 1):
        members = kernel.order[kernel.blocks[block] : kernel.blocks[block + 1]]
        for i in members:
            g[i] = 0
            for a in members:
                g[i] += work[F + 8 * a + i] * info[R + a]
            for j in members:
                product[i, j] = 0
                for a in members:
                    product[i, j] += info[N + 8 * i + a] * work[F + 8 * a + j]
        for i in members:
            for j in members:
                G[i, j] = 0
                for a in members:
                    G[i, j] += work[F + 8 * a + i] * product[a, j]


@njit_noalloc_inlined
def _smooth_update(members, smallest, info, scratch):
    """Compute r and N before an update, of components that depend on each other.

    Args:
        members: Indices of these components.
        smallest: Number that is added to correlations, for what rounding makes singular.
        info: (INFO_SIZE,) backward information of the track, output.
        scratch: `ReadoutScratch` with G, P and P- in matrices 0 to 2, x - x- and g in the vectors.
    """
    matrices, e, g = scratch.matrices, scratch.vectors[0], scratch.vectors[1]
    G, now, before, product, inverse, other = (
        matrices[0], matrices[1], matrices[2], matrices[3], matrices[4], matrices[5],
    )  # fmt: skip
    _invert(members, smallest, before, inverse, product)
    for i in members:
        for a in members:
            e[i] += now[i, a] * g[a]
    _multiply(members, now, G, product)
    _multiply(members, product, now, other)
    for i in members:
        info[R + i] = 0
        for j in members:
            info[R + i] += inverse[i, j] * e[j]
            other[i, j] += now[i, j] - before[i, j]
    _multiply(members, inverse, other, product)
    _multiply(members, product, inverse, other)
    for i in members:
        for j in members:
            info[N + 8 * i + j] = other[i, j]


@njit_noalloc_inlined
def _multiply(members, a, b, out):
    """Multiply two matrices, of components that depend on each other.

    Args:
        members: Indices of these components; others are left alone.
        a: (8, 8).
        b: (8, 8).
        out: (8, 8) output, another array.
    """
    for i in members:
        for j in members:
            total = 0.0
            for k in members:
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit_noalloc_inlined
def _invert(members, smallest, P, out, work):
    """Invert a covariance by sweeps, scaled to correlations; 0 for exactly known components.

    Args:
        members: Indices of the components that depend on each other; others are left alone.
        smallest: Number that is added to correlations, for what rounding makes singular.
        P: (8, 8) covariance.
        out: (8, 8) output.
        work: (8, 8) scratch.
    """
    for i in members:
        for j in members:
            scale = P[i, i] * P[j, j]
            out[i, j] = P[i, j] / np.sqrt(scale) if P[i, i] > 0 and P[j, j] > 0 else 0.0
        out[i, i] += smallest if P[i, i] > 0 else 1.0
    for k in members:
        pivot = out[k, k]
        for i in members:
            for j in members:
                work[i, j] = out[i, j] - out[i, k] * out[k, j] / pivot
        for i in members:
            work[i, k] = out[i, k] / pivot
            work[k, i] = out[k, i] / pivot
        work[k, k] = -1 / pivot
        for i in members:
            for j in members:
                out[i, j] = work[i, j]
    for i in members:
        for j in members:
            scale = P[i, i] * P[j, j]
            known = not (P[i, i] > 0 and P[j, j] > 0)
            out[i, j] = 0.0 if known else -out[i, j] / np.sqrt(scale)


@njit_noalloc_inlined
def _readout_track(context, rows, query, track, out):
    """Read out a track at all times at which it is requested.

    Args:
        context: `_Context`.
        rows: (rows, INFO_SIZE) backward information; empty for filtered states.
        query: `ReadoutQuery`.
        track: The track's column in the query.
        out: `ReadoutArrays`, output.
    """
    updates, work, smooth = context.updates, context.scratch.work, len(rows) > 0
    targets, micro = len(updates.latest), work.dtype.type(1e-6)
    chunk = target = row = following = np.int64(-1)
    for at in range(len(query.chunk)):
        if not query.requested[at, track]:
            continue
        if query.chunk[at] != chunk:
            chunk = query.chunk[at]
            row, following = updates.begin[chunk], updates.begin[chunk] + targets
            while row + 1 < following and updates.integers[row, ID] != query.serial[track]:
                row += 1
            target = updates.target[row]
        while following < updates.begin[chunk + 1] and updates.step[following] <= query.step[at]:
            row = following if updates.target[following] == target else row
            following += 1
        time, last = query.time[at], updates.integers[row, LAST_UPDATE]
        since = max(time - last, 0)
        silence = since
        if smooth and rows[row, KNOWN] != 0:
            silence = np.int64(rows[row, NEXT]) - last
        _predict(context, row, since, silence)
        if smooth:
            _smooth_state(context, rows[row], row, time)
        pointers = _pointers(context, since, silence)
        context.kernel.functions.canonical(*pointers, row, 0, 0, 1)
        for i in range(8):
            out.mean[at, track, i] = work[MEAN + i]
            for j in range(8):
                out.covariance[at, track, i, j] = work[COVARIANCE + 8 * i + j]
        out.idle[at, track] = work.dtype.type(time - updates.integers[row, LAST_HIT]) * micro


@njit_noalloc_inlined
def _smooth_state(context, info, row, time):
    """Smooth the predicted state in the scratch memory: X + P g and P + P G P.

    Args:
        context: `_Context` with X and P of the prediction in `scratch.work`.
        info: (INFO_SIZE,) backward information of the track.
        row: Recorded row of the track before the time.
        time: Time, us since the chunk's start.
    """
    kernel, scratch = context.kernel, context.scratch
    work, matrices, e, g = scratch.work, scratch.matrices, scratch.vectors[0], scratch.vectors[1]
    now, product, other = matrices[1], matrices[3], matrices[4]
    for i in range(8):
        e[i] = work[X + i]
        for j in range(8):
            now[i, j] = work[P + 8 * i + j]
    _transport(context, info, row, time)
    for block in range(len(kernel.blocks) - 1):
        members = kernel.order[kernel.blocks[block] : kernel.blocks[block + 1]]
        _multiply(members, now, matrices[0], product)
        _multiply(members, product, now, other)
        for i in members:
            for a in members:
                e[i] += now[i, a] * g[a]
            for j in members:
                work[P + 8 * i + j] = (now[i, j] + now[j, i] + other[i, j] + other[j, i]) / 2
        for i in members:
            work[X + i] = e[i]
