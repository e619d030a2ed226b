"""The driver of all trackers: chunks are scanned, and in each its steps. Pure."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxevent.blob.lifecycle import Log, State, begin, count_strays, end_cycle, shift, sow
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots, place, scan_steps


class Association(eqx.Module):
    """Whose the events are: the likeliest target's serial number, -1 for none, and its weight."""

    id: Int[Array, "*chunks steps M"]
    weight: Float[Array, "*chunks steps M"]


class Told(eqx.Module):
    """What a run tells of every chunk, as far as it was asked for."""

    log: Log
    slots: Slots | None = None  # before the first step; "states": of steps + 1 moments
    association: Association | None = None
    path: tuple[Array, Array, Array] | None = None  # p, v and last update of steps + 1 moments
    loss: Array | None = None
    count: Array | None = None


def run(
    filter: Filter,
    params: TrackerParams,
    state: State | None,
    features: Features,
    wanted: str | None = None,
) -> tuple[State, Told]:
    """Track through chunks. Pure; differentiable with the memory of one chunk and of its starts.

    `state` is what the run before returned; None: the recording starts here. Births and deaths are
    always told, and of `wanted` "states" the targets at each chunk's start and after each step,
    "path" their positions, "associated" and "all" the negative log-likelihood of events, None the
    targets at each chunk's start and whose each event is.
    """
    features = jax.tree.map(jnp.asarray, features)
    if state is None:
        state = begin(filter, params, features)
    parts = (
        jnp.arange(len(features.t), dtype=jnp.int32), features.t, features.xi, features.polarity,
        features.valid, features.owner, features.elapsed, features.stop, features.cycle,
    )  # fmt: skip
    chunk = functools.partial(_run_chunk, filter, params, features, wanted or "")
    return lax.scan(jax.checkpoint(chunk), state, parts)


run_compiled = jax.jit(run, static_argnames=("filter", "wanted"))


def _run_chunk(
    filter: Filter,
    params: TrackerParams,
    features: Features,
    wanted: str,
    state: State,
    part: Any,
) -> tuple[State, Told]:
    number, t, xi, polarity, valid, owner, elapsed, stop, cycle = part
    state = shift(state, elapsed)
    before = sow(filter, params, features, features.seed == number, state.slots)
    events = t, xi, polarity, valid, owner
    slots, steps = scan_steps(filter, params, wanted, features.frame, before, events)
    grid = state.grid
    if grid is not None:
        stray = steps.unassociated
        grid = lax.cond(
            stray.any(),
            lambda g: count_strays(lax.stop_gradient(params), g, stop, t, xi, stray),
            lambda g: g,
            grid,
        )
    state = State(slots, grid, state.next_id)
    none = jnp.zeros_like(slots.id)
    state, log = lax.cond(
        cycle,
        lambda s: end_cycle(filter, params, features, stop, s),
        lambda s: (s, Log(s.slots.id, s.slots.id, s.slots.confirmed, none, none)),
        state,
    )
    told: dict[str, Any] = {}
    if not wanted:
        told["slots"] = before
        told["association"] = Association(steps.target, steps.weight)
    elif wanted == "states":
        told["slots"] = jax.tree.map(_put_first, before, steps.slots)
    elif wanted == "path":
        told["path"] = jax.tree.map(_put_first, place(filter, params, before), steps.path)
    elif wanted in ("associated", "all"):
        told["loss"], told["count"] = steps.loss.sum(), steps.count.sum()
    return state, Told(log, **told)


def _put_first(one: Array, others: Array) -> Array:
    return jnp.concatenate([one[None], others], axis=0)
