"""Contrast maximisation: the motion that makes the image of warped events sharpest; a baseline.

After Gallego, Rebecq & Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras"
(CVPR 2018) and Gallego & Scaramuzza, "Accurate Angular Velocity Estimation with an Event Camera"
(RA-L 2017). The events of a time window are moved along a constant motion to the window's middle,

    planar:    x' = x - U t
    rotation:  X' = exp(Omega t) X,  x' = f (X'_x, X'_y) / X'_z,  X = (x, y, f)

with t (s) from the middle, and are summed with their polarity into a blurred image J. The estimate
maximises the mean square or the variance of J: the events of one scene point then fall together. It
is refined from coarse to fine blur, starting from the motion of the previous window. For the first
window, and after the motion was lost, all motions are searched. SciPy's BFGS uses one compiled
gradient for all blurs.

If all edges are straight and parallel, J is equally sharp for all motions along them, and chance
decides which one is best. So each maximum is compared with motions up to 6 px away along its
flattest axis, on the points that all of these motions keep in view: elsewhere edges would end at
the sensor's border. The cells of the image are resampled with replacement, and the maximum of each
draw is found (bootstrap; Efron, Ann. Stat. 1979). Its mean square is added to the covariance. If
more than one in twenty draws has its maximum at either end, the motion is lost.

Points that enter or leave the sensor within the window bias the motion towards 0, because a slower
motion keeps their cut tracks together as well. So J only counts where a point is in view for the
whole window. That region is computed from the initial motion of an ascent, and then fixed. Events
are weighted less towards the window's ends.

An event gives its pixel, not its position within the pixel. If all events were at the pixels'
middles, and objects moved almost along rows or columns, J would become sharper by the grid alone.
The motion across would then be too large, whatever the blur and the number of events. Events that
are spread randomly over their pixels do not show the grid.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from jaxevent import threads
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.baselines.fits import Fit, motion_of_fits
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.estimator import HostEstimator, HostInputs
from jaxevent.egomotion.geometry import blur, splat
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import CovarianceCalibration, MotionEstimate
from jaxevent.egomotion.patches import ImageSpeed
from jaxevent.parameters import Choice, Count, Parameters, Positive, UnitInterval
from jaxevent.progress import bar
from jaxevent.recording import Recording

N_COARSE_BLURS = 8  # blurs by [1 2 1] / 4 in a search: 2 px
N_MIDDLE_BLURS = 2  # blurs after that
FINEST_GRID_SPACING_PX = 2.0  # between motions of a search grid, at the window's end
GRID_RANGE_RATIO = 4.0  # range of a search grid over that of the next, finer one
N_REFINED_MOTIONS = 4  # motions of a grid that are refined
INDEPENDENT_CELL_PX = 24  # side of the image's cells, whose errors are taken as independent
CURVATURE_PROBE_PX = 0.5  # step of the differences that measure the curvature, at the window's end
# Along the flattest axis, at the window's end.
COMPARED_DISPLACEMENTS_PX = np.arange(-6.0, 7.0, 2.0)
N_DRAWS = 200  # bootstrap draws of the image's cells
MAX_UNBOUNDED_FRACTION = 0.05  # of draws with the maximum at the ends of the displacements
MIN_RELATIVE_GRADIENT = 1e-3  # 1/px, relative to the objective, at which an ascent ends
BEST_WINDOW_DISPLACEMENT_PX = 10.0  # of the image in an adapted window
WINDOW_DISPLACEMENT_RANGE_PX = (5.0, 60.0)  # within which the default duration is kept
WINDOW_DURATION_RANGE_S = (0.002, 2.0)  # of an adapted window
COVARIANCE_CALIBRATION = CovarianceCalibration(change=0.09)
SYSTEMATIC_ERROR_PX = 0.25  # of the displacement in a window, from events at pixels' middles
MIN_DENSITY_RATIO = 0.35  # density of events in a half of a window over that in the densest half
MAX_ALL_HALVED = 3  # number of estimates up to which every window is halved to measure changes
N_HALVED_WINDOWS = 5  # windows halved if there are more, for changes that neighbours do not show
RELATIVE_MOTION_NOISE = 0.5  # 1/sqrt(s), relative change of a motion, if windows are few
INITIAL_INVERSE_CURVATURE_PX2 = 2.0  # px^2, relative to the objective, of an ascent's first step
PARALLEL_EDGES_WARNING = (
    "the edges in view are parallel: events show the motion across them alone, and any motion "
    "along them explains the events as well; rows are empty"
)

Numeric = Array | np.ndarray


class Params(Parameters):
    """Parameters of contrast maximisation."""

    window: Choice = Choice(
        ("duration", "events"), "windows of `duration`, or of `events` events each"
    )
    polarity: Choice = Choice(("signed", "ignored"), "OFF events count -1, or 1 like ON")
    measure: Choice = Choice(("mean square", "variance"), "of the image of warped events")
    taper: Choice = Choice((True, False), "weight events by cos(pi t / length), or all alike")
    whole: Choice = Choice(
        (True, False), "count only points that are in view for the whole window, or all"
    )
    dither: Choice = Choice(
        (True, False), "place events randomly within their pixels, or at the middles"
    )

    events: Count = Count(
        20000, "", "events of a window; if `duration` holds more, this many, evenly spaced"
    )
    fewest: Count = Count(300, "", "least number of events of an estimate")
    blur: Count = Count(1, "", "final number of blurs of the image by [1 2 1] / 4")
    steps: Count = Count(20, "", "most steps of the ascent at each blur")
    starts: Count = Count(7, "", "motions per component in each grid of the search")
    margin: Count = Count(16, "px", "margin of the image around the sensor")

    duration: Positive = Positive(0.1, "s", "length of a window, in which the motion is constant")
    overlap: UnitInterval = UnitInterval(0.5, "", "fraction of a window that the next one shares")
    speed_max: Positive = Positive(
        4000.0, "px/s", "planar: largest component of motions of the search"
    )
    omega_max: Positive = Positive(
        30.0, "rad/s", "rotation: largest component of motions of the search"
    )
    contrast: Positive = Positive(
        1.2, "", "square of J, relative to chance, below which the motion is lost"
    )


class Window(eqx.Module):
    """The events of a window, padded to a fixed number by events of weight 0.

    Attributes:
        xi: Positions, px, see `pixel_coordinates`.
        t: Times from the middle of the window, s.
        weight: Signed weights; 0 for padding.
        shuffled: The times in random order, s.
        mask: 1 where the image counts; see `mask_visible`.
        ends: Begin and end of the window from its middle, s.
        scale: Motion per px of displacement at the window's end.
        model: Motion model.
        shape: Height and width of the image, px.
        offset: Position of its pixel [0, 0], px.
        box: Extent of the sensor, x0, y0, x1, y1, px.
    """

    xi: Float[Numeric, "N 2"]
    t: Float[Numeric, " N"]
    weight: Float[Numeric, " N"]
    shuffled: Float[Numeric, " N"]
    mask: Float[Numeric, "height width"]
    ends: Float[Numeric, "2"]
    scale: Float[Numeric, " dimension"]
    model: Model
    shape: tuple[int, int] = eqx.field(static=True)
    offset: tuple[float, float] = eqx.field(static=True)
    box: tuple[float, float, float, float] = eqx.field(static=True)

    def warp(self, xi: Array, t: Array, motion: Array) -> Float[Array, "n 2"]:
        """Move positions from their times to the middle.

        Args:
            xi: (n, 2) positions, px.
            t: (n,) times from the middle, s.
            motion: (d,) motion.

        Returns:
            (n, 2) positions, px.
        """
        return self.model.warp(xi, motion * t[:, None])

    @property
    def sum_squared_weights(self) -> Float[Array, ""]:
        """Sum of squared weights, at least 1; without a taper the number of events."""
        return jnp.maximum(jnp.sum(jnp.asarray(self.weight) ** 2), 1)


def mask_visible(window: Window, motion: Float[Numeric, " dimension"]) -> Window:
    """Restrict the image to points that the sensor sees from the window's start to its end.

    If these are less than a quarter of the sensor, all points count. The mask has no derivative.

    Args:
        window: The window.
        motion: (d,) motion.

    Returns:
        The window with the mask.
    """
    height, width = window.shape
    y, x = jnp.mgrid[:height, :width].reshape(2, -1)
    xi = jnp.stack([x + window.offset[0], y + window.offset[1]], -1)
    x0, y0, x1, y1 = window.box
    xi, motion = xi.astype(window.mask.dtype), lax.stop_gradient(jnp.asarray(motion))
    inside = jnp.ones(len(xi), bool)
    # A point moves from the middle to the time t as it moves from -t to the middle.
    for t in jnp.asarray(window.ends):
        at = window.warp(xi, jnp.full(len(xi), -t), motion)
        inside &= (at >= jnp.array([x0, y0])).all(1) & (at <= jnp.array([x1, y1])).all(1)
    enough = inside.sum() * 4 >= (x1 - x0 + 1) * (y1 - y0 + 1)
    mask = jnp.where(enough, inside, True).astype(window.mask.dtype)
    return dataclasses.replace(window, mask=mask.reshape(height, width))


def warped_image(
    params: Params,
    window: Window,
    motion: Float[Numeric, " dimension"],
    n_blurs: int | Int[Array, ""] | None = None,
) -> Float[Array, "height width"]:
    """Make the blurred image of warped events J.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) motion.
        n_blurs: Number of blurs; by default `params.blur`. If traced, at most the larger of
            `N_COARSE_BLURS` and `params.blur`.

    Returns:
        (height, width) image.
    """
    weight = jnp.asarray(window.weight)
    if params.polarity == "ignored":
        weight = jnp.abs(weight)
    at = window.warp(jnp.asarray(window.xi), jnp.asarray(window.t), jnp.asarray(motion))
    image = splat(at, weight, window.shape, window.offset)
    if n_blurs is None or isinstance(n_blurs, int):
        return blur(image, params.blur if n_blurs is None else n_blurs)

    def blur_again(J, k):
        return lax.cond(k < n_blurs, blur, lambda J: J, J), None

    return lax.scan(blur_again, image, jnp.arange(max(N_COARSE_BLURS, params.blur)))[0]


def objective(
    params: Params,
    window: Window,
    motion: Float[Numeric, " dimension"],
    n_blurs: int | Int[Array, ""] | None = None,
) -> Float[Array, ""]:
    """Compute the sum of J^2, or of (J - mean J)^2, over the window's mask, per event.

    It is differentiable in the motion and in the events' positions, times and weights. Bilinear
    weights have no second derivative, so the curvature is measured by differences of the gradient.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) motion.
        n_blurs: Number of blurs, see `warped_image`.

    Returns:
        The value.
    """
    J, mask = warped_image(params, window, motion, n_blurs), jnp.asarray(window.mask)
    if params.measure == "variance":
        J = J - jnp.sum(mask * J) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.sum(mask * J**2) / window.sum_squared_weights


@eqx.filter_jit
def _value_and_grad(
    params: Params, window: Window, z: Array, n_blurs: Array
) -> tuple[Array, Array]:
    """Compute the objective and its gradient.

    Args:
        params: The parameters.
        window: The window.
        z: (d,) motion, px at the window's end.
        n_blurs: Number of blurs.

    Returns:
        The objective and its gradient (d,).
    """
    scale = jnp.asarray(window.scale)
    return jax.value_and_grad(lambda z: objective(params, window, z * scale, n_blurs))(z)


_mask_visible = eqx.filter_jit(mask_visible)


def _cell_parts(params: Params, window: Window, z: Array) -> Float[Array, " cells"]:
    """Return each image cell's part of the objective, with the measure "mean square".

    Args:
        params: Parameters.
        window: The window.
        z: (dimension,) motion, in px of displacement at the window's end.

    Returns:
        (cells,) parts, row by row.
    """
    J = warped_image(params, window, z * jnp.asarray(window.scale)) * window.mask
    rows, columns = (-(-n // INDEPENDENT_CELL_PX) for n in J.shape)
    size = rows * INDEPENDENT_CELL_PX, columns * INDEPENDENT_CELL_PX
    J = jnp.pad(J, [(0, whole - n) for whole, n in zip(size, J.shape, strict=True)])
    cells = (J**2).reshape(rows, INDEPENDENT_CELL_PX, columns, INDEPENDENT_CELL_PX)
    return cells.sum((1, 3)).reshape(-1) / window.sum_squared_weights


@eqx.filter_jit
def _cell_gradients(params: Params, window: Window, z: Array) -> Float[Array, "cells dimension"]:
    """Return the gradient of each image cell's part of the objective.

    Args:
        params: Parameters.
        window: The window.
        z: (dimension,) motion, in px of displacement at the window's end.

    Returns:
        Gradients with respect to `z`, 1/px.
    """
    return jax.jacfwd(lambda z: _cell_parts(params, window, z))(z)


@eqx.filter_jit
def _cell_profile(
    params: Params, window: Window, z: Float[Array, "motions dimension"]
) -> Float[Array, "motions cells"]:
    """Return each image cell's part of the objective, on points that all motions keep in view.

    Args:
        params: Parameters.
        window: The window.
        z: Motions along a line, in px of displacement at the window's end; the first and the last
            determine the points in view.

    Returns:
        Parts of the cells, for each motion.
    """
    motions = z * jnp.asarray(window.scale)
    masks = lax.map(lambda motion: mask_visible(window, motion).mask, motions[jnp.array([0, -1])])
    window = dataclasses.replace(window, mask=masks.prod(0))
    return lax.map(lambda z: _cell_parts(params, window, z), z)


def _evaluate(
    params: Params, window: Window, z: NDArray, n_blurs: int
) -> tuple[float, NDArray[np.float64]]:
    """Compute the objective and its gradient on the host, in double precision.

    Args:
        params: The parameters.
        window: The window.
        z: (d,) motion, px at the window's end.
        n_blurs: Number of blurs.

    Returns:
        The objective and its gradient (d,).
    """
    real, number = jnp.result_type(float), jnp.asarray(n_blurs)
    value, slope = _value_and_grad(params, window, jnp.asarray(z, real), number)
    return float(value), np.asarray(slope, np.float64)


def ascend(
    params: Params, window: Window, motion: NDArray[np.floating], n_blurs: int | None = None
) -> tuple[NDArray[np.float64], float]:
    """Maximise the objective from a motion, by BFGS on motions in px at the window's end.

    Args:
        params: The parameters; `steps` is the largest number of steps.
        window: The window.
        motion: (d,) motion at the start.
        n_blurs: Number of blurs; by default `params.blur`.

    Returns:
        The motion (d,) at the maximum, and the objective there.
    """
    n_blurs = params.blur if n_blurs is None else n_blurs
    scale = np.asarray(window.scale, np.float64)
    begin = np.asarray(motion, np.float64) / scale
    unit = max(_evaluate(params, window, begin, n_blurs)[0], 1e-12)

    def loss(z: NDArray) -> tuple[float, NDArray]:
        value, slope = _evaluate(params, window, z, n_blurs)
        return -value / unit, -slope / unit

    initial = INITIAL_INVERSE_CURVATURE_PX2 * np.eye(len(begin))
    options = {"gtol": MIN_RELATIVE_GRADIENT, "maxiter": params.steps, "hess_inv0": initial}
    found = minimize(loss, begin, jac=True, method="BFGS", options=options)
    return found.x * scale, -float(found.fun) * unit


class WindowEstimate(NamedTuple):
    """Motion of a window, estimated by contrast maximisation.

    Attributes:
        motion: (d,) motion at the maximum.
        contrast: The objective, relative to its value with shuffled times.
        covariance: (d, d), see `covariance`.
        is_observable: Whether the objective has a maximum along every axis.
    """

    motion: NDArray[np.float64]
    contrast: float
    covariance: NDArray[np.float64] | None
    is_observable: bool


def refine(params: Params, window: Window, motion: NDArray[np.floating]) -> WindowEstimate:
    """Refine a motion, first with `N_MIDDLE_BLURS` and then with `params.blur` blurs.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) motion at the start.

    Returns:
        The estimate.
    """
    for n_blurs in (N_MIDDLE_BLURS, params.blur):
        if params.whole:
            window = _mask_visible(window, jnp.asarray(motion, window.xi.dtype))
        motion, value = ascend(params, window, motion, n_blurs)
    z = motion / np.asarray(window.scale, np.float64)
    shuffled = dataclasses.replace(window, t=window.shuffled)
    chance, _ = _evaluate(params, shuffled, z, params.blur)
    curvature = measure_curvature(params, window, motion)
    found = covariance(params, window, motion, curvature)
    spread = None if found is None else maximum_spread(params, window, motion, curvature)
    if found is not None and spread is not None:
        found = found + spread
    return WindowEstimate(motion, value / max(chance, 1e-12), found, spread is not None)


class Curvature(NamedTuple):
    """Eigenvalues and eigenvectors of the objective's negative Hessian, motions in px."""

    values: NDArray[np.float64]  # (d,) in ascending order
    axes: NDArray[np.float64]  # (d, d) eigenvectors in columns


