"""The contract of reconstruction methods: `jaxevent.estimator` for images."""

import abc
import dataclasses
from collections.abc import Hashable, Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from jaxevent.deprecated import renamed_methods
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, Estimator
from jaxevent.events.clocks import check_clocks
from jaxevent.reconstruction.augment import calibrated_values
from jaxevent.reconstruction.engine.images import make_kernel_images, make_kernel_video
from jaxevent.reconstruction.features import Features, ReadOut
from jaxevent.reconstruction.frames import EventTiming, time_span
from jaxevent.reconstruction.live import LiveVideo
from jaxevent.reconstruction.video import ImageSequence, P, Video
from jaxevent.reconstruction.windows import prepare
from jaxevent.recording import Recording, Times, check_times, microseconds


@runtime_checkable
class PreparedImages(Protocol):
    """Images at the times that were prepared: `mean, variance, valid = images(params)`.

    A pytree, pure: it jits, maps over `params` and differentiates. Each array is (times, pixels).
    """

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        """Compute the images at the prepared times.

        Args:
            params: Parameters of the method.
            variance: Whether to compute the variance and its derivatives.

        Returns:
            Mean (ln I), variance (ln I)^2 and `valid`, each (times, pixels).
        """
        ...

    def take(self, rows: NDArray) -> "PreparedImages":
        """Choose the images at some of the times, in the order of `rows`."""
        ...


class ScannedImages(eqx.Module):
    """`PreparedImages` by a method's `run` and `read`."""

    features: Any  # inputs of the method's `run`
    out: Any  # times of images, as the method's `read` takes them
    method: Any = eqx.field(static=True)  # the method

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        trajectory, _ = self.method.run(params, self.features)
        return self.method.read(params, trajectory, self.out)

    def take(self, rows: NDArray) -> "ScannedImages":
        """Choose some of the images; see `PreparedImages.take`."""
        return ScannedImages(self.features, self.out.take(rows), self.method)


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
    has_likelihood: ClassVar[bool] = False  # whether it has `log_likelihood`
    measures_events: ClassVar[bool] = False  # whether that is of events, else of the frames given
    is_absolute: ClassVar[bool] = True  # whether intensity has the frames' black and white

    @property
    def by_parameters(self) -> str:
        if not self.differentiable:
            return super().by_parameters
        return (
            f"prepare once outside, images = {self.spelled}.prepare_images(recording, times), and "
            "map or differentiate images(params)"
        )

    def check_span(self, recording: Recording, times: Times, params: P) -> None:
        """Check that times lie within the recording, its frames on either clock.

        Args:
            recording: Events and frames.
            times: Times of images, us or s.
            params: Parameters, of which `clock_offset` is used.

        Raises:
            InputError: A time lies outside.
        """
        check_times(times, *time_span(recording, params.clock_offset), recording.name)

    def names_left_open(self, explicit: Mapping[str, Any]) -> tuple[str, ...]:
        return super().names_left_open(explicit) if self.fuses else ()

    def usual_params(self, recording: Recording) -> P:
        """Return the parameters with which `estimate` makes images where none are given.

        Methods that combine events and frames take clock and thresholds from the recording.

        Args:
            recording: Events and frames.

        Returns:
            The parameters.

        Raises:
            InputError: The recording lacks what the method needs.
        """
        self.check(recording)
        params = self.Params()
        found = calibrated_values(recording, params, self.names_left_open({})).found
        return params.replace(**found)

    def check(self, recording: Recording) -> None:
        """Raise `InputError` for a recording without data, or without what the method needs."""
        super().check(recording)
        recording.refuse_empty()

    def check_request(
        self, recording: Recording, times: Times, params: P | None, extrapolate: bool
    ) -> tuple[P, NDArray[np.int64]]:
        """Check what `prepare` is given, and find the events' times of images.

        Args:
            recording: Events and frames.
            times: Times of images, integers in us or floats in s.
            params: Parameters; the defaults if None.
            extrapolate: Whether times may lie outside the recording.

        Returns:
            The parameters, and the times of the events that show the images, us: `event_delay`
            later.

        Raises:
            InputError: The recording lacks what the method needs, or times lie outside it.
        """
        self.check(recording)
        params = self.Params() if params is None else params
        self.check_clocks(recording, params)
        if not extrapolate:
            self.check_span(recording, times, params)
        delay_us = EventTiming.of(params).image_delay_us
        return params, np.atleast_1d(microseconds(times)) + delay_us

    def check_clocks(self, recording: Recording, params: P) -> None:
        """Check that frames and events that are combined can be on one clock (`events.clocks`).

        Args:
            recording: Events and frames.
            params: Parameters, of which `clock_offset` is used.

        Raises:
            InputError: They cannot; where it is but doubtful there is a warning.
        """
        if self.fuses:
            check_clocks(recording, params.clock_offset)

    @abc.abstractmethod
    def estimate(
        self, recording: Recording, params: P | None = None, **options: Any
    ) -> ImageSequence[P]:
        """Make images of a recording: `mean, variance, valid = estimate(recording, params)(times)`.

        Args:
            recording: Events and frames.
            params: Parameters; those of `usual_params` if None.
            **options: Options of the method.

        Returns:
            Images as a function of time.

        Raises:
            InputError: The recording lacks what the method needs.
        """

    def live(
        self, size: tuple[int, int], params: P | None = None, *, frames: bool, **options: Any
    ) -> LiveVideo:
        """Make images of events that are still to come, which per-pixel methods alone can.

        Args:
            size: Width and height of the sensor, px.
            params: Parameters; the defaults if None.
            frames: Whether frames will come.
            **options: Options of the method.

        Returns:
            The images, to which events are added.

        Raises:
            InputError: The method takes whole recordings.
        """
        raise InputError(
            f"the method {self.name!r} takes whole recordings; use akf, cf or high-pass for events "
            "that are still to come"
        )

    def preparation_key(self, params: P) -> Hashable:
        """Return the parameters that preparation depends on: images are prepared again with others.

        Args:
            params: Parameters.

        Returns:
            Their values.
        """
        return EventTiming.of(params)

    def prepare_images(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
    ) -> PreparedImages:
        """Prepare the images at sorted times as a function of parameters, for losses.

            images = akf.prepare_images(recording, times)
            loss = lambda params: ((images(params).mean - truth) ** 2).mean()
            value, gradient = jax.jit(jax.value_and_grad(loss))(akf.Params())

        Args:
            recording: Events and frames.
            times: Sorted times, integers in us or floats in s.
            params: Parameters that act through comparisons with event times, see `prepare`; the
                defaults if None.
            extrapolate: Allow times outside the recording.

        Returns:
            The images as a function of parameters.

        Raises:
            InputError: As `prepare`.
        """
        features, out = self.prepare(recording, times, params, extrapolate=extrapolate)
        return ScannedImages(features, out, self)


