"""The motion-compensated reconstruction: the method `mc` and its video.

Per-pixel estimators ignore that all pixels that see a scene point see the same brightness, and
interpolation between frames ignores the events. Here both speak: the smoother's images at instants
around a target time, frames among them, show how the points visible at the target move
(`trajectories`), and along these paths they are fused (`fusion`).
"""

import collections
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from jaxevent import dispatch
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.locks import synchronized
from jaxevent.reconstruction.clock import Clock, Timing, time_span
from jaxevent.reconstruction.compensated import borders, trajectories
from jaxevent.reconstruction.compensated.agreement import Agreement, Place, agree, place_of, shown
from jaxevent.reconstruction.compensated.course import TIME, course_of
from jaxevent.reconstruction.compensated.evidence import Evidence
from jaxevent.reconstruction.compensated.exposures import (
    Shots,
    Taken,
    constrain,
    constrain_purely,
    samples_for,
)
from jaxevent.reconstruction.compensated.fusion import (
    SOURCES,
    Fused,
    Views,
    compare,
    decide,
    fuse,
    views,
    weight_after,
)
from jaxevent.reconstruction.compensated.implicit import Numbers, Seen, depending
from jaxevent.reconstruction.compensated.instants import (
    Instants,
    Schedule,
    all_instants,
    room_for,
    speed_of,
)
from jaxevent.reconstruction.compensated.parameters import Params
from jaxevent.reconstruction.compensated.steadiness import (
    Brightness,
    Steadiness,
    smooth_at_target,
    smooth_part,
)
from jaxevent.reconstruction.compensated.thresholds import learn
from jaxevent.reconstruction.compensated.warping import (
    places,
    reach,
    sample,
    spread_purely,
    warp,
    warp_purely,
)
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.features import Features, Numeric, ReadOut
from jaxevent.reconstruction.frames import FrameImages
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.reconstruction.windows import WINDOW_EVENTS, prepare
from jaxevent.recording import Recording, Times, microseconds

PROBES = 6  # instants at which the speed of the image is measured
KEPT = 96  # images of instants that a video remembers
FADE = 0.35  # of variances from one resolution to the half of it
APART: int = 8  # steps of the schedule between anchors
ANCHORS = 2  # whose motion is remembered
STEPS = 2  # with which a target's motion is found at half resolution
CLEARLY = 0.97  # of the misfit by time, where the course tells more than noise
FASTEST = 2.0  # times as fast as what moves on the whole: what exposures are sampled for
INFLATE = 3.0  # of the variance of an image that motion is refined with

evidence = Evidence("evidence", Params, fuses=False)  # reads images at single instants


class Targets(ShortRepr):
    """Images to be read: where their instants lie, and how their points move."""

    instants: ReadOut  # all instants of all targets, sorted
    rows: Int[Numeric, "times k"]  # of each target's instants
    place: Place  # each (times, k) or (times,)
    p: Float[Numeric, "times rows columns 4"]  # trajectories
    whose: Int[Numeric, "times h w"]  # the pixel whose trajectory each one takes
    taken: Taken  # each (times, n)
    steady: Float[Numeric, " times"]  # 1 where frames keep their brightness, else 0
    brightness: Brightness  # each (times,)
    # Of exposures; None: these are not looked at.
    samples: int | None = eqx.field(static=True, default=None)

    def images(self, rows: NDArray) -> "Targets":
        """Those of its images, in that order."""
        each = (
            self.rows, self.place, self.p, self.whose, self.taken, self.steady, self.brightness,
        )  # fmt: skip
        chosen = jax.tree.map(lambda leaf: leaf[rows], each)
        return Targets(self.instants, *chosen, samples=self.samples)

    def over(self, devices: Sequence[Any]) -> "Targets":
        """The same: pixels read each other and are not shared out."""
        return self


