"""Motion compared with a known one, for `jaxevent evaluate`.

Settings beside `protocol = "motion"`:

    model = "planar"                    # or "rotation", "general", "package.module:Class"
    truth = "*.csv"                     # beside each recording, * being its name without suffix;
                                        # or "poses", "gyro" of the recording itself
    gyro_bias = [0.0, 0.0, 0.0]         # rad/s, taken off the gyro first
    imu_rotation = "y-up"               # its axes, as --imu-rotation of `jaxevent motion`
    depth = 2.0                         # m, of the scene: poses then tell a planar motion too
    settle = 0.0                        # s after the first event before errors count
    centred = true                      # compare with the motion that candidates show, `lag` ago
    smooth = true                       # a backward pass, of methods that have one
    gyro = false                        # tell the gyro to methods that take it
    seed = 0
    metrics = ["mypackage.mymodule:function"]  # of one's own: `jaxevent.runs.own`

A row has the errors of `scores.motion_errors` at 200 times per second, without those at which the
motion was lost: `lost`, their share of all after it was first found, `startup` (s) later.
`per_time` lists t (us) and `error`, the relative error in %, and of a direction, as the `heading`
of general motion, its error in degrees; None where lost.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.estimator import SCORE_RATE_HZ, MotionEstimator
from jaxevent.egomotion.models import Model, find_model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.scores import errors_by_part, score_motion
from jaxevent.egomotion.truth import KnownMotion, from_gyro, imu_rotation, known_motion
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording, Times
from jaxevent.runs.config import (
    METRICS_CHECK,
    NOT_NEGATIVE_CHECK,
    POSITIVE_CHECK,
    Check,
    is_table,
    truth_files,
    truth_table,
)
from jaxevent.runs.family import Protocol
from jaxevent.runs.own import MethodFunction, Metric, find_metrics, own_names


def _vector(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(type(n) in (int, float) and np.isfinite(n) for n in value)
    )


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


MOTION_SETTINGS: dict[str, Check] = {
    "model": (lambda value: isinstance(value, str), 'a name, as "planar" or "rotation"'),
    "truth": (
        is_table,
        'the name of tables beside the recordings, as "*.csv", or "poses", "gyro"',
    ),
    "gyro_bias": (_vector, "three numbers, rad/s"),
    "imu_rotation": (
        lambda value: isinstance(value, str),
        'the gyro\'s axes, as "camera", "y-up", or nine numbers, row by row, in a text',
    ),
    "depth": POSITIVE_CHECK,
    "settle": (NOT_NEGATIVE_CHECK[0], "a number of seconds, 0 or more"),
    "centred": (_flag, "true or false"),
    "smooth": (_flag, "true or false"),
    "gyro": (_flag, "true or false"),
    "seed": (lambda value: type(value) is int and value >= 0, "a whole number, 0 or more"),
    "metrics": METRICS_CHECK,
}
# Measures that rows have in any case.
MEASURE_NAMES = (
    "AEE", "AEE_rel", "AAE_U", "AAE_T", "AAE_Omega", "AME", "AME_rel", "AME_N", "vector_error",
    "outliers", "lost", "startup",
)  # fmt: skip


RECORDED_TRUTHS = ("poses", "gyro")  # truth that recordings hold themselves
TRUTH_SETTINGS = ("gyro_bias", "imu_rotation", "depth")  # settings of the ground truth


def model_of(options: Mapping[str, Any]) -> type[Model]:
    """Return the motion model in the settings; raise `InputError` for an unknown one."""
    return find_model(options.get("model", "planar"))


def check(options: Mapping[str, Any]) -> None:
    """Raise `InputError` for settings that are missing or not possible together."""
    model_of(options)
    _rotation(options)
    if "truth" not in options:
        raise InputError(
            'the true motion is not given; add truth = "*.csv" (tables beside the recordings), '
            '"poses" or "gyro"'
        )


def files(path: Path, options: Mapping[str, Any]) -> list[Path]:
    """Return further files that a row of the recording depends on."""
    truth = options["truth"]
    if isinstance(truth, str) and truth in RECORDED_TRUTHS:
        return []
    return truth_files(truth, str(path))


def true_motion(recording: Recording, options: Mapping[str, Any]) -> KnownMotion:
    """Return the true motion of a recording, whose name is its path."""
    source = options["truth"]
    if not (isinstance(source, str) and source in RECORDED_TRUTHS):
        source = truth_table(source, recording.name)
    return known_motion(
        recording,
        model_of(options),
        source,
        _bias(options),
        rotation=_rotation(options),
        depth=options.get("depth"),
    )


def _rotation(options: Mapping[str, Any]) -> NDArray[np.float64] | None:
    axes = options.get("imu_rotation")
    return None if axes is None else imu_rotation(axes)


def _bias(options: Mapping[str, Any]) -> NDArray[np.float64]:
    return np.asarray(options.get("gyro_bias", (0.0, 0.0, 0.0)), np.float64)


class MotionProtocol(Protocol):
    """Motion compared with a known one."""

    settings = MOTION_SETTINGS

    def check(self, options: Mapping[str, Any]) -> None:
        check(options)
        find_metrics(options.get("metrics", ()), MEASURE_NAMES)

    def check_method(self, method: MotionEstimator, options: Mapping[str, Any]) -> None:
        method.find_model(model_of(options))

    def files(self, path: Path, options: Mapping[str, Any]) -> list[Path]:
        return files(path, options)

    def score(
        self,
        recording: Recording,
        method: MotionEstimator | MethodFunction,
        params: Parameters | None,
        options: Mapping[str, Any],
        progress: bool | None = None,
    ) -> dict[str, Any]:
        """Raises `InputError` where there is no truth or no events."""
        model, bias = model_of(options), _bias(options)
        if not len(recording.events):
            raise InputError(f"{recording.name}: holds no events; choose another recording")
        truth = true_motion(recording, options)
        metrics = find_metrics(options.get("metrics", ()), MEASURE_NAMES)
        first, last = int(recording.events[:1].t[0]), int(recording.events[-1:].t[0])
        begin = first + round(options.get("settle", 0.0) * 1e6)
        times = np.arange(begin, last + 1, round(1e6 / SCORE_RATE_HZ))
        times = times[truth.covers(times)]
        if not len(times):
            raise InputError(
                f"{recording.name}: its events and the true motion are not of one time; times are "
                "seconds on the recording's clock"
            )
        clock = time.perf_counter()
        if isinstance(method, MethodFunction):
            motion = _of_function(recording, method, times, model)
        else:
            motion = method.estimate(
                recording,
                params,
                model=model,
                seed=options.get("seed", 0),
                progress=progress,
                **_settings(recording, method, options, bias),
            )
        seconds = time.perf_counter() - clock
        centred = options.get("centred")
        found = score_motion(motion, truth, times, start=first, centred=centred)
        mean, _, valid = motion(times, centred=centred)

        def listed(values: Any) -> list[float | None]:
            return [
                float(f"{value:.6g}") if ok and np.isfinite(value) else None
                for value, ok in zip(values, valid, strict=True)
            ]

        each = errors_by_part(model, np.where(valid[:, None], mean, 0), truth(times))
        return {
            "model": options.get("model", "planar"),
            **{k: float(v) if np.isfinite(v) else None for k, v in found.figures.items()},
            **_own(metrics, mean[valid], truth(times)[valid], recording.name),
            **own_names(metrics),
            "lost": found.lost,
            "startup": found.startup,
            "times": len(times),
            "events": len(recording.events),
            "seconds": seconds,
            "per_time": {
                "t": times.tolist(),
                **{name: listed(values) for name, values in each.items()},
            },
        }


def _settings(
    recording: Recording,
    method: MotionEstimator,
    options: Mapping[str, Any],
    bias: NDArray[np.float64],
) -> dict[str, Any]:
    """Return the settings of the protocol that the method's `estimate` takes."""
    settings: dict[str, Any] = {}
    if "smooth" in options and "smooth" in method.options:
        settings["smooth"] = options["smooth"]
    if options.get("gyro", False) and "gyro" in method.options:
        if recording.imu is None:
            raise InputError(f"{recording.name}: holds no IMU; leave out gyro = true")
        settings["gyro"] = from_gyro(recording.imu, bias, _rotation(options))
    return settings


class SampledMotion(MotionEstimate):
    """A motion that is known at the times of its estimates alone, without interpolation."""

    def __call__(
        self, times: Times, *, centred: bool | None = None, extrapolate: bool = False
    ) -> Estimate:
        rows = np.searchsorted(self.t, np.asarray(times))
        return Estimate(self.mean[rows], self.covariance[rows], self.valid[rows])


def _of_function(
    recording: Recording, method: MethodFunction, times: NDArray[np.int64], model: type[Model]
) -> MotionEstimate:
    """Return the motion that a function estimates at `times` (us); lost where it is NaN."""
    d = len(model.components)
    mean, covariance, _ = method.estimate(recording, times, [(d,)])
    if covariance is None or covariance.shape != (len(times), d, d):
        covariance = np.full((len(times), d, d), np.nan)
    return SampledMotion.from_arrays(model, times, mean, covariance, np.isfinite(mean).all(1))


def _own(
    metrics: Sequence[Metric], mean: NDArray, truth: NDArray, recording: str
) -> dict[str, float | None]:
    """Compute the user's metrics; None where no motion was found."""
    return {one.name: one(mean, truth, recording) if len(mean) else None for one in metrics}
