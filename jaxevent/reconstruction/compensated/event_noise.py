"""Noise of events in excess of the model's, measured by the change between frames.

Events that are lost, of wrong sign, at another place or at another time do not add up to the change
between two frames. Between the frames k and k + 1, for every pixel,

    e = L[k + 1] - L[k] - (c_on n_on - c_off n_off),

without the part that varies slowly over the image, which is of the frames' brightness. Its expected
square v is the sum of the variances of both frames, of the steps of events and of the drift. Around
a pixel,

    factor = max(<e^2> / <v>, 1)^2,    excess = (factor - 1) <v>,

where < > is a mean with Gaussian weights over the pixels that both frames show unclipped. Images at
instants between the frames have the variance V factor + excess w (1 - w), with the instant's place
0 <= w <= 1 in the interval: V is the smoother's, and w (1 - w) the shape of the variance of a sum
of steps between two known ends. So images at the frames keep theirs. The square makes events that
are slightly worse than expected count nearly as before, and faulty ones hardly at all.

The trust in the events of an interval is the mean of 1 / factor, weighted by <v>.
"""

import collections
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from jaxevent.reconstruction.compensated.images import InstantImages, gaussian_blur
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.stream import count_polarities
from jaxevent.recording import Recording

REGION_SIGMA_PX = 8.0  # of the Gaussian of the mean around a pixel
N_CACHED_INTERVALS = 16
EXTRAPOLATION_SHAPE = np.float32(0.25)  # w (1 - w) before the first and after the last frame


class IntervalNoise(NamedTuple):
    """Noise of the events between two frames in excess of the model's."""

    factor: Float[Numeric, "*intervals h w"]  # on the variance of images between the frames
    excess: Float[Numeric, "*intervals h w"]  # added to it halfway, times 4, (ln I)^2
    trust: Float[Numeric, "*intervals"]  # 0..1


class NoiseParams(NamedTuple):
    """Parameters of `mc` that the expected noise of events depends on.

    Attributes:
        c_on: Contrast threshold of ON events, ln I.
        c_off: Contrast threshold of OFF events, ln I.
        sigma_event: Noise of an event's step, relative to its threshold.
        sigma_bg: Drift without events, ln I / sqrt(s).
        share: Fraction of an event's change that belongs to its 8 neighbours.
    """

    c_on: Numeric | float
    c_off: Numeric | float
    sigma_event: Numeric | float
    sigma_bg: Numeric | float
    share: Numeric | float

    @classmethod
    def of(cls, params: Params, convert: Callable[[Any], Any] = float) -> "NoiseParams":
        """Take the parameters of the noise from those of `mc`.

        Args:
            params: Parameters of `mc`.
            convert: Conversion of each number.

        Returns:
            The parameters.
        """
        return cls(*(convert(getattr(params, name)) for name in cls._fields))


class IntervalEvents(NamedTuple):
    """Events of intervals between frames, from which their noise is measured."""

    ends: Int[Numeric, "*intervals 2"]  # rows, among images, of the frames before and after
    counts: Float[Numeric, "*intervals 2 h w"]  # ON and OFF events
    seconds: Float[Numeric, "*intervals"]


class IntervalPositions(NamedTuple):
    """Positions of instants in the intervals between frames."""

    interval: Int[Numeric, " k"]  # index of the frame before, of the nearest interval beyond
    shape: Float[Numeric, " k"]  # w (1 - w); 0 at frames

    def between_frames(self) -> NDArray[np.int64]:
        """Return the intervals that hold instants other than frames, at least one."""
        inside = np.asarray(self.interval)[np.asarray(self.shape) > 0]
        return np.unique(inside if len(inside) else self.interval[:1])


def inflate_variances(V: Numeric, noise: IntervalNoise, shape: Numeric) -> Numeric:
    """Inflate the variances of images between frames by the noise of their events.

    Args:
        V: (K, h, w) variances, (ln I)^2.
        noise: Noise of the intervals of the K images.
        shape: (K,) as of `IntervalPositions`.

    Returns:
        (K, h, w), those of images at frames as they are.
    """
    shape = shape[:, None, None]
    return V * jnp.where(shape > 0, noise.factor, 1) + noise.excess * shape


def measure_noise(
    params: NoiseParams, images: tuple[Any, Any, Any], counts: Any, seconds: Any
) -> IntervalNoise:
    """Measure the noise of the events between two frames; differentiable.

    Args:
        params: Parameters.
        images: L, V and clear at both frames, each (..., 2, h, w), of NumPy or JAX.
        counts: (..., 2, h, w) ON and OFF events between the frames.
        seconds: (...) time between the frames, s.

    Returns:
        The noise, of float32 for NumPy.
    """
    L, V, clear = images
    counts = _share_out(counts, params.share)
    up, down = params.c_on * counts[..., 0, :, :], params.c_off * counts[..., 1, :, :]
    steps = params.sigma_event**2 * (params.c_on * up + params.c_off * down)
    drift = (params.sigma_bg**2 * seconds)[..., None, None]
    both = clear[..., 0, :, :] * clear[..., 1, :, :]
    change = L[..., 1, :, :] - L[..., 0, :, :]
    e = both * (change - (up - down)).astype(L.dtype)
    e = e - both * gaussian_blur(e) / gaussian_blur(both).clip(1e-6)
    v = gaussian_blur(both * (steps + drift + V.sum(-3)).astype(L.dtype), REGION_SIGMA_PX)
    factor = (gaussian_blur(e * e, REGION_SIGMA_PX) / v.clip(1e-9)).clip(1) ** 2
    trust = (v / factor).sum((-2, -1)) / v.sum((-2, -1)).clip(1e-12)
    return IntervalNoise(factor, (factor - 1) * v, trust)