class Images:
    """The smoother's images at any instants of a recording, the latest ones remembered.

    `factors` (2, pixels) are those of single pixels' thresholds; None: all are alike.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params,
        window_events: int,
        factors: NDArray[np.floating] | None = None,
    ):
        self.factors = factors
        self._video = evidence.estimate(
            recording, params, window_events=window_events, progress=False, factors=factors
        )
        self._kept: collections.OrderedDict[int, Estimate] = collections.OrderedDict()

    @property
    def dtype(self) -> np.dtype:
        return self._video.dtype

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._video.recording.height, self._video.recording.width

    def fetch(self, times: NDArray[np.int64]) -> None:
        """Read those of the sorted times that are not remembered."""
        missing = np.array([t for t in times.tolist() if t not in self._kept], np.int64)
        for t in times.tolist():
            if t in self._kept:
                self._kept.move_to_end(t)
        for batch, part in self._video.batches(missing, extrapolate=True):
            for n, t in enumerate(batch.tolist()):
                image = Estimate(*(np.array(v[n], np.float32) for v in part))
                self._kept[t] = image
        while len(self._kept) > max(KEPT, len(times)):
            self._kept.popitem(last=False)

    def __call__(self, times: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """L, V and clear, each (times, h, w) float32."""
        self.fetch(times)
        chosen = [self._kept[t] for t in times.tolist()]
        L, V, clear = (np.stack(part) for part in zip(*chosen, strict=True))
        return L, V, clear


def schedule_of(
    recording: Recording, params: Params, images: Images, common: bool = True
) -> Schedule:
    """The schedule for a recording, by the speed of its image.

    `common`: by a clock that goes as fast as the scene moves, where that has a common course.
    """
    clock = Clock.of(recording, Timing.of(params))
    # The first whole microsecond at which a frame is the one before.
    frames = np.ceil(clock.mid).astype(np.int64) + clock.origin
    first, last = time_span(recording, params.clock_offset)
    lag = int(np.median(np.diff(frames)) / 4) if len(frames) > 1 else 5000
    inner = first + np.linspace(0, max(last - lag - first, 0), PROBES + 2)[1:-1].astype(np.int64)

    def logs(times: NDArray[np.int64]) -> NDArray:
        order = np.argsort(times, kind="stable")
        L = images(times[order])[0]
        return L[np.argsort(order, kind="stable")]

    speed = speed_of(logs, inner, max(lag, 400))
    if not math.isfinite(speed):
        raise InputError(
            f"{recording.name}: with these parameters images at single instants are not finite; "
            "choose some nearer the defaults"
        )
    course = course_of(recording, (first, last), 4 * lag) if common else TIME
    return Schedule(frames, (first, last), speed, course)


class Shutter:
    """When frames were taken, and for how long they were exposed."""

    def __init__(self, recording: Recording, params: Params, speed: float):
        clock = Clock.of(recording, Timing.of(params))
        self.mid = np.ceil(clock.mid).astype(np.int64) + clock.origin
        self._half = np.rint((clock.right - clock.left) / 2).astype(np.int64)  # us
        moved = FASTEST * speed * 2e-6 * float(self._half.max(initial=0))
        samples = samples_for(moved) if params.deblur else 1
        wanted = samples > 1 or (float(params.margin) > 0 and params.one_sided)
        self.samples = samples if params.integrate and wanted else None

    def __call__(self, t: int, instants: Instants) -> Taken:
        """The frames next to a time (us), that of the target of these instants."""
        after = int(np.searchsorted(self.mid, t, "right"))
        here = int(np.searchsorted(self.mid, t, "left"))
        frame, present = np.array([here - 1, after]), np.array([here > 0, after < len(self.mid)])
        if here < after:  # the farther one gives way to that at this time
            far = np.where(present, np.abs(self.mid[frame.clip(0, len(self.mid) - 1)] - t), 1 << 62)
            frame[far.argmax()], present[far.argmax()] = here, True
        frame = frame.clip(0, max(len(self.mid) - 1, 0)).astype(np.int32)
        mid, half = self.mid[frame], self._half[frame]
        s = instants.at(mid)
        return Taken(
            frame,
            np.where(present, s, 0).astype(np.float32),
            ((instants.at(mid + half) - instants.at(mid - half)) / 2).astype(np.float32),
            present.astype(np.float32),
        )


class Followed(NamedTuple):
    """A target, the images at its instants, and how its points move."""

    instants: Instants
    L: NDArray[np.float32]  # (K, h, w)
    V: NDArray[np.float32]
    clear: NDArray[np.float32]
    p: NDArray[np.float32]  # (rows, columns, 4), px at s = 1, of nodes
    whose: NDArray[np.int32] | None = None  # (h, w), as `borders.choose`; None: each its own
    smooth: NDArray[np.float32] | None = None  # (K, h, w), taken away from L; None: nothing is

    @property
    def paths(self) -> NDArray[np.float32]:
        """Those of all pixels, (h, w, 4)."""
        paths = trajectories.spread(self.p, self.L.shape[1:])
        return paths if self.whose is None else paths.reshape(-1, 4)[self.whose]


@runtime_checkable
class Moving(Protocol):
    """What tells how points move: a `RigidFlow` of egomotion, or a video with optical flow."""

    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.floating]:
        """Optical flow (T, H, W, 2), of x and y in px/s; not finite where it is not known."""
        ...


@dataclasses.dataclass(frozen=True)
class Start:
    """Motion that is known beforehand; `refine` tells whether images may correct it."""

    motion: Moving
    refine: bool = True

    def __call__(self, t: int, late: int, unit: float) -> NDArray[np.float32] | None:
        """Trajectories (rows, columns, 4) of the target at a time; None where it is not known.

        The acceleration is that of points: what flow differs by `late` us before and after, at the
        places to which they go.
        """
        before, now, after = np.asarray(
            self.motion.flow(np.array([t - late, t, t + late]), extrapolate=True), float
        )
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
        rows, columns = trajectories.nodes(h, w, 0)
        padded = np.pad(p, [(0, 2 * rows - h), (0, 2 * columns - w), (0, 0)], mode="edge")
        return padded.reshape(rows, 2, columns, 2, 4).mean((1, 3)).astype(np.float32)


class Follower:
    """Estimates the motion of a recording's targets.

    Motion is sought from nothing at anchors only, which are evenly spaced in time. That of a target
    starts from the nearest anchor's. So the images of a video cost less than single ones, and none
    depends on which others were asked for. Where motion is known beforehand it starts from that.
    """

    def __init__(
        self, recording: Recording, params: Params, images: Images, start: Start | None = None
    ):
        self.params, self.images, self.start = params, images, start
        self.schedule = schedule_of(recording, params, images, common=start is None)
        self.shutter = Shutter(recording, params, self.schedule.speed)
        self.steady = Steadiness(recording, self.schedule.frames, float(params.I0))
        self._anchors: collections.OrderedDict[int, tuple[Instants, NDArray[np.float32]]]
        self._anchors = collections.OrderedDict()
        caution, floor, nu = (float(v) for v in (params.caution, params.floor, params.robust))
        numbers = (params.smooth, params.jump, params.edge, params.straight)
        self._caution = caution
        self._settings = (floor, nu, trajectories.Smoothness(*(float(v) for v in numbers)))

    def _images(self, instants: Instants) -> tuple[NDArray, NDArray, NDArray, NDArray | None]:
        """L, V and clear at instants, and what is taken away from L where frames are unsteady."""
        L, V, clear = self.images(instants.t)
        if self.steady(int(instants.t[0]), int(instants.t[-1])):
            return L, V, clear, None
        smooth = smooth_part(L)
        return L - smooth, V, clear, smooth

    def _doubted(self, V: NDArray, clear: NDArray) -> NDArray[np.float32]:
        return (V * np.where(clear > 0, 1, self._caution)).astype(np.float32)

    def _anchor(self, t: int) -> tuple[Instants, NDArray[np.float32]]:
        """The anchor next to a time, and its motion at half resolution."""
        first, last = self.schedule.span
        apart = APART * self.schedule.step
        at = min(max(first + round((t - first) / apart) * apart, first), last)
        if at in self._anchors:
            self._anchors.move_to_end(at)
        else:
            instants = self.schedule(at)
            L, V, clear, _ = self._images(instants)
            pyramid = trajectories.Pyramid(L, self._doubted(V, clear), FADE)
            plan = trajectories.stages(instants.s, instants.first)
            motion = trajectories.follow(pyramid, instants.s, plan, *self._settings)
            self._anchors[at] = instants, motion.at(1, *L.shape[1:]).p
            if len(self._anchors) > ANCHORS:
                self._anchors.popitem(last=False)
        return self._anchors[at]

    def _begin(self, t: int, instants: Instants) -> NDArray[np.float32]:
        """Where the motion of a target starts, at half resolution."""
        if self.start is not None:
            known = self.start(t, self.schedule.step, instants.unit)
            if known is not None:
                h, w = self.images.size
                return trajectories.Motion(known, 0).at(1, h, w).p
        anchor, p = self._anchor(t)
        apart = float(anchor.at(np.array([t]))[0])
        return trajectories.advect(p, apart, instants.unit / anchor.unit)

    def _stepped(
        self, images: NDArray[np.float32], instants: Instants, p: NDArray[np.float32]
    ) -> tuple[Instants, NDArray[np.float32]]:
        """A few steps at half resolution, by the clock on which images agree better."""

        def stepped(s: NDArray[np.float32], path: NDArray[np.float32]) -> NDArray[np.float32]:
            for _ in range(STEPS):
                path = trajectories.step(images, s, path, *self._settings)
            return path

        found = stepped(instants.s, p)
        if not instants.course.share:
            return instants, found
        plain = instants.by(TIME)
        other = stepped(plain.s, trajectories.by_clock(p, instants.s, plain.s))
        floor, nu, _ = self._settings
        misfit, by_time = (
            trajectories.misfit(images, one.s, path, floor, nu)
            for one, path in ((instants, found), (plain, other))
        )
        return (instants, found) if misfit < CLEARLY * by_time else (plain, other)

    def __call__(self, t: int) -> Followed:
        """The target at a time (us)."""
        instants = self.schedule(t)
        p = self._begin(t, instants)
        s = instants.s
        L, V, clear, smooth = self._images(instants)
        if self.start is not None and not self.start.refine:
            p = trajectories.Motion(p, 1).at(0, *L.shape[1:]).p
            return Followed(instants, L, V, clear, p, smooth=smooth)
        doubted = self._doubted(V, clear)
        pyramid = trajectories.Pyramid(L, doubted, FADE)
        instants, p = self._stepped(pyramid[1], instants, p)
        s = instants.s
        p = trajectories.Motion(p, 1).at(0, *L.shape[1:]).p
        # The target's own image is the smoother's. What is fused so far is a better one to refine
        # with.
        fused = fuse_images(self.params, Followed(instants, L, V, clear, p))
        better, own = L.copy(), instants.own
        better[own] = fused.L
        doubted[own] = INFLATE * np.asarray(fused.P) + self._settings[0]
        packed = trajectories.pack(better, doubted)
        p, whose = borders.refine(packed, s, p, *self._settings)
        return Followed(instants, L, V, clear, p, whose, smooth)


@jax.jit
def _decide(params: Params, told: Agreement, seen: Views) -> Fused:
    return decide(params, compare(told, seen))


def look(params: Params, target: Followed) -> tuple[Agreement, Views]:
    """What `fusion.compare` looks at, of a target's images along trajectories."""
    instants, L, V, clear, *_ = target
    paths = target.paths
    along = warp(L, V, np.asarray(clear, np.float32), instants.s, paths)
    place = place_of(instants, clear, len(instants))
    return agree(params, L, along, place), views(L, V, along, place, reach(paths))


