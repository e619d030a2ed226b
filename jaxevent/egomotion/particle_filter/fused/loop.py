"""The loop that all models' kernels share: over batches and events, as `filtering.run` has it.

Single numbers are in `cells`, the driver's own first, in the order of `CELLS`; numbers of all
particles are rows of `work`. What differs from model to model are the functions of `Functions`,
which `functions` writes; so this module is compiled once.
"""

import warnings
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.particle_filter.fused.nodes import BLOCK, interpolate, place, usable
from jaxevent.kernels import compiled, part

# Functions that are passed as arguments are called through their address.
warnings.filterwarnings("ignore", category=numba.NumbaExperimentalFeatureWarning)

CELLS = (
    "event.xi.0", "event.xi.1", "event.room.0", "event.room.1", "event.room.2",
    "event.room.3", "event.valid.0", "event.scale.0", "event.rate.0", "passed.elapsed.0",
    "passed.history.0", "passed.some.0", "seen.0", "lag.0", "votes.0", "chance.0", "told.votes.0",
    "told.chance.0", "reach.0", "state.searching.0", "state.votes.0", "state.chance.0",
    "state.usual.0", "state.age.0", "found.searches.0", "found.votes.0", "found.chance.0",
    "found.usual.0", "found.age.0", "found.sound.0", "found.lost.0", "found.few.0",
    "found.searching.0", "found.contrast.0", "found.evidence.0",
)  # fmt: skip
(
    XI, _, ROOM, _, _, _, VALID, SCALE, RATE, ELAPSED, HISTORY, SOME, SEEN, LAG, VOTES,
    CHANCE, ALL_VOTES, ALL_CHANCE, REACH, SEARCHING, _, _, _, _, SEARCHES, _, _, _, _, SOUND, LOST,
    FEW, TELLS_SEARCHING, CONTRAST, EVIDENCE,
) = range(len(CELLS))  # fmt: skip
STATE = 5  # cells, from SEARCHING and from SEARCHES on


class Functions(NamedTuple):
    """What is a model's own."""

    propagate: Any
    follow: Any
    search: Any
    weigh: Any
    restart: Any


class Rows(NamedTuple):
    """Which rows of `work` the driver reads and writes, and cells of what is told."""

    particles: NDArray[np.int64]
    normal: NDArray[np.int64]
    moved: NDArray[np.int64]
    at: NDArray[np.int64]
    cloud: NDArray[np.int64]
    anew: NDArray[np.int64]
    log_weights: int
    weights: int
    share: int
    total: int
    of_batch: int
    weighed: int
    sorted_by: int  # ages of a search's motions; -1: they are all the same
    mean: NDArray[np.int64]  # cells, of the mean and then of the covariance
    widest: NDArray[np.int64]


class Given(NamedTuple):
    """Batches: the arrays of `Candidates`, and random numbers."""

    d: NDArray  # (batches, K, C, 2)
    age: NDArray
    xi: NDArray
    room: NDArray
    valid: NDArray[np.bool_]
    scale: NDArray
    rate: NDArray
    elapsed: NDArray
    history: NDArray
    normal: NDArray
    uniform: NDArray
    cloud: NDArray


class Told(NamedTuple):
    """What batches tell: the arrays of `filtering.Info`."""

    mean: NDArray
    covariance: NDArray
    searching: NDArray[np.bool_]
    contrast: NDArray
    lag: NDArray
    evidence: NDArray
    cloud: NDArray


@compiled
def run(functions, numbers, rows, given, told, cells, work, nodes):
    """The filter over batches; `cells` and `work` hold the state, before and afterwards."""
    memory = cells.ctypes, work.ctypes, numbers.ctypes, given.d.ctypes, given.age.ctypes
    count = given.normal.shape[1]
    for b in range(len(given.elapsed)):
        cells[ELAPSED], cells[HISTORY] = given.elapsed[b], given.history[b]
        cells[SOME] = given.valid[b].any()
        for k in range(len(rows.normal)):
            for i in range(count):
                work[rows.normal[k], i] = given.normal[b, i, k]
        functions.propagate(*memory[:3], count)
        told.lag[b] = _score(functions, memory, rows, given, b, cells, work, nodes)
        functions.weigh(*memory[:3], count)
        lost = cells[LOST] != 0
        if lost:
            for k in range(len(rows.cloud)):
                for i in range(count):
                    work[rows.cloud[k], i] = given.cloud[i, k]
            functions.restart(*memory[:3], count)
        _tell(rows, told, b, cells, work, count)
        _resample(rows, given.uniform[b], cells, work, count)
        for k in range(STATE):
            cells[SEARCHING + k] = cells[SEARCHES + k]


