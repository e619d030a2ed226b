"""Dense optical flow of a recording's events, as a function of time."""

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.cache import cache_method
from jaxevent.calibration.event_calibration import remove_many_hot_events
from jaxevent.errors import InputError
from jaxevent.event_flow.alignment import (
    MAX_VARIANCE,
    Alignment,
    Clock,
    Displacement,
    WindowEvents,
)
from jaxevent.event_flow.paths import WindowPaths
from jaxevent.parameters import Count, Parameters, Positive
from jaxevent.recording import Events, Recording, Times, check_recording, check_times, microseconds

CELLS = (4, 2, 1)  # px, for motion sought from nothing
LAST_CELLS = (2, 1)  # px, for motion that starts from the one before
LEVELS = range(-4, 5)  # powers of 2 of the window's size
CHAIN_WINDOWS = 16  # half windows of a chain of anchors
MAX_KNOTS = 16  # of paths, whose cost and memory they set
N_CACHED_ANCHORS = 256
UNKNOWN_VARIANCE = 1e8  # (px/s)^2, where there are no events
MIN_SCORE_RATIO = 0.9  # to the anchor before, below which motion is sought from nothing


class FlowParams(Parameters):
    """Parameters of the flow from events."""

    density: Positive = Positive(
        0.23, "1/px", "events per pixel on either side of a time, at first"
    )
    displacement: Positive = Positive(
        3.0, "px", "typical displacement before and after a time; windows grow"
    )
    spacing: Count = Count(8, "px", "distance between nodes of the flow")
    smoothness: Positive = Positive(
        8.0, "1/px^2", "weight of differences between neighbouring nodes"
    )
    edge: Positive = Positive(
        0.2, "px", "difference from which neighbours are taken for different objects"
    )


class Anchor(NamedTuple):
    """Flow at one time, at nodes.

    Attributes:
        row: Number of the event there.
        t: Its time, us.
        aligned: Displacement of nodes.
        rates: (2, K) rates of its clock, 1/s, and their variances.
    """

    row: int
    t: int
    aligned: Displacement
    rates: NDArray[np.float64]

    @property
    def rate(self) -> float:
        """Displacements per second, less than 0 where the clock runs backwards."""
        return float(np.interp(self.t, self.aligned.clock.t, self.rates[0]))


