"""At which instants around a target time images are compared."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxevent.reconstruction.compensated.course import TIME, Course

OFFSETS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # in steps, of instants from the target
STEP = 0.6  # px that what moves does so in a step
NEAR = 6.0  # px that it may move between the target and a further frame
FRAMES = (2, 8)  # on either side: at least, at most
NEAREST = 2.2  # steps: the horizon at which motion is first sought
RESTING = 0.1  # of the mean rate of events, below which a scene is at rest
ROOM = 4  # numbers of instants are multiples, to compile few shapes


@dataclasses.dataclass(frozen=True)
class Instants:
    """Those of one target: times (us), which is the target and which hold frames.

    `s` are the times relative to the target by the scene's course, -1..1; `unit` (s) is what 1
    stands for.
    """

    t: NDArray[np.int64]
    own: int
    before: int  # of the nearest frames; where there is none on a side, the other one
    after: int
    s: NDArray[np.float32]
    unit: float
    first: float  # the horizon, in s, at which motion is first sought
    course: Course
    # How far the scene is at rest between the target and frames that are on one side of it alone,
    # 0..1; 0 where they are on both.
    rest: float = 0.0

    def at(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """Times (us) as those of `s`."""
        both = self.course(np.append(times, self.t[self.own]))
        return (both[:-1] - both[-1]) * 1e-6 / self.unit

    def pace(self, over: int) -> float:
        """How much of s passes per s at the target, within so many us before and after it."""
        begin, end = self.at(self.t[self.own] + np.array([-over, over]))
        return float(end - begin) / (2e-6 * over)

    def by(self, course: Course) -> "Instants":
        """The same on another clock."""
        s, unit = _relative(course, self.t, self.own)
        return dataclasses.replace(self, s=s, unit=unit, course=course)

    def __len__(self) -> int:
        return len(self.t)


def _relative(
    course: Course, times: NDArray[np.int64], own: int
) -> tuple[NDArray[np.float32], float]:
    """Times (us) relative to that of a target, in -1..1, and what 1 stands for in s."""
    gone = course(times)
    gone -= gone[own]
    unit = max(float(np.abs(gone).max()), 1.0)
    return (gone / unit).astype(np.float32), unit * 1e-6


class Schedule:
    """Chooses instants: frames around a target, and between the two next to it a grid of steps.

    `speed` (px/s) is that of what moves.
    """

    def __init__(
        self,
        frames: NDArray[np.int64],
        span: tuple[int, int],
        speed: float,
        course: Course = TIME,
    ):
        self.frames, self.span, self.course = frames, span, course
        gap = float(np.median(np.diff(frames))) if len(frames) > 1 else float(span[1] - span[0])
        self.speed = speed = max(speed, 1e-3)
        self.step = max(round(min(STEP / speed * 1e6, gap / 2)), 200)
        self.reach = NEAR / speed * 1e6

    def __call__(self, t: int) -> Instants:
        frames, step = self.frames, self.step
        right = int(np.searchsorted(frames, t, "right"))  # of frames at t, none is left or right
        left = int(np.searchsorted(frames, t, "left"))
        chosen = set()
        for side in (range(left - 1, -1, -1), range(right, len(frames))):
            for n, k in enumerate(side):
                if n >= FRAMES[1] or (n >= FRAMES[0] and abs(frames[k] - t) > self.reach):
                    break
                chosen.add(int(frames[k]))
        low = int(frames[left - 1]) if left > 0 else self.span[0]
        high = int(frames[right]) if right < len(frames) else self.span[1]
        # On a grid, so that targets share instants.
        first, middle = self.span[0], round((t - self.span[0]) / step)
        for o in OFFSETS:
            for at in (first + (middle - o) * step, first + (middle + o) * step):
                if low < at < high and abs(at - t) > step // 2:
                    chosen.add(at)
        chosen.add(t)
        times = np.array(sorted(chosen), np.int64)
        own = int(np.searchsorted(times, t))
        s, unit = _relative(self.course, times, own)
        at = [
            int(np.searchsorted(times, frames[k]))
            for k in (left - 1, right)
            if 0 <= k < len(frames)
        ]
        before, after = (at[0], at[-1]) if at else (own, own)
        far = np.sort(np.abs(s))
        # At least two instants on either side, where there are.
        horizon = max(NEAREST * step * 1e-6 / unit, float(far[min(4, len(far) - 1)]))
        rest = 0.0
        if len(at) == 1 and left == right:
            rate = self.course.rate(*sorted((int(times[at[0]]), t)))
            rest = 1 / (1 + (rate / RESTING) ** 2)
        horizon = float(min(horizon, 1))
        return Instants(times, own, before, after, s, unit, horizon, self.course, rest)


def speed_of(
    images: Callable[[NDArray[np.int64]], NDArray], times: NDArray[np.int64], lag: int
) -> float:
    """The speed (px/s) of what moves in the smoother's images, (T, H, W) of log intensity.

    Normal flow |dL/dt| / |grad L| between images at `times` and `lag` (us) later, a mean over
    blocks of 4 x 4 pixels by their change; `lag` is shortened until the flow is below 2 px.
    """
    while True:
        both = images(np.concatenate([times, times + lag]))
        early, late = both[: len(times)], both[len(times) :]
        mean = np.pad((early + late) / 2, [(0, 0), (1, 1), (1, 1)], mode="edge")
        gx = (mean[:, 1:-1, 2:] - mean[:, 1:-1, :-2]) / 2
        gy = (mean[:, 2:, 1:-1] - mean[:, :-2, 1:-1]) / 2
        change = np.abs(late - early)
        slope = gx**2 + gy**2
        step, steep, weight = (
            _blocks(part) for part in (change * np.sqrt(slope), slope, change**2)
        )
        weight = weight * (steep > 1e-4)  # what is steeper than 1 % per px
        flow = step / np.maximum(steep, 1e-4)
        moved = float((weight * flow).sum() / max(float(weight.sum()), 1e-12))
        if moved < 2 or lag < 1000:
            return moved / lag * 1e6
        lag //= 2


def _blocks(images: NDArray) -> NDArray:
    h, w = (size // 4 * 4 for size in images.shape[1:])
    return images[:, :h, :w].reshape(len(images), h // 4, 4, w // 4, 4).mean((2, 4))


def room_for(number: int) -> int:
    """The number up to which a target's instants are filled."""
    return -(-number // ROOM) * ROOM


def all_instants(targets: Sequence[Instants]) -> NDArray[np.int64]:
    """Those of all targets (us), sorted; the last one fills them up to a power of two.

    So windows of a fit share their programs, each of which takes 15 s to compile.
    """
    t = np.unique(np.concatenate([one.t for one in targets]))
    return np.pad(t, (0, (1 << (len(t) - 1).bit_length()) - len(t)), mode="edge")
