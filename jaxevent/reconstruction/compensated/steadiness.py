"""Frames whose brightness changes where no events tell of it: an exposure that adapts, or flicker.

Such frames show the same points with other values, so they do not agree along any trajectory. What
they have in common is all that is left when what varies slowly over the image is taken away. So
where frames around a target are not steady its images are compared and fused without their smooth
part, and the result is given that of the smoother's image at the target, which goes from frame to
frame as a blend does. Beyond the frames it drifts with the events, and brightness is that of the
nearest frame along trajectories. Where that one is the exception, since the two next to it are
alike, brightness becomes theirs within an interval of frames.

Steadiness is told by pixels without events around them between two frames: a change there is none
of the scene. On slider_depth and davis346_street the median change of blocks of such pixels is
below 0.01 of ln I between any two frames, in evbench_seq3 with its three bright frames 0.1 to 0.4.

Where some frames are brighter than those before and after, an image between frames may be so, too,
and nothing tells. How much brightness is in doubt is how badly those of the frames around, left out
one by one, follow from their neighbours. Of two frames either follows from the other alone.
"""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from jaxevent.devices import full_precision
from jaxevent.reconstruction.compensated.agreement import Place
from jaxevent.reconstruction.compensated.warping import places, sample
from jaxevent.reconstruction.features import Numeric
from jaxevent.reconstruction.frames import FrameImages
from jaxevent.recording import Recording

REACH = 12.0  # px, of the Gaussian that leaves the smooth part
LEAST = 0.05  # ln I, by which frames differ that are not steady
BLOCK = 16  # px, over which the change of pixels without events is a median
ENOUGH = 8  # such pixels in a block
BLOCKS = 4  # such blocks at least
AROUND = 8  # frames on either side, whose brightness tells how far it is in doubt
# Of independent brightnesses of variance v two differ by 2 v, squared, and one from the mean of two
# others by 3 v / 2.
HALFWAY = 0.75
SHOWN = (0.02, 0.98)  # grey values of pixels that are not clipped


@functools.cache
def _averages(size: int, reach: float) -> NDArray[np.float32]:
    """The matrix that blurs an axis; at the border by what is inside."""
    at = np.arange(size)
    weights = np.exp(-0.5 * ((at[:, None] - at) / reach) ** 2)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


@full_precision
def smooth_part(L: Any, reach: float = REACH) -> Any:
    """What varies slowly over images (..., h, w), of NumPy or JAX: a Gaussian of `reach` px."""
    return _averages(L.shape[-2], reach) @ L @ _averages(L.shape[-1], reach).T


class Brightness(NamedTuple):
    """What frames around a time tell of its brightness, each ()."""

    doubt: Numeric  # variance, (ln I)^2, of which no frame tells
    usual: Numeric  # ln I, by how much the nearest frame is to be brighter; 0 between frames


