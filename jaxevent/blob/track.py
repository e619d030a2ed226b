"""Tracks of one moment, and one step of events: predict, gate, associate, update.

Events are taken in steps of M. In each step every track is predicted to the step's time, events
inside its gate are divided among the tracks and update them. The steps of a `Filter` are of one
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

from jaxevent.blob.authors import (
    ReferenceEvent,
    ReferenceState,
    nearest_target,
    reference_step,
    update_reference_state,
)
from jaxevent.blob.filter import EventBatch, Filter, gate_radius, where_tree
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import MAX_CHUNK_US
from jaxevent.estimator import Estimate

P = TypeVar("P", bound=TrackerParams)

MIN_THETA_AXIS_RATIO = 1.15  # lambda1 / lambda2 from which theta is defined well enough


class TrackBuffer(eqx.Module):
    """Tracks of one moment in a buffer of fixed capacity; times are us since the chunk's start.

    Attributes:
        state: States of the filter at the last updates, with a leading axis of targets.
        gate: Radius of the gate, px, before the position's uncertainty is added.
        hits: Number of events, by weight.
        last_update: Time of the last update.
        last_hit: Time of the last step with half an event or more.
        birth: Time of birth.
        last_apart: Time at which the track was last more than a lambda away from all older tracks.
        id: Serial number; -1: the entry is free.
        confirmed: Whether the track is confirmed.
        overrides: `raw` parameters of single targets, by name.
        reference: Association state, of `association = "authors"`.
    """

    state: Any
    gate: Float[Array, "*targets"]
    hits: Float[Array, "*targets"]
    last_update: Int[Array, "*targets"]
    last_hit: Int[Array, "*targets"]
    birth: Int[Array, "*targets"]
    last_apart: Int[Array, "*targets"]
    id: Int[Array, "*targets"]
    confirmed: Bool[Array, "*targets"]
    overrides: dict[str, Float[Array, "*targets"]]
    reference: ReferenceState | None = None


class NewTracks(eqx.Module):
    """Tracks that may begin, one for each entry of the buffer.

    Attributes:
        begins: Whether a track begins in this entry.
        xi: Position, px.
        size: Size, px.
        id: Serial number.
    """

    begins: Bool[Array, " targets"]
    xi: Float[Array, "targets 2"]
    size: Float[Array, " targets"]
    id: Int[Array, " targets"]


class StepEvents(eqx.Module):
    """The events of one step, with the tracks that may own them.

    Attributes:
        time: Time of the step, us since the chunk's start.
        batch: The M events.
        valid: Whether an event is real rather than padding.
        owner: Serial numbers of tracks that may own each event; None: any track.
    """

    time: Int[Array, ""]
    batch: EventBatch
    valid: Bool[Array, " M"]
    owner: Int[Array, "M 2"] | None


class StepInfo(eqx.Module):
    """Report of one step; fields that were not requested are None.

    Attributes:
        unassociated: Whether an event belongs to no track.
        tracks: The tracks after the step.
        target: (M,) serial number of each event's likeliest track.
        weight: (M,) weight of the event for this track.
        path: See `positions`.
        loss: Sum of the losses of the events that count.
        count: Number of events that count.
    """

    unassociated: Bool[Array, " M"]
    tracks: Any = None
    target: Any = None
    weight: Any = None
    path: Any = None
    loss: Any = None
    count: Any = None


class TrackPrediction(eqx.Module):
    """A track at a step's time, before its events, with its gate and likelihoods.

    Attributes:
        state: Predicted state of the filter.
        alive: Whether the track is alive.
        radius: Radius of the gate, px.
        inside: Whether an event is inside the gate.
        near: Whether an event is too near to begin another track.
        log_likelihood: ln(2 pi p) of the events.
    """

    state: Any
    alive: Bool[Array, "*targets"]
    radius: Float[Array, "*targets"]
    inside: Bool[Array, "*targets M"]
    near: Bool[Array, "*targets M"]
    log_likelihood: Float[Array, "*targets M"]


class TrackStates(Estimate):
    """States of tracks at some times: `mean, covariance, valid = tracks(times)`.

    `mean` (times, tracks, 8) holds (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad:
    lambda1 >= lambda2 are standard deviations, theta in [-pi/2, pi/2) turns x towards y and is that
    of lambda1. `covariance` is (times, tracks, 8, 8). `valid` (times, tracks) is true where the
    track is alive; elsewhere numbers are NaN.

    Attributes:
        idle: (times, tracks), s since the track's last event.
        id: Numbers of the tracks, (tracks,) of `Tracks`, (times, tracks) of `Tracker.read`, where
            a new target may take the place of one that has ended.
    """

    idle: Any
    id: Any

    @property
    def theta_valid(self) -> Any:
        """Validity of theta and q, (times, tracks): lambda1 > 1.15 lambda2."""
        return self.valid & (self.mean[..., 4] > MIN_THETA_AXIS_RATIO * self.mean[..., 5])


def to_seconds(us: Any, like: Array) -> Array:
    """Convert integer us to s.

    Args:
        us: Times, us.
        like: Array of the type wanted.

    Returns:
        Times, s.
    """
    return us.astype(like.dtype) * 1e-6


def wrap_angle(theta: Array) -> Array:
    """Wrap an angle to [-pi, pi]."""
    return theta - 2 * jnp.pi * jnp.round(theta / (2 * jnp.pi))


def track_params(params: P, overrides: dict[str, Array]) -> P:
    """Return the parameters of one track: the common ones, with its own values in place of some.

    Args:
        params: Parameters of the tracker.
        overrides: The track's own values by name, in unconstrained form.
    """
    if not overrides:
        return params
    return eqx.tree_at(lambda one: one.raw, params, {**params.raw, **overrides})


def init_tracks(
    filter: Filter,
    params: TrackerParams,
    tracks: TrackBuffer,
    new: NewTracks,
    time: Array,
    confirmed: bool,
) -> TrackBuffer:
    """Start tracks at rest in some entries of the buffer.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: Tracks so far.
        new: Tracks to start.
        time: Start of the tracks, us since the chunk's start.
        confirmed: Whether they are confirmed at once.

    Returns:
        The tracks.
    """
    state = init_states(filter, params, tracks.overrides, new.xi, new.size)
    gate = initial_gate(params, new.size).astype(new.xi.dtype)
    at = jnp.broadcast_to(time, new.begins.shape)
    begun = TrackBuffer(
        state, gate, jnp.zeros_like(gate), at, at, at, at, new.id,
        jnp.full_like(new.begins, confirmed), tracks.overrides,
        init_reference(params, at, gate.dtype),
    )  # fmt: skip
    return jax.vmap(where_tree)(new.begins, begun, tracks)


def initial_gate(params: TrackerParams, size: Array) -> Array:
    """Return the gate's radius of new tracks.

    Args:
        params: Parameters of the tracker.
        size: Sizes of the tracks, px.

    Returns:
        Radii, px, of the shape of `size`.
    """
    if params.association == "authors":
        return jnp.broadcast_to(params.gate_min, size.shape)
    return jnp.clip(params.gate * size, params.gate_min, params.gate_max)


def init_reference(params: TrackerParams, time: Array, dtype: Any) -> ReferenceState | None:
    """Return the association state of tracks that begin, if they need one.

    Args:
        params: Parameters of the tracker.
        time: Begins of the tracks, us since the chunk's start.
        dtype: Type of real numbers.

    Returns:
        The state; None unless `association = "authors"`.
    """
    return ReferenceState.init(time, dtype) if params.association == "authors" else None


def init_states(
    filter: Filter, params: TrackerParams, overrides: dict[str, Array], xi: Array, size: Array
) -> Any:
    """Make filter states of targets at rest.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        overrides: Own values of the targets, (targets,) by name.
        xi: (targets, 2) positions, px.
        size: (targets,) sizes, px.

    Returns:
        The states, with the axis of targets first.
    """

    def init(overrides: dict[str, Array], xi: Array, size: Array) -> Any:
        return filter.init(track_params(params, overrides), xi, size)

    return jax.vmap(init)(overrides, xi, size)


def shift_times(tracks: TrackBuffer, elapsed: Array) -> TrackBuffer:
    """Count times from the start of a later chunk.

    Times that would not fit into int32 stay at the least one.
    Args:
        tracks: The tracks.
        elapsed: () time from the old chunk's start to the new one's, us.

    Returns:
        The tracks.
    """

    def shift(t):
        return jnp.maximum(t - elapsed, -2 * MAX_CHUNK_US)

    times = lambda s: (s.last_update, s.last_hit, s.birth, s.last_apart)  # noqa: E731
    tracks = eqx.tree_at(times, tracks, tuple(shift(t) for t in times(tracks)))
    if tracks.reference is None:
        return tracks
    return dataclasses.replace(tracks, reference=tracks.reference.shift_times(elapsed))


def coast_limits_us(params: TrackerParams, tracks: TrackBuffer) -> Int[Array, "*targets"]:
    """Return the longest time without events before each track ends.

    Args:
        params: Parameters of the tracker.
        tracks: The tracks.

    Returns:
        Times, us.
    """
    limit = jnp.where(tracks.confirmed, params.t_coast, params.t_tentative)
    us = jnp.minimum(jnp.round(lax.stop_gradient(limit) * 1e6), 2 * MAX_CHUNK_US).astype(jnp.int32)
    return jnp.where(tracks.id >= 0, us, -4 * MAX_CHUNK_US)


def is_alive(params: TrackerParams, tracks: TrackBuffer, time: Array) -> Array:
    """Return which tracks are confirmed and not silent for too long.

    Args:
        params: Parameters of the tracker.
        tracks: The tracks.
        time: Time, us since the chunk's start.

    Returns:
        (targets,) truth values.
    """
    is_recent = time - tracks.last_hit < coast_limits_us(params, tracks)
    return (tracks.id >= 0) & tracks.confirmed & is_recent


def is_static(params: TrackerParams, dt: Array) -> Array:
    """Return whether a target is taken to stand still.

    Args:
        params: Parameters of the tracker.
        dt: Time without events, s.

    Returns:
        Truth values, of the shape of `dt`.
    """
    return (params.t_still > 0) & (dt > params.t_still)


def predict(
    filter: Filter, params: TrackerParams, state: Any, dt: Array, static: Array | None = None
) -> Any:
    """Predict one track's state `dt` seconds ahead, without events.

    After `params.t_still` seconds without events the velocity is set to zero; its covariance is
    reset to the initial one so that the target can start again.

    Args:
        filter: Filter of the target.
        params: Parameters of the target.
        state: State at the last update.
        dt: Time since then, s.
        static: Whether the target stands still; None: decided by `dt`.

    Returns:
        The predicted state.
    """
    static = is_static(params, dt) if static is None else static
    state = where_tree(static, filter.zero_velocity(params, state, True), state)
    state = filter.predict(params, state, dt)
    return where_tree(static, filter.zero_velocity(params, state, False), state)


def positions(
    filter: Filter, params: TrackerParams, tracks: TrackBuffer
) -> tuple[Array, Array, Array]:
    """Return position, velocity and time of the last update of all tracks.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: The tracks.

    Returns:
        Positions (targets, 2), px, velocities (targets, 2), px/s, and times (targets,), us since
        the chunk's start.
    """

    def measure(track: TrackBuffer) -> Any:
        return filter.predicted_measurement(track_params(params, track.overrides), track.state)

    now = jax.vmap(measure)(tracks)
    return now.p, now.v, tracks.last_update


def predict_and_gate(
    filter: Filter, params: TrackerParams, track: TrackBuffer, limit: Array, events: StepEvents
) -> TrackPrediction:
    """Predict one track to the step's time and gate the step's events.

    Gating and ownership have no derivative; the predicted state and the log-likelihoods have.

    Args:
        filter: Filter of the target.
        params: Parameters of the tracker.
        track: One track of the buffer, at its last update.
        limit: Longest time without events before the track ends, us.
        events: The M events of the step.

    Returns:
        The predicted state, the gate, and for each event whether it is inside and its likelihood.
    """
    params = track_params(params, track.overrides)
    time, batch = events.time, events.batch
    alive = time - track.last_hit <= limit
    dt = jnp.where(alive, to_seconds(jnp.maximum(time - track.last_update, 0), batch.xi), 0)
    state = predict(filter, params, track.state, dt)
    predicted = filter.predicted_measurement(params, state)
    e = batch.xi - (predicted.p - predicted.v * batch.age[:, None])
    log_likelihood = jax.vmap(filter.log_likelihood, (None, None, 0))(params, predicted, e)

    fixed, now, residual = lax.stop_gradient((params, predicted, e))
    radius = gate_radius(fixed, track.gate, now.size.max(), dt)
    gates = jax.vmap(filter.gate, (None, None, None, 0))
    inside = gates(fixed, now, radius, residual)
    if events.owner is not None:
        # A single possible owner takes the event outside its gate too.
        inside = (events.owner == track.id).any(1) & (inside | (events.owner[:, 1] < 0))
    inside &= alive & events.valid
    near = gates(fixed, now, jnp.maximum(fixed.surround, 1) * radius, residual) & alive
    return TrackPrediction(state, alive, radius, inside, near, log_likelihood)


def update_track(
    filter: Filter,
    params: TrackerParams,
    track: TrackBuffer,
    prediction: TrackPrediction,
    events: StepEvents,
    weight: Array,
) -> TrackBuffer:
    """Update one track with the step's events.

    Args:
        filter: Filter of the target.
        params: Parameters of the tracker.
        track: The track at its last update.
        prediction: Its prediction at the step's time.
        events: The M events of the step.
        weight: (M,) weights of the events for this track, 0 to 1.

    Returns:
        The track; unchanged if all weights are 0.
    """
    params = track_params(params, track.overrides)
    touched = (weight > 0).any()
    number = lax.stop_gradient(weight).sum()
    updated = filter.update(params, prediction.state, events.batch, weight)
    return dataclasses.replace(
        track,
        state=where_tree(touched, updated, track.state),
        gate=jnp.where(touched, prediction.radius, track.gate),
        hits=track.hits + number,
        last_update=jnp.where(touched, events.time, track.last_update),
        last_hit=jnp.where(number >= 0.5, events.time, track.last_hit),
    )


def _update_nearest_track(
    filter: Filter,
    params: TrackerParams,
    tracks: TrackBuffer,
    prediction: TrackPrediction,
    events: StepEvents,
) -> tuple[TrackBuffer, TrackPrediction, Array]:
    """Update all tracks with the one event of a step as `authors` does.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: The tracks.
        prediction: Their predictions at the step's time.
        events: The one event.

    Returns:
        The tracks, their predictions, and the weights (targets, 1) of the event.
    """
    time, batch, valid = events.time, events.batch, events.valid
    p, _, _ = positions(filter, params, lax.stop_gradient(tracks))
    k = nearest_target(p, prediction.alive, batch.xi[0])
    track = jax.tree.map(lambda a: a[k], tracks)
    # The first event is at the time of the start.
    since = jnp.where(track.hits > 0, to_seconds(time - track.last_update, batch.xi), 0)
    own = track_params(params, track.overrides)
    event = ReferenceEvent(batch, time, since)
    result = reference_step(filter, own, track.state, track.gate, track.reference, event)
    new = dataclasses.replace(
        track,
        state=result.state,
        gate=result.radius,
        hits=track.hits + result.accepted,
        last_update=jnp.where(result.updated, time, track.last_update),
        last_hit=jnp.where(result.accepted, time, track.last_hit),
        reference=result.reference,
    )
    hit = (jnp.arange(len(tracks.id)) == k) & prediction.alive & valid[0]
    after = jax.vmap(where_tree, (0, None, 0))(hit, new, tracks)

    def update(track: TrackBuffer) -> ReferenceState:
        assert track.reference is not None
        own = track_params(params, track.overrides)
        return update_reference_state(filter, own, track.state, track.reference, time)

    reference = where_tree(valid[0], jax.vmap(update)(after), after.reference)
    inside = (hit & result.accepted)[:, None]
    prediction = dataclasses.replace(prediction, inside=inside)
    weight = inside.astype(batch.xi.dtype)
    return dataclasses.replace(after, reference=reference), prediction, weight


def _update_tracks(
    filter: Filter, params: TrackerParams, tracks: TrackBuffer, limit: Array, events: StepEvents
) -> tuple[TrackBuffer, TrackPrediction, Array]:
    """Predict, gate, associate and update all tracks.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: The tracks.
        limit: (targets,) longest times without events, us, of `coast_limits_us`.
        events: The M events of a step.

    Returns:
        The tracks, their predictions, and the weights (targets, M) of the events.
    """
    predict = functools.partial(predict_and_gate, filter, params)
    prediction = jax.vmap(predict, (0, 0, None))(tracks, limit, events)
    if params.association == "authors":
        return _update_nearest_track(filter, params, tracks, prediction, events)
    weights = jax.vmap(functools.partial(filter.association_weights, params), 1, 1)
    weight = weights(prediction.inside, prediction.log_likelihood)
    update = functools.partial(update_track, filter, params)
    tracks = jax.vmap(update, (0, 0, None, 0))(tracks, prediction, events, weight)
    return tracks, prediction, weight


def _loss(
    params: TrackerParams, output: str, frame: Any, prediction: TrackPrediction, valid: Array
) -> tuple[Array, Array]:
    """Add up the negative log likelihood of a step's events.

    Args:
        params: `outliers`, the fraction of events that belong to no target.
        output: "associated": events inside a gate count; "all": every event.
        frame: Width and height of the sensor, px.
        prediction: Prediction of all tracks.
        valid: (M,) whether an event is real rather than padding.

    Returns:
        The sum of -ln p, and the number of events that count.
    """
    log_p = prediction.log_likelihood - math.log(2 * math.pi)
    alive = prediction.alive[:, None] & valid
    if output == "associated":
        counted = prediction.inside.any(0)
        log_p = jnp.where(prediction.inside, log_p, -jnp.inf)
    else:
        counted = valid
        log_p = jnp.where(alive, log_p, -jnp.inf)
        number = prediction.alive.sum()
        clutter = jnp.where(number > 0, params.outliers, 1)
        targets = log_p + jnp.log1p(-params.outliers) - jnp.log(jnp.maximum(number, 1))
        clutter = jnp.broadcast_to(jnp.log(clutter / frame.prod()), valid.shape)
        log_p = jnp.concatenate([targets, clutter[None]])
    log_p = jnp.where(counted, log_p, 0)
    loss = -jnp.where(counted, jax.nn.logsumexp(log_p, axis=0), 0).sum()
    return loss, counted.sum().astype(log_p.dtype)


def run_steps(
    filter: Filter,
    params: TrackerParams,
    tracks: TrackBuffer,
    events: Any,
    output: str | None,
    frame: Any,
) -> tuple[TrackBuffer, StepInfo]:
    """Run all steps of a chunk.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: Tracks at the chunk's start.
        events: Times, positions, polarities, validity and owners of the chunk, see `Features`.
        output: Fields to report: "states" the tracks, "path" their positions, "associated" or "all"
            the loss of events; None: the likeliest track of each event.
        frame: Width and height of the sensor, px.

    Returns:
        The tracks at the chunk's end, and the reports of all steps.
    """
    limits = coast_limits_us(params, tracks)

    def step(tracks: TrackBuffer, part: Any) -> tuple[TrackBuffer, StepInfo]:
        times, xi, polarity, valid, owner = part
        # A single event's age is 0 for the compiler too, which then omits its products.
        age = to_seconds(times[-1] - times, xi) if len(times) > 1 else jnp.zeros_like(xi[:, 0])
        events = StepEvents(times[-1], EventBatch(xi, age, polarity), valid, owner)
        tracks, prediction, weight = _update_tracks(filter, params, tracks, limits, events)
        info: dict[str, Any] = {}
        if output is None:
            best = jnp.argmax(weight, axis=0)
            top = weight.max(0)
            info["target"], info["weight"] = jnp.where(top > 0, tracks.id[best], -1), top
        elif output == "states":
            info["tracks"] = tracks
        elif output == "path":
            info["path"] = positions(filter, params, tracks)
        else:
            info["loss"], info["count"] = _loss(params, output, frame, prediction, valid)
        return tracks, StepInfo(valid & ~prediction.near.any(0), **info)

    return lax.scan(step, tracks, events)


def canonical_ellipse(
    mean: Float[Array, " 8"], covariance: Float[Array, "8 8"]
) -> tuple[Float[Array, " 8"], Float[Array, "8 8"]]:
    """Describe an ellipse with lambda1 >= lambda2 and theta in [-pi/2, pi/2).

    Args:
        mean: State, as of `TrackStates`.
        covariance: Its covariance.

    Returns:
        Both, of the same ellipse.
    """
    swap = mean[5] > mean[4]
    order = jnp.array([0, 1, 2, 3, 5, 4, 6, 7])
    theta = mean[6] + jnp.where(swap, jnp.pi / 2, 0)
    theta = jnp.mod(theta + jnp.pi / 2, jnp.pi) - jnp.pi / 2
    theta = jnp.where(theta >= jnp.pi / 2, -jnp.pi / 2, theta)  # rounding
    mean = jnp.where(swap, mean[order], mean).at[6].set(theta)
    return mean, jnp.where(swap, covariance[order][:, order], covariance)


def readout(
    filter: Filter, params: TrackerParams, track: TrackBuffer, time: Array
) -> tuple[Array, Array, Array]:
    """Read out one track at a time.

    Args:
        filter: Filter of the target.
        params: Parameters of the tracker.
        track: The track at its last update.
        time: Time, us since the chunk's start.

    Returns:
        Mean (8,) and covariance (8, 8) in the order of `TrackStates`, and s since the last event.
    """
    params = track_params(params, track.overrides)
    dt = to_seconds(jnp.maximum(time - track.last_update, 0), track.gate)
    state = predict(filter, params, track.state, dt)
    mean, covariance = canonical_ellipse(*filter.readout(params, state))
    return mean, covariance, to_seconds(time - track.last_hit, track.gate)
