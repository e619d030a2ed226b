"""Speed of the image from events alone, measured in patches, before any motion is known.

    speed = measure_image_speed(recording)  # None where nothing is seen to move

Methods adapt the lengths of their windows to it (`MotionEstimator.adapt_params`), and models are
compared on patches (`model_selection`). Around some times, the events of a window of duration L are
moved back by every displacement d (px in L) of a grid. The signed image of a patch of 24 px is
sharpest for the true displacement (cf. contrast maximisation). Of windows of many durations, the
sharpest one whose displacement is within the grid determines the speed |d| / L of a patch.

Frames show whether the camera is static. Where it moves, all edges across its motion make events;
where it is static, those of the background make none. So `is_camera_static` counts the strongest
edges of frames that have an event beside them while the image moves by a few pixels.

    flow_consistency(recording)  # whether all parts of the image move as one

Motion models are fitted to patches (`fit_planar`, `fit_rotation`, `fit_general`), each to one half
of the pixels. On the other half, D_p is the log of a patch's sharpness under one model less that
under another. Errors of patches are independent, so z = sum D_p / sqrt(sum D_p^2) is standard
normal where both explain the events alike.
"""

import contextlib
import dataclasses
import functools
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from jaxevent.camera import PinholeCamera
from jaxevent.codegen import njit_noalloc
from jaxevent.deprecated import renamed_fields, renamed_methods, renamed_names
from jaxevent.egomotion.candidates import pixel_coordinates
from jaxevent.egomotion.geometry import rotation_basis
from jaxevent.egomotion.models import Model, Planar, Rotation
from jaxevent.recording import Imu, Recording

PATCH_PX = 24
MAX_GRID_DISPLACEMENT_PX = 7  # of the grid, in x and y
WINDOW_DURATIONS_S = 0.0015625 * 2.0 ** np.arange(11)  # of the windows
N_EVALUATED_TIMES = 6  # at which windows, or frames, are evaluated
MAX_WINDOW_EVENTS = 12_000  # of whole patches
MIN_PATCH_EVENTS = 40
MIN_MEASURED_DISPLACEMENT_PX = 2.5  # shorter ones cannot be distinguished from 0
MIN_RELATIVE_SHARPNESS = (
    1.15  # of a patch's sharpest image, relative to the median of all displacements
)
MIN_AGREEING_FRACTION = 0.2  # fraction of patches whose halves agree; of noise it is 0.1
MIN_MEASURED_PATCHES = 6  # with a speed
PATCH_MARGIN_PX = 6  # of a patch's image around the patch
IMAGE_PIXEL_PX = 2
FRAME_WINDOW_DISPLACEMENT_PX = 5.0  # of the image around a frame whose edges are counted
EDGE_PIXEL_FRACTION = 0.1  # of the pixels, those of the steepest log intensity
DARK_GREY_OFFSET = 0.05  # of full scale, added before the logarithm: darker greys are noise
MIN_GYRO_SPEED_RAD_S = 0.3  # of a camera that turns; biases are up to 0.2
MAX_STATIC_EDGE_FRACTION = 0.3  # fraction of edges with events, below which the camera is static

N_FIT_TIMES = 4  # at which patches are evaluated for fits
MAX_FIT_DISPLACEMENT_PX = 10  # of their grid, in x and y
FIT_WINDOW_DISPLACEMENT_PX = 5.0  # median displacement of the image in a window of a fit
# Positions along a half-line.
HALF_LINE_POSITIONS_PX = np.linspace(0, 1.4 * MAX_FIT_DISPLACEMENT_PX, 29)
N_REFINED_HEADINGS = 6  # from which a general motion is refined
MIN_INCONSISTENCY_Z = 3.0  # from which parts of the image move apart
# Of the model's displacement; a roll moves half of the patches backwards.
TRIED_SPEED_RATIOS = np.concatenate([-np.geomspace(3.0, 0.3, 25), np.geomspace(0.3, 3.0, 25)])
# Ratios half a step to either side of 1 are the two nearest: parts that differ by no more are seen
# to move as the model has it, however significant that difference.
MIN_SPREAD = float(TRIED_SPEED_RATIOS[-1] / TRIED_SPEED_RATIOS[-2] - 1) / 2

