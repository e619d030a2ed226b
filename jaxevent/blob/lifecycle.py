"""Births and deaths of tracks: events in nobody's gate are counted on a coarse grid.

At the end of every cycle tracks are confirmed, end and merge, and new ones begin where unassociated
events were many. After jAER's RectangularClusterTracker.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.association import Expected, largest_eigenvalue
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import LONGEST, Features, Numeric
from jaxevent.blob.steps import Filter, choose
from jaxevent.blob.targets import (
    Slots,
    begin_slots,
    own_params,
    predict,
    seconds,
    shift_slots,
    silence_limits,
    start_memory,
    start_states,
)

ENDS = ("end", "idle", "unconfirmed", "left", "size", "uncertain", "merged", "not finite")


class Grid(eqx.Module):
    """Unassociated events, exponentially forgotten: number and sums of x and y in each cell."""

    sums: Float[Array, "3 rows columns"]
    time: Int[Array, ""]  # us since the chunk's start


class State(eqx.Module):
    """What is carried from chunk to chunk."""

    slots: Slots
    grid: Grid | None
    next_id: Int[Array, ""]


class Log(eqx.Module):
    """Births and deaths of a chunk, or of several, by slot; -1 where no track."""

    before: Int[Numeric, "*chunks targets"]
    after: Int[Numeric, "*chunks targets"]
    confirmed: Bool[Numeric, "*chunks targets"]
    ended: Int[Numeric, "*chunks targets"]  # why, see ENDS; 0: it goes on
    death: Int[Numeric, "*chunks targets"]  # us since the chunk's start


def begin(filter: Filter, params: TrackerParams, features: Features) -> State:
    """No track yet."""
    real = features.xi.dtype
    number = max(len(features.seed) + (params.max_targets if features.detect else 0), 1)
    own = {} if not len(features.seed) else jax.tree.map(jnp.asarray, features.own)
    none = jnp.zeros(number, jnp.int32)
    size = jnp.broadcast_to(params.lambda0, number).astype(real)
    state = start_states(filter, params, own, jnp.zeros((number, 2), real), size)
    free = jnp.zeros(number, bool)
    memory = start_memory(params, none, real)
    slots = Slots(state, size, 0 * size, none, none, none, none, none - 1, free, own, memory)
    grid = None
    if features.detect:
        grid = Grid(jnp.zeros((3, *features.cells), real), jnp.zeros((), jnp.int32))
    return State(slots, grid, jnp.asarray(len(features.seed), jnp.int32))


def shift(state: State, elapsed: Array) -> State:
    """The same with times since a later moment; at most so far back that int32 lasts."""
    grid = state.grid
    if grid is not None:
        grid = Grid(grid.sums, jnp.maximum(grid.time - elapsed, -2 * LONGEST))
    return State(shift_slots(state.slots, elapsed), grid, state.next_id)


def sow(
    filter: Filter, params: TrackerParams, features: Features, due: Array, slots: Slots
) -> Slots:
    """Seed number k begins in slot k, of the seeds that are `due`."""
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
    now = jnp.zeros((), jnp.int32)
    return lax.cond(
        due.any(),
        lambda s: begin_slots(filter, params, s, due, xi, size, now, ids, True),
        lambda s: s,
        slots,
    )


def count_strays(
    params: TrackerParams, grid: Grid, stop: Array, t: Array, xi: Array, stray: Array
) -> Grid:
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


def _find_births(
    params: TrackerParams, sums: Array, free: Array, next_id: Array
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


def expect(filter: Filter, params: TrackerParams, slot: Slots, stop: Array) -> Expected:
    """What one target expects at a chunk's end."""
    params = own_params(params, slot.own)
    dt = jnp.where(slot.id >= 0, seconds(jnp.maximum(stop - slot.last, 0), slot.gate), 0)
    return filter.predicted_measurement(
        params, predict(filter, params, lax.stop_gradient(slot.state), dt)
    )


class Verdict(eqx.Module):
    """What becomes of a target at a chunk's end."""

    confirmed: Bool[Array, "*targets"]
    ended: Int[Array, "*targets"]  # why, see ENDS; 0: it goes on
    death: Int[Array, "*targets"]  # us since the chunk's start
    apart: Int[Array, "*targets"]


