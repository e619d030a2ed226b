"""Estimators of the camera's motion under the common contract (`jaxevent.estimator`)."""

import dataclasses
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.calibration.faults import warn_of_unit
from jaxevent.camera import PinholeCamera
from jaxevent.deprecated import renamed_fields, renamed_methods
from jaxevent.egomotion.models import MODELS, Model, find_model, in_words
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.egomotion.patches import (
    ImageSpeed,
    describe_windows,
    measure_image_speed,
)
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.errors import InputError, InputWarning
from jaxevent.estimator import Estimate, Estimator
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording, Times, check_times, microseconds

P = TypeVar("P", bound=Parameters)

COMMON_OPTIONS = frozenset({"model", "camera", "seed"})  # of every method
SCORE_RATE_HZ = 200.0  # of the times at which estimates are compared with known motion
N_TRUTH_SAMPLES = 256  # of the known motion of a training segment


class LostMotionWarning(InputWarning):
    """A method found no motion of the camera at any time."""


class InconsistentMotionWarning(InputWarning):
    """A recording contradicts a motion, or the image does not move as one."""


def score_times(start: int, stop: int) -> NDArray[np.int64]:
    """Return the times at which errors are scored.

    Args:
        start: First time, us.
        stop: Time after the last one, us.

    Returns:
        (T,) us, at `SCORE_RATE_HZ`.
    """
    return np.arange(start, stop, round(1e6 / SCORE_RATE_HZ))


class TrainingSegment(NamedTuple):
    """A part of a recording with known motion.

    Attributes:
        recording: The recording.
        start: First time, us.
        stop: Time after the last, us.
        known: The motion.
        split: Index in `runs.family.SPLIT_NAMES`.
    """

    recording: Recording
    start: int
    stop: int
    known: KnownMotion
    split: int

    def crop(self) -> Recording:
        """Return the part of the recording."""
        return self.recording[self.start : self.stop]

    def truth(
        self, times: NDArray[np.int64], settle: float | int
    ) -> tuple[NDArray[np.float64], ...]:
        """Return the first five fields of `TrainingRuns`.

        Args:
            times: (T,) times of the estimates, us.
            settle: Time after the start from which errors count, s.

        Returns:
            Times (T,) in s, times of the truth (G,) in s, the truth (G, d), 1 or 0 for each of the
            times (T,), and their sum, above 0.
        """
        grid = np.linspace(self.start, self.stop, N_TRUTH_SAMPLES)
        inside = np.clip(grid, self.known.t[0], self.known.t[-1])
        truth = self.known(np.rint(inside).astype(np.int64))
        time = (times - self.start) * 1e-6
        counted = ((time >= settle) & self.known.covers(times)).astype(float)
        weight = np.asarray(max(counted.sum(), 1e-9))
        return time, (grid - self.start) * 1e-6, truth, counted, weight


@dataclasses.dataclass(frozen=True)
class AdaptedParams(Generic[P]):
    """Parameters adapted to a recording.

    Attributes:
        params: The parameters.
        speed: The speed of the image, or None if it is unknown.
        speed_message: A clause about the speed.
        params_message: A clause about the parameters that were adapted.
    """

    params: P
    speed: ImageSpeed | None
    speed_message: str
    params_message: str

    @property
    def message(self) -> str:
        """A line to print; "" if nothing was to adapt."""
        return ": ".join(filter(None, (self.speed_message, self.params_message)))


class TrainingRuns(eqx.Module):
    """A segment prepared for a fit of parameters: its known motion, and the estimates of runs.

    Attributes:
        time: Times of estimates, s since the segment's start.
        grid: Times of the truth, s since the segment's start.
        truth: True motion.
        counted: 1 where the error counts, else 0.
        weight: Weight of the segment in the loss.
        model: Motion model.
    """

    time: Float[Array | np.ndarray, " T"]
    grid: Float[Array | np.ndarray, " G"]
    truth: Float[Array | np.ndarray, "G d"]
    counted: Float[Array | np.ndarray, " T"]
    weight: Float[Array | np.ndarray, ""]
    model: Model

    def estimates(self, params: Any) -> tuple[Float[Array, "runs T d"], Float[Array, "runs T"]]:
        """Return the means of every run, and their lags (s); differentiable."""
        raise NotImplementedError


