"""Priors of a log image: natural scenes, and what other windows of events saw.

Gradients of log images are heavy-tailed. A cell is a square of four neighbouring pixels, with the
mean square q of its two differences across and two down, in squared thresholds. The prior has

    phi(q) = sqrt(q + edge^2) - edge                                                          (2)

for each cell, so that an edge costs about its height in whatever direction it runs.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class SolverParams(NamedTuple):
    """Numbers of the model of one image; log intensity is in thresholds."""

    silence: float = 0.5  # weight of rows without an event at one end, against those of events
    tail: float = 1.4  # residual, in thresholds, beyond which a row counts less
    gradient: float = 0.2  # weight of the prior of gradients (2)
    edge: float = 0.1  # gradient below which (2) is quadratic
    leak: float = 2e-4  # weight of M^2


class GradientPrior(NamedTuple):
    """Gaussian prior of the gradient of the log image at each pixel, by central differences."""

    gradient: Float[np.ndarray, "height width 2"]  # ln I / px, x before y
    information: Float[np.ndarray, "height width 2 2"]  # (px / ln I)^2
