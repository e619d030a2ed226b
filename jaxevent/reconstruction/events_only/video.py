"""Images from events alone as a function of time."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.windows import SolvedWindow, WindowSolver
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.video import FlowSource, ImageSequence
from jaxevent.recording import Recording, Times
from jaxevent.threads import synchronized

GREY = 0.5  # intensity where the log image is at its mean: events alone tell it up to a factor


class IntensityScale(NamedTuple):
    """Scales of images: ln(I + I0) = factor (L - mean L) + level.

    Attributes:
        factor: ln I per unit of L.
        level: Mean log intensity.
    """

    factor: Float[Numeric, " images"]
    level: Float[Numeric, " images"]

    @classmethod
    def of(cls, windows: Sequence[SolvedWindow], I0: float) -> "IntensityScale":
        """Return the scales by frames, or those that are agreed where there are none.

        Args:
            windows: Solved windows of the images.
            I0: Offset inside the logarithm.

        Returns:
            The scales.
        """
        agreed = math.log(GREY + I0)
        pairs = [(1.0, agreed)] * len(windows)
        for k, (_, _, solution, scale) in enumerate(windows):
            level = math.nan if scale is None else scale.level(solution.log_image)
            if scale is not None and math.isfinite(level):
                pairs[k] = scale.factor, level + scale.factor * float(solution.log_image.mean())
        return cls(*np.array(pairs, np.dtype(jnp.result_type(float))).T)


def read_intensity(
    params: Params, L: Array, P: Array, scale: IntensityScale
) -> tuple[Array, Array, Array]:
    """Return mean, variance and validity of an estimate; pure.

    Args:
        params: Parameters.
        L: (images, ...) log images, ln I.
        P: Their variance, (ln I)^2.
        scale: Scales of the images.

    Returns:
        Intensity; the variance of ln(I + I0); and whether its root is below `vague`.
    """
    factor, level = (v.reshape(-1, *[1] * (L.ndim - 1)) for v in scale)
    mean = L.mean(tuple(range(1, L.ndim)), keepdims=True)
    image, P = jnp.exp(factor * (L - mean) + level) - params.I0, factor**2 * P
    return image, P, jnp.isfinite(image) & (jnp.sqrt(P) < params.vague)


_read_compiled = jax.jit(read_intensity)


class EventsOnlyVideo(ImageSequence[Params]):
    """Images from events alone: `image, variance, valid = video(times)`.

    A window of events is read for an image, so memory does not grow with the recording's length.

    Args:
        estimator: The method.
        recording: Events.
        params: Its parameters.
        causal: Whether images rest on earlier events alone.
        motion: Optical flow that is known beforehand; None: it is estimated from the events.
        progress: Show a progress bar; None: if it takes long.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: Params,
        *,
        causal: bool = False,
        motion: FlowSource | None = None,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._windows = WindowSolver(recording, params, causal=causal, motion=motion)

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(jnp.result_type(float))

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        for n, window in enumerate(self._windows.each(times.tolist())):
            scale = IntensityScale.of([window], float(self.params.I0))
            L, P = (v[None].astype(self.dtype) for v in window.solution[:2])
            yield times[n : n + 1], _read_compiled(self.params, L, P, scale)

    @synchronized
    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.floating]:
        """Return the optical flow along which images are made.

        Args:
            times: (T,) times, as of images.
            extrapolate: Whether times may lie outside the data.

        Returns:
            (T, H, W, 2) flow along x and y, px/s.

        Raises:
            InputError: A time is not finite, or outside the recording.
        """
        return self._windows.flow.flow(self._among_events(times, extrapolate), extrapolate=True)
