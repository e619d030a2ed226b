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

from jaxevent import dispatch
from jaxevent.camera import PinholeCamera
from jaxevent.codegen.module import make_kernel
from jaxevent.devices import make_mesh, shard
from jaxevent.egomotion.candidates import Candidates, Expected, Gatherer
from jaxevent.egomotion.estimator import COMMON, Batch, MotionEstimator, Stretch, truth_of
from jaxevent.egomotion.geometry import length
from jaxevent.egomotion.models import Model
from jaxevent.egomotion.motion import Calibration, Motion
from jaxevent.egomotion.particle_filter import filtering
from jaxevent.egomotion.particle_filter.engine.running import FusedRun
from jaxevent.egomotion.particle_filter.filtering import Info, Noise, State
from jaxevent.egomotion.particle_filter.parameters import Params
from jaxevent.egomotion.particle_filter.smoothing import smoothed
from jaxevent.egomotion.patches import Speed
from jaxevent.errors import InputError
from jaxevent.estimator import Estimate
from jaxevent.progress import bar
from jaxevent.recording import Recording, Times, check_times, microseconds

CHUNK = 1024  # scored events after which the host looks where the motion is
SPAN = 0.1  # of tau_max, or after so long
CHANGE = 1.2  # factor by which speeds are expected to change until then
GATE = 3.5  # sigma_x, how far from the flow of the mean candidates are still looked at, at least
CELL = 16  # px: which candidates are looked at is chosen for parts of the sensor of about this size
AGES, OLDEST = 1.2, 1.0  # of the oldest candidates: in baselines of the usual speed, s at most
PLANAR, OTHERS = Calibration(change=0.12), Calibration(factor=0.7, change=0.05)
FASTEST = 2.5  # usual speeds, that a search goes to at least
KERNEL_EVENTS = 100_000  # scored ones, from which on a kernel is compiled
SPREAD = 0.2  # of the first particles of a fit, in shares of the true motion

_run = eqx.filter_jit(filtering.run)
_begin = eqx.filter_jit(filtering.begin)
_draw = eqx.filter_jit(filtering.draw)


class Features(eqx.Module):
    """What the filter needs of a recording."""

    model: Model
    candidates: Candidates
    noise: Noise


class ReadOut(eqx.Module):
    """Between which batches times lie, and how far on; see `Motion`."""

    before: Any  # (times,)
    after: Any
    share: Float[Array | np.ndarray, " times"]
    inside: Bool[Array | np.ndarray, " times"]  # of the recording, from the first batch on


