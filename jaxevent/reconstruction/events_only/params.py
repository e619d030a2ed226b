"""Parameters of the reconstruction from events alone."""

from typing import Any

from jaxevent.parameters import Choice, Positive
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.events_only.prior import SolverParams

_SOLVER = SolverParams()


class Params(FrameParams):
    """Parameters of `events-only`.

    Events alone determine the ratio of the thresholds (`learn`), not their size, which is the scale
    of the log intensity.
    """

    c_on: Positive = Positive(0.2, "ln I", "contrast threshold of ON events")
    c_off: Positive = Positive(0.2, "ln I", "contrast threshold of OFF events")
    I0: Positive = Positive(
        0.02, "intensity", "offset inside the logarithm, L = ln(I + I0)", least=1e-6
    )
    window: Positive = Positive(
        0.35, "events / px", "events of the window on each side", gradient=False
    )
    silence: Positive = Positive(
        _SOLVER.silence, "1", "weight of silence, against that of an event"
    )
    tail: Positive = Positive(
        _SOLVER.tail, "c", "residual from which an equation counts less", least=1e-6
    )
    gradient: Positive = Positive(_SOLVER.gradient, "1", "weight of the prior of gradients")
    edge: Positive = Positive(_SOLVER.edge, "c / px", "scale of the prior of gradients", least=1e-6)
    leak: Positive = Positive(
        _SOLVER.leak, "1 / c^2", "weight of the squared log intensity", least=1e-9
    )
    vague: Positive = Positive(
        1.0, "ln I", "standard deviation from which an image is not valid", gradient=False
    )
    learn: Choice = Choice(
        (True, False), "whether the thresholds are scaled by the ratios that the events show"
    )
    use_frames: Choice = Choice(
        (False, True), "whether a frame at hand shows gradients, too, and the scale of intensity"
    )
    calibrated = ()

    def solver(self) -> SolverParams:
        """Return the numbers of the model of one image; they may be traced."""
        values: list[Any] = [self.silence, self.tail, self.gradient, self.edge, self.leak]
        return SolverParams(*values)
