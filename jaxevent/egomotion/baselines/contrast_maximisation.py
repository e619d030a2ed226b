"""Motion that makes the image of warped events sharpest: contrast maximisation, as a baseline.

After Gallego, Rebecq & Scaramuzza, "A Unifying Contrast Maximization Framework for Event Cameras"
(CVPR 2018) and Gallego & Scaramuzza, "Accurate Angular Velocity Estimation with an Event Camera"
(RA-L 2017). In a window of time events are moved along a constant motion to the window's middle,

    planar:    x' = x - U t
    rotation:  X' = exp(Omega t) X,  x' = f (X'_x, X'_y) / X'_z,  X = (x, y, f)

with t (s) from the middle, and are summed, by polarity, into an image J, bilinearly and blurred.
The motion sought maximises the mean square or the variance of J: events of one point of the scene
then fall together. It is found from coarse to fine, with much blur at first, from the motion of the
window before; for the first window, and when it was lost, by a search of all motions (`search`).
SciPy's BFGS goes around one compiled gradient, for all blurs.

Points that enter or leave the sensor within the window pull the motion towards 0, for a slower one
keeps their cut tracks together as well. So J only counts where a point is in view for the whole
window, which is found from the motion that an ascent starts with and then held fixed; and events
count less towards the window's ends.

An event tells its pixel, not where in it. Were all at the pixels' middles, an image along whose
rows or columns things about move would become sharper by the grid alone, and the motion across too
large, whatever the blur and the number of events. Events that are spread over their pixels do not
see the grid.
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

from jaxevent import dispatch
from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.baselines.local_planes import Fit, held
from jaxevent.egomotion.candidates import coordinates
from jaxevent.egomotion.estimator import Given, OnHost
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Calibration, Motion
from jaxevent.egomotion.patches import Speed
from jaxevent.egomotion.warped import blur, splat
from jaxevent.parameters import Choice, Count, Parameters, Positive, UnitInterval
from jaxevent.progress import bar
from jaxevent.recording import Recording

COARSE = 8  # times [1 2 1] in a search: 2 px
MIDDLE = 2  # times, next
SPACING = 2.0  # px at the end of a short window between motions of its grid
NARROWER = 4.0  # factor between the grids of a search
TRIED = 4  # motions of a grid that are followed up
CELL = 24  # px, of the image's parts that err independently
PROBE = 0.5  # px at the window's end, between which and the maximum the curvature is taken
ENOUGH = 1e-3  # 1/px; a smaller slope, in shares of the objective, ends the ascent
WAY, WAYS = 10.0, (5.0, 60.0)  # px in a window: at best, and with which the default is kept
SHORTEST, LONGEST = 0.002, 2.0  # s
CALIBRATION = Calibration(change=0.09)
SPREAD = 2.0  # px^2; the inverse curvature, in the same unit, that an ascent begins with

Numeric = Array | np.ndarray


class Params(Parameters):
    """Parameters of contrast maximisation."""

    window = Choice(("duration", "events"), "windows of `duration`, or of `events` events each")
    polarity = Choice(("signed", "ignored"), "OFF counts -1, or as ON")
    measure = Choice(("mean square", "variance"), "of the image of warped events")
    taper = Choice((True, False), "events count cos(pi t / length) as much; or all alike")
    whole = Choice((True, False), "only points that are in view all the time count; or all")
    dither = Choice((True, False), "events are anywhere in their pixels, by chance; or at middles")

    events = Count(20000, "", "events of a window; of more within `duration`, these many evenly")
    fewest = Count(300, "", "events that an estimate needs")
    blur = Count(1, "", "times [1 2 1] / 4 over the image, at last")
    steps = Count(20, "", "most steps of the ascent at each blur")
    starts = Count(7, "", "motions of each of the search's grids in each component")
    margin = Count(16, "px", "of the image around the sensor")

    duration = Positive(0.1, "s", "length of a window; motion is taken to be constant in it")
    overlap = UnitInterval(0.5, "", "share of a window that the next one has too")
    speed_max = Positive(4000.0, "px/s", "planar: motions of the search are in +- this")
    omega_max = Positive(30.0, "rad/s", "rotation: motions of the search are in +- this")
    contrast = Positive(1.2, "", "lost where J's square is less than this, in chance's")


class Window(eqx.Module):
    """The events of a window, filled up to a fixed number with events of no weight."""

    xi: Float[Numeric, "N 2"]  # px, undistorted, from the principal point; see `coordinates`
    t: Float[Numeric, " N"]  # s from the middle
    weight: Float[Numeric, " N"]  # by polarity; 0 where there is no event
    shuffled: Float[Numeric, " N"]  # s, the same times in another order
    mask: Float[Numeric, "height width"]  # 1 where the image counts; see `in_view`
    ends: Float[Numeric, "2"]  # s from the middle
    scale: Float[Numeric, " dimension"]  # the motion per px at the window's end
    model: Model
    shape: tuple[int, int] = eqx.field(static=True)  # of the image, height and width
    offset: tuple[float, float] = eqx.field(static=True)  # px, where its pixel [0, 0] lies
    box: tuple[float, float, float, float] = eqx.field(static=True)  # px, x0, y0, x1, y1 of events


def warp(window: Window, motion: Float[Numeric, " dimension"]) -> Float[Array, "N 2"]:
    """Where what the window's events show was or will be at its middle, px."""
    return _moved(window, jnp.asarray(window.xi), jnp.asarray(window.t), jnp.asarray(motion))


