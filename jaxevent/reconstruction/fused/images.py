"""Images and their derivatives by parameters in one pass of a kernel, as a function for JAX.

A kernel carries the derivatives of each pixel's state beside it (`slopes`), forwards along the
parameters that are asked for. JAX sees a function with a rule for its derivatives (`custom_jvp`),
which is linear in the parameters' changes; so gradients in reverse cost the same one pass.
"""

import functools
import itertools
import threading
import weakref
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from jaxevent.estimator import Estimate
from jaxevent.reconstruction.clock import Timing
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.fused.passes import DividedRecording, Passes
from jaxevent.reconstruction.fused.pixel import Directions
from jaxevent.recording import Recording

_held: "weakref.WeakValueDictionary[int, Divided]" = weakref.WeakValueDictionary()
_numbers = itertools.count()


class Divided:
    """A recording divided among bands, with the kernels that have passed over it.

    What is of one method, precision and size is equal: programs that JAX compiles for one serve
    all. Which one is meant is told by its number, when they run.
    """

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        self._recording = DividedRecording(recording, Timing.of(params), method.filters)
        self.method, self.dtype = method, self._recording.dtype
        self.pixels = recording.width * recording.height
        self._clock_offset = np.asarray(params.clock_offset)
        self._window = self._recording.cut(None, self._recording.windows.initial())
        self._times = times - self._recording.origin
        self._lock = threading.Lock()
        self._passes: dict[Directions, Passes] = {}
        self.check(params)
        self.number = next(_numbers)
        _held[self.number] = self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Divided) and self._kind() == other._kind()

    def __hash__(self) -> int:
        return hash(self._kind())

    def _kind(self) -> tuple:
        return self.method, self.pixels, self.dtype.name

    def check(self, params: Any) -> None:
        """Raise `Untranslatable` unless there are kernels for the images and their derivatives."""
        self._recording.kernel(self.method, params, self._clock_offset)
        dead = params.without_gradient()
        numbers = [
            (leaf, k)
            for leaf, (path, value) in enumerate(jax.tree_util.tree_flatten_with_path(params)[0])
            if getattr(path[-1], "key", None) not in dead
            for k in range(np.size(value))
        ]
        self._recording.check(
            self.method,
            params,
            self._clock_offset,
            Directions(tuple(numbers), ("mean", "variance")),
        )

    def images(
        self, rows: NDArray, params: Any, directions: Directions
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Images at some of the times, and their derivatives (times, pixels, images, lanes)."""
        wanted, places = np.unique(rows, return_inverse=True)
        times = self._times[wanted]
        with self._lock:
            kernel = self._recording.kernel(self.method, params, self._clock_offset, directions)
            passes = self._passes.get(directions)
            if passes is None or passes.kernel.source is not kernel.source:
                passes = Passes(kernel, self._recording.layout, self.dtype)
                self._passes[directions] = passes
            passes.kernel = kernel
            passes.begin(self._window)
            images = passes.room(len(times), self.pixels)
            passes.run(self._window, int(times[-1]) + 1 if len(times) else 0, times, images)
        made = images.mean, images.variance, images.valid.view(bool), images.slopes
        if len(wanted) == len(rows) and (places == np.arange(len(rows))).all():
            return made
        mean, variance, valid, slopes = (array[places] for array in made)
        return mean, variance, valid, slopes


class FusedImages(eqx.Module):
    """`PreparedImages` by kernels. Raises `Untranslatable` where there are none."""

    number: Int[Numeric, ""]  # of what is held
    rows: Int[Numeric, " times"]
    held: Divided = eqx.field(static=True)

    @classmethod
    def of(
        cls, method: Any, recording: Recording, times: NDArray[np.int64], params: Any
    ) -> "FusedImages":
        held = Divided(method, recording, times, params)
        return cls(np.asarray(held.number, np.int32), np.arange(len(times)), held)

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        outputs = ("mean", "variance") if variance else ("mean",)
        mean, P, valid = _images((self.held, outputs), self.number, self.rows, params)
        return Estimate(mean, P, valid)

    def take(self, rows: NDArray) -> "FusedImages":
        return FusedImages(self.number, np.asarray(self.rows)[rows], self.held)

    def over(self, devices: Sequence[Any]) -> "FusedImages":
        """Images of kernels are made on the host."""
        return self


def _evaluate(
    tree: Any, directions: Directions, number: Any, rows: Any, leaves: list[Any]
) -> tuple[NDArray, ...]:
    held = _held[int(number)]
    params = jax.tree.unflatten(tree, [np.asarray(leaf) for leaf in leaves])
    made = held.images(np.asarray(rows), params, directions)
    return made if directions.numbers else made[:3]


def _called(
    about: tuple[Divided, tuple[str, ...]], number: Any, rows: Any, params: Any, numbers: tuple
) -> Any:
    held, outputs = about
    leaves, tree = jax.tree.flatten(params)
    directions = Directions(numbers, outputs if numbers else Directions().of)
    shape = len(rows), held.pixels
    shapes = [jax.ShapeDtypeStruct(shape, kind) for kind in (held.dtype, held.dtype, bool)]
    if numbers:
        shape = *shape, len(outputs), directions.lanes
        shapes.append(jax.ShapeDtypeStruct(shape, held.dtype))
    evaluate = functools.partial(_evaluate, tree, directions)
    return jax.pure_callback(
        evaluate, tuple(shapes), number, rows, leaves, vmap_method="sequential"
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _images(about: Any, number: Any, rows: Any, params: Any) -> Any:
    return _called(about, number, rows, params, ())


def _images_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    """The images' changes: sums of derivatives by numbers times the numbers' changes."""
    number, rows, params = primals
    changes = jax.tree.leaves(tangents[2], is_leaf=_is_zero)
    moving = [k for k, change in enumerate(changes) if not _is_zero(change)]
    numbers = tuple((k, place) for k in moving for place in range(changes[k].size))
    if not numbers:
        images = _images(about, number, rows, params)
        return images, tuple(jnp.zeros(image.shape, _tangent(image)) for image in images)
    mean, variance, valid, slopes = _called(about, number, rows, params, numbers)
    change = jnp.concatenate([jnp.ravel(changes[k]) for k in moving]).astype(slopes.dtype)
    change = jnp.pad(change, (0, slopes.shape[-1] - change.size))
    moved = jnp.einsum("tpil,l->tpi", slopes, change)
    d_variance = moved[..., 1] if moved.shape[-1] > 1 else jnp.zeros_like(variance)
    d_valid = np.zeros(valid.shape, jax.dtypes.float0)
    return (mean, variance, valid), (moved[..., 0], d_variance, d_valid)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _tangent(image: Any) -> Any:
    return image.dtype if jnp.issubdtype(image.dtype, jnp.inexact) else jax.dtypes.float0


_images.defjvp(_images_jvp, symbolic_zeros=True)
