"""Motion from planes through the latest events: local plane fitting, as a baseline.

After Benosman et al., "Event-based visual flow" (IEEE TNNLS 2014). The times of a polarity's latest
events, one per pixel, are a surface t(x, y) that a moving edge raises as it passes. Its gradient
(s/px) points along the edge's motion, and

    u_n = grad t / |grad t|^2

is the normal flow (px/s), the part of the image velocity across the edge. A plane is fitted to the
neighbourhood of each event by least squares, without the outliers of the plane before, several
times. All planes of a window then determine the motion, with n = u_n / |u_n|:

    n . U(x; motion) = |u_n|

which is linear in a planar motion and in the camera's rotation, U = B(x) Omega. Constraints are
weighted by 1 / |u_n|, for errors in proportion to it. Unweighted, planes that are too flat make the
motion too fast; weighted by 1 / |u_n|^2, as grad t . U = 1, it is too slow. An edge makes a burst
of events at every pixel, and the surface keeps the first. The latest have come at some pixels and
not yet at others, which makes the motion too fast.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.egomotion.baselines.fits import CORRELATED_CELL_PX, motion_of_fits, robust_fit
from jaxevent.egomotion.candidates import EVENTS_PER_READ, NEVER_US, pixel_coordinates
from jaxevent.egomotion.estimator import HostEstimator, HostInputs
from jaxevent.egomotion.motion import CovarianceCalibration, MotionEstimate
from jaxevent.parameters import Choice, Count, Parameters, Positive
from jaxevent.progress import bar
from jaxevent.recording import Recording

# Planes of simulated textures give 1 to 3 % too much speed; otherwise they err as cells do.
COVARIANCE_CALIBRATION = CovarianceCalibration(share=0.009, speed=0.015, change=0.25)


class Params(Parameters):
    """Parameters of motion by local planes."""

    burst: Choice = Choice(("first", "latest"), "event of an edge's burst that the surface keeps")

    radius: Count = Count(
        2, "px", "largest distance of neighbours to which a plane is fitted, in x and y"
    )
    fewest: Count = Count(8, "", "least number of neighbours of a plane")
    iterations: Count = Count(4, "", "number of times that outliers of the plane are removed")
    every: Count = Count(1, "", "a plane is fitted for one event in so many")
    constraints: Count = Count(100, "", "least number of planes of a window")

    oldest: Positive = Positive(
        0.04, "s", "largest age of neighbours; several times radius / (expected speed)"
    )
    apart: Positive = Positive(0.02, "s", "events of a pixel nearer than that are one burst")
    tolerance: Positive = Positive(
        2.0, "", "standard deviations from the plane beyond which are outliers"
    )
    rough: Positive = Positive(
        0.1, "", "largest fraction of the times' variance that the plane leaves"
    )
    speed_max: Positive = Positive(
        2000.0, "px/s", "largest speed of an edge; flatter planes are left out"
    )
    window: Positive = Positive(0.02, "s", "time whose planes make an estimate")
    step: Positive = Positive(0.01, "s", "time from an estimate to the next")


class NormalFlow(NamedTuple):
    """Normal flow of n events."""

    t: NDArray[np.int64]  # (n,) us, of the event
    row: NDArray[np.int64]  # (n,) row of the recording's events
    flow: NDArray[np.float64]  # (n, 2) px/s, undistorted if there is a camera; 0 where invalid
    valid: NDArray[np.bool_]  # (n,) whether there was a plane
    age: NDArray[np.float64]  # (n,) s, mean age of the plane's neighbours


def normal_flow(
    recording: Recording,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> NormalFlow:
    """Estimate the normal flow of events, each from the events before it.

    Args:
        recording: The recording.
        params: The parameters; `every` chooses the events.
        camera: The camera; by default the recording's.
        progress: Whether to show a progress bar; by default in a terminal.

    Returns:
        The normal flow.

    Raises:
        InputError: The distortion has no inverse; see `geometry.centred_coordinates`.
    """
    params = params or Params()
    xi, _ = pixel_coordinates(recording.width, recording.height, camera or recording.camera)
    shape = (2, recording.height, recording.width)
    surface = EventSurface(
        xi,
        np.full(shape, NEVER_US),
        np.full(shape, NEVER_US),
        np.zeros((3, (2 * params.radius + 1) ** 2)),
    )
    end, parts, rules = len(recording.events), [], PlaneRules.from_params(params)
    with bar(
        total=end, desc="fit planes", unit="event", unit_scale=True, progress=progress
    ) as shown:
        for start in range(0, end, EVENTS_PER_READ):
            events = recording.events[start : start + EVENTS_PER_READ]
            row = np.arange(start, start + len(events))
            wanted = row % params.every == 0
            flow, age = np.zeros((len(row), 2)), np.zeros(len(row))
            valid = np.zeros(len(row), bool)
            stream = events.t, events.x, events.y, events.p, wanted
            _fit_planes(stream, surface, rules, (flow, age, valid))
            parts.append((events.t[wanted], row[wanted], flow[wanted], valid[wanted], age[wanted]))
            shown.update(len(row))
    if not parts:
        times = np.zeros(0, np.int64)
        return NormalFlow(times, times, np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))
    return NormalFlow(*map(np.concatenate, zip(*parts, strict=True)))


def solve(params: Params, inputs: HostInputs) -> MotionEstimate:
    """Estimate the motion in windows of time, by robust least squares of the normal flow.

    Estimates are at the windows' middles; their `lag` is the mean age of the planes' neighbours.
    A window with too few planes, or with edges of one direction only, is lost, and its mean that of
    the window before. Nothing is random.

    Args:
        params: The parameters.
        inputs: Recording, model and options.

    Returns:
        The estimate.
    """
    recording, camera = inputs.recording, inputs.camera
    if not len(recording.events):
        return MotionEstimate.empty(inputs.model)
    flows = normal_flow(recording, params, camera=camera, progress=inputs.progress)
    xi, f = pixel_coordinates(recording.width, recording.height, camera)
    model = inputs.model(f)
    size = model.pixel_scale(xi)
    window, step = (round(1e6 * float(s)) for s in (params.window, params.step))
    first, last = int(flows.t[0]), int(flows.t[-1])
    begins = np.arange(first, max(first, last - window) + 1, max(step, 1))
    fits, lags = [], []
    for begin, end in np.searchsorted(flows.t, np.stack([begins, begins + window], 1)):
        valid = np.arange(begin, end)[flows.valid[begin:end]]
        flow = flows.flow[valid]
        x, y = _pixels_of(recording, flows.row[valid])
        speed = np.linalg.norm(flow, axis=1)
        basis = np.asarray(model.basis(xi[y, x]), np.float64)
        rows = np.einsum("ni,nid->nd", flow / speed[:, None] ** 2, basis)
        cells = (
            y // CORRELATED_CELL_PX * (recording.width // CORRELATED_CELL_PX + 1)
            + x // CORRELATED_CELL_PX
        )
        enough = len(valid) >= params.constraints
        fits.append(robust_fit(rows, np.ones(len(valid)), cells, size) if enough else None)
        lags.append(flows.age[valid].mean() if len(valid) else 0.0)
    motion = motion_of_fits(inputs.model, begins + window // 2, fits)
    return dataclasses.replace(motion, lag=np.array(lags)).with_calibrated_covariance(
        COVARIANCE_CALIBRATION.with_lens(camera), float(params.window)
    )


def _pixels_of(recording: Recording, rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return the pixels of some events.

    Args:
        recording: The recording.
        rows: (n,) ascending rows of the events.

    Returns:
        (n,) columns and rows, px.
    """
    if not len(rows):
        return np.zeros(0, int), np.zeros(0, int)
    events = recording.events[int(rows[0]) : int(rows[-1]) + 1]
    rows = rows - rows[0]
    return events.x[rows].astype(int), events.y[rows].astype(int)


