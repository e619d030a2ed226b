"""A recording's windows one beside another, each from where the one before goes on."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.bundle.path import Path, advanced
from jaxevent.egomotion.bundle.windows import Fit, Params, Rival, Windows, near_to
from jaxevent.egomotion.estimator import COMMON_OPTIONS, HostEstimator, HostInputs
from jaxevent.egomotion.models import General
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.patches import ImageSpeed
from jaxevent.progress import bar

WAYS = 24.0, 150.0  # px in a window, with which the default length is kept
SHORTEST, LONGEST = 0.02, 2.0  # s, of half a window
# Of how far the motion at a window's end is from that at its middle, what is not known of it. Of
# varying motion (seeds 810, 811) squared errors of Omega 0.1 s from the middle are 40 to 180 times
# the variance at the middle, 0.1 to 2 with this; of constant motion about 1.
BENT = 0.5
# rad, `Fit.doubted`, from which the next window is not followed but has rivals of its own: what is
# followed is alone, and so told too surely.
DOUBTED = 1.0
LOST = 4  # times the least cost of the windows before: the path is not followed


def solve(params: Params, given: HostInputs) -> MotionEstimate:
    """The general motion of a camera, from windows that overlap.

    The motion at a time is the mean of what the windows around it tell, of those nearer the more
    (a raised cosine). Estimates are a fifth of a `step` apart. The seed chooses events where a
    window has more than `events`. The option `gyro` (`twists.from_gyro`) settles Omega.
    """
    recording, camera, gyro = given.recording, given.camera, given.options.get("gyro")
    assert camera is not None
    if not len(recording.events):
        return MotionEstimate.empty(given.model)
    windows = Windows(recording, params, camera, gyro, given.seed)
    first, last = int(recording.events[:1].t[0]), int(recording.events[-1:].t[0])
    half, step = (round(1e6 * float(value)) for value in (params.half_window, params.step))
    centres = np.arange(first + half, last - half + 1, step)
    if not len(centres):
        centres = np.array([(first + last) // 2])
    fits = _followed(windows, centres.tolist(), step, half, given.progress)
    return _blended(centres, fits, half, step, first, last)


def _followed(
    windows: Windows, centres: list[int], step: int, half: int, progress: bool | None
) -> list[Fit | None]:
    """The windows one after the other, each from where the one before goes on.

    One is followed while the one before is at its last stage: steps of one keep about one core
    busy, and that stage changes little.
    """
    fits: list[Fit | None] = []
    enough = [np.diff(windows.rows(c, half * 1e-6))[0] >= windows.params.fewest for c in centres]
    warm: Path | None = None
    ahead: Future[Rival] | None = None
    since, wait, cost = 0, windows.params.fresh, 0.0

    def onward(path: Path, steps: int = 1) -> Path:
        return advanced(path, steps * step * 1e-6, half * 1e-6)

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
                rival = ahead.result() if ahead else windows.followed(centre, warm)
                ahead = None
                if since + 1 < wait and row + 1 < len(centres) and enough[row + 1]:
                    path = onward(rival[0].path)
                    ahead = beside.submit(windows.followed, centres[row + 1], path)
                fit = windows.ended(centre, [rival])
                anew = fit is None or not fit.cost <= LOST * cost
            if anew:
                ahead, fit = None, windows.fit(centre, warm)
            fits.append(fit)
            if fit is None:
                warm = None
                continue
            if anew:
                agreed = warm is not None and near_to(fit.path, warm)
                if warm is not None and not agreed:
                    _revise(windows, centres[: len(fits)], fits, onward)
                since, wait = 0, 2 * wait if agreed else windows.params.fresh
                if fit.doubted > DOUBTED:
                    since = wait
            cost = fit.cost if anew else min(cost, fit.cost)
            warm = onward(fit.path)
    return fits


def _revise(
    windows: Windows, centres: list[int], fits: list[Fit | None], onward: Callable[..., Path]
) -> None:
    """The last window found a motion that was not followed to it: those before are fitted again.

    Each starts from the one after it, back to where that ends at what was found before; of the new
    ones so many of the last remain as together save most.
    """
    row, later, gained = len(fits) - 1, fits[-1], 0.0
    new: dict[int, Fit] = {}
    while row > 0 and later is not None:
        row, old = row - 1, fits[row - 1]
        before = windows.followed(centres[row], onward(later.path, -1))
        later = windows.ended(centres[row], [before])
        if old is None or later is None or near_to(later.path, old.path):
            break
        new[row] = later
        gained += old.cost + windows.turning(old.path)
        gained -= later.cost + windows.turning(later.path)
        if gained > 0:
            for at, fit in new.items():
                fits[at] = fit
            new, gained = {}, 0.0


def _blended(
    centres: NDArray, fits: list[Fit | None], half: int, step: int, first: int, last: int
) -> MotionEstimate:
    """The motion of overlapping windows; lost where none tells it.

    Of a window the middle two thirds count, those beyond `reach` where no other tells more. How far
    a window disagrees with its neighbours is in its covariance; on a side where it has none, `BENT`
    of how far its motion there is from that at its middle. Where the camera is slower than at the
    middle the heading is known less.
    """
    end = 2 * half // 3
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
        T, turn = fit.path.twist((t[near] - centre) * 1e-6)
        heading[near] += weight[:, None] * T
        Omega[near] += weight[:, None] * turn
        way = np.concatenate([T, turn], 1) - np.concatenate(fit.path.twist(0.0), 1)
        way = BENT * way * _alone(fits, k, t[near] - centre)[:, None]
        bent = way[:, :, None] * way[:, None, :]
        told = _slower(fit.covariance, fit.path.pace((t[near] - centre) * 1e-6))
        covariance[near] += weight[:, None, None] * (told + off + bent)
        agreement[near] += weight * fit.agreement
        total[near] += weight
    lost = (total < 1e-6) | ~np.isfinite(covariance).all((1, 2))
    safe = np.where(lost, 1, total)
    size = np.linalg.norm(heading, axis=1, keepdims=True)
    heading = np.where(size > 0, heading / np.where(size > 0, size, 1), np.array([0.0, 0, 1]))
    mean = np.concatenate([heading, Omega / safe[:, None]], 1)
    told = MotionEstimate.from_arrays(General, t, mean, covariance / safe[:, None, None], ~lost)
    return dataclasses.replace(told, agreement=agreement / safe)


def _slower(covariance: NDArray, pace: NDArray) -> NDArray[np.float64]:
    """Covariances (times, 6, 6) where |T| is `pace` times that of which one is known.

    What is known is the velocity, whose direction is known less the slower it is.
    """
    told = float(np.trace(covariance[:3, :3]))
    most = np.pi / 2 / np.sqrt(told) if told > 0 else np.inf
    grown = np.clip(1 / np.maximum(pace, 1e-6), 1, max(most, 1))
    factors = np.ones((len(pace), 6))
    factors[:, :3] = grown[:, None]
    return factors[:, :, None] * covariance * factors[:, None, :]


def _alone(fits: list[Fit | None], row: int, since: NDArray) -> NDArray[np.bool_]:
    """Whether at times since a window's middle there is no window beside it, on that side."""
    there = [0 <= other < len(fits) and fits[other] is not None for other in (row - 1, row + 1)]
    return np.where(since < 0, not there[0], not there[1])


