"""A tracker of a user's own, outside the package: heavy tails of the events' scatter."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxevent.blob import Tracker, TrackerParams, constant_velocity
from jaxevent.parameters import Positive


class Params(TrackerParams):
    """Parameters of the Student tracker."""

    nu: Positive = Positive(4.0, "", "degrees of freedom of the events' scatter")


def squared(expected, e):
    """e^T S^-1 e and ln |S| with S = L L^T + P_p."""
    S = expected.spread + expected.P_p
    return e @ jnp.linalg.inv(S) @ e, jnp.log(jnp.linalg.det(S))


def log_likelihood(params, expected, e):
    """Of Student's t in two dimensions: 2 pi p = |S|^-1/2 (1 + d^2 / nu)^-(nu/2 + 1)."""
    d2, log_det = squared(expected, e)
    return -0.5 * log_det - (params.nu / 2 + 1) * jnp.log1p(d2 / params.nu)


def update(params, state, batch, weight):
    """Events far away count less, by (nu + 2) / (nu + d^2)."""
    expected = constant_velocity.filter.predicted_measurement(params, state)
    e = batch.xi - (expected.p - expected.v * batch.age[:, None])
    d2 = jax.vmap(lambda e: squared(expected, e)[0])(e)
    robust = jnp.minimum((params.nu + 2) / (params.nu + d2), 1)
    return constant_velocity.filter.update(params, state, batch, weight * robust)


student = Tracker(
    "student",
    Params,
    dataclasses.replace(constant_velocity.filter, update=update, log_likelihood=log_likelihood),
    about="A Kalman filter of constant velocity with Student's t for the events.",
)