class EventNoise:
    """Noise of the events between a recording's frames: `noise = event_noise(interval)`.

    Args:
        recording: The recording.
        params: Parameters of `mc`.
        images: Images at instants.
        frames: (frames,) times of frames, us.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params,
        images: InstantImages,
        frames: NDArray[np.int64],
    ):
        self._recording, self._params, self._images = recording, params, images
        self._frames = frames
        self._cache: collections.OrderedDict[int, IntervalNoise] = collections.OrderedDict()

    def locate(self, times: NDArray[np.int64]) -> IntervalPositions:
        """Locate times (us) between the frames."""
        frames, last = self._frames, max(len(self._frames) - 2, 0)
        interval = (np.searchsorted(frames, times, "right") - 1).clip(0, last)
        if not last and len(frames) < 2:
            return IntervalPositions(interval, np.full(len(times), EXTRAPOLATION_SHAPE))
        begin, end = frames[interval], frames[interval + 1]
        w = ((times - begin) / (end - begin)).astype(np.float32)
        shape = np.where((times < begin) | (times > end), EXTRAPOLATION_SHAPE, w * (1 - w))
        return IntervalPositions(interval, shape)

    def __call__(self, interval: int) -> IntervalNoise:
        """Return the noise of the events after a frame, by the index of the frame."""
        if interval in self._cache:
            self._cache.move_to_end(interval)
        else:
            self._cache[interval] = self._measure_interval(interval)
            if len(self._cache) > N_CACHED_INTERVALS:
                self._cache.popitem(last=False)
        return self._cache[interval]

    def trust(self, t: int) -> float:
        """Return the trust in the events at a time (us), 0..1."""
        return float(self(int(self.locate(np.array([t])).interval[0])).trust)

    def inflate(self, times: NDArray[np.int64], V: NDArray[np.float32]) -> None:
        """Inflate the variances of images by the noise of their events, in place.

        Args:
            times: (K,) times of the images, us.
            V: (K, h, w) variances, (ln I)^2, float32.
        """
        for k, (interval, shape) in enumerate(zip(*self.locate(times), strict=True)):
            if shape > 0:
                noise = self(int(interval))
                V[k] *= noise.factor
                V[k] += shape * noise.excess

    def _measure_interval(self, interval: int) -> IntervalNoise:
        size = self._images.image_shape
        if len(self._frames) < 2:
            return IntervalNoise(np.ones(size, np.float32), np.zeros(size, np.float32), 1.0)
        begin, end = self._frames[interval : interval + 2].tolist()
        images = self._images(np.array([begin, end]))
        params, counts = NoiseParams.of(self._params), self._count_events(interval)
        return measure_noise(params, images, counts, np.float64((end - begin) * 1e-6))

    def _count_events(self, interval: int) -> NDArray[np.float64]:
        """Count the ON and OFF events between two frames, (2, h, w), in common thresholds."""
        rho_us = 1e6 * float(self._params.rho_ref)
        begin, end = self._frames[interval : interval + 2].tolist()
        counts = count_polarities(self._recording, begin, end, rho_us)
        if self._images.factors is not None:
            counts = counts * self._images.factors
        return counts.reshape(2, *self._images.image_shape)

    def events(self, intervals: NDArray[np.int64], times: NDArray[np.int64]) -> IntervalEvents:
        """Return what `measure_noise` needs of some intervals beside images.

        Args:
            intervals: (n,) indices of the frames before.
            times: (images,) sorted times of images, us; those of frames at either end are there.

        Returns:
            The events; of a recording with a single frame none, and that frame at both ends.
        """
        ends = self._frames[np.minimum(intervals[:, None] + np.arange(2), len(self._frames) - 1)]
        counts = np.zeros((len(intervals), 2, *self._images.image_shape), np.float32)
        if len(self._frames) > 1:
            counts[:] = [self._count_events(k) for k in intervals.tolist()]
        seconds = (np.diff(ends)[:, 0] * 1e-6).astype(np.float32)
        return IntervalEvents(np.searchsorted(times, ends).astype(np.int32), counts, seconds)


def _share_out(counts: Any, share: Numeric | float) -> Any:
    """Share counts of events out between pixels and their 8 neighbours.

    Args:
        counts: (..., h, w) events, of NumPy or JAX.
        share: Fraction of each event that goes to the neighbours, 0..1.

    Returns:
        (..., h, w); what would go beyond the border is lost.
    """
    widths = [(0, 0)] * (counts.ndim - 2) + [(1, 1), (1, 1)]
    padded = counts.__array_namespace__().pad(counts, widths)
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    around = rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:] - counts
    return (1 - share) * counts + share * around / 8
