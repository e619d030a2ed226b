"""The estimator of blobs: a filter of one target, and what all trackers share."""

import dataclasses
import functools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxevent.blob.engine.program import TrackVariant
from jaxevent.blob.engine.runner import KernelRunner
from jaxevent.blob.filter import Filter
from jaxevent.blob.lifecycle import TrackerState, shift_state
from jaxevent.blob.live import LiveTracks
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import ChunkPacker, Features, ReadoutTimes
from jaxevent.blob.run import XlaRunner, run
from jaxevent.blob.search import TargetSearchResult, find
from jaxevent.blob.smoother import (
    SmoothedTracks,
    backward_pass,
    propagate_to_chunk_end,
    readout_smoothed,
    terminal_info,
)
from jaxevent.blob.track import TrackBuffer, TrackStates, is_alive, readout
from jaxevent.blob.tracks import Tracks
from jaxevent.codegen.module import choose_backend, make_kernel
from jaxevent.errors import InputError, InputWarning
from jaxevent.estimator import Estimator, OptionKind, option_of_class
from jaxevent.recording import Recording, Times, microseconds

P = TypeVar("P", bound=TrackerParams)


@dataclasses.dataclass(frozen=True, repr=False)
class Tracker(Estimator[P]):
    """Tracking of any number of blobs, each by a `Filter`.

    A tracker of your own needs a class of parameters, derived from `TrackerParams`, and a filter:

        mine = Tracker("mine", Params, dataclasses.replace(moment.filter, update=update))
    """

    filter: Filter
    family: ClassVar[str] = "blob"
    option_kinds: ClassVar[Mapping[str, OptionKind]] = {
        **Estimator.option_kinds,
        "found": option_of_class(TargetSearchResult),
    }
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"seeds", "start", "stop", "detect", "found", "smooth", "compiler"}),
        kw_only=True,
    )

    def names_left_open(self, explicit: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names of parameters that a search for targets may set; see `Estimator`."""
        return self.Params.names_not_stated(self.Params.settings(), explicit)

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: P | None = None,
        *,
        seeds: Sequence[Any] | np.ndarray | None = None,
        start: int | float | None = None,
        stop: int | float | None = None,
        detect: bool | None = None,
        found: TargetSearchResult | None = None,
        extrapolate: bool = False,
    ) -> tuple[Features, ReadoutTimes]:
        """Prepare all events of a recording, or of a part of it, for `run`.

        Of the parameters `events_per_step`, `cycle`, `cell` and those of the prefilter act here.

        Args:
            recording: The events.
            times: Times for `read`, integers (us) or floats (s).
            params: See `Params`; None: the defaults.
            seeds: See `estimate`.
            start: See `estimate`.
            stop: See `estimate`.
            detect: See `estimate`; by default only without seeds.
            found: See `estimate`.
            extrapolate: Whether times outside the recording are allowed; estimates are not valid
                there.

        Returns:
            Chunks of events for `run`, and the location of the times in them for `read`.

        Raises:
            InputError: See `estimate`; also times outside the recording.
        """
        self.check(recording)
        self.check_options(seeds=seeds, start=start, stop=stop, detect=detect, found=found)
        params = self.Params() if params is None else params
        packer = ChunkPacker(recording, params, seeds, start, stop, detect, found=found)
        us = np.atleast_1d(microseconds(times))
        if not extrapolate:
            packer.check_times(us)
        features = packer.pack_all()
        return features, packer.locate_times(features, us)

    def run(
        self, params: P, features: Features, state: TrackerState | None = None
    ) -> tuple[TrackBuffer, TrackerState]:
        """Track through chunks of events; pure.

        Losses need less memory, see `jaxevent.blob.losses`.

        Args:
            params: See `Params`.
            features: Chunks of `prepare`.
            state: State that the run before returned, of features that end where these begin;
                None: the recording starts here.

        Returns:
            All tracks at every chunk's start and after each of its steps, whose arrays begin with
            (chunks, steps + 1, targets), and the state at the end. `smooth` makes them rest on
            later events too.
        """
        state, info = run(self.filter, params, state, features, "states")
        assert info.tracks is not None
        last = jnp.max(jnp.where(features.cycle, jnp.arange(len(features.cycle)), 0))
        return info.tracks, shift_state(state, jnp.asarray(features.stop)[last])

    def smooth(self, params: P, features: Features, trajectory: TrackBuffer) -> SmoothedTracks:
        """Smooth a trajectory of `run` with all events of the features; pure.

        Args:
            params: See `Params`.
            features: Chunks of `prepare`.
            trajectory: Tracks that `run` returned.

        Returns:
            The trajectory for `read`, with the information of later events.

        Raises:
            InputError: The filter's states cannot be smoothed.
        """
        self._check_smoothing()
        elapsed = jnp.asarray(features.elapsed)

        def smooth_chunk(carry: Any, chunk: Array) -> Any:
            path = jax.tree.map(lambda a: a[chunk], trajectory)
            end = jax.tree.map(lambda a: a[-1], path)
            info = propagate_to_chunk_end(carry[0], end, carry[1])
            info = backward_pass(self.filter, params, path, info)
            return (jax.tree.map(lambda a: a[0], info), elapsed[chunk]), info

        after = terminal_info(jax.tree.map(lambda a: a[-1, -1], trajectory))
        chunks = jnp.arange(len(elapsed), dtype=jnp.int32)
        carry = after, jnp.zeros_like(elapsed[0])
        _, info = lax.scan(smooth_chunk, carry, chunks, reverse=True)
        return SmoothedTracks(trajectory, info)

    def read(
        self, params: P, trajectory: TrackBuffer | SmoothedTracks, out: ReadoutTimes
    ) -> TrackStates:
        """Read out the tracks at the prepared times; pure.

        Args:
            params: See `Params`.
            trajectory: Tracks of `run`, whose states rest on the events up to each time, or of
                `smooth`, whose states rest on all events.
            out: Location of the times, of `prepare`.

        Returns:
            States of the seeds' targets in the user's order, then of the detected ones, as many as
            may be held at a time. Confirmed targets are valid. `Tracks` includes the time before
            the confirmation too, for it knows what follows.
        """
        now = jax.tree.map(lambda a: a[out.chunk, out.step], trajectory)
        time = jnp.asarray(out.time)
        if isinstance(now, SmoothedTracks):
            tracks, read = now.tracks, functools.partial(readout_smoothed, self.filter, params)
            states = jax.vmap(jax.vmap(read, (0, 0, None)))(tracks, now.info, time)
        else:
            tracks, read = now, functools.partial(readout, self.filter, params)
            states = jax.vmap(jax.vmap(read, (0, None)))(tracks, time)
        mean, covariance, idle = states
        valid = jax.vmap(is_alive, (None, 0, 0))(params, tracks, time)
        valid &= jnp.asarray(out.inside)[:, None]
        seeds = len(out.seed_index)
        valid = valid.at[:, :seeds].set(valid[:, :seeds] & ~jnp.asarray(out.ended))
        id = tracks.id
        if seeds:
            index = jnp.asarray(out.seed_index)
            id = jnp.where((id >= 0) & (id < seeds), index[jnp.clip(id, 0, seeds - 1)], id)
            order = jnp.concatenate([jnp.argsort(index), jnp.arange(seeds, id.shape[1])])
            mean, covariance, idle, valid, id = (
                part[:, order] for part in (mean, covariance, idle, valid, id)
            )
        return TrackStates(
            jnp.where(valid[..., None], mean, jnp.nan),
            jnp.where(valid[..., None, None], covariance, jnp.nan),
            valid,
            jnp.where(valid, idle, jnp.nan),
            jnp.where(valid, id, -1),
        )

    def estimate(
        self,
        recording: Recording,
        params: P | None = None,
        *,
        seeds: Sequence[Any] | np.ndarray | None = None,
        start: int | float | None = None,
        stop: int | float | None = None,
        detect: bool | None = None,
        found: TargetSearchResult | None = None,
        smooth: bool | None = None,
        compiler: str | None = None,
        progress: bool | None = None,
    ) -> Tracks:
        """Track the blobs of a recording.

        Without parameters and seeds the targets and their parameters are found first, see `find`.

        Args:
            recording: Events; frames are not needed.
            params: See `Params`; None: those of the found targets, or the defaults.
            seeds: Targets as (x, y, size) or (x, y, size, t): pixel, standard deviation
                of the events in px, and begin of the track (int us or float s on the recording's
                clock; by default `start`). They are confirmed at once.
            start: Begin of tracking, by default the first event.
            stop: End of tracking, by default after the last event.
            detect: Whether tracks are born of unassociated events; by default only with parameters
                and without seeds.
            found: Targets that `find` found. Tracks begin and end with them, and use events near
                them only.
            smooth: Whether states rest on all events, those after a time included. False: on those
                up to it. None: on all, where the filter can.
            compiler: "numba" tracks by kernels made of the filter's own functions, "xla" by the
                `run` that is differentiated; they agree to rounding. None: numba, where it has a
                kernel.
            progress: Whether to show a progress bar; None: on a terminal.

        Returns:
            The tracks, a function of time. An `InputWarning` tells that no target was found.

        Raises:
            InputError: A seed is outside the sensor or the time, there is no time to track, the
                filter's states cannot be smoothed, or numba is requested and has no kernel.
        """
        self.check(recording)
        self.check_options(
            seeds=seeds, start=start, stop=stop, detect=detect, found=found, smooth=smooth
        )
        choose_backend(compiler, True)
        if smooth:
            self._check_smoothing()
        smooth = self.filter.transition is not None if smooth is None else smooth
        if params is None and seeds is None and detect is None and found is None:
            found = find(recording, start, stop, progress=progress)
            if not len(found):
                warnings.warn(
                    f"{recording.name}: no target was found; give seeds=, or params= to begin "
                    "tracks wherever events gather",
                    InputWarning,
                    stacklevel=2,
                )
        if params is None:
            params = self.Params(**found.settings()) if found is not None else self.Params()
        births = seeds is None and found is None if detect is None else detect
        runner = self._make_runner(params, compiler, births, found)
        packer = ChunkPacker(
            recording, params, seeds, start, stop, detect, found=found,
            events_per_segment=runner.events_per_segment,
        )  # fmt: skip
        return Tracks(runner, packer, smooth, progress)

    def live(
        self,
        size: tuple[int, int],
        params: P | None = None,
        *,
        seeds: Sequence[Any] | np.ndarray | None = None,
        start: int | float | None = None,
        detect: bool | None = None,
        compiler: str | None = None,
    ) -> LiveTracks:
        """Track the targets of events that are still to come; see `LiveTracks`.

        Targets are not searched for beforehand, as `find` needs the whole recording, and states are
        not smoothed.

        Args:
            size: (width, height) of the sensor, px.
            params: See `Params`; None: the defaults.
            seeds: Targets, see `estimate`.
            start: Begin of tracking; earlier events are left out. By default the first event.
            detect: Whether tracks are born of unassociated events; by default only without seeds.
            compiler: See `estimate`; the readout is always compiled by XLA.

        Returns:
            The tracks, to which events are added.

        Raises:
            InputError: A seed is outside the sensor, or numba is requested and has no kernel.
        """
        choose_backend(compiler, True)
        self.check_options(seeds=seeds, start=start, detect=detect)
        params = self.Params() if params is None else params
        detect = seeds is None if detect is None else detect
        runner = self._make_runner(params, compiler, detect)
        return LiveTracks(self.filter, runner, size, seeds=seeds, start=start, detect=detect)

    def _check_smoothing(self) -> None:
        if self.filter.transition is None:
            raise InputError(
                f"the states of the method {self.name!r} cannot be smoothed, its filter has no "
                "`transition`; leave out smooth"
            )

    def _make_runner(
        self, params: P, compiler: str | None, detect: bool, found: TargetSearchResult | None = None
    ) -> KernelRunner | XlaRunner:
        """Make the runner of segments: by numba where it has a kernel, else by XLA."""
        overrides = tuple(found.per_target_values(params)) if found else ()
        variant = TrackVariant(overrides, has_owners=bool(found))
        make = functools.partial(KernelRunner, self.filter, params, detect=detect, variant=variant)
        kernel = make_kernel(self.name, compiler, True, make)
        return XlaRunner(self.filter, params) if kernel is None else kernel