def measure_curvature(params: Params, window: Window, motion: NDArray[np.floating]) -> Curvature:
    """Measure the curvature of the objective at a motion, from differences of gradients.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) the motion.

    Returns:
        The curvature; 0 along all axes where gradients are not finite.
    """
    z = np.asarray(motion, np.float64) / np.asarray(window.scale, np.float64)
    H = [
        _evaluate(params, window, z + h, params.blur)[1]
        - _evaluate(params, window, z - h, params.blur)[1]
        for h in CURVATURE_PROBE_PX * np.eye(len(z))
    ]
    H = np.array(H) / (2 * CURVATURE_PROBE_PX)
    if not np.isfinite(H).all():
        return Curvature(np.zeros(len(z)), np.eye(len(z)))
    return Curvature(*np.linalg.eigh(-(H + H.T) / 2))


def covariance(
    params: Params, window: Window, motion: NDArray[np.floating], curvature: Curvature
) -> NDArray[np.float64] | None:
    """Return the sandwich covariance H^-1 (sum_c g_c g_c') H^-1 of a motion.

    H is the objective's curvature at its maximum. g_c is the gradient of the part of the objective
    in cell c of the image (24 px). These gradients sum to 0, and if cells are independent, their
    scatter gives the error of the maximum. Changes of the motion within the window are not
    included; see `CovarianceCalibration`. Curvatures are raised to at least 1 % of the largest.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) motion at the maximum.
        curvature: The curvature there.

    Returns:
        (d, d) covariance, or None if there is no maximum.
    """
    scale = np.asarray(window.scale, np.float64)
    z = np.asarray(motion, np.float64) / scale
    values, axes = curvature
    g = np.asarray(_cell_gradients(params, window, jnp.asarray(z, window.xi.dtype)), np.float64)
    if not (np.isfinite(g).all() and values[-1] > 0):
        return None
    inverse = axes / np.maximum(values, 0.01 * values[-1]) @ axes.T
    return inverse @ (g.T @ g) @ inverse * np.outer(scale, scale)


