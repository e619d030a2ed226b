"""Motion of a target's points, and its image fused along their paths.

Motion is sought from nothing at anchors, whose times depend on the recording alone, and carried
from there to targets (`TrajectoryEstimator`). `fuse_target` makes the image of one.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from jaxevent.cache import cache_method
from jaxevent.errors import InputError
from jaxevent.reconstruction.compensated.common_motion import estimate_common_motion
from jaxevent.reconstruction.compensated.event_noise import EventNoise
from jaxevent.reconstruction.compensated.exposures import FrameExposures
from jaxevent.reconstruction.compensated.fusion import (
    FusedImage,
    after_weight,
    fuse_candidates,
    fusion_features,
    fusion_inputs,
)
from jaxevent.reconstruction.compensated.images import (
    BrightnessPrior,
    FrameBrightness,
    InstantImages,
    are_equally_bright,
    gaussian_blur,
    smooth_part_at_target,
)
from jaxevent.reconstruction.compensated.instants import (
    TIME_CLOCK,
    InstantSchedule,
    TargetInstants,
    fit_motion_clock,
    measure_image_speed,
)
from jaxevent.reconstruction.compensated.normal_equations import (
    CostParams,
    PackedImages,
)
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.robust_mean import (
    InstantLayout,
    RobustMean,
    make_layout,
    robust_mean,
)
from jaxevent.reconstruction.compensated.thresholds import learn_thresholds
from jaxevent.reconstruction.compensated.trajectories import (
    PATH_SEARCHES,
    ImagePyramid,
    NodeTrajectories,
    advect_nodes,
    borrow_paths,
    change_clock,
    choose_trajectories,
    estimate_trajectories,
    fit_path,
    gauss_newton_step,
    node_shape,
    pack_images,
    plan_stages,
    robust_cost,
    select_paths,
)
from jaxevent.reconstruction.compensated.warp import (
    PathTimes,
    WarpedImages,
    interpolate_paths,
    squared_reach,
    warp_images,
)
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.frames import EventTiming, FrameClock, time_span
from jaxevent.reconstruction.video import FlowSource
from jaxevent.recording import Recording

N_SPEED_PROBES = 6  # instants at which the speed of the image is measured
PYRAMID_VARIANCE_FACTOR = 0.35  # from one resolution to half of it
ANCHOR_STEPS = 8  # steps of the schedule between anchors
# 1 - (trust in events)^4, up to which frames alone are not asked: images would seldom choose them.
MIN_DOUBT = 0.1
N_CACHED_ANCHORS = 4
MIN_CLOCK_COST = 1e-12  # so that its logarithm exists
# By which the frames' cost must fall, so that common motion is used.
MAX_COMMON_COST = 0.7
N_ANCHOR_STEPS = 2  # at half resolution, on each clock
FUSED_VARIANCE_FACTOR = 3.0  # on the variance of the fused image that motion is refined with


def make_instant_schedule(
    recording: Recording, params: Params, images: InstantImages, use_motion_clock: bool = True
) -> InstantSchedule:
    """Make the schedule of a recording, by the speed of its image.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        images: Images at instants.
        use_motion_clock: Whether instants are on a clock that goes as fast as the scene moves.

    Returns:
        The schedule.

    Raises:
        InputError: If images are not finite with these parameters.
    """
    clock = FrameClock.of(recording, EventTiming.of(params))
    # The first whole microsecond at which a frame is the one before.
    frames = np.ceil(clock.mid).astype(np.int64) + clock.origin
    first, last = time_span(recording, params.clock_offset)
    lag = int(np.median(np.diff(frames)) / 4) if len(frames) > 1 else 5000
    inner = np.linspace(0, max(last - lag - first, 0), N_SPEED_PROBES + 2)[1:-1]

    speed = measure_image_speed(images.log_images, first + inner.astype(np.int64), max(lag, 400))
    if not math.isfinite(speed):
        raise InputError(
            f"{recording.name}: with these parameters images at single instants are not finite; "
            "choose some nearer the defaults"
        )
    motion_clock = (
        fit_motion_clock(recording, (first, last), 4 * lag) if use_motion_clock else TIME_CLOCK
    )
    return InstantSchedule(frames, (first, last), speed, motion_clock)


class NodeMotion(NamedTuple):
    """The motion of a target's points."""

    instants: TargetInstants
    p: NDArray[np.float32]  # (rows, columns, 4), of nodes, px at s = 1

    def carry(self, instants: TargetInstants) -> NDArray[np.float32]:
        """Carry the motion to another target, on the clock of that one."""
        there, p = self
        now = there.with_clock(instants.clock)
        if there.clock.event_share != instants.clock.event_share:
            p = change_clock(p, there.s, now.s)
        at = now.path_times_at(instants.t[[instants.target]])
        p = advect_nodes(p, float(at.s[0]), instants.unit / now.unit, at.common[0])
        if there.common is not instants.common:
            own, other = (
                one.path_times.common
                for one in (instants, instants.with_common_motion(there.common))
            )
            p = p + fit_path(instants.s, other - own)
        return p


