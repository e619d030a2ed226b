"""Result of a calibration."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.parameters import Parameters


class CalibrationValue(NamedTuple):
    """A value that data determine, with its confidence interval.

    | field | meaning |
    |---|---|
    | value | the estimate; NaN where the data do not determine it |
    | low, high | ends of the 95 % interval; NaN where there is none |
    | unit | unit of all three |
    | note | "not identifiable" and the reason, or what else a reader should know |
    """

    value: float
    low: float
    high: float
    unit: str
    note: str = ""

    @property
    def is_identifiable(self) -> bool:
        """True where the data determine the value."""
        return math.isfinite(self.value)


@dataclasses.dataclass(frozen=True, repr=False)
class Calibration:
    """Values that `calibrate` found in a recording.

    Attributes:
        clock_offset: Time added to the frames' stamps, s.
        c_on: Contrast threshold of ON events at `I0`, ln I.
        c_off: Contrast threshold of OFF events at `I0`, ln I.
        threshold_ratio: Ratio of the ON threshold to the OFF threshold.
        hot_pixels: (height, width), true for pixels that fire without cause.
        offsets: (n,) clock offsets that were tried, s.
        correlations: (n,) correlation of the events' counts with the frames' changes at `offsets`.
    """

    clock_offset: CalibrationValue
    c_on: CalibrationValue
    c_off: CalibrationValue
    threshold_ratio: CalibrationValue
    hot_pixels: NDArray[np.bool_]
    offsets: NDArray[np.float64]
    correlations: NDArray[np.float64]

    def params(self, kind: type[Parameters], **explicit: Any) -> Any:
        """Return parameters of a method with the values that were found.

        Args:
            kind: Class of the parameters, as `jaxevent.akf.Params`.
            **explicit: Values that win over those found.

        Returns:
            The parameters.
        """
        known = kind.settings()
        found = {
            name: getattr(self, name).value
            for name in ("clock_offset", "c_on", "c_off")
            if name in known and getattr(self, name).is_identifiable
        }
        return kind(**{**found, **explicit})