def maximum_spread(
    params: Params, window: Window, motion: NDArray[np.floating], curvature: Curvature
) -> NDArray[np.float64] | None:
    """Return the bootstrap covariance of the maximum along its flattest axis.

    Args:
        params: The parameters.
        window: The window.
        motion: (d,) motion at the maximum.
        curvature: The curvature there.

    Returns:
        (d, d) covariance, or None if the draws do not bound the maximum, as along parallel edges.
    """
    scale = np.asarray(window.scale, np.float64)
    axis = curvature.axes[:, 0]
    z = np.asarray(motion, np.float64) / scale + COMPARED_DISPLACEMENTS_PX[:, None] * axis
    profile = _cell_profile(params, window, jnp.asarray(z, window.xi.dtype))
    profile = np.asarray(profile, np.float64)
    profile = profile[:, profile.any(0)]
    cells = profile.shape[1]
    if not cells:
        return None
    draws = np.random.default_rng(0).multinomial(cells, np.full(cells, 1 / cells), N_DRAWS)
    best = (profile @ draws.T).argmax(0)
    if np.isin(best, [0, len(z) - 1]).mean() > MAX_UNBOUNDED_FRACTION:
        return None
    offset = axis * scale
    return (COMPARED_DISPLACEMENTS_PX[best] ** 2).mean() * np.outer(offset, offset)