class TwoClockMotion(NamedTuple):
    """The motion of a target's points on two clocks, and on which of them frames agree better.

    Attributes:
        on_clock: Motion on the schedule's clock.
        on_time: Motion on the clock of time.
        evidence: Log of the cost on time over the cost on the schedule's clock.
    """

    on_clock: NodeMotion
    on_time: NodeMotion
    evidence: float

    def on(self, timed: bool) -> NodeMotion:
        """Return the motion on the clock of time, or on the schedule's."""
        return self.on_time if timed else self.on_clock


class Anchor(NamedTuple):
    """A target whose motion was estimated without an initial value, and its image."""

    motion: NodeMotion  # at full resolution
    L: NDArray[np.float32]  # (h, w), ln I
    P: NDArray[np.float32]  # (h, w), its variance
    is_steady: bool  # no smooth part was subtracted from L


class TrajectoryEstimate(NamedTuple):
    """A target, the images at its instants, and the motion of its points.

    Attributes:
        instants: The instants.
        L: (K, h, w) log intensity.
        V: (K, h, w) its variance, (ln I)^2.
        clear: (K, h, w) 1 where a frame shows the pixel unclipped, else 0.
        p: (rows, columns, 4) trajectories of nodes, px at s = 1.
        path_index: (h, w), as of `trajectories.select_paths`; None: each pixel takes its own path.
        smooth: (K, h, w) smooth part that was subtracted from `L`; None: nothing was.
        noise: (h, w) or (), as of `fusion.FusionInputs`.
    """

    instants: TargetInstants
    L: NDArray[np.float32]
    V: NDArray[np.float32]
    clear: NDArray[np.float32]
    p: NDArray[np.float32]
    path_index: NDArray[np.int32] | None = None
    smooth: NDArray[np.float32] | None = None
    noise: NDArray[np.float32] | float = 1.0

    @property
    def paths(self) -> NDArray[np.float32]:
        """Paths of all pixels, (h, w, 4), px."""
        paths = interpolate_paths(self.p, self.L.shape[1:])
        return paths if self.path_index is None else paths.reshape(-1, 4)[self.path_index]


class InstantStack(NamedTuple):
    """Images at the K instants of a target, each (K, h, w)."""

    L: NDArray[np.float32]  # log intensity
    V: NDArray[np.float32]  # its variance
    clear: NDArray[np.float32]  # 1 where a frame shows the pixel unclipped
    smooth: NDArray[np.float32] | None  # subtracted from L; None: nothing is


class InitialTarget(NamedTuple):
    """A target, and the motion that its own is refined from."""

    instants: TargetInstants
    images: InstantStack
    noise: NDArray[np.float32] | float  # (h, w), as of `fusion.FusionInputs`
    # (rows, columns, 4), trajectories of nodes known beforehand, px; None: those of anchors.
    known: NDArray[np.float32] | None
    anchor: Anchor | None
    beside: NodeMotion | None  # of the anchor on the other side, at half resolution


