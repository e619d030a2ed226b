"""Calibration of a recording by itself: clock offset, contrast thresholds, noise and faults.

calibration = jaxevent.calibrate(recording)
params = calibration.params(jaxevent.akf.Params)
findings = jaxevent.check_consistency(recording)
"""

from jaxevent.calibration.estimation import calibrate
from jaxevent.calibration.event_calibration import EventCalibration, calibrate_events
from jaxevent.calibration.faults import Fault, check_consistency
from jaxevent.calibration.result import CalibratedValues, Calibration, CalibrationValue
from jaxevent.calibration.storage import format_toml, recall_calibration, recall_numbers

__all__ = [
    "CalibratedValues",
    "Calibration",
    "CalibrationValue",
    "EventCalibration",
    "Fault",
    "calibrate",
    "calibrate_events",
    "check_consistency",
    "format_toml",
    "recall_calibration",
    "recall_numbers",
]
