"""Runs of batches by a kernel, with what `filtering.run` takes and returns."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.particle_filter.engine.functions import kernel_of
from jaxevent.egomotion.particle_filter.engine.loop import (
    REACH,
    USED,
    Given,
    Rows,
    Told,
    room_for,
    run,
)
from jaxevent.egomotion.particle_filter.filtering import Info, Noise, State
from jaxevent.egomotion.particle_filter.parameters import Params


class FusedRun:
    """The filter by a model's kernel; raises `TranslationError`."""

    def __init__(self, params: Params, model: Model):
        self.dtype = np.dtype(jnp.result_type(float))
        self._kernel = kernel_of(params, model, self.dtype)
        self._count, self._model = params.particles, model
        layout = self._kernel.layout
        d, of, cells = model.dimension, layout.rows_of, layout.cells

        def told(mean: str, covariance: str) -> NDArray[np.int64]:
            names = [f"{mean}.{k}" for k in range(d)] + [f"{covariance}.{k}" for k in range(d * d)]
            return np.array([cells[name] for name in names], np.int64)

        self._rows = Rows(
            particles=of("state.particles"),
            normal=of("normal"),
            moved=of("moved"),
            at=of("at"),
            cloud=of("cloud"),
            anew=of("anew"),
            log_weights=layout.rows["state.log_weights.0"],
            weights=layout.rows["weights.0"],
            share=layout.rows["share.0"],
            total=layout.rows["total.0"],
            of_batch=layout.rows["told.log_likelihood.0"],
            weighed=layout.rows["found.log_weights.0"],
            sorted_by=layout.rows.get("search_asked.ages.youngest.0", -1),
            mean=told("found.mean", "found.covariance"),
            widest=told("middle", "widest"),
        )
        self._nodes = room_for(float(params.off), self._count, d, self.dtype)

    @property
    def interpolated(self) -> int:
        """In how many batches log-likelihoods have been interpolated."""
        return int(self._nodes.now[USED])

    def __call__(
        self, candidates: Candidates, noise: Noise, state: State, thinned: int = 0
    ) -> tuple[State, Info]:
        """The filter over stacked batches, on the host."""
        layout, rows, count = self._kernel.layout, self._rows, self._count
        cells = np.zeros(len(layout.cells), self.dtype)
        work = np.zeros((1 + max(layout.rows.values()), layout.room), self.dtype)
        work[rows.particles, :count] = np.asarray(state.particles).T
        work[rows.log_weights, :count] = state.log_weights
        names = ("searching", "votes", "chance", "usual", "age")
        for name in names:
            cells[layout.cells[f"state.{name}.0"]] = getattr(state, name)
        cells[layout.cells["f.0"]], cells[REACH] = self._model.f, candidates.reach
        given = Given(
            *(np.asarray(getattr(candidates, name)) for name in Given._fields[:9]),
            *map(np.asarray, (noise.normal, noise.uniform, noise.cloud)),
        )
        batches, d = len(given.elapsed), self._model.dimension
        told = Told(*(
            np.zeros((batches, *shape), kind)
            for shape, kind in (
                ((d,), self.dtype), ((d, d), self.dtype), ((), bool), ((), self.dtype),
                ((), self.dtype), ((), self.dtype), ((thinned, d), self.dtype),
            )
        ))  # fmt: skip
        kernel = self._kernel
        run(kernel.functions, kernel.numbers, rows, given, told, cells, work, self._nodes)
        after = [
            work[rows.particles, :count].T.copy(),
            work[rows.log_weights, :count].copy(),
            cells[layout.cells["state.searching.0"]] != 0,
            *(cells[layout.cells[f"state.{name}.0"]] for name in names[1:]),
        ]
        return State(*map(jnp.asarray, after)), Info(*map(jnp.asarray, told))
