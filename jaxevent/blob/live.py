"""Tracks of events that are still coming: from a camera, a socket, any iterator.

    live = jaxevent.blob.moment.live((240, 180), params)
    for events in camera:  # `jaxevent.Events`, one chunk after another
        live.add(events)
        mean, covariance, valid = live(live.stop)

States are those that `estimate` with `smooth=False` gives of all that has been added so far,
however it is divided into chunks. Only the targets, and the events since the last end of a cycle,
are held.
"""

import bisect
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent.blob.engine.tracking import FusedRun
from jaxevent.blob.lifecycle import Log, State, begin
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import NEVER, Features, Numeric, Packing
from jaxevent.blob.scan import ScanRun
from jaxevent.blob.seeds import Seeds, read_seeds
from jaxevent.blob.states import TrackStates, is_alive, tell
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots
from jaxevent.errors import InputError
from jaxevent.events.tail import Tail
from jaxevent.locks import TurnLock, refuse_to_pickle, synchronized
from jaxevent.recording import Events, Recording, Times, microseconds

STEPS, CHUNKS = 64, 8  # of a chunk, and chunks run together
BORN = 1 << 20  # serial number of the first target that is born; those given have lower ones


@functools.partial(jax.jit, static_argnames="filter")
def _read(
    filter: Filter, params: TrackerParams, slots: Slots, time: Array
) -> tuple[Array, Array, Array, Array]:
    """Mean, covariance, seconds without events and whether alive, of all targets at a time."""
    told = jax.vmap(functools.partial(tell, filter, params), (0, None))(slots, time)
    return *told, is_alive(params, slots, time)