def _moved(window: Window, xi: Array, t: Array, motion: Array) -> Array:
    """Places xi (n, 2) of times t (n,) at the middle."""
    return window.model.warp(xi, motion * t[:, None])


def in_view(window: Window, motion: Float[Numeric, " dimension"]) -> Window:
    """The window with a mask of the points that the sensor sees from its begin to its end.

    All points where these are less than a quarter of the sensor. Not differentiated.
    """
    height, width = window.shape
    y, x = jnp.mgrid[:height, :width].reshape(2, -1)
    place = jnp.stack([x + window.offset[0], y + window.offset[1]], -1)
    x0, y0, x1, y1 = window.box
    place, motion = place.astype(window.mask.dtype), lax.stop_gradient(jnp.asarray(motion))
    inside = jnp.ones(len(place), bool)
    # Back from the middle to the time t is as far as from -t to the middle.
    for t in jnp.asarray(window.ends):
        at = _moved(window, place, jnp.full(len(place), -t), motion)
        inside &= (at >= jnp.array([x0, y0])).all(1) & (at <= jnp.array([x1, y1])).all(1)
    enough = inside.sum() * 4 >= (x1 - x0 + 1) * (y1 - y0 + 1)
    mask = jnp.where(enough, inside, True).astype(window.mask.dtype)
    return dataclasses.replace(window, mask=mask.reshape(height, width))


def image(
    params: Params,
    window: Window,
    motion: Float[Numeric, " dimension"],
    times: int | Int[Array, ""] | None = None,
) -> Float[Array, "height width"]:
    """The image of warped events J, blurred so many times, by default `params.blur`."""
    weight = jnp.asarray(window.weight)
    if params.polarity == "ignored":
        weight = jnp.abs(weight)
    warped = splat(warp(window, motion), weight, window.shape, window.offset)
    if times is None or isinstance(times, int):
        return blur(warped, params.blur if times is None else times)

    def more(J, k):
        return lax.cond(k < times, blur, lambda J: J, J), None

    return lax.scan(more, warped, jnp.arange(max(COARSE, params.blur)))[0]