# Of `measure_image_speed`: the latest events, sensor and camera, and result.
_latest: tuple[Any, Any, "ImageSpeed | None"] = (lambda: None, None, None)


@renamed_fields(usual="median", at="by_time")
@dataclasses.dataclass(frozen=True)
class ImageSpeed:
    """Speeds of patches of the image.

    Attributes:
        median: Median, px/s.
        slow: Lower quartile, px/s.
        fast: Upper quartile, px/s.
        by_time: Some times (us) with the median at each, px/s; NaN where nothing is seen to move.
    """

    median: float
    slow: float
    fast: float
    by_time: tuple[tuple[int, float], ...]


@renamed_methods(length="duration", ways="displacements")
@dataclasses.dataclass(frozen=True, eq=False)
class PatchSharpness:
    """Sharpness of the patches of a window by displacement, for two halves of the pixels.

    Patches with too few events are left out.
    """

    middle: int  # us, of the window
    duration: float  # s, of the window
    xi: NDArray[np.float64]  # (patches, 2) px, middles from the principal point
    count: NDArray[np.int64]  # (patches,) events
    # (2, patches, n, n) sum of squares of the signed image per event; rows by the displacement in y
    energy: NDArray[np.float64]
    displacements: NDArray[np.float64]  # (n,) px in the window's duration, in x and in y

    @functools.cached_property
    def log_energy(self) -> NDArray[np.float64]:
        """Natural logarithms of `energy`."""
        return np.log(np.maximum(self.energy, 1e-6))


def spread_times(recording: Recording, number: int) -> list[int]:
    """Choose times, spread evenly over the events.

    Args:
        recording: A recording with events.
        number: Number of times.

    Returns:
        The times, us.
    """
    events, n = recording.events, len(recording.events)
    rows = [int(n * (k + 0.5) / number) for k in range(number)]
    return [int(events[row : row + 1].t[0]) for row in rows]


def measure_image_speed(
    recording: Recording, camera: PinholeCamera | None = None
) -> ImageSpeed | None:
    """Measure the speed at which the image moves, in undistorted px/s.

    Windows of 1.6 ms to 1.6 s are evaluated at six times, spread evenly over the events. The latest
    result is cached, because methods, model selection and scores need it one after another.

    Args:
        recording: The recording.
        camera: The camera; by default the recording's.

    Returns:
        The speed, or None where nothing is seen to move.
    """
    sensor = recording.width, recording.height, camera or recording.camera
    global _latest
    events, known_sensor, speed = _latest
    if events() is recording.events and known_sensor == sensor:
        return speed
    speed = _measure_speed(recording, sensor[2])
    with contextlib.suppress(TypeError):  # a user's event source may not allow references
        _latest = weakref.ref(recording.events), sensor, speed
    return speed


def describe_windows(recording: Recording) -> str:
    """Describe the durations of the windows that are evaluated, those that fit, in words."""
    if len(recording.events) < MIN_PATCH_EVENTS:
        return "in so few events"
    fitting = window_durations(recording).tolist()
    if not fitting:
        return "in so short a recording"
    ends = sorted({fitting[0], fitting[-1]})
    words = [f"{1e3 * one:.2g} ms" if one < 0.1 else f"{one:.2g} s" for one in ends]
    return f"in windows of {' to '.join(words)}"


def window_durations(recording: Recording) -> NDArray[np.float64]:
    """Return the durations (s) of windows that fit in a recording, the last one its whole length.

    Of a recording longer than all of them, they are `WINDOW_DURATIONS_S`.
    """
    whole = 1e-6 * (recording.stop - recording.start)
    every = np.asarray(WINDOW_DURATIONS_S, np.float64)
    fitting: NDArray[np.float64] = every[[_is_long_enough(recording, float(one)) for one in every]]
    if whole >= WINDOW_DURATIONS_S[-1] or not len(fitting):
        return fitting
    return np.append(fitting, whole)


def _is_long_enough(recording: Recording, duration: float) -> bool:
    """Return whether the recording is at least as long as a window.

    Args:
        recording: The recording.
        duration: Length of the window, s.

    Returns:
        Whether it is.
    """
    return 2 * round(5e5 * duration) <= recording.stop - recording.start + 1