@dataclasses.dataclass(frozen=True)
class InitialMotion:
    """Motion that is known beforehand.

    Attributes:
        motion: The flow.
        delay_us: Time added to that of an image to be beside the events that show it.
        refine: Whether images may correct it.
    """

    motion: FlowSource
    delay_us: int = 0
    refine: bool = True

    def __call__(self, t: int, late: int, unit: float) -> NDArray[np.float32] | None:
        """Return the trajectories of a target.

        The acceleration is that of points: the difference of flow before and after, at the places
        to which they go.

        Args:
            t: Time of the target, us.
            late: Time before and after it at which flow is read for the acceleration, us.
            unit: What s = 1 stands for, s.

        Returns:
            (rows, columns, 4) trajectories of nodes, px; None where the flow is not known.
        """
        times = t - self.delay_us + np.array([-late, 0, late])
        before, now, after = np.asarray(self.motion.flow(times, extrapolate=True), float)
        if not np.isfinite([before, now, after]).all():
            return None
        h, w = now.shape[:2]
        y, x = np.mgrid[:h, :w].astype(float)
        dt = late * 1e-6

        def there(field: NDArray, sign: int) -> NDArray:
            at = [y + sign * dt * now[..., 1], x + sign * dt * now[..., 0]]
            parts = [map_coordinates(field[..., c], at, order=1, mode="nearest") for c in (0, 1)]
            return np.stack(parts, -1)

        change = (there(after, 1) - there(before, -1)) / (2 * dt)
        p = np.concatenate([now * unit, change / 2 * unit**2], -1)
        rows, columns = node_shape(h, w, 0)
        padded = np.pad(p, [(0, 2 * rows - h), (0, 2 * columns - w), (0, 0)], mode="edge")
        return padded.reshape(rows, 2, columns, 2, 4).mean((1, 3)).astype(np.float32)


