"""Reading of what a run has noted: states at times, and what later events say of them.

The backward pass is that of `jaxevent.blob.smoother`, over the updates of each target alone, and in
double precision. What differs from filter to filter are the functions of `Functions`, which
`reading` writes; they take and leave numbers in a row of `work`, at the places below.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine.loop import HEARD, ID, LAST
from jaxevent.blob.prepare import LONGEST
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined

DT, SILENCE, X, P, F = 0, 1, 2, 10, 74  # s, s, (8,), (8, 8) and (8, 8)
MEAN, COVARIANCE, NUMBERS = 138, 146, 210
MATRICES = 6  # that the backward pass works with

# What later events say of a target, `smoother.Later`, as one row: r (8,), N (8, 8) and the rest.
R, N, NEXT, KNOWN, WHOSE, LATER = 0, 8, 72, 73, 74, 75


class Functions(NamedTuple):
    """What is a filter's own: of a target's row."""

    moved: Any  # moments X, P after DT without events, of SILENCE in all
    passed: Any  # the transition F over DT
    canonical: Any  # MEAN and COVARIANCE of X, P


class Kernel(NamedTuple):
    """The functions of a filter, with the numbers of its parameters."""

    functions: Functions
    numbers: NDArray[np.float64]
    order: NDArray[np.int64]  # of the 8 numbers of a target, those that depend on each other
    blocks: NDArray[np.int64]  # side by side: where each block begins, and 8
    smallest: float  # what is added to correlations, for what rounding makes singular


class Room(NamedTuple):
    """Where rows are worked on; nothing in it is kept."""

    matrices: NDArray[np.float64]  # [MATRICES, 8, 8]
    vectors: NDArray[np.float64]  # [2, 8]
    work: NDArray  # [NUMBERS]
    marks: NDArray[np.int64]  # of no use here


class Asked(NamedTuple):
    """Sorted times, and of which tracks they are asked."""

    chunk: NDArray[np.int64]
    step: NDArray[np.int64]  # of each time: steps of the chunk done by then
    time: NDArray[np.int64]  # us since its start
    serial: NDArray[np.int64]  # of the tracks
    wanted: NDArray[np.bool_]  # [times, tracks]


class States(NamedTuple):
    """What is told: [times, tracks, ...]."""

    mean: NDArray
    covariance: NDArray
    idle: NDArray


@njit_noalloc
def read(kernel, updates, following, later, rows, asked, room, out):
    """States, smoothed where there are `rows`; these are filled first where `following` is given.

    `rows` is what later events say of each row, `following` us from each chunk's start to the next
    one's, and `later` what is known of targets at the start of what comes after the last chunk;
    it is then that of the first chunk's start.
    """
    for back in range(len(following)):
        chunk = len(following) - 1 - back
        begin, end = updates.begin[chunk], updates.begin[chunk + 1]
        _hand_on(updates.whole[begin : begin + len(later)], later, following[chunk])
        _go_back(kernel, updates, begin, end, later, rows, room)
    for track in range(len(asked.serial)):
        _tell(kernel, updates, rows, asked, track, room, out)


@njit_noalloc_inlined
def _hand_on(whole, later, elapsed):
    """What later events say at a chunk's end: nothing of targets that are gone in the next one."""
    for k in range(len(later)):
        whose = whole[k, ID]
        if later[k, KNOWN] != 0 and later[k, WHOSE] == whose and whose >= 0:
            later[k, NEXT] = min(np.int64(later[k, NEXT]) + elapsed, 2 * LONGEST)
        else:
            for field in range(LATER):
                later[k, field] = 0
        later[k, WHOSE] = whose


@njit_noalloc_inlined
def _given(kernel, updates, dt, silence, room):
    """The arguments of a function of a row; `dt` and `silence` in us."""
    work = room.work
    micro = work.dtype.type(1e-6)
    work[DT], work[SILENCE] = work.dtype.type(dt) * micro, work.dtype.type(silence) * micro
    return (
        updates.cells.ctypes, updates.whole.ctypes, work.ctypes, room.marks.ctypes,
        kernel.numbers.ctypes,
    )  # fmt: skip


@njit_noalloc_inlined
def _move(kernel, updates, row, dt, silence, room):
    """The moments of a row's target after dt; times in us."""
    kernel.functions.moved(*_given(kernel, updates, dt, silence, room), row, 0, 0, 1)


