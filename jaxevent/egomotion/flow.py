"""Optical flow of each event, once the camera's motion is known; and how many events contradict it.

    U, valid, residual = flow(recording, voting.estimate(recording, model="rotation"))

Planar motion is the flow, a rotation makes B Omega. General motion leaves the speed rho along the
half-line B Omega + rho a, a = A T / |A T|, to the depth. It is told by the event's candidates: with
q = d - dt B Omega, what the rotation leaves of the displacement d from an earlier event of age dt,

    S(rho) = |U|^g sum_c exp(-|q_c - rho dt_c a|^2 / (2 sigma_x^2)),  U = B Omega + rho a,

over those that U moves by b/2 to b, is looked at on a grid of speeds; the largest one is refined by
least squares over the candidates that voted for it. The candidate nearest to the half-line alone
(thesis, chapter 6) tells less: an edge's burst of events offers many.
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.candidates import Candidates, Gatherer
from jaxevent.egomotion.geometry import length
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Motion
from jaxevent.errors import InputError
from jaxevent.parameters import Count, Number, Parameters, Positive
from jaxevent.progress import bar
from jaxevent.recording import Recording

BATCH, BATCHES = 256, 32  # events that are looked at together, and how often before the host acts
REFINEMENTS = 2


class Params(Parameters):
    """Parameters of the flow of events from a known motion."""

    radius = Count(8, "px", "candidates are so near, in x and y; baseline + 1.5 or more")
    per_pixel = Count(8, "", "latest events of a pixel that are candidates")
    candidates = Count(192, "", "most candidates of an event; of more, these many in even steps")
    speeds = Count(48, "", "general: speeds due to translation that are tried, by equal factors")

    baseline = Positive(6.5, "px", "b: candidates have moved by b/2 to b")
    tau_max = Positive(0.1, "s", "oldest candidates")
    sigma_x = Positive(1.0, "px", "spread of a candidate")
    slowest = Positive(3.0, "px/s", "general: least speed due to translation but 0")
    fastest = Positive(1000.0, "px/s", "general: most speed due to translation")
    gain = Number(0.25, "", "general: g, exponent of the speed; 0 prefers slow flow, 1 fast flow")
    limit = Positive(1.0, "px", "an event none of whose candidates is so near is an outlier")


class Flow(NamedTuple):
    """Flow of n events: `flow` (n, 2) in px/s, `valid` (n,), `residual` (n,) in px.

    The flow is that of undistorted coordinates of one focal length, where there is a calibration
    (see `geometry.undistorted`). `valid` is False, and the flow NaN, where the motion is lost and,
    in general motion, where no candidate is within `limit`. The residual is the distance of the
    candidate that fits the flow best, infinite where there is none.
    """

    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    residual: NDArray[np.float32]

    def outliers(self, limit: float | int = 1.0) -> float:
        """The percentage of events whose residual is above `limit` px.

        Among those for which the motion is known; 0 where there is none.
        """
        known = ~np.isnan(self.residual)
        return 100 * float((self.residual[known] > limit).mean()) if known.any() else 0.0


def flow(
    recording: Recording,
    motion: Motion,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> Flow:
    """The flow of every event of a recording; see `Flow`, and `iterate`, which says what it takes.

    Raises `InputError` for a rotation or general motion without a calibration.
    """
    parts = list(iterate(recording, motion, params, camera=camera, progress=progress))
    if not parts:
        none = np.zeros(0, np.float32)
        return Flow(none.reshape(0, 2), none.astype(bool), none)
    return Flow(
        np.concatenate([part.flow for part in parts]),
        np.concatenate([part.valid for part in parts]),
        np.concatenate([part.residual for part in parts]),
    )


def iterate(
    recording: Recording,
    motion: Motion,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> Iterator[Flow]:
    """The same in stretches of up to 8192 events, one after another, in constant memory.

    `camera` is by default the recording's. The motion is that which `motion` tells of the events'
    times, centred: a fixed-lag estimate. Residuals are NaN where it is lost.
    """
    params = params or Params.of({})
    camera = camera or recording.camera
    if motion.model.needs_camera and camera is None:
        raise InputError(
            f"{recording.name}: has no calibration, which the flow of {motion.model.title} needs"
            f"{recording.describe_left_out('camera')}; give a camera"
        )
    gatherer = Gatherer(
        recording,
        camera,
        radius=params.radius,
        per_pixel=params.per_pixel,
        most=params.candidates,
        every=1,
        batch=BATCH,
        longest=1e6,
        silence=float(params.tau_max),
    )
    real = np.dtype(jnp.result_type(float))
    ages = _ages(params, motion, gatherer)
    model = motion.model(gatherer.f)
    with bar(
        total=len(recording.events), unit="event", unit_scale=True, desc="flow", progress=progress
    ) as shown:
        while not gatherer.done:
            made = gatherer.gather(BATCHES, *ages)
            seen = made.row >= 0
            rows = made.row[seen]
            if not len(rows):
                break
            t = recording.events[int(rows[0]) : int(rows[-1]) + 1].t
            told = motion(t, centred=True, extrapolate=True)
            known = told.valid & np.isfinite(told.mean).all(1)
            mean = np.zeros((*seen.shape, told.mean.shape[1]), real)
            mean[seen] = np.where(known[:, None], told.mean, 0)
            U, residual = _flows(params, model, made.candidates, mean)
            U, residual = np.asarray(U)[seen], np.asarray(residual)[seen]
            valid = known & (residual <= float(params.limit)) if model.half_line else known
            yield Flow(
                np.where(valid[:, None], U, np.nan).astype(np.float32),
                valid,
                np.where(known, residual, np.nan).astype(np.float32),
            )
            shown.update(len(rows))


def _ages(params: Params, motion: Motion, gatherer: Gatherer) -> tuple[float, float]:
    """Youngest and oldest candidates (s) that any event can need, from the flow at the border."""
    tau_max, b = float(params.tau_max), float(params.baseline)
    mean = np.asarray(motion.mean[motion.valid], float)
    if not len(mean):
        return tau_max / 2, tau_max
    border = np.concatenate(
        [gatherer.xi[0], gatherer.xi[-1], gatherer.xi[:, 0], gatherer.xi[:, -1]]
    )
    model = motion.model(gatherer.f)
    basis = np.asarray(model.basis(border))
    if model.uniform:
        speed = float(np.linalg.norm(mean @ basis[0].T, axis=1).max())
    else:
        speed = float(np.linalg.norm(np.abs(basis).max(0) @ np.abs(mean).max(0)))
    if model.half_line:
        speed += float(params.fastest)
    return min(b / 2 / max(speed, 1e-9), tau_max / 2), tau_max


@eqx.filter_jit
def _flows(
    params: Params,
    model: Model,
    candidates: Candidates,
    mean: Float[Array | NDArray, "batches K dimension"],
) -> tuple[Float[Array, "batches K 2"], Float[Array, "batches K"]]:
    """Flow and residual of batches of events."""
    grid = jnp.geomspace(params.slowest, params.fastest, params.speeds)
    grid = jnp.concatenate([jnp.zeros(1, grid.dtype), grid])

    def one(batch: tuple[Array, Array, Array, Array]):
        d, age, xi, mean = batch
        base = jax.vmap(model.flow)(xi, mean)
        a = jax.vmap(model.line)(xi, mean) if model.half_line else jnp.zeros_like(base)
        q = d - age[..., None] * base  # C K 2
        along = (q * a).sum(-1)
        off = ((q - along[..., None] * a) ** 2).sum(-1)
        rho = jnp.zeros_like(along[0])
        if model.half_line:
            rho = _voted(params, grid, age, along, off, base, a)
        U = base + rho[:, None] * a
        moved = _moved(params, age, length(U))
        nearest = jnp.sqrt(off + (along - rho * age) ** 2)
        return U, jnp.where(moved, nearest, jnp.inf).min(0)

    d, age = (jnp.swapaxes(jnp.asarray(part), 1, 2) for part in (candidates.d, candidates.age))
    xi = jnp.asarray(candidates.xi)
    return lax.map(one, (d, age, xi, jnp.asarray(mean)))


def _moved(params: Params, age: Array, speed: Array) -> Array:
    """Which candidates a flow of this speed has moved by b/2 to b; none where there is none."""
    way = age * speed
    return (age > 0) & (way >= params.baseline / 2) & (way <= params.baseline)


def _voted(
    params: Params, grid: Array, age: Array, along: Array, off: Array, base: Array, a: Array
) -> Float[Array, " K"]:
    """The speed (px/s) along the half-line for which most candidates (C, K) vote."""
    exponent = -0.5 / params.sigma_x**2
    share = jnp.where(age > 0, jnp.exp(off * exponent), 0)
    speed = length(base[:, None] + grid[:, None] * a[:, None])  # K speeds

    def add(S: Array, one: tuple[Array, Array, Array]):
        age, along, share = (part[:, None] for part in one)
        votes = share * jnp.exp((along - grid * age) ** 2 * exponent)
        return S + jnp.where(_moved(params, age, speed), votes, 0), None

    S = lax.scan(add, jnp.zeros_like(speed), (age, along, share))[0]
    # A fast flow looks at younger, fewer candidates.
    rho = grid[(S * speed**params.gain).argmax(1)]
    for _ in range(REFINEMENTS):
        votes = share * jnp.exp((along - rho * age) ** 2 * exponent)
        votes = jnp.where(_moved(params, age, length(base + rho[:, None] * a)), votes, 0)
        moment = (votes * age**2).sum(0)
        fitted = (votes * along * age).sum(0) / jnp.where(moment > 0, moment, 1)
        rho = jnp.where(moment > 0, jnp.clip(fitted, 0, params.fastest), rho)
    return rho
