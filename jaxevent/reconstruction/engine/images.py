"""Images made by kernels: videos, and functions of parameters with derivatives.

Videos pass over windows of events or segments of frames, one after another. For fits a kernel
carries the derivatives of each pixel's state beside it, forwards along the parameters that move.
JAX sees a function with a rule for its derivatives (`custom_jvp`), which is linear in the
parameters' changes; so gradients in reverse cost the same one pass.
"""

import abc
import functools
import itertools
import math
import queue
import weakref
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from jaxevent.codegen import run_over_rows
from jaxevent.codegen.derivative import (
    DerivativeDirections,
    moving_numbers,
    refuse_second_derivatives,
    zero_tangents,
)
from jaxevent.codegen.module import choose_backend, make_kernel, programs_may_call
from jaxevent.estimator import Estimate
from jaxevent.precision import full_precision
from jaxevent.progress import bar
from jaxevent.reconstruction.engine.bands import (
    NEVER_US,
    BufferPool,
    ImageBuffers,
    PartitionedRecording,
)
from jaxevent.reconstruction.engine.filter_loop import (
    BandedWindow,
    FilterPasses,
    PixelStates,
    cut_window,
)
from jaxevent.reconstruction.engine.filter_program import check_filter_kernel
from jaxevent.reconstruction.engine.smoother_loop import (
    FrameSegment,
    ImageTimes,
    SegmentInputs,
    SmootherPasses,
    filter_frames,
    read_images,
    smooth_frames,
)
from jaxevent.reconstruction.engine.smoother_program import (
    LATER_FIELDS,
    LINK_FIELDS,
    STATE_FIELDS,
    SmoothingMethod,
)
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.frames import EventTiming, FrameClock
from jaxevent.reconstruction.stream import StreamState
from jaxevent.reconstruction.video import MAX_WINDOW_STARTS, ImageSequence, P
from jaxevent.reconstruction.windows import sorted_times
from jaxevent.recording import Recording, Times
from jaxevent.threads import TurnLock

MAX_WINDOW_EVENTS = 1 << 21  # 8 bytes each, and 13 where they are read from a file
MAX_SEGMENT_EVENTS = 1 << 22  # 8 bytes each
MAX_SEGMENT_FRAME_PIXELS = 3_000_000  # of a segment's frames, 24 bytes each


class WindowStart(NamedTuple):
    """State from which filtering goes on at a window's start."""

    start: int | None
    context: StreamState  # of weighted events
    states: PixelStates | None  # None: the recording's beginning

    @property
    def time(self) -> float:
        """Start of the window, us."""
        return -math.inf if self.start is None else float(self.start)


class FilterVideo(ImageSequence[P]):
    """Images of a filter, made by a kernel; as `Video` in all else.

    Args:
        estimator: The filter.
        recording: Events and frames.
        params: Parameters of the filter.
        window_events: Most events of a window.
        progress: Whether a bar is shown; None: if it takes long.

    Raises:
        TranslationError: There is no kernel for the method.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: P,
        *,
        window_events: int = MAX_WINDOW_EVENTS,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._partitioned = PartitionedRecording(
            recording, EventTiming.of(params), estimator.is_event_driven, window_events
        )
        # Divided for the parameters' own clock: the lag is exactly 0.
        self._passes = FilterPasses(self._partitioned, estimator, params, params.frame_delay)
        self._buffers = BufferPool(self._partitioned.windows.pixels, self.dtype)
        self._begins = [WindowStart(None, self._partitioned.windows.initial(), None)]
        self._open: BandedWindow | None = None
        self._done = -NEVER_US  # the time up to which the open window is passed over

    @property
    def dtype(self) -> np.dtype:
        return self._partitioned.dtype

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        done, origin = 0, self._partitioned.origin
        while done < len(times):
            window = self._open_window_at(int(times[done]))
            end = len(times)
            if window.stop is not None:
                end = int(np.searchsorted(times, window.stop))
            batch = times[done : min(end, done + self._buffers.times)]
            images = self._buffers.take(len(batch))
            last = int(batch[-1]) - origin
            self._open = None  # until it is passed over up to a time that is known
            self._passes.run(window, last + 1, batch - origin, images)
            self._open, self._done = window, last
            done += len(batch)
            made = Estimate(images.mean, images.variance, images.valid.view(bool))
            del images
            yield batch, made

    def _open_window_at(self, time: int) -> BandedWindow:
        """Return the open window that contains a time (us), not passed over beyond it."""
        at, window = time - self._partitioned.origin, self._open
        if window is not None and window.contains(time) and self._done <= at:
            return window
        begin = [b for b in self._begins if b.time <= time][-1]
        behind = window is None or time < window.begins or window.begins < begin.time
        if window is None or behind or window.contains(time):
            window = self._enter(begin)
        while not window.contains(time):
            window = self._enter(self._finish(window))
        return window

    def _finish(self, window: BandedWindow) -> WindowStart:
        """Pass over the rest of a window, and return the start of the next one."""
        assert window.stop is not None
        self._open = None
        self._passes.run(window, window.stop - self._partitioned.origin)
        begin = WindowStart(window.stop, window.context, self._passes.copy_states())
        if all(b.start != window.stop for b in self._begins):
            self._begins = sorted([*self._begins, begin], key=lambda b: b.time)
            # Keep the first one, the last one, and half of the others.
            if len(self._begins) > MAX_WINDOW_STARTS:
                self._begins = [self._begins[0], *self._begins[1:-1][::2], self._begins[-1]]
        return begin

    def _enter(self, begin: WindowStart) -> BandedWindow:
        """Divide a window's events among the bands, and put the bands at its start."""
        self._open = None  # so that two windows are never held at once
        window = cut_window(self._partitioned, begin.start, begin.context)
        if begin.states is None or begin.start is None:
            self._passes.init(window)
        else:
            self._passes.resume(window, begin.states, begin.start - self._partitioned.origin)
        self._open, self._done = window, -NEVER_US
        return window


