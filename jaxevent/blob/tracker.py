"""The one estimator of blobs: a filter of one target, and what all trackers share."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxevent.blob.engine.tracking import FusedRun
from jaxevent.blob.lifecycle import State, shift
from jaxevent.blob.live import LiveTracks
from jaxevent.blob.params import TrackerParams
from jaxevent.blob.prepare import Features, Packing, ReadOut
from jaxevent.blob.run import run
from jaxevent.blob.search import TargetSearchResult, find
from jaxevent.blob.smoother import Smoothed, at_end, look_back, nothing_later, tell_smoothed
from jaxevent.blob.states import TrackStates, is_alive, tell
from jaxevent.blob.steps import Filter
from jaxevent.blob.targets import Slots
from jaxevent.blob.tracks import Tracks
from jaxevent.codegen.module import choose_backend, make_kernel
from jaxevent.errors import InputError
from jaxevent.estimator import Estimator, OptionKind, of_class
from jaxevent.recording import Recording, Times, microseconds

P = TypeVar("P", bound=TrackerParams)


@dataclasses.dataclass(frozen=True, repr=False)
class Tracker(Estimator[P]):
    """Tracking of any number of blobs, each by a `Filter`.

    One of your own needs a class of parameters, derived from `TrackerParams`, and a filter:

        mine = Tracker("mine", Params, dataclasses.replace(moment.filter, update=update))
    """

    filter: Filter
    family: ClassVar[str] = "blob"
    option_kinds: ClassVar[Mapping[str, OptionKind]] = {
        **Estimator.option_kinds,
        "found": of_class(TargetSearchResult),
    }
    options: frozenset[str] = dataclasses.field(
        default=frozenset({"seeds", "start", "stop", "detect", "found", "smooth", "compiler"}),
        kw_only=True,
    )

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
    ) -> tuple[Features, ReadOut]:
        """All events of a recording, or of a part of it, for `run`, and `times` for `read`.

        Of the parameters `events_per_step`, `cycle`, `cell` and those of the prefilter act here.
        Options and errors as those of `estimate`; also raises `InputError` for times outside the
        recording, unless told to `extrapolate`: then the estimate is not valid there.
        """
        self.check(recording)
        self.check_options(seeds=seeds, start=start, stop=stop, detect=detect, found=found)
        params = self.Params() if params is None else params
        packing = Packing(recording, params, seeds, start, stop, detect, found=found)
        us = np.atleast_1d(microseconds(times))
        if not extrapolate:
            packing.check_times(us)
        features = packing.whole()
        return features, packing.read_out(features, us)

    def run(self, params: P, features: Features, state: State | None = None) -> tuple[Slots, State]:
        """Track: all targets at every chunk's start and after each of its steps, and at the end.

        The trajectory's arrays begin with (chunks, steps + 1, targets). `state` is what the run
        before returned, of features that end where these start; omitted, the recording starts here.
        `smooth` adds what later events say. For losses, which need less memory, see
        `jaxevent.blob.losses`.
        """
        state, told = run(self.filter, params, state, features, "states")
        assert told.slots is not None
        last = jnp.max(jnp.where(features.cycle, jnp.arange(len(features.cycle)), 0))
        return told.slots, shift(state, jnp.asarray(features.stop)[last])

    def smooth(self, params: P, features: Features, trajectory: Slots) -> Smoothed:
        """A trajectory of `run`, to be read with all events of the features; pure.

        Raises `InputError` where the filter's states cannot be smoothed.
        """
        self._check_smoothing()
        elapsed = jnp.asarray(features.elapsed)

        def one(carry: Any, chunk: Array) -> Any:
            path = jax.tree.map(lambda a: a[chunk], trajectory)
            later = at_end(carry[0], jax.tree.map(lambda a: a[-1], path), carry[1])
            later = look_back(self.filter, params, path, later)
            return (jax.tree.map(lambda a: a[0], later), elapsed[chunk]), later

        after = nothing_later(jax.tree.map(lambda a: a[-1, -1], trajectory))
        chunks = jnp.arange(len(elapsed), dtype=jnp.int32)
        _, later = lax.scan(one, (after, jnp.zeros_like(elapsed[0])), chunks, reverse=True)
        return Smoothed(trajectory, later)

    def read(self, params: P, trajectory: Slots | Smoothed, out: ReadOut) -> TrackStates:
        """The targets at the times prepared: first the seeds' in the order given.

        Those found follow, as many as may be held at a time. States rest on the events up to each
        time, those of what `smooth` returned on all. Valid are confirmed targets; unlike `Tracks`,
        which knows what follows, this leaves out the time before they were confirmed.
        """
        now = jax.tree.map(lambda a: a[out.chunk, out.step], trajectory)
        time = jnp.asarray(out.time)
        if isinstance(now, Smoothed):
            slots, of_one = now.slots, functools.partial(tell_smoothed, self.filter, params)
            told = jax.vmap(jax.vmap(of_one, (0, 0, None)))(slots, now.later, time)
        else:
            slots, of_one = now, functools.partial(tell, self.filter, params)
            told = jax.vmap(jax.vmap(of_one, (0, None)))(slots, time)
        mean, covariance, idle = told
        valid = jax.vmap(is_alive, (None, 0, 0))(params, slots, time)
        valid &= jnp.asarray(out.inside)[:, None]
        seeds = len(out.given)
        valid = valid.at[:, :seeds].set(valid[:, :seeds] & ~jnp.asarray(out.ended))
        id = slots.id
        if seeds:
            given = jnp.asarray(out.given)
            id = jnp.where((id >= 0) & (id < seeds), given[jnp.clip(id, 0, seeds - 1)], id)
            order = jnp.concatenate([jnp.argsort(given), jnp.arange(seeds, id.shape[1])])
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

        Without parameters and seeds the targets and what suits them are found first, see `find`.

        Args:
            recording: Events; frames are not needed.
            params: See `Params`; None: those of what is found, or the defaults.
            seeds: Where targets are, one (x, y, size) or (x, y, size, t) for each: the pixel, about
                twice the standard deviation of its events in px, and when the track begins (int us
                or float s on the recording's clock; by default at `start`). They are confirmed at
                once.
            start: Tracking begins there, by default at the first event.
            stop: And ends before this, by default after the last event.
            detect: Whether tracks are born where events belong to none; by default only with
                parameters and without seeds.
            found: Targets found before, by `find`. Tracks begin and end with them, and take events
                that are near them only.
            smooth: Whether states rest on all events, those after a time included. False: on those
                up to it, as they are known while events come. None: on all, where the filter can.
            compiler: "numba" follows and reads targets by kernels made of the filter's own
                functions, "xla" by the `run` that is differentiated; both to rounding the same.
                None: numba, where it has a kernel.
            progress: Whether a bar is shown; None: where somebody looks on.

        Raises:
            InputError: A seed is outside the sensor or the time, there is no time to track, the
                filter's states cannot be smoothed, or numba is asked for and has no kernel.
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
        if params is None:
            params = self.Params(**found.settings()) if found is not None else self.Params()
        packing = Packing(recording, params, seeds, start, stop, detect, found=found)
        fused = self._fused(params, compiler, packing)
        if fused is not None:
            packing.lengthen()
        return Tracks(self.filter, packing, params, progress, smooth, fused)

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
        """Targets of events that are still to come; see `LiveTracks`.

        Nothing is found beforehand, as `find` needs the whole recording, and nothing is smoothed.

        Args:
            size: (width, height) of the sensor, px.
            params: See `Params`; None: the defaults.
            seeds: Where targets are, as `estimate` takes them.
            start: Tracking begins there, and earlier events are left out; by default at the first
                event.
            detect: Whether tracks are born where events belong to none; by default only without
                seeds.
            compiler: As of `estimate`; what is read is compiled by XLA.

        Raises:
            InputError: A seed is outside the sensor, or numba is asked for and has no kernel.
        """
        choose_backend(compiler, True)
        self.check_options(seeds=seeds, start=start, detect=detect)
        params = self.Params() if params is None else params
        kernel = functools.partial(self._fused, params, compiler)
        return LiveTracks(
            self.filter, params, size, seeds=seeds, start=start, detect=detect, kernel=kernel
        )

    def _check_smoothing(self) -> None:
        if self.filter.transition is None:
            raise InputError(
                f"the states of the method {self.name!r} cannot be smoothed, its filter has no "
                "`transition`; leave out smooth"
            )

    def _fused(self, params: P, compiler: str | None, packing: Packing) -> FusedRun | None:
        """The kernel that follows targets; None where XLA does."""
        make = functools.partial(FusedRun, self.filter, params, packing)
        return make_kernel(self.name, compiler, True, make)
