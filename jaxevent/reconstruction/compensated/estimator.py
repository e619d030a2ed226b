"""The motion-compensated reconstruction: the method `mc` and its video.

Per-pixel estimators ignore that all pixels that see a scene point see the same brightness, and
interpolation between frames ignores the events. Here both are used. The smoother's images at
instants around a target time, frames among them, show the motion of the points visible at the
target (`trajectories`). Along these paths the images are fused (`fusion`).
"""

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent import codegen, threads
from jaxevent.cache import ByValue
from jaxevent.codegen import map_ahead
from jaxevent.deprecated import RenamedAttribute, renamed_names
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.precision import to_jax, with_own_settings
from jaxevent.reconstruction.compensated.event_noise import (
    IntervalEvents,
    NoiseParams,
    inflate_variances,
    measure_noise,
)
from jaxevent.reconstruction.compensated.exposures import (
    AdjacentExposures,
    AdjacentFrames,
    ExposureModel,
    FrameExposures,
    constrain_image,
    constrain_image_jax,
)
from jaxevent.reconstruction.compensated.fusion import (
    SOURCE_NAMES,
    FusedImage,
    after_weight,
    fuse,
)
from jaxevent.reconstruction.compensated.images import (
    BrightnessPrior,
    gaussian_blur,
    instant_smoother,
    smooth_part_at_target,
)
from jaxevent.reconstruction.compensated.instants import (
    merge_instant_times,
    pad_instant_count,
    pad_with_last,
)
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.robust_mean import (
    InstantLayout,
    make_layout,
    visibility,
)
from jaxevent.reconstruction.compensated.target_motion import (
    InitialMotion,
    InitialTarget,
    TrajectoryEstimate,
    TrajectoryEstimator,
    add_smooth_part,
    fuse_target,
    make_trajectory_estimator,
)
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    interpolate_paths_jax,
    path_positions,
    sample_bilinear,
    squared_reach,
    warp_images,
    warp_images_jax,
)
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.features import Features, Numeric, ReadOut
from jaxevent.reconstruction.frames import EventTiming, FrameImages
from jaxevent.reconstruction.video import FlowSource, ImageSequence
from jaxevent.reconstruction.windows import MAX_WINDOW_EVENTS, prepare
from jaxevent.recording import Recording, Times
from jaxevent.threads import synchronized

# Pixels of all targets that are held at once, each with a kilobyte while it is refined.
MAX_PIXELS_AT_ONCE = 1 << 19


class PreparedTarget(NamedTuple):
    """The instants of a target, and the motion of its points; of several, stacked.

    Attributes:
        rows: Indices of its instants among all.
        layout: Layout of its instants.
        events: Events of the intervals that its instants are in; `ends` are rows of its instants.
        noise_rows: Index of each instant's interval among these.
        noise_shape: See `event_noise.IntervalPositions.shape`.
        p: Trajectories of nodes, px.
        path_index: Flat index of the pixel whose path each pixel takes.
        exposures: Exposures of the frames next to the target.
        steady: 1 where frames keep their brightness, else 0.
        brightness: Brightness of the target beside that of the frames.
    """

    rows: Int[Numeric, "*times k"]
    layout: InstantLayout
    events: IntervalEvents
    noise_rows: Int[Numeric, "*times k"]
    noise_shape: Float[Numeric, "*times k"]
    p: Float[Numeric, "*times rows columns 4"]
    path_index: Int[Numeric, "*times h w"]
    exposures: AdjacentExposures
    steady: Float[Numeric, "*times"]
    brightness: BrightnessPrior


class PreparedTargets(ShortRepr):
    """Targets to read images of."""

    instants: ReadOut  # all instants of all targets, sorted
    targets: PreparedTarget  # stacked
    # Of exposures; None: images are not fitted to them.
    samples: int | None = eqx.field(static=True, default=None)

    def take(self, rows: NDArray) -> "PreparedTargets":
        """Choose some of the images, in the order of `rows`, and the instants that they need."""
        # By NumPy: JAX would compile a program for each shape.
        chosen = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], self.targets)
        used, places = np.unique(chosen.rows, return_inverse=True)
        instants = self.instants.take(used[pad_with_last(len(used), chosen.rows.size)])
        chosen = chosen._replace(rows=places.reshape(chosen.rows.shape).astype(np.int32))
        return PreparedTargets(instants, chosen, self.samples)


