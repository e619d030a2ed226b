"""The driver of all trackers: chunks are scanned, and in each its steps.

`run` is pure and differentiable. `XlaRunner` runs segments by it, and runs them again to read them
out; where there is a kernel, `engine.runner.KernelRunner` takes its place.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from jaxevent import threads
from jaxevent.blob.filter import Filter
from jaxevent.blob.lifecycle import (
    LifecycleLog,
    TrackerState,
    accumulate_clutter,
    init_state,
    manage_tracks,
    shift_state,
    spawn_seeded_tracks,
)
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Segment
from jaxevent.blob.smoother import (
    BackwardInfo,
    SmoothedTracks,
    backward_pass,
    propagate_to_chunk_end,
    readout_smoothed,
    terminal_info,
)
from jaxevent.blob.track import TrackBuffer, positions, readout, run_steps

READOUT_TIMES_PER_CALL = 64  # times read out by one compiled call


class EventAssociation(eqx.Module):
    """The likeliest track of each event.

    Attributes:
        id: Serial number of the track; -1 for none.
        weight: Weight of the event for this track.
    """

    id: Int[Array, "*chunks steps M"]
    weight: Float[Array, "*chunks steps M"]


class ChunkInfo(eqx.Module):
    """Report of each chunk; fields that were not requested are None.

    Attributes:
        log: Births, confirmations and deaths.
        tracks: The tracks before the first step; with "states" those of steps + 1 moments.
        association: The likeliest track of each event.
        path: p (px), v (px/s) and time of the last update (us) of steps + 1 moments.
        loss: Sum of the losses of the events that count.
        count: Number of events that count.
    """

    log: LifecycleLog
    tracks: TrackBuffer | None = None
    association: EventAssociation | None = None
    path: tuple[Array, Array, Array] | None = None
    loss: Array | None = None
    count: Array | None = None


def run(
    filter: Filter,
    params: TrackerParams,
    state: TrackerState | None,
    features: Features,
    output: str | None = None,
) -> tuple[TrackerState, ChunkInfo]:
    """Track through chunks. Pure; differentiable with the memory of one chunk and of its starts.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        state: State that the run before returned; None: the recording starts here.
        features: The chunks.
        output: Fields to report beside births and deaths: "states" the tracks at each chunk's start
            and after each step, "path" their positions, "associated" or "all" the negative
            log-likelihood of events, None the tracks at each chunk's start and the association.

    Returns:
        The state at the end, and the reports of all chunks.
    """
    features = jax.tree.map(jnp.asarray, features)
    if state is None:
        state = init_state(filter, params, features)
    parts = (
        jnp.arange(len(features.t), dtype=jnp.int32), features.t, features.xi, features.polarity,
        features.valid, features.owner, features.elapsed, features.stop, features.cycle,
    )  # fmt: skip
    chunk = functools.partial(_run_chunk, filter, params, features, output)
    return lax.scan(jax.checkpoint(chunk), state, parts)


run_compiled = jax.jit(run, static_argnames=("filter", "output"))


def _run_chunk(
    filter: Filter,
    params: TrackerParams,
    features: Features,
    output: str | None,
    state: TrackerState,
    part: Any,
) -> tuple[TrackerState, ChunkInfo]:
    """Run the tracker over one chunk, the step of the scan in `run`.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: All chunks.
        output: Report that is requested; see `run`.
        state: State before the chunk.
        part: Number of the chunk, and its rows of the features' arrays.

    Returns:
        The state after the chunk, and its report.
    """
    number, t, xi, polarity, valid, owner, elapsed, stop, cycle = part
    state = shift_state(state, elapsed)
    before = spawn_seeded_tracks(filter, params, features, features.seed == number, state.tracks)
    events = t, xi, polarity, valid, owner
    tracks, steps = run_steps(filter, params, before, events, output, features.frame)
    grid = state.grid
    if grid is not None:
        unassociated = steps.unassociated
        fixed = lax.stop_gradient(params)
        grid = lax.cond(
            unassociated.any(),
            lambda g: accumulate_clutter(fixed, g, stop, t, xi, unassociated),
            lambda g: g,
            grid,
        )
    state = TrackerState(tracks, grid, state.next_id)
    none = jnp.zeros_like(tracks.id)
    state, log = lax.cond(
        cycle,
        lambda s: manage_tracks(filter, params, features, stop, s),
        lambda s: (s, LifecycleLog(s.tracks.id, s.tracks.id, s.tracks.confirmed, none, none)),
        state,
    )
    info: dict[str, Any] = {}
    if output is None:
        info["tracks"] = before
        info["association"] = EventAssociation(steps.target, steps.weight)
    elif output == "states":
        info["tracks"] = jax.tree.map(_prepend, before, steps.tracks)
    elif output == "path":
        info["path"] = jax.tree.map(_prepend, positions(filter, params, before), steps.path)
    else:
        info["loss"], info["count"] = steps.loss.sum(), steps.count.sum()
    return state, ChunkInfo(log, **info)


def _prepend(one: Array, others: Array) -> Array:
    return jnp.concatenate([one[None], others], axis=0)


class NextChunk(NamedTuple):
    """Backward information at the start of the chunk after one.

    Attributes:
        info: The backward information.
        elapsed: Time from the start of the chunk to that of the next one, us.
        smoothed: Smoothed tracks of the chunk itself, where they are kept.
    """

    info: BackwardInfo
    elapsed: Any
    smoothed: SmoothedTracks | None = None


_init = jax.jit(init_state, static_argnames="filter")
_terminal_info = jax.jit(lambda starts: terminal_info(jax.tree.map(lambda a: a[-1], starts)))


class XlaRunner:
    """Runner of segments by programs that XLA compiles.

    Raises:
        InputError: By every method, where none can run in this thread.
    """

    events_per_segment = 0  # a segment has the default length

    def __init__(self, filter: Filter, params: TrackerParams):
        self.params, self._arguments = params, (filter, params)

    @property
    def _parts(self) -> tuple[Filter, TrackerParams]:
        threads.check_not_forked()
        return self._arguments

    def init(self, features: Features) -> TrackerState:
        """Return the state without any track."""
        return _init(*self._parts, features)

    def run(self, state: TrackerState, features: Features) -> tuple[TrackerState, LifecycleLog]:
        """Run a segment; return the state at its end, with births and deaths."""
        state, info = run_compiled(*self._parts, state, features)
        return state, info.log

    def record(self, state: TrackerState, features: Features) -> tuple[TrackerState, TrackBuffer]:
        """Run a segment; return the state at its end, and a record to be read out.

        The record are the tracks at the chunks' starts.
        """
        state, info = run_compiled(*self._parts, state, features)
        assert info.tracks is not None
        return state, info.tracks

    def associate(
        self, state: TrackerState, features: Features
    ) -> tuple[TrackerState, NDArray[np.int32], NDArray]:
        """Run a segment; return the state at its end, likeliest tracks of events, and weights."""
        state, info = run_compiled(*self._parts, state, features)
        assert info.association is not None
        return state, np.asarray(info.association.id), np.asarray(info.association.weight)

    def backward_pass(
        self,
        segment: Segment,
        starts: TrackBuffer,
        info: BackwardInfo | None,
        elapsed: int,
        max_numbers: int = 0,
    ) -> tuple[list[NextChunk], BackwardInfo]:
        """Run the backward pass over a segment.

        Args:
            segment: The segment.
            starts: Its record.
            info: Backward information at the start of the next segment; None: there is none.
            elapsed: Time from the start of the last chunk to that of the next segment, us.
            max_numbers: Smoothed chunks are kept if they hold at most so many numbers.

        Returns:
            The information after each chunk, and at the segment's start.
        """
        info = _terminal_info(starts) if info is None else info
        features, found = jax.device_put(segment.features), []
        per_step = count_numbers(info) + count_numbers(starts) // len(segment.start)
        keep = segment.n_chunks * (segment.features.t.shape[1] + 1) * per_step <= max_numbers
        for chunk in reversed(range(segment.n_chunks)):
            following = NextChunk(info, np.int32(elapsed))
            smoothed, info = _smooth_chunk(
                *self._parts, features, starts, np.int32(chunk), following
            )
            found.append(following._replace(smoothed=smoothed) if keep else following)
            elapsed = int(segment.features.elapsed[chunk])
        return found[::-1], jax.device_get(info)

    def readout(
        self,
        segment: Segment,
        starts: TrackBuffer,
        following: Sequence[NextChunk] | None,
        times: NDArray[np.int64],
        serial: NDArray[np.int64],
        requested: NDArray[np.bool_],
    ) -> tuple[NDArray, ...]:
        """Read out tracks at times of a segment.

        Args:
            segment: The segment.
            starts: Its record.
            following: Information of the backward pass; None: filtered states.
            times: Sorted times, us.
            serial: Serial numbers of the tracks.
            requested: (times, tracks) which states to read out.

        Returns:
            Mean (times, tracks, 8), covariance (times, tracks, 8, 8) and s since the last event
            (times, tracks); NaN where not requested.
        """
        real, shape = np.dtype(jnp.result_type(float)), requested.shape
        out = tuple(np.full((*shape, *size), np.nan, real) for size in ((8,), (8, 8), ()))
        features, id = jax.device_put(segment.features), np.asarray(starts.id)
        chunks, steps, since = segment.find_steps(times)
        since = since.astype(np.int32)
        for chunk in np.unique(chunks):
            rows = np.flatnonzero(chunks == chunk)
            some = np.flatnonzero(requested[rows].any(0))
            if not len(some):
                continue
            entry = np.argmax(id[chunk] == serial[some][:, None], axis=1)
            entry = np.pad(entry, (0, -len(entry) % 8))
            read = self._chunk_reader(features, starts, following, int(chunk))
            for first in range(0, len(rows), READOUT_TIMES_PER_CALL):
                part = rows[first : first + READOUT_TIMES_PER_CALL]
                fill = (0, READOUT_TIMES_PER_CALL - len(part))
                states = read(np.pad(steps[part], fill), np.pad(since[part], fill), entry)
                at = np.ix_(part, some)
                for one, value in zip(out, states, strict=True):
                    value = np.asarray(value)[: len(part), : len(some)]
                    here = requested[at].reshape(*value.shape[:2], *[1] * (value.ndim - 2))
                    one[at] = np.where(here, value, np.nan)
        return out

    def _chunk_reader(
        self,
        features: Features,
        starts: TrackBuffer,
        following: Sequence[NextChunk] | None,
        chunk: int,
    ) -> Any:
        """Make the function that reads out a chunk.

        Args:
            features: Chunks of the segment.
            starts: Tracks at the chunks' starts.
            following: Backward information after each chunk; None: states are filtered.
            chunk: Number of the chunk.

        Returns:
            A function of steps, times and entries of the buffer, see `_read_filtered`.
        """
        if following is None:
            path = _replay_chunk(*self._parts, features, starts, np.int32(chunk))
            return functools.partial(_read_filtered, *self._parts, path)
        smoothed = following[chunk].smoothed
        if smoothed is None:
            at = np.int32(chunk), following[chunk]
            smoothed, _ = _smooth_chunk(*self._parts, features, starts, *at)
        return functools.partial(_read_smoothed, *self._parts, smoothed)


def count_numbers(tree: Any) -> int:
    """Count the numbers in the arrays of a tree."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@functools.partial(jax.jit, static_argnames="filter")
