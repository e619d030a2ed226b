"""What the voting filters are fitted to: motion that is known.

Settings of the method "voting" in a configuration of `jaxevent.runs.fit`:

    model = "planar"                    # or "rotation", "general"
    truth = "*.csv"                     # beside each recording, * being its name without suffix;
                                        # or "poses", "gyro" of the recording itself
    centred = false                     # compare with the motion that candidates show, `lag` ago
    runs = 4                            # of every window, with different random numbers
    settle = 0.05                       # s of every window before errors count
    gyro_bias = [0.0, 0.0, 0.0]         # rad/s, taken off the gyro first

A table of the true motion has the columns t (s) and the components of the model, as `jaxevent
motion` writes them (vx, vy in px/s; wx, wy, wz in rad/s; tx, ty, tz before them).

A recording is cut into windows of `window` seconds. If neither validation nor test is given, they
are shared out: with `split` = [2, 1, 1], of every 4 windows in turn 2 are to fit, 1 to validate and
1 to test; then `window` is by default an eighth of the recording. In every window particles start
around the true motion, so that no search is fitted; their random numbers stay the same during the
fit. The loss is the mean over batches and runs of |estimate - truth|^2, in units of the truth's;
of a general motion those of heading and of angular velocity are added. Its gradient goes through
weights, particles and, by the carried score, resampling; ages of candidates are held fixed.

Results: `error`, the mean relative error of the whole filter (search included) over the windows, %;
of a general motion `heading`, degrees; `lost`, the share of times at which it was lost.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaxevent.devices import along, mesh, shared_out
from jaxevent.egomotion import particle_filter as voting
from jaxevent.egomotion.candidates import Candidates
from jaxevent.egomotion.geometry import length
from jaxevent.egomotion.particle_filter import Model, Noise, Params
from jaxevent.egomotion.truth import (
    Known,
    axis_error,
    relative_error,
)
from jaxevent.errors import InputError
from jaxevent.io.output import finite, values_of
from jaxevent.recording import Recording
from jaxevent.runs import egomotion_scores as scores
from jaxevent.runs.config import read_params
from jaxevent.show.report import aligned
from jaxevent.splits import SPLITS, windows

Sources = Mapping[str, Sequence[tuple[str, Recording]]]
Share = tuple[int, ...] | None

# Parameters that act when candidates are gathered, and those of decisions: without gradient.
PREPARED = (
    *("longest", "tau_max", "baseline", "resample_below", "d_max", "V_max"),
    *("found", "contrast", "drop", "memory", "speed_max", "omega_max"),
)
SPREAD = 0.2  # of the first particles, in shares of the true motion
RATE = 200.0  # Hz at which estimates are scored


class Batch(eqx.Module):
    """A window: its candidates, the truth at the end of every batch, random numbers by run."""

    candidates: Candidates
    noise: Noise  # leaves begin with [runs]
    start: Float[Array | np.ndarray, "N dimension"]  # standard normal, of the first particles
    time: Float[Array | np.ndarray, " batches"]  # s since the window's start
    grid: Float[Array | np.ndarray, " T"]  # s, of the truth
    truth: Float[Array | np.ndarray, "T dimension"]
    counted: Float[Array | np.ndarray, " batches"]  # 1: the error counts
    weight: Float[Array | np.ndarray, ""]
    model: Model

    def over(self, devices: Sequence[Any]) -> "Batch":
        """The batch on several devices, runs shared out, or particles if runs are too few."""
        runs, particles = self.noise.normal.shape[0], self.start.shape[0]
        chosen = mesh(devices, runs)
        by_run = chosen is not None and chosen.size == len(devices)
        if not by_run:
            chosen = mesh(devices, particles)
        if chosen is None:
            return jax.device_put(self, devices[0])
        noise = self.noise
        axes = (0, 0, 0, None) if by_run else (2, None, 1, 0)
        arrays = (noise.normal, noise.uniform, noise.cloud, self.start)
        placed = [along(chosen, v, axis) for v, axis in zip(arrays, axes, strict=True)]
        return eqx.tree_at(
            lambda b: (b.noise.normal, b.noise.uniform, b.noise.cloud, b.start),
            along(chosen, self),
            placed,
        )


@dataclasses.dataclass(frozen=True)
class Loss:
    """The mean relative squared error of estimates, over runs: `loss(params, batch)`."""

    centred: bool = False

    def __call__(self, params: Params, batch: Batch) -> Float[Array, ""]:
        return jnp.mean(jax.vmap(lambda noise: self.one(params, batch, noise))(batch.noise))

    def one(self, params: Params, batch: Batch, noise: Noise) -> Float[Array, ""]:
        """Of one run."""
        parts = [slice(0, 3), slice(3, 6)] if batch.model.name == "general" else [slice(None)]
        first, normal = jnp.asarray(batch.truth)[0], jnp.asarray(batch.start)
        around = [
            first[part] + SPREAD * jnp.sqrt((first[part] ** 2).mean()) * normal[:, part]
            for part in parts
        ]
        if len(parts) == 2:
            around[0] = around[0] / length(around[0])[:, None]
        carry = dataclasses.replace(
            voting.begin(params, batch.model, noise),
            particles=jnp.concatenate(around, 1),
            searching=jnp.asarray(False),
        )
        _, told = voting.run(params, batch.model, batch.candidates, noise, carry)
        at = jnp.asarray(batch.time) - (jax.lax.stop_gradient(told.lag) if self.centred else 0)
        truth = jax.vmap(lambda column: jnp.interp(at, batch.grid, column), 1, 1)(
            jnp.asarray(batch.truth)
        )
        counted = jnp.asarray(batch.counted)
        total = jnp.zeros((), told.mean.dtype)
        for part in parts:
            square = ((told.mean[:, part] - truth[:, part]) ** 2).sum(1)
            scale = (truth[:, part] ** 2).sum(1)
            total += (square * counted).sum() / jnp.maximum((scale * counted).sum(), 1e-12)
        return total


class Part(NamedTuple):
    """A window of a recording, of times in us."""

    recording: Recording
    start: int
    stop: int
    known: Known
    split: int  # the place in SPLITS


@dataclasses.dataclass(frozen=True)
class Goal:
    """How a voting filter is fitted and scored; `jaxevent.runs.fit.Goal` describes the methods."""

    start: Params
    loss: Loss
    model: str
    truth: str
    runs: int
    settle: float | int
    gyro_bias: tuple[float, ...]
    prepared = PREPARED
    # Forwards: in reverse every candidate's vote would be kept.
    forward = True

    def files(self, recording: Path) -> list[Path]:
        return scores.files(recording, {"truth": self.truth})

    def problem(
        self, sources: Sources, split: Share, window: float | int | None
    ) -> Callable[[Params], tuple[list[Batch], list[Batch]]]:
        found = [part for part in self._parts(sources, split, window) if part.split < 2]
        prepared: tuple[Any, Any] = (None, None)

        def batches(params: Params) -> tuple[list[Batch], list[Batch]]:
            nonlocal prepared
            fixed = tuple(float(getattr(params, name)) for name in ("longest", "tau_max"))
            if prepared[0] != fixed:
                prepared = (None, None)  # so that two are never held at once
                made = self.batches(found, params)
                pairs = list(zip(found, made, strict=True))
                by_split = tuple(
                    shared_out([b for part, b in pairs if part.split == s]) for s in (0, 1)
                )
                prepared = fixed, by_split
            return prepared[1]

        return batches

    def batches(self, found: Sequence[Part], params: Params) -> list[Batch]:
        """Windows prepared, filled up to one shape, so that one program serves all."""
        made = [self._gathered(part, params) for part in found]
        most = max((len(candidates.elapsed) for _, candidates, _ in made), default=0)
        real = np.dtype(jnp.result_type(float))
        batches = []
        for number, (part, (kind, candidates, t)) in enumerate(zip(found, made, strict=True)):
            n = len(t)

            def fill(array: Any, n: int = n) -> NDArray:
                array = np.asarray(array)
                return np.pad(array, [(0, most - n), *[(0, 0)] * (array.ndim - 1)])

            candidates = jax.tree.map(fill, candidates)
            time = (t - part.start) * 1e-6
            grid = np.linspace(part.start, part.stop, 256)
            inside = np.clip(grid, part.known.t[0], part.known.t[-1])
            counted = candidates.valid[:n].any(1) & (time >= self.settle) & part.known.within(t)
            key = jax.random.key(number)
            cloud = jax.random.normal(
                jax.random.fold_in(key, self.runs), (params.particles, kind.dimension), real
            )
            noise = jax.vmap(lambda k: voting.draw(k, most, params, kind))(  # noqa: B023
                jax.random.split(key, self.runs)
            )
            batches.append(
                Batch(
                    candidates,
                    noise,
                    cloud,
                    fill(time).astype(real),
                    ((grid - part.start) * 1e-6).astype(real),
                    part.known(np.rint(inside).astype(np.int64)).astype(real),
                    fill(counted).astype(real),
                    np.asarray(max(counted.sum(), 1e-9), real),
                    kind,
                )
            )
        return jax.device_put(batches)

    def _gathered(self, part: Part, params: Params) -> tuple[Model, Candidates, NDArray[np.int64]]:
        """The candidates of a window, of the ages that half to double the true speeds look at."""
        recording = part.recording[part.start : part.stop]
        kind, gatherer = voting.prepare(recording, params, self.model)
        youngest, oldest = 0.0, float(params.tau_max)
        if params.likelihood != "literal" and self.model != "general":
            inside = part.known.within(np.linspace(part.start, part.stop, 32).astype(np.int64))
            times = np.linspace(part.start, part.stop, 32).astype(np.int64)[inside]
            places = gatherer.xi[:: max(1, len(gatherer.xi) // 8), ::16].reshape(-1, 2)
            basis = np.asarray(kind.basis(jnp.asarray(places)))
            speed = np.linalg.norm(np.einsum("kid,td->kti", basis, part.known(times)), axis=-1)
            b = float(params.baseline)
            youngest = min(b / max(speed.max(), 1e-9), oldest) / 4
            oldest = min(2 * b / max(speed.min(), 1e-9), oldest)
        whole = gatherer.whole(youngest, oldest)
        return kind, whole.candidates, whole.t

    def score(
        self,
        sources: Sources,
        split: Share,
        window: float | int | None,
        params: Params,
        progress: bool,
    ) -> Iterator[dict[str, Any]]:
        found = self._parts(sources, split, window)
        for place, (given, recording) in (
            (place, source) for place, name in enumerate(SPLITS) for source in sources[name]
        ):
            mine = [p for p in found if p.recording is recording]
            if not mine:
                continue
            known = mine[0].known
            motion = voting.estimate(recording, params, model=self.model, progress=progress)
            t = np.arange(mine[0].start, mine[-1].stop, round(1e6 / RATE))
            t = t[known.within(t)]
            mean, _, lost = motion(t, centred=self.loss.centred)
            truth = known(t)
            for k, name in enumerate(SPLITS):
                chosen = [p for p in mine if p.split == k and (split is not None or k == place)]
                inside = np.zeros(len(t), bool)
                for p in chosen:
                    inside |= (p.start <= t) & (t < p.stop)
                if not inside.any():
                    continue
                usable = inside & ~lost
                row: dict[str, Any] = {"recording": given, "split": name, "error": None}
                rates = slice(3, 6) if self.model == "general" else slice(None)
                if usable.any():
                    errors = relative_error(mean[usable, rates], truth[usable, rates])
                    row["error"] = finite(float(100 * errors.mean()))
                    if self.model == "general":
                        heading = axis_error(mean[usable, :3], truth[usable, :3])
                        row["heading"] = finite(float(heading.mean()))
                row["lost"] = float(lost[inside].mean())
                row["windows"] = len(chosen)
                yield {**row, "params": values_of(params)}

    def table(self, rows: Sequence[Mapping[str, Any]]) -> str:
        columns = [("error %", "error", 1, 2), ("lost", "lost", 1, 3), ("windows", "windows", 1, 0)]
        if any("heading" in row for row in rows):
            columns.insert(1, ("heading deg", "heading", 1, 2))
        return aligned(rows, columns)

    def known(self, recording: Recording) -> Known:
        """What is true of the motion of a recording, whose name is its path."""
        settings = {"model": self.model, "truth": self.truth, "gyro_bias": self.gyro_bias}
        return scores.true_motion(recording, settings)

    def _parts(self, sources: Sources, split: Share, window: float | int | None) -> list[Part]:
        """The windows of all recordings whose truth is known and that hold events."""
        found = []
        for place, (_, recording) in (
            (place, source) for place, name in enumerate(SPLITS) for source in sources[name]
        ):
            events, truth = recording.events, self.known(recording)
            if not len(events):
                raise InputError(f"{recording.name}: holds no events; choose another recording")
            first, stop = int(events[:1].t[0]), int(events[-1:].t[0]) + 1
            first, stop = max(first, int(truth.t[0])), min(stop, int(truth.t[-1]) + 1)
            if first >= stop:
                raise InputError(
                    f"{recording.name}: its events and the true motion are not of one time; times "
                    "are seconds on the recording's clock"
                )
            for begin, end, s in windows(first, stop, window, split, place):
                if events.index(begin) < events.index(end):
                    found.append(Part(recording, begin, end, truth, s))
        return found


class _Voting:
    """The system of the method "voting", for `jaxevent.runs.fit`."""

    settings: dict[str, tuple[Callable[[Any], bool], str]] = {
        **{
            name: scores.SETTINGS[name]
            for name in ("model", "truth", "centred", "settle", "gyro_bias")
        },
        "runs": (lambda value: type(value) is int and value > 0, "a whole number, 1 or more"),
    }
    own = ("model", "centred")

    def start(self, name: str, given: Any, folder: Path) -> Params:
        return read_params(Params, name, given, folder)

    def goal(self, name: str, params: Any, given: Mapping[str, Any]) -> Goal:
        scores.check(given)
        return Goal(
            params,
            Loss(given.get("centred", False)),
            given.get("model", "planar"),
            given["truth"],
            given.get("runs", 4),
            given.get("settle", 0.05),
            tuple(map(float, given.get("gyro_bias", (0.0, 0.0, 0.0)))),
        )


VOTING = _Voting()