class EventSurface(NamedTuple):
    """The latest events of each pixel, and scratch for the neighbours of one event."""

    position: NDArray  # (height, width, 2) px
    times: NDArray  # (2, height, width) us, of the first or latest events of bursts
    latest: NDArray  # (2, height, width) us
    scratch: NDArray  # (3, neighbours)


class PlaneRules(NamedTuple):
    """Numbers of `Params` for kernels.

    Attributes:
        first: Whether the surface keeps the first event of a burst, else the latest.
        apart: Time within which events of a pixel are one burst, us.
        oldest: Largest age of a plane's neighbours, us.
        radius: Largest distance of neighbours in x and y, px.
        fewest: Least number of neighbours of a plane.
        iterations: Number of times that outliers are removed.
        tolerance: As of `Params`.
        rough: As of `Params`.
        speed_max: Largest speed of an edge, px/s.
    """

    first: bool
    apart: int
    oldest: int
    radius: int
    fewest: int
    iterations: int
    tolerance: float
    rough: float
    speed_max: float

    @classmethod
    def from_params(cls, params: Params) -> "PlaneRules":
        """Convert parameters."""
        return cls(
            params.burst == "first",
            round(1e6 * float(params.apart)),
            round(1e6 * float(params.oldest)),
            params.radius,
            params.fewest,
            params.iterations,
            float(params.tolerance),
            float(params.rough),
            float(params.speed_max),
        )


