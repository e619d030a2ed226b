"""Dense optical flow of a recording's events, as a function of time."""

import functools
import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.event_flow.alignment import Aligned, Alignment, WindowEvents
from jaxevent.event_flow.paths import WindowPaths
from jaxevent.parameters import Count, Parameters, Positive
from jaxevent.recording import Recording, Times, check_times, microseconds

CELLS = (4, 2, 1)  # px, for motion sought from nothing
LAST_CELLS = (2, 1)  # px, for motion that starts from the one before
LEVELS = range(-4, 5)  # powers of 2 of the window's size
CHAIN_WINDOWS = 16  # half windows of a chain of anchors
N_CACHED_ANCHORS = 64
UNKNOWN_VARIANCE = 1e8  # (px/s)^2, where there are no events
MAX_DEVIATION_PX = (
    1.0  # standard deviation of a valid displacement from an anchor to a window's end
)
MIN_SCORE_RATIO = 0.9  # to the anchor before, below which motion is sought from nothing


class FlowParams(Parameters):
    """Parameters of the flow from events."""

    density = Positive(0.23, "1/px", "events per pixel on either side of a time, at first")
    displacement = Positive(3.0, "px", "typical displacement before and after a time; windows grow")
    spacing = Count(8, "px", "distance between nodes of the flow")
    smoothness = Positive(8.0, "1/px^2", "weight of differences between neighbouring nodes")
    edge = Positive(0.5, "px", "difference from which neighbours are taken for different objects")


class Anchor(NamedTuple):
    """Flow at one time, at nodes."""

    row: int  # of the event there
    t: int  # us
    unit: float  # s in which points are displaced
    aligned: Aligned

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity (rows, columns, 2), px/s."""
        return self.aligned.u / self.unit


class Chain(NamedTuple):
    """Anchors that start one from the other: the first of them, and how many events apart."""

    first: Anchor
    half: int  # events on either side of an anchor


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
        self._base = max(round(float(params.density) * pixels), 2 ** -LEVELS[0])  # events
        self._align = Alignment(self.shape, params)
        self._chain = functools.lru_cache(N_CACHED_ANCHORS)(self._make_chain)
        self._anchor = functools.lru_cache(N_CACHED_ANCHORS)(self._make_anchor)
        self._lock = threading.RLock()

    def _window(self, row: int, half: int) -> tuple[int, WindowEvents]:
        """Return the time (us) of an event, and the events around it."""
        events = self.recording.events[max(row - half, 0) : row + half]
        at = int(events.t[min(row, half)])
        return at, WindowEvents.of(events, at)

    def _seek(self, row: int, most: int | None = None) -> Chain:
        """Find the motion around an event from nothing, in windows that double.

        They grow until points are displaced far enough, or to `most` events.
        """
        start, found = None, None
        for level in LEVELS:
            half = int(self._base * 2.0**level)
            at, window = self._window(row, half)
            start = None if found is None else found.aligned.u * (window.unit / found.unit)
            found = Anchor(row, at, window.unit, self._align(window, start, CELLS))
            whole = row + half >= len(self.recording.events) and row - half <= 0
            if half == most or (
                most is None
                and (whole or found.aligned.typical() >= float(self.params.displacement))
            ):
                break
        assert found is not None
        return Chain(found, half)

    def _make_chain(self, number: int) -> Chain:
        return self._seek(number * CHAIN_WINDOWS * self._base)

    def _make_anchor(self, number: int, k: int) -> Anchor:
        """Return an anchor of a chain; those before it are estimated first."""
        first, half = self._chain(number)
        if k == 0:
            return first
        before = self._anchor(number, k - 1)
        row = number * CHAIN_WINDOWS * self._base + k * half
        at, window = self._window(row, half)
        found = self._align(window, before.velocity * window.unit, LAST_CELLS)
        if found.score < MIN_SCORE_RATIO * before.aligned.score:
            other = self._seek(row, half).first
            if other.aligned.score > found.score:
                return other
        return Anchor(row, at, window.unit, found)

    def window_events(self, t: int) -> int:
        """Return how many events on either side of a time (us) the flow there rests on."""
        row = max(self.recording.events.index(t + 1) - 1, 0)
        return self._chain(row // (CHAIN_WINDOWS * self._base)).half

    def _rows(self, number: int) -> NDArray[np.int64]:
        """Return the events at which the anchors of a chain are."""
        length = CHAIN_WINDOWS * self._base
        end = min((number + 1) * length, len(self.recording.events))
        return np.arange(number * length, end, self._chain(number).half)

    def _around(self, start: int, stop: int) -> list[Anchor]:
        """Return the anchors that determine flow from start to stop (us), of different times."""
        events, length = self.recording.events, CHAIN_WINDOWS * self._base
        n = len(events)
        if not n:
            return []
        seen = events.index(stop + 1)  # events that a causal flow may use
        low, high = max(events.index(start + 1) - 1, 0), min(events.index(stop), n - 1)
        found: list[Anchor] = []
        first = max(low // length - self.causal, 0)
        for number in range(first, min(high // length + 2, (n - 1) // length + 1)):
            if found and found[-1].row >= high:
                break
            rows = self._rows(number)
            if self.causal:
                rows = rows[rows + self._chain(number).half <= seen]
            for k in range(len(rows)):
                next_row = rows[k + 1] if k + 1 < len(rows) else n
                if next_row <= low and not (self.causal and k + 1 == len(rows)):
                    continue
                anchor = self._anchor(number, k)
                if not found or anchor.t > found[-1].t:
                    found.append(anchor)
                if rows[k] >= high:
                    break
        return found

    def _fields(self, anchors: list[Anchor]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return velocity and covariance of all pixels at anchors."""
        if not anchors:
            still = np.zeros((1, *self.shape, 2), np.float32)
            return still, np.full((*still.shape, 2), UNKNOWN_VARIANCE * np.eye(2), np.float32)
        velocity = [self._align.fill(anchor.velocity) for anchor in anchors]
        covariance = [self._align.covariance(a.aligned) / a.unit**2 for a in anchors]
        return np.stack(velocity), np.stack([self._align.fill(one) for one in covariance])

    def paths(self, start: int, stop: int, at: int) -> WindowPaths:
        """Return the paths of the points that events of a window saw.

        Args:
            start: First time of the events, us.
            stop: Last time of the events, us.
            at: Time to which points are carried, us.

        Returns:
            The paths.
        """
        with self._lock:
            anchors = self._around(min(start, at), max(stop, at))
        knots = np.array([anchor.t for anchor in anchors] or [at], np.int64)
        return WindowPaths(int(at), knots, *self._fields(anchors))

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
        valid = np.zeros(mean.shape[:3], bool)
        for row, t in enumerate(wanted.tolist()):
            with self._lock:
                anchors = self._around(t, t)
            knots = [anchor.t for anchor in anchors] or [t]
            weights = np.array([np.interp(t, knots, one) for one in np.eye(len(knots))], np.float32)
            velocity, uncertainty = self._fields(anchors)
            mean[row] = np.tensordot(weights, velocity, 1)
            covariance[row] = np.tensordot(weights, uncertainty, 1)
            unit = float(weights @ np.array([anchor.unit for anchor in anchors] or [0.0]))
            largest = np.linalg.eigvalsh(covariance[row])[..., 1]
            valid[row] = (unit > 0) & (largest * unit**2 < MAX_DEVIATION_PX**2)
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
