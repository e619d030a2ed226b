"""What a filter of one blob is: a bright spot whose events scatter about its centre.

The state is (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad, in whatever form a
filter keeps it; lambda are the standard deviations of the events along the blob's axes, theta turns
the first axis from x towards y, q is its rate. L = R(theta) diag(lambda1, lambda2) R(theta)^T is
the square root of the events' covariance. Wang, Molloy, van Goor, Mahony, "Asynchronous Blob
Tracker for Event Cameras".
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob import association
from jaxevent.blob.association import Expected
from jaxevent.deprecated import renamed_fields

T = TypeVar("T")


class Batch(eqx.Module):
    """The M events of one step."""

    xi: Float[Array, "M 2"]  # px
    age: Float[Array, " M"]  # s before the step's time; 0 for an event at that time
    polarity: Float[Array, " M"]  # +1 or -1


def _go_on(params: Any, state: T, known: bool) -> T:
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
    update: Callable[[Any, Any, Batch, Array], Any]
    predicted_measurement: Callable[[Any, Any], Expected]
    readout: Callable[[Any, Any], tuple[Array, Array]]
    zero_velocity: Callable[[Any, Any, bool], Any] = _go_on
    transition: Callable[[Any, Array, Array], Array] | None = None
    gate: Callable[[Any, Expected, Array, Array], Array] = association.gate
    log_likelihood: Callable[[Any, Expected, Array], Array] = association.log_likelihood
    association_weights: Callable[[Any, Array, Array], Array] = association.share


def choose(hit: Array, new: T, old: T) -> T:
    """`new` where `hit` (), else `old`: of all leaves."""
    return jax.tree.map(lambda a, b: jnp.where(hit, a, b), new, old)