class EventRange(NamedTuple):
    """The events of a window."""

    middle: int  # us
    begin: int  # row of the first event
    end: int  # row after the last event


class WindowSequence:
    """Windows of a recording; iterating over them gives each one's `EventRange`.

    Args:
        recording: The recording.
        params: The parameters.
        model: Motion model, or its name.
        camera: The camera; by default the recording's.
        seed: Seed of the random numbers.

    Raises:
        InputError: The model is unknown, or it needs a camera and there is none.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params | None = None,
        model: str | type[Model] = "planar",
        camera: PinholeCamera | None = None,
        seed: int = 0,
    ):
        self.recording, self.params = recording, params or Params()
        kind, camera = contrast.find_model_and_camera(recording, model, camera)
        self.xi, f = pixel_coordinates(recording.width, recording.height, camera)
        self.model = kind(f)
        margin = self.params.margin
        low = np.floor(self.xi.min((0, 1))) - margin
        width, height = (np.ceil(self.xi.max((0, 1))) + margin - low).astype(int) + 1
        self.shape, self.offset = (int(height), int(width)), (float(low[0]), float(low[1]))
        x0, y0, x1, y1 = (float(v) for v in (*self.xi.min((0, 1)), *self.xi.max((0, 1))))
        self.box = x0, y0, x1, y1
        self.pixel_scale = self.model.pixel_scale(self.xi)
        p = self.params
        self.search_bound = float(self.model.search_bound(p))
        self._rng = np.random.default_rng(seed)
        advance = max(1 - float(p.overlap), 0.01)
        events = recording.events
        n = len(events)
        whole = int(events[n - 1 :].t[0] - events[:1].t[0]) + 1 if n else 1
        self._length = min(max(round(1e6 * float(p.duration)), 2), whole)
        self._step = max(round(advance * self._length), 1)
        self._stride = max(round(advance * p.events), 1)

    def __len__(self) -> int:
        return len(self._begins)

    @functools.cached_property
    def _begins(self) -> NDArray[np.int64]:
        """Times (us) at which windows begin, or rows of events."""
        n = len(self.recording.events)
        if not n:
            return np.zeros(0, np.int64)
        if self.params.window == "events":
            return np.arange(0, max(n - self.params.events, 0) + 1, self._stride)
        first, last = self.recording.event_span()
        return np.arange(first, max(last - self._length, first) + 1, self._step)

    def __iter__(self) -> Iterator[EventRange]:
        events, n = self.recording.events, len(self.recording.events)
        for begin in self._begins:
            if self.params.window == "events":
                first, end = int(begin), min(int(begin) + self.params.events, n)
                ends = events[first : first + 1].t[0], events[end - 1 : end].t[0]
                yield EventRange(int(ends[0] + ends[1]) // 2, first, end)
            else:
                first, end = (events.index(int(begin) + k) for k in (0, self._length))
                yield EventRange(int(begin) + self._length // 2, first, end)

    def length(self, part: EventRange) -> float:
        """Return the length (s) of a window."""
        if self.params.window == "duration":
            return 1e-6 * self._length
        events = self.recording.events
        ends = events[part.begin : part.begin + 1].t, events[part.end - 1 : part.end].t
        return 1e-6 * float(ends[1][0] - ends[0][0]) if len(ends[0]) and len(ends[1]) else 0.0

    def half_length(self, part: EventRange) -> float:
        """Return half the length (s) of a window, about its middle."""
        if self.params.window == "duration":
            return self._length * 0.5e-6
        events = self.recording.events[part.begin : part.end]
        return max(np.abs(events.t - part.middle).max(initial=0) * 1e-6, 1e-6)

    def filled_parts(self, part: EventRange) -> NDArray[np.bool_]:
        """Return whether events fill a window's first quarter, its middle, and its last quarter.

        If the camera starts or stops within a window, events fill only a part of it. They fill the
        middle if they are about equally dense in the first, the central and the last half.

        Args:
            part: The range of events.

        Returns:
            (3,) booleans.
        """
        t = self.recording.events[part.begin : part.end].t
        half = 1e6 * self.half_length(part)
        count = np.histogram(t, part.middle + half * np.linspace(-1, 1, 5))[0]
        halves = count[:-1] + count[1:]
        least = MIN_DENSITY_RATIO * halves.max()
        return np.array([2 * count[0] >= least, halves.min() >= least, 2 * count[-1] >= least])

    def crop(self, part: EventRange, half: float | None = None) -> Window:
        """Make the window of a range of events, or of its middle part.

        Args:
            part: The range of events.
            half: Half the length of the middle part, s, for a search; at most a quarter of
                `params.events` are kept. By default the whole window is made.

        Returns:
            The window.
        """
        events, t = self.recording.events[part.begin : part.end], part.middle
        size = self.params.events
        rows = np.arange(len(events))
        if half is None:
            half = self.half_length(part)
        else:
            size = -(-size // 4)
            rows = np.flatnonzero(np.abs(events.t - t) <= 1e6 * half)
        if len(rows) > size:
            rows = rows[np.linspace(0, len(rows) - 1, size).round().astype(int)]
        real, n = np.dtype(jnp.result_type(float)), len(rows)
        xi, times, weight = (np.zeros(s, real) for s in ((size, 2), (2, size), size))
        xi[:n] = self.xi[events.y[rows].astype(int), events.x[rows].astype(int)]
        if self.params.dither:
            xi[:n] += self._rng.uniform(-0.5, 0.5, (n, 2))
        times[:, :n] = (events.t[rows] - t) * 1e-6
        weight[:n] = np.where(events.p[rows], 1, -1)
        if self.params.taper:
            weight *= np.cos(np.clip(times[0] / half, -1, 1) * np.pi / 2)
        times[1, :n] = self._rng.permutation(times[1, :n])
        scale = (1 / (self.pixel_scale * half)).astype(real)
        ends, mask = np.array([-half, half], real), np.ones(self.shape, real)
        return Window(
            xi, times[0], weight, times[1], mask, ends, scale,
            self.model, self.shape, self.offset, self.box,
        )  # fmt: skip

    def measure_change(
        self, part: EventRange, motion: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measure the change of the motion within a window from estimates of its two halves.

        Args:
            part: The range of events.
            motion: (d,) motion of the whole window.

        Returns:
            (d,) change and its covariance (d, d); both 0 if the motion of a half is lost.
        """
        quarter = self.half_length(part) / 2
        middles = [part.middle + round(1e6 * side * quarter) for side in (-1, 1)]
        first, second = (
            refine(self.params, self.crop(part._replace(middle=middle), quarter), motion)
            for middle in middles
        )
        is_sharp = min(first.contrast, second.contrast) >= float(self.params.contrast)
        if not is_sharp or first.covariance is None or second.covariance is None:
            return np.zeros(len(motion)), np.zeros((len(motion), len(motion)))
        common = Fit(second.motion - first.motion, first.covariance + second.covariance)
        error = np.sqrt(2) * SYSTEMATIC_ERROR_PX
        noise = common.with_systematic_error(error, self.length(part) / 2, self.pixel_scale)
        return 2 * noise.mean, 4 * noise.covariance

    def mean_square_unseen_change(
        self, parts: list[EventRange], spans: NDArray[np.floating], estimate: MotionEstimate
    ) -> NDArray[np.float64]:
        """Return the mean square (d, d) of changes within windows that neighbours do not show.

        A motion that reverses several times within a window has the same mean in all windows.

        Args:
            parts: Windows of the estimate.
            spans: Lengths of the windows, s.
            estimate: Motions of the windows.

        Returns:
            The mean square, less that of errors.
        """
        valid = np.flatnonzero(estimate.valid)
        t, found = estimate.t[valid], estimate.mean[valid]
        squares = []
        for k in valid[np.linspace(0, len(valid) - 1, N_HALVED_WINDOWS).round().astype(int)]:
            change, covariance = self.measure_change(parts[k], estimate.mean[k])
            at = estimate.t[k] + 5e5 * spans[k] * np.array([-1, 1])
            before, after = np.stack([np.interp(at, t, column) for column in found.T], 1)
            far = change - (after - before)
            squares.append(np.outer(far, far) - covariance)
        values, vectors = np.linalg.eigh(np.mean(squares, 0))
        return vectors * np.maximum(values, 0) @ vectors.T

    def search(self, part: EventRange) -> NDArray[np.float64]:
        """Search for the motion of a window over all motions, from wide to narrow grids.

        The window of each grid is so short that neighbouring motions differ by
        `FINEST_GRID_SPACING_PX` at its end. The widest grid, of all motions, has the shortest
        window. Each further grid is narrower by `GRID_RANGE_RATIO`, and its window longer by the
        same factor, up to the whole window. The best motions so far join those of each grid, and
        all are refined. So a motion is found at any speed; if several explain a short window, a
        longer one separates them.

        Args:
            part: The range of events.

        Returns:
            (d,) motion.
        """
        params, whole = self.params, self.half_length(part)
        # Range of a grid in px, as a motion times s.
        reach = FINEST_GRID_SPACING_PX * (params.starts - 1) / 2 / self.pixel_scale.max()
        bounds = [self.search_bound]
        while params.starts > 1 and reach / bounds[-1] < whole:
            bounds.append(bounds[-1] / GRID_RANGE_RATIO)
        found: list[NDArray[np.float64]] = []
        for bound in bounds:
            half = min(max(reach / bound, 1e-6), whole)
            window = self.crop(part, half)
            if np.count_nonzero(window.weight) < params.fewest and bound != bounds[-1]:
                continue
            starts = [*found, *self._grid_peaks(window, bound)]
            refined = [ascend(params, window, motion, N_COARSE_BLURS) for motion in starts]
            found = _drop_duplicates(refined, np.asarray(window.scale, np.float64))[
                :N_REFINED_MOTIONS
            ]
        window = self.crop(part)
        refined = [ascend(params, window, motion, N_COARSE_BLURS) for motion in found]
        return max(refined, key=lambda one: one[1])[0]

    def _grid_peaks(self, window: Window, bound: float) -> list[NDArray[np.float64]]:
        """Find the best local maxima of a grid of motions.

        Args:
            window: The window.
            bound: Largest size of each component.

        Returns:
            The motions, the best first.
        """
        dimension, number = self.model.dimension, self.params.starts
        axis = np.linspace(-bound, bound, number) if number > 1 else np.zeros(1)
        motions = np.stack(np.meshgrid(*[axis] * dimension, indexing="ij"), -1)
        steps = motions.reshape(-1, dimension) / np.asarray(window.scale, np.float64)
        values = np.array([_evaluate(self.params, window, z, N_COARSE_BLURS)[0] for z in steps])
        values = values.reshape(motions.shape[:-1])
        peaks = np.where(values == maximum_filter(values, 3), values, -np.inf).ravel()
        best = np.argsort(-peaks, kind="stable")[:N_REFINED_MOTIONS]
        return [motions.reshape(-1, dimension)[row] for row in best if np.isfinite(peaks[row])]


