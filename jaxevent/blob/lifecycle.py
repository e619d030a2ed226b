"""Track management: clutter is counted on a coarse grid, and tracks begin and end.

At the end of every cycle tracks are confirmed, deleted and merged, and new ones begin where
unassociated events were many. After jAER's RectangularClusterTracker.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.filter import Filter, PredictedMeasurement, largest_eigenvalue, where_tree
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import MAX_CHUNK_US, Features, Numeric
from jaxevent.blob.track import (
    NewTracks,
    TrackBuffer,
    coast_limits_us,
    init_reference,
    init_states,
    init_tracks,
    predict,
    shift_times,
    to_seconds,
    track_params,
)

END_REASONS = ("end", "idle", "unconfirmed", "left", "size", "uncertain", "merged", "not finite")


class ClutterGrid(eqx.Module):
    """Sums of unassociated events per cell, forgotten exponentially.

    Attributes:
        sums: Number of events, and sums of x and of y, px.
        time: Time of the sums, us since the chunk's start.
    """

    sums: Float[Array, "3 rows columns"]
    time: Int[Array, ""]


class TrackerState(eqx.Module):
    """State of a tracker between two chunks.

    Attributes:
        tracks: The tracks.
        grid: Unassociated events; None where no track begins of them.
        next_id: Serial number of the next track.
    """

    tracks: TrackBuffer
    grid: ClutterGrid | None
    next_id: Int[Array, ""]


class LifecycleLog(eqx.Module):
    """Births, confirmations and deaths of one or several chunks, by entry of the buffer.

    Attributes:
        id_before: Serial number at the chunk's start; -1: no track.
        id_after: Serial number at its end; -1: no track.
        confirmed: Whether the track is confirmed in the chunk.
        end_reason: Index of `END_REASONS`; 0: the track goes on.
        death: Time of its end, us since the chunk's start.
    """

    id_before: Int[Numeric, "*chunks targets"]
    id_after: Int[Numeric, "*chunks targets"]
    confirmed: Bool[Numeric, "*chunks targets"]
    end_reason: Int[Numeric, "*chunks targets"]
    death: Int[Numeric, "*chunks targets"]


class TrackDecision(eqx.Module):
    """Decision on a track at a chunk's end: confirm, delete or keep.

    Attributes:
        confirmed: Whether the track is confirmed.
        end_reason: Index of `END_REASONS`; 0: the track goes on.
        death: Time of its end, us since the chunk's start.
        last_apart: Time at which it was last apart from all older tracks, us since the chunk's
            start.
    """

    confirmed: Bool[Array, "*targets"]
    end_reason: Int[Array, "*targets"]
    death: Int[Array, "*targets"]
    last_apart: Int[Array, "*targets"]


class TrackEvidence(eqx.Module):
    """Evidence on a track at a chunk's end.

    Attributes:
        predicted: Distribution of its next events.
        merging: Whether it is within one lambda of an older track.
        detected: Whether it was born of clutter, not of a seed.
    """

    predicted: PredictedMeasurement
    merging: Bool[Array, "*targets"]
    detected: Bool[Array, "*targets"]


def init_state(filter: Filter, params: TrackerParams, features: Features) -> TrackerState:
    """Return the state without any track, with room for all seeds and detected targets."""
    real = features.xi.dtype
    number = max(len(features.seed) + (params.max_targets if features.detect else 0), 1)
    overrides = {} if not len(features.seed) else jax.tree.map(jnp.asarray, features.overrides)
    zero = jnp.zeros(number, jnp.int32)
    size = jnp.broadcast_to(params.lambda0, number).astype(real)
    state = init_states(filter, params, overrides, jnp.zeros((number, 2), real), size)
    tracks = TrackBuffer(
        state, size, 0 * size, zero, zero, zero, zero, zero - 1, jnp.zeros(number, bool), overrides,
        init_reference(params, zero, real),
    )  # fmt: skip
    grid = None
    if features.detect:
        grid = ClutterGrid(jnp.zeros((3, *features.grid_shape), real), jnp.zeros((), jnp.int32))
    return TrackerState(tracks, grid, jnp.asarray(len(features.seed), jnp.int32))


def shift_state(state: TrackerState, elapsed: Array) -> TrackerState:
    """Count times from a later moment; times that would not fit are limited.

    Args:
        state: State of the tracker.
        elapsed: () time from the old moment to the new one, us.

    Returns:
        The state.
    """
    grid = state.grid
    if grid is not None:
        grid = ClutterGrid(grid.sums, jnp.maximum(grid.time - elapsed, -2 * MAX_CHUNK_US))
    return TrackerState(shift_times(state.tracks, elapsed), grid, state.next_id)


def spawn_seeded_tracks(
    filter: Filter, params: TrackerParams, features: Features, due: Array, tracks: TrackBuffer
) -> TrackBuffer:
    """Start a confirmed track at each seed that is due; seed k uses buffer entry k.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: Seeds of the segment.
        due: (seeds,) whether a seed starts now.
        tracks: Tracks so far.

    Returns:
        The tracks.
    """
    seeds, number = len(features.seed), len(tracks.id)
    if seeds == 0:
        return tracks
    due = jnp.pad(due, (0, number - seeds))
    size = jnp.where(features.seed_size > 0, features.seed_size, params.lambda0)
    size = jnp.concatenate(
        [size, jnp.broadcast_to(params.lambda0, number - seeds)]
    ).astype(features.xi.dtype)  # fmt: skip
    xi = jnp.pad(features.seed_xi, ((0, number - seeds), (0, 0)))
    new = NewTracks(due, xi, size, jnp.arange(number, dtype=jnp.int32))
    now = jnp.zeros((), jnp.int32)
    return lax.cond(
        due.any(),
        lambda s: init_tracks(filter, params, s, new, now, True),
        lambda s: s,
        tracks,
    )


def accumulate_clutter(
    params: TrackerParams, grid: ClutterGrid, stop: Array, t: Array, xi: Array, unassociated: Array
) -> ClutterGrid:
    """Add a chunk's unassociated events to the grid.

    Args:
        params: Size of the cells and time constant of the grid.
        grid: The grid at the chunk's start.
        stop: End of the chunk, us.
        t: Times of the events (steps, M), us.
        xi: Positions of the events (steps, M, 2), px.
        unassociated: Whether each event is near no track.

    Returns:
        The grid at the chunk's end.
    """
    tau, real = params.tau_birth, xi.dtype
    _, rows, columns = grid.sums.shape
    decay = jnp.exp(-to_seconds(stop - grid.time, xi) / tau)
    weight = jnp.where(unassociated, jnp.exp(-to_seconds(stop - t, xi) / tau), 0).ravel()
    x, y = xi[..., 0].ravel(), xi[..., 1].ravel()
    column = jnp.clip(x / params.cell, 0, columns - 1).astype(jnp.int32)
    row = jnp.clip(y / params.cell, 0, rows - 1).astype(jnp.int32)
    values = jnp.stack([weight, weight * x, weight * y])
    sums = (grid.sums * decay).reshape(3, -1).at[:, row * columns + column].add(values)
    return ClutterGrid(sums.reshape(grid.sums.shape).astype(real), stop)


def _sum_3x3(counts: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Sum over the 3x3 cells around each cell."""
    a = jnp.pad(counts, 1)
    a = a[:-2] + a[1:-1] + a[2:]
    return a[:, :-2] + a[:, 1:-1] + a[:, 2:]


