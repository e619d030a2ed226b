"""What later events say of a target: the backward pass over the states of its filter.

Of x and P, the filter's state predicted to a time t, and F, the transition from t to the target's
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

from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import LONGEST
from jaxevent.blob.states import canonical, wrap
from jaxevent.blob.steps import Filter, choose
from jaxevent.blob.targets import Slots, own_params, predict, seconds, stands_still
from jaxevent.devices import full_precision


class Later(eqx.Module):
    """What later events say of targets; see the text of this module."""

    r: Float[Array, "*targets 8"]
    N: Float[Array, "*targets 8 8"]
    next: Int[Array, "*targets"]  # us since the chunk's start, of the next update
    known: Bool[Array, "*targets"]  # whether there is one
    id: Int[Array, "*targets"]  # whose it is, the serial number


class Smoothed(eqx.Module):
    """A trajectory with what later events say: arrays begin with (chunks, steps + 1, targets)."""

    slots: Slots
    later: Later


class _Update(eqx.Module):
    """A target's update in a step."""

    touched: Bool[Array, "*steps"]  # whether there was one
    F: Float[Array, "*steps 8 8"]  # from the update before to this one
    b: Float[Array, "*steps 8"]  # (P-)^-1 (x - x-)
    M: Float[Array, "*steps 8 8"]  # (P-)^-1 P
    B: Float[Array, "*steps 8 8"]  # (P-)^-1 (P - P-) (P-)^-1
    time: Int[Array, "*steps"]

    @property
    @full_precision
    def chain(self) -> tuple[Array, Array, Array]:
        """T, c, C of F^T r -> c + T F'^T r', F^T N F -> C + T F'^T N' F' T^T; the same without."""
        F, hit = self.F.mT, self.touched[..., None]
        T = jnp.where(hit[..., None], F @ self.M, jnp.eye(8, dtype=F.dtype))
        c = jnp.where(hit, (F @ self.b[..., None])[..., 0], 0)
        return T, c, jnp.where(hit[..., None], F @ self.B @ F.mT, 0)


def nothing_later(slots: Slots) -> Later:
    """After the last event."""
    real, zero = slots.gate.dtype, jnp.zeros_like(slots.last)
    r = jnp.zeros((*slots.id.shape, 8), real)
    return Later(r, jnp.zeros((*r.shape, 8), real), zero, zero > 0, slots.id)


def at_end(later: Later, slots: Slots, elapsed: Array) -> Later:
    """What is known at a chunk's end, of what is known at the start of the next one.

    `slots` are those at the end: of a target that is gone in the next chunk nothing is known.
    `elapsed` (us) is the time between the starts of both.
    """
    next = jnp.minimum(later.next + elapsed, 2 * LONGEST)
    same = (later.id == slots.id) & (slots.id >= 0)
    shifted = Later(later.r, later.N, next, later.known, later.id)
    return jax.vmap(choose)(same, shifted, nothing_later(slots))


@full_precision
def look_back(filter: Filter, params: TrackerParams, path: Slots, later: Later) -> Later:
    """What later events say at all moments (steps + 1, targets) of a chunk's path.

    `later` (targets,) is what is known at its end.
    """
    moments = lambda slot: filter.readout(own_params(params, slot.own), slot.state)  # noqa: E731
    told = jax.vmap(jax.vmap(moments))(path)
    before, then, now = (
        jax.tree.map(lambda a, s=s: a[s], part)
        for part, s in ((path, slice(-1)), (told, slice(-1)), (told, slice(1, None)))
    )
    of_step = lambda *one: _update_of(filter, params, *one)  # noqa: E731
    updates = jax.vmap(jax.vmap(of_step))(before, then, path.last[1:], now)

    # Between two updates the chain is one affine map, so that little is left to the loop.
    def back(plus, step):
        (r, N), (T, c, C) = plus, step
        plus = c + T @ r, C + T @ N @ T.T
        return plus, plus

    def of_target(later: Later, end: Slots, updates: _Update) -> Later:
        F = _transition(filter, params, end, later, end.last).T
        last = F @ later.r, F @ later.N @ F.T
        _, plus = lax.scan(back, last, updates.chain, reverse=True)
        r, N = jax.tree.map(lambda a, b: jnp.concatenate([a[1:], b[None]]), plus, last)
        M = updates.M
        minus = updates.b + (M @ r[..., None])[..., 0], updates.B + M @ N @ M.mT
        # The update that comes next after each step; beyond the last one `later` holds.
        steps = len(updates.touched)
        place = jnp.where(updates.touched, jnp.arange(steps), steps)
        place = jnp.append(lax.cummin(place, reverse=True), steps)
        given = later.r, later.N, later.next
        r, N, next = (
            jnp.concatenate([a, b[None]])[place]
            for a, b in zip((*minus, updates.time), given, strict=True)
        )
        return Later(r, N, next, (place < steps) | later.known, jnp.full(place.shape, later.id))

    end = jax.tree.map(lambda a: a[-1], path)
    return jax.vmap(of_target, (0, 0, 1), 1)(later, end, updates)