def fuse_images(params: Params, target: Followed) -> Fused:
    """The images at a target's instants along trajectories, in one."""
    return _decide(params, *look(params, target))


def smoothed_back(target: Followed, fused: Fused, brightness: Brightness) -> Fused:
    """What is fused, with the smooth part that was taken away from a target's images."""
    assert target.smooth is not None
    place = place_of(target.instants, target.clear, len(target.instants))
    L, P = smooth_at_target(target.smooth, place, weight_after(place), target.paths, brightness)
    return dataclasses.replace(fused, L=fused.L + L, P=fused.P + P)


def follower_of(
    recording: Recording, params: Params, window_events: int, start: Start | None = None
) -> Follower:
    """The follower of a recording, with the thresholds of single pixels where they are learned."""
    follow = Follower(recording, params, Images(recording, params, window_events), start)

    def fused(t: int) -> tuple[NDArray, NDArray]:
        found = fuse_images(params, follow(t))
        return np.asarray(found.L), np.asarray(found.P)

    factors = learn(recording, params, follow.schedule.span, fused)
    if factors is None:
        return follow
    return Follower(recording, params, Images(recording, params, window_events, factors), start)


@jax.jit
def _carry(images: Array, s: Array, paths: Array) -> Array:
    """Images (n, h, w, channels) at s (n,) along trajectories."""
    Y, X = places(paths, s)
    return jax.vmap(lambda one: sample(one, Y, X), -1, -1)(images)


