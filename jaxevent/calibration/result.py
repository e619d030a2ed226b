"""Result of a calibration."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.parameters import Parameters

WIDE_RATIO = 1.5  # of the ends of an interval, from which these differ much


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

    def updated(self, found: Mapping[str, float], names: Iterable[str]) -> "CalibratedValues":
        """Return the values of some names, those found elsewhere first.

        Args:
            found: Values that replace these.
            names: Names in the order wanted; those without a value are left out.

        Returns:
            The values.
        """
        known = {**self.found, **found}
        return CalibratedValues({n: known[n] for n in names if n in known}, self.missing)

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
    if name == "event_delay":
        return f"events {1e3 * abs(value):.1f} ms {'late' if value >= 0 else 'early'}"
    if name == "rho_ref":
        return f"dead time {1e3 * value:.2g} ms"
    if name == "exposure":
        return f"exposure {1e3 * value:.3g} ms"
    return f"clock {1e3 * value:+.1f} ms" if name == "clock_offset" else f"{name} {value:.3g}"


def not_identifiable(unit: str, why: str) -> CalibrationValue:
    """Return a value that the data do not determine.

    Args:
        unit: Its unit.
        why: The reason.

    Returns:
        The value, NaN.
    """
    return CalibrationValue(math.nan, math.nan, math.nan, unit, f"not identifiable: {why}")


@dataclasses.dataclass(frozen=True, repr=False)
class Calibration:
    """Values that `calibrate` found in a recording.

    Attributes:
        clock_offset: Time added to the frames' stamps, s.
        clock_drift: Growth of the clock offset with time, s / s.
        c_on: Contrast threshold of ON events in ln(I + I0), I0 as given to `calibrate`.
        c_off: Contrast threshold of OFF events.
        threshold_ratio: Ratio of the ON threshold to the OFF threshold.
        dark_offset: Offset inside the logarithm at which thresholds are the same at all
            intensities.
        event_noise: Noise of an event's step and spread of thresholds, in thresholds.
        frame_noise: Standard deviation of a frame's grey value, 1 is white.
        exposure: Length of the exposures, s.
        exposure_anchor: Place of the stamps in the exposures: 0 begin, 0.5 middle, 1 end.
        rho_ref: Dead time of a pixel after an event, s.
        hot_pixels: (height, width), true for pixels that fire without cause.
        offsets: (n,) clock offsets that were tried, s.
        correlations: (n,) correlation of the events' counts with the frames' changes at `offsets`.
        threshold_factors: (2, height, width) ratios of a pixel's ON and OFF thresholds to the
            common ones, 1 where unknown; None where the data do not determine them.
    """

    clock_offset: CalibrationValue
    clock_drift: CalibrationValue
    c_on: CalibrationValue
    c_off: CalibrationValue
    threshold_ratio: CalibrationValue
    dark_offset: CalibrationValue
    event_noise: CalibrationValue
    frame_noise: CalibrationValue
    exposure: CalibrationValue
    exposure_anchor: CalibrationValue
    rho_ref: CalibrationValue
    hot_pixels: NDArray[np.bool_]
    offsets: NDArray[np.float64]
    correlations: NDArray[np.float64]
    threshold_factors: NDArray[np.float32] | None = None

    def __repr__(self) -> str:
        known = [
            f"{name}={one.value:.4g} ({one.low:.3g} to {one.high:.3g}){' ' * (one.unit != '1')}"
            f"{one.unit if one.unit != '1' else ''}"
            for name, one in self.values().items()
            if one.is_identifiable
        ]
        known.append(f"{int(self.hot_pixels.sum())} hot pixels")
        if not self.c_on.is_identifiable:
            known.append(f"no thresholds: {self.c_on.note}")
        return f"<Calibration: {', '.join(known)}>"

    def values(self) -> dict[str, CalibrationValue]:
        """Return all values with intervals, by name."""
        return {name: v for name, v in vars(self).items() if isinstance(v, CalibrationValue)}

    def select(self, names: Iterable[str]) -> CalibratedValues:
        """Return the values of some names, and those that the data do not determine.

        An exposure or a dead time that may be none is left out.

        Args:
            names: Names, as of `Parameters.calibrated`; those of other things are left out.

        Returns:
            The values.
        """
        values = self.values()
        chosen = {name: values[name] for name in names if name in values}
        for name in ("exposure", "rho_ref"):
            if name in chosen and not chosen[name].low > 0:
                del chosen[name]
        return CalibratedValues(
            {name: one.value for name, one in chosen.items() if one.is_identifiable},
            {name: one.note for name, one in chosen.items() if not one.is_identifiable},
        )

    def threshold_candidates(self) -> list[dict[str, float]]:
        """Return the thresholds found, and the ends of their intervals where these are wide.

        Returns:
            `c_on` and `c_off` of each candidate.
        """
        pair = {"c_on": self.c_on, "c_off": self.c_off}
        which = ["value"]
        if max(one.high / one.low for one in pair.values()) > WIDE_RATIO:
            which += ["low", "high"]
        return [{name: getattr(one, end) for name, one in pair.items()} for end in which]

    def params(self, kind: type[Parameters], **explicit: Any) -> Any:
        """Return parameters of a method with the values that were found.

        Args:
            kind: Class of the parameters, as `jaxevent.akf.Params`.
            **explicit: Values that win over those found; those of a preset do, too.

        Returns:
            The parameters.
        """
        left_open = kind.names_left_open(explicit)
        names = [name for name in left_open if name not in kind.calibrated_if_needed]
        found: dict[str, Any] = {**self.select(names).found}
        return kind(**found, **explicit)
