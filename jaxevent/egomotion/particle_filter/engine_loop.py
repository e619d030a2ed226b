"""Loop of the particle filter over batches and events, for the compiled functions of any model.

The loop does what `filtering.run` does. Single numbers are in `cells`, the loop's own first, in the
order of `CELL_NAMES`. Numbers of all particles are rows of `work`. Models differ in the
functions of `ModelFunctions`, which `engine` writes, so this module is compiled once.

While the motion is tracked, the log-likelihood of a batch is a smooth function of the motion, a sum
of logarithms of sums of Gaussians. So it is computed at the k Chebyshev nodes of each component's
range. For particles it is the polynomial through the nodes, of degree k - 1 in each component. Some
particles, others in every batch, are scored too, as a check. If one of them deviates by more than
the bound, all are scored, and after that there are more nodes, or none for some batches.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.codegen import njit, njit_fastmath_inlined, njit_inlined

CELL_NAMES = (
    "event.xi.0", "event.xi.1", "event.bounds.0", "event.bounds.1", "event.bounds.2",
    "event.bounds.3", "event.valid.0", "event.scale.0", "event.rate.0", "timing.elapsed.0",
    "timing.history.0", "timing.has_events.0", "counts.0", "lag.0", "votes.0", "chance.0",
    "likelihood.votes.0", "likelihood.chance.0", "radius.0", "state.searching.0", "state.votes.0",
    "state.chance.0", "state.mean_contrast.0", "state.age.0", "found.searching.0", "found.votes.0",
    "found.chance.0", "found.mean_contrast.0", "found.age.0", "found.is_finite.0", "found.lost.0",
    "found.resample.0", "found.reported_searching.0", "found.contrast.0", "found.evidence.0",
)  # fmt: skip
(
    XI, _, BOUNDS, _, _, _, VALID, SCALE, RATE, ELAPSED, HISTORY, HAS_EVENTS, COUNTS, LAG, VOTES,
    CHANCE, BATCH_VOTES, BATCH_CHANCE, RADIUS, SEARCHING, _, _, _, _, NEXT_SEARCHING, _, _, _, _,
    IS_FINITE, LOST, RESAMPLE, REPORTED_SEARCHING, CONTRAST, EVIDENCE,
) = range(len(CELL_NAMES))  # fmt: skip
N_STATE_CELLS = 5  # cells of the state, from SEARCHING and from NEXT_SEARCHING on

MOTIONS_PER_BLOCK = 16  # motions that are scored together
MIN_CHECKED_PARTICLES = 4  # particles that are scored beside the nodes
MIN_NODES_PER_COMPONENT, MAX_NODES_PER_COMPONENT = 3, 7  # of a component
MAX_SCORED_FRACTION = 0.6  # of the particles, number of nodes and checks
N_BATCHES_WITHOUT_NODES = 64  # after the most nodes per component were too few
REDUCING_ERROR_RATIO = 0.05  # of the bound, error at which there may be fewer nodes
# Places in `Interpolation.counters`.
NODES_COUNTER, WAIT_COUNTER, BATCH_COUNTER, INTERPOLATED_COUNTER = range(4)


class ModelFunctions(NamedTuple):
    """Compiled functions of a model, of all particles each.

    Attributes:
        predict: Predict the particles to the batch.
        track: Score events for a block of motions, near a known motion.
        search: Score events for a block of motions, in a search.
        reweight: Update the weights by the batch.
        restart: Begin a search.
    """

    predict: Any
    track: Any
    search: Any
    reweight: Any
    restart: Any


class RowIndices(NamedTuple):
    """Rows of `work` that the loop reads and writes, and cells of the report.

    With derivatives, those along all directions are behind the values: of n directions there are
    (1 + n) d rows in place of d, and 1 + n in place of one.

    Attributes:
        particles: (d,) rows of the particles.
        normal: (d,) rows of the normal random numbers.
        predicted: (d,) rows of the predicted particles.
        motions: (d,) rows of the motions that are scored: particles, or nodes and checks.
        cloud: (d,) rows of the random numbers of a search.
        restarted: (d,) rows of the particles that a search begins with.
        log_weights: (1,) row of the log weights before the batch.
        weights: (1,) row of the weights after it.
        motion_weights: (1,) row of the weights of the motions that are scored.
        total: (1,) row of the log-likelihoods of motions.
        log_likelihood: (1,) row of the log-likelihoods of particles.
        new_log_weights: (1,) row of the log weights after the batch.
        youngest: Row of the ages of the motions of a search; -1: they are all the same.
        mean: Cells of the mean and then of the covariance.
        mean_tangents: (n d,) cells of the derivatives of the mean.
        widest: Cells of the mean and covariance of a search.
    """

    particles: NDArray[np.int64]
    normal: NDArray[np.int64]
    predicted: NDArray[np.int64]
    motions: NDArray[np.int64]
    cloud: NDArray[np.int64]
    restarted: NDArray[np.int64]
    log_weights: NDArray[np.int64]
    weights: NDArray[np.int64]
    motion_weights: NDArray[np.int64]
    total: NDArray[np.int64]
    log_likelihood: NDArray[np.int64]
    new_log_weights: NDArray[np.int64]
    youngest: int
    mean: NDArray[np.int64]
    mean_tangents: NDArray[np.int64]
    widest: NDArray[np.int64]


class BatchArrays(NamedTuple):
    """Arrays of `Candidates`, and random numbers.

    Attributes:
        d: (batches, K, C, 2) displacement from candidate to event, px.
        age: (batches, K, C) age of each candidate, s; 0: unused.
        xi: (batches, K, 2) positions of events, px.
        bounds: (batches, K, 2, 2) least and largest displacement within the sensor, px.
        valid: (batches, K) whether an event is scored.
        scale: (batches, K) number of candidates that each stands for.
        rate: (batches, K) candidates per time of age, 1/s.
        elapsed: (batches,) time from the last event of the batch before to this one's, s.
        history: (batches,) age up to which all candidates are known, s.
        normal: (batches, N, d) normal random numbers.
        uniform: (batches,) uniform random numbers, 0..1.
        cloud: (N, d) random numbers of a search, -1..1.
    """

    d: NDArray
    age: NDArray
    xi: NDArray
    bounds: NDArray
    valid: NDArray[np.bool_]
    scale: NDArray
    rate: NDArray
    elapsed: NDArray
    history: NDArray
    normal: NDArray
    uniform: NDArray
    cloud: NDArray


class InfoArrays(NamedTuple):
    """Arrays of `filtering.BatchInfo`, to be filled, and derivatives.

    Attributes:
        mean: (batches, d) before resampling.
        covariance: (batches, d, d) of the weighted particles.
        searching: (batches,) whether the motion is searched for.
        contrast: (batches,) votes relative to chance.
        lag: (batches,) time by which the observed motion precedes the last event, s.
        evidence: (batches,) log of the mean likelihood.
        cloud: (batches, n_cloud, d) some particles, drawn by weight.
        mean_tangents: (batches, n d) derivatives of the mean along n directions.
    """

    mean: NDArray
    covariance: NDArray
    searching: NDArray[np.bool_]
    contrast: NDArray
    lag: NDArray
    evidence: NDArray
    cloud: NDArray
    mean_tangents: NDArray


class Memory(NamedTuple):
    """Numbers of the compiled functions."""

    cells: NDArray  # single numbers
    work: NDArray  # (rows, particles)
    numbers: NDArray[np.float64]  # of the parameters


class Interpolation(NamedTuple):
    """State of the interpolation of log-likelihoods, and scratch memory."""

    bound: float  # largest error of a weight, relative to the largest; 0: no interpolation
    # Nodes of a component, batches to wait, batches so far, and batches with nodes.
    counters: NDArray[np.int64]
    # (d, MAX_NODES_PER_COMPONENT, N) polynomial of each node of a component at the particles.
    basis: NDArray
    slopes: NDArray  # likewise its derivatives by the component; (0, ...) without derivatives
    product: NDArray  # (N,) scratch
    checked: NDArray[np.int64]  # particles


class Context(NamedTuple):
    """Everything that the parts of the loop share."""

    functions: ModelFunctions
    pointers: Any  # addresses of cells, work, parameters, votes and ages, and of candidates in use
    rows: RowIndices
    batches: BatchArrays
    cells: NDArray  # (cells,) numbers common to all particles; `FunctionTracer` places them
    work: NDArray  # (rows, N) numbers of particles, likewise


def init_interpolation(
    bound: float, particles: int, dimension: int, dtype: np.dtype, *, has_tangents: bool = False
) -> Interpolation:
    """Start with the fewest nodes.

    Args:
        bound: Largest error of a weight, relative to the largest.
        particles: Number of particles, N.
        dimension: Number of components, d.
        dtype: Type of real numbers.
        has_tangents: Whether log-likelihoods have derivatives.

    Returns:
        The state.
    """
    shape = dimension, MAX_NODES_PER_COMPONENT, particles
    basis, product = np.zeros(shape, dtype), np.zeros(particles, dtype)
    slopes = np.zeros(shape if has_tangents else (0, *shape[1:]), dtype)
    checked = np.zeros(MOTIONS_PER_BLOCK + MIN_CHECKED_PARTICLES, np.int64)
    return Interpolation(
        bound, np.array([MIN_NODES_PER_COMPONENT, 0, 0, 0]), basis, slopes, product, checked
    )


@njit
def run(functions, memory, rows, batches, out, nodes):
    """Run the filter over batches.

    Args:
        functions: `ModelFunctions`.
        memory: Cells, work and parameters' numbers; they hold the state, before and afterwards.
        rows: `RowIndices` of the work.
        batches: `BatchArrays`.
        out: Reports of the batches, output.
        nodes: `Interpolation`, changed in place.
    """
    cells, work, numbers = memory
    chosen = np.empty(batches.age.shape[2] + 1, np.int64)
    pointers = (
        cells.ctypes, work.ctypes, numbers.ctypes, batches.d.ctypes, batches.age.ctypes,
        chosen.ctypes,
    )  # fmt: skip
    context = Context(functions, pointers, rows, batches, cells, work)
    count = batches.normal.shape[1]
    for b in range(len(batches.elapsed)):
        cells[ELAPSED], cells[HISTORY] = batches.elapsed[b], batches.history[b]
        cells[HAS_EVENTS] = batches.valid[b].any()
        for k in range(len(rows.normal)):
            for i in range(count):
                work[rows.normal[k], i] = batches.normal[b, i, k]
        functions.predict(*pointers[:3], count)
        out.lag[b] = _score(context, b, nodes)
        functions.reweight(*pointers[:3], count)
        if cells[LOST] != 0:
            for k in range(len(rows.cloud)):
                for i in range(count):
                    work[rows.cloud[k], i] = batches.cloud[i, k]
            functions.restart(*pointers[:3], count)
        _report(context, b, out)
        _resample(context, batches.uniform[b])
        for k in range(N_STATE_CELLS):
            cells[SEARCHING + k] = cells[NEXT_SEARCHING + k]


@njit_inlined
def _score(context, b, nodes):
    """Compute the log-likelihoods of a batch for all particles, into their row of the work.

    Args:
        context: `Context`.
        b: Number of the batch.
        nodes: `Interpolation`.

    Returns:
        The mean lag of the batch, s.
    """
    rows, cells, work = context.rows, context.cells, context.work
    count = context.batches.normal.shape[1]
    searching, d = cells[SEARCHING] != 0, len(rows.normal)
    if cells[HAS_EVENTS] == 0:
        cells[BATCH_VOTES] = cells[BATCH_CHANCE] = 0
        for k in range(len(rows.log_likelihood)):
            work[rows.log_likelihood[k], :count] = 0
        return cells[BATCH_VOTES]
    if not searching and _can_interpolate(nodes, d, count):
        lanes = _place_nodes(nodes, work, rows, count)
        lag = _score_events(context, b, lanes)
        if _interpolate_log_likelihoods(nodes, work, rows, lanes, count):
            return lag
    order = np.arange(work.shape[1])
    if rows.youngest >= 0 and searching:
        _place_particles(rows, work, order, count)
        cells[VALID] = 0
        _score_event(context, b, 0, len(order) // MOTIONS_PER_BLOCK)
        _sort(order[:count], work[rows.youngest])
    _place_particles(rows, work, order, count)
    lag = _score_events(context, b, len(order))
    for k in range(len(rows.total)):
        for i in range(count):
            work[rows.log_likelihood[k], order[i]] = work[rows.total[k], i]
    return lag


@njit_inlined
def _place_particles(rows, work, order, count):
    """Copy particles to the motions that are scored; the last one is repeated, without weight.

    Args:
        rows: `RowIndices`.
        work: (rows, motions) numbers of the motions.
        order: Order of the particles.
        count: Number of particles.
    """
    for i in range(work.shape[1]):
        particle = order[min(i, count - 1)]
        for k in range(len(rows.motions)):
            work[rows.motions[k], i] = work[rows.predicted[k], particle]
        for k in range(len(rows.weights)):
            weight = work[rows.weights[k], particle]
            work[rows.motion_weights[k], i] = weight if i < count else 0


@njit_inlined
def _sort(order, values):
    """Order numbers by their values, smallest first, by Shell's method.

    Args:
        order: Numbers, ordered in place.
        values: Value of each number.
    """
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
def _score_events(context, b, lanes):
    """Sum the log-likelihoods of a batch's events for some motions.

    Args:
        context: `Context`.
        b: Number of the batch.
        lanes: Number of motions.

    Returns:
        The mean lag, s.
    """
    cells, batches = context.cells, context.batches
    for k in range(len(context.rows.total)):
        context.work[context.rows.total[k], :lanes] = 0
    cells[BATCH_VOTES] = cells[BATCH_CHANCE] = 0
    lag, valid = cells[BATCH_VOTES], 0
    for e in range(batches.age.shape[1]):
        if not batches.valid[b, e]:
            continue
        valid += 1
        cells[VALID] = 1
        _score_event(context, b, e, lanes // MOTIONS_PER_BLOCK)
        lag += cells[LAG]
        cells[BATCH_VOTES] += cells[VOTES]
        cells[BATCH_CHANCE] += cells[CHANCE]
    return lag / cells.dtype.type(max(valid, 1))


@njit_inlined
def _score_event(context, b, e, blocks):
    """Add the log-likelihoods of an event for some motions.

    Args:
        context: `Context`.
        b: Number of the batch.
        e: Number of the event in it.
        blocks: Number of blocks of `MOTIONS_PER_BLOCK` motions.
    """
    cells, batches, functions = context.cells, context.batches, context.functions
    most = batches.age.shape[2]
    cells[XI], cells[XI + 1] = batches.xi[b, e, 0], batches.xi[b, e, 1]
    for k in range(4):
        cells[BOUNDS + k] = batches.bounds[b, e, k // 2, k % 2]
    cells[SCALE], cells[RATE] = batches.scale[b, e], batches.rate[b, e]
    cells[VOTES] = cells[CHANCE] = 0
    first = (b * batches.age.shape[1] + e) * most
    if cells[SEARCHING] != 0:
        functions.search(*context.pointers, blocks, first, most)
    else:
        functions.track(*context.pointers, blocks, first, most)


@njit_inlined
def _report(context, b, out):
    """Report a batch, before resampling.

    Args:
        context: `Context`.
        b: Number of the batch.
        out: Reports of the batches, output.
    """
    rows, cells, work = context.rows, context.cells, context.work
    d, is_finite = out.mean.shape[1], cells[IS_FINITE] != 0
    source = rows.mean if is_finite else rows.widest
    for k in range(d):
        out.mean[b, k] = cells[source[k]]
        for j in range(d):
            out.covariance[b, k, j] = cells[source[d + k * d + j]]
    for k in range(len(rows.mean_tangents)):
        out.mean_tangents[b, k] = cells[rows.mean_tangents[k]] if is_finite else 0
    out.searching[b] = cells[REPORTED_SEARCHING] != 0
    out.contrast[b], out.evidence[b] = cells[CONTRAST], cells[EVIDENCE]
    if is_finite and out.cloud.shape[1]:
        count = context.batches.normal.shape[1]
        drawn = np.empty(out.cloud.shape[1], np.int64)
        _draw(work[rows.new_log_weights[0]], drawn, cells.dtype.type(0.5), count)
        for i in range(len(drawn)):
            for k in range(d):
                out.cloud[b, i, k] = work[rows.predicted[k], drawn[i]]


@njit_inlined
def _resample(context, uniform):
    """Write the particles of the state, and their weights.

    Args:
        context: `Context`.
        uniform: Number in 0..1, the place of the first step of systematic resampling.
    """
    rows, cells, work = context.rows, context.cells, context.work
    count = context.batches.normal.shape[1]
    equal = cells.dtype.type(-np.log(count))
    if cells[LOST] != 0 or cells[RESAMPLE] != 0:
        drawn = np.arange(count)
        source = rows.restarted
        if cells[LOST] == 0:
            _draw(work[rows.new_log_weights[0]], drawn, uniform, count)
            source = rows.predicted
        for k in range(len(rows.particles)):
            for i in range(count):  # those of a search have no derivatives
                kept = k < len(source)
                work[rows.particles[k], i] = work[source[k], drawn[i]] if kept else 0
        work[rows.log_weights[0], :count] = equal
        # Weights keep their derivatives, see `filtering.resample`.
        for k in range(1, len(rows.log_weights)):
            for i in range(count):
                score = work[rows.new_log_weights[k], drawn[i]]
                work[rows.log_weights[k], i] = score if cells[LOST] == 0 else 0
    else:
        for k in range(len(rows.predicted)):
            _copy(work[rows.predicted[k]], work[rows.particles[k]], count)
        for k in range(len(rows.log_weights)):
            _copy(work[rows.new_log_weights[k]], work[rows.log_weights[k]], count)


@njit_inlined
def _copy(source, out, count):
    """Copy numbers; numba takes over a second to compile a copy of slices.

    Args:
        source: (count or more,).
        out: (count or more,) output.
        count: How many.
    """
    for i in range(count):
        out[i] = source[i]


@njit_inlined
def _draw(log_weights, drawn, uniform, count):
    """Draw particles at equal steps of their summed weights.

    Args:
        log_weights: (N,) log weights.
        drawn: Output, numbers of the particles.
        uniform: Place of the first step, 0 to 1.
        count: Number of particles, N.
    """
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
def _count_lanes(nodes, dimension):
    """Return the number of motions to score: nodes and checks, filled up to whole blocks.

    Args:
        nodes: `Interpolation`.
        dimension: Number of components of a motion.

    Returns:
        The number.
    """
    number = nodes.counters[NODES_COUNTER] ** dimension
    return (
        (number + MIN_CHECKED_PARTICLES + MOTIONS_PER_BLOCK - 1)
        // MOTIONS_PER_BLOCK
        * MOTIONS_PER_BLOCK
    )


@njit_inlined
def _can_interpolate(nodes, dimension, count):
    """Count a batch, and return whether it may have nodes, and these are fewer than particles.

    Args:
        nodes: `Interpolation`, whose counters are changed.
        dimension: Number of components, d.
        count: Number of particles.
    """
    nodes.counters[BATCH_COUNTER] += 1
    if nodes.counters[WAIT_COUNTER] > 0:
        nodes.counters[WAIT_COUNTER] -= 1
        return False
    return nodes.bound > 0 and _count_lanes(nodes, dimension) <= MAX_SCORED_FRACTION * count


@njit_inlined
def _place_nodes(nodes, work, rows, count):
    """Write nodes, and particles that check them, to the motions that are scored.

    The weight of a node is the sum of its polynomial over the weighted particles.

    Args:
        nodes: `Interpolation`.
        work: (rows, motions) numbers of the motions.
        rows: `RowIndices`.
        count: Number of particles.

    Returns:
        Number of nodes and checks.
    """
    motions, predicted, weights = rows.motions, rows.predicted, rows.motion_weights
    real, d, k = work.dtype.type, len(rows.normal), nodes.counters[NODES_COUNTER]
    number, lanes = k**d, _count_lanes(nodes, d)
    for c in range(d):
        row = work[predicted[c]]
        low, high = row[0], row[0]
        for i in range(count):
            low = min(low, row[i])
            high = max(high, row[i])
        middle, half = (low + high) / real(2), (high - low) / real(2)
        half = half if half > 0 else real(1)
        for i in range(number):
            work[motions[c], i] = middle + half * real(_chebyshev(k, i // k ** (d - 1 - c) % k))
        for j in range(k):
            z = real(_chebyshev(k, j))
            _fill_basis(nodes.basis[c, j], row, middle, half, k, z)
            if len(nodes.slopes):
                _fill_slopes(nodes.slopes[c, j], row, middle, half, k, z)
    for i in range(number, lanes):
        particle = (
            (i - number) * count // (lanes - number) + nodes.counters[BATCH_COUNTER]
        ) % count
        nodes.checked[i - number] = particle
        for c in range(len(motions)):
            work[motions[c], i] = work[predicted[c], particle]
    for c in range(d, len(motions)):  # nodes stay where they are
        work[motions[c], :number] = 0
    for c in range(len(weights)):
        work[weights[c], :lanes] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        work[weights[0], j] = _dot(nodes.product, work[rows.weights[0]], count)
    return lanes


@njit_inlined
def _interpolate_log_likelihoods(nodes, work, rows, lanes, count):
    """Interpolate particles' log-likelihoods from those of the nodes.

    Args:
        nodes: `Interpolation`, whose counters are changed.
        work: (rows, motions) numbers of the motions.
        rows: `RowIndices`.
        lanes: Number of nodes and checks.
        count: Number of particles.

    Returns:
        Whether the checks are within the bound.
    """
    of_particles, of_motions = rows.log_likelihood[0], rows.total[0]
    d = len(rows.normal)
    number = nodes.counters[NODES_COUNTER] ** d
    work[of_particles, :count] = 0
    for j in range(number):
        _fill_product(nodes, j, d)
        _add_product(work[of_particles], nodes.product, work[of_motions, j], count)
    top, before = -np.inf, work[rows.log_weights[0]]
    for i in range(number, lanes):
        top = max(top, before[nodes.checked[i - number]] + work[of_motions, i])
    error = 0.0
    for i in range(number, lanes):
        c = nodes.checked[i - number]
        weight = np.exp(before[c] + work[of_motions, i] - top)
        off = abs(np.exp(before[c] + work[of_particles, c] - top) - weight)
        error = max(error, off) if off == off else np.inf
    fits = error <= nodes.bound
    if fits:
        _interpolate_tangents(nodes, work, rows, number, count)
        nodes.counters[INTERPOLATED_COUNTER] += 1
        if (
            error <= REDUCING_ERROR_RATIO * nodes.bound
            and nodes.counters[NODES_COUNTER] > MIN_NODES_PER_COMPONENT
        ):
            nodes.counters[NODES_COUNTER] -= 1
    else:
        nodes.counters[NODES_COUNTER] += 1
        if (
            nodes.counters[NODES_COUNTER] > MAX_NODES_PER_COMPONENT
            or _count_lanes(nodes, d) > MAX_SCORED_FRACTION * count
        ):
            nodes.counters[NODES_COUNTER] -= 1
            nodes.counters[WAIT_COUNTER] = N_BATCHES_WITHOUT_NODES
    return fits


@njit_inlined
def _interpolate_tangents(nodes, work, rows, number, count):
    """Interpolate the derivatives of particles' log-likelihoods, of p(theta(t), t) by t.

    Of the polynomial p = sum_j p_j L_j(theta) with the values p_j of nodes that do not move they
    are sum_j L_j dp_j / dt + p_j (dL_j / dtheta) dtheta / dt.

    Args:
        nodes: `Interpolation`.
        work: (rows, motions) numbers of the motions.
        rows: `RowIndices`.
        number: Number of nodes.
        count: Number of particles.
    """
    d = len(rows.normal)
    for n in range(1, len(rows.total)):
        work[rows.log_likelihood[n], :count] = 0
    if len(nodes.slopes) == 0:
        return
    for j in range(number):
        _fill_product(nodes, j, d)
        for n in range(1, len(rows.total)):
            value = work[rows.total[n], j]
            _add_product(work[rows.log_likelihood[n]], nodes.product, value, count)
        for c in range(d):
            _fill_slope_product(nodes, j, c, d)
            value = work[rows.total[0], j]
            for n in range(1, len(rows.total)):
                changes = work[rows.predicted[n * d + c]]
                _add_products(work[rows.log_likelihood[n]], nodes.product, changes, value, count)


@njit_inlined
def _chebyshev(k, j):
    """Return a Chebyshev node on [-1, 1].

    Args:
        k: Number of nodes.
        j: The node, from 0.

    Returns:
        Its place.
    """
    return np.cos((2 * j + 1) * np.pi / (2 * k))


@njit_fastmath_inlined
def _fill_basis(basis, row, middle, half, k, z):
    """Evaluate Lagrange's polynomial of a node at particles.

    At a particle y it is 2 / k sum_m' T_m(z) T_m(y), of Chebyshev polynomials T.

    Args:
        basis: (N,) output.
        row: (N,) a component of the particles.
        middle: Middle of its range.
        half: Half of its range.
        k: Number of nodes.
        z: The node, -1 to 1.
    """
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
def _fill_slopes(slopes, row, middle, half, k, z):
    """Differentiate Lagrange's polynomial of a node, see `_fill_basis`, by the component.

    With U_m(y) = dT_m / dy these are U_m+1 = 2 T_m + 2 y U_m - U_m-1.

    Args:
        slopes: (N,) output.
        row: (N,) a component of the particles.
        middle: Middle of its range.
        half: Half of its range.
        k: Number of nodes.
        z: The node, -1 to 1.
    """
    real = row.dtype.type
    for i in range(len(slopes)):
        y = (row[i] - middle) / half
        before, now, of_before, of_now = real(1), y, real(1), z
        slope_before, slope, total = real(0), real(1), real(0)
        for _ in range(1, k):
            total += slope * of_now
            slope_before, slope = slope, real(2) * (now + y * slope) - slope_before
            before, now = now, real(2) * y * now - before
            of_before, of_now = of_now, real(2) * z * of_now - of_before
        slopes[i] = total * real(2) / (real(k) * half)


@njit_fastmath_inlined
def _fill_product(nodes, j, d):
    """Multiply the polynomials of the components of a node, into `nodes.product`.

    Args:
        nodes: `Interpolation`.
        j: Number of the node among those of all components.
        d: Number of components.
    """
    k = nodes.counters[NODES_COUNTER]
    product, one = nodes.product, nodes.basis[d - 1, j % k]
    for i in range(len(product)):
        product[i] = one[i]
    for c in range(d - 1):
        one = nodes.basis[c, j // k ** (d - 1 - c) % k]
        for i in range(len(product)):
            product[i] *= one[i]


@njit_fastmath_inlined
def _fill_slope_product(nodes, j, moving, d):
    """Differentiate the product of a node by one component, into `nodes.product`.

    Args:
        nodes: `Interpolation`.
        j: Number of the node among those of all components.
        moving: The component.
        d: Number of components.
    """
    k = nodes.counters[NODES_COUNTER]
    product, one = nodes.product, nodes.slopes[moving, j // k ** (d - 1 - moving) % k]
    for i in range(len(product)):
        product[i] = one[i]
    for c in range(d):
        if c != moving:
            one = nodes.basis[c, j // k ** (d - 1 - c) % k]
            for i in range(len(product)):
                product[i] *= one[i]


@njit_fastmath_inlined
def _dot(one, other, count):
    """Return the scalar product of the first numbers of two vectors.

    Args:
        one: (count or more,).
        other: (count or more,).
        count: How many.

    Returns:
        The product, in the type of `one`.
    """
    total = one.dtype.type(0)
    for i in range(count):
        total += one[i] * other[i]
    return total


@njit_fastmath_inlined
def _add_product(out, product, value, count):
    """Add a multiple of a vector to another one.

    Args:
        out: (count or more,), in place.
        product: (count or more,).
        value: The factor.
        count: How many.
    """
    for i in range(count):
        out[i] += product[i] * value


@njit_fastmath_inlined
def _add_products(out, product, factors, value, count):
    """Add a multiple of the products of two vectors' numbers to another vector.

    Args:
        out: (count or more,), in place.
        product: (count or more,).
        factors: (count or more,).
        value: The factor.
        count: How many.
    """
    for i in range(count):
        out[i] += product[i] * factors[i] * value
