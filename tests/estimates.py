"""A quick stand-in of the calibration, for tests of what is done with its values."""

from typing import Any

import numpy as np

from jaxevent.calibration import Calibration, CalibrationValue, storage
from jaxevent.calibration.result import not_identifiable
from jaxevent.recording import Recording

NAMES = ("clock_offset", "c_on", "c_off")


def make_up(monkeypatch: Any) -> None:
    """Have calibrations made up, and none refined or remembered, for one test."""
    for module in ("jaxevent.calibration", "jaxevent.calibration.storage"):
        monkeypatch.setattr(f"{module}.calibrate", made_up)
    monkeypatch.setattr("jaxevent.reconstruction.augment.refine", lambda *arguments: {})
    monkeypatch.setattr(storage, "_memory", type(storage._memory)())


def made_up(recording: Recording, I0: float = 1.0, sample: object = None) -> Calibration:
    """Values that depend on all frames, the events' number and `I0`; none without two frames."""
    hot = np.zeros((recording.height, recording.width), bool)
    hot[2, 1] = True
    none = not_identifiable("", "made up")
    values = dict.fromkeys(
        [name for name, kind in Calibration.__annotations__.items() if kind is CalibrationValue],
        none,
    )
    frames = recording.frames
    if frames is not None and len(frames) > 1:
        mean = float(frames.intensity.mean())
        share = len(recording.events) % 97 / 97
        known = {"clock_offset": 0.005 + 0.004 * mean, "c_on": 0.08 + 0.01 * share}
        known["c_off"] = 0.06 + 0.02 * mean
        values |= {
            name: CalibrationValue(
                v / (1 + I0), 0.9 * v / (1 + I0), 1.1 * v / (1 + I0), "s", "near"
            )
            for name, v in known.items()
        }
    offsets = np.linspace(-0.04, 0.04, 21)
    return Calibration(
        **values, hot_pixels=hot, offsets=offsets, correlations=np.cos(20 * offsets),
        threshold_factors=None,
    )  # fmt: skip
