"""The association of the published program (`association = "authors"`), as a reference.

Wang, Molloy, van Goor, Mahony, "Asynchronous Blob Tracker for Event Cameras": an event goes to the
target whose last position is nearest, if it is less than the gate's radius away. The paper omits
that the program

- compares events with the position after the last update, not with a prediction,
- lets the radius follow the size only where both variances of the position were small when images
  were last displayed, and counts the time from the last event that was nearest, accepted or not,
- keeps an event with the time of the one before pending, and then puts all pending events, at even
  distances of time and with its polarity, in the place of the next event that it accepts.

In the program all targets share one queue; here each target has its own.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.filter import EventBatch, Filter, gate_radius, where_tree
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import MAX_CHUNK_US

DISPLAY_PERIOD_US = 25_000  # between displayed images
MAX_ADAPTING_VARIANCE_PX2 = (
    3.0  # px^2; the radius follows the size where the position's variances are below
)
PENDING_EVENTS_PER_BLOCK = 8  # pending events that are applied together
# Pending events of a target; further ones are left out.
MAX_PENDING_EVENTS = 8 * PENDING_EVENTS_PER_BLOCK


class ReferenceState(eqx.Module):
    """Association state of each target; times are us since the chunk's start.

    Attributes:
        last_event: Time of the last event of any target.
        last_nearest: Time of the last event that was nearest to the target.
        next_display: Time of the next display in the authors' program, which decides `is_adapting`.
        is_adapting: Whether the radius of the gate follows the size.
        pending: Positions of events that await the next update, px; the first `n_pending` count.
        n_pending: Number of these events.
    """

    last_event: Int[Array, "*targets"]
    last_nearest: Int[Array, "*targets"]
    next_display: Int[Array, "*targets"]
    is_adapting: Bool[Array, "*targets"]
    pending: Float[Array, "*targets n 2"]
    n_pending: Int[Array, "*targets"]

    @classmethod
    def init(cls, time: Int[Array, " targets"], dtype: Any) -> "ReferenceState":
        """Initialise the association state of targets.

        Args:
            time: (targets,) times at which the targets begin, us since the chunk's start.
            dtype: Type of positions.

        Returns:
            The state, without pending events.
        """
        pending = jnp.zeros((*time.shape, MAX_PENDING_EVENTS, 2), dtype)
        zero = jnp.zeros_like(time)
        return cls(time - 1, time, time + DISPLAY_PERIOD_US, zero > 0, pending, zero)

    def shift_times(self, elapsed: Array) -> "ReferenceState":
        """Count times from the start of a chunk that begins `elapsed` us later."""
        times = lambda s: (s.last_event, s.last_nearest, s.next_display)  # noqa: E731
        later = tuple(jnp.maximum(t - elapsed, -2 * MAX_CHUNK_US) for t in times(self))
        return eqx.tree_at(times, self, later)


class ReferenceStepResult(eqx.Module):
    """A target after an event that is nearest to it.

    Attributes:
        state: State of the filter.
        radius: Radius of the gate, px.
        reference: Association state of the target.
        accepted: Whether the event is inside the gate.
        updated: Whether the state is of this event's time; else the event may be pending.
    """

    state: Any
    radius: Float[Array, ""]
    reference: ReferenceState
    accepted: Bool[Array, ""]
    updated: Bool[Array, ""]


class ReferenceEvent(eqx.Module):
    """One event, and the time since a target's last update.

    Attributes:
        batch: A batch of one event.
        time: Time of the event, us since the chunk's start.
        since: Time since the target's last update, s.
    """

    batch: EventBatch
    time: Int[Array, ""]
    since: Float[Array, ""]


def reference_step(
    filter: Filter,
    params: TrackerParams,
    state: Any,
    radius: Float[Array, ""],
    reference: ReferenceState,
    event: ReferenceEvent,
) -> ReferenceStepResult:
    """Update one target with an event that is nearest to it.

    Args:
        filter: Filter of the target.
        params: Parameters of the target.
        state: State of the filter, at the last update.
        radius: Radius of the gate, px.
        reference: Association state of the target.
        event: The event.

    Returns:
        The target after the event.
    """
    time, batch = event.time, event.batch
    fixed, now = lax.stop_gradient((params, filter.predicted_measurement(params, state)))
    idle = (time - reference.last_nearest).astype(radius.dtype) * 1e-6
    following = gate_radius(fixed, radius, now.size.max(), idle)
    radius = jnp.where(reference.is_adapting, following, radius)
    accepted = jnp.hypot(*(batch.xi[0] - now.p)) < radius
    tied = time == reference.last_event
    waits, updated = accepted & tied, accepted & ~tied

    def apply_event(state: Any) -> Any:
        state = filter.predict(params, state, event.since)
        return filter.update(params, state, batch, jnp.ones(1))

    def apply(state: Any) -> Any:
        of_queue = lambda s: apply_pending(filter, params, s, reference, event)  # noqa: E731
        return lax.cond(reference.n_pending > 0, of_queue, apply_event, state)

    state = lax.cond(updated, apply, lambda s: s, state)
    index = jnp.where(waits, reference.n_pending, MAX_PENDING_EVENTS)  # beyond the queue: dropped
    pending = reference.pending.at[index].set(batch.xi[0], mode="drop")
    n_pending = jnp.where(updated, 0, reference.n_pending + waits)
    n_pending = jnp.minimum(n_pending, MAX_PENDING_EVENTS).astype(jnp.int32)
    reference = ReferenceState(
        reference.last_event, time, reference.next_display, reference.is_adapting, pending,
        n_pending,
    )  # fmt: skip
    return ReferenceStepResult(state, radius, reference, accepted, updated)


def apply_pending(
    filter: Filter,
    params: TrackerParams,
    state: Any,
    reference: ReferenceState,
    event: ReferenceEvent,
) -> Any:
    """Update a state with the pending events, which take the place of an accepted event.

    They come at even distances of time between the last event, of any target, and this one.

    Args:
        filter: Filter of the target.
        params: Parameters of the target.
        state: State of the filter, at the last update.
        reference: Association state, which holds the positions of the pending events.
        event: The accepted event; its position does not count.

    Returns:
        The state at the event's time.
    """
    batch, since = event.batch, event.since
    whole = (event.time - reference.last_event).astype(since.dtype) * 1e-6
    each = whole / reference.n_pending

    def one(state: Any, part: tuple[Array, Array]) -> tuple[Any, None]:
        xi, i = part
        dt = jnp.where(i == 0, jnp.maximum(since - whole, 0) + each, each)
        new = EventBatch(xi[None], batch.age, batch.polarity)
        after = filter.update(params, filter.predict(params, state, dt), new, jnp.ones(1))
        return where_tree(i < reference.n_pending, after, state), None

    def block(state: Any, part: tuple[Array, Array]) -> tuple[Any, None]:
        some = part[1][0] < reference.n_pending
        return lax.cond(some, lambda s: lax.scan(one, s, part)[0], lambda s: s, state), None

    blocks = (
        reference.pending.reshape(-1, PENDING_EVENTS_PER_BLOCK, 2),
        jnp.arange(MAX_PENDING_EVENTS).reshape(-1, PENDING_EVENTS_PER_BLOCK),
    )
    return lax.scan(block, state, blocks)[0]


def update_reference_state(
    filter: Filter,
    params: TrackerParams,
    state: Any,
    reference: ReferenceState,
    time: Int[Array, ""],
) -> ReferenceState:
    """Update the association state of any target after an event, of this target or not.

    Args:
        filter: Filter of the target.
        params: Parameters of the target.
        state: State of the filter, at the last update.
        reference: Association state of the target.
        time: Time of the event, us since the chunk's start.

    Returns:
        The association state after the event.
    """
    predicted = filter.predicted_measurement(params, state)
    variances = jnp.diagonal(lax.stop_gradient(predicted).P_p)
    due = time >= reference.next_display
    is_adapting = jnp.where(
        due, (variances < MAX_ADAPTING_VARIANCE_PX2).all(), reference.is_adapting
    )
    next_display = reference.next_display + DISPLAY_PERIOD_US * due.astype(jnp.int32)
    return ReferenceState(
        time, reference.last_nearest, next_display, is_adapting, reference.pending,
        reference.n_pending,
    )  # fmt: skip


def nearest_target(
    p: Float[Array, "targets 2"], alive: Bool[Array, " targets"], xi: Float[Array, " 2"]
) -> Int[Array, ""]:
    """Return the living target that is nearest to an event.

    Args:
        p: Positions of the targets, px.
        alive: Whether each target is alive.
        xi: Position of the event, px.

    Returns:
        Its index; 0 where none is alive.
    """
    distance = jax.vmap(jnp.hypot)(xi[0] - p[:, 0], xi[1] - p[:, 1])
    return jnp.argmin(jnp.where(alive, distance, jnp.inf))
