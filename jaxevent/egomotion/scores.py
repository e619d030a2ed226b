"""Errors of an estimated motion.

    errors = motion_errors(Omega=(estimate, truth), T=(heading, true_heading))
    scores = score_motion(motion, truth, times)

Errors follow the egomotion thesis, 5.20 to 5.21 and 6.22 to 6.29.
"""

import dataclasses
import warnings
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxevent.egomotion.models import Model, unit_vectors
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.truth import KnownMotion, find_imu_axes
from jaxevent.errors import InputError, InputWarning
from jaxevent.metrics import MEASURE_MEANINGS
from jaxevent.recording import Times, microseconds

OUTLIER_RELATIVE_ERROR = (
    0.05  # relative magnitude error from which a vector is an outlier in the thesis
)
METRIC_UNITS = {  # of `motion_errors`
    "AEE": "px/s", "AEE_rel": "%", "AAE_U": "deg", "AAE_T": "deg", "AAE_Omega": "deg",
    "AME": "deg/s", "AME_rel": "%", "AME_N": "%", "vector_error": "%", "outliers": "%",
}  # fmt: skip


def endpoint_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return |U - U_g|, whose mean is AEE (5.20).

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.

    Returns:
        (n,) errors, in the unit of the vectors.
    """
    estimate, truth = _check_motions(estimate, truth)
    return np.linalg.norm(estimate - truth, axis=-1)


def relative_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return |V - V_g| / |V_g|; of flow the mean is AEE_rel (5.21), of Omega the vector error.

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.

    Returns:
        (n,) errors; infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(
        endpoint_error(estimate, truth), np.linalg.norm(_check_motions(truth, truth)[1], axis=-1)
    )


def axis_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return the angles between vectors of any length, whose mean is AAE (6.22-25).

    They are the arccos of the normalised product, computed by arctan2, which is exact near 0 and
    180 degrees too.

    Args:
        estimate: (n, 2 or 3) vectors.
        truth: (n, 2 or 3) vectors.

    Returns:
        (n,) angles, degrees. They are 90, the mean over all directions, where one is the zero
        vector, and 0 where both are.
    """
    estimate, truth = (unit_vectors(v) for v in _check_motions(estimate, truth))
    # tan(angle / 2) = |a - b| / |a + b| of unit vectors.
    apart = np.linalg.norm(estimate - truth, axis=-1)
    together = np.linalg.norm(estimate + truth, axis=-1)
    return np.degrees(2 * np.arctan2(apart, together))


def magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return | |V| - |V_g| |; of Omega the mean is AME (6.26-27).

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.

    Returns:
        (n,) errors, in the unit of the vectors.
    """
    estimate, truth = _check_motions(estimate, truth)
    return np.abs(np.linalg.norm(estimate, axis=-1) - np.linalg.norm(truth, axis=-1))


def relative_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return | |V| - |V_g| | / |V_g|; of Omega the mean is AME_rel (6.28).

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.

    Returns:
        (n,) errors; infinite where only the truth is the zero vector, 0 where both are.
    """
    return _ratio(
        magnitude_error(estimate, truth), np.linalg.norm(_check_motions(truth, truth)[1], axis=-1)
    )


