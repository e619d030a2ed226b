"""Runs of chunks by XLA: followed, and run again to be read, with what later events say."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaxevent import dispatch
from jaxevent.blob.lifecycle import Log, State, begin
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Stretch
from jaxevent.blob.run import run_compiled
from jaxevent.blob.smoother import (
    Later,
    Smoothed,
    at_end,
    look_back,
    nothing_later,
    tell_smoothed,
)
from jaxevent.blob.states import tell
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots, scan_steps

READS = 64  # times read per call

_begin = jax.jit(begin, static_argnames="filter")
_nothing_later = jax.jit(lambda begins: nothing_later(jax.tree.map(lambda a: a[-1], begins)))


class Following(NamedTuple):
    """What later events say at the start of the chunk that follows, and its us since this one's.

    And the chunk smoothed with it, where that is kept.
    """

    later: Later
    elapsed: Any
    smoothed: Smoothed | None = None


class ScanRun:
    """Tracks through chunks by `run`."""

    def __init__(self, filter: Filter, params: TrackerParams):
        self._given = filter, params

    @property
    def _parts(self) -> tuple[Filter, TrackerParams]:
        """Return the arguments of all its programs; raises `InputError` where none can run."""
        dispatch.check_threads()
        return self._given

    def begin(self, features: Features) -> State:
        """No track yet."""
        return _begin(*self._parts, features)

    def follow(self, state: State, features: Features) -> tuple[State, Log]:
        """The state at the end, with births and deaths."""
        state, told = run_compiled(*self._parts, state, features)
        return state, told.log

    def play(self, state: State, features: Features) -> tuple[State, Slots]:
        """The state at the end, and the targets at chunks' starts, to be read."""
        state, told = run_compiled(*self._parts, state, features)
        assert told.slots is not None
        return state, told.slots

    def owners(self, state: State, features: Features) -> tuple[State, NDArray[np.int32], NDArray]:
        """The state at the end, serial numbers of the likeliest targets of events, and weights."""
        state, told = run_compiled(*self._parts, state, features)
        assert told.association is not None
        return state, np.asarray(told.association.id), np.asarray(told.association.weight)

    def look_back(
        self, stretch: Stretch, begins: Slots, later: Later | None, elapsed: int, room: int = 0
    ) -> tuple[list[Following], Later]:
        """What later events say after each chunk, and at the stretch's start.

        `later` is that at the start of the next one, `elapsed` us after this one's last chunk.
        Smoothed chunks are kept if all are at most `room` numbers.
        """
        later = _nothing_later(begins) if later is None else later
        features, found = jax.device_put(stretch.features), []
        used = stretch.used
        moment = numbers_in(later) + numbers_in(begins) // len(stretch.start)
        keep = used * (stretch.features.t.shape[1] + 1) * moment <= room
        for chunk in reversed(range(used)):
            at = Following(later, np.int32(elapsed))
            smoothed, later = _smooth(*self._parts, features, begins, np.int32(chunk), at)
            found.append(at._replace(smoothed=smoothed) if keep else at)
            elapsed = int(stretch.features.elapsed[chunk])
        return found[::-1], jax.device_get(later)

    def read(
        self,
        stretch: Stretch,
        begins: Slots,
        following: Sequence[Following] | None,
        times: NDArray[np.int64],
        serial: NDArray[np.int64],
        wanted: NDArray[np.bool_],
    ) -> tuple[NDArray, ...]:
        """Mean, covariance and idle of tracks at sorted times of a stretch; NaN if not `wanted`.

        Smoothed with what `look_back` said, `following`; None: filtered.
        """
        real, shape = np.dtype(jnp.result_type(float)), wanted.shape
        out = tuple(np.full((*shape, *size), np.nan, real) for size in ((8,), (8, 8), ()))
        features, id = jax.device_put(stretch.features), np.asarray(begins.id)
        chunks, steps, since = stretch.find_steps(times)
        since = since.astype(np.int32)
        for chunk in np.unique(chunks):
            rows = np.flatnonzero(chunks == chunk)
            some = np.flatnonzero(wanted[rows].any(0))
            if not len(some):
                continue
            slot = np.argmax(id[chunk] == serial[some][:, None], axis=1)
            slot = np.pad(slot, (0, -len(slot) % 8))
            read = self._reader(features, begins, following, int(chunk))
            for first in range(0, len(rows), READS):
                part = rows[first : first + READS]
                fill = (0, READS - len(part))
                told = read(np.pad(steps[part], fill), np.pad(since[part], fill), slot)
                at = np.ix_(part, some)
                for one, value in zip(out, told, strict=True):
                    value = np.asarray(value)[: len(part), : len(some)]
                    seen = wanted[at].reshape(*value.shape[:2], *[1] * (value.ndim - 2))
                    one[at] = np.where(seen, value, np.nan)
        return out

    def _reader(
        self, features: Features, begins: Slots, following: Sequence[Following] | None, chunk: int
    ) -> Any:
        """What reads a chunk at steps, times and slots."""
        if following is None:
            return functools.partial(_read, *self._parts, features, begins, np.int32(chunk))
        smoothed = following[chunk].smoothed
        if smoothed is None:
            at = np.int32(chunk), following[chunk]
            smoothed, _ = _smooth(*self._parts, features, begins, *at)
        return functools.partial(_read_smoothed, *self._parts, smoothed)