@renamed_methods(
    knows="supports",
    place="find_model_and_camera",
    start="initial_params",
    suit="adapt_params",
    follow="training_runs",
)
@renamed_fields(lengths="adapt_lengths")
@dataclasses.dataclass(frozen=True, repr=False)
class MotionEstimator(Estimator[P]):
    """A method that estimates the camera's motion.

    `estimate` returns a `MotionEstimate`. All methods have the options `model`, a name of
    `models.MODELS`, "package.module:Class" or the class; `camera`, by default the recording's; and
    `seed`, of the random numbers. Some have `smooth`, whether to use later events too; `cloud`, the
    number of particles of an estimate to return; and `gyro`, twists of `truth.twists_from_gyro`.

    Attributes:
        linear: Whether it needs a flow that is linear in the motion.
        adapt_lengths: Function (params, speed) that returns values of parameters adapted to the
            speed of the image, as lengths of windows.
    """

    family: ClassVar[str] = "egomotion"
    linear: bool = dataclasses.field(default=False, kw_only=True)
    adapt_lengths: Callable[[Any, ImageSpeed], dict[str, float]] | None = dataclasses.field(
        default=None, kw_only=True
    )
    options: frozenset[str] = dataclasses.field(default=COMMON_OPTIONS, kw_only=True)

    def supports(self, model: type[Model]) -> bool:
        """Return whether it can estimate the motion of a model."""
        return (model.name in self.models or not self.models) and not (
            self.linear and model.half_line
        )

    def find_model(self, model: str | type[Model]) -> type[Model]:
        """Return the model of a name, of "package.module:Class", or the class itself.

        Raises:
            InputError: The model is unknown, or the method does not support it.
        """
        found = find_model(model)
        if not self.supports(found):
            known = [name for name, one in MODELS.items() if self.supports(one)]
            raise InputError(
                f"the method {self.name!r} does not know {found.title} but {in_words(known)}; "
                "choose another model or method"
            )
        return found

    def find_model_and_camera(
        self, recording: Recording, model: str | type[Model] | None, camera: PinholeCamera | None
    ) -> tuple[type[Model], PinholeCamera | None]:
        """Return the model and the camera that `estimate` uses.

        Args:
            recording: The recording.
            model: Model or its name; by default the first one that the method supports.
            camera: The camera; by default the recording's.

        Returns:
            The model, and the camera or None.

        Raises:
            InputError: The model is unknown or not supported, it needs a camera and there is none,
                or the recording lacks what the method needs.
        """
        self.check_options(model=model, camera=camera)
        if model is None:
            model = next(one for one in MODELS.values() if self.supports(one))
        found, camera = self.find_model(model), camera or recording.camera
        if found.needs_camera:
            camera = recording.require_camera(camera, found.title)
        self.check(recording)
        return found, camera

    def check_against(
        self, recording: Recording, motion: MotionEstimate, camera: PinholeCamera | None
    ) -> MotionEstimate:
        """Add the evidence of the whole recording to a motion, see `with_flow_consistency`.

        Args:
            recording: The recording.
            motion: Its motion.
            camera: The camera; by default the recording's.

        Returns:
            The motion. An `InconsistentMotionWarning` tells what is wrong.
        """
        if camera is not None:
            recording = dataclasses.replace(recording, camera=camera)
        motion, line = motion.with_flow_consistency(recording)
        if line:
            warnings.warn(f"{recording.name}: {line}", InconsistentMotionWarning, stacklevel=4)
        return motion

    def warn_if_lost(self, motion: MotionEstimate) -> None:
        """Warn with a `LostMotionWarning` if all estimates of a motion are lost."""
        if motion.valid.any() or motion.warning:
            return
        others = motion.model.best_method, motion.model.fallback_method
        other = next((f"egomotion.{one}, " for one in others if one not in (None, self.name)), "")
        count = len(motion)
        lost = "its only estimate is lost" if count == 1 else f"all {count} estimates are lost"
        warnings.warn(
            f"{motion.recording}: {self.name} found no motion, "
            f"{lost if count else 'as there are no events'}; try "
            f"{other}another model, or params of other windows",
            LostMotionWarning,
            stacklevel=3,
        )

    def initial_params(self, model: type[Model]) -> P:
        """Return the parameters for a model, before they are adapted to a recording."""
        return self.Params()

    def adapt_params(
        self,
        recording: Recording,
        params: P,
        *,
        camera: PinholeCamera | None = None,
        given: Collection[str] = (),
        speed: ImageSpeed | None = None,
    ) -> AdaptedParams[P]:
        """Adapt lengths of windows to the speed of the image, where the defaults are far off.

        Args:
            recording: The recording.
            params: The parameters.
            camera: The camera; by default the recording's.
            given: Names of parameters that stay as they are.
            speed: The speed; by default `patches.measure_image_speed`.

        Returns:
            The parameters, with messages about them.
        """
        if self.adapt_lengths is None:
            return AdaptedParams(params, speed, "", "")
        speed = speed or measure_image_speed(recording, camera)
        if speed is None:
            warn_of_unit(recording)  # a clock that is too fast or too slow may be the cause
            still = f"nothing was seen to move {describe_windows(recording)}"
            return AdaptedParams(params, None, f"{still}; windows are as by default", "")
        chosen = self.adapt_lengths(params, speed)
        chosen = {name: value for name, value in chosen.items() if name not in given}
        settings = self.Params.settings()
        values = ", ".join(f"{name} = {v:.2g} {settings[name].unit}" for name, v in chosen.items())
        moves = f"the image moves at about {speed.median:.3g} px/s"
        values = values or "windows are as given or by default"
        return AdaptedParams(params.replace(**chosen), speed, moves, values)

    def training_runs(
        self,
        segments: Sequence[TrainingSegment],
        params: P,
        model: type[Model],
        runs: int,
        settle: float | int,
    ) -> list[TrainingRuns]:
        """Prepare segments for a fit of parameters.

        Args:
            segments: Segments with known motion.
            params: The parameters at the start of the fit.
            model: Motion model.
            runs: Number of runs of each segment, with different random numbers.
            settle: Time after a segment's start from which errors count, s.

        Returns:
            The runs of each segment.
        """
        prepared = []
        for number, segment in enumerate(segments):
            recording = segment.crop()
            times = score_times(recording.start, recording.stop + 1)
            common = *segment.truth(times, settle), model()
            seeds = range(number * runs, (number + 1) * runs)
            prepared.append(self._runs_of_segment(common, recording, times, params, seeds))
        return prepared

    def _runs_of_segment(
        self,
        common: tuple[Any, ...],
        recording: Recording,
        times: NDArray[np.int64],
        params: P,
        seeds: Sequence[int],
    ) -> TrainingRuns:
        """Prepare the runs of a segment.

        Args:
            common: Fields that runs of all kinds have, the last one the model.
            recording: The segment.
            times: (T,) times at which errors count, us.
            params: Parameters.
            seeds: A seed for each run.

        Returns:
            The runs.
        """
        model = type(common[-1])
        prepared = tuple(
            self.prepare(recording, times, params, model=model, seed=seed) for seed in seeds
        )
        return StackedRuns(*common, prepared, self)


