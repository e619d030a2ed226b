"""Motion of a live stream of events, from a camera, a socket or any iterator.

    live = jaxevent.egomotion.voting.live((240, 180), model="rotation", camera=camera)
    for events in camera:  # `jaxevent.Events`, one chunk after another
        live.add(events)
        mean, covariance, valid = live(live.stop)
    live.finish()

Estimates are those of `voting.estimate` with `causal=True` on all events added so far, however the
events are divided into chunks. Only the latest estimates and the events that later estimates need
are kept.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.events.live import Tail
from jaxevent.recording import Events, Recording, Times, microseconds
from jaxevent.threads import TurnLock, refuse_to_pickle, synchronized

MAX_HELD_ESTIMATES = 4096  # latest estimates that are kept
MIN_DROPPED_EVENTS = 1 << 15  # number of unneeded events from which on they are dropped


class ChunkRunner(Protocol):
    """The filter over the chunks of a recording, see `particle_filter.estimator`."""

    params: Any  # parameters of the filter
    sampler: Any  # `CandidateSampler` of the filter

    def has_chunk(self) -> bool:
        """Return whether the next chunk is complete."""
        ...

    def run(self) -> Any:
        """Run the next chunk."""
        ...

    def causal_motion(self, parts: list[Any]) -> MotionEstimate:
        """Join the results of chunks to an estimate that uses no later events."""
        ...


class LiveMotion:
    """The motion of all events added so far: `mean, covariance, valid = live(times)`.

    One thread may add events while another reads the motion.

    Args:
        recording: A recording whose events are a `Tail`, without events so far.
        model: Motion model.
        make_runner: Function that makes the filter's runner, called after the first event.
    """

    def __init__(
        self, recording: Recording, model: type[Model], make_runner: Callable[[], ChunkRunner]
    ):
        self._turns = TurnLock("live motion")
        assert isinstance(recording.events, Tail)
        self._recording, self._tail = recording, recording.events
        self._make_runner = make_runner
        self._runner: ChunkRunner | None = None
        self._motion = dataclasses.replace(MotionEstimate.empty(model), causal=True)
        self._is_finished = False

    def __repr__(self) -> str:
        r = self._recording
        return (
            f"LiveMotion({self._motion.model.name}, {r.width}x{r.height}, "
            f"{len(self._tail):,} events)"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        refuse_to_pickle("live motion", "keep the estimates, live.motion")

    @property
    @synchronized
    def stop(self) -> int:
        """Time (us) of the last event."""
        if not len(self._tail):
            raise InputError("nothing has been added yet; add events first")
        return self._tail.last

    @property
    @synchronized
    def start(self) -> int:
        """Time (us) of the first event."""
        if not len(self._tail):
            raise InputError("nothing has been added yet; add events first")
        return int(self._tail[:1].t[0])

    @property
    @synchronized
    def motion(self) -> MotionEstimate:
        """The latest estimates."""
        return self._motion

    @synchronized
    def add(self, events: Events) -> MotionEstimate:
        """Add events that are not earlier than those added before.

        Args:
            events: The events.

        Returns:
            The new estimates.

        Raises:
            InputError: The events are not valid, or the stream was finished.
        """
        if self._is_finished:
            raise InputError("the live motion is finished; begin another one")
        self._tail.add(events)
        return self._run(until_end=False)

    @synchronized
    def finish(self) -> MotionEstimate:
        """Estimate the motion at the last events, and return the new estimates."""
        self._is_finished = True
        return self._run(until_end=True)

    @synchronized
    def __call__(self, times: Times) -> Estimate:
        """Return the motion at some times, as `MotionEstimate` does.

        Up to `tau_max` after the last estimate the motion is predicted. Later it is unknown, as in
        a pause of events.
        """
        us, motion = np.atleast_1d(microseconds(times)), self._motion
        mean, covariance, valid = motion(us, extrapolate=True)
        if self._runner is not None and len(motion):
            known = us <= motion.t[-1] + 1e6 * float(self._runner.params.tau_max)
            mean, valid = np.where(known[:, None], mean, np.nan), valid & known
        return Estimate(mean, covariance, valid)

    def _run(self, until_end: bool) -> MotionEstimate:
        """Run the chunks that later events cannot change."""
        if len(self._tail) and self._runner is None:
            self._runner = self._make_runner()
        runner, parts = self._runner, []
        while runner is not None and (runner.has_chunk() or until_end):
            if runner.sampler.is_exhausted:
                break
            parts.append(runner.run())
        if runner is None or not parts:
            return _take_estimates(self._motion, slice(0, 0))
        new = runner.causal_motion(parts)
        last = _take_estimates(self._motion, slice(-1, None))
        joined = _join(last, new)._with_gaps(float(runner.params.tau_max))
        new = _take_estimates(joined, slice(len(last), None))
        self._motion = _take_estimates(_join(self._motion, new), slice(-MAX_HELD_ESTIMATES, None))
        needed = self._tail.index(int(new.t[-1] - 1e6 * float(runner.params.tau_max)) - 1)
        needed = min(needed, runner.sampler.next_row)
        if needed - self._tail.dropped > MIN_DROPPED_EVENTS:
            self._tail.drop(needed)
        return new


def _take_estimates(motion: MotionEstimate, rows: slice) -> MotionEstimate:
    """Return the estimates of some rows."""
    arrays = {
        f.name: v[rows]
        for f in dataclasses.fields(motion)
        if isinstance(v := getattr(motion, f.name), np.ndarray)
    }
    return dataclasses.replace(motion, **arrays)


def _join(one: MotionEstimate, two: MotionEstimate) -> MotionEstimate:
    """Join two sequences of estimates."""
    arrays = {
        f.name: np.concatenate([getattr(one, f.name), v])
        for f in dataclasses.fields(two)
        if isinstance(v := getattr(two, f.name), np.ndarray)
    }
    return dataclasses.replace(two, **arrays)
