"""The filter of one blob, a compact source whose events scatter about its centre.

The state is (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad, in whatever form a
filter keeps it; lambda are the standard deviations of the events along the blob's axes, theta turns
the first axis from x towards y, q is its rate. L = R(theta) diag(lambda1, lambda2) R(theta)^T is
the square root of the events' covariance. Wang, Molloy, van Goor, Mahony, "Asynchronous Blob
Tracker for Event Cameras".

Gate and likelihood are functions of one target and one event, the association weights of one event
and all targets. Soft association, JPDA: Bar-Shalom, Fortmann, "Tracking and Data Association".
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxevent.blob.params import TrackerParams
from jaxevent.deprecated import renamed_fields

T = TypeVar("T")


class EventBatch(eqx.Module):
    """The M events of one step.

    Attributes:
        xi: Positions, px.
        age: Time before the step's time, s; 0 for an event at that time.
        polarity: +1 or -1.
    """

    xi: Float[Array, "M 2"]
    age: Float[Array, " M"]
    polarity: Float[Array, " M"]


class PredictedMeasurement(eqx.Module):
    """Predicted distribution of a target's next events.

    Attributes:
        p: Centre, px.
        v: Velocity, px/s.
        spread: Covariance of events about the true centre, px^2.
        P_p: Covariance of `p`, px^2.
        size: lambda1 and lambda2, px.
    """

    p: Float[Array, " 2"]
    v: Float[Array, " 2"]
    spread: Float[Array, "2 2"]
    P_p: Float[Array, "2 2"]
    size: Float[Array, " 2"]


def where_tree(condition: Array, new: T, old: T) -> T:
    """Select one pytree or another by a condition.

    Args:
        condition: () truth value.
        new: What is selected where it holds.
        old: What is selected elsewhere, of the same structure.

    Returns:
        The pytree selected.
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def largest_eigenvalue(a: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Return the largest eigenvalue of a symmetric matrix."""
    half = (a[0, 0] - a[1, 1]) / 2
    mean = (a[0, 0] + a[1, 1]) / 2
    return mean + jnp.sqrt(half**2 + a[0, 1] ** 2)


def _determinant(a: Float[Array, "2 2"]) -> Float[Array, ""]:
    return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]


def _squared_distance(e: Float[Array, " 2"], a: Float[Array, "2 2"]) -> Float[Array, ""]:
    """Return the squared Mahalanobis distance e^T a^-1 e.

    Args:
        e: Residual, px.
        a: Covariance, px^2.

    Returns:
        The distance.
    """
    x, y = e[0], e[1]
    top = a[1, 1] * x**2 - 2 * a[0, 1] * x * y + a[0, 0] * y**2
    return top / _determinant(a)


def gate_radius(
    params: TrackerParams, radius: Float[Array, ""], size: Float[Array, ""], dt: Float[Array, ""]
) -> Float[Array, ""]:
    """Predict the gate's radius, which follows the size at the rate `gate_decay`.

    Args:
        params: Parameters of the tracker.
        radius: Present radius, px.
        size: Size of the target, px.
        dt: Time to predict ahead, s.

    Returns:
        The radius, px.
    """
    a = jnp.exp(-params.gate_decay * dt)
    radius = a * radius + (1 - a) * params.gate * size
    return jnp.clip(radius, params.gate_min, params.gate_max)


def is_in_gate(
    params: TrackerParams,
    predicted: PredictedMeasurement,
    radius: Float[Array, ""],
    e: Float[Array, " 2"],
) -> Bool[Array, ""]:
    """Return whether a residual is inside the gate, widened by the position's covariance.

    Circle: |e|^2 <= radius^2 + g^2 (largest eigenvalue of P_p). Ellipse: e^T ((radius/lambda1)^2
    L L^T + g^2 P_p)^-1 e <= 1. In both g is `gate_position`.

    Args:
        params: Shape of the gate and `gate_position`.
        predicted: Predicted events of the target.
        radius: Radius of the gate along the longer axis, px.
        e: Residual of the event, px.
    """
    g2 = params.gate_position**2
    if params.gate_shape == "circle":
        return (e**2).sum() <= radius**2 + g2 * largest_eigenvalue(predicted.P_p)
    scale = radius / predicted.size.max()
    return _squared_distance(e, scale**2 * predicted.spread + g2 * predicted.P_p) <= 1


def log_likelihood(
    params: TrackerParams, predicted: PredictedMeasurement, e: Float[Array, " 2"]
) -> Float[Array, ""]:
    """Return ln(2 pi p) of an event with a residual e, p = N(e; 0, L L^T + P_p) in 1/px^2.

    Args:
        params: Parameters of the tracker.
        predicted: Prediction of the target's events.
        e: Residual, px.

    Returns:
        The logarithm.
    """
    S = predicted.spread + predicted.P_p
    return -0.5 * (_squared_distance(e, S) + jnp.log(_determinant(S)))


def association_weights(
    params: TrackerParams, inside: Bool[Array, " K"], log_likelihood: Float[Array, " K"]
) -> Float[Array, " K"]:
    """Divide one event among K targets: w_i ~ p_i among the gates that contain it.

    Args:
        params: Rule of association and density of clutter.
        inside: Whether each target's gate contains the event.
        log_likelihood: ln(2 pi p) of the event for each target.

    Returns:
        Weights in [0, 1]; their sum is at most 1.
    """
    value = jnp.where(inside, log_likelihood, -jnp.inf)
    if params.association == "nearest":
        first = jnp.arange(len(value)) == jnp.argmax(value)
        return (inside & first).astype(value.dtype)
    clutter = params.raw["clutter"] + math.log(2 * math.pi)  # the logarithm: -inf for none
    cluttered = clutter > -jnp.inf
    if len(value) == 1:  # equal to the rest; without clutter certainly the one target's
        over = jnp.where(inside, value, 0) - jnp.where(cluttered, clutter, 0)
        return jnp.where(inside, jnp.where(cluttered, jax.nn.sigmoid(over), 1), 0)
    top = value.max()
    top = lax.stop_gradient(jnp.where(cluttered, jnp.maximum(top, clutter), top))
    top = jnp.where(jnp.isfinite(top), top, 0)
    parts = jnp.where(inside, jnp.exp(jnp.where(inside, value, top) - top), 0)
    total = parts.sum() + jnp.where(cluttered, jnp.exp(clutter - top), 0)
    return parts / jnp.where(total > 0, total, 1)


def _keep_state(params: Any, state: T, known: bool) -> T:
    return state


@renamed_fields(
    start="init",
    expected="predicted_measurement",
    moments="readout",
    halt="zero_velocity",
    share="association_weights",
)
@dataclasses.dataclass(frozen=True)
class Filter:
    """Steps of one target: pure functions, which the tracker maps over all targets.

    A state is any pytree of arrays. One filter differs from another by
    `dataclasses.replace(filter, update=...)`.

    Attributes:
        init: `init(params, position, size)` returns the state of a round blob at rest: centre
            (2,) and size () in px.
        predict: `predict(params, state, dt)` returns the state dt >= 0 seconds later, without
            events; exact over any gap.
        update: `update(params, state, batch, weight)` returns the state after the events of a
            step. `weight` (M,) in [0, 1] multiplies the information of each event; a step whose
            weights are all 0 changes nothing. Each event is compared with the position at its age.
        predicted_measurement: `predicted_measurement(params, state)` returns the distribution of
            events at the state's time, a `PredictedMeasurement`.
        readout: `readout(params, state)` returns the mean (8,) and the covariance (8, 8) of (px,
            py, vx, vy, lambda1, lambda2, theta, q), lambda in px.
        zero_velocity: `zero_velocity(params, state, known)` returns the state at rest: its velocity
            is 0, either exactly or with the variance of a new track. The default returns the state
            unchanged.
        transition: `transition(params, dt, static)` returns the matrix (8, 8) by which `predict`
            moves the mean of `readout` in dt seconds, at rest where `static`. The smoother needs
            it; None: states of this filter cannot be smoothed.
        gate: `gate(params, predicted, radius, e)` returns whether an event with the residual (2,)
            may belong to the target.
        log_likelihood: `log_likelihood(params, predicted, e)` returns ln(2 pi p) of that residual.
        association_weights: `association_weights(params, inside, log_likelihood)` returns the
            weight (targets,) of one event for each target, from the gates that contain it and its
            log-likelihoods.
    """

    init: Callable[[Any, Array, Array], Any]
    predict: Callable[[Any, Any, Array], Any]
    update: Callable[[Any, Any, EventBatch, Array], Any]
    predicted_measurement: Callable[[Any, Any], PredictedMeasurement]
    readout: Callable[[Any, Any], tuple[Array, Array]]
    zero_velocity: Callable[[Any, Any, bool], Any] = _keep_state
    transition: Callable[[Any, Array, Array], Array] | None = None
    gate: Callable[[Any, PredictedMeasurement, Array, Array], Array] = is_in_gate
    log_likelihood: Callable[[Any, PredictedMeasurement, Array], Array] = log_likelihood
    association_weights: Callable[[Any, Array, Array], Array] = association_weights