def judge(
    params: TrackerParams,
    frame: Array,
    slot: Slots,
    now: Expected,
    inside: Array,
    found: Array,
    stop: Array,
) -> Verdict:
    """Whether one target is confirmed and whether it ends.

    `now` is what it expects, `inside` whether it is within one lambda of an older one, `found`
    whether it is no seed. With `association = "authors"` a track ends by silence only.
    """
    alive = slot.id >= 0
    age = seconds(stop - slot.born, slot.gate)
    enough = (slot.hits >= params.n_confirm) & (age >= params.t_confirm)
    finite = jnp.ones_like(alive)
    for leaf in jax.tree.leaves((now, slot.state)):
        finite &= jnp.isfinite(leaf).all()
    long, short = now.size.max(), now.size.min()
    limit = silence_limits(params, slot)
    confirmed = slot.confirmed | (alive & enough & ~inside)
    since = jnp.where(inside, slot.apart, stop)
    patience = jnp.where(confirmed, params.t_merge, params.t_tentative / 2)
    merged = jnp.where(
        confirmed, seconds(stop - since, slot.gate) >= patience, inside & (age >= patience)
    )
    one_pixel = found & (long <= 1.01 * params.lambda_min)  # a hot one, no blob
    outside = ((now.p < -0.5) | (now.p > frame - 0.5)).any()
    ended = jnp.select(
        [
            ~alive,
            ~finite,
            stop - slot.heard > limit,
            ~confirmed & (age >= 2 * params.t_tentative),
            outside,
            one_pixel | (long >= 0.999 * params.lambda_max) | (long > params.aspect_max * short),
            largest_eigenvalue(now.P_p) > params.sigma_max**2,
            inside & merged,
        ],
        [0, 7, 1, 2, 3, 4, 5, 6],
        0,
    ).astype(jnp.int32)
    if params.association == "authors":
        ended = jnp.where((ended >= 3) & (ended <= 6), 0, ended)
    return Verdict(confirmed, ended, jnp.where(ended == 1, slot.heard + limit, stop), since)


def _judge(
    filter: Filter, params: TrackerParams, features: Features, stop: Array, slots: Slots
) -> tuple[Log, Array]:
    """Which tracks are confirmed and which end at a chunk's end; and when each was last apart."""
    now = jax.vmap(functools.partial(expect, filter, params), (0, None))(slots, stop)
    apart = ((now.p[:, None] - now.p) ** 2).sum(-1) > now.size.max(-1) ** 2  # target i from j
    older = (slots.id >= 0) & (slots.id < slots.id[:, None])
    inside = (older & ~apart).any(1)
    found = jnp.arange(len(slots.id)) >= len(features.seed)
    frame = jnp.asarray(features.frame)
    of_one = jax.vmap(functools.partial(judge, params, frame), (0, 0, 0, 0, None))
    told = of_one(slots, now, inside, found, stop)
    return Log(slots.id, slots.id, told.confirmed, told.ended, told.death), told.apart


def end_cycle(
    filter: Filter, params: TrackerParams, features: Features, stop: Array, state: State
) -> tuple[State, Log]:
    """Confirmations, deaths, mergers and births at a chunk's end."""
    fixed = lax.stop_gradient(params)
    log, since = _judge(filter, fixed, features, stop, state.slots)
    dead = jnp.asarray(log.ended) > 0
    slots: Any = eqx.tree_at(
        lambda s: (s.id, s.confirmed, s.apart),
        state.slots,
        (jnp.where(dead, -1, log.before), log.confirmed & ~dead, since),
    )
    real = slots.gate.dtype
    size = jnp.broadcast_to(params.lambda0, len(dead)).astype(real)
    nowhere = jnp.zeros((len(dead), 2), real)
    empty = start_states(filter, params, slots.own, nowhere, size)
    slots = eqx.tree_at(lambda s: s.state, slots, jax.vmap(choose)(dead, empty, slots.state))
    state = State(slots, state.grid, state.next_id)
    if state.grid is not None:
        free = (slots.id < 0) & (jnp.arange(len(dead)) >= len(features.seed))
        sums = state.grid.sums * jnp.exp(-seconds(stop - state.grid.time, size) / fixed.tau_birth)
        which, xi, ids, sums, next_id = _find_births(fixed, sums.astype(real), free, state.next_id)
        slots = begin_slots(filter, params, slots, which, xi, size, stop, ids, False)
        state = State(slots, Grid(sums, stop), next_id)
    return state, eqx.tree_at(lambda v: v.after, log, state.slots.id)