def _read_filtered(
    filter: Filter, params: TrackerParams, path: TrackBuffer, step: Array, time: Array, entry: Array
) -> tuple[Array, Array, Array]:
    """Read out filtered states of a chunk.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        path: Tracks at the chunk's start and after each step.
        step: (times,) steps of the chunk done by each time.
        time: (times,) us since the chunk's start.
        entry: (tracks,) entries of the buffer.

    Returns:
        Mean (times, tracks, 8), covariance, and s since the last event.
    """
    tracks = jax.tree.map(lambda a: a[step[:, None], entry], path)
    read = functools.partial(readout, filter, params)
    return jax.vmap(jax.vmap(read, (0, None)))(tracks, time)


@functools.partial(jax.jit, static_argnames="filter")
def _read_smoothed(
    filter: Filter,
    params: TrackerParams,
    smoothed: SmoothedTracks,
    step: Array,
    time: Array,
    entry: Array,
) -> tuple[Array, Array, Array]:
    """Read out smoothed states of a chunk.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        smoothed: Tracks at the chunk's start and after each step, smoothed.
        step: (times,) steps of the chunk done by each time.
        time: (times,) us since the chunk's start.
        entry: (tracks,) entries of the buffer.

    Returns:
        Mean (times, tracks, 8), covariance, and s since the last event.
    """
    now = jax.tree.map(lambda a: a[step[:, None], entry], smoothed)
    read = functools.partial(readout_smoothed, filter, params)
    return jax.vmap(jax.vmap(read, (0, 0, None)))(now.tracks, now.info, time)


