"""Images from events alone as a function of time."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.locks import synchronized
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.windows import FlowSource, WindowSolver
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Recording, Times, microseconds

GREY = 0.5  # intensity where the log image is at its mean: events alone tell it up to a factor


def read_intensity(params: Params, L: Array, P: Array) -> tuple[Array, Array, Array]:
    """Return mean, variance and validity of an estimate; pure.

    Args:
        params: Parameters.
        L: (images, ...) log images, ln I.
        P: Their variance, (ln I)^2.

    Returns:
        Intensity, of which the geometric mean (of I + I0) of an image is 0.5; P; and whether the
        standard deviation is below `vague`.
    """
    level = L.mean(tuple(range(1, L.ndim)), keepdims=True)
    image = (GREY + params.I0) * jnp.exp(L - level) - params.I0
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
        for n, t in enumerate(times.tolist()):
            solution = self._windows(t).solution
            images = (v[None].astype(self.dtype) for v in (solution.log_image, solution.variance))
            yield times[n : n + 1], _read_compiled(self.params, *images)

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
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            self.estimator.check_span(self.recording, wanted, self.params)
        return self._windows.flow.flow(wanted, extrapolate=True)
