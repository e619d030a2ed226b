"""Fits of egomotion methods to known motion, and motion compared with a known one.

Settings beside `protocol = "motion"` of `jaxevent.runs.evaluate`:

    model = "planar"                    # or "rotation", "general", "package.module:Class"
    truth = "*.csv"                     # beside each recording, * being its name without suffix;
                                        # or "poses", "gyro" of the recording itself
    gyro_bias = [0.0, 0.0, 0.0]         # rad/s, taken off the gyro first
    imu_rotation = "y-up"               # its axes, as --imu-rotation of `jaxevent motion`
    depth = 2.0                         # m, of the scene: poses then tell a planar motion too
    settle = 0.0                        # s after the first event before errors count
    centred = true                      # compare with the motion that candidates show, `lag` ago;
                                        # false: with that at the time of an estimate
    smooth = true                       # a backward pass, of methods that have one
    gyro = false                        # tell the gyro to methods that take it
    seed = 0
    metrics = ["mypackage.mymodule:function"]  # of one's own: `jaxevent.runs.own`

A row has the errors of `scores.motion_errors` at 200 times per second, without those at which the
motion was lost: `lost`, their share of all after it was first found, `startup` (s) later.
`per_time` lists t (us) and `error`, the relative error in %, and of a direction, as the `heading`
of general motion, its error in degrees; None where lost.

A configuration of `jaxevent.runs.fit` has the settings up to `centred` (`settle`: of every window,
0.05 s), and

    runs = 4                            # of every window, with different random numbers

A table of the true motion has the columns t (s) and the components of the model, as `jaxevent
motion` writes them (vx, vy in px/s; wx, wy, wz in rad/s; tx, ty, tz before them).

A recording is cut into windows of `window` seconds. If neither validation nor test is given, they
are shared out: with `split` = [2, 1, 1], of every 4 windows in turn 2 are to fit, 1 to validate and
1 to test; then `window` is by default an eighth of the recording. The loss is the mean over times
and runs of |estimate - truth|^2, in units of the truth's; of a general motion those of heading and
of angular velocity are added. Random numbers stay the same during the fit.

With "voting" in every window particles start around the true motion, so that no search is fitted.
Where the motion is lost the mean of the particles that search counts, about as much as no motion.
The gradient goes through weights, particles and, by the carried score, resampling; ages of
candidates are held fixed. Any other method that is differentiable, as one of your own, is run
over every window from its beginning. The numbers of a method that computes on the host are
searched: every candidate is computed anew, and a window counts as at rest where it tells no motion.

Results: `error`, the mean relative error of the whole filter (search included) over the windows, %;
of a direction, as the `heading` of general motion, degrees; `lost`, the share of times at which it
was lost.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.egomotion.estimator import (
    SCORE_RATE_HZ,
    MotionEstimator,
    TrainingRuns,
    TrainingSegment,
)
from jaxevent.egomotion.models import Model, find_model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.scores import errors_by_part, score_motion, warn_of_gyro_axes
from jaxevent.egomotion.truth import KnownMotion, known_motion, parse_imu_rotation, twists_from_gyro
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.io.output import finite, values_of
from jaxevent.methods import find
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording, Times
from jaxevent.runs.config import (
    FLAG_CHECK,
    METRICS_CHECK,
    NATURAL_CHECK,
    NOT_NEGATIVE_CHECK,
    POSITIVE_CHECK,
    SEED_CHECK,
    Check,
    is_numbers,
    is_table,
    truth_files,
    truth_table,
)
from jaxevent.runs.family import (
    SPLIT_NAMES,
    Family,
    FitData,
    Goal,
    LastBatches,
    Protocol,
    Settings,
    batches_by_split,
    windows,
)
from jaxevent.runs.own import MethodFunction, Metric, find_metrics, own_names
from jaxevent.show.tables import Row, legend, results_table
from jaxevent.tuning import Batches

MOTION_SETTINGS: dict[str, Check] = {
    "model": (lambda value: isinstance(value, str), 'a name, as "planar" or "rotation"'),
    "truth": (
        is_table,
        'the name of tables beside the recordings, as "*.csv", or "poses", "gyro"',
    ),
    "gyro_bias": (lambda value: is_numbers(value, 3), "three numbers, rad/s"),
    "imu_rotation": (
        lambda value: isinstance(value, str),
        'the gyro\'s axes, as "camera", "y-up", or nine numbers, row by row, in a text',
    ),
    "depth": POSITIVE_CHECK,
    "settle": (NOT_NEGATIVE_CHECK[0], "a number of seconds, 0 or more"),
    "centred": FLAG_CHECK,
    "smooth": FLAG_CHECK,
    "gyro": FLAG_CHECK,
    "seed": SEED_CHECK,
    "metrics": METRICS_CHECK,
}
# Measures that rows have in any case.
MEASURE_NAMES = (
    "AEE", "AEE_rel", "AAE_U", "AAE_T", "AAE_Omega", "AME", "AME_rel", "AME_N", "vector_error",
    "outliers", "lost", "startup",
)  # fmt: skip


RECORDED_TRUTHS = ("poses", "gyro")  # truth that recordings hold themselves
TRUTH_SETTINGS = ("gyro_bias", "imu_rotation", "depth")  # settings of the ground truth


def model_of(options: Settings) -> type[Model]:
    """Return the motion model in the settings; raise `InputError` for an unknown one."""
    return find_model(options.get("model", "planar"))


def check_settings(options: Settings) -> None:
    """Raise `InputError` for settings that are missing or not possible together."""
    model_of(options)
    _rotation(options)
    if "truth" not in options:
        raise InputError(
            'the true motion is not given; add truth = "*.csv" (tables beside the recordings), '
            '"poses" or "gyro"'
        )


def truth_files_of(path: Path, options: Settings) -> list[Path]:
    """Return the files of the true motion of a recording.

    Args:
        path: The recording.
        options: Settings of the protocol; `truth` is "poses", "gyro", or files of tables.

    Returns:
        Files of the true motion; empty if the recording holds it.
    """
    truth = options["truth"]
    if isinstance(truth, str) and truth in RECORDED_TRUTHS:
        return []
    return truth_files(truth, str(path))


def true_motion(recording: Recording, options: Settings) -> KnownMotion:
    """Return the true motion of a recording.

    Args:
        recording: The recording; its name is its path.
        options: Settings of the protocol: `truth`, `model`, `gyro_bias`, `imu_rotation`, `depth`.

    Returns:
        The true motion.
    """
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


def _rotation(options: Settings) -> NDArray[np.float64] | None:
    axes = options.get("imu_rotation")
    return None if axes is None else parse_imu_rotation(axes)


def _bias(options: Settings) -> NDArray[np.float64]:
    return np.asarray(options.get("gyro_bias", (0.0, 0.0, 0.0)), np.float64)


class MotionProtocol(Protocol):
    """Motion compared with a known one."""

    settings = MOTION_SETTINGS

    def check(self, options: Settings) -> None:
        check_settings(options)
        find_metrics(options.get("metrics", ()), MEASURE_NAMES)

    def check_method(self, method: MotionEstimator, options: Settings) -> None:
        method.find_model(model_of(options))

    def files(self, path: Path, options: Settings) -> list[Path]:
        return truth_files_of(path, options)

    def score(
        self,
        recording: Recording,
        method: MotionEstimator | MethodFunction,
        params: Parameters | None,
        options: Settings,
        progress: bool | None = None,
    ) -> dict[str, Any]:
        """Score a method; raises `InputError` where there is no truth or no events."""
        model, bias = model_of(options), _bias(options)
        first, last = recording.event_span()
        truth = true_motion(recording, options)
        metrics = find_metrics(options.get("metrics", ()), MEASURE_NAMES)
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
            motion = _estimate_by_function(recording, method, times, model)
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
    options: Settings,
    bias: NDArray[np.float64],
) -> dict[str, Any]:
    """Choose the settings of the protocol that a method's `estimate` takes.

    Args:
        recording: The recording.
        method: The method.
        options: Settings of the protocol.
        bias: (3,) bias of the gyroscope, rad/s.

    Returns:
        Settings, by name.

    Raises:
        InputError: The gyroscope is wanted, but there is no IMU.
    """
    settings: dict[str, Any] = {}
    if "smooth" in options and "smooth" in method.options:
        settings["smooth"] = options["smooth"]
    if options.get("gyro", False) and "gyro" in method.options:
        if recording.imu is None:
            raise InputError(f"{recording.name}: holds no IMU; leave out gyro = true")
        settings["gyro"] = twists_from_gyro(recording.imu, bias, _rotation(options))
    return settings


class SampledMotion(MotionEstimate):
    """A motion that is known at the times of its estimates alone, without interpolation."""

    def __call__(
        self, times: Times, *, centred: bool | None = None, extrapolate: bool = False
    ) -> Estimate:
        rows = np.searchsorted(self.t, np.asarray(times))
        return Estimate(self.mean[rows], self.covariance[rows], self.valid[rows])


def _estimate_by_function(
    recording: Recording, method: MethodFunction, times: NDArray[np.int64], model: type[Model]
) -> MotionEstimate:
    """Estimate motion by a user's function.

    Args:
        recording: The recording.
        method: The function.
        times: (T,) us.
        model: Model of the motion.

    Returns:
        The motion at these times, lost where it is NaN.
    """
    d = len(model.components)
    mean, covariance, _ = method.estimate(recording, times, [(d,)])
    if covariance is None or covariance.shape != (len(times), d, d):
        covariance = np.full((len(times), d, d), np.nan)
    return SampledMotion.from_arrays(model, times, mean, covariance, np.isfinite(mean).all(1))


def _own(
    metrics: Sequence[Metric], mean: NDArray, truth: NDArray, recording: str
) -> dict[str, float | None]:
    """Compute the user's metrics of a motion.

    Args:
        metrics: The metrics.
        mean: (times, d) estimates of the components of the motion.
        truth: (times, d) true components.
        recording: Name of the recording.

    Returns:
        Values by name; None without times.
    """
    return {one.name: one(mean, truth, recording) if len(mean) else None for one in metrics}


@dataclasses.dataclass(frozen=True)
class MotionLoss:
    """The mean relative squared error of estimates, over runs: `loss(params, batch)`."""

    centred: bool = True

    def __call__(self, params: Any, batch: TrainingRuns) -> Float[Array, ""]:
        means, lags = batch.estimates(params)
        return jnp.mean(jax.vmap(lambda mean, lag: self.one(batch, mean, lag))(means, lags))

    def one(
        self, batch: TrainingRuns, mean: Float[Array, "T d"], lag: Float[Array, " T"]
    ) -> Float[Array, ""]:
        """Compute the loss of one run.

        Args:
            batch: A window of a recording with the true motion.
            mean: Estimated components at `batch.time`.
            lag: Lag of the estimates, s.

        Returns:
            The loss, ().
        """
        at = jnp.asarray(batch.time) - (jax.lax.stop_gradient(lag) if self.centred else 0)
        truth = jax.vmap(lambda column: jnp.interp(at, batch.grid, column), 1, 1)(
            jnp.asarray(batch.truth)
        )
        counted = jnp.asarray(batch.counted)
        total = jnp.zeros((), mean.dtype)
        for part in batch.model.parts:
            square = ((mean[:, part.rows] - truth[:, part.rows]) ** 2).sum(1)
            scale = (truth[:, part.rows] ** 2).sum(1)
            total += (square * counted).sum() / jnp.maximum((scale * counted).sum(), 1e-12)
        return total


@dataclasses.dataclass(frozen=True)
class MotionGoal(Goal):
    """The fit of a method to known motion, and its scores."""

    method: MotionEstimator
    loss: MotionLoss
    model: str
    truth: str
    runs: int
    settle: float | int  # s after the first event before errors count
    of_truth: Mapping[str, Any]  # gyro_bias, imu_rotation, depth
    # Forwards: in reverse every candidate's vote would be kept.
    forward = True
    measure = "error"

    @property
    def kind(self) -> type[Model]:
        """The motion model."""
        return find_model(self.model)

    def files(self, recording: Path) -> list[Path]:
        return truth_files_of(recording, {"truth": self.truth})

    def problem(self, data: FitData) -> Callable[[Any], Batches]:
        found = [one for one in self._cut_windows(data) if one.split < 2]

        def acting(params: Any) -> dict[str, float]:
            acts = params.names_without_gradient() if self.method.differentiable else params.numbers
            return {name: float(getattr(params, name)) for name in acts}

        def make(params: Any) -> Batches:
            made = self.method.training_runs(found, params, self.kind, self.runs, self.settle)
            return batches_by_split(found, made)

        return LastBatches(acting, make)

    def score(
        self, data: FitData, params: Parameters, progress: bool | None
    ) -> Iterator[dict[str, Any]]:
        found = self._cut_windows(data)
        for place, given, recording in data:
            mine = [p for p in found if p.recording is recording]
            if not mine:
                continue
            known = mine[0].known
            motion = self.method.estimate(recording, params, model=self.kind, progress=progress)
            warn_of_gyro_axes(motion, known)
            t = np.arange(mine[0].start, mine[-1].stop, round(1e6 / SCORE_RATE_HZ))
            t = t[known.covers(t)]
            estimate = motion(t, centred=self.loss.centred)
            mean, _, valid = estimate
            truth = known(t)
            for k, name in enumerate(SPLIT_NAMES):
                chosen = [
                    p for p in mine if p.split == k and (data.split is not None or k == place)
                ]
                inside = np.zeros(len(t), bool)
                for p in chosen:
                    inside |= (p.start <= t) & (t < p.stop)
                if not inside.any():
                    continue
                usable = inside & valid
                row: dict[str, Any] = {"recording": given, "split": name, "error": None}
                if usable.any():
                    each = errors_by_part(self.kind, mean[usable], truth[usable])
                    row |= {
                        name: finite(float(np.nanmean(values))) for name, values in each.items()
                    }
                row["lost"] = float((~valid[inside]).mean())
                row["windows"] = len(chosen)
                yield {**row, "params": values_of(params)}

    def table(self, rows: Sequence[Row]) -> str:
        columns = [("error %", "error", 1, 2), ("lost", "lost", 1, 3), ("windows", "windows", 1, 0)]
        for part in self.kind.parts:
            if part.direction and any(part.name in row for row in rows):
                columns.insert(1, (f"{part.name} deg", part.name, 1, 2))
        return results_table(rows, columns) + legend(columns)

    def known(self, recording: Recording) -> KnownMotion:
        """Return the true motion of a recording, whose name is its path."""
        settings = {"model": self.model, "truth": self.truth, **self.of_truth}
        return true_motion(recording, settings)

    def _cut_windows(self, data: FitData) -> list[TrainingSegment]:
        """Cut all recordings with known truth into windows that hold events."""
        found = []
        for place, _, recording in data:
            events, truth = recording.events, self.known(recording)
            first, last = recording.event_span()
            first, stop = max(first, int(truth.t[0])), min(last, int(truth.t[-1])) + 1
            if first >= stop:
                raise InputError(
                    f"{recording.name}: its events and the true motion are not of one time; times "
                    "are seconds on the recording's clock"
                )
            for begin, end, s in windows(first, stop, data.window, data.split, place):
                if events.index(begin) < events.index(end):
                    found.append(TrainingSegment(recording, begin, end, truth, s))
        return found


def find_estimator(name: str) -> MotionEstimator:
    """Return the egomotion method of a name, or of "package.module:object".

    Raises `InputError` for an unknown name, and for any other object.
    """
    found = find(name, "egomotion")
    if not isinstance(found, MotionEstimator):
        raise InputError(f"{name!r} is no jaxevent.egomotion.MotionEstimator; make it one")
    return found


class Egomotion(Family):
    """The methods that estimate the camera's motion."""

    protocols = {"motion": MotionProtocol()}
    fit_settings = {
        **{
            name: MOTION_SETTINGS[name]
            for name in ("model", "truth", "centred", "settle", *TRUTH_SETTINGS)
        },
        "runs": NATURAL_CHECK,
    }
    own = ("model", "centred")

    def goal(
        self, method: MotionEstimator, params: Parameters, settings: Mapping[str, Any]
    ) -> MotionGoal:
        check_settings(settings)
        method.find_model(model_of(settings))
        return MotionGoal(
            method,
            MotionLoss(settings.get("centred", True)),
            settings.get("model", "planar"),
            settings["truth"],
            settings.get("runs", 4),
            settings.get("settle", 0.05),
            {name: settings[name] for name in TRUTH_SETTINGS if name in settings},
        )


FAMILY = Egomotion()
