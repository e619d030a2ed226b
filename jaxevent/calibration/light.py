"""Changes of the light, which all of a scene shows alike, where motion shows them either way."""

import numpy as np
from numpy.typing import NDArray

MIN_SIGMAS = 4.0  # of a change that all places have in common
_MEDIAN_ERROR = 1.86  # standard error of a median of n, in median deviations / sqrt(n)


def common_change(changes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the change that places have in common, 0 where their scatter explains it.

    Args:
        changes: (..., n) changes of n places, ln I.

    Returns:
        (...) medians, 0 where they are within four standard errors.
    """
    median = np.median(changes, axis=-1)
    deviation = np.median(np.abs(changes - median[..., None]), axis=-1)
    error = _MEDIAN_ERROR * deviation / np.sqrt(changes.shape[-1])
    return np.where(np.abs(median) > MIN_SIGMAS * error, median, 0.0)
