"""All targets of one moment, and one step of events: predict, gate, share out, update.

Events are taken in steps of M. In each step every target predicts itself to the step's time, events
inside its gate are shared out among the targets and update them. The steps of a `Filter` are of one
target and are mapped over all of them here.
"""

import dataclasses
import functools
import math
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.association import gate_radius
from jaxevent.blob.authors import Memory, nearest, remember, take
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import LONGEST
from jaxevent.blob.steps import Batch, Filter, choose

P = TypeVar("P", bound=TrackerParams)


class Slots(eqx.Module):
    """The targets of one moment; times are us since the chunk's start."""

    state: Any  # the filter's, of the last update, with a leading axis of targets
    gate: Float[Array, "*targets"]  # px, before the position's uncertainty is added
    hits: Float[Array, "*targets"]  # events, by weight
    last: Int[Array, "*targets"]  # of the last update
    heard: Int[Array, "*targets"]  # of the last step with half an event or more
    born: Int[Array, "*targets"]
    apart: Int[Array, "*targets"]  # last found more than a lambda from all older tracks
    id: Int[Array, "*targets"]  # serial number; -1: free
    confirmed: Bool[Array, "*targets"]
    own: dict[str, Float[Array, "*targets"]]  # `raw` values, see `per_target_values`
    memory: Memory | None = None  # of `association = "authors"`


class Step(eqx.Module):
    """What one step tells: filled in as far as it was asked for."""

    unassociated: Bool[Array, " M"]
    slots: Any = None  # after it
    target: Any = None  # (M,) serial number of each event's likeliest target
    weight: Any = None  # (M,)
    path: Any = None  # see `place`
    loss: Any = None  # sum over the events that count
    count: Any = None


class Ahead(eqx.Module):
    """One target at a step's time, before its events; or all of them."""

    state: Any
    alive: Bool[Array, "*targets"]
    radius: Float[Array, "*targets"]  # of the gate, px
    inside: Bool[Array, "*targets M"]  # which events are inside the gate
    near: Bool[Array, "*targets M"]  # and which so near that they begin no other track
    density: Float[Array, "*targets M"]  # ln(2 pi p) of the events


def seconds(us: Any, like: Array) -> Array:
    """Whole us as seconds."""
    return us.astype(like.dtype) * 1e-6


def own_params(params: P, own: dict[str, Array]) -> P:
    """The parameters of one target: those of all, but for its own numbers."""
    if not own:
        return params
    return eqx.tree_at(lambda one: one.raw, params, {**params.raw, **own})


def begin_slots(
    filter: Filter,
    params: TrackerParams,
    slots: Slots,
    which: Array,
    xi: Array,
    size: Array,
    time: Array,
    ids: Array,
    confirmed: bool,
) -> Slots:
    """Tracks begin in some slots, `which` (targets,), at rest at the positions given."""
    state = start_states(filter, params, slots.own, xi, size)
    gate = start_gate(params, size).astype(xi.dtype)
    at = jnp.broadcast_to(time, which.shape)
    new = Slots(
        state, gate, jnp.zeros_like(gate), at, at, at, at, ids, jnp.full_like(which, confirmed),
        slots.own, start_memory(params, at, gate.dtype),
    )  # fmt: skip
    return jax.vmap(choose)(which, new, slots)


def start_gate(params: TrackerParams, size: Array) -> Array:
    """Radius (px) of the gate of a target of a size (px)."""
    if params.association == "authors":
        return jnp.broadcast_to(params.gate_min, size.shape)
    return jnp.clip(params.gate * size, params.gate_min, params.gate_max)


def start_memory(params: TrackerParams, time: Array, dtype: Any) -> Memory | None:
    """What targets remember that begin at some times (targets,)."""
    return Memory.empty(time, dtype) if params.association == "authors" else None


def start_states(
    filter: Filter, params: TrackerParams, own: dict[str, Array], xi: Array, size: Array
) -> Any:
    """States of targets (targets, ...) at rest at the positions given."""

    def start(own: dict[str, Array], xi: Array, size: Array) -> Any:
        return filter.start(own_params(params, own), xi, size)

    return jax.vmap(start)(own, xi, size)


