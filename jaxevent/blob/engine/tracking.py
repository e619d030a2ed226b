"""Runs of chunks by a kernel: what `jaxevent.blob.scan` does by XLA."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.engine import loop
from jaxevent.blob.engine.loop import FRAME, ROWS, TARGETS, Chunks, Memory, Settings, Space, Updates
from jaxevent.blob.engine.reading import functions_of
from jaxevent.blob.engine.replay import LATER, MATRICES, NUMBERS, Asked, Kernel, Room, States, read
from jaxevent.blob.engine.target import kernel_of, shares_apart
from jaxevent.blob.lifecycle import Log, State, begin
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Packing, Stretch
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots
from jaxevent.codegen.graph import evaluate_jaxpr
from jaxevent.codegen.trace import name_leaves, name_numbers


@functools.lru_cache(maxsize=16)
def _beginning(filter: Filter, tree: Any, kinds: tuple[jax.ShapeDtypeStruct, ...]) -> Any:
    """The equations of `lifecycle.begin` for parameters and features, and what they tell."""
    start = functools.partial(begin, filter)
    closed, told = jax.make_jaxpr(start, return_shape=True)(*jax.tree.unflatten(tree, kinds))
    return closed, jax.tree.structure(told)


class FusedRun:
    """Tracks through a packing's chunks by a filter's kernel; raises `TranslationError`."""

    def __init__(self, filter: Filter, params: TrackerParams, packing: Packing):
        self.dtype = np.dtype(jnp.result_type(float))
        self._filter, self._params, self._packing = filter, params, packing
        own = packing.own if len(packing.seeds.t) else {}
        owned = packing.joined is not None
        self._kernel = kernel_of(filter, params, own, owned, self.dtype)
        self._settings = Settings(
            float(params.lambda0), packing.detect, float(params.tau_birth), float(params.cell),
            float(params.n_birth), shares_apart(filter),
        )  # fmt: skip
        layout = self._kernel.layout
        self._columns: list[tuple[bool, NDArray[np.int64], tuple[int, ...], np.dtype]] = []
        for name, leaf in name_leaves("slot", self._kernel.slot).items():
            names = name_numbers(name, leaf)
            real = leaf.dtype.kind == "f"
            places = layout.cells if real else layout.whole
            columns = np.array([places[number] for number in names], np.int64)
            self._columns.append((real, columns, leaf.shape, leaf.dtype))

    def __reduce__(self) -> tuple[Any, ...]:
        return FusedRun, (self._filter, self._params, self._packing)

    def begin(self, features: Features) -> State:
        """No track yet."""
        leaves, tree = jax.tree.flatten((self._params, features))
        given = [np.asarray(leaf) for leaf in leaves]
        kinds = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in given)
        closed, told = _beginning(self._filter, tree, kinds)
        return jax.tree.unflatten(told, evaluate_jaxpr(closed, given))

    def follow(self, state: State, features: Features) -> tuple[State, Log]:
        """The state at the end, with births and deaths."""
        return self._run(state, features)[:2]

    def play(self, state: State, features: Features) -> tuple[State, Updates]:
        """The state at the end, and all updates, to be read."""
        chunks, steps, _ = features.t.shape
        rows = (chunks + steps) * len(state.slots.id) + chunks * steps
        while True:
            end, _, _, updates = self._run(state, features, rows)
            if updates.count[0] <= rows:
                return end, updates
            rows = int(updates.count[0])

    def owners(self, state: State, features: Features) -> tuple[State, NDArray[np.int32], NDArray]:
        """The state at the end, serial numbers of the likeliest targets of events, and weights."""
        state, _, told, _ = self._run(state, features, owners=True)
        return state, told.owner, told.weight

    def look_back(
        self,
        stretch: Stretch,
        updates: Updates,
        later: NDArray[np.float64] | None,
        elapsed: int,
        room: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What later events say of all updates, and at the stretch's start.

        `later` is that at the start of the next one, `elapsed` us after this one's last chunk.
        """
        later = np.zeros((len(updates.latest), LATER)) if later is None else later.copy()
        following = np.append(stretch.features.elapsed[1 : stretch.used], elapsed).astype(np.int64)
        rows = np.empty((int(updates.count[0]), LATER))
        none = np.empty(0, np.int64)
        nothing = Asked(none, none, none, none, np.empty((0, 0), bool))
        self._read(updates, following, later, rows, nothing)
        return rows, later

    def read(
        self,
        stretch: Stretch,
        updates: Updates,
        rows: NDArray[np.float64] | None,
        times: NDArray[np.int64],
        serial: NDArray[np.int64],
        wanted: NDArray[np.bool_],
    ) -> States:
        """States of tracks at sorted times of a stretch where they are `wanted`; NaN elsewhere.

        Smoothed with what `look_back` said, `rows`; None: filtered.
        """
        chunk, step, since = stretch.find_steps(times)
        rows = np.empty((0, LATER)) if rows is None else rows
        asked = Asked(chunk, step.astype(np.int64), since, serial, wanted)
        return self._read(updates, np.empty(0, np.int64), np.empty((0, LATER)), rows, asked)

    def slots(self, updates: Updates) -> Slots:
        """The targets at chunks' starts as `run` tells them."""
        at = updates.begin[:-1, None] + np.arange(len(updates.latest))
        return self._slots(self._kernel.slot, updates.cells[at], updates.whole[at])

    def _read(
        self,
        updates: Updates,
        following: NDArray[np.int64],
        later: NDArray[np.float64],
        rows: NDArray[np.float64],
        asked: Asked,
    ) -> States:
        shape = asked.wanted.shape
        out = States(*(
            np.full((*shape, *size), np.nan, self.dtype) for size in ((8,), (8, 8), ())
        ))  # fmt: skip
        room = Room(
            np.empty((MATRICES, 8, 8)), np.empty((2, 8)), np.empty(NUMBERS, self.dtype),
            np.empty(1, np.int64),
        )  # fmt: skip
        read(self._reading, updates, following, later, rows, asked, room, out)
        return out

    @functools.cached_property
    def _reading(self) -> Kernel:
        found = functions_of(self._filter, self._params, self._kernel, self.dtype)
        return Kernel(*found, 4 * float(np.finfo(self.dtype).eps))

    def _run(
        self, state: State, features: Features, rows: int = 0, owners: bool = False
    ) -> tuple[State, Log, loop.Told, Updates]:
        state = jax.device_get(state)
        memory, chunks, kernel = (
            self._memory_of(state, features),
            _chunks_of(features),
            self._kernel,
        )
        told, space = self._told(chunks, memory, owners), self._space(chunks, memory)
        updates = self._updates(chunks, memory, rows)
        loop.run(
            kernel.functions, kernel.numbers, self._settings, chunks, memory, told, space, updates
        )
        rest = [np.asarray(one, np.int32) for one in memory.at]
        if state.grid is not None:
            rest.insert(0, memory.sums)
        else:
            rest = rest[1:]
        leaves = [*jax.tree.leaves(self._slots(state.slots, memory.cells, memory.whole)), *rest]
        end = jax.tree.unflatten(jax.tree.structure(state), leaves)
        log = Log(told.before, told.after, told.confirmed, told.ended, told.death)
        return end, log, told, updates

    def _told(self, chunks: Chunks, memory: Memory, owners: bool) -> loop.Told:
        events = chunks.t.shape if owners else (0, 0, 0)
        shape, kinds = (len(chunks.t), len(memory.whole)), (np.int32, np.int32, bool)
        return loop.Told(
            np.empty(events, np.int32), np.empty(events, self.dtype),
            *(np.empty(shape, kind) for kind in (*kinds, np.int32, np.int32)),
        )  # fmt: skip

    def _updates(self, chunks: Chunks, memory: Memory, rows: int) -> Updates:
        whole = np.int64
        return Updates(
            np.empty((rows, memory.cells.shape[1]), self.dtype),
            np.empty((rows, memory.whole.shape[1]), whole),
            *(np.empty(rows, whole) for _ in range(3)),
            np.empty(len(chunks.t) + 1, whole), np.empty(len(memory.whole), whole),
            np.zeros(1, whole),
        )  # fmt: skip

    def _space(self, chunks: Chunks, memory: Memory) -> Space:
        targets, events = len(memory.whole), chunks.t.shape[2]
        rows, columns = memory.sums.shape[1:]
        return Space(
            np.zeros((TARGETS + ROWS * targets, events), self.dtype),
            np.zeros(2 * events, np.int64), np.empty(targets, np.int64),
            np.empty((rows, columns), self.dtype), np.empty(columns + 2, self.dtype),
        )  # fmt: skip

    def _memory_of(self, state: State, features: Features) -> Memory:
        layout, targets = self._kernel.layout, len(state.slots.id)
        cells = np.zeros((targets, len(layout.cells)), self.dtype)
        whole = np.zeros((targets, len(layout.whole)), np.int64)
        leaves = jax.tree.leaves(state.slots)
        for leaf, (real, columns, _, _) in zip(leaves, self._columns, strict=True):
            (cells if real else whole)[:, columns] = np.reshape(leaf, (targets, -1))
        cells[:, FRAME : FRAME + 2] = features.frame
        sums, at = np.zeros((3, 1, 1), self.dtype), np.zeros(2, np.int64)
        if state.grid is not None:
            sums, at[0] = np.array(state.grid.sums), int(state.grid.time)
        at[1] = int(state.next_id)
        return Memory(cells, whole, sums, at)

    def _slots(self, like: Slots, cells: NDArray, whole: NDArray) -> Any:
        """The rows of targets as `Slots`."""
        leaves = []
        for real, columns, shape, kind in self._columns:
            part = (cells if real else whole)[..., columns].astype(kind)
            leaves.append(part.reshape(*part.shape[:-1], *shape))
        return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _chunks_of(features: Features) -> Chunks:
    owner = np.empty((0, 0, 0, 0), np.int32) if features.owner is None else features.owner
    parts: list[NDArray] = [
        np.asarray(part)
        for part in (
            features.t, features.xi, features.polarity, features.valid, owner, features.elapsed,
            features.stop, features.cycle, features.seed, features.seed_xi, features.seed_size,
        )
    ]  # fmt: skip
    return Chunks(*parts)
