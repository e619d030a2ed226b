"""Images of a recording as a function of parameters, for losses and their derivatives."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
from numpy.typing import NDArray

from jaxevent.estimator import Estimate


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
        return ScannedImages(self.features, self.out.images(rows), self.method)

    def over(self, devices: Sequence[Any]) -> "ScannedImages":
        return ScannedImages(self.features.over(devices), self.out.over(devices), self.method)
