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

T = TypeVar("T")


class Batch(eqx.Module):
    """The M events of one step."""

    xi: Float[Array, "M 2"]  # px
    age: Float[Array, " M"]  # s before the step's time; 0 for an event at that time
    polarity: Float[Array, " M"]  # +1 or -1


def _go_on(params: Any, state: T, known: bool) -> T:
    return state


@dataclasses.dataclass(frozen=True)
class Filter:
    """The steps of one target: pure functions, which the tracker maps over all targets.

    A state is any pytree of arrays. One filter differs from another by
    `dataclasses.replace(filter, update=...)`.

    Attributes:
        start: `start(params, position, size)` is the state of a resting round blob: centre (2,)
            and size () in px.
        predict: `predict(params, state, dt)` is the state dt >= 0 seconds later, without events;
            exact over any gap.
        update: `update(params, state, batch, weight)` is the state after the events of a step.
            `weight` (M,) in [0, 1] multiplies an event's information; a step whose weights are all
            0 changes nothing. Events are compared with the position at their own age.
        expected: `expected(params, state)` is what the filter expects of events at the state's
            time.
        moments: `moments(params, state)` is the mean (8,) and the covariance (8, 8) of (px, py, vx,
            vy, lambda1, lambda2, theta, q), lambda in px.
        halt: `halt(params, state, known)` is the state of a target that stands still: its velocity
            is 0, and is either known or as uncertain as at the start. By default the state as it
            is.
        transition: `transition(params, dt, still)` is the matrix (8, 8) by which `predict` moves
            the mean of `moments` in dt seconds, or, where `still`, moves it between two halts. The
            smoother needs it; None: the filter's states cannot be smoothed.
        gate: `gate(params, expected, radius, e)` says whether a residual (2,) is a possible event
            of the target.
        log_likelihood: `log_likelihood(params, expected, e)` is ln(2 pi p) of that residual.
        share: `share(params, inside, density)` shares one event out among all targets: its weights
            (targets,), from the gates that hold it and its log likelihoods.
    """

    start: Callable[[Any, Array, Array], Any]
    predict: Callable[[Any, Any, Array], Any]
    update: Callable[[Any, Any, Batch, Array], Any]
    expected: Callable[[Any, Any], Expected]
    moments: Callable[[Any, Any], tuple[Array, Array]]
    halt: Callable[[Any, Any, bool], Any] = _go_on
    transition: Callable[[Any, Array, Array], Array] | None = None
    gate: Callable[[Any, Expected, Array, Array], Array] = association.gate
    log_likelihood: Callable[[Any, Expected, Array], Array] = association.log_likelihood
    share: Callable[[Any, Array, Array], Array] = association.share


def choose(hit: Array, new: T, old: T) -> T:
    """`new` where `hit` (), else `old`: of all leaves."""
    return jax.tree.map(lambda a, b: jnp.where(hit, a, b), new, old)