def shift_slots(slots: Slots, elapsed: Array) -> Slots:
    """The same with times since a later chunk's start; at most so far back that int32 lasts."""

    def shift(t):
        return jnp.maximum(t - elapsed, -2 * LONGEST)

    times = lambda s: (s.last, s.heard, s.born, s.apart)  # noqa: E731
    slots = eqx.tree_at(times, slots, tuple(shift(t) for t in times(slots)))
    if slots.memory is None:
        return slots
    return dataclasses.replace(slots, memory=slots.memory.shift(elapsed))


def silence_limits(params: TrackerParams, slots: Slots) -> Int[Array, "*targets"]:
    """Us of silence that end each track."""
    limit = jnp.where(slots.confirmed, params.t_coast, params.t_tentative)
    us = jnp.minimum(jnp.round(lax.stop_gradient(limit) * 1e6), 2 * LONGEST).astype(jnp.int32)
    return jnp.where(slots.id >= 0, us, -4 * LONGEST)


def stands_still(params: TrackerParams, dt: Array) -> Array:
    """Whether a target without events for dt (s) stands still."""
    return (params.t_still > 0) & (dt > params.t_still)


def predict(
    filter: Filter, params: TrackerParams, state: Any, dt: Array, still: Array | None = None
) -> Any:
    """One target's state dt (s) later, without events.

    After `t_still` it stands still, and when it goes on its velocity is as unknown as at the start.
    `still` says so instead where the silence is known to last longer.
    """
    still = stands_still(params, dt) if still is None else still
    state = choose(still, filter.halt(params, state, True), state)
    state = filter.predict(params, state, dt)
    return choose(still, filter.halt(params, state, False), state)


def place(filter: Filter, params: TrackerParams, slots: Slots) -> tuple[Array, Array, Array]:
    """Position, velocity and time of the last update of all targets."""
    of_one = lambda slot: filter.expected(own_params(params, slot.own), slot.state)  # noqa: E731
    now = jax.vmap(of_one)(slots)
    return now.p, now.v, slots.last


def look_ahead(
    filter: Filter,
    params: TrackerParams,
    slot: Slots,
    limit: Array,
    time: Array,
    batch: Batch,
    valid: Array,
    owner: Array | None,
) -> Ahead:
    """One target and what it expects of the events; `limit`: us of silence that end its track."""
    params = own_params(params, slot.own)
    alive = time - slot.heard <= limit
    dt = jnp.where(alive, seconds(jnp.maximum(time - slot.last, 0), batch.xi), 0)
    state = predict(filter, params, slot.state, dt)
    expected = filter.expected(params, state)
    e = batch.xi - (expected.p - expected.v * batch.age[:, None])
    density = jax.vmap(filter.log_likelihood, (None, None, 0))(params, expected, e)

    # Which events are whose has no derivative.
    fixed, now, residual = lax.stop_gradient((params, expected, e))
    radius = gate_radius(fixed, slot.gate, now.size.max(), dt)
    gates = jax.vmap(filter.gate, (None, None, None, 0))
    inside = gates(fixed, now, radius, residual)
    if owner is not None:
        inside = (owner == slot.id).any(1) & (inside | (owner[:, 1] < 0))
    inside &= alive & valid
    near = gates(fixed, now, jnp.maximum(fixed.surround, 1) * radius, residual) & alive
    return Ahead(state, alive, radius, inside, near, density)


def update_slot(
    filter: Filter,
    params: TrackerParams,
    slot: Slots,
    ahead: Ahead,
    time: Array,
    batch: Batch,
    weight: Array,
) -> Slots:
    """One target after its events."""
    params = own_params(params, slot.own)
    touched = (weight > 0).any()
    number = lax.stop_gradient(weight).sum()
    state = choose(touched, filter.update(params, ahead.state, batch, weight), slot.state)
    return Slots(
        state,
        jnp.where(touched, ahead.radius, slot.gate),
        slot.hits + number,
        jnp.where(touched, time, slot.last),
        jnp.where(number >= 0.5, time, slot.heard),
        slot.born,
        slot.apart,
        slot.id,
        slot.confirmed,
        slot.own,
        slot.memory,
    )


