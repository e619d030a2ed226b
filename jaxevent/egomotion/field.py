"""Optical flow of every pixel of a rigid scene, from the camera's motion and the scene's depths.

    motion = egomotion.voting.estimate(recording, model="rotation")
    moving = RigidFlow(recording, motion)
    moving.flow(times)  # (T, height, width, 2), px/s
    video = jaxevent.mc.estimate(recording, params, motion=moving)

Planar motion and rotations are the flow. Of general motion depth is told by the events around a
time (`flow`): the inverse depth of a pixel, in units of the camera's speed, is the mean of theirs,
weighted by a Gaussian and by how much it moves the image there. Wider Gaussians go first; an event
counts less the farther it is from what they tell.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.flow import flow
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Motion
from jaxevent.errors import InputError
from jaxevent.recording import Recording, Times, microseconds

AROUND = 30_000  # us on either side of a time, whose events tell depths
BEFORE = 100_000  # us before these, whose events are their candidates
SPREADS = (
    1.5,
    3.0,
    6.0,
    15.0,
    50.0,
)  # px, of the Gaussians: the narrowest that some events fill counts
ENOUGH = 0.3  # events per pixel that fill one
SIMILAR = 0.3  # of an inverse depth, by which events of the same place differ


@dataclasses.dataclass(frozen=True)
class RigidFlow:
    """How the pixels of a rigid scene move: `flow(times)`.

    Attributes:
        recording: Whose events tell depths.
        motion: The camera's.
        camera: By default the recording's.
    """

    recording: Recording
    motion: Motion
    camera: PinholeCamera | None = None

    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.float32]:
        """Optical flow (T, H, W, 2) at `times`, of x and y in px/s; NaN where motion is lost.

        Times are integers (us) or floats (s). Raises `InputError` for those outside the recording
        unless told to `extrapolate`, and where the motion needs a camera and there is none.
        """
        camera = self.camera or self.recording.camera
        if self.motion.model.needs_camera and camera is None:
            raise InputError(
                f"{self.recording.name}: has no calibration, which the flow of "
                f"{self.motion.model.title} needs{self.recording.describe_left_out('camera')}; "
                "give a camera"
            )
        size = self.recording.height, self.recording.width
        xi, f = coordinates(size[1], size[0], camera)
        times = np.atleast_1d(microseconds(times))
        told = self.motion(times, centred=True, extrapolate=extrapolate)
        out = np.full((len(times), *size, 2), np.nan, np.float32)
        model = self.motion.model(f)
        # The pixels' own displacements are those of undistorted coordinates, turned back.
        along = np.stack([np.gradient(xi, axis=1), np.gradient(xi, axis=0)], -1)
        back = np.linalg.inv(along)
        for row, t in enumerate(times.tolist()):
            if told.valid[row]:
                mean = np.asarray(told.mean[row], float)
                U = _each(model.flow, xi, mean)
                if model.half_line:
                    U = U + self._parallax(t, xi, model, mean)
                out[row] = (back @ U[..., None])[..., 0]
        return out

    def _parallax(
        self, t: int, xi: NDArray[np.float64], model: Model, mean: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The flow that is due to translation."""
        f = model.f
        first = max(t - AROUND - BEFORE, self.recording.start)
        part = self.recording[first : t + AROUND]
        found = flow(part, self.motion, camera=self.camera, progress=False)
        e = part.events[: len(part.events)]
        use = found.valid & (e.t >= t - AROUND)
        # A T of a heading, whose direction is the line, and its length px/s at inverse depth 1.
        reach = np.hypot(xi[..., 0] * mean[2] - f * mean[0], xi[..., 1] * mean[2] - f * mean[1])
        line = _each(model.line, xi, mean)
        x, y = e.x[use], e.y[use]
        speed = ((found.flow[use] - _each(model.flow, xi, mean)[y, x]) * line[y, x]).sum(-1)
        if not len(x):
            return np.zeros((*reach.shape, 2))
        depth = speed / np.maximum(reach[y, x], 1e-9)  # inverse
        near = np.full(reach.shape, np.median(depth))
        for sigma in reversed(SPREADS):
            # Events of a wrong speed are far from what wider surroundings tell.
            off = (depth - near[y, x]) / np.maximum(SIMILAR * near[y, x], 1e-9)
            weight = reach[y, x] / (1 + off**2)
            total, mass, count = (
                gaussian_filter(_gathered(reach.shape, y, x, part), sigma)
                for part in (weight * depth, weight, np.ones(len(x)))
            )
            trust = np.clip(count / ENOUGH, 0, 1)
            near = near + trust * (total / np.maximum(mass, 1e-12) - near)
        return (near * reach)[..., None] * line


def _gathered(
    shape: tuple[int, ...], y: NDArray, x: NDArray, values: NDArray
) -> NDArray[np.float64]:
    """Sums over the events of each pixel."""
    sums = np.bincount(y.astype(int) * shape[1] + x, values, shape[0] * shape[1])
    return np.asarray(sums, float).reshape(shape)


def _each(function, xi: NDArray[np.float64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """A function of places and motions at every pixel, (H, W, 2)."""
    flat = jax.vmap(function, (0, None))(jnp.asarray(xi.reshape(-1, 2)), jnp.asarray(mean))
    return np.asarray(flat, float).reshape(xi.shape)
