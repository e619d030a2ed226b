"""Robust linear fits of motions, with covariances of errors that are correlated within cells."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import MotionEstimate

CORRELATED_CELL_PX = 16  # size of the cells of the image within which errors are correlated
HUBER_THRESHOLD_SIGMAS = (
    1.345  # standard deviations from which a residual counts linearly: 95 % efficient
)
MAX_REWEIGHTINGS = 20  # of reweighting
MIN_RELATIVE_INFORMATION = 0.02  # of the largest, below which a direction is undetermined: aperture


class Fit(NamedTuple):
    """A motion and its covariance.

    Attributes:
        mean: (d,) motion.
        covariance: (d, d).
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def with_systematic_error(
        self, displacement: float, duration: float, pixel_scale: NDArray[np.floating]
    ) -> "Fit":
        """Add an error of the whole image's displacement, which no fit shows.

        Args:
            displacement: Standard deviation of the error, px.
            duration: Time in which the image moves, s.
            pixel_scale: (d,) flow per unit of each component, px/s, see `Model.pixel_scale`.

        Returns:
            The fit with the larger covariance.
        """
        sigma = displacement / (max(duration, 1e-6) * np.maximum(pixel_scale, 1e-12))
        return self._replace(covariance=self.covariance + np.diag(sigma**2))


def robust_fit(
    rows: NDArray[np.floating],
    values: NDArray[np.floating],
    cells: NDArray[np.integer],
    size: NDArray[np.floating],
) -> Fit | None:
    """Fit m to rows @ m = values by Huber's loss.

    By iteratively reweighted least squares, with the scale from the median absolute residual. The
    covariance is a sandwich over cells, see `sandwich`. Systematic errors are not in it.

    Args:
        rows: (n, d) coefficients.
        values: (n,) values.
        cells: (n,) cell of each row. Errors are correlated within a cell, independent otherwise.
        size: (d,) unit of each component, see `Model.pixel_scale`: components are divided by it.

    Returns:
        The fit. It is None if a direction is undetermined: its information is less than
        `MIN_RELATIVE_INFORMATION` of the largest.
    """
    dimension = rows.shape[1]
    if len(rows) <= dimension:
        return None
    scaled = rows / size
    weight, m = np.ones(len(rows)), np.zeros(dimension)
    for _ in range(MAX_REWEIGHTINGS):
        H = (scaled * weight[:, None]).T @ scaled
        information = np.linalg.eigvalsh(H)
        if not information[0] > MIN_RELATIVE_INFORMATION * information[-1]:
            return None
        new = np.linalg.solve(H, (scaled * weight[:, None]).T @ values)
        residual = values - scaled @ new
        scale = 1.4826 * np.median(np.abs(residual)) + 1e-12 * np.abs(values).max()
        weight = np.minimum(
            1, HUBER_THRESHOLD_SIGMAS * scale / np.maximum(np.abs(residual), 1e-300)
        )
        done, m = np.abs(new - m).max() <= 1e-9 * np.abs(new).max(), new
        if done:
            break
    H = (scaled * weight[:, None]).T @ scaled
    covariance = sandwich(H, scaled * (weight * residual)[:, None], cells)
    return Fit(m / size, covariance / np.outer(size, size))


def sandwich(
    H: NDArray[np.floating], scores: NDArray[np.floating], cells: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Return the covariance H^-1 (sum_c g_c g_c') H^-1, with g_c the sum of scores in a cell.

    Args:
        H: (d, d) normal matrix.
        scores: (n, d) gradients of the terms of the loss.
        cells: (n,) cell of each term.

    Returns:
        (d, d) covariance, corrected for the number of cells.
    """
    dimension = len(H)
    which = np.unique(cells, return_inverse=True)[1]
    sums = np.zeros((which.max() + 1, dimension))
    np.add.at(sums, which, scores)
    half = np.linalg.solve(H, sums.T)
    return len(sums) / max(len(sums) - dimension, 1) * (half @ half.T)


def motion_of_fits(
    model: type[Model],
    t: NDArray[np.int64],
    fits: list[Fit | None],
    contrast: NDArray[np.floating] | None = None,
) -> MotionEstimate:
    """Make an estimate of fits; where there is none the motion is lost, and its mean repeated.

    Args:
        model: Motion model.
        t: (n,) times, us.
        fits: n fits.
        contrast: (n,) agreement of events with the motion, relative to chance.

    Returns:
        The estimate.
    """
    dimension = len(model.components)
    last, mean, covariance = np.zeros(dimension), [], []
    prior = model.prior_sigma**2 * np.eye(dimension)
    for fit in fits:
        last = last if fit is None else fit.mean
        mean.append(last)
        covariance.append(prior if fit is None else fit.covariance)
    valid = np.array([fit is not None for fit in fits], bool)
    return MotionEstimate.from_arrays(
        model, t, np.array(mean), np.array(covariance), valid, contrast
    )