_shown = jax.jit(shown)


class CompensatedVideo(ImageSequence[Params]):
    """Images of `mc`: `image, variance, valid = video(times)`; also `flow` and `sources`.

    `valid` is false, too, where the standard deviation is above the parameter `vague`: there lie
    most of the large errors, of points that the frames do not show and motion that was not found.
    The smoother's images are read as `Video` reads them, in constant memory. Images do not depend
    on which other images were asked for.

    With `motion`, which has `flow(times, extrapolate)` as this video has it, trajectories start
    from that, for instance a rigid scene's (`jaxevent.egomotion.field.RigidFlow`); without `refine`
    they are that. Where it is not finite motion is sought from nothing.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        params: Params,
        *,
        window_events: int = WINDOW_EVENTS,
        motion: Moving | None = None,
        refine: bool = True,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._start = None if motion is None else Start(motion, refine)
        self._window_events = window_events
        self._follower: Follower | None = None
        self._latest: tuple[int, Followed, Fused] | None = None
        self._frames = FrameImages(recording, np.dtype(np.float32))
        self._response = self._frames.response()

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(jnp.result_type(float))

    @property
    @synchronized
    def follow(self) -> Follower:
        """What estimates the motion of targets; made when first asked for."""
        if self._follower is None:
            given = (self.recording, self.params, self._window_events)
            self._follower = follower_of(*given, self._start)
        return self._follower

    @synchronized
    def _target(self, t: int) -> tuple[Followed, Fused]:
        if self._latest is None or self._latest[0] != t:
            dispatch.check_threads()
            target = self.follow(t)
            self._latest = t, target, self._held(t, target)
        return self._latest[1:]

    def _held(self, t: int, target: Followed) -> Fused:
        """What a target's images give, held to the frames next to it."""
        fused, brightness = fuse_images(self.params, target), self.follow.steady.brightness(t)
        if target.smooth is not None:  # nor can it be held to frames of another brightness
            return smoothed_back(target, fused, brightness)
        if self.follow.shutter.samples is not None:
            fused = self._constrained(t, target, fused)
        return dataclasses.replace(fused, P=fused.P + brightness.doubt)

    def _constrained(self, t: int, target: Followed, fused: Fused) -> Fused:
        """What is fused, held to exposures and clipped pixels."""
        shutter = self.follow.shutter
        assert shutter.samples is not None
        taken = shutter(t, target.instants)
        low, high = int(taken.frame.min()), int(taken.frame.max()) + 1
        grey, intensity, _, gain = self._frames.read(slice(low, high), high - low)
        rows = taken.frame - low
        shots = Shots(grey[rows], intensity[rows], self._response, gain[rows])
        return constrain(self.params, fused, target.paths, taken, shots, shutter.samples)

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        for n, t in enumerate(times.tolist()):
            _, fused = self._target(t)
            image = np.exp(np.asarray(fused.L)) - np.asarray(self.params.I0)
            valid = np.isfinite(image) & (np.sqrt(fused.P) < np.asarray(self.params.vague))
            whole = (image.astype(self.dtype), np.asarray(fused.P, self.dtype), valid)
            yield times[n : n + 1], tuple(v[None] for v in whole)

    def _targets(self, times: Times, extrapolate: bool) -> Iterator[tuple]:
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            self.estimator.check_span(self.recording, wanted, self.params)
        for t in wanted.tolist():
            yield self._target(t)

    @synchronized
    def carry(
        self, images: NDArray[np.floating], at: NDArray[np.int64], to: int
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """As `ImageSequence.carry`, along trajectories."""
        target, fused = self._target(to)
        s = target.instants.at(at).astype(np.float32)
        order = np.argsort(at, kind="stable")
        L, V, clear = (part[np.argsort(order)] for part in self.follow.images(at[order]))
        M = np.asarray(fused.L, np.float32)
        if target.smooth is not None:
            L, M = L - smooth_part(L), M - smooth_part(M)
        along = warp(L, V, clear, s, target.paths)
        seen = _carry(np.asarray(images, np.float32), s, target.paths)
        return np.asarray(seen), np.asarray(_shown(self.params, M, along))

    @synchronized
    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.float32]:
        """Optical flow (T, H, W, 2) at `times`, of x and y in px/s, of the points visible then.

        Times are as those of images.
        """
        found = [
            target.paths[..., :2] * np.float32(target.instants.pace(self.follow.schedule.step))
            for target, _ in self._targets(times, extrapolate)
        ]
        return np.stack(found)

    @synchronized
    def sources(self, times: Times, extrapolate: bool = False) -> dict[str, NDArray[np.float32]]:
        """Where each pixel of the images comes from: shares (T, H, W) whose sum is 1.

        "before" and "after" are frames along trajectories, "events" instants without frame along
        trajectories, "smoothed" the pixel's own smoother and "blend" the frames blended in place.
        `visible_before` and `visible_after`, 0 to 1, tell whether the frames next to the target
        show the point. Times are as those of images.
        """
        found = [fused for _, fused in self._targets(times, extrapolate)]
        shares = {name: [one.sources[k] for one in found] for k, name in enumerate(SOURCES)}
        shares["visible_before"] = [one.visible[0] for one in found]
        shares["visible_after"] = [one.visible[1] for one in found]
        return {name: np.stack(images).astype(np.float32) for name, images in shares.items()}


