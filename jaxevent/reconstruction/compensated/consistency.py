"""Events that contradict frames: factors on the variance of images between frames.

Between two frames the smoother's images rest on events. How far these can be believed is seen at
the frames: with L and L' their log intensities, S the sum of s c over the events between them, and
q the variance that events and time add,

    L' - L = S + noise,    variance V + V' + q.

The mean square of what is left, in units of that variance, over the pixels around, is 1 where
events are as good as the smoother's model of them. It is large where events are missing, where
their polarity or place is wrong, or where their clock is not the frames'. There images between
frames have a larger variance, and motion and image come from frames alone.
"""

import collections
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from jaxevent.reconstruction.compensated.images import InstantImages, gaussian_blur
from jaxevent.reconstruction.compensated.params import Params
from jaxevent.reconstruction.compensated.robust_mean import blur_image
from jaxevent.reconstruction.compensated.thresholds import count_events
from jaxevent.recording import Recording
import os
REGION_SIGMA_PX = float(os.environ.get('REG', 8))  # of the Gaussian over the pixels around
POWER = float(os.environ.get('POW', 2))
ADD = float(os.environ.get('ADD', 1))
PRIOR = float(os.environ.get('PRI', 0))
N_CACHED_INTERVALS = 8


class EventNoise:
    def __init__(self, recording, params, images, frames):
        self._recording, self._params, self._images, self._frames = recording, params, images, frames
        self._cache = collections.OrderedDict()

    def __call__(self, interval: int):
        interval = min(max(interval, 0), len(self._frames) - 2)
        if interval < 0:
            return np.ones(self._images.image_shape, np.float32), np.zeros(self._images.image_shape, np.float32), 1.0
        if interval not in self._cache:
            self._cache[interval] = self._measure(interval)
            if len(self._cache) > N_CACHED_INTERVALS:
                self._cache.popitem(last=False)
        return self._cache[interval]

    def _measure(self, interval):
        p, r = self._params, self._recording
        times = self._frames[interval : interval + 2]
        L, V, clear = self._images(times)
        counts = count_events(r, int(times[0]), int(times[1]), 1e6 * float(p.rho_ref))
        if self._images.factors is not None:
            counts = counts * self._images.factors
        counts = counts.reshape(2, *L.shape[1:])
        share = float(p.share)

        def redistribute(n):
            P = np.pad(n, 1)
            rows = P[:-2] + P[1:-1] + P[2:]
            around = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] - n
            return n + share * (around / 8 - n)

        on, off = (redistribute(n) for n in counts)
        c_on, c_off = float(p.c_on), float(p.c_off)
        q = float(p.sigma_event) ** 2 * (c_on**2 * on + c_off**2 * off)
        q = q + float(p.sigma_bg) ** 2 * (times[1] - times[0]) * 1e-6
        e = (L[1] - L[0] - (c_on * on - c_off * off)).astype(np.float32)
        both = (clear[0] * clear[1]).astype(np.float32)
        smooth = gaussian_blur(both * e) / np.maximum(gaussian_blur(both), 1e-6)
        e = e - smooth
        expected = (q + V.sum(0)).astype(np.float32)
        num, den = (gaussian_blur(x.astype(np.float32), REGION_SIGMA_PX) for x in (both * e * e, both * expected))
        ratio = num / np.maximum(den, 1e-9)
        factor = np.maximum(ratio, 1).astype(np.float32) ** POWER
        return factor, (factor - 1) * den * ADD, float((den / factor).sum() / max(den.sum(), 1e-12))