class LiveTracks:
    """Targets of all events added so far: `mean, covariance, valid = live(times)`.

    Targets are given, at the start or by `add_target`, and with `detect` born where events belong
    to none. Each has a number that is never used again: those given count from 0 in that order,
    those born get theirs when they are confirmed, before which they are not told of. One thread may
    add what another reads.
    """

    def __init__(
        self,
        filter: Filter,
        params: TrackerParams,
        size: tuple[int, int],
        *,
        seeds: Sequence[Any] | NDArray | None,
        start: int | float | None,
        detect: bool | None,
        kernel: Callable[[Packing], FusedRun | None],
    ):
        self.params, self._filter, self._kernel = params, filter, kernel
        self._turns = TurnLock("live tracks")
        self._tail = Tail(*size)
        self._recording = Recording("live", *size, self._tail)
        self._detect = seeds is None if detect is None else detect
        self._packing: Packing | None = None
        self._count = 0  # numbers given to targets
        self._names: list[int] = []  # the number of each seed
        self._born: dict[int, int] = {}  # numbers of those born, by serial number, while they live
        self._waiting: list[Seeds] = []
        self._start = None if start is None else int(microseconds(start, "the start"))
        if self._start is not None:
            self._open(self._start)
        self._give(seeds)

    def __repr__(self) -> str:
        r = self._recording
        method = type(self.params).__module__.rpartition(".")[2]
        return f"LiveTracks({method}, {r.width}x{r.height}, {len(self._tail):,} events)"

    def __reduce__(self) -> tuple[Any, ...]:
        refuse_to_pickle("live tracks", "keep what they tell, live(times)")

    @property
    @synchronized
    def start(self) -> int:
        """The first time (us) of which states can still be had."""
        self._opened()
        return self._mark.start

    @property
    @synchronized
    def stop(self) -> int:
        """The time (us) of the last event, or where tracking begins if there is none."""
        return max(self._opened().start, self._tail.last)

    @synchronized
    def add(self, events: Events) -> None:
        """Add events that are not earlier than those before; raises `InputError` for bad ones."""
        if self._start is not None and isinstance(events, Events):
            events = events[events.index(self._start) :]
        self._tail.add(events)
        if not len(events):
            return
        if self._packing is None:
            self._open(int(events.t[0]))
        self._settle()

    @synchronized
    def add_target(
        self, x: float | int, y: float | int, size: float | int, time: int | float | None = None
    ) -> int:
        """Say where a target is, and return its number.

        It is at (x, y), has `size`, about twice the standard deviation of its events (px), and is
        confirmed at once. It begins at `time` (int us or float s), by default at the last event; if
        there is none yet, with the first one. The step is compiled again when more are alive than
        ever before. Raises `InputError` for a target outside the sensor or before `start`.
        """
        self._give([(x, y, size) if time is None else (x, y, size, time)])
        return self._count - 1

    @synchronized
    def __call__(self, times: Times) -> TrackStates:
        """States at `times` from `start` on, of the targets alive at one of them.

        After the last event they are predicted, as if no other came until then. `id` are the
        targets' numbers, (tracks,). Raises `InputError` for times that are forgotten.
        """
        us = np.atleast_1d(microseconds(times))
        if len(us) and us.min() < self.start:
            raise InputError(
                f"states at {us.min()} us were asked for, but those before {self.start} us are "
                "forgotten; ask before more events are added"
            )
        told = [self._read(int(time)) for time in us]
        ids = np.array(sorted({int(one) for names, *_ in told for one in names}), np.int64)
        shape, real = (len(us), len(ids)), np.dtype(jnp.result_type(float))
        mean, covariance = np.full((*shape, 8), np.nan, real), np.full((*shape, 8, 8), np.nan, real)
        idle, valid = np.full(shape, np.nan, real), np.zeros(shape, bool)
        for row, (names, *values) in enumerate(told):
            at = np.searchsorted(ids, names)
            for out, value in zip((mean, covariance, idle), values, strict=True):
                out[row, at] = value
            valid[row, at] = True
        return TrackStates(mean, covariance, valid, idle, ids)

    def _opened(self) -> Packing:
        if self._packing is None:
            raise InputError("nothing has been added yet; add events first")
        return self._packing

    def _open(self, start: int) -> None:
        """Tracking begins."""
        self._packing = packing = Packing(
            self._recording, self.params, [], start, NEVER - 1, self._detect,
            steps=STEPS, chunks=CHUNKS, as_stored=True,
        )  # fmt: skip
        self._runner: Any = self._kernel(packing) or ScanRun(self._filter, self.params)
        self._mark = packing.first
        self._state = self._nobody()
        for name, seeds in enumerate(self._waiting):
            self._insert(name, dataclasses.replace(seeds, t=np.maximum(seeds.t, start)))
        self._waiting = []

    def _nobody(self) -> State:
        features = self._opened().pack(self._mark, more=True).features
        state = begin(self._filter, self.params, features)
        return dataclasses.replace(state, next_id=jnp.asarray(BORN, jnp.int32))

    def _give(self, seeds: Sequence[Any] | NDArray | None) -> None:
        """Take seeds, or keep them until tracking begins."""
        read = read_seeds(self._recording, seeds, -NEVER, NEVER)
        for row in np.argsort(read.given):
            one = Seeds(*(part[row : row + 1] for part in dataclasses.astuple(read)))
            if self._packing is None:
                self._waiting.append(one)
            else:
                if one.t[0] == -NEVER:
                    one.t[0] = self.stop
                if one.t[0] < self._mark.start:
                    raise InputError(
                        f"the target begins at {one.t[0]} us, but what was before "
                        f"{self._mark.start} us is forgotten; give a later time"
                    )
                self._insert(self._count, one)
            self._count += 1

    def _insert(self, name: int, one: Seeds) -> None:
        """Put a seed among those to come, by time."""
        packing = self._opened()
        self._make_room()
        used = len(self._names)
        seeds, t = packing.seeds, int(one.t[0])
        at = bisect.bisect_right(seeds.t[:used].tolist(), t, lo=self._mark.seed)
        for values, value in ((seeds.t, t), (seeds.xi, one.xi[0]), (seeds.size, one.size[0])):
            values[at + 1 : used + 1] = values[at:used].copy()
            values[at] = value
        self._names.insert(at, name)

    def _make_room(self) -> None:
        """Leave out the seeds whose targets have ended, and if all are alive double their number.

        A seed is the target of its slot, so these are moved alike.
        """
        packing, sown = self._opened(), self._mark.seed
        old, used = packing.seeds, len(self._names)
        if used < len(old.t):
            return
        id = np.asarray(self._state.slots.id)
        kept = [k for k in range(used) if k >= sown or id[k] >= 0]
        living = [k for k in kept if k < sown]
        number = max(len(old.t), 1) if len(kept) < len(old.t) else max(2 * len(old.t), 1)
        t, xi, size = np.full(number, NEVER), np.zeros((number, 2)), np.ones(number)
        t[: len(kept)], xi[: len(kept)], size[: len(kept)] = (
            old.t[kept],
            old.xi[kept],
            old.size[kept],
        )
        packing.seeds = Seeds(t, xi, size, np.arange(number))
        self._names = [self._names[k] for k in kept]
        self._mark = self._mark._replace(seed=len(living))
        born = len(old.t) if self._detect else len(id)  # the first slot of those born

        def move(new: Numeric, before: Numeric) -> Array:
            rows = [np.asarray(before)[living], np.asarray(new)[len(living) : number]]
            rows.append(np.asarray(before)[born:])
            return jnp.asarray(np.concatenate(rows))

        state = self._state
        slots: Any = jax.tree.map(move, self._nobody().slots, state.slots)
        serial = np.array(slots.id)
        serial[: len(living)] = np.arange(len(living))
        slots = dataclasses.replace(slots, id=jnp.asarray(serial))
        self._state = State(slots, *jax.tree.map(jnp.asarray, (state.grid, state.next_id)))

    def _settle(self) -> None:
        """Track through the chunks that no event to come can change, and forget their events."""
        packing = self._opened()
        packing.rows = 0, len(self._tail)
        while True:
            stretch = packing.pack(self._mark, more=True)
            assert stretch.next is not None
            self._mark = stretch.next
            if stretch.used:
                self._state, log = self._runner.follow(self._state, stretch.features)
                self._name(jax.tree.map(np.asarray, log))
            if stretch.used < CHUNKS:
                break
        needed = self._mark.row
        if packing.prefilter:
            waiting = self._tail[needed : needed + 1].t
            first = int(waiting[0]) if len(waiting) else self._tail.last
            needed = min(needed, self._tail.index(first - packing.reach))
        self._tail.drop(needed)

    def _name(self, log: Log) -> None:
        """Give those that were confirmed a number, and forget those that have ended."""
        at = np.nonzero(log.confirmed & (log.before >= BORN))
        serial, first = np.unique(np.asarray(log.before)[at], return_index=True)
        for row in np.lexsort((serial, at[0][first])):
            if int(serial[row]) not in self._born:
                self._born[int(serial[row])] = self._count
                self._count += 1
        for one in np.asarray(log.before)[np.nonzero(log.ended)]:
            self._born.pop(int(one), None)

    def _read(self, time: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Numbers, means, covariances and seconds without events of those alive at a time."""
        packing, mark, state = self._opened(), self._mark, self._state
        packing.stop = max(self._tail.last, time) + 1
        while True:
            stretch = packing.pack(mark)
            if stretch.next is None or stretch.next.start > time:
                break
            mark, (state, _) = stretch.next, self._runner.follow(state, stretch.features)
        chunk, done, since = (int(one[0]) for one in stretch.find_steps(np.array([time])))
        state, _ = self._runner.follow(state, _cut(stretch.features, chunk, done))
        told = _read(self._filter, self.params, state.slots, np.int32(since))
        mean, covariance, idle, alive = (np.asarray(part) for part in told)
        serial = np.asarray(state.slots.id)
        names = [self._names[k] if 0 <= k < BORN else self._born.get(int(k), -1) for k in serial]
        told_of = np.flatnonzero(alive & (np.array(names) >= 0))
        return np.array(names)[told_of], mean[told_of], covariance[told_of], idle[told_of]


def _cut(f: Features, chunk: int, done: int) -> Features:
    """Chunks without what comes after so many steps of one."""
    valid, elapsed, cycle, seed = (np.array(p) for p in (f.valid, f.elapsed, f.cycle, f.seed))
    valid[chunk, done:], valid[chunk + 1 :] = False, False
    elapsed[chunk + 1 :] = 0
    cycle[chunk:] = False
    seed[seed > chunk] = -1
    return dataclasses.replace(f, valid=valid, elapsed=elapsed, cycle=cycle, seed=seed)
