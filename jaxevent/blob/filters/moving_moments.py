"""Baseline: mean and covariance of the events with weights exp(-age / tau_moments).

The position lags by `tau_moments`; the velocity is that of the line through the events.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.filter import EventBatch, Filter, PredictedMeasurement, where_tree
from jaxevent.blob.filters.motion import LinearMotion, ellipse_axes, ellipse_covariance, join_blocks
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.tracker import Tracker
from jaxevent.parameters import Positive


class WeightedMoments(eqx.Module):
    """Weighted moments of the events; times are ages at the state's time.

    Attributes:
        mass: Sum of weights.
        center: Mean position, px.
        age: Mean time, s.
        spread: Covariance of positions, px^2.
        drift: Covariance of position and time, px s.
        duration: Variance of time, s^2.
    """

    mass: Float[Array, ""]
    center: Float[Array, " 2"]
    age: Float[Array, ""]
    spread: Float[Array, "2 2"]
    drift: Float[Array, " 2"]
    duration: Float[Array, ""]


class Params(TrackerParams):
    """Parameters of `moving_moments`."""

    tau_moments: Positive = Positive(0.002, "s", "time constant of the window")


def init(params: Params, position: Array, size: Array) -> WeightedMoments:
    none = jnp.zeros((), position.dtype)
    around = size**2 * jnp.eye(2, dtype=position.dtype)
    return WeightedMoments(none + 1, position, none, around, 0 * position, none)


def predict(params: Params, state: WeightedMoments, dt: Array) -> WeightedMoments:
    mass = state.mass * jnp.exp(-dt / params.tau_moments)
    return dataclasses.replace(state, mass=mass, age=state.age + dt)


def update(
    params: Params, state: WeightedMoments, batch: EventBatch, weight: Array
) -> WeightedMoments:
    m = weight.sum()
    share = weight / jnp.where(m > 0, m, 1)
    xi = jnp.where(weight[:, None] > 0, batch.xi, 0)
    center, age = (share[:, None] * xi).sum(0), (share * batch.age).sum()
    e, t = jnp.where(weight[:, None] > 0, xi - center, 0), age - batch.age
    own = [
        (share[:, None, None] * e[:, :, None] * e[:, None]).sum(0),
        (share[:, None] * e * t[:, None]).sum(0),
        (share * t**2).sum(),
    ]
    mass = state.mass + m
    new = m / jnp.where(mass > 0, mass, 1)
    d, dt = center - state.center, state.age - age
    between = [d[:, None] * d, d * dt, dt**2]
    old = [state.spread, state.drift, state.duration]
    around, drift, duration = (
        (1 - new) * a + new * b + new * (1 - new) * c
        for a, b, c in zip(old, own, between, strict=True)
    )
    moved = WeightedMoments(
        mass, state.center + new * d, state.age - new * dt, around, drift, duration
    )
    return where_tree(m > 0, moved, state)


def predicted_measurement(params: Params, state: WeightedMoments) -> PredictedMeasurement:
    theta, size = ellipse_axes(state.spread)
    size = jnp.clip(size, params.lambda_min, params.lambda_max)
    around = ellipse_covariance(theta, size)
    v, _, _ = _fit_line(state)
    return PredictedMeasurement(
        state.center, v, around, around / jnp.maximum(state.mass, 1e-6), size
    )


def readout(params: Params, state: WeightedMoments) -> tuple[Array, Array]:
    theta, size = ellipse_axes(state.spread)
    v, P_p, P_v = _fit_line(state)
    motion = LinearMotion((state.center, v), (P_p, 0 * P_p, P_v))
    turn = jnp.stack([theta, 0 * theta])
    mass = jnp.maximum(state.mass, 1e-6)
    return join_blocks(motion, size, size**2 / (2 * mass), turn, jnp.zeros(4, theta.dtype))


def _fit_line(state: WeightedMoments) -> tuple[Array, Array, Array]:
    """Fit a line: the velocity, and the covariances of position and velocity."""
    known = state.duration > 0
    duration = jnp.where(known, state.duration, 1)
    mass = jnp.maximum(state.mass, 1e-6)
    P_v = jnp.where(known, state.spread / (mass * duration), 0)
    return jnp.where(known, state.drift / duration, 0), state.spread / mass, P_v


moving_moments = Tracker(
    "moving_moments",
    Params,
    Filter(init, predict, update, predicted_measurement, readout),
    about="Moving mean and covariance of the events near a blob; a baseline.",
)
