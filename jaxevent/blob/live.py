"""Tracks of a live stream of events: from a camera, a socket, any iterator.

    live = jaxevent.blob.moment.live((240, 180), params)
    for events in camera:  # `jaxevent.Events`, one chunk after another
        live.add(events)
        mean, covariance, valid = live(live.stop)

States equal those of `estimate` with `smooth=False` on all events added so far, however they are
divided into chunks. Only the targets, and the events since the last end of a cycle, are held.
"""

import bisect
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.blob.filter import Filter
from jaxevent.blob.lifecycle import LifecycleLog, TrackerState, init_state
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import NEVER_US, ChunkPacker, Features, Numeric
from jaxevent.blob.seeds import Seeds, read_seeds
from jaxevent.blob.track import TrackBuffer, TrackStates, is_alive, readout
from jaxevent.errors import InputError
from jaxevent.events.live import Tail
from jaxevent.recording import Events, Recording, Times, microseconds, one_time
from jaxevent.threads import TurnLock, refuse_to_pickle, synchronized

STEPS_PER_CHUNK, CHUNKS_PER_RUN = 64, 8
FIRST_DETECTED_ID = 1 << 20  # serial number of the first detected target; seeds have lower ones


@functools.partial(jax.jit, static_argnames="filter")
def _read_all(
    filter: Filter, params: TrackerParams, tracks: TrackBuffer, time: Array
) -> tuple[Array, Array, Array, Array]:
    """Read out all tracks at a time.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        tracks: The tracks.
        time: () us since the chunk's start.

    Returns:
        Mean (targets, 8), covariance (targets, 8, 8), time since the last event (targets,), s, and
        whether the track is alive (targets,).
    """
    states = jax.vmap(functools.partial(readout, filter, params), (0, None))(tracks, time)
    return *states, is_alive(params, tracks, time)