class TrajectoryEstimator:
    """Estimates the motion of a recording's targets: `estimate = trajectories(t)`, t in us.

    Motion is sought from nothing, improved and refined with the image that it gives at anchors
    only, whose times depend on the recording alone. A target starts from the motion and the image
    of the anchor next to it, and takes one more step. So the images of a video cost less than
    single ones, and none depends on which others were requested. Where motion is known beforehand
    each target is its own anchor.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        images: Images at instants.
        start: Motion that is known beforehand, or None.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params,
        images: InstantImages,
        start: InitialMotion | None = None,
    ):
        self.params, self.images, self.start = params, images, start
        self.schedule = make_instant_schedule(
            recording, params, images, use_motion_clock=start is None
        )
        self.exposures = FrameExposures(recording, params, self.schedule.speed)
        self.brightness = FrameBrightness(recording, self.schedule.frames, float(params.I0))
        self.event_noise = EventNoise(recording, params, images, self.schedule.frames)
        # By their times.
        self._anchor = cache_method(self._make_anchor, N_CACHED_ANCHORS)
        self._anchor_motion = cache_method(self._estimate_anchor_motion, N_CACHED_ANCHORS)
        self._frame_motion = cache_method(self._estimate_frame_motion, N_CACHED_ANCHORS)
        self._caution, self._cost = float(params.caution), CostParams.of(params)
        self._latest: tuple[NDArray[np.int64], Any] | None = None  # times, and images
        self._anchors: list[int] = []  # times of those whose images were read last, us

    def _images(self, instants: TargetInstants) -> InstantStack:
        """Return the images at instants.

        The latest ones are remembered: motion that was sought is next refined on them.
        """
        if self._latest is None or not np.array_equal(self._latest[0], instants.t):
            self._latest = None  # so that two are never held at once
            self._latest = instants.t, self._read_images(instants)
        return self._latest[1]

    def _read_images(self, instants: TargetInstants) -> InstantStack:
        L, V, clear = self.images(instants.t)
        self.event_noise.inflate(instants.t, V)
        first, last = int(instants.t[0]), int(instants.t[-1])
        if self.brightness.is_steady(first, last) and are_equally_bright(L):
            return InstantStack(L, V, clear, None)
        smooth = gaussian_blur(L)
        return InstantStack(L - smooth, V, clear, smooth)

    def _noise(self, t: int) -> NDArray[np.float32] | float:
        """Return the factor (h, w) on the variance of the events' images at a target (us)."""
        interval, shape = self.event_noise.locate(np.array([t]))
        return self.event_noise(int(interval[0])).factor if shape[0] > 0 else 1.0

    def _raise_variance(self, V: NDArray, clear: NDArray) -> NDArray[np.float32]:
        """Raise variances for the estimation of motion, except of pixels that frames show.

        Args:
            V: (K, h, w) variances, (ln I)^2.
            clear: (K, h, w), above 0 where a frame shows the pixel unclipped.

        Returns:
            (K, h, w), (ln I)^2.
        """
        cautious = V * np.float32(self._caution)
        for k in np.flatnonzero(clear.max((1, 2)) > 0):
            np.copyto(cautious[k], V[k], where=clear[k] > 0)
        return cautious

    def _anchor_times(self, t: int) -> list[int]:
        """Return the times (us) of the anchors next to a time, at most two, the nearest first.

        Anchors are evenly spaced between two frames, and between a frame and the end of the data.
        """
        frames, (first, last) = self.schedule.frames, self.schedule.span
        after = int(np.searchsorted(frames, t, "right"))
        begin = int(frames[after - 1]) if after > 0 else first
        end = int(frames[after]) if after < len(frames) else last
        count = max(round((end - begin) / (ANCHOR_STEPS * self.schedule.step)), 1)
        place = (t - begin) * count // max(end - begin, 1)
        place = min(max(place, 0), count - 1)
        times = [begin + (2 * n + 1) * (end - begin) // (2 * count) for n in range(count)]
        beside = place + (1 if t >= times[place] else -1)
        return [times[n] for n in (place, beside) if 0 <= n < count]

    def _estimate_anchor_motion(self, at: int) -> TwoClockMotion:
        """Estimate a target's motion without an initial value, at half resolution."""
        instants = self.schedule(at)
        L, V, clear, _ = self._images(instants)
        pyramid = ImagePyramid(L, self._raise_variance(V, clear), PYRAMID_VARIANCE_FACTOR)
        p = self._estimate_trajectories(pyramid, instants.path_times, instants.first_horizon)
        doubt = 1 - self.event_noise.trust(at) ** 4
        other = self._motion_between_frames(at) if doubt > MIN_DOUBT else None
        if other is not None:
            images = PackedImages.of(pyramid[1], instants.path_times.at_level(1))
            several = p, other.carry(instants)
            p = choose_trajectories(images, several, self._cost, (1.0, doubt))
        found = self._improve(pyramid[1], NodeMotion(instants, p))
        beside = self._estimate_beside_common_motion(pyramid, instants)
        if beside is None:
            return found
        costs = [
            min(self._frame_cost(pyramid[1], one.on(timed)) for timed in (False, True))
            for one in (found, beside)
        ]
        return beside if costs[1] < MAX_COMMON_COST * costs[0] else found

    def _estimate_beside_common_motion(
        self, pyramid: ImagePyramid, instants: TargetInstants
    ) -> TwoClockMotion | None:
        """Estimate motion beside that of all points; None where trajectories explain all of it."""
        common = estimate_common_motion(pyramid, instants.t, instants.s, self._cost)
        if common is None:
            return None
        instants = instants.with_common_motion(common)
        p = self._estimate_trajectories(pyramid, instants.path_times, instants.first_horizon)
        return self._improve(pyramid[1], NodeMotion(instants, p))

    def _frame_cost(self, pixels: NDArray[np.float32], motion: NodeMotion) -> float:
        """Return the mean squared difference of frames along motion at half resolution.

        Images from events have the faults of their clock and course, so that they do not judge it.

        Args:
            pixels: (K, h / 2, w / 2, 4) packed images at half resolution.
            motion: Motion of nodes at half resolution.

        Returns:
            The cost; of images at all instants where at most two are of frames.
        """
        instants, p = motion
        judges = np.isin(instants.t, self.schedule.frames)
        if judges.sum() <= 2:  # agree on any clock
            judges[:] = True
        times = instants.path_times.take(judges).at_level(1)
        return robust_cost(PackedImages.of(pixels[judges], times), p, self._cost)

    def _motion_between_frames(self, t: int) -> NodeMotion | None:
        """Return the motion halfway between two frames by frames alone, at half resolution."""
        frames = self.schedule.frames
        after = int(np.searchsorted(frames, t, "right"))
        if not 0 < after < len(frames):
            return None
        return self._frame_motion(int(frames[after - 1] + frames[after]) // 2)

    def _estimate_frame_motion(self, at: int) -> NodeMotion:
        """Estimate a target's motion at a time (us) without an initial value, by frames alone."""
        instants = self.schedule(at)
        L, V, _, _ = self._images(instants)
        framed = np.isin(instants.t, self.schedule.frames)
        frames = ImagePyramid(L[framed], V[framed], PYRAMID_VARIANCE_FACTOR)
        nearest = float(np.abs(instants.s[[instants.before, instants.after]]).max())
        return NodeMotion(
            instants, self._estimate_trajectories(frames, instants.path_times.take(framed), nearest)
        )

    def _estimate_trajectories(
        self, pyramid: ImagePyramid, times: PathTimes, horizon: float
    ) -> NDArray[np.float32]:
        """Estimate trajectories without initial values, up to half resolution.

        Args:
            pyramid: Images at the instants.
            times: Times of the instants, with common displacements in px at full resolution.
            horizon: Distance of the instants that are used first, in units of `times.s`.

        Returns:
            (rows, columns, 4) trajectories of nodes at half resolution, in its pixels.
        """
        plan = plan_stages(times.s, horizon)
        motion = estimate_trajectories(pyramid, times, plan, self._cost)
        return motion.at_level(1, self.images.image_shape).p

    def _make_anchor(self, at: int, timed: bool) -> Anchor:
        """Find the motion of a target on one of its clocks, and fuse its image.

        Args:
            at: Time of the target, us.
            timed: Whether on the clock of time, else on the schedule's.

        Returns:
            The target.
        """
        motion = self._anchor_motion(at).on(timed)
        return self._refine(motion, self._images(motion.instants), self._noise(at))

    def _refine(
        self, motion: NodeMotion, images: InstantStack, noise: NDArray[np.float32] | float
    ) -> Anchor:
        """Refine motion at half resolution with the image that it gives.

        Args:
            motion: Motion of nodes at half resolution.
            images: Images at its instants.
            noise: (h, w) or (), as of `fusion.FusionInputs`.

        Returns:
            The target with the motion at full resolution, and its fused image.
        """
        (instants, p), (L, V, clear, smooth) = motion, images
        p = NodeTrajectories(p, 1).at_level(0, self.images.image_shape).p
        estimate = TrajectoryEstimate(instants, L, V, clear, p, noise=noise)
        fused = fuse_target(self.params, estimate)
        image, P = np.asarray(fused.L, np.float32), np.asarray(fused.P, np.float32)
        packed = self._pack(estimate, image, P)
        p = borrow_paths(packed, gauss_newton_step(packed, p, self._cost), self._cost)
        return Anchor(NodeMotion(instants, p), image, P, smooth is None)

    def _pack(self, target: TrajectoryEstimate, image: NDArray, P: NDArray) -> PackedImages:
        """Pack the images of a target, its own replaced by one with less noise.

        Args:
            target: The target.
            image: (h, w) log intensity to put in place of its own.
            P: (h, w) variance of that, (ln I)^2.

        Returns:
            The images at full resolution.
        """
        own, V = target.instants.target, self._raise_variance(target.V, target.clear)
        pixels = pack_images(target.L, V)
        V = FUSED_VARIANCE_FACTOR * P + self._cost.floor
        pixels[own] = pack_images(image[None], V[None])[0]
        return PackedImages.of(pixels, target.instants.path_times)

    def _improve(self, pixels: NDArray[np.float32], motion: NodeMotion) -> TwoClockMotion:
        """Take a few steps at half resolution on both clocks, and compare how frames agree.

        Args:
            pixels: (K, h / 2, w / 2, 4) packed images at half resolution.
            motion: Motion of nodes at half resolution.

        Returns:
            The motion on both clocks; twice the same where both clocks are one.
        """
        instants, p = motion

        def improved(clock: TargetInstants, p: NDArray[np.float32]) -> NodeMotion:
            images = PackedImages.of(pixels, clock.path_times.at_level(1))
            for _ in range(N_ANCHOR_STEPS):
                p = gauss_newton_step(images, p, self._cost)
            return NodeMotion(clock, p)

        found = improved(instants, p)
        if not instants.clock.event_share:
            return TwoClockMotion(found, found, 0.0)
        timed = instants.with_clock(TIME_CLOCK)
        other = improved(timed, change_clock(p, instants.s, timed.s))
        costs = [max(self._frame_cost(pixels, one), MIN_CLOCK_COST) for one in (other, found)]
        evidence = math.log(costs[0] / costs[1])
        return TwoClockMotion(found, other, evidence)

    def _prefers_time(self, t: int, anchors: list[int]) -> bool:
        """Return whether a target is put on the clock of time.

        The nearest anchor decides, and halfway between two both do: a step of the schedule away
        from there the weight of the farther one is 0.
        Args:
            t: Time of the target, us.
            anchors: Times of the anchors next to it, us, the nearest first.

        Returns:
            Whether it is; else it is on the schedule's clock.
        """
        evidence = [self._anchor_motion(at).evidence for at in anchors]
        if len(anchors) == 1:
            return evidence[0] <= 0
        nearest, other = (abs(at - t) for at in anchors)
        weight = min((1 + (other - nearest) / self.schedule.step) / 2, 1.0)
        return weight * evidence[0] + (1 - weight) * evidence[1] <= 0

    def __call__(self, t: int) -> TrajectoryEstimate:
        """Estimate the motion of the target at a time (us)."""
        return self.refine(self.begin(t))

    def begin(self, t: int) -> InitialTarget:
        """Find all that the motion of the target at a time (us) is refined from."""
        instants = self.schedule(t)
        known = None if self.start is None else self.start(t, self.schedule.step, instants.unit)
        if known is not None:
            return InitialTarget(
                instants, self._images(instants), self._noise(t), known, None, None
            )
        nearest, *others = anchors = self._anchor_times(t)
        new = [self.schedule(at).t for at in anchors if at not in self._anchors]
        self.images.cache_images(np.unique(np.concatenate([instants.t, *new])))
        self._anchors = anchors
        images, noise = self._images(instants), self._noise(t)
        timed = self._prefers_time(t, anchors)
        anchor = self._anchor(nearest, timed)
        beside = self._anchor_motion(others[0]).on(timed) if others else None
        instants = instants.with_common_motion(anchor.motion.instants.common)
        if timed:
            instants = instants.with_clock(TIME_CLOCK)
        return InitialTarget(instants, images, noise, None, anchor, beside)

    def refine(self, initial: InitialTarget) -> TrajectoryEstimate:
        """Refine the motion of a target; threads may do so for several at once."""
        instants, images, noise, known, anchor, beside = initial
        (L, V, clear, smooth), size = images, self.images.image_shape
        if known is not None:
            if self.start is None or not self.start.refine:
                return TrajectoryEstimate(instants, L, V, clear, known, smooth=smooth, noise=noise)
            pyramid = ImagePyramid(L, self._raise_variance(V, clear), PYRAMID_VARIANCE_FACTOR)
            half = NodeTrajectories(known, 0).at_level(1, size).p
            found = self._improve(pyramid[1], NodeMotion(instants, half))
            timed = found.evidence <= 0
            anchor = self._refine(found.on(timed), images, noise)
            if timed:
                instants = instants.with_clock(TIME_CLOCK)
        assert anchor is not None
        p = anchor.motion.carry(instants)
        target = TrajectoryEstimate(instants, L, V, clear, p, smooth=smooth, noise=noise)
        packed = self._pack(target, *self._carry_image(anchor, target))
        if beside is not None:
            p = self._choose(packed, p, beside.carry(instants))
        p = gauss_newton_step(packed, p, self._cost)
        # Nodes of the anchor have taken paths from farther away.
        path_index = select_paths(packed, interpolate_paths(p, size), self._cost, PATH_SEARCHES[1:])
        return target._replace(p=p, path_index=path_index)

    def _choose(
        self, images: PackedImages, p: NDArray[np.float32], other: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Choose between two trajectories of each node, by images at half resolution.

        Args:
            images: Images at full resolution.
            p: (rows, columns, 4) trajectories of nodes at full resolution, px.
            other: (rows, columns, 4) trajectories of nodes at half resolution, in its pixels.

        Returns:
            (rows, columns, 4) trajectories of nodes at full resolution, px.
        """
        size = self.images.image_shape
        L, V = images.pixels[..., 0], images.pixels[..., 1]
        pyramid = ImagePyramid(L, V, PYRAMID_VARIANCE_FACTOR)
        half = PackedImages.of(pyramid[1], images.times.at_level(1))
        own = NodeTrajectories(p, 0).at_level(1, size).p
        change = choose_trajectories(half, (own, other), self._cost, (1.0, 1.0)) - own
        return p + NodeTrajectories(change, 1).at_level(0, size).p

    def _carry_image(
        self, anchor: Anchor, target: TrajectoryEstimate
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Carry the image of an anchor to a target.

        Args:
            anchor: The anchor.
            target: The target, whose own image stands in where the anchor does not see a point.

        Returns:
            Log intensity and its variance, each (h, w).
        """
        if anchor.is_steady != (target.smooth is None):
            fused = fuse_target(self.params, target)
            return np.asarray(fused.L, np.float32), np.asarray(fused.P, np.float32)
        there, here = anchor.motion.instants, target.instants
        at = here.path_times_at(there.t[[there.target]])
        if not at.s[0]:
            return anchor.L, anchor.P
        L, P = anchor.L[None], anchor.P[None]
        warped = warp_images(L, P, np.zeros_like(L), at, target.paths)
        inside = warped.inside[0] > 0
        own = here.target
        return (
            np.where(inside, warped.L[0], target.L[own]),
            np.where(inside, warped.V[0], self._caution * target.V[own]),
        )


@jax.jit
def _fuse(
    params: Params,
    mean: RobustMean,
    images: tuple[Numeric, Numeric, WarpedImages, InstantLayout],
    paths: Numeric,
    noise: Numeric | float,
) -> FusedImage:
    """Fuse the images that `fuse_target` hands over.

    Args:
        params: Parameters of `mc`.
        mean: Robust mean along the trajectories.
        images: L and V of these images, each (k, h, w), the images warped, and their instants.
        paths: (h, w, 4) paths of all pixels, px.
        noise: (h, w) or (), as of `fusion.FusionInputs`.

    Returns:
        The image.
    """
    reach = squared_reach(paths, images[3].common)
    compared = fusion_inputs(*images, reach, noise=noise)
    return fuse_candidates(params, fusion_features(mean, compared))


def fuse_target(params: Params, target: TrajectoryEstimate) -> FusedImage:
    """Fuse the images at a target's instants along trajectories.

    Args:
        params: Parameters of `mc`.
        target: The target.

    Returns:
        The image, without the smooth part that was subtracted.
    """
    instants, L, V, clear, *_ = target
    paths = target.paths
    warped = warp_images(L, V, np.asarray(clear, np.float32), instants.path_times, paths)
    layout = make_layout(instants, clear, len(instants))
    mean = robust_mean(params, L, warped, layout)
    # The images that it is compared with are few, and are all that is handed over.
    names = ("target", "before", "after", "other")
    rows = [int(getattr(layout, name)) for name in names]
    places = {name: np.int32(rows.index(k)) for name, k in zip(names, rows, strict=True)}
    warped = WarpedImages(*(part[rows] for part in warped))
    layout = InstantLayout(*(part[rows] for part in layout[:5]), **places, rest=layout.rest)
    return _fuse(params, mean, (L[rows], V[rows], warped, layout), paths, target.noise)


def add_smooth_part(
    target: TrajectoryEstimate, fused: FusedImage, brightness: BrightnessPrior
) -> FusedImage:
    """Add the smooth part that was subtracted from a target's images.

    Args:
        target: The target.
        fused: Its fused image.
        brightness: Its brightness.

    Returns:
        The image with other `L` and `P`.
    """
    assert target.smooth is not None
    layout = make_layout(target.instants, target.clear, len(target.instants))
    weight = after_weight(layout)
    L, P = smooth_part_at_target(target.smooth, layout, weight, target.paths, brightness)
    return dataclasses.replace(fused, L=fused.L + L, P=fused.P + P)


def make_trajectory_estimator(
    recording: Recording, params: Params, window_events: int, start: InitialMotion | None = None
) -> TrajectoryEstimator:
    """Make the trajectory estimator of a recording, with learned thresholds of single pixels.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        window_events: Events per window of the smoother.
        start: Motion that is known beforehand, or None.

    Returns:
        The estimator.
    """

    def made(factors: NDArray | None) -> TrajectoryEstimator:
        images = InstantImages(recording, params, window_events, factors)
        return TrajectoryEstimator(recording, params, images, start)

    trajectories = made(None)

    def fused(t: int) -> tuple[NDArray, NDArray]:
        found = fuse_target(params, trajectories(t))
        return np.asarray(found.L), np.asarray(found.P)

    factors = learn_thresholds(recording, params, trajectories.schedule.span, fused)
    return trajectories if factors is None else made(factors)
