"""Interpolation along the optical flow of the frames; no events.

Dense inverse search (Kroeger et al., ECCV 2016; OpenCV's, preset medium) finds the flow from the
frame before to the frame after, and back. Both frames are warped to the time between them, as if
what moves kept its velocity, and blended by time. Computed on the host with the extra `vision`.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.camera import Response
from jaxevent.errors import InputError, require
from jaxevent.estimator import Estimate, ShortRepr
from jaxevent.reconstruction.augment import FrameParams
from jaxevent.reconstruction.estimator import ImageEstimator
from jaxevent.reconstruction.frames import EventTiming, FrameClock, FrameImages
from jaxevent.reconstruction.video import N_BATCH_IMAGES, ImageSequence
from jaxevent.recording import Recording, Times
from jaxevent.threads import synchronized

MIN_SIDE_PX = 12  # pixels that OpenCV's search needs in width or height
GREY_OUTLIER_FRACTION = 1e-3  # of the greys of two frames, at either end, that do not set the range


class Params(FrameParams):
    """Parameters of `flow`, of which `clock_offset` alone acts."""


class FrameSeries(ShortRepr):
    """Frames in time, the features that `run` takes."""

    mid: NDArray[np.floating]  # (frames,), mid-exposures, us from the recording's start
    grey: NDArray[np.floating]  # (frames, H, W), in [0, 1]
    intensity: NDArray[np.floating]  # (frames, H, W)
    gain: NDArray[np.floating]  # (frames,)
    response: Response


class ImageTimes(NamedTuple):
    """Times of images among the frames, prepared for `read`.

    Attributes:
        frame: (times,) index of the frame before.
        share: (times,) time since that frame as a part of the interval, 0..1.
    """

    frame: NDArray[np.int64]
    share: NDArray[np.floating]


class FramePair(NamedTuple):
    """Two successive frames, and the flows between them.

    Attributes:
        before: (H, W) the earlier frame.
        after: (H, W) the later frame.
        forward: (H, W, 2) flow from the earlier to the later, px.
        backward: (H, W, 2) flow from the later to the earlier, px.
    """

    before: NDArray[np.floating]
    after: NDArray[np.floating]
    forward: NDArray[np.float32]
    backward: NDArray[np.float32]

    def at(self, time_fraction: float | int) -> NDArray[np.floating]:
        """Return the image at a fraction of the time from one frame to the other."""
        s = float(time_fraction)
        if s == 0:
            return self.before
        moved = _warp(self.before, s * self.forward), _warp(self.after, (1 - s) * self.backward)
        return (1 - s) * moved[0] + s * moved[1]

    def flow(self, time_fraction: float | int) -> NDArray[np.floating]:
        """Return the flow (H, W, 2) at a fraction of the time, px from frame to frame."""
        return (1 - time_fraction) * self.forward - time_fraction * self.backward


def _warp(image: NDArray[np.floating], flow: NDArray[np.float32]) -> NDArray[np.floating]:
    """Sample an image at the source of the flow of every pixel.

    Args:
        image: (H, W).
        flow: (H, W, 2) flow to each pixel, px.

    Returns:
        (H, W).
    """
    cv2 = require("cv2", "vision")
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    return cv2.remap(
        image, x - flow[..., 0], y - flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def make_frame_pair(frames: FrameSeries, first_frame: int) -> FramePair:
    """Find the flows between a frame and the next.

    Args:
        frames: Frames in time.
        first_frame: Index of the first of the two.

    Returns:
        The two frames with the flows.
    """
    cv2 = require("cv2", "vision")
    two = slice(first_frame, first_frame + 2)
    one, other = _levels(frames.grey[two], frames.intensity[two], frames.gain[two], frames.response)
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = search.calc(one, other, None), search.calc(other, one, None)
    return FramePair(frames.intensity[first_frame], frames.intensity[first_frame + 1], there, back)


def _levels(
    grey: NDArray, intensity: NDArray, gain: NDArray, response: Response
) -> NDArray[np.uint8]:
    """Scale two frames to the 256 levels that the search takes.

    The search weighs gradients against thresholds and a smoothness that are made for levels of a
    well exposed picture. Frames that use a few of 256 levels show no motion below a pixel. So the
    range of the two frames, but for a few outliers such as hot pixels, is spread over all levels.
    The range is common to both, as flow follows points of one brightness. Frames of different gain
    are brought to the lower one, at which neither clips anew. Levels are grey values rather than
    intensities, which would leave few levels for dark parts.

    Args:
        grey: (2, H, W) grey values, 0 to 1.
        intensity: (2, H, W) intensities.
        gain: (2,) exposure relative to the common one.
        response: Response of the camera.

    Returns:
        (2, H, W) levels.
    """
    if gain[0] != gain[1]:
        grey = np.asarray(response.grey(jnp.asarray(intensity * gain.min())))
    low, high = np.quantile(grey, [GREY_OUTLIER_FRACTION, 1 - GREY_OUTLIER_FRACTION])
    spread = 255 / (high - low) if high > low else 0.0
    return np.rint(((grey - low) * spread).clip(0, 255)).astype(np.uint8)


def _read_frames(images: FrameImages, clock: FrameClock, used: slice) -> FrameSeries:
    """Read a range of frames as a series.

    Args:
        images: Source of the frames.
        clock: Times of the frames.
        used: The range, from `start` to `stop`.

    Returns:
        The series.
    """
    recording, n = images.recording, used.stop - used.start
    shape = (n, recording.height, recording.width)
    grey, intensity, _, gain = images.read(used, n)
    return FrameSeries(
        clock.mid[used], grey.reshape(shape), intensity.reshape(shape), gain, recording.response
    )


class FlowVideo(ImageSequence[Params]):
    """Images along the optical flow of the frames: `image, variance, valid = video(times)`.

    Two frames and the flows between them are kept, so memory does not grow with the recording's
    length. Before the first frame and after the last, these are held.
    """

    def __init__(
        self,
        estimator: "Flow",
        recording: Recording,
        params: Params,
        *,
        progress: bool | None = None,
    ):
        super().__init__(estimator, recording, params, progress=progress)
        self._clock = FrameClock.of(recording, EventTiming.of(params))
        self._dtype = np.dtype(jnp.result_type(float))
        self._images = FrameImages(recording, self._dtype)
        self._pair: tuple[int, FramePair] | None = None  # with the number of its first frame

    @property
    def dtype(self) -> np.dtype:
        return self._dtype

    def _read(self, times: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Any]]:
        located = _locate(self._clock, times)
        for first in range(0, len(times), N_BATCH_IMAGES):
            batch = slice(first, first + N_BATCH_IMAGES)
            places = zip(located.frame[batch], located.share[batch], strict=True)
            images = np.stack([self._image_at(int(frame), float(share)) for frame, share in places])
            yield times[batch], _estimate(images)

    @synchronized
    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.floating]:
        """Return the flow at times, along which images are made.

        Args:
            times: Integers (us) or floats (s), in any order.
            extrapolate: Allow times outside the recording.

        Returns:
            (T, H, W, 2) px/s, x before y; NaN outside the frames.

        Raises:
            InputError: A time is not finite, or outside the recording.
        """
        times = self._among_events(times, extrapolate)
        located = _locate(self._clock, times)
        shape = (len(times), self.recording.height, self.recording.width, 2)
        flows = np.full(shape, np.nan, self._dtype)
        since = times - self._clock.origin
        for row in np.argsort(times, kind="stable"):
            frame = int(located.frame[row])
            if self._clock.mid[0] <= since[row] and frame + 1 < len(self._clock):
                seconds = float(self._clock.mid[frame + 1] - self._clock.mid[frame]) * 1e-6
                flows[row] = self._frame_pair(frame).flow(float(located.share[row])) / seconds
        return flows

    def _image_at(self, frame: int, share: float) -> NDArray[np.floating]:
        """Return the image at a position between two frames.

        Args:
            frame: The frame before.
            share: Part of the interval to the next frame that is over, 0 to 1.

        Returns:
            (H, W) intensity.
        """
        if share == 0:
            return _read_frames(self._images, self._clock, slice(frame, frame + 1)).intensity[0]
        return self._frame_pair(frame).at(share)

    def _frame_pair(self, frame: int) -> FramePair:
        if self._pair is None or self._pair[0] != frame:
            two = _read_frames(self._images, self._clock, slice(frame, frame + 2))
            self._pair = frame, make_frame_pair(two, 0)
        return self._pair[1]


def _locate(clock: FrameClock, times: NDArray[np.int64]) -> ImageTimes:
    """Locate times among the frames.

    Args:
        clock: Times of the frames.
        times: (times,) times, us.

    Returns:
        Their places.
    """
    _, frame, _, share = clock.locate(times - clock.origin)
    return ImageTimes(frame, share)


def _estimate(images: NDArray[np.floating]) -> Estimate:
    return Estimate(images, np.full_like(images, np.nan), np.isfinite(images))


class FlowTrajectory(ShortRepr):
    """Frames, and the flows (H, W, 2) from each to the next and back, px: the trajectory."""

    frames: FrameSeries
    pairs: list[FramePair]


@dataclasses.dataclass(frozen=True, repr=False)
class Flow(ImageEstimator[Params]):
    """Interpolation along the optical flow of the frames."""

    def check(self, recording: Recording) -> None:
        """Raise `InputError` without frames, for tiny ones and without the extra `vision`."""
        super().check(recording)
        if max(recording.width, recording.height) < MIN_SIDE_PX:
            raise InputError(
                f"{recording.name}: {recording.width}x{recording.height} pixels are too few for "
                f"optical flow; {MIN_SIDE_PX} in one direction are needed, or the method 'blend'"
            )
        require("cv2", "vision")

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: Params | None = None,
        *,
        extrapolate: bool = False,
    ) -> tuple[FrameSeries, ImageTimes]:
        """Read all frames of a recording, and find times among them.

        Args:
            recording: The recording.
            times: Sorted times, integers in us or floats in s.
            params: Parameters; the defaults if None.
            extrapolate: Allow times outside the recording.

        Returns:
            The frames, and the times among them.

        Raises:
            InputError: As `check`, and for times outside the recording.
        """
        params, wanted = self.check_request(recording, times, params, extrapolate)
        clock = FrameClock.of(recording, EventTiming.of(params))
        images = FrameImages(recording, np.dtype(jnp.result_type(float)))
        frames = _read_frames(images, clock, slice(0, len(clock)))
        return frames, _locate(clock, wanted)

    def run(
        self, params: Params, features: FrameSeries, state: None = None
    ) -> tuple[FlowTrajectory, None]:
        """Find the flows between all frames, on the host.

        Args:
            params: Parameters; not used.
            features: The frames.
            state: Not used.

        Returns:
            The trajectory, and None: nothing passes from run to run.
        """
        pairs = [make_frame_pair(features, first) for first in range(len(features.mid) - 1)]
        return FlowTrajectory(features, pairs), None

    def read(self, params: Params, trajectory: FlowTrajectory, out: ImageTimes) -> Estimate:
        """Read images, on the host.

        Args:
            params: Parameters; not used.
            trajectory: Frames and flows.
            out: Times among the frames.

        Returns:
            The images, each array (times, pixels).
        """
        images = [
            trajectory.frames.intensity[frame]
            if share == 0
            else trajectory.pairs[frame].at(float(share))
            for frame, share in zip(out.frame, out.share, strict=True)
        ]
        return _estimate(np.stack(images).reshape(len(images), -1))

    def estimate(
        self,
        recording: Recording,
        params: Params | None = None,
        *,
        progress: bool | None = None,
        **options: Any,
    ) -> FlowVideo:
        """Make images along the frames' flow: `mean, variance, valid = estimate(recording)(times)`.

        Args:
            recording: The recording.
            params: Parameters; the defaults if None.
            progress: Show a progress bar; None: if it takes long.
            **options: None; others raise.

        Returns:
            Images as a function of time.

        Raises:
            InputError: As `check`.
        """
        self.refuse_unknown(options)
        chosen = self.Params() if params is None else params
        return FlowVideo(self, recording, chosen, progress=progress)


flow = Flow(
    "flow",
    Params,
    needs_frames=True,
    differentiable=False,
    fuses=False,
    has_covariance=False,
    about="The frames before and after, each moved along the optical flow between them (dense "
    "inverse search), blended by time; no events. Needs the extra `vision`.",
)
