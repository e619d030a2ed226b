"""The loop that all models' kernels share: over batches and events, as `filtering.run` has it.

Single numbers are in `cells`, the driver's own first, in the order of `CELLS`; numbers of all
particles are rows of `work`. What differs from model to model are the functions of `Functions`,
which `functions` writes; so this module is compiled once.

While the motion is followed a batch's log-likelihood is a smooth function of the motion, sums of
logarithms of sums of Gaussians. So it is computed at the k Chebyshev nodes of each component's
range, and is for particles the polynomial through these: of degree k - 1 in each component. Some
particles, others in every batch, are scored too. Where one of them is off by more than the bound
all are scored, and after that nodes are more, or left out for some batches.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_fastmath_inlined, njit_inlined

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

BLOCK = 16  # motions that are scored together; those that are no nodes are particles, as checks
LEAST_CHECKS = 4
FEWEST, MOST = 3, 7  # nodes of a component
GAIN = 0.6  # nodes and checks are fewer than this share of the particles
REST = 64  # batches for which nodes are left out, where the most that there may be were too few
NEARER = 0.05  # of the bound, by which nodes may become fewer
K, WAIT, BATCH, USED = range(4)


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


class Nodes(NamedTuple):
    """How the log-likelihood is interpolated, and room for it."""

    bound: float  # largest error of a batch's log-likelihood; 0: none are interpolated
    now: NDArray[np.int64]  # nodes of a component, batches to wait, batches, and those with nodes
    basis: NDArray  # (d, MOST, N), what a component's node counts for each particle
    product: NDArray  # (N,)
    checked: NDArray[np.int64]  # particles


def room_for(bound: float, particles: int, dimension: int, dtype: np.dtype) -> Nodes:
    """Nothing interpolated yet."""
    basis, product = np.zeros((dimension, MOST, particles), dtype), np.zeros(particles, dtype)
    checked = np.zeros(BLOCK + LEAST_CHECKS, np.int64)
    return Nodes(bound, np.array([FEWEST, 0, 0, 0]), basis, product, checked)


@njit
def run(functions, numbers, rows, given, told, cells, work, nodes):
    """The filter over batches; `cells` and `work` hold the state, before and afterwards."""
    chosen = np.empty(given.age.shape[2] + 1, np.int64)
    memory = (
        cells.ctypes, work.ctypes, numbers.ctypes, given.d.ctypes, given.age.ctypes, chosen.ctypes
    )  # fmt: skip
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


@njit_inlined
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


@njit_inlined
def _lay_out(rows, work, order, count):
    """Write particles in an order where they are scored; the last is repeated, without weight."""
    for i in range(work.shape[1]):
        particle = order[min(i, count - 1)]
        for k in range(len(rows.at)):
            work[rows.at[k], i] = work[rows.moved[k], particle]
        work[rows.share, i] = work[rows.weights, particle] if i < count else 0


@njit_inlined
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


@njit_inlined
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


@njit_inlined
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


@njit_inlined
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


@njit_inlined
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
            _copy(work[rows.moved[k]], work[rows.particles[k]], count)
        _copy(work[rows.weighed], work[rows.log_weights], count)


@njit_inlined
def _copy(one, other, count):
    """Copy so many numbers; of slices numba takes over a second to compile it."""
    for i in range(count):
        other[i] = one[i]


@njit_inlined
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


@njit_inlined
def lanes_of(nodes, dimension):
    """Nodes and checks together, where k of each component are used."""
    number = nodes.now[K] ** dimension
    return (number + LEAST_CHECKS + BLOCK - 1) // BLOCK * BLOCK


@njit_inlined
def usable(nodes, dimension, count):
    """Whether nodes are to be used for a batch, and are fewer than particles."""
    nodes.now[BATCH] += 1
    if nodes.now[WAIT] > 0:
        nodes.now[WAIT] -= 1
        return False
    return nodes.bound > 0 and lanes_of(nodes, dimension) <= GAIN * count


@njit_inlined
def place(nodes, work, rows, count):
    """Write nodes and particles that check them where motions are scored: how many there are.

    A node's weight is what particles between the nodes weigh.
    """
    at, moved, share = rows.at, rows.moved, rows.share
    real, d, k = work.dtype.type, len(moved), nodes.now[K]
    number, lanes = k**d, lanes_of(nodes, d)
    for c in range(d):
        row = work[moved[c]]
        low, high = row[0], row[0]
        for i in range(count):
            low = min(low, row[i])
            high = max(high, row[i])
        middle, half = (low + high) / real(2), (high - low) / real(2)
        half = half if half > 0 else real(1)
        for i in range(number):
            work[at[c], i] = middle + half * real(_chebyshev(k, i // k ** (d - 1 - c) % k))
        for j in range(k):
            _fill_basis(nodes.basis[c, j], row, middle, half, k, real(_chebyshev(k, j)))
    for i in range(number, lanes):
        particle = ((i - number) * count // (lanes - number) + nodes.now[BATCH]) % count
        nodes.checked[i - number] = particle
        for c in range(d):
            work[at[c], i] = work[moved[c], particle]
    work[share, :lanes] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        work[share, j] = _sum_products(nodes.product, work[rows.weights], count)
    return lanes


@njit_inlined
def interpolate(nodes, work, rows, lanes, count):
    """Write particles' log-likelihoods from those of nodes; whether they are within the bound."""
    of_particles, at_nodes, d = rows.of_batch, rows.total, len(rows.at)
    number = nodes.now[K] ** d
    work[of_particles, :count] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        _add_product(work[of_particles], nodes.product, work[at_nodes, j], count)
    top, before = -np.inf, work[rows.log_weights]
    for i in range(number, lanes):
        top = max(top, before[nodes.checked[i - number]] + work[at_nodes, i])
    error = 0.0
    for i in range(number, lanes):
        c = nodes.checked[i - number]
        weight = np.exp(before[c] + work[at_nodes, i] - top)
        off = abs(np.exp(before[c] + work[of_particles, c] - top) - weight)
        error = max(error, off) if off == off else np.inf
    fits = error <= nodes.bound
    if fits:
        nodes.now[USED] += 1
        if error <= NEARER * nodes.bound and nodes.now[K] > FEWEST:
            nodes.now[K] -= 1
    else:
        nodes.now[K] += 1
        if nodes.now[K] > MOST or lanes_of(nodes, d) > GAIN * count:
            nodes.now[K] -= 1
            nodes.now[WAIT] = REST
    return fits