def _find_births(
    params: TrackerParams, sums: Array, free: Array, next_id: Array
) -> tuple[Array, Array, Array, Array]:
    """Find where tracks are born.

    The cell whose 3x3 sum is largest comes first; the 5x5 cells around it are emptied.

    Args:
        params: `n_birth`.
        sums: (3, rows, columns) sums of the weights of unassociated events, and of weight times x
            and y (px), in each cell.
        free: (entries,) whether an entry of the buffer is free.
        next_id: Number of the first new track.

    Returns:
        For each entry whether a track begins in it, its position (entries, 2) in px and its number,
        and what remains of the sums.
    """
    number, (_, rows, columns) = len(free), sums.shape

    def more(loop):
        sums, begins, _, _ = loop
        return (free & ~begins).any() & (_sum_3x3(sums[0]).max() > params.n_birth)

    def one(loop):
        sums, begins, xi, ids = loop
        cell = jnp.argmax(_sum_3x3(sums[0]))
        row, column = cell // columns, cell % columns
        near = lax.dynamic_slice(
            jnp.pad(sums, ((0, 0), (1, 1), (1, 1))), (0, row, column), (3, 3, 3)
        ).sum((1, 2))
        centre = near[1:] / near[0]
        entry = jnp.arange(number) == jnp.argmax(free & ~begins)
        here = (abs(jnp.arange(rows) - row) <= 2)[:, None] & (
            abs(jnp.arange(columns) - column) <= 2
        )
        ids = jnp.where(entry, next_id + begins.sum(), ids).astype(jnp.int32)
        xi = jnp.where(entry[:, None], centre, xi)
        return jnp.where(here, 0, sums), begins | entry, xi, ids

    none = jnp.zeros(number, bool)
    start = (sums, none, jnp.zeros((number, 2), sums.dtype), jnp.zeros(number, jnp.int32))
    sums, begins, xi, ids = lax.while_loop(more, one, start)
    return begins, xi, ids, sums


