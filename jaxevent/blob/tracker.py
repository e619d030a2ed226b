"""Tracks of many blobs in one stream of events: gate, association, births and deaths.

Events are taken in steps of M. In each step every target predicts itself to the step's time, events
inside its gate are shared out among the targets and update them; events in nobody's gate are
counted on a coarse grid, where tracks are born. All of it is one pure function, `run`, over chunks
that `jaxevent.blob.prepare` packs. Guide to the methods: Wang, Molloy, van Goor, Mahony,
"Asynchronous Blob Tracker for Event Cameras" (gate); Bar-Shalom, Fortmann, "Tracking and Data
Association" (soft association, JPDA); jAER's RectangularClusterTracker (life cycle).
"""

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray
from tqdm import tqdm

from jaxevent.blob.filters import Batch, Expected, FilterParams, filter_of
from jaxevent.blob.prepare import LONGEST, Features, Mark, Seeds, Window, Windows
from jaxevent.errors import InputError
from jaxevent.parameters import Choice, Count, Positive
from jaxevent.recording import Recording, Times, microseconds

BEGINS = 32  # windows from which tracking can be taken up again
READS = 64  # times read per call
THETA_RATIO = 1.15  # lambda1 / lambda2 from which theta means something

ENDS = ("end", "idle", "unconfirmed", "left", "size", "uncertain", "merged", "not finite")


class Params(FilterParams):
    """Parameters of blob tracking: of the filter, the association and the life cycle.

    The times of the life cycle suit blobs of 10,000 events/s and more; scale them with the rate (a
    blob of 100 events/s needs "slow").
    """

    association = Choice(
        ("soft", "nearest"),
        "an event in several gates: shared by its likelihood (JPDA), or the likeliest target's",
    )
    clutter = Positive(
        0.0, "1/px^2", "soft: density of stray events inside a gate, per event of the target"
    )
    outliers = Positive(0.1, "", "likelihood of all events: share of events of no target")
    max_targets = Count(16, "", "most targets at a time that detection may hold")

    prefilter = Choice((False, True), "leave out events without recent neighbours")
    prefilter_neighbours = Count(2, "", "of 8 pixels around, how many must have fired")
    prefilter_time = Positive(5e-3, "s", "how long ago they may have fired")

    cycle = Positive(1e-3, "s", "period of births and deaths")
    cell = Count(8, "px", "cell of the grid of unassociated events, about a blob's lambda")
    tau_birth = Positive(3e-3, "s", "time constant in which the grid forgets")
    n_birth = Positive(30.0, "", "unassociated events in 3x3 cells that begin a track")
    surround = Positive(
        1.0, "", "radius, in gates, around a track whose events begin no other (jAER: surround)"
    )
    n_confirm = Positive(100.0, "", "events after which a track is confirmed")
    t_confirm = Positive(2e-3, "s", "least age of a confirmed track")
    t_tentative = Positive(10e-3, "s", "tentative tracks end after this time without events, and "
                           "after twice this time")  # fmt: skip
    t_coast = Positive(0.1, "s", "confirmed tracks end after this time without events")
    t_merge = Positive(
        0.1,
        "s",
        "the younger of two confirmed tracks ends after this time within one lambda of the older",
    )
    aspect_max = Positive(10.0, "", "tracks end when lambda1 / lambda2 is larger")
    sigma_max = Positive(50.0, "px", "tracks end when the position is less certain")

    presets = {
        **FilterParams.presets,
        "slow": {  # stars: 50 events/s each
            **FilterParams.presets["slow"],
            "gate_decay": 1.0,
            "cycle": 0.05, "cell": 6, "tau_birth": 0.5, "n_birth": 12.0, "n_confirm": 40.0,
            "t_confirm": 0.5, "t_tentative": 1.0, "t_coast": 3.0, "t_merge": 1.0,
            "sigma_max": 10.0,
        },
        "fast": {  # more than 10,000 px/s
            **FilterParams.presets["fast"],
            "cycle": 2e-4, "cell": 16, "tau_birth": 5e-4, "surround": 2.0, "t_confirm": 5e-4,
            "t_tentative": 2e-3, "t_coast": 2e-2, "t_merge": 1e-2, "sigma_max": 200.0,
        },
    }  # fmt: skip


class Slots(eqx.Module):
    """The targets of one moment; times are us since the chunk's start."""

    state: Any  # the filter's, of the last update, with a leading axis of targets
    gate: Float[Array, " targets"]  # px, before the position's uncertainty is added
    hits: Float[Array, " targets"]  # events, by weight
    last: Int[Array, " targets"]  # of the last update
    heard: Int[Array, " targets"]  # of the last step with half an event or more
    born: Int[Array, " targets"]
    apart: Int[Array, " targets"]  # last found more than a lambda from all older tracks
    id: Int[Array, " targets"]  # serial number; -1: free
    confirmed: Bool[Array, " targets"]


class Grid(eqx.Module):
    """Unassociated events, exponentially forgotten: number and sums of x and y in each cell."""

    sums: Float[Array, "3 rows columns"]
    time: Int[Array, ""]  # us since the chunk's start


class Carry(eqx.Module):
    slots: Slots
    grid: Grid | None
    next_id: Int[Array, ""]


class Step(eqx.Module):
    """What one step tells: filled in as far as it was asked for."""

    unassociated: Bool[Array, " M"]
    slots: Any = None  # after it
    target: Any = None  # (M,) serial number of each event's likeliest target
    weight: Any = None  # (M,)
    path: Any = None  # see _line
    loss: Any = None  # sum over the events that count
    count: Any = None


class Log(eqx.Module):
    """Births and deaths of one chunk, by slot; -1 where no track."""

    before: Int[Array, " targets"]
    after: Int[Array, " targets"]
    confirmed: Bool[Array, " targets"]
    ended: Int[Array, " targets"]  # why, see ENDS; 0: it goes on
    death: Int[Array, " targets"]  # us since the chunk's start


class Association(eqx.Module):
    """Whose the events are: the likeliest target's serial number, -1 for none, and its weight."""

    id: Int[Array, "steps M"]
    weight: Float[Array, "steps M"]


