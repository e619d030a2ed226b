"""The windows of a recording's events: equations, and their solutions on the host."""

import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxevent.calibration.event_calibration import calibrate_events, remove_many_hot_events
from jaxevent.codegen import map_ahead
from jaxevent.event_flow import EventFlow, FlowParams, WindowPaths
from jaxevent.reconstruction.events_only.frames import FrameMeasurements, FrameScale
from jaxevent.reconstruction.events_only.memory import KeyMemories, fuse
from jaxevent.reconstruction.events_only.params import Params
from jaxevent.reconstruction.events_only.prior import GradientPrior, SolverParams
from jaxevent.reconstruction.events_only.rows import Rows, make_rows
from jaxevent.reconstruction.events_only.solve import Solution, solve
from jaxevent.reconstruction.video import FlowSource
from jaxevent.recording import Events, Recording

ROW_COLUMNS = ("corner", "fraction", "change", "weight", "kind", "pixel")
N_MOTION_KNOTS = 5  # times of a window at which a given motion is read


class SolvedWindow(NamedTuple):
    """The equations of a window, and their solution."""

    rows: Rows
    prior: GradientPrior
    solution: Solution
    scale: FrameScale | None  # None: intensity has no scale


class WindowSolver:
    """Solves for the image at a time: `solved = windows(t)`, t in us.

    Args:
        recording: Events.
        params: Parameters.
        causal: Whether images rest on earlier events alone.
        motion: Optical flow that is known beforehand; None: that of the events.
    """

    def __init__(
        self,
        recording: Recording,
        params: Params,
        *,
        causal: bool = False,
        motion: FlowSource | None = None,
    ):
        self.params, self.causal = params, causal
        self.shape = (recording.height, recording.width)
        self.n_side = max(round(float(params.window) * self.shape[0] * self.shape[1]), 1)
        self.relative = np.ones((2, *self.shape), np.float32)
        self.muted = np.zeros(self.shape, bool)
        if params.learn:
            found = calibrate_events(recording)
            self.relative, self.muted = found.thresholds, found.hot | ~found.read_out
            recording = remove_many_hot_events(recording, found)
        self.recording = recording
        self.flow = EventFlow(recording, FlowParams(), causal) if motion is None else motion
        c = np.array([params.c_on, params.c_off], np.float32)
        self.thresholds = self.relative * c[:, None, None]
        self.numbers = SolverParams(*(float(value) for value in params.solver()))
        itself: Any = weakref.proxy(self)  # lest both wait until cycles are collected
        self.memory = KeyMemories(
            itself,
            recording,
            self.n_side,
            silence=self.numbers.silence,
            threshold=float(self.thresholds.mean()),
        )

        self.frames: FrameMeasurements | None = None
        if params.use_frames and recording.frames is not None:
            numbers = (float(params.I0), float(params.frame_delay))
            self.frames = FrameMeasurements(self, recording, *numbers, causal)

    def rows_around(self, t: int) -> Rows:
        """Return the equations of the events around a time (us) for the image there."""
        place = self.recording.events.index(t)
        events = self.events(max(place - self.n_side, 0), place + self.n_side)
        span = (int(events.t[0]), int(events.t[-1])) if len(events) else (t, t)
        span = min(span[0], t), max(span[1], t)
        paths = self.paths(*span, t)
        return make_rows(events, paths, self.thresholds, self.shape, span, self.muted)

    def paths(self, start: int, stop: int, at: int, *, until: int | None = None) -> WindowPaths:
        """Return the paths of points through a window, see `EventFlow.paths`.

        Args:
            start: Begin of the window, us.
            stop: Its end, us.
            at: Time to which points are carried, us.
            until: Time up to which a causal flow may use events, us; None: the latest of the three.

        Returns:
            The paths.
        """
        if isinstance(self.flow, EventFlow):
            return self.flow.paths(start, stop, at, until=until)
        low, high = min(start, at), max(stop, at)
        knots = np.unique(np.linspace(low, high, N_MOTION_KNOTS).astype(np.int64))
        velocity = np.nan_to_num(np.asarray(self.flow.flow(knots, extrapolate=True), np.float32))
        return WindowPaths(at, knots, velocity)

    def events(self, first: int, last: int) -> Events:
        """Return the events of some rows of the recording, without those of muted pixels.

        Args:
            first: First row.
            last: Row after the last one.

        Returns:
            The events.
        """
        events = self.recording.events[first:last]
        return events[~self.muted[events.y, events.x]]

    def __call__(
        self, t: int, *, variance: bool = True, held_out: Callable[[Rows], NDArray] | None = None
    ) -> SolvedWindow:
        """Solve for the image at a time.

        Args:
            t: Time, us.
            variance: Whether the variance is wanted.
            held_out: Chooses rows (booleans) that the solution does not see.

        Returns:
            The window's equations and solution.
        """
        return self._set_up(t, held_out).solve(variance)

    def each(
        self,
        times: Iterable[int],
        *,
        variance: bool = True,
        held_out: Callable[[Rows], NDArray] | None = None,
    ) -> Iterator[SolvedWindow]:
        """Solve for the images at some times, each while the equations of later ones are set up.

        Args:
            times: Times, us.
            variance: Whether the variances are wanted.
            held_out: Chooses rows (booleans) that the solutions do not see.

        Yields:
            The windows' equations and solutions.
        """
        windows = (self._set_up(t, held_out) for t in times)
        return map_ahead(lambda window: window.solve(variance), windows)

    def _set_up(self, t: int, held_out: Callable[[Rows], NDArray] | None) -> "_Window":
        """Set up the equations of the image at a time.

        A window begins at a key of the memory, and ends at one or, where images are causal, at t.
        Args:
            t: Time of the image, us.
            held_out: Chooses rows (booleans) that the solution does not see; None: it sees all.

        Returns:
            The equations.
        """
        memory, place = self.memory, self.recording.events.index(t)
        ahead = 0 if self.causal else min(self.n_side, len(self.recording.events) - place)
        first = max(place + ahead - 2 * self.n_side, 0) // memory.step
        if self.causal:
            last, end, stop = None, place, t
        else:
            last = memory.key_after(max(place + ahead, 2 * self.n_side))
            end, stop = memory.row(last), memory.time(last)
        start = memory.time(first)
        span = min(start, t), max(stop, t)
        events = self.events(memory.row(first), end)
        paths = self.paths(*span, t)
        rows = make_rows(events, paths, self.thresholds, self.shape, span, self.muted)
        prior, scale = memory.prior(rows, t, first, last), None
        measured = None if self.frames is None else self.frames(t, memory.threshold)
        if measured is not None:
            prior, scale = fuse(prior, measured[0], memory.threshold), measured[1]
        seen = rows
        if held_out is not None:
            kept = ~held_out(rows)
            seen = rows._replace(**{name: getattr(rows, name)[kept] for name in ROW_COLUMNS})
        return _Window(rows, seen, prior, scale, self.numbers)


class _Window(NamedTuple):
    """The equations of a window."""

    rows: Rows
    seen: Rows  # those that the solution sees
    prior: GradientPrior
    scale: FrameScale | None
    params: SolverParams

    def solve(self, variance: bool) -> SolvedWindow:
        solution = solve(self.seen, self.prior, self.params, variance=variance)
        return SolvedWindow(self.rows, self.prior, solution, self.scale)
