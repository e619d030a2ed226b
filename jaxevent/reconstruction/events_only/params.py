"""Parameters of the reconstruction from events alone."""

from jaxevent.parameters import Choice, Positive
from jaxevent.reconstruction.augment import FrameParams


class Params(FrameParams):
    """Parameters of `events-only`.

    Events alone determine the ratio of the thresholds (`learn`), not their size, which is the scale
    of the log intensity.
    """

    I0 = Positive(0.02, "intensity", "offset inside the logarithm, L = ln(I + I0)", least=1e-6)
    window = Positive(0.25, "events / px", "events of the window on each side", gradient=False)
    vague = Positive(
        1.0, "ln I", "standard deviation from which an image is not valid", gradient=False
    )
    learn = Choice(
        (True, False), "whether the thresholds are scaled by the ratios that the events show"
    )
    calibrated = ()