def objective(
    params: Params,
    window: Window,
    motion: Float[Numeric, " dimension"],
    times: int | Int[Array, ""] | None = None,
) -> Float[Array, ""]:
    """What the motion (px/s or rad/s) is to maximise: sum J^2, or sum (J - mean J)^2, per event.

    The sums are those over the window's mask. `times` is that of `image`; traced, it is at most
    the larger of 8 and `params.blur`. Differentiable in the motion and in the events' places, times
    and weights. Bilinear weights have no second derivative: differences of the gradient tell
    curvature.
    """
    J, mask = image(params, window, motion, times), jnp.asarray(window.mask)
    if params.measure == "variance":
        J = J - jnp.sum(mask * J) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.sum(mask * J**2) / _number(window)


def _number(window: Window) -> Array:
    return jnp.maximum(jnp.sum(jnp.asarray(window.weight) ** 2), 1)


@eqx.filter_jit
def _slope(params: Params, window: Window, z: Array, times: Array) -> tuple[Array, Array]:
    """The objective of a motion in px at the window's end, and its gradient."""
    scale = jnp.asarray(window.scale)
    return jax.value_and_grad(lambda z: objective(params, window, z * scale, times))(z)


_in_view = eqx.filter_jit(in_view)


@eqx.filter_jit
def _parts(params: Params, window: Window, z: Array) -> Float[Array, "cells dimension"]:
    """Gradients of what the image's cells have of the objective, but for the mean's part."""

    def parts(z: Array) -> Array:
        J = image(params, window, z * jnp.asarray(window.scale)) * window.mask
        height, width = (-(-n // CELL) for n in J.shape)
        J = jnp.pad(J, [(0, height * CELL - J.shape[0]), (0, width * CELL - J.shape[1])])
        squares = (J**2).reshape(height, CELL, width, CELL).sum((1, 3)).reshape(-1)
        return squares / _number(window)

    return jax.jacfwd(parts)(z)


def _value(
    params: Params, window: Window, z: NDArray, times: int
) -> tuple[float, NDArray[np.float64]]:
    real, number = jnp.result_type(float), jnp.asarray(times)
    value, slope = _slope(params, window, jnp.asarray(z, real), number)
    return float(value), np.asarray(slope, np.float64)


def ascend(
    params: Params, window: Window, motion: NDArray[np.floating], times: int | None = None
) -> tuple[NDArray[np.float64], float]:
    """The motion at the maximum of `objective` that is found from `motion`, and the value there.

    By BFGS on motions in px at the window's end; at most `params.steps` steps.
    """
    times = params.blur if times is None else times
    scale = np.asarray(window.scale, np.float64)
    begin = np.asarray(motion, np.float64) / scale
    unit = max(_value(params, window, begin, times)[0], 1e-12)

    def loss(z: NDArray) -> tuple[float, NDArray]:
        value, slope = _value(params, window, z, times)
        return -value / unit, -slope / unit

    options = {"gtol": ENOUGH, "maxiter": params.steps, "hess_inv0": SPREAD * np.eye(len(begin))}
    found = minimize(loss, begin, jac=True, method="BFGS", options=options)
    return found.x * scale, -float(found.fun) * unit


class Told(NamedTuple):
    """What a window tells of the motion."""

    motion: NDArray[np.float64]
    contrast: float  # the objective in units of what it is after the times have been shuffled
    covariance: NDArray[np.float64] | None  # see `covariance`


def refine(params: Params, window: Window, motion: NDArray[np.floating]) -> Told:
    """The motion nearest to a known one, at the blurs 2 and `params.blur`."""
    for times in (MIDDLE, params.blur):
        if params.whole:
            window = _in_view(window, jnp.asarray(motion, window.xi.dtype))
        motion, value = ascend(params, window, motion, times)
    z = motion / np.asarray(window.scale, np.float64)
    chance, _ = _value(params, dataclasses.replace(window, t=window.shuffled), z, params.blur)
    return Told(motion, value / max(chance, 1e-12), covariance(params, window, motion))


def covariance(
    params: Params, window: Window, motion: NDArray[np.floating]
) -> NDArray[np.float64] | None:
    """The sandwich H^-1 (sum_c g_c g_c') H^-1, in the motion's unit; None without a maximum.

    H is the objective's curvature at its maximum, from differences of gradients, and g_c the
    gradient of what cell c of the image (24 px) has of it. The sum of these is 0, and their scatter
    tells how far chance has moved the maximum, if cells err independently. There is no other scale.
    Changes of the motion within the window are not in it; see `Calibration`.
    A direction with less than 1 % of the largest curvature is taken to have that much.
    """
    scale = np.asarray(window.scale, np.float64)
    z = np.asarray(motion, np.float64) / scale
    probes = PROBE * np.eye(len(z))
    H = [
        _value(params, window, z + h, params.blur)[1]
        - _value(params, window, z - h, params.blur)[1]
        for h in probes
    ]
    H = np.array(H) / (2 * PROBE)
    g = np.asarray(_parts(params, window, jnp.asarray(z, window.xi.dtype)), np.float64)
    if not (np.isfinite(H).all() and np.isfinite(g).all()):
        return None
    values, vectors = np.linalg.eigh(-(H + H.T) / 2)
    if not values[-1] > 0:
        return None
    inverse = vectors / np.maximum(values, 0.01 * values[-1]) @ vectors.T
    return inverse @ (g.T @ g) @ inverse * np.outer(scale, scale)


class Windows:
    """The windows of a recording: `for t, start, stop in windows` are times and rows of events."""

    def __init__(
        self,
        recording: Recording,
        params: Params | None = None,
        model: str | type[Model] = "planar",
        camera: PinholeCamera | None = None,
        seed: int = 0,
    ):
        self.recording, self.params = recording, params or Params()
        kind, camera = contrast.place(recording, model, camera)
        self.xi, f = coordinates(recording.width, recording.height, camera)
        self.model = kind(f)
        margin = self.params.margin
        low = np.floor(self.xi.min((0, 1))) - margin
        width, height = (np.ceil(self.xi.max((0, 1))) + margin - low).astype(int) + 1
        self.shape, self.offset = (int(height), int(width)), (float(low[0]), float(low[1]))
        x0, y0, x1, y1 = (float(v) for v in (*self.xi.min((0, 1)), *self.xi.max((0, 1))))
        self.box = x0, y0, x1, y1
        self.arms = self.model.arms(self.xi)
        p = self.params
        self.extent = float(self.model.extent(p))
        self._rng = np.random.default_rng(seed)
        share = max(1 - float(p.overlap), 0.01)
        events = recording.events
        n = len(events)
        whole = int(events[n - 1 :].t[0] - events[:1].t[0]) + 1 if n else 1
        self._length = min(max(round(1e6 * float(p.duration)), 2), whole)
        self._step = max(round(share * self._length), 1)
        self._stride = max(round(share * p.events), 1)

    def __len__(self) -> int:
        return len(self._begins)

    @functools.cached_property
    def _begins(self) -> NDArray[np.int64]:
        """Times at which windows begin, or rows."""
        events, n = self.recording.events, len(self.recording.events)
        if not n:
            return np.zeros(0, np.int64)
        if self.params.window == "events":
            return np.arange(0, max(n - self.params.events, 0) + 1, self._stride)
        first, last = int(events[:1].t[0]), int(events[n - 1 :].t[0])
        return np.arange(first, max(last - self._length, first) + 1, self._step)

    def __iter__(self) -> Iterator[tuple[int, int, int]]:
        events, n = self.recording.events, len(self.recording.events)
        for begin in self._begins:
            if self.params.window == "events":
                start, stop = int(begin), min(int(begin) + self.params.events, n)
                ends = events[start : start + 1].t[0], events[stop - 1 : stop].t[0]
                yield int(ends[0] + ends[1]) // 2, start, stop
            else:
                start, stop = (events.index(int(begin) + k) for k in (0, self._length))
                yield int(begin) + self._length // 2, start, stop

    def span(self, start: int, stop: int) -> float:
        """The length (s) of the window of some rows."""
        if self.params.window == "duration":
            return 1e-6 * self._length
        events = self.recording.events
        ends = events[start : start + 1].t, events[stop - 1 : stop].t
        return 1e-6 * float(ends[1][0] - ends[0][0]) if len(ends[0]) and len(ends[1]) else 0.0

    def half(self, t: int, start: int, stop: int) -> float:
        """Half the length (s) of the window of some rows about t (us)."""
        if self.params.window == "duration":
            return self._length * 0.5e-6
        events = self.recording.events[start:stop]
        return max(np.abs(events.t - t).max(initial=0) * 1e-6, 1e-6)

    def cut(self, t: int, start: int, stop: int, half: float | None = None) -> Window:
        """The window of some rows about t (us); with `half` (s) only its middle, for a search.

        That has room for a quarter of the events.
        """
        events = self.recording.events[start:stop]
        size = self.params.events
        rows = np.arange(len(events))
        if half is None:
            half = self.half(t, start, stop)
        else:
            size = -(-size // 4)
            rows = np.flatnonzero(np.abs(events.t - t) <= 1e6 * half)
        if len(rows) > size:
            rows = rows[np.linspace(0, len(rows) - 1, size).round().astype(int)]
        real, n = np.dtype(jnp.result_type(float)), len(rows)
        xi, times, weight = (
            np.zeros((size, 2), real),
            np.zeros((2, size), real),
            np.zeros(size, real),
        )
        xi[:n] = self.xi[events.y[rows].astype(int), events.x[rows].astype(int)]
        if self.params.dither:
            xi[:n] += self._rng.uniform(-0.5, 0.5, (n, 2))
        times[:, :n] = (events.t[rows] - t) * 1e-6
        weight[:n] = np.where(events.p[rows], 1, -1)
        if self.params.taper:
            weight *= np.cos(np.clip(times[0] / half, -1, 1) * np.pi / 2)
        times[1, :n] = self._rng.permutation(times[1, :n])
        scale = (1 / (self.arms * half)).astype(real)
        ends, mask = np.array([-half, half], real), np.ones(self.shape, real)
        return Window(
            xi, times[0], weight, times[1], mask, ends, scale,
            self.model, self.shape, self.offset, self.box,
        )  # fmt: skip

    def change(
        self, t: int, start: int, stop: int, motion: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """By how much the motion changes in a window, by its halves; 0 where one is lost."""
        quarter = self.half(t, start, stop) / 2
        told = [
            refine(
                self.params,
                self.cut(t + round(1e6 * side * quarter), start, stop, quarter),
                motion,
            )
            for side in (-1, 1)
        ]
        if min(half.contrast for half in told) < float(self.params.contrast):
            return np.zeros(len(motion))
        return 2 * (told[1].motion - told[0].motion)

    def search(self, t: int, start: int, stop: int) -> NDArray[np.float64]:
        """The motion of a window of which nothing is known.

        By grids of motions, each with a window so short that its motions differ by `SPACING` px at
        the end: the widest grid, of all motions, over the shortest window, and then `NARROWER`
        grids over windows that are as much longer, up to the whole one. The best of each grid and
        of what the window before has found go on into the next window. So a motion is found however
        fast it is, and where several explain a short window a longer one tells them apart.
        """
        params, whole = self.params, self.half(t, start, stop)
        reach = SPACING * (params.starts - 1) / 2 / self.arms.max()  # px, in units of the motion s
        extents = [self.extent]
        while params.starts > 1 and reach / extents[-1] < whole:
            extents.append(extents[-1] / NARROWER)
        found: list[NDArray[np.float64]] = []
        for extent in extents:
            half = min(max(reach / extent, 1e-6), whole)
            window = self.cut(t, start, stop, half)
            if np.count_nonzero(window.weight) < params.fewest and extent != extents[-1]:
                continue
            starts = [*found, *self._peaks(window, extent)]
            tried = [ascend(params, window, motion, COARSE) for motion in starts]
            found = _different(tried, np.asarray(window.scale, np.float64))[:TRIED]
        window = self.cut(t, start, stop)
        tried = [ascend(params, window, motion, COARSE) for motion in found]
        return max(tried, key=lambda one: one[1])[0]

    def _peaks(self, window: Window, extent: float) -> list[NDArray[np.float64]]:
        """The best of the local maxima of a grid of motions within +- extent."""
        dimension, number = self.model.dimension, self.params.starts
        axis = np.linspace(-extent, extent, number) if number > 1 else np.zeros(1)
        motions = np.stack(np.meshgrid(*[axis] * dimension, indexing="ij"), -1)
        steps = motions.reshape(-1, dimension) / np.asarray(window.scale, np.float64)
        values = np.array([_value(self.params, window, z, COARSE)[0] for z in steps])
        values = values.reshape(motions.shape[:-1])
        peaks = np.where(values == maximum_filter(values, 3), values, -np.inf).ravel()
        best = np.argsort(-peaks, kind="stable")[:TRIED]
        return [motions.reshape(-1, dimension)[row] for row in best if np.isfinite(peaks[row])]


def _different(
    tried: list[tuple[NDArray[np.float64], float]], scale: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Motions by their values, the best first, of those nearer than half `SPACING` px only one."""
    kept: list[NDArray[np.float64]] = []
    for motion, _ in sorted(tried, key=lambda one: -one[1]):
        if all(np.abs((motion - other) / scale).max() > SPACING / 2 for other in kept):
            kept.append(motion)
    return kept


def solve(params: Params, given: Given) -> Motion:
    """The motion in overlapping windows of time, each by itself; estimates are at their middles.

    `contrast` is the objective in units of what it is after the events' times have been shuffled,
    by the seed. Where that is too small, or events are too few, it is lost: the motion before is
    held, and the next window is searched anew. For the covariance see `covariance`. The first and
    the last estimate are held to their windows' ends.
    """
    dispatch.check_threads()
    windows = Windows(given.recording, params, given.model, given.camera, given.seed)
    if not len(windows):
        return Motion.nothing(given.model)
    motion, t, fits, contrasts, spans = None, [], [], [], []
    rows: list[tuple[int, int, int]] = []
    for middle, start, stop in bar(
        windows, desc="sharpen windows", unit="window", progress=given.progress
    ):
        t.append(middle)
        spans.append(windows.span(start, stop))
        rows.append((middle, start, stop))
        if stop - start < params.fewest:
            motion = None
            fits.append(None)
            contrasts.append(0.0)
            continue
        if motion is None:
            motion = windows.search(middle, start, stop)
        window = windows.cut(middle, start, stop)
        told = refine(params, window, motion)
        sharp = told.contrast >= float(params.contrast)
        fit = Fit(told.motion, told.covariance) if sharp and told.covariance is not None else None
        motion = None if fit is None else fit.mean
        fits.append(fit)
        contrasts.append(told.contrast)
    found = held(given.model, np.array(t), fits, np.array(contrasts))
    alone = rate = None
    if found.valid.sum() == 1:
        k = int(found.valid.argmax())
        alone = windows.change(*rows[k], found.mean[k])
        rate = np.outer(alone, alone) / max(1e6 * spans[k], 1) ** 2
    found = found.calibrated(CALIBRATION.behind(given.camera), np.array(spans), alone)
    before, after = (round(1e6 * windows.half(*rows[k])) for k in (0, -1))
    return found.reaching(t[0] - before, t[-1] + after, rate)


def lengths(params: Params, speed: Speed) -> dict[str, float]:
    """A duration in which the image moves by some pixels."""
    way = speed.fast * float(params.duration)
    if params.window != "duration" or WAYS[0] <= way <= WAYS[1]:
        return {}
    return {"duration": min(max(WAY / speed.fast, SHORTEST), LONGEST)}


contrast = OnHost(
    "contrast",
    Params,
    solve,
    linear=True,
    lengths=lengths,
    about="The motion that makes the image of warped events sharpest (Gallego et al., CVPR 2018), "
    "in overlapping windows of time, each by itself.",
)