@part
def _score(functions, memory, rows, given, b, cells, work, nodes):
    """Log-likelihoods of a batch for all particles, into their row; the lag of what is seen."""
    count = given.normal.shape[1]
    searching, d = cells[SEARCHING] != 0, len(rows.moved)
    if cells[SOME] == 0:
        cells[ALL_VOTES] = cells[ALL_CHANCE] = 0
        work[rows.of_batch, :count] = 0
        return cells[ALL_VOTES]
    if not searching and usable(nodes, d, count):
        lanes = place(nodes, work, rows, count)
        lag = _ask_events(functions, memory, rows, given, b, cells, work, lanes)
        if interpolate(nodes, work, rows, lanes, count):
            return lag
    order = np.arange(work.shape[1])
    if rows.sorted_by >= 0 and searching:
        _lay_out(rows, work, order, count)
        cells[VALID] = 0
        _ask_event(functions, memory, given, b, 0, cells, len(order) // BLOCK)
        sort(order[:count], work[rows.sorted_by])
    _lay_out(rows, work, order, count)
    lag = _ask_events(functions, memory, rows, given, b, cells, work, len(order))
    for i in range(count):
        work[rows.of_batch, order[i]] = work[rows.total, i]
    return lag


@part
def _lay_out(rows, work, order, count):
    """Write particles in an order where they are scored; the last is repeated, without weight."""
    for i in range(work.shape[1]):
        particle = order[min(i, count - 1)]
        for k in range(len(rows.at)):
            work[rows.at[k], i] = work[rows.moved[k], particle]
        work[rows.share, i] = work[rows.weights, particle] if i < count else 0


@part
def sort(order, values):
    """Order numbers by their values, smallest first, by Shell's method."""
    gap = len(order) // 2
    while gap > 0:
        for i in range(gap, len(order)):
            one, j = order[i], i
            while j >= gap and values[order[j - gap]] > values[one]:
                order[j] = order[j - gap]
                j -= gap
            order[j] = one
        gap //= 2


@part
def _ask_events(functions, memory, rows, given, b, cells, work, lanes):
    """The sum over a batch's events of what they say of so many motions; the mean lag."""
    work[rows.total, :lanes] = 0
    cells[ALL_VOTES] = cells[ALL_CHANCE] = 0
    lag, valid = cells[ALL_VOTES], 0
    for e in range(given.age.shape[1]):
        if not given.valid[b, e]:
            continue
        valid += 1
        cells[VALID] = 1
        _ask_event(functions, memory, given, b, e, cells, lanes // BLOCK)
        lag += cells[LAG]
        cells[ALL_VOTES] += cells[VOTES]
        cells[ALL_CHANCE] += cells[CHANCE]
    return lag / cells.dtype.type(max(valid, 1))


@part
def _ask_event(functions, memory, given, b, e, cells, blocks):
    """What an event says of so many blocks of motions."""
    most = given.age.shape[2]
    cells[XI], cells[XI + 1] = given.xi[b, e, 0], given.xi[b, e, 1]
    for k in range(4):
        cells[ROOM + k] = given.room[b, e, k // 2, k % 2]
    cells[SCALE], cells[RATE] = given.scale[b, e], given.rate[b, e]
    cells[VOTES] = cells[CHANCE] = 0
    first = (b * given.age.shape[1] + e) * most
    if cells[SEARCHING] != 0:
        functions.search(*memory, blocks, first, most)
    else:
        functions.follow(*memory, blocks, first, most)


@part
def _tell(rows, told, b, cells, work, count):
    """What a batch tells, before resampling."""
    d, sound = told.mean.shape[1], cells[SOUND] != 0
    source = rows.mean if sound else rows.widest
    for k in range(d):
        told.mean[b, k] = cells[source[k]]
        for j in range(d):
            told.covariance[b, k, j] = cells[source[d + k * d + j]]
    told.searching[b] = cells[TELLS_SEARCHING] != 0
    told.contrast[b], told.evidence[b] = cells[CONTRAST], cells[EVIDENCE]
    if sound and told.cloud.shape[1]:
        drawn = np.empty(told.cloud.shape[1], np.int64)
        _draw(work[rows.weighed], drawn, cells.dtype.type(0.5), count)
        for i in range(len(drawn)):
            for k in range(d):
                told.cloud[b, i, k] = work[rows.moved[k], drawn[i]]


@part
def _resample(rows, uniform, cells, work, count):
    """The particles that go on, and their weights."""
    even = cells.dtype.type(-np.log(count))
    if cells[LOST] != 0 or cells[FEW] != 0:
        drawn = np.arange(count)
        source = rows.anew
        if cells[LOST] == 0:
            _draw(work[rows.weighed], drawn, uniform, count)
            source = rows.moved
        for k in range(len(source)):
            for i in range(count):
                work[rows.particles[k], i] = work[source[k], drawn[i]]
        work[rows.log_weights, :count] = even
    else:
        for k in range(len(rows.moved)):
            work[rows.particles[k], :count] = work[rows.moved[k], :count]
        work[rows.log_weights, :count] = work[rows.weighed, :count]


@part
def _draw(log_weights, drawn, uniform, count):
    """Particles at even steps of their summed weights."""
    edges = np.empty(count, log_weights.dtype)
    total = log_weights.dtype.type(0)
    for i in range(count):
        total += np.exp(log_weights[i])
        edges[i] = total
    step, at = total / log_weights.dtype.type(len(drawn)), 0
    for i in range(len(drawn)):
        point = (log_weights.dtype.type(i) + uniform) * step
        while at < count - 1 and edges[at] <= point:
            at += 1
        drawn[i] = at
