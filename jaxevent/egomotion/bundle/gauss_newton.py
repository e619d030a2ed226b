"""Steps of Gauss and Newton, which the alignment and the photometric fit of a window share.

A fit linearises, adds what the priors pull, solves, limits the step and accepts it or not; each is
a function of its own. What is common of the path's rows and of bonds between neighbours is here
too.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FURTHEST = 4  # px at the window's end, that a step moves at most
DEEPEST = 0.5  # of log depth, likewise
# A step that costs more is taken back and damped, first by so much, then by so many times more;
# where that is too much no step helps. A step that costs less leaves so much of the damping, and is
# the last if it gains less than such a part.
DAMP, HARDER, STUCK, SOFTER, ENOUGH = 0.1, 5, 50, 0.5, 1e-3


class Acceptance(NamedTuple):
    """How steps go on: Nesterov's count of steps that gained, and the damping."""

    momentum: int
    damping: float

    @property
    def ahead(self) -> float:
        """By how many times the last step the next one starts ahead: reweighting alone closes a
        tenth of what is left in a step."""
        return self.momentum / (self.momentum + 2)

    @property
    def goes_on(self) -> bool:
        return self.damping < STUCK


def accept(now: Acceptance, better: bool, gain: float, energy: float, counts: bool) -> Acceptance:
    """After a step that was `better` or not and gained so much of the energy.

    Only from when it `counts` does a gain add momentum.
    """
    damping = now.damping * SOFTER if better else max(now.damping * HARDER, DAMP)
    damping = damping if damping >= DAMP / 4 else 0.0
    if better and gain < ENOUGH * energy:
        damping = STUCK
    return Acceptance(now.momentum + 1 if better and counts else 0, damping)


def limit_step(rows: NDArray) -> float:
    """The share of a step of the path's rows (in px at the window's end) that is taken."""
    return min(1.0, FURTHEST / max(float(np.abs(rows).max()), 1e-9))


def bonds(log_rho: NDArray, weight: float, edge: float) -> tuple[NDArray, NDArray, float]:
    """Weights of the squares of differences to the nodes before, and what all together cost.

    Of those of the column before and of the row before, each (rows, columns). A difference well
    beyond `edge` is an edge, and pulls no more.
    """
    found, cost = [], 0.0
    for axis in (1, 0):
        apart = np.diff(log_rho, axis=axis, prepend=np.take(log_rho, [0], axis))
        u = (apart / edge) ** 2
        cost += weight * edge**2 / 2 * float(np.log1p(u).sum())
        found.append(weight / (1 + u))
    found[0][:, 0], found[1][0] = 0, 0
    return found[0], found[1], cost
