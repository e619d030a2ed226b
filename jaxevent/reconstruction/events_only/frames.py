"""Frames as further measurements of the log image: gradients, and the scale of intensity.

A frame shows F = ln(I + I0) = factor M + level. Along paths the events of a pixel change M by S in
all while F changes by D, so that with the sums over pixels

    factor = sum D^2 / sum S D                                                               (6)

does not depend on how well the image is solved. The frame's gradient over the factor is a
measurement of grad M, carried from the frame's time as a memory (5). Clipped pixels say nothing.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from jaxevent.event_flow import WindowPaths
from jaxevent.reconstruction.events_only.memory import MemoryParams, carry
from jaxevent.reconstruction.events_only.prior import GradientPrior
from jaxevent.reconstruction.events_only.rows import EVENT, Rows, carry_pixels
from jaxevent.recording import Recording

PIXEL_NOISE = 0.01  # of intensity, standard deviation
CLIPPED = 0.004  # intensity next to black and white at which frames count as clipped
OFFSETS_US = np.arange(-40_000, 40_001, 5_000)  # of frames from their stamps that are tried
LEAST_CORRELATION = 0.4  # of changes by events and by the frame, from which a frame is used


class FrameScale(NamedTuple):
    """The relation between the log image and frames, ln(I + I0) = factor M + level.

    Attributes:
        factor: ln I per unit of the log image.
        image: (height, width) F at the time of the log image, NaN: unknown.
    """

    factor: float
    image: NDArray[np.float32]

    def level(self, log_image: NDArray) -> float:
        """Return the level that fits a log image (height, width) to the frame."""
        return float(np.nanmedian(self.image - self.factor * log_image))


@runtime_checkable
class PathSource(Protocol):
    """A source of a recording's paths and equations."""

    def paths(self, start: int, stop: int, at: int) -> WindowPaths:
        """Return the paths through a window of time.

        Args:
            start: Begin of the window, us.
            stop: Its end, us.
            at: Time to which points are carried, us.

        Returns:
            The paths.
        """
        ...

    def rows_around(self, t: int) -> Rows:
        """Return the equations of the window around a time (us)."""
        ...


class FrameMeasurements:
    """Measurements of the image at a time by the nearest frame.

    Args:
        windows: Source of paths and equations.
        recording: Events and at least one frame.
        I0: Offset inside the logarithm.
        frame_delay: Time added to the frames' stamps, s.
        causal: Whether later frames are left out.
    """

    def __init__(
        self, windows: PathSource, recording: Recording, I0: float, frame_delay: float, causal: bool
    ):
        assert recording.frames is not None
        self.windows, self.frames, self.causal = windows, recording.linear_frames, causal
        self.I0, self.offset = I0, round(frame_delay * 1e6)
        self._span = recording.start, recording.stop
        self._factors: dict[int, tuple[float, int] | None] = {}

    def __call__(self, t: int, threshold: float) -> tuple[GradientPrior, FrameScale] | None:
        """Return the gradient that the nearest frame measures, and the scale, or None.

        Args:
            t: Time of the image, us.
            threshold: Mean threshold, ln I.

        Returns:
            The measurement at that time; None where no frame agrees with the events.
        """
        stamps = self.frames.t + self.offset
        places = np.flatnonzero(stamps <= t) if self.causal else np.arange(len(stamps))
        if not len(places):
            return None
        frame = int(places[np.argmin(np.abs(stamps[places] - t))])
        if frame not in self._factors:
            self._factors[frame] = self._fit(frame)
        fitted = self._factors[frame]
        if fitted is None:
            return None
        factor, at = fitted
        F, noise = self._read(frame)
        known = np.isfinite(F)
        filled = np.where(known, F, np.nanmean(F)).astype(np.float32)
        gradient = np.stack(np.gradient(filled)[::-1], -1) / factor
        information = np.zeros((*F.shape, 2, 2), np.float32)
        information[...] = np.eye(2) * (known * 2 * (factor / noise) ** 2)[..., None, None]
        numbers = MemoryParams()
        variances = numbers.noise(1e-6 * abs(t - at), threshold, numbers.blur)
        paths = self.windows.paths(min(t, at), max(t, at), at)
        measured = GradientPrior(gradient.astype(np.float32), information)
        return carry(measured, paths, t, variances), FrameScale(factor, _warp_frame(F, paths, t))

    def _read(self, frame: int) -> tuple[NDArray, NDArray]:
        """Return ln(I + I0) of a frame, NaN where it is clipped, and its standard deviation."""
        shown = self.frames[frame : frame + 1]
        intensity, (black, white) = shown.intensity[0].astype(np.float64), shown.limits[0].tolist()
        clear = (intensity > black + CLIPPED) & (intensity < white - CLIPPED)
        F = np.where(clear, np.log(np.maximum(intensity, 0) + self.I0), np.nan)
        return F, PIXEL_NOISE / (np.maximum(intensity, 0) + self.I0)

    def _fit(self, frame: int) -> tuple[float, int] | None:
        """Fit the factor (6) and the frame's time (us), by the correlation of both changes."""
        stamp, F = int(self.frames.t[frame]) + self.offset, self._read(frame)[0]
        t = min(max(stamp, self._span[0]), self._span[1])
        rows = self.windows.rows_around(t)
        best, found = LEAST_CORRELATION, None
        for at in (stamp + OFFSETS_US).tolist():
            moved = _warp_frame(F, self.windows.paths(min(t, at), max(t, at), at), t)
            S, D = _sum_changes(rows, moved)
            square = float((S**2).sum() * (D**2).sum())
            product = float((S * D).sum())
            if square > 0 and product / square**0.5 > best:
                best, found = product / square**0.5, (float((D**2).sum() / product), at)
        return found


def _warp_frame(F: NDArray, paths: WindowPaths, t: int) -> NDArray[np.float32]:
    """Sample a frame at the end of paths.

    Args:
        F: (height, width) log intensity of a frame, NaN where it is clipped.
        paths: Paths towards the time of the frame.
        t: Time at which the pixels are in place, us.

    Returns:
        (height, width) log intensity at that time, NaN where it is unknown.
    """
    places = np.moveaxis(carry_pixels(paths, F.shape, t), -1, 0)[::-1]
    return map_coordinates(F, places, order=1, mode="constant", cval=np.nan).astype(np.float32)


def _sum_changes(rows: Rows, F: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """Return the change of each pixel between its first and last event, by events and by a frame.

    Args:
        rows: Equations of a window.
        F: (height, width) log intensity of a frame at the target time, NaN: unknown.

    Returns:
        Changes by events and by the frame, each (pixels,), ln I; sums over the rows that F covers.
    """
    width, flat = F.shape[1], np.pad(F.ravel(), (0, F.shape[1] + 1), mode="edge")
    x, y = rows.fraction[..., 0], rows.fraction[..., 1]
    upper = flat[rows.corner] * (1 - x) + flat[rows.corner + 1] * x
    lower = flat[rows.corner + width] * (1 - x) + flat[rows.corner + width + 1] * x
    seen = upper * (1 - y) + lower * y
    change = seen[:, 0] - seen[:, 1]
    used = (rows.kind == EVENT) & np.isfinite(change)
    S = np.bincount(rows.pixel[used], rows.threshold * rows.change[used], F.size)
    return S, np.bincount(rows.pixel[used], change[used], F.size)