def seconds(us: Any, like: Array) -> Array:
    """Whole us as seconds."""
    return us.astype(like.dtype) * 1e-6


def _largest(a: Float[Array, "... 2 2"]) -> Float[Array, "..."]:
    """The larger eigenvalue of symmetric matrices."""
    half = (a[..., 0, 0] - a[..., 1, 1]) / 2
    mean = (a[..., 0, 0] + a[..., 1, 1]) / 2
    return mean + jnp.sqrt(half**2 + a[..., 0, 1] ** 2)


def _determinant(a: Float[Array, "... 2 2"]) -> Float[Array, "..."]:
    return a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0]


def _squared(e: Float[Array, "K M 2"], a: Float[Array, "K 2 2"]) -> Float[Array, "K M"]:
    """e^T a^-1 e."""
    x, y = e[..., 0], e[..., 1]
    a = a[:, None]
    top = a[..., 1, 1] * x**2 - 2 * a[..., 0, 1] * x * y + a[..., 0, 0] * y**2
    return top / _determinant(a)


def held(
    params: FilterParams,
    expected: Expected,
    gate: Float[Array, " K"],
    e: Float[Array, "K M 2"],
) -> Bool[Array, "K M"]:
    """Which residuals are inside the gates of radius `gate`, widened by the position's P.

    circle: |e|^2 <= gate^2 + g^2 (largest eigenvalue of P_p); ellipse: the same along every axis of
    the blob, e^T ((gate/lambda1)^2 L L^T + g^2 P_p)^-1 e <= 1.
    """
    g2 = params.gate_position**2
    if params.gate_shape == "circle":
        return (e**2).sum(-1) <= (gate**2 + g2 * _largest(expected.P_p))[:, None]
    scale = gate / expected.size.max(-1)
    shape = (scale**2)[:, None, None] * expected.spread + g2 * expected.P_p
    return _squared(e, shape) <= 1


def shares(
    params: Params, inside: Bool[Array, "K M"], d2: Float[Array, "K M"], det: Float[Array, " K"]
) -> Float[Array, "K M"]:
    """How much of each event is each target's: w_i ~ N(xi; p_i, S_i) among the gates that hold it.

    `d2` is the squared Mahalanobis distance and `det` the determinant of S_i.
    """
    if params.association == "nearest":
        score = jnp.where(inside, d2 + jnp.log(det)[:, None], jnp.inf)
        first = jnp.arange(len(score))[:, None] == jnp.argmin(score, axis=0)
        return (inside & first).astype(d2.dtype)
    density = jnp.where(inside, -0.5 * (d2 + jnp.log(det)[:, None]), -jnp.inf)
    clutter = params.raw["clutter"] + math.log(2 * math.pi)  # the logarithm: -inf for none
    top = lax.stop_gradient(jnp.maximum(density.max(0), clutter))
    top = jnp.where(jnp.isfinite(top), top, 0)
    parts = jnp.where(inside, jnp.exp(jnp.where(inside, density, top) - top), 0)
    total = parts.sum(0) + jnp.exp(clutter - top)
    return parts / jnp.where(total > 0, total, 1)


