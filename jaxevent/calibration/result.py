"""Result of a calibration."""

import dataclasses
import math
from collections.abc import Iterable
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


class CalibratedValues(NamedTuple):
    """Values that parameters take from a calibration.

    | field | meaning |
    |---|---|
    | found | values by name |
    | missing | notes of those that the data do not determine, by name |
    """

    found: dict[str, float]
    missing: dict[str, str]

    def __str__(self) -> str:
        return ", ".join(format_calibrated(name, value) for name, value in self.found.items())


def format_calibrated(name: str, value: float) -> str:
    """Format a value of a calibration for a line, as "clock +7.8 ms".

    Args:
        name: Name of the parameter.
        value: Its value.

    Returns:
        Words.
    """
    return f"clock {1e3 * value:+.1f} ms" if name == "clock_offset" else f"{name} {value:.3g}"


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

    def values(self) -> dict[str, CalibrationValue]:
        """Return all values with intervals, by name."""
        return {name: v for name, v in vars(self).items() if isinstance(v, CalibrationValue)}

    def select(self, names: Iterable[str]) -> CalibratedValues:
        """Return the values of some names, and those that the data do not determine.

        Args:
            names: Names of fields, as of `Parameters.calibrated`.

        Returns:
            The values.
        """
        chosen = {name: getattr(self, name) for name in names}
        return CalibratedValues(
            {name: one.value for name, one in chosen.items() if one.is_identifiable},
            {name: one.note for name, one in chosen.items() if not one.is_identifiable},
        )

    def params(self, kind: type[Parameters], **explicit: Any) -> Any:
        """Return parameters of a method with the values that were found.

        Args:
            kind: Class of the parameters, as `jaxevent.akf.Params`.
            **explicit: Values that win over those found; those of a preset do, too.

        Returns:
            The parameters.
        """
        return kind(**self.select(kind.names_left_open(explicit)).found, **explicit)
