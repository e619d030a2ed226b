"""A motion model of a user's own, and a method: what a camera makes that zooms and rolls."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxevent.egomotion import Model, MotionEstimate, MotionEstimator
from jaxevent.egomotion.models import Part
from jaxevent.estimator import Estimate
from jaxevent.parameters import Number, Parameters


class ZoomRoll(Model):
    """A zoom (1/s) and a roll (rad/s) about the image's middle, x from there.

    U = (zoom x - roll y, zoom y + roll x).
    """

    name, title = "zoom-roll", "zoom and roll"
    components, units = ("zoom", "roll"), ("1/s", "rad/s")
    parts = (Part("rates", slice(0, 2), "1/s"),)

    def basis(self, xi):
        x, y = xi[..., 0], xi[..., 1]
        return jnp.stack([jnp.stack([x, -y], -1), jnp.stack([y, x], -1)], -2)

    def search_bound(self, params):
        return params.omega_max

    def diffusion(self, params, mean):
        return jnp.broadcast_to(params.noise_rotation, (2,))


class Params(Parameters):
    """What the guess is."""

    zoom: Number = Number(0.5, "1/s", "guess of the zoom")
    roll: Number = Number(1.0, "rad/s", "guess of the roll")


class Told(eqx.Module):
    motion: Array


class Guess(MotionEstimator[Params]):
    """The same motion at all times, whatever the events."""

    def prepare(self, recording, times, params=None, *, model=ZoomRoll, camera=None, seed=0):
        self.find_model_and_camera(recording, model, camera)
        return (), np.asarray(times)

    def run(self, params, features, state=None):
        return Told(jnp.stack([params.zoom, params.roll])), None

    def read(self, params, trajectory, out):
        shape = len(out), 2
        every = jnp.broadcast_to(trajectory.motion, shape)
        return Estimate(every, jnp.zeros((*shape, 2)), jnp.ones(len(out), bool))

    def estimate(self, recording, params=None, *, model=ZoomRoll, progress=None, **options):
        params = Params() if params is None else params
        t = np.array([recording.start, recording.stop])
        mean, covariance, _ = self.read(params, self.run(params, ())[0], t)
        return MotionEstimate.from_arrays(
            model, t, np.asarray(mean), np.asarray(covariance)
        ).with_recording(recording)


guess = Guess("guess", Params, models=("zoom-roll",))
