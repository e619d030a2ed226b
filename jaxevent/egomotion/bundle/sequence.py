"""Motion of a whole recording: its windows one after another, and their blend."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.hypotheses import Hypothesis, WindowFit, WindowFitter, is_near
from jaxevent.egomotion.bundle.warp import Path, predict_path
from jaxevent.egomotion.bundle.windows import Params
from jaxevent.egomotion.estimator import COMMON_OPTIONS, HostEstimator, HostInputs
from jaxevent.egomotion.models import General
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.patches import ImageSpeed
from jaxevent.events.clocks import warn_of_clocks
from jaxevent.progress import bar

# Motion of the image in a window, with which the default length stays.
WINDOW_DISPLACEMENT_RANGE_PX = (24.0, 150.0)
MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S = 0.02, 2.0
# Uncertainty of the motion at the end of a window without neighbour, by its difference from that at
# the middle. Squared errors of Omega 0.1 s from the middle are then 0.1 to 2 times the variance.
WINDOW_END_SIGMA_PER_CHANGE = 0.5
MAX_AMBIGUITY_RAD = 1.0  # of a window whose path is followed into the next one
LOST_COST_RATIO = 4  # times the least cost of the windows before: the path is not followed


def estimate_motion(params: Params, given: HostInputs) -> MotionEstimate:
    """Estimate the general motion of a camera from windows that overlap.

    The motion at a time is the mean of those of the windows around it, those nearer weighted more
    (a raised cosine). Estimates are a fifth of a `step` apart.

    Args:
        params: Parameters.
        given: Recording, camera, seed of the choice of events, and the option `gyro`
            (`truth.twists_from_gyro`), which gives Omega.

    Returns:
        The motion, lost at times that no window determines.

    Raises:
        InputError: All events are at one time.
    """
    recording, camera, gyro = given.recording, given.camera, given.options.get("gyro")
    assert camera is not None
    if not len(recording.events):
        return MotionEstimate.empty(given.model)
    recording.refuse_one_time()
    if params.frames:
        warn_of_clocks(recording)
    windows = WindowFitter(recording, params, camera, gyro, given.seed)
    first, last = recording.event_span()
    half, step = (round(1e6 * float(value)) for value in (params.half_window, params.step))
    centres = np.arange(first + half, last - half + 1, step)
    if not len(centres):
        centres = np.array([(first + last) // 2])
    fits = _fit_windows(windows, centres.tolist(), step, half, given.progress)
    return _blend(centres, fits, half, step, (first, last))


def _fit_windows(
    windows: WindowFitter, centres: list[int], step: int, half: int, progress: bool | None
) -> list[WindowFit | None]:
    """Fit windows one after another, each from the predicted path of the one before.

    After some windows new starts compete with that path. The next window is begun while the last
    stage of the one before runs: steps of one keep about one core busy, and that stage changes
    little.

    Args:
        windows: Windows of the recording.
        centres: Middles of the windows, us.
        step: Time from one to the next, us.
        half: Half the length of one, us.
        progress: Whether to show a bar.

    Returns:
        The fits; None for windows that are lost.
    """
    fits: list[WindowFit | None] = []
    enough = [
        np.diff(windows.event_range(c, half * 1e-6))[0] >= windows.params.fewest for c in centres
    ]
    warm: Path | None = None
    ahead: Future[Hypothesis] | None = None
    since, wait, cost = 0, windows.params.fresh, 0.0

    def onward(path: Path, steps: int = 1) -> Path:
        return predict_path(path, steps * step * 1e-6, half * 1e-6)

    shown = bar(centres, desc="fit motion", unit="window", progress=progress)
    with ThreadPoolExecutor(1) as beside:
        for row, centre in enumerate(shown):
            if not enough[row]:
                warm = ahead = None
                fits.append(None)
                continue
            since, fit = since + 1, None
            anew = warm is None or since >= wait
            if warm is not None and not anew:
                found = ahead.result() if ahead else windows.refine_from(centre, warm)
                ahead = None
                if since + 1 < wait and row + 1 < len(centres) and enough[row + 1]:
                    path = onward(found[0].path)
                    ahead = beside.submit(windows.refine_from, centres[row + 1], path)
                fit = windows.refine_final(centre, [found])
                anew = fit is None or not fit.cost <= LOST_COST_RATIO * cost
            if anew:
                ahead, fit = None, windows.fit(centre, warm)
            fits.append(fit)
            if fit is None:
                warm = None
                continue
            if anew:
                agreed = warm is not None and is_near(fit.path, warm)
                if warm is not None and not agreed:
                    _refit_backwards(windows, centres[: len(fits)], fits, onward)
                since, wait = 0, 2 * wait if agreed else windows.params.fresh
                if fit.ambiguity > MAX_AMBIGUITY_RAD:
                    since = wait
            cost = fit.cost if anew else min(cost, fit.cost)
            warm = onward(fit.path)
    return fits


def _refit_backwards(
    windows: WindowFitter,
    centres: list[int],
    fits: list[WindowFit | None],
    onward: Callable[..., Path],
) -> None:
    """Refit the windows before one in which new starts found another motion, in place.

    Each starts from the one after it, back to where that ends at what was found before; of the new
    fits so many of the last remain as together save most.

    Args:
        windows: Windows of the recording.
        centres: Middles of the windows so far, us.
        fits: Their fits.
        onward: Predicts a path by a number of windows.
    """
    row, later, gained = len(fits) - 1, fits[-1], 0.0
    new: dict[int, WindowFit] = {}
    while row > 0 and later is not None:
        row, old = row - 1, fits[row - 1]
        before = windows.refine_from(centres[row], onward(later.path, -1))
        later = windows.refine_final(centres[row], [before])
        if old is None or later is None or is_near(later.path, old.path):
            break
        new[row] = later
        gained += old.cost - later.cost
        if gained > 0:
            for at, fit in new.items():
                fits[at] = fit
            new, gained = {}, 0.0


def _blend(
    centres: NDArray,
    fits: list[WindowFit | None],
    half: int,
    step: int,
    span: tuple[int, int],
) -> MotionEstimate:
    """Blend the motions of overlapping windows.

    Of a window the middle two thirds count, those beyond `step` hardly. The covariance contains the
    window's disagreement with its neighbours; without neighbour, `WINDOW_END_SIGMA_PER_CHANGE` of
    the difference of its motion there from that at its middle. If the camera is slower than at the
    middle, the heading is less certain.

    Args:
        centres: Middles of the windows, us.
        fits: Fits of the windows, None if lost.
        half: Half the length of a window, us.
        step: Time from one window to the next, us.
        span: First and last time of the recording, us.
    """
    (first, last), end = span, 2 * half // 3
    every = max(min(step // 5, (last - first) // 4), 1)
    t = np.arange(max(centres[0] - end, first), min(centres[-1] + end, last) + 1, every)
    heading, Omega = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    covariance, total, agreement = np.zeros((len(t), 6, 6)), np.zeros(len(t)), np.zeros(len(t))
    reach = min(end, step)
    apart = _disagreements(centres, fits, half)
    for k, (centre, fit, off) in enumerate(zip(centres, fits, apart, strict=True)):
        near = np.abs(t - centre) <= end
        if fit is None or not near.any():
            continue
        far = np.minimum(np.abs(t[near] - centre) / max(reach, 1), 1)
        weight = np.maximum(np.cos(np.pi / 2 * far) ** 2, 1e-3)
        T, turn = fit.path.unit_twist((t[near] - centre) * 1e-6)
        heading[near] += weight[:, None] * T
        Omega[near] += weight[:, None] * turn
        way = np.concatenate([T, turn], 1) - np.concatenate(fit.path.unit_twist(0.0), 1)
        way = (
            WINDOW_END_SIGMA_PER_CHANGE
            * way
            * _has_no_neighbour(fits, k, t[near] - centre)[:, None]
        )
        bent = way[:, :, None] * way[:, None, :]
        speed = fit.path.relative_speed((t[near] - centre) * 1e-6)
        scaled = _scale_heading_covariance(fit.covariance, speed)
        covariance[near] += weight[:, None, None] * (scaled + off + bent)
        agreement[near] += weight * fit.agreement
        total[near] += weight
    lost = (total < 1e-6) | ~np.isfinite(covariance).all((1, 2))
    safe = np.where(lost, 1, total)
    size = np.linalg.norm(heading, axis=1, keepdims=True)
    heading = np.where(size > 0, heading / np.where(size > 0, size, 1), np.array([0.0, 0, 1]))
    mean = np.concatenate([heading, Omega / safe[:, None]], 1)
    found = MotionEstimate.from_arrays(General, t, mean, covariance / safe[:, None, None], ~lost)
    return dataclasses.replace(found, agreement=agreement / safe)


def _scale_heading_covariance(covariance: NDArray, speed: NDArray) -> NDArray[np.float64]:
    """Scale a window's covariance to times at which the speed has changed.

    The fit determines the velocity. The direction of a velocity is the less certain the slower it
    is.

    Args:
        covariance: (6, 6), of heading and Omega at the window's middle.
        speed: (times,) |T| in units of that at the middle.

    Returns:
        (times, 6, 6).
    """
    variance = float(np.trace(covariance[:3, :3]))
    most = np.pi / 2 / np.sqrt(variance) if variance > 0 else np.inf
    grown = np.clip(1 / np.maximum(speed, 1e-6), 1, max(most, 1))
    factors = np.ones((len(speed), 6))
    factors[:, :3] = grown[:, None]
    return factors[:, :, None] * covariance * factors[:, None, :]


def _has_no_neighbour(fits: list[WindowFit | None], row: int, since: NDArray) -> NDArray[np.bool_]:
    """Return whether a window lacks a neighbour on the side of some times.

    Args:
        fits: Fits of all windows, None where one failed.
        row: Number of the window.
        since: (times,) times from the window's middle; the sign counts.

    Returns:
        (times,) booleans.
    """
    there = [0 <= other < len(fits) and fits[other] is not None for other in (row - 1, row + 1)]
    return np.where(since < 0, not there[0], not there[1])


def _disagreements(
    centres: NDArray, fits: list[WindowFit | None], half: int
) -> list[NDArray[np.float64]]:
    """Measure how much overlapping windows disagree, halfway between their middles.

    Another window has other events in part, and a false minimum comes and goes.

    Args:
        centres: (windows,) middles, us.
        fits: Fits of the windows, None where one failed.
        half: Half the length of a window, us.

    Returns:
        For each window the mean square (6, 6) of the differences of heading and Omega from those of
        its neighbours.
    """
    found: list[list[NDArray[np.float64]]] = [[] for _ in fits]
    for k, (one, other) in enumerate(zip(fits[:-1], fits[1:], strict=True)):
        way = int(centres[k + 1] - centres[k])
        if one is None or other is None or way >= 2 * half:
            continue
        before, after = (
            np.concatenate(fit.path.unit_twist(0.5e-6 * side), 1)[0]
            for fit, side in ((one, way), (other, -way))
        )
        square = np.outer(after - before, after - before)
        found[k].append(square)
        found[k + 1].append(square)
    return [np.mean(squares, 0) if squares else np.zeros((6, 6)) for squares in found]


def adapt_lengths(params: Params, speed: ImageSpeed) -> dict[str, float]:
    """Return `half_window` and `step` for windows in which the image moves by some pixels."""
    way = 2 * float(params.half_window) * speed.median
    low, high = WINDOW_DISPLACEMENT_RANGE_PX
    if low <= way <= high:
        return {}
    half = (low if way < low else high) / speed.median / 2
    half = min(max(half, MIN_HALF_WINDOW_S), MAX_HALF_WINDOW_S)
    return {"half_window": half, "step": half * float(params.step) / float(params.half_window)}


batch = HostEstimator(
    "batch",
    Params,
    estimate_motion,
    models=(General.name,),
    options=COMMON_OPTIONS | {"gyro"},
    adapt_lengths=adapt_lengths,
    about="General motion by fitting a whole window of events: the camera's path and the scene's "
    "depth. Estimates of overlapping windows are blended, a fifth of a `step` apart.",
)
