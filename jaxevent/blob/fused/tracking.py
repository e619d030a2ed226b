"""Runs of chunks by a kernel, with what `jaxevent.blob.run` takes and returns."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.blob.fused.loop import (
    FRAME,
    ROWS,
    TARGETS,
    Chunks,
    Memory,
    Settings,
    Space,
    Told,
    run,
)
from jaxevent.blob.fused.target import kernel_of, shares_apart
from jaxevent.blob.lifecycle import Log, State
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Packing
from jaxevent.blob.run import Told as Telling
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots
from jaxevent.kernels.loops import leaves_of, numbers_of


class FusedRun:
    """Tracks through a packing's chunks by a filter's kernel; raises `Untranslatable`."""

    def __init__(self, filter: Filter, params: TrackerParams, packing: Packing):
        self.dtype = np.dtype(jnp.result_type(float))
        own = packing.own if len(packing.seeds.t) else {}
        owned = packing.joined is not None
        self._kernel = kernel_of(filter, params, own, owned, self.dtype)
        self._settings = Settings(
            float(params.lambda0), packing.detect, float(params.tau_birth), float(params.cell),
            float(params.n_birth), shares_apart(filter),
        )  # fmt: skip
        layout = self._kernel.layout
        self._columns: list[tuple[bool, NDArray[np.int64], tuple[int, ...], np.dtype]] = []
        for name, leaf in leaves_of("slot", self._kernel.slot).items():
            names = numbers_of(name, leaf)
            real = leaf.dtype.kind == "f"
            places = layout.cells if real else layout.whole
            columns = np.array([places[number] for number in names], np.int64)
            self._columns.append((real, columns, leaf.shape, leaf.dtype))

    def __call__(
        self, state: State, features: Features, begins: bool = False
    ) -> tuple[State, Telling]:
        """The state at the end, births and deaths, and, if asked for, targets at chunks' starts."""
        state = jax.device_get(state)
        memory = self._memory_of(state, features)
        chunks, events = len(features.t), features.t.shape[2]
        targets = len(memory.whole)
        kinds = np.int32, np.int32, bool, np.int32, np.int32
        told = Told(
            np.empty((chunks if begins else 0, *memory.cells.shape), self.dtype),
            np.empty((chunks if begins else 0, *memory.whole.shape), np.int64),
            *(np.empty((chunks, targets), kind) for kind in kinds),
        )
        owner = np.empty((0, 0, 0, 0), np.int32) if features.owner is None else features.owner
        parts: list[NDArray] = [
            np.asarray(part)
            for part in (
                features.t, features.xi, features.polarity, features.valid, owner,
                features.elapsed, features.stop, features.cycle, features.seed, features.seed_xi,
                features.seed_size,
            )
        ]  # fmt: skip
        given = Chunks(*parts)
        rows, columns = memory.sums.shape[1:]
        space = Space(
            np.zeros((TARGETS + ROWS * targets, events), self.dtype),
            np.zeros(2 * events, np.int64), np.empty(targets, np.int64),
            np.empty((rows, columns), self.dtype), np.empty(columns + 2, self.dtype),
        )  # fmt: skip
        kernel = self._kernel
        run(kernel.functions, kernel.numbers, self._settings, given, memory, told, space)
        rest = [np.asarray(one, np.int32) for one in memory.at]
        if state.grid is not None:
            rest.insert(0, memory.sums)
        else:
            rest = rest[1:]
        leaves = [*jax.tree.leaves(self._slots(state.slots, memory.cells, memory.whole)), *rest]
        end = jax.tree.unflatten(jax.tree.structure(state), leaves)
        log = Log(told.before, told.after, told.confirmed, told.ended, told.death)
        return end, Telling(
            log, self._slots(state.slots, told.cells, told.whole) if begins else None
        )

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