@full_precision
def tell_smoothed(
    filter: Filter, params: TrackerParams, slot: Slots, later: Later, time: Array
) -> tuple[Array, Array, Array]:
    """As `states.tell`, from all events of the recording."""
    own = own_params(params, slot.own)
    dt = seconds(jnp.maximum(time - slot.last, 0), slot.gate)
    state = predict(filter, own, slot.state, dt, _stands_still(own, slot, later, time))
    x, P = filter.readout(own, state)
    F = _transition(filter, params, slot, later, time).T
    x = x + P @ (F @ later.r)
    P = P + P @ F @ later.N @ F.T @ P
    mean, covariance = canonical(x, (P + P.T) / 2)
    return mean, covariance, seconds(time - slot.heard, slot.gate)


@full_precision
def _update_of(
    filter: Filter,
    params: TrackerParams,
    before: Slots,
    then: tuple[Array, Array],
    time: Array,
    now: tuple[Array, Array],
) -> _Update:
    """One target's update at a time, from the moments before and after it."""
    params = own_params(params, before.own)
    dt = seconds(time - before.last, before.gate)
    still = stands_still(params, dt)
    x0, P0 = filter.readout(params, predict(filter, params, before.state, dt, still))
    x, P = now
    touched = (time != before.last) | (x != then[0]).any() | (P != then[1]).any()
    e = x - x0
    e = e.at[6].set(wrap(e[6]))
    inverse = _inverse(P0)
    return _Update(
        touched,
        _moved(filter, params, dt, still),
        inverse @ e,
        inverse @ P,
        inverse @ (P - P0) @ inverse,
        time,
    )


def _stands_still(params: TrackerParams, slot: Slots, later: Later, time: Array) -> Array:
    """Whether a target stands still at a time: it is silent for long until its next update."""
    until = jnp.where(later.known, later.next, time)
    return stands_still(params, seconds(until - slot.last, slot.gate))


def _transition(
    filter: Filter, params: TrackerParams, slot: Slots, later: Later, time: Array
) -> Array:
    """From a time to the target's next update."""
    params = own_params(params, slot.own)
    dt = seconds(jnp.maximum(later.next - time, 0), slot.gate)
    return _moved(filter, params, dt, _stands_still(params, slot, later, time))


def _moved(filter: Filter, params: Any, dt: Array, still: Array) -> Array:
    assert filter.transition is not None
    return filter.transition(params, dt, still)


def _inverse(P: Float[Array, "8 8"]) -> Float[Array, "8 8"]:
    """Of a covariance; 0 for what is exactly known."""
    variance = jnp.diagonal(P)
    known = variance <= 0
    scale = jnp.where(known, 0, lax.rsqrt(jnp.where(known, 1, variance)))
    small = 4 * jnp.finfo(P.dtype).eps  # for what rounding makes singular
    eye = jnp.eye(8, dtype=P.dtype)
    correlation = scale[:, None] * P * scale + eye * jnp.where(known, 1, small)
    return scale[:, None] * _swept(correlation) * scale


def _swept(A: Float[Array, "8 8"]) -> Float[Array, "8 8"]:
    """The inverse, by the sweep operator: half the time that LAPACK takes for many small ones."""

    def sweep(k: Array, A: Array) -> Array:
        row, here = A[k] / A[k, k], jnp.arange(8) == k
        swept = jnp.where(here[:, None], row, A - A[:, k, None] * row)
        swept = jnp.where(here, row[:, None], swept)
        return jnp.where(here[:, None] & here, -1 / A[k, k], swept)

    return -lax.fori_loop(0, 8, sweep, A)
