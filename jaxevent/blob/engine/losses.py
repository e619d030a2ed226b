"""Losses of trackers by kernels, as functions that JAX differentiates.

For a fit a kernel carries the tangents of each track's state beside it, along one number of the
parameters in each pass. JAX sees a function with a rule for its derivatives (`custom_jvp`), which
is linear in the parameters' changes; so gradients in reverse cost the same passes.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxevent.blob.engine import loop
from jaxevent.blob.engine.program import TrackVariant, check_track
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filter import Filter
from jaxevent.blob.lifecycle import init_state
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features
from jaxevent.blob.track import TrackBuffer, positions
from jaxevent.cache import ByValue
from jaxevent.codegen import map_ahead
from jaxevent.codegen.derivative import (
    are_zero_tangents,
    is_real,
    is_zero_tangent,
    refuse_second_derivatives,
    zero_tangents,
)
from jaxevent.errors import InputError

MIN_EVENTS_PER_THREAD = 50_000  # of a pass; with fewer a thread takes longer to begin


class TrackedLosses(NamedTuple):
    """Sums of a loss, and the tracks at requested moments; None without moments.

    Attributes:
        loss: () sum of -ln p over the events that count.
        count: () number of events that count.
        p: (moments, targets, 2) px, positions at the last updates.
        v: (moments, targets, 2) px/s, velocities.
        last_update: (moments, targets) us since the chunk's start.
    """

    loss: Any
    count: Any
    p: Any
    v: Any
    last_update: Any


class LossKernel(NamedTuple):
    """Kernel of a loss.

    Attributes:
        name: Name of the tracker.
        filter: Filter of one target.
        every: Whether every event counts, not only those inside a gate.
    """

    name: str
    filter: Filter
    every: bool

    def check(self, params: TrackerParams, features: Features) -> None:
        """Raise `TranslationError` unless there are kernels for parameters and features.

        Of parameters that are traced, the defaults of the same choices are checked.
        """
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(params)):
            with jax.ensure_compile_time_eval():
                params = type(params).of(dict(params.chosen))
        dtype = np.dtype(jnp.result_type(float))
        for tangents in (False, True):
            check_track(self.filter, params, _variant(features, tangents), dtype)

    def __call__(
        self, params: TrackerParams, features: Features, moments: Any = None
    ) -> TrackedLosses:
        """Run all chunks of a recording; differentiable in the parameters.

        Args:
            params: Parameters of the tracker.
            features: The chunks, from the recording's start.
            moments: (moments,) numbers chunk * (steps + 1) + steps of the chunk done by then; None:
                no tracks are requested.

        Returns:
            The losses.
        """
        outliers = params.outliers
        fixed = jax.lax.stop_gradient(params.raw["outliers"])
        params = params.with_raw({"outliers": fixed})  # without a tangent no pass is made along it
        return _run(self, params, outliers, features, moments)


def _variant(features: Features, tangents: bool) -> TrackVariant:
    overrides = tuple(sorted(features.overrides))
    return TrackVariant(overrides, features.owner is not None, tangents)


# Windows of a recording share parameters, one behind the other.
@functools.lru_cache(maxsize=64)
def _make_runner(
    filter: Filter,
    known: ByValue,
    detect: bool,
    variant: TrackVariant,
    along: tuple[str, int] | None,
) -> KernelRunner:
    return KernelRunner(filter, known.tree, detect=detect, variant=variant, along=along)


def _evaluate(
    kernel: LossKernel, places: tuple[tuple[str, int], ...], tree: Any, leaves: list[Any]
) -> tuple[Any, ...]:
    """Run a kernel once for each place of a derivative, or once without any.

    Args:
        kernel: The kernel.
        places: Name of a parameter and index in it, of each derivative.
        tree: Structure of parameters, outliers, features and moments.
        leaves: Their leaves.

    Returns:
        Totals and tracks, and with places the tangents of the loss and of the tracks' states, one
        behind the other.
    """
    params, *given = jax.tree.unflatten(tree, leaves)
    outliers, features, moments = jax.tree.map(np.asarray, given)
    known = ByValue(jax.tree.map(jnp.asarray, params))
    variant = _variant(features, bool(places))
    make = functools.partial(_make_runner, kernel.filter, known, features.detect, variant)
    runners = [make(along) for along in places or (None,)]
    unique, rows = None, slice(0)
    if moments is not None:
        unique, rows = np.unique(moments.astype(np.int64), return_inverse=True)
    state = runners[0].init(features)

    def run(runner: KernelRunner) -> Any:
        return runner.losses(state, features, float(outliers), kernel.every, unique)

    most = None if features.t.size > MIN_EVENTS_PER_THREAD else 1
    found = list(map_ahead(run, runners, most))
    real = np.dtype(jnp.result_type(float))
    tracks = tangents = None
    if moments is not None:
        tracks = jax.tree.map(lambda a: a[rows], found[0].tracks)
        states = [one.tangents for one in found]
        tangents = jax.tree.map(lambda *a: np.stack(a)[:, rows], *states)
    made = found[0].totals.astype(real), tracks
    if not places:
        return made
    return *made, np.array([one.totals[loop.LOSS_TANGENT] for one in found], real), tangents


def _call(
    kernel: LossKernel,
    places: tuple[tuple[str, int], ...],
    params: TrackerParams,
    outliers: Any,
    features: Features,
    moments: Any,
) -> tuple[Any, ...]:
    """Call `_evaluate` from a compiled program.

    Args:
        kernel: The kernel.
        places: Name of a parameter and index in it, of each derivative.
        params: Parameters of the tracker.
        outliers: () their share of events that belong to no target.
        features: The chunks.
        moments: (moments,) of the tracks, or None.

    Returns:
        What `_evaluate` does.
    """
    leaves, tree = jax.tree.flatten((params, outliers, features, moments))
    real, tracks, tangents = jnp.result_type(float), None, None

    def extend(like: Any, *sizes: int) -> Any:
        return jax.tree.map(lambda a: jax.ShapeDtypeStruct((*sizes, *a.shape), a.dtype), like)

    if moments is not None:
        begin = functools.partial(init_state, kernel.filter)
        tracks = extend(jax.eval_shape(begin, params, features).tracks, len(moments))
        tangents = extend(eqx.filter(tracks.state, is_real), len(places))
    shapes: tuple[Any, ...] = jax.ShapeDtypeStruct((4,), real), tracks
    if places:
        shapes = *shapes, jax.ShapeDtypeStruct((len(places),), real), tangents
    evaluate = functools.partial(_evaluate, kernel, places, tree)
    return jax.pure_callback(evaluate, shapes, leaves, vmap_method="sequential")


def _measure(kernel: LossKernel, tracks: TrackBuffer, params: Any, state: Any) -> Any:
    """Return positions, velocities and times of the last updates of tracks at some moments.

    Args:
        kernel: The kernel.
        tracks: (moments, targets) the tracks.
        params: Parameters of the tracker.
        state: (moments, targets) their states.

    Returns:
        See `TrackedLosses`.
    """
    tracks = dataclasses.replace(tracks, state=state)
    return jax.vmap(functools.partial(positions, kernel.filter, params))(tracks)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _run(kernel: LossKernel, params: Any, outliers: Any, features: Any, moments: Any) -> Any:
    totals, tracks = _call(kernel, (), params, outliers, features, moments)
    return _collect(kernel, totals, tracks, params)


def _collect(
    kernel: LossKernel, totals: Any, tracks: TrackBuffer | None, params: Any
) -> TrackedLosses:
    measured: Any = (None, None, None)
    if tracks is not None:
        measured = _measure(kernel, tracks, params, tracks.state)
    return TrackedLosses(totals[loop.LOSS], totals[loop.COUNT], *measured)


def _run_jvp(kernel: LossKernel, primals: Any, tangents: Any) -> Any:
    """Compute losses and their tangents: derivatives times the tangents of parameters, summed.

    Args:
        kernel: The kernel.
        primals: Parameters, their share of outliers, features and moments.
        tangents: Tangents of these.

    Returns:
        The losses, and their tangents.

    Raises:
        InputError: Features have tangents.
    """
    params, outliers, features, moments = primals
    if not are_zero_tangents(tangents[2]):
        raise InputError(
            f"the kernel of {kernel.name!r} has no derivatives by events and seeds; give "
            'compiler="xla"'
        )
    changes = {n: c for n, c in tangents[0].raw.items() if not is_zero_tangent(c)}
    places = tuple((name, k) for name, change in changes.items() for k in range(change.size))
    by_outliers = 0 if is_zero_tangent(tangents[1]) else tangents[1]
    if not places:
        totals, tracks = _call(kernel, (), params, outliers, features, moments)
        slope, moved = 0.0, None
    else:
        made = _with_tangents((kernel, places), params, outliers, features, moments)
        totals, tracks, slopes, moved = made
        change = jnp.concatenate([jnp.ravel(c) for c in changes.values()])
        slope = slopes @ change
        moved = jax.tree.map(lambda a: jnp.tensordot(change, a, 1), moved)
    out = _collect(kernel, totals, tracks, params)
    dots = zero_tangents(out)
    if tracks is not None and moved is not None:
        real, rest = eqx.partition(tracks.state, is_real)

        def measure(raw: Any, real: Any) -> Any:
            state = eqx.combine(real, rest)
            p, v, _ = _measure(kernel, tracks, params.with_raw(raw), state)
            return p, v

        raw = {name: params.raw[name] for name in changes}
        _, (p, v) = jax.jvp(measure, (raw, real), (changes, moved))
        dots = dots._replace(p=p, v=v)
    loss = slope + totals[loop.LOSS_BY_OUTLIERS] * by_outliers
    return out, dots._replace(loss=jnp.asarray(loss, out.loss.dtype))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_tangents(about: Any, params: Any, outliers: Any, features: Any, moments: Any) -> Any:
    return _call(*about, params, outliers, features, moments)


def _with_tangents_jvp(about: Any, primals: Any, tangents: Any) -> Any:
    refuse_second_derivatives(about[0].name, tangents, 'compiler="xla"')
    made = _with_tangents(about, *primals)
    return made, zero_tangents(made)


_run.defjvp(_run_jvp, symbolic_zeros=True)
_with_tangents.defjvp(_with_tangents_jvp, symbolic_zeros=True)