def numbers_in(tree: Any) -> int:
    """How many numbers its arrays hold."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@functools.partial(jax.jit, static_argnames="filter")
def _read(
    filter: Filter,
    params: TrackerParams,
    features: Features,
    begins: Slots,
    chunk: Array,
    step: Array,
    time: Array,
    slot: Array,
) -> tuple[Array, Array, Array]:
    """Mean, covariance and seconds without events, (times, tracks, ...), of some slots.

    The chunk is run again from the targets at its start; a time is after `step` of its steps.
    """
    path = _path_of(filter, params, features, begins, chunk)
    slots = jax.tree.map(lambda a: a[step[:, None], slot], path)
    of_one = functools.partial(tell, filter, params)
    return jax.vmap(jax.vmap(of_one, (0, None)))(slots, time)


@functools.partial(jax.jit, static_argnames="filter")
def _smooth(
    filter: Filter,
    params: TrackerParams,
    features: Features,
    begins: Slots,
    chunk: Array,
    following: Following,
) -> tuple[Smoothed, Later]:
    """A chunk's path, run again, with what later events say; and what they say at its start."""
    path = _path_of(filter, params, features, begins, chunk)
    end = jax.tree.map(lambda a: a[-1], path)
    later = look_back(filter, params, path, at_end(following.later, end, following.elapsed))
    return Smoothed(path, later), jax.tree.map(lambda a: a[0], later)


@functools.partial(jax.jit, static_argnames="filter")
def _read_smoothed(
    filter: Filter, params: TrackerParams, smoothed: Smoothed, step: Array, time: Array, slot: Array
) -> tuple[Array, Array, Array]:
    """As `_read`, of a chunk that is smoothed."""
    now = jax.tree.map(lambda a: a[step[:, None], slot], smoothed)
    of_one = functools.partial(tell_smoothed, filter, params)
    return jax.vmap(jax.vmap(of_one, (0, 0, None)))(now.slots, now.later, time)


def _path_of(
    filter: Filter, params: TrackerParams, features: Features, begins: Slots, chunk: Array
) -> Slots:
    """All targets (steps + 1, targets) of a chunk: at its start and after each of its steps."""
    f = features
    before = jax.tree.map(lambda a: a[chunk], begins)
    events = f.t[chunk], f.xi[chunk], f.polarity[chunk], f.valid[chunk]
    events = *events, None if f.owner is None else f.owner[chunk]
    _, steps = scan_steps(filter, params, "states", f.frame, before, events)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), before, steps.slots)