def smooth_at_target(
    smooth: Numeric, place: Place, weight: Numeric, paths: Numeric, brightness: Brightness
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """The smooth part at the target, of those of its instants (K, h, w), and its variance.

    `weight` is that of the frame after, 0..1. In between nothing tells which of the two the
    brightness is of, nor whether it is that of either. `paths` (h, w, 4) lead to frames that are on
    one side alone.
    """
    nearest = jnp.asarray(smooth)[place.before][None]
    Y, X = places(jnp.asarray(paths), jnp.asarray(place.s)[place.before][None])
    beyond = sample(nearest, Y, X)[0] + brightness.usual
    apart = smooth[place.after] - smooth[place.before]
    variance = jnp.maximum(weight * (1 - weight) * apart**2, brightness.doubt)
    return jnp.where(place.before == place.after, beyond, smooth[place.own]), variance


class Steadiness:
    """Tells which frames of a recording keep their brightness; `mid` are their times (us)."""

    def __init__(self, recording: Recording, mid: NDArray[np.int64], I0: float):
        self._recording, self._mid, self._I0 = recording, mid, I0
        self._images = FrameImages(recording, np.dtype(np.float32))
        self._known: dict[int, float] = {}

    def __call__(self, first: int, last: int) -> bool:
        """Whether the frames of these times (us) and those between do."""
        low = int(np.searchsorted(self._mid, first, "left"))
        high = int(np.searchsorted(self._mid, last, "right"))
        return all(abs(self._change(k)) < LEAST for k in range(low, high - 1))

    def brightness(self, t: int) -> Brightness:
        """What is told of the brightness at a time (us)."""
        return Brightness(np.float32(self.doubt(t)), np.float32(self._usual(t)))

    def _usual(self, t: int) -> float:
        """By how much the nearest frame is to be brighter, ln I, beyond the frames; else 0."""
        mid = self._mid
        if len(mid) < 3 or mid[0] <= t <= mid[-1]:
            return 0.0
        if t < mid[0]:
            nearest, next_to_it, away, apart = self._change(0), self._change(1), mid[0] - t, mid[:2]
        else:
            nearest, next_to_it = -self._change(len(mid) - 2), self._change(len(mid) - 3)
            away, apart = t - mid[-1], mid[-2:]
        if abs(nearest) < LEAST or abs(next_to_it) >= LEAST:
            return 0.0
        return nearest * min(1.0, float(away / np.diff(apart)[0]))

    def doubt(self, t: int) -> float:
        """The variance of brightness, (ln I)^2, at a time (us) of which no frame tells.

        It is 0 at the frames and largest halfway between two, and beyond the last and the first.
        """
        right = int(np.searchsorted(self._mid, t, "right"))
        left = int(np.searchsorted(self._mid, t, "left"))
        low, high = max(left - AROUND, 0), min(right + AROUND, len(self._mid))
        if left < right or high - low < 2:
            return 0.0
        mid = (self._mid[low:high] - t) * 1e-6
        level = np.cumsum([0.0, *(self._change(k) for k in range(low, high - 1))])
        between = low < right < high
        if high - low > 2:
            w = (mid[1:-1] - mid[:-2]) / (mid[2:] - mid[:-2])
            error, part = level[1:-1] - (1 - w) * level[:-2] - w * level[2:], 1.0
        else:
            error, part = level[1:], HALFWAY if between else 1.0
        variance = part * float((np.where(np.abs(error) < LEAST, 0, error) ** 2).mean())
        if not between:
            return variance
        w = -mid[left - 1 - low] / (mid[right - low] - mid[left - 1 - low])
        return float(variance * 4 * w * (1 - w))

    def _change(self, frame: int) -> float:
        """How much brighter the next frame is than this one, in ln(I + I0)."""
        if frame not in self._known:
            self._known[frame] = self._measure(frame)
        return self._known[frame]

    def _measure(self, frame: int) -> float:
        """The median over blocks of how far pixels without events change, in ln(I + I0)."""
        source, size = self._recording.events, (self._recording.height, self._recording.width)
        begin, end = (source.index(int(t)) for t in self._mid[frame : frame + 2])
        grey, intensity, _, _ = self._images.read(slice(frame, frame + 2), 2)
        shown = ((grey > SHOWN[0]) & (grey < SHOWN[1])).all(0).reshape(size)
        events = source[begin:end]
        counts = np.zeros(size, np.float32)
        np.add.at(counts, (events.y, events.x), 1)
        quiet = shown & (uniform_filter(counts, 3) < 1 / 18)
        change = np.diff(np.log(intensity + self._I0), axis=0).reshape(size)
        h, w = (length // BLOCK for length in size)

        def blocks(image: NDArray) -> NDArray:
            cut = image[: h * BLOCK, : w * BLOCK].reshape(h, BLOCK, w, BLOCK)
            return cut.swapaxes(1, 2).reshape(h * w, BLOCK**2)

        changes = [
            float(np.median(values[chosen]))
            for values, chosen in zip(blocks(change), blocks(quiet), strict=True)
            if chosen.sum() >= ENOUGH
        ]
        return float(np.median(changes)) if len(changes) >= BLOCKS else 0.0
