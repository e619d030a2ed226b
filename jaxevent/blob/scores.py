"""Tracks compared with true paths, by the measures of multi-object tracking.

CLEAR MOT: Bernardin, Stiefelhagen, "Evaluating multiple object tracking performance", 2008. IDF1:
Ristani et al., "Performance measures and a data set for multi-target, multi-camera tracking", 2016.
HOTA: Luiten et al., "HOTA: a higher order metric for evaluating multi-object tracking", 2021, here
of distances as TrackEval has it: similar by 1 - d / (2 reach), from 0 on.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from jaxevent.errors import InputError

HOTA_THRESHOLDS = np.arange(1, 20) / 20  # least similarities of a pair, over which HOTA is a mean
MIN_MATCHED_TIME_SHARE = (
    0.5  # of its time that a found target has a track, or a true track a target
)


@dataclasses.dataclass(frozen=True)
class TrackScores:
    """Scores of tracks against targets.

    Attributes:
        match: (times, targets), the track matched to each target; -1: none.
        targets: Number of targets.
        tracks: Number of tracks.
        found: Targets near which one track is for half of their time or more.
        missed: The other targets.
        false: Tracks that are near no target for half of their time or more.
        switches: Number of changes of a target's track.
        covered: Share of the targets' time in which they have a track.
        rms: Distance of matched pairs, root of the mean square, px; NaN: there is none.
        mota: 1 - (misses + false positives + switches) / truth; negative where errors are more.
        idf1: F1 score of positions under the best one-to-one pairing of whole tracks and targets.
        hota: Geometric mean of detection and association, over thresholds of distance.
        deta: Its detection.
        assa: Its association.
    """

    match: NDArray[np.int64]
    targets: int
    tracks: int
    found: int
    missed: int
    false: int
    switches: int
    covered: float
    rms: float
    mota: float
    idf1: float
    hota: float
    deta: float
    assa: float


def score_tracks(
    truth: NDArray[np.floating],
    tracks: NDArray[np.floating],
    reach: ArrayLike | float | int,
    hidden: NDArray[np.bool_] | None = None,
) -> TrackScores:
    """Compare tracks with true paths at some times.

    Args:
        truth: True positions (times, targets, 2) in px; NaN where a target is not.
        tracks: Positions of tracks (times, tracks, 2); NaN where a track is not.
        reach: Largest distance of a matched pair, px; one, or (times, targets).
        hidden: Whether a target cannot be seen (times, targets): there neither a track near it nor
            a missing one is an error.

    Returns:
        The scores.

    Raises:
        InputError: The arrays do not fit each other.
    """
    truth, tracks = np.asarray(truth, np.float64), np.asarray(tracks, np.float64)
    fit = truth.ndim == tracks.ndim == 3 and truth.shape[2:] == tracks.shape[2:] == (2,)
    if not fit or len(truth) != len(tracks):
        raise InputError(
            f"a truth of {truth.shape} and tracks of {tracks.shape} do not fit; give "
            "(times, targets, 2) and (times, tracks, 2)"
        )
    there = np.asarray(np.isfinite(truth).all(2))
    distance = np.linalg.norm(truth[:, :, None] - tracks[:, None], axis=-1)
    reach = np.broadcast_to(np.asarray(reach, np.float64), there.shape)[..., None]
    near = distance <= reach
    waits = np.zeros(tracks.shape[:2], bool)
    if hidden is not None:
        there &= ~hidden
        waits = (near & hidden[..., None]).any(1)
    alive = np.asarray(np.isfinite(tracks).all(2) & ~waits)
    pairs = near & there[..., None] & alive[:, None]
    real, tracked = there.any(0), np.isfinite(tracks).all(2).any(0)

    match, switches = _match(pairs, distance)
    matched = match >= 0
    number, misses = int(there.sum()), int(there.sum() - matched.sum())
    k, i = np.nonzero(matched)
    errors = distance[k, i, match[k, i]]
    shared = pairs.sum(0)
    i, j = linear_sum_assignment(shared, maximize=True)
    total = number + int(alive.sum())
    most = shared.max(1, initial=0)
    found = int((most[real] >= MIN_MATCHED_TIME_SHARE * there.sum(0)[real]).sum())
    lives = np.isfinite(tracks).all(2).sum(0)
    follows = (pairs.any(1) | waits).sum(0)
    deta, assa, hota = _hota(np.where(there[..., None], distance, np.inf), reach, there, alive)
    return TrackScores(
        match=match,
        targets=int(real.sum()),
        tracks=int(tracked.sum()),
        found=found,
        missed=int(real.sum()) - found,
        false=int((tracked & (follows < MIN_MATCHED_TIME_SHARE * lives)).sum()),
        switches=switches,
        covered=float(matched.sum() / max(number, 1)),
        rms=float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan"),
        mota=float(1 - (misses + alive.sum() - matched.sum() + switches) / max(number, 1)),
        idf1=float(2 * shared[i, j].sum() / total) if total else 1.0,
        hota=hota,
        deta=deta,
        assa=assa,
    )


def _match(
    pairs: NDArray[np.bool_], distance: NDArray[np.float64]
) -> tuple[NDArray[np.int64], int]:
    """Match tracks to targets at each time by the rules of CLEAR.

    A matched pair stays matched while it may; the others are matched at the least distance.

    Args:
        pairs: (times, targets, tracks) whether a track is near enough to a target.
        distance: (times, targets, tracks) px.

    Returns:
        (times, targets) track of each target, -1 for none, and the number of switches between
            tracks.
    """
    times, targets, tracks = pairs.shape
    match, last, switches = np.full((times, targets), -1), np.full(targets, -1), 0
    for k in range(times):
        if not pairs[k].any():
            continue
        free = np.ones(tracks, bool)
        for i in np.flatnonzero(last >= 0):
            if free[last[i]] and pairs[k, i, last[i]]:
                match[k, i], free[last[i]] = last[i], False
        rest = np.flatnonzero(match[k] < 0)
        possible = pairs[k, rest] & free
        # As many pairs as possible come before the least distance.
        worth = np.where(possible, 1e6 - distance[k, rest], 0)
        for i, j in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
            if possible[i, j]:
                match[k, rest[i]] = j
        now = match[k] >= 0
        switches += int((now & (last >= 0) & (match[k] != last)).sum())
        last = np.where(now, match[k], last)
    return match, switches


def _hota(
    distance: NDArray[np.float64],
    reach: NDArray[np.float64],
    there: NDArray[np.bool_],
    alive: NDArray[np.bool_],
) -> tuple[float, float, float]:
    """Compute HOTA (Luiten et al. 2021), means over `HOTA_THRESHOLDS`.

    Args:
        distance: (times, targets, tracks) px, infinite where a target is not there.
        reach: (times, targets, 1) distance at which the similarity of a track and a target is 1/2,
            px.
        there: (times, targets) whether a target is there.
        alive: (times, tracks) whether a track is alive.

    Returns:
        Detection, association and HOTA, 0 to 1.
    """
    similar = np.maximum(1 - np.where(alive[:, None], distance, np.inf) / (2 * reach), 0)
    if not there.any() and not alive.any():
        return 1.0, 1.0, 1.0
    all_pairs = similar.sum(1, keepdims=True) + similar.sum(2, keepdims=True) - similar
    possible = (similar / np.maximum(all_pairs, 1e-12)).sum(0)
    n_true, n_tracked = there.sum(0)[:, None], alive.sum(0)
    alignment = possible / np.maximum(n_true + n_tracked - possible, 1e-12)
    count = np.zeros((len(HOTA_THRESHOLDS), *possible.shape))
    for now in similar:
        i, j = linear_sum_assignment(alignment * now, maximize=True)
        count[:, i, j] += now[i, j] >= HOTA_THRESHOLDS[:, None] - 1e-12
    true = count.sum((1, 2))
    deta = true / (there.sum() + alive.sum() - true)
    assa = (count**2 / np.maximum(n_true + n_tracked - count, 1)).sum((1, 2)) / np.maximum(true, 1)
    return float(deta.mean()), float(assa.mean()), float(np.sqrt(deta * assa).mean())