def normalised_magnitude_error(estimate: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Return | |V| - |V_g| | / max |V_g|, over all times; of Omega the mean is AME_N (6.29).

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.

    Returns:
        (n,) errors; infinite where the whole truth is 0 and the estimate is not, 0 where both are.
    """
    error = magnitude_error(estimate, truth)
    largest = np.linalg.norm(_check_motions(truth, truth)[1], axis=-1).max(initial=0)
    return _ratio(error, np.full(len(error), largest))


def outlier_percentage(
    estimate: ArrayLike, truth: ArrayLike, limit: float | int = OUTLIER_RELATIVE_ERROR
) -> float:
    """Return the percentage of outliers (thesis 6.5.3).

    Args:
        estimate: (n, components) vectors.
        truth: (n, components) vectors.
        limit: Relative magnitude error from which a vector is an outlier.

    Returns:
        Percentage.
    """
    return _percent(relative_magnitude_error(estimate, truth) >= limit)


def motion_errors(
    *,
    U: tuple[ArrayLike, ArrayLike] | None = None,
    T: tuple[ArrayLike, ArrayLike] | None = None,
    Omega: tuple[ArrayLike, ArrayLike] | None = None,
    V: tuple[ArrayLike, ArrayLike] | None = None,
) -> dict[str, float]:
    """Return the errors of the thesis for pairs of estimate and truth.

    All but the outliers are means over the n times. Scaling T by a positive number changes nothing.

    Args:
        U: Pair of image velocities (n, 2), px/s.
        T: Pair of translations (n, 3), in any unit and of any length.
        Omega: Pair of angular velocities (n, 3), rad/s.
        V: Pair of any other vectors (n, components).

    Returns:
        Errors by name. U has AEE (px/s), AEE_rel (%) and AAE_U (degrees), and T has AAE_T
        (degrees). Omega has AAE_Omega (degrees), AME (degrees/s) and AME_N (%). Omega and V have
        AME_rel (%), vector_error (%) and outliers (%).

    Raises:
        InputError: A pair has two shapes or no rows, or a value is not finite.
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


@dataclasses.dataclass(frozen=True)
class MotionScores:
    """Errors of a motion over the times at which it was found.

    Attributes:
        figures: Errors by name, see `motion_errors`.
        startup: Time before the motion was first found, which is left out, s.
        lost: Fraction of the later times at which it was lost, which are left out.
        count: Number of times compared.
        truth: The truth in words.
        notes: Further lines to print.
    """

    figures: Mapping[str, float]
    startup: float
    lost: float
    count: int
    truth: str
    notes: tuple[str, ...] = ()

    def rows(self) -> list[tuple[str, float, str]]:
        """Return the name, value and unit of each error."""
        rows = [(name, value, METRIC_UNITS[name]) for name, value in self.figures.items()]
        return [*rows, ("lost", 100 * self.lost, "%"), ("startup", self.startup, "s")]

    def table(self) -> list[str]:
        """Return the lines of a table to print."""
        rows = [(name, f"{value:.4g}", unit) for name, value, unit in self.rows()]
        widths = [max(len(row[i]) for row in rows) for i in range(2)]
        lines = [
            f"{name:{widths[0]}}  {value:>{widths[1]}} {unit:4}  {MEASURE_MEANINGS[name]}"
            for name, value, unit in rows[:-2]
        ]
        lines += self.notes if lines else ()
        return [
            *(lines or ["the motion was never found where the truth is known"]),
            f"of {self.count:,} times against {self.truth}; the first {self.startup:.3f} s and "
            f"{100 * self.lost:.2f} % lost later are left out",
        ]


def find_gyro_axes(motion: MotionEstimate, truth: KnownMotion) -> str | None:
    """Find other axes in which a gyro agrees with an estimate, where its own were not given.

    Args:
        motion: The estimate.
        truth: Angular velocity of the gyro.

    Returns:
        The axes, see `find_imu_axes`; None if the camera's fit, or were given.
    """
    if not truth.assumes_camera_axes:
        return None
    estimated = motion(truth.t, centred=True, extrapolate=True)
    rows = estimated.valid & np.isfinite(estimated.mean).all(1)
    return find_imu_axes(estimated.mean[rows], truth.values[rows]) if rows.any() else None


def warn_of_gyro_axes(motion: MotionEstimate, truth: KnownMotion) -> None:
    """Warn with an `InputWarning` of a gyro that agrees with an estimate in other axes.

    Args:
        motion: The estimate.
        truth: The known motion.
    """
    if (axes := find_gyro_axes(motion, truth)) is not None:
        warnings.warn(
            f"{motion.recording}: the gyro is like the estimate in other axes; give known_motion "
            f'rotation={axes!r}, or a configuration imu_rotation = "{axes}", if they are its own',
            InputWarning,
            stacklevel=3,
        )


def score_motion(
    motion: MotionEstimate,
    truth: KnownMotion,
    times: Times,
    *,
    start: int | None = None,
    centred: bool | None = None,
    description: str = "the truth",
) -> MotionScores:
    """Compare a motion with a known one.

    Args:
        motion: The estimate.
        truth: The known motion.
        times: (n,) times, integers in us or floats in s; those at which the truth is unknown are
            left out.
        start: Time of the first event, us; by default the first of the times.
        centred: Whether to use fixed-lag estimates.
        description: The truth in words.

    Returns:
        The errors. An `InputWarning` tells of a gyro that agrees in other axes.
    """
    warn_of_gyro_axes(motion, truth)
    times = np.atleast_1d(microseconds(times))
    times = times[truth.covers(times)]
    estimate = motion(times, centred=centred, extrapolate=True)
    start = int(times[0]) if start is None and len(times) else start or 0
    found = np.flatnonzero(estimate.valid)
    if not len(found):
        span = (int(times[-1]) - start) * 1e-6 if len(times) else 0.0
        return MotionScores({}, max(span, 0.0), 1.0, 0, description)
    lost, first = ~estimate.valid[found[0] :], int(times[found[0]])
    mean, true = estimate.mean[found], truth(times[found])
    pairs = {}
    for part in motion.model.parts:
        rows = np.isfinite(mean[:, part.rows]).all(1)
        if rows.any():
            pairs[part.figure] = mean[rows, part.rows], true[rows, part.rows]
    startup = max(first - start, 0) * 1e-6
    return MotionScores(
        motion_errors(**pairs), startup, float(lost.mean()), len(found), description
    )


def errors_by_part(
    model: type[Model], mean: NDArray[np.floating], true: NDArray[np.floating]
) -> dict[str, NDArray[np.float64]]:
    """Return the error of each direction, and of all other components together.

    Args:
        model: Motion model of d components.
        mean: (n, d) estimates.
        true: (n, d) known motions.

    Returns:
        Arrays (n,) by the name of a direction, degrees, and "error" of the rest, %.
    """
    errors = {
        part.name: np.where(
            np.isfinite(mean[:, part.rows]).all(1),
            axis_error(np.nan_to_num(mean[:, part.rows]), true[:, part.rows]),
            np.nan,
        )
        for part in model.parts
        if part.direction
    }
    rest = [np.arange(mean.shape[1])[part.rows] for part in model.parts if not part.direction]
    if rest:
        columns = np.concatenate(rest)
        errors["error"] = 100 * relative_error(mean[:, columns], true[:, columns])
    return errors


def _check_motions(estimate: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    """Check a motion and its truth, and return both as arrays.

    Args:
        estimate: (times, components) estimated motion.
        truth: (times, components) true motion.

    Returns:
        Both, as given.

    Raises:
        InputError: Shapes differ or are others, there are no times, or a number is not finite.
    """
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


def _ratio(error: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Divide errors by sizes; where a size is 0, an error is infinite or, if it is 0, 0.

    Args:
        error: Errors, 0 or more.
        size: Sizes, of the same shape.

    Returns:
        Ratios.
    """
    infinite = np.where(error > 0, np.inf, 0.0)
    return np.where(size > 0, error / np.where(size > 0, size, 1), infinite)


def _percent(values: NDArray) -> float:
    return 100 * float(np.mean(values))
