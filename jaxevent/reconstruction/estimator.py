"""The contract of reconstruction methods: `jaxevent.estimator` for images."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, Estimator
from jaxevent.events.clocks import check_clocks
from jaxevent.reconstruction.features import Features, ReadOut
from jaxevent.reconstruction.frames import Timing, time_span
from jaxevent.reconstruction.live import LiveVideo
from jaxevent.reconstruction.video import ImageSequence, P, Video
from jaxevent.reconstruction.windows import prepare
from jaxevent.recording import Recording, Times, check_times


@runtime_checkable
class PreparedImages(Protocol):
    """Images at the times that were prepared: `mean, variance, valid = images(params)`.

    A pytree, pure: it jits, maps over `params` and differentiates. Each array is (times, pixels).
    """

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        """The images; without `variance` there is none, and no derivatives of it."""
        ...

    def take(self, rows: NDArray) -> "PreparedImages":
        """Those at some of the times, in that order."""
        ...

    def over(self, devices: Sequence[Any]) -> "PreparedImages":
        """The same on several devices, pixels shared out."""
        ...


class ScannedImages(eqx.Module):
    """`PreparedImages` by a method's `run` and `read`."""

    features: Any
    out: Any
    method: Any = eqx.field(static=True)

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        trajectory, _ = self.method.run(params, self.features)
        return self.method.read(params, trajectory, self.out)

    def take(self, rows: NDArray) -> "ScannedImages":
        return ScannedImages(self.features, self.out.take(rows), self.method)

    def over(self, devices: Sequence[Any]) -> "ScannedImages":
        return ScannedImages(self.features.over(devices), self.out.over(devices), self.method)


@dataclasses.dataclass(frozen=True, repr=False)
class ImageEstimator(Estimator[P]):
    """A reconstruction method.

    Images are `Estimate`s: `mean` is intensity, 0 the frames' black and 1 their white, and goes
    beyond; `covariance` is the variance of log intensity ln(I + I0), NaN of methods that estimate
    none; `valid` is false where the intensity is not a finite number.

    Attributes:
        fuses: Whether images rest on events and frames together, so that thresholds must suit both
            and their clocks agree.
    """

    family: ClassVar[str] = "reconstruction"
    fuses: bool = dataclasses.field(default=True, kw_only=True)
    has_likelihood: ClassVar[bool] = False  # whether it has `log_likelihood` of the frames given

    @property
    def by_parameters(self) -> str:
        if not self.differentiable:
            return super().by_parameters
        return (
            f"prepare once outside, images = {self.spelled}.prepare_images(recording, times), and "
            "map or differentiate images(params)"
        )

    def check_span(self, recording: Recording, times: Times, params: P) -> None:
        """Raise `InputError` for times outside the recording, its frames on either clock."""
        check_times(times, *time_span(recording, params.clock_offset), recording.name)

    def check(self, recording: Recording) -> None:
        """Raise `InputError` for a recording without data, or without what the method needs."""
        super().check(recording)
        recording.refuse_empty()

    def check_clocks(self, recording: Recording, params: P) -> None:
        """Raise `InputError` or warn if frames and events that it combines cannot be on one clock.

        See `jaxevent.events.clocks`.
        """
        if self.fuses:
            check_clocks(recording, params.clock_offset)

    @abc.abstractmethod
    def estimate(
        self, recording: Recording, params: P | None = None, **options: Any
    ) -> ImageSequence[P]:
        """Images of a recording: `image, variance, valid = estimate(recording, params)(times)`.

        Raises `InputError` if the recording lacks what the method needs.
        """

    def prepare_images(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
    ) -> PreparedImages:
        """The images at sorted `times` as a function of parameters, for losses.

            images = akf.prepare_images(recording, times)
            loss = lambda params: ((images(params).mean - truth) ** 2).mean()
            value, slope = jax.jit(jax.value_and_grad(loss))(akf.Params())

        Prepared for those of the `params` that act through comparisons with event times, see
        `prepare`. Raises `InputError` as `prepare` does.
        """
        features, out = self.prepare(recording, times, params, extrapolate=extrapolate)
        return ScannedImages(features, out, self)


@renamed_methods(filters="is_event_driven", looks_ahead="needs_future", start="init_state")
@dataclasses.dataclass(frozen=True, repr=False)
class PixelEstimator(ImageEstimator[P]):
    """A reconstruction method to which every pixel is one of its own, in windows of events."""

    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "devices"}), kw_only=True
    )

    @property
    @abc.abstractmethod
    def is_event_driven(self) -> bool:
        """Whether it passes over single events."""

    @property
    def needs_future(self) -> bool:
        """Whether `run` needs what later windows say."""
        return False

    @abc.abstractmethod
    def init_state(self, params: P, features: Features) -> Any:
        """The state at the recording's start, from the features of its first window."""

    @abc.abstractmethod
    def run(
        self, params: P, features: Features, state: Any = None, future: Any = None
    ) -> tuple[Any, Any]:
        """Estimate a window; pure, so it jits, vmaps over `params` and differentiates.

        `state` is what the window before returned; omitted, the recording starts here. `future` is
        what later windows say, for estimators that look ahead; omitted, there are none. Returns
        the trajectory, to `read` images from, and the state for the next window.
        """

    @abc.abstractmethod
    def read(self, params: P, trajectory: Any, out: ReadOut) -> Estimate:
        """The images prepared in `out`, each array (times, pixels); pure, as `run`."""

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
    ) -> tuple[Features, ReadOut]:
        """A whole recording for `run`, and points of images at sorted `times` for `read`.

        See `windows.prepare`; prepared for those of the `params` that act through comparisons with
        event times. Raises `InputError` if the recording lacks what the method needs, and for times
        that are not sorted or, unless told to `extrapolate`, outside the recording.
        """
        self.check(recording)
        params = self.Params() if params is None else params
        self.check_clocks(recording, params)
        if not extrapolate:
            self.check_span(recording, times, params)
        return prepare(recording, times, Timing.of(params), filtering=self.is_event_driven)

    def estimate(
        self, recording: Recording, params: P | None = None, **options: Any
    ) -> ImageSequence[P]:
        """Video of a recording: `image, variance, valid = estimate(recording, params)(times)`.

        `options` are those of `Video`. Raises `InputError` if the recording lacks what the method
        needs.
        """
        self.check_options(**options)
        return Video(self, recording, self.Params() if params is None else params, **options)

    def live(
        self, size: tuple[int, int], params: P | None = None, *, frames: bool, **options: Any
    ) -> LiveVideo:
        """Images of events, and with `frames` of frames, that are still to come; see `LiveVideo`.

        `size` is (width, height). Options: `window_events`, which are filtered together; `extra`,
        a recording's further arrays, for a camera response. Raises `InputError` for a method that
        looks ahead.
        """
        if self.needs_future:
            raise InputError(f"the method {self.name!r} needs what comes later; use akf")
        self.check_options(**options)
        params = self.Params() if params is None else params
        return LiveVideo(self, size, params, frames=frames, **options)