def _measure_speed(recording: Recording, camera: PinholeCamera | None) -> ImageSpeed | None:
    if len(recording.events) < MIN_PATCH_EVENTS:
        return None
    xi, _ = pixel_coordinates(recording.width, recording.height, camera)
    speeds, by_time, n_patches = [], [], 0
    for middle in spread_times(recording, N_EVALUATED_TIMES):
        best: dict[tuple[float, ...], tuple[float, float]] = {}  # sharpness and speed by position
        for duration in window_durations(recording):
            window = measure_sharpness(
                recording, middle, float(duration), MAX_GRID_DISPLACEMENT_PX, xi
            )
            if window is None:
                continue
            sharpness, size, agree = _best_displacements(window)
            for k, position in enumerate(map(tuple, window.xi.tolist())):
                # At the border of the grid the displacement may be longer still.
                inside = size[k] < MAX_GRID_DISPLACEMENT_PX - 0.5
                if inside and sharpness[k] > best.get(position, (MIN_RELATIVE_SHARPNESS, 0.0))[0]:
                    known = agree[k] and size[k] >= MIN_MEASURED_DISPLACEMENT_PX
                    best[position] = sharpness[k], size[k] / float(duration) if known else 0.0
        here = np.array([speed for _, speed in best.values() if speed > 0])
        n_patches += len(best)
        speeds.append(here)
        by_time.append(
            (middle, float(np.median(here)) if len(here) >= MIN_MEASURED_PATCHES else np.nan)
        )
    speed = np.concatenate(speeds)
    if len(speed) < max(MIN_MEASURED_PATCHES, MIN_AGREEING_FRACTION * n_patches):
        return None
    slow, median, fast = np.percentile(speed, [25, 50, 75])
    return ImageSpeed(float(median), float(slow), float(fast), tuple(by_time))


