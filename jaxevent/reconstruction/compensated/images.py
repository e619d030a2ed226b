"""Images at single instants, and how the brightness of frames changes without events.

Automatic exposure and flicker change frames without events. Such frames show the same points with
other values, so they do not agree along any trajectory. They do agree once the part that varies
slowly over the image is subtracted. Around frames that are not steady, images are compared and
fused without that smooth part. The result gets the smooth part of the smoother's image at the
target, which blends from one frame to the next. Beyond the first and the last frame that image
drifts with the events, so brightness is that of the nearest frame along trajectories. If only that
frame is an exception, as the two next to it are alike, brightness becomes theirs within one
interval of frames.

Frames are steady if pixels without events around them keep their values: such pixels show no change
of the scene. If some frames are brighter than those before and after, an image between frames may
be brighter, too, and nothing determines by how much. The variance of the brightness is then
estimated by predicting each nearby frame from its neighbours.
"""

import collections
import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.calibration.light import common_change
from jaxevent.codegen import njit_noalloc, njit_noalloc_inlined
from jaxevent.estimator import Estimate
from jaxevent.precision import full_precision
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.robust_mean import InstantLayout
from jaxevent.reconstruction.compensated.warp import PathTimes, path_positions, sample_bilinear
from jaxevent.reconstruction.features import FrameFeatures, Numeric
from jaxevent.reconstruction.frames import FrameImages
from jaxevent.reconstruction.smoother import FrameMeasurements, Gaussian, Smoother
from jaxevent.reconstruction.stream import count_events_per_pixel
from jaxevent.recording import Recording

N_CACHED_IMAGES = 96  # images at instants that a video keeps
SMOOTH_PART_SIGMA_PX = 12.0  # of the Gaussian blur whose result is the smooth part
MIN_UNSTEADY_CHANGE = 0.05  # ln I, smallest change between frames that are not steady
MEDIAN_BLOCK_PX = 16  # side of the blocks whose median change is taken
MIN_BLOCK_PIXELS, MIN_BLOCKS = 8, 4  # least pixels without events in a block, least such blocks
MAX_BRIGHTNESS_FRAMES = 8  # on either side, from which the variance of brightness is estimated
# For independent brightnesses of variance v, the squared difference of two has the mean 2 v, and
# that of one from the mean of two others has 3 v / 2: the ratio of the second to the first.
MIDPOINT_VARIANCE_FACTOR = 0.75
UNCLIPPED_GREY_RANGE = (0.02, 0.98)  # grey values of pixels that are not clipped


class FrameLevels(NamedTuple):
    """Log intensity of frames at the middle of their exposures."""

    z: Float[Array, "*frames pixels"]  # log intensity
    V: Float[Array, "*frames pixels"]  # its variance
    clear: Float[Array, "*frames pixels"]  # 1 where the pixel is unclipped


@dataclasses.dataclass(frozen=True, repr=False)
class InstantSmoother(Smoother[Params]):
    """Smoother whose image at the middle of an exposure is that frame itself.

    An image is log intensity L, its variance V, and whether a frame shows the pixel unclipped. The
    smoother weighs a frame by a noise model made for integrating events. At the middle of an
    exposure the frame itself is more accurate: it has the variance
    (sigma_pixel / (I + I0))^2 + 1e-4, and is deblurred as far as events determine it.
    """

    adds_unseen_errors: ClassVar[bool] = False  # the fusion estimates its own variance

    def readout_inputs(
        self, params: Params, frames: FrameFeatures, measured: FrameMeasurements, events: Any
    ) -> FrameLevels:
        z, V = measured.z, (params.sigma_pixel * measured.slope) ** 2 + 1e-4
        if events is not None:
            blurred = jnp.log(frames.intensity + params.I0)
            change = z - blurred
            # The events' correction has an error of about a threshold and their noise. Where it is
            # smaller than this error, the blurred frame is closer to the truth.
            error = params.c_on * params.c_off * (0.25 + params.sigma_event**2 * events / 3)
            trust = change**2 / (change**2 + error)
            z, V = blurred + trust * change, V + trust * error
        return FrameLevels(z, V, measured.clear)

    def readout(self, params: Params, state: Gaussian, info: FrameLevels, here: Array) -> Estimate:
        """Read images at times; where a frame shows the pixel at that time, from the frame.

        Args:
            params: Parameters of `mc`.
            state: (times, pixels) log intensity of the smoother.
            info: (times, pixels) log intensity of the previous frame.
            here: (times, 1) whether the time is the middle of that frame's exposure.

        Returns:
            Log intensity, its variance, (ln I)^2, and whether a frame shows the pixel unclipped.
        """
        L = jnp.log(jnp.maximum(jnp.exp(state.m) - params.I0, 0) + params.I0)
        shown = here & (info.clear > 0.5)
        V = jnp.where(shown, jnp.minimum(state.P, info.V), state.P)
        return Estimate(jnp.where(shown, info.z, L), V, shown)


