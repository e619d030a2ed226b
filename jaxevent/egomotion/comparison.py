"""A motion compared with a known one: the figures of `scores.motion_errors` over some times."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Motion
from jaxevent.egomotion.scores import axis_error, motion_errors, relative_error
from jaxevent.egomotion.truth import Known
from jaxevent.metrics import MEANINGS

FIGURES = {  # of `motion_errors`: their units
    "AEE": "px/s", "AEE_rel": "%", "AAE_U": "deg", "AAE_T": "deg", "AAE_Omega": "deg",
    "AME": "deg/s", "AME_rel": "%", "AME_N": "%", "vector_error": "%", "outliers": "%",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Comparison:
    """How far a motion is from the truth: `figures` of `motion_errors` over `count` times.

    Left out are the `startup` (s) before the motion was first found and the times at which it was
    lost later, a share `lost` of all later ones. `truth` says in words what the truth is, `notes`
    what else there is to say of it.
    """

    figures: Mapping[str, float]
    startup: float
    lost: float
    count: int
    truth: str
    notes: tuple[str, ...] = ()

    def rows(self) -> list[tuple[str, float, str]]:
        """Names, values and units."""
        rows = [(name, value, FIGURES[name]) for name, value in self.figures.items()]
        return [*rows, ("lost", 100 * self.lost, "%"), ("startup", self.startup, "s")]

    def table(self) -> list[str]:
        """Lines to print."""
        rows = [(name, f"{value:.4g}", unit) for name, value, unit in self.rows()]
        wide = [max(len(row[i]) for row in rows) for i in range(2)]
        lines = [
            f"{name:{wide[0]}}  {value:>{wide[1]}} {unit:4}  {MEANINGS[name]}"
            for name, value, unit in rows[:-2]
        ]
        lines += self.notes if lines else ()
        return [
            *(lines or ["the motion was never found where the truth is known"]),
            f"of {self.count:,} times against {self.truth}; the first {self.startup:.3f} s and "
            f"{100 * self.lost:.2f} % lost later are left out",
        ]


def compare(
    motion: Motion, truth: Known, times: NDArray[np.int64], *, start: int | None = None,
    centred: bool = False, named: str = "the truth",
) -> Comparison:  # fmt: skip
    """The errors of a motion at those of the times (us) at which the truth is known.

    `start` (us) is when the events begin, by default the first of the times.
    """
    times = times[truth.within(times)]
    told = motion(times, centred=centred, extrapolate=True)
    start = int(times[0]) if start is None and len(times) else start or 0
    found = np.flatnonzero(told.valid)
    if not len(found):
        span = (int(times[-1]) - start) * 1e-6 if len(times) else 0.0
        return Comparison({}, max(span, 0.0), 1.0, 0, named)
    lost, began = ~told.valid[found[0] :], int(times[found[0]])
    mean, true = told.mean[found], truth(times[found])
    pairs = {part.figure: (mean[:, part.rows], true[:, part.rows]) for part in motion.model.parts}
    figures = motion_errors(**pairs)
    return Comparison(figures, max(began - start, 0) * 1e-6, float(lost.mean()), len(found), named)


def by_part(
    model: type[Model], mean: NDArray[np.floating], true: NDArray[np.floating]
) -> dict[str, NDArray[np.float64]]:
    """Errors (n,) of motions (n, d): of each direction in degrees, and `error` of the rest, %."""
    errors = {
        part.name: axis_error(mean[:, part.rows], true[:, part.rows])
        for part in model.parts
        if part.direction
    }
    rest = [np.arange(mean.shape[1])[part.rows] for part in model.parts if not part.direction]
    if rest:
        columns = np.concatenate(rest)
        errors["error"] = 100 * relative_error(mean[:, columns], true[:, columns])
    return errors
