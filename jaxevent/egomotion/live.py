"""Motion of a live stream of events: from a camera, a socket, any iterator.

    live = jaxevent.egomotion.voting.live((240, 180), model="rotation", camera=camera)
    for events in camera:  # `jaxevent.Events`, one chunk after another
        live.add(events)
        mean, covariance, valid = live(live.stop)
    live.finish()

Estimates are those of `voting.estimate` with `causal=True` on all events added so far, however they
are divided into chunks. Only the latest estimates are held, and the events that later ones need.
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

HELD_ESTIMATES = 4096  # the latest ones, which are read
DROPPED_EVENTS = 1 << 15  # from so many on they are dropped


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
        """Join chunks to an estimate."""
        ...


class LiveMotion:
    """The motion of all events added so far: `mean, covariance, valid = live(times)`.

    One thread may add what another reads.

    Args:
        recording: A recording without events, whose events are a `Tail`.
        model: Motion model.
        make_runner: Function that makes the runner of the filter, once the first event is there.
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
        """Add events that are not earlier than those before.

        Args:
            events: The events.

        Returns:
            The estimates that are new.

        Raises:
            InputError: The events are not valid, or the stream was finished.
        """
        if self._is_finished:
            raise InputError("the live motion is finished; begin another one")
        self._tail.add(events)
        return self._run(until_end=False)

    @synchronized
    def finish(self) -> MotionEstimate:
        """Estimate the motion at the last events, and return the estimates that are new."""
        self._is_finished = True
        return self._run(until_end=True)

    @synchronized
    def __call__(self, times: Times) -> Estimate:
        """Return the motion at some times, as `MotionEstimate` does.

        Later ones are predicted, for as long as candidates live (`tau_max`). After that nothing is
        known, as in a pause of events.
        """
        us, motion = np.atleast_1d(microseconds(times)), self._motion
        mean, covariance, valid = motion(us, extrapolate=True)
        if self._runner is not None and len(motion):
            known = us <= motion.t[-1] + 1e6 * float(self._runner.params.tau_max)
            mean, valid = np.where(known[:, None], mean, np.nan), valid & known
        return Estimate(mean, covariance, valid)

    def _run(self, until_end: bool) -> MotionEstimate:
        """Run the chunks that no event to come can change."""
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
        self._motion = _take_estimates(_join(self._motion, new), slice(-HELD_ESTIMATES, None))
        needed = self._tail.index(int(new.t[-1] - 1e6 * float(runner.params.tau_max)) - 1)
        needed = min(needed, runner.sampler.next_row)
        if needed - self._tail.dropped > DROPPED_EVENTS:
            self._tail.drop(needed)
        return new


def _take_estimates(motion: MotionEstimate, rows: slice) -> MotionEstimate:
    """Return some estimates."""
    arrays = {
        f.name: v[rows]
        for f in dataclasses.fields(motion)
        if isinstance(v := getattr(motion, f.name), np.ndarray)
    }
    return dataclasses.replace(motion, **arrays)


def _join(one: MotionEstimate, two: MotionEstimate) -> MotionEstimate:
    """Return the estimates of both."""
    arrays = {
        f.name: np.concatenate([getattr(one, f.name), v])
        for f in dataclasses.fields(two)
        if isinstance(v := getattr(two, f.name), np.ndarray)
    }
    return dataclasses.replace(two, **arrays)
