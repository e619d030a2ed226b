"""Whether the camera stands still and things move before it, by frames where there are any.

Where a camera moves, all edges across its motion make events; before one that stands still, those
of the background make none. So of the strongest edges of a frame, those beside which there is an
event while the image goes a few pixels are counted.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from jaxevent.egomotion.patches import Speed, usual_speed
from jaxevent.recording import Recording

TIMES = 6  # frames that are looked at
WAY = 5.0  # px, that the image goes around each of them
STRONG = 0.1  # of the pixels, those of the steepest log intensity
DARK = 0.05  # of full scale, added before the logarithm: darker greys are noise
# The share of the edges with events below which the camera stands still. Street (cars before a
# camera at rest) 0.06; slider_depth 0.85, evbench_seq3 0.91, simulated scenes 1.
STILL = 0.3


def stands_still(recording: Recording, speed: Speed | None) -> bool:
    """Whether the edges that frames show make no events; false without frames or a speed."""
    share = None if speed is None else edges_with_events(recording, speed)
    return share is not None and share < STILL


def edges_with_events(recording: Recording, speed: Speed | None = None) -> float | None:
    """The share (median over frames) of the strongest edges with events beside them.

    None where nothing is seen to move, and where no frame has events before and after it for as
    long as the image takes to go `WAY`.
    """
    frames, events, n = recording.frames, recording.events, len(recording.events)
    if frames and speed is None:
        speed = usual_speed(recording)
    if frames is None or speed is None:
        return None
    half = round(5e5 * WAY / speed.usual)
    first, last = int(events[:1].t[0]), int(events[n - 1 :].t[0])
    rows = np.flatnonzero((frames.t - half >= first) & (frames.t + half <= last))
    if not len(rows):
        return None
    rows = np.unique(rows[((np.arange(TIMES) + 0.5) * len(rows) / TIMES).astype(int)])
    shares = []
    for at, image in zip(frames.t[rows].tolist(), frames[rows].intensity, strict=True):
        edges = _edges(image)
        part = events[events.index(at - half) : events.index(at + half)]
        seen = np.zeros(edges.shape, bool)
        seen[part.y, part.x] = True
        shares.append(maximum_filter(seen, 3)[edges].mean())
    return float(np.median(shares))


def _edges(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The pixels of a frame (intensity) where log intensity is steepest."""
    smooth = gaussian_filter(np.log(image + DARK), 1.0)
    steep = np.hypot(np.gradient(smooth, axis=0), np.gradient(smooth, axis=1))
    return steep >= np.quantile(steep, 1 - STRONG)