def _step(
    params: Params, wanted: str, frame: Any, limit: Array, slots: Slots, events: Any
) -> tuple[Slots, Step]:
    """One step: predict, gate, share out, update. `limit`: us of silence that end a track."""
    blob = filter_of(params)
    times, xi, polarity, valid = events
    time = times[-1]
    # A single event's is 0 for the compiler too, which leaves out what it would multiply.
    age = seconds(time - times, xi) if len(times) > 1 else jnp.zeros_like(xi[:, 0])
    alive = time - slots.heard <= limit
    dt = jnp.where(alive, seconds(jnp.maximum(time - slots.last, 0), xi), 0)
    predicted = jax.vmap(blob.predict, (None, 0, 0))(params, slots.state, dt)
    expected = jax.vmap(blob.expected, (None, 0))(params, predicted)
    e = xi - (expected.p[:, None] - expected.v[:, None] * age[:, None])

    fixed, now, residual = lax.stop_gradient((params, expected, e))
    a = jnp.exp(-fixed.gate_decay * dt)
    radius = a * slots.gate + (1 - a) * fixed.gate * now.size.max(-1)
    radius = jnp.clip(radius, fixed.gate_min, fixed.gate_max)
    inside = held(fixed, now, radius, residual) & alive[:, None] & valid

    S = expected.spread + expected.P_p
    det, d2 = _determinant(S), _squared(e, S)
    weight = shares(params, inside, d2, det)
    batch = Batch(xi, age, polarity)
    updated = jax.vmap(blob.update, (None, 0, None, 0))(params, predicted, batch, weight)
    touched = (weight > 0).any(1)
    number = lax.stop_gradient(weight).sum(1)

    def choose(new, old):
        return jnp.where(touched.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    slots = Slots(
        jax.tree.map(choose, updated, slots.state),
        choose(radius, slots.gate),
        slots.hits + number,
        jnp.where(touched, time, slots.last),
        jnp.where(number >= 0.5, time, slots.heard),
        slots.born,
        slots.apart,
        slots.id,
        slots.confirmed,
    )
    some = inside.any(0)
    near = held(fixed, now, jnp.maximum(fixed.surround, 1) * radius, residual) & alive[:, None]
    told: dict[str, Any] = {}
    if wanted == "states":
        told["slots"] = slots
    elif wanted == "associations":
        best = jnp.argmax(weight, axis=0)
        top = weight.max(0)
        told["target"], told["weight"] = jnp.where(top > 0, slots.id[best], -1), top
    elif wanted == "path":
        told["path"] = _line(params, slots)
    elif wanted in ("associated", "all"):
        counted = some if wanted == "associated" else valid
        among = inside if wanted == "associated" else alive[:, None] & valid
        density = -0.5 * (d2 + jnp.log(det)[:, None]) - math.log(2 * math.pi)
        density = jnp.where(among, density, -jnp.inf)
        if wanted == "all":
            number = alive.sum()
            share = jnp.where(number > 0, params.outliers, 1)
            targets = density + jnp.log1p(-params.outliers) - jnp.log(jnp.maximum(number, 1))
            stray = jnp.broadcast_to(jnp.log(share / frame.prod()), valid.shape)
            density = jnp.concatenate([targets, stray[None]])
        density = jnp.where(counted, density, 0)
        told["loss"] = -jnp.where(counted, jax.nn.logsumexp(density, axis=0), 0).sum()
        told["count"] = counted.sum().astype(xi.dtype)
    return slots, Step(valid & ~near.any(0), **told)


def _line(params: Params, slots: Slots) -> tuple[Array, Array, Array]:
    """Position, velocity and time of the last update of all targets."""
    now = jax.vmap(filter_of(params).expected, (None, 0))(params, slots.state)
    return now.p, now.v, slots.last


def _where(mask: Array, new: Any, old: Any) -> Any:
    """By target."""

    def choose(a, b):
        return jnp.where(mask.reshape(-1, *[1] * (b.ndim - 1)), a, b)

    return jax.tree.map(choose, new, old)


def _started(
    params: Params, slots: Slots, which: Array, xi: Array, size: Array, time: Array, ids: Array,
    confirmed: bool,
) -> Slots:  # fmt: skip
    """Tracks begin in some slots, at rest at the positions given."""
    state = jax.vmap(filter_of(params).start, (None, 0, 0))(params, xi, size)
    gate = jnp.clip(params.gate * size, params.gate_min, params.gate_max).astype(xi.dtype)
    at = jnp.broadcast_to(time, which.shape)
    new = Slots(
        state, gate, jnp.zeros_like(gate), at, at, at, at, ids, jnp.full_like(which, confirmed)
    )
    return _where(which, new, slots)


def begin(params: Params, features: Features) -> Carry:
    """No track yet."""
    real = features.xi.dtype
    number = len(features.seed) + (params.max_targets if features.detect else 0)
    none = jnp.zeros(number, jnp.int32)
    size = jnp.broadcast_to(params.lambda0, number).astype(real)
    state = jax.vmap(filter_of(params).start, (None, 0, 0))(
        params, jnp.zeros((number, 2), real), size
    )
    slots = Slots(state, size, 0 * size, none, none, none, none, none - 1, jnp.zeros(number, bool))
    grid = None
    if features.detect:
        grid = Grid(jnp.zeros((3, *features.cells), real), jnp.zeros((), jnp.int32))
    return Carry(slots, grid, jnp.asarray(len(features.seed), jnp.int32))


def _shifted(slots: Slots, elapsed: Array) -> Slots:
    """The same with times since a later chunk's start; at most so far back that int32 lasts."""

    def shift(t):
        return jnp.maximum(t - elapsed, -2 * LONGEST)

    times = lambda s: (s.last, s.heard, s.born, s.apart)  # noqa: E731
    return eqx.tree_at(times, slots, tuple(shift(t) for t in times(slots)))


def _limits(params: Params, slots: Slots) -> Int[Array, " targets"]:
    """Us of silence that end each track."""
    limit = jnp.where(slots.confirmed, params.t_coast, params.t_tentative)
    us = jnp.minimum(jnp.round(lax.stop_gradient(limit) * 1e6), 2 * LONGEST).astype(jnp.int32)
    return jnp.where(slots.id >= 0, us, -4 * LONGEST)


def _sown(params: Params, features: Features, due: Array, slots: Slots) -> Slots:
    """Seed number k begins in slot k."""
    seeds, number = len(features.seed), len(slots.id)
    if seeds == 0:
        return slots
    due = jnp.pad(due, (0, number - seeds))
    size = jnp.where(features.seed_size > 0, features.seed_size, params.lambda0)
    size = jnp.concatenate(
        [size, jnp.broadcast_to(params.lambda0, number - seeds)]
    ).astype(features.xi.dtype)  # fmt: skip
    xi = jnp.pad(features.seed_xi, ((0, number - seeds), (0, 0)))
    ids = jnp.arange(number, dtype=jnp.int32)
    return lax.cond(
        due.any(),
        lambda s: _started(params, s, due, xi, size, jnp.zeros((), jnp.int32), ids, True),
        lambda s: s,
        slots,
    )


def _counted(params: Params, grid: Grid, stop: Array, t: Array, xi: Array, stray: Array) -> Grid:
    """The grid at a chunk's end, with its unassociated events."""
    tau, real = params.tau_birth, xi.dtype
    _, rows, columns = grid.sums.shape
    kept = jnp.exp(-seconds(stop - grid.time, xi) / tau)
    weight = jnp.where(stray, jnp.exp(-seconds(stop - t, xi) / tau), 0).ravel()
    x, y = xi[..., 0].ravel(), xi[..., 1].ravel()
    column = jnp.clip(x / params.cell, 0, columns - 1).astype(jnp.int32)
    row = jnp.clip(y / params.cell, 0, rows - 1).astype(jnp.int32)
    values = jnp.stack([weight, weight * x, weight * y])
    sums = (grid.sums * kept).reshape(3, -1).at[:, row * columns + column].add(values)
    return Grid(sums.reshape(grid.sums.shape).astype(real), stop)


def _around(counts: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Sums over 3x3 cells."""
    a = jnp.pad(counts, 1)
    a = a[:-2] + a[1:-1] + a[2:]
    return a[:, :-2] + a[:, 1:-1] + a[:, 2:]


def _born(
    params: Params, sums: Array, free: Array, next_id: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Where tracks are born: (slots, positions, ids, the grid without their events, next id).

    The cell whose 3x3 sum is largest comes first; the 5x5 cells around it are emptied.
    """
    number, (_, rows, columns) = len(free), sums.shape

    def more(loop):
        sums, which, _, _ = loop
        return (free & ~which).any() & (_around(sums[0]).max() > params.n_birth)

    def one(loop):
        sums, which, xi, ids = loop
        place = jnp.argmax(_around(sums[0]))
        row, column = place // columns, place % columns
        near = lax.dynamic_slice(
            jnp.pad(sums, ((0, 0), (1, 1), (1, 1))), (0, row, column), (3, 3, 3)
        ).sum((1, 2))
        centre = near[1:] / near[0]
        slot = jnp.arange(number) == jnp.argmax(free & ~which)
        here = (abs(jnp.arange(rows) - row) <= 2)[:, None] & (
            abs(jnp.arange(columns) - column) <= 2
        )
        ids = jnp.where(slot, next_id + which.sum(), ids).astype(jnp.int32)
        return jnp.where(here, 0, sums), which | slot, jnp.where(slot[:, None], centre, xi), ids

    none = jnp.zeros(number, bool)
    start = (sums, none, jnp.zeros((number, 2), sums.dtype), jnp.zeros(number, jnp.int32))
    sums, which, xi, ids = lax.while_loop(more, one, start)
    return which, xi, ids, sums, next_id + which.sum().astype(jnp.int32)


def _cycle(params: Params, features: Features, stop: Array, carry: Carry) -> tuple[Carry, Log]:
    """Confirmations, deaths, mergers and births at a chunk's end."""
    slots, fixed = carry.slots, lax.stop_gradient(params)
    real = slots.gate.dtype
    blob = filter_of(params)
    alive = slots.id >= 0
    dt = jnp.where(alive, seconds(jnp.maximum(stop - slots.last, 0), slots.gate), 0)
    state = lax.stop_gradient(slots.state)
    now = jax.vmap(blob.expected, (None, 0))(
        fixed, jax.vmap(blob.predict, (None, 0, 0))(fixed, state, dt)
    )
    age = seconds(stop - slots.born, slots.gate)
    enough = (slots.hits >= fixed.n_confirm) & (age >= fixed.t_confirm)

    finite = jnp.ones_like(alive)
    for leaf in jax.tree.leaves((now, slots.state)):
        finite &= jnp.isfinite(leaf.reshape(len(alive), -1)).all(1)
    long, short = now.size.max(-1), now.size.min(-1)
    limits = _limits(params, slots)
    apart = ((now.p[:, None] - now.p) ** 2).sum(-1) > long**2  # of target i from target j
    older = alive & (slots.id < slots.id[:, None])
    inside = (older & ~apart).any(1)
    confirmed = slots.confirmed | (alive & enough & ~inside)
    since = jnp.where(inside, slots.apart, stop)
    patience = jnp.where(confirmed, fixed.t_merge, fixed.t_tentative / 2)
    merged = jnp.where(
        confirmed, seconds(stop - since, slots.gate) >= patience, inside & (age >= patience)
    )
    found = jnp.arange(len(alive)) >= len(features.seed)
    one_pixel = found & (long <= 1.01 * fixed.lambda_min)  # a hot one, no blob
    outside = ((now.p < -0.5) | (now.p > features.frame - 0.5)).any(-1)
    ended = jnp.select(
        [
            ~alive,
            ~finite,
            stop - slots.heard > limits,
            ~confirmed & (age >= 2 * fixed.t_tentative),
            outside,
            one_pixel | (long >= 0.999 * fixed.lambda_max) | (long > fixed.aspect_max * short),
            _largest(now.P_p) > fixed.sigma_max**2,
            inside & merged,
        ],
        [0, 7, 1, 2, 3, 4, 5, 6],
        0,
    ).astype(jnp.int32)
    death = jnp.where(ended == 1, slots.heard + limits, stop)
    dead = ended > 0
    log = Log(slots.id, slots.id, confirmed, ended, death)

    slots = eqx.tree_at(
        lambda s: (s.id, s.confirmed, s.apart),
        slots,
        (jnp.where(dead, -1, slots.id), confirmed & ~dead, since),
    )
    nowhere = jnp.zeros((len(alive), 2), real)
    size = jnp.broadcast_to(params.lambda0, len(alive)).astype(real)
    empty = jax.vmap(blob.start, (None, 0, 0))(params, nowhere, size)
    slots = eqx.tree_at(lambda s: s.state, slots, _where(dead, empty, slots.state))
    carry = Carry(slots, carry.grid, carry.next_id)
    if carry.grid is not None:
        free = (slots.id < 0) & found
        sums = carry.grid.sums * jnp.exp(-seconds(stop - carry.grid.time, size) / fixed.tau_birth)
        which, xi, ids, sums, next_id = _born(fixed, sums.astype(real), free, carry.next_id)
        slots = _started(params, slots, which, xi, size, stop, ids, False)
        carry = Carry(slots, Grid(sums, stop), next_id)
    return carry, eqx.tree_at(lambda v: v.after, log, carry.slots.id)


def _steps(
    params: Params, wanted: str, frame: Any, slots: Slots, events: Any
) -> tuple[Slots, Step]:
    step = functools.partial(_step, params, wanted, frame, _limits(params, slots))
    return lax.scan(step, slots, events)


class Told(eqx.Module):
    """What a run tells of every chunk, as far as it was asked for."""

    log: Log
    slots: Slots | None = None  # before the first step
    association: Association | None = None
    path: tuple[Array, Array, Array] | None = None  # p, v and last update of steps + 1 moments
    loss: Array | None = None
    count: Array | None = None


def run(
    params: Params, carry: Carry, features: Features, wanted: str | None = None
) -> tuple[Carry, Told]:
    """Track through chunks. Pure; differentiable with the memory of one chunk and of its starts.

    `wanted` adds to the births and deaths that are always told: "begins" the targets at each
    chunk's start, "associations" whose each event is, "path" positions, "associated" and "all" the
    negative log-likelihood of events.
    """
    inner = wanted or ""
    features = jax.tree.map(jnp.asarray, features)

    def chunk(carry: Carry, part: Any) -> tuple[Carry, Told]:
        place, t, xi, polarity, valid, elapsed, stop, cycle = part
        slots = _sown(params, features, features.seed == place, _shifted(carry.slots, elapsed))
        before = slots
        slots, steps = _steps(params, inner, features.frame, slots, (t, xi, polarity, valid))
        grid = carry.grid
        if grid is not None:
            grid = Grid(grid.sums, jnp.maximum(grid.time - elapsed, -2 * LONGEST))
            stray = steps.unassociated
            grid = lax.cond(
                stray.any(),
                lambda g: _counted(lax.stop_gradient(params), g, stop, t, xi, stray),
                lambda g: g,
                grid,
            )
        carry = Carry(slots, grid, carry.next_id)
        none = jnp.zeros_like(slots.id)
        carry, log = lax.cond(
            cycle,
            lambda c: _cycle(params, features, stop, c),
            lambda c: (c, Log(c.slots.id, c.slots.id, c.slots.confirmed, none, none)),
            carry,
        )
        told: dict[str, Any] = {}
        if wanted == "begins":
            told["slots"] = before
        elif wanted == "associations":
            told["association"] = Association(steps.target, steps.weight)
        elif wanted == "path":
            p, v, last = _line(params, before)
            join = functools.partial(jnp.concatenate, axis=0)
            P, V, L = steps.path
            told["path"] = join([p[None], P]), join([v[None], V]), join([last[None], L])
        elif wanted in ("associated", "all"):
            told["loss"], told["count"] = steps.loss.sum(), steps.count.sum()
        return carry, Told(log, **told)

    parts = (
        jnp.arange(len(features.t), dtype=jnp.int32), features.t, features.xi, features.polarity,
        features.valid, features.elapsed, features.stop, features.cycle,
    )  # fmt: skip
    return lax.scan(jax.checkpoint(chunk), carry, parts)


def negative_log_likelihood(
    params: Params, features: Features, events: str = "associated"
) -> Float[Array, ""]:
    """Mean over events of -ln p(xi), each predicted before it is used; px^-2.

    With "associated", p sums N(xi; p^-, L L^T + P_p) over the gates that hold the event, and only
    events in a gate count: right for process noise, but a smaller gate lowers it. With "all",
    p = (1 - o) mean_i N_i(xi) + o / area, o = `outliers`, for every event and without gates: right
    for gates and for whole recordings too. A loss for `jaxevent.optimise`.
    """
    _, told = run(params, begin(params, features), features, events)
    assert told.loss is not None and told.count is not None
    return told.loss.sum() / jnp.maximum(told.count.sum(), 1)


class Positions(eqx.Module):
    """A batch of `position_error`: prepared events and where the seeds' targets were."""

    features: Features
    chunk: Int[np.ndarray | Array, " times"]
    step: Int[np.ndarray | Array, " times"]  # steps of the chunk done by then
    time: Int[np.ndarray | Array, " times"]  # us since the chunk's start
    xi: Float[np.ndarray | Array, "times seeds 2"]  # px
    known: Bool[np.ndarray | Array, "times seeds"]


def position_error(params: Params, batch: Positions, scale: float | int = 10) -> Float[Array, ""]:
    """Mean of 2 s^2 (sqrt(1 + d^2 / s^2) - 1), d the distance of seeds' tracks from the truth, px.

    It is d^2 for d well below `scale` = s (px) and grows as d beyond, so that one lost target does
    not rule. Lost targets go on along their last velocity.
    """
    _, told = run(params, begin(params, batch.features), batch.features, "path")
    assert told.path is not None
    p, v, last = (part[batch.chunk, batch.step, : batch.xi.shape[1]] for part in told.path)
    dt = seconds(batch.time[:, None] - last, p)
    d2 = ((p + v * dt[..., None] - jnp.where(batch.known[..., None], batch.xi, p)) ** 2).sum(-1)
    error = 2 * scale**2 * (jnp.sqrt(1 + d2 / scale**2) - 1)
    return jnp.where(batch.known, error, 0).sum() / jnp.maximum(batch.known.sum(), 1)


def prepare(
    recording: Recording,
    params: Params | None = None,
    seeds: Sequence[Any] | np.ndarray | None = None,
    *,
    start: int | float | None = None,
    stop: int | float | None = None,
    detect: bool | None = None,
) -> Features:
    """All events of a recording, or of a part of it, packed for `run` and the losses.

    The parameters `events_per_step`, `cycle`, `cell` and those of the prefilter act here; the
    others do not. Arguments and errors as those of `track`.
    """
    return _windows(recording, params or Params.of({}), seeds, start, stop, detect).whole()


def prepare_positions(
    recording: Recording,
    params: Params,
    seeds: Sequence[Any] | np.ndarray,
    times: Times,
    positions: NDArray[np.floating],
    *,
    start: int | float | None = None,
    stop: int | float | None = None,
) -> Positions:
    """A batch for `position_error`.

    Args:
        recording: The events.
        params: As for `prepare`.
        seeds: One (x, y, size) or (x, y, size, t) for every target.
        times: Sorted, (times,).
        positions: True x and y at these times, (times, seeds, 2) in px; NaN where not known.
        start: Tracking begins there, by default at the first event.
        stop: And ends before this.

    Raises:
        InputError: Positions of another shape, times outside the part that is tracked.
    """
    windows = _windows(recording, params, seeds, start, stop, False)
    features = windows.whole()
    us = np.atleast_1d(microseconds(times))
    positions = np.asarray(positions)
    if positions.shape != (len(us), len(seeds), 2):
        raise InputError(
            f"{recording.name}: positions have shape {positions.shape}; give x and y of every "
            f"seed at every time: ({len(us)}, {len(seeds)}, 2)"
        )
    if len(us) and (us.min() < windows.start or us.max() >= windows.stop):
        raise InputError(
            f"{recording.name}: positions are given from {us.min()} to {us.max()} us, but events "
            f"are used from {windows.start} to {windows.stop - 1} us; leave out the others"
        )
    used = int(np.flatnonzero(features.cycle)[-1]) + 1  # the others fill up
    begins = windows.start + np.cumsum(features.elapsed[:used], dtype=np.int64)
    chunk = np.searchsorted(begins, us, "right") - 1
    step = _steps_done(features, chunk, us - begins[chunk])
    truth = positions[:, windows.seeds.given]
    known = np.asarray(np.isfinite(truth).all(-1))
    return Positions(
        features, chunk, step, (us - begins[chunk]).astype(np.int32),
        np.where(known[..., None], truth, 0).astype(features.xi.dtype), known,
    )  # fmt: skip


def _steps_done(features: Features, chunk: NDArray, time: NDArray) -> NDArray[np.int32]:
    """How many steps of a chunk were done by a time (us since its start)."""
    done = (np.asarray(features.t)[chunk, :, -1] <= time[:, None]) & np.asarray(features.valid)[
        chunk, :, 0
    ]
    return done.sum(1, dtype=np.int32)


def _read_seeds(
    recording: Recording, seeds: Sequence[Any] | np.ndarray | None, start: int, stop: int
) -> Seeds:
    """The user's seeds, sorted by time; raises `InputError` saying which one cannot be used."""
    times, places, sizes = [], [], []
    for number, seed in enumerate([] if seeds is None else seeds):
        name = f"{recording.name}: seed {number}"
        try:
            x, y, size, *time = seed
            x, y, size = (float(v) for v in (x, y, size))
        except (TypeError, ValueError):
            raise InputError(f"{name} is {seed!r}; give x, y, size in px, and its time") from None
        if len(time) > 1 or not (math.isfinite(size) and size > 0):
            raise InputError(
                f"{name} is {seed!r}; give x, y, a size above 0 (standard deviation, px) and, if "
                "it begins later, its time"
            )
        if not (-0.5 <= x <= recording.width - 0.5 and -0.5 <= y <= recording.height - 0.5):
            raise InputError(
                f"{name} at ({x:g}, {y:g}) is outside the {recording.width}x{recording.height} "
                "sensor; give pixel coordinates from 0"
            )
        at = int(microseconds(time[0], f"the time of seed {number}")) if time else start
        if not start <= at < stop:
            raise InputError(
                f"{name} begins at {at} us, but events are used from {start} to {stop - 1} us; "
                "integers are microseconds, floats seconds, both on the recording's clock"
            )
        times.append(at)
        places.append((x, y))
        sizes.append(size)
    given = np.argsort(times, kind="stable").astype(np.int64)
    xi = np.array(places, np.float64).reshape(-1, 2)
    return Seeds(
        np.array(times, np.int64)[given], xi[given], np.array(sizes, np.float64)[given], given
    )


def _windows(
    recording: Recording,
    params: Params,
    seeds: Sequence[Any] | np.ndarray | None,
    start: int | float | None,
    stop: int | float | None,
    detect: bool | None,
    **shape: int,
) -> Windows:
    if not len(recording.events):
        first, last = 0, 1
        if recording.frames is not None:
            first, last = int(recording.frames.t[0]), int(recording.frames.t[-1]) + 1
    else:
        first, last = int(recording.events[:1].t[0]), len(recording.events)
        last = int(recording.events[last - 1 : last].t[0]) + 1
    begin = first if start is None else int(microseconds(start, "the start"))
    end = last if stop is None else int(microseconds(stop, "the stop"))
    if end <= begin:
        raise InputError(
            f"{recording.name}: nothing to track from {begin} us to {end} us; the events reach "
            f"from {first} to {last - 1} us, integers are microseconds, floats seconds"
        )
    detect = seeds is None if detect is None else detect
    return Windows(
        recording, params, _read_seeds(recording, seeds, begin, end), begin, end,
        detect=detect, **shape,
    )  # fmt: skip


_begin = jax.jit(begin)
_run = jax.jit(run, static_argnames="wanted")


@jax.jit
def _read(
    params: Params, features: Features, begins: Slots, chunk: Array, step: Array, time: Array,
    slot: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Mean, covariance and seconds without events, (times, tracks, ...), of some slots.

    The chunk is run again from the targets at its start; a time is after `step` of its steps.
    """
    blob, f = filter_of(params), features
    before = jax.tree.map(lambda a: a[chunk], begins)
    events = f.t[chunk], f.xi[chunk], f.polarity[chunk], f.valid[chunk]
    _, steps = _steps(params, "states", f.frame, before, events)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), before, steps.slots)
    slots = jax.tree.map(lambda a: a[step[:, None], slot], path)
    time = time[:, None]
    dt = seconds(jnp.maximum(time - slots.last, 0), slots.gate)

    def one(state, dt):
        return canonical(*blob.moments(blob.predict(params, state, dt)))

    mean, covariance = jax.vmap(jax.vmap(one))(slots.state, dt)
    return mean, covariance, seconds(time - slots.heard, slots.gate)


def canonical(
    mean: Float[Array, " 8"], covariance: Float[Array, "8 8"]
) -> tuple[Float[Array, " 8"], Float[Array, "8 8"]]:
    """The same ellipse with lambda1 >= lambda2 and theta in [-pi/2, pi/2)."""
    swap = mean[5] > mean[4]
    order = jnp.array([0, 1, 2, 3, 5, 4, 6, 7])
    theta = mean[6] + jnp.where(swap, jnp.pi / 2, 0)
    theta = jnp.mod(theta + jnp.pi / 2, jnp.pi) - jnp.pi / 2
    theta = jnp.where(theta >= jnp.pi / 2, -jnp.pi / 2, theta)  # rounding
    mean = jnp.where(swap, mean[order], mean).at[6].set(theta)
    return mean, jnp.where(swap, covariance[order][:, order], covariance)


class States(NamedTuple):
    """States of tracks at some times; NaN where a track is not alive.

    `mean` holds (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad: lambda1 >= lambda2
    are standard deviations, theta in [-pi/2, pi/2) turns x towards y and is that of lambda1.
    """

    mean: NDArray[np.floating]  # (times, tracks, 8)
    covariance: NDArray[np.floating]  # (times, tracks, 8, 8)
    alive: NDArray[np.bool_]  # (times, tracks)
    idle: NDArray[np.floating]  # (times, tracks), s since the track's last event

    @property
    def theta_valid(self) -> NDArray[np.bool_]:
        """Where the blob is long enough for theta and q to mean something: lambda1 > 1.15 lambda2.

        (times, tracks).
        """
        return self.alive & (self.mean[..., 4] > THETA_RATIO * self.mean[..., 5])


class Events(NamedTuple):
    """Whose events are, one entry for each event of a stretch of the recording."""

    row: NDArray[np.int64]  # in `recording.events`
    t: NDArray[np.int64]  # us
    id: NDArray[np.int64]  # the likeliest track that holds it in its gate; -1: none
    weight: NDArray[np.floating]  # how much of the event is this track's


class Tracks:
    """Tracks of a recording: `mean, covariance, alive, idle = tracks(times)`.

    Times, arrays of shape (tracks,): `birth`, `death` (the first moment when it is no more; for a
    track that lives to the end, that of the last event + 1) and `confirmed`, int64 us. `id` are
    whole numbers that are never used again, the seeds' first and in the order given; tracks that
    were never confirmed are left out. `ended` says why: "end" of the events, "idle", "left" the
    image, "size" beyond limits, "uncertain" position, "merged" with an older one, "not finite".

    Only the targets at the start of some windows are kept. Reading tracks the windows again that
    hold the times asked for, so that memory does not grow with the recording's length.
    """

    def __init__(self, windows: Windows, params: Params, progress: bool = False):
        self.recording, self.params = windows.recording, params
        self.start, self.stop = windows.start, windows.stop
        self._windows, self._progress = windows, progress
        self._begins: list[tuple[Mark, int, Any]] = []
        self._follow()

    def __len__(self) -> int:
        return len(self.id)

    def __repr__(self) -> str:
        return f"Tracks({len(self)} of {self.recording.name}, {self.start} to {self.stop} us)"

    def __call__(
        self, times: Times, ids: Sequence[int] | NDArray[np.integer] | None = None
    ) -> States:
        """States at `times`: integers (us) or floats (s), in any order.

        What is told of a time is the prediction from the last step at or before it; with
        `events_per_step` above 1, a step has the time of its last event. `ids` chooses tracks, by
        default all. Raises `InputError` for times that are not finite and ids that do not exist.
        """
        times = np.atleast_1d(microseconds(times))
        order = np.argsort(times, kind="stable")
        parts = [states for _, states in self.batches(times[order], ids)]
        if not parts:
            return self._nothing(times, self._chosen(ids))
        back = np.argsort(order, kind="stable")
        return States(*(np.concatenate(part)[back] for part in zip(*parts, strict=True)))

    def batches(
        self, times: Times, ids: Sequence[int] | NDArray[np.integer] | None = None
    ) -> Iterator[tuple[NDArray[np.int64], States]]:
        """The same, one stretch of sorted times after another: `times, states`."""
        times = np.atleast_1d(microseconds(times))
        if (times[1:] < times[:-1]).any():
            raise InputError("times must be sorted to be read in batches; sort them")
        chosen = self._chosen(ids)
        first, end = (int(i) for i in np.searchsorted(times, [self.start, self.stop]))
        if first:
            yield times[:first], self._nothing(times[:first], chosen)
        if not len(self) and end > first:
            yield times[first:end], self._nothing(times[first:end], chosen)
            first = end
        for window, slots in self._again(times[first:end]):
            features, id = jax.device_put(window.features), np.asarray(slots.id)
            upto = end
            if window.next is not None:
                upto = int(np.searchsorted(times[:end], window.next.start))
            while first < upto:
                chunk = int(np.searchsorted(window.start, times[first], "right")) - 1
                stop = upto
                if chunk + 1 < len(window.start):
                    stop = min(stop, int(np.searchsorted(times, window.start[chunk + 1])))
                batch = times[first:stop]
                yield batch, self._in_chunk(window, features, slots, id, chunk, batch, chosen)
                first = stop
        if first < len(times):
            yield times[first:], self._nothing(times[first:], chosen)

    def events(
        self, start: int | float | None = None, stop: int | float | None = None
    ) -> Iterator[Events]:
        """Whose each event is, one window after another; events outside the tracking are left out.

        Events that the prefilter drops are not told of. Raises `InputError` for times that are not
        finite.
        """
        t0 = self.start if start is None else int(microseconds(start, "the start"))
        t1 = self.stop if stop is None else int(microseconds(stop, "the stop"))
        t0, t1 = max(t0, self.start), min(t1, self.stop)
        if t0 >= t1 or not self._begins:
            return
        mark, carry = self._begin_of(t0)
        while mark is not None and mark.start < t1:
            window = self._windows.prepare(mark)
            mark = window.next
            wanted = "associations" if mark is None or mark.start > t0 else "begins"
            carry, told = _run(self.params, carry, window.features, wanted=wanted)
            if told.association is None:
                continue
            valid = np.asarray(window.features.valid)
            t = (window.start[:, None, None] + window.features.t)[valid]
            serial = np.asarray(told.association.id)[valid]
            now = (t >= t0) & (t < t1)
            yield Events(
                window.row[valid][now], t[now], self._id_of[serial[now]],
                np.asarray(told.association.weight)[valid][now],
            )  # fmt: skip

    def _chosen(self, ids: Sequence[int] | NDArray[np.integer] | None) -> NDArray[np.int64]:
        """Places of tracks in the arrays."""
        if ids is None:
            return np.arange(len(self))
        for one in ids:
            if one not in self.id:
                raise InputError(
                    f"{self.recording.name}: there is no track {one}; there are "
                    f"{', '.join(map(str, self.id[:20])) or 'none'}"
                )
        return np.array([int(np.flatnonzero(self.id == one)[0]) for one in ids], np.int64)

    def _nothing(self, times: NDArray[np.int64], chosen: NDArray[np.int64]) -> States:
        shape, real = (len(times), len(chosen)), np.dtype(jnp.result_type(float))
        return States(
            np.full((*shape, 8), np.nan, real),
            np.full((*shape, 8, 8), np.nan, real),
            np.zeros(shape, bool),
            np.full(shape, np.nan, real),
        )

    def _in_chunk(
        self,
        window: Window,
        features: Features,
        slots: Slots,
        id: NDArray,
        chunk: int,
        times: NDArray[np.int64],
        chosen: NDArray[np.int64],
    ) -> States:
        states = self._nothing(times, chosen)
        alive = (self.birth[chosen] <= times[:, None]) & (times[:, None] < self.death[chosen])
        some = np.flatnonzero(alive.any(0))
        if not len(some):
            return states
        slot = np.argmax(id[chunk] == self._serial[chosen[some]][:, None], axis=1)
        slot = np.pad(slot, (0, -len(slot) % 8))
        since = times - window.start[chunk]
        step = _steps_done(window.features, np.full(len(times), chunk), since)
        mask = alive[:, some]
        for first in range(0, len(times), READS):
            part = slice(first, first + READS)
            fill = (0, READS - len(times[part]))
            read = _read(
                self.params,
                features,
                slots,
                np.int32(chunk),
                np.pad(step[part], fill),
                np.pad(since[part], fill).astype(np.int32),
                slot,
            )
            now = mask[part]
            for out, value in zip((states.mean, states.covariance, states.idle), read, strict=True):
                value = np.asarray(value)[: len(now), : len(some)]
                seen = now.reshape(*now.shape, *[1] * (value.ndim - 2))
                out[part, some] = np.where(seen, value, np.nan)
        states.alive[:] = alive
        return states

    def _again(self, times: NDArray[np.int64]) -> Iterator[tuple[Window, Any]]:
        """The windows that hold some of the sorted times, with the targets at chunks' starts."""
        if not len(times):
            return
        mark, carry = self._begin_of(int(times[0]))
        done = 0
        while done < len(times):
            assert mark is not None
            window = self._windows.prepare(mark)
            mark = window.next
            upto = len(times) if mark is None else int(np.searchsorted(times, mark.start))
            carry, told = _run(self.params, carry, window.features, wanted="begins")
            if upto > done:
                yield window, told.slots
            done = upto
            if done < len(times) and mark is not None:
                later, known = self._begin_of(int(times[done]))
                if later is not None and later.start > mark.start:
                    mark, carry = later, known

    def _begin_of(self, time: int) -> tuple[Mark | None, Any]:
        known = [(mark, carry) for mark, _, carry in self._begins if mark.start <= time]
        return known[-1]

    def _follow(self) -> None:
        """The first pass: all births and deaths, and some targets on the way."""
        birth: dict[int, int] = {k: int(t) for k, t in enumerate(self._windows.seeds.t)}
        death: dict[int, tuple[int, int]] = {}
        confirmed: dict[int, int] = dict(birth)
        rows = self._windows.rows
        nothing = rows[0] == rows[1] and not birth
        mark: Mark | None = None if nothing else self._windows.first
        carry, number, every = None, 0, 1
        logs: list[tuple[Window, Log]] = []
        with tqdm(
            total=rows[1] - rows[0], unit="event", unit_scale=True,
            delay=2, disable=not self._progress, leave=False,
        ) as bar:  # fmt: skip
            while mark is not None:
                window = self._windows.prepare(mark)
                if carry is None:
                    carry = _begin(self.params, window.features)
                if number % every == 0:
                    self._begins.append((mark, number, carry))
                    if len(self._begins) > BEGINS:
                        every *= 2
                        self._begins = [one for one in self._begins if one[1] % every == 0]
                carry, told = _run(self.params, carry, window.features, wanted="begins")
                logs.append((window, told.log))
                if len(logs) > 1:  # while this window is on the device
                    self._note(*logs.pop(0), birth, confirmed, death)
                bar.update(int(np.count_nonzero(window.features.valid)))
                mark, number = window.next, number + 1
            for one in logs:
                self._note(*one, birth, confirmed, death)
        serial = np.array(sorted(confirmed), np.int64)
        seeds, given = len(self._windows.seeds.t), self._windows.seeds.given
        public = np.arange(len(serial))
        public[:seeds] = given
        order = np.argsort(public, kind="stable")
        self._serial = serial[order]
        self.id = public[order].astype(np.int64)
        self.birth = np.array([birth[k] for k in self._serial], np.int64)
        self.confirmed = np.array([confirmed[k] for k in self._serial], np.int64)
        ends = [death.get(int(k), (self.stop, 0)) for k in self._serial]
        self.death = np.array([when for when, _ in ends], np.int64)
        self.ended = tuple(ENDS[why] for _, why in ends)
        self._id_of = np.full(max([-1, *birth]) + 2, -1)  # its last entry serves the serial -1
        self._id_of[self._serial] = self.id

    @staticmethod
    def _note(
        window: Window,
        told: Log,
        birth: dict[int, int],
        confirmed: dict[int, int],
        death: dict[int, tuple[int, int]],
    ) -> None:
        """Enter a window's births, confirmations and deaths, by serial number."""
        log = jax.tree.map(np.asarray, told)
        end = window.start + window.features.stop
        at = np.nonzero(log.confirmed & (log.before >= 0))
        for one, first in zip(*np.unique(log.before[at], return_index=True), strict=True):
            confirmed.setdefault(int(one), int(end[at[0][first]]))
        for chunk, slot in zip(*np.nonzero(log.ended), strict=True):
            when = int(window.start[chunk]) + int(log.death[chunk, slot])
            death[int(log.before[chunk, slot])] = when, int(log.ended[chunk, slot])
        new = (log.after >= 0) & (log.after != log.before)
        for chunk, slot in zip(*np.nonzero(new), strict=True):
            birth.setdefault(int(log.after[chunk, slot]), int(end[chunk]))


def track(
    recording: Recording,
    params: Params | None = None,
    seeds: Sequence[Any] | np.ndarray | None = None,
    *,
    start: int | float | None = None,
    stop: int | float | None = None,
    detect: bool | None = None,
    progress: bool = False,
) -> Tracks:
    """Track the blobs of a recording.

    Args:
        recording: Events; frames are not needed.
        params: See `Params`.
        seeds: Where targets are, one (x, y, size) or (x, y, size, t) for each: the pixel, about
            twice the standard deviation of its events in px, and when the track begins (int us or
            float s on the recording's clock; by default at `start`). They are confirmed at once.
        start: Tracking begins there, by default at the first event.
        stop: And ends before this, by default after the last event.
        detect: Whether tracks are born where events belong to none; by default only without seeds.
        progress: Show a bar on stderr.

    Raises:
        InputError: A seed is outside the sensor or the time, or there is no time to track.
    """
    params = params or Params.of({})
    return Tracks(_windows(recording, params, seeds, start, stop, detect), params, progress)