@functools.partial(jax.jit, static_argnames="filter")
def _smooth_chunk(
    filter: Filter,
    params: TrackerParams,
    features: Features,
    starts: TrackBuffer,
    chunk: Array,
    following: NextChunk,
) -> tuple[SmoothedTracks, BackwardInfo]:
    """Run a chunk again and smooth it.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: The chunk's segment.
        starts: Tracks at the start of each chunk.
        chunk: () number of the chunk in the segment.
        following: Backward information at the start of the next chunk.

    Returns:
        Smoothed tracks at the chunk's start and after each step, and the backward information at
        its start.
    """
    path = _replay_chunk(filter, params, features, starts, chunk)
    end = jax.tree.map(lambda a: a[-1], path)
    info = propagate_to_chunk_end(following.info, end, following.elapsed)
    info = backward_pass(filter, params, path, info)
    return SmoothedTracks(path, info), jax.tree.map(lambda a: a[0], info)


@functools.partial(jax.jit, static_argnames="filter")
def _replay_chunk(
    filter: Filter, params: TrackerParams, features: Features, starts: TrackBuffer, chunk: Array
) -> TrackBuffer:
    """Run a chunk again.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        features: The chunk's segment.
        starts: Tracks at the start of each chunk.
        chunk: () number of the chunk in the segment.

    Returns:
        Tracks (steps + 1, targets) at the chunk's start and after each step.
    """
    f = features
    before = jax.tree.map(lambda a: a[chunk], starts)
    events = f.t[chunk], f.xi[chunk], f.polarity[chunk], f.valid[chunk]
    events = *events, None if f.owner is None else f.owner[chunk]
    _, steps = run_steps(filter, params, before, events, "states", f.frame)
    return jax.tree.map(_prepend, before, steps.tracks)
