"""Optical flow of events and of pixels, once the camera's motion is known.

    U, valid, residual = flow(recording, voting.estimate(recording, model="rotation"))
    field = RigidFlow(recording, motion).flow(times)  # (T, height, width, 2) px/s

Planar motion is the flow, a rotation makes B Omega. General motion leaves the speed rho along the
half-line B Omega + rho a, a = A T / |A T|, to the depth. The event's candidates determine it. With
q = d - dt B Omega, what the rotation leaves of the displacement d from an earlier event of age dt,

    S(rho) = |U|^g sum_c exp(-|q_c - rho dt_c a|^2 / (2 sigma_x^2)),  U = B Omega + rho a,

over the candidates that U moves by b/2 to b, is evaluated on a grid of speeds. The largest one is
refined by least squares over the candidates that voted for it. The candidate nearest to the
half-line alone (thesis, chapter 6) is less certain, since an edge's burst of events offers many.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_methods, renamed_names
from jaxevent.egomotion.candidates import Candidates, CandidateSampler, pixel_coordinates
from jaxevent.egomotion.geometry import length
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.parameters import Count, Number, Parameters, Positive
from jaxevent.progress import bar
from jaxevent.recording import Recording, Times, microseconds

EVENTS_PER_BATCH = 256
BATCHES_PER_CHUNK = 32  # batches per call of the compiled function
N_DEPTH_REFINEMENTS = 2
DEPTH_WINDOW_US = 30_000  # on either side of a time, whose events determine depths
CANDIDATE_WINDOW_US = 100_000  # before that, whose events are candidates
DEPTH_SIGMAS_PX = (1.5, 3.0, 6.0, 15.0, 50.0)  # of Gaussians; the narrowest with events counts
FULL_WEIGHT_EVENT_DENSITY = 0.3  # events per pixel at which a Gaussian counts in full
RELATIVE_DEPTH_SPREAD = 0.3  # relative deviation of the inverse depths of one position


class Params(Parameters):
    """Parameters of the flow of events from a known motion."""

    radius: Count = Count(8, "px", "candidates are so near, in x and y; baseline + 1.5 or more")
    per_pixel: Count = Count(8, "", "latest events of a pixel that are candidates")
    candidates: Count = Count(
        192, "", "most candidates of an event; of more, these many in even steps"
    )
    speeds: Count = Count(
        48, "", "general: speeds due to translation that are tried, by equal factors"
    )

    baseline: Positive = Positive(6.5, "px", "b: candidates have moved by b/2 to b")
    tau_max: Positive = Positive(0.1, "s", "oldest candidates")
    sigma_x: Positive = Positive(1.0, "px", "spread of a candidate")
    slowest: Positive = Positive(3.0, "px/s", "general: least speed due to translation but 0")
    fastest: Positive = Positive(1000.0, "px/s", "general: most speed due to translation")
    gain: Number = Number(
        0.25, "", "general: g, exponent of the speed; 0 prefers slow flow, 1 fast flow"
    )
    limit: Positive = Positive(
        1.0, "px", "an event none of whose candidates is so near is an outlier"
    )


@renamed_methods(outliers="outlier_percentage")
class Flow(NamedTuple):
    """Flow of n events.

    It is the flow of undistorted coordinates of one focal length, if there is a calibration (see
    `geometry.centred_coordinates`). Events are invalid where the motion is lost and, in general
    motion, where no candidate is within `Params.limit`.

    Attributes:
        flow: (n, 2) flow, px/s; NaN where invalid.
        valid: (n,) whether the flow is known.
        residual: (n,) distance of the candidate that fits the flow best, px; infinite without
            candidates, NaN where the motion is lost.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    residual: NDArray[np.float32]

    def outlier_percentage(self, limit: float | int = 1.0) -> float:
        """Return the percentage of events with a residual above `limit` px.

        It counts events for which the motion is known, and is 0 without any.
        """
        known = ~np.isnan(self.residual)
        return 100 * float((self.residual[known] > limit).mean()) if known.any() else 0.0