@njit_noalloc_inlined
def _go_back(kernel, updates, begin, end, later, rows, room):
    """From the end of a chunk to its start, update by update.

    With g = F^T r' and G = F^T N' F of the next update, r = (P-)^-1 (x - x- + P g) and
    N = (P-)^-1 (P + P G P - P-) (P-)^-1.
    """
    work, matrices = room.work, room.matrices
    e, now, before = room.vectors[0], matrices[1], matrices[2]
    for back in range(end - begin):
        row = end - 1 - back
        k, last = updates.target[row], updates.before[row]
        for field in range(LATER):
            rows[row, field] = later[k, field]
        if last < 0:
            continue
        time, since = updates.whole[row, LAST], updates.whole[last, LAST]
        none = time - time
        _transport(kernel, updates, later[k], row, time, time, room)
        _move(kernel, updates, row, none, none, room)
        for i in range(8):
            e[i] = work[X + i]
            for j in range(8):
                now[i, j] = work[P + 8 * i + j]
        _move(kernel, updates, last, time - since, time - since, room)
        for i in range(8):
            e[i] -= work[X + i]
            for j in range(8):
                before[i, j] = work[P + 8 * i + j]
        e[6] -= 2 * np.pi * np.rint(e[6] / (2 * np.pi))
        for block in range(len(kernel.blocks) - 1):
            members = kernel.order[kernel.blocks[block] : kernel.blocks[block + 1]]
            _update_later(members, kernel.smallest, later[k], room)
        later[k, NEXT], later[k, KNOWN] = time, 1


@njit_noalloc_inlined
def _transport(kernel, updates, later, row, last, time, room):
    """g = F^T r and G = F^T N F, F from a time to the target's next update."""
    work, g, G, product = room.work, room.vectors[1], room.matrices[0], room.matrices[3]
    next = np.int64(later[NEXT])
    until = next if later[KNOWN] != 0 else time
    given = _given(kernel, updates, max(next - time, 0), until - last, room)
    kernel.functions.passed(*given, row, 0, 0, 1)
    for block in range(len(kernel.blocks) - 1):
        members = kernel.order[kernel.blocks[block] : kernel.blocks[block + 1]]
        for i in members:
            g[i] = 0
            for a in members:
                g[i] += work[F + 8 * a + i] * later[R + a]
            for j in members:
                product[i, j] = 0
                for a in members:
                    product[i, j] += later[N + 8 * i + a] * work[F + 8 * a + j]
        for i in members:
            for j in members:
                G[i, j] = 0
                for a in members:
                    G[i, j] += work[F + 8 * a + i] * product[a, j]


@njit_noalloc_inlined
def _update_later(members, smallest, later, room):
    """r and N before an update, of numbers that depend on each other."""
    matrices, e, g = room.matrices, room.vectors[0], room.vectors[1]
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
        later[R + i] = 0
        for j in members:
            later[R + i] += inverse[i, j] * e[j]
            other[i, j] += now[i, j] - before[i, j]
    _multiply(members, inverse, other, product)
    _multiply(members, product, inverse, other)
    for i in members:
        for j in members:
            later[N + 8 * i + j] = other[i, j]


@njit_noalloc_inlined
def _multiply(members, a, b, out):
    for i in members:
        for j in members:
            total = 0.0
            for k in members:
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit_noalloc_inlined
def _invert(members, smallest, P, out, work):
    """Of a covariance, scaled to correlations, by the sweep operator; 0 for what is known."""
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
def _tell(kernel, updates, rows, asked, track, room, out):
    """A track at all times."""
    work, smooth, targets = room.work, len(rows) > 0, len(updates.latest)
    micro = work.dtype.type(1e-6)
    chunk = target = row = following = np.int64(-1)
    for at in range(len(asked.chunk)):
        if not asked.wanted[at, track]:
            continue
        if asked.chunk[at] != chunk:
            chunk = asked.chunk[at]
            row, following = updates.begin[chunk], updates.begin[chunk] + targets
            while row + 1 < following and updates.whole[row, ID] != asked.serial[track]:
                row += 1
            target = updates.target[row]
        while following < updates.begin[chunk + 1] and updates.step[following] <= asked.step[at]:
            row = following if updates.target[following] == target else row
            following += 1
        time, last = asked.time[at], updates.whole[row, LAST]
        since = max(time - last, 0)
        silence = since
        if smooth and rows[row, KNOWN] != 0:
            silence = np.int64(rows[row, NEXT]) - last
        _move(kernel, updates, row, since, silence, room)
        if smooth:
            _smooth(kernel, updates, rows[row], row, last, time, room)
        given = _given(kernel, updates, since, silence, room)
        kernel.functions.canonical(*given, row, 0, 0, 1)
        for i in range(8):
            out.mean[at, track, i] = work[MEAN + i]
            for j in range(8):
                out.covariance[at, track, i, j] = work[COVARIANCE + 8 * i + j]
        out.idle[at, track] = work.dtype.type(time - updates.whole[row, HEARD]) * micro


@njit_noalloc_inlined
def _smooth(kernel, updates, later, row, last, time, room):
    """X and P from all events: X + P g, P + P G P."""
    work, matrices, e = room.work, room.matrices, room.vectors[0]
    now, product, other = matrices[1], matrices[3], matrices[4]
    for i in range(8):
        e[i] = work[X + i]
        for j in range(8):
            now[i, j] = work[P + 8 * i + j]
    _transport(kernel, updates, later, row, last, time, room)
    g = room.vectors[1]
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
