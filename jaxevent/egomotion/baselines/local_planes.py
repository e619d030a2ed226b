"""Motion from planes through the latest events: local plane fitting, as a baseline.

After Benosman et al., "Event-based visual flow" (IEEE TNNLS 2014). The times of a polarity's latest
events, one per pixel, are a surface t(x, y) that a moving edge raises as it passes. Its gradient
(s/px) points along the edge's motion, and

    u_n = grad t / |grad t|^2

is the normal flow (px/s), the part of the image velocity across the edge. Each event gets a plane
by least squares over its neighbourhood, from which what lies off the plane is left out, again and
again. All planes of a window then tell the motion, with n = u_n / |u_n|:

    n . U(x; motion) = |u_n|

which is linear in a planar motion and in the camera's rotation, U = B(x) Omega. Constraints are
weighted by 1 / |u_n|, for errors in proportion to it: unweighted, planes that are too flat make the
motion too fast, and by 1 / |u_n|^2, which asks grad t . U = 1, it is too slow. An edge makes a
burst of events at every pixel, and the surface keeps the first: of the latest, which have come at
some pixels and not yet at others, motion is too fast.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.egomotion.candidates import NEVER, READ_ROWS, coordinates
from jaxevent.egomotion.estimator import Given, OnHost
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Calibration, Motion
from jaxevent.parameters import Choice, Count, Parameters, Positive
from jaxevent.progress import bar
from jaxevent.recording import Recording

CELL = 16  # px; constraints of a cell are taken to err together
HUBER = 1.345  # standard deviations from which a residual counts linearly: 95 % efficient
ROUNDS = 20  # of reweighting
# Planes of simulated textures tell 1 to 3 % too much speed; beside that they err as cells do.
CALIBRATION = Calibration(share=0.009, speed=0.015, change=0.25)
LEAST_NORMALS = 0.02  # of the larger information, for the smaller not to be noise: aperture


class Params(Parameters):
    """Parameters of motion by local planes."""

    burst = Choice(("first", "latest"), "which of an edge's burst of events the surface keeps")

    radius = Count(2, "px", "a plane is fitted to neighbours so near, in x and y")
    fewest = Count(8, "", "neighbours that a plane needs")
    iterations = Count(4, "", "times that neighbours off the plane are left out")
    every = Count(1, "", "one event in so many gets a plane")
    constraints = Count(100, "", "planes that a window needs")

    oldest = Positive(
        0.04, "s", "neighbours are not older; several times radius / (expected speed)"
    )
    apart = Positive(0.02, "s", "events of a pixel nearer than that are one burst")
    tolerance = Positive(2.0, "", "neighbours off the plane by more standard deviations are left")
    rough = Positive(0.1, "", "largest share of the times' variance that is off the plane")
    speed_max = Positive(2000.0, "px/s", "planes that are as flat as faster edges count for none")
    window = Positive(0.02, "s", "an estimate is made of the planes of so long")
    step = Positive(0.01, "s", "from an estimate to the next")


class NormalFlow(NamedTuple):
    """Normal flow of events, n of them."""

    t: NDArray[np.int64]  # (n,) us, the event's
    row: NDArray[np.int64]  # (n,) of the recording's events
    flow: NDArray[np.float64]  # (n, 2) px/s, undistorted where there is a camera; 0 where not valid
    valid: NDArray[np.bool_]  # (n,) whether there was a plane
    age: NDArray[np.float64]  # (n,) s, mean of the plane's neighbours: so old is what flow tells


def normal_flow(
    recording: Recording,
    params: Params | None = None,
    *,
    camera: PinholeCamera | None = None,
    progress: bool | None = None,
) -> NormalFlow:
    """The normal flow of each event (of one in `params.every`) from the events up to it.

    Raises `InputError` for a camera without an inverse; see `geometry.undistorted`.
    """
    params = params or Params()
    xi, _ = coordinates(recording.width, recording.height, camera or recording.camera)
    shape = (2, recording.height, recording.width)
    surface, latest = np.full(shape, NEVER), np.full(shape, NEVER)
    scratch = np.zeros((3, (2 * params.radius + 1) ** 2))
    end, parts, rules = len(recording.events), [], Rules.of(params)
    with bar(
        total=end, desc="fit planes", unit="event", unit_scale=True, progress=progress
    ) as shown:
        for start in range(0, end, READ_ROWS):
            events = recording.events[start : start + READ_ROWS]
            row = np.arange(start, start + len(events))
            wanted = row % params.every == 0
            flow, age = np.zeros((len(row), 2)), np.zeros(len(row))
            valid = np.zeros(len(row), bool)
            stream = events.t, events.x, events.y, events.p
            _planes(stream, wanted, xi, surface, latest, scratch, rules, (flow, age, valid))
            parts.append((events.t[wanted], row[wanted], flow[wanted], valid[wanted], age[wanted]))
            shown.update(len(row))
    if not parts:
        none = np.zeros(0)
        return NormalFlow(
            none.astype(np.int64), none.astype(np.int64), np.zeros((0, 2)), none.astype(bool), none
        )
    return NormalFlow(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def solve(params: Params, given: Given) -> Motion:
    """The motion in windows of time, by robust least squares of the normal flow.

    Estimates are at the windows' middles; their `lag` is the mean age of the planes' neighbours.
    The covariance is that of the fit; see `robust_fit`. A window with too few planes, or with edges
    of one direction only, is lost: the motion before is held. Nothing is drawn.
    """
    recording, camera = given.recording, given.camera
    if not len(recording.events):
        return Motion.nothing(given.model)
    flows = normal_flow(recording, params, camera=camera, progress=given.progress)
    xi, f = coordinates(recording.width, recording.height, camera)
    model = given.model(f)
    size = model.arms(xi)
    window, step = (round(1e6 * float(s)) for s in (params.window, params.step))
    first, last = int(flows.t[0]), int(flows.t[-1])
    begins = np.arange(first, max(first, last - window) + 1, max(step, 1))
    rows = np.searchsorted(flows.t, np.stack([begins, begins + window], 1))
    fits, lags = [], []
    for begin, stop in rows:
        valid = np.arange(begin, stop)[flows.valid[begin:stop]]
        flow = flows.flow[valid]
        events = _events(recording, flows.row[valid])
        at = xi[events[1], events[0]]
        speed = np.linalg.norm(flow, axis=1)
        rows_of = np.einsum("ni,nid->nd", flow / speed[:, None] ** 2, basis_on_host(model, at))
        cells = events[1] // CELL * (recording.width // CELL + 1) + events[0] // CELL
        enough = len(valid) >= params.constraints
        fits.append(robust_fit(rows_of, np.ones(len(valid)), cells, size) if enough else None)
        lags.append(flows.age[valid].mean() if len(valid) else 0.0)
    motion = held(given.model, begins + window // 2, fits)
    return dataclasses.replace(motion, lag=np.array(lags)).calibrated(
        CALIBRATION.behind(camera), float(params.window)
    )


def _events(recording: Recording, rows: NDArray) -> tuple[NDArray, NDArray]:
    """Columns and rows of pixels of some events."""
    if not len(rows):
        return np.zeros(0, int), np.zeros(0, int)
    events = recording.events[int(rows[0]) : int(rows[-1]) + 1]
    rows = rows - rows[0]
    return events.x[rows].astype(int), events.y[rows].astype(int)


def basis_on_host(model: Model, xi: NDArray[np.floating]) -> NDArray[np.float64]:
    """U = basis @ motion at xi (n, 2): (n, 2, d)."""
    return np.asarray(model.basis(xi), np.float64)


class Fit(NamedTuple):
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]


def robust_fit(
    rows: NDArray[np.floating],
    values: NDArray[np.floating],
    cells: NDArray[np.integer],
    size: NDArray[np.floating],
) -> Fit | None:
    """The m that makes rows (n, dimension) @ m nearest to values (n,), by Huber's loss; or None.

    By iteratively reweighted least squares, with the scale from the median of the absolute
    residuals. The covariance is the sandwich H^-1 (sum_c g_c g_c') H^-1, where H is the weighted
    normal matrix and g_c the sum of the scores of a cell: errors within a cell may be anyhow
    correlated, those of different cells are independent. Systematic errors are not in it:
    squared errors are larger than it tells, whatever the cells' size. None where a direction of m
    is not told: its information is less than `LEAST_NORMALS` of the best told one's, of components
    in units of 1 / `size` (dimension,); see `Model.arms`.
    """
    dimension = rows.shape[1]
    if len(rows) <= dimension:
        return None
    scaled = rows / size
    weight, m = np.ones(len(rows)), np.zeros(dimension)
    for _ in range(ROUNDS):
        H = (scaled * weight[:, None]).T @ scaled
        information = np.linalg.eigvalsh(H)
        if not information[0] > LEAST_NORMALS * information[-1]:
            return None
        new = np.linalg.solve(H, (scaled * weight[:, None]).T @ values)
        residual = values - scaled @ new
        scale = 1.4826 * np.median(np.abs(residual)) + 1e-12 * np.abs(values).max()
        weight = np.minimum(1, HUBER * scale / np.maximum(np.abs(residual), 1e-300))
        done, m = np.abs(new - m).max() <= 1e-9 * np.abs(new).max(), new
        if done:
            break
    H = (scaled * weight[:, None]).T @ scaled
    covariance = sandwich(H, scaled * (weight * residual)[:, None], cells)
    return Fit(m / size, covariance / np.outer(size, size))


def sandwich(
    H: NDArray[np.floating], scores: NDArray[np.floating], cells: NDArray[np.integer]
) -> NDArray[np.float64]:
    """H^-1 (sum_c g_c g_c') H^-1, g_c the sum of the scores (n, dimension) in a cell."""
    dimension = len(H)
    which = np.unique(cells, return_inverse=True)[1]
    sums = np.zeros((which.max() + 1, dimension))
    np.add.at(sums, which, scores)
    half = np.linalg.solve(H, sums.T)
    return len(sums) / max(len(sums) - dimension, 1) * (half @ half.T)


def held(
    model: type[Model],
    t: NDArray[np.int64],
    fits: list[Fit | None],
    contrast: NDArray[np.floating] | None = None,
) -> Motion:
    """A `Motion` of fits at times t (us); where there is none it is lost and the last one held."""
    dimension = len(model.components)
    last, mean, covariance = np.zeros(dimension), [], []
    for fit in fits:
        last = last if fit is None else fit.mean
        mean.append(last)
        covariance.append(model.unknown**2 * np.eye(dimension) if fit is None else fit.covariance)
    valid = np.array([fit is not None for fit in fits], bool)
    return Motion.of(model, t, np.array(mean), np.array(covariance), valid, contrast)


class Rules(NamedTuple):
    """How planes are fitted: numbers of `Params`, times in us."""

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
    def of(cls, params: Params) -> "Rules":
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
def _planes(stream, wanted, position, surface, latest, scratch, rules, out):
    """Update the surface event by event, and fit a plane to it about each event."""
    # Names of their own: numba reads arrays out of tuples anew in every loop.
    t, x, y, p = stream
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


planes = OnHost(
    "planes",
    Params,
    solve,
    linear=True,
    about="Motion from planes through the latest events (Benosman et al., TNNLS 2014): the normal "
    "flow of a window tells the motion by robust least squares.",
)
