"""Fixed-interval smoother: a backward pass over the states of a track's filter.

Of x and P, the filter's state predicted to a time t, and F, the transition from t to the track's
next update, all events of the recording give x + P F^T r with the covariance P + P F^T N F P. r and
N go backwards from update to update:

    r = (P-)^-1 (x - x- + P F^T r'),  N = (P-)^-1 (P + P F^T N' F P - P-) (P-)^-1

with x-, P- before the update, x, P after it, and F, r', N' of the next one. This is the smoother of
Rauch, Tung and Striebel ("Maximum likelihood estimates of linear dynamic systems", 1965), written
with r as Bryson and Frazier did. Pure and differentiable.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxevent.blob.filter import Filter, where_tree
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import MAX_CHUNK_US
from jaxevent.blob.track import (
    TrackBuffer,
    canonical_ellipse,
    is_static,
    predict,
    to_seconds,
    track_params,
    wrap_angle,
)
from jaxevent.precision import full_precision


class BackwardInfo(eqx.Module):
    """Adjoint variables of the Bryson-Frazier smoother, one set per track.

    The smoothed state at a time with transition F to the next update is `x + P F^T r` with
    covariance `P + P F^T N F P`.
    """

    r: Float[Array, "*targets 8"]  # gradient of the log-likelihood of later events
    N: Float[Array, "*targets 8 8"]  # its Hessian
    next: Int[Array, "*targets"]  # time of the next update, us since the chunk's start
    known: Bool[Array, "*targets"]  # whether there is a next update
    id: Int[Array, "*targets"]  # serial number of the track


class SmoothedTracks(eqx.Module):
    """Tracks with backward information: arrays begin with (chunks, steps + 1, targets).

    Attributes:
        tracks: The filtered tracks.
        info: Their backward information.
    """

    tracks: TrackBuffer
    info: BackwardInfo


class _TrackUpdate(eqx.Module):
    """Update of a track in a step.

    Attributes:
        touched: Whether there was an update.
        F: Transition from the update before to this one.
        b: (P-)^-1 (x - x-).
        M: (P-)^-1 P.
        B: (P-)^-1 (P - P-) (P-)^-1.
        time: Time of the update, us since the chunk's start.
    """

    touched: Bool[Array, "*steps"]
    F: Float[Array, "*steps 8 8"]
    b: Float[Array, "*steps 8"]
    M: Float[Array, "*steps 8 8"]
    B: Float[Array, "*steps 8 8"]
    time: Int[Array, "*steps"]

    @property
    @full_precision
    def backward_map(self) -> tuple[Array, Array, Array]:
        """T, c, C of F^T r = c + T F'^T r' and F^T N F = C + T F'^T N' F' T^T.

        Without an update the map is the identity.
        """
        F, hit = self.F.mT, self.touched[..., None]
        T = jnp.where(hit[..., None], F @ self.M, jnp.eye(8, dtype=F.dtype))
        c = jnp.where(hit, (F @ self.b[..., None])[..., 0], 0)
        return T, c, jnp.where(hit[..., None], F @ self.B @ F.mT, 0)


def terminal_info(tracks: TrackBuffer) -> BackwardInfo:
    """Return the backward information after the last event: none."""
    real, zero = tracks.gate.dtype, jnp.zeros_like(tracks.last_update)
    r = jnp.zeros((*tracks.id.shape, 8), real)
    return BackwardInfo(r, jnp.zeros((*r.shape, 8), real), zero, zero > 0, tracks.id)


def propagate_to_chunk_end(info: BackwardInfo, tracks: TrackBuffer, elapsed: Array) -> BackwardInfo:
    """Propagate backward information from the start of the next chunk to a chunk's end.

    Args:
        info: Information at the start of the next chunk.
        tracks: Tracks at the chunk's end; of one that is gone in the next chunk there is none.
        elapsed: Time between the starts of both chunks, us.
    """
    next = jnp.minimum(info.next + elapsed, 2 * MAX_CHUNK_US)
    same = (info.id == tracks.id) & (tracks.id >= 0)
    shifted = BackwardInfo(info.r, info.N, next, info.known, info.id)
    return jax.vmap(where_tree)(same, shifted, terminal_info(tracks))


@full_precision
def backward_pass(
    filter: Filter, params: TrackerParams, path: TrackBuffer, info: BackwardInfo
) -> BackwardInfo:
    """Run the backward pass over one chunk.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        path: Tracks (steps + 1, targets) before the first step and after each step.
        info: Backward information (targets,) at the chunk's end.

    Returns:
        Backward information (steps + 1, targets).
    """

    def read(track: TrackBuffer) -> tuple[Array, Array]:
        return filter.readout(track_params(params, track.overrides), track.state)

    def describe(*one: Any) -> _TrackUpdate:
        return _describe_update(filter, params, *one)

    states = jax.vmap(jax.vmap(read))(path)
    before, then, now = (
        jax.tree.map(lambda a, s=s: a[s], part)
        for part, s in ((path, slice(-1)), (states, slice(-1)), (states, slice(1, None)))
    )
    updates = jax.vmap(jax.vmap(describe))(before, then, path.last_update[1:], now)

    # Between two updates the recursion is one affine map, so that little is left to the loop.
    def back(plus, step):
        (r, N), (T, c, C) = plus, step
        plus = c + T @ r, C + T @ N @ T.T
        return plus, plus

    def smooth(info: BackwardInfo, end: TrackBuffer, updates: _TrackUpdate) -> BackwardInfo:
        F = _transition_to_next(filter, params, end, info, end.last_update).T
        last = F @ info.r, F @ info.N @ F.T
        _, plus = lax.scan(back, last, updates.backward_map, reverse=True)
        r, N = jax.tree.map(lambda a, b: jnp.concatenate([a[1:], b[None]]), plus, last)
        M = updates.M
        minus = updates.b + (M @ r[..., None])[..., 0], updates.B + M @ N @ M.mT
        # The update that comes next after each step; beyond the last one `info` holds.
        steps = len(updates.touched)
        step = jnp.where(updates.touched, jnp.arange(steps), steps)
        step = jnp.append(lax.cummin(step, reverse=True), steps)
        at_end = info.r, info.N, info.next
        r, N, next = (
            jnp.concatenate([a, b[None]])[step]
            for a, b in zip((*minus, updates.time), at_end, strict=True)
        )
        known = (step < steps) | info.known
        return BackwardInfo(r, N, next, known, jnp.full(step.shape, info.id))

    end = jax.tree.map(lambda a: a[-1], path)
    return jax.vmap(smooth, (0, 0, 1), 1)(info, end, updates)


@full_precision
def readout_smoothed(
    filter: Filter, params: TrackerParams, track: TrackBuffer, info: BackwardInfo, time: Array
) -> tuple[Array, Array, Array]:
    """Read out one track at a time from all events of the recording.

    Args:
        filter: Filter of the target.
        params: Parameters of the tracker.
        track: The track at its last update.
        info: Its backward information.
        time: Time, us since the chunk's start.

    Returns:
        Mean (8,) and covariance (8, 8) in the order of `TrackStates`, and s since the last event.
    """
    own = track_params(params, track.overrides)
    dt = to_seconds(jnp.maximum(time - track.last_update, 0), track.gate)
    static = _is_static_until_next(own, track, info, time)
    state = predict(filter, own, track.state, dt, static)
    x, P = filter.readout(own, state)
    F = _transition_to_next(filter, params, track, info, time).T
    x = x + P @ (F @ info.r)
    P = P + P @ F @ info.N @ F.T @ P
    mean, covariance = canonical_ellipse(x, (P + P.T) / 2)
    return mean, covariance, to_seconds(time - track.last_hit, track.gate)


@full_precision
def _describe_update(
    filter: Filter,
    params: TrackerParams,
    before: TrackBuffer,
    then: tuple[Array, Array],
    time: Array,
    now: tuple[Array, Array],
) -> _TrackUpdate:
    """Describe a track's update at a time, for the backward pass.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        before: The track before the time.
        then: Mean (8,) and covariance (8, 8) of `before`, not predicted.
        time: Time of the update, us since the chunk's start.
        now: Mean and covariance after the update.

    Returns:
        The update.
    """
    params = track_params(params, before.overrides)
    dt = to_seconds(time - before.last_update, before.gate)
    static = is_static(params, dt)
    x0, P0 = filter.readout(params, predict(filter, params, before.state, dt, static))
    x, P = now
    touched = (time != before.last_update) | (x != then[0]).any() | (P != then[1]).any()
    e = x - x0
    e = e.at[6].set(wrap_angle(e[6]))
    inverse = _invert_covariance(P0)
    F = _transition(filter, params, dt, static)
    return _TrackUpdate(touched, F, inverse @ e, inverse @ P, inverse @ (P - P0) @ inverse, time)


def _is_static_until_next(
    params: TrackerParams, track: TrackBuffer, info: BackwardInfo, time: Array
) -> Array:
    """Return whether a track stands still at a time: its next update is late enough.

    Args:
        params: Parameters of the tracker.
        track: A track.
        info: Its backward information.
        time: () us since the chunk's start.

    Returns:
        () whether it does.
    """
    until = jnp.where(info.known, info.next, time)
    return is_static(params, to_seconds(until - track.last_update, track.gate))


def _transition_to_next(
    filter: Filter, params: TrackerParams, track: TrackBuffer, info: BackwardInfo, time: Array
) -> Array:
    """Return the transition from a time to the track's next update.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        track: A track.
        info: Its backward information.
        time: () us since the chunk's start.

    Returns:
        (8, 8).
    """
    params = track_params(params, track.overrides)
    dt = to_seconds(jnp.maximum(info.next - time, 0), track.gate)
    return _transition(filter, params, dt, _is_static_until_next(params, track, info, time))


def _transition(filter: Filter, params: Any, dt: Array, static: Array) -> Array:
    assert filter.transition is not None
    return filter.transition(params, dt, static)


def _invert_covariance(P: Float[Array, "8 8"]) -> Float[Array, "8 8"]:
    """Invert a covariance; rows of exactly known components are 0."""
    variance = jnp.diagonal(P)
    known = variance <= 0
    scale = jnp.where(known, 0, lax.rsqrt(jnp.where(known, 1, variance)))
    small = 4 * jnp.finfo(P.dtype).eps  # for what rounding makes singular
    eye = jnp.eye(8, dtype=P.dtype)
    correlation = scale[:, None] * P * scale + eye * jnp.where(known, 1, small)
    return scale[:, None] * _invert_by_sweeps(correlation) * scale


def _invert_by_sweeps(A: Float[Array, "8 8"]) -> Float[Array, "8 8"]:
    """Invert a matrix by the sweep operator: for many small ones twice as fast as LAPACK."""

    def sweep(k: Array, A: Array) -> Array:
        row, here = A[k] / A[k, k], jnp.arange(8) == k
        swept = jnp.where(here[:, None], row, A - A[:, k, None] * row)
        swept = jnp.where(here, row[:, None], swept)
        return jnp.where(here[:, None] & here, -1 / A[k, k], swept)

    return -lax.fori_loop(0, 8, sweep, A)
