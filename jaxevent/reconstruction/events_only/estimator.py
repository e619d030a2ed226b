"""The method `events-only`: video from events alone."""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.cache import ByValue
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.events_only.gradient import (
    WindowEquations,
    held_out_likelihood,
    pack_equations,
    sample_variance,
    solve_equations,
    threshold,
)
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.rows import EVENT, Rows
from jaxevent.reconstruction.events_only.video import (
    EventsOnlyVideo,
    IntensityScale,
    read_intensity,
)
from jaxevent.reconstruction.events_only.windows import SolvedWindow, WindowSolver
from jaxevent.reconstruction.features import Numeric
from jaxevent.recording import Recording, Times

HELD_OUT_STEP = 5  # one of so many events is predicted by the others


def _choose_held_out(rows: Rows) -> NDArray[np.bool_]:
    """Choose rows of events evenly, in the order of their times."""
    event = rows.kind == EVENT
    return event & (np.cumsum(event) % HELD_OUT_STEP == 0)


class WindowFeatures(ShortRepr):
    """Windows of events around the prepared times, the features that `run` takes."""

    equations: WindowEquations  # stacked


class HeldOutEvents(ShortRepr):
    """Windows of events, of which some events are to be predicted by the others."""

    equations: WindowEquations  # stacked
    held: Float[Numeric, "times rows"]  # 1 for an event to predict, else 0

    @property
    def count(self) -> int:
        """Number of the events to predict."""
        return int(self.held.sum())


class WindowImages(NamedTuple):
    """Log images of windows."""

    L: Float[Array, "times pixels"]  # ln I
    P: Float[Array, "times pixels"]  # variance, (ln I)^2


class PreparedTimes(ShortRepr):
    """Times to read images at, as rows of the windows."""

    rows: Any
    scale: IntensityScale

    def take(self, rows: Any) -> "PreparedTimes":
        """Choose some of the images, in the order of `rows`."""
        return PreparedTimes(self.rows[rows], IntensityScale(*(v[rows] for v in self.scale)))


@dataclasses.dataclass(frozen=True, repr=False)
class EventsOnly(ImageEstimator[Params]):
    """Video from events alone."""

    has_likelihood: ClassVar[bool] = True
    measures_events: ClassVar[bool] = True
    is_absolute: ClassVar[bool] = False
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"causal", "motion"}), kw_only=True
    )

    def preparation_key(self, params: Params) -> Hashable:
        return ByValue(params.raw)  # motion is estimated with all of them

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
        windows, wanted, params = self._open(recording, times, params, extrapolate)
        solved = list(windows.each(wanted.tolist()))
        equations, _ = self._stack(windows, solved, params)
        scale = IntensityScale.of(solved, float(params.I0))
        return WindowFeatures(equations), PreparedTimes(np.arange(len(wanted)), scale)

    def _open(
        self,
        recording: Recording,
        times: Times,
        params: Params | None,
        extrapolate: bool = False,
    ) -> tuple[WindowSolver, NDArray[np.int64], Params]:
        params, wanted = self.check_request(recording, times, params, extrapolate)
        if not len(wanted):
            raise InputError(f"{recording.name}: no times to prepare images for; give some")
        return WindowSolver(recording, params), wanted, params

    def _stack(
        self,
        windows: WindowSolver,
        solved: Sequence[SolvedWindow],
        params: Params,
        held_out: Callable[[Rows], NDArray[np.bool_]] | None = None,
    ) -> tuple[WindowEquations, Array]:
        """Stack the equations of solved windows.

        Args:
            windows: The solver of the windows.
            solved: The solved windows.
            params: Parameters that their rows were made with.
            held_out: Chooses rows (booleans) that the solution did not see; None: it saw all.

        Returns:
            The equations, filled up to the same number of rows, and 1 for rows that are held out,
            else 0, (windows, rows).
        """
        count = max(len(one.rows.kind) for one in solved)
        packed = [pack_equations(one, windows.relative, params, count) for one in solved]
        held = np.zeros((len(solved), count), packed[0].fraction.dtype)
        for row, one in zip(held, solved, strict=True):
            if held_out is not None:
                row[: len(one.rows.kind)] = held_out(one.rows)
        equations = jax.tree.map(lambda *leaves: np.stack(leaves), *packed)
        return jax.device_put((equations, held))

    def prepare_likelihood(
        self, recording: Recording, times: Times, params: Params | None = None
    ) -> HeldOutEvents:
        """Prepare the windows at some times for `log_likelihood`.

        Args:
            recording: Events.
            times: (T,) times at the middle of windows, us or s.
            params: Parameters with which motion is estimated; None: the defaults.

        Returns:
            The windows, one of `HELD_OUT_STEP` events of which is to be predicted.

        Raises:
            InputError: As `prepare`.
        """
        windows, wanted, params = self._open(recording, times, params)
        solved = list(windows.each(wanted.tolist(), variance=False, held_out=_choose_held_out))
        return HeldOutEvents(*self._stack(windows, solved, params, _choose_held_out))

    def log_likelihood(self, params: Params, features: HeldOutEvents) -> Float[Array, ""]:
        """Return the log likelihood of events that the others of their window predict.

        Args:
            params: Parameters.
            features: Windows of `prepare_likelihood`.

        Returns:
            (), a sum over the events to be predicted.
        """

        @jax.checkpoint
        def one(window: tuple[WindowEquations, Array]) -> Array:
            return held_out_likelihood(*window, params)

        return jax.lax.map(one, (features.equations, features.held)).sum()

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
        return Estimate(*read_intensity(params, L, P, out.scale))

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
    "The log intensity is known up to an offset and a factor: the geometric mean of each image is "
    "0.5.",
)
