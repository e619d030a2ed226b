"""The method `events-only`: video from events alone."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.video import GREY, EventsOnlyVideo
from jaxevent.reconstruction.features import Numeric
from jaxevent.recording import Recording, Times, microseconds


class WindowFeatures(ShortRepr):
    """Windows of events around the prepared times."""

    counts: Float[Numeric, "times 2 pixels"]


class WindowImages(NamedTuple):
    """Solutions of windows."""

    L: Float[Array, "times pixels"]
    P: Float[Array, "times pixels"]


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
        pixels = recording.width * recording.height
        number = round(float(params.window) * pixels)
        counts = np.zeros((len(wanted), 2, pixels), np.float32)
        for one, t in zip(counts, wanted.tolist(), strict=True):
            last = recording.events.index(t)
            events = recording.events[max(last - number, 0) : last]
            np.add.at(one, (1 - events.p, events.y.astype(int) * recording.width + events.x), 1)
        return WindowFeatures(counts), PreparedTimes(np.arange(len(wanted)))

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
        on, off = features.counts[:, 0], features.counts[:, 1]
        L = params.c_on * on - params.c_off * off
        P = params.c_on * params.c_off * (1 + 100 * jnp.exp(-on - off))
        return WindowImages(L, P), None

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
        image = (GREY + params.I0) * jnp.exp(L) - params.I0
        return Estimate(image, P, jnp.isfinite(image) & (jnp.sqrt(P) < params.vague))

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
