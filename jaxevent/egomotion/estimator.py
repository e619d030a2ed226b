"""Estimators of the camera's motion under the common contract (`jaxevent.estimator`)."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.camera import PinholeCamera
from jaxevent.egomotion.models import MODELS, Model, find_model, in_words
from jaxevent.egomotion.motion import Motion
from jaxevent.egomotion.patches import Speed, tried, usual_speed
from jaxevent.egomotion.truth import Known
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, Estimator
from jaxevent.parameters import Parameters
from jaxevent.recording import Recording, Times, check_times, microseconds

P = TypeVar("P", bound=Parameters)

COMMON = frozenset({"model", "camera", "seed"})  # options of every method
RATE = 200.0  # Hz at which estimates are compared with what is known


class Stretch(NamedTuple):
    """A stretch of a recording, of times in us, whose motion is known: to be fitted to."""

    recording: Recording
    start: int
    stop: int
    known: Known
    split: int  # the place in `splits.SPLITS`

    def cut(self) -> Recording:
        """Its events."""
        return self.recording[self.start : self.stop]


@dataclasses.dataclass(frozen=True)
class Suited(Generic[P]):
    """Parameters that suit a recording, how fast its image moves, and what is said of both.

    `moves` says the speed, `lengths` the windows.
    """

    params: P
    speed: Speed | None
    moves: str
    lengths: str

    @property
    def line(self) -> str:
        return ": ".join(filter(None, (self.moves, self.lengths)))


class Batch(eqx.Module):
    """A prepared stretch to be fitted to: what is true of it, and the estimates of some runs."""

    time: Float[Array | np.ndarray, " T"]  # s since the stretch's start
    grid: Float[Array | np.ndarray, " G"]  # s, of the truth
    truth: Float[Array | np.ndarray, "G d"]
    counted: Float[Array | np.ndarray, " T"]  # 1: the error counts
    weight: Float[Array | np.ndarray, ""]
    model: Model

    def estimates(self, params: Any) -> tuple[Float[Array, "runs T d"], Float[Array, "runs T"]]:
        """Means of every run, and by how much (s) what was seen is older; differentiable."""
        raise NotImplementedError

    def over(self, devices: Sequence[Any]) -> "Batch":
        """The batch on several devices; on the first of them, where it is not shared out."""
        return jax.device_put(self, devices[0])


@dataclasses.dataclass(frozen=True, repr=False)
class MotionEstimator(Estimator[P]):
    """A method that tells the camera's motion.

    `estimate` returns a `Motion`. Options that all methods take are the `model`, a name of
    `models.MODELS`, "package.module:Class" or the class; the `camera`, by default the recording's;
    and the `seed`: the same one gives the same motion. Some take `smooth`: whether later events
    tell of a time too; `cloud`: how many particles of an estimate to keep; and `gyro`, what a gyro
    measured (`twists.from_gyro`).

    Attributes:
        linear: Whether it needs a flow that is linear in the motion.
        lengths: Parameters that suit the speed of the image, of `lengths(params, speed)`.
    """

    family: ClassVar[str] = "egomotion"
    linear: bool = dataclasses.field(default=False, kw_only=True)
    lengths: Callable[[Any, Speed], dict[str, float]] | None = dataclasses.field(
        default=None, kw_only=True
    )
    options: frozenset[str] = dataclasses.field(default=COMMON, kw_only=True)

    def knows(self, model: type[Model]) -> bool:
        """Whether it can tell the motion of a model."""
        return (model.name in self.models or not self.models) and not (
            self.linear and model.half_line
        )

    def find_model(self, model: str | type[Model]) -> type[Model]:
        """The model; raises `InputError` for an unknown one, and one that the method cannot tell"""
        found = find_model(model)
        if not self.knows(found):
            known = [name for name, one in MODELS.items() if self.knows(one)]
            raise InputError(
                f"the method {self.name!r} does not know {found.title} but {in_words(known)}; "
                "choose another model or method"
            )
        return found

    def place(
        self, recording: Recording, model: str | type[Model] | None, camera: PinholeCamera | None
    ) -> tuple[type[Model], PinholeCamera | None]:
        """The model, by default the first that it knows, and the camera, if none the recording's.

        Raises `InputError` as `find_model` does, and where the model needs a camera and there is
        none.
        """
        self.check_options(model=model, camera=camera)
        if model is None:
            model = next(one for one in MODELS.values() if self.knows(one))
        found, camera = self.find_model(model), camera or recording.camera
        if found.needs_camera and camera is None:
            raise InputError(
                f"{recording.name}: has no calibration, which {found.title} needs"
                f"{recording.describe_left_out('camera')}; give a camera"
            )
        self.check(recording)
        return found, camera

    def start(self, model: type[Model]) -> P:
        """The parameters that it starts with."""
        return self.Params()

    def suit(
        self,
        recording: Recording,
        params: P,
        *,
        camera: PinholeCamera | None = None,
        given: Collection[str] = (),
        speed: Speed | None = None,
    ) -> Suited[P]:
        """Parameters with windows as long as the recording needs, and lines that say so.

        Lengths of time are chosen by how fast the image moves, where the defaults are far from
        right: by `speed`, or `patches.usual_speed`. Those named in `given` stay as they are.
        """
        if self.lengths is None:
            return Suited(params, speed, "", "")
        speed = speed or usual_speed(recording, camera)
        if speed is None:
            still = f"nothing was seen to move {tried(recording)}; windows are as by default"
            return Suited(params, None, still, "")
        chosen = self.lengths(params, speed)
        chosen = {name: value for name, value in chosen.items() if name not in given}
        said = ", ".join(
            f"{name} = {value:.2g} {self.Params.settings()[name].unit}"
            for name, value in chosen.items()
        )
        moves = f"the image moves at about {speed.usual:.3g} px/s"
        said = said or "windows are as given or by default"
        return Suited(params.replace(**chosen), speed, moves, said)

    def follow(
        self,
        stretches: Sequence[Stretch],
        params: P,
        model: type[Model],
        runs: int,
        settle: float | int,
    ) -> list[Batch]:
        """Stretches prepared to be fitted to, each with so many runs of different random numbers.

        Errors count from `settle` seconds after a stretch's start on.
        """
        return [Stacked.of(self, stretch, params, model, runs, settle, k) for k, stretch in
                enumerate(stretches)]  # fmt: skip


def truth_of(stretch: Stretch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (s) since a stretch's start, and what is true at them."""
    grid = np.linspace(stretch.start, stretch.stop, 256)
    inside = np.clip(grid, stretch.known.t[0], stretch.known.t[-1])
    return (grid - stretch.start) * 1e-6, stretch.known(np.rint(inside).astype(np.int64))