def _disagreements(
    centres: NDArray, fits: list[Fit | None], half: int
) -> list[NDArray[np.float64]]:
    """Mean squares (6, 6) of how far windows differ from those before and after that they overlap.

    Halfway between them. What one window shows beside its own errors is whether another, of other
    events in part, finds the same: a minimum that is not the truth's comes and goes.
    """
    found: list[list[NDArray[np.float64]]] = [[] for _ in fits]
    for k, (one, other) in enumerate(zip(fits[:-1], fits[1:], strict=True)):
        way = int(centres[k + 1] - centres[k])
        if one is None or other is None or way >= 2 * half:
            continue
        before, after = (
            np.concatenate(fit.path.twist(0.5e-6 * side), 1)[0]
            for fit, side in ((one, way), (other, -way))
        )
        square = np.outer(after - before, after - before)
        found[k].append(square)
        found[k + 1].append(square)
    return [np.mean(squares, 0) if squares else np.zeros((6, 6)) for squares in found]


def lengths(params: Params, speed: ImageSpeed) -> dict[str, float]:
    """Windows in which the image moves by some pixels."""
    way = 2 * float(params.half_window) * speed.median
    if WAYS[0] <= way <= WAYS[1]:
        return {}
    half = min(max((WAYS[0] if way < WAYS[0] else WAYS[1]) / speed.median / 2, SHORTEST), LONGEST)
    return {"half_window": half, "step": half * float(params.step) / float(params.half_window)}


batch = HostEstimator(
    "batch",
    Params,
    solve,
    models=(General.name,),
    options=COMMON_OPTIONS | {"gyro"},
    lengths=lengths,
    about="General motion by fitting a whole window of events: the camera's path and the scene's "
    "depth. Estimates of overlapping windows are blended, a fifth of a `step` apart.",
)
