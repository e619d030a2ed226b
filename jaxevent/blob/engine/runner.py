"""Runner of segments by a kernel; see `jaxevent.blob.run.XlaRunner`."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob import filter as filters
from jaxevent.blob.engine import loop, smoother_loop
from jaxevent.blob.engine.loop import (
    ChunkArrays,
    KernelOutput,
    KernelState,
    Snapshots,
    UpdateRecord,
)
from jaxevent.blob.engine.program import TrackCompiler, TrackVariant
from jaxevent.blob.engine.smoother_loop import ReadoutArrays, ReadoutKernel, ReadoutScratch
from jaxevent.blob.filter import Filter
from jaxevent.blob.lifecycle import LifecycleLog, TrackerState, init_state
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Segment
from jaxevent.blob.track import TrackBuffer
from jaxevent.codegen.derivative import is_real
from jaxevent.codegen.graph import evaluate_jaxpr
from jaxevent.codegen.trace import named_leaves, number_names

NO_LOSSES = loop.LossSums(np.zeros(0), False, 0.0)
COMMON_VARIANT = TrackVariant()
NO_MOMENTS = np.zeros(0, np.int64)


@functools.lru_cache(maxsize=16)
def _trace_init(filter: Filter, tree: Any, kinds: tuple[jax.ShapeDtypeStruct, ...]) -> Any:
    """Trace `lifecycle.init_state`.

    Args:
        filter: Filter of one target.
        tree: Structure of its other arguments, parameters and features.
        kinds: Shapes and types of their leaves.

    Returns:
        Its equations, and the structure of its result.
    """
    init = functools.partial(init_state, filter)
    closed, shape = jax.make_jaxpr(init, return_shape=True)(*jax.tree.unflatten(tree, kinds))
    return closed, jax.tree.structure(shape)


class _Column(NamedTuple):
    """Columns of a leaf's numbers.

    Attributes:
        real: Whether they are those of real numbers rather than of integers.
        at: Numbers of the columns.
        shape: Shape of the leaf.
        dtype: Its type.
    """

    real: bool
    at: NDArray[np.int64]
    shape: tuple[int, ...]
    dtype: np.dtype


class _KernelRun(NamedTuple):
    """Result of a segment."""

    state: TrackerState
    out: KernelOutput
    updates: UpdateRecord
    snapshots: Snapshots


class KernelLosses(NamedTuple):
    """Losses of events, and tracks at requested moments, with tangents.

    Attributes:
        totals: (4,) see `loop.LossSums`.
        tracks: (moments, targets) the tracks; None without moments.
        tangents: (moments, targets) tangents of the real numbers of their states; None: none.
    """

    totals: NDArray[np.float64]
    tracks: TrackBuffer | None
    tangents: Any


class KernelRunner:
    """Runner of segments by a filter's kernel.

    Args:
        filter: Filter of one target.
        params: Parameters of the tracker.
        detect: Whether tracks are born of unassociated events.
        variant: Inputs and outputs of the kernel.
        along: Name of the parameter, and index in it, along which tangents are.

    Raises:
        TranslationError: A function has no translation.
    """

    events_per_segment = 262144  # so that the kernel seldom waits for a segment to be packed

    def __init__(
        self,
        filter: Filter,
        params: TrackerParams,
        *,
        detect: bool = False,
        variant: TrackVariant = COMMON_VARIANT,
        along: tuple[str, int] | None = None,
    ):
        self.params, self._filter = params, filter
        self._variant = variant
        self._options = {"detect": detect, "variant": variant, "along": along}
        self.dtype = np.dtype(jnp.result_type(float))
        self._compiler = TrackCompiler(filter, params, variant, self.dtype, along)
        alone = filter.association_weights is filters.association_weights
        config = loop.LifecycleConfig(
            detect, float(params.tau_birth), float(params.cell), float(params.n_birth), alone
        )
        compiler = self._compiler
        self._kernel = loop.TrackKernel(compiler.functions, compiler.numbers, config)
        self._columns = self._find_columns("track", compiler.track)

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(KernelRunner, **self._options), (self._filter, self.params)

    def _find_columns(self, name: str, tree: Any) -> list[_Column]:
        """Find the columns of the leaves of a tree.

        Args:
            name: Name of the tree.
            tree: Shapes of one track's numbers.

        Returns:
            The columns of each leaf.
        """
        layout, found = self._compiler.layout, list[_Column]()
        for leaf_name, leaf in named_leaves(name, tree).items():
            real = leaf.dtype.kind == "f"
            places = layout.reals if real else layout.integers
            at = np.array([places[number] for number in number_names(leaf_name, leaf)], np.int64)
            found.append(_Column(real, at, leaf.shape, leaf.dtype))
        return found

    def init(self, features: Features) -> TrackerState:
        """Return the state without any track."""
        leaves, tree = jax.tree.flatten((self.params, features))
        values = [np.asarray(leaf) for leaf in leaves]
        kinds = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in values)
        closed, structure = _trace_init(self._filter, tree, kinds)
        return jax.tree.unflatten(structure, evaluate_jaxpr(closed, values))

    def run(self, state: TrackerState, features: Features) -> tuple[TrackerState, LifecycleLog]:
        """Run a segment; return the state at its end, with births and deaths."""
        state, out, *_ = self._run(state, features)
        return state, LifecycleLog(
            out.id_before, out.id_after, out.confirmed, out.end_reason, out.death
        )

    def record(self, state: TrackerState, features: Features) -> tuple[TrackerState, UpdateRecord]:
        """Run a segment; return the state at its end, and a record to be read out.

        The record are all tracks at the chunks' starts and after their updates.
        """
        chunks, steps, _ = features.t.shape
        rows = (chunks + steps) * len(state.tracks.id) + chunks * steps
        while True:
            end, _, updates, _ = self._run(state, features, rows)
            if updates.count[0] <= rows:
                return end, updates
            rows = int(updates.count[0])

    def associate(
        self, state: TrackerState, features: Features
    ) -> tuple[TrackerState, NDArray[np.int32], NDArray]:
        """Run a segment; return the state at its end, likeliest tracks of events, and weights."""
        state, out, *_ = self._run(state, features, associate=True)
        return state, out.target, out.weight

    def losses(
        self,
        state: TrackerState,
        features: Features,
        outliers: float,
        every: bool,
        moments: NDArray[np.int64] | None,
    ) -> KernelLosses:
        """Run all chunks of a recording for a loss.

        Args:
            state: State at the recording's start, of `init`.
            features: The chunks.
            outliers: Share of events that belong to no target.
            every: Whether every event counts, not only those inside a gate.
            moments: (moments,) sorted, see `loop.Snapshots`; None: no tracks are wanted.

        Returns:
            Losses, and tracks at the moments.
        """
        sums = loop.LossSums(np.zeros(4), every, outliers)
        at = NO_MOMENTS if moments is None else moments
        snapshots = self._run(state, features, losses=sums, moments=at).snapshots
        reals, integers = snapshots.reals, snapshots.integers
        tracks = tangents = None
        if moments is not None:
            tracks = self._tracks(self._compiler.track, reals, integers)
        if moments is not None and self._variant.tangents:
            tangents = _read_columns(*self._tangents, reals, integers)
        return KernelLosses(sums.totals, tracks, tangents)

    @functools.cached_property
    def _tangents(self) -> tuple[list[_Column], Any]:
        """Columns of the tangents of a state, and its shapes."""
        like = eqx.filter(self._compiler.track.state, is_real)
        return self._find_columns("tangent", like), like

    def backward_pass(
        self,
        segment: Segment,
        updates: UpdateRecord,
        info: NDArray[np.float64] | None,
        elapsed: int,
        max_numbers: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Run the backward pass over a segment.

        Args:
            segment: The segment.
            updates: Its record.
            info: Backward information at the start of the next segment; None: there is none.
            elapsed: Time from the start of the last chunk to that of the next segment, us.
            max_numbers: Not used.

        Returns:
            The information of each recorded row, and at the segment's start.
        """
        size = smoother_loop.INFO_SIZE
        info = np.zeros((len(updates.latest), size)) if info is None else info.copy()
        following = np.append(segment.features.elapsed[1 : segment.n_chunks], elapsed)
        rows = np.empty((int(updates.count[0]), size))
        smoother_loop.backward_pass(
            self._readout_kernel, updates, following.astype(np.int64), info, rows, self._scratch()
        )
        return rows, info

    def readout(
        self,
        segment: Segment,
        updates: UpdateRecord,
        rows: NDArray[np.float64] | None,
        times: NDArray[np.int64],
        serial: NDArray[np.int64],
        requested: NDArray[np.bool_],
    ) -> ReadoutArrays:
        """Read out tracks at times of a segment.

        Args:
            segment: The segment.
            updates: Its record.
            rows: Information of the backward pass; None: filtered states.
            times: Sorted times, us.
            serial: Serial numbers of the tracks.
            requested: (times, tracks) which states to read out.

        Returns:
            Mean (times, tracks, 8), covariance (times, tracks, 8, 8) and s since the last event
            (times, tracks); NaN where not requested.
        """
        chunk, step, since = segment.find_steps(times)
        rows = np.empty((0, smoother_loop.INFO_SIZE)) if rows is None else rows
        query = smoother_loop.ReadoutQuery(chunk, step.astype(np.int64), since, serial, requested)
        shape = requested.shape
        out = ReadoutArrays(*(
            np.full((*shape, *size), np.nan, self.dtype) for size in ((8,), (8, 8), ())
        ))  # fmt: skip
        smoother_loop.readout(self._readout_kernel, updates, rows, query, self._scratch(), out)
        return out

    def chunk_starts(self, updates: UpdateRecord) -> TrackBuffer:
        """Return the recorded tracks at the chunks' starts, (chunks, targets)."""
        at = updates.begin[:-1, None] + np.arange(len(updates.latest))
        return self._tracks(self._compiler.track, updates.reals[at], updates.integers[at])

    @functools.cached_property
    def _readout_kernel(self) -> ReadoutKernel:
        return self._compiler.readout()

    def _scratch(self) -> ReadoutScratch:
        return ReadoutScratch(
            np.empty((smoother_loop.N_MATRICES, 8, 8)), np.empty((2, 8)),
            np.empty(smoother_loop.WORK_SIZE, self.dtype), np.empty(1, np.int64),
        )  # fmt: skip

    def _run(
        self,
        state: TrackerState,
        features: Features,
        rows: int = 0,
        *,
        associate: bool = False,
        losses: loop.LossSums = NO_LOSSES,
        moments: NDArray[np.int64] = NO_MOMENTS,
    ) -> _KernelRun:
        """Run a segment.

        Args:
            state: State at the segment's start.
            features: The segment.
            rows: Room for records of tracks after their updates.
            associate: Whether to report the tracks of events.
            losses: Sums over events, output.
            moments: (moments,) of the snapshots.

        Returns:
            The state at the segment's end, and what is reported.
        """
        state = jax.device_get(state)
        kernel_state, chunks = self._to_kernel(state, features), _chunk_arrays(features)
        targets = len(kernel_state.integers)
        out = self._output(chunks, targets, associate)
        updates = self._record(kernel_state, len(chunks.t), rows)
        scratch = self._loop_scratch(kernel_state, chunks.t.shape[2])
        snapshots = self._snapshots(kernel_state, moments)
        outputs = loop.LoopOutput(out, updates, losses, snapshots)
        loop.run(self._kernel, chunks, kernel_state, scratch, outputs)
        return _KernelRun(self._from_kernel(state, kernel_state), out, updates, snapshots)

    def _output(self, chunks: ChunkArrays, targets: int, associate: bool) -> KernelOutput:
        """Allocate the report of a segment.

        Args:
            chunks: Arrays of the segment.
            targets: Capacity of the buffer of tracks.
            associate: Whether it has room for the tracks of events.

        Returns:
            The report, not yet filled.
        """
        events = chunks.t.shape if associate else (0, 0, 0)
        kinds = (np.int32, np.int32, bool, np.int32, np.int32)
        return KernelOutput(
            np.empty(events, np.int32), np.empty(events, self.dtype),
            *(np.empty((len(chunks.t), targets), kind) for kind in kinds),
        )  # fmt: skip

    def _record(self, state: KernelState, chunks: int, rows: int) -> UpdateRecord:
        integer = np.int64
        return UpdateRecord(
            np.empty((rows, state.reals.shape[1]), self.dtype),
            np.empty((rows, state.integers.shape[1]), integer),
            *(np.empty(rows, integer) for _ in range(3)),
            np.empty(chunks + 1, integer), np.empty(len(state.integers), integer),
            np.zeros(1, integer),
        )  # fmt: skip

    def _snapshots(self, state: KernelState, moments: NDArray[np.int64]) -> Snapshots:
        shape = len(moments), len(state.integers)
        return Snapshots(
            moments,
            np.empty((*shape, state.reals.shape[1]), self.dtype),
            np.empty((*shape, state.integers.shape[1]), np.int64),
            np.zeros(1, np.int64),
        )

    def _loop_scratch(self, state: KernelState, events: int) -> loop.Scratch:
        targets, (rows, columns) = len(state.integers), state.sums.shape[1:]
        return loop.Scratch(
            np.zeros((loop.TRACKS + loop.ROWS_PER_TRACK * targets, events), self.dtype),
            np.zeros(2 * events, np.int64), np.empty(targets, np.int64),
            np.empty((rows, columns), self.dtype), np.empty(columns + 2, self.dtype),
        )  # fmt: skip

    def _to_kernel(self, state: TrackerState, features: Features) -> KernelState:
        layout, targets = self._compiler.layout, len(state.tracks.id)
        reals = np.zeros((targets, len(layout.reals)), self.dtype)
        integers = np.zeros((targets, len(layout.integers)), np.int64)
        leaves = jax.tree.leaves(state.tracks)
        for leaf, (real, columns, _, _) in zip(leaves, self._columns, strict=True):
            (reals if real else integers)[:, columns] = np.reshape(leaf, (targets, -1))
        reals[:, loop.FRAME : loop.FRAME + 2] = features.frame
        sums, grid_time = np.zeros((3, 1, 1), self.dtype), 0
        if state.grid is not None:
            sums, grid_time = np.array(state.grid.sums), int(state.grid.time)
        return KernelState(reals, integers, sums, np.array([grid_time, int(state.next_id)]))

    def _from_kernel(self, like: TrackerState, state: KernelState) -> TrackerState:
        grid_time, next_id = (np.asarray(one, np.int32) for one in state.counters)
        tracks = self._tracks(like.tracks, state.reals, state.integers)
        grid = [] if like.grid is None else [state.sums, grid_time]
        leaves = [*jax.tree.leaves(tracks), *grid, next_id]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def _tracks(self, like: TrackBuffer, reals: NDArray, integers: NDArray) -> Any:
        """Convert rows of tracks to a `TrackBuffer`.

        Args:
            like: Tracks of the same filter.
            reals: (..., columns) real numbers of the rows.
            integers: (..., columns) their integers.

        Returns:
            The tracks, of the rows' shape.
        """
        return _read_columns(self._columns, like, reals, integers)


def _read_columns(columns: list[_Column], like: Any, reals: NDArray, integers: NDArray) -> Any:
    """Read a tree from rows.

    Args:
        columns: Columns of the tree's leaves.
        like: A tree of the same structure.
        reals: (..., columns) real numbers of the rows.
        integers: (..., columns) their integers.

    Returns:
        The tree, of the rows' shape.
    """
    leaves = []
    for column in columns:
        part = (reals if column.real else integers)[..., column.at].astype(column.dtype)
        leaves.append(part.reshape(*part.shape[:-1], *column.shape))
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _chunk_arrays(features: Features) -> ChunkArrays:
    owner = np.empty((0, 0, 0, 0), np.int32) if features.owner is None else features.owner
    parts: list[NDArray] = [
        np.asarray(part)
        for part in (
            features.t, features.xi, features.polarity, features.valid, owner, features.elapsed,
            features.stop, features.cycle, features.seed, features.seed_xi, features.seed_size,
        )
    ]  # fmt: skip
    return ChunkArrays(*parts)