class StackedRuns(TrainingRuns):
    """Runs of any differentiable estimator, each from the start of the segment."""

    prepared: tuple[tuple[Any, Any], ...]  # features and read-out of every run
    method: Any = eqx.field(static=True)  # estimator of the runs

    def estimates(self, params: Any) -> tuple[Array, Array]:
        means = []
        for features, out in self.prepared:
            trajectory, _ = self.method.run(params, features)
            means.append(self.method.read(params, trajectory, out).mean)
        means = jnp.stack(means)
        return means, jnp.zeros(means.shape[:2], means.dtype)


class FixedEstimates(TrainingRuns):
    """Runs of an estimator on the host, computed when the segment was prepared."""

    mean: Float[Array | np.ndarray, "runs T d"]  # components, in the model's units

    def estimates(self, params: Any) -> tuple[Array, Array]:
        mean = jnp.asarray(self.mean)
        return mean, jnp.zeros(mean.shape[:2], mean.dtype)


class HostInputs(NamedTuple):
    """Inputs of a method that computes on the host.

    Attributes:
        recording: The recording.
        model: The motion model.
        camera: Calibration; None: there is none.
        seed: Seed of random numbers.
        progress: Whether a bar is shown; None: if it takes long.
        options: Options of this method alone.
    """

    recording: Recording
    model: type[Model]
    camera: PinholeCamera | None
    seed: int
    progress: bool | None
    options: Mapping[str, Any]