class LiveTracks:
    """Targets of all events added so far: `mean, covariance, valid = live(times)`.

    Targets are given, at the start or by `add_target`, and with `detect` born of unassociated
    events. Each has a number that is never used again. Given ones count from 0 in that order;
    detected ones get theirs when they are confirmed, and are not reported before. One thread may
    add what another reads.
    """

    def __init__(
        self,
        filter: Filter,
        runner: Any,
        size: tuple[int, int],
        *,
        seeds: Sequence[Any] | NDArray | None,
        start: int | float | None,
        detect: bool,
    ):
        self.params, self._filter, self._runner = runner.params, filter, runner
        self._turns = TurnLock("live tracks")
        self._tail = Tail(*size)
        self._recording = Recording("live", *size, self._tail)
        self._detect = detect
        self._packer: ChunkPacker | None = None
        self._n_ids = 0  # numbers given to targets
        self._seed_ids: list[int] = []  # the number of each seed
        self._detected_ids: dict[int, int] = {}  # numbers of living targets by serial number
        self._pending_seeds: list[Seeds] = []
        self._start = None if start is None else one_time(start, "the start")
        if self._start is not None:
            self._start_tracking(self._start)
        self._add_seeds(seeds)

    def __repr__(self) -> str:
        r = self._recording
        method = type(self.params).__module__.rpartition(".")[2]
        return f"LiveTracks({method}, {r.width}x{r.height}, {len(self._tail):,} events)"

    def __reduce__(self) -> tuple[Any, ...]:
        refuse_to_pickle("live tracks", "keep the states, live(times)")

    @property
    @synchronized
    def start(self) -> int:
        """The first time (us) of which states are still available."""
        self._require_packer()
        return self._cursor.start

    @property
    @synchronized
    def stop(self) -> int:
        """The time (us) of the last event, or the begin of tracking if there is none."""
        return max(self._require_packer().start, self._tail.last)

    @synchronized
    def add(self, events: Events) -> None:
        """Add events that are not earlier than those before; raises `InputError` for bad ones."""
        if self._start is not None and isinstance(events, Events):
            events = events[events.index(self._start) :]
        self._tail.add(events)
        if not len(events):
            return
        if self._packer is None:
            self._start_tracking(int(events.t[0]))
        self._run_complete_chunks()

    @synchronized
    def add_target(
        self, x: float | int, y: float | int, size: float | int, time: int | float | None = None
    ) -> int:
        """Add a target, which is confirmed at once.

        The step is compiled again when more targets are alive than ever before.

        Args:
            x: Column, px.
            y: Row, px.
            size: Standard deviation of its events, px.
            time: Begin of its track, int us or float s; None: the last event, or the first one if
                there is none yet.

        Returns:
            The target's number.

        Raises:
            InputError: It is outside the sensor, or begins before `start`.
        """
        self._add_seeds([(x, y, size) if time is None else (x, y, size, time)])
        return self._n_ids - 1

    @synchronized
    def __call__(self, times: Times) -> TrackStates:
        """Read out the targets that are alive at one of some times.

        After the last event states are predicted, as if no other came until then.

        Args:
            times: Integers (us) or floats (s), from `start` on.

        Returns:
            States (times, tracks); `id` are the targets' numbers, (tracks,).

        Raises:
            InputError: A time is before `start`.
        """
        us = np.atleast_1d(microseconds(times))
        if len(us) and us.min() < self.start:
            raise InputError(
                f"states at {us.min()} us are not available, those before {self.start} us are "
                "forgotten; read before more events are added"
            )
        states = [self._read(int(time)) for time in us]
        ids = np.array(sorted({int(one) for numbers, *_ in states for one in numbers}), np.int64)
        shape, real = (len(us), len(ids)), np.dtype(jnp.result_type(float))
        mean, covariance = np.full((*shape, 8), np.nan, real), np.full((*shape, 8, 8), np.nan, real)
        idle, valid = np.full(shape, np.nan, real), np.zeros(shape, bool)
        for row, (numbers, *values) in enumerate(states):
            at = np.searchsorted(ids, numbers)
            for out, value in zip((mean, covariance, idle), values, strict=True):
                out[row, at] = value
            valid[row, at] = True
        return TrackStates(mean, covariance, valid, idle, ids)

    def _require_packer(self) -> ChunkPacker:
        if self._packer is None:
            raise InputError("nothing has been added yet; add events first")
        return self._packer

    def _start_tracking(self, start: int) -> None:
        self._packer = packer = ChunkPacker(
            self._recording, self.params, [], start, NEVER_US - 1, self._detect,
            steps=STEPS_PER_CHUNK, chunks=CHUNKS_PER_RUN, as_stored=True, live=True,
        )  # fmt: skip
        self._cursor = packer.first
        self._state = self._empty_state()
        for number, seeds in enumerate(self._pending_seeds):
            self._insert_seed(number, dataclasses.replace(seeds, t=np.maximum(seeds.t, start)))
        self._pending_seeds = []

    def _empty_state(self) -> TrackerState:
        features = self._require_packer().pack(self._cursor, more=True).features
        state = init_state(self._filter, self.params, features)
        return dataclasses.replace(state, next_id=jnp.asarray(FIRST_DETECTED_ID, jnp.int32))

    def _add_seeds(self, seeds: Sequence[Any] | NDArray | None) -> None:
        """Insert seeds, or keep them until tracking begins."""
        read = read_seeds(self._recording, seeds, -NEVER_US, NEVER_US)
        for row in np.argsort(read.index):
            one = Seeds(*(part[row : row + 1] for part in dataclasses.astuple(read)))
            if self._packer is None:
                self._pending_seeds.append(one)
            else:
                if one.t[0] == -NEVER_US:
                    one.t[0] = self.stop
                if one.t[0] < self._cursor.start:
                    raise InputError(
                        f"the target begins at {one.t[0]} us, but everything before "
                        f"{self._cursor.start} us is forgotten; give a later time"
                    )
                self._insert_seed(self._n_ids, one)
            self._n_ids += 1

    def _insert_seed(self, number: int, one: Seeds) -> None:
        """Insert a seed among those to come, by time."""
        packer = self._require_packer()
        self._make_room()
        used = len(self._seed_ids)
        seeds, t = packer.seeds, int(one.t[0])
        at = bisect.bisect_right(seeds.t[:used].tolist(), t, lo=self._cursor.seed)
        for values, value in ((seeds.t, t), (seeds.xi, one.xi[0]), (seeds.size, one.size[0])):
            values[at + 1 : used + 1] = values[at:used].copy()
            values[at] = value
        self._seed_ids.insert(at, number)

    def _make_room(self) -> None:
        """Drop the seeds of ended targets; if all are alive, double the capacity.

        A seed has the buffer's entry with its index, so both are moved alike.
        """
        packer, begun = self._require_packer(), self._cursor.seed
        old, used = packer.seeds, len(self._seed_ids)
        if used < len(old.t):
            return
        id = np.asarray(self._state.tracks.id)
        kept = [k for k in range(used) if k >= begun or id[k] >= 0]
        living = [k for k in kept if k < begun]
        number = max(len(old.t), 1) if len(kept) < len(old.t) else max(2 * len(old.t), 1)
        t, xi, size = np.full(number, NEVER_US), np.zeros((number, 2)), np.ones(number)
        for new, before in ((t, old.t), (xi, old.xi), (size, old.size)):
            new[: len(kept)] = before[kept]
        packer.seeds = Seeds(t, xi, size, np.arange(number))
        self._seed_ids = [self._seed_ids[k] for k in kept]
        self._cursor = self._cursor._replace(seed=len(living))
        detected = len(old.t) if self._detect else len(id)  # the first entry of detected targets

        def move(new: Numeric, before: Numeric) -> Array:
            rows = [np.asarray(before)[living], np.asarray(new)[len(living) : number]]
            rows.append(np.asarray(before)[detected:])
            return jnp.asarray(np.concatenate(rows))

        state = self._state
        tracks: Any = jax.tree.map(move, self._empty_state().tracks, state.tracks)
        serial = np.array(tracks.id)
        serial[: len(living)] = np.arange(len(living))
        tracks = dataclasses.replace(tracks, id=jnp.asarray(serial))
        rest = jax.tree.map(jnp.asarray, (state.grid, state.next_id))
        self._state = TrackerState(tracks, *rest)

    def _run_complete_chunks(self) -> None:
        """Run the chunks that no event to come can change, and forget their events."""
        packer = self._require_packer()
        packer.rows = 0, len(self._tail)
        while True:
            segment = packer.pack(self._cursor, more=True)
            assert segment.next is not None
            self._cursor = segment.next
            if segment.n_chunks:
                self._state, log = self._runner.run(self._state, segment.features)
                self._assign_ids(jax.tree.map(np.asarray, log))
            if segment.n_chunks < CHUNKS_PER_RUN:
                break
        needed = self._cursor.row
        if packer.prefilter:
            waiting = self._tail[needed : needed + 1].t
            first = int(waiting[0]) if len(waiting) else self._tail.last
            needed = min(needed, self._tail.index(first - packer.prefilter_us))
        self._tail.drop(needed)

    def _assign_ids(self, log: LifecycleLog) -> None:
        """Number the targets that were confirmed, and forget those that have ended."""
        before = np.asarray(log.id_before)
        at = np.nonzero(log.confirmed & (before >= FIRST_DETECTED_ID))
        serial, first = np.unique(before[at], return_index=True)
        for row in np.lexsort((serial, at[0][first])):
            if int(serial[row]) not in self._detected_ids:
                self._detected_ids[int(serial[row])] = self._n_ids
                self._n_ids += 1
        for one in before[np.nonzero(log.end_reason)]:
            self._detected_ids.pop(int(one), None)

    def _read(self, time: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Read out the living targets at a time (us): numbers, means, covariances, idle times."""
        packer, cursor, state = self._require_packer(), self._cursor, self._state
        packer.stop = max(self._tail.last, time) + 1
        while True:
            segment = packer.pack(cursor)
            if segment.next is None or segment.next.start > time:
                break
            cursor, (state, _) = segment.next, self._runner.run(state, segment.features)
        chunk, done, since = (int(one[0]) for one in segment.find_steps(np.array([time])))
        state, _ = self._runner.run(state, _truncate(segment.features, chunk, done))
        states = _read_all(self._filter, self.params, state.tracks, np.int32(since))
        mean, covariance, idle, alive = (np.asarray(part) for part in states)
        numbers = np.array([
            self._seed_ids[k] if 0 <= k < FIRST_DETECTED_ID else self._detected_ids.get(int(k), -1)
            for k in np.asarray(state.tracks.id)
        ])  # fmt: skip
        at = np.flatnonzero(alive & (numbers >= 0))
        return numbers[at], mean[at], covariance[at], idle[at]


def _truncate(f: Features, chunk: int, done: int) -> Features:
    """Remove the events after some steps of a chunk, and what later chunks hold.

    Args:
        f: Chunks of a segment.
        chunk: Number of the chunk.
        done: Number of its steps that are kept.

    Returns:
        The segment without them.
    """
    valid, elapsed, cycle, seed = (np.array(p) for p in (f.valid, f.elapsed, f.cycle, f.seed))
    valid[chunk, done:], valid[chunk + 1 :] = False, False
    elapsed[chunk + 1 :] = 0
    cycle[chunk:] = False
    seed[seed > chunk] = -1
    return dataclasses.replace(f, valid=valid, elapsed=elapsed, cycle=cycle, seed=seed)