def flow(
    recording: Recording,
    motion: MotionEstimate,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> Flow:
    """Estimate the flow of every event of a recording.

    Args:
        recording: The recording.
        motion: The camera's motion; its fixed-lag estimates are used.
        params: The parameters.
        camera: The calibration; by default the recording's.
        progress: Whether to show a progress bar; by default in a terminal.

    Returns:
        The flow.

    Raises:
        InputError: The motion needs a calibration and there is none.
    """
    parts = list(iterate_flow(recording, motion, params, camera=camera, progress=progress))
    if not parts:
        return Flow(np.zeros((0, 2), np.float32), np.zeros(0, bool), np.zeros(0, np.float32))
    return Flow(*map(np.concatenate, zip(*parts, strict=True)))


def iterate_flow(
    recording: Recording,
    motion: MotionEstimate,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> Iterator[Flow]:
    """Estimate the flow of events in chunks of up to 8192 events, in constant memory.

    Args:
        recording: The recording.
        motion: The camera's motion; its fixed-lag estimates are used.
        params: The parameters.
        camera: The calibration; by default the recording's.
        progress: Whether to show a progress bar; by default in a terminal.

    Yields:
        The flow of consecutive events.

    Raises:
        InputError: The motion needs a calibration and there is none.
    """
    params = params or Params.of({})
    sampler = CandidateSampler(
        recording,
        _required_camera(recording, motion, camera),
        radius=params.radius,
        per_pixel=params.per_pixel,
        most=params.candidates,
        every=1,
        batch=EVENTS_PER_BATCH,
        longest=1e6,
        silence=float(params.tau_max),
    )
    real = np.dtype(jnp.result_type(float))
    ages = _age_range(params, motion, sampler)
    model = motion.model(sampler.f)
    total = len(recording.events)
    with bar(total=total, unit="event", unit_scale=True, desc="flow", progress=progress) as shown:
        while not sampler.is_exhausted:
            batches = sampler.sample(BATCHES_PER_CHUNK, *ages)
            used = batches.row >= 0
            rows = batches.row[used]
            if not len(rows):
                break
            t = recording.events[int(rows[0]) : int(rows[-1]) + 1].t
            estimate = motion(t, centred=True, extrapolate=True)
            known = estimate.valid
            mean = np.zeros((*used.shape, estimate.mean.shape[1]), real)
            mean[used] = np.nan_to_num(estimate.mean)  # without a heading it is a rotation
            U, residual = _estimate_flow(params, model, batches.candidates, mean)
            U, residual = np.asarray(U)[used], np.asarray(residual)[used]
            valid = known & (residual <= float(params.limit)) if model.half_line else known
            yield Flow(
                np.where(valid[:, None], U, np.nan).astype(np.float32),
                valid,
                np.where(known, residual, np.nan).astype(np.float32),
            )
            shown.update(len(rows))


def _required_camera(
    recording: Recording, motion: MotionEstimate, camera: PinholeCamera | None
) -> PinholeCamera | None:
    """Return the camera, by default the recording's.

    Args:
        recording: The recording.
        motion: The motion, whose model may need a camera.
        camera: The camera; None: the recording's.

    Returns:
        The camera; None where there is none and none is needed.

    Raises:
        InputError: It is needed and missing.
    """
    if motion.model.needs_camera:
        return recording.require_camera(camera, f"the flow of {motion.model.title}")
    return camera or recording.camera


def _age_range(
    params: Params, motion: MotionEstimate, sampler: CandidateSampler
) -> tuple[float, float]:
    """Bound the ages of candidates that any event can need, by the flow at the border.

    Args:
        params: Parameters.
        motion: The motion.
        sampler: Sampler of the candidates.

    Returns:
        Least and greatest age, s.
    """
    tau_max, b = float(params.tau_max), float(params.baseline)
    mean = np.asarray(motion.mean[motion.valid], float)
    if not len(mean):
        return tau_max / 2, tau_max
    xi = sampler.xi
    border = np.concatenate([xi[0], xi[-1], xi[:, 0], xi[:, -1]])
    model = motion.model(sampler.f)
    basis = np.asarray(model.basis(border))
    if model.uniform:
        speed = float(np.linalg.norm(mean @ basis[0].T, axis=1).max())
    else:
        speed = float(np.linalg.norm(np.abs(basis).max(0) @ np.abs(mean).max(0)))
    if model.half_line:
        speed += float(params.fastest)
    return min(b / 2 / max(speed, 1e-9), tau_max / 2), tau_max


class _Displacements(NamedTuple):
    """Candidates (C, K) of K events, relative to the flow that does not depend on depth."""

    age: Array  # s
    along: Array  # px, component along the half-line of what the rotation leaves
    across2: Array  # px^2, square of the other component
    base: Array  # (K, 2) px/s, start of the half-line
    a: Array  # (K, 2) its direction

    def in_baseline(self, params: Params, speed: Array) -> Array:
        """Return which candidates a flow of some speed has moved by b/2 to b.

        Args:
            params: Parameters, with the baseline b, px.
            speed: Speed, px/s, of a shape that broadcasts with `age`.

        Returns:
            Truth values, of that shape.
        """
        distance = self.age * speed
        return (self.age > 0) & (distance >= params.baseline / 2) & (distance <= params.baseline)


@eqx.filter_jit
def _estimate_flow(
    params: Params,
    model: Model,
    candidates: Candidates,
    mean: Float[Array | NDArray, "batches K dimension"],
) -> tuple[Float[Array, "batches K 2"], Float[Array, "batches K"]]:
    """Estimate flow and residual of batches of events.

    Args:
        params: Parameters.
        model: Model of the motion.
        candidates: Candidates of the events, of all batches.
        mean: Motion at the times of the events.

    Returns:
        Flow, px/s, and the distance of the nearest candidate from it, px; infinite where none is.
    """
    grid = jnp.geomspace(params.slowest, params.fastest, params.speeds)
    grid = jnp.concatenate([jnp.zeros(1, grid.dtype), grid])

    def estimate(batch: tuple[Array, Array, Array, Array]):
        d, age, xi, mean = batch
        base = jax.vmap(model.flow)(xi, mean)
        a = jnp.zeros_like(base)
        if model.half_line:
            a = jax.vmap(model.half_line_direction)(xi, mean)
        q = d - age[..., None] * base  # C K 2
        along = (q * a).sum(-1)
        found = _Displacements(age, along, ((q - along[..., None] * a) ** 2).sum(-1), base, a)
        rho = jnp.zeros_like(along[0])
        if model.half_line:
            rho = _vote_speed(params, grid, found)
        U = base + rho[:, None] * a
        moved = found.in_baseline(params, length(U))
        nearest = jnp.sqrt(found.across2 + (along - rho * age) ** 2)
        return U, jnp.where(moved, nearest, jnp.inf).min(0)

    d, age = (jnp.swapaxes(jnp.asarray(part), 1, 2) for part in (candidates.d, candidates.age))
    xi = jnp.asarray(candidates.xi)
    return lax.map(estimate, (d, age, xi, jnp.asarray(mean)))


def _vote_speed(params: Params, grid: Array, found: _Displacements) -> Float[Array, " K"]:
    """Find the speed along the half-line for which most candidates vote.

    Args:
        params: The parameters.
        grid: Speeds that are tried, px/s.
        found: Candidates (C, K) of K events.

    Returns:
        (K,) speeds, px/s; 0 where there is no candidate.
    """
    exponent = -0.5 / params.sigma_x**2
    weight = jnp.where(found.age > 0, jnp.exp(found.across2 * exponent), 0)
    speed = length(found.base[:, None] + grid[:, None] * found.a[:, None])  # K speeds

    def add(S: Array, candidate: tuple[Array, Array, Array]):
        age, along, weight = (part[:, None] for part in candidate)
        votes = weight * jnp.exp((along - grid * age) ** 2 * exponent)
        one = found._replace(age=age)
        return S + jnp.where(one.in_baseline(params, speed), votes, 0), None

    S = lax.scan(add, jnp.zeros_like(speed), (found.age, found.along, weight))[0]
    # A fast flow has younger, fewer candidates.
    rho = grid[(S * speed**params.gain).argmax(1)]
    for _ in range(N_DEPTH_REFINEMENTS):
        votes = weight * jnp.exp((found.along - rho * found.age) ** 2 * exponent)
        U = found.base + rho[:, None] * found.a
        votes = jnp.where(found.in_baseline(params, length(U)), votes, 0)
        moment = (votes * found.age**2).sum(0)
        fitted = (votes * found.along * found.age).sum(0) / jnp.where(moment > 0, moment, 1)
        rho = jnp.where(moment > 0, jnp.clip(fitted, 0, params.fastest), rho)
    return rho


@dataclasses.dataclass(frozen=True)
class RigidFlow:
    """Optical flow of all pixels of a rigid scene, a function of time: `flow(times)`.

        motion = egomotion.voting.estimate(recording, model="rotation")
        moving = RigidFlow(recording, motion)
        video = jaxevent.mc.estimate(recording, params, motion=moving)

    For general motion the events around a time determine the depths. The inverse depth of a pixel,
    in units of the camera's speed, is the mean of those of the events. They are weighted by a
    Gaussian, and by the image motion that translation makes there. Gaussians get narrower step by
    step, and events far from the mean of the step before count less.

    Attributes:
        recording: Recording whose events determine depths.
        motion: The camera's motion.
        camera: The calibration; by default the recording's.
    """

    recording: Recording
    motion: MotionEstimate
    camera: PinholeCamera | None = None

    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.float32]:
        """Return the optical flow at some times.

        Args:
            times: (T,) integers (us) or floats (s).
            extrapolate: Whether times outside the recording are allowed.

        Returns:
            (T, height, width, 2) flow in x and y, px/s; NaN where the motion is lost.

        Raises:
            InputError: A time is outside the recording without `extrapolate`, or the motion needs a
                calibration and there is none.
        """
        camera = _required_camera(self.recording, self.motion, self.camera)
        size = self.recording.height, self.recording.width
        xi, f = pixel_coordinates(size[1], size[0], camera)
        times = np.atleast_1d(microseconds(times))
        estimate = self.motion(times, centred=True, extrapolate=extrapolate)
        out = np.full((len(times), *size, 2), np.nan, np.float32)
        model = self.motion.model(f)
        # Displacements of pixels are those of undistorted coordinates, distorted again.
        undistortion = np.stack([np.gradient(xi, axis=1), np.gradient(xi, axis=0)], -1)
        distortion = np.linalg.inv(undistortion)
        for row, t in enumerate(times.tolist()):
            if estimate.valid[row]:
                mean = np.nan_to_num(np.asarray(estimate.mean[row], float))
                U = _map_pixels(model.flow, xi, mean)
                if model.half_line:
                    U = U + self._parallax(t, xi, model, mean)
                out[row] = (distortion @ U[..., None])[..., 0]
        return out

    def _parallax(
        self, t: int, xi: NDArray[np.float64], model: Model, mean: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Compute the flow that is due to translation.

        Args:
            t: Time, us.
            xi: (height, width, 2) positions of pixels, px.
            model: The model.
            mean: (d,) motion.

        Returns:
            (height, width, 2) px/s.
        """
        f = model.f
        first = max(t - DEPTH_WINDOW_US - CANDIDATE_WINDOW_US, self.recording.start)
        part = self.recording[first : t + DEPTH_WINDOW_US]
        found = flow(part, self.motion, camera=self.camera, progress=False)
        e = part.events[: len(part.events)]
        use = found.valid & (e.t >= t - DEPTH_WINDOW_US)
        # A T of a heading: its direction is the half-line's, its length px/s at inverse depth 1.
        size = np.hypot(xi[..., 0] * mean[2] - f * mean[0], xi[..., 1] * mean[2] - f * mean[1])
        a = _map_pixels(model.half_line_direction, xi, mean)
        x, y = e.x[use], e.y[use]
        base = _map_pixels(model.flow, xi, mean)
        speed = ((found.flow[use] - base[y, x]) * a[y, x]).sum(-1)
        if not len(x):
            return np.zeros((*size.shape, 2))
        rho = speed / np.maximum(size[y, x], 1e-9)  # inverse depth
        smooth = np.full(size.shape, np.median(rho))
        for sigma in reversed(DEPTH_SIGMAS_PX):
            # Events of a wrong speed deviate from the wider surroundings.
            off = (rho - smooth[y, x]) / np.maximum(RELATIVE_DEPTH_SPREAD * smooth[y, x], 1e-9)
            weight = size[y, x] / (1 + off**2)
            total, mass, count = (
                gaussian_filter(_sum_by_pixel(size.shape, y, x, values), sigma)
                for values in (weight * rho, weight, np.ones(len(x)))
            )
            trust = np.clip(count / FULL_WEIGHT_EVENT_DENSITY, 0, 1)
            smooth = smooth + trust * (total / np.maximum(mass, 1e-12) - smooth)
        return (smooth * size)[..., None] * a


def _sum_by_pixel(
    shape: tuple[int, ...], y: NDArray, x: NDArray, values: NDArray
) -> NDArray[np.float64]:
    """Sum the values of the events of each pixel.

    Args:
        shape: (height, width).
        y: (n,) rows, px.
        x: (n,) columns, px.
        values: (n,) values.

    Returns:
        (height, width).
    """
    sums = np.bincount(y.astype(int) * shape[1] + x, values, shape[0] * shape[1])
    return np.asarray(sums, float).reshape(shape)


def _map_pixels(
    function: Callable, xi: NDArray[np.float64], mean: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Evaluate a function of a position and a motion at every pixel.

    Args:
        function: Function of a position (2,), px, and the motion that returns (2,).
        xi: (height, width, 2) positions of the pixels, px.
        mean: (dimension,) motion.

    Returns:
        (height, width, 2).
    """
    flat = jax.vmap(function, (0, None))(jnp.asarray(xi.reshape(-1, 2)), jnp.asarray(mean))
    return np.asarray(flat, float).reshape(xi.shape)


__getattr__ = renamed_names(__name__)
