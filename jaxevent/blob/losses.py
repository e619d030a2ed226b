"""Losses that trackers are fitted to: the likelihood of events, or known positions."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from jaxevent.blob.engine.losses import LossKernel
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import ChunkPacker, Features
from jaxevent.blob.run import run
from jaxevent.blob.track import to_seconds
from jaxevent.blob.tracker import Tracker
from jaxevent.codegen.module import choose_backend, make_kernel, programs_may_call
from jaxevent.errors import InputError
from jaxevent.recording import Recording, Times, check_recording, microseconds


def negative_log_likelihood(
    tracker: Tracker,
    params: TrackerParams,
    features: Features,
    events: str = "associated",
    compiler: str | None = None,
) -> Float[Array, ""]:
    """Return the mean over events of -ln p(xi), each predicted before it is used.

    With "associated", p sums N(xi; p^-, L L^T + P_p) over the gates that hold the event, and only
    events in a gate count: right for process noise, but a smaller gate lowers it. With "all",
    p = (1 - o) mean_i N_i(xi) + o / area, o = `outliers`, for every event and without gates: right
    for gates and for whole recordings too. N is the filter's `log_likelihood`. A loss for
    `jaxevent.tuning.optimise`, with the tracker given: `functools.partial(..., tracker)`.

    Args:
        tracker: The estimator.
        params: Its parameters.
        features: Chunks of events, of `Tracker.prepare`.
        events: Events that count, "associated" or "all".
        compiler: "numba" computes the loss and its derivatives by parameters by kernels, "xla" by
            the scan of `jaxevent.blob.run`, which has all derivatives. None: numba, where it has
            kernels.

    Returns:
        The loss, p in px^-2.

    Raises:
        InputError: Numba is requested and has no kernel.
    """
    kernel = _find_kernel(tracker, params, features, events == "all", compiler)
    if kernel is not None:
        found = kernel(params, features)
        return found.loss / jnp.maximum(found.count, 1)
    _, info = run(tracker.filter, params, None, features, events)
    assert info.loss is not None and info.count is not None
    return info.loss.sum() / jnp.maximum(info.count.sum(), 1)


def _find_kernel(
    tracker: Tracker, params: TrackerParams, features: Features, every: bool, compiler: str | None
) -> LossKernel | None:
    """Find the kernel of a loss.

    Args:
        tracker: The estimator.
        params: Its parameters.
        features: Chunks of events.
        every: Whether every event counts, not only those inside a gate.
        compiler: "numba" or "xla" if the user names one.

    Returns:
        The kernel, or None where XLA compiles the loss.

    Raises:
        InputError: The user names numba, and there is no kernel.
    """
    if choose_backend(compiler, True) == "xla" or not programs_may_call(tracker.name, compiler):
        return None

    def make() -> LossKernel:
        kernel = LossKernel(tracker.name, tracker.filter, every)
        kernel.check(params, features)
        return kernel

    return make_kernel(tracker.name, compiler, True, make)


class PositionBatch(eqx.Module):
    """A batch of `position_error`: prepared events, and true positions of the seeds' targets.

    Attributes:
        features: Prepared events.
        chunk: Chunk of each time.
        step: Steps of the chunk done by then.
        time: The time, us since the chunk's start.
        xi: True positions, px.
        known: Whether the position is known.
    """

    features: Features
    chunk: Int[np.ndarray | Array, " times"]
    step: Int[np.ndarray | Array, " times"]
    time: Int[np.ndarray | Array, " times"]
    xi: Float[np.ndarray | Array, "times seeds 2"]
    known: Bool[np.ndarray | Array, "times seeds"]


def position_error(
    tracker: Tracker,
    params: TrackerParams,
    batch: PositionBatch,
    scale: float | int = 10,
    compiler: str | None = None,
) -> Float[Array, ""]:
    """Return the mean of 2 s^2 (sqrt(1 + d^2 / s^2) - 1), d the distance of tracks from the truth.

    It is d^2 for d well below s and grows as d beyond, so that one lost target does not dominate.
    Lost targets go on along their last velocity.

    Args:
        tracker: The estimator.
        params: Its parameters.
        batch: A batch of `prepare_positions`.
        scale: s, px.
        compiler: See `negative_log_likelihood`.

    Returns:
        The loss, px^2.

    Raises:
        InputError: Numba is requested and has no kernel.
    """
    features, targets = batch.features, batch.xi.shape[1]
    kernel = _find_kernel(tracker, params, features, False, compiler)
    if kernel is not None:
        moments = batch.chunk * (features.t.shape[1] + 1) + batch.step
        path = kernel(params, features, moments)
        p, v, last = (part[:, :targets] for part in (path.p, path.v, path.last_update))
    else:
        _, info = run(tracker.filter, params, None, features, "path")
        assert info.path is not None
        p, v, last = (part[batch.chunk, batch.step, :targets] for part in info.path)
    dt = to_seconds(batch.time[:, None] - last, p)
    d2 = ((p + v * dt[..., None] - jnp.where(batch.known[..., None], batch.xi, p)) ** 2).sum(-1)
    error = 2 * scale**2 * (jnp.sqrt(1 + d2 / scale**2) - 1)
    return jnp.where(batch.known, error, 0).sum() / jnp.maximum(batch.known.sum(), 1)


def prepare_positions(
    recording: Recording,
    params: TrackerParams,
    seeds: Sequence[Any] | np.ndarray,
    times: Times,
    positions: NDArray[np.floating],
    *,
    start: int | float | None = None,
    stop: int | float | None = None,
) -> PositionBatch:
    """Prepare a batch for `position_error`.

    Args:
        recording: The events.
        params: Parameters that act when events are packed, see `Tracker.prepare`.
        seeds: One (x, y, size) or (x, y, size, t) for every target.
        times: Sorted, (times,).
        positions: True x and y at these times, (times, seeds, 2) in px; NaN where not known.
        start: Begin of tracking, by default the first event.
        stop: End of tracking, by default after the last event.

    Returns:
        The batch.

    Raises:
        InputError: Positions of another shape, times outside the part that is tracked.
    """
    check_recording(recording, "blob.prepare_positions")
    packer = ChunkPacker(recording, params, seeds, start, stop, False)
    features = packer.pack_all()
    us = np.atleast_1d(microseconds(times))
    positions = np.asarray(positions)
    if positions.shape != (len(us), len(seeds), 2):
        raise InputError(
            f"{recording.name}: positions have shape {positions.shape}; give x and y of every "
            f"seed at every time: ({len(us)}, {len(seeds)}, 2)"
        )
    if len(us) and (us.min() < packer.start or us.max() >= packer.stop):
        raise InputError(
            f"{recording.name}: positions are given from {us.min()} to {us.max()} us, but events "
            f"are used from {packer.start} to {packer.stop - 1} us; leave out the others"
        )
    out = packer.locate_times(features, us)
    truth = positions[:, packer.seeds.index]
    known = np.asarray(np.isfinite(truth).all(-1))
    xi = np.where(known[..., None], truth, 0).astype(features.xi.dtype)
    return PositionBatch(features, out.chunk, out.step, out.time, xi, known)
