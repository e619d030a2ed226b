"""Cameras: how intensity becomes grey levels and with what certainty; pinhole geometry."""

import abc
import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxevent.errors import InputError


@dataclasses.dataclass(frozen=True)
class PinholeCamera:
    """Focal lengths and centre in pixels; distortion k1, k2, p1, p2, k3 (Brown-Conrady)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class Response(eqx.Module):
    """A camera response: intensity of a grey value, and how certain the grey value makes it."""

    @abc.abstractmethod
    def intensity(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        """Intensity in [0, 1] of a grey value in [0, 1]: the inverse camera response."""

    @abc.abstractmethod
    def certainty(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        """w = dCRF/dE at that grey value, scaled to the maximum 1 (AKF paper section 3.2.1)."""


class UnknownResponse(Response):
    """Grey is intensity; certainty 4 I (1 - I): full at mid-grey, none where the sensor clips."""

    def intensity(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        return grey

    def certainty(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        return 4 * grey * (1 - grey)


class TableResponse(Response):
    """A monotone table: `levels[i]` is the intensity at grey value i / (len(levels) - 1).

    The certainty is `weights`, entry by entry, scaled to the maximum 1; omitted, it is the slope of
    grey over intensity, by central differences of the table. Tables of the authors' recordings:
    `TableResponse(jnp.linspace(0, 1, 256), recording.extra["f_Q"])`. Raises `InputError` for a
    table of fewer than 3 intensities, one that falls, and weights of another length.
    """

    levels: Float[Array, " entries"]
    weights: Float[Array, " entries"]

    def __init__(self, levels: ArrayLike, weights: ArrayLike | None = None):
        table = np.asarray(levels, float)
        if table.ndim != 1 or len(table) < 3 or not (np.diff(table) >= 0).all():
            raise InputError("a camera response needs 3 or more intensities that never fall")
        certain = 1 / np.maximum(np.gradient(table), 1e-9) if weights is None else weights
        certain = np.asarray(certain, float)
        if certain.shape != table.shape or not (certain >= 0).all() or not certain.max() > 0:
            raise InputError(
                f"a camera response of {len(table)} intensities needs as many weights, none "
                "negative and not all 0"
            )
        self.levels = jnp.asarray(table, jnp.result_type(float))
        self.weights = jnp.asarray(certain / certain.max(), jnp.result_type(float))

    def intensity(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._at(self.levels, grey)

    def certainty(self, grey: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._at(self.weights, grey)

    def _at(self, table: Float[Array, " entries"], grey: Float[Array, "..."]):
        return jnp.interp(grey, jnp.linspace(0, 1, table.shape[0]), table)