@dataclasses.dataclass(frozen=True, repr=False)
class Voting(MotionEstimator[Params]):
    """Motion by voting, batch by batch, as events arrive.

    `estimate` looks, after every few batches, only at candidates that the motion found so far can
    need. `prepare` knows no motion and gathers candidates for all that a search looks at; of more
    than `params.candidates` it takes these many evenly.
    """

    def start(self, model: type[Model]) -> Params:
        return Params(preset=model.preset)

    def gatherer(
        self,
        recording: Recording,
        params: Params | None = None,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
    ) -> tuple[Model, Gatherer]:
        """The model, and its candidates: `gatherer(...)[1].whole(youngest, oldest)`.

        `camera` is by default the recording's. Raises `InputError` as `estimate` does.
        """
        kind, camera = self.place(recording, model, camera)
        params = self.start(kind) if params is None else params
        if params.undistort is False and camera is not None:
            camera = dataclasses.replace(camera, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
        gatherer = Gatherer(
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
        return kind(gatherer.f), gatherer

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
    ) -> tuple[Features, ReadOut]:
        """A recording for `run`, with the random numbers of a seed, and `times` for `read`.

        Raises `InputError` as `estimate` does, for a recording without events and, unless told to
        `extrapolate`, for times outside the recording.
        """
        self.check_options(seed=seed)
        kind, gatherer = self.gatherer(recording, params, model, camera)
        if not len(recording.events):
            raise InputError(f"{recording.name}: holds no events; choose another recording")
        if not extrapolate:
            check_times(times, recording.start, recording.stop, recording.name)
        params = self.start(type(kind)) if params is None else params
        looked = look(params, kind, _corners(kind, gatherer), None)
        whole = gatherer.whole(looked.youngest, looked.oldest)
        noise = _draw(jax.random.key(seed), len(whole.t), params, kind)
        us, n = np.atleast_1d(microseconds(times)), len(whole.t)
        place = np.searchsorted(whole.t, us, "right")
        after, before = np.minimum(place, n - 1), np.maximum(place - 1, 0)
        gap = whole.t[after] - whole.t[before]
        share = np.clip((us - whole.t[before]) / np.maximum(gap, 1), 0, 1)
        inside = (us >= whole.t[0]) & (us <= recording.stop)
        real = np.dtype(jnp.result_type(float))
        features = Features(kind, jax.device_put(whole.candidates), noise)
        return features, ReadOut(before, after, share.astype(real), inside)

    def run(
        self, params: Params, features: Features, state: State | None = None
    ) -> tuple[tuple[Model, Info], State]:
        """The filter over all batches: what each tells, and the particles at the end."""
        state, info = filtering.run(
            params, features.model, features.candidates, features.noise, state
        )
        return (features.model, info), state

    def read(self, params: Params, trajectory: tuple[Model, Info], out: ReadOut) -> Estimate:
        model, info = trajectory
        before, after, share = (jnp.asarray(v) for v in (out.before, out.after, out.share))

        def between(values: Array) -> Array:
            s = share.reshape(-1, *[1] * (values.ndim - 1))
            return (1 - s) * values[before] + s * values[after]

        valid = ~info.searching[before] & ~info.searching[after] & jnp.asarray(out.inside)
        mean = jax.vmap(model.on_manifold)(between(info.mean))
        return Estimate(mean, between(info.covariance), valid)

    def estimate(
        self,
        recording: Recording,
        params: Params | None = None,
        *,
        model: str | type[Model] | None = None,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        progress: bool | None = None,
        smooth: bool = False,
        cloud: int = 0,
        compiler: str | None = None,
    ) -> Motion:
        """The motion of a camera, batch by batch, as events arrive.

        Args:
            recording: Events; nothing else is looked at but the calibration.
            params: See `Params`; by default as they are there, with the model's `preset` and ages
                that `suit` the recording.
            model: What moves: see `models`.
            camera: The calibration, by default the recording's.
            seed: Of the particles; the same seed gives the same motion.
            progress: Show a bar on stderr; None: where somebody looks on.
            smooth: `smoothed` by later events, for use after the recording.
            cloud: So many particles of each batch, drawn by weight, are the motion's `cloud`.
            compiler: "numba" runs a kernel made of the filter's own functions, "xla" the `run` that
                is differentiated. Log-likelihoods of the two are the same to rounding, and weights
                to `params.off` where the kernel interpolates; which particles are resampled may
                differ then, as with another seed. None: in single precision and from 100,000 scored
                events on (one in `params.every` is) numba, where there is a kernel: for all but the
                literal likelihood.

        Raises:
            InputError: The model is unknown, or it needs a camera and there is none, or numba is
                asked for and has no kernel.
        """
        self.check_options(seed=seed, progress=progress, smooth=smooth, cloud=cloud)
        dispatch.check_threads()
        if params is None:
            found, _ = self.place(recording, model, camera)
            params = self.suit(recording, self.start(found), camera=camera).params
        kind, gatherer = self.gatherer(recording, params, model, camera)
        batches = -(-CHUNK // params.batch)
        events = len(recording.events) // params.every
        run = self._kernel(params, kind, compiler, events) or functools.partial(_run, params, kind)
        key, corners = jax.random.key(seed), _corners(kind, gatherer)
        state, parts, number, span = None, [], 0, SPAN * float(params.tau_max)
        with bar(
            total=len(recording.events),
            desc="find motion",
            unit="event",
            unit_scale=True,
            progress=progress,
        ) as shown:
            while not gatherer.done:
                noise = _draw(jax.random.fold_in(key, number), batches, params, kind)
                if state is None:
                    state = _begin(params, kind, noise)
                looked = look(params, kind, corners, state)
                made = gatherer.gather(
                    batches, looked.youngest, looked.oldest, span, looked.expected
                )
                state, info = run(made.candidates, noise, state, cloud)
                used = int((made.row >= 0).any(1).sum())
                info = jax.tree.map(lambda a, n=used: np.asarray(a)[:n], info)
                parts.append((made.t[:used], info))
                shown.update(int(made.row.max(initial=0)) + 1 - shown.n)
                number += 1

        motion = _told(kind, parts, cloud > 0).within(recording)
        if not parts:
            return motion
        by = (PLANAR if kind.uniform else OTHERS).behind(camera or recording.camera)
        return (smoothed(motion, params) if smooth else motion).calibrated(by, 2 * motion.lag)

    def _kernel(
        self, params: Params, model: Model, compiler: str | None, events: int
    ) -> FusedRun | None:
        """The filter as a kernel; None where XLA compiles it."""
        serves = jnp.result_type(float) == np.float32 and events >= KERNEL_EVENTS
        return make_kernel(self.name, compiler, serves, lambda: FusedRun(params, model))

    def follow(
        self,
        stretches: Sequence[Stretch],
        params: Params,
        model: type[Model],
        runs: int,
        settle: float | int,
    ) -> list[Batch]:
        """Stretches with particles that start around the true motion, so that no search is fitted.

        Filled up to one shape, so that one program serves all; random numbers stay the same.
        """
        made = [self._gathered(stretch, params, model) for stretch in stretches]
        most = max((len(candidates.elapsed) for _, candidates, _ in made), default=0)
        real = np.dtype(jnp.result_type(float))
        batches: list[Batch] = []
        for number, (stretch, (kind, candidates, t)) in enumerate(
            zip(stretches, made, strict=True)
        ):
            n = len(t)

            def fill(array: Any, n: int = n) -> NDArray:
                array = np.asarray(array)
                return np.pad(array, [(0, most - n), *[(0, 0)] * (array.ndim - 1)])

            time = (t - stretch.start) * 1e-6
            grid, truth = truth_of(stretch)
            counted = candidates.valid[:n].any(1) & (time >= settle) & stretch.known.within(t)
            key = jax.random.key(number)
            cloud = jax.random.normal(
                jax.random.fold_in(key, runs), (params.particles, kind.dimension), real
            )
            noise = jax.vmap(lambda k: filtering.draw(k, most, params, kind))(  # noqa: B023
                jax.random.split(key, runs)
            )
            batches.append(
                Followed(
                    fill(time).astype(real),
                    grid.astype(real),
                    truth.astype(real),
                    fill(counted).astype(real),
                    np.asarray(max(counted.sum(), 1e-9), real),
                    kind,
                    jax.tree.map(fill, candidates),
                    noise,
                    cloud,
                )
            )
        return jax.device_put(batches)

    def _gathered(
        self, stretch: Stretch, params: Params, model: type[Model]
    ) -> tuple[Model, Candidates, NDArray[np.int64]]:
        """The candidates of a stretch, of the ages that half to double the true speeds look at."""
        kind, gatherer = self.gatherer(stretch.cut(), params, model)
        youngest, oldest = 0.0, float(params.tau_max)
        if params.likelihood != "literal" and not model.half_line:
            times = np.linspace(stretch.start, stretch.stop, 32).astype(np.int64)
            times = times[stretch.known.within(times)]
            places = gatherer.xi[:: max(1, len(gatherer.xi) // 8), ::16].reshape(-1, 2)
            basis = np.asarray(kind.basis(jnp.asarray(places)))
            speed = np.linalg.norm(np.einsum("kid,td->kti", basis, stretch.known(times)), axis=-1)
            b = float(params.baseline)
            youngest = min(b / max(speed.max(), 1e-9), oldest) / 4
            oldest = min(2 * b / max(speed.min(), 1e-9), oldest)
        whole = gatherer.whole(youngest, oldest)
        return kind, whole.candidates, whole.t


class Followed(Batch):
    """A stretch whose motion is followed from its true beginning on, in some runs."""

    candidates: Candidates
    noise: Noise  # leaves begin with [runs]
    start: Float[Array | np.ndarray, "N d"]  # standard normal, of the first particles

    def estimates(self, params: Params) -> tuple[Array, Array]:
        return jax.vmap(lambda noise: self.one(params, noise))(self.noise)

    def one(self, params: Params, noise: Noise) -> tuple[Array, Array]:
        """Of one run."""
        first, normal = jnp.asarray(self.truth)[0], jnp.asarray(self.start)
        particles = []
        for part in self.model.parts:
            middle, normal_part = first[part.rows], normal[:, part.rows]
            near = middle + SPREAD * jnp.sqrt((middle**2).mean()) * normal_part
            if part.direction:
                near = near / length(near)[:, None]
            particles.append(near)
        state = filtering.around(params, jnp.concatenate(particles, 1))
        _, info = filtering.run(params, self.model, self.candidates, noise, state)
        return info.mean, info.lag

    def over(self, devices: Sequence[Any]) -> "Followed":
        """Runs shared out, or particles if runs are too few."""
        runs, particles = self.noise.normal.shape[0], self.start.shape[0]
        chosen = make_mesh(devices, runs)
        by_run = chosen is not None and chosen.size == len(devices)
        if not by_run:
            chosen = make_mesh(devices, particles)
        if chosen is None:
            return jax.device_put(self, devices[0])
        noise = self.noise
        axes = (0, 0, 0, None) if by_run else (2, None, 1, 0)
        arrays = (noise.normal, noise.uniform, noise.cloud, self.start)
        placed = [shard(chosen, v, axis) for v, axis in zip(arrays, axes, strict=True)]
        return eqx.tree_at(
            lambda b: (b.noise.normal, b.noise.uniform, b.noise.cloud, b.start),
            shard(chosen, self),
            placed,
        )


def _told(model: Model, parts: list[tuple[NDArray, Any]], cloud: bool) -> Motion:
    """The motion of what a filter says, times and `Info` of one stretch after another."""
    if not parts:
        return Motion.nothing(type(model))

    def whole(name: str) -> NDArray:
        return np.concatenate([getattr(info, name) for _, info in parts])

    return Motion(
        type(model),
        np.concatenate([t for t, _ in parts]),
        whole("mean"),
        whole("covariance"),
        ~whole("searching"),
        whole("lag"),
        whole("contrast"),
        whole("evidence"),
        whole("cloud") if cloud else None,
    )


def _corners(model: Model, gatherer: Gatherer) -> NDArray[np.floating]:
    """The model's basis (rows, columns, 2, d) at the corners of equal parts of the sensor.

    Where the flow is the same everywhere one part is enough, and where it is not linear no more
    are used.
    """
    parts = (1, 1)
    if not (model.uniform or model.half_line):
        parts = tuple(max(1, n // CELL) for n in gatherer.xi.shape[:2])
    lines, columns = (
        np.rint(np.linspace(0, n - 1, k + 1)).astype(int)
        for n, k in zip(gatherer.xi.shape[:2], parts, strict=True)
    )
    xi = gatherer.xi[np.ix_(lines, columns)]
    return np.asarray(model.basis(jnp.asarray(xi.astype(np.dtype(jnp.result_type(float))))))


def lengths(params: Params, speed: Speed) -> dict[str, float]:
    """The oldest candidates, so old that a quarter of the image has moved by the baseline.

    They stay where they are half as old at least: a motion that changes is told worse by old ones.
    """
    if params.likelihood == "literal":
        return {}
    chosen, oldest = {}, AGES * float(params.baseline) / speed.fast
    if oldest > 2 * float(params.tau_max):
        chosen["tau_max"] = min(oldest, OLDEST)
    if FASTEST * speed.usual > float(params.speed_max):
        chosen["speed_max"] = FASTEST * speed.usual
    return chosen


class Looked(NamedTuple):
    """At which candidates the next batches can need to look; see `Gatherer.gather`."""

    youngest: float | NDArray[np.floating]
    oldest: float | NDArray[np.floating]
    expected: Expected | None


def look(params: Params, model: Model, corners: NDArray, state: State | None) -> Looked:
    """By parts of the sensor: those whose flow is about what the mean makes there.

    While the motion is searched for, without a state and in the literal likelihood: all.
    """
    tau_max, b, share = (float(v) for v in (params.tau_max, params.baseline, params.youngest))
    if params.likelihood == "literal":
        return Looked(0.0, tau_max, None)
    if model.half_line:
        tau = float(params.tau_general)
        return Looked(share * tau, tau, None)
    if params.likelihood == "band" or state is None or bool(state.searching):
        widest = np.full(model.dimension, float(model.extent(params)))
        fastest = float(np.sqrt(((np.abs(corners) @ widest) ** 2).sum(-1)).max())
        return Looked(share * min(b / fastest, tau_max / 2), tau_max, None)
    particles, weights = np.asarray(state.particles), np.exp(np.asarray(state.log_weights))
    mean = weights @ particles
    spread = np.sqrt(weights @ (particles - mean) ** 2)
    U, wider = corners @ mean, np.sqrt(((corners**2) @ spread**2).sum(-1)).max()
    four = np.stack([U[:-1, :-1], U[1:, :-1], U[:-1, 1:], U[1:, 1:]])
    # All flows of a part are about within a circle that holds those of its corners.
    centre = four.mean(0)
    radius = np.sqrt(((four - centre) ** 2).sum(-1)).max(0)
    speed = np.sqrt((centre**2).sum(-1))
    fastest, slowest = CHANGE * (speed + radius), np.maximum(speed - radius, 0) / CHANGE
    young = np.minimum(b / np.maximum(fastest, 1e-9), tau_max)
    old = np.minimum(b / np.maximum(slowest, 1e-9), tau_max)
    slack = radius + 3 * wider + (CHANGE - 1) * (speed + radius)
    expected = Expected(np.moveaxis(centre, -1, 0), slack, GATE * float(params.sigma_x))
    return Looked(share * young, old, expected)


voting = Voting(
    "voting",
    Params,
    lengths=lengths,
    options=COMMON | {"smooth", "cloud", "compiler"},
    about="Motion by voting: a particle filter whose likelihood asks the earlier neighbours of "
    "events (Egomotion thesis, chapters 5 and 6, with all neighbours voting, softly).",
)