class Stacked(Batch):
    """Of any differentiable estimator: what it prepares for every run, one after another."""

    prepared: tuple[tuple[Any, Any], ...]  # features and out of every run
    method: Any = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        method: MotionEstimator[P],
        stretch: Stretch,
        params: P,
        model: type[Model],
        runs: int,
        settle: float | int,
        seed: int,
    ) -> "Stacked":
        recording = stretch.cut()
        times = np.arange(recording.start, recording.stop + 1, round(1e6 / RATE))
        prepared = tuple(
            method.prepare(recording, times, params, model=model, seed=seed * runs + k)
            for k in range(runs)
        )
        time = (times - stretch.start) * 1e-6
        counted = ((time >= settle) & stretch.known.within(times)).astype(float)
        weight = np.asarray(max(counted.sum(), 1e-9))
        return cls(time, *truth_of(stretch), counted, weight, model(), prepared, method)

    def estimates(self, params: Any) -> tuple[Array, Array]:
        means = []
        for features, out in self.prepared:
            trajectory, _ = self.method.run(params, features)
            means.append(self.method.read(params, trajectory, out).mean)
        means = jnp.stack(means)
        return means, jnp.zeros(means.shape[:2], means.dtype)


class Told(Batch):
    """A stretch whose motion was told when it was prepared, by a method on the host."""

    mean: Float[Array | np.ndarray, "runs T d"]

    def estimates(self, params: Any) -> tuple[Array, Array]:
        mean = jnp.asarray(self.mean)
        return mean, jnp.zeros(mean.shape[:2], mean.dtype)

    def over(self, devices: Sequence[Any]) -> "Told":
        return jax.device_put(self, devices[0])


class Given(NamedTuple):
    """What a method that computes on the host is given."""

    recording: Recording
    model: type[Model]
    camera: PinholeCamera | None
    seed: int
    progress: bool | None
    more: Mapping[str, Any]  # its own options


@dataclasses.dataclass(frozen=True, repr=False)
class OnHost(MotionEstimator[P]):
    """A method of which `solve(params, given)` tells the motion of a whole recording."""

    solve: Callable[[P, Given], Motion]
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
        **more: Any,
    ) -> tuple[Given, NDArray[np.int64]]:
        """What `run` needs; raises `InputError` as `estimate` does and for times outside."""
        self.refuse_unknown(more)
        self.check_options(seed=seed, progress=progress, **more)
        found, camera = self.place(recording, model, camera)
        if not extrapolate and len(recording.events):
            check_times(times, recording.start, recording.stop, recording.name)
        given = Given(recording, found, camera, seed, progress, more)
        return given, np.atleast_1d(microseconds(times))

    def follow(
        self,
        stretches: Sequence[Stretch],
        params: P,
        model: type[Model],
        runs: int,
        settle: float | int,
    ) -> list[Batch]:
        """Stretches with the motion that these parameters tell; rest where they tell none."""
        batches: list[Batch] = []
        for number, stretch in enumerate(stretches):
            recording = stretch.cut()
            times = np.arange(recording.start, recording.stop + 1, round(1e6 / RATE))
            means = []
            for k in range(runs):
                seed = number * runs + k
                told = self.estimate(recording, params, model=model, seed=seed, progress=False)
                mean, _, valid = told(times, extrapolate=True)
                means.append(np.where(valid[:, None], mean, 0.0))
            time = (times - stretch.start) * 1e-6
            counted = ((time >= settle) & stretch.known.within(times)).astype(float)
            weight = np.asarray(max(counted.sum(), 1e-9))
            batches.append(
                Told(time, *truth_of(stretch), counted, weight, model(), np.stack(means))
            )
        return batches

    def run(self, params: P, features: Given, state: None = None) -> tuple[Motion, None]:
        """The motion, computed on the host."""
        return self.solve(params, features).within(features.recording), None

    def read(self, params: P, trajectory: Motion, out: NDArray[np.int64]) -> Estimate:
        """The motion at the times that were prepared."""
        return trajectory(out, extrapolate=True)

    def estimate(self, recording: Recording, params: P | None = None, **options: Any) -> Motion:
        """The `Motion` of a recording; see the module of the method for what it is.

        Raises `InputError` for a model that is unknown or that the method does not know, where the
        model needs a camera and there is none, and for what the method needs and is not there.
        Without parameters they are the defaults, with windows that `suit` the recording.
        """
        given, _ = self.prepare(recording, np.zeros(0, np.int64), params, **options)
        if params is None:
            params = self.suit(recording, self.start(given.model), camera=given.camera).params
        return self.run(params, given)[0]
