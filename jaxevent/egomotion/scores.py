"""How far an estimate of the motion is from the truth.

    scores = motion_errors(Omega=(estimate, truth), T=(heading, true_heading))

Errors follow the egomotion thesis, 5.20 to 5.21 and 6.22 to 6.29.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.errors import InputError

_OUTLIER = 0.05  # relative magnitude error from which the thesis counts an outlier


def endpoint_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """|U - U_g| (n,) of vectors (n, components), in their unit; the mean is AEE (5.20)."""
    estimate, truth = _pair(estimate, truth)
    return np.linalg.norm(estimate - truth, axis=-1)


def relative_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """|V - V_g| / |V_g| (n,); of flow the mean is AEE_rel (5.21), of Omega the vector error.

    Infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(endpoint_error(estimate, truth), np.linalg.norm(_pair(truth, truth)[1], axis=-1))


def axis_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Angles (n,) in degrees between vectors (n, 2 or 3) of any length; the mean is AAE (6.22-25).

    arccos of the normalised product, computed by arctan2, which stays exact near 0 and 180 degrees.
    90 degrees where one of them is the zero vector, the mean over all directions, and 0 where both
    are.
    """
    estimate, truth = (unit_vectors(v) for v in _pair(estimate, truth))
    # tan(angle / 2) = |a - b| / |a + b| of unit vectors.
    apart = np.linalg.norm(estimate - truth, axis=-1)
    together = np.linalg.norm(estimate + truth, axis=-1)
    return np.degrees(2 * np.arctan2(apart, together))


def magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | (n,), in their unit; of Omega the mean is AME (6.26-27)."""
    estimate, truth = _pair(estimate, truth)
    return np.abs(np.linalg.norm(estimate, axis=-1) - np.linalg.norm(truth, axis=-1))


def relative_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | / |V_g| (n,); of Omega the mean is AME_rel (6.28).

    Infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(magnitude_error(estimate, truth), np.linalg.norm(_pair(truth, truth)[1], axis=-1))


def normalised_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """| |V| - |V_g| | / max |V_g| (n,), over the whole truth; of Omega the mean is AME_N (6.29).

    Infinite where the whole truth is 0 and the estimate is not, 0 where both are.
    """
    error = magnitude_error(estimate, truth)
    largest = np.linalg.norm(_pair(truth, truth)[1], axis=-1).max(initial=0)
    return _ratio(error, np.full(len(error), largest))


def outlier_percentage(
    estimate: ArrayLike, truth: ArrayLike, limit: float | int = _OUTLIER
) -> float:
    """Percentage of vectors whose relative magnitude error is at least `limit` (thesis 6.5.3)."""
    return _percent(relative_magnitude_error(estimate, truth) >= limit)


def motion_errors(
    *,
    U: tuple[ArrayLike, ArrayLike] | None = None,
    T: tuple[ArrayLike, ArrayLike] | None = None,
    Omega: tuple[ArrayLike, ArrayLike] | None = None,
    V: tuple[ArrayLike, ArrayLike] | None = None,
) -> dict[str, float]:
    """The thesis' figures for pairs of (estimate, truth), each (n, components), n > 0.

    - U, image velocity in px/s: AEE (px/s), AEE_rel (%), AAE_U (degrees);
    - T, translation in any unit and of any length: AAE_T (degrees);
    - Omega, in rad/s: AAE_Omega (degrees), AME (degrees/s), AME_rel (%), AME_N (%), vector_error
      (%), outliers (%);
    - V, any other vector: AME_rel (%), vector_error (%), outliers (%).

    All are means over the n times except outliers. Scaling the estimate or the truth of T by a
    positive number changes nothing. Raises `InputError` for pairs of other shapes, none at all,
    and values that are not finite.
    """
    scores: dict[str, float] = {}
    if U is not None:
        scores["AEE"] = float(endpoint_error(*U).mean())
        scores["AEE_rel"] = _percent(relative_error(*U))
        scores["AAE_U"] = float(axis_error(*U).mean())
    if T is not None:
        scores["AAE_T"] = float(axis_error(*T).mean())
    if Omega is not None:
        scores["AAE_Omega"] = float(axis_error(*Omega).mean())
        scores["AME"] = float(np.degrees(magnitude_error(*Omega)).mean())
        scores["AME_rel"] = _percent(relative_magnitude_error(*Omega))
        scores["AME_N"] = _percent(normalised_magnitude_error(*Omega))
        scores["vector_error"] = _percent(relative_error(*Omega))
        scores["outliers"] = outlier_percentage(*Omega)
    if V is not None:
        scores["AME_rel"] = _percent(relative_magnitude_error(*V))
        scores["vector_error"] = _percent(relative_error(*V))
        scores["outliers"] = outlier_percentage(*V)
    return scores


def _pair(estimate: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    pair = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if pair[0].shape != pair[1].shape or pair[0].ndim != 2 or not len(pair[0]):
        raise InputError(
            f"motions of shapes {pair[0].shape} and {pair[1].shape} cannot be compared; give both "
            "as (times, components), at the same times, one or more"
        )
    for name, values in zip(("estimated", "true"), pair, strict=True):
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values).all(-1)))
            raise InputError(f"the {name} motion is not finite in row {row}; leave that time out")
    return pair


def unit_vectors(v: NDArray[np.float64]) -> NDArray[np.float64]:
    # The largest component first: the square of a tiny one would be lost.
    largest = np.abs(v).max(-1, keepdims=True)
    v = v / np.where(largest > 0, largest, 1)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(size > 0, size, 1)


def _ratio(error: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    infinite = np.where(error > 0, np.inf, 0.0)
    return np.where(size > 0, error / np.where(size > 0, size, 1), infinite)


def _percent(values: NDArray) -> float:
    return 100 * float(np.mean(values))