@renamed_fields(lengths="adapt_lengths")
@dataclasses.dataclass(frozen=True, repr=False)
class HostEstimator(MotionEstimator[P]):
    """A method on the host: `solve(params, inputs)` estimates the motion of a whole recording."""

    solve: Callable[[P, HostInputs], MotionEstimate]
    differentiable: bool = dataclasses.field(default=False, kw_only=True)

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        progress: bool | None = None,
        extrapolate: bool = False,
        **options: Any,
    ) -> tuple[HostInputs, NDArray[np.int64]]:
        self.refuse_unknown(options)
        self.check_options(seed=seed, progress=progress, **options)
        found, camera = self.find_model_and_camera(recording, model, camera)
        if not extrapolate and len(recording.events):
            check_times(times, recording.start, recording.stop, recording.name)
        inputs = HostInputs(recording, found, camera, seed, progress, options)
        return inputs, np.atleast_1d(microseconds(times))

    def _runs_of_segment(
        self,
        common: tuple[Any, ...],
        recording: Recording,
        times: NDArray[np.int64],
        params: P,
        seeds: Sequence[int],
    ) -> TrainingRuns:
        """Estimate a segment with several seeds, for its loss.

        Args:
            common: Fields of `TrainingRuns`.
            recording: The segment.
            times: (T,) times of the estimates, us.
            params: Parameters of the method.
            seeds: Seeds of the runs.

        Returns:
            The segment with the estimates.
        """
        model, means = type(common[-1]), []
        for seed in seeds:
            motion = self._solve(recording, params, model=model, seed=seed, progress=False)
            mean, _, valid = motion(times, extrapolate=True)
            means.append(np.where(valid[:, None], mean, 0.0))  # at rest where the motion is lost
        return FixedEstimates(*common, np.stack(means))

    def run(
        self, params: P, features: HostInputs, state: None = None
    ) -> tuple[MotionEstimate, None]:
        return self.solve(params, features).with_recording(features.recording), None

    def read(self, params: P, trajectory: MotionEstimate, out: NDArray[np.int64]) -> Estimate:
        return trajectory(out, extrapolate=True)

    def estimate(
        self, recording: Recording, params: P | None = None, **options: Any
    ) -> MotionEstimate:
        """Estimate the motion of a recording; see the module of the method.

        Args:
            recording: The recording.
            params: The parameters; by default with windows adapted to the recording.
            options: Options of the method, see `MotionEstimator`.

        Returns:
            The motion. An `InputWarning` tells that none was found, or that the recording
            contradicts it.

        Raises:
            InputError: The model is unknown or not supported, it needs a camera and there is none,
                or the recording lacks what the method needs.
        """
        motion = self._solve(recording, params, **options)
        motion = self.check_against(recording, motion, options.get("camera"))
        self.warn_if_lost(motion)
        return motion

    def _solve(self, recording: Recording, params: P | None, **options: Any) -> MotionEstimate:
        """Estimate the motion, without a warning if it is lost.

        Args:
            recording: The recording.
            params: Parameters; None: those adapted to the recording.
            **options: Options of `estimate`.

        Returns:
            The motion.
        """
        inputs, _ = self.prepare(recording, np.zeros(0, np.int64), params, **options)
        if params is None:
            start = self.initial_params(inputs.model)
            params = self.adapt_params(recording, start, camera=inputs.camera).params
        assumed = options.get("model") is None and sum(map(self.supports, MODELS.values())) > 1
        return dataclasses.replace(self.run(params, inputs)[0], model_assumed=assumed)