def _drop_duplicates(
    refined: list[tuple[NDArray[np.float64], float]], scale: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Keep the best of motions that are close to each other.

    Args:
        refined: Motions (d,) and their objectives.
        scale: (d,) motion of 1 px at the window's end.

    Returns:
        The motions, the best first.
    """
    kept: list[NDArray[np.float64]] = []
    for motion, _ in sorted(refined, key=lambda one: -one[1]):
        if all(
            np.abs((motion - other) / scale).max() > FINEST_GRID_SPACING_PX / 2 for other in kept
        ):
            kept.append(motion)
    return kept


def solve(params: Params, inputs: HostInputs) -> MotionEstimate:
    """Estimate the motion at the middles of overlapping windows.

    `contrast` is the objective relative to its value with shuffled times. If it is too small, or
    events are too few or do not fill the window, the motion is lost: its mean is that of the
    previous window, and all motions are searched for the next one. The first and the last estimate
    are extended to the ends of their windows if events reach them.

    Args:
        params: The parameters.
        inputs: Recording, model and options.

    Returns:
        The estimate.
    """
    threads.check_not_forked()
    windows = WindowSequence(inputs.recording, params, inputs.model, inputs.camera, inputs.seed)
    if not len(windows):
        return MotionEstimate.empty(inputs.model)
    motion, fits, contrasts = None, [], []
    parts: list[EventRange] = []
    unobservable = 0
    for part in bar(windows, desc="sharpen windows", unit="window", progress=inputs.progress):
        parts.append(part)
        if part.end - part.begin < params.fewest or not windows.filled_parts(part)[1]:
            motion = None
            fits.append(None)
            contrasts.append(0.0)
            continue
        if motion is None:
            motion = windows.search(part)
        found = refine(params, windows.crop(part), motion)
        is_sharp = found.contrast >= float(params.contrast)
        is_found = is_sharp and found.is_observable
        unobservable += is_sharp and not is_found
        fit = None
        if is_found and found.covariance is not None:
            fit = Fit(found.motion, found.covariance).with_systematic_error(
                SYSTEMATIC_ERROR_PX, windows.length(part), windows.pixel_scale
            )
        motion = found.motion if is_sharp and found.covariance is not None else None
        fits.append(fit)
        contrasts.append(found.contrast)
    t = np.array([part.middle for part in parts])
    spans = np.array([windows.length(part) for part in parts])
    estimate = motion_of_fits(inputs.model, t, fits, np.array(contrasts))
    change = rate = None
    valid = np.flatnonzero(estimate.valid)
    if not len(valid) and unobservable:
        return dataclasses.replace(estimate, warning=PARALLEL_EDGES_WARNING)
    if 0 < len(valid) <= MAX_ALL_HALVED:
        change = np.zeros_like(estimate.mean)
        for k in valid:
            change[k] = windows.measure_change(parts[k], estimate.mean[k])[0]
    if change is not None and len(valid) == 1:
        k = int(valid[0])
        rate = np.outer(change[k], change[k]) / max(1e6 * spans[k], 1) ** 2
    calibration = COVARIANCE_CALIBRATION.with_lens(inputs.camera)
    estimate = estimate.with_calibrated_covariance(calibration, spans, change)
    if change is not None:
        # A random walk of variance q^2 t deviates from its mean over a window T by a mean square of
        # q^2 T / 6. This prior counts as much as one window, so n windows divide it by n.
        square = RELATIVE_MOTION_NOISE**2 * (estimate.mean**2).sum(1) * spans / (6 * len(valid))
        added = square[:, None, None] * np.eye(estimate.mean.shape[1])
        estimate = dataclasses.replace(estimate, covariance=estimate.covariance + added)
    elif len(valid):
        # A linear change by d over a window deviates from its mean by d / sqrt(12), rms.
        added = windows.mean_square_unseen_change(parts, spans, estimate) / 12
        estimate = dataclasses.replace(estimate, covariance=estimate.covariance + added)
    before, after = (
        round(1e6 * windows.half_length(part)) if windows.filled_parts(part)[end] else 0
        for part, end in ((parts[0], 0), (parts[-1], 2))
    )
    return estimate.extended_to(int(t[0]) - before, int(t[-1]) + after, rate)


def adapt_lengths(params: Params, speed: ImageSpeed) -> dict[str, float]:
    """Return a duration in which the image moves by 10 px, if the default is far from that."""
    displacement = speed.fast * float(params.duration)
    low, high = WINDOW_DISPLACEMENT_RANGE_PX
    if params.window != "duration" or low <= displacement <= high:
        return {}
    shortest, longest = WINDOW_DURATION_RANGE_S
    return {"duration": min(max(BEST_WINDOW_DISPLACEMENT_PX / speed.fast, shortest), longest)}


contrast = HostEstimator(
    "contrast",
    Params,
    solve,
    linear=True,
    adapt_lengths=adapt_lengths,
    about="The motion that makes the image of warped events sharpest (Gallego et al., CVPR 2018), "
    "in overlapping windows of time, each by itself.",
)
