"""Dense optical flow of a recording's events, as a function of time."""

import collections
import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.event_flow.alignment import Alignment, WindowEvents
from jaxevent.event_flow.paths import WindowPaths
from jaxevent.parameters import Count, Parameters, Positive
from jaxevent.recording import Recording, Times, check_times, microseconds

ANCHORS_PER_CHAIN = 8  # of which the first is sought from nothing
N_CACHED_ANCHORS = 32


class FlowParams(Parameters):
    """Parameters of the flow from events."""

    density = Positive(0.23, "1/px", "events per pixel before and after a time that make a window")
    spacing = Count(8, "px", "distance between nodes of the flow, at 240 x 180 pixels")
    smoothness = Positive(2.0, "1/px^2", "weight of differences between neighbouring nodes")
    edge = Positive(1.0, "px", "difference from which neighbours are taken for different objects")


class Anchor(NamedTuple):
    """Flow at one time: nodes' velocity (rows, columns, 2), px/s, and its covariance."""

    t: int  # us
    displacement: NDArray[np.float64]  # px in `unit`
    unit: float  # s
    covariance: NDArray[np.float64]  # (rows, columns, 2, 2), px^2


class EventFlow:
    """Dense optical flow of a recording, estimated where it is asked for: `flow(times)`.

    Flow is estimated at anchors, one for so many events. Between them it is linear in time. What is
    returned does not depend on what was asked for before.

    Attributes:
        recording: The recording; only its events are used.
        params: The parameters.
        causal: Whether flow at a time uses no later events.
    """

    def __init__(self, recording: Recording, params: FlowParams, causal: bool = False):
        self.recording, self.params, self.causal = recording, params, causal
        self.shape = (recording.height, recording.width)
        pixels = self.shape[0] * self.shape[1]
        self.half = max(int(round(float(params.density) * pixels)), 1)  # events
        self.step = self.half
        self._aligner = Alignment(self.shape, params)
        self._anchors: collections.OrderedDict[int, Anchor] = collections.OrderedDict()
        self._lock = threading.RLock()

    @property
    def n_anchors(self) -> int:
        """Number of anchors."""
        n = len(self.recording.events)
        return 0 if n == 0 else (n - 1) // self.step + 1

    def _anchor_time(self, k: int) -> int:
        return int(self.recording.events[k * self.step : k * self.step + 1].t[0])

    def _anchor(self, k: int) -> Anchor:
        """Return the anchor of a number; those of its chain are estimated before it."""
        with self._lock:
            if k not in self._anchors:
                before = self._anchor(k - 1) if k % ANCHORS_PER_CHAIN else None
                self._anchors[k] = self._estimate(k, before)
                if len(self._anchors) > N_CACHED_ANCHORS:
                    self._anchors.popitem(last=False)
            self._anchors.move_to_end(k)
            return self._anchors[k]

    def _estimate(self, k: int, before: Anchor | None) -> Anchor:
        row = k * self.step
        events = self.recording.events[max(row - self.half, 0) : row + self.half]
        at = self._anchor_time(k)
        window = WindowEvents.of(events, at)
        start = None
        if before is not None and before.unit > 0:
            start = before.displacement * (window.unit / before.unit)
        u, covariance = self._aligner(window, start)
        return Anchor(at, u, window.unit, covariance)

    def _around(self, start: int, stop: int) -> list[Anchor]:
        """Return the anchors that determine flow from start to stop (us), of different times."""
        events, last = self.recording.events, self.n_anchors - 1
        low = min(max((events.index(start + 1) - 1) // self.step, 0), last)
        high = min(-(-events.index(stop) // self.step), last)
        if self.causal:
            # An anchor rests on `half` events after it.
            newest = max((events.index(stop + 1) - self.half) // self.step, 0)
            low, high = min(low, newest), min(high, newest)
        found: dict[int, Anchor] = {}
        for k in range(low, high + 1):
            anchor = self._anchor(k)
            found.setdefault(anchor.t, anchor)
        return list(found.values())

    def paths(self, start: int, stop: int, at: int) -> WindowPaths:
        """Return the paths of the points that events of a window saw.

        Args:
            start: First time of the events, us.
            stop: Last time of the events, us.
            at: Time to which points are carried, us.

        Returns:
            The paths.
        """
        if self.n_anchors == 0:
            still = np.zeros((1, *self.shape, 2), np.float32)
            unknown = np.broadcast_to(
                np.float32(1e6) * np.eye(2, dtype=np.float32), (*still.shape, 2)
            )
            return WindowPaths(int(at), np.array([at], np.int64), still, unknown)
        anchors = self._around(min(start, at), max(stop, at))
        per_second = [1 / a.unit if a.unit > 0 else 0.0 for a in anchors]
        velocity = [
            self._aligner.fill(a.displacement * s) for a, s in zip(anchors, per_second, strict=True)
        ]
        covariance = [
            self._aligner.fill(a.covariance * s**2)
            for a, s in zip(anchors, per_second, strict=True)
        ]
        knots = np.array([a.t for a in anchors], np.int64)
        return WindowPaths(int(at), knots, np.stack(velocity), np.stack(covariance))

    def __call__(
        self, times: Times, extrapolate: bool = False
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Return the flow at some times.

        Args:
            times: (T,) integers (us) or floats (s).
            extrapolate: Whether times outside the recording are allowed.

        Returns:
            Flow (T, H, W, 2) along x and y, px/s; its covariance (T, H, W, 2, 2), (px/s)^2; and
            whether events determine it (T, H, W).

        Raises:
            InputError: A time is outside the recording without `extrapolate`.
        """
        wanted = np.atleast_1d(microseconds(times))
        if not extrapolate:
            check_times(wanted, self.recording.start, self.recording.stop, self.recording.name)
        mean = np.zeros((len(wanted), *self.shape, 2), np.float32)
        covariance = np.zeros((*mean.shape, 2), np.float32)
        for row, t in enumerate(wanted.tolist()):
            paths = self.paths(t, t, t)
            weights = _weights(paths.knots, t)
            mean[row] = np.tensordot(weights, paths.velocity, 1)
            covariance[row] = np.tensordot(weights, paths.covariance, 1)
        valid = np.isfinite(covariance[..., 0, 0]) & (covariance[..., 0, 0] < 1e6)
        return mean, covariance, valid

    def flow(self, times: Times, extrapolate: bool = False) -> NDArray[np.float32]:
        """Return the flow alone, as `mc` takes it.

        Args:
            times: (T,) integers (us) or floats (s).
            extrapolate: Whether times outside the recording are allowed.

        Returns:
            (T, H, W, 2) flow along x and y, px/s.

        Raises:
            InputError: A time is outside the recording without `extrapolate`.
        """
        return self(times, extrapolate)[0]


def _weights(knots: NDArray[np.int64], t: int) -> NDArray[np.float32]:
    """Return the weights of knots in a value at a time, linear between and constant outside."""
    eye = np.eye(len(knots))
    return np.array([np.interp(t, knots, row) for row in eye], np.float32)


def flow_from_events(
    recording: Recording, params: FlowParams | None = None, *, causal: bool = False
) -> EventFlow:
    """Estimate dense optical flow from events alone, as a function of time.

    Args:
        recording: The recording; frames are not used.
        params: The parameters; None: the defaults.
        causal: Whether flow at a time uses no later events.

    Returns:
        The flow: `mean, covariance, valid = flow(times)`.

    Raises:
        InputError: The parameters are of another method.
    """
    params = FlowParams() if params is None else params
    if not isinstance(params, FlowParams):
        raise InputError(f"params are {type(params).__name__}; give FlowParams")
    return EventFlow(recording, params, causal)