def _make_segments(clock: FrameClock, recording: Recording, events: int) -> list[FrameSegment]:
    """Divide frames into segments of at most so many events, one frame at least.

    Args:
        clock: Times of the frames.
        recording: Events and frames.
        events: Most events of a segment of several frames.

    Returns:
        The segments, in order.
    """
    most = max(6, MAX_SEGMENT_FRAME_PIXELS // (recording.width * recording.height))
    rows = [recording.events.index(int(np.ceil(t)) + clock.origin) for t in clock.mid]
    rows.append(len(recording.events))
    found, begin = list[FrameSegment](), 0
    while begin < len(clock):
        end = int(np.searchsorted(rows, rows[begin] + events, "right")) - 1
        end = min(max(end, begin + 1), begin + most, len(clock))
        found.append(FrameSegment(begin, end))
        begin = end
    return found


class SmootherVideo(ImageSequence[P]):
    """Images of a smoother, made by a kernel; as `Video` in all else.

    Of every frame of a segment its message and the state before it are stored, of all other
    segments only how the message of later frames passes through them (`LINK_FIELDS`).

    Args:
        estimator: The smoother.
        recording: Events and frames.
        params: Parameters of the smoother.
        window_events: Most events of a segment of frames, if it has more than one frame.
        progress: Whether a bar is shown; None: if it takes long.
        factors: (2, pixels), of ON and OFF thresholds of single pixels.

    Raises:
        TranslationError: There is no kernel for the method.
    """

    def __init__(
        self,
        estimator: SmoothingMethod,
        recording: Recording,
        params: P,
        *,
        window_events: int = MAX_SEGMENT_EVENTS,
        progress: bool | None = None,
        factors: NDArray[np.floating] | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._method = estimator
        partitioned = PartitionedRecording(
            recording, EventTiming.of(params), False, window_events, factors
        )
        self._passes = SmootherPasses(partitioned, estimator, params, params.frame_delay)
        self._segments = _make_segments(self._passes.clock, recording, window_events)
        most = max(segment.end - segment.begin for segment in self._segments)
        self._memory = self._passes.memory(self._passes.layout.bands, most)
        self._buffers = BufferPool(partitioned.windows.pixels, self.dtype)
        self._field("given")[:] = self._passes.fractions
        self._context = partitioned.windows.initial()
        self._states: list[NDArray] = []  # before each segment
        self._later: list[NDArray] = []  # messages of all frames after each segment
        self._open: tuple[int, SegmentInputs] | None = None

    @property
    def dtype(self) -> np.dtype:
        return self._passes.dtype

    def _field(self, name: str) -> NDArray:
        return self._passes.field(self._memory, f"{name}.0")

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        passes, done, origin = self._passes, 0, self._passes.recording.origin
        frame = passes.frame_before(times - origin)
        begins = [segment.begin for segment in self._segments]
        while done < len(times):
            place = max(int(np.searchsorted(begins, frame[done], "right")) - 1, 0)
            last = place == len(begins) - 1
            end = len(times) if last else int(np.searchsorted(frame, self._segments[place].end))
            batch = times[done : min(end, done + self._buffers.times)]
            given, images = self._enter_segment(place), self._buffers.take(len(batch))
            image_times = passes.image_times(batch - origin, begins[place])
            self._over_bands(read_images, given, self._memory, image_times, images)
            made = Estimate(images.mean, images.variance, images.valid.view(bool))
            del images
            yield batch, made
            done += len(batch)

    def _over_bands(self, loop: Any, *args: Any) -> None:
        run_over_rows(loop, self._passes.layout.bands, *args)

    def _enter_segment(self, place: int) -> SegmentInputs:
        """Filter and smooth a segment, if it is not the open one; return its inputs."""
        if not self._later:
            self._pass_over_all_segments()
        if self._open is not None and self._open[0] == place:
            return self._open[1]
        self._open = None  # so that two are never held at once
        for name, values in zip(STATE_FIELDS, self._states[place], strict=True):
            self._field(name)[:] = values
        given = self._filter(place, False)
        self._smooth(place, given)
        return given

    def _smooth(self, place: int, given: SegmentInputs) -> None:
        """Smooth a segment whose frames are filtered."""
        for name, values in zip(LATER_FIELDS, self._later[place], strict=True):
            self._field(name)[:] = values
        self._over_bands(smooth_frames, given, self._memory)
        self._open = place, given

    def _filter(self, place: int, linked: bool) -> SegmentInputs:
        """Divide a segment's events among the bands, and filter its frames.

        Args:
            place: Number of the segment.
            linked: Whether to compose the maps of messages through it, too.

        Returns:
            The arguments of passes over the segment.
        """
        segment, passes = self._segments[place], self._passes
        bands, self._context = passes.partition(segment, self._context)
        given = passes.inputs(segment, bands, np.arange(passes.layout.bands))
        self._over_bands(filter_frames, given, self._memory, place == 0, linked)
        return given

    def _pass_over_all_segments(self) -> None:
        """Pass over all segments once, for the messages of later frames at each."""
        states, links, last = list[NDArray](), list[NDArray](), len(self._segments) - 1
        given = None

        def fields(names: tuple[str, ...]) -> NDArray:
            return np.stack([self._field(name) for name in names])

        with bar(
            total=last + 1, desc="look ahead", unit="segment", progress=self.progress
        ) as shown:
            for place in range(last + 1):
                states.append(fields(STATE_FIELDS))
                for k, name in enumerate(LINK_FIELDS):
                    self._field(name)[:] = k == 0
                given = self._filter(place, last > 0)
                links.append(fields(LINK_FIELDS))
                shown.update()
        assert given is not None
        later = [np.zeros_like(states[0])]
        while len(links) > 1:
            later.insert(0, self._method.apply_message_map(links.pop(), later[0]))
        self._states, self._later = states, later
        self._smooth(last, given)


def _is_single_precision() -> bool:
    """Return true in single precision, where kernels are the faster way to images."""
    return jnp.result_type(float) == np.float32


def make_kernel_video(
    kind: Callable[..., ImageSequence[P]],
    method: Any,
    recording: Recording,
    params: P,
    compiler: str | None,
    options: dict[str, Any],
) -> ImageSequence[P] | None:
    """Make the images of a method by a kernel.

    Args:
        kind: Class of the images.
        method: The method.
        recording: Events and frames.
        params: Parameters of the method.
        compiler: "numba" or "xla" if the user names one.
        options: Further options of the method's `estimate`.

    Returns:
        The images, or None where XLA compiles the method.

    Raises:
        InputError: The user names numba, and there is no kernel.
    """
    serves = _is_single_precision()
    return make_kernel(
        method.name, compiler, serves, lambda: kind(method, recording, params, **options)
    )


# What programs call by number; see `ImageKernel`.
_image_kernels: "weakref.WeakValueDictionary[int, ImageKernel]" = weakref.WeakValueDictionary()
_numbers = itertools.count()


class ImageKernel(abc.ABC):
    """Kernels of a method for the images of a recording at some times, and their derivatives.

    Those of one method, precision and size are equal: programs that JAX compiles for one serve all.
    The number, which programs get when they run, names the one that is meant.

    Args:
        method: The method.
        recording: Events and frames.
        times: Sorted times of the images, us.
        params: Parameters of the kind that images are made for.

    Raises:
        TranslationError: There are no kernels for the images and their derivatives.
    """

    passes_class: ClassVar[type]

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        self.recording = PartitionedRecording(
            recording, EventTiming.of(params), method.is_event_driven
        )
        self.method, self.dtype = method, self.recording.dtype
        self.pixels = recording.width * recording.height
        self.frame_delay = np.asarray(params.frame_delay)
        self._times = times - self.recording.origin
        self._arguments = method, recording, times, params
        self._turns = TurnLock(f"images of {recording.name}")
        self._passes: dict[DerivativeDirections, Any] = {}
        dead = params.names_without_gradient()
        numbers = [
            (leaf, k)
            for leaf, (path, value) in enumerate(jax.tree_util.tree_flatten_with_path(params)[0])
            if getattr(path[-1], "key", "homogeneous") not in {"homogeneous", *dead}
            for k in range(np.size(value))
        ]
        self.check(params, DerivativeDirections(tuple(numbers), ("mean", "variance")))
        self.number = next(_numbers)
        _image_kernels[self.number] = self

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._arguments

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ImageKernel) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple:
        return self.method, self.pixels, self.dtype.name

    def passes_with_derivatives(
        self,
        params: Any,
        directions: DerivativeDirections = DerivativeDirections(),  # noqa: B008
    ) -> Any:
        """Return the passes for some derivatives, which go on with these parameters.

        Args:
            params: Parameters of the method.
            directions: Numbers by which derivatives are taken.

        Returns:
            An object of `passes_class`.
        """
        if directions not in self._passes:
            self._passes[directions] = self.passes_class(
                self.recording, self.method, params, self.frame_delay, directions
            )
        self._passes[directions].use_params(params)
        return self._passes[directions]

    @abc.abstractmethod
    def check(self, params: Any, directions: DerivativeDirections) -> None:
        """Raise `TranslationError` unless there are kernels for images and derivatives.

        Args:
            params: Parameters of the method.
            directions: Numbers by which derivatives are taken.
        """

    @abc.abstractmethod
    def make(
        self, times_us: NDArray[np.int64], params: Any, directions: DerivativeDirections
    ) -> ImageBuffers:
        """Make images and their derivatives.

        Args:
            times_us: Sorted times, us since the recording's start.
            params: Parameters of the method.
            directions: Numbers by which derivatives are taken.

        Returns:
            The images and their derivatives.
        """

    def images(
        self, rows: NDArray, params: Any, directions: DerivativeDirections
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Make images at some of the times.

        Args:
            rows: Numbers of the times.
            params: Parameters of the method.
            directions: Numbers by which derivatives are taken.

        Returns:
            Mean, variance and validity (rows, pixels); derivatives (rows, pixels, images, lanes).
        """
        wanted, places = np.unique(rows, return_inverse=True)
        with self._turns:
            images = self.make(self._times[wanted], params, directions)
        made = images.mean, images.variance, images.valid.view(bool), images.derivatives
        if len(wanted) == len(rows) and (places == np.arange(len(rows))).all():
            return made
        mean, variance, valid, derivatives = (array[places] for array in made)
        return mean, variance, valid, derivatives


class FilterImages(ImageKernel):
    """Image kernel of a filter, which passes over the events."""

    passes_class = FilterPasses

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        super().__init__(method, recording, times, params)
        self._window = cut_window(self.recording, None, self.recording.windows.initial())

    def check(self, params: Any, directions: DerivativeDirections) -> None:
        kind = self.passes_with_derivatives(params).kind._replace(directions=directions)
        fixed = self.recording.fixed_inputs(self.frame_delay, self.method.has_covariance)
        check_filter_kernel(self.method, params, fixed, kind)

    def make(
        self, times_us: NDArray[np.int64], params: Any, directions: DerivativeDirections
    ) -> ImageBuffers:
        passes = self.passes_with_derivatives(params, directions)
        passes.init(self._window)
        images = passes.image_buffers(len(times_us), self.pixels)
        passes.run(self._window, int(times_us[-1]) + 1 if len(times_us) else 0, times_us, images)
        return images


class SmootherImages(ImageKernel):
    """Image kernel of a smoother, which passes over all frames of a recording, band by band."""

    passes_class = SmootherPasses

    def __init__(self, method: Any, recording: Recording, times: NDArray[np.int64], params: Any):
        super().__init__(method, recording, times, params)
        passes = self.passes_with_derivatives(params)
        self._whole = FrameSegment(0, len(passes.clock))
        self._bands, _ = passes.partition(self._whole, self.recording.windows.initial())

    def check(self, params: Any, directions: DerivativeDirections) -> None:
        SmootherPasses(self.recording, self.method, params, self.frame_delay, directions)

    def make(
        self, times_us: NDArray[np.int64], params: Any, directions: DerivativeDirections
    ) -> ImageBuffers:
        passes = self.passes_with_derivatives(params, directions)
        images, image_times = passes.image_buffers(len(times_us)), passes.image_times(times_us, 0)
        given = passes.inputs(self._whole, self._bands, np.zeros(passes.layout.bands, np.int64))
        run_over_rows(_smooth_bands, passes.layout.bands, passes, given, image_times, images)
        return images


def _smooth_bands(
    begin: int,
    end: int,
    passes: SmootherPasses,
    given: SegmentInputs,
    image_times: ImageTimes,
    images: ImageBuffers,
) -> None:
    """Make the images of some bands, one after another in the same memory.

    Args:
        begin: First band.
        end: Band after the last.
        passes: The smoother.
        given: Arguments of passes over all frames.
        image_times: Times of the images.
        images: Output.
    """
    try:
        memory = passes.spare.get_nowait()
    except queue.Empty:
        memory = passes.memory(1, len(given.line.mid))
    program = passes.kernel.program
    later = [n for leaf in LATER_FIELDS for n in (f"{leaf}.0", *program.derivatives(f"{leaf}.0"))]
    for band in range(begin, end):
        passes.field(memory, "given.0")[:] = passes.fractions[band]
        filter_frames(band, band + 1, given, memory, True, False)
        for name in later:
            passes.field(memory, name)[:] = 0
        smooth_frames(band, band + 1, given, memory)
        read_images(band, band + 1, given, memory, image_times, images)
    passes.spare.put(memory)


class KernelImages(eqx.Module):
    """Images made by kernels as a function of parameters; see `PreparedImages`."""

    number: Int[Numeric, ""]  # of the kernel
    rows: Int[Numeric, " times"]  # of the images that the kernel makes
    kernel: ImageKernel = eqx.field(static=True)

    @classmethod
    def of(cls, kernel: ImageKernel, times: int) -> "KernelImages":
        """Return the images at the first times of a kernel.

        Args:
            kernel: The kernel.
            times: Number of times.

        Returns:
            The function.
        """
        return _rebuild(kernel, np.arange(times))

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.kernel, np.asarray(self.rows))

    def __call__(self, params: Any, *, variance: bool = True) -> Estimate:
        outputs = ("mean", "variance") if variance else ("mean",)
        # No image depends on `point`: without a tangent of it the kernel carries none.
        params = eqx.tree_at(
            lambda p: p.homogeneous, params, jax.lax.stop_gradient(params.homogeneous)
        )
        mean, P, valid = _images((self.kernel, outputs), self.number, self.rows, params)
        return Estimate(mean, P, valid)

    def take(self, rows: NDArray) -> "KernelImages":
        """Return the images at some of the times."""
        return KernelImages(self.number, np.asarray(self.rows)[rows], self.kernel)


def _rebuild(kernel: ImageKernel, rows: NDArray) -> KernelImages:
    """Rebuild images that a pickle or copy holds from their kernel, which has a number of its own.

    Args:
        kernel: The kernel.
        rows: (times,) rows of the images among those of the kernel.

    Returns:
        The images.
    """
    return KernelImages(np.asarray(kernel.number, np.int32), rows, kernel)


def make_kernel_images(
    kind: type[ImageKernel],
    method: Any,
    recording: Recording,
    times: Times,
    params: Any,
    *,
    extrapolate: bool,
    compiler: str | None,
) -> KernelImages | None:
    """Prepare a method's images by kernels; see `Filter.prepare_images`.

    Args:
        kind: Class of the kernels.
        method: The method.
        recording: Events and frames.
        times: Times of the images, us.
        params: Parameters of the method.
        extrapolate: Whether times may lie outside the recording.
        compiler: "numba" or "xla" if the user names one.

    Returns:
        The images, or None where XLA compiles the method.

    Raises:
        InputError: The user names numba, and there is no kernel.
    """
    serves = _is_single_precision()
    backend = choose_backend(compiler, serves)
    if backend == "xla" or "rho_ref" in params.added_derivatives:
        return None
    if not programs_may_call(method.name, compiler):
        return None
    times = sorted_times(times)
    _, event_times = method.check_request(recording, times, params, extrapolate)

    def make() -> KernelImages:
        return KernelImages.of(kind(method, recording, event_times, params), len(times))

    return make_kernel(method.name, compiler, serves, make)


def _evaluate(
    tree: Any, directions: DerivativeDirections, number: Any, rows: Any, leaves: list[Any]
) -> tuple[NDArray, ...]:
    kernel = _image_kernels[int(number)]
    params = jax.tree.unflatten(tree, [np.asarray(leaf) for leaf in leaves])
    made = kernel.images(np.asarray(rows), params, directions)
    return made if directions.numbers else made[:3]


def _call_kernel(
    about: tuple[ImageKernel, tuple[str, ...]], number: Any, rows: Any, params: Any, numbers: tuple
) -> Any:
    """Call the kernel of a number from a compiled program.

    Args:
        about: A kernel of the same kind, and which of "mean" and "variance" have derivatives.
        number: () number of the kernel that is meant.
        rows: (times,) rows of the images.
        params: Parameters.
        numbers: Leaf and place of each number by which derivatives are taken; none: no derivatives.

    Returns:
        Mean, variance and valid, each (times, pixels), and with `numbers` the derivatives
        (times, pixels, images, lanes).
    """
    kernel, outputs = about
    leaves, tree = jax.tree.flatten(params)
    directions = DerivativeDirections(numbers, outputs if numbers else DerivativeDirections().of)
    shape = len(rows), kernel.pixels
    shapes = [jax.ShapeDtypeStruct(shape, kind) for kind in (kernel.dtype, kernel.dtype, bool)]
    if numbers:
        shape = *shape, len(outputs), directions.lanes
        shapes.append(jax.ShapeDtypeStruct(shape, kernel.dtype))
    evaluate = functools.partial(_evaluate, tree, directions)
    return jax.pure_callback(
        evaluate, tuple(shapes), number, rows, leaves, vmap_method="sequential"
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _images(about: Any, number: Any, rows: Any, params: Any) -> Any:
    return _call_kernel(about, number, rows, params, ())


@full_precision
def _images_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    """Compute images and their tangents: derivatives times the tangents of parameters, summed.

    Args:
        about: As in `_call_kernel`.
        primals: Number of the kernel, rows of images, and parameters.
        tangents: Tangents of these; only those of parameters count.

    Returns:
        Mean, variance and valid, each (times, pixels), and their tangents.
    """
    number, rows, params = primals
    numbers, changes = moving_numbers(tangents[2])
    if not numbers:
        images = _images(about, number, rows, params)
        return images, zero_tangents(images)
    mean, variance, valid, derivatives = _with_derivatives((*about, numbers), number, rows, params)
    change = jnp.concatenate([jnp.ravel(change) for change in changes]).astype(derivatives.dtype)
    change = jnp.pad(change, (0, derivatives.shape[-1] - change.size))
    moved = jnp.einsum("tpil,l->tpi", derivatives, change)
    d_variance = moved[..., 1] if moved.shape[-1] > 1 else jnp.zeros_like(variance)
    d_valid = np.zeros(valid.shape, jax.dtypes.float0)
    return (mean, variance, valid), (moved[..., 0], d_variance, d_valid)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_derivatives(about: Any, number: Any, rows: Any, params: Any) -> Any:
    kernel, outputs, numbers = about
    return _call_kernel((kernel, outputs), number, rows, params, numbers)


def _with_derivatives_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    """Refuse second derivatives, which kernels do not have.

    Args:
        about: As in `_call_kernel`, and `numbers`.
        primals: Number of the kernel, rows of images, and parameters.
        tangents: Tangents of these, all symbolic zeros.

    Returns:
        Images with derivatives, and tangents that are 0.

    Raises:
        InputError: A tangent is not zero.
    """
    name = about[0].method.name
    refuse_second_derivatives(name, tangents, 'prepare_images(..., compiler="xla")')
    made = _with_derivatives(about, *primals)
    return made, zero_tangents(made)


_images.defjvp(_images_jvp, symbolic_zeros=True)
_with_derivatives.defjvp(_with_derivatives_jvp, symbolic_zeros=True)