def predict_measurement(
    filter: Filter, params: TrackerParams, track: TrackBuffer, stop: Array
) -> PredictedMeasurement:
    """Predict the events of one track at a chunk's end.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        track: One track of the buffer, at its last update.
        stop: End of the chunk, us since its start.

    Returns:
        The prediction; for an empty entry that of its state as it is.
    """
    params = track_params(params, track.overrides)
    dt = to_seconds(jnp.maximum(stop - track.last_update, 0), track.gate)
    dt = jnp.where(track.id >= 0, dt, 0)
    state = predict(filter, params, lax.stop_gradient(track.state), dt)
    return filter.predicted_measurement(params, state)


def decide_track(
    params: TrackerParams, frame: Array, track: TrackBuffer, evidence: TrackEvidence, stop: Array
) -> TrackDecision:
    """Decide whether one track is confirmed, goes on or ends.

    With `association = "authors"` a track ends by silence only.

    Args:
        params: Parameters of the tracker.
        frame: Width and height of the sensor, px.
        track: The track.
        evidence: Predicted events, and relation to other tracks.
        stop: End of the chunk, us.

    Returns:
        The decision; its reason is an index of `END_REASONS`, 0 for a track that goes on.
    """
    predicted, merging = evidence.predicted, evidence.merging
    alive = track.id >= 0
    age = to_seconds(stop - track.birth, track.gate)
    enough = (track.hits >= params.n_confirm) & (age >= params.t_confirm)
    finite = jnp.ones_like(alive)
    for leaf in jax.tree.leaves((predicted, track.state)):
        finite &= jnp.isfinite(leaf).all()
    long, short = predicted.size.max(), predicted.size.min()
    limit = coast_limits_us(params, track)
    confirmed = track.confirmed | (alive & enough & ~merging)
    last_apart = jnp.where(merging, track.last_apart, stop)
    patience = jnp.where(confirmed, params.t_merge, params.t_tentative / 2)
    merged = jnp.where(
        confirmed,
        to_seconds(stop - last_apart, track.gate) >= patience,
        merging & (age >= patience),
    )
    hot_pixel = evidence.detected & (long <= 1.01 * params.lambda_min)
    outside = ((predicted.p < -0.5) | (predicted.p > frame - 0.5)).any()
    reason = jnp.select(
        [
            ~alive,
            ~finite,
            stop - track.last_hit > limit,
            ~confirmed & (age >= 2 * params.t_tentative),
            outside,
            hot_pixel | (long >= 0.999 * params.lambda_max) | (long > params.aspect_max * short),
            largest_eigenvalue(predicted.P_p) > params.sigma_max**2,
            merging & merged,
        ],
        [0, 7, 1, 2, 3, 4, 5, 6],
        0,
    ).astype(jnp.int32)
    if params.association == "authors":
        reason = jnp.where((reason >= 3) & (reason <= 6), 0, reason)
    death = jnp.where(reason == 1, track.last_hit + limit, stop)
    return TrackDecision(confirmed, reason, death, last_apart)


