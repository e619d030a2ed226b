"""Images and their derivatives by parameters in one pass of a kernel, as a function for JAX.

A kernel carries the derivatives of each pixel's state beside it (`slopes`), forwards along the
parameters that are asked for. JAX sees a function with a rule for its derivatives (`custom_jvp`),
which is linear in the parameters' changes; so gradients in reverse cost the same one pass.
"""

import abc
import functools
import itertools
import weakref
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from jaxevent import dispatch
from jaxevent.codegen.module import choose_backend, make_kernel
from jaxevent.devices import full_precision, has_accelerator
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.locks import TurnLock
from jaxevent.reconstruction.engine.loop import Images
from jaxevent.reconstruction.engine.passes import DividedRecording, Passes
from jaxevent.reconstruction.engine.pixel import Directions
from jaxevent.reconstruction.engine.video import serves_images
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.frames import Timing
from jaxevent.reconstruction.windows import sorted_times
from jaxevent.recording import Recording, Times

IS_SYNCHRONOUS = dispatch.use_synchronous_dispatch()  # so that programs may call kernels

_held: "weakref.WeakValueDictionary[int, Divided]" = weakref.WeakValueDictionary()
_numbers = itertools.count()


class Divided(abc.ABC):
    """A recording divided among bands, with the kernels that have passed over it.

    What is of one method, precision and size is equal: programs that JAX compiles for one serve
    all. Which one is meant is told by its number, when they run. Raises `TranslationError` unless
    there are kernels for the images and their derivatives.
    """

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        self.recording = DividedRecording(recording, Timing.of(params), method.is_event_driven)
        self.method, self.dtype = method, self.recording.dtype
        self.pixels = recording.width * recording.height
        self.clock_offset = np.asarray(params.clock_offset)
        self._times = times - self.recording.origin
        self._made_of = method, recording, times, params
        self._turns = TurnLock(f"images of {recording.name}")
        dead = params.without_gradient()
        numbers = [
            (leaf, k)
            for leaf, (path, value) in enumerate(jax.tree_util.tree_flatten_with_path(params)[0])
            if getattr(path[-1], "key", "point") not in {"point", *dead}
            for k in range(np.size(value))
        ]
        self.check(params, Directions(tuple(numbers), ("mean", "variance")))
        self.number = next(_numbers)
        _held[self.number] = self

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._made_of

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Divided) and self._kind() == other._kind()

    def __hash__(self) -> int:
        return hash(self._kind())

    def _kind(self) -> tuple:
        return self.method, self.pixels, self.dtype.name

    @abc.abstractmethod
    def check(self, params: Any, directions: Directions) -> None:
        """Raise `TranslationError` unless there are kernels for images and these derivatives."""

    @abc.abstractmethod
    def make(self, times: NDArray[np.int64], params: Any, directions: Directions) -> Images:
        """Images at sorted times (us since the recording's start), and their derivatives."""

    def images(
        self, rows: NDArray, params: Any, directions: Directions
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Images at some of the times, and their derivatives (times, pixels, images, lanes)."""
        wanted, places = np.unique(rows, return_inverse=True)
        with self._turns:
            images = self.make(self._times[wanted], params, directions)
        made = images.mean, images.variance, images.valid.view(bool), images.slopes
        if len(wanted) == len(rows) and (places == np.arange(len(rows))).all():
            return made
        mean, variance, valid, slopes = (array[places] for array in made)
        return mean, variance, valid, slopes


class DividedEvents(Divided):
    """Of a filter, which passes over the events."""

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        super().__init__(method, recording, times, params)
        self._window = self.recording.cut(None, self.recording.windows.initial())
        self._passes: dict[Directions, Passes] = {}

    def check(self, params: Any, directions: Directions) -> None:
        self.recording.kernel(self.method, params, self.clock_offset)
        self.recording.check(self.method, params, self.clock_offset, directions)

    def make(self, times: NDArray[np.int64], params: Any, directions: Directions) -> Images:
        kernel = self.recording.kernel(self.method, params, self.clock_offset, directions)
        passes = self._passes.get(directions)
        if passes is None or passes.kernel.places is not kernel.places:
            passes = Passes(kernel, self.recording.layout, self.dtype)
            self._passes[directions] = passes
        passes.kernel = kernel
        passes.begin(self._window)
        images = passes.room(len(times), self.pixels)
        passes.run(self._window, int(times[-1]) + 1 if len(times) else 0, times, images)
        return images


class FusedImages(eqx.Module):
    """`PreparedImages` by kernels."""

    number: Int[Numeric, ""]  # of what is held
    rows: Int[Numeric, " times"]
    held: Divided = eqx.field(static=True)

    @classmethod
    def of(cls, held: Divided, times: int) -> "FusedImages":
        return _again(held, np.arange(times))

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self.held, np.asarray(self.rows))

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        outputs = ("mean", "variance") if variance else ("mean",)
        # No image depends on `point`: without a tangent of it the kernel carries none.
        params = eqx.tree_at(lambda p: p.point, params, jax.lax.stop_gradient(params.point))
        mean, P, valid = _images((self.held, outputs), self.number, self.rows, params)
        return Estimate(mean, P, valid)

    def take(self, rows: NDArray) -> "FusedImages":
        return FusedImages(self.number, np.asarray(self.rows)[rows], self.held)

    def over(self, devices: Sequence[Any]) -> "FusedImages":
        """Images of kernels are made on the host."""
        return self


def _again(held: Divided, rows: NDArray) -> FusedImages:
    """Images of what a pickle or copy holds, which has a number of its own."""
    return FusedImages(np.asarray(held.number, np.int32), rows, held)


def prepared_by_kernel(
    kind: type[Divided],
    method: Any,
    recording: Recording,
    times: Times,
    params: Any,
    extrapolate: bool,
    compiler: str | None,
) -> FusedImages | None:
    """A method's images at sorted times by kernels; None where these do not serve.

    See `Filter.prepare_images`. Raises `InputError` where numba is asked for what it cannot do.
    """
    serves = serves_images(jax.local_devices()) and not has_accelerator()
    backend = choose_backend(compiler, serves)
    if backend == "xla" or not IS_SYNCHRONOUS or "rho_ref" in params.followed:
        return None
    method.check(recording)
    method.check_clocks(recording, params)
    times = sorted_times(times)
    if not extrapolate:
        method.check_span(recording, times, params)

    def make() -> FusedImages:
        return FusedImages.of(kind(method, recording, times, params), len(times))

    return make_kernel(method.name, compiler, serves, make)


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


@full_precision
def _images_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    """The images' changes: sums of derivatives by numbers times the numbers' changes."""
    number, rows, params = primals
    changes = jax.tree.leaves(tangents[2], is_leaf=_is_zero)
    moving = [k for k, change in enumerate(changes) if not _is_zero(change)]
    numbers = tuple((k, place) for k in moving for place in range(changes[k].size))
    if not numbers:
        images = _images(about, number, rows, params)
        return images, tuple(jnp.zeros(image.shape, _tangent(image)) for image in images)
    mean, variance, valid, slopes = _with_derivatives((*about, numbers), number, rows, params)
    change = jnp.concatenate([jnp.ravel(changes[k]) for k in moving]).astype(slopes.dtype)
    change = jnp.pad(change, (0, slopes.shape[-1] - change.size))
    moved = jnp.einsum("tpil,l->tpi", slopes, change)
    d_variance = moved[..., 1] if moved.shape[-1] > 1 else jnp.zeros_like(variance)
    d_valid = np.zeros(valid.shape, jax.dtypes.float0)
    return (mean, variance, valid), (moved[..., 0], d_variance, d_valid)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_derivatives(about: Any, number: Any, rows: Any, params: Any) -> Any:
    held, outputs, numbers = about
    return _called((held, outputs), number, rows, params, numbers)


def _with_derivatives_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    """Refuse second derivatives, which no kernel carries; a change of nothing changes nothing."""
    if not all(map(_is_zero, jax.tree.leaves(tangents, is_leaf=_is_zero))):
        raise InputError(
            f"the kernel of the method {about[0].method.name!r} has first derivatives only; for "
            'second ones, as of jax.hessian, give prepare_images(..., compiler="xla")'
        )
    made = _with_derivatives(about, *primals)
    return made, tuple(jnp.zeros(one.shape, _tangent(one)) for one in made)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _tangent(image: Any) -> Any:
    return image.dtype if jnp.issubdtype(image.dtype, jnp.inexact) else jax.dtypes.float0


_images.defjvp(_images_jvp, symbolic_zeros=True)
_with_derivatives.defjvp(_with_derivatives_jvp, symbolic_zeros=True)