class Chain(NamedTuple):
    """Sequence of anchors, each estimated from the one before.

    Attributes:
        first: The first anchor.
        half: Number of events on either side of an anchor.
    """

    first: Anchor
    half: int


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
        self._chain = cache_method(self._make_chain, N_CACHED_ANCHORS)
        self._anchor = cache_method(self._make_anchor, N_CACHED_ANCHORS)
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        causal = ", causal" if self.causal else ""
        return f"EventFlow({self.recording.name}, {self.shape[1]}x{self.shape[0]}{causal})"

    def _events(self, row: int, half: int) -> tuple[int, Events]:
        """Read the events around an event.

        Args:
            row: Number of the event.
            half: Number of events on either side.

        Returns:
            Its time, us, and the events.
        """
        events = self.recording.events[max(row - half, 0) : row + half]
        return int(events.t[min(row, half)]), events

    def _start_chain(self, row: int, most: int | None = None) -> Chain:
        """Estimate the motion around an event without an initial value, in windows that double.

        They grow until points are displaced far enough, or to `most` events.

        Args:
            row: Number of the event.
            most: Number of events on either side to go to; None: until points move far enough.

        Returns:
            The chain that starts with the anchor there.
        """
        start, clock, half = None, None, 0
        for level in LEVELS:
            half = int(self._base * 2.0**level)
            found = self._refine(row, half, start, clock, grow=True)
            start, clock = self._align.shrink(found.aligned), found.aligned.clock
            whole = row + half >= len(self.recording.events) and row - half <= 0
            if half == most or (
                most is None
                and (whole or self._align.typical(found.aligned) >= float(self.params.displacement))
            ):
                break
        return Chain(self._refine(row, half, start, clock), half)

    def _refine(
        self,
        row: int,
        half: int,
        start: NDArray | None,
        before: Clock | None,
        grow: bool = False,
    ) -> Anchor:
        """Align the window around an event from displacements that had another clock.

        Args:
            row: Number of the event.
            half: Number of events on either side.
            start: (rows, columns, 2) displacements to start from, px per unit of s; None: 0.
            before: Their clock.
            grow: Whether larger windows follow: coarse cells, and the clock as it is.

        Returns:
            The flow at the event.
        """
        at, events = self._events(row, half)
        clock = Clock.of(events, at, half)
        if start is not None and before is not None:
            start = start * (before.mean_rate / clock.mean_rate)
        window, cells = WindowEvents.of(events), CELLS if grow else LAST_CELLS
        found = self._align(window, clock, at, start, cells, not grow)
        if start is not None and before is not None and not grow:
            tried = [] if before.rises else [(window, clock, -start)]
            for turned, stop in clock.turned(at):
                back = window.reversed_after(stop)
                tried += [(back, turned, start), (back, turned, -start)]
            scores = [self._align.score(*one, cells[0]) for one in tried]
            if tried and max(scores) > self._align.score(window, clock, start, cells[0]):
                other, clock, start = tried[int(np.argmax(scores))]
                again = self._align(other, clock, at, start, cells, True)
                found = max(found, again, key=lambda one: one.score)
        return Anchor(row, at, found, found.clock.rates())

    def _make_chain(self, number: int) -> Chain:
        return self._start_chain(number * CHAIN_WINDOWS * self._base)

    def _make_anchor(self, number: int, k: int) -> Anchor:
        """Make an anchor of a chain; those before it are estimated first.

        Args:
            number: Number of the chain.
            k: Number of the anchor in the chain.

        Returns:
            The anchor.
        """
        first, half = self._chain(number)
        if k == 0:
            return first
        before = self._anchor(number, k - 1)
        row = number * CHAIN_WINDOWS * self._base + k * half
        found = self._refine(row, half, before.aligned.u, before.aligned.clock)
        if found.aligned.score < MIN_SCORE_RATIO * before.aligned.score:
            other = self._start_chain(row, half).first
            if other.aligned.score > found.aligned.score:
                return other
        return found

    def window_events(self, t: int) -> int:
        """Return how many events on either side of a time (us) the flow there rests on."""
        row = max(self.recording.events.index(t + 1) - 1, 0)
        return self._chain(row // (CHAIN_WINDOWS * self._base)).half

    def _anchor_events(self, number: int) -> NDArray[np.int64]:
        """Return the events at which the anchors of a chain are."""
        length = CHAIN_WINDOWS * self._base
        end = min((number + 1) * length, len(self.recording.events))
        return np.arange(number * length, end, self._chain(number).half)

    def _around(self, start: int, stop: int, until: int) -> list[Anchor]:
        """Return the anchors that determine flow through a span of time.

        Args:
            start: Begin of the span, us.
            stop: End of the span, us.
            until: Time up to which a causal flow uses events, us.

        Returns:
            The anchors, of different times, in order.
        """
        events, length = self.recording.events, CHAIN_WINDOWS * self._base
        n = len(events)
        if not n:
            return []
        seen = events.index(until + 1)  # events that a causal flow may use
        low, high = max(events.index(start + 1) - 1, 0), min(events.index(stop), n - 1)
        found: list[Anchor] = []
        first = max(low // length - self.causal, 0)
        for number in range(first, min(high // length + 2, (n - 1) // length + 1)):
            if found and found[-1].row >= high:
                break
            rows = self._anchor_events(number)
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

    def _velocities_at(
        self, anchors: list[Anchor], knots: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return velocity and covariance of all nodes at some times.

        Args:
            anchors: Anchors around the times, in order; none: no velocity.
            knots: (K,) times, us.

        Returns:
            Velocity (K, rows, columns, 2), px/s, and covariance (K, rows, columns, 2, 2), (px/s)^2.
        """
        if not anchors:
            velocity = np.zeros((len(knots), *self._align.nodes, 2))
            return velocity, np.broadcast_to(UNKNOWN_VARIANCE * np.eye(2), (*velocity.shape, 2))
        times, own = [anchor.t for anchor in anchors], np.eye(len(anchors))
        weights = np.array([np.interp(knots, times, one) for one in own])
        rates, variances = (
            np.array([np.interp(knots, a.aligned.clock.t, a.rates[k]) for a in anchors])
            for k in range(2)
        )
        u = np.stack([anchor.aligned.u for anchor in anchors])
        spread = np.stack([anchor.aligned.covariance * anchor.rate**2 for anchor in anchors])
        squares = u[..., :, None] * u[..., None, :]
        covariance = np.tensordot(weights, spread, (0, 0))
        covariance += np.tensordot(weights * variances, squares, (0, 0))
        return np.tensordot(weights * rates, u, (0, 0)), covariance

    def paths(self, start: int, stop: int, at: int, *, until: int | None = None) -> WindowPaths:
        """Return the paths of the points that events of a window saw.

        Args:
            start: First time of the events, us.
            stop: Last time of the events, us.
            at: Time to which points are carried, us.
            until: Time up to which a causal flow may use events, us; None: the latest of the three.

        Returns:
            The paths.
        """
        start, stop = min(start, at), max(stop, at)
        with self._lock:
            anchors = self._around(start, stop, stop if until is None else until)
        times = [np.array([anchor.t for anchor in anchors] or [at])]
        for anchor in anchors:
            inner = anchor.aligned.clock.t[1:-1]
            times.append(inner[(inner >= start) & (inner <= stop)])
        knots = np.unique(np.concatenate(times).astype(np.int64))
        if len(knots) > MAX_KNOTS:
            knots = knots[np.linspace(0, len(knots) - 1, MAX_KNOTS).round().astype(int)]
        velocity, covariance = self._velocities_at(anchors, knots)
        spread = self._align.fill(covariance.mean(0))
        return WindowPaths(int(at), knots, velocity, spread[None], self._align.spacing)

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
                anchors = self._around(t, t, t)
            found = self._velocities_at(anchors, wanted[row : row + 1])
            mean[row], covariance[row] = (self._align.fill(one[0]) for one in found)
            if anchors:
                rate = np.interp(t, [a.t for a in anchors], [abs(a.rate) for a in anchors])
                valid[row] = np.linalg.eigvalsh(covariance[row])[..., 1] < MAX_VARIANCE * rate**2
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

    Hot pixels that make more than a twentieth of the events are left out, if there are others.

    Args:
        recording: The recording; frames are not used.
        params: The parameters; None: the defaults.
        causal: Whether flow at a time uses no later events.

    Returns:
        The flow: `mean, covariance, valid = flow(times)`.

    Raises:
        InputError: There are no events, or the parameters are of another method.
    """
    check_recording(recording, "flow_from_events")
    if not len(recording.events):
        raise InputError(f"{recording.name}: holds no events; give a recording with some")
    params = FlowParams() if params is None else params
    if not isinstance(params, FlowParams):
        raise InputError(f"params are {type(params).__name__}; give FlowParams")
    return EventFlow(remove_many_hot_events(recording), params, causal)
