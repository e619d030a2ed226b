"""What tracks say of some times."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxevent.blob.params import TrackerParams
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots, own_params, predict, seconds, silence_limits
from jaxevent.estimator import Estimate

THETA_RATIO = 1.15  # lambda1 / lambda2 from which theta means something


class TrackStates(Estimate):
    """States of tracks at some times: `mean, covariance, valid = tracks(times)`.

    `mean` (times, tracks, 8) holds (px, py, vx, vy, lambda1, lambda2, theta, q) in px, s and rad:
    lambda1 >= lambda2 are standard deviations, theta in [-pi/2, pi/2) turns x towards y and is that
    of lambda1. `covariance` is (times, tracks, 8, 8). `valid` (times, tracks) is true where the
    track is alive; elsewhere numbers are NaN.

    Attributes:
        idle: (times, tracks), s since the track's last event.
        id: Numbers of the tracks, (tracks,) of `Tracks`, (times, tracks) of `Tracker.read`, where a
            target that has ended makes room for another one.
    """

    idle: Any
    id: Any

    @property
    def theta_valid(self) -> Any:
        """Where the blob is long enough for theta and q to mean something: lambda1 > 1.15 lambda2.

        (times, tracks).
        """
        return self.valid & (self.mean[..., 4] > THETA_RATIO * self.mean[..., 5])


def canonical(
    mean: Float[Array, " 8"], covariance: Float[Array, "8 8"]
) -> tuple[Float[Array, " 8"], Float[Array, "8 8"]]:
    """The same ellipse with lambda1 >= lambda2 and theta in [-pi/2, pi/2)."""
    swap = mean[5] > mean[4]
    order = jnp.array([0, 1, 2, 3, 5, 4, 6, 7])
    theta = mean[6] + jnp.where(swap, jnp.pi / 2, 0)
    theta = jnp.mod(theta + jnp.pi / 2, jnp.pi) - jnp.pi / 2
    theta = jnp.where(theta >= jnp.pi / 2, -jnp.pi / 2, theta)  # rounding
    mean = jnp.where(swap, mean[order], mean).at[6].set(theta)
    return mean, jnp.where(swap, covariance[order][:, order], covariance)


def wrap(theta: Array) -> Array:
    """The same angle in [-pi, pi]."""
    return theta - 2 * jnp.pi * jnp.round(theta / (2 * jnp.pi))


def is_alive(params: TrackerParams, slots: Slots, time: Array) -> Array:
    """Which targets are confirmed and not silent for too long at a time (us, in their chunk)."""
    return (slots.id >= 0) & slots.confirmed & (time - slots.heard < silence_limits(params, slots))


def tell(
    filter: Filter, params: TrackerParams, slot: Slots, time: Array
) -> tuple[Array, Array, Array]:
    """Mean, covariance and seconds without events of one target at a time (us, in its chunk)."""
    params = own_params(params, slot.own)
    dt = seconds(jnp.maximum(time - slot.last, 0), slot.gate)
    state = predict(filter, params, slot.state, dt)
    mean, covariance = canonical(*filter.readout(params, state))
    return mean, covariance, seconds(time - slot.heard, slot.gate)