@njit_noalloc
def _fit_planes(stream, surfaces, rules, out):
    """Update the surface event by event, and fit a plane to it around each event.

    Args:
        stream: Times (us), columns, rows and polarities of events, and whether each is wanted.
        surfaces: `EventSurface`, changed in place.
        rules: `PlaneRules`.
        out: Output: flow (n, 2) px/s, mean age (n,) s of the plane's events, and whether there is a
            flow.
    """
    # Names of their own: numba reads arrays out of tuples anew in every loop.
    t, x, y, p, wanted = stream
    position, surface, latest, scratch = surfaces
    first, apart, oldest, radius, fewest, iterations, tolerance, rough, speed_max = rules
    flow, age, valid = out
    height, width = surface.shape[1:]
    for i in range(len(t)):
        now, column, line, sign = t[i], int(x[i]), int(y[i]), int(p[i])
        # A burst goes on while its events are near in time and the other polarity is silent.
        begun = now - latest[sign, line, column] > apart
        begun |= latest[1 - sign, line, column] > latest[sign, line, column]
        latest[sign, line, column] = now
        if first and not begun:
            continue
        surface[sign, line, column] = now
        if not wanted[i]:
            continue
        n = 0
        for v in range(max(0, line - radius), min(height, line + radius + 1)):
            for u in range(max(0, column - radius), min(width, column + radius + 1)):
                past = now - surface[sign, v, u]
                if past <= oldest:
                    scratch[0, n] = position[v, u, 0] - position[line, column, 0]
                    scratch[1, n] = position[v, u, 1] - position[line, column, 1]
                    scratch[2, n] = -1e-6 * past
                    n += 1
        for _ in range(iterations + 1):
            if n < fewest:
                break
            mx, my, mt = 0.0, 0.0, 0.0
            for j in range(n):
                mx += scratch[0, j]
                my += scratch[1, j]
                mt += scratch[2, j]
            mx, my, mt = mx / n, my / n, mt / n
            xx, xy, yy, xt, yt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(n):
                dx, dy, dt = scratch[0, j] - mx, scratch[1, j] - my, scratch[2, j] - mt
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
                xt += dx * dt
                yt += dy * dt
                tt += dt * dt
            det = xx * yy - xy * xy
            # Neighbours on a line, or all at one time, have no plane.
            if det <= 0.05 * (xx + yy) ** 2 / 4 or tt <= 0:
                break
            gx, gy = (yy * xt - xy * yt) / det, (xx * yt - xy * xt) / det
            off = max(tt - gx * xt - gy * yt, 0.0)
            bound = tolerance * np.sqrt(off / n) + 1e-6
            kept = 0
            for j in range(n):
                away = scratch[2, j] - mt - gx * (scratch[0, j] - mx) - gy * (scratch[1, j] - my)
                if abs(away) <= bound:
                    for k in range(3):
                        scratch[k, kept] = scratch[k, j]
                    kept += 1
            steep = gx * gx + gy * gy
            if kept == n or _ == iterations:
                if off <= rough * tt and steep * speed_max * speed_max >= 1:
                    flow[i, 0], flow[i, 1] = gx / steep, gy / steep
                    age[i] = -mt
                    valid[i] = True
                break
            n = kept


planes = HostEstimator(
    "planes",
    Params,
    solve,
    linear=True,
    about="Motion from planes through the latest events (Benosman et al., TNNLS 2014): the normal "
    "flow of a window determines the motion by robust least squares.",
)
