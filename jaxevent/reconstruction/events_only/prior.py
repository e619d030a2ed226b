"""Priors of a log image: natural scenes, and what other windows of events saw.

Gradients of log images are heavy-tailed. A cell is a square of four neighbouring pixels, with the
mean square q of its two differences across and two down, in squared thresholds. The prior has

    phi(q) = gradient / 2 log(1 + q / edge^2)                                                 (2)

for each cell: gradients have Student's distribution, the same for edges of all directions. Where
events show an edge, its sides may differ in height along it, too.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class SolverParams(NamedTuple):
    """Numbers of the model of one image; log intensity is in thresholds."""

    silence: float = 1.0  # weight of rows without an event at one end, against those of events
    tail: float = 1.4  # residual, in thresholds, beyond which a row counts less
    gradient: float = 0.03  # weight of the prior (2)
    edge: float = 0.1  # gradient, in thresholds per px, below which (2) is quadratic
    leak: float = 2e-5  # weight of u^2


class GradientPrior(NamedTuple):
    """Gaussian prior of the gradient of the log image at each pixel, by central differences."""

    gradient: Float[np.ndarray, "height width 2"]  # ln I / px, x before y
    information: Float[np.ndarray, "height width 2 2"]  # (px / ln I)^2
