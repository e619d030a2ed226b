"""Motion by voting as an estimator: `voting`."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaxevent import threads
from jaxevent.camera import PinholeCamera
from jaxevent.codegen.module import choose_backend, make_kernel, programs_may_call
from jaxevent.deprecated import renamed_methods
from jaxevent.egomotion.candidates import (
    CandidateBatches,
    Candidates,
    CandidateSampler,
    ExpectedFlow,
    join_batches,
)
from jaxevent.egomotion.estimator import (
    COMMON_OPTIONS,
    MotionEstimator,
    TrainingRuns,
    TrainingSegment,
)
from jaxevent.egomotion.evidence import EvidenceTest, LockDetector, report_before_lock
from jaxevent.egomotion.live import LiveMotion
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import CovarianceCalibration, MotionEstimate
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine import CompiledFilter, check_filter
from jaxevent.egomotion.particle_filter.filtering import BatchInfo, ParticleState, RandomNumbers
from jaxevent.egomotion.particle_filter.params import Params
from jaxevent.egomotion.particle_filter.training import WarmStartedRuns, training_spread
from jaxevent.egomotion.patches import ImageSpeed, is_camera_known_to_move
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.events.live import Tail
from jaxevent.progress import bar
from jaxevent.recording import Recording, Times, check_times, microseconds

EVENTS_PER_CHUNK = 1024  # scored events after which the range of candidates is updated
MAX_CHUNK_TAUS = 0.1  # tau_max, time after which it is updated at the latest
MAX_SPEED_CHANGE_RATIO = 1.2  # largest factor by which speeds are expected to change until then
GATE_SIGMAS = 3.5  # sigma_x, margin of candidates around the expected flow
CANDIDATE_CELL_PX = (
    16  # approximate size of the parts of the sensor with a range of candidates each
)
N_PARTS = 10  # of the sensor in x and y, whose events are as old as their own flow makes them
MAX_AGE_BASELINES = 1.2  # largest age of candidates, in baselines of the fast quarter of the image
MAX_CANDIDATE_AGE_S = 1.0
TIME_PENALTY_RATIO = 25.0  # r_t per median image speed
MIN_SEARCH_SPEED_RATIO = 2.5  # median image speeds, least largest speed of a search
MIN_GAP_BATCHES = 1.2  # longest batches, time between two from which the sensor was silent
MIN_KERNEL_EVENTS = 100_000  # scored events from which a kernel is compiled
# The maximum of the votes is up to about half a per cent beside the motion.
PLANAR_CALIBRATION = CovarianceCalibration(share=0.005, change=0.2)
GENERAL_CALIBRATION = CovarianceCalibration(0.7, share=0.005, change=0.2)
# Of models of linear flow, whose components' flows resemble each other in parts of the image.
LINEAR_CALIBRATION = CovarianceCalibration(0.7, share=0.005, flow_change=0.1)

_run = eqx.filter_jit(filtering.run)
_init = eqx.filter_jit(filtering.init)
_draw = eqx.filter_jit(filtering.draw)


class Features(eqx.Module):
    """A recording prepared for the filter."""

    model: Model
    candidates: Candidates
    noise: RandomNumbers


class ReadoutTimes(eqx.Module):
    """Positions of times between batches."""

    before: Any  # (times,) batch
    after: Any  # (times,) batch
    fraction: Float[Array | np.ndarray, " times"]  # of the interval from batch `before` to `after`
    inside: Bool[Array | np.ndarray, " times"]  # of the recording, from the first batch on


@renamed_methods(gatherer="sampler")
@dataclasses.dataclass(frozen=True, repr=False)
class VotingEstimator(MotionEstimator[Params]):
    """Motion by voting, batch by batch, as events arrive.

    After every few batches `estimate` updates the range of candidates that the motion found so far
    can need. `prepare` knows no motion and samples candidates for the whole range of a search; of
    more than `params.candidates` these many evenly.
    """

    def initial_params(self, model: type[Model]) -> Params:
        return Params(preset=model.preset)

    def sampler(
        self,
        recording: Recording,
        params: Params | None = None,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
    ) -> tuple[Model, CandidateSampler]:
        """Make the sampler of candidates: `sampler(...)[1].sample_all(youngest, oldest)`.

        Args:
            recording: The recording.
            params: The parameters.
            model: Motion model, or its name.
            camera: The camera; by default the recording's.

        Returns:
            The model with its focal length, and the sampler.

        Raises:
            InputError: The model is unknown, or it needs a camera and there is none.
        """
        kind, camera = self.find_model_and_camera(recording, model, camera)
        params = self.initial_params(kind) if params is None else params
        if params.undistort is False and camera is not None:
            camera = dataclasses.replace(camera, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
        sampler = CandidateSampler(
            recording,
            camera,
            radius=params.radius,
            per_pixel=params.per_pixel,
            most=params.candidates,
            every=params.every,
            batch=params.batch,
            longest=float(params.longest),
            silence=float(params.tau_max),
        )
        return kind(sampler.f), sampler

    def prepare(
        self,
        recording: Recording,
        times: Times,
        params: Params | None = None,
        *,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        extrapolate: bool = False,
    ) -> tuple[Features, ReadoutTimes]:
        self.check_options(seed=seed)
        kind, sampler = self.sampler(recording, params, model, camera)
        if not len(recording.events):
            raise InputError(f"{recording.name}: holds no events; choose another recording")
        if not extrapolate:
            check_times(times, recording.start, recording.stop, recording.name)
        params = self.initial_params(type(kind)) if params is None else params
        ages = candidate_range(params, kind, _basis_at_corners(kind, sampler), None)
        whole = sampler.sample_all(ages.youngest, ages.oldest)
        noise = _draw(jax.random.key(seed), len(whole.t), params, kind)
        us, n = np.atleast_1d(microseconds(times)), len(whole.t)
        row = np.searchsorted(whole.t, us, "right")
        after, before = np.minimum(row, n - 1), np.maximum(row - 1, 0)
        gap = whole.t[after] - whole.t[before]
        fraction = np.clip((us - whole.t[before]) / np.maximum(gap, 1), 0, 1)
        inside = (us >= whole.t[0]) & (us <= recording.stop)
        real = np.dtype(jnp.result_type(float))
        features = Features(kind, jax.device_put(whole.candidates), noise)
        return features, ReadoutTimes(before, after, fraction.astype(real), inside)

    def run(
        self, params: Params, features: Features, state: ParticleState | None = None
    ) -> tuple[tuple[Model, BatchInfo], ParticleState]:
        state, info = filtering.run(
            params, features.model, features.candidates, features.noise, state
        )
        return (features.model, info), state

    def read(
        self, params: Params, trajectory: tuple[Model, BatchInfo], out: ReadoutTimes
    ) -> Estimate:
        model, info = trajectory
        before, after, fraction = (jnp.asarray(v) for v in (out.before, out.after, out.fraction))

        def interpolate(values: Array) -> Array:
            s = fraction.reshape(-1, *[1] * (values.ndim - 1))
            return (1 - s) * values[before] + s * values[after]

        valid = ~info.searching[before] & ~info.searching[after] & jnp.asarray(out.inside)
        mean = jax.vmap(model.project)(interpolate(info.mean))
        return Estimate(mean, interpolate(info.covariance), valid)

    def estimate(
        self,
        recording: Recording,
        params: Params | None = None,
        *,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        progress: bool | None = None,
        causal: bool = False,
        smooth: bool | None = None,
        cloud: int = 0,
        compiler: str | None = None,
    ) -> MotionEstimate:
        """Estimate the motion of a camera, batch by batch, as events arrive.

        Args:
            recording: Recording whose events and calibration are used.
            params: The parameters; by default with the model's `preset` and ages adapted to the
                recording.
            model: Motion model, or its name; see `models`.
            camera: The calibration; by default the recording's.
            seed: Seed of the random numbers; it makes the estimate reproducible.
            progress: Whether to show a progress bar; by default in a terminal.
            causal: Whether estimates use events before their times alone, as live ones do. They
                lag, and their covariance has the change of the motion meanwhile.
            smooth: Whether to smooth by later events; by default unless `causal`. Without,
                estimates hold for the time `lag` before their own.
            cloud: Number of particles of each batch, drawn by weight, in the result's `cloud`.
            compiler: "numba" runs a kernel made of the filter's own functions, "xla" the `run` that
                is differentiated. Their log-likelihoods are equal to rounding, and weights to
                `params.off` where the kernel interpolates. Then other particles may be resampled,
                as with another seed. By default numba is used in single precision from 100,000
                scored events on, if there is a kernel: for all but the literal likelihood.

        Returns:
            The motion. An `InputWarning` tells that none was found, or that the recording
            contradicts it; of causal estimates, which know no later events, it does not.

        Raises:
            InputError: The model is unknown, it needs a camera and there is none, or the compiler
                is "numba" and there is no kernel.
        """
        self.check_options(seed=seed, progress=progress, causal=causal, smooth=smooth, cloud=cloud)
        if causal and smooth:
            raise InputError("a causal estimate cannot be smoothed; leave out causal or smooth")
        threads.check_not_forked()
        if params is None:
            found, _ = self.find_model_and_camera(recording, model, camera)
            start = self.initial_params(found)
            params = self.adapt_params(recording, start, camera=camera).params
        runner = self.make_runner(
            recording, params, model=model, camera=camera, seed=seed, compiler=compiler
        )
        parts = []
        with bar(
            total=len(recording.events), desc="find motion", unit="event", unit_scale=True,
            progress=progress,
        ) as shown:  # fmt: skip
            while not runner.sampler.is_exhausted:
                parts.append(runner.run(cloud))
                shown.update(runner.row - shown.n)
        if causal:
            motion = runner.causal_motion(parts).with_recording(recording)
            motion = motion._with_gaps(float(params.tau_max))
        else:
            motion = runner.motion(parts, smooth=smooth is not False)
            motion = self.check_against(recording, motion, camera)
        self.warn_if_lost(motion)
        return motion

    def make_runner(
        self,
        recording: Recording,
        params: Params,
        *,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        compiler: str | None = None,
    ) -> "ChunkRunner":
        """Make the filter over the chunks of a recording.

        Args:
            recording: The recording; that of a live stream holds the events so far.
            params: The parameters.
            model: Motion model, or its name.
            camera: The camera; by default the recording's.
            seed: Seed of the random numbers.
            compiler: "numba" or "xla", see `estimate`.

        Returns:
            The runner.

        Raises:
            InputError: The model is unknown, it needs a camera and there is none, or the compiler
                is "numba" and there is no kernel.
        """
        kind, sampler = self.sampler(recording, params, model, camera)
        events = len(recording.events) // params.every
        if isinstance(recording.events, Tail):
            events = MIN_KERNEL_EVENTS
        lock = self._make_lock(recording, params, kind, sampler, camera)
        kernel = self._kernel(params, kind, compiler, events)
        camera = camera or recording.camera
        return ChunkRunner(params, kind, sampler, kernel, lock, camera=camera, seed=seed)

    def live(
        self,
        size: tuple[int, int],
        params: Params | None = None,
        *,
        model: str | type[Model] = "planar",
        camera: PinholeCamera | None = None,
        seed: int = 0,
        compiler: str | None = None,
    ) -> LiveMotion:
        """Begin to estimate the motion of a live stream of events, see `egomotion.live`.

        Args:
            size: Width and height of the sensor, px.
            params: The parameters; by default those of the model. They are not adapted.
            model: Motion model, or its name.
            camera: The calibration.
            seed: Seed of the random numbers.
            compiler: "numba" or "xla", see `estimate`; by default a kernel if there is one.

        Returns:
            The live motion.

        Raises:
            InputError: The model is unknown, or it needs a camera and there is none.
        """
        self.check_options(seed=seed)
        recording = Recording("live", *size, Tail(*size), camera=camera)
        found, _ = self.find_model_and_camera(recording, model, camera)
        used = self.initial_params(found) if params is None else params

        make_runner = functools.partial(
            self.make_runner, recording, used, model=found, camera=camera, seed=seed,
            compiler=compiler,
        )  # fmt: skip
        return LiveMotion(recording, found, make_runner)

    def _make_lock(
        self,
        recording: Recording,
        params: Params,
        model: Model,
        sampler: CandidateSampler,
        camera: PinholeCamera | None,
    ) -> LockDetector | None:
        """Return the test of what the filter finds; None for likelihoods and models without one."""
        if params.likelihood == "literal" or model.half_line:
            return None
        diffusion = jax.jit(functools.partial(model.diffusion, params))
        moves = is_camera_known_to_move(recording, camera)
        test = EvidenceTest(model, sampler.xi)
        return LockDetector(test, float(params.baseline), float(params.tau_max), diffusion, moves)

    def _kernel(
        self, params: Params, model: Model, compiler: str | None, events: int
    ) -> CompiledFilter | None:
        """Return the filter as a kernel, or None where XLA compiles it."""
        is_faster = jnp.result_type(float) == np.float32 and events >= MIN_KERNEL_EVENTS
        return make_kernel(self.name, compiler, is_faster, lambda: CompiledFilter(params, model))

    def training_runs(
        self,
        segments: Sequence[TrainingSegment],
        params: Params,
        model: type[Model],
        runs: int,
        settle: float | int,
        *,
        compiler: str | None = None,
    ) -> list[TrainingRuns]:
        # Particles start around the true motion, so that no search is fitted. Segments are padded
        # to one shape, so that one program serves all; random numbers stay the same.
        sampled = [self._sample_segment(segment, params, model) for segment in segments]
        by_kernel = bool(sampled) and self._trains_by_kernel(params, sampled[0][0], compiler)
        most = max((len(candidates.elapsed) for _, candidates, _ in sampled), default=0)
        most_candidates = max((1, *(candidates.most_used for _, candidates, _ in sampled)))
        real = np.dtype(jnp.result_type(float))
        prepared: list[TrainingRuns] = []
        for number, (segment, (kind, candidates, t)) in enumerate(
            zip(segments, sampled, strict=True)
        ):
            n = len(t)

            def pad(array: Any, n: int = n) -> NDArray:
                array = np.asarray(array)
                return np.pad(array, [(0, most - n), *[(0, 0)] * (array.ndim - 1)])

            time, grid, truth, counted, _ = segment.truth(t, settle)
            counted = candidates.valid[:n].any(1) * counted
            key = jax.random.key(number)
            start = jax.random.normal(
                jax.random.fold_in(key, runs), (params.particles, kind.dimension), real
            )
            noise = jax.vmap(lambda k: filtering.draw(k, most, params, kind))(  # noqa: B023
                jax.random.split(key, runs)
            )
            prepared.append(
                WarmStartedRuns(
                    pad(time).astype(real),
                    grid.astype(real),
                    truth.astype(real),
                    pad(counted).astype(real),
                    np.asarray(max(counted.sum(), 1e-9), real),
                    kind,
                    jax.tree.map(pad, candidates.shorten(most_candidates)),
                    noise,
                    start,
                    by_kernel,
                )
            )
        return jax.device_put(prepared)

    def _trains_by_kernel(self, params: Params, model: Model, compiler: str | None) -> bool:
        """Return whether the runs of a fit are a kernel's, not XLA's."""
        serves = jnp.result_type(float) == np.float32
        if choose_backend(compiler, serves) == "xla" or not programs_may_call(self.name, compiler):
            return False
        check = functools.partial(check_filter, params, model)
        return make_kernel(self.name, compiler, serves, check) is not None

    def _sample_segment(
        self, segment: TrainingSegment, params: Params, model: type[Model]
    ) -> tuple[Model, Candidates, NDArray[np.int64]]:
        """Sample the candidates that motions near the true one need, chunk by chunk as `estimate`.

        Batches begin when events have come for the largest age of candidates, be they earlier than
        the segment. Where that is too late they begin at once. The literal likelihood has all
        candidates of the segment.

        Args:
            segment: The segment.
            params: The parameters.
            model: Motion model.

        Returns:
            The model, the candidates, and the times of their batches, us.
        """

        def find_range(us: int) -> CandidateRange:
            truth = segment.known(np.clip([us], segment.known.t[0], segment.known.t[-1]))[0]
            near = MotionRange(truth, training_spread(kind, truth))
            return candidate_range(params, kind, corners, near)

        recording, start, stop = segment.recording, segment.start, segment.stop
        kind, sampler = self.sampler(recording[start:stop], params, model)
        if params.likelihood == "literal":
            whole = sampler.sample_all(0.0, float(params.tau_max))
            return kind, whole.candidates, whole.t
        corners = _basis_at_corners(kind, sampler)
        lead = round(1e6 * float(np.max(find_range(start).oldest)))
        begin = max(start, recording.event_span()[0] + lead)
        if begin < stop:
            kind, sampler = self.sampler(recording[begin - lead : stop], params, model)
            sampler.skip(begin)
        batches, span = _chunk_size(params)
        parts: list[CandidateBatches] = []
        while not parts or not sampler.is_exhausted:
            ages = find_range(sampler.next_time)
            parts.append(sampler.sample(batches, ages.youngest, ages.oldest, span, ages.expected))
        whole = join_batches(parts)
        return kind, whole.candidates, whole.t


class ChunkRunner:
    """The filter over the chunks of a recording, one after another.

    Args:
        params: The parameters.
        model: Motion model.
        sampler: Sampler of the recording's candidates.
        kernel: The filter as a kernel, or None.
        lock: The test of what it finds, or None.
        camera: The calibration, or None.
        seed: Seed of the random numbers.
    """

    def __init__(
        self,
        params: Params,
        model: Model,
        sampler: CandidateSampler,
        kernel: CompiledFilter | None,
        lock: LockDetector | None,
        *,
        camera: PinholeCamera | None,
        seed: int,
    ):
        self.params, self.model, self.sampler, self.lock = params, model, sampler, lock
        self.camera = camera
        self.batches, self.span = _chunk_size(params)
        self.row = 0  # after the last event that was scored
        self._run = kernel or functools.partial(_run, params, model)
        self._key, self._corners = jax.random.key(seed), _basis_at_corners(model, sampler)
        self._state: ParticleState | None = None
        self._number = 0
        self._lag = 0.0  # s, of the latest observation

    def causal_motion(
        self, parts: list[tuple[NDArray[np.int64], Any, NDArray[np.bool_]]]
    ) -> MotionEstimate:
        """Join what `run` returned for some chunks to a causal estimate."""
        motion = dataclasses.replace(join_reports(self.model, parts), causal=True)
        return calibrate(motion, self.camera)

    def motion(
        self,
        parts: list[tuple[NDArray[np.int64], Any, NDArray[np.bool_]]],
        smooth: bool = True,
    ) -> MotionEstimate:
        """Join what `run` returned for all chunks to an estimate.

        Args:
            parts: What it returned.
            smooth: Whether later events smooth it.

        Returns:
            The motion.
        """
        motion = join_reports(self.model, parts).with_recording(self.sampler.recording)
        if not parts:
            return motion
        drift, longest = np.zeros_like(motion.covariance), float(self.params.tau_max)
        if self.lock is not None:
            searching = np.concatenate([info.searching for _, info, _ in parts])
            valid, covariance, drift = report_before_lock(
                motion.t, motion.mean, motion.covariance, searching, motion.valid,
                self.lock.diffusion,
            )  # fmt: skip
            motion = dataclasses.replace(motion, valid=valid, covariance=covariance)
        gaps = self._find_gaps(motion.t)
        valid = motion.valid.copy()
        for k in gaps:  # the filter coasts
            valid[k] |= bool(valid[k - 1 : k + 2 : 2].all())
        silent = [(int(motion.t[k - 1]), int(motion.t[k])) for k in gaps]
        motion = dataclasses.replace(motion, valid=valid)
        drift = dataclasses.replace(motion, covariance=drift)._with_gaps(longest).covariance
        motion = motion._with_gaps(longest)
        span = 2 * motion.lag
        if smooth:
            motion = filtering.smooth(motion, self.params)
            if not self.model.half_line:
                basis = None if self.model.uniform else self._basis_at_parts()
                mean = filtering.undo_averages(motion, span, self.params, basis)
                motion = dataclasses.replace(motion, mean=mean.astype(motion.mean.dtype))
        metric = None
        if not (self.model.uniform or self.model.half_line):
            metric = mean_square_flow(self.model, self.sampler.xi)
        found = calibrate(motion, self.camera, span, metric)
        seen, valid = found.observed_t, found.valid.copy()
        for begin, end in silent:
            valid[(seen > begin) & (seen < end)] = False
        return dataclasses.replace(found, covariance=found.covariance + drift, valid=valid)

    def _basis_at_parts(self) -> NDArray[np.floating]:
        """Return the model's basis (pixels, 2, d) in the middles of equal parts of the sensor."""
        xi = self.sampler.xi
        rows, columns = ((np.arange(N_PARTS) + 0.5) * n / N_PARTS for n in xi.shape[:2])
        basis = _basis_at(self.model, xi[np.ix_(rows.astype(int), columns.astype(int))])
        return basis.reshape(-1, *basis.shape[2:]).astype(float)

    def _find_gaps(self, t: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the batches before which the sensor was silent for about as long as one lasts.

        In a pause so short the camera may have stopped, or events have been dropped.
        """
        last = len(t) - 1
        gaps = 1 + np.flatnonzero(np.diff(t) > MIN_GAP_BATCHES * 1e6 * float(self.params.longest))
        return gaps[gaps < last]

    def has_chunk(self) -> bool:
        """Return whether the next chunk is complete, whatever events are still to come."""
        every, row = self.params.every, self.sampler.next_row
        events = self.sampler.recording.events
        first, count = -(-row // every) * every, len(events)
        if (count - first) // every > self.batches * self.params.batch:
            return True
        last = (count - 1) // every * every
        if last <= first:
            return False
        begin, end = (int(events[at : at + 1].t[0]) for at in (first, last))
        return end - begin > round(1e6 * self.span)

    def run(self, cloud: int = 0) -> tuple[NDArray[np.int64], Any, NDArray[np.bool_]]:
        """Run the next chunk.

        Args:
            cloud: Number of particles to report.

        Returns:
            Times (n,) of its batches, us, their stacked reports, and whether the motion is
                reported.
        """
        key = jax.random.fold_in(self._key, self._number)
        noise = _draw(key, self.batches, self.params, self.model)
        if self._state is None:
            self._state = _init(self.params, self.model, noise)
        near = MotionRange.of(self._state)
        ages = candidate_range(self.params, self.model, self._corners, near)
        sample = self.sampler.sample(
            self.batches, ages.youngest, ages.oldest, self.span, ages.expected
        )
        self._state, info = self._run(sample.candidates, noise, self._state, cloud)
        used = int((sample.row >= 0).any(1).sum())
        info = jax.tree.map(lambda a: np.asarray(a)[:used], info)
        # Events of a batch precede its end, on average by half of its duration.
        duration = np.minimum(sample.candidates.elapsed[:used], float(self.params.longest))
        # Where candidates are missing, the motion is predicted, as it was observed before.
        row = np.maximum.accumulate(
            np.where(sample.candidates.valid[:used].any(1), np.arange(used), -1)
        )
        lag = np.where(row >= 0, (info.lag + duration / 2)[row], self._lag)
        self._lag = float(lag[-1]) if used else self._lag
        info = eqx.tree_at(lambda report: report.lag, info, lag)
        t, reported = sample.t[:used], ~info.searching
        if self.lock is not None:
            events = self.sampler.recording.events
            count = np.diff(sample.row[:used].max(1), prepend=self.row - 1)
            reported = self.lock.update(
                events, count, t, info.mean, info.covariance, info.searching
            )
            # No motion is reported backwards across a pause.
            searching = info.searching | self.lock.sparse
            info = eqx.tree_at(lambda report: report.searching, info, searching)
        self._number += 1
        self.row = int(sample.row.max(initial=self.row - 1)) + 1
        return t, info, reported


def calibrate(
    motion: MotionEstimate,
    camera: PinholeCamera | None,
    length: NDArray[np.floating] | None = None,
    flow_metric: NDArray[np.floating] | None = None,
) -> MotionEstimate:
    """Return the motion with the covariance of its errors.

    Args:
        motion: Estimates of the filter or the smoother.
        camera: The calibration.
        length: (n,) time span of an estimate's events, s, in which changes between the neighbours,
            before and after, count; None: they do not.
        flow_metric: (d, d) `mean_square_flow`; None of models whose flow is the same everywhere,
            or not linear.

    Returns:
        The motion with the calibrated covariance.
    """
    if motion.model.uniform:
        calibration = PLANAR_CALIBRATION
    elif motion.model.half_line:
        calibration = GENERAL_CALIBRATION
    else:
        calibration = LINEAR_CALIBRATION
    calibration = calibration.with_lens(camera)
    if length is None:
        return motion.with_calibrated_covariance(calibration._replace(change=0.0))
    return motion.with_calibrated_covariance(calibration, length, flow_metric=flow_metric)


def mean_square_flow(model: Model, xi: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the matrix M of which v' M v is the mean square flow of a motion v.

    Args:
        model: A model of d components whose flow is linear in them.
        xi: (height, width, 2) undistorted positions of all pixels, px.

    Returns:
        The matrix (d, d).
    """
    basis = _basis_at(model, xi)
    rows = basis.reshape(-1, basis.shape[-1]).astype(float)
    return rows.T @ rows / (len(rows) / 2)


def join_reports(model: Model, parts: list[tuple[NDArray, Any, NDArray]]) -> MotionEstimate:
    """Join the reports of chunks of batches to an estimate.

    Args:
        model: Model of the motion.
        parts: Of each chunk times (n,), us, reports (n, ...), and whether each is reported (n,).

    Returns:
        The estimate.
    """
    if not parts:
        return MotionEstimate.empty(type(model))

    def join(name: str) -> NDArray:
        return np.concatenate([getattr(info, name) for _, info, _ in parts])

    cloud = join("cloud")
    return MotionEstimate(
        type(model),
        np.concatenate([t for t, *_ in parts]),
        join("mean"),
        join("covariance"),
        np.concatenate([reported for *_, reported in parts]),
        join("lag"),
        join("contrast"),
        join("evidence"),
        cloud if cloud.shape[1] else None,
    )


def _basis_at_corners(model: Model, sampler: CandidateSampler) -> NDArray[np.floating]:
    """Return the model's basis (rows, columns, 2, d) at the corners of equal parts of the sensor.

    One part is enough where the flow is the same everywhere, or not linear.
    """
    parts = (1, 1)
    if not (model.uniform or model.half_line):
        parts = tuple(max(1, n // CANDIDATE_CELL_PX) for n in sampler.xi.shape[:2])
    lines, columns = (
        np.rint(np.linspace(0, n - 1, k + 1)).astype(int)
        for n, k in zip(sampler.xi.shape[:2], parts, strict=True)
    )
    return _basis_at(model, sampler.xi[np.ix_(lines, columns)])


def _basis_at(model: Model, xi: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the model's basis at some positions.

    Args:
        model: Model of the motion.
        xi: (..., 2) undistorted positions, px.

    Returns:
        (..., 2, d).
    """
    return np.asarray(model.basis(xi.astype(np.dtype(jnp.result_type(float)))))


def adapt_lengths(params: Params, speed: ImageSpeed) -> dict[str, float]:
    """Adapt the age of the oldest candidates, and the largest speed of a search.

    The oldest candidates are so old that the fast quarter of the image has moved by the baseline.
    They stay as they are if they are at least half as old: old ones blur a motion that changes.
    Of the literal likelihood, the penalty of a wrong time: a speed, it grows with the image's.

    Args:
        params: The parameters.
        speed: Speed of the image.

    Returns:
        Values by parameter.
    """
    chosen, oldest = {}, MAX_AGE_BASELINES * float(params.baseline) / speed.fast
    if params.likelihood == "literal":
        chosen["r_t"] = TIME_PENALTY_RATIO * speed.median
    elif oldest > 2 * float(params.tau_max):
        chosen["tau_max"] = min(oldest, MAX_CANDIDATE_AGE_S)
    if MIN_SEARCH_SPEED_RATIO * speed.median > float(params.speed_max):
        chosen["speed_max"] = MIN_SEARCH_SPEED_RATIO * speed.median
    return chosen


class MotionRange(NamedTuple):
    """A motion, and how far particles are from it.

    Attributes:
        mean: (d,) the motion, in the units of the model.
        spread: (d,) standard deviation of each component.
    """

    mean: NDArray[np.floating]
    spread: NDArray[np.floating]

    @classmethod
    def of(cls, state: ParticleState | None) -> "MotionRange | None":
        """Return that of a filter's particles, or None in a search."""
        if state is None or bool(state.searching):
            return None
        particles, weights = np.asarray(state.particles), np.exp(np.asarray(state.log_weights))
        mean = weights @ particles
        return cls(mean, np.sqrt(weights @ (particles - mean) ** 2))


def _chunk_size(params: Params) -> tuple[int, float]:
    """Return batches of a chunk, and its longest duration, s."""
    return -(-EVENTS_PER_CHUNK // params.batch), MAX_CHUNK_TAUS * float(params.tau_max)


class CandidateRange(NamedTuple):
    """Candidates that the next batches can need; see `CandidateSampler.sample`."""

    youngest: float | NDArray[np.floating]  # least age, s; an array: of each part of the sensor
    oldest: float | NDArray[np.floating]  # largest age, s, likewise
    expected: ExpectedFlow | None  # flow that candidates must fit; None: any


def candidate_range(
    params: Params, model: Model, corners: NDArray, near: MotionRange | None
) -> CandidateRange:
    """Return the candidates near the flow of a motion, by parts of the sensor.

    In a search and for the literal likelihood all candidates are in the range.

    Args:
        params: The parameters.
        model: Motion model.
        corners: Basis at the corners of parts of the sensor, see `_basis_at_corners`.
        near: The motion; None in a search.

    Returns:
        The range.
    """
    tau_max, b, youngest = (float(v) for v in (params.tau_max, params.baseline, params.youngest))
    if params.likelihood == "literal":
        return CandidateRange(0.0, tau_max, None)
    if model.half_line:
        tau = float(params.tau_general)
        return CandidateRange(youngest * tau, tau, None)
    if params.likelihood == "band" or near is None:
        widest = np.full(model.dimension, float(model.search_bound(params)))
        fastest = float(np.sqrt(((np.abs(corners) @ widest) ** 2).sum(-1)).max())
        return CandidateRange(youngest * min(b / fastest, tau_max / 2), tau_max, None)
    U = corners @ near.mean
    flow_sigma = np.sqrt(((corners**2) @ near.spread**2).sum(-1)).max()
    four = np.stack([U[:-1, :-1], U[1:, :-1], U[:-1, 1:], U[1:, 1:]])
    # All flows of a part are about within a circle that holds those of its corners.
    centre = four.mean(0)
    radius = np.sqrt(((four - centre) ** 2).sum(-1)).max(0)
    speed = np.sqrt((centre**2).sum(-1))
    fastest = MAX_SPEED_CHANGE_RATIO * (speed + radius)
    slowest = np.maximum(speed - radius, 0) / MAX_SPEED_CHANGE_RATIO
    young = np.minimum(b / np.maximum(fastest, 1e-9), tau_max)
    old = np.minimum(b / np.maximum(slowest, 1e-9), tau_max)
    slack = radius + 3 * flow_sigma + (MAX_SPEED_CHANGE_RATIO - 1) * (speed + radius)
    margin = GATE_SIGMAS * float(params.sigma_x)
    expected = ExpectedFlow(np.moveaxis(centre, -1, 0), slack, margin)
    return CandidateRange(youngest * young, old, expected)


voting = VotingEstimator(
    "voting",
    Params,
    adapt_lengths=adapt_lengths,
    options=COMMON_OPTIONS | {"causal", "smooth", "cloud", "compiler"},
    about="Motion by voting: a particle filter whose likelihood is the vote of the earlier "
    "neighbours of events (Egomotion thesis, chapters 5 and 6, with soft votes of all neighbours).",
)