@renamed_methods(filters="is_event_driven", looks_ahead="needs_future", start="init_state")
@dataclasses.dataclass(frozen=True, repr=False)
class PixelEstimator(ImageEstimator[P]):
    """A reconstruction method that takes each pixel on its own, in windows of events."""

    options: frozenset[str] = dataclasses.field(default=frozenset({"window_events"}), kw_only=True)

    @property
    @abc.abstractmethod
    def is_event_driven(self) -> bool:
        """True if the method passes over single events."""

    @property
    def needs_future(self) -> bool:
        """True if `run` needs the message of later windows."""
        return False

    @abc.abstractmethod
    def init_state(self, params: P, features: Features) -> Any:
        """Return the state at the recording's start.

        Args:
            params: Parameters.
            features: The first window.

        Returns:
            A pytree of arrays (pixels,).
        """

    @abc.abstractmethod
    def run(
        self, params: P, features: Features, state: Any = None, future: Any = None
    ) -> tuple[Any, Any]:
        """Estimate a window; pure, so it jits, vmaps over `params` and differentiates.

        Args:
            params: Parameters.
            features: The window.
            state: State that the window before returned; None: the recording starts here.
            future: Message of later windows, for methods that need it; None: there are none.

        Returns:
            The trajectory, to `read` images from, and the state for the next window.
        """

    @abc.abstractmethod
    def read(self, params: P, trajectory: Any, out: ReadOut) -> Estimate:
        """Read images of a window; pure, as `run`.

        Args:
            params: Parameters.
            trajectory: Trajectory that `run` returned.
            out: Prepared times of images.

        Returns:
            The images, each array (times, pixels).
        """

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
    ) -> tuple[Features, ReadOut]:
        """Prepare a recording for `run`, and images for `read`; see `windows.prepare`.

        Args:
            recording: Events and frames.
            times: Sorted times, integers in us or floats in s.
            params: Parameters that act through comparisons with event times; the defaults if None.
            extrapolate: Allow times outside the recording.

        Returns:
            The features of the recording, and the read-out of the images.

        Raises:
            InputError: The recording lacks what the method needs, or times are not sorted or
                outside
                the recording.
        """
        params, times = self.check_request(recording, times, params, extrapolate)
        return prepare(recording, times, EventTiming.of(params), filtering=self.is_event_driven)

    def estimate(
        self, recording: Recording, params: P | None = None, **options: Any
    ) -> ImageSequence[P]:
        """Make images of a recording: `mean, variance, valid = estimate(recording, params)(times)`.

        Args:
            recording: Events and frames.
            params: Parameters; those of `usual_params` if None.
            **options: Options of `Video`.

        Returns:
            Images as a function of time.

        Raises:
            InputError: The recording lacks what the method needs.
        """
        self.check_options(**options)
        params = self.usual_params(recording) if params is None else params
        return Video(self, recording, params, **options)

    def live(
        self, size: tuple[int, int], params: P | None = None, *, frames: bool, **options: Any
    ) -> LiveVideo:
        """Make images of events, and perhaps frames, that are still to come; see `LiveVideo`.

        Args:
            size: Width and height of the sensor, px.
            params: Parameters; the defaults if None.
            frames: Whether frames will come.
            **options: `window_events`, which are filtered together; `extra`, a recording's further
                arrays, for a camera response.

        Returns:
            The images, to which events are added.

        Raises:
            InputError: The method needs later events.
        """
        if self.needs_future:
            raise InputError(f"the method {self.name!r} needs what comes later; use akf")
        self.check_options(**options)
        params = self.Params() if params is None else params
        return LiveVideo(self, size, params, frames=frames, **options)


