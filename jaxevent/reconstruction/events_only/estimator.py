"""The method `events-only`: video from events alone."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.events_only.gradient import (
    WindowEquations,
    pack_equations,
    sample_variance,
    solve_equations,
    threshold,
)
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.video import EventsOnlyVideo, read_intensity
from jaxevent.reconstruction.events_only.windows import WindowSolver
from jaxevent.recording import Recording, Times, microseconds


class WindowFeatures(ShortRepr):
    """Windows of events around the prepared times, the features that `run` takes."""

    equations: WindowEquations  # stacked

    def over(self, devices: Any) -> "WindowFeatures":
        """Return the windows as they are: pixels depend on each other and are not shared out."""
        return self


class WindowImages(NamedTuple):
    """Log images of windows."""

    L: Float[Array, "times pixels"]  # ln I
    P: Float[Array, "times pixels"]  # variance, (ln I)^2


class PreparedTimes(ShortRepr):
    """Times to read images at, as rows of the windows."""

    rows: Any

    def take(self, rows: Any) -> "PreparedTimes":
        """Choose some of the images, in the order of `rows`."""
        return PreparedTimes(self.rows[rows])

    def over(self, devices: Any) -> "PreparedTimes":
        """Return the times as they are: pixels depend on each other and are not shared out."""
        return self


@dataclasses.dataclass(frozen=True, repr=False)
class EventsOnly(ImageEstimator[Params]):
    """Video from events alone."""

    options: frozenset[str] = dataclasses.field(
        default=frozenset({"causal", "motion"}), kw_only=True
    )

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: Params | None = None,
        *,
        extrapolate: bool = False,
    ) -> tuple[WindowFeatures, PreparedTimes]:
        """Prepare images for `run` and `read`; motion is estimated here.

        Args:
            recording: Events.
            times: (T,) times of the images, us or s.
            params: Parameters with which motion is estimated; None: the defaults.
            extrapolate: Whether times may lie outside the data.

        Returns:
            The windows of events, and the times among them.

        Raises:
            InputError: The recording has no events, or times lie outside it.
        """
        self.check(recording)
        params = self.Params() if params is None else params
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            self.check_span(recording, wanted, params)
        if not len(wanted):
            raise InputError(f"{recording.name}: no times to prepare images for; give some")
        windows = WindowSolver(recording, params)
        solved = [windows(t, variance=False) for t in wanted.tolist()]
        count = max(len(one.rows.kind) for one in solved)
        packed = [pack_equations(one, windows.relative, params, count) for one in solved]
        equations = jax.tree.map(lambda *leaves: np.stack(leaves), *packed)
        features = WindowFeatures(jax.device_put(equations))
        return features, PreparedTimes(np.arange(len(wanted)))

    def run(
        self, params: Params, features: WindowFeatures, state: Any = None
    ) -> tuple[WindowImages, None]:
        """Solve for the images; pure and differentiable.

        Args:
            params: Parameters.
            features: Windows of events.
            state: Not used.

        Returns:
            The solutions, and None: nothing passes from run to run.
        """

        @jax.checkpoint
        def solve(equations: WindowEquations) -> WindowImages:
            u, c = solve_equations(equations, params), threshold(equations, params)
            variance = sample_variance(u, equations, params)
            return WindowImages((c * u).ravel(), (c**2 * variance).ravel())

        return jax.lax.map(solve, features.equations), None

    def read(self, params: Params, trajectory: WindowImages, out: PreparedTimes) -> Estimate:
        """Read the prepared images; pure and differentiable.

        Args:
            params: Parameters.
            trajectory: Result of `run`.
            out: Times of `prepare`.

        Returns:
            Images (T, pixels), their variance (ln I)^2, and which pixels are valid.
        """
        L, P = (leaf[out.rows] for leaf in trajectory)
        return Estimate(*read_intensity(params, L, P))

    def estimate(
        self, recording: Recording, params: Params | None = None, **options: Any
    ) -> EventsOnlyVideo:
        """Make the video of a recording: `image, variance, valid = estimate(recording)(times)`.

        Args:
            recording: Events.
            params: Parameters; None: the defaults.
            **options: Options of `EventsOnlyVideo`.

        Returns:
            The video.

        Raises:
            InputError: The recording has no events, or an option is not known.
        """
        self.check_options(**options)
        chosen = self.usual_params(recording) if params is None else params
        return EventsOnlyVideo(self, recording, chosen, **options)


events_only = EventsOnly(
    "events-only",
    Params,
    fuses=False,
    about="Video from events alone. It estimates motion and image of a window of events together. "
    "The log intensity is known up to an offset and a factor: where nothing is known it is 0 and "
    "the intensity 0.5.",
)
