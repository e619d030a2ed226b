"""The association of the authors' program (`association = "authors"`), one target at a time.

Wang, Molloy, van Goor, Mahony, "Asynchronous Blob Tracker for Event Cameras": an event goes to the
target whose last position is nearest, if it is less than the gate's radius away. What the paper
does not say is that the program

- compares events with the position after the last update, not with a prediction,
- lets the radius follow the size only where both variances of the position were small when images
  were last displayed, and counts the time from the last event that was nearest, taken or not,
- lets an event of the same time as the one before wait, and then puts all that wait, at even
  distances of time and with its polarity, in the place of the next event that it takes.

In the program all targets share one queue; here each target has its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.association import gate_radius
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import LONGEST
from jaxevent.blob.steps import Batch, Filter, choose

DISPLAY = 25_000  # us between displayed images
KNOWN = 3.0  # px^2; the radius follows the size where the position's variances are below
BLOCK = 8
WAITING = 8 * BLOCK  # most events of a target that wait; further ones are left out


class Memory(eqx.Module):
    """What a target remembers of the events so far; times are us since the chunk's start."""

    seen: Int[Array, "*targets"]  # of the last event, whoever's it was
    assigned: Int[Array, "*targets"]  # of the last event that was nearest to this target
    display: Int[Array, "*targets"]  # of the next displayed image
    adapting: Bool[Array, "*targets"]  # whether the radius follows the size
    waiting: Float[Array, "*targets n 2"]  # px, the first `number` count
    number: Int[Array, "*targets"]

    @classmethod
    def empty(cls, time: Int[Array, " targets"], dtype: Any) -> "Memory":
        """Of targets that begin at some times."""
        waiting = jnp.zeros((*time.shape, WAITING, 2), dtype)
        none = jnp.zeros_like(time)
        return cls(time - 1, time, time + DISPLAY, none > 0, waiting, none)

    def shift(self, elapsed: Array) -> "Memory":
        """The same with times since a later chunk's start."""
        times = lambda m: (m.seen, m.assigned, m.display)  # noqa: E731
        later = tuple(jnp.maximum(t - elapsed, -2 * LONGEST) for t in times(self))
        return eqx.tree_at(times, self, later)


class Taken(eqx.Module):
    """A target after an event that is nearest to it."""

    state: Any
    radius: Float[Array, ""]  # px
    memory: Memory
    accepted: Bool[Array, ""]  # whether the event is inside the gate
    updated: Bool[Array, ""]  # whether the state is of this event's time; otherwise it may wait


def take(
    filter: Filter,
    params: TrackerParams,
    state: Any,
    radius: Float[Array, ""],
    memory: Memory,
    time: Int[Array, ""],
    since: Float[Array, ""],
    batch: Batch,
) -> Taken:
    """One target after an event (`batch`) at a time, `since` seconds after its last update."""
    fixed, now = lax.stop_gradient((params, filter.predicted_measurement(params, state)))
    idle = (time - memory.assigned).astype(radius.dtype) * 1e-6
    followed = gate_radius(fixed, radius, now.size.max(), idle)
    radius = jnp.where(memory.adapting, followed, radius)
    accepted = jnp.hypot(*(batch.xi[0] - now.p)) < radius
    tied = time == memory.seen
    waits, updated = accepted & tied, accepted & ~tied

    def alone(state: Any) -> Any:
        return filter.update(params, filter.predict(params, state, since), batch, jnp.ones(1))

    def move(state: Any) -> Any:
        of_queue = lambda s: replay(filter, params, s, memory, time, since, batch)  # noqa: E731
        return lax.cond(memory.number > 0, of_queue, alone, state)

    state = lax.cond(updated, move, lambda s: s, state)
    place = jnp.where(waits, memory.number, WAITING)  # beyond the queue: nowhere
    waiting = memory.waiting.at[place].set(batch.xi[0], mode="drop")
    number = jnp.minimum(jnp.where(updated, 0, memory.number + waits), WAITING).astype(jnp.int32)
    memory = Memory(memory.seen, time, memory.display, memory.adapting, waiting, number)
    return Taken(state, radius, memory, accepted, updated)


def replay(
    filter: Filter,
    params: TrackerParams,
    state: Any,
    memory: Memory,
    time: Int[Array, ""],
    since: Float[Array, ""],
    batch: Batch,
) -> Any:
    """The state after the events that wait, which take this event's place.

    They come at even distances between the last event, whoever's it was, and this one.
    """
    whole = (time - memory.seen).astype(since.dtype) * 1e-6
    each = whole / memory.number

    def one(state: Any, part: tuple[Array, Array]) -> tuple[Any, None]:
        xi, i = part
        dt = jnp.where(i == 0, jnp.maximum(since - whole, 0) + each, each)
        new = Batch(xi[None], batch.age, batch.polarity)
        after = filter.update(params, filter.predict(params, state, dt), new, jnp.ones(1))
        return choose(i < memory.number, after, state), None

    def block(state: Any, part: tuple[Array, Array]) -> tuple[Any, None]:
        some = part[1][0] < memory.number
        return lax.cond(some, lambda s: lax.scan(one, s, part)[0], lambda s: s, state), None

    blocks = memory.waiting.reshape(-1, BLOCK, 2), jnp.arange(WAITING).reshape(-1, BLOCK)
    return lax.scan(block, state, blocks)[0]


def remember(
    filter: Filter, params: TrackerParams, state: Any, memory: Memory, time: Int[Array, ""]
) -> Memory:
    """What any target remembers after an event, of this target or not."""
    variances = jnp.diagonal(lax.stop_gradient(filter.predicted_measurement(params, state)).P_p)
    due = time >= memory.display
    adapting = jnp.where(due, (variances < KNOWN).all(), memory.adapting)
    display = memory.display + DISPLAY * due.astype(jnp.int32)
    return Memory(time, memory.assigned, display, adapting, memory.waiting, memory.number)


def nearest(p: Float[Array, "targets 2"], alive: Bool[Array, " targets"], xi: Array) -> Array:
    """The number of the target whose position is nearest to an event."""
    distance = jax.vmap(jnp.hypot)(xi[0] - p[:, 0], xi[1] - p[:, 1])
    return jnp.argmin(jnp.where(alive, distance, jnp.inf))