def update_nearest(
    filter: Filter,
    params: TrackerParams,
    slots: Slots,
    ahead: Ahead,
    time: Array,
    batch: Batch,
    valid: Array,
) -> tuple[Slots, Ahead, Array]:
    """All targets after the one event of a step, as `authors` has it, and its weights."""
    p, _, _ = place(filter, params, lax.stop_gradient(slots))
    k = nearest(p, ahead.alive, batch.xi[0])
    slot = jax.tree.map(lambda a: a[k], slots)
    since = jnp.where(slot.hits > 0, seconds(time - slot.last, batch.xi), 0)  # the first is at 0
    own = own_params(params, slot.own)
    taken = take(filter, own, slot.state, slot.gate, slot.memory, time, since, batch)
    new = Slots(
        taken.state, taken.radius, slot.hits + taken.accepted,
        jnp.where(taken.updated, time, slot.last), jnp.where(taken.accepted, time, slot.heard),
        slot.born, slot.apart, slot.id, slot.confirmed, slot.own, taken.memory,
    )  # fmt: skip
    hit = (jnp.arange(len(slots.id)) == k) & ahead.alive & valid[0]
    after = jax.vmap(choose, (0, None, 0))(hit, new, slots)

    def memory(slot: Slots) -> Memory:
        assert slot.memory is not None
        return remember(filter, own_params(params, slot.own), slot.state, slot.memory, time)

    kept = choose(valid[0], jax.vmap(memory)(after), after.memory)
    inside = (hit & taken.accepted)[:, None]
    ahead = dataclasses.replace(ahead, inside=inside)
    return dataclasses.replace(after, memory=kept), ahead, inside.astype(batch.xi.dtype)


def step(
    filter: Filter,
    params: TrackerParams,
    wanted: str,
    frame: Any,
    limit: Array,
    slots: Slots,
    events: Any,
) -> tuple[Slots, Step]:
    """One step: predict, gate, share out, update. `limit`: us of silence that end a track."""
    times, xi, polarity, valid, owner = events
    time = times[-1]
    # A single event's is 0 for the compiler too, which leaves out what it would multiply.
    age = seconds(time - times, xi) if len(times) > 1 else jnp.zeros_like(xi[:, 0])
    batch = Batch(xi, age, polarity)
    look = functools.partial(look_ahead, filter, params)
    ahead = jax.vmap(look, (0, 0, None, None, None, None))(slots, limit, time, batch, valid, owner)
    if params.association == "authors":
        slots, ahead, weight = update_nearest(filter, params, slots, ahead, time, batch, valid)
    else:
        shares = jax.vmap(functools.partial(filter.share, params), 1, 1)
        weight = shares(ahead.inside, ahead.density)
        update = functools.partial(update_slot, filter, params)
        slots = jax.vmap(update, (0, 0, None, None, 0))(slots, ahead, time, batch, weight)

    told: dict[str, Any] = {}
    if not wanted:
        best = jnp.argmax(weight, axis=0)
        top = weight.max(0)
        told["target"], told["weight"] = jnp.where(top > 0, slots.id[best], -1), top
    elif wanted == "states":
        told["slots"] = slots
    elif wanted == "path":
        told["path"] = place(filter, params, slots)
    elif wanted in ("associated", "all"):
        told["loss"], told["count"] = _loss(params, wanted, frame, ahead, valid)
    return slots, Step(valid & ~ahead.near.any(0), **told)


def _loss(
    params: TrackerParams, events: str, frame: Any, ahead: Ahead, valid: Array
) -> tuple[Array, Array]:
    """Sum of -ln p over the events that count, see `losses`, and their number."""
    density = ahead.density - math.log(2 * math.pi)
    alive = ahead.alive[:, None] & valid
    if events == "associated":
        counted = ahead.inside.any(0)
        density = jnp.where(ahead.inside, density, -jnp.inf)
    else:
        counted = valid
        density = jnp.where(alive, density, -jnp.inf)
        number = ahead.alive.sum()
        share = jnp.where(number > 0, params.outliers, 1)
        targets = density + jnp.log1p(-params.outliers) - jnp.log(jnp.maximum(number, 1))
        stray = jnp.broadcast_to(jnp.log(share / frame.prod()), valid.shape)
        density = jnp.concatenate([targets, stray[None]])
    density = jnp.where(counted, density, 0)
    loss = -jnp.where(counted, jax.nn.logsumexp(density, axis=0), 0).sum()
    return loss, counted.sum().astype(density.dtype)


def scan_steps(
    filter: Filter, params: TrackerParams, wanted: str, frame: Any, slots: Slots, events: Any
) -> tuple[Slots, Step]:
    """The steps of a chunk."""
    limits = silence_limits(params, slots)
    return lax.scan(functools.partial(step, filter, params, wanted, frame, limits), slots, events)