def _best_displacements(window: PatchSharpness) -> tuple[NDArray, NDArray, NDArray]:
    """Return the best sharpness of patches, its displacement (px), and whether halves agree."""
    n, m = len(window.xi), len(window.displacements)
    halves = window.energy.reshape(2, n, -1)
    energy = halves.mean(0)

    def displacement(best: NDArray) -> NDArray:
        return np.stack([window.displacements[best % m], window.displacements[best // m]], -1)

    difference = displacement(halves[0].argmax(1)) - displacement(halves[1].argmax(1))
    apart = np.hypot(*np.moveaxis(difference, -1, 0))
    sharpness = energy.max(1) / np.maximum(np.median(energy, 1), 1e-9)
    return sharpness, np.hypot(*displacement(energy.argmax(1)).T), apart <= 2


def measure_sharpness(
    recording: Recording,
    middle: int,
    duration: float,
    max_displacement: int,
    xi: NDArray[np.float64],
) -> PatchSharpness | None:
    """Measure the sharpness of the patches of a window.

    Args:
        recording: The recording.
        middle: Middle of the window, us.
        duration: Duration of the window, s.
        max_displacement: Longest displacement in x and y, px.
        xi: (height, width, 2) positions of pixels, see `candidates.pixel_coordinates`.

    Returns:
        The sharpness, or None if no patch has enough events.
    """
    corner = np.floor(xi.min((0, 1)))
    columns = int((xi[..., 0].max() - corner[0]) // PATCH_PX) + 1
    half, index = round(5e5 * duration), recording.events.index
    start, stop = index(middle - half), index(middle + half)
    if stop - start < MIN_PATCH_EVENTS or not _is_long_enough(recording, duration):
        return None
    events = recording.events[start : min(stop, start + 40 * MAX_WINDOW_EVENTS)]
    at = xi[events.y, events.x] - corner
    row, column = (at[:, 1] // PATCH_PX).astype(int), (at[:, 0] // PATCH_PX).astype(int)
    patch = row * columns + column
    count = np.bincount(patch)
    order = np.random.default_rng(0).permutation(len(count))
    order = order[count[order] >= MIN_PATCH_EVENTS]
    if not len(order):
        return None
    n_used = max(1, int((np.cumsum(count[order]) <= MAX_WINDOW_EVENTS).sum()))
    used = np.sort(order[:n_used])
    number = np.full(len(count), -1)
    number[used] = np.arange(len(used))
    keep = number[patch] >= 0
    which = number[patch[keep]]
    halves = (events.x[keep].astype(int) + events.y[keep]) % 2
    of_patches = PatchEvents(
        at[keep] - np.stack([column, row], 1)[keep] * PATCH_PX,
        (events.t[keep] - middle) * 1e-6 / duration,
        np.where(events.p[keep], 1.0, -1.0),
        which,
        halves,
    )
    displacements = np.arange(-max_displacement, max_displacement + 1.0)
    energy = np.zeros((2, len(used), len(displacements), len(displacements)))
    side = (PATCH_PX + 2 * PATCH_MARGIN_PX) // IMAGE_PIXEL_PX
    _accumulate_energy(of_patches, displacements, np.empty((2, len(used), side, side)), energy)
    for k in range(2):
        events_of_half = np.bincount(which[halves == k], minlength=len(used))
        energy[k] /= np.maximum(events_of_half, 1)[:, None, None]
    centre = corner + (np.stack([used % columns, used // columns], 1) + 0.5) * PATCH_PX
    return PatchSharpness(middle, duration, centre, count[used], energy, displacements)


class PatchEvents(NamedTuple):
    """Events of patches.

    Attributes:
        at: (n, 2) positions from the corner of the patch, px.
        since: (n,) times from the middle of the window, in durations.
        sign: (n,) polarities, +1 or -1.
        patch: (n,) index of the patch.
        half: (n,) half of the pixels that the event belongs to, 0 or 1.
    """

    at: NDArray[np.float64]
    since: NDArray[np.float64]
    sign: NDArray[np.float64]
    patch: NDArray[np.int64]
    half: NDArray[np.int64]


@njit_noalloc
def _accumulate_energy(events, displacements, scratch, energy):
    """Compute the sum of squares of patches' signed images for every displacement.

    Args:
        events: Positions, times, signs, patches and halves of events.
        displacements: (n,) displacements along x and along y that are tried, px in the window.
        scratch: (2, patches, side, side) images.
        energy: (2, patches, n, n) output, by half, patch, and displacement along y and x.
    """
    at, since, sign, patch, half = events
    side = scratch.shape[3]
    for row in range(len(displacements)):
        for column in range(len(displacements)):
            scratch[:] = 0
            for e in range(len(at)):
                x = (at[e, 0] - displacements[column] * since[e] + PATCH_MARGIN_PX) / IMAGE_PIXEL_PX
                y = (at[e, 1] - displacements[row] * since[e] + PATCH_MARGIN_PX) / IMAGE_PIXEL_PX
                i, j = int(np.floor(x)), int(np.floor(y))
                if i < 0 or j < 0 or i >= side - 1 or j >= side - 1:
                    continue
                u, v = x - i, y - j
                image = scratch[half[e], patch[e]]
                image[j, i] += sign[e] * (1 - u) * (1 - v)
                image[j, i + 1] += sign[e] * u * (1 - v)
                image[j + 1, i] += sign[e] * (1 - u) * v
                image[j + 1, i + 1] += sign[e] * u * v
            for k in range(2):
                for c in range(energy.shape[1]):
                    total = 0.0
                    for j in range(side):
                        for i in range(side):
                            total += scratch[k, c, j, i] ** 2
                    energy[k, c, row, column] = total


def is_camera_static(recording: Recording, speed: ImageSpeed | None) -> bool:
    """Return whether the edges in the frames make no events.

    Args:
        recording: The recording.
        speed: Speed of the image, or None if it is unknown.

    Returns:
        A boolean; false without frames or a speed.
    """
    fraction = None if speed is None else edge_event_fraction(recording, speed)
    return fraction is not None and fraction < MAX_STATIC_EDGE_FRACTION


def is_camera_known_to_move(recording: Recording, camera: PinholeCamera | None = None) -> bool:
    """Return whether frames or a gyro show that the camera moves.

    Args:
        recording: The recording.
        camera: The camera; by default the recording's.

    Returns:
        A boolean; false where it is not known.
    """
    if recording.imu is not None and gyro_speed(recording.imu) > MIN_GYRO_SPEED_RAD_S:
        return True
    if not recording.frames:
        return False
    fraction = edge_event_fraction(recording, measure_image_speed(recording, camera))
    return fraction is not None and fraction >= MAX_STATIC_EDGE_FRACTION


def gyro_speed(imu: Imu) -> float:
    """Return the root mean square of a gyro's rates, rad/s, of which the least is its bias."""
    return float(np.sqrt((np.asarray(imu.gyro, np.float64) ** 2).sum(1).mean()))


def edge_event_fraction(recording: Recording, speed: ImageSpeed | None = None) -> float | None:
    """Measure the fraction of the strongest edges in frames that have events beside them.

    Args:
        recording: The recording.
        speed: Speed of the image; by default it is measured.

    Returns:
        The median over some frames, or None. It is None where nothing is seen to move, and where no
        frame has edges, and events before and after it while it moves by
        `FRAME_WINDOW_DISPLACEMENT_PX`.
    """
    frames, events = recording.frames, recording.events
    if frames and speed is None:
        speed = measure_image_speed(recording)
    if frames is None or speed is None:
        return None
    half = round(5e5 * FRAME_WINDOW_DISPLACEMENT_PX / speed.median)
    first, last = recording.event_span()
    rows = np.flatnonzero((frames.t - half >= first) & (frames.t + half <= last))
    if not len(rows):
        return None
    rows = np.unique(
        rows[((np.arange(N_EVALUATED_TIMES) + 0.5) * len(rows) / N_EVALUATED_TIMES).astype(int)]
    )
    fractions = []
    for at, image in zip(frames.t[rows].tolist(), frames[rows].intensity, strict=True):
        edges = _find_edges(image)
        if not edges.any():
            continue
        part = events[events.index(at - half) : events.index(at + half)]
        active = np.zeros(edges.shape, bool)
        active[part.y, part.x] = True
        fractions.append(maximum_filter(active, 3)[edges].mean())
    return float(np.median(fractions)) if fractions else None


def _find_edges(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find the pixels of a frame (intensity) where log intensity is steepest."""
    smooth = gaussian_filter(np.log(image + DARK_GREY_OFFSET), 1.0)
    slope = np.hypot(np.gradient(smooth, axis=0), np.gradient(smooth, axis=1))
    return (slope > 0) & (slope >= np.quantile(slope, 1 - EDGE_PIXEL_FRACTION))


@renamed_fields(both="both_directions")
@renamed_methods(several="is_inconsistent")
@dataclasses.dataclass(frozen=True)
class FlowConsistency:
    """Differences between the motions of parts of the image, along the model's direction.

    Attributes:
        spread: Standard deviation of the speeds, relative to their median.
        z: Test statistic of whether they differ.
        slow: 10th percentile of the speeds, px/s.
        fast: 90th percentile of the speeds, px/s.
        both_directions: Whether some parts move backwards.
    """

    spread: float
    z: float
    slow: float
    fast: float
    both_directions: bool

    @property
    def is_inconsistent(self) -> bool:
        """Return whether the image does not move as one."""
        return self.z > MIN_INCONSISTENCY_Z and self.spread > MIN_SPREAD


def flow_consistency(
    recording: Recording,
    model: type[Model] = Planar,
    camera: PinholeCamera | None = None,
    speed: ImageSpeed | None = None,
) -> FlowConsistency | None:
    """Test whether the image moves as one, as planar motion or a rotation does.

    Each patch may move by its own factor of the displacement that the model makes there.

    Args:
        recording: The recording.
        model: `Planar` or `Rotation`.
        camera: The camera; by default the recording's.
        speed: The speed of the image; by default it is measured.

    Returns:
        The consistency, or None where nothing is seen to move, and for other models.
    """
    camera = camera or recording.camera
    if model not in (Planar, Rotation):
        return None
    speed = speed or measure_image_speed(recording, camera)
    if speed is None:
        return None
    _, f = pixel_coordinates(recording.width, recording.height, camera)
    factors = np.append(TRIED_SPEED_RATIOS, 1.0)
    differences, best_factors, speeds = [], [], []
    for window in measure_windows(recording, speed, camera):
        d = fit_planar(window)
        if float(np.hypot(*d)) < 1:
            continue
        displacements = np.tile(d, (len(window.xi), 1))
        if model is Rotation:
            turn = fit_rotation(window, f, d)
            displacements = np.asarray(rotation_basis(window.xi, f)) @ turn
        own = factors[:, None, None] * displacements
        train = log_sharpness(window, 0, own)
        best, rows = train.argmax(0), np.arange(len(window.xi))
        differences.append(
            log_sharpness(window, 1, own[best, rows]) - log_sharpness(window, 1, own[-1])
        )
        gain = train.max(0) - train[-1] + train.max(0) - np.median(train, 0)
        is_sharp = gain > np.log(1.3)
        factor = factors[best][is_sharp]
        best_factors.append(factor)
        speeds.append(np.abs(factor) * np.hypot(*displacements[is_sharp].T) / window.duration)
    if not best_factors or not len(np.concatenate(best_factors)):
        return None
    factor = np.concatenate(best_factors)
    low, high = np.percentile(factor, [16, 84])
    slow, fast = np.percentile(np.concatenate(speeds), [10, 90])
    median = float(np.median(np.abs(factor)))
    spread = float((high - low) / 2 / max(median, 1e-9))
    z = z_score(np.concatenate(differences))
    return FlowConsistency(spread, z, float(slow), float(fast), bool(low < 0))


def measure_windows(
    recording: Recording, speed: ImageSpeed, camera: PinholeCamera | None = None
) -> list[PatchSharpness]:
    """Evaluate patches at some times, in windows in which the image moves by a few px.

    Args:
        recording: The recording.
        speed: Speed of the image.
        camera: The camera; by default the recording's.

    Returns:
        The windows that hold enough events.
    """
    windows = []
    xi, _ = pixel_coordinates(recording.width, recording.height, camera or recording.camera)
    for middle in spread_times(recording, N_FIT_TIMES):
        near = [(abs(t - middle), v) for t, v in speed.by_time if np.isfinite(v)]
        here = min(near)[1] if near else speed.median
        durations = window_durations(recording)
        if not len(durations):
            return windows
        ratio = durations * here / FIT_WINDOW_DISPLACEMENT_PX
        duration = durations[np.abs(np.log(ratio)).argmin()]
        window = measure_sharpness(recording, middle, float(duration), MAX_FIT_DISPLACEMENT_PX, xi)
        if window is not None:
            windows.append(window)
    return windows


def log_sharpness(
    window: PatchSharpness, half: int, displacements: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate the log of the sharpness of patches.

    Args:
        window: The patches.
        half: Half of the pixels, 0 or 1.
        displacements: (..., patches, 2) displacements, px.

    Returns:
        (..., patches) values.
    """
    at = np.clip(displacements + MAX_FIT_DISPLACEMENT_PX, 0, 2 * MAX_FIT_DISPLACEMENT_PX)
    patch = np.broadcast_to(np.arange(len(window.xi)), at.shape[:-1])
    values = window.log_energy[half]
    return map_coordinates(values, [patch, at[..., 1], at[..., 0]], order=1, mode="nearest")


def _minimise(loss: Callable[[NDArray], float], starts: list[NDArray], size: float) -> NDArray:
    """Minimise a loss from several starts by the method of Nelder and Mead.

    Args:
        loss: Function of (n,).
        starts: Arguments to start from, each (n,).
        size: Size of the first simplexes.

    Returns:
        (n,) the best argument.
    """
    from scipy.optimize import minimize

    options = {"maxiter": 250, "xatol": 1e-3 * size, "fatol": 1e-3}
    found = []
    for start in starts:
        simplex = np.concatenate([start[None], start + size * np.eye(len(start))])
        options["initial_simplex"] = simplex
        found.append(minimize(loss, start, method="Nelder-Mead", options=options))
    return min(found, key=lambda one: one.fun).x


def fit_planar(window: PatchSharpness) -> NDArray[np.float64]:
    """Fit one displacement (2,) in px to all patches."""
    n = len(window.displacements)
    sums = window.log_energy[0].sum(0)
    row, column = divmod(int(sums.argmax()), n)
    start = window.displacements[[column, row]]

    def loss(d: NDArray) -> float:
        return -float(log_sharpness(window, 0, np.tile(d, (len(window.xi), 1))).sum())

    return _minimise(loss, [start], 0.5)


def fit_rotation(
    window: PatchSharpness, f: float, planar: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fit a rotation to the patches.

    Args:
        window: The patches.
        f: Focal length, px.
        planar: (2,) displacement of all patches, px, from which the fit starts.

    Returns:
        (3,) rotation vector over the window, rad.
    """
    basis = np.asarray(rotation_basis(window.xi, f))
    first = np.array([planar[1] / f, -planar[0] / f, 0.0])
    roll = 2.0 / max(float(np.hypot(*window.xi.T).mean()), 1.0)
    starts = [first + np.array([0, 0, k * roll]) for k in (-2, 0, 2)]
    starts.append(np.zeros(3))
    unit = np.array([1 / f, 1 / f, roll / 2])

    def loss(v: NDArray) -> float:
        return -float(log_sharpness(window, 0, basis @ (v * unit)).sum())

    return _minimise(loss, [one / unit for one in starts], 1.0) * unit


def refine_rotation(
    window: PatchSharpness, basis: NDArray[np.float64], turn: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Refine a rotation whose displacements are linear.

    Args:
        window: The patches.
        basis: (patches, 2, 3) displacements per rad, px.
        turn: (3,) rotation vector over the window at the start, rad.

    Returns:
        (3,) rotation vector, rad.
    """
    unit = 1 / np.sqrt(np.maximum((basis**2).sum(1).mean(0), 1e-12))

    def loss(v: NDArray) -> float:
        return -float(log_sharpness(window, 0, basis @ (v * unit)).sum())

    return _minimise(loss, [turn / unit], 1.0) * unit


def half_line_displacements(
    window: PatchSharpness, f: float, T: NDArray, turn: NDArray
) -> NDArray[np.float64]:
    """Return displacements along the half-lines of a general motion.

    Args:
        window: The patches.
        f: Focal length, px.
        T: (3,) heading.
        turn: (3,) rotation vector over the window, rad.

    Returns:
        (positions, patches, 2) displacements, px.
    """
    base = np.asarray(rotation_basis(window.xi, f)) @ turn
    line = np.einsum("pij,j->pi", _translation_basis(window.xi, f), T)
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
    return base + HALF_LINE_POSITIONS_PX[:, None, None] * line


def _translation_basis(xi: NDArray[np.float64], f: float) -> NDArray[np.float64]:
    """Return `geometry.A` at some positions.

    Args:
        xi: (n, 2) positions, px.
        f: Focal length, px.

    Returns:
        (n, 2, 3).
    """
    columns = np.zeros((len(xi), 2, 3))
    columns[:, 0, 0] = columns[:, 1, 1] = -f
    columns[:, :, 2] = xi
    return columns


def fit_general(window: PatchSharpness, f: float, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a general motion, with the best position along its half-line for each patch.

    Args:
        window: The patches.
        f: Focal length, px.
        turn: (3,) rotation vector over the window from which the fit starts, rad.

    Returns:
        (6,) heading and rotation vector over the window, rad.
    """
    columns = _translation_basis(window.xi, f)
    basis = np.asarray(rotation_basis(window.xi, f))

    def displacements(v: NDArray) -> NDArray:
        line = columns @ v[:3]
        line = line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
        return basis @ (v[3:] / f) + HALF_LINE_POSITIONS_PX[:, None, None] * line

    def loss(v: NDArray) -> float:
        size = float(np.linalg.norm(v[:3]))
        best = log_sharpness(window, 0, displacements(v)).max(0)
        return -float(best.sum()) + 10 * (size - 1) ** 2

    headings = np.random.default_rng(0).normal(size=(40, 3))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    headings = np.concatenate([headings, np.eye(3), -np.eye(3)])
    starts = [np.append(T, factor * f * turn) for T in headings for factor in (0.0, 0.5, 1.0)]
    starts = sorted(starts, key=loss)[:N_REFINED_HEADINGS]
    found = _minimise(loss, starts, 0.3)
    return np.append(found[:3] / np.linalg.norm(found[:3]), found[3:] / f)


def z_score(D: NDArray[np.float64]) -> float:
    """Return the sum of independent differences, relative to its standard deviation."""
    size = float(np.sqrt((D**2).sum()))
    return float(D.sum()) / size if size > 0 else 0.0


__getattr__ = renamed_names(__name__)