instant_smoother = InstantSmoother("instant-smoother", Params, fuses=False)


class InstantImages:
    """The smoother's images at any instants of a recording, with a cache of the latest ones.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        window_events: Events per window of the smoother.
        factors: (2, pixels) factors on the ON and OFF thresholds of pixels; None for 1.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params,
        window_events: int,
        factors: NDArray[np.floating] | None = None,
    ):
        self.factors = factors
        self._video = instant_smoother.estimate(
            recording, params, window_events=window_events, progress=False, factors=factors
        )
        self._cache: collections.OrderedDict[int, Estimate] = collections.OrderedDict()

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self._video.recording.height, self._video.recording.width

    def __call__(self, times: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return L, V and clear, each (times, h, w) float32, at sorted times (us)."""
        chosen = self._read(times)
        L, V, clear = (np.stack(part) for part in zip(*chosen, strict=True))
        return L, V, clear

    def cache_images(self, times: NDArray[np.int64]) -> None:
        """Read images at sorted times (us) into the cache, in one pass, before they are needed."""
        self._read(times)

    def log_images(self, times: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return L alone (times, h, w) at sorted times (us)."""
        return np.stack([one.mean for one in self._read(times)])

    def _read(self, times: NDArray[np.int64]) -> list[Estimate]:
        missing = np.array([t for t in times.tolist() if t not in self._cache], np.int64)
        for t in times.tolist():
            if t in self._cache:
                self._cache.move_to_end(t)
        for batch, part in self._video.batches(missing, extrapolate=True):
            for n, t in enumerate(batch.tolist()):
                self._cache[t] = Estimate(*(np.array(v[n], np.float32) for v in part))
        while len(self._cache) > max(N_CACHED_IMAGES, len(times)):
            self._cache.popitem(last=False)
        return [self._cache[t] for t in times.tolist()]


@functools.cache
def _averages(size: int, sigma: float) -> NDArray[np.float32]:
    """Make the matrix that blurs along an axis, normalised at the borders.

    Args:
        size: Length of the axis, px.
        sigma: Standard deviation of the Gaussian, px.

    Returns:
        (size, size); each row sums to 1.
    """
    at = np.arange(size)
    weights = np.exp(-0.5 * ((at[:, None] - at) / sigma) ** 2)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


@full_precision
def gaussian_blur(L: Any, sigma_px: float = SMOOTH_PART_SIGMA_PX) -> Any:
    """Blur images by a Gaussian.

    Args:
        L: (..., h, w) images, of NumPy or JAX.
        sigma_px: Standard deviation of the Gaussian, px.

    Returns:
        (..., h, w).
    """
    return _averages(L.shape[-2], sigma_px) @ L @ _averages(L.shape[-1], sigma_px).T


class BrightnessPrior(NamedTuple):
    """Brightness at a time relative to the nearest frames, each ()."""

    variance: Numeric  # (ln I)^2, of the part that no frame determines
    offset: Numeric  # ln I, to add to the nearest frame; 0 between frames


def smooth_part_at_target(
    smooth: Numeric, layout: InstantLayout, weight: Numeric, paths: Numeric, prior: BrightnessPrior
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Return the smooth part of the target's image, ln I, and its variance.

    Between two frames nothing determines which of the two has the brightness of the target.

    Args:
        smooth: (K, h, w) smooth parts of the images at the target's instants.
        layout: The instants.
        weight: (), weight of the later of the two frames around the target, 0..1.
        paths: (h, w, 4) paths, px, used where all frames are on one side of the target.
        prior: Brightness at the target.

    Returns:
        The smooth part (h, w) and its variance (h, w), (ln I)^2.
    """
    nearest = jnp.asarray(smooth)[layout.before][None]
    frame = PathTimes(*(jnp.asarray(part)[layout.before][None] for part in layout.path_times))
    Y, X = path_positions(jnp.asarray(paths), frame)
    beyond = sample_bilinear(nearest, Y, X)[0] + prior.offset
    difference = smooth[layout.after] - smooth[layout.before]
    variance = jnp.maximum(weight * (1 - weight) * difference**2, prior.variance)
    one_sided = layout.before == layout.after
    return jnp.where(one_sided, beyond, smooth[layout.target]), variance


def are_equally_bright(L: NDArray[np.floating]) -> bool:
    """Return whether images show the scene under the same light.

    Motion brightens some blocks of pixels and darkens others; a change of light acts on all alike.
    Light has changed if the median of the blocks' changes exceeds the limit, and exceeds what
    their scatter explains.

    Args:
        L: (n, h, w) log intensity.

    Returns:
        Whether they are equally bright.
    """
    h, w = (length // MEDIAN_BLOCK_PX for length in L.shape[1:])
    if h * w < MIN_BLOCKS:
        return True
    cut = L[:, : h * MEDIAN_BLOCK_PX, : w * MEDIAN_BLOCK_PX]
    means = cut.reshape(len(L), h, MEDIAN_BLOCK_PX, w, MEDIAN_BLOCK_PX).mean((2, 4))
    level = common_change((means - means[len(L) // 2]).reshape(len(L), -1))
    return bool((np.abs(level) < MIN_UNSTEADY_CHANGE).all())


class FrameBrightness:
    """Changes of the brightness of a recording's frames that events do not show.

    Args:
        recording: The recording.
        mid: (frames,) times of the frames, us.
        I0: Offset inside the logarithm.
    """

    def __init__(self, recording: Recording, mid: NDArray[np.int64], I0: float):
        self._recording, self._mid, self._I0 = recording, mid, I0
        self._images = FrameImages(recording, np.dtype(np.float32))
        self._changes: dict[int, float] = {}

    def is_steady(self, first_us: int, last_us: int) -> bool:
        """Return whether all frames between two times are equally bright.

        Changes of a fading light are small from frame to frame, so they are summed.

        Args:
            first_us: First time, us; a frame at it counts.
            last_us: Last time, us, likewise.

        Returns:
            Whether the brightness stays within `MIN_UNSTEADY_CHANGE`.
        """
        low = int(np.searchsorted(self._mid, first_us, "left"))
        high = int(np.searchsorted(self._mid, last_us, "right"))
        level = np.cumsum([0.0, *(self._change(k) for k in range(low, high - 1))])
        return float(np.ptp(level)) < MIN_UNSTEADY_CHANGE

    def prior(self, t_us: int) -> BrightnessPrior:
        """Return the prior of the brightness at a time (us)."""
        return BrightnessPrior(np.float32(self.variance(t_us)), np.float32(self._offset(t_us)))

    def _offset(self, t: int) -> float:
        """Return the brightness (ln I) to add to the nearest frame; 0 between frames."""
        mid = self._mid
        if len(mid) < 3 or mid[0] <= t <= mid[-1]:
            return 0.0
        if t < mid[0]:
            change, next_change = self._change(0), self._change(1)
            distance, interval = mid[0] - t, mid[1] - mid[0]
        else:
            change, next_change = -self._change(len(mid) - 2), self._change(len(mid) - 3)
            distance, interval = t - mid[-1], mid[-1] - mid[-2]
        if abs(change) < MIN_UNSTEADY_CHANGE or abs(next_change) >= MIN_UNSTEADY_CHANGE:
            return 0.0
        return change * min(1.0, float(distance / interval))

    def variance(self, t_us: int) -> float:
        """Return the variance (ln I)^2 of the brightness at a time (us).

        It is 0 at the frames and largest halfway between two, and beyond the last and the first.
        """
        right = int(np.searchsorted(self._mid, t_us, "right"))
        left = int(np.searchsorted(self._mid, t_us, "left"))
        low, high = (
            max(left - MAX_BRIGHTNESS_FRAMES, 0),
            min(right + MAX_BRIGHTNESS_FRAMES, len(self._mid)),
        )
        if left < right or high - low < 2:
            return 0.0
        mid = (self._mid[low:high] - t_us) * 1e-6
        level = np.cumsum([0.0, *(self._change(k) for k in range(low, high - 1))])
        between = low < right < high
        if high - low > 2:
            w = (mid[1:-1] - mid[:-2]) / (mid[2:] - mid[:-2])
            error, factor = level[1:-1] - (1 - w) * level[:-2] - w * level[2:], 1.0
        else:
            error, factor = level[1:], MIDPOINT_VARIANCE_FACTOR if between else 1.0
        variance = factor * float(
            (np.where(np.abs(error) < MIN_UNSTEADY_CHANGE, 0, error) ** 2).mean()
        )
        if not between:
            return variance
        w = -mid[left - 1 - low] / (mid[right - low] - mid[left - 1 - low])
        return float(variance * 4 * w * (1 - w))

    def _change(self, frame: int) -> float:
        """Return the change of ln(I + I0) from a frame to the next; it is cached."""
        if frame not in self._changes:
            self._changes[frame] = self._measure_change(frame)
        return self._changes[frame]

    def _measure_change(self, frame: int) -> float:
        """Measure the change of ln(I + I0) to the next frame: a median of blocks without events."""
        source, size = self._recording.events, (self._recording.height, self._recording.width)
        begin, end = (source.index(int(t)) for t in self._mid[frame : frame + 2])
        grey, intensity, _, _ = self._images.read(slice(frame, frame + 2), 2)
        events = source[begin:end]
        counts = count_events_per_pixel(events.x, events.y, size[1], size[0] * size[1])
        h, w = (length // MEDIAN_BLOCK_PX for length in size)
        number = np.zeros((h, w), np.int64)
        found = np.full((h, w, MEDIAN_BLOCK_PX**2), np.inf, np.float32)
        pair = grey.reshape(2, *size), intensity.reshape(2, *size)
        _list_quiet_changes(pair, counts.reshape(size), np.float32(self._I0), number, found)
        chosen = number >= MIN_BLOCK_PIXELS
        number, found = number[chosen], np.sort(found[chosen], axis=1)
        rows = np.arange(len(number))
        changes = (found[rows, (number - 1) // 2] + found[rows, number // 2]) / 2
        return float(np.median(changes)) if len(changes) >= MIN_BLOCKS else 0.0


@njit_noalloc_inlined
def _is_quiet(counts, y, x):
    """Return whether a pixel and its eight neighbours have no events.

    Args:
        counts: (h, w) events of pixels.
        y: Row of the pixel.
        x: Column of the pixel.
    """
    if counts[y, x] != 0:
        return False
    h, w = counts.shape
    for i in range(max(y - 1, 0), min(y + 2, h)):
        for j in range(max(x - 1, 0), min(x + 2, w)):
            if counts[i, j] != 0:
                return False
    return True


@njit_noalloc
def _list_quiet_changes(frames, counts, I0, number, found):
    """List, for each block, the changes of ln(I + I0) of its quiet and unclipped pixels.

    Args:
        frames: Grey values and intensities of two frames, (2, h, w) each.
        counts: (h, w) events of each pixel between them.
        I0: Offset inside the logarithm.
        number: (rows, columns) of blocks, output: number of changes.
        found: (rows, columns, pixels) output: changes.
    """
    (grey, intensity), size = frames, MEDIAN_BLOCK_PX
    black, white = np.float32(UNCLIPPED_GREY_RANGE[0]), np.float32(UNCLIPPED_GREY_RANGE[1])
    for y in range(len(number) * size):
        for x in range(number.shape[1] * size):
            if not _is_quiet(counts, y, x):
                continue
            low, high = min(grey[0, y, x], grey[1, y, x]), max(grey[0, y, x], grey[1, y, x])
            if low > black and high < white:
                i, j = y // size, x // size
                change = np.log(intensity[1, y, x] + I0) - np.log(intensity[0, y, x] + I0)
                found[i, j, number[i, j]] = change
                number[i, j] += 1