@dataclasses.dataclass(frozen=True, repr=False)
class MotionCompensated(ImageEstimator[Params]):
    """The estimator of this package.

    Attributes:
        through_motion: Whether derivatives of what `read` returns go through the motion, too, as
            through a fixpoint (`implicit`). Else motion counts as fixed. Values are the same.
    """

    options: frozenset[str] = dataclasses.field(
        default=frozenset({"window_events", "motion", "refine"}), kw_only=True
    )
    through_motion: bool = dataclasses.field(default=False, kw_only=True)

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: Params | None = None,
        *,
        extrapolate: bool = False,
    ) -> tuple[Features, Targets]:
        """As `ImageEstimator.prepare`; motion is estimated here, with the params given."""
        self.check(recording)
        params = self.Params() if params is None else params
        self.check_clocks(recording, params)
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            self.check_span(recording, wanted, params)
        if not len(wanted):
            raise InputError(f"{recording.name}: no times to prepare images for; give some")
        follow = follower_of(recording, params, WINDOW_EVENTS)
        chosen = [follow.schedule(t) for t in wanted.tolist()]
        room = room_for(max(len(one) for one in chosen))
        every = all_instants(chosen)
        features, instants = prepare(recording, every, Timing.of(params), filtering=False)
        factors = follow.images.factors
        if factors is not None:
            features, instants = features.weighted(factors), instants.weighted(factors)
        shape = (len(chosen), *trajectories.nodes(recording.height, recording.width, 0), 4)
        rows, p = np.zeros((len(chosen), room), np.int32), np.zeros(shape, np.float32)
        places, taken, told, steady = [], [], [], []
        size = (recording.height, recording.width)
        own = np.arange(recording.height * recording.width, dtype=np.int32).reshape(size)
        whose = np.repeat(own[None], len(chosen), 0)
        for n in range(len(chosen)):
            target = follow(int(wanted[n]))
            one, clear, p[n] = target.instants, target.clear, target.p
            whose[n] = own if target.whose is None else target.whose
            steady.append(target.smooth is None)
            told.append(follow.steady.brightness(int(wanted[n])))
            rows[n, : len(one)] = np.searchsorted(every, one.t)
            places.append(place_of(one, clear, room))
            taken.append(follow.shutter(int(wanted[n]), one))
        place, taken, told = (
            jax.tree.map(lambda *leaves: np.stack(leaves), *one) for one in (places, taken, told)
        )
        each = (rows, place, p, whose, taken, np.asarray(steady, np.float32), told)
        return features, jax.device_put(Targets(instants, *each, samples=follow.shutter.samples))

    def run(self, params: Params, features: Features, state: Any = None) -> tuple[Any, Any]:
        """Smooth each pixel; pure. `state` is what the window before returned."""
        return evidence.run(params, features, state)

    def read(self, params: Params, trajectory: Any, out: Targets) -> Estimate:
        """The images prepared in `out`; the motion is what `prepare` found."""
        L, V, clear = evidence.read(params, trajectory, out.instants)
        frames = jax.tree.map(jnp.asarray, trajectory.frames)
        width = frames.width
        L, V, clear = (v.reshape(len(v), -1, width) for v in (L, V, clear.astype(L.dtype)))

        @jax.checkpoint
        def one(target: tuple) -> tuple[Array, Array]:
            rows, place, p, whose, taken, steady, told = target
            smooth = (1 - steady) * smooth_part(L[rows])
            images = (L[rows] - smooth, V[rows], clear[rows])
            if self.through_motion:
                p = self._moved(params, images, place, p)
            paths = spread_purely(p, *whose.shape).reshape(-1, 4)[whose]
            along = warp_purely(*images, place.s, paths)
            fused = fuse(params, images[0], images[1], along, place, reach(paths))
            if out.samples is not None:
                at = taken.frame
                seen = (frames.grey[at], frames.intensity[at], frames.response, frames.gain[at])
                # Frames of another brightness hold nothing.
                taken = taken._replace(present=taken.present * steady)
                fused = constrain_purely(params, fused, paths, taken, Shots(*seen), out.samples)
            base, variance = smooth_at_target(smooth, place, weight_after(place), paths, told)
            return fused.L + (1 - steady) * base, fused.P + variance

        each = (out.rows, out.place, out.p, out.whose, out.taken, out.steady, out.brightness)
        found, P = jax.lax.map(one, each)
        image = (jnp.exp(found) - params.I0).reshape(len(found), -1)
        P = P.reshape(image.shape)
        return Estimate(image, P, jnp.isfinite(image) & (jnp.sqrt(P) < params.vague))

    def _moved(
        self, params: Params, images: tuple[Array, Array, Array], place: Place, p: Array
    ) -> Array:
        """Trajectories that depend on images and parameters."""
        L, V, clear = images
        chosen = (params.floor, params.robust, params.smooth, params.jump, params.edge)
        numbers = Numbers(*(jnp.asarray(v, L.dtype) for v in (*chosen, params.straight)))
        doubted = V * jnp.where(clear > 0, 1, params.caution)
        return depending(p, Seen(L, doubted, place.s, place.present), numbers)

    def estimate(
        self, recording: Recording, params: Params | None = None, **options: Any
    ) -> CompensatedVideo:
        """Video of a recording: `image, variance, valid = mc.estimate(recording, params)(times)`.

        `options` are those of `CompensatedVideo`.
        """
        self.refuse_unknown({name: v for name, v in options.items() if name != "progress"})
        self.check_options(**options)
        chosen = self.Params() if params is None else params
        return CompensatedVideo(self, recording, chosen, **options)


mc = MotionCompensated(
    "mc",
    Params,
    needs_frames=True,
    about="The motion-compensated reconstruction. It estimates how the scene's points move, from "
    "frames and events together, and fuses both along their paths; where that fails it falls back "
    "on the smoother of each pixel and on the frames.",
)
