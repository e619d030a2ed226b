"""Images from events alone as a function of time."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Recording

GREY = 0.5  # intensity where the log intensity is 0, in the middle of the scale


class EventsOnlyVideo(ImageSequence[Params]):
    """Images from events alone: `image, variance, valid = video(times)`.

    Args:
        estimator: The method.
        recording: Events.
        params: Its parameters.
        progress: Show a progress bar; None: if it takes long.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: Params,
        *,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(jnp.result_type(float))

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        for n in range(len(times)):
            batch = times[n : n + 1]
            features, out = self.estimator.prepare(
                self.recording, batch, self.params, extrapolate=True
            )
            trajectory, _ = self.estimator.run(self.params, features)
            yield batch, tuple(self.estimator.read(self.params, trajectory, out))