@dataclasses.dataclass(frozen=True, repr=False)
class KernelEstimator(PixelEstimator[P]):
    """A per-pixel method of which numba makes kernels for the CPU, from its own functions."""

    kernel_video: ClassVar[Any]  # class of its images, see `engine.images`
    kernel_images: ClassVar[Any]  # class of its kernels for prepared images
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "compiler"}), kw_only=True
    )

    def estimate(
        self,
        recording: Recording,
        params: P | None = None,
        *,
        compiler: str | None = None,
        **options: Any,
    ) -> ImageSequence[P]:
        """Make images of a recording: `mean, variance, valid = estimate(recording, params)(times)`.

        In single precision they come from a kernel that numba compiles from the method's own
        functions (`engine`) for the CPU. `run` and `read`, compiled by XLA, serve where a function
        has no translation, and in double precision.

        Args:
            recording: Events and frames.
            params: Parameters; those of `usual_params` if None.
            compiler: "numba" or "xla", to demand one of the two.
            **options: Options of `Video`; those of `aks` include `factors`.

        Returns:
            Images as a function of time.

        Raises:
            InputError: The recording lacks what the method needs, or no kernel can do what is
                demanded.
        """
        self.check_options(**options)
        params = self.usual_params(recording) if params is None else params
        fused = make_kernel_video(self.kernel_video, self, recording, params, compiler, options)
        return Video(self, recording, params, **options) if fused is None else fused

    def prepare_images(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        extrapolate: bool = False,
        compiler: str | None = None,
    ) -> PreparedImages:
        """Prepare the images at sorted times as a function of parameters, for losses.

        In single precision a kernel makes images and their derivatives by all parameters in one
        pass over the events, on the CPU. `run` and `read` serve where a function has no
        translation, in double precision, for derivatives by the dead time `rho_ref`, and where JAX
        computed before jaxevent was imported (`jaxevent.threads`).

        Args:
            recording: Events and frames.
            times: Sorted times, integers in us or floats in s.
            params: Parameters that act in preparation; the defaults if None.
            extrapolate: Allow times outside the recording.
            compiler: "numba" or "xla", to demand the kernel or to do without it.

        Returns:
            The images as a function of parameters.

        Raises:
            InputError: As `estimate`, and for times that are not sorted or outside the recording.
        """
        params = self.Params() if params is None else params
        fused = make_kernel_images(
            self.kernel_images,
            self,
            recording,
            times,
            params,
            extrapolate=extrapolate,
            compiler=compiler,
        )
        if fused is not None:
            return fused
        return super().prepare_images(recording, times, params, extrapolate=extrapolate)
