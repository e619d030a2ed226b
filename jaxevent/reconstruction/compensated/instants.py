"""Instants around a target time at which images are compared, and the clock that they are put on.

The clock goes as fast as the scene moves. Where the camera speeds up, slows down or stops, all
points do so together. Trajectories that are parabolas of time miss that over a few frames. Events
come in proportion to motion, so parabolas of the number of events do not miss it. Where objects
move independently, no clock suits all of them, and the clock is time. Parts of the image decide
between both: the rate of events in one part is regressed on the rate in all others. Events that are
missing in gaps of the stream are counted as they would have come, evenly over the gap, and where
some are missing between two frames the clock is nearer to time.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxevent.cache import cache_method
from jaxevent.calibration.gaps import Gaps, find_gaps
from jaxevent.codegen import njit_noalloc
from jaxevent.reconstruction.compensated.warp import PathTimes
from jaxevent.recording import Recording

GRID_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # distances of instants from the target
GRID_STEP_PX = 0.6  # motion within a step of the grid
MAX_FRAME_MOTION_PX = 6.0  # between the target and a frame beyond the nearest ones
MIN_FRAMES, MAX_FRAMES = 2, 8  # on either side of the target
FIRST_HORIZON_STEPS = 2.2  # the horizon at which motion is first sought
MAX_REST_RATE = 0.1  # of the mean rate of events, below which a scene is at rest
INSTANT_COUNT_MULTIPLE = 4  # numbers of instants are multiples, to compile few shapes
MIN_GRID_STEP_US = 200

MAX_EVENT_SHARE = 0.9  # of the clock: time never stands still
N_RATE_SEGMENTS = 8  # of a recording, in which parts of the image are compared
SEGMENT_FRAME_INTERVALS = 4  # intervals of frames, the length of a segment
N_PARTS, N_BINS = 4, 16  # of the image along each axis, and of a segment
N_CACHED_TIMES = 4096  # times whose number of earlier events is remembered
N_CACHED_GAP_BLOCKS = 64  # stretches of a recording whose gaps are remembered
MIN_RATE_DEVIATION = 0.05  # deviations of the rate, as a part of it, that do not matter


class MissedEvents:
    """Estimates the events that are missing in gaps: `missed = missed_events(times)`.

    Args:
        recording: The recording.
        block_us: Length of the stretches in which gaps are sought, us.
    """

    def __init__(self, recording: Recording, block_us: int):
        self._events, self._origin, self._block = recording.events, recording.start, block_us
        self._gaps = cache_method(self._find_gaps, N_CACHED_GAP_BLOCKS)

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the events missing before times (us), beside a number common to all of them."""
        first, last = ((int(t) - self._origin) // self._block for t in (times.min(), times.max()))
        missed = np.zeros(len(times))
        for block in range(first - 1, last + 1):
            begin, end, _, number = (part[:, None] for part in self._gaps(block))
            missed += (number * ((times - begin) / (end - begin)).clip(0, 1)).sum(0)
        return missed

    def _find_gaps(self, block: int) -> Gaps:
        """Find the gaps that begin in a stretch, by events up to a stretch before and after."""
        begin = self._origin + block * self._block
        end, events = begin + self._block, self._events
        rows = slice(events.index(begin - self._block), events.index(end + self._block))
        found = find_gaps(events[rows].t)
        chosen = (found.begin >= begin) & (found.begin < end)
        return Gaps._make(part[chosen] for part in found)


@dataclasses.dataclass(frozen=True)
class MotionClock:
    """A monotone map from time to motion time: a weighted mean of time and the event count.

    Over the whole recording it goes as fast as time.
    """

    count_before: Callable[[int], int]  # events before a time (us)
    origin: int  # us
    event_interval: float  # us, mean over the recording
    event_share: float  # weight of the event count, 0..1
    # Events missing before times (us), beside a common number; None: none are.
    missed: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the motion time (us) at times (us), beside a constant where events are missing."""
        elapsed = np.asarray(times - self.origin, float)
        if not self.event_share:
            return elapsed
        counts = np.array([self.count_before(t) for t in times.tolist()], float)
        if self.missed is not None:
            counts += self.missed(times)
        return (1 - self.event_share) * elapsed + self.event_share * self.event_interval * counts

    def between(self, begin_us: int, end_us: int) -> "MotionClock":
        """Return the clock whose weight of events is lower by the share that is missing.

        Args:
            begin_us: Time from which missing events count, us.
            end_us: Time up to which they count, us.

        Returns:
            The clock itself where none are missing.
        """
        if not self.event_share or self.missed is None:
            return self
        missed = float(np.ptp(self.missed(np.array([begin_us, end_us]))))
        if not missed:
            return self
        here = self.count_before(end_us) - self.count_before(begin_us)
        share = self.event_share * here / (here + missed)
        return dataclasses.replace(self, event_share=share)

    def relative_event_rate(self, begin_us: int, end_us: int) -> float:
        """Return the rate of events between two times, relative to the mean rate.

        Args:
            begin_us: First time, us.
            end_us: Last time, us.

        Returns:
            The ratio; 1 where it is not defined.
        """
        if not (self.event_interval and end_us > begin_us):
            return 1.0
        count = self.count_before(end_us) - self.count_before(begin_us)
        return count * self.event_interval / (end_us - begin_us)


TIME_CLOCK = MotionClock(lambda _: 0, 0, 0.0, 0.0)


def fit_motion_clock(
    recording: Recording, span_us: tuple[int, int], frame_interval_us: int
) -> MotionClock:
    """Fit the motion clock of a recording.

    Args:
        recording: The recording.
        span_us: First and last time with data, us.
        frame_interval_us: Time between frames, us.

    Returns:
        The clock.
    """
    first, last = span_us
    length = min(SEGMENT_FRAME_INTERVALS * frame_interval_us, last - first)
    begins = np.linspace(first, last - length, N_RATE_SEGMENTS).astype(np.int64)
    counts = [_count_parts(recording, int(begin), length) for begin in np.unique(begins)]
    event_interval = (recording.stop - recording.start) / max(len(recording.events), 1)
    # Targets share instants, and formats that are decoded are slow to search.
    count_before = functools.lru_cache(N_CACHED_TIMES)(recording.events.index)
    event_share = common_motion_fraction(np.stack(counts))
    missed = MissedEvents(recording, max(frame_interval_us, 1))
    return MotionClock(count_before, first, event_interval, event_share, missed)


def common_motion_fraction(counts: NDArray[np.floating]) -> float:
    """Estimate the fraction of the motion that all parts of the image have in common.

    Returns the slope of a regression: of the deviation of a part's rate of events from a constant
    one, on that of all other parts.

    Args:
        counts: (segments, parts, bins) numbers of events.

    Returns:
        0 for independent parts, to `MAX_EVENT_SHARE`.
    """
    total = counts.sum((1, 2), keepdims=True)
    own, rest = counts.sum(2, keepdims=True), counts.sum(1, keepdims=True) - counts
    bins = counts.shape[2]
    here = counts / np.maximum(own, 1) * bins - 1
    there = rest / np.maximum(total - own, 1) * bins - 1
    least = MIN_RATE_DEVIATION**2
    slope = (own * here * there).sum() / max((own * (there**2 + least)).sum(), 1e-12)
    return float(min(max(slope, 0.0), MAX_EVENT_SHARE))


def _count_parts(recording: Recording, begin: int, length: int) -> NDArray[np.floating]:
    """Count the events of a segment by part of the image and time.

    Args:
        recording: The recording.
        begin: Begin of the segment, us.
        length: Length of the segment, us.

    Returns:
        (parts, bins) numbers of events.
    """
    source = recording.events
    events = source[source.index(begin) : source.index(begin + length)]
    counts, size = np.zeros((N_PARTS**2, N_BINS)), (recording.height, recording.width)
    _add_to_cells((events.t, events.x, events.y), begin, max(length, 1), size, counts)
    return counts


@njit_noalloc
def _add_to_cells(events, begin, length, image_shape, counts):
    """Add events to the counts of parts of the image and of a span of time.

    Args:
        events: t (us), x and y, (n,) each.
        begin: Begin of the span, us.
        length: Its length, us.
        image_shape: Height and width of the sensor, px.
        counts: (parts, bins) added to.
    """
    (t, x, y), (height, width) = events, image_shape
    for i in range(len(t)):
        part = np.int64(y[i]) * N_PARTS // height * N_PARTS + np.int64(x[i]) * N_PARTS // width
        counts[part, (t[i] - begin) * N_BINS // length] += 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class CommonMotion:
    """The displacement of all points of a scene, a function of time.

    Attributes:
        t: (K,) sorted times, us, K >= 2.
        displacement: (K, 2) along x and y at these times, px.
    """

    t: NDArray[np.int64]
    displacement: NDArray[np.float64]

    def between(self, start: int, times: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the displacements from one time to others.

        Args:
            start: Time, us.
            times: (n,) times, us.

        Returns:
            (n, 2) along x and y, px.
        """
        moved = self._displacement_at(np.append(times, start))
        return (moved[:-1] - moved[-1]).astype(np.float32)

    def velocity(self, time: int, span: int) -> NDArray[np.float32]:
        """Return the mean velocity around a time.

        Args:
            time: Time, us.
            span: Time before and after it over which the mean is taken, us.

        Returns:
            (2,) along x and y, px/s.
        """
        before, after = self._displacement_at(np.array([time - span, time + span]))
        return ((after - before) / (2e-6 * span)).astype(np.float32)

    @functools.cached_property
    def _course(self) -> Callable[[NDArray], NDArray[np.float64]]:
        from scipy.interpolate import Akima1DInterpolator  # imported in .4 s

        return Akima1DInterpolator((self.t - self.t[0]) * 1e-6, self.displacement)

    def _displacement_at(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        return self._course((times.clip(self.t[0], self.t[-1]) - self.t[0]) * 1e-6)


@dataclasses.dataclass(frozen=True)
class TargetInstants:
    """The instants of one target, sorted, and their times on a clock.

    Attributes:
        t: (K,) times of the instants, us.
        target: Index of the target.
        before: Index of the nearest frame before; where there is none, of the one after.
        after: Index of the nearest frame after; where there is none, of the one before.
        s: (K,) times relative to the target on the clock, -1..1.
        unit: Time that 1 stands for, s.
        first_horizon: Horizon at which motion is first estimated, in units of `s`.
        clock: The clock.
        rest: 1 where the scene is at rest between the target and frames on one side of it alone,
            else 0; 0 where frames are on both sides.
        common: Motion common to all points, which trajectories do not explain; None: none is known.
    """

    t: NDArray[np.int64]
    target: int
    before: int
    after: int
    s: NDArray[np.float32]
    unit: float
    first_horizon: float
    clock: MotionClock
    rest: float = 0.0
    common: CommonMotion | None = None

    @functools.cached_property
    def path_times(self) -> PathTimes:
        """The instants on the clock of paths."""
        return PathTimes(self.s, self._common_displacement(self.t))

    def path_times_at(self, times_us: NDArray[np.int64]) -> PathTimes:
        """Put other times (us) on the clock of paths."""
        s = self.to_relative_times(times_us).astype(np.float32)
        return PathTimes(s, self._common_displacement(times_us))

    def _common_displacement(self, times: NDArray[np.int64]) -> NDArray[np.float32]:
        if self.common is None:
            return np.zeros((len(times), 2), np.float32)
        return self.common.between(int(self.t[self.target]), times)

    def to_relative_times(self, times_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Convert times (us) to those of `s`."""
        both = self.clock(np.append(times_us, self.t[self.target]))
        return (both[:-1] - both[-1]) * 1e-6 / self.unit

    def relative_times_per_second(self, span_us: int) -> float:
        """Return the change of `s` per second, over `span_us` us before and after the target."""
        begin, end = self.to_relative_times(self.t[self.target] + np.array([-span_us, span_us]))
        return float(end - begin) / (2e-6 * span_us)

    def with_clock(self, clock: MotionClock) -> "TargetInstants":
        """Put the instants on another clock."""
        s, unit = _relative_times(clock, self.t, self.target)
        return dataclasses.replace(self, s=s, unit=unit, clock=clock)

    def with_common_motion(self, common: CommonMotion | None) -> "TargetInstants":
        """Put the motion that all points have in common beside their trajectories."""
        return dataclasses.replace(self, common=common)

    def __len__(self) -> int:
        return len(self.t)


def _relative_times(
    clock: MotionClock, times: NDArray[np.int64], target: int
) -> tuple[NDArray[np.float32], float]:
    """Convert times to those relative to a target, on a clock.

    Args:
        clock: The clock.
        times: (K,) times, us.
        target: Index of the target's time among them.

    Returns:
        (K,) relative times, -1..1, and what 1 stands for, s.
    """
    elapsed = clock(times)
    elapsed -= elapsed[target]
    unit = max(float(np.abs(elapsed).max()), 1.0)
    return (elapsed / unit).astype(np.float32), unit * 1e-6


class InstantSchedule:
    """Chooses the instants of a target: frames around it, and a grid between the nearest two.

    Args:
        frame_times_us: (frames,) times of frames, us.
        span_us: First and last time with data, us.
        speed_px_s: Speed of the moving points, px/s.
        clock: Clock of the instants.
    """

    def __init__(
        self,
        frame_times_us: NDArray[np.int64],
        span_us: tuple[int, int],
        speed_px_s: float,
        clock: MotionClock = TIME_CLOCK,
    ):
        self.frames, self.span, self.clock = frame_times_us, span_us, clock
        gap = (
            float(np.median(np.diff(frame_times_us)))
            if len(frame_times_us) > 1
            else float(span_us[1] - span_us[0])
        )
        self.speed = speed_px_s = max(speed_px_s, 1e-3)
        self.step = max(
            round(min(GRID_STEP_PX / speed_px_s * 1e6, gap / 2)), MIN_GRID_STEP_US
        )  # us
        self.max_distance = MAX_FRAME_MOTION_PX / speed_px_s * 1e6  # us, of further frames

    def __call__(self, t: int) -> TargetInstants:
        """Choose the instants of the target at a time (us)."""
        frames = self.frames
        right = int(np.searchsorted(frames, t, "right"))  # of frames at t, none is left or right
        left = int(np.searchsorted(frames, t, "left"))
        times = np.array(sorted({t, *self._near_frames(t), *self._grid_times(t)}), np.int64)
        target = int(np.searchsorted(times, t))
        nearest = [
            int(np.searchsorted(times, frames[k]))
            for k in (left - 1, right)
            if 0 <= k < len(frames)
        ]
        before, after = (nearest[0], nearest[-1]) if nearest else (target, target)
        clock = self.clock.between(int(times[before]), int(times[after]))
        s, unit = _relative_times(clock, times, target)
        far = np.sort(np.abs(s))
        # At least two instants on either side, where there are.
        first_step = FIRST_HORIZON_STEPS * self.step * 1e-6 / unit
        horizon = float(min(max(first_step, float(far[min(4, len(far) - 1)])), 1))
        rest = 0.0
        if len(nearest) == 1 and left == right:
            rate = self.clock.relative_event_rate(*sorted((int(times[nearest[0]]), t)))
            rest = 1 / (1 + (rate / MAX_REST_RATE) ** 2)
        return TargetInstants(times, target, before, after, s, unit, horizon, clock, rest)

    def _near_frames(self, t: int) -> set[int]:
        """Return the times (us) of the frames to use around a time (us)."""
        frames, chosen = self.frames, set()
        right = int(np.searchsorted(frames, t, "right"))
        left = int(np.searchsorted(frames, t, "left"))
        for side in (range(left - 1, -1, -1), range(right, len(frames))):
            for n, k in enumerate(side[:MAX_FRAMES]):
                if n >= MIN_FRAMES and abs(frames[k] - t) > self.max_distance:
                    break
                chosen.add(int(frames[k]))
        return chosen

    def _grid_times(self, t: int) -> set[int]:
        """Return the times (us) of a common grid, between the frames next to a time (us)."""
        frames, step, (first, last) = self.frames, self.step, self.span
        right = int(np.searchsorted(frames, t, "right"))
        left = int(np.searchsorted(frames, t, "left"))
        low = int(frames[left - 1]) if left > 0 else first
        high = int(frames[right]) if right < len(frames) else last
        middle = round((t - first) / step)
        grid = {first + (middle + sign * n) * step for n in GRID_STEPS for sign in (-1, 1)}
        return {at for at in grid if low < at < high and abs(at - t) > step // 2}


def measure_image_speed(
    images: Callable[[NDArray[np.int64]], NDArray], times_us: NDArray[np.int64], lag_us: int
) -> float:
    """Measure the speed of the moving points in the smoother's images.

    It is the normal flow |dL/dt| / |grad L|, a mean over blocks of 4 x 4 pixels weighted by the
    squared change. The lag is halved until the flow is below 2 px.

    Args:
        images: A function from sorted times (T,), us, to images (T, h, w) of log intensity.
        times_us: (times,) us.
        lag_us: Time between the images of a pair, us.

    Returns:
        The speed, px/s.
    """
    while True:
        pairs = (images(np.array([t, t + lag_us])) for t in times_us)
        product, steepness, weight = np.stack([_change_and_steepness(*pair) for pair in pairs], 1)
        weight = weight * (steepness > 1e-4)  # of blocks steeper than 1 % per px
        flow = product / np.maximum(steepness, 1e-4)
        moved = float((weight * flow).sum() / max(float(weight.sum()), 1e-12))
        if moved < 2 or lag_us < 1000:
            return moved / lag_us * 1e6
        lag_us //= 2


def _change_and_steepness(early: NDArray, late: NDArray) -> NDArray:
    """Average changes and gradients of two images over blocks of 4 x 4 pixels.

    Args:
        early: (h, w) log intensity.
        late: (h, w) log intensity a little later.

    Returns:
        (3, h // 4, w // 4) means of |dL| |grad L|, |grad L|^2 and |dL|^2, with gradients per px.
    """
    mean = np.pad((early + late) / 2, 1, mode="edge")
    gx = (mean[1:-1, 2:] - mean[1:-1, :-2]) / 2
    gy = (mean[2:, 1:-1] - mean[:-2, 1:-1]) / 2
    change, gradient2 = np.abs(late - early), gx**2 + gy**2
    h, w = (size // 4 * 4 for size in early.shape)
    parts = np.stack([change * np.sqrt(gradient2), gradient2, change**2])[:, :h, :w]
    return parts.reshape(3, h // 4, 4, w // 4, 4).mean((2, 4))


def pad_instant_count(count: int) -> int:
    """Return the number to which a target's instants are padded."""
    return -(-count // INSTANT_COUNT_MULTIPLE) * INSTANT_COUNT_MULTIPLE


def merge_instant_times(targets: Sequence[TargetInstants]) -> NDArray[np.int64]:
    """Merge the times (us) of several targets, sorted; see `pad_with_last`."""
    t = np.unique(np.concatenate([one.t for one in targets]))
    return t[pad_with_last(len(t))]


def pad_with_last(count: int, most: int | None = None) -> NDArray[np.int64]:
    """Return the indices that repeat the last of some items until their number is a power of two.

    Windows of a fit so share their programs, each of which takes 10 s to compile.

    Args:
        count: Number of items.
        most: Largest number to pad to.

    Returns:
        Indices of the items, (padded,).
    """
    padded = 1 << (count - 1).bit_length()
    return np.minimum(np.arange(padded if most is None else min(padded, most)), count - 1)