def _decide_tracks(
    filter: Filter, params: TrackerParams, features: Features, stop: Array, tracks: TrackBuffer
) -> TrackDecision:
    """Decide on all tracks at a chunk's end.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: The chunk's segment, for the sensor's size and the number of seeds.
        stop: () the chunk's end, us since its start.
        tracks: The tracks.

    Returns:
        Decisions, one for each entry of the buffer.
    """
    predicted = jax.vmap(functools.partial(predict_measurement, filter, params), (0, None))(
        tracks, stop
    )
    distance2 = ((predicted.p[:, None] - predicted.p) ** 2).sum(-1)
    apart = distance2 > predicted.size.max(-1) ** 2  # target i from j
    older = (tracks.id >= 0) & (tracks.id < tracks.id[:, None])
    merging = (older & ~apart).any(1)
    detected = jnp.arange(len(tracks.id)) >= len(features.seed)
    decide = functools.partial(decide_track, params, jnp.asarray(features.frame))
    evidence = TrackEvidence(predicted, merging, detected)
    return jax.vmap(decide, (0, 0, None))(tracks, evidence, stop)


def manage_tracks(
    filter: Filter, params: TrackerParams, features: Features, stop: Array, state: TrackerState
) -> tuple[TrackerState, LifecycleLog]:
    """Confirm, delete, merge and begin tracks at a chunk's end.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: Seeds and sensor of the segment.
        stop: End of the chunk, us since its start.
        state: Tracks and grid at the chunk's end.

    Returns:
        The state after births and deaths, and the changes.
    """
    fixed = lax.stop_gradient(params)
    decision = _decide_tracks(filter, fixed, features, stop, state.tracks)
    id_before, dead = state.tracks.id, decision.end_reason > 0
    tracks: Any = eqx.tree_at(
        lambda s: (s.id, s.confirmed, s.last_apart),
        state.tracks,
        (jnp.where(dead, -1, id_before), decision.confirmed & ~dead, decision.last_apart),
    )
    real = tracks.gate.dtype
    size = jnp.broadcast_to(params.lambda0, len(dead)).astype(real)
    empty = init_states(filter, params, tracks.overrides, jnp.zeros((len(dead), 2), real), size)
    after = jax.vmap(where_tree)(dead, empty, tracks.state)
    tracks = eqx.tree_at(lambda s: s.state, tracks, after)
    grid, next_id = state.grid, state.next_id
    if grid is not None:
        free = (tracks.id < 0) & (jnp.arange(len(dead)) >= len(features.seed))
        sums = grid.sums * jnp.exp(-to_seconds(stop - grid.time, size) / fixed.tau_birth)
        begins, xi, ids, sums = _find_births(fixed, sums.astype(real), free, next_id)
        new = NewTracks(begins, xi, size, ids)
        tracks = init_tracks(filter, params, tracks, new, stop, False)
        grid, next_id = ClutterGrid(sums, stop), next_id + begins.sum().astype(jnp.int32)
    log = LifecycleLog(
        id_before, tracks.id, decision.confirmed, decision.end_reason, decision.death
    )
    return TrackerState(tracks, grid, next_id), log