@njit_inlined
def _chebyshev(k, j):
    """The nodes of k on [-1, 1]."""
    return np.cos((2 * j + 1) * np.pi / (2 * k))


@njit_fastmath_inlined
def _fill_basis(basis, row, middle, half, k, z):
    """Lagrange's polynomial of a node z at particles y: 2 / k sum_m' T_m(z) T_m(y)."""
    real = row.dtype.type
    for i in range(len(basis)):
        y = (row[i] - middle) / half
        before, now, of_before, of_now = real(1), y, real(1), z
        total = real(0.5)
        for _ in range(1, k):
            total += now * of_now
            before, now = now, real(2) * y * now - before
            of_before, of_now = of_now, real(2) * z * of_now - of_before
        basis[i] = total * real(2) / real(k)


@njit_fastmath_inlined
def _fill_product(nodes, j, d):
    """What node j counts for each particle."""
    k = nodes.now[K]
    product, one = nodes.product, nodes.basis[d - 1, j % k]
    for i in range(len(product)):
        product[i] = one[i]
    for c in range(d - 1):
        one = nodes.basis[c, j // k ** (d - 1 - c) % k]
        for i in range(len(product)):
            product[i] *= one[i]


@njit_fastmath_inlined
def _sum_products(one, other, count):
    total = one.dtype.type(0)
    for i in range(count):
        total += one[i] * other[i]
    return total


@njit_fastmath_inlined
def _add_product(to, product, value, count):
    for i in range(count):
        to[i] += product[i] * value