@jax.jit
def _warp_images(images: Array, times: PathTimes, paths: Array) -> Array:
    """Read images along trajectories.

    Args:
        images: (n, h, w, channels) images at n times.
        times: The n times.
        paths: (h, w, 4) paths of the target's points, px.

    Returns:
        (n, h, w, channels) values at the target's points.
    """
    Y, X = path_positions(paths, times)
    return jax.vmap(lambda one: sample_bilinear(one, Y, X), -1, -1)(images)


_visibility = jax.jit(visibility)


class Target(NamedTuple):
    """A target, with the motion of its points and its image."""

    motion: TrajectoryEstimate
    image: FusedImage

    @property
    def t(self) -> int:
        """Its time, us."""
        instants = self.motion.instants
        return int(instants.t[instants.target])


class CompensatedVideo(ImageSequence[Params]):
    """Images of `mc`: `image, variance, valid = video(times)`; also `flow` and `sources`.

    `valid` is also false where the standard deviation is above the parameter `vague`. Most of the
    large errors lie there: of points that the frames do not show, and of motion that was not found.
    The smoother's images are read as `Video` reads them, in constant memory. Images do not depend
    on which other images were requested.

    Args:
        estimator: The method.
        recording: The recording.
        params: Its parameters.
        window_events: Events per window of the smoother.
        motion: Flow that trajectories start from, for instance of a rigid scene
            (`jaxevent.egomotion.flow.RigidFlow`). Where it is not finite, motion is sought from
            nothing.
        refine: Whether images may correct `motion`.
        progress: Whether to show progress; None: on a terminal.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: Params,
        *,
        window_events: int = MAX_WINDOW_EVENTS,
        motion: FlowSource | None = None,
        refine: bool = True,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        delay = self._image_delay_us
        self._start = None if motion is None else InitialMotion(motion, delay, refine)
        self._window_events = window_events
        self._trajectories: TrajectoryEstimator | None = None
        self._latest: Target | None = None
        self._frames = FrameImages(recording, np.dtype(np.float32))
        self._response = self._frames.response()

    @property
    def dtype(self) -> np.dtype:
        """Type of the images."""
        return np.dtype(jnp.result_type(float))

    @property
    @synchronized
    def trajectories(self) -> TrajectoryEstimator:
        """The estimator of the targets' motion; made when first needed."""
        if self._trajectories is None:
            self._trajectories = make_trajectory_estimator(
                self.recording, self.params.beside_events(), self._window_events, self._start
            )
        return self._trajectories

    follow = RenamedAttribute("trajectories")

    @synchronized
    def _target(self, t: int) -> Target:
        (target,) = self._each([t])
        return target

    def _each(self, times: Sequence[int]) -> Iterator[Target]:
        """Yield targets at times (us), each of which is refined while the next ones are begun."""
        pixels = self.recording.width * self.recording.height
        # Some take ten times as long to begin as others, so that several wait meanwhile.
        most = max(min(2 * codegen.N_THREADS, len(times), MAX_PIXELS_AT_ONCE // pixels), 1)
        for target in map_ahead(lambda refine: refine(), map(self._begin, times), most):
            self._latest = target
            yield target

    def _begin(self, t: int) -> Callable[[], Target]:
        """Begin the target at a time (us); return the function that refines it, on any thread."""
        latest = self._latest
        if latest is not None and latest.t == t:
            return lambda: latest
        threads.check_not_forked()
        # Other threads may not ask for it while this one has its turn.
        trajectories = self.trajectories
        initial, brightness = trajectories.begin(t), trajectories.brightness.prior(t)
        return with_own_settings(lambda: self._refine(trajectories, initial, brightness))

    def _refine(
        self, trajectories: TrajectoryEstimator, initial: InitialTarget, brightness: BrightnessPrior
    ) -> Target:
        threads.check_not_forked()
        motion = trajectories.refine(initial)
        return Target(motion, self._fuse(trajectories.exposures, motion, brightness))

    def _fuse(
        self, exposures: FrameExposures, target: TrajectoryEstimate, brightness: BrightnessPrior
    ) -> FusedImage:
        """Fuse a target's images, and fit the result to the frames next to it."""
        fused = fuse_target(self.params, target)
        samples = exposures.samples
        if target.smooth is not None:
            fused = add_smooth_part(target, fused, brightness)
            # Frames of another brightness are no constraint, but for white.
            samples = None if samples is None else 1
        if samples is not None:
            instants = target.instants
            adjacent = exposures(int(instants.t[instants.target]), instants)
            low, high = int(adjacent.frame.min()), int(adjacent.frame.max()) + 1
            grey, intensity, _, gain = self._frames.read(slice(low, high), high - low)
            rows = adjacent.frame - low
            frames = AdjacentFrames(
                grey[rows], intensity[rows], self._response, gain[rows], self._frames.white
            )
            model = ExposureModel(adjacent, frames, target.paths)
            fused = constrain_image(self.params, fused, model, samples)
        if target.smooth is not None:
            return fused
        P = np.asarray(fused.P)
        return dataclasses.replace(fused, P=to_jax(P + P.dtype.type(brightness.variance)))

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        for n, (_, fused) in enumerate(self._each(times.tolist())):
            image = np.exp(np.asarray(fused.L)) - np.asarray(self.params.I0)
            valid = np.isfinite(image) & (np.sqrt(fused.P) < np.asarray(self.params.vague))
            whole = (image.astype(self.dtype), np.asarray(fused.P, self.dtype), valid)
            yield times[n : n + 1], tuple(v[None] for v in whole)

    def _targets(self, times: Times, extrapolate: bool) -> Iterator[Target]:
        return self._each(self._among_events(times, extrapolate).tolist())

    @synchronized
    def carry(
        self, images: NDArray[np.floating], at: NDArray[np.int64], to: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Carry images along trajectories to another time.

        Args:
            images: (n, H, W, channels) images.
            at: (n,) their times, us.
            to: The time to carry them to, us.

        Returns:
            The images (n, H, W, channels), and the visibility (n, H, W) of the points in each.
        """
        target, fused = self._target(to + self._image_delay_us)
        at = at + self._image_delay_us
        there = target.instants.path_times_at(at)
        order = np.argsort(at, kind="stable")
        L, V, clear = (part[np.argsort(order)] for part in self.trajectories.images(at[order]))
        self.trajectories.event_noise.inflate(at, V)
        M = np.asarray(fused.L, np.float32)
        if target.smooth is not None:
            L, M = L - gaussian_blur(L), M - gaussian_blur(M)
        warped = warp_images(L, V, clear, there, target.paths)
        carried = _warp_images(np.asarray(images, np.float32), there, target.paths)
        return np.asarray(carried), np.asarray(_visibility(self.params, M, warped))

    @synchronized
    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.float32]:
        """Return the optical flow of the points that are visible at some times.

        Args:
            times: (T,) times, as of images.
            extrapolate: Whether times may lie outside the data.

        Returns:
            (T, H, W, 2) flow along x and y, px/s.
        """
        step, found = self.trajectories.schedule.step, []
        for target, _ in self._targets(times, extrapolate):
            instants = target.instants
            flow = target.paths[..., :2] * np.float32(instants.relative_times_per_second(step))
            if instants.common is not None:
                flow = flow + instants.common.velocity(int(instants.t[instants.target]), step)
            found.append(flow)
        return np.stack(found)

    @synchronized
    def sources(self, times: Times, extrapolate: bool = False) -> dict[str, NDArray[np.float32]]:
        """Return the shares of the sources of each pixel.

        "before" and "after" are frames along trajectories, "events" instants without frame along
        trajectories, "smoothed" the pixel's own smoother and "blend" the frames blended in place.

        Args:
            times: (T,) times, as of images.
            extrapolate: Whether times may lie outside the data.

        Returns:
            Shares (T, H, W) by source, whose sum is 1. `visible_before` and `visible_after` are 1
            where the frame next to the target shows the point, 0 where it is hidden.
        """
        found = [target.image for target in self._targets(times, extrapolate)]
        shares = {name: [one.sources[k] for one in found] for k, name in enumerate(SOURCE_NAMES)}
        shares["visible_before"] = [one.visible[0] for one in found]
        shares["visible_after"] = [one.visible[1] for one in found]
        return {name: np.stack(images).astype(np.float32) for name, images in shares.items()}


@dataclasses.dataclass(frozen=True, repr=False)
class MotionCompensation(ImageEstimator[Params]):
    """The motion-compensated reconstruction.

    The motion that `prepare` finds is constant in derivatives of the images that `read` returns.
    """

    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "motion", "refine"}), kw_only=True
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
    ) -> tuple[Features, PreparedTargets]:
        """Prepare images for `run` and `read`; motion is estimated here.

        Args:
            recording: The recording.
            times: (T,) times of the images.
            params: Parameters with which motion is estimated; None: the defaults.
            extrapolate: Whether times may lie outside the data.

        Returns:
            Features of the recording, and the targets.

        Raises:
            InputError: If the recording has no frames, or times are missing or outside the data.
        """
        params, wanted = self.check_request(recording, times, params, extrapolate)
        if not len(wanted):
            raise InputError(f"{recording.name}: no times to prepare images for; give some")
        params = params.beside_events()
        trajectories = make_trajectory_estimator(recording, params, MAX_WINDOW_EVENTS)
        chosen = [trajectories.schedule(t) for t in wanted.tolist()]
        count = pad_instant_count(max(len(one) for one in chosen))
        every = merge_instant_times(chosen)
        features, instants = prepare(recording, every, EventTiming.of(params), filtering=False)
        factors = trajectories.images.factors
        if factors is not None:
            features, instants = features.scale_counts(factors), instants.scale_counts(factors)
        size = (recording.height, recording.width)
        own = np.arange(recording.height * recording.width, dtype=np.int32).reshape(size)
        noise = trajectories.event_noise
        between = [noise.locate(one.t).between_frames() for one in chosen]
        n_intervals, targets = max(len(one) for one in between), []
        for t, intervals in zip(wanted.tolist(), between, strict=True):
            target = trajectories(t)
            one, rows = target.instants, np.zeros(count, np.int32)
            rows[: len(one)] = np.searchsorted(every, one.t)
            positions = noise.locate(every[rows])
            intervals = np.resize(intervals, n_intervals)
            noise_rows = (positions.interval[:, None] == intervals).argmax(1).astype(np.int32)
            path_index = own if target.path_index is None else target.path_index
            targets.append(
                PreparedTarget(
                    rows,
                    make_layout(one, target.clear, count),
                    noise.events(intervals, one.t),
                    noise_rows,
                    positions.shape,
                    target.p,
                    path_index,
                    trajectories.exposures(t, one),
                    np.float32(target.smooth is None),
                    trajectories.brightness.prior(t),
                )
            )

        def stack(*leaves: Any) -> NDArray:
            return np.stack(leaves)

        out = PreparedTargets(
            instants, jax.tree.map(stack, *targets), trajectories.exposures.samples
        )
        return features, jax.device_put(out)

    def run(self, params: Params, features: Features, state: Any = None) -> tuple[Any, Any]:
        """Smooth each pixel; pure.

        Args:
            params: Parameters.
            features: Features of the recording, or of a window.
            state: State after the window before; None at the beginning.

        Returns:
            The trajectory that `read` reads, and the state at the end.
        """
        return instant_smoother.run(params, features, state)

    def read(self, params: Params, trajectory: Any, out: PreparedTargets) -> Estimate:
        """Read the prepared images; pure and differentiable.

        Args:
            params: Parameters.
            trajectory: Result of `run`.
            out: Targets of `prepare`, with the motion.

        Returns:
            Images (T, pixels), their variance (ln I)^2, and which pixels are valid.
        """
        L, V, clear = instant_smoother.read(params, trajectory, out.instants)
        frames = jax.tree.map(jnp.asarray, trajectory.frames)
        L, V, clear = (v.reshape(len(v), -1, frames.width) for v in (L, V, clear.astype(L.dtype)))
        noise_params = NoiseParams.of(params, jnp.asarray)

        @jax.checkpoint
        def one(target: PreparedTarget) -> tuple[Array, Array]:
            rows, layout, events = target.rows, target.layout, target.events
            shape, steady = target.noise_shape, target.steady
            smooth = (1 - steady) * gaussian_blur(L[rows])
            at_frames = tuple(values[rows[events.ends]] for values in (L, V, clear))
            noise = measure_noise(noise_params, at_frames, events.counts, events.seconds)
            noise = jax.tree.map(lambda values: values[target.noise_rows], noise)
            variances = inflate_variances(V[rows], noise, shape)
            images = (L[rows] - smooth, variances, clear[rows])
            at_frame = shape[layout.target] == 0
            factor = jnp.where(at_frame, 1, noise.factor[layout.target])
            path_index = target.path_index
            paths = interpolate_paths_jax(target.p, *path_index.shape)
            paths = paths.reshape(-1, 4)[path_index]
            warped = warp_images_jax(*images, layout.path_times, paths)
            reach = squared_reach(paths, layout.common)
            fused = fuse(params, *images[:2], warped, layout, reach, noise=factor)
            weight = after_weight(layout)
            base, variance = smooth_part_at_target(smooth, layout, weight, paths, target.brightness)
            base, added = (1 - steady) * base, (1 - steady) * variance
            fused = dataclasses.replace(fused, L=fused.L + base, P=fused.P + added)
            if out.samples is not None:
                exposures = target.exposures
                at = exposures.frame
                adjacent = AdjacentFrames(
                    frames.grey[at],
                    frames.intensity[at],
                    frames.response,
                    frames.gain[at],
                    frames.white,
                )
                # Frames of another brightness are no constraint, but for white.
                exposures = exposures._replace(half=exposures.half * steady)
                model = ExposureModel(exposures, adjacent, paths)
                fused = constrain_image_jax(params, fused, model, out.samples)
            return fused.L, fused.P + steady * variance

        found, P = jax.lax.map(one, out.targets)
        image = (jnp.exp(found) - params.I0).reshape(len(found), -1)
        P = P.reshape(image.shape)
        return Estimate(image, P, jnp.isfinite(image) & (jnp.sqrt(P) < params.vague))

    def estimate(
        self, recording: Recording, params: Params | None = None, **options: Any
    ) -> CompensatedVideo:
        """Make the video of a recording: `image, variance, valid = mc.estimate(recording)(times)`.

        Args:
            recording: The recording.
            params: Parameters; None: those of `usual_params`.
            **options: Options of `CompensatedVideo`.

        Returns:
            The video.

        Raises:
            InputError: If the recording has no frames, or an option is not known.
        """
        self.refuse_unknown({name: v for name, v in options.items() if name != "progress"})
        self.check_options(**options)
        chosen = self.usual_params(recording) if params is None else params
        return CompensatedVideo(self, recording, chosen, **options)


mc = MotionCompensation(
    "mc",
    Params,
    needs_frames=True,
    about="The motion-compensated reconstruction. It estimates the motion of the scene's points "
    "from frames and events together, and fuses both along their paths. Where that fails it falls "
    "back on the smoother of each pixel and on the frames.",
)
Params.validator = mc

__getattr__ = renamed_names(__name__)
